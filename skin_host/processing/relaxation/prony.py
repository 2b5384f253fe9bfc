"""The linear models: no relaxation at all, and the Prony series."""

import numpy as np
from numpy.typing import DTypeLike, NDArray

from skin_host.processing.relaxation.base import (
    Array,
    FiniteInput,
    Flush,
    Parameters,
    approach,
    as_modes,
    check_modes,
    clean_dt,
    mix,
)

SERIES_BELOW = 1e-4


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


class PronyRelaxation:
    """Linear viscoelasticity, tau_k q_k' = C - q_k, exact for input linear between samples.

    The update of viscoelastic finite elements (Taylor, Pister and Goudreau 1970; Abaqus
    Theory Manual 4.7.1): with x = dt/tau, e = 1 - exp(-x) and g = 1 - e/x,
    q1 = (1-e) q0 + (e-g) C0 + g C1. All three weights are positive and sum to 1, so it
    never overshoots. The first sample after a reset is taken as steady.

    Args:
        n: number of taxels.
        beta: what each mode takes of the pressure in the end, [modes] or [modes, n].
        tau_s: time constants, alike.
        dtype: of states and answers, float64 or float32.
    """

    def __init__(
        self,
        n: int,
        *,
        beta: Parameters,
        tau_s: Parameters,
        dtype: DTypeLike = np.float64,
    ) -> None:
        self.n = n
        self._dtype = np.dtype(dtype)
        self._beta = as_modes("beta", beta, n, dtype)
        self._tau_s = as_modes("tau_s", tau_s, n, np.float64)
        check_modes(beta=self._beta, tau_s=self._tau_s)
        self._states: Array = np.zeros((self._beta.shape[0], n), dtype=dtype)
        self._scratch: Array = np.empty_like(self._states)
        self._start: Array = np.zeros(n, dtype=dtype)
        self._fresh = np.ones(n, dtype=np.bool_)
        self._any_fresh = True
        self._input = FiniteInput(n, dtype)
        self._flush = Flush()
        self.bytes_per_taxel = (self._beta.shape[0] + 2) * self._dtype.itemsize + 1

    def step(self, pressure_kpa: Array, dt_s: float, out: Array | None = None) -> Array:
        """Return the relaxation [n] in kPa at the end of the step; see `Relaxation`.

        Here `pressure_kpa` is the pressure at the end of the step, reached on a straight
        line from that of the step before.
        """
        end = self._input.take(np.asarray(pressure_kpa, dtype=self._dtype))
        if self._any_fresh:
            self._start[self._fresh] = end[self._fresh]
            self._fresh.fill(False)
            self._any_fresh = False
        dt_s = clean_dt(dt_s)
        rise, ramp = _weights(dt_s, self._tau_s)
        # q += e (C0 - q) + g (C1 - C0)
        np.subtract(self._start, self._states, out=self._scratch)
        np.multiply(self._scratch, rise.astype(self._dtype), out=self._scratch)
        np.add(self._states, self._scratch, out=self._states)
        np.subtract(end, self._start, out=self._start)
        np.multiply(self._start, ramp.astype(self._dtype), out=self._scratch)
        np.add(self._states, self._scratch, out=self._states)
        np.copyto(self._start, end)
        self._flush.step(self._states, self._scratch, dt_s)
        return mix(self._beta, self._states, out)

    def reset(self, mask: NDArray[np.bool_] | None = None) -> None:
        """Forget the history of all taxels, or of those in `mask` [n]."""
        where = slice(None) if mask is None else mask
        self._states[:, where] = 0.0
        self._input.last[where] = 0.0
        self._fresh[where] = True
        self._any_fresh = True


def _weights(dt_s: float, tau_s: Array) -> tuple[Array, Array]:
    """Return e and g of the update. For small steps g is a difference of near equals."""
    x = dt_s / tau_s
    rise = approach(dt_s, tau_s)
    with np.errstate(invalid="ignore"):
        ramp = np.where(
            x < SERIES_BELOW, x / 2 - x * x / 6 + x * x * x / 24, 1.0 - rise / np.where(x, x, 1.0)
        )
    return rise, ramp
