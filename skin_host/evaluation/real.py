"""`skin report --real`: false touches, detection, flicker and kPa on recordings of real skin.

Each recording passes through the engine that the daemon runs, from CAN frames to touch events.
Its zero is taken from its own first seconds, its pressure curves from the calibration recording
of the same foam, and from no other data.
"""

import time
from concurrent.futures import Future, as_completed
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import Settings
from skin_host.errors import RequestError
from skin_host.evaluation import insole, page, tables
from skin_host.evaluation.document import as_text, write
from skin_host.evaluation.goals import goal
from skin_host.evaluation.insole import ZERO_S, InsoleRecording
from skin_host.evaluation.machine import machine
from skin_host.evaluation.steps import show_step
from skin_host.layout import Layout, build_layout
from skin_host.processes import Processes
from skin_host.processing.calibration import Calibration, Verdict, with_pressures_of
from skin_host.processing.core import Engine
from skin_host.recording.fitting import Samples, fit_curves
from skin_host.recording.load_table import LoadTable, check_course, check_covers
from skin_host.recording.replay import calibrate_from_log, steps
from skin_host.recording.turns import fed

Row = dict[str, Any]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

SCHEMA = "skin.real/1"
#: Beside a checkout of the project; not part of it.
RECORDINGS = Path("../shared/data/insole")
GRASPS = "icub_grasp.log"
#: A recording is calibrated on the one of its foam: the first word of its name, and this.
CALIBRATION = "_calibration"
#: Nothing is pressed for so long: a touch in it is false.
UNTOUCHED_S = 10.0
#: Pads that move at all and never read less than this in the first seconds are alive.
LOWEST_LIVE = 100
#: A pad that is invalid for longer than half of a recording is not usable in it: it jumps.
VALID_SHARE = 0.5
LEVELS_KPA = (60.0, 40.0)
WITHIN_S = 1.0
#: The load is gone when the pressure stays within this of rest: the skin's resolution by its paper,
#: which is below the threshold of every pad.
GONE_KPA = 5.0
#: What is touched for so long afterwards is not the foam that comes back late, but stays.
AFTERWARDS_S = 10.0
#: An error of the pressure that every usable pad must detect: it shows a press where none is, or
#: hides one.
FAR_KPA = LEVELS_KPA[0]
#: The pressure's own record has electrical spikes of one sample: a median over so many.
SPIKE_SAMPLES = 5
#: How far sweeps and pressures may be apart where one lag is fitted to a whole file.
LARGEST_LAG_S = 3.0
#: By which shares the pressure's clock may be faster, where its rate is fitted as well.
RATES = np.arange(-20, 21) * 1e-3
#: A quick report measures these, where they are.
QUICK = ("left_calibration", "left_validation_1")
GRASPS_UNTOUCHED_S = 6.0

SOURCE = "Belli et al., Sensors 2023, 23(9), 4501, for the same recordings"
#: What others reach, fitted on left_calibration: RMSE over a whole recording, then over pads.
PUBLISHED: tuple[Row, ...] = (
    {
        "method": "polynomial of degree 3, 40 past samples to degree 4, a model a pad",
        "recording": "left_validation_1",
        "pads": 74,
        "median_rmse_kpa": 12.8,
        "p95_rmse_kpa": 26.5,
        "source": SOURCE,
    },
    {
        "method": "a straight line a pad (the calibration before it)",
        "recording": "left_validation_1",
        "pads": 88,
        "median_rmse_kpa": 13.0,
        "p95_rmse_kpa": 37.2,
        "source": SOURCE,
    },
)
#: What is known in hindsight.
AS_REPORTED = "nothing: as reported"
ONE_LINE = "gain and offset of the whole skin"
COMMON_ERROR = "the error that all pads have in common, at each moment"
OWN_CURVES = "the best rising curve of each pad"
#: A curve is found over means of this many equal shares of the samples.
SHARES = 400


