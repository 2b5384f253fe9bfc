"""The chips of a robot, each board's at the chosen fidelity, and the wires to them.

Fidelity "chip" has every register and transaction: an `AD7147` behind an `EmulatedSMBus` that
the firmware drives over smbus2. Fidelity "signal" goes straight from capacitance to counts.

The behaviour of an AD7147 never depends on how often it is read, and both fidelities convert
alike. So the results that firmware reads over intact wires are taken from `SignalSkin` at either
fidelity, and the registers are updated to the present when any other reader accesses them. Once
another program has written to a chip of a board, that board's results come over its bus.

Over data lines with a fault, boards of either fidelity reach their chips bit by bit
(`emulator.chips.i2c_wire`). Chips are numbered as the layout numbers its triangles.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from emulator.boards.arithmetic import ABSENT, TAXELS
from emulator.boards.chip_access import (
    ADDRESSES,
    CHIPS_PER_LINE,
    SLOTS,
    BangedChips,
    Chips,
    I2cChips,
    StageMap,
    Words,
)
from emulator.boards.mtb4 import ERGO_HAND_SLOTS
from emulator.chips import ad7147_map as reg
from emulator.chips.ad7147 import AD7147
from emulator.chips.i2c import EmulatedSMBus, build_lines
from emulator.chips.i2c_wire import Chip, I2cWire
from emulator.chips.noise import ChipNoise, PadNoise
from emulator.chips.signal import SignalChips, SignalPort, SignalSkin
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
    """Return the slot of a triangle's chip on its board: ergoCub hands have a separate map."""
    return ERGO_HAND_SLOTS[triangle] if board.settings.effective_skin_type == 3 else triangle


