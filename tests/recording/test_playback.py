"""What was recorded is played again: on CAN, to a broker, through the pipeline."""

import asyncio
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from mcap.writer import Writer

from emulator.probes.scene import Scene
from emulator.robot import Robot
from skin_host.bus.logs import read_channels
from skin_host.bus.wire import FrameBatch
from skin_host.client import SkinClient
from skin_host.config.settings import Bus, Mqtt, Settings, changed, load
from skin_host.errors import LogError, RequestError
from skin_host.layout import Layout, build_layout
from skin_host.mqtt.address import Broker
from skin_host.mqtt.info import encode_info, node_info
from skin_host.processing.core import Engine
from skin_host.recording.capture import CanLog, capture_broker, capture_buses
from skin_host.recording.mcap import Recorder, read_can, read_messages_of, recorded_topics
from skin_host.recording.playback import paced, play_messages, play_on_buses, play_processed
from skin_host.recording.replay import calibrate_from_log, steps
from tests.support.broker import Mosquitto
from tests.support.ports import StillPort
from tests.support.waiting import PATIENCE_S, until

ROOT = Path(__file__).parents[2]
CONFIG = ROOT / "config" / "icub_hand.toml"
GRASP = ROOT.parent / "shared" / "data" / "icub_grasp.log"
needs_grasp = pytest.mark.skipif(not GRASP.exists(), reason=f"{GRASP} is not here")


def hand() -> tuple[Settings, Layout]:
    settings = load(CONFIG)
    return settings, build_layout(settings, CONFIG.parent)


def frames_of(log: Path) -> list[tuple[int, bytes, int]]:
    return [
        (int(batch.id[i]), batch.data[i, : batch.dlc[i]].tobytes(), int(batch.t_ns[i]))
        for _, batch in (read_can(log) if log.suffix == ".mcap" else read_channels(log))
        for i in range(len(batch))
    ]


def beginning(folder: Path, n_lines: int = 2600) -> Path:
    """The first seconds of the recorded grasps."""
    path = folder / "grasp.log"
    path.write_text("".join(GRASP.read_text().splitlines(keepends=True)[:n_lines]))
    return path


def steps_of(log: Path) -> list[Any]:
    settings, layout = hand()
    engine = Engine(settings, layout, [0], calibrate_from_log(log, settings, layout, 5.0))
    return [
        (step.frame.t_ns, step.frame.raw.tobytes(), step.frame.pressure_kpa.tobytes(), step.events)
        for step in steps(log, engine)
    ]


@needs_grasp
@pytest.mark.parametrize("name", ["a.mcap", "a.log", "a.blf", "a.asc"])
def test_can_frames_of_every_format_replay_to_the_same(tmp_path: Path, name: str) -> None:
    grasp = beginning(tmp_path)
    path = tmp_path / name
    if path.suffix == ".mcap":
        with Recorder(path) as recorder:
            for channel, batch in read_channels(grasp):
                recorder.can(channel, batch)
    else:
        with CanLog(path) as log:
            for channel, batch in read_channels(grasp):
                log.put(channel, batch)
        assert log.frames == 2600
    assert [frame[:2] for frame in frames_of(path)] == [frame[:2] for frame in frames_of(grasp)]
    if path.suffix in (".mcap", ".log"):  # the others keep times less exactly
        assert steps_of(path) == steps_of(grasp)
    else:
        assert [step[1] for step in steps_of(path)] == [step[1] for step in steps_of(grasp)]


def test_a_format_that_nobody_knows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"wanted one of \.log, \.asc"):
        CanLog(tmp_path / "a.xyz")


@needs_grasp
async def test_a_recording_played_on_a_bus_is_captured_as_it_was(tmp_path: Path) -> None:
    grasp = beginning(tmp_path, 400)
    settings, _ = hand()
    bus = Bus(interface="virtual", channel=f"play-{tmp_path.name}")
    settings = changed(settings, {"buses.can0": bus})
    path = tmp_path / "again.mcap"
    stop = asyncio.Event()
    with (
        Recorder(path) as recorder,
        can.Bus(interface=bus.interface, channel=bus.channel) as sender,
    ):
        capturing = asyncio.create_task(capture_buses(settings, recorder.can, stop))
        await asyncio.sleep(0.05)
        assert await play_on_buses(grasp, settings, {"can0": sender}, speed=100) == 400
        await asyncio.sleep(0.1)  # several times what lies between two looks at the bus
        stop.set()
        assert await capturing == 0
    assert [frame[:2] for frame in frames_of(path)] == [frame[:2] for frame in frames_of(grasp)]


