"""What repeats itself beyond chance is no sensor; what is merely quiet is one."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from skin_host.bus.compensation import GAIN, NO_GAIN, THERMAL_TAXEL
from skin_host.processing.liveness import CONVERSION_S, Liveness, change_rate
from skin_host.processing.masks import Mask
from skin_host.processing.stuck import Encoding, Repeats, longest_run

K = 4
HERE = np.ones(K, bool)
NO = np.zeros(K, bool)
PERIOD_S = 0.05


def noisy_bytes(rng: np.random.Generator, sigma: float, centre: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(centre + sigma * rng.standard_normal((K, 12))), 0, 255).astype(np.uint8)


def rest(liveness: Liveness, sweeps: int) -> None:
    for _ in range(sweeps):
        liveness.step(np.full((K, 12), 240, np.uint8), HERE, NO)


def calibrated(rng: np.random.Generator, sigma: float, centre: np.ndarray) -> Liveness:
    seen = np.array([noisy_bytes(rng, sigma, centre) for _ in range(100)])
    return Liveness(K, seen.std(axis=0), PERIOD_S)


@given(st.floats(0.05, 3.0), st.floats(0.0, 1.0))
@settings(max_examples=50, deadline=None)
def test_the_rate_of_changes_follows_from_the_noise(sigma: float, phase: float) -> None:
    rng = np.random.default_rng(1)
    values = np.rint(100 + phase + sigma * rng.standard_normal(4000))
    seen = np.mean(np.diff(values) != 0)
    assert change_rate(np.array([values.std()]))[0] == pytest.approx(seen, abs=0.12)


@pytest.mark.parametrize("sigma", [0.08, 0.15, 0.3, 0.8, 2.0])
def test_a_quiet_healthy_triangle_is_not_accused(sigma: float) -> None:
    rng = np.random.default_rng(3)
    centre = 240 + rng.uniform(-0.5, 0.5, (K, 12))
    liveness = calibrated(rng, sigma, centre)
    for _ in range(4000):
        liveness.step(noisy_bytes(rng, sigma, centre), HERE, NO)
        assert not liveness.frozen.any()
        assert not liveness.stuck.any()
        assert not liveness.noisy.any()


def test_a_triangle_that_drifts_to_the_quiet_middle_of_its_bytes_is_not_accused() -> None:
    rng = np.random.default_rng(3)
    sigma = 0.15
    liveness = calibrated(rng, sigma, np.full((K, 12), 240.5))
    for centre in np.concatenate([np.linspace(240.5, 241.0, 6000), np.full(3000, 241.0)]):
        liveness.step(noisy_bytes(rng, sigma, np.full((K, 12), centre)), HERE, NO)
        assert not liveness.frozen.any()


def test_a_board_that_sends_more_seldom_than_another_is_followed_as_well() -> None:
    """Two boards; the second, of every third turn, drifts to the quiet middle of its bytes."""
    rng = np.random.default_rng(3)
    sigma = 0.15
    noise = np.full((K, 12), 0.55)
    liveness = Liveness(K, noise, np.array([PERIOD_S, 3 * PERIOD_S]), boards=2)
    for turn, centre in enumerate(
        np.concatenate([np.linspace(240.5, 241.0, 2400), np.full(1200, 241.0)])
    ):
        came = np.array([True, turn % 3 == 0])
        centres = np.where(np.arange(K) < K // 2, 240.5, centre)[:, None] * np.ones(12)
        here = np.repeat(came, K // 2)
        liveness.step(noisy_bytes(rng, sigma, centres), here, NO, came=came)
        assert not liveness.frozen.any(), turn


@pytest.mark.parametrize("value", [240, 17, 254])
def test_a_triangle_that_stops_is_found_within_0_7_s(value: int) -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.8, centre)
    for _ in range(40):
        liveness.step(noisy_bytes(rng, 0.8, centre), HERE, NO)
    for _ in range(round(0.7 / PERIOD_S)):
        raw = noisy_bytes(rng, 0.8, centre)
        raw[2] = value
        liveness.step(raw, HERE, NO)
    assert liveness.frozen.tolist() == [False, False, True, False]
    assert liveness.doubted is not None
    assert liveness.doubted.all(axis=1).tolist() == [False, False, True, False]


@pytest.mark.parametrize("here", [HERE, np.array([True, True, True, False])])
@pytest.mark.parametrize("sigma", [0.21, 0.25, 0.8])
def test_a_triangle_is_frozen_by_the_first_repeat_beyond_what_chance_allows(
    sigma: float, here: np.ndarray
) -> None:
    """Of which the calibration knows as much as from five seconds."""
    rng = np.random.default_rng(3)
    liveness = Liveness(K, np.full((K, 12), sigma), PERIOD_S)
    changes = min(1.0 - (1.0 - 2.0 * sigma**2) ** 12, 0.9) if sigma < 0.5 else 0.9
    (allowed,) = longest_run(np.array([changes]), 5.0 / PERIOD_S, 1e9)
    raw = noisy_bytes(rng, 3.0, np.full((K, 12), 200.0))
    # The last triangle does not change together with the others.
    liveness.step(raw + np.array([[1], [1], [1], [0]], np.uint8), here, NO)
    liveness.step(raw, here, NO)
    for repeats in range(1, int(allowed) + 2):
        liveness.step(raw, here, NO)
        assert liveness.frozen[:3].tolist() == [repeats > allowed] * 3


def test_a_triangle_at_the_end_of_its_scale_is_pressed_not_dead() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.8, centre)
    for _ in range(600):
        raw = noisy_bytes(rng, 0.8, centre)
        raw[1] = 0
        liveness.step(raw, HERE, NO)
    assert not liveness.frozen.any()


def test_a_board_that_sends_faster_than_its_chips_convert_repeats_itself_rightly() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    period_s = CONVERSION_S / 4
    liveness = Liveness(K, np.full((K, 12), 0.8), period_s)
    for _ in range(500):
        raw = noisy_bytes(rng, 0.8, centre)
        for _ in range(4):
            liveness.step(raw, HERE, NO)
            assert not liveness.frozen.any()
            assert not liveness.stuck.any()


def test_what_had_an_error_must_show_that_it_lives() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.8, centre)
    erring = np.array([True, False, False, False])
    constant = np.full((K, 12), 240, np.uint8)
    liveness.step(constant, ~erring, erring)
    for _ in range(100):
        raw = noisy_bytes(rng, 0.8, centre)
        raw[0] = 240
        liveness.step(raw, HERE, NO)
        assert liveness.unproven[0]
    for _ in range(6):
        liveness.step(noisy_bytes(rng, 0.8, centre), HERE, NO)
    assert not liveness.unproven.any()


def test_a_touch_is_no_noise_and_a_bad_solder_joint_is() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.8, centre)
    for k in range(200):
        pressed = centre.copy()
        pressed[0] -= 100 * (k // 8 % 2)  # tapped 1.25 times a second
        raw = noisy_bytes(rng, 0.8, pressed)
        raw[3, 0] = np.clip(240 + 8 * rng.standard_normal(), 0, 255)
        liveness.step(raw, HERE, NO)
        assert not liveness.noisy[:3].any()
    assert np.argwhere(liveness.noisy).tolist() == [[3, 0]]
    assert liveness.doubted is not None
    assert np.argwhere(liveness.doubted).tolist() == [[3, 0]]


def test_one_stuck_pad_is_not_valid_and_its_triangle_is() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.8, centre)
    for _ in range(100):
        raw = noisy_bytes(rng, 0.8, centre)
        raw[2, 7] = 239
        liveness.step(raw, HERE, NO)
    assert np.argwhere(liveness.stuck).tolist() == [[2, 7]]
    assert liveness.doubted is not None
    assert np.argwhere(liveness.doubted).tolist() == [[2, 7]]
    assert not liveness.unproven.any()


@pytest.mark.parametrize(
    ("stuck", "constant", "halted"), [(6, 0, False), (7, 0, True), (4, 5, True)]
)
def test_where_most_pads_of_a_chip_are_stuck_none_of_it_is_valid_until_they_move(
    stuck: int, constant: int, halted: bool
) -> None:
    """Those that were constant when calibrated cannot be called stuck, and do not count."""
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    alive = (np.arange(12) < 12 - constant)[None]

    def sweep() -> np.ndarray:
        return np.where(alive, noisy_bytes(rng, 0.8, centre), np.uint8(240))

    liveness = Liveness(K, np.array([sweep() for _ in range(100)]).std(axis=0), PERIOD_S)
    for _ in range(160):
        raw = sweep()
        raw[2, :stuck] = 239
        liveness.step(raw, HERE, NO)
    liveness.catch_up()
    after = Liveness(K, np.full((K, 12), 0.8), PERIOD_S)
    after.keep(liveness, np.ones(1, np.bool_))
    for one in (liveness, after):
        assert one.halted.tolist() == [False, False, halted, False]
        assert one.stuck[2].sum() == stuck
        assert one.doubted is not None and one.lifeless is not None
        assert one.doubted[2].all() == halted and not one.doubted[[0, 1, 3]].any()
        assert one.lifeless[2].all() == halted
    # Stuck pads are left out of a calibration, which makes no other of the chip valid.
    left_out = np.where((np.arange(12) < stuck) & (np.arange(K) == 2)[:, None], np.nan, 0.8)
    calibrated_since = Liveness(K, np.where(alive, left_out, 0.0), PERIOD_S)
    calibrated_since.keep(liveness, np.zeros(1, np.bool_))
    assert calibrated_since.halted.tolist() == [False, False, halted, False]
    for _ in range(30):
        liveness.step(sweep(), HERE, NO)
    liveness.catch_up()
    assert liveness.doubted is None and not liveness.halted.any()


def test_a_held_hand_is_given_more_time() -> None:
    """The bytes of an iCub's fingertips repeat for 19 sweeps while its hand holds something."""
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.8, centre)
    elsewhere = np.zeros((K, 12), bool)
    elsewhere[1:3, 0] = True
    raw = noisy_bytes(rng, 0.8, centre)
    for _ in range(19):
        moving = noisy_bytes(rng, 0.8, centre)
        moving[0] = raw[0]
        liveness.step(moving, HERE, NO, elsewhere)
        assert not liveness.frozen.any()


