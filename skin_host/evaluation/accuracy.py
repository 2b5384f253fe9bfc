"""Speed against error, part one: the error of every relaxation model on every truth.

Each model is fitted to the calibration hold of a truth, and to no other record, as a user would
fit it to one recording; then it is tested on all histories of that truth in the pipeline that the
daemon runs: bytes with noise on a separate skin, with one triangle for each history.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.probes.foam import Foam
from emulator.probes.viscoelastic import FoamTruth, TruthKind
from skin_host.bus.wire import TAXELS
from skin_host.config.relaxation import FITTED, MODELS, RelaxationSettings
from skin_host.evaluation.histories import HISTORIES, PlayedHistory, calibration_hold, play, record
from skin_host.evaluation.rig import Rig
from skin_host.processing.fitting.hold import Fit, HoldRecord, fit, merge
from skin_host.processing.pressure import PressureCurve
from skin_host.processing.relaxation import OWN_MEANS, ParameterSet, make_model, stand_in

Floats = NDArray[np.float64]
Row = dict[str, Any]

UNIT_FF = 2.88
NOISE_UNITS = 0.4
#: Of the default on the fitted foam. Thresholds, and so what is taken for drift, differ by draw.
NOISE_DRAWS = 6
#: A cycle holds and rests 5 s each, with moves of 0.3 s; the truth is computed in growing steps.
CYCLE_KPA = 50.0
CYCLE_STEPS_S = (0.3, 1.4, 3.3)
#: The histories that goals and headline name.
JUDGED_HISTORIES = ("nine_steps", "multistep", "grasps", "cycling")


@dataclass(frozen=True)
class Variant:
    """One row of the table: a model, and how often its states are updated."""

    model: str
    update_s: float = 1.0

    @property
    def dtype(self) -> str:
        """The type of its states in the pipeline: steps of a second are enough for float32."""
        return "float32" if self.update_s > 0.0 and self.model not in OWN_MEANS else "float64"


#: Default of the pipeline.
DEFAULT = Variant(RelaxationSettings().model, RelaxationSettings().update_s)
VARIANTS = tuple(
    dict.fromkeys([*(Variant(model) for model in MODELS), Variant(DEFAULT.model, 0.0)])
)
#: Models that are tested on other foam than the fitted one.
ELSEWHERE = (Variant("none"), DEFAULT)
#: Subtracts exactly what the truth has lost.
PERFECT = Variant("perfect", 0.0)
#: The default with its relaxation multiplied by one number for each pad, the best for all histories
#: together: the best possible result with the model's shape.
HINDSIGHT = Variant("hindsight", 0.0)
HINDSIGHT_FACTORS = np.arange(0.3, 2.5, 0.02)


@dataclass(frozen=True)
class Scenario:
    """Difference from the foam that the model was fitted to.

    Attributes:
        name: of it.
        fitted: whether the model was fitted at all; otherwise its default parameters are used.
        speed, loss: of the foam, as multiples of those of the fit.
        loss_spread: by how much the losses of pads differ, log-normal.
        drawn: whether their curves differ, without measured gains.
    """

    name: str
    fitted: bool = True
    speed: float = 1.0
    loss: float = 1.0
    loss_spread: float = 0.0
    drawn: bool = False


#: A rate of 2.8 is about 10 degrees. 28 % of loss is the truths' own.
SCENARIOS = (
    Scenario("fitted"),
    Scenario("temperature", speed=2.8),
    Scenario("spread of losses", loss_spread=0.2),
    Scenario("spread of losses and curves", loss_spread=0.2, drawn=True),
    Scenario("not fitted", fitted=False),
    Scenario("not fitted, 15 % of loss", fitted=False, loss=0.15 / 0.28),
    Scenario("not fitted, 40 % of loss", fitted=False, loss=0.40 / 0.28),
)
FITTED_FOAM = SCENARIOS[0]
#: Pads of a triangle that a history presses; the others are untouched.
PRESSED_PADS = 6

#: What a model and a truth have in common. "law": the truth is a limit of the model's own law,
#: but for the number of modes. "cause": one of the causes of slow unloading is that of the truth,
#: if in another form. "none": no mechanism. No model has a power of time (F), a memory of the
#: highest compression (M) or losses that grow with pressure (A, H, F).
_ASYMMETRIC = {"A": "cause", "S": "none", "L": "law", "H": "cause", "F": "none", "M": "none"}
FAMILY: dict[str, dict[str, str]] = {
    "none": dict.fromkeys("FMHSAL", "none"),
    "published": _ASYMMETRIC,
    "asymmetric": _ASYMMETRIC,
}
#: Truths that no model is kin to: headline, goals and default rest on these.
HELD_OUT: tuple[TruthKind, ...] = ("F", "M")


@dataclass(frozen=True)
class HistoryPlan:
    """How much is worked out: shares of the histories' length, at this rate."""

    scale: float = 1.0
    sample_hz: float = 5.0


