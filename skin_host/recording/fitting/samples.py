"""Reads a recording as samples at equal distances, with the gaps of each board."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import Settings
from skin_host.errors import LogError, RequestError
from skin_host.layout import Layout, PartLayout
from skin_host.processing.calibration import Calibration, Verdict
from skin_host.processing.core import Engine
from skin_host.recording import seconds as in_seconds
from skin_host.recording.load_table import longest_gap_s
from skin_host.recording.replay import calibrate_from_log, steps

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Recordings have times in microseconds.
LEAST_STEP_NS = 1000
#: A recording lasts at most so many times as long as the samples that were received.
MOST_MISSING = 10
WANTED = "wanted a recording of one hold, or of levels, without such a step"


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


def check_gaps(samples: Samples, moving: Mask) -> None:
    """Check that the boards whose pads move, bool[n], were received throughout.

    What is repeated in a gap would be paired with pressures that it does not belong to.

    Raises:
        RequestError: one of them was not.
    """
    for gap in samples.gaps:
        if np.any(gap.taxels & moving):
            raise gap_error(gap, samples, "throughout")


def gap_error(gap: Gap, samples: Samples, when: str) -> RequestError:
    """Return that a board was not received in a gap, and when its readings were wanted."""
    return RequestError(
        f"board {gap.board}: nothing of it was received for {gap.seconds:.1f} s, from "
        f"{gap.rows.start * samples.dt_s:.1f} s of the recording on; wanted its readings {when}"
    )


def boards_of(layout: Layout, part: PartLayout) -> Iterator[tuple[str, Mask]]:
    """Yield the boards of a part by name, each with what it reads of this part, bool[n]."""
    for board in part.boards:
        mine = layout.taxels_of([board])
        mine[: part.start] = mine[part.stop :] = False
        yield layout.boards[board].name, mine


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
    for board, taxels in boards_of(layout, part):
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


def _held(values: NDArray[np.uint8], valid: Mask) -> NDArray[np.uint8]:
    """Values [t, n] with the last valid one in place of the invalid, and the first one before it:
    a recording may begin in the middle of a sweep, and the skin is untouched then.
    """
    rows = np.where(valid, np.arange(len(values))[:, np.newaxis], valid.argmax(axis=0))
    return np.take_along_axis(values, np.maximum.accumulate(rows, axis=0), axis=0)
