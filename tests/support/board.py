"""A board on the bench: firmware, emulated I2C lines and chips, without a CAN bus."""

from collections.abc import Sequence

from emulator.boards.chip_access import I2cChips
from emulator.boards.mtb import make_board
from emulator.chips.ad7147 import AD7147
from emulator.chips.i2c import build_lines
from skin_host.bus.answers import parse_answer
from skin_host.bus.commands import Message, command_frame

RESTING_FF = 9000.0
STEP_NS = 1_000_000


class BoardOnBench:
    """A board with noise-free chips at some slots, all pads at `RESTING_FF`."""

    def __init__(
        self, model: str, address: int = 1, slots: Sequence[int] = (0,), skin_type: int = 0
    ) -> None:
        self.chips = {slot: AD7147() for slot in slots}
        for chip in self.chips.values():
            chip.set_capacitances_ff([RESTING_FF] * 12)
        positions = 20 if skin_type == 3 else 16
        self.lines = build_lines([self.chips.get(slot) for slot in range(positions)])
        self.board = make_board(model, address, I2cChips(self.lines))
        self.t_ns = 0

    def say(self, command: Message) -> list[Message]:
        """Send a command to the board's address; its answers, and those of the next instant."""
        can_id, data = command_frame(command, self.board.address)
        frames = self.board.handle(can_id, data, self.t_ns)
        parsed = [parse_answer(answer_id, payload) for answer_id, payload in frames]
        return [one[1] for one in parsed if one is not None and isinstance(one[1], Message)]

    def run(self, seconds: float) -> list[tuple[int, bytes]]:
        """Let time pass in milliseconds; the frames that the board sends."""
        frames: list[tuple[int, bytes]] = []
        for _ in range(round(seconds * 1e9 / STEP_NS)):
            self.t_ns += STEP_NS
            for chip in self.chips.values():
                chip.advance(STEP_NS * 1e-9)
            batch = self.board.step(self.t_ns)
            frames += [
                (int(can_id), data[:dlc].tobytes())
                for can_id, dlc, data in zip(batch.id, batch.dlc, batch.data, strict=True)
            ]
        return frames

    def triangle(self, frames: list[tuple[int, bytes]], number: int) -> tuple[list[int], int]:
        """Values and status word of the last pair of frames of a triangle."""
        own = [data for can_id, data in frames if can_id & 0xF == number]
        a = next(data for data in reversed(own) if data[0] == 0x40)
        b = next(data for data in reversed(own) if data[0] == 0xC0)
        return [*a[1:], *b[1:6]], int.from_bytes(b[6:8])
