"""Sweeps of boards become samples of parts, in order of time, and silence is told."""

import dataclasses
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skin_host.bus.assembler import Sweep
from skin_host.cli.common import load_skin
from skin_host.config.settings import Settings
from skin_host.layout import Layout, build_layout
from skin_host.processing.core import Engine
from skin_host.processing.intake import PartSample, below_zero, lifted, unpressable
from skin_host.processing.liveness import PROBATION_CHANGES

MS = 1_000_000
PERIOD = 50 * MS
DEMO = Path(__file__).parents[2] / "config/demo.toml"
OUTER, INNER = 1, 2


@cache
def skin():
    return load_skin(DEMO)


class Joined:
    """Ledger and intake of an engine, as its sweeps pass through them."""

    def __init__(
        self,
        parts: tuple[int, ...] = (1,),
        configured: tuple[Settings, Layout] | None = None,
    ) -> None:
        configuration, layout = configured or skin()
        self.engine = Engine(configuration, layout, list(parts))

    def feed(self, sweeps: list[Sweep]) -> list[PartSample]:
        return self.engine._take(sweeps)

    def expire(self, now_ns: int) -> list[PartSample]:
        self.engine.ledger.look(now_ns)
        return self.engine.intake.expire(now_ns)


def intake():
    """Of the forearm, both of whose boards have been received, and live."""
    parts = Joined()
    for t_ns in (1, 3):
        parts.feed([sweep(OUTER, t_ns), sweep(INNER, t_ns + 1)])
        parts.feed([sweep(OUTER, t_ns + 2, fill=239), sweep(INNER, t_ns + 3, fill=239)])
    parts.feed([sweep(OUTER, 7)])
    parts.engine.intake.flush()
    return parts


def sweep(board: int, t_ns: int, status: int = 0, fill: int = 240) -> Sweep:
    triangles = 16 if board == OUTER else 8
    raw = np.full((16, 12), fill, np.uint8)
    words = np.full(16, status, np.uint16)
    return Sweep(board, raw, words, (1 << triangles) - 1, t_ns, 0)


def test_a_part_of_two_boards_waits_for_both():
    parts = intake()
    assert parts.feed([sweep(OUTER, PERIOD)]) == []
    (sample,) = parts.feed([sweep(INNER, PERIOD + 3 * MS)])
    assert sample.t_ns == PERIOD + 3 * MS
    assert sample.present.all()
    assert (sample.raw == 240).all()


