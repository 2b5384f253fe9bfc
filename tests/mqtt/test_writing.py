"""Frames are written past paho, and never into the middle of what it writes."""

import asyncio
import contextlib
import socket
import ssl
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import (
    MAX_IN_FLIGHT,
    Connection,
    PackedProperties,
    connect,
    message_properties,
)
from skin_host.mqtt.packets import numbered_packet, publish_head, publish_packet
from tests.support.certificates import authority, certificate
from tests.support.packets import packet_with_flags
from tests.support.waiting import PATIENCE_S, until

CONNECT, PUBLISH, DISCONNECT = 0x10, 0x30, 0xE0


@dataclass
class SlowBroker:
    """Takes a connection, and reads nothing more until it is told to."""

    reading: asyncio.Event = field(default_factory=asyncio.Event)
    packets: list[tuple[int, bytes]] = field(default_factory=list)
    port: int = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                command, packet = await packet_with_flags(reader)
                self.packets.append((command, packet))
                if command == CONNECT:
                    writer.write(b"\x20\x03\x00\x00\x00")
                    await self.reading.wait()
                elif command & 0x06:
                    topic_end = 2 + int.from_bytes(packet[:2], "big")
                    writer.write(b"\x40\x02" + packet[topic_end : topic_end + 2])
        writer.close()

    def payloads(self, topic: str) -> list[bytes]:
        """Of what came with QoS 0, in order."""
        head = publish_head(topic, b"\x00")
        return [
            packet[len(head) :]
            for command, packet in self.packets
            if command == PUBLISH and packet.startswith(head)
        ]


@asynccontextmanager
async def slow_broker(tls: ssl.SSLContext | None) -> AsyncIterator[SlowBroker]:
    broker = SlowBroker()
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
    listener.bind(("127.0.0.1", 0))
    server = await asyncio.start_server(broker.serve, sock=listener, ssl=tls, limit=20_000)
    broker.port = listener.getsockname()[1]
    yield broker
    server.close()


@pytest.fixture(params=["plain", "tls"])
def contexts(
    request: pytest.FixtureRequest, tmp_path: Path
) -> tuple[ssl.SSLContext | None, ssl.SSLContext | None]:
    """Of the broker, and of its client."""
    if request.param == "plain":
        return None, None
    authority(tmp_path, "ca")
    certificate(tmp_path, "server", "IP:127.0.0.1")
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.load_cert_chain(tmp_path / "server.crt", tmp_path / "server.key")
    return server, ssl.create_default_context(cafile=str(tmp_path / "ca.crt"))


def numbered(number: int, size: int) -> bytes:
    return number.to_bytes(4, "big") + bytes([number % 251]) * size


async def test_no_packet_is_cut_by_another_when_the_socket_is_full(
    contexts: tuple[ssl.SSLContext | None, ssl.SSLContext | None],
) -> None:
    head = publish_head("f", b"\x00")
    async with slow_broker(contexts[0]) as broker:
        address = Broker("127.0.0.1", broker.port, tls=contexts[1])
        async with connect(address, identifier="writer") as connection:
            cleared = asyncio.Event()
            connection.when_clear = cleared.set
            written: list[int] = []
            events: list[asyncio.Future[None]] = []
            number = 0
            # More and more, until the socket is full; then the same with the broker reading.
            for tries in range(4):
                taken = size = 1
                while taken == size:
                    frames = [number, number + 1, number + 2]
                    number += 3
                    packets = [publish_packet(head, numbered(n, 30_011)) for n in frames]
                    size = len(packets)
                    taken = connection.write_now(packets)
                    written += frames[:taken]
                    if len(events) < 10 * (tries + 1):
                        payload = numbered(number, 3001)
                        events.append(connection.send("e", payload, qos=1, hold=number % 2 > 0))
                        connection.flush()
                    await asyncio.sleep(0)
                broker.reading.set()
                await asyncio.wait_for(cleared.wait(), PATIENCE_S)
                cleared.clear()
            await asyncio.wait_for(asyncio.gather(*events), PATIENCE_S)
        await until(lambda: broker.packets[-1][0] == DISCONNECT)
        payloads = broker.payloads("f")
        assert [int.from_bytes(payload[:4], "big") for payload in payloads] == written
        assert all(
            payload == numbered(n, 30_011) for payload, n in zip(payloads, written, strict=True)
        )
        events_seen = [packet for command, packet in broker.packets if command & 0xF6 == 0x32]
        assert len(events_seen) == len(events)


