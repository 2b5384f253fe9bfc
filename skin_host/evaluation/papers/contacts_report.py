"""`skin report --contacts`: localisation, intrinsic sensing, fusion and slip, measured.

Plain rows of numbers; `contacts_page` makes tables and pictures of them.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from skin_host.evaluation.localization_trials import (
    METHODS as SKIN_METHODS,
)
from skin_host.evaluation.localization_trials import (
    Case,
    errors,
    localizer_for,
    separation,
)
from skin_host.evaluation.papers import contacts_page
from skin_host.evaluation.papers.design import PlanarStructure
from skin_host.evaluation.papers.fingertip_trials import (
    METHODS,
    SINGLE_METHODS,
    intrinsic_errors,
    rms,
    task_errors,
)
from skin_host.evaluation.papers.slip_trials import DETECTORS, false_alarms_per_hour, slip_trials
from skin_host.fingertip.intrinsic import PUBLISHED_FRICTION_FACTOR, sphere_error_bound

Row = dict[str, Any]
Report = dict[str, list[Row]]

SCHEMA = "skin.contacts/1"

#: What the pictures show of localisation: (title, varied key, cases).
_SWEEPS: dict[str, list[Case]] = {
    "probe": [Case(size) for size in (3.0, 4.0, 6.0, 8.0, 10.0, 12.0)],
    "force": [Case(10.0, units=units) for units in (6.0, 12.0, 25.0, 57.0, 100.0)],
    "noise": [Case(10.0, noise_units=noise) for noise in (0.2, 0.4, 0.8, 1.6, 3.0)],
    "foam": [Case(size, membrane_mm=0.25) for size in (6.0, 10.0)],
}


@dataclass(frozen=True, slots=True)
class Plan:
    """How much is measured: presses, samples, fingertips, seconds of a task, objects, hours."""

    presses: int
    samples: int
    fingertips: int
    seconds: float
    objects: int
    hours: float


QUICK = Plan(100, 2_000, 2, 4.0, 50, 0.5)
FULL = Plan(600, 20_000, 8, 8.0, 200, 10.0)


def run(*, quick: bool = False, output: Path | None = None) -> dict[str, Any]:
    """Measure everything, and write it to a folder if one is given.

    Args:
        quick: fewer presses, fingertips and hours: half a minute in place of minutes.
        output: folder for contacts.json, contacts.html and the plots; needs matplotlib.

    Returns:
        `schema`, `quick`, `seconds` it took, and the `tables` of `measure`.

    Raises:
        ImportError: matplotlib is not installed (the extra `plots`).
        OSError: the folder cannot be written.
    """
    start = time.perf_counter()
    tables = measure(QUICK if quick else FULL)
    document = {
        "schema": SCHEMA,
        "quick": quick,
        "seconds": round(time.perf_counter() - start, 1),
        "tables": tables,
    }
    if output is not None:
        contacts_page.write(document, output)
    return document


def describe(document: dict[str, Any]) -> str:
    """The tables as text for a terminal."""
    return contacts_page.text(document)


def measure(plan: Plan) -> Report:
    """Measure everything to the extent of `plan`.

    Returns:
        Tables of rows: `localization`, `separation`, `intrinsic`, `bounds`, `tasks`,
        `calibrations` (of the fusion), `slip`, `placements`.
    """
    return {
        "localization": _localization(plan.presses),
        "separation": _separation(plan.presses),
        "intrinsic": _intrinsic(plan.samples),
        "bounds": _bounds(),
        "tasks": _tasks(plan.fingertips, plan.seconds),
        "calibrations": _calibrations(max(1, plan.fingertips // 2), plan.seconds),
        "slip": _slip(plan.objects, plan.hours),
        "placements": [
            {"places": places, "condition": condition}
            for condition, places in PlanarStructure().placements()
            if condition < 10.0
        ],
    }


def _localization(presses: int) -> list[Row]:
    rows = []
    for sweep, cases in _SWEEPS.items():
        for case in cases:
            localizers = {
                str(method): localizer_for(method, case.probe_mm, case.noise_units)
                for method in SKIN_METHODS
            }
            localizers["template, any size"] = localizer_for("template", None, case.noise_units)
            found = errors(case, localizers, np.random.default_rng(0), presses)
            for method, result in found.items():
                rows.append(
                    {
                        "sweep": sweep,
                        "probe_mm": case.probe_mm,
                        "units": case.units,
                        "noise_units": case.noise_units,
                        "membrane_mm": case.membrane_mm,
                        "method": method,
                        "contacts": len(result.error_mm),
                        "rms_mm": result.rms_mm,
                        "p95_mm": float(np.percentile(result.error_mm, 95)),
                        "said_mm": rms(result.said_mm),
                        "ns": result.ns,
                    }
                )
    return rows


def _separation(presses: int) -> list[Row]:
    rows = []
    for apart_mm in (10.0, 12.0, 14.0, 16.0, 18.0):
        both, alone = separation(np.random.default_rng(1), apart_mm, presses)
        rows.append({"apart_mm": apart_mm, "two_told_as_two": both, "one_told_as_two": alone})
    return rows


def _intrinsic(samples: int) -> list[Row]:
    rows = []
    for force_n in (0.1, 0.3, 1.0, 3.0, 10.0, 30.0):
        error, predicted, none = intrinsic_errors(force_n, np.random.default_rng(2), samples)
        rows.append(
            {"force_n": force_n, "rms_mm": error, "first_order_mm": predicted, "no_contact": none}
        )
    return rows


def _bounds() -> list[Row]:
    return [
        {
            "friction": friction,
            "printed": printed,
            "derived": sphere_error_bound(1.0, 0.5, friction),
        }
        for friction, printed in PUBLISHED_FRICTION_FACTOR.items()
    ]


def _tasks(fingertips: int, seconds: float) -> list[Row]:
    rows = []
    for task, found in task_errors(fingertips, seconds).items():
        best = min(rms(found[method]) for method in SINGLE_METHODS)
        rows += [
            {
                "task": task,
                "method": method,
                "rms_mm": rms(found[method]),
                "peak_mm": float(np.nanmax(np.abs(found[method]))),
                "of_best_single": rms(found[method]) / best,
            }
            for method in METHODS
        ]
    return rows


def _calibrations(fingertips: int, seconds: float) -> list[Row]:
    """How good the fusion is after calibrations of several kinds."""
    rows = []
    for presses, place_sd_mm in ((60, 0.4), (60, 0.2), (200, 0.4), (200, 0.2)):
        found = task_errors(fingertips, seconds, presses, place_sd_mm)
        shares = [
            rms(methods["fused"]) / min(rms(methods[method]) for method in SINGLE_METHODS)
            for methods in found.values()
        ]
        rows.append(
            {
                "presses": presses,
                "press_sd_mm": place_sd_mm,
                "mean_of_best_single": float(np.mean(shares)),
                "worst_of_best_single": float(np.max(shares)),
            }
        )
    return rows


def _slip(objects: int, hours: float) -> list[Row]:
    alarms = false_alarms_per_hour(np.random.default_rng(4), hours)
    rows = []
    for share in (0.85, 0.95, 1.0):
        trials = slip_trials(np.random.default_rng(3), objects, sliding_share=share)
        for i, name in enumerate(DETECTORS):
            slipped, delay = trials.slipped_mm[i], trials.delay_s[i]
            told = np.isfinite(slipped)
            rows.append(
                {
                    "detector": name,
                    "sliding_over_static": share,
                    "within_1_mm": float((slipped < 1.0).mean()),
                    "never": float((~told).mean()),
                    "median_slipped_mm": float(np.median(slipped[told])) if told.any() else None,
                    "median_delay_ms": 1e3 * float(np.median(delay[told])) if told.any() else None,
                    "false_alarms_per_hour": float(alarms[i]),
                    "hours": hours,
                }
            )
    return rows
