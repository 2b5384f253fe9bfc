"""Numbers that somebody forges make a node neither unreadable nor unheard."""

import asyncio

import aiomqtt
import numpy as np
import pytest
from msgspec.structs import replace
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from skin_host.client.order import EventOrder, Newest
from skin_host.client.streams import Stream
from skin_host.mqtt.messages import Frame, encode_event
from skin_host.mqtt.order import Numbers, Stamp, put_run, put_stamp, stamp_of
from skin_host.processing.events import Touch
from tests.client.test_client import hearing, publishing, take, touch
from tests.client.test_order import event
from tests.support.broker import Mosquitto
from tests.support.waiting import PATIENCE_S, until

#: The true run of a node.
RUN = 1_700_000_000_000_000_000


def frame(seq: int) -> Frame:
    none = np.zeros(1, np.bool_)
    return Frame("palm", seq, seq, np.zeros(1, np.float32), none, none)


@pytest.mark.parametrize("forged", [10**18 * 8, 10**19 - 1, 10**19 - 2])
def test_a_node_that_met_a_forged_stamp_is_understood(forged: int) -> None:
    numbers = Numbers(lambda: 1_700_000_000_000_000_000, lambda: 0)
    for more in range(3):
        numbers.overtake(Stamp(forged + more, 1))
        numbers.connect()
    properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    put_stamp(properties, numbers.state())
    assert stamp_of(properties) == Stamp(numbers.connection, 2)


def test_a_run_whose_clock_was_ahead_is_overtaken() -> None:
    numbers = Numbers(lambda: 1_700_000_000_000_000_000, lambda: 0)
    assert numbers.overtake(Stamp(4_000_000_000_000_000_000, 1))
    assert numbers.run > 4_000_000_000_000_000_000


#: Of events and frames: a clock years ahead, the greatest number that is read, one count too many.
FORGED = [(4 * 10**18, 3), (10**19 - 1, 1), (RUN, 10**15)]


@pytest.mark.parametrize(("run", "count"), FORGED)
@pytest.mark.parametrize("hold_s", [0.0, 10.0])
@pytest.mark.parametrize("begins", [False, True])
def test_a_forged_event_does_not_silence_a_robot_for_ever(
    run: int, count: int, hold_s: float, begins: bool
) -> None:
    order = EventOrder(hold_s)
    now_s, passed, forged = 0.0, list[Touch](), event(count)
    for n in range(1, 2000):
        now_s += 0.1
        if n == (1 if begins else 500):
            passed += order.take(forged, run, now_s)
        passed += order.take(event(n), RUN, now_s) + order.expire(now_s)
    told = [one.count for one in passed if one is not forged]
    assert told == sorted(set(told))
    assert told[-1] == 1999
    assert len(told) > 1999 - 450


def test_many_forged_runs_delay_a_robot_no_longer_than_one() -> None:
    order = EventOrder(0.0)
    passed, now_s = [], 0.0
    for n in range(1, 2000):
        now_s += 0.1
        if 500 <= n < 600:
            order.take(event(n), RUN + n * 10**15, now_s)
        passed += order.take(event(n), RUN, now_s)
    assert [one.count for one in passed][-1000:] == [*range(1000, 2000)]


@pytest.mark.parametrize("number", FORGED)
def test_a_forged_frame_does_not_silence_a_robot_for_ever(number: tuple[int, int]) -> None:
    order = EventOrder(0.0)
    run, seq = number
    assert order.take_frame(frame(seq), run, 0.0)
    shown = [n for n in range(1, 1000) if order.take_frame(frame(n), RUN, n / 20)]
    assert shown == [*range(shown[0], 1000)]
    assert len(shown) > 300


def test_a_forged_stamp_of_a_state_is_not_the_newest_for_ever() -> None:
    newest = Newest()
    forged = Stamp(10**19 - 1, 1)
    assert newest.take("health", "palm", forged, 0.0)
    assert newest.take("contact", "palm", forged, 0.0)
    taken = [s for s in range(1, 100) if newest.take("health", "palm", Stamp(RUN, s), float(s))]
    assert taken == [*range(32, 100)]
    assert newest.take("contact", "palm", Stamp(RUN, 200), 200.0) is False
    assert newest.take("contact", "palm", Stamp(RUN, 300), 300.0)


def test_a_state_that_stays_is_not_given_up_for_what_a_frozen_broker_delivers_late() -> None:
    newest = Newest()
    assert newest.take("contact", "palm", Stamp(RUN + 7, 1), 0.0)
    for second in range(1, 300):
        assert newest.take("contact", "palm", Stamp(RUN, second), float(second)) is False
        assert newest.take("health", "palm", Stamp(RUN + 7, second + 1), float(second))


def test_a_run_that_lives_is_not_given_up_for_what_comes_late_of_the_one_before() -> None:
    order = EventOrder(10.0)
    for n in range(1, 300):
        order.take(event(2 * n), RUN, float(n))
    told = []
    for n in range(1, 300):
        told += order.take(event(n), RUN + 10, 300.0 + n)
        assert order.take(event(600 + n), RUN, 300.0 + n) == []
    assert [one.count for one in told][-299:] == [*range(1, 300)]


@pytest.mark.parametrize("forged", [4 * 10**18, 10**19 - 1])
async def test_a_program_hears_its_robot_again_after_a_forged_run(
    mosquitto: Mosquitto, forged: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skin_host.client.order.VANISHED_S", 0.5)
    properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    put_run(properties, forged)
    topic, payload = "skin/robot/palm/touch", encode_event(touch(77), 77)
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        touches = skin.touches()
        await until(lambda: mosquitto.subscriptions("skin/robot/+/touch"))
        publisher.put_touch(touch(1))
        assert (await take(touches, 1))[0].seq == 1
        async with aiomqtt.Client(
            mosquitto.host, mosquitto.port, protocol=aiomqtt.ProtocolVersion.V5
        ) as attacker:
            await attacker.publish(topic, payload, 1, properties=properties)
        assert (await take(touches, 1))[0].seq == 77
        async with asyncio.timeout(PATIENCE_S):
            heard: list[Touch] = []
            async with asyncio.TaskGroup() as group:
                task = group.create_task(take(touches, 20))
                number = 2
                while not task.done():
                    publisher.put_touch(touch(number))
                    number += 1
                    await asyncio.sleep(0.05)
                heard = task.result()
        numbers = [one.seq for one in heard]
        assert numbers == [*range(numbers[0], numbers[0] + 20)]


@pytest.mark.parametrize("hold_s", [0.0, 10.0])
async def test_what_a_forged_run_hides_is_counted(hold_s: float) -> None:
    order, stream = EventOrder(hold_s), Stream[Touch](None, "touch")
    now_s, n_sent = 0.0, 600
    for count in range(1, n_sent + 1):
        now_s += 0.1
        for item in order.expire(now_s):
            stream.put(item)
        sent = [(RUN, replace(event(count), t_ns=10 * count))]
        if count == 50:
            sent.append((4 * 10**18, replace(event(7), t_ns=10 * count + 1)))
        for run, one in sent:
            for item in order.take(one, run, now_s):
                stream.put(item)
    stream.close()
    told = [item async for item in stream]
    after = next(item for item in told if item.t_ns > 501)
    assert 501 in [item.t_ns for item in told]
    assert after.count > 300
    assert after.missed == after.count - 51
    assert [item.missed for item in told if item.t_ns > after.t_ns] == [0] * (n_sent - after.count)