def score(kind: TruthKind, scenario: Scenario, plan: HistoryPlan) -> list[Row]:
    """The rows of errors on a truth: all histories of the fitted foam, else those judged."""
    names = tuple(HISTORIES) if scenario == FITTED_FOAM else JUDGED_HISTORIES
    skin = _skin(kind, scenario, plan, names)
    rows = []
    for variant in VARIANTS if scenario == FITTED_FOAM else ELSEWHERE:
        table = relaxation_table(variant, kind, scenario.fitted)
        rows += skin.rows(variant, kind, scenario, table, seed=ord(kind))
    return rows


def noise_draws(kind: TruthKind, plan: HistoryPlan) -> list[Row]:
    """The default's errors of real readings on the fitted foam, for each draw of the noise."""
    skin = _skin(kind, FITTED_FOAM, plan, JUDGED_HISTORIES)
    table = relaxation_table(DEFAULT, kind, FITTED_FOAM.fitted)
    return [
        row | {"draw": draw}
        for draw in range(NOISE_DRAWS)
        for row in skin.rows(DEFAULT, kind, FITTED_FOAM, table, seed=draw)
        if row["noise_units"] > 0.0
    ]


def by_history(rows: list[Row]) -> dict[tuple[str, str], list[float]]:
    """The RMS errors of rows, in kPa, by truth and history."""
    found: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        found.setdefault((row["truth"], row["history"]), []).append(row["rms_kpa"])
    return found


def _skin(
    kind: TruthKind, scenario: Scenario, plan: HistoryPlan, names: tuple[str, ...]
) -> "_Skin":
    """Skin on which all the named histories are played."""
    pads = PRESSED_PADS if scenario.loss_spread else 1

    def foam() -> FoamTruth:
        drawn = np.random.default_rng(ord(kind)) if scenario.loss_spread else None
        return FoamTruth(
            kind,
            pads,
            drawn,
            loss=scenario.loss,
            spread=scenario.loss_spread,
            speed=scenario.speed,
        )

    holds = {name: HISTORIES[name](plan.scale) for name in names}
    records = {name: play(foam(), held, plan.sample_hz) for name, held in holds.items()}
    typical = records
    if scenario.loss_spread:
        typical = {
            name: play(FoamTruth(kind, 1), held, plan.sample_hz) for name, held in holds.items()
        }
    layer = Foam.uniform(PRESSED_PADS)
    if scenario.drawn:
        layer = Foam.drawn(PRESSED_PADS, np.random.default_rng(ord(kind) + 1))
    return _Skin(records, typical, layer, plan.sample_hz)


def relaxation_table(variant: Variant, kind: TruthKind, fitted: bool) -> dict[str, Any]:
    """The configuration table `processing.relaxation` of a variant, fitted to a truth or not."""
    table: dict[str, Any] = {"model": variant.model, "update_s": variant.update_s}
    if not fitted or variant.model == "none":
        return table
    found = fits_of(kind)[variant.model].parameters
    return table | {
        "beta": list(found.beta),
        "tau_s": list(found.tau_s),
        "beta_unload": list(found.beta_unload),
        "tau_unload_s": list(found.tau_unload_s),
    }


