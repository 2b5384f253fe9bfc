"""Plans when to read the ports.

A wake-up costs as much as reading dozens of frames, so the daemon wakes up only by its own plan. A
board sends its sweep once a period: after one sweep it is known when the last frame of the next is
due, and the ports are read right then. Of boards whose sweeps make one sample together (those of a
part) the last two are planned for, because nothing comes of the others before. While a board has
not sent yet, or not in time, the ports are read at fixed intervals; after some time without it
at longer ones.
"""

import asyncio
import contextlib
from collections.abc import Callable, Iterable, Mapping

from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Receive

#: The ports are read this long after the last frame of a sweep is due.
GUARD_NS = 200_000
#: If a sweep has not ended by then, the ports are read again: first after this time, then after as
#: long as it is late already. Other boards' frames go first on a full bus.
RETRY_NS = 1_000_000
#: A sweep that is later than this is no longer planned for.
GIVE_UP_NS = 10_000_000
#: A late sweep moves the plan by no more than this: the next may be in time again. It is enough to
#: follow a clock that is 0.1 % slower than nominal, at a period of 50 ms.
SLIP_NS = 50_000
#: With a plan for every board, the ports are read at least this often: once between two sweeps of
#: a board at 20 Hz.
LONGEST_NS = 26_000_000
#: A board that has sent nothing for this long is searched for no oftener than that.
SEARCH_NS = 2_000_000_000
#: At this rate of samples one is always due: then reads are one polling interval apart, and
#: proportionally with fewer samples, so that wake-ups never cost more than the frames.
BUSY_HZ = 1000.0

#: Of each sample, the boards whose sweeps it waits for.
Missing = Callable[[], Iterable[Iterable[int]]]


class Plan:
    """Predicts the ends of sweeps. Pure: takes and returns times in ns on the frames' clock.

    Args:
        periods_ns: nominal period of each board.
        poll_ns: interval of reading while some board is not predicted.
    """

    def __init__(
        self, periods_ns: Mapping[int, int], poll_ns: int, missing: Missing | None = None
    ) -> None:
        self._periods_ns = periods_ns
        self._poll_ns = poll_ns
        self._missing = missing or (lambda: ((board,) for board in periods_ns))
        self._due_ns: dict[int, int] = {}
        self._look_ns: dict[int, int] = {}
        #: Since when boards have been without a plan; None before the first call of `next_ns`.
        self._lost_ns: dict[int, int | None] = dict.fromkeys(periods_ns)

    def sweep_ended(self, board: int, t_ns: int) -> None:
        """Note the time of a sweep's last frame."""
        period_ns = self._periods_ns[board]
        late_ns = t_ns - self._due_ns.get(board, t_ns)
        if SLIP_NS < late_ns < period_ns // 2:
            t_ns -= late_ns - SLIP_NS
        self._due_ns[board] = t_ns + period_ns
        self._look_ns[board] = t_ns + period_ns + GUARD_NS
        if self._lost_ns:
            self._lost_ns.pop(board, None)

    def next_ns(self, now_ns: int) -> int:
        """Return when to read next, after all sweeps that ended by now were noted."""
        look_ns = self._look_ns
        if look_ns and min(look_ns.values()) <= now_ns:
            for board in [board for board, at_ns in look_ns.items() if at_ns <= now_ns]:
                late_ns = now_ns - self._due_ns[board]
                if late_ns < GIVE_UP_NS:
                    look_ns[board] = now_ns + max(RETRY_NS, late_ns)
                else:
                    del look_ns[board]
                    self._lost_ns[board] = now_ns
        sample_ns: int | None = None
        for boards in self._missing():
            # With the last but one, what came before it is worked off and does not delay the last.
            # In a plain loop, because this is done for every wake-up.
            last_ns = before_ns = -1
            for board in boards:
                if board in look_ns:
                    at_ns = look_ns[board]
                    if at_ns > last_ns:
                        before_ns, last_ns = last_ns, at_ns
                    elif at_ns > before_ns:
                        before_ns = at_ns
            end_ns = last_ns if before_ns < 0 else before_ns
            if end_ns >= 0 and (sample_ns is None or end_ns < sample_ns):
                sample_ns = end_ns
        if sample_ns is None:
            return now_ns + self._search_ns(now_ns)
        if self._lost_ns:
            return min(now_ns + self._search_ns(now_ns), sample_ns)
        # Looks between are spread evenly: none comes just before that for a sample.
        looks = -(-(sample_ns - now_ns) // max(LONGEST_NS, self._poll_ns))
        return now_ns + (sample_ns - now_ns) // looks

    def _search_ns(self, now_ns: int) -> int:
        """Return the interval of reads while some board is not predicted."""
        for board, since_ns in self._lost_ns.items():
            if since_ns is None:
                self._lost_ns[board] = now_ns
        newest_ns = max((ns for ns in self._lost_ns.values() if ns is not None), default=now_ns)
        return self._poll_ns if now_ns - newest_ns < SEARCH_NS else max(LONGEST_NS, self._poll_ns)


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
        clock: to wake by.
        missing: see `Plan`.
        samples_hz: how many samples come a second; without it each sweep is one.
    """

    def __init__(
        self,
        receive: Receive,
        periods_ns: Mapping[int, int],
        clock: Clock = SYSTEM,
        missing: Missing | None = None,
        samples_hz: float | None = None,
    ) -> None:
        self._clock = clock
        poll_ns = int(receive.poll_ms * 1e6)
        if samples_hz is None:
            samples_hz = sum(1e9 / period_ns for period_ns in periods_ns.values())
        self._rest_ns = int(poll_ns * min(1.0, samples_hz / BUSY_HZ))
        self._plan = Plan(periods_ns, poll_ns, missing)
        self.sweep_ended = self._plan.sweep_ended

    async def run(self, work: Callable[[], None]) -> None:
        """Call `work` whenever frames are expected, until it raises or this is cancelled."""
        failure: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        clock = self._clock

        def wake() -> None:
            try:
                began_ns = clock.monotonic_ns()
                work()
                rest_ns = self._rest_ns - (clock.monotonic_ns() - began_ns)
                now_ns = clock.now_ns()
                alarm.set(max(self._plan.next_ns(now_ns) - now_ns, rest_ns, 1))
            except Exception as error:
                alarm.close()
                if not failure.done():
                    failure.set_exception(error)

        with contextlib.closing(clock.alarm(wake)) as alarm:
            alarm.set(1)
            await failure
