"""Long steady contacts through the whole pipeline: never absorbed, and no ghost afterwards."""

from functools import cache

import numpy as np
import pytest

from skin_host.evaluation.histories import record
from skin_host.evaluation.rig import Rig
from skin_host.layout import PadKind
from skin_host.processing.calibration import FEWEST_SAMPLES
from skin_host.processing.pressure import PressureCurve

CURVE = PressureCurve(2.88)
HOLD_KPA = 65.0
BEFORE_S, AFTER_S = 20.0, 120.0
TEN_MINUTES_S, EIGHT_HOURS_S = 600.0, 28800.0
FEW, ALL = 6, 192


@cache
def history(truth, seconds, hz):
    return record(truth, [(0.0, BEFORE_S), (HOLD_KPA, seconds), (0.0, AFTER_S)], hz)


def hold(truth, seconds, *, hz, pressed, drift=0.0):
    """Shares [t] of the pressed taxels told as touched: before, in the hold, and after it.

    Everything drifts by so many units a second. Nothing else may be told as touched.
    """
    played = history(truth, seconds, hz)
    rig = Rig(1, 0.3, seed=21, hz=hz, calibrate_s=max(5.0, FEWEST_SAMPLES / hz))
    here = np.arange(rig.n) < pressed
    told = []
    for sweep, units in enumerate(CURVE.units(played.momentary_kpa)):
        frame = rig.step(np.where(here, units, 0.0) + drift * sweep / hz)
        told.append(np.mean(frame.touched[here]))
        assert not frame.touched[~here].any()
    start, end = round(BEFORE_S * hz), round((BEFORE_S + seconds) * hz)
    shares = np.array(told)
    return shares[:start], shares[start + 3 : end - 1], shares[end + 3 :]


@pytest.mark.parametrize("truth", ["A", "S"])
@pytest.mark.parametrize("pressed", [FEW, ALL])
def test_a_hold_of_ten_minutes_is_told_to_its_end_and_no_longer(truth, pressed):
    hz = 10.0
    before, during, after = hold(truth, TEN_MINUTES_S, hz=hz, drift=0.004, pressed=pressed)
    assert not before.any()
    assert during.all()
    assert after.sum() / hz <= 3.0
    assert not after[-round(60 * hz) :].any()


@pytest.mark.parametrize(("pressed", "drift"), [(FEW, 0.0), (ALL, 0.0001)])
def test_a_hold_of_eight_hours_is_neither_absorbed_nor_left_behind(pressed, drift):
    before, during, after = hold("S", EIGHT_HOURS_S, hz=1.0, drift=drift, pressed=pressed)
    assert not before.any()
    assert during.all()
    assert after.sum() <= 3.0
    assert not after[-60:].any()


def ghost_s(kind):
    """For how long a touch is told after a hold of all pads, while it grew warmer."""
    hz = 10.0
    rig = Rig(1, 0.3, seed=23, hz=hz, kind=kind, processing={"relaxation": {"model": "none"}})
    thermal = rig.layout.pad_kind == PadKind.THERMAL
    felt = np.where(thermal, 1.0, 0.6)
    warmth, ghost = 0.0, 0.0
    for rate, press, seconds in ((0.02, 0, 300), (-0.02, 0, 300), (0.01, 35, 600), (0.0, 0, 60)):
        for _ in range(round(seconds * hz)):
            warmth += rate / hz
            touched = rig.step(felt * warmth + np.where(thermal, 0.0, press)).touched[~thermal]
            if press:
                ghost = -3.0 / hz
            elif ghost < 0.0 or rate == 0.0:
                ghost += float(np.mean(touched)) / hz
    return max(ghost, 0.0)


@pytest.mark.parametrize("kind", ["triangle", "triangle_10pad"])
def test_a_part_that_grew_warm_while_all_of_it_was_pressed_is_not_touched_afterwards(kind):
    assert ghost_s(kind) < 0.5


@pytest.mark.parametrize("left_units", [1.0, 2.0, 3.0, 3.4])
def test_no_drift_of_a_few_units_under_a_contact_latches_it(left_units):
    hz = 10.0
    rig = Rig(1, 0.4, seed=22, hz=hz, processing={"relaxation": {"model": "none"}})
    sweeps = round(TEN_MINUTES_S * hz)
    for sweep in range(sweeps):
        frame = rig.step(35.0 + left_units * sweep / sweeps)
    assert frame.touched.all()
    ghosts = [rig.step(left_units).touched.any() for _ in range(round(120 * hz))]
    assert not any(ghosts[-round(60 * hz) :])
