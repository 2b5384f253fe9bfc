import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.config.settings import Drift
from skin_host.processing.drift import BaselineTracker, paper_step, proportional_step
from skin_host.processing.loaded_zeros import BULGED

N = 24
NOBODY = np.zeros(N, bool)
TRIANGLE = np.repeat(np.arange(2, dtype=np.int32), 12)


def tracker(rule="proportional", thermal=NOBODY, **settings):
    return BaselineTracker(np.zeros(N), ~thermal, TRIANGLE, thermal, Drift(rule=rule, **settings))


def follow(track, true_baseline, touched=NOBODY, press=0.0, noise=0.0, rng=None):
    """One second: the tracker is shown what would be read above its baseline."""
    units = true_baseline - track.baseline + np.where(touched, press, 0.0)
    if rng is not None:
        units = units + rng.normal(0.0, noise, N)
    return track.step(units, touched, NOBODY, 1.0)


def after_touch(touched, seconds):
    """A tracker under a touch of 25 units that has lasted so long."""
    track = tracker()
    for _ in range(seconds):
        follow(track, 0.0, touched, 25.0)
    return track


def test_the_papers_rule_moves_by_a_fixed_step_outside_its_dead_band():
    units = np.array([-3.0, -0.6, -0.5, -0.1, 0.0, 0.5, 0.6, 9.0])
    change = paper_step(units, 0.04, 0.1, 0.5)
    assert change == pytest.approx(np.array([-1, -1, 0, 0, 0, 0, 1, 1]) * 0.004)


def test_the_papers_rule_has_no_bias():
    rng = np.random.default_rng(1)
    baseline = 0.0
    for reading in rng.normal(0.0, 1.0, 20_000):
        baseline += paper_step(np.array([reading - baseline]), 0.04, 0.1, 0.5)[0]
    assert abs(baseline) < 0.3


def test_the_proportional_rule_does_not_depend_on_the_length_of_its_steps():
    once = proportional_step(np.array([0.2]), 1.0, 0.2)[0]
    left = 0.2
    for _ in range(10):
        left -= proportional_step(np.array([left]), 0.1, 0.2)[0]
    assert 0.2 - left == pytest.approx(once)


@pytest.mark.parametrize("rule", ["paper", "proportional"])
@pytest.mark.parametrize("rate", [0.01, 0.05, 0.09, -0.09])
def test_a_drift_below_the_fastest_rate_is_followed(rule, rate):
    track = tracker(rule)
    true = 0.0
    for _ in range(200):
        true += rate
        follow(track, true)
    assert np.abs(true - track.baseline).max() < 0.9


def test_no_rule_leaves_baselines_alone():
    track = tracker("none")
    for _ in range(20):
        follow(track, 2.0)
    assert not track.baseline.any()


def test_a_touched_taxel_shares_the_drift_of_the_untouched():
    track = tracker()
    touched = np.arange(N) < 6
    rng = np.random.default_rng(0)
    true = 0.0
    for _ in range(600):
        true += 0.004
        follow(track, true, touched, press=30.0, noise=0.1, rng=rng)
    assert np.abs(true - track.baseline).max() < 0.4


def test_a_steady_touch_is_not_absorbed_in_eight_hours():
    track = tracker()
    touched = np.arange(N) < 6
    for _ in range(8 * 360):
        units = np.where(touched, 8.0 - track.baseline, -track.baseline)
        assert track.step(units, touched, NOBODY, 10.0) is None
    assert np.abs(track.baseline).max() < 0.01
    assert track.frozen[:6].all()
    assert not track.frozen[6:].any()


def test_what_is_left_of_a_contact_that_let_go_is_taken_for_drift():
    track = tracker()
    everything = ~NOBODY
    for _ in range(600):
        follow(track, 0.0, everything, press=35.0)
    found = [follow(track, 0.0, everything, press=2.6) for _ in range(2)]
    assert found[0] is None
    assert sorted(found[1]) == list(range(N))
    assert track.baseline == pytest.approx(np.full(N, 2.6))


@given(st.integers(5, 600), st.floats(0.3, 4.0), st.integers(0, N))
def test_as_much_is_left_by_drift_as_a_firm_press_may_have_hidden(seconds, left, ended):
    """However many other taxels of the part have ended before: they did not show it either."""
    track = tracker()
    for _ in range(seconds):
        follow(track, 0.0, ~NOBODY, press=35.0)
    stays = np.arange(N) >= ended
    found = [follow(track, 0.0, stays, press=left) for _ in range(2)][1]
    most = min(0.01 * seconds + 0.25, 0.01 * (seconds + 2), 3.5)
    if abs(left - most) > 0.02:
        is_drift = left < most and ended < N
        assert (found is not None) is is_drift
        if is_drift:
            assert found.tolist() == np.flatnonzero(stays).tolist()


def test_a_hold_that_was_eased_to_little_hides_no_drift_however_long_it_lasts():
    """What drifts meanwhile is in its reading."""
    track = tracker()
    for press in [35.0] * 60 + [3.0] * 3600:
        assert follow(track, 0.0, ~NOBODY, press=press) is None
    assert np.abs(track.baseline).max() < 0.1


@pytest.mark.parametrize(("free", "is_released"), [(12, False), (13, True)])
def test_a_part_is_released_where_most_of_what_was_pressed_of_late_is_free(free, is_released):
    track = after_touch(~NOBODY, 60)
    assert not track.is_released
    follow(track, 0.0, np.arange(N) >= free, 25.0)
    assert track.is_released is is_released
    for _ in range(60):
        follow(track, 0.0, np.arange(N) >= free, 25.0)
    assert not track.is_released


def test_what_is_left_after_a_short_contact_is_still_a_contact():
    track = tracker()
    everything = ~NOBODY
    for press in [35.0] * 10 + [5.0] * 120:
        assert follow(track, 0.0, everything, press=press) is None


def test_taxels_that_bulge_while_others_are_held_are_not_followed():
    track = tracker()
    touched, bulged = np.arange(N) < 3, np.arange(N) >= 12
    for _ in range(60):
        units = np.where(touched, 20.0, np.where(bulged, -6.0, 0.0)) - track.baseline
        track.step(units, touched, NOBODY, 1.0)
    assert np.abs(track.baseline).max() < 0.7


