"""Access of the firmware to its chips: set-up words, burst reads, four or five data lines.

A board has one I2C clock and four data lines (five on newer boards) with four chips each,
at 0x2C to 0x2F. Slot s of the arrays below is on line s // 4 at address 0x2C + s % 4.
Sources: AD7147-Configuration.c of the MTB3, AD7147.c and I2C_Multi_SDA.c of the MTB4. The
firmwares bang the lines in parallel and check neither acknowledges nor the clock, as
`BangedChips` does; the others do the same at less cost as long as all wires are sound.
"""

from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from smbus2 import SMBus, i2c_msg

from emulator.boards.arithmetic import ABSENT, TAXELS
from emulator.chips.i2c_wire import BitMaster, I2cWire

ADDRESSES = (0x2C, 0x2D, 0x2E, 0x2F)
CHIPS_PER_LINE = len(ADDRESSES)
SLOTS = 20
RESULTS = 0x00B

Words = NDArray[np.uint16]


class StageMap(IntEnum):
    """Which pads a conversion takes together (high nibble of command 4C)."""

    SINGLE = 0
    THREE = 1
    ALL = 2
    FINGERTIP = 4


#: Connection words of the stages: a pad on the positive input, all others on BIAS.
_CONNECTIONS: dict[StageMap, list[tuple[int, int]]] = {
    StageMap.SINGLE: [
        (0xFFFF & ~(1 << 2 * cin), 0x1FFF) if cin < 7 else (0xFFFF, 0x1FFF & ~(1 << 2 * (cin - 7)))
        for cin in range(TAXELS)
    ],
    StageMap.THREE: [(0xFFAA, 0x1FFF), (0x2AFF, 0x1FFE), (0xFFFF, 0x1EAB)],
    StageMap.ALL: [(0xEAAA, 0x1EAA)],
    StageMap.FINGERTIP: [(0xFF2A, 0x1FFF), (0x2ABF, 0x1FFE)],
}
_SENSITIVITY_AND_OFFSETS = (0x2626, 50, 50, 100, 100)
_BANK_2 = 0x080
_STAGE_WORDS = 8
_STAGE_CAL_EN = 0x001


class Chips(Protocol):
    """The chips of one board as its firmware sees them."""

    def configure(
        self, slots: Iterable[int], stages: StageMap, cdc_offset: int, power_control: int
    ) -> None:
        """Write the whole set-up of the chips at `slots`; absent ones ignore it."""
        ...

    def read(self, without: int = 0) -> Words:
        """The twelve results of every slot, uint16[20, 12]; 0xFFFF where nothing answers.

        Args:
            without: data lines that are left out, as bits; what is answered for them is undefined.
        """
        ...


def set_up_bursts(
    stages: StageMap, cdc_offset: int, power_control: int
) -> list[tuple[int, tuple[int, ...]]]:
    """The bursts (first register, words) that set a chip up, in the order they are written."""
    connections = _CONNECTIONS[stages]
    bursts = [
        (
            _BANK_2 + _STAGE_WORDS * stage,
            (first, second, cdc_offset, *_SENSITIVITY_AND_OFFSETS),
        )
        for stage, (first, second) in enumerate(connections)
    ]
    control: tuple[int, ...]
    if stages is StageMap.SINGLE:
        # The buffer is used again without clearing: the last stage's second word lands in
        # STAGE_CAL_EN and three words fall on read-only registers.
        control = (power_control, connections[-1][1], 0, 0, 0, 0, 0, 0x0400, 0, 0, 0x0FFF)
    else:
        control = (power_control, 0, 0x3230, 0x14C8, 0x0832, 0, 0, 0x0800)
    return [*bursts, (0x000, control), (_STAGE_CAL_EN, (0x0FFF,))]


def _set_up_messages(stages: StageMap, cdc_offset: int, power_control: int) -> list[bytes]:
    return [
        first.to_bytes(2) + b"".join(word.to_bytes(2) for word in words)
        for first, words in set_up_bursts(stages, cdc_offset, power_control)
    ]


