"""Why a contact ended whose touch decision, or whose zero, has been changed under it."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.config.settings import changed
from skin_host.evaluation.rig import Rig
from skin_host.processing.core import Engine
from skin_host.processing.events import Touch
from skin_host.processing.intake import PartSample

#: Units that one triangle feels: more than twice the usual threshold, and less than a raised one.
LIGHT_UNITS, FIRM_UNITS = 6.0, 60.0
RAISED = {"processing.touch.margin_units": 20.0}
USUAL = {"processing.touch.margin_units": 2.0}


class Skin:
    """A board of skin whose first triangle is pressed, and an engine that can be replaced."""

    def __init__(self, seed: int = 0, noise_units: float = 0.4) -> None:
        self.rig = Rig(1, noise_units, seed=seed)
        self.layout = self.rig.layout
        self.settings = self.rig.settings
        self.engine = Engine(self.settings, self.layout, [0], self.rig.calibration)
        self.pressed = np.arange(self.rig.n) < 12

    def press(self, units: float, sweeps: int) -> list[Touch]:
        """Return the events of a press on the first triangle."""
        events: list[Touch] = []
        for _ in range(sweeps):
            self.rig.t_ns += 40_000_000
            raw = self.rig.read(np.where(self.pressed, units, 0.0))
            all_of_them = np.ones(self.rig.n, np.bool_)
            sample = PartSample(0, raw, all_of_them, all_of_them, self.rig.t_ns)
            (step,) = self.engine._process([sample])
            events += step.events
        return events

    def change(self, values: dict[str, Any]) -> None:
        self.settings = changed(self.settings, values)
        self.engine = Engine(self.settings, self.layout, [0], after=self.engine)


def ends(events: list[Touch]) -> list[str | None]:
    return [event.reason for event in events if event.event == "end"]


@given(seed=st.integers(0, 1000), units=st.floats(LIGHT_UNITS, 12.0))
def test_a_press_that_a_raised_threshold_ends_was_not_released(seed: int, units: float) -> None:
    skin = Skin(seed)
    assert ends(skin.press(units, 25)) == []
    skin.change(RAISED)
    assert set(ends(skin.press(units, 250))) == {"stopped"}
    assert skin.press(units, 25) == []


@pytest.mark.parametrize("values", [RAISED, {"processing.touch.votes_of_3": 3}, USUAL])
@pytest.mark.parametrize("noise_units", [0.3, 1.0])
def test_a_press_that_is_lifted_later_was_released(
    values: dict[str, Any], noise_units: float
) -> None:
    skin = Skin(noise_units=noise_units)
    assert ends(skin.press(FIRM_UNITS, 25)) == []
    skin.change(values)
    assert ends(skin.press(FIRM_UNITS, 25)) == []
    assert ends(skin.press(0.0, 50)) == ["released"]


def test_a_press_that_is_lifted_when_the_threshold_is_lowered_was_released() -> None:
    skin = Skin()
    skin.change(RAISED)
    skin.press(FIRM_UNITS, 25)
    skin.change(USUAL)
    assert ends(skin.press(0.0, 50)) == ["released"]


@pytest.mark.parametrize("other", [{"processing.touch.margin_units": 25.0}, USUAL | RAISED])
def test_of_several_changes_the_one_under_which_the_contact_was_found_counts(
    other: dict[str, Any],
) -> None:
    skin = Skin()
    skin.press(LIGHT_UNITS, 25)
    skin.change(RAISED)
    skin.change(other)
    assert set(ends(skin.press(LIGHT_UNITS, 250))) == {"stopped"}


def test_a_contact_that_begins_after_the_change_is_released_whatever_was_before() -> None:
    skin = Skin()
    skin.press(LIGHT_UNITS, 25)
    skin.change(RAISED)
    assert set(ends(skin.press(LIGHT_UNITS, 250))) == {"stopped"}
    assert next(event.event for event in skin.press(FIRM_UNITS, 25)) == "begin"
    # It was a touch by the first threshold, and is none by the present one.
    assert set(ends(skin.press(LIGHT_UNITS, 250))) == {"released"}


def test_a_change_that_concerns_no_threshold_leaves_every_release_what_it_is() -> None:
    skin = Skin()
    skin.press(LIGHT_UNITS, 25)
    skin.change({"processing.touch.move_hz": 5.0})
    assert ends(skin.press(0.0, 50)) == ["released"]


def test_a_press_that_a_new_calibration_takes_for_untouched_was_not_released() -> None:
    skin = Skin()
    skin.press(LIGHT_UNITS, 25)
    skin.engine.use(skin.rig.calibration)
    events = skin.press(LIGHT_UNITS, 25)
    assert ends(events) == ["stopped"]
    assert [event.event for event in events if event.event != "move"] == ["end", "begin"]
    assert ends(skin.press(0.0, 50)) == ["released"]
