"""A recording played to a broker disturbs no robot there, and tells what was delivered."""

import asyncio
import dataclasses
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from skin_host.bus.logs import read_channels
from skin_host.cli import main
from skin_host.config.settings import Mqtt
from skin_host.mqtt.publisher import Publisher
from skin_host.recording.mcap import Recorder
from skin_host.recording.playback import LONGEST_PAUSE_S, MAX_NODES
from tests.support import programs
from tests.support.broker import Mosquitto, free_port
from tests.support.subscriber import Subscriber
from tests.support.waiting import PATIENCE_S
from tests.support.world import World

ROOT = Path(__file__).parents[2]


@dataclasses.dataclass
class Recorded:
    """A recording of the robot `demo` and its configuration, which names a broker that is gone."""

    log: Path
    config: Path

    def replay(self, url: str, *more: str) -> int:
        command = ["replay", str(self.log), "--config", str(self.config), "--onto", "broker"]
        return main([*command, "--speed", "20", "--broker", url, *more])


class Messages(Recorded):
    """A recording of messages, which needs no configuration."""

    def replay(self, url: str, *more: str) -> int:
        return main(["replay", str(self.log), "--onto", "broker", "--broker", url, *more])


def recorded_of(kind: str, frames: Recorded, folder: Path) -> Recorded:
    """The recording of frames, or one of a message."""
    if kind == "frames":
        return frames
    path = folder / "a.mcap"
    with Recorder(path) as recorder:
        recorder.say("skin/demo/left_hand/contact", 1, b"OFF")
    return Messages(path, path)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("recorded")
    world = World(folder, folder, Mosquitto("never started", folder))
    world.write_recordings()
    return Recorded(folder / "grasp.log", world.robot)


def url_of(broker: Mosquitto) -> str:
    return f"mqtt://{broker.host}:{broker.port}"


def with_table(recorded: Recorded, folder: Path, text: str) -> Recorded:
    """The same recording by a configuration with these lines in the table of the broker."""
    config = folder / "robot.toml"
    known = recorded.config.read_text()
    assert "[mqtt]\n" in known
    config.write_text(known.replace("[mqtt]\n", f"[mqtt]\n{text}\n"))
    return Recorded(recorded.log, config)


def robots(subscriber: Subscriber) -> set[str]:
    subscriber.catch_up()
    return {topic.split("/")[1] for topic, _ in subscriber._messages if topic.startswith("skin/")}


def play_beside(recorded: Recorded, broker: Mosquitto, *more: str) -> tuple[int, Any]:
    """Play while a node of `demo` is online; return the exit status and the node's counters."""

    async def living() -> tuple[int, Any]:
        settings = Mqtt(host=broker.host, port=broker.port)
        async with Publisher(settings, "demo", "main") as live:
            live.put_contact("left_hand", "ON")
            while not live.counters.retained_sent:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
            status = await asyncio.to_thread(recorded.replay, url_of(broker), *more)
            return status, live.counters

    return asyncio.run(living())


def test_frames_played_as_another_robot_leave_the_live_one_alone(
    written: Recorded, mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str]
) -> None:
    listening = Subscriber(mosquitto.host, mosquitto.port, "skin/#")
    status, live = play_beside(written, mosquitto, "--robot", "ghost")
    assert status == 0
    assert robots(listening) == {"demo", "ghost"}
    assert set(listening.payloads("demo/left_hand/contact")) == {b"ON"}
    assert not listening.payloads("demo/left_hand/frame")
    assert listening.payloads("ghost/left_hand/frame")
    (info, *_) = listening.documents("ghost/nodes/main/info")
    assert info["robot"] == "ghost"
    assert "left_hand" in info["parts"]
    assert live.connections == 1
    assert "delivered" in capsys.readouterr().out


def test_the_player_has_a_name_at_the_broker_that_no_daemon_has(
    written: Recorded, mosquitto: Mosquitto
) -> None:
    assert written.replay(url_of(mosquitto)) == 0
    assert "skin/demo/main" not in mosquitto.log
    assert "skin-playback-" in mosquitto.log


@pytest.mark.parametrize("kind", ["frames", "messages"])
def test_a_recording_is_not_played_as_a_robot_that_is_live(
    written: Recorded,
    mosquitto: Mosquitto,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    kind: str,
) -> None:
    listening = Subscriber(mosquitto.host, mosquitto.port, "skin/#")
    recorded = recorded_of(kind, written, tmp_path)
    status, live = play_beside(recorded, mosquitto)
    assert status == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert '"demo"' in told
    assert "--robot" in told
    listening.catch_up()
    assert set(listening.payloads("left_hand/contact")) == {b"ON"}
    assert live.connections == 1


