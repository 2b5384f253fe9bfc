"""Baselines that follow slow drift while nothing touches (paper, section V-C).

An untouched taxel is followed by itself. A touched one cannot be, yet it drifts all the
same, and a drift beyond the threshold during one contact would leave it touched for ever.
Three things prevent that, from the surest to the last resort:

1. Its triangle's thermal pads, where there are any: they feel what drifts, not what presses.
   How much each taxel follows them is learnt while it is untouched.
2. The untouched taxels of its part, whose median change it shares (the first version of the
   paper's authors took the mean).
3. A doubt that grows with the time in touch. When a contact has let go and what is left is
   small, still, and no more than may have drifted meanwhile, it is taken for drift.

A touch also stirs the taxels around it: where a hand closes, its skin bulges, and taxels
that nothing touches read several units less as long as it holds. Followed, they would read
as touched when it opens. So while a part is touched, its taxels follow what they have in
common, and hardly what one has alone; and a sudden fall is never followed quickly.
"""

import math

import numpy as np
from numpy.typing import NDArray

from skin_host.settings import Drift

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: With fewer untouched taxels than this nobody speaks for the touched ones.
WITNESSES = 4
#: More than these add nothing but time.
ENOUGH_WITNESSES = 256
#: What has this much of the untouched taxels within this distance of their median is drift ...
AGREEING_SHARE = 0.8
AGREEING_UNITS = 0.5
#: ... else something stirs them: what is common to those near their baselines is followed
#: slowly, and what one of them has alone hardly at all.
NEAR_UNITS = 1.0
STIRRED_UNITS_PER_S = 0.01
ALONE_UNITS_PER_S = 0.0005
#: A reading so far below its baseline did not get there by drift; it is followed slowly.
FALLEN_UNITS = -2.5
FALLEN_UNITS_PER_S = 0.005
#: Thermal evidence, in units^2 s, that weighs as much as the assumption of no relation.
THERMAL_PRIOR = 100.0
#: Thermal evidence older than this fades.
THERMAL_MEMORY_S = 3600.0
#: A byte resolves temperature poorly: the pads are smoothed over this time.
THERMAL_SMOOTHING_S = 10.0
#: Unseen drift to be expected in a touch: quick at first, up to a limit, then slow.
DOUBT_UNITS_PER_S = 0.005
DOUBT_LIMIT_UNITS = 3.5
SLOW_DOUBT_UNITS_PER_S = 1e-4
#: Seen untouched again, a taxel is less and less in doubt, and below this no longer.
RELIEF_S = 5.0
DOUBTED_S = 1.0
#: A contact has let go when less than this share of its largest reading is left ...
LET_GO_SHARE = 0.4
#: ... and is still when its mean changes by less than this from window to window.
STILL_UNITS = 0.3


def paper_step(units: Array, dt_s: float, rate_units_per_s: float, dead_band_units: float) -> Array:
    """Return the paper's change of baseline [n] for activations above it [n].

    A fixed rate towards the reading outside the dead band. (The paper prints "< 0.5" for
    the second comparison; it lacks the minus sign, which would pull all baselines down.)
    """
    step = rate_units_per_s * dt_s
    change: Array = step * ((units > dead_band_units) - 1.0 * (units < -dead_band_units))
    return change


def proportional_step(
    units: Array, dt_s: float, gain_per_s: float, rate_units_per_s: float
) -> Array:
    """Return the change of baseline [n] that closes the share gain x dt of the distance.

    The rule of the deployed iCub host, exact for any dt, but never faster than the paper's
    rate: when a hand closes, its skin bulges and untouched taxels fall by several units for
    a second. That is no drift, and a rule that follows it sees a touch when they come back.
    """
    limit = rate_units_per_s * dt_s
    change: Array = -math.expm1(-gain_per_s * dt_s) * units
    np.fmin(change, limit, out=change)
    np.fmax(change, -limit, out=change)
    return change


