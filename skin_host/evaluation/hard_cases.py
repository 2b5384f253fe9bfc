"""Former errors: each case runs through the shipped pipeline and gives one figure."""

from collections.abc import Callable
from typing import Any

import numpy as np

from emulator.probes.viscoelastic import FoamTruth
from skin_host.evaluation.accuracy import DEFAULT, UNIT_FF, relaxation_table
from skin_host.evaluation.goals import goal
from skin_host.evaluation.histories import play
from skin_host.evaluation.rig import Rig
from skin_host.processing.pressure import PressureCurve

Row = dict[str, Any]

HZ = 25.0
NOISE_UNITS = 0.4
#: Half of a triangle is pressed, as by a finger; everything else is untouched.
PRESSED = 6
HOLD_KPA = 65.0


def _rig(seed: int) -> Rig:
    table = {"relaxation": relaxation_table(DEFAULT, "F", fitted=True)}
    return Rig(1, NOISE_UNITS, seed=seed, hz=HZ, processing=table)


def renewal(hold_s: float) -> list[Row]:
    """A new threshold or a reload during a long press renews the pipeline."""
    rig = _rig(21)
    held = play(FoamTruth("F", 1), [(HOLD_KPA, hold_s), (0.0, 300.0)], HZ)
    units = PressureCurve(UNIT_FF).units(held.momentary_kpa[:, 0])
    pressed = np.arange(rig.n) < PRESSED
    release = round(hold_s * HZ)
    renewed = release - round(10.0 * HZ)
    before, after, ghosts = [], [], 0
    for sweep, height in enumerate(units):
        if sweep == renewed:
            rig.pipeline.renew(rig.settings.processing, rig.calibration, np.zeros(rig.n, np.bool_))
        frame = rig.step(np.where(pressed, height, 0.0))
        mean_kpa = float(np.mean(frame.pressure_kpa[pressed]))
        if renewed - 5 * HZ <= sweep < renewed:
            before.append(mean_kpa)
        elif renewed <= sweep < renewed + 5 * HZ:
            after.append(mean_kpa)
        elif sweep > release + 3:
            ghosts += int(np.count_nonzero(frame.touched[pressed]))
    jump = abs(float(np.mean(after) - np.mean(before)))
    name = f"pipeline renewed after {hold_s / 60:g} min at 65 kPa: "
    return [
        goal(f"{name}jump of the pressure, kPa", jump, 0.5, 0.2),
        goal(f"{name}false contact after the release, s", ghosts / PRESSED / HZ, 3.0, 0.0),
    ]


def silence(gap_s: float) -> list[Row]:
    """Released while the board is silent; 12 kPa when it is back."""
    rig = _rig(22)
    played = play(
        FoamTruth("F", 1), [(0.0, 10.0), (HOLD_KPA, 600.0), (0.0, gap_s), (12.0, 20.0)], HZ
    )
    units = PressureCurve(UNIT_FF).units(played.momentary_kpa[:, 0])
    pressed = np.arange(rig.n) < PRESSED
    gap = round(610.0 * HZ), round((610.0 + gap_s) * HZ)
    error: list[float] = []
    for sweep, (height, true) in enumerate(zip(units, played.pressure_kpa[:, 0], strict=True)):
        if gap[0] <= sweep < gap[1]:
            rig.t_ns += round(1e9 / HZ)
            continue
        frame = rig.step(np.where(pressed, height, 0.0))
        if sweep >= gap[1] + 2 * HZ:
            error.append(float(np.mean(frame.pressure_kpa[pressed])) - float(true))
    figure = f"12 kPa after 10 min at 65 kPa and {gap_s:g} s of silence: error, kPa"
    return [goal(figure, abs(float(np.mean(error))), 2.0, 1.0)]


def negative(seconds: float) -> list[Row]:
    """Readings 30 units below zero, then at zero again."""
    rig = _rig(23)
    low = np.where(np.arange(rig.n) < PRESSED, -30.0, 0.0)
    for _ in range(round(seconds * HZ)):
        rig.step(low)
    touched = sum(
        int(np.count_nonzero(rig.step(0.0).touched[:PRESSED])) for _ in range(round(300.0 * HZ))
    )
    figure = f"{seconds / 60:g} min 30 units below zero: false contact after it, s"
    return [goal(figure, touched / PRESSED / HZ, 3.0, 0.0)]


def fast_drift(rate: float) -> list[Row]:
    """All untouched taxels drift for 40 s, then stay there for ten minutes."""
    rig = _rig(24)
    touched = [0, 0]
    counts = round(40.0 * HZ), round(600.0 * HZ)
    for phase, count in enumerate(counts):
        for sweep in range(count):
            drifted = rate * (sweep / HZ if phase == 0 else 40.0)
            touched[phase] += int(np.count_nonzero(rig.step(drifted).touched))
    shares = [100.0 * n / count / rig.n for n, count in zip(touched, counts, strict=True)]
    name = f"{rate:g} units/s of drift for 40 s, nothing touched: taxel-time falsely touched "
    return [
        goal(f"{name}in it, %", shares[0], 1.0, 0.0),
        goal(f"{name}in the 10 min after it, %", shares[1], 0.1, 0.0),
    ]


def absorbed_load(rate: float) -> list[Row]:
    """A load so slow that it passes for drift is removed: how soon is a tap detected again?"""
    rig = _rig(25)
    pressed = np.arange(rig.n) < PRESSED
    for sweep in range(round(15.0 / rate * HZ)):
        rig.step(np.where(pressed, rate * sweep / HZ, 0.0))
    tap = np.where(pressed, float(PressureCurve(UNIT_FF).units(np.array([22.0]))[0]), 0.0)
    seen_s, limit_s = 3600.0, 3600.0
    for number in range(round(limit_s / 10.0)):
        for _ in range(round(9.0 * HZ)):
            rig.step(0.0)
        hits = [rig.step(tap).touched[:PRESSED].all() for _ in range(round(1.0 * HZ))]
        if any(hits):
            seen_s = 10.0 * (number + 1)
            break
    figure = f"a load of 15 units that came at {rate:g} units/s is gone: taps of 22 kPa unseen for"
    return [goal(f"{figure}, s", seen_s, 60.0, 10.0)]


def cases(quick: bool) -> list[tuple[Callable[..., list[Row]], float]]:
    """Return the functions above with their arguments."""
    return [
        (renewal, 300.0 if quick else 1800.0),
        (silence, 120.0),
        *([] if quick else [(silence, 3600.0)]),
        (negative, 60.0 if quick else 600.0),
        (fast_drift, 0.2),
        (absorbed_load, 0.05),
    ]
