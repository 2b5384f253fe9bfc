"""`skin report --contacts`: localisation, intrinsic sensing, fusion and slip, measured.

Plain rows of numbers, then tables and pictures of them.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from skin_host.evaluation.document import Section, Table, as_text, new_figure, png, write
from skin_host.evaluation.localization_trials import (
    METHODS as SKIN_METHODS,
)
from skin_host.evaluation.localization_trials import (
    Case,
    errors,
    localizer_for,
    separation,
)
from skin_host.evaluation.papers.force_torque import (
    PUBLISHED_FRICTION_FACTOR,
    PlanarStructure,
    intrinsic_errors,
    sphere_error_bound,
)
from skin_host.evaluation.papers.fusion import (
    METHODS,
    SINGLE_METHODS,
    rms,
    task_errors,
)
from skin_host.evaluation.papers.grasp_loops import DETECTORS, false_alarms_per_hour, slip_trials
from skin_host.evaluation.steps import show_step

Row = dict[str, Any]
Report = dict[str, list[Row]]

SCHEMA = "skin.contacts/1"

TITLE = "Where, how hard, is it slipping"
#: Of each table: its heading, its explanation, and its picture.
_SECTIONS: dict[str, tuple[str, str, str | None]] = {
    "localization": (
        "Where on the skin",
        (
            "Root mean square of the radial error, mm, of one round probe on 12-pad triangles "
            "(pitch 5 mm, foam 2 mm), by method. `template` knows the size of the probe, "
            "`template, any size` does not. Noise and activation are in units of the 8-bit "
            "reading; the cover is how far the foam is drawn down around the probe. Last line: "
            "microseconds per contact."
        ),
        "contacts_localization.png",
    ),
    "separation": (
        "One contact or two",
        "Probes of 8 mm, the second at 70 % of the first: shares of presses reported as two.",
        None,
    ),
    "intrinsic": (
        "Contact from force and torque",
        "Sphere of 13 mm: error of random contacts, mm, against first-order propagation.",
        "contacts_intrinsic.png",
    ),
    "bounds": (
        "The bound of the sphere",
        "Its factor f for a coefficient of friction: as printed, and as derived here.",
        None,
    ),
    "tasks": (
        "Array and force/torque together",
        (
            "The six tasks of Son et al., with noise and accelerations. The last column compares "
            "with the best of the published single methods in that task."
        ),
        "contacts_fusion.png",
    ),
    "calibrations": (
        "What calibration the fusion needs",
        "Error as a share of the best single method, by presses and their placing error.",
        None,
    ),
    "slip": (
        "Is it slipping",
        "Objects under rising tangential load. A negative delay is a warning before the slip.",
        None,
    ),
    "placements": (
        "Placing three gauges",
        "Condition numbers of the planar structure, by which three of its places are used.",
        None,
    ),
}
#: What the pictures show of localisation: (title, varied key, cases).
_SWEEPS: dict[str, list[Case]] = {
    "probe": [Case(size) for size in (3.0, 4.0, 6.0, 8.0, 10.0, 12.0)],
    "force": [Case(10.0, units=units) for units in (6.0, 12.0, 25.0, 57.0, 100.0)],
    "noise": [Case(10.0, noise_units=noise) for noise in (0.2, 0.4, 0.8, 1.6, 3.0)],
    "foam": [Case(size, membrane_mm=0.25) for size in (6.0, 10.0)],
}


@dataclass(frozen=True, slots=True)
class ContactsPlan:
    """How much is measured: presses, samples, fingertips, seconds of a task, objects, hours."""

    presses: int
    samples: int
    fingertips: int
    seconds: float
    objects: int
    hours: float


QUICK = ContactsPlan(100, 2_000, 2, 4.0, 50, 0.5)
FULL = ContactsPlan(600, 20_000, 8, 8.0, 200, 10.0)


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
        write_page(document, output)
    return document


def describe(document: dict[str, Any]) -> str:
    """The tables as text for a terminal."""
    return text(document)


def measure(plan: ContactsPlan) -> Report:
    """Measure everything to the extent of `plan`.

    Returns:
        Tables of rows: `localization`, `separation`, `intrinsic`, `bounds`, `tasks`,
        `calibrations` (of the fusion), `slip`, `placements`.
    """
    tables: dict[str, Callable[[], list[Row]]] = {
        "localization": lambda: _localization(plan.presses),
        "separation": lambda: _separation(plan.presses),
        "intrinsic": lambda: _intrinsic(plan.samples),
        "bounds": _bounds,
        "tasks": lambda: _tasks(plan.fingertips, plan.seconds),
        "calibrations": lambda: _calibrations(max(1, plan.fingertips // 2), plan.seconds),
        "slip": lambda: _slip(plan.objects, plan.hours),
        "placements": lambda: [
            {"places": places, "condition": condition}
            for condition, places in PlanarStructure().placements()
            if condition < 10.0
        ],
    }
    found: Report = {}
    for name, table in tables.items():
        show_step(name)
        found[name] = table()
    return found


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


def text(document: dict[str, Any]) -> str:
    """Every table as text."""
    parts = [
        f"{_SECTIONS[name][0]}\n{as_text(*_table(name, rows))}"
        for name, rows in document["tables"].items()
    ]
    return "\n\n".join([*parts, f"in {document['seconds']:.0f} s"])


def write_page(document: dict[str, Any], folder: Path) -> None:
    """Write contacts.json, contacts.html, contacts.md and the pictures.

    Raises:
        ImportError: matplotlib is not installed (the extra `plots`).
        OSError: the folder cannot be written.
    """
    sections = []
    for name, rows in document["tables"].items():
        title, about, drawn = _SECTIONS[name]
        sections.append(Section(title, [about], [_table(name, rows)], drawn))
    write(sections, TITLE, document, folder, "contacts", draw(document["tables"]))


def _table(name: str, rows: list[Row]) -> Table:
    if name == "localization":
        return _by_method(rows)
    columns = list(rows[0])
    return columns, [[_cell(row[column]) for column in columns] for row in rows]


def _by_method(rows: list[Row]) -> Table:
    """One line for each case, one column for each method, and their cost at the end."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    cases: dict[tuple[float, ...], dict[str, float]] = {}
    for row in rows:
        case = row["probe_mm"], row["units"], row["noise_units"], row["membrane_mm"]
        cases.setdefault(case, {})[row["method"]] = row["rms_mm"]
    lines = [
        [f"{value:g}" for value in case] + [f"{found[method]:.2f}" for method in methods]
        for case, found in cases.items()
    ]
    cost_us = [
        1e-3 * float(np.median([row["ns"] for row in rows if row["method"] == method]))
        for method in methods
    ]
    lines.append(["us", "", "", "", *(f"{cost:.0f}" for cost in cost_us)])
    return ["probe mm", "units", "noise", "cover mm", *methods], lines


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value)


