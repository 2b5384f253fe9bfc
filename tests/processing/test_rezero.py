"""The new zero of a board is looked at for long enough, and told where it cannot be known."""

from collections.abc import Callable

import numpy as np
import pytest

from emulator.chips.noise import SampledNoise
from skin_host.config.settings import TouchSettings
from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.rezero import (
    FEWEST,
    LOOK_SWEEPS,
    SETTLE_NS,
    Rezero,
    look_s,
)
from skin_host.processing.touch import levels

N = 192
NO_LOAD = np.full(N, 240.0)
NOISE_UNITS = 0.7
NONE = np.zeros(N, np.bool_)
S = 1_000_000_000


def look(rezero: Rezero, offset_units: np.ndarray, period_s: float) -> tuple[int, int]:
    """Send sweeps until it has seen enough; return how many that took, and when it was, in ns."""
    rng = np.random.default_rng(2)
    t_ns = 1_700_000_000 * S
    for number in range(1000):
        raw = np.rint(NO_LOAD - offset_units + NOISE_UNITS * rng.standard_normal(N))
        if rezero.step(np.clip(raw, 0, 255).astype(np.uint8), ~NONE, NONE, t_ns):
            return number, t_ns
        t_ns += round(period_s * S)
    raise AssertionError("never ends")


@pytest.mark.parametrize("period_s", [0.02, 0.05, 0.2, 1.0])
def test_a_slow_boards_zero_is_known_as_well_as_that_of_a_quick_one(period_s: float) -> None:
    offset = np.linspace(-3.0, 3.0, N)
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    sweeps, _ = look(rezero, offset, period_s)
    assert sweeps == max(LOOK_SWEEPS, round(1.0 / period_s))
    _, found = rezero.finish(np.zeros(N), np.full(N, NOISE_UNITS))
    # A baseline that is off by half a unit makes noise look like a touch.
    assert np.std(found - offset) < 0.2
    assert not rezero.doubted.any()


PERIOD_S = 0.05
NOISY_UNITS = 4.0
#: One pad in four is noisy.
NOISY = np.arange(N) % 4 == 0
SPREAD = np.where(NOISY, NOISY_UNITS, NOISE_UNITS)
ENTER = levels(np.full(N, 0.5), SPREAD, TouchSettings()).enter


def look_at_noisy(
    rest_units: float = 0.0, pressed: slice = slice(0, 0)
) -> tuple[Rezero, list[np.ndarray], np.ndarray]:
    """Observe a board with noisy pads for 10 s; return the observer, which pads were found in each
    sweep, and the zeros.

    Args:
        rest_units: where the noisy pads rest.
        pressed: sweeps in which they are pressed with 8 units, and others feel that.
    """
    wanted = np.ceil(look_s(SPREAD, ENTER) / PERIOD_S).astype(np.int64)
    rezero = Rezero(NONE, NO_LOAD, ~NONE, wanted)
    rng = np.random.default_rng(3)
    zeros, found = np.zeros(N), []
    presses = range(10_000)[pressed]
    for number in range(200):
        presses_now = number in presses
        units = np.where(NOISY, rest_units + 8.0 * presses_now, 0.0)
        raw = np.rint(NO_LOAD - units + SPREAD * rng.standard_normal(N))
        sent = np.clip(raw, 0, 255).astype(np.uint8)
        t_ns = round(number * PERIOD_S * S)
        new = NONE
        if rezero.step(sent, ~NONE, NONE, t_ns, touched=presses_now):
            better, zeros = rezero.finish(zeros, SPREAD)
            new = better if rezero.late is None else better & ~rezero.late
        found.append(new)
    return rezero, found, zeros


def test_the_zero_of_noisy_pads_is_known_as_well_as_they_decide() -> None:
    """What noise leaves in it is far below the threshold that this noise sets."""
    rezero, found, zeros = look_at_noisy()
    seen = [number for number, new in enumerate(found) if new.any()]
    # The others do not wait for them.
    assert np.array_equal(found[seen[0]], ~NOISY)
    assert np.array_equal(found[seen[1]], NOISY)
    assert len(seen) == 2
    assert not rezero.doubted.any()
    for pads in (NOISY, ~NOISY):
        assert np.std(zeros[pads]) < ENTER[pads][0] / 5


