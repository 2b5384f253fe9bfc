"""What a press leaves in the foam is no touch."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skin_host.config.settings import TouchSettings
from skin_host.processing.residuals import Residuals
from skin_host.processing.touch import levels
from tests.support.deciding import SWEEP_S, detector_of, flags, pressed

ON = np.array([2.0])
#: What noise does not take below that.
FIRM = np.array([6.0])


def residuals_of(votes=2):
    residuals = Residuals(1)
    residuals.configure(ON, FIRM, np.array([votes]))
    return residuals


def reported_after_a_press(press, rest, *, rest_s=0.0):
    """Whether a rest is reported as a new touch, after a press and so long of nothing."""
    detector, residuals = detector_of(), residuals_of()
    reported = []
    for value in [press] * 5 + [0] * 3:
        touched = pressed(detector, value)
        reported.append(bool(residuals.step(touched, np.array([float(value)]))[0]))
    assert any(reported)
    residuals.fade(rest_s)
    for _ in range(5):
        touched = pressed(detector, rest)
        reported.append(bool(residuals.step(touched, np.array([float(rest)]))[0]))
    return reported[-1]


def test_what_a_hard_press_leaves_in_the_foam_is_no_new_touch():
    assert not reported_after_a_press(100, 4)
    assert reported_after_a_press(20, 4)  # a softer one leaves less
    assert reported_after_a_press(100, 6)  # and this is more than it left


def test_what_a_press_has_left_is_forgotten():
    assert reported_after_a_press(100, 3, rest_s=10.0)


def reported_over(values, residuals, dt_s=SWEEP_S):
    """What is reported of a taxel that reads so many units, which are kPa here."""
    detector = detector_of()
    reported = []
    for value in values:
        touched = pressed(detector, value, dt_s)
        signal = np.array([float(value)])
        reported.append(bool(residuals.step(touched, signal, detector.repeated)[0]))
    return reported


def test_a_press_that_goes_down_to_more_than_it_leaves_is_one_touch():
    assert reported_over([100] * 5 + [6] * 50, residuals_of()) == [False] + [True] * 54


def test_a_press_that_has_fallen_to_what_it_leaves_has_ended():
    # The detector alone would hold on to it: 3 units are more than its threshold.
    assert (
        reported_over([100] * 5 + [3] * 50, residuals_of())
        == flags(0, 1, 1, 1, 1, 1) + [False] * 49
    )


def after_a_press_beyond(seconds, felt, *, cut_off=False, relaxation=20.0, later=(), wait_s=0.0):
    """What is reported at the end of a press of 100 kPa, beyond the calibrated range for so long,
    that falls to what is felt then; and whether what is felt later is.
    """
    residuals, touched = residuals_of(), np.array([True])
    kept = np.array([relaxation])
    residuals.press_beyond(touched, np.array([cut_off]), seconds)
    for value in [100.0] * 5 + [felt] * 4:
        reported = residuals.step(touched, np.array([value]), relaxation=kept)
    residuals.fade(wait_s)
    # The decision is another one, so that it is looked at again.
    for value in later:
        reported = residuals.step(touched.copy(), np.array([value]), relaxation=kept)
    return bool(reported[0])


@pytest.mark.parametrize(("cut_off", "most"), [(False, 2.0 + 3.0 + 5.0), (True, 2.0 + 3.0 + 10.0)])
def test_a_press_beyond_the_calibrated_range_may_leave_a_share_of_the_relaxation_more(
    cut_off, most
):
    assert not after_a_press_beyond(1.0, most - 0.1, cut_off=cut_off)
    assert after_a_press_beyond(1.0, most + 0.1, cut_off=cut_off)
    # A model that takes nothing off, or adds, lacks nothing.
    for relaxation in (0.0, -20.0):
        assert after_a_press_beyond(1.0, 5.1, cut_off=cut_off, relaxation=relaxation)
        assert not after_a_press_beyond(1.0, 4.9, cut_off=cut_off, relaxation=relaxation)


def test_what_a_press_beyond_the_calibrated_range_left_stays_for_as_long_as_its_foam_recovers():
    """8 kPa are a touch again when they are 2 and what noise adds, 1.9, above what has remained of
    them, which falls to 1/e in 30 s and twice the time beyond the range. No press is remembered
    for ever.
    """
    for seconds, falls_in_s in ((0.04, 30.08), (60.0, 150.0), (1e6, 1200.0)):
        for multiple, wanted in ((0.62, False), (0.72, True)):
            wait_s = multiple * falls_in_s
            assert after_a_press_beyond(seconds, 8.0, later=[8.0] * 60, wait_s=wait_s) == wanted


def test_a_tap_on_what_a_press_has_left_ends_where_it_began():
    """The tap alone would leave 0.6 kPa; 6 of the harder press are left before and after it."""
    residuals, on, off = residuals_of(), np.array([True]), np.array([False])
    for value in [200.0] * 5 + [6.0] * 4:
        residuals.step(on, np.array([value]))
    residuals.step(off, np.array([0.0]))
    residuals.fade(3.0)
    again, tap = on.copy(), [20.0] * 5 + [6.0] * 4
    reported = [bool(residuals.step(again, np.array([value]))[0]) for value in tap]
    assert reported == flags(1, 1, 1, 1, 1, 1, 0, 0, 0)


def test_taps_stay_apart_though_the_foam_has_not_come_back_between_them():
    taps = ([60] * 5 + [3] * 8) * 3
    reported = reported_over(taps, residuals_of())
    begins = [not before and now for before, now in pairwise([False, *reported])]
    assert sum(begins) == 3


def test_a_noisy_taxel_that_falls_needs_as_many_measurements_as_for_a_touch():
    fall = [100] * 5 + [3] * 10
    assert reported_over(fall, residuals_of(votes=5)) == [False] + [True] * 8 + [False] * 6
    # One that is no lower than its noise goes ends nothing.
    assert all(reported_over([100] * 5 + [3, 3, 50] * 10, residuals_of(votes=3))[1:])


def test_a_measurement_that_is_sent_again_ends_no_press():
    reported = reported_over([100] * 8 + [3] * 3, residuals_of(), dt_s=0.01)
    assert reported[-3:] == flags(1, 1, 1)


def test_what_a_press_has_left_falls_to_a_third_in_five_seconds() -> None:
    """100 kPa leave 3: after five seconds 1.1 more than the threshold of 2 are needed."""
    assert not reported_after_a_press(100, 3, rest_s=5.0)
    assert reported_after_a_press(100, 4, rest_s=5.0)
    assert not reported_after_a_press(100, 4, rest_s=1.0)


def test_a_press_that_left_next_to_nothing_changes_no_threshold() -> None:
    # A twentieth of the threshold of 2 is what 3.3 units leave.
    residuals = residuals_of()
    on, off = np.array([True]), np.array([False])
    for touched, signal in ((on, 3.2), (off, 0.0), (on, 0.5)):
        reported = residuals.step(touched, np.array([signal]))
    assert reported[0]
    residuals = residuals_of()
    for touched, signal in ((on, 3.4), (off, 0.0), (on, 0.5)):
        reported = residuals.step(touched, np.array([signal]))
    assert not reported[0]


def test_a_reset_forgets_the_press_of_its_taxel() -> None:
    residuals = Residuals(2)
    residuals.configure(np.full(2, 2.0), np.full(2, 6.0), np.array([2, 2]))
    both, none = np.ones(2, bool), np.zeros(2, bool)
    residuals.press_beyond(both, both, 60.0)
    kept = np.full(2, 20.0)
    residuals.step(both, np.full(2, 100.0), relaxation=kept)
    assert residuals.any
    residuals.reset(np.array([True, False]))
    assert residuals.step(none, np.zeros(2)).tolist() == [False, False]
    assert not residuals.any
    assert residuals.step(both.copy(), np.full(2, 4.0)).tolist() == [True, False]
    # Pressed again within the range, the first lacks nothing.
    for signal in (100.0, 100.0, 9.0, 9.0, 9.0):
        reported = residuals.step(both, np.full(2, signal), relaxation=kept)
    assert reported.tolist() == [True, False]


def test_what_is_felt_under_a_residual_is_the_mean_since_it_was_touched() -> None:
    """A quarter of each new sample: 0.25 * 12 + 0.75 * 3 is more than 2 + 3, 0.25 * 8 is not."""
    for second, wanted in ((12.0, True), (8.0, False)):
        residuals = residuals_of()
        on, off = np.array([True]), np.array([False])
        residuals.step(on, np.array([100.0]))
        residuals.step(off, np.array([0.0]))
        assert not residuals.step(on.copy(), np.array([3.0]))[0]
        assert residuals.step(on.copy(), np.array([second]))[0] == wanted


@pytest.mark.parametrize(("press", "ends"), [(6.0, False), (6.5, True)])
def test_a_press_ends_at_its_residual_if_noise_does_not_take_it_there(press, ends) -> None:
    """6 units, which noise takes below 2, and 3 % of the press."""
    residuals = residuals_of()
    on = np.array([True])
    for _ in range(20):
        residuals.step(on, np.array([press]))
    reported = [bool(residuals.step(on, np.array([2.1]))[0]) for _ in range(5)]
    assert reported[-1] is not ends


def test_a_firm_press_that_ends_makes_a_soft_one_beside_it_no_firmer() -> None:
    residuals = Residuals(2)
    residuals.configure(np.full(2, 2.0), np.full(2, 6.0), np.array([5, 5]))
    both = np.ones(2, bool)
    for firm, soft in [(100.0, 5.0)] * 20 + [(3.0, 5.0)] * 4 + [(3.0, 2.1)] * 10:
        reported = residuals.step(both, np.array([firm, soft]))
    assert reported.tolist() == [False, True]


@pytest.mark.parametrize(("reading", "reported"), [(3.0, False), (3.2, True)])
def test_of_the_three_units_of_a_hard_press_one_is_left_after_five_seconds(
    reading: float, reported: bool
) -> None:
    residuals = residuals_of()
    residuals.step(np.array([True]), np.array([100.0]))
    residuals.step(np.array([False]), np.zeros(1))
    residuals.fade(5.0)
    assert bool(residuals.step(np.array([True]), np.array([reading]))[0]) is reported


@pytest.mark.parametrize("last", [1.0, 4.5, 4.9])
def test_what_a_press_left_is_the_mean_of_the_readings_in_which_it_fell(last: float) -> None:
    """The last of them may be any: noise makes it low as often as high."""
    residuals = residuals_of(votes=7)
    on, off = np.array([True]), np.array([False])
    for reading in [120.0] * 40 + [4.9, 4.1, 4.8, 4.2, 4.7, 4.6, last]:
        reported = residuals.step(on, np.array([reading]))
    assert not reported[0]
    residuals.step(off, np.array([4.5]))
    # Its mean is 4 to 4.6, and 2 units more are a touch.
    assert not residuals.step(on.copy(), np.array([5.9]))[0]
    residuals.step(off, np.array([4.5]))
    assert residuals.step(on.copy(), np.array([6.7]))[0]


@pytest.mark.parametrize(("reading", "reported"), [(5.0, False), (8.0, True)])
def test_what_a_press_left_is_no_new_evidence_after_it_was_lost_either(
    reading: float, reported: bool
) -> None:
    residuals = residuals_of(votes=7)
    on, off = np.array([True]), np.array([False])
    for value in [120.0] * 40 + [3.0] * 9:
        residuals.step(on, np.array([value]))
    residuals.fade(10.0)
    assert not residuals.step(off, np.array([3.0]), lost=on)[0]
    assert bool(residuals.step(on.copy(), np.array([reading]))[0]) is reported


@pytest.mark.parametrize(
    ("press", "reading", "reported"),
    [(100.0, 9.0, False), (100.0, 14.0, True), (3.0, 3.0, True)],
)
def test_a_touch_that_noise_kept_after_a_firm_press_is_no_new_evidence_after_it_was_lost(
    press: float, reading: float, reported: bool
) -> None:
    """`gripper.toml` 9073: no seven readings in a row were as low as what is left."""
    residuals = residuals_of(votes=7)
    on, off = np.array([True]), np.array([False])
    for value in [press] * 40 + [min(press, 7.0), min(press, 3.0)] * 25:
        assert residuals.step(on, np.array([value]))[0]
    assert not residuals.step(off, np.array([3.0]), lost=on)[0]
    assert bool(residuals.step(on.copy(), np.array([reading]))[0]) is reported


def test_a_touch_that_was_lost_is_new_evidence_once_it_was_released() -> None:
    residuals = residuals_of(votes=7)
    on, off = np.array([True]), np.array([False])
    for value in [120.0] * 40 + [3.0] * 9:
        residuals.step(on, np.array([value]))
    residuals.fade(10.0)
    residuals.step(off, np.array([3.0]), lost=on)
    residuals.step(off, np.array([3.0]))
    assert residuals.step(on.copy(), np.array([5.0]))[0]


@pytest.mark.parametrize(("reading", "reported"), [(5.0, False), (8.0, True)])
def test_what_a_noisy_touch_feels_at_last_is_no_touch_after_its_end(
    reading: float, reported: bool
) -> None:
    """Noise hides that the press has fallen, and that something is left when the touch ends."""
    residuals = residuals_of(votes=14)
    on = np.array([True])
    for _ in range(20):
        residuals.step(on, np.array([100.0]))
    for _ in range(13):
        for signal in (7.0, 3.0) * 10:
            assert residuals.step(on, np.array([signal]))[0]
        residuals.fade(1.0)
    residuals.step(np.array([False]), np.zeros(1))
    residuals.fade(2.0)
    assert bool(residuals.step(on.copy(), np.array([reading]))[0]) is reported


@pytest.mark.parametrize(("reading", "reported"), [(3.9, False), (6.5, True)])
def test_what_a_press_left_when_it_fell_is_no_touch_while_it_slowly_goes(
    reading: float, reported: bool
) -> None:
    """Foam whose model is not fitted keeps more than 3 % of the press, for more than 5 s."""
    residuals = residuals_of()
    on = np.array([True])
    for _ in range(20):
        residuals.step(on, np.array([70.0]))
    seen = []
    for _ in range(15):
        seen += [bool(residuals.step(on, np.array([3.9]))[0]) for _ in range(20)]
        residuals.fade(1.0)
    assert not any(seen[20:])
    for _ in range(20):
        found = residuals.step(on, np.array([reading]))
    assert bool(found[0]) is reported


def held_at_a_residual(noise_units: float, seconds: float) -> list[bool]:
    """Press hard, fall to what the foam keeps for long, with noise; what is reported after that."""
    rng = np.random.default_rng(3)
    found = levels(np.zeros(1), np.full(1, noise_units), TouchSettings())
    on = found.enter + 0.25
    residuals = Residuals(1)
    residuals.configure(on, on + found.fall, found.votes)
    touched = np.ones(1, np.bool_)
    reported = []
    n = round(seconds / SWEEP_S)
    for units in [60.0] * 20 + [float(0.9 * on[0])] * n:
        signal = np.full(1, units + noise_units * rng.standard_normal())
        reported.append(bool(residuals.step(touched, signal)[0]))
        residuals.fade(SWEEP_S)
    return reported[20:]


@pytest.mark.parametrize("noise_units", [0.0, 0.8, 1.5])
def test_a_residual_that_the_decision_holds_on_to_is_no_touch_again(noise_units: float) -> None:
    reported = held_at_a_residual(noise_units, 30.0)
    begins = sum(now and not before for before, now in pairwise([True, *reported]))
    assert not reported[-1]
    assert begins == 0


def rising_again(
    press: float, rest: float, reading: float, *, votes: int = 2, lifts: bool = False
) -> bool:
    """Press, fall to a rest that ends the press, then read more; return whether that is reported.

    The decision before holds on to the taxel all the time, or lets go of it once, if it lifts.
    """
    residuals = residuals_of(votes)
    on = np.array([True])
    for value in [press] * 20 + [rest] * votes:
        reported = residuals.step(on, np.array([value]))
    assert not reported[0]
    if lifts:
        residuals.step(np.array([False]), np.array([rest]))
    for _ in range(60):
        reported = residuals.step(on, np.array([reading]))
    return bool(reported[0])


def test_a_press_that_ends_some_seconds_after_it_fell_left_its_share_of_the_hardest() -> None:
    """4.1 of 82 units; when its touch ends, six hundredths of what falls in 5 s are 2.2."""
    residuals = Residuals(1)
    residuals.configure(np.full(1, 2.0), np.full(1, 3.0), np.array([2]), fitted=False)
    on, off = np.array([True]), np.array([False])
    for value in [82.0] * 20 + [8.0] * 10:
        assert residuals.step(on, np.array([value]))[0]
    residuals.fade(4.0)
    for _ in range(4):
        reported = residuals.step(on, np.array([4.1]))
    assert not reported[0]
    for reading, wanted in ((5.9, False), (6.3, True)):
        residuals.step(off, np.array([4.1]))
        for _ in range(20):
            reported = residuals.step(on, np.array([reading]))
        assert bool(reported[0]) is wanted


def still_felt(fitted: bool, left: float, seconds: float, reading: float) -> bool:
    """Press 70 units, feel what they have left for so long, then some reading; return whether that
    is reported.
    """
    residuals = Residuals(1)
    residuals.configure(np.full(1, 2.0), np.full(1, 6.0), np.array([2]), fitted)
    on = np.array([True])
    for value in [70.0] * 20 + [left] * 4:
        residuals.step(on, np.array([value]))
    for _ in range(round(seconds / 0.4)):
        for _ in range(8):
            assert not residuals.step(on, np.array([left + 0.1]))[0]
        residuals.fade(0.4)
    for _ in range(60):
        reported = residuals.step(on, np.array([reading]))
    return bool(reported[0])


@pytest.mark.parametrize("fitted", [True, False])
def test_where_no_model_was_fitted_what_a_press_left_does_not_fall_while_it_is_felt(
    fitted: bool,
) -> None:
    """After 12 s 3.9 units have fallen to 2.6; a held taxel rises by 1.9 above the threshold of 2
    and that.
    """
    assert still_felt(fitted, 3.9, 12.0, 6.7) is fitted
    assert still_felt(fitted, 3.9, 12.0, 7.9)


def test_what_is_felt_of_a_press_is_not_taken_for_what_it_left_for_ever() -> None:
    """A tenth of 70 units has fallen to 1.5 after 46 s."""
    assert not still_felt(False, 3.2, 46.0, 5.3)
    assert still_felt(False, 3.2, 46.0, 5.5)


@pytest.mark.parametrize(("votes", "rise"), [(2, 1.89), (8, 3.78)])
def test_a_held_taxel_is_touched_again_by_five_deviations_of_its_mean(
    votes: int, rise: float
) -> None:
    """Four deviations of a measurement are 4 units, times the root of half the votes; those of a
    mean with a weight of a quarter are 0.378 of that.
    """
    threshold = 2.0 + 3.9
    assert not rising_again(70.0, 3.9, threshold + rise - 0.1, votes=votes)
    assert rising_again(70.0, 3.9, threshold + rise + 0.1, votes=votes)


def test_a_taxel_that_was_let_go_is_touched_again_above_what_its_press_left() -> None:
    assert not rising_again(70.0, 3.9, 5.8, lifts=True)
    assert rising_again(70.0, 3.9, 6.0, lifts=True)


def test_no_more_than_six_hundredths_of_a_press_are_taken_for_what_it_left() -> None:
    """40 units end at less than 3.2; 2.4 of these are the foam's."""
    assert not rising_again(40.0, 3.1, 4.3, lifts=True)
    assert rising_again(40.0, 3.1, 4.5, lifts=True)