def written_by_paho(
    version: Literal["5", "3.1.1"], topic: str, payload: bytes, qos: int = 0, retain: bool = False
) -> tuple[int, bytes | None, bytes]:
    """What paho numbers a message with, the packed properties that it has, and paho's packet."""
    broker = Broker(protocol=version)
    properties = PackedProperties.of(message_properties(broker, "application/json"))
    protocol = MQTTProtocolVersion.MQTTv5 if broker.v5 else MQTTProtocolVersion.MQTTv311
    client = Client(CallbackAPIVersion.VERSION2, protocol=protocol)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        client._sock = ours
        sent = client.publish(topic, payload, qos, retain, properties)
        packet = theirs.recv(200_000)
        client._sock = None
    return sent.mid, None if properties is None else properties.pack(), packet


@pytest.mark.parametrize("retain", [False, True])
@pytest.mark.parametrize("size", [0, 1, 100, 128, 16_384])
@pytest.mark.parametrize("version", ["5", "3.1.1"])
def test_an_event_has_the_bytes_that_paho_would_write(
    size: int, version: Literal["5", "3.1.1"], retain: bool
) -> None:
    topic, payload = "skin/robot/palm/touch", b"x" * size
    mid, packed, expected = written_by_paho(version, topic, payload, 1, retain)
    assert numbered_packet(topic, mid, packed, payload, retain=retain) == expected


@pytest.mark.parametrize("correlation", [None, 0, 100, 1024])
@pytest.mark.parametrize("size", [0, 1, 100, 128, 16_384])
async def test_a_message_fits_if_its_packet_is_not_longer_than_the_broker_takes(
    size: int, correlation: int | None
) -> None:
    properties = None
    if correlation is not None:
        properties = message_properties(Broker(), "application/json")
        assert properties is not None
        properties.CorrelationData = b"c" * correlation
    packed = b"\0" if properties is None else properties.pack()
    topic, payload = "skin/robot/palm/t\u00e4uch", b"x" * size
    connection = Connection(
        Broker(),
        identifier="fits",
        will=None,
        max_incoming=1,
        max_packet=1000,
        session_s=0,
        resume=False,
    )
    assert connection.fits(topic, payload, properties)
    length = len(numbered_packet(topic, 1, packed, payload, retain=False))
    for spare, fits in ((0, True), (-1, False)):
        connection.packet_limit = length + spare
        assert connection.fits(topic, payload, properties) == fits


@pytest.mark.parametrize("hold", [False, True])
async def test_events_keep_their_order_beyond_those_that_may_be_on_their_way(hold: bool) -> None:
    n = 5 * MAX_IN_FLIGHT
    async with slow_broker(None) as broker:
        broker.reading.set()
        async with connect(Broker("127.0.0.1", broker.port), identifier="writer") as connection:
            events = []
            for number in range(n):
                payload = number.to_bytes(4, "big")
                events.append(connection.send("e", payload, qos=1, hold=hold))
                if number % 7 == 0:
                    connection.flush()
                    await asyncio.sleep(0.001 * (number % 3))
            connection.flush()
            await asyncio.wait_for(asyncio.gather(*events), PATIENCE_S)
        await until(lambda: broker.packets[-1][0] == DISCONNECT)
    came = [packet[-4:] for command, packet in broker.packets if command == PUBLISH | 0x02]
    assert [int.from_bytes(payload, "big") for payload in came] == list(range(n))


@pytest.mark.parametrize("size", [0, 1, 100, 127, 128, 16_383, 16_384, 70_000])
@pytest.mark.parametrize("version", ["5", "3.1.1"])
def test_a_frame_has_the_bytes_that_paho_would_write(
    size: int, version: Literal["5", "3.1.1"]
) -> None:
    topic, payload = "skin/robot/palm/frame", b"x" * size
    _, packed, expected = written_by_paho(version, topic, payload)
    assert publish_packet(publish_head(topic, packed), payload) == expected


def test_a_packet_longer_than_mqtt_knows_is_refused() -> None:
    class Endless(bytes):
        def __len__(self) -> int:
            return 2**28

    with pytest.raises(ValueError, match="wanted at most"):
        publish_packet(b"", Endless())