@pytest.mark.parametrize("presses", [False, True])
def test_what_was_read_of_a_noisy_pad_so_far_is_its_zero_meanwhile(presses: bool) -> None:
    """It is better than that of the board before, unless something pressed it in that time."""
    wanted = np.ceil(look_s(SPREAD, ENTER) / PERIOD_S).astype(np.int64)
    rezero = Rezero(NONE, NO_LOAD, ~NONE, wanted)
    offset = np.where(NOISY & presses, 30.0, 0.0)
    rng = np.random.default_rng(3)
    for number in range(LOOK_SWEEPS + 1):
        units = offset if number > 12 else 0.0
        raw = np.rint(NO_LOAD - units + SPREAD * rng.standard_normal(N)).clip(0, 255)
        ready = rezero.step(raw.astype(np.uint8), ~NONE, NONE, round(number * PERIOD_S * S))
        assert ready == (number == LOOK_SWEEPS)
    before = np.where(NOISY, 5.0, 0.0)
    better, zeros = rezero.finish(before, SPREAD)
    assert (rezero.late == NOISY).all()
    if presses:
        assert (rezero.moved == NOISY).all()
        assert not better[NOISY].any()
        assert (zeros[NOISY] == 5.0).all()
    else:
        assert better.all()
        assert np.std(zeros[NOISY]) < ENTER[0] / 2


def test_a_press_while_noisy_pads_are_observed_is_not_in_their_zero() -> None:
    _, found, zeros = look_at_noisy(pressed=slice(30, 120))
    assert np.abs(zeros[NOISY]).max() < ENTER[NOISY][0] / 2
    assert [number > 120 for number, new in enumerate(found) if new[NOISY].any()] == [True]


def test_noise_that_reaches_the_end_of_the_scale_is_refused_and_in_no_doubt() -> None:
    """A board's zero is one reading: it leaves noisy pads anywhere within their noise."""
    rezero, _, zeros = look_at_noisy(rest_units=-9.0)
    assert (rezero.cut_off & NOISY).sum() > 0.5 * NOISY.sum()
    assert not (rezero.cut_off & ~NOISY).any()
    assert not rezero.doubted.any()
    # The one before, or the mean of the readings until others were found.
    assert (zeros[rezero.cut_off] >= -9.0 - ENTER[0] / 2).all()
    believed = NOISY & ~rezero.cut_off
    assert np.abs(zeros[believed] + 9.0).max() < ENTER[NOISY][0] / 2


def test_noise_that_nearly_reaches_the_end_of_the_scale_gives_a_zero() -> None:
    rezero, _, zeros = look_at_noisy(rest_units=-6.0)
    believed = NOISY & ~rezero.cut_off
    assert believed.sum() > 0.9 * NOISY.sum()
    assert np.abs(zeros[believed] + 6.0).max() < ENTER[NOISY][0] / 2


def test_a_quiet_pad_at_the_end_of_the_scale_was_pressed_when_zeroed() -> None:
    """Its noise does not explain where it rests."""
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    look(rezero, np.where(np.arange(N) == 7, -20.0, 0.0), PERIOD_S)
    rezero.finish(np.zeros(N), np.full(N, NOISE_UNITS))
    assert np.flatnonzero(rezero.doubted).tolist() == [7]
    assert not rezero.cut_off.any()


def test_a_pad_that_lifts_while_it_is_observed_was_pressed_when_zeroed() -> None:
    """What pressed it harder for some sweeps balances in the mean what it reads once it lifts."""
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    pad = np.arange(N) == 7
    for number in range(LOOK_SWEEPS + 1):
        units = np.where(pad, 18.0 if number < 9 else -20.0, 0.0)
        raw = np.clip(NO_LOAD - units, 0, 255).astype(np.uint8)
        rezero.step(raw, ~NONE, NONE, round(number * PERIOD_S * S))
    rezero.finish(np.zeros(N), np.full(N, NOISE_UNITS))
    assert np.flatnonzero(rezero.doubted).tolist() == [7]
    assert not rezero.cut_off.any()


