"""A bus or a board that is away at the first start keeps the others from nothing, and is not
forgotten.
"""

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import Any

import can
import numpy as np
import pytest

from emulator.clock import RealClock
from emulator.faults import Fault
from emulator.probes.scene import Scene
from emulator.robot import Robot
from skin_host.clock import SteppedClock
from skin_host.config.settings import (
    Board,
    Bus,
    CalibrationSettings,
    Fingertip,
    Mqtt,
    Part,
    Patch,
    Processing,
    Service,
    Settings,
)
from skin_host.daemon.daemon import Daemon
from skin_host.daemon.memory import remembered
from skin_host.layout import build_layout
from tests.support.stepped import stepped

SIDES = ("left", "right")
PATIENCE_S = 60.0
_numbers = count()


class Adapters:
    """What python-can finds: every bus, but for those that are unplugged."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.unplugged: set[str] = set()
        self._open = can.Bus
        monkeypatch.setattr("can.Bus", self.open)

    def open(self, *args: Any, channel: str, **options: Any) -> can.BusABC:
        if channel in self.unplugged:
            raise can.CanInitializationError("it is not plugged in")
        return self._open(*args, channel=channel, **options)


class Body:
    """A robot, and one daemon after the other."""

    def __init__(self, settings: Settings, robot: Robot, clock: SteppedClock) -> None:
        self.robot = robot
        self._settings, self._clock = settings, clock
        self.daemon: Daemon

    def start(self, *, calibrate: bool = False) -> None:
        layout = build_layout(self._settings, Path())
        memory = remembered(self._settings, layout, "main", take_new=calibrate)
        self.daemon = Daemon(self._settings, layout, clock=self._clock, memory=memory)
        self._stop = asyncio.Event()
        self._host = asyncio.create_task(self.daemon.run(self._stop, calibrate=calibrate))

    async def end(self) -> None:
        self._stop.set()
        await self._host


@contextlib.asynccontextmanager
async def two_buses(
    state: Path,
    clock: SteppedClock,
    adapters: Adapters,
    *,
    unplugged: Sequence[str] = ("right",),
    hung: Sequence[str] = (),
    calibrate: bool = False,
    fingertips: Mapping[str, Fingertip] = MappingProxyType({}),
) -> AsyncIterator[Body]:
    """A daemon whose parts lie on a bus each, of which some are unplugged, or have a board that is
    silent.
    """
    sides = ("left",) if fingertips else SIDES
    buses = {
        side: Bus(interface="virtual", channel=f"late-{side}-{next(_numbers)}") for side in SIDES
    }
    settings = Settings(
        robot="r",
        buses=buses,
        boards={side: Board(bus=side, address=1) for side in sides},
        parts={side: Part(patches=[Patch(board=side, triangles="0")]) for side in sides},
        fingertips=dict(fingertips),
        mqtt=Mqtt(port=1),
        service=Service(state_directory=str(state)),
        processing=Processing(calibration=CalibrationSettings(seconds=3.0)),
    )
    robot = Robot(settings, build_layout(settings, Path()), Scene(quiet=True))
    for board in hung:
        robot.inject(Fault(name="board_silent", board=board))
    wires = {side: can.Bus(interface="virtual", channel=bus.channel) for side, bus in buses.items()}
    adapters.unplugged.update(buses[side].channel for side in unplugged)
    running = asyncio.create_task(robot.run(wires, RealClock(clock=clock)))
    body = Body(settings, robot, clock)
    body.start(calibrate=calibrate)
    try:
        yield body
    finally:
        await body.end()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        for wire in wires.values():
            wire.shutdown()


async def until(clock: SteppedClock, condition: Callable[[], object]) -> None:
    end_s = clock.monotonic_s() + PATIENCE_S
    while not condition():
        assert clock.monotonic_s() < end_s
        await clock.sleep(0.5)


def is_valid(daemon: Daemon, part: str) -> bool:
    record = daemon.records()[part]
    return record["valid_taxels"] == record["taxels"]


@pytest.mark.parametrize("calibrate", [False, True])
@stepped
async def test_a_bus_that_is_away_at_the_first_start_is_calibrated_when_it_comes(
    clock: SteppedClock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calibrate: bool
) -> None:
    adapters = Adapters(monkeypatch)
    async with two_buses(tmp_path, clock, adapters, calibrate=calibrate) as body:
        daemon = body.daemon
        await until(clock, lambda: is_valid(daemon, "left"))
        assert daemon.records()["right"]["valid_taxels"] == 0
        first = daemon.engine.calibration
        assert first is not None
        await clock.sleep(8.0)
        assert daemon.engine.calibration is first
        adapters.unplugged.clear()
        await until(clock, lambda: is_valid(daemon, "right"))
        left = daemon.layout.taxels_of([0])
        found = daemon.engine.calibration
        assert found is not None
        np.testing.assert_array_equal(found.baseline[left], first.baseline[left])
        assert is_valid(daemon, "left")
        await clock.sleep(8.0)
        assert daemon.engine.calibration is found


@stepped
async def test_what_an_operator_has_calibrated_is_not_calibrated_again(
    clock: SteppedClock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    adapters = Adapters(monkeypatch)
    async with two_buses(tmp_path, clock, adapters) as body:
        daemon = body.daemon
        await until(clock, lambda: is_valid(daemon, "left"))
        adapters.unplugged.clear()
        await until(clock, daemon.engine.ledger.sweeps.all)
        await until(clock, lambda: not daemon._calibration_lock.locked())
        found = await daemon.calibrate(3.0)
        await until(clock, lambda: is_valid(daemon, "right"))
        await clock.sleep(8.0)
        assert daemon.engine.calibration is found


@stepped
async def test_nothing_is_calibrated_while_no_board_sends(
    clock: SteppedClock,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    adapters = Adapters(monkeypatch)
    async with two_buses(tmp_path, clock, adapters, unplugged=SIDES) as body:
        daemon = body.daemon
        await clock.sleep(12.0)
        assert daemon.engine.calibration is None
        assert not [line for line in caplog.messages if "calibrat" in line and "is not" not in line]
        adapters.unplugged.clear()
        await until(clock, lambda: all(is_valid(daemon, side) for side in SIDES))


@stepped
async def test_fingertips_are_waited_for_as_only_a_calibration_of_all_gives_them_a_zero(
    clock: SteppedClock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    adapters = Adapters(monkeypatch)
    tips = {"index": Fingertip(bus="right", address=2, shape="sphere", radius_mm=13.0)}
    async with two_buses(tmp_path, clock, adapters, fingertips=tips) as body:
        daemon = body.daemon
        await clock.sleep(12.0)
        assert daemon.engine.ledger.sweeps.all()
        assert daemon.engine.calibration is None
        adapters.unplugged.clear()
        await until(clock, lambda: daemon.engine.calibration)
        assert daemon.engine.calibration is not None
        assert [*daemon.engine.calibration.zeros] == ["index"]


@stepped
async def test_a_bus_that_comes_after_a_restart_is_calibrated_all_the_same(
    clock: SteppedClock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    adapters = Adapters(monkeypatch)
    async with two_buses(tmp_path, clock, adapters) as body:
        await until(clock, lambda: is_valid(body.daemon, "left"))
        first = body.daemon.engine.calibration
        assert first is not None
        for _ in range(2):
            await body.end()
            body.start()
            await until(clock, lambda: is_valid(body.daemon, "left"))
            assert body.daemon.records()["right"]["valid_taxels"] == 0
        adapters.unplugged.clear()
        await until(clock, lambda: is_valid(body.daemon, "right"))
        found = body.daemon.engine.calibration
        assert found is not None
        left = body.daemon.layout.taxels_of([0])
        assert found.baseline[left] == pytest.approx(first.baseline[left], abs=1e-5)
        await body.end()
        body.start()
        await until(clock, lambda: all(is_valid(body.daemon, side) for side in SIDES))
        await clock.sleep(8.0)
        assert body.daemon.engine.calibration is not None
        assert body.daemon.engine.calibration.id == found.id


@pytest.mark.parametrize("restarts", [False, True])
@stepped
async def test_a_board_that_was_silent_at_the_first_start_is_calibrated_when_it_sends(
    clock: SteppedClock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, restarts: bool
) -> None:
    adapters = Adapters(monkeypatch)
    async with two_buses(tmp_path, clock, adapters, unplugged=(), hung=("right",)) as body:
        await until(clock, lambda: is_valid(body.daemon, "left"))
        if restarts:
            await body.end()
            body.start()
            await until(clock, lambda: is_valid(body.daemon, "left"))
        assert body.daemon.records()["right"]["valid_taxels"] == 0
        body.robot.mend(Fault(name="board_silent", board="right"))
        await until(clock, lambda: is_valid(body.daemon, "right"))


@stepped
async def test_a_board_whose_chips_do_not_answer_is_calibrated_when_it_has_started_with_them(
    clock: SteppedClock,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Until then it is not tried again and again: operators could take no calibration meanwhile."""
    caplog.set_level(logging.INFO)

    def calibrations() -> int:
        return sum(line.startswith("calibrating for") for line in caplog.messages)

    adapters = Adapters(monkeypatch)
    async with two_buses(tmp_path, clock, adapters, unplugged=()) as body:
        mend = body.robot.inject(Fault(name="chip_gone", board="right", triangle=0))
        await until(clock, lambda: is_valid(body.daemon, "left"))
        await clock.sleep(12.0)
        assert calibrations() == 1
        mend()
        await clock.sleep(24.0)
        # The chip answers, and its board, which has not found it when it started, reads nothing.
        assert calibrations() == 2
        assert body.daemon.records()["right"]["valid_taxels"] == 0
        body.robot.inject(Fault(name="board_reset", board="right"))
        await until(clock, lambda: is_valid(body.daemon, "right"))
        assert calibrations() == 3


@stepped
async def test_while_only_silent_boards_are_there_the_log_has_why_nothing_is_calibrated(
    clock: SteppedClock,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Whichever bus gives boards first is calibrated first."""
    adapters = Adapters(monkeypatch)
    async with two_buses(tmp_path, clock, adapters, hung=("left",)) as body:
        await clock.sleep(12.0)
        assert body.daemon.engine.calibration is None
        assert "no board sent a sweep; check with `skin scan`" in caplog.text
        adapters.unplugged.clear()
        await until(clock, lambda: is_valid(body.daemon, "right"))
        assert body.daemon.records()["left"]["valid_taxels"] == 0
        body.robot.mend(Fault(name="board_silent", board="left"))
        await until(clock, lambda: all(is_valid(body.daemon, side) for side in SIDES))