def _places(slots: Iterable[int], n_lines: int) -> list[tuple[int, int]]:
    """Line and address of each slot; a board of four lines has none at the last four."""
    places = [divmod(slot, CHIPS_PER_LINE) for slot in slots]
    return [(line, ADDRESSES[index]) for line, index in places if line < n_lines]


class I2cChips:
    """Chips behind smbus2 buses, one per data line: emulated ones, or /dev/i2c-N.

    The lines follow each other, and a chip that does not answer (OSError) reads as all ones.
    """

    def __init__(self, lines: Sequence[SMBus]) -> None:
        self._lines = lines
        self._registers = np.empty((SLOTS, TAXELS), ">u2")
        self._pointer = [i2c_msg.write(address, RESULTS.to_bytes(2)) for address in ADDRESSES]
        self._results = [i2c_msg.read(address, 2 * TAXELS) for address in ADDRESSES]

    def __reduce__(self) -> tuple[type["I2cChips"], tuple[Sequence[SMBus]]]:
        """Messages hold addresses of memory; a saved board makes its own again."""
        return I2cChips, (self._lines,)

    def configure(
        self, slots: Iterable[int], stages: StageMap, cdc_offset: int, power_control: int
    ) -> None:
        """Write the set-up burst by burst."""
        messages = _set_up_messages(stages, cdc_offset, power_control)
        for line, address in _places(slots, len(self._lines)):
            for message in messages:
                try:
                    self._lines[line].i2c_rdwr(i2c_msg.write(address, message))
                except OSError:
                    break

    def read(self, without: int = 0) -> Words:
        """One combined read of twelve words from every chip of every line."""
        self._registers[:] = ABSENT
        for number, line in enumerate(self._lines):
            if without >> number & 1:
                continue
            for index in range(CHIPS_PER_LINE):
                results = self._results[index]
                try:
                    line.i2c_rdwr(self._pointer[index], results)
                except OSError:
                    continue
                self._registers[CHIPS_PER_LINE * number + index] = np.frombuffer(
                    bytes(results), ">u2"
                )
        return self._registers.astype(np.uint16)


class BangedChips:
    """Chips on a wire that is driven bit by bit, all lines together, as the boards do.

    Args:
        wire: with one data line for every four slots.
    """

    def __init__(self, wire: I2cWire) -> None:
        self._wire = wire

    def configure(
        self, slots: Iterable[int], stages: StageMap, cdc_offset: int, power_control: int
    ) -> None:
        """Write the set-up burst by burst, a line at a time."""
        messages = _set_up_messages(stages, cdc_offset, power_control)
        for line, address in _places(slots, len(self._wire.lines)):
            master = BitMaster(self._wire, 1 << line)
            for message in messages:
                _send(master, address, message)
                master.stop()

    def read(self, without: int = 0) -> Words:
        """One combined read of twelve words at each address, on all lines at once."""
        n_lines = len(self._wire.lines)
        lines = ((1 << n_lines) - 1) & ~without
        registers = np.full((SLOTS, TAXELS), ABSENT, np.uint16)
        master = BitMaster(self._wire, lines)
        for index, address in enumerate(ADDRESSES):
            _send(master, address, RESULTS.to_bytes(2))
            master.start()
            master.put(address << 1 | 1)
            taken = [master.get(acknowledge=at < 2 * TAXELS - 1) for at in range(2 * TAXELS)]
            master.stop()
            of_lines = np.array(taken, np.uint8).T.copy().view(">u2")
            registers[index : CHIPS_PER_LINE * n_lines : CHIPS_PER_LINE] = of_lines
        return registers


def _send(master: BitMaster, address: int, message: bytes) -> None:
    """A write message without its STOP; nobody checks who acknowledges it."""
    master.start()
    for byte in (address << 1, *message):
        master.put(byte)
