"""Recordings as three-dimensional scenes, for common robotics tools.

An `.mcap` file for Foxglove holds, besides the recording's own messages, a point cloud of each
part, its contacts as arrows, the parts' transforms, health and further events, in Foxglove's own
Protobuf schemas:
no custom panel is needed. An `.rrd` file holds the same for Rerun.

A configuration does not contain where on the body a part is: the parts lie side by side, each in
its frame.
"""

from collections.abc import Iterable, Iterator, Mapping
from heapq import merge
from itertools import groupby
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.errors import RequestError, required
from skin_host.files import whole_file, write_atomic, writing
from skin_host.fingertip.events import FingertipEvent, Over, Slip
from skin_host.mqtt.info import FingertipInfo, PartInfo
from skin_host.processing.events import Reason, Touch
from skin_host.recording import is_mcap
from skin_host.recording.export.series import HealthLine, Series
from skin_host.recording.mcap import read_records

ROOT = "robot"
#: Distance of two parts that lie side by side.
GAP_M = 0.03
#: Length of a contact's arrow per newton.
ARROW_M_PER_N = 0.01
SHAFT_M, HEAD_M = 0.0015, 0.004
#: From no pressure to the highest of the recording, by the square root: cividis, as on the page.
RAMP = np.array(
    [
        [0x20, 0x3F, 0x6C],
        [0x57, 0x5C, 0x6D],
        [0x8A, 0x87, 0x79],
        [0xC4, 0xB5, 0x6C],
        [253, 233, 69],
    ],
    np.float64,
)
INVALID_RGBA = (150, 150, 150, 60)
ARROW_RGBA = (255, 110, 80, 255)
#: The scale ends at this pressure or above.
LEAST_TOP_KPA = 20.0

#: A fingertip without a size, a plane, gets this much room to either side.
PLANE_M = 0.01
COLOUR = ("red", "green", "blue", "alpha")
#: x, y, z (m), pressure (kPa, 0 where not valid), valid and beyond the calibrated range (0 or 1),
#: colour.
POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("kpa", "<f4")]
    + [(name, "u1") for name in ("valid", "beyond_range", *COLOUR)]
)

Floats = NDArray[np.floating[Any]]


class Arrow(NamedTuple):
    """A contact at an instant: its place, its force (N) into the skin, and whether that is a bound
    from below.
    """

    id: int
    at_m: tuple[float, float, float]
    force_n: tuple[float, float, float]
    is_bound: bool

    @property
    def label(self) -> str:
        bound = "≥ " if self.is_bound else ""
        return f"#{self.id} {bound}{float(np.linalg.norm(self.force_n)):.2f} N"


class Points(NamedTuple):
    """A part at an instant: a record of `POINT` a taxel."""

    part: str
    t_ns: int
    points: NDArray[np.void]


class Arrows(NamedTuple):
    """The contacts of a part from an instant on, and whether anything is known of them: without
    arrows nothing touches the part only then.
    """

    part: str
    t_ns: int
    arrows: list[Arrow]
    is_known: bool = True


class EventLine(NamedTuple):
    """What no arrow shows: a slip, too hard a press, a contact that ended without a release."""

    part: str
    t_ns: int
    text: str


Item = Points | Arrows | HealthLine | EventLine


