import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.evaluation.papers.fusion import angle_derivatives, contact_angle, position_sd_mm

RADIUS = 15.7


def push(theta, psi, force):
    fx, fy = force * np.cos(psi), force * np.sin(psi)
    return fx, fy, RADIUS * (np.cos(theta) * fy - np.sin(theta) * fx)


@given(theta=st.floats(-3.0, 3.0), lean=st.floats(-1.4, 1.4), force=st.floats(0.01, 100.0))
def test_the_angle_comes_back_all_around_the_circle(theta, lean, force):
    found = contact_angle(*push(theta, theta + lean, force), RADIUS)
    off = np.angle(np.exp(1j * (found - theta)))
    assert abs(off) < 1e-7


def test_too_great_a_moment_is_no_contact():
    assert np.isnan(contact_angle(1.0, 0.0, RADIUS, RADIUS))
    assert np.isnan(contact_angle(0.0, 0.0, 0.0, RADIUS))
    assert np.isfinite(contact_angle(1.0, 0.0, 0.99 * RADIUS, RADIUS))


@given(theta=st.floats(-1.5, 1.5), lean=st.floats(-1.2, 1.2), force=st.floats(0.5, 20.0))
def test_the_derivatives_are_those_of_the_angle(theta, lean, force):
    fx, fy, m = push(theta, theta + lean, force)
    d = angle_derivatives(fx, fy, m, RADIUS)
    h = 1e-5 * force

    def slope(lower, upper, width):
        return np.angle(np.exp(1j * (contact_angle(*upper) - contact_angle(*lower)))) / width

    np.testing.assert_allclose(
        d.fx, slope((fx - h, fy, m, RADIUS), (fx + h, fy, m, RADIUS), 2 * h), rtol=1e-4, atol=1e-7
    )
    np.testing.assert_allclose(
        d.fy, slope((fx, fy - h, m, RADIUS), (fx, fy + h, m, RADIUS), 2 * h), rtol=1e-4, atol=1e-7
    )
    np.testing.assert_allclose(
        d.m, slope((fx, fy, m - h, RADIUS), (fx, fy, m + h, RADIUS), 2 * h), rtol=1e-4, atol=1e-7
    )
    np.testing.assert_allclose(
        d.r,
        slope((fx, fy, m, RADIUS - 1e-5), (fx, fy, m, RADIUS + 1e-5), 2e-5),
        rtol=1e-4,
        atol=1e-7,
    )


@pytest.mark.parametrize(
    ("name", "low_mm", "high_mm"),
    [("fx", 0.0, 0.0), ("fy", -1.87, 1.75), ("m", 1.76, -1.88), ("r", -2.38, 1.47)],
)
def test_the_eight_numbers_of_figure_4(name, low_mm, high_mm):
    # Contact at theta 0, force leaning by 30 degrees, one quantity off by 20 %.
    nominal = dict(zip(("fx", "fy", "m"), push(0.0, np.deg2rad(30), 1.0), strict=True))
    for change, wanted in ((0.8, low_mm), (1.2, high_mm)):
        off = {**nominal, "r": RADIUS}
        off[name] *= change
        found = RADIUS * contact_angle(off["fx"], off["fy"], off["m"], off["r"])
        if name == "fx":
            # The figure's line lies on zero: fx turns the force and its lever alike.
            assert found == pytest.approx(0.0, abs=1e-9)
        else:
            assert found == pytest.approx(wanted, abs=0.005)


def test_the_predicted_deviation_agrees_with_monte_carlo():
    rng = np.random.default_rng(10)
    fx, fy, m = push(0.1, 0.5, 3.0)
    noise = rng.normal(size=(3, 50_000))
    found = contact_angle(fx + 0.02 * noise[0], fy + 0.02 * noise[1], m + 0.4 * noise[2], RADIUS)
    predicted = position_sd_mm(fx, fy, m, RADIUS, force_sd_n=0.02, torque_sd_nmm=0.4)
    assert RADIUS * found.std() == pytest.approx(predicted, rel=0.03)