@dataclass(frozen=True)
class PlayedCourse:
    """What the engine made of a recording: f frames of its 280 pads.

    Attributes:
        t_ns: int64[f], time of each frame.
        sweep: int64[f], which sweep of the recording it is.
        pressure_kpa, touched, valid: [f, 280].
        begun_ns: int64[e], when touches began.
    """

    t_ns: NDArray[np.int64]
    sweep: NDArray[np.int64]
    pressure_kpa: NDArray[np.float32]
    touched: Mask
    valid: Mask
    begun_ns: NDArray[np.int64]


def run(
    quick: bool,
    output: Path | None,
    recordings: Path | None = None,
    *,
    with_emulation: bool = False,
    may_be_absent: bool = False,
) -> Row:
    """Measure every recording of a folder.

    Args:
        quick: only `QUICK`.
        output: folder for real.json, real.html and real.md, or None.
        recordings: the folder; if not given, `RECORDINGS` where it is there.
        with_emulation: whether emulated pads are set beside the recorded ones, which takes minutes.
        may_be_absent: whether `RECORDINGS` may have none: it lies beside some checkouts only.

    Returns:
        `real`, a row for each recording, none if there are none; `published`, the
        figures of others; `grasps`, or None; `emulated`, emulated pads beside those of
        `left_calibration`, if `with_emulation`; `absent`, the folder that does not exist, or None.

    Raises:
        RequestError: the folder has no recording.
        LogError: one of them is damaged.
        OSError: `output` cannot be written.
    """
    start_s, here = time.perf_counter(), machine()
    folder = RECORDINGS if recordings is None else recordings
    paths = sorted(folder.glob("*.npz"))
    if not paths and recordings is not None:
        raise RequestError(f"{folder}: no recording in it; wanted a folder with .npz files")
    if not paths and not may_be_absent:
        raise RequestError(_absent(folder))
    if quick:
        paths = [path for path in paths if path.stem in QUICK] or paths[:1]
    grasp_log = folder.parent / GRASPS
    show_step("real skin")
    with Processes() as processes:
        grasping = processes.submit(grasps, grasp_log) if grasp_log.exists() else None
        known = {_foam(path): _calibration_path(_foam(path), folder) for path in paths}
        fitting = {
            foam: processes.submit(fit_pressures, path)
            for foam, path in known.items()
            if path.exists()
        }
        fitted = {foam: future.result() for foam, future in fitting.items()}
        measured = [processes.submit(measure, path, fitted.get(_foam(path))) for path in paths]
        calibration = next((path for path in paths if path.stem == FITTED_FOAM), None)
        emulating = None
        if calibration is not None and with_emulation:
            emulating = processes.submit(insole.compare, calibration)
        parts: list[Future[Any]] = [*measured]
        parts += [part for part in (grasping, emulating) if part is not None]
        for done, part in enumerate(as_completed(parts), 1):
            part.result()
            show_step(f"real skin: {done} of {len(parts)} parts")
        rows = [future.result() for future in measured]
        found = None if grasping is None else grasping.result()
        compared = [] if emulating is None else emulating.result()
    document: Row = {
        "schema": SCHEMA,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": here,
        "quick": quick,
        "real": rows,
        "published": list(PUBLISHED),
        "grasps": found,
        "emulated": compared,
        "absent": None if paths else str(folder),
        "seconds": round(time.perf_counter() - start_s, 1),
    }
    if output is not None:
        write([page.real_skin(document)], "Real skin", document, output, "real")
    return document


def describe(document: Row) -> str:
    """The rows as text for a terminal."""
    if document["absent"] is not None:
        return _absent(document["absent"])
    head, rows = tables.real(document)
    lines = [as_text(head, rows), *page.remarks_on_real(document)]
    return "\n".join([*lines, f"in {document['seconds']} s on {document['machine']['processor']}"])


def _absent(folder: Path | str) -> str:
    return f"{folder}: no recordings of real skin here; --recordings names a folder"


