"""The touch decision on recordings of real skin, where they are."""

from dataclasses import replace
from pathlib import Path

import numpy as np
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


@pytest.mark.parametrize("share", [1.0, 0.2])
def test_what_stood_on_the_skin_when_it_was_calibrated_is_felt_after_some_steps(
    share: float,
) -> None:
    """Two seconds of 101 kPa, a second of rest, and so on, all recorded. Where a share of the pads
    is loaded, which is half of those that can be used, the others rest.
    """
    path = RECORDINGS / "left_steps.npz"
    if not path.exists():
        pytest.skip(f"no recording {path}")
    whole = insole.read(path)
    time_s = (whole.t_ns - whole.t_ns[0]) / 1e9
    load = np.flatnonzero((time_s > 71.0) & (time_s < 80.0))
    rest = np.flatnonzero(time_s < 8.0)
    assert np.ptp(np.percentile(whole.pressure_kpa[load], [5, 95])) < 8.0
    stride = [np.r_[rest[49 * n : 49 * (n + 1)], load[98 * n : 98 * (n + 1)]] for n in range(4)]
    sweeps = np.concatenate([load, *stride, *stride, *stride])
    counts = whole.counts[sweeps]
    loaded = np.arange(counts.shape[1]) < share * counts.shape[1]
    counts[:, ~loaded] = whole.counts[np.resize(rest, len(sweeps))][:, ~loaded]
    recording = replace(
        whole,
        t_ns=whole.t_ns[0] + np.arange(len(sweeps)) * round(1e9 / 49.0),
        counts=counts,
        pressure_kpa=whole.pressure_kpa[sweeps],
    )
    settings, layout = insole.skin()
    calibration = real.calibrate(recording, settings, layout)
    course = real.play(recording, settings, layout, calibration)
    usable = calibration.usable[insole.pads(layout)] & real.live_pads(recording)
    pressed = (recording.pressure_kpa[course.sweep] > 60.0) & (course.sweep > 2 * len(sweeps) // 3)
    untouched = course.valid & ~course.touched
    assert untouched[np.ix_(pressed, usable & loaded)].mean() < 0.25
    assert not course.touched[:, usable & ~loaded].any()
