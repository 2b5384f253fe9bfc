"""Sends the content of an outbox over one connection after the other.

Frames are encoded and written right after the turn of the event loop that produced them: touches
first, then all frames of that turn in one write. While the socket is full they stay in the outbox,
where a newer frame of a part replaces the one before, which is counted.

Messages that were in flight when the broker ended a connection are sent one at a time over the
next: if one of them is the reason, it is found after `trials.TRIES`, counted and named. An event is
dropped then; states and frames of its topic are withheld for a while. Without the status nothing
is sent: who sees no node online must not see its contacts.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from itertools import islice
from typing import Literal, NamedTuple

from skin_host.clock import SYSTEM, Clock
from skin_host.mqtt.commands import shortened
from skin_host.mqtt.connection import (
    TIMEOUT_S,
    Connection,
    MessageProperties,
    MqttError,
    PackedProperties,
    within,
)
from skin_host.mqtt.frames import encode_frame
from skin_host.mqtt.outbox import Outbox, State
from skin_host.mqtt.packets import publish_head, publish_packet
from skin_host.mqtt.topics import Topics
from skin_host.mqtt.trials import REJECTIONS
from skin_host.processing.frame import PressureFrame

#: Limit of unacknowledged messages. Together less than the 20 that mosquitto and paho allow, so
#: that touches never wait behind health.
TOUCH_WINDOW = 10
#: Frames that are encoded and written at a time; then other tasks of the loop run.
FRAME_WINDOW = 8
RETAINED_WINDOW = 6
#: How long suspected frames are waited for.
FRAME_PATIENCE_S = 1.0

_log = logging.getLogger(__name__)


class FrameForm(NamedTuple):
    """How frames are written."""

    encoding: Literal["json", "cbor"]
    properties: PackedProperties | None


class Suspect(NamedTuple):
    """The only publication that was in flight when the broker ended the connection.

    Attributes:
        topic: its topic.
        found: how often in a row this topic has been found to be the reason, see `Trials.strike`.
    """

    topic: str
    found: int


class _InFlight(NamedTuple):
    """A message on its way: done when it is acknowledged, which must be before `until_s`."""

    done: "asyncio.Future[None]"
    until_s: float


class Courier:
    """Sends an outbox.

    Args:
        outbox: the messages to send.
        topics: of the robot.
        status: the topic of the node's status, which is never withheld.
        form: how frames are written.
        state_properties: of a topic's retained payload.
        after_states: called when all retained messages have been acknowledged.
        clock: by which raw frames end.

    Attributes:
        too_large: topics whose last message was larger than the broker takes.
    """

    def __init__(
        self,
        outbox: Outbox,
        topics: Topics,
        status: str,
        form: FrameForm,
        state_properties: Callable[[str, bytes], MessageProperties | None],
        after_states: Callable[[Connection], None],
        clock: Clock = SYSTEM,
    ) -> None:
        self._clock = clock
        self._outbox = outbox
        self._topics = topics
        self._status = status
        self._form = form
        self._state_properties = state_properties
        self._after_states = after_states
        self._raw_until_s = 0.0
        self._events_out: deque[_InFlight] = deque()  # of the first events in the queue
        self._states_out: dict[str, asyncio.Future[None]] = {}
        self._frames_out: dict[str, None] = {}  # parts whose frames this connection has sent
        #: To be sent one at a time: this many of the first events, these states, these parts'
        #: frames.
        self._events_alone = 0
        self._states_alone: dict[str, None] = {}
        self._frames_alone: dict[str, None] = {}
        self._frame_tried: str | None = None
        #: The connection for events and frames, while they may be written.
        self._to: Connection | None = None
        self._is_writing_due = False
        self._suspect_came = asyncio.Event()
        #: By part: the topic of its frames, and the bytes before their payload.
        self._heads: dict[str, tuple[str, bytes]] = {}
        outbox.on_put = self._note_put
        #: The broker has acknowledged something over this connection; otherwise it may end
        #: connections for other reasons, as a node of a broken cluster does.
        self._works = False
        self.too_large: dict[str, None] = {}

    def use(self, form: FrameForm) -> None:
        """Write frames in this form from now on."""
        self._form = form
        self._heads.clear()

    def show_raw(self, seconds: float) -> None:
        """Send the boards' own bytes with the frames for this time; 0 ends it."""
        self._raw_until_s = self._clock.monotonic_s() + seconds

    def repeat_events(self) -> None:
        """Send recent events again, because the next connection is to another broker, which may not
        have them.
        """
        n = self._outbox.repeat_events()
        if self._events_alone:
            self._events_alone += n

    async def carry(self, connection: Connection) -> None:
        """Send until cancelled.

        Raises:
            MqttError: the connection is lost.
        """
        self._states_out.clear()
        self._frames_out.clear()
        self._works = False
        await self._try_alone(connection)
        self._to = connection
        connection.when_clear = self._note_put
        self._note_put()
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._send_states(connection))
                group.create_task(self._watch_events())
        finally:
            self._to = None

    def note_end(self, connection: Connection) -> Suspect | None:
        """Note the end of the connection; return the publication that may be the reason, if one
        alone was in flight.
        """
        outbox = self._outbox
        outbox.drop_frames()
        out = min(len(self._events_out), len(outbox.events))
        # An acknowledgement that is read after this must not count for what moves up in the queue.
        self._events_out.clear()
        answers = sum(not event.is_touch for event in islice(outbox.events, out))
        states = [topic for topic, done in self._states_out.items() if not done.done()]
        first = outbox.events[0].topic if out else ""
        outbox.drop_answers()
        if not connection.ended_by_broker:
            return None
        events = out - answers
        if out + len(states) == 0:
            return self._judge_frames()
        self._events_alone = max(self._events_alone, events)
        self._states_alone |= dict.fromkeys(states)
        if out + len(states) > 1:
            return None
        if answers:  # lost in any case, so it need not be found
            return Suspect(first, 0)
        # The status is the first of all, so nothing needs to have worked before it.
        if states == [self._status]:
            return Suspect(self._status, outbox.trials.strike(self._status))
        if not self._works:
            return None
        return self._judge_event() if events else self._judge_state(states[0])

    def _judge_event(self) -> Suspect:
        """Judge the first event, which alone was in flight."""
        outbox = self._outbox
        topic = outbox.events[0].topic
        found = outbox.trials.strike(topic)
        if found:
            outbox.give_up_event()
            self._events_alone -= 1
        if found >= REJECTIONS:
            outbox.trials.withhold(topic)
        return Suspect(topic, found)

    def _judge_state(self, topic: str) -> Suspect:
        """Judge a state that alone was in flight."""
        found = self._strike(topic)
        if found:
            self._states_alone.pop(topic, None)
        return Suspect(topic, found)

    def _judge_frames(self) -> Suspect | None:
        """Judge frames, if nothing else was in flight."""
        part, self._frame_tried = self._frame_tried, None
        if part is None:
            self._frames_alone |= self._frames_out
            return None
        topic = self._topics.part("frame", part)
        found = self._strike(topic)
        if found:
            self._frames_alone.pop(part, None)
        return Suspect(topic, found)

    def _strike(self, topic: str) -> int:
        """A strike for states or frames; their topic is withheld when it is found."""
        found = self._outbox.trials.strike(topic)
        if found:
            self._outbox.trials.withhold(topic)
            self._outbox.counters.rejected += 1
        return found

    def _fits(
        self,
        connection: Connection,
        topic: str,
        payload: bytes,
        properties: MessageProperties | None,
    ) -> bool:
        """Whether the broker's limit lets a message through; names the topic if it does not."""
        if connection.packet_limit is None and not self.too_large:
            return True
        if connection.fits(topic, payload, properties):
            if self.too_large:
                self.too_large.pop(topic, None)
            return True
        if topic not in self.too_large:
            self.too_large[topic] = None
            _log.warning(
                "not published: %s: %d bytes; the broker takes packets of up to %d",
                topic,
                len(payload) + (0 if properties is None else len(properties.pack())),  # type: ignore[no-untyped-call]
                connection.packet_limit,
            )
        return False

    def _drop_large_event(self, number: int) -> None:
        """Drop an event that is too large; the answer to a command is shortened as long as it can
        be.
        """
        event = self._outbox.events[number]
        if event.is_touch:
            self._outbox.give_up_event(number)
            return
        shorter = shortened(event.payload)
        if shorter is not None:
            self._outbox.events[number] = event._replace(payload=shorter)
        else:
            self._outbox.give_up_event(number)
            self.too_large.pop(event.topic, None)  # whoever asks may name another one each time

    async def _try_alone(self, connection: Connection) -> None:
        """Send suspected messages, one at a time.

        Before the suspected events go the status and all contacts: the status makes valid what the
        broker retained of these, however old it is.
        """
        outbox = self._outbox
        if self._events_alone or self._states_alone or self._frames_alone:
            await self._send_batch(connection, {self._status: outbox.retained[self._status]})
            self._states_alone.pop(self._status, None)
            due = outbox.take_states(len(outbox.pending))
            contacts = [topic for topic in due if self._is_contact(topic)]
            suspected = [topic for topic in contacts if topic in self._states_alone]
            others = [topic for topic in contacts if topic not in self._states_alone]
            for start in range(0, len(others), RETAINED_WINDOW):
                topics = others[start : start + RETAINED_WINDOW]
                await self._send_batch(connection, {one: outbox.retained[one] for one in topics})
            await self._try_states(connection, suspected)
        while self._events_alone and outbox.events:
            event = outbox.events[0]
            if not self._fits(connection, event.topic, event.payload, event.properties):
                self._drop_large_event(0)
                self._events_alone -= event.is_touch
                continue
            done = connection.send(event.topic, event.payload, qos=1, properties=event.properties)
            self._events_out.append(_InFlight(done, 0.0))
            await within(TIMEOUT_S, done)
            self._events_out.popleft()
            outbox.event_sent()
            self._events_alone -= 1
        self._events_alone = 0
        await self._try_states(connection, list(self._states_alone))
        if self._frames_alone:
            try:
                async with self._clock.timeout(FRAME_PATIENCE_S):
                    await self._try_frames(connection)
            except TimeoutError:  # some parts send none
                self._frames_alone.clear()

    async def _try_states(self, connection: Connection, topics: list[str]) -> None:
        """Send these suspected states, one at a time."""
        for topic in topics:
            await self._send_batch(connection, {topic: self._outbox.retained[topic]})
            del self._states_alone[topic]

    def _is_contact(self, topic: str) -> bool:
        subject = self._topics.parse(topic)
        return subject is not None and subject.kind == "contact"

    async def _try_frames(self, connection: Connection) -> None:
        """Send one frame of each suspected part, with QoS 1: an acknowledgement clears it."""
        outbox = self._outbox
        while self._frames_alone:
            await self._suspect_came.wait()
            self._suspect_came.clear()
            for part in [part for part in self._frames_alone if part in outbox.frames]:
                self._frame_tried = part
                await self._send_suspect(connection, outbox.frames.pop(part))
                self._frame_tried = None
                outbox.trials.arrived(self._topics.part("frame", part))
                del self._frames_alone[part]

    async def _send_suspect(self, connection: Connection, frame: PressureFrame) -> None:
        """Send a frame with QoS 1 and wait for its acknowledgement."""
        topic = self._topics.part("frame", frame.part)
        payload = self._encoded(connection, topic, frame)
        if payload is None:
            return
        properties = self._form.properties
        done = connection.send(topic, payload, qos=1, properties=properties)
        self._frames_out[frame.part] = None
        self._outbox.counters.frames_sent += 1
        await within(TIMEOUT_S, done)

    def __enter__(self) -> None:
        """Write at the end of the block what is put in it, without another turn of the loop."""
        self._is_writing_due = True

    def __exit__(self, *_: object) -> None:
        self._write()

    def _note_put(self) -> None:
        """Write when everything of this turn of the loop has been put."""
        if self._frames_alone:
            self._suspect_came.set()
        if self._to is not None and not self._is_writing_due:
            self._is_writing_due = True
            asyncio.get_running_loop().call_soon(self._write)

    def _write(self) -> None:
        """Write what is in the outbox, touches first, then frames as far as the socket takes
        them.
        """
        self._is_writing_due = False
        connection, outbox = self._to, self._outbox
        if connection is None:
            return
        if len(outbox.events) > len(self._events_out):
            try:
                self._fill_window(connection)
            except MqttError:
                return  # the reader of the connection finds it lost
        # Nothing is encoded for a socket that takes nothing.
        if not outbox.frames or not connection.is_clear():
            return
        frames, packets = [], []
        for _ in range(min(FRAME_WINDOW, len(outbox.frames))):
            frame = outbox.take_frame()
            topic, head = self._head(frame.part)
            payload = self._encoded(connection, topic, frame)
            if payload is not None:
                frames.append(frame)
                packets.append(publish_packet(head, payload))
        taken = connection.write_now(packets) if packets else 0
        for frame in frames[:taken]:
            self._frames_out[frame.part] = None
        outbox.counters.frames_sent += taken
        if taken < len(packets):
            outbox.put_back(frames[taken:])
        elif outbox.frames:
            self._note_put()

    def _head(self, part: str) -> tuple[str, bytes]:
        """The topic of a part's frames, and the bytes before their payload."""
        found = self._heads.get(part)
        if found is None:
            properties = self._form.properties
            packed = None if properties is None else properties.pack()
            topic = self._topics.part("frame", part)
            found = self._heads[part] = topic, publish_head(topic, packed)
        return found

    def _encoded(self, connection: Connection, topic: str, frame: PressureFrame) -> bytes | None:
        """The payload of a frame; None for one that the broker does not take, which is counted."""
        raw = self._raw_until_s > 0.0 and self._clock.monotonic_s() < self._raw_until_s
        payload = encode_frame(frame, self._form.encoding, raw=raw)
        withheld = self._outbox.trials.withholds(topic)
        if withheld or not self._fits(connection, topic, payload, self._form.properties):
            self._outbox.counters.frames_skipped += 1
            return None
        return payload

    def _fill_window(self, connection: Connection) -> None:
        """Send events, in order, until as many are on their way as may be.

        Events that are not acknowledged stay in the queue and are sent again.
        """
        outbox, in_flight = self._outbox, self._events_out
        until_s = self._clock.monotonic_s() + TIMEOUT_S
        while len(in_flight) < min(len(outbox.events), TOUCH_WINDOW):
            event = outbox.events[len(in_flight)]
            if not self._fits(connection, event.topic, event.payload, event.properties):
                self._drop_large_event(len(in_flight))
                continue
            topic, payload, properties, _ = event
            done = connection.send(topic, payload, qos=1, properties=properties, hold=True)
            done.add_done_callback(self._note_acknowledged)
            in_flight.append(_InFlight(done, until_s))
        connection.flush()  # a touch must not wait for the encoding of frames

    def _note_acknowledged(self, _done: "asyncio.Future[None]") -> None:
        """The first events in the queue may have arrived; others take their places."""
        in_flight = self._events_out
        while in_flight and in_flight[0].done.done():
            in_flight.popleft()
            self._outbox.event_sent()
            self._works = True
        if len(self._outbox.events) > len(in_flight):
            self._note_put()

    async def _watch_events(self) -> None:
        """Watch that events are acknowledged in time.

        Raises:
            MqttError: one was not.
        """
        while True:
            now_s = self._clock.monotonic_s()
            until_s = self._events_out[0].until_s if self._events_out else now_s + TIMEOUT_S
            if until_s <= now_s:
                await within(0.0, self._events_out[0].done)
            else:
                await self._clock.sleep(until_s - now_s)

    async def _send_states(self, connection: Connection) -> None:
        outbox = self._outbox
        outbox.retained_put.set()
        while True:
            with suppress(TimeoutError):  # a withheld one may go
                async with self._clock.timeout_at(outbox.held_until_s()):
                    await outbox.retained_put.wait()
            outbox.retained_put.clear()
            while states := outbox.take_states(RETAINED_WINDOW):
                await self._send_batch(connection, states)
                self._after_states(connection)

    async def _send_batch(self, connection: Connection, states: dict[str, State]) -> None:
        """Send states together, and wait until all have arrived but those that are too large."""
        for topic, state in list(states.items()):
            sent = self._send_state(connection, topic, state.payload)
            if sent is None:
                self._outbox.give_up_state(topic)
                del states[topic]
            else:
                self._states_out[topic] = sent
        for done in self._states_out.values():
            await within(TIMEOUT_S, done)
        self._works = self._works or bool(self._states_out)
        self._states_out.clear()
        self._outbox.states_sent(states)

    def _send_state(
        self, connection: Connection, topic: str, payload: bytes
    ) -> "asyncio.Future[None] | None":
        """Send a state; None for one that the broker does not take."""
        properties = self._state_properties(topic, payload)
        if not self._fits(connection, topic, payload, properties):
            return None
        return connection.send(topic, payload, qos=1, retain=True, properties=properties)