#: The recording that the emulator's Infinergy is fitted to.
FITTED_FOAM = "left_calibration"
#: Usable pads that are wanted: of the live ones of the calibration recording, and in number.
USABLE_SHARE = (0.7, 0.85)
USABLE_PADS = {"left_validation_1": (100, 125), "left_steps": (105, 120)}
#: RMSE of the median pad, of the 95th percentile, and of the mean over pads: musts, aims.
ERRORS_KPA = {
    "left_validation_1": ((8.0, 5.0), (16.0, 10.0), (6.0, 3.0)),
    "left_steps": ((8.0, 5.0), (18.0, 12.0), (6.0, 3.0)),
}
#: The recording whose loading and unloading counts for flicker.
FLICKER = "left_steps"


def goals(document: Row) -> list[Row]:
    """What is wanted on real skin, as far as the recordings are there."""
    lines = []
    for row in document["real"]:
        name = row["recording"]
        figure = f"{name}: touches begun in the first 10 s"
        lines.append(goal(figure, row["touches_begun_10s"], 0, 0))
        for level in LEVELS_KPA:
            figure = f"{name}: usable pads touched within 1 s of {level:g} kPa over rest"
            must = 0.95 if level == LEVELS_KPA[0] else 0.0
            lines.append(goal(figure, row[f"detected_{level:g}kpa"], must, 0.95, at_least=True))
        if name == FLICKER:
            figure = f"{name}: touch begins a usable pad, loading and unloading"
            lines.append(goal(figure, row["begins_per_pad"], 1.2, 1.0))
        if name == f"left{CALIBRATION}":
            share = row["pads_usable"] / row["pads_live"] if row["pads_live"] else None
            lines.append(goal(f"{name}: usable of live pads", share, *USABLE_SHARE, at_least=True))
        if name in USABLE_PADS:
            pads = row["pads_usable"]
            lines.append(goal(f"{name}: usable pads", pads, *USABLE_PADS[name], at_least=True))
        measures = ("median_rmse_kpa", "p95_rmse_kpa", "skin_rms_kpa")
        words = ("RMSE, median pad", "RMSE, 95 % of pads", "RMS of the mean over pads")
        for measure, word, wanted in zip(measures, words, ERRORS_KPA.get(name, ()), strict=False):
            lines.append(goal(f"{name}: {word}, kPa", row[measure], *wanted))
    grasped = document["grasps"]
    if grasped is not None:
        figure = f"{grasped['recording']}: touches too many or too few of {grasped['grasps']}"
        wrong = abs(grasped["touches"] - grasped["grasps"]) + grasped["early"]
        lines.append(goal(f"{figure}, or early", wrong, 0, 0))
    return lines


def _foam(path: Path) -> str:
    return path.stem.partition("_")[0]


def _calibration_path(foam: str, folder: Path) -> Path:
    """The recording that a foam is calibrated on: beside the others, else among the shared."""
    beside = folder / f"{foam}{CALIBRATION}.npz"
    return beside if beside.exists() else RECORDINGS / beside.name


def measure(path: Path, fitted: Calibration | None) -> Row:
    """Measure one recording with the curves that were fitted to its foam, if there are any."""
    recording = insole.read(path)
    settings, layout = insole.skin()
    calibration = calibrate(recording, settings, layout)
    why_not = None
    if fitted is None:
        why_not = f"{_foam(path)}{CALIBRATION}.npz is missing"
    else:
        calibration = with_pressures_of(calibration, fitted)
    course = play(recording, settings, layout, calibration)
    live = live_pads(recording)
    lasting = course.valid.mean(axis=0) >= VALID_SHARE
    calibrated = calibration.usable[insole.pads(layout)]
    usable = live & calibrated & lasting
    errors = pressure_errors(recording, course, usable, why_not)
    # A pad that is valid seldom may be wrong whenever it is.
    far = None if why_not is not None else far_share(recording, course, calibrated)
    errors["calibrated_far_share"] = far
    return touches(recording, course, live, usable) | errors


