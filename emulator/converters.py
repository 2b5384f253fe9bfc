"""The chips of a robot, each board's at the fidelity that was asked for.

Fidelity "chip" has every register and transaction: an `AD7147` behind an `EmulatedSMBus` that
the firmware drives over smbus2. Fidelity "signal" goes straight from capacitance to counts.
Chips are numbered as the layout numbers its triangles.
"""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from emulator.ad7147 import AD7147
from emulator.firmware.arithmetic import ABSENT, TAXELS
from emulator.firmware.chips import (
    ADDRESSES,
    CHIPS_PER_LINE,
    SLOTS,
    Chips,
    I2cChips,
    Words,
)
from emulator.firmware.mtb4 import ERGO_HAND_SLOTS
from emulator.i2c import Chip, EmulatedSMBus, build_lines
from emulator.signal import SignalChips, SignalSkin
from skin_host.errors import ConfigurationError
from skin_host.layout import BoardLayout, Layout

FIDELITIES = ("signal", "chip")
Q_FF = 0.36

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


def fidelities(layout: Layout, fidelity: str | Mapping[str, str]) -> dict[int, str]:
    """The fidelity of each board by its index, from one for all or one by the board's name.

    Raises:
        ConfigurationError: no such fidelity or board.
    """
    if not isinstance(fidelity, str):
        unknown = set(fidelity) - {board.name for board in layout.boards}
        if unknown:
            raise ConfigurationError(f'fidelity: no board "{min(unknown)}"')
    of_board: dict[int, str] = {}
    for number, board in enumerate(layout.boards):
        chosen = fidelity if isinstance(fidelity, str) else fidelity.get(board.name, "signal")
        if chosen not in FIDELITIES:
            known = ", ".join(FIDELITIES)
            raise ConfigurationError(
                f'board "{board.name}": no fidelity "{chosen}"; there are: {known}'
            )
        of_board[number] = chosen
    return of_board


def slot_of(board: BoardLayout, triangle: int) -> int:
    """Where the chip of a triangle sits on its board: ergoCub hands have a map of their own."""
    return ERGO_HAND_SLOTS[triangle] if board.settings.skin_type == 3 else triangle


