"""Pictures of recordings and calibrations: `skin plot` (PNG, SVG or PDF by the suffix)."""

import os
from heapq import merge
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skin_host.client.presence import STALE_S
from skin_host.errors import RequestError, required
from skin_host.files import write_atomic, writing
from skin_host.layout import Layout, PadKind
from skin_host.processing.calibration import Calibration, Verdict
from skin_host.processing.curves import KNOTS_UNITS, Curves, CurveVerdict
from skin_host.processing.events import Touch
from skin_host.recording.export import PartSeries, Series

Floats = NDArray[np.float64]

#: This many lines are distinguishable by their colours.
MOST_LINES = 7
SUFFIXES = (".png", ".svg", ".pdf")
#: Okabe and Ito's colours, for colour-blind readers.
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#000000")
VERDICT_COLOURS = {
    Verdict.OK: "#56b4e9",
    Verdict.NOISY: "#e69f00",
    Verdict.SATURATES: "#f0e442",
    Verdict.TOUCHED: "#009e73",
    Verdict.STUCK: "#d55e00",
    Verdict.OUT_OF_RANGE: "#cc79a7",
    Verdict.TOO_NOISY: "#8c510a",
    Verdict.ABSENT: "#999999",
    Verdict.TOO_FEW: "#333333",
}


def check_format(output: Path) -> None:
    """Check, without a recording, that a picture of this name can be made.

    Raises:
        RequestError: its suffix is another than those of `SUFFIXES`.
        SkinError: matplotlib is not installed.
    """
    if output.suffix not in SUFFIXES:
        raise RequestError(f"{output}: wanted a name that ends in one of {', '.join(SUFFIXES)}")
    find_matplotlib()


def find_matplotlib() -> Any:
    """Return matplotlib, for pictures without a window.

    Raises:
        SkinError: it is not installed.
    """
    os.environ["MPLBACKEND"] = "agg"  # one that it does not know ends its import
    return required("matplotlib", "pictures", "plots")


