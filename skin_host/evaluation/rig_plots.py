"""Recordings of `skin report --rig` and their pictures, one for each figure of section VI."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.probes.bench import NAMED_PADS, PalmRig
from emulator.probes.experiments import Presses, Scan
from skin_host.evaluation.cup_grasp import Grasp
from skin_host.evaluation.document import new_figure, png

Floats = NDArray[np.float64]

#: One hue for each pad or model, dark enough for print.
COLOURS = ("#1b5e9e", "#c4541a", "#2e7d4f", "#7a4f9a", "#5f5f5f")
PROBES_MM = (2.0, 3.0, 4.0, 5.0, 6.0)
PALM_PITCH_MM = 0.5


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


def draw(results: Results) -> dict[str, bytes]:
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
    for colour, (name, pad) in zip(COLOURS, NAMED_PADS.items(), strict=False):
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
        for colour, (pad, size) in zip(COLOURS, curves, strict=False):
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
    for colour, (name, pressure) in zip(COLOURS, corrected.corrected_kpa.items(), strict=False):
        top.plot(hours, pressure, color=colour, lw=0.8, label=f"C - relax, {name}")
        bottom.plot(hours, pressure - corrected.true_kpa, color=colour, lw=0.8)
    top.set(title=f"{title}: relaxation and its correction", ylabel="kPa")
    top.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    bottom.axhline(0, color="black", lw=0.5)
    bottom.set(xlabel="hours", ylabel="error (kPa)")
