import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skin_host.config.settings import TouchSettings
from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.touch import LOST_S, TouchDetector, levels
from tests.support.deciding import BAND, REST, SWEEP_S, detector_of, flags, levels_of, pressed


def touched_over(signal, votes=2, found=BAND):
    detector = detector_of(found, votes)
    return [bool(pressed(detector, value)[0]) for value in signal]


@pytest.mark.parametrize(("gap_s", "touched"), [(0.8 * LOST_S, True), (1.2 * LOST_S, False)])
def test_what_an_untouched_taxel_read_before_it_was_lost_is_no_evidence(gap_s, touched):
    """It may be received now and then only because of what it reads: then noise is a touch."""
    detector = detector_of()
    pressed(detector, 2)
    raw = np.full(1, REST, np.uint8)
    for _ in range(round(gap_s / SWEEP_S)):
        detector.step(raw, SWEEP_S, np.array([True]))
    assert not detector.touched[0]
    assert bool(pressed(detector, 2)[0]) is touched
    assert pressed(detector, 2)[0]


def test_a_touch_ends_when_its_taxel_is_lost_for_long_at_a_time_and_not_now_and_then():
    detector = detector_of()
    raw = np.full(1, REST - 50, np.uint8)
    lost = np.ones(1, np.bool_)
    for _ in range(2):
        detector.step(raw, SWEEP_S)
    for _ in range(20):
        assert detector.step(raw, SWEEP_S, lost)[0]
        assert detector.step(raw, SWEEP_S)[0]
    turns = round(LOST_S / SWEEP_S) + 1
    assert not [detector.step(raw, SWEEP_S, lost)[0] for _ in range(turns)][-1]


def test_one_measurement_over_the_threshold_is_no_touch():
    assert not any(touched_over([0, 0, 50, 0, 0, 0]))


def test_two_measurements_are_a_touch_and_two_end_it():
    assert touched_over([0, 5, 5, 5, 0, 5, 0, 0, 0]) == flags(0, 0, 1, 1, 1, 1, 1, 0, 0)


def test_one_vote_decides_at_once_and_three_wait_for_three():
    assert touched_over([0, 5, 5, 0, 0], votes=1) == flags(0, 1, 1, 0, 0)
    assert touched_over([0, 5, 5, 5, 0, 0, 0], votes=3) == flags(0, 0, 0, 1, 1, 1, 0)


def test_a_conversion_that_is_sent_again_has_no_second_vote():
    detector = detector_of()
    pressed(detector, 0)
    for dt_s in (0.02, 0.01, 0.005):
        assert not pressed(detector, 30, dt_s)[0]
    # The chip has converted again since: the same byte is another measurement.
    assert pressed(detector, 30, 0.03)[0]


@pytest.mark.parametrize("period_ms", [5, 10, 18, 20, 25, 36])
def test_no_period_gives_a_single_conversion_two_votes(period_ms):
    detector = detector_of()
    for t_ms in range(0, 37 - period_ms, period_ms):
        assert not pressed(detector, 30, period_ms * 1e-3)[0], t_ms


def test_what_was_not_received_has_no_vote():
    detector = detector_of()
    raw = np.full(1, REST - 30, np.uint8)
    assert not detector.step(raw, SWEEP_S)[0]
    for _ in range(5):
        assert not detector.step(raw, SWEEP_S, np.ones(1, bool))[0]
    assert detector.step(raw, SWEEP_S)[0]


def test_a_touch_lasts_while_it_stands_between_the_thresholds():
    found = levels_of(2.5, 1.5, 1.0, 1.0)
    assert touched_over([3, 3, 2, 2, 2, 2, 1, 1], found=found) == flags(0, 1, 1, 1, 1, 1, 1, 0)
    assert not any(touched_over([2] * 20, found=found))


def test_a_weak_press_needs_as_many_measurements_as_its_noise_demands():
    found = levels_of(1.75, 1.75, 6.0, 6.0)
    assert touched_over([3] * 5, found=found).index(True) == 4
    assert touched_over([6] * 5, found=found).index(True) == 1


@pytest.mark.parametrize(("units", "idle"), [(0, True), (2, True), (3, False)])
def test_a_sweep_is_skipped_unless_it_adds_evidence(units: int, idle: bool) -> None:
    detector = detector_of(levels_of(2.0, 1.0, 1.0, 1.0))
    assert detector.is_idle(np.array([REST - units], np.uint8)) is idle


