"""A configuration file (TOML) as typed settings.

One file describes one robot: its CAN buses, the boards on them, the parts of the
body that their triangles cover, and how the signals are processed and published.
Unknown keys, wrong types, wrong lengths and references to nothing are errors that
name the file and the path inside it. `docs/configuration.md` explains every key.
"""

import hashlib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct, field

from skin_host.errors import ConfigurationError
from skin_host.explain import Named, explain, not_finite
from skin_host.fields import Name, NotNegative, Positive
from skin_host.fingertip.settings import Fingertip as Fingertip  # noqa: PLC0414 (for others too)
from skin_host.fingertip.settings import wrong_references
from skin_host.relaxation_settings import Relaxation, with_file, wrong_parameters

Byte = Annotated[int, Meta(ge=0, le=255)]
T = TypeVar("T", bound=Struct)
TRIANGLES_PER_BOARD = 16


class _Table(Struct, forbid_unknown_fields=True, kw_only=True):
    pass


class Bus(_Table):
    """One CAN bus, opened by python-can."""

    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: int = 1_000_000
    #: Further keyword arguments for `can.Bus`, as python-can's own documentation names them.
    options: dict[str, str | int | float | bool] = {}
    #: Leave the frames of other classes (motors, ...) to others: they are not read, nor counted.
    skin_only: bool = False


class Board(_Table):
    """One MTB. Sources: reference of the wire, commands 4D (SET_BRD_CFG)."""

    bus: Name
    address: Annotated[int, Meta(ge=1, le=14)]
    #: Sets the pitfalls that are worked around on bring-up, and what the emulator imitates.
    model: Literal["mtb3", "mtb4", "mtb4c"] = "mtb4"
    period_ms: Annotated[int, Meta(ge=10, le=209)] = 50
    #: 0 with temperature compensation, 1 palm and fingertips, 2 without, 3 ergoHand, 7 raw, 8 V2.
    skin_type: Literal[0, 1, 2, 3, 7, 8] = 0
    no_load: Byte = 240


class Place(_Table):
    """Where one triangle lies: its origin, its turn, and the normal of its plane.

    The triangle's own frame is turned about its z axis by `turn_deg`, then its z axis is
    laid along `normal` by the shortest rotation, then moved to (x, y, z).
    """

    x_mm: float = 0.0
    y_mm: float = 0.0
    z_mm: float = 0.0
    turn_deg: float = 0.0
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    mirror: bool = False


class Patch(_Table):
    """Some triangles of one board, all of one kind and set up alike (command 50)."""

    board: Name
    #: Triangle numbers of the board, in the order of the part's taxels: "0-4,8".
    triangles: str
    kind: Name = "triangle"
    shift: Annotated[int, Meta(ge=0, le=8)] = 2
    cdc_offset: Annotated[int, Meta(ge=0, le=0xFFFF)] = 0x2200
    #: One place per triangle. Without them the triangles are tiled side by side.
    places: list[Place] = []
    #: Or a file of taxel positions: one row x y z nx ny nz (m) per taxel of the patch.
    positions: str | None = None


class Kind(_Table):
    """A kind of sensor unit: 12 pads, or 24, 36, 48 where triangles are cut as one."""

    about: str
    pads_mm: list[tuple[float, float]]
    pitch_mm: Positive
    radius_mm: Positive
    area_mm2: Positive
    outline_mm: list[tuple[float, float]]
    thermal: list[int] = []


class Part(_Table):
    """A part of the body: one topic, one array of taxels."""

    patches: Annotated[list[Patch], Meta(min_length=1)]
    #: The daemon that reads this part, see `skin run --node`.
    node: Name = "main"
    #: Kinds of object that the skin feels: any, or only grounded ones (no cover).
    covered: bool = True
    foam_mm: Positive = 3.0
    #: Whether frames of pressure are published. Without them, touches are told all the same,
    #: and a part that nothing touches costs next to nothing.
    frames: bool = True
    #: Where in a contact, see `processing.localization`. All but `centroid` also tell several
    #: contacts in one touched patch apart.
    localization: Literal["centroid", "half_maximum", "peak", "template"] = "centroid"
    #: For `template`: diameters of what may touch. One is sharper if it is the right one.
    probe_mm: Annotated[list[Positive], Meta(min_length=1)] = field(
        default_factory=lambda: [6.0, 8.0, 10.0, 12.0]
    )


