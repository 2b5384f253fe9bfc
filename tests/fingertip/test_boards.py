"""Force/torque boards brought up, watched and described, with the emulated ones on the bus."""

import asyncio
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.boards.fingertips import StrainBoard
from emulator.faults import parse
from emulator.probes.scene import Probe, Scene
from emulator.robot import Robot
from skin_host.bus.answers import answer_frame
from skin_host.bus.commands import SetTransmissionPeriod, command_frame
from skin_host.bus.ledger import MOST_OFTEN, MOST_WAITING_NS
from skin_host.bus.strain import FullScale, StrainType, Wrench, start_frames
from skin_host.bus.wire import FrameBatch
from skin_host.config.settings import changed, load
from skin_host.daemon import metrics
from skin_host.fingertip.engine import FingertipEngine
from skin_host.fingertip.events import FingertipEvent
from skin_host.fingertip.frozen import LEAST_NOISE_WORDS, OTHERS, REPEATS, Frozen
from skin_host.fingertip.health import FingertipHealth, FingertipRecord
from skin_host.fingertip.service import FingertipPublisher, StrainBoards
from skin_host.layout import build_layout
from skin_host.mqtt import messages
from skin_host.processing.calibration import Zero
from skin_host.processing.calibration.file import load_calibration, save_calibration
from skin_host.processing.core import Engine, Output
from skin_host.processing.events import Touch
from tests.support.strain import encode_strain

CONFIG = Path(__file__).parents[2] / "config"
FORCE_OF_INDEX, TORQUE_OF_INDEX = 0x31A, 0x31B


class Bench:
    """The robot of the shipped configuration, its host, and time that they share."""

    def __init__(self, *probes: dict[str, Any], noise: bool = True, **table: Any) -> None:
        settings = load(CONFIG / "fingertips.toml")
        index = msgspec.structs.replace(settings.fingertips["index"], **table)
        settings = changed(settings, {"fingertips.index": index})
        layout = build_layout(settings, CONFIG)
        scene = Scene(probe=[msgspec.convert(probe, Probe) for probe in probes], noise=noise)
        self.robot = Robot(settings, layout, scene)
        self.robot.bring_up()
        self.engine = Engine(settings, layout, [0])
        assert self.engine.fingertips is not None
        self.tips: FingertipEngine = self.engine.fingertips
        self.health = FingertipHealth(self.tips)
        self.sent: list[tuple[int, bytes]] = []
        self.felt: list[FingertipEvent] = []
        #: By how much the computer's clock was set since the start.
        self.ahead_ns = 0
        clock = lambda: self.robot.t_ns  # noqa: E731
        self.boards = StrainBoards("can0", self, self.tips.on_bus("can0"), clock)

    async def send(self, frames: Iterable[tuple[int, bytes]], gap_s: float = 0.0) -> None:
        """As a port does, but within the robot's own time."""
        for can_id, data in frames:
            self.sent.append((can_id, data))
            self.robot.receive("can0", can_id, data)

    async def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.02)):
            batch = self.robot.step(0.02)["can0"]
            batch.t_ns = batch.t_ns + self.ahead_ns
            # A clock may be set between two reads.
            self.felt += self.engine.expire(self.now_ns - 10_000_000).grasps
            self.felt += self.engine.feed("can0", batch).grasps
            self.felt += self.engine.expire(self.now_ns).grasps
            self.boards.supervise()
            self.health.tick(self.now_ns)
            await asyncio.sleep(0)

    async def calibrate(self) -> None:
        self.engine.begin_calibration(0.5)
        await self.run(0.6)
        self.engine.use(self.engine.end_calibration("2026-01-01T00:00:00+00:00"))

    @property
    def now_ns(self) -> int:
        return self.robot.t_ns + self.ahead_ns

    def contact(self, name: str = "index") -> str:
        """What is published as the fingertip's contact."""
        put: dict[str, str] = {}

        class Put:
            def put_contact(self, part: str, state: str) -> None:
                put[part] = state

        FingertipPublisher(self.tips, Put())  # type: ignore[arg-type]
        return put[name]

    def record(self, name: str = "index") -> FingertipRecord:
        return self.health.records(self.now_ns)[name]

    def codes(self, name: str = "index") -> list[str]:
        return [fault["code"].removeprefix("fingertip_") for fault in self.record(name)["faults"]]


async def calibrated(*probes: dict[str, Any], noise: bool = True, **table: Any) -> Bench:
    """A bench whose boards are set up, and calibrated."""
    bench = Bench(*probes, noise=noise, **table)
    await bench.boards.bring_up()
    await bench.calibrate()
    return bench


async def test_a_board_is_asked_for_its_full_scales_set_up_and_zeroed() -> None:
    bench = Bench()
    assert (bench.record()["state"], bench.codes()) == ("no data", [])
    await bench.boards.bring_up()
    await bench.run(0.4)
    assert bench.record()["full_scale"] == [50, 50, 50, 1, 1, 1]
    assert (bench.record()["state"], bench.codes()) == ("not calibrated", ["not_calibrated"])
    await bench.calibrate()
    record = bench.record()
    assert (record["state"], record["sentences"]) == ("ok", [])
    assert record["rate_hz"] == pytest.approx(333, rel=0.05)
    assert record["lone"] == 0
    assert bench.record("thumb")["rate_hz"] == pytest.approx(100, rel=0.05)


def test_a_full_scale_that_was_damaged_on_its_way_is_not_used() -> None:
    """It would be a wrong unit of everything that the channel measures."""
    bench = Bench()
    state = bench.tips.tips["index"]

    def answer(*scale: int) -> None:
        for channel, value in enumerate(scale):
            frame = answer_frame(FullScale(channel, value), state.settings.address)
            bench.engine.feed("can0", FrameBatch.of([(*frame, bench.robot.t_ns)]))

    answer(50, 50, 50, 1 | 1 << 9, 1, 1)
    answer(50, 50, 50, 1, 1, 1)
    assert state.assembler is None
    answer(50, 50, 50, 1, 1, 1)
    assert state.assembler is not None
    assert state.assembler.full_scale.tolist() == [50, 50, 50, 1, 1, 1]
    answer(50, 50, 50, 1, 1 | 1 << 15, 1)
    answer(50, 50, 50, 1, 1, 1)
    assert state.reported_scale.tolist() == [50, 50, 50, 1, 1, 1]


async def test_a_board_that_never_sends_is_absent_once_it_has_had_its_time() -> None:
    bench = Bench()
    mend = bench.robot.inject(parse("board_silent board=index"))
    await bench.boards.bring_up()
    await bench.run(0.2)
    assert "absent" not in bench.codes()
    await bench.run(1.5)
    assert "absent" in bench.codes()
    assert bench.record()["state"] == "no data"
    assert "absent" not in bench.codes("thumb")
    mend()
    await bench.run(5.0)
    assert "absent" not in bench.codes()