@pytest.mark.timeout(60)
async def test_a_clock_that_was_set_while_recording_is_not_waited_for() -> None:
    """A computer without a clock begins in 1970; or somebody wrote such a file."""
    set_ns = [0, 10, 1_700_000_000 * 10**9, 1_700_000_000 * 10**9 + 10, 20, 30, 2**62]
    assert [item async for item in paced(set_ns, lambda item: item, speed=1.0)] == set_ns


async def test_a_bus_on_which_more_comes_than_is_read_does_not_hold_up_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings, stop = load(ROOT / "config" / "demo.toml"), asyncio.Event()

    class Flooded(StillPort):
        def read(self) -> FrameBatch:
            return FrameBatch.of([(0x4E0, bytes(8), 1)] * self.capacity)

    monkeypatch.setattr("skin_host.recording.capture.open_port", Flooded)
    asyncio.get_running_loop().call_later(0.05, stop.set)
    n = 0

    def sink(_: str, batch: FrameBatch) -> None:
        nonlocal n
        n += len(batch)
        assert n < 10_000_000

    assert await capture_buses(settings, sink, stop) == 0
    assert n


async def test_buses_that_are_read_in_turn_are_recorded_as_their_frames_came(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A turn is longer than the period of fast boards, and much longer when the computer was busy:
    sweeps of one bus, and then those of the other, make no whole samples of a part on both.
    """
    hour = 3_600_000
    times_ms = {
        "left": [*range(0, 100, 5), *range(100 - hour, 200 - hour, 5)],
        "right": [*range(2, 102, 5), *range(102 - hour, 202 - hour, 5)],
    }
    settings, stop = load(ROOT / "config" / "demo.toml"), asyncio.Event()
    buses = {name: Bus(interface="virtual", channel=name) for name in times_ms}

    class Filled(StillPort):
        def __init__(self, name: str, *others: Any) -> None:
            super().__init__(name, *others)
            start_ns = 1_700_000_000 * 10**9
            frames = [
                (number, b"", start_ns + ms * 1_000_000)
                for number, ms in enumerate(times_ms.get(name, ()))
            ]
            self.waiting = [FrameBatch.of(frames)]
            self.waiting[0].dropped = 3

    monkeypatch.setattr("skin_host.recording.capture.open_port", Filled)
    found: list[tuple[str, int]] = []
    dropped = Counter[str]()

    def sink(channel: str, batch: FrameBatch) -> None:
        found.extend((channel, number) for number in batch.id.tolist())
        dropped[channel] += batch.dropped
        if len(found) == 80:
            stop.set()

    await capture_buses(changed(settings, {"buses": buses}), sink, stop)
    assert dropped == {"left": 3, "right": 3}
    for channel in times_ms:
        assert [number for name, number in found if name == channel] == list(range(40))
    assert all(abs(number - place // 2) <= 1 for place, (_, number) in enumerate(found))


def test_errors_of_the_wire_are_recorded_as_such(tmp_path: Path) -> None:
    """Anybody can send one over multicast: as a data frame it was a board's."""
    error = FrameBatch.of([(0x20000000 | 0x4E0, bytes(8), 1_700_000_000 * 10**9)])
    for name in ("a.log", "a.asc", "a.blf", "a.csv"):
        with CanLog(tmp_path / name) as log:
            log.put("can0", error)
            log.put("can0", FrameBatch.of([(0x4E1, bytes(8), 1_700_000_001 * 10**9)]))
        found = [int(one) for _, batch in read_channels(tmp_path / name) for one in batch.id]
        assert 0x4E0 not in found
        assert found[-1] == 0x4E1


@pytest.mark.parametrize(
    "topic",
    [
        "status",
        "/contact",
        "skin/demo/+/contact",
        "skin/demo/nodes/main/cmd/status",
        "skin/demo/palm\0/contact",
        "$SYS/demo/palm/contact",
        "skin//palm/contact",
        "skin/demo/" + "x" * 100_000 + "/contact",
    ],
)
def test_topics_of_a_recording_that_nobody_could_have_recorded_are_not_played(
    tmp_path: Path, topic: str
) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("skin.text", "jsonschema", b"{}")
        for name in (topic, "skin/demo/palm/contact"):
            channel = writer.register_channel(name, "json", schema)
            writer.add_message(channel, 1, b'{"text":"ON"}', 1)
        writer.finish()
    assert [one.topic for one in read_messages_of(path)] == ["skin/demo/palm/contact"]


async def test_pace_follows_the_recording_and_the_speed() -> None:
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    items = paced([0, 100, 200], lambda item: item * 1_000_000, speed=4)
    waited_s = [loop.time() - begun_s async for _ in items]
    assert waited_s[1] >= 0.024
    assert waited_s[2] >= 0.049


@asynccontextmanager
async def recording(broker: Mosquitto, path: Path) -> AsyncIterator[Recorder]:
    stop = asyncio.Event()
    with Recorder(path) as recorder:
        address, _ = Broker.from_url(f"mqtt://{broker.host}:{broker.port}", "5")
        last = recorded_topics("skin", "icub")[-1]
        before = broker.subscriptions(last)
        capturing = asyncio.create_task(capture_broker(recorder, address, "skin", "icub", stop))
        await until(lambda: broker.subscriptions(last) > before)
        yield recorder
        stop.set()
        await capturing


@needs_grasp
async def test_what_a_broker_said_is_recorded_and_said_again_byte_for_byte(
    tmp_path: Path, mosquitto: Mosquitto
) -> None:
    settings, layout = hand()
    settings = changed(settings, {"mqtt": Mqtt(host=mosquitto.host, port=mosquitto.port)})
    grasp = beginning(tmp_path)
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    calibration = calibrate_from_log(grasp, settings, layout, 5.0)
    async with recording(mosquitto, first) as recorder:
        engine = Engine(settings, layout, [0], calibration)
        there = Broker(mosquitto.host, mosquitto.port)
        played = await play_processed(grasp, engine, settings, there, speed=20)
        assert played.frames >= played.frames_sent > 100
        # The last thing said is that the node goes.
        await until(lambda: recorder.messages.get("status") == 2)
    assert recorder.messages["touch"] == played.events_sent > 0
    assert recorder.messages["frame"] > 50
    async with recording(mosquitto, second) as again:
        broker, _ = Broker.from_url(f"mqtt://{mosquitto.host}:{mosquitto.port}", "5")
        assert await play_messages(first, broker, speed=5) == sum(recorder.messages.values())
        # Those recorded, the one that the broker had kept, and a last one at the end of the play.
        await until(lambda: again.messages.get("status") == recorder.messages["status"] + 2)

    def said(path: Path, kind: str) -> list[bytes]:
        return [one.payload for one in read_messages_of(path) if one.topic.endswith(f"/{kind}")]

    assert said(second, "frame") == said(first, "frame")
    assert said(second, "touch") == said(first, "touch")
    # What is over does not look alive.
    assert said(second, "status")[-1] == b"offline"


@needs_grasp
async def test_a_recording_can_be_played_as_another_robot(
    tmp_path: Path, mosquitto: Mosquitto
) -> None:
    _, layout = hand()
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        info = node_info(layout, "main", version="1", configuration="x")
        recorder.say("skin/icub/nodes/main/status", 0, b"online")
        recorder.say("skin/icub/nodes/main/info", 0, encode_info(info))
        recorder.say("skin/icub/left_hand/contact", 1, b"ON")
    url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    broker, _ = Broker.from_url(url, "5")
    async with SkinClient(url, robot="ghost") as skin:
        contacts = skin.contacts()
        await asyncio.sleep(0.2)
        await play_messages(path, broker, robot="ghost")
        async with asyncio.timeout(PATIENCE_S):
            contact = await anext(contacts)
            assert (contact.part, contact.state) == ("left_hand", "ON")
            assert (await skin.info())["main"].parts.keys() == {"left_hand"}


async def test_an_emulated_robot_can_be_recorded(tmp_path: Path) -> None:
    settings = load(ROOT / "config" / "demo.toml")
    settings = changed(settings, {"buses.can0.channel": tmp_path.name})
    layout = build_layout(settings, CONFIG.parent)
    bus = settings.buses["can0"]
    path = tmp_path / "robot.blf"
    stop = asyncio.Event()
    robot = Robot(settings, layout, Scene(quiet=True))
    robot.bring_up()
    with CanLog(path) as log, can.Bus(interface=bus.interface, channel=bus.channel) as opened:
        capturing = asyncio.create_task(capture_buses(settings, log.put, stop))
        living = asyncio.create_task(robot.run({"can0": opened}))
        async with asyncio.timeout(PATIENCE_S):
            while log.frames < 500:  # noqa: ASYNC110
                await asyncio.sleep(0.05)
        stop.set()
        await capturing
        living.cancel()
        await asyncio.gather(living, return_exceptions=True)
    ids = {frame[0] >> 8 for frame in frames_of(path)}
    assert ids == {4}
    assert np.unique([frame[0] for frame in frames_of(path)]).size == 33


async def test_two_robots_are_not_played_as_one(tmp_path: Path, mosquitto: Mosquitto) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for n, robot in enumerate(("icub", "kaspar")):
            recorder.say(f"skin/{robot}/palm/contact", n, b"ON")
    broker = Broker(mosquitto.host, mosquitto.port)
    with pytest.raises(LogError, match=r"holds messages of skin/icub and of skin/kaspar"):
        await play_messages(path, broker, robot="ghost")
    assert await play_messages(path, broker) == 2
