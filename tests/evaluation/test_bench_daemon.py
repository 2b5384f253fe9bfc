"""The benchmark of the whole daemon sends what it says, and knows the rooms."""

import time

import numpy as np
import pytest

from skin_host.bus.wire import TAXELS, TRIANGLES
from skin_host.evaluation.body_stream import Body
from skin_host.evaluation.can_stream import CAN_FRAME
from skin_host.evaluation.measured_daemon import RoomClock, room_of
from skin_host.layout import build_layout
from skin_host.processing import curves


@pytest.mark.parametrize("hz", [20, 50])
def test_no_bus_carries_more_than_it_can(hz: int) -> None:
    body = Body.of(10_000, hz)
    ticks = body.ticks(np.zeros((body.boards, TRIANGLES, TAXELS), np.uint8))
    frames = [(bus, len(burst) // CAN_FRAME.size) for tick in ticks for bus, burst in tick]
    per_bus = np.bincount([bus for bus, _ in frames], [n for _, n in frames])
    assert per_bus.sum() == 2 * body.triangles
    assert per_bus.max() <= 8000 / hz
    assert max(n for _, n in frames) <= 9


def test_a_body_has_the_taxels_that_were_asked_for(tmp_path) -> None:  # type: ignore[no-untyped-def]
    body = Body.of(2000, 20)
    layout = build_layout(body.settings(), tmp_path)
    assert layout.n_taxels == body.taxels == 2004
    assert [len(part.boards) for part in layout.parts] == [4, 4, 3]


def work() -> None:
    for _ in range(20):
        curves.rising(curves.KNOTS_UNITS)


def test_cpu_is_put_down_to_the_room_that_takes_it() -> None:
    rooms = RoomClock()
    rooms.begin()
    until_s = time.process_time() + 0.1
    while time.process_time() < until_s:
        work()
    by_room_s = rooms.end()
    assert next(iter(by_room_s)) == "pipeline"


def test_a_turn_shorter_than_the_interval_of_samples_is_sampled_too() -> None:
    rooms = RoomClock()
    rooms.begin()
    for _ in range(400):
        rooms.sleep()
        rooms.wake()
        until_s = time.thread_time() + 0.0003
        while time.thread_time() < until_s:
            work()
    by_room_s = rooms.end()
    assert rooms.samples["pipeline"] > 0
    assert next(iter(by_room_s)) == "pipeline"


def test_each_room_is_named_by_its_modules() -> None:
    assert room_of("skin_host.bus.assembler") == "assembler"
    assert room_of("paho.mqtt.client") == "mqtt"
    assert room_of("asyncio.events") == ""
