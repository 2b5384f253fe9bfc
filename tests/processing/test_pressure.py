import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.processing.pressure import PressureCurve

CURVE = PressureCurve(2.88)


def test_the_published_parabola_is_reproduced_below_its_bend():
    units = np.linspace(0.0, 80.0, 200)
    ff = 2.88 * units
    expected = -0.001132 * ff**2 + 0.8141 * ff
    assert CURVE.kpa(units[:, np.newaxis])[:, 0] == pytest.approx(expected, abs=1e-9)


def test_one_unit_is_2_3_kpa_at_zero_load():
    assert CURVE.kpa(1.0)[0] == pytest.approx(2.335, abs=0.001)


@given(st.floats(-255.0, 255.0), st.floats(-255.0, 255.0))
def test_more_activation_is_never_less_pressure(one, other):
    low, high = sorted((one, other))
    assert CURVE.kpa(high)[0] >= CURVE.kpa(low)[0]


def test_a_saturated_taxel_reads_far_above_the_calibrated_range_and_not_below_zero():
    assert CURVE.kpa(255.0)[0] == pytest.approx(257.5, abs=0.1)
    assert CURVE.beyond_units[0] == pytest.approx(85.4, abs=0.1)


@given(st.floats(-30.0, 255.0), st.floats(0.5, 6.0), st.floats(0.5, 2.0))
def test_units_undo_kpa(units, unit_ff, gain):
    curve = PressureCurve(unit_ff, gain)
    assert curve.units(curve.kpa(units))[0] == pytest.approx(units, abs=1e-9)


@given(st.floats(0.0, 130.0))
def test_kpa_undo_units_below_130_kpa(kpa):
    assert CURVE.kpa(CURVE.units(kpa))[0] == pytest.approx(kpa, abs=1e-9)


def test_a_curve_that_bends_up_has_no_end():
    curve = PressureCurve(2.88, a=0.001)
    assert np.isinf(curve.beyond_units[0])
    assert curve.units(curve.kpa(200.0))[0] == pytest.approx(200.0)


def test_each_taxel_has_its_own_curve():
    curve = PressureCurve([2.88, 1.44], gain=[1.0, 2.0])
    one, other = curve.kpa([10.0, 10.0])
    assert one == pytest.approx(CURVE.kpa(10.0)[0])
    assert other == pytest.approx(2.0 * CURVE.kpa(5.0)[0])
    assert curve.part(np.array([False, True])).kpa(10.0)[0] == other


@pytest.mark.parametrize("wrong", [{"gain": 0.0}, {"b": -1.0}, {"gain": -2.0}])
def test_impossible_curves_are_refused(wrong):
    with pytest.raises(ValueError, match="positive"):
        PressureCurve(2.88, **wrong)


@pytest.mark.parametrize(
    "wrong",
    [
        {"unit_ff": 1e-300},
        {"unit_ff": 1e300},
        {"unit_ff": np.nan},
        {"gain": np.inf},
        {"gain": 1e-100},
        {"a": -1.0},
        {"a": 1.0},
        {"a": np.nan},
        {"b": 1e-300},
    ],
)
def test_a_curve_that_is_not_finite_and_rising_is_not_sound_and_is_flat(wrong):
    coefficients = {"unit_ff": 2.88, "gain": 1.0, "a": -0.001132, "b": 0.8141}
    two = {key: np.array([value, wrong.get(key, value)]) for key, value in coefficients.items()}
    curve = PressureCurve(**two)
    assert curve.sound.tolist() == [True, False]
    assert curve.part(np.array([1])).sound.tolist() == [False]
    assert curve.kpa([255.0, 255.0])[0] == CURVE.kpa(255.0)[0]
    assert curve.kpa([255.0, 255.0])[1] == 0.0
    assert np.isfinite(curve.units([9.0, 9.0])).all()
