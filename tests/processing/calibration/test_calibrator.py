from dataclasses import replace

import numpy as np
import pytest

from emulator.chips.noise import SampledNoise
from skin_host.config.settings import Processing
from skin_host.layout import PadKind
from skin_host.processing import calibration
from skin_host.processing.calibration import Verdict
from skin_host.processing.calibration.calibrator import (
    FEWEST_SAMPLES,
    KNOWN_SAMPLES,
    NOISE_SAMPLES,
    PRESSED_UNITS,
    Calibrator,
    Known,
    going_on,
)
from skin_host.processing.pipeline import Pipeline
from tests.support.calibrated import LAYOUT, PRESENT, TIME, N, calibrated, noisy


def test_baseline_is_the_mean_and_noise_the_deviation():
    sweeps = noisy(np.random.default_rng(1))
    found = calibrated(sweeps)
    assert found.baseline == pytest.approx(LAYOUT.no_load - sweeps.mean(axis=0))
    assert found.noise == pytest.approx(sweeps.std(axis=0))


def test_the_percentile_is_the_inverted_distribution_of_activations():
    sweeps = noisy(np.random.default_rng(2), sweeps=73, sd=2.0)
    expected = np.quantile(LAYOUT.no_load - sweeps, 0.95, axis=0, method="inverted_cdf")
    assert calibrated(sweeps).percentile == pytest.approx(expected)
    assert calibrated(sweeps, percentile=1.0).percentile == pytest.approx(
        (LAYOUT.no_load - sweeps).max(axis=0)
    )


def test_an_untouched_skin_is_ok(untouched):
    assert np.all(untouched.verdict == Verdict.OK)
    assert untouched.usable.all()


def test_a_quiet_taxel_that_repeats_one_code_is_ok():
    assert np.all(calibrated(np.full((125, N), 240)).verdict == Verdict.OK)


def test_a_noisy_taxel_is_named_and_used():
    sweeps = noisy(np.random.default_rng(3))
    sweeps[:, 5] += np.rint(np.random.default_rng(4).normal(0.0, 3.0, 125))
    found = calibrated(sweeps)
    assert found.verdict[5] == Verdict.NOISY
    assert found.usable[5]


def test_a_pad_in_finer_units_is_judged_by_the_same_pressure():
    fine = replace(
        LAYOUT, triangles=tuple(triangle._replace(shift=0) for triangle in LAYOUT.triangles)
    )
    for layout, verdict in ((LAYOUT, Verdict.NOISY), (fine, Verdict.OK)):
        calibrator = Calibrator(layout)
        for raw in noisy(np.random.default_rng(3), sd=3.0, level=220.0):
            calibrator.add(0, raw.astype(np.uint8), PRESENT)
        assert np.mean(calibrator.finish("abc", TIME).verdict == verdict) > 0.99


@pytest.mark.parametrize("sd", [3.0, 5.0, 8.0])
def test_noise_of_any_size_is_no_touch(sd):
    sweeps = np.rint(200.0 + np.random.default_rng(11).normal(0.0, sd, (100, N)))
    found = calibrated(sweeps)
    assert np.mean(found.verdict == Verdict.NOISY) > 0.99
    assert np.median(found.noise) == pytest.approx(sd, rel=0.05)


@pytest.mark.parametrize(("first", "last"), [(0, 60), (60, 125), (40, 80)])
def test_a_touch_during_calibration_is_named_and_left_out_of_the_baseline(first, last):
    sweeps = noisy(np.random.default_rng(5))
    untouched = 240.0 - sweeps[:, 7].mean()
    sweeps[first:last, 7] -= 30
    found = calibrated(sweeps)
    assert found.verdict[7] == Verdict.TOUCHED
    assert np.count_nonzero(found.verdict) == 1
    assert found.baseline[7] == pytest.approx(untouched, abs=0.6)
    assert found.percentile[7] == pytest.approx(found.baseline[7] + 1.645 * found.noise[7])
    assert found.noise[7] < 1.0


def test_presses_that_come_and_go_in_a_calibration_do_not_raise_the_noise_that_is_known():
    """A quiet pad was taken for one with a unit of noise, and soon afterwards for stuck."""
    before = calibrated(noisy(np.random.default_rng(5)))
    sweeps = noisy(np.random.default_rng(6), sweeps=61)
    for first, last, units in ((6, 27, 4), (33, 61, 7)):
        sweeps[first:last, 7:9] -= units
    found = recalibrated(before, sweeps)
    assert found.verdict[7] == Verdict.TOUCHED
    assert found.noise[7] == before.noise[7]


