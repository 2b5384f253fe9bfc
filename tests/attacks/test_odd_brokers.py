"""Brokers that follow the letter of MQTT 5 and allow little, or answer only half of what they must,
or end the connection over one topic.

Whatever a broker withholds, the node publishes what it may, says in a line what is missing, and
does not fill the log.
"""

import asyncio
import itertools
import logging
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from typing import Any

import pytest

from skin_host.config.settings import Mqtt
from skin_host.mqtt import connection, trials
from skin_host.mqtt.commands import Handler
from skin_host.mqtt.publisher import Publisher
from skin_host.mqtt.trials import TRIES
from tests.support.packets import PUBLISH, SUBSCRIBE, packet_with_flags, suback
from tests.support.waiting import until

QOS_1 = 2
DISCONNECT, PUBACK = 0xE0, 0x40
RECEIVE_MAXIMUM_EXCEEDED, QOS_NOT_SUPPORTED, WILDCARDS_NOT_SUPPORTED = 0x93, 0x9B, 0xA2


class Odd:
    """A broker with these properties of CONNACK, which ends a connection for a reason code.

    Attributes:
        ends_over: publications to this topic, or subscriptions to it, end the connection without
            a word.
        topics: of all publications.
        in_flight, most: unacknowledged publications, now and at most.
    """

    def __init__(
        self,
        properties: bytes = b"",
        *,
        subscribes: bool = True,
        wildcards: bool = True,
        judge: Callable[["Odd", int], int] = lambda *_: 0,
        connack_s: float = 0.0,
        ends_over: tuple[int, str] | None = None,
    ) -> None:
        self.ends_over = ends_over
        self._properties, self._subscribes, self._judge = properties, subscribes, judge
        self._connack_s = connack_s
        self._wildcards = wildcards
        self.connections = self.in_flight = self.most = 0
        self.topics: list[str] = []

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        self.in_flight = 0
        try:
            await self._answer(reader, writer)
        except (OSError, asyncio.IncompleteReadError):
            pass
        finally:
            writer.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await packet_with_flags(reader)
        body = bytes([0, 0, len(self._properties)]) + self._properties
        for byte in bytes([0x20, len(body)]) + body:
            writer.write(bytes([byte]))
            await writer.drain()
            await asyncio.sleep(self._connack_s)
        while True:
            first, body = await packet_with_flags(reader)
            if first >> 4 == SUBSCRIBE and b"+" in body and not self._wildcards:
                writer.write(bytes([DISCONNECT, 1, WILDCARDS_NOT_SUPPORTED]))
                return
            if first >> 4 == SUBSCRIBE and self.ends_over == (SUBSCRIBE, body[5:-1].decode()):
                return
            if first >> 4 == SUBSCRIBE and self._subscribes:
                writer.write(suback(body))
            elif first >> 4 == PUBLISH and first & QOS_1:
                end = 2 + int.from_bytes(body[:2], "big")
                if self.ends_over == (PUBLISH, body[2:end].decode()):
                    return
                self.topics.append(body[2:end].decode())
                self.in_flight += 1
                self.most = max(self.most, self.in_flight)
                if reason := self._judge(self, first):
                    writer.write(bytes([DISCONNECT, 1, reason]))
                    await writer.drain()
                    return
                asyncio.get_running_loop().call_later(
                    0.005, self._acknowledge, writer, body[end : end + 2]
                )

    def _acknowledge(self, writer: asyncio.StreamWriter, number: bytes) -> None:
        if not writer.is_closing():
            self.in_flight -= 1
            writer.write(bytes([PUBACK, 2]) + number)


@asynccontextmanager
async def publishing(broker: Odd, handler: Handler | None = None) -> AsyncIterator[Publisher]:
    server = await asyncio.start_server(broker.serve, "127.0.0.1", 0)
    settings = Mqtt(host="127.0.0.1", port=server.sockets[0].getsockname()[1])
    async with Publisher(settings, "robot", handler=handler, drain_s=0.0) as publisher:
        for part in range(12):
            publisher.put_contact(f"p{part}", "OFF")
        yield publisher
    server.close()


async def answer(name: str, request: bytes) -> Mapping[str, Any]:
    return {}


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name.startswith("skin_host")]


@pytest.mark.parametrize("most", [1, 3, 10])
async def test_no_more_is_unacknowledged_than_the_broker_allows(most: int) -> None:
    def judge(broker: Odd, _: int) -> int:
        return RECEIVE_MAXIMUM_EXCEEDED * (broker.in_flight > most)

    broker = Odd(b"\x21" + most.to_bytes(2, "big"), judge=judge)
    async with publishing(broker):
        await until(lambda: len(set(broker.topics)) >= 13)
    assert broker.connections == 1
    assert broker.most <= most


