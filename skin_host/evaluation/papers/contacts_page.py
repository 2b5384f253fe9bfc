"""The contact report for readers: text for a terminal, a page of HTML, and its pictures."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from skin_host.evaluation.page import Section, to_html
from skin_host.evaluation.papers.fingertip_trials import METHODS
from skin_host.files import write_atomic

Row = dict[str, Any]
Table = tuple[list[str], list[list[str]]]

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


def text(document: dict[str, Any]) -> str:
    """Every table as text."""
    parts = [
        f"{_SECTIONS[name][0]}\n{_aligned(_table(name, rows))}"
        for name, rows in document["tables"].items()
    ]
    return "\n\n".join([*parts, f"in {document['seconds']:.0f} s"])


def write(document: dict[str, Any], folder: Path) -> None:
    """Write contacts.json, contacts.html and the pictures.

    Raises:
        ImportError: matplotlib is not installed (the extra `plots`).
        OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in draw(document["tables"]).items():
        write_atomic(folder / name, picture)
    sections = []
    for name, rows in document["tables"].items():
        title, about, drawn = _SECTIONS[name]
        sections.append(Section(title, [about], [_table(name, rows)], drawn))
    write_atomic(folder / "contacts.html", to_html(sections, TITLE).encode())
    write_atomic(folder / "contacts.json", json.dumps(document, indent=1).encode() + b"\n")


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


def _aligned(table: Table) -> str:
    lines = [table[0], *table[1]]
    widths = [max(len(line[i]) for line in lines) for i in range(len(table[0]))]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        for line in lines
    )


def draw(tables: dict[str, list[Row]]) -> dict[str, bytes]:
    """Every picture, PNG, by its file name.

    Raises:
        ImportError: matplotlib is not installed (the extra `plots`).
    """
    return {
        "contacts_localization.png": _localization(tables["localization"]),
        "contacts_fusion.png": _fusion(tables["tasks"]),
        "contacts_intrinsic.png": _intrinsic(tables["intrinsic"]),
    }


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()


def _localization(rows: list[Row]) -> bytes:
    figure = _figure(12, 4)
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
    return _png(figure)


def _fusion(rows: list[Row]) -> bytes:
    figure = _figure(9, 4.5)
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
    return _png(figure)


def _intrinsic(rows: list[Row]) -> bytes:
    figure = _figure(5.5, 4)
    axis = figure.subplots()
    forces = [row["force_n"] for row in rows]
    axis.loglog(forces, [row["rms_mm"] for row in rows], "o", label="Monte Carlo")
    axis.loglog(forces, [row["first_order_mm"] for row in rows], "-", label="first order")
    axis.set(xlabel="contact force (N)", ylabel="contact error, rms (mm)")
    axis.set_title("Intrinsic sensing, sphere of 13 mm")
    axis.grid(alpha=0.3, which="both")
    axis.legend()
    return _png(figure)
