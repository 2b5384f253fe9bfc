"""Speed against error, part one: the error of every relaxation model on every truth.

Each model is fitted to the calibration hold of a truth, and to nothing else, as a user
would fit it to one recording; then it meets all histories of that truth, once with exact
readings and several times with noise, whole units and a baseline of its own.
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.viscoelastic import FoamTruth, TruthKind
from skin_host.evaluation.histories import HISTORIES, Record, calibration_hold, record
from skin_host.processing.fitting import Fit, HoldRecord, fit, merge
from skin_host.processing.pressure import PressureCurve
from skin_host.processing.relaxation import MODELS, ParameterSet, make_model, stand_in

Floats = NDArray[np.float64]
Row = dict[str, Any]

UNIT_FF = 2.88
NOISE_UNITS = 0.4
#: A cycle holds and rests 5 s each; the truth takes them in growing steps.
CYCLE_KPA = 50.0
CYCLE_STEPS_S = (0.3, 1.4, 3.3)
#: Untouched samples from which a baseline is known, as in 5 s at 25 Hz.
BASELINE_SAMPLES = 125


@dataclass(frozen=True)
class Variant:
    """One row of the table: a model, how often its states are updated, its numbers' type."""

    model: str
    update_s: float
    dtype: str = "float64"


VARIANTS = (
    Variant("none", 0.0),
    Variant("published", 0.0),
    Variant("published", 1.0),
    Variant("published_bleed", 1.0),
    Variant("prony", 0.0),
    Variant("prony", 1.0),
    Variant("asymmetric", 0.0),
    Variant("asymmetric", 1.0),
    Variant("asymmetric_log", 0.0),
    Variant("asymmetric_log", 1.0),
    Variant("asymmetric_clock", 0.0),
    Variant("asymmetric_clock", 1.0),
    Variant("asymmetric_clock", 1.0, "float32"),
)


@dataclass(frozen=True)
class Plan:
    """How much is worked out: shares of the histories' length, and copies with noise."""

    truths: tuple[TruthKind, ...] = ("A", "S", "L", "H")
    scale: float = 1.0
    sample_hz: float = 25.0
    copies: int = 4


def score(plan: Plan) -> tuple[list[Row], list[Row]]:
    """Return the rows of errors, and one row per fit, of all truths in the plan."""
    rows: list[Row] = []
    fits: list[Row] = []
    # A fresh process per truth: the parent may run threads, which a fork would not survive.
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        for some_rows, some_fits in pool.map(_score_truth, plan.truths, [plan] * len(plan.truths)):
            rows += some_rows
            fits += some_fits
    return rows, fits


def cycles(plan: Plan, last: int, names: tuple[str, ...]) -> list[Row]:
    """Errors at the end of a press after 1, 10, ... `last` cycles of 5 s at 50 kPa, 5 s free."""
    kinds = plan.truths[:2]
    jobs = ([last] * len(kinds), [names] * len(kinds))
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        return [row for rows in pool.map(_cycle, kinds, *jobs) for row in rows]


def fitted_hold(kind: TruthKind, sample_hz: float = 25.0) -> HoldRecord:
    """The calibration record of a truth, ready to be fitted."""
    held = record(kind, calibration_hold(), sample_hz)
    release = round(calibration_hold()[0][1] * sample_hz)
    return merge(held.dt_s, held.momentary_kpa, held.pressure_kpa, 0, release)


def _score_truth(kind: TruthKind, plan: Plan) -> tuple[list[Row], list[Row]]:
    hold = fitted_hold(kind)
    fits = {model: fit(model, hold) for model in MODELS if model not in ("none", "published_bleed")}
    # The bleed has no parameter of its own.
    fits["published_bleed"] = replace(fits["published"], model="published_bleed")
    records = {
        name: record(kind, make(plan.scale), plan.sample_hz) for name, make in HISTORIES.items()
    }
    series = _Series(records, plan.copies, seed=ord(kind))
    rows = series.rows("perfect", 0.0, "float64", kind, series.true_relaxation())
    for variant in VARIANTS:
        parameters = (
            stand_in("none", "mid") if variant.model == "none" else fits[variant.model].parameters
        )
        relaxation = series.relaxation(variant, parameters)
        rows += series.rows(variant.model, variant.update_s, variant.dtype, kind, relaxation)
    return rows, [_fit_row(kind, found) for found in fits.values()]


