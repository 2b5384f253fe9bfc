import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skin_host.errors import CalibrationError
from skin_host.evaluation.papers.force_torque import (
    PUBLISHED_FRICTION_FACTOR,
    calibrate,
    condition_number,
    relative_error_bound,
    sphere_error_bound,
)
from skin_host.fingertip.intrinsic import locate, sphere

#: The load-from-signal matrix that Son et al. print (section 3.2).
PRINTED = np.array([[-126.0, -51, 127], [378, -6, -72], [396, -128, 22]])


def known_loads(rng, count, scale):
    """Loads in all directions, and one without load."""
    loads = rng.uniform(-1, 1, (count, len(scale))) * scale
    loads[0] = 0.0
    return loads


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_exact_signals_give_the_true_matrix_and_offset(seed):
    rng = np.random.default_rng(seed)
    scale = np.array([10.0, 10, 10, 100, 100, 100])
    truth = rng.normal(size=(6, 6)) / scale
    offset = rng.normal(size=6)
    loads = known_loads(rng, 40, scale)
    found = calibrate(loads @ truth.T + offset, loads)
    np.testing.assert_allclose(found.response, truth, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(found.offset, offset, atol=1e-10)


def test_loads_come_back_from_noisy_calibration_within_what_the_calibration_says():
    rng = np.random.default_rng(1)
    scale = np.array([10.0, 10, 10, 100, 100, 100])
    truth = rng.normal(size=(8, 6)) / scale  # eight gauges: redundant
    noise = np.linspace(0.005, 0.05, 8)
    loads = known_loads(rng, 200, scale)
    found = calibrate(loads @ truth.T + rng.normal(size=(200, 8)) * noise, loads)
    np.testing.assert_allclose(found.noise, noise, rtol=0.2)
    fresh = known_loads(rng, 4000, scale)
    error = found.loads(fresh @ truth.T + rng.normal(size=(4000, 8)) * noise) - fresh
    ratio = error.std(axis=0) / np.sqrt(np.diag(found.load_covariance()))
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)
    # Weighting by the gauges' noise beats the plain inverse.
    plain = np.linalg.pinv(found.response)
    assert np.trace(found.load_covariance() / scale**2) < np.trace(
        (plain * found.noise) @ (plain * found.noise).T / scale**2
    )


def test_the_fit_of_signals_on_loads_is_not_pulled_towards_zero():
    rng = np.random.default_rng(2)
    loads = known_loads(rng, 4000, np.ones(3))
    signals = loads + rng.normal(size=loads.shape) * 0.5
    found = calibrate(signals, loads)
    inverse_fit, *_ = np.linalg.lstsq(signals, loads, rcond=None)
    assert abs(np.diag(found.matrix).mean() - 1.0) < 0.03
    assert np.diag(inverse_fit).mean() < 0.7


def test_the_standard_errors_cover_the_errors_of_the_matrix():
    rng = np.random.default_rng(3)
    truth = np.eye(3)
    loads = known_loads(rng, 30, np.ones(3))
    score = []
    for _ in range(200):
        found = calibrate(loads @ truth.T + rng.normal(size=(30, 3)) * 0.1, loads)
        score.append((found.response - truth) / found.response_sd)
    assert 0.9 < np.std(score) < 1.15


@pytest.mark.parametrize(
    ("loads", "words"),
    [
        (np.eye(3), "span 3 of 4"),
        (np.vstack([np.zeros(3), np.eye(3)[:2], np.eye(3)[:2]]), "span 3 of 4"),
        (np.full((6, 3), np.nan), "not a number"),
    ],
)
def test_loads_that_do_not_tell_components_apart_are_refused(loads, words):
    with pytest.raises(CalibrationError, match=words):
        calibrate(np.zeros((len(loads), 3)), loads)


def test_fewer_gauges_than_components_are_refused():
    loads = np.vstack([np.zeros(3), np.eye(3)])
    with pytest.raises(CalibrationError, match="2 gauges for 3"):
        calibrate(np.zeros((4, 2)), loads)


def test_the_u_shaped_sensor_has_the_published_condition_number():
    assert condition_number(PRINTED) == pytest.approx(20.05, abs=0.005)
    assert condition_number(np.linalg.inv(PRINTED)) == pytest.approx(20.052, abs=0.0005)