def test_evidence_fades_before_sweeps_are_skipped_so_votes_far_apart_are_no_touch() -> None:
    detector, rest = detector_of(), np.full(1, REST, np.uint8)
    for _ in range(3):
        assert not pressed(detector, 5)[0]
        assert not detector.is_idle(rest)
        skipped = 0
        for _ in range(10):
            if detector.is_idle(rest):
                skipped += 1
            else:
                pressed(detector, 0)
        assert 0 < skipped < 10


def test_a_taxel_without_a_vote_is_never_touched():
    found = levels_of(np.inf, np.inf, 1.0, 1.0)
    assert not any(touched_over([200] * 20, found=found))


def test_answers_are_not_changed_afterwards():
    detector = detector_of(votes=1)
    first = pressed(detector, 5)
    pressed(detector, 0)
    detector.reset(np.array([0]))
    assert first[0]


def test_other_levels_leave_what_is_touched_touched():
    detector = detector_of()
    for _ in range(2):
        pressed(detector, 10)
    noisier = levels_of(3.0, 2.0, 8.0, 8.0)
    detector.configure(noisier, 2)
    assert pressed(detector, 10)[0]
    assert not [pressed(detector, 0)[0] for _ in range(5)][-1]


def test_evidence_against_other_levels_makes_no_touch():
    detector = detector_of(levels_of(1.75, 1.75, 3.0, 3.0))
    pressed(detector, 3)
    detector.configure(levels_of(6.75, 6.75, 0.5, 0.5), 2)
    assert not pressed(detector, 0)[0]


@given(
    st.lists(st.lists(st.integers(0, 6), min_size=4, max_size=4), min_size=1, max_size=60),
    st.sampled_from([1, 2, 3]),
    st.lists(st.integers(0, 39), max_size=3),
)
@settings(deadline=None)
def test_the_decision_is_the_evidence_added_up_and_idle_sweeps_may_be_left_out(rows, votes, resets):
    span = np.array([0.5, 1.0, 3.0, 6.0])
    found = levels_of(np.full(4, 2.5), np.full(4, 1.5), span, np.array([0.5, 1.5, 3.0, 8.0]))
    detector, evidence, touched = detector_of(found, votes), np.zeros(4), np.zeros(4, bool)
    for number, row in enumerate(rows):
        if number in resets:
            detector.reset(np.array([1]))
            evidence[1], touched[1] = 0.0, False
        vote, veto = (limit * (1 + 1e-5) / votes for limit in (span, found.hold))
        gain = np.array(row) - np.where(touched, found.leave, found.enter)
        evidence = np.clip(evidence + np.clip(gain, -veto, vote), 0.0, found.hold)
        touched = np.where(touched, evidence > 1e-4 * found.hold, evidence >= span - 1e-5)
        raw = REST - np.array(row, np.uint8)
        if detector.is_idle(raw):
            assert not touched.any()
        else:
            assert np.array_equal(detector.step(raw, SWEEP_S), touched)


def test_the_threshold_is_the_papers_for_quiet_taxels():
    # Two units above a mean of 0 and of 0.4: readings of 2, and of 3.
    for rest in (0.0, 0.4):
        found = levels(np.array([np.ceil(rest) - rest]), np.array([0.1]), TouchSettings())
        first = np.ceil(found.enter + found.span / 2 - 1e-9 + rest)
        assert first == np.ceil(rest) + 2


def test_noise_needs_measurements_and_not_pressure():
    quiet, usual, noisy = levels(
        np.full(3, 0.6), np.array([0.3, 1.0, 1.5]), TouchSettings()
    ).decides
    assert usual < quiet + 0.5
    assert noisy < quiet + 1.0


def test_settings_of_nothing_make_no_decision_of_noise():
    still = TouchSettings(margin_units=0.0, minimum_threshold_units=0.0, hysteresis_units=0.0)
    found = levels(np.zeros(2), np.array([0.0, 1.0]), still)
    assert np.all(found.leave >= 0.0)
    assert np.all(found.enter > 0.0)
    assert np.all(found.span > 0.0)


@pytest.mark.parametrize("spread", [0.4, 0.8, 1.2, 2.0, 5.0])
def test_noise_reaches_its_span_as_rarely_as_it_was_made_for(spread):
    """At odds of 10^4 instead of 10^9, which can be counted."""
    rng = np.random.default_rng(3)
    n, steps = 400, 5000
    found = levels(np.full(n, 0.5), np.full(n, spread), TouchSettings())
    less = np.log(1e4) / np.log(1e9)
    fewer = found._replace(span=found.span * less)
    detector = detector_of(fewer)
    begun, before = 0, detector.touched
    for _ in range(steps):
        raw = np.rint(REST + spread * rng.standard_normal(n)).astype(np.uint8)
        touched = detector.step(raw, SWEEP_S)
        begun += int(np.count_nonzero(touched & ~before))
        before = touched
    assert begun < n * steps / 1e4


