"""A computer that is starved of time, and an adapter that stamps frames when they are read."""

import random
from pathlib import Path

import pytest

from emulator.probes.scene import Scene
from skin_host.bus.wire import FrameBatch
from skin_host.clock import SteppedClock
from skin_host.config.settings import load
from skin_host.evaluation.simulate.cables import SimulatedPort
from skin_host.evaluation.simulate.world import Life, World
from skin_host.health import FaultLog
from skin_host.layout import build_layout

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"
#: The first zero of the boards, the absent broker, and what this computer does itself.
OWN = {"board_rezeroed", "broker_away", "bus_drops", "host_stalls", "taxel_decides_late"}


class LateStamps(SimulatedPort):
    """As of a serial adapter: a frame has the time at which it was read."""

    stamps_late = True

    def read(self) -> FrameBatch:
        batch = super().read()
        now_ns = batch.t_ns * 0 + self._clock.now_ns()
        return FrameBatch(batch.id, batch.dlc, batch.data, now_ns)


@pytest.mark.parametrize(("runs_s", "pause_s"), [(0.02, 0.06), (0.02, 0.3), (1.0, 1.5)])
def test_a_starved_computer_accuses_no_board_and_no_bus(
    runs_s: float, pause_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    monkeypatch.setattr("skin_host.evaluation.simulate.world.SimulatedPort", LateStamps)
    settings = load(CONFIG)
    world = World(settings, build_layout(settings, CONFIG.parent), CONFIG, 1, Scene(quiet=True))
    chance = random.Random(1)
    said: set[tuple[str, str]] = set()

    async def starve() -> None:
        world.life = life = Life(world)
        life.start(lambda _: None)
        daemon, clock = life.daemon, world.clock
        while daemon.engine.calibration is None or daemon.engine.calibrating:
            await clock.sleep(0.1)
        await clock.sleep(2.0)
        end_s = clock.monotonic_s() + 10.0
        while clock.monotonic_s() < end_s:
            await clock.sleep(chance.expovariate(1 / runs_s))
            clock.advance(chance.expovariate(1 / pause_s))
            said.update(
                (fault["code"], fault["where"])
                for record in daemon.records().values()
                for fault in record["faults"]
            )
        assert not daemon.engine.ledger.silences.any()
        life.kill()

    with world.clock.runner() as runner:
        runner.run(starve())
    assert {code for code, _ in said} <= OWN, said


def test_a_fault_that_was_seen_twice_with_a_stall_between_has_not_lasted(
    caplog: pytest.LogCaptureFixture,
) -> None:
    faults, clock = FaultLog(), SteppedClock()
    seen = {("board_silent", "hand"): "board hand has stopped sending"}
    faults.note({}, clock.monotonic_s())
    faults.note(seen, clock.monotonic_s())
    clock.advance(8.7)
    faults.note(seen, clock.monotonic_s())
    assert not caplog.records
    for _ in range(25):
        clock.advance(0.1)
        faults.note(seen, clock.monotonic_s())
    assert len(caplog.records) == 1
