"""A stuck pad is told from a quiet one by odds, and the odds are what they say."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.boards.arithmetic import transmit_16, transmit_32
from skin_host.bus.compensation import GAIN, GAIN_V2, NO_GAIN, THERMAL_TAXEL
from skin_host.processing import stuck
from skin_host.processing.stuck import (
    Encoding,
    Repeats,
    StuckPads,
    TouchedPads,
    inside,
    rate_in_run,
)

K = 8
SHAPE = (K, 12)
PERIOD_S = 0.05
NO = np.zeros(K, bool)
NO_LOAD = 240


class Watched:
    """Pads of a board that are shown to a watcher sweep by sweep."""

    def __init__(self, seen: np.ndarray, repeats: Repeats | None = None, share: float = 1.0):
        plain = Repeats([Encoding(NO_GAIN, 2, NO_LOAD, False)] * K)
        shares, periods_s = np.full(K, share), np.full(K, PERIOD_S)
        self.pads = StuckPads(seen.std(axis=0), shares, periods_s, repeats or plain, 1)
        self.raw = seen[-1]
        self.accusations = 0

    def show(self, raw: np.ndarray, touched: np.ndarray | None = None) -> None:
        before = self.pads.stuck
        felt = None if touched is None else TouchedPads.of(touched, touched.tobytes(), 1)
        self.pads.step(raw, raw != self.raw, inside(raw), NO, felt)
        self.raw = raw
        self.accusations += np.count_nonzero(self.pads.stuck & ~before)


def to_bytes(units: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(units), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma", [0.1, 0.4, 0.7, 1.5])
def test_false_accusations_are_as_rare_as_the_odds_say(
    sigma: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stuck, "ODDS", 1000.0)
    rng = np.random.default_rng(5)
    centre = 240 + rng.uniform(-0.5, 0.5, SHAPE)
    watched = Watched(to_bytes(centre + sigma * rng.standard_normal((100, *SHAPE))))
    began = 0
    for _ in range(6000):
        begins = watched.pads._run == stuck.BEGUN
        watched.show(to_bytes(centre + sigma * rng.standard_normal(SHAPE)))
        began += np.count_nonzero(begins)
    expected = began / stuck.ODDS
    assert watched.accusations <= expected + 4 * math.sqrt(expected) + 1
    if sigma == 0.7:
        assert watched.accusations > 0.1 * expected  # nor is anybody spared


@pytest.mark.parametrize("sigma", [0.3, 0.45, 0.6])
def test_a_pad_that_drifts_from_the_edge_of_a_byte_to_its_middle_is_not_accused(
    sigma: float,
) -> None:
    rng = np.random.default_rng(3)
    watched = Watched(to_bytes(240.5 + sigma * rng.standard_normal((100, *SHAPE))))
    for centre in np.concatenate([np.full(6000, 240.5), np.linspace(240.5, 241, 600)]):
        watched.show(to_bytes(centre + sigma * rng.standard_normal(SHAPE)))
    for _ in range(3000):
        watched.show(to_bytes(241 + sigma * rng.standard_normal(SHAPE)))
    assert watched.accusations == 0


def sweeps_until_stuck(
    watched: Watched, rng: np.random.Generator, units: float, touched: np.ndarray | None = None
) -> int:
    for sweep in range(1, 400):
        raw = to_bytes(240.3 + 0.8 * rng.standard_normal(SHAPE))
        raw[1, 5] = units
        watched.show(raw, touched)
        if watched.pads.stuck.any():
            assert np.argwhere(watched.pads.stuck).tolist() == [[1, 5]]
            return sweep
    raise AssertionError("never told")


def lively() -> tuple[Watched, np.random.Generator]:
    rng = np.random.default_rng(3)
    return Watched(to_bytes(240.3 + 0.8 * rng.standard_normal((100, *SHAPE)))), rng


def test_a_pad_that_stops_is_stuck_until_it_moves_again() -> None:
    watched, rng = lively()
    assert sweeps_until_stuck(watched, rng, 239) * PERIOD_S < 5
    for _ in range(20):
        watched.show(to_bytes(240.3 + 0.8 * rng.standard_normal(SHAPE)))
    assert not watched.pads.stuck.any()


def test_a_quiet_pad_that_sticks_is_found_at_last() -> None:
    """What is known of it is not forgotten while it shows nothing else."""
    plain = Repeats([Encoding(NO_GAIN, 2, NO_LOAD, False)] * K)
    pads = StuckPads(np.full(SHAPE, 0.4), np.ones(K), np.full(K, PERIOD_S), plain, 1)
    allowed = float(pads.longest[1, 5])
    assert 1000 < allowed < 20_000
    raw, changed = np.full(SHAPE, 240, np.uint8), np.zeros(SHAPE, bool)
    for _ in range(round(1.1 * allowed)):
        pads.step(raw, changed, None, NO)
    assert pads.stuck[1, 5]


def hold(watched: Watched, rng: np.random.Generator, *bytes_: int) -> list[bool]:
    """Show these bytes of the pad that stuck; return in which sweeps it is stuck."""
    found = []
    for byte in bytes_:
        raw = to_bytes(240.3 + 0.8 * rng.standard_normal(SHAPE))
        raw[1, 5] = byte
        watched.show(raw)
        found.append(bool(watched.pads.stuck[1, 5]))
    return found


@pytest.mark.parametrize("rests", [10, 200])
@pytest.mark.parametrize("units", [1, 2, 50])
def test_a_stuck_pad_is_valid_after_three_moves_however_long_it_rests_between_them(
    rests: int, units: int
) -> None:
    watched, rng = lively()
    sweeps_until_stuck(watched, rng, 239)
    assert all(hold(watched, rng, *[239 - units] * rests, *[239] * rests))
    # Whether a large step is a damaged byte, the next sweep shows.
    late = units > 1
    after = hold(watched, rng, *[239 - units] * 10)
    assert after == [True] * late + [False] * (10 - late)


def test_a_pad_that_was_stuck_before_a_restart_is_so_until_it_has_moved_three_times() -> None:
    """Its first byte is compared with none."""
    watched, rng = lively()
    was_stuck = np.zeros(SHAPE, bool)
    was_stuck[1, 5] = True
    watched.pads.expect_stuck(was_stuck)
    assert np.argwhere(watched.pads.stuck).tolist() == [[1, 5]]
    watched.raw[:] = 0
    for moves, byte in enumerate([200, 200, 201, 201, 202, 202, 203]):
        assert hold(watched, rng, byte) == [moves < 6]


def test_damaged_bytes_are_no_sign_of_life() -> None:
    watched, rng = lively()
    sweeps_until_stuck(watched, rng, 239)
    for wrong in (239 ^ 128, 239 ^ 4, 239 ^ 1, 239 ^ 2, 239 ^ 1, 239 ^ 1, 239 ^ 64):
        assert all(hold(watched, rng, *[239] * 15, wrong, *[239] * 15))


def test_a_damaged_byte_of_a_board_is_none_until_its_own_next_sweep_shows_that() -> None:
    """Two boards of which the second sends twice as often."""
    raw = np.full(SHAPE, 239, np.uint8)
    plain = Repeats([Encoding(NO_GAIN, 2, NO_LOAD, False)] * K)
    pads = StuckPads(np.full(SHAPE, 0.8), np.ones(K), np.full(K, PERIOD_S), plain, 2)
    for sweep in range(400):
        before, raw = raw, raw.copy()
        came = np.array([sweep % 2 == 0, True])
        here = np.repeat(came, K // 2)
        raw[here] = 239
        if sweep > 200 and sweep % 20 == 0:
            raw[: K // 2] ^= 64
        changed = (raw != before) & here[:, None]
        pads.step(raw, changed, inside(raw) & here[:, None], NO, came=came)
        assert pads.stuck.all() or sweep < 200


def test_a_quiet_pad_that_was_calibrated_as_a_noisy_one_is_not_called_stuck_for_good() -> None:
    """It moves for one sweep in ten seconds, so it rests for too long before each move."""
    raw = np.full(SHAPE, 240, np.uint8)
    plain = Repeats([Encoding(NO_GAIN, 2, NO_LOAD, False)] * K)
    pads = StuckPads(np.full(SHAPE, 5.0), np.ones(K), np.full(K, PERIOD_S), plain, 1)
    stuck_for = []
    for sweep in range(36_000):
        before, raw = raw, np.full(SHAPE, 239 if sweep % 200 == 0 else 240, np.uint8)
        pads.step(raw, raw != before, None, NO)
        stuck_for.append(bool(pads.stuck[1, 5]))
    assert any(stuck_for[:200])
    assert not any(stuck_for[-12_000:])


def test_a_pad_that_sticks_again_and_again_is_found_each_time() -> None:
    """What it shows meanwhile does not let it rest for longer once it has lived for a while."""
    watched, rng = lively()
    for _ in range(5):
        for _ in range(600):
            watched.show(to_bytes(240.3 + 0.8 * rng.standard_normal(SHAPE)))
        assert not watched.pads.stuck.any()
        assert sweeps_until_stuck(watched, rng, 239) * PERIOD_S < 5
        hold(watched, rng, *[239] * 1200)


@pytest.mark.parametrize("sigma", [0.6, 0.8, 1.2])
def test_after_a_calibration_a_run_is_too_long_by_the_odds_of_a_hundred_samples(
    sigma: float,
) -> None:
    """The beta-binomial of Bayes' rule, after two repeats with which a run begins."""
    noise = np.full(SHAPE, sigma)
    plain = Repeats([Encoding(NO_GAIN, 2, NO_LOAD, False)] * K)
    pads = StuckPads(noise, np.ones(K), np.full(K, PERIOD_S), plain, 1)
    moves = 100 * rate_in_run(noise)[0, 0]
    run, still = pads.longest[0, 0] - 2, 100 - moves
    log_odds = (
        math.lgamma(100 + run) - math.lgamma(still + run) - math.lgamma(100.0) + math.lgamma(still)
    )
    assert log_odds == pytest.approx(math.log(1e11), rel=0.01)


