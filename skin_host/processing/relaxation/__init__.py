"""The models of the foam: what each keeps of the past, and what it makes of it.

`none`, `asymmetric` (the default) and `published` (Schmitz et al. 2011, equation 5, exactly and at
constant cost) forget with time; the plays (Prandtl-Ishlinskii) remember without it. All stand
behind one interface, `base.Relaxation`.

The paper's Table I (its twelve parameters) is not in any public copy of it. The named sets here are
replacements: they agree with its text about the foam, and they span the known range of porous
silicones. For the numbers of a real skin, fit them to a recording:
`skin calibrate --relaxation LOG`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

from skin_host.config.relaxation import MODELS
from skin_host.config.relaxation import RelaxationSettings as Settings
from skin_host.processing.relaxation.base import (
    Array,
    FiniteInput,
    Flush,
    Parameters,
    Relaxation,
    TumblingMean,
    all_finite,
    approach,
    as_modes,
    check_modes,
    clean_dt,
    mix,
)

__all__ = [
    "OWN_MEANS",
    "STAND_INS",
    "AsymmetricRelaxation",
    "NoRelaxation",
    "ParameterSet",
    "PlayRelaxation",
    "PublishedRelaxation",
    "Relaxation",
    "log_spaced",
    "make_model",
    "parameters_of",
    "stand_in",
]

#: Evenly spaced modes, from a second to the longest that an hour's record can distinguish from a
#: constant.
LOG_TAU_S = (1.0, 4.8, 23.0, 110.0, 520.0, 2500.0)
#: Models that take means of their own, and so must see every sample.
OWN_MEANS = ("published",)


class NoRelaxation:
    """`none`: no correction, the foam is taken as perfectly elastic."""

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


class AsymmetricRelaxation:
    """`asymmetric`: each state q_k relaxes towards the pressure C; relaxation = sum beta_k q_k.

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


class PublishedRelaxation:
    """`published`: Boltzmann superposition with one kernel for loading and one for unloading steps.

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
        #: Both ends of where each play may be, relative to the reading and absolute.
        self._reach = np.concatenate([-self._radius, self._radius])
        self._ends: Array = np.empty((2 * plays, n), dtype=dtype)
        self._near, self._far = self._ends[:plays], self._ends[plays:]
        self._floor: Array = np.zeros(n, dtype=dtype)
        self._reading: Array = np.zeros(n, dtype=dtype)
        self.bytes_per_taxel = (plays + 1) * np.dtype(dtype).itemsize

    def step(self, pressure_kpa: Array, dt_s: float, out: Array | None = None) -> Array:
        """Return the relaxation [n] in kPa at the end of the step; see `Relaxation`."""
        reading = np.asarray(pressure_kpa, dtype=self._plays.dtype)
        if not all_finite(reading):
            reading = np.where(np.isfinite(reading), reading, self._reading)
        reading = np.maximum(reading, self._floor, out=self._reading)
        near, far = self._near, self._far
        np.add(reading, self._reach, out=self._ends)
        np.maximum(self._plays, near, out=self._plays)
        np.minimum(self._plays, far, out=self._plays)
        np.maximum(near, self._floor, out=near)
        np.subtract(self._plays, near, out=far)
        return mix(self._weight, far, out)

    def part(self, taxels: NDArray[np.intp] | slice) -> "PlayRelaxation":
        """Return a model of some taxels, k of them, that continues from their present state."""
        radius, weight = (
            values if values.shape[1] == 1 else values[:, taxels]
            for values in (self._radius, self._weight)
        )
        reading, dtype = self._reading[taxels], self._plays.dtype
        part = PlayRelaxation(len(reading), radius_kpa=radius, weight=weight, dtype=dtype)
        part._plays[...] = self._plays[:, taxels]
        part._reading[...] = reading
        return part

    def take_back(self, taxels: NDArray[np.intp] | slice, part: "PlayRelaxation") -> None:
        """Adopt the state of some taxels from a model of them."""
        self._plays[:, taxels] = part._plays
        self._reading[taxels] = part._reading

    def reset(self, mask: NDArray[np.bool_] | None = None) -> None:
        """Forget the history of all taxels, or of those in `mask` [n]."""
        where = slice(None) if mask is None else mask
        self._plays[:, where] = 0.0
        self._reading[where] = 0.0


@dataclass(frozen=True)
class ParameterSet:
    """Shares and time constants of the modes, for pressing and for letting go."""

    beta: Parameters
    tau_s: Parameters
    beta_unload: Parameters
    tau_unload_s: Parameters


STAND_INS = {
    "mild": ParameterSet((0.04, 0.05, 0.06), (4, 90, 1500), (0.035, 0.05, 0.06), (8, 180, 3000)),
    "mid": ParameterSet((0.07, 0.08, 0.10), (6, 120, 1800), (0.06, 0.08, 0.09), (12, 240, 3600)),
    "strong": ParameterSet((0.10, 0.12, 0.18), (8, 150, 2400), (0.08, 0.11, 0.16), (20, 400, 4800)),
}


def log_spaced(total_beta: float, unload_ratio: float = 2.0) -> ParameterSet:
    """Return modes spaced evenly in the logarithm of time, sharing `total_beta` alike."""
    beta = tuple(total_beta / len(LOG_TAU_S) for _ in LOG_TAU_S)
    slow = tuple(unload_ratio * tau for tau in LOG_TAU_S)
    return ParameterSet(beta, LOG_TAU_S, beta, slow)


def stand_in(model: str, name: str) -> ParameterSet:
    """Return the stand-in set `name` (mild, mid, strong) as `model` wants it."""
    chosen = STAND_INS[name]
    if model != "asymmetric":
        return chosen
    return log_spaced(float(np.sum(np.asarray(chosen.beta))))


def make_model(
    model: str,
    n: int,
    parameters: ParameterSet,
    *,
    held: bool = False,
    dtype: DTypeLike = np.float64,
) -> Relaxation:
    """Make a relaxation model by name for n taxels.

    Args:
        model: one of MODELS.
        n: number of taxels.
        parameters: of the model; those of unloading serve the models that have them.
        held: whether the published model's answer stays the same between the ends of its
            averages.
        dtype: of states and answers.

    Raises:
        ValueError: no such model, or parameters that do not fit together.
    """
    match model:
        case "none":
            return NoRelaxation(n, dtype=dtype)
        case "published":
            return PublishedRelaxation(
                n,
                beta_load=parameters.beta,
                tau_load_s=parameters.tau_s,
                beta_unload=parameters.beta_unload,
                tau_unload_s=parameters.tau_unload_s,
                held=held,
                dtype=dtype,
            )
        case "asymmetric":
            return AsymmetricRelaxation(
                n,
                beta=parameters.beta,
                tau_s=parameters.tau_s,
                tau_unload_s=parameters.tau_unload_s,
                dtype=dtype,
            )
        case _:
            raise ValueError(f'no relaxation model "{model}"; there are: {", ".join(MODELS)}')


def parameters_of(settings: Settings) -> ParameterSet:
    """Return the parameters that a configuration asks for (table `processing.relaxation`)."""
    if settings.beta is None or settings.tau_s is None:
        return stand_in(settings.model, settings.set)
    return ParameterSet(
        settings.beta,
        settings.tau_s,
        settings.beta if settings.beta_unload is None else settings.beta_unload,
        settings.tau_s if settings.tau_unload_s is None else settings.tau_unload_s,
    )
