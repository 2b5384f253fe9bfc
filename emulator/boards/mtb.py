"""MTB boards by name: `make_board("mtb4", ...)` gives the firmware of that model.

The models differ in commands, arithmetic, order of frames and pitfalls; see
`emulator.boards`.
"""

import numpy as np

from emulator.boards.board import Burst, Frame, Mtb, join
from emulator.boards.chip_access import Chips, I2cChips
from emulator.boards.mtb3 import Mtb3
from emulator.boards.mtb4 import Mtb4, Mtb4c

__all__ = ["Burst", "Chips", "Frame", "I2cChips", "Mtb", "join", "make_board"]


def make_board(
    model: str, address: int, chips: Chips, random: np.random.Generator | None = None
) -> Mtb:
    """Return a board in its state after power-up.

    Args:
        model: "mtb3", "mtb4" or "mtb4c".
        address: its stored CAN address, 1..14.
        chips: access to its chips: `I2cChips` over smbus2 buses, or an emulator's own.
        random: source of the random address for command 32 FF of the MTB4.

    Raises:
        ValueError: there is no such model.
    """
    match model:
        case "mtb3":
            return Mtb3(address, chips)
        case "mtb4" | "mtb4c":
            kind = Mtb4 if model == "mtb4" else Mtb4c
            return kind(address, chips, random or np.random.default_rng(0))
        case _:
            raise ValueError(f'no board "{model}"; there are: mtb3, mtb4, mtb4c')
