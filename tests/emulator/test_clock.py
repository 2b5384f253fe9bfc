import asyncio

import numpy as np
import pytest

from emulator.clock import NS, RealClock, SteppedTime
from skin_host import clock as clocks


async def test_a_real_clock_wakes_a_sleeper_after_its_time() -> None:
    clock = RealClock()
    until_ns = clock.now_ns() + 5_000_000
    await clock.sleep_until_ns(until_ns)
    assert clock.now_ns() >= until_ns


async def test_an_accelerated_clock_runs_ahead_of_the_machine() -> None:
    fast, slow = RealClock(speed=1000.0), RealClock()
    await asyncio.sleep(0.002)
    assert fast.now_ns() > 100 * slow.now_ns()


class HeldUp(clocks.Clock):
    """A process that loses the processor for 60 ms, some reads of a clock after the next."""

    def __init__(self, reads: int) -> None:
        super().__init__()
        self.t_ns, self.reads = 0, reads

    def _read(self) -> int:
        self.reads -= 1
        self.t_ns += 60_000_000 if self.reads == 0 else 1000
        return self.t_ns

    def monotonic_ns(self) -> int:
        return self._read()

    def now_ns(self) -> int:
        return 10**18 + self._read()


@pytest.mark.parametrize("reads", [2, 3, 4])
def test_a_process_that_is_held_up_between_two_clocks_stamps_as_before(reads: int) -> None:
    clock = RealClock(clock=HeldUp(reads))
    (host_ns,) = clock.host_ns(np.array([5 * NS]))
    assert host_ns == pytest.approx(10**18 + 5 * NS, abs=200_000)


def test_a_clock_that_stands_still_is_refused() -> None:
    with pytest.raises(ValueError, match="wanted a number above 0"):
        RealClock(speed=0.0)


async def test_a_stepped_clock_moves_only_when_it_is_moved() -> None:
    clock = SteppedTime()
    sleeper = asyncio.create_task(clock.sleep_until_ns(NS))
    await asyncio.sleep(0)
    await clock.advance(0.5)
    assert not sleeper.done()
    assert clock.now_ns() == NS // 2
    await clock.advance(0.5)
    await sleeper


async def test_a_free_clock_jumps_over_every_sleep() -> None:
    clock = SteppedTime(free=True)
    await clock.sleep_until_ns(3600 * NS)
    assert clock.now_ns() == 3600 * NS


@pytest.mark.parametrize("speed", [5e-324, 1e-300, 1e-12, 0.5, 1e8])
def test_times_for_the_host_keep_their_order_at_any_speed(speed: float) -> None:
    clock = RealClock(speed=speed)
    host_ns = clock.host_ns(clock.now_ns() + np.array([-5_000_000_000, 0, 5_000_000_000]))
    assert host_ns[0] <= host_ns[1] <= host_ns[2]
    assert host_ns.dtype == np.int64
