from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.probes.viscoelastic import FoamTruth
from skin_host.config.relaxation import MODELS
from skin_host.config.settings import Processing, Settings
from skin_host.evaluation.rig import Rig, flat_skin
from skin_host.layout import PadKind, build_layout
from skin_host.processing.calibration import Verdict
from skin_host.processing.calibration.calibrator import Calibrator
from skin_host.processing.curves import KNOTS_UNITS, Curves, CurveVerdict
from skin_host.processing.pipeline import Pipeline
from skin_host.processing.pressure import PressureCurve

CURVE = PressureCurve(2.88)
NO_RELAXATION = {"relaxation": {"model": "none"}}


def press(rig, units, sweeps, where=slice(0, 6)):
    activation = np.zeros(rig.n)
    activation[where] = units
    return [rig.step(activation) for _ in range(sweeps)]


def test_a_press_is_told_with_its_pressure():
    rig = Rig(1, 0.3, processing=NO_RELAXATION)
    *_, frame = press(rig, 20.0, 10)
    assert np.array_equal(np.flatnonzero(frame.touched), range(6))
    assert frame.pressure_kpa[:6] == pytest.approx(np.full(6, CURVE.kpa(20.0)[0]), abs=3.5)
    assert frame.pressure_kpa[6:].max() < 5.0
    assert frame.valid.all()
    assert not frame.beyond_range.any()


def test_a_press_ends_with_two_sweeps_without_it():
    rig = Rig(1, 0.3)
    press(rig, 20.0, 50)
    frames = press(rig, 0.0, 3)
    assert [bool(frame.touched.any()) for frame in frames] == [True, False, False]


def test_pressure_is_never_negative_and_frames_are_counted():
    rig = Rig(1, 0.4)
    frames = press(rig, -10.0, 30) + press(rig, 30.0, 30) + press(rig, 0.0, 30)
    assert all(frame.pressure_kpa.min() >= 0.0 for frame in frames)
    assert [frame.seq for frame in frames] == list(range(90))


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("update_s", [0.0, 1.0])
def test_every_model_takes_relaxation_off_a_hold(model, update_s):
    rig = Rig(1, 0.2, hz=10.0, processing={"relaxation": {"model": model, "update_s": update_s}})
    frames = press(rig, 30.0, 600)
    first, last = (float(frame.pressure_kpa[:6].mean()) for frame in (frames[3], frames[-1]))
    if model == "none":
        assert last == pytest.approx(first, abs=1.0)
    else:
        assert last < first - 3.0


def test_states_once_a_second_say_nearly_what_states_at_every_sweep_say():
    frames = {}
    for update_s in (0.0, 1.0):
        rig = Rig(1, 0.4, processing={"relaxation": {"update_s": update_s}})
        frames[update_s] = [
            frame.pressure_kpa[:6]
            for units, sweeps in ((25.0, 300), (0.0, 200), (12.0, 300), (0.0, 200))
            for frame in press(rig, units, sweeps)
        ]
    difference = np.array(frames[0.0]) - np.array(frames[1.0])
    assert np.sqrt(np.mean(difference**2)) < 0.5
    assert np.abs(difference).max() < 4.0


def test_what_is_not_received_is_not_valid_and_its_history_is_kept():
    rig = Rig(1, 0.2, processing=NO_RELAXATION)
    press(rig, 20.0, 20)
    lost = np.ones(rig.n, bool)
    lost[:12] = False
    raw = np.where(lost, rig.read(0.0), 0).astype(np.uint8)
    for _ in range(3):
        rig.t_ns += 40_000_000
        frame = rig.pipeline.step(0, raw, lost, rig.t_ns)
        assert not frame.valid[:12].any()
        assert not frame.touched[:12].any()
        assert not frame.pressure_kpa[:12].any()
        assert frame.valid[12:].all()
    (frame,) = press(rig, 20.0, 1)
    assert frame.touched[:6].all()


def test_zeros_for_lost_triangles_leave_no_trace():
    steady, lossy = (Rig(1, 0.0, processing=NO_RELAXATION) for _ in range(2))
    here = np.ones(steady.n, bool)
    for sweep in range(300):
        here[:] = True
        if sweep % 7 == 3:
            here[24:60] = False
        raw = steady.read(3.0)
        t_ns = sweep * 40_000_000
        one = steady.pipeline.step(0, raw, np.ones(steady.n, bool), t_ns)
        other = lossy.pipeline.step(0, np.where(here, raw, 0).astype(np.uint8), here, t_ns)
    assert np.array_equal(one.touched, other.touched)
    assert one.pressure_kpa == pytest.approx(other.pressure_kpa, abs=0.3)


def test_a_saturated_taxel_says_that_it_is_beyond_its_range():
    rig = Rig(1, 0.2, processing=NO_RELAXATION)
    *_, frame = press(rig, 400.0, 5, where=slice(0, 1))
    assert frame.beyond_range[0]
    assert frame.pressure_kpa[0] > 131.0
    assert not frame.beyond_range[1:].any()


@pytest.mark.parametrize(
    "wrong", [{"bend": 1e4}, {"gain": 1e-30}, {"gain": np.inf}, {"bend": np.nan}]
)
def test_a_taxel_whose_curve_does_not_rise_is_unreached_and_not_valid(wrong):
    """Read as untouched, a press on it would be denied."""
    rig = Rig(1, 0.3)
    values = {name: np.ones(rig.n) for name in ("gain", "bend")}
    for name, value in wrong.items():
        values[name][:3] = value
    pipeline = Pipeline(rig.layout, rig.settings.processing, replace(rig.calibration, **values))
    activation = np.where(np.arange(rig.n) < 6, 30.0, 0.0)
    rig.pipeline = pipeline
    for _ in range(60):
        frame = rig.step(activation)
    assert np.flatnonzero(pipeline.unreached).tolist() == [0, 1, 2]
    assert np.flatnonzero(~frame.valid).tolist() == [0, 1, 2]
    assert np.flatnonzero(frame.touched).tolist() == [3, 4, 5]
    assert np.isfinite(frame.pressure_kpa).all()
    assert 0.0 < pipeline.decides_kpa(0) < 10.0


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_taxel_whose_own_curve_is_not_finite_is_unreached_and_not_valid(wrong):
    rig = Rig(1, 0.3)
    knots = np.tile(CURVE.kpa(KNOTS_UNITS[:, np.newaxis])[:, 0], (rig.n, 1))
    knots[:3, 40:] = wrong
    curves = Curves(
        knots,
        np.full(rig.n, 80.0),
        np.full(rig.n, 0.3),
        np.full(rig.n, 1.0),
        np.full(rig.n, CurveVerdict.GOOD, np.uint8),
        80.0,
        0.0,
    )
    own = replace(rig.calibration, curves=curves)
    rig.pipeline = pipeline = Pipeline(rig.layout, rig.settings.processing, own)
    for _ in range(60):
        frame = rig.step(np.where(np.arange(rig.n) < 6, 30.0, 0.0))
    assert np.flatnonzero(pipeline.unreached).tolist() == [0, 1, 2]
    assert np.flatnonzero(~frame.valid).tolist() == [0, 1, 2]
    assert np.flatnonzero(frame.touched).tolist() == [3, 4, 5]
    assert np.isfinite(frame.pressure_kpa).all()


