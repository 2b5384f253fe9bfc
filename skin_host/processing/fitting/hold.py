"""Fits the relaxation models to one recording: a hold and a release.

The paper's recipe (section VI-G): press quickly, hold for an hour, release, record for 75 minutes
more, and choose the parameters so that the corrected pressure matches the load cell. The result
also states what one such record cannot show.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skin_host.config.relaxation import FITTED
from skin_host.processing.relaxation import ParameterSet, make_model, stand_in
from skin_host.processing.relaxation.base import Parameters

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Samples after a sudden change are kept one by one for this long, then merged more and more.
FINE_S = 1.0
GROWTH = 1.1
COARSE_S = 60.0
#: Uncertainty of the pressure at any time, and of a parameter before the fit (as the logarithm of a
#: factor). Together they keep parameters that the record does not show near the start values.
UNCERTAINTY_KPA = 0.3
DOUBT_FACTOR = np.log(4.0)
#: A parameter whose uncertainty in the record is worse than this factor is reported as uncertain.
UNKNOWN_FACTOR = 2.0
#: A greater factor is reported as this one.
MOST_FACTOR = 1000.0
MAXIMUM_ITERATIONS = 60
#: How much slower than loading unloading is assumed to be before the fit.
START_RATIO = 2.0


@dataclass(frozen=True)
class HoldRecord:
    """A hold and a release, merged into steps of growing length.

    Attributes:
        dt_s: float64[t], lengths of the steps.
        momentary_kpa: float64[t], mean of C over each step.
        pressure_kpa: float64[t], true pressure at the end of each step, NaN where unknown.
        released: index of the first step after the release.
        unit_rms_kpa: error from readings in whole units at the hold's level, if no noise blurs
            them; 0 for exact readings.
        lag_s: by how much the clock of the table of pressures was found to be ahead.
    """

    dt_s: Floats
    momentary_kpa: Floats
    pressure_kpa: Floats
    released: int
    unit_rms_kpa: float = 0.0
    lag_s: float = 0.0

    @property
    def hold_s(self) -> float:
        return float(self.dt_s[: self.released].sum())

    @property
    def level_kpa(self) -> float:
        """Momentary pressure of the hold."""
        return float(np.median(self.momentary_kpa[: self.released]))

    @property
    def rest_s(self) -> float:
        return float(self.dt_s[self.released :].sum())


@dataclass(frozen=True)
class Fit:
    """A model's parameters for one foam, and their reliability.

    Attributes:
        model: its name.
        parameters: as `make_model` takes them.
        rms_hold_kpa, rms_rest_kpa: remaining error in the record, with equal weight for each
            moment of the logarithm of time; NaN where the pressure is unknown.
        uncertain: names of parameters that the record does not show, with the factor within
            which they are known.
        remarks: limits of this record, as sentences.
    """

    model: str
    parameters: ParameterSet
    rms_hold_kpa: float
    rms_rest_kpa: float
    uncertain: dict[str, float]
    remarks: tuple[str, ...]


def merge(
    dt_s: float, momentary_kpa: Floats, pressure_kpa: Floats, start: int, release: int
) -> HoldRecord:
    """Merge a regularly sampled record, finely after the press and the release, then coarsely.

    Args:
        dt_s: distance of the samples.
        momentary_kpa: C [t].
        pressure_kpa: true pressure [t], NaN where unknown.
        start: first sample of the press.
        release: first sample of the release.
    """
    edges = _edges(dt_s, release - start) + start
    edges = np.concatenate([edges[:-1], _edges(dt_s, len(momentary_kpa) - release) + release])
    counts = np.diff(edges)
    sums = np.add.reduceat(momentary_kpa[: edges[-1]], edges[:-1])
    released = int(np.searchsorted(edges, release))
    return HoldRecord(counts * dt_s, sums / counts, pressure_kpa[edges[1:] - 1], released)


def _edges(dt_s: float, samples: int) -> NDArray[np.intp]:
    edges, at, step_s = [0], 0, dt_s
    while at < samples:
        at = min(at + max(round(step_s / dt_s), 1), samples)
        edges.append(at)
        if at * dt_s > FINE_S:
            step_s = min(step_s * GROWTH, COARSE_S)
    return np.array(edges)


class _Shape:
    """Converts a model's parameters to and from a vector of logarithms.

    The modes of `asymmetric` are evenly spaced in the logarithm of time: their shares are free,
    and one ratio of unloading to loading times. A branch of `published` has free times.
    """

    def __init__(self, model: str) -> None:
        start = stand_in(model, "mid")
        self._tau_s = np.reshape(np.asarray(start.tau_s, dtype=np.float64), (-1, 1))
        self._modes = len(self._tau_s)
        self._free_tau = model == "published"
        self.names = [f"beta_{k + 1}" for k in range(self._modes)]
        first = [*np.ravel(start.beta)]
        if self._free_tau:
            self.names += [f"tau_{k + 1}" for k in range(self._modes)]
            first += [*np.ravel(start.tau_s)]
        else:
            self.names.append("unload_ratio")
            first.append(START_RATIO)
        self.start: Floats = np.log(np.array(first, dtype=np.float64))

    def parameters(self, vectors: Floats) -> ParameterSet:
        """Parameters [modes, k] of vectors [k, p]."""
        values = np.exp(vectors).T
        beta = values[: self._modes]
        if self._free_tau:
            tau = values[self._modes :]
            return ParameterSet(beta, tau, beta, tau)
        tau = np.repeat(self._tau_s, values.shape[1], axis=1)
        return ParameterSet(beta, tau, beta, tau * values[-1])


def fit(model: str, record: HoldRecord) -> Fit:
    """Fit one model.

    Raises:
        ValueError: no such model, or one without parameters.
    """
    if model not in FITTED:
        raise ValueError(f'no parameters to fit in a model "{model}"')
    if model == "published":
        return _fit_published(record)
    shape = _Shape(model)

    def relaxation(vectors: Floats) -> Floats:
        return _simulate(model, shape.parameters(vectors), record)

    vector, spread = _least_squares(relaxation, shape.start, record, slice(None))
    best = _single(shape.parameters(vector[np.newaxis]))
    uncertain = _uncertain(shape.names, spread)
    return _judged(model, best, record, uncertain)


def _fit_published(record: HoldRecord) -> Fit:
    """Fit in the paper's order: the loading branch on the hold, then the other one on the rest."""
    shape = _Shape("published")

    def loading(vectors: Floats) -> Floats:
        chosen = shape.parameters(vectors)
        return _simulate("published", chosen, record)

    def both(vectors: Floats) -> Floats:
        chosen = shape.parameters(vectors)
        fixed = shape.parameters(np.repeat(load_vector[np.newaxis], len(vectors), axis=0))
        mixed = ParameterSet(fixed.beta, fixed.tau_s, chosen.beta, chosen.tau_s)
        return _simulate("published", mixed, record)

    hold, rest = slice(0, record.released), slice(record.released, None)
    load_vector, load_spread = _least_squares(loading, shape.start, record, hold)
    unload_vector, unload_spread = _least_squares(both, load_vector, record, rest)
    load = _single(shape.parameters(load_vector[np.newaxis]))
    unload = _single(shape.parameters(unload_vector[np.newaxis]))
    best = ParameterSet(load.beta, load.tau_s, unload.beta, unload.tau_s)
    uncertain = _uncertain(shape.names, load_spread)
    uncertain |= _uncertain([f"{name}_unload" for name in shape.names], unload_spread)
    return _judged("published", best, record, uncertain)


