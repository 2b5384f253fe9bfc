"""MTB boards by name: `make_board("mtb4", ...)` gives the firmware of that model.

The models differ in commands, arithmetic, order of frames and pitfalls; see `emulator.boards`.
`set_up` gives the commands of a careful host before boards stream, for robots without a host.
"""

from collections.abc import Callable

import numpy as np

from emulator.boards.board import Burst, Frame, Mtb, join
from emulator.boards.chip_access import Chips, I2cChips
from emulator.boards.mtb3 import Mtb3
from emulator.boards.mtb4 import Mtb4, Mtb4c
from skin_host.bus.board import configuration
from skin_host.bus.commands import (
    Message,
)
from skin_host.layout import Layout

#: An MTB3 takes commands between calibrations of two periods; chips convert in 37 ms.
SETTLE_PERIODS = 4
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


def set_up(
    layout: Layout, send: Callable[[int, Message], None], wait: Callable[[float], object]
) -> None:
    """Configure all boards of a robot; this takes a second or two of emulated time.

    Args:
        layout: the boards and their set-up.
        send: sends a command to one of them, by its index in the layout.
        wait: lets seconds pass.
    """
    boards = layout.boards
    settle_s = SETTLE_PERIODS * 1e-3 * max(board.settings.period_ms for board in boards)
    commands = [
        configuration(board, [one for one in layout.triangles if one.board == number])
        for number, board in enumerate(boards)
    ]
    for number, (of_board, *_) in enumerate(commands):
        send(number, of_board)
    wait(settle_s)
    set_ups = [of_triangles for _, *of_triangles in commands]
    # Twice: the first one may take its baseline before the chips have converted again.
    for _ in range(2):
        for turn in range(max(map(len, set_ups))):
            for number, own_set_ups in enumerate(set_ups):
                if turn < len(own_set_ups):
                    send(number, own_set_ups[turn])
            wait(settle_s)
