"""When to look at the ports.

A wake-up costs as much as reading dozens of frames, so nothing wakes the daemon but its
own plan. A board sends its sweep once a period: after one sweep it is known when the last
frame of the next is due, and the ports are read right then. Boards that have not sent yet,
or not in time, are looked for at fixed intervals.
"""

import asyncio
import contextlib
import ctypes
import os
import time
from collections.abc import Callable, Mapping

from skin_host.settings import Receive

#: The ports are read this long after the last frame of a sweep is due.
GUARD_NS = 200_000
#: A sweep that has not ended by then is looked for again: after so long, then after as long as
#: it is late already. Other boards' frames go first on a full bus.
RETRY_NS = 1_000_000
#: A sweep that is late by more is not planned for.
GIVE_UP_NS = 10_000_000
#: A sweep that ends late moves the plan by no more than this: the next may be in time again.
#: It is enough to follow a clock that is 0.1 % slower than nominal, at a period of 50 ms.
SLIP_NS = 50_000
#: With a plan for every board, the ports are read at least this often.
LONGEST_NS = 20_000_000
#: With so many sweeps a second one is always due: then looks begin an interval of polling apart,
#: and in proportion with fewer, so that wake-ups never cost more than the frames.
BUSY_HZ = 1000.0


class Plan:
    """Predicts the ends of sweeps. Pure: times in, times out, in ns on the frames' clock.

    Args:
        periods_ns: nominal period of each board.
        poll_ns: interval of reading while some board is not predicted.
    """

    def __init__(self, periods_ns: Mapping[int, int], poll_ns: int) -> None:
        self._periods_ns = periods_ns
        self._poll_ns = poll_ns
        self._due_ns: dict[int, int] = {}
        self._look_ns: dict[int, int] = {}

    def sweep_ended(self, board: int, t_ns: int) -> None:
        """Note the time of a sweep's last frame."""
        period_ns = self._periods_ns[board]
        late_ns = t_ns - self._due_ns.get(board, t_ns)
        if SLIP_NS < late_ns < period_ns // 2:
            t_ns -= late_ns - SLIP_NS
        self._due_ns[board] = t_ns + period_ns
        self._look_ns[board] = t_ns + period_ns + GUARD_NS

    def next_ns(self, now_ns: int) -> int:
        """When to read next, all sweeps that have ended by now being noted."""
        look_ns = self._look_ns
        if look_ns and min(look_ns.values()) <= now_ns:
            for board in [board for board, at_ns in look_ns.items() if at_ns <= now_ns]:
                late_ns = now_ns - self._due_ns[board]
                if late_ns < GIVE_UP_NS:
                    look_ns[board] = now_ns + max(RETRY_NS, late_ns)
                else:
                    del look_ns[board]
        all_known = len(look_ns) == len(self._periods_ns)
        longest_ns = max(LONGEST_NS, self._poll_ns) if all_known else self._poll_ns
        return min(now_ns + longest_ns, min(look_ns.values(), default=now_ns + longest_ns))


class WakeUp:
    """Wakes the reader of all ports by a `Plan`.

        wake_up = WakeUp(receive, {board: period_ns, ...})
        def work():
            for port in ports:
                for sweep in assembler.feed(port.read()):
                    wake_up.sweep_ended(sweep.board, sweep.t_ns)
        await wake_up.run(work)

    Args:
        receive: the interval of polling.
        periods_ns: nominal period of each board.
    """

    def __init__(self, receive: Receive, periods_ns: Mapping[int, int]) -> None:
        poll_ns = int(receive.poll_ms * 1e6)
        sweeps_hz = sum(1e9 / period_ns for period_ns in periods_ns.values())
        self._rest_ns = int(poll_ns * min(1.0, sweeps_hz / BUSY_HZ))
        self._plan = Plan(periods_ns, poll_ns)
        self.sweep_ended = self._plan.sweep_ended

    async def run(self, work: Callable[[], None]) -> None:
        """Call `work` whenever frames should be there, until it raises or this is cancelled."""
        loop = asyncio.get_running_loop()
        failure: asyncio.Future[None] = loop.create_future()
        with contextlib.closing(_Timer()) as timer:

            def wake() -> None:
                try:
                    began_ns = time.monotonic_ns()
                    work()
                    rest_ns = self._rest_ns - (time.monotonic_ns() - began_ns)
                    now_ns = time.time_ns()
                    timer.set(max(self._plan.next_ns(now_ns) - now_ns, rest_ns, 1))
                except Exception as error:
                    loop.remove_reader(timer.fileno)
                    if not failure.done():
                        failure.set_exception(error)

            loop.add_reader(timer.fileno, wake)
            timer.set(1)
            try:
                await failure
            finally:
                loop.remove_reader(timer.fileno)


class _Timer:
    """timerfd_create(2): the event loop's own timers are late by up to a millisecond."""

    _CLOCK_MONOTONIC = 1

    def __init__(self) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        self.fileno: int = libc.timerfd_create(self._CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self.fileno < 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code))
        self._set = libc.timerfd_settime
        # struct itimerspec: an interval (none) and a first time, each in s and ns.
        self._time = (ctypes.c_long * 4)()
        self._time_at = ctypes.byref(self._time)

    def set(self, delay_ns: int) -> None:
        """Become readable after `delay_ns` > 0, and not before."""
        self._time[2], self._time[3] = divmod(delay_ns, 1_000_000_000)
        self._set(self.fileno, 0, self._time_at, None)

    def close(self) -> None:
        os.close(self.fileno)
