"""What is left of an error when something of the truth is known."""

import numpy as np
import pytest

from skin_host.evaluation import real

TRUE_KPA = 100.0 + 100.0 * np.sin(np.linspace(0.0, 40.0, 4000))


def left(kpa, known):
    rows = real.errors_in_hindsight(kpa, np.ones_like(kpa, dtype=np.bool_), TRUE_KPA)
    (row,) = [row for row in rows if row["known"] == known]
    return row


def test_pads_with_wrong_curves_are_right_with_the_best_curve_of_each():
    kpa = np.stack([TRUE_KPA**1.2, 0.5 * TRUE_KPA, TRUE_KPA + 10.0], axis=1)
    assert left(kpa, real.AS_REPORTED)["median_rmse_kpa"] > 50.0
    assert left(kpa, real.OWN_CURVES)["p95_rmse_kpa"] < 1.0


def test_a_wrong_gain_of_all_is_removed_by_a_line_of_the_whole_skin():
    kpa = np.repeat(0.9 * TRUE_KPA[:, np.newaxis] - 5.0, 3, axis=1)
    for row in (left(kpa, real.ONE_LINE), left(kpa, real.COMMON_ERROR)):
        assert row["p95_rmse_kpa"] < 1e-6
        assert row["skin_rms_kpa"] < 1e-6


def test_noise_of_the_pads_stays_when_the_error_in_common_is_known():
    noise = np.random.default_rng(1).normal(0.0, 4.0, (len(TRUE_KPA), 40))
    drift = np.linspace(0.0, 30.0, len(TRUE_KPA))
    row = left(TRUE_KPA[:, np.newaxis] + drift[:, np.newaxis] + noise, real.COMMON_ERROR)
    assert row["median_rmse_kpa"] == pytest.approx(4.0, rel=0.05)


def test_the_nearest_rising_function_pools_what_falls():
    found = real.rising(np.array([1.0, 2.0, 3.0, 4.0]), np.array([1.0, 5.0, 3.0, 9.0]))
    assert found.tolist() == [1.0, 4.0, 4.0, 9.0]