class Calibration(_Table):
    """How a calibration is taken (paper, section V-A)."""

    seconds: Positive = 5.0
    percentile: Annotated[float, Meta(gt=0, le=1)] = 0.95


class Pressure(_Table):
    """Counts to kPa. The defaults are the paper's equation (1) and its 2.88 fF at shift 3.

    Other pads and foams are scaled to the pad that the equation was measured on, as plate
    capacitors are: with the area of the pad over the thickness of the foam.
    """

    code_ff: Positive = 0.36
    a_kpa_per_ff2: float = -0.001132
    b_kpa_per_ff: Positive = 0.8141
    #: The palm of the paper: 2 mm of foam; the radius follows from its Figs. 11 to 13.
    pad_radius_mm: Positive = 2.1
    foam_mm: Positive = 2.0


class Touch(_Table):
    """The touch decision (paper, section V-B), in units of the 8-bit value."""

    margin_units: NotNegative = 2.0
    minimum_threshold_units: NotNegative = 1.0
    hysteresis_units: NotNegative = 0.5
    #: A taxel is touched when so many of its last three samples say so. Of two, both must be
    #: above what noise does; else a third is needed.
    votes_of_3: Literal[1, 2, 3] = 2
    #: `move` events are sent at most this often for a contact.
    move_hz: Positive = 50.0


class Drift(_Table):
    """Baseline tracking (paper, section V-C, and the proportional rule of deployed hosts)."""

    rule: Literal["none", "paper", "proportional"] = "proportional"
    rate_units_per_s: Positive = 0.1
    dead_band_units: NotNegative = 0.5
    gain_per_s: Positive = 0.2
    #: A baseline is never moved farther than this from its calibrated value.
    limit_units: Positive = 40.0
    #: A baseline held still by a touch for longer than this is reported.
    frozen_report_s: Positive = 600.0


class Processing(_Table):
    """Sweeps to pressure to contacts."""

    calibration: Calibration = field(default_factory=Calibration)
    pressure: Pressure = field(default_factory=Pressure)
    relaxation: Relaxation = field(default_factory=Relaxation)
    touch: Touch = field(default_factory=Touch)
    drift: Drift = field(default_factory=Drift)


class Mqtt(_Table):
    """The broker. The password never stands here: it is read from a file or credential."""

    host: str = "localhost"
    port: Annotated[int, Meta(ge=1, le=65535)] = 1883
    protocol: Literal["5", "3.1.1"] = "5"
    base: str = "skin"
    username: str | None = None
    #: A file with the password; else systemd's credential `mqtt-password`.
    password_file: str | None = None
    tls: bool = False
    ca_file: str | None = None
    certificate_file: str | None = None
    key_file: str | None = None
    keepalive_s: Annotated[int, Meta(ge=5, le=3600)] = 10
    encoding: Literal["json", "cbor"] = "json"
    frame_hz: Annotated[float, Meta(ge=0)] = 0.0
    event_queue: Annotated[int, Meta(ge=16, le=1_000_000)] = 10_000
    commands: bool = True
    #: Tell Home Assistant of the parts below this prefix, "homeassistant" as a rule.
    discovery_prefix: Annotated[str, Meta(pattern=r"^[a-zA-Z0-9_/-]+$")] | None = None


class Receive(_Table):
    """The receive path, see docs/receive.md."""

    poll_ms: Annotated[float, Meta(gt=0, le=1000)] = 4.0
    buffer_bytes: Annotated[int, Meta(ge=65536)] = 4_194_304
    #: A sweep whose triangles have not all come is closed after this many periods.
    close_periods: Positive = 0.9
    silent_periods: Positive = 4.0


class Service(_Table):
    """The daemon as a whole."""

    #: Calibrations and recordings; default: systemd's $STATE_DIRECTORY, else XDG state.
    state_directory: str | None = None
    #: Prometheus text on this port of localhost; 0 is off.
    metrics_port: Annotated[int, Meta(ge=0, le=65535)] = 0