@pytest.mark.parametrize("spread", [0.5, 1.0, 2.0])
def test_noise_alone_takes_a_thousand_million_measurements_for_a_touch(spread: float) -> None:
    """By Siegmund's mean time to a false alarm of a cumulative sum."""
    found = levels(np.zeros(1), np.array([spread]), TouchSettings(hysteresis_units=0.1))
    drift = found.enter[0] / spread
    bound = found.span[0] / spread + 1.166  # the sum goes beyond its bound by so much
    measurements = math.exp(2 * drift * bound) / (2 * drift**2)
    assert measurements == pytest.approx(1e9)


def test_a_taxel_without_noise_has_the_thresholds_of_its_settings() -> None:
    still = TouchSettings(margin_units=3.0, hysteresis_units=1.0, minimum_threshold_units=0.5)
    found = levels(np.array([0.0, 0.5, 9.0]), np.zeros(3), still)
    # Half a unit less than the margin, and as much more as the percentile of a byte may be.
    assert found.enter == pytest.approx(np.array([2.0, 2.5, 2.5]))
    assert found.leave == pytest.approx(found.enter)
    assert found.whole == pytest.approx(found.enter + 0.5)
    assert found.span == pytest.approx(np.ones(3))
    assert found.hold == pytest.approx(found.span)
    assert found.fall == pytest.approx(np.zeros(3))
    assert found.votes.tolist() == [2, 2, 2]
    assert found.decides == pytest.approx(found.enter + found.span * 0.0369, abs=1e-3)


def test_a_quiet_taxel_that_rests_at_the_edge_of_a_byte_is_not_touched_by_it() -> None:
    """Calibrated in the middle, with noise of 0.3 units, it reads 1.54 below its rest at times."""
    found = levels(np.zeros(1), np.array([0.31]), TouchSettings())
    detector = TouchDetector(found)
    detector.renew(np.array([244.54]))
    assert [bool(detector.step(np.array([raw], np.uint8), 0.05)[0]) for raw in (245, 243, 243)] == [
        False,
        False,
        False,
    ]
    assert [bool(detector.step(np.array([raw], np.uint8), 0.05)[0]) for raw in (239, 238)] == [
        False,
        True,
    ]


def test_the_least_threshold_and_the_hysteresis_bound_each_other() -> None:
    least = TouchSettings(margin_units=0.2, hysteresis_units=5.0, minimum_threshold_units=0.8)
    found = levels(np.zeros(1), np.zeros(1), least)
    assert (found.enter[0], found.span[0]) == pytest.approx((0.4, 0.8))
    # A measurement that counts in full is no firmer press than the margin and what bounds it.
    assert found.whole[0] == pytest.approx(0.8)


@pytest.mark.parametrize("interval_s", [CONVERSION_S, 0.05, 0.1, 0.209])
@pytest.mark.parametrize("spread", [0.3, 1.0, 2.0, 4.5])
@pytest.mark.parametrize("votes", [2, 3])
def test_nearly_every_press_of_what_a_taxel_surely_decides_on_is_decided_in_a_second(
    interval_s: float, spread: float, votes: int
) -> None:
    """And of what it decides on in the mean, at the pace of conversions, not."""
    n = 1000
    rng = np.random.default_rng(3)
    found = levels(np.full(n, 0.5), np.full(n, spread), TouchSettings())
    press = found.decides_surely(interval_s, votes)
    detector = TouchDetector(found, votes)
    rest = np.full(n, 200.3)
    detector.renew(rest)
    for _ in range(40):
        raw = np.rint(rest + spread * rng.standard_normal(n)).astype(np.uint8)
        detector.step(raw, interval_s)
    in_time = np.zeros(n, np.bool_)
    for _ in range(int(1.0 / interval_s + 1e-6)):
        raw = np.rint(rest - press + spread * rng.standard_normal(n)).astype(np.uint8)
        in_time |= detector.step(raw, interval_s)
    assert in_time.mean() > 0.94


