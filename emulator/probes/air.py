"""Air that presses all pads of a part equally: pressure over time, also from recordings."""

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from skin_host.errors import ConfigurationError

#: Bounds of a recorded course.
MOST_BYTES = 64_000_000
MOST_SAMPLES = 1_000_000
HIGHEST_KPA = 10_000.0

Floats = NDArray[np.float64]


class AirCourse:
    """Pressure over time: straight lines between samples, nothing before and after them.

    Args:
        times_s: float64[m], not falling.
        pressure_kpa: float64[m].
    """

    def __init__(self, times_s: Floats, pressure_kpa: Floats) -> None:
        self._times_s = times_s
        self._kpa = pressure_kpa

    @classmethod
    def of(cls, keyframes: Sequence[tuple[float, float]], start_s: float) -> "AirCourse":
        """Return the course of a scene's keyframes (s, kPa), which count from `start_s`."""
        times_s, kpa = np.array(keyframes, np.float64).reshape(-1, 2).T
        return cls(times_s + start_s, kpa)

    @property
    def start_s(self) -> float:
        """When it begins."""
        return float(self._times_s[0])

    @property
    def end_s(self) -> float:
        """When it is over."""
        return float(self._times_s[-1])

    def kpa_at(self, t_s: float) -> float:
        """Pressure at a time."""
        return float(np.interp(t_s, self._times_s, self._kpa, left=0.0, right=0.0))


def read_course(path: Path) -> list[tuple[float, float]]:
    """Read a recorded course: time from 0 (s) and pressure (kPa).

    A CSV file has the head `time_s,pressure_kpa`; an .npz file the arrays `t_s` and
    `pressure_kpa`, paired by index. Times count from the first. A sample that differs from both
    its neighbours is a spike of the sensor: each is replaced by the median of the three.

    Raises:
        ConfigurationError: unreadable, or not such a course.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ConfigurationError(f"{path}: larger than {MOST_BYTES // 1_000_000} MB")
        times_s, kpa = _npz(path) if path.suffix == ".npz" else _csv(path)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        reason = str(error).splitlines()[0]
        raise ConfigurationError(
            f"{path}: {reason}; wanted time_s,pressure_kpa or an .npz of t_s and pressure_kpa"
        ) from None
    if not 1 < len(times_s) <= MOST_SAMPLES:
        raise ConfigurationError(f"{path}: {len(times_s)} samples; wanted 2 to {MOST_SAMPLES}")
    if not np.isfinite(times_s).all() or (np.diff(times_s) < 0).any():
        raise ConfigurationError(f"{path}: times run backwards or are no numbers")
    if not np.isfinite(kpa).all() or np.abs(kpa).max() > HIGHEST_KPA:
        raise ConfigurationError(f"{path}: pressure is no number, or beyond {HIGHEST_KPA:g} kPa")
    before, after = np.append(kpa[:1], kpa[:-1]), np.append(kpa[1:], kpa[-1:])
    kpa = np.maximum(np.median([before, kpa, after], axis=0), 0.0)
    return list(zip((times_s - times_s[0]).tolist(), kpa.tolist(), strict=True))


def _npz(path: Path) -> tuple[Floats, Floats]:
    with np.load(path, allow_pickle=False) as arrays:
        times_s, kpa = (np.asarray(arrays[name], np.float64) for name in ("t_s", "pressure_kpa"))
    if times_s.ndim != 1 or kpa.ndim != 1:
        raise ValueError("t_s or pressure_kpa is no row of numbers")
    n = min(len(times_s), len(kpa))
    return times_s[:n], kpa[:n]


def _csv(path: Path) -> tuple[Floats, Floats]:
    with path.open(encoding="utf-8") as file:
        head = file.readline(200).strip()
        if head != "time_s,pressure_kpa":
            raise ValueError(f'begins with "{head[:40]}"')
        table = np.loadtxt(file, delimiter=",", ndmin=2, max_rows=MOST_SAMPLES + 1)
    if table.shape[1:] != (2,):
        raise ValueError(f"{table.shape[-1]} columns")
    return table[:, 0], table[:, 1]