class Settings(_Table):
    """A whole configuration file."""

    robot: Name
    buses: Annotated[dict[Name, Bus], Meta(min_length=1)]
    boards: Annotated[dict[Name, Board], Meta(min_length=1)]
    parts: Annotated[dict[Name, Part], Meta(min_length=1)]
    #: Kinds of sensor unit beyond the built-in ones.
    kinds: dict[Name, Kind] = {}
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
    for item in text.split(","):
        first, dash, last = item.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise ValueError(f'"{text}": seen "{item.strip()}", wanted a list such as "0-4,8"')
        low, high = int(first), int(last if dash else first)
        if max(low, high) >= TRIANGLES_PER_BOARD:
            raise ValueError(f'"{text}": a board has triangles 0 to {TRIANGLES_PER_BOARD - 1}')
        if high < low:
            raise ValueError(f'"{text}": the range "{item.strip()}" runs backwards')
        numbers.extend(range(low, high + 1))
    if len(set(numbers)) != len(numbers):
        raise ValueError(f'"{text}": a triangle is named twice')
    return numbers


def read_toml(path: Path, table: type[T], named: Named) -> T:
    """Read a file whose keys are those of a table.

    Args:
        path: of the file.
        table: what it must be.
        named: its sections that hold tables by name, and the type of these.

    Raises:
        ConfigurationError: unreadable, not TOML, or wrong; the message names file and key.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        found = msgspec.toml.decode(data, type=table)
    except msgspec.ValidationError as error:
        what = explain(msgspec.toml.decode(data), error, table, named)
        raise ConfigurationError(f"{path}: {what}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: not TOML: {error}") from None
    for where, number in not_finite(msgspec.toml.decode(data)):
        raise ConfigurationError(f"{path}: {where}: seen {number}, wanted a finite number")
    return found


def load(path: Path) -> Settings:
    """Read and check a configuration file.

    Raises:
        ConfigurationError: unreadable, not TOML, or wrong; the message names file and key.
    """
    named: Named = {
        "buses": Bus,
        "boards": Board,
        "parts": Part,
        "kinds": Kind,
        "fingertips": Fingertip,
    }
    settings = read_toml(path, Settings, named)
    _check_references(path, settings)
    processing = settings.processing
    relaxation = with_file(processing.relaxation, path)
    processing = msgspec.structs.replace(processing, relaxation=relaxation)
    return msgspec.structs.replace(settings, processing=processing)


def _check_references(path: Path, settings: Settings) -> None:
    def wrong(where: str, what: str) -> ConfigurationError:
        return ConfigurationError(f"{path}: {where}: {what}")

    addresses: dict[tuple[str, int], str] = {}
    for name, board in settings.boards.items():
        if board.bus not in settings.buses:
            raise wrong(f"boards.{name}.bus", f'no bus "{board.bus}"; {_known(settings.buses)}')
        twin = addresses.setdefault((board.bus, board.address), name)
        if twin != name:
            raise wrong(
                f"boards.{name}.address",
                f'{board.address} on bus "{board.bus}" is already that of board "{twin}"',
            )
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
    for where, what in wrong_references(settings):
        raise wrong(where, what)
    misfit = wrong_parameters(settings.processing.relaxation)
    if misfit is not None:
        raise wrong("processing.relaxation", misfit)


def _known(table: dict[str, Any]) -> str:
    return "there are: " + ", ".join(table)


def skin_hash(settings: Settings) -> str:
    """Identify what a calibration belongs to: the boards, their set-up, parts and fingertips.

    Twelve hexadecimal digits. Processing, publishing and channel names do not count, so
    a calibration survives a change of the threshold or a move to another interface.
    """
    boards = {
        name: [board.bus, board.address, board.skin_type, board.no_load]
        for name, board in settings.boards.items()
    }
    parts = {
        name: [
            [patch.board, patch.triangles, patch.kind, patch.shift, patch.cdc_offset]
            for patch in part.patches
        ]
        for name, part in settings.parts.items()
    }
    described: list[Any] = [boards, parts]
    if settings.fingertips:
        tips = settings.fingertips.items()
        described.append({name: [tip.bus, tip.address, tip.full_scale] for name, tip in tips})
    return hashlib.sha256(msgspec.json.encode(described)).hexdigest()[:12]
