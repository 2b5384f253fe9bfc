"""Boards that reset, come late, stop or lose their set-up are set up again, alone."""

import asyncio
from pathlib import Path

import can
import numpy as np
import pytest

from emulator.probes.scene import Fault, Place, Probe
from skin_host.bus.commands import (
    Message,
    SetBoardConfig,
    SetTriangleConfig,
    SetTxMode,
    TxMode,
    command_frame,
)
from skin_host.bus.wire import FrameBatch
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus
from skin_host.daemon.state import Zeros, load_kept
from tests.support.live import CONFIG, living
from tests.support.stepped import stepped

#: Told for a while afterwards.
LATELY = frozenset({"board_reset", "board_rezeroed", "board_lost_set_up"})
#: More than a second of the demo's boards at 20 Hz.
FRAMES_BEHIND = 1500


@stepped
async def test_a_board_that_resets_is_set_up_again_and_the_others_notice_nothing(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well(but=LATELY)
        known = live.daemon.engine.calibration
        live.robot.inject(Fault(name="board_reset", board="hand"))
        told = await live.until("board_reset")
        assert ("board_reset", "hand") in told
        await live.until_well(but=LATELY)
        records = live.daemon.link.boards["can0"].records
        assert {address: record.configurations for address, record in records.items()} == {
            14: 2,
            13: 1,
            12: 1,
        }
        assert live.daemon.engine.calibration is known
        rezeros = live.daemon.engine.ledger.rezeros
        assert rezeros[0] == rezeros[1] + 1


@stepped
@pytest.mark.parametrize("after_s", [0.02 * step for step in range(13)])
async def test_a_board_that_resets_while_it_is_set_up_is_set_up_again(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, after_s: float
) -> None:
    """Its last commands came after that: it sent at half of the scale, and nobody noticed."""
    config = CONFIG.with_name("icub_hand.toml")
    async with living(can_bus_settings, tmp_path, config=config, clock=clock) as live:
        await live.until_well(but=LATELY)
        board = live.robot.boards["left_hand"]
        before = board.shift.copy(), board.no_load
        setting_up = asyncio.create_task(live.daemon.configure([0]))
        await clock.sleep(after_s)
        board.reset(live.robot.t_ns)
        await setting_up
        await clock.sleep(2.0)
        await live.until_well(but=LATELY)
        assert np.array_equal(board.shift, before[0])
        assert board.no_load == before[1]


@stepped
async def test_a_board_that_comes_back_is_found(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well(but=LATELY)
        live.robot.inject(Fault(name="board_silent", board="hand"))
        told = await live.until("board_silent")
        assert ("board_silent", "hand") in told
        live.robot.hung.clear()
        await live.until_well(but=LATELY)


@stepped
async def test_what_was_touched_at_a_new_zero_is_in_doubt_until_calibrated(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well(but=LATELY)
        engine = live.daemon.engine
        part = engine.layout.part("left_hand")
        touched = engine.zeros._touched[part.start : part.stop]
        probe = live.robot.touch(
            Probe(part="left_hand", at=Place(taxel=3), diameter_mm=4, force_n=[(0, 1)])
        )
        probe.press(2.0)
        await live.wait(lambda: bool(touched[3]))
        await live.daemon.configure([0])
        await live.until("board_in_doubt")

        def only_the_touched() -> bool:
            return live.daemon.records()["left_hand"]["invalid"] == [3]

        await live.wait(only_the_touched)
        # What was zero under a press lies beyond the scale without it: the board takes zero again.
        probe.lift()
        await live.daemon.configure([0])
        await live.wait(only_the_touched)
        await live.daemon.calibrate(1.0, [0])
        await live.until_well(but=LATELY)


@stepped
async def test_a_board_that_is_set_up_by_command_is_not_called_silent_meanwhile(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well(but=LATELY)
        record = live.daemon.link.boards["can0"].records[14]
        ledger = live.daemon.engine.ledger
        for number in range(2, 5):
            await live.daemon.configure([0])
            assert record.configurations == number
            assert not ledger.silences.any() and not ledger.resets.any()
        await live.until_well(but=LATELY)
        assert record.configurations == 4
        assert not ledger.silences.any() and not ledger.resets.any()


@stepped
async def test_one_board_is_calibrated_and_the_others_keep_theirs(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well(but=LATELY)
        engine = live.daemon.engine
        before = engine.calibration
        assert before is not None
        await live.daemon.calibrate(1.0, [0])
        after = engine.calibration
        assert after is not None
        hand = engine.layout.taxels_of([0])
        assert np.array_equal(after.baseline[~hand], before.baseline[~hand])
        assert not np.array_equal(after.baseline[hand], before.baseline[hand])


@stepped
async def test_zeros_of_boards_that_are_not_calibrated_are_kept_for_the_next_start(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well(but=LATELY)
        daemon = live.daemon
        await daemon.configure([1])
        await clock.sleep(3.0)
        # What lies on the hand from now on is in its new zero.
        weight = Probe(part="left_hand", at=Place(taxel=3), diameter_mm=4, force_n=[(0, 1)])
        live.robot.touch(weight).press(2.0)
        await clock.sleep(1.0)
        await daemon.calibrate(1.0, [0])
        await clock.sleep(2.0)
        kept = load_kept(tmp_path / "demo-main.zeros.json", Zeros)
        calibration, pipeline = daemon.engine.calibration, daemon.engine.pipeline
        assert calibration is not None
        assert pipeline is not None
        assert kept.calibration == calibration.id
        for name in ("left_forearm", "left_hand"):
            part = daemon.layout.part(name)
            used = pipeline.baseline[part.start : part.stop]
            assert np.abs(np.array(kept.baselines[name]) - used).max() < 0.5


@stepped
async def test_a_dead_bus_floods_no_log(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well(but=LATELY)
        await clock.sleep(0.3)
        caplog.clear()
        live.robot.inject(Fault(name="bus_off", bus="can0"))
        await live.until("bus_silent")
        await clock.sleep(4.0)
        assert live.faults() == {("bus_silent", "can0"), ("broker_away", "broker")}
        lines = [record for record in caplog.records if record.levelname != "DEBUG"]
        assert len(lines) <= 1, [record.getMessage() for record in lines]


@stepped
async def test_a_daemon_that_was_held_up_takes_no_board_for_silent(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well(but=LATELY)
        records = live.daemon.link.boards["can0"].records.values()
        silences = live.daemon.engine.ledger.silences
        before = [record.configurations for record in records], silences.tolist()
        # Nothing in this process runs, the emulated robot included.
        clock.advance(1.0)
        await clock.sleep(0.5)
        assert ([record.configurations for record in records], silences.tolist()) == before


@stepped
async def test_a_board_that_paused_keeps_its_zero(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well(but=LATELY)
        record = live.daemon.link.boards["can0"].records[14]
        ledger = live.daemon.engine.ledger
        zeroes = ledger.rezeros.tolist()
        bus = can.Bus(interface=can_bus_settings.interface, channel=can_bus_settings.channel)
        # Somebody else tells the board to stop; it is not reset and stays as it was set up.
        identifier, data = command_frame(SetTxMode(TxMode.STOP), 14)
        bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        await live.wait(lambda: bool(ledger.silences[record.row]))
        await live.until_well(but=LATELY)
        bus.shutdown()
        assert record.configurations == 1
        assert ledger.rezeros.tolist() == zeroes


@stepped
async def test_a_robot_that_starts_after_its_daemon_is_set_up_whole(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, robot_late_s=0.7, clock=clock) as live:
        await live.until_well(but=LATELY)
        records = live.daemon.link.boards["can0"].records.values()
        assert all(record.configurations == 1 for record in records)
        assert not live.daemon.engine.ledger.resets.any()
        assert not any(live.daemon.engine.zeros.in_doubt(record.index).any() for record in records)


@stepped
async def test_while_the_daemon_is_behind_no_board_is_set_up(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    """What it reads then is old, and may have lost its end to the kernel."""
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well(but=LATELY)
        link = live.daemon.link
        record = link.boards["can0"].records[14]
        port = link.ports["can0"]
        usual = port.read, port.capacity
        waiting: list[tuple[int, bytes, int]] = []

        def read_too_late() -> FrameBatch:
            batch = usual[0]()
            rows = zip(batch.id, batch.dlc, batch.data, batch.t_ns, strict=True)
            waiting.extend((int(i), bytes(data[:n]), int(t_ns)) for i, n, data, t_ns in rows)
            # There is always more to come: if nothing is old enough, a frame of somebody else's.
            oldest_ns = waiting[0][2] if waiting else clock.now_ns()
            old = len(waiting) > FRAMES_BEHIND
            return FrameBatch.of([waiting.pop(0) if old else (0x100, b"", oldest_ns)])

        port.read, port.capacity = read_too_late, 1  # type: ignore[method-assign]
        bus = can.Bus(interface=can_bus_settings.interface, channel=can_bus_settings.channel)
        none = SetTriangleConfig(0, 15, 2, flags=0, cdc_offset=0x2200)
        for command in (none, SetTxMode(TxMode.START)):
            identifier, data = command_frame(command, 14)
            bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        await clock.sleep(3.0)
        assert len(waiting) >= FRAMES_BEHIND
        assert record.configurations == 1
        assert not live.daemon.engine.ledger.lost_set_ups.any()
        port.read, port.capacity = usual  # type: ignore[method-assign]
        await live.wait(lambda: record.configurations == 2)
        bus.shutdown()


@stepped
async def test_a_board_that_somebody_else_sets_up_otherwise_gets_its_own_set_up_back(
    clock: SteppedClock,
    can_bus_settings: Bus,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """One at another period, one without a triangle."""
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well(but=LATELY)
        records = live.daemon.link.boards["can0"].records
        period, triangle = records[14], records[13]
        bus = can.Bus(interface=can_bus_settings.interface, channel=can_bus_settings.channel)

        def command(address: int, *commands: Message) -> None:
            for identifier, data in (command_frame(one, address) for one in commands):
                bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

        command(14, SetBoardConfig(0, 100, 240), SetTriangleConfig(0, 15), SetTxMode(TxMode.START))
        command(13, SetTriangleConfig(2, 2, flags=0))
        await live.wait(lambda: period.configurations == triangle.configurations == 2)
        bus.shutdown()
        here = "bus can0: board"
        # Its period is not known as soon.
        assert f"{here} hand was set up otherwise by another program: setting it up" in caplog.text
        assert f"{here} {triangle.layout.name} does not send all of its triangles" in caplog.text
        lost = live.daemon.engine.ledger.lost_set_ups
        assert lost[period.row] == lost[triangle.row] == 1
        assert records[12].configurations == 1