def test_repeats_count_for_less_on_the_board_that_is_touched_now_not_on_one_that_was() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = Liveness(K, np.full((K, 12), 0.8), PERIOD_S, boards=2)
    before, now = np.zeros((2, K, 12), np.bool_)
    before[1, 0] = now[3, 0] = True
    for _ in range(30):
        raw = noisy_bytes(rng, 0.8, centre)
        liveness.step(raw, HERE, NO, before)
    for _ in range(19):
        liveness.step(raw, HERE, NO, now)
    # The touch on triangle 3 may be its own.
    assert liveness.frozen.tolist() == [True, True, False, True]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_any_bytes_at_all_are_survived(seed: int) -> None:
    rng = np.random.default_rng(seed)
    liveness = Liveness(K, rng.choice([0.0, 0.3, 90.0], (K, 12)), PERIOD_S)
    for _ in range(60):
        raw = rng.integers(0, 256, (K, 12)).astype(np.uint8)
        liveness.step(raw, rng.random(K) < 0.8, rng.random(K) < 0.1)
        assert liveness.doubted is None or liveness.doubted.shape == (K, 12)
    assert np.isfinite(liveness._rate).all()
    assert np.isfinite(liveness._pads.longest).all()


def test_the_last_pad_that_can_move_is_given_its_own_time_though_another_board_is_touched() -> None:
    """A pad that changes in a quarter of all sweeps may rest for some 70 of them."""
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.0)
    liveness = Liveness(K, np.full((K, 12), 0.4), PERIOD_S, boards=2)
    touched = np.zeros((K, 12), bool)
    touched[0, 0] = True
    for _ in range(1000):
        liveness.step(noisy_bytes(rng, 0.4, centre), HERE, NO, touched)
    frozen_after = None
    for sweep in range(100):
        raw = noisy_bytes(rng, 0.4, centre)
        raw[3] = [240] + [0] * 11
        liveness.step(raw, HERE, NO, touched)
        if frozen_after is None and liveness.frozen[3]:
            frozen_after = sweep
    assert frozen_after is not None
    assert 35 < frozen_after < 100


@pytest.mark.parametrize("every", [8, 10, 15])
def test_one_pad_that_jumps_now_and_then_is_not_taken_for_errors_of_the_bus(every: int) -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.4, centre)
    for number in range(200):
        raw = noisy_bytes(rng, 0.4, centre)
        raw[1, 4] -= 40 * (number % every == 0)
        liveness.step(raw, HERE, NO)
    assert liveness.spikes.sum() <= 1 + 200 * PERIOD_S / 1.0 / 2


@pytest.mark.parametrize("gap", [False, True])
def test_a_press_before_a_gap_and_its_end_after_it_are_no_spike(gap: bool) -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.4, centre)
    pressed = noisy_bytes(rng, 0.4, centre)
    pressed[1, 4] -= 40
    for raw in (noisy_bytes(rng, 0.4, centre), pressed, noisy_bytes(rng, 0.4, centre)):
        if gap and raw is not pressed:
            liveness.note_gap(0)
        liveness.step(raw, HERE, NO)
    rest(liveness, 30)
    assert liveness.spikes.sum() == (0 if gap else 1)


