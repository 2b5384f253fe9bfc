"""Recordings of a robot of two limbs under known pressure: candump logs, tables, and fits."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import encode_sweep
from skin_host.cli import main
from skin_host.config.settings import load, skin_hash
from skin_host.layout import build_layout
from skin_host.processing.calibration import Calibration
from skin_host.processing.calibration.file import load_calibration, save_calibration
from skin_host.processing.pressure import PressureCurve

HZ = 5.0
#: Pads of a limb: two triangles on a board of its own.
PADS = 24
BOARDS = (3, 4)
CURVE = PressureCurve(2.88)
CONFIG = """
robot = "bench"
[buses.can0]
[boards.a]
bus = "can0"
address = 3
period_ms = 200
[boards.b]
bus = "can0"
address = 4
period_ms = 200
[parts.arm]
foam_mm = 2.0
patches = [{ board = "a", triangles = "0-1", shift = 3 }]
[parts.leg]
foam_mm = 2.0
patches = [{ board = "b", triangles = "0-1", shift = 3 }]
[processing.relaxation]
model = "none"
[service]
state_directory = "STATE"
"""
LEVELS = (20.0, 40.0, 80.0)
ARM, LEG = slice(0, PADS), slice(PADS, 2 * PADS)

Floats = NDArray[np.float64]


def write_log(path: Path, units: Floats, boards: tuple[int, ...] = BOARDS, seed: int = 3) -> Path:
    """A candump log of activations [t, 48], of some of the boards."""
    rng = np.random.default_rng(seed)
    rest = rng.uniform(235.0, 241.0, 2 * PADS)
    triangles, status = np.arange(2), np.zeros(2, np.uint16)
    with path.open("w") as file:
        for sweep, activation in enumerate(units):
            level = np.rint(rest - activation + rng.normal(0.0, 0.4, 2 * PADS))
            values = np.clip(level, 0, 255).astype(np.uint8).reshape(2, 2, 12)
            for limb, board in enumerate(BOARDS):
                if board not in boards:
                    continue
                ids, data = encode_sweep(board, triangles, values[limb], status)
                for number, (can_id, payload) in enumerate(zip(ids, data, strict=True)):
                    time_s = 1.7e9 + sweep / HZ + 1e-4 * number + 2e-5 * limb
                    line = f"({time_s:.6f}) can0 {can_id:03X}#{payload.tobytes().hex().upper()}"
                    file.write(f"{line}\n")
    return path


def without(
    log: Path, begin_s: float, end_s: float, *, addresses: str = "", output: Path | None = None
) -> Path:
    """Take what boards, all by default, sent in a time after its start out of a log, or of a copy
    of it.
    """

    def is_left(line: str) -> bool:
        is_theirs = not addresses or line.split()[2][1] in addresses
        return not (is_theirs and begin_s <= float(line[1:18]) - 1.7e9 < end_s)

    output = log if output is None else output
    output.write_text("".join(filter(is_left, log.read_text().splitlines(keepends=True))))
    return output


def pressed(units: Floats, *limbs: slice) -> Floats:
    """Activations [t, 48] of which only these limbs are pressed."""
    found = np.zeros((len(units), 2 * PADS))
    for limb in limbs:
        found[:, limb] = units[:, limb]
    return found


def stored(bench: Path, path: Path) -> Calibration:
    settings = load(bench)
    return load_calibration(path, build_layout(settings, bench.parent), skin_hash(settings))


def keep(bench: Path, path: Path, calibration: Calibration) -> None:
    save_calibration(path, calibration, build_layout(load(bench), bench.parent))


def ramp(bench: Path) -> tuple[Floats, Path]:
    """A course up to 80 kPa and down on both limbs: activations [t, 48], and its table."""
    time_s = np.arange(0.0, 93.0, 1.0 / HZ)
    kpa = np.interp(time_s, [0.0, 8.0, 48.0, 88.0, 93.0], [0.0, 0.0, 80.0, 0.0, 0.0])
    units = np.outer(60.0 * (kpa / 80.0) ** 0.7, np.linspace(0.8, 1.2, 2 * PADS))
    table = bench.with_name("air.csv")
    np.savetxt(table, np.column_stack([time_s, kpa]), delimiter=",", header="time_s,pressure_kpa")
    return units, table


def staircase(gain: Floats) -> Floats:
    """Activations [t, 48] under `LEVELS`, of pads whose gain over the common curve is this."""
    corners_s = [0.0, 8.0, 9.0, 24.0, 25.0, 40.0, 41.0, 56.0, 57.0, 66.0]
    kpa = np.interp(np.arange(0.0, 66.0, 1.0 / HZ), corners_s, np.repeat([0.0, *LEVELS, 0.0], 2))
    units: Floats = CURVE.units(kpa[:, np.newaxis] / gain)
    return units


def calibrate(bench: Path, log: Path, table: Path, *more: Any) -> int:
    words = "calibrate", bench, "--pressure", log, "--load", table, *more
    return main([str(word) for word in words])


def with_levels(bench: Path, log: Path, *more: Any, levels: tuple[float, ...] = LEVELS) -> int:
    words = "calibrate", bench, "--pressure", log, "--levels", *levels, *more
    return main([str(word) for word in words])


def write_config(folder: Path) -> Path:
    """A configuration whose calibration is kept below the same folder."""
    config = folder / "bench.toml"
    config.write_text(CONFIG.replace("STATE", str(folder / "state")))
    return config
