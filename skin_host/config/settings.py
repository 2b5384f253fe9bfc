"""A configuration file (TOML) as typed settings.

One file describes one robot: its CAN buses, the boards on them, the parts of the
body that their triangles cover, and how the signals are processed and published.
Unknown keys, wrong types, wrong lengths and references to nothing are errors that
name the file and the path inside it. `docs/configuration.md` explains every key.
"""

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from datetime import date, datetime, time
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct, field

from skin_host.config.explain import (
    DEEPEST,
    LARGEST,
    LONGEST_VALUE,
    Named,
    explain,
    out_of_bounds,
    too_deep,
)
from skin_host.config.fields import (
    Address,
    Coefficient,
    FileName,
    Hertz,
    Host,
    Millimetres,
    Name,
    PlaceMm,
    PositiveCoefficient,
    Printable,
    Seconds,
    Units,
    host_and_port,
)
from skin_host.config.fingertips import Fingertip as Fingertip  # noqa: PLC0414 (for others too)
from skin_host.config.relaxation import RelaxationSettings, with_file
from skin_host.errors import ConfigurationError, RequestError, visible
from skin_host.files import read_whole
from skin_host.mqtt.topics import wrong_base
from skin_host.untrusted import from_json

T = TypeVar("T", bound=Struct)
TRIANGLES_PER_BOARD = 16
LAST_PORT = 65535
#: A rate of 0 lets everything pass; another one is at least this.
LEAST_HZ = 0.001


class _Table(Struct, forbid_unknown_fields=True, kw_only=True, frozen=True):
    """Settings never change; `changed` makes others."""


class Bus(_Table, frozen=True):
    """One CAN bus, opened by python-can."""

    interface: Annotated[Printable, Meta(min_length=1)] = "socketcan"
    channel: Annotated[Printable, Meta(min_length=1)] = "can0"
    bitrate: Annotated[int, Meta(ge=1000, le=10_000_000)] = 1_000_000
    #: Further keyword arguments for `can.Bus`, as python-can's own documentation names them.
    options: dict[Printable, Printable | int | float | bool] = {}
    #: Ignore frames of other classes (motors, ...): they are neither read nor counted.
    skin_only: bool = False


#: Skin types that an MTB3 knows, and the one without temperature compensation.
MTB3_SKIN_TYPES = frozenset({0, 1, 2})
UNCOMPENSATED = 2


class Board(_Table, frozen=True):
    """One MTB. Sources: reference of the wire, commands 4D (SET_BRD_CFG)."""

    bus: Name
    address: Annotated[int, Meta(ge=1, le=14)]
    #: Selects the board's known problems to work around on bring-up, and the emulated firmware.
    model: Literal["mtb3", "mtb4", "mtb4c"] = "mtb4"
    period_ms: Annotated[int, Meta(ge=10, le=209)] = 50
    #: 0 with temperature compensation, 1 palm and fingertips, 2 without, 3 ergoHand, 8 V2; an MTB3
    #: acts by 3 and 8 as by 2. With 7, a test mode, boards send the low byte of a word, which is no
    #: measure of pressure.
    skin_type: Literal[0, 1, 2, 3, 8] = 0
    #: At an end of the scale untouched pads would be cut off.
    no_load: Annotated[int, Meta(ge=1, le=254)] = 240

    @property
    def effective_skin_type(self) -> int:
        """The skin type that its firmware acts by: an MTB3 compensates nothing with those that it
        does not know (FillCanMessages8bit of mtb3/main_V3.c).
        """
        known = self.model != "mtb3" or self.skin_type in MTB3_SKIN_TYPES
        return self.skin_type if known else UNCOMPENSATED


class PlaceSettings(_Table, frozen=True):
    """Where one triangle lies: its origin, its rotation, and the normal of its plane.

    The triangle's own frame is rotated about its z axis by `turn_deg`, then its z axis is
    laid along `normal` by the shortest rotation, then moved to (x, y, z).
    """

    x_mm: PlaceMm = 0.0
    y_mm: PlaceMm = 0.0
    z_mm: PlaceMm = 0.0
    turn_deg: float = 0.0
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    mirror: bool = False