def test_a_press_that_fell_below_its_zero_left_as_much_as_any() -> None:
    """3 % of 70 units."""
    assert not rising_again(70.0, -5.0, 4.0, lifts=True)
    assert rising_again(70.0, -5.0, 4.2, lifts=True)


def test_a_reset_forgets_what_a_press_left_and_that_its_taxel_is_held() -> None:
    residuals = Residuals(2)
    residuals.configure(np.full(2, 2.0), np.full(2, 6.0), np.array([2, 2]))
    both = np.ones(2, bool)
    for value in [70.0] * 20 + [3.9] * 2:
        residuals.step(both, np.full(2, value))
    residuals.reset(np.array([True, False]))
    assert residuals.step(both, np.full(2, 0.5)).tolist() == [True, False]


def test_what_a_press_left_falls_to_a_third_in_thirty_seconds() -> None:
    """3.9 units of 70 become 1.43; a held taxel rises by 1.89 above the threshold of 2 and that."""
    for reading, wanted in ((5.2, False), (5.5, True)):
        residuals = residuals_of()
        on = np.array([True])
        for value in [70.0] * 20 + [3.9] * 2:
            residuals.step(on, np.array([value]))
        residuals.fade(30.0)
        for _ in range(60):
            reported = residuals.step(on, np.array([reading]))
        assert bool(reported[0]) is wanted