@pytest.mark.parametrize("rate", [0.2, 0.3, -0.3])
def test_what_all_untouched_taxels_do_alike_is_followed_without_the_rules_limit(rate):
    track = tracker()
    rng = np.random.default_rng(5)
    true = 0.0
    for _ in range(100):
        true += rate
        follow(track, true, noise=0.1, rng=rng)
        assert np.abs(true - track.baseline).max() < 0.9


def test_a_load_of_the_whole_part_that_comes_quickly_is_no_drift():
    track = tracker()
    for _ in range(3):
        units = np.full(N, 2.0) * (_ + 1) / 3 - track.baseline
        track.step(units, NOBODY, NOBODY, 1.0)
    for _ in range(10):
        track.step(2.0 - track.baseline, NOBODY, NOBODY, 1.0)
    assert track.baseline.max() < 0.3
    for _ in range(600):
        track.step(2.0 - track.baseline, NOBODY, NOBODY, 1.0)
    assert track.baseline == pytest.approx(np.full(N, 2.0), abs=0.5)


def test_a_release_of_the_whole_part_is_followed_at_once():
    track = tracker()
    track.step(np.full(N, -9.0), NOBODY, NOBODY, 1.0)
    assert track.baseline == pytest.approx(np.full(N, -9.0))


def test_a_slow_load_that_was_absorbed_blinds_no_taxel_after_its_release():
    track = tracker()
    loaded = np.arange(N) < 6
    for second in range(240):
        track.step(np.where(loaded, 0.05 * second, 0.0) - track.baseline, NOBODY, NOBODY, 1.0)
    assert track.baseline[:6].min() > 9.0
    for _ in range(7):
        track.step(-track.baseline, NOBODY, NOBODY, 1.0)
    assert np.abs(track.baseline).max() < 0.5


def test_taxels_pressed_through_the_calibration_are_not_blind_for_long():
    track = tracker()
    pressed = np.arange(N) < 4
    for second in range(20):
        # A tap of 12 units for half of every third second.
        tap = 6.0 * (second % 3 == 2)
        track.step(np.where(pressed, tap - 14.0, 0.0) - track.baseline, NOBODY, NOBODY, 1.0)
    assert track.baseline[:4].max() < -8.0


def test_a_bulge_is_not_followed_while_it_is_short_or_something_is_touched():
    track = tracker()
    touched, bulged = np.arange(N) < 2, np.arange(N) >= 18
    for _ in range(4):
        track.step(np.where(bulged, -7.0, 0.0) - track.baseline, NOBODY, NOBODY, 1.0)
    for _ in range(600):
        units = np.where(touched, 20.0, np.where(bulged, -7.0, 0.0)) - track.baseline
        track.step(units, touched, NOBODY, 1.0)
    assert np.abs(track.baseline).max() < 0.5


def fall_and_return(track, away, beside=0.0):
    """Some taxels read 30 units less for ten minutes, and then what they read before."""
    for _ in range(600):
        track.step(np.where(away, -30.0, 0.0) - track.baseline, NOBODY, NOBODY, 1.0)
    back = np.where(away, beside, 0.0)
    return [track.step(back - track.baseline, away, NOBODY, 1.0) for _ in range(2)]


@pytest.mark.parametrize("fallen", [4, N])
def test_what_returns_to_where_it_was_before_a_fall_is_in_doubt(fallen):
    """It may be pressed as it was when its zero was taken, or was pulled and is free."""
    track = tracker()
    away = np.arange(N) < fallen
    assert fall_and_return(track, away) == [None, None]
    assert np.array_equal(track.returned, away)
    for _ in range(7200):
        track.step(np.where(away, 5.0, 0.0) - track.baseline, NOBODY, NOBODY, 1.0)
    assert np.array_equal(track.returned, away)
    assert track.baseline[:fallen] == pytest.approx(np.full(fallen, -30.0), abs=0.5)


def test_what_falls_again_was_pressed_and_is_believed_from_then_on():
    track = tracker()
    away = np.arange(N) < 4
    fall_and_return(track, away)
    unknown = np.where(away, 0.0, -track.baseline)
    track.step(unknown, NOBODY, away, 1.0)
    assert np.array_equal(track.returned, away)
    track.step(np.where(away, -16.0, 0.0) - track.baseline, NOBODY, NOBODY, 1.0)
    assert not track.returned.any()
    track.step(np.where(away, -30.0, 0.0) - track.baseline, NOBODY, NOBODY, 1.0)
    for _ in range(10):
        track.step(-track.baseline, away, NOBODY, 1.0)
    assert not track.returned.any()
    assert track.baseline[:4] == pytest.approx(np.full(4, -30.0), abs=0.5)


def test_a_new_zero_ends_the_doubt_and_so_does_the_end_of_tracking():
    track = tracker()
    away = np.arange(N) < 4
    fall_and_return(track, away)
    track.baseline[0] = 0.0
    track.forget(np.arange(N) == 0)
    assert np.array_equal(np.flatnonzero(track.returned), [1, 2, 3])
    track.renew(np.ones(N, bool), NOBODY, Drift(rule="none"))
    assert not track.returned.any()


def warm(track, touched, rate, seconds):
    """Touched taxels drift; return the error of the baselines [n]."""
    rng = np.random.default_rng(8)
    dt_s = 1.0 if seconds <= 600 else 10.0
    true = np.zeros(N)
    for _ in range(round(seconds / dt_s)):
        true = true + np.where(touched, rate * dt_s, 0.0)
        units = true - track.baseline + np.where(touched, 30.0, 0.0) + rng.normal(0.0, 0.1, N)
        assert track.step(units, touched, NOBODY, dt_s) is None
    return np.abs(true - track.baseline)


@pytest.mark.parametrize(("held", "rate", "seconds"), [(6, 0.008, 600), (N, 0.001, 28800)])
def test_taxels_that_grow_warm_under_a_hand_are_followed_and_reported(held, rate, seconds):
    track = tracker()
    touched = np.arange(N) < held
    assert warm(track, touched, rate, seconds).max() < 1.0
    assert track.frozen[:held].all()
    assert not track.frozen[held:].any()