def test_a_pad_that_is_stuck_as_if_touched_is_found_as_soon() -> None:
    watched, rng = lively()
    alone = np.zeros(SHAPE, bool)
    alone[1, 5] = True
    found = sweeps_until_stuck(watched, rng, 190, alone)
    again, rng = lively()
    assert found <= sweeps_until_stuck(again, rng, 190) + 3


def test_while_something_else_is_touched_a_pad_may_rest_for_longer() -> None:
    watched, rng = lively()
    elsewhere = np.zeros(SHAPE, bool)
    elsewhere[3, 0] = True
    found = sweeps_until_stuck(watched, rng, 239, elsewhere)
    again, rng = lively()
    assert found > 3 * sweeps_until_stuck(again, rng, 239)


@pytest.mark.parametrize("pads", [1, 2])
def test_a_touch_slows_its_own_board_but_neither_others_nor_what_only_feels_itself(
    pads: int,
) -> None:
    """Two boards of four triangles; pads of the first board's second triangle are touched."""
    touched = np.zeros(SHAPE, bool)
    touched[1, :pads] = True
    felt = TouchedPads.of(touched, b"", 2)
    assert felt.calm.tolist() == [False] * 4 + [True] * 4
    assert felt.elsewhere.tolist() == [True, False, True, True] + [False] * 4
    slow = 1.0 / 6.0
    assert felt.weight[4:].tolist() == np.ones((4, 12)).tolist()
    assert felt.weight[[0, 2, 3]].tolist() == np.full((3, 12), slow).tolist()
    # Where two are touched, each feels something else than itself.
    assert felt.weight[1].tolist() == [1.0 if pads == 1 else slow] * pads + [slow] * (12 - pads)