def test_a_second_press_ends_by_as_many_measurements_as_the_first() -> None:
    residuals = Residuals(3)
    residuals.configure(np.full(3, 2.0), np.full(3, 6.0), np.array([2, 2, 2]))
    first, both = np.array([True, False, False]), np.array([True, False, True])

    def over(touched: np.ndarray, *readings: float) -> list[bool]:
        """What is reported of the last taxel, while something soft touches the first."""
        signals = [np.array([5.0, 0.0, reading]) for reading in readings]
        return [bool(residuals.step(touched, signal)[2]) for signal in signals]

    assert over(both, 100, 100, 100, 3, 3)[-3:] == flags(1, 1, 0)
    over(first, 0, 0, 0)
    assert over(both, 100, 100, 100, 3, 100)[-2:] == flags(1, 1)
    assert over(both, 3, 3) == flags(1, 0)


def test_a_press_is_felt_as_firm_while_another_seems_to_fall_again_and_again() -> None:
    residuals = Residuals(2)
    residuals.configure(np.full(2, 2.0), np.full(2, 6.0), np.array([5, 5]))
    both = np.ones(2, bool)
    for _ in range(20):
        residuals.step(both, np.array([100.0, 5.0]))
    # The first one never falls for as many measurements as would end it.
    falling = [3.0, 3.0, 3.0, 3.0, 100.0]
    for unsteady, reading in [(one, 100.0) for one in 10 * falling] + [
        (one, 3.0) for one in falling
    ]:
        reported = residuals.step(both, np.array([unsteady, reading]))
    assert reported.tolist() == [True, False]