def _simulate(model: str, parameters: ParameterSet, record: HoldRecord) -> Floats:
    """Return the relaxation [t, k] for k sets of parameters: each set is a separate taxel."""
    k = 1 if np.ndim(parameters.beta) == 1 else np.shape(parameters.beta)[1]
    simulated = make_model(model, k, parameters)
    result = np.empty((len(record.dt_s), k))
    for row, (dt_s, pressure) in enumerate(zip(record.dt_s, record.momentary_kpa, strict=True)):
        simulated.step(np.full(k, pressure), float(dt_s), result[row])
    return result


def _least_squares(
    relaxation: Callable[[Floats], Floats], start: Floats, record: HoldRecord, part: slice
) -> tuple[Floats, Floats]:
    """Levenberg-Marquardt on the logarithms; return the best vector and its uncertainty."""
    wanted = (record.momentary_kpa - record.pressure_kpa)[part]
    known = np.isfinite(wanted)
    n = len(start)

    def residuals(vectors: Floats) -> Floats:
        error = relaxation(vectors)[part][known] - wanted[known, np.newaxis]
        prior = (vectors - start).T / DOUBT_FACTOR
        return np.concatenate([error / UNCERTAINTY_KPA, prior])

    vector, damping, nudge = start.copy(), 1e-2, 1e-4
    for _ in range(MAXIMUM_ITERATIONS):
        nudged = np.concatenate([vector[np.newaxis], vector + nudge * np.eye(n)])
        around = residuals(nudged)
        here = around[:, 0]
        jacobian = (around[:, 1:] - here[:, np.newaxis]) / nudge
        normal = jacobian.T @ jacobian
        gradient = jacobian.T @ here
        trials = damping * 10.0 ** np.arange(-1.0, 3.0)
        moves = [
            np.linalg.solve(normal + trial * np.diag(np.diag(normal)), -gradient)
            for trial in trials
        ]
        candidates = vector + np.clip(np.array(moves), -1.0, 1.0)
        costs = np.sum(residuals(candidates) ** 2, axis=0)
        best = int(np.argmin(costs))
        gain = float(here @ here) - float(costs[best])
        if gain <= 0.0:
            damping *= 100.0
            if damping > 1e8:
                break
            continue
        vector, damping = candidates[best], float(max(trials[best], 1e-9))
        if gain < 1e-5 * costs[best]:
            break
    # Where the record fits worse than was assumed, its information counts for less.
    worse = max(1.0, _rms(here[: np.count_nonzero(known)]))
    spread = worse * np.sqrt(np.diag(np.linalg.inv(normal)))
    return vector, spread


