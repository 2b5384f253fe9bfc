"""The report to read: one list of sections, written as Markdown and as HTML, with plots."""

import html
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from skin_host.evaluation import plots
from skin_host.evaluation.accuracy import VARIANTS
from skin_host.evaluation.histories import HISTORIES
from skin_host.files import write_atomic

Row = dict[str, Any]
Report = dict[str, Any]

PICTURES = "accuracy"
STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;
color:#1b1f24}
table{border-collapse:collapse;margin:1rem 0;font-size:.85rem;display:block;overflow-x:auto}
td,th{padding:.25rem .6rem;border-bottom:1px solid #d8dee4;text-align:right}
td:first-child,th:first-child{text-align:left}
img{max-width:100%}
"""


@dataclass(frozen=True)
class Section:
    """A heading, paragraphs, tables of (head, rows), and the path of a picture."""

    title: str
    text: list[str]
    tables: list[tuple[list[str], list[list[str]]]] = field(default_factory=list)
    picture: str | None = None


def write(report: Report, folder: Path) -> None:
    """Write report.json, report.html and accuracy.md, and the plots to a folder beside them.

    Raises:
        OSError: the folder cannot be written.
    """
    for name, picture in plots.draw(report).items():
        write_atomic(folder / PICTURES / name, picture)
    sections = _sections(report)
    write_atomic(folder / "report.json", json.dumps(report, indent=1).encode() + b"\n")
    write_atomic(folder / "accuracy.md", markdown(sections, "How accurate, how fast").encode())
    write_atomic(folder / "report.html", to_html(sections, "How accurate, how fast").encode())


def markdown(sections: list[Section], title: str) -> str:
    """The sections as Markdown."""
    lines = [f"# {title}", ""]
    for section in sections:
        lines += [f"## {section.title}", ""]
        for paragraph in section.text:
            lines += [paragraph, ""]
        for head, rows in section.tables:
            lines.append("| " + " | ".join(head) + " |")
            lines.append("|" + "---|" * len(head))
            lines += ["| " + " | ".join(row) + " |" for row in rows]
            lines.append("")
        if section.picture:
            lines += [f"![{section.title}]({section.picture})", ""]
    return "\n".join(lines)


def to_html(sections: list[Section], title: str) -> str:
    """The sections as a page of HTML; pictures lie beside it."""
    name = html.escape(title)
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{name}</title>",
        "<meta name=viewport content='width=device-width,initial-scale=1'>",
        f"<style>{STYLE}</style><h1>{name}</h1>",
    ]
    for section in sections:
        parts.append(f"<h2>{html.escape(section.title)}</h2>")
        parts += [f"<p>{html.escape(paragraph)}</p>" for paragraph in section.text]
        for head, rows in section.tables:
            parts.append("<table><tr>" + "".join(f"<th>{html.escape(h)}</th>" for h in head))
            parts += [
                "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows
            ]
            parts.append("</table>")
        if section.picture:
            alt = html.escape(section.title)
            parts.append(f'<p><img src="{section.picture}" alt="{alt}"></p>')
    return "\n".join(parts)


def _sections(report: Report) -> list[Section]:
    machine = report["machine"]
    length = "quick: a quarter of each history, at 5 Hz" if report["quick"] else "the whole"
    return [
        Section(
            "What this is",
            [
                (
                    f"Written by `skin report` on {report['date'][:10]} in "
                    f"{report['seconds']:.0f} s ({length}), on {machine['processor']}, "
                    f"{machine['cores']} cores, load {machine['load']}, Python "
                    f"{machine['python']}, numpy {machine['numpy']}. All errors are against "
                    "synthetic truths of the emulator's foam, since no relaxation curve of the "
                    "paper's foam is public; seeds are fixed, so the errors come out the same "
                    "again. Times depend on the machine and on what else runs on it: compare "
                    "them with the copy of memory timed next to them."
                ),
                (
                    "Every model was fitted to one record of each truth, a hold of one hour at "
                    "65 kPa with 75 minutes of rest, and met the other histories unprepared. "
                    "Truth A is asymmetric (unloading 2.5 times slower, rates growing with "
                    "overstress), S has a material clock (times shrink with compression), L is "
                    "linear, H is A with plays. None is the model of a compensator: they have "
                    "seven modes and laws of their own; but `asymmetric` shares its cause with "
                    "A, and `asymmetric_clock` half of its cause with A and half with S. L and "
                    "H are strangers to both."
                ),
            ],
        ),
        Section(
            "Speed against error",
            [
                (
                    "Error: RMS over nine steps, multistep, grasps and cycling on A and S, "
                    "exact readings. Cost: ns per taxel-step at 1920 taxels. A star marks the "
                    "Pareto front."
                ),
            ],
            [_summary_table(report)],
            f"{PICTURES}/pareto.png",
        ),
        Section("Goals", ["What was set out to reach, and what was measured."], [_goals(report)]),
        Section(
            "Errors in full",
            [
                "kPa RMS, exact readings. `perfect` takes off the true relaxation.",
            ],
            [_errors(report, 0.0, measure="rms_kpa")],
            f"{PICTURES}/errors.png",
        ),
        Section(
            "Errors of real readings",
            [
                (
                    "kPa RMS with 0.4 units of noise, whole units and a baseline between two "
                    "codes. What `perfect` leaves is the floor of the 8-bit reading."
                ),
            ],
            [_errors(report, 0.4, measure="rms_kpa")],
        ),
        Section(
            "Worst errors and rest",
            [
                (
                    "kPa, exact readings. With states at 1 Hz the worst error is that of the "
                    "first second of a press. First table: worst; second: RMS while nothing "
                    "presses."
                ),
            ],
            [
                _errors(report, 0.0, measure="worst_kpa"),
                _errors(report, 0.0, measure="rest_rms_kpa"),
            ],
        ),
        Section(
            "Bounded or not",
            [
                (
                    "Error at the end of a press (kPa, not clamped at zero) after so many "
                    "cycles of 5 s at 50 kPa and 5 s free."
                ),
            ],
            [_cycles(report)],
            f"{PICTURES}/cycles.png",
        ),
        Section(
            "What models cost",
            ["ns per taxel-step alone, at 50 Hz, and bytes of state per taxel (float64)."],
            [_speed(report)],
        ),
        Section(
            "Cost follows need",
            [
                (
                    "The whole pipeline from bytes to kPa, touch and drift, ns per taxel-step. "
                    "Where nobody wants the pressures of a part and nothing touches it, most "
                    f"sweeps are only compared with a limit: of {report['unwatched']['sweeps']} "
                    "sweeps with a touch half of the time "
                    f"{report['unwatched']['skipped_sweeps']} were skipped, "
                    f"{report['unwatched']['touches_that_differ']} touch decisions differed, and "
                    f"pressures by {report['unwatched']['worst_difference_kpa']:.2f} kPa at most."
                ),
            ],
            [_pipeline(report)],
            f"{PICTURES}/touched.png",
        ),
        Section(
            "False touches",
            [
                (
                    "Touches begun per hour and taxel of untouched skin, after a calibration of "
                    "5 s at 25 Hz, against noise (units) and votes of three samples."
                ),
            ],
            [_false_touches(report)],
            f"{PICTURES}/false_touches.png",
        ),
        Section(
            "Detection",
            ["A sudden press of so many units, 0.4 units of noise, two votes of three."],
            [_detection(report)],
        ),
        Section(
            "Drift",
            ["Lag of the baselines behind a steady drift of all taxels, 0.4 units of noise."],
            [_drift(report)],
            f"{PICTURES}/drift.png",
        ),
        Section(
            "Long holds",
            [
                (
                    "A press at 65 kPa while everything drifts: is it told as long as it lasts, "
                    "how wrong is its pressure at the end, and for how long is a touch told "
                    "that is no more. `all`: the whole part is pressed, and no untouched taxel "
                    "tells of drift."
                ),
            ],
            [_holds(report)],
        ),
        Section(
            "Localisation",
            ["One probe on the 12-pad triangle (pitch 5 mm), 57 units, 0.4 units of noise; mm."],
            [_localization(report)],
        ),
        Section(
            "Parameters found",
            ["What each fit to the calibration hold gave, and what it could not tell apart."],
            [_fits(report)],
        ),
    ]


def _summary_table(report: Report) -> tuple[list[str], list[list[str]]]:
    head = ["model", "states", "type", "RMS kPa", "worst RMS", "with noise", "ns", "bytes", ""]
    rows = [
        [
            line["model"],
            _states(line["update_s"]),
            line["dtype"],
            f"{line['rms_kpa']:.2f}",
            f"{line['worst_rms_kpa']:.2f}",
            f"{line['noisy_rms_kpa']:.2f}",
            f"{line['ns_per_taxel_step']:.1f}",
            str(line["bytes_per_taxel"]),
            "*" if line["pareto"] else "",
        ]
        for line in report["summary"]
    ]
    return head, rows


def _goals(report: Report) -> tuple[list[str], list[list[str]]]:
    rows = [
        [
            goal["figure"],
            f"{goal['measured']:.3g}",
            f"{goal['must']:g}",
            f"{goal['aim']:g}",
            "aim reached" if goal["aim_reached"] else "reached" if goal["reached"] else "missed",
        ]
        for goal in report["goals"]
    ]
    return ["figure", "measured", "must", "aim", ""], rows


def _errors(report: Report, noise: float, measure: str) -> tuple[list[str], list[list[str]]]:
    truths = list(dict.fromkeys(row["truth"] for row in report["rows"]))
    histories = [name for name in HISTORIES if measure != "rest_rms_kpa" or name != "walk"]
    head = ["model", "states"] + [f"{truth} {name}" for truth in truths for name in histories]
    found = {
        (row["model"], row["update_s"], row["dtype"], row["truth"], row["history"]): row[measure]
        for row in report["rows"]
        if row["noise_units"] == noise
    }
    rows = []
    for model, update_s, dtype in [("perfect", 0.0, "float64")] + [
        (variant.model, variant.update_s, variant.dtype) for variant in VARIANTS
    ]:
        if dtype != "float64":
            continue
        cells = [
            found.get((model, update_s, dtype, truth, name))
            for truth in truths
            for name in histories
        ]
        rows.append(
            [model, _states(update_s)] + ["" if cell is None else f"{cell:.2f}" for cell in cells]
        )
    return head, rows


def _cycles(report: Report) -> tuple[list[str], list[list[str]]]:
    marks = sorted({row["cycles"] for row in report["cycles"]})
    rows = []
    for model, truth in dict.fromkeys((row["model"], row["truth"]) for row in report["cycles"]):
        errors = {
            row["cycles"]: row["unclamped_error_kpa"]
            for row in report["cycles"]
            if row["model"] == model and row["truth"] == truth
        }
        rows.append([model, truth] + [f"{errors[mark]:.2f}" for mark in marks])
    return ["model", "truth"] + [f"{mark:,}" for mark in marks], sorted(rows, key=lambda r: r[1])


def _speed(report: Report) -> tuple[list[str], list[list[str]]]:
    sizes = sorted({row["taxels"] for row in report["speed"]})
    columns = [(dtype, n) for dtype in ("float64", "float32") for n in sizes]
    found = {
        (row["model"], row["update_s"], row["dtype"], row["taxels"]): row for row in report["speed"]
    }
    rows = []
    for model, update_s in dict.fromkeys(
        (row["model"], row["update_s"]) for row in report["speed"]
    ):
        cells = [
            f"{found[model, update_s, dtype, n]['ns_per_taxel_step']:.2f}" for dtype, n in columns
        ]
        size = found[model, update_s, "float64", sizes[0]]["bytes_per_taxel"]
        rows.append([model, _states(update_s), *cells, str(size)])
    return ["model", "states"] + [f"{dtype} {n:,}" for dtype, n in columns] + ["bytes"], rows


def _pipeline(report: Report) -> tuple[list[str], list[list[str]]]:
    rows = [
        [
            f"{row['taxels']:,}",
            f"{row['touched']:,}",
            "yes" if row["pressures_wanted"] else "no",
            f"{row['ns_per_taxel_step']:.2f}",
            f"{row['ns_per_taxel_step'] * row['taxels'] * 1e-3:.1f}",
        ]
        for row in report["pipeline"]
    ]
    return ["taxels", "touched", "pressures wanted", "ns per taxel-step", "us per sweep"], rows


def _false_touches(report: Report) -> tuple[list[str], list[list[str]]]:
    votes = sorted({row["votes"] for row in report["false_touches"]})
    rows = []
    for noise in sorted({row["noise_units"] for row in report["false_touches"]}):
        mine = {row["votes"]: row for row in report["false_touches"] if row["noise_units"] == noise}
        rows.append(
            [f"{noise:g}"]
            + [f"{mine[vote]['touches_per_taxel_hour']:.3g}" for vote in votes]
            + [f"{mine[votes[0]]['taxel_hours']:.0f}"]
        )
    return ["noise"] + [f"{vote} of 3" for vote in votes] + ["taxel-hours"], rows


def _detection(report: Report) -> tuple[list[str], list[list[str]]]:
    rows = [
        [
            f"{row['height_units']:g}",
            f"{row['height_kpa']:.1f}",
            f"{row['told_within_2_s']:.2f}",
            "" if row["median_sweeps"] is None else f"{row['median_sweeps']:g}",
            "" if row["p95_sweeps"] is None else f"{row['p95_sweeps']:g}",
        ]
        for row in report["detection"]
    ]
    return ["units", "kPa", "told within 2 s", "median sweeps", "95 % within sweeps"], rows


def _drift(report: Report) -> tuple[list[str], list[list[str]]]:
    rows = [
        [
            row["rule"],
            f"{row['rate_units_per_s']:g}",
            f"{row['lag_units']:.2f}",
            f"{row['touched_share']:.2g}",
        ]
        for row in report["drift"]
    ]
    return ["rule", "units per s", "lag, units", "share told as touched"], rows


def _holds(report: Report) -> tuple[list[str], list[list[str]]]:
    rows = [
        [
            row["truth"],
            row["case"],
            "all" if row["all_pressed"] else "some",
            f"{row['touched_share_in_hold']:.3f}",
            f"{row['rms_in_hold_kpa']:.2f}",
            f"{row['end_of_hold_error_kpa']:.2f}",
            f"{row['ghost_s_per_taxel']:.2f}",
            f"{row['rest_rms_kpa']:.2f}",
        ]
        for row in report["holds"]
    ]
    head = [
        "truth",
        "case",
        "pressed",
        "told",
        "RMS kPa",
        "error at end",
        "ghost s",
        "rest RMS kPa",
    ]
    return head, rows


def _localization(report: Report) -> tuple[list[str], list[list[str]]]:
    rows = [
        [row["method"], f"{row['probe_mm']:g}", f"{row['rms_mm']:.2f}", f"{row['p95_mm']:.2f}"]
        for row in report["localization"]
    ]
    return ["method", "probe mm", "RMS mm", "95 % within mm"], rows


def _fits(report: Report) -> tuple[list[str], list[list[str]]]:
    def numbers(values: list[float], digits: int) -> str:
        return " ".join(f"{value:.{digits}f}" for value in values)

    rows = [
        [
            row["model"],
            row["truth"],
            f"{row['rms_hold_kpa']:.2f} / {row['rms_rest_kpa']:.2f}",
            numbers(row["beta"], 3),
            numbers(row["tau_s"], 1),
            numbers(row["beta_unload"], 3) if row["model"].startswith("published") else "",
            numbers(row["tau_unload_s"], 1),
            "" if row["clock_kpa"] is None else f"{row['clock_kpa']:.0f}",
            " ".join(row["uncertain"]),
        ]
        for row in report["fits"]
    ]
    head = ["model", "truth", "RMS hold / rest", "beta", "tau s", "beta unload", "tau unload s"]
    return [*head, "clock kPa", "not known"], rows


def _states(update_s: float) -> str:
    return "every sample" if update_s == 0.0 else f"every {update_s:g} s"
