"""Health accuses nobody wrongly: own stalls are own, sentences are about now, `ok` is ok."""

from typing import Any

import numpy as np
import pytest

from emulator.probes.scene import Fault, Place, Probe, Scene
from emulator.robot import Robot
from skin_host.bus.commands import SetTriangleConfig
from skin_host.bus.ledger import MOST_OFTEN
from skin_host.bus.wire import FrameBatch
from skin_host.health import LATELY_NS, STALLED_NS, HealthWatch
from skin_host.layout import PadKind
from tests.support.fault_bench import CONFIG, FaultBench
from tests.support.fault_matrix import bench_of

OUTPUT: dict[str, Any] = {"connected": True, "touches_dropped": 0, "refused": 0, "last_error": ""}


def codes(health: HealthWatch, now_ns: int, **output: Any) -> set[str]:
    record = health.record(0, now_ns, {}, {}, OUTPUT | output)
    return {fault["code"] for fault in record["faults"]}


def test_a_stall_of_this_computer_is_its_own_and_passes(bench: FaultBench) -> None:
    """The robot went on meanwhile; what was lost on the way may have been lost here."""
    bench.inject("frame_loss", bus="can0")
    bench.run(1.0)
    assert "bus_loses_frames" in codes(bench.health, bench.now_ns)
    later_ns = bench.now_ns + 700_000_000
    bench.health.tick(later_ns, {}, {})
    bench.health._held.clear()
    record = bench.health.record(0, later_ns, {}, {})
    (stall,) = record["faults"]
    assert stall["code"] == "host_stalls"
    assert "700 ms" in record["sentences"][0] or "for 7" in record["sentences"][0]
    assert "host_stalls" not in codes(bench.health, later_ns + STALLED_NS + 1)


def test_losses_of_the_output_are_faults_for_a_minute(bench: FaultBench) -> None:
    now_ns = bench.now_ns
    assert codes(bench.health, now_ns) == set()
    assert codes(bench.health, now_ns, touches_dropped=3, refused=1) == {
        "touches_dropped",
        "broker_refuses",
    }
    assert codes(bench.health, now_ns + LATELY_NS, touches_dropped=3, refused=1) == set()
    assert codes(bench.health, now_ns + 2 * LATELY_NS, touches_dropped=4, refused=1) == {
        "touches_dropped"
    }


def test_a_board_whose_frames_wait_for_those_of_an_irregular_one_is_not_called_irregular() -> None:
    """Six boards that were set up together want the bus at the same time; urgent ones go first."""
    bench = FaultBench(2.0, config=CONFIG.with_name("nao.toml"), settle_s=2.0)
    end = bench.inject("jittered_period", board="left_upper_arm", value=7.25)
    bench.run(10.0)
    jittered = {where for code, where in bench.told if code == "board_jitter"}
    assert jittered == {"left_upper_arm"}
    end()
    bench.run(5.0)
    assert not bench.told
    # One of another period comes between them at ever other moments.
    end = bench.inject("late_period", board="left_upper_arm", value=25.3)
    for _ in range(20):
        bench.run(0.25)
        assert "board_jitter" not in {code for code, _ in bench.told}
    assert ("board_period", "left_upper_arm") in bench.told
    end()
    bench.run(5.0)
    # Of two both are named: the less urgent one is not held up all the time.
    for board in ("left_lower_arm_1", "left_upper_arm"):
        bench.inject("jittered_period", board=board, value=8.0)
    bench.run(5.0)
    jittered = {where for code, where in bench.told if code == "board_jitter"}
    assert jittered == {"left_lower_arm_1", "left_upper_arm"}


def test_a_board_that_one_held_up_which_is_silent_now_is_not_called_irregular() -> None:
    bench = FaultBench(2.0, config=CONFIG.with_name("nao.toml"), settle_s=2.0)
    bench.inject("late_period", board="left_lower_arm_1", value=25.3)
    bench.run(1.5)
    bench.inject("board_silent", board="right_lower_arm_2")
    for _ in range(10):
        bench.run(0.1)
        assert "board_jitter" not in {code for code, _ in bench.told}


def test_boards_that_wait_for_triangles_that_are_not_configured_are_not_called_irregular() -> None:
    """A board that another program set up sends all sixteen, which takes the bus longer."""
    bench = FaultBench(2.0, config=CONFIG.with_name("kaspar.toml"), settle_s=2.0)
    hand = bench.layout.boards[1]
    assert hand.triangles == tuple(range(6))
    bench.robot._command(1, SetTriangleConfig(0, 15))
    bench.robot._boards[1].next_ns += 7_000_000  # it sends where the others have begun
    bench.robot._look_ahead()
    bench.run(3.0)
    bench.inject("jittered_period", board="right_lower_arm", value=8.0)
    irregular = set()
    for _ in range(60):
        bench.run(0.25)
        irregular |= {where for code, where in bench.told if code == "board_jitter"}
    assert irregular == {"right_lower_arm"}


