"""Rate-independent hysteresis: plays beside no time at all (Prandtl-Ishlinskii)."""

import numpy as np
from numpy.typing import DTypeLike, NDArray

from skin_host.processing.relaxation.base import Array, FiniteInput, Parameters, as_modes


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
        np.multiply(far, self._weight, out=far)
        return np.add.reduce(far, axis=0, out=out)

    def step_some(self, taxels: NDArray[np.intp], pressure_kpa: Array, out: Array) -> None:
        """Step some taxels only, in steps that cost as much as there are taxels in them.

        Args:
            taxels: int[k], which.
            pressure_kpa: momentary pressures of all taxels [n]; finite.
            out: [n], the relaxation in kPa; that of the others is left as it is.
        """
        if 4 * len(taxels) > self.n:
            self.step(pressure_kpa, 0.0, out)
            return
        radius = self._radius if self._radius.shape[1] == 1 else self._radius[:, taxels]
        weight = self._weight if self._weight.shape[1] == 1 else self._weight[:, taxels]
        zero = self._floor[0, 0]
        reading = np.maximum(pressure_kpa.take(taxels), zero)
        near = reading - radius
        plays = self._plays.take(taxels, axis=1)
        np.maximum(plays, near, out=plays)
        np.minimum(plays, reading + radius, out=plays)
        self._plays[:, taxels] = plays
        plays -= np.maximum(near, zero, out=near)
        plays *= weight
        out[taxels] = np.add.reduce(plays, axis=0)

    def reset(self, mask: NDArray[np.bool_] | None = None) -> None:
        """Forget the history of all taxels, or of those in `mask` [n]."""
        where = slice(None) if mask is None else mask
        self._plays[:, where] = 0.0
        self._input.last[where] = 0.0