def draw(tables: dict[str, list[Row]]) -> dict[str, bytes]:
    """Every picture, PNG, by its file name.

    Raises:
        ImportError: matplotlib is not installed (the extra `plots`).
    """
    return {
        "contacts_localization.png": _draw_localization(tables["localization"]),
        "contacts_fusion.png": _draw_fusion(tables["tasks"]),
        "contacts_intrinsic.png": _draw_intrinsic(tables["intrinsic"]),
    }


def _draw_localization(rows: list[Row]) -> bytes:
    figure = new_figure(12, 4)
    axes = figure.subplots(1, 3, sharey=True)
    for axis, (sweep, key, label, title) in zip(
        axes,
        (
            ("probe", "probe_mm", "probe diameter (mm)", "57 units, noise 0.4"),
            ("force", "units", "activation of a covered pad (units)", "probe 10 mm, noise 0.4"),
            ("noise", "noise_units", "noise (units)", "probe 10 mm, 57 units"),
        ),
        strict=True,
    ):
        swept = [row for row in rows if row["sweep"] == sweep]
        for method in dict.fromkeys(row["method"] for row in swept):
            mine = [row for row in swept if row["method"] == method]
            axis.plot(
                [row[key] for row in mine], [row["rms_mm"] for row in mine], "o-", label=method
            )
        axis.set(xlabel=label, yscale="log", title=title)
        axis.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("localisation error, rms (mm)")
    axes[0].legend(fontsize=8)
    return png(figure)


def _draw_fusion(rows: list[Row]) -> bytes:
    figure = new_figure(9, 4.5)
    axis = figure.subplots()
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    for i, method in enumerate(METHODS):
        heights = [row["rms_mm"] for row in rows if row["method"] == method]
        axis.bar(np.arange(len(tasks)) + 0.12 * (i - 3), heights, 0.11, label=method)
    axis.set_xticks(range(len(tasks)), [task.replace(" ", "\n", 1) for task in tasks], fontsize=8)
    axis.set_ylabel("contact error, rms (mm)")
    axis.set_title("One contact from array and force/torque, in the tasks of Son et al.")
    axis.legend(fontsize=8)
    axis.grid(axis="y", alpha=0.3)
    return png(figure)


def _draw_intrinsic(rows: list[Row]) -> bytes:
    figure = new_figure(5.5, 4)
    axis = figure.subplots()
    forces = [row["force_n"] for row in rows]
    axis.loglog(forces, [row["rms_mm"] for row in rows], "o", label="Monte Carlo")
    axis.loglog(forces, [row["first_order_mm"] for row in rows], "-", label="first order")
    axis.set(xlabel="contact force (N)", ylabel="contact error, rms (mm)")
    axis.set_title("Intrinsic sensing, sphere of 13 mm")
    axis.grid(alpha=0.3, which="both")
    axis.legend()
    return png(figure)
