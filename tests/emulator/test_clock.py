import asyncio

import pytest

from emulator.clock import NS, RealClock, SteppedClock


async def test_a_real_clock_wakes_a_sleeper_after_its_time() -> None:
    clock = RealClock()
    until_ns = clock.now_ns() + 5_000_000
    await clock.sleep_until_ns(until_ns)
    assert clock.now_ns() >= until_ns


async def test_an_accelerated_clock_runs_ahead_of_the_machine() -> None:
    fast, slow = RealClock(speed=1000.0), RealClock()
    await asyncio.sleep(0.002)
    assert fast.now_ns() > 100 * slow.now_ns()


def test_a_clock_that_stands_still_is_refused() -> None:
    with pytest.raises(ValueError, match="wanted a number above 0"):
        RealClock(speed=0.0)


async def test_a_stepped_clock_moves_only_when_it_is_moved() -> None:
    clock = SteppedClock()
    sleeper = asyncio.create_task(clock.sleep_until_ns(NS))
    await asyncio.sleep(0)
    await clock.advance(0.5)
    assert not sleeper.done()
    assert clock.now_ns() == NS // 2
    await clock.advance(0.5)
    await sleeper


async def test_a_free_clock_jumps_over_every_sleep() -> None:
    clock = SteppedClock(free=True)
    await clock.sleep_until_ns(3600 * NS)
    assert clock.now_ns() == 3600 * NS
