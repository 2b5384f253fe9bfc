"""What was recorded, as arrays over time: read from messages, or computed from CAN frames."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from operator import methodcaller
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.client.presence import STALE_S
from skin_host.client.streams import SentTwice
from skin_host.config.settings import Settings, skin_hash
from skin_host.errors import LogError, RequestError
from skin_host.fingertip.events import FingertipEvent, Over, Slip
from skin_host.fingertip.health import FingertipHealth
from skin_host.health import HealthWatch
from skin_host.layout import Layout
from skin_host.mqtt.frames import decode_frame
from skin_host.mqtt.info import FingertipInfo, PartInfo, decode_info, node_info
from skin_host.mqtt.messages import (
    EVENT_DECODERS,
    ContactState,
    Frame,
    decode_contact,
    decode_health,
)
from skin_host.mqtt.outbox import REPEATED
from skin_host.mqtt.payload import MessageError
from skin_host.processing.calibration import Calibration
from skin_host.processing.core import Engine
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from skin_host.recording.export.columns import TABLES
from skin_host.recording.export.known import CONTACT_STALE_S, ContactLine, Gone, Known
from skin_host.recording.mcap import read_messages_of, robot_at
from skin_host.recording.replay import contacts_of, mistimed_boards, replay

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]


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
        parts: by name, those with frames.
        touches: events in their order, of fingertips too.
        shapes: positions of the taxels, if the recording has them.
        health: changes in their order; of a recording of CAN frames, that at its end.
        slips, overs: of fingertips, in their order.
        contacts: changes in their order; of a recording of CAN frames, those of parts with skin.
        fingertips: those on force/torque boards, as far as the recording describes them.
        gone: when parts were not received any more; of a recording of CAN frames none, as its
            frames and touches show it.
    """

    parts: dict[str, PartSeries]
    touches: list[Touch]
    shapes: dict[str, PartInfo]
    health: list[HealthLine] = field(default_factory=list)
    slips: list[Slip] = field(default_factory=list)
    overs: list[Over] = field(default_factory=list)
    contacts: list[ContactLine] = field(default_factory=list)
    fingertips: dict[str, FingertipInfo] = field(default_factory=dict)
    gone: list[Gone] = field(default_factory=list)

    def gone_ns(self, part: str) -> list[int]:
        """Return when a part was not received any more."""
        return [gone.t_ns for gone in self.gone if gone.part == part]

    def take(self, event: FingertipEvent) -> None:
        """Add an event."""
        if isinstance(event, Touch):
            self.touches.append(event)
        elif isinstance(event, Slip):
            self.slips.append(event)
        else:
            self.overs.append(event)

    def contents(self) -> str:
        """Return what it holds besides frames, such as "touches (10), health (2)"."""
        numbers = {table.name: len(getattr(self, table.name)) for table in TABLES}
        return ", ".join(f"{name} ({n})" for name, n in numbers.items() if n)

    def require_frames(self, what: str) -> None:
        """Refuse what is made of frames alone.

        Raises:
            RequestError: there are none.
        """
        if not self.parts:
            raise RequestError(
                f"{what}: the recording holds {self.contents() or 'nothing'}; wanted frames of "
                "pressure (`frames = true` of a part); export it to .npz, .parquet or a folder"
            )


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
    """Read an MCAP recording of messages. It may have no frames, see `Series.require_frames`.

    Raises:
        LogError: it cannot be read, holds nothing to export, or messages of several robots.
    """
    robots: set[str] = set()
    parts: dict[str, _Growing] = {}
    found = Series({}, [], {})
    repeats = SentTwice(2 * REPEATED)  # to the next broker, besides what was in flight
    health: dict[str, HealthLine] = {}
    #: What a client would have received, in its order.
    received: list[Callable[[Known], None]] = []
    for said in read_messages_of(recording):
        words = said.topic.split("/")
        name, kind = words[-2:]
        robots.add("/".join(words[: robot_at(words) + 1]))
        if len(robots) > 1:
            raise LogError(
                f"{recording}: holds messages of several robots: "
                f"{', '.join(sorted(robots))}; split it, e.g. with `mcap filter`"
            )
        try:
            if kind == "frame":
                frame = decode_frame(name, said.payload)
                growing = parts.setdefault(name, _Growing())
                if growing.kpa and len(growing.kpa[0]) != len(frame.valid):
                    raise LogError(
                        f"{recording}: {name} changes from {len(growing.kpa[0])} to "
                        f"{len(frame.valid)} taxels; export the recordings of one skin"
                    )
                growing.add(frame)
                received.append(methodcaller("frame", name, said.t_ns, frame.t_ns))
            elif kind in EVENT_DECODERS:
                event = EVENT_DECODERS[kind](said.payload)
                if not repeats.has(event):
                    found.take(event)
                    if isinstance(event, Touch):
                        received.append(methodcaller("touch", event, said.t_ns))
            elif kind == "contact" and said.payload:
                state = decode_contact(said.payload)
                received.append(methodcaller("state", name, state, said.t_ns, said.stored))
            elif kind == "status":
                received.append(methodcaller("status", name, said.payload, said.t_ns))
            elif kind == "health" and said.payload and not said.stored:
                received.append(methodcaller("health", name, said.t_ns))
                line = health_line(name, said.t_ns, decode_health(said.payload))
                if name not in health or health[name]._replace(t_ns=said.t_ns) != line:
                    health[name] = line
                    found.health.append(line)
            elif kind == "info" and said.payload:
                info = decode_info(said.payload)
                found.shapes.update(info.parts)
                found.fingertips.update(info.fingertips)
                names = [*info.parts, *info.fingertips]
                received.append(methodcaller("info", name, names, said.t_ns))
        except MessageError as error:
            raise LogError(f"{recording}: {said.topic}: {error}") from None
    found.parts.update((name, part.series(name)) for name, part in parts.items())
    known = Known(STALE_S if parts or health else CONTACT_STALE_S)
    for take in received:
        take(known)
    found.contacts.extend(known.contacts)
    found.gone.extend(known.gone)
    if not found.parts and not found.contents():
        raise LogError(
            f"{recording}: holds no frames of pressure, events, contact states or health of a robot"
        )
    return found