@pytest.mark.parametrize("missed", [1, 5, 6, 100])
def test_a_press_that_began_in_a_gap_and_ends_after_its_first_sweep_is_no_spike(
    missed: int,
) -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.4, centre)
    pressed = noisy_bytes(rng, 0.4, centre)
    pressed[1, 4] -= 40
    liveness.step(noisy_bytes(rng, 0.4, centre), HERE, NO)
    liveness.note_gap(0, missed)
    liveness.step(pressed, HERE, NO)
    rest(liveness, 30)
    assert not liveness.spikes.any()


def test_six_extremes_of_the_noise_of_a_working_pad_are_chance() -> None:
    """A pad of 0.8 units brings them once in some 10^9 measurements."""
    liveness = Liveness(K, np.full((K, 12), 0.78), PERIOD_S)
    for byte in (242, 243, 239, 243, 239, 244, 240, 241):
        raw = np.full((K, 12), 241, np.uint8)
        raw[1, 4] = byte
        liveness.step(raw, HERE, NO)
        assert not liveness.noisy.any()


@pytest.mark.parametrize("period_s", [0.0125, 0.0204, PERIOD_S])
def test_a_pad_is_noisy_beyond_its_noise_under_pressure_where_that_was_measured(
    period_s: float,
) -> None:
    """Pads of real skin jump by some units when they are pressed, and not when they rest."""
    pressed = np.full((K, 12), np.nan)
    pressed[:, :6] = 3.0
    liveness = Liveness(K, np.full((K, 12), 0.4), period_s, pressed_units=pressed)
    rng = np.random.default_rng(5)
    raw, conversions = np.zeros((K, 12), np.uint8), -1
    for sweep in range(round(3.0 / period_s)):
        if int(sweep * period_s / CONVERSION_S) != conversions:
            conversions = int(sweep * period_s / CONVERSION_S)
            raw = noisy_bytes(rng, 0.4, np.full((K, 12), 200.0))
            low = ((conversions + np.arange(12)) % 2).astype(np.uint8)
            raw[0] -= 12 * low
            raw[1] -= 40 * low
        liveness.step(raw, HERE, NO)
    assert not liveness.noisy[2:].any()
    assert liveness.noisy[0].tolist() == [False] * 6 + [True] * 6
    assert liveness.noisy[1].all()


@pytest.mark.parametrize(("units", "spikes"), [(5, 0), (7, 0), (8, 1), (200, 1)])
def test_one_sweep_off_by_more_than_seven_units_and_back_is_a_spike(
    units: int, spikes: int
) -> None:
    liveness = Liveness(K, np.full((K, 12), 0.4), PERIOD_S)
    for off in (0, units, 0, 0):
        raw = np.full((K, 12), 240, np.uint8)
        raw[1, 4] -= off
        liveness.step(raw, HERE, NO)
    rest(liveness, 30)
    assert liveness.spikes.sum() == spikes
    assert liveness.spikes[1, 4] == spikes


@pytest.mark.parametrize(("first", "last"), [(0, 60), (10, 11), (15, 17)])
def test_a_byte_that_is_off_in_a_touched_triangle_is_no_damage(first: int, last: int) -> None:
    """Pads of real skin jump under pressure, and some are felt by others of their triangle only."""
    liveness = Liveness(K, np.full((K, 12), 0.4), PERIOD_S)
    touched = np.zeros((K, 12), np.bool_)
    touched[1, 7] = True
    for number in range(60):
        raw = np.full((K, 12), 240, np.uint8)
        if number == 10:
            raw[1, 4] = raw[2, 4] = 228
        liveness.step(raw, HERE, NO, touched if first <= number <= last else None)
    assert np.argwhere(liveness.spikes).tolist() == [[2, 4]]


@pytest.mark.parametrize("again", [2, 5, 20])
def test_a_byte_that_is_off_and_off_again_is_a_fault_of_its_pad_from_the_first(again: int) -> None:
    """Pads that become noisy, or are another chip's, all at once: none of them harms a frame."""
    liveness = Liveness(K, np.full((K, 12), 0.4), PERIOD_S)
    for number in range(60):
        raw = np.full((K, 12), 240, np.uint8)
        for pad in range(4):
            if number in {10 + pad, 10 + pad + again}:
                raw[pad, 4] -= 12
        liveness.step(raw, HERE, NO)
        assert not liveness.spikes.any()


def test_bytes_of_other_pads_that_are_off_are_each_counted_once() -> None:
    liveness = Liveness(K, np.full((K, 12), 0.4), PERIOD_S)
    for number in range(60):
        raw = np.full((K, 12), 240, np.uint8)
        if 10 <= number < 18:
            raw[number % 4, number % 12] -= 12
        liveness.step(raw, HERE, NO)
    assert liveness.spikes.sum() == np.count_nonzero(liveness.spikes) == 8


@pytest.mark.parametrize("gain", [GAIN, NO_GAIN])
def test_pads_of_which_a_noisy_temperature_pad_is_taken_off_are_in_doubt_with_it(
    gain: tuple[int, ...],
) -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    repeats = Repeats([Encoding(gain, 2, 240, truncates=False)] * K)
    liveness = Liveness(K, np.full((K, 12), 0.6), PERIOD_S, repeats)
    for _ in range(60):
        raw = noisy_bytes(rng, 0.5, centre)
        raw[2, THERMAL_TAXEL] = np.clip(240 + 8 * rng.standard_normal(), 0, 255)
        liveness.step(raw, HERE, NO)
    assert np.argwhere(liveness.noisy).tolist() == [[2, THERMAL_TAXEL]]
    assert liveness.doubted is not None
    expected = np.zeros((K, 12), np.bool_)
    expected[2] = np.array(gain) > 0
    expected[2, THERMAL_TAXEL] = True
    assert liveness.doubted.tolist() == expected.tolist()
    for _ in range(40):
        liveness.step(noisy_bytes(rng, 0.5, centre), HERE, NO)
    assert liveness.doubted is None


def test_what_was_frozen_is_so_after_a_new_calibration_of_its_board_or_another() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)

    def new() -> Liveness:
        return Liveness(K, np.full((K, 12), 0.8), PERIOD_S, boards=2)

    before = new()
    dead = np.array([True, False, False, True])
    for _ in range(40):
        raw = noisy_bytes(rng, 0.8, centre)
        raw[dead] = 240
        before.step(raw, HERE, NO)
    assert before.frozen.tolist() == dead.tolist()
    after = new()
    after.keep(before, np.array([False, True]))
    # A calibration does not show that a triangle lives: it may go on with what was known of it.
    assert after.frozen.tolist() == dead.tolist()
    assert after.doubted is not None
    assert after.doubted.all(axis=1).tolist() == dead.tolist()
    for _ in range(6):
        after.step(noisy_bytes(rng, 0.8, centre), HERE, NO)
    assert after.doubted is None