def plot_pressure(series: Series, output: Path, part: str, taxels: list[int] | None = None) -> None:
    """Draw pressure over time: the named taxels, or the strongest ones; contacts as bars below.

    Raises:
        RequestError: no such part or taxel.
        SkinError: matplotlib is not installed, or the picture cannot be written.
    """
    one = _part(series, part)
    n = one.pressure_kpa.shape[1]
    if taxels is None:
        peaks = np.nan_to_num(one.pressure_kpa, nan=0.0).max(axis=0)
        taxels = [int(i) for i in np.argsort(-peaks)[:MOST_LINES] if peaks[i] > 0] or [0]
    if wrong := [taxel for taxel in taxels if not 0 <= taxel < n]:
        raise RequestError(f"{part} has taxels 0 to {n - 1}; seen {wrong[0]}")
    figure, (top, bottom) = _pyplot().subplots(
        2, 1, figsize=(9, 5), sharex=True, height_ratios=[5, 1], layout="constrained"
    )
    t_s, kpa = _broken(series, one, taxels)
    for i, taxel in enumerate(taxels):
        top.plot(
            t_s,
            kpa[:, i],
            label=f"taxel {taxel}",
            color=COLOURS[i % len(COLOURS)],
            linestyle=("-", "--", ":")[i // len(COLOURS) % 3],
            linewidth=1.2,
        )
    top.set_ylabel(f"pressure of {part} / kPa")
    top.set_ylim(bottom=min(0.0, top.get_ylim()[0]))
    figure.legend(loc="outside upper center", fontsize="small", ncols=MOST_LINES)
    top.grid(alpha=0.3)
    for row, (first_s, last_s) in enumerate(_contacts(series, one)):
        bottom.barh(row % 3, last_s - first_s, left=first_s, height=0.8, color=COLOURS[0])
    bottom.set_yticks([])
    bottom.set_ylabel("contacts")
    bottom.set_xlabel("time / s")
    _write(figure, output)


def plot_map(series: Series, output: Path, part: str, at_s: float | None = None) -> None:
    """Draw the part from above at an instant, or when the sum of its pressures was highest.

    Raises:
        RequestError: no such part or instant, or the recording has no positions of its taxels.
        SkinError: matplotlib is not installed, or the picture cannot be written.
    """
    one = _part(series, part)
    shape = series.shapes.get(part)
    if shape is None or len(shape.pads) != one.pressure_kpa.shape[1]:
        raise RequestError(f"{part}: the recording has no positions of its taxels")
    felt = np.nan_to_num(one.pressure_kpa, nan=0.0)
    row = int(felt.sum(axis=1).argmax())
    if at_s is not None:
        if not one.t_s[0] <= at_s <= one.t_s[-1]:
            first_s, last_s = one.t_s[0], one.t_s[-1]
            raise RequestError(
                f"{part}: no frame at {at_s:g} s; its last is at {last_s:.2f} s, "
                f"its first at {first_s:.2f} s"
            )
        row = int(np.abs(one.t_s - at_s).argmin())
        spanned = (one.t_s[:-1] < at_s) & (at_s < one.t_s[1:])
        between = np.flatnonzero(spanned & _ends(series, one))
        if between.size:
            before = int(between[0])
            raise RequestError(
                f"{part}: nothing is known at {at_s:g} s; the frames before and after are at "
                f"{one.t_s[before]:.2f} and {one.t_s[before + 1]:.2f} s"
            )
    kpa = one.pressure_kpa[row]
    thermal = np.array([pad == "thermal" for pad in shape.pads])
    position_mm = np.array(shape.position_m) @ _face_on(np.array(shape.normal)).T * 1e3
    figure, axes = _pyplot().subplots(figsize=(8, 6), layout="compressed")
    for triangle in shape.triangles:
        outline_m = np.array(triangle.outline_m).reshape(-1, 3)
        outline_mm = outline_m @ _face_on(np.array(shape.normal)).T * 1e3
        axes.fill(*outline_mm[:, :2].T, facecolor="none", edgecolor="#b0b0b0", linewidth=0.8)
    valid = np.isfinite(kpa)
    dots = axes.scatter(
        *position_mm[valid, :2].T,
        c=kpa[valid],
        cmap="cividis",
        vmin=0.0,
        vmax=max(1.0, float(felt.max())),
        s=60,
        edgecolors="#606060",
        linewidths=0.4,
    )
    for mask, marker, label in (
        (~valid & ~thermal, "x", "not valid"),
        (thermal, "s", "feels temperature"),
    ):
        if mask.any():
            style = {"facecolors": "none"} if marker == "s" else {}
            axes.scatter(
                *position_mm[mask, :2].T,
                marker=marker,
                s=22,
                color="#808080",
                linewidths=0.8,
                label=label,
                **style,
            )
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside lower center", ncols=2, fontsize="small")
    figure.colorbar(dots, label="pressure / kPa")
    axes.set_aspect("equal")
    axes.set_xlabel("x / mm")
    axes.set_ylabel("y / mm")
    axes.set_title(f"{part} at {one.t_s[row]:.2f} s")
    _write(figure, output)


def plot_calibration(calibration: Calibration, layout: Layout, output: Path) -> None:
    """Draw the quality of a calibration: baseline, noise and threshold of each taxel, and its
    verdict.

    Raises:
        SkinError: matplotlib is not installed, or the picture cannot be written.
    """
    pressure = layout.pad_kind == PadKind.PRESSURE
    n_parts, curves = len(layout.parts), calibration.curves
    columns = 2 if curves is None else 3
    figure, rows = _pyplot().subplots(
        n_parts,
        columns,
        figsize=(11 if curves is None else 15, 1.2 + 2.1 * n_parts),
        squeeze=False,
        layout="constrained",
    )
    for part, (left, right, *more) in zip(layout.parts, rows, strict=True):
        mine = slice(part.start, part.stop)
        taxel = np.arange(part.n_taxels)
        feels = pressure[mine]
        verdicts = calibration.verdict[mine]
        for verdict in Verdict:
            chosen = feels & (verdicts == verdict)
            if not chosen.any():
                continue
            look = {"color": VERDICT_COLOURS[verdict], "s": 9}
            label = f"{verdict.name.lower().replace('_', ' ')} ({int(chosen.sum())})"
            left.scatter(taxel[chosen], calibration.baseline[mine][chosen], label=label, **look)
            right.scatter(taxel[chosen], calibration.noise[mine][chosen], **look)
        above = calibration.percentile[mine] - calibration.baseline[mine]
        right.plot(taxel[feels], above[feels], ".", markersize=2, color="#444444")
        left.set_ylabel(f"{part.name}\nbaseline / units")
        left.legend(fontsize="x-small", loc="best")
        right.set_ylabel("noise / units")
        for axes in (left, right, *more):
            axes.grid(alpha=0.3)
        if curves is not None:
            _draw_curves(more[0], curves, mine, feels)
    rows[0][1].set_title("noise; grey: 95th percentile above the baseline", fontsize="small")
    rows[0][0].set_title(f"calibration {calibration.id}, {calibration.time}", fontsize="small")
    for axes in rows[-1][:2]:
        axes.set_xlabel("taxel")
    if curves is not None:
        plays = ", ".join(f"{kpa:.0f}" for kpa in curves.memory.radius_kpa) or "none"
        rows[0][2].set_title(f"own curves; plays of {plays} kPa", fontsize="small")
        rows[-1][2].set_xlabel("activation / units")
    _write(figure, output)


def _draw_curves(axes: Any, curves: Curves, mine: slice, feels: NDArray[np.bool_]) -> None:
    """Draw the measured curves of a part, and how many of its pads got each verdict."""
    own = np.flatnonzero(curves.own[mine]) + mine.start
    for taxel in own:
        inside = curves.beyond_units[taxel] + 1.0 >= KNOTS_UNITS
        axes.plot(
            KNOTS_UNITS[inside], curves.kpa[taxel, inside], color=COLOURS[0], lw=0.5, alpha=0.5
        )
    counts = {
        verdict.name.lower(): int(np.sum(feels & (curves.verdict[mine] == verdict)))
        for verdict in CurveVerdict
    }
    text = "\n".join(f"{count} {name}" for name, count in counts.items() if count)
    axes.text(0.03, 0.97, text, transform=axes.transAxes, va="top", fontsize="x-small")
    axes.set_ylabel("pressure / kPa")


def _part(series: Series, part: str) -> PartSeries:
    there = ", ".join(series.parts)
    if part in series.parts:
        return series.parts[part]
    if part in series.fingertips:
        raise RequestError(
            f"{part}: a fingertip on a force/torque board has no taxels to draw; wanted a part of "
            f"skin: {there}; its touches and slips: `skin export`"
        )
    raise RequestError(f'no part "{part}"; there are: {there}')


def _broken(series: Series, part: PartSeries, taxels: list[int]) -> tuple[Floats, Floats]:
    """Return times (s), [m], and pressures of taxels [m, k] with a NaN wherever nothing was known
    for a while: no line is drawn across.
    """
    at = np.flatnonzero(_ends(series, part)) + 1
    kpa = part.pressure_kpa[:, taxels].astype(np.float64)
    return np.insert(part.t_s, at, part.t_s[at - 1]), np.insert(kpa, at, np.nan, axis=0)


def _ends(series: Series, part: PartSeries) -> NDArray[np.bool_]:
    """Return after which frames of a part [n - 1] nothing was known of it for a while."""
    known = np.searchsorted(np.sort(series.gone_ns(part.name)), part.t_ns)
    steps_ns = np.diff(part.t_ns)
    # Frames may be thinned to any rate.
    usual_ns = float(np.median(steps_ns)) if len(steps_ns) else 0.0
    ends: NDArray[np.bool_] = steps_ns > max(STALE_S * 1e9, 2.0 * usual_ns)
    return ends | (np.diff(known) > 0)


def _contacts(series: Series, part: PartSeries) -> list[tuple[float, float]]:
    """Return begin and end (s) of each contact of a part; it ends where nothing is known of it."""
    begun: dict[int, float] = {}
    spans = []
    known_s = 0.0
    gone: list[tuple[int, Touch | None]]
    gone = [(t_ns, None) for t_ns in series.gone_ns(part.name)]
    touches = [(one.t_ns, one) for one in series.touches if one.part == part.name]
    for t_ns, touch in merge(gone, touches, key=lambda one: one[0]):
        at_s = (t_ns - int(part.t_ns[0])) * 1e-9
        if touch is None:
            spans += [(first_s, at_s) for first_s in begun.values()]
            begun.clear()
            known_s = at_s
        elif touch.event == "end":
            spans.append((begun.pop(touch.id, known_s), at_s))
        else:
            begun.setdefault(touch.id, at_s)
    spans += [(first_s, float(part.t_s[-1])) for first_s in begun.values()]
    return sorted(spans)


def _face_on(normal: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return axes [3, 3] in which most of the part faces the viewer; the identity if it is flat."""
    eye = normal.sum(axis=0)
    length = float(np.linalg.norm(eye))
    if length < 1e-9 or eye[2] / length > 0.999:
        return np.eye(3)
    eye = eye / length
    right = np.cross([0.0, 0.0, 1.0] if abs(eye[2]) < 0.9 else [1.0, 0.0, 0.0], eye)
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(eye, right), eye])


def _pyplot() -> Any:
    """Matplotlib's figures without a window.

    Raises:
        SkinError: it is not installed.
    """
    mpl = find_matplotlib()
    mpl.use("Agg")
    mpl.rcParams["text.parse_math"] = False  # a recording's names may look like formulas
    from matplotlib import pyplot

    return pyplot


def _write(figure: Any, output: Path) -> None:
    check_format(output)
    buffer = BytesIO()
    figure.savefig(buffer, format=output.suffix[1:], dpi=110)
    _pyplot().close(figure)
    with writing(output):
        write_atomic(output, buffer.getvalue())
