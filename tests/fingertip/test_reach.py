"""How much force a force/torque board measures in every direction."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.fingertip.reach import reach_n

SCALE = np.array([100.0, 80.0, 50.0, 10.0, 10.0, 10.0])
AXES = np.eye(6)[:3]
#: The largest word is one less than the full scale.
WORD = 0x7FFF / 0x8000


def test_the_weakest_axis_decides() -> None:
    assert reach_n(AXES, SCALE) == pytest.approx(50.0 * WORD)


def test_what_the_zero_takes_of_the_range_is_not_left_for_a_touch() -> None:
    offset = np.array([0.0, 0.0, -7.0, 1.0, 1.0, 1.0])
    assert reach_n(AXES, SCALE, offset) == pytest.approx(50.0 * WORD - 7.0)
    beyond = np.array([0.0, 0.0, 51.0, 0.0, 0.0, 0.0])
    assert reach_n(AXES, SCALE, beyond) == 0.0


@pytest.mark.parametrize("degrees", [0.0, 30.0, 45.0, 123.0])
def test_a_board_that_is_turned_reaches_as_far(degrees: float) -> None:
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ AXES
    assert reach_n(turned, SCALE) == pytest.approx(50.0 * WORD)


def test_two_channels_of_one_axis_reach_as_far_as_both_together() -> None:
    halves = np.array([[1.0, 0, 0, 0.5, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0]])
    scale = np.array([1.0, 5, 5, 6, 1, 1])
    assert reach_n(halves, scale) == pytest.approx(4.0 * WORD)


@pytest.mark.parametrize(
    "to_force",
    [
        np.zeros((3, 6)),
        np.ones((3, 6)),
        np.array([[1.0, 0, 0, 0, 0, 0]] * 3),
        np.array([[1.0, 2, 0, 0, 0, 0], [0, 1, 3, 0, 0, 0], [1, 3, 3, 0, 0, 0]]),
    ],
)
def test_a_direction_in_which_nothing_is_measured_is_not_reached(
    to_force: np.ndarray,
) -> None:
    assert reach_n(to_force, SCALE) == pytest.approx(0.0, abs=1e-9)


@given(st.integers(0, 1 << 32), st.integers(3, 6))
def test_no_direction_reaches_less_and_one_reaches_no_farther(seed: int, channels: int) -> None:
    """The measurable forces are a convex body: a direction's farthest plane touches it."""
    rng = np.random.default_rng(seed)
    to_force = np.zeros((3, 6))
    to_force[:, :channels] = rng.normal(size=(3, channels))
    offset = 0.02 * SCALE * rng.uniform(-1, 1, 6)
    reach = reach_n(to_force, SCALE, offset)
    towards = rng.normal(size=(40_000, 3))
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    farthest = np.abs(towards @ to_force * SCALE * WORD).sum(axis=1) - towards @ to_force @ offset
    assert reach <= farthest.min() * (1 + 1e-9)
    assert reach >= 0.9 * farthest.min() - 0.05 * farthest.max()
