"""Recordings of real skin: an insole under known air pressure, as CAN frames and as truth.

280 pads of the skin's own technology in a chamber of compressed air: I. Belli et al.,
"Modeling and Calibration of Pressure-Sensing Insoles via a New Plenum-Based Chamber", Sensors
2023, 23(9), 4501 (data: ami-iit/paper_belli_2023_sensors_insole-calibration). The readings of a
sweep become 28 triangles of ten pads on two boards, so that they pass through the whole program.

`compare` presses an emulated insole by the same course of air. It has the layout, the boards and
the pressure of a recording; its foam is `infinergy`, its pads are drawn as those of real skin. What
both send is compared: the course of the median pad, its curve and its hysteresis, how pads differ,
and the noise of the first seconds.
"""

import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from emulator.probes.scene import Air, Scene
from emulator.robot import Robot
from skin_host.bus.wire import FrameBatch, encode_sweep
from skin_host.config.settings import Settings
from skin_host.errors import LogError
from skin_host.layout import Layout, PadKind, build_layout

Row = dict[str, Any]
Floats = NDArray[np.float64]

BUS = "can0"
PADS = 280
#: Triangles of board 1 and of board 2.
TRIANGLES_OF = {1: 16, 2: 12}
#: Pads that feel pressure; 6 and 10 feel temperature, are not recorded, and read `NO_LOAD`.
PRESSURE_PADS = (0, 1, 2, 3, 4, 5, 7, 8, 9, 11)
NO_LOAD = 240
PERIOD_MS = 20
#: A recording counts from 0; frames carry the time of day.
START_NS = 1_600_000_000_000_000_000
#: One frame takes this long on a bus of 1 Mbit/s.
FRAME_NS = 125_000
#: Bounds of what is read: an hour of sweeps, no pressure beyond 10 MPa.
LONGEST_SWEEPS = 200_000
HIGHEST_KPA = 10_000.0
#: Its zero is taken from so much of a recording.
ZERO_S = 5.0
#: One batch of frames holds this many sweeps.
SWEEPS_PER_BATCH = 8
#: By then the emulated boards stream.
START_S = 2.0
REST_S = 5.0
#: Pads that move at all and are not near a rail at rest.
LEAST_COUNT = 100
LEAST_RANGE = 3
#: Pressures (kPa) at which curves are compared, and how near to them counts.
LEVELS_KPA = (50.0, 100.0, 200.0, 300.0)
NEAR_KPA = 4.0
#: A pad that moves more than this at rest (units rms) telegraphs.
TELEGRAPHING = 4.5
#: Courses are compared in steps of this length; noise does not enter.
COURSE_S = 0.25


@dataclass(frozen=True)
class InsoleRecording:
    """One recording.

    Attributes:
        name: of its file, without the ending.
        t_ns: int64[t], time of each sweep since 1970, whole microseconds as in a log.
        counts: uint8[t, 280].
        pressure_kpa: float64[p], true pressure over the atmosphere's; sampled at the sweeps' rate
            without times of its own, so paired with them by index.
    """

    name: str
    t_ns: NDArray[np.int64]
    counts: NDArray[np.uint8]
    pressure_kpa: Floats

    def batches(self) -> Iterator[FrameBatch]:
        """The frames that the two boards would have sent."""
        t = len(self.counts)
        values = np.full((t, 28, 12), NO_LOAD, np.uint8)
        values[:, :, PRESSURE_PADS] = self.counts.reshape(t, 28, 10)
        per_sweep = 2 * 28
        ids = np.empty(per_sweep, np.uint32)
        data = np.empty((t, per_sweep, 8), np.uint8)
        first = 0
        for board, triangles in TRIANGLES_OF.items():
            numbers = np.arange(triangles)
            mine = slice(2 * first, 2 * (first + triangles))
            status = np.zeros(triangles, np.uint16)
            for sweep, its in enumerate(values[:, first : first + triangles]):
                ids[mine], data[sweep, mine] = encode_sweep(board, numbers, its, status)
            first += triangles
        t_ns = self.t_ns[:, np.newaxis] + np.arange(per_sweep) * FRAME_NS
        for begin in range(0, t, SWEEPS_PER_BATCH):
            part = slice(begin, min(begin + SWEEPS_PER_BATCH, t))
            k = (part.stop - part.start) * per_sweep
            yield FrameBatch(
                np.tile(ids, part.stop - part.start),
                np.full(k, 8, np.uint8),
                data[part].reshape(k, 8),
                t_ns[part].ravel(),
            )


