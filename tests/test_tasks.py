"""Tasks end when they are asked to."""

import asyncio

import pytest

from skin_host.tasks import leave_if_cancelled


async def test_a_loop_that_tries_again_ends_if_an_error_hides_its_cancellation() -> None:
    """As `asyncio.TaskGroup` does if one of its tasks fails when the group's own is cancelled."""
    asked = asyncio.Event()

    async def fail() -> None:
        await asked.wait()
        raise OSError("gone")

    async def try_again() -> None:
        while True:
            try:
                async with asyncio.TaskGroup() as group:
                    group.create_task(fail())
            except* OSError:
                asked.clear()
            leave_if_cancelled()

    trying = asyncio.create_task(try_again())
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    asked.set()
    trying.cancel()
    with pytest.raises(asyncio.CancelledError):
        await trying


async def test_a_task_that_nobody_cancelled_goes_on() -> None:
    leave_if_cancelled()
