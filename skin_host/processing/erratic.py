"""Detects pads that jump to and fro: a broken contact, not a pressure."""

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.curves import Curve
from skin_host.processing.masks import Mask

Floats = NDArray[np.float32]

#: From sample to sample, a pad's noise and a growing press stay below this many standard deviations
#: of its noise, and below this pressure.
STEP_DEVIATIONS = 6.0
STEP_UNITS = 8.0
#: A few samples with such steps both up and down count 1; each few without them subtract this. At
#: the limit a pad is erratic: no hand presses and releases that often.
RELIEF = 0.25
LIMIT = 2.0
#: A pad stays erratic for this long after its last jumps.
CALM_S = 60.0


class Erratic:
    """Finds which of m pads jump up and down by more than their noise under pressure.

    Args:
        step_kpa: [m], smallest step that cannot be noise; inf where it is not known.

    Attributes:
        pads: bool[m], the erratic pads; the array changes in place.
        any: whether there is one.
        suspects: whether any pad has jumped of late.
    """

    def __init__(self, step_kpa: NDArray[np.float64]) -> None:
        m = len(step_kpa)
        self._step = step_kpa.astype(np.float32)
        self._score = np.zeros(m, np.float32)
        self._left_s = np.zeros(m)
        self.pads: Mask = np.zeros(m, np.bool_)
        self.any = False
        self.suspects = False

    def look(self, rows: Floats) -> None:
        """Check some successive samples [k, m] in kPa."""
        if len(rows) < 3:
            return
        if self.suspects:
            np.subtract(self._score, np.float32(RELIEF), out=self._score)
            np.maximum(self._score, np.float32(0.0), out=self._score)
        # Few pads move that far at all; only those are looked at step by step.
        spread = rows.max(axis=0)
        np.subtract(spread, rows.min(axis=0), out=spread)
        moving = np.flatnonzero(spread > self._step)
        if len(moving):
            changes = np.diff(rows[:, moving], axis=0)
            step = self._step[moving]
            both = moving[(changes.max(axis=0) > step) & (changes.min(axis=0) < -step)]
            self._score[both] += np.float32(1.0 + RELIEF)
            beyond = both[self._score[both] > LIMIT]
            if len(beyond):
                self._score[beyond] = LIMIT
                self._left_s[beyond] = CALM_S
                self.pads[beyond] = True
                self.any = True
        elif not self.suspects:
            return
        self.suspects = bool(self._score.any())

    def reset(self, taxels: Mask) -> None:
        """Forget the jumps of taxels [m], which have a new zero."""
        self._score[taxels] = 0.0
        self._left_s[taxels] = 0.0
        self.pass_time(0.0)

    def pass_time(self, dt_s: float) -> None:
        """Let time pass, after which calm pads are no longer erratic."""
        if self.any:
            self._left_s -= dt_s
            np.greater(self._left_s, 0.0, out=self.pads)
            self.any = bool(self.pads.any())


def step_kpa(curve: Curve, noise_units: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the step [m] from sample to sample that a pad's noise does not reach."""
    end = np.clip(curve.beyond_units, 1.0, 255.0)
    step: NDArray[np.float64] = (
        np.maximum(STEP_DEVIATIONS * noise_units, STEP_UNITS) * curve.kpa(end) / end
    )
    return step
