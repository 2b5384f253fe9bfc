"""What every relaxation model has in common: the interface, parameters, means."""

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

Array = NDArray[np.floating[Any]]
Parameters = Sequence[float] | Array

#: Sums of dt within this of a whole second complete it: 50 times 0.02 s is 1 s.
TIME_TOLERANCE_S = 1e-9
#: Below this a state is as good as zero; denormal numbers would cost 6 to 8 times the time.
NEGLIGIBLE_KPA = 1e-20
#: So often such states are looked for: one takes 40 time constants from there to denormal.
FLUSH_EVERY_S = 10.0


class Relaxation(Protocol):
    """A viscoelastic model of n taxels: how much pressure the foam has lost by now.

    The pressure on a taxel is its momentary pressure minus its relaxation (paper, equation 2).
    Samples hold over their step: `pressure_kpa` is what the taxels read during the last `dt_s`
    seconds.
    """

    n: int
    #: Size of the state, for the table of costs.
    bytes_per_taxel: int

    def step(self, pressure_kpa: Array, dt_s: float, out: Array | None = None) -> Array:
        """Return the relaxation [n] in kPa at the end of the step.

        Args:
            pressure_kpa: momentary pressure C [n]. A value that is not finite counts
                as the last one that was.
            dt_s: length of the step. Not finite or negative counts as 0.
            out: where to write the answer; without it a new array is made.
        """
        ...

    def reset(self, mask: NDArray[np.bool_] | None = None) -> None:
        """Forget the history of all taxels, or of those in `mask` [n]."""
        ...


def as_modes(name: str, values: Parameters, n: int, dtype: DTypeLike) -> Array:
    """Return parameters as [modes, 1] (shared) or [modes, n] (per taxel).

    Raises:
        ValueError: another shape, or a number that is negative or not finite.
    """
    array: Array = np.asarray(values, dtype=np.float64)
    if array.ndim == 1:
        array = array[:, np.newaxis]
    if array.ndim != 2 or array.shape[0] == 0 or array.shape[1] not in (1, n):
        raise ValueError(f"{name}: shape {np.shape(values)}, wanted [modes] or [modes, {n}]")
    if not np.all(np.isfinite(array)) or np.any(array < 0.0):
        raise ValueError(f"{name}: every number must be finite and not negative")
    return np.ascontiguousarray(array, dtype=dtype)


def check_modes(**named: Array) -> None:
    """Raise ValueError unless all arrays have as many modes, and no time constant is 0."""
    counts = {name: array.shape[0] for name, array in named.items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"numbers of modes differ: {counts}")
    for name, array in named.items():
        if name.startswith("tau") and np.any(array <= 0.0):
            raise ValueError(f"{name}: a time constant must be positive")


def clean_dt(dt_s: float) -> float:
    """Return a step that time can have taken: not negative, and a number."""
    return dt_s if 0.0 < dt_s < math.inf else 0.0


def approach(dt_s: float, tau_s: Array) -> Array:
    """Return 1 - exp(-dt/tau), right for the smallest steps too."""
    result: Array = -np.expm1(-dt_s / tau_s)
    return result


def mix(weights: Array, states: Array, out: Array | None = None) -> Array:
    """Return the sum over modes of weights [modes, 1 or n] times states [modes, n]."""
    shared = weights.shape[1] == 1
    if out is not None and out.dtype == states.dtype:
        if shared:
            np.dot(weights[:, 0], states, out=out)
        else:
            np.einsum("ij,ij->j", weights, states, out=out)
        return out
    total: Array = weights[:, 0] @ states if shared else np.einsum("ij,ij->j", weights, states)
    if out is None:
        return total
    np.copyto(out, total, casting="same_kind")
    return out


def all_finite(values: Array) -> bool:
    """Return whether every value is a number. One product is several times faster than a mask."""
    return math.isfinite(np.dot(values, values))


class FiniteInput:
    """The guard of the models that look at every sample: holds the last finite value."""

    def __init__(self, n: int, dtype: DTypeLike) -> None:
        self.last: Array = np.zeros(n, dtype=dtype)

    def take(self, pressure_kpa: Array) -> Array:
        """Return the samples with values that are not finite replaced; valid till next time."""
        if all_finite(pressure_kpa):
            self.last[...] = pressure_kpa
        else:
            np.copyto(self.last, pressure_kpa, where=np.isfinite(pressure_kpa))
        return self.last


