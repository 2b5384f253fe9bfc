"""The pictures of the reports, as PNG files in memory; one for each figure of section VI."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.probes.bench import NAMED_PADS, PalmRig
from emulator.probes.experiments import Presses, Scan
from skin_host.evaluation.cup_grasp import Grasp
from skin_host.evaluation.document import new_figure, png

Row = dict[str, Any]
Report = dict[str, Any]

Floats = NDArray[np.float64]
#: One hue for each pad or model, dark enough for print.
HUES = ("#1b5e9e", "#c4541a", "#2e7d4f", "#7a4f9a", "#5f5f5f")
PROBES_MM = (2.0, 3.0, 4.0, 5.0, 6.0)
COLOURS = {
    "none": "#8c959f",
    "published": "#cf222e",
    "asymmetric": "#0969da",
}


def draw_report(report: Report) -> dict[str, bytes]:
    """Every picture by its file name."""
    import matplotlib as mpl

    with mpl.rc_context({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3}):
        return {
            "pareto.png": _pareto(report),
            "errors.png": _errors(report),
            "cycles.png": _cycles(report),
            "touched.png": _touched(report),
            "false_touches.png": _false_touches(report),
            "drift.png": _drift(report),
        }


def _figure(width: float = 7.0, height: float = 3.8) -> tuple[Any, Any]:
    figure = new_figure(width, height)
    return figure, figure.add_subplot()


def _pareto(report: Report) -> bytes:
    figure, axes = _figure()
    lines = report["summary"]
    for line in lines:
        every_sample = line["update_s"] == 0.0
        marker = "o" if every_sample else "s"
        axes.scatter(
            line["ns_per_taxel_step"],
            line["rms_kpa"],
            color=COLOURS[line["model"]],
            marker=marker,
            s=55,
            zorder=3,
            label=None if every_sample else line["model"],
        )
    front = sorted((line["ns_per_taxel_step"], line["rms_kpa"]) for line in lines if line["pareto"])
    axes.plot(*zip(*front, strict=True), color="#57606a", lw=1, ls="--", label="Pareto front")
    (copy,) = [
        row["ns_per_taxel_step"]
        for row in report["speed"]
        if (row["model"], row["dtype"], row["taxels"]) == ("memory_copy", "float64", 1920)
    ]
    axes.axvline(copy, color="#8c959f", lw=1, ls=":", label="copy of memory")
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="ns per taxel-step alone, 1920 taxels",
        ylabel="error, kPa RMS, foam in no family",
        title="Speed against error: squares at 1 Hz, circles every sample",
    )
    axes.margins(x=0.1, y=0.15)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return png(figure)


def _errors(report: Report) -> bytes:
    figure, axes = _figure(height=4.2)
    rows = [
        row
        for row in report["rows"]
        if row["noise_units"] == 0.0 and row["scenario"] == "fitted" and row["update_s"] == 1.0
    ]
    models = list(dict.fromkeys(row["model"] for row in rows))
    places = list(dict.fromkeys((row["truth"], row["history"]) for row in rows))
    width = 0.8 / len(models)
    for number, model in enumerate(models):
        values = {
            (row["truth"], row["history"]): row["rms_kpa"] for row in rows if row["model"] == model
        }
        axes.bar(
            np.arange(len(places)) + (number + 0.5) * width - 0.4,
            [max(values[place], 0.01) for place in places],
            width,
            label=model,
            color=COLOURS[model],
        )
    axes.set(yscale="log", ylabel="kPa RMS, exact readings, states at 1 Hz")
    axes.set_xticks(
        np.arange(len(places)), [f"{truth} {name}" for truth, name in places], rotation=70
    )
    axes.legend(ncols=len(models), fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return png(figure)


def _cycles(report: Report) -> bytes:
    figure, axes = _figure()
    rows = [row for row in report["cycles"] if row["model"] in COLOURS]
    truths = [truth for truth in "FS" if any(row["truth"] == truth for row in rows)]
    for truth, style in zip(truths, ("-", "--"), strict=False):
        for model in dict.fromkeys(row["model"] for row in rows):
            mine = [row for row in rows if row["model"] == model and row["truth"] == truth]
            axes.plot(
                [row["cycles"] for row in mine],
                [max(abs(row["unclamped_error_kpa"]), 1e-3) for row in mine],
                style,
                color=COLOURS[model],
                marker=".",
                label=model if truth == truths[0] else None,
            )
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="cycles of 5 s at 50 kPa, 5 s free",
        ylabel="size of the error, kPa",
        title="Does the error grow? Truth F solid, S dashed",
    )
    axes.legend(fontsize=7)
    return png(figure)


def _touched(report: Report) -> bytes:
    figure, axes = _figure()
    for n in sorted({row["taxels"] for row in report["pipeline"]}):
        mine = [row for row in report["pipeline"] if row["taxels"] == n and row["pressures_wanted"]]
        axes.plot(
            [row["touched"] for row in mine],
            [row["ns_per_taxel_step"] * n * 1e-3 for row in mine],
            marker="o",
            label=f"{n} taxels",
        )
        (glance,) = [
            row for row in report["pipeline"] if row["taxels"] == n and not row["pressures_wanted"]
        ]
        axes.scatter(0, glance["ns_per_taxel_step"] * n * 1e-3, marker="x", color="k", zorder=3)
    axes.set(
        xscale="symlog",
        ylim=(0, None),
        xlabel="touched taxels",
        ylabel="us per sweep, bytes to kPa",
        title="Cost against touch; crosses: pressures not wanted",
    )
    axes.legend()
    return png(figure)


def _false_touches(report: Report) -> bytes:
    figure, axes = _figure()
    rows = [row for row in report["false_touches"] if row["noise_units"] is not None]
    for votes in sorted({row["votes"] for row in rows}):
        mine = [row for row in rows if row["votes"] == votes]
        # What was never seen is drawn at half an event in the time watched.
        axes.plot(
            [row["noise_units"] for row in mine],
            [max(row["touches_per_taxel_hour"], 0.5 / row["taxel_hours"]) for row in mine],
            marker="o",
            label=f"{votes} of 3",
        )
    axes.set(
        yscale="log",
        xlabel="noise, units",
        ylabel="false touches per taxel-hour",
        title="False touches of untouched skin",
    )
    axes.legend()
    return png(figure)


def _drift(report: Report) -> bytes:
    figure, axes = _figure()
    for rule in ("paper", "proportional"):
        mine = [row for row in report["drift"] if row["rule"] == rule]
        axes.plot(
            [row["rate_units_per_s"] for row in mine],
            [max(row["lag_units"], 1e-3) for row in mine],
            marker="o",
            label=rule,
        )
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="drift, units per s",
        ylabel="lag, units",
        title="Lag of the baseline behind a steady drift",
    )
    axes.legend()
    return png(figure)


@dataclass(frozen=True, slots=True)
class Corrected:
    """A long recording and what the host makes of it, in steps of a second.

    Attributes:
        t_s, momentary_kpa, true_kpa: float64[m], time, C and P*.
        corrected_kpa: by model, float64[m], C - relax.
    """

    t_s: Floats
    momentary_kpa: Floats
    true_kpa: Floats
    corrected_kpa: dict[str, Floats]


@dataclass(frozen=True, slots=True)
class Results:
    """All recordings of a report."""

    area: Scan
    line: Scan
    presses: Presses
    fig_17: Corrected
    fig_18: Corrected
    hour_s: float
    grasps: list[Grasp]


def draw_rig(results: Results) -> dict[str, bytes]:
    """Every picture, PNG, by its file name.

    Raises:
        ImportError: matplotlib is not installed (the extra `plots`).
    """
    import matplotlib as mpl

    pictures = {}
    with mpl.rc_context({"axes.spines.top": False, "axes.spines.right": False, "font.size": 9}):
        for name, drawn, size in (
            ("rig_11_12.png", _draw_scans, (10, 4)),
            ("rig_13_16.png", _draw_presses, (10, 7)),
            (
                "rig_17.png",
                lambda figure, all_: _draw_hold(figure, all_.fig_17, "Fig. 17"),
                (10, 5),
            ),
            (
                "rig_18.png",
                lambda figure, all_: _draw_hold(figure, all_.fig_18, "Fig. 18"),
                (10, 5),
            ),
        ):
            figure = new_figure(*size)
            drawn(figure, results)
            pictures[name] = png(figure, 130)
    return pictures


def _draw_scans(figure: Any, results: Results) -> None:
    left, right = figure.subplots(1, 2)
    area = results.area
    strongest = np.nan_to_num(np.nanmax(area.s_ff, axis=1))
    mesh = left.tricontourf(area.x_mm, area.y_mm, strongest, levels=12, cmap="Blues")
    figure.colorbar(mesh, ax=left, label="fF", shrink=0.8)
    rig = PalmRig()
    for centre, radius, c0_ff in zip(
        rig.pads.centre_mm, rig.pads.radius_mm, rig.pads.c0_ff, strict=True
    ):
        if area.x_mm.min() < centre[0] < area.x_mm.max() and centre[1] > area.y_mm.min():
            left.add_patch(_circle(centre, float(radius), thermal=c0_ff == 0))
    for name in NAMED_PADS:
        left.annotate(str(name), rig.centre_mm(name), ha="center", va="center", weight="bold")
    left.set(
        title="Fig. 11: all pads at 150-160 kPa, 3 mm probe",
        xlabel="x (mm)",
        ylabel="y (mm)",
        aspect="equal",
    )
    line = results.line
    for colour, (name, pad) in zip(HUES, NAMED_PADS.items(), strict=False):
        mean, sd = line.s_ff[:, pad], line.sd_ff[:, pad]
        right.plot(line.x_mm, mean, color=colour, label=f"pad {name}")
        right.fill_between(line.x_mm, mean - sd, mean + sd, color=colour, alpha=0.2, lw=0)
    right.set(title="Fig. 12: along a line through the pads", xlabel="x (mm)", ylabel="fF")
    right.legend(frameon=False)


def _circle(centre: Any, radius: float, *, thermal: bool) -> Any:
    """A pad's outline; dashed where it feels temperature only."""
    from matplotlib.patches import Circle

    style = "--" if thermal else "-"
    return Circle(tuple(centre), radius, fill=False, lw=0.8, ls=style, color="#444444")


