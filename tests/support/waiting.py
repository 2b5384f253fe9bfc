"""Waiting for what must come, however slow the machine is."""

import asyncio
from collections.abc import Callable

#: Nothing waits for so long but a test that fails; a busy machine is slow.
PATIENCE_S = 120.0


async def until(condition: Callable[[], object]) -> None:
    """Wait until the condition holds; TimeoutError if it never does."""
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.01)
