"""Viscoelastic truths of the foam: what the pressure really is, given how far it is squeezed.

They are what compensators are measured against, so none of them is a compensator's model. All
lose 28 % of a small pressure in the end; but for F by seven modes over four decades of time:

    L  linear: the ordinary Prony solid.
    A  asymmetric: unloading 2.5 times slower, losses grow with amplitude, rates with overstress.
    H  as A, and three play operators: about 3 % of hysteresis at any speed.
    S  symmetric, but times shrink with compression: tau exp(-(C - 30 kPa) / 40 kPa). Slow
       unloading comes out of it without being put in. The default.
    F  fractional: the Cole-Cole law, whose relaxation is a power of time at both ends and no
       finite sum of exponentials; losses grow with amplitude.
    M  softens and heals (Mullins effect): as L, and below the highest compression of late the
       foam bears up to 3 % less, after Ogden and Roxburgh; that memory fades in 30 min.

The numbers are chosen, not measured: no relaxation curve of the paper's foam is public.

K. S. Cole, R. H. Cole, Journal of Chemical Physics 9, 341 (1941), eq. (5) and its spectrum; R. W.
Ogden, D. G. Roxburgh, Proceedings of the Royal Society A 455, 2861 (1999), with a hyperbolic
tangent for the error function.
"""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
TruthKind = Literal["S", "A", "L", "H", "F", "M"]

TAU_S = np.geomspace(1.5, 6000.0, 7)
BETA = np.full(7, 0.04)
#: Spread of the losses from taxel to taxel, when drawn.
STRENGTH_SD = 0.1
#: Above this, truth S gets no faster: presses of 2 s at 160 kPa must have come back after 20 s
#: to within the scatter of the paper's repetitions (2.3-5 kPa).
SHIFT_LIMIT_KPA = 100.0
#: Above this, the share that is lost grows no further with the amplitude: more would be lost than
#: there is, and foam that carries no pressure would swell without end.
AMPLITUDE_LIMIT_KPA = 400.0
#: Half widths of the play operators (kPa). Each costs PLAY_SHARE of its width.
PLAY_KPA = np.array([4.0, 12.0, 34.0])
PLAY_SHARE = 0.03
#: Rate-independent hysteresis fades below this pressure: foam at rest is foam at rest.
PLAY_FADE_KPA = 10.0
#: Exponent and time of the Cole-Cole law. Its spectrum is taken at four times a decade.
COLE_EXPONENT = 0.5
COLE_TAU_S = 100.0
COLE_TAUS_S = np.geomspace(1e-4, 1e8, 49)
#: Mullins effect: the share that is lost far below the highest compression, how far below that
#: is, and how soon that compression is forgotten.
SOFTENING = 0.03
SOFTENING_KPA = 40.0
HEALING_S = 1800.0
_NONE = np.zeros(0)


def _cole_cole() -> Floats:
    """Weights of `COLE_TAUS_S`: the spectrum of the Cole-Cole law, 28 % in all."""
    away = np.log(COLE_TAUS_S / COLE_TAU_S)
    density = 1.0 / (np.cosh(COLE_EXPONENT * away) + np.cos(np.pi * COLE_EXPONENT))
    weights: Floats = BETA.sum() * density / density.sum()
    return weights


@dataclass(frozen=True, slots=True)
class _Law:
    unloading_ratio: float = 1.0
    amplitude_per_kpa: float = 0.0
    overstress_per_kpa: float = 0.0
    time_shift: bool = False
    plays: bool = False
    softens: bool = False
    tau_s: Floats = field(default_factory=lambda: TAU_S)
    beta: Floats = field(default_factory=lambda: BETA)


_LAWS: dict[str, _Law] = {
    "L": _Law(),
    "A": _Law(unloading_ratio=2.5, amplitude_per_kpa=0.0015, overstress_per_kpa=0.01),
    "H": _Law(2.5, 0.0015, 0.01, plays=True),
    "S": _Law(time_shift=True),
    "F": _Law(amplitude_per_kpa=0.0015, tau_s=COLE_TAUS_S, beta=_cole_cole()),
    "M": _Law(softens=True),
}


class _States(NamedTuple):
    """What k taxels remember: modes [k, modes], plays [k, 3], highest compression [k].

    The last two are empty in a law that has no use for them.
    """

    modes: Floats
    plays: Floats
    peak_kpa: Floats


