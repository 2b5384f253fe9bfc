"""Bugs that seeds of `skin simulate` found, each as a claim."""

import asyncio
import json
import random
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.boards.mtb4 import NO_ACKS_TO_CALIBRATE
from emulator.probes.scene import Fault, Place, Probe, Scene
from skin_host.bus.port import LinkState
from skin_host.bus.wire import HEADER_A, HEADER_B, FrameBatch
from skin_host.cli.common import load_skin
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus
from skin_host.daemon.calibrate import calibration_path, stored_calibration
from skin_host.daemon.daemon import Daemon
from skin_host.demo import configuration
from skin_host.evaluation.simulate.accusations import STARTED_NS
from skin_host.evaluation.simulate.cables import Cable, Sent, SimulatedPort
from skin_host.evaluation.simulate.calm import Calm
from skin_host.evaluation.simulate.deeds import Deeds
from skin_host.evaluation.simulate.disk import PowerCut
from skin_host.evaluation.simulate.exercises import LONGEST_DRILL_S
from skin_host.evaluation.simulate.promises import Promises
from skin_host.evaluation.simulate.run import _Run
from skin_host.evaluation.simulate.storm import Storm
from skin_host.evaluation.simulate.trace import Trace
from skin_host.evaluation.simulate.troubles.acts import act
from skin_host.evaluation.simulate.troubles.catalogue import KINDS
from skin_host.evaluation.simulate.troubles.trouble import Trouble
from skin_host.evaluation.simulate.world import Life, World
from skin_host.fingertip.events import FingertipEvent
from skin_host.layout import PadKind
from skin_host.mqtt.commands import Result, decode_result
from skin_host.processing.calibration.file import save_calibration
from skin_host.processing.events import Touch

DEMO = configuration("demo.toml")


def world_of(config: Path, seed: int = 1, *, quiet: bool = True) -> World:
    """The whole system of a configuration; its state directory is the environment's."""
    settings, layout = load_skin(config)
    return World(settings, layout, config, seed, Scene(quiet=quiet))


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    yield world_of(DEMO)


