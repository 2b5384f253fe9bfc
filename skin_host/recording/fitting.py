"""Fits parameters to recordings: the foam's relaxation, and the pressure curve of each taxel.

The recording begins with some seconds of untouched skin, which serve as its calibration. Curves and
gains are those of the boards that were pressed in it: limbs are fitted one after the other.
"""

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from skin_host.config.relaxation import RELAXATION_SCHEMA
from skin_host.config.settings import Settings
from skin_host.errors import LogError, RequestError
from skin_host.files import write_document
from skin_host.layout import Layout, PadKind, PartLayout
from skin_host.processing import calibration as calibrations
from skin_host.processing.calibration import Calibration, Verdict, with_curves, with_gains
from skin_host.processing.core import Engine
from skin_host.processing.curves import Curves, CurveVerdict, TableCurve, common_curve
from skin_host.processing.fitting.course import (
    LONGEST_LAG_S,
    PRESSED_QUANTILES,
    Course,
    GainFit,
    activations,
    find_lag,
    fit_course,
    fit_gains,
    following,
    median_of_moving,
    moves,
    shown,
)
from skin_host.processing.fitting.hold import Fit, HoldRecord, fit, merge
from skin_host.processing.fitting.memory import unloads
from skin_host.processing.pressure import PressureCurve
from skin_host.processing.relaxation import make_model, parameters_of
from skin_host.recording import seconds as in_seconds
from skin_host.recording.load_table import (
    LoadTable,
    check_course,
    check_covers,
    check_untouched,
    longest_gap_s,
    on_clock_of,
    without_spikes,
)
from skin_host.recording.plausibility import check_ratio, describe_ratio
from skin_host.recording.replay import calibrate_from_log, steps

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: A taxel takes part in a hold if its reading is at least this share of the strongest.
TAKES_PART = 0.6
#: Quantile of a taxel's readings that represents its pressed time: the recording may be mostly
#: rest.
PRESSED_QUANTILE = 0.95
#: A hold has at least this pressure, for at least this share of its time.
LEAST_KPA = 10.0
HELD_SHARE = 0.98
#: A fit that leaves this share of the hold's level as its error, and this pressure, describes
#: another hold. Foam loses some tens of percent of a hold; what loses more has another pressure.
FITTED_SHARE = 0.1
FITTED_KPA = 2.0
MOST_TAKEN = 0.6
#: Pressure moves if it changes by more than this share of the hold's from one sample to the next.
MOVING_SHARE = 0.1
#: A plateau of known pressure lasts at least this long, and is steady to this share of itself.
PLATEAU_S = 1.0
STEADY_SHARE = 0.05
STEADY_KPA = 3.5
#: Less than this, or than this share of the earlier press, is the residual of that press.
PRESSED_KPA = 4.0
IMPRINT_SHARE = 0.07
#: A board is pressed if at least this share of its usable pads are. Of fewer, as at the edge of a
#: bag of air on its neighbour, the pressure is not known.
PRESSED_SHARE = 0.25
#: Pressures belong to a recording if at least this share of the pads of pressed boards that answer
#: can be fitted.
LEAST_FITTED = 0.5
#: Recordings have times in microseconds.
LEAST_STEP_NS = 1000
#: A recording lasts at most so many times as long as the samples that were received.
MOST_MISSING = 10
WANTED = "wanted a recording of one hold, or of levels, without such a step"
#: The first part of a plateau, in which the pressure settles, is left out.
SETTLING_SHARE = 0.3


class Gap(NamedTuple):
    """A time in which nothing of a board was received.

    Attributes:
        board: its name.
        taxels: bool[n], what it reads of one part.
        rows: samples which repeat what was received before; the next is what came after.
        seconds: how long it lasted.
    """

    board: str
    taxels: Mask
    rows: slice
    seconds: float