def _is_archive(path: Path) -> bool:
    """Whether a file begins and ends as an .npz does.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return zipfile.is_zipfile(file)


def read(path: Path) -> InsoleRecording:
    """Read a recording: arrays `t_s`, `counts` and `pressure_kpa` of an .npz file.

    Raises:
        LogError: unreadable, or not such a recording.
    """
    wanted = "wanted arrays t_s [t], counts uint8 [t, 280] and pressure_kpa [p] in one .npz"
    try:
        if not _is_archive(path):  # numpy reads such a file otherwise, or advises to run it
            raise ValueError("no archive of arrays")
        with np.load(path, allow_pickle=False) as arrays:
            t_s, counts, pressure = (arrays[n] for n in ("t_s", "counts", "pressure_kpa"))
    except (OSError, ValueError, KeyError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        raise LogError(f"{path}: {str(error).splitlines()[0]}; {wanted}") from None
    seen = (
        f"t_s {t_s.dtype} {t_s.shape}, counts {counts.dtype} {counts.shape}, "
        f"pressure_kpa {pressure.dtype} {pressure.shape}"
    )
    fits = counts.dtype == np.uint8 and counts.shape == (*t_s.shape, PADS) and pressure.ndim == 1
    fits &= t_s.dtype.kind in "iuf" and pressure.dtype.kind in "iuf"
    if not fits or not 0 < len(t_s) <= LONGEST_SWEEPS or not 0 < len(pressure) <= LONGEST_SWEEPS:
        raise LogError(f"{path}: {seen}; {wanted}, at most {LONGEST_SWEEPS} sweeps")
    t_s, pressure = t_s.astype(np.float64), pressure.astype(np.float64)
    if not (np.isfinite(t_s).all() and (np.diff(t_s) > 0.0).all() and abs(t_s).max() < 1e6):
        raise LogError(f"{path}: t_s does not rise; wanted seconds from 0")
    if not (np.isfinite(pressure).all() and abs(pressure).max() < HIGHEST_KPA):
        raise LogError(f"{path}: pressure_kpa is not finite or above {HIGHEST_KPA:g} kPa")
    t_ns = START_NS + np.rint(t_s * 1e6).astype(np.int64) * 1000
    if t_ns[-1] - t_ns[0] < ZERO_S * 1e9 or not np.diff(t_ns).all():
        raise LogError(
            f"{path}: {len(t_s)} sweeps in {t_s[-1] - t_s[0]:.3g} s; wanted at least {ZERO_S:g} s "
            "of untouched skin, and sweeps that are microseconds apart"
        )
    return InsoleRecording(path.stem, t_ns, counts, pressure)


def skin() -> tuple[Settings, Layout]:
    """Settings and layout of the insole: its triangles in rows of seven, 32 mm apart."""
    patches, first = [], 0
    for board, triangles in TRIANGLES_OF.items():
        places = [
            {"x_mm": number % 7 * 32, "y_mm": number // 7 * 32}
            for number in range(first, first + triangles)
        ]
        patches.append(
            {
                "board": f"board_{board}",
                "triangles": f"0-{triangles - 1}",
                "kind": "triangle_10pad",
                "places": places,
            }
        )
        first += triangles
    document = {
        "robot": "insole",
        "buses": {BUS: {"channel": BUS}},
        "boards": {
            f"board_{board}": {
                "bus": BUS,
                "address": board,
                "skin_type": 0,
                "no_load": NO_LOAD,
                "period_ms": PERIOD_MS,
            }
            for board in TRIANGLES_OF
        },
        "parts": {"insole": {"patches": patches}},
    }
    settings = msgspec.convert(document, Settings)
    return settings, build_layout(settings, Path())


def pads(layout: Layout) -> NDArray[np.intp]:
    """Flat taxels [280] of the recorded pads, in the recording's order."""
    return np.flatnonzero(layout.pad_kind == PadKind.PRESSURE)


def compare(path: Path, seed: int = 1, longest_s: float = np.inf) -> list[Row]:
    """Figures of a recording and of its emulation.

    Args:
        path: of the recording.
        seed: of the emulated pads.
        longest_s: stop there.

    Returns:
        Rows with `figure`, `unit`, `recorded`, `emulated`.

    Raises:
        LogError: the recording is damaged.
    """
    recording = read(path)
    t_s = (recording.t_ns - recording.t_ns[0]) * 1e-9
    n = min(len(t_s), len(recording.pressure_kpa), int(np.searchsorted(t_s, longest_s)))
    t_s, pressure_kpa = t_s[:n], recording.pressure_kpa[:n]
    real = recording.counts[:n].astype(np.float64)
    emulated = _emulate(path, t_s, seed)
    real, emulated = (_live(counts, t_s) for counts in (real, emulated))
    return [
        *_courses(t_s, pressure_kpa, real, emulated),
        *_noise(t_s, real, emulated),
    ]