@pytest.mark.parametrize(("fast_ms", "slow_ms"), [(20, 25), (20, 50), (10, 200)])
def test_boards_of_a_part_with_different_periods_are_valid_in_every_sample(
    fast_ms: int, slow_ms: int
) -> None:
    """A sample comes with each sweep of the slower board, and has the newest of the other one."""
    configured, _ = skin()
    boards = dict(configured.boards)
    for name, period_ms in zip(("forearm_outer", "forearm_inner"), (fast_ms, slow_ms), strict=True):
        boards[name] = msgspec.structs.replace(boards[name], period_ms=period_ms)
    configured = msgspec.structs.replace(configured, boards=boards)
    parts = Joined(configured=(configured, build_layout(configured, DEMO.parent)))
    sent = [
        sweep(OUTER, (t_ms + 1) * MS, fill=230 + t_ms // fast_ms % 9)
        for t_ms in range(0, 2000, fast_ms)
    ]
    sent += [
        sweep(INNER, (t_ms + 4) * MS, fill=230 + t_ms // slow_ms % 9)
        for t_ms in range(0, 2000, slow_ms)
    ]
    sent.sort(key=lambda one: one.t_ns)
    samples: list[PartSample] = []
    newest = 0
    for one in sent:
        newest = one.raw[0, 0] if one.board == OUTER else newest
        came = parts.feed([one])
        assert len(came) == (one.board == INNER)
        assert all(sample.raw[0] == newest for sample in came)
        # A board lives from its third sweep on.
        assert all(sample.present.all() for sample in came if len(samples) > 2)
        samples += came + parts.expire(one.t_ns)
    assert len(samples) == 2000 // slow_ms


def test_a_dead_board_is_waited_for_no_longer_than_its_second_turn():
    parts = intake()
    assert parts.feed([sweep(OUTER, 2 * PERIOD)]) == []
    (sample,) = parts.feed([sweep(OUTER, 3 * PERIOD)])
    assert sample.present[: 16 * 12].all()
    assert not sample.present[16 * 12 :].any()
    assert (sample.raw[: 16 * 12] == 240).all()
    assert not sample.raw[16 * 12 :].any()


def test_a_part_names_the_boards_whose_sweeps_its_sample_waits_for() -> None:
    parts = intake()
    inner = parts.engine.intake
    for board, left in ((OUTER, [INNER]), (INNER, [OUTER, INNER])):
        parts.feed([sweep(board, PERIOD)])
        assert [sorted(waits) for waits in inner.missing()] == [left]
    parts.feed([sweep(OUTER, 2 * PERIOD)])
    configuration, layout = skin()
    after = Engine(configuration, layout, [1], after=parts.engine)
    assert [sorted(waits) for waits in after.intake.missing()] == [[INNER]]


def test_sweeps_from_before_and_after_a_pause_are_no_one_sample():
    """Nothing of the time between was received, and both are read at once."""
    parts = intake()
    assert parts.feed([sweep(OUTER, 2 * PERIOD)]) == []
    (before,) = parts.feed([sweep(INNER, 22 * PERIOD)])
    assert before.t_ns == 2 * PERIOD
    assert before.present[: 16 * 12].all()
    assert not before.present[16 * 12 :].any()
    (after,) = parts.feed([sweep(OUTER, 22 * PERIOD + 3 * MS)])
    assert after.t_ns == 22 * PERIOD + 3 * MS
    assert after.present.all()


@pytest.mark.parametrize("direction", [1, -1])
def test_a_sample_waits_for_a_whole_period_of_a_clock_that_may_be_set_back(direction: int):
    parts = intake()
    assert parts.feed([sweep(OUTER, 2 * PERIOD)]) == []
    for waited_ns in (0, 1, PERIOD - MS, PERIOD):
        assert parts.engine.intake.expire(2 * PERIOD + direction * waited_ns) == []
    (sample,) = parts.engine.intake.expire(2 * PERIOD + direction * (PERIOD + 1))
    assert sample.present[: 16 * 12].all()
    assert not sample.present[16 * 12 :].any()


def test_what_the_board_doubts_is_not_present():
    (sample,) = intake().feed([sweep(OUTER, PERIOD, status=2), sweep(INNER, PERIOD)])
    assert not sample.present[: 16 * 12].any()
    assert sample.present[16 * 12 :].all()


def test_a_silent_part_says_so_at_once_and_then_once_a_second():
    parts = intake()
    parts.feed([sweep(OUTER, PERIOD), sweep(INNER, PERIOD)])
    said: list[PartSample] = []
    for t_ms in range(60, 2500, 20):
        said += parts.expire(t_ms * MS)
    assert len(said) == 3
    assert not any(sample.present.any() for sample in said)
    assert said[0].t_ns <= PERIOD + 4 * PERIOD


def test_a_part_that_is_silent_holds_up_no_other() -> None:
    parts = Joined((0, 1))
    said: list[PartSample] = []
    for turn in range(1, 10):
        parts.feed([sweep(OUTER, turn * PERIOD), sweep(INNER, turn * PERIOD)])
        said += parts.expire(turn * PERIOD)
    assert [sample.part for sample in said] == [0]
    parts.feed([sweep(OUTER, 10 * PERIOD)])
    (sample,) = parts.expire(11 * PERIOD + 1)
    assert sample.part == 1


@given(
    lateness=st.lists(st.tuples(st.integers(0, 80), st.integers(0, 80)), min_size=3, max_size=12)
)
@settings(max_examples=40, deadline=None)
def test_times_of_a_part_only_rise_however_late_its_boards_are(lateness):
    arrivals = []
    latest_ns = {OUTER: 0, INNER: 0}
    for turn, (outer_ms, inner_ms) in enumerate(lateness, start=1):
        for board, offset_ms, late_ms in ((OUTER, 0, outer_ms), (INNER, 15, inner_ms)):
            t_ns = turn * PERIOD + offset_ms * MS
            # A board's own sweeps come in order.
            latest_ns[board] = max(latest_ns[board], t_ns + late_ms * MS)
            arrivals.append((latest_ns[board], sweep(board, t_ns)))
    parts = intake()
    times = []
    for now_ns, one in sorted(arrivals, key=lambda arrival: arrival[0]):
        times += [sample.t_ns for sample in parts.feed([one]) + parts.expire(now_ns)]
    assert all(np.diff(times) > 0)


def test_what_sweeps_say_of_a_chips_life_holds_from_the_next_one_on():
    """And does so whether it is worked out at once or when the next sweep comes."""
    rng = np.random.default_rng(1)
    lazy, eager = intake(), intake()
    frozen_at = None
    for turn in range(1, 120):
        one = sweep(OUTER, turn * PERIOD)
        one.raw[:] = rng.normal(240.0, 1.0, one.raw.shape).round()
        one.raw[3] = 200  # a triangle that repeats itself for ever
        samples = [parts.feed([one]) + parts.expire((turn + 1) * PERIOD) for parts in (lazy, eager)]
        eager.engine.intake.judge()
        for mine, its in zip(*samples, strict=True):
            assert (mine.present == its.present).all()
        dead = eager.engine.intake.liveness.frozen[3]
        believed = [sample.present[3 * 12 : 4 * 12].any() for sample in samples[1]]
        if frozen_at is None and dead:
            frozen_at = turn
        elif frozen_at is not None:
            assert not any(believed), turn
        else:
            assert all(believed[-1:]), turn
    assert frozen_at is not None


def test_chips_are_judged_as_soon_as_every_board_that_sends_has_sent() -> None:
    parts = intake()
    inner = parts.engine.intake
    inner.judge()
    for turn in range(1, 4):
        assert not inner.is_whole
        parts.feed([sweep(OUTER, turn * PERIOD)])
        assert not inner.is_whole
        parts.feed([sweep(INNER, turn * PERIOD + MS)])
        assert inner.is_whole
        inner.judge_whole()
    # A board that has timed out is not waited for.
    for turn in range(4, 12):
        parts.engine.ledger.look(turn * PERIOD)
        parts.feed([sweep(OUTER, turn * PERIOD)])
    assert parts.engine.ledger.any_silent
    assert inner.is_whole


@pytest.mark.parametrize("row", [0, 1])
def test_while_a_board_is_touched_its_other_chips_may_repeat_for_longer(row: int) -> None:
    parts = intake()
    touched = np.zeros((16, 12), np.bool_)
    touched[1, 0] = True
    parts.engine.intake.touched[row] = touched
    for turn in range(1, 25):
        samples = parts.feed([sweep(OUTER, turn * PERIOD), sweep(INNER, turn * PERIOD)])
    parts.engine.intake.judge()
    frozen = np.flatnonzero(parts.engine.intake.liveness.frozen).tolist()
    # The touch may be the dead chip's own.
    of_boards = [list(range(16)), list(range(16, 24))]
    of_boards[row] = [16 * row + 1]
    assert frozen == of_boards[0] + of_boards[1]
    present = samples[-1].present.reshape(-1, 12).all(axis=1)
    assert np.flatnonzero(~present).tolist() == frozen


def test_a_chip_that_reports_an_error_is_not_said_to_repeat_itself() -> None:
    """Its bytes do not change because it does not answer, and its board says so."""
    parts = intake()
    for turn in range(1, 60):
        inner = sweep(INNER, turn * PERIOD)
        inner.status[3] = 2
        outer = sweep(OUTER, turn * PERIOD)
        outer.status[5] = 1
        parts.feed([outer, inner])
    parts.engine.intake.judge()
    frozen = parts.engine.intake.liveness.frozen
    assert np.flatnonzero(~frozen[:24]).tolist() == [5, 16 + 3]


@pytest.mark.parametrize("eager", [False, True])
def test_a_chip_that_reported_an_error_in_one_sweep_is_invalid_until_its_bytes_change(
    eager: bool,
) -> None:
    """And is so whether that is judged at once or when the next sweep comes."""
    parts = intake()
    sent = [(1, 0), (2, 0), (2, 0), (None, 0), (None, 1), (None, 2), (None, 3), (None, 4)]
    invalid = []
    for turn, (erring, change) in enumerate(sent, start=1):
        outer = sweep(OUTER, turn * PERIOD)
        outer.raw[1] += change
        if erring is not None:
            outer.status[erring] = 2
        (sample,) = parts.feed([outer, sweep(INNER, turn * PERIOD)])
        invalid.append(np.flatnonzero(~sample.present.reshape(-1, 12).all(axis=1)).tolist())
        if eager:
            parts.engine.intake.judge()
    assert invalid == [[1], [1, 2], [1, 2], [1, 2], [1, 2], [1, 2], [1, 2], [2]]


@pytest.mark.parametrize("eager", [False, True])
def test_what_had_an_error_is_not_valid_after_a_calibration_before_it_changes(eager: bool) -> None:
    """Judged already or not: a calibration goes on with what was known of a chip that is mute."""
    parts = intake()
    joined = parts.engine.intake
    parts.feed([sweep(board, PERIOD, status=2) for board in (OUTER, INNER)])
    if eager:
        joined.judge()
    noise = np.full(parts.engine.layout.n_taxels, 0.5)
    joined.use(noise, np.array([True, False]))
    (sample,) = parts.feed([sweep(board, 2 * PERIOD) for board in (OUTER, INNER)])
    assert not sample.present.any()
    for turn in range(3, 3 + PROBATION_CHANGES + 1):
        outer, inner = (sweep(board, turn * PERIOD) for board in (OUTER, INNER))
        outer.raw[:] += turn % 2
        (sample,) = parts.feed([outer, inner])
    assert sample.present[: 16 * 12].all()
    assert not sample.present[16 * 12 :].any()


def test_a_veto_makes_a_taxel_invalid_that_was_received() -> None:
    parts = intake()
    vetoed = np.zeros((16, 12), np.bool_)
    vetoed[2, 3] = True
    parts.engine.intake.veto[0] = vetoed
    (sample,) = parts.feed([sweep(OUTER, PERIOD), sweep(INNER, PERIOD)])
    assert np.flatnonzero(~sample.present).tolist() == [2 * 12 + 3]
    assert sample.received.all()


def test_a_veto_holds_for_as_long_as_it_is_there_whatever_was_vetoed_before() -> None:
    parts = intake()
    for turn, pad in enumerate((5, 7, 7, 5, 190), start=1):
        vetoed = np.zeros((16, 12), np.bool_)
        vetoed.flat[pad] = True
        parts.engine.intake.veto[0] = vetoed
        (sample,) = parts.feed([sweep(OUTER, turn * PERIOD), sweep(INNER, turn * PERIOD)])
        assert np.flatnonzero(~sample.present).tolist() == [pad]
    erring = sweep(OUTER, 6 * PERIOD)
    erring.status[2] = 2
    (sample,) = parts.feed([erring, sweep(INNER, 6 * PERIOD)])
    assert np.flatnonzero(~sample.present).tolist() == [*range(24, 36), 190]
    assert np.flatnonzero(~sample.received).tolist() == [*range(24, 36)]
    del parts.engine.intake.veto[0]
    (sample,) = parts.feed([sweep(OUTER, 7 * PERIOD), sweep(INNER, 7 * PERIOD)])
    assert np.flatnonzero(~sample.present).tolist() == [*range(24, 36)]


def test_a_pad_that_its_board_marks_as_far_out_of_range_is_invalid_in_those_sweeps() -> None:
    parts = intake()
    for turn, pad in enumerate((3, 5, 5, 3, 0, 11), start=1):
        outer = sweep(OUTER, turn * PERIOD)
        outer.status[1] = 1 << 4 + pad
        (sample,) = parts.feed([outer, sweep(INNER, turn * PERIOD)])
        assert np.flatnonzero(~sample.present).tolist() == [12 + pad]


def test_a_sample_in_progress_goes_on_with_changed_settings() -> None:
    parts = intake()
    assert parts.feed([sweep(OUTER, PERIOD, fill=230)]) == []
    configuration, layout = skin()
    parts.engine = Engine(configuration, layout, [1], after=parts.engine)
    (sample,) = parts.feed([sweep(INNER, PERIOD + 3 * MS)])
    assert sample.present.all()
    assert (sample.raw[: 16 * 12] == 230).all()
    assert sample.t_ns == PERIOD + 3 * MS


def test_single_pads_far_below_zero_are_named_and_those_of_another_chip_are_not() -> None:
    raw = np.full((3, 12), 255, np.uint8)
    raw[0, 0] = 254
    far_pads = np.arange(12) < np.array([[6], [7], [0]])
    found = below_zero(raw, far_pads)
    assert np.argwhere(found).tolist() == [[0, pad] for pad in range(1, 6)]


def test_pads_are_lifted_off_by_another_chip_if_two_are_or_one_among_seven_far_ones() -> None:
    raw = np.zeros((5, 12), np.uint8)
    raw[[0, 1, 2, 4], 0] = 255
    raw[[2, 4], 1] = 255
    raw[4, 2] = 255
    far_pads = np.arange(12) < np.array([[6], [7], [2], [12], [3]])
    assert lifted(raw, far_pads).tolist() == [False, True, True, False, True]


def far(pads: int) -> int:
    """A status word that calls the first pads far out of range."""
    return ((1 << pads) - 1) << 4


def test_a_triangle_far_out_of_range_both_ways_is_not_pressed_but_dead():
    """Its other pads stand at the end of the scale, as if pressed as hard as can be."""
    dead = sweep(OUTER, PERIOD, status=far(9), fill=0)
    dead.raw[:, 0] = 255
    (sample,) = intake().feed([dead, sweep(INNER, PERIOD)])
    assert not sample.present[: 16 * 12].any()


def test_pads_that_say_more_than_any_press_could_are_a_dead_chips() -> None:
    """Shift 2: far is 691 fF, of pads that end at 360 fF. Three of twelve still look pressed."""
    (sample,) = intake().feed([sweep(OUTER, PERIOD, status=far(9), fill=0), sweep(INNER, PERIOD)])
    assert not sample.present[: 16 * 12].any()


def test_fine_scales_can_be_pressed_far_out() -> None:
    """Shift 0, as on some fingertips: far is 173 fF, and what is left of the triangle counts."""
    _, layout = skin()
    fine = dataclasses.replace(layout, unit_ff=np.full(layout.n_taxels, 0.36))
    assert not unpressable(fine, OUTER, 360.0).any()
    # The limit is half as much again as the end of the curve of pads of 0.73: 395 fF.
    for unit_ff, beyond in ((0.8, False), (0.85, True)):
        coarse = dataclasses.replace(layout, unit_ff=np.full(layout.n_taxels, unit_ff))
        assert unpressable(coarse, OUTER, 360.0).all() == beyond
    assert unpressable(layout, OUTER, 360.0).all()


def test_a_torn_pad_does_not_silence_the_pressed_ones_beside_it():
    torn = sweep(OUTER, PERIOD, status=far(4), fill=0)
    torn.raw[:, 0] = 255
    (sample,) = intake().feed([torn, sweep(INNER, PERIOD)])
    assert sample.present[: 16 * 12].reshape(16, 12)[:, 4:].all()
    assert not sample.present[: 16 * 12].reshape(16, 12)[:, :4].any()


def both(turn: int, pads: int, byte: int, status: int = 0) -> list[Sweep]:
    """Sweeps in which the first pads of a triangle have this byte, and marked ones the last."""
    outer, inner = (sweep(board, turn * PERIOD, fill=239 + turn % 2) for board in (OUTER, INNER))
    outer.raw[1, :pads] = byte
    outer.raw[1, np.arange(12)[status >> np.arange(4, 16) & 1 == 1]] = 0
    outer.status[1] = status
    return [outer, inner]


def pressed_far(pads: int, status: int) -> tuple[Joined, PartSample]:
    """Pads of a triangle go far out of range, the first ones having been pressed."""
    parts = intake()
    touched = np.zeros((16, 12), np.bool_)
    touched[1, :pads] = True
    for turn, byte in enumerate((150, 60, 0, 0), start=1):
        parts.feed(both(turn, pads, byte))
        parts.engine.intake.touched[0] = touched
    for turn in range(5, 20):
        (sample,) = parts.feed(both(turn, pads, 0, status))
    return parts, sample


@pytest.mark.parametrize("pads", [1, 4, 8, 12])
def test_pads_that_are_pressed_far_out_of_range_are_valid_and_of_no_calibration(pads: int) -> None:
    """However many they are: a chip is dead whose other pads are far."""
    parts, sample = pressed_far(pads, far(pads))
    assert sample.present.all()
    assert np.flatnonzero(~sample.received).tolist() == list(range(12, 12 + pads))
    assert parts.engine.intake.takes(0, 1)


def test_pads_that_went_far_at_once_are_not_valid_beside_those_that_are_pressed_there() -> None:
    _, sample = pressed_far(4, far(12))
    assert np.flatnonzero(~sample.present).tolist() == list(range(12, 24))


def test_what_is_pressed_far_goes_on_with_changed_settings_and_not_after_a_calibration() -> None:
    parts, _ = pressed_far(2, far(2))
    configuration, layout = skin()
    parts.engine = Engine(configuration, layout, [1], after=parts.engine)
    (sample,) = parts.feed(both(20, 2, 0, far(2)))
    assert sample.present.all()
    parts.engine.intake.use(np.full(layout.n_taxels, 0.5), np.ones(2, np.bool_))
    for turn in range(21, 40):
        (sample,) = parts.feed(both(turn, 2, 0, far(2)))
        assert np.flatnonzero(~sample.present).tolist() == [12, 13]


def test_what_two_boards_at_one_address_send_is_no_press() -> None:
    parts, _ = pressed_far(2, far(2))
    parts.engine.ledger.twice = {0: 0}
    parts.feed(both(20, 2, 0, far(2)))
    parts.engine.ledger.twice = {}
    for turn in range(21, 40):
        (sample,) = parts.feed(both(turn, 2, 0, far(2)))
    assert np.flatnonzero(~sample.present).tolist() == [12, 13]


def test_what_is_pressed_far_is_so_after_a_sweep_that_lacks_its_triangle() -> None:
    """And has no marks therefore."""
    parts, _ = pressed_far(2, far(2))
    outer, inner = both(20, 12, 0)
    (sample,) = parts.feed([outer._replace(present=outer.present & ~2), inner])
    assert np.flatnonzero(~sample.present).tolist() == list(range(12, 24))
    (sample,) = parts.feed(both(21, 2, 0, far(2)))
    assert sample.present.all()


def test_a_gap_before_a_sweep_is_no_gap_before_the_one_that_is_not_judged_yet():
    """A board that sends twice in the turn of another: its first sweep still waits."""
    parts = intake()
    joined = parts.engine.intake
    joined.use(np.full(parts.engine.layout.n_taxels, 0.5), np.ones(2, np.bool_))
    for turn in range(1, 4):
        parts.feed([sweep(OUTER, turn * PERIOD), sweep(INNER, turn * PERIOD)])
        joined.judge_whole()
    away = sweep(OUTER, 4 * PERIOD)
    away.raw[1, 4] -= 40
    parts.feed([away])
    joined.note_gap(parts.engine.ledger.row[OUTER])
    for turn in range(5, 40):
        parts.feed([sweep(OUTER, turn * PERIOD), sweep(INNER, turn * PERIOD)])
    joined.judge()
    assert joined.liveness.spikes.sum() == 0


def test_readings_of_two_boards_at_one_address_show_nothing_until_one_is_gone() -> None:
    parts = intake()
    joined, ledger = parts.engine.intake, parts.engine.ledger
    for turn in range(1, 100):
        two = 20 <= turn < 80
        ledger.twice = {0: 0} if two else {}
        outer, inner = sweep(OUTER, turn * PERIOD), sweep(INNER, turn * PERIOD)
        if not two:
            outer.raw[:] += turn % 3
        inner.raw[:] += turn % 3
        (sample,) = parts.feed([outer, inner])
        joined.judge()
        assert sample.present[16 * 12 :].all()
        assert sample.present[: 16 * 12].all() != two
        assert sample.received[: 16 * 12].any() != two
        assert joined.takes(0, 3) != two
        # Not even that its bytes repeat.
        assert not joined.liveness.frozen.any()
    # The board whose readings were taken before is judged again.
    for turn in range(100, 140):
        inner = sweep(INNER, turn * PERIOD)
        inner.raw[:] += turn % 3
        parts.feed([sweep(OUTER, turn * PERIOD), inner])
        joined.judge()
    assert np.flatnonzero(joined.liveness.frozen).tolist() == [*range(16)]


def test_what_a_board_sent_last_is_judged_once_however_often_others_send() -> None:
    parts = intake()
    joined = parts.engine.intake
    for turn in range(1, 60):
        outer = sweep(OUTER, turn * PERIOD)
        outer.raw[:] += turn % 3
        parts.feed([outer])
        joined.judge()
    assert not joined.liveness.frozen.any()


@pytest.mark.parametrize("status", [2, 0x30])
def test_readings_of_a_triangle_are_not_taken_in_the_sweep_that_its_status_word_doubts(
    status: int,
) -> None:
    parts = intake()
    joined = parts.engine.intake
    taken = []
    for turn, word in enumerate((0, status, 0, 0), start=1):
        outer = sweep(OUTER, turn * PERIOD)
        outer.raw[:] += turn % 3
        outer.status[3] = word
        if word & 0x30:
            outer.raw[3, :2] = 255
        parts.feed([outer, sweep(INNER, turn * PERIOD)])
        assert joined.takes(0, 4)
        taken.append(joined.takes(0, 3))
    assert taken == [True, False, True, True]


@pytest.mark.parametrize("marked", [0x30, far(9)])
def test_readings_of_a_triangle_at_the_edge_of_another_chips_range_stay_untaken(
    marked: int,
) -> None:
    """Noise decides which sweeps mark enough pads: the others are no less another chip's."""
    parts = intake()
    taken = []
    for turn in range(1, 30):
        outer = sweep(OUTER, turn * PERIOD, fill=239 + turn % 2)
        if turn in (1, 4, 7):
            outer.status[3] = marked
            outer.raw[3, :2] = 255
        (sample,) = parts.feed([outer, sweep(INNER, turn * PERIOD, fill=239 + turn % 2)])
        present = sample.present.reshape(-1, 12)
        assert present[4].all()
        assert present[3].all() == present[3].any() == parts.engine.intake.takes(0, 3)
        taken.append(bool(present[3].any()))
    # Once may be a damaged byte. After a second without it is believed again.
    assert np.flatnonzero(taken).tolist() == [1, 2, *range(26, 29)]


def test_a_calibration_believes_a_triangle_again() -> None:
    parts = intake()
    joined = parts.engine.intake
    for turn in (1, 2):
        outer = sweep(OUTER, turn * PERIOD)
        outer.status[3], outer.raw[3, :2] = 0x30, 255
        parts.feed([outer, sweep(INNER, turn * PERIOD)])
    joined.use(None, np.ones(2, np.bool_))
    parts.feed([sweep(OUTER, 3 * PERIOD)])
    assert joined.takes(0, 3)
