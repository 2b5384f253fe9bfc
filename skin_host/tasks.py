"""Tasks of asyncio: to end them, to work until a stop, to serve each connection."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

T = TypeVar("T")
Handler = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Coroutine[Any, Any, None]]


async def cancel(*tasks: "asyncio.Future[Any]") -> None:
    """Cancel tasks, and wait until they have ended, with whatever result."""
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def leave_if_cancelled() -> None:
    """End this task if it was cancelled, for loops that try again after an error.

    A wait that fails at the moment of the cancellation raises its error in place of it
    (`asyncio.wait_for` and `asyncio.TaskGroup` of Python 3.11): the loop would go on, and who
    cancelled it would wait for ever.

    The block of a group must wait for its tasks itself: of one that fails when the block is over,
    Python 3.11 leaves the group's own task marked as cancelled.

    Raises:
        CancelledError: it was.
    """
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError


async def until(stop: asyncio.Event, work: Coroutine[Any, Any, T]) -> T | None:
    """Work until `stop` is set, and return the result of work that ends before.

    Raises:
        Exception: what the work raises, before the stop or because of it.
    """
    working, stopping = asyncio.create_task(work), asyncio.create_task(stop.wait())
    try:
        await asyncio.wait([working, stopping], return_when=asyncio.FIRST_COMPLETED)
    finally:
        await cancel(working, stopping)
    return None if working.cancelled() else working.result()


def in_tasks(handler: Handler) -> Callable[[asyncio.StreamReader, asyncio.StreamWriter], None]:
    """Return a callback for `asyncio.start_server` that runs `handler` for each connection.

    A handler that is cancelled, as all are when the program ends, closes its connection silently.
    The server of Python 3.11 asks the cancelled task of a handler for its exception, and logs that
    as a failure.
    """
    running: set[asyncio.Task[None]] = set()

    def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        def ended(task: asyncio.Task[None]) -> None:
            running.discard(task)
            writer.close()

        task = asyncio.get_running_loop().create_task(handler(reader, writer))
        running.add(task)
        task.add_done_callback(ended)

    return connected