@pytest.fixture
def worn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> World:
    """Ten boards on one bus, with noise as on real skin: a start takes seconds to set them up."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    return world_of(DEMO.with_name("kaspar.toml"), 2, quiet=False)


def start(world: World) -> Life:
    world.life = Life(world)
    world.life.start(lambda _: None)
    return world.life


def start_watched(world: World) -> tuple[Promises, Life]:
    promises = Promises(world)
    life = world.life = Life(world)
    life.start(promises.watch)
    return promises, life


async def sampled(promises: Promises, seconds: float) -> None:
    """Let time pass, and compare with the truth as a run does."""
    for _ in range(round(seconds / 0.05)):
        await promises._world.clock.sleep(0.05)
        promises.sample()


def test_a_daemon_that_died_in_a_touch_does_not_call_it_untouched_when_it_is_back(
    world: World,
) -> None:
    """Its boards go on sending; the zero that they take at the next start takes in what presses."""

    async def live() -> bytes:
        life = start(world)
        await world.clock.sleep(8.0)
        spot = world.spots[0]
        pressing = asyncio.create_task(spot.press(8.0))
        await world.clock.sleep(2.0)
        life.kill()
        await world.clock.sleep(0.5)
        life = start(world)
        await world.clock.sleep(4.0)
        assert not pressing.done()
        topic = life.daemon.publisher.topics.part("contact", spot.part)
        state = world.broker.retained[topic]
        board_doubts = [
            life.daemon.engine.zeros.in_doubt(board).sum() for board in life.daemon.engine.boards
        ]
        assert sum(board_doubts) > 0
        life.kill()
        return state

    with world.clock.runner() as runner:
        assert runner.run(live()) == b"UNKNOWN"


async def press_through(world: World, *, whole: bool) -> tuple[Life, str]:
    """Press, end the daemon meanwhile, start it again; return the new one, and the part pressed."""
    life = start(world)
    await world.clock.sleep(8.0)
    spot = world.spots[0]
    pressing = asyncio.create_task(spot.press(12.0), name="press")
    await world.clock.sleep(2.0)
    if whole:
        await world.end()
    else:
        life.kill()
    await world.clock.sleep(0.5)
    life = start(world)
    await world.clock.sleep(5.0)
    assert not pressing.done()
    return life, spot.part


def test_a_daemon_that_was_asked_to_end_in_a_touch_does_not_zero_it_away(world: World) -> None:
    """The boards stop with it, and take what still presses into the zero of their next set-up."""

    async def live() -> None:
        life, part = await press_through(world, whole=True)
        topic = life.daemon.publisher.topics.part("contact", part)
        assert world.broker.retained[topic] == b"UNKNOWN"
        record = life.daemon.records()[part]
        assert "board_in_doubt" in {fault["code"] for fault in record["faults"]}
        # It stays so over a third start, and until the skin is calibrated at rest.
        await world.clock.sleep(8.0)
        life.kill()
        life = start(world)
        await world.clock.sleep(5.0)
        assert sum(life.daemon.engine.zeros.in_doubt(i).sum() for i in life.daemon.engine.boards)
        await life.daemon.calibrate(2.0)
        await world.clock.sleep(3.0)
        assert world.broker.retained[topic] == b"OFF"
        await world.end()
        life = start(world)
        await world.clock.sleep(5.0)
        assert world.broker.retained[topic] == b"OFF"
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


def test_what_pressed_as_the_daemon_started_is_in_doubt_when_it_lifts_and_no_broken_pad(
    world: World,
) -> None:
    """Nobody felt it begin, so its board took it for zero; then it reads far below zero."""

    async def live() -> None:
        life = start(world)
        await world.clock.sleep(8.0)
        await world.end()
        spot = world.spots[0]
        pressing = asyncio.create_task(spot.press(6.0))
        await world.clock.sleep(0.5)
        life = start(world)
        accused = set()
        while not pressing.done():
            await world.clock.sleep(0.5)
        for _ in range(20):
            await world.clock.sleep(0.1)
            faults = life.daemon.records()[spot.part]["faults"]
            accused |= {fault["code"] for fault in faults}
        assert "board_in_doubt" in accused
        assert not accused & {"taxel_out_of_range", "triangle_out_of_range", "taxel_unproven"}
        # It is not believed when it is pressed as it was, nor after it is set up again.
        doubted = np.flatnonzero(life.daemon.engine.zeros.at_risk(touched=False))
        assert len(doubted)
        pressing = asyncio.create_task(spot.press(3.0))
        await world.clock.sleep(2.0)
        start_of_part = world.layout.part(spot.part).start
        invalid = life.daemon.records()[spot.part]["invalid"]
        assert set(doubted - start_of_part) <= set(invalid)
        await pressing
        await life.daemon.configure()
        await life.daemon.calibrate(2.0)
        await world.clock.sleep(3.0)
        record = life.daemon.records()[spot.part]
        assert record["invalid"] == []
        assert "board_in_doubt" not in {fault["code"] for fault in record["faults"]}
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


@pytest.mark.parametrize("kpa", [30.0, 40.0])
def test_a_pad_at_the_end_of_its_scale_after_a_press_that_nobody_felt_begin_is_not_valid(
    world: World, kpa: float
) -> None:
    """Boards mark a pad only at twice their range; the others seem to be untouched for ever."""

    async def live() -> None:
        life = start(world)
        await world.clock.sleep(8.0)
        await world.end()
        spot = world.spots[0]
        pressing = asyncio.create_task(spot.press(6.0, kpa))
        await world.clock.sleep(0.5)
        life = start(world)
        await pressing
        await world.clock.sleep(1.5)
        at_end = set(life.daemon.records()[spot.part]["beyond_range"])
        assert at_end
        await world.clock.sleep(6.0)
        record = life.daemon.records()[spot.part]
        assert record["beyond_range"] == []
        assert at_end <= set(record["invalid"])
        assert "board_in_doubt" in {fault["code"] for fault in record["faults"]}
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


def test_a_pad_that_is_stuck_is_never_valid_after_a_crash(world: World) -> None:
    """It takes as long to be found stuck as before; its daemon knows it."""

    async def live() -> None:
        life = start(world)
        await world.clock.sleep(8.0)
        part = world.layout.part(world.spots[0].part)
        triangle = next(one for one in world.layout.triangles if one.first == part.start)
        board = world.layout.boards[triangle.board].name
        stuck = Fault(name="stuck_taxel", board=board, triangle=triangle.number, taxel=0)
        mend = world.robot.inject(stuck)
        invalid: list[int] = []
        for _ in range(300):
            await world.clock.sleep(1.0)
            invalid = life.daemon.records()[part.name]["invalid"]
            if invalid:
                break
        assert invalid == [0]
        await world.clock.sleep(1.0)
        life.kill()
        life = start(world)
        records = []
        for _ in range(40):
            await world.clock.sleep(0.1)
            records.append(life.daemon.records()[part.name])
        assert all(0 in record["invalid"] for record in records if record["frames"])
        assert records[-1]["invalid"] == [0]
        assert records[-1]["taxel_faults"] == {"stuck": [0]}
        mend()
        await world.clock.sleep(20.0)
        assert life.daemon.records()[part.name]["invalid"] == []
        life.kill()
        life = start(world)
        await world.clock.sleep(6.0)
        assert life.daemon.records()[part.name]["invalid"] == []
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


def test_a_press_that_begins_while_a_zero_is_observed_is_felt_when_it_comes_again(
    world: World,
) -> None:
    """`fingertips.toml` 18, `gripper.toml` 16: half of it became the zero, and it read 0 kPa."""

    async def live() -> None:
        life = start(world)
        await world.clock.sleep(8.0)
        spot, engine = world.spots[0], life.daemon.engine
        topic = life.daemon.publisher.topics.part("contact", spot.part)
        before = engine.zeros.found
        await life.daemon.configure()
        while not all(rezero.begun for rezero in engine.zeros.rezeros.values()):
            await world.clock.sleep(0.01)
        await world.clock.sleep(0.5)
        assert engine.zeros.found == before
        pressing = asyncio.create_task(spot.press(3.0, 60.0))
        await world.clock.sleep(2.5)
        assert engine.zeros.found > before
        assert world.broker.retained[topic] == b"UNKNOWN"
        await pressing
        while engine.zeros.may_be_touched().any():
            await world.clock.sleep(0.1)
        await world.clock.sleep(3.0)
        assert world.broker.retained[topic] == b"OFF"
        pressing = asyncio.create_task(spot.press(3.0, 60.0))
        await world.clock.sleep(2.5)
        assert world.broker.retained[topic] == b"ON"
        await pressing
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


@pytest.mark.parametrize("refused", [False, True])
def test_doubts_that_the_disk_refused_are_lost_with_a_daemon_that_was_asked_to_end(
    world: World, refused: bool
) -> None:
    """`fingertips.toml` 18: after the next start nobody knows what pressed before it."""

    async def live() -> None:
        promises, _ = start_watched(world)
        await world.clock.sleep(8.0)
        life, spot = world.life, world.spots[0]
        assert life is not None
        pressing = asyncio.create_task(spot.press(8.0, 60.0))
        await world.clock.sleep(2.0)
        if refused:
            KINDS["disk_read_only"](world, random.Random(1), False)
        await world.end()
        promises.over(life)
        part = world.layout.part(spot.part)
        assert promises.excuses.exempt[part.start : part.stop].any() == refused
        await pressing

    with world.clock.runner() as runner:
        runner.run(live())


def test_a_slow_disk_does_not_make_touches_last_when_the_daemon_ends(world: World) -> None:
    """It reads nothing any more, so what it retained would be stale until the disk is done."""

    async def live() -> bytes:
        life = start(world)
        await world.clock.sleep(8.0)
        spot = world.spots[0]
        topic = life.daemon.publisher.topics.part("contact", spot.part)
        pressing = asyncio.create_task(spot.press(8.0))
        await world.clock.sleep(2.0)
        assert world.broker.retained[topic] == b"ON"
        world.clock.threads_take_s = 3.0
        ending = asyncio.create_task(world.end())
        await world.clock.sleep(0.5)
        assert not ending.done()
        state = world.broker.retained[topic]
        await asyncio.gather(ending, pressing)
        return state

    with world.clock.runner() as runner:
        assert runner.run(live()) == b"UNKNOWN"


def test_events_that_wait_for_a_slow_disk_before_the_broker_are_lost_with_a_cause(
    world: World,
) -> None:
    """`small.toml` 9032, `--hours 1`: the daemon started on a slow disk, and noise made touches."""

    async def live() -> None:
        promises = Promises(world)
        trouble = KINDS["disk_slow"](world, random.Random(1), True)
        world.clock.threads_take_s = 3.0
        life = start(world)
        await world.clock.sleep(2.9)
        assert not life.daemon.publisher.counters.connected
        await world.clock.sleep(0.2)
        assert life.daemon.publisher.counters.connected
        assert not promises.accusations._has_cause("touches_dropped", "broker")
        promises.begin(trouble)
        assert promises.accusations._has_cause("touches_dropped", "broker")
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


def test_nothing_is_felt_by_boards_that_are_set_up_while_the_daemon_ends(world: World) -> None:
    """`gripper.toml` 9071: a board's set-up reads its bus first, and a touch began without an end,
    while a slow disk kept the daemon from ending.
    """

    async def live() -> None:
        promises, life = start_watched(world)
        await world.clock.sleep(8.0)
        world.clock.threads_take_s = 3.0
        ending = asyncio.create_task(world.end())
        await world.clock.sleep(0.5)
        pressing = asyncio.create_task(world.spots[0].press(2.0))
        await world.clock.sleep(1.0)
        assert not ending.done()
        await life.daemon.link.set_up(life.daemon.engine.boards)
        await asyncio.gather(ending, pressing)
        assert promises._skin.endless() is None

    with world.clock.runner() as runner:
        runner.run(live())


@pytest.mark.parametrize("asked_after_s", [-0.1, 0.5])
def test_a_command_that_comes_while_the_daemon_ends_is_refused_and_starts_no_board_again(
    world: World, asked_after_s: float
) -> None:
    """It would go on sending. One that runs when the daemon is asked to end is ended with it."""

    async def live() -> None:
        life = start(world)
        await world.clock.sleep(8.0)
        topics = life.daemon.publisher.topics
        reply_to = topics.reply("main", "operator")
        answers: list[Result] = []

        def note(topic: str, payload: bytes) -> None:
            if topic == reply_to:
                answers.append(decode_result(payload))

        world.broker.listeners.append(note)

        def ask() -> None:
            world.broker.request(topics.command("main", "configure"), b"{}", reply_to, b"1")

        world.clock.threads_take_s = 3.0
        if asked_after_s < 0.0:
            ask()
            await world.clock.sleep(-asked_after_s)
        ending = asyncio.create_task(world.end())
        if asked_after_s > 0.0:
            await world.clock.sleep(asked_after_s)
            assert not ending.done()
            ask()
        await ending
        assert [(answer.ok, "the daemon is ending" in str(answer.error)) for answer in answers] == [
            (False, True)
        ]
        sent = [dict(cable.sent.bursts) for cable in world.cables.values()]
        await world.clock.sleep(1.0)
        world.move()
        assert [dict(cable.sent.bursts) for cable in world.cables.values()] == sent

    with world.clock.runner() as runner:
        runner.run(live())


@pytest.mark.parametrize("power", [True, False])
def test_a_daemon_that_dies_while_it_is_asked_to_end_has_not_ended_the_run(
    world: World, tmp_path: Path, power: bool
) -> None:
    """`icub_hand.toml` 9054: it was about to write, and the rest of the hour did not pass."""

    async def live() -> None:
        promises = Promises(world)
        deeds = Deeds(world, promises, tmp_path)
        life = start(world)
        await world.clock.sleep(8.0)
        stopping = asyncio.create_task(deeds.stop())
        await world.clock.sleep(0.001)
        assert not life.task.done()
        deeds.kill(power=power)
        await stopping
        assert promises.broken is None
        assert world.life is None
        assert life.dead

    with world.clock.runner() as runner:
        runner.run(live())


def test_a_run_that_ends_before_its_time_has_not_kept_its_promises(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def end(_: object) -> None:
        raise PowerCut

    monkeypatch.setattr(Storm, "rage", end)
    with pytest.raises(PowerCut), world.clock.runner() as runner:
        runner.run(_Run(world, tmp_path, 2, 60.0, None).live())


@pytest.mark.parametrize(
    ("stalls_s", "some_dropped"),
    [((0.5,), False), ((4.0,), True), ((4.0, 4.0), True), ((0.3, 4.0), True), ((4.0, 0.3), True)],
)
def test_a_daemon_that_is_asked_to_end_right_after_stalls_counts_what_was_sent_in_them(
    world: World, stalls_s: tuple[float, ...], some_dropped: bool
) -> None:
    """It waits in the socket, or was dropped there, which the boards' next sweeps show."""

    async def live() -> None:
        life = start(world)
        await world.clock.sleep(8.0)
        for stall_s in stalls_s:
            # Between two the daemon has a moment, not enough to read all.
            await world.clock.sleep(0.001)
            world.clock.advance(stall_s)
        await world.end()
        assert life.sent_before_end is not None
        for bus, sent in life.sent_before_end.items():
            counters = life.daemon.engine.assemblers[bus].counters
            under_way = len(sent)
            assert counters.sweeps + counters.missed >= sum(sent.values()) - under_way
            port = life.daemon.link.ports[bus]
            assert (port.counters.dropped > 0) == some_dropped

    with world.clock.runner() as runner:
        runner.run(live())


