"""State of each board of a node: when it sent last, how regularly, what is missing.

There is one ledger for all boards, updated once per sweep. Supervision, validity and health read
it, so that there is one answer to each question: whether a board has timed out, what its status
words report, how often it was reset.

Silence is measured on a clock that only runs while the buses are read up to the present: it
advances with the reader's calls of `look` (in a replay with the sweeps' time stamps), a pause
counts for no more than a limit, or not at all if this computer was held up, and a clock that is set
back or forward changes nothing. While nothing is read, or old frames are read, no board times out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Sweep
from skin_host.bus.wire import (
    NO_STATUS,
    TAXELS,
    TRIANGLE_BITS,
    TRIANGLES,
    StatusError,
    out_of_range,
    status_error,
    triangles_in,
)
from skin_host.layout import BoardLayout

Mask = NDArray[np.bool_]

#: A pause between two calls of `look` counts for no more than this: after a longer one it is not
#: yet known which boards sent. Planned pauses are shorter.
LONGEST_PAUSE_NS = 100_000_000
#: A time stamp that is older than the newest by more than this comes from a clock that was set.
LONGEST_DISORDER_NS = 1_000_000_000
#: Intervals between sweeps that are kept.
INTERVALS = 16
#: After this long without a sweep, the intervals before it are not used for the period.
STALE_INTERVALS_NS = 1_000_000_000
#: Triangles are missing after this many sweeps in a row: single frames get lost and sweeps get cut.
MISSING_SWEEPS = 5
#: An MTB3 that zeroes itself, after five bad readings, sends nothing for four periods. It times out
#: no earlier than after this many: to query it then would stop it.
MTB3_PERIODS = 6.0
#: So many of its sweeps are missed then.
ZEROING_SWEEPS = 3
#: A chip that is lost reads 0xFFFF on all pads. Sent without status words, as in recordings of
#: other programs, that is 0, beyond all pressures, on this many pads at least, and 255, far below
#: none, where the correction of temperature wraps. No press does that: on 15 triangles of real skin
#: that were lost it was nine and one.
LOST_PADS = 8
#: A period that differs by more than this share is not the one that was set.
WRONG_PERIOD = 0.25
#: For a regular board all intervals, except the longest and shortest fifth, lie within this share.
UNEVEN = 0.1
#: Two boards send at one address when some triangle comes so many times as often as of one board,
#: for this long, and some sweeps too soon after the one before.
TWICE_SWEEPS = 1.4
TWICE_NS = 2_000_000_000
#: Where both send at the same moments, most triangles are cut, and so many sweeps a period come, of
#: one triangle or a few each. Frames that are late cut a sweep into two or three.
CUT_SWEEPS = 4.0
#: What waited while this computer was busy comes too soon as well, but in one burst.
BURST_NS = 250_000_000
#: It is over when so much time's sweeps of one board have come, none of them too soon.
ALONE_NS = 1_000_000_000
#: Of two boards, however far apart, one sweep a period does not come too soon, or fewer where
#: frames are lost. Of one that sends far too often nearly all do.
APART_SHARE = 0.7
LEAST_APART_SHARE = 0.4
#: Whatever a board sends, so many times as many sweeps as it is set up for are processed, and ...
MOST_OFTEN = 5.0
#: ... at once as many as it may send in this time: they have waited where a computer was busy.
MOST_WAITING_NS = 10_000_000_000
_NO_STATUS = bytes(2 * TRIANGLES)


@dataclass(slots=True)
class _Crowd:
    """Sweeps of a board of which some come too soon after the one before.

    Attributes:
        since_ns: time of the first that did, of those that are counted.
        counted_ns, counted: time and number of the sweep from which on they are counted.
        last_ns, last: time and number of the last that came too soon.
        apart: how many of those that are counted did not.
        came: int64[16], how many of those that are counted had each triangle.
    """

    since_ns: int
    counted_ns: int
    counted: int
    last_ns: int
    last: int
    apart: int = 0
    came: NDArray[np.int64] = field(default_factory=lambda: np.zeros(TRIANGLES, np.int64))

    def is_of_two(self, number: int, periods: float) -> bool:
        """Whether what came in so many periods, up to the sweep of this number, is of two boards.

        The same frames make more sweeps where some are late.
        """
        many = TWICE_SWEEPS * periods
        return number - self.counted > many and (
            int(self.came.max()) > many or number - self.counted > CUT_SWEEPS * periods
        )


class Allowance:
    """How much is processed of a board that may send far too often: it is broken, or hostile."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._taken = 0.0
        self._t_ns = 0

    def is_excess(self, t_ns: int) -> bool:
        """Return whether what came at this time is too much to be processed."""
        passed_ns, self._t_ns = max(t_ns - self._t_ns, 0), t_ns
        taken = max(self._taken - MOST_OFTEN * passed_ns / self._period_ns, 0.0)
        excess = (taken + 1.0) * self._period_ns > MOST_WAITING_NS
        self._taken = taken if excess else taken + 1.0
        return excess


