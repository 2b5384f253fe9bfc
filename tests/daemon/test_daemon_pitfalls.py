"""The pitfalls of the boards' firmware are met by the daemon, not by its user."""

from pathlib import Path

import can
import numpy as np
import pytest

from emulator.probes.scene import Fault
from skin_host.bus.commands import Discover, command_frame
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus
from tests.support.live import CONFIG, Live, living
from tests.support.stepped import stepped

LATELY = frozenset({"board_reset", "board_rezeroed", "board_lost_set_up"})
NO_LOAD = 240


def changed(tmp_path: Path, old: str, new: str) -> Path:
    """The demo's configuration with something else in it."""
    text = CONFIG.read_text()
    assert old in text
    config = tmp_path / "changed.toml"
    config.write_text(text.replace(old, new))
    return config


def counted(live: Live) -> dict[str, tuple[int, int, int]]:
    """Of each board: how often it was set up, fell silent, and lost its set-up."""
    records = live.daemon.link.boards["can0"].records.values()
    ledger = live.daemon.engine.ledger
    return {
        one.layout.name: (
            one.configurations,
            int(ledger.silences[one.row]),
            int(ledger.lost_set_ups[one.row]),
        )
        for one in records
    }


@stepped
async def test_boards_of_the_mtb3_are_set_up_once_and_a_reset_one_is_found(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    """They fall silent after class 7, and lose commands that come close together."""
    config = changed(tmp_path, 'model = "mtb4"', 'model = "mtb3"')
    async with living(can_bus_settings, tmp_path, config=config, clock=clock) as live:
        await live.until_well(but=LATELY)
        assert set(counted(live).values()) == {(1, 0, 0)}
        live.robot.inject(Fault(name="board_reset", board="hand"))
        await live.wait(lambda: counted(live)["hand"][0] == 2)
        await live.until_well(but=LATELY)
        assert counted(live)["forearm_outer"] == counted(live)["forearm_inner"] == (1, 0, 0)


@stepped
async def test_an_mtb3_that_another_program_queries_is_set_up_and_was_not_reset(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    """A query stops it, such as that of `skin scan`, or one of ours that comes late."""
    config = changed(tmp_path, 'model = "mtb4"', 'model = "mtb3"')
    async with living(can_bus_settings, tmp_path, config=config, clock=clock) as live:
        await live.until_well(but=LATELY)
        bus = can.Bus(interface=can_bus_settings.interface, channel=can_bus_settings.channel)
        identifier, data = command_frame(Discover(), 14)
        bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        await live.wait(lambda: counted(live)["hand"][0] == 2)
        await live.until_well(but=LATELY)
        bus.shutdown()
        assert not live.daemon.engine.ledger.resets.any()


@stepped
async def test_an_mtb3_that_pauses_to_zero_itself_is_left_alone(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    """After five bad readings it sends nothing for four periods; a query would stop it."""
    config = changed(tmp_path, 'model = "mtb4"', 'model = "mtb3"')
    async with living(can_bus_settings, tmp_path, config=config, clock=clock) as live:
        await live.until_well(but=LATELY)
        for board in live.robot.boards.values():
            board.count_no_ack(5)
        told = set[str]()
        ledger = live.daemon.engine.ledger
        end = ledger.sweeps + 100
        longest_ms = 0.0

        def have_sent() -> bool:
            nonlocal longest_ms
            longest_ms = max(longest_ms, 1e-6 * (ledger.now_ns - ledger.received_ns).max())
            told.update(code for code, _ in live.faults())
            return bool((ledger.sweeps >= end).all())

        # More often than `live.wait` looks, so that the pause is seen near its end.
        for _ in range(1000):
            if have_sent():
                break
            await clock.sleep(0.02)
        assert have_sent()
        assert longest_ms > 190.0
        assert set(counted(live).values()) == {(1, 0, 0)}
        assert not told & {"bus_silent", "board_silent", "board_absent"}


@pytest.mark.parametrize("model", ["mtb3", "mtb4", "mtb4c"])
@stepped
async def test_a_zero_that_a_new_cdc_offset_would_spoil_is_taken_again(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, model: str
) -> None:
    """An MTB4 takes it before the first conversion with the new offset."""
    config = changed(tmp_path, 'kind = "palml"\n', 'kind = "palml"\ncdc_offset = 0x2000\n')
    config.write_text(config.read_text().replace('model = "mtb4"', f'model = "{model}"'))
    async with living(can_bus_settings, tmp_path, config=config, clock=clock) as live:
        await live.until_well(but=LATELY)
        raw = live.daemon.engine.pipeline is not None and live.daemon.health._watch.parts[0].raw
        assert isinstance(raw, np.ndarray)
        assert np.abs(raw.astype(int) - NO_LOAD).max() < 40
