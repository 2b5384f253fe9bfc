"""Speed against error, part one: the error of every relaxation model on every truth.

Each model is fitted to the calibration hold of a truth, and to nothing else, as a user
would fit it to one recording; then it meets all histories of that truth, once with exact
readings and several times with noise, whole units and a baseline of its own.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.viscoelastic import FoamTruth, TruthKind
from skin_host.evaluation.histories import HISTORIES, Record, calibration_hold, record
from skin_host.processing.fitting import Fit, HoldRecord, fit, merge
from skin_host.processing.pressure import PressureCurve
from skin_host.processing.relaxation import ParameterSet, make_model, stand_in
from skin_host.relaxation_settings import FITTED

Floats = NDArray[np.float64]
Row = dict[str, Any]

UNIT_FF = 2.88
NOISE_UNITS = 0.4
#: A cycle holds and rests 5 s each, with moves of 0.3 s; the truth takes them in growing steps.
CYCLE_KPA = 50.0
CYCLE_STEPS_S = (0.3, 1.4, 3.3)
CYCLE_MODEL_STEPS_S = (0.3, 4.7)
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
#: Takes off what the truth has lost.
PERFECT = Variant("perfect", 0.0)


#: What a model and a truth have in common. "law": the truth is a limit of the model's own law,
#: but for the number of modes. "cause": one of the causes of slow unloading is that of the truth,
#: if in another form. "none": no mechanism. No model has the plays of H.
_ASYMMETRIC = {"A": "cause", "S": "none", "L": "law", "H": "cause"}
FAMILY: dict[str, dict[str, str]] = {
    "none": dict.fromkeys("ASLH", "none"),
    "published": _ASYMMETRIC,
    "published_bleed": _ASYMMETRIC,
    "prony": {"A": "none", "S": "none", "L": "law", "H": "none"},
    "asymmetric": _ASYMMETRIC,
    "asymmetric_log": _ASYMMETRIC,
    "asymmetric_clock": _ASYMMETRIC | {"S": "cause"},
}


@dataclass(frozen=True)
class Plan:
    """How much is worked out: shares of the histories' length, and copies with noise."""

    scale: float = 1.0
    sample_hz: float = 25.0
    copies: int = 4


def score(kind: TruthKind, plan: Plan) -> tuple[list[Row], list[Row]]:
    """Return the rows of errors on a truth, and one row per model fitted to it."""
    fits = fits_of(kind)
    records = {
        name: record(kind, make(plan.scale), plan.sample_hz) for name, make in HISTORIES.items()
    }
    series = _Series(records, plan.copies, seed=ord(kind))
    rows = series.rows(PERFECT, kind, series.true_relaxation())
    for variant in VARIANTS:
        relaxation = series.relaxation(variant, _parameters(variant.model, kind))
        rows += series.rows(variant, kind, relaxation)
    return rows, [_fit_row(kind, found) for found in fits.values()]


def cycles(kind: TruthKind, last: int, variants: tuple[Variant, ...]) -> list[Row]:
    """Errors at the end of a press after 1, 10, ... `last` cycles of 5 s at 50 kPa, 5 s free.

    The rows of the model "perfect" tell the relaxation of the truth itself.
    """
    truth = FoamTruth(kind, 1)
    models = {
        variant: make_model(
            variant.model,
            1,
            _parameters(variant.model, kind),
            update_s=variant.update_s,
            dtype=variant.dtype,
        )
        for variant in variants
    }
    marks = {10**power for power in range(int(np.log10(last)) + 1)} | {last}
    pressed, free = np.array([CYCLE_KPA]), np.zeros(1)
    rows: list[Row] = []
    for cycle in range(1, last + 1):
        for dt_s in CYCLE_STEPS_S:
            true_kpa = max(float(truth.step(pressed, dt_s)[0]), 0.0)
        answers = {PERFECT: np.array([CYCLE_KPA - true_kpa])}
        for variant, model in models.items():
            for dt_s in CYCLE_MODEL_STEPS_S:
                answers[variant] = model.step(pressed, dt_s)
        if cycle in marks:
            rows += [_cycle_row(v, kind, cycle, float(a[0]), true_kpa) for v, a in answers.items()]
        for dt_s in CYCLE_STEPS_S:
            truth.step(free, dt_s)
        for model in models.values():
            for dt_s in CYCLE_MODEL_STEPS_S:
                model.step(free, dt_s)
    return rows


@cache
def fitted_hold(kind: TruthKind, sample_hz: float = 25.0) -> HoldRecord:
    """The calibration record of a truth, ready to be fitted."""
    held = record(kind, calibration_hold(), sample_hz)
    release = round(calibration_hold()[0][1] * sample_hz)
    return merge(held.dt_s, held.momentary_kpa, held.pressure_kpa, 0, release)


@cache
def fits_of(kind: TruthKind) -> dict[str, Fit]:
    """Every model with parameters, fitted to the calibration record of a truth."""
    hold = fitted_hold(kind)
    fits = {model: fit(model, hold) for model in FITTED if model != "published_bleed"}
    # The bleed has no parameter of its own.
    return fits | {"published_bleed": replace(fits["published"], model="published_bleed")}


def _parameters(model: str, kind: TruthKind) -> ParameterSet:
    return stand_in("none", "mid") if model == "none" else fits_of(kind)[model].parameters


def _cycle_row(
    variant: Variant, kind: TruthKind, cycle: int, relaxation: float, true_kpa: float
) -> Row:
    return {
        "model": variant.model,
        "update_s": variant.update_s,
        "dtype": variant.dtype,
        "truth": kind,
        "cycles": cycle,
        "relaxation_kpa": relaxation,
        "error_kpa": max(CYCLE_KPA - relaxation, 0.0) - true_kpa,
        "unclamped_error_kpa": CYCLE_KPA - relaxation - true_kpa,
    }


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

    def rows(self, variant: Variant, truth: str, relaxation: Floats) -> list[Row]:
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
                        "model": variant.model,
                        "update_s": variant.update_s,
                        "dtype": variant.dtype,
                        "truth": truth,
                        "in_common": FAMILY.get(variant.model, {}).get(truth),
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