async def test_metrics_tell_of_fingertips() -> None:
    bench = await calibrated()
    page = metrics.exposition(bench.health.records(bench.robot.t_ns))
    assert 'skin_fingertip_touched{part="index"} 0' in page
    assert 'skin_faults{part="thumb"} 0' in page


@pytest.mark.parametrize("period_ms", [1, 10])
async def test_a_board_that_sends_in_another_period_is_named_and_set_up_again(
    period_ms: int,
) -> None:
    """By the period slips are judged: at a third of it their rates are too low by three times."""
    bench = await calibrated()
    assert bench.tips.tips["index"].keeps_period
    await bench.run(1.0)
    # Another program's.
    bench.robot.receive("can0", *command_frame(SetTransmissionPeriod(period_ms), 1))
    bench.sent.clear()
    sentences: set[str] = set()
    for _ in range(30):
        await bench.run(0.02)
        sentences.update(bench.record()["sentences"])
        assert bench.codes("thumb") == []
    assert f"sends every {period_ms} ms, not 3 ms" in sentences.pop()
    assert not sentences
    assert command_frame(SetTransmissionPeriod(3), 1) in bench.sent
    assert bench.codes() == []
    bench.sent.clear()
    await bench.run(10.0)
    assert bench.sent == []


async def test_of_a_board_that_floods_its_bus_so_many_samples_are_processed() -> None:
    bench = await calibrated()
    state = bench.tips.tips["index"]
    begun_ns, processed = bench.robot.t_ns, 0
    before = state.samples
    for turn in range(1000):
        t_ns = begun_ns + turn * 20_000_000
        frames = [
            (
                *encode_strain(1, kind, (turn % 7, number, 0)),
                t_ns + number * 400_000 + kind * 1_000,
            )
            for number in range(50)
            for kind in (StrainType.FORCE, StrainType.TORQUE)
        ]
        processed += len(bench.engine.feed("can0", FrameBatch.of(frames)).samples)
        bench.engine.expire(t_ns + 20_000_000)
    assert state.samples - before == 50_000
    assert bench.record()["excess"] == 50_000 - processed
    at_once, later = MOST_WAITING_NS / 3e6, MOST_OFTEN * 20e9 / 3e6
    assert abs(processed - (at_once + later)) <= 4
    # It is processed in whole again when that is over.
    excess = bench.record()["excess"]
    bench.ahead_ns = 20_000_000_000
    await bench.run(1.0)
    assert bench.record()["excess"] == excess


async def test_a_board_that_cannot_send_in_its_period_is_set_up_ever_more_seldom() -> None:
    bench = await calibrated()
    board = bench.robot.fingertips.boards["index"]
    handle = board.handle

    def refuse(can_id: int, data: bytes, t_ns: int) -> list[tuple[int, bytes]]:
        return [] if data[0] == SetTransmissionPeriod.CODE else handle(can_id, data, t_ns)

    board.handle = refuse  # type: ignore[method-assign]
    board.period_ms = 10
    bench.sent.clear()
    await bench.run(60.0)
    assert bench.codes() == ["period"]
    assert 5 <= bench.sent.count(command_frame(SetTransmissionPeriod(3), 1)) <= 11


class TwoBoards:
    """Let a second board send at the address of the index finger while `acts` is set."""

    def __init__(self, bench: Bench, phase_ms: float) -> None:
        self.acts = True
        load = [0.4, 0.0, -0.8, 0.0, 0.0, 0.0]
        scale = (50, 50, 50, 1, 1, 1)
        other = StrainBoard(1, lambda _: load, np.random.default_rng(5), full_scale=scale)
        for frame in start_frames(1, 3):
            other.handle(*frame, bench.robot.t_ns + round(phase_ms * 1e6))
        feed = bench.engine.feed

        def both(bus: str, batch: FrameBatch) -> Output:
            more = other.step(bench.robot.t_ns)
            if not self.acts:
                return feed(bus, batch)
            frames = [
                (int(one.id[row]), one.data[row, : one.dlc[row]].tobytes(), int(one.t_ns[row]))
                for one in (batch, more)
                for row in range(len(one))
            ]
            return feed(bus, FrameBatch.of(sorted(frames, key=lambda frame: frame[2])))

        bench.engine.feed = both  # type: ignore[method-assign]


@pytest.mark.parametrize("phase_ms", [0.05, 0.15, 1.1, 1.5])
async def test_two_boards_at_one_address_are_named_and_feel_nothing(phase_ms: float) -> None:
    """Their samples came in turns, as 300 touches a second of a fingertip that was well."""
    bench = await calibrated()
    two = TwoBoards(bench, phase_ms)
    bench.sent.clear()
    await bench.run(4.5)
    bench.felt.clear()
    for _ in range(20):
        await bench.run(0.1)
        assert bench.codes()[0] == "twice"
        assert bench.contact() == "UNKNOWN"
    assert not bench.felt
    # It may be one that sends too often.
    assert 1 <= bench.sent.count(command_frame(SetTransmissionPeriod(3), 1)) <= 4
    await bench.calibrate()
    assert bench.codes()[0] == "twice"
    assert not bench.tips.tips["index"].tip.zeroed
    assert bench.tips.tips["thumb"].tip.zeroed
    two.acts = False
    await bench.run(5.0)
    await bench.calibrate()
    await bench.run(0.5)
    assert (bench.codes(), bench.contact()) == ([], "OFF")


@pytest.mark.parametrize("pause_s", [0.3, 1.0, 3.0])
async def test_what_waited_while_a_computer_was_busy_is_not_of_two_boards(pause_s: float) -> None:
    """As an adapter stamps it: all at the time of reading."""
    bench = await calibrated()
    state = bench.tips.tips["index"]
    for _ in range(6):
        waited = bench.robot.step(pause_s)["can0"]
        waited.t_ns[:] = bench.robot.t_ns
        bench.engine.feed("can0", waited)
        for _ in range(60):
            await bench.run(0.02)
            assert not state.twice


@given(st.lists(st.floats(-0.3, 0.3), min_size=40, max_size=40), st.floats(0.0, 0.2))
def test_samples_that_are_late_or_lost_are_not_of_another_period(
    late: list[float], lost: float
) -> None:
    bench = Bench(full_scale=(50.0, 50.0, 50.0, 1.0, 1.0, 1.0))
    state = bench.tips.tips["index"]
    rng = np.random.default_rng(round(1e3 * sum(late) ** 2))
    for number, share in enumerate(late):
        if rng.random() < lost:
            continue
        t_ns = 10**18 + round(3e6 * (number + share))
        force = encode_strain(1, StrainType.FORCE, [0, 0, number])
        torque = encode_strain(1, StrainType.TORQUE, [0, 0, number])
        batch = FrameBatch.of([(*force, t_ns), (*torque, t_ns + 130_000)])
        bench.engine.feed("can0", batch)
        assert state.keeps_period is not False


