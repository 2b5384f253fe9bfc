"""Pads that scatter beyond their range are found; those that measure what presses them are not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skin_host.evaluation.rig import Rig
from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.scatter import (
    LONGEST_BESIDE_S,
    LONGEST_S,
    MEMORY_CONVERSIONS,
    Scatter,
)
from tests.processing.fitting.test_course import use_own_curves

#: A pad of the usual units: one is 8 kPa, and a step of 8 units is six deviations of its noise.
UNIT_KPA = 8.0
STEP_KPA = 64.0
NOISE_KPA = STEP_KPA / 6.0
RANGE_KPA = 300.0
PADS = 12
PERIODS_S = (0.01, 0.02, 0.05, 0.1)


def look(scatter: Scatter, rows: np.ndarray, period_s: float = 0.05) -> list[int]:
    return scatter.look(rows, [period_s] * len(rows), rows.max(axis=0)).tolist()


def watching(m: int, range_kpa: float = RANGE_KPA, step_kpa: float = STEP_KPA) -> Scatter:
    """Pads of one chip."""
    every = np.ones(m, np.float32)
    return Scatter(step_kpa * every, range_kpa * every, np.roll(np.arange(m), -1))


def found(
    kpa: np.ndarray, period_s: float, range_kpa: float = RANGE_KPA, step_kpa: float = STEP_KPA
) -> set[int]:
    """Which of the pads [t, m] are found at any time, looked at as the pipeline does."""
    scatter = watching(kpa.shape[1], range_kpa, step_kpa)
    rows = kpa.astype(np.float32)
    pads: set[int] = set()
    for begin in range(0, len(rows) - 7, 8):
        pads.update(look(scatter, rows[begin : begin + 8], period_s))
    return pads


def read(kpa: np.ndarray, t_s: np.ndarray) -> np.ndarray:
    """What boards send of pads [c, m] that are converted every `CONVERSION_S`, in whole units."""
    at = np.minimum((t_s / CONVERSION_S).astype(np.intp), len(kpa) - 1)
    sent: np.ndarray = np.rint(kpa[at] / UNIT_KPA) * UNIT_KPA
    return sent


def times(seconds: float, period_s: float) -> tuple[np.ndarray, np.ndarray]:
    """When pads are converted, and when they are sent: a slow board converts when it is asked."""
    sent_s = np.arange(round(seconds / period_s)) * period_s
    if period_s >= CONVERSION_S:
        return sent_s, sent_s
    return np.arange(round(seconds / CONVERSION_S) + 1) * CONVERSION_S, sent_s


def noise(kind: str, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    if kind == "white":
        return rng.normal(size=shape)
    if kind == "heavy":
        return rng.standard_t(3, size=shape) / np.sqrt(3.0)
    slow = rng.normal(size=shape)
    for row in range(1, len(slow)):
        slow[row] = 0.9 * slow[row - 1] + np.sqrt(1.0 - 0.9**2) * slow[row]
    return slow


def pressed(kind: str, t_s: np.ndarray, hz: float, rng: np.random.Generator) -> np.ndarray:
    """Pressures [t, PADS] of up to 700 kPa, far beyond the range."""
    kpa = np.zeros((len(t_s), PADS))
    for pad in range(PADS):
        lasts_s = np.maximum(rng.normal(1.0, 0.08, int(2.0 * hz * t_s[-1]) + 2), 0.5) / hz
        begins_s = np.cumsum(lasts_s) - lasts_s[0]
        number = np.searchsorted(begins_s, t_s, side="right") - 1
        phase = (t_s - begins_s[number]) / lasts_s[number]
        peak = rng.uniform(300.0, 700.0, len(lasts_s))[number]
        if kind == "taps":
            kpa[:, pad] = np.where(phase < 0.6, peak * np.sin(np.pi * phase / 0.6), 0.0)
        elif kind == "short taps on a load":
            kpa[:, pad] = 150.0 + np.where(phase < 0.3, peak * np.sin(np.pi * phase / 0.3), 0.0)
        elif kind == "steps":
            kpa[:, pad] = peak
        elif kind == "sliding":
            kpa[:, pad] = peak * np.exp(-0.5 * ((phase - 0.5) / 0.1) ** 2)
        else:
            kpa[:, pad] = 400.0 + 200.0 * np.sin(2.0 * np.pi * phase)
    return kpa


def measured(
    kind: str, hz: float, period_s: float, noisy: str = "white", seconds: float = 30.0
) -> np.ndarray:
    rng = np.random.default_rng(5)
    converted_s, sent_s = times(seconds, period_s)
    kpa = pressed(kind, converted_s, hz, rng)
    kpa += NOISE_KPA * noise(noisy, kpa.shape, rng)
    return kpa if period_s >= CONVERSION_S else read(kpa, sent_s)


@pytest.mark.parametrize("period_s", PERIODS_S)
@pytest.mark.parametrize("levels", [2, 3, 0])
def test_a_pad_that_reads_another_value_with_each_conversion_is_found_at_any_rate(
    period_s: float, levels: int
):
    rng = np.random.default_rng(3)
    converted_s, sent_s = times(30.0, period_s)
    shape = (len(converted_s), PADS)
    at = rng.integers(levels, size=shape) - 0.5 * (levels - 1) if levels else rng.normal(size=shape)
    kpa = 450.0 + 12.0 * UNIT_KPA * at / np.std(at)
    sent = read(kpa, sent_s) if period_s < CONVERSION_S else kpa
    assert found(sent, period_s) == set(range(PADS))


@pytest.mark.parametrize("period_s", [0.05, 0.1])
@pytest.mark.parametrize("step_kpa", [STEP_KPA, 2.5 * STEP_KPA])
@given(seed=st.integers(0, 1000), opens=st.floats(0.02, 0.13), scatter=st.floats(0.65, 1.0))
@settings(max_examples=10, deadline=None)
def test_a_broken_contact_that_also_opens_now_and_then_is_found(
    step_kpa: float, period_s: float, seed: int, opens: float, scatter: float
):
    """It falls to what a released pad reads, but more seldom than a hand would release."""
    rng = np.random.default_rng(seed)
    shape = (600, PADS)
    levels = np.sqrt(2.0) * rng.choice([-1.0, 0.0, 0.0, 1.0], shape)
    opened = rng.random(shape) < opens
    kpa = step_kpa * (8.0 + scatter * levels)
    kpa = np.where(opened, rng.uniform(0.0, 100.0, shape), kpa)
    kpa += step_kpa / 6.0 * rng.normal(size=shape)
    assert len(found(kpa, period_s, step_kpa=step_kpa)) >= PADS - 1


@pytest.mark.parametrize("shape", ["half waves", "held"])
@pytest.mark.parametrize("step_kpa", [STEP_KPA, 2.5 * STEP_KPA])
@pytest.mark.parametrize("hz", [4.0, 5.1, 6.5, 8.0])
def test_taps_that_last_longer_than_their_releases_are_no_scatter_at_ten_sweeps_a_second(
    hz: float, step_kpa: float, shape: str
):
    """So seldom are they read that each reading shows another tap, or twice the same moment."""
    t_s, rng = np.arange(600) * 0.1, np.random.default_rng(9)
    phase = (t_s[:, np.newaxis] * hz + rng.uniform(size=PADS)) % 1.0
    pressed = np.clip(phase / 0.65, 0.0, 1.0)
    wave = (
        np.sin(np.pi * pressed)
        if shape == "half waves"
        else 4.0 * np.minimum(pressed, 1.0 - pressed)
    )
    kpa = rng.uniform(300.0, 700.0, phase.shape) * np.clip(wave, 0.0, 1.0)
    kpa += step_kpa / 6.0 * rng.normal(size=kpa.shape)
    assert not found(kpa, 0.1, step_kpa=step_kpa)


@pytest.mark.parametrize("period_s", PERIODS_S)
@pytest.mark.parametrize("hz", [1.0, 3.0, 5.0, 6.5, 8.0])
def test_taps_beyond_the_range_are_no_scatter_at_any_rate(period_s: float, hz: float):
    assert not found(measured("taps", hz, period_s), period_s)


@pytest.mark.parametrize("period_s", PERIODS_S)
@pytest.mark.parametrize(
    ("kind", "hz"),
    [
        ("short taps on a load", 1.0),
        ("short taps on a load", 3.0),
        ("steps", 0.3),
        ("steps", 1.0),
        ("sliding", 1.0),
        ("sliding", 3.0),
        ("pumped without a release", 0.5),
        ("pumped without a release", 2.0),
    ],
)
def test_no_press_that_goes_beyond_the_range_is_scatter(kind: str, hz: float, period_s: float):
    assert not found(measured(kind, hz, period_s), period_s)


@pytest.mark.parametrize("period_s", [*PERIODS_S, 0.2])
@pytest.mark.parametrize("kind", ["white", "slow", "heavy"])
def test_noise_beyond_the_range_is_no_scatter(kind: str, period_s: float):
    rng = np.random.default_rng(2)
    converted_s, sent_s = times(100.0, period_s)
    kpa = 400.0 + NOISE_KPA * noise(kind, (len(converted_s), 50), rng)
    assert not found(read(kpa, sent_s) if period_s < CONVERSION_S else kpa, period_s)


@given(
    seed=st.integers(0, 1000),
    share=st.floats(0.1, 1.5),
    level_kpa=st.floats(310.0, 2000.0),
    period_s=st.sampled_from(PERIODS_S),
)
@settings(max_examples=20, deadline=None)
def test_noise_up_to_one_and_a_half_times_what_was_measured_is_no_scatter(
    seed: int, share: float, level_kpa: float, period_s: float
):
    rng = np.random.default_rng(seed)
    kpa = level_kpa + share * NOISE_KPA * rng.normal(size=(600, PADS))
    assert not found(kpa, period_s)


def test_what_scatters_within_its_range_is_not_found():
    rng = np.random.default_rng(3)
    kpa = 450.0 + 12.0 * UNIT_KPA * rng.normal(size=(600, PADS))
    assert found(kpa, 0.05) == set(range(PADS))
    assert not found(kpa, 0.05, range_kpa=float(kpa.max()))
    assert not found(kpa, 0.05, range_kpa=np.inf)


def test_readings_too_far_apart_for_one_move_of_a_hand_show_a_broken_chip_but_no_single_pad():
    rng = np.random.default_rng(3)
    kpa = 450.0 + 12.0 * UNIT_KPA * rng.normal(size=(600, PADS))
    every, alone = set(range(PADS)), kpa.copy()
    alone[:, 1:] = 450.0
    assert found(kpa, LONGEST_S) == every
    assert found(alone, LONGEST_S) == {0}
    assert found(kpa, LONGEST_S + 0.001) == found(kpa, LONGEST_BESIDE_S) == every
    assert not found(alone, LONGEST_S + 0.001)
    assert not found(kpa[:, :1], LONGEST_S + 0.001)
    assert not found(kpa, LONGEST_BESIDE_S + 0.001)


#: Of pads that one press moves: by how much each takes part in it.
GAINS = {
    "alike": np.ones(PADS),
    "less at its edge": np.linspace(0.4, 1.0, PADS),
    "rocking": np.linspace(-1.0, 1.0, PADS),
}


@pytest.mark.parametrize("gains", GAINS)
@pytest.mark.parametrize("period_s", [0.13, 0.2, 0.25])
@given(seed=st.integers(0, 1000), hz=st.floats(0.3, 5.0), irregular=st.booleans())
@settings(max_examples=10, deadline=None)
def test_a_press_beyond_the_range_that_moves_the_pads_of_a_chip_together_is_no_scatter(
    period_s: float, gains: str, seed: int, hz: float, irregular: bool
):
    """However often it moves to and fro between two sweeps, and without any release."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(400) * period_s
    wave = rng.normal(size=400) if irregular else np.sqrt(2.0) * np.sin(2.0 * np.pi * hz * t_s)
    moves = 100.0 * np.clip(wave, -1.5, 1.5)
    kpa = 450.0 + moves[:, np.newaxis] * GAINS[gains] + NOISE_KPA * rng.normal(size=(400, PADS))
    assert not found(kpa, period_s)


