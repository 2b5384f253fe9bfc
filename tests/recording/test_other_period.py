"""Of boards that send at another period than configured a recording shows that, not silence."""

import json
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from skin_host.cli import main
from tests.support.broker import Mosquitto
from tests.support.limbs import HZ, PADS, calibrate, ramp, write_config, write_log


@pytest.mark.parametrize("period_ms", [10, 20])
def test_boards_that_send_much_more_slowly_than_configured_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], period_ms: int
) -> None:
    bench = write_config(tmp_path)
    bench.write_text(bench.read_text().replace("period_ms = 200", f"period_ms = {period_ms}"))
    units, table = ramp(bench)
    log = write_log(tmp_path / "slow.log", units)
    output = tmp_path / "slow.jsonl"
    words = "replay", log, "--config", bench, "--output", output
    assert main([str(word) for word in words]) != 0
    error = capsys.readouterr().err
    assert f"a sends every 200 ms (configured: {period_ms} ms)" in error
    assert "b sends every 200 ms" in error
    assert not output.exists()
    assert calibrate(bench, log, table) != 0
    assert f"a sends every 200 ms (configured: {period_ms} ms)" in capsys.readouterr().err


@pytest.mark.parametrize(("period_ms", "is_slow"), [(40, True), (60, False)])
def test_a_recording_of_which_little_counts_for_that_is_processed_with_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], period_ms: int, is_slow: bool
) -> None:
    bench = write_config(tmp_path)
    bench.write_text(bench.read_text().replace("period_ms = 200", f"period_ms = {period_ms}"))
    log = write_log(tmp_path / "slow.log", ramp(bench)[0])
    output = tmp_path / "slow.jsonl"
    words = "replay", log, "--config", bench, "--output", output
    assert main([str(word) for word in words]) == 0
    error = capsys.readouterr().err
    assert ("a sends every 200 ms (configured: 40 ms), b sends every 200 ms" in error) == is_slow
    assert ("wanted boards.NAME.period_ms as in the recording" in error) == is_slow
    last_frame = [line for line in output.read_text().splitlines() if '"frame"' in line][-1]
    assert any(json.loads(last_frame)["valid"]) != is_slow


@pytest.mark.parametrize(("period_ms", "is_slow"), [(40, True), (60, False)])
def test_what_is_exported_and_drawn_of_it_comes_with_the_same_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], period_ms: int, is_slow: bool
) -> None:
    bench = write_config(tmp_path)
    bench.write_text(bench.read_text().replace("period_ms = 200", f"period_ms = {period_ms}"))
    log = write_log(tmp_path / "slow.log", ramp(bench)[0])
    tables, picture = tmp_path / "slow.npz", tmp_path / "slow.png"
    for words in (
        ("replay", log, "--config", bench, "--output", tmp_path / "slow.jsonl"),
        ("export", log, tables, "--config", bench),
        ("plot", "pressure", log, picture, "--config", bench, "--part", "arm"),
    ):
        assert main([str(word) for word in words]) == 0
        slow = [line for line in capsys.readouterr().err.splitlines() if " sends every " in line]
        assert len(slow) == is_slow
        assert all(
            line.startswith(f"warning: {log}: a sends every 200 ms (configured: 40 ms)")
            for line in slow
        )


def test_frames_that_slow_boards_lost_cost_no_pad_its_zero(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of 5 sweeps a second the first seconds have hardly enough."""
    bench = write_config(tmp_path)
    log = write_log(tmp_path / "slow.log", np.zeros((round(20 * HZ), 2 * PADS)))
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join(line for number, line in enumerate(lines) if number % 37))
    output = tmp_path / "slow.jsonl"
    words = "replay", log, "--config", bench, "--output", output
    assert main([str(word) for word in words]) == 0
    assert capsys.readouterr().err == ""
    for line in output.read_text().splitlines()[-2:]:
        assert json.loads(line)["valid_taxels"] == PADS


def sped_up(log: Path, late_s: str) -> Path:
    """Return a copy of a log in half the time, of which every second sweep is late by this."""
    found = log.with_name("fast.log")
    lines = [line.split(") ", 1) for line in log.read_text().splitlines()]
    first_s = Decimal(lines[0][0][1:])
    with found.open("w") as file:
        for stamp, frame in lines:
            passed_s = (Decimal(stamp[1:]) - first_s) / 2
            is_late = int(float(passed_s) * HZ * 2) % 2
            file.write(f"({first_s + passed_s + is_late * Decimal(late_s):.6f}) {frame}\n")
    return found


@pytest.mark.parametrize(("late_s", "is_named"), [("0", False), ("0.01", True)])
def test_boards_whose_frames_come_as_those_of_two_at_one_address_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], late_s: str, is_named: bool
) -> None:
    bench = write_config(tmp_path)
    log = sped_up(write_log(tmp_path / "slow.log", ramp(bench)[0]), late_s)
    output = tmp_path / "fast.jsonl"
    words = "replay", log, "--config", bench, "--output", output
    assert main([str(word) for word in words]) == 0
    error = capsys.readouterr().err
    named = (
        "a (configured: 200 ms), b (configured: 200 ms): at the end frames came as often" in error
    )
    assert named == is_named
    assert ("wanted boards.NAME.period_ms as in the recording" in error) == is_named
    last_frame = [line for line in output.read_text().splitlines() if '"frame"' in line][-1]
    assert any(json.loads(last_frame)["valid"]) != is_named


def test_what_is_played_of_it_to_a_broker_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], mosquitto: Mosquitto
) -> None:
    bench = write_config(tmp_path)
    bench.write_text(bench.read_text().replace("period_ms = 200", "period_ms = 40"))
    log = write_log(tmp_path / "slow.log", ramp(bench)[0])
    words = "replay", log, "--config", bench, "--onto", "broker", "--speed", 1000
    url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    assert main([*(str(word) for word in words), "--broker", url]) == 0
    assert "a sends every 200 ms (configured: 40 ms)" in capsys.readouterr().err
