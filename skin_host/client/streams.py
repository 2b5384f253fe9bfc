"""What a client hears, one kind at a time, and what it did not hear."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from typing import Any, Generic, TypeVar, cast

from msgspec.structs import replace

from skin_host.publish.frames import Frame
from skin_host.publish.grasping import Over, Slip
from skin_host.publish.messages import Touch
from skin_host.publish.topics import PartTopic

#: What is held for a reader that is slow; then the oldest goes, and is missed.
HELD = {
    "touch": 10_000,
    "slip": 10_000,
    "over": 10_000,
    "frame": 256,
    "contact": 1000,
    "health": 1000,
}
#: An event that the broker got twice comes again within so many events.
DUPLICATE_SPAN = 64

T = TypeVar("T")


class Stream(AsyncIterator[T], Generic[T]):
    """All of some kinds from the moment of asking on; made by `SkinClient`, ends with it."""

    def __init__(self, part: str | None, *kinds: PartTopic) -> None:
        self.part = part
        self.kinds = kinds
        self._items: deque[T] = deque(maxlen=max(HELD[kind] for kind in kinds))
        self._wake = asyncio.Event()
        self._closed = False
        #: By kind and part; each has numbers of its own.
        self._last: dict[tuple[type, str], tuple[int, int]] = {}

    def put(self, item: T) -> None:
        """Add what was heard."""
        self._items.append(item)
        self._wake.set()

    def close(self) -> None:
        """End after what is held."""
        self._closed = True
        self._wake.set()

    async def __anext__(self) -> T:
        while True:
            while not self._items:
                if self._closed:
                    raise StopAsyncIteration
                self._wake.clear()
                await self._wake.wait()
            item: Any = self._items.popleft()
            if isinstance(item, Touch | Slip | Over):
                # A publisher that does not count cannot be checked.
                missed = self._missed(item, item.count) if item.count else 0
            elif isinstance(item, Frame):
                missed = self._missed(item, item.seq)
            else:
                return cast(T, item)
            if missed is not None:
                # Other streams hold the same object, and may have missed less.
                return cast(T, replace(item, missed=missed) if missed else item)

    def _missed(self, item: Touch | Slip | Over | Frame, number: int) -> int | None:
        """How many numbers were passed over; None for one that was heard before."""
        kind = type(item), item.part
        last, last_ns = self._last.get(kind, (number - 1, item.t_ns))
        if number <= last and item.t_ns <= last_ns and last - number < DUPLICATE_SPAN:
            return None
        self._last[kind] = number, item.t_ns
        # A smaller number at a later time says that the node was started anew.
        return max(0, number - last - 1)
