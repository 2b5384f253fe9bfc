"""A robot that is saved and restored goes on as if nothing had happened; other files do nothing."""

import os
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator import state
from emulator.faults import KINDS, parse
from emulator.probes.scene import Fault, Place, Probe, Scene
from emulator.probes.scene import load as load_scene
from emulator.robot import Robot
from emulator.state import StateError
from skin_host.config.settings import Settings, load
from skin_host.layout import Layout, build_layout

CONFIG = Path(__file__).parents[2] / "config"
FAULTS = (
    "stuck_taxel board=hand triangle=2 taxel=3",
    "noisy_taxel board=hand triangle=2 taxel=4",
    "chip_gone board=forearm_outer triangle=3",
    "frame_loss bus=can0 value=0.1",
    "no_acknowledge board=hand triangle=0",
    "bit_flipped board=forearm_inner triangle=0",
    "shared_address board=forearm_outer triangle=6",
    "wrong_address board=forearm_outer triangle=9 value=0",
    "swapped_lines board=forearm_inner triangle=2 value=1",
    "shorted_finger board=forearm_outer triangle=13",
    "slow_rise board=hand triangle=9",
    "clock_stretched board=hand triangle=8",
    "data_held_low board=forearm_outer triangle=0",
    "late_period board=hand",
    "jittered_period board=forearm_outer",
    "board_silent board=forearm_inner",
    "babbling_node bus=can0 value=0.1",
    "temperature_step value=3",
)
OF_FINGERTIPS = ("board_silent board=index", "board_latched board=thumb value=1")


def skin(name: str = "demo") -> tuple[Settings, Layout]:
    settings = load(CONFIG / f"{name}.toml")
    return settings, build_layout(settings, CONFIG)


def sent(robot: Robot, steps: int) -> bytes:
    batches = [robot.step(0.05)["can0"] for _ in range(steps)]
    return b"".join(
        batch.id.tobytes() + batch.data.tobytes() + batch.t_ns.tobytes() for batch in batches
    )


@pytest.mark.parametrize("fidelity", ["signal", "chip"])
@pytest.mark.parametrize("name", ["demo", "fingertips"])
def test_branches_from_one_state_send_the_same_bytes(
    name: str, fidelity: str, tmp_path: Path
) -> None:
    """In the middle of a press, with faults on that end later."""
    configuration = skin(name)
    scene = load_scene(CONFIG / "scenes" / f"{name}.toml")
    robot = Robot(*configuration, scene, fidelity=fidelity)
    robot.bring_up()
    robot.step(7.0 - robot.t_ns * 1e-9)
    for line in FAULTS if name == "demo" else OF_FINGERTIPS:
        fault = parse(line)
        fault.at_s, fault.until_s = 0.0, 0.8
        robot.inject(fault)
    robot.step(0.3)
    robot.write(tmp_path / "state")
    branches = [Robot.read(tmp_path / "state", *configuration) for _ in range(2)]

    wanted = sent(robot, 25)
    for branch in branches:
        assert sent(branch, 25) == wanted
        np.testing.assert_array_equal(branch.skin.capacitance_ff, robot.skin.capacitance_ff)


def test_a_slide_goes_on_from_its_state_as_if_it_had_not_been_saved() -> None:
    settings, layout = skin()
    probe = Probe(
        part=layout.parts[0].name,
        at=Place(taxel=17),
        diameter_mm=9.0,
        force_n=[(0.0, 1.0), (9.0, 3.0)],
        slide_mm=[(0.0, -10.0, 0.0), (9.0, 20.0, 5.0)],
    )
    robot = Robot(settings, layout, Scene(probe=[probe]))
    robot.bring_up()
    robot.step(0.123)
    branch = Robot.restore(robot.save(), settings, layout)

    assert sent(branch, 40) == sent(robot, 40)
    np.testing.assert_array_equal(branch.skin.capacitance_ff, robot.skin.capacitance_ff)