def _draw_presses(figure: Any, results: Results) -> None:
    axes = figure.subplots(2, 2).ravel()
    panels = (
        ("Fig. 13: pad 2, probes of 2 to 6 mm", [(2, size) for size in PROBES_MM], (0, 250)),
        ("Fig. 14: pads 1, 2, 3, 3 mm probe", [(pad, 3.0) for pad in (1, 2, 3)], (0, 250)),
        ("Fig. 15: pads 1, 2, 3, 6 mm probe", [(pad, 6.0) for pad in (1, 2, 3)], (0, 90)),
        ("Fig. 16: pad 2, small pressures", [(2, 5.0), (2, 6.0)], (0, 40)),
    )
    for ax, (title, curves, limits) in zip(axes, panels, strict=True):
        for colour, (pad, size) in zip(HUES, curves, strict=False):
            pressure, mean, sd = results.presses.curve(pad, size)
            shown = pressure < limits[1]
            ax.errorbar(
                pressure[shown],
                mean[shown],
                sd[shown],
                fmt="o",
                ms=3,
                elinewidth=0.9,
                color=colour,
                label=f"pad {pad}, {size:.0f} mm",
            )
        ax.set(title=title, xlabel="pressure of the load cell (kPa)", ylabel="fF", xlim=limits)
        ax.set_ylim(bottom=0)
        ax.legend(frameon=False)


def _draw_hold(figure: Any, corrected: Corrected, title: str) -> None:
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    hours = corrected.t_s / 3600
    top.plot(hours, corrected.momentary_kpa, color="#9a9a9a", lw=0.8, label="C, uncorrected")
    top.plot(hours, corrected.true_kpa, color="black", lw=1.2, label="P*, load cell")
    for colour, (name, pressure) in zip(HUES, corrected.corrected_kpa.items(), strict=False):
        top.plot(hours, pressure, color=colour, lw=0.8, label=f"C - relax, {name}")
        bottom.plot(hours, pressure - corrected.true_kpa, color=colour, lw=0.8)
    top.set(title=f"{title}: relaxation and its correction", ylabel="kPa")
    top.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    bottom.axhline(0, color="black", lw=0.5)
    bottom.set(xlabel="hours", ylabel="error (kPa)")