def test_the_url_outranks_the_brokers_of_the_configuration(
    written: Recorded, mosquitto: Mosquitto, tmp_path: Path
) -> None:
    recorded = with_table(written, tmp_path, f'brokers = ["127.0.0.1:{free_port()}"]')
    listening = Subscriber(mosquitto.host, mosquitto.port, "skin/#")
    assert recorded.replay(url_of(mosquitto)) == 0
    assert robots(listening) == {"demo"}


def with_part(recorded: Recorded, folder: Path, part: str, line: str) -> Recorded:
    """The same recording by a configuration with this line in the table of a part."""
    config = folder / "part.toml"
    known = recorded.config.read_text()
    assert f"[parts.{part}]\n" in known
    config.write_text(known.replace(f"[parts.{part}]\n", f"[parts.{part}]\n{line}\n"))
    return Recorded(recorded.log, config)


def numbers(subscriber: Subscriber, part: str) -> list[int]:
    subscriber.catch_up()
    return [frame["seq"] for frame in subscriber.documents(f"demo/{part}/frame")]


def test_all_frames_are_delivered_however_many_are_processed_at_once(
    written: Recorded, mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """A daemon's newer frame takes the place of one that waits; a playback can wait."""
    path = tmp_path / "long.mcap"
    with Recorder(path) as recorder:
        for channel, batch in read_channels(written.log, window_ns=10**9):
            recorder.can(channel, batch)
    listening = Subscriber(mosquitto.host, mosquitto.port, "skin/#")
    assert Recorded(path, written.config).replay(url_of(mosquitto)) == 0
    for part in ("left_hand", "left_forearm"):
        seen = numbers(listening, part)
        assert len(seen) > 80
        assert seen == list(range(seen[0], seen[0] + len(seen)))


def test_frames_that_the_broker_does_not_take_are_counted_and_named(
    written: Recorded, mosquitto: Mosquitto, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "small"
    place.mkdir()
    with Mosquitto(mosquitto.program, place, "max_packet_size 700\n") as broker:
        listening = Subscriber(broker.host, broker.port, "skin/#")
        status = written.replay(url_of(broker))
        hand, arm = (numbers(listening, part) for part in ("left_hand", "left_forearm"))
    assert len(hand) > len(arm) == 0
    assert status == 1
    seen = capsys.readouterr()
    assert seen.out == ""
    assert "it does not take skin/demo/" in seen.err
    assert "skin/demo/left_forearm/frame" in seen.err
    assert f"sent were {len(hand)} of {2 * len(hand)} frames" in seen.err


def test_a_part_without_frames_in_the_configuration_is_played_without_them(
    written: Recorded, mosquitto: Mosquitto, tmp_path: Path
) -> None:
    listening = Subscriber(mosquitto.host, mosquitto.port, "skin/#")
    recorded = with_part(written, tmp_path, "left_hand", "frames = false")
    assert recorded.replay(url_of(mosquitto)) == 0
    assert numbers(listening, "left_forearm")
    assert numbers(listening, "left_hand") == []
    assert listening.payloads("demo/left_hand/touch")


def guarded(mosquitto: Mosquitto, folder: Path) -> Mosquitto:
    """A broker that wants the name anna and her password."""
    passwords = folder / "passwords"
    tool = programs.find("mosquitto_passwd")
    if tool is None:
        pytest.skip("mosquitto_passwd is not installed")
    subprocess.run([tool, "-b", "-c", passwords, "anna", "sesame"], check=True)
    passwords.chmod(0o644)
    place = folder / "guarded"
    place.mkdir()
    broker = Mosquitto(mosquitto.program, place, f"user root\npassword_file {passwords}\n")
    configuration = place / "mosquitto.conf"
    text = configuration.read_text().replace("allow_anonymous true", "allow_anonymous false")
    configuration.write_text(text)
    return broker


@pytest.mark.parametrize("where", ["url", "environment", "file"])
def test_user_and_password_are_taken_from_the_url_or_the_environment(
    written: Recorded,
    mosquitto: Mosquitto,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    where: str,
) -> None:
    broker = guarded(mosquitto, tmp_path)
    broker.start()
    password = ":sesame" if where == "url" else ""
    if where == "environment":
        monkeypatch.setenv("SKIN_MQTT_PASSWORD", "sesame")
    if where == "file":
        (tmp_path / "secret").write_text("sesame\n")
        monkeypatch.setenv("SKIN_MQTT_PASSWORD_FILE", str(tmp_path / "secret"))
    try:
        url = f"mqtt://anna{password}@{broker.host}:{broker.port}?protocol=3.1.1"
        assert written.replay(url) == 0
    finally:
        broker.kill()
    lines = [line for line in broker.log.splitlines() if "as skin-playback-" in line]
    assert lines
    assert all("p2" in line and "u'anna'" in line for line in lines)  # so it writes MQTT 3.1.1


@pytest.mark.parametrize("kind", ["frames", "messages"])
def test_a_playback_without_a_broker_fails_in_one_line(
    written: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    recorded = recorded_of(kind, written, tmp_path)
    assert recorded.replay(f"mqtt://127.0.0.1:{free_port()}") == 1
    seen = capsys.readouterr()
    assert seen.out == ""
    assert seen.err.count("\n") == 1
    assert "no broker listens there" in seen.err


@pytest.mark.parametrize("kind", ["frames", "messages"])
def test_a_playback_that_the_broker_refuses_fails_and_counts(
    written: Recorded,
    mosquitto: Mosquitto,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    kind: str,
) -> None:
    rules = tmp_path / "rules"
    rules.write_text("topic read #\ntopic write skin/demo/left_hand/frame\n")
    rules.chmod(0o644)
    place = tmp_path / "strict"
    place.mkdir()
    broker = Mosquitto(mosquitto.program, place, f"user root\nacl_file {rules}\n")
    broker.start()
    recorded = recorded_of(kind, written, tmp_path)
    try:
        assert recorded.replay(url_of(broker)) == 1
    finally:
        broker.kill()
    seen = capsys.readouterr()
    assert seen.out == ""
    assert "ot authori" in seen.err
    assert ("messages refused" if kind == "frames" else "refuses 1 of 1 messages") in seen.err


def test_every_touch_of_a_recording_that_ends_while_touched_is_ended(
    written: Recorded, mosquitto: Mosquitto, tmp_path: Path
) -> None:
    lines = written.log.read_text().splitlines(keepends=True)
    for share in (0.5, 0.6, 0.7, 0.8, 0.9):
        cut = tmp_path / "cut.log"
        cut.write_text("".join(lines[: int(len(lines) * share)]))
        recorded = Recorded(cut, written.config)
        output = tmp_path / "cut.jsonl"
        command = ["replay", str(cut), "--config", str(written.config), "--output", str(output)]
        assert main(command) == 0
        touches = [json.loads(line) for line in output.read_text().splitlines()]
        known = [one["event"] for one in touches if one["type"] == "touch"]
        if known.count("begin") > known.count("end"):
            break
        output.unlink()
    else:
        raise AssertionError("no share of the recording ends while something touches")
    listening = Subscriber(mosquitto.host, mosquitto.port, "skin/#")
    assert recorded.replay(url_of(mosquitto)) == 0
    listening.catch_up()
    events = [one["event"] for one in listening.documents("/touch")]
    assert events.count("begin") == events.count("end") > 0
    assert listening.payloads("left_hand/contact")[-1] == b"UNKNOWN"


def test_a_playback_that_is_killed_leaves_no_node_online(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """Its contacts stay at the broker, and it is the status that shows that nobody is behind."""
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for node in ("main", "arm"):
            recorder.say(f"skin/demo/nodes/{node}/status", 1, b"online")
        recorder.say("skin/demo/left_hand/contact", 2, b"ON")
        recorder.say("skin/demo/left_hand/contact", int(0.9 * LONGEST_PAUSE_S * 1e9), b"OFF")
    listening = Subscriber(mosquitto.host, mosquitto.port, "skin/#")
    program = [sys.executable, "-m", "skin_host", "replay", str(path)]
    with subprocess.Popen([*program, "--onto", "broker", "--broker", url_of(mosquitto)]) as playing:
        await_payloads(listening, "demo/left_hand/contact", [b"ON"])
        playing.kill()
    for node in ("main", "arm"):
        await_payloads(listening, f"demo/nodes/{node}/status", [b"online", b"offline"])


def await_payloads(subscriber: Subscriber, end: str, wanted: list[bytes]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while (seen := subscriber.payloads(end)) != wanted:
        assert time.monotonic() < deadline_s, seen
        time.sleep(0.02)


def test_a_recording_of_more_nodes_than_a_robot_has_is_refused(
    mosquitto: Mosquitto, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each one that is played has a connection of its own."""
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for number in range(MAX_NODES + 1):
            recorder.say(f"skin/demo/nodes/node{number}/status", 1, b"online")
    listening = Subscriber(mosquitto.host, mosquitto.port, "skin/#")
    assert main(["replay", str(path), "--onto", "broker", "--broker", url_of(mosquitto)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{path}: holds the status of more than {MAX_NODES} nodes" in line
    listening.catch_up()
    assert listening.payloads(f"node{MAX_NODES - 1}/status")[-1] == b"offline"
    assert listening.payloads(f"node{MAX_NODES}/status") == []
