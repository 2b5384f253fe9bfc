"""A short filter that passes changes larger than noise, and smooths the rest."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

Array = NDArray[np.floating[Any]]

#: A difference of more standard deviations of the noise is taken for a change. With three, the
#: error of slow pressures falls by another 0.2 kPa, and fast ones lag by a half more.
LIMIT_DEVIATIONS = 2.0


class StepFilter:
    """y = C - k clip(C - y, -limit, limit), k = exp(-dt / time): for each of n taxels.

    A change beyond the limit passes at once except for the limit, which follows with the
    filter's time; so y is never farther from C than k times the limit. Where the limit is
    many times the noise it is the exponential filter, and where it is 0 nothing is smoothed.

    Args:
        limit_kpa: [n], the largest effect of noise.
        time_s: of the exponential filter; 0 passes everything.
        dtype: of state and results.

    Attributes:
        smooth: the smoothed pressure [n], of the last step.
    """

    def __init__(self, limit_kpa: ArrayLike, time_s: float, dtype: DTypeLike = np.float64) -> None:
        self._limit: Array = np.asarray(limit_kpa).astype(dtype)
        self._minus_limit: Array = -self._limit
        self.smooth: Array = np.zeros_like(self._limit)
        self.use(time_s)

    def use(self, time_s: float) -> None:
        """Filter with this time from now on; what is smoothed so far is kept."""
        self._time_s = time_s
        self._dt_s = -1.0
        self._kept: Any = self._limit.dtype.type(0.0)

    def step(self, kpa: Array, dt_s: float) -> Array:
        """Return the smoothed pressure [n]; the array is valid until the next step.

        Args:
            kpa: the momentary pressure [n], finite.
            dt_s: since the step before.
        """
        smooth, kept = self.smooth, self._share_kept(dt_s)
        np.subtract(kpa, smooth, out=smooth)
        np.minimum(smooth, self._limit, out=smooth)
        np.maximum(smooth, self._minus_limit, out=smooth)
        np.multiply(smooth, kept, out=smooth)
        return np.subtract(kpa, smooth, out=smooth)

    def part(self, taxels: NDArray[np.intp] | slice) -> "StepFilter":
        """Return a filter of some taxels that continues from their present state."""
        part = StepFilter(self._limit[taxels], self._time_s, self._limit.dtype)
        part.smooth[...] = self.smooth[taxels]
        return part

    def take_back(self, taxels: NDArray[np.intp] | slice, part: "StepFilter") -> None:
        """Adopt the state of some taxels from a filter of them."""
        self.smooth[taxels] = part.smooth

    def _share_kept(self, dt_s: float) -> Any:
        if dt_s != self._dt_s:
            self._dt_s = dt_s
            kept = math.exp(-dt_s / self._time_s) if self._time_s > 0.0 else 0.0
            self._kept = self._limit.dtype.type(kept)
        return self._kept

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Forget the earlier readings of taxels [n]."""
        self.smooth[mask] = 0.0