@pytest.mark.parametrize("noise", [np.nan, np.inf])
def test_a_taxel_that_would_decide_at_no_number_is_unreached(noise):
    rig = Rig(1, 0.3)
    spread = rig.calibration.spread.copy()
    spread[4] = noise
    loud = replace(rig.calibration, spread=spread)
    pipeline = Pipeline(rig.layout, rig.settings.processing, loud)
    assert np.flatnonzero(pipeline.unreached).tolist() == [4]
    assert np.isfinite(pipeline.decides_kpa(0))


@pytest.mark.parametrize(
    "pressure",
    [
        {"a_kpa_per_ff2": -0.28},
        {"a_kpa_per_ff2": 0.014},
        {"code_ff": 1e-4},
        {"a_kpa_per_ff2": 0.0, "b_kpa_per_ff": 1e-6},
        {"a_kpa_per_ff2": 0.0, "b_kpa_per_ff": 3e5},
        {"a_kpa_per_ff2": 0.0, "code_ff": 9e4},
    ],
)
def test_a_press_begins_and_ends_at_the_ends_of_what_a_configuration_permits(pressure):
    rig = Rig(1, 0.3, processing={"pressure": pressure})
    frames = press(rig, 20.0, 200)
    assert frames[5].touched[:6].all()
    assert frames[-1].touched[:6].all()
    assert not frames[-1].touched[6:].any()
    frames += press(rig, 0.0, 500)
    assert not frames[-1].touched.any()
    assert all(np.isfinite(frame.pressure_kpa).all() for frame in frames)
    assert frames[-1].valid.all()


@pytest.mark.parametrize("a_kpa_per_ff2", [-0.001132, 0.0, 0.005, 0.014])
def test_a_touch_does_not_begin_again_after_a_long_press_however_the_curve_bends(a_kpa_per_ff2):
    """The foam, which no compensator models exactly, gives back its residual over minutes."""
    rig = Rig(1, 0.3, processing={"pressure": {"a_kpa_per_ff2": a_kpa_per_ff2}})
    curve = PressureCurve(2.88, a=a_kpa_per_ff2)
    foam = FoamTruth("S", 1)

    def lasts(kpa, sweeps):
        for _ in range(sweeps):
            elastic_kpa = foam.step_pressure(np.full(1, kpa), rig.dt_s)
            yield press(rig, curve.units(elastic_kpa)[0], 1)[0].touched[:6]

    held = list(lasts(60.0, 750))
    assert np.all(held[5:])
    released = np.array(list(lasts(0.0, 2000)))
    assert not released[10:].any()


def test_thermal_pads_are_no_taxels():
    rig = Rig(1, 0.2, kind="triangle_10pad")
    thermal = rig.layout.pad_kind == PadKind.THERMAL
    *_, frame = press(rig, 20.0, 10, where=slice(None))
    assert not frame.valid[thermal].any()
    assert not frame.touched[thermal].any()
    assert not frame.pressure_kpa[thermal].any()
    assert frame.touched[~thermal].all()