class SkinScene:
    """Items for a viewer, made from frames and touches as they come.

    The colour scale ends at `top_kpa`; higher pressures raise it.

    Attributes:
        origins_m: where the frame of each part and fingertip lies in the robot's.
        radius_m: of each part's taxels.
    """

    def __init__(
        self,
        shapes: dict[str, PartInfo],
        top_kpa: float = LEAST_TOP_KPA,
        fingertips: Mapping[str, FingertipInfo] | None = None,
    ) -> None:
        self._top_kpa = top_kpa
        self._feels: dict[str, NDArray[np.bool_]] = {}
        self._points: dict[str, NDArray[np.void]] = {}
        self.origins_m = _side_by_side(shapes, fingertips or {})
        self._arrows: dict[str, dict[int, Arrow]] = {name: {} for name in self.origins_m}
        #: Parts of which a contact ended that may still last: their force is not known.
        self._doubtful: set[str] = set()
        self.radius_m = {
            name: float(np.mean(shape.radius_mm or [0.0])) * 1e-3 for name, shape in shapes.items()
        }
        for name, shape in shapes.items():
            feels = np.array([pad == "pressure" for pad in shape.pads], np.bool_)
            points = np.zeros(int(feels.sum()), POINT)
            places_m = np.array(shape.position_m, np.float64).reshape(-1, 3)[feels]
            for axis, key in enumerate("xyz"):
                points[key] = places_m[:, axis]
            self._feels[name], self._points[name] = feels, points

    def points(
        self, part: str, t_ns: int, all_kpa: Floats, beyond_range: NDArray[np.bool_]
    ) -> Points:
        """A frame: pressures of all taxels [m], NaN where not valid, and which are beyond the
        calibrated range [m].
        """
        feels = self._feels[part]
        points, kpa = self._points[part].copy(), all_kpa[feels]
        self._top_kpa = max(self._top_kpa, float(np.nanmax(kpa, initial=0.0)))
        points["valid"] = np.isfinite(kpa)
        points["kpa"] = np.nan_to_num(kpa)
        points["beyond_range"] = beyond_range[feels]
        for key, values in zip(COLOUR, self._colours(kpa).T, strict=True):
            points[key] = values
        return Points(part, t_ns, points)

    def unknown(self, part: str, t_ns: int) -> Points:
        """A part of which nothing is known any more: no taxel is valid."""
        m = len(self._feels[part])
        return self.points(part, t_ns, np.full(m, np.nan), np.zeros(m, np.bool_))

    def _colours(self, kpa: Floats) -> NDArray[np.uint8]:
        """Red, green, blue, alpha uint8[n, 4]."""
        share = np.sqrt(np.clip(np.nan_to_num(kpa) / self._top_kpa, 0.0, 1.0))
        stops = np.linspace(0.0, 1.0, len(RAMP))
        colours = np.full((len(kpa), 4), 255, np.uint8)
        for channel in range(3):
            colours[:, channel] = np.interp(share, stops, RAMP[:, channel]).round()
        colours[~np.isfinite(kpa)] = INVALID_RGBA
        return colours

    def arrows(self, part: str, t_ns: int, touches: Iterable[Touch]) -> Arrows:
        """The contacts of a part after some of its events."""
        there = self._arrows[part]
        reason: Reason | None = None
        for touch in touches:
            there.pop(touch.id, None)
            arrow = _arrow(touch)
            if arrow is not None:
                there[touch.id] = arrow
            if touch.may_last:
                self._doubtful.add(part)
            reason = touch.reason
        is_known = part not in self._doubtful and (bool(there) or reason == "released")
        return Arrows(part, t_ns, list(there.values()), is_known)

    def untouched(self, part: str, t_ns: int, *, is_known: bool = True) -> Arrows:
        """Nothing touches a part, or nothing is known of that, whatever has been received of its
        contacts.
        """
        self._arrows[part].clear()
        if is_known:
            self.end_doubt(part)
        return Arrows(part, t_ns, [], is_known)

    def end_doubt(self, part: str) -> None:
        """Take the contacts of a part that ended without a release for ended from here on."""
        self._doubtful.discard(part)