def test_two_minutes_of_a_steady_touch_are_not_reported():
    track = tracker()
    follow(track, 0.0)
    warm(track, np.arange(N) < 6, 0.0, 120)
    assert not track.frozen.any()


def test_a_touch_whose_load_slowly_eases_is_left_alone():
    track = tracker()
    assert warm(track, np.arange(N) < 6, -0.008, 600).max() == pytest.approx(4.8, abs=0.3)


def test_a_load_that_grows_is_no_drift():
    track = tracker()
    touched = np.arange(N) < 6
    for second in range(400):
        track.step(
            np.where(touched, 5.0 + 0.05 * second, 0.0) - track.baseline, touched, NOBODY, 1.0
        )
    # A fifth of 20 units: what rises more slowly than that is not distinguished from drift.
    assert np.abs(track.baseline).max() < 4.0


def test_what_foam_pushes_back_after_a_load_was_eased_is_no_drift():
    track = tracker()
    touched = np.arange(N) < 6
    for _ in range(60):
        track.step(np.where(touched, 33.0, 0.0) - track.baseline, touched, NOBODY, 1.0)
    for second in range(400):
        units = np.where(touched, 13.0 + 0.005 * second, 0.0) - track.baseline
        track.step(units, touched, NOBODY, 1.0)
    assert np.abs(track.baseline).max() < 0.1


def test_a_grip_that_is_eased_after_long_is_found_again_when_the_foam_pushes_back():
    track = tracker()
    held = np.arange(N) < 6
    for _ in range(1500):
        follow(track, 0.0, held, 25.0)
    touched = held
    for second in range(300):
        press = np.where(held, 1.6 + 3.0 * -np.expm1(-second / 30.0), 0.0)
        units = press - track.baseline
        ghosts = track.step(units, touched, NOBODY, 1.0)
        touched = held & (units > np.where(touched, 1.0, 2.0))
        if ghosts is not None:
            touched[ghosts] = False
    assert np.abs(track.baseline).max() < 1.0
    assert touched[held].all()


def test_a_touch_that_ends_while_the_foam_is_late_is_found_again_when_it_pushes_back():
    """Its grip was eased, not released, and reads too little for seconds."""
    held = np.arange(N) < 6
    track = after_touch(held, 1500)
    for second in range(150):
        eased = np.where(held, 0.7 + 1.8 * -np.expm1(-second / 30.0), 0.0)
        track.step(eased - track.baseline, NOBODY, NOBODY, 1.0)
    assert track.baseline[held] == pytest.approx(np.zeros(6), abs=0.2)


def test_what_is_left_of_a_touch_is_followed_while_the_whole_part_drifts():
    """The drift alone is no load that pushes back."""
    held = np.arange(N) < 6
    track = after_touch(held, 1500)
    for second in range(200):
        follow(track, 0.008 * second + np.where(held, 1.2, 0.0))
    assert track.baseline == pytest.approx(0.008 * 200 + np.where(held, 1.2, 0.0), abs=0.1)


def test_what_is_left_of_a_touch_is_followed_while_another_pad_is_touched():
    held, other = np.arange(N) < 6, np.arange(N) == 20
    track = after_touch(held | other, 60)
    for _ in range(60):
        follow(track, np.where(held, 1.2, 0.0), other, 25.0)
    assert track.baseline[held] == pytest.approx(np.full(6, 1.2), abs=0.1)


def test_a_press_after_a_touch_that_ended_by_itself_is_no_foam_that_pushes_back():
    held = np.arange(N) < 6
    track = after_touch(held, 60)
    for _ in range(60):
        follow(track, np.where(held, 1.2, 0.0))
    assert track.baseline[held] == pytest.approx(np.full(6, 1.2), abs=0.1)
    for _ in range(20):
        follow(track, np.where(held, 1.2, 0.0), held, 25.0)
    assert track.baseline[held] == pytest.approx(np.full(6, 1.2), abs=0.1)


def test_what_the_foam_is_late_with_in_short_pauses_is_no_drift():
    track = tracker()
    held = np.arange(N) < 6
    for _ in range(100):
        for press, touched in ((20.0, held), (20.0, held), (1.5, NOBODY), (1.5, NOBODY)):
            track.step(np.where(held, press, 0.0) - track.baseline, touched, NOBODY, 1.0)
    assert np.abs(track.baseline).max() < 0.3


def test_a_light_contact_after_a_silence_is_not_what_a_firm_one_before_it_has_left():
    track = tracker()
    held = np.arange(N) < 6
    for _ in range(600):
        follow(track, 0.0, held, 25.0)
    track.pass_gap(120.0)
    for _ in range(60):
        assert follow(track, 0.0, held, 3.3) is None
    assert np.abs(track.baseline).max() < 0.1


def test_new_baselines_are_kept_whatever_was_known_of_the_old_ones():
    track = tracker()
    fallen = np.arange(N) == 3
    for _ in range(10):
        track.step(np.where(fallen, -20.0, 0.0) - track.baseline, NOBODY, NOBODY, 1.0)
    track.forget(fallen)
    for _ in range(10):
        track.step(np.where(fallen, 20.0, 0.0), fallen, NOBODY, 1.0)
    assert track.baseline[3] == pytest.approx(-20.0)


def test_missing_taxels_share_what_the_others_have_in_common():
    track = tracker()
    missing = np.arange(N) < 4
    true = 0.0
    for _ in range(100):
        true += 0.01
        track.step(np.where(missing, 0.0, true - track.baseline), NOBODY, missing, 1.0)
    assert track.baseline[:4] == pytest.approx(np.full(4, true), abs=0.1)


def test_a_baseline_never_leaves_its_limits_and_says_when_it_reaches_them():
    track = tracker(limit_units=3.0)
    true = 0.0
    for _ in range(100):
        true += 0.05
        follow(track, true)
    assert track.baseline == pytest.approx(np.full(N, 3.0))
    assert track.at_limit.all()


