"""How it is said: one task that takes what the daemon puts down to the broker.

The broker may be absent, dead, frozen or back: the acquisition does not feel it, and what
must arrive is sent again. Frames are encoded only while there is a connection.
"""

import asyncio
import logging
import time
from collections import deque
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

from skin_host.fingertip.events import OverEvent, SlipEvent
from skin_host.processing.contacts import TouchEvent
from skin_host.processing.pipeline import PressureFrame
from skin_host.publish.address import Broker
from skin_host.publish.commands import CommandDesk, Handler
from skin_host.publish.connection import (
    TIMEOUT_S,
    Connection,
    Message,
    MqttError,
    PackedProperties,
    Retry,
    Will,
    connect,
    explain,
    first_error,
    message_properties,
    within,
)
from skin_host.publish.frames import encode_frame, load_cbor2
from skin_host.publish.home_assistant import discovery
from skin_host.publish.info import NodeInfo, encode_info
from skin_host.publish.messages import encode_contact, encode_health
from skin_host.publish.outbox import Event, Outbox, PublisherCounters
from skin_host.publish.payload import CBOR_TYPE, JSON_TYPE
from skin_host.publish.topics import OFFLINE, ONLINE, Topics
from skin_host.settings import Mqtt

FRAME_EXPIRY_S = 1
#: What may be on its way to the broker unacknowledged. Together less than the 20 that
#: mosquitto and paho allow, so that touches never wait behind health.
TOUCH_WINDOW = 10
#: Frames that are encoded and written in one turn of the event loop.
FRAME_WINDOW = 8
RETAINED_WINDOW = 6
MAX_CORRELATION_BYTES = 1024

_log = logging.getLogger(__name__)


class _InFlight(NamedTuple):
    """A message on its way: done when it is acknowledged, which must be before `until_s`."""

    done: "asyncio.Future[None]"
    until_s: float


