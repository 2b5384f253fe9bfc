"""`skin emulate` takes faults on standard input as long as that can be read."""

import asyncio
import os
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from skin_host.cli.without_robot import take_commands

ROBOT: Any = None  # no line reaches it


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


def read_from(monkeypatch: pytest.MonkeyPatch, descriptor: int) -> None:
    """Let standard input be this descriptor, and watch it."""
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(fileno=lambda: descriptor))
    loop = asyncio.get_running_loop()
    loop.add_reader(descriptor, take_commands, ROBOT, {}, bytearray())


async def test_standard_input_that_cannot_be_read_ends_as_one_that_has_ended(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a terminal of which this is an orphan in the background: each look was a traceback."""
    _, unreadable = pipe
    read_from(monkeypatch, unreadable)
    take_commands(ROBOT, {}, bytearray())
    assert not asyncio.get_running_loop().remove_reader(unreadable)


async def test_standard_input_on_which_nothing_waits_is_looked_at_again(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another program that has the terminal may have made it one that does not wait."""
    reading, _ = pipe
    os.set_blocking(reading, False)
    read_from(monkeypatch, reading)
    take_commands(ROBOT, {}, bytearray())
    assert asyncio.get_running_loop().remove_reader(reading)
