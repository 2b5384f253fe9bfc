"""Exports recordings: arrays and tables here; `tables` and `scene` need other packages."""

from collections.abc import Iterator
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from skin_host.errors import RequestError, SkinError
from skin_host.files import write_atomic
from skin_host.mqtt.messages import TouchMessage
from skin_host.recording.export.series import (
    TOUCH_NUMBERS,
    HealthLine,
    PartSeries,
    Series,
    read_frames,
    read_messages,
)

__all__ = ["HealthLine", "PartSeries", "Series", "export", "read_frames", "read_messages"]

SUFFIXES = ("", ".npz", ".parquet", ".mcap", ".rrd")
TOUCH_COLUMNS = ("t_ns", "part", "event", "id", "x_m", "y_m", "z_m")


def export(
    series: Series, output: Path, recording: Path | None = None, *, lerobot: bool = False
) -> list[Path]:
    """Write a recording in the format of the suffix of `output`.

    `.npz` and a folder of CSV tables are written here, `.parquet` by `tables`, `.mcap`
    (for Foxglove) and `.rrd` (for Rerun) by `scene`.

    Args:
        series: what was recorded.
        output: a file, or a folder.
        recording: the file that it was read from; `.mcap` takes its messages along.
        lerobot: write the folder as a data set of LeRobot instead of tables.

    In an npz file the arrays of a part are `<part>.seq`, `.t_ns`, `.pressure_kpa` (NaN where
    not valid), `.beyond_range`, `.raw` and `.position_m`; touches are columns `touch.*`. In a
    folder there is `<part>.csv`, a row a frame, and `touches.csv`.

    Raises:
        RequestError: the suffix is another one.
        SkinError: it cannot be written, or the package for it is not installed.
    """
    if output.suffix not in SUFFIXES:
        raise RequestError(
            f"{output}: wanted a name that ends in one of {', '.join(SUFFIXES[1:])}, or a folder"
        )
    if lerobot and output.suffix:
        raise RequestError(
            f"{output}: a data set of LeRobot is a folder; wanted a name without end"
        )
    written = []
    if output.suffix == ".parquet" or lerobot:
        from skin_host.recording.export import tables

        write = tables.write_lerobot if lerobot else tables.write_parquet
        return write(series, output)
    if output.suffix == ".rrd":
        from skin_host.recording.export.scene import write_rerun

        write_rerun(series, output)
        return [output]
    if output.suffix == ".mcap":
        from skin_host.recording.export.scene import write_foxglove

        write_foxglove(series, recording, output)
        return [output]
    try:
        if output.suffix == ".npz":
            buffer = BytesIO()
            np.savez_compressed(buffer, **dict(_arrays(series)))
            write_atomic(output, buffer.getvalue())
            return [output]
        for name, part in series.parts.items():
            path = output / f"{name}.csv"
            write_atomic(path, _table(part).encode())
            written.append(path)
        path = output / "touches.csv"
        write_atomic(path, _touch_table(series.touches).encode())
    except OSError as error:
        raise SkinError(f"{output}: cannot be written: {error.strerror}") from None
    return [*written, path]


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
    records = [msgspec.to_builtins(touch) for touch in series.touches]
    for key in ("t_ns", "part", "event", "id"):
        yield f"touch.{key}", np.array([record[key] for record in records])
    for key in TOUCH_NUMBERS:
        yield f"touch.{key}", np.array([record[key] for record in records], np.float64)
    nowhere = (np.nan,) * 3
    yield (
        "touch.centroid_m",
        np.array([touch.centroid_m or nowhere for touch in series.touches]).reshape(-1, 3),
    )


def _table(part: PartSeries) -> str:
    """A row a frame: seq, time, then kPa of each taxel, empty where not valid."""
    text = StringIO()
    heads = [f"taxel_{i}_kpa" for i in range(part.pressure_kpa.shape[1])]
    text.write(",".join(["seq", "t_ns", *heads]) + "\n")
    rows = zip(part.seq.tolist(), part.t_ns.tolist(), part.pressure_kpa, strict=True)
    for seq, t_ns, kpa in rows:
        cells = ["" if value != value else f"{value:.2f}" for value in kpa.tolist()]  # noqa: PLR0124  # NaN
        text.write(f"{seq},{t_ns},{','.join(cells)}\n")
    return text.getvalue()


def _touch_table(touches: list[TouchMessage]) -> str:
    text = StringIO()
    text.write(",".join([*TOUCH_COLUMNS, *TOUCH_NUMBERS, "taxels"]) + "\n")
    for touch in touches:
        where = touch.centroid_m or ("", "", "")
        known = [getattr(touch, key) for key in TOUCH_NUMBERS]
        numbers = ["" if number is None else number for number in known]
        taxels = " ".join(map(str, touch.taxels))
        cells = [touch.t_ns, touch.part, touch.event, touch.id, *where, *numbers, taxels]
        text.write(",".join(map(str, cells)) + "\n")
    return text.getvalue()
