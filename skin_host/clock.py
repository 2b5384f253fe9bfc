"""Time and random numbers: the machine's, or stepped time and a seed.

The daemon gets the time, waits, starts threads and draws random numbers only through a `Clock`;
nothing else in its path uses the system's. With a `SteppedClock` the whole daemon, emulated robots
and their bus run in one event loop, without a thread, as fast as the machine can:

    clock = SteppedClock()
    with clock.runner() as runner:
        runner.run(main(clock))

Its loop never waits. When nothing is ready to run, time jumps to the next timer, so `asyncio.sleep`
and `asyncio.timeout` of libraries are stepped too. The same run gives the same results, as long as
nothing outside the process takes part.
"""

import asyncio
import ctypes
import os
import random
import selectors
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future
from contextvars import Context
from datetime import UTC, datetime
from heapq import heapify, heappop, heappush
from itertools import count
from queue import SimpleQueue
from typing import Any, Protocol, TypeVar, TypeVarTuple, Unpack

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

NS_PER_S = 1_000_000_000
#: Stepped time begins at a plausible time of day.
EPOCH_NS = 1_700_000_000 * NS_PER_S
#: A loop with more cancelled timers sorts them out, as asyncio's does.
MANY_TIMERS = 100
#: A stepped loop without any timer waits this long at a time for a thread or for outside input.
OUTSIDE_S = 0.01


class Alarm(Protocol):
    """A timer that calls a function."""

    def set(self, delay_ns: int) -> None:
        """Ring once after `delay_ns` > 0, and not before; this replaces an earlier setting."""

    def close(self) -> None:
        """Never ring again."""


class Clock:
    """The machine's time, timers, threads and random numbers."""

    def __init__(self) -> None:
        self._random = random.Random()

    #: Time of day since 1970: that of the frames' time stamps. It may be set.
    now_ns: Callable[[], int] = staticmethod(time.time_ns)
    #: A time that is never set.
    monotonic_ns: Callable[[], int] = staticmethod(time.monotonic_ns)
    #: `monotonic_ns` in seconds.
    monotonic_s: Callable[[], float] = staticmethod(time.monotonic)

    def since_boot_ns(self) -> int:
        """A time that is never set, and goes on while the computer sleeps."""
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)

    def today(self) -> datetime:
        """Date and time of day in UTC."""
        return datetime.fromtimestamp(self.now_ns() / NS_PER_S, UTC)

    def uniform(self, low: float, high: float) -> float:
        """Return a random number between the two; each process draws different ones."""
        return self._random.uniform(low, high)

    async def sleep(self, seconds: float) -> None:
        """Wait; other tasks run meanwhile, at least once."""
        await asyncio.sleep(seconds)

    def call_later(self, seconds: float, call: Callable[[Unpack[Ts]], object], *args: *Ts) -> None:
        """Call a function of the running loop once."""
        asyncio.get_running_loop().call_later(seconds, call, *args)

    def timeout(self, seconds: float) -> asyncio.Timeout:
        """Raise TimeoutError in a block of code that takes longer."""
        return asyncio.timeout(seconds)

    def timeout_at(self, when_s: float | None) -> asyncio.Timeout:
        """The same at a time of `monotonic_s`; never, if it is None."""
        return asyncio.timeout_at(when_s)

    def alarm(self, ring: Callable[[], object]) -> Alarm:
        """A timer of the running loop that is late by microseconds only."""
        return _TimerFd(ring)

    async def in_thread(self, function: Callable[[Unpack[Ts]], T], *args: *Ts) -> T:
        """Run a blocking function, for a disk or a resolver, beside the event loop.

        Unlike with `asyncio.to_thread`, the end of the program does not wait for it: a cancelled
        caller leaves the thread running. Where the system lets no thread begin, the loop waits.

        Raises:
            Exception: what the function raises.
        """
        loop = asyncio.get_running_loop()
        done: asyncio.Future[T] = loop.create_future()

        def settle(result: T | None, error: BaseException | None) -> None:
            if done.done():
                return
            if error is not None:
                done.set_exception(error)
            else:
                done.set_result(result)  # type: ignore[arg-type]

        def run() -> None:
            result, error = None, None
            try:
                result = function(*args)
            except BaseException as raised:
                error = raised
            try:
                loop.call_soon_threadsafe(settle, result, error)
            except RuntimeError:
                return  # the loop has ended meanwhile

        name = getattr(function, "__name__", "work")
        try:
            threading.Thread(target=run, name=name, daemon=True).start()
        except RuntimeError:  # a limit of tasks or of memory; what keeps files must not end by it
            run()
        return await done

    def executor(self, name: str) -> "Executor":
        """Return a thread that runs one function after the other."""
        return _Thread(name)

    def thread(self, function: Callable[[], object], name: str) -> threading.Thread:
        """Start a thread that nothing waits for, also beside stepped time: it may only write."""
        thread = threading.Thread(target=function, name=name, daemon=True)
        thread.start()
        return thread


