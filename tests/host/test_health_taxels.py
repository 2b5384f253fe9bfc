"""Zeros of taxels that go astray over minutes are told, with what to do about them."""

from pathlib import Path

import pytest

from emulator.scene import load
from tests.support.fault_bench import FaultBench

HELD_SCENE = """
about = "Something is put on the forearm and stays."
spread = false

[[probe]]
part = "left_forearm"
at = { taxel = 27 }
diameter_mm = 3
pressure_kpa = [[0, 0], [0.2, 100], [600, 100]]
start_s = 12
"""


def codes(bench: FaultBench, part: str) -> set[str]:
    return {fault["code"] for fault in bench.records[part]["faults"]}


@pytest.fixture
def close_limit() -> FaultBench:
    """A robot whose baselines may move by two units only."""
    bench = FaultBench()
    bench.engine.settings.processing.drift.limit_units = 2.0
    calibration = bench.engine.calibration
    assert calibration is not None
    bench.engine.use(calibration)
    bench.run(2.0)
    return bench


def test_a_zero_that_drifts_is_told_and_told_again_when_it_can_follow_no_farther(
    close_limit: FaultBench,
) -> None:
    bench = close_limit
    assert not codes(bench, "left_hand") & {"taxel_drifting", "taxel_at_limit"}
    bench.inject("temperature_step", value=3.0)
    for _ in range(60):
        bench.run(1.0)
        if "taxel_at_limit" in codes(bench, "left_hand"):
            break
    first = {code: since_s for (code, part), since_s in bench.first_told.items()}
    assert first["taxel_drifting"] < first["taxel_at_limit"]
    record = bench.records["left_hand"]
    assert set(record["baseline_at_limit"]) <= set(record["taxel_faults"]["drifting"])
    (says,) = (line for line in record["sentences"] if "cannot follow any farther" in line)
    assert "calibrate" in says


def test_a_touch_that_never_ends_hides_a_zero_and_that_is_told(tmp_path: Path) -> None:
    scene = tmp_path / "held.toml"
    scene.write_text(HELD_SCENE)
    bench = FaultBench(scene=load(scene))
    bench.engine.settings.processing.drift.frozen_report_s = 4.0
    while bench.t_s < 14.0:
        bench.run(0.5)
    assert "taxel_held" not in codes(bench, "left_forearm")
    bench.run(4.0)
    assert "taxel_held" in codes(bench, "left_forearm")
    assert 27 in bench.records["left_forearm"]["baseline_frozen"]
    # It is touched all the same, and believed.
    assert bench.touched["left_forearm"][27]
    assert bench.valid["left_forearm"][27]
