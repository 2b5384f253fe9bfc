"""Gain and bend of each taxel from known uniform pressures."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.processing.fitting.course import BEND_RANGE, GAIN_RANGE, fit_gains

LEVELS_FF = np.linspace(10.0, 200.0, 6)[:, np.newaxis]


def curve(units_ff, gain=1.0, bend=1.0):
    linear, square = 0.8141 * units_ff, -0.001132 * units_ff**2
    return linear, square, gain * (linear + bend * square)


def test_a_gain_is_found_from_one_level():
    linear, square, pressure = curve(np.array([[20.0]]), gain=1.3)
    found = fit_gains(pressure[:, 0], linear, square, np.ones(1, bool))
    assert found.gain[0] == pytest.approx(1.3)
    assert not found.bent[0]
    assert found.rms_after_kpa < 1e-9 < found.rms_before_kpa


def test_a_bend_is_found_where_levels_are_many_and_high():
    ff = np.linspace(10.0, 200.0, 6)[:, np.newaxis]
    linear, square, pressure = curve(ff, gain=1.1, bend=0.7)
    found = fit_gains(pressure[:, 0], linear, square, np.ones(1, bool))
    assert found.bent[0]
    assert (found.gain[0], found.bend[0]) == (pytest.approx(1.1), pytest.approx(0.7))


def test_a_bend_is_not_believed_where_levels_are_low():
    ff = np.array([[10.0], [20.0], [30.0]])
    linear, square, pressure = curve(ff, bend=0.5)
    found = fit_gains(pressure[:, 0], linear, square, np.ones(1, bool))
    assert not found.bent[0]
    assert found.bend[0] == 1.0


def test_a_taxel_that_feels_nothing_keeps_the_common_curve():
    linear, square, pressure = curve(np.array([[20.0, 0.0]]))
    found = fit_gains(pressure[:, 0], linear, square, np.ones(2, bool))
    assert list(found.fitted) == [True, False]
    assert found.gain[1] == 1.0


@pytest.mark.parametrize("levels", [[], [0.0, 10.0], [-5.0]])
def test_levels_must_be_pressures(levels):
    with pytest.raises(ValueError, match="positive"):
        fit_gains(np.array(levels), np.ones((len(levels), 1)), np.ones((len(levels), 1)), [True])


def test_each_taxel_has_its_own_gain_and_bend():
    gains, bends = np.array([0.8, 1.0, 1.2]), np.array([0.6, 1.0, 1.3])
    level = np.array([10.0, 25.0, 40.0, 60.0, 80.0, 100.0])
    # What a taxel must read for its curve to say the level: the rising root of its parabola.
    a, b = -0.001132 * gains * bends, 0.8141 * gains
    ff = (b - np.sqrt(b**2 + 4 * a * level[:, np.newaxis])) / (-2 * a)
    linear, square, _ = curve(ff)
    found = fit_gains(level, linear, square, np.ones(3, bool))
    assert found.gain == pytest.approx(gains)
    assert found.bend == pytest.approx(bends)
    assert found.rms_after_kpa < 1e-9 < found.rms_before_kpa


def test_whole_units_move_a_gain_by_less_than_a_hundredth():
    rng = np.random.default_rng(4)
    ff = np.repeat(LEVELS_FF, 200, axis=1)
    _, _, pressure = curve(ff, gain=1.1)
    read = np.rint(ff / 2.88 + rng.normal(0.0, 0.4, ff.shape)) * 2.88
    linear, square, _ = curve(read)
    found = fit_gains(pressure[:, 0], linear, square, np.ones(200, bool))
    assert found.gain.mean() == pytest.approx(1.1, abs=0.01)
    assert found.rms_after_kpa < found.rms_before_kpa


def test_a_taxel_that_is_not_believed_keeps_the_common_curve():
    linear, square, pressure = curve(np.repeat(LEVELS_FF, 2, axis=1), gain=1.3)
    found = fit_gains(pressure[:, 0], linear, square, np.array([True, False]))
    assert list(found.fitted) == [True, False]
    assert (found.gain[1], found.bend[1]) == (1.0, 1.0)


def test_a_gain_that_no_pad_has_is_not_believed():
    linear, square, pressure = curve(LEVELS_FF, gain=2.0 * GAIN_RANGE[1])
    found = fit_gains(pressure[:, 0], linear, square, np.ones(1, bool))
    assert not found.fitted[0]
    assert (found.gain[0], found.bend[0]) == (1.0, 1.0)


def test_a_bend_that_no_foam_has_is_not_believed():
    linear, square, pressure = curve(LEVELS_FF, bend=0.5 * BEND_RANGE[0])
    found = fit_gains(pressure[:, 0], linear, square, np.ones(1, bool))
    assert found.fitted[0]
    assert not found.bent[0]


def test_two_levels_are_too_few_for_a_bend():
    linear, square, pressure = curve(LEVELS_FF[-2:], bend=0.7)
    assert not fit_gains(pressure[:, 0], linear, square, np.ones(1, bool)).bent[0]


@given(
    st.floats(0.3, 3.0),
    st.floats(0.3, 1.5),
    st.lists(st.floats(5.0, 150.0), min_size=1, max_size=8, unique=True),
)
def test_a_fit_is_never_worse_than_the_common_curve(gain, bend, levels_ff):
    linear, square, pressure = curve(np.array(levels_ff)[:, np.newaxis], gain, bend)
    found = fit_gains(pressure[:, 0], linear, square, np.ones(1, bool))
    assert np.all(np.isfinite(found.gain)) and np.all(np.isfinite(found.bend))
    assert found.rms_after_kpa <= found.rms_before_kpa + 1e-9
