"""The few packets of MQTT 5 that a broker of a dozen lines needs."""

import asyncio

CONNECT, PUBLISH, SUBSCRIBE = 1, 3, 8
CONNACK = bytes([0x20, 3, 0, 0, 0])


async def packet(reader: asyncio.StreamReader) -> tuple[int, bytes]:
    """The type of the next packet and what follows its length."""
    first, rest = await packet_with_flags(reader)
    return first >> 4, rest


async def packet_with_flags(reader: asyncio.StreamReader) -> tuple[int, bytes]:
    """The first byte of the next packet, type and flags, and what follows its length."""
    first = (await reader.readexactly(1))[0]
    length = shift = 0
    while True:
        byte = (await reader.readexactly(1))[0]
        length |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return first, await reader.readexactly(length)


def suback(subscribe: bytes) -> bytes:
    """The acknowledgement of a subscription to one topic with QoS 1."""
    return bytes([0x90, 4]) + subscribe[:2] + b"\0\1"