def test_an_irregular_board_that_more_urgent_ones_hide_is_not_known() -> None:
    """All that it adds to its intervals passes while the bus is taken by the boards before it."""
    bench = FaultBench(2.0, config=CONFIG.with_name("kaspar.toml"), settle_s=2.0)
    bench.inject("jittered_period", board="right_foot", value=6.1)
    bench.run(5.0)
    assert not bench.told
    seen_ns = bench.engine.ledger.intervals_ns(
        bench.engine.ledger.row[len(bench.layout.boards) - 1]
    )
    assert np.percentile(np.abs(seen_ns - 50_000_000), 75) < 1_000_000


def test_a_part_with_complaints_is_not_ok(bench: FaultBench) -> None:
    assert bench.health.record(0, bench.now_ns, {}, {}, OUTPUT)["state"] == "ok"
    away = OUTPUT | {"connected": False}
    assert bench.health.record(0, bench.now_ns, {}, {}, away)["state"] == "warning"
    bench.inject("chip_gone", board="hand", triangle=0)
    bench.run(1.0)
    assert bench.health.record(0, bench.now_ns, {}, {}, away)["state"] == "degraded"


class TwoBoards:
    """A second robot, of whose boards the one at the address of a robot's first board sends too."""

    def __init__(self, bench: FaultBench, scene: Scene) -> None:
        self._bench = bench
        self._alone = bench.robot.step
        self.other = Robot(bench.engine.settings, bench.layout, scene)
        self.other.bring_up()
        self.other.step(0.013)
        bench.robot.step = self._step  # type: ignore[method-assign]

    def end(self) -> None:
        self._bench.robot.step = self._alone  # type: ignore[method-assign]

    def _step(self, seconds: float) -> dict[str, FrameBatch]:
        batches = self._alone(seconds)
        (bus,) = batches
        mine, other = batches[bus], self.other.step(seconds)[bus]
        same = (other.id >> 4 & 0xF) == self._bench.layout.boards[0].settings.address
        t_ns = np.concatenate(
            [mine.t_ns, other.t_ns[same] - self.other.t_ns + self._bench.robot.t_ns]
        )
        order = np.argsort(t_ns, kind="stable")
        return {
            bus: FrameBatch(
                np.concatenate([mine.id, other.id[same]])[order],
                np.concatenate([mine.dlc, other.dlc[same]])[order],
                np.concatenate([mine.data, other.data[same]])[order],
                t_ns[order],
            )
        }


def pads_of(bench: FaultBench, board: int) -> np.ndarray:
    """Which of a board's pressure pads were valid in the last frames."""
    layout = bench.layout
    found = np.zeros(layout.n_taxels, np.bool_)
    for part in layout.parts:
        found[part.start : part.stop] = bench.valid[part.name]
    taxels = layout.boards[board].taxel_index
    taxels = taxels[taxels >= 0]
    return found[taxels[layout.pad_kind[taxels] == PadKind.PRESSURE]]


@pytest.mark.parametrize("quiet", [True, False])
def test_two_boards_at_one_address_are_called_by_name(quiet: bool) -> None:
    """Their frames cut each other's sweeps, which looks like losses of the bus. Nobody knows which
    of them a reading is of, so none is valid until one of them is gone.
    """
    bench = FaultBench(3.0, Scene(quiet=quiet, seed=1))
    before = pads_of(bench, 0)
    assert before.any()
    twins = TwoBoards(bench, Scene(quiet=quiet, seed=7))
    bench.run(3.0)
    bench.first_told.clear()
    name = bench.layout.boards[0].name
    for _ in range(40):
        bench.run(0.1)
        assert ("board_twice", name) in bench.told
        assert not pads_of(bench, 0).any()
        assert pads_of(bench, 1).any()
    codes = {code for code, _ in bench.told}
    assert not codes & {"bus_loses_frames", "board_period", "board_jitter", "taxel_unproven"}
    twins.end()
    bench.run(5.0)
    assert ("board_twice", name) not in bench.told
    assert pads_of(bench, 0).sum() >= before.sum() - 2


def press_on_hand(start_s: float) -> Probe:
    return Probe(
        part="left_hand",
        at=Place(triangle=4),
        diameter_mm=12,
        pressure_kpa=[(0, 0), (0.2, 60), (2.0, 60), (2.2, 0)],
        start_s=start_s,
    )


def test_what_pressed_one_of_two_boards_as_it_took_its_zero_accuses_no_pad() -> None:
    """Sweep by sweep its pads read far below zero, and as those of the other board."""
    press = press_on_hand(4.0)
    bench = FaultBench(3.0, Scene(quiet=True, seed=1))
    other = TwoBoards(bench, Scene(quiet=True, seed=7, probe=[press])).other
    name = bench.layout.boards[0].name
    bench.run(5.0 - other.t_ns / 1e9)
    assert ("board_twice", name) in bench.told
    other.inject(Fault(name="chip_gone", board=name, triangle=0, value=0))  # it takes a zero
    bench.first_told.clear()
    bench.run(5.0)
    assert ("board_twice", name) in bench.told
    assert bench.engine.ledger.far[bench.engine.ledger.row[0]].any()
    assert not {where for code, where in bench.first_told if "out_of_range" in code}


