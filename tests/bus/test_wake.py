"""When the ports are read: right after each sweep, seldom otherwise, never in a tight loop."""

import asyncio
from itertools import pairwise, permutations

import pytest

from skin_host.bus.wake import (
    GIVE_UP_NS,
    GUARD_NS,
    LONGEST_NS,
    RETRY_NS,
    SEARCH_NS,
    SLIP_NS,
    Plan,
    WakeUp,
)
from skin_host.clock import SteppedClock
from skin_host.config.settings import Receive
from tests.support.stepped import stepped
from tests.support.waiting import PATIENCE_S

MS = 1_000_000
PERIOD = 50 * MS
POLL = 4 * MS
T0 = 1_700_000_000_000_000_000


def test_without_knowledge_it_polls():
    plan = Plan({0: PERIOD}, POLL)
    assert plan.next_ns(T0) == T0 + POLL


def test_the_next_sweep_is_read_when_its_last_frame_is_due():
    plan = Plan({0: PERIOD}, POLL)
    plan.sweep_ended(0, T0)
    now = T0 + PERIOD - 2 * MS
    assert plan.next_ns(now) == T0 + PERIOD + GUARD_NS


def test_between_sweeps_it_sleeps_long_only_if_every_board_is_known():
    plan = Plan({0: PERIOD, 1: PERIOD}, POLL)
    plan.sweep_ended(0, T0)
    assert plan.next_ns(T0) == T0 + POLL
    plan.sweep_ended(1, T0 + MS)
    once_between = plan.next_ns(T0 + MS)
    assert once_between == T0 + MS + (PERIOD + GUARD_NS - MS) // 2
    assert plan.next_ns(once_between) == T0 + PERIOD + GUARD_NS


@pytest.mark.parametrize("order", list(permutations((0, 1, 2))))
def test_boards_of_one_sample_are_read_with_the_last_but_one_and_the_last(order: tuple[int, ...]):
    missing = [list(order), [3]]
    plan = Plan(dict.fromkeys(range(4), PERIOD), POLL, lambda: missing)
    for board, at_ms in ((0, 0), (3, 5), (1, 10), (2, 20)):
        plan.sweep_ended(board, T0 + at_ms * MS)
    again = T0 + PERIOD
    assert plan.next_ns(again - MS) == again + 5 * MS + GUARD_NS
    plan.sweep_ended(0, again)
    plan.sweep_ended(3, again + 5 * MS)
    missing[0].remove(0)
    assert plan.next_ns(again + 6 * MS) == again + 10 * MS + GUARD_NS
    plan.sweep_ended(1, again + 10 * MS)
    missing[0].remove(1)
    assert plan.next_ns(again + 11 * MS) == again + 20 * MS + GUARD_NS


def test_a_sample_is_not_planned_by_a_board_that_is_silent():
    plan = Plan({0: PERIOD, 1: PERIOD}, POLL, lambda: [[0, 1]])
    plan.sweep_ended(0, T0)
    assert plan.next_ns(T0 + PERIOD - MS) == T0 + PERIOD + GUARD_NS


def test_a_late_sweep_is_looked_for_again_ever_more_seldom_then_no_more():
    plan = Plan({0: PERIOD}, POLL)
    plan.sweep_ended(0, T0)
    due = T0 + PERIOD
    now = due + GUARD_NS
    waits = []
    while now - due < GIVE_UP_NS:
        then = plan.next_ns(now)
        waits.append(then - now)
        now = then
    assert waits[0] == RETRY_NS
    assert waits == sorted(waits)
    assert len(waits) < 8
    assert plan.next_ns(now) == now + POLL


def test_a_board_that_stays_away_is_looked_for_less_often_until_it_sends():
    plan = Plan({0: PERIOD, 1: PERIOD}, POLL)
    plan.sweep_ended(1, T0)
    assert plan.next_ns(T0) == T0 + POLL
    later = T0 + SEARCH_NS
    plan.sweep_ended(1, later)
    assert plan.next_ns(later) == later + LONGEST_NS
    plan.sweep_ended(0, later + MS)
    back = later + MS + SEARCH_NS
    assert plan.next_ns(back) <= back + POLL