def test_it_settles_a_second_after_the_look_however_long_that_took() -> None:
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    _, ended_ns = look(rezero, np.zeros(N), 0.2)
    rezero.finish(np.zeros(N), np.full(N, NOISE_UNITS))
    assert not rezero.settled(ended_ns)
    assert not rezero.settled(ended_ns + S)
    assert rezero.settled(ended_ns + 2 * S)


def test_new_baselines_are_unsettled_until_the_pipeline_uses_them() -> None:
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    _, ended_ns = look(rezero, np.zeros(N), 0.05)
    assert not rezero.settled(ended_ns)
    rezero.finish(np.zeros(N), np.full(N, NOISE_UNITS))
    # Times of a part may lie a little before that of the board's sweep.
    for passed_ns in (-SETTLE_NS + 1, 0, 1, SETTLE_NS - 1):
        late = rezero.unsettled(ended_ns + passed_ns)
        assert late is not None
        assert late.all()
        assert not rezero.settled(ended_ns + passed_ns)
    for passed_ns in (SETTLE_NS, SETTLE_NS + 1, 1000 * S):
        assert rezero.unsettled(ended_ns + passed_ns) is None
        assert rezero.settled(ended_ns + passed_ns)


def test_a_zero_that_has_long_been_in_use_is_settled_and_in_no_doubt() -> None:
    t_ns = 1_700_000_000 * S
    rezero = Rezero.of_long_ago(NO_LOAD, t_ns)
    assert rezero.begun
    for passed_ns in (0, SETTLE_NS, 100 * S):
        assert rezero.settled(t_ns + passed_ns)
        assert rezero.unsettled(t_ns + passed_ns) is None
    assert not rezero.doubted.any()
    assert not rezero.step(NO_LOAD.astype(np.uint8), ~NONE, NONE, t_ns)


def test_a_look_begins_with_the_first_sweep() -> None:
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    assert not rezero.begun
    late = rezero.unsettled(S)
    assert late is not None
    assert late.all()
    rezero.step(NO_LOAD.astype(np.uint8), NONE, NONE, S)
    assert rezero.begun


