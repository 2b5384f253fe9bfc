"""`skin emulate` takes faults on standard input as long as that can be read."""

import asyncio
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from emulator.robot import Robot
from skin_host.cli.without_robot import follow_commands, take_commands
from skin_host.layout import load_skin

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"
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
    loop.add_reader(descriptor, take_commands, ROBOT, bytearray())


async def test_standard_input_that_cannot_be_read_ends_as_one_that_has_ended(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a terminal of which this is an orphan in the background: each look was a traceback."""
    _, unreadable = pipe
    read_from(monkeypatch, unreadable)
    take_commands(ROBOT, bytearray())
    assert not asyncio.get_running_loop().remove_reader(unreadable)


async def test_standard_input_on_which_nothing_waits_is_looked_at_again(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another program that has the terminal may have made it one that does not wait."""
    reading, _ = pipe
    os.set_blocking(reading, False)
    read_from(monkeypatch, reading)
    take_commands(ROBOT, bytearray())
    assert asyncio.get_running_loop().remove_reader(reading)


@pytest.fixture
def robot() -> Robot:
    return Robot(*load_skin(CONFIG))


def send(robot: Robot, text: str, pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = pipe
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(fileno=lambda: reading))
    os.write(writing, text.encode())
    take_commands(robot, bytearray())


def test_mend_lists_the_faults_that_it_can_end(
    robot: Robot,
    pipe: tuple[int, int],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Faults that were over or cannot be undone were listed as on, and one was "mended"."""
    lines = "board_reset board=hand\nbus_off bus=can0 until_s=1\nchip_gone triangle=2 board=hand\n"
    send(robot, lines, pipe, monkeypatch)
    robot.step(1.5)
    send(robot, "mend\nmend bus_off bus=can0\nmend board_reset board=hand\n", pipe, monkeypatch)
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 3
    assert all(line.endswith(": chip_gone board=hand triangle=2") for line in told)
    send(robot, "mend chip_gone board=hand triangle=2\n", pipe, monkeypatch)
    assert robot.faults_on == []
    assert not capsys.readouterr().err


def test_a_robot_that_continues_from_a_state_has_its_faults_mended(
    robot: Robot,
    pipe: tuple[int, int],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """`--state` brought the faults back, but no line could end them."""
    send(robot, "bus_off bus=can0\n", pipe, monkeypatch)
    again = Robot.restore(robot.save(), robot.settings, robot.layout)
    send(again, "mend bus_off bus=can0\n", pipe, monkeypatch)
    assert not again.wires["can0"].off
    assert not capsys.readouterr().err


@pytest.mark.parametrize("end", ["\n", ""])
async def test_the_lines_of_a_file_are_taken_at_the_start(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: str
) -> None:
    """A file cannot be waited for: `skin emulate CONFIG < FILE` took nothing, without a word."""
    lines = ["bus_off bus=can0"] + [f"chip_gone board=hand triangle={n % 5}" for n in range(500)]
    path = tmp_path / "faults"
    path.write_text("\n".join(lines) + end)
    with path.open() as file:
        monkeypatch.setattr(sys, "stdin", file)
        follow_commands(robot)
    assert robot.wires["can0"].off
    assert len(robot.faults_on) == 6


@pytest.mark.parametrize("device", [Path("/dev/null"), Path("/dev/zero")], ids=str)
async def test_what_can_neither_be_waited_for_nor_is_a_file_has_no_commands(
    device: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with device.open() as file:
        monkeypatch.setattr(sys, "stdin", file)
        follow_commands(ROBOT)


async def test_a_standard_input_that_is_closed_has_no_commands(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    follow_commands(ROBOT)
