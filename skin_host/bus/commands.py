"""Commands to the boards: class 2 (analog) and class 7 (management); see `answers` for the answers.

Every message is a small record that knows its code and the layout of its payload, so one encoder
and one parser serve all. Multi-byte numbers are little endian. Boards do not answer the skin
configuration commands. Sources: the boards' protocol document TSD-ICUBUNIT (section 3),
mtb3/can_interface.c and embot_prot_can_analog_polling.cpp.
"""

import struct
from dataclasses import astuple, dataclass
from enum import IntEnum, IntFlag
from typing import ClassVar, Self

from skin_host.bus.wire import (
    HOST_ADDRESS,
    MAX_STANDARD_ID,
    MessageClass,
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


@dataclass(frozen=True, slots=True)
class SetTxMode(Analog):
    """07: start or stop the stream."""

    CODE = 0x07
    LAYOUT = struct.Struct("B")
    mode: int


@dataclass(frozen=True, slots=True)
class SetTransmissionPeriod(Analog):
    """08: period of an analog stream in ms (force/torque boards; skin takes it from 4D)."""

    CODE = 0x08
    LAYOUT = struct.Struct("B")
    period_ms: int


@dataclass(frozen=True, slots=True)
class GetFirmwareVersion(Analog):
    """1C: query the firmware version, with the CAN protocol version of the host."""

    CODE = 0x1C
    LAYOUT = struct.Struct("2B")
    protocol_major: int
    protocol_minor: int


@dataclass(frozen=True, slots=True)
class SetBoardAddress(Analog):
    """32: a new address 1..14, stored at once, not answered."""

    CODE = 0x32
    LAYOUT = struct.Struct("B")
    address: int


@dataclass(frozen=True, slots=True)
class ImuGet(Analog):
    """33: query the inertial set-up (MTB4 family)."""

    CODE = 0x33


@dataclass(frozen=True, slots=True)
class ImuSet(Analog):
    """34: which inertial sensors stream, a mask of 16 bits, then range and further settings."""

    CODE = 0x34
    LAYOUT = struct.Struct("<HBI")
    sensors: int
    fusion: int
    ranges: int


@dataclass(frozen=True, slots=True)
class ImuTransmit(Analog):
    """35: inertial period in ms, 0 stops."""

    CODE = 0x35
    LAYOUT = struct.Struct("B")
    period_ms: int


@dataclass(frozen=True, slots=True)
class ThermometerGet(Analog):
    """38: query the set-up of the temperature sensors."""

    CODE = 0x38


@dataclass(frozen=True, slots=True)
class ThermometerSet(Analog):
    """39: which temperature sensors stream."""

    CODE = 0x39
    LAYOUT = struct.Struct("B")
    sensors: int


@dataclass(frozen=True, slots=True)
class ThermometerTransmit(Analog):
    """3A: period of the temperature sensors in seconds, 0 stops."""

    CODE = 0x3A
    LAYOUT = struct.Struct("B")
    period_s: int


@dataclass(frozen=True, slots=True)
class TactileSetup(Analog):
    """4C, obsolete: set up, calibrate and start in class 3 (MTB3); MTB4 ignores the fields.

    Low nibble of `mode`: 0 16-bit, 1 8-bit, 2 10-bit, 3 calibrate; high nibble: 0 twelve
    values, 1 three, 2 one, 4 fingertip. `decimation` 1 is 256, 2 is 128, 3 is 64. `timer`
    counts 3.2 us and is used where `timer_flag` is 3.
    """

    CODE = 0x4C
    LAYOUT = struct.Struct("<3BHH")
    mode: int = 1
    decimation: int = 1
    timer_flag: int = 1
    cdc_offset: int = 0x2000
    timer: int = 0


@dataclass(frozen=True, slots=True)
class SetBoardConfig(Analog):
    """4D: skin type, period, untouched value. Side effect: all triangles are disabled."""

    CODE = 0x4D
    LAYOUT = struct.Struct("3B")
    skin_type: int
    period_ms: int
    no_load: int


@dataclass(frozen=True, slots=True)
class TactileSetup2(Analog):
    """4E, obsolete (MTB3): shifts, no-load, flags, enabled triangles; calibrates and starts."""

    CODE = 0x4E
    LAYOUT = struct.Struct("<4BHB")
    shift: int = 0x02
    shifts: int = 0x22
    no_load: int = 0xF0
    flags: int = 0
    enabled: int = 0xFFFF
    trailer: int = 0x0A


@dataclass(frozen=True, slots=True)
class AccGyroSetup(Analog):
    """4F: inertial sensors of the board; period in ms, 0 stops."""

    CODE = 0x4F
    LAYOUT = struct.Struct("2B")
    sensors: int
    period_ms: int


class TriangleFlags(IntFlag):
    """Flags of command 50."""

    ENABLE = 1


@dataclass(frozen=True, slots=True)
class SetTriangleConfig(Analog):
    """50: set up triangles first..last. Triggers a new baseline of the whole board."""

    CODE = 0x50
    LAYOUT = struct.Struct("<4BH")
    first: int
    last: int
    shift: int = 2
    flags: int = TriangleFlags.ENABLE
    cdc_offset: int = 0x2200


@dataclass(frozen=True, slots=True)
class EnterBootloader(Management):
    """00: reset into the bootloader."""

    CODE = 0x00


@dataclass(frozen=True, slots=True)
class Ping(Management):
    """04: check that a board is present (MTB3 application); ends the bootloader."""

    CODE = 0x04


@dataclass(frozen=True, slots=True)
class GetAdditionalInfo(Management):
    """0C: query the board's text of 32 characters."""

    CODE = 0x0C


@dataclass(frozen=True, slots=True)
class SetAdditionalInfo(Management):
    """0D: four characters of the board's text, `index` 0..7."""

    CODE = 0x0D
    LAYOUT = struct.Struct("B4s")
    index: int
    text: bytes


@dataclass(frozen=True, slots=True)
class GetTimeOfLife(Management):
    """0E: query how long the board has been up."""

    CODE = 0x0E


@dataclass(frozen=True, slots=True)
class SetCanAddress(Management):
    """32: a new address (FF picks one at random outside `forbidden`, a mask of addresses)."""

    CODE = 0x32
    LAYOUT = struct.Struct("<BH")
    address: int
    forbidden: int = 0


@dataclass(frozen=True, slots=True)
class Discover(Management):
    """FF: query all boards. An MTB3 stops sending after any frame of this class."""

    CODE = 0xFF


COMMANDS: tuple[type[Message], ...] = (
    SetTxMode,
    SetTransmissionPeriod,
    GetFirmwareVersion,
    SetBoardAddress,
    ImuGet,
    ImuSet,
    ImuTransmit,
    ThermometerGet,
    ThermometerSet,
    ThermometerTransmit,
    TactileSetup,
    SetBoardConfig,
    TactileSetup2,
    AccGyroSetup,
    SetTriangleConfig,
    EnterBootloader,
    Ping,
    GetAdditionalInfo,
    SetAdditionalInfo,
    GetTimeOfLife,
    SetCanAddress,
    Discover,
)


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
