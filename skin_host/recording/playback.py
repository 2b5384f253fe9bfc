"""Plays recordings again: onto a CAN interface, or to a broker and so into the live page."""

import asyncio
import contextlib
import itertools
import secrets
import time
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import can

from skin_host import __version__
from skin_host.bus.port import ERROR_FLAG, REMOTE_FLAG
from skin_host.bus.wire import FrameBatch
from skin_host.client import SkinClient
from skin_host.client.links import FIRST_RETAINED_S, RETAINED_S
from skin_host.config.settings import Mqtt, Settings, changed, skin_hash
from skin_host.errors import BrokerError, BusError, LogError, RequestError
from skin_host.fingertip.service import FingertipPublisher
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import Connection, MqttError, connect, explain
from skin_host.mqtt.info import node_info
from skin_host.mqtt.order import last_will
from skin_host.mqtt.outbox import BACKLOG
from skin_host.mqtt.publisher import Publisher
from skin_host.mqtt.topics import OFFLINE
from skin_host.processing.core import Engine, Output
from skin_host.recording.capture import message_at
from skin_host.recording.mcap import read_messages_of, robot_at
from skin_host.recording.replay import contacts_of, read_buses, timed

LONGEST_PAUSE_S = 600.0
RETAINED = ("status", "info", "contact", "health")
#: The node as which frames of CAN are played under another robot's name, with all of its parts.
NODE = "main"
#: Each node that is played has a connection of its own, because a connection has one last will:
#: that of a playback which is killed leaves no node online. No robot has as many.
MAX_NODES = 64
#: How long to wait for a broker.
PATIENCE_S = 5.0
#: How long the broker may take for the last messages.
DRAIN_S = 10.0
#: So many events may wait for the broker; from about twice as many on, moves are replaced.
MOST_EVENTS = BACKLOG // 2
#: How often a broker that is slow is looked after.
LOOK_S = 0.001
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


async def refuse_live(broker: Broker, base: str, robot: str) -> None:
    """Refuse to play as a robot of which a node is online at the broker.

    Its subscribers would take what was recorded for what touches it now.

    Raises:
        RequestError: a node is online, or no robot can have this name.
        BrokerError: the broker cannot be reached.
    """
    loop = asyncio.get_running_loop()
    async with SkinClient(broker, robot=robot, base=base, patience_s=PATIENCE_S) as skin:
        until_s = loop.time() + FIRST_RETAINED_S
        known = False
        while loop.time() < until_s:
            for name, node in skin.nodes.items():
                if node.online:
                    raise RequestError(
                        f'robot "{robot}" is live at broker {broker}, its node "{name}" is '
                        "online: play the recording under another name with --robot NAME"
                    )
            if not known and any(node.online is False for node in skin.nodes.values()):
                known, until_s = True, loop.time() + RETAINED_S
            await asyncio.sleep(0.02)


def _identifier() -> str:
    """Return a name at the broker that no daemon and no other playback has."""
    return f"skin-playback-{secrets.token_hex(4)}"


