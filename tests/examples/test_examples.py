"""The examples do what they say, against a real broker."""

import asyncio
import math
import runpy
import signal
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import AbstractContextManager, asynccontextmanager, nullcontext
from dataclasses import replace
from functools import partial
from itertools import count, repeat
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import msgspec
import numpy as np
import pytest

from skin_host import client
from skin_host.client import session
from skin_host.config.settings import Mqtt, load
from skin_host.layout import build_layout
from skin_host.mqtt.info import node_info
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.events import Load
from skin_host.processing.frame import PressureFrame
from skin_host.tasks import cancel
from tests.support import ros
from tests.support.broker import Mosquitto
from tests.support.said import touch_event
from tests.support.waiting import PATIENCE_S, until

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
CONFIG = ROOT / "config" / "demo.toml"
BEGIN = touch_event(
    "begin", 7, 3, 10**18 + 5, "left_hand", [0, 1], [0.1, 0, 0], [0, 0, 1.0], 40.0, 31, 20.0, 2.0
)


@asynccontextmanager
async def node(broker: Mosquitto) -> AsyncIterator[Publisher]:
    """The demo's node, that does nothing by itself."""
    layout = build_layout(load(CONFIG), CONFIG.parent)
    async with Publisher(Mqtt(host=broker.host, port=broker.port), "demo", "main") as publisher:
        publisher.put_info(node_info(layout, "main", version="1", configuration="x"))
        yield publisher


@asynccontextmanager
async def living(publisher: Publisher, part: str) -> AsyncIterator[None]:
    """Its health comes again and again: what the broker has stored shows nothing of now."""

    async def live() -> None:
        for number in count():
            publisher.put_health(part, {"age_ms": float(number)})
            await asyncio.sleep(0.1)

    task = asyncio.create_task(live())
    try:
        yield
    finally:
        await cancel(task)


