"""Recordings whose clock was set, stood still, or had no date."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from skin_host.cli import main
from tests.support.candump import write_config, write_log

STAMP = re.compile(r"^\((\d+)\.(\d{6})\)", re.MULTILINE)
START_US = 1_700_000_000 * 10**6
SET_US = START_US + 7_000_000
HOUR_US = 3600 * 10**6


def back(us: int) -> int:
    return us - HOUR_US if us > SET_US else us


def forward(us: int) -> int:
    return us + 8766 * HOUR_US if us > SET_US else us


def stands(us: int) -> int:
    return START_US


def undated(us: int) -> int:
    return us - START_US


def set_by_a_step(us: int) -> int:
    return us + 3_000_000 if us > SET_US else us


def once_ahead(us: int) -> int:
    return us + HOUR_US if us == SET_US else us


CHANGES = [back, forward, stands, undated, set_by_a_step]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return write_config(tmp_path / "skin.toml")


def stamped(text: str, change: Callable[[int], int]) -> str:
    """The lines of a recording by another clock."""

    def stamp(found: re.Match[str]) -> str:
        us = change(int(found[1]) * 10**6 + int(found[2]))
        return f"({us // 10**6}.{us % 10**6:06d})"

    return STAMP.sub(stamp, text)


def changed(path: Path, change: Callable[[int], int]) -> Path:
    """A recording of ten seconds, pressed from the sixth to the ninth, by another clock."""
    write_log(path, 240, lambda period: range(12) if 120 < period < 180 else ())
    path.write_text(stamped(path.read_text(), change))
    return path


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize(
    "arguments",
    [["--pressure", "{}", "--levels", "20"], ["--relaxation", "{}", "--weight-kpa", "20"]],
    ids=["pressure", "relaxation"],
)
def test_a_fit_ends_in_one_line_or_in_a_file(
    change: Callable[[int], int],
    arguments: list[str],
    config: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = changed(tmp_path / "a.log", change)
    command = ["calibrate", str(config), "--output", str(tmp_path / "b.json")]
    status = main([*command, *(one.replace("{}", str(log)) for one in arguments)])
    lines = [
        line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning")
    ]
    assert status in (0, 2)
    assert len(lines) == (status > 0)
    wanted = {back: "goes back by 3600 s", forward: "a gap of 31557600 s", stands: "stands still"}
    if change in wanted:
        assert status == 2
        assert wanted[change] in lines[0]
        assert str(log) in lines[0]


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("output", ["a.jsonl", "a.npz", "a.parquet", "tables", "a.png", "map.png"])
def test_it_is_replayed_exported_and_drawn(
    change: Callable[[int], int],
    output: str,
    config: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = changed(tmp_path / "a.log", change)
    where = str(tmp_path / output)
    if output == "a.jsonl":
        command = ["replay", str(log), "--output", where]
    elif output.endswith("png"):
        command = ["plot", "map" if output == "map.png" else "pressure", str(log), where]
    else:
        command = ["export", str(log), where]
    assert main([*command, "--config", str(config)]) == 0
    assert all(line.startswith("warning: ") for line in capsys.readouterr().err.splitlines())


TWO_BUSES = """
robot = "two"
[buses.a]
channel = "can0"
[buses.b]
channel = "can1"
[boards.left]
bus = "a"
address = 1
[boards.right]
bus = "b"
address = 1
[[parts.hand.patches]]
board = "left"
triangles = "0-15"
[[parts.hand.patches]]
board = "right"
triangles = "0-15"
"""


def touches_of_two_buses(folder: Path, change: Callable[[int], int]) -> list[tuple[str, int, str]]:
    """Begins and ends of contacts, with the number of their frame: both boards of a part, each on a
    bus of its own, are pressed in the tenth second of a clock that changes in the seventh.
    """
    folder.mkdir()
    config, log = folder / "two.toml", folder / "a.log"
    config.write_text(TWO_BUSES)
    write_log(log, 240, lambda period: range(12) if 180 < period < 200 else ())
    left = log.read_text()
    right = stamped(left.replace("can0", "can1"), lambda us: us + 50)
    in_order = sorted((left + right).splitlines(keepends=True))
    log.write_text(stamped("".join(in_order), change))
    output = folder / "a.jsonl"
    command = ["replay", str(log), "--config", str(config), "--output", str(output)]
    assert main([*command, "--calibrate-seconds", "5"]) == 0
    records = map(json.loads, output.read_text().splitlines())
    return [
        (one["event"], one["seq"], one.get("reason", ""))
        for one in records
        if one["type"] == "touch" and one["event"] != "move"
    ]


@pytest.mark.parametrize("change", [back, once_ahead])
def test_a_clock_that_changes_does_not_pull_two_buses_apart(
    change: Callable[[int], int], tmp_path: Path
) -> None:
    expected = touches_of_two_buses(tmp_path / "steady", lambda us: us)
    assert [event for event, _, _ in expected] == ["begin", "begin", "end", "end"]
    found = touches_of_two_buses(tmp_path / "changed", change)
    assert found == expected