class Patch(_Table, frozen=True):
    """Some triangles of one board, all of one kind and with the same set-up (command 50)."""

    board: Name
    #: Triangle numbers of the board, in the order of the part's taxels: "0-4,8".
    triangles: Printable
    kind: Name = "triangle"
    shift: Annotated[int, Meta(ge=0, le=8)] = 2
    cdc_offset: Annotated[int, Meta(ge=0, le=0xFFFF)] = 0x2200
    #: One place per triangle. Without them the triangles are tiled side by side.
    places: list[PlaceSettings] = []
    #: Or a file of taxel positions: one row x y z nx ny nz (m) per taxel of the patch.
    positions: FileName | None = None


class KindSettings(_Table, frozen=True):
    """A kind of sensor unit: 12 pads, or 24, 36, 48 where triangles are cut as one."""

    about: Printable
    pads_mm: list[tuple[PlaceMm, PlaceMm]]
    pitch_mm: Annotated[float, Meta(ge=0.001, le=1000)]
    radius_mm: Millimetres
    outline_mm: list[tuple[PlaceMm, PlaceMm]]
    thermal: list[int] = []


class Part(_Table, frozen=True):
    """A part of the body: one topic, one array of taxels."""

    patches: Annotated[list[Patch], Meta(min_length=1)]
    #: The daemon that reads this part, see `skin run --node`.
    node: Name = "main"
    #: Which objects the skin feels: any, or only grounded ones (no cover).
    covered: bool = True
    foam_mm: Millimetres = 3.0
    #: Whether frames of pressure are published. Without them, touches are still reported, and a
    #: part that nothing touches costs almost nothing.
    frames: bool = True
    #: How a contact is located, see `processing.localization`. All but `centroid` also separate
    #: several contacts in one touched patch.
    localization: Literal["centroid", "half_maximum", "peak", "template"] = "centroid"
    #: For `template`: diameters of touching objects, up to three pitches of the part's pads. A
    #: single one is more precise if it is the right one.
    probe_mm: Annotated[list[Millimetres], Meta(min_length=1, max_length=16)] = field(
        default_factory=lambda: [6.0, 8.0, 10.0, 12.0]
    )


class CalibrationSettings(_Table, frozen=True):
    """How a calibration is taken (paper, section V-A)."""

    seconds: Annotated[float, Meta(ge=0.001, le=86_400)] = 5.0
    percentile: Annotated[float, Meta(gt=0, le=1)] = 0.95


class Pressure(_Table, frozen=True):
    """Counts to kPa. The defaults are the paper's equation (1) and its 2.88 fF at shift 3.

    Other pads and foams are scaled to the pad that the equation was measured on, as plate
    capacitors are: with the area of the pad over the thickness of the foam.
    """

    code_ff: PositiveCoefficient = 0.36
    a_kpa_per_ff2: Coefficient = -0.001132
    b_kpa_per_ff: PositiveCoefficient = 0.8141
    #: The palm of the paper: 2 mm of foam; the radius follows from its Figs. 11 to 13.
    pad_radius_mm: Millimetres = 2.1
    foam_mm: Millimetres = 2.0
    #: Noise in pressures of pads with their own curve is smoothed over this time; larger steps pass
    #: at once. Touches are decided before that. 0 smooths nothing.
    smoothing_s: Annotated[float, Meta(ge=0, le=3600)] = 0.5


class TouchSettings(_Table, frozen=True):
    """The touch decision (paper, section V-B), in units of the 8-bit value."""

    margin_units: Units = 2.0
    minimum_threshold_units: Units = 1.0
    hysteresis_units: Units = 0.5
    #: A touch begins and ends with at least this many measurements; noise or a weak press need
    #: more.
    votes_of_3: Literal[1, 2, 3] = 2
    #: `move` events are sent at most this often for a contact.
    move_hz: Hertz = 50.0


class Drift(_Table, frozen=True):
    """Baseline tracking (paper, section V-C, and the proportional rule of deployed hosts)."""

    rule: Literal["none", "paper", "proportional"] = "proportional"
    rate_units_per_s: Annotated[float, Meta(ge=1e-6, le=100)] = 0.1
    dead_band_units: Units = 0.5
    gain_per_s: Annotated[float, Meta(ge=1e-6, le=100)] = 0.2
    #: A baseline is never moved farther than this from its calibrated value.
    limit_units: Annotated[float, Meta(ge=0.001, le=10_000)] = 40.0
    #: A baseline held still by a touch for longer than this is reported.
    frozen_report_s: Seconds = 600.0