def test_a_gap_of_one_board_hides_no_spike_of_another() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = Liveness(K, np.full((K, 12), 0.4), PERIOD_S, boards=2)
    for row in (1, 2):
        pressed = noisy_bytes(rng, 0.4, centre)
        pressed[row, 4] -= 40
        for raw in (noisy_bytes(rng, 0.4, centre), pressed, noisy_bytes(rng, 0.4, centre)):
            liveness.note_gap(0)
            liveness.step(raw, HERE, NO)
    rest(liveness, 30)
    assert np.argwhere(liveness.spikes).tolist() == [[2, 4]]


@pytest.mark.parametrize(("missed", "spikes"), [(1, 1), (200, 0)])
def test_a_byte_that_was_off_before_a_long_silence_is_not_counted_after_it(
    missed: int, spikes: int
) -> None:
    """It takes 25 sweeps to know that the pad does not jump. What was damaged then is over now."""
    liveness = Liveness(K, np.full((K, 12), 0.4), PERIOD_S)
    for number in range(60):
        raw = np.full((K, 12), 240, np.uint8)
        raw[1, 4] -= 12 * (number == 10)
        if number == 20:
            assert not liveness.spikes.any()
            liveness.note_gap(0, missed)
        liveness.step(raw, HERE, NO)
    assert liveness.spikes.sum() == spikes


@pytest.mark.parametrize("missed", [1, 5])
def test_a_board_that_sends_more_seldom_than_it_was_set_up_to_is_judged_as_any_other(
    missed: int,
) -> None:
    """Each of its sweeps follows a gap. A live chip is valid; a dead one, or stuck pad, is not."""
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = Liveness(K, np.full((K, 12), 0.8), PERIOD_S)
    for _ in range(400):
        liveness.note_gap(0, missed)
        raw = noisy_bytes(rng, 0.8, centre)
        raw[1], raw[2, 4] = 240, 240
        liveness.step(raw, HERE, NO)
    assert liveness.unproven.tolist() == [False, True, False, False]
    assert liveness.frozen.tolist() == [False, True, False, False]
    assert np.argwhere(liveness.stuck).tolist() == [[2, 4]]
    assert not liveness.noisy.any()


def test_presses_of_a_board_that_sends_seldom_are_neither_noise_nor_spikes() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.4, centre)
    for number in range(400):
        liveness.note_gap(0, 1)
        raw = noisy_bytes(rng, 0.4, centre)
        raw[1, 4] -= 40 * (number % 2)
        liveness.step(raw, HERE, NO)
        assert not liveness.noisy.any()
    assert not liveness.spikes.any()


ONE = np.arange(K) == 1


def without_one(liveness: Liveness, raw: np.ndarray, erring: bool = False) -> None:
    """Take a sweep without the second triangle, whose status has an error or did not come."""
    liveness.step(np.where(ONE[:, None], 0, raw).astype(np.uint8), ~ONE, ONE & erring)


@pytest.mark.parametrize("every", [2, 3, 6])
def test_a_triangle_that_is_lost_in_most_sweeps_shows_that_it_lives(every: int) -> None:
    rng = np.random.default_rng(11)
    centre = np.full((K, 12), 240.0)
    liveness = calibrated(rng, 0.8, centre)
    for sweep in range(4 * every):
        raw = noisy_bytes(rng, 0.8, centre)
        if sweep % every:
            without_one(liveness, raw)
        else:
            liveness.step(raw, HERE, NO)
    assert not liveness.unproven.any()


@pytest.mark.parametrize("every", [1, 2, 3, 6])
def test_a_triangle_that_dies_is_found_by_as_many_sweeps_if_others_are_lost(every: int) -> None:
    rng = np.random.default_rng(12)
    centre = np.full((K, 12), 240.0)
    liveness = calibrated(rng, 0.8, centre)
    for _ in range(10):
        liveness.step(noisy_bytes(rng, 0.8, centre), HERE, NO)
    for sweep in range(12 * every):
        raw = noisy_bytes(rng, 0.8, centre)
        raw[ONE] = 240
        if sweep % every:
            without_one(liveness, raw)
        else:
            liveness.step(raw, HERE, NO)
    assert liveness.frozen.tolist() == ONE.tolist()


@pytest.mark.parametrize(("lost", "erring"), [(6, False), (1, True)])
def test_bytes_before_many_lost_sweeps_or_an_error_are_not_compared(
    lost: int, erring: bool
) -> None:
    """The chip may have restarted."""
    liveness = Liveness(K, None, PERIOD_S)
    for value in (240, 239, 238):
        liveness.step(np.full((K, 12), value, np.uint8), HERE, NO)
        for _ in range(lost):
            without_one(liveness, np.full((K, 12), value, np.uint8), erring)
    assert liveness.unproven.tolist() == ONE.tolist()


def test_lost_sweeps_of_a_triangle_and_of_its_board_count_together() -> None:
    liveness = Liveness(K, None, PERIOD_S)
    for value in (240, 239, 238):
        liveness.step(np.full((K, 12), value, np.uint8), HERE, NO)
        for _ in range(3):
            without_one(liveness, np.full((K, 12), value, np.uint8))
        liveness.note_gap(0, 3)
    assert liveness.unproven.tolist() == ONE.tolist()


def test_presses_between_lost_sweeps_of_a_triangle_are_no_jumps() -> None:
    """Pressed in every other of the sweeps that came, as by 5 Hz."""
    rng = np.random.default_rng(13)
    centre = np.full((K, 12), 240.0)
    liveness = calibrated(rng, 0.5, centre)
    for sweep in range(100):
        raw = noisy_bytes(rng, 0.5, centre)
        raw[ONE] -= np.uint8(30 * (sweep % 4 == 0))
        if sweep % 2:
            without_one(liveness, raw)
        else:
            liveness.step(raw, HERE, NO)
        assert not liveness.noisy.any()
    assert not liveness.spikes.any()


def test_another_byte_after_a_long_silence_shows_no_life() -> None:
    """The board may have restarted meanwhile, and has another zero."""
    liveness = Liveness(K, np.full((K, 12), 0.8), PERIOD_S)
    for number in range(4):
        liveness.note_gap(0, 6)
        rest(liveness, 1)
        raw = np.full((K, 12), 230 + number, np.uint8)
        liveness.note_gap(0, 6)
        liveness.step(raw, HERE, NO)
    assert liveness.unproven.all()


@pytest.mark.parametrize(("lost_of_7", "spikes"), [(0, 1), (1, 1), (5, 0)])
def test_a_byte_that_was_off_is_not_counted_long_after_it_where_most_sweeps_are_lost(
    lost_of_7: int, spikes: int
) -> None:
    """Of sweeps that come one by one none can be compared with the one before."""
    liveness = Liveness(K, np.full((K, 12), 0.4), PERIOD_S)
    for number in range(200):
        raw = np.full((K, 12), 240, np.uint8)
        raw[1, 4] -= 12 * (number == 10)
        present = HERE.copy()
        present[1] = number < 12 or number % 7 >= lost_of_7
        liveness.step(raw, present, NO)
    assert liveness.spikes.sum() == spikes