@pytest.mark.parametrize(
    ("no_load", "raw", "pressed"),
    [(240, 237, False), (240, 235, True), (240, 200, True), (200, 231, False)],
)
def test_a_pad_that_rests_higher_than_noise_explains_is_not_untouched(
    no_load: int, raw: int, pressed: bool
) -> None:
    """It was pressed between the zero and the first sweep. What rests lower has been released."""
    rezero = Rezero(NONE, np.full(N, float(no_load)), ~NONE)
    for number in range(LOOK_SWEEPS + 1):
        ended = rezero.step(np.full(N, raw, np.uint8), ~NONE, NONE, number * S // 20)
        assert ended == (number == LOOK_SWEEPS)
    found, baseline = rezero.finish(np.zeros(N), np.full(N, NOISE_UNITS))
    assert rezero.unknown.tolist() == [pressed] * N
    assert found.tolist() == [not pressed] * N
    assert baseline.tolist() == [0.0 if pressed else float(no_load - raw)] * N


def test_without_a_new_zero_pads_rest_where_they_did() -> None:
    """A doubt from an earlier start is no zero of the board: its pads have drifted since theirs."""
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    look(rezero, np.full(N, 20.0), PERIOD_S)
    found, zeros = rezero.finish(np.full(N, 19.0), np.full(N, NOISE_UNITS))
    assert found.all()
    assert np.abs(zeros - 20.0).max() < 1.0


#: Pads that something presses while their board's zero is observed.
PRESSED = np.arange(N) < 6
#: Each of them with more, down to what a touch begins with.
FORCES = np.where(PRESSED, np.array([60.0, 30.0, 15.0, 8.0, 6.0, 5.0])[np.arange(N) % 6], 0.0)


def observe(
    sweeps: int, pressed: Callable[[int], np.ndarray], touched: bool = False
) -> tuple[Rezero, dict[int, np.ndarray], np.ndarray]:
    """Observe a board with little noise; return the observer, which pads [n] were found in which
    sweep, and the zeros [n].

    Args:
        sweeps: how many.
        pressed: what presses each pad [n] in a sweep, in units.
        touched: whether another pad is touched all the while, whose zero is known.
    """
    rng = np.random.default_rng(5)
    rezero, zeros, seen = Rezero(NONE, NO_LOAD, ~NONE), np.zeros(N), {}
    for number in range(sweeps):
        units = np.maximum(pressed(number) + NOISE_UNITS * rng.standard_normal(N), -15.0)
        raw = np.clip(np.rint(NO_LOAD - units), 0, 255).astype(np.uint8)
        if rezero.step(raw, ~NONE, NONE, round(number * PERIOD_S * S), touched=touched):
            found, new = rezero.finish(zeros, np.full(N, NOISE_UNITS))
            zeros = np.where(found, new, zeros)
            if found.any():
                seen[number] = found
    return rezero, seen, zeros


@pytest.mark.parametrize("begins", [0, 1, 4, 10, 16, 18])
def test_a_press_that_begins_while_a_zero_is_observed_is_not_in_it(begins: int) -> None:
    """However long it lasts: the pad reads as it did before only when it has lifted."""
    lifts = 100
    rezero, seen, _ = observe(lifts, lambda sweep: FORCES * (sweep >= begins))
    assert np.array_equal(rezero.unknown, PRESSED)
    assert [found.tolist() for found in seen.values()] == [(~PRESSED).tolist()]
    rezero, seen, zeros = observe(
        lifts + 60, lambda sweep: FORCES * (begins <= sweep < lifts), touched=True
    )
    assert not rezero.unknown.any()
    assert np.abs(zeros).max() < 1.0
    known = np.array([min(sweep for sweep in seen if seen[sweep][pad]) for pad in range(N)])
    assert (known[PRESSED] > lifts).all()
    assert (known[~PRESSED] == LOOK_SWEEPS).all()


@pytest.mark.parametrize("lasts", [2, 5, 10])
def test_a_press_that_begins_and_ends_while_a_zero_is_observed_is_not_in_it(lasts: int) -> None:
    rezero, seen, zeros = observe(60, lambda sweep: FORCES * (5 <= sweep < 5 + lasts))
    assert not rezero.unknown.any()
    assert np.abs(zeros).max() < 1.0
    first, second = seen.values()
    assert first[~PRESSED].all()
    # What is less than noise leaves in a zero may remain in it.
    assert second[FORCES > 10.0].all()


def test_a_weak_press_that_was_zeroed_and_lifts_is_not_in_the_zero() -> None:
    """The pad then rests below what the board took for its zero, and not yet at the scale's end."""
    weak = np.where(PRESSED, 9.0, 0.0)
    rezero, _, zeros = observe(60, lambda sweep: -weak * (sweep >= 8))
    assert not rezero.unknown.any()
    assert np.abs(zeros + weak).max() < 1.0


def test_damaged_bytes_do_not_keep_a_zero_from_being_found() -> None:
    """A line that flips bits for a while: pads are known when it works again."""
    rng = np.random.default_rng(4)

    def damage(sweep: int) -> np.ndarray:
        flipped = rng.random(N) < 0.05 * (sweep < LOOK_SWEEPS)
        return np.where(flipped, rng.choice([-8.0, 16.0, 64.0], N), 0.0)

    rezero, _, zeros = observe(60, damage)
    assert not rezero.unknown.any()
    # Two that balance in every split are a tenth of what they were in the mean.
    assert np.abs(zeros).max() < 2.0


def test_one_conversion_that_is_sent_three_times_is_no_rest() -> None:
    """A recorded pad jumps away from pressure now and then, here at the end of the look."""
    rng = np.random.default_rng(6)
    period_s, jumps = 0.0123, range(80, 83)
    rezero, zeros = Rezero(NONE, NO_LOAD, ~NONE, None, period_s), np.zeros(N)
    for number in range(400):
        units = NOISE_UNITS * rng.standard_normal(N) - 12.0 * (PRESSED & (number in jumps))
        raw = np.rint(NO_LOAD - units).astype(np.uint8)
        if rezero.step(raw, ~NONE, NONE, round(number * period_s * S)):
            _, zeros = rezero.finish(zeros, np.full(N, NOISE_UNITS))
    assert not rezero.unknown.any()


def test_pads_that_are_not_used_are_in_no_doubt() -> None:
    """One that was absent when calibrated has no noise that would explain what it reads."""
    used = ~PRESSED
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    look(rezero, np.where(used, 0.0, 20.0), PERIOD_S)
    noise = np.where(used, NOISE_UNITS, 0.0)
    found, _ = rezero.finish(np.zeros(N), noise, np.where(used, noise, np.inf))
    assert found.all()
    assert not rezero.unknown.any()


@pytest.mark.parametrize("period_s", [0.02, 0.05])
def test_noise_as_on_real_skin_is_no_press(period_s: float) -> None:
    """One in a thousand pads may be observed for longer; none for ever."""
    again = 0
    for seed in range(20):
        noise = SampledNoise(16, seed)
        before = [noise.at(round(number * CONVERSION_S * S)) for number in range(-150, 1)]
        spread, snapshot = np.std(before, axis=0), before[-1]
        wanted = np.ceil(
            look_s(spread, levels(np.full(N, 0.5), spread, TouchSettings()).enter) / period_s
        )
        rezero = Rezero(NONE, NO_LOAD, ~NONE, wanted.astype(np.int64), period_s)
        found = NONE
        for number in range(1, round(8.0 / period_s)):
            t_ns = round(number * period_s * S)
            raw = np.clip(np.rint(NO_LOAD - noise.at(t_ns) + snapshot), 0, 255).astype(np.uint8)
            if rezero.step(raw, ~NONE, NONE, t_ns):
                new, _ = rezero.finish(np.zeros(N), spread)
                again += int(rezero.moved.sum())
                found = found | new
        assert (found | rezero.doubted | rezero.cut_off).all()
    assert again <= 4


def test_ten_readings_make_a_zero_and_nine_do_not() -> None:
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    few, enough = np.arange(N) < 4, np.arange(N) >= 4
    for number in range(LOOK_SWEEPS + 1):
        present = (enough & (number < FEWEST)) | (few & (number < FEWEST - 1))
        ended = rezero.step((NO_LOAD - 3).astype(np.uint8), present, NONE, number * S // 20)
    assert ended
    found, baseline = rezero.finish(np.zeros(N), np.full(N, NOISE_UNITS))
    assert np.flatnonzero(~found).tolist() == [0, 1, 2, 3]
    assert baseline.tolist() == [0.0] * 4 + [3.0] * (N - 4)
    late = rezero.unsettled(LOOK_SWEEPS * S // 20 + SETTLE_NS)
    assert late is not None
    assert np.flatnonzero(late).tolist() == [0, 1, 2, 3]


def test_what_is_read_after_the_look_is_no_part_of_a_zero_that_is_known() -> None:
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    for number in range(LOOK_SWEEPS + 1):
        raw = NO_LOAD - (2 if number < LOOK_SWEEPS else 40)
        rezero.step(raw.astype(np.uint8), ~NONE, NONE, number * S // 20)
    _, baseline = rezero.finish(np.zeros(N), np.full(N, NOISE_UNITS))
    assert baseline.tolist() == [2.0] * N


def test_a_zero_taken_under_a_press_is_in_doubt() -> None:
    offset = np.where(np.arange(N) == 7, -35.0, 0.0)
    touched = np.arange(N) == 3
    rezero = Rezero(touched, NO_LOAD, ~NONE)
    look(rezero, offset, 0.05)
    _, found = rezero.finish(np.zeros(N), np.full(N, NOISE_UNITS))
    assert np.flatnonzero(rezero.doubted).tolist() == [3, 7]
    assert found[[3, 7]].tolist() == [0.0, 0.0]


def test_a_clock_that_is_set_back_does_not_end_the_look_early() -> None:
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    raw = NO_LOAD.astype(np.uint8)
    t_ns = 1_700_000_000 * S
    ended = [rezero.step(raw, ~NONE, NONE, t_ns - number * S) for number in range(LOOK_SWEEPS + 1)]
    assert ended == [False] * LOOK_SWEEPS + [True]


def test_what_a_board_marks_as_far_out_of_range_is_no_part_of_its_zero() -> None:
    """For two sweeps after its data line was shorted, a board sends 0 without an error."""
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    raw = (NO_LOAD - 2.0).astype(np.uint8)
    for number in range(LOOK_SWEEPS + 1):
        shorted = np.full(N, number < 2)
        sent = np.where(shorted, 0, raw).astype(np.uint8)
        rezero.step(sent, ~NONE, shorted, number * S // 20)
    _, found = rezero.finish(np.zeros(N), np.full(N, NOISE_UNITS))
    assert found.tolist() == [2.0] * N
    assert not rezero.doubted.any()


def test_the_zero_of_what_was_far_out_of_range_all_the_while_is_in_doubt() -> None:
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    for number in range(LOOK_SWEEPS + 1):
        rezero.step(np.zeros(N, np.uint8), ~NONE, np.arange(N) < 12, number * S // 20)
    before = np.where(np.arange(N) < 12, 0.0, 240.0)
    found, baseline = rezero.finish(before, np.zeros(N))
    assert found.all()
    assert np.flatnonzero(rezero.doubted).tolist() == list(range(12))
    assert baseline.tolist() == before.tolist()


def test_pads_whose_frames_were_lost_in_the_look_are_observed_until_their_zero_is_known() -> None:
    """A triangle needs both its frames: of 40 % lost ones, eight of twenty sweeps have it."""
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    lost = np.arange(N) < 12
    absent = np.arange(N) >= 180
    found_at: dict[int, list[int]] = {}
    raw = (NO_LOAD - 2.0).astype(np.uint8)
    for number in range(80):
        t_ns = number * S // 20
        present = ~absent & ~(lost & (number % 5 < 3))
        if rezero.step(raw, present, NONE, t_ns):
            found, baseline = rezero.finish(np.zeros(N), np.full(N, NOISE_UNITS))
            found_at[number] = np.flatnonzero(found).tolist()
            assert (baseline[found] == 2.0).all()
            late = rezero.unsettled(t_ns)
            assert late is not None
            assert late[absent].all()
    first, last = found_at
    assert found_at == {first: list(range(12, 180)), last: list(range(12))}
    assert last > first
    late = rezero.unsettled(4 * S)
    assert late is not None
    assert np.flatnonzero(late).tolist() == list(range(180, N))
    assert not rezero.doubted.any()


def test_a_zero_is_observed_for_longer_the_more_it_scatters_against_the_threshold() -> None:
    """Until its standard error is a seventh of the threshold, a conversion being a second."""
    spread, enter = np.array([0.5, 1.0, 3.0, 0.0]), np.array([7.0, 7.0, 10.5, 7.0])
    assert look_s(spread, enter) == pytest.approx(np.array([0.25, 1.0, 4.0, 0.0]) * CONVERSION_S)


def test_what_was_sent_before_a_silence_decides_nothing_after_it() -> None:
    """A pad near the end of the scale was pressed before; what it reads afterwards is its noise."""
    noise_units = 5.0
    rng = np.random.default_rng(3)
    rezero = Rezero(NONE, NO_LOAD, ~NONE)
    t_ns = 1_700_000_000 * S
    for _ in range(5):
        rezero.step(np.full(N, 160, np.uint8), ~NONE, NONE, t_ns)
        t_ns += S // 20
    rezero.restart(t_ns)
    done = False
    while not done:
        raw = np.clip(np.rint(250.0 + noise_units * rng.standard_normal(N)), 0, 255)
        done = rezero.step(raw.astype(np.uint8), ~NONE, NONE, t_ns)
        t_ns += S // 20
    rezero.finish(np.zeros(N), np.full(N, noise_units))
    assert rezero.cut_off.mean() > 0.9
    assert rezero.doubted.mean() < 0.1