class BaselineTracker:
    """The baselines of the n taxels of one part.

    The readings that it follows must be corrected for relaxation: the imprint that a touch
    leaves in the foam is no drift, and would otherwise be taken for it.

    Args:
        baseline: float64[n] in units, as calibrated; moved in place.
        usable: bool[n], taxels that feel pressure and are to be believed.
        triangle: int[n], the triangle of each taxel, any numbering.
        thermal: bool[n], pads that feel temperature.
        settings: the rule and its numbers.

    Attributes:
        frozen_s: float64[n], for how long each taxel has been touched without a break.
    """

    def __init__(
        self,
        baseline: Array,
        usable: Mask,
        triangle: NDArray[np.int32],
        thermal: Mask,
        settings: Drift,
    ) -> None:
        n = len(baseline)
        self.baseline = baseline
        self._calibrated = baseline.copy()
        self._low = self._calibrated - settings.limit_units
        self._high = self._calibrated + settings.limit_units
        self._usable = usable
        self._settings = settings
        self._thermometer = _Thermometer(triangle, thermal) if np.any(thermal) else None
        self.frozen_s: Array = np.zeros(n)
        self._stirred_s = 0.0
        self._doubt_s: Array = np.zeros(n)
        self._peak: Array = np.zeros(n)
        self._level: Array = np.zeros(n)

    def step(
        self, units: Array, touched: Mask, missing: Mask, dt_s: float
    ) -> NDArray[np.intp] | None:
        """Move the baselines, in place.

        Args:
            units: mean activation [n] above the baseline in the last dt_s seconds. Entries
                of thermal pads count too.
            touched: taxels [n] that were touched at any time in it.
            missing: taxels [n] that were not received at some time in it.
            dt_s: that time.

        Returns:
            Numbers of taxels whose touch has turned out to be drift, or None.
            Their baselines have moved up to their readings.
        """
        if self._settings.rule == "none":
            return None
        held = self._usable & (touched | missing)
        free = self._usable & ~held
        forecast = None
        if self._thermometer is not None:
            forecast = self._thermometer.step(units, self.baseline, free, dt_s)
            units = units - forecast
        if self._settings.rule == "paper":
            change = paper_step(
                units, dt_s, self._settings.rate_units_per_s, self._settings.dead_band_units
            )
        else:
            change = proportional_step(
                units, dt_s, self._settings.gain_per_s, self._settings.rate_units_per_s
            )
        ghosts = None
        touched = touched & held
        if np.count_nonzero(touched):
            ghosts = self._hold(change, units, free, touched, dt_s)
        else:
            np.fmax(change, -FALLEN_UNITS_PER_S * dt_s, out=change, where=units < FALLEN_UNITS)
            if np.count_nonzero(held):
                change[held] = self._common(change, units, free, dt_s)
            self._relieve(dt_s)
        if forecast is not None:
            change += forecast
        change *= self._usable
        np.add(self.baseline, change, out=self.baseline)
        np.fmax(self.baseline, self._low, out=self.baseline)
        np.fmin(self.baseline, self._high, out=self.baseline)
        return ghosts

    @property
    def frozen(self) -> Mask:
        """Taxels [n] touched for so long that it is told."""
        return self.frozen_s >= self._settings.frozen_report_s

    @property
    def at_limit(self) -> Mask:
        """Taxels [n] whose baseline has gone as far from its calibration as it may."""
        edge = (self.baseline <= self._low) | (self.baseline >= self._high)
        return edge & self._usable

    def _common(self, change: Array, units: Array, free: Mask, dt_s: float) -> float:
        """What the untouched taxels have in common, 0 if there are too few of them."""
        untouched = np.flatnonzero(free)
        if len(untouched) < WITNESSES:
            return 0.0
        asked = untouched[:: max(len(untouched) // ENOUGH_WITNESSES, 1)]
        reading, change = units[asked], change[asked]
        agreeing = np.abs(reading - _median(reading)) < AGREEING_UNITS
        if np.count_nonzero(agreeing) >= AGREEING_SHARE * len(asked):
            return _median(change)
        near = change[np.abs(reading) < NEAR_UNITS]
        if len(near) < WITNESSES:
            return 0.0
        limit = STIRRED_UNITS_PER_S * dt_s
        return min(max(_median(near), -limit), limit)

    def _hold(
        self, change: Array, units: Array, free: Mask, touched: Mask, dt_s: float
    ) -> NDArray[np.intp] | None:
        """Replace the changes by what is common to the untouched; return what was no touch."""
        common = self._common(change, units, free, dt_s)
        alone = ALONE_UNITS_PER_S * dt_s
        # What was in touch a moment ago is followed by its own rule: it may have drifted unseen.
        recovering = free & (self._doubt_s > DOUBTED_S)
        own = change[recovering]
        np.clip(change - common, -alone, alone, out=change)
        change[~free] = 0.0
        change += common
        change[recovering] = own
        ghosts = self._ghosts(units, touched, dt_s)
        if ghosts is not None:
            change[ghosts] = units[ghosts]
        return ghosts

    def _relieve(self, dt_s: float) -> None:
        """Nothing is touched: forget, but not at once, for a touch may flicker."""
        if self._stirred_s <= 0.0:
            return
        self.frozen_s.fill(0.0)
        self._stirred_s -= dt_s
        kept = math.exp(-dt_s / RELIEF_S) if self._stirred_s > 0.0 else 0.0
        self._doubt_s *= kept
        self._peak *= kept

    def _ghosts(self, units: Array, touched: Mask, dt_s: float) -> NDArray[np.intp] | None:
        """Which of the touched taxels read no more than drift may have brought."""
        self._stirred_s = 5.0 * RELIEF_S
        who = np.flatnonzero(touched)
        reading = units[who]
        kept = math.exp(-dt_s / RELIEF_S)
        frozen_s, doubt_s = self.frozen_s[who] + dt_s, self._doubt_s[who] + dt_s
        peak = np.maximum(self._peak[who], reading)
        self.frozen_s.fill(0.0)
        self._doubt_s *= kept
        self._peak *= kept
        self.frozen_s[who], self._doubt_s[who], self._peak[who] = frozen_s, doubt_s, peak
        still = np.abs(reading - self._level[who]) < STILL_UNITS
        np.copyto(self._level, units)
        slow = SLOW_DOUBT_UNITS_PER_S * doubt_s
        quick = np.minimum(DOUBT_UNITS_PER_S * doubt_s, DOUBT_LIMIT_UNITS)
        let_go = reading < LET_GO_SHARE * peak
        ghosts = who[still & (reading < slow + np.where(let_go, quick, 0.0))]
        return ghosts if len(ghosts) else None


def _median(values: Array) -> float:
    """The upper median; numpy's own costs five times as much for so few."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


class _Thermometer:
    """What the thermal pads foretell: the drift of each taxel since the last step."""

    def __init__(self, triangle: NDArray[np.int32], thermal: Mask) -> None:
        n = len(triangle)
        self._triangle = triangle = np.unique(triangle, return_inverse=True)[1].astype(np.intp)
        self._pads = np.flatnonzero(thermal)
        self._pads_of = np.bincount(triangle[self._pads], minlength=int(triangle.max()) + 1)
        self._warmth: Array | None = None
        #: Sums over time while untouched: 1, warmth, reading, and their products.
        self._sums: Array = np.zeros((5, n))

    def step(self, units: Array, baseline: Array, free: Mask, dt_s: float) -> Array:
        """Return the foretold change [n] of the baselines; learn from the untouched taxels."""
        sums = np.bincount(
            self._triangle[self._pads], units[self._pads], minlength=len(self._pads_of)
        )
        now = (sums / np.maximum(self._pads_of, 1))[self._triangle]
        if self._warmth is None:
            self._warmth = now
            return np.zeros(len(baseline))
        change = -math.expm1(-dt_s / THERMAL_SMOOTHING_S) * (now - self._warmth)
        warmth = self._warmth = self._warmth + change
        reading = baseline + units
        new = np.array([np.ones(len(free)), warmth, reading, warmth * reading, warmth * warmth])
        kept = math.exp(-dt_s / THERMAL_MEMORY_S)
        np.copyto(self._sums, kept * self._sums + dt_s * new, where=free)
        # Least squares: how much each untouched taxel follows the warmth.
        time_s, warm, read, cross, square = self._sums
        time_s = np.maximum(time_s, dt_s)
        slope = (cross - warm * read / time_s) / (square - warm**2 / time_s + THERMAL_PRIOR)
        forecast: Array = slope * change
        return forecast
