import numpy as np
import pytest

from skin_host.evaluation.papers.grasp_loops import Cap, CapWorld


def test_a_cap_turns_lightly_until_it_is_closed_and_does_not_spring_back():
    cap = Cap()
    assert cap.turn(1.0, 0.01) == 0.0
    for _ in range(2000):
        cap.turn(40.0, 0.001)
    assert cap.angle_rad == pytest.approx(0.8 + 38.0 / 120.0, abs=0.01)
    assert cap.turn(-40.0, 0.01) == 0.0


def test_the_elements_carry_the_contacts_force():
    world = CapWorld()
    towards = np.array([[-1.0, 0.0], [1.0, 0.0]])
    world.advance(4.0 * towards, 1.0)
    world.advance(np.array([[0.0, 3.0], [0.0, -3.0]]), 0.1)
    assert (world.normal_n > 0.5).all()
    angle = np.deg2rad(np.linspace(-60, 60, 41))
    normals = np.stack([np.sin(angle), np.zeros(41), np.cos(angle)], axis=1)
    south = np.stack([np.cos(angle), np.zeros(41), -np.sin(angle)], axis=1)
    east = np.tile([0.0, 1.0, 0.0], (41, 1))
    for finger in range(2):
        parts = world.element_forces(finger, normals, south, east)
        total = np.einsum("ni,nij->j", parts, np.stack([south, east, normals], axis=1))
        size = np.hypot(world.normal_n[finger], world.shear_n[finger])
        assert np.linalg.norm(total) == pytest.approx(size)
        assert total[2] < 0.0  # the cap pushes the fingertip back
        assert total[0] * world.shear_n[finger] < 0.0
