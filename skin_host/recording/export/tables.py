"""Recordings as columns: Parquet for pandas and polars, and data sets in the form of LeRobot.

Units and layout are in the metadata of the files: of each column its `unit`, of the file the key
`skin` with each part's places (m), normals and areas (mm2) as JSON.
"""

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from skin_host.errors import SkinError
from skin_host.extras import required
from skin_host.files import write_atomic
from skin_host.recording.export.series import TOUCH_NUMBERS, PartSeries, Series

#: LeRobot's version of the folder's form.
LEROBOT_VERSION = "v2.1"
CHUNK = 1000
TASK = "tactile recording"
UNITS = {"area_mm2": "mm2", "peak_kpa": "kPa", "mean_kpa": "kPa", "force_n": "N", "sigma_m": "m"}


def write_parquet(series: Series, output: Path) -> list[Path]:
    """Write `NAME.parquet`, a row a frame of a part, and `NAME.touches.parquet`, a row an event.

    Columns of frames: part, seq, t (UTC, ns), pressure_kpa (a list, null where not valid),
    beyond_range, raw (null where it was not recorded).

    Raises:
        SkinError: pyarrow is not installed, or a file cannot be written.
    """
    pa = required("pyarrow", "Parquet tables", "parquet")
    layout = {"skin": json.dumps(_layout(series))}
    schema = pa.schema(
        [
            pa.field("part", pa.string()),
            pa.field("seq", pa.int64()),
            pa.field("t", pa.timestamp("ns", "UTC")),
            pa.field("pressure_kpa", pa.list_(pa.float32()), metadata={"unit": "kPa"}),
            pa.field("beyond_range", pa.list_(pa.bool_())),
            pa.field("raw", pa.list_(pa.uint8())),
        ],
        metadata=layout,
    )
    parts = [_frames(pa, part, schema) for part in series.parts.values()]
    touches = output.with_suffix(".touches.parquet")
    _write(output, pa.concat_tables(parts))
    _write(touches, _touches(pa, series, layout))
    return [output, touches]


def _frames(pa: Any, part: PartSeries, schema: Any) -> Any:
    n = len(part.seq)
    flat_kpa = pa.array(part.pressure_kpa.ravel(), pa.float32(), from_pandas=True)  # NaN is null
    offsets = pa.array(np.arange(n + 1, dtype=np.int32) * part.pressure_kpa.shape[1])
    beyond = pa.ListArray.from_arrays(offsets, pa.array(part.beyond_range.ravel()))
    raw = pa.nulls(n, pa.list_(pa.uint8()))
    if part.raw is not None:
        raw = pa.ListArray.from_arrays(offsets, pa.array(part.raw.ravel()))
    columns = [
        pa.array([part.name] * n, pa.string()),
        pa.array(part.seq),
        pa.array(part.t_ns, pa.int64()).cast(pa.timestamp("ns", "UTC")),
        pa.ListArray.from_arrays(offsets, flat_kpa),
        beyond,
        raw,
    ]
    return pa.table(columns, schema=schema)


def _touches(pa: Any, series: Series, layout: dict[str, str]) -> Any:
    records = [msgspec.to_builtins(touch) for touch in series.touches]
    fields = [
        pa.field("t", pa.timestamp("ns", "UTC")),
        pa.field("part", pa.string()),
        pa.field("event", pa.string()),
        pa.field("id", pa.int64()),
        pa.field("centroid_m", pa.list_(pa.float64()), metadata={"unit": "m"}),
        *(pa.field(key, pa.float64(), metadata={"unit": UNITS[key]}) for key in TOUCH_NUMBERS),
        pa.field("taxels", pa.list_(pa.int32())),
    ]
    columns = [
        pa.array([record["t_ns"] if one.name == "t" else record[one.name] for record in records])
        .cast(pa.int64() if one.name == "t" else one.type)
        .cast(one.type)
        if records
        else pa.nulls(0, one.type)
        for one in fields
    ]
    return pa.table(columns, schema=pa.schema(fields, metadata=layout))


