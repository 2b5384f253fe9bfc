"""Pads that jump up and down are found, and forgiven when they have been calm."""

import numpy as np
import pytest

from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.curves import KNOTS_UNITS, TableCurve
from skin_host.processing.erratic import LIMIT, RELIEF_PER_S, Erratic, quieter_of_chip, step_kpa
from skin_host.processing.pressure import PressureCurve

STEP_KPA = 5.0
PERIOD_S = 0.02


def samples(*kpa: float) -> np.ndarray:
    """The second of three pads; the first presses slowly, the third is quiet."""
    rows = np.zeros((len(kpa), 3), np.float32)
    rows[:, 0] = np.arange(len(kpa))
    rows[:, 1] = kpa
    return rows


def look(found: Erratic, *kpa: float, period_s: float = PERIOD_S) -> None:
    found.look(samples(*kpa), [period_s] * len(kpa))


def jumping(looks: int) -> Erratic:
    found = Erratic(np.array([STEP_KPA, STEP_KPA, np.inf]), np.full(3, np.inf), np.zeros(3, int))
    for _ in range(looks):
        look(found, 0, 9, 0, 9)
    return found


def tapping(
    presses_per_s: float, contact_s: float, hz: float, seconds: float, convert_s: float = 1e-9
) -> Erratic:
    """A pad that is tapped, converted and read so often, and looked at as the pipeline does."""
    found = jumping(0)
    t_s = np.arange(round(seconds * hz)) / hz
    converted_s = np.floor(t_s / convert_s) * convert_s
    phase_s = converted_s % (1.0 / presses_per_s)
    kpa = np.where(phase_s < contact_s, 20.0 * np.sin(np.pi * phase_s / contact_s), 0.0)
    for begin in range(0, len(kpa) - 7, 8):
        look(found, *kpa[begin : begin + 8], period_s=1.0 / hz)
    return found


def test_a_pad_that_jumps_again_and_again_is_erratic_and_the_others_are_not():
    assert not jumping(1).any
    found = jumping(3)
    assert found.any
    assert found.pads.tolist() == [False, True, False]


@pytest.mark.parametrize("hz", [10.0, 15.0, 20.0, 25.0, 49.0, 100.0])
@pytest.mark.parametrize("presses_per_s", [1.0, 2.0, 3.0, 4.9])
def test_tapping_is_no_broken_contact_at_any_rate_of_sweeps(hz: float, presses_per_s: float):
    contact_s = min(0.1, 0.6 / presses_per_s)
    assert not tapping(presses_per_s, contact_s, hz, 60.0).any


@pytest.mark.parametrize("hz", [20.0, 25.0, 49.0, 100.0])
@pytest.mark.parametrize("presses_per_s", [3.0, 4.0, 4.5, 4.7, 4.9])
@pytest.mark.parametrize("contact_s", [0.06, 0.1])
def test_tapping_is_no_broken_contact_where_a_chip_converts_more_seldom_than_it_is_read(
    hz: float, presses_per_s: float, contact_s: float
):
    """A press shows up to a conversion after it began: two may seem closer than they are."""
    assert not tapping(presses_per_s, contact_s, hz, 60.0, CONVERSION_S).any


@pytest.mark.parametrize("hz", [30.0, 49.0, 100.0])
def test_where_no_conversion_is_left_out_presses_that_no_hand_repeats_are_a_broken_contact(
    hz: float,
):
    assert tapping(6.5, 0.05, hz, 60.0, CONVERSION_S).any


@pytest.mark.parametrize("hz", [20.0, 49.0, 100.0])
def test_a_broken_contact_is_found_at_any_rate_of_sweeps(hz: float):
    found = jumping(0)
    rng = np.random.default_rng(3)
    # The contact opens and closes with each conversion of the chip.
    t_s = np.arange(round(10.0 * hz)) / hz
    levels = np.where(rng.random(round(10.0 / 0.037) + 1) < 0.5, 0.0, 9.0)
    kpa = levels[(t_s / 0.037).astype(np.int64)]
    for begin in range(0, len(kpa) - 7, 8):
        look(found, *kpa[begin : begin + 8], period_s=1.0 / hz)
    assert found.pads.tolist() == [False, True, False]


def test_seven_short_presses_a_second_are_a_broken_contact() -> None:
    """Each release is as long as those of a hand; presses do not follow each other so fast."""
    found = jumping(0)
    kpa = [9, 9, 0, 0, 0, 0, 0] * 16
    for begin in range(0, len(kpa), 8):
        look(found, *kpa[begin : begin + 8])
    assert found.pads.tolist() == [False, True, False]


