"""Readings after a silence show whether the board zeroed itself meanwhile."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.silent_zero import SWEEPS, SilentZero

NO_LOAD = 240.0
PERIOD_S = 0.05
N = 48


class Skin:
    """Pads with noise of their own, which a first zero left off by the noise of one reading.

    Args:
        seed: of all that is drawn.
        slow_share: how much of the noise lasts for longer than the comparison.
        n: pads.
    """

    def __init__(self, seed: int, slow_share: float = 0.0, n: int = N) -> None:
        self.rng = np.random.default_rng(seed)
        self.noise = self.rng.uniform(0.3, 3.0, n)
        self.slow = np.sqrt(slow_share) * self.noise
        self.fast = np.sqrt(1.0 - slow_share) * self.noise
        # A measurement of the slow part is no better for being repeated.
        self.spread = np.hypot(self.fast, self.slow / np.sqrt(0.0369))
        self.baseline = self.noise * self.rng.standard_normal(n)
        self.known = np.ones(n, np.bool_)

    def evidence(
        self,
        zeroed: bool,
        *,
        common_units: float = 0.0,
        own_units: float = 0.0,
        unlike: float = 0.0,
        pressed: slice = slice(0),
        press_units: float | NDArray[np.float64] = 20.0,
        silent_s: float = 3.0,
    ) -> tuple[bool | None, float]:
        """Return what is decided, and the evidence, after a silence in which all pads drifted by
        `common_units`, each by up to `own_units` and by a share of the common drift whose standard
        deviation is `unlike`, and some were pressed.
        """
        n = len(self.noise)
        rest = self.noise * self.rng.standard_normal(n) if zeroed else self.baseline
        rest = rest + common_units + own_units * self.rng.uniform(-1.0, 1.0, n)
        rest += unlike * common_units * self.rng.standard_normal(n)
        rest = rest + self.slow * self.rng.standard_normal(n)
        rest[pressed] += press_units
        test = SilentZero(
            self.baseline, self.noise, self.spread, self.known, NO_LOAD, PERIOD_S, silent_s
        )
        found = None
        for sweep in range(SWEEPS):
            assert found is None, sweep
            raw = np.rint(NO_LOAD - rest - self.fast * self.rng.standard_normal(n))
            received = np.clip(raw, 0, 255).astype(np.uint8), np.ones(n, np.bool_)
            found = test.step(*received, round(sweep * PERIOD_S * 1e9))
        return found, test.evidence()


SEEDS = st.integers(0, 10_000)
COMMON = st.floats(-1.0, 1.0)
SLOW = st.sampled_from([0.0, 0.05, 0.2])


@given(SEEDS, COMMON, SLOW, st.integers(0, 8))
def test_a_board_that_was_not_zeroed_is_not_called_so(
    seed: int, common_units: float, slow_share: float, presses: int
) -> None:
    found, _ = Skin(seed, slow_share).evidence(
        False, common_units=common_units, own_units=0.5, pressed=slice(0, presses)
    )
    assert found is False


@given(SEEDS, COMMON, st.integers(0, 8))
def test_a_board_that_was_zeroed_is_recognised(
    seed: int, common_units: float, presses: int
) -> None:
    found, _ = Skin(seed).evidence(True, common_units=common_units, pressed=slice(0, presses))
    assert found is True


@given(SEEDS, st.floats(-6.0, 6.0))
def test_a_long_silence_in_which_it_became_warmer_is_no_zero(
    seed: int, common_units: float
) -> None:
    found, _ = Skin(seed).evidence(False, common_units=common_units, own_units=2.0, silent_s=600.0)
    assert found is False


@pytest.mark.parametrize("common_units", [-6.0, -4.0, 4.0, 6.0])
def test_a_long_silence_in_which_pads_drifted_unlike_is_no_zero(common_units: float) -> None:
    """The emulated foam's drift differs by half of what the pads share."""
    found = [
        Skin(seed).evidence(False, common_units=common_units, unlike=0.5, silent_s=240.0)[0]
        for seed in range(200)
    ]
    assert np.mean(np.array(found, np.bool_)) < 0.1


@pytest.mark.parametrize("common_units", [-4.0, 0.0, 4.0])
def test_nearly_every_zero_in_a_long_silence_is_recognised_as_pads_drift(
    common_units: float,
) -> None:
    found = [
        Skin(seed).evidence(True, common_units=common_units, unlike=0.5, silent_s=240.0)[0]
        for seed in range(200)
    ]
    assert np.mean(np.array(found, np.bool_)) > 0.98