def fine_residuals(fitted: bool = True) -> tuple[Residuals, float, float, int]:
    """A taxel of 1.85 kPa of noise and a threshold of 1.7 kPa, as units of shift 0 have; with its
    threshold, its noise and its votes.
    """
    noise_kpa, on_kpa, votes = 1.85, 1.7, 14
    residuals = Residuals(1)
    fall = 4.0 * noise_kpa * math.sqrt(2.0 / votes)
    residuals.configure(
        np.array([on_kpa]), np.array([on_kpa + fall]), np.array([votes]), fitted=fitted
    )
    return residuals, on_kpa, noise_kpa, votes


def measured(residuals: Residuals, pressures: list[float], noise_kpa: float, seed: int) -> list:
    """What is reported of a taxel that the decision before takes for touched, with noise."""
    rng, on = np.random.default_rng(seed), np.array([True])
    reported = []
    for kpa in pressures:
        signal = np.array([kpa + noise_kpa * rng.standard_normal()])
        reported.append(bool(residuals.step(on, signal)[0]))
        residuals.fade(SWEEP_S)
    return reported


@given(seed=st.integers(0, 2**32 - 1), falls_in=st.sampled_from([1, 20, 75]))
@settings(deadline=None, max_examples=50)
def test_noise_across_the_threshold_does_not_keep_a_press_that_has_fallen(
    seed: int, falls_in: int
) -> None:
    """The rest is a deviation of the noise below the threshold: of fourteen measurements in a row
    one is nearly always above it. The press may also fall slowly.
    """
    residuals, _, noise_kpa, votes = fine_residuals(fitted=False)
    press = [60.0] * 50 + np.linspace(60.0, 1.2, falls_in).tolist()
    reported = measured(residuals, press + [1.2] * 100, noise_kpa, seed)
    assert reported[49]
    assert not any(reported[-100 + 5 * votes :])