@pytest.mark.parametrize("period_s", [0.13, 0.2])
@pytest.mark.parametrize("hz", [1.0, 2.0, 3.0, 4.5, 6.5])
@pytest.mark.parametrize("kind", ["taps", "sliding"])
def test_slow_boards_show_no_scatter_where_presses_end(kind: str, hz: float, period_s: float):
    assert not found(measured(kind, hz, period_s, seconds=120.0), period_s)


def test_a_lost_sweep_costs_no_more_than_the_readings_beside_it():
    """A pad of quick boards is found by its own readings all the same."""
    rng = np.random.default_rng(3)
    kpa = 450.0 + 12.0 * UNIT_KPA * rng.normal(size=(600, PADS))
    kpa[:, 1:] = 450.0
    scatter, pads = watching(PADS), set()
    steps_s = np.where(np.arange(600) % 9 == 8, 0.2, 0.1)
    for begin in range(0, 600, 8):
        rows = kpa[begin : begin + 8].astype(np.float32)
        steps = steps_s[begin : begin + 8].tolist()
        pads.update(scatter.look(rows, steps, rows.max(axis=0)).tolist())
    assert pads == {0}


def scattering(rng: np.random.Generator, samples: int) -> np.ndarray:
    kpa: np.ndarray = 450.0 + 12.0 * UNIT_KPA * rng.normal(size=(samples, 2))
    return kpa.astype(np.float32)


