"""Servers of streams that end while somebody is connected."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

Handler = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Coroutine[Any, Any, None]]


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