@given(seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=20)
def test_a_press_above_what_is_left_is_one_touch_however_noise_takes_it_below(seed: int) -> None:
    residuals, _, noise_kpa, _ = fine_residuals()
    # At first 3.5 kPa are the threshold.
    assert all(measured(residuals, [60.0] * 50 + [6.0] * 500, noise_kpa, seed)[1:])


def counted(readings: list[float], votes: int, *, fitted: bool = True) -> list[bool]:
    """What is reported after a press of 100, which ends below 5, or below 8 if no model of the foam
    was fitted.
    """
    residuals, on = Residuals(1), np.array([True])
    residuals.configure(ON, FIRM, np.array([votes]), fitted=fitted)
    return [
        bool(residuals.step(on, np.array([reading]))[0]) for reading in [100.0] * 20 + readings
    ][20:]


def test_a_press_ends_when_so_many_more_of_its_measurements_are_below_than_above() -> None:
    assert counted([3.0, 3.0, 9.0, 3.0, 3.0], votes=3, fitted=False) == flags(1, 1, 1, 1, 0)
    # What no noise explains is a press.
    pressed = [3.0, 3.0, 50.0, 3.0, 3.0, 3.0]
    assert counted(pressed, votes=3, fitted=False) == flags(1, 1, 1, 1, 1, 0)
    assert counted([50.0, 3.0, 3.0, 3.0], votes=3, fitted=False) == flags(1, 1, 1, 0)


