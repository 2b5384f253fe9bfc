"""Connections are accepted; where none can be, that costs few lines."""

import asyncio
import os
import resource
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from skin_host.acceptor import LINE_S, accept
from skin_host.clock import SteppedClock


@contextmanager
def no_more_files() -> Iterator[None]:
    """While the block lasts this program may open none."""
    lowest = os.dup(0)
    os.close(lowest)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_a_port_where_nothing_can_be_accepted_costs_one_line_a_minute(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Also where one is accepted now and then, which ends nothing."""
    clock = SteppedClock()
    taken = 0
    with (
        clock.runner() as runner,
        socket.create_server(("127.0.0.1", 0)) as listening,
        socket.socket() as early,
        socket.socket() as late,
    ):

        async def take(connection: socket.socket) -> None:
            nonlocal taken
            taken += 1
            connection.close()
            raise ConnectionResetError

        async def main() -> None:
            serving = asyncio.create_task(accept(listening, take, "the page", clock))
            await clock.sleep(1.0)
            early.connect(listening.getsockname())
            with no_more_files():
                await clock.sleep(LINE_S / 2)
            assert (taken, len(caplog.records)) == (0, 1)
            await clock.sleep(2.0)
            assert taken == 1
            late.connect(listening.getsockname())
            with no_more_files():
                await clock.sleep(LINE_S / 4)
                assert len(caplog.records) == 1
                await clock.sleep(LINE_S * 2)
            await clock.sleep(2.0)
            assert taken == 2
            serving.cancel()

        runner.run(main())
    assert len(caplog.records) == 3
    assert all(
        one.getMessage().startswith("the page: no connection can be accepted: Too many open files")
        for one in caplog.records
    )
