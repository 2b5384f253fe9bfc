"""Brokers that follow the letter of MQTT 5 and allow little, or answer only half of what they must.

Whatever a broker withholds, the node publishes what it may, says in a line what is missing, and
does not fill the log.
"""

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from typing import Any

import pytest

from skin_host.config.settings import Mqtt
from skin_host.mqtt import connection
from skin_host.mqtt.commands import Handler
from skin_host.mqtt.publisher import Publisher
from tests.support.packets import PUBLISH, SUBSCRIBE, packet_with_flags, suback
from tests.support.waiting import until

QOS_1 = 2
DISCONNECT, PUBACK = 0xE0, 0x40
RECEIVE_MAXIMUM_EXCEEDED, QOS_NOT_SUPPORTED, WILDCARDS_NOT_SUPPORTED = 0x93, 0x9B, 0xA2


class Odd:
    """A broker with these properties of CONNACK, which ends a connection for a reason code.

    Attributes:
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
    ) -> None:
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
            if first >> 4 == SUBSCRIBE and self._subscribes:
                writer.write(suback(body))
            elif first >> 4 == PUBLISH and first & QOS_1:
                end = 2 + int.from_bytes(body[:2], "big")
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
    assert broker.connections == 1
    said = [line for line in lines(caplog) if "no commands are received" in line]
    assert len(said) == 1


async def test_a_broker_without_wildcards_takes_everything_but_commands(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """It ends the connection over a subscription with one (MQTT 5.0, 3.2.2.3.11)."""
    broker = Odd(b"\x28\0", wildcards=False)
    async with publishing(broker, answer):
        await until(lambda: len(set(broker.topics)) >= 13)
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