def health_line(part: str, t_ns: int, record: Mapping[str, Any]) -> HealthLine:
    state, sentences = str(record.get("state", "?")), record.get("sentences") or []
    return HealthLine(part, t_ns, state, "; ".join([f"{part}: {state}", *map(str, sentences)]))


def read_frames(
    log: Path,
    settings: Settings,
    layout: Layout,
    calibration: Calibration,
    warn: Callable[[str], None] = lambda _: None,
) -> Series:
    """Process a recording of CAN frames with the pipeline, as `skin replay` does. It may have no
    frames of pressure, see `Series.require_frames`.

    `warn` is called with the boards of which little or nothing counted because they send at
    another period than configured.

    Raises:
        LogError: it cannot be read, or holds nothing of this skin.
    """
    engine = Engine(settings, layout, list(range(len(layout.parts))), calibration)
    parts = {part.name: _Growing() for part in layout.parts}
    found = Series({}, [], {})
    counts: Counter[tuple[str, type]] = Counter()
    contacts = contacts_of(engine)
    states: dict[int, ContactState] = {}
    watch = HealthWatch(engine)
    last_ns: int | None = None
    for output in replay(log, engine):
        watch.note(output)
        times_ns = [step.frame.t_ns for step in output.steps if step.frame.raw.any()]
        last_ns = max(times_ns + [t_ns for _, t_ns in output.samples], default=last_ns)
        for step in output.steps:
            frame = step.frame
            # Of a part that has not been received yet there are only reports of its silence.
            if parts[frame.part].seq or frame.raw.any():
                parts[frame.part].add(frame)
            state = contacts[step.part].step(frame, step.events)
            if states.get(step.part) != state:
                states[step.part] = state
                found.contacts.append(ContactLine(frame.part, frame.t_ns, state))
        for event in output.events:
            counts[event.part, type(event)] += 1
            found.take(event.published(counts[event.part, type(event)]))
    for node in {part.node for part in layout.parts}:
        info = node_info(
            layout,
            node,
            version="",
            configuration=skin_hash(settings),
            fingertips=settings.fingertips,
        )
        found.shapes.update(info.parts)
        found.fingertips.update(info.fingertips)
    found.parts.update((name, part.series(name)) for name, part in parts.items() if part.seq)
    if last_ns is None:
        raise LogError(f"{log}: holds no sweep of this skin, and no sample of its fingertips")
    found.health.extend(
        health_line(part.name, parts[part.name].t_ns[-1], watch.replayed(index))
        for index, part in enumerate(layout.parts)
        if part.name in found.parts
    )
    if engine.fingertips is not None:
        records = FingertipHealth(engine.fingertips).records(None)
        found.health.extend(health_line(name, last_ns, record) for name, record in records.items())
    found.health.sort(key=lambda line: line.t_ns)
    if mistimed := mistimed_boards(engine):
        warn(mistimed)
    return found
