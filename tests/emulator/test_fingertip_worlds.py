import numpy as np
import pytest

from emulator.fingertip_worlds import Cap, CapWorld, Friction, HeldObjects, StickSlip

LAW = Friction(static=0.6, sliding=0.5, stiffness_n_mm=2.0, damping=0.0)


def test_a_contact_holds_like_a_spring_up_to_the_static_limit():
    contact = StickSlip(1, LAW)
    force = [float(contact.step([[1.0]], [1.0], 0.01)[0, 0]) for _ in range(29)]
    np.testing.assert_allclose(force, 2.0 * 0.01 * np.arange(1, 30), rtol=1e-9)
    assert contact.slipped_mm[0] == 0.0
    assert float(contact.step([[2.0]], [1.0], 0.01)[0, 0]) == pytest.approx(0.5)
    assert contact.slipped_mm[0] == pytest.approx(0.06, abs=1e-9)


def test_slow_sliding_sticks_and_slips_and_fast_sliding_drags():
    slow, fast = StickSlip(1, LAW), StickSlip(1, LAW)
    slow_force = [float(slow.step([[5.0]], [1.0], 0.001)[0, 0]) for _ in range(500)][100:]
    fast_force = [float(fast.step([[50.0]], [1.0], 0.001)[0, 0]) for _ in range(500)][100:]
    assert np.ptp(slow_force) > 0.08
    np.testing.assert_allclose(fast_force, 0.5)


def test_a_contact_without_normal_force_does_not_hold():
    assert StickSlip(1, LAW).step([[5.0]], [0.0], 0.01)[0, 0] == 0.0


def test_friction_in_two_directions_opposes_the_motion():
    contact = StickSlip(1, LAW, dimensions=2)
    for _ in range(100):
        force = contact.step([[30.0, 40.0]], [1.0], 0.01)
    np.testing.assert_allclose(force, [[0.3, 0.4]], rtol=1e-6)


def test_an_object_falls_when_its_load_passes_the_limit_and_not_before():
    objects = HeldObjects(2, LAW)
    for i in range(900):
        objects.advance(np.minimum(0.002 * i, [0.55, 0.65]), np.ones(2), 1 / 300)
    assert objects.slipped_mm[0] == 0.0
    assert objects.slipped_mm[1] > 100.0
    assert objects.fallen_mm[1] == pytest.approx(objects.slipped_mm[1], abs=1.0)


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