@pytest.mark.parametrize("sooner_ms", [30.0, 40.0])
def test_one_board_that_sends_far_too_often_is_not_called_two(
    bench: FaultBench, sooner_ms: float
) -> None:
    end = bench.inject("late_period", board="hand", value=-sooner_ms)
    bench.run(6.0)
    assert ("board_period", "hand") in bench.told
    assert "board_twice" not in {code for code, _ in bench.first_told}
    end()


def test_what_pressed_as_a_board_took_its_zero_is_no_fault_of_its_triangle() -> None:
    press = press_on_hand(9.0)
    bench = FaultBench(3.0, Scene(quiet=True, probe=[press]), settle_s=5.0)
    bench.run(10.0 - bench.t_s)
    assert bench.touched["left_hand"].any()
    bench.inject("chip_gone", board="hand", triangle=0, value=0)  # after which it takes a zero
    bench.run(5.0)
    assert ("board_in_doubt", "hand") in bench.told
    assert not {where for code, where in bench.first_told if "out_of_range" in code}
    assert not bench.valid["left_hand"][48:60].all()


def test_what_pressed_as_a_board_took_its_zero_hides_no_fault_of_the_chip() -> None:
    """Such pads read far below zero pressure; a chip that fails reads far above."""
    press = press_on_hand(9.0)
    bench = FaultBench(3.0, Scene(quiet=True, probe=[press]), settle_s=5.0)
    bench.run(10.0 - bench.t_s)
    bench.inject("chip_gone", board="hand", triangle=0, value=0)  # after which it takes a zero
    bench.run(5.0)
    mend = bench.inject("clock_stretched", board="hand", triangle=4)
    bench.run(1.0)
    assert ("board_in_doubt", "hand") in bench.told
    assert ("triangle_out_of_range", "hand/4") in bench.told
    mend()
    bench.run(1.0)
    assert ("board_in_doubt", "hand") in bench.told
    assert not {where for code, where in bench.told if "out_of_range" in code}


def test_a_board_that_floods_its_bus_is_named_and_the_other_is_served() -> None:
    """A chip has something new every 36.9 ms: nine sweeps a period tell no more than one."""
    bench = FaultBench(3.0)
    board, row = bench.layout.boards[1].name, bench.engine.ledger.row[1]
    ledger = bench.engine.ledger
    before = int(ledger.sweeps[row])
    end = bench.inject("late_period", board=board, value=-44.5)
    bench.run(8.0)
    sent = int(ledger.sweeps[row]) - before
    assert sent > 8.5 * 160
    assert sent - ledger.excess[row] <= 200 + MOST_OFTEN * 160 + 1
    assert ledger.excess[1 - row] == 0
    assert set(bench.told) == {("board_period", board)}
    part = next(
        record
        for record in bench.records.values()
        if board in {one["name"] for one in record["boards"]}
    )
    assert part["state"] == "warning"
    assert f"{ledger.excess[row]} of its sweeps" in " ".join(part["sentences"])
    assert pads_of(bench, 0).all()
    assert pads_of(bench, 1).all()
    end()
    bench.run(1.0)
    excess = int(ledger.excess[row])
    bench.run(65.0)
    assert ledger.excess[row] == excess
    assert not bench.told


def test_a_chip_that_does_not_answer_is_no_touch_when_its_board_was_zeroed() -> None:
    """What the board takes for its zero is none, so its pads read anything."""
    bench = bench_of("mtb4", "signal", touched=False)
    mend = bench.inject("no_acknowledge", board="one", triangle=3)
    bench.run(3.0)
    assert ("board_rezeroed", "one") in bench.told
    mend()
    bench.run(6.0)
    assert ("triangle_answers_again", "one/3") in bench.told
    assert "board_in_doubt" not in {code for code, _ in bench.first_told}


def test_a_triangle_of_a_bus_that_loses_frames_is_missing_where_chance_does_not_explain_it() -> (
    None
):
    """Three of its sweeps in a row are lost now and then; it is enabled all the same."""
    bench = bench_of("mtb4", "signal", touched=False)
    bench.inject("frame_loss", bus="can0", value=0.1)
    bench.run(40.0)
    assert {code for code, _ in bench.first_told} == {"bus_loses_frames"}
    step = bench.robot.step

    def without(seconds: float) -> dict[str, FrameBatch]:
        (batch,) = step(seconds).values()
        kept = batch.id & 0xFF != 1 << 4 | 3
        return {
            "can0": FrameBatch(
                batch.id[kept], batch.dlc[kept], batch.data[kept], batch.t_ns[kept].copy()
            )
        }

    bench.robot.step = without  # type: ignore[method-assign]
    bench.run(1.0)
    assert set(bench.told) == {("bus_loses_frames", "can0"), ("triangle_missing", "one/3")}
