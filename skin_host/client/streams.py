"""Streams of received messages, one kind at a time, with the number of lost ones."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from typing import Any, Generic, Literal, NamedTuple, TypeVar, cast

from msgspec.structs import replace

from skin_host.client.presence import Contact, taxels_of
from skin_host.errors import RequestError, SkinError
from skin_host.fingertip.events import Over, Slip
from skin_host.mqtt.messages import Frame
from skin_host.mqtt.topics import PartTopic
from skin_host.processing.events import Touch

#: Of what a stream may be: messages of a topic, or descriptions of parts.
Kind = PartTopic | Literal["info"]
#: How many items a stream holds for a slow reader; then the oldest is dropped. The next event or
#: frame of its part counts it.
HELD: dict[Kind, int] = {
    "touch": 10_000,
    "slip": 10_000,
    "over": 10_000,
    "frame": 256,
    "contact": 1000,
    "health": 1000,
    "info": 1000,
}
#: A state is true until the next one of its part. There are fewer parts than items held.
STATES = {"contact", "health", "info"}
#: Of touches and frames no more than have this many taxels together: whoever may publish could send
#: some of a hundred thousand each.
HELD_TAXELS = 5_000_000
#: For a reader that is later than this, older frames and states are left out: they look like those
#: of now. A broker keeps frames no longer either.
LATE_S = 1.0
#: Of these. Events are all read, and what is left out of contact states does not depend on time.
AGING = {"frame", "health", "info"}
UNENTERED = "this client was not entered: use it in its `async with` block"
ENDED = "this client has ended: nothing is received any more; make another one"
#: An event that the broker got twice comes again within this many events.
DUPLICATE_SPAN = 64

_Numbered = Touch | Slip | Over | Frame
_COUNTED = (Touch, Slip, Over, Frame)

T = TypeVar("T")


class _Last(NamedTuple):
    """The last item of a part and kind: the start of the node from which it is, and its number."""

    run: int | None
    number: int
    t_ns: int


def refuse_other_loop(loop: asyncio.AbstractEventLoop | None) -> None:
    """Refuse what is done in another event loop, which nothing that is received would wake.

    Args:
        loop: in which the client was entered; None: it was not.

    Raises:
        RequestError: another one runs, or none.
    """
    if loop is None:
        return
    try:
        running: asyncio.AbstractEventLoop | None = asyncio.get_running_loop()
    except RuntimeError:
        running = None
    if running is not loop:
        raise RequestError(
            "this client was entered in another event loop: use it there, or use SkinCallbacks, "
            "which any thread may call"
        )


class SentTwice:
    """Finds events and frames that came before: what was in flight when a connection broke is sent
    again, and without MQTT 5 each of several brokers sends it.

    They have the same number and time. One of an equal number at another time is of another run.

    Args:
        span: so many items of a part and kind are known.
    """

    def __init__(self, span: int = DUPLICATE_SPAN) -> None:
        self._span = span
        #: Numbers and times in their order, as a set.
        self._latest: dict[tuple[type, str], dict[tuple[int, int], None]] = {}

    def has(self, item: _Numbered) -> bool:
        """Return whether an item is among the last ones of its part and kind, and note it."""
        number = item.seq if isinstance(item, Frame) else item.count
        if not number and not isinstance(item, Frame):
            return False  # a publisher that does not count cannot be checked
        latest = self._latest.setdefault((type(item), item.part), {})
        which = number, item.t_ns
        if which in latest:
            return True
        latest[which] = None
        if len(latest) > self._span:
            del latest[next(iter(latest))]
        return False


class Stream(AsyncIterator[T], Generic[T]):
    """Items of some kinds from the request on; made by `SkinClient`, ends with it.

    Raises (on reading, once):
        RequestError: the robot has no part of this name, or nothing of this kind comes of it, see
            `SkinClient`.
        BrokerError: a broker does not let us subscribe to a topic that is needed.

    Raises (on reading):
        RequestError: the client was not entered yet, or in another event loop.
    """

    def __init__(self, part: str | None, *kinds: Kind) -> None:
        self.part = part
        self.kinds = kinds
        #: In which the client was entered.
        self.loop: asyncio.AbstractEventLoop | None = None
        #: Its client was not entered yet.
        self.is_early = False
        #: Whether it is known that there is such a part, or was reported that there is none.
        self.is_judged = part is None
        self._failure: str | None = None
        self._failed: set[str] = set()
        #: Topics that a broker refused, and the errors that were not raised yet.
        self._refused: set[str] = set()
        self._refusals: deque[SkinError] = deque()
        self._items: deque[T] = deque()
        self._ages = not AGING.isdisjoint(kinds)
        #: When they came, by the event loop's clock, if they age.
        self._arrived_s: deque[float] = deque()
        self._most = max(HELD[kind] for kind in kinds)
        self._taxels = 0
        self._wake = asyncio.Event()
        self._closed = False
        #: By kind and part; each has separate numbers.
        self._last: dict[tuple[type, str], _Last] = {}
        #: What the reader was too slow for, until the next item that is read.
        self._lost: dict[tuple[type, str], int] = {}
        self._repeats = SentTwice()

    def takes(self, kind: str, part: str) -> bool:
        """Return whether a kind of item of a part belongs to it."""
        return kind in self.kinds and self.part in (None, part)

    def put(self, item: T, run: int | None = None) -> None:
        """Add a received item, unless it came before.

        Args:
            item: what was received.
            run: of the node, in which each kind of events of a part is numbered from 1, and its
                frames from 0; None: not known.
        """
        self.is_judged, self._failure = True, None
        if isinstance(item, _COUNTED):
            if self._repeats.has(item):
                return
            item = cast(T, self._counted(item, run))
        if isinstance(item, Contact) and self._is_unread(item):
            return
        self._items.append(item)
        if self._ages:
            self._arrived_s.append(_now_s())
        self._taxels += taxels_of(item)
        if len(self._items) > self._most:
            self._make_room()
        while self._taxels > HELD_TAXELS and len(self._items) > 1:
            self._drop()
        self._wake.set()

    def _is_unread(self, now: Contact) -> bool:
        """Return whether a state is the last one of its part that was not read. An OFF before it,
        which is not true any more, is left out: who is slow would take the part for untouched.
        """
        items = cast(deque[Contact], self._items)
        mine = [at for at, item in enumerate(items) if item.part == now.part]
        if mine and items[mine[-1]].state == "OFF":
            del items[mine.pop()]
        return bool(mine) and items[mine[-1]] == now

    def _make_room(self) -> None:
        """Drop the oldest item; of states the oldest that a newer one of its part follows: nothing
        would show that the newest is missing.
        """
        if STATES.isdisjoint(self.kinds):
            self._drop()
            return
        items: list[Any] = list(self._items)
        newest = {item.part: at for at, item in enumerate(items)}
        # Parts that anybody names, and names no longer, are more than those that there are.
        oldest = next((at for at, item in enumerate(items) if newest[item.part] > at), 0)
        del self._items[oldest]
        if self._ages:
            del self._arrived_s[oldest]

    def _drop(self) -> None:
        """Drop the oldest item; the next one of its part and kind counts it."""
        item = self._pop()
        if isinstance(item, _COUNTED):
            kind = type(item), item.part
            self._lost[kind] = self._lost.get(kind, 0) + 1 + item.missed

    def _catch_up(self) -> None:
        """Let a reader that is late continue with the newest item of each part. A state is true
        until the next one; of a frame nobody knows that.
        """
        oldest_s = _now_s() - LATE_S
        if not self._arrived_s or self._arrived_s[0] >= oldest_s:
            return
        items = cast(deque[Any], self._items)
        newest = {item.part: item for item in items}
        for _ in range(len(items)):
            is_now = self._arrived_s[0] >= oldest_s or not isinstance(items[0], Frame)
            if is_now and items[0] is newest[items[0].part]:
                items.rotate(-1)
                self._arrived_s.rotate(-1)
            else:
                self._drop()

    def _pop(self) -> T:
        item = self._items.popleft()
        if self._ages:
            self._arrived_s.popleft()
        self._taxels -= taxels_of(item)
        return item

    def close(self) -> None:
        """End after the held items."""
        self._closed = True
        self._wake.set()

    def fail(self, why: str) -> None:
        """Let the reader get a RequestError, once: nothing will come, as far as is known."""
        self.is_judged = True
        if why not in self._failed:
            self._failed.add(why)
            self._failure = why
            self._wake.set()

    def refuse(self, topic: str, error: SkinError) -> None:
        """Let the reader get an error, once: messages of this topic cannot come."""
        if topic not in self._refused:
            self._refused.add(topic)
            self._refusals.append(error)
            self._wake.set()

    async def __anext__(self) -> T:
        if self.is_early:
            raise RequestError(UNENTERED)
        if not self._closed:  # what is left may be read anywhere
            refuse_other_loop(self.loop)
        while True:
            self._catch_up()
            if self._refusals:
                raise self._refusals.popleft()
            if self._items:
                return self._take_out()
            if self._failure is not None:
                why, self._failure = self._failure, None
                raise RequestError(why)
            if self._closed:
                raise StopAsyncIteration
            self._wake.clear()
            await self._wake.wait()

    def _take_out(self) -> T:
        item: Any = self._pop()
        lost = self._lost.pop((type(item), item.part), 0) if isinstance(item, _COUNTED) else 0
        return cast(T, replace(item, missed=item.missed + lost) if lost else item)

    def _counted(self, item: _Numbered, run: int | None) -> _Numbered:
        """Return an item with the number of those that are missing before it."""
        is_frame = isinstance(item, Frame)
        number = item.seq if isinstance(item, Frame) else item.count
        # A publisher that does not count events cannot be checked.
        missed = self._missed(item, number, run) if number or is_frame else 0
        # Other streams hold the same object, and may have missed fewer.
        return item if missed == item.missed else replace(item, missed=missed)

    def _missed(self, item: _Numbered, number: int, run: int | None) -> int:
        """Return how many numbers are missing before this one."""
        kind = type(item), item.part
        last = self._last.get(kind)
        if last is None:
            self._last[kind] = _Last(run, number, item.t_ns)
            return 0  # what was before it was not asked for
        # What was lost behind greater numbers that were forged, only the order of all events knows.
        lost = item.missed
        first = 0 if isinstance(item, Frame) else 1
        if run is not None and last.run is not None:
            before = last.number if run == last.run else first - 1
            # What came before a run that is followed again, nobody knows but the order.
            missed = lost or (number - before - 1 if run >= last.run else 0)
        elif item.t_ns < last.t_ns and 0 < last.number - number < DUPLICATE_SPAN:
            # It came late over another broker, or its node was restarted with an earlier clock.
            return lost
        else:
            # A smaller number at a later time means that the node was restarted.
            before = last.number if number >= last.number else first - 1
            missed = lost or number - before - 1
        self._last[kind] = _Last(run, number, item.t_ns)
        return max(0, missed)


def _now_s() -> float:
    return asyncio.get_running_loop().time()
