"""The commands around recordings, as they are typed."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from skin_host.bus.opening import open_port
from skin_host.bus.port import Port
from skin_host.cli import main
from skin_host.config.settings import Mqtt, load
from skin_host.layout import build_layout, load_skin
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import FIRST_RETRY_S, GOOD_S, Retry, connect
from skin_host.mqtt.info import encode_info, node_info
from skin_host.mqtt.publisher import Publisher
from skin_host.recording import capture
from skin_host.recording.capture import capture_broker
from skin_host.recording.export import read_messages
from skin_host.recording.mcap import Recorder, read_messages_of, recorded_topics
from tests.support.broker import Mosquitto
from tests.support.candump import write_config, write_log
from tests.support.talking import live, talking
from tests.support.waiting import PATIENCE_S, until
from tests.support.world import World

ROOT = Path(__file__).parents[2]
CONFIG = ROOT / "config" / "icub_hand.toml"
GRASP = ROOT.parent / "shared" / "data" / "icub_grasp.log"
needs_grasp = pytest.mark.skipif(not GRASP.exists(), reason=f"{GRASP} is not here")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("grasp") / "grasp.log"
    path.write_text("".join(GRASP.read_text().splitlines(keepends=True)[:2600]))
    return path


def test_a_picture_needs_no_window_that_the_environment_names(tmp_path: Path) -> None:
    """A name that matplotlib does not know was a traceback."""
    log, config = write_log(tmp_path / "a.log", 140, lambda period: ()), tmp_path / "skin.toml"
    words = ["plot", "pressure", str(log), str(tmp_path / "a.png")]
    done = subprocess.run(
        [sys.executable, "-m", "skin_host", *words, "--config", str(write_config(config))],
        env={**os.environ, "MPLBACKEND": "of_another_program"},
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


@needs_grasp
def test_a_recording_is_exported_and_drawn(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = ["--config", str(CONFIG)]
    assert main(["export", str(log), str(tmp_path / "a.npz"), *config]) == 0
    assert main(["export", str(log), str(tmp_path / "tables"), *config]) == 0
    assert main(["plot", "map", str(log), str(tmp_path / "map.png"), *config]) == 0
    said = capsys.readouterr().out.split()
    assert [Path(line).name for line in said] == [
        "a.npz",
        "left_hand.csv",
        "touches.csv",
        "slips.csv",
        "overs.csv",
        "contacts.csv",
        "health.csv",
        "map.png",
    ]
    with np.load(tmp_path / "a.npz") as arrays:
        assert arrays["left_hand.pressure_kpa"].shape == (260, 108)


def test_a_recording_opens_with_the_mcap_reader_and_replays_to_the_same_bytes(
    tmp_path: Path,
) -> None:
    world = World(tmp_path, tmp_path, Mosquitto("never started", tmp_path))
    world.write_recordings()
    with (tmp_path / "grasp.mcap").open("rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert {"skin/demo/left_hand/frame", "skin/demo/left_hand/touch"} < topics
    replayed = []
    for number, name in enumerate(["grasp.mcap", "grasp.mcap", "grasp.log"]):
        output = tmp_path / f"{number}.jsonl"
        log = str(tmp_path / name)
        assert main(["replay", log, "--config", str(world.robot), "--output", str(output)]) == 0
        replayed.append(output.read_bytes())
    assert replayed[0] == replayed[1] == replayed[2]
    kinds = Counter(json.loads(line)["type"] for line in replayed[0].splitlines())
    assert kinds["frame"] > 100
    assert kinds["touch"] >= 2
    assert kinds["health"] == 2


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["export", "b.log", "a.npz"], "skin export: b.log: CAN frames need --config"),
        (["export", "a.log", "a.npz"], "skin export: a.log: cannot be read: No such file"),
        (["export", ".", "a.npz"], "skin export: .: unknown format of file name; known are .asc"),
        (["plot", "map", "setup.cfg", "a.png"], "skin plot: setup.cfg: unknown format of file"),
        (["export", "gone.mcap", "a.npz"], "skin export: gone.mcap: cannot be read: No such file"),
        (["plot", "calibration", "a.json", "a.png"], "skin plot: a calibration is drawn with"),
        (["record", "a.log"], "skin record: a.log: holds CAN frames alone and needs --config"),
        (["record", "a.txt"], 'skin record: a.txt: suffix ".txt"; wanted one of .log'),
        (["record", "setup.cfg"], "skin record: setup.cfg: is there already"),
        (["replay", "a.log"], "skin replay: the following arguments are required: --config"),
        (["replay", "a.log", "--onto", "can"], "skin replay: --onto can needs --config"),
        (["replay", "b.log", "--onto", "broker"], "skin replay: b.log: CAN frames need --config"),
        (["replay", "a.log", "--onto", "broker"], "skin replay: a.log: cannot be read: No such"),
        (["dbc", "gone.toml"], "skin dbc: gone.toml: cannot be read"),
    ],
)
def test_a_wrong_request_is_told_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    for there in ("b.log", "setup.cfg"):
        Path(there).touch()
    assert main(arguments) == 2
    seen = capsys.readouterr()
    assert seen.err.startswith(said)
    assert seen.err.count("\n") == 1
    assert seen.out == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.log", "setup.cfg"]


def test_a_dbc_is_printed_or_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dbc", str(CONFIG)]) == 0
    text = capsys.readouterr().out
    assert "BO_ 1248 left_hand_T00: 8 left_hand" in text
    assert main(["dbc", str(CONFIG), "--output", str(tmp_path / "a.dbc")]) == 0
    assert (tmp_path / "a.dbc").read_text() == text


@pytest.mark.parametrize("name", ["a.log", "a.mcap"])
def test_a_recording_of_a_bus_on_which_nothing_came_has_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    config = str(CONFIG.parent / "demo.toml")
    file = str(tmp_path / name)
    assert main(["record", file, "--config", config, "--seconds", "0.1", "--json"]) == 1
    told = capsys.readouterr()
    (line,) = told.err.splitlines()
    assert f"no CAN frame came on the buses of {config}" in line
    assert told.out == ""
    # The next attempt finds no file in its way.
    assert not any(tmp_path.iterdir())


def test_frames_that_are_played_where_nobody_is_are_no_success_without_a_word(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, config = write_log(tmp_path / "a.log", 3, lambda _: ()), tmp_path / "skin.toml"
    write_config(config)
    text = config.read_text()
    config.write_text(text.replace('channel = "can0"', 'channel = "can0"\ninterface = "virtual"'))
    assert main(["replay", str(log), "--config", str(config), "--onto", "can"]) == 0
    told = capsys.readouterr()
    assert told.out.endswith("frames played\n")
    (line,) = told.err.splitlines()
    assert line.startswith("warning: bus ")
    assert "no other program is on it" in line


async def test_a_robot_is_recorded_until_ctrl_c_and_played_again(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    layout = build_layout(load(CONFIG), CONFIG.parent)
    url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    file = tmp_path / "a.mcap"
    settings = Mqtt(host=mosquitto.host, port=mosquitto.port)
    async with Publisher(settings, "icub", "main") as publisher:
        publisher.put_info(node_info(layout, "main", version="1", configuration="x"))
        publisher.put_contact("left_hand", "ON")
        command = [
            sys.executable,
            "-m",
            "skin_host",
            "record",
            str(file),
            "--broker",
            url,
            "--json",
        ]
        recording = await asyncio.create_subprocess_exec(
            *command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        assert recording.stderr is not None
        assert b"recording" in await asyncio.wait_for(recording.stderr.readline(), PATIENCE_S)
        await asyncio.sleep(2.5)  # what is retained comes as soon as it listens
        recording.send_signal(signal.SIGINT)
        out, err = await asyncio.wait_for(recording.communicate(), PATIENCE_S)
    assert recording.returncode == 0, err
    told = json.loads(out)
    assert told["messages"] == {"contact": 1, "info": 1, "status": 1}
    assert {said.topic for said in read_messages_of(file)} >= {"skin/icub/left_hand/contact"}
    played = await asyncio.to_thread(
        main, ["replay", str(file), "--onto", "broker", "--broker", url, "--robot", "ghost"]
    )
    assert played == 0


async def test_the_time_of_a_recording_begins_when_the_robot_is_found(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    async with connect(Broker(mosquitto.host, mosquitto.port), identifier="robot") as connection:
        await connection.publish("skin/icub/palm/contact", b"ON", qos=1, retain=True)
    mosquitto.freeze()
    url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    options = ["--broker", url, "--robot", "icub", "--seconds", "0.5", "--json"]
    recording = await asyncio.create_subprocess_exec(
        *[sys.executable, "-m", "skin_host", "record", str(tmp_path / "a.mcap"), *options],
        cwd=ROOT,
        stdout=subprocess.PIPE,
    )
    await until(lambda: list(tmp_path.glob(".a.growing*")))
    await asyncio.sleep(1.0)  # longer than it records
    mosquitto.resume()
    out, _ = await asyncio.wait_for(recording.communicate(), PATIENCE_S)
    assert json.loads(out)["messages"] == {"contact": 1}


def test_the_time_of_a_recording_begins_when_its_buses_are_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A serial adapter takes seconds."""

    def slowly(*arguments: Any) -> Port:
        time.sleep(0.5)
        return open_port(*arguments)

    monkeypatch.setattr(capture, "open_port", slowly)
    group = "239.74.163.50"
    words = ["record", str(tmp_path / "a.log"), "--config", str(live(tmp_path, group)), "--json"]
    with talking(group):
        assert main([*words, "--seconds", "0.4"]) == 0
    assert json.loads(capsys.readouterr().out)["frames"] > 3


