"""Writes the frames of the boards as a DBC file, for cantools, SavvyCAN, Wireshark and others.

The two frames of a triangle share an identifier and differ in their first byte, and so do the
commands and the answers of a board: in a DBC file that byte is a multiplexer. Force/torque boards
send words; they are N and N m where the full scales are known.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from itertools import groupby
from typing import NamedTuple

from skin_host.bus.answers import ANSWERS, TX_OVERFLOW_TYPE, DiscoveredBootloader
from skin_host.bus.commands import (
    COMMANDS,
    Message,
    SetTransmissionPeriod,
    SetTxMode,
    TactileSetup,
)
from skin_host.bus.strain import (
    ZERO_WORD,
    FullScale,
    GetFullScale,
    StrainMode,
    StrainType,
)
from skin_host.bus.wire import (
    BROADCAST_ADDRESS,
    HEADER_A,
    HEADER_B,
    HOST_ADDRESS,
    TAXELS,
    TRIANGLES,
    VALUES_A,
    MessageClass,
    identifier,
    skin_id,
)
from skin_host.config.fingertips import Fingertip, Six
from skin_host.errors import RequestError
from skin_host.layout import Layout

ADDRESSES = range(1, 15)
_BYTES = {"B": 1, "H": 2, "I": 4}
#: Unit of the commands' timer (reference of the wire, command 4C).
_TIMER_US = 3.2
#: Full scales for words without a unit.
_WORDS = (ZERO_WORD,) * 3
#: Nodes that are no board.
_RESERVED = ("host", "all")
#: Commands and answers of force/torque boards, besides their streams.
_STRAIN_COMMANDS = (SetTxMode, SetTransmissionPeriod, GetFullScale)
_STRAIN_ANSWERS = (FullScale,)


class _Board(NamedTuple):
    """A board to describe: its name, address, and each triangle with what it is."""

    name: str
    address: int
    triangles: list[tuple[int, str]]


class _Sensor(NamedTuple):
    """A force/torque board; its full scales (N, N m) if they are known."""

    name: str
    address: int
    full_scale: Six | None = None


class _Signal(NamedTuple):
    name: str
    start: int
    bits: int
    multiplexed: str = ""
    factor: float = 1.0
    offset: float = 0.0
    unit: str = ""
    big_endian: bool = False


def dbc_text(
    layout: Layout | None = None,
    bus: str | None = None,
    fingertips: Mapping[str, Fingertip] | None = None,
) -> str:
    """Return a DBC file.

    Args:
        layout: describe the boards and triangles of this skin; None for all possible ones.
        bus: of the layout's buses; None if there is only one.
        fingertips: of the same robot, by name: those on force/torque boards.

    Raises:
        RequestError: the layout has several buses and none is named, or not this one.
    """
    if layout is None:
        boards, sensors = _every_board(), [_Sensor(f"FT{n}", n) for n in ADDRESSES]
    else:
        tips = fingertips or {}
        bus = _chosen(bus, layout, tips)
        taken = set(_RESERVED)
        boards = _boards_of(layout, bus, taken)
        sensors = _sensors_of(tips, bus, taken)
    lines = [
        'VERSION ""',
        "",
        "NS_ :",
        "",
        "BS_:",
        "",
        "BU_: host "
        + " ".join([*(board.name for board in boards), *(sensor.name for sensor in sensors)]),
        "",
    ]
    remarks: list[str] = []
    values: list[str] = []
    commands, answers = COMMANDS, ANSWERS
    if layout is None:  # a board of either sort may have the address
        commands = [GetFullScale, *COMMANDS]
        answers = [FullScale, *ANSWERS]
    for board in boards:
        for triangle, about in board.triangles:
            can_id = skin_id(board.address, triangle)
            name = f"{board.name}_T{triangle:02}"
            lines += _message(can_id, name, 8, board.name, "host", _skin_signals())
            remarks.append(f'CM_ BO_ {can_id} "{about}";')
            values.append(f'VAL_ {can_id} Header {HEADER_A} "first seven" {HEADER_B} "last five" ;')
        _add_commands(board, commands, answers, lines, values)
        can_id = identifier(MessageClass.MANAGEMENT, board.address, TX_OVERFLOW_TYPE)
        lines += _message(can_id, f"{board.name}_tx_overflow", 0, board.name, "host", [])
    for sensor in sensors:
        _add_streams(sensor, lines, remarks)
        if layout is not None:
            _add_commands(sensor, _STRAIN_COMMANDS, _STRAIN_ANSWERS, lines, values)
    _add_commands(_Board("all", BROADCAST_ADDRESS, []), COMMANDS, (), lines, values)
    return "\n".join([*lines, *remarks, "", *values, ""])


def _every_board() -> list[_Board]:
    return [
        _Board(f"MTB{address}", address, [(i, f"triangle {i}") for i in range(TRIANGLES)])
        for address in ADDRESSES
    ]


def _chosen(bus: str | None, layout: Layout, tips: Mapping[str, Fingertip]) -> str:
    used = [board.settings.bus for board in layout.boards] + [tip.bus for tip in tips.values()]
    buses = list(dict.fromkeys(used))
    if bus is None and len(buses) > 1:
        raise RequestError(f"the configuration has several buses; choose one: {', '.join(buses)}")
    bus = bus or buses[0]
    if bus not in buses:
        raise RequestError(f'no bus "{bus}"; there are: {", ".join(buses)}')
    return bus


def _boards_of(layout: Layout, bus: str, taken: set[str]) -> list[_Board]:
    found = []
    for number, board in enumerate(layout.boards):
        if board.settings.bus != bus:
            continue
        triangles = []
        for triangle in layout.triangles:
            if triangle.board == number:
                part = layout.parts[triangle.part]
                first = triangle.first - part.start
                about = f"{part.name}, taxels {first} to {first + TAXELS - 1}"
                triangles.append((triangle.number, about))
        name, address = _symbol(board.name, taken), board.settings.address
        found.append(_Board(name, address, sorted(triangles)))
    return found


def _sensors_of(tips: Mapping[str, Fingertip], bus: str, taken: set[str]) -> list[_Sensor]:
    found = []
    for name, tip in tips.items():
        if tip.bus == bus:
            found.append(_Sensor(_symbol(name, taken, "_ft"), tip.address, tip.full_scale))
    return found


def _symbol(name: str, taken: set[str], suffix: str = "_") -> str:
    """Return a name as a DBC file accepts it, and take it: an identifier that no other node has."""
    symbol = name.replace("-", "_")
    if not symbol[0].isalpha() or symbol in _RESERVED:
        symbol = f"board_{symbol}"
    while symbol in taken:
        symbol += suffix
    taken.add(symbol)
    return symbol


def _skin_signals() -> list[_Signal]:
    first, second = f"m{HEADER_A}", f"m{HEADER_B}"
    signals = [_Signal("Header", 0, 8, "M")]
    for taxel in range(TAXELS):
        place = taxel if taxel < VALUES_A else taxel - VALUES_A
        which = first if taxel < VALUES_A else second
        signals.append(_Signal(f"Taxel{taxel}", 8 * (1 + place), 8, which))
    # The mask's highest bit is that of byte 6; its lowest four lie in byte 7's upper half.
    signals.append(_Signal("OutOfRange", 6 * 8 + 7, 12, second, big_endian=True))
    signals.append(_Signal("NoAck", 7 * 8, 1, second))
    signals.append(_Signal("NotConnected", 7 * 8 + 1, 1, second))
    return signals


def _add_streams(sensor: _Sensor, lines: list[str], remarks: list[str]) -> None:
    """Add force and torque of a board, and the same before its own calibration."""
    for kind in StrainType:
        can_id = identifier(MessageClass.ANALOG_STREAM, sensor.address, kind)
        quantity, unit = ("torque", "Nm") if kind & 1 else ("force", "N")
        scales = None
        if sensor.full_scale is not None and kind >= StrainType.FORCE:
            scales = sensor.full_scale[3:] if kind & 1 else sensor.full_scale[:3]
        signals = [
            _Signal(
                f"{quantity}_{axis}", start, 16, "", full / ZERO_WORD, -full, unit if scales else ""
            )
            for axis, start, full in zip("xyz", (0, 16, 32), scales or _WORDS, strict=True)
        ]
        # Only a saturated board sends this: its frames are one byte longer.
        signals.append(_Signal("saturated", 48, 8))
        lines += _message(
            can_id, f"{sensor.name}_{kind.name.lower()}", 7, sensor.name, "host", signals
        )
        if kind < StrainType.FORCE:
            remarks.append(f'CM_ BO_ {can_id} "before the calibration of the board, no unit";')
        elif scales is None:
            remarks.append(
                f'CM_ BO_ {can_id} "in 1/{ZERO_WORD} of the full scale of each channel";'
            )


def _add_commands(
    board: _Board | _Sensor,
    commands: Sequence[type[Message]],
    answers: Sequence[type[Message]],
    lines: list[str],
    values: list[str],
) -> None:
    """The commands to a board and its answers."""
    for kinds, suffix, to_board in ((commands, "", True), (answers, "_answer", False)):
        for message_class, group in groupby(kinds, key=lambda kind: kind.CLASS):
            # Two answers share a code; the application's own holds the fields of the other.
            messages = [kind for kind in group if kind is not DiscoveredBootloader]
            sender, low = HOST_ADDRESS, board.address
            if not to_board:
                sender, low = low, sender
            can_id = identifier(message_class, sender, low)
            word = "command" if message_class == MessageClass.ANALOG_COMMAND else "management"
            length = 1 + max(kind.LAYOUT.size for kind in messages)
            ends = ("host", board.name) if to_board else (board.name, "host")
            if board.address == BROADCAST_ADDRESS:
                ends = ("host", "Vector__XXX")
            signals = [_Signal("Code", 0, 8, "M"), *_fields(messages)]
            lines += _message(can_id, f"{board.name}_{word}{suffix}", length, *ends, signals)
            names = " ".join(f'{kind.CODE} "{kind.__name__}"' for kind in messages)
            values.append(f"VAL_ {can_id} Code {names} ;")
            if isinstance(board, _Sensor) and to_board:
                names = " ".join(f'{mode.value} "{mode.name.lower()}"' for mode in StrainMode)
                values.append(f"VAL_ {can_id} C{SetTxMode.CODE:02X}_mode {names} ;")


def _fields(messages: Iterable[type[Message]]) -> Iterator[_Signal]:
    for kind in messages:
        start = 8
        formats = _formats(kind.LAYOUT.format)
        # Attributes of the class itself, such as CODE, are not fields.
        for name, size in zip((entry.name for entry in fields(kind)), formats, strict=True):
            unit = {"ms": "ms", "s": "s"}.get(name.rpartition("_")[2], "")
            factor = 1.0
            if kind is TactileSetup and name == "timer":
                unit, factor = "us", _TIMER_US
            signal = f"C{kind.CODE:02X}_{name}"
            big = kind.LAYOUT.format.startswith(">") and size > 1
            # A big-endian field is placed by its highest bit, which is in its first byte.
            place = start + 7 if big else start
            yield _Signal(
                signal, place, 8 * size, f"m{kind.CODE}", factor, unit=unit, big_endian=big
            )
            start += 8 * size


def _formats(layout: str) -> Iterator[int]:
    """Sizes (bytes) of the fields of a `struct` format: "<3BHH" is 1, 1, 1, 2, 2."""
    count = ""
    for letter in layout.lstrip("<>"):
        if letter.isdigit():
            count += letter
        elif letter == "s":
            yield int(count or "1")
            count = ""
        else:
            yield from [_BYTES[letter]] * int(count or "1")
            count = ""


def _message(
    can_id: int, name: str, length: int, sender: str, receiver: str, signals: Iterable[_Signal]
) -> list[str]:
    lines = [f"BO_ {can_id} {name}: {length} {sender}"]
    for signal in signals:
        order = "@0+" if signal.big_endian else "@1+"
        top = (2**signal.bits - 1) * signal.factor + signal.offset
        multiplexed = f" {signal.multiplexed}" if signal.multiplexed else ""
        lines.append(
            f" SG_ {signal.name}{multiplexed} : {signal.start}|{signal.bits}{order} "
            f"({signal.factor:.15g},{signal.offset:.15g}) [{signal.offset:.15g}|{top:.15g}] "
            f'"{signal.unit}" {receiver}'
        )
    return [*lines, ""]
