"""Exports recordings: arrays and tables here, for viewers of robotics in `scene` and `live`.

Tables are CSV, and Parquet for pandas and polars; `lerobot` has data sets for learning. Units and
layout are in the metadata of Parquet: of each column its `unit`, of the file the key `skin` with
each part's places (m), normals and areas (mm2) as JSON.
"""

import csv
import json
from collections.abc import Iterator
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np

from skin_host.errors import RequestError, required
from skin_host.files import write_together
from skin_host.recording.export.columns import TABLES, Column, Table
from skin_host.recording.export.series import (
    HealthLine,
    PartSeries,
    Series,
    read_frames,
    read_messages,
)

__all__ = ["HealthLine", "PartSeries", "Series", "export", "read_frames", "read_messages"]

#: With this a table of a part's frames begins.
_HEAD = b"seq,t_ns,taxel_0_kpa"
SUFFIXES = ("", ".npz", ".parquet", ".mcap", ".rrd")
#: What formats need, as `errors.required` has it.
_PACKAGES = {
    "": (),
    ".npz": (),
    ".parquet": (("pyarrow", "Parquet tables", "parquet"),),
    ".mcap": (
        ("mcap_protobuf", "scenes for Foxglove", "foxglove"),
        ("foxglove_schemas_protobuf", "scenes for Foxglove", "foxglove"),
    ),
    ".rrd": (("rerun", "recordings for Rerun", "rerun"),),
    "lerobot": (("pyarrow", "data sets of LeRobot", "parquet"),),
}


def check_format(output: Path, *, lerobot: bool = False) -> None:
    """Check, without a recording, that its format can be written.

    Raises:
        RequestError: the suffix is another than those of `SUFFIXES`, or a data set of LeRobot has
            one.
        SkinError: the package for it is not installed.
    """
    if output.suffix not in SUFFIXES:
        raise RequestError(
            f"{output}: wanted a name that ends in one of {', '.join(SUFFIXES[1:])}, or a folder"
        )
    if lerobot and output.suffix:
        raise RequestError(
            f"{output}: a data set of LeRobot is a folder; wanted a name without end"
        )
    for package in _PACKAGES["lerobot" if lerobot else output.suffix]:
        required(*package)


def export(
    series: Series, output: Path, recording: Path | None = None, *, lerobot: bool = False
) -> list[Path]:
    """Write a recording in the format of the suffix of `output`.

    `.mcap` is for Foxglove, `.rrd` for Rerun.

    Args:
        series: what was recorded.
        output: a file, or a folder.
        recording: the file that it was read from; `.mcap` takes its messages along.
        lerobot: write the folder as a data set of LeRobot instead of tables.

    In an npz file the arrays of a part are `<part>.seq`, `.t_ns`, `.pressure_kpa` (NaN where
    not valid), `.beyond_range`, `.raw` and `.position_m`; the columns of `TABLES` are `touch.*`,
    `slip.*`, ... In a folder there is `<part>.csv`, a row a frame, and a file for each of these
    tables, `touches.csv`, `slips.csv`, ..., also without rows: one of an earlier export would stay.

    Raises:
        RequestError: the suffix is another one, the format has no place for this recording, a file
            to write is `recording`, or the folder has a part of another one.
        SkinError: it cannot be written, or the package for it is not installed.
    """
    check_format(output, lerobot=lerobot)
    if lerobot:
        from skin_host.recording.export.lerobot import write_lerobot

        return write_lerobot(series, output, _layout(series))
    if output.suffix == ".parquet":
        return write_parquet(series, output)
    if output.suffix == ".rrd":
        from skin_host.recording.export.scene import write_rerun

        write_rerun(series, output)
        return [output]
    if output.suffix == ".mcap":
        from skin_host.recording.export.scene import write_foxglove

        write_foxglove(series, recording, output)
        return [output]
    for table in TABLES:
        taken = table.singular if output.suffix == ".npz" else table.name
        if taken in series.parts:
            raise RequestError(
                f'{output}: part "{taken}" has the name of the table of {table.name}; wanted '
                ".parquet"
            )
    if output.suffix == ".npz":
        buffer = BytesIO()
        np.savez_compressed(buffer, **dict(_arrays(series)))
        return write_together([(output, buffer.getvalue())])
    tables = {name: _frame_table(part) for name, part in series.parts.items()}
    tables |= {table.name: _text_table(table, getattr(series, table.name)) for table in TABLES}
    _refuse_other_parts(output, series)
    files = ((output / f"{name}.csv", text.encode()) for name, text in tables.items())
    return write_together(files, [] if recording is None else [recording])


