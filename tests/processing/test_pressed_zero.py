"""What was pressed when its board was zeroed stays so until it reads below its zero."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from skin_host.processing.pressed_zero import PressedZero
from skin_host.processing.rezero import BELOW_SWEEPS, LEAST_SPREAD, SNAPSHOT_SIGMAS, STEADY_UNITS

NO_LOAD = 240.0
ALL = np.ones(3, np.bool_)


def zero(noise: float = 0.6, repeats: float = 1.0) -> PressedZero:
    """Of three pads, of which the first two were pressed."""
    pressed = np.array([True, True, False])
    return PressedZero(pressed, NO_LOAD, np.full(3, noise), repeats)


def send(of: PressedZero, sweeps: int, *units: int, here: np.ndarray = ALL) -> bool:
    """Send what three pads read, in units of pressure; return whether the last sweep turned any."""
    turned = False
    for _ in range(sweeps):
        turned = of.step((NO_LOAD - np.array(units)).clip(0, 255).astype(np.uint8), here)
    return turned


def test_what_reads_below_its_zero_has_lifted() -> None:
    found = zero()
    assert not send(found, BELOW_SWEEPS - 1, -15, 0, -15)
    assert found.pressed.tolist() == [True, True, False]
    assert send(found, 1, -15, 0, -15)
    assert not send(found, 1, -15, 0, -15)
    assert found.pressed.tolist() == [False, True, False]
    assert found.lifted.tolist() == [True, False, False]


def test_what_is_pressed_again_as_before_is_so() -> None:
    found = zero()
    send(found, BELOW_SWEEPS, -10, -10, 0)
    send(found, BELOW_SWEEPS, 0, -10, 0)
    assert found.pressed.tolist() == [True, False, False]


def test_what_is_not_received_shows_nothing() -> None:
    found = zero()
    send(found, 3, -10, -10, 0)
    send(found, 20, 0, -10, 0, here=~ALL)
    assert found.pressed.tolist() == [True, True, False]
    send(found, 2, -10, -10, 0)
    assert not found.pressed.any()


def test_a_conversion_that_is_sent_again_is_no_other() -> None:
    found = zero(repeats=3.7)
    send(found, 18, -10, -10, 0)
    assert found.pressed.any()
    send(found, 1, -10, -10, 0)
    assert not found.pressed.any()


@given(noise=st.floats(0.3, 6.0), data=st.data())
def test_what_the_noise_of_the_zero_explains_is_no_release(
    noise: float, data: st.DataObject
) -> None:
    """It is one reading: by three standard deviations it may be off."""
    found = zero(noise)
    lowest = math.ceil(-STEADY_UNITS - SNAPSHOT_SIGMAS * max(noise, LEAST_SPREAD))
    lowest = max(lowest, -14)  # below is the end of the scale
    for unit in data.draw(st.lists(st.integers(lowest, 40), max_size=60)):
        send(found, 1, unit, unit, unit)
    send(found, BELOW_SWEEPS, lowest, lowest, lowest)
    assert found.pressed.tolist() == [True, True, False]
    send(found, BELOW_SWEEPS, lowest - 1, 0, 0)
    assert found.lifted.tolist() == [True, False, False]


def test_a_calibration_of_some_pads_shows_nothing_of_the_others() -> None:
    found = zero()
    assert not found.forget(np.array([True, False, True]))
    assert found.pressed.tolist() == [False, True, False]
    assert found.forget(~np.array([True, False, True]))
    assert not found.pressed.any()
