"""Pads of which no curve is known read by the median curve of the others of their part."""

import numpy as np
import pytest

from skin_host.config.settings import Pressure
from skin_host.processing.curves import (
    KNOTS_UNITS,
    REPRESENTATIVES,
    Curves,
    CurveVerdict,
    TableCurve,
    with_own,
)
from skin_host.processing.pressure import PressureCurve

N = 40
#: Two parts of 20 pads; only in the first are curves known. Real foam takes five times as much.
PARTS = [slice(0, 20), slice(20, 40)]
SPREAD = np.linspace(0.8, 1.2, 15)
UNITS = np.array([1.5, 5.0, 10.0, 19.0, 28.0, 37.0])
KNOWN = Pressure()


def common(unit_ff: float | np.ndarray = 1.44, gain: float | np.ndarray = 1.0) -> PressureCurve:
    return PressureCurve(np.full(N, unit_ff), gain, KNOWN.a_kpa_per_ff2, KNOWN.b_kpa_per_ff)


def curves(known: int = 15, verdict: CurveVerdict = CurveVerdict.UNKNOWN) -> Curves:
    """Stiff pads, nearly straight, that were pressed to 36 units."""
    verdicts = np.full(N, CurveVerdict.UNKNOWN, np.uint8)
    verdicts[:20] = verdict
    verdicts[:known] = CurveVerdict.GOOD
    kpa = np.zeros((N, len(KNOTS_UNITS)))
    kpa[:known] = 8.0 * SPREAD[:known, np.newaxis] * KNOTS_UNITS
    beyond = np.where(verdicts == CurveVerdict.GOOD, 36.0, np.inf)
    return Curves(kpa, beyond, np.zeros(N), np.full(N, np.nan), verdicts, 300.0, 0.0)


def kpa_of(curve: PressureCurve | TableCurve, units: np.ndarray = UNITS) -> np.ndarray:
    return curve.kpa(units[:, np.newaxis] * np.ones(N))


def test_a_pad_of_which_nothing_is_known_reads_as_the_median_pad_of_its_part() -> None:
    read = with_own(common(), curves(), PARTS, np.ones(N, np.bool_))
    found = kpa_of(read)
    assert found[:, 15:20] == pytest.approx(8.0 * UNITS[:, np.newaxis] * np.ones(5), rel=1e-6)
    assert found[:, :15] == pytest.approx(8.0 * UNITS[:, np.newaxis] * SPREAD)
    assert read.beyond_units[15:20] == pytest.approx(36.0)


def test_pads_of_other_parts_which_may_have_other_foam_keep_the_common_curve() -> None:
    read = with_own(common(), curves(), PARTS, np.ones(N, np.bool_))
    knots = kpa_of(common(), KNOTS_UNITS)
    assert kpa_of(read, KNOTS_UNITS)[:, 20:] == pytest.approx(knots[:, 20:], rel=1e-3, abs=0.2)
    assert read.beyond_units[20:] == pytest.approx(common().beyond_units[20:])


def test_a_pad_in_other_units_reads_the_same_pressure_at_the_same_capacitance() -> None:
    unit_ff = np.where(np.arange(N) == 17, 0.72, 1.44)
    read = with_own(common(unit_ff), curves(), PARTS, np.ones(N, np.bool_))
    found = read.kpa(np.where(np.arange(N) == 17, 2.0, 1.0) * UNITS[:, np.newaxis])
    assert found[:, 17] == pytest.approx(8.0 * UNITS, rel=0.02)
    assert read.beyond_units[17] == pytest.approx(72.0)


def test_a_pad_with_a_gain_of_its_own_keeps_it() -> None:
    gain = np.where(np.arange(N) == 17, 3.0, 1.0)
    read = with_own(common(gain=gain), curves(), PARTS, gain == 1.0)
    knots = kpa_of(common(gain=gain), KNOTS_UNITS)
    assert kpa_of(read, KNOTS_UNITS)[:, 17] == pytest.approx(knots[:, 17], rel=1e-3, abs=0.6)


def test_few_pads_do_not_represent_their_part() -> None:
    few = REPRESENTATIVES - 1
    read = with_own(common(), curves(few), PARTS, np.ones(N, np.bool_))
    knots = kpa_of(common(), KNOTS_UNITS)
    assert kpa_of(read, KNOTS_UNITS)[:, few:] == pytest.approx(knots[:, few:], rel=1e-3, abs=0.2)
