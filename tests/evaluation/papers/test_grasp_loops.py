"""Fingers of this project close on emulated objects."""

import numpy as np
import pytest

from skin_host.evaluation.papers.grasp_loops import close_cap, finger_velocity, hold_object
from skin_host.fingertip.grasp import Flags

pytestmark = pytest.mark.long


@pytest.mark.parametrize("friction", [0.4, 0.7])
def test_an_object_under_a_rising_load_is_held(friction):
    held = hold_object(np.random.default_rng(1), friction=friction)
    assert held.slipped_mm[-1] < 3.0  # in all of its slips together
    assert held.load_n[-1] > 1.5 * friction * held.grip_n[0]  # the first grip would not do
    assert held.grip_n[-1] < 12.0 * 1.05  # OVER keeps it from being crushed
    assert np.count_nonzero(np.diff(held.slip)) >= 2  # slips begin and end


def test_without_an_answer_to_slip_it_is_dropped():
    dropped = hold_object(np.random.default_rng(1), respond=False)
    assert dropped.slipped_mm[-1] > 100.0
    assert dropped.slip.any()


@pytest.fixture(scope="module")
def cap():
    return close_cap(np.random.default_rng(2))


@pytest.fixture(scope="module")
def stubborn():
    return close_cap(np.random.default_rng(2), adapt=False)


def test_the_cap_is_closed_by_touch_and_release(cap, stubborn):
    turned = [cap.angle_rad[cap.twist == twist][-1] for twist in range(4)]
    assert turned[0] > 0.5
    assert turned[1] > turned[0] + 0.3
    # After the third twist nothing moves any more: it is closed.
    assert turned[3] - turned[2] < 0.1
    assert turned[3] > stubborn.angle_rad[-1] + 0.1


def test_a_loose_cap_turns_without_slip_and_a_closed_one_trembles(cap):
    first, last = (cap.moving & (cap.twist == twist) for twist in (0, 3))
    assert cap.torque_nmm[last].max() > 5 * cap.torque_nmm[first].max()
    assert cap.shear_rate_n_s[last].max() > 2 * cap.shear_rate_n_s[first].max()


def test_the_trajectory_bends_around_the_cap_once_it_is_tight(cap, stubborn):
    def sideways_mm(result, twist):
        path = result.tip_mm[result.moving & (result.twist == twist)]
        return np.ptp(path[:, :, 0], axis=0).max()

    assert sideways_mm(cap, 0) < 0.1
    assert sideways_mm(cap, 3) > 0.5
    # It is saturated after closing, and the given trajectory stays a straight line.
    assert abs(sideways_mm(cap, 3) - sideways_mm(cap, 2)) < 0.5
    assert sideways_mm(stubborn, 3) < 0.1


def test_no_element_is_pressed_much_beyond_the_limit(cap):
    assert cap.element_n.max() < 1.5  # OVER is at 1 N; the cap itself presses back
    assert cap.grip_n[cap.moving].max() > 1.0  # the paper's 1 N of grasp


@pytest.mark.parametrize("over", [False, True])
@pytest.mark.parametrize("slip", [False, True])
@pytest.mark.parametrize("mode", [Flags.SEARCH, Flags.MOVE])
def test_the_speed_follows_the_flags(mode, slip, over):
    flags = mode | (Flags.SLIP if slip else Flags(0)) | (Flags.OVER if over else Flags(0))
    velocity = finger_velocity(
        flags,
        search_mm_s=np.array([1.0, 0.0]),
        move_mm_s=np.array([0.0, 2.0]),
        squeeze_mm_s=3.0,
        normal_n=np.array([0.1, 0.9, 0.3]),
        inward=np.array([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]]),
    )
    wanted = np.array([1.0, 0.0]) if mode == Flags.SEARCH else np.array([0.0, 2.0])
    if slip and not over:
        wanted += np.array([1.8, 2.4])  # along the normal of the element pressed most
    np.testing.assert_allclose(velocity, wanted)
