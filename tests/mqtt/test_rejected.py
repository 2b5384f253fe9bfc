"""A broker that ends the connection over a publication costs that publication, nothing else."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiomqtt
import numpy as np
import pytest
from msgspec import json

from skin_host.mqtt import trials
from skin_host.mqtt.publisher import Publisher
from skin_host.mqtt.trials import HOLD_S, LONGEST_HOLD_S, TRIES, Trials
from skin_host.processing.frame import PressureFrame
from tests.mqtt.test_publisher import frame, listening, settings, touch
from tests.support.broker import Mosquitto
from tests.support.waiting import until

#: Larger than the broker below takes.
LARGE = {"text": "x" * 3000}


@pytest.fixture
def mosquitto(mosquitto: Mosquitto, tmp_path: Path) -> Iterator[Mosquitto]:
    """One that ends the connection over a packet of 2000 bytes; with MQTT 3.1.1 unannounced."""
    folder = tmp_path / "narrow"
    folder.mkdir()
    with Mosquitto(mosquitto.program, folder, "max_packet_size 2000\n") as narrow:
        yield narrow


def wide(seq: int) -> PressureFrame:
    """A frame of 1200 taxels."""
    m = 1200
    mask = np.zeros(m, np.bool_)
    kpa = np.full(m, 1.5, np.float32)
    return PressureFrame("arm", seq, seq, np.zeros(m, np.uint8), kpa, mask, ~mask, mask)


def narrow(broker: Mosquitto, **keys: Any) -> Any:
    return settings(broker, protocol="3.1.1", **keys)


async def test_a_state_that_the_broker_does_not_take_is_given_up_and_named(
    mosquitto: Mosquitto, caplog: pytest.LogCaptureFixture
) -> None:
    async with listening(mosquitto) as seen, Publisher(narrow(mosquitto), "robot") as publisher:
        publisher.put_health("palm", LARGE)
        publisher.put_health("arm", {"rate_hz": 1.0})
        publisher.put_touch(touch(1))
        await until(lambda: publisher.counters.rejected == 1)
        publisher.put_touch(touch(2))
        await until(lambda: seen.touches()[-1:] == [2])
        assert seen.payloads("arm/health")
        assert publisher.counters.connected
        assert publisher.counters.connections <= TRIES + 2
        assert publisher.counters.touches_dropped == 0
    given_up = [r.getMessage() for r in caplog.records if "given up" in r.getMessage()]
    assert len(given_up) == 1
    assert "skin/robot/palm/health" in given_up[0]


async def test_a_state_that_was_given_up_is_sent_as_it_is_when_its_topic_may_be_tried_again(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials, "HOLD_S", 0.5)
    async with listening(mosquitto) as seen, Publisher(narrow(mosquitto), "robot") as publisher:
        publisher.put_health("palm", LARGE)
        await until(lambda: publisher.counters.rejected == 1)
        publisher.put_health("palm", {"rate_hz": 2.0})
        await until(lambda: seen.payloads("palm/health"))
        await until(lambda: publisher.counters.withheld == [])


async def test_of_touches_one_that_is_not_taken_is_counted_and_the_others_arrive_in_order(
    mosquitto: Mosquitto,
) -> None:
    large = touch(4)
    large.taxels.extend(range(2000))
    async with listening(mosquitto) as seen, Publisher(narrow(mosquitto), "robot") as publisher:
        for number in (1, 2, 3):
            publisher.put_touch(touch(number))
        publisher.put_touch(large)
        for number in (5, 6, 7):
            publisher.put_touch(touch(number))
        await until(lambda: 7 in seen.touches())
        assert list(dict.fromkeys(seen.touches())) == [1, 2, 3, 5, 6, 7]
        assert publisher.counters.rejected == publisher.counters.touches_dropped == 1


async def test_frames_that_are_not_taken_are_withheld_and_the_other_parts_go_on(
    mosquitto: Mosquitto,
) -> None:
    async with listening(mosquitto) as seen, Publisher(narrow(mosquitto), "robot") as publisher:

        async def sweep(seq: int) -> None:
            publisher.put_frame(wide(seq))
            publisher.put_frame(frame(seq))
            await asyncio.sleep(0.02)

        seq = 0
        while not publisher.counters.withheld:
            seq += 1
            await sweep(seq)
            assert seq < 3000
        assert publisher.counters.withheld == ["skin/robot/arm/frame"]
        await until(lambda: publisher.counters.connected)
        before = len(seen.payloads("palm/frame"))
        for more in range(5):
            await sweep(seq + more)
        await until(lambda: len(seen.payloads("palm/frame")) > before)


async def test_an_answer_is_dropped_with_the_connection_that_it_ended(
    mosquitto: Mosquitto,
) -> None:
    async def long(name: str, payload: bytes) -> dict[str, str]:
        return LARGE

    async with listening(mosquitto) as seen:
        async with Publisher(narrow(mosquitto), "robot", handler=long) as publisher:
            await until(lambda: mosquitto.subscriptions("skin/robot/nodes/main/cmd/+"))
            async with aiomqtt.Client(mosquitto.host, mosquitto.port) as client:
                await client.publish("skin/robot/nodes/main/cmd/scan", "{}", qos=1)
            await until(lambda: publisher.counters.answers_dropped == 1)
            await until(lambda: publisher.counters.connected)
            publisher.put_touch(touch(1))
            await until(lambda: seen.touches() == [1])
            assert publisher.counters.connections == 2
            assert publisher.counters.rejected == 0


def test_a_topic_is_found_after_some_strikes_and_by_each_one_from_then_on() -> None:
    found = Trials()
    assert [found.strike("a") for _ in range(5)] == [0, 0, 1, 2, 3]
    assert TRIES == 3
    assert found.strike("b") == 0


def test_a_topic_is_withheld_for_a_while() -> None:
    now_s = [0.0]
    found = Trials(lambda: now_s[0])
    found.withhold("a")
    assert found.withheld == ["a"]
    now_s[0] = HOLD_S
    assert found.withheld == []


def test_a_topic_that_is_never_taken_is_withheld_for_longer_and_longer_until_one_arrives() -> None:
    """Each try costs a connection."""
    found = Trials(lambda: 0.0)
    ends_s = []
    for arrives in (False, False, False, False, True):
        found.withhold("a")
        ends_s.append(found.until_s("a"))
        if arrives:
            found.arrived("a")
    found.withhold("a")
    assert ends_s == [HOLD_S, 2 * HOLD_S, 4 * HOLD_S, LONGEST_HOLD_S, LONGEST_HOLD_S]
    assert found.until_s("a") == HOLD_S


def test_an_arrival_clears_a_topic() -> None:
    found = Trials()
    for _ in range(TRIES):
        found.strike("a")
        found.strike("b")
    found.withhold("a")
    found.arrived("a")
    assert found.withheld == []
    assert (found.strike("a"), found.strike("b")) == (0, 2)


async def test_the_limit_that_a_broker_announces_is_kept(
    mosquitto: Mosquitto, caplog: pytest.LogCaptureFixture
) -> None:
    async def long(name: str, payload: bytes) -> dict[str, str]:
        return LARGE

    large = touch(1)
    large.taxels.extend(range(2000))
    async with listening(mosquitto) as seen:
        async with Publisher(settings(mosquitto), "robot", handler=long) as publisher:
            # A frame without a connection is skipped, whatever its size.
            await until(lambda: publisher.counters.connected)
            publisher.put_health("palm", LARGE)
            publisher.put_touch(large)
            publisher.put_touch(touch(2))
            publisher.put_frame(wide(1))
            async with aiomqtt.Client(mosquitto.host, mosquitto.port) as client:
                await client.publish("skin/robot/nodes/main/cmd/scan", "{}", qos=1)
            await until(lambda: seen.payloads("scan/result"))
            await until(lambda: seen.touches() == [2])
            counters = publisher.counters
        (answer,) = map(json.decode, seen.payloads("scan/result"))
        assert (answer["ok"], answer["result"]) == (True, {"left_out": ["text"]})
    assert counters.connections == 1
    assert counters.rejected == 2
    assert counters.touches_dropped == counters.frames_skipped == 1
    assert {"skin/robot/palm/health", "skin/robot/arm/frame"} <= {*counters.withheld}
    assert sum("skin/robot/palm/health" in r.getMessage() for r in caplog.records) == 1


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
async def test_two_daemons_of_one_name_give_way_to_each_other_and_say_so(
    mosquitto: Mosquitto, protocol: str
) -> None:
    """With MQTT 3.1.1 the broker closes the older connection without a reason."""
    at = settings(mosquitto, protocol=protocol)
    async with Publisher(at, "robot") as one:
        await until(lambda: one.counters.connected)
        async with Publisher(at, "robot") as other:
            await until(lambda: one.counters.name_taken)
            await until(lambda: other.counters.name_taken)
            before = one.counters.connections + other.counters.connections
            await asyncio.sleep(2.0)
            assert one.counters.connections + other.counters.connections <= before + 2
