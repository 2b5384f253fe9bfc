"""Emulated pads beside real ones: the same course of air pressure presses both.

The emulated insole has the layout, the boards and the pressure of a recording; its foam is
`infinergy`, its pads are drawn as those of real skin. What both send is compared: the course of
the median pad, its curve and its hysteresis, how pads differ, and the noise of the first seconds.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.probes.scene import Air, Scene
from emulator.robot import Robot
from skin_host.bus.wire import FrameBatch
from skin_host.evaluation import insole

Row = dict[str, Any]
Floats = NDArray[np.float64]

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
    recording = insole.read(path)
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
    settings, layout = insole.skin()
    air = Air(part="insole", file=str(path.resolve()), start_s=START_S)
    robot = Robot(settings, layout, Scene(foam="infinergy", air=[air]), seed=seed)
    robot.bring_up()
    counts = np.full((len(layout.triangles), 14), insole.NO_LOAD, np.uint8)
    sent = np.empty((len(t_s), insole.PADS))
    pads = insole.pads(layout)
    for row, time_s in enumerate(t_s):
        _take(counts, robot.step(max(START_S + time_s - robot.t_ns * 1e-9, 0.0))[insole.BUS])
        sent[row] = counts[:, :12].reshape(-1)[pads]
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


def describe(rows: list[Row]) -> str:
    """The rows as text."""
    return "\n".join(
        f"  {row['figure']:52s} "
        + (" " * 9 if row["recorded"] is None else f"{row['recorded']:9.2f}")
        + f" {row['emulated']:9.2f} {row['unit']}"
        for row in rows
    )
