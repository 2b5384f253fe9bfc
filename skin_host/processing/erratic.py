"""Detects pads that jump to and fro: a broken contact, not a pressure.

Pads jump faster than a hand, which is seen where sweeps come fast; or scatter beyond their measured
range, see `scatter`. Where most pads of a chip do, it is the chip whose contact is broken: the
others, which have not been found yet or have less noise, are no measurement either. Pads that have
not been valid of late for another reason, as they are noisy or stuck, decide nothing in this.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.curves import Curve
from skin_host.processing.masks import Mask
from skin_host.processing.scatter import Scatter

Floats = NDArray[np.float32]

#: From sample to sample, a pad's noise and a growing press stay below this many standard deviations
#: of its noise, and below this pressure.
STEP_DEVIATIONS = 6.0
STEP_UNITS = 8.0
#: A hand presses at most this often, and half of that time it releases. A pad that rises, falls and
#: rises in less time, or falls, rises and falls, or rises sooner after it began to fall, is not
#: pressed so: its contact is broken. A pad may have moved at any time since the measurement before:
#: that is the sample before, or the conversion before where each is sent several times. Where some
#: are left out, the sample before may show one that is nearly a conversion old.
FASTEST_HZ = 5.0
#: Each look that finds such a pad counts 1, and time takes away this much; at the limit the pad is
#: erratic.
RELIEF_PER_S = 0.25
LIMIT = 2.0
#: A pad stays erratic for this long after its last jumps.
CALM_S = 60.0
#: Fewer pads of one chip may jump each by itself.
LEAST_OF_CHIP = 3
#: What was not valid at so many looks, one a second, has not been so of late.
LATELY_LOOKS = 3


class Erratic:
    """Finds which of m pads jump up and down by more than their noise, faster than a hand, or
    scatter beyond their range.

    Pads that are read less than three times as often as a hand presses look alike, jumping or
    tapped: none of them is found within its range.

    Args:
        step_kpa: [m], smallest step that cannot be noise; inf where it is not known.
        range_kpa: [m], pressure up to which each pad was measured.
        chip: int[m], which chip each pad is read by, any numbering.

    Attributes:
        pads: bool[m], the erratic pads, and all pads of a chip with mostly such; the array changes
            in place.
        any: whether there is one.
        suspects: whether any pad has jumped of late.
    """

    def __init__(
        self,
        step_kpa: NDArray[np.float64],
        range_kpa: NDArray[np.float64],
        chip: NDArray[np.integer[Any]],
    ) -> None:
        m = len(step_kpa)
        self._chip = np.unique(chip, return_inverse=True)[1].astype(np.intp)
        self._known: Mask = np.isfinite(step_kpa)
        #: At how many looks each pad was last not valid.
        self._missed = np.zeros(m, np.int8)
        self._step = step_kpa.astype(np.float32)
        beside = quieter_of_chip(self._chip, self._known, self._step)
        self._scatter = Scatter(self._step, range_kpa.astype(np.float32), beside)
        self._score = np.zeros(m, np.float32)
        self._left_s = np.zeros(m)
        self._now_s = 0.0
        #: The last sample, if what is looked at next follows it.
        self._before: Floats | None = None
        #: Whether each pad last rose; and for each way, down and up, since when at the earliest it
        #: moves so, and the same of the last time before it moved the other way.
        self._rose: Mask = np.zeros(m, np.bool_)
        self._began_s = np.full((2, m), -np.inf)
        self._earlier_s = np.full((2, m), -np.inf)
        self.pads: Mask = np.zeros(m, np.bool_)
        self.any = False
        self.suspects = False

    def look(self, rows: Floats, steps_s: Sequence[float]) -> None:
        """Check some successive samples.

        Args:
            rows: [k, m], in kPa.
            steps_s: k times from sample to sample, the first from the sample before `rows`.
        """
        before, self._before = self._before, rows[-1].copy()
        times_s = np.cumsum([self._now_s, *steps_s]).tolist()
        elapsed_s, self._now_s = times_s[-1] - self._now_s, times_s[-1]
        spread, lowest = rows.max(axis=0), rows.min(axis=0)
        scattered = self._scatter.look(rows, steps_s, spread)
        if len(scattered):
            self._accuse(scattered)
        # Few pads move that far at all; only those are looked at step by step.
        if before is not None:
            np.maximum(spread, before, out=spread)
            np.minimum(lowest, before, out=lowest)
        np.subtract(spread, lowest, out=spread)
        moving = np.flatnonzero(spread > self._step)
        if self.suspects:
            relief = np.float32(RELIEF_PER_S * elapsed_s)
            np.subtract(self._score, relief, out=self._score)
            np.maximum(self._score, np.float32(0.0), out=self._score)
        if len(moving):
            first = rows[0] if before is None else before
            changes = np.diff(rows[:, moving], axis=0, prepend=first[np.newaxis, moving])
            step = self._step[moving]
            found = self._jumped(moving, changes < -step, changes > step, times_s)
            self._score[found] += np.float32(1.0)
            beyond = found[self._score[found] >= LIMIT]
            if len(beyond):
                self._score[beyond] = LIMIT
                self._accuse(beyond)
        elif not self.suspects:
            return
        self.suspects = bool(self._score.any())

    def wait(self, elapsed_s: float) -> None:
        """Let time pass in which no pad need be looked at."""
        self._now_s += elapsed_s
        self._before = None
        self._scatter.wait()

    def _accuse(self, pads: NDArray[np.intp]) -> None:
        self._left_s[pads] = CALM_S
        self._mark()

    def _mark(self) -> None:
        """Mark the pads that have not been calm for long enough, and those of their chips."""
        np.greater(self._left_s, 0.0, out=self.pads)
        self.any = bool(self.pads.any())
        if self.any:
            judged = self._known & (self.pads | (self._missed < LATELY_LOOKS))
            found, of_chip = (
                np.bincount(self._chip[pads], minlength=len(self.pads))
                for pads in (self.pads, judged)
            )
            broken: Mask = found >= most_of(of_chip)
            if broken.any():
                np.logical_or(self.pads, broken[self._chip], out=self.pads)

    def _jumped(
        self,
        moving: NDArray[np.intp],
        falls: Mask,
        rises: Mask,
        times_s: list[float],
    ) -> NDArray[np.intp]:
        """Return which of the moving pads moved to and fro too fast.

        Args:
            moving: which pads [p].
            falls, rises: bool[k, p], which of them moved so from sample to sample.
            times_s: k + 1, of these samples.
        """
        found: Mask = np.zeros(len(moving), np.bool_)
        shortest_s = 1.0 / FASTEST_HZ
        rising = self._rose[moving]
        began_s, earlier_s = self._began_s[:, moving], self._earlier_s[:, moving]
        for fell, rose, (since_s, now_s) in zip(falls, rises, pairwise(times_s), strict=True):
            leaves_out = now_s - since_s >= CONVERSION_S
            measured_s = (since_s if leaves_out else now_s) - CONVERSION_S
            for way, begins in ((0, fell & rising), (1, rose & ~rising)):
                found |= begins & (earlier_s[way] > now_s - shortest_s)
                np.copyto(earlier_s[1 - way], began_s[1 - way], where=begins)
                began_s[way, begins] = measured_s
            found |= rose & ~rising & (began_s[0] > now_s - shortest_s / 2.0)
            rising = (rising | rose) & ~fell
        self._rose[moving] = rising
        self._began_s[:, moving], self._earlier_s[:, moving] = began_s, earlier_s
        return moving[found]

    def reset(self, taxels: Mask) -> None:
        """Forget the jumps of taxels [m], which have a new zero."""
        self._score[taxels] = 0.0
        self._left_s[taxels] = 0.0
        self._rose[taxels] = False
        self._before = None
        self._began_s[:, taxels] = self._earlier_s[:, taxels] = -np.inf
        self._scatter.reset(taxels)
        self.pass_time(0.0)

    def note_valid(self, pads: Mask) -> None:
        """Note once a second which pads [m] are valid, but for being erratic."""
        before = self._missed < LATELY_LOOKS
        self._missed += before
        self._missed[pads] = 0
        lately = self._missed < LATELY_LOOKS
        if not np.array_equal(lately, before):
            watched = self._known & lately
            self._scatter.compare(quieter_of_chip(self._chip, watched, self._step))

    def pass_time(self, dt_s: float) -> None:
        """Let time pass, after which calm pads are no longer erratic."""
        if self.any:
            self._left_s -= dt_s
            self._mark()


def most_of(pads: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return how many of so many pads of a chip show that its connection is broken."""
    return np.maximum(pads // 2 + 1, LEAST_OF_CHIP)


def quieter_of_chip(chip: NDArray[np.intp], watched: Mask, step_kpa: Floats) -> NDArray[np.intp]:
    """Return for each pad [m] the watched one of its chip with the next smaller step; of the one
    with the smallest the next larger; for one that is not watched, or alone, itself.

    A quiet pad shows a broken contact long before one whose own noise hides it, and waits for none.
    """
    beside = np.arange(len(chip))
    order = np.flatnonzero(watched)
    order = order[np.lexsort((step_kpa[order], chip[order]))]
    quieter, louder = order[:-1], order[1:]
    alike = chip[quieter] == chip[louder]
    beside[quieter[alike]] = louder[alike]
    beside[louder[alike]] = quieter[alike]
    return beside


def step_kpa(curve: Curve, noise_units: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the step [m] from sample to sample that a pad's noise does not reach."""
    step: NDArray[np.float64] = (
        np.maximum(STEP_DEVIATIONS * noise_units, STEP_UNITS) * range_kpa(curve) / _end_units(curve)
    )
    return step


def range_kpa(curve: Curve) -> NDArray[np.float64]:
    """Return the pressure [m] up to which the pads were measured."""
    return curve.kpa(_end_units(curve))


def _end_units(curve: Curve) -> NDArray[np.float64]:
    end: NDArray[np.float64] = np.clip(curve.beyond_units, 1.0, 255.0)
    return end
