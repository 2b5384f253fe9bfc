"""The pictures of the report, as PNG files in memory."""

from typing import Any

import numpy as np

from skin_host.evaluation.document import new_figure, png

Row = dict[str, Any]
Report = dict[str, Any]

COLOURS = {
    "none": "#8c959f",
    "published": "#cf222e",
    "asymmetric": "#0969da",
}


def draw(report: Report) -> dict[str, bytes]:
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