def test_thermal_pads_tell_of_drift_when_everything_is_touched():
    thermal = np.arange(N) % 12 >= 10
    track = tracker(thermal=thermal)
    share = np.random.default_rng(3).normal(0.6, 0.1, N)
    warmth = 0.0

    def second(rate, press):
        nonlocal warmth
        warmth += rate
        drifted = share * warmth
        units = np.where(thermal, warmth, drifted - track.baseline + press)
        track.step(units, ~thermal & (press > 0.0), NOBODY, 1.0)
        return (drifted - track.baseline)[~thermal]

    for rate in (0.02, -0.02):
        for _ in range(300):
            second(rate, 0.0)
    for _ in range(600):
        error = second(0.01, 30.0)
    assert np.mean(share[~thermal] * warmth) > 3.0
    assert np.abs(error).max() < 0.8


def test_two_samples_of_one_time_teach_nothing_of_the_temperature():
    thermal = np.arange(N) % 12 >= 10
    track = tracker(thermal=thermal)
    for warmth in (0.0, 5.0):
        with np.errstate(all="raise"):
            track.step(np.where(thermal, warmth, 0.0), ~thermal, NOBODY, 0.0)
    assert (track.baseline == 0.0).all()


def test_a_temperature_pad_that_is_missing_tells_of_no_drift():
    """What it read last, or reads while nobody believes it, is no temperature."""
    thermal = np.arange(N) % 12 >= 10
    track = tracker(thermal=thermal)
    for _ in range(2):
        for warmth in (*np.arange(0.0, 4.0, 0.02), *np.arange(4.0, 0.0, -0.02)):
            units = np.where(thermal, warmth, warmth - track.baseline)
            track.step(units, NOBODY, NOBODY, 1.0)
    begun = track.baseline.copy()
    one = np.arange(N) == 10
    for _ in range(20):
        units = np.where(one, 240.0, np.where(thermal, 0.0, 30.0))
        track.step(units, ~thermal, one, 1.0)
    assert track.baseline == pytest.approx(begun, abs=0.2)


@pytest.mark.parametrize("jump", [-240.0, -60.0, -20.0, -8.0, 8.0, 20.0, 240.0])
@pytest.mark.parametrize("held", [0, 6])
def test_a_temperature_pad_that_fails_moves_no_zero_that_others_show_to_be_right(jump, held):
    """Pads of its triangle that had followed it were touched for ever."""
    thermal = np.arange(N) % 12 == 11
    track = tracker(thermal=thermal)
    rng = np.random.default_rng(5)
    touched = np.arange(N) < held

    def second(warmth, shift, press=NOBODY):
        drifted = 0.5 * warmth - track.baseline + np.where(press, 30.0, 0.0)
        reads = np.where(thermal, warmth + shift * (np.arange(N) == 11), drifted)
        track.step(reads + rng.normal(0.0, 0.2, N), press, NOBODY, 1.0)
        return (0.5 * warmth - track.baseline)[~thermal]

    for warmth in np.arange(0.0, 12.0, 0.02):
        second(warmth, 0.0)
    errors = [second(12.0, jump, touched) for _ in range(120)]
    assert np.abs(errors).max() < 1.6
    assert np.abs(errors[-1]).max() < 0.6
    errors = [second(12.0, 0.0, touched) for _ in range(60)]
    assert np.abs(errors).max() < 1.6


@pytest.mark.parametrize("jump", [-240.0, -50.0, 50.0, 240.0])
def test_a_temperature_pad_that_jumps_while_its_whole_triangle_is_pressed_ends_no_press(jump):
    thermal = np.arange(N) % 12 == 11
    track = tracker(thermal=thermal)
    for warmth in np.arange(0.0, 12.0, 0.02):
        track.step(np.where(thermal, warmth, 0.5 * warmth - track.baseline), NOBODY, NOBODY, 1.0)
    begun = track.baseline.copy()
    for _ in range(60):
        units = np.where(thermal, 12.0 + jump, 30.0 + begun - track.baseline)
        track.step(units, ~thermal, NOBODY, 1.0)
    assert track.baseline == pytest.approx(begun, abs=0.1)


def test_a_new_zero_says_nothing_of_how_a_taxel_followed_the_temperature():
    """A jump of the readings with that of the temperature pads is no relation of the two."""
    thermal = np.arange(N) % 12 >= 10
    mine = np.arange(N) < 12
    track = tracker(thermal=thermal)
    for _ in range(30):
        track.step(np.where(thermal, 80.0, -4.0 - track.baseline), NOBODY, NOBODY, 1.0)
    track.baseline[mine & ~thermal] = 0.0
    track.forget(mine & ~thermal)
    for _ in range(30):
        reads = np.where(mine, 0.0, np.where(thermal, 80.0, -4.0))
        track.step(reads - track.baseline, NOBODY, NOBODY, 1.0)
        assert track.baseline[mine & ~thermal] == pytest.approx(0.0, abs=0.1)


def test_thermal_pads_that_do_not_feel_the_drift_do_no_harm():
    thermal = np.arange(N) % 12 >= 10
    track = tracker(thermal=thermal)
    rng = np.random.default_rng(4)
    true = 0.0
    for _ in range(600):
        true += 0.01
        units = np.where(thermal, rng.normal(0.0, 0.3, N), true - track.baseline)
        track.step(units, NOBODY, NOBODY, 1.0)
    assert np.abs(true - track.baseline[~thermal]).max() < 0.3


def test_a_grip_that_is_eased_is_no_drift_where_untouched_taxels_show_none():
    track = tracker()
    held = np.arange(N) < 6
    for _ in range(1500):
        follow(track, 0.0, held, 25.0)
    assert all(follow(track, 0.0, held, 3.0) is None for _ in range(60))
    assert np.abs(track.baseline).max() < 0.1


