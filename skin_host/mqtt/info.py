"""Description of a node: its parts, the order and places of their taxels, units and rates.

The payload of `nodes/<node>/info`, retained. With it a subscriber can draw the skin and locate each
entry of a frame without any file of the robot's.

Discovery messages let Home Assistant find the skin automatically: two entities per part, grouped by
node, show whether anything touches it, and whether it has a problem. Source: Home Assistant's
documentation of the MQTT integration ("MQTT discovery") and of its binary sensor. Only names of the
configuration are included.
"""

import hashlib
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from skin_host.config.fields import Name
from skin_host.config.sizes import DECIMALS_M
from skin_host.mqtt.messages import SCALE_KPA
from skin_host.mqtt.payload import MessageError, decode
from skin_host.mqtt.topics import Topics
from skin_host.processing.events import Vector

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from skin_host.config.fingertips import Fingertip
    from skin_host.config.settings import Part
    from skin_host.layout import Layout, PartLayout

INFO_SCHEMA: Final = "skin.info/1"
#: As on the page and in `skin status`: anything but `ok` is a problem, with its sentences.
PROBLEM: Final = "{{ 'OFF' if value_json.state == 'ok' else 'ON' }}"
WHY: Final = "{{ {'state': value_json.state, 'sentences': value_json.sentences} | tojson }}"
#: Health comes once a second, the contact state every 2 s. A broker that has stored the last ones
#: may be all that is left of a robot: after so many seconds without another they are unavailable.
EXPIRE_S: Final = 10
#: A part that cannot feel is not "not touched": its contact is unavailable.
FEELS: Final = (
    "{{ 'online' if value_json.state in ('ok', 'warning', 'degraded', 'saturated') "
    "else 'offline' }}"
)
#: For Home Assistant the text None is an unknown state.
STATE: Final = "{{ 'None' if value == 'UNKNOWN' else value }}"
#: 100 000 taxels and their triangles fit.
MAX_BYTES = 32 * 1024 * 1024
MAX_PIECES = 10_000
#: Areas and radii are published to 0.01, normals to 0.0001.
_MM, _NORMAL = 2, 4


class CalibrationInfo(Struct, frozen=True):
    """Which calibration is in use, and when it was taken (ISO 8601, UTC)."""

    id: str
    time: str


class TriangleInfo(Struct, frozen=True):
    """A triangle: its board and number, its first taxel in the part, its outline [k, 3] (m).

    `no_load` is the byte of an untouched taxel, as configured; None from older nodes.
    """

    board: Name
    number: int
    kind: str
    first: int
    outline_m: list[Vector]
    no_load: int | None = None


class PartInfo(Struct, frozen=True, omit_defaults=True):
    """A part. Lists have one entry a taxel, in the order of the values of a frame.

    Attributes:
        period_ms: time between two frames as configured, of its slowest board.
        pads: `pressure` or `thermal`; thermal pads are never valid in frames.
        position_m, normal: in the part's own frame.
        radius_mm, area_mm2: of the pad; of the skin that it answers for.
        frames: whether its frames are published.
    """

    period_ms: int
    pads: list[Literal["pressure", "thermal"]]
    position_m: list[Vector]
    normal: list[Vector]
    radius_mm: list[float]
    area_mm2: list[float]
    triangles: list[TriangleInfo]
    frames: bool = True


class FingertipInfo(Struct, frozen=True):
    """A fingertip on a force/torque board: it has no frames, but touches, slips and health.

    Attributes:
        period_ms: between two samples of its board.
        shape: sphere, cylinder (about z), ellipsoid (axes along x, y, z) or plane (faces z).
        size_mm: radius, semi-axes, or nothing for a plane.
        array: the part whose skin covers it, in the same frame.
        friction: known coefficient of static friction, or None.
        threshold_n, over_n: where a contact begins, and where it presses too hard.
    """

    period_ms: int
    shape: str
    size_mm: list[float]
    array: str | None
    friction: float | None
    threshold_n: float
    over_n: float