class Flush:
    """Makes negligible states zero, once in a while."""

    def __init__(self) -> None:
        self._since_s = 0.0

    def step(self, states: Array, scratch: Array, dt_s: float) -> None:
        """Let time pass; `scratch`, as large as `states`, is overwritten."""
        self._since_s += dt_s
        if self._since_s >= FLUSH_EVERY_S:
            self._since_s = 0.0
            np.abs(states, out=scratch)
            np.putmask(states, scratch < NEGLIGIBLE_KPA, 0.0)


class TumblingMean:
    """Exact means over windows that follow each other, of samples that hold over their step.

    A window is complete when the summed dt reaches its length, in the middle of a step
    if need be. Values that are not finite are left out as if they were the mean so far.

    Samples are laid aside and summed several at a time: one product of a matrix costs
    less than many passes over the taxels.
    """

    ROWS = 8

    def __init__(self, n: int, length_s: float, dtype: DTypeLike) -> None:
        if not 0.0 < length_s < math.inf:
            raise ValueError(f"a window of {length_s} s, wanted a positive length")
        self.length_s = length_s
        self._nearly_s = length_s - TIME_TOLERANCE_S
        self.elapsed_s = 0.0
        self._summed_s = 0.0
        self._rows: Array = np.zeros((self.ROWS, n), dtype=dtype)
        self._row = list(self._rows)
        self._weights: Array = np.zeros(self.ROWS, dtype=dtype)
        self._laid = 0
        self._integral: Array = np.zeros(n, dtype=dtype)
        self._part: Array = np.zeros(n, dtype=dtype)
        self._mean: Array = np.zeros(n, dtype=dtype)
        self.bytes_per_taxel = (self.ROWS + 3) * self._mean.itemsize

    def feed(
        self, pressure_kpa: Array, dt_s: float, complete: Callable[[Array, int], None]
    ) -> None:
        """Add a step. Calls `complete(mean, windows)` for windows that end within it.

        `windows` is above 1 when the same mean holds over that many whole windows.
        """
        elapsed_s = self.elapsed_s + dt_s
        if elapsed_s < self._nearly_s:
            self._lay(pressure_kpa, dt_s)
            self.elapsed_s = elapsed_s
            return
        room = self.length_s - self.elapsed_s
        self._lay(pressure_kpa, room)
        self._fold()
        np.divide(self._integral, self.length_s, out=self._mean)
        self._integral.fill(0.0)
        self._summed_s = self.elapsed_s = 0.0
        complete(self._mean, 1)
        rest = max(dt_s - room, 0.0)
        whole = int((rest + TIME_TOLERANCE_S) / self.length_s)
        if whole:
            np.copyto(self._mean, pressure_kpa, where=np.isfinite(pressure_kpa))
            complete(self._mean, whole)
            rest = max(rest - whole * self.length_s, 0.0)
        if rest > 0.0:
            self._lay(pressure_kpa, rest)
            self.elapsed_s = rest

    def reset(self, mask: NDArray[np.bool_] | None) -> None:
        """Forget the samples of this window (of the taxels in `mask`)."""
        where = slice(None) if mask is None else mask
        self._rows[:, where] = 0.0
        self._integral[where] = 0.0
        self._mean[where] = 0.0
        if mask is None:
            self._laid = 0
            self._summed_s = self.elapsed_s = 0.0

    def _lay(self, pressure_kpa: Array, dt_s: float) -> None:
        laid = self._laid
        if laid == self.ROWS:
            self._fold()
            laid = 0
        # Half the cost of np.copyto.
        self._row[laid][...] = pressure_kpa
        self._weights[laid] = dt_s
        self._laid = laid + 1

    def _fold(self) -> None:
        laid, self._laid = self._laid, 0
        weights, rows = self._weights[:laid], self._rows[:laid]
        np.dot(weights, rows, out=self._part)
        if not all_finite(self._part):
            self._mend(rows, weights)
            np.dot(weights, rows, out=self._part)
        np.add(self._integral, self._part, out=self._integral)
        self._summed_s = self.elapsed_s

    def _mend(self, rows: Array, weights: Array) -> None:
        integral, summed_s = self._integral.copy(), self._summed_s
        for row, dt_s in zip(rows, weights.tolist(), strict=True):
            so_far = integral / summed_s if summed_s > 0.0 else self._mean
            np.copyto(row, so_far, where=~np.isfinite(row))
            integral += dt_s * row
            summed_s += dt_s
