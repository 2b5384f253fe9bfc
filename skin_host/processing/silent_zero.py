"""Decides whether a board was zeroed while it was not received.

A board zeroes itself after five readings without acknowledge, which its status words report
(icub-firmware, mtb3/main_V3.c). Nobody learns of it while its bus is away, and then its
readings are judged by the zero before. They show it: just after a zero all pads read the byte of an
untouched pad, but for the noise of one reading, and without a zero each reads its own baseline.

So the first sweeps after a silence are compared with both, over all pads that nothing touched. Both
allow for what moves all pads together, as temperature does, and for pads that are pressed or fail.
Where both fit alike, the baselines are near zero and nothing depends on the answer.

After a start of the daemon nobody knows how long it was not received: a moment, or a winter. Both
are tried then.

What waited on the way, as behind a node that keeps the bus busy, comes at once afterwards and may
be from before the zero: such sweeps are not compared. The first after a silence may have waited,
too, so it counts only among all ten.

Most silences are a few lost sweeps, and many noisy pads show within two sweeps that nothing was
zeroed. So do pads that were touched before the silence and still read half as much or more: a zero
that was taken under the press would make them read none. So the board counts again as soon as
either shows it, and goes on being compared. What still presses after a silence in which no touch
would have ended was there all the time, whatever the others show: beside it pads are pressed too
lightly for a touch, and had moved as those of a new zero do.

In a silence of minutes the skin becomes warmer or colder. Where most pads have moved then, and rose
by no more than temperature pads show, the baselines move with them before any pad is valid again:
otherwise all would be touched at once, and would stay it, because a touch hides drift. Without
temperature pads, what rose no faster than drift does is taken for it, as a load that comes slowly
is (`drift`). So such a board waits for all ten sweeps.

Where most pads read more than a new zero and any drift leave, neither explains the readings:
something presses on them. Then which of two improbable ones is less so shows nothing.
"""

import math

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.drift import ALIKE_SHARE, REFERENCES, SLOW_UNITS_PER_S
from skin_host.processing.masks import Mask
from skin_host.processing.touch import LOST_S

#: So many sweeps are compared; pads of which fewer than half were received do not count.
SWEEPS = 10
FEWEST = SWEEPS // 2
#: A sweep waited if it comes sooner than this share of a period after the one before. No more than
#: so many count as that: a board may send faster than it was set up to.
WAITED_SHARE = 0.5
MOST_WAITED = 20
#: A board was zeroed when its readings are so many times as probable then: a zero taken for none
#: makes untouched pads read touches, and none taken for one costs a second (docs/found.md).
ODDS = 100
#: It need not wait for the other sweeps once they are so many times as probable without a zero, or
#: this share of what was touched still is, and reads as large a share of what it did.
CLEAR_NATS = math.log(1e4)
STILL_SHARE = 0.5
#: Of which a pad counts so much at most, squared, in standard deviations of a zero's readings.
MOST_SQUARE = 25.0
#: That takes a whole conversion, and so many sweeps: a single one may be damaged.
CLEAR_SWEEPS = 2
#: Rounding, and what the baseline of a pad drifts by itself (units, standard deviation).
OWN_UNITS = 0.5
#: A silence must be longer than this for that to count.
DRIFT_S = OWN_UNITS / SLOW_UNITS_PER_S
#: What all pads of a board drift by together (units, standard deviation), however short the
#: silence was; in a long one this grows by `SLOW_UNITS_PER_S`, up to a limit.
COMMON_UNITS = 1.0
MOST_COMMON_UNITS = 10.0
#: By this share of what a long silence adds, pads may drift apart, and by this one of what they
#: drift together (standard deviations): they differ in their foam.
APART_SHARE = 0.1
UNLIKE_SIGMA = 0.3
#: Without temperature pads a drift is followed up to so many units, as ten degrees make.
MOST_DRIFTED_UNITS = 5.0
#: Pads drift alike when they differ from what most do by no more than this share of it, `OWN_UNITS`
#: and so many standard deviations. One in ten emulated ones hardly drifts, a few do twice as much.
UNLIKE_SHARE = 0.6
ALIKE_SIGMAS = 2.0
MOST_SHARE = 2.0
#: Common drifts are tried up to so many standard deviations, in steps of so many units.
COMMON_SIGMAS = 3.0
STEP_UNITS = 0.25
#: This share of the pads is pressed or fails: they read anything, within so many units.
ELSEWHERE_SHARE = 0.05
RANGE_UNITS = 60.0
#: A baseline is the mean of this time, at least.
BASELINE_S = 1.0

