"""The drift that temperature pads predict for the taxels of their triangle."""

import math

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.masks import Mask

Array = NDArray[np.float64]

#: Slow changes are detected in means over this time, because a byte resolves them poorly.
SMOOTHING_S = 10.0
#: For this long evidence lasts.
MEMORY_S = 3600.0
#: Evidence, in units^2 s, that weighs as much as the assumption of no relation.
PRIOR = 100.0
#: What was predicted lately, over twice the smoothing, is wrong where it is more than so many
#: units, and most untouched taxels of its triangle show at least this share of it the other way.
WRONG_UNITS = 1.0
WRONG_SHARE = 0.5
#: Fewer untouched taxels show nothing of a triangle.
FEWEST_FREE = 3
#: A temperature pad that is suddenly off by more than this does not measure the temperature: it is
#: 4 to 16 degrees, in the finest and in the usual units.
JUMP_UNITS = 40.0


class ThermalReference:
    """The drift of each taxel since the last step, as far as the temperature pads predict it.

    A pad that fails moves as no temperature does, or as the untouched taxels beside it do not. Then
    what it has predicted lately is taken back, and its triangle learns from the beginning.
    """

    def __init__(self, triangle: NDArray[np.int32], thermal: Mask) -> None:
        n = len(triangle)
        self._triangle = triangle = np.unique(triangle, return_inverse=True)[1].astype(np.intp)
        self._pads = np.flatnonzero(thermal)
        self._pads_of = np.bincount(triangle[self._pads], minlength=int(triangle.max()) + 1)
        #: Of the triangle of each taxel, smoothed; NaN while it is not known.
        self._temperature: Array = np.full(n, np.nan)
        #: Sums over time while untouched: 1, temperature, reading, and their products.
        self._sums: Array = np.zeros((5, n))
        #: What was predicted lately, fading.
        self._predicted: Array = np.zeros(n)

    def forget(self, taxels: Mask) -> None:
        """Some taxels, bool[n], have a new zero, and so have the temperature pads beside them."""
        beside = np.zeros(len(self._pads_of), np.bool_)
        beside[self._triangle[taxels]] = True
        self._begin_again(beside[self._triangle])

    def miss(self, taxels: Mask) -> None:
        """The temperature of some taxels, bool[n], has changed, and so have their baselines."""
        self._temperature[taxels] = np.nan

    def step(self, units: Array, baseline: Array, free: Mask, missing: Mask, dt_s: float) -> Array:
        """Return the predicted change [n] of the baselines; learn from the untouched taxels.

        The temperature stays as it was where a pad that measures it is missing.
        """
        pads, triangles = self._pads, len(self._pads_of)
        sums = np.bincount(self._triangle[pads], units[pads], minlength=triangles)
        now = (sums / np.maximum(self._pads_of, 1))[self._triangle]
        absent = np.bincount(self._triangle[pads], missing[pads], minlength=triangles) > 0
        known = ~absent[self._triangle]
        with np.errstate(invalid="ignore"):  # not known yet
            jumped = known & (np.abs(now - self._temperature) > JUMP_UNITS)
        if np.count_nonzero(jumped):
            self._begin_again(jumped)
        new = known & np.isnan(self._temperature)
        self._temperature[new] = now[new]
        known &= ~new
        share = -math.expm1(-dt_s / SMOOTHING_S)
        change = np.where(known, share * (now - self._temperature), 0.0)
        temperature = self._temperature = self._temperature + change
        reading = baseline + units
        new_sums = np.array(
            [
                np.ones(len(free)),
                temperature,
                reading,
                temperature * reading,
                temperature * temperature,
            ]
        )
        kept = math.exp(-dt_s / MEMORY_S)
        np.copyto(self._sums, kept * self._sums + dt_s * new_sums, where=free & known)
        # Least squares: how much each untouched taxel follows the temperature.
        time_s, warm, read, cross, square = self._sums
        time_s = np.maximum(time_s, dt_s)
        slope = (cross - warm * read / time_s) / (square - warm**2 / time_s + PRIOR)
        forecast: Array = slope * change
        self._predicted *= math.exp(-dt_s / (2.0 * SMOOTHING_S))
        self._predicted += forecast
        if np.count_nonzero(np.abs(self._predicted) > WRONG_UNITS):
            wrong = self._is_wrong(units - forecast, free)
            forecast = np.where(wrong, forecast - self._predicted, forecast)
            self._begin_again(wrong)
        return forecast

    def _is_wrong(self, left: Array, free: Mask) -> Mask:
        """Return the taxels [n] of triangles whose untouched ones show that what was predicted
        lately has not come.

        Args:
            left: what they read above the baselines that follow [n].
            free: untouched taxels [n].
        """
        much = free & (np.abs(self._predicted) > WRONG_UNITS)
        against = much & (-left * np.sign(self._predicted) > WRONG_SHARE * np.abs(self._predicted))
        triangles = len(self._pads_of)
        shown = np.bincount(self._triangle, free, minlength=triangles)
        those = np.bincount(self._triangle, against, minlength=triangles)
        wrong: Mask = ((shown >= FEWEST_FREE) & (2.0 * those > shown))[self._triangle]
        return wrong

    def _begin_again(self, taxels: Mask) -> None:
        """Forget what is known of whole triangles, bool[n]."""
        self._temperature[taxels] = np.nan
        self._sums[:, taxels] = 0.0
        self._predicted[taxels] = 0.0