class Converters:
    """All chips of a robot, at one common time.

    Args:
        layout: which chips there are.
        noise: of the pads of each triangle; None is no noise at all.
        noise_ff: float64[n_taxels], its rms.
        seed: the same seed draws the same noise at either fidelity.
        fidelity: of each board, by its index.

    Attributes:
        signal: the chips at fidelity "signal" (all of the layout have a row).
        registers: the chips at fidelity "chip", by number.
        lines: the I2C lines of each board at fidelity "chip", by the board's index.
        chip_of_slot: for each board intp[20], the chip at each of its slots, -1 for none.
        by_bus: let all boards at fidelity "chip" read over their buses, to compare with.
    """

    def __init__(
        self,
        layout: Layout,
        noise: PadNoise | None,
        noise_ff: Floats,
        seed: int,
        *,
        fidelity: Mapping[int, str],
    ) -> None:
        self._layout = layout
        self._t_ns = 0
        noise_ff = noise_ff.reshape(-1, TAXELS)
        rngs = [np.random.default_rng([seed, 2, chip]) for chip in range(len(layout.triangles))]
        draws = None
        if noise is not None:
            draws = ChipNoise(np.array([rng.integers(1 << 62) for rng in rngs], np.intp), noise)
        self.signal = SignalSkin(draws, noise_ff.copy(), Q_FF)
        self.registers: dict[int, AD7147] = {}
        self._synced_ns: dict[int, int] = {}
        self._on_line: dict[int, Chip] = {}
        self.lines: dict[int, list[EmulatedSMBus]] = {}
        self._wires: list[I2cWire] = []
        self._boards: list[Chips] = []
        self.by_bus = False
        #: Boards with a chip that was set up by something other than their firmware.
        self._strange: set[int] = set()
        self._configuring = False
        #: How often each board has read its chips without a bus.
        self._reads = [0] * len(layout.boards)
        #: Chips that answer at a slot which has its own chip, by that slot.
        self._second: dict[tuple[int, int], int] = {}
        self._brown_outs = np.random.default_rng([seed, 7])
        self.chip_of_slot: list[Ints] = []
        for number, board in enumerate(layout.boards):
            chip_of_slot = np.full(SLOTS, -1, np.intp)
            for chip, triangle in enumerate(layout.triangles):
                if triangle.board == number:
                    chip_of_slot[slot_of(board, triangle.number)] = chip
            self.chip_of_slot.append(chip_of_slot)
            n_lines = 5 if (chip_of_slot[16:] >= 0).any() else 4
            rng = np.random.default_rng([seed, 6, number])
            wire = I2cWire([{} for _ in range(n_lines)], rng)
            self._wires.append(wire)
            at_once = SignalChips(self.signal, chip_of_slot)
            if fidelity[number] == "signal":
                self._boards.append(_WiredChips(self, number, wire, at_once))
                continue
            for chip in chip_of_slot[chip_of_slot >= 0]:
                registers = (
                    AD7147(q_ff=Q_FF)
                    if draws is None
                    else AD7147(rngs[chip], q_ff=Q_FF, noise=draws.one(int(chip)))
                )
                registers.set_input_noise_ff(noise_ff[chip])
                self.registers[int(chip)] = registers
                self._synced_ns[int(chip)] = 0
                self._on_line[int(chip)] = _InTime(self, number, int(chip))
            self.lines[number] = build_lines(wire)
            by_bus = I2cChips(self.lines[number])
            self._boards.append(_WiredChips(self, number, wire, at_once, by_bus))
        for number in self.lines:
            self._plug(number)

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

    def i2c_wire(self, number: int) -> I2cWire:
        """The data lines of a board, to let something go wrong there."""
        if not self._wires[number].faulty:
            self._plug(number)
        return self._wires[number]

    def read_at_once(self, number: int) -> bool:
        """Return whether a board may take its chips' results from `signal` now; this counts as
        read.
        """
        if self._wires[number].faulty:
            return False
        if number in self.lines:
            if self.by_bus or number in self._strange:
                return False
            self._reads[number] += 1
        return True

    @contextmanager
    def configuring(self) -> Iterator[None]:
        """While the firmware of a board sets its chips up: `signal` is set up alike."""
        self._configuring = True
        yield
        self._configuring = False

    def written(self, number: int) -> None:
        """Registers of a chip of a board are written, over its bus."""
        if not self._configuring:
            self._strange.add(number)

    def reads(self, number: int) -> int:
        """How often a board has read its chips without a bus."""
        return self._reads[number]

    def brown_out(self, chip: int) -> None:
        """Let the supply of a chip fail for a moment: registers at reset, RAM random."""
        ram = self._brown_outs.integers(0, 1 << 16, reg.END_OF_MAP - reg.BANK_2).astype(np.uint16)
        if chip in self.registers:
            self.synced(chip).brown_out(ram)
        self.signal.brown_out(chip, ram)

    def slot(self, number: int, triangle: int) -> int:
        """Where the chip of a board's triangle sits, 0 to 19."""
        return slot_of(self._layout.boards[number], triangle)

    def answer_second(self, number: int, slot: int, chip: int | None) -> None:
        """Let another chip answer at a slot of a board as well; None ends that."""
        if chip is None:
            del self._second[number, slot]
        else:
            self._second[number, slot] = chip
        self._plug(number)

    def force(self, chip: int, word: int | None) -> None:
        """Remove a chip: it accepts nothing, and `word` is read instead; None ends that.

        0xFFFF is read from pulled-up lines, 0 from a line that is held low.
        """
        self.signal.force(chip, -1 if word is None else word)
        self._plug(self._layout.triangles[chip].board)

    def rewire(self, number: int, chip_of_slot: Ints) -> None:
        """Connect other chips to the slots of a board."""
        self.chip_of_slot[number][:] = chip_of_slot
        self._plug(number)

    def _plug(self, number: int) -> None:
        """Connect the chips of a board to its I2C lines as they are wired now."""
        for number_of_line, line in enumerate(self._wires[number].lines):
            chips: dict[int, Chip] = {}
            for index, address in enumerate(ADDRESSES):
                slot = CHIPS_PER_LINE * number_of_line + index
                chip = self._at_slot(int(self.chip_of_slot[number][slot]))
                if chip is not None:
                    chips[address] = chip
                line.share(address, self._at_slot(self._second.get((number, slot), -1)))
            line.chips = chips

    def _at_slot(self, chip: int) -> Chip | None:
        """Return the bus side of a chip as it is now; None if there is none, or it does not
        answer.
        """
        if chip < 0:
            return None
        word = int(self.signal.forced[chip])
        if word >= 0:
            return None if word == ABSENT else _Unpowered(word)
        if chip in self.registers:
            return self._on_line[chip]
        return SignalPort(self.signal, chip)

    def set_capacitance_ff(self, chips: Ints, values: Floats) -> None:
        """Change the pads of some chips from now on, float64[k, 12]."""
        self.signal.set_capacitance_ff(chips, values)
        if self.registers:
            for chip, row in zip(chips.tolist(), values, strict=True):
                if chip in self.registers:
                    self.synced(chip).set_capacitances_ff(row)

    def set_noise_ff(self, chip: int, values: Floats) -> None:
        """Change the noise of a chip's pads, float64[12] (fF rms)."""
        if chip in self.registers:
            self.synced(chip).set_input_noise_ff(values)
        self.signal.set_input_noise_ff(np.array([chip]), values[None])

    def hold_results(self, chip: int, held: NDArray[np.bool_]) -> None:
        """Results bool[12] of a chip that show no noise at all, not even the converter's own."""
        if chip in self.registers:
            self.synced(chip).hold_results(held)
        self.signal.hold_results(chip, held)

    def synced(self, chip: int) -> AD7147:
        """A chip at fidelity "chip", brought to the present."""
        registers = self.registers[chip]
        late_ns = self._t_ns - self._synced_ns[chip]
        if late_ns:
            registers.advance(late_ns * 1e-9)
            self._synced_ns[chip] = self._t_ns
        return registers


