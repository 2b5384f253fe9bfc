"""The frames of the boards as a DBC file, for cantools, SavvyCAN, Wireshark and their like.

The two frames of a triangle share an identifier and are told apart by their first byte, and
so are the commands and the answers of a board: in a DBC file that byte is a multiplexer.
"""

from collections.abc import Iterable, Iterator
from dataclasses import fields
from itertools import groupby
from typing import NamedTuple

from skin_host.bus.protocol import (
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
from skin_host.bus.protocol.answers import ANSWERS, TX_OVERFLOW_TYPE, DiscoveredBootloader
from skin_host.bus.protocol.commands import COMMANDS, Message, TactileSetup
from skin_host.errors import RequestError
from skin_host.layout import Layout

ADDRESSES = range(1, 15)
_BYTES = {"B": 1, "H": 2, "I": 4}
#: The commands' timer counts this (reference of the wire, command 4C).
_TIMER_US = 3.2


class _Board(NamedTuple):
    """A board to describe: its name, address, and each triangle with what it is."""

    name: str
    address: int
    triangles: list[tuple[int, str]]


class _Signal(NamedTuple):
    name: str
    start: int
    bits: int
    multiplexed: str = ""
    factor: float = 1.0
    unit: str = ""
    big_endian: bool = False


def dbc_text(layout: Layout | None = None, bus: str | None = None) -> str:
    """Write a DBC file.

    Args:
        layout: describe the boards and triangles of this skin; None is all that can be.
        bus: of the layout's buses; None if there is but one.

    Raises:
        RequestError: the layout has several buses and none is named, or not this one.
    """
    boards = _every_board() if layout is None else _boards_of(layout, bus)
    lines = [
        'VERSION ""',
        "",
        "NS_ :",
        "",
        "BS_:",
        "",
        "BU_: host " + " ".join(board.name for board in boards),
        "",
    ]
    remarks: list[str] = []
    values: list[str] = []
    for board in boards:
        for triangle, about in board.triangles:
            can_id = skin_id(board.address, triangle)
            name = f"{board.name}_T{triangle:02}"
            lines += _message(can_id, name, 8, board.name, "host", _skin_signals())
            remarks.append(f'CM_ BO_ {can_id} "{about}";')
            values.append(f'VAL_ {can_id} Header {HEADER_A} "first seven" {HEADER_B} "last five" ;')
        _add_commands(board, lines, values)
    _add_commands(_Board("all", BROADCAST_ADDRESS, []), lines, values)
    return "\n".join([*lines, *remarks, "", *values, ""])


def _every_board() -> list[_Board]:
    return [
        _Board(f"MTB{address}", address, [(i, f"triangle {i}") for i in range(TRIANGLES)])
        for address in ADDRESSES
    ]


def _boards_of(layout: Layout, bus: str | None) -> list[_Board]:
    buses = list(dict.fromkeys(board.settings.bus for board in layout.boards))
    if bus is None and len(buses) > 1:
        raise RequestError(f"the configuration has several buses; say which: {', '.join(buses)}")
    bus = bus or buses[0]
    if bus not in buses:
        raise RequestError(f'no bus "{bus}"; there are: {", ".join(buses)}')
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
        name = board.name.replace("-", "_")
        # Names are identifiers, and two are taken.
        name = name if name[0].isalpha() and name not in ("host", "all") else f"board_{name}"
        found.append(_Board(name, board.settings.address, sorted(triangles)))
    return found


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


def _add_commands(board: _Board, lines: list[str], values: list[str]) -> None:
    """The commands to a board and its answers; everybody (address 15) gives no answer."""
    for kinds, suffix, to_board in ((COMMANDS, "", True), (ANSWERS, "_answer", False)):
        if board.address == BROADCAST_ADDRESS and not to_board:
            continue
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
    if board.address != BROADCAST_ADDRESS:
        can_id = identifier(MessageClass.MANAGEMENT, board.address, TX_OVERFLOW_TYPE)
        lines += _message(can_id, f"{board.name}_tx_overflow", 0, board.name, "host", [])


def _fields(messages: Iterable[type[Message]]) -> Iterator[_Signal]:
    for kind in messages:
        start = 8
        formats = _formats(kind.LAYOUT.format)
        # Attributes of the class itself, such as CODE, are no fields.
        for name, size in zip((entry.name for entry in fields(kind)), formats, strict=True):
            unit = {"ms": "ms", "s": "s"}.get(name.rpartition("_")[2], "")
            factor = 1.0
            if kind is TactileSetup and name == "timer":
                unit, factor = "us", _TIMER_US
            signal = f"C{kind.CODE:02X}_{name}"
            yield _Signal(signal, start, 8 * size, f"m{kind.CODE}", factor, unit)
            start += 8 * size


def _formats(layout: str) -> Iterator[int]:
    """Sizes (bytes) of the fields of a `struct` format: "<3BHH" is 1, 1, 1, 2, 2."""
    count = ""
    for letter in layout.lstrip("<"):
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
        top = (2**signal.bits - 1) * signal.factor
        multiplexed = f" {signal.multiplexed}" if signal.multiplexed else ""
        lines.append(
            f" SG_ {signal.name}{multiplexed} : {signal.start}|{signal.bits}{order} "
            f'({signal.factor:g},0) [0|{top:.17g}] "{signal.unit}" {receiver}'
        )
    return [*lines, ""]