def test_where_a_model_was_fitted_so_many_in_a_row_end_a_press() -> None:
    assert counted([3.0, 3.0, 6.0, 3.0, 3.0, 3.0], votes=3) == flags(1, 1, 1, 1, 1, 0)


def test_a_press_that_has_stayed_above_what_it_leaves_has_as_many_to_lose_first() -> None:
    """Without a fitted model, what reads less than 8 after a press of 100 may be left of it."""
    for stays in (30, 60):
        residuals, on = Residuals(1), np.array([True])
        residuals.configure(ON, FIRM, np.array([3]), fitted=False)
        reported = [
            bool(residuals.step(on, np.array([reading]))[0])
            for reading in [100.0] * 20 + [9.0] * stays + [7.0] * 6
        ]
        assert reported[20:] == [True] * (stays + 5) + [False]


def test_where_a_model_was_fitted_a_press_that_is_eased_slowly_goes_on() -> None:
    assert all(counted([6.0] * 30 + [4.0] * 30, votes=3))


def test_a_measurement_that_is_sent_again_is_not_counted() -> None:
    residuals, on, again = residuals_of(3), np.array([True]), np.array([True])
    for reading in [100.0] * 20 + [3.0, 3.0]:
        residuals.step(on, np.array([reading]))
    for reading in (3.0, 6.0, 50.0):
        assert residuals.step(on, np.array([reading]), again)[0]
    assert not residuals.step(on, np.array([3.0]))[0]
    # The mean of the three: 2 more and 3.3, the rise that noise explains, are a touch again.
    for reading, wanted in ((7.1, False), (7.5, True)):
        for _ in range(60):
            reported = residuals.step(on, np.array([reading]))
        assert bool(reported[0]) is wanted


