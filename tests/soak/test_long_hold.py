"""A hold of eight hours at one sweep a second: half a minute of one core."""

import pytest

from tests.support.long_hold import ALL, FEW, hold

EIGHT_HOURS_S = 28800.0


@pytest.mark.parametrize(("pressed", "drift"), [(FEW, 0.0), (ALL, 0.0001)])
def test_a_hold_of_eight_hours_is_neither_absorbed_nor_left_behind(
    pressed: int, drift: float
) -> None:
    held = hold("S", EIGHT_HOURS_S, hz=1.0, drift=drift, pressed=pressed)
    assert not held.before.any()
    assert held.during.all()
    assert held.after.sum() <= 3.0
    assert not held.after[-60:].any()
