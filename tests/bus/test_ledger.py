"""What is concluded from the sweeps of boards: silence, period, what is missing."""

from itertools import accumulate

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.bus.assembler import Sweep
from skin_host.bus.ledger import LONGEST_PAUSE_NS, BoardLedger
from skin_host.config.settings import load
from skin_host.layout import build_layout
from tests.support.stack import ROOT

CONFIG = ROOT / "config" / "demo.toml"
MS = 1_000_000
PERIOD = 50 * MS
SILENT_PERIODS = 4.0
T0 = 1_700_000_000_000_000_000
HAND, OUTER = 0, 1


def ledger() -> BoardLedger:
    layout = build_layout(load(CONFIG), CONFIG.parent)
    return BoardLedger(list(enumerate(layout.boards)), SILENT_PERIODS)


def enabled(board: int) -> int:
    return build_layout(load(CONFIG), CONFIG.parent).boards[board].enabled


def sweep(board: int, t_ns: int, present: int | None = None, status: int = 0) -> Sweep:
    mask = enabled(board) if present is None else present
    words = np.full(16, status, np.uint16)
    return Sweep(board, np.zeros((16, 12), np.uint8), words, mask, t_ns, 0)


def after(intervals_ms: list[float]) -> BoardLedger:
    """A board set to 50 ms whose sweeps came so far apart."""
    known = ledger()
    for t_ms in accumulate(intervals_ms, initial=0.0):
        known.note(sweep(HAND, T0 + round(t_ms * 1e6)))
    return known


@pytest.mark.parametrize("period_ms", [20.0, 37.0, 50.0, 100.0])
def test_a_regular_period_is_recognised(period_ms: float) -> None:
    assert after([period_ms] * 16).regular_period_ns(HAND) == pytest.approx(period_ms * 1e6)


@pytest.mark.parametrize(
    "intervals_ms",
    [
        # Too few to say anything.
        [20.0] * 6,
        # Held up now and then, and sent in bunches.
        [140.0, 5.0, 5.0] * 5,
        # One long pause.
        [20.0] * 15 + [3000.0],
    ],
)
def test_sweeps_that_are_held_up_have_no_regular_period(intervals_ms: list[float]) -> None:
    assert after(intervals_ms).regular_period_ns(HAND) is None


def test_jitter_does_not_hide_the_period() -> None:
    assert after([49.0, 51.5] * 8).regular_period_ns(HAND) == pytest.approx(50e6, rel=0.03)


def test_triangles_that_never_come_are_missing_and_those_of_cut_sweeps_are_not() -> None:
    known, all_of = ledger(), enabled(HAND)
    lowest = all_of & -all_of
    times = (T0 + turn * PERIOD for turn in range(100))
    for turn in range(8):
        known.note(sweep(HAND, next(times), all_of & ~lowest if turn % 2 else lowest))
        assert known.missing(HAND) == 0
    for _ in range(8):
        known.note(sweep(HAND, next(times), all_of & ~lowest))
    assert known.missing(HAND) == lowest
    known.set_up(HAND)
    assert known.missing(HAND) == 0


def test_a_board_is_silent_after_its_periods_and_no_other() -> None:
    known = ledger()
    for turn in range(20):
        for board in (HAND, OUTER) if turn < 10 else (HAND,):
            known.note(sweep(board, T0 + turn * PERIOD))
        quiet = max(0, turn - 9)
        assert known.silent.tolist()[:2] == [False, quiet > SILENT_PERIODS]
        assert known.is_silent(OUTER) == (quiet > SILENT_PERIODS)


@pytest.mark.parametrize("jump_s", [-86_400, -3600, -2, 3600, 86_400])
def test_a_clock_that_is_set_makes_nobody_silent_nor_alive(jump_s: int) -> None:
    known = ledger()
    now_ns = T0
    for _ in range(8):
        now_ns += PERIOD
        known.look(now_ns)
        known.note(sweep(HAND, now_ns))
    assert known.silent.tolist()[:2] == [False, True]
    now_ns += jump_s * 1_000_000_000
    known.look(now_ns)
    assert known.silent.tolist()[:2] == [False, True]
    for _ in range(10):
        now_ns += PERIOD
        known.look(now_ns)
    assert known.silent.all()


@given(
    st.lists(
        st.one_of(
            st.integers(-(10**15), 10**15),
            st.integers(-30 * MS, 60 * MS),
        )
    )
)
def test_the_ledgers_clock_never_runs_back_nor_faster_than_its_limit(steps: list[int]) -> None:
    known = ledger()
    t_ns = T0
    for step in steps:
        t_ns += step
        before = known.now_ns
        known.look(t_ns)
        assert 0 <= known.now_ns - before <= LONGEST_PAUSE_NS


def test_time_stamps_of_two_buses_that_are_read_in_turn_are_not_counted_twice() -> None:
    known = ledger()
    for turn in range(10):
        for board in (HAND, OUTER):
            for part in range(5):
                known.note(sweep(board, T0 + (5 * turn + part) * PERIOD))
    assert known.now_ns <= 50 * PERIOD


def test_status_words_stand_until_the_next_sweep() -> None:
    known = ledger()
    assert not known.flagged[HAND]
    known.note(sweep(HAND, T0, status=0x8011))
    assert known.flagged[HAND]
    assert set(known.error[HAND].tolist()) == {1}
    assert np.flatnonzero(known.far[HAND, 3]).tolist() == [0, 11]
    known.note(sweep(HAND, T0 + PERIOD))
    assert not known.flagged[HAND]
    assert not known.error.any()
    assert not known.far.any()