def test_a_soft_touch_outlasts_what_a_firm_press_before_it_has_left() -> None:
    """The press of 100 is no more than one that noise takes to the threshold, 6, after 84 s."""
    for wait_s, wanted in ((80.0, False), (90.0, True)):
        residuals, on = Residuals(1), np.array([True])
        residuals.configure(ON, FIRM, np.array([5]), fitted=False)
        for reading in [100.0] * 20 + [8.5] * 20:
            residuals.step(on, np.array([reading]))
        residuals.fade(wait_s)
        for _ in range(40):
            reported = residuals.step(on, np.array([1.9]))
        assert bool(reported[0]) is wanted


@pytest.mark.parametrize("fitted", [False, True])
def test_where_no_model_was_fitted_six_hundredths_of_a_press_and_noise_are_no_press(
    fitted: bool,
) -> None:
    """2 kPa of noise and 6 of 100, instead of the threshold of 2 and 3 of 100."""
    for rest, unfitted in ((7.9, False), (8.1, True)):
        residuals, on = Residuals(1), np.array([True])
        residuals.configure(ON, FIRM, np.array([2]), fitted=fitted)
        for reading in [100.0] * 20 + [rest] * 10:
            reported = residuals.step(on, np.array([reading]))
        assert bool(reported[0]) is (fitted or unfitted)
        # It lifts and comes again.
        residuals.step(np.array([False]), np.zeros(1))
        for _ in range(40):
            reported = residuals.step(on.copy(), np.array([rest]))
        assert bool(reported[0]) is (fitted or unfitted)