class Executor(ABC):
    """Runs one function after the other beside the event loop, in order."""

    @abstractmethod
    def submit(self, function: Callable[[Unpack[Ts]], T], *args: *Ts) -> "Future[T]":
        """Run a function; see `concurrent.futures`."""

    @abstractmethod
    def close(self) -> None:
        """Start no further functions; a running one is not waited for."""


class SteppedClock(Clock):
    """Time that moves when nothing is left to do at the present, or by `advance`.

    Args:
        seed: of the random numbers: the same seed gives the same ones.

    Attributes:
        threads_take_s: how long what runs beside the event loop takes.
    """

    def __init__(self, seed: int = 0) -> None:
        self._random = random.Random(seed)
        self._epoch_ns = EPOCH_NS
        self._t_ns = 0
        self._slept_ns = 0
        self.threads_take_s = 0.0

    def now_ns(self) -> int:
        return self._epoch_ns + self._t_ns

    def monotonic_ns(self) -> int:
        return self._t_ns

    def since_boot_ns(self) -> int:
        return self._slept_ns + self._t_ns

    def monotonic_s(self) -> float:
        return self._t_ns / NS_PER_S

    def advance(self, seconds: float) -> None:
        """Move time on, as if the process had been stopped."""
        self._t_ns += round(seconds * NS_PER_S)

    def jump(self, seconds: float) -> None:
        """Move time on until a timer is surely due."""
        self._t_ns += int(seconds * NS_PER_S) + 1

    def set(self, jump_s: float) -> None:
        """Set the time of day forward or back."""
        self._epoch_ns += round(jump_s * NS_PER_S)

    def suspend(self, seconds: float) -> None:
        """Let the computer sleep: `monotonic_ns` stands still."""
        self._slept_ns += round(seconds * NS_PER_S)
        self.set(seconds)

    def alarm(self, ring: Callable[[], object]) -> Alarm:
        return _LoopAlarm(ring)

    async def in_thread(self, function: Callable[[Unpack[Ts]], T], *args: *Ts) -> T:
        """Run the function directly, without a thread."""
        await asyncio.sleep(self.threads_take_s)
        return function(*args)

    def executor(self, name: str) -> Executor:
        """Return an executor without a thread."""
        return _Inline()

    def runner(self) -> asyncio.Runner:
        """Runs coroutines by this clock; see `asyncio.Runner`."""
        return asyncio.Runner(loop_factory=lambda: _SteppedLoop(self))


class _SteppedLoop(asyncio.SelectorEventLoop):
    """An event loop whose time is a stepped clock's, and that wakes up at little cost."""

    def __init__(self, clock: SteppedClock) -> None:
        super().__init__(_Jumping(clock))
        # Asked for several times in each turn.
        self.time = clock.monotonic_s  # type: ignore[method-assign]
        self._clock = clock
        #: The timers that are set: when they are due, their numbers, and they themselves; a heap.
        #: Those of one time are due in the order in which they were set, whatever else is.
        self._timers: list[tuple[float, int, Any]] = []
        self._numbers = count()
        self._n_cancelled = 0
        #: The same with what asyncio's types do not declare.
        self._own: Any = self

    def call_at(
        self,
        when: float,
        callback: Callable[[Unpack[Ts]], object],
        *args: *Ts,
        context: Context | None = None,
    ) -> asyncio.TimerHandle:
        timer: Any = asyncio.TimerHandle(when, callback, args, self, context)
        timer._scheduled = True
        heappush(self._timers, (when, next(self._numbers), timer))
        return timer  # type: ignore[no-any-return]

    def call_later(
        self,
        delay: float,
        callback: Callable[[Unpack[Ts]], object],
        *args: *Ts,
        context: Context | None = None,
    ) -> asyncio.TimerHandle:
        return self.call_at(self.time() + delay, callback, *args, context=context)

    def _timer_handle_cancelled(self, timer: Any) -> None:
        self._n_cancelled += timer._scheduled

    def _run_once(self) -> None:
        """One turn, as asyncio's; where nothing but timers can come, without asking the system."""
        own, ready = self._own, self._own._ready
        timers = self._timers
        if len(timers) > MANY_TIMERS and 2 * self._n_cancelled > len(timers):
            timers[:] = [timer for timer in timers if not timer[2]._cancelled]
            heapify(timers)
            self._n_cancelled = 0
        while timers and timers[0][2]._cancelled:
            heappop(timers)
            self._n_cancelled -= 1
        clock = self._clock
        wait_s = timers[0][0] - clock._t_ns / NS_PER_S if timers and not ready else 0.0
        if len(own._selector._fd_to_key) > 1 or not (timers or ready) or own._stopping:
            is_idle = not (ready or own._stopping)
            longest_s = max(wait_s, 0.0) if timers else None
            own._process_events(own._selector.select(longest_s if is_idle else 0.0))
        elif wait_s > 0:
            clock.jump(wait_s)
        if timers:
            end_s = clock._t_ns / NS_PER_S + own._clock_resolution
            while timers and timers[0][0] < end_s:
                timer = heappop(timers)[2]
                timer._scheduled = False
                ready.append(timer)
        for _ in range(len(ready)):
            handle = ready.popleft()
            if not handle._cancelled:
                handle._run()

    def close(self) -> None:
        self._timers.clear()
        super().close()

    def run_in_executor(  # type: ignore[override]
        self, executor: Any, func: Any, *args: Any
    ) -> "asyncio.Future[Any]":
        """Run the function directly, without a thread."""
        done = self.create_future()
        try:
            done.set_result(func(*args))
        except Exception as error:
            done.set_exception(error)
        return done


