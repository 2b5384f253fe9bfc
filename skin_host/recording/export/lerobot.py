"""Recordings as data sets of LeRobot (form v2.1), for learning.

LeRobot counts steps: step i of an episode is at i / fps, where fps is a whole number, and a data
set whose times differ from that by more than 0.1 ms is refused. So frames, whose times jitter and
of which some are lost, are put on such a grid. Source: huggingface/lerobot v0.3.3,
`datasets/utils.py`, `check_timestamps_sync` and `DEFAULT_FEATURES`.
"""

import json
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.errors import RequestError, required
from skin_host.files import read_whole, write_together
from skin_host.recording import seconds
from skin_host.recording.export.series import PartSeries, Series
from skin_host.untrusted import from_json

VERSION = "v2.1"
#: Episodes in a folder.
CHUNK = 1000
TASK = "tactile recording"
_INFO = "meta/info.json"
#: LeRobot reads times as float32: from 1024 s on, two of them may differ by 0.1 ms too much.
EPISODE_S = 1000
#: Three days at 40 Hz; more are mostly a gap.
MOST_STEPS = 10_000_000
#: A frame is held for so many periods of its part: one that is lost is bridged, two are a gap.
HELD_PERIODS = 1.5
#: Recordings have times in microseconds. Frames that came at one time are apart by less.
LEAST_PERIOD_NS = 1000

Int64s = NDArray[np.int64]


def write_lerobot(series: Series, output: Path, layout: dict[str, Any]) -> list[Path]:
    """Write a recording as a data set; what is longer than `EPISODE_S` becomes several episodes.

    Steps come at the whole rate next to that of the part that has most frames, from the first frame
    of any part to the last one. Of each part a step has the last frame that came before the middle
    between it and the next step. `observation.skin.<part>` is float32[m] in kPa, 0 where
    `...<part>.valid` is false, as in a gap; where `...<part>.beyond_range` is true it is an
    estimate. `skin.<part>.t_ns` is the time of the frame itself, 0 before the first one.

    Args:
        series: what was recorded.
        output: a folder.
        layout: of the skin, for the key `skin` of the data set's info.

    Returns:
        The files written: all of them, or none.

    Raises:
        SkinError: pyarrow is not installed, or a file cannot be written.
        RequestError: there are no frames; the times of a part go back, or stand still; there are
            more than `MOST_STEPS`; or the folder has the data set of another recording.
    """
    required("pyarrow", "data sets of LeRobot", "parquet")
    grid = _Grid(series, output)
    recording = {
        "parts": sorted(series.parts),
        "begin_ns": grid.start_ns,
        "end_ns": max(int(part.t_ns[-1]) for part in series.parts.values()),
    }
    _refuse_others(output, {_episode_path(n) for n in range(grid.episodes)}, recording)
    skin = {**layout, "recording": recording}
    return write_together((output / path, data) for path, data in _files(series, grid, skin))


