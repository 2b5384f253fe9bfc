"""Which bytes of a sweep are new measurements."""

import numpy as np

from skin_host.processing.conversions import Conversions

SLOW_S, FAST_S = 0.05, 0.01
RAW = np.array([240, 230], np.uint8)


def test_nothing_repeats_where_sweeps_are_further_apart_than_conversions() -> None:
    conversions = Conversions(2)
    for _ in range(3):
        assert conversions.step(RAW.copy(), SLOW_S) is None


def test_a_quick_sweep_after_slow_ones_repeats_what_has_not_changed() -> None:
    conversions = Conversions(2)
    conversions.step(RAW.copy(), SLOW_S)
    changed = RAW + np.array([0, 1], np.uint8)
    repeated = conversions.step(changed, FAST_S)
    assert repeated is not None
    assert repeated.tolist() == [True, False]


def test_a_byte_that_stays_is_new_again_after_a_conversion() -> None:
    conversions = Conversions(2)
    conversions.step(RAW.copy(), SLOW_S)
    found = []
    for _ in range(4):
        repeated = conversions.step(RAW.copy(), FAST_S)
        assert repeated is not None
        found.append(bool(repeated[0]))
    assert found == [True, True, True, False]


def test_after_sweeps_that_were_left_out_everything_is_new() -> None:
    conversions = Conversions(2)
    conversions.step(RAW.copy(), SLOW_S)
    conversions.forget()
    repeated = conversions.step(RAW.copy(), FAST_S)
    assert repeated is not None
    assert not repeated.any()