def fit_pressures(path: Path) -> Calibration:
    """What `skin calibrate --pressure --load` makes of a recording under known pressure.

    Raises:
        RequestError: nothing is pressed in it, or its pressure is of another recording.
    """
    recording = insole.read(path)
    n = min(len(recording.t_ns), len(recording.pressure_kpa))
    time_s: Floats = recording.t_ns[:n].astype(np.float64) * 1e-9
    load = LoadTable(path, time_s, recording.pressure_kpa[:n])
    # Without gaps there are about as many samples as sweeps.
    check_course(load)
    check_covers(load, recording.t_ns[0] * 1e-9, recording.t_ns[-1] * 1e-9, "recording")
    settings, layout = insole.skin()
    calibration = calibrate(recording, settings, layout)
    period_ns = int(np.median(np.diff(recording.t_ns)))
    grid_ns = np.arange(recording.t_ns[0], recording.t_ns[-1], period_ns)
    raw = np.full((len(grid_ns), layout.n_taxels), insole.NO_LOAD, np.uint8)
    before = np.searchsorted(recording.t_ns, grid_ns, side="right") - 1
    raw[:, insole.pads(layout)] = recording.counts[before]
    samples = Samples(
        period_ns * 1e-9,
        recording.t_ns[0] * 1e-9,
        raw,
        layout.no_load - calibration.baseline,
        calibration.verdict < Verdict.ABSENT,
        calibration.usable,
        calibration,
        ZERO_S,
    )
    return fit_curves(samples, settings, layout, load).calibration


def calibrate(recording: InsoleRecording, settings: Settings, layout: Layout) -> Calibration:
    """The calibration of a recording's first seconds."""
    engine = Engine(settings, layout, [0])
    engine.begin_calibration(ZERO_S)
    for batch in recording.batches():
        engine.feed(insole.BUS, batch)
        if engine.calibration_progress() >= 1.0:
            break
    return engine.end_calibration("1970-01-01T00:00:00+00:00")


def play(
    recording: InsoleRecording, settings: Settings, layout: Layout, calibration: Calibration
) -> PlayedCourse:
    """Replay a recording as `skin replay` does."""
    engine = Engine(settings, layout, [0], calibration)
    pads = insole.pads(layout)
    t_ns, pressure, touched, valid, begun = [], [], [], [], []
    batches = ((insole.BUS, batch) for batch in recording.batches())
    for step in [step for _, output in fed(batches, engine, 0) for step in output.steps]:
        t_ns.append(step.frame.t_ns)
        pressure.append(step.frame.pressure_kpa[pads])
        touched.append(step.frame.touched[pads])
        valid.append(step.frame.valid[pads])
        begun += [event.t_ns for event in step.events if event.event == "begin"]
    times = np.array(t_ns, np.int64)
    return PlayedCourse(
        times,
        np.searchsorted(recording.t_ns, times, side="right") - 1,
        np.array(pressure),
        np.array(touched),
        np.array(valid),
        np.array(begun, np.int64),
    )


def live_pads(recording: InsoleRecording) -> Mask:
    """Pads [280] that move at all and never read very low while nothing presses."""
    first = recording.counts[recording.t_ns - recording.t_ns[0] <= ZERO_S * 1e9]
    return np.asarray((first.min(axis=0) >= LOWEST_LIVE) & (np.ptp(first, axis=0) > 0))


def touches(recording: InsoleRecording, course: PlayedCourse, live: Mask, usable: Mask) -> Row:
    """Touches of a recording."""
    start_ns = recording.t_ns[0]
    touched = course.touched[:, usable]
    begins = touched[1:] & ~touched[:-1]
    n = int(np.count_nonzero(usable))
    early = course.t_ns - start_ns <= UNTOUCHED_S * 1e9
    begun = int(np.count_nonzero(course.begun_ns - start_ns <= UNTOUCHED_S * 1e9))
    begun_pads = course.touched[early]
    row: Row = {
        "recording": recording.name,
        "pads_live": int(np.count_nonzero(live)),
        "pads_usable": n,
        "touches_begun_10s": begun,
        "false_begins_per_s": begun / UNTOUCHED_S,
        "pad_begins_10s": int(np.count_nonzero(begun_pads[1:] & ~begun_pads[:-1])),
        "begins_per_pad": float(np.count_nonzero(begins) / n) if n else None,
        "pads_touched_afterwards": touched_afterwards(recording, course, usable),
    }
    for level in LEVELS_KPA:
        row[f"detected_{level:g}kpa"] = detected(recording, course, usable, level)
    return row


