"""What was recorded, as arrays over time: read from messages, or computed from CAN frames."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import Settings, skin_hash
from skin_host.errors import LogError
from skin_host.health import HealthWatch
from skin_host.layout import Layout
from skin_host.mqtt.frames import decode_frame
from skin_host.mqtt.info import PartInfo, decode_info, node_info
from skin_host.mqtt.messages import Frame, decode_health, decode_touch
from skin_host.mqtt.payload import MessageError
from skin_host.processing.calibration import Calibration
from skin_host.processing.core import Engine
from skin_host.processing.events import Touch
from skin_host.processing.pipeline import PressureFrame
from skin_host.recording.mcap import read_messages_of, robot_at
from skin_host.recording.replay import replay

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]
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


class HealthLine(NamedTuple):
    """Health of a part, when it changed: its state, and its sentences as one text."""

    part: str
    t_ns: int
    state: str
    text: str


@dataclass(frozen=True, slots=True)
class Series:
    """A whole recording.

    Attributes:
        parts: by name.
        touches: events in their order.
        shapes: positions of the taxels, if the recording has them.
        health: changes in their order; of a recording of CAN frames, that at its end.
    """

    parts: dict[str, PartSeries]
    touches: list[Touch]
    shapes: dict[str, PartInfo]
    health: list[HealthLine] = field(default_factory=list)


@dataclass(slots=True)
class _Growing:
    seq: list[int] = field(default_factory=list)
    t_ns: list[int] = field(default_factory=list)
    kpa: list[Floats] = field(default_factory=list)
    beyond: list[Mask] = field(default_factory=list)
    raw: list[NDArray[np.uint8] | None] = field(default_factory=list)

    def add(self, frame: Frame | PressureFrame) -> None:
        self.seq.append(frame.seq)
        self.t_ns.append(frame.t_ns)
        self.kpa.append(np.where(frame.valid, frame.pressure_kpa, np.nan).astype(np.float32))
        self.beyond.append(frame.beyond_range.copy())
        self.raw.append(None if frame.raw is None else frame.raw.copy())

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
        LogError: it cannot be read, holds no frames, or those of several robots.
    """
    robots: set[str] = set()
    parts: dict[str, _Growing] = {}
    touches: list[Touch] = []
    shapes: dict[str, PartInfo] = {}
    health: list[HealthLine] = []
    latest: dict[str, HealthLine] = {}
    for said in read_messages_of(recording):
        words = said.topic.split("/")
        name, kind = words[-2:]
        try:
            if kind == "frame":
                robots.add("/".join(words[: robot_at(words) + 1]))
                if len(robots) > 1:
                    raise LogError(
                        f"{recording}: holds frames of several robots: "
                        f"{', '.join(sorted(robots))}; split it, e.g. with `mcap filter`"
                    )
                frame = decode_frame(name, said.payload)
                growing = parts.setdefault(name, _Growing())
                if growing.kpa and len(growing.kpa[0]) != len(frame.valid):
                    raise LogError(
                        f"{recording}: {name} changes from {len(growing.kpa[0])} to "
                        f"{len(frame.valid)} taxels; export the recordings of one skin"
                    )
                growing.add(frame)
            elif kind == "touch":
                touches.append(decode_touch(said.payload))
            elif kind == "health":
                line = health_line(name, said.t_ns, decode_health(said.payload))
                before = latest.get(name)
                if before is None or (before.state, before.text) != (line.state, line.text):
                    latest[name] = line
                    health.append(line)
            elif kind == "info":
                shapes |= decode_info(said.payload).parts
        except MessageError as error:
            raise LogError(f"{recording}: {said.topic}: {error}") from None
    if not parts:
        raise LogError(f"{recording}: holds no frames of pressure")
    found = {name: part.series(name) for name, part in parts.items()}
    return Series(found, touches, shapes, health)


def health_line(part: str, t_ns: int, record: Mapping[str, Any]) -> HealthLine:
    state, sentences = str(record.get("state", "?")), record.get("sentences") or []
    return HealthLine(part, t_ns, state, "; ".join([f"{part}: {state}", *map(str, sentences)]))


def read_frames(log: Path, settings: Settings, layout: Layout, calibration: Calibration) -> Series:
    """Process a recording of CAN frames with the pipeline, as `skin replay` does.

    Raises:
        LogError: it cannot be read, or holds nothing of this skin.
    """
    engine = Engine(settings, layout, list(range(len(layout.parts))), calibration)
    parts = {part.name: _Growing() for part in layout.parts}
    touches: list[Touch] = []
    counts = dict.fromkeys(parts, 0)
    watch = HealthWatch(engine)
    for output in replay(log, engine):
        watch.note(output)
        for step in output.steps:
            parts[step.frame.part].add(step.frame)
            for event in step.events:
                counts[event.part] += 1
                touches.append(event.published(counts[event.part]))
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
    health = [
        health_line(part.name, parts[part.name].t_ns[-1], watch.replayed(index))
        for index, part in enumerate(layout.parts)
        if part.name in series
    ]
    return Series(series, touches, shapes, sorted(health, key=lambda line: line.t_ns))
