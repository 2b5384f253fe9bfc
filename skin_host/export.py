"""Recordings as plain arrays and tables, for numpy, spreadsheets and everything between."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.engine import Engine
from skin_host.errors import LogError, RequestError, SkinError
from skin_host.files import write_atomic
from skin_host.layout import Layout
from skin_host.processing.calibration import Calibration
from skin_host.publish.frames import decode_frame
from skin_host.publish.info import PartInfo, decode_info, node_info
from skin_host.publish.messages import TouchMessage, decode_touch, touch_message
from skin_host.publish.payload import MessageError
from skin_host.publish.recording import read_said
from skin_host.replay import calibrate_from_log, replay
from skin_host.settings import Settings, skin_hash

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]
TOUCH_COLUMNS = ("t_ns", "part", "event", "id", "x_m", "y_m", "z_m")
TOUCH_NUMBERS = ("area_mm2", "peak_kpa", "mean_kpa", "force_n", "sigma_m")


@dataclass(frozen=True, slots=True)
class PartSeries:
    """One part over time: n frames of m taxels.

    Attributes:
        seq, t_ns: int64[n].
        pressure_kpa: float32[n, m], NaN where not valid.
        beyond_range: bool[n, m].
        raw: uint8[n, m], or None where it was not recorded.
    """

    name: str
    seq: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    pressure_kpa: Floats
    beyond_range: Mask
    raw: NDArray[np.uint8] | None

    @property
    def t_s(self) -> NDArray[np.float64]:
        """Seconds since the first frame, float64[n]."""
        seconds: NDArray[np.float64] = (self.t_ns - self.t_ns[0]) * 1e-9
        return seconds


@dataclass(frozen=True, slots=True)
class Series:
    """A whole recording.

    Attributes:
        parts: by name.
        touches: events in their order.
        shapes: where taxels lie, as far as the recording says.
    """

    parts: dict[str, PartSeries]
    touches: list[TouchMessage]
    shapes: dict[str, PartInfo]


@dataclass(slots=True)
class _Growing:
    seq: list[int] = field(default_factory=list)
    t_ns: list[int] = field(default_factory=list)
    kpa: list[Floats] = field(default_factory=list)
    beyond: list[Mask] = field(default_factory=list)
    raw: list[NDArray[np.uint8] | None] = field(default_factory=list)

    def add(
        self,
        seq: int,
        t_ns: int,
        kpa: NDArray[np.floating[Any]],
        valid: Mask,
        beyond: Mask,
        raw: NDArray[np.uint8] | None,
    ) -> None:
        self.seq.append(seq)
        self.t_ns.append(t_ns)
        self.kpa.append(np.where(valid, kpa, np.nan).astype(np.float32))
        self.beyond.append(beyond.copy())
        self.raw.append(None if raw is None else raw.copy())

    def series(self, name: str) -> PartSeries:
        raw = [one for one in self.raw if one is not None]
        return PartSeries(
            name,
            np.array(self.seq, np.int64),
            np.array(self.t_ns, np.int64),
            np.array(self.kpa),
            np.array(self.beyond),
            np.array(raw) if len(raw) == len(self.raw) else None,
        )


def read_messages(recording: Path) -> Series:
    """Read an MCAP recording of messages.

    Raises:
        LogError: it cannot be read, or holds no frames.
    """
    parts: dict[str, _Growing] = {}
    touches: list[TouchMessage] = []
    shapes: dict[str, PartInfo] = {}
    for said in read_said(recording):
        name, kind = said.topic.split("/")[-2:]
        try:
            if kind == "frame":
                frame = decode_frame(name, said.payload)
                growing = parts.setdefault(name, _Growing())
                if growing.kpa and len(growing.kpa[0]) != len(frame.valid):
                    raise LogError(
                        f"{recording}: {name} changes from {len(growing.kpa[0])} to "
                        f"{len(frame.valid)} taxels; export the recordings of one skin"
                    )
                growing.add(
                    frame.seq,
                    frame.t_ns,
                    frame.pressure_kpa,
                    frame.valid,
                    frame.beyond_range,
                    frame.raw,
                )
            elif kind == "touch":
                touches.append(decode_touch(said.payload))
            elif kind == "info":
                shapes |= decode_info(said.payload).parts
        except MessageError as error:
            raise LogError(f"{recording}: {said.topic}: {error}") from None
    if not parts:
        raise LogError(f"{recording}: holds no frames of pressure")
    return Series({name: part.series(name) for name, part in parts.items()}, touches, shapes)


def read_frames(
    log: Path,
    settings: Settings,
    layout: Layout,
    *,
    calibration: Calibration | None = None,
    calibrate_seconds: float = 5.0,
) -> Series:
    """Put a recording of CAN frames through the pipeline, as `skin replay` does.

    Raises:
        LogError: it cannot be read, or holds nothing of this skin.
    """
    found = calibration or calibrate_from_log(log, settings, layout, calibrate_seconds)
    engine = Engine(settings, layout, list(range(len(layout.parts))), found)
    parts = {part.name: _Growing() for part in layout.parts}
    touches: list[TouchMessage] = []
    counts = dict.fromkeys(parts, 0)
    for step in replay(log, engine):
        frame = step.frame
        parts[frame.part].add(
            frame.seq, frame.t_ns, frame.pressure_kpa, frame.valid, frame.beyond_range, frame.raw
        )
        for event in step.events:
            counts[event.part] += 1
            touches.append(touch_message(event, counts[event.part]))
    shapes = {
        name: part
        for node in {part.node for part in layout.parts}
        for name, part in node_info(
            layout, node, version="", configuration=skin_hash(settings)
        ).parts.items()
    }
    series = {name: part.series(name) for name, part in parts.items() if part.seq}
    if not series:
        raise LogError(f"{log}: holds no sweep of this skin")
    return Series(series, touches, shapes)


def export(series: Series, output: Path) -> list[Path]:
    """Write a recording as one `.npz` file, or as a folder of CSV tables.

    In an npz file the arrays of a part are `<part>.seq`, `.t_ns`, `.pressure_kpa` (NaN where
    not valid), `.beyond_range`, `.raw` and `.position_m`; touches are columns `touch.*`. In a
    folder there is `<part>.csv`, a row a frame, and `touches.csv`.

    Raises:
        RequestError: the suffix is another one.
        SkinError: it cannot be written.
    """
    if output.suffix not in (".npz", ""):
        raise RequestError(f"{output}: wanted a name that ends in .npz, or a folder for CSV tables")
    written = []
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