@pytest.mark.parametrize("value", [0, 255])
def test_a_pad_at_an_end_of_its_scale_is_not_called_stuck(value: int) -> None:
    watched, rng = lively()
    for _ in range(400):
        raw = to_bytes(240.3 + 0.8 * rng.standard_normal(SHAPE))
        raw[1, 5] = value
        watched.show(raw)
    assert not watched.pads.stuck.any()


# ---------------------------------------------------------------------- compensation


def sent(words: np.ndarray, gain: tuple[int, ...], shift: int, truncates: bool) -> np.ndarray:
    """Bytes uint8[K, 12] of what the chips say, their zero being at 20000."""
    transmit = transmit_16 if truncates else transmit_32
    values, _ = transmit(
        words.astype(np.uint16),
        np.full(SHAPE, 20000, np.int32),
        np.full(K, shift, np.int32),
        np.full(K, NO_LOAD, np.int32),
        np.tile(np.array(gain, np.int32), (K, 1)),
        np.full(K, THERMAL_TAXEL, np.intp),
    )
    return values


@given(
    st.sampled_from([GAIN, GAIN_V2, NO_GAIN]),
    st.integers(0, 4),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=60, deadline=None)
def test_a_word_that_stays_is_a_repetition_whatever_is_taken_from_it(
    gain: tuple[int, ...], shift: int, truncates: bool, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    repeats = Repeats([Encoding(gain, shift, NO_LOAD, truncates)] * K)
    held = 20000 + rng.integers(-10, 60, SHAPE)
    raw, seen = np.zeros(SHAPE, np.uint8), np.zeros(SHAPE, bool)
    for _ in range(40):
        held[:, THERMAL_TAXEL] = 20000 + rng.integers(-12, 13, K)
        before, raw = raw, sent(held, gain, shift, truncates)
        inside = (raw > 0) & (raw < 255)
        moved, _ = repeats.step(raw, raw != before, inside)
        inside[:, THERMAL_TAXEL] = False
        seen, before_seen = seen | inside, seen
        assert not (moved & before_seen & inside).any()


def test_bytes_without_compensation_or_too_coarse_to_show_it_are_compared_themselves() -> None:
    changed = np.arange(12 * K).reshape(SHAPE) % 3 == 0
    raw = np.full(SHAPE, NO_LOAD, np.uint8)
    for gain, shift in ((NO_GAIN, 2), (GAIN, stuck.MOST_SHIFT + 1), (NO_GAIN, 6)):
        repeats = Repeats([Encoding(gain, shift, NO_LOAD, False)] * K)
        assert not repeats.shifted.any()
        moved, told = repeats.step(raw, changed, None)
        assert moved.tolist() == changed.tolist()
        assert told is None
    assert Repeats([Encoding(GAIN, stuck.MOST_SHIFT, NO_LOAD, False)] * K).shifted.any()


def test_noise_that_the_compensation_adds_is_not_the_pads_own() -> None:
    """But half of the byte's noise always is: both are estimates."""
    repeats = Repeats([Encoding(GAIN, 2, NO_LOAD, False)] * K)
    gain = np.array(GAIN) / 128
    others = np.delete(np.arange(12), THERMAL_TAXEL)
    for thermal in (0.0, 1.0, 20.0):
        noise = np.full(SHAPE, 2.0)
        noise[:, THERMAL_TAXEL] = thermal
        own = np.sqrt(np.maximum(2.0**2 - (gain * thermal) ** 2, 1.0))
        assert repeats.own_noise(noise)[3, others] == pytest.approx(own[others])


@pytest.mark.parametrize("end", [0, 255])
def test_nothing_shows_where_the_thermal_pad_is_at_an_end_of_its_scale(end: int) -> None:
    rng = np.random.default_rng(3)
    repeats = Repeats([Encoding(GAIN, 2, NO_LOAD, False)] * K)
    before = np.full(SHAPE, NO_LOAD, np.uint8)
    repeats.step(before, np.ones(SHAPE, bool), np.ones(SHAPE, bool))
    raw = rng.integers(100, 200, SHAPE).astype(np.uint8)
    raw[2, THERMAL_TAXEL] = end
    moved, told = repeats.step(raw, raw != before, inside(raw))
    others = np.delete(np.arange(K), 2)
    assert not moved[2].any()
    assert not told[2].any()
    assert moved[others].all()
    assert told[others].all()


@pytest.mark.parametrize("end", [0, 255])
def test_of_triangles_without_compensation_only_the_end_of_a_pads_own_scale_hides_its_moves(
    end: int,
) -> None:
    """They may be of a board whose other triangles are compensated."""
    plain, compensated = Encoding(NO_GAIN, 2, NO_LOAD, False), Encoding(GAIN, 2, NO_LOAD, False)
    repeats = Repeats([compensated, plain, compensated, plain])
    before = np.full((4, 12), NO_LOAD, np.uint8)
    before[:, THERMAL_TAXEL] = end
    repeats.step(before, np.ones((4, 12), bool), inside(before))
    raw = before.copy()
    raw[:, :3] -= 40
    moved, told = repeats.step(raw, raw != before, inside(raw))
    assert not told[[0, 2]].any()
    assert not moved[[0, 2]].any()
    for triangle in (1, 3):
        assert np.flatnonzero(moved[triangle]).tolist() == [0, 1, 2]
        assert np.flatnonzero(~told[triangle]).tolist() == [THERMAL_TAXEL]


def test_a_stuck_pad_is_found_though_the_noise_of_the_thermal_pad_moves_its_byte() -> None:
    rng = np.random.default_rng(3)
    repeats = Repeats([Encoding(GAIN, 2, NO_LOAD, False)] * K)

    def sweep() -> np.ndarray:
        return np.rint(20000 + 3.0 * rng.standard_normal(SHAPE))

    seen = np.array([sent(sweep(), GAIN, 2, False) for _ in range(100)])
    watched = Watched(seen, repeats)
    for _ in range(2000):
        watched.show(sent(sweep(), GAIN, 2, False))
    assert watched.accusations == 0
    held, changes = sweep(), 0
    for _ in range(240):
        words = sweep()
        words[2, [0, 1, 9]] = held[2, [0, 1, 9]]
        before = watched.raw
        watched.show(sent(words, GAIN, 2, False))
        changes += np.count_nonzero((watched.raw != before)[2, [0, 1, 9]])
    assert changes > 30
    assert np.argwhere(watched.pads.stuck).tolist() == [[2, 0], [2, 1], [2, 9]]


@pytest.mark.parametrize("gain", [GAIN, GAIN_V2], ids=["type 0", "type 8"])
@pytest.mark.parametrize(("shift", "sigma"), [(2, 0.5), (3, 0.25), (3, 0.4), (4, 0.2)])
@pytest.mark.parametrize("thermal_share", [0.5, 1.0])
@pytest.mark.parametrize("colder", [-1.0, 1.0])
def test_quiet_pads_that_are_compensated_are_not_accused_when_it_becomes_warmer_or_colder(
    gain: tuple[int, ...], shift: int, sigma: float, thermal_share: float, colder: float
) -> None:
    """One word may explain more bytes of a pad then, and a temperature pad may come to rest in one
    byte, so that its noise no longer moves the others against the edges of theirs.
    """
    rng = np.random.default_rng(3)
    repeats = Repeats([Encoding(gain, shift, NO_LOAD, False)] * K)
    centre = 20000 + rng.uniform(-20, 20, SHAPE)
    others = np.delete(np.arange(12), THERMAL_TAXEL)
    share = np.array(gain) / 128

    def sweep(change: float) -> np.ndarray:
        noise = sigma * 2**shift * rng.standard_normal(SHAPE)
        words = centre + change * share + noise
        words[:, THERMAL_TAXEL] = 20000 + change + thermal_share * noise[:, THERMAL_TAXEL]
        return sent(np.rint(words), gain, shift, False)

    watched = Watched(np.array([sweep(15.0 * colder) for _ in range(100)]), repeats)
    for change in np.linspace(15.0, -15.0, 4000) * colder:
        watched.show(sweep(change))
        assert not watched.pads.stuck[:, others].any()


def test_damaged_bytes_of_the_thermal_pad_show_no_life_of_those_compensated_with_it() -> None:
    rng = np.random.default_rng(3)
    repeats = Repeats([Encoding(GAIN, 2, NO_LOAD, False)] * K)

    def sweep() -> np.ndarray:
        return np.rint(20000 + 3.0 * rng.standard_normal(SHAPE))

    watched = Watched(np.array([sent(sweep(), GAIN, 2, False) for _ in range(100)]), repeats)
    held = sweep()
    for number in range(600):
        words = sweep()
        words[2, [0, 1]] = held[2, [0, 1]]
        raw = sent(words, GAIN, 2, False)
        if number > 300 and number % 20 == 0:
            raw[2, THERMAL_TAXEL] ^= 64
        watched.show(raw)
        if number > 300:
            assert np.argwhere(watched.pads.stuck).tolist() == [[2, 0], [2, 1]]


@pytest.mark.parametrize("gain", [GAIN, GAIN_V2], ids=["type 0", "type 8"])
@pytest.mark.parametrize("shift", range(stuck.MOST_SHIFT + 1))
def test_a_pad_has_moved_when_no_word_explains_all_its_bytes(
    shift: int, gain: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(shift)
    lowest, pattern = stuck._words(gain, shift, NO_LOAD, True)
    repeats = Repeats([Encoding(gain, shift, NO_LOAD, True)])
    words: list[set[int]] = [set() for _ in range(12)]
    raw = np.full((1, 12), 240, np.uint8)
    for _ in range(400):
        before, raw = raw, np.clip(raw + rng.integers(-1, 2, (1, 12)), 0, 255).astype(np.uint8)
        if rng.random() < 0.1:
            raw[0, rng.integers(12)] = rng.integers(256)
        within = inside(raw) & inside(before)
        every = within.all()
        moved, _ = repeats.step(raw, raw != before, None if every else within)
        thermal = int(raw[0, THERMAL_TAXEL])
        for pad in range(12):
            if not within[0, pad] or not 0 < thermal < 255:
                assert not moved[0, pad]
                continue
            base = int(lowest[thermal, pad]) - (int(raw[0, pad]) << shift)
            bits = int(pattern[thermal, pad])
            now = {base + bit for bit in range(bits.bit_length()) if bits >> bit & 1}
            assert moved[0, pad] == words[pad].isdisjoint(now)
            words[pad] = words[pad] & now or now


@pytest.mark.parametrize("board", [0, 1])
def test_what_a_board_learns_of_its_pads_does_not_depend_on_whether_another_sends(
    board: int,
) -> None:
    rng = np.random.default_rng(2)
    both, alone = (
        StuckPads(
            np.full(SHAPE, 0.4),
            np.ones(K),
            np.full(K, PERIOD_S),
            Repeats([Encoding(NO_GAIN, 2, NO_LOAD, False)] * K),
            2,
        )
        for _ in ("both", "alone")
    )
    before = alone.longest.copy()
    came = np.arange(2) == board
    mine = np.repeat(came, K // 2)
    sent = to_bytes(239.8 + 0.4 * rng.standard_normal((2 * stuck.STEP_SAMPLES + 1, *SHAPE)))
    for last, raw in pairwise(sent):
        changed = raw != last
        both.step(raw, changed, None, NO)
        here = mine[:, None]
        alone.step(raw, changed & here, inside(raw) & here, NO, came=came)
    assert (alone.longest[mine] == both.longest[mine]).all()
    assert (alone.longest[mine] != before[mine]).all()
    assert (alone.longest[~mine] == before[~mine]).all()
