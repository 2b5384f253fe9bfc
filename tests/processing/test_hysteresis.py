"""A hysteresis of more than the margin is cut to it, everywhere."""

import numpy as np
import pytest

from skin_host.evaluation.rig import Rig
from skin_host.processing.frame import PressureFrame


def press(rig: Rig, units: float, seconds: float) -> list[PressureFrame]:
    activation = np.zeros(rig.n)
    activation[:6] = units
    return [rig.step(activation) for _ in range(round(25 * seconds))]


@pytest.mark.parametrize("hysteresis_units", [0.5, 4.0, 10.0, 20.0])
def test_a_light_press_soon_after_a_firm_one_is_felt_at_once(hysteresis_units: float) -> None:
    touch = {"hysteresis_units": hysteresis_units}
    rig = Rig(1, 0.5, processing={"touch": touch, "relaxation": {"model": "none"}})
    for units, seconds in ((0.0, 5.0), (100.0, 30.0), (0.0, 3.0)):
        press(rig, units, seconds)
    frames = press(rig, 6.0, 0.4)
    assert any(frame.touched[:6].any() for frame in frames)