def cycles(kind: TruthKind, last: int, models: tuple[str, ...]) -> list[Row]:
    """Errors at the end of a press after 1, 10, ... `last` cycles of 5 s at 50 kPa, 5 s free.

    Of the models' laws alone, at every step. The rows of the model "perfect" report the
    relaxation of the truth itself.
    """
    truth = FoamTruth(kind, 1)
    made = {model: make_model(model, 1, _parameters(model, kind)) for model in models}
    marks = {10**power for power in range(int(np.log10(last)) + 1)} | {last}
    pressed, free = np.array([CYCLE_KPA]), np.zeros(1)
    rows: list[Row] = []
    for cycle in range(1, last + 1):
        for dt_s in CYCLE_STEPS_S:
            true_kpa = max(float(truth.step(pressed, dt_s)[0]), 0.0)
        answers = {PERFECT.model: np.array([CYCLE_KPA - true_kpa])}
        for name, model in made.items():
            for dt_s in CYCLE_STEPS_S:
                answers[name] = model.step(pressed, dt_s)
        if cycle in marks:
            rows += [_cycle_row(m, kind, cycle, float(a[0]), true_kpa) for m, a in answers.items()]
        for dt_s in CYCLE_STEPS_S:
            truth.step(free, dt_s)
        for model in made.values():
            for dt_s in CYCLE_STEPS_S:
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
    return {model: fit(model, hold) for model in FITTED}


def fit_rows(kind: TruthKind) -> list[Row]:
    """One row for each model fitted to a truth."""
    return [_fit_row(kind, found) for found in fits_of(kind).values()]


def _parameters(model: str, kind: TruthKind) -> ParameterSet:
    return stand_in("none", "mid") if model == "none" else fits_of(kind)[model].parameters


def _cycle_row(model: str, kind: TruthKind, cycle: int, relaxation: float, true_kpa: float) -> Row:
    return {
        "model": model,
        "truth": kind,
        "cycles": cycle,
        "relaxation_kpa": relaxation,
        "error_kpa": max(CYCLE_KPA - relaxation, 0.0) - true_kpa,
        "unclamped_error_kpa": CYCLE_KPA - relaxation - true_kpa,
    }