class Converters:
    """All chips of a robot, at one common time.

    Args:
        layout: which chips there are.
        noise_ff: float64[n_taxels], noise of each pad.
        seed: the same seed draws the same noise at either fidelity.
        quiet: no noise at all.
        fidelity: of each board, by its index.

    Attributes:
        signal: the chips at fidelity "signal" (all of the layout have a row).
        registers: the chips at fidelity "chip", by number.
        lines: the I2C lines of each board at fidelity "chip", by the board's index.
        chip_of_slot: for each board intp[20], the chip at each of its slots, -1 for none.
    """

    def __init__(
        self,
        layout: Layout,
        noise_ff: Floats,
        seed: int,
        *,
        quiet: bool,
        fidelity: Mapping[int, str],
    ) -> None:
        self._layout = layout
        self._t_ns = 0
        noise_ff = noise_ff.reshape(-1, TAXELS)
        rngs = [np.random.default_rng([seed, 2, chip]) for chip in range(len(layout.triangles))]
        self.signal = SignalSkin(rngs, noise_ff.copy(), Q_FF, quiet=quiet)
        self.registers: dict[int, AD7147] = {}
        self._synced_ns: dict[int, int] = {}
        self._on_line: dict[int, Chip] = {}
        self.lines: dict[int, list[EmulatedSMBus]] = {}
        self._boards: list[Chips] = []
        self.chip_of_slot: list[Ints] = []
        for number, board in enumerate(layout.boards):
            chip_of_slot = np.full(SLOTS, -1, np.intp)
            for chip, triangle in enumerate(layout.triangles):
                if triangle.board == number:
                    chip_of_slot[slot_of(board, triangle.number)] = chip
            self.chip_of_slot.append(chip_of_slot)
            if fidelity[number] == "signal":
                self._boards.append(SignalChips(self.signal, chip_of_slot))
                continue
            for chip in chip_of_slot[chip_of_slot >= 0]:
                registers = AD7147(None if quiet else rngs[chip], q_ff=Q_FF)
                registers.set_input_noise_ff(noise_ff[chip])
                self.registers[int(chip)] = registers
                self._synced_ns[int(chip)] = 0
                self._on_line[int(chip)] = _InTime(registers, partial(self._sync, int(chip)))
            n_slots = SLOTS if (chip_of_slot[16:] >= 0).any() else 16
            self.lines[number] = build_lines([None] * n_slots)
            self._plug(number)
            self._boards.append(I2cChips(self.lines[number]))

    @property
    def t_ns(self) -> int:
        """The time at which chips are read and capacitances change."""
        return self._t_ns

    @t_ns.setter
    def t_ns(self, t_ns: int) -> None:
        self._t_ns = self.signal.t_ns = t_ns

    def of_board(self, number: int) -> Chips:
        """The chips of a board as its firmware sees them."""
        return self._boards[number]

    def force(self, chip: int, word: int | None) -> None:
        """Let a chip be gone: it takes nothing, and `word` is read instead; None mends it.

        0xFFFF is what pulled-up lines read, 0 what a line reads that is held low.
        """
        self.signal.forced[chip] = -1 if word is None else word
        self._plug(self._layout.triangles[chip].board)

    def rewire(self, number: int, chip_of_slot: Ints) -> None:
        """Put other chips at the slots of a board."""
        self.chip_of_slot[number][:] = chip_of_slot
        self._plug(number)

    def _plug(self, number: int) -> None:
        """Put the chips of a board on its I2C lines as they are wired now."""
        for line, bus in enumerate(self.lines.get(number, [])):
            chips: dict[int, Chip] = {}
            for index, address in enumerate(ADDRESSES):
                chip = int(self.chip_of_slot[number][CHIPS_PER_LINE * line + index])
                word = int(self.signal.forced[chip])
                if chip >= 0 and word < 0:
                    chips[address] = self._on_line[chip]
                elif chip >= 0 and word != ABSENT:
                    chips[address] = _Unpowered(word)
            bus.chips = chips

    def set_capacitance_ff(self, chips: Ints, values: Floats) -> None:
        """Change the pads of some chips from now on, float64[k, 12]."""
        in_signal = chips
        if self.registers:
            registers = np.array([int(chip) in self.registers for chip in chips], bool)
            in_signal, values_signal = chips[~registers], values[~registers]
            for chip, row in zip(chips[registers], values[registers], strict=True):
                self._sync(int(chip))
                self.registers[int(chip)].set_capacitances_ff(row)
            values = values_signal
        if len(in_signal):
            self.signal.set_capacitance_ff(in_signal, values)

    def set_noise_ff(self, chip: int, values: Floats) -> None:
        """Change the noise of a chip's pads, float64[12] (fF rms)."""
        if chip in self.registers:
            self._sync(chip)
            self.registers[chip].set_input_noise_ff(values)
        else:
            self.signal.set_input_noise_ff(np.array([chip]), values[None])

    def hold_results(self, chip: int, held: NDArray[np.bool_]) -> None:
        """Results bool[12] of a chip that show no noise at all, not even the converter's own."""
        if chip in self.registers:
            self._sync(chip)
            self.registers[chip].hold_results(held)
        else:
            self.signal.hold_results(chip, held)

    def _sync(self, chip: int) -> None:
        """Bring a chip to the present."""
        late_ns = self._t_ns - self._synced_ns[chip]
        if late_ns:
            self.registers[chip].advance(late_ns * 1e-9)
            self._synced_ns[chip] = self._t_ns


class _Unpowered:
    """What answers where a line is held low: every word is the same."""

    def __init__(self, word: int) -> None:
        self._word = word.to_bytes(2)

    def write(self, data: bytes) -> int:
        return len(data)

    def read(self, length: int) -> bytes:
        return (self._word * length)[:length]


class _InTime:
    """A chip on its line, brought to the present before every message."""

    def __init__(self, chip: AD7147, sync: Callable[[], None]) -> None:
        self._chip = chip
        self._sync = sync

    def write(self, data: bytes) -> int:
        self._sync()
        return self._chip.write(data)

    def read(self, length: int) -> bytes:
        self._sync()
        return self._chip.read(length)


def read_rows(signal: SignalSkin, chips: Ints, row: Ints) -> Words:
    """Read chips of a `SignalSkin`, and give some of the answers, uint16[k, 12].

    Args:
        signal: the chips.
        chips: which of them are read.
        row: intp[k], indices into `chips`; -1 answers 0xFFFF.
    """
    words = signal.read(chips)
    if len(row) == len(chips) and (row == np.arange(len(chips))).all():
        return words
    return np.vstack([words, np.full((1, TAXELS), ABSENT, np.uint16)])[row]