def touched_afterwards(
    recording: InsoleRecording, course: PlayedCourse, usable: Mask
) -> int | None:
    """Usable pads that are still touched `AFTERWARDS_S` after the load is gone; None if it never is
    for so long.
    """
    pressure, rest = _course(recording)
    pressed = np.flatnonzero(pressure > rest + GONE_KPA)
    if not len(pressed):
        return None
    at_ns = recording.t_ns[pressed[-1]] + AFTERWARDS_S * 1e9
    after = course.t_ns >= at_ns
    return int(np.count_nonzero(course.touched[after][0, usable])) if after.any() else None


def detected(
    recording: InsoleRecording, course: PlayedCourse, usable: Mask, over_kpa: float
) -> float | None:
    """Share of usable pads that are reported touched within a second of a lasting pressure."""
    pressure, rest = _course(recording)
    loading = pressure[: int(np.argmax(pressure)) + 1]
    if loading[-1] < rest + over_kpa or not usable.any():
        return None
    stays = int(np.flatnonzero(loading < rest + over_kpa)[-1]) + 1
    since_ns = recording.t_ns[stays]
    until_ns = since_ns + WITHIN_S * 1e9
    within = (course.t_ns >= since_ns) & (course.t_ns <= until_ns)
    return float(np.mean(course.touched[within][:, usable].any(axis=0)))


def pressure_errors(
    recording: InsoleRecording, course: PlayedCourse, usable: Mask, why_not: str | None
) -> Row:
    """Errors in kPa over the whole recording, paired by index; beside them with one lag, and with
    one lag and one rate of the pressure's clock.
    """
    row: Row = dict.fromkeys(
        (
            "median_rmse_kpa",
            "p95_rmse_kpa",
            "skin_rms_kpa",
            "worst_rmse_kpa",
            "far_share",
            "valid_share",
            "lag_s",
            "lagged_median_rmse_kpa",
            "lagged_p95_rmse_kpa",
            "lagged_skin_rms_kpa",
            "rate",
            "rated_median_rmse_kpa",
            "rated_p95_rmse_kpa",
            "rated_skin_rms_kpa",
            "zero_kpa",
            "hindsight",
        )
    )
    row["why_no_pressure"] = why_not
    paired = course.sweep < len(recording.pressure_kpa)
    if why_not is not None or not course.valid[paired][:, usable].any():
        return row
    valid = course.valid[paired][:, usable]
    kpa = course.pressure_kpa[paired][:, usable].astype(np.float64)
    row["valid_share"] = float(np.mean(valid))
    count, known = valid.sum(axis=0), valid.any(axis=1)
    mean_kpa = np.sum(kpa, axis=1, where=valid)[known] / valid.sum(axis=1)[known]
    sweep = course.sweep[paired]
    period_s = float(np.median(np.diff(recording.t_ns))) * 1e-9

    since_middle = sweep - sweep.mean()

    def true_kpa(lag: int, rate: float = 0.0) -> Floats:
        at = np.rint(sweep + rate * since_middle).astype(np.int64) - lag
        true: Floats = recording.pressure_kpa[at.clip(0, len(recording.pressure_kpa) - 1)]
        return true

    def of_mean(lag: int, rate: float = 0.0) -> float:
        return float(np.sqrt(np.mean((mean_kpa - true_kpa(lag, rate)[known]) ** 2)))

    def of_each(lag: int, rate: float = 0.0) -> Floats:
        squares = (kpa - true_kpa(lag, rate)[:, np.newaxis]) ** 2
        each: Floats = np.sum(squares, axis=0, where=valid)[count > 0] / count[count > 0]
        return np.sqrt(each)

    def errors(lag: int, rate: float = 0.0) -> tuple[float, float, float]:
        each = of_each(lag, rate)
        return float(np.median(each)), float(np.percentile(each, 95.0)), of_mean(lag, rate)

    furthest = round(LARGEST_LAG_S / period_s)
    lags = range(-furthest, furthest + 1)
    lag = min(lags, key=of_mean)
    clocks = ((late, rate) for late in lags[::5] for rate in RATES[::4].tolist())
    nearly_late, nearly = min(clocks, key=lambda clock: of_mean(*clock))
    clocks = (
        (late, rate)
        for late in lags
        for rate in RATES.tolist()
        if abs(late - nearly_late) <= 5 and abs(rate - nearly) <= 4e-3
    )
    rated_lag, rate = min(clocks, key=lambda clock: of_mean(*clock))
    names = ("median_rmse_kpa", "p95_rmse_kpa", "skin_rms_kpa")
    row |= dict(zip(names, errors(0), strict=True))
    row |= {f"lagged_{name}": value for name, value in zip(names, errors(lag), strict=True)}
    row |= {"lag_s": lag * period_s, "rate": rate}
    rated = errors(rated_lag, rate)
    row |= {f"rated_{name}": value for name, value in zip(names, rated, strict=True)}
    row["worst_rmse_kpa"] = float(of_each(0).max())
    row["far_share"] = far_share(recording, course, usable)
    here = valid.any(axis=0)
    row["hindsight"] = errors_in_hindsight(
        kpa[known][:, here], valid[known][:, here], true_kpa(0)[known]
    )
    at_zero = np.searchsorted(recording.t_ns, recording.t_ns[0] + round(ZERO_S * 1e9))
    row["zero_kpa"] = float(np.median(recording.pressure_kpa[:at_zero]))
    return row