class _Jumping(selectors.DefaultSelector):
    """Makes time jump where a loop would wait for its next timer."""

    def __init__(self, clock: SteppedClock) -> None:
        super().__init__()
        self._clock = clock

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        # The loop itself waits for one end of a pair of sockets, by which threads wake it. What
        # they bring is taken at the loop's next turn anyway.
        only_threads = len(self.get_map()) <= 1
        ready = [] if only_threads and timeout is not None else super().select(0)
        if ready or timeout == 0:
            return ready
        if timeout is None:
            return super().select(OUTSIDE_S)
        self._clock.jump(timeout)
        return ready


class _TimerFd:
    """timerfd_create(2), because the event loop's own timers are late by up to a millisecond."""

    _CLOCK_MONOTONIC = 1

    def __init__(self, ring: Callable[[], object]) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        self._fd: int = libc.timerfd_create(self._CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self._fd < 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code))
        self._settime = libc.timerfd_settime
        # struct itimerspec: an interval (none) and a first time, each in s and ns.
        self._time = (ctypes.c_long * 4)()
        self._time_at = ctypes.byref(self._time)
        self._loop = asyncio.get_running_loop()
        # Expirations are not read: setting the next time makes the descriptor unreadable.
        self._loop.add_reader(self._fd, ring)

    def set(self, delay_ns: int) -> None:
        self._time[2], self._time[3] = divmod(delay_ns, NS_PER_S)
        self._settime(self._fd, 0, self._time_at, None)

    def close(self) -> None:
        if self._fd >= 0:
            self._loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = -1


class _LoopAlarm:
    """A timer of the loop itself: exact where the loop's time is stepped."""

    def __init__(self, ring: Callable[[], object]) -> None:
        self._ring = ring
        self._loop = asyncio.get_running_loop()
        self._handle: asyncio.TimerHandle | None = None

    def set(self, delay_ns: int) -> None:
        self.close()
        loop = self._loop
        self._handle = loop.call_at(loop.time() + delay_ns / NS_PER_S, self._ring)

    def close(self) -> None:
        if self._handle is not None:
            self._handle.cancel()


class _Thread(Executor):
    """Unlike the threads of `concurrent.futures`, the end of the program does not wait for it."""

    def __init__(self, name: str) -> None:
        self._waiting: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._closed = False
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def submit(self, function: Callable[[Unpack[Ts]], T], *args: *Ts) -> "Future[T]":
        done: Future[T] = Future()

        def call() -> None:
            if self._closed or not done.set_running_or_notify_cancel():
                done.cancel()
            else:
                _settle(done, function, *args)

        self._waiting.put(call)
        return done

    def close(self) -> None:
        self._closed = True
        self._waiting.put(None)

    def _run(self) -> None:
        while (call := self._waiting.get()) is not None:
            call()


class _Inline(Executor):
    def submit(self, function: Callable[[Unpack[Ts]], T], *args: *Ts) -> "Future[T]":
        done: Future[T] = Future()
        _settle(done, function, *args)
        return done

    def close(self) -> None:
        pass


def _settle(done: "Future[T]", function: Callable[[Unpack[Ts]], T], *args: *Ts) -> None:
    try:
        done.set_result(function(*args))
    except Exception as error:
        done.set_exception(error)


SYSTEM = Clock()
