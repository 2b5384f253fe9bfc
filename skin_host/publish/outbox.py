"""What waits to be published. Putting is cheap and never waits for anybody.

Frames have a mailbox that holds the newest of each part, events that must arrive a bounded
queue whose losses are counted, and everything retained a mailbox by topic.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

from skin_host.fingertip.events import OverEvent, SlipEvent
from skin_host.processing.contacts import TouchEvent
from skin_host.processing.pipeline import PressureFrame
from skin_host.publish.connection import MessageProperties
from skin_host.publish.grasping import encode_grasp
from skin_host.publish.messages import encode_touch

#: `move` events may fill half of the queue: a begin or an end is worth more.
MOVE_SHARE = 0.5

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class PublisherCounters:
    """What became of everything that was put.

    Attributes:
        connections: how often the broker was reached.
        frames_skipped: a newer frame came before they could be sent, or there was no broker.
        touches_waiting: events in the queue now.
        touches_dropped: events that found the queue full, or were left at the end.
        refused: publications that the broker refused; `last_error` says why.
    """

    connected: bool = False
    connections: int = 0
    last_error: str = ""
    frames_sent: int = 0
    frames_skipped: int = 0
    touches_sent: int = 0
    touches_waiting: int = 0
    touches_dropped: int = 0
    retained_sent: int = 0
    refused: int = 0
    commands_taken: int = 0
    commands_refused: int = 0


class Event(NamedTuple):
    """Something that must arrive: an event of a part, or the answer to a command."""

    topic: str
    payload: bytes
    properties: MessageProperties | None
    is_touch: bool


class Outbox:
    """Everything that a publisher has yet to send.

    Args:
        event_limit: how many events may wait.
        frame_hz: frames are thinned to this rate; 0 lets all pass.

    Attributes:
        frames: the newest frame of each part.
        events: what must arrive, in order.
        retained: the payload of every retained topic, sent or not.
        pending: the topics of `retained` that are to be sent.
        frames_put, events_put, retained_put: set when there is something new.
        emptied: set when no event and nothing retained is left to send.
        counters: what became of everything.
    """

    def __init__(self, event_limit: int, frame_hz: float = 0.0) -> None:
        self.frames: dict[str, PressureFrame] = {}
        self.events: deque[Event] = deque()
        self.retained: dict[str, bytes] = {}
        self.pending: dict[str, None] = {}
        self.frames_put = asyncio.Event()
        self.events_put = asyncio.Event()
        self.retained_put = asyncio.Event()
        self.emptied = asyncio.Event()
        self.counters = PublisherCounters()
        self._event_limit = event_limit
        self._move_limit = int(event_limit * MOVE_SHARE)
        self._overflowing = False
        self._counts: dict[str, int] = {}
        self._frame_ns = int(1e9 / frame_hz) if frame_hz else 0
        self._frame_due_ns: dict[str, int] = {}

    def put_frame(self, frame: PressureFrame) -> None:
        """Take a frame, unless it comes sooner than the rate allows or nobody is there."""
        if not self._is_due(frame):
            return
        if not self.counters.connected:
            self.counters.frames_skipped += 1
            return
        self.counters.frames_skipped += frame.part in self.frames
        self.frames[frame.part] = frame
        self.frames_put.set()

    def take_frame(self) -> PressureFrame:
        """Take out the frame of the part that has waited longest."""
        return self.frames.pop(next(iter(self.frames)))

    def drop_frames(self) -> None:
        """A frame that waited for a broker to come back would be old by then."""
        self.counters.frames_skipped += len(self.frames)
        self.frames.clear()

    def put_touch(
        self, topic: str, touch: TouchEvent, properties: MessageProperties | None
    ) -> None:
        """Take a touch event, or count it as lost; either way it is numbered."""
        limit = self._move_limit if touch.event == "move" else self._event_limit
        self._put_counted(topic, lambda n: encode_touch(touch, n), properties, limit)

    def put_grasp(
        self, topic: str, event: SlipEvent | OverEvent, properties: MessageProperties | None
    ) -> None:
        """Take a slip, or pressing too hard, in the same way."""
        limit = self._event_limit
        self._put_counted(topic, lambda n: encode_grasp(event, n), properties, limit)

    def _put_counted(
        self,
        topic: str,
        encode: Callable[[int], bytes],
        properties: MessageProperties | None,
        limit: int,
    ) -> None:
        count = self._counts[topic] = self._counts.get(topic, 0) + 1
        if len(self.events) < limit:
            self.put_event(Event(topic, encode(count), properties, is_touch=True))
            return
        self.counters.touches_dropped += 1
        if not self._overflowing:
            self._overflowing = True
            _log.warning("touch events are lost: %d wait for the broker already", limit)

    def put_event(self, event: Event) -> None:
        """Take something that must arrive."""
        self.events.append(event)
        self.events_put.set()

    def event_sent(self) -> None:
        """The first event has arrived."""
        self.counters.touches_sent += self.events.popleft().is_touch
        if not self.events:
            self._overflowing = False
            self.emptied.set()

    def put_state(self, topic: str, payload: bytes) -> None:
        """Take what is to be retained; it replaces what the topic held."""
        self.retained[topic] = payload
        self.pending[topic] = None
        self.retained_put.set()

    def take_states(self, most: int) -> dict[str, bytes]:
        """Up to `most` topics and payloads to be sent; they stay until `states_sent`."""
        return {topic: self.retained[topic] for topic in islice(self.pending, most)}

    def states_sent(self, states: dict[str, bytes]) -> None:
        """These have arrived. What was put meanwhile is still to be sent."""
        self.counters.retained_sent += len(states)
        for topic, payload in states.items():
            if self.retained[topic] is payload:
                del self.pending[topic]
        if not self.pending:
            self.emptied.set()

    def repeat_states(self) -> None:
        """Send everything retained again, to a broker that may have forgotten it."""
        self.pending = dict.fromkeys(self.retained)
        self.retained_put.set()

    async def drained(self) -> None:
        """Wait until every event and everything retained has arrived."""
        while self.events or self.pending:
            self.emptied.clear()
            await self.emptied.wait()

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
        # After a gap, or when the clock was set back, counting starts anew.
        from_ns = due_ns if abs(early_ns) <= self._frame_ns else frame.t_ns
        self._frame_due_ns[frame.part] = from_ns + self._frame_ns
        return True
