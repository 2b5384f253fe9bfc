import numpy as np
import pytest

from skin_host.evaluation.papers.force_torque import (
    CYLINDER_AZIMUTH_DEG,
    CYLINDER_DECOUPLING,
    CYLINDER_ROW,
    CYLINDER_TURN_SIGN,
    PlanarStructure,
    condition_number,
    cylinder_response,
    pattern_search,
    six_gauge_cylinder,
)


@pytest.mark.parametrize(
    ("places", "published"), [("LRT", 2.55), ("LST", 3.43), ("RKT", 3.43), ("KST", 4.05)]
)
def test_the_planar_structure_has_the_published_condition_numbers(places, published):
    found = {name: condition for condition, name in PlanarStructure().placements()}
    assert found[places] == pytest.approx(published, abs=0.01)


def test_the_best_published_placement_is_the_best_there_is_and_tension_changes_it_little():
    assert PlanarStructure().placements()[0][1] == "LRT"
    condition, places = PlanarStructure().placements(axial=True)[0]
    assert places == "LRT"
    assert condition == pytest.approx(2.53, abs=0.05)  # the paper's finite elements


def test_without_the_top_of_the_vertical_beam_force_and_moment_are_not_told_apart():
    for condition, places in PlanarStructure().placements():
        assert ("T" in places) == (condition < 1e6)


def test_equal_greatest_stress_gives_the_published_ratio_of_thicknesses():
    # Vertical push at the tip's side bends the joint, horizontal push at its top the stand.
    stress = PlanarStructure(thickness_v=1.0).stresses()

    def at(place, theta_deg, phi_deg):
        theta, phi = np.deg2rad([theta_deg, phi_deg])
        return abs(stress[place] @ [np.sin(phi), np.sin(theta - phi), np.cos(phi)])

    ratio = np.sqrt(at("U", 90, 180) / at("K", 180, -90))
    assert ratio == pytest.approx(1.633, abs=5e-4)


def test_free_proportions_beat_the_published_planar_structure():
    def cost(x):
        if min(x) < 0.2 or max(x) > 3.0:
            return np.inf
        return PlanarStructure(radius=x[0], height=x[1], thickness_v=x[2]).placements()[0][0]

    _, condition = pattern_search(cost, (1.0, 1.0, 1.633), (0.2, 0.2, 0.2))
    assert condition < 1.5


def test_sums_and_differences_almost_decouple_the_six_gauges():
    decoupled = CYLINDER_DECOUPLING @ six_gauge_cylinder(14.0, 10.0, 6.0)
    off = decoupled.copy()
    off[np.arange(6), np.arange(6)] = 0.0
    left = np.argwhere(np.abs(off) > 1e-12)
    # What is left is the shear of f2 beside m2, and of f3 beside m3 (eq. 20).
    assert left.tolist() == [[4, 1], [5, 2]]


def test_the_cylinder_model_agrees_with_beam_theory_about_a_pure_push():
    # A push at the sphere's centre bends the lower row by force times distance.
    response = cylinder_response(np.zeros(2), np.zeros(2), [0.0, 10.0], 6.0)
    force, moment = response[:, 1], response[:, 5]
    assert force[0] == pytest.approx(0.0, abs=1e-12)
    assert force[1] == pytest.approx(10.0 * moment[1])


def test_the_search_finds_the_bottom_of_a_bowl():
    best, lowest = pattern_search(
        lambda x: float(((x - [1.0, -2.0]) ** 2).sum()), (0.0, 0.0), (0.3, 0.3)
    )
    np.testing.assert_allclose(best, [1.0, -2.0], atol=1e-3)
    assert lowest < 1e-6


def test_gauges_placed_freely_are_better_conditioned_than_the_published_arrangement():
    scale = np.array([1.0, 1, 1, 10, 10, 10])  # 10 mm of lever: a fingertip's nominal loads

    def cost(x):
        if not 3.0 <= x[18] <= 9.0 or np.ptp(x[12:18]) > 20.0:
            return np.inf
        return condition_number(cylinder_response(x[:6], x[6:12], x[12:18], x[18]), scale)

    start = np.concatenate(
        [
            np.deg2rad(14.0) * np.array(CYLINDER_TURN_SIGN),
            np.deg2rad(CYLINDER_AZIMUTH_DEG),
            10.0 * np.array(CYLINDER_ROW),
            [6.0],
        ]
    )
    step = np.concatenate([np.full(12, 0.2), np.full(6, 3.0), [1.0]])
    _, condition = pattern_search(cost, start, step, finest=0.02)
    assert condition < 0.6 * cost(start)
