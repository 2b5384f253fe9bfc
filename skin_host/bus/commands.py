"""Commands to the boards: class 2 (analog) and class 7 (management); see `answers` for the answers.

Every message is a small record that knows its code and the layout of its payload, so one encoder,
one parser and one writer of DBC files serve all. Multi-byte numbers are little endian. Boards do
not answer the skin configuration commands. Sources: the boards' protocol document TSD-ICUBUNIT
(section 3), mtb3/can_interface.c and embot_prot_can_analog_polling.cpp.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import astuple, dataclass
from enum import IntEnum, IntFlag
from typing import ClassVar, Self, TypeVar, dataclass_transform

import numpy as np

from skin_host.bus.wire import (
    HOST_ADDRESS,
    MAX_STANDARD_ID,
    FrameBatch,
    MessageClass,
    RecordBatch,
    identifier,
)


class BoardType(IntEnum):
    """Type that a board reports. Source: iCubCanProto_types.h."""

    SKIN = 5
    MTB4 = 11
    STRAIN2 = 12
    RFE = 13
    PSC = 15
    MTB4W = 16
    MTB4C = 20
    STRAIN2C = 22
    AMCMJ1 = 25
    UNKNOWN = 255


SKIN_BOARD_TYPES = frozenset({BoardType.SKIN, BoardType.MTB4, BoardType.MTB4W, BoardType.MTB4C})


M = TypeVar("M", bound="Message")


@dataclass(frozen=True, slots=True)
class Message:
    """One command or answer: a code byte, then the fields as `LAYOUT` packs them."""

    CLASS: ClassVar[MessageClass]
    CODE: ClassVar[int]
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("")

    def encode(self) -> bytes:
        """Return the payload, the code byte first.

        Raises:
            ValueError: a field does not fit its bytes.
        """
        try:
            return bytes([self.CODE]) + self.LAYOUT.pack(*astuple(self))
        except struct.error as error:
            raise ValueError(f"{self}: {error}") from None

    @classmethod
    def decode(cls, payload: bytes) -> Self | None:
        """Return the record in `payload`, or None if it is too short or has another code.

        Bytes past the fields are ignored, as the boards ignore them.
        """
        if payload[:1] != bytes([cls.CODE]) or len(payload) < 1 + cls.LAYOUT.size:
            return None
        return cls(*cls.LAYOUT.unpack_from(payload, 1))


#: Every command to a board, in the order in which they are described below.
COMMANDS: list[type[Message]] = []


@dataclass_transform(frozen_default=True)
def message(
    code: int, layout: str = "", table: list[type[Message]] | None = None
) -> Callable[[type[M]], type[M]]:
    """Make a class a message: a frozen record of its fields.

    Args:
        code: the first byte of the payload.
        layout: how the fields are packed behind it, as `struct` writes it.
        table: lists the message.
    """

    def made(kind: type[M]) -> type[M]:
        record = dataclass(frozen=True, slots=True)(kind)
        record.CODE, record.LAYOUT = code, struct.Struct(layout)
        if table is not None:
            table.append(record)
        return record

    return made


class Analog(Message):
    """A message of class 2."""

    __slots__ = ()
    CLASS = MessageClass.ANALOG_COMMAND


class Management(Message):
    """A message of class 7."""

    __slots__ = ()
    CLASS = MessageClass.MANAGEMENT


class TxMode(IntEnum):
    """Argument of command 07; note that 0 means start."""

    START = 0
    STOP = 1


@message(0x07, "B", COMMANDS)
class SetTxMode(Analog):
    """07: start or stop the stream."""

    mode: int


@message(0x08, "B", COMMANDS)
class SetTransmissionPeriod(Analog):
    """08: period of an analog stream in ms (force/torque boards; skin takes it from 4D)."""

    period_ms: int


@message(0x1C, "2B", COMMANDS)
class GetFirmwareVersion(Analog):
    """1C: query the firmware version, with the CAN protocol version of the host."""

    protocol_major: int
    protocol_minor: int


@message(0x32, "B", COMMANDS)
class SetBoardAddress(Analog):
    """32: a new address 1..14, stored at once, not answered."""

    address: int


@message(0x33, "", COMMANDS)
class ImuGet(Analog):
    """33: query the inertial set-up (MTB4 family)."""


@message(0x34, "<HBI", COMMANDS)
class ImuSet(Analog):
    """34: which inertial sensors stream, a mask of 16 bits, then range and further settings."""

    sensors: int
    fusion: int
    ranges: int


@message(0x35, "B", COMMANDS)
class ImuTransmit(Analog):
    """35: inertial period in ms, 0 stops."""

    period_ms: int


@message(0x38, "", COMMANDS)
class ThermometerGet(Analog):
    """38: query the set-up of the temperature sensors."""


@message(0x39, "B", COMMANDS)
class ThermometerSet(Analog):
    """39: which temperature sensors stream."""

    sensors: int


@message(0x3A, "B", COMMANDS)
class ThermometerTransmit(Analog):
    """3A: period of the temperature sensors in seconds, 0 stops."""

    period_s: int


@message(0x4C, "<3BHH", COMMANDS)
class TactileSetup(Analog):
    """4C, obsolete: set up, calibrate and start in class 3 (MTB3); MTB4 ignores the fields.

    Low nibble of `mode`: 0 16-bit, 1 8-bit, 2 10-bit, 3 calibrate; high nibble: 0 twelve
    values, 1 three, 2 one, 4 fingertip. `decimation` 1 is 256, 2 is 128, 3 is 64. `timer`
    counts 3.2 us and is used where `timer_flag` is 3.
    """

    mode: int = 1
    decimation: int = 1
    timer_flag: int = 1
    cdc_offset: int = 0x2000
    timer: int = 0


@message(0x4D, "3B", COMMANDS)
class SetBoardConfig(Analog):
    """4D: skin type, period, untouched value. Side effect: all triangles are disabled."""

    skin_type: int
    period_ms: int
    no_load: int


@message(0x4E, "<4BHB", COMMANDS)
class TactileSetup2(Analog):
    """4E, obsolete (MTB3): shifts, no-load, flags, enabled triangles; calibrates and starts."""

    shift: int = 0x02
    shifts: int = 0x22
    no_load: int = 0xF0
    flags: int = 0
    enabled: int = 0xFFFF
    trailer: int = 0x0A


@message(0x4F, "2B", COMMANDS)
class AccGyroSetup(Analog):
    """4F: inertial sensors of the board; period in ms, 0 stops."""

    sensors: int
    period_ms: int


class TriangleFlags(IntFlag):
    """Flags of command 50."""

    ENABLE = 1


@message(0x50, "<4BH", COMMANDS)
class SetTriangleConfig(Analog):
    """50: set up triangles first..last. Triggers a new baseline of the whole board."""

    first: int
    last: int
    shift: int = 2
    flags: int = TriangleFlags.ENABLE
    cdc_offset: int = 0x2200


@message(0x00, "", COMMANDS)
class EnterBootloader(Management):
    """00: reset into the bootloader."""


@message(0x04, "", COMMANDS)
class Ping(Management):
    """04: check that a board is present (MTB3 application); ends the bootloader."""


@message(0x0C, "", COMMANDS)
class GetAdditionalInfo(Management):
    """0C: query the board's text of 32 characters."""


