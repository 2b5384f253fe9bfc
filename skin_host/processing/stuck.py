"""Single pads that stand still in a triangle that is otherwise alive.

A pad is stuck when it repeats itself (`repeats`) for longer than chance allows. What chance
allows is not told by how often the pad moves at all. Of a pad that reads 240 in 6 of 10
samples, 239 and 241 in 2 each, 44 % of all samples repeat the one before. But a long run is
spent at 240, where 60 % repeat. So moves are counted out of runs that have begun, and a run
of k more repeats, after m moves in n such samples, has the probability
B(m, n - m + k) / B(m, n - m) (Bayes' rule), which is (1 - m/n)^k where n is large.

This is slow by nature. Per sample a repetition tells -ln(p) of the pad's commonest byte, 0.4
to 0.9 at the noise of a hand's pads (0.4 to 0.8 units), and `ODDS` ask for 25.3.
"""

import math

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.masks import Mask, any_of
from skin_host.processing.repeats import Repeats

Floats = NDArray[np.float64]

#: A run with a probability below 1/odds is not chance. 2000 taxels at 20 Hz begin some 10^11
#: runs a year.
ODDS = 1e11
#: A run has begun after so many repeats.
BEGUN = 2
#: Moves are counted over about this time, in steps of about this many samples.
MEMORY_S = 300.0
STEP_SAMPLES = 20
#: A calibration is worth so many samples of runs that have begun.
CALIBRATED_SAMPLES = 100
#: No pad is taken to move more often than in so many of its samples, nor to have less noise.
MOST_RATE = 0.8
LEAST_NOISE_UNITS = 0.1
#: A quiet pad at the edge between two bytes moves often until it drifts away from there. Its rate
#: is taken for no more than so many times that of one that rests in the middle.
RESTING_MARGIN = 1.25
#: A repeat while something else is touched weighs one in so much.
TOUCHED_PACE = 6
#: So many moves make a stuck pad believable again.
PROBATION_MOVES = 3
LONGEST_RUN = 1e6
NEWTON_STEPS = 8


class StuckPads:
    """Watches the pads of the k triangles of one board.

    Args:
        noise_units: float64[k, 12], calibrated noise of the bytes.
        share: how many of its samples are new conversions, 0 to 1.
        period_s: how often the board sends.
        repeats: tells which pads say something new.

    Attributes:
        stuck: bool[k, 12].
        any_stuck: whether any is.
        longest: float64[k, 12], repeats in a row that chance allows now.
    """

    def __init__(
        self, noise_units: Floats, share: float, period_s: float, repeats: Repeats
    ) -> None:
        shape = noise_units.shape
        self._repeats = repeats
        self._begun = math.ceil(BEGUN / share)
        self._forget = min(1.0, STEP_SAMPLES * period_s / MEMORY_S)
        resting = share * rate_in_run(repeats.own_noise(noise_units))
        most = np.where(repeats.shifted, MOST_RATE, RESTING_MARGIN * resting)
        self._most = np.minimum(most, MOST_RATE)
        self._seen = np.full(shape, float(CALIBRATED_SAMPLES))
        self._moved = resting * CALIBRATED_SAMPLES
        self._run = np.zeros(shape)
        self._to_show = np.zeros(shape, np.int64)
        self._new_seen = np.zeros(shape)
        self._new_moved = np.zeros(shape, np.int64)
        self._samples = 0
        self.stuck: Mask = np.zeros(shape, np.bool_)
        self.any_stuck = False
        self._renew_limits()

    def step(
        self,
        raw: NDArray[np.uint8],
        changed: Mask,
        compared: Mask,
        unproven: Mask,
        touched: Mask | None,
    ) -> None:
        """Take one sweep.

        Args:
            raw: uint8[k, 12].
            changed: bool[k, 12], bytes that differ from those before.
            compared: bool[k], triangles that came now and before.
            unproven: bool[k], triangles that are not believed at all.
            touched: bool[k, 12], pads that were touched a moment ago, if any was.
        """
        within = inside(raw) & compared[:, None]
        moved, told = self._repeats.step(raw, changed, within)
        run = self._run
        if touched is None:
            # A run counts when it ends: one that does not may be no chance.
            ended = moved & (run >= self._begun)
            np.add(self._new_seen, run - (self._begun - 1), out=self._new_seen, where=ended)
            self._new_moved += ended
            run += told
        else:
            # What a pad feels all by itself is no excuse: it may be stuck there.
            run += told / np.where(np.count_nonzero(touched) > touched, TOUCHED_PACE, 1)
        np.copyto(run, 0.0, where=moved)
        self._samples += 1
        if self._samples >= STEP_SAMPLES:
            self._learn(unproven)
        too_long = run > self.longest
        if not self.any_stuck and not any_of(too_long):
            return
        run[unproven] = 0.0
        too_long &= run > 0.0
        self._to_show -= moved & (self._to_show > 0)
        self._to_show[too_long] = PROBATION_MOVES
        self.stuck = self._to_show > 0
        self.any_stuck = any_of(self.stuck)

    def _learn(self, unproven: Mask) -> None:
        """Let the rates follow what was seen of pads that live."""
        lives = ~self.stuck & ~unproven[:, None]
        keep = np.where(lives, 1.0 - self._forget, 1.0)
        self._seen = self._seen * keep + np.where(lives, self._new_seen, 0.0)
        self._moved = self._moved * keep + np.where(lives, self._new_moved, 0)
        self._new_seen[:] = 0.0
        self._new_moved[:] = 0
        self._samples = 0
        self._renew_limits()

    def _renew_limits(self) -> None:
        rate = np.minimum(self._moved / np.maximum(self._seen, 1.0), self._most)
        self.longest = self._begun + longest_run(rate, self._seen, ODDS)


def rate_in_run(noise_units: Floats) -> Floats:
    """How often a pad leaves the byte in which it rests, given the noise of its bytes (units).

    Of a normal distribution in the middle of a byte, 1 - erf(1 / (2 sqrt(2) sigma)): no place
    between two bytes keeps a pad for longer. Rounding has added 1/12 to the variance.
    """
    sigma = np.sqrt(np.maximum(noise_units**2 - 1.0 / 12.0, LEAST_NOISE_UNITS**2))
    width = 0.5 / math.sqrt(2.0) / sigma
    return np.array([1.0 - math.erf(one) for one in width.ravel()]).reshape(width.shape)


def longest_run(rate: Floats, samples: Floats | float, odds: float) -> Floats:
    """How many samples without a change are less probable than 1/odds.

    Args:
        rate: share of samples with a change.
        samples: of how many it was seen.
        odds: of the run.

    The sum of ln((n + i) / (n - c + i)) over a run is taken as its integral, which is concave
    in the run: Newton's method from 0 comes up to the root and never beyond it, exact for
    runs below 1000 and to 1 % for the longest. A rate of 0 allows a run without end.
    """
    still = np.maximum((1.0 - rate) * samples, 0.5)
    n = np.maximum(samples, still)
    wanted = math.log(odds)
    run = np.zeros_like(still)
    for _ in range(NEWTON_STEPS):
        slope = np.log((n + run) / (still + run))
        told = n * np.log1p(run / n) - still * np.log1p(run / still) + run * slope
        run += (wanted - told) / np.maximum(slope, wanted / LONGEST_RUN)
        np.minimum(run, LONGEST_RUN, out=run)
    return run


def inside(raw: NDArray[np.uint8]) -> Mask:
    """Bytes that are not at an end of the scale: those cannot tell whether their pad moves."""
    mask: Mask = raw - np.uint8(1) < np.uint8(254)  # 0 wraps to 255
    return mask
