"""Pads that jump up and down are found, and forgiven when they have been calm."""

import numpy as np

from skin_host.processing.erratic import CALM_S, LIMIT, RELIEF, Erratic

STEP_KPA = 5.0


def samples(*kpa: float) -> np.ndarray:
    """The first of three pads; the second presses slowly, the third is quiet."""
    rows = np.zeros((len(kpa), 3), np.float32)
    rows[:, 0] = kpa
    rows[:, 1] = np.arange(len(kpa))
    return rows


def jumping(looks: int) -> Erratic:
    found = Erratic(np.array([STEP_KPA, STEP_KPA, np.inf]))
    for _ in range(looks):
        found.look(samples(0, 9, 0, 9))
    return found


def test_a_pad_that_jumps_again_and_again_is_erratic_and_the_others_are_not():
    assert not jumping(int(LIMIT) - 1).any
    found = jumping(int(LIMIT))
    assert found.any
    assert found.pads.tolist() == [True, False, False]


def test_a_press_and_a_release_that_lie_far_apart_are_no_jumps():
    found = jumping(0)
    for _ in range(20):
        found.look(samples(0, 9, 9, 9))  # up
        found.look(samples(9, 9, 0, 0))  # and down in a later look
    assert not found.any


def test_rare_jumps_are_forgotten():
    found = jumping(0)
    for _ in range(20):
        found.look(samples(0, 9, 0))
        for _ in range(round(1.0 / RELIEF)):
            found.look(samples(0, 0, 0))
    assert not found.any


def test_too_few_samples_show_no_jump():
    found = jumping(0)
    for _ in range(20):
        found.look(samples(0, 9))
    assert not found.any


def test_an_erratic_pad_is_believed_again_when_it_was_calm_for_a_minute():
    found = jumping(10)
    found.pass_time(CALM_S - 1.0)
    assert found.pads[0]
    found.pass_time(2.0)
    assert not found.any
    assert not found.pads.any()


def test_a_new_zero_begins_without_old_jumps():
    found = jumping(10)
    found.reset(np.array([True, False, False]))
    assert not found.any
    found.look(samples(0, 9, 0))
    assert not found.any
