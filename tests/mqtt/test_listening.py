"""A node that says it is online already listens, whatever the broker's haste."""

import asyncio
from typing import Any

from skin_host.config.settings import Mqtt
from skin_host.mqtt.publisher import Publisher
from tests.support.packets import CONNACK, CONNECT, PUBLISH, SUBSCRIBE, packet, suback
from tests.support.waiting import until


async def obey(name: str, payload: bytes) -> dict[str, Any]:
    return {}


async def test_a_node_says_online_when_its_subscription_to_commands_is_acknowledged() -> None:
    seen: list[int] = []
    closed = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while True:
                kind, body = await packet(reader)
                seen.append(kind)
                if kind == CONNECT:
                    writer.write(CONNACK)
                elif kind == SUBSCRIBE:
                    writer.write(suback(body))
        except (OSError, asyncio.IncompleteReadError):
            writer.close()
            closed.set()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    settings = Mqtt(host="127.0.0.1", port=server.sockets[0].getsockname()[1])
    async with Publisher(settings, "robot", handler=obey, drain_s=0.0):
        await until(lambda: PUBLISH in seen)
    assert seen[:4] == [CONNECT, SUBSCRIBE, SUBSCRIBE, PUBLISH]
    server.close()
    await until(closed.is_set)