def test_a_board_that_loses_a_third_of_its_frames_is_not_of_another_period() -> None:
    """Every few minutes it was called one that sends in twice its period, and set up again."""
    bench = Bench(full_scale=(50.0, 50.0, 50.0, 1.0, 1.0, 1.0))
    state = bench.tips.tips["index"]
    rng = np.random.default_rng(3)
    for turn in range(10_000):
        frames = [
            (
                *encode_strain(1, kind, [0, 0, sample % 1000]),
                10**18 + 3_000_000 * sample + 130_000 * later,
            )
            for sample in range(6 * turn, 6 * turn + 6)
            for later, kind in enumerate((StrainType.FORCE, StrainType.TORQUE))
            if rng.random() > 0.33
        ]
        bench.engine.feed("can0", FrameBatch.of(frames))
        assert state.keeps_period is not False


async def test_a_board_that_falls_silent_is_told_of_and_set_up_again() -> None:
    bench = await calibrated()
    mend = bench.robot.inject(parse("board_silent board=index"))
    await bench.run(0.3)
    assert (bench.record()["state"], bench.codes()) == ("silent", ["silent"])
    assert bench.codes("thumb") == []
    before = len(bench.sent)
    await bench.run(8.0)
    # Ever more rarely: each time six full scales twice, the period and the start.
    assert 3 * 14 <= len(bench.sent) - before <= 5 * 14
    bench.robot.fingertips.boards["index"].next_ns = None  # it has lost its power
    mend()
    await bench.run(9.0)
    assert bench.codes() == []
    assert bench.record()["silences"] == 1


@pytest.mark.parametrize("period_ms", [100, 150, 255])
async def test_a_board_has_timed_out_when_it_is_late_by_its_own_period(period_ms: int) -> None:
    bench = Bench(period_ms=period_ms, filter_hz=1.0, full_scale=(50.0, 50.0, 50.0, 1.0, 1.0, 1.0))
    await bench.boards.bring_up()
    await bench.run(1.0)
    seen = set()
    for _ in range(30):
        await bench.run(0.1)
        seen.update(bench.codes())
    assert seen == {"not_calibrated"}
    assert bench.record()["silences"] == 0
    mend = bench.robot.inject(parse("board_silent board=index"))
    await bench.run(3.0 * period_ms / 1000)
    assert bench.codes()[0] == "silent"
    mend()
    await bench.run(2.0)
    assert bench.codes() == ["not_calibrated"]
    assert bench.record()["silences"] == 1


async def test_a_touch_outlasts_a_lost_sample_of_a_slow_board() -> None:
    bench = Bench(
        {"part": "index", "force_n": [[8.0, 0], [8.1, 3], [99.0, 3]]},
        period_ms=255,
        filter_hz=1.0,
        full_scale=(50.0, 50.0, 50.0, 1.0, 1.0, 1.0),
    )
    await bench.boards.bring_up()
    await bench.run(1.0)
    bench.engine.begin_calibration(4.0)
    await bench.run(4.1)
    bench.engine.use(bench.engine.end_calibration("2026-01-01T00:00:00+00:00"))
    await bench.run(6.0)
    assert bench.contact() == "ON"
    mend = bench.robot.inject(parse("board_silent board=index"))
    await bench.run(0.26)
    mend()
    await bench.run(2.0)
    assert [event.event for event in bench.felt if event.event == "end"] == []
    assert bench.record()["silences"] == 0


async def test_full_scales_that_somebody_else_reported_are_told_until_the_board_is_asked() -> None:
    bench = await calibrated(full_scale=(50.0, 50.0, 50.0, 1.0, 1.0, 1.0))
    address = bench.tips.tips["index"].settings.address
    forged = answer_frame(FullScale(0, 7), address)
    bench.engine.feed("can0", FrameBatch.of([(*forged, bench.robot.t_ns)] * 2))
    assert bench.codes() == ["scale"]
    before = bench.record()["samples"]
    await bench.run(9.0)
    assert bench.codes() == []
    assert bench.record()["samples"] - before > 2500  # it went on sending


async def test_full_scales_that_are_given_are_used_and_compared() -> None:
    bench = await calibrated(full_scale=(50.0, 50.0, 50.0, 1.0, 1.0, 1.0))
    assert bench.codes() == []
    bench.tips.tips["index"].reported_scale[2] = 2000.0
    assert bench.codes() == ["scale"]


def exchange(bench: Bench, full_scale: float) -> None:
    """Put another board in the place of the index finger's, which does not send yet."""
    board = bench.robot.fingertips.boards["index"]
    board._full_scale = np.full(6, full_scale)
    board.next_ns = None


async def test_a_board_that_was_exchanged_for_one_of_another_range_does_not_feel() -> None:
    """By the range of the board before, a press on this one would be a fortieth of itself."""
    bench = Bench({"part": "index", "force_n": [[4.0, 0], [4.1, 5], [8.0, 5], [8.1, 0]]})
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    mend = bench.robot.inject(parse("board_silent board=index"))
    await bench.run(0.7)
    exchange(bench, 2000.0)
    mend()
    assert await contacts(bench, 3.0) == {"UNKNOWN"}
    record = bench.record()
    assert (record["state"], bench.codes()) == ("degraded", ["scale"])
    (sentence,) = record["sentences"]
    assert "(2000, 2000, 2000, 2000, 2000, 2000) than (50, 50, 50, 1, 1, 1)" in sentence
    assert await contacts(bench, 5.0) == {"UNKNOWN"}
    samples = bench.record()["samples"]
    bench.engine.begin_calibration(0.5)
    assert await contacts(bench, 0.6) == {"UNKNOWN"}
    bench.engine.use(bench.engine.end_calibration("2026-01-01T00:00:00+00:00"))
    await bench.run(0.1)
    assert bench.record()["full_scale"] == [2000.0] * 6
    assert bench.record()["samples"] > samples
    assert ("scale" in bench.codes(), bench.contact()) == (False, "OFF")


@pytest.mark.parametrize("full_scale", [50.0, 2000.0])
async def test_a_zero_that_was_kept_is_of_the_board_that_it_was_taken_of(
    tmp_path: Path, full_scale: float
) -> None:
    """A board may be exchanged while no daemon runs."""
    before, after = Bench(), Bench()
    await before.boards.bring_up()
    await before.run(0.4)
    await before.calibrate()
    calibration, layout = before.engine.calibration, before.engine.layout
    assert calibration is not None
    save_calibration(tmp_path / "kept.json", calibration, layout)
    board = after.robot.fingertips.boards["index"]
    board._full_scale = np.where(board._full_scale > 1.0, full_scale, 1.0)
    after.engine.use(load_calibration(tmp_path / "kept.json", layout, calibration.configuration))
    await after.boards.bring_up()
    await after.run(0.6)
    is_other = full_scale > 50.0
    assert (after.codes(), after.contact()) == ((["scale"], "UNKNOWN") if is_other else ([], "OFF"))
    if is_other:
        (sentence,) = after.record()["sentences"]
        assert "(2000, 2000, 2000, 1, 1, 1) than (50, 50, 50, 1, 1, 1) before" in sentence
    await after.calibrate()
    await after.run(0.1)
    assert ("scale" in after.codes(), after.contact()) == (False, "OFF")