def at_start(seed: int, zeroed: bool, common_units: float, own_units: float) -> bool | None:
    """Return what is decided where nobody knows how long the board was not received."""
    return Skin(seed).evidence(
        zeroed, common_units=common_units, own_units=own_units, silent_s=math.inf
    )[0]


@given(SEEDS, st.floats(-6.0, 6.0), st.floats(0.0, 2.0))
def test_no_drift_is_taken_for_a_zero_at_a_start(
    seed: int, common_units: float, own_units: float
) -> None:
    assert at_start(seed, False, common_units, own_units) is False


@pytest.mark.parametrize("common_units", [-1.0, 0.0, 1.0])
def test_nearly_every_zero_of_a_moment_ago_is_recognised_at_a_start(common_units: float) -> None:
    found = [at_start(seed, True, common_units, own_units=0.3) is True for seed in range(200)]
    assert np.mean(found) > 0.99


def test_few_zeros_before_a_winter_are_missed_at_a_start() -> None:
    assert np.mean([at_start(seed, True, 6.0, 2.0) is True for seed in range(200)]) > 0.8


def quiet(seed: int, zeroed: bool) -> bool | None:
    """Return what is decided of a small board with little noise."""
    skin = Skin(seed, n=24)
    skin.noise = skin.fast = skin.spread = skin.rng.uniform(0.5, 0.8, 24)
    skin.baseline = skin.noise * skin.rng.standard_normal(24)
    return skin.evidence(zeroed, own_units=0.5, pressed=slice(0, 2))[0]


def test_few_zeros_of_a_small_board_with_little_noise_are_missed_and_none_invented() -> None:
    assert np.mean([quiet(seed, zeroed=True) is True for seed in range(200)]) > 0.8
    assert not any(quiet(seed, zeroed=False) for seed in range(200))


def test_slow_noise_hides_few_zeros() -> None:
    found = [Skin(seed, 0.05, 192).evidence(True)[0] for seed in range(100)]
    assert np.mean(np.array(found, np.bool_)) > 0.95


@pytest.mark.parametrize("zeroed", [False, True])
def test_a_board_whose_pads_are_all_touched_keeps_its_zero(zeroed: bool) -> None:
    skin = Skin(1)
    skin.known[:] = False
    assert skin.evidence(zeroed) == (False, 0.0)


def test_baselines_near_zero_decide_nothing() -> None:
    """Whether quiet pads that rest at zero were zeroed again changes nothing."""
    skin = Skin(2)
    skin.noise[:] = skin.fast[:] = skin.spread[:] = 0.05
    skin.baseline[:] = 0.0
    for zeroed in (False, True):
        found, evidence = skin.evidence(zeroed)
        assert found is False
        assert abs(evidence) < 1.0


def test_one_firm_press_where_a_zero_would_be_is_no_zero() -> None:
    """A pad that rests at -3 units and is pressed to 0 is one of many."""
    skin = Skin(3)
    skin.baseline[0] = -3.0
    found, _ = skin.evidence(False, pressed=slice(0, 1), press_units=3.0)
    assert found is False


@pytest.mark.parametrize("silent_s", [0.2, 1.0, 30.0])
def test_a_load_on_all_pads_that_begins_in_a_silence_is_no_zero(silent_s: float) -> None:
    """Pads differ in what the same load makes them read: neither a zero nor none explains it."""
    everything = slice(0, N)
    for seed in range(50):
        skin = Skin(seed)
        press_units = 10.0 * skin.rng.uniform(0.6, 1.6, N)
        found, _ = skin.evidence(
            False, pressed=everything, press_units=press_units, silent_s=silent_s
        )
        assert found is False, seed


def test_pads_that_are_hardly_received_do_not_count() -> None:
    skin = Skin(4)
    test = SilentZero(skin.baseline, skin.noise, skin.spread, skin.known, NO_LOAD, PERIOD_S, 3.0)
    raw = np.full(N, NO_LOAD).astype(np.uint8)
    period_ns = round(PERIOD_S * 1e9)
    found = [test.step(raw, np.full(N, number < 4), number * period_ns) for number in range(SWEEPS)]
    assert found == [None] * (SWEEPS - 1) + [False]
    assert test.evidence() == 0.0


