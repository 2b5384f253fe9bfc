"""The fleet's plain ends lose and repeat nothing over a broker that is killed."""

import asyncio
from pathlib import Path

import pytest

from skin_host.client.order import EventOrder
from skin_host.config.settings import Mqtt
from skin_host.evaluation.fleet_sockets import Heard, PlainEar, PlainRobot
from skin_host.mqtt.address import Broker
from skin_host.mqtt.messages import decode_touch
from tests.support.broker import Mosquitto
from tests.support.said import make_event
from tests.support.waiting import until

EVENTS = 300


@pytest.fixture
def brokers(mosquitto: Mosquitto, tmp_path: Path) -> list[Mosquitto]:
    folder = tmp_path / "second"
    folder.mkdir()
    return [mosquitto, Mosquitto(mosquitto.program, folder)]


async def test_events_and_states_arrive_once_and_in_order_over_a_killed_broker(
    brokers: list[Mosquitto],
) -> None:
    brokers[1].start()
    order = EventOrder(hold_s=60.0)
    counts: list[int] = []
    states: list[bytes] = []

    def take(heard: Heard) -> None:
        if heard.topic.endswith("/touch"):
            events = order.take(decode_touch(heard.payload), heard.run, 0.0)
            counts.extend(event.count for event in events)
        elif heard.topic.endswith("/contact"):
            states.append(heard.payload)

    ears = [
        PlainEar(Broker(one.host, one.port), f"ear{one.port}", ["skin/#"], take, lambda: None)
        for one in brokers
    ]
    tasks = [asyncio.create_task(ear.run()) for ear in ears]
    await until(lambda: all(ear.connected for ear in ears))
    addresses = [f"{one.host}:{one.port}" for one in brokers]
    robot = await PlainRobot(Mqtt(brokers=addresses), "r").__aenter__()
    await until(lambda: robot.connected)
    first = brokers[addresses.index(robot.address)]
    for number in range(EVENTS):
        robot.put_touch(make_event(seq=number))
        robot.put_contact("palm", "ON" if number % 2 else "OFF")
        if number == EVENTS // 2:
            first.kill()
        await asyncio.sleep(0.001)
    await until(lambda: len(counts) == EVENTS and not robot.waiting and states[-1] == b"ON")
    assert counts == list(range(1, EVENTS + 1))
    assert robot.connections == 2
    for task in [*tasks, robot.task]:
        task.cancel()
    await asyncio.gather(*tasks, robot.task, return_exceptions=True)
    await asyncio.sleep(0)
    brokers[1].kill()
