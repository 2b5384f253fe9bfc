"""A broker that sends what no broker should: packets of every type, malformed and endless."""

import asyncio
import logging
import random

import pytest

from skin_host.config.settings import Mqtt
from skin_host.mqtt.publisher import Publisher
from tests.support.packets import SUBSCRIBE, packet, suback
from tests.support.waiting import until

CONNACK_5 = bytes([0x20, 3, 0, 0, 0])
CONNACK_311 = bytes([0x20, 2, 0, 0])


def packets(chance: random.Random) -> list[bytes]:
    """Every type with every flag: empty, random, of a length that never comes, and a bomb."""
    found = []
    for first in range(0x10, 0x100):
        body = chance.randbytes(chance.randrange(60))
        found.append(bytes([first, len(body)]) + body)
        found.append(bytes([first, 0]))
        found.append(bytes([first, 0xFF, 0xFF, 0xFF, 0x7F]) + chance.randbytes(1000))
        found.append(bytes([first, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF]))
    properties = b"\x26\0\0\0\0" * 100_000
    body = b"\0\1a\0\1" + b"\xa0\xc2\x1e" + properties
    found.append(b"\x32" + b"\xa8\xc2\x1e" + body)
    chance.shuffle(found)
    return found


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
async def test_a_hostile_broker_is_left_and_tried_again_with_few_words(
    protocol: str, caplog: pytest.LogCaptureFixture
) -> None:
    hostile = packets(random.Random(1))
    served = 0

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal served
        try:
            await reader.readuntil(b"MQTT")
            writer.write(CONNACK_5 if protocol == "5" else CONNACK_311)
            for packet in hostile[served : served + 60]:
                writer.write(packet)
            served += 60
            await writer.drain()
            await asyncio.sleep(0.05)
        except (OSError, asyncio.IncompleteReadError):
            pass
        finally:
            writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    longest_s = 0.0

    async def beat() -> None:
        nonlocal longest_s
        now_s = asyncio.get_running_loop().time
        while True:
            before_s = now_s()
            await asyncio.sleep(0.01)
            longest_s = max(longest_s, now_s() - before_s)

    beating = asyncio.create_task(beat())
    settings = Mqtt(host="127.0.0.1", port=port, protocol=protocol)
    async with Publisher(settings, "robot", drain_s=0.0):
        await until(lambda: served >= 300)
    beating.cancel()
    await asyncio.gather(beating, return_exceptions=True)
    server.close()
    assert longest_s < 5.0  # a bomb that is decoded takes most of a minute
    errors = [r for r in caplog.records if r.exc_info is not None]
    assert errors == []
    assert len([r for r in caplog.records if r.levelno >= logging.WARNING]) < 40


@pytest.mark.parametrize("qos", [0, 1])
async def test_a_message_without_a_topic_or_with_a_number_for_it_is_left_out(
    qos: int, caplog: pytest.LogCaptureFixture
) -> None:
    mid = b"\0\1" * qos
    # No property; a topic alias of 0, of 1, of 65535, none of which was ever allowed.
    properties = [b"\0", b"\3\x23\0\0", b"\3\x23\0\1", b"\3\x23\xff\xff"]
    bodies = [b"\0\0" + mid + one + b"{}" for one in properties] * 100
    connections = answered = 0

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal connections, answered
        connections += 1
        try:
            await packet(reader)
            writer.write(CONNACK_5)
            for body in bodies:
                writer.write(bytes([0x30 | qos << 1, len(body)]) + body)
            await writer.drain()
            kind, subscribe = await packet(reader)
            while kind != SUBSCRIBE:
                kind, subscribe = await packet(reader)
            writer.write(suback(subscribe))
            await reader.readuntil(b"online")
            answered += 1
            await reader.read()
        except (OSError, asyncio.IncompleteReadError):
            pass
        finally:
            writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with Publisher(Mqtt(host="127.0.0.1", port=port), "robot", drain_s=0.0):
        await until(lambda: connections > 1 or answered)
        assert (connections, answered) == (1, 1)
    server.close()
    said = [r for r in caplog.records if "an invalid topic was not read" in r.getMessage()]
    assert len(said) == 1