@pytest.mark.parametrize("apart_ms", [0.0, 2.0, 20.0])
def test_sweeps_that_waited_on_the_way_may_be_from_before_the_zero(apart_ms: float) -> None:
    """They were compared, too, and half of them hid the zero."""
    skin = Skin(3)
    test = SilentZero(skin.baseline, skin.noise, skin.spread, skin.known, NO_LOAD, PERIOD_S, 3.0)
    rest = skin.noise * skin.rng.standard_normal(N)
    t_ms, found = 0.0, None
    for sweep in range(6 + SWEEPS):
        before = sweep < 6
        t_ms += apart_ms if before else 1e3 * PERIOD_S
        units = (skin.baseline if before else rest) + skin.fast * skin.rng.standard_normal(N)
        assert found is None
        raw = np.rint(NO_LOAD - units).astype(np.uint8)
        found = test.step(raw, skin.known, round(t_ms * 1e6))
    assert found


def test_a_board_that_sends_faster_than_it_was_set_up_to_is_decided_on() -> None:
    skin = Skin(4)
    test = SilentZero(skin.baseline, skin.noise, skin.spread, skin.known, NO_LOAD, PERIOD_S, 3.0)
    raw = np.rint(NO_LOAD - skin.baseline).astype(np.uint8)
    found = [test.step(raw, skin.known, 10_000_000 * sweep) for sweep in range(100)]
    decided = [sweep for sweep, one in enumerate(found) if one is not None]
    assert 0 < decided[0] < 60


def clear_after(
    skin: Skin,
    rest: NDArray[np.float64],
    *,
    period_s: float = PERIOD_S,
    silent_s: float = 0.1,
    touched: NDArray[np.bool_] | None = None,
    first: NDArray[np.float64] | None = None,
    still_units: NDArray[np.float64] | None = None,
) -> int | None:
    """Return after how many sweeps a board is clear, None if it is not before the decision, whose
    pads rest at so many units; in its first sweep elsewhere, if `first` is given. Chips convert.
    """
    if still_units is None:
        still_units = skin.baseline + np.maximum(4.0, 5.0 * skin.spread)
    known = skin.known if touched is None else skin.known & ~touched
    test = SilentZero(
        skin.baseline,
        skin.noise,
        skin.spread,
        known,
        NO_LOAD,
        period_s,
        silent_s,
        touched,
        still_units,
    )
    n, conversion, raw = len(known), -1, np.zeros(len(known), np.uint8)
    slow = skin.slow * skin.rng.standard_normal(n)
    for sweep in range(SWEEPS):
        here = rest if sweep or first is None else first
        now = math.floor(sweep * period_s / CONVERSION_S)
        if now != conversion or sweep == 1:
            conversion = now
            units = here + slow + skin.fast * skin.rng.standard_normal(n)
            raw = np.clip(np.rint(NO_LOAD - units), 0, 255).astype(np.uint8)
        found = test.step(raw, np.ones(n, np.bool_), round(sweep * period_s * 1e9))
        if test.clear:
            return sweep + 1
    assert found is not None
    return None


PERIODS = st.sampled_from([0.01, 0.02, 0.05, 0.1, 0.2])


@given(SEEDS, PERIODS, COMMON)
def test_many_noisy_pads_are_clear_after_one_conversion_and_two_sweeps(
    seed: int, period_s: float, common_units: float
) -> None:
    """The first sweep after a silence may have waited, so it does not count."""
    skin = Skin(seed, n=190)
    after = clear_after(skin, skin.baseline + common_units, period_s=period_s)
    assert after == 1 + max(2, math.ceil(CONVERSION_S / period_s))


Hard = Callable[[Skin], NDArray[np.float64]]


def zeroed(skin: Skin) -> NDArray[np.float64]:
    return skin.noise * skin.rng.standard_normal(len(skin.noise))


def pressed_meanwhile(skin: Skin) -> NDArray[np.float64]:
    """A third of the pads is pressed after the zero, by up to twenty units."""
    units = zeroed(skin)
    pressed = skin.rng.random(len(units)) < 1 / 3
    return units + pressed * skin.rng.uniform(0.0, 20.0, len(units))


def pressed_evenly(skin: Skin) -> NDArray[np.float64]:
    return zeroed(skin) + skin.rng.uniform(-2.0, 2.0)