@message(0x0D, "B4s", COMMANDS)
class SetAdditionalInfo(Management):
    """0D: four characters of the board's text, `index` 0..7."""

    index: int
    text: bytes


@message(0x0E, "", COMMANDS)
class GetTimeOfLife(Management):
    """0E: query how long the board has been up."""


@message(0x32, "<BH", COMMANDS)
class SetCanAddress(Management):
    """32: a new address (FF picks one at random outside `forbidden`, a mask of addresses)."""

    address: int
    forbidden: int = 0


@message(0xFF, "", COMMANDS)
class Discover(Management):
    """FF: query all boards. An MTB3 stops sending after any frame of this class."""


def command_frame(command: Message, address: int) -> tuple[int, bytes]:
    """Identifier and payload of a command from the host to `address` (15 is everyone)."""
    return identifier(command.CLASS, HOST_ADDRESS, address), command.encode()


def parse_command(can_id: int, payload: bytes) -> tuple[int, Message] | None:
    """Return receiver (1..15) and command of a frame from the host, or None for any other frame."""
    if can_id > MAX_STANDARD_ID or can_id >> 4 & 0xF != HOST_ADDRESS:
        return None
    address = can_id & 0xF
    if address == HOST_ADDRESS:
        return None
    for kind in COMMANDS:
        if can_id >> 8 == kind.CLASS:
            command = kind.decode(payload)
            if command is not None:
                return address, command
    return None


#: Commands after which a board has another zero.
ZEROING: tuple[type[Message], ...] = (
    SetBoardConfig,
    SetTriangleConfig,
    TactileSetup,
    TactileSetup2,
)
_ANALOG_COMMANDS = int(MessageClass.ANALOG_COMMAND) << 8 | HOST_ADDRESS << 4
_ADDRESSES = 0xF


def cut_where_zeroed(
    batch: FrameBatch, zeroed: Callable[[int, Message, int], object]
) -> Iterator[FrameBatch]:
    """Yield a batch in pieces, cut where a host gives a board another zero.

    Args:
        batch: of one bus.
        zeroed: called between the pieces, with the receiver (15 is everyone), the command, and its
            time. Commands that follow each other without another frame share a place.
    """
    rows = np.flatnonzero(batch.id & ~np.uint32(_ADDRESSES) == _ANALOG_COMMANDS).tolist()
    begin = 0
    before = -1
    whole: RecordBatch | None = None
    for row in rows:
        payload = batch.data[row, : batch.dlc[row]].tobytes()
        parsed = parse_command(int(batch.id[row]), payload)
        if parsed is None or not isinstance(parsed[1], ZEROING):
            continue
        if whole is None:
            whole = RecordBatch(batch.id, batch.dlc, batch.data, batch.t_ns)
        if row > before + 1:
            yield whole[begin:row]
            begin = row
        before = row
        zeroed(*parsed, int(batch.t_ns[row]))
    yield batch if whole is None else whole[begin:]
