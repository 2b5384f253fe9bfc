"""Many recordings are processed side by side, each to the same bytes as alone."""

import logging
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from skin_host.bus.logs import WINDOW_NS
from skin_host.bus.wire import TAXELS
from skin_host.cli import main
from skin_host.recording import replay
from tests.support.candump import write_config, write_log

PERIODS = 140


def recording(path: Path, seed: int) -> Path:
    """Seven seconds of a board of which two triangles are pressed at the end."""
    taxels = range(TAXELS * seed, TAXELS * (seed + 2))
    return write_log(path, PERIODS, lambda period: taxels if period > 110 else (), seed)


@pytest.fixture
def logs(tmp_path: Path) -> list[Path]:
    return [recording(tmp_path / f"{name}.log", seed) for seed, name in enumerate("abc")]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return write_config(tmp_path / "skin.toml")


@pytest.fixture
def alone(logs: list[Path], config: Path, tmp_path: Path) -> dict[str, bytes]:
    """What each recording comes to by itself."""
    found = {}
    for log in logs:
        output = tmp_path / f"alone-{log.stem}.jsonl"
        assert main(["replay", str(log), "--config", str(config), "--output", str(output)]) == 0
        found[f"{log.stem}.jsonl"] = output.read_bytes()
    assert all(lines.count(b'"event":"begin"') == 1 for lines in found.values())
    return found


def test_how_long_batches_are_changes_no_byte(
    logs: list[Path],
    config: Path,
    alone: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(replay, "LONG_WINDOW_NS", WINDOW_NS)
    output = tmp_path / "short.jsonl"
    replay.process(replay.Task(logs[0], config, output))
    assert output.read_bytes() == alone[f"{logs[0].stem}.jsonl"]


def written(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_recordings_side_by_side_come_to_the_same_bytes_as_alone(
    logs: list[Path], config: Path, alone: dict[str, bytes], tmp_path: Path
) -> None:
    command = ["replay", *map(str, logs), "--config", str(config)]
    assert main([*command, "--output", str(tmp_path / "out")]) == 0
    assert written(tmp_path / "out") == alone


def test_folders_above_the_output_are_made_as_those_of_a_file(
    logs: list[Path], config: Path, alone: dict[str, bytes], tmp_path: Path
) -> None:
    command = ["replay", *map(str, logs), "--config", str(config)]
    assert main([*command, "--output", str(tmp_path / "new" / "out")]) == 0
    assert written(tmp_path / "new" / "out") == alone
    command = ["replay", str(logs[0]), "--config", str(config)]
    assert main([*command, "--output", str(tmp_path / "newer" / "out" / "a.jsonl")]) == 0
    assert (tmp_path / "newer" / "out" / "a.jsonl").read_bytes() == alone["a.jsonl"]


@pytest.mark.parametrize(("end", "status"), [("(17\n", 2), ("(17", 0)])
def test_no_name_of_a_recording_steers_the_terminal(
    end: str,
    status: int,
    logs: list[Path],
    config: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    evil = "\x1b]0;title\x07\x1b[2J\r"
    named = [log.rename(log.with_name(f"{evil}{log.name}")) for log in logs[:2]]
    with named[1].open("a") as damaged:
        damaged.write(end)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    command = ["replay", *map(str, named), "--config", str(config)]
    assert main([*command, "--output", str(tmp_path / "out")]) == status
    shown = capsys.readouterr().err
    assert "title" in shown or status == 0
    assert "\x1b]" not in shown
    assert "\x1b[2J" not in shown


def test_a_damaged_recording_is_told_and_stops_no_other(
    logs: list[Path], config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    with logs[1].open("a") as damaged:
        damaged.write("(17\n")
    command = ["replay", *map(str, logs), "--config", str(config)]
    assert main([*command, "--output", str(folder)]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith(f"skin replay: {logs[1]}: damaged after frame {PERIODS * 32}")
    assert set(written(folder)) == {"a.jsonl", "c.jsonl"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["a.log", "b.log"], "several LOGs go into a folder: wanted --output FOLDER"),
        (["a.log", "b.log", "--output", "a.log"], "--output a.log: File exists"),
        (["a.log", "x/a.log", "--output", "."], "a.jsonl: two LOGs of that name"),
        (["a.log", "b.log", "--onto", "can"], "--onto plays one LOG at a time"),
        (
            ["a.log", "b.log", "--output", ".", "--scheduler", "tcp://127.0.0.1:9"],
            "--scheduler tcp://127.0.0.1:9: no scheduler answers",
        ),
    ],
)
def test_a_request_that_cannot_be_met_is_refused(
    logs: list[Path],
    config: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    if "--scheduler" in arguments:
        pytest.importorskip("distributed")
        monkeypatch.setattr("skin_host.recording.replay.SCHEDULER_S", 0.1)
    monkeypatch.chdir(tmp_path)
    assert main(["replay", *arguments, "--config", str(config)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


@pytest.fixture
def scheduler() -> Iterator[str]:
    """A scheduler and two workers, processes of this computer, on loopback."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    ) as cluster:
        yield cluster.scheduler_address


def test_a_cluster_comes_to_the_same_bytes(
    logs: list[Path], config: Path, alone: dict[str, bytes], scheduler: str, tmp_path: Path
) -> None:
    command = ["replay", *map(str, logs), "--config", str(config), "--scheduler", scheduler]
    assert main([*command, "--output", str(tmp_path / "out")]) == 0
    assert written(tmp_path / "out") == alone
