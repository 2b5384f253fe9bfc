"""Tables of known pressure: `time_s,pressure_kpa`, written by a load cell or a pressure sensor."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from skin_host.errors import RequestError
from skin_host.files import read_whole

Floats = NDArray[np.float64]

WANTED = "wanted rising times in s and pressures in kPa, parted by commas: time_s,pressure_kpa"
#: A table of a day at 100 Hz; larger files are not tables.
LARGEST_BYTES = 200_000_000
#: Air in a chamber, and a probe on skin, press less than this.
HIGHEST_KPA = 10_000.0
#: A course that spans less than this is in another unit, or not a pressure.
LEAST_KPA = 10.0
#: Samples may be missing for this long, or for this multiple of their usual distance.
LONGEST_GAP_S = 1.0
GAP_SAMPLES = 10.0
#: At least this share of the recording must lie within the table.
COVERED_SHARE = 0.95
#: A table that begins before this many seconds counts them from its recording's start.
OWN_CLOCK_S = 1e6


def read_table(path: Path) -> tuple[Floats, Floats]:
    """Read times in s, rising, and pressures in kPa, both finite [t], at least two.

    A first line without numbers is a heading; lines that start with # are remarks.

    Raises:
        RequestError: unreadable, or not such a table; the message names file and line.
    """
    try:
        lines = read_whole(path, LARGEST_BYTES).decode().splitlines()
    except OSError as error:
        raise RequestError(f"{path}: {error.strerror}; {WANTED}") from None
    except UnicodeDecodeError:
        raise RequestError(f"{path}: not text; {WANTED}") from None
    rows: list[tuple[float, float]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        fields = line.split(",")
        try:
            time_s, kpa = map(float, fields)
        except ValueError:
            if not rows and len(fields) == 2 and not any(map(_is_number, fields)):
                continue
            raise RequestError(f'{path}:{number}: "{line[:60]}"; {WANTED}') from None
        if not (np.isfinite(time_s) and np.isfinite(kpa)):
            raise RequestError(f'{path}:{number}: "{line[:60]}" is not finite; {WANTED}')
        if rows and time_s <= rows[-1][0]:
            raise RequestError(
                f"{path}:{number}: time {time_s:g} s follows {rows[-1][0]:g} s; {WANTED}"
            )
        rows.append((time_s, kpa))
    if len(rows) < 2:
        raise RequestError(f"{path}: {len(rows)} samples; {WANTED}")
    table = np.array(rows)
    return table[:, 0], table[:, 1]


def check_course(path: Path, time_s: Floats, kpa: Floats) -> None:
    """Check that a table holds a course of pressure in kPa without gaps.

    Raises:
        RequestError: it spans too little, is in another unit, or has a gap.
    """
    low, high = float(kpa.min()), float(kpa.max())
    seen = f"{path}: pressures from {low:g} to {high:g}"
    if high > HIGHEST_KPA:
        raise RequestError(f"{seen} kPa are beyond {HIGHEST_KPA:g}; are they in Pa? wanted kPa")
    if high - low < LEAST_KPA:
        raise RequestError(
            f"{seen} kPa span less than {LEAST_KPA:g}; are they in bar (1 bar = 100 kPa)? "
            "wanted a course of pressure in kPa"
        )
    gaps = np.diff(time_s)
    longest = int(np.argmax(gaps))
    if gaps[longest] > max(LONGEST_GAP_S, GAP_SAMPLES * float(np.median(gaps))):
        raise RequestError(
            f"{path}: a gap of {gaps[longest]:.1f} s after {time_s[longest]:g} s; "
            "wanted the pressure throughout the recording"
        )


def on_clock_of(time_s: Floats, start_s: float, end_s: float, path: Path) -> Floats:
    """Return a table's times on a recording's clock, but for a lag.

    A table counts from its recording's start, or has the same clock.

    Raises:
        RequestError: the table is of another time, or ends long before the recording does.
    """
    of_own = time_s[0] < OWN_CLOCK_S <= start_s
    aligned: Floats = time_s + start_s if of_own else time_s
    covered = min(end_s, aligned[-1]) - max(start_s, aligned[0])
    if covered <= 0.0:
        raise RequestError(
            f"{path}: covers {time_s[0]:.0f} to {time_s[-1]:.0f} s, the recording {start_s:.0f} to "
            f"{end_s:.0f} s; wanted the pressure of the same time"
        )
    if covered < COVERED_SHARE * (end_s - start_s):
        raise RequestError(
            f"{path}: covers {covered:.0f} s of the recording's {end_s - start_s:.0f} s; wanted "
            "the pressure throughout the recording"
        )
    return aligned


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
