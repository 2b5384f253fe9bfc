"""The touch decision on recordings of real skin, where they are."""

from dataclasses import replace
from pathlib import Path

import pytest

from skin_host.evaluation import insole, real
from skin_host.processing.calibration import Verdict

RECORDINGS = Path(__file__).parents[3] / "shared" / "data" / "insole"
NAMES = ("left_calibration", "left_validation_1", "left_steps", "right_calibration")


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_touched_while_the_pressure_rests(name: str) -> None:
    path = RECORDINGS / f"{name}.npz"
    if not path.exists():
        pytest.skip(f"no recording {path}")
    whole = insole.read(path)
    rests = whole.t_ns - whole.t_ns[0] <= real.UNTOUCHED_S * 1e9
    recording = replace(
        whole,
        t_ns=whole.t_ns[rests],
        counts=whole.counts[rests],
        pressure_kpa=whole.pressure_kpa[: int(rests.sum())],
    )
    settings, layout = insole.skin()
    calibration = real.calibrate(recording, settings, layout)
    course = real.play(recording, settings, layout, calibration)
    assert len(course.t_ns) > 450
    assert not course.touched.any()
    assert len(course.begun_ns) == 0
    # Pads that jump between levels are noisy; at most a few rest far from all others.
    live = real.live_pads(recording)
    verdicts = calibration.verdict[insole.pads(layout)][live]
    assert (verdicts == Verdict.TOUCHED).sum() <= 4