def _cycle(kind: TruthKind, last: int, names: tuple[str, ...]) -> list[Row]:
    hold = fitted_hold(kind)
    truth = FoamTruth(kind, 1)
    models = {name: make_model(name, 1, fit(name, hold).parameters) for name in names}
    marks = [10**power for power in range(int(np.log10(last)) + 1)]
    rows: list[Row] = []
    for cycle in range(1, last + 1):
        for dt_s in CYCLE_STEPS_S:
            true_kpa = max(float(truth.step(np.array([CYCLE_KPA]), dt_s)[0]), 0.0)
        pressed = {name: model.step(np.array([CYCLE_KPA]), 5.0) for name, model in models.items()}
        if cycle in marks:
            rows += [
                {
                    "model": name,
                    "truth": kind,
                    "cycles": cycle,
                    "relaxation_kpa": float(relaxation[0]),
                    "error_kpa": max(CYCLE_KPA - float(relaxation[0]), 0.0) - true_kpa,
                    "unclamped_error_kpa": CYCLE_KPA - float(relaxation[0]) - true_kpa,
                }
                for name, relaxation in pressed.items()
            ]
        for dt_s in CYCLE_STEPS_S:
            truth.step(np.zeros(1), dt_s)
        for model in models.values():
            model.step(np.zeros(1), 5.0)
    return rows


class _Series:
    """All histories side by side, one column each with exact readings and some with noise."""

    def __init__(self, records: dict[str, Record], copies: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._records = records
        self._copies = copies
        self._dt_s = next(iter(records.values())).dt_s
        columns = []
        longest = max(len(one.momentary_kpa) for one in records.values())
        for one in records.values():
            exact = one.momentary_kpa
            readings = [exact] + [_as_read(exact, rng) for _ in range(copies)]
            # A shorter history goes on resting until the longest has ended.
            columns += [np.pad(each, (0, longest - len(exact))) for each in readings]
        self._momentary = np.ascontiguousarray(np.array(columns).T)

    def relaxation(self, variant: Variant, parameters: ParameterSet) -> Floats:
        model = make_model(
            variant.model,
            self._momentary.shape[1],
            parameters,
            update_s=variant.update_s,
            dtype=variant.dtype,
        )
        result = np.empty(self._momentary.shape, dtype=variant.dtype)
        momentary = self._momentary.astype(variant.dtype)
        for sample, answer in zip(momentary, result, strict=True):
            model.step(sample, self._dt_s, answer)
        return result.astype(np.float64)

    def true_relaxation(self) -> Floats:
        """What a perfect model would take off: with noise, what is left is the reading's floor."""
        result = np.zeros_like(self._momentary)
        for number, one in enumerate(self._records.values()):
            lost = one.momentary_kpa - one.pressure_kpa
            for copy in range(self._copies + 1):
                result[: len(lost), number * (self._copies + 1) + copy] = lost
        return result

    def rows(
        self, model: str, update_s: float, dtype: str, truth: str, relaxation: Floats
    ) -> list[Row]:
        rows = []
        for number, (name, one) in enumerate(self._records.items()):
            samples = len(one.pressure_kpa)
            first = number * (self._copies + 1)
            for noise, columns in (
                (0.0, slice(first, first + 1)),
                (NOISE_UNITS, slice(first + 1, first + 1 + self._copies)),
            ):
                corrected = self._momentary[:samples, columns] - relaxation[:samples, columns]
                error = np.maximum(corrected, 0.0) - one.pressure_kpa[:, np.newaxis]
                resting = error[one.resting]
                rows.append(
                    {
                        "model": model,
                        "update_s": update_s,
                        "dtype": dtype,
                        "truth": truth,
                        "history": name,
                        "noise_units": noise,
                        "rms_kpa": _rms(error),
                        "worst_kpa": float(np.max(np.abs(error))),
                        "rest_rms_kpa": _rms(resting) if resting.size else None,
                    }
                )
        return rows


def _as_read(momentary_kpa: Floats, rng: np.random.Generator) -> Floats:
    """What comes of a pressure through a pad, noise, an 8-bit reading and a calibration."""
    curve = PressureCurve(UNIT_FF)
    start = float(rng.uniform(0.0, 1.0))
    untouched = np.rint(start + rng.normal(0.0, NOISE_UNITS, BASELINE_SAMPLES))
    noise = rng.normal(0.0, NOISE_UNITS, len(momentary_kpa))
    codes = np.rint(start + curve.units(momentary_kpa) + noise)
    return curve.kpa(codes - untouched.mean())


def _rms(error: Floats) -> float:
    return float(np.sqrt(np.mean(error**2)))


def _fit_row(truth: str, found: Fit) -> Row:
    chosen = found.parameters
    return {
        "truth": truth,
        "model": found.model,
        "rms_hold_kpa": found.rms_hold_kpa,
        "rms_rest_kpa": found.rms_rest_kpa,
        "beta": list(map(float, chosen.beta)),
        "tau_s": list(map(float, chosen.tau_s)),
        "beta_unload": list(map(float, chosen.beta_unload)),
        "tau_unload_s": list(map(float, chosen.tau_unload_s)),
        "clock_kpa": float(chosen.clock_kpa),
        "uncertain": found.uncertain,
    }