def test_a_press_that_is_lost_for_some_samples_again_and_again_is_a_broken_contact():
    found = jumping(0)
    for _ in range(8):
        look(found, 9, 9, 0, 0, 9, 9, 9, 9)
        look(found, *[9] * 8)
    assert found.pads.tolist() == [False, True, False]


def test_jumps_that_are_read_less_than_three_times_as_often_as_a_hand_presses_may_be_presses():
    found = jumping(0)
    for _ in range(20):
        look(found, 0, 9, 0, 9, 0, 9, 0, 9, period_s=0.07)
    assert not found.suspects


def test_a_press_and_a_release_that_lie_far_apart_are_no_jumps():
    found = jumping(0)
    for _ in range(20):
        look(found, 0, 0, 0, 9, 9, 9, 9, 9)  # up
        look(found, 9, 9, 0, 0, 0, 0, 0, 0)  # and down in a later look
    assert not found.suspects


def test_jumps_count_across_looks_and_not_across_a_pause():
    for pause_s in (0.0, 0.2):
        found = jumping(0)
        look(found, 0, 9, 9, 0)
        found.wait(pause_s)
        look(found, 0, 9, 9)
        assert found.suspects == (pause_s == 0.0)


def test_rare_jumps_are_forgotten():
    found = jumping(0)
    for _ in range(20):
        look(found, 0, 9, 0, 9)
        for _ in range(round(1.0 / (RELIEF_PER_S * 0.5))):
            look(found, *[9] * 25)
    assert not found.any


def test_an_erratic_pad_is_believed_again_when_it_was_calm_for_a_minute():
    found = jumping(10)
    found.pass_time(59.5)
    assert found.pads[1]
    found.pass_time(1.0)
    assert not found.any
    assert not found.pads.any()


#: Two chips; the last pad of each has no curve of its own, so nothing is known of its jumps.
CHIP = np.array([7, 7, 7, 7, 7, 7, 2, 2, 2, 2])
WATCHED = np.array([True] * 5 + [False] + [True] * 3 + [False])


def of_chips(*jumping_pads: int) -> Erratic:
    found = Erratic(np.where(WATCHED, STEP_KPA, np.inf), np.full(len(CHIP), np.inf), CHIP)
    rows = np.zeros((8, len(CHIP)), np.float32)
    rows[1::2, list(jumping_pads)] = 9.0
    for _ in range(10):
        found.look(rows, [PERIOD_S] * len(rows))
    return found


@pytest.mark.parametrize(
    ("jumping_pads", "erratic"),
    [
        ([0, 1], [0, 1]),
        ([0, 1, 2], [0, 1, 2, 3, 4, 5]),
        ([6, 7], [6, 7]),
        ([6, 7, 8], [6, 7, 8, 9]),
        ([0, 1, 6, 7], [0, 1, 6, 7]),
        ([0, 1, 4, 6, 7, 8], list(range(10))),
    ],
)
def test_no_pad_of_a_chip_is_read_while_most_of_them_jump(
    jumping_pads: list[int], erratic: list[int]
):
    """Of those whose jumps are known; two may jump each by itself."""
    assert np.flatnonzero(of_chips(*jumping_pads).pads).tolist() == erratic


def test_pads_of_a_chip_that_are_not_valid_for_another_reason_decide_nothing_of_it():
    """They cannot jump: what is not valid is taken as unchanged."""
    found = Erratic(np.full(10, STEP_KPA), np.full(10, np.inf), np.repeat(0, 10))
    valid = np.arange(10) < 5
    rows = np.zeros((8, 10), np.float32)
    rows[1::2, [0, 1, 2]] = 9.0
    erratic = []
    for second in range(8):
        found.look(rows, [PERIOD_S] * len(rows))
        # One lost sweep of the others shows nothing.
        found.note_valid(np.ones(10, np.bool_) if second < 4 and second % 2 else valid)
        found.pass_time(1.0)
        erratic.append(np.flatnonzero(found.pads).tolist())
    assert erratic[4] == [0, 1, 2]
    assert erratic[-1] == list(range(10))
    found.note_valid(np.ones(10, np.bool_))
    found.pass_time(1.0)
    assert np.flatnonzero(found.pads).tolist() == [0, 1, 2]


