"""A board that sends each conversion several times hides no fault by that."""

from pathlib import Path

import pytest

from tests.support.fault_bench import CONFIG, FaultBench


@pytest.mark.parametrize("period_ms", [20, 25])
def test_a_noisy_pad_of_a_fast_board_is_named_within_2_s_and_touches_nothing(
    period_ms: int, tmp_path: Path
) -> None:
    config = tmp_path / "fast.toml"
    line = 'bus = "can0"\n'
    config.write_text(CONFIG.read_text().replace(line, f"{line}period_ms = {period_ms}\n"))
    bench = FaultBench(config=config, settle_s=3.0)
    part = bench.layout.parts[0]
    board = bench.layout.boards[part.boards[0]]
    assert board.settings.period_ms == period_ms
    bench.inject("noisy_taxel", board=board.name, triangle=0, taxel=3)
    touched = 0
    for _ in range(80):
        bench.run(0.05)
        touched += int(bench.touched[part.name].any())
    assert bench.first_told[("taxel_noisy", part.name)] - bench.since_s < 2.0
    assert not touched