class RecordedScene:
    """Items of a recording for a viewer, in the order of time.

    Attributes:
        scene: of its parts; its scale ends at the highest pressure of the recording.

    Raises:
        RequestError: the recording has no positions of its taxels.
    """

    def __init__(self, series: Series) -> None:
        self._series = series
        missing = [
            name
            for name, part in series.parts.items()
            if name not in series.shapes
            or len(series.shapes[name].pads) != part.pressure_kpa.shape[1]
        ]
        if missing:
            raise RequestError(
                f"the recording has no positions of the taxels of {', '.join(missing)}; name "
                "its configuration with --config, or record `nodes/<node>/info` too"
            )
        peak_kpa = max(
            (float(np.nanmax(part.pressure_kpa, initial=0.0)) for part in series.parts.values()),
            default=0.0,
        )
        self.scene = SkinScene(series.shapes, max(LEAST_TOP_KPA, peak_kpa), series.fingertips)

    @property
    def start_ns(self) -> int:
        """Time of the first frame; without frames, of the first event."""
        series = self._series
        first_ns = [int(part.t_ns[0]) for part in series.parts.values()]
        others = (series.touches, series.slips, series.overs, series.health)
        return min(first_ns or [events[0].t_ns for events in others if events], default=0)

    def items(self) -> Iterator[Item]:
        """Everything, in the order of time."""
        courses: list[Iterator[Item]] = [self._points(name) for name in self._series.parts]
        courses += [self._unknown(name) for name in self._series.parts]
        courses += [self._arrows(name) for name in self.scene.origins_m]
        series = self._series
        for events in (series.touches, series.slips, series.overs):
            courses.append(filter(None, map(event_line, events)))
        courses.append(iter(series.health))
        yield from merge(*courses, key=lambda item: item.t_ns)

    def _points(self, name: str) -> Iterator[Item]:
        part = self._series.parts[name]
        rows = zip(part.t_ns.tolist(), part.pressure_kpa, part.beyond_range, strict=True)
        for t_ns, kpa, beyond_range in rows:
            yield self.scene.points(name, t_ns, kpa, beyond_range)

    def _unknown(self, name: str) -> Iterator[Item]:
        for t_ns in self._series.gone_ns(name):
            yield self.scene.unknown(name, t_ns)

    def _arrows(self, name: str) -> Iterator[Item]:
        mine = (touch for touch in self._series.touches if touch.part == name)
        by_time = groupby(mine, key=attrgetter("t_ns"))
        gone: Iterator[tuple[int, list[Touch] | bool]]
        gone = ((t_ns, False) for t_ns in self._series.gone_ns(name))
        states = [line for line in self._series.contacts if line.part == name]
        untouched = ((line.t_ns, True) for line in states if line.state == "OFF")
        touched = ((t_ns, list(touches)) for t_ns, touches in by_time)
        shown: Arrows | None = None
        for t_ns, what in merge(gone, touched, untouched, key=itemgetter(0)):
            if isinstance(what, list):
                shown = self.scene.arrows(name, t_ns, what)
                if not states:
                    self.scene.end_doubt(name)  # or no event of the recording would
            elif not what:
                shown = self.scene.untouched(name, t_ns, is_known=False)
            elif shown is None or not (shown.is_known or shown.arrows):
                # States have the recorder's time: one may come after the touch that follows it.
                shown = self.scene.untouched(name, t_ns)
            else:
                continue
            yield shown


def _arrow(touch: Touch) -> Arrow | None:
    if touch.event == "end" or touch.centroid_m is None:
        return None
    if touch.load is not None:
        force_n = touch.load.force_n
    else:
        x, y, z = touch.normal or (0.0, 0.0, 1.0)
        force_n = (-x * touch.force_n, -y * touch.force_n, -z * touch.force_n)
    return Arrow(touch.id, touch.centroid_m, force_n, touch.force_is_bound)


def event_line(event: FingertipEvent) -> EventLine | None:
    """Return an event as a line; None for one that arrows show."""
    who = f"{event.part}: contact {event.id}"
    match event:
        case Touch() if event.may_last:
            text = f"{who} ended without a release ({event.reason}): it may still last"
        case Touch():
            return None
        case Slip(event="begin"):
            text = (
                f"{who} begins to slip ({event.cause}): {event.force_n:.2f} N, "
                f"{event.shear_n:.2f} N along the surface"
            )
        case Slip():
            text = f"{who} slips no longer"
        case Over(event="begin"):
            text = f"{who} presses too hard: {event.force_n:.2f} N"
        case Over():
            text = f"{who} presses too hard no longer"
    return EventLine(event.part, event.t_ns, text)


def _side_by_side(
    shapes: Mapping[str, PartInfo], fingertips: Mapping[str, FingertipInfo]
) -> dict[str, tuple[float, float, float]]:
    """Return where the frame of each part lies; skin on a fingertip has the fingertip's frame."""
    extents_m: dict[str, tuple[float, float]] = {}
    for name, shape in shapes.items():
        # Anybody may publish a part without taxels.
        xs_m = [x_m for x_m, _, _ in shape.position_m] or [0.0]
        extents_m[name] = min(xs_m), max(xs_m)
    for name, tip in fingertips.items():
        if tip.array not in shapes and name not in shapes:
            half_m = max(tip.size_mm, default=PLANE_M * 1e3) * 1e-3
            extents_m[name] = -half_m, half_m
    origins: dict[str, tuple[float, float, float]] = {}
    next_m = 0.0
    for name, (low_m, high_m) in extents_m.items():
        origins[name] = (next_m - low_m, 0.0, 0.0)
        next_m += high_m - low_m + GAP_M
    for name, tip in fingertips.items():
        if name not in origins and tip.array is not None:
            origins[name] = origins[tip.array]
    return origins


