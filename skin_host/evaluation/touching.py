"""Touch and drift in numbers: false touches, delays, lags, long holds, and former errors."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.probes.viscoelastic import FoamTruth, TruthKind
from skin_host.evaluation.accuracy import DEFAULT, UNIT_FF, relaxation_table
from skin_host.evaluation.goals import goal
from skin_host.evaluation.histories import Holds, play, record
from skin_host.evaluation.rig import Rig
from skin_host.processing.pressure import PressureCurve

Row = dict[str, Any]

NOISES = (0.2, 0.4, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0)
HEIGHTS = (2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0, 12.0, 20.0)
RATES = (0.001, 0.004, 0.01, 0.03, 0.05, 0.09, 0.11)
HOLD_KPA = 65.0
HZ = 25.0
NOISE_UNITS = 0.4
#: Half of a triangle is pressed, as by a finger; everything else is untouched.
PRESSED = 6
LONGEST_CASE = "8 h, 0.001 units/s"
#: A skin of 10 boards: enough taxels for rare events, as many as a robot has.
BOARDS = 10


def false_touches(
    hours: float,
    votes: tuple[int, ...] = (1, 2, 3),
    noises: tuple[float | None, ...] = NOISES,
    boards: int = BOARDS,
    hz: float = 25.0,
) -> list[Row]:
    """False touches of untouched skin per taxel-hour, against noise and votes.

    Args:
        hours: simulated.
        votes: of three samples.
        noises: in units; None is noise as it was measured on real skin.
        boards: of 192 taxels each.
        hz: sweeps a second.
    """
    rows = []
    for noise in noises:
        for needed in votes:
            table = {"touch": {"votes_of_3": needed}}
            rig = Rig(boards, noise, seed=3, hz=hz, processing=table)
            before = np.zeros(rig.n, dtype=np.bool_)
            begun = samples = 0
            for _ in range(round(hours * 3600.0 / rig.dt_s)):
                touched = rig.step(0.0).touched
                if touched.any():
                    samples += int(np.count_nonzero(touched))
                    begun += int(np.count_nonzero(touched & ~before))
                before = touched
            taxel_hours = hours * rig.n
            rows.append(
                {
                    "noise_units": noise,
                    "hz": hz,
                    "votes": needed,
                    "taxel_hours": taxel_hours,
                    "usable_share": float(np.mean(rig.calibration.usable)),
                    "touches_per_taxel_hour": begun / taxel_hours,
                    "samples_per_taxel_hour": samples / taxel_hours,
                }
            )
    return rows


def detection_delays(noise_units: float = 0.4, hz: float = 25.0, boards: int = BOARDS) -> list[Row]:
    """Time until a sudden press of this many units is reported, one taxel in four pressed."""
    rows = []
    for height in HEIGHTS:
        rig = Rig(boards, noise_units, seed=5, hz=hz)
        for _ in range(round(2.0 * hz)):
            rig.step(0.0)
        pressed = np.arange(rig.n) % 4 == 0
        activation = np.where(pressed, height, 0.0)
        sweeps = round(2.0 * hz)
        first = np.full(rig.n, np.inf)
        for sweep in range(1, sweeps + 1):
            touched = rig.step(activation).touched
            first = np.where(touched & np.isinf(first), sweep, first)
        seen = first[pressed]
        told = np.isfinite(seen)
        rows.append(
            {
                "height_units": height,
                "height_kpa": float(PressureCurve(2.88).kpa(height)[0]),
                "noise_units": noise_units,
                "hz": hz,
                "told_within_2_s": float(np.mean(told)),
                "median_sweeps": float(np.median(seen[told])) if told.any() else None,
                "p95_sweeps": _inverted_percentile(seen[told], 0.95) if told.any() else None,
            }
        )
    return rows


def drift_lags(minutes: float, rule: str) -> list[Row]:
    """How far baselines lag behind a steady drift of all taxels, by rate."""
    rows = []
    for rate in RATES:
        rig = Rig(1, 0.4, seed=7, processing={"drift": {"rule": rule, "limit_units": 1000.0}})
        touched = 0
        # Never so far that the byte runs out of its scale.
        seconds = min(60.0 * minutes, 150.0 / rate)
        sweeps = round(seconds / rig.dt_s)
        for sweep in range(sweeps):
            drifted = rate * sweep * rig.dt_s
            touched += int(np.count_nonzero(rig.step(drifted).touched))
        lag = rig.true_baseline + drifted - rig.pipeline.baseline
        rows.append(
            {
                "rule": rule,
                "rate_units_per_s": rate,
                "seconds": seconds,
                "lag_units": float(np.mean(lag)),
                "touched_share": touched / (sweeps * rig.n),
            }
        )
    return rows


def hold_cases(quick: bool) -> list[tuple[TruthKind, str, float, float, float, bool]]:
    """The long holds that are asked for, as arguments of `long_hold`; the longest first."""
    kinds: tuple[TruthKind, ...] = ("F",) if quick else ("F", "M", "H")
    cases: list[tuple[str, float, float, float]] = [
        ("10 min, 0.004 units/s", 600.0, 0.004, 10.0 if quick else 25.0)
    ]
    if not quick:
        cases = [
            ("8 h, no drift", 28800.0, 0.0, 5.0),
            (LONGEST_CASE, 28800.0, 0.001, 5.0),
            ("10 min, no drift", 600.0, 0.0, 25.0),
            ("10 min, 0.001 units/s", 600.0, 0.001, 25.0),
            *cases,
        ]
    return [(kind, *case, alone) for kind in kinds for case in cases for alone in (False, True)]


def long_hold(
    kind: TruthKind, name: str, hold_s: float, rate: float, hz: float, alone: bool
) -> Row:
    """What is reported during and after a long press at 65 kPa, while everything drifts.

    Args:
        kind: the truth; the default model is fitted to its calibration hold.
        name: of the case.
        hold_s: length of the press.
        rate: drift in units per s.
        hz: sweeps a second.
        alone: whether all taxels are pressed, so that no untouched one shows the drift.
    """
    rest_s = 900.0
    relaxation = relaxation_table(DEFAULT, kind, fitted=True)
    holds: Holds = [(0.0, 30.0), (HOLD_KPA, hold_s), (0.0, rest_s)]
    played = record(kind, holds, hz)
    rig = Rig(1, 0.4, seed=11, hz=hz, processing={"relaxation": relaxation})
    pressed = np.arange(rig.n) < (rig.n if alone else 6)
    units = PressureCurve(2.88).units(played.momentary_kpa)
    release = round((30.0 + hold_s) * hz)
    pressed_at = round(30.0 * hz)
    held = ghosts = 0
    last_ghost_s = 0.0
    error: list[NDArray[np.float64]] = []
    rest_error: list[NDArray[np.float64]] = []
    for sweep, (height, true_kpa) in enumerate(zip(units, played.pressure_kpa, strict=True)):
        frame = rig.step(np.where(pressed, height, 0.0) + rate * sweep / hz)
        if pressed_at + 2 * hz <= sweep < release:
            held += int(np.count_nonzero(frame.touched[pressed]))
            error.append(frame.pressure_kpa[pressed] - true_kpa)
        elif sweep >= release + 3:  # two samples of three need this long to end it
            rest_error.append(frame.pressure_kpa[pressed].astype(np.float64))
            still = int(np.count_nonzero(frame.touched[pressed]))
            ghosts += still
            if still and sweep < release + 60.0 * hz:
                last_ghost_s = (sweep - release) / hz
    n = int(np.count_nonzero(pressed))
    return {
        "truth": kind,
        "case": name,
        "hold_s": hold_s,
        "drift_units_per_s": rate,
        "all_pressed": alone,
        "touched_share_in_hold": held / (len(error) * n),
        "rms_in_hold_kpa": float(np.sqrt(np.mean(np.square(error)))),
        "end_of_hold_error_kpa": float(np.mean(error[-round(10 * hz) :])),
        "ghost_s_per_taxel": ghosts / n / hz,
        "last_ghost_s": last_ghost_s,
        "rest_rms_kpa": float(np.sqrt(np.mean(np.square(rest_error)))),
    }


def _inverted_percentile(values: NDArray[np.float64], share: float) -> float:
    return float(np.quantile(values, share, method="inverted_cdf"))


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


def hard_cases(quick: bool) -> list[tuple[Callable[..., list[Row]], float]]:
    """Former errors, each a function above with its argument: through the shipped pipeline."""
    return [
        (renewal, 300.0 if quick else 1800.0),
        (silence, 120.0),
        *([] if quick else [(silence, 3600.0)]),
        (negative, 60.0 if quick else 600.0),
        (fast_drift, 0.2),
        (absorbed_load, 0.05),
    ]