def looked_at() -> Scatter:
    """Two pads that scatter and are nearly found."""
    scatter = watching(2)
    rng = np.random.default_rng(1)
    rows = scattering(rng, 400)
    for begin in range(0, 400, 4):
        if len(look(scatter, rows[begin : begin + 4])) == 2:
            return scatter
    raise AssertionError


@pytest.mark.parametrize("together", [2, 3, 5])
def test_a_pad_is_found_as_soon_however_many_samples_are_looked_at_together(together: int):
    rows = scattering(np.random.default_rng(4), 400)

    def found_after(count: int) -> int:
        scatter = watching(2)
        for begin in range(0, 400, count):
            if look(scatter, rows[begin : begin + count]):
                return begin + count
        raise AssertionError

    assert abs(found_after(together) - found_after(1)) < together


def test_a_new_zero_and_a_pause_forget_what_was_read():
    rows = scattering(np.random.default_rng(2), 4)
    for taxels, left in (([True, False], [1]), ([False, False], [0, 1]), ([True, True], [])):
        scatter = looked_at()
        scatter.reset(np.array(taxels))
        assert look(scatter, rows) == left
    scatter = looked_at()
    scatter.wait()
    assert not look(scatter, rows)


def test_a_pad_that_reads_steadily_again_is_not_found_any_more():
    scatter = looked_at()
    steady = np.full((8, 2), 400.0, np.float32)
    for _ in range(3 * MEMORY_CONVERSIONS // 8):
        look(scatter, steady)
    assert not look(scatter, steady)


def test_samples_that_come_one_by_one_are_judged_like_those_that_come_together():
    rows = scattering(np.random.default_rng(4), 640)
    each = [watching(2, range_kpa=0.0) for _ in range(2)]
    many = [look(each[0], rows[k : k + 8]) for k in range(0, 640, 8)]
    few = [look(each[1], rows[k : k + 1]) for k in range(640)][7::8]
    assert [0, 1] in many
    assert np.mean([a == b for a, b in zip(many, few, strict=True)]) > 0.9


@pytest.mark.parametrize("hz", [10.0, 20.0, 50.0])
def test_a_pressed_pad_whose_contact_breaks_is_not_valid_and_the_others_stay_so(hz: float):
    """Levels as far apart as those of recorded real skin, beyond the 60 units that are known."""
    rig = Rig(1, 0.3, seed=5, hz=hz)
    use_own_curves(rig, 4.0)
    rng = np.random.default_rng(1)
    pressed, broken = np.arange(rig.n) < 12, np.arange(rig.n) == 3
    for _ in range(round(20.0 * hz)):
        off = 14.0 + rng.choice([-20.0, 0.0, 0.0, 20.0])
        frame = rig.step(np.where(pressed, 48.0, 0.0) + np.where(broken, off, 0.0))
    assert np.flatnonzero(~frame.valid).tolist() == [3]
