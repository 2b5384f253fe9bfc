from itertools import product

import numpy as np
import pytest

from skin_host.fingertip.grasp import (
    FingerFlags,
    Flags,
    GraspThresholds,
    analyse,
    next_mode,
)

LIMITS = GraspThresholds(touch_n=0.2, over_n=2.0, slip_n_s=5.0, slip_hold_s=0.03, lost_s=0.2)
MS = 1_000_000


@pytest.mark.parametrize(
    ("normal_n", "rate_n_s", "flags"),
    [
        (0.1, 0.0, Flags(0)),
        (0.3, 0.0, Flags.TOUCH),
        (0.1, 6.0, Flags.TOUCH | Flags.SLIP),
        (0.3, 6.0, Flags.TOUCH | Flags.SLIP),
        (2.5, 0.0, Flags.TOUCH | Flags.OVER),
        (2.5, 6.0, Flags.TOUCH | Flags.SLIP | Flags.OVER),
        (0.2, 5.0, Flags(0)),  # thresholds must be exceeded
    ],
)
def test_the_truth_table_of_touch_slip_and_over(normal_n, rate_n_s, flags):
    # One element of three decides, whichever it is.
    for place in range(3):
        normal, rate = np.zeros(3), np.zeros(3)
        normal[place], rate[2 - place] = normal_n, rate_n_s
        assert analyse(normal, rate, LIMITS) == flags


def test_the_truth_table_of_search_and_move():
    for touch, lost, done in product([False, True], repeat=3):
        after_search = next_mode(Flags.SEARCH, touch=touch, lost=lost, done=done)
        assert after_search == (Flags.MOVE if touch else Flags.SEARCH)
        after_move = next_mode(Flags.MOVE, touch=touch, lost=lost, done=done)
        assert after_move == (Flags.SEARCH if lost or done else Flags.MOVE)


def run(finger, samples):
    """Feed (milliseconds, normal, rate) and collect flags, and when which of them changed."""
    changes = []
    for t_ms, normal, rate in samples:
        changed = finger.step(np.array([normal]), np.array([rate]), t_ms * MS)
        changes.append((t_ms, changed & (Flags.SLIP | Flags.OVER)))
    return finger.flags, [change for change in changes if change[1]]


def test_a_finger_searches_until_it_touches_and_moves_until_it_has_lost_touch():
    finger = FingerFlags(LIMITS)
    assert run(finger, [(0, 0.0, 0.0)])[0] == Flags.SEARCH
    assert run(finger, [(10, 0.5, 0.0)])[0] == Flags.MOVE | Flags.TOUCH
    assert run(finger, [(100, 0.0, 0.0)])[0] == Flags.MOVE
    assert run(finger, [(211, 0.0, 0.0)])[0] == Flags.SEARCH


def test_a_finger_waits_for_the_others_before_it_moves():
    finger = FingerFlags(LIMITS)
    pressed, still = np.array([0.5]), np.array([0.0])
    finger.step(pressed, still, 0, others_touch=False)
    assert finger.flags == Flags.SEARCH | Flags.TOUCH
    finger.step(pressed, still, 10 * MS, others_touch=True)
    assert finger.flags == Flags.MOVE | Flags.TOUCH
    finger.step(pressed, still, 20 * MS, done=True)
    assert finger.flags == Flags.SEARCH | Flags.TOUCH


def test_a_train_of_slips_is_one_slip_and_over_is_separate():
    finger = FingerFlags(LIMITS)
    _, changes = run(
        finger,
        [
            (0, 1.0, 0.0),
            (10, 1.0, 8.0),
            (20, 1.0, 0.0),
            (30, 1.0, 9.0),
            (55, 2.5, 0.0),
            (70, 2.5, 0.0),
            (80, 1.0, 0.0),
        ],
    )
    assert changes == [(10, Flags.SLIP), (55, Flags.OVER), (70, Flags.SLIP), (80, Flags.OVER)]


def test_a_clock_that_steps_back_ends_what_was_held():
    finger = FingerFlags(LIMITS)
    run(finger, [(1000, 1.0, 9.0)])
    flags, _ = run(finger, [(10, 0.0, 0.0)])
    assert flags == Flags.SEARCH
