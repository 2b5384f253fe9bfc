"""Dates frames that a library stamps by another clock, or only when it is asked for them. Pure."""

import math

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.port import PLAUSIBLE_S
from skin_host.bus.wire import HEADER_A, HEADER_B, MessageClass

#: Clocks that differ by less are the same. Within so long some frame is read at once.
SAME_S = 0.002
FRESH_S = 2.0
#: A clock that is not known yet is one if it differs by the same in two times of this length, one
#: after the other, to within so much.
PROOF_S = 1.0
STEADY_S = 0.02
#: Frames that come from a queue that has not been empty for longer than this have waited.
BACKLOG_S = 0.1
#: A frame that seems to have waited for so much longer than since the queue was empty has not, on
#: whatever way it came: its clock was set back, or begins again.
LONGEST_WAY_S = 5.0
#: No frame takes a shorter time on the bus. Reads are planned to be so far apart at most.
FRAME_NS = 111_000
LONGEST_NS = 30_000_000


class Stamps:
    """Brings the time stamps of another clock, an adapter's or another computer's, to this one's.

    They differ by what the freshest frame of some seconds seems to have waited. A clock that
    differs by a tenth of a period would make whole sweeps look cut, or boards as if they had
    sent in the future. A single stamp that is ahead may be damaged: two in a row show the clock.
    Frames that waited because this computer is too busy to read them in time show nothing of it.

    A clock that is far from the known one, at first the time of day, counts from the adapter's
    start, has begun again, or this computer's was set. It has to show that it is one: stamps that
    stand still, jump or are no numbers do not.
    """

    def __init__(self) -> None:
        self._behind_s = 0.0
        self._before_s = math.inf
        self._since_s = -math.inf
        self._least_s = math.inf
        self._emptied_s = math.inf
        #: By how much another clock than the known one differs at least, since a moment, and in the
        #: time before that.
        self._other_s = math.inf
        self._other_since_s = -math.inf
        self._other_before_s = math.inf
        #: By how much one differs that has shown to be a clock.
        self._shown_s: float | None = None

    def note_empty(self, now_s: float) -> None:
        """No more frames wait to be read."""
        self._emptied_s = now_s
        # Not before: a frame of the same read would seem to be older than the one before it.
        if self._shown_s is not None:
            self._behind_s, self._shown_s = self._shown_s, None
            self._since_s, self._least_s = now_s, math.inf

    def clock_set(self, step_s: float) -> None:
        """Note that this computer's clock was set, and the adapter's was not.

        That it was set back the next two frames show: they seem to be of the future.
        """
        self._behind_s += max(step_s, 0.0)

    def here(self, stamp_s: float, now_s: float) -> float | None:
        """Return the time on this computer's clock of a frame that is read now; None if its stamp
        is not of a known clock.
        """
        differs_s = now_s - stamp_s
        # After one of another clock, one that waited for long is of that, too.
        ahead_s = most_s = PROOF_S if self._other_s < math.inf else PLAUSIBLE_S
        if self._since_s > -math.inf and self._emptied_s <= now_s:
            most_s = min(most_s, LONGEST_WAY_S + now_s - self._emptied_s)
        if not -ahead_s <= differs_s - self._behind_s <= most_s:
            self._note_other(differs_s, now_s)
            return None
        if self._other_s < math.inf:
            self._other_s = self._other_before_s = math.inf
        before_s, self._before_s = self._before_s, differs_s
        waited_s = differs_s - self._behind_s
        if now_s - self._emptied_s <= BACKLOG_S:
            self._least_s = min(self._least_s, waited_s)
        if not 0 <= now_s - self._since_s < FRESH_S:
            # Frames that waited while this computer was busy come after fresh ones.
            if SAME_S < self._least_s < math.inf:
                self._behind_s += self._least_s
                waited_s -= self._least_s
            self._since_s, self._least_s = now_s, math.inf
        if waited_s < 0:
            self._behind_s = min(self._behind_s, max(differs_s, before_s))
            return now_s
        return now_s - waited_s

    def _note_other(self, differs_s: float, now_s: float) -> None:
        """Note a stamp of another clock than the known one, if it is of a clock."""
        if not 0 <= now_s - self._other_since_s < PROOF_S:
            if abs(self._other_s - self._other_before_s) <= STEADY_S:
                self._shown_s = self._other_s
            self._other_before_s, self._other_s = self._other_s, math.inf
            self._other_since_s = now_s
        self._other_s = min(self._other_s, differs_s)


class Reads:
    """Dates frames of which no more is known than when they were read.

    A board that a read finds in the middle of its sweep goes on at once: what comes up to its last
    frame followed without a pause. By the time of the next read, half a period later, its sweep
    would be cut, and the bus and the board would be accused.
    """

    def __init__(self) -> None:
        #: The halves that each board had sent of a sweep when all had been read, and that time.
        self._sent: dict[int, set[int]] = {}
        self._emptied_ns = 0

    def note_empty(self, now_ns: int) -> None:
        """No more frames wait to be read."""
        self._emptied_ns = now_ns

    def date(
        self, identifier: NDArray[np.uint32], header: NDArray[np.uint8], t_ns: NDArray[np.int64]
    ) -> None:
        """Date the frames of a read [n]; `t_ns` are the times at which they were read."""
        before, self._sent = self._sent, {}
        end = 0
        heads = zip(identifier.tolist(), header.tolist(), strict=True)
        for row, (number, first) in enumerate(heads):
            if number >> 8 != MessageClass.SKIN_STREAM or first not in (HEADER_A, HEADER_B):
                continue
            board, half = number >> 4, number << 8 | first
            sent = before.get(board)
            if sent is not None and half not in sent:
                end = row + 1
            else:
                before.pop(board, None)
                sent = self._sent.setdefault(board, set())
                if half in sent:
                    sent.clear()  # another sweep begins
            sent.add(half)
            self._sent[board] = sent
        if end and 0 < t_ns[end - 1] - self._emptied_ns <= LONGEST_NS:
            soonest_ns = self._emptied_ns + FRAME_NS * np.arange(1, end + 1)
            t_ns[:end] = np.minimum(t_ns[:end], soonest_ns)
