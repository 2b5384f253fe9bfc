"""MQTT publisher: one task that sends queued messages to the broker.

The acquisition is not affected if the broker is absent, frozen or lost, and messages that must
arrive are sent again. Frames are encoded only while there is a connection.
"""

import asyncio
import logging
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractAsyncContextManager, AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any, Self

import msgspec

from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Mqtt
from skin_host.errors import SkinError
from skin_host.fingertip.events import FingertipEvent, Over, Slip
from skin_host.mqtt.address import Broker, CredentialError
from skin_host.mqtt.commands import CommandHandler, Handler
from skin_host.mqtt.connection import (
    FIRST_RETRY_S,
    GOOD_S,
    TIMEOUT_S,
    Connection,
    Message,
    MessageProperties,
    MqttError,
    PackedProperties,
    Retry,
    UnansweredError,
    connect,
    explain,
    first_error,
    message_properties,
    within,
)
from skin_host.mqtt.courier import Courier, FrameForm, Suspect
from skin_host.mqtt.frames import load_cbor2
from skin_host.mqtt.info import (
    MAX_PIECES,
    NodeInfo,
    discovery,
    discovery_topics,
    encode_pieces,
)
from skin_host.mqtt.messages import ContactState, encode_contact, encode_health
from skin_host.mqtt.order import (
    Numbers,
    last_will,
    parts_of,
    put_parts,
    put_run,
    put_stamp,
    stamp_of,
    that_fit,
)
from skin_host.mqtt.outbox import Event, Outbox, PublisherCounters
from skin_host.mqtt.payload import CBOR_TYPE, JSON_TYPE
from skin_host.mqtt.topics import MAX_PART, OFFLINE, ONLINE, PartTopic, Topics
from skin_host.mqtt.trials import TRIES, Trials
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from skin_host.tasks import cancel, leave_if_cancelled

FRAME_EXPIRY_S = 1
#: A request of 64 KiB, with its topic and properties.
MAX_PACKET_BYTES = 80_000
#: So often the contact of a part is published again with its health, though it has not changed:
#: another node that had the part before, and ends or starts later, publishes that it is unknown.
CONTACT_AGAIN_S = 2.0
MAX_CORRELATION_BYTES = 1024
#: Waiting times after another daemon has taken this node's name, from the first to the longest.
FIRST_TAKEN_S = 2.0
LAST_TAKEN_S = 30.0
#: At most this many withheld topics are named.
MAX_NAMED = 8

_TOPICS: dict[type, PartTopic] = {Touch: "touch", Slip: "slip", Over: "over"}

#: Makes a connection to a broker, see `connection.connect`.
Connect = Callable[..., AbstractAsyncContextManager[Connection]]

_log = logging.getLogger(__name__)