class Publisher:
    """Publishes for one node. Use from the event loop's own thread:

        async with Publisher(settings.mqtt, settings.robot, "main") as publisher:
            publisher.put_frame(frame)

    Leaving the block sends what waits, for at most `drain_s`, and says offline.

    Args:
        settings: table `mqtt` of the configuration.
        robot: whose topics.
        node: the name of this daemon.
        handler: answers commands; without it, or with `mqtt.commands` off, none are taken.
        folder: where relative file names in `settings` start.
        drain_s: how long leaving may take.

    Raises:
        ConfigurationError: a name cannot stand in a topic, or a named file cannot be used.
        SkinError: frames in CBOR are wanted and cbor2 is not installed.
    """

    def __init__(
        self,
        settings: Mqtt,
        robot: str,
        node: str = "main",
        *,
        handler: Handler | None = None,
        folder: Path = Path(),
        drain_s: float = 2.0,
    ) -> None:
        self.topics = Topics(settings.base, robot)
        self._broker = Broker.from_settings(settings, folder)
        self._encoding = settings.encoding
        if self._encoding == "cbor":
            load_cbor2()
        self._node = node
        self._discovery_prefix = settings.discovery_prefix
        self._identifier = f"skin-{robot}-{node}"
        self._desk = CommandDesk(handler) if handler and settings.commands else None
        self._drain_s = drain_s
        self._status = self.topics.node("status", node)

        self._outbox = Outbox(settings.event_queue, settings.frame_hz)
        self._outbox.put_state(self._status, ONLINE)
        self._raw_until_s = 0.0
        self._closing = asyncio.Event()
        self._connection: Connection | None = None
        self._task: asyncio.Task[None] | None = None

        cbor = self._encoding == "cbor"
        frame_type = CBOR_TYPE if cbor else JSON_TYPE
        properties = message_properties(self._broker, frame_type, text=not cbor)
        if properties is not None:
            properties.MessageExpiryInterval = FRAME_EXPIRY_S
        self._frame_properties = PackedProperties.of(properties)
        self._json_properties = PackedProperties.of(message_properties(self._broker, JSON_TYPE))
        self._text_properties = PackedProperties.of(message_properties(self._broker, "text/plain"))

    @property
    def counters(self) -> PublisherCounters:
        """What became of everything so far: a copy."""
        known, desk, connection = self._outbox.counters, self._desk, self._connection
        return replace(
            known,
            touches_waiting=self._outbox.touches_waiting(),
            refused=known.refused + (connection.refused if connection else 0),
            commands_taken=desk.taken if desk else 0,
            commands_refused=known.commands_refused
            + (desk.refused if desk else 0)
            + (connection.discarded if connection else 0),
        )

    def put_info(self, info: NodeInfo) -> None:
        """Say what this node is; again whenever that changes."""
        self._outbox.put_state(self.topics.node("info", self._node), encode_info(info))
        if self._discovery_prefix is not None:
            for topic, payload in discovery(self._discovery_prefix, self.topics, info).items():
                self._outbox.put_state(topic, payload)

    def put_frame(self, frame: PressureFrame) -> None:
        """Send a frame, if no newer one of its part comes first. It must not change any more."""
        self._outbox.put_frame(frame)

    def show_raw(self, seconds: float) -> None:
        """Send the boards' own bytes with the frames for so long; 0 ends it."""
        self._raw_until_s = time.monotonic() + seconds

    def put_touch(self, event: TouchEvent) -> None:
        """Send a touch event; those of a part arrive in order, and at least once."""
        topic = self.topics.part("touch", event.part)
        self._outbox.put_touch(topic, event, self._json_properties)

    def put_grasp(self, event: SlipEvent | OverEvent) -> None:
        """Send that a fingertip slips or presses too hard, as surely as a touch event."""
        kind: Literal["slip", "over"] = "slip" if isinstance(event, SlipEvent) else "over"
        topic = self.topics.part(kind, event.part)
        self._outbox.put_grasp(topic, event, self._json_properties)

    def put_contact(self, part: str, touched: bool) -> None:
        """Say whether a part is touched at all; nothing is sent if that is known already."""
        topic = self.topics.part("contact", part)
        payload = encode_contact(touched)
        if self._outbox.retained.get(topic) != payload:
            self._outbox.put_state(topic, payload)

    def put_health(self, part: str, record: Any) -> None:
        """Say how a part is: a record with keys that JSON can hold."""
        self._outbox.put_state(self.topics.part("health", part), encode_health(record))

    async def __aenter__(self) -> Self:
        self._task = asyncio.create_task(self._run(), name="mqtt publisher")
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._task is not None
        self._closing.set()
        hopeful = self._outbox.counters.connected or self._outbox.events
        await asyncio.wait([self._task], timeout=self._drain_s if hopeful else 0.0)
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        if self._desk is not None:
            await self._desk.close()
        left = self._outbox.touches_waiting()
        if left:
            self._outbox.counters.touches_dropped += left
            _log.warning("stopped with %d touch events that the broker did not take", left)

    async def _run(self) -> None:
        retry = Retry()
        loop = asyncio.get_running_loop()
        will = Will(self._status, OFFLINE, qos=1, retain=True)
        why: str | None = ""
        while True:
            since_s: float | None = None
            said, why = why, None
            try:
                async with connect(self._broker, identifier=self._identifier, will=will) as link:
                    since_s = loop.time()
                    said = ""
                    await self._talk(link)
                    await link.publish(
                        self._status, OFFLINE, qos=1, retain=True, properties=self._text_properties
                    )
            except* Exception as group:
                # Whatever it is, it must not end the publishing.
                why = self._note_loss(first_error(group), said, was_connected=since_s is not None)
            finally:
                self._forget_connection()
            if why is None or (self._closing.is_set() and not self._outbox.events):
                return
            await asyncio.sleep(retry.delay_s(0.0 if since_s is None else loop.time() - since_s))

    def _note_loss(self, error: BaseException, said: str | None, *, was_connected: bool) -> str:
        """Say in one line why there is no broker, unless that was `said` already."""
        why = self._outbox.counters.last_error = explain(error)
        if why != said:
            what = "connection lost" if was_connected else "cannot connect"
            unknown = None if isinstance(error, MqttError) else error
            _log.warning(
                "broker %s: %s: %s; trying again", self._broker, what, why, exc_info=unknown
            )
        return why

    async def _talk(self, connection: Connection) -> None:
        """Send and listen until the end of the publisher; an error says that the broker is lost."""
        self._connection = connection
        self._outbox.counters.connected = True
        self._outbox.counters.connections += 1
        _log.info("broker %s: connected", self._broker)
        self._outbox.repeat_states()
        async with asyncio.TaskGroup() as group:
            workers = [
                group.create_task(self._send_retained(connection)),
                group.create_task(self._send_events(connection)),
                group.create_task(self._send_frames(connection)),
                group.create_task(self._listen(connection)),
            ]
            await self._closing.wait()
            await self._outbox.drained()
            for worker in workers:
                worker.cancel()

    def _forget_connection(self) -> None:
        counters, connection = self._outbox.counters, self._connection
        counters.connected = False
        self._outbox.drop_frames()
        if connection is not None:
            counters.refused += connection.refused
            counters.commands_refused += connection.discarded
            self._connection = None

    async def _send_frames(self, connection: Connection) -> None:
        outbox = self._outbox
        while True:
            await outbox.frames_put.wait()
            outbox.frames_put.clear()
            while outbox.frames:
                raw = time.monotonic() < self._raw_until_s
                for _ in range(min(FRAME_WINDOW, len(outbox.frames))):
                    frame = outbox.take_frame()
                    payload = encode_frame(frame, self._encoding, raw=raw)
                    topic = self.topics.part("frame", frame.part)
                    written = connection.send(topic, payload, properties=self._frame_properties)
                    outbox.counters.frames_sent += 1
                await within(TIMEOUT_S, written)

    async def _send_events(self, connection: Connection) -> None:
        """Send the queue in order. What was not acknowledged stays and is sent again."""
        outbox = self._outbox
        in_flight: deque[_InFlight] = deque()  # of the first events in the queue
        now_s = asyncio.get_running_loop().time
        outbox.events_put.set()
        while True:
            try:
                async with asyncio.timeout_at(in_flight[0].until_s if in_flight else None):
                    await outbox.events_put.wait()
            except TimeoutError:
                await within(0.0, in_flight[0].done)
            outbox.events_put.clear()
            while in_flight and in_flight[0].done.done():
                in_flight.popleft()
                outbox.event_sent()
            news = False
            while len(in_flight) < min(len(outbox.events), TOUCH_WINDOW):
                event = outbox.events[len(in_flight)]
                done = connection.send(
                    event.topic, event.payload, qos=1, properties=event.properties
                )
                done.add_done_callback(lambda _: outbox.events_put.set())
                in_flight.append(_InFlight(done, now_s() + TIMEOUT_S))
                news = True
            if news:
                connection.flush()  # a touch is not to wait for the frames to be encoded

    async def _send_retained(self, connection: Connection) -> None:
        outbox = self._outbox
        while True:
            await outbox.retained_put.wait()
            outbox.retained_put.clear()
            while states := outbox.take_states(RETAINED_WINDOW):
                for done in [self._send_state(connection, *state) for state in states.items()]:
                    await within(TIMEOUT_S, done)
                outbox.states_sent(states)
                self._note_refusals(connection)

    def _send_state(
        self, connection: Connection, topic: str, payload: bytes
    ) -> "asyncio.Future[None]":
        json = payload.startswith(b"{")
        properties = self._json_properties if json else self._text_properties
        return connection.send(topic, payload, qos=1, retain=True, properties=properties)

    def _note_refusals(self, connection: Connection) -> None:
        why = f"the broker refuses what we publish: {connection.refusal}"
        if connection.refused and why != self._outbox.counters.last_error:
            self._outbox.counters.last_error = why
            _log.warning("broker %s: %s; check its access rules", self._broker, why)

    async def _listen(self, connection: Connection) -> None:
        wanted = [self._status]
        if self._desk is not None:
            wanted.append(self.topics.command(self._node, "+"))
        for topic in wanted:
            if not await connection.listen_to(topic):
                _log.warning("broker %s: may not subscribe to %s", self._broker, topic)
        async for message in connection.messages:
            self._take(message)

    def _take(self, message: Message) -> None:
        topic = message.topic.value
        payload = message.payload if isinstance(message.payload, bytes) else b""
        if topic == self._status:
            # The last will of an earlier connection of ours can come late. We are here.
            if payload != ONLINE:
                self._outbox.put_state(self._status, ONLINE)
            return
        # A request that a broker kept for us was not meant for now.
        if self._desk is None or message.retain:
            return
        name = topic.rpartition("/")[2]
        reply_to: str = getattr(message.properties, "ResponseTopic", "")
        correlation: bytes = getattr(message.properties, "CorrelationData", b"")
        if not self.topics.may_reply_to(self._node, reply_to):
            # Who wants the answer where it may not go finds it where all others look.
            reply_to = self.topics.result(self._node, name)
        if len(correlation) > MAX_CORRELATION_BYTES:
            correlation = b""
        self._desk.take(name, payload, partial(self._answer, reply_to, correlation))

    def _answer(self, topic: str, correlation: bytes, payload: bytes) -> None:
        properties = message_properties(self._broker, JSON_TYPE)
        if properties is not None and correlation:
            properties.CorrelationData = correlation
        self._outbox.put_event(Event(topic, payload, properties, is_touch=False))