class BoardLedger:
    """Arrays over the boards of a node; a board's place in them is its row.

    Args:
        boards: (index in `Layout.boards`, board) of each.
        silent_periods: a board has timed out after this many of its periods without a sweep, an
            MTB3 after `MTB3_PERIODS` if that is more.
        poll_ms: longest planned pause between two reads of the buses.

    Attributes:
        row: of each board, by its index.
        now_ns: the ledger's own clock; starts at 0.
        silent_after_ns: int64[b], after so long without a sweep a board has timed out.
        received_ns: int64[b], when the last sweep was received, on that clock.
        last: the last sweep of each board.
        sweeps: int64[b], how many were received.
        present: bool[b, 16], triangles of the last sweep.
        error: uint8[b, 16], error nibbles of the last sweep's status words, see `StatusError`; also
            of a chip whose bytes show that it is lost.
        far: bool[b, 16, 12], pads that are marked so as far out of range.
        flagged: whether a board's last sweep had any of these.
        absent: int64[b, 16], in how many sweeps in a row each enabled triangle has been missing.
        twice: rows of boards at whose address a second one sends, each with the time of a sweep
            since when: what comes is of one or the other.
        silences, resets, lost_set_ups, tx_overflows, rezeros: int64[b], how often it timed out,
            restarted by itself, sent something that it was not set up to send, reported that it had
            to drop frames, and was zeroed.
        excess: int64[b], how many of its sweeps are too many to be processed.
    """

    def __init__(
        self,
        boards: Sequence[tuple[int, BoardLayout]],
        silent_periods: float,
        poll_ms: float = 0.0,
    ) -> None:
        n = len(boards)
        self.row = {index: row for row, (index, _) in enumerate(boards)}
        self.now_ns = 0
        self._newest_ns: int | None = None
        self._looked = False
        #: Rows of the boards that sent since it was last looked.
        self._came: list[int] = []
        self._longest_ns = LONGEST_PAUSE_NS + int(poll_ms * 1e6)
        self._period_ns = np.array([board.settings.period_ms for _, board in boards]) * 1_000_000
        self.silent_after_ns = (silent_periods * self._period_ns).astype(np.int64)
        self._enabled = [board.enabled for _, board in boards]
        #: Rows of boards that pause where they zero themselves.
        self._pauses: set[int] = set()
        for row, (_, board) in enumerate(boards):
            if board.settings.model == "mtb3":
                self.expect_pauses(row)

        self.received_ns = np.zeros(n, np.int64)
        self._none_silent_until_ns = -1
        self.last: list[Sweep | None] = [None] * n
        self.sweeps = np.zeros(n, np.int64)
        self.present = np.zeros((n, TRIANGLES), np.bool_)
        self._present = [0] * n
        self.error = np.zeros((n, TRIANGLES), np.uint8)
        self.far = np.zeros((n, TRIANGLES, TAXELS), np.bool_)
        self.flagged = [False] * n
        #: Of boards with chips that are lost by their bytes, which triangles bool[16] these are.
        self._lost: dict[int, Mask] = {}
        self.absent = np.zeros((n, TRIANGLES), np.int64)
        self._complete = [True] * n
        self._intervals_ns = [[0] * INTERVALS for _ in range(n)]
        self._n_intervals = [0] * n
        #: Of each board, a mask of the intervals that are not within `WRONG_PERIOD` of its period.
        self._uneasy = [(1 << INTERVALS) - 1] * n
        self._easy_ns = [
            ((1 - WRONG_PERIOD) * period_ns, (1 + WRONG_PERIOD) * period_ns)
            for period_ns in self._period_ns.tolist()
        ]
        self._since_set_up = [0] * n
        self.twice: dict[int, int] = {}
        self._crowds: dict[int, _Crowd] = {}
        #: Of each board, of its sweeps that come too soon, and whether the last one is too much.
        self._early = [Allowance(period_ns) for period_ns in self._period_ns.tolist()]
        self._is_excess = [False] * n
        self.excess = np.zeros(n, np.int64)
        self.silences = np.zeros(n, np.int64)
        self.resets = np.zeros(n, np.int64)
        self.lost_set_ups = np.zeros(n, np.int64)
        self.tx_overflows = np.zeros(n, np.int64)
        self.rezeros = np.zeros(n, np.int64)

    def expect_pauses(self, row: int) -> None:
        """Give a board, an MTB3, the time to zero itself before it has timed out."""
        self._pauses.add(row)
        least_ns = int(MTB3_PERIODS * self._period_ns[row])
        self.silent_after_ns[row] = max(int(self.silent_after_ns[row]), least_ns)

    def look(self, now_ns: int) -> None:
        """Everything received up to `now_ns` has been read (clock of the time stamps)."""
        self._looked = True
        self._advance(now_ns)
        self._came.clear()

    def pass_over(self, now_ns: int) -> None:
        """The time up to `now_ns` does not count: frames of it may still be on their way."""
        self._looked = True
        self._newest_ns = now_ns
        self._came.clear()

    def note(self, sweep: Sweep) -> int:
        """Take in a sweep; return the row of its board."""
        row = self.row[sweep.board]
        if not self._looked:
            self._advance(sweep.t_ns)
        before = self.last[row]
        self.last[row] = sweep
        self.received_ns[row] = self.now_ns
        if self._looked:
            self._came.append(row)
        self.sweeps[row] += 1
        if before is not None and self._since_set_up[row]:
            self._note_interval(row, sweep.t_ns - before.t_ns)
        self._since_set_up[row] += 1
        if sweep.crowded or self._crowds:
            excess = self._is_excess[row] = sweep.crowded and self._early[row].is_excess(sweep.t_ns)
            self.excess[row] += excess
            self._note_crowd(row, sweep)
        if sweep.present != self._present[row]:
            self._present[row] = sweep.present
            self.present[row] = triangles_in(sweep.present)
        complete = not self._enabled[row] & ~sweep.present
        if not (complete and self._complete[row]):
            self._complete[row] = complete
            enabled = triangles_in(self._enabled[row])
            self.absent[row] = (self.absent[row] + enabled) * ~self.present[row]
        # Comparing bytes costs a tenth of numpy's `any`.
        flagged = sweep.status is not NO_STATUS and sweep.status.tobytes() != _NO_STATUS
        lost = self._note_lost(row, sweep, before)
        if flagged or lost is not None or self.flagged[row]:
            self.flagged[row] = flagged or lost is not None
            self.error[row] = status_error(sweep.status)
            self.far[row] = out_of_range(sweep.status)
            if lost is not None:
                self.error[row, lost] |= np.uint8(StatusError.NOT_CONNECTED)
                self.far[row, lost] = True
        return row

    def _note_lost(self, row: int, sweep: Sweep, before: Sweep | None) -> Mask | None:
        """Return the triangles bool[16] whose chips are lost by their bytes; None if none is. Their
        status word has precedence.

        A pad that read 255 already, before all others read 0, is one that is out of range beside a
        press.
        """
        lost_before = self._lost.pop(row, None)
        missing = TRIANGLES - sweep.present.bit_count()
        if sweep.raw.tobytes().count(0) < LOST_PADS + TAXELS * missing:
            return None
        wrapped = sweep.raw == 255
        if before is not None:
            was_far = before.raw == 255
            if lost_before is not None:
                was_far[lost_before] = False
            wrapped &= ~was_far
        pressed = np.count_nonzero(sweep.raw == 0, axis=1)
        lost: Mask = self.present[row] & (pressed >= LOST_PADS) & wrapped.any(axis=1)
        lost &= sweep.status == 0
        if not lost.any():
            return None
        self._lost[row] = lost
        return lost

    def set_up(self, row: int) -> None:
        """Note that a board has been set up: its earlier sweeps are no longer compared with the
        set-up.
        """
        self._since_set_up[row] = 0
        self._n_intervals[row] = 0

    def since_set_up(self, row: int) -> int:
        """Return how many sweeps came since a board was set up."""
        return self._since_set_up[row]

    def complete(self, row: int) -> bool:
        """Whether the last sweep had every enabled triangle."""
        return self._complete[row]

    @property
    def all_complete(self) -> bool:
        """Whether the last sweep of every board had every enabled triangle: none is absent then."""
        return all(self._complete)

    def is_excess(self, row: int) -> bool:
        """Return whether a board's last sweep is too much to be processed: a board that is broken,
        or hostile, sends as many as its bus carries.
        """
        return self._is_excess[row]

    @property
    def any_silent(self) -> bool:
        """Whether any board has timed out."""
        if self.now_ns <= self._none_silent_until_ns:
            return False
        # Boards that send meanwhile only move this further away.
        self._none_silent_until_ns = int((self.received_ns + self.silent_after_ns).min())
        return self.now_ns > self._none_silent_until_ns

    @property
    def silent(self) -> Mask:
        """Return the boards that have timed out, bool[b]."""
        return self.now_ns - self.received_ns > self.silent_after_ns

    def is_silent(self, row: int) -> bool:
        """Return whether a board has timed out."""
        return self.overdue(row, 0)

    def zeroing_ns(self, sweep: Sweep) -> int:
        """Return how long the board of a sweep paused before it, if it may have zeroed itself in
        that time without its status words showing it, because they were lost; otherwise 0.
        """
        row = self.row[sweep.board]
        if sweep.missed < ZEROING_SWEEPS or row not in self._pauses:
            return 0
        last = self.last[row]
        if self._looked or last is None:
            quiet_ns = self.now_ns - int(self.received_ns[row])
        else:
            quiet_ns = sweep.t_ns - last.t_ns
        # A clock that was set makes a gap of time stamps only.
        return quiet_ns if quiet_ns >= ZEROING_SWEEPS * int(self._period_ns[row]) else 0

    def silent_ns(self, board: int) -> int:
        """Return for how long a board, by its index, has not been received, if it has timed out;
        otherwise 0.
        """
        row = self.row[board]
        return self.now_ns - int(self.received_ns[row]) if self.is_silent(row) else 0

    def overdue(self, row: int, since_ns: int) -> bool:
        """As `is_silent`, for a board that could not send before `since_ns` (ledger's clock)."""
        quiet_ns = self.now_ns - max(int(self.received_ns[row]), since_ns)
        return quiet_ns > int(self.silent_after_ns[row])

    def is_easy(self, row: int) -> bool:
        """Return whether a board sends all that it was set up to send, each of its last sweeps
        within `WRONG_PERIOD` of its period. One that does not may do so within other limits.
        """
        return (
            self._complete[row]
            and self._since_set_up[row] > 0
            and not self._uneasy[row]
            and (self.now_ns <= self._none_silent_until_ns or not self.is_silent(row))
        )

    def missing(self, row: int) -> int:
        """Return a mask of the enabled triangles that a board has not sent since it was set up, or
        has stopped sending.
        """
        if self._complete[row] or self._since_set_up[row] < MISSING_SWEEPS:
            return 0
        return int((self.absent[row] >= MISSING_SWEEPS) @ (1 << TRIANGLE_BITS))

    def intervals_ns(self, row: int) -> NDArray[np.int64]:
        """Return the last intervals int64[up to 16] between a board's sweeps, the oldest first."""
        n, intervals = self._n_intervals[row], self._intervals_ns[row]
        oldest = n % INTERVALS if n > INTERVALS else 0
        return np.array([*intervals[oldest:], *intervals[:oldest]][:n], np.int64)

    def answered(self, row: int) -> NDArray[np.bool_]:
        """Return the triangles bool[16] of a board whose last sweep came without an `error`."""
        found: NDArray[np.bool_] = self.present[row] & (self.error[row] == 0)
        return found

    def regular_period_ns(self, row: int) -> float | None:
        """Return the median of a board's last intervals, or None if they are few or irregular.

        A board's timer is regular, whatever period is set. Irregular intervals are delays
        elsewhere.
        """
        return regular_ns(self._intervals_ns[row][: self._n_intervals[row]])

    def keeps_period(self, row: int) -> bool | None:
        """Return whether a board sends in its configured period, within `WRONG_PERIOD`; None where
        `regular_period_ns` is not known.
        """
        return is_period(self.regular_period_ns(row), float(self._period_ns[row]))

    def _note_crowd(self, row: int, sweep: Sweep) -> None:
        """Decide whether two boards send at an address.

        By the sweeps alone, so that neither a silence nor a clock that is set ends it.
        """
        crowd, t_ns, number = self._crowds.get(row), sweep.t_ns, int(self.sweeps[row])
        period_ns = int(self._period_ns[row])
        if crowd is not None:
            crowd.came += triangles_in(sweep.present)
        if not sweep.crowded:
            if crowd is not None:
                crowd.apart += 1
                passed_ns, came_ns = t_ns - crowd.last_ns, (number - crowd.last) * period_ns
                if passed_ns < 0:
                    crowd.last_ns, crowd.last = t_ns, number
                elif ALONE_NS <= came_ns <= TWICE_SWEEPS * passed_ns:
                    del self._crowds[row]
                    self.twice.pop(row, None)
            return
        if crowd is None or not 0 <= t_ns - crowd.last_ns < ALONE_NS:
            self._crowds[row] = _Crowd(t_ns, t_ns, number, t_ns, number)
            return
        crowd.last_ns, crowd.last = t_ns, number
        if t_ns - crowd.since_ns < BURST_NS:
            crowd.counted_ns, crowd.counted, crowd.apart = t_ns, number, 0
            crowd.came[:] = 0
        elif t_ns - crowd.since_ns >= TWICE_NS:
            passed_ns = t_ns - crowd.counted_ns
            apart = crowd.apart * period_ns / passed_ns
            if crowd.is_of_two(number, passed_ns / period_ns) and apart > APART_SHARE:
                self.twice.setdefault(row, crowd.since_ns)
            elif apart < LEAST_APART_SHARE:
                self.twice.pop(row, None)
            self._crowds[row] = _Crowd(t_ns, t_ns, number, t_ns, number)

    def _note_interval(self, row: int, interval_ns: int) -> None:
        if not 0 < interval_ns < STALE_INTERVALS_NS:
            self._n_intervals[row] = 0
            return
        n = self._n_intervals[row]
        place = n % INTERVALS
        self._intervals_ns[row][place] = interval_ns
        self._n_intervals[row] = n + 1
        least_ns, most_ns = self._easy_ns[row]
        if least_ns < interval_ns < most_ns:
            self._uneasy[row] &= ~(1 << place)
        else:
            self._uneasy[row] |= 1 << place

    def _advance(self, now_ns: int) -> None:
        newest_ns, self._newest_ns = self._newest_ns, now_ns
        if newest_ns is None:
            return
        passed_ns = now_ns - newest_ns
        if passed_ns > self._longest_ns:
            # What waited in a pause was read at once: who sent in it did so until now.
            self.now_ns += self._longest_ns
            self.received_ns[self._came] = self.now_ns
        elif passed_ns > 0:
            self.now_ns += passed_ns
        elif passed_ns > -LONGEST_DISORDER_NS:
            self._newest_ns = newest_ns


def regular_ns(intervals_ns: list[int]) -> float | None:
    """Return the median of the last `INTERVALS` intervals of a board, or None if they are few or
    irregular.
    """
    # For so few numbers a list is faster than an array.
    intervals = sorted(intervals_ns)
    if len(intervals) < INTERVALS // 2 - 1:
        return None
    fifth, usual_ns = len(intervals) // 5, float(median(intervals))
    spread_ns = intervals[-1 - fifth] - intervals[fifth]
    return usual_ns if spread_ns < UNEVEN * usual_ns else None


def is_period(seen_ns: float | None, period_ns: float) -> bool | None:
    """Return whether what is seen of a period is that period, within `WRONG_PERIOD`; None where
    nothing is known of it.
    """
    return None if seen_ns is None else abs(seen_ns - period_ns) <= WRONG_PERIOD * period_ns