async def play_messages(
    recording: Path, broker: Broker, speed: float = 1.0, robot: str | None = None
) -> int:
    """Publish the messages of an MCAP recording again, byte for byte; return how many.

    `robot` is a name in place of the recorded one, so that a live robot is not disturbed.

    Raises:
        LogError: the recording cannot be read, holds no messages, is of several robots that
            would get one name, or of more than `MAX_NODES` nodes.
        RequestError: the robot is live at this broker.
        BrokerError: the broker cannot be reached, is lost, or does not take a message.
    """
    messages = iter(read_messages_of(recording))
    first = next(messages, None)
    if first is None:
        raise LogError(f"{recording}: holds no messages; it was recorded from a bus alone")
    # Before the first is due, which would delay all others.
    base, name = _whose(first.topic)
    await refuse_live(broker, base, robot or name)
    free = {(base, robot or name)}
    #: The connections of nodes by the topics of their status, which are also their last wills.
    nodes: dict[str, Connection] = {}
    n = 0
    try:
        async with contextlib.AsyncExitStack() as stack:
            common = await stack.enter_async_context(connect(broker, identifier=_identifier()))
            all_of_them = itertools.chain([first], messages)
            async for said in paced(all_of_them, lambda said: said.t_ns, speed):
                recorded = _whose(said.topic)
                if robot is not None and recorded != (base, name):
                    raise LogError(
                        f"{recording}: holds messages of {base}/{name} and of "
                        f"{'/'.join(recorded)}; without --robot they are played as themselves"
                    )
                topic = said.topic if robot is None else _renamed(said.topic, robot)
                if (whose := _whose(topic)) not in free:
                    await refuse_live(broker, *whose)
                    free.add(whose)
                kind = topic.rpartition("/")[2]
                if kind == "status" and topic not in nodes:
                    if len(nodes) == MAX_NODES:
                        raise LogError(
                            f"{recording}: holds the status of more than {MAX_NODES} nodes; split "
                            "it, e.g. with `mcap filter`"
                        )
                    nodes[topic] = await stack.enter_async_context(_node(broker, topic))
                await nodes.get(topic, common).publish(
                    topic, said.payload, qos=0 if kind == "frame" else 1, retain=kind in RETAINED
                )
                n += 1
    except MqttError as error:
        raise BrokerError(
            f"broker {broker}: {explain(error)}; {n} messages were delivered"
        ) from None
    connections = [common, *nodes.values()]
    refused = sum(connection.refused for connection in connections)
    if refused:
        why = next(connection.refusal for connection in connections if connection.refused)
        raise BrokerError(f"broker {broker}: refuses {refused} of {n} messages: {why}")
    return n


@contextlib.asynccontextmanager
async def _node(broker: Broker, status: str) -> AsyncIterator[Connection]:
    """Connect as a node that is played, for its status: it is `offline` afterwards, however that
    ends, because a recording that was played is over.

    Raises:
        MqttError: there is no connection.
    """
    will = last_will(status, OFFLINE, None)
    async with connect(broker, identifier=_identifier(), will=will) as connection:
        try:
            yield connection
        finally:
            await connection.publish(status, OFFLINE, qos=1, retain=True)


def _whose(topic: str) -> tuple[str, str]:
    """Return base and robot of a topic."""
    words = topic.split("/")
    at = robot_at(words)
    return "/".join(words[:at]), words[at]


def _renamed(topic: str, robot: str) -> str:
    """Return the same topic for another robot: skin/<robot>/... with any base."""
    words = topic.split("/")
    words[robot_at(words)] = robot
    return "/".join(words)


def played_as(settings: Settings, robot: str) -> Settings:
    """Return the settings with which a recording is played as another robot: of one node."""
    return changed(
        settings,
        {"robot": robot}
        | {f"parts.{name}.node": NODE for name in settings.parts}
        | {f"fingertips.{name}.node": NODE for name in settings.fingertips},
    )


class Played(NamedTuple):
    """How much was played: frames of pressure, and of these and of events what was delivered."""

    frames: int
    frames_sent: int
    events_sent: int