def far_share(recording: InsoleRecording, course: PlayedCourse, pads: Mask) -> float | None:
    """Share of the valid readings of some pads [280] that are off by more than `FAR_KPA`; None if
    none is valid.
    """
    paired = course.sweep < len(recording.pressure_kpa)
    valid = course.valid[paired][:, pads]
    true_kpa = recording.pressure_kpa[course.sweep[paired], np.newaxis]
    far = np.abs(course.pressure_kpa[paired][:, pads] - true_kpa) > FAR_KPA
    return float(np.mean(far[valid])) if valid.any() else None


def _course(recording: InsoleRecording) -> tuple[Floats, float]:
    """The pressure at the sweeps, and its value at rest."""
    pressure = _without_spikes(recording.pressure_kpa)[: len(recording.t_ns)]
    at_rest = recording.t_ns[: len(pressure)] - recording.t_ns[0] <= ZERO_S * 1e9
    return pressure, float(np.median(pressure[at_rest]))


def _without_spikes(values: Floats) -> Floats:
    """A running median."""
    half = SPIKE_SAMPLES // 2
    padded = np.pad(values, half, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, SPIKE_SAMPLES)
    return np.asarray(np.median(windows, axis=1))


def hand() -> tuple[Settings, Layout]:
    """The five fingertips of the iCub hand that made the grasp recording."""
    document = {
        "robot": "icub",
        "buses": {"can0": {}},
        "boards": {"hand": {"bus": "can0", "address": 14, "skin_type": 1, "no_load": 244}},
        "parts": {
            "hand": {
                "foam_mm": 2.0,
                "patches": [
                    {
                        "board": "hand",
                        "triangles": "0-4",
                        "kind": "fingertip",
                        "shift": 3,
                        "cdc_offset": 0x2000,
                        "places": [{"x_mm": 24 * finger} for finger in range(5)],
                    }
                ],
            }
        },
    }
    settings = msgspec.convert(document, Settings)
    return settings, build_layout(settings, Path())


