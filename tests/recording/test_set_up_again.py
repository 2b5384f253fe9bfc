"""A board that the host sets up again in a recording: it has another zero from then on."""

from collections.abc import Callable
from pathlib import Path

import pytest

from emulator.boards.mtb import set_up
from emulator.probes.scene import load as load_scene
from emulator.robot import Robot
from skin_host.bus.commands import (
    Message,
    SetBoardConfig,
    SetTransmissionPeriod,
    SetTriangleConfig,
    SetTxMode,
    TactileSetup,
    TactileSetup2,
    TxMode,
    command_frame,
)
from skin_host.bus.wire import BROADCAST_ADDRESS, FrameBatch
from skin_host.config.settings import load
from skin_host.layout import Layout, build_layout
from skin_host.processing.core import Engine
from skin_host.recording.capture import CanLog
from skin_host.recording.replay import calibrate_from_log, replay
from skin_host.recording.turns import fed

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"
SETTINGS = load(CONFIG)
LAYOUT: Layout = build_layout(SETTINGS, CONFIG.parent)
T0_NS = 1_700_000_000 * 10**9
SCENE = """
about = "a press in which the boards are set up"
seed = 8
quiet = true
[[probe]]
part = "left_forearm"
at = { triangle = 3 }
diameter_mm = 8
pressure_kpa = [[0, 0], [0.2, 60], [5.8, 60], [6, 0]]
start_s = 6
"""


def recording(folder: Path) -> Path:
    """What a recorder on the bus has of a press in which all boards are set up."""
    scene = folder / "scene.toml"
    scene.write_text(SCENE)
    robot = Robot(SETTINGS, LAYOUT, load_scene(scene))
    robot.bring_up()
    path = folder / "a.log"
    with CanLog(path) as log:

        def step(seconds: float) -> None:
            batch = robot.step(seconds)["can0"]
            log.put("can0", FrameBatch(batch.id, batch.dlc, batch.data, batch.t_ns + T0_NS))

        def send(board: int, command: Message) -> None:
            can_id, data = command_frame(command, LAYOUT.boards[board].settings.address)
            log.put("can0", FrameBatch.of([(can_id, data, robot.t_ns + T0_NS)]))
            robot.receive("can0", can_id, data)

        while robot.t_ns < 8e9:
            step(0.1)
        set_up(LAYOUT, send, step)
        for board in range(len(LAYOUT.boards)):
            send(board, SetTxMode(TxMode.START))
        while robot.t_ns < 16e9:
            step(0.1)
    return path


def test_a_set_up_ends_what_touches_the_skin_and_invents_nothing(tmp_path: Path) -> None:
    """What is pressed then has no known zero until it is calibrated, as with the daemon."""
    log = recording(tmp_path)
    found = calibrate_from_log(log, SETTINGS, LAYOUT, 5.0)
    engine = Engine(SETTINGS, LAYOUT, list(range(len(LAYOUT.parts))), found)
    events = [
        (event.event, event.reason)
        for output in replay(log, engine)
        for step in output.steps
        for event in step.events
        if event.event != "move"
    ]
    assert events == [("begin", None), ("end", "lost")]
    assert any(engine.zeros.doubts().values())
    assert set(engine.zeros.rezeros) == set(engine.boards)


@pytest.mark.parametrize(
    ("command", "zeroes"),
    [
        (SetBoardConfig(1, 50, 240), True),
        (SetTriangleConfig(0, 15), True),
        (TactileSetup(), True),
        (TactileSetup2(), True),
        (SetTxMode(TxMode.START), False),
        (SetTransmissionPeriod(10), False),
    ],
)
@pytest.mark.parametrize("to_all", [False, True], ids=["one", "all"])
def test_the_commands_that_zero_a_board_do_so_for_the_boards_that_they_go_to(
    command: Message, zeroes: bool, to_all: bool
) -> None:
    engine = Engine(SETTINGS, LAYOUT, list(range(len(LAYOUT.parts))))
    zeroed: list[int] = []
    rezero: Callable[[int, bool], int] = engine.zeros.rezero

    def note(board: int, believed: bool = True) -> int:
        zeroed.append(board)
        return rezero(board, believed)

    engine.zeros.rezero = note  # type: ignore[method-assign]
    own = LAYOUT.boards[engine.boards[0]].settings
    can_id, data = command_frame(command, BROADCAST_ADDRESS if to_all else own.address)
    other = (0x7FF, b"", T0_NS)
    batch = FrameBatch.of([other, (can_id, data, T0_NS + 1), other])
    list(fed([(own.bus, batch)], engine, 0))
    boards = engine.boards if to_all else engine.boards[:1]
    assert zeroed == (boards if zeroes else [])
    assert engine.assemblers[own.bus].counters.frames == 3


def test_an_answer_or_a_damaged_command_zeroes_nothing() -> None:
    engine = Engine(SETTINGS, LAYOUT, list(range(len(LAYOUT.parts))))
    own = LAYOUT.boards[engine.boards[0]].settings
    can_id, data = command_frame(SetTriangleConfig(0, 15), own.address)
    frames = [
        (can_id, data[:3], T0_NS),
        (can_id, b"", T0_NS + 1),
        (can_id | 0x80000000, data, T0_NS + 2),
        (can_id | 0x10, data, T0_NS + 3),
    ]
    list(fed([(own.bus, FrameBatch.of(frames))], engine, 0))
    assert engine.ledger.rezeros.tolist() == [0] * len(engine.boards)
    assert not engine.zeros.rezeros