async def test_a_client_prints_a_touch(mosquitto: Mosquitto) -> None:
    where = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with node(mosquitto) as publisher:
        program = await asyncio.create_subprocess_exec(
            *(sys.executable, "-u", EXAMPLES / "client.py", where), cwd=ROOT, stdout=subprocess.PIPE
        )
        assert program.stdout is not None
        # A touch is not retained: it is published again until the program has subscribed.
        reading = asyncio.create_task(program.stdout.readline())
        async with asyncio.timeout(PATIENCE_S):
            while not reading.done():
                publisher.put_touch(BEGIN)
                await asyncio.wait([reading], timeout=0.1)
        program.terminate()
        await program.wait()
    assert (await reading).decode().strip() == "left_hand (0.1, 0.0, 0.0) 2.00 N"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["client.py", "http://x"], "the URL of the broker"),
        (["ros2_node.py"], "No module named 'rclpy': wanted ROS 2"),
        (["stop_on_touch.py"], "which part?"),
        (["stop_on_touch.py", "left_hand", "mqtt://localhost", "demo"], "which part?"),
        (["stop_on_touch.py", "mqtt://localhost:1"], "which part?"),
        (["stop_on_touch.py", "left_hand", "http://x"], "the URL of the broker"),
    ],
)
def test_an_example_without_what_it_needs_ends_with_one_line(words: list[str], said: str) -> None:
    example, *rest = words
    ended = subprocess.run(
        [sys.executable, EXAMPLES / example, *rest], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 1
    (line,) = ended.stderr.splitlines()
    assert said in line


@pytest.fixture
def handlers() -> Iterator[None]:
    """An example that runs in this process handles its signals, as one that a shell has started:
    none is blocked or ignored.
    """
    numbers = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    before = {number: signal.getsignal(number) for number in numbers}
    blocked = signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
    signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("words", [["stop_on_touch.py", "left_hand"], ["gripper.py"]])
def test_an_example_that_is_ended_ends_without_a_traceback(
    words: list[str],
    number: signal.Signals,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """And stops its motors, and what it has started."""

    class Ended:
        def __init__(self, *_: object, **__: object) -> None:
            assert signal.getsignal(number) != signal.SIG_DFL
            signal.raise_signal(number)

    emulator = MagicMock()
    monkeypatch.setattr(client, "SkinCallbacks", Ended)
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: emulator)
    monkeypatch.setattr(sys, "argv", words)
    ended: AbstractContextManager[object] = pytest.raises(SystemExit)
    if number == signal.SIGINT:
        ended = nullcontext()
    with ended:
        runpy.run_path(str(EXAMPLES / words[0]), run_name="__main__")
    if words[0] == "gripper.py":
        assert emulator.terminate.called
        assert emulator.wait.called
    else:
        assert capsys.readouterr().out.splitlines()[-1] == "stop the program ends"


async def said_to_ros(
    broker: Mosquitto, monkeypatch: pytest.MonkeyPatch, messages: Iterator[Any]
) -> ros.Node:
    """Run the ROS 2 example until it has passed on two of these frames or touches."""
    ros.install(monkeypatch, enough=2)
    monkeypatch.setattr(sys, "argv", ["ros2_node.py", f"mqtt://{broker.host}:{broker.port}"])
    async with node(broker) as publisher:
        running = asyncio.create_task(
            asyncio.to_thread(runpy.run_path, str(EXAMPLES / "ros2_node.py"))
        )
        while not running.done():
            message = next(messages)
            put = publisher.put_touch if message is BEGIN else publisher.put_frame
            put(message)
            await asyncio.wait([running], timeout=0.2)
        await running
    (skin,) = ros.nodes
    return skin


async def test_what_is_not_valid_is_no_number_in_ros(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    n = build_layout(load(CONFIG), CONFIG.parent).part("left_hand").n_taxels
    zeros, valid = np.zeros(n, np.bool_), np.arange(n) == 0
    kpa = np.where(valid, np.float32(1.5), np.float32(0.0))
    frame = PressureFrame("left_hand", 1, 2, np.zeros(n, np.uint8), kpa, zeros, valid, zeros)
    skin = await said_to_ros(mosquitto, monkeypatch, (replace(frame, seq=seq) for seq in count()))
    assert skin.made == ["left_hand/pressure"]
    for topic, message in skin.published[:2]:
        assert topic == "left_hand/pressure"
        assert message.data[0] == 1.5
        assert all(map(math.isnan, message.data[1:]))
        assert len(message.data) == n


async def test_a_contact_pushes_against_the_normal_and_turns_the_part_about_its_origin(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    skin = await said_to_ros(mosquitto, monkeypatch, repeat(BEGIN))
    topic, said = skin.published[0]
    assert (topic, said.header.frame_id) == ("left_hand/wrench", "left_hand")
    assert (said.header.stamp.sec, said.header.stamp.nanosec) == (10**9, 5)
    assert vars(said.wrench.force) == {"x": 0, "y": 0, "z": -2.0}
    # 2 N down at x = 0.1 m: the x side goes down, which is a positive turn about y.
    assert vars(said.wrench.torque) == {"x": 0, "y": pytest.approx(0.2), "z": 0}


def ros_example(monkeypatch: pytest.MonkeyPatch) -> tuple[ros.Node, Any, MagicMock]:
    """Run the ROS 2 example without a robot: its node, its names, its client."""
    ros.install(monkeypatch, enough=0)
    skin = MagicMock()
    skin.return_value.__enter__.return_value.present.return_value = []
    monkeypatch.setattr(client, "SkinCallbacks", skin)
    monkeypatch.setattr(sys, "argv", ["ros2_node.py"])
    names = runpy.run_path(str(EXAMPLES / "ros2_node.py"))
    (node_made,) = ros.nodes
    return node_made, SimpleNamespace(**names), skin.return_value.__enter__.return_value


def test_the_wrench_in_ros_is_of_all_contacts_that_last(monkeypatch: pytest.MonkeyPatch) -> None:
    skin, example, known = ros_example(monkeypatch)

    def pressed(number: int, force_n: float, **changes: Any) -> client.Touch:
        return msgspec.structs.replace(BEGIN, id=number, force_n=force_n, **changes)

    def shown() -> tuple[float, float]:
        wrench = skin.published[-1][1].wrench
        return wrench.force.z, wrench.torque.y

    known.present.return_value = [pressed(1, 5.0), pressed(2, 3.0)]
    example.on_touch(BEGIN)
    assert shown() == pytest.approx((-8.0, 0.8))
    known.present.return_value = [pressed(1, 5.0)]
    example.on_touch(pressed(2, 0.0, event="end"))
    assert shown() == pytest.approx((-5.0, 0.5))
    known.present.return_value = []
    example.on_contact(client.Contact("left_hand", "OFF"))
    assert shown() == (0.0, 0.0)
    example.on_contact(client.Contact("left_hand", "UNKNOWN", "offline"))
    assert all(map(math.isnan, shown()))  # the node died: 0 N would be known
    known.present.return_value = [pressed(3, 5.0, centroid_m=None)]
    example.on_touch(BEGIN)
    assert all(map(math.isnan, shown()))
    load = Load("saturated", (0.0, 0.0, -41.0), (0.0, 0.25, 0.0), None, [])
    known.present.return_value = [pressed(3, 41.0, centroid_m=None, load=load)]
    example.on_touch(BEGIN)
    assert shown() == (-41.0, 0.25)


def test_the_example_for_ros_without_a_broker_ends_with_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ros.install(monkeypatch, enough=0)
    monkeypatch.setattr(sys, "argv", ["ros2_node.py", "http://x"])
    with pytest.raises(SystemExit, match="the URL of the broker"):
        runpy.run_path(str(EXAMPLES / "ros2_node.py"))


@pytest.mark.parametrize("end", [KeyboardInterrupt, ros.ExternalShutdownException])
def test_the_example_for_ros_ends_quietly_with_ctrl_c_and_when_ros_shuts_down(
    monkeypatch: pytest.MonkeyPatch, end: type[BaseException]
) -> None:
    ros.install(monkeypatch, enough=0)
    monkeypatch.setattr(sys.modules["rclpy"], "spin", MagicMock(side_effect=end))
    skin = MagicMock()
    skin.return_value.__exit__.return_value = None
    monkeypatch.setattr(client, "SkinCallbacks", skin)
    monkeypatch.setattr(sys, "argv", ["ros2_node.py"])
    runpy.run_path(str(EXAMPLES / "ros2_node.py"))
    skin.return_value.__exit__.assert_called_once()


@pytest.mark.parametrize("part", ["left-hand", "2nd", "arm"])
def test_the_example_and_the_node_for_ros_name_parts_alike(
    monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    skin, example, _ = ros_example(monkeypatch)
    names = runpy.run_path(str(ROOT / "ros2/skin_host_ros/skin_host_ros/names.py"))
    example.on_contact(client.Contact(part, "OFF"))
    assert skin.made == [f"{names['ros_name'](part)}/wrench"]


async def test_a_wrong_part_stops_the_motor_and_is_named(
    mosquitto: Mosquitto,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(session, "NAMED_S", 0.0)
    url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    monkeypatch.setattr(sys, "argv", ["stop_on_touch.py", "left_hnd", url])
    monkeypatch.setattr(signal, "signal", MagicMock())  # this is not the main thread
    ended = threading.Event()
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(read=partial(ended.wait, PATIENCE_S)))
    missing = 'robot "demo" has no part "left_hnd"; there are: left_forearm, left_hand'

    def run() -> None:
        with pytest.raises(SystemExit, match=missing):
            runpy.run_path(str(EXAMPLES / "stop_on_touch.py"))

    async with node(mosquitto):
        program = asyncio.create_task(asyncio.to_thread(run))
        await until(lambda: missing in caplog.text)
        ended.set()
        await program
    assert capsys.readouterr().out.splitlines() == [
        "stop until something is known",
        "stop the program ends",
    ]


async def test_the_motor_stops_for_what_is_touched_and_for_what_is_not_known(
    mosquitto: Mosquitto,
) -> None:
    program = await asyncio.create_subprocess_exec(
        *(sys.executable, "-u", EXAMPLES / "stop_on_touch.py", "left_hand"),
        *(f"mqtt://{mosquitto.host}:{mosquitto.port}",),
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert program.stdout is not None and program.stdin is not None
    said = []
    async with asyncio.timeout(PATIENCE_S):
        async with node(mosquitto) as publisher, living(publisher, "left_hand"):
            for state in ("OFF", "ON", "OFF", "UNKNOWN", "OFF"):
                publisher.put_contact("left_hand", state)
                if not said:
                    said.append(await program.stdout.readline())
                said.append(await program.stdout.readline())
        said.append(await program.stdout.readline())
        program.stdin.close()
        await program.wait()
    assert [line.decode().strip() for line in said] == [
        "stop until something is known",
        "move",
        "stop touched",
        "move",
        "stop not_felt",
        "move",
        "stop offline",
    ]