Floats = NDArray[np.float64]


class SilentZero:
    """Compares the n taxels of a board after it was silent with both explanations.

    Args:
        baseline: float64[n], activation of the untouched taxels before, in units.
        noise: float64[n], standard deviation of a measurement, as calibrated.
        spread: float64[n], the same derived from sums of measurements: it includes slow noise.
        known: bool[n], usable taxels that were untouched, and whose baseline was known.
        no_load: the byte of an untouched pad just after a zero.
        period_s: how often the board sends.
        silent_s: for how long it was not received; infinite at a start, where nobody knows.
        touched: bool[n], taxels that something touched before; none of them is known.
        still_units: float64[n], a taxel that reads more than this is still touched.
        before: the same after its last silence, if what came since then has not decided: its
            baseline is still from before that.
        read_units: float64[n], what was read last. The baselines of temperature pads do not follow
            drift. None if there are none of these: all pads measure pressure.
        pressure: bool[n], pads that measure pressure.
        fineness: float64[n], how many of the units of each taxel are a usual one: noise and drift
            are as many times larger in finer units. All that is compared is in usual ones.

    Attributes:
        silent_s, touched: as given.
        still_units, read_units: as given, in usual units, or those of `before`.
        unseen_s: the same with all silences since the baseline was known.
        at_start: whether it is infinite.
        clear: whether a zero is so improbable by now, at least one that hides a touch, that the
            board may be taken for one that was not zeroed while it is compared further.
    """

    def __init__(
        self,
        baseline: Floats,
        noise: Floats,
        spread: Floats,
        known: Mask,
        no_load: float,
        period_s: float,
        silent_s: float,
        touched: Mask | None = None,
        still_units: Floats | None = None,
        before: "SilentZero | None" = None,
        read_units: Floats | None = None,
        pressure: Mask | None = None,
        fineness: Floats | float = 1.0,
    ) -> None:
        self._fineness = fineness
        self._baseline = baseline / fineness
        self._noise = noise / fineness
        self._spread = spread / fineness
        self._known = known
        self._pressure: Mask = np.ones_like(known) if pressure is None else pressure
        self.touched: Mask = np.zeros_like(known) if touched is None else touched
        none = np.full(len(known), np.inf)
        self.still_units: Floats = (none if still_units is None else still_units) / fineness
        self.read_units: Floats = (baseline if read_units is None else read_units) / fineness
        if before is not None:
            self.still_units, self.read_units = before.still_units, before.read_units
        self.silent_s = silent_s
        self.unseen_s: float = silent_s + (0.0 if before is None else before.unseen_s)
        self.at_start = math.isinf(self.unseen_s)
        self.clear = False
        #: Whether a touch has outlasted the silence.
        self._outlasted = False
        self._no_load = no_load
        self._period_s = period_s
        drifted = min(SLOW_UNITS_PER_S * self.unseen_s, MOST_COMMON_UNITS)
        #: What all pads may have drifted by together, in units; each is as probable.
        self._drifted_units = [0.0, drifted] if self.at_start else [drifted]
        self._sum = np.zeros(len(known))
        self._count = np.zeros(len(known), np.int64)
        self._sweeps = 0
        #: The first after a silence, in units, and what of it was received.
        self._first: tuple[Floats, Mask] | None = None
        #: How many others are compared, and how many must be before the board can be clear.
        self._compared = 0
        self._fewest = max(CLEAR_SWEEPS, math.ceil(CONVERSION_S / period_s))
        self._waited = 0
        self._last_ns: int | None = None

    @property
    def decided(self) -> bool:
        """Return whether enough sweeps have been compared."""
        return self._sweeps >= SWEEPS

    def step(self, raw: NDArray[np.uint8], present: Mask, t_ns: int) -> bool | None:
        """Take one sweep; return whether the board was zeroed, or None while that is not known.

        Args:
            raw: uint8[n], the bytes.
            present: bool[n], which of them were received and are readings.
            t_ns: when it came.
        """
        last_ns, self._last_ns = self._last_ns, t_ns
        soon_ns = WAITED_SHARE * self._period_s * 1e9
        soon = last_ns is not None and 0 <= t_ns - last_ns < soon_ns
        if soon and self._waited < MOST_WAITED:
            self._waited += 1
            self._sum[:] = self._count[:] = self._sweeps = self._compared = 0
            self.clear = self._outlasted = False
            self._first = None
            return None
        self._sweeps += 1
        units = np.where(present, self._no_load - raw, 0.0) / self._fineness
        if last_ns is None and not self.at_start:
            self._first = units, present
            return None
        self._add(units, present)
        self._compared += 1
        if self._sweeps >= SWEEPS:
            if self._first is not None:
                self._add(*self._first)
            return self.was_zeroed
        if not self.clear and not self._drifts and self._compared >= self._fewest:
            self.clear = self._is_clear()
        return None

    @property
    def received(self) -> Mask:
        """Return the taxels bool[n] that were received often enough to be compared."""
        return self._count >= FEWEST

    @property
    def _drifts(self) -> bool:
        """Whether pads may have drifted so much together that it counts where they rest now."""
        return self.unseen_s > DRIFT_S

    def drifted_units(self) -> Floats | None:
        """Return by how much the untouched readings [n] have drifted in a long silence without a
        zero, once that is decided; None if they have not, or if it may be a load.

        Each pad that reads no more than drift may leave takes its own reading for it.
        """
        received = self.received
        seen = self._known & self._pressure & received
        if not self._drifts or self.at_start or np.count_nonzero(seen) < REFERENCES:
            return None
        of_all = seen | (self.touched & self._pressure & received)
        mean, variance = self._mean_of(of_all)
        moved = mean - self._baseline[of_all]
        untouched = seen[of_all]
        common = float(np.median(moved[untouched]))
        apart = OWN_UNITS + UNLIKE_SHARE * abs(common) + ALIKE_SIGMAS * np.sqrt(variance)
        # What touched a pad before has lifted where it reads what the untouched ones do.
        alike = np.abs(moved - common) < apart
        if np.mean(alike) < ALIKE_SHARE or common > self._most_drifted(received):
            return None
        moved = moved[untouched]
        drifted = np.where(self._pressure, common, 0.0)
        shared = max(common, 0.0)
        drifted[seen] = np.where(moved > OWN_UNITS + MOST_SHARE * shared, shared, moved)
        return drifted * self._fineness

    def _most_drifted(self, received: Mask) -> float:
        """Return how much untouched pads may have risen together, in units.

        Temperature pads show what becomes warmer, and nothing of what presses.

        Args:
            received: bool[n], pads that came often enough.
        """
        warm = self._known & ~self._pressure & received
        if np.count_nonzero(warm) < REFERENCES:
            return min(SLOW_UNITS_PER_S * self.unseen_s + OWN_UNITS, MOST_DRIFTED_UNITS)
        mean, _ = self._mean_of(warm)
        risen = float(np.mean(mean - self.read_units[warm]))
        return min(OWN_UNITS + max(risen, 0.0), MOST_COMMON_UNITS)

    def _add(self, units: Floats, present: Mask) -> None:
        self._sum += units
        self._count += present

    def _is_clear(self) -> bool:
        fewest = math.ceil(self._compared / 2)
        still = self._still_touched(fewest)
        self._outlasted = still and self.unseen_s <= LOST_S
        evidence = self.evidence(fewest)
        most = math.log(ODDS) if still else -CLEAR_NATS
        return self._outlasted or evidence < most

    def _still_touched(self, fewest: int) -> bool:
        """Return whether what was touched before still is, by pads that came in so many sweeps."""
        still = self.touched & (self._count >= fewest)
        still &= self._sum > self.still_units * self._count
        n = np.count_nonzero(self.touched)
        if np.count_nonzero(still) < max(STILL_SHARE * n, 1):
            return False
        mean, variance = self._mean_of(still)
        variance += np.square(self._noise[still]) + OWN_UNITS**2
        squares = np.minimum(np.square(mean) / variance, MOST_SQUARE).sum()
        # Chernoff's bound of how probable such a sum of squares is of a zero under the touch.
        return bool(squares > n and squares - n * (1 + math.log(squares / n)) > 2 * CLEAR_NATS)

    @property
    def was_zeroed(self) -> bool:
        """Return whether what came so far shows that the board was zeroed."""
        zeroed = not self._outlasted and self.evidence() > math.log(ODDS)
        return zeroed and not self._most_are_pressed()

    def _most_are_pressed(self) -> bool:
        """Return whether most pads, touched before or not, read more than all may drift by."""
        seen = (self._known | self.touched) & (self._count >= FEWEST)
        most_units = COMMON_SIGMAS * _common_units(max(self._drifted_units))
        return bool(
            2 * np.count_nonzero(self._sum[seen] > most_units * self._count[seen]) > seen.sum()
        )

    def evidence(self, fewest: int = FEWEST) -> float:
        """Return how much more probable the readings are after a zero, as a natural logarithm.

        Args:
            fewest: pads that were received in fewer sweeps do not count.
        """
        seen = self._known & (self._count >= fewest)
        if not seen.any():
            return 0.0
        mean, variance = self._mean_of(seen)
        # A zero is a single reading: its noise is in all that follow.
        zeroed = self._log_likelihood(mean, variance + np.square(self._noise[seen]))
        return zeroed - self._log_likelihood(mean - self._baseline[seen], variance)

    def _mean_of(self, seen: Mask) -> tuple[Floats, Floats]:
        """Return the means of some taxels, bool[n], in units, and how far noise takes each from its
        baseline (variance).
        """
        count = self._count[seen]
        # Readings within one conversion repeat it; slower ones are each their own.
        independent = count * min(1.0, self._period_s / CONVERSION_S)
        share = 1.0 / np.maximum(independent, 1.0) + CONVERSION_S / BASELINE_S
        return self._sum[seen] / count, np.square(self._spread[seen]) * share

    def _log_likelihood(self, residual: Floats, variance: Floats) -> float:
        """Return the logarithm of the likelihood of residuals [n], whatever the pads drifted by."""
        return float(
            np.logaddexp.reduce([_of_drift(residual, variance, d) for d in self._drifted_units])
        )


def _common_units(drifted_units: float) -> float:
    """How far all pads of a board may have moved alike (standard deviation)."""
    return math.hypot(COMMON_UNITS, drifted_units)


def _of_drift(residual: Floats, variance: Floats, drifted_units: float) -> float:
    """Return the logarithm of the likelihood of residuals [n] after a drift of about so many units,
    whatever moved them together.
    """
    common_units = _common_units(drifted_units)
    most = COMMON_SIGMAS * common_units
    common = np.arange(-most, most + STEP_UNITS, STEP_UNITS)[:, None]
    own = OWN_UNITS**2 + (APART_SHARE * drifted_units) ** 2 + np.square(UNLIKE_SIGMA * common)
    variance = variance + own
    apart = residual - common
    density = np.exp(-0.5 * apart**2 / variance) / np.sqrt(2.0 * np.pi * variance)
    mixed = (1.0 - ELSEWHERE_SHARE) * density + ELSEWHERE_SHARE / RANGE_UNITS
    of_common = np.log(mixed).sum(axis=1) - 0.5 * np.square(common[:, 0] / common_units)
    # Wider drifts have more values, each less probable.
    return float(np.logaddexp.reduce(of_common)) - math.log(common_units)
