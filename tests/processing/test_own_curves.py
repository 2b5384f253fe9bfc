"""What a part with fitted curves makes of bytes at the ends of the scale, jumps and slow rises."""

import numpy as np
import pytest

from skin_host.evaluation.rig import Rig
from skin_host.processing.curves import CurveVerdict
from skin_host.processing.pipeline import ROWS
from tests.processing.fitting.test_course import use_own_curves

PRESSED = np.arange(192) < 12


def own(noise_units=0.4, **keys) -> Rig:
    rig = Rig(1, 0.0, seed=5, hz=50.0, **keys)
    use_own_curves(rig, noise_units)
    return rig


def hold(rig, units, sweeps, where=PRESSED):
    return [rig.step(np.where(where, units, 0.0)) for _ in range(sweeps)]


def sent(rig, raw):
    rig.t_ns += 20_000_000
    return rig.pipeline.step(0, raw, np.ones(rig.n, bool), rig.t_ns)


@pytest.mark.parametrize("end", [0, 255])
def test_a_byte_at_an_end_of_the_scale_is_no_reading_of_a_pad_with_its_own_curve(end):
    rig = own()
    raw = rig.read(0.0)
    raw[[3, 7]] = end
    for _ in range(5):
        frame = sent(rig, raw)
        assert np.flatnonzero(~frame.valid).tolist() == [3, 7]
        assert not frame.touched.any()
        assert not frame.pressure_kpa[[3, 7]].any()
    assert sent(rig, rig.read(0.0)).valid.all()


def test_a_pad_that_rests_near_the_end_of_the_scale_may_send_its_last_byte():
    rig = own()
    near = np.arange(12, dtype=np.int32)
    rig.pipeline.set_zero(near, np.full(12, float(rig.layout.no_load[0]) - 250.0))
    raw = rig.read(0.0)
    raw[:12] = 250
    raw[[3, 20]] = 255
    assert np.flatnonzero(~sent(rig, raw).valid).tolist() == [20]


def test_pads_without_their_own_curve_read_both_ends_of_the_scale():
    rig = Rig(1, 0.0, seed=5, hz=50.0)
    use_own_curves(rig, 0.4, CurveVerdict.UNKNOWN)
    raw = rig.read(0.0)
    raw[[3, 7]] = 0, 255
    frame = sent(rig, raw)
    assert frame.valid.all()
    assert np.flatnonzero(frame.beyond_range).tolist() == [3, 7]


def test_a_pad_that_jumps_to_and_fro_under_pressure_is_not_valid_until_it_is_calm():
    rig = own()
    hold(rig, 20.0, 20)
    jumping = np.arange(192) == 3
    for sweep in range(60):
        frame = rig.step(np.where(PRESSED, 20.0, 0.0) + np.where(jumping, 30.0 * (sweep % 2), 0.0))
    assert np.flatnonzero(~frame.valid).tolist() == [3]
    assert not frame.touched[3]
    assert frame.pressure_kpa[3] == 0.0
    frames = hold(rig, 20.0, 50 * 65)
    assert not frames[50 * 55].valid[3]
    assert frames[-1].valid.all()


def test_a_load_that_grows_slowly_is_pressure_and_not_drift():
    """A unit a minute is drift on a skin of the common curve; fitted ones know better."""
    pressure = {}
    for fitted in (False, True):
        rig = Rig(1, 0.0, hz=5.0)
        if fitted:
            use_own_curves(rig, 0.4)
        for second in range(600):
            for _ in range(5):
                frame = rig.step(np.where(PRESSED, second / 60.0, 0.0))
        pressure[fitted] = frame.pressure_kpa[PRESSED].mean()
    assert pressure[False] < 5.0
    assert pressure[True] > 15.0


def test_a_zero_that_falls_is_followed():
    rig = own()
    before = rig.pipeline.baseline.copy()
    hold(rig, -3.0, 50 * 60)
    fallen = rig.pipeline.baseline - before
    assert fallen[PRESSED] == pytest.approx(-3.0, abs=0.6)
    assert fallen[~PRESSED] == pytest.approx(0.0, abs=0.5)


def test_a_calibration_of_some_pads_forgets_what_these_felt_and_no_others():
    rig = Rig(1, 0.0, seed=5, hz=50.0)
    calibration = use_own_curves(rig, 0.4)
    hold(rig, 30.0, 100)
    held = hold(rig, 10.0, 1)[0].pressure_kpa
    rig.pipeline.renew(rig.settings.processing, calibration, np.arange(192) < 6)
    kpa = hold(rig, 10.0, 10)[-1].pressure_kpa
    assert kpa[6:12] == pytest.approx(held[6:12], abs=0.5)
    # What the foam remembers of the harder press is taken off the others alone.
    assert kpa[:6].min() > held[:12].max() + 1.0
    (frame,) = hold(rig, 0.0, 3)[2:]
    assert not frame.touched.any()


def test_untouched_pads_are_smoothed_over_some_sweeps_and_touched_ones_follow_each():
    rig = own()
    hold(rig, 20.0, 5 * ROWS)
    frames = [
        rig.step(np.where(PRESSED, 20.0 + 3.0 * (sweep % 5), 1.0)) for sweep in range(2 * ROWS)
    ]
    shown = np.array([frame.pressure_kpa for frame in frames])
    changes = np.count_nonzero(np.diff(shown, axis=0), axis=0)
    assert changes[PRESSED].min() == 2 * ROWS - 1
    assert 1 <= changes[~PRESSED].max() <= 2


def test_frames_that_were_taken_before_do_not_change():
    rig = own()
    hold(rig, 20.0, 10)
    frames = hold(rig, 20.0, 3)
    copies = [frame.pressure_kpa.copy() for frame in frames]
    hold(rig, 40.0, 3 * ROWS)
    for frame, copy in zip(frames, copies, strict=True):
        assert np.array_equal(frame.pressure_kpa, copy)


def test_a_pad_that_jumps_where_nothing_presses_makes_no_touch_and_stays_valid():
    rig = own()
    hold(rig, 20.0, 20)
    hold(rig, 0.0, 5 * ROWS)
    for sweep in range(500):
        frame = hold(rig, 30.0 * (sweep % 4 == 0), 1, np.arange(192) == 3)[0]
        assert not frame.touched.any()
        assert frame.valid.all()