def test_a_press_takes_its_votes_where_a_second_has_fewer_measurements() -> None:
    found = levels(np.zeros(1), np.array([0.5]), TouchSettings())
    assert np.isfinite(found.decides_surely(0.209, 8)).all()
    assert found.decides_surely(0.209, 8) == pytest.approx(found.decides_surely(0.125, 8))


@pytest.mark.parametrize(("votes", "expected"), [(2, [3, 3, 6, 27]), (3, [4, 4, 6, 27])])
def test_a_noisy_taxel_takes_more_measurements_for_a_decision(
    votes: int, expected: list[int]
) -> None:
    found = levels(np.full(4, 0.5), np.array([0.1, 0.5, 1.2, 8.0]), TouchSettings())
    assert found.measurements(votes).tolist() == expected


@given(st.floats(0.0, 0.6), st.floats(0.01, 8.0), st.floats(1.01, 3.0))
@settings(deadline=None)
def test_more_noise_takes_more_evidence_and_never_less_pressure(above, spread, factor) -> None:
    found = levels(np.full(2, above), spread * np.array([1.0, factor]), TouchSettings())
    for name in ("enter", "span", "hold", "fall", "votes", "decides"):
        quiet, noisy = getattr(found, name).tolist()
        assert noisy >= quiet * 0.75 if name == "fall" else noisy >= quiet - 1e-9, name
    assert (found.leave <= found.enter + 1e-9).all()
    assert (found.leave >= found.enter / 2 - 1e-9).all()
    band = min(TouchSettings().hysteresis_units, found.enter[0] * 2)
    assert found.hold == pytest.approx(
        np.clip(2 * (found.span - band), found.span, 1.5 * found.span), rel=0.02
    )
    assert found.leave == pytest.approx(found.enter * (1 + band / found.span) / 2, rel=0.02)
    wanted = np.clip(np.ceil(found.span / found.enter), 2, 14)
    assert found.votes.tolist() == wanted.tolist()
    assert found.fall == pytest.approx(4.0 * spread * np.array([1, factor]) * np.sqrt(2 / wanted))


def test_the_noisiest_taxels_wait_a_little_longer_than_their_odds_demand() -> None:
    found = levels(np.zeros(1), np.array([8.0]), TouchSettings())
    drift = found.enter[0] / 8.0
    measurements = math.exp(2 * drift * (found.span[0] / 8.0 + 1.166)) / (2 * drift**2)
    assert 1.1e9 < measurements < 2e9


def test_what_is_touched_keeps_a_sweep_from_being_skipped() -> None:
    detector = detector_of(votes=1)
    assert pressed(detector, 5)[0]
    assert detector.any
    assert not detector.is_idle(np.full(1, REST, np.uint8))


def test_a_reset_of_one_taxel_leaves_the_touch_of_another() -> None:
    detector = detector_of(levels_of(*np.repeat([[1.75], [1.75], [0.5], [0.5]], 2, axis=1)), 1)
    assert pressed(detector, [5, 5]).all()
    detector.reset(np.array([0]))
    assert detector.any
    detector.reset(np.array([1]))
    assert not detector.any


def test_a_lost_touch_is_lost_until_it_is_decided_again() -> None:
    detector = detector_of(levels_of(*np.repeat([[1.75], [1.75], [0.5], [0.5]], 3, axis=1)))
    for _ in range(3):
        pressed(detector, [5, 5, 5])
    detector.lose(np.array([True, True, True]))
    assert detector.lost is not None
    detector.reset(np.array([2]))
    assert detector.lost.tolist() == [True, True, False]
    pressed(detector, [5, 0, 0])
    assert detector.touched.tolist() == [True, False, False]
    assert detector.lost is None


def after_an_outage(seconds: float, units: int) -> list[bool]:
    """Press firmly, lose the taxel for some time, then read so many units; return the decisions."""
    detector = detector_of()
    for _ in range(10):
        pressed(detector, [20])
    raw = np.full(1, REST - 20, np.uint8)
    for _ in range(round(seconds / SWEEP_S)):
        detector.step(raw, SWEEP_S, np.ones(1, np.bool_))
    return [bool(pressed(detector, [units])[0]) for _ in range(3)]


def test_what_lifted_while_it_was_not_received_for_long_is_no_touch_when_it_is_back() -> None:
    assert after_an_outage(1.0, 0) == [False, False, False]


def test_what_still_presses_after_it_was_not_received_is_touched_at_once() -> None:
    assert after_an_outage(1.0, 20) == [True, True, True]


def test_a_few_sweeps_that_do_not_come_end_no_touch() -> None:
    assert after_an_outage(0.2, 0) == [True, False, False]
