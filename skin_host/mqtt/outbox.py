"""Messages that wait to be published. Putting is cheap and never waits.

For frames it holds the newest of each part, for events that must arrive a bounded queue whose
losses are counted, and for retained messages the newest of each topic.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Collection
from itertools import islice
from typing import NamedTuple

from msgspec import Struct

from skin_host.clock import SYSTEM, Clock
from skin_host.fingertip.events import FingertipEvent
from skin_host.mqtt.connection import MessageProperties
from skin_host.mqtt.messages import encode_event
from skin_host.mqtt.trials import Trials
from skin_host.processing.frame import PressureFrame

#: Events that are sent again to another broker: acknowledged within this time, and at most this
#: many. A frozen broker is noticed after 3 s.
REPEAT_S = 10.0
REPEATED = 1000
#: While more events than this wait, a newer `move` takes the place of the one before it: what waits
#: longer would describe the past. The first ones, as many, may be on their way.
BACKLOG = 100
#: `move` events may fill half of the queue, because a begin or an end is more important.
MOVE_SHARE = 0.5

_log = logging.getLogger(__name__)


class PublisherCounters(Struct):
    """Results of everything that was put.

    Attributes:
        connections: how often the broker was reached.
        frames_skipped: a newer frame came before they could be sent, there was no broker, or they
            were read too late.
        touches_waiting: events in the queue now.
        moves_replaced: `move` events that were replaced by a newer one of their contact before they
            were sent, because many events waited; they leave no gap in `count`.
        touches_dropped: events that found the queue full, or were left at the end.
        refused: publications that the broker refused; `last_error` gives the reason.
        rejected: publications that were dropped because the broker ended the connection
            whenever they were sent.
        withheld: topics to which nothing is sent because of that, or of the size of the message.
        unsubscribed: topics that this node should receive and does not, though it is connected: the
            broker does not allow the subscription, does not answer it, or ends the connection
            over it. Without that of commands none is received.
        name_taken: connections are ended as if another client used this node's name.
        answers_dropped: answers to commands that were lost with a connection, or that the broker
            does not take.
    """

    connected: bool = False
    connections: int = 0
    last_error: str = ""
    frames_sent: int = 0
    frames_skipped: int = 0
    touches_sent: int = 0
    touches_waiting: int = 0
    touches_dropped: int = 0
    moves_replaced: int = 0
    retained_sent: int = 0
    refused: int = 0
    rejected: int = 0
    withheld: list[str] = []
    unsubscribed: list[str] = []
    name_taken: bool = False
    answers_dropped: int = 0
    commands_taken: int = 0
    commands_refused: int = 0


class Event(NamedTuple):
    """Something that must arrive: an event of a part, or the answer to a command."""

    topic: str
    payload: bytes
    properties: MessageProperties | None
    is_touch: bool


class State(NamedTuple):
    """A retained message. Two puts of the same payload are two states: what was on its way in
    between, such as a last will, may have replaced the first one at the broker.
    """

    payload: bytes
    version: int


class Outbox:
    """Everything that a publisher still has to send.

    Args:
        event_limit: how many events may wait.
        frame_hz: frames are thinned to this rate; 0 lets all pass.

    Attributes:
        frames: the newest frame of each part.
        events: messages that must arrive, in order.
        retained: the newest state of every retained topic, sent or not.
        passed_on: recently acknowledged events.
        pending: the topics of `retained` that are to be sent, now or when they are no longer
            withheld.
        on_put: called when there is a new frame or event.
        retained_put: set when there is something new to be retained.
        emptied: set when no event, or nothing retained, is left to send now.
        counters: results of everything that was put.
        trials: which topics are withheld.
    """

    def __init__(self, event_limit: int, frame_hz: float = 0.0, clock: Clock = SYSTEM) -> None:
        self.frames: dict[str, PressureFrame] = {}
        self.events: deque[Event] = deque()
        self.retained: dict[str, State] = {}
        self.passed_on: deque[tuple[float, Event]] = deque(maxlen=REPEATED)
        self.pending: dict[str, None] = {}
        self.on_put: Callable[[], None] = lambda: None
        self.retained_put = asyncio.Event()
        self.emptied = asyncio.Event()
        self.counters = PublisherCounters()
        self.trials = Trials(clock.monotonic_s)
        self._clock = clock
        self._event_limit = event_limit
        self._move_limit = int(event_limit * MOVE_SHARE)
        self._overflowing = False
        self._counts: dict[str, int] = {}
        #: By topic and contact: its last event, if that is a move, and the event's number.
        self._last_moves: dict[tuple[str, int], tuple[Event, int]] = {}
        self._version = 0
        #: States that are larger than the broker takes, by topic.
        self._given_up: dict[str, State] = {}
        self._frame_ns = int(1e9 / frame_hz) if frame_hz else 0
        self._frame_due_ns: dict[str, int] = {}

    def put_frame(self, frame: PressureFrame) -> None:
        """Take a frame, unless it is earlier than the rate allows or there is no connection."""
        if not self._is_due(frame):
            return
        if not self.counters.connected:
            self.counters.frames_skipped += 1
            return
        self.counters.frames_skipped += frame.part in self.frames
        self.frames[frame.part] = frame
        self.on_put()

    def take_frame(self) -> PressureFrame:
        """Take out the frame of the part that has waited longest."""
        return self.frames.pop(next(iter(self.frames)))

    def put_back(self, frames: list[PressureFrame]) -> None:
        """Put back frames that could not be sent, before all others."""
        self.frames = {frame.part: frame for frame in frames} | self.frames

    def drop_frames(self) -> None:
        """Drop all frames, which would be old when a broker comes back."""
        self.counters.frames_skipped += len(self.frames)
        self.frames.clear()

    def put_touch(
        self, topic: str, touch: FingertipEvent, properties: MessageProperties | None
    ) -> None:
        """Take a touch, slip or excess, or count it as lost; either way it is numbered.

        While many events wait, a `move` takes the place and the number of the contact's last one.
        """
        contact = topic, touch.id
        moves = touch.event == "move"
        if moves and len(self.events) > BACKLOG and self._replace_move(contact, touch, properties):
            return
        self._last_moves.pop(contact, None)
        limit = self._move_limit if moves else self._event_limit
        event = self._put_counted(topic, touch, properties, limit)
        if moves and event is not None:
            self._last_moves[contact] = event, self._counts[topic]

    def _replace_move(
        self, contact: tuple[str, int], touch: FingertipEvent, properties: MessageProperties | None
    ) -> bool:
        """Put a move in the place of the contact's last event, if that is a waiting move."""
        last, count = self._last_moves.get(contact, (None, 0))
        if last is None:
            return False
        for back, event in enumerate(islice(reversed(self.events), len(self.events) - BACKLOG)):
            if event is last:
                newer = last._replace(payload=encode_event(touch, count), properties=properties)
                self.events[-1 - back] = newer
                self._last_moves[contact] = newer, count
                self.counters.moves_replaced += 1
                return True
        return False

    def _put_counted(
        self,
        topic: str,
        event: FingertipEvent,
        properties: MessageProperties | None,
        limit: int,
    ) -> Event | None:
        count = self._counts[topic] = self._counts.get(topic, 0) + 1
        if self.trials.withholds(topic):
            self.counters.touches_dropped += 1
            self.counters.rejected += 1
            return None
        if len(self.events) < limit:
            waiting = Event(topic, encode_event(event, count), properties, is_touch=True)
            self.put_event(waiting)
            return waiting
        self.counters.touches_dropped += 1
        if not self._overflowing:
            self._overflowing = True
            _log.warning("touch events are lost: %d wait for the broker already", limit)
        return None

    def put_event(self, event: Event) -> None:
        """Take a message that must arrive."""
        self.events.append(event)
        self.on_put()

    def event_sent(self) -> None:
        """Note that the first event has arrived."""
        event = self.events.popleft()
        self.counters.touches_sent += event.is_touch
        if event.is_touch:
            self.passed_on.append((self._clock.monotonic_s(), event))
        self.trials.arrived(event.topic)
        if not self.events:
            self._overflowing = False
            self.emptied.set()

    def give_up_event(self, number: int = 0) -> None:
        """Drop the first event, or another one, which the broker does not take."""
        self.counters.rejected += 1
        is_touch = self.events[number].is_touch
        self.counters.touches_dropped += is_touch
        self.counters.answers_dropped += not is_touch
        del self.events[number]
        if not self.events:
            self.emptied.set()

    def drop_answers(self) -> None:
        """Drop answers: their askers have lost the connection, or the answer is why we lost
        ours.
        """
        kept = [event for event in self.events if event.is_touch]
        self.counters.answers_dropped += len(self.events) - len(kept)
        self.events = deque(kept)

    def repeat_events(self) -> int:
        """Put recently acknowledged events before all waiting ones; return how many events.

        They may have been lost with their broker: an acknowledgement means that the broker has an
        event, not that subscribers have it.
        """
        since_s = self._clock.monotonic_s() - REPEAT_S
        again = [event for at_s, event in self.passed_on if at_s >= since_s]
        self.passed_on.clear()
        self.counters.touches_sent -= len(again)
        self.events.extendleft(reversed(again))
        # Subscribers may know the numbers of these and of what was in flight behind them.
        self._last_moves.clear()
        self.on_put()
        return len(again)

    def renumber(self, properties: MessageProperties | None) -> None:
        """Let touches that wait, and those that may be repeated, have these properties: of a run
        that they name no more subscribers would pass them over.
        """
        self.events = deque(
            event._replace(properties=properties) if event.is_touch else event
            for event in self.events
        )
        again = [(at_s, event._replace(properties=properties)) for at_s, event in self.passed_on]
        self.passed_on = deque(again, REPEATED)
        self._last_moves.clear()

    def put_state(self, topic: str, payload: bytes) -> None:
        """Take a retained message; it replaces the one of the topic."""
        self._version += 1
        self.retained[topic] = State(payload, self._version)
        self.pending[topic] = None
        self.retained_put.set()

    def take_states(self, most: int) -> dict[str, State]:
        """Return up to `most` topics and states to be sent now; they stay until `states_sent`."""
        due = (topic for topic in self.pending if not self.trials.withholds(topic))
        return {topic: self.retained[topic] for topic in islice(due, most)}

    def held_until_s(self) -> float | None:
        """Return when the first withheld state may be sent, by the clock that is never set."""
        ends = map(self.trials.until_s, self.pending)
        return min((end for end in ends if end is not None), default=None)

    def states_sent(self, states: dict[str, State]) -> None:
        """Note that these have arrived. Newer states of their topics are still to be sent, after
        all others that wait.
        """
        self.counters.retained_sent += len(states)
        for topic, state in states.items():
            was_pending = topic in self.pending
            self.pending.pop(topic, None)
            if was_pending and self.retained[topic].version != state.version:
                self.pending[topic] = None
            self.trials.arrived(topic)
        self._note_emptied()

    def repeat_states(self, first: Collection[str] = ()) -> None:
        """Send all retained messages again, to a broker that may have lost them.

        Args:
            first: topics that go before all others; they have been put.
        """
        topics = {**dict.fromkeys(first), **self.retained}
        self.pending = {topic: None for topic in topics if not self._is_given_up(topic)}
        self.retained_put.set()

    def give_up_state(self, topic: str) -> None:
        """Drop a retained message that is larger than the broker takes, until it changes."""
        self.counters.rejected += 1
        self._given_up[topic] = self.retained[topic]
        self.pending.pop(topic, None)
        self._note_emptied()

    def _is_given_up(self, topic: str) -> bool:
        given_up = self._given_up.get(topic)
        return given_up is not None and given_up.version == self.retained[topic].version

    def _note_emptied(self) -> None:
        if not self.take_states(1):
            self.emptied.set()

    async def drained(self) -> None:
        """Wait until every event and everything retained has arrived, but for what is withheld."""
        while self.events or self.take_states(1):
            self.emptied.clear()
            await self.emptied.wait()

    def counted(self, topic: str) -> int:
        """Return how many events of a topic there have been."""
        return self._counts.get(topic, 0)

    def touches_waiting(self) -> int:
        """How many touch events are in the queue."""
        return sum(event.is_touch for event in self.events)

    def _is_due(self, frame: PressureFrame) -> bool:
        """Thin the frames by their own times; a little early is on time."""
        if not self._frame_ns:
            return True
        due_ns = self._frame_due_ns.get(frame.part, frame.t_ns)
        early_ns = due_ns - frame.t_ns
        if self._frame_ns // 10 < early_ns <= self._frame_ns * 2:
            return False
        # After a gap, or when the clock was set back, counting starts again.
        from_ns = due_ns if abs(early_ns) <= self._frame_ns else frame.t_ns
        self._frame_due_ns[frame.part] = from_ns + self._frame_ns
        return True
