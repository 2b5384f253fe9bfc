"""Tables of known pressure: `time_s,pressure_kpa`, written by a load cell or a pressure sensor."""

from pathlib import Path
from typing import NamedTuple

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
#: A spike of the sensor's line, not of the air, is shorter than this, or one sample.
SPIKE_S = 0.05
#: Skin is untouched under less than this: chambers of air keep some kPa, pads feel about one unit.
UNTOUCHED_KPA = 10.0
#: At least this share of the recording, or of its hold, must lie within the table.
COVERED_SHARE = 0.95
#: A table that begins before this many seconds counts them from its recording's start.
OWN_CLOCK_S = 1e6


class LoadTable(NamedTuple):
    """A course of pressure in time: times [t] in s, rising, and pressures [t] in kPa, of a file."""

    path: Path
    time_s: Floats
    kpa: Floats


def read_table(path: Path) -> LoadTable:
    """Read a table of at least two samples, all finite.

    A first line without numbers is a heading; lines that start with # are remarks. Fields may stand
    in quotes.

    Raises:
        RequestError: unreadable, or not such a table; the message names file and line.
    """
    try:
        lines = read_whole(path, LARGEST_BYTES).decode("utf-8-sig").splitlines()
    except OSError as error:
        raise RequestError(f"{path}: {error.strerror}; {WANTED}") from None
    except UnicodeDecodeError:
        raise RequestError(f"{path}: not text; {WANTED}") from None
    rows: list[tuple[float, float]] = []
    headed = False
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        fields = [field.strip().strip('"') for field in line.split(",")]
        try:
            time_s, kpa = map(float, fields)
        except ValueError:
            heads = not (rows or headed or any(map(_is_number, fields)))
            if heads and len(fields) == 2:
                headed = True
                continue
            raise RequestError(f'{path}:{number}: "{line[:60]}"; {WANTED}') from None
        if not (np.isfinite(time_s) and np.isfinite(kpa)):
            raise RequestError(f'{path}:{number}: "{line[:60]}" is not finite; {WANTED}')
        if rows and time_s <= rows[-1][0]:
            raise RequestError(
                f"{path}:{number}: time {time_s:.16g} s follows {rows[-1][0]:.16g} s; {WANTED}"
            )
        rows.append((time_s, kpa))
    if len(rows) < 2:
        raise RequestError(f"{path}: {len(rows)} samples; {WANTED}")
    time_s, kpa = np.array(rows).T
    return LoadTable(path, time_s, kpa)


def check_course(table: LoadTable) -> None:
    """Check that a table holds a course of pressure in kPa without gaps.

    Raises:
        RequestError: it spans too little, is in another unit, or has a gap.
    """
    path, time_s, kpa = table
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
    if gaps[longest] > longest_gap_s(gaps):
        raise RequestError(
            f"{path}: a gap of {gaps[longest]:.1f} s after {time_s[longest]:.10g} s; "
            "wanted the pressure throughout the recording"
        )


def longest_gap_s(distances_s: Floats) -> float:
    """Return how far apart samples may be that are usually so far apart [k], in seconds."""
    return max(LONGEST_GAP_S, GAP_SAMPLES * float(np.median(distances_s)))


def without_spikes(table: LoadTable) -> LoadTable:
    """Return a table without spikes: each pressure is the median of those around it."""
    step_s = float(np.median(np.diff(table.time_s)))
    half = max(round(SPIKE_S / step_s), 1)
    around = np.pad(table.kpa, half, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(around, 2 * half + 1)
    return table._replace(kpa=np.asarray(np.median(windows, axis=1)))


def check_untouched(kpa: Floats, zero_s: float, dt_s: float) -> None:
    """Check that nothing presses while the skin is zeroed.

    Args:
        kpa: pressures [t] during a recording, without spikes.
        zero_s: of its first seconds the zero is taken.
        dt_s: distance of the pressures.

    Raises:
        RequestError: there is a pressure that pads feel, over ambient or over the lowest.
    """
    zero_kpa = kpa[: max(round(zero_s / dt_s), 1)]
    lowest_kpa = float(kpa.min())
    if float(zero_kpa.max()) - min(lowest_kpa, 0.0) > UNTOUCHED_KPA:
        if float(zero_kpa.max()) - lowest_kpa <= UNTOUCHED_KPA:
            raise RequestError(
                f"no pressure is below {lowest_kpa:.0f} kPa: are they absolute, or has the sensor "
                f"an offset? wanted kPa over ambient, {UNTOUCHED_KPA:g} or less while the skin is "
                "untouched"
            )
        raise RequestError(
            f"the first {zero_s:g} s of the recording, of which the zero is taken, are at "
            f"{zero_kpa.min():.0f} to {zero_kpa.max():.0f} kPa; wanted untouched skin then, at "
            f"{UNTOUCHED_KPA:g} kPa over ambient or less"
        )


def on_clock_of(table: LoadTable, start_s: float) -> LoadTable:
    """Return a table on the clock of a recording that starts at `start_s`, but for a lag.

    A table counts from its recording's start, or has the same clock.
    """
    of_own = table.time_s[0] < OWN_CLOCK_S <= start_s
    return table._replace(time_s=table.time_s + start_s) if of_own else table


def check_covers(table: LoadTable, start_s: float, end_s: float, whole: str) -> None:
    """Check that a table covers a time on its clock, which the message calls `whole`.

    Raises:
        RequestError: the table is of another time, or lacks more than little of it.
    """
    first_s, last_s = float(table.time_s[0]), float(table.time_s[-1])
    covered = min(end_s, last_s) - max(start_s, first_s)
    if covered <= 0.0:
        raise RequestError(
            f"{table.path}: covers {first_s:.0f} to {last_s:.0f} s, the {whole} {start_s:.0f} to "
            f"{end_s:.0f} s; wanted the pressure of the same time"
        )
    if covered < COVERED_SHARE * (end_s - start_s):
        raise RequestError(
            f"{table.path}: covers {covered:.0f} s of the {whole}'s {end_s - start_s:.0f} s; "
            f"wanted the pressure throughout the {whole}"
        )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