def _layout(series: Series) -> dict[str, Any]:
    return {
        "unit": "kPa",
        "parts": {
            name: {
                "pads": shape.pads,
                "position_m": shape.position_m,
                "normal": shape.normal,
                "area_mm2": shape.area_mm2,
            }
            for name, shape in series.shapes.items()
            if name in series.parts
        },
    }


def write_lerobot(series: Series, output: Path) -> list[Path]:
    """Write a recording as one episode of a LeRobot data set, for learning.

    Frames come at the rate of the part that has most of them; the others' last values are held.
    `observation.skin.<part>` is float32[m] in kPa, 0 where `...<part>.valid` is false.

    Raises:
        SkinError: pyarrow is not installed, or a file cannot be written.
    """
    pa = required("pyarrow", "data sets of LeRobot", "parquet")
    leader = max(series.parts.values(), key=lambda part: len(part.seq))
    t_s = leader.t_s
    n = len(t_s)
    fps = round(1 / float(np.median(np.diff(t_s)))) if n > 1 else 1
    columns: dict[str, Any] = {}
    features: dict[str, Any] = {}
    stats: dict[str, Any] = {}
    for name, part in series.parts.items():
        rows = np.clip(np.searchsorted(part.t_ns, leader.t_ns, side="right") - 1, 0, None)
        kpa = part.pressure_kpa[rows]
        valid = np.isfinite(kpa) & (part.t_ns[0] <= leader.t_ns)[:, np.newaxis]
        kpa = np.where(valid, kpa, np.float32(0.0))
        for key, values, kind in (("", kpa, "float32"), (".valid", valid, "bool")):
            column = f"observation.skin.{name}{key}"
            flat = pa.array(values.ravel())
            columns[column] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
            taxels = [f"taxel_{i}" for i in range(values.shape[1])]
            features[column] = {"dtype": kind, "shape": [values.shape[1]], "names": taxels}
            stats[column] = {
                "min": values.min(axis=0).astype(float).tolist(),
                "max": values.max(axis=0).astype(float).tolist(),
                "mean": values.mean(axis=0).astype(float).tolist(),
                "std": values.std(axis=0).astype(float).tolist(),
                "count": [n],
            }
    columns |= {
        "timestamp": pa.array(t_s.astype(np.float32)),
        "frame_index": pa.array(np.arange(n, dtype=np.int64)),
        "episode_index": pa.array(np.zeros(n, np.int64)),
        "index": pa.array(np.arange(n, dtype=np.int64)),
        "task_index": pa.array(np.zeros(n, np.int64)),
    }
    kinds = dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")
    for key, kind in ({"timestamp": "float32"} | kinds).items():
        features[key] = {"dtype": kind, "shape": [1], "names": None}
    data = output / "data/chunk-000/episode_000000.parquet"
    info = {
        "codebase_version": LEROBOT_VERSION,
        "robot_type": "skin",
        "total_episodes": 1,
        "total_frames": n,
        "total_tasks": 1,
        "total_videos": 0,
        "total_chunks": 1,
        "chunks_size": CHUNK,
        "fps": fps,
        "splits": {"train": "0:1"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": None,
        "features": features,
        "skin": _layout(series),
    }
    _write(data, pa.table(columns))
    meta = {
        "info.json": json.dumps(info, indent=2),
        "tasks.jsonl": json.dumps({"task_index": 0, "task": TASK}) + "\n",
        "episodes.jsonl": json.dumps({"episode_index": 0, "tasks": [TASK], "length": n}) + "\n",
        "episodes_stats.jsonl": json.dumps({"episode_index": 0, "stats": stats}) + "\n",
    }
    written = [data]
    for name, text in meta.items():
        path = output / "meta" / name
        try:
            write_atomic(path, text.encode())
        except OSError as error:
            raise SkinError(f"{path}: cannot be written: {error.strerror}") from None
        written.append(path)
    return written


def _write(path: Path, table: Any) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    buffer = pa.BufferOutputStream()
    parquet.write_table(table, buffer, compression="zstd")
    try:
        write_atomic(path, buffer.getvalue())
    except OSError as error:
        raise SkinError(f"{path}: cannot be written: {error.strerror}") from None
