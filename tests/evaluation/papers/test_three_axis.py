import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skin_host.errors import CalibrationError
from skin_host.evaluation.papers.grasp_loops import (
    ThreeAxisSensor,
    dome,
    fit_bilinear,
    fit_shear,
    in_element_frame,
)
from skin_host.evaluation.papers.truth import OpticalDome


def test_the_dome_has_41_elements_and_the_papers_meridian():
    layout = dome()
    assert len(layout.azimuth_rad) == 41
    np.testing.assert_allclose(np.linalg.norm(layout.position_mm, axis=1), 20.0)
    # Elements 0, 1, 5, 9, 17, 25, 33 are tested along one meridian; 9 and 17 have one latitude.
    meridian = layout.position_mm[[0, 1, 5, 9, 17, 25, 33]]
    np.testing.assert_allclose(meridian[:, 1], 0.0, atol=1e-12)
    assert layout.latitude_rad[9] == layout.latitude_rad[17]


def test_the_elements_frames_are_right_handed_and_point_south_and_east():
    layout = dome()
    np.testing.assert_allclose(np.cross(layout.south, layout.east), layout.normal, atol=1e-12)
    assert (layout.south[1:, 2] < 0).all()
    np.testing.assert_allclose(layout.east[:, 2], 0.0)


@given(
    knee=st.floats(0.4, 1.6),
    lower=st.floats(1e-4, 5e-4),
    ratio=st.floats(1.6, 4.0),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=40, deadline=None)
def test_the_knot_of_two_slopes_is_found_within_2_percent(knee, lower, ratio, seed):
    rng = np.random.default_rng(seed)
    force = np.linspace(0.0, 2.0, 81)
    grey = np.where(force < knee, force / lower, knee / lower + (force - knee) / (lower * ratio))
    grey = grey + 0.0002 * grey.max() * rng.normal(size=len(force))
    fitted = fit_bilinear(grey, force)
    assert fitted.knot == pytest.approx(knee / lower, rel=0.02)
    assert fitted.lower == pytest.approx(lower, rel=0.02)
    assert fitted.upper == pytest.approx(lower * ratio, rel=0.05)


def test_the_curve_is_continuous_and_rises():
    fitted = fit_bilinear([0, 100, 200, 300, 350, 400, 450], [0, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9])
    assert fitted.knot == pytest.approx(300.0, rel=1e-6)
    around = fitted.force_n(fitted.knot + np.array([-1e-6, 0, 1e-6]))
    assert np.ptp(around) < 1e-8
    assert (np.diff(fitted.force_n(np.linspace(0, 1000, 200))) > 0).all()
    assert fitted.force_n(-50.0) == 0.0


@pytest.mark.parametrize(
    ("grey", "force", "words"),
    [
        ([0, 1, 2], [0, 1, 2], "wanted at least 5"),
        ([1, 2, 3, 4, 5, 6], [1, 2, 3, 2, 1, 0], "rises with the load"),
    ],
)
def test_elements_that_cannot_be_calibrated_are_refused(grey, force, words):
    with pytest.raises(CalibrationError, match=words):
        fit_bilinear(grey, force)


def test_a_centroid_that_does_not_follow_the_shear_is_refused():
    with pytest.raises(CalibrationError, match="does not move"):
        fit_shear([0.0, -1.0], [0.0, 1.0])


def test_the_projection_undoes_the_cameras_foreshortening():
    rng = np.random.default_rng(1)
    layout = dome()
    local = rng.normal(size=(41, 2))
    seen = local[:, :1] * layout.south + local[:, 1:] * layout.east
    picture = seen[:, :2]  # the camera looks along z
    _, found = in_element_frame(layout, np.ones(41), picture)
    np.testing.assert_allclose(found, local, atol=1e-12)


def calibrated(rng):
    """A dome of the emulator, calibrated by pressing each element, and its curves."""
    layout = dome()
    camera = OpticalDome(layout.azimuth_rad, layout.latitude_rad, rng)
    push = np.linspace(0.0, 2.0, 41)
    force = np.zeros((41, 41, 3))
    force[..., 2] = -push[:, None]
    grey, _ = camera.read(force)
    own_grey, _ = in_element_frame(layout, grey, np.zeros((*grey.shape, 2)))
    curves = [fit_bilinear(own_grey[:, i], push) for i in range(41)]
    sheared = np.zeros((21, 41, 3))
    sheared[..., 0] = np.linspace(-1, 1, 21)[:, None]
    sheared[..., 2] = -1.0
    _, moved = in_element_frame(layout, *camera.read(sheared))
    return layout, camera, curves, fit_shear(moved[..., 0], sheared[..., 0])


def test_two_lines_fit_each_element_as_well_as_in_the_paper():
    _, _, curves, _ = calibrated(np.random.default_rng(2))
    correlation = np.array([curve.correlation for curve in curves])
    assert (correlation > 0.911).all()  # the paper: 0.911 to 0.997


def test_three_forces_of_every_element_come_back():
    rng = np.random.default_rng(3)
    layout, camera, curves, stiffness = calibrated(rng)
    sensor = ThreeAxisSensor(layout, curves, stiffness)
    lean, turn = rng.uniform(-0.5, 0.5, (200, 41)), rng.uniform(0, 2 * np.pi, (200, 41))
    size = rng.uniform(0.3, 2.0, (200, 41))
    force = np.stack(
        [
            size * np.sin(lean) * np.cos(turn),
            size * np.sin(lean) * np.sin(turn),
            -size * np.cos(lean),
        ],
        axis=-1,
    )
    found = sensor.forces(*camera.read(force))
    error = np.abs(found - force)
    assert np.percentile(error[..., 2], 95) < 0.1
    assert np.percentile(error[..., :2], 95) < 0.02
    # 30 degrees of inclination change the normal force by no more than the paper's 3.7 %.
    assert np.median(error[..., 2] / size) < 0.037


def test_the_shear_curve_is_common_to_all_inclinations():
    rng = np.random.default_rng(4)
    layout, camera, _, stiffness = calibrated(rng)
    for degrees in (15, 30, 45, 60):
        size = np.linspace(0.2, 1.0, 15)[:, None]
        force = np.zeros((15, 41, 3))
        force[..., 0] = size * np.sin(np.deg2rad(degrees))
        force[..., 2] = -size * np.cos(np.deg2rad(degrees))
        _, moved = in_element_frame(layout, *camera.read(force))
        assert fit_shear(moved[..., 0], force[..., 0]) == pytest.approx(stiffness, rel=0.02)


def test_the_sum_over_elements_is_the_force_on_the_fingertip():
    layout = dome()
    rng = np.random.default_rng(5)
    world = rng.normal(size=(41, 3))
    local = np.stack(
        [(world * axis).sum(axis=1) for axis in (layout.south, layout.east, layout.normal)], axis=-1
    )
    curves = [fit_bilinear(np.arange(1.0, 9.0), np.arange(1.0, 9.0))] * 41
    sensor = ThreeAxisSensor(layout, curves, 1.0)
    np.testing.assert_allclose(sensor.total_force(local), world.sum(axis=0))
    with pytest.raises(CalibrationError, match="40 calibrations"):
        ThreeAxisSensor(layout, curves[:40], 1.0)