@dataclass(frozen=True)
class Samples:
    """A recording as bytes at equal distances: t samples of the n taxels of the skin.

    Attributes:
        dt_s: distance of the samples.
        start_s: time of the first sample, on the recording's clock.
        raw: uint8[t, n]; the last known value where none was received.
        zero: float64[n], the untouched reading.
        received: bool[n], taxels that were received at all.
        usable: bool[n], usable taxels.
        calibration: of the untouched skin at the beginning.
        zero_s: how long that was.
        gaps: of the boards that were received, longer than a table of pressure may have them.
    """

    dt_s: float
    start_s: float
    raw: NDArray[np.uint8]
    zero: Floats
    received: Mask
    usable: Mask
    calibration: Calibration
    zero_s: float
    gaps: tuple[Gap, ...] = ()

    def units(self, rows: slice, taxels: Mask) -> Floats:
        """Activations above the baseline of some samples and taxels."""
        units: Floats = self.zero[taxels] - self.raw[rows, taxels]
        return units


Found = TypeVar("Found", Curves, GainFit)


@dataclass(frozen=True)
class Fitted(Generic[Found]):
    """A calibration with what a recording under known pressure has shown, and that alone.

    Attributes:
        calibration: that of the recording where boards were pressed; elsewhere the one before.
        found: what was fitted, only to the pads of boards that were pressed.
        pressed: bool[n], the pads that were received of these boards.
        ratio: known pressures over those of the common curve, of the median pad.
        unshown: bool[n], those of them of which the recording does not show a curve.
        unloads: whether the foam's hysteresis is known, by this recording or before it.
        memory_kept: whether it is the one before, because pads keep their curves.
    """

    calibration: Calibration
    found: Found
    pressed: Mask
    ratio: float
    unshown: Mask
    unloads: bool = True
    memory_kept: bool = False


def read_samples(
    log: Path,
    settings: Settings,
    layout: Layout,
    seconds: float,
    progress: Callable[[float], None] = lambda _: None,
) -> Samples:
    """Read a recording whose first `seconds` are untouched.

    `progress` is called now and then with the number of minutes read.

    Raises:
        LogError: unreadable, or with too little of this skin in it.
    """
    calibration = calibrate_from_log(log, settings, layout, seconds)
    engine = Engine(settings, layout, list(range(len(layout.parts))), calibration)
    times_ns: list[list[int]] = [[] for _ in layout.parts]
    raws: list[list[NDArray[np.uint8]]] = [[] for _ in layout.parts]
    valids: list[list[Mask]] = [[] for _ in layout.parts]
    for step in steps(log, engine):
        times_ns[step.part].append(step.frame.t_ns)
        raws[step.part].append(step.frame.raw)
        valids[step.part].append(step.frame.valid)
        if step.frame.seq % 500 == 0:
            progress((step.frame.t_ns - times_ns[step.part][0]) / 60e9)
    heard = [part for part, times in enumerate(times_ns) if len(times) > 10]
    if not heard:
        raise LogError(f"{log}: ten sweeps or fewer; wanted a recording of a hold or of levels")
    first_ns = min(times_ns[part][0] for part in heard)
    last_ns = max(times_ns[part][-1] for part in heard)
    steps_ns = [np.diff(times_ns[part]) for part in heard]
    step_ns = round(min(float(np.median(mine)) for mine in steps_ns))
    if (back_ns := min(int(mine.min()) for mine in steps_ns)) < 0:
        raise LogError(
            f"{log}: its time goes back by {in_seconds(-back_ns)}: the clock was set; {WANTED}"
        )
    if step_ns < LEAST_STEP_NS:
        raise LogError(f"{log}: its time stands still; {WANTED}")
    if last_ns - first_ns > MOST_MISSING * step_ns * max(map(len, steps_ns)):
        gap_ns = max(int(mine.max()) for mine in steps_ns)
        raise LogError(
            f"{log}: a gap of {gap_ns / 1e9:.0f} s: the clock was set, or the skin was not "
            f"received; {WANTED}"
        )
    grid_ns = np.arange(first_ns, last_ns, step_ns)
    raw = np.zeros((len(grid_ns), layout.n_taxels), dtype=np.uint8)
    usable = np.zeros(layout.n_taxels, dtype=np.bool_)
    gaps: list[Gap] = []
    for part in heard:
        mine = slice(layout.parts[part].start, layout.parts[part].stop)
        valid = np.array(valids[part])
        index = np.searchsorted(times_ns[part], grid_ns, side="right").clip(1) - 1
        raw[:, mine] = _held(np.array(raws[part]), valid)[index]
        usable[mine] = calibration.usable[mine] & (valid.mean(axis=0) > 0.5)
        gaps += _gaps_of(layout, layout.parts[part], np.array(times_ns[part]), valid, grid_ns)
    zero = layout.no_load - calibration.baseline
    received = ~np.isin(calibration.verdict, (Verdict.ABSENT, Verdict.TOO_FEW))
    return Samples(
        step_ns * 1e-9,
        first_ns * 1e-9,
        raw,
        zero,
        received,
        usable,
        calibration,
        seconds,
        tuple(gaps),
    )


