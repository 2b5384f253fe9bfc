"""A link of a client to its broker ends when it is asked to, whatever the broker does then."""

import asyncio
from collections.abc import Sequence
from typing import Any

import pytest

from skin_host.client.links import BrokerLink
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import Connection, Message
from tests.support.packets import CONNACK, CONNECT, SUBSCRIBE, packet
from tests.support.waiting import PATIENCE_S


class _Deaf:
    """A hearer that wants one topic."""

    async def prepare(self, connection: Connection, broker: Broker) -> None:
        """Nothing must be known."""

    def wanted(self) -> Sequence[str]:
        return ["skin/+/nodes/+/status"]

    def take(self, link: BrokerLink, message: Message) -> None:
        """Nothing comes."""

    def unfollow(self, topic: str) -> None:
        """Nothing is."""

    def note(self, link: BrokerLink) -> None:
        """Links come and go."""


@pytest.mark.parametrize("last", [CONNECT, SUBSCRIBE], ids=["connecting", "subscribing"])
async def test_a_link_ends_that_is_cancelled_as_its_broker_leaves(
    monkeypatch: pytest.MonkeyPatch, last: int
) -> None:
    """Ctrl-C reaches client and broker at one moment: the error took the cancellation's place,
    and the link tried again for ever.
    """

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while (await packet(reader))[0] != last:
            writer.write(CONNACK)
        writer.close()

    notice = Connection._on_disconnect

    def cancelled_too(connection: Connection, *arguments: Any) -> None:
        notice(connection, *arguments)
        running.cancel()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        link = BrokerLink(0, Broker("127.0.0.1", port), "link", _Deaf())
        with monkeypatch.context() as patch:
            patch.setattr(Connection, "_on_disconnect", cancelled_too)
            running = asyncio.create_task(link.run())
            ended, _ = await asyncio.wait([running], timeout=PATIENCE_S / 10)
            patch.undo()
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
    assert ended