def _refuse_other_parts(output: Path, series: Series) -> None:
    """Refuse a folder with the frames of a part that would be read as one of this recording.

    Raises:
        RequestError: there is one.
    """
    for path in sorted(output.glob("*.csv")):
        if path.stem not in series.parts and _has_frames(path):
            raise RequestError(
                f"{output}: holds {path.name}, a part that this recording does not have; wanted "
                "another folder, or remove it"
            )


def _has_frames(path: Path) -> bool:
    """Whether a file is a table of a part's frames, as far as it can be read."""
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return file.read(len(_HEAD)) == _HEAD
    except OSError:
        return False


def _arrays(series: Series) -> Iterator[tuple[str, Any]]:
    for name, part in series.parts.items():
        yield f"{name}.seq", part.seq
        yield f"{name}.t_ns", part.t_ns
        yield f"{name}.pressure_kpa", part.pressure_kpa
        yield f"{name}.beyond_range", part.beyond_range
        if part.raw is not None:
            yield f"{name}.raw", part.raw
        if name in series.shapes:
            yield f"{name}.position_m", np.array(series.shapes[name].position_m)
    for table in TABLES:
        rows = getattr(series, table.name)
        for column in table.columns:
            for key, array in column.arrays(rows).items():
                yield f"{table.singular}.{key}", array


def _frame_table(part: PartSeries) -> str:
    """A row a frame: seq, time, kPa of each taxel, empty where not valid, then the numbers of the
    taxels beyond range, and the boards' own bytes in hexadecimal where they were recorded.
    """
    text = StringIO()
    heads = [f"taxel_{i}_kpa" for i in range(part.pressure_kpa.shape[1])]
    text.write(",".join(["seq", "t_ns", *heads, "beyond_range", "raw"]) + "\n")
    raw = [""] * len(part.seq) if part.raw is None else [row.tobytes().hex() for row in part.raw]
    rows = zip(
        *(part.seq.tolist(), part.t_ns.tolist(), part.pressure_kpa, part.beyond_range, raw),
        strict=True,
    )
    for seq, t_ns, kpa, beyond, sent in rows:
        cells = ["" if value != value else f"{value:.2f}" for value in kpa.tolist()]  # noqa: PLR0124  # NaN
        cells += [" ".join(map(str, np.flatnonzero(beyond).tolist())), sent]
        text.write(f"{seq},{t_ns},{','.join(cells)}\n")
    return text.getvalue()


def _text_table(table: Table, rows: list[Any]) -> str:
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([head for column in table.columns for head in column.heads])
    for row in rows:
        writer.writerow([cell for column in table.columns for cell in column.cells(row)])
    return text.getvalue()


def write_parquet(series: Series, output: Path) -> list[Path]:
    """Write `NAME.parquet`, a row a frame of a part, and `NAME.touches.parquet`, a row an event.

    The other `TABLES` have a file each, too: `NAME.slips.parquet`, ... In all of them `t` is the
    time.

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
    tables = {output: pa.concat_tables([schema.empty_table(), *parts])} | {
        output.with_suffix(f".{table.name}.parquet"): _arrow_table(pa, table, series, layout)
        for table in TABLES
    }
    return write_together((path, _parquet(table)) for path, table in tables.items())


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


def _arrow_table(pa: Any, table: Table, series: Series, layout: dict[str, str]) -> Any:
    kinds = {
        "integer": pa.int64(),
        "number": pa.float64(),
        "text": pa.string(),
        "vector": pa.list_(pa.float64()),
        "numbers": pa.list_(pa.int32()),
        "texts": pa.list_(pa.string()),
    }

    def field(column: Column) -> Any:
        if column.name == "t_ns":
            return pa.field("t", pa.timestamp("ns", "UTC"))
        unit = None if column.unit is None else {"unit": column.unit}
        return pa.field(column.name, kinds[column.kind], metadata=unit)

    schema = pa.schema([field(column) for column in table.columns], metadata=layout)
    rows = getattr(series, table.name)
    columns = [[column.of(row) for row in rows] for column in table.columns]
    return pa.table(
        [pa.array(values, one.type) for values, one in zip(columns, schema, strict=True)],
        schema=schema,
    )


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


def _parquet(table: Any) -> bytes:
    from pyarrow import parquet

    buffer = BytesIO()
    parquet.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()
