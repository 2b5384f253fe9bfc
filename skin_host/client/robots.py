"""Which robot is meant when none is named."""

import asyncio

from skin_host.errors import RequestError
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import Connection
from skin_host.mqtt.topics import ONLINE

#: Retained messages come within this time of a subscription.
RETAINED_S = 0.5


async def only_robot(connection: Connection, broker: Broker, base: str) -> str:
    """Find the only robot below the base, by the status of its nodes.

    Of several the only one that is online: the broker remembers who has left.

    Raises:
        RequestError: there is none, or more than one.
    """
    prefix = f"{base}/"
    known: set[str] = set()
    online: set[str] = set()

    async def listen() -> None:
        async for message in connection.messages:
            robot = message.topic.value.removeprefix(prefix).partition("/")[0]
            known.add(robot)
            if message.payload == ONLINE:
                online.add(robot)

    everybody = f"{prefix}+/nodes/+/status"
    await connection.subscribe(everybody, qos=1)
    try:
        await asyncio.wait_for(listen(), RETAINED_S)
    except TimeoutError:
        await connection.unsubscribe(everybody)
    meant = online or known
    if not meant:
        raise RequestError(
            f'broker {broker}: no robot has published below "{base}"; is `skin run` running?'
        )
    if len(meant) > 1:
        names = ", ".join(sorted(meant)[:20])
        raise RequestError(
            f'broker {broker}: wanted one robot below "{base}", there are: {names}; name the robot'
        )
    return meant.pop()
