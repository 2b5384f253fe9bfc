"""Present state of a robot's skin, and the messages that bring each page up to date. Pure.

Pages come and go and may be slow. Each has a `Cursor`, and gets the messages that it has not had
yet; frames that it was too slow for are skipped.

A frame goes to a page as bytes, little endian: kind 1 (u8), flags (u8, bit 0: raw values
follow), number of the part (u16), number of taxels n (u32), version of the layout (u32),
sequence number (u32, its low bits), time (f64, s), frames received and missed since the
server was started (u32 each), how long ago it was received (f32, s); then pressure in kPa
(f32[n]), bits (u8[n]: 1 valid, 2 beyond range), and raw values (u8[n]). Everything else is JSON.
"""

import struct
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from skin_host.client import Contact, Frame, Health, NodeInfo, PartInfo, Touch

FRAME = 1
HAS_RAW = 1
VALID, BEYOND_RANGE = 1, 2
_HEAD = struct.Struct("<BBHIIIdIIf")
_U32 = 2**32
#: Of a part; of more the newest are shown.
MAX_CONTACTS = 200
#: A frame has a number of 16 bits for its part. No robot has as many.
MAX_PARTS = 2**16


#: A fingertip on a force/torque board has contacts and health; its age is that of its health.
_NO_TAXELS: dict[str, Any] = {
    "period_ms": 1000,
    "pads": [],
    "position_m": [],
    "normal": [],
    "radius_mm": [],
    "area_mm2": [],
    "triangles": [],
}


@dataclass(slots=True)
class PartView:
    """One part or fingertip: its last messages; `changed` counts those of each kind."""

    number: int
    node: str
    n_taxels: int
    frame: Frame | None = None
    #: When that was received.
    frame_s: float = 0.0
    received: int = 0
    missed: int = 0
    contacts: list[Touch] = field(default_factory=list)
    changed: Counter[str] = field(default_factory=Counter)


@dataclass(slots=True)
class Cursor:
    """State of one page: the counters at the time of its last messages, of parts by name."""

    layout: int = -1
    status: int = -1
    parts: dict[str, Counter[str]] = field(default_factory=dict)


class Picture:
    """State of the robot's skin. Times are those of one clock that is never set, in s.

    Attributes:
        parts: by name, in the order in which they are drawn.
        version: of the layout; it changes with the parts and their descriptions.
    """

    def __init__(self) -> None:
        self.parts: dict[str, PartView] = {}
        self.version = 0
        self._nodes: dict[str, tuple[bool | None, NodeInfo | None]] = {}
        self._holders: dict[str, str] = {}
        self._status: dict[str, Any] = {}
        self._status_changed = 0
        self._layout = b""
        #: By part, also of parts that no node has named yet: a state is sent only when it changes.
        self._states: dict[str, Contact] = {}
        #: The last record of each part, and when one came that the broker had not stored, if any.
        self._health: dict[str, tuple[dict[str, Any], float | None]] = {}

    def take_nodes(
        self,
        robot: str,
        nodes: dict[str, tuple[bool | None, NodeInfo | None]],
        holders: dict[str, str],
    ) -> None:
        """Take the present nodes: whether each is online, and its description; and by part the node
        that has it, which others may describe, too.
        """
        if (self._nodes, self._holders) == (nodes, holders):
            return
        told = {name: info for name, (_, info) in nodes.items() if info is not None}
        before = {name: info for name, (_, info) in self._nodes.items() if info is not None}
        self._nodes = dict(nodes)
        if (before, self._holders) != (told, holders):
            self._holders = holders
            self._lay_out(robot, told)

    def take_status(self, status: dict[str, Any]) -> None:
        """Take the state of the connection to the broker; the nodes are added."""
        status = status | {"nodes": {name: online for name, (online, _) in self._nodes.items()}}
        if status != self._status:
            self._status = status
            self._status_changed += 1

    def take_frame(self, frame: Frame, now_s: float) -> None:
        part = self.parts.get(frame.part)
        if part is not None and len(frame.pressure_kpa) == part.n_taxels:
            part.frame, part.frame_s = frame, now_s
            part.received += 1
            part.missed += frame.missed
            part.changed["frame"] += 1

    def take_touches(self, touches: Iterable[Touch]) -> None:
        """Take what touches the skin at present, of all parts, oldest first."""
        found: defaultdict[str, list[Touch]] = defaultdict(list)
        for touch in touches:
            found[touch.part].append(touch)
        for name, part in self.parts.items():
            # Whoever may publish could go on for ever.
            contacts = found[name][-MAX_CONTACTS:]
            if contacts != part.contacts:
                part.contacts = contacts
                part.changed["contacts"] += 1

    def take_contact(self, contact: Contact) -> None:
        """Take the contact state of a part."""
        self._states[contact.part] = contact
        if contact.part in self.parts:
            self.parts[contact.part].changed["contacts"] += 1

    def take_health(self, health: Health, now_s: float) -> None:
        _, at_s = self._health.get(health.part, (None, None))
        self._health[health.part] = dict(health.record), at_s if health.stored else now_s
        if health.part in self.parts:
            self.parts[health.part].changed["health"] += 1

    def lose(self) -> None:
        """Note that nothing is received any more: what touches the skin is not known."""
        for name in self._states:
            self.take_contact(Contact(name, "UNKNOWN", "disconnected"))
        self.take_touches(())

    def news(self, cursor: Cursor, now_s: float) -> list[bytes | str]:
        """Return the messages that a page has not had (text is JSON), and advance its cursor."""
        news: list[bytes | str] = []
        if cursor.layout != self.version and self._layout:
            news.append(self._layout.decode())
            cursor.layout = self.version
            cursor.parts.clear()
        if cursor.status != self._status_changed:
            news.append(_json({"type": "status"} | self._status))
            cursor.status = self._status_changed
        for name, part in self.parts.items():
            had = cursor.parts.get(name)
            if part.frame is not None and (had is None or had["frame"] != part.changed["frame"]):
                news.append(self._frame_bytes(part, part.frame, now_s))
            if had is None or had["contacts"] != part.changed["contacts"]:
                news.append(_contacts_text(name, part, self._states.get(name)))
            if name in self._health and (had is None or had["health"] != part.changed["health"]):
                record, at_s = self._health[name]
                news.append(_health_text(name, record, None if at_s is None else now_s - at_s))
            if had != part.changed or had is None:
                cursor.parts[name] = part.changed.copy()
        return news

    def _lay_out(self, robot: str, nodes: dict[str, NodeInfo]) -> None:
        old = self.parts
        self.parts = {}
        parts: list[dict[str, Any]] = []
        described = [
            (node, name, len(part.pads), _description(part, info.frame_hz))
            for node, info in nodes.items()
            for name, part in info.parts.items()
            if self._holders.get(name) == node
        ]
        # Last, as parts without taxels, because pages number frames by the parts alone.
        described += [
            (node, name, 0, {"fingertip": True} | _NO_TAXELS)
            for node, info in nodes.items()
            for name in info.fingertips
            if self._holders.get(name) == node
        ]
        for number, (node, name, n_taxels, description) in enumerate(described[:MAX_PARTS]):
            view = old.get(name)
            if view is None or view.n_taxels != n_taxels:
                view = PartView(0, node, n_taxels)
            view.number, view.node = number, node
            self.parts[name] = view
            parts.append({"name": name, "node": node} | description)
        self.version += 1
        self._layout = msgspec.json.encode(
            {
                "type": "layout",
                "version": self.version,
                "robot": robot,
                "parts": parts,
                "nodes": {
                    name: {
                        "version": info.version,
                        "configuration": info.configuration,
                        "calibration": msgspec.to_builtins(info.calibration),
                        "commands": info.commands,
                    }
                    for name, info in nodes.items()
                },
            }
        )

    def _frame_bytes(self, part: PartView, frame: Frame, now_s: float) -> bytes:
        bits = frame.valid * np.uint8(VALID) | frame.beyond_range * np.uint8(BEYOND_RANGE)
        head = _HEAD.pack(
            FRAME,
            HAS_RAW if frame.raw is not None else 0,
            part.number,
            part.n_taxels,
            self.version,
            frame.seq % _U32,
            frame.t_ns * 1e-9,
            part.received % _U32,
            part.missed % _U32,
            now_s - part.frame_s,
        )
        raw = b"" if frame.raw is None else frame.raw.tobytes()
        pressure = frame.pressure_kpa.astype("<f4").tobytes()
        return head + pressure + bits.astype(np.uint8).tobytes() + raw


