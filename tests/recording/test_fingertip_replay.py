"""A recording with force/torque frames through `skin replay`: touches and slips in their order."""

import asyncio
import json
from pathlib import Path

import pytest

from emulator.probes.scene import load as load_scene
from emulator.robot import Robot
from skin_host.bus.strain import start_frames
from skin_host.cli import main
from skin_host.config.settings import load
from skin_host.layout import build_layout, load_skin
from skin_host.mqtt.address import Broker
from skin_host.processing.calibration.file import save_calibration
from skin_host.processing.core import Engine
from skin_host.processing.events import Touch
from skin_host.recording.capture import capture_broker
from skin_host.recording.mcap import Recorder, read_messages_of, recorded_topics
from skin_host.recording.playback import play_processed
from skin_host.recording.replay import calibrate_from_log, replay
from tests.support.broker import Mosquitto
from tests.support.waiting import until

CONFIG = Path(__file__).parents[2] / "config"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve seconds of the shipped scene: a press, a slip, a press of the thumb."""
    settings = load(CONFIG / "fingertips.toml")
    scene = load_scene(CONFIG / "scenes" / "fingertips.toml")
    robot = Robot(settings, build_layout(settings, CONFIG), scene)
    robot.bring_up()
    for tip in settings.fingertips.values():
        for can_id, data in start_frames(tip.address, tip.period_ms):
            robot.receive("can0", can_id, data)
    lines = []
    while robot.t_ns < 12_480_000_000:
        batch = robot.step(0.12)["can0"]
        for row in range(len(batch)):
            t_ns = 1_763_700_000_000_000_000 + int(batch.t_ns[row])
            payload = batch.data[row, : batch.dlc[row]].tobytes().hex().upper()
            seconds, micros = t_ns // 10**9, t_ns % 10**9 // 1000
            lines.append(f"({seconds}.{micros:06}) can0 {batch.id[row]:03X}#{payload}\n")
    path = tmp_path_factory.mktemp("fingertips") / "fingertips.log"
    path.write_text("".join(lines))
    return path


def test_a_replay_tells_what_the_fingertips_felt_and_tells_it_again(
    recording: Path, tmp_path: Path
) -> None:
    outputs = [tmp_path / "first.jsonl", tmp_path / "second.jsonl"]
    for output in outputs:
        command = ["replay", str(recording), "--config", str(CONFIG / "fingertips.toml")]
        assert main([*command, "--calibrate-seconds", "5", "--output", str(output)]) == 0
    assert outputs[0].read_bytes() == outputs[1].read_bytes()
    lines = [json.loads(line) for line in outputs[0].read_text().splitlines()]
    touches = [one for one in lines if one["type"] == "touch" and one["part"] == "index"]
    assert [touches[0]["event"], touches[-1]["event"]] == ["begin", "end"]
    assert [one["count"] for one in touches] == list(range(1, len(touches) + 1))
    slips = [one for one in lines if one["type"] == "slip"]
    assert [slips[0]["event"], slips[0]["count"], slips[0]["id"]] == ["begin", 1, 1]
    joined = [one for one in lines if one["type"] == "touch" and one["part"] == "thumb"]
    assert any(one["taxels"] for one in joined)
    health = {one["part"]: one for one in lines if one["type"] == "health"}
    assert set(health) == {"thumb_skin", "index", "thumb"}
    assert health["index"]["state"] == "ok"
    assert "age_ms" not in health["index"]


def cut(recording: Path, folder: Path) -> tuple[Path, int]:
    """The same without what the index's board sends from 0.3 s of its first touch on, and when that
    is.
    """
    settings, layout = load_skin(CONFIG / "fingertips.toml")
    found = calibrate_from_log(recording, settings, layout, 5.0)
    engine = Engine(settings, layout, list(range(len(layout.parts))), found)
    begun = (
        event
        for output in replay(recording, engine)
        for event in output.events
        if isinstance(event, Touch) and event.part == "index"
    )
    cut_ns = next(begun).t_ns + 300_000_000

    def came(line: str) -> bool:
        seconds, micros = line[1 : line.index(")")].split(".")
        return int(seconds) * 10**9 + int(micros) * 1000 < cut_ns

    log = folder / "stops.log"
    lines = recording.read_text().splitlines(keepends=True)
    log.write_text("".join(line for line in lines if came(line) or " can0 31" not in line))
    return log, cut_ns


def test_a_recording_that_begins_after_the_boards_were_queried_is_read_by_the_calibration(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = CONFIG / "fingertips.toml"
    settings, layout = load_skin(config)
    found = calibrate_from_log(recording, settings, layout, 5.0)
    begin_s = 1_763_700_005
    log, known = tmp_path / "late.log", tmp_path / "calibration.json"
    lines = recording.read_text().splitlines(keepends=True)
    log.write_text("".join(line for line in lines if int(line[1:].split(".")[0]) >= begin_s))
    save_calibration(known, found, layout)

    def events_of(path: Path, *options: str) -> list[tuple[str, str, int]]:
        output = tmp_path / "a.jsonl"
        replaying = ["replay", str(path), "--config", str(config), "--output", str(output)]
        assert main([*replaying, *options]) == 0
        lines = [json.loads(line) for line in output.read_text().splitlines()]
        return [
            (one["part"], one["event"], one["t_ns"])
            for one in lines
            if one["type"] in ("touch", "slip") and one["part"] == "index"
        ]

    late = events_of(log, "--calibration", str(known))
    assert "full scales" not in capsys.readouterr().err
    assert late == events_of(recording, "--calibration", str(known))
    assert late[0][1] == "begin"
    assert events_of(log, "--calibrate-seconds", "1") == []
    assert "the full scales of index are unknown" in capsys.readouterr().err


async def test_it_ends_so_at_a_broker_too(
    recording: Path, tmp_path: Path, mosquitto: Mosquitto
) -> None:
    log, cut_ns = cut(recording, tmp_path)
    settings, layout = load_skin(CONFIG / "fingertips.toml")
    found = calibrate_from_log(log, settings, layout, 5.0)
    engine = Engine(settings, layout, list(range(len(layout.parts))), found)
    there, stop = Broker(mosquitto.host, mosquitto.port), asyncio.Event()
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        last = recorded_topics("skin", settings.robot)[-1]
        capturing = asyncio.create_task(
            capture_broker(recorder, there, "skin", settings.robot, stop)
        )
        await until(lambda: mosquitto.subscriptions(last) > 0)
        await play_processed(log, engine, settings, there, speed=20)
        await until(lambda: recorder.messages.get("status") == 2)
        stop.set()
        await capturing
    messages = list(read_messages_of(path))
    touches = [json.loads(one.payload) for one in messages if one.topic.endswith("/index/touch")]
    assert (touches[-1]["event"], touches[-1]["reason"]) == ("end", "lost")
    assert 0 < touches[-1]["t_ns"] - cut_ns < 1_000_000_000
    states = [one.payload for one in messages if one.topic.endswith("/index/contact")]
    assert states[-1] == b"UNKNOWN"


def test_a_contact_whose_samples_stop_in_a_recording_ends_as_lost(
    recording: Path, tmp_path: Path
) -> None:
    """As with the daemon; the other boards go on."""
    output = tmp_path / "out.jsonl"
    command = ["--config", str(CONFIG / "fingertips.toml"), "--calibrate-seconds", "5"]
    log, cut_ns = cut(recording, tmp_path)
    assert main(["replay", str(log), *command, "--output", str(output)]) == 0
    found = [json.loads(line) for line in output.read_text().splitlines()]
    touches = [one for one in found if one["type"] == "touch" and one["part"] == "index"]
    assert (touches[-1]["event"], touches[-1]["reason"]) == ("end", "lost")
    assert 0 < touches[-1]["t_ns"] - cut_ns < 1_000_000_000
    (health,) = [one for one in found if one["type"] == "health" and one["part"] == "index"]
    assert health["state"] == "silent"


def test_a_fingertip_has_no_taxels_to_draw_and_its_picture_is_refused_with_what_there_is(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output, config = tmp_path / "a.png", str(CONFIG / "fingertips.toml")
    command = ["plot", "pressure", str(recording), str(output), "--config", config]
    assert main([*command, "--part", "index"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        "skin plot: index: a fingertip on a force/torque board has no taxels to draw; wanted a "
        "part of skin: thumb_skin; its touches and slips: `skin export`"
    )
    assert not output.exists()