def write_foxglove(series: Series, recording: Path | None, output: Path) -> None:
    """Write an MCAP file with what Foxglove's 3D, plot and log panels show as they are.

    Messages of `recording` itself are taken along if it is MCAP.

    Raises:
        SkinError: a package of the extra `foxglove` is not installed, or writing fails.
        RequestError: see `RecordedScene`.
    """
    required("mcap_protobuf", "scenes for Foxglove", "foxglove")
    required("foxglove_schemas_protobuf", "scenes for Foxglove", "foxglove")
    from mcap.writer import Writer

    scene = RecordedScene(series)
    with whole_file(output) as growing, growing.open("wb") as file:
        writer: Any = Writer(file)
        writer.start(profile="", library="skin-host")
        if recording is not None and is_mcap(recording):
            _copy(recording, writer)
        _Foxglove(writer).write(scene)
        writer.finish()


def _copy(recording: Path, writer: Any) -> None:
    """Write every message of a file as it is."""
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    for schema, channel, message in read_records(recording):
        if channel.id not in channels:
            if schema is not None and schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            channels[channel.id] = writer.register_channel(
                topic=channel.topic,
                message_encoding=channel.message_encoding,
                schema_id=0 if schema is None else schemas[schema.id],
                metadata=channel.metadata,
            )
        writer.add_message(
            channel_id=channels[channel.id],
            log_time=message.log_time,
            publish_time=message.publish_time,
            sequence=message.sequence,
            data=message.data,
        )


class _Foxglove:
    """Writes items as Foxglove's Protobuf messages."""

    def __init__(self, writer: Any) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}

    def write(self, scene: RecordedScene) -> None:
        self._add("/tf", scene.start_ns, transforms(scene.scene, scene.start_ns))
        for item in scene.items():
            self._add(*foxglove_message(item))

    def _add(self, topic: str, t_ns: int, message: Any) -> None:
        from mcap_protobuf.schema import register_schema

        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(
                topic=topic,
                message_encoding="protobuf",
                schema_id=register_schema(self._writer, type(message)),
            )
        self._writer.add_message(
            channel_id=self._channels[topic],
            log_time=t_ns,
            publish_time=t_ns,
            data=message.SerializeToString(),
        )


def foxglove_message(item: Item) -> tuple[str, int, Any]:
    """Topic, time (ns) and message in Foxglove's Protobuf schemas."""
    match item:
        case Points(part, t_ns, _):
            return f"/{part}/points", t_ns, _cloud(item)
        case Arrows(part, t_ns, _, _):
            return f"/{part}/contacts", t_ns, _update(item)
        case EventLine(_, t_ns, _):
            return "/events", t_ns, _log(item, is_warning=True)
        case HealthLine(_, t_ns, state, _):
            return "/health", t_ns, _log(item, is_warning=state != "ok")


def transforms(scene: SkinScene, t_ns: int) -> Any:
    """Foxglove's message about where the parts' frames lie."""
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms

    message = FrameTransforms()
    for part, (x, y, z) in scene.origins_m.items():
        one = FrameTransform(parent_frame_id=ROOT, child_frame_id=part)
        one.timestamp.FromNanoseconds(t_ns)
        one.translation.x, one.translation.y, one.translation.z = x, y, z
        one.rotation.w = 1.0
        message.transforms.append(one)
    return message


def _cloud(item: Points) -> Any:
    from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

    kinds = {np.dtype("<f4"): PackedElementField.FLOAT32, np.dtype("u1"): PackedElementField.UINT8}
    message = PointCloud(
        frame_id=item.part, point_stride=POINT.itemsize, data=item.points.tobytes()
    )
    message.timestamp.FromNanoseconds(item.t_ns)
    message.pose.orientation.w = 1.0
    assert POINT.fields is not None
    for name, (kind, offset, *_) in POINT.fields.items():
        message.fields.append(PackedElementField(name=name, offset=offset, type=kinds[kind]))
    return message


def _update(item: Arrows) -> Any:
    from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    # One entity a part: the next one of its id replaces it, so that contacts end.
    entity = SceneEntity(id=item.part, frame_id=item.part)
    entity.timestamp.FromNanoseconds(item.t_ns)
    for arrow in item.arrows:
        force_n = np.array(arrow.force_n)
        size_n = float(np.linalg.norm(force_n))
        shown = entity.arrows.add()
        start_m = np.array(arrow.at_m) - force_n * ARROW_M_PER_N
        where = shown.pose.position
        where.x, where.y, where.z = start_m.tolist()
        turn = shown.pose.orientation
        turn.x, turn.y, turn.z, turn.w = turned_from_x(force_n)
        shown.shaft_length = max(0.0, size_n * ARROW_M_PER_N - HEAD_M)
        shown.shaft_diameter = SHAFT_M
        shown.head_length = min(HEAD_M, size_n * ARROW_M_PER_N)
        shown.head_diameter = 2 * SHAFT_M
        _paint(shown.color)
        words = entity.texts.add()
        words.text = arrow.label
        place = words.pose.position
        place.x, place.y, place.z = start_m.tolist()
        words.pose.orientation.w = 1.0
        words.billboard = True
        words.font_size = 12.0
        words.scale_invariant = True
        _paint(words.color)
    return SceneUpdate(entities=[entity])