def _description(part: PartInfo, frame_hz: float) -> dict[str, Any]:
    """Describe a part for pages; its period is that of its frames, which may be thinned."""
    thinned_ms = 1000.0 / frame_hz if frame_hz > 0 else 0.0
    described: dict[str, Any] = msgspec.to_builtins(part)
    return described | {
        "period_ms": max(part.period_ms, thinned_ms),
        "thinned": thinned_ms > part.period_ms,
    }


def _contacts_text(name: str, part: PartView, contact: Contact | None) -> str:
    """Return what touches a part, and its contact state; nothing is known of one without."""
    state, why = (None, None) if contact is None else (contact.state, contact.why)
    contacts = [
        {
            "id": touch.id,
            "taxels": touch.taxels,
            "centroid_m": touch.centroid_m,
            "force_n": touch.force_n,
            "peak_kpa": touch.peak_kpa,
            "area_mm2": touch.area_mm2,
            "partial": touch.partial,
            "beyond": touch.beyond,
            "verdict": None if touch.load is None else touch.load.verdict,
        }
        # Of what is not received any more, nobody knows whether it ended.
        for touch in (part.contacts if why in (None, "not_felt") else ())
    ]
    message = {"type": "contacts", "part": name, "state": state, "why": why}
    return _json(message | {"contacts": contacts})


#: Text for states that are not faults themselves.
STATES = {
    "not calibrated": "Not calibrated: leave the skin untouched and calibrate.",
    "no data": "No data have come yet.",
    "silent": "Silent: no taxel is valid.",
    "disabled": "Disabled.",
}


class _Triangle(Struct):
    board: str
    triangle: int


class _Record(Struct):
    """The keys of a health record that pages draw; the sender is not trusted."""

    state: str = ""
    sentences: list[str] = []
    rate_hz: float | None = None
    taxels: int | None = None
    valid_taxels: int | None = None
    triangles: list[_Triangle] = []


def _health_text(name: str, record: dict[str, Any], age_s: float | None) -> str:
    """Of a record that the broker had stored nobody knows how old it is."""
    try:
        known = msgspec.convert(record, _Record)
    except msgspec.ValidationError as error:
        known = _Record(sentences=[f"This health record cannot be read: {error}."])
    said = [STATES[known.state]] if known.state in STATES else []
    message = msgspec.to_builtins(known) | {"sentences": said + known.sentences}
    age = None if age_s is None else round(age_s, 3)
    return _json({"type": "health", "part": name, "age_s": age} | message)


def _json(message: dict[str, Any]) -> str:
    return msgspec.json.encode(message).decode()