async def test_full_scales_that_somebody_else_reported_are_doubted_until_the_board_is_asked() -> (
    None
):
    bench = Bench()
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    address = bench.tips.tips["index"].settings.address
    forged = answer_frame(FullScale(0, 7), address)
    bench.engine.feed("can0", FrameBatch.of([(*forged, bench.robot.t_ns)] * 2))
    await bench.run(0.02)
    assert (bench.codes(), bench.contact()) == (["scale"], "UNKNOWN")
    await bench.run(9.0)
    assert (bench.codes(), bench.contact()) == ([], "OFF")
    assert bench.record()["full_scale"] == [50, 50, 50, 1, 1, 1]


async def test_a_board_that_does_not_tell_its_full_scales_is_not_configured() -> None:
    bench = Bench()
    await bench.boards.bring_up()
    await bench.run(0.1)
    state = bench.tips.tips["index"]
    state.assembler = None
    state.reported_scale[:] = 0.0
    assert (bench.record()["state"], bench.codes()) == ("not configured", ["not_configured"])
    await bench.run(5.0)
    assert "not_configured" not in bench.codes()


@pytest.mark.parametrize(
    ("late", "sentence"),
    [(0, "frames are lost or late"), (48, "frames are lost or late"), (50, "come so far apart")],
)
async def test_lost_frames_are_told_until_none_is_lost(late: int, sentence: str) -> None:
    bench = await calibrated()
    await bench.run(1.0)
    assembler = bench.tips.tips["index"].assembler
    assert assembler is not None
    assembler.counters.lone += 50
    assembler.counters.late += late
    await bench.run(0.1)
    assert bench.codes() == ["loses_frames"]
    assert sentence in bench.record()["sentences"][0]
    await bench.run(6.0)
    assert bench.codes() == []


async def test_frames_of_a_wrong_length_count_for_the_board_that_sent_them() -> None:
    bench = Bench()
    await bench.boards.bring_up()
    await bench.run(0.4)
    skin = (0x388, bytes.fromhex("40F0F0F0F0F0F0F0"))  # the legacy stream of a skin board
    for can_id, data in ((FORCE_OF_INDEX, bytes(5)), skin, (FORCE_OF_INDEX, bytes(8))):
        bench.engine.feed("can0", FrameBatch.of([(can_id, data, bench.now_ns)]))
    assert bench.record()["wrong_length"] == 2
    assert bench.record("thumb")["wrong_length"] == 0


async def test_load_beyond_the_range_is_told_and_has_no_place() -> None:
    bench = await calibrated({"part": "index", "force_n": [[2.5, 0], [2.6, 60], [4, 60], [4.1, 0]]})
    await bench.run(2.5)
    assert (bench.record()["state"], bench.codes()) == ("saturated", ["saturated"])
    told = [event for event in bench.felt if event.part == "index"]
    loads = [getattr(event, "load", None) for event in told]
    assert "saturated" in {load.verdict for load in loads if load is not None}
    await bench.run(6.0)
    assert bench.codes() == []


class Damage:
    """Damages one frame of a stream in so many, each in another way, from `begin` on."""

    def __init__(self, bench: Bench, can_id: int, one_in: int) -> None:
        self.saturates = False
        self._step = bench.robot.step
        self._id, self._one_in = can_id, one_in
        self._chance = np.random.default_rng(can_id)
        self._frames = 0
        self._begun = False
        bench.robot.step = self.step  # type: ignore[method-assign]

    def begin(self) -> None:
        self._begun = True

    def step(self, seconds: float) -> dict[str, FrameBatch]:
        batches = self._step(seconds)
        batch = batches["can0"]
        for row in np.flatnonzero(batch.id == self._id).tolist() if self._begun else ():
            self._frames += 1
            if self._frames % self._one_in:
                continue
            if self._chance.random() < 0.3:
                batch.data[row, :6] = self._chance.integers(0, 256, 6)
            else:
                batch.data[row, self._chance.integers(6)] ^= 1 << self._chance.integers(8)
            if self.saturates:
                batch.dlc[row], batch.data[row, 6] = 7, 1
        return batches


@pytest.mark.parametrize("can_id", [FORCE_OF_INDEX, FORCE_OF_INDEX + 1])
@pytest.mark.parametrize("saturates", [False, True])
async def test_single_damaged_frames_are_no_touch(can_id: int, saturates: bool) -> None:
    bench = Bench()
    damage = Damage(bench, can_id, 3)
    damage.saturates = saturates
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    damage.begin()
    await bench.run(1.5)
    assert bench.felt == []
    assert bench.codes() == []


@pytest.mark.parametrize("can_id", [FORCE_OF_INDEX, FORCE_OF_INDEX + 1])
async def test_single_damaged_frames_change_nothing_of_a_touch(can_id: int) -> None:
    bench = Bench({"part": "index", "force_n": [[2.0, 0], [2.1, 2], [4.5, 2], [4.6, 0]]})
    damage = Damage(bench, can_id, 4)
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    await bench.run(1.6)
    (place,) = {event.centroid_m for event in bench.felt[-1:] if isinstance(event, Touch)}
    assert place is not None
    damage.begin()
    before = len(bench.felt)
    await bench.run(1.2)
    told = [event for event in bench.felt[before:] if isinstance(event, Touch)]
    assert bench.felt[before:] == told
    assert {event.event for event in told} == {"move"}
    for event in told:
        assert event.load is not None and event.load.verdict == "contact"
        assert event.force_n == pytest.approx(2.0, abs=0.05)
        np.testing.assert_allclose(event.centroid_m or (), place, atol=2e-3)
    await bench.run(1.2)
    ends = [event for event in bench.felt if event.event == "end"]
    assert len(ends) == 1


async def test_a_press_is_felt_with_its_second_sample_and_over_with_the_second_without_it() -> None:
    bench = Bench(full_scale=(50.0, 50.0, 50.0, 1.0, 1.0, 1.0), noise=False)
    noise = np.array([2e-3] * 3 + [5e-5] * 3)
    bench.tips.use(dict.fromkeys(bench.tips.tips, Zero(np.zeros(6), noise)))
    state = bench.tips.tips["index"]
    t_ns, seen = 0, []
    for force_n in (0.0, 0.0, 0.0, 0.0, 2.0, 2.0, 2.0, 0.0, 0.0, 0.0):
        t_ns += 3_000_000
        noise_words = len(seen) % 2
        force_words = round(-force_n / 50.0 * 0x8000) + noise_words
        force = encode_strain(1, StrainType.FORCE, [0, 0, force_words])
        torque = encode_strain(1, StrainType.TORQUE, [0, 0, noise_words])
        batch = FrameBatch.of([(*force, t_ns), (*torque, t_ns + 100_000)])
        bench.tips.feed("can0", batch, t_ns)
        seen.append(state.tip.touched)
    assert seen == [False] * 5 + [True] * 3 + [False] * 2