class NodeInfo(Struct, frozen=True, kw_only=True):
    """The payload of `nodes/<node>/info`.

    Attributes:
        version: of skin-host.
        configuration: hash of what a calibration belongs to (`settings.skin_hash`).
        scale: one unit of the values of a frame, in `unit`.
        frame_hz: frames are thinned to this rate; 0 means that every one is sent.
        calibration: None before the first.
        commands: whether the node takes commands (`mqtt.commands`).
        pieces: number of documents, if one would be too large for the broker. The others are at
            `nodes/<node>/2/info` and so on, equal except for `parts` and `fingertips`.
    """

    schema: Literal["skin.info/1"] = INFO_SCHEMA
    robot: str
    node: str
    version: str
    configuration: str
    unit: Literal["kPa"] = "kPa"
    scale: float = SCALE_KPA
    encoding: Literal["json", "cbor"] = "json"
    frame_hz: float = 0.0
    calibration: CalibrationInfo | None = None
    commands: bool = True
    pieces: Annotated[int, Meta(ge=1, le=MAX_PIECES)] = 1
    parts: Annotated[dict[Name, PartInfo], Meta(max_length=10_000)]
    fingertips: Annotated[dict[Name, FingertipInfo], Meta(max_length=10_000)] = {}


_decoder = msgspec.json.Decoder(NodeInfo)


def node_info(
    layout: "Layout",
    node: str,
    *,
    version: str,
    configuration: str,
    encoding: Literal["json", "cbor"] = "json",
    frame_hz: float = 0.0,
    calibration: CalibrationInfo | None = None,
    commands: bool = True,
    parts: Mapping[str, "Part"] | None = None,
    fingertips: Mapping[str, "Fingertip"] | None = None,
) -> NodeInfo:
    """Describe the parts of `layout`, and of `fingertips` those, that belong to `node`.

    Of parts that are not among `parts` frames are published.
    """
    silent = {name for name, part in (parts or {}).items() if not part.frames}
    described = {
        part.name: _part_info(layout, number, part, frames=part.name not in silent)
        for number, part in enumerate(layout.parts)
        if part.node == node
    }
    return NodeInfo(
        robot=layout.robot,
        node=node,
        version=version,
        configuration=configuration,
        encoding=encoding,
        frame_hz=frame_hz,
        calibration=calibration,
        commands=commands,
        parts=described,
        fingertips={
            name: _fingertip_info(tip)
            for name, tip in (fingertips or {}).items()
            if tip.node == node
        },
    )


def encode_info(info: NodeInfo) -> bytes:
    """Write the payload of `nodes/<node>/info`."""
    return msgspec.json.encode(info)


def encode_pieces(info: NodeInfo, limit: int | None) -> list[bytes]:
    """Write an info as one payload, or as several of at most `limit` bytes.

    A part that is longer by itself follows as a piece that is not counted in `pieces`.
    """
    whole = encode_info(info)
    if limit is None or len(whole) <= limit:
        return [whole]
    bare = replace(info, parts={}, fingertips={}, pieces=MAX_PIECES)
    room = limit - len(encode_info(bare))
    pieces: list[NodeInfo] = []
    large: list[NodeInfo] = []
    free = 0
    for key in ("parts", "fingertips"):
        for name, value in getattr(info, key).items():
            size = len(msgspec.json.encode({name: value}))
            if size > room:
                large.append(replace(bare, **{key: {name: value}}))
                continue
            if size > free:
                pieces.append(bare)
                free = room
            free -= size
            pieces[-1] = replace(pieces[-1], **{key: getattr(pieces[-1], key) | {name: value}})
    pieces = pieces or [bare]
    return [encode_info(replace(one, pieces=len(pieces))) for one in [*pieces, *large]]


def join_pieces(found: Mapping[int, NodeInfo]) -> NodeInfo | None:
    """Put pieces together by their numbers; None while some are missing or of another skin."""
    first = found.get(1)
    if first is None or first.pieces == 1:
        return first
    pieces = [found.get(number) for number in range(1, first.pieces + 1)]
    parts: dict[str, PartInfo] = {}
    fingertips: dict[str, FingertipInfo] = {}
    for one in pieces:
        if one is None or (one.configuration, one.pieces) != (first.configuration, first.pieces):
            return None
        parts |= one.parts
        fingertips |= one.fingertips
    return replace(first, pieces=1, parts=parts, fingertips=fingertips)


def decode_info(payload: bytes) -> NodeInfo:
    """Read the payload of `nodes/<node>/info`.

    Raises:
        MessageError: it is not such a payload.
    """
    info = decode(_decoder, payload, "info", MAX_BYTES)
    for name, part in info.parts.items():
        n = len(part.pads)
        lists: tuple[list[Any], ...] = (part.position_m, part.normal, part.radius_mm, part.area_mm2)
        if any(len(values) != n for values in lists):
            raise MessageError(f"info: parts.{name}: its lists differ in length")
    return info