@pytest.mark.parametrize("noise_units", [None, np.full((K, 12), 0.8)])
def test_a_triangle_of_which_nothing_is_known_is_valid_from_its_second_change_on(
    noise_units: np.ndarray | None,
) -> None:
    liveness = Liveness(K, noise_units, PERIOD_S)
    raw = np.full((K, 12), 240, np.uint8)
    for _ in range(5):
        assert liveness.unproven.all()
        assert liveness.doubted is not None
        assert liveness.doubted.all()
        liveness.step(raw, HERE, NO)
    assert not liveness.frozen.any()
    # One change may be that of a set-up.
    for changes in (1, 2):
        raw[1, 4] -= 1
        liveness.step(raw, HERE, NO)
        assert liveness.unproven.tolist() == [True, changes < 2, True, True]


def test_a_calibration_takes_no_triangle_for_unknown_that_has_changed() -> None:
    before = Liveness(K, None, PERIOD_S)
    raw = np.full((K, 12), 240, np.uint8)
    for _ in range(3):
        raw[:3, 4] -= 1
        before.step(raw, HERE, NO)
    noise = np.full((K, 12), 0.8)
    noise[2] = 0.0
    after = Liveness(K, noise, PERIOD_S)
    after.keep(before, np.zeros(1, np.bool_))
    assert after.unproven.tolist() == [False, False, True, True]


def test_a_pad_that_is_stuck_at_a_calibration_is_so_until_it_has_moved_three_times() -> None:
    """The boards' zeros are what they were, and so are the bytes that show its life."""
    rng = np.random.default_rng(3)
    centre, noise = np.full((K, 12), 240.3), np.full((K, 12), 0.8)
    before = Liveness(K, noise, PERIOD_S)
    for _ in range(400):
        raw = noisy_bytes(rng, 0.8, centre)
        raw[1, 4] = 240
        before.step(raw, HERE, NO)
    assert np.argwhere(before.stuck).tolist() == [[1, 4]]
    after = Liveness(K, noise, PERIOD_S)
    after.keep(before, np.zeros(1, np.bool_))
    for byte in (240, 240, 241, 241, 241, 240, 240, 241):
        assert np.argwhere(after.stuck).tolist() == [[1, 4]]
        assert after.lifeless is not None
        assert np.array_equal(after.lifeless, after.stuck)
        raw = noisy_bytes(rng, 0.8, centre)
        raw[1, 4] = byte
        after.step(raw, HERE, NO)
    assert after.lifeless is None


def test_a_triangle_that_a_calibration_finds_constant_is_valid_after_three_changes() -> None:
    rng = np.random.default_rng(3)
    noise = np.full((K, 12), 0.8)
    noise[2] = 0.0
    liveness = Liveness(K, noise, PERIOD_S)
    liveness.step(noisy_bytes(rng, 0.8, np.full((K, 12), 240.3)), HERE, NO)
    for changes in range(4):
        others = changes < 2
        assert liveness.unproven.tolist() == [others, others, changes < 3, others]
        liveness.step(noisy_bytes(rng, 0.8, np.full((K, 12), 240.3)), HERE, NO)


def test_a_press_right_after_a_release_is_no_damaged_byte() -> None:
    """Up and down within two sweeps, but not back to where it was."""
    rng = np.random.default_rng(4)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.4, centre)
    for below in (90, 90, 0, 12, 20):
        raw = noisy_bytes(rng, 0.4, centre)
        raw[1, 4] -= below
        liveness.step(raw, HERE, NO)
    assert liveness.spikes.sum() == 0


def test_a_triangle_that_was_absent_when_calibrated_may_be_as_noisy_as_it_is() -> None:
    """Its noise is not known: it is no damage of its frames, nor a fault of its pads."""
    rng = np.random.default_rng(5)
    centre = np.full((K, 12), 240.3)
    noise = np.full((K, 12), 0.5)
    noise[1] = 0.0
    liveness = Liveness(K, noise, PERIOD_S)
    for _ in range(200):
        raw = noisy_bytes(rng, 0.5, centre)
        raw[1] = noisy_bytes(rng, 5.0, centre)[1]
        liveness.step(raw, HERE, NO)
    assert liveness.spikes.sum() == 0
    assert not liveness.noisy.any()


def test_a_pad_of_which_too_little_was_received_may_be_as_noisy_as_it_is() -> None:
    """As a whole triangle: what was not measured is no reason to refuse or accuse anything."""
    rng = np.random.default_rng(5)
    centre = np.full((K, 12), 240.3)
    noise = np.full((K, 12), 0.5)
    noise[1, 4] = np.nan
    liveness = Liveness(K, noise, PERIOD_S)
    for _ in range(200):
        raw = noisy_bytes(rng, 0.5, centre)
        raw[1, 4] = noisy_bytes(rng, 5.0, centre)[1, 4]
        liveness.step(raw, HERE, NO)
    assert liveness.spikes.sum() == 0
    assert liveness.doubted is None


def test_a_pad_that_was_pressed_to_its_end_for_a_minute_is_known_as_well_as_before() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.0)
    liveness = Liveness(K, np.full((K, 12), 0.4), PERIOD_S)
    for _ in range(1200):
        raw = noisy_bytes(rng, 0.4, centre)
        raw[3, 1:] = 0
        liveness.step(raw, HERE, NO)
    raw[3] = [0, 240] + [0] * 10
    for _ in range(100):
        others = noisy_bytes(rng, 0.4, centre)
        others[3] = raw[3]
        liveness.step(others, HERE, NO)
    assert liveness.frozen.tolist() == [False, False, False, True]


def test_the_first_sweep_of_a_board_is_compared_with_nothing_whichever_came_before() -> None:
    rng = np.random.default_rng(3)
    liveness = Liveness(K, np.zeros((K, 12)), PERIOD_S, boards=2)
    centre = np.full((K, 12), 240.3)
    first = np.arange(K) < K // 2
    liveness.step(noisy_bytes(rng, 0.8, centre), first, NO, came=np.array([True, False]))
    for changes in range(4):
        assert liveness.unproven.tolist() == [changes < 3] * 2 + [changes < 4] * 2
        liveness.step(noisy_bytes(rng, 0.8, centre), HERE, NO)


def test_a_pad_whose_joint_is_mended_is_calm_again_after_some_sweeps() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.4, centre)
    for number in range(100):
        raw = noisy_bytes(rng, 0.4, centre)
        raw[1, 4] -= 40 * (number % 2)
        liveness.step(raw, HERE, NO)
    assert liveness.noisy[1, 4]
    for _ in range(40):
        liveness.step(noisy_bytes(rng, 0.4, centre), HERE, NO)
    assert not liveness.noisy.any()
    assert liveness.doubted is None


