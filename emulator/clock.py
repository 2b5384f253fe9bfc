"""Time of the emulator: real, accelerated, or stepped by the owner of the clock.

The cores of the emulator have no clock; they are given the time that has passed. A clock is only
for loops that communicate with the outside, such as `Robot.run`.
"""

import asyncio
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skin_host import clock

NS = 1_000_000_000
#: Two clocks are read as at one moment when no more than this passes meanwhile. A process that is
#: held up between them reads them again, so often at most.
AT_ONCE_NS = 100_000
MOST_READS = 20
#: Times are given to the host as no farther away from its own than this.
FARTHEST_NS = float(1 << 62)


class EmulatedTime(Protocol):
    """Emulated time in nanoseconds since the clock was made, and how to wait for it."""

    def now_ns(self) -> int:
        """Emulated time that has passed."""
        ...

    def host_ns(self, t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """The host's time of day at some emulated times."""
        ...

    async def sleep_until_ns(self, t_ns: int) -> None:
        """Return when `t_ns` has been reached; other tasks run meanwhile."""
        ...


class RealClock:
    """Emulated time runs as a clock's monotonic time, or `speed` times as fast."""

    def __init__(self, speed: float = 1.0, clock: clock.Clock = clock.SYSTEM) -> None:
        if not speed > 0:
            raise ValueError(f"speed {speed}: wanted a number above 0")
        self._speed = speed
        self._clock = clock
        self._start_ns = clock.monotonic_ns()

    def now_ns(self) -> int:
        """Emulated time that has passed."""
        return int((self._clock.monotonic_ns() - self._start_ns) * self._speed)

    def host_ns(self, t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """The host's time of day at some emulated times, as its clock is set now."""
        monotonic_ns, host_ns = self._both_ns()
        now_ns = int((monotonic_ns - self._start_ns) * self._speed)
        # At the slowest speeds a moment of emulated time is longer than int64 can count.
        most_ns = FARTHEST_NS * self._speed
        ago_ns = np.clip(now_ns - t_ns, -most_ns, most_ns) / self._speed
        return np.asarray(host_ns - ago_ns.astype(np.int64))

    def _both_ns(self) -> tuple[int, int]:
        """Return monotonic time and the host's time of day at one moment."""
        reads: list[tuple[int, int, int]] = []
        monotonic_ns = self._clock.monotonic_ns()
        for _ in range(MOST_READS):
            host_ns = self._clock.now_ns()
            after_ns = self._clock.monotonic_ns()
            reads.append((after_ns - monotonic_ns, monotonic_ns, host_ns))
            if reads[-1][0] <= AT_ONCE_NS:
                break
            monotonic_ns = after_ns
        _, monotonic_ns, host_ns = min(reads)
        return monotonic_ns, host_ns

    async def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until `t_ns`; a time that has passed still lets other tasks run once."""
        await self._clock.sleep(max(0, t_ns - self.now_ns()) / (NS * self._speed))


class SteppedTime:
    """Time that moves only by `advance`, or by a sleeper if the clock runs freely.

    With `free` every sleep jumps straight to its end, so a loop runs as fast as the machine
    can. Otherwise sleepers wait until `advance` has moved the time past their end.
    """

    def __init__(self, *, free: bool = False) -> None:
        self._t_ns = 0
        self._free = free
        self._moved = asyncio.Condition()

    def now_ns(self) -> int:
        """Emulated time that has passed."""
        return self._t_ns

    def host_ns(self, t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Emulated time is the host's."""
        return t_ns

    async def advance(self, dt_s: float) -> None:
        """Move the time on and wake those whose time has come."""
        async with self._moved:
            self._t_ns += round(dt_s * NS)
            self._moved.notify_all()
        await asyncio.sleep(0)

    async def sleep_until_ns(self, t_ns: int) -> None:
        """Wait for `advance` to reach `t_ns`, or jump there where the clock runs freely."""
        if self._free:
            self._t_ns = max(self._t_ns, t_ns)
            await asyncio.sleep(0)
            return
        async with self._moved:
            await self._moved.wait_for(lambda: self._t_ns >= t_ns)