@given(
    SEEDS,
    PERIODS,
    SLOW,
    st.sampled_from([1, 2, 3, 12, 48, 192]),
    st.sampled_from([zeroed, pressed_meanwhile, pressed_evenly]),
)
def test_a_board_that_was_zeroed_is_never_clear(
    seed: int, period_s: float, slow_share: float, pads: int, hard: Hard
) -> None:
    skin = Skin(seed, slow_share, n=pads)
    assert clear_after(skin, hard(skin), period_s=period_s) is None


@given(SEEDS, PERIODS, st.sampled_from([0.0, 0.05, 0.3]), st.sampled_from([2, 24, 192]))
def test_quiet_pads_whose_board_was_zeroed_are_never_clear(
    seed: int, period_s: float, noise: float, pads: int
) -> None:
    """Their bytes do not change, and they have drifted by up to a unit since they were zeroed."""
    skin = Skin(seed, n=pads)
    skin.noise[:] = skin.fast[:] = skin.spread[:] = noise
    skin.slow[:] = 0.0
    skin.baseline = skin.rng.uniform(-1.0, 1.0, pads)
    assert clear_after(skin, zeroed(skin), period_s=period_s) is None


@given(SEEDS, PERIODS, st.integers(1, N), st.booleans())
def test_a_board_that_was_zeroed_under_what_touches_it_is_never_clear(
    seed: int, period_s: float, touched: int, waited: bool
) -> None:
    """Its touched pads read none then, even if its first sweep waited and is from before."""
    skin = Skin(seed)
    held = np.arange(N) < touched
    first = skin.baseline + 30.0 * held if waited else None
    rest = zeroed(skin)
    assert clear_after(skin, rest, period_s=period_s, touched=held, first=first) is None


@given(SEEDS, PERIODS, st.integers(1, N))
def test_a_board_whose_touched_pads_still_are_is_clear(
    seed: int, period_s: float, touched: int
) -> None:
    """So it is where all its pads are touched, and no other shows that it was not zeroed."""
    skin = Skin(seed)
    held = np.arange(N) < touched
    after = clear_after(skin, skin.baseline + 40.0 * held, period_s=period_s, touched=held)
    assert after == 1 + max(2, math.ceil(CONVERSION_S / period_s))


@pytest.mark.parametrize(("silent_s", "after"), [(0.1, 3), (0.5, 3), (3.0, None)])
def test_untouched_pads_that_show_a_zero_count_for_more_than_a_touch_after_long_silences(
    silent_s: float, after: int | None
) -> None:
    """What touches a board may have lifted for its zero, and pressed again."""
    skin = Skin(5)
    held = np.arange(N) < 4
    rest = zeroed(skin) + 40.0 * held
    assert clear_after(skin, rest, silent_s=silent_s, touched=held) == after


@given(SEEDS, st.integers(2, 12))
def test_pads_pressed_lightly_beside_a_touch_are_no_zero_after_lost_sweeps(
    seed: int, lost: int
) -> None:
    """They rest elsewhere than their baselines, as after a zero. Then the touch ends."""
    skin = Skin(seed)
    held = np.arange(N) < N // 2
    test = SilentZero(
        skin.baseline,
        skin.noise,
        skin.spread,
        ~held,
        NO_LOAD,
        0.02,
        0.02 * lost,
        held,
        np.where(held, 20.0, np.inf),
    )
    lightly = skin.rng.uniform(-3.0, 3.0, N)
    found = None
    for sweep in range(SWEEPS):
        units = skin.baseline + lightly + 40.0 * (held & (sweep < 4))
        raw = np.clip(np.rint(NO_LOAD - units), 0, 255).astype(np.uint8)
        found = test.step(raw, np.ones(N, np.bool_), 20_000_000 * sweep)
    assert found is False


@given(SEEDS, PERIODS, st.floats(0.0, 0.45))
def test_a_touch_that_reads_less_than_half_of_before_shows_nothing(
    seed: int, period_s: float, share: float
) -> None:
    """Its pads may have been zeroed under it, and pressed more since."""
    skin = Skin(seed)
    held = np.ones(N, np.bool_)
    rest = zeroed(skin) + 60.0 * share
    still_units = np.full(N, 30.0)
    assert clear_after(skin, rest, period_s=period_s, touched=held, still_units=still_units) is None


def test_a_start_compares_all_its_sweeps() -> None:
    skin = Skin(6, n=190)
    assert clear_after(skin, skin.baseline, silent_s=math.inf) is None


