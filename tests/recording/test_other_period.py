"""A recording of boards that send much more slowly than configured is refused by that name."""

from pathlib import Path

import pytest

from skin_host.cli import main
from tests.support.limbs import calibrate, ramp, write_config, write_log


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
