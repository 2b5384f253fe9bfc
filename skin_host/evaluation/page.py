"""The report to read: one list of sections, written as Markdown and as HTML, with plots."""

import html
import json
import re
from dataclasses import dataclass, field
from pathlib import Path

from skin_host.evaluation import plots, tables
from skin_host.evaluation.tables import Report, Table
from skin_host.files import write_atomic

PICTURES = "accuracy"
STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;
color:#1b1f24}
table{border-collapse:collapse;margin:1rem 0;font-size:.85rem;display:block;overflow-x:auto}
td{white-space:nowrap}
td,th{padding:.25rem .6rem;border-bottom:1px solid #d8dee4;text-align:right}
td:first-child,th:first-child{text-align:left}
img{max-width:100%}
"""


@dataclass(frozen=True)
class Section:
    """A heading, paragraphs, tables of (head, rows), and the path of a picture."""

    title: str
    text: list[str]
    tables: list[Table] = field(default_factory=list)
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
        parts += [f"<p>{_code(html.escape(paragraph))}</p>" for paragraph in section.text]
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


def _code(text: str) -> str:
    return re.sub("`([^`]+)`", r"<code>\1</code>", text)


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
                    "Truth A is asymmetric (unloading 2.5 times slower, losses growing with "
                    "pressure, rates with overstress), S has a material clock (times shrink with "
                    "compression), L is linear, H is A with rate-independent plays. They have "
                    "seven modes over four decades; none is the model of a compensator."
                ),
                (
                    "Made anew by `skin report --output docs`; nothing else writes this page. "
                    "Take a quiet machine."
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
            [tables.summary(report)],
            f"{PICTURES}/pareto.png",
        ),
        Section(
            "Goals",
            ["What was set out to reach, and what was measured."],
            [tables.goals(report)],
        ),
        Section(
            "Whose family",
            [
                (
                    "The same errors truth by truth, with what model and truth have in common. "
                    "`its law`: the truth is a limit of the model's own law, but for the number of "
                    "modes; so is L, without asymmetry and clock, for all of them. `a cause`: the "
                    "model has one of the truth's causes of slow unloading, if in another form. "
                    "`nothing`: it has none of them."
                ),
                (
                    "The default, `asymmetric_clock`, lays slow unloading half to direction and "
                    "half to a clock, since one hold cannot tell the two apart. It shares half of "
                    "its cause with A and H and half with S, with the very exponential of S's "
                    "clock: its lead on S, and part of that on A, is kinship. The plays of H, and "
                    "losses that grow with pressure (A and H), are in no model: H is the truth "
                    "against which no model is in family. `asymmetric` and `asymmetric_log` share "
                    "nothing with S. Read those rows for what to expect of foam whose law nobody "
                    f"knows. {tables.verdict_of_strangers(report)}"
                ),
            ],
            [tables.family(report)],
        ),
        Section(
            "Errors in full",
            [
                "kPa RMS, exact readings. `perfect` takes off the true relaxation.",
            ],
            [tables.errors(report, 0.0, measure="rms_kpa")],
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
            [tables.errors(report, 0.4, measure="rms_kpa")],
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
                tables.errors(report, 0.0, measure="worst_kpa"),
                tables.errors(report, 0.0, measure="rest_rms_kpa"),
            ],
        ),
        Section(
            "Bounded or not",
            [
                (
                    "Error at the end of a press (kPa, not clamped at zero) after so many cycles "
                    "of 5 s at 50 kPa and 5 s free, and the relaxation of the truth itself."
                ),
                (
                    "The published model runs away; the others follow the truth to a cycle that "
                    "repeats. What still moves after cycle 100, which is 1000 s, is the truth: its "
                    "slowest modes take 6000 s, and a hold of one hour shows them in part. The "
                    "default's error is a share of that relaxation: on A, since losses that grow "
                    "with pressure cannot be seen at one level; on H it is largest, since a fit "
                    "takes what the plays leave of a hold for slow modes. The last table tells "
                    "that neither float32 nor states at 1 Hz nor the number of cycles adds to it, "
                    "and by how much two models differ in the end that fit the hold equally well: "
                    "less than that no fit to this record can promise."
                ),
            ],
            [tables.cycles(report), tables.cycle_evidence(report)],
            f"{PICTURES}/cycles.png",
        ),
        Section(
            "What models cost",
            ["ns per taxel-step alone, at 50 Hz, and bytes of state per taxel (float64)."],
            [tables.speed(report)],
        ),
        Section(
            "Cost follows need",
            [
                (
                    "The whole pipeline from bytes to kPa, touch and drift, ns per taxel-step, and "
                    "in copies of as many float32 in memory. "
                    "Where nobody wants the pressures of a part and nothing touches it, most "
                    f"sweeps are only compared with a limit: of {report['unwatched']['sweeps']} "
                    "sweeps with a touch half of the time "
                    f"{report['unwatched']['skipped_sweeps']} were skipped, "
                    f"{report['unwatched']['touches_that_differ']} touch decisions differed, and "
                    f"pressures by {report['unwatched']['worst_difference_kpa']:.2f} kPa at most."
                ),
            ],
            [tables.pipeline(report)],
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
            [tables.false_touches(report)],
            f"{PICTURES}/false_touches.png",
        ),
        Section(
            "Detection",
            ["A sudden press of so many units, 0.4 units of noise, two votes of three."],
            [tables.detection(report)],
        ),
        Section(
            "Drift",
            ["Lag of the baselines behind a steady drift of all taxels, 0.4 units of noise."],
            [tables.drift(report)],
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
            [tables.holds(report)],
        ),
        Section(
            "Localisation",
            ["One probe on the 12-pad triangle (pitch 5 mm), 57 units, 0.4 units of noise; mm."],
            [tables.localization(report)],
        ),
        Section(
            "Parameters found",
            ["What each fit to the calibration hold gave, and what it could not tell apart."],
            [tables.fits(report)],
        ),
    ]