def _gaps_of(
    layout: Layout,
    part: PartLayout,
    times_ns: NDArray[np.int64],
    valid: Mask,
    grid_ns: NDArray[np.int64],
) -> Iterator[Gap]:
    """Yield the gaps of the boards of a part that were received.

    Args:
        layout: of the skin.
        part: one of it.
        times_ns: int64[f], of its frames.
        valid: bool[f, k], its taxels.
        grid_ns: int64[t], of the samples.
    """
    for board, taxels in _boards_of(layout, part):
        came_ns = times_ns[valid[:, taxels[part.start : part.stop]].any(axis=1)]
        if len(came_ns) < 2:
            continue
        longest_ns = longest_gap_s(np.diff(came_ns) * 1e-9) * 1e9
        # Before its first frame the skin is untouched as it is then.
        edges_ns = np.concatenate([came_ns, grid_ns[-1:]])
        for gap in np.flatnonzero(np.diff(edges_ns) > longest_ns).tolist():
            begin_ns, end_ns = edges_ns[gap : gap + 2].tolist()
            rows = slice(
                int(np.searchsorted(grid_ns, begin_ns, side="right")),
                int(np.searchsorted(grid_ns, end_ns)),
            )
            yield Gap(board, taxels, rows, (end_ns - begin_ns) * 1e-9)


def _boards_of(layout: Layout, part: PartLayout) -> Iterator[tuple[str, Mask]]:
    """Yield the boards of a part by name, each with what it reads of this part, bool[n]."""
    for board in part.boards:
        mine = layout.taxels_of([board])
        mine[: part.start] = mine[part.stop :] = False
        yield layout.boards[board].name, mine


