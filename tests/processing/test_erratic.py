"""Pads that jump up and down are found, and forgiven when they have been calm."""

import numpy as np
import pytest

from skin_host.processing.curves import KNOTS_UNITS, TableCurve
from skin_host.processing.erratic import LIMIT, RELIEF, Erratic, step_kpa
from skin_host.processing.pressure import PressureCurve

STEP_KPA = 5.0


def samples(*kpa: float) -> np.ndarray:
    """The second of three pads; the first presses slowly, the third is quiet."""
    rows = np.zeros((len(kpa), 3), np.float32)
    rows[:, 0] = np.arange(len(kpa))
    rows[:, 1] = kpa
    return rows


def jumping(looks: int) -> Erratic:
    found = Erratic(np.array([STEP_KPA, STEP_KPA, np.inf]))
    for _ in range(looks):
        found.look(samples(0, 9, 0, 9))
    return found


def test_a_pad_that_jumps_again_and_again_is_erratic_and_the_others_are_not():
    assert not jumping(1).any
    found = jumping(2)
    assert found.any
    assert found.pads.tolist() == [False, True, False]


def test_a_press_and_a_release_that_lie_far_apart_are_no_jumps():
    found = jumping(0)
    for _ in range(20):
        found.look(samples(0, 9, 9, 9))  # up
        found.look(samples(9, 9, 0, 0))  # and down in a later look
    assert not found.any


def test_rare_jumps_are_forgotten():
    found = jumping(0)
    for _ in range(20):
        found.look(samples(0, 9, 0))
        for _ in range(round(1.0 / RELIEF)):
            found.look(samples(0, 0, 0))
    assert not found.any


def test_too_few_samples_show_no_jump():
    found = jumping(0)
    for _ in range(20):
        found.look(samples(0, 9))
    assert not found.any


def test_an_erratic_pad_is_believed_again_when_it_was_calm_for_a_minute():
    found = jumping(10)
    found.pass_time(59.5)
    assert found.pads[1]
    found.pass_time(1.0)
    assert not found.any
    assert not found.pads.any()


@pytest.mark.parametrize("jumps", [0, 10])
def test_a_new_zero_begins_without_old_jumps(jumps: int):
    found = jumping(jumps)
    found.reset(np.array([False, True, False]))
    assert not found.any
    found.look(samples(0, 9, 0))
    assert not found.any
    found.look(samples(0, 9, 0))
    assert found.any


def test_a_new_zero_of_one_pad_changes_nothing_of_another():
    found = jumping(10)
    for _ in range(100):
        found.reset(np.array([True, False, True]))
    assert found.pads.tolist() == [False, True, False]


def test_a_pad_that_jumped_for_long_is_a_suspect_no_longer_than_at_its_limit():
    found = jumping(100)
    for _ in range(round(LIMIT / RELIEF)):
        assert found.suspects
        found.look(samples(0, 0, 0))
    assert not found.suspects


def test_a_pad_is_a_suspect_from_its_first_jumps_until_they_are_forgotten():
    assert not jumping(0).suspects
    found = jumping(1)
    for _ in range(round((1.0 + RELIEF) / RELIEF)):
        assert found.suspects
        found.look(samples(0, 0, 0))
    assert not found.suspects


def test_too_few_samples_relieve_no_suspect():
    found = jumping(0)
    for _ in range(2):
        found.look(samples(0, 9, 0))
        for _ in range(round((1.0 + RELIEF) / RELIEF)):
            found.look(samples(0, 0))
    assert found.any


def test_noise_of_six_deviations_or_eight_units_is_no_jump():
    straight = PressureCurve([1.0, 1.0], a=0.0, b=2.0)
    assert step_kpa(straight, np.array([0.5, 2.0])).tolist() == [2.0 * 8.0, 2.0 * 6.0 * 2.0]


def test_a_jump_is_measured_by_the_mean_slope_of_the_curve_where_it_was_calibrated():
    noise_units = np.zeros(2)
    bent = PressureCurve([1.0, 2.0])
    slope = bent.kpa(bent.beyond_units) / bent.beyond_units
    assert step_kpa(bent, noise_units) == pytest.approx(8.0 * slope)
    # Of a curve that was measured up to less than a unit, the first unit counts.
    soft = TableCurve(np.tile(KNOTS_UNITS**2, (2, 1)), np.array([0.01, 100.0]))
    assert step_kpa(soft, noise_units) == pytest.approx(
        8.0 * soft.kpa(np.array([1.0, 100.0])) / np.array([1.0, 100.0])
    )
    # Of one that ends beyond what a byte can say, the byte's end.
    fine = PressureCurve([0.5])
    assert fine.beyond_units > 255.0
    slope = fine.kpa(np.array([255.0])) / 255.0
    assert step_kpa(fine, noise_units[:1]) == pytest.approx(8.0 * slope, rel=1e-9)
