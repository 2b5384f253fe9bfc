"""Answers of boards to commands of class 2 and class 7; sources as in `commands`."""

from dataclasses import dataclass

from skin_host.bus.commands import Analog, Management, Message, message
from skin_host.bus.wire import (
    BROADCAST_ADDRESS,
    HOST_ADDRESS,
    MAX_STANDARD_ID,
    MessageClass,
    identifier,
)

#: Every answer of a board; longest first where two share a code, so that it is tried first.
ANSWERS: list[type[Message]] = []
TX_OVERFLOW_TYPE = 5


@message(0x1C, "7B", ANSWERS)
class FirmwareVersion(Analog):
    """Answer to 1C."""

    board_type: int
    firmware_major: int
    firmware_minor: int
    firmware_build: int
    protocol_major: int
    protocol_minor: int
    compatible: int


@message(0x00, "B", ANSWERS)
class ResetAnswer(Management):
    """Answer of an MTB3 to 00, just before it resets."""

    ok: int = 1


@message(0x04, "B", ANSWERS)
class PingAnswer(Management):
    """Answer to 04."""

    ok: int = 1


@message(0x0C, "B4s", ANSWERS)
class AdditionalInfo(Management):
    """One of eight answers to 0C."""

    index: int
    text: bytes


@message(0x0E, "7s", ANSWERS)
class TimeOfLife(Management):
    """Answer to 0E: seven bytes of microseconds, little endian (byte order inferred)."""

    microseconds: bytes

    @property
    def seconds(self) -> float:
        """Time since the board started."""
        return int.from_bytes(self.microseconds, "little") * 1e-6


@message(0xFF, "4B", ANSWERS)
class Discovered(Management):
    """Answer of an application to FF."""

    board_type: int
    firmware_major: int
    firmware_minor: int
    firmware_build: int


@message(0xFF, "3B", ANSWERS)
class DiscoveredBootloader(Management):
    """Answer of a bootloader to FF: the board runs no application."""

    board_type: int
    bootloader_major: int
    bootloader_minor: int


@dataclass(frozen=True, slots=True)
class TxOverflow:
    """Notification from an MTB3 that its transmit buffer overflowed: class 7, low nibble 5, DLC
    0.
    """


def answer_frame(answer: Message, address: int) -> tuple[int, bytes]:
    """Identifier and payload of an answer from board `address` to the host."""
    return identifier(answer.CLASS, address, HOST_ADDRESS), answer.encode()


def parse_answer(can_id: int, payload: bytes) -> tuple[int, Message | TxOverflow] | None:
    """Return sender (1..14) and answer of a frame from a board, or None for any other frame."""
    sender = can_id >> 4 & 0xF
    if can_id > MAX_STANDARD_ID or sender in {HOST_ADDRESS, BROADCAST_ADDRESS}:
        return None
    if can_id >> 8 == MessageClass.MANAGEMENT and can_id & 0xF == TX_OVERFLOW_TYPE and not payload:
        return sender, TxOverflow()
    if can_id & 0xF != HOST_ADDRESS:
        return None
    for kind in ANSWERS:
        if can_id >> 8 == kind.CLASS:
            answer = kind.decode(payload)
            if answer is not None:
                return sender, answer
    return None
