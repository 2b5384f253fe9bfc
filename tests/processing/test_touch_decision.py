"""What decides touches takes its levels in units to the pressures of the curve of each taxel."""

import numpy as np
import pytest

from skin_host.processing.curves import KNOTS_UNITS, TableCurve
from skin_host.processing.masks import Mask
from skin_host.processing.touch import Levels
from skin_host.processing.touch_decision import TouchDecision

REST = 200
#: A single measurement of 2 units counts in full, and noise takes 6 not below that.
LEVELS = Levels(
    enter=np.full(2, 1.75),
    leave=np.full(2, 1.75),
    whole=np.full(2, 2.0),
    span=np.full(2, 0.5),
    hold=np.full(2, 0.5),
    fall=np.full(2, 4.0),
    votes=np.full(2, 2),
    spread=np.zeros(2),
)
KPA_PER_UNIT = 10.0
BOTH: Mask = np.ones(2, np.bool_)


def decision(usable: Mask = BOTH, fitted: bool = True) -> TouchDecision:
    """Of two taxels of straight curves, of which nothing has been sent."""
    curve = TableCurve(np.tile(KPA_PER_UNIT * KNOTS_UNITS, (2, 1)), np.full(2, 100.0))
    made = TouchDecision(LEVELS, 2)
    made.adopt(LEVELS, curve, usable, fitted)
    return made


def report(made: TouchDecision, touched: Mask, *kpa: float, sweeps: int = 1) -> list[bool]:
    lost = np.zeros(2, np.float32)
    for _ in range(sweeps):
        signal = np.array(kpa, np.float32)
        reported = made.report(touched.copy(), signal, lost, idle=False)
    return reported.tolist()


@pytest.mark.parametrize(
    ("falls_to_kpa", "ends"),
    [(0.9 * KPA_PER_UNIT * 2.0, True), (1.2 * KPA_PER_UNIT * 2.0, False)],
)
def test_a_firm_press_ends_below_what_counts_in_full(falls_to_kpa: float, ends: bool) -> None:
    made = decision()
    # 30 kPa are above it and not firm, 100 kPa are firm.
    assert report(made, BOTH, 30.0, 100.0, sweeps=20) == [True, True]
    assert report(made, BOTH, 21.0, falls_to_kpa, sweeps=5) == [True, not ends]


def test_a_press_that_was_never_firm_does_not_end_by_falling() -> None:
    made = decision()
    assert report(made, BOTH, 50.0, 70.0, sweeps=20) == [True, True]
    assert report(made, BOTH, 15.0, 15.0, sweeps=5) == [True, False]


def test_where_no_model_was_fitted_more_is_left_of_a_press() -> None:
    made = decision(fitted=False)
    # A touch is 20 kPa above what is left, 36 of 600 kPa, or 18 where a model was fitted.
    assert report(made, BOTH, 600.0, 600.0, sweeps=5) == [True, True]
    assert report(made, BOTH, 45.0, 300.0, sweeps=8) == [False, True]
    made = decision()
    assert report(made, BOTH, 600.0, 600.0, sweeps=5) == [True, True]
    assert report(made, BOTH, 45.0, 300.0, sweeps=8) == [True, True]


def test_what_foam_has_lost_must_be_exceeded() -> None:
    made = decision()
    relaxation_kpa = np.array([0.0, 60.0], np.float32)
    made.renew(np.full(2, REST, np.float32), relaxation_kpa, np.array([False, True]))
    for units, touched in ((4, [True, False]), (9, [True, True])):
        raw = np.full(2, REST - units, np.uint8)
        for _ in range(3):
            found = made.detector.step(raw, 0.04)
        assert found.tolist() == touched