class _WiredChips:
    """The chips of a board over its wires: at once, by messages, or bit by bit if they are faulty.

    Args:
        converters, number: the board.
        wire: its data lines.
        at_once: its chips without a bus.
        by_bus: its chips on their buses, if they have registers.
    """

    def __init__(
        self,
        converters: Converters,
        number: int,
        wire: I2cWire,
        at_once: SignalChips,
        by_bus: I2cChips | None = None,
    ) -> None:
        self._converters = converters
        self._number = number
        self._wire = wire
        self._at_once = at_once
        self._by_bus = by_bus
        self._banged = BangedChips(wire)

    def configure(
        self, slots: Iterable[int], stages: StageMap, cdc_offset: int, power_control: int
    ) -> None:
        faulty = self._wire.faulty
        slots = list(slots)
        banged = [slot for slot in slots if faulty >> slot // CHIPS_PER_LINE & 1]
        sound = [slot for slot in slots if slot not in banged]
        if self._by_bus is not None:
            with self._converters.configuring():
                self._by_bus.configure(sound, stages, cdc_offset, power_control)
        self._at_once.configure(sound, stages, cdc_offset, power_control)
        self._banged.configure(banged, stages, cdc_offset, power_control)

    def read(self, without: int = 0) -> Words:
        if self._converters.read_at_once(self._number):
            return self._at_once.read(without)
        faulty = self._wire.faulty
        chips = self._by_bus or self._at_once
        words = chips.read(faulty)
        if not faulty:
            return words
        banged = self._banged.read(~faulty)
        for line in range(SLOTS // CHIPS_PER_LINE):
            if faulty >> line & 1:
                own = slice(CHIPS_PER_LINE * line, CHIPS_PER_LINE * (line + 1))
                words[own] = banged[own]
        return words


class _Unpowered:
    """Answers where a line is held low: every word is the same."""

    pointer = 0

    def __init__(self, word: int) -> None:
        self._word = word.to_bytes(2)

    def write(self, data: bytes) -> int:
        return len(data)

    def read(self, length: int) -> bytes:
        return (self._word * length)[:length]


class _InTime:
    """A chip on its line, updated to the present before every message."""

    def __init__(self, converters: Converters, number: int, chip: int) -> None:
        self._converters = converters
        self._number = number
        self._chip = chip
        self._reads = 0

    @property
    def pointer(self) -> int:
        return self._now().pointer

    @pointer.setter
    def pointer(self, address: int) -> None:
        self._now().pointer = address

    def write(self, data: bytes) -> int:
        if len(data) > 2:
            self._converters.written(self._number)
        return self._now().write(data)

    def read(self, length: int) -> bytes:
        return self._now().read(length)

    def _now(self) -> AD7147:
        chip = self._converters.synced(self._chip)
        reads = self._converters.reads(self._number)
        if reads != self._reads:
            # The firmware has read all results since, though not over this bus.
            self._reads = reads
            chip.pointer = reg.DEVICE_ID
        return chip
