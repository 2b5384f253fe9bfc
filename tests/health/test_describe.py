"""What the records of parts are made of."""

import numpy as np
import pytest

from skin_host.health.describe import _period, common_shift

TRIANGLES = np.repeat(np.arange(3), 10)
MS = 1_000_000


def test_what_moves_all_triangles_is_a_common_shift() -> None:
    rests = np.ones(30, np.bool_)
    noise = np.random.default_rng(1).normal(0.0, 0.8, 30)
    assert common_shift(2.0 + noise, rests, TRIANGLES) == pytest.approx(2.0, abs=0.5)
    rests[:8] = False
    assert common_shift(-3.0 + noise, rests, TRIANGLES) == pytest.approx(-3.0, abs=0.5)


@pytest.mark.parametrize("units", [-16.0, 16.0])
def test_what_moves_most_pads_of_some_triangles_only_is_none(units: float) -> None:
    """A press that a board took for its zero has lifted, or something lies on the part."""
    shift = np.random.default_rng(2).normal(0.0, 0.8, 30)
    shift[:18] += units
    assert common_shift(shift, np.ones(30, np.bool_), TRIANGLES) == 0.0


def test_a_pause_among_the_first_sweeps_is_no_longer_period() -> None:
    assert _period(np.array([50] * 7 + [200]) * MS, 50) == (None, None)
    assert _period(np.array([50] * 8 + [200]) * MS, 50) == (50.0, 0.0)
    assert _period(np.array([90] * 8) * MS, 50) == (90.0, 0.0)
