"""Fits the foam's relaxation to a hold and its release."""

import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skin_host.config.relaxation import RELAXATION_SCHEMA
from skin_host.config.settings import Settings
from skin_host.errors import RequestError
from skin_host.files import write_document
from skin_host.processing.fitting.course import LONGEST_LAG_S
from skin_host.processing.fitting.hold import Fit, HoldRecord, fit, merge
from skin_host.processing.pressure import PressureCurve
from skin_host.recording.fitting.fitted import finite
from skin_host.recording.fitting.samples import Samples, gap_error
from skin_host.recording.load_table import LoadTable, check_course, check_covers, on_clock_of
from skin_host.recording.plausibility import check_ratio

Floats = NDArray[np.float64]

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
            raise gap_error(gap, samples, "while press and release move the reading")
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


def _error(found: Fit) -> float:
    known = [x for x in (found.rms_hold_kpa, found.rms_rest_kpa) if np.isfinite(x)]
    return float(np.sqrt(np.mean(np.square(known))))