def test_a_state_of_another_configuration_is_refused() -> None:
    robot = Robot(*skin())
    other = skin("fingertips")

    with pytest.raises(StateError, match="of another configuration"):
        Robot.restore(robot.save(), *other)


def test_a_state_of_taxels_that_were_moved_since_is_refused() -> None:
    """Settings name files of positions; what presses would lie where taxels were before."""
    settings, layout = skin()
    robot = Robot(settings, layout)
    Robot.restore(robot.save(), *skin())
    moved = replace(layout, position_m=layout.position_m + 1e-3)
    with pytest.raises(StateError, match="of another configuration"):
        Robot.restore(robot.save(), settings, moved)


def test_a_damaged_or_foreign_file_is_refused_in_one_line(tmp_path: Path) -> None:
    configuration = skin()
    data = Robot(*configuration).save()
    for wrong in (b"", b"hello", data[: len(data) // 2], data[:60]):
        (tmp_path / "state").write_bytes(wrong)
        with pytest.raises(StateError) as refused:
            Robot.read(tmp_path / "state", *configuration)
        assert str(tmp_path / "state") in str(refused.value)
        assert "\n" not in str(refused.value)


class _Evil:
    def __init__(self, *call: object) -> None:
        self._call = call

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return self._call[0], self._call[1:]


@pytest.mark.parametrize(
    "call",
    [
        (os.system, "true"),
        (eval, "1"),
        (getattr, "", "join"),
        (getattr, Path("x"), "write_text"),
        (load, Path("x")),
    ],
)
def test_a_state_calls_nothing_but_the_emulators_own(call: tuple[object, ...]) -> None:
    configuration = skin()
    head = Robot(*configuration).save()[: len(state.MAGIC) + state.DIGEST_BYTES]

    with pytest.raises(StateError, match="the state names"):
        Robot.restore(head + pickle.dumps(_Evil(*call)), *configuration)


class _Calls:
    """Calls a method of an object when it is read; `owner` is found in the state itself."""

    def __init__(self, method: object, *arguments: object) -> None:
        self._call = method, arguments

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return self._call


def test_a_state_cannot_have_its_robot_write_files(tmp_path: Path) -> None:
    """Whoever reads a state of somebody else would lose a file of their own."""
    configuration = skin()
    robot = Robot(*configuration)
    kept = tmp_path / "kept"
    kept.write_text("kept")
    for method, *arguments in ((robot.write, kept), (robot.step, 1e9), (Robot.read, kept)):
        wrong = state.save(_Calls(method, *arguments), configuration)
        with pytest.raises(StateError, match="the state names"):
            Robot.restore(wrong, *configuration)
    assert kept.read_text() == "kept"


@pytest.mark.parametrize("fidelity", ["signal", "chip"])
@pytest.mark.parametrize("name", ["demo", "fingertips"])
def test_a_robot_with_any_fault_can_be_saved(name: str, fidelity: str) -> None:
    configuration = skin(name)
    robot = Robot(*configuration, fidelity=fidelity)
    robot.bring_up()
    places: dict[str, Any] = {
        "board": next(iter(robot.boards)),
        "bus": next(iter(robot.wires)),
        "triangle": configuration[1].boards[0].triangles[0],
        "taxel": 3,
    }
    for kind, of_kind in KINDS.items():
        named = {key: places[key] for key in of_kind.needs}
        if of_kind.aim is not None:
            named["value"] = 2.0  # another line or address than its own
        if of_kind.on != "skin" and robot.fingertips.boards:
            named["board"] = next(iter(robot.fingertips.boards))
        elif of_kind.on == "fingertip":
            continue
        alone = Robot.restore(robot.save(), *configuration)
        alone.inject(Fault(name=kind, until_s=0.1, **named))
        alone.step(0.05)
        Robot.restore(alone.save(), *configuration).step(0.2)
