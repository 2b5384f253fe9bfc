"""The examples do what they say, against a real broker."""

import asyncio
import math
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib import util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skin_host.client import Frame, Touch
from skin_host.layout import build_layout
from skin_host.processing.contacts import TouchEvent
from skin_host.processing.pipeline import PressureFrame
from skin_host.publish.info import node_info
from skin_host.publish.mqtt import Publisher
from skin_host.settings import Mqtt, load
from tests.support import ros
from tests.support.broker import Mosquitto

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
CONFIG = ROOT / "config" / "demo.toml"
PATIENCE_S = 30.0
BEGIN = TouchEvent(
    "begin", 7, 3, 10**18 + 5, "left_hand", [0, 1], [0.1, 0, 0], [0, 0, 1.0], 40.0, 31, 20.0, 2.0
)


@asynccontextmanager
async def node(broker: Mosquitto) -> AsyncIterator[Publisher]:
    """The demo's node, that does nothing by itself."""
    layout = build_layout(load(CONFIG), CONFIG.parent)
    async with Publisher(Mqtt(host=broker.host, port=broker.port), "demo", "main") as publisher:
        publisher.put_info(node_info(layout, "main", version="1", configuration="x"))
        yield publisher


@pytest.mark.parametrize(
    ("example", "line"),
    [
        ("subscriber.py", "left_hand begin 7 2.00 N"),
        ("client.py", "left_hand (0.1, 0.0, 0.0) 2.00 N 0"),
    ],
)
async def test_a_subscriber_prints_a_touch(mosquitto: Mosquitto, example: str, line: str) -> None:
    where = str(mosquitto.port)
    if example == "client.py":
        where = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with node(mosquitto) as publisher:
        program = await asyncio.create_subprocess_exec(
            *(sys.executable, "-u", EXAMPLES / example, where), cwd=ROOT, stdout=subprocess.PIPE
        )
        assert program.stdout is not None
        # A touch is not retained: it is told again until the program listens.
        reading = asyncio.create_task(program.stdout.readline())
        async with asyncio.timeout(PATIENCE_S):
            while not reading.done():
                publisher.put_touch(BEGIN)
                await asyncio.wait([reading], timeout=0.1)
        program.terminate()
        await program.wait()
    assert (await reading).decode().strip() == line


def ros_example(monkeypatch: pytest.MonkeyPatch) -> Any:
    ros.install(monkeypatch)
    spec = util.spec_from_file_location("ros2_node", EXAMPLES / "ros2_node.py")
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_what_is_not_valid_is_no_number_in_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    skin = ros_example(monkeypatch).SkinNode()
    frame = Frame(
        "palm", 1, 0, np.array([1.5, 0.0]), np.array([True, False]), np.zeros(2, np.bool_)
    )
    for _ in range(2):
        skin.on_frame(frame)
    assert skin.made == ["palm/pressure"]
    assert skin.published[0][0] == "palm/pressure"
    first, second = skin.published[0][1].data
    assert (first, math.isnan(second)) == (1.5, True)


def test_a_contact_pushes_against_the_normal_and_turns_the_part_about_its_origin(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    skin = ros_example(monkeypatch).SkinNode()
    event = {name: getattr(BEGIN, name) for name in Touch.__struct_fields__ if hasattr(BEGIN, name)}
    skin.on_touch(Touch(**event))
    ((topic, said),) = skin.published
    assert (topic, said.header.frame_id) == ("left_hand/wrench", "left_hand")
    assert (said.header.stamp.sec, said.header.stamp.nanosec) == (10**9, 5)
    assert vars(said.wrench.force) == {"x": 0, "y": 0, "z": -2.0}
    # 2 N down at x = 0.1 m: the x side goes down, which is a positive turn about y.
    assert vars(said.wrench.torque) == {"x": 0, "y": pytest.approx(0.2), "z": 0}


async def test_the_ros_node_passes_on_what_the_skin_says(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    example = ros_example(monkeypatch)
    monkeypatch.setattr(ros.Node, "enough", 2)
    layout = build_layout(load(CONFIG), CONFIG.parent)
    n = layout.part("left_hand").n_taxels
    zeros = np.zeros(n, np.bool_)
    frame = PressureFrame(
        "left_hand", 1, 2, np.zeros(n, np.uint8), np.full(n, 3.0), zeros, ~zeros, zeros
    )
    url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with node(mosquitto) as publisher:
        running = asyncio.create_task(asyncio.to_thread(example.main, url))
        while not running.done():
            publisher.put_touch(BEGIN)
            publisher.put_frame(frame)
            await asyncio.wait([running], timeout=0.2)
        await running
    (skin,) = ros.nodes
    assert {topic for topic, _ in skin.published} <= {"left_hand/pressure", "left_hand/wrench"}
