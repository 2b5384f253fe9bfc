"""Zeros that had a load in them: what shows it, and what returns. The course of a part's baselines
is in test_drift.py.
"""

import numpy as np
import pytest

from skin_host.processing.loaded_zeros import MEMORY_S, LoadedZeros

ALL = np.ones(4, np.bool_)
NONE = ~ALL


def fallen(by_units: float, seconds: float = 0.0) -> LoadedZeros:
    """Four taxels that fell by so much, so long ago."""
    zeros = LoadedZeros(4)
    zeros.expect_back(ALL, np.zeros(4))
    zeros.note_returns(np.full(4, -by_units), np.full(4, -by_units), ALL, NONE, seconds)
    return zeros


@pytest.mark.parametrize(("by_units", "returned"), [(2.4, False), (2.6, True)])
def test_what_fell_less_far_than_a_load_lifts_is_in_no_doubt_when_it_returns(
    by_units: float, returned: bool
) -> None:
    zeros = fallen(by_units)
    zeros.note_returns(np.zeros(4), np.full(4, -by_units), ALL, NONE, 1.0)
    assert np.array_equal(zeros.returned, ALL if returned else NONE)


def test_what_returns_is_where_its_baseline_was() -> None:
    zeros = LoadedZeros(4)
    zeros.expect_back(ALL, np.full(4, 3.0))
    for level, returned in ((-3.0, False), (3.0, True)):
        zeros.note_returns(np.full(4, level), np.full(4, -4.0), ALL, NONE, 1.0)
        assert np.array_equal(zeros.returned, ALL if returned else NONE)


@pytest.mark.parametrize(("windows", "lifted"), [(12, True), (13, False)])
def test_two_lifts_are_of_one_load_within_some_seconds(windows: int, lifted: bool) -> None:
    """In windows of 0.4 s, the first of which has ended when it is counted."""
    zeros = LoadedZeros(4)
    below, rest = np.full(4, -6.0), np.zeros(4)
    assert zeros.lifted(below, 0.0, NONE, ALL, 0.4) is None
    for _ in range(windows):
        assert zeros.lifted(rest, 0.0, NONE, ALL, 0.4) is None
    assert (zeros.lifted(below, 0.0, NONE, ALL, 0.4) is not None) == lifted


@pytest.mark.parametrize(("seconds", "returned"), [(MEMORY_S - 2.0, True), (MEMORY_S, False)])
def test_what_returns_after_an_hour_is_a_touch(seconds: float, returned: bool) -> None:
    zeros = fallen(7.0, seconds)
    assert zeros.may_return == returned
    zeros.note_returns(np.zeros(4), np.full(4, -7.0), ALL, NONE, 1.0)
    assert np.array_equal(zeros.returned, ALL if returned else NONE)


def test_what_passes_by_does_not_return() -> None:
    zeros = fallen(7.0)
    zeros.note_returns(np.zeros(4), np.full(4, -7.0), NONE, NONE, 1.0)
    assert not zeros.returned.any()


def test_a_new_zero_is_not_returned_to() -> None:
    zeros = fallen(7.0)
    zeros.forget(np.arange(4) < 2)
    zeros.note_returns(np.zeros(4), np.full(4, -7.0), ALL, NONE, 1.0)
    assert zeros.returned.tolist() == [False, False, True, True]


@pytest.mark.parametrize(("low", "lifted"), [(-2.5, False), (-2.6, True)])
def test_bulges_reach_down_to_a_limit(low: float, lifted: bool) -> None:
    zeros = LoadedZeros(4)
    steps = [zeros.lifted(np.full(4, low), 0.0, NONE, ALL, 1.0) for _ in range(2)]
    assert steps[0] is None
    assert (steps[1] is not None) == lifted


@pytest.mark.parametrize(
    ("low", "touched", "lifted"),
    [(21, 0, True), (20, 0, False), (41, 1, True), (40, 1, False), (41, 5, False), (51, 5, True)],
)
def test_a_quarter_of_a_part_bulges_only_beside_what_touches_it(
    low: int, touched: int, lifted: bool
) -> None:
    n = 80
    zeros = LoadedZeros(n)
    readings = np.where(np.arange(n) < low, -6.0, 0.0)
    presses, received = np.arange(n) >= n - touched, np.ones(n, np.bool_)
    steps = [zeros.lifted(readings, 0.5, presses, received, 1.0) for _ in range(2)]
    assert steps[0] is None
    assert (steps[1] is not None) == lifted