class _Grid:
    """The steps of a data set.

    Attributes:
        fps: steps a second.
        steps: of the whole recording.
        start_ns: time of the first one.
    """

    def __init__(self, series: Series, output: Path) -> None:
        series.require_frames(f"{output}: a data set of LeRobot")
        parts = series.parts.values()
        for part in parts:
            steps_ns = np.diff(part.t_ns)
            if (back := np.flatnonzero(steps_ns < 0)).size:
                raise RequestError(
                    f"{output}: {part.name}: its time goes back by {seconds(-steps_ns[back[0]])} "
                    f"at frame {back[0] + 1}; a data set has rising times"
                )
        leader = max(parts, key=lambda part: len(part.seq))
        period_ns = _period_ns(leader)
        if period_ns is not None and period_ns < LEAST_PERIOD_NS:
            raise RequestError(f"{output}: {leader.name}: its time stands still; it has no rate")
        self.fps = 1 if period_ns is None else max(1, round(1e9 / period_ns))
        self.start_ns = min(int(part.t_ns[0]) for part in parts)
        span_ns = max(int(part.t_ns[-1]) for part in parts) - self.start_ns
        self.steps = (span_ns * self.fps + 500_000_000) // 1_000_000_000 + 1
        if self.steps > MOST_STEPS:
            raise RequestError(
                f"{output}: {leader.name}: seen {self.fps} steps a second for {span_ns / 1e9:.0f} "
                f"s; wanted at most {MOST_STEPS} steps, so without so long a gap"
            )

    @property
    def episodes(self) -> int:
        return -(-self.steps // self._most)

    @property
    def _most(self) -> int:
        """Steps of a whole episode."""
        return EPISODE_S * self.fps

    def indices(self, episode: int) -> Int64s:
        """The numbers of an episode's steps in the whole recording."""
        first = episode * self._most
        return np.arange(first, min(first + self._most, self.steps), dtype=np.int64)

    def held(self, part: PartSeries, indices: Int64s) -> tuple[Int64s, NDArray[np.bool_]]:
        """Return the frame of a part that each step has, -1 before the first, and whether there is
        one that is not too old.
        """
        # Rounded up, so that a frame at a step, whose time was rounded, is never after it.
        at_ns = -(-indices * 1_000_000_000 // self.fps)
        step_ns = 1_000_000_000 // self.fps
        t_ns = part.t_ns - self.start_ns
        frames = np.searchsorted(t_ns, at_ns + step_ns // 2, side="right") - 1
        most_ns = HELD_PERIODS * max(_period_ns(part) or 0.0, step_ns)
        return frames, (frames >= 0) & (at_ns - t_ns[frames] <= most_ns)


def _period_ns(part: PartSeries) -> float | None:
    """Return the usual distance of a part's frames; None: it has one frame."""
    return float(np.median(np.diff(part.t_ns))) if len(part.t_ns) > 1 else None


def _episode_path(episode: int) -> str:
    return f"data/chunk-{episode // CHUNK:03d}/episode_{episode:06d}.parquet"


def _refuse_others(output: Path, mine: set[str], recording: dict[str, Any]) -> None:
    """Refuse a folder with the data set of another recording, or with episodes that would be read
    as some of this one.

    Raises:
        RequestError: there are some.
    """
    there = {path.relative_to(output).as_posix() for path in output.glob("data/*/*.parquet")}
    if others := sorted(there - mine):
        raise RequestError(
            f"{output}: holds {others[0]}, which is none of this data set's {len(mine)}; wanted "
            "another folder, or remove this one"
        )
    if there and _recording_of(output) != recording:
        raise RequestError(
            f"{output}: holds a data set that is not known to be of this recording; wanted another "
            "folder, or remove this one"
        )


def _recording_of(output: Path) -> Any:
    """Return what the data set in a folder names as its recording; None where that is not known."""
    try:
        info = from_json(read_whole(output / _INFO), dict[str, Any])
    except (OSError, msgspec.DecodeError):
        return None
    skin = info.get("skin")
    return skin.get("recording") if isinstance(skin, dict) else None


def _files(series: Series, grid: _Grid, layout: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    """Yield path within the data set and content of each file."""
    from pyarrow import parquet

    episodes: list[dict[str, Any]] = []
    stats: list[dict[str, Any]] = []
    features: dict[str, Any] = {}
    for episode in range(grid.episodes):
        columns = _columns(series, grid, episode)
        buffer = BytesIO()
        parquet.write_table(_table(columns), buffer, compression="zstd")
        yield _episode_path(episode), buffer.getvalue()
        features = {name: _feature(values) for name, values in columns.items()}
        n = len(columns["index"])
        episodes.append({"episode_index": episode, "tasks": [TASK], "length": n})
        ranges = {name: _range(values) for name, values in columns.items()}
        stats.append({"episode_index": episode, "stats": ranges})
    info = {
        "codebase_version": VERSION,
        "robot_type": "skin",
        "total_episodes": grid.episodes,
        "total_frames": grid.steps,
        "total_tasks": 1,
        "total_videos": 0,
        "total_chunks": -(-grid.episodes // CHUNK),
        "chunks_size": CHUNK,
        "fps": grid.fps,
        "splits": {"train": f"0:{grid.episodes}"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": None,
        "features": features,
        "skin": layout,
    }
    yield _INFO, json.dumps(info, indent=2).encode()
    for name, lines in (
        ("tasks", [{"task_index": 0, "task": TASK}]),
        ("episodes", episodes),
        ("episodes_stats", stats),
    ):
        text = "".join(json.dumps(line) + "\n" for line in lines)
        yield f"meta/{name}.jsonl", text.encode()


def _columns(series: Series, grid: _Grid, episode: int) -> dict[str, NDArray[Any]]:
    """Return the columns of an episode of n steps by name: [n], or [n, m] of m taxels."""
    indices = grid.indices(episode)
    columns: dict[str, NDArray[Any]] = {}
    for name, part in series.parts.items():
        frames, is_fresh = grid.held(part, indices)
        kpa = part.pressure_kpa[frames]
        valid = np.isfinite(kpa) & is_fresh[:, np.newaxis]
        columns |= {
            f"observation.skin.{name}": np.where(valid, kpa, np.float32(0.0)),
            f"observation.skin.{name}.valid": valid,
            f"observation.skin.{name}.beyond_range": part.beyond_range[frames] & valid,
            f"skin.{name}.t_ns": np.where(frames >= 0, part.t_ns[frames], 0),
        }
    n = len(indices)
    return columns | {
        "timestamp": (np.arange(n) / grid.fps).astype(np.float32),
        "frame_index": np.arange(n, dtype=np.int64),
        "episode_index": np.full(n, episode, np.int64),
        "index": indices,
        "task_index": np.zeros(n, np.int64),
    }


def _table(columns: dict[str, NDArray[Any]]) -> Any:
    import pyarrow as pa

    def array(values: NDArray[Any]) -> Any:
        flat = pa.array(values.ravel())
        if values.ndim == 1:
            return flat
        return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])

    return pa.table({name: array(values) for name, values in columns.items()})


def _feature(values: NDArray[Any]) -> dict[str, Any]:
    """Describe a column as LeRobot does."""
    if values.ndim == 1:
        return {"dtype": values.dtype.name, "shape": [1], "names": None}
    taxels = values.shape[1]
    names = [f"taxel_{i}" for i in range(taxels)]
    return {"dtype": values.dtype.name, "shape": [taxels], "names": names}


def _range(values: NDArray[Any]) -> dict[str, Any]:
    """Return the statistics of a column that LeRobot keeps for each episode."""
    rows = values.reshape(len(values), -1)
    return {
        "min": rows.min(axis=0).astype(np.float64).tolist(),
        "max": rows.max(axis=0).astype(np.float64).tolist(),
        "mean": rows.mean(axis=0, dtype=np.float64).tolist(),
        "std": rows.std(axis=0, dtype=np.float64).tolist(),
        "count": [len(rows)],
    }
