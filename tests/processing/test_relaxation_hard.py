"""Hard cases of the relaxation models.

Half a day by default. The full length is five days:

    SOAK_DAYS=5 pytest tests/processing/test_relaxation_hard.py -k days
"""

import os

import numpy as np
import pytest

from skin_host.config.relaxation import FITTED
from skin_host.processing.relaxation import (
    AsymmetricRelaxation,
    make_model,
    stand_in,
)

DAYS = float(os.environ.get("SOAK_DAYS", "0.5"))


def default(n=1, dtype="float64"):
    return make_model("asymmetric", n, stand_in("asymmetric", "mid"), dtype=dtype)


def sine(time_s):
    return 25.0 + 25.0 * np.sin(2.0 * np.pi * time_s / 7.0)


def play(model, times_s):
    """Drive with the sine, each sample holding since the last; the last answer."""
    last_s, answer = 0.0, None
    for now_s in times_s:
        answer = model.step(np.array([sine(now_s)]), now_s - last_s)[0]
        last_s = now_s
    return answer


def test_a_slow_mode_in_float32_reaches_what_float64_reaches_in_steps_of_a_second():
    tau_s, seconds = 3600.0, 300
    slow = {"beta": [1.0], "tau_s": [tau_s], "tau_unload_s": [tau_s]}
    twenty = np.full(1, 20.0, np.float32)
    model = AsymmetricRelaxation(1, **slow, dtype="float32")
    model.step(twenty, 5.0 * tau_s)
    for _ in range(seconds):
        answer = model.step(twenty, 1.0)[0]
    exact = 20.0 * -np.expm1(-5.0 - seconds / tau_s)
    assert answer == pytest.approx(exact, abs=3e-3)


@pytest.mark.long
def test_days_of_noisy_work_in_float32_stay_with_float64():
    """Windows of 50 and of 100 samples side by side: hours-long holds, and grasps."""
    rng = np.random.default_rng(5)
    seconds = round(86_400 * DAYS)
    level = np.where(
        np.arange(seconds) % 7200 < 3600, 60.0, 40.0 * (rng.uniform(size=seconds) < 0.3)
    )
    noise = rng.normal(0.0, 1.0, (seconds, 4)) / np.sqrt([50, 50, 100, 100])
    samples = np.maximum(level[:, np.newaxis] + noise, 0.0)
    single, double = (default(4, dtype=kind) for kind in ("float32", "float64"))
    apart = np.empty(seconds)
    for second, sample in enumerate(samples):
        difference = single.step(sample, 1.0) - double.step(sample, 1.0)
        apart[second] = np.abs(difference).max()
    first, last = apart[: seconds // 2].max(), apart[seconds // 2 :].max()
    assert max(first, last) < 0.01
    assert last < 2.0 * first


@pytest.mark.parametrize("hz", [50, 100])
def test_samples_of_an_hour_in_float32_stay_with_float64(hz):
    rng = np.random.default_rng(hz)
    single, double = (default(2, dtype=kind) for kind in ("float32", "float64"))
    for minute in range(60):
        level = 60.0 * (minute % 3 < 2)
        for sample in np.maximum(level + rng.normal(0.0, 1.0, (hz, 2)), 0.0):
            difference = single.step(sample, 1.0 / hz) - double.step(sample, 1.0 / hz)
            assert np.abs(difference).max() < 0.01
        for model in (single, double):
            model.step(np.full(2, level), 59.0)


@pytest.mark.long
def test_after_1e5_cycles_the_default_in_float32_repeats_itself():
    model = default(dtype="float32")
    pressed, free = np.full(1, 50.0, np.float32), np.zeros(1, np.float32)
    peaks = []
    for cycle in range(100_000):
        peak = float(model.step(pressed, 5.0)[0])
        model.step(free, 5.0)
        if cycle in (19_999, 99_999):
            peaks.append(peak)
    assert peaks[1] == pytest.approx(peaks[0], abs=1e-4)


def test_the_relaxation_of_a_cycle_settles_and_stays():
    model = default()
    peaks = []
    for cycle in range(20_000):
        peak = model.step(np.array([50.0]), 5.0)[0]
        model.step(np.zeros(1), 5.0)
        if cycle in (9_999, 19_999):
            peaks.append(peak)
    assert peaks[1] == pytest.approx(peaks[0], abs=1e-9)
    assert peaks[1] < 50.0 * sum(stand_in("asymmetric", "mid").beta)


def test_true_times_make_jitter_harmless():
    rng = np.random.default_rng(1)
    even_s = np.arange(1, 15_001) * 0.02
    jittered_s = even_s + rng.uniform(-0.009, 0.009, even_s.size)
    jittered_s[-1] = even_s[-1]
    assert play(default(), jittered_s) == pytest.approx(play(default(), even_s), abs=0.02)


@pytest.mark.parametrize("lost", [0.01, 0.1, 0.3])
def test_true_times_make_lost_samples_harmless(lost):
    even_s = np.arange(1, 15_001) * 0.02
    kept = np.random.default_rng(2).uniform(size=even_s.size) > lost
    kept[-1] = True
    assert play(default(), even_s[kept]) == pytest.approx(play(default(), even_s), abs=0.05)


@pytest.mark.parametrize("gap_s", [1.0, 5.0, 30.0])
def test_a_gap_is_nearly_forgotten_after_a_minute(gap_s):
    even_s = np.arange(1, 9_001) * 0.02
    inside = (even_s > 100.0) & (even_s < 100.0 + gap_s)
    assert play(default(), even_s[~inside]) == pytest.approx(play(default(), even_s), abs=0.3)


def test_late_samples_change_nothing_but_their_own_moment():
    model, late = default(), default()
    for _ in range(100):
        expected = model.step(np.array([30.0]), 0.04)
    for number in range(100):
        # Two samples swap their lengths: one came late, the next soon after it.
        seen = late.step(np.array([30.0]), 0.04 + (0.03 if number % 2 else -0.03))
    assert seen == pytest.approx(expected, abs=1e-9)


def test_values_that_are_no_numbers_never_leave_a_trace():
    clean, spoilt = default(3), default(3)
    rng = np.random.default_rng(4)
    for sweep in range(2_000):
        sample = np.array([40.0, 20.0, 0.0])
        expected = clean.step(sample, 0.02)
        if rng.uniform() < 0.02:
            sample[rng.integers(3)] = rng.choice([np.nan, np.inf, -np.inf])
        with np.errstate(invalid="ignore"):
            seen = spoilt.step(sample, 0.02)
        assert np.isfinite(seen).all(), sweep
    assert seen == pytest.approx(expected, abs=1e-6)


def test_states_that_die_out_cost_no_more_than_states_that_live():
    """Denormal numbers would make each step several times slower; there must be none."""
    model = AsymmetricRelaxation(4, beta=[0.3], tau_s=[0.4], tau_unload_s=[0.4], dtype=np.float32)
    model.step(np.full(4, 50.0, np.float32), 1.0)
    tiny = np.finfo(np.float32).tiny
    for _ in range(2_000):
        answer = model.step(np.zeros(4, np.float32), 0.02)
        assert np.all((answer == 0.0) | (answer >= tiny))
    assert not answer.any()


@pytest.mark.parametrize("dt_s", [1e-6, 1e3, 1e9])
def test_no_step_is_too_short_or_too_long(dt_s):
    for name in FITTED:
        model = make_model(name, 1, stand_in(name, "mid"))
        for _ in range(5):
            answer = model.step(np.array([80.0]), dt_s)[0]
            assert np.isfinite(answer)
            assert -1e-9 <= answer <= 80.0 * 0.4