def test_drift_that_the_foams_relaxation_hides_under_a_touch_is_known_at_the_release():
    track = tracker()
    held = np.arange(N) < 6
    for second in range(1500):
        # The pressure falls as fast as the zero rises, so only the reading shows the drift.
        drift = 0.002 * second
        relaxed = np.where(held, drift, 0.0)
        track.step(np.where(held, 25.0, 0.0) - track.baseline, held, NOBODY, 1.0, relaxed)
    found = [follow(track, 0.0, held, 2.6) for _ in range(2)]
    assert found[1] is not None
    assert list(found[1]) == list(range(6))


@pytest.mark.parametrize("pad", [0, 23])
def test_taxels_of_a_triangle_without_a_thermal_pad_are_followed_without_one(pad):
    track = tracker(thermal=np.arange(N) == pad)
    true = 0.0
    for _ in range(200):
        true += 0.01
        follow(track, true)
    others = np.arange(N) != pad
    assert np.abs(true - track.baseline[others]).max() < 0.3


@pytest.mark.parametrize(("free", "moved"), [(3, False), (4, True)])
def test_four_untouched_taxels_stand_for_the_part_and_three_do_not(free, moved):
    track = tracker()
    touched = np.arange(N) >= free
    for _ in range(20):
        units = np.where(touched, 30.0, 0.01)
        track.step(units, touched, NOBODY, 1.0)
    assert bool(track.baseline[-1] > 0.1) is moved


@pytest.mark.parametrize(("free", "moved"), [(1, False), (2, True), (3, True)])
def test_a_slow_rise_of_the_few_free_pads_of_a_fingertip_is_drift_of_them_all(free, moved):
    """It is in use all the time, and becomes warm by a degree a minute."""
    track = fingertip()
    touched = np.arange(12) >= free
    for second in range(240):
        units = 0.008 * (second + 1) + np.where(touched, 30.0, 0.0) - track.baseline
        track.step(units, touched, touched & False, 1.0)
    assert bool(np.all(track.baseline > 1.8)) is moved


@pytest.mark.parametrize("shown", [[0.02, -0.5, 0.02], [-0.5, -0.5, -0.5]])
def test_what_not_all_free_pads_of_a_fingertip_rise_by_may_be_a_bulge_and_moves_no_touched_one(
    shown,
):
    track = fingertip()
    touched = np.arange(12) >= 3
    for _ in range(60):
        units = np.concatenate([shown, np.full(9, 30.0)])
        track.step(units, touched, touched & False, 1.0)
    assert track.baseline[3:] == pytest.approx(0.0, abs=1e-9)


def fingertip():
    part = np.zeros(12, np.int32)
    return BaselineTracker(np.zeros(12), part == 0, part, part > 0, Drift())


def test_pads_beside_a_touch_that_drift_more_than_the_others_are_followed():
    """As those of a palm do, beside fingers of thinner foam."""
    track = tracker()
    touched, more = np.arange(N) < 3, np.arange(N) >= 18
    rng = np.random.default_rng(6)
    for second in range(240):
        drifted = np.where(more, 0.014, 0.006) * (second + 1)
        units = drifted + np.where(touched, 20.0, 0.0) - track.baseline + rng.normal(0.0, 0.1, N)
        track.step(units, touched, NOBODY, 1.0)
    assert (drifted - track.baseline)[more].max() < 1.0


@pytest.mark.parametrize("noise", [0.1, 0.2])
def test_noise_beside_a_touch_does_not_lift_the_baselines(noise):
    track = tracker()
    touched = np.arange(N) < 3
    rng = np.random.default_rng(7)
    for _ in range(1200):
        units = rng.normal(0.0, noise, N) + np.where(touched, 20.0, 0.0) - track.baseline
        track.step(units, touched, NOBODY, 1.0)
    assert np.abs(track.baseline[3:]).max() < 0.3


def test_a_part_moves_alike_when_four_fifths_of_its_taxels_do():
    def moves(alike):
        track = tracker()
        units = np.where(np.arange(N) < alike, 0.3, 1.5)
        track.step(units, NOBODY, NOBODY, 1.0)
        return track.baseline[0]

    assert moves(20) == pytest.approx(0.3)
    assert moves(19) < 0.2


def test_the_time_in_touch_is_reported_from_its_limit_on_and_fades_after_it():
    track = tracker(frozen_report_s=30.0)
    touched = np.arange(N) < 6
    found = []
    for _ in range(31):
        follow(track, 0.0, touched, 20.0)
        found.append(bool(track.frozen[0]))
    assert found == [False] * 29 + [True] * 2
    for _ in range(2):
        follow(track, 0.0)
    assert not track.frozen.any()


def test_a_zero_that_no_reading_has_shown_to_be_right_is_uncertain_after_a_minute_of_touch():
    """After a night it may be wrong, and pads read as touched though nothing touches them."""
    track = tracker()
    touched = np.arange(N) < 6
    for _ in range(59):
        follow(track, 0.0, touched, 25.0)
    assert not track.frozen.any()
    follow(track, 0.0, touched, 25.0)
    assert np.array_equal(track.frozen, touched)
    follow(track, 0.0)
    for _ in range(300):
        follow(track, 0.0, touched, 25.0)
    assert not track.frozen.any()
    track.renew(np.ones(N, bool), np.arange(N) < 3, Drift())
    for _ in range(60):
        follow(track, 0.0, touched, 25.0)
    assert np.array_equal(track.frozen, np.arange(N) < 3)


def test_without_tracking_no_touch_of_before_is_reported_for_ever():
    track = tracker(frozen_report_s=30.0)
    touched = np.arange(N) < 6
    for _ in range(40):
        follow(track, 0.0, touched, 25.0)
    assert track.frozen[:6].all()
    track.renew(np.ones(N, bool), NOBODY, Drift(rule="none", frozen_report_s=30.0))
    for _ in range(60):
        follow(track, 0.0)
    assert not track.frozen.any()
    track.renew(np.ones(N, bool), NOBODY, Drift(frozen_report_s=30.0))
    for _ in range(29):
        follow(track, 0.0, touched, 25.0)
        assert not track.frozen.any()
    follow(track, 0.0, touched, 25.0)
    assert track.frozen[:6].all()