@pytest.mark.parametrize(
    ("sd", "sweeps"), [(0.4, 25), (0.7, 25), (0.7, 125), (1.5, 50), (1.5, 400)]
)
def test_the_zero_of_a_touched_taxel_is_not_the_lowest_that_its_noise_went(sd, sweeps):
    """In the mean over pads, however few measurements an untouched mean has."""
    rng = np.random.default_rng(21)
    untouched = noisy(rng, sweeps, sd, level=240.0)
    pressed = noisy(rng, sweeps, sd, level=200.0)
    found = calibrated(np.concatenate([untouched, pressed]))
    assert np.all(found.verdict == Verdict.TOUCHED)
    assert abs(np.mean(found.baseline)) < 0.25 * sd


def as_sent(conversions, period_s):
    """Sweeps of conversions [c, N] of 36.9 ms, and their times: each is sent until the next."""
    times_s = np.arange(0.0, len(conversions) * 0.0369, period_s)
    return conversions[(times_s / 0.0369).astype(int)], np.rint(times_s * 1e9).astype(np.int64)


def calibrated_as_sent(conversions, period_s):
    calibrator = Calibrator(LAYOUT)
    sweeps, times_ns = as_sent(conversions, period_s)
    for raw, t_ns in zip(sweeps, times_ns.tolist(), strict=True):
        calibrator.add(0, np.rint(raw).astype(np.uint8), PRESENT, t_ns)
    return calibrator.finish("abc", TIME)


@pytest.mark.parametrize("period_s", [0.01, 0.02, 0.0204, 0.04, 0.2])
def test_noise_is_that_of_measurements_at_any_period(period_s):
    conversions = 220.0 + np.random.default_rng(12).normal(0.0, 1.0, (280, N))
    found = calibrated_as_sent(conversions, period_s)
    assert np.median(found.noise) == pytest.approx(1.04, rel=0.05)
    # What is seen for a short time may be more; that it was sent again makes it no more.
    assert np.median(found.spread / found.noise) == pytest.approx(1.2, abs=0.3)


#: Of a calibration of five seconds.
CONVERSIONS = 136


def telegraph(rng, count, share, dwell, height=12.0):
    """Conversions [count, N] that jump between two levels, after so many of them in the mean."""
    up = np.zeros((count, N), bool)
    up[0] = rng.uniform(size=N) < share
    for now, before in zip(up[1:], up[:-1], strict=True):
        leaves = rng.uniform(size=N) < 1.0 / dwell
        now[:] = np.where(leaves, rng.uniform(size=N) < share, before)
    return 225.0 - height * up + rng.normal(0.0, 0.8, up.shape)


@pytest.mark.parametrize("period_s", [0.02, 0.04])
@pytest.mark.parametrize("dwell", [1, 3])
@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
def test_a_pad_that_jumps_between_levels_is_noisy_and_not_touched(share, dwell, period_s):
    conversions = telegraph(np.random.default_rng(13), 10 * CONVERSIONS, share, dwell)
    found = calibrated_as_sent(conversions[:CONVERSIONS], period_s)
    assert np.mean(np.isin(found.verdict, [Verdict.NOISY, Verdict.TOO_NOISY])) > 0.97
    pipeline = Pipeline(LAYOUT, Processing(), found)
    touched = np.zeros(N, bool)
    for raw, t_ns in zip(*as_sent(conversions[CONVERSIONS:], period_s), strict=True):
        frame = pipeline.step(0, np.rint(raw).astype(np.uint8), PRESENT, int(t_ns))
        touched |= frame.touched
    assert np.mean(touched) < 0.03


def test_noise_that_lasts_has_a_larger_spread():
    short, long = (
        calibrated_as_sent(telegraph(np.random.default_rng(14), CONVERSIONS, 0.5, dwell), 0.04)
        for dwell in (1, 8)
    )
    assert np.median(long.noise) == pytest.approx(np.median(short.noise), rel=0.2)
    assert np.median(long.spread) > 1.5 * np.median(short.spread)


def test_jumps_towards_pressure_count_for_more_than_jumps_away_from_it():
    rng = np.random.default_rng(15)
    rare = np.where(rng.uniform(size=(140, N)) < 0.1, 6.0, 0.0) + rng.normal(0, 0.3, (140, N))
    towards = calibrated_as_sent(225.0 - rare, 0.04)
    away = calibrated_as_sent(225.0 + rare, 0.04)
    assert np.median(towards.noise) == pytest.approx(np.median(away.noise), rel=0.01)
    assert np.median(towards.spread) > 1.5 * np.median(away.spread)


