"""An MTB made of a single-board computer: the firmware model on real chips and a real bus.

AD7147s on /dev/i2c-1 and a CAN interface become a board that any host of the skin can use. The
same firmware runs on emulated chips; it drives whatever smbus2 buses it is given.
"""

from collections.abc import Sequence

import can
from smbus2 import SMBus

from emulator.boards.mtb import I2cChips, make_board
from emulator.clock import Clock, RealClock
from emulator.link import Link
from skin_host.bus.wire import FrameBatch

#: How often the bus is looked at for commands.
POLL_NS = 2_000_000


async def run(
    model: str, address: int, lines: Sequence[SMBus], bus: can.BusABC, clock: Clock | None = None
) -> None:
    """Be a board until cancelled.

    Args:
        model: "mtb3", "mtb4" or "mtb4c".
        address: CAN address, 1..14.
        lines: its I2C buses, one for each data line of a board: triangle t is the chip at
            0x2C + t % 4 of line t // 4. A computer with one bus has triangles 0 to 3.
        bus: an open python-can bus.
        clock: time to live in; the machine's own, if not given. Chips that are real live in
            real time.

    Raises:
        ValueError: there is no such model.
    """
    clock = clock or RealClock()
    board = make_board(model, address, I2cChips(lines))
    link = Link(f"of board {address}", bus)
    while True:
        now_ns = clock.now_ns()
        for can_id, data in link.received():
            answers = board.handle(can_id, data, now_ns)
            batch = FrameBatch.of([(answer, payload, now_ns) for answer, payload in answers])
            link.send(batch, clock.host_ns(batch.t_ns))
        batch = board.step(now_ns)
        link.send(batch, clock.host_ns(batch.t_ns))
        due_ns = now_ns + POLL_NS if board.due_ns is None else min(board.due_ns, now_ns + POLL_NS)
        await clock.sleep_until_ns(due_ns)
