"""Plays recordings again: onto a CAN interface, or to a broker and so into the live page."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

import can

from skin_host import __version__
from skin_host.bus.port import ERROR_FLAG, REMOTE_FLAG
from skin_host.bus.wire import FrameBatch
from skin_host.config.settings import Settings, skin_hash
from skin_host.errors import BusError, LogError
from skin_host.fingertip.service import FingertipPublisher
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import connect
from skin_host.mqtt.contact import PartContact
from skin_host.mqtt.info import node_info
from skin_host.mqtt.publisher import Publisher
from skin_host.mqtt.topics import OFFLINE
from skin_host.processing.core import Engine, Output
from skin_host.recording.capture import message_at
from skin_host.recording.mcap import read_messages_of
from skin_host.recording.replay import read_buses

LONGEST_PAUSE_S = 600.0
RETAINED = ("status", "info", "contact", "health")
_NO_DATA = ERROR_FLAG | REMOTE_FLAG

T = TypeVar("T")


async def paced(items: Iterable[T], t_ns: Callable[[T], int], speed: float) -> AsyncIterator[T]:
    """Yield the items at their own pace times `speed`; late items follow at once.

    A longer pause than `LONGEST_PAUSE_S`, or time that goes back, is a clock that was set.
    """
    start: tuple[float, int] | None = None
    last_ns = 0
    for item in items:
        now_s, item_ns = time.monotonic(), t_ns(item)
        if start is None or not -1e9 < item_ns - last_ns < LONGEST_PAUSE_S * 1e9:
            start = now_s, item_ns
        last_ns = item_ns
        due_s = start[0] + (item_ns - start[1]) * 1e-9 / speed
        await asyncio.sleep(max(0.0, due_s - now_s))
        yield item


def _last_ns(item: tuple[str, FrameBatch]) -> int:
    return int(item[1].t_ns[-1])


async def play_on_buses(
    log: Path, settings: Settings, buses: Mapping[str, can.BusABC], speed: float = 1.0
) -> int:
    """Send the data frames of a recording onto CAN; return how many.

    `buses` are open ones by their names in the settings, whose channels are the recording's.
    `speed` 2 is twice as fast as recorded.

    Raises:
        LogError: the recording cannot be read.
        BusError: a bus does not take the frames.
    """
    sent = 0

    async for name, batch in paced(read_buses(log, settings), _last_ns, speed):
        for row in range(len(batch)):
            if batch.id[row] & _NO_DATA:
                continue
            try:
                # A full queue of the interface is waited for, off the loop.
                await asyncio.to_thread(buses[name].send, message_at(batch, row), 1.0)
            except can.CanError as error:
                raise BusError(f'bus "{name}": cannot send: {error}') from None
            sent += 1
    return sent


async def play_messages(
    recording: Path, broker: Broker, speed: float = 1.0, robot: str | None = None
) -> int:
    """Publish the messages of an MCAP recording again, byte for byte; return how many.

    `robot` is a name in place of the recorded one, so that a live robot is not disturbed.

    Raises:
        LogError: the recording cannot be read, or holds no messages.
        MqttError: the broker cannot be reached, or is lost.
    """
    nodes: set[str] = set()
    n = 0
    async with connect(broker, identifier="skin-play") as connection:
        try:
            async for said in paced(read_messages_of(recording), lambda said: said.t_ns, speed):
                topic = said.topic if robot is None else _renamed(said.topic, robot)
                kind = topic.rpartition("/")[2]
                if kind == "status":
                    nodes.add(topic)
                await connection.publish(
                    topic, said.payload, qos=0 if kind == "frame" else 1, retain=kind in RETAINED
                )
                n += 1
        finally:
            # A recording that was played is over, and its nodes must not look alive.
            for topic in nodes:
                await connection.publish(topic, OFFLINE, qos=1, retain=True)
    if not n:
        raise LogError(f"{recording}: holds no messages; it was recorded from a bus alone")
    return n


def _renamed(topic: str, robot: str) -> str:
    """Return the same topic for another robot: skin/<robot>/... with any base."""
    words = topic.split("/")
    # Before the end stand <robot>/<part>/<kind>, or <robot>/nodes/<node>/<kind>, or, of an info in
    # pieces, <robot>/nodes/<node>/<piece>/info.
    at = -4 if words[-3] == "nodes" else -5 if words[-4:-3] == ["nodes"] else -3
    words[at] = robot
    return "/".join(words)


async def play_processed(log: Path, engine: Engine, settings: Settings, speed: float = 1.0) -> int:
    """Process a recording of CAN frames with the pipeline and publish the results.

    The engine is calibrated already; the table `mqtt` of the settings gives the broker.

    Raises:
        LogError: the recording cannot be read.
    """
    n = 0
    async with Publisher(settings.mqtt, engine.layout.robot) as publisher:
        publisher.put_info(
            node_info(
                engine.layout,
                "main",
                version=__version__,
                configuration=skin_hash(settings),
                encoding=settings.mqtt.encoding,
                commands=False,
                fingertips=settings.fingertips,
            )
        )

        fingertips = FingertipPublisher(engine.fingertips, publisher)
        contacts = {part: PartContact(engine.layout, part) for part in engine.parts}

        def publish(output: Output) -> int:
            fingertips.deliver(output.grasps)
            for step in output.steps:
                publisher.put_frame(step.frame)
                for event in step.events:
                    publisher.put_touch(event)
                state = contacts[step.part].step(step.frame, step.events)
                publisher.put_contact(step.frame.part, state)
            return len(output.steps)

        async for bus, batch in paced(read_buses(log, settings), _last_ns, speed):
            n += publish(engine.feed(bus, batch))
        n += publish(engine.flush())
    return n