def _part_info(layout: "Layout", number: int, part: "PartLayout", *, frames: bool) -> PartInfo:
    from skin_host.layout import PadKind

    mine = slice(part.start, part.stop)
    is_thermal = layout.pad_kind[mine] == PadKind.THERMAL
    return PartInfo(
        period_ms=max(layout.boards[board].settings.period_ms for board in part.boards),
        pads=["thermal" if thermal else "pressure" for thermal in is_thermal.tolist()],
        position_m=_vectors(layout.position_m[mine], DECIMALS_M),
        normal=_vectors(layout.normal[mine], _NORMAL),
        radius_mm=_rounded(layout.radius_mm[mine], _MM),
        area_mm2=_rounded(layout.area_mm2[mine], _MM),
        triangles=[
            TriangleInfo(
                layout.boards[triangle.board].name,
                triangle.number,
                triangle.kind,
                triangle.first - part.start,
                _vectors(triangle.outline_m, DECIMALS_M),
                layout.boards[triangle.board].settings.no_load,
            )
            for triangle in layout.triangles
            if triangle.part == number
        ],
        frames=frames,
    )


def _fingertip_info(tip: "Fingertip") -> FingertipInfo:
    size = tip.semi_axes_mm or (() if tip.radius_mm is None else (tip.radius_mm,))
    return FingertipInfo(
        tip.period_ms,
        tip.shape,
        list(size),
        tip.array,
        tip.friction,
        tip.threshold_n,
        tip.over_n,
    )


def _rounded(values: "NDArray[np.float64]", decimals: int) -> Any:
    # Adding 0 turns a rounded -0.0 into 0.0.
    return (values.round(decimals) + 0.0).tolist()


def _vectors(values: "NDArray[np.float64]", decimals: int) -> list[Vector]:
    return [(x, y, z) for x, y, z in _rounded(values, decimals)]


def discovery(prefix: str, topics: Topics, info: NodeInfo) -> dict[str, bytes]:
    """Return topics and payloads, to be retained, that announce the parts and fingertips of a node.

    Args:
        prefix: of Home Assistant's discovery, `homeassistant` by default.
        topics: of the robot.
        info: of the node.
    """
    status = topics.node("status", info.node)
    alive = {"topic": status}
    messages: dict[str, dict[str, Any]] = {}
    for part in [*info.parts, *info.fingertips]:
        health = topics.part("health", part)
        contact = topics.part("contact", part)
        messages[_identifier(contact)] = {
            "name": f"{part} contact",
            "icon": "mdi:gesture-tap",
            "state_topic": contact,
            "value_template": STATE,
            "expire_after": EXPIRE_S,
            "availability": [alive, {"topic": health, "value_template": FEELS}],
            "availability_mode": "all",
        }
        messages[_identifier(health)] = {
            "name": f"{part} problem",
            "device_class": "problem",
            "entity_category": "diagnostic",
            "state_topic": health,
            "value_template": PROBLEM,
            "json_attributes_topic": health,
            "json_attributes_template": WHY,
            "expire_after": EXPIRE_S,
            "availability": [alive],
        }
    common = {
        "qos": 1,
        "device": {
            "identifiers": [_identifier(status)],
            "name": f"{info.robot} skin, node {info.node}",
            "sw_version": info.version,
        },
        "origin": {"name": "skin-host", "sw_version": info.version},
    }
    return {
        _discovery_topic(prefix, name): msgspec.json.encode({"unique_id": name} | message | common)
        for name, message in messages.items()
    }


def discovery_topics(prefix: str, topics: Topics, part: str) -> list[str]:
    """Return the topics that announce a part or fingertip."""
    shown = topics.part("contact", part), topics.part("health", part)
    return [_discovery_topic(prefix, _identifier(topic)) for topic in shown]


def _discovery_topic(prefix: str, name: str) -> str:
    return f"{prefix}/binary_sensor/{name}/config"


def _identifier(topic: str) -> str:
    """Return a name for what a topic of ours shows, of letters, digits, `_` and `-`, which are all
    that a discovery topic may have.

    Two topics have two names, also where they differ only in what such a name cannot have.
    """
    readable = re.sub(r"[^a-zA-Z0-9_-]", "_", topic)
    return f"{readable}_{hashlib.sha256(topic.encode()).hexdigest()[:8]}"