async def test_a_robot_that_is_off_is_not_untouched_in_a_recording(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    broker, robot = Broker(mosquitto.host, mosquitto.port), "skin/icub"
    info = encode_info(node_info(load_skin(CONFIG)[1], "main", version="1", configuration="x"))
    async with connect(broker, identifier="robot") as connection:
        for topic, payload in {
            "left_hand/contact": b"OFF",
            "left_hand/health": b'{"schema": "skin.health/1", "state": "ok"}',
            "nodes/main/status": b"offline",
            "nodes/main/info": info,
        }.items():
            await connection.publish(f"{robot}/{topic}", payload, qos=1, retain=True)
    with Recorder(tmp_path / "a.mcap") as recorder:
        stop = asyncio.Event()
        recording = asyncio.create_task(capture_broker(recorder, broker, "skin", "icub", stop))
        await until(lambda: len(recorder.messages) == 4)
        stop.set()
        await recording
    series = read_messages(tmp_path / "a.mcap")
    assert [(one.part, one.state) for one in series.contacts] == [("left_hand", "UNKNOWN")]
    assert series.health == []


def test_what_no_export_could_read_is_not_recorded(tmp_path: Path) -> None:
    """One such message would cost the whole recording; one that was deleted holds nothing."""
    health, info = "skin/demo/palm/health", "skin/demo/nodes/main/info"
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.say("skin/demo/palm/contact", 1, b"ON")
        for topic, payload in (
            (health, b"{}"),
            (health, b'{"schema": "skin.health/1", "sentences": 3}'),
            (info, b"{}"),
        ):
            recorder.say(topic, 1, payload)
        assert recorder.unreadable == 3
        for topic in (health, info):
            recorder.say(topic, 1, b"")
        assert recorder.unreadable == 3
    assert main(["export", str(tmp_path / "a.mcap"), str(tmp_path / "tables")]) == 0


async def test_messages_that_came_faster_than_they_were_recorded_are_counted(
    mosquitto: Mosquitto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capture, "MAX_INCOMING", 2)
    broker = Broker(mosquitto.host, mosquitto.port)
    parts = 200
    async with connect(broker, identifier="parts") as connection:
        for n in range(parts):
            await connection.publish(f"skin/icub/part{n}/contact", b"ON", qos=1, retain=True)
        with Recorder(tmp_path / "a.mcap") as recorder:
            stop = asyncio.Event()
            recording = asyncio.create_task(capture_broker(recorder, broker, "skin", "icub", stop))
            last = recorded_topics("skin", "icub")[-1]
            await until(lambda: mosquitto.subscriptions(last))
            # It follows all that was retained.
            health = b'{"schema": "skin.health/1"}'
            await connection.publish("skin/icub/last/health", health, qos=1)
            await until(lambda: "health" in recorder.messages)
            stop.set()
            await recording
    assert recorder.discarded > 0
    assert recorder.messages["contact"] + recorder.discarded == parts
    with (tmp_path / "a.mcap").open("rb") as file:
        (metadata,) = make_reader(file).iter_metadata()
    assert metadata.metadata["discarded"] == str(recorder.discarded)


async def test_a_recording_comes_back_soon_after_a_connection_that_was_good(
    mosquitto: Mosquitto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many were lost before it: what is published meanwhile is not recorded."""
    waits_s: list[float] = []

    class Noted(Retry):
        def delay_s(self, lasted_s: float = 0.0) -> float:
            # As if each connection had lasted for long.
            wait_s = super().delay_s(GOOD_S * (lasted_s > 0.0))
            waits_s.extend([wait_s] * (lasted_s > 0.0))
            return 0.0

    monkeypatch.setattr(capture, "Retry", Noted)
    broker = Broker(mosquitto.host, mosquitto.port)
    with Recorder(tmp_path / "a.mcap") as recorder:
        stop = asyncio.Event()
        recording = asyncio.create_task(capture_broker(recorder, broker, "skin", "icub", stop))
        last = recorded_topics("skin", "icub")[-1]
        for number in range(5):
            await until(lambda n=number: mosquitto.subscriptions(last) > n)  # type: ignore[misc]
            mosquitto.restart()
            await until(lambda n=number: len(waits_s) > n)  # type: ignore[misc]
        stop.set()
        await recording
    assert len(waits_s) == 5
    assert max(waits_s) <= FIRST_RETRY_S


async def test_a_gap_is_counted_once_however_many_attempts_it_takes(
    mosquitto: Mosquitto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts = 0

    class Noted(Retry):
        def delay_s(self, lasted_s: float = 0.0) -> float:
            nonlocal attempts
            attempts += 1
            return 0.001

    monkeypatch.setattr(capture, "Retry", Noted)
    broker = Broker(mosquitto.host, mosquitto.port)
    last = recorded_topics("skin", "icub")[-1]
    with Recorder(tmp_path / "a.mcap") as recorder:
        stop = asyncio.Event()
        recording = asyncio.create_task(capture_broker(recorder, broker, "skin", "icub", stop))
        for number in range(2):
            async with connect(broker, identifier="part") as connection:
                await until(lambda n=number: mosquitto.subscriptions(last) > n)  # type: ignore[misc]
                # It follows what shows that the recorder listens.
                await connection.publish("skin/icub/palm/contact", b"ON", qos=1)
                await until(lambda n=number: recorder.messages.get("contact", 0) > n)  # type: ignore[misc]
            before = attempts
            mosquitto.kill()
            await until(lambda n=before: attempts >= n + 5)  # type: ignore[misc]
            mosquitto.start()
        stop.set()
        assert await recording == recorder.gaps == 2


def test_an_export_of_a_recording_that_is_not_there_is_a_wrong_request(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.npz").touch()
    assert main(["export", str(tmp_path / "gone.mcap"), str(tmp_path / "a.npz")]) == 2
    assert "gone.mcap: cannot be read: No such file" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["replay", "a.log", "--config", "skin.toml", "--output", "a.log"],
        ["replay", "a.log", "--config", "skin.toml", "--output", "link.log"],
        ["replay", "a.log", "--config", "skin.toml", "--output", "skin.toml"],
        ["replay", "a.log", "--config", "skin.toml", "--calibration", "c", "--output", "c"],
        ["export", "a.log", "c.npz", "--config", "skin.toml", "--calibration", "c.npz"],
        ["plot", "calibration", "c.png", "c.png", "--config", "skin.toml"],
        ["dbc", "skin.toml", "--output", "skin.toml"],
        ["urdf", "skin.toml", "--output", "skin.toml"],
    ],
)
def test_what_a_command_reads_is_not_replaced_by_what_it_writes(
    arguments: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_config(Path("skin.toml"))
    write_log(Path("a.log"), 130, lambda _: ())
    Path("link.log").symlink_to("a.log")
    for name in ("c", "c.npz", "c.png"):
        Path(name).write_text("{}")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "is read by this command; choose another name" in line
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