def test_a_condition_number_depends_on_the_unit_of_the_moment():
    per_radius = np.linalg.inv(PRINTED) * np.array([1.0, 1.0, 15.7])
    assert condition_number(per_radius) == pytest.approx(103.6, abs=0.05)
    assert condition_number(np.linalg.inv(PRINTED), [1.0, 1.0, 15.7]) == pytest.approx(
        condition_number(per_radius)
    )


@given(seed=st.integers(0, 2**32 - 1), size=st.floats(1e-4, 0.05))
@settings(max_examples=50, deadline=None)
def test_errors_stay_below_the_bound(seed, size):
    rng = np.random.default_rng(seed)
    c = rng.normal(size=(3, 3)) + 2 * np.eye(3)
    load = rng.normal(size=3)
    v = c @ load
    dc, dv = rng.normal(size=(3, 3)), rng.normal(size=3)
    dc *= size * np.linalg.norm(c, 2) / np.linalg.norm(dc, 2)
    dv *= size * np.linalg.norm(v) / np.linalg.norm(dv)
    bound = relative_error_bound(condition_number(c), size, size)
    if np.isfinite(bound):
        error = np.linalg.solve(c + dc, v + dv) - load
        assert np.linalg.norm(error) <= bound * np.linalg.norm(load) * (1 + 1e-9)


def test_the_bound_is_the_papers_law_for_small_errors():
    assert relative_error_bound(20.05, 1e-6, 1e-6) == pytest.approx(20.05 * 2e-6, rel=1e-4)
    assert relative_error_bound(20.05, 0.01, 0.05) == float("inf")


def test_the_matrix_error_of_a_calibration_covers_the_true_one():
    rng = np.random.default_rng(4)
    truth = rng.normal(size=(3, 3)) + 2 * np.eye(3)
    loads = known_loads(rng, 50, np.ones(3))
    inside = 0
    for _ in range(100):
        found = calibrate(loads @ truth.T + rng.normal(size=(50, 3)) * 0.05, loads)
        true_error = np.linalg.norm(found.response - truth, 2) / np.linalg.norm(truth, 2)
        inside += true_error <= found.relative_response_error(np.ones(3))
    assert inside >= 75


def worst_case(radius, relative_error, friction):
    """Greatest error over all signs of relative errors of the non-zero components."""
    q = np.arctan(friction)
    point = np.array([-radius, 0, 0])
    force = np.array([np.cos(q), np.sin(q), 0.0])
    load = np.concatenate([force, np.cross(point, force)])
    signs = np.array(np.meshgrid(*[[-1, 0, 1]] * 6)).reshape(6, -1).T
    noisy = load * (1 + relative_error * signs)
    found = locate(noisy[:, :3], noisy[:, 3:], sphere(radius)).point_mm
    return np.nanmax(np.linalg.norm(found - point, axis=1))


def test_the_frictionless_bound_is_the_papers_and_holds():
    assert sphere_error_bound(10.0, 0.01) == pytest.approx(0.2)
    assert np.rad2deg(0.2 / 10.0) == pytest.approx(1.15, abs=0.01)  # the paper rounds to 1
    assert worst_case(10.0, 0.01, 0.0) <= 0.2


@pytest.mark.parametrize(("friction", "derived"), [(0.1, 1.07), (0.3, 1.52), (0.5, 2.13)])
def test_the_friction_bound_is_near_the_printed_one_and_holds(friction, derived):
    factor = sphere_error_bound(1.0, 0.5, friction)
    assert factor == pytest.approx(derived, abs=0.006)
    printed = PUBLISHED_FRICTION_FACTOR[friction]
    assert 0.92 < factor / printed <= 1.0
    found = worst_case(10.0, 0.01, friction) / (2 * 10.0 * 0.01)
    assert found == pytest.approx(friction, rel=0.05)  # both bounds are loose by 4 to 10


@given(
    friction=st.floats(0.0, 0.6),
    error=st.floats(1e-4, 0.02),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=40, deadline=None)
def test_random_relative_errors_stay_below_the_friction_bound(friction, error, seed):
    rng = np.random.default_rng(seed)
    q = np.arctan(friction)
    point = np.array([-10.0, 0, 0])
    force = np.array([np.cos(q), np.sin(q), 0.0])
    load = np.concatenate([force, np.cross(point, force)])
    noisy = load * (1 + error * rng.uniform(-1, 1, (200, 6)))
    found = locate(noisy[:, :3], noisy[:, 3:], sphere(10.0)).point_mm
    assert np.linalg.norm(found - point, axis=1).max() <= sphere_error_bound(
        10.0, error, friction
    ) * (1 + 1e-9)
