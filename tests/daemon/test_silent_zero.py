"""A board that zeroes itself while its bus is away is recognised when the bus is back."""

from pathlib import Path

import pytest

from emulator.probes.scene import Fault, Scene
from skin_host.bus.port import LinkState
from skin_host.cli.common import load_skin
from skin_host.evaluation.simulate.world import Life, World
from tests.support.stack import ROOT

CONFIG = ROOT / "config" / "demo.toml"
#: Seconds of the outage before, with and after the fault.
THIRD_S = 1.0


def outage(seed: int, *, zeroes: bool) -> tuple[list[int], int, float]:
    """Take away the bus of a demo robot with noisy skin; return how often each of its boards was
    zeroed, how many touches were published afterwards, and what share of the first board's taxels
    is in use a second after the bus was back.
    """
    settings, layout = load_skin(CONFIG)
    world = World(settings, layout, CONFIG, seed, Scene(quiet=False))
    touches = 0

    def note(topic: str, _: bytes) -> None:
        nonlocal touches
        touches += topic.endswith("/touch")

    async def live() -> tuple[list[int], int, float]:
        nonlocal touches
        world.life = Life(world)
        world.life.start(lambda _: None)
        await world.clock.sleep(15.0)
        world.broker.listeners.append(note)
        board = layout.boards[0]
        engine = world.life.daemon.engine
        before = engine.ledger.rezeros.copy()
        touches = 0
        cable = world.cables[board.settings.bus]
        cable.set_state(LinkState.GONE)
        await world.clock.sleep(THIRD_S)
        if zeroes:
            world.move()
            mend = world.robot.inject(
                Fault(name="no_acknowledge", board=board.name, triangle=board.triangles[0])
            )
            await world.clock.sleep(THIRD_S)
            world.move()
            mend()
            await world.clock.sleep(THIRD_S)
        else:
            await world.clock.sleep(2.0 * THIRD_S)
        cable.set_state(LinkState.UP)
        await world.clock.sleep(1.0)
        veto = engine.intake.veto.get(engine.ledger.row[0])
        fitted = board.taxel_index >= 0
        valid = 1.0 if veto is None else float((~veto[fitted]).mean())
        await world.clock.sleep(9.0)
        found = (engine.ledger.rezeros - before).tolist()
        world.life.kill()
        return found, touches, valid

    with world.clock.runner() as runner:
        return runner.run(live())


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))


def test_a_board_that_zeroed_itself_unheard_feels_nothing_on_untouched_skin() -> None:
    rezeros, touches, _ = outage(3, zeroes=True)
    assert rezeros == [1, 0, 0]
    assert touches == 0


def test_boards_whose_bus_was_away_keep_their_zero() -> None:
    rezeros, touches, valid = outage(3, zeroes=False)
    assert rezeros == [0, 0, 0]
    assert touches == 0
    assert valid > 0.95