def _uncertain(names: list[str], spread: Floats) -> dict[str, float]:
    factors = np.exp(np.minimum(spread, np.log(MOST_FACTOR)))
    return {
        name: round(float(factor), 2)
        for name, factor in zip(names, factors, strict=True)
        if factor > UNKNOWN_FACTOR
    }


def _single(parameters: ParameterSet) -> ParameterSet:
    """Return the first of several sets, as plain numbers."""

    def column(values: Parameters) -> tuple[float, ...]:
        return tuple(float(value) for value in np.asarray(values)[:, 0])

    return ParameterSet(
        column(parameters.beta),
        column(parameters.tau_s),
        column(parameters.beta_unload),
        column(parameters.tau_unload_s),
    )


def _judged(
    model: str, parameters: ParameterSet, record: HoldRecord, uncertain: dict[str, float]
) -> Fit:
    relaxation = _simulate(model, parameters, record)[:, 0]
    error = relaxation - (record.momentary_kpa - record.pressure_kpa)
    remarks = []
    if not np.any(np.isfinite(error[: record.released])):
        remarks.append("the pressure of the hold is unknown: loading times are start values")
    longest = max(np.max(parameters.tau_s), np.max(parameters.tau_unload_s))
    if longest > 0.5 * record.rest_s:
        remarks.append(
            f"the slowest mode ({longest:.0f} s) is hardly distinguishable from a constant in "
            f"{record.rest_s:.0f} s of rest: longer holds are extrapolated"
        )
    remarks.append(
        f"one level ({record.level_kpa:.0f} kPa): whether others relax in proportion and as fast "
        "is not known"
    )
    return Fit(
        model,
        parameters,
        _rms(error[: record.released]),
        _rms(error[record.released :]),
        uncertain,
        tuple(remarks),
    )


def _rms(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
