"""A robot that lives ahead of those who look at it does what one does that nobody lets ahead."""

import random
from pathlib import Path

import numpy as np
import pytest

from emulator.boards.board import join
from emulator.probes.scene import Fault, Place, Probe, Scene, Temperature
from emulator.robot import NS, Robot
from skin_host.bus.commands import SetTxMode, TxMode, command_frame
from skin_host.bus.wire import FrameBatch
from skin_host.config import settings as configurations
from skin_host.evaluation.simulate import ahead
from skin_host.layout import build_layout

CONFIG = Path(__file__).parents[3] / "config"
#: Three boards on one bus, and ten on another.
ROBOTS = ("demo", "kaspar")
FAULTS = (
    Fault(name="board_reset", board=""),
    Fault(name="bit_flipped", board="", triangle=0, value=0.01),
    Fault(name="stuck_taxel", board="", triangle=0, taxel=3),
    Fault(name="late_period", board="", value=3.0),
)


def robot(name: str, *, quiet: bool) -> Robot:
    path = CONFIG / f"{name}.toml"
    settings = configurations.load(path)
    warm = Temperature(keyframes_c=[(0.0, 24.0), (20.0, 26.0)])
    scene = Scene(quiet=quiet, temperature=warm, seed=3)
    made = Robot(settings, build_layout(settings, path.parent), scene)
    made.bring_up()
    return made


class Direct:
    """A robot that is never ahead."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.t_ns = robot.t_ns

    def move_to(self, t_ns: int) -> dict[str, FrameBatch]:
        self.t_ns = t_ns
        return self._robot.step((t_ns - self._robot.t_ns) / NS)

    def true_pressure_kpa(self) -> np.ndarray:
        return self._robot.skin.true_pressure_kpa()


def life(robot: Robot, ahead: "ahead.Ahead | Direct", seed: int) -> list[bytes]:
    """What a robot sends and feels while it is looked at, pressed, commanded and broken."""
    chance = random.Random(seed)
    part = robot.layout.parts[0]
    place = Place(taxel=chance.randrange(part.n_taxels))
    probe = robot.touch(Probe(part=part.name, at=place, diameter_mm=8.0, force_n=[(0.0, 0.0)]))
    came: dict[str, list[FrameBatch]] = {name: [] for name in robot.wires}
    felt = []
    for _ in range(250):
        for name, batch in ahead.move_to(ahead.t_ns + chance.randrange(1, 60_000_000)).items():
            came[name].append(batch)
        felt.append(ahead.true_pressure_kpa().tobytes())
        acts = chance.random()
        board = chance.choice(list(robot.boards))
        if acts < 0.03:
            probe.press(chance.uniform(0.5, 4.0))
        elif acts < 0.05:
            probe.lift()
        elif acts < 0.06:
            chosen = robot.layout.boards[list(robot.boards).index(board)].settings
            for mode in (TxMode.STOP, TxMode.START):
                robot.receive(chosen.bus, *command_frame(SetTxMode(mode), chosen.address))
        elif acts < 0.08:
            fault = chance.choice(FAULTS)
            robot.inject(Fault(**{**_fields(fault), "board": board, "until_s": 0.3}))
    sent = [join(batches) for batches in came.values()]
    octets = [array.tobytes() for one in sent for array in (one.id, one.dlc, one.data, one.t_ns)]
    return octets + felt


def _fields(fault: Fault) -> dict[str, object]:
    return {name: getattr(fault, name) for name in fault.__struct_fields__}


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("seed", range(4))
def test_a_robot_that_is_ahead_sends_and_feels_the_same(name: str, seed: int) -> None:
    quiet = seed % 2 == 0
    one, other = robot(name, quiet=quiet), robot(name, quiet=quiet)
    assert life(one, ahead.Ahead(one), seed) == life(other, Direct(other), seed)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_goes_back_to_what_it_was(name: str) -> None:
    one = robot(name, quiet=False)
    part = one.layout.parts[0]
    probe = one.touch(Probe(part=part.name, at=Place(taxel=7), force_n=[(0.0, 0.0)]))
    probe.press(2.0)
    while not one.is_steady:
        one.step(0.001)
    other = Robot.restore(one.save(), one.settings, one.layout)
    mark = one.mark()
    one.step(0.7)
    one.go_back(mark)
    assert one.t_ns == other.t_ns
    for seconds in (0.013, 0.4, 1.0):
        sent, wanted = one.step(seconds), other.step(seconds)
        for bus in one.wires:
            assert sent[bus].t_ns.tolist() == wanted[bus].t_ns.tolist()
            assert sent[bus].data.tobytes() == wanted[bus].data.tobytes()
        pressures = [which.skin.true_pressure_kpa().tobytes() for which in (one, other)]
        assert pressures[0] == pressures[1]
