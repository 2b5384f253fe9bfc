"""What a careful host says to the boards before they stream, for robots without a host."""

from typing import TYPE_CHECKING

from skin_host.bus.protocol.commands import (
    Message,
    SetBoardConfig,
    SetTriangleConfig,
    SetTxMode,
    TriangleFlags,
    TxMode,
    command_frame,
)
from skin_host.layout import BoardLayout, Layout

if TYPE_CHECKING:
    from emulator.robot import Robot

#: An MTB3 takes commands between calibrations of two periods; chips convert in 37 ms.
SETTLE_PERIODS = 4


def bring_up(robot: "Robot") -> None:
    """Configure and start all boards of a robot; a second or two pass, frames are dropped."""
    boards = robot.layout.boards

    def command(board: BoardLayout, message: Message) -> None:
        can_id, data = command_frame(message, robot.boards[board.name].address)
        robot.receive(board.settings.bus, can_id, data)

    settle_s = SETTLE_PERIODS * 1e-3 * max(board.settings.period_ms for board in boards)
    for board in boards:
        own = board.settings
        command(board, SetBoardConfig(own.skin_type, own.period_ms, own.no_load))
    robot.step(settle_s)
    set_ups = [triangle_set_ups(robot.layout, number) for number in range(len(boards))]
    # Twice: the first one may take its baseline before the chips have converted anew.
    for _ in range(2):
        for turn in range(max(map(len, set_ups))):
            for board, own_set_ups in zip(boards, set_ups, strict=True):
                if turn < len(own_set_ups):
                    command(board, own_set_ups[turn])
            robot.step(settle_s)
    robot.fingertips.start(robot.t_ns)
    for board in boards:
        command(board, SetTxMode(TxMode.START))


def triangle_set_ups(layout: Layout, board: int) -> list[SetTriangleConfig]:
    """Command 50 for each run of a board's triangles that are set up alike."""
    fitted = {
        triangle.number: (triangle.shift, triangle.cdc_offset)
        for triangle in layout.triangles
        if triangle.board == board
    }
    commands: list[SetTriangleConfig] = []
    for number, (shift, cdc_offset) in sorted(fitted.items()):
        first = number
        if commands:
            last = commands[-1]
            if (last.last, last.shift, last.cdc_offset) == (number - 1, shift, cdc_offset):
                first = commands.pop().first
        commands.append(SetTriangleConfig(first, number, shift, TriangleFlags.ENABLE, cdc_offset))
    return commands
