"""A subscriber of touches in a process of its own, and plain messages to compare with.

Both benchmarks of the whole daemon use it: the delay of a message is the time at which it was
received less its `t_ns`. All processes share one clock.
"""

import asyncio
import json
import time
from collections import defaultdict
from multiprocessing.connection import Connection

import aiomqtt

#: Messages of another program: so far apart, and about as long as a touch.
PLAIN_S = 0.028
PLAIN_TOPIC = "skin/bench/plain/touch"
_PLAIN_BYTES = 300


def listen(parent: Connection, broker_port: int, nodes: int = 1) -> None:
    """Process: report to the parent that all nodes are calibrated; then collect delays for it."""
    asyncio.run(_collect(parent, broker_port, nodes))


async def _collect(parent: Connection, broker_port: int, nodes: int) -> None:
    delays_ns: defaultdict[str, list[int]] = defaultdict(list)

    def answer() -> None:
        parent.recv()
        parent.send(dict(delays_ns))
        delays_ns.clear()

    asyncio.get_running_loop().add_reader(parent.fileno(), answer)
    calibrated: set[str] = set()
    async with aiomqtt.Client("127.0.0.1", broker_port, timeout=10.0) as client:
        await client.subscribe("skin/bench/+/touch", qos=1)
        await client.subscribe("skin/bench/nodes/+/info", qos=1)
        async for message in client.messages:
            now_ns = time.time_ns()
            document = json.loads(message.payload)
            if "event" in document:
                delays_ns[str(message.topic)].append(now_ns - document["t_ns"])
            elif len(calibrated) < nodes and document["calibration"] is not None:
                calibrated.add(str(message.topic))
                if len(calibrated) == nodes:
                    parent.send(None)


async def collected(listener: Connection) -> dict[str, list[int]]:
    """The delays (ns) of messages that the subscriber received since the last query, by topic."""
    listener.send(None)
    delays_ns: dict[str, list[int]] = await asyncio.to_thread(listener.recv)
    return delays_ns


async def publish_plain(broker_port: int, seconds: float) -> None:
    """Publish messages with their time of sending, as a touch has it."""
    filling = "-" * _PLAIN_BYTES
    async with aiomqtt.Client("127.0.0.1", broker_port, timeout=10.0) as client:
        for _ in range(round(seconds / PLAIN_S)):
            document = {"event": "plain", "t_ns": time.time_ns(), "filling": filling}
            await client.publish(PLAIN_TOPIC, json.dumps(document), qos=1)
            await asyncio.sleep(PLAIN_S)
