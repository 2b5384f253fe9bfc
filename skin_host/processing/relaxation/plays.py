"""Rate-independent hysteresis: plays beside no time at all (Prandtl-Ishlinskii)."""

import numpy as np
from numpy.typing import DTypeLike, NDArray

from skin_host.processing.relaxation.base import Array, FiniteInput, Parameters, as_modes, mix


class PlayRelaxation:
    """A foam that reads more while it is unloaded than while it is loaded, however slowly.

    The play of radius r follows the reading C at a distance of r: p = min(max(p, C - r), C + r).
    While foam that rested is loaded p = max(C - r, 0), and the pressure is C; whenever a
    press goes back, the plays stay behind, and relaxation = sum w_r (p_r - max(C - r, 0)).

    Only the order of readings matters, not their times (Krasnosel'skii and Pokrovskii,
    Systems with Hysteresis, 1989, chapter 1; the superposition of plays has an inverse of the
    same form: Kuhnen, European Journal of Control 9(4), 2003). It lies between 0 and
    2 sum(w r) for ever, the pressure C - relaxation rises with every C, and what is
    below zero counts as zero: an untouched taxel that reads too little remembers nothing.

    Args:
        n: number of taxels.
        radius_kpa: of each play, [plays] or [plays, n].
        weight: of each play, alike.
        dtype: of states and answers, float64 or float32.
    """

    def __init__(
        self, n: int, *, radius_kpa: Parameters, weight: Parameters, dtype: DTypeLike = np.float64
    ) -> None:
        self.n = n
        self._radius = as_modes("radius_kpa", radius_kpa, n, dtype)
        self._weight = as_modes("weight", weight, n, dtype)
        if len(self._radius) != len(self._weight):
            raise ValueError(f"{len(self._radius)} radii and {len(self._weight)} weights")
        plays = len(self._radius)
        self._plays: Array = np.zeros((plays, n), dtype=dtype)
        self._near: Array = np.empty_like(self._plays)
        self._far: Array = np.empty_like(self._plays)
        self._floor: Array = np.zeros_like(self._plays)
        self._reading: Array = np.zeros(n, dtype=dtype)
        self._input = FiniteInput(n, dtype)
        self.bytes_per_taxel = (plays + 1) * np.dtype(dtype).itemsize

    def step(self, pressure_kpa: Array, dt_s: float, out: Array | None = None) -> Array:
        """Return the relaxation [n] in kPa at the end of the step; see `Relaxation`."""
        finite = self._input.take(np.asarray(pressure_kpa, dtype=self._plays.dtype))
        reading = np.fmax(finite, self._floor[0], out=self._reading)
        near, far = self._near, self._far
        np.subtract(reading, self._radius, out=near)
        np.add(reading, self._radius, out=far)
        np.maximum(self._plays, near, out=self._plays)
        np.minimum(self._plays, far, out=self._plays)
        np.maximum(near, self._floor, out=near)
        np.subtract(self._plays, near, out=far)
        return mix(self._weight, far, out)

    def part(self, taxels: NDArray[np.intp]) -> "PlayRelaxation":
        """Return a model of some taxels, int[k], that continues from their present state."""
        radius, weight = (
            values if values.shape[1] == 1 else values[:, taxels]
            for values in (self._radius, self._weight)
        )
        k, dtype = len(taxels), self._plays.dtype
        part = PlayRelaxation(k, radius_kpa=radius, weight=weight, dtype=dtype)
        part._plays[...] = self._plays[:, taxels]
        part._input.last[...] = self._input.last[taxels]
        return part

    def take_back(self, taxels: NDArray[np.intp], part: "PlayRelaxation") -> None:
        """Adopt the state of some taxels, int[k], from a model of them."""
        self._plays[:, taxels] = part._plays
        self._input.last[taxels] = part._input.last

    def reset(self, mask: NDArray[np.bool_] | None = None) -> None:
        """Forget the history of all taxels, or of those in `mask` [n]."""
        where = slice(None) if mask is None else mask
        self._plays[:, where] = 0.0
        self._input.last[where] = 0.0