def seldom_read(valid: np.ndarray) -> list[int]:
    """The pads that are found of a chip whose contact is broken, read each 0.2 s for a minute.

    All scatter alike; two had noise of nearly as much when they were calibrated.
    """
    rng = np.random.default_rng(5)
    step = np.array([40.0, 300.0, 45.0, 310.0, 50.0, 55.0, 60.0])
    found = Erratic(step, np.full(7, 300.0), np.zeros(7, int))
    rows = np.where(valid, 450.0 + 80.0 * rng.normal(size=(300, 7)), 0.0).astype(np.float32)
    for begin in range(0, len(rows), 5):
        found.look(rows[begin : begin + 5], [0.2] * 5)
        found.note_valid(valid)
        found.pass_time(1.0)
    return np.flatnonzero(found.pads).tolist()


@pytest.mark.parametrize("missing", [None, 0, 5, 6])
def test_a_pad_whose_noise_hides_its_scatter_or_is_not_valid_hides_no_other_of_a_slow_board(
    missing: int | None,
):
    """Readings so far apart are compared with those of another pad of the chip."""
    assert seldom_read(np.arange(7) != missing) == list(range(7))


def test_each_pad_is_compared_with_the_next_quieter_one_of_its_chip():
    chip = np.array([4, 4, 4, 1, 1, 9, 4])
    watched = np.array([True] * 6 + [False])
    step = np.array([9.0, 30.0, 8.0, 7.0, 7.0, 1.0, 1.0], np.float32)
    assert quieter_of_chip(chip, watched, step).tolist() == [2, 0, 0, 4, 3, 5, 6]


def test_pads_of_a_chip_are_read_again_as_soon_as_few_of_them_are_erratic():
    found = of_chips(0, 1)
    found.pass_time(30.0)
    rows = np.zeros((8, len(CHIP)), np.float32)
    rows[1::2, [0, 1, 2]] = 9.0
    for _ in range(10):
        found.look(rows, [PERIOD_S] * len(rows))
    rows[:, 2] = 0.0
    found.look(rows, [PERIOD_S] * len(rows))
    found.pass_time(59.0)
    assert np.flatnonzero(found.pads).tolist() == [0, 1, 2, 3, 4, 5]
    for _ in range(10):
        found.look(rows, [PERIOD_S] * len(rows))
    found.pass_time(2.0)
    assert np.flatnonzero(found.pads).tolist() == [0, 1]
    found.reset(np.array([True] * 2 + [False] * 8))
    assert not found.any


@pytest.mark.parametrize("jumps", [0, 10])
def test_a_new_zero_begins_without_old_jumps(jumps: int):
    found = jumping(jumps)
    found.reset(np.array([False, True, False]))
    assert not found.any
    look(found, 0, 9, 0)
    assert not found.suspects
    look(found, 0, 9, 0, 9)
    assert found.suspects
    assert not found.any


def test_a_new_zero_of_one_pad_changes_nothing_of_another():
    found = jumping(10)
    for _ in range(100):
        found.reset(np.array([True, False, True]))
    assert found.pads.tolist() == [False, True, False]


def test_a_pad_that_jumped_for_long_is_a_suspect_no_longer_than_at_its_limit():
    found = jumping(100)
    for _ in range(round(LIMIT / RELIEF_PER_S)):
        assert found.suspects
        look(found, *[9] * 8, period_s=0.125)
    assert not found.suspects


def test_noise_of_six_deviations_or_eight_units_is_no_jump():
    straight = PressureCurve([1.0, 1.0], a=0.0, b=2.0)
    assert step_kpa(straight, np.array([0.5, 2.0])).tolist() == [2.0 * 8.0, 2.0 * 6.0 * 2.0]


def test_a_jump_is_measured_by_the_mean_slope_of_the_curve_where_it_was_calibrated():
    noise_units = np.zeros(2)
    bent = PressureCurve([1.0, 2.0])
    slope = bent.kpa(bent.beyond_units) / bent.beyond_units
    assert step_kpa(bent, noise_units) == pytest.approx(8.0 * slope)
    # Of a curve that was measured up to less than a unit, the first unit counts.
    soft = TableCurve(np.tile(KNOTS_UNITS**2, (2, 1)), np.array([0.01, 100.0]))
    assert step_kpa(soft, noise_units) == pytest.approx(
        8.0 * soft.kpa(np.array([1.0, 100.0])) / np.array([1.0, 100.0])
    )
    # Of one that ends beyond what a byte can say, the byte's end.
    fine = PressureCurve([0.5])
    assert fine.beyond_units > 255.0
    slope = fine.kpa(np.array([255.0])) / 255.0
    assert step_kpa(fine, noise_units[:1]) == pytest.approx(8.0 * slope, rel=1e-9)
