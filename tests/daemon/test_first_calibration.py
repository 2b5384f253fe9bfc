"""The calibration that a daemon takes by itself names what touched the skin meanwhile, as one does
that an operator asks for.
"""

import logging
from pathlib import Path

import pytest

from emulator.probes.scene import Fault, Place, Probe, Scene
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus
from tests.support.live import living
from tests.support.stepped import stepped
from tests.support.waiting import PATIENCE_S

PRESS = Probe(
    part="left_hand",
    at=Place(taxel=3),
    diameter_mm=4,
    pressure_kpa=[(0, 0), (0.1, 60), (1000, 60)],
    start_s=1.5,
)


def warnings_of_touch(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [
        record.getMessage()
        for record in caplog.records
        if record.levelno == logging.WARNING and "touched while" in record.getMessage()
    ]


@stepped
async def test_pads_that_were_touched_are_a_warning_with_the_command_that_mends_it(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scene = Scene(quiet=True, probe=[PRESS])
    async with living(can_bus_settings, tmp_path, scene=scene, clock=clock) as live:
        await clock.sleep(1.0)
        pressed = live.daemon.records()["left_hand"]["taxel_verdicts"]["touched"]
        assert 3 in pressed
    (line,) = warnings_of_touch(caplog)
    assert line.startswith("the skin was touched while it was calibrated: taxel")
    assert " of left_hand; take away what touches it" in line
    assert "repeat with `skin command calibrate`: these read too little until then" in line


@stepped
async def test_a_robot_that_gets_its_power_later_is_calibrated_then_and_not_tried_until_then(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A service beside a robot that is switched off wrote two lines every six seconds."""
    caplog.set_level(logging.INFO)
    late_s = PATIENCE_S - 30.0
    async with living(can_bus_settings, tmp_path, robot_late_s=late_s, clock=clock) as live:
        assert live.daemon.engine.calibration is not None
    for text, wanted in (("no calibration: no board sent a sweep", 1), ("calibrating for", 2)):
        assert sum(record.getMessage().startswith(text) for record in caplog.records) == wanted


@stepped
async def test_a_reason_for_no_calibration_is_a_warning_once(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    boards = {"hand": [*range(5), *range(8, 12)], "forearm_outer": range(16)}
    boards["forearm_inner"] = range(8)
    faults = [
        Fault(name="chip_gone", board=board, triangle=triangle, until_s=60.0)
        for board, triangles in boards.items()
        for triangle in triangles
    ]
    faults += [Fault(name="board_reset", board=board, at_s=61.0) for board in boards]
    scene = Scene(quiet=True, fault=faults)
    async with living(can_bus_settings, tmp_path, scene=scene, clock=clock) as live:
        assert live.daemon.engine.calibration is not None
    said = [one.getMessage() for one in caplog.records if "no calibration" in one.getMessage()]
    assert said
    assert len(said) == len(set(said))


@stepped
async def test_untouched_skin_is_none(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await clock.sleep(1.0)
        assert live.daemon.engine.calibration is not None
    assert not warnings_of_touch(caplog)
