"""Work shared among processes, on all cores of this computer."""

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from multiprocessing.resource_tracker import ensure_running
from types import TracebackType
from typing import Any, TypeVar, TypeVarTuple, Unpack

from skin_host.errors import SkinError

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

#: A process that is to end has so long to clean up.
AGAIN_S = 2.0
#: A terminal sends these to all processes that were started in it: Ctrl-C, and that it is closed.
OF_TERMINALS = (signal.SIGINT, signal.SIGHUP)
#: Where the handlers are that asyncio sets.
_OF_LOOPS = "asyncio.unix_events"
#: From linux/prctl.h.
_PR_SET_PDEATHSIG = 1


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


class Processes:
    """Processes that share work.

        with Processes() as processes:
            futures = [processes.submit(function, item) for item in items]

    They are fresh ones: the parent may run threads, which a fork would not survive. When the block
    ends by an exception, such as Ctrl-C or SIGTERM, they end at once and clean up, and so they do
    when their parent is killed.

    Args:
        most: no more than these.

    Raises:
        SkinError: at the end of the block, if somebody killed one of them.
    """

    def __init__(self, most: int | None = None) -> None:
        start_tracker()
        self._pool = ProcessPoolExecutor(
            cores() if most is None else min(cores(), most),
            multiprocessing.get_context("spawn"),
            _begin,
            (os.getpid(),),
        )
        self._others = set(multiprocessing.active_children())
        self._before: Any = None

    def submit(self, function: Callable[[Unpack[Ts]], T], *arguments: *Ts) -> "Future[T]":
        """Call a function, which can be pickled, in one of the processes."""
        with kept_from_children(*OF_TERMINALS):  # the first call starts them
            return self._pool.submit(_work, function, arguments)

    def __enter__(self) -> "Processes":
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGTERM, _leave)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is not None:
            for process in set(multiprocessing.active_children()) - self._others:
                process.terminate()
        self._pool.shutdown(cancel_futures=error is not None)
        if self._before is not None:
            signal.signal(signal.SIGTERM, self._before)
        if isinstance(error, BrokenProcessPool):
            raise SkinError(
                "a process that shared this work was killed, perhaps because memory was short"
            ) from None


def start_tracker() -> None:
    """Start the process in which `multiprocessing` tracks what is to be removed at the end.

    It survives a terminal that is closed: the next one would not know what it has to remove.
    """
    with kept_from_children(signal.SIGHUP):
        ensure_running()


@contextlib.contextmanager
def beside(processes: Sequence[BaseProcess], *ends: Connection) -> Iterator[None]:
    """Run processes for as long as the block lasts; signals of a terminal do not reach them.

    Args:
        processes: not started yet.
        ends: of pipes, that only these processes need. They are closed here, so that who waits at
            the other end learns that its process has ended.

    Raises:
        SkinError: in place of the EOFError that this is.
    """
    start_tracker()
    started: list[BaseProcess] = []
    try:
        with kept_from_children(*OF_TERMINALS):
            for process in processes:
                process.start()
                started.append(process)
        for end in ends:
            end.close()
        yield
    except EOFError:
        raise SkinError("a process of this work has ended; its error stands above") from None
    finally:
        for process in started:
            process.terminate()
        for process in started:
            process.join()


@contextlib.contextmanager
def kept_from_children(*numbers: signal.Signals) -> Iterator[None]:
    """Programs that are started in the block do not receive these signals, unless they unblock
    them: a terminal sends Ctrl-C to all of them, but this process ends by it, and then ends them.

    What comes meanwhile reaches this process after the block. The first start of a process by
    `multiprocessing` unblocks SIGINT and SIGTERM (Python 3.11): call `start_tracker` before.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    # Another thread, which does not block them, may take them: a start that a handler leaves half
    # way makes its program report an error.
    came: list[int] = []
    handlers = {}
    if threading.current_thread() is threading.main_thread():
        for number in numbers:
            before_it = signal.getsignal(number)
            # None is a handler that Python does not know. An event loop's does nothing: the loop
            # is woken by the signal itself, and would be a second time.
            is_of_loop = getattr(before_it, "__module__", None) == _OF_LOOPS
            if before_it not in (signal.SIG_IGN, None) and not is_of_loop:
                handlers[number] = signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for one in came:
            signal.raise_signal(one)


def end_with_parent(parent: int) -> None:
    """Get SIGTERM when the process `parent` ends, however it does, or if it has ended already."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        signal.raise_signal(signal.SIGTERM)


def _leave(number: int, _: object) -> None:
    """End this process by an exception, so that everything is cleaned up."""
    sys.exit(128 + number)


#: Set in a process that is to end.
_is_ended = False


def _begin(parent: int) -> None:
    """End when the parent asks for that, or has ended."""
    signal.signal(signal.SIGTERM, _end)
    signal.signal(signal.SIGALRM, _end)
    end_with_parent(parent)


def _end(*_: object) -> None:
    global _is_ended  # noqa: PLW0603
    _is_ended = True
    # The pool asks again when another one has ended, which would interrupt the cleaning up.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    # An exception is lost where nothing can be raised, such as in a destructor: then once more.
    sys.unraisablehook = lambda _: None
    signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
    sys.exit()


def _work(function: Callable[[Unpack[Ts]], T], arguments: tuple[*Ts]) -> T:
    try:
        return function(*arguments)
    finally:
        if _is_ended:  # The pool would wait for more work, of a parent that may be gone.
            os._exit(1)