def test_a_frozen_triangle_was_not_silenced_by_an_error_and_one_with_an_error_was() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.8, centre)
    erring = np.array([True, False, False, False])
    for number in range(40):
        raw = noisy_bytes(rng, 0.8, centre)
        raw[:3] = 240
        liveness.step(raw, HERE & ~erring, erring & (number == 0))
    assert liveness.unproven.tolist() == [True, True, True, False]
    assert liveness.silenced.tolist() == [True, False, False, False]
    for _ in range(6):
        liveness.step(noisy_bytes(rng, 0.8, centre), HERE, NO)
    assert not liveness.silenced.any()


def test_what_changes_in_every_conversion_is_known_to_and_only_conversions_count() -> None:
    """Of a board that sends four times as often as its chips convert, a sweep is a quarter."""
    for sends_per_conversion in (1, 4):
        period_s = CONVERSION_S / sends_per_conversion
        liveness = Liveness(K, np.full((K, 12), 0.8), period_s)
        seen = liveness._seen[0]
        for sweep in range(1 + 100 * sends_per_conversion):
            raw = np.full((K, 12), 200 + sweep // sends_per_conversion % 2, np.uint8)
            liveness.step(raw, HERE, NO)
        liveness.catch_up()
        assert liveness._seen == pytest.approx(np.full(K, seen + 100.0))
        changes = 1 / sends_per_conversion
        for _ in range(20):
            for sweep in range(100 * sends_per_conversion):
                raw = np.full((K, 12), 200 + sweep // sends_per_conversion % 2, np.uint8)
                liveness.step(raw, HERE, NO)
        assert liveness._rate == pytest.approx(np.full((K, 12), changes), rel=0.02)


def test_triangles_that_are_not_fitted_are_in_no_doubt_and_change_no_verdict() -> None:
    rng = np.random.default_rng(8)
    noise = np.full((K, 12), 0.8)
    fitted = np.array([True, True, True, False])
    some = Liveness(K, np.where(fitted[:, None], noise, 0.0), PERIOD_S, fitted=fitted)
    three = Liveness(K - 1, noise[:-1], PERIOD_S)
    centre = rng.uniform(200, 240, (K, 12))
    for sweep in range(300):
        raw = noisy_bytes(rng, 0.8, centre)
        raw[3] = 0
        raw[1, 4] = 222
        if sweep > 200:
            raw[2] = 230
        some.step(raw, fitted, NO)
        three.step(raw[:3], HERE[:3], NO[:3])
        np.testing.assert_array_equal(some.frozen[:3], three.frozen)
        np.testing.assert_array_equal(some.stuck[:3], three.stuck)
    assert some.stuck[1, 4]
    assert some.frozen.tolist() == [False, False, True, False]
    assert some.doubted is not None
    assert not some.doubted[3].any()


def test_a_pad_that_was_noisy_when_another_board_was_calibrated_calms_down() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)

    def new() -> Liveness:
        return Liveness(K, np.full((K, 12), 0.4), PERIOD_S, boards=2)

    before, after = new(), new()
    for number in range(100):
        raw = noisy_bytes(rng, 0.4, centre)
        raw[3, 4] -= 40 * (number % 2)
        before.step(raw, HERE, NO)
    for _ in range(2):
        before.step(noisy_bytes(rng, 0.4, centre), HERE, NO)
    after.keep(before, np.array([False, True]))
    assert after.noisy[3, 4]
    for _ in range(40):
        after.step(noisy_bytes(rng, 0.4, centre), HERE, NO)
    assert after.doubted is None


def test_steps_of_four_units_up_and_down_are_noise_at_the_fourth() -> None:
    """Each counts as four thirds of the limit, with an eighth of the weight."""
    liveness = Liveness(K, np.full((K, 12), 0.4), PERIOD_S)
    found = []
    for number in range(7):
        raw = np.full((K, 12), 240, np.uint8)
        raw[1, 4] -= 4 * (number % 2)
        liveness.step(raw, HERE, NO)
        found.append(bool(liveness.noisy[1, 4]))
    # The first sweep is compared with nothing, and a jump is two steps.
    assert found == [False] * 5 + [True] * 2


def repeated(conversions: list[np.ndarray], period_s: float) -> list[np.ndarray]:
    """The sweeps of a board whose chips convert once in `CONVERSION_S`, from the middle of one."""
    end_s = len(conversions) * CONVERSION_S
    times_s = np.arange(0.4 * period_s, end_s, period_s)
    return [conversions[int(time_s / CONVERSION_S)] for time_s in times_s]


@pytest.mark.parametrize("period_ms", [10, 12, 18, 20, 25, 36, 40, 50])
@pytest.mark.parametrize("units", [20, 120])
def test_a_pad_that_jumps_is_noisy_however_often_its_board_sends_it(
    period_ms: int, units: int
) -> None:
    rng = np.random.default_rng(period_ms)
    centre = np.full((K, 12), 240.3)
    liveness = Liveness(K, np.full((K, 12), 0.5), period_ms * 1e-3)
    conversions = []
    for _ in range(round(20.0 / CONVERSION_S)):
        raw = noisy_bytes(rng, 0.5, centre)
        raw[1, 4] -= units * int(rng.integers(2))
        conversions.append(raw)
    noisy = []
    for raw in repeated(conversions, period_ms * 1e-3):
        liveness.step(raw, HERE, NO)
        noisy.append(bool(liveness.noisy[1, 4]))
        assert np.count_nonzero(liveness.noisy) <= noisy[-1]
    assert noisy.index(True) * period_ms < 2000
    # Where a conversion lasts longer than a period, all of it is seen.
    assert np.mean(noisy) > 0.7
    assert not liveness.spikes.any()
    for raw in repeated([noisy_bytes(rng, 0.5, centre) for _ in range(40)], period_ms * 1e-3):
        liveness.step(raw, HERE, NO)
    assert liveness.doubted is None


@given(st.integers(10, 50), st.integers(3, 8), st.floats(0.0, 1.2), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_presses_and_noise_are_no_jumps_however_often_a_board_sends_them(
    period_ms: int, conversions_each: int, sigma: float, seed: int
) -> None:
    """A press of three conversions and more, 0.11 s, is two sweeps of the slowest of them."""
    rng = np.random.default_rng(seed)
    centre = np.full((K, 12), 240.3)
    liveness = Liveness(K, np.full((K, 12), max(sigma, 0.4)), period_ms * 1e-3)
    conversions = []
    for number in range(300):
        pressed = centre.copy()
        pressed[:2] -= 100 * (number // conversions_each % 2)
        conversions.append(noisy_bytes(rng, sigma, pressed))
    for raw in repeated(conversions, period_ms * 1e-3):
        liveness.step(raw, HERE, NO)
        assert not liveness.noisy.any()
    assert not liveness.spikes.any()


@pytest.mark.parametrize("period_ms", [10, 20, 25])
def test_a_temperature_pad_that_jumps_is_noisy_between_the_repeats_of_other_pads(
    period_ms: int,
) -> None:
    """What is taken off the other pads moves them in sweeps in which they are not converted."""
    rng = np.random.default_rng(3)
    repeats = Repeats([Encoding(GAIN, 2, 240, truncates=False)] * K)
    liveness = Liveness(K, np.full((K, 12), 0.6), period_ms * 1e-3, repeats)
    jumps: list[np.ndarray] = []
    for _ in range(80):
        raw = noisy_bytes(rng, 0.5, np.full((K, 12), 240.3))
        raw[2, THERMAL_TAXEL] -= 30 * (len(jumps) % 2)
        raw[1, 4] -= 30 * (len(jumps) % 2)
        jumps.append(raw)
    for number, sent in enumerate(repeated(jumps, period_ms * 1e-3)):
        raw = sent.copy()
        raw[1, 4] += number % 2
        liveness.step(raw, HERE, NO)
    assert np.argwhere(liveness.noisy).tolist() == [[1, 4], [2, THERMAL_TAXEL]]
    assert liveness.doubted is not None
    assert liveness.doubted[2].tolist() == (repeats.compensated[2] | liveness.noisy[2]).tolist()


@pytest.mark.parametrize(("sweeps", "spikes"), [(1, 1), (2, 0), (4, 0)])
def test_a_byte_of_a_fast_board_is_damaged_for_one_sweep_and_a_pad_jumps_for_longer(
    sweeps: int, spikes: int
) -> None:
    liveness = Liveness(K, np.full((K, 12), 0.4), 0.01)
    for number in range(300):
        raw = np.full((K, 12), 240, np.uint8)
        raw[1, 4] -= 30 * (10 <= number < 10 + sweeps)
        liveness.step(raw, HERE, NO)
        # It takes some 25 conversions to know that the pad does not jump.
        assert number > 80 or not liveness.spikes.any()
    assert liveness.spikes.sum() == spikes


@pytest.mark.parametrize(("left_out", "noisy"), [(None, True), ("gap", False), ("lost", True)])
def test_a_step_before_a_gap_and_one_after_it_are_no_jump_of_a_fast_board(
    left_out: str | None, noisy: bool
) -> None:
    """Of a triangle that one sweep lacked nothing else happened meanwhile."""
    liveness = Liveness(K, np.full((K, 12), 0.4), 0.01)
    for number in range(200):
        raw = np.full((K, 12), 240, np.uint8)
        raw[1, 4] -= 30 * (number // 4 % 2)
        here = HERE.copy()
        if number % 4 == 2:
            if left_out == "gap":
                liveness.note_gap(0, 1)
            here[1] = left_out != "lost"
        liveness.step(raw, here, NO)
    assert bool(liveness.noisy[1, 4]) is noisy


def test_a_fast_board_and_a_slow_one_are_each_judged_by_their_own_conversions() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = Liveness(K, np.full((K, 12), 0.5), np.array([0.0125, 0.05]), boards=2)
    for number in range(400):
        came = np.array([True, number % 4 == 3])
        if number % 4 == 0:
            # Up and down again in two sweeps of the slow board is a press.
            raws = [noisy_bytes(rng, 0.4, centre) for _ in range(4)]
        raw = raws[0].copy()
        raw[0, 4] -= 30 * (number // 3 % 2)
        raw[3, 4] -= 30 * (number // 8 % 2)
        liveness.step(raw, np.repeat(came, K // 2), NO, came=came)
    assert np.argwhere(liveness.noisy).tolist() == [[0, 4]]


def test_a_triangle_of_which_little_came_or_that_is_touched_teaches_no_rate() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = Liveness(K, np.full((K, 12), 0.4), PERIOD_S)
    before = liveness._triangle_rate.copy()
    for number in range(300):
        here = HERE.copy()
        here[2] = number % 4 == 0
        liveness.step(noisy_bytes(rng, 3.0, centre), here, NO)
    assert liveness._triangle_rate[2] == before[2]
    assert (liveness._triangle_rate[[0, 1, 3]] != before[[0, 1, 3]]).all()
    before = liveness._triangle_rate.copy()
    for _ in range(300):
        liveness.step(noisy_bytes(rng, 3.0, centre), HERE, NO, np.ones((K, 12), bool))
    assert (liveness._triangle_rate == before).all()


def test_a_frozen_triangle_that_reports_an_error_is_silenced_and_no_longer_frozen() -> None:
    rng = np.random.default_rng(3)
    centre = np.full((K, 12), 240.3)
    liveness = calibrated(rng, 0.8, centre)
    frozen = np.array([True, False, False, False])
    for _ in range(40):
        raw = noisy_bytes(rng, 0.8, centre)
        raw[0] = 240
        liveness.step(raw, HERE, NO)
    assert liveness.frozen.tolist() == frozen.tolist()
    liveness.step(raw, ~frozen, frozen)
    assert liveness.silenced.tolist() == frozen.tolist()
    assert not liveness.frozen.any()


def test_after_an_error_repeats_count_from_nothing() -> None:
    sigma = 0.21
    liveness = Liveness(K, np.full((K, 12), sigma), PERIOD_S)
    changes = 1.0 - (1.0 - 2.0 * sigma**2) ** 12
    (allowed,) = longest_run(np.array([changes]), 5.0 / PERIOD_S, 1e9)
    raw = np.full((K, 12), 240, np.uint8)
    erring = np.array([True, False, False, False])
    for _ in range(3):
        liveness.step(raw, HERE, NO)
    liveness.step(raw, ~erring, erring)
    liveness.step(raw, HERE, NO)
    for repeats in range(1, int(allowed) + 2):
        liveness.step(raw, HERE, NO)
        assert bool(liveness.frozen[0]) is bool(repeats > allowed)


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_sweeps_that_wait_change_no_decision_and_nothing_that_is_learnt(
    data: st.DataObject,
) -> None:
    """Whether pads jump, stick, die, err, are touched or are not received."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    harm = data.draw(st.sampled_from([0.0, 0.02, 0.1]))
    k, boards = 6, 2
    sigma = rng.uniform(0.15, 1.2, (k, 12))
    centre = rng.uniform(235.0, 250.0, (k, 12))
    period_s = data.draw(st.sampled_from([0.0125, 0.05]))
    waits, takes = (Liveness(k, sigma, period_s, boards=boards) for _ in range(2))
    takes._room_left = lambda: 0  # type: ignore[method-assign]
    stuck, wild = np.zeros((k, 12), np.bool_), np.zeros((k, 12), np.bool_)
    dead = np.zeros(k, np.bool_)
    touched: Mask | None = None
    raw = np.zeros((k, 12), np.uint8)
    waited = 0
    for _ in range(300):
        if rng.random() < harm:
            stuck = rng.random((k, 12)) < data.draw(st.sampled_from([0.0, 0.03]))
            wild = rng.random((k, 12)) < data.draw(st.sampled_from([0.0, 0.1]))
            dead = rng.random(k) < data.draw(st.sampled_from([0.0, 0.2]))
            touched = rng.random((k, 12)) < 0.2 if rng.random() < 0.5 else None
        noise = rng.normal(0.0, sigma) + wild * rng.choice([-12.0, 0.0, 12.0], (k, 12))
        pressed = 0.0 if touched is None else 25.0 * rng.random() * touched
        now = np.clip(np.rint(centre + noise - pressed), 0, 255).astype(np.uint8)
        raw = np.where(stuck | dead[:, None], raw, now)
        present, erring, came = np.ones(k, np.bool_), np.zeros(k, np.bool_), None
        if rng.random() < harm:
            erring = rng.random(k) < 0.2
            present = ~erring & (rng.random(k) < 0.9)
        if rng.random() < harm:
            came = np.array([True, False])
            present[k // boards :] = erring[k // boards :] = False
        if rng.random() < harm:
            board = int(rng.integers(boards))
            for one in (waits, takes):
                one.note_gap(board)
        for one in (waits, takes):
            one.step(raw, present, erring, touched, came)
        waited += len(waits._waiting)
        for name in ("frozen", "unproven", "silenced", "noisy", "stuck"):
            assert np.array_equal(getattr(waits, name), getattr(takes, name)), name
        assert (waits.doubted is None) == (takes.doubted is None)
        assert waits.doubted is None or np.array_equal(waits.doubted, takes.doubted)
    waits.catch_up()
    assert np.array_equal(waits.spikes, takes.spikes)
    assert np.array_equal(waits._rate, takes._rate)
    assert np.array_equal(waits._pads.longest, takes._pads.longest)
    assert waited or harm


SLOW_PERIODS_S = (0.1, 0.2)


def slow(period_s: float, pressed_units: np.ndarray | None = None) -> Liveness:
    return Liveness(K, np.full((K, 12), 0.4), period_s, pressed_units=pressed_units)


@pytest.mark.parametrize("period_s", [0.025, 0.03, 0.04, PERIOD_S, *SLOW_PERIODS_S])
@pytest.mark.parametrize("contact_share", [0.3, 0.5, 0.7])
@given(hz=st.floats(0.5, 4.9), pads=st.sampled_from([3, 6, 12]), seed=st.integers(0, 99))
@example(hz=0.734375, pads=12, seed=33)
@settings(max_examples=10, deadline=None)
def test_pads_that_a_hand_taps_are_not_noisy_however_seldom_they_are_read(
    period_s: float, contact_share: float, hz: float, pads: int, seed: int
) -> None:
    """They rise and fall from sweep to sweep, and together."""
    rng, liveness = np.random.default_rng(seed), slow(period_s)
    tapped = np.arange(12) < pads
    for sweep in range(100):
        depth = 15.0 * (sweep * period_s * hz % 1.0 < contact_share) * rng.uniform(0.7, 1.0)
        centre = 240.0 - np.where(tapped, depth, 0.0) * np.linspace(0.6, 1.0, 12)
        liveness.step(noisy_bytes(rng, 0.4, np.tile(centre, (K, 1))), HERE, NO)
        assert not liveness.noisy.any()


@pytest.mark.parametrize("period_s", [PERIOD_S, *SLOW_PERIODS_S])
@pytest.mark.parametrize("jumping_pads", [1, 2])
@pytest.mark.parametrize("seed", range(5))
def test_few_pads_that_jump_are_noisy_for_slow_boards_too(
    period_s: float, jumping_pads: int, seed: int
) -> None:
    rng, liveness = np.random.default_rng(seed), slow(period_s)
    for _ in range(60):
        raw = noisy_bytes(rng, 0.4, np.full((K, 12), 200.0))
        raw[0, :jumping_pads] -= rng.choice([0, 30], jumping_pads).astype(np.uint8)
        liveness.step(raw, HERE, NO)
    assert np.argwhere(liveness.noisy).tolist() == [[0, pad] for pad in range(jumping_pads)]


@pytest.mark.parametrize("period_s", [PERIOD_S, *SLOW_PERIODS_S])
def test_a_temperature_pad_that_a_slow_board_takes_off_the_others_is_noisy_although_they_follow(
    period_s: float,
) -> None:
    rng = np.random.default_rng(2)
    repeats = Repeats([Encoding(GAIN, 2, 240, truncates=False)] * K)
    liveness = Liveness(K, np.full((K, 12), 0.4), period_s, repeats)
    for _ in range(60):
        raw = noisy_bytes(rng, 0.4, np.full((K, 12), 200.0))
        raw[1] -= np.uint8(rng.choice([0, 30]))
        liveness.step(raw, HERE, NO)
    assert liveness.noisy[1, THERMAL_TAXEL]
    assert liveness.doubted is not None
    assert liveness.doubted[1, np.array(GAIN) > 0].all()


def jumped(liveness: Liveness, pads: int, period_s: float, seconds: float = 20.0) -> Mask:
    """Which are noisy after so many pads of one triangle have read what they like."""
    rng = np.random.default_rng(4)
    for _ in range(round(seconds / period_s)):
        raw = noisy_bytes(rng, 0.4, np.full((K, 12), 200.0))
        raw[1, :pads] -= rng.integers(0, 60, pads).astype(np.uint8)
        liveness.step(raw, HERE, NO)
    return liveness.noisy.copy()


@pytest.mark.parametrize("period_s", [0.05, *SLOW_PERIODS_S])
def test_no_pad_of_a_slow_boards_chip_is_read_while_most_are_noisy_and_for_a_minute_after(
    period_s: float,
) -> None:
    known, whole = np.full((K, 12), 0.5), period_s > 0.05
    assert jumped(slow(period_s, known), 6, period_s)[1].sum() == 6
    liveness = slow(period_s, known)
    assert jumped(liveness, 7, period_s)[1].all() == whole
    after = slow(period_s, known)
    after.keep(liveness, np.ones(1, np.bool_))
    for one in (liveness, after):
        still = jumped(one, 0, period_s, 55.0)
        assert np.argwhere(still).tolist() == [[1, pad] for pad in range(12) if whole]
        assert not jumped(one, 0, period_s, 10.0).any()
        assert one.doubted is None


def test_pads_whose_noise_under_pressure_is_not_known_do_not_show_a_broken_chip() -> None:
    known = np.where(np.arange(12) < 6, np.nan, np.full((K, 12), 0.5))
    assert jumped(slow(0.2), 9, 0.2)[1].sum() == 9
    assert jumped(slow(0.2, known), 9, 0.2)[1].sum() == 9
    assert jumped(slow(0.2, known), 10, 0.2)[1].all()