def test_what_noise_adds_to_a_press_that_has_fallen_is_three_deviations_of_its_mean() -> None:
    """4 deviations are 3 kPa here, so that it is 1.6, above 6 of 100 kPa."""
    for rest, wanted in ((7.5, False), (7.7, True)):
        residuals, on = Residuals(1), np.array([True])
        residuals.configure(ON, ON + 3.0, np.array([2]), fitted=False)
        for reading in [100.0] * 20 + [rest] * 10:
            reported = residuals.step(on, np.array([reading]))
        assert bool(reported[0]) is wanted


def test_a_high_reading_that_began_a_touch_on_what_is_left_does_not_prove_it() -> None:
    """Noise begins it with a high one; a press has a high mean, or one that noise has not."""
    for readings, wanted in (
        ([9.5, 5.0, 5.0], False),
        ([9.5] * 12, True),
        ([30.0], True),
    ):
        residuals, on, off = Residuals(1), np.array([True]), np.array([False])
        residuals.configure(ON, FIRM, np.array([2]), fitted=False)
        for reading in [100.0] * 20 + [3.0] * 4:
            residuals.step(on, np.array([reading]))
        residuals.step(off, np.zeros(1))
        assert (
            any(residuals.step(on.copy(), np.array([reading]))[0] for reading in readings) is wanted
        )
