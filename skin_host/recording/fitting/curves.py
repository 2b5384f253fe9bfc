"""Fits a curve to each pad, and the foam's memory, from any course of known pressure."""

import sys
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import Settings
from skin_host.errors import RequestError
from skin_host.layout import Layout, PadKind
from skin_host.processing.calibration import Calibration
from skin_host.processing.curves import Curves, CurveVerdict, TableCurve, common_curve
from skin_host.processing.fitting.course import (
    PRESSED_QUANTILES,
    Course,
    activations,
    find_lag,
    fit_course,
    following,
    median_of_moving,
    moves,
    shown,
)
from skin_host.processing.fitting.memory import unloads
from skin_host.recording.fitting.fitted import (
    Fitted,
    check_share,
    pressed_boards,
    renewed_calibration,
    without,
)
from skin_host.recording.fitting.samples import Samples, check_gaps
from skin_host.recording.load_table import (
    LoadTable,
    check_course,
    check_covers,
    check_untouched,
    on_clock_of,
    without_spikes,
)
from skin_host.recording.plausibility import check_ratio

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def fit_curves(
    samples: Samples,
    settings: Settings,
    layout: Layout,
    load: LoadTable,
    before: Calibration | None = None,
) -> Fitted[Curves]:
    """Fit a curve to every pad, and the foam's memory, from any course of known pressure.

    Boards that are not pressed, and pads that the pressure moves too little to show a curve, keep
    what they have in the calibration `before`. If curves are among it, the foam's memory stays as
    well, because it belongs to them.

    `load` is the pressure on all pads alike.

    Raises:
        RequestError: the table is no course of pressure, not of this recording or in another unit,
            or not that of untouched skin at first; nothing is pressed, too few pads can be fitted,
            or the recording has a gap.
    """
    check_course(load)
    path, time_s, kpa = load = on_clock_of(load, samples.start_s)
    end_s = samples.start_s + samples.dt_s * len(samples.raw)
    check_covers(load, samples.start_s, end_s, "recording")
    pads = samples.received & (layout.pad_kind == PadKind.PRESSURE)
    course = Course(samples.dt_s, samples.raw, samples.zero, pads, np.zeros(len(samples.raw)))
    units, _ = activations(course)
    check_gaps(samples, pads & moves(units, samples.dt_s, PRESSED_QUANTILES))
    now_s: Floats = samples.start_s + samples.dt_s * np.arange(len(samples.raw), dtype=np.float64)
    try:
        lag_s = find_lag(median_of_moving(units[:, pads], samples.dt_s), now_s, (time_s, kpa))
        pressure = np.interp(now_s + lag_s, time_s, kpa)
        steady = np.interp(now_s + lag_s, time_s, without_spikes(load).kpa)
        follows = following(units, pressure, samples.dt_s)
        rise_kpa = steady - np.median(steady[: max(round(samples.zero_s / samples.dt_s), 1)])
        _check_unit(units, rise_kpa, follows & samples.usable, settings, layout)
        check_untouched(steady, samples.zero_s, samples.dt_s)
        boards = pressed_boards(follows, samples, layout)
        pressed = samples.received & boards
        course = replace(course, there=pads & boards, pressure_kpa=pressure, lag_s=lag_s)
        renewed = pressed & (shown(course) | ~pads)
        kept = None if before is None else without(before.curves, renewed)
        memory = kept.memory if kept is not None and kept.own.any() else None
        curves = fit_course(course, settings.processing.pressure.smoothing_s, memory)
        ratio = _over_common(curves, settings, layout)
        check_ratio(ratio)
        answering = samples.usable & course.there & (curves.verdict != CurveVerdict.DEAD)
        check_share(curves.own, answering, ratio)
    except RequestError as error:
        raise RequestError(f"{path}: {error}") from None
    gain, bend = np.ones(layout.n_taxels), np.ones(layout.n_taxels)
    if before is not None:
        gain, bend = (np.where(renewed, 1.0, old) for old in (before.gain, before.bend))
    joined = curves if kept is None else _joined(kept, curves, renewed)
    calibration = renewed_calibration(samples, before, pressed, gain, bend, joined)
    is_kept = memory is not None
    # Without plays the one before was none, or not known.
    known = (is_kept and bool(curves.memory.radius_kpa)) or unloads(steady)
    return Fitted(calibration, curves, pressed, ratio, pressed & ~renewed, known, is_kept)


def _check_unit(
    units: Floats, rise_kpa: Floats, follows: Mask, settings: Settings, layout: Layout
) -> None:
    """Check that pressures may be in kPa, before they are compared with any.

    Args:
        units: activations [t, n].
        rise_kpa: by how much the pressure [t] is above that of the zero.
        follows: bool[n], pads that follow it.

    Raises:
        RequestError: see `check_ratio`.
    """
    top = PRESSED_QUANTILES[1]
    if follows.any() and (high_kpa := float(np.quantile(rise_kpa, top))) > 0.0:
        common = common_curve(layout, settings.processing.pressure).part(follows)
        reads_kpa = common.kpa(np.quantile(units[:, follows], top, axis=0))
        check_ratio(high_kpa / max(float(np.median(reads_kpa)), sys.float_info.min))


def _over_common(curves: Curves, settings: Settings, layout: Layout) -> float:
    """Return pressures over those of the common curve, of the median pad at its highest reading.

    Raises:
        RequestError: no pad has a curve.
    """
    own = curves.own
    if not own.any():
        raise RequestError(
            "no pad is good: the pressures that they report differ too much from the known ones; "
            "is it the pressure of this recording?"
        )
    end = curves.beyond_units[own]
    common = common_curve(layout, settings.processing.pressure).part(own)
    return float(np.median(TableCurve(curves.kpa[own], end).kpa(end) / common.kpa(end)))


def _joined(kept: Curves, new: Curves, taxels: Mask) -> Curves:
    """Return the new curves of some taxels, and those of the others that are kept."""
    highest_kpa = max(kept.highest_kpa, new.highest_kpa) if kept.own.any() else new.highest_kpa
    return Curves(
        np.where(taxels[:, np.newaxis], new.kpa, kept.kpa),
        np.where(taxels, new.beyond_units, kept.beyond_units),
        np.where(taxels, new.noise_units, kept.noise_units),
        np.where(taxels, new.error_kpa, kept.error_kpa),
        np.where(taxels, new.verdict, kept.verdict),
        highest_kpa,
        new.lag_s,
        new.memory,
    )