@given(SEEDS, st.floats(-6.0, 6.0))
def test_a_short_silence_after_a_long_one_is_as_long(seed: int, common_units: float) -> None:
    """Nothing was known between them, so pads may have drifted apart as after the long one."""
    skin = Skin(seed)
    own_units = 2.0 * skin.rng.uniform(-1.0, 1.0, N)

    def after(silent_s: float, before: SilentZero | None) -> SilentZero:
        return SilentZero(
            skin.baseline,
            skin.noise,
            skin.spread,
            skin.known,
            NO_LOAD,
            PERIOD_S,
            silent_s,
            before=before,
        )

    test = after(0.3, after(600.0, None))
    found = None
    for sweep in range(SWEEPS):
        units = skin.baseline + common_units + own_units + skin.fast * skin.rng.standard_normal(N)
        raw = np.clip(np.rint(NO_LOAD - units), 0, 255).astype(np.uint8)
        found = test.step(raw, skin.known, round(sweep * PERIOD_S * 1e9))
    assert found is False


def test_a_board_is_not_clear_by_sweeps_that_waited_on_the_way() -> None:
    """What came in one go may all be from before the zero."""
    skin = Skin(6, n=190)
    test = SilentZero(skin.baseline, skin.noise, skin.spread, skin.known, NO_LOAD, PERIOD_S, 0.1)
    seen = []
    for t_ms in (0, 50, 100, 101, 151):
        units = skin.baseline + skin.fast * skin.rng.standard_normal(190)
        raw = np.clip(np.rint(NO_LOAD - units), 0, 255).astype(np.uint8)
        test.step(raw, skin.known, t_ms * 1_000_000)
        seen.append(test.clear)
    assert seen == [False, False, True, False, False]


def test_a_board_that_is_not_clear_at_once_may_be_so_later() -> None:
    """Half of the first sweeps read nearly what a zero would: two sweeps are too few to tell."""
    skin = Skin(7, n=24)
    skin.noise[:] = skin.fast[:] = skin.spread[:] = 1.0
    skin.slow[:] = 0.0
    skin.baseline = np.where(np.arange(24) % 2, 4.0, -4.0)
    test = SilentZero(skin.baseline, skin.noise, skin.spread, skin.known, NO_LOAD, PERIOD_S, 0.1)
    clear = []
    for sweep in range(SWEEPS - 1):
        share = 0.2 if sweep < 3 else 1.0
        raw = np.rint(NO_LOAD - share * skin.baseline).astype(np.uint8)
        test.step(raw, skin.known, round(sweep * PERIOD_S * 1e9))
        clear.append(test.clear)
    assert not any(clear[:3])
    assert clear[-1]


MINUTES = st.floats(200.0, 3600.0)


def drifted(
    moved_units: NDArray[np.float64],
    silent_s: float,
    warm_units: float | None = None,
    noise: float = 0.5,
    touched: slice = slice(0),
) -> NDArray[np.float64] | None:
    """Return by how much pads that moved so far are taken to have drifted in a silence.

    Args:
        moved_units: float64[n], of pads of pressure.
        silent_s: how long it was.
        warm_units: by how much six temperature pads moved; without it there are none.
        noise: of all.
        touched: those that something touched before.
    """
    n_warm = 0 if warm_units is None else 6
    n = len(moved_units) + n_warm
    moved = np.append(moved_units, np.full(n_warm, warm_units or 0.0))
    rng = np.random.default_rng(1)
    baseline = rng.uniform(-1.0, 1.0, n)
    spread = np.full(n, noise)
    pressure = np.arange(n) < len(moved_units)
    before = np.zeros(n, np.bool_)
    before[touched] = True
    test = SilentZero(
        baseline, spread, spread, ~before, NO_LOAD, PERIOD_S, silent_s, before, pressure=pressure
    )
    for sweep in range(SWEEPS):
        raw = np.rint(NO_LOAD - baseline - moved - noise * rng.standard_normal(n))
        t_ns = round(sweep * PERIOD_S * 1e9)
        test.step(np.clip(raw, 0, 255).astype(np.uint8), np.ones(n, np.bool_), t_ns)
    return test.drifted_units()


@given(st.floats(-8.0, 5.0), MINUTES)
def test_each_pad_has_drifted_by_what_it_reads_after_a_long_silence(
    common_units: float, silent_s: float
) -> None:
    most = min(common_units, 0.008 * silent_s)
    moved = most * np.linspace(0.6, 1.4, 40)
    found = drifted(moved, silent_s)
    assert found is not None
    np.testing.assert_allclose(found, moved, atol=1.0)