def test_a_taxel_that_fell_alone_is_left_for_five_seconds_and_then_followed_at_once():
    track = tracker()
    baselines = []
    for _ in range(6):
        follow(track, np.where(np.arange(N) == 5, -8.0, 0.0))
        baselines.append(track.baseline[5])
    assert baselines[3] == pytest.approx(0.0, abs=0.1)
    assert baselines[4:] == pytest.approx([-8.0, -8.0])


def test_half_a_unit_of_a_taxel_alone_is_noise_to_the_papers_rule_and_a_step_each_way_is_not():
    track = tracker("paper")
    for _ in range(10):
        units = np.zeros(N)
        units[:3] = 0.45, 0.8, -0.8
        track.step(units, NOBODY, NOBODY, 0.1)
    assert track.baseline[:4] == pytest.approx(np.array([0.0, 0.1, -0.1, 0.0]), abs=1e-9)


def test_noise_after_a_release_gives_nothing_back_that_was_taken_for_drift():
    track = tracker()
    everything = ~NOBODY
    for _ in range(600):
        follow(track, 0.0, everything, press=35.0)
    for _ in range(2):
        follow(track, 0.0, everything, press=2.6)
    assert track.baseline == pytest.approx(np.full(N, 2.6))
    for second in range(60):
        follow(track, 2.6 + (0.2 if second % 2 else -0.2))
        assert track.baseline == pytest.approx(np.full(N, 2.6), abs=0.5)


#: Too few taxels are free of it to represent the part.
MOST = np.arange(N) < 21


def let_go(press=2.6, relaxed=0.0):
    """A grip of ten minutes lets go, and what is left of it is taken for drift."""
    track = tracker()
    for _ in range(600):
        follow(track, 0.0, MOST, press=35.0)
    for _ in range(2):
        hold(track, press, MOST, relaxed)
    assert track.baseline[MOST] == pytest.approx(press)
    return track


def hold(track, press, touched=NOBODY, relaxed=0.0):
    """One second in which the taxels of the grip read so much above the calibration."""
    units = np.where(MOST, press, 0.0) - track.baseline
    return track.step(units, touched, NOBODY, 1.0, np.where(MOST, relaxed, 0.0))


def test_what_was_taken_for_drift_is_given_back_when_the_foam_pushes_back():
    track = let_go()
    for _ in range(10):
        hold(track, 2.6)
    for _ in range(2):
        hold(track, 5.6, MOST)
    assert track.baseline[MOST] == pytest.approx(0.0)


@pytest.mark.parametrize(("seconds", "given_back"), [(178, True), (179, False)])
def test_what_was_taken_for_drift_may_be_given_back_for_three_minutes(seconds, given_back):
    track = let_go()
    for _ in range(seconds):
        hold(track, 2.6)
    hold(track, 12.6, MOST)
    assert track.baseline[MOST] == pytest.approx(0.0 if given_back else 2.6)


def test_a_reading_that_overshoots_at_the_release_does_not_make_the_next_ones_a_load():
    track = let_go(press=1.4)
    for _ in range(30):
        hold(track, 2.6)
        assert track.baseline[MOST].min() > 1.3


@pytest.mark.parametrize(("rise", "given_back"), [(2.0, False), (4.0, True)])
def test_a_rise_of_less_than_half_of_what_free_foam_would_lose_is_its_models_error(
    rise, given_back
):
    track = let_go(relaxed=6.0)
    for _ in range(10):
        hold(track, 2.6, relaxed=6.0)
    for second in range(60):
        passed = min(second / 10.0, 1.0)
        hold(track, 2.6 + rise * passed, relaxed=6.0 - 6.0 * passed)
    assert bool(track.baseline[0] < 1.0) is given_back


def test_a_baseline_that_fell_at_a_release_is_never_given_back_upwards():
    track = let_go(press=-2.0)
    for press in [-2.0] * 10 + [0.5] * 4:
        hold(track, press)
    assert track.baseline[MOST] == pytest.approx(-2.0, abs=0.05)


@pytest.mark.parametrize(("left", "is_drift"), [(2.1, True), (2.4, False)])
def test_a_quarter_of_the_relaxation_may_be_left_of_a_touch_that_let_go(left, is_drift):
    track = tracker()
    held = np.arange(N) < 6
    for _ in range(600):
        follow(track, 0.0, held, press=35.0)
    units = np.where(held, left, 0.0)
    found = [track.step(units, held, NOBODY, 1.0, np.where(held, 8.0, 0.0)) for _ in range(2)]
    assert (found[1] is not None) is is_drift


@pytest.mark.parametrize(("free_s", "after_s"), [(20, 12), (60, 30)])
def test_a_touch_that_comes_back_soon_goes_on_from_what_has_not_faded(free_s, after_s):
    """Of 1000 s, e to the power of -20 s / 5 s is 18 s; after a minute all is forgotten."""
    track = tracker(frozen_report_s=30.0)
    touched = np.arange(N) < 6
    for _ in range(1000):
        follow(track, 0.0, touched, 20.0)
    for _ in range(free_s):
        follow(track, 0.0)
    found = []
    for _ in range(31):
        follow(track, 0.0, touched, 20.0)
        found.append(bool(track.frozen[0]))
    assert found.index(True) + 1 == after_s


def test_after_a_shift_in_touch_a_new_touch_counts_from_its_beginning():
    track = tracker(frozen_report_s=30.0)
    touched = np.arange(N) < 6
    for _ in range(8 * 360):
        track.step(np.where(touched, 20.0, 0.0) - track.baseline, touched, NOBODY, 10.0)
    for _ in range(60):
        follow(track, 0.0)
    for _ in range(29):
        follow(track, 0.0, touched, 20.0)
        assert not track.frozen.any()
    follow(track, 0.0, touched, 20.0)
    assert track.frozen[:6].all()


@pytest.mark.parametrize("rule", ["paper", "proportional"])
@pytest.mark.parametrize("dt_s", [0.1, 1.0, 3.0])
def test_what_a_taxel_reads_alone_moves_its_baseline_at_the_rules_rate_at_most(rule, dt_s):
    track = tracker(rule)
    units = np.zeros(N)
    units[5] = 2.0
    track.step(units, NOBODY, NOBODY, dt_s)
    assert track.baseline[5] == pytest.approx(0.1 * dt_s)


