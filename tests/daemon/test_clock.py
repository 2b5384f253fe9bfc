"""Stepped time: a loop that never waits, whose timers go off in order and on time."""

import asyncio
import threading
import time

import pytest

from skin_host.clock import EPOCH_NS, SYSTEM, SteppedClock
from tests.support.stepped import stepped

HOUR_S = 3600.0


@stepped
async def test_hours_pass_in_order_and_without_waiting(clock: SteppedClock) -> None:
    began_s = time.monotonic()
    order: list[tuple[str, float]] = []

    async def note(name: str, seconds: float) -> None:
        await clock.sleep(seconds)
        order.append((name, clock.monotonic_s()))

    async with asyncio.TaskGroup() as group:
        for name, hours in (("last", 3.0), ("first", 1.0), ("second", 2.0)):
            group.create_task(note(name, hours * HOUR_S))
    assert [name for name, _ in order] == ["first", "second", "last"]
    assert [at_s / HOUR_S for _, at_s in order] == pytest.approx([1.0, 2.0, 3.0])
    assert clock.now_ns() == EPOCH_NS + clock.monotonic_ns()
    assert time.monotonic() - began_s < HOUR_S


def test_only_the_time_since_the_start_goes_on_in_sleep_and_is_not_set() -> None:
    clock = SteppedClock()
    clock.set(HOUR_S)
    clock.suspend(2.0)
    clock.advance(1.0)
    assert clock.now_ns() - EPOCH_NS == (3600 + 2 + 1) * 10**9
    assert clock.since_boot_ns() == (2 + 1) * 10**9
    assert clock.monotonic_ns() == 10**9
    began_ns = SYSTEM.since_boot_ns()
    assert SYSTEM.since_boot_ns() >= began_ns > 0


@stepped
async def test_timeouts_of_libraries_are_stepped_too(clock: SteppedClock) -> None:
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(HOUR_S):
            await asyncio.Event().wait()
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(asyncio.Event().wait(), HOUR_S)
    assert clock.monotonic_s() == pytest.approx(2 * HOUR_S)


@stepped
async def test_an_alarm_rings_at_its_time_and_a_new_time_voids_the_old(clock: SteppedClock) -> None:
    rung: list[int] = []
    alarm = clock.alarm(lambda: rung.append(clock.monotonic_ns()))
    alarm.set(5_000)
    alarm.set(3_000)
    await clock.sleep(1.0)
    alarm.set(1)
    alarm.close()
    await clock.sleep(1.0)
    assert len(rung) == 1
    assert rung[0] == pytest.approx(3_000, abs=2)


@stepped
async def test_timers_that_are_cancelled_never_ring_however_many(clock: SteppedClock) -> None:
    loop = asyncio.get_running_loop()
    rang: list[int] = []
    timers = [loop.call_later(1 + number, rang.append, number) for number in range(500)]
    for number, timer in enumerate(timers):
        if number % 7:
            timer.cancel()
    await clock.sleep(600.0)
    assert rang == list(range(0, 500, 7))


def test_the_same_seed_draws_the_same_numbers() -> None:
    clocks = [SteppedClock(seed=seed) for seed in (1, 1, 2)]
    drawn = [[clock.uniform(0.5, 1.0) for _ in range(4)] for clock in clocks]
    assert drawn[0] == drawn[1] != drawn[2]


@stepped
async def test_what_may_block_is_done_without_a_thread(clock: SteppedClock) -> None:
    with pytest.raises(ZeroDivisionError):
        await clock.in_thread(lambda: 1 // 0)
    assert await clock.in_thread(int, "7") == 7
    executor = clock.executor("one")
    assert executor.submit(int, "8").result(0) == 8
    assert isinstance(executor.submit(int, "x").exception(0), ValueError)
    loop = asyncio.get_running_loop()
    assert await loop.run_in_executor(None, int, "9") == 9


async def test_where_no_thread_may_begin_the_loop_does_what_may_block(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As in a service whose limit of tasks is reached, which must go on keeping its files."""

    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    with pytest.raises(ZeroDivisionError):
        await SYSTEM.in_thread(lambda: 1 // 0)
    assert await SYSTEM.in_thread(int, "7") == 7


async def test_the_machines_clock_does_the_same_with_threads() -> None:
    with pytest.raises(ZeroDivisionError):
        await SYSTEM.in_thread(lambda: 1 // 0)
    assert await SYSTEM.in_thread(int, "7") == 7
    rung = asyncio.Event()
    alarm = SYSTEM.alarm(rung.set)
    alarm.set(1_000)
    await rung.wait()
    alarm.close()
    alarm.close()
    executor = SYSTEM.executor("one")
    assert await asyncio.wrap_future(executor.submit(int, "8")) == 8
    executor.close()


@pytest.mark.parametrize("others", range(20))
def test_timers_of_one_time_ring_in_the_order_in_which_they_were_set(others: int) -> None:
    """An end of the run that is set besides, or not, changes nothing that comes before it."""
    rung: list[int] = []

    async def ring() -> None:
        loop = asyncio.get_running_loop()
        for number in range(others):
            loop.call_at(10.0 + number % 7, rung.append, -1)
        for number in range(20):
            loop.call_at(2.0, rung.append, number)
            loop.call_at(1.0 + 0.01 * (number % 3), int)
        await asyncio.sleep(3.0)

    with SteppedClock().runner() as runner:
        runner.run(ring())
    assert rung == list(range(20))
