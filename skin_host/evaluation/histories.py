"""Loading histories, and the response of the emulator's foam to them.

The histories are difficult ones for a compensator: the paper's calibration record and its hardest
test, and the daily work of a robot's hand. A position is commanded, given as the pressure C that
the foam would show without relaxation, and reached through the load cell's compliance; the foam's
truth responds with the C it shows and the pressure P it bears.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emulator.probes.viscoelastic import FoamTruth, TruthKind

Floats = NDArray[np.float64]
#: A commanded change takes this long: the robot's fastest move over the foam.
RAMP_S = 0.08
#: The truth is computed in steps of the first length after a change, growing up to the second in a
#: hold.
FINE_S, COARSE_S, GROWTH = 0.04, 1.0, 1.12
SAMPLE_HZ = 25.0
TRUTHS: tuple[TruthKind, ...] = ("F", "M", "H", "S", "A", "L")

Holds = list[tuple[float, float]]


@dataclass(frozen=True)
class PlayedHistory:
    """A history as a truth answers it, sampled at equal distances.

    Attributes:
        dt_s: distance of the samples.
        momentary_kpa: C, what a perfect reading would be converted to, [t] or [t, pads].
        pressure_kpa: P, what a load cell would show, alike.
        resting: whether nothing presses, [t].
    """

    dt_s: float
    momentary_kpa: Floats
    pressure_kpa: Floats
    resting: NDArray[np.bool_]


def calibration_hold(scale: float = 1.0) -> Holds:
    """The paper's Fig. 17: one hour at one depth, then 75 minutes of rest."""
    return [(65.0, 3600.0 * scale), (0.0, 4500.0 * scale)]


def nine_steps(scale: float = 1.0) -> Holds:
    """Nine levels of 2 to 7 minutes, up and down, and a rest."""
    rng = np.random.default_rng(9)
    levels = rng.uniform(10.0, 80.0, 9)
    holds = [(float(level), float(rng.uniform(120.0, 420.0)) * scale) for level in levels]
    return [*holds, (0.0, 300.0 * scale)]


def multistep(scale: float = 1.0) -> Holds:
    """After the paper's Fig. 18, 2.6 h: stairs to three heights, 30 cycles, rests between."""
    holds: Holds = []
    for top in (40.0, 80.0, 110.0):
        holds += [(top * share, 300.0) for share in (0.25, 0.5, 0.75, 1.0, 0.6, 0.2)]
        holds += [(0.0, 420.0)]
    holds += [(level, seconds) for _ in range(30) for level, seconds in ((90.0, 30.0), (0.0, 20.0))]
    holds += [(50.0, 900.0), (0.0, 720.0)]
    return [(level, seconds * scale) for level, seconds in holds]


def grasps(scale: float = 1.0) -> Holds:
    """Grasps of 2 to 20 s with pauses of 1 to 15 s (220 of them)."""
    rng = np.random.default_rng(220)
    holds: Holds = []
    for _ in range(max(int(220 * scale), 10)):
        holds.append((float(rng.uniform(10.0, 60.0)), float(rng.uniform(2.0, 20.0))))
        holds.append((0.0, float(rng.uniform(1.0, 15.0))))
    return holds


def cycling(scale: float = 1.0) -> Holds:
    """Cycles of 5 s to 50 kPa (360 of them)."""
    return [(50.0, 2.5), (0.0, 2.5)] * max(int(360 * scale), 10)


def walk(scale: float = 1.0) -> Holds:
    """A random walk of 40 minutes, a new level every second."""
    rng = np.random.default_rng(40)
    level, holds = 30.0, []
    for _ in range(int(2400 * scale)):
        level = float(np.clip(level + rng.normal(0.0, 6.0), 0.0, 110.0))
        holds.append((level, 1.0))
    return holds


HISTORIES: dict[str, Callable[[float], Holds]] = {
    "hold": calibration_hold,
    "nine_steps": nine_steps,
    "multistep": multistep,
    "grasps": grasps,
    "cycling": cycling,
    "walk": walk,
}


def record(kind: TruthKind, holds: Holds, sample_hz: float = SAMPLE_HZ) -> PlayedHistory:
    """Play a history to the truth `kind` under one pad; arrays are [t]."""
    played = play(FoamTruth(kind, 1), holds, sample_hz)
    momentary, pressure = played.momentary_kpa[:, 0], played.pressure_kpa[:, 0]
    return replace(played, momentary_kpa=momentary, pressure_kpa=pressure)


def play(truth: FoamTruth, holds: Holds, sample_hz: float = SAMPLE_HZ) -> PlayedHistory:
    """Play a history to foam that was never touched; arrays are [t, pads]."""
    now_s, level = 0.0, 0.0
    times, momentary, pressure = [0.0], [truth.elastic_kpa.copy()], [truth.pressure_kpa.copy()]

    def go(command: float, dt_s: float) -> None:
        nonlocal now_s
        now_s += dt_s
        truth.step_held(np.full(len(truth), command), dt_s)
        times.append(now_s)
        momentary.append(truth.elastic_kpa.copy())
        pressure.append(truth.pressure_kpa.copy())

    for target, seconds in holds:
        end_s = now_s + seconds
        ramp_s = min(RAMP_S, seconds / 2)
        go(0.5 * (level + target), ramp_s / 2)
        go(target, ramp_s / 2)
        step_s = FINE_S
        while end_s - now_s > 1e-9:
            go(target, min(step_s, end_s - now_s))
            step_s = min(step_s * GROWTH, COARSE_S)
        level = target
    dt_s = 1.0 / sample_hz
    sampled_s = np.arange(dt_s, now_s, dt_s)
    ends_s = np.cumsum([seconds for _, seconds in holds])
    pressed = np.array([level > 0.0 for level, _ in holds])
    phase = np.minimum(np.searchsorted(ends_s, sampled_s), len(holds) - 1)
    return PlayedHistory(
        dt_s,
        _sampled(sampled_s, times, momentary),
        np.maximum(_sampled(sampled_s, times, pressure), 0.0),
        ~pressed[phase],
    )


def _sampled(at_s: Floats, times: list[float], values: list[Floats]) -> Floats:
    columns = np.array(values).T
    return np.stack([np.interp(at_s, times, column) for column in columns], axis=1)