@pytest.mark.parametrize("bit", [0x01, 0x10])
async def test_damaged_frames_of_a_calibration_are_no_noise_of_a_board(
    bit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = await calibrated()
    whole = bench.record()["threshold_n"]
    step = bench.robot.step
    number = 0

    def damaged(seconds: float) -> dict[str, FrameBatch]:
        nonlocal number
        batches = step(seconds)
        batch = batches["can0"]
        forces = np.flatnonzero(batch.id == FORCE_OF_INDEX)
        number += 1
        batch.data[forces[number % 10 : number % 10 + 1], 1] ^= bit
        return batches

    monkeypatch.setattr(bench.robot, "step", damaged)
    await bench.calibrate()
    assert bench.codes() == []
    assert bench.record()["threshold_n"] == pytest.approx(whole, rel=0.05)


async def test_a_load_that_comes_during_a_calibration_counts_as_noise() -> None:
    bench = Bench({"part": "index", "force_n": [[1.4, 0], [1.45, 2]]})
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    assert bench.codes() == ["noisy"]
    assert bench.health.records(None)["index"]["faults"] == bench.record()["faults"]


async def test_a_fingertip_that_was_touched_when_calibrated_is_named_until_it_was_not(
    tmp_path: Path,
) -> None:
    bench = Bench({"part": "index", "force_n": [[2.0, 0], [2.1, 2], [4.0, 2], [4.1, 0]]})
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    assert bench.codes() == []
    await bench.run(0.7)
    await bench.calibrate()
    assert bench.codes() == ["pressed"]
    assert bench.codes("thumb") == []
    found = bench.engine.calibration
    assert found is not None
    layout, skin = bench.engine.layout, bench.engine.configuration
    save_calibration(tmp_path / "calibration.json", found, layout)
    kept = load_calibration(tmp_path / "calibration.json", layout, skin)
    assert {name: zero.touched for name, zero in kept.zeros.items()} == {
        "index": True,
        "thumb": False,
    }
    await bench.run(1.5)
    # By that zero it is touched now, so only a second calibration is known to be unloaded.
    await bench.calibrate()
    assert bench.codes() == ["pressed"]
    await bench.calibrate()
    assert bench.codes() == []


@pytest.mark.parametrize("set_s", [-3600, -2, 2, 3600])
async def test_a_clock_that_is_set_changes_nothing_of_a_touch(set_s: int) -> None:
    bench = Bench({"part": "index", "force_n": [[2.0, 0], [2.1, 2], [6.0, 2], [6.1, 0]]})
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    await bench.run(2.0)
    bench.ahead_ns = set_s * 1_000_000_000
    before = len(bench.felt)
    await bench.run(2.0)
    told = [event for event in bench.felt[before:] if isinstance(event, Touch)]
    assert [event.event for event in told] == ["move"] * len(told)
    assert told, "a touch that lasts is reported every second"
    assert bench.codes() == []
    await bench.run(2.0)
    assert [event.event for event in bench.felt if event.part == "index"][-1] == "end"


@pytest.mark.parametrize("set_s", [-3600, 0, 3600])
async def test_a_board_that_stops_sending_when_the_clock_is_set_has_timed_out(set_s: int) -> None:
    bench = Bench({"part": "index", "force_n": [[2.0, 0], [2.1, 2], [9.0, 2]]})
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    await bench.run(2.0)
    bench.robot.inject(parse("board_silent board=index"))
    bench.ahead_ns = set_s * 1_000_000_000
    await bench.run(0.8)
    assert bench.codes() == ["silent"]
    assert getattr(bench.felt[-1], "reason", None) == "lost"


async def test_a_fingertip_whose_board_answers_too_small_a_range_does_not_feel() -> None:
    """The emulated board answers 50 N."""
    bench = Bench(threshold_n=60.0, over_n=100.0)
    await bench.boards.bring_up()
    await bench.run(0.4)
    assert bench.codes() == ["not_calibrated", "unreached"]
    await bench.calibrate()
    await bench.run(0.1)
    assert (bench.record()["state"], bench.codes()) == ("degraded", ["unreached"])
    assert (bench.contact(), bench.contact("thumb")) == ("UNKNOWN", "OFF")
    (sentence,) = bench.record()["sentences"]
    assert "60 N" in sentence and "fingertips.index" in sentence
    assert (bench.health.records(None)["index"]["sentences"]) == [sentence]


async def test_what_is_felt_beyond_the_range_of_a_fingertip_that_does_not_feel_is_a_contact() -> (
    None
):
    bench = Bench(
        {"part": "index", "force_n": [[2.5, 0], [2.6, 70], [9.0, 70]]},
        threshold_n=60.0,
        over_n=100.0,
    )
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    await bench.run(0.1)
    assert bench.contact() == "UNKNOWN"
    await bench.run(2.0)
    assert bench.contact() == "ON"


async def test_noise_that_raises_the_threshold_beyond_the_range_is_not_felt_through() -> None:
    bench = await calibrated()
    await bench.run(0.1)
    assert bench.contact() == "OFF"
    noisy = Zero(np.zeros(6), np.array([9.0, 9.0, 9.0, 0.1, 0.1, 0.1]))
    assert bench.engine.calibration is not None
    bench.tips.use(bench.engine.calibration.zeros | {"index": noisy})
    await bench.run(0.1)
    assert bench.codes() == ["unreached", "noisy"]
    assert "calibrate" in bench.record()["sentences"][0]
    assert (bench.contact(), bench.contact("thumb")) == ("UNKNOWN", "OFF")
    await bench.calibrate()
    await bench.run(0.1)
    assert (bench.codes(), bench.contact()) == ([], "OFF")


class Latch:
    """A converter of the index finger that repeats its last frames, or some of their bytes, while
    it `holds`.
    """

    def __init__(
        self,
        bench: Bench,
        of: tuple[int, ...] = (FORCE_OF_INDEX, TORQUE_OF_INDEX),
        octets: slice = slice(None),
    ) -> None:
        self.holds = False
        self._step = bench.robot.step
        self._of, self._octets = of, octets
        self._last: dict[int, Any] = {}
        bench.robot.step = self.step  # type: ignore[method-assign]

    def step(self, seconds: float) -> dict[str, FrameBatch]:
        batches = self._step(seconds)
        batch = batches["can0"]
        for row, can_id in enumerate(batch.id.tolist()):
            if can_id in self._of:
                if self.holds and can_id in self._last:
                    batch.data[row, self._octets] = self._last[can_id][self._octets]
                self._last[can_id] = batch.data[row].copy()
        return batches


@pytest.mark.parametrize("pressed_n", [0.0, 2.0])
async def test_a_board_that_repeats_its_bytes_does_not_feel_until_they_change(
    pressed_n: float,
) -> None:
    held = [[2.5, 0], [2.6, pressed_n], [99.0, pressed_n]]
    bench = Bench({"part": "index", "force_n": held})
    latch = Latch(bench)
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    await bench.run(2.0)
    before = "ON" if pressed_n else "OFF"
    assert (bench.codes(), bench.contact()) == ([], before)
    latch.holds = True
    await bench.run(0.8 * REPEATS * 3e-3)
    assert (bench.codes(), bench.contact()) == ([], before)
    await bench.run(0.4 * REPEATS * 3e-3)
    assert (bench.record()["state"], bench.codes()) == ("degraded", ["frozen"])
    assert (bench.contact(), bench.contact("thumb")) == ("UNKNOWN", "OFF")
    ends = [event for event in bench.felt if isinstance(event, Touch) and event.event == "end"]
    assert [event.reason for event in ends] == (["lost"] if pressed_n else [])
    assert bench.health.records(None)["index"]["faults"] == bench.record()["faults"]
    latch.holds = False
    await bench.run(0.1)
    assert (bench.codes(), bench.contact()) == ([], before)


async def test_a_board_that_repeats_its_bytes_gets_no_zero() -> None:
    bench = Bench()
    latch = Latch(bench)
    await bench.boards.bring_up()
    await bench.run(0.4)
    latch.holds = True
    await bench.run(1.0)
    bench.tips.begin_zero()
    await bench.run(0.5)
    assert set(bench.tips.end_zero()) == {"thumb"}
    bench.tips.begin_zero()
    latch.holds = False
    await bench.run(0.4)
    latch.holds = True
    await bench.run(1.0)
    assert set(bench.tips.end_zero()) == {"thumb"}


async def contacts(bench: Bench, seconds: float) -> set[str]:
    """What is published as the contact of the index finger meanwhile."""
    seen = set()
    for _ in range(round(seconds / 0.02)):
        await bench.run(0.02)
        seen.add(bench.contact())
    return seen


@pytest.mark.parametrize("pressed_n", [0.0, 2.0])
async def test_a_board_that_repeats_its_bytes_from_the_start_is_never_free_nor_touched(
    pressed_n: float,
) -> None:
    before = await calibrated()
    bench = Bench({"part": "index", "force_n": [[0.0, pressed_n], [99.0, pressed_n]]})
    latch = Latch(bench)
    latch.holds = True
    await bench.boards.bring_up()
    assert before.engine.calibration is not None
    bench.tips.use(before.engine.calibration.zeros)
    assert await contacts(bench, 0.9 * REPEATS * 3e-3) == {"UNKNOWN"}
    assert (bench.record()["state"], bench.codes()) == ("no data", [])
    assert await contacts(bench, 1.5) == {"UNKNOWN"}
    assert (bench.record()["state"], bench.codes()) == ("degraded", ["frozen"])
    assert [event for event in bench.felt if event.part == "index"] == []
    latch.holds = False
    await bench.run(0.1)
    free = "ON" if pressed_n else "OFF"
    assert (bench.record()["state"], bench.contact()) == ("ok", free)


async def test_a_board_that_comes_back_with_the_same_bytes_is_not_free() -> None:
    bench = Bench()
    latch = Latch(bench)
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    assert await contacts(bench, 0.2) == {"OFF"}
    mend = bench.robot.inject(parse("board_silent board=index"))
    await bench.run(1.0)
    latch.holds = True
    mend()
    assert await contacts(bench, 0.9 * REPEATS * 3e-3) == {"UNKNOWN"}
    latch.holds = False
    await bench.run(0.1)
    assert (bench.codes(), bench.contact()) == ([], "OFF")


@pytest.mark.parametrize(("of", "what"), [(FORCE_OF_INDEX, "force"), (TORQUE_OF_INDEX, "torque")])
async def test_a_board_that_repeats_only_one_of_its_frames_does_not_feel(
    of: int, what: str
) -> None:
    bench = Bench()
    latch = Latch(bench, (of,))
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    await bench.run(0.2)
    latch.holds = True
    await bench.run(1.2 * REPEATS * 3e-3)
    assert (bench.record()["state"], bench.codes()) == ("degraded", ["frozen"])
    assert f"repeats the same {what} " in bench.record()["sentences"][0]
    assert (bench.contact(), bench.contact("thumb")) == ("UNKNOWN", "OFF")
    bench.tips.begin_zero()
    await bench.run(0.5)
    assert set(bench.tips.end_zero()) == {"thumb"}
    latch.holds = False
    await bench.run(0.1)
    assert (bench.codes(), bench.contact()) == ([], "OFF")


@pytest.mark.parametrize(
    ("of", "what"), [(FORCE_OF_INDEX, "force along z"), (TORQUE_OF_INDEX, "torque along z")]
)
async def test_a_board_of_which_one_channel_stands_still_does_not_feel(of: int, what: str) -> None:
    """Its other channels go on changing: what presses along this one would look like nothing."""
    bench = Bench({"part": "index", "force_n": [[0.0, 0], [2.5, 0], [2.6, 2.0], [99.0, 2.0]]})
    latch = Latch(bench, (of,), slice(4, 6))
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    await bench.run(0.2)
    assert (bench.codes(), bench.contact()) == ([], "OFF")
    latch.holds = True
    await bench.run(1.2 * REPEATS * 3e-3)
    assert (bench.record()["state"], bench.codes()) == ("degraded", ["frozen"])
    assert f"repeats the same {what} " in bench.record()["sentences"][0]
    assert (bench.contact(), bench.contact("thumb")) == ("UNKNOWN", "OFF")
    latch.holds = False
    await bench.run(2.0)
    assert (bench.codes(), bench.contact()) == ([], "ON")


async def test_a_board_that_has_stopped_sending_is_not_frozen_too() -> None:
    bench = Bench()
    latch = Latch(bench)
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    latch.holds = True
    await bench.run(1.0)
    assert bench.codes() == ["frozen"]
    bench.robot.inject(parse("board_silent board=index"))
    await bench.run(0.4)
    assert bench.codes() == ["silent"]


class Halves:
    """What happens to frames of the index finger's board on their way while it `acts`.

    Args:
        of: their identifiers.
        how: they are "lost", "short" of a byte, "late" by 0.8 periods, or "rare": only one in
            fifty comes.
    """

    def __init__(self, bench: Bench, of: tuple[int, ...], how: str) -> None:
        self.acts = False
        self._step = bench.robot.step
        self._of, self._how = of, how
        self._number = 0
        bench.robot.step = self.step  # type: ignore[method-assign]

    def step(self, seconds: float) -> dict[str, FrameBatch]:
        batches = self._step(seconds)
        batch = batches["can0"]
        mine = np.isin(batch.id, self._of)
        if not self.acts or not mine.any():
            return batches
        rows = np.arange(len(batch))
        if self._how == "short":
            batch.dlc[mine] = 5
        elif self._how == "late":
            batch.t_ns = batch.t_ns + mine * 2_400_000
            rows = np.argsort(batch.t_ns, kind="stable")
        else:
            lost = mine.copy()
            if self._how == "rare":
                numbers = self._number + np.cumsum(mine)
                lost &= numbers % 50 != 0
            self._number += int(mine.sum())
            rows = np.flatnonzero(~lost)
        batches["can0"] = FrameBatch(
            batch.id[rows], batch.dlc[rows], batch.data[rows], batch.t_ns[rows]
        )
        return batches


HALVES = {"force": (FORCE_OF_INDEX,), "torque": (TORQUE_OF_INDEX,)}


@pytest.mark.parametrize(
    ("missing", "how"),
    [
        ("force", "lost"),
        ("torque", "lost"),
        ("force", "short"),
        ("torque", "short"),
        ("torque", "late"),
    ],
)
@pytest.mark.parametrize("pressed_n", [0.0, 2.0])
async def test_a_board_that_sends_no_whole_samples_does_not_feel(
    missing: str, how: str, pressed_n: float
) -> None:
    """What is left of a sample is no load: the contact before would last for ever."""
    bench = Bench({"part": "index", "force_n": [[2.5, 0], [2.6, pressed_n], [99.0, pressed_n]]})
    halves = Halves(bench, HALVES[missing], how)
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    await bench.run(2.0)
    before = "ON" if pressed_n else "OFF"
    assert (bench.codes(), bench.contact()) == ([], before)
    halves.acts = True
    await bench.run(0.4)
    assert bench.contact() == before
    commands = len(bench.sent)
    await bench.run(0.2)
    record = bench.record()
    assert (record["state"], bench.codes()) == ("silent", ["incomplete"])
    (sentence,) = record["sentences"]
    (other,) = set(HALVES) - {missing}
    wanted = {"lost": f"sends {other} without {missing}: ", "late": "do not follow each other"}
    wanted["short"] = f"sends {other} without {missing}, and frames of a wrong length: "
    assert wanted[how] in sentence
    assert record["silences"] == 1
    assert 500.0 <= (record["age_ms"] or 0.0) <= 620.0
    assert (bench.contact(), bench.contact("thumb")) == ("UNKNOWN", "OFF")
    assert not record["touched"]
    ends = [event for event in bench.felt if isinstance(event, Touch) and event.event == "end"]
    assert [event.reason for event in ends] == (["lost"] if pressed_n else [])
    assert await contacts(bench, 2.0) == {"UNKNOWN"}
    assert len(bench.sent) >= commands + 14  # it is set up again
    assert bench.codes("thumb") == []
    halves.acts = False
    await bench.run(0.1)
    assert bench.contact() == before
    await bench.run(6.0)
    record = bench.record()
    assert (record["state"], bench.codes(), record["silences"]) == ("ok", [], 1)


async def test_a_touch_is_not_reported_after_its_release_by_a_board_that_lost_its_torque() -> None:
    bench = Bench({"part": "index", "force_n": [[2.0, 0], [2.1, 2], [4.0, 2], [4.1, 0]]})
    halves = Halves(bench, HALVES["torque"], "lost")
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    await bench.run(2.0)
    assert bench.contact() == "ON"
    halves.acts = True
    await bench.run(0.6)
    assert await contacts(bench, 2.0) == {"UNKNOWN"}
    halves.acts = False
    await bench.run(0.1)
    assert bench.contact() == "OFF"


async def test_single_frames_of_a_board_that_is_silent_are_no_sign_that_nothing_touches() -> None:
    bench = Bench()
    halves = Halves(bench, (FORCE_OF_INDEX, TORQUE_OF_INDEX), "rare")
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    halves.acts = True
    await bench.run(0.6)
    assert await contacts(bench, 3.0) == {"UNKNOWN"}


@pytest.mark.parametrize("missing", list(HALVES))
async def test_a_board_that_never_sends_whole_samples_is_named_once_it_has_had_its_time(
    missing: str,
) -> None:
    before = await calibrated()
    bench = Bench()
    halves = Halves(bench, HALVES[missing], "lost")
    halves.acts = True
    await bench.boards.bring_up()
    assert before.engine.calibration is not None
    bench.tips.use(before.engine.calibration.zeros)
    await bench.run(0.3)
    assert "incomplete" not in bench.codes()
    assert await contacts(bench, 1.0) == {"UNKNOWN"}
    assert bench.codes()[0] == "incomplete"
    assert bench.record()["age_ms"] is None
    assert bench.record()["state"] == "silent"


async def test_a_board_that_sends_only_frames_of_a_wrong_length_is_not_called_silent() -> None:
    bench = Bench()
    halves = Halves(bench, (FORCE_OF_INDEX, TORQUE_OF_INDEX), "short")
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    halves.acts = True
    await bench.run(0.7)
    assert bench.codes() == ["incomplete"]
    assert "sends only frames of a wrong length: " in bench.record()["sentences"][0]
    assert bench.contact() == "UNKNOWN"
    bench.robot.inject(parse("board_silent board=index"))
    await bench.run(0.3)
    assert bench.codes() == ["silent"]
    assert bench.record()["silences"] == 1


async def test_no_zero_is_taken_of_a_board_that_sends_no_whole_samples() -> None:
    bench = Bench()
    halves = Halves(bench, HALVES["torque"], "lost")
    await bench.boards.bring_up()
    await bench.run(0.4)
    halves.acts = True
    bench.tips.begin_zero()
    await bench.run(1.0)
    assert set(bench.tips.end_zero()) == {"thumb"}


async def test_a_contact_of_before_a_gap_in_the_samples_must_show_again_that_it_is_measured() -> (
    None
):
    bench = Bench()
    latch = Latch(bench)
    halves = Halves(bench, HALVES["force"], "lost")
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    await bench.run(0.2)
    halves.acts = True
    await bench.run(0.8)
    latch.holds, halves.acts = True, False
    assert await contacts(bench, 0.7 * REPEATS * 3e-3) == {"UNKNOWN"}
    latch.holds = False
    await bench.run(0.1)
    assert bench.contact() == "OFF"


def sample(force: float, torque: float, *, saturated: bool = False) -> Wrench:
    return Wrench(0, np.array([force, 1.0, 1.0]), np.array([torque, 1.0, 1.0]), saturated)


def after(*samples: Wrench) -> Frozen:
    seen = Frozen()
    for one in samples:
        seen.take(one)
    return seen


REPEATED = [sample(5, 1)] * (REPEATS + 1)


def test_only_so_many_equal_frames_in_a_row_are_frozen() -> None:
    assert after(*REPEATED).repeated == ["force", "torque"]
    assert after(*REPEATED[1:]).repeated == []
    assert after(*REPEATED[1:], sample(6, 2), *REPEATED[1:]).repeated == []
    assert after(*REPEATED[1:], sample(5, 2)).repeated == ["force"]
    assert after(*REPEATED[1:], sample(6, 1)).repeated == ["torque"]


def test_single_damaged_frames_do_not_hide_that_a_board_is_frozen() -> None:
    others = [sample(6 + n, 2 + n) for n in range(OTHERS)]
    assert after(*REPEATED, *others[:-1]).repeated
    assert after(*REPEATED, *others[:-1], sample(5, 1), *others[:-1]).repeated
    assert not after(*REPEATED, *others).repeated


def test_what_was_sent_is_trusted_once_force_and_torque_have_changed_several_times_in_a_row() -> (
    None
):
    assert not after().trusted
    changing = [sample(n, n) for n in range(10, 11 + OTHERS)]
    assert not after(*changing[:-1]).trusted
    assert after(*changing).trusted
    assert not after(*[sample(n, 0) for n in range(99)]).trusted
    assert not after(*[sample(0, n) for n in range(99)]).trusted
    # A damaged frame differs from the one before and from the one after it.
    assert not after(*[sample(n % 3 == 0, n % 3 == 0) for n in range(99)]).trusted
    assert after(*changing, *REPEATED[1:]).trusted
    assert not after(*changing, *REPEATED).trusted
    assert after(*changing, *REPEATED, *changing).trusted
    seen = after(*changing)
    seen.doubt()
    assert not seen.trusted
    for one in changing:
        seen.take(one)
    assert seen.trusted


def test_a_channel_by_itself_is_frozen_only_if_it_had_noise_at_rest() -> None:
    changing = [sample(n, n) for n in range(10, 11 + OTHERS)]
    still = [
        Wrench(0, np.array([5.0, n, 1.0]), np.array([n, 1.0, 1.0]), saturated=False)
        for n in range(REPEATS + 9)
    ]
    for noise_words, frozen in ((LEAST_NOISE_WORDS, ["force along x"]), (0.5, [])):
        seen = Frozen()
        seen.judge(np.array([noise_words, 9.0, 0.0, 9.0, 0.0, 0.0]))
        for one in [*changing, *still]:
            seen.take(one)
        assert (seen.repeated, seen.trusted) == (frozen, not frozen)
        for one in changing:
            seen.take(one)
        assert (seen.repeated, seen.trusted) == ([], True)


@pytest.mark.parametrize("rest_words", [0.0, 0.5])
@pytest.mark.parametrize("noise_words", [0.0, 0.1, 0.3, 0.52, 2.0])
def test_noise_of_a_channel_does_not_repeat_for_so_long_by_chance(
    rest_words: float, noise_words: float
) -> None:
    """Judged by the noise at a rest, which shows most where it is between two words."""
    rng = np.random.default_rng(2)
    shown = np.round(rest_words + noise_words * rng.normal(size=(1000, 6))).std(axis=0)
    seen = Frozen()
    seen.judge(shown)
    for words in np.round(noise_words * rng.normal(size=(20 * REPEATS, 6))):
        seen.take(Wrench(0, words[:3], words[3:], saturated=False))
        assert not any("along" in name for name in seen.repeated)


def test_a_board_at_the_end_of_its_range_is_saturated_and_not_frozen() -> None:
    assert not after(*[sample(5, 1, saturated=True)] * (2 * REPEATS)).repeated


@pytest.mark.parametrize("noise_words", [0.25, 0.5, 1.6])
def test_noise_does_not_repeat_for_so_long_by_chance_and_is_soon_trusted(
    noise_words: float,
) -> None:
    """Each channel rests in the middle of a word: there it repeats most often."""
    one = math.erf(0.5 / noise_words / math.sqrt(2.0))
    begun_in_a_year = 2 * 333 * 3600 * 24 * 365
    assert begun_in_a_year * one ** (3 * REPEATS) < 0.01
    rng = np.random.default_rng(1)
    for _ in range(100):
        seen, taken = Frozen(), 0
        while not seen.trusted:
            force, torque = np.round(noise_words * rng.normal(size=(2, 3)))
            seen.take(Wrench(0, force, torque, saturated=False))
            taken += 1
            assert not seen.repeated
        assert taken <= 2 * REPEATS


async def test_a_contact_without_end_makes_its_zero_uncertain() -> None:
    bench = await calibrated({"part": "index", "force_n": [[2.5, 0], [2.6, 1], [6.5, 1], [6.6, 0]]})
    bench.tips.held_report_ns = 2_000_000_000
    await bench.run(2.5)
    assert bench.codes() == []
    await bench.run(2.5)
    assert bench.codes() == ["held"]
    await bench.run(3.0)
    assert bench.codes() == []


frames = st.lists(
    st.tuples(
        st.one_of(
            # Data of both fingertips, answers, anything.
            st.sampled_from([0x318, 0x31A, 0x31B, 0x32A, 0x32B, 0x210, 0x220]),
            st.integers(0, 0x7FF),
        ),
        st.one_of(st.binary(min_size=6, max_size=7), st.binary(max_size=8)),
        st.one_of(st.sampled_from([100_000, 2_900_000]), st.integers(-3_000_000, 700_000_000)),
    ),
    max_size=60,
)


async def test_a_board_that_sent_while_this_computer_stood_still_has_not_stopped_sending() -> None:
    """What waited may be read at once, and be of longer than a board may be silent."""
    bench = Bench()
    await bench.boards.bring_up()
    await bench.run(0.4)
    await bench.calibrate()
    await bench.run(1.2)
    index, thumb = bench.tips.tips["index"], bench.tips.tips["thumb"]
    for sends in (True, False):
        batch = bench.robot.step(1.2)["can0"]
        if not sends:
            rows = np.flatnonzero(batch.id >> 4 & 0xF != 1)
            batch = FrameBatch(batch.id[rows], batch.dlc[rows], batch.data[rows], batch.t_ns[rows])
        bench.engine.feed("can0", batch)
        bench.engine.expire(bench.now_ns)
        assert (index.alive, index.silenced) == (sends, 0 if sends else 1)
        assert (thumb.alive, thumb.silenced) == (True, 0)


@given(frames)
def test_no_traffic_on_the_bus_breaks_the_engine_or_gives_numbers_that_are_none(
    traffic: list[tuple[int, bytes, int]],
) -> None:
    bench = Bench(full_scale=(50.0, 50.0, 50.0, 1.0, 1.0, 1.0))
    noise = np.array([2e-3] * 3 + [5e-5] * 3)
    felt = bench.tips.use(dict.fromkeys(bench.tips.tips, Zero(np.zeros(6), noise)))
    t_ns = 1_000_000_000
    for can_id, data, pause_ns in traffic:
        t_ns = max(0, t_ns + pause_ns)
        felt += bench.engine.feed("can0", FrameBatch.of([(can_id, data, t_ns)])).grasps
        felt += bench.engine.expire(t_ns).grasps
        bench.health.tick(t_ns)
        bench.health.records(t_ns)
    felt += bench.tips.end_all(t_ns)
    open_now: dict[str, set[tuple[str, int]]] = {"touch": set(), "slip": set(), "over": set()}
    for event in felt:
        kind = "touch" if isinstance(event, Touch) else type(event).__name__.lower()
        assert math.isfinite(event.force_n)
        if isinstance(event, Touch):
            assert event.centroid_m is None or np.isfinite(event.centroid_m).all()
            messages.decode_touch(messages.encode_event(event, 1))
        key = event.part, event.id
        if event.event == "begin":
            assert key not in open_now[kind] or kind != "touch"
            open_now[kind].add(key)
        elif event.event == "end":
            open_now[kind].remove(key)
        else:
            assert key in open_now[kind]
    assert open_now == {"touch": set(), "slip": set(), "over": set()}