def _paint(colour: Any) -> None:
    colour.r, colour.g, colour.b, colour.a = (channel / 255 for channel in ARROW_RGBA)


def turned_from_x(direction: Floats) -> tuple[float, float, float, float]:
    """The quaternion x, y, z, w of the shortest turn from the x axis to a direction."""
    size = float(np.linalg.norm(direction))
    if size == 0:
        return 0.0, 0.0, 0.0, 1.0
    x, y, z = (direction / size).tolist()
    if x < -1 + 1e-9:
        return 0.0, 0.0, 1.0, 0.0
    turn = np.array([0.0, -z, y, 1.0 + x])
    ix, iy, iz, w = (turn / np.linalg.norm(turn)).tolist()
    return ix, iy, iz, w


def _log(item: HealthLine | EventLine, *, is_warning: bool) -> Any:
    from foxglove_schemas_protobuf.Log_pb2 import Log

    level = Log.WARNING if is_warning else Log.INFO
    message = Log(level=level, name=item.part, message=item.text)
    message.timestamp.FromNanoseconds(item.t_ns)
    return message


def write_rerun(series: Series, output: Path) -> None:
    """Write a recording for Rerun: points, arrows of contacts, forces over time, health.

    Raises:
        SkinError: the package of the extra `rerun` is not installed, or the file cannot be written.
        RequestError: see `RecordedScene`.
    """
    rr = required("rerun", "recordings for Rerun", "rerun")
    scene = RecordedScene(series)
    stream = rr.RecordingStream("skin-host")
    # Its own writer of files never ends on a full disk.
    encoded = stream.binary_stream()
    try:
        shown = RerunStream(stream, scene.scene)
        for item in scene.items():
            shown.show(item)
    finally:
        # What is not read is waited for when this is deleted, and never comes: the thread that
        # brings it waits for Python's lock.
        data = encoded.read()
    with writing(output):
        write_atomic(output, data or b"")


class RerunStream:
    """Logs items to a recording stream of Rerun, which goes to a file or to a viewer.

    What is not known is NaN in its courses over time: 0 would be untouched.
    """

    def __init__(self, stream: Any, scene: SkinScene) -> None:
        self._rr = rr = required("rerun", "views in Rerun", "rerun")
        self._stream = stream
        self._scene = scene
        stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for part, origin_m in scene.origins_m.items():
            stream.log(f"{ROOT}/{part}", rr.Transform3D(translation=origin_m), static=True)

    def show(self, item: Item) -> None:
        rr, stream = self._rr, self._stream
        stream.set_time("time", timestamp=np.datetime64(item.t_ns, "ns"))
        where = f"{ROOT}/{item.part}"
        match item:
            case Points(part, _, points):
                places_m = np.stack([points[axis] for axis in "xyz"], axis=1)
                colours = np.stack([points[key] for key in COLOUR], axis=1)
                radius_m = self._scene.radius_m[part]
                cloud = rr.Points3D(places_m, colors=colours, radii=radius_m)
                stream.log(f"{where}/taxels", cloud)
                kpa = points["kpa"][points["valid"] > 0]
                stream.log(f"kpa/{part}", rr.Scalars(float(kpa.max()) if len(kpa) else np.nan))
            case Arrows(part, _, arrows, is_known):
                forces_n = np.array([one.force_n for one in arrows]).reshape(-1, 3)
                starts_m = np.array([one.at_m for one in arrows]).reshape(-1, 3)
                shown = rr.Arrows3D(
                    origins=starts_m - forces_n * ARROW_M_PER_N,
                    vectors=forces_n * ARROW_M_PER_N,
                    colors=[ARROW_RGBA] * len(arrows),
                    labels=[one.label for one in arrows],
                )
                stream.log(f"{where}/contacts", shown)
                total_n = float(np.linalg.norm(forces_n, axis=1).sum()) if is_known else np.nan
                stream.log(f"force_n/{part}", rr.Scalars(total_n))
            case HealthLine():
                level = "INFO" if item.state == "ok" else "WARN"
                stream.log("health", rr.TextLog(item.text, level=level))
            case EventLine():
                stream.log("events", rr.TextLog(item.text, level="WARN"))
