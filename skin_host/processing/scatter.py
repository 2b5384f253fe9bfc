"""Finds pads that scatter beyond their measured range: a broken contact, not a pressure.

A pad whose connection is broken reads another value with each conversion. Where sweeps are far
apart a hand may have pressed between two of them, so how often a reading moves to and fro decides
nothing. What does is by how much, and that its moves take each other back: of independent readings
the next move takes back half of each in the mean, while a press that grows, ends, or is modulated
at less than a quarter of the rate of sweeps goes on in the same direction as often as not.

A press that is released between two sweeps would look like that, too: three readings in which one
falls far speak against scatter, each three alike, however far the moves of the others are. A hand
that taps releases for a third of the time or more; a contact that also opens now and then, for one
reading of seven or fewer, is found by the others. Within the range that a pad was measured in,
nothing is found: a grip may tremble. Beyond it a reading is an estimate, and one that scatters is
none. A press beyond the range that is modulated faster than that, and never released, looks the
same.

Readings that are further apart show several moves of a hand, and a steady rhythm of it takes itself
back. But what presses a chip's pads, which lie within three centimetres, moves them together, or
one up as the other goes down; where the chip's connection is broken each reads what it likes. So
of boards that send more seldom a pad is found only with another one of its chip, if both scatter
and the moves of one do not go with the other's.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.conversions import YOUNG_S
from skin_host.processing.masks import Mask

Floats = NDArray[np.float32]

#: Sums are over about this many conversions. With them the mean square of noise is known to 15 %:
#: noise of 1.5 times its measured deviation stays below the least scatter by five of these.
MEMORY_CONVERSIONS = 64
#: A pad scatters by more than this share of the step that its noise does not reach: by twice the
#: deviation of its noise, where a step is six.
LEAST_SHARE = 1.0 / 3.0
#: The next move takes back more than this share of each, by the products and squares of moves of a
#: step at most. Independent readings: 1/2, or 1/3 where all moves are larger than a step and only
#: their directions are left. A modulation at a quarter of the rate: 0.
TAKEN_BACK = 1.0 / 6.0
#: Of three readings in which the lowest is below this share of the highest, a press may have been
#: released, on a pad that something else presses, too.
RELEASED = 0.4
#: Such three count against scatter by this share of the square of a step: by as much as three
#: independent readings count for it whose moves are all larger than a step. They are counted, not
#: weighed by their moves: a fall is far larger than what a broken contact scatters by beside it.
AGAINST = 1.0 / 3.0 - TAKEN_BACK
#: A hand that presses five times a second moves one way for a tenth of one. Readings that are
#: further apart show several moves of a hand, and of them pads are compared with those beside them;
#: sweeps may be a quarter late.
LONGEST_S = 0.125
#: Boards send at least every 209 ms, and a sweep is lost now and then; readings that are further
#: apart are not compared.
LONGEST_BESIDE_S = 0.5
#: Moves of two pads do not go together, or against each other, if their correlation is below this.
#: Of independent ones it is known to 0.1, to 0.3 when a pad of wild readings is first found.
#: Moves of one press that are large enough to be found have some 0.8 or more, with their noise.
ALIKE = 0.5

_NONE: NDArray[np.intp] = np.zeros(0, np.intp)


class Scatter:
    """Finds which of m pads read another value with each conversion, beyond their range.

    Args:
        step_kpa: [m], smallest step that cannot be noise; inf where it is not known.
        range_kpa: [m], pressure up to which the pad was measured.
        beside: int[m], another pad of the same chip; the pad itself where there is none.
    """

    def __init__(self, step_kpa: Floats, range_kpa: Floats, beside: NDArray[np.intp]) -> None:
        self._step = step_kpa
        self._beside = beside
        self._range = np.where(np.isfinite(step_kpa), range_kpa, np.float32(np.inf))
        least = 2.0 * MEMORY_CONVERSIONS * (LEAST_SHARE * step_kpa) ** 2
        self._least = least.astype(np.float32)
        #: Of pads that were beyond their range of late: what moves have taken back of those before
        #: them, less what counts against scatter; and the mean squares of both, of those readings
        #: that count for it. Sums in kPa^2, of which the old ones fade.
        self._taken_back = np.zeros_like(step_kpa)
        self._moved = np.zeros_like(step_kpa)
        #: The same of products of its moves with those of the pad beside it, of slow boards.
        self._together = np.zeros_like(step_kpa)
        self._watched = False
        #: The last two samples that may be conversions of their own, and how long ago the last was.
        self._before: Floats | None = None
        self._since_s = np.inf
        #: Whether that was too long for a hand's move, so that pads are compared with each other.
        self._is_slow = False

    def look(self, rows: Floats, steps_s: Sequence[float], highest_kpa: Floats) -> NDArray[np.intp]:
        """Return which pads scatter, after some successive samples.

        Args:
            rows: [k, m], in kPa.
            steps_s: k times from sample to sample, the first from the sample before `rows`.
            highest_kpa: [m], the highest of `rows`.
        """
        new = self._conversions(steps_s)
        if not new:
            return _NONE
        before = self._before
        self._before = rows[new[-2:]]
        if before is not None and len(new) == 1:
            self._before = np.concatenate([before[-1:], self._before])
        seen: Mask = highest_kpa > self._range
        if self._watched:
            seen |= self._moved > 0.0
        pads = np.flatnonzero(seen)
        if not len(pads):
            return pads
        if len(new) + (0 if before is None else len(before)) < 3:
            return _NONE

        def readings(of: NDArray[np.intp]) -> Floats:
            last: Floats = rows[new].take(of, axis=1)
            return last if before is None else np.concatenate([before.take(of, axis=1), last])

        found = self._judge(pads, readings(pads))
        if self._is_slow:
            beside = self._beside[pads]
            found &= self._differ(pads, readings(pads), beside, readings(beside))
        return pads[found]

    def _judge(self, pads: NDArray[np.intp], readings: Floats) -> Mask:
        """Return which of some pads [p] scatter, with their next readings [j, p]."""
        step = self._step[pads]
        moves = self._moves(pads, readings)
        first, second = moves[:-1], moves[1:]
        squares = moves * moves
        squares = 0.5 * (squares[:-1] + squares[1:])
        highest = np.maximum(np.maximum(readings[:-2], readings[1:-1]), readings[2:])
        lowest = np.minimum(np.minimum(readings[:-2], readings[1:-1]), readings[2:])
        counts = (highest > self._range[pads]) & (lowest >= RELEASED * highest)
        taken_back = -first * second
        against = np.float32(-AGAINST) * step * step
        np.minimum(taken_back, against, out=taken_back, where=~counts)
        squares *= counts
        remains = _remains(len(first))
        sums = self._taken_back[pads] * remains + taken_back.sum(axis=0)
        moved = self._moved[pads] * remains + squares.sum(axis=0)
        # Nothing speaks for scatter any more.
        calm = (sums <= 0.0) & ~counts.any(axis=0)
        sums[calm] = moved[calm] = 0.0
        self._taken_back[pads], self._moved[pads] = sums, moved
        self._watched = bool(moved.any())
        found: Mask = (sums > TAKEN_BACK * moved) & (moved > self._least[pads])
        return found

    def _differ(
        self,
        pads: NDArray[np.intp],
        readings: Floats,
        beside: NDArray[np.intp],
        readings_beside: Floats,
    ) -> Mask:
        """Return of which of some pads [p] the one beside it [p] scatters, too, and otherwise, with
        the next readings [j, p] of both; all have been judged by them.
        """
        moves = self._moves(pads, readings)[1:]
        moves *= self._moves(beside, readings_beside)[1:]
        together = self._together[pads] * _remains(len(moves)) + moves.sum(axis=0)
        moved, moved_beside = self._moved[pads], self._moved[beside]
        together[moved == 0.0] = 0.0
        self._together[pads] = together
        differ: Mask = self._taken_back[beside] > TAKEN_BACK * moved_beside
        differ &= moved_beside > self._least[beside]
        differ &= together * together < ALIKE**2 * moved * moved_beside
        return differ

    def _moves(self, pads: NDArray[np.intp], readings: Floats) -> Floats:
        """Return from reading to reading by how much some pads [p] move, by a step at most."""
        step = self._step[pads]
        moves: Floats = np.clip(np.diff(readings, axis=0), -step, step)
        return moves

    def _conversions(self, steps_s: Sequence[float]) -> list[int]:
        """Return which samples, at these distances, may be conversions of their own of all pads,
        and can be compared with the ones before them.
        """
        new: list[int] = []
        for row, step_s in enumerate(steps_s):
            self._since_s += step_s
            if self._since_s < YOUNG_S:
                continue
            is_slow = self._since_s > LONGEST_S
            if self._since_s > LONGEST_BESIDE_S:
                new.clear()
                self._before = None
            elif is_slow != self._is_slow:
                # What is compared goes on from the last sample.
                if new:
                    del new[:-1]
                    self._before = None
                elif self._before is not None:
                    self._before = self._before[-1:]
            self._is_slow = is_slow
            new.append(row)
            self._since_s = 0.0
        return new

    def compare(self, beside: NDArray[np.intp]) -> None:
        """Compare each pad with another one [m] from now on; see the class."""
        self._together[beside != self._beside] = 0.0
        self._beside = beside

    def wait(self) -> None:
        """Nothing touches: what was seen before is over."""
        self._before = None
        self._since_s = np.inf
        if self._watched:
            for sums in (self._taken_back, self._moved, self._together):
                sums.fill(0.0)
            self._watched = False

    def reset(self, taxels: Mask) -> None:
        """Forget what taxels [m] have read: they have a new zero."""
        self._before = None
        self._since_s = np.inf
        for sums in (self._taken_back, self._moved, self._together):
            sums[taxels] = 0.0
        self._watched = bool(self._moved.any())


def _remains(readings: int) -> np.float32:
    """Return what is left of a sum after so many more readings."""
    return np.float32((1.0 - 1.0 / MEMORY_CONVERSIONS) ** readings)
