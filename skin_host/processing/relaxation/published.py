"""The published model (Schmitz et al. 2011, equation 5), exactly and at constant cost."""

import numpy as np
from numpy.typing import DTypeLike, NDArray

from skin_host.processing.relaxation.base import (
    Array,
    Parameters,
    TumblingMean,
    approach,
    as_modes,
    check_modes,
    clean_dt,
    mix,
)


class PublishedRelaxation:
    """Boltzmann superposition with one kernel for loading and one for unloading steps.

    Every `mean_s` the mean of C is compared with D, the sum of all steps so far; when they
    differ by more than `threshold_kpa`, their difference becomes a new step at that
    instant. With A the sum of a branch's steps, the response r_k of a mode to all of them
    relaxes towards A with tau_k and is unchanged by a step. This is the direct sum of
    equation (5), not an approximation: between steps each of its terms decays by the
    same factor.

    The model is not one of fading memory: when the sums of beta differ between the
    branches, every press leaves a residue for ever.

    Args:
        n: number of taxels.
        beta_load: share of each mode in steps up, [modes] or [modes, n].
        tau_load_s: its time constant.
        beta_unload: share of each mode in steps down.
        tau_unload_s: its time constant.
        mean_s: length of the average.
        threshold_kpa: difference above which a step is made.
        held: whether the answer stays the same between the ends of averages, for speed.
        dtype: of states and answers. The sums of steps grow without bound; in float32 they
            are off by a tenth of a kPa after some days of work.
    """

    def __init__(
        self,
        n: int,
        *,
        beta_load: Parameters,
        tau_load_s: Parameters,
        beta_unload: Parameters,
        tau_unload_s: Parameters,
        mean_s: float = 1.0,
        threshold_kpa: float = 1.5,
        held: bool = False,
        dtype: DTypeLike = np.float64,
    ) -> None:
        self.n = n
        self._dtype = np.dtype(dtype)
        beta = [as_modes("beta_load", beta_load, n, np.float64)]
        beta += [as_modes("beta_unload", beta_unload, n, np.float64)]
        tau = [as_modes("tau_load_s", tau_load_s, n, np.float64)]
        tau += [as_modes("tau_unload_s", tau_unload_s, n, np.float64)]
        check_modes(beta_load=beta[0], tau_load_s=tau[0])
        check_modes(beta_unload=beta[1], tau_unload_s=tau[1])
        width = max(array.shape[1] for array in (*beta, *tau))
        # Both branches below each other, loading first.
        self._beta = np.concatenate([np.broadcast_to(a, (len(a), width)) for a in beta])
        self._tau_s = np.concatenate([np.broadcast_to(a, (len(a), width)) for a in tau])
        self._split = len(beta[0])
        modes = len(self._beta)
        # One array, so that the answer is one product: responses of both branches, and the two
        # sums of steps.
        self._states: Array = np.zeros((modes + 2, n), dtype=dtype)
        self._responses = self._states[:modes]
        self._sum_load = self._states[modes]
        self._sum_unload = self._states[modes + 1]
        self._staircase: Array = np.zeros(n, dtype=dtype)
        self._relaxation: Array = np.zeros(n, dtype=dtype)
        self._gap: Array = np.empty(n, dtype=dtype)
        self._scratch: Array = np.empty_like(self._responses)
        self._threshold_kpa = threshold_kpa
        self._held = held
        self._mean = TumblingMean(n, mean_s, dtype)
        self.bytes_per_taxel = (modes + 4) * self._dtype.itemsize + self._mean.bytes_per_taxel

    def step(self, pressure_kpa: Array, dt_s: float, out: Array | None = None) -> Array:
        """Return the relaxation [n] in kPa at the end of the step; see `Relaxation`."""
        self._mean.feed(pressure_kpa, clean_dt(dt_s), self._complete)
        if not self._held:
            return mix(self._weights(self._mean.elapsed_s), self._states, out)
        if out is None:
            return self._relaxation.copy()
        out[...] = self._relaxation
        return out

    def reset(self, mask: NDArray[np.bool_] | None = None) -> None:
        """Forget the history of all taxels, or of those in `mask` [n]."""
        where = slice(None) if mask is None else mask
        self._states[:, where] = 0.0
        self._staircase[where] = 0.0
        self._relaxation[where] = 0.0
        self._mean.reset(mask)

    def _weights(self, age_s: float) -> Array:
        """Weights of the states in the relaxation, `age_s` after they were up to date."""
        modes, split = len(self._beta), self._split
        done = approach(age_s, self._tau_s)
        done *= self._beta
        weights = np.empty((modes + 2, self._beta.shape[1]), dtype=self._dtype)
        np.subtract(self._beta, done, out=weights[:modes], casting="same_kind")
        weights[modes] = done[:split].sum(axis=0)
        weights[modes + 1] = done[split:].sum(axis=0)
        return weights

    def _complete(self, mean_kpa: Array, seconds: int) -> None:
        """A second has ended; with the same mean, `seconds` of them."""
        self._advance(self._mean.length_s)
        self._add_steps(mean_kpa)
        if seconds > 1:
            # The first has made the step, if there was one: the others bring no more.
            self._advance((seconds - 1) * self._mean.length_s)
        if self._held:
            mix(self._weights(0.0), self._states, self._relaxation)

    def _advance(self, dt_s: float) -> None:
        share = approach(dt_s, self._tau_s).astype(self._dtype)
        change = self._scratch
        np.subtract(self._sum_load, self._responses[: self._split], out=change[: self._split])
        np.subtract(self._sum_unload, self._responses[self._split :], out=change[self._split :])
        np.multiply(change, share, out=change)
        np.add(self._responses, change, out=self._responses)

    def _add_steps(self, mean_kpa: Array) -> None:
        np.subtract(mean_kpa, self._staircase, out=self._gap)
        self._gap[np.abs(self._gap) <= self._threshold_kpa] = 0.0
        np.add(self._staircase, self._gap, out=self._staircase)
        np.add(self._sum_load, np.maximum(self._gap, 0.0), out=self._sum_load)
        np.add(self._sum_unload, np.minimum(self._gap, 0.0), out=self._sum_unload)