class FoamTruth:
    """One of the truths under each of n taxels.

    `elastic_kpa` C is what the strain alone would give, the true pressure is P = C - relaxation.
    Drive it by C, by P, or by a robot that holds its position through a spring. Every `step`
    takes C to run straight from its last value to the new one. `taxels` picks some of the n
    (int[k], no repeats); time stands still for the others.

    Args:
        kind: one of `TruthKind`.
        n: number of taxels.
        rng: if given, losses vary from taxel to taxel.
        loss: of this foam, as a multiple of 28 %.
        spread: by how much losses vary if drawn, log-normal.
        speed: of all that takes time, as a multiple: foam at another temperature.

    Attributes:
        elastic_kpa, pressure_kpa, relaxation_kpa: float64[n], after the last step.
    """

    def __init__(
        self,
        kind: TruthKind,
        n: int,
        rng: np.random.Generator | None = None,
        *,
        loss: float = 1.0,
        spread: float = STRENGTH_SD,
        speed: float = 1.0,
    ) -> None:
        self._law = _LAWS[kind]
        self._speed = speed
        self.elastic_kpa = np.zeros(n)
        self.pressure_kpa = np.zeros(n)
        self.relaxation_kpa = np.zeros(n)
        self._strength = np.full(n, loss)
        if rng is not None:
            self._strength *= np.exp(spread * rng.standard_normal(n))
        self._modes = np.zeros((n, len(self._law.tau_s)))
        self._plays = np.tile(-PLAY_KPA, (n, 1))
        self._peak_kpa = np.zeros(n)

    def __len__(self) -> int:
        return len(self.elastic_kpa)

    def reset(self, taxels: Ints | slice = slice(None)) -> None:
        """Foam that was never touched."""
        self._modes[taxels] = 0
        self._plays[taxels] = -PLAY_KPA
        for state in (self.elastic_kpa, self.pressure_kpa, self.relaxation_kpa, self._peak_kpa):
            state[taxels] = 0

    def step(
        self, elastic_kpa: ArrayLike, dt_s: float, taxels: Ints | slice = slice(None)
    ) -> Floats:
        """Strain-driven: go to C [k] within `dt_s`; answers the true pressure P [k].

        P may come out negative, for a probe glued to the foam.
        """
        elastic = np.asarray(elastic_kpa, np.float64)
        return self._store(elastic, self._stepped(elastic, dt_s, taxels), taxels)

    def step_pressure(
        self, pressure_kpa: ArrayLike, dt_s: float | Floats, taxels: Ints | slice = slice(None)
    ) -> Floats:
        """Pressure-driven: find the C [k] that leaves P = `pressure_kpa` after `dt_s`.

        With P = 0 it is free foam, and C its residual. `dt_s` may be [k], a time for each.
        """
        pressure = np.asarray(pressure_kpa, np.float64)
        return self._solve(pressure, 0.0, dt_s, taxels)

    def step_held(
        self,
        command_kpa: ArrayLike,
        dt_s: float,
        taxels: Ints | slice = slice(None),
        compliance: float = 0.08,
    ) -> Floats:
        """A robot commands a position and gives way by `compliance` per kPa of true pressure.

        C = command - compliance P; where that would need a pull, the probe has left: P = 0.
        Answers C [k].
        """
        # With P = C - relaxation: C = (command + compliance relaxation) / (1 + compliance).
        command = np.asarray(command_kpa, np.float64)
        return self._solve(command / (1 + compliance), 1 / (1 + compliance), dt_s, taxels)

    def _solve(
        self, offset: Floats, pressed_share: float, dt_s: float | Floats, taxels: Ints | slice
    ) -> Floats:
        """Find C = max(offset + (1 - pressed_share) R, R) with R at the end of the step."""
        relaxation = self.relaxation_kpa[taxels]
        for _ in range(50):
            elastic = np.maximum(offset + (1 - pressed_share) * relaxation, relaxation)
            states = self._stepped(elastic, dt_s, taxels)
            last, relaxation = relaxation, self._relaxation(elastic, states, taxels)
            if np.abs(relaxation - last).max(initial=0.0) < 1e-7:
                break
        self._store(elastic, states, taxels)
        return elastic

    def _stepped(self, elastic: Floats, dt_s: float | Floats, taxels: Ints | slice) -> _States:
        """The states after C went to `elastic`; nothing is stored."""
        law = self._law
        modes = self._modes[taxels]
        dt_s = dt_s * self._speed
        # C in the middle of a straight line stands for the line: exact to second order.
        middle = 0.5 * (self.elastic_kpa[taxels] + elastic)[:, None]
        away = middle - modes
        rate = (dt_s[:, None] if isinstance(dt_s, np.ndarray) else dt_s) / law.tau_s
        if law.time_shift:
            rate = rate * np.exp((np.minimum(middle, SHIFT_LIMIT_KPA) - 30.0) / 40.0)
        if law.unloading_ratio != 1.0:
            rate = np.where(away < 0, rate / law.unloading_ratio, rate)
        if law.overstress_per_kpa:
            rate = rate * (1 + law.overstress_per_kpa * np.abs(away))
        modes = modes - np.expm1(-rate) * away
        plays = peak = _NONE
        if law.plays:
            low, high = elastic[:, None] - PLAY_KPA, elastic[:, None] + PLAY_KPA
            plays = np.clip(self._plays[taxels], low, high)
        if law.softens:
            peak = self._peak_kpa[taxels]
            healed = peak + np.expm1(-dt_s / HEALING_S) * (peak - elastic)
            peak = np.maximum(healed, elastic)
        return _States(modes, plays, peak)

    def _relaxation(self, elastic: Floats, states: _States, taxels: Ints | slice) -> Floats:
        law = self._law
        modes = states.modes
        if law.amplitude_per_kpa:
            modes = modes * (1 + law.amplitude_per_kpa * np.minimum(modes, AMPLITUDE_LIMIT_KPA))
        relaxation: Floats = self._strength[taxels] * (modes @ law.beta)
        if law.plays:
            # 0 while loading, twice the half width while unloading.
            behind = (states.plays - elastic[:, None] + PLAY_KPA).sum(axis=1)
            relaxation += PLAY_SHARE * behind * elastic / (np.abs(elastic) + PLAY_FADE_KPA)
        if law.softens:
            below = (states.peak_kpa - elastic) / SOFTENING_KPA
            relaxation += SOFTENING * np.maximum(elastic, 0.0) * np.tanh(below)
        return relaxation

    def _store(self, elastic: Floats, states: _States, taxels: Ints | slice) -> Floats:
        relaxation = self._relaxation(elastic, states, taxels)
        pressure = elastic - relaxation
        self._modes[taxels] = states.modes
        if self._law.plays:
            self._plays[taxels] = states.plays
        if self._law.softens:
            self._peak_kpa[taxels] = states.peak_kpa
        self.elastic_kpa[taxels] = elastic
        self.relaxation_kpa[taxels] = relaxation
        self.pressure_kpa[taxels] = pressure
        return pressure
