"""A subscriber that names no robot finds the only one, also where the broker is slow or busy."""

import asyncio
import contextlib

import pytest

from skin_host.client import links
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import connect
from skin_host.mqtt.packets import publish_head, publish_packet
from skin_host.mqtt.topics import OFFLINE, ONLINE
from tests.support.packets import CONNACK, CONNECT, SUBSCRIBE, packet, suback

UNSUBSCRIBE = 10


async def found(*statuses: tuple[str, bytes], late_s: float = 0.0) -> str:
    """The robot of a broker that sends these statuses so long after the subscription."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                kind, rest = await packet(reader)
                if kind == CONNECT:
                    writer.write(CONNACK)
                elif kind == SUBSCRIBE:
                    writer.write(suback(rest))
                    await asyncio.sleep(late_s)
                    for robot, status in statuses:
                        head = publish_head(f"skin/{robot}/nodes/main/status", b"\0")
                        writer.write(publish_packet(head, status))
                elif kind == UNSUBSCRIBE:
                    writer.write(bytes([0xB0, 4]) + rest[:2] + b"\0\0")
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server:
        port = server.sockets[0].getsockname()[1]
        broker, _ = Broker.from_url(f"mqtt://127.0.0.1:{port}")
        async with connect(broker) as connection:
            return await links.only_robot(connection, broker, "skin")


async def test_a_robot_that_ends_meanwhile_is_not_taken_for_a_second_one() -> None:
    assert await found(("a", ONLINE), ("b", ONLINE), ("b", OFFLINE)) == "a"


async def test_the_first_status_may_come_late(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(links, "RETAINED_S", 0.05)
    assert await found(("a", ONLINE), late_s=0.2) == "a"
