"""What is touched is kept before the daemon, its computer or a board loses its power."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from emulator.clock import RealClock
from emulator.probes.scene import Fault, Place, Probe, Scene
from emulator.robot import Robot
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus, changed, load
from skin_host.daemon.calibrate import take_calibration
from skin_host.daemon.daemon import Daemon
from skin_host.daemon.lasting import LOOK_S, REVIEW_S, UNTOUCHED_S, LastingTouches
from skin_host.daemon.memory import remembered
from skin_host.files import write_document
from skin_host.layout import build_layout, parts_of
from skin_host.mqtt.messages import ContactState
from skin_host.processing.calibration.outcome import outcome
from tests.support.live import CONFIG
from tests.support.stepped import stepped

#: Three taxels of board 0, two of board 1.
BOARDS = np.array([0, 0, 0, 1, 1])


def mask(*taxels: int) -> np.ndarray:
    found = np.zeros(len(BOARDS), np.bool_)
    found[list(taxels)] = True
    return found


def kept(touches: LastingTouches) -> list[int]:
    return np.flatnonzero(touches.kept).tolist()


@pytest.fixture
def touches() -> LastingTouches:
    return LastingTouches(BOARDS, mask())


def test_a_touch_that_two_looks_find_is_kept(touches: LastingTouches) -> None:
    assert not touches.look(mask(1), mask(), 100.0)
    assert not touches.look(mask(1, 3), mask(), 100.0 + 0.9 * LOOK_S)
    assert kept(touches) == []
    assert touches.look(mask(1, 3), mask(), 100.0 + LOOK_S)
    assert kept(touches) == [1]


def test_touches_of_a_board_are_kept_until_it_has_been_untouched_for_a_while(
    touches: LastingTouches,
) -> None:
    """The edge of a contact comes and goes: that is no reason to write."""
    for look in range(4):
        touches.look(mask(1, 4) if look % 2 else mask(0, 1, 4), mask(), look * LOOK_S)
    assert kept(touches) == [1, 4]
    for look in range(4, 20):
        touches.look(mask(1), mask(), look * LOOK_S)
        assert kept(touches) == ([1, 4] if (look - 3) * LOOK_S < UNTOUCHED_S else [1])


def test_what_a_board_in_use_no_longer_feels_is_not_kept_for_ever(touches: LastingTouches) -> None:
    """A hand that is never untouched would keep all that it has ever felt."""
    for look in range(3):
        touches.look(mask(0, 1, 4), mask(), look * LOOK_S)
    until = round(2 * REVIEW_S / LOOK_S) + 3
    writes = sum(touches.look(mask(1, 4), mask(), look * LOOK_S) for look in range(3, until))
    assert kept(touches) == [1, 4]
    assert writes == 1


def test_the_edge_of_a_contact_that_comes_and_goes_is_not_written_again(
    touches: LastingTouches,
) -> None:
    touches.look(mask(0, 1), mask(), 0.0)
    touches.look(mask(0, 1), mask(), LOOK_S)
    for look in range(2, 100):
        edge = mask(0, 1) if look % 10 == 0 else mask(1)
        assert not touches.look(edge, mask(), look * LOOK_S)
    assert kept(touches) == [0, 1]


def test_a_touch_of_a_board_that_falls_silent_is_kept_at_once(touches: LastingTouches) -> None:
    touches.look(mask(1, 4), mask(), 100.0)
    assert touches.look(mask(1, 4), mask(3, 4), 100.1)
    assert kept(touches) == [4]
    assert not touches.look(mask(1, 4), mask(3, 4), 100.2)


def test_what_a_start_finds_is_kept_until_its_board_has_shown_otherwise() -> None:
    touches = LastingTouches(BOARDS, mask(1, 4))
    touches.look(mask(4), mask(), 100.0)
    assert kept(touches) == [4]


def test_a_calibration_ends_what_is_kept(touches: LastingTouches) -> None:
    touches.look(mask(1, 4), mask(), 100.0)
    touches.look(mask(1, 4), mask(), 100.0 + LOOK_S)
    touches.calibrated(mask(0, 1, 2))
    assert kept(touches) == [4]
    touches.look(mask(1, 4), mask(), 100.0 + 2 * LOOK_S)
    assert kept(touches) == [4]


class Lives:
    """A robot whose hand is pressed in turn, and daemons that come and go."""

    def __init__(self, clock: SteppedClock, state: Path, until_s: float) -> None:
        bus = Bus(interface="virtual", channel=state.name)
        self.clock = clock
        self.settings = changed(
            load(CONFIG),
            {
                "buses.can0": bus,
                "service.state_directory": str(state),
                "mqtt.port": 1,
                "processing.calibration.seconds": 1.5,
            },
        )
        self.layout = build_layout(self.settings, CONFIG.parent)
        press = Probe(
            part="left_hand",
            at=Place(triangle=4),
            diameter_mm=10,
            pressure_kpa=[(0, 0), (0.1, 60), (until_s - 6, 60), (until_s - 5.9, 0), (1e4, 0)],
            start_s=6.0,
        )
        self.robot = Robot(self.settings, self.layout, Scene(quiet=True, probe=[press]))
        self._can = can.Bus(interface=bus.interface, channel=bus.channel)
        robot_run = self.robot.run({"can0": self._can}, RealClock(clock=clock))
        self._body = asyncio.create_task(robot_run)
        self._began_s = clock.monotonic_s()
        self.file = state / "demo-main.zeros.json"
        self.contact: dict[str, ContactState] = {}
        self.daemon: Daemon
        self._stop = asyncio.Event()

    async def start(self, **run: Any) -> None:
        memory = remembered(self.settings, self.layout, "main", take_new=bool(run))
        self.daemon = daemon = Daemon(self.settings, self.layout, memory=memory, clock=self.clock)
        self.contact = {}
        daemon.publisher.put_contact = self.contact.__setitem__  # type: ignore[method-assign]
        self._stop = asyncio.Event()
        self._host = asyncio.create_task(daemon.run(self._stop, **run))
        while daemon.engine.calibration is None or daemon._calibration_lock.locked():
            await self.clock.sleep(0.05)

    async def until(self, time_s: float) -> None:
        await self.clock.sleep(time_s - (self.clock.monotonic_s() - self._began_s))

    async def end(self) -> None:
        self._stop.set()
        await self._host

    async def kill(self) -> None:
        """Nothing is written, no board is stopped."""

        async def nothing(*_: Any, **__: Any) -> None:
            pass

        self.daemon.keeper.end = nothing  # type: ignore[method-assign]
        self.daemon.link.stop = nothing  # type: ignore[method-assign]
        self._host.cancel()
        await asyncio.gather(self._host, return_exceptions=True)

    def reset_boards(self) -> None:
        for board in self.robot.boards:
            self.robot.inject(Fault(name="board_reset", board=board))

    def touched(self) -> list[int]:
        """What the file holds as touched."""
        if not self.file.exists():
            return []
        found: list[int] = json.loads(self.file.read_bytes())["touched"].get("left_hand", [])
        return found

    async def close(self) -> None:
        self._body.cancel()
        await asyncio.gather(self._body, return_exceptions=True)
        self._can.shutdown()


@contextlib.asynccontextmanager
async def lives(clock: SteppedClock, state: Path, until_s: float = 1000.0) -> AsyncIterator[Lives]:
    made = Lives(clock, state, until_s)
    await made.start()
    try:
        yield made
    finally:
        await made.end()
        await made.close()


@stepped
async def test_a_touch_that_lasts_is_in_a_file_until_it_is_over(
    clock: SteppedClock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[str] = []

    def write(path: Path, document: Any) -> None:
        written.append(path.name)
        write_document(path, document)

    monkeypatch.setattr("skin_host.daemon.keeper.write_document", write)
    async with lives(clock, tmp_path, until_s=20.0) as live:
        await live.until(6.9)
        assert written == []
        await live.until(11.0)
        assert written == [live.file.name]
        assert len(live.touched()) >= 4
        await live.until(26.0)
        # Foam settles, so that a contact may grow once more.
        assert len(written) <= 2
        assert live.touched()
        written.clear()
        await live.until(36.0)
        assert written == [live.file.name]
        assert live.touched() == []


@stepped
async def test_what_is_held_while_robot_and_computer_lose_their_power_is_not_off_after_it(
    clock: SteppedClock, tmp_path: Path
) -> None:
    async with lives(clock, tmp_path) as live:
        await live.until(12.0)
        assert live.contact["left_hand"] == "ON"
        await live.kill()
        live.reset_boards()
        await clock.sleep(10.0)
        await live.start()
        await clock.sleep(12.0)
        assert live.contact == {"left_hand": "UNKNOWN", "left_forearm": "OFF"}
        # A crash before the operator has helped must not end the doubt.
        await live.kill()
        await live.start()
        await clock.sleep(12.0)
        assert live.contact == {"left_hand": "UNKNOWN", "left_forearm": "OFF"}


@stepped
async def test_a_touch_in_which_a_board_fell_silent_is_in_doubt_after_a_crash(
    clock: SteppedClock, tmp_path: Path
) -> None:
    async with lives(clock, tmp_path) as live:
        await live.until(7.0)
        assert live.touched() == []
        mend = live.robot.inject(Fault(name="board_silent", board="hand"))
        await clock.sleep(1.0)
        assert live.touched()
        await live.kill()
        await live.start()
        await clock.sleep(1.0)
        live.robot.inject(Fault(name="board_reset", board="hand"))
        mend()
        await clock.sleep(15.0)
        assert live.contact == {"left_hand": "UNKNOWN", "left_forearm": "OFF"}


@stepped
async def test_what_is_released_while_the_daemon_is_away_and_its_boards_send_is_untouched(
    clock: SteppedClock, tmp_path: Path
) -> None:
    async with lives(clock, tmp_path, until_s=14.0) as live:
        await live.until(12.0)
        assert live.touched()
        await live.kill()
        await live.until(20.0)
        await live.start()
        await clock.sleep(15.0)
        assert live.contact == {"left_hand": "OFF", "left_forearm": "OFF"}
        assert live.touched() == []


@stepped
async def test_a_calibration_in_the_grip_of_a_restart_names_what_is_pressed(
    clock: SteppedClock, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with lives(clock, tmp_path, until_s=40.0) as live:
        await live.until(12.0)
        await live.end()
        await live.start()
        await clock.sleep(6.0)
        answer = await live.daemon.control.handle("calibrate", b"{}")
        assert answer["touched"]["left_hand"]
        assert "nothing has shown that this is over" in caplog.text
        await live.until(45.0)
        # It has lifted: the operator sets the board up and calibrates it untouched.
        await live.daemon.configure()
        await clock.sleep(4.0)
        answer = await live.daemon.control.handle("calibrate", b"{}")
        assert answer["touched"] == {}
        await clock.sleep(3.0)
        assert live.contact == {"left_hand": "OFF", "left_forearm": "OFF"}


@stepped
async def test_a_start_that_calibrates_in_a_grip_names_what_is_pressed(
    clock: SteppedClock, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with lives(clock, tmp_path) as live:
        await live.until(12.0)
        await live.end()
        await live.start(calibrate=True)
        assert "nothing has shown that this is over" in caplog.text
        assert "the skin was touched while it was calibrated" in caplog.text


@stepped
async def test_a_start_that_calibrates_keeps_what_is_known_of_a_board_that_is_dead(
    clock: SteppedClock, tmp_path: Path
) -> None:
    """As `skin calibrate` does: the board was not valid when it came back, until calibrated."""
    async with lives(clock, tmp_path) as live:
        await live.until(4.0)
        before = live.daemon.engine.calibration
        await live.end()
        mend = live.robot.inject(Fault(name="board_silent", board="forearm_outer"))
        await live.start(calibrate=True)
        found = live.daemon.engine.calibration
        assert before is not None
        assert found is not None
        dead = live.layout.taxels_of([list(live.settings.boards).index("forearm_outer")])
        assert found.id != before.id
        assert found.usable[dead].all()
        assert found.unchanged is not None
        assert np.array_equal(found.unchanged, dead)
        mend()
        await clock.sleep(12.0)
        record = live.daemon.records()["left_forearm"]
        assert record["valid_taxels"] == record["taxels"]
        assert live.contact["left_forearm"] == "OFF"


@stepped
async def test_a_calibration_without_a_daemon_names_what_was_pressed_when_one_ended(
    clock: SteppedClock, tmp_path: Path
) -> None:
    async with lives(clock, tmp_path) as live:
        await live.until(12.0)
        await live.end()
        touched = live.touched()
        parts = parts_of(live.layout, "main")
        found = await take_calibration(
            live.settings, live.layout, parts, 1.5, lambda _: None, clock, {"left_hand": touched}
        )
        named = outcome(found, live.layout, parts)["touched"]
        assert set(named["left_hand"]) >= set(touched)
        await live.start()