class Processing(_Table, frozen=True):
    """Sweeps to pressure to contacts."""

    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)
    pressure: Pressure = field(default_factory=Pressure)
    relaxation: RelaxationSettings = field(default_factory=RelaxationSettings)
    touch: TouchSettings = field(default_factory=TouchSettings)
    drift: Drift = field(default_factory=Drift)


class Mqtt(_Table, frozen=True):
    """The broker. The password is never stored here: it is read from a file or credential."""

    host: Host = "localhost"
    port: Annotated[int, Meta(ge=1, le=LAST_PORT)] = 1883
    #: Instead of `host`: nodes of a cluster or independent brokers, as "host" or "host:port".
    brokers: Annotated[list[Address], Meta(max_length=16)] = []
    protocol: Literal["5", "3.1.1"] = "5"
    base: str = "skin"
    username: Annotated[Printable, Meta(min_length=1, max_length=1000)] | None = None
    #: A file with the password; otherwise systemd's credential `mqtt-password`.
    password_file: FileName | None = None
    tls: bool = False
    ca_file: FileName | None = None
    certificate_file: FileName | None = None
    key_file: FileName | None = None
    keepalive_s: Annotated[int, Meta(ge=5, le=3600)] = 10
    encoding: Literal["json", "cbor"] = "json"
    frame_hz: Annotated[float, Meta(ge=0, le=1_000_000)] = 0.0
    event_queue: Annotated[int, Meta(ge=16, le=1_000_000)] = 10_000
    commands: bool = True
    #: Publish the parts to Home Assistant below this prefix, usually "homeassistant".
    discovery_prefix: (
        Annotated[str, Meta(pattern=r"^[a-zA-Z0-9_/-]+(?!\n)$", max_length=256)] | None
    ) = None

    def wrong_values(self) -> Iterator[tuple[str, str]]:
        """Values that contradict each other: the key, and the reason."""
        if self.password_file is not None and self.username is None:
            yield "password_file", "needs mqtt.username too"
        for key in ("ca_file", "certificate_file", "key_file"):
            if getattr(self, key) is not None and not self.tls:
                yield key, "is given, but mqtt.tls is not true"
        if self.key_file is not None and self.certificate_file is None:
            yield "key_file", "needs mqtt.certificate_file too"
        ends: set[tuple[str, int]] = set()
        for i, address in enumerate(self.brokers):
            try:
                end = host_and_port(address, self.port)
            except ValueError as error:
                yield f"brokers[{i}]", f"{address}: {error}"
                continue
            if end in ends:
                yield f"brokers[{i}]", f"{address} is named twice"
            ends.add(end)
        if len(self.brokers) > 1 and self.protocol != "5":
            what = 'need mqtt.protocol = "5", by which subscribers distinguish new messages from'
            yield "brokers", f"{len(self.brokers)} brokers {what} old ones"


class Receive(_Table, frozen=True):
    """The receive path, see docs/receive.md."""

    poll_ms: Annotated[float, Meta(ge=0.1, le=1000)] = 4.0
    buffer_bytes: Annotated[int, Meta(ge=65536)] = 4_194_304
    #: A sweep with missing triangles is closed after this many periods. A board whose bus is busy
    #: takes up to half of one to send it.
    close_periods: Annotated[float, Meta(ge=0.5, le=10)] = 0.9
    #: A board in order lets one and a half pass where a sweep is late.
    silent_periods: Annotated[float, Meta(ge=1.5, le=100)] = 4.0


class Service(_Table, frozen=True):
    """The daemon as a whole."""

    #: Calibrations and recordings, from the folder of the configuration; default: systemd's
    #: $STATE_DIRECTORY, otherwise XDG state.
    state_directory: Printable | None = None
    #: Prometheus text on this port of localhost; 0 is off.
    metrics_port: Annotated[int, Meta(ge=0, le=LAST_PORT)] = 0


