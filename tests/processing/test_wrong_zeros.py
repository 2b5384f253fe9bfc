import numpy as np
import pytest

from skin_host.bus.assembler import Sweep
from skin_host.bus.wire import TRIANGLES
from skin_host.processing.drift import SETTLE_S
from skin_host.processing.rezero import BELOW_SWEEPS, END, JUMPS_NS
from skin_host.processing.wrong_zeros import INSIDE_WEIGHT, WrongZeros

PERIOD_NS = 50_000_000
ALL = np.ones(TRIANGLES, bool)
NONE = np.zeros((TRIANGLES, 12), bool)
PAD = NONE.copy()
PAD[2, 3] = True


def sweep(number, raw=240):
    bytes_ = np.broadcast_to(raw, (TRIANGLES, 12)).astype(np.uint8)
    status = np.zeros(TRIANGLES, np.uint16)
    return Sweep(0, bytes_, status, 0xFFFF, number * PERIOD_NS, 0)


def below(zeros, number, pads, *, present=ALL, pressed=NONE, is_new=False):
    """One sweep in which these pads read far below zero."""
    received = present, present
    seen = pads & present[:, None]
    one = sweep(number, np.where(seen, END, 240))
    return zeros.note_below(one, seen, received, pressed, 240.0, is_new=is_new)


def test_a_pad_that_stays_far_below_zero_has_a_wrong_one():
    zeros = WrongZeros()
    found = [below(zeros, number, PAD) for number in range(BELOW_SWEEPS + 2)]
    assert not any(one.any() for one in found[: BELOW_SWEEPS - 1])
    assert all(np.array_equal(one, PAD) for one in found[BELOW_SWEEPS - 1 :])


def test_a_pad_far_below_zero_is_in_doubt_at_once_and_only_while_it_reads_so():
    zeros = WrongZeros()
    below(zeros, 0, NONE)
    assert not zeros.below
    below(zeros, 1, PAD)
    assert np.array_equal(zeros.below[0] > 0, PAD)
    below(zeros, 2, NONE)
    assert not zeros.below


def test_sweeps_without_the_triangle_count_neither_way():
    zeros = WrongZeros()
    here = ALL.copy()
    here[2] = False
    for number in range(BELOW_SWEEPS - 1):
        below(zeros, number, PAD)
    assert not below(zeros, 10, PAD, present=here).any()
    assert np.array_equal(below(zeros, 11, PAD), PAD)


@pytest.mark.parametrize(("pressed", "found"), [(NONE, False), (PAD, True)])
def test_what_comes_back_soon_jumps_unless_it_was_pressed(pressed, found):
    zeros = WrongZeros()
    below(zeros, 0, PAD)
    below(zeros, 1, NONE, pressed=pressed)
    for number in range(2, 2 + BELOW_SWEEPS):
        last = below(zeros, number, PAD, pressed=pressed)
    assert last.any() == found


def test_what_comes_back_after_its_zero_was_found_wrong_is_pressed_again_and_did_not_jump():
    zeros = WrongZeros()
    for number in range(BELOW_SWEEPS + 1):
        below(zeros, number, PAD)
    below(zeros, 10, NONE)
    found = [below(zeros, 11 + number, PAD) for number in range(BELOW_SWEEPS)]
    assert np.array_equal(found[-1], PAD)


def test_two_seconds_after_a_jump_a_zero_may_be_wrong_again():
    zeros = WrongZeros()
    below(zeros, 0, PAD)
    below(zeros, 1, NONE)
    later = 1 + JUMPS_NS // PERIOD_NS
    found = [below(zeros, later + number, PAD) for number in range(BELOW_SWEEPS)]
    assert np.array_equal(found[-1], PAD)


def test_what_a_new_zero_brings_back_did_not_jump():
    zeros = WrongZeros()
    below(zeros, 0, PAD)
    below(zeros, 1, NONE, is_new=True)
    found = [below(zeros, 2 + number, PAD) for number in range(BELOW_SWEEPS)]
    assert np.array_equal(found[-1], PAD)


def at_end(zeros, number, *, touching=False, raw=END):
    return zeros.note_at_end(sweep(number, raw), PAD, PERIOD_NS * 1e-9, touching=touching)


def test_a_pad_that_rests_at_the_end_of_the_scale_has_a_wrong_zero():
    zeros = WrongZeros()
    seconds = round(SETTLE_S / (PERIOD_NS * 1e-9))
    found = [at_end(zeros, number) for number in range(seconds)]
    assert not found[-2].any()
    assert np.array_equal(found[-1], PAD)


def test_beside_a_touch_nothing_is_counted_and_nothing_is_forgotten():
    zeros = WrongZeros()
    for number in range(200):
        assert not at_end(zeros, number, touching=True).any()
    assert not zeros.may_be_at_end(sweep(200))
    at_end(zeros, 200)
    at_end(zeros, 201, touching=True)
    assert zeros.may_be_at_end(sweep(202))


def test_a_reading_inside_the_scale_counts_as_several_at_its_end():
    zeros = WrongZeros()
    for number in range(INSIDE_WEIGHT + 1):
        at_end(zeros, number)
    at_end(zeros, 50, raw=240)
    assert zeros.may_be_at_end(sweep(51))
    at_end(zeros, 51, raw=240)
    assert not zeros.may_be_at_end(sweep(52))


def test_a_new_zero_ends_what_was_counted_at_the_end_of_the_scale():
    zeros = WrongZeros()
    at_end(zeros, 0)
    zeros.forget(0)
    assert not zeros.may_be_at_end(sweep(1))


def test_a_triangle_is_of_the_same_chip_once_its_others_have_rested_in_sweeps_in_a_row():
    zeros, here = WrongZeros(), ALL.copy()
    here[2] = False
    for _ in range(BELOW_SWEEPS - 1):
        assert not zeros.note_resting(0, ALL, ALL).any()
    # What was not received counts neither way, and what rests no more begins again.
    assert zeros.note_resting(0, ALL & here, here).sum() == TRIANGLES - 1
    assert zeros.note_resting(0, ALL, ALL).all()
    assert zeros.follows(0)
    assert not zeros.note_resting(0, ~ALL, ALL).any()
    assert not zeros.follows(0)