@pytest.mark.parametrize("number", range(2))
def test_a_board_that_restarts_in_a_press_does_not_zero_it_away(world: World, number: int) -> None:
    """It is silent before it is set up again; its touches have ended as lost by then."""

    async def live() -> None:
        life = start(world)
        await world.clock.sleep(8.0)
        spot = world.spots[number]
        pressing = asyncio.create_task(spot.press(8.0, 50.0), name="press")
        await world.clock.sleep(2.0)
        part = world.layout.part(spot.part)
        triangle = world.layout.triangles[int(world.layout.triangle_of[part.start + spot.taxel])]
        board = world.layout.boards[triangle.board].name
        world.move()
        world.robot.inject(Fault(name="board_reset", board=board))
        await world.clock.sleep(5.0)
        assert not pressing.done()
        assert life.daemon.engine.zeros.in_doubt(triangle.board).any()
        topic = life.daemon.publisher.topics.part("contact", spot.part)
        assert world.broker.retained[topic] == b"UNKNOWN"
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


@pytest.mark.parametrize("before", [True, False])
def test_a_press_that_began_while_a_chip_did_not_answer_is_in_the_zero_of_its_board(
    world: World, before: bool
) -> None:
    """What was felt before is in doubt instead; so is what is felt since the chip answers again,
    for half a second.
    """

    async def live() -> None:
        promises, life = start_watched(world)
        await sampled(promises, 12.0)
        spot = world.spots[0]
        part = world.layout.part(spot.part)
        triangle = world.layout.triangles[world.layout.triangle_of[part.start + spot.taxel]]
        name = world.layout.boards[triangle.board].name
        short = Fault(name="shorted_finger", board=name, triangle=triangle.number)
        pads = world.taxels((name, triangle.number))
        pads = pads[world.layout.pad_kind[pads] == PadKind.PRESSURE]
        if before:
            pressing = asyncio.create_task(spot.press(20.0, 50.0), name="press")
            await sampled(promises, 2.0)
        world.move()
        mend = world.robot.inject(short)
        await sampled(promises, 0.5)
        if not before:
            pressing = asyncio.create_task(spot.press(20.0, 50.0), name="press")
        await sampled(promises, 1.0)
        world.move()
        mend()
        await sampled(promises, 0.1)
        await life.daemon.configure()
        await sampled(promises, 4.0)
        pressed = pads[world.robot.skin.true_pressure_kpa()[pads] > 25.0]
        assert len(pressed)
        assert promises.excuses.exempt[pressed].all() != before
        pressing.cancel()
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


