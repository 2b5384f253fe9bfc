import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.processing.touch import Imprints, TouchDetector, sure_units, threshold_units
from skin_host.settings import Touch

ON, OFF = np.array([2.0]), np.array([1.5])


def told(signal, votes):
    detector = TouchDetector(ON, OFF, votes)
    return [bool(detector.step(np.array([value]))[0]) for value in signal]


def test_one_sample_over_the_threshold_is_no_touch():
    assert not any(told([0, 0, 5, 0, 0, 0], votes=2))


def test_two_of_three_samples_are_a_touch_and_two_of_three_end_it():
    assert told([0, 5, 0, 5, 5, 0, 5, 0, 0, 0], votes=2) == [
        bool(x) for x in (0, 0, 0, 1, 1, 1, 1, 0, 0, 0)
    ]


def test_one_vote_tells_at_once_and_three_wait_for_three():
    assert told([0, 5, 5, 5, 0, 0, 0], votes=1) == [bool(x) for x in (0, 1, 1, 1, 0, 0, 0)]
    assert told([0, 5, 5, 5, 0, 0, 0, 0], votes=3) == [bool(x) for x in (0, 0, 0, 1, 1, 1, 0, 0)]


def test_what_is_barely_above_the_threshold_must_last_for_three_samples():
    detector = TouchDetector(ON, OFF, 2, sure=np.array([4.0]))
    signal = [0, 3, 3, 0, 0, 3, 3, 3, 1.6, 1.6, 0, 0, 0, 3, 4, 4, 0, 0]
    told = [bool(detector.step(np.array([value]))[0]) for value in signal]
    assert told == [bool(x) for x in (0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 0, 0, 0, 0, 1, 1, 0)]


def test_a_noisy_taxel_is_sure_further_above_its_threshold():
    noise = np.array([0.3, 0.8])
    threshold = threshold_units(np.array([1.0, 1.4]), np.zeros(2), noise, Touch())
    quiet, noisy = sure_units(threshold, noise) - threshold
    assert quiet == 0.0
    assert noisy > 1.0


def test_exactly_the_threshold_is_a_touch():
    assert told([2, 2, 2], votes=2)[-1]


def test_a_touch_lasts_down_to_the_lower_threshold():
    assert told([2, 2, 1.6, 1.6, 1.6, 1.4, 1.4], votes=2) == [
        bool(x) for x in (0, 1, 1, 1, 1, 1, 0)
    ]
    assert not any(told([1.6] * 5, votes=2))


def test_what_is_no_number_touches_nothing():
    assert not any(told([np.nan] * 5, votes=2))


@given(st.lists(st.floats(0.0, 4.0), max_size=60), st.sampled_from([1, 2, 3]))
def test_after_three_quiet_samples_nothing_is_touched_and_none_need_be_taken(signal, votes):
    detector = TouchDetector(ON, OFF, votes)
    for value in [*signal, 0.0, 0.0, 0.0]:
        touched = detector.step(np.array([value]))
    assert not touched.any()
    assert detector.idle


def test_answers_are_not_changed_afterwards():
    detector = TouchDetector(ON, OFF, 1)
    first = detector.step(np.array([5.0]))
    detector.step(np.array([0.0]))
    detector.reset(np.array([0]))
    assert first[0]


def test_the_threshold_is_the_papers_for_quiet_taxels():
    # 95th percentile 1 unit above the mean, margin of 2: readings of 3 and more are a touch.
    (threshold,) = threshold_units(np.array([1.0]), np.zeros(1), np.array([0.4]), Touch())
    assert 2.0 < threshold <= 3.0


def test_noisy_taxels_keep_a_distance_in_proportion_to_their_noise():
    noise = np.array([1.0, 2.0, 3.0])
    thresholds = threshold_units(1.645 * noise, np.zeros(3), noise, Touch())
    assert np.all(thresholds >= 3.6 * noise)


def test_a_release_threshold_above_the_threshold_is_refused():
    with pytest.raises(ValueError, match="release"):
        TouchDetector(OFF, ON)


@given(
    st.lists(st.lists(st.integers(0, 4), min_size=4, max_size=4), min_size=1, max_size=40),
    st.sampled_from([1, 2, 3]),
    st.lists(st.integers(0, 39), max_size=3),
)
def test_the_decision_is_the_vote_counted_out_at_every_sample(rows, votes, resets):
    detector = TouchDetector(np.full(4, 3.0), np.full(4, 2.0), votes, sure=np.full(4, 4.0))
    nothing = np.zeros(4, bool)
    touched, over, sure = nothing, [nothing] * 3, [nothing] * 3
    for number, row in enumerate(rows):
        if number in resets:
            detector.reset(np.array([1]))
            others = np.arange(4) != 1
            touched = touched & others
            over, sure = [one & others for one in over], [one & others for one in sure]
        signal = np.array(row, float)
        over = [*over[1:], signal >= np.where(touched, 2.0, 3.0)]
        sure = [*sure[1:], signal >= 4.0]
        count = np.sum(over, axis=0)
        if votes == 1:
            touched = over[-1]
        elif votes == 2:
            touched = (count == 3) | (np.sum(sure, axis=0) >= 2) | (touched & (count >= 2))
        else:
            touched = (count == 3) | (touched & (count > 0))
        assert np.array_equal(detector.step(signal), touched)


def told_after_a_press(press, rest, *, rest_s=0.0):
    """Whether a rest is told as a new touch, after a press and so long of nothing."""
    detector, imprints = TouchDetector(ON, OFF), Imprints(ON)
    told = []
    for value in [press] * 5 + [0.0] * 3:
        signal = np.array([value])
        told.append(bool(imprints.step(detector.step(signal), signal)[0]))
    assert any(told)
    imprints.fade(rest_s)
    for _ in range(5):
        signal = np.array([rest])
        told.append(bool(imprints.step(detector.step(signal), signal)[0]))
    return told[-1]


def test_what_a_hard_press_leaves_in_the_foam_is_no_new_touch():
    assert not told_after_a_press(100.0, 4.5)
    assert told_after_a_press(20.0, 4.5)  # a softer one leaves less
    assert told_after_a_press(100.0, 6.0)  # and this is more than it left


def test_what_a_press_has_left_is_forgotten():
    assert told_after_a_press(100.0, 3.0, rest_s=10.0)


def test_a_press_that_goes_down_without_end_is_one_touch():
    detector, imprints = TouchDetector(ON, OFF), Imprints(ON)
    told = [
        bool(imprints.step(detector.step(np.array([value])), np.array([value]))[0])
        for value in [100.0] * 5 + [3.0] * 50
    ]
    assert told == [False] + [True] * 54
