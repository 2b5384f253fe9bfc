"""Many recordings are processed side by side, each to the same bytes as alone."""

import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from skin_host.bus.logs import WINDOW_NS
from skin_host.bus.wire import TAXELS, TRIANGLES, encode_sweep
from skin_host.cli import main
from skin_host.recording import replay

PERIODS = 140


def recording(path: Path, seed: int) -> Path:
    """Seven seconds of a board at 20 Hz that is pressed at the end."""
    rng = np.random.default_rng(seed)
    lines = []
    for period in range(PERIODS):
        raw = rng.integers(239, 242, (TRIANGLES, TAXELS))
        raw[seed : seed + 2] -= 60 * (period > 110)
        ids, data = encode_sweep(
            1, np.arange(TRIANGLES), raw.astype(np.uint8), np.zeros(TRIANGLES, np.uint16)
        )
        for row, (identifier, payload) in enumerate(zip(ids.tolist(), data, strict=True)):
            t_us = 1_700_000_000_000_000 + period * 50_000 + row * 125
            stamp = f"{t_us // 1_000_000}.{t_us % 1_000_000:06d}"
            lines.append(f"({stamp}) can0 {identifier:X}#{payload.tobytes().hex()}\n")
    path.write_text("".join(lines))
    return path


@pytest.fixture
def logs(tmp_path: Path) -> list[Path]:
    return [recording(tmp_path / f"{name}.log", seed) for seed, name in enumerate("abc")]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "skin.toml"
    path.write_text(
        'robot = "fleet"\n[buses.can0]\nchannel = "can0"\n[boards.b]\nbus = "can0"\naddress = 1\n'
        '[[parts.arm.patches]]\nboard = "b"\ntriangles = "0-15"\n'
    )
    return path


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


def test_a_damaged_recording_is_told_and_stops_no_other(
    logs: list[Path], config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    with logs[1].open("a") as damaged:
        damaged.write("(17")
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