def test_a_press_just_before_a_zero_is_in_it_also_where_something_lay_on_the_pad(
    world: World,
) -> None:
    """`icub_hand.toml` 9052: half a kPa, which nobody felt."""

    async def live() -> None:
        promises, life = start_watched(world)
        await sampled(promises, 12.0)
        spot = world.spots[0]
        part = world.layout.part(spot.part)
        at = Place(taxel=spot.taxel)
        lies = Probe(kind="disc", part=spot.part, at=at, diameter_mm=8.0, force_n=[(0.0, 0.0)])
        world.move()
        world.robot.touch(lies).press(0.025)
        await sampled(promises, 5.0)
        pressing = asyncio.create_task(spot.press(20.0, 60.0), name="press")
        await world.clock.sleep(0.02)
        await life.daemon.configure()
        await sampled(promises, 4.0)
        pads = np.arange(part.start, part.stop)
        pressed = pads[world.robot.skin.true_pressure_kpa()[pads] > 25.0]
        assert len(pressed)
        assert promises.excuses.exempt[pressed].all()
        pressing.cancel()
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


@pytest.mark.parametrize("felt_kpa", [0.1, 100.0])
def test_a_press_that_noisy_pads_had_not_felt_is_in_the_zero_of_their_board(
    world: World, felt_kpa: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They detect it only if it is firmer, or lasts for longer than a second."""

    async def live() -> None:
        promises, life = start_watched(world)
        await world.clock.sleep(12.0)
        levels = np.full(world.layout.n_taxels, felt_kpa)
        monkeypatch.setattr(promises._truth, "felt_kpa", levels)
        promises.sample()
        pressing = asyncio.create_task(world.spots[0].press(8.0, 50.0), name="press")
        for _ in range(8):
            await world.clock.sleep(0.25)
            promises.sample()
        pressed = world.robot.skin.true_pressure_kpa() > 1.0
        assert pressed.any()
        assert not promises.excuses.exempt.any()
        await life.daemon.configure()
        promises.sample()
        assert promises.excuses.exempt[pressed].all() == (felt_kpa > 50.0)
        pressing.cancel()
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


def test_a_board_that_is_set_up_while_a_disabled_part_is_pressed_does_not_zero_that_away(
    world: World,
) -> None:
    """Nothing is published of a disabled part, and it is felt all the same."""

    async def live() -> None:
        life = start(world)
        await world.clock.sleep(8.0)
        spot = world.spots[0]
        index = [part.name for part in world.layout.parts].index(spot.part)
        part = world.layout.parts[index]
        life.daemon.disable(index)
        pipeline = life.daemon.engine.pipeline
        assert pipeline is not None
        number = pipeline.seq(index)
        pressing = asyncio.create_task(spot.press(9.0, 50.0), name="press")
        await world.clock.sleep(2.0)
        await life.daemon.configure()
        await world.clock.sleep(4.0)
        assert pipeline.seq(index) == number
        life.daemon.enable(index)
        await world.clock.sleep(1.0)
        assert not pressing.done()
        board = world.layout.triangles[int(world.layout.triangle_of[part.start + spot.taxel])].board
        assert life.daemon.engine.zeros.in_doubt(board).any()
        topic = life.daemon.publisher.topics.part("contact", spot.part)
        assert world.broker.retained[topic] == b"UNKNOWN"
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


def baselines(life: Life) -> NDArray[np.float64]:
    """Return a copy of the baselines [n] in use, in units."""
    pipeline = life.daemon.engine.pipeline
    assert pipeline is not None
    return pipeline.baseline.copy()


def test_a_daemon_that_starts_reports_no_touch_before_its_boards_are_zeroed(
    worn: World,
) -> None:
    """The daemon before it has zeroed them since the calibration; ten boards take seconds."""

    async def live() -> list[str]:
        life = start(worn)
        await worn.clock.sleep(10.0)
        await life.daemon.configure()
        await worn.clock.sleep(8.0)
        zeroed, calibrated = baselines(life), life.daemon.engine.calibration
        life.kill()
        await worn.clock.sleep(0.5)
        seen: list[str] = []

        def hear(topic: str, payload: bytes) -> None:
            if topic.endswith("/touch"):
                seen.append(topic)

        worn.broker.listeners.append(hear)
        life = start(worn)
        # Until they are set up again, boards send with the zero that the daemon before gave them.
        assert calibrated is not None
        assert np.abs(calibrated.baseline - zeroed).max() > 5.0
        assert np.abs(baselines(life) - zeroed).max() < 0.5
        await worn.clock.sleep(6.0)
        assert all(record["valid_taxels"] for record in life.daemon.records().values())
        life.kill()
        return seen

    with worn.clock.runner() as runner:
        assert runner.run(live()) == []


def test_a_calibration_of_one_board_keeps_the_zeros_of_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if the power fails before the calibration has its name, or right after."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    world = world_of(DEMO, quiet=False)

    async def live() -> None:
        life = start(world)
        await world.clock.sleep(8.0)
        await life.daemon.configure()
        await world.clock.sleep(8.0)
        first, *_ = life.daemon.engine.boards
        others = ~life.daemon.engine.layout.taxels_of([first])
        calibrated = life.daemon.engine.calibration
        assert calibrated is not None
        assert np.abs(calibrated.baseline - baselines(life))[others].max() > 2.0
        await life.daemon.calibrate(0.5, [first])
        zeroed = baselines(life)
        life.kill()
        path = calibration_path(world.settings, "main")
        for known in (life.daemon.engine.calibration, calibrated):
            assert known is not None
            save_calibration(path, known, world.layout)
            after = stored_calibration(world.settings, world.layout, "main")
            pipeline = Daemon(world.settings, world.layout, calibration=after).engine.pipeline
            assert pipeline is not None
            assert np.abs(pipeline.baseline - zeroed)[others].max() < 0.5

    with world.clock.runner() as runner:
        runner.run(live())


def test_pads_whose_noise_a_set_up_cuts_off_are_named_and_make_no_part_unknown(
    worn: World,
) -> None:
    """A board's zero is one reading: it leaves noisy pads near the end of the scale. Nothing
    presses, so no zero is in doubt.
    """

    async def live() -> None:
        life = start(worn)
        await worn.clock.sleep(10.0)
        await life.daemon.configure()
        await worn.clock.sleep(8.0)
        engine, topics = life.daemon.engine, life.daemon.publisher.topics
        assert engine.calibration is not None
        cut_off = engine.zeros.cut_off() & engine.calibration.usable
        assert cut_off.any()
        assert not (engine.zeros.at_risk(touched=False) & engine.calibration.usable).any()
        for part in worn.layout.parts:
            refused = np.flatnonzero(cut_off[part.start : part.stop])
            record = life.daemon.records()[part.name]
            assert set(refused) <= set(record["invalid"])
            codes = {fault["code"] for fault in record["faults"]}
            assert "board_in_doubt" not in codes
            assert "taxel_refused" in codes or not len(refused)
            assert worn.broker.retained[topics.part("contact", part.name)] == b"OFF"
        life.kill()

    with worn.clock.runner() as runner:
        runner.run(live())


def test_a_bus_that_comes_back_after_a_start_has_no_valid_taxel_before_its_boards_are_set_up(
    world: World,
) -> None:
    """Boards that were away when the daemon started may have zeroed themselves before."""

    async def live() -> None:
        life = start(world)
        await world.clock.sleep(8.0)
        life.kill()
        world.cables["can0"].set_state(LinkState.GONE)
        life = start(world)
        await world.clock.sleep(4.5)
        world.cables["can0"].set_state(LinkState.UP)
        boards = life.daemon.link.boards["can0"]
        came = 0
        while not all(record.configurations for record in boards.records.values()):
            await world.clock.sleep(0.02)
            came = int(life.daemon.engine.ledger.sweeps.max())
            valid = sum(one["valid_taxels"] for one in life.daemon.records().values())
            set_up = [one for one in boards.records.values() if one.configurations]
            taxels = [life.daemon.engine.layout.boards[one.index].taxel_index for one in set_up]
            assert valid <= sum(int(np.count_nonzero(board >= 0)) for board in taxels)
        assert came > 0
        await world.clock.sleep(4.0)
        assert all(record["valid_taxels"] for record in life.daemon.records().values())
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


def test_boards_of_a_bus_that_takes_no_frames_are_valid_with_the_zero_that_they_have(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An adapter that only listens: no daemon can set its boards up, and all of them send."""

    async def live() -> None:
        life = start(world)
        await world.clock.sleep(8.0)
        life.kill()
        monkeypatch.setattr(Cable, "send", lambda *_: False)
        life = start(world)
        await world.clock.sleep(10.0)
        assert all(record["valid_taxels"] for record in life.daemon.records().values())
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


def test_a_shorted_data_line_that_two_parts_share_is_named_by_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each has only two of the four triangles that stop answering."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    world = world_of(Path(__file__).with_name("small.toml"))

    async def live() -> None:
        life = start(world)
        await world.clock.sleep(8.0)
        world.move()
        world.robot.inject(Fault(name="shorted_finger", board="left", triangle=0))
        await world.clock.sleep(1.0)
        for record in life.daemon.records().values():
            codes = {fault["code"] for fault in record["faults"] if fault["where"] != "broker"}
            assert "line_shorted" in codes
            assert not {code for code in codes if code.startswith("triangle_")}
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


def test_a_short_whose_first_sweep_zeroes_its_board_may_be_named_by_what_follows(
    world: World,
) -> None:
    """It has counted four missing acknowledges, and the chip is the only one of its line."""

    async def live() -> str | None:
        promises, life = start_watched(world)
        await world.clock.sleep(STARTED_NS / 1e9 + 8.0)
        for board in world.robot.boards.values():
            board.no_acks = NO_ACKS_TO_CALIBRATE - 1
        short = KINDS["shorted_finger"](world, random.Random(4), True)
        assert short.about == "shorted_finger board=hand triangle=4"
        promises.begin(short)
        for _ in range(8):
            await world.clock.sleep(0.25)
            promises.sample()
        life.kill()
        return promises.broken

    with world.clock.runner() as runner:
        assert runner.run(live()) is None


def test_a_frame_whose_other_half_was_lost_just_before_the_end_is_accounted_for(
    world: World,
) -> None:
    """It is counted as lone when the next sweep begins, and none does."""

    async def live() -> str | None:
        promises, life = start_watched(world)
        await world.clock.sleep(6.0)
        for lost, seconds in ((0.3, 0.2), (1.0, 0.15)):
            for wire in world.cables.values():
                wire.mischief.lost = lost
            await world.clock.sleep(seconds)
        await world.end()
        assert any(
            state.lone
            for assembler in life.daemon.engine.assemblers.values()
            for state in assembler._states.values()
        )
        promises.broken = None  # health names losses that nobody noted
        promises.over(life)
        return promises.broken

    with world.clock.runner() as runner:
        assert runner.run(live()) is None


def test_what_waited_for_a_full_bus_is_of_before_a_chip_was_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`gripper.toml`, seed 9331: it passes when the node that filled the bus is quiet again.

    The computer slept meanwhile, so that its daemon awaits what the boards send next.
    """
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    world = world_of(DEMO.with_name("gripper.toml"))

    async def live() -> str | None:
        promises, life = start_watched(world)
        await sampled(promises, 8.0)
        babble = KINDS["babbling_node"](world, random.Random(1), True)
        promises.begin(babble)
        await sampled(promises, 0.1)
        promises.begin(KINDS["suspended"](world, random.Random(1), True))
        await sampled(promises, 0.1)
        promises.begin(KINDS["chip_gone"](world, random.Random(1), True))
        await sampled(promises, 1.05)
        babble.end()
        promises.end(babble)
        await sampled(promises, 0.5)
        life.kill()
        return promises.broken

    with world.clock.runner() as runner:
        assert runner.run(live()) is None


def test_what_is_retained_just_before_a_stall_is_at_the_broker_after_it(world: World) -> None:
    """It was on its way: seconds have passed when it arrives, and nobody was late."""

    async def live() -> str | None:
        promises, life = start_watched(world)
        await world.clock.sleep(8.0)
        promises.sample()
        promises.contacts()
        put_ns = max(put_ns for _, put_ns in promises.subscribers.wanted.values())
        while put_ns == max(put_ns for _, put_ns in promises.subscribers.wanted.values()):
            await world.clock.sleep(0.0005)
        stall = KINDS["stall"](world, random.Random(7), True)
        assert stall.about == "stall 4.72 s"
        promises.begin(stall)
        promises.contacts()
        await world.clock.sleep(3.0)
        promises.contacts()
        life.kill()
        return promises.broken

    with world.clock.runner() as runner:
        assert runner.run(live()) is None


def test_what_health_reports_for_a_minute_it_reports_for_longer_through_a_stall(
    world: World,
) -> None:
    """A set-up takes seconds, and the first record after a stall may be of what was read before."""
    accusations = Promises(world).accusations
    fault = {"code": "board_rezeroed", "where": world.layout.boards[0].name}
    record = {"faults": [fault], "sentences": ["board zeroed itself"]}
    accusations.begin(act("configure"))
    world.clock.advance(3.2 + 60.0 + 4.8)
    assert accusations.note("left_hand", record) is None
    accusations.restarted()
    world.clock.advance(12.0)
    assert "accused without a cause" in str(accusations.note("left_hand", record))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_was_damaged_and_waited_in_two_stalls_is_not_judged(world: World, seed: int) -> None:
    """The bus has damaged nothing for seconds when it is read."""

    async def live() -> str | None:
        promises, life = start_watched(world)
        await world.clock.sleep(8.0)
        chance = random.Random(seed)
        trouble = KINDS["frames_damaged"](world, chance, True)
        promises.begin(trouble)
        for over in (trouble.end, None):
            stall = KINDS["stall"](world, random.Random(7), True)
            assert stall.about == "stall 4.72 s"
            promises.begin(stall)
            if over is not None:
                over()
                promises.end(trouble)
        spoiled = promises.excuses.spoiled()
        assert trouble.spoils is not None
        assert spoiled[trouble.spoils].all()
        for _ in range(8):
            await world.clock.sleep(0.25)
            promises.sample()
        life.kill()
        return promises.broken

    with world.clock.runner() as runner:
        assert runner.run(live()) is None


def test_a_pause_between_two_presses_that_no_sample_saw_is_known(world: World) -> None:
    """The last frame before the bus went off may be of that pause."""

    async def live() -> str | None:
        promises, life = start_watched(world)
        await world.clock.sleep(8.0)
        spot = world.spots[0]
        first = asyncio.create_task(spot.press(2.0, 60.0))
        for _ in range(8):
            await world.clock.sleep(0.25)
            promises.sample()
        await first
        await world.clock.sleep(0.06)
        second = asyncio.create_task(spot.press(2.0, 60.0))
        await world.clock.sleep(0.0)
        promises.begin(KINDS["link_down"](world, random.Random(1), False))
        for _ in range(2):
            await world.clock.sleep(0.13)
            promises.sample()
        broken = promises.broken
        await second
        life.kill()
        return broken

    with world.clock.runner() as runner:
        assert runner.run(live()) is None


def test_halves_of_sweeps_that_a_full_bus_held_up_are_paired_though_one_was_lost() -> None:
    """Sweeps follow each other within a millisecond then; what is left of the first is one half."""
    sent = Sent()
    first, second = bytes([HEADER_A, *range(7)]), bytes([HEADER_B, *range(7, 12), 0, 0])
    left = bytes([HEADER_B, *[99] * 5, 0, 0])
    frames = [(0x411, data, number * 100_000) for number, data in enumerate((left, first, second))]
    sent.note(FrameBatch.of(frames))
    assert [answered for answered, _ in sent.find(1, 1, bytes(range(12)))] == [True]
    assert not list(sent.find(1, 1, bytes([*range(7), *[98] * 5])))


def test_the_rest_of_a_sweep_that_more_urgent_boards_hold_up_is_of_that_sweep() -> None:
    """`icub.toml`, seed 2: six boards between the two halves of the last triangle take 12.1 ms."""
    sent = Sent()
    urgent_ns = 12_100_000
    halves = bytes([HEADER_A, *range(7)]), bytes([HEADER_B, *range(7, 12), 0, 0])
    for begin_ns in (0, 50_000_000):
        frames = [
            (0x4E0 | number, half, begin_ns + number * 232_000 + at_ns)
            for number, pause_ns in ((0, 116_000), (1, urgent_ns))
            for half, at_ns in zip(halves, (0, pause_ns), strict=True)
        ]
        sent.note(FrameBatch.of(frames))
    for number in (0, 1):
        assert len(list(sent.find(14, number, bytes(range(12))))) == 2
    assert sent.bursts == {14: 2}


def cable_of(clock: SteppedClock, *, loses: bool = False) -> Cable:
    """A bus without a robot."""
    rng = np.random.default_rng(1)
    nothing, always = (lambda *_: None), (lambda: True)
    return Cable("can0", clock, nothing, nothing, always, lambda: loses, rng, Trace())


@pytest.mark.parametrize(
    ("twin", "loses", "lost", "babbles", "is_blurred"),
    [
        (1, False, 0.0, False, False),
        (1, True, 0.0, False, True),
        (1, False, 0.1, False, True),
        (1, False, 0.0, True, True),
        (None, True, 0.1, True, False),
    ],
)
def test_which_of_two_boards_sent_what_is_unknown_where_frames_are_lost_or_held_up(
    twin: int | None, loses: bool, lost: float, babbles: bool, is_blurred: bool
) -> None:
    """`gripper.toml` 9362, `icub_hand.toml` 9249: a triangle has a frame of each."""
    clock = SteppedClock(seed=1)
    cable = cable_of(clock, loses=loses)
    port = SimulatedPort(cable, Bus(interface="virtual", channel="two"), clock)
    cable.mischief.twin, cable.mischief.lost = twin, lost
    now_ns = clock.monotonic_ns()
    frames = [(0x411, bytes([header, *range(7)]), now_ns) for header in (HEADER_A, HEADER_B)]
    cable.arrive(FrameBatch.of([*frames, *[(0, bytes(8), now_ns)] * babbles]))
    assert (cable.blurred_ns == now_ns) == is_blurred
    port.close()


def test_a_frame_that_comes_late_is_stamped_when_it_came_not_when_it_was_read() -> None:
    """Read much later, it would stand between the halves of a sweep that came meanwhile."""
    clock = SteppedClock(seed=1)
    cable = cable_of(clock)
    port = SimulatedPort(cable, Bus(interface="virtual", channel="late"), clock)
    cable.mischief.late = 1.0
    began_ns = clock.monotonic_ns()
    cable.arrive(FrameBatch.of([(0x411, bytes([HEADER_B, *range(7)]), began_ns)]))
    cable.mischief.late = 0.0
    assert not len(port.read())
    clock.advance(0.025)
    after = bytes([HEADER_A, *range(7)])
    cable.arrive(FrameBatch.of([(0x411, after, began_ns + 20_000_000)]))
    batch = port.read()
    since_ns = batch.t_ns - (clock.now_ns() - clock.monotonic_ns()) - began_ns
    assert since_ns.tolist() == [cable.mischief.late_ns, 20_000_000]
    assert batch.data[:, 0].tolist() == [HEADER_B, HEADER_A]


def test_frames_of_different_sweeps_do_not_change_places() -> None:
    """Sweeps that wait together after a stall came 50 ms apart."""
    clock = SteppedClock(seed=1)
    cable = cable_of(clock)
    port = SimulatedPort(cable, Bus(interface="virtual", channel="stall"), clock)
    cable.mischief.swapped = 1.0
    frames = [
        (0x411, bytes([header, *[sweep] * 7]), sweep * 50_000_000 + at_ns)
        for sweep in range(8)
        for header, at_ns in ((HEADER_A, 0), (HEADER_B, 116_000))
    ]
    cable.arrive(FrameBatch.of(frames))
    batch = port.read()
    assert batch.data[:, 0].tolist() == [HEADER_B, HEADER_A] * 8
    since_ns = batch.t_ns - (clock.now_ns() - clock.monotonic_ns())
    assert (since_ns // 50_000_000).tolist() == batch.data[:, 1].tolist()


def test_a_press_that_lifted_while_its_bus_was_off_is_no_touch_when_it_is_back(
    world: World,
) -> None:
    """What is touched stayed so until a measurement denied it, and none came meanwhile."""

    async def live() -> list[str]:
        life = start(world)
        await world.clock.sleep(8.0)
        spot = world.spots[0]
        triangle = int(world.layout.triangle_of[world.layout.part(spot.part).start + spot.taxel])
        board = world.layout.boards[world.layout.triangles[triangle].board]
        seen: list[str] = []
        put_touch = life.daemon.publisher.put_touch

        def look(event: FingertipEvent) -> None:
            assert isinstance(event, Touch)
            if event.event != "move":
                seen.append(event.event)
            put_touch(event)

        life.daemon.publisher.put_touch = look  # type: ignore[method-assign]
        pressing = asyncio.create_task(spot.press(3.0))
        await world.clock.sleep(2.0)
        world.move()
        mend = world.robot.inject(Fault(name="bus_off", bus=board.settings.bus))
        await pressing
        await world.clock.sleep(2.0)
        world.move()
        mend()
        await world.clock.sleep(3.0)
        life.kill()
        return seen

    with world.clock.runner() as runner:
        assert runner.run(live()) == ["begin", "end"]


def test_a_noisy_temperature_pad_spoils_its_triangle_and_another_pad_itself(world: World) -> None:
    """`icub.toml`, seed 5: its board takes what it reads off all others."""
    kinds = world.layout.pad_kind
    seen = set()
    for seed in range(60):
        trouble = KINDS["noisy_taxel"](world, random.Random(seed), False)
        trouble.end()
        assert trouble.spoils is not None
        warms = bool((kinds[trouble.spoils] == PadKind.THERMAL).any())
        assert np.count_nonzero(trouble.spoils) == (12 if warms else 1)
        seen.add(warms)
    assert seen == {False, True}


@pytest.mark.parametrize(
    ("robot", "warmer", "named"),
    [("gripper.toml", True, False), ("gripper.toml", False, True), ("demo.toml", True, True)],
)
def test_a_step_of_temperature_must_be_named_where_it_cannot_be_an_even_load(
    robot: str, warmer: bool, named: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`gripper.toml`, seed 21: all pads of two fingertips read as touched with 10 kPa."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    world = world_of(DEMO.with_name(robot))

    async def live() -> None:
        life = start(world)
        await world.clock.sleep(8.0)
        await life.daemon.calibrate(5.0)
        await world.clock.sleep(5.0)
        trouble = next(
            trouble for trouble in strong_steps(world) if ("value=-" in trouble.about) != warmer
        )
        codes: set[str] = set()
        for _ in range(round(10 * trouble.within_s)):
            await world.clock.sleep(0.1)
            for record in life.daemon.records().values():
                codes.update(fault["code"] for fault in record["faults"])
        assert trouble.shows() == named
        assert ("part_temperature" in codes) == named
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


def strong_steps(world: World) -> Iterator[Trouble]:
    """Steps of temperature that must be named, each ended when the next is asked for."""
    for seed in range(1000):
        trouble = KINDS["temperature_step"](world, random.Random(seed), False)
        if trouble.must:
            yield trouble
        trouble.end()


def test_a_chip_whose_set_up_was_damaged_is_not_judged_until_its_board_was_off_and_on(
    world: World,
) -> None:
    """It measures other pads than it should, or none. An MTB4 writes it once after power-up."""
    board = next(one for one in world.layout.boards if one.name == "forearm_outer")
    taxels = board.taxel_index[14]

    async def live() -> None:
        promises, life = start_watched(world)
        await world.clock.sleep(8.0)
        world.move()
        mend = world.robot.inject(Fault(name="slow_rise", board=board.name, triangle=14))
        world.robot.inject(Fault(name="board_reset", board=board.name))
        await world.clock.sleep(8.0)
        world.move()
        mend()
        promises.sample()
        await life.daemon.link.boards["can0"].set_up(board.settings.address)
        await world.clock.sleep(4.0)
        promises.sample()
        promises.calibrated_at_rest()
        assert (board.name, 14) in world.damaged_set_ups()
        assert world.unpowered == {board.name}
        assert promises.excuses.spoiled()[taxels].all()
        assert promises.accusations._has_cause("taxel_stuck", "left_forearm")
        world.robot.inject(Fault(name="board_reset", board=board.name))
        await world.clock.sleep(8.0)
        promises.sample()
        assert not world.damaged_set_ups()
        assert promises.excuses.spoiled()[taxels].all()
        promises.calibrated_at_rest()
        await world.clock.sleep(0.1)
        assert not promises.excuses.spoiled()[taxels].any()
        life.kill()

    with world.clock.runner() as runner:
        runner.run(live())


@pytest.mark.parametrize("kind", ["bit_errors", "frames_damaged"])
def test_damage_must_be_named_by_when_enough_of_it_came(world: World, kind: str) -> None:
    """One triangle sends 40 frames a second, 33 of them 1320."""
    one = world_of(DEMO.with_name("fingertips.toml"))
    for number in range(20):
        chance = random.Random(number)
        trouble = KINDS[kind](one, chance, True)
        share = float(trouble.about.rpartition("=")[2])
        assert trouble.within_s == pytest.approx(36 / (40 * share))
        assert KINDS[kind](world, chance, True).within_s == 8.0


@pytest.mark.parametrize("kind", ["frame_loss", "frames_lost"])
def test_loss_must_be_named_by_when_a_second_with_enough_of_it_has_come(
    world: World, kind: str
) -> None:
    """`gripper.toml`, seed 9350: 1.6 % of 80 frames a second, of which two in one may take long."""
    one = world_of(DEMO.with_name("gripper.toml"))
    draws = np.random.default_rng(1)
    for number in range(20):
        trouble = KINDS[kind](one, random.Random(number), False)
        share = float(trouble.about.rpartition("=")[2])
        assert trouble.must == {"bus_loses_frames"}
        seconds = draws.binomial(80, share * (1.0 - share), (20_000, round(trouble.within_s)))
        assert np.count_nonzero((seconds < 2).all(axis=1)) <= 10
        assert trouble.within_s == 5.0 or share < 0.06
        assert KINDS[kind](world, random.Random(number), False).within_s == 5.0


def test_a_fingertip_that_was_free_between_two_samples_need_not_be_touched_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    one = world_of(DEMO.with_name("fingertips.toml"))

    async def live() -> None:
        life = start(one)
        await one.clock.sleep(8.0)
        promises = Promises(one)
        promises.watch(life)
        tip = one.tips[0]
        pressing = asyncio.create_task(tip.press(2.0, 80.0))
        await sampled(promises, 2.0)
        await pressing
        await one.clock.sleep(0.1)
        pressing = asyncio.create_task(tip.press(2.0, 80.0))
        await one.clock.sleep(0.005)
        promises.sample()
        assert promises.broken is None
        await sampled(promises, 1.0)
        assert promises.broken is None
        pressing.cancel()
        life.kill()

    with one.clock.runner() as runner:
        runner.run(live())


def test_a_calm_ends_though_pads_of_real_skin_that_were_stuck_from_the_first_are_named(
    worn: World, tmp_path: Path
) -> None:
    """Damaged bytes were their noise when they were calibrated; other pads may not be stuck."""
    held = np.flatnonzero(~np.isnan(worn.robot.skin.held_ff))
    part = next(part for part in worn.layout.parts if part.start <= held[0] < part.stop)
    stuck = int(held[0]) - part.start

    def record(state: str, stuck: list[int], invalid: list[int]) -> bytes:
        return json.dumps(
            {
                "state": state,
                "faults": [{"code": "taxel_stuck", "where": part.name}],
                "taxels": part.n_taxels,
                "valid_taxels": part.n_taxels - len(invalid),
                "taxel_faults": {"stuck": stuck},
                "invalid": invalid,
            }
        ).encode()

    async def live() -> None:
        promises = Promises(worn)
        calm = Calm(Deeds(worn, promises, tmp_path))
        pads = promises.accusations.stuck[part.name]
        assert calm._faults(record("degraded", [stuck], [stuck]), pads) == []
        assert calm._faults(record("degraded", [stuck], [stuck, stuck + 1]), pads)
        assert calm._faults(record("degraded", [stuck + 1], [stuck + 1]), pads)
        assert calm._faults(record("silent", [], []), pads)
        assert calm._faults(record("degraded", [stuck], [stuck]), frozenset())

    with worn.clock.runner() as runner:
        runner.run(live())


@pytest.mark.parametrize("kind", ["swapped_lines", "wrong_address", "shared_address"])
def test_pads_are_not_judged_until_their_rest_is_back_from_bytes_of_another_chip(
    world: World, kind: str
) -> None:
    excuses = Promises(world).excuses
    trouble = KINDS[kind](world, random.Random(1), True)
    assert trouble.spoils is not None
    excuses.begin(trouble)
    trouble.end()
    excuses.end(trouble)
    world.clock.advance(15.0)
    assert excuses.spoiled()[trouble.spoils].all()
    world.clock.advance(6.0)
    assert not excuses.spoiled().any()


def test_what_presses_of_300_kpa_leave_in_the_foam_is_not_taken_for_a_wrong_pressure(
    world: World,
) -> None:
    """`gripper.toml` 4002: a tenth of it is there two seconds after the last of several presses."""

    async def live() -> tuple[float, str | None]:
        promises, life = start_watched(world)
        await world.clock.sleep(8.0)
        promises.sample()
        spot = world.spots[0]
        for _ in range(6):
            pressing = asyncio.create_task(spot.press(4.0, 400.0))
            for _ in range(18):
                await world.clock.sleep(0.25)
                promises.sample()
            await pressing
        for _ in range(8):
            await world.clock.sleep(0.25)
            promises.sample()
        left_kpa = max(frame.pressure_kpa.max() for frame in promises._skin._frames.values())
        wrong = promises._skin.wrong()
        life.kill()
        return float(left_kpa), wrong

    with world.clock.runner() as runner:
        left_kpa, wrong = runner.run(live())
    assert left_kpa > 25.0
    assert wrong is None


def drawn(kind: str, world: World, calibrated_units: float) -> Trouble:
    """Return a sure trouble of this kind on pads that were calibrated with so much noise."""

    async def live() -> Trouble:
        _, life = start_watched(world)
        await world.clock.sleep(8.0)
        engine = life.daemon.engine
        assert engine.calibration is not None
        noise = np.full_like(engine.calibration.noise, calibrated_units)
        engine.calibration = replace(engine.calibration, noise=noise)
        trouble = KINDS[kind](world, random.Random(1), True)
        life.kill()
        return trouble

    with world.clock.runner() as runner:
        return runner.run(live())


@pytest.mark.parametrize(
    ("own_units", "least_units", "must"), [(1.0, 8.0, True), (6.0, 20.0, False)]
)
def test_noise_must_be_named_where_a_pad_had_much_less_when_it_was_calibrated(
    world: World, own_units: float, least_units: float, must: bool
) -> None:
    """The demo's 4004: recorded noise of a pad was six units, a fault of three made it quieter."""

    trouble = drawn("noisy_taxel", world, own_units)
    assert trouble.about.endswith(f"value={least_units}")
    assert bool(trouble.must) == must


def test_noise_need_not_be_named_of_a_pad_of_real_skin_that_is_stuck_from_the_first(
    world: World,
) -> None:
    """`gripper.toml`, seed 9368: it has none."""
    world.robot.skin.held_ff[:] = 100.0
    assert not drawn("noisy_taxel", world, 1.0).must


@pytest.mark.parametrize(
    ("own_units", "calibrated_units", "at_once"),
    [(0.5, 0.6, True), (0.5, 0.38, False), (0.25, 0.6, False), (0.25, 0.38, False)],
)
def test_a_stuck_pad_must_be_named_once_chance_does_not_repeat_for_so_long(
    world: World, own_units: float, calibrated_units: float, at_once: bool
) -> None:
    """`icub_hand.toml`, seed 5003: noise of a quarter unit seldom leaves the middle of a byte."""

    world.robot.skin.noise_ff = own_units * world.layout.unit_ff
    trouble = drawn("stuck_taxel", world, calibrated_units)
    assert trouble.must == {"taxel_stuck"}
    assert (trouble.within_s == 20.0) == at_once
    assert at_once or trouble.within_s > LONGEST_DRILL_S


@pytest.mark.parametrize("after_s", [0.1, 0.2, 0.3, 0.4])
def test_what_waits_unread_when_a_board_is_zeroed_is_not_of_the_new_zero(
    worn: World, after_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a stall the zero was observed in it. An MTB3 goes on sending while it is set up."""

    async def live() -> None:
        life = start(worn)
        await worn.clock.sleep(20.0)
        engine, zeroed_ns = life.daemon.engine, list[int]()
        rezero = engine.zeros.rezero

        def note(board: int, believed: bool = True) -> int:
            zeroed_ns.append(worn.clock.now_ns())
            return rezero(board, believed)

        monkeypatch.setattr(engine.zeros, "rezero", note)
        setting_up = asyncio.create_task(life.daemon.configure([0]))
        await worn.clock.sleep(after_s)
        worn.clock.advance(2.0)
        await setting_up
        await worn.clock.sleep(1.0)
        assert len(zeroed_ns) == 2
        since_ns = engine.zeros.rezeros[0]._since_ns
        assert since_ns is not None
        assert since_ns > zeroed_ns[-1]
        await worn.end()

    with worn.clock.runner() as runner:
        runner.run(live())
