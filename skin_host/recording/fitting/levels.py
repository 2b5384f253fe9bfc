"""Fits gain and bend of each taxel to plateaus of known pressure."""

import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import Settings
from skin_host.errors import RequestError
from skin_host.layout import Layout, PadKind
from skin_host.processing.calibration import Calibration
from skin_host.processing.fitting.course import PRESSED_QUANTILES, GainFit, fit_gains, moves
from skin_host.processing.pressure import PressureCurve
from skin_host.processing.relaxation import make_model, parameters_of
from skin_host.recording.fitting.fitted import (
    Fitted,
    check_share,
    pressed_boards,
    renewed_calibration,
    without,
)
from skin_host.recording.fitting.samples import Samples, check_gaps
from skin_host.recording.plausibility import check_ratio

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: A plateau of known pressure lasts at least this long, and is steady to this share of itself.
PLATEAU_S = 1.0
STEADY_SHARE = 0.05
STEADY_KPA = 3.5
#: Less than this, or than this share of the earlier press, is the residual of that press.
PRESSED_KPA = 4.0
IMPRINT_SHARE = 0.07
#: The first part of a plateau, in which the pressure settles, is left out.
SETTLING_SHARE = 0.3


def fit_pressures(
    samples: Samples,
    settings: Settings,
    layout: Layout,
    levels_kpa: list[float],
    before: Calibration | None = None,
) -> Fitted[GainFit]:
    """Fit gain and bend of every taxel to plateaus of known uniform pressure, in their order.

    Boards that are not pressed keep what they have in the calibration `before`.

    Raises:
        RequestError: another number of plateaus than of levels was found, nothing is pressed, the
            levels are not those of the plateaus in kPa, or the recording has a gap.
    """
    pressure = settings.processing.pressure
    unit_ff = layout.unit_ff / layout.sensitivity
    curve = PressureCurve(unit_ff, 1.0, pressure.a_kpa_per_ff2, pressure.b_kpa_per_ff)
    everyone = np.ones_like(samples.usable)
    moving = moves(samples.units(slice(None), everyone), samples.dt_s, PRESSED_QUANTILES)
    check_gaps(samples, moving)
    boards = pressed_boards(moving, samples, layout)
    typical = _typical_kpa(samples, curve, settings, moving & samples.usable & boards)
    found = plateaus(typical, samples.dt_s)
    if len(found) != len(levels_kpa):
        seen = ", ".join(
            f"{typical[part].mean():.0f} kPa at {part.start * samples.dt_s:.0f} s" for part in found
        )
        raise RequestError(
            f"plateaus of pressure in the recording: {len(found)} ({seen or 'none'}), "
            f"levels given: {len(levels_kpa)}; wanted one level for each, in their order"
        )
    linear, square = [], []
    for part, kept in zip(found, _kept_shares(samples, curve, settings, found), strict=True):
        ff = samples.units(part, everyone).mean(axis=0) * unit_ff
        linear.append(kept * pressure.b_kpa_per_ff * ff)
        square.append(kept * pressure.a_kpa_per_ff2 * ff**2)
    usable = samples.usable & boards
    common = (np.array(linear) + np.array(square))[:, usable & moving]
    level = np.array(levels_kpa)[:, np.newaxis]
    ratio = float(np.median(np.sum(common * level, axis=0) / np.sum(common**2, axis=0)))
    check_ratio(ratio)
    result = fit_gains(np.array(levels_kpa), np.array(linear), np.array(square), usable)
    check_share(result.fitted, usable & (layout.pad_kind == PadKind.PRESSURE), ratio)
    pressed = samples.received & boards
    curves = None if before is None else without(before.curves, pressed)
    calibration = renewed_calibration(samples, before, pressed, result.gain, result.bend, curves)
    return Fitted(calibration, result, pressed, ratio, np.zeros_like(pressed))


def plateaus(pressure_kpa: Floats, dt_s: float) -> list[slice]:
    """Return where a pressed skin is steady.

    The pressure [t] is that on a typical taxel, corrected for relaxation; otherwise the residual of
    a high pressure would be taken for a low one.

    Returns:
        The plateaus in their order, without the settling time at the beginning of each.
    """
    length = max(round(PLATEAU_S / dt_s), 2)
    if len(pressure_kpa) <= length:
        return []
    windows = np.lib.stride_tricks.sliding_window_view(pressure_kpa, length)
    spread = windows.max(axis=1) - windows.min(axis=1)
    level = windows.mean(axis=1)
    limit = np.maximum(STEADY_KPA, STEADY_SHARE * level)
    before = np.maximum.accumulate(level)
    steady = (spread <= limit) & (level > np.maximum(PRESSED_KPA, IMPRINT_SHARE * before))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], steady, [False]]).astype(np.int8)))
    pieces: list[tuple[int, int]] = []
    for first, last in edges.reshape(-1, 2):
        begin, end = int(first), int(last) + length - 1
        # A moment of noise does not divide a plateau: it continues at the same pressure.
        if pieces and begin - pieces[-1][1] <= length:
            earlier = float(pressure_kpa[slice(*pieces[-1])].mean())
            if abs(float(pressure_kpa[begin:end].mean()) - earlier) <= limit[first]:
                begin = pieces.pop()[0]
        pieces.append((begin, end))
    return [slice(begin + round(SETTLING_SHARE * (end - begin)), end) for begin, end in pieces]


def _typical_kpa(
    samples: Samples, curve: PressureCurve, settings: Settings, pressed: Mask
) -> Floats:
    """Return the pressure [t] on the median of the pressed taxels, corrected for relaxation."""
    curve = curve.part(pressed)
    blocks = [slice(row, row + 1000) for row in range(0, len(samples.raw), 1000)]
    momentary = np.concatenate(
        [np.median(curve.kpa(samples.units(block, pressed)), axis=1) for block in blocks]
    )
    chosen = settings.processing.relaxation
    model = make_model(chosen.model, 1, parameters_of(chosen))
    pressure: Floats = momentary.copy()
    for row in range(len(momentary)):
        pressure[row] -= model.step(momentary[row : row + 1], samples.dt_s)[0]
    return pressure


def _kept_shares(
    samples: Samples, curve: PressureCurve, settings: Settings, parts: list[slice]
) -> list[Floats]:
    """Return the mean share [n] of the momentary pressure that remains after relaxation, for each
    plateau.
    """
    chosen = settings.processing.relaxation
    n = samples.raw.shape[1]
    model = make_model(chosen.model, n, parameters_of(chosen))
    sums = [np.zeros(n) for _ in parts]
    for row, raw in enumerate(samples.raw):
        momentary = curve.kpa(samples.zero - raw)
        relaxation = model.step(momentary, samples.dt_s)
        for part, total in zip(parts, sums, strict=True):
            if part.start <= row < part.stop:
                np.add(
                    total,
                    np.clip(1.0 - relaxation / np.maximum(momentary, 1.0), 0.3, 1.0),
                    out=total,
                )
    return [total / (part.stop - part.start) for part, total in zip(parts, sums, strict=True)]
