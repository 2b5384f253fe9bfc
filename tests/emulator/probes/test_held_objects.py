import numpy as np
import pytest

from emulator.probes.held_objects import Friction, HeldObjects, StickSlip

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


@pytest.mark.parametrize("looks", [1, 3, 30, 100])
def test_an_object_slides_alike_however_often_it_is_looked_at(looks):
    """Each look let an inner step of the object pass, so that what was watched slid further."""
    objects = HeldObjects(1, LAW, dt_s=1e-3)
    for _ in range(100):
        for _ in range(looks):
            objects.advance([0.65], [1.0], 3e-3 / looks)
        for _ in range(looks):
            objects.advance([0.65], [1.0], 0.0)
    alone = HeldObjects(1, LAW, dt_s=1e-3)
    for _ in range(100):
        alone.advance([0.65], [1.0], 3e-3)
    assert objects.slipped_mm == pytest.approx(alone.slipped_mm)
    assert objects.slipped_mm[0] > 10.0