def grasps(log: Path) -> Row:
    """How often the whole hand begins to be touched in the recording of 13 grasps."""
    settings, layout = hand()
    calibration = calibrate_from_log(log, settings, layout, ZERO_S)
    engine = Engine(settings, layout, [0], calibration)
    frames = [(step.frame.t_ns, bool(step.frame.touched.any())) for step in steps(log, engine)]
    begins = [
        (after_ns - frames[0][0]) * 1e-9
        for (_, before), (after_ns, after) in pairwise(frames)
        if after and not before
    ]
    early = sum(begin_s < GRASPS_UNTOUCHED_S for begin_s in begins)
    return {"recording": log.stem, "grasps": 13, "touches": len(begins), "early": early}


def errors_in_hindsight(kpa: Floats, valid: Mask, true_kpa: Floats) -> list[Row]:
    """Errors of reported pressures, and what is left of them when something of the truth is known.

    What the best possible estimators would make of a recording whose true pressure they know. None
    of them can be built: each knows something that no calibration can know. What error is left
    when it is known shows where the rest comes from.

    Args:
        kpa: float64[t, k], reported pressures.
        valid: bool[t, k]; each moment and each pad have a valid one.
        true_kpa: float64[t].

    Returns:
        One row for each `known`: `median_rmse_kpa` and `p95_rmse_kpa` over the pads, and
        `skin_rms_kpa` of the mean over the pads.
    """
    mean = _mean(kpa, valid)
    gain, offset = np.polyfit(mean, true_kpa, 1)
    curved, mapped = np.zeros_like(kpa), rising(mean, true_kpa)
    for pad, its in enumerate(valid.T):
        curved[its, pad] = rising(kpa[its, pad], true_kpa[its])
    common = (true_kpa - mean)[:, np.newaxis]
    return [
        _row(AS_REPORTED, kpa, mean, valid, true_kpa),
        _row(ONE_LINE, gain * kpa + offset, gain * mean + offset, valid, true_kpa),
        _row(COMMON_ERROR, kpa + common, true_kpa, valid, true_kpa),
        _row(OWN_CURVES, curved, mapped, valid, true_kpa),
    ]


def rising(values: Floats, wanted: Floats) -> Floats:
    """Return the rising function of values [t] that is nearest to what is wanted [t].

    Least squares over means of `SHARES` shares: neighbours that fall are pooled until none does
    (Barlow et al., Statistical Inference under Order Restrictions, 1972, chapter 1).
    """
    order = np.argsort(values, kind="stable")
    shares = [share for share in np.array_split(order, SHARES) if len(share)]
    pools: list[tuple[float, int, int]] = []
    for share in shares:
        level, weight, count = float(wanted[share].mean()), len(share), 1
        while pools and pools[-1][0] >= level:
            lower, other, more = pools.pop()
            level = (level * weight + lower * other) / (weight + other)
            weight, count = weight + other, count + more
        pools.append((level, weight, count))
    found = np.empty_like(wanted)
    levels = np.repeat([level for level, _, _ in pools], [count for _, _, count in pools])
    for share, level in zip(shares, levels, strict=True):
        found[share] = level
    return found


def _mean(kpa: Floats, valid: Mask) -> Floats:
    mean: Floats = np.sum(kpa, axis=1, where=valid) / valid.sum(axis=1)
    return mean


def _row(known: str, kpa: Floats, mean: Floats, valid: Mask, true_kpa: Floats) -> Row:
    squares = (kpa - true_kpa[:, np.newaxis]) ** 2
    each = np.sqrt(np.sum(squares, axis=0, where=valid) / valid.sum(axis=0))
    return {
        "known": known,
        "median_rmse_kpa": float(np.median(each)),
        "p95_rmse_kpa": float(np.percentile(each, 95.0)),
        "skin_rms_kpa": float(np.sqrt(np.mean((mean - true_kpa) ** 2))),
    }