def test_one_late_sweep_does_not_delay_the_next():
    plan = Plan({0: PERIOD}, POLL)
    plan.sweep_ended(0, T0)
    plan.sweep_ended(0, T0 + PERIOD + 3 * MS)
    now = T0 + 2 * PERIOD - MS
    assert plan.next_ns(now) == T0 + 2 * PERIOD + SLIP_NS + GUARD_NS


@pytest.mark.parametrize("late", [PERIOD // 2, PERIOD * 3 // 4, PERIOD + MS, 7 * PERIOD])
def test_a_sweep_that_is_late_by_half_a_period_or_more_begins_a_new_beat(late: int) -> None:
    plan = Plan({0: PERIOD}, POLL)
    plan.sweep_ended(0, T0)
    came = T0 + PERIOD + late
    plan.sweep_ended(0, came)
    assert plan.next_ns(came + PERIOD - MS) == came + PERIOD + GUARD_NS


@pytest.mark.parametrize("ppm", [-1000, 0, 900])
def test_a_board_with_another_clock_is_followed(ppm):
    plan = Plan({0: PERIOD}, POLL)
    real_period = PERIOD + PERIOD * ppm // 1_000_000
    end = T0
    for _ in range(200):
        plan.sweep_ended(0, end)
        end += real_period
    assert abs(plan.next_ns(end - 2 * MS) - end) <= GUARD_NS + 2 * SLIP_NS


def test_a_board_that_was_away_is_followed_from_its_return():
    plan = Plan({0: PERIOD}, POLL)
    plan.sweep_ended(0, T0)
    back = T0 + 40 * PERIOD + 17 * MS
    plan.next_ns(back)
    plan.sweep_ended(0, back)
    assert plan.next_ns(back + PERIOD - MS) == back + PERIOD + GUARD_NS


def test_a_clock_that_jumps_back_costs_at_most_the_longest_wait():
    plan = Plan({0: PERIOD}, POLL)
    plan.sweep_ended(0, T0)
    long_ago = T0 - 3600 * 1_000_000_000
    assert long_ago < plan.next_ns(long_ago) <= long_ago + LONGEST_NS


async def test_work_is_called_again_and_again():
    calls = 0
    enough = asyncio.Event()

    def work() -> None:
        nonlocal calls
        calls += 1
        if calls == 5:
            enough.set()

    running = asyncio.create_task(WakeUp(Receive(poll_ms=1.0), {}).run(work))
    async with asyncio.timeout(PATIENCE_S):
        await enough.wait()
    running.cancel()
    with pytest.raises(asyncio.CancelledError):
        await running


@stepped
async def test_an_idle_reader_does_not_spin(clock: SteppedClock):
    calls = 0

    def work() -> None:
        nonlocal calls
        calls += 1

    receive = Receive(poll_ms=20.0)
    running = asyncio.create_task(WakeUp(receive, {}, clock).run(work))
    await clock.sleep(0.2)
    running.cancel()
    assert 1 <= calls <= 2 + 0.2 / 0.02


@pytest.mark.parametrize("took_ms", [0, 3])
@pytest.mark.parametrize(("n", "apart_ms"), [(14, 20), (10, 20), (2, 4)])
@stepped
async def test_when_a_sweep_is_always_due_looks_begin_a_share_of_a_poll_apart(
    clock: SteppedClock, n: int, apart_ms: int, took_ms: int
) -> None:
    """A whole poll at a thousand samples a second, however long the work takes."""
    boards = dict.fromkeys(range(n), 10 * MS)
    wake_up = WakeUp(Receive(poll_ms=20.0), boards, clock)
    began_ns: list[int] = []

    def work() -> None:
        began_ns.append(clock.now_ns())
        clock.advance(took_ms * 1e-3)
        for board in boards:
            wake_up.sweep_ended(board, clock.now_ns() - 10 * MS + board * MS // n)

    running = asyncio.create_task(wake_up.run(work))
    await clock.sleep(0.2)
    running.cancel()
    assert len(began_ns) >= 9
    apart_ns = [after - before for before, after in pairwise(began_ns)]
    assert apart_ns == pytest.approx([apart_ms * MS] * len(apart_ns), abs=10)


async def test_an_error_in_the_work_ends_the_run_with_it():
    def work() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await WakeUp(Receive(), {}).run(work)
