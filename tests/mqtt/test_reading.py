"""What a broker has sent is read at once, however late the program comes to it."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import Connection, connect
from tests.support.packets import packet_with_flags
from tests.support.waiting import PATIENCE_S

ACCEPTED = b"\x20\x03\x00\x00\x00"


def published(number: int) -> bytes:
    """A message of the topic `t` with a number of four bytes."""
    return b"\x30\x08\x00\x01t\x00" + number.to_bytes(4, "big")


@asynccontextmanager
async def sent_at_once(messages: int, max_incoming: int) -> AsyncIterator[Connection]:
    """A connection to a broker that sends so many messages together."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            await packet_with_flags(reader)
            writer.write(ACCEPTED + b"".join(map(published, range(messages))))
            await reader.read()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    address = Broker("127.0.0.1", server.sockets[0].getsockname()[1])
    try:
        async with connect(address, max_incoming=max_incoming) as made:
            yield made
    finally:
        server.close()


async def test_all_messages_that_have_come_are_read_in_one_turn() -> None:
    """A program that computes between two turns would fall behind, and never know it."""
    async with sent_at_once(300, 10_000) as link:
        first = await asyncio.wait_for(anext(link.messages), PATIENCE_S)
        numbers = [first.payload, *(other.payload for other in link.waiting())]
        assert numbers == [number.to_bytes(4, "big") for number in range(300)]


@pytest.mark.parametrize("max_incoming", [1, 8])
async def test_no_more_are_read_than_have_room(max_incoming: int) -> None:
    async with sent_at_once(100, max_incoming) as link:
        await asyncio.wait_for(anext(link.messages), PATIENCE_S)
        assert len(list(link.waiting())) <= max_incoming