class _Skin:
    """All histories at once on one part of skin: each presses half the pads of its triangle."""

    def __init__(
        self,
        records: dict[str, PlayedHistory],
        typical: dict[str, PlayedHistory],
        foam: Foam,
        hz: float,
    ) -> None:
        self._records = records
        self._typical = typical
        self._hz = hz
        curve = PressureCurve(UNIT_FF)
        longest = max(len(one.resting) for one in records.values())
        self._taxels = np.concatenate(
            [TAXELS * number + np.arange(PRESSED_PADS) for number in range(len(records))]
        )
        # A shorter history goes on resting until the longest has ended.
        columns = []
        for one in records.values():
            units = curve.units(one.momentary_kpa) * _softness(foam, one.momentary_kpa)
            columns.append(np.pad(units, ((0, longest - len(units)), (0, 0))))
        self._units = np.concatenate(columns, axis=1)
        self._exact_kpa = curve.kpa(self._units)

    def rows(
        self,
        variant: Variant,
        kind: TruthKind,
        scenario: Scenario,
        table: dict[str, Any],
        seed: int,
    ) -> list[Row]:
        """Run the pipeline with a model, and set its pressures against the truth's."""
        rig = Rig(1, NOISE_UNITS, seed=seed, hz=self._hz, processing={"relaxation": table})
        relaxation = np.empty(self._units.shape, np.float32)
        reported = np.empty(self._units.shape, np.float32)
        read = np.empty(self._units.shape, np.float64)
        zero = (rig.layout.no_load - rig.calibration.baseline)[self._taxels]
        activation = np.zeros(rig.n)
        held = variant.dtype == "float32"
        for sweep, units in enumerate(self._units):
            activation[self._taxels] = units
            if held:
                relaxation[sweep] = rig.pipeline.relaxation_kpa[self._taxels]
            frame = rig.step(activation)
            reported[sweep] = frame.pressure_kpa[self._taxels]
            if variant.model == "none":
                read[sweep] = zero - frame.raw[self._taxels]
            if not held:
                relaxation[sweep] = rig.pipeline.relaxation_kpa[self._taxels]
        rows = self._hindsight(relaxation, kind, scenario) if variant == DEFAULT else []
        for number, (name, one) in enumerate(self._records.items()):
            t = len(one.resting)
            mine = slice(number * PRESSED_PADS, (number + 1) * PRESSED_PADS)
            true = one.pressure_kpa
            exact = np.maximum(self._exact_kpa[:t, mine] - relaxation[:t, mine], 0.0) - true
            errors = {0.0: exact, NOISE_UNITS: reported[:t, mine] - true}
            if variant.model == "none":
                # What a perfect model of the typical foam would leave.
                typical = self._typical[name]
                lost = typical.momentary_kpa - typical.pressure_kpa
                read_kpa = PressureCurve(UNIT_FF).kpa(read[:t, mine])
                floor = {
                    0.0: np.maximum(self._exact_kpa[:t, mine] - lost, 0.0) - true,
                    NOISE_UNITS: np.maximum(read_kpa - lost, 0.0) - true,
                }
                rows += [
                    _row(PERFECT, kind, scenario, name, noise, error, one.resting)
                    for noise, error in floor.items()
                ]
            rows += [
                _row(variant, kind, scenario, name, noise, error, one.resting)
                for noise, error in errors.items()
            ]
        return rows

    def _hindsight(
        self, relaxation: NDArray[np.float32], kind: TruthKind, scenario: Scenario
    ) -> list[Row]:
        """Rows of exact readings with the best factor of each pad."""
        judged = [
            (number, name, one)
            for number, (name, one) in enumerate(self._records.items())
            if name in JUDGED_HISTORIES
        ]

        def error(number: int, one: PlayedHistory, factor: Floats | float) -> Floats:
            t, mine = len(one.resting), slice(number * PRESSED_PADS, (number + 1) * PRESSED_PADS)
            left = self._exact_kpa[:t, mine] - factor * relaxation[:t, mine]
            return np.maximum(left, 0.0) - one.pressure_kpa

        square = np.array(
            [
                np.sum([np.mean(error(number, one, f) ** 2, 0) for number, _, one in judged], 0)
                for f in HINDSIGHT_FACTORS
            ]
        )
        best = HINDSIGHT_FACTORS[np.argmin(square, axis=0)]
        return [
            _row(HINDSIGHT, kind, scenario, name, 0.0, error(number, one, best), one.resting)
            for number, name, one in judged
        ]


def _softness(foam: Foam, elastic_kpa: Floats) -> Floats:
    """Capacitance [t, pads] that pressures [t, 1 or pads] make, over the common foam's."""
    steps_kpa = np.linspace(0.5, 1.1 * float(elastic_kpa.max()) + 1.0, 200)
    typical = _rise(Foam.uniform(1), steps_kpa)
    rises = [_rise(foam.take(np.array([pad])), steps_kpa) / typical for pad in range(len(foam))]
    pressures = np.broadcast_to(elastic_kpa, (len(elastic_kpa), len(foam))).T
    return np.stack(
        [np.interp(one, steps_kpa, rise) for one, rise in zip(pressures, rises, strict=True)],
        axis=1,
    )


def _rise(foam: Foam, pressures_kpa: Floats) -> Floats:
    strains = np.concatenate([foam.strain(np.array([pressure])) for pressure in pressures_kpa])
    rise: Floats = strains / (1.0 - strains)
    return rise


def _row(
    variant: Variant,
    kind: TruthKind,
    scenario: Scenario,
    history: str,
    noise: float,
    error: Floats,
    resting: NDArray[np.bool_],
) -> Row:
    return {
        "model": variant.model,
        "update_s": variant.update_s,
        "truth": kind,
        "scenario": scenario.name,
        "in_common": FAMILY.get(variant.model, {}).get(kind),
        "history": history,
        "noise_units": noise,
        "rms_kpa": _rms(error),
        "worst_kpa": float(np.max(np.abs(error))),
        "rest_rms_kpa": _rms(error[resting]) if resting.any() else None,
    }


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
        "uncertain": found.uncertain,
    }
