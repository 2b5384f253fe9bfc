"""Pressures in another unit than kPa are noticed by their ratio to the common curve."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.errors import RequestError
from skin_host.recording.plausibility import LEAST_RATIO, MOST_RATIO, check_ratio, describe_ratio


@pytest.mark.parametrize(
    ("unit", "kpa"),
    [("MPa", 1e3), ("bar", 1e2), ("N/cm2", 10.0), ("psi", 6.895), ("mbar", 0.1), ("mmHg", 0.1333)],
)
@given(foam=st.floats(0.6, 1.6))
def test_the_unit_that_was_meant_is_named(unit: str, kpa: float, foam: float) -> None:
    ratio = foam / kpa
    assert f"are they in {unit}" in describe_ratio(ratio) or f"or {unit} (" in describe_ratio(ratio)


def test_pascals_are_named() -> None:
    assert "are they in Pa (" in describe_ratio(1000.0)


@given(ratio=st.floats(-1e6, 1e6))
def test_a_ratio_of_no_known_foam_is_refused(ratio: float) -> None:
    if LEAST_RATIO <= ratio <= MOST_RATIO:
        check_ratio(ratio)
    else:
        with pytest.raises(RequestError, match="are they in"):
            check_ratio(ratio)


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0, 5.2, 6.1])
def test_foam_twice_as_soft_to_that_of_the_insole_is_possible(ratio: float) -> None:
    check_ratio(ratio)