async def play_processed(
    log: Path, engine: Engine, settings: Settings, broker: Broker, speed: float = 1.0
) -> Played:
    """Process a recording of CAN frames with the pipeline and publish the results as a daemon.

    The engine is calibrated already. Of the table `mqtt` of the settings the form of the messages
    counts, not the broker. A broker that is slower than the recording delays it, so that no frame
    is replaced by a newer one. Contacts that last at the end of the recording are ended.

    Raises:
        LogError: the recording cannot be read.
        BrokerError: the broker cannot be reached, or has not taken everything.
    """
    n = last_ns = 0
    of = engine.layout.parts
    engine.touch_only = {i for i in engine.parts if not settings.parts[of[i].name].frames}
    publisher = _publisher(settings.mqtt, engine.layout.robot, broker)
    async with publisher:
        await _connected(publisher, broker)
        trouble = publisher.counters.last_error
        publisher.put_info(
            node_info(
                engine.layout,
                NODE,
                version=__version__,
                configuration=skin_hash(settings),
                encoding=settings.mqtt.encoding,
                frame_hz=settings.mqtt.frame_hz,
                commands=False,
                parts=settings.parts,
                fingertips=settings.fingertips,
            )
        )

        fingertips = FingertipPublisher(engine.fingertips, publisher)
        contacts = contacts_of(engine)

        async def publish(output: Output) -> int:
            fingertips.deliver(output.grasps)
            frames = 0
            for step in output.steps:
                if step.part not in engine.touch_only:
                    publisher.put_frame(step.frame)
                    frames += 1
                for event in step.events:
                    publisher.put_touch(event)
                state = contacts[step.part].step(step.frame, step.events)
                publisher.put_contact(step.frame.part, state)
                await _taken(publisher)
            return frames

        def end() -> None:
            for part, contact in contacts.items():
                events = engine.end_part(part, last_ns)
                for event in events:
                    publisher.put_touch(event)
                publisher.put_contact(engine.layout.parts[part].name, contact.stop(events))
            fingertips.end(last_ns)

        try:
            async for t_ns, output in paced(timed(log, engine), lambda one: one[0], speed):
                last_ns = t_ns
                n += await publish(output)
        finally:
            end()
    counters = publisher.counters
    played = Played(n, counters.frames_sent, counters.touches_sent)
    losses = {
        "touch events lost": counters.touches_dropped,
        "messages refused": counters.refused,
        "messages that it does not take": counters.rejected,
    }
    lost = counters.frames_skipped or any(losses.values())
    if lost or counters.last_error != trouble:
        withheld = ", ".join(counters.withheld)
        why = counters.last_error or (
            f"it does not take {withheld}" if withheld else "it is too slow"
        )
        told = [f"{count} {what}" for what, count in losses.items() if count]
        raise BrokerError(
            f"broker {broker}: not everything was taken: {why}; sent were {played.frames_sent} of "
            f"{n} frames and {played.events_sent} touch events"
            + (f"; {', '.join(told)}" if told else "")
        )
    return played


async def _taken(publisher: Publisher) -> None:
    """Wait until there is room for more: a recording's time is its own.

    A broker that is lost is not waited for.
    """
    await asyncio.sleep(0.0)  # what was put is written in a turn of the loop
    while publisher.counters.connected and (  # noqa: ASYNC110
        publisher.frames_waiting or publisher.counters.touches_waiting > MOST_EVENTS
    ):
        await asyncio.sleep(LOOK_S)


def _publisher(settings: Mqtt, robot: str, broker: Broker) -> Publisher:
    """Return a publisher to this broker, by another client identifier than a daemon's.

    A broker has one client of each identifier: a daemon and a playback would end each other's
    connections.
    """

    def connect_there(_: Broker, **options: Any) -> AbstractAsyncContextManager[Connection]:
        return connect(broker, **(options | {"identifier": _identifier()}))

    there = {"host": broker.host, "port": broker.port, "protocol": broker.protocol}
    alone: dict[str, Any] = {"brokers": [], "tls": False, "commands": False}
    # User, password and TLS are the URL's.
    files = ("username", "password_file", "ca_file", "certificate_file", "key_file")
    mqtt = changed(settings, there | alone | dict.fromkeys(files))
    return Publisher(mqtt, robot, NODE, drain_s=DRAIN_S, connect=connect_there)


async def _connected(publisher: Publisher, broker: Broker) -> None:
    """Wait until the broker is there: frames before that would be lost.

    Raises:
        BrokerError: it is not.
    """
    try:
        async with asyncio.timeout(PATIENCE_S):
            while not publisher.counters.connected:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
    except TimeoutError:
        why = publisher.counters.last_error or "it does not answer"
        raise BrokerError(f"broker {broker}: cannot connect: {why}; nothing was played") from None