@pytest.mark.parametrize(("hz", "rate", "loss"), [(50.0, 0.01, 0.05), (20.0, 0.03, 0.1)])
def test_drift_is_followed_where_frames_are_lost(hz: float, rate: float, loss: float) -> None:
    """Of each triangle's two frames a share is lost; the readings drift by `rate` units/s."""
    rig = Rig(1, 0.4, hz=hz)
    rng = np.random.default_rng(5)
    touched = 0
    for sweep in range(int(200 * hz)):
        rig.t_ns += round(1e9 / hz)
        came = (rng.random((rig.n // 12, 2)) >= loss).all(axis=1).repeat(12)
        raw = np.where(came, rig.read(rate * sweep / hz), 0).astype(np.uint8)
        touched += np.count_nonzero(rig.pipeline.step(0, raw, came, rig.t_ns).touched)
    assert touched == 0
    followed = np.mean(rig.pipeline.baseline - rig.calibration.baseline)
    assert followed == pytest.approx(200 * rate, abs=0.3)


@pytest.mark.parametrize("lost", [False, True])
def test_temperature_pads_tell_of_drift_while_another_triangle_is_missing(lost):
    rig = Rig(1, 0.0, kind="triangle_10pad", processing=NO_RELAXATION)
    thermal = rig.layout.pad_kind == PadKind.THERMAL
    here = np.ones(rig.n, bool)
    here[:12] = not lost
    t_s = warmth = 0.0

    def pass_time(seconds, rate, press):
        nonlocal t_s, warmth
        for _ in range(seconds * 5):
            t_s += 0.2
            warmth += rate * 0.2
            activation = warmth + np.where(thermal, 0.0, press)
            raw = np.where(here, rig.read(activation), 0).astype(np.uint8)
            rig.pipeline.step(0, raw, here, int(t_s * 1e9))

    for rate in (0.03, -0.03, 0.03):
        pass_time(200, rate, 0.0)
    before = rig.pipeline.baseline.copy()
    pass_time(300, -0.01, 30.0)
    moved = (rig.pipeline.baseline - before)[12:][~thermal[12:]]
    assert (moved < -0.5).all()


def test_taxels_that_the_calibration_does_not_trust_are_not_valid():
    settings_, layout = flat_skin(1)
    calibrator = Calibrator(layout)
    present = np.ones(layout.n_taxels, bool)
    for number in range(100):
        raw = np.full(layout.n_taxels, 240 - number % 2, np.uint8)
        raw[3] = 255
        calibrator.add(0, raw, present)
    found = calibrator.finish("x", "t")
    assert found.verdict[3] == Verdict.STUCK
    pipeline = Pipeline(layout, settings_.processing, found)
    for sweep in range(5):
        raw = np.zeros(layout.n_taxels, np.uint8)
        frame = pipeline.step(0, raw, present, sweep * 40_000_000)
    assert not frame.valid[3]
    assert frame.pressure_kpa[3] == 0.0
    assert frame.touched.sum() == layout.n_taxels - 1


def test_of_an_untouched_part_that_nobody_watches_only_touch_is_worked_out():
    watched, unwatched = (Rig(1, 0.3, seed=9) for _ in range(2))
    present = np.ones(watched.n, bool)
    computed = []
    for sweep in range(500):
        units = np.where(np.arange(watched.n) < 4, 15.0 * (200 <= sweep < 300), 0.0)
        raw = watched.read(units)
        one = watched.pipeline.step(0, raw, present, sweep * 20_000_000)
        other = unwatched.pipeline.step(0, raw, present, sweep * 20_000_000, pressures=False)
        assert np.array_equal(one.touched, other.touched)
        computed.append(other.computed)
        if other.computed:
            assert other.pressure_kpa == pytest.approx(one.pressure_kpa, abs=0.7)
    assert all(computed[202:300])
    assert np.mean(computed[:200]) < 0.3


def test_a_clock_set_back_changes_pressures_by_less_than_a_unit():
    rig = Rig(1, 0.0)
    before = press(rig, 20.0, 250)[-1]
    rig.t_ns -= 3_600_000_000_000
    for frame in press(rig, 20.0, 50):
        assert frame.pressure_kpa[:6] == pytest.approx(before.pressure_kpa[:6], abs=1.0)
        assert frame.touched[:6].all()


@pytest.mark.parametrize("update_s", [0.0, 1.0])
def test_in_a_gap_the_foam_relaxes_under_what_is_read_after_it(update_s):
    processing = {"relaxation": {"update_s": update_s}, "drift": {"rule": "none"}}
    rig = Rig(1, 0.0, processing=processing)
    held = Rig(1, 0.0, hz=1.0, calibrate_s=60.0, processing=processing)
    press(rig, 20.0, 1)
    press(held, 20.0, 1)
    rig.t_ns += 3_600_000_000_000
    expected = press(held, 20.0, 3600)[-1].pressure_kpa[:6]
    after = press(rig, 20.0, 50)
    assert after[0].pressure_kpa[:6] == pytest.approx(expected, abs=0.5)
    assert after[-1].touched[:6].all()


@pytest.mark.parametrize("update_s", [0.0, 1.0])
@pytest.mark.parametrize("units", [20.0, 110.0])
def test_a_gap_counts_once_and_beyond_the_calibrated_range_too(units, update_s):
    processing = {"relaxation": {"update_s": update_s}, "drift": {"rule": "none"}}
    rig, held = (Rig(1, 0.0, hz=10.0, processing=processing) for _ in ("rig", "held"))
    press(rig, units, 20)
    press(held, units, 20)
    rig.t_ns += 30_000_000_000
    expected = press(held, units, 320)[-1].pressure_kpa[:6]
    assert press(rig, units, 20)[-1].pressure_kpa[:6] == pytest.approx(expected, rel=0.006)


def test_what_was_released_in_a_gap_is_no_touch_and_what_still_presses_is_one_at_once():
    hour_ns = 3_600_000_000_000
    for units in (0.0, 20.0):
        rig = Rig(1, 0.0)
        press(rig, 20.0, 50)
        rig.t_ns += hour_ns
        (frame,) = press(rig, units, 1)
        assert frame.touched[:6].all() == frame.touched.any() == (units > 0.0)


def test_foam_released_while_its_board_was_silent_has_recovered_when_it_is_back():
    rig = Rig(1, 0.0, hz=2.0, processing={"drift": {"rule": "none"}})
    press(rig, 28.0, 1200)
    rig.t_ns += 3_600_000_000_000
    light = press(rig, 5.5, 50)[-1].pressure_kpa[:6]
    # Of 12 kPa the foam takes a quarter, and little of the 14 kPa is left that it took before.
    assert (light > 6.0).all()


@pytest.mark.parametrize("update_s", [0.0, 1.0])
def test_a_taxel_that_reads_too_little_for_long_is_not_touched_when_it_is_back(update_s):
    rig = Rig(1, 0.0, processing={"drift": {"rule": "none"}, "relaxation": {"update_s": update_s}})
    press(rig, -30.0, 6000)
    assert not any(frame.touched.any() for frame in press(rig, 0.0, 300))
    press(rig, -30.0, 10)
    rig.t_ns += 3_600_000_000_000
    press(rig, -30.0, 1)
    assert not any(frame.touched.any() for frame in press(rig, 0.0, 300))


def test_a_clock_set_forward_by_decades_is_survived():
    rig = Rig(1, 0.0)
    press(rig, 20.0, 250)
    rig.t_ns += 10**18
    assert press(rig, 20.0, 50)[-1].touched[:6].all()


@pytest.mark.parametrize("raw", [0, 255])
def test_frames_of_one_value_are_survived(raw):
    rig = Rig(1, 0.3)
    present = np.ones(rig.n, bool)
    for _ in range(100):
        rig.t_ns += 40_000_000
        frame = rig.pipeline.step(0, np.full(rig.n, raw, np.uint8), present, rig.t_ns)
        assert np.isfinite(frame.pressure_kpa).all()
    assert frame.touched.all() == (raw == 0)
    for _ in range(200):
        frame = rig.step(0.0)
    assert not frame.touched.any()
    frame = press(rig, 20.0, 5)[-1]
    # Seconds of 255 read as if a load had lifted that was in all zeros.
    assert (frame.touched if raw < 255 else frame.touched | ~frame.valid)[:6].all()


@pytest.mark.parametrize("half_s", [0.5, 1.0, 3.0])
def test_what_stood_on_the_skin_when_it_was_calibrated_is_felt_after_some_steps(half_s):
    """Zeros with a load in them are low where it lifts, for however short a time."""
    rig = Rig(1, 0.5, processing=NO_RELAXATION)
    load = np.linspace(5.0, 30.0, rig.n)
    rig._resting += load.astype(np.float32)
    steps = round(half_s / rig.dt_s)
    for _ in range(round(12.0 / half_s)):
        for units in (np.zeros(rig.n), load):
            frames = [rig.step(units) for _ in range(steps)]
    assert frames[-1].valid.all()
    assert frames[-1].touched.mean() > 0.95
    right = CURVE.kpa(load[rig.n // 2 :])
    assert np.median(frames[-1].pressure_kpa[rig.n // 2 :] / right) == pytest.approx(1.0, abs=0.1)


def test_what_read_low_by_another_zero_shows_no_load_in_the_new_one():
    rig = Rig(1, 0.3)
    low = np.linspace(-12.0, -4.0, rig.n)
    press(rig, 0.0, 50, slice(None))
    press(rig, low, 15, slice(None))
    rig.pipeline.set_zero(np.arange(rig.n, dtype=np.int32), rig.true_baseline)
    press(rig, 0.0, 60, slice(None))
    press(rig, low, 15, slice(None))
    assert press(rig, 0.0, 60, slice(None))[-1].valid.all()
    assert np.abs(rig.pipeline.baseline - rig.true_baseline).max() < 1.0


def test_a_flickering_taxel_disturbs_no_other():
    rig = Rig(1, 0.3)
    rng = np.random.default_rng(2)
    for _ in range(1000):
        activation = np.zeros(rig.n)
        activation[50] = rng.choice([0.0, 230.0])
        frame = rig.step(activation)
        assert not np.delete(frame.touched, 50).any()
    assert np.abs(np.delete(rig.pipeline.baseline - rig.true_baseline, 50)).max() < 0.4


def test_what_a_hard_press_leaves_is_no_touch_though_it_would_be_one_by_itself():
    told = []
    for before_units in (0.0, 45.0):
        rig = Rig(1, 0.3, processing=NO_RELAXATION)
        press(rig, before_units, 50)
        press(rig, 0.0, 5)
        told.append(any(frame.touched.any() for frame in press(rig, 2.0, 50)))
    assert told == [True, False]


def test_what_a_hard_press_left_has_gone_after_an_hour_without_data():
    rig = Rig(1, 0.3, processing=NO_RELAXATION)
    press(rig, 45.0, 50)
    press(rig, 0.0, 5)
    rig.t_ns += 3_600_000_000_000
    # It fades in seconds without a gap, too.
    assert any(frame.touched.any() for frame in press(rig, 2.0, 10))


def left_in_foam_kpa(set_s, passed_s, sent_s=()):
    """Highest pressure that is reported of what a hold left in foam, after the clock was set and
    time has passed; frames stamped `sent_s` before it was set come after that is known.
    """
    rig = Rig(1, 0.3)
    press(rig, 40.0, 500)
    press(rig, 0.0, 5)
    rig.pipeline.clock_set(round(set_s * 1e9))
    for gap_s in sent_s:
        rig.t_ns += round(gap_s * 1e9)
        press(rig, 0.0, 1)
    rig.t_ns += round((set_s + passed_s) * 1e9)
    press(rig, 0.0, 1)
    return rig.pipeline.relaxation_kpa[:6].max()


def test_foam_does_not_recover_in_an_hour_by_which_the_clock_was_set():
    unset_kpa = left_in_foam_kpa(0.0, 0.0)
    assert unset_kpa > 1.0
    assert left_in_foam_kpa(3600.0, 0.0) == pytest.approx(unset_kpa, rel=1e-3)
    assert left_in_foam_kpa(3600.0, 0.0, sent_s=(0.04, 0.04)) == pytest.approx(
        left_in_foam_kpa(0.0, 0.0, sent_s=(0.04, 0.04)), rel=1e-3
    )


def test_foam_recovers_in_the_time_that_passes_beside_a_clock_that_is_set():
    assert left_in_foam_kpa(3600.0, 20.0) == pytest.approx(left_in_foam_kpa(0.0, 20.0), rel=1e-3)
    assert left_in_foam_kpa(3600.0, 20.0) < 0.7 * left_in_foam_kpa(3600.0, 0.0)


@pytest.mark.parametrize(("margin_units", "felt"), [(2.0, True), (255.0, False)])
def test_a_taxel_of_which_no_reading_is_a_touch_is_not_valid(margin_units, felt):
    rig = Rig(1, 0.3, processing={"touch": {"margin_units": margin_units}})
    (frame,) = press(rig, 0.0, 1)
    assert frame.valid.all() == frame.valid.any() == felt
    assert rig.pipeline.unreached.all() == rig.pipeline.unreached.any() == (not felt)


def test_a_sweep_of_which_nothing_is_published_is_processed_and_takes_no_number():
    published, followed = Rig(1, 0.0), Rig(1, 0.0)
    for units in (0.0, 20.0, 20.0, 20.0, 0.0, 0.0):
        (expected,) = press(published, units, 1)
        activation = np.zeros(followed.n)
        activation[:6] = units
        raw, present = followed.read(activation), np.ones(followed.n, bool)
        found = followed.pipeline.follow(0, raw, present, expected.t_ns)
        assert np.array_equal(found.touched, expected.touched)
        assert np.array_equal(found.valid, expected.valid)
        assert found.seq == 0
    assert expected.seq == 5


def test_frames_tell_the_time_that_passed_whatever_the_clock_is_set_to():
    rig = Rig(1, 0.3)
    step_ns = round(1e9 * rig.dt_s)
    first_ns = press(rig, 0.0, 1)[0].elapsed_ns
    hour_ns = 3600 * 1_000_000_000
    passed_ns = []
    for set_ns in (0, hour_ns, -hour_ns):
        rig.pipeline.clock_set(set_ns)
        rig.t_ns += set_ns
        frames = press(rig, 0.0, 3)
        passed_ns += [frame.elapsed_ns - first_ns for frame in frames]
        first_ns = frames[-1].elapsed_ns
    # The step before a clock that is set back is not known.
    assert passed_ns == [n * step_ns for n in (1, 2, 3, 1, 2, 3, 0, 1, 2)]
    rig.t_ns += hour_ns
    assert press(rig, 0.0, 1)[0].elapsed_ns - first_ns == hour_ns + step_ns


def test_a_clock_that_is_set_forward_and_back_before_any_sweep_changes_nothing():
    left_kpa = []
    for steps_s in ((), (3600, -3600)):
        rig = Rig(1, 0.3)
        press(rig, 40.0, 500)
        press(rig, 0.0, 5)
        for step_s in steps_s:
            rig.pipeline.clock_set(step_s * 1_000_000_000)
        rig.t_ns += 3_600_000_000_000
        press(rig, 0.0, 1)
        left_kpa.append(rig.pipeline.relaxation_kpa)
    assert np.array_equal(*left_kpa)


def test_a_byte_at_an_end_of_the_scale_is_told_beyond_range():
    rig = Rig(1, 0.3, processing={"pressure": {"a_kpa_per_ff2": 0.0}})
    raw = rig.read(0.0)
    for units in (0, 255):
        raw[5] = units
        frame = rig.pipeline.step(0, raw, np.ones(rig.n, bool), rig.t_ns)
        assert np.flatnonzero(frame.beyond_range).tolist() == [5]
        assert frame.valid[5]


def test_a_part_at_rest_is_never_told_as_touched():
    rig = Rig(2, 0.4, seed=1)
    assert not any(rig.step(0.0).touched.any() for _ in range(3000))


def test_a_rising_temperature_is_no_touch_and_a_press_on_it_is():
    rig = Rig(1, 0.3, seed=4)
    for sweep in range(4000):
        frame = rig.step(0.01 * sweep * rig.dt_s)
        assert not frame.touched.any()
    frame = [rig.step(16.0 + 10.0) for _ in range(5)][-1]
    assert frame.touched.all()


def test_a_ten_minute_hold_leaves_no_ghost_though_everything_drifts():
    rig = Rig(1, 0.3, hz=10.0, seed=6, processing=NO_RELAXATION)
    pressed = np.arange(rig.n) < 12
    sweep = 0

    def go(seconds, units):
        nonlocal sweep
        touched = []
        for _ in range(round(seconds * 10)):
            sweep += 1
            touched.append(rig.step(np.where(pressed, units, 0.0) + 0.0004 * sweep).touched)
        return np.array(touched)

    go(20, 0.0)
    assert go(600, 35.0)[5:, pressed].all()
    assert not go(60, 0.0)[3:].any()


@given(
    st.lists(
        st.tuples(st.integers(0, 255), st.booleans(), st.integers(-(10**10), 10**10)),
        min_size=1,
        max_size=40,
    )
)
@settings(deadline=None, max_examples=50)
def test_no_bytes_and_no_times_make_nonsense(samples):
    rig = SHARED
    t_ns = 0
    for code, here, step_ns in samples:
        t_ns += step_ns
        raw = np.full(rig.n, code, np.uint8)
        frame = rig.pipeline.step(0, raw, np.full(rig.n, here), t_ns)
        assert np.isfinite(frame.pressure_kpa).all()
        assert frame.pressure_kpa.min() >= 0.0
        assert not (frame.touched & ~frame.valid).any()
        assert not (frame.beyond_range & ~frame.valid).any()
        assert np.array_equal(frame.raw, raw)


SHARED = Rig(1, 0.3)


def test_a_new_threshold_changes_nothing_else():
    """What is remembered of the foam, of touches and of baselines goes on."""
    rigs = Rig(1, 0.3, seed=5), Rig(1, 0.3, seed=5)
    nobody = np.zeros(rigs[0].n, bool)
    for rig in rigs:
        press(rig, 30.0, 500)
    kept, renewed = rigs
    wider = msgspec.convert({"touch": {"margin_units": 2.1}}, Processing)
    renewed.pipeline.renew(wider, renewed.calibration, nobody)
    for units, sweeps in ((30.0, 50), (0.0, 500), (20.0, 50)):
        frames = [press(rig, units, sweeps) for rig in rigs]
        for one, other in zip(*frames, strict=True):
            assert one.seq == other.seq
            assert np.array_equal(one.touched, other.touched)
            assert other.pressure_kpa == pytest.approx(one.pressure_kpa, abs=1e-3)
    assert renewed.pipeline.baseline == pytest.approx(kept.pipeline.baseline)


def test_the_calibration_of_some_taxels_leaves_what_is_known_of_the_others():
    rig = Rig(1, 0.3, seed=5)
    press(rig, 30.0, 500, where=slice(0, 24))
    before = rig.pipeline.relaxation_kpa.copy()
    assert before[:24].min() > 1.0
    zeroed = np.arange(rig.n) >= 12
    rig.pipeline.renew(rig.settings.processing, rig.calibration, zeroed)
    assert np.array_equal(rig.pipeline.relaxation_kpa[:12], before[:12])
    assert not rig.pipeline.relaxation_kpa[12:].any()
    (frame,) = press(rig, 30.0, 1, where=slice(0, 12))
    assert frame.touched[:12].all()
    assert not frame.touched[12:].any()


def test_a_taxel_touched_for_long_and_a_baseline_at_its_limit_are_told():
    rig = Rig(
        1,
        0.3,
        hz=5.0,
        processing={
            "relaxation": {"model": "none"},
            "drift": {"frozen_report_s": 60.0, "limit_units": 4.0},
        },
    )
    press(rig, 20.0, 400, where=slice(0, 3))
    assert np.array_equal(np.flatnonzero(rig.pipeline.frozen(0)), range(3))
    press(rig, 0.0, 50)
    assert not rig.pipeline.frozen(0).any()
    for sweep in range(600):
        rig.step(0.01 * sweep)
    assert rig.pipeline.at_limit(0).all()


def test_a_new_zero_forgets_what_was_received_against_the_old_one():
    rig = Rig(1, 0.3, processing=NO_RELAXATION)
    press(rig, 0.0, 20)
    # Whatever the bytes were before the new zero: untouched is 244 from now on.
    vetoed = np.ones(rig.n, bool)
    vetoed[:12] = False
    raw = rig.read(0.0)
    raw[:12] = 244
    rig.pipeline.set_zero(
        np.arange(12, dtype=np.int32), np.full(12, float(rig.layout.no_load[0]) - 244.0)
    )
    for present in (vetoed, vetoed, vetoed, ~np.zeros(rig.n, bool)):
        rig.t_ns += 40_000_000
        frame = rig.pipeline.step(0, raw, present, rig.t_ns)
        assert not frame.touched.any()
    assert frame.valid.all()
    raw[3] = 214
    rig.t_ns += 40_000_000
    rig.pipeline.step(0, raw, np.ones(rig.n, bool), rig.t_ns)
    frame = rig.pipeline.step(0, raw, np.ones(rig.n, bool), rig.t_ns + 40_000_000)
    assert np.flatnonzero(frame.touched).tolist() == [3]


@pytest.mark.parametrize("units", [-12.0, -1.0, 1.0])
def test_a_zero_that_has_moved_becomes_the_zero(units):
    rig = Rig(1, 0.0)
    before = [rig.step(0.0) for _ in range(50)][-1].raw.astype(float)
    after = press(rig, units, 3000)[-1].raw.astype(float)
    zero = rig.layout.no_load - rig.pipeline.baseline
    assert zero[:6] == pytest.approx(after[:6], abs=0.3)
    assert zero[6:] == pytest.approx(before[6:], abs=0.3)


@pytest.mark.parametrize("units", [3.0, 8.0, 20.0])
def test_a_press_moves_no_zero(units):
    rig = Rig(1, 0.0)
    before = rig.pipeline.baseline.copy()
    press(rig, units, 250)
    assert rig.pipeline.baseline == pytest.approx(before, abs=0.3)


@pytest.mark.parametrize("units", [-12.0, 1.0])
def test_zeros_move_alike_whether_pressures_are_subscribed_or_not(units):
    rigs = [Rig(1, 0.0) for _ in range(2)]
    for _ in range(3000):
        for rig, pressures in zip(rigs, (True, False), strict=True):
            rig.t_ns += 40_000_000
            raw = rig.read(np.where(np.arange(rig.n) < 6, units, 0.0))
            rig.pipeline.step(0, raw, np.ones(rig.n, bool), rig.t_ns, pressures)
    watched, unwatched = (rig.pipeline.baseline for rig in rigs)
    assert unwatched == pytest.approx(watched, abs=0.05)


def test_zeros_move_alike_with_noise_whether_pressures_are_subscribed_or_not():
    """Of sweeps that are not computed each byte counts, not one for all."""
    rigs = [Rig(1, 0.5, hz=50.0) for _ in range(2)]
    for sweep in range(50 * 60):
        for rig, pressures in zip(rigs, (True, False), strict=True):
            rig.t_ns += 20_000_000
            raw = rig.read(0.02 * sweep / 50.0)
            rig.pipeline.step(0, raw, rig._present, rig.t_ns, pressures)
    watched, unwatched = (rig.pipeline.baseline for rig in rigs)
    assert unwatched == pytest.approx(watched, abs=0.02)


def test_what_was_read_against_an_old_zero_does_not_count_against_the_new_one():
    rigs = [Rig(1, 0.0, hz=50.0) for _ in range(2)]
    for rig, pressures in zip(rigs, (True, False), strict=True):
        for sweep in range(200):
            rig.t_ns += 20_000_000
            if sweep == 105:
                rig._resting -= np.float32(20.0)
                rig.pipeline.set_zero(np.arange(rig.n, dtype=np.int32), rig.true_baseline)
            frame = rig.pipeline.step(0, rig.read(0.0), rig._present, rig.t_ns, pressures)
            assert not frame.touched.any()
    watched, unwatched = (rig.pipeline.baseline for rig in rigs)
    assert unwatched == pytest.approx(watched, abs=0.02)


@pytest.mark.parametrize(
    ("hz", "rate", "update_s", "pressures", "loss"),
    [
        (10.0, 0.2, 1.0, True, 0.0),
        (4.8, 0.1, 1.0, True, 0.0),
        (20.0, 0.1, 1.0, False, 0.0),
        (4.8, 0.1, 1.0, False, 0.0),
        (20.0, 0.1, 0.2, True, 0.0),
        (20.0, 0.1, 0.5, False, 0.0),
        (20.0, 0.3, 5.0, True, 0.0),
        (20.0, 0.1, 1.0, True, 0.3),
        (10.0, 0.1, 0.3, False, 0.4),
    ],
)
def test_a_skin_that_grows_warm_is_untouched_at_every_rate_of_its_boards(
    hz: float, rate: float, update_s: float, pressures: bool, loss: float
) -> None:
    """Means of few sweeps are noisy, so that pads of drifting skin seem to move apart."""
    processing = {"relaxation": {"update_s": update_s}}
    rig = Rig(1, None, hz=hz, seed=0, calibrate_s=10.0, processing=processing)
    rng = np.random.default_rng(5)
    for sweep in range(round(60.0 * hz)):
        rig.t_ns += rig._dt_ns
        drifted = rate * min(sweep / hz, 8.0 / rate)
        present = np.repeat(rng.random(rig.n // 12) >= loss, 12)
        raw = np.where(present, rig.read(drifted), 0).astype(np.uint8)
        frame = rig.pipeline.step(0, raw, present, rig.t_ns, pressures)
        assert not frame.touched.any()
    behind = rig.true_baseline + drifted - rig.pipeline.baseline
    assert np.median(np.abs(behind)) < 0.5


@pytest.mark.parametrize("pressures", [True, False])
@pytest.mark.parametrize("hz", [5.0, 10.0, 20.0])
@pytest.mark.parametrize("units", [3.0, 8.0])
def test_a_steady_press_of_a_whole_part_is_no_drift_at_any_rate(
    units: float, hz: float, pressures: bool
) -> None:
    rig = Rig(1, None, hz=hz, seed=1, calibrate_s=10.0, processing=NO_RELAXATION)
    for _ in range(round(60.0 * hz)):
        rig.t_ns += rig._dt_ns
        frame = rig.pipeline.step(0, rig.read(units), rig._present, rig.t_ns, pressures)
    # A slow rise of 0.01 units/s is followed.
    assert np.median(rig.pipeline.baseline - rig.true_baseline) < 0.7
    assert frame.touched.mean() > 0.8


@pytest.mark.parametrize("update_s", [0.2, 0.7, 3.0])
def test_how_often_states_are_updated_hardly_changes_what_the_foam_keeps(
    update_s: float,
) -> None:
    rigs = [
        Rig(1, 0.0, processing={"relaxation": {"update_s": seconds}}) for seconds in (0.0, update_s)
    ]
    for units, seconds in ((25.0, 30), (0.0, 15), (12.0, 15)):
        for rig in rigs:
            press(rig, units, 25 * seconds)
        each, some = (rig.pipeline.relaxation_kpa[:6] for rig in rigs)
        assert some == pytest.approx(each, abs=0.3 + 0.3 * update_s)


def test_a_first_sample_before_a_gap_is_survived():
    rig = Rig(1, 0.0)
    with np.errstate(divide="raise", invalid="raise"):
        press(rig, 20.0, 1)
        rig.t_ns += 3_600_000_000_000
        frames = press(rig, 0.0, 50)
    assert not frames[-1].touched.any()
    assert rig.pipeline.baseline == pytest.approx(rig.true_baseline, abs=0.5)


@pytest.mark.parametrize("shift_units", [20.0, -12.0])
def test_drift_is_limited_from_the_zero_that_a_board_has(shift_units: float):
    """Held near the zero before, all of a board would read pressed, or nothing."""
    rig = Rig(1, 0.3, seed=5, hz=25.0, processing={"drift": {"limit_units": 5.0}})
    press(rig, 0.0, 50)
    rig._resting -= np.float32(shift_units)
    rig.pipeline.set_zero(np.arange(rig.n, dtype=np.int32), rig.true_baseline)
    assert not any(frame.touched.any() for frame in press(rig, 0.0, 125))
    assert rig.pipeline.baseline == pytest.approx(rig.true_baseline, abs=0.5)
    assert not rig.pipeline.at_limit(0).any()
    rig.pipeline.renew(rig.settings.processing, rig.calibration, np.zeros(rig.n, bool))
    assert rig.pipeline.baseline == pytest.approx(rig.true_baseline, abs=0.5)
    frames = press(rig, 20.0, 5)
    assert np.array_equal(np.flatnonzero(frames[-1].touched), range(6))


def test_a_tap_after_a_board_was_zeroed_is_felt_in_full_though_its_foam_had_been_pressed():
    """What the foam keeps of the press is in the new zero, and must not be taken off twice."""
    rig = Rig(1, 0.3, seed=5, hz=50.0)
    curve = PressureCurve(rig.layout.unit_ff / rig.layout.sensitivity)
    pressed = np.arange(rig.n) < 12
    press(rig, 40.0, 50 * 60, where=pressed)
    for _ in range(50 * 8):
        rig.step(curve.units(rig.pipeline.relaxation_kpa))
    left_units = curve.units(rig.pipeline.relaxation_kpa)
    assert left_units[:12].min() > 1.5
    zeroed = pressed & (np.arange(rig.n) % 12 < 6)
    rig.pipeline.set_zero(
        np.flatnonzero(zeroed).astype(np.int32), (rig.true_baseline + left_units)[zeroed]
    )
    assert not rig.pipeline.relaxation_kpa[zeroed].any()
    assert rig.pipeline.relaxation_kpa[6:12].min() > 4.0
    tapped = curve.units(np.where(pressed, 12.0, 0.0)) + left_units
    frames = [rig.step(tapped) for _ in range(20)]
    assert frames[-1].touched[:12].all()
    felt_kpa = np.mean([frame.pressure_kpa[:6] for frame in frames])
    assert felt_kpa == pytest.approx(12.0, abs=1.5)


def test_relaxation_fades_after_a_release_alike_whether_pressures_are_subscribed_or_not():
    rigs = [Rig(1, 0.0, hz=50.0) for _ in range(2)]
    for sweep in range(50 * 30):
        for rig, pressures in zip(rigs, (True, False), strict=True):
            rig.t_ns += 20_000_000
            units = 30.0 if sweep < 50 * 20 else 0.0
            raw = rig.read(np.where(np.arange(rig.n) < 6, units, 0.0))
            rig.pipeline.step(0, raw, np.ones(rig.n, bool), rig.t_ns, pressures)
        watched, unwatched = (rig.pipeline.relaxation_kpa for rig in rigs)
        assert unwatched == pytest.approx(watched, abs=0.1)
    assert watched[:6].min() > 0.5


def test_without_a_subscriber_an_untouched_part_is_computed_five_times_a_second():
    rig = Rig(1, 0.0, hz=50.0)
    present = np.ones(rig.n, bool)
    frames = []
    for _ in range(500):
        rig.t_ns += 20_000_000
        frames.append(rig.pipeline.step(0, rig.read(0.0), present, rig.t_ns, pressures=False))
    assert sum(frame.computed for frame in frames) == pytest.approx(50, abs=12)
    idle = next(frame for frame in frames if not frame.computed)
    assert not idle.pressure_kpa.any()
    assert not idle.touched.any()
    assert idle.valid.all()


def test_a_sweep_that_is_only_followed_takes_no_number_and_counts_as_any_other():
    rig = Rig(1, 0.0)
    press(rig, 20.0, 5)
    rig.t_ns += 40_000_000
    raw = rig.read(np.where(np.arange(rig.n) < 6, 20.0, 0.0))
    frame = rig.pipeline.follow(0, raw, np.ones(rig.n, bool), rig.t_ns)
    assert frame.touched[:6].all()
    assert rig.pipeline.seq(0) == 5
    assert press(rig, 20.0, 1)[0].seq == 5
    assert rig.pipeline.seq(0) == 6


def test_every_taxel_detects_the_pressure_that_is_named_for_its_part_within_a_second():
    rig = Rig(1, 0.8, seed=3, hz=50.0, calibrate_s=20.0, processing=NO_RELAXATION)
    kpa = rig.pipeline.decides_kpa(0)
    assert 1.0 < kpa < 50.0
    units = float(CURVE.units(np.array([kpa]))[0])
    frames = press(rig, units, 50, where=slice(None))
    seen = np.array([frame.touched for frame in frames]).any(axis=0)
    assert seen.mean() > 0.98


def test_a_frame_keeps_its_bytes_when_the_reader_uses_its_buffer_again():
    rig = Rig(1, 0.0)
    raw = rig.read(0.0)
    frame = rig.pipeline.step(0, raw, np.ones(rig.n, bool), 40_000_000)
    sent = raw.copy()
    raw[:] = 0
    assert np.array_equal(frame.raw, sent)
    later = rig.pipeline.step(0, sent, np.zeros(rig.n, bool), 80_000_000)
    assert not later.touched.any()


def test_pressures_beyond_the_calibrated_range_are_told_so_below_the_end_of_the_scale_too():
    rig = Rig(1, 0.0, processing=NO_RELAXATION)
    # The paper's curve is calibrated up to 131 kPa.
    limit_units = float(CURVE.units(np.array([131.0]))[0])
    for units, beyond in ((limit_units - 2.0, False), (limit_units + 3.0, True)):
        frame = press(rig, units, 5)[-1]
        assert frame.beyond_range[:6].all() == frame.beyond_range[:6].any() == beyond
        assert not frame.beyond_range[6:].any()
        assert frame.pressure_kpa[:6] == pytest.approx(CURVE.kpa(units)[0], rel=0.05)


def test_another_model_of_the_foam_begins_without_what_the_last_one_had_taken_off():
    rig = Rig(1, 0.0)
    press(rig, 30.0, 500)
    assert rig.pipeline.relaxation_kpa[:6].min() > 1.0
    other = msgspec.convert(NO_RELAXATION, Processing)
    rig.pipeline.renew(other, rig.calibration, np.zeros(rig.n, bool))
    assert not rig.pipeline.relaxation_kpa.any()
    frame = press(rig, 30.0, 1)[0]
    assert frame.pressure_kpa[:6] == pytest.approx(CURVE.kpa(30.0)[0], abs=3.5)


def test_a_new_calibration_of_some_taxels_gives_them_their_new_zero():
    rig = Rig(1, 0.0)
    moved = rig.calibration.baseline + 2.0
    calibration = replace(rig.calibration, baseline=moved)
    before = rig.pipeline.baseline.copy()
    zeroed = np.arange(rig.n) < 12
    rig.pipeline.renew(rig.settings.processing, calibration, zeroed)
    assert np.array_equal(rig.pipeline.baseline[:12], moved[:12])
    assert np.array_equal(rig.pipeline.baseline[12:], before[12:])


def test_a_zero_that_rises_slowly_beneath_a_long_hold_is_followed():
    rig = Rig(1, 0.0, hz=10.0, processing=NO_RELAXATION)
    before = rig.pipeline.baseline[:6].copy()
    for sweep in range(6000):
        press(rig, 30.0 + 0.0004 * sweep, 1)
    assert rig.pipeline.baseline[:6] - before == pytest.approx(np.full(6, 2.4), abs=0.7)
    assert not any(frame.touched.any() for frame in press(rig, 2.4, 50)[3:])


def test_what_a_taxel_read_before_its_calibration_does_not_move_its_new_zero():
    rig = Rig(1, 0.0)
    press(rig, -12.0, 12, where=slice(None))  # half of a window of a second
    rig.pipeline.renew(rig.settings.processing, rig.calibration, np.ones(rig.n, bool))
    for _ in range(40):
        rig.step(0.0)
    assert rig.pipeline.baseline == pytest.approx(rig.calibration.baseline, abs=0.5)


def test_a_calibration_of_taxels_forgets_what_a_hard_press_left():
    rig = Rig(1, 0.3, processing=NO_RELAXATION)
    press(rig, 45.0, 50)
    press(rig, 0.0, 5)
    rig.pipeline.renew(rig.settings.processing, rig.calibration, np.ones(rig.n, bool))
    assert any(frame.touched.any() for frame in press(rig, 2.0, 50))


@pytest.mark.parametrize("units", [25.0, 110.0])
def test_what_is_reported_and_what_the_foam_takes_are_together_what_the_curve_reads(units):
    rig = Rig(1, 0.0)
    press(rig, 40.0, 1500)
    frame = press(rig, units, 3)[-1]
    taken = rig.pipeline.relaxation_kpa[:6]
    read = (rig.layout.no_load - rig.pipeline.baseline - frame.raw)[:6]
    assert taken.min() > 5.0
    assert frame.pressure_kpa[:6] + taken == pytest.approx(CURVE.kpa(read), rel=0.01)


def two_parts():
    """A skin of two parts of one board each, with temperature pads."""
    patch = {"triangles": "0-15", "kind": "triangle_10pad", "shift": 3}
    skin = msgspec.convert(
        {
            "robot": "two",
            "buses": {"can0": {}},
            "boards": {
                name: {"bus": "can0", "address": number}
                for number, name in enumerate(("a", "b"), start=1)
            },
            "parts": {
                name: {
                    "foam_mm": 2.0,
                    "patches": [{"board": board, **patch}],
                }
                for name, board in (("first", "a"), ("second", "b"))
            },
        },
        Settings,
    )
    return skin, build_layout(skin, Path())


def test_a_part_is_processed_alike_whatever_part_comes_before_it():
    rig = Rig(1, 0.4, kind="triangle_10pad", hz=10.0, seed=8)
    n = rig.n
    skin, layout = two_parts()
    present = np.ones(n, bool)
    calibrator = Calibrator(layout)
    for number in range(100):
        calibrator.add(0, np.full(n, 230 - number % 2, np.uint8), present)
        calibrator.add(1, rig.read(0.0), present)
    found = calibrator.finish("x", "t")
    both = Pipeline(layout, skin.processing, found)
    arrays = ("baseline", "percentile", "noise", "spread", "gain", "bend", "verdict")
    second = {name: getattr(found, name)[n:] for name in arrays}
    alone_found = replace(rig.calibration, **second)
    alone = Pipeline(rig.layout, skin.processing, alone_found)
    pressed = np.arange(n) < 24
    for sweep in range(900):
        t_ns = sweep * 100_000_000
        raw = rig.read(np.where(pressed, 25.0 * (100 <= sweep < 500), -0.002 * sweep))
        # The first part is touched when the second is not.
        other = np.full(n, 230 - 40 * (sweep >= 500), np.uint8)
        assert both.step(0, other, present, t_ns).touched.any() == (sweep > 500)
        one, same = alone.step(0, raw, present, t_ns), both.step(1, raw, present, t_ns)
        assert same.part == "second"
        assert np.array_equal(same.touched, one.touched)
        assert np.array_equal(same.valid, one.valid)
        assert same.pressure_kpa == pytest.approx(one.pressure_kpa)
    assert both.baseline[n:] == pytest.approx(alone.baseline)
    assert both.decides_kpa(1) == alone.decides_kpa(0)
    some = np.arange(12, dtype=np.int32)
    for pipeline, before in ((both, n), (alone, 0)):
        zeroed = np.zeros(before + n, bool)
        zeroed[before + 24 :] = True
        pipeline.renew(skin.processing, found if before else alone_found, zeroed)
        pipeline.set_zero(before + some, np.full(12, 30.0))
    assert both.baseline[n:] == pytest.approx(alone.baseline)
    raw[some] = 255 - 30
    assert np.array_equal(
        both.step(1, raw, present, t_ns).touched, alone.step(0, raw, present, t_ns).touched
    )