def hold_record(
    samples: Samples,
    curve: PressureCurve,
    load: LoadTable | None,
    weight_kpa: float | None,
) -> HoldRecord:
    """Find the hold and the release in a recording.

    Args:
        samples: of the recording.
        curve: of its taxels.
        load: a load cell's table, on the recording's clock or from its start, if there was one.
        weight_kpa: the pressure of a dead weight that was laid on and taken off again.

    Raises:
        RequestError: nothing was pressed for long, or more than once, or it was not released; or
            the table is no course of pressure in kPa, or does not cover the hold; or the press or
            the release lies in a gap.
    """
    # Some thousand samples show which taxels take part; only for those the whole is used.
    thin = slice(None, None, max(len(samples.raw) // 4000, 1))
    everyone = np.ones_like(samples.usable)
    strongest = np.quantile(curve.kpa(samples.units(thin, everyone)), PRESSED_QUANTILE, axis=0)
    strongest *= samples.usable
    chosen = strongest >= max(TAKES_PART * strongest.max(), LEAST_KPA)
    if not chosen.any():
        raise RequestError(
            f"no taxel was held above {LEAST_KPA:g} kPa; wanted a hold and a release, "
            "the first seconds untouched"
        )
    momentary = curve.part(chosen).kpa(samples.units(slice(None), chosen)).mean(axis=1)
    gaps = [gap for gap in samples.gaps if np.any(gap.taxels & chosen)]
    for gap in gaps:
        around = momentary[max(gap.rows.start - 1, 0) : gap.rows.stop + 1]
        if np.ptp(around) > MOVING_SHARE * strongest[chosen].mean():
            raise _gap_error(gap, samples, "while press and release move the reading")
    held = momentary > 0.5 * strongest[chosen].mean()
    start = int(np.argmax(held))
    release = len(held) - int(np.argmax(held[::-1]))
    if release >= len(held) - 10 / samples.dt_s:
        raise RequestError("the recording ends before the release; wanted 10 s of rest or more")
    presses = int(np.count_nonzero(held[start + 1 : release] & ~held[start : release - 1])) + 1
    if np.mean(held[start:release]) < HELD_SHARE:
        raise RequestError(
            f"the skin was pressed {presses} times; wanted one hold at one level and its release"
        )
    pressure = np.full(len(momentary), np.nan)
    pressure[release:] = 0.0
    lag_s = 0.0
    if weight_kpa is not None:
        pressure[start:release] = weight_kpa
    elif load is not None:
        check_course(load)
        load = on_clock_of(load, samples.start_s)
        now_s: Floats = samples.start_s + samples.dt_s * np.arange(len(momentary), dtype=np.float64)
        above: Floats = momentary - 0.5 * float(strongest[chosen].mean())
        lag_s = _edge_lag(above, now_s, start, release, load)
        load = load._replace(time_s=load.time_s - lag_s)
        check_covers(load, float(now_s[start]), float(now_s[release]), "hold")
        inside = (now_s >= load.time_s[0]) & (now_s <= load.time_s[-1])
        pressure = np.where(inside, np.interp(now_s, load.time_s, load.kpa), pressure)
    # During movement, reading and load cell are not of the same moment.
    moving = np.abs(np.diff(momentary)) > MOVING_SHARE * strongest[chosen].mean()
    pressure[:-1][moving] = np.nan
    pressure[1:][moving] = np.nan
    for gap in gaps:
        pressure[gap.rows] = np.nan
    record = merge(samples.dt_s, momentary, pressure, start, release)
    held_units = np.median(samples.units(slice(start, release), chosen), axis=0)
    half = 0.5 * np.array([[-1.0], [1.0]])
    low, high = curve.part(chosen).kpa(held_units + half)
    unit_rms_kpa = float(np.mean(high - low) / np.sqrt(12.0 * np.count_nonzero(chosen)))
    return replace(record, unit_rms_kpa=unit_rms_kpa, lag_s=lag_s)


def _edge_lag(above: Floats, now_s: Floats, start: int, release: int, load: LoadTable) -> float:
    """Return by how many seconds a table's clock is ahead, from press and release.

    Creep makes a held reading follow its pressure late, which a fit of the whole course would take
    for a lag; at half of the level both pass within the time of the movement. A slow press is
    passed too early by one of them, and its release too late by the same: their mean is right.

    Args:
        above: reading above half of its level [t].
        now_s: float64[t], of the samples.
        start, release: the first sample of the press, and of the release.
        load: on the recording's clock as far as it is known.

    Returns:
        0 if the table has neither press nor release within `LONGEST_LAG_S` of them.
    """
    step_s = float(now_s[1] - now_s[0])
    around_s = np.arange(now_s[0] - LONGEST_LAG_S, now_s[-1] + LONGEST_LAG_S, step_s)
    kpa = np.interp(around_s, load.time_s, load.kpa)
    level_kpa = kpa - 0.5 * float(np.quantile(kpa, PRESSED_QUANTILE))
    found = []
    for sign, reading in ((1.0, start), (-1.0, release)):
        rising = sign * level_kpa > 0.0
        edges = np.flatnonzero(rising[1:] & ~rising[:-1]) + 1
        if reading == 0 or not len(edges):
            continue
        reading_s = _passed_s(above, now_s, reading)
        table_s = np.array([_passed_s(level_kpa, around_s, edge) for edge in edges.tolist()])
        nearest_s = float(table_s[int(np.argmin(np.abs(table_s - reading_s)))]) - reading_s
        if abs(nearest_s) <= LONGEST_LAG_S:
            found.append(nearest_s)
    return round(float(np.mean(found)), 3) if found else 0.0


def _passed_s(values: Floats, time_s: Floats, row: int) -> float:
    """Return when values [t] pass 0 between the row before and this one."""
    before, here = float(values[row - 1]), float(values[row])
    share = before / (before - here) if before != here else 1.0
    return float(time_s[row - 1] + min(max(share, 0.0), 1.0) * (time_s[row] - time_s[row - 1]))


def fit_relaxation(record: HoldRecord, models: Sequence[str]) -> list[Fit]:
    """Fit models to a record, the best first."""
    fits = [fit(model, record) for model in models]
    return sorted(fits, key=_error)


def save_relaxation(path: Path, found: Fit, settings: Settings, record: HoldRecord) -> None:
    """Write a file for `processing.relaxation.file`, completely or not at all.

    Raises:
        RequestError: the model does not describe the record, so its pressure is probably not
            that of the hold.
    """
    chosen = found.parameters
    _check_fit(found, record)
    document: dict[str, Any] = {
        "schema": RELAXATION_SCHEMA,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "robot": settings.robot,
        "model": found.model,
        "beta": list(chosen.beta),
        "tau_s": list(chosen.tau_s),
        "beta_unload": list(chosen.beta_unload),
        "tau_unload_s": list(chosen.tau_unload_s),
        "rms_hold_kpa": finite(found.rms_hold_kpa),
        "rms_rest_kpa": finite(found.rms_rest_kpa),
        "hold_s": record.hold_s,
        "rest_s": record.rest_s,
        "uncertain": found.uncertain,
        "remarks": list(found.remarks),
    }
    write_document(path, document)


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
    _check_gaps(samples, moving)
    boards = _pressed_boards(moving, samples, layout)
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
    _check_share(result.fitted, usable & (layout.pad_kind == PadKind.PRESSURE), ratio)
    pressed = samples.received & boards
    curves = None if before is None else _without(before.curves, pressed)
    calibration = _renewed(samples, before, pressed, result.gain, result.bend, curves)
    return Fitted(calibration, result, pressed, ratio, np.zeros_like(pressed))


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
    _check_gaps(samples, pads & moves(units, samples.dt_s, PRESSED_QUANTILES))
    now_s: Floats = samples.start_s + samples.dt_s * np.arange(len(samples.raw), dtype=np.float64)
    try:
        lag_s = find_lag(median_of_moving(units[:, pads], samples.dt_s), now_s, (time_s, kpa))
        pressure = np.interp(now_s + lag_s, time_s, kpa)
        steady = np.interp(now_s + lag_s, time_s, without_spikes(load).kpa)
        follows = following(units, pressure, samples.dt_s)
        rise_kpa = steady - np.median(steady[: max(round(samples.zero_s / samples.dt_s), 1)])
        _check_unit(units, rise_kpa, follows & samples.usable, settings, layout)
        check_untouched(steady, samples.zero_s, samples.dt_s)
        boards = _pressed_boards(follows, samples, layout)
        pressed = samples.received & boards
        course = replace(course, there=pads & boards, pressure_kpa=pressure, lag_s=lag_s)
        renewed = pressed & (shown(course) | ~pads)
        kept = None if before is None else _without(before.curves, renewed)
        memory = kept.memory if kept is not None and kept.own.any() else None
        curves = fit_course(course, settings.processing.pressure.smoothing_s, memory)
        ratio = _over_common(curves, settings, layout)
        check_ratio(ratio)
        answering = samples.usable & course.there & (curves.verdict != CurveVerdict.DEAD)
        _check_share(curves.own, answering, ratio)
    except RequestError as error:
        raise RequestError(f"{path}: {error}") from None
    gain, bend = np.ones(layout.n_taxels), np.ones(layout.n_taxels)
    if before is not None:
        gain, bend = (np.where(renewed, 1.0, old) for old in (before.gain, before.bend))
    joined = curves if kept is None else _joined(kept, curves, renewed)
    calibration = _renewed(samples, before, pressed, gain, bend, joined)
    is_kept = memory is not None
    # Without plays the one before was none, or not known.
    known = (is_kept and bool(curves.memory.radius_kpa)) or unloads(steady)
    return Fitted(calibration, curves, pressed, ratio, pressed & ~renewed, known, is_kept)


def _check_gaps(samples: Samples, moving: Mask) -> None:
    """Check that the boards whose pads move, bool[n], were received throughout.

    What is repeated in a gap would be paired with pressures that it does not belong to.

    Raises:
        RequestError: one of them was not.
    """
    for gap in samples.gaps:
        if np.any(gap.taxels & moving):
            raise _gap_error(gap, samples, "throughout")


def _gap_error(gap: Gap, samples: Samples, when: str) -> RequestError:
    return RequestError(
        f"board {gap.board}: nothing of it was received for {gap.seconds:.1f} s, from "
        f"{gap.rows.start * samples.dt_s:.1f} s of the recording on; wanted its readings {when}"
    )


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


def _check_share(fitted: Mask, pads: Mask, ratio: float) -> None:
    """Check that enough of the pads [n] that answer are fitted [n].

    Raises:
        RequestError: the pressures are hardly those of this recording, or show little of it.
    """
    if np.count_nonzero(fitted & pads) < LEAST_FITTED * np.count_nonzero(pads):
        raise RequestError(
            f"{np.count_nonzero(fitted & pads)} of {np.count_nonzero(pads)} pads of the pressed "
            f"boards can be fitted, wanted at least {LEAST_FITTED:.0%}; {describe_ratio(ratio)}"
        )


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


def _pressed_boards(pressed: Mask, samples: Samples, layout: Layout) -> Mask:
    """Return the taxels [n] of each board of each part of which enough pads are pressed, bool[n].

    Raises:
        RequestError: there is none.
    """
    pads = samples.usable & (layout.pad_kind == PadKind.PRESSURE)
    found: Mask = np.zeros_like(pads)
    most = 0.0
    for part in layout.parts:
        for _, mine in _boards_of(layout, part):
            share = float(pressed[mine & pads].mean()) if np.any(mine & pads) else 0.0
            most = max(most, share)
            if share >= PRESSED_SHARE:
                found |= mine
    if not found.any():
        raise RequestError(
            f"no board is pressed: at most {most:.0%} of a board's pads follow the pressure; "
            "wanted all pads of a board under the same pressure"
        )
    return found


def _renewed(
    samples: Samples,
    before: Calibration | None,
    pressed: Mask,
    gain: Floats,
    bend: Floats,
    curves: Curves | None,
) -> Calibration:
    """Return the calibration of a recording where pads were pressed, elsewhere the one before."""
    base = samples.calibration
    if before is not None:
        # Its curves would judge the new zeros, and are replaced.
        base = calibrations.merge(replace(before, curves=None), base, pressed)
    gained = with_gains(
        base, np.where(pressed, gain, base.gain), np.where(pressed, bend, base.bend)
    )
    return with_curves(gained, curves)


def _without(curves: Curves | None, taxels: Mask) -> Curves | None:
    """Return curves with nothing known of some taxels; None if nothing is known of others."""
    if curves is None:
        return None
    left = replace(
        curves,
        beyond_units=np.where(taxels, np.inf, curves.beyond_units),
        error_kpa=np.where(taxels, np.nan, curves.error_kpa),
        verdict=np.where(taxels, CurveVerdict.UNKNOWN, curves.verdict).astype(np.uint8),
    )
    return left if np.any(left.verdict != CurveVerdict.UNKNOWN) else None


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


def _check_fit(found: Fit, record: HoldRecord) -> None:
    hold_kpa = record.pressure_kpa[: record.released]
    if np.isfinite(hold_kpa).any():
        check_ratio(float(np.nanmedian(hold_kpa)) / record.level_kpa)
    errors_kpa = found.rms_hold_kpa, found.rms_rest_kpa
    worst_kpa = max((kpa for kpa in errors_kpa if not math.isnan(kpa)), default=0.0)
    most_kpa = max(FITTED_SHARE * record.level_kpa, FITTED_KPA)
    if worst_kpa >= most_kpa:
        raise RequestError(
            f"{found.model} fits a hold at {record.level_kpa:.0f} kPa to {worst_kpa:.3g} kPa RMS; "
            f"wanted less than {most_kpa:.3g}: is the pressure that of this hold, in kPa, and "
            "processing.pressure the curve of this foam?"
        )
    taken = max(math.fsum(found.parameters.beta), math.fsum(found.parameters.beta_unload))
    if taken >= MOST_TAKEN:
        raise RequestError(
            f"{found.model} takes {taken:.0%} of a hold's pressure away; wanted less than "
            f"{MOST_TAKEN:.0%}: is the pressure that of this hold, in kPa?"
        )


def _held(values: NDArray[np.uint8], valid: Mask) -> NDArray[np.uint8]:
    """Values [t, n] with the last valid one in place of the invalid."""
    rows = np.where(valid, np.arange(len(values))[:, np.newaxis], 0)
    return np.take_along_axis(values, np.maximum.accumulate(rows, axis=0), axis=0)


def _error(found: Fit) -> float:
    known = [x for x in (found.rms_hold_kpa, found.rms_rest_kpa) if np.isfinite(x)]
    return float(np.sqrt(np.mean(np.square(known))))


def finite(value: float) -> float | None:
    """A number for JSON, which has none that are not finite."""
    return value if np.isfinite(value) else None