def test_where_the_zero_of_a_temperature_pad_is_does_not_matter():
    thermal = np.arange(N) % 12 >= 10

    def followed(zero):
        track = tracker(thermal=thermal)
        warmth = 0.0
        for second in range(900):
            warmth += 0.02 if second < 300 or second >= 600 else -0.02
            held = ~thermal if second >= 600 else NOBODY
            units = 0.5 * warmth - track.baseline + np.where(held, 30.0, 0.0)
            track.step(np.where(thermal, zero + warmth, units), held, NOBODY, 1.0)
        return track.baseline[~thermal]

    assert followed(50.0) == pytest.approx(followed(0.0), abs=0.01)
    assert followed(0.0) == pytest.approx(3.0, abs=0.3)


@pytest.mark.parametrize(("beside", "returned"), [(0.9, True), (-0.9, True), (1.2, False)])
def test_within_a_unit_of_where_it_was_a_taxel_has_returned(beside, returned):
    track = tracker()
    away = np.arange(N) < 4
    fall_and_return(track, away, beside)
    assert track.returned[:4].all() == returned


def test_fewer_than_four_taxels_that_have_not_fallen_do_not_move_the_part():
    track = tracker()
    fallen = np.where(np.arange(N) < 3, 0.0, -5.0 - np.arange(N))
    track.step(fallen, NOBODY, NOBODY, 1.0)
    assert track.baseline == pytest.approx(0.0, abs=0.001)


def stride(track, lifts, relaxed=0.0, missing=NOBODY, noise=0.5, touched=NOBODY):
    """A second in which a load that is in the zeros of some taxels is lifted for a moment."""
    units = np.where(lifts, -3.0, 0.0) - track.baseline
    lowest = np.where(lifts, -7.0, 0.0) - track.baseline
    track.step(units, touched, missing, 1.0, relaxed, lowest=(lowest, np.full(N, noise)))