async def test_touches_reach_a_broker_that_never_acknowledges_a_subscription(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connection, "TIMEOUT_S", 0.5)
    broker = Odd(subscribes=False)
    async with publishing(broker) as publisher:
        await until(lambda: len(set(broker.topics)) >= 13)
        assert publisher.counters.connected
        assert publisher.counters.unsubscribed == ["skin/robot/nodes/main/status"]
    assert broker.connections == 1
    said = [line for line in lines(caplog) if "no commands are received" in line]
    assert len(said) == 1


async def test_a_broker_without_wildcards_takes_everything_but_commands(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """It ends the connection over a subscription with one (MQTT 5.0, 3.2.2.3.11)."""
    broker = Odd(b"\x28\0", wildcards=False)
    async with publishing(broker, answer) as publisher:
        await until(lambda: len(set(broker.topics)) >= 13)
        assert publisher.counters.unsubscribed == ["skin/robot/nodes/main/cmd/+"]
    assert broker.connections == 1
    said = [
        line for line in lines(caplog) if "may not subscribe to skin/robot/nodes/main/cmd/+" in line
    ]
    assert len(said) == 1


async def test_a_broker_that_ends_every_connection_fills_no_log(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(connection, "LAST_RETRY_S", 0.05)
    monkeypatch.setattr(connection, "FIRST_RETRY_S", 0.05)
    broker = Odd(b"\x24\0", judge=lambda _, first: QOS_NOT_SUPPORTED)
    async with publishing(broker) as publisher:
        await until(lambda: broker.connections >= 20)
        assert "QoS 1" in publisher.counters.last_error
        assert not publisher.counters.name_taken
        # What the stop reports depends on whether a connection stands just then.
        assert len(lines(caplog)) <= 3


async def test_an_acknowledgement_that_drips_is_given_up_in_a_line(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connection, "TIMEOUT_S", 0.2)
    broker = Odd(connack_s=0.1)
    async with publishing(broker):
        await until(lambda: broker.connections >= 3)
    assert len(lines(caplog)) == 1
    assert not [record for record in caplog.records if record.name == "asyncio"]


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """The next connection follows at once."""
    monkeypatch.setattr(connection, "FIRST_RETRY_S", 0.05)
    monkeypatch.setattr(connection, "LAST_RETRY_S", 0.05)


@pytest.mark.usefixtures("hasty")
async def test_a_state_that_differs_at_every_try_is_found_and_all_else_is_published(
    caplog: pytest.LogCaptureFixture,
) -> None:
    topic = "skin/robot/palm/health"
    numbers = itertools.count()
    broker = Odd(ends_over=(PUBLISH, topic))
    async with publishing(broker) as publisher:

        def goes_on() -> bool:
            publisher.put_health("palm", {"number": next(numbers)})
            return publisher.counters.connected and "skin/robot/after/contact" in broker.topics

        def is_found() -> bool:
            publisher.put_health("palm", {"number": next(numbers)})
            return broker.connections > 2 * TRIES or bool(publisher.counters.withheld)

        await until(is_found)
        publisher.put_contact("after", "ON")
        await until(goes_on)
        counters = publisher.counters
        assert counters.withheld == [topic]
        assert counters.last_error.endswith(f"when this is published: {topic}")
        assert not counters.name_taken
        assert counters.rejected == 1
    assert broker.connections <= TRIES + 2
    assert sum(topic in line for line in lines(caplog)) == 1


@pytest.mark.usefixtures("hasty")
async def test_a_broker_that_never_takes_the_status_is_named_for_that_in_a_line(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Nothing is published without it: who sees no node online must not see its contacts."""
    topic = "skin/robot/nodes/main/status"
    broker = Odd(ends_over=(PUBLISH, topic))
    async with publishing(broker, answer) as publisher:
        await until(lambda: broker.connections >= 3 * TRIES)
        counters = publisher.counters
        assert counters.last_error.endswith(f"when this is published: {topic}")
        assert not counters.name_taken
        assert counters.withheld == []
        assert len(lines(caplog)) <= 3
    assert sum(topic in line for line in lines(caplog)) == 1


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize("name", ["status", "cmd/+"])
async def test_a_broker_that_takes_no_subscription_takes_everything_else_until_it_allows_it(
    name: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    topic = f"skin/robot/nodes/main/{name}"
    broker = Odd(ends_over=(SUBSCRIBE, topic))
    with monkeypatch.context() as patch:
        patch.setattr(trials, "HOLD_S", 2.0)
        async with publishing(broker, answer) as publisher:
            await until(lambda: len(set(broker.topics)) >= 13 or broker.connections > 2 * TRIES)
            counters = publisher.counters
            assert broker.connections == TRIES + 1
            assert counters.unsubscribed == [topic]
            assert counters.last_error.endswith(f"when we subscribe to: {topic}")
            assert not counters.name_taken
            assert sum(topic in line for line in lines(caplog)) == 1
            # Its rules are asked for again, once, and once more.
            await until(lambda: broker.connections == TRIES + 2)
            broker.ends_over = None
            await until(lambda: publisher.counters.connected)
            await until(lambda: not publisher.counters.unsubscribed)
            assert broker.connections == TRIES + 2
