"""The default model: one state per exponential, slower on unloading."""

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


class AsymmetricRelaxation:
    """Each state q_k relaxes towards the momentary pressure C; relaxation = sum beta_k q_k.

    The time constant is tau_k while C is above the state and tau_unload_k while it is
    below. Exact for samples that hold over their step, whatever the sampling. As every
    q_k stays between 0 and the largest C, the relaxation is bounded by sum(beta) max(C)
    for ever, and zero input brings it back to zero. With equal time constants it is the
    linear Prony model. The published model (PublishedRelaxation) has neither property.

    Args:
        n: number of taxels.
        beta: what each mode takes of the pressure in the end, [modes] or [modes, n].
        tau_s: time constants of loading, alike.
        tau_unload_s: time constants of unloading, alike.
        dtype: of states and answers, float64 or float32.
    """

    def __init__(
        self,
        n: int,
        *,
        beta: Parameters,
        tau_s: Parameters,
        tau_unload_s: Parameters,
        dtype: DTypeLike = np.float64,
    ) -> None:
        self.n = n
        self._dtype = np.dtype(dtype)
        self._beta = as_modes("beta", beta, n, dtype)
        tau = as_modes("tau_s", tau_s, n, np.float64)
        tau_unload = as_modes("tau_unload_s", tau_unload_s, n, np.float64)
        check_modes(beta=self._beta, tau_s=tau, tau_unload_s=tau_unload)
        self._tau_s, self._tau_unload_s = tau, tau_unload
        modes = self._beta.shape[0]
        self._states: Array = np.zeros((modes, n), dtype=dtype)
        self._over: Array = np.empty_like(self._states)
        self._share: Array = np.empty_like(self._states)
        self._zeros: Array = np.zeros_like(self._states)
        self._input = FiniteInput(n, dtype)
        self._rates_dt_s = -1.0
        self._fall: Array = np.zeros(1, dtype=dtype)
        self._extra_rise: Array = np.zeros(1, dtype=dtype)
        self._flush = Flush()
        self.bytes_per_taxel = (modes + 1) * self._dtype.itemsize

    def step(self, pressure_kpa: Array, dt_s: float, out: Array | None = None) -> Array:
        """Return the relaxation [n] in kPa at the end of the step; see `Relaxation`."""
        pressure_kpa = self._input.take(np.asarray(pressure_kpa, dtype=self._dtype))
        dt_s = clean_dt(dt_s)
        np.subtract(pressure_kpa, self._states, out=self._over)
        self._approach(dt_s)
        self._flush.step(self._states, self._over, dt_s)
        return mix(self._beta, self._states, out)

    def reset(self, mask: NDArray[np.bool_] | None = None) -> None:
        """Forget the history of all taxels, or of those in `mask` [n]."""
        where = slice(None) if mask is None else mask
        self._states[:, where] = 0.0
        self._input.last[where] = 0.0

    def _approach(self, dt_s: float) -> None:
        """q += fall * d + (rise - fall) * max(d, 0) with d = C - q: both ways, no branch."""
        if dt_s != self._rates_dt_s:
            fall = approach(dt_s, self._tau_unload_s)
            self._fall = fall.astype(self._dtype)
            self._extra_rise = (approach(dt_s, self._tau_s) - fall).astype(self._dtype)
            self._rates_dt_s = dt_s
        np.fmax(self._over, self._zeros, out=self._share)
        np.multiply(self._over, self._fall, out=self._over)
        np.multiply(self._share, self._extra_rise, out=self._share)
        np.add(self._states, self._over, out=self._states)
        np.add(self._states, self._share, out=self._states)
