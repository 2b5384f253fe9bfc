"""Accepts the connections to a port that is served here, also where no more files may be open.

asyncio's own server tries then as often as its queue is long, each second again, writes a traceback
for each of these tries, and multiplies them.
"""

import asyncio
import errno
import logging
import math
import os
import resource
import socket
from collections.abc import Awaitable, Callable
from typing import NoReturn

from skin_host.clock import SYSTEM, Clock

log = logging.getLogger(__name__)

#: A connection that could not be accepted waits in the queue of the port for so long.
RETRY_S = 1.0
#: Of a port that can accept nothing, or nothing now and then, one line is written in this time.
LINE_S = 60.0


async def accept(
    listening: socket.socket,
    take: Callable[[socket.socket], Awaitable[object]],
    what: str,
    clock: Clock = SYSTEM,
) -> NoReturn:
    """Accept connections until cancelled.

    Args:
        listening: a port of this program; it is not closed here.
        take: begins to serve a connection, and is waited for. What it raises as OSError ends that
            connection.
        what: is served, for the log.
        clock: the time.
    """
    loop = asyncio.get_running_loop()
    listening.setblocking(False)
    written_s = -math.inf
    while True:
        try:
            connection, _ = await loop.sock_accept(listening)
        except ConnectionAbortedError:
            continue
        except OSError as error:
            if clock.monotonic_s() - written_s >= LINE_S:
                written_s = clock.monotonic_s()
                log.warning(
                    "%s: no connection can be accepted: %s; trying again", what, _why(error)
                )
            await clock.sleep(RETRY_S)
            continue
        try:
            await take(connection)
        except OSError:
            connection.close()


def _why(error: OSError) -> str:
    why = os.strerror(error.errno) if error.errno else str(error)
    if error.errno == errno.EMFILE:
        why += f", `ulimit -n` is {resource.getrlimit(resource.RLIMIT_NOFILE)[0]}"
    return why