class Settings(_Table, frozen=True):
    """A whole configuration file."""

    robot: Name
    buses: Annotated[dict[Name, Bus], Meta(min_length=1)]
    boards: Annotated[dict[Name, Board], Meta(min_length=1)]
    parts: Annotated[dict[Name, Part], Meta(min_length=1)]
    #: Kinds of sensor unit beyond the built-in ones.
    kinds: dict[Name, KindSettings] = {}
    #: Fingertips on force/torque boards.
    fingertips: dict[Name, Fingertip] = {}
    processing: Processing = field(default_factory=Processing)
    mqtt: Mqtt = field(default_factory=Mqtt)
    receive: Receive = field(default_factory=Receive)
    service: Service = field(default_factory=Service)


def parse_triangles(text: str) -> list[int]:
    """Turn "0-4,8" into [0, 1, 2, 3, 4, 8].

    Raises:
        ValueError: not such a list, a number outside 0..15, or one named twice.
    """
    numbers: list[int] = []
    shown = visible(text, LONGEST_VALUE)
    for item in map(str.strip, text.split(",")):
        first, dash, last = item.partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            seen = visible(item, LONGEST_VALUE)
            raise ValueError(f'"{shown}": seen "{seen}", wanted a list such as "0-4,8"')
        low, high = _triangle(first), _triangle(last if dash else first)
        if max(low, high) >= TRIANGLES_PER_BOARD:
            raise ValueError(f'"{shown}": a board has triangles 0 to {TRIANGLES_PER_BOARD - 1}')
        if high < low:
            raise ValueError(f'"{shown}": the range "{item}" is reversed')
        numbers.extend(range(low, high + 1))
    if len(set(numbers)) != len(numbers):
        raise ValueError(f'"{shown}": a triangle is named twice')
    return numbers


def _triangle(digits: str) -> int:
    """Return the number of these digits; where it has more than any board, one that no board has.

    Python reads no number of thousands of digits.
    """
    return int(digits) if len(digits) <= LONGEST_VALUE else TRIANGLES_PER_BOARD


def format_triangles(numbers: list[int]) -> str:
    """Turn numbers such as [0, 1, 2, 3, 4, 8] into "0-4,8", as `parse_triangles` reads."""
    runs = []
    for _, run in groupby(enumerate(numbers), key=lambda item: item[1] - item[0]):
        members = [number for _, number in run]
        first, last = members[0], members[-1]
        runs.append(f"{first}-{last}" if last > first else f"{first}")
    return ",".join(runs)