@given(MINUTES)
def test_pads_that_were_touched_and_read_what_the_others_do_have_drifted(silent_s: float) -> None:
    found = drifted(np.full(40, 1.5), silent_s, touched=slice(20))
    assert found is not None
    np.testing.assert_allclose(found, 1.5, atol=1.0)


@given(MINUTES)
def test_no_drift_is_known_where_much_that_was_touched_still_is(silent_s: float) -> None:
    assert drifted(np.repeat([8.0, 1.5], 20), silent_s, touched=slice(20)) is None


@given(MINUTES)
def test_what_a_few_pads_read_more_than_the_others_is_no_drift(silent_s: float) -> None:
    moved = np.full(40, 1.5)
    moved[:6] = 8.0
    found = drifted(moved, silent_s)
    assert found is not None
    np.testing.assert_allclose(found, 1.5, atol=1.0)


@given(st.floats(2.0, 8.0), st.floats(1.0, 100.0))
def test_what_rises_faster_than_drift_may_be_a_load(common_units: float, silent_s: float) -> None:
    assert drifted(np.full(40, common_units), silent_s) is None


@given(st.floats(2.0, 8.0), MINUTES)
def test_what_temperature_pads_do_not_show_may_be_a_load(
    common_units: float, silent_s: float
) -> None:
    moved = np.full(40, common_units)
    assert drifted(moved, silent_s, warm_units=0.0) is None
    assert drifted(moved, silent_s, warm_units=common_units) is not None


def test_half_of_a_board_that_rose_may_be_a_load() -> None:
    moved = np.where(np.arange(40) < 26, 3.0, 0.0)
    assert drifted(moved, 3600.0) is None


def test_a_board_that_may_have_drifted_is_not_clear_before_all_sweeps() -> None:
    """Its pads would be touched until then."""
    for silent_s, clear in ((10.0, True), (300.0, False)):
        n = 40
        baseline = np.random.default_rng(1).uniform(-6.0, 6.0, n)
        spread = np.full(n, 0.3)
        known = np.ones(n, np.bool_)
        test = SilentZero(baseline, spread, spread, known, NO_LOAD, PERIOD_S, silent_s)
        for sweep in range(SWEEPS - 1):
            raw = np.rint(NO_LOAD - baseline).astype(np.uint8)
            assert test.step(raw, known, round(sweep * PERIOD_S * 1e9)) is None
        assert test.clear is clear


@given(SEEDS, st.sampled_from([0.5, 30.0, 600.0, math.inf]), st.booleans())
def test_fine_units_are_judged_as_the_same_signals_in_usual_ones(
    seed: int, silent_s: float, zeroed: bool
) -> None:
    """Noise, baselines, drift and what was touched are four times as many units."""
    no_load, fineness = 128.0, 4.0
    skin = Skin(seed)
    touched = np.arange(N) < 4
    read_units = skin.baseline + skin.rng.standard_normal(N)
    pressure = np.arange(N) < 40

    def compared(fine: float) -> SilentZero:
        return SilentZero(
            *(fine * value for value in (skin.baseline, skin.noise, skin.spread)),
            skin.known & ~touched,
            no_load,
            PERIOD_S,
            silent_s,
            touched,
            np.full(N, fine * 6.0),
            read_units=fine * read_units,
            pressure=pressure,
            fineness=np.full(N, fine),
        )

    fine, usual = compared(fineness), compared(1.0)
    rest = np.rint(2.0 + (0.0 if zeroed else 1.0) * skin.baseline + 10.0 * touched)
    for sweep in range(SWEEPS):
        units = np.clip(rest + np.rint(skin.noise * skin.rng.standard_normal(N)), -31, 31)
        t_ns = round(sweep * PERIOD_S * 1e9)
        raw = [(no_load - scale * units).astype(np.uint8) for scale in (1.0, fineness)]
        found = usual.step(raw[0], skin.known, t_ns), fine.step(raw[1], skin.known, t_ns)
        assert found[0] is found[1]
        assert fine.clear is usual.clear
    assert fine.evidence() == pytest.approx(usual.evidence())
    drifted_units = usual.drifted_units()
    if drifted_units is None:
        assert fine.drifted_units() is None
    else:
        np.testing.assert_allclose(fine.drifted_units(), fineness * drifted_units)
