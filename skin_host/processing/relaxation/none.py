"""No relaxation at all."""

import numpy as np
from numpy.typing import DTypeLike, NDArray

from skin_host.processing.relaxation.base import Array


class NoRelaxation:
    """No correction: the foam is taken as perfectly elastic."""

    bytes_per_taxel = 0

    def __init__(self, n: int, *, dtype: DTypeLike = np.float64) -> None:
        self.n = n
        self._zeros: Array = np.zeros(n, dtype=dtype)

    def step(self, pressure_kpa: Array, dt_s: float, out: Array | None = None) -> Array:
        """Return zeros [n]; see `Relaxation`."""
        if out is None:
            return self._zeros.copy()
        out.fill(0.0)
        return out

    def reset(self, mask: NDArray[np.bool_] | None = None) -> None:
        """Do nothing: there is no history."""
