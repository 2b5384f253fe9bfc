"""A calibration that finds nothing tells boards that do not send from boards whose taxels are all
unusable, and from boards that are zeroed again and again.
"""

import asyncio
from pathlib import Path

import can
import pytest

from emulator.clock import RealClock
from emulator.probes.scene import Fault, Scene
from emulator.robot import Robot
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus, changed, load
from skin_host.daemon.calibrate import take_calibration
from skin_host.errors import SkinError
from skin_host.layout import build_layout, parts_of
from skin_host.tasks import cancel
from tests.support.live import CONFIG
from tests.support.stepped import stepped

BOARDS = ("hand", "forearm_outer", "forearm_inner")
#: The triangles of the demo's boards.
USED = {"hand": [*range(5), *range(8, 12)], "forearm_outer": range(16), "forearm_inner": range(8)}


def chips_gone(*boards: str) -> Scene:
    faults = [
        Fault(name="chip_gone", board=board, triangle=triangle)
        for board in boards
        for triangle in USED[board]
    ]
    return Scene(quiet=True, fault=faults)


async def why_none(
    scene: Scene,
    hung: tuple[str, ...],
    clock: SteppedClock,
    place: Path,
    restarting: tuple[str, ...] = (),
) -> str:
    """What `skin calibrate` answers beside a robot whose boards `hung` send nothing, and others
    restart every 0.8 s.
    """

    async def restart(robot: Robot) -> None:
        while restarting:
            await clock.sleep(0.8)
            for board in restarting:
                robot.inject(Fault(name="board_reset", board=board))

    bus = Bus(interface="virtual", channel=place.name)
    settings = changed(load(CONFIG), {"buses.can0": bus, "service.state_directory": str(place)})
    layout = build_layout(settings, CONFIG.parent)
    robot = Robot(settings, layout, scene)
    for board in hung:
        robot.inject(Fault(name="board_silent", board=board))
    with can.Bus(interface=bus.interface, channel=bus.channel) as can_bus:
        body = asyncio.create_task(robot.run({"can0": can_bus}, RealClock(clock=clock)))
        supply = asyncio.create_task(restart(robot))
        with pytest.raises(SkinError, match=r"^no calibration: ") as refusal:
            await take_calibration(
                settings, layout, parts_of(layout, "main"), 1.5, lambda _: None, clock
            )
        await cancel(body, supply)
    return str(refusal.value)


@stepped
async def test_of_boards_that_send_nothing_it_names_power(
    clock: SteppedClock, tmp_path: Path
) -> None:
    why = await why_none(Scene(quiet=True), BOARDS, clock, tmp_path)
    assert "no board sent a sweep; check with `skin scan`" in why


@stepped
async def test_of_boards_whose_chips_do_not_answer_it_names_those(
    clock: SteppedClock, tmp_path: Path
) -> None:
    why = await why_none(chips_gone(*BOARDS), (), clock, tmp_path)
    assert "no board sent" not in why
    assert "skin scan" not in why
    assert "no taxel gave a usable sample" in why
    for board, triangles in (("hand", "0-4,8-11"), ("forearm_inner", "0-7")):
        assert f"board {board}: triangles {triangles} not connected" in why
    assert why.endswith("`skin status` has all that is wrong")


@stepped
async def test_a_board_that_does_not_send_beside_one_without_chips_is_named(
    clock: SteppedClock, tmp_path: Path
) -> None:
    hung = ("forearm_outer", "forearm_inner")
    why = await why_none(chips_gone("hand"), hung, clock, tmp_path)
    assert "board hand: triangles 0-4,8-11 not connected" in why
    for board in hung:
        assert f"board {board}: no sweep" in why


@stepped
async def test_of_boards_that_restart_again_and_again_nothing_is_kept(
    clock: SteppedClock, tmp_path: Path
) -> None:
    why = await why_none(Scene(quiet=True), (), clock, tmp_path, restarting=BOARDS)
    assert "no pad is usable by what was received: left_hand: " in why
    assert "too few" in why
    assert "times meanwhile, as by a restart: check with `skin scan` whether it keeps" in why