def read_toml(path: Path, table: type[T], named: Named) -> T:
    """Read a file whose keys are those of a table.

    `named` are its sections that hold tables by name, and the type of these.

    Raises:
        ConfigurationError: unreadable, not TOML, or wrong; the message names file and key.
        BusyFileError: another program is writing it.
    """
    try:
        data = read_whole(path)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        # Editors of other systems begin a text with a mark of its coding.
        document = msgspec.toml.decode(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: not TOML: {error}; save it as UTF-8") from None
    except msgspec.DecodeError as error:
        raise ConfigurationError(f"{path}: not TOML: {visible(str(error))}") from None
    except ValueError:  # Python reads no number of more than 4300 digits
        raise ConfigurationError(
            f"{path}: not TOML: holds a number of thousands of digits; wanted numbers "
            f"between {-LARGEST:g} and {LARGEST:g}"
        ) from None
    except RecursionError:
        raise ConfigurationError(f"{path}: not a configuration: nested too deep") from None
    if (place := too_deep(document)) is not None:
        raise ConfigurationError(
            f"{path}: {visible(place, LONGEST_VALUE)}: nested too deep; wanted at most "
            f"{DEEPEST} levels"
        )
    try:
        # The same as `msgspec.toml.decode` with a type: a date is a value of its own.
        found = msgspec.convert(
            document, table, builtin_types=(datetime, date, time), str_keys=True
        )
    except msgspec.ValidationError as error:
        what = explain(document, error, table, named)
        raise ConfigurationError(f"{path}: {visible(what)}") from None
    for where, what in out_of_bounds(document):
        raise ConfigurationError(f"{path}: {visible(f'{where}: {what}')}")
    return found


def load(path: Path) -> Settings:
    """Read and check a configuration file.

    Raises:
        ConfigurationError: unreadable, not TOML, or wrong; the message names file and key.
        BusyFileError: another program is writing it, or a file that it names.
    """
    named: Named = {
        "buses": Bus,
        "boards": Board,
        "parts": Part,
        "kinds": KindSettings,
        "fingertips": Fingertip,
    }
    settings = read_toml(path, Settings, named)
    _check_references(path, settings)
    values: dict[str, Any] = {
        "processing.relaxation": with_file(settings.processing.relaxation, path)
    }
    place = settings.service.state_directory
    if place is not None and not place.startswith("~"):
        # Whole, because a running daemon's is compared with that of another working directory.
        values["service.state_directory"] = os.path.realpath(path.parent / place)
    return changed(settings, values)


def _check_references(path: Path, settings: Settings) -> None:
    def wrong(where: str, what: str) -> ConfigurationError:
        return ConfigurationError(f"{path}: {where}: {visible(what)}")

    if (what := wrong_base(settings.mqtt.base)) is not None:
        raise wrong("mqtt.base", what)
    if 0.0 < settings.mqtt.frame_hz < LEAST_HZ:
        seen = f"seen {settings.mqtt.frame_hz:g}, wanted 0 or at least {LEAST_HZ:g}"
        raise wrong("mqtt.frame_hz", seen)
    for key, what in settings.mqtt.wrong_values():
        raise wrong(f"mqtt.{key}", what)
    # By what a bus is, not by its name: two of one channel both receive what one board sends.
    addresses: dict[tuple[object, int], tuple[str, str]] = {}
    boards: list[tuple[str, str, Board | Fingertip]] = [
        *((f"boards.{name}", f'board "{name}"', board) for name, board in settings.boards.items()),
        *(
            (f"fingertips.{name}", f"fingertips.{name}", tip)
            for name, tip in settings.fingertips.items()
        ),
    ]
    for where, label, board in boards:
        if board.bus not in settings.buses:
            raise wrong(f"{where}.bus", f'no bus "{board.bus}"; {_known(settings.buses)}')
        bus = settings.buses[board.bus]
        wire = (bus.interface, bus.channel, tuple(sorted(bus.options.items())))
        twin, twins_bus = addresses.setdefault((wire, board.address), (label, board.bus))
        if twin != label:
            what = f'{board.address} on bus "{board.bus}" is already that of {twin}'
            if twins_bus != board.bus:
                what += f": buses.{board.bus}.channel is that of buses.{twins_bus}, {bus.channel}"
            raise wrong(f"{where}.address", what)
    used: dict[tuple[str, int], str] = {}
    if "nodes" in settings.parts:
        raise wrong("parts.nodes", "the name is taken by the topics of the nodes; choose another")
    for part_name, part in settings.parts.items():
        for number, patch in enumerate(part.patches):
            where = f"parts.{part_name}.patches[{number}]"
            if patch.board not in settings.boards:
                known = _known(settings.boards)
                raise wrong(f"{where}.board", f'no board "{patch.board}"; {known}')
            try:
                triangles = parse_triangles(patch.triangles)
            except ValueError as error:
                raise wrong(f"{where}.triangles", str(error)) from None
            for triangle in triangles:
                other = used.setdefault((patch.board, triangle), where)
                if other != where:
                    raise wrong(
                        f"{where}.triangles",
                        f'triangle {triangle} of board "{patch.board}" is already in {other}',
                    )
            if patch.places and patch.positions is not None:
                raise wrong(where, "has both `places` and `positions`; wanted one of them")
    unused = set(settings.boards) - {board for board, _ in used}
    if unused:
        raise wrong(f"boards.{min(unused)}", "no part uses this board; remove it or add a patch")
    _check_fingertips(settings, wrong)


def _check_fingertips(settings: Settings, wrong: Callable[[str, str], ConfigurationError]) -> None:
    nodes = {part.node for part in settings.parts.values()}
    covered: dict[str, str] = {}
    for name, tip in settings.fingertips.items():
        where = f"fingertips.{name}"
        if name in settings.parts or name == "nodes":
            raise wrong(where, "the name is taken by another's topics; choose another")
        if tip.array is not None and tip.array not in settings.parts:
            raise wrong(f"{where}.array", f'no part "{tip.array}"; {_known(settings.parts)}')
        if tip.array is not None and (other := covered.setdefault(tip.array, name)) != name:
            raise wrong(f"{where}.array", f'"{tip.array}" already covers fingertips.{other}')
        if tip.array is not None and settings.parts[tip.array].node != tip.node:
            raise wrong(f"{where}.node", f'"{tip.node}", but its array belongs to another node')
        if tip.node not in nodes:
            raise wrong(f"{where}.node", f'no part belongs to node "{tip.node}"')
        for key, what in tip.wrong_values():
            raise wrong(f"{where}.{key}", what)


def _known(table: dict[str, Any]) -> str:
    return "there are: " + ", ".join(table)


def changed(settings: T, values: Mapping[str, Any]) -> T:
    """Return a copy of settings with other values, by their keys: {"mqtt.port": 1883}.

    Raises:
        KeyError: there is no such key.
    """
    for path, value in values.items():
        settings = _changed(settings, path.split("."), value)
    return settings


def _changed(table: Any, keys: list[str], value: Any) -> Any:
    key, *rest = keys
    known = table if isinstance(table, dict) else msgspec.structs.asdict(table)
    if key not in known:
        raise KeyError(key)
    inner = _changed(known[key], rest, value) if rest else value
    if isinstance(table, dict):
        return table | {key: inner}
    return msgspec.structs.replace(table, **{key: inner})


#: Settings of parts that a running node can change, besides `processing`.
_OF_PARTS = ("covered", "foam_mm", "frames", "localization", "probe_mm")
_OF_PATCHES = ("places", "positions")


def load_running(path: Path) -> Settings:
    """Return a daemon's configuration, from the JSON that it wrote at its start.

    Raises:
        RequestError: it is absent or damaged.
    """
    try:
        return from_json(read_whole(path), Settings)
    except OSError as error:
        raise RequestError(
            f"{path}: {error.strerror}; a daemon that runs under systemd writes it"
        ) from None
    except msgspec.DecodeError as error:
        raise RequestError(f"{path}: damaged: {error}; restart the daemon") from None


def needs_restart(old: Settings, new: Settings) -> str | None:
    """Return the first key that differs and that a running node cannot change.

    All keys that are not listed here as changeable must be equal, and in the same order.
    """
    same = changed(new, {"processing": old.processing})
    for name, part in old.parts.items():
        if name not in new.parts or len(new.parts[name].patches) != len(part.patches):
            return f"parts.{name}"
        taken = {key: getattr(part, key) for key in _OF_PARTS}
        patches = [
            msgspec.structs.replace(its, **{key: getattr(mine, key) for key in _OF_PATCHES})
            for mine, its in zip(part.patches, new.parts[name].patches, strict=True)
        ]
        part = msgspec.structs.replace(new.parts[name], patches=patches, **taken)  # noqa: PLW2901
        same = changed(same, {f"parts.{name}": part})
    return _first_difference(msgspec.to_builtins(old), msgspec.to_builtins(same))


def _first_difference(old: Any, new: Any, where: str = "") -> str | None:
    if not isinstance(old, dict) or not isinstance(new, dict):
        return where if old != new else None
    if list(old) != list(new):
        return where or "the tables"
    for key in old:
        found = _first_difference(old[key], new[key], f"{where}.{key}" if where else key)
        if found is not None:
            return found
    return None


def skin_hash(settings: Settings) -> str:
    """Return a hash of what a calibration belongs to: boards, their set-up, parts and fingertips.

    Twelve hexadecimal digits. Processing, publishing, channel names and how lists of triangles are
    written do not count, so a calibration survives a change of the threshold or a move to another
    interface.
    """
    boards = {
        name: [board.bus, board.address, board.skin_type, board.no_load]
        for name, board in settings.boards.items()
    }
    parts = {
        name: [
            [
                patch.board,
                format_triangles(parse_triangles(patch.triangles)),
                patch.kind,
                patch.shift,
                patch.cdc_offset,
            ]
            for patch in part.patches
        ]
        for name, part in settings.parts.items()
    }
    described: list[Any] = [boards, parts]
    if settings.fingertips:
        tips = settings.fingertips.items()
        described.append({name: [tip.bus, tip.address, tip.full_scale] for name, tip in tips})
    return hashlib.sha256(msgspec.json.encode(described)).hexdigest()[:12]