def _emulate(path: Path, t_s: Floats, seed: int) -> Floats:
    """Counts [t, 280] that an emulated insole sends under the recorded pressure."""
    settings, layout = skin()
    air = Air(part="insole", file=str(path.resolve()), start_s=START_S)
    robot = Robot(settings, layout, Scene(foam="infinergy", air=[air]), seed=seed)
    robot.bring_up()
    counts = np.full((len(layout.triangles), 14), NO_LOAD, np.uint8)
    sent = np.empty((len(t_s), PADS))
    recorded = pads(layout)
    for row, time_s in enumerate(t_s):
        _take(counts, robot.step(max(START_S + time_s - robot.t_ns * 1e-9, 0.0))[BUS])
        sent[row] = counts[:, :12].reshape(-1)[recorded]
    return sent


def _take(counts: NDArray[np.uint8], batch: FrameBatch) -> None:
    """Put the bytes of data frames where their triangles are."""
    triangle = (batch.id >> 4 & 0xF).astype(int) * 16 - 16 + (batch.id & 0xF)
    second = batch.data[:, 0] == 0xC0
    counts[triangle[~second], :7] = batch.data[~second, 1:]
    counts[triangle[second], 7:] = batch.data[second, 1:]


def _live(counts: Floats, t_s: Floats) -> Floats:
    """Of pads that live, what they send below their own rest, [t, k]."""
    rest = counts[t_s < REST_S]
    live = (rest.min(axis=0) >= LEAST_COUNT) & (np.ptp(counts, axis=0) > LEAST_RANGE)
    live &= np.ptp(rest, axis=0) > 0
    lived: Floats = rest[:, live].mean(axis=0) - counts[:, live]
    return lived


def _courses(t_s: Floats, pressure_kpa: Floats, real: Floats, emulated: Floats) -> list[Row]:
    parts = np.flatnonzero(np.diff(np.floor(t_s / COURSE_S), prepend=-1.0))
    of_parts = np.diff(np.append(parts, len(t_s)))
    mean = [
        np.add.reduceat(np.median(units, axis=1), parts) / of_parts for units in (real, emulated)
    ]
    apart = np.abs(mean[0] - mean[1])
    rows = [
        _row("course of the median pad: median difference", "units", None, np.median(apart)),
        _row("the same, 95 % of the time below", "units", None, np.percentile(apart, 95)),
    ]
    rising = np.arange(len(t_s)) < np.argmax(pressure_kpa)
    for level in LEVELS_KPA:
        near = np.abs(pressure_kpa - level) < NEAR_KPA
        for way, during in (("rising", near & rising), ("falling", near & ~rising)):
            if during.any():
                found = [float(np.median(units[during])) for units in (real, emulated)]
                rows.append(_row(f"median pad at {level:g} kPa, {way}", "units", *found))
    high = pressure_kpa > 0.9 * pressure_kpa.max()
    for share in (5, 95):
        found = [
            float(np.percentile(np.median(units[high], axis=0), share))
            for units in (real, emulated)
        ]
        rows.append(_row(f"pads near the highest pressure, {share} %", "units", *found))
    return rows


def _noise(t_s: Floats, real: Floats, emulated: Floats) -> list[Row]:
    deviation = [units[t_s < REST_S].std(axis=0) for units in (real, emulated)]
    rows = [
        _row(
            f"noise at rest, {share} % of the pads",
            "units rms",
            *(float(np.percentile(one, share)) for one in deviation),
        )
        for share in (5, 25, 50, 75, 95)
    ]
    shares = [float(np.mean(one > TELEGRAPHING)) for one in deviation]
    rows.append(_row(f"pads with more than {TELEGRAPHING:g} units rms", "share", *shares))
    repeats = [
        float(np.mean(np.diff(units[t_s < REST_S], axis=0) == 0)) for units in (real, emulated)
    ]
    rows.append(_row("consecutive sweeps equal", "share", *repeats))
    return rows


def _row(figure: str, unit: str, recorded: float | None, emulated: float) -> Row:
    """A line of the table; what is a difference has no recorded value."""
    return {
        "figure": figure,
        "unit": unit,
        "recorded": None if recorded is None else round(recorded, 3),
        "emulated": round(float(emulated), 3),
    }