@pytest.mark.parametrize(
    ("lifted", "touched", "followed"),
    [(N // 2 + 1, 1, True), (N // 2, 1, False), (BULGED + 1, 0, True), (BULGED, 0, False)],
)
def test_a_load_in_the_zeros_of_much_of_a_part_is_known_after_two_steps(lifted, touched, followed):
    """Nothing else is below zero so widely; a bulge is beside a touch."""
    track = tracker()
    lifts, presses = np.arange(N) < lifted, np.arange(N) >= N - touched
    stride(track, lifts, touched=presses)
    assert track.baseline[:lifted].min() > -4.0
    stride(track, lifts, touched=presses)
    assert bool(track.baseline[0] == pytest.approx(-7.0, abs=0.1)) == followed
    assert np.abs(track.baseline[lifted:]).max() < 0.5


@pytest.mark.parametrize(("pause_s", "known"), [(4, True), (6, False)])
def test_two_steps_that_far_apart_are_one_each(pause_s, known):
    track = tracker()
    lifts = np.arange(N) < 20
    stride(track, lifts)
    for _ in range(pause_s):
        follow(track, 0.0)
    stride(track, lifts)
    assert (track.baseline[0] < -6.5) == known


def test_what_the_model_of_the_foam_takes_off_too_much_is_no_load_in_a_zero():
    track = tracker()
    for _ in range(4):
        stride(track, np.arange(N) < 20, relaxed=5.0)
    assert track.baseline.min() > -5.0


@pytest.mark.parametrize(("beside", "bulges"), [(1, False), (2, True)])
def test_most_of_a_small_part_may_bulge_beside_what_is_touched(beside, bulges):
    track = tracker()
    for _ in range(2):
        stride(track, np.arange(N) < 20, touched=np.arange(N) >= N - beside)
    assert (track.baseline[0] > -4.0) == bulges


def test_what_is_touched_when_it_comes_back_was_loaded_all_the_same():
    track = tracker()
    lifts = np.arange(N) < 20
    for _ in range(2):
        stride(track, lifts, touched=lifts)
    assert track.baseline[:20].max() < -6.5


def test_what_noise_makes_low_is_no_load_in_a_zero():
    track = tracker()
    for _ in range(4):
        stride(track, np.arange(N) < 20, noise=3.1)
    assert track.baseline.min() > -5.0


def test_taxels_that_are_missing_show_no_load_in_their_zeros():
    track = tracker()
    lifts = np.arange(N) < 20
    for _ in range(4):
        stride(track, lifts, missing=np.arange(N) < 10)
    assert np.abs(track.baseline[:10]).max() < 0.5
    assert track.baseline[10:20].max() < -6.5


def test_a_new_zero_is_shown_to_be_wrong_by_its_own_steps_alone():
    track = tracker()
    lifts = np.arange(N) < 20
    stride(track, lifts)
    track.forget(np.ones(N, bool))
    stride(track, lifts)
    assert track.baseline.min() > -4.0


def test_what_temperature_pads_showed_hours_ago_counts_less_than_what_they_show_now():
    """A pad that was moved follows the temperature by a fifth of a unit a unit, not by one."""
    thermal = np.arange(N) % 12 >= 10
    track = tracker(thermal=thermal)
    warmth = drifted = 0.0
    for share in (1.0, 0.2, 0.2, 0.2, 0.2, 0.2):
        for step in range(360):
            rise = 0.04 if step % 180 < 90 else -0.04
            warmth += rise
            drifted += share * rise
            units = np.where(thermal, warmth, drifted - track.baseline)
            track.step(units, NOBODY, NOBODY, 10.0)
    begun = track.baseline[~thermal].copy()
    for _ in range(100):
        warmth += 0.04
        units = np.where(thermal, warmth, 30.0)
        track.step(units, ~thermal, NOBODY, 10.0)
    assert (track.baseline[~thermal] - begun) == pytest.approx(0.8, abs=0.3)


def test_a_small_change_that_all_readings_share_is_followed_at_once_and_only_once():
    track = tracker()
    follow(track, np.full(N, 0.02))
    assert track.baseline == pytest.approx(np.full(N, 0.02))


@pytest.mark.parametrize("conversions", [2.5, 5.0, 10.0, 20.0])
@pytest.mark.parametrize("rate", [0.05, 0.1, -0.2])
def test_drift_of_all_is_followed_however_few_conversions_are_in_a_mean(conversions, rate):
    track = tracker()
    rng = np.random.default_rng(7)
    true = 0.0
    for _ in range(150):
        true += rate
        units = true - track.baseline + rng.normal(0.0, 1.0 / np.sqrt(conversions), N)
        track.step(units, NOBODY, NOBODY, 1.0, 0.0, conversions)
        assert np.median(np.abs(true - track.baseline)) < 1.2


@pytest.mark.parametrize("conversions", [5.0, 10.0, 20.0])
def test_a_load_that_grows_unevenly_is_no_drift_however_few_conversions_are_in_a_mean(conversions):
    """Noise makes nothing alike that is not: it is taken out of the means, not let through."""
    track = tracker()
    rates = np.linspace(0.0, 0.5, N)
    taken = []
    for second in range(60):
        load = np.minimum(rates * second, 20.0 * rates)
        before = track.baseline.copy()
        track.step(load - track.baseline, NOBODY, NOBODY, 1.0, 0.0, conversions)
        taken.append(np.median(track.baseline - before))
    # What differs at once by the tolerance shows in a mean as long as twenty conversions take.
    assert sum(taken[: 3 + int(20.0 / conversions)]) < 3.0
    assert max(taken[30:]) < 0.11


def test_a_taxel_that_was_not_received_is_alike_by_what_it_read_before():
    """Its mean shows nothing; a few conversions after it show little."""
    track = tracker()
    rng = np.random.default_rng(2)
    true = 0.0
    for second in range(100):
        true += 0.2
        lost = rng.random(N) < 0.3
        conversions = np.where(lost, 0.0, 5.0)
        units = np.where(lost, 30.0, true - track.baseline + rng.normal(0.0, 0.4, N))
        track.step(units, NOBODY, lost, 1.0, 0.0, conversions)
        assert np.median(np.abs(true - track.baseline)) < 0.9, second


def test_drift_goes_on_after_a_window_in_which_noise_made_taxels_differ():
    track = tracker()
    true = 0.0
    for second in range(40):
        true += 0.35
        noise = 3.0 * (np.arange(N) % 2) if second % 5 == 4 else 0.0
        track.step(true + noise - track.baseline, NOBODY, NOBODY, 1.0)
    assert true - track.baseline.max() < 0.8


@pytest.mark.parametrize(("units", "followed"), [(0.75, True), (1.1, False)])
def test_a_load_of_the_whole_part_above_what_two_windows_of_drift_are_is_not_followed(
    units, followed
):
    track = tracker()
    for _ in range(20):
        track.step(units - track.baseline, NOBODY, NOBODY, 1.0)
    assert bool(track.baseline.min() > 0.7) is followed
    assert followed or track.baseline.max() < 0.25


def test_a_window_of_no_time_changes_nothing():
    track = let_go()
    before = track.baseline.copy()
    with np.errstate(all="raise"):
        assert track.step(np.full(N, 1.0), NOBODY, NOBODY, 0.0) is None
        for _ in range(10):
            hold(track, 2.6)
    assert track.baseline == pytest.approx(before, abs=0.1)


def in_units_of(fineness, usable=NOBODY):
    """A tracker of taxels in units that are so many times finer than the usual ones."""
    usable = usable if usable.any() else ~NOBODY
    return BaselineTracker(np.zeros(N), usable, TRIANGLE, NOBODY, Drift(), fineness)


MIXED = np.where(np.arange(N) < 12, 4.0, 1.0)


@pytest.mark.parametrize("fineness", [2.0, 4.0, MIXED])
@pytest.mark.parametrize("rate", [0.04, 0.2, -0.3])
def test_drift_is_followed_alike_in_units_of_any_size(fineness, rate):
    """In the finest ones all of a part that became warm was touched, and so ever after."""
    track = in_units_of(np.broadcast_to(fineness, N))
    rng = np.random.default_rng(8)
    true = 0.0
    for _ in range(120):
        true += rate
        units = true * fineness - track.baseline + rng.normal(0.0, 0.09, N) * fineness
        assert track.step(units, NOBODY, NOBODY, 1.0) is None
        assert np.abs((true * fineness - track.baseline) / fineness).max() < 0.5


def test_the_drift_of_a_single_pad_is_followed_in_the_finest_units():
    one = np.arange(N) == 3
    track = in_units_of(4.0, one)
    true = 0.0
    for _ in range(120):
        true += 4.0 * 0.04
        track.step(true - track.baseline, NOBODY, NOBODY, 1.0)
        assert abs(true - track.baseline[3]) < 1.2


@pytest.mark.parametrize("fineness", [1.0, 4.0])
def test_what_a_hand_warms_is_followed_under_the_touch_in_units_of_any_size(fineness):
    track = in_units_of(fineness)
    touched = ~NOBODY
    for second in range(600):
        drift = 0.008 * fineness * second
        track.step(25.0 * fineness + drift - track.baseline, touched, NOBODY, 1.0)
    assert track.baseline == pytest.approx(np.full(N, drift), abs=0.5 * fineness)
    assert track.frozen.all()


@pytest.mark.parametrize("fineness", [1.0, 4.0])
def test_a_load_that_grows_by_a_kpa_a_second_is_no_drift_in_units_of_any_size(fineness):
    track = in_units_of(fineness)
    load = 0.0
    for _ in range(10):
        load += 0.5 * fineness
        track.step(load - track.baseline, NOBODY, NOBODY, 1.0)
    assert np.abs(track.baseline).max() <= 0.11 * fineness


@pytest.mark.parametrize("fineness", [1.0, 4.0])
def test_the_limit_is_as_far_away_in_units_of_any_size(fineness):
    track = in_units_of(fineness)
    for _ in range(120):
        track.step(np.full(N, -45.0 * fineness) - track.baseline, NOBODY, NOBODY, 5.0)
    assert track.baseline == pytest.approx(np.full(N, -40.0 * fineness))
    assert track.at_limit.all()