def test_of_thousands_of_equal_pads_none_is_taken_for_much_quieter_than_it_is():
    """A hundred bytes are skewed by chance; that is no noise that jumps away from pressure."""
    rng = np.random.default_rng(23)
    least = [
        calibrated(noisy(rng, sweeps=100, sd=0.9, level=rng.uniform(239.5, 240.5, N))).spread.min()
        for _ in range(-(-10_000 // N))
    ]
    assert min(least) > 0.75 * 0.9


@pytest.mark.parametrize("sweeps", [10, 20, 40, 100, 400])
def test_a_pad_is_seldom_noisier_than_calibrated_however_short_that_was(sweeps):
    """Ten bytes of noise easily scatter by half of it."""
    rng = np.random.default_rng(29)
    n_trials = -(-4000 // N)
    quieter = [
        (found.usable & (found.spread < 2.0)).mean()
        for found in (calibrated(noisy(rng, sweeps=sweeps, sd=2.0)) for _ in range(n_trials))
    ]
    assert np.mean(quieter) < 0.06


def test_taps_that_two_pads_share_are_a_touch_and_those_of_one_pad_are_noise():
    sweeps = noisy(np.random.default_rng(16), sweeps=250)
    taps = np.arange(250) % 60 < 30
    sweeps[np.ix_(taps, [7, 8, 100])] -= 20
    found = calibrated(sweeps)
    assert np.flatnonzero(found.verdict == Verdict.TOUCHED).tolist() == [7, 8]
    assert found.verdict[100] in (Verdict.NOISY, Verdict.TOO_NOISY)


def test_a_calibration_of_any_length_remembers_its_course():
    sweeps = noisy(np.random.default_rng(17), sweeps=3000)
    sweeps[2000:, 7] -= 30
    found = calibrated(sweeps)
    assert np.flatnonzero(found.verdict == Verdict.TOUCHED).tolist() == [7]


def test_a_pad_that_rests_far_from_all_others_was_pressed_all_the_time():
    sweeps = noisy(np.random.default_rng(18))
    sweeps[:, 7] -= 12
    sweeps[:, 8] -= 6
    found = calibrated(sweeps)
    assert np.flatnonzero(found.verdict).tolist() == [7]
    assert found.verdict[7] == Verdict.TOUCHED
    assert found.usable[7]


def test_a_pad_that_rests_where_it_did_was_not_pressed_however_far_the_others_are():
    """They were pressed as their board was zeroed: what presses them now brings them back into the
    scale, and to a vote.
    """
    rng = np.random.default_rng(21)
    others = np.arange(N) != 7
    lifted = noisy(rng)
    lifted[:, others] = 255
    before = calibrated(lifted)
    assert before.verdict[7] == Verdict.OK
    lightly = noisy(rng)
    lightly[:, others] += 11
    assert calibrated(lightly).verdict[7] == Verdict.TOUCHED
    assert recalibrated(before, lightly).verdict[7] == Verdict.OK
    in_doubt = recalibrated(before, lightly, zeroed=np.zeros(N, np.bool_))
    assert in_doubt.verdict[7] == Verdict.TOUCHED
    lightly[:, 7] -= 4
    assert recalibrated(before, lightly).verdict[7] == Verdict.TOUCHED


@pytest.mark.parametrize("seconds", [1.0, 2.0, 5.0])
@pytest.mark.parametrize("period_s", [0.01, 0.02, 0.05])
def test_noise_of_real_skin_is_no_press_however_the_zero_caught_it(seconds, period_s):
    """A board's zero is one reading of each pad: a noisy pad may rest far from all others."""
    for seed in range(3):
        noise = SampledNoise(N // 12, seed)
        zero = noise.at(0)
        calibrator = Calibrator(LAYOUT)
        for t_ns in range(10**9, round((1.0 + seconds) * 1e9), round(period_s * 1e9)):
            raw = np.clip(np.rint(240.0 + noise.at(t_ns) - zero), 0, 255).astype(np.uint8)
            calibrator.add(0, raw, PRESENT, t_ns)
        found = calibrator.finish("abc", TIME)
        rest = zero - np.median(zero)
        assert not (found.verdict == Verdict.TOUCHED).any(), rest[found.verdict == Verdict.TOUCHED]
        # It can tell: pads that are pressed all the time are still named.
    assert rest.max() > PRESSED_UNITS


@pytest.mark.parametrize(
    ("seed", "first", "pad"), [(30, 125, 103), (39, 500, 124), (42, 500, 38), (74, 500, 69)]
)
def test_noise_that_wanders_is_no_press_where_it_is_known(seed, first, pad):
    """A pad that picks up a sine may go up and down once in two seconds."""
    noise = SampledNoise(N // 12, seed)
    zero = noise.at(0)
    sweeps = np.array([240.0 + noise.at(50_000_000 * sweep) - zero for sweep in range(first + 50)])

    def taken(sweeps, known=None):
        calibrator = Calibrator(LAYOUT)
        for sweep, raw in enumerate(np.clip(np.rint(sweeps), 0, 255).astype(np.uint8)):
            calibrator.add(0, raw, PRESENT, 50_000_000 * sweep)
        return calibrator.finish("abc", TIME, known)

    before = taken(sweeps[:100])
    known = Known(before, before.baseline, PRESENT)
    usable = np.flatnonzero(before.usable)
    quiet = usable[np.argmin(before.noise[usable])]
    short = sweeps[first : first + (50 if seed == 42 else 40)]
    # Nothing shows that these two seconds were of the same noise.
    assert taken(short).verdict[pad] == Verdict.TOUCHED
    assert not (taken(short, known).verdict == Verdict.TOUCHED).any()
    # A press is still named, a light one of a quiet pad, too; or the zero from before is kept.
    for units in (5.0, 40.0):
        pressed = short.copy()
        pressed[20:, [quiet, pad]] -= units
        found = taken(pressed, known)
        assert found.verdict[quiet] == Verdict.TOUCHED
        assert found.baseline[pad] == pytest.approx(before.baseline[pad], abs=5.0)


def test_a_noisy_pad_that_was_pressed_all_the_time_is_named():
    conversions = telegraph(np.random.default_rng(20), CONVERSIONS, 0.5, 1)
    conversions[:, 7] -= 60.0
    assert calibrated_as_sent(conversions, 0.04).verdict[7] == Verdict.TOUCHED


def test_noise_beyond_use_has_no_vote():
    sweeps = noisy(np.random.default_rng(19), level=150.0)
    sweeps[:, 7] += np.rint(np.random.default_rng(20).normal(0.0, 25.0, 125))
    found = calibrated(sweeps)
    assert found.verdict[7] == Verdict.TOO_NOISY
    assert not found.usable[7]


@pytest.mark.parametrize("code", [0, 255])
def test_pads_at_an_end_of_the_scale_have_no_vote(code):
    """A chip that fails may leave most pads of a part there."""
    sweeps = noisy(np.random.default_rng(32), sweeps=40)
    stuck = np.arange(N) % 12 < 7
    sweeps[:, stuck] = code
    verdict = calibrated(sweeps).verdict
    assert (verdict[stuck] == Verdict.STUCK).all()
    assert not (verdict == Verdict.TOUCHED).any()
    sweeps[:, 8] -= 30
    assert np.flatnonzero(calibrated(sweeps).verdict == Verdict.TOUCHED).tolist() == [8]


def test_a_rest_so_near_an_end_of_the_scale_that_a_press_is_cut_off_is_named():
    sweeps = noisy(np.random.default_rng(21))
    sweeps[:, 48:60] -= 180.0
    sweeps[:, 60:72] -= 158.0  # noise at the zero of a healthy pad, not a press that is cut off
    calibrator = Calibrator(LAYOUT, range_units=np.full(N, 85.0))
    for raw in sweeps:
        calibrator.add(0, raw.astype(np.uint8), PRESENT)
    found = calibrator.finish("abc", TIME)
    assert np.all(found.verdict[48:60] == Verdict.SATURATES)
    assert found.usable.all()
    assert np.all(np.delete(found.verdict, np.r_[48:60]) == Verdict.OK)


@pytest.mark.parametrize("code", [0, 255])
def test_a_taxel_at_an_end_of_the_scale_is_stuck(code):
    sweeps = noisy(np.random.default_rng(6))
    sweeps[:, 9] = code
    found = calibrated(sweeps)
    assert found.verdict[9] == Verdict.STUCK
    assert not found.usable[9]


def test_a_taxel_that_is_often_at_an_end_of_the_scale_is_out_of_range():
    sweeps = noisy(np.random.default_rng(7))
    sweeps[::5, 9] = 255
    assert calibrated(sweeps).verdict[9] == Verdict.OUT_OF_RANGE


@pytest.mark.parametrize("share", [0.3, 0.4, 0.5])
def test_the_noise_of_a_taxel_that_goes_out_of_range_is_that_between_its_readings(share):
    """A board was zeroed under a press: its pad is at the end of the scale once that is lifted. In
    so few measurements this is not distinguished from noise otherwise.
    """
    rng = np.random.default_rng(7)
    sweeps = noisy(rng, 45, sd=0.8)
    usual = calibrated(sweeps).noise[9]
    lifted = round(45 * (1 - share))
    sweeps[lifted:, 9] = np.minimum(254.5 + rng.normal(0.0, 0.7, 45 - lifted), 255).round()
    found = calibrated(sweeps)
    assert found.verdict[9] == Verdict.OUT_OF_RANGE
    assert 0.3 * usual < found.noise[9] < 3.0 * usual


def test_what_was_never_received_is_absent():
    present = np.ones((125, N), bool)
    present[:, 24:36] = False
    found = calibrated(noisy(np.random.default_rng(8)), present)
    assert np.all(found.verdict[24:36] == Verdict.ABSENT)
    assert np.count_nonzero(found.verdict) == 12
    assert calibration.summary(found, LAYOUT) == {"skin": {"ok": N - 12, "absent": 12}}


@pytest.mark.parametrize("samples", [1, 9])
def test_what_was_hardly_ever_received_is_not_judged_by_that(samples):
    found = calibrated(np.full((samples, N), 240))
    assert np.all(found.verdict == Verdict.TOO_FEW)
    assert not found.usable.any()


def test_a_triangle_that_repeated_itself_until_it_was_no_longer_received_is_not_known():
    """Its chip had stopped answering; without noise, all that it sends later would be damage."""
    sweeps = noisy(np.random.default_rng(8))
    sweeps[:, 24:36] = 239
    present = np.ones((125, N), bool)
    present[20:, 24:36] = False
    found = calibrated(sweeps, present)
    assert np.all(found.verdict[24:36] == Verdict.TOO_FEW)
    assert np.count_nonzero(found.verdict) == 12
    # One in coarse units may repeat itself all the time.
    assert not calibrated(sweeps).verdict.any()


def test_noise_is_not_known_from_a_few_bytes():
    present = np.ones((125, N), bool)
    present[9:, 24:36] = False
    found = calibrated(noisy(np.random.default_rng(8), sd=1.0), present)
    assert np.all(found.verdict[24:36] == Verdict.TOO_FEW)
    assert not found.noise[24:36].any()
    assert found.noise[:24].all()


@pytest.mark.parametrize("sd", [0.0, 0.5, 3.0])
def test_a_pad_of_unknown_noise_is_not_judged_by_what_shows_little_of_it(sd):
    """The few readings of some noisy pads are alike by chance."""
    found = calibrated(noisy(np.random.default_rng(8), sweeps=NOISE_SAMPLES - 1, sd=sd))
    assert (found.verdict == Verdict.TOO_FEW).all()


@pytest.mark.parametrize("samples", [FEWEST_SAMPLES, NOISE_SAMPLES - 1, NOISE_SAMPLES])
def test_a_few_bytes_at_an_end_of_the_scale_do_not_take_a_pad_out_of_use(samples):
    before = calibrated(noisy(np.random.default_rng(8)))
    sweeps = noisy(np.random.default_rng(9), sweeps=samples)
    sweeps[:3, 5] = 255
    found = calibrated(sweeps)
    few = samples < NOISE_SAMPLES
    assert found.verdict[5] == (Verdict.TOO_FEW if few else Verdict.OUT_OF_RANGE)
    kept = going_on(found, Known(before, before.baseline, PRESENT))
    assert kept.usable[5] == few
    assert kept.baseline[5] == (before if few else found).baseline[5]
    assert kept.unchanged[5] == few
    doubted = going_on(found, Known(before, before.baseline, ~PRESENT))
    assert not doubted.usable[5]
    assert not doubted.unchanged.any()


@pytest.mark.parametrize(("sd", "used"), [(0.3, True), (3.0, False)])
def test_a_pad_of_known_noise_is_used_if_its_zero_is_known_well_enough_for_its_threshold(sd, used):
    rng = np.random.default_rng(8)
    before = calibrated(noisy(rng, sd=sd))
    found = recalibrated(before, noisy(rng, sweeps=20, sd=sd), zeroed=~PRESENT)
    assert (found.usable == used).all()
    assert set(found.verdict[~found.usable]) <= {Verdict.TOO_FEW}


def test_every_noisy_pad_is_used_after_the_least_that_a_calibration_takes():
    for seed in range(5):
        rng = np.random.default_rng([8, seed])
        found = calibrated(noisy(rng, sweeps=KNOWN_SAMPLES, sd=4.0))
        assert not (found.verdict == Verdict.TOO_FEW).any()


def recalibrated(before, sweeps, present=None, zeroed=PRESENT, moved=0.0):
    """Calibrated after `before`, whose baselines have moved since."""
    calibrator = Calibrator(LAYOUT)
    present = np.ones(sweeps.shape, bool) if present is None else present
    for raw, here in zip(sweeps, present, strict=True):
        calibrator.add(0, raw.astype(np.uint8), here)
    return calibrator.finish("abc", TIME, Known(before, before.baseline + moved, zeroed))


def test_few_samples_do_not_lower_the_noise_that_is_known():
    """A pad that scatters little for half a second may be as noisy as before."""
    rng = np.random.default_rng(26)
    before = calibrated(noisy(rng, sd=2.0))
    short = recalibrated(before, noisy(rng, sweeps=45, sd=0.5))
    assert np.all(short.spread >= before.spread)
    assert np.all(short.noise >= before.noise)
    assert np.all(short.percentile - short.baseline >= 1.0)
    assert np.abs(short.baseline).max() < 1.5
    # They raise it, and more samples lower it.
    assert np.median(recalibrated(before, noisy(rng, sweeps=45, sd=4.0)).spread) > 4.0
    assert recalibrated(before, noisy(rng, sweeps=60, sd=0.5)).spread.max() < 1.5


def test_a_pad_of_which_too_little_was_received_goes_on_with_what_is_known_of_it():
    rng = np.random.default_rng(27)
    before = calibrated(noisy(rng, sd=3.0))
    present = np.ones((125, N), bool)
    present[20:, 24:36] = False
    present[:, 36:48] = False
    zeroed = PRESENT.copy()
    zeroed[30:42] = False
    found = recalibrated(before, noisy(rng, sd=3.0, level=235.0), present, zeroed, moved=1.5)
    goes_on = np.flatnonzero(before.usable & zeroed & ~present.all(axis=0))
    assert len(goes_on) >= 10
    assert np.flatnonzero(found.unchanged).tolist() == goes_on.tolist()
    assert found.baseline[goes_on] == pytest.approx(before.baseline[goes_on] + 1.5)
    assert found.spread[goes_on] == pytest.approx(before.spread[goes_on])
    assert np.all(found.verdict[goes_on] == before.verdict[goes_on])
    above = (found.percentile - found.baseline)[goes_on]
    assert above == pytest.approx((before.percentile - before.baseline)[goes_on])
    # Where the zero is in doubt, nothing is known.
    assert np.all(found.verdict[30:36] == Verdict.TOO_FEW)
    assert np.all(found.verdict[36:42] == Verdict.ABSENT)
    assert found.baseline[:24] == pytest.approx(np.full(24, 5.0), abs=1.7)
    assert calibration.unchanged(found, LAYOUT) == {"skin": goes_on.tolist()}


def test_a_pad_that_was_refused_before_does_not_go_on():
    rng = np.random.default_rng(28)
    present = np.ones((125, N), bool)
    present[:, 24:36] = False
    before = calibrated(noisy(rng), present)
    found = recalibrated(before, noisy(rng), present)
    assert not found.unchanged.any()
    assert np.all(found.verdict[24:36] == Verdict.ABSENT)


def spoilt(sweeps, share, rng, bits=(4, 5, 6, 7)):
    """Sweeps in which this share of the bytes has one wrong bit, and where."""
    sweeps = sweeps.astype(np.uint8)
    wrong = rng.random(sweeps.shape) < share
    wrong[1:] &= ~wrong[:-1]
    flipped = np.where(wrong, 1 << rng.choice(bits, sweeps.shape), 0)
    return sweeps ^ flipped.astype(np.uint8), wrong


@pytest.mark.parametrize("sd", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("share", [0.0006, 0.0025, 0.0125])
def test_damaged_bytes_are_no_noise(sd, share):
    rng = np.random.default_rng(31)
    sweeps = noisy(rng, sweeps=100, sd=sd, level=210.3)
    received, wrong = spoilt(sweeps, share, rng)
    clean, found = calibrated(sweeps), calibrated(received)
    right = np.abs(found.noise - clean.noise) < 0.1
    assert np.mean(right) > 0.95
    assert np.mean(np.abs(found.spread - clean.spread)[right] < 0.3) > 0.95
    assert np.abs(found.baseline - clean.baseline)[right].max() < 0.2
    assert (found.verdict[right] == clean.verdict[right]).all()
    assert (found.damaged == wrong.any(axis=0))[right].mean() > 0.99
    named = calibration.damaged(found, LAYOUT)
    assert sum(map(len, named.values())) == np.count_nonzero(
        found.damaged & (LAYOUT.pad_kind == PadKind.PRESSURE)
    )


@pytest.mark.parametrize("at", [0, 1, 2, 60, 97, 98, 99])
def test_a_damaged_byte_is_found_wherever_it_is(at):
    sweeps = noisy(np.random.default_rng(32), sweeps=100)
    received = sweeps.copy()
    received[at, 7] -= 128
    found = calibrated(received)
    assert found.noise == pytest.approx(calibrated(sweeps).noise, abs=0.05)
    assert np.flatnonzero(found.damaged).tolist() == [7]
    assert found.verdict[7] == Verdict.OK


def test_damaged_bytes_are_left_out_of_the_course_of_a_calibration_of_any_length():
    rng = np.random.default_rng(33)
    received, wrong = spoilt(noisy(rng, sweeps=3000), 0.003, rng)
    received[1500:, 7] -= 30
    found = calibrated(received)
    assert np.flatnonzero(found.verdict == Verdict.TOUCHED).tolist() == [7]
    assert wrong.any(axis=0).mean() > 0.99
    assert np.median(found.noise) < 0.6


@pytest.mark.parametrize("sd", [0.1, 1.0, 3.0, 8.0])
def test_nothing_of_clean_noise_is_called_damaged(sd):
    sweeps = noisy(np.random.default_rng(34), sweeps=400, sd=sd, level=180.0)
    found = calibrated(sweeps)
    assert not found.damaged.any()
    assert found.noise == pytest.approx(sweeps.std(axis=0))


def test_what_a_single_pad_does_again_and_again_is_its_noise():
    sweeps = noisy(np.random.default_rng(35), sweeps=100)
    sweeps[10::20, 7] -= 20
    found = calibrated(sweeps)
    assert not found.damaged.any()
    assert found.noise[7] == pytest.approx(sweeps[:, 7].std())


def test_nothing_is_called_damaged_of_what_was_forgotten():
    sweeps = noisy(np.random.default_rng(36), sweeps=100)
    calibrator = Calibrator(LAYOUT)
    for number, raw in enumerate(sweeps):
        if number == 50:
            calibrator.forget(np.arange(N // 2))
        received = raw.copy()
        received[[7, N - 1]] -= 64 * (number == 30)
        calibrator.add(0, received.astype(np.uint8), PRESENT)
    found = calibrator.finish("abc", TIME)
    assert np.flatnonzero(found.damaged).tolist() == [N - 1]
    assert found.noise[7] == pytest.approx(sweeps[50:, 7].std())


def test_lost_sweeps_do_not_shift_the_baseline():
    sweeps = noisy(np.random.default_rng(9))
    present = np.random.default_rng(10).uniform(size=(125, N)) > 0.3
    raw = np.where(present, sweeps, 0)
    expected = np.array([240.0 - sweeps[present[:, i], i].mean() for i in range(N)])
    assert calibrated(raw, present).baseline == pytest.approx(expected)


def slowly_pressed(rise, sd, sweeps=125, seed=12):
    """Sweeps in which all pads but the first 20 rise slowly together."""
    raw = noisy(np.random.default_rng(seed), sweeps, sd)
    raw[:, 20:] -= np.rint(np.linspace(0.0, rise, sweeps)[:, np.newaxis])
    return raw


@pytest.mark.parametrize("sweeps", [80, 125, 250])
def test_a_slow_press_of_a_whole_part_is_a_touch_though_noise_hides_it_on_each_pad(sweeps):
    found = calibrated(slowly_pressed(2.0, 1.2, sweeps))
    pressure = LAYOUT.pad_kind == PadKind.PRESSURE
    touched = found.verdict == Verdict.TOUCHED
    assert touched[20:][pressure[20:]].mean() > 0.9
    assert touched[:20].mean() < 0.2


def test_pads_beside_a_press_that_ends_during_a_calibration_were_not_touched():
    """The pressed ones move the mean of the part, which the noise of some follows by chance."""
    pressed = np.arange(N) < N // 2
    for seed in range(10):
        raw = noisy(np.random.default_rng(seed), sweeps=100, sd=0.8)
        raw[80:] += 8.0 * pressed
        touched = calibrated(np.minimum(raw, 255)).verdict == Verdict.TOUCHED
        pressure = LAYOUT.pad_kind == PadKind.PRESSURE
        assert touched[pressed & pressure].all()
        assert not touched[~pressed].any()


def test_pads_at_rest_do_not_move_like_the_one_beside_them_that_was_touched_for_a_moment():
    """All others of the part are pressed for long, which is no evidence about these four."""
    pressure = np.flatnonzero(LAYOUT.pad_kind == PadKind.PRESSURE)
    resting, tapped, pressed = pressure[:3], pressure[3], pressure[4:]
    for seed in range(40):
        raw = noisy(np.random.default_rng(seed), sweeps=100, sd=0.5)
        raw[:60, pressed] -= 10.0
        raw[:5, tapped] -= 12.0
        found = calibrated(raw)
        assert (found.verdict[pressed] == Verdict.TOUCHED).all()
        assert not (found.verdict[resting] == Verdict.TOUCHED).any()


@pytest.mark.parametrize("sd", [0.4, 1.2, 3.0])
def test_what_drifts_less_than_a_touch_while_it_is_calibrated_is_no_touch(sd):
    for seed in range(5):
        found = calibrated(slowly_pressed(0.5, sd, seed=seed))
        assert not (found.verdict == Verdict.TOUCHED).any()


def test_a_drift_that_is_followed_is_no_touch_in_a_long_calibration():
    calibrator = Calibrator(LAYOUT)
    for number, raw in enumerate(slowly_pressed(1.8, 1.2, 600)):
        calibrator.add(0, np.asarray(raw, np.uint8), PRESENT, number * 50_000_000)
    assert not (calibrator.finish("abc", TIME).verdict == Verdict.TOUCHED).any()


def warmed(rate, seconds, sd, press=None, seed=3, period_s=0.05):
    """A calibration of a part that becomes warmer or colder by `rate` units a second, each pad by
    up to a fifth more or less, and the activations of its pads at the end.

    `press(t)` is subtracted from the readings at time t.
    """
    rng = np.random.default_rng(seed)
    rates = rate * rng.uniform(0.8, 1.2, N)
    rest = rng.uniform(225.0, 235.0, N)
    calibrator = Calibrator(LAYOUT)
    for number in range(round(seconds / period_s)):
        t_s = number * period_s
        reads = rest - rates * t_s + rng.normal(0.0, sd, N)
        reads = reads - (0.0 if press is None else press(t_s))
        raw = np.clip(np.rint(reads), 0, 255).astype(np.uint8)
        calibrator.add(0, raw, PRESENT, round(t_s * 1e9))
    return calibrator.finish("abc", TIME), 240.0 - rest + rates * seconds


PRESSURE = LAYOUT.pad_kind == PadKind.PRESSURE


@pytest.mark.parametrize("sd", [0.4, 1.2])
@pytest.mark.parametrize(
    ("rate", "seconds"), [(0.04, 60), (-0.04, 60), (0.01, 300), (0.09, 120), (-0.09, 120)]
)
def test_a_part_that_becomes_warm_while_it_is_calibrated_has_the_zeros_and_noise_of_the_end(
    rate, seconds, sd
):
    """All of its pads were called touched, and were so ever after where it became warmer."""
    found, at_end = warmed(rate, seconds, sd)
    assert (found.verdict[PRESSURE] == Verdict.OK).all()
    assert np.abs(found.baseline - at_end)[PRESSURE].max() < 0.5
    steady, _ = warmed(0.0, seconds, sd)
    assert found.noise[PRESSURE] == pytest.approx(steady.noise[PRESSURE], abs=0.25)
    more = (found.spread - steady.spread)[PRESSURE]
    assert more.min() > -0.3
    assert more.max() < 1.0


def test_slow_boards_that_become_warm_are_calibrated_alike():
    found, at_end = warmed(0.04, 60, 0.4, period_s=0.2)
    assert (found.verdict[PRESSURE] == Verdict.OK).all()
    assert np.abs(found.baseline - at_end)[PRESSURE].max() < 0.5


def test_pads_that_are_touched_while_their_part_becomes_warm_are_named():
    pressed = np.flatnonzero(PRESSURE)[:5]

    def press(t_s):
        return np.where(np.isin(np.arange(N), pressed), 12.0 * (t_s < 20.0), 0.0)

    found, at_end = warmed(0.04, 60, 0.4, press)
    assert (found.verdict[pressed] == Verdict.TOUCHED).all()
    others = np.setdiff1d(np.flatnonzero(PRESSURE), pressed)
    assert (found.verdict[others] == Verdict.OK).all()
    assert np.abs(found.baseline - at_end)[others].max() < 0.5
    assert np.abs(found.baseline - at_end)[pressed].max() < 2.5


@pytest.mark.parametrize("rise_s", [0.5, 5.0, 20.0])
def test_a_press_of_the_whole_part_is_no_warmth_however_long_the_calibration(rise_s):
    found, _ = warmed(0.0, 120, 0.4, lambda t_s: np.clip((t_s - 50.0) / rise_s, 0.0, 1.0) * 12.0)
    assert (found.verdict[PRESSURE] == Verdict.TOUCHED).all()


@pytest.mark.parametrize("gap_s", [0.0, 3600.0])
def test_a_computer_that_slept_during_a_calibration_makes_no_press_slow(gap_s):
    calibrator = Calibrator(LAYOUT)
    for number, raw in enumerate(slowly_pressed(2.0, 1.2, 250)):
        t_ns = number * 20_000_000 + (number > 60) * round(gap_s * 1e9)
        calibrator.add(0, np.asarray(raw, np.uint8), PRESENT, t_ns)
    touched = calibrator.finish("abc", TIME).verdict == Verdict.TOUCHED
    assert touched[20:][PRESSURE[20:]].mean() > 0.9


def test_dead_pads_do_not_hide_that_the_others_become_warm():
    dead = np.flatnonzero(PRESSURE)[::3]
    calibrator = Calibrator(LAYOUT)
    rng = np.random.default_rng(6)
    for number in range(1200):
        raw = np.rint(230.0 - 0.002 * number + rng.normal(0.0, 0.4, N))
        raw[dead] = 180.0
        calibrator.add(0, raw.astype(np.uint8), PRESENT, number * 50_000_000)
    found = calibrator.finish("abc", TIME)
    lively = np.setdiff1d(np.flatnonzero(PRESSURE), dead)
    assert not (found.verdict[lively] == Verdict.TOUCHED).any()
    assert np.abs(found.baseline[lively] - 12.4).max() < 0.3
    assert found.baseline[dead] == pytest.approx(60.0)


def test_what_a_part_did_before_its_board_was_zeroed_makes_no_press_slow():
    calibrator = Calibrator(LAYOUT)
    for number in range(1200):
        calibrator.add(0, np.full(N, 230, np.uint8), PRESENT, number * 50_000_000)
    calibrator.forget(np.arange(N))
    for number, raw in enumerate(slowly_pressed(2.0, 1.2, 250), 1200):
        t_ns = 1200 * 50_000_000 + (number - 1200) * 20_000_000
        calibrator.add(0, np.asarray(raw, np.uint8), PRESENT, t_ns)
    touched = calibrator.finish("abc", TIME).verdict == Verdict.TOUCHED
    assert touched[20:][PRESSURE[20:]].mean() > 0.9
