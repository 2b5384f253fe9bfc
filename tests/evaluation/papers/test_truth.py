import numpy as np
import pytest

from skin_host.evaluation.papers.fusion import RATE_HZ, TASKS, make_task
from skin_host.evaluation.papers.truth import (
    PRINTED_MATRIX,
    LoadPatch,
    OpticalDome,
    PlanarGauges,
    StripArray,
    box_patch,
    pin_patch,
    planar_load,
)

PLACES = np.linspace(-7, 7, 8)
POINT = LoadPatch(np.zeros((1, 2)), np.ones(1))


def plain_array(columns=PLACES, rows=PLACES, **traits):
    """The bare solid-mechanics model, with no noise."""
    kept = {"noise": 0.0, "gain_sd": 0.0, "shear_far": 0.0, "shear_local": 1.0} | traits
    return StripArray(columns, rows, np.random.default_rng(0), **kept)


def profile(lean_deg, **traits):
    x = np.linspace(-8, 8, 3201)
    lean = np.deg2rad(lean_deg)
    array = plain_array(x, np.zeros(1), **traits)
    return x, array.read(0.0, np.cos(lean), np.sin(lean), POINT)[0, 0]


def test_the_point_response_has_the_half_width_of_the_solid_mechanics_model():
    x, response = profile(0.0)
    wide = x[response > 0.5 * response.max()]
    # The tail that the strips carry is a hundredth of the peak.
    assert np.ptp(wide) == pytest.approx(2.65, abs=0.08)


def test_shear_moves_the_peak_by_a_quarter_of_a_millimetre_not_by_one():
    x, response = profile(30.0)
    assert x[response.argmax()] == pytest.approx(0.26, abs=0.02)
    assert abs(profile(30.0, shear_local=0.35)[0][profile(30.0, shear_local=0.35)[1].argmax()]) < (
        0.12
    )


def test_the_strain_is_the_depth_derivative_of_boussinesqs_and_cerrutis_displacement():
    # Displacement u_z of a half-space under a point load, by the textbook, derived by z.
    nu = 0.12

    def displacement(x, z, normal, shear):
        r = np.hypot(x, z)
        boussinesq = normal * (2 * (1 - nu) / r + z**2 / r**3)
        cerruti = shear * (x * z / r**3 + (1 - 2 * nu) * x / (r * (r + z)))
        return boussinesq + cerruti

    # The array's tail of 1 % is taken off by comparing shapes without it.
    x = np.array([-3.0, -1.0, 0.5, 2.0])
    for normal, shear in ((1.0, 0.0), (0.0, 1.0)):
        h, z = 1e-5, 2.4
        strain = -(
            displacement(x, z + h, normal, shear) - displacement(x, z - h, normal, shear)
        ) / (2 * h)
        found = plain_array(x, np.zeros(1))._response(x, 0.0 * x, normal, shear)
        far = 0.01 * normal * (3 - 2 * nu) / z**2 * np.exp(-np.abs(x) / 10.0)
        np.testing.assert_allclose(found - far, strain, rtol=1e-6, atol=1e-9)


def test_responses_add_up_and_scale_with_the_load():
    array = plain_array()
    once = array.read(1.0, 1.5, 0.3, pin_patch())
    np.testing.assert_allclose(array.read(1.0, 3.0, 0.6, pin_patch()), 2.0 * once)
    normal, shear = array.read(1.0, 1.0, 0.0, POINT), array.read(1.0, 0.0, 1.0, POINT)
    np.testing.assert_allclose(array.read(1.0, 2.0, 3.0, POINT), 2 * normal + 3 * shear)


def test_patches_carry_the_whole_load():
    for patch in (pin_patch(), box_patch(skew=0.5)):
        assert patch.share.sum() == pytest.approx(1.0)
        assert (patch.share >= 0).all()
    skewed = box_patch(skew=0.5)
    assert (skewed.share * skewed.points_mm[:, 1]).sum() > 1.0


def test_the_dome_answers_with_two_slopes_and_more_light_means_more_grey():
    rng = np.random.default_rng(1)
    latitude = np.deg2rad([90.0, 30.0])
    dome = OpticalDome(np.zeros(2), latitude, rng, noise_grey=0.0, noise_pixels=0.0)
    push = np.linspace(0, 2, 201)
    force = np.zeros((201, 2, 3))
    force[..., 2] = -push[:, None]
    grey, centroid = dome.read(force)
    slope = np.diff(grey / np.sin(latitude), axis=0) / np.diff(push)[:, None]
    np.testing.assert_allclose(slope[:20].mean(axis=0), dome.lower, rtol=0.02)
    np.testing.assert_allclose(slope[-20:].mean(axis=0), dome.upper, rtol=0.02)
    assert not centroid.any()
    assert (grey == np.round(grey)).all()


def test_a_lifted_element_is_dark():
    dome = OpticalDome(np.zeros(1), np.full(1, 1.0), np.random.default_rng(2), noise_grey=0.0)
    grey, _ = dome.read([[0.3, 0.0, 0.5]])
    assert grey[0] == 0.0


def test_the_gauges_answer_with_the_inverse_of_the_printed_matrix_and_feel_inertia():
    gauges = PlanarGauges(np.random.default_rng(3), noise_v=0.0, mass_kg=0.035)
    load = np.array([[1.0, -2.0, 10.0]])
    np.testing.assert_allclose(gauges.read(load) @ PRINTED_MATRIX.T, load)
    knocked = gauges.read(load, [[1.0, 0.0]]) @ PRINTED_MATRIX.T
    np.testing.assert_allclose(knocked - load, [[0.035, 0.0, 0.0]], atol=1e-12)


def test_a_planar_load_obeys_the_papers_moment():
    load = planar_load(4.0, 2.0, 0.7, 15.7)
    x, y = 15.7 * np.cos(4.0 / 15.7), 15.7 * np.sin(4.0 / 15.7)
    assert load[2] == pytest.approx(load[1] * x - load[0] * y)
    assert np.hypot(*load[:2]) == pytest.approx(np.hypot(2.0, 0.7))


@pytest.mark.parametrize("name", TASKS)
def test_tasks_are_what_the_paper_describes(name):
    task = make_task(name, np.random.default_rng(4))
    assert (task.normal_n > 1.0).all()
    assert np.abs(task.place_mm).max() < 7.0
    if name.startswith("pin"):
        assert np.ptp(task.place_mm) == 0.0
    else:
        assert np.ptp(task.place_mm) > 2.5
    if name == "pin translation off centre":
        assert np.mean(task.tangential_n / task.normal_n) == pytest.approx(0.19, abs=0.02)
    if "translation" in name:
        fastest = np.abs(task.acceleration_m_s2).max()
        assert 0.8 < fastest < 2.0  # the paper: 80 to 130 cm/s2 at the corners
    if "rotation" in name and name.startswith("pin"):
        lean = np.arctan2(task.tangential_n, task.normal_n) + task.place_mm / 15.7
        assert np.rad2deg(np.abs(lean)).max() == pytest.approx(20.0, abs=4.0)


def test_an_unknown_task_is_an_error():
    with pytest.raises(KeyError):
        make_task("juggling", np.random.default_rng(5))


def test_the_servo_runs_at_300_hz_and_the_task_lasts_as_long_as_asked():
    assert RATE_HZ == 300.0
    assert len(make_task("box rotation", np.random.default_rng(6), seconds=2.0).place_mm) == 600