class Publisher:
    """Publishes for one node. Use from the event loop's own thread:

        async with Publisher(settings.mqtt, settings.robot, "main") as publisher:
            publisher.put_frame(frame)

    Leaving the block sends waiting messages, for at most `drain_s`, and publishes `offline`.

    Args:
        settings: table `mqtt` of the configuration.
        robot: whose topics.
        node: the name of this daemon.
        handler: answers commands; without it, or with `mqtt.commands` off, none are taken.
        folder: where relative file names in `settings` start.
        drain_s: how long leaving may take.
        clock: for time and waiting.
        connect: makes the connections.

    Attributes:
        put_frame: sends a frame, unless a newer one of its part comes first. It must not change any
            more.
        together: at the end of a block with it, what was put is written: touches first, then
            frames.

    Raises:
        ConfigurationError: a name cannot be part of a topic, or a named file cannot be used.
        SkinError: frames in CBOR are requested and cbor2 is not installed.
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
        clock: Clock = SYSTEM,
        connect: Connect = connect,
    ) -> None:
        self._clock = clock
        self._connect = connect
        self.topics = Topics(settings.base, robot)
        self._name = f"{robot}/{node}"
        self._brokers = _addresses(settings, folder, self._name)
        self._broker = self._brokers[0]
        self._settings = settings
        self._folder = folder
        self._encoding = settings.encoding
        if self._encoding == "cbor":
            load_cbor2()
        self._node = node
        self._discovery_prefix = settings.discovery_prefix
        # No other node's: with dashes, node `b-c` of robot `a` would be node `c` of robot `a-b`.
        self._identifier = f"{settings.base}/{robot}/{node}"
        self._command_handler = CommandHandler(handler) if handler and settings.commands else None
        self._drain_s = drain_s
        self._status = self.topics.node("status", node)
        self._commands = self.topics.command(node, "+").removesuffix("/+")
        self._wanted = [self._status]
        if self._command_handler is not None:
            self._wanted.append(self.topics.command(node, "+"))
        #: Of these, those that the broker has acknowledged, and the one that waits for that.
        self._subscribed: set[str] = set()
        self._asked: str | None = None
        #: Of subscriptions, over which a broker may end the connection as over publications.
        self._trials = Trials(clock.monotonic_s)

        self._outbox = Outbox(settings.event_queue, settings.frame_hz, clock)
        self._outbox.put_state(self._status, ONLINE)
        self._states_of_contact: dict[str, ContactState] = {}
        self._contact_put_s: dict[str, float] = {}
        self._numbers = Numbers(clock.now_ns, clock.monotonic_ns)
        self._turn = 0  # index of the broker in use
        self._untried = len(self._brokers)
        self._last_broker: str | None = None
        #: What was sent over the last connection was of a run that subscribers take for an old one.
        self._overtakes = False
        self._info: NodeInfo | None = None
        self._pieces = 0
        #: Parts and fingertips of this node, and those of others in the configuration.
        self._parts: list[str] = []
        self._elsewhere: Collection[str] = ()
        #: Brokers at which the last will names no part.
        self._without_parts: set[str] = set()
        #: What an earlier configuration left at the broker, and the tries that remain.
        self._left: dict[str, int] = {}
        self._left_found = asyncio.Event()
        self._met_status = False
        self._name_taken_until_s = 0.0
        self._was_ended = False
        self._is_brief = False  # the last connection did not last
        self._closed_in_a_row = 0
        self._closing = asyncio.Event()
        self._connection: Connection | None = None
        self._task: asyncio.Task[None] | None = None

        self._courier = Courier(
            self._outbox,
            self.topics,
            self._status,
            FrameForm(self._encoding, None),
            self._state_properties,
            self._note_refusals,
            clock,
        )
        self.put_frame: Callable[[PressureFrame], None] = self._outbox.put_frame
        self.together: AbstractContextManager[None] = self._courier
        self._number_messages()

    def _number_messages(self) -> None:
        """Add the number of this run of the node to events and frames."""
        run = self._numbers.run
        events = message_properties(self._broker, JSON_TYPE)
        put_run(events, run)
        self._event_properties = PackedProperties.of(events)
        self._outbox.renumber(self._event_properties)
        cbor = self._encoding == "cbor"
        frames = message_properties(self._broker, CBOR_TYPE if cbor else JSON_TYPE, text=not cbor)
        if frames is not None:
            frames.MessageExpiryInterval = FRAME_EXPIRY_S
        put_run(frames, run)
        self._courier.use(FrameForm(self._encoding, PackedProperties.of(frames)))

    @property
    def counters(self) -> PublisherCounters:
        known, handler, connection = self._outbox.counters, self._command_handler, self._connection
        return msgspec.structs.replace(
            known,
            touches_waiting=self._outbox.touches_waiting(),
            withheld=[*self._outbox.trials.withheld, *self._courier.too_large][:MAX_NAMED],
            unsubscribed=self._unsubscribed(),
            name_taken=self._clock.monotonic_s() < self._name_taken_until_s,
            refused=known.refused + (connection.refused if connection else 0),
            commands_taken=handler.taken if handler else 0,
            commands_refused=known.commands_refused
            + (handler.refused if handler else 0)
            + (connection.discarded if connection else 0),
        )

    @property
    def frames_waiting(self) -> int:
        """How many frames have not been written: the newest of each part at most."""
        return len(self._outbox.frames)

    def skip_frame(self) -> None:
        """Count a frame that is not sent, because it was read so late."""
        self._outbox.counters.frames_skipped += 1

    def _unsubscribed(self) -> list[str]:
        if not self._outbox.counters.connected:
            return []
        return [topic for topic in self._wanted if topic not in self._subscribed]

    def put_info(self, info: NodeInfo, elsewhere: Collection[str] = ()) -> None:
        """Publish the description of this node; again whenever it changes.

        Args:
            info: the description.
            elsewhere: parts of other nodes of the same configuration.
        """
        self._info = info
        self._parts, self._elsewhere = [*info.parts, *info.fingertips], elsewhere
        self._publish_info()
        if self._discovery_prefix is not None:
            for topic, payload in discovery(self._discovery_prefix, self.topics, info).items():
                self._outbox.put_state(topic, payload)

    def _publish_info(self) -> None:
        """Publish the info in pieces that the broker takes, and delete superfluous pieces."""
        if self._info is None:
            return
        topic = self.topics.info(self._node, MAX_PIECES)
        room = None if self._connection is None else self._connection.room(topic)
        pieces = encode_pieces(self._info, room)
        for number, payload in enumerate(pieces, 1):
            self._outbox.put_state(self.topics.info(self._node, number), payload)
        for number in range(len(pieces) + 1, self._pieces + 1):
            self._outbox.put_state(self.topics.info(self._node, number), b"")
        self._pieces = max(self._pieces, len(pieces))

    def show_raw(self, seconds: float) -> None:
        """Send the boards' own bytes with the frames for this time; 0 ends it."""
        self._courier.show_raw(seconds)

    def put_touch(self, event: FingertipEvent) -> None:
        """Send a touch, slip or excess; those of a part arrive in order, and at least once."""
        topic = self.topics.part(_TOPICS[type(event)], event.part)
        self._outbox.put_touch(topic, event, self._event_properties)

    def put_contact(self, part: str, state: ContactState) -> None:
        """Publish whether a part is touched, if that has changed; `put_health` repeats it."""
        if self._states_of_contact.get(part) != state:
            self._states_of_contact[part] = state
            self._publish_contact(part, state)

    def _publish_contact(self, part: str, state: ContactState) -> None:
        self._contact_put_s[part] = self._clock.monotonic_s()
        self._outbox.put_state(self.topics.part("contact", part), encode_contact(state))

    def put_health(self, part: str, record: Any) -> None:
        """Publish the health of a part: a record with keys that JSON can hold."""
        self._outbox.put_state(self.topics.part("health", part), encode_health(record))
        state = self._states_of_contact.get(part)
        again_s = self._contact_put_s.get(part, 0.0) + CONTACT_AGAIN_S
        if state is not None and self._clock.monotonic_s() >= again_s:
            self._publish_contact(part, state)

    async def end_commands(self) -> None:
        """Cancel the commands that run, and refuse those that come from now on."""
        if self._command_handler is not None:
            await self._command_handler.end()

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
        await self.end_commands()
        if hopeful and self._outbox.pending:
            _log.warning(
                "stopped before the broker took the last state of %d topics",
                len(self._outbox.pending),
            )
        left = self._outbox.touches_waiting()
        if left:
            self._outbox.counters.touches_dropped += left
            _log.warning("stopped with %d touch events that the broker did not take", left)

    async def _run(self) -> None:
        retry = Retry(self._clock)
        clock = self._clock
        why: str | None = ""
        while True:
            since_s: float | None = None
            said, why = why, None
            try:
                # Read again for each connection: passwords and certificates may appear late and
                # change.
                self._brokers = await clock.in_thread(
                    Broker.all_from_settings, self._settings, self._folder, self._name
                )
                self._broker = self._brokers[self._turn % len(self._brokers)]
                self._numbers.connect()
                stamp = self._numbers.last_will if self._broker.v5 else None
                async with self._connect(
                    self._broker,
                    identifier=self._identifier,
                    will=last_will(self._status, OFFLINE, stamp, self._parts_in_will()),
                    max_packet=MAX_PACKET_BYTES,
                    clock=clock,
                ) as link:
                    since_s = clock.monotonic_s()
                    await self._talk(link)
                    properties = self._state_properties(self._status, OFFLINE)
                    await link.publish(
                        self._status, OFFLINE, qos=1, retain=True, properties=properties
                    )
            except* Exception as group:
                # No error may end the publishing.
                self._is_brief = since_s is not None and clock.monotonic_s() - since_s < GOOD_S
                if since_s is not None and not self._is_brief:
                    said = ""
                error = first_error(group)
                if isinstance(error, UnansweredError):
                    # A broker states its limit only in its answer: the next try is without them,
                    # and the one after it with them again.
                    self._without_parts ^= {str(self._broker)}
                why = self._note_loss(error, said, was_connected=since_s is not None)
            finally:
                self._forget_connection()
            leave_if_cancelled()
            if why is None or (self._closing.is_set() and not self._outbox.events):
                return
            up_s = 0.0 if since_s is None else clock.monotonic_s() - since_s
            wait_s = self._turn_on(up_s)
            if wait_s is None:
                wait_s = retry.delay_s(up_s)
            await clock.sleep(max(wait_s, self._give_way_s(up_s)))

    def _turn_on(self, up_s: float) -> float | None:
        """Select the next broker; return how long to wait, None after all have been tried."""
        self._turn += 1
        self._untried = (len(self._brokers) if up_s >= GOOD_S else self._untried) - 1
        if self._untried <= 0:
            self._untried = len(self._brokers)
            return None
        return self._clock.uniform(0.0, FIRST_RETRY_S)

    def _give_way_s(self, up_s: float) -> float:
        """How long to leave the name to another daemon that seems to have taken it.

        Not every broker gives a reason when it closes the older of two connections of one name.
        An end does not count if one thing alone waited for its answer, because that may be the
        reason; of the others such a reason causes no more than `TRIES` + 1 in a row.
        """
        ended, self._was_ended = self._was_ended, False
        self._closed_in_a_row = self._closed_in_a_row + 1 if ended and up_s < GOOD_S else 0
        over = self._closed_in_a_row - (TRIES + 1)
        if over <= 0:
            return 0.0
        self._name_taken_until_s = self._clock.monotonic_s() + 2 * LAST_TAKEN_S
        return min(FIRST_TAKEN_S * 2.0**over, LAST_TAKEN_S) * self._clock.uniform(0.5, 1.0)

    def _note_loss(self, error: BaseException, said: str | None, *, was_connected: bool) -> str:
        """Log in one line why there is no broker, unless that was logged last."""
        why = self._outbox.counters.last_error = explain(error)
        if why != said:
            what = "connection lost" if was_connected else "cannot connect"
            unknown = None if isinstance(error, MqttError | SkinError) else error
            _log.warning(
                "broker %s: %s: %s; trying again", self._broker, what, why, exc_info=unknown
            )
        return why

    async def _talk(self, connection: Connection) -> None:
        """Send and listen until the end of the publisher; an error means a lost broker."""
        self._connection = connection
        self._met_status = False
        # Who sees this node online may ask it at once: it listens first.
        later = await self._subscribe(connection)
        self._outbox.counters.connected = True
        self._outbox.counters.connections += 1
        if self._is_brief:
            # A broker that ends every connection would fill the log.
            self._clock.call_later(GOOD_S, self._note_connected, connection)
        else:
            self._note_connected(connection)
        self._publish_info()
        # The status makes valid what the broker retained of contacts, however old that is.
        contacts = (self.topics.part("contact", part) for part in self._states_of_contact)
        self._outbox.repeat_states([self._status, *contacts])
        if self._overtakes or self._last_broker not in (None, str(self._broker)):
            self._overtakes = False
            self._courier.repeat_events()
        self._last_broker = str(self._broker)
        async with asyncio.TaskGroup() as group:
            workers = [
                group.create_task(self._courier.carry(connection)),
                group.create_task(self._listen(connection)),
                group.create_task(connection.lost()),
                group.create_task(self._clear_left(connection)),
                group.create_task(self._subscribe_later(connection, later)),
            ]
            await self._closing.wait()
            await self._outbox.drained()
            await cancel(*workers)  # here, not at the end of the block: see `leave_if_cancelled`

    def _note_connected(self, connection: Connection) -> None:
        if connection is not self._connection:
            return
        _log.info("broker %s: connected", self._broker)
        named = min(len(self._parts_in_status()), len(self._parts_in_will()))
        if self._broker.v5 and named < len(self._parts):
            _log.warning(
                "broker %s: the status names only %d of its %d parts: packets have no room for "
                "more. When the configuration changes, what is retained of the others may stay",
                *(self._broker, named, len(self._parts)),
            )

    def _forget_connection(self) -> None:
        counters, connection = self._outbox.counters, self._connection
        counters.connected = False
        if connection is None:
            return
        counters.refused += connection.refused
        counters.commands_refused += connection.discarded
        self._connection = None
        self._subscribed.clear()
        suspect = self._courier.note_end(connection)
        asked, self._asked = self._asked, None
        if asked is not None and connection.ended_by_broker:
            suspect = Suspect(asked, self._trials.strike(asked))
            if suspect.found:
                self._trials.withhold(asked)
                self._name_reason(connection, f"we subscribe to: {asked}", "; given up")
        elif suspect is not None and suspect.found:
            # The status is not given up: every connection ends over it.
            is_status = suspect.topic == self._status
            what, then = f"this is published: {suspect.topic}", "" if is_status else "; given up"
            self._name_reason(connection, what, then, log=suspect.found == 1 or not is_status)
        self._was_ended = connection.taken_over or (connection.without_reason and suspect is None)

    def _name_reason(
        self, connection: Connection, what: str, then: str, *, log: bool = True
    ) -> None:
        """Name what the broker ends connections over, with the reason that it gives."""
        counters = self._outbox.counters
        given = "" if connection.without_reason else f": {counters.last_error}"
        counters.last_error = f"the broker ends the connection when {what}{given}"
        if log:
            _log.warning("broker %s: %s%s", self._broker, counters.last_error, then)

    def _note_refusals(self, connection: Connection) -> None:
        why = f"the broker refuses what we publish: {connection.refusal}"
        if connection.refused and why != self._outbox.counters.last_error:
            self._outbox.counters.last_error = why
            _log.warning("broker %s: %s; check its access rules", self._broker, why)

    def _state_properties(self, topic: str, payload: bytes) -> MessageProperties | None:
        kind = JSON_TYPE if payload.startswith(b"{") else "text/plain"
        properties = message_properties(self._broker, kind)
        is_online = topic == self._status and payload == ONLINE
        put_stamp(properties, self._numbers.online if is_online else self._numbers.state())
        if topic == self._status:
            put_parts(properties, self._parts_in_status())
        return properties

    def _parts_in_status(self) -> Sequence[str]:
        connection = self._connection
        return that_fit(self._parts, None if connection is None else connection.room(self._status))

    def _parts_in_will(self) -> Sequence[str]:
        return () if str(self._broker) in self._without_parts else that_fit(self._parts)

    async def _subscribe(self, connection: Connection) -> list[str]:
        """Subscribe to what a node listens to; return what is withheld."""
        withheld = [topic for topic in self._wanted if self._trials.withholds(topic)]
        for topic in self._wanted:
            if topic not in withheld and not await self._subscribe_to(topic, connection):
                break  # this broker answers none
        return withheld

    async def _subscribe_later(self, connection: Connection, topics: Sequence[str]) -> None:
        """Subscribe to what was withheld: the broker's rules may have changed."""
        for topic in topics:
            left_s = (self._trials.until_s(topic) or 0.0) - self._clock.monotonic_s()
            await self._clock.sleep(max(left_s, 0.0))
            await self._subscribe_to(topic, connection)

    async def _subscribe_to(self, topic: str, connection: Connection) -> bool:
        """Subscribe to a topic; return whether the broker answers, not whether it allows it.

        Raises:
            MqttError: the connection is lost.
        """
        self._asked = topic
        try:
            allowed = await connection.listen_to(topic)
        except MqttError as error:
            # A broker that is frozen does not answer this either.
            properties = self._state_properties(self._status, ONLINE)
            try:
                done = connection.send(
                    self._status, ONLINE, qos=1, retain=True, properties=properties
                )
            except MqttError:
                raise error from None
            self._asked = None
            await within(TIMEOUT_S, done)
            _log.warning(
                "broker %s: no commands are received: it does not acknowledge the subscription",
                self._broker,
            )
            return False
        self._asked = None
        self._trials.arrived(topic)
        if allowed:
            self._subscribed.add(topic)
        else:
            _log.warning("broker %s: may not subscribe to %s", self._broker, topic)
        return True

    def _note_left(self, parts: set[str]) -> None:
        """Note the parts of which this node published before, by another configuration."""
        left = sorted(parts.difference(self._parts)) if self._parts else []
        self._left |= dict.fromkeys(left, TRIES)
        self._left_found.set()

    async def _clear_left(self, connection: Connection) -> None:
        """Take back what an earlier configuration left at the broker: nobody knows what touches a
        part that this node no longer has.
        """
        self._left_found.set()
        while True:
            await self._left_found.wait()
            self._left_found.clear()
            for part in list(self._left):
                # A broker may end the connection over it.
                self._left[part] -= 1
                if self._left[part] < 0:
                    del self._left[part]
                    continue
                for topic, payload in self._states_left(part).items():
                    properties = self._state_properties(topic, payload)
                    sent = connection.send(
                        topic, payload, qos=1, retain=True, properties=properties
                    )
                    await within(TIMEOUT_S, sent)
                del self._left[part]

    def _states_left(self, part: str) -> dict[str, bytes]:
        states = {self.topics.part("contact", part): encode_contact("UNKNOWN")}
        if part not in self._elsewhere:  # no other node publishes these
            gone = [self.topics.part("health", part)]
            if self._discovery_prefix is not None:
                gone += discovery_topics(self._discovery_prefix, self.topics, part)
            states |= dict.fromkeys(gone, b"")
        return states

    async def _listen(self, connection: Connection) -> None:
        async for message in connection.messages:
            self._take(message)

    def _take(self, message: Message) -> None:
        topic = message.topic.value
        payload = message.payload if isinstance(message.payload, bytes) else b""
        if topic == self._status:
            # The last will of our earlier connection can arrive late, but we are online.
            if payload != ONLINE:
                self._outbox.put_state(self._status, ONLINE)
            if not self._met_status:  # the stored one; others may come from anybody
                self._met_status = True
                self._note_left(parts_of(message.properties))
            stamp = stamp_of(message.properties)
            if message.retain and stamp is not None and self._numbers.overtake(stamp):
                if self._connection is not None:
                    self._connection.cut()  # what follows would come before what is sent again
                self._number_messages()
                self._overtakes = True
                raise MqttError("an earlier run of this node had a clock that was ahead of ours")
            return
        commands, _, name = topic.rpartition("/")
        if self._command_handler is None or commands != self._commands:
            return  # brokers may send topics without a subscription
        if message.retain:
            self._command_handler.ignore_retained(topic)
            return
        reply_to: str = getattr(message.properties, "ResponseTopic", "")
        correlation: bytes = getattr(message.properties, "CorrelationData", b"")
        if not self.topics.may_reply_to(self._node, reply_to):
            # If the response topic is not allowed, the answer goes to the default result topic. It
            # would be longer than any with a name as long as a topic may be.
            reply_to = self.topics.result(self._node, name[:MAX_PART])
        if len(correlation) > MAX_CORRELATION_BYTES:
            correlation = b""
        self._command_handler.take(name, payload, partial(self._answer, reply_to, correlation))

    def _answer(self, topic: str, correlation: bytes, payload: bytes) -> None:
        properties = message_properties(self._broker, JSON_TYPE)
        if properties is not None and correlation:
            properties.CorrelationData = correlation
        self._outbox.put_event(Event(topic, payload, properties, is_touch=False))


def _addresses(settings: Mqtt, folder: Path, name: str) -> list[Broker]:
    """Return the configured brokers; a password that cannot be read yet is read later."""
    try:
        return Broker.all_from_settings(settings, folder, name)
    except CredentialError:
        without = msgspec.structs.replace(settings, username=None, password_file=None)
        return Broker.all_from_settings(without, folder, name)
