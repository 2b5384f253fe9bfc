"""What a part with fitted curves makes of bytes at the ends of the scale, jumps and slow rises."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.config.settings import Drift
from skin_host.evaluation.rig import Rig
from skin_host.processing.curves import Curves, CurveVerdict, Memory
from skin_host.processing.drift import BaselineTracker
from skin_host.processing.fitting.course import limit_kpa, make_memory
from skin_host.processing.frame import PressureFrame
from skin_host.processing.own_curves import RISE_UNITS_PER_S, OwnCurves
from skin_host.processing.pressure import PressureCurve
from skin_host.processing.smoothing import StepFilter
from skin_host.processing.windows import ROWS
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


def press_to_the_end(rig, units):
    """Press pads to so many units, and then as far as makes them send 0; return the frames."""
    hold(rig, units / 2, 10)
    hold(rig, units, 10)
    raw = rig.read(0.0)
    raw[PRESSED] = 0
    return [sent(rig, raw) for _ in range(100)]


def test_a_press_to_the_end_of_the_scale_stays_one_with_an_own_curve():
    frames = press_to_the_end(own(), 200.0)
    for frame in frames:
        assert frame.valid.all()
        assert frame.touched.tolist() == PRESSED.tolist()
        assert frame.beyond_range.tolist() == PRESSED.tolist()
    assert (frames[-1].pressure_kpa[PRESSED] > frames[0].pressure_kpa[PRESSED] * 0.99).all()


def test_a_contact_that_breaks_in_a_light_press_is_no_reading():
    frames = press_to_the_end(own(), 60.0)
    for frame in frames:
        assert frame.valid.tolist() == (~PRESSED).tolist()
    assert not frames[-1].touched.any()


def test_a_press_at_the_end_of_the_scale_stays_one_over_a_gap():
    rig = own()
    press_to_the_end(rig, 200.0)
    rig.t_ns += 5_000_000_000
    raw = rig.read(0.0)
    raw[PRESSED] = 0
    frames = [sent(rig, raw) for _ in range(10)]
    assert all(frame.valid.all() for frame in frames)
    assert frames[-1].touched.tolist() == PRESSED.tolist()
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


def test_a_chip_whose_pads_jump_to_and_fro_under_pressure_is_not_read():
    """Real triangles did, all at once, when the air in the chamber pressed their connection."""
    rig = own()
    hold(rig, 20.0, 20)
    rng = np.random.default_rng(4)
    level = 0.0
    chip = np.arange(12)
    # Pads 9 to 11 have not shown it yet.
    jumping = np.isin(np.arange(192), chip[:9])
    for sweep in range(200):
        level = 40.0 * rng.integers(2) if sweep % 2 == 0 else level
        frame = rig.step(np.where(PRESSED, 20.0, 0.0) + np.where(jumping, level, 0.0))
    assert np.flatnonzero(~frame.valid).tolist() == chip.tolist()
    assert not frame.touched.any()


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


@pytest.mark.parametrize("loss", [0.0, 0.1])
@pytest.mark.parametrize("pressures", [False, True])
@pytest.mark.parametrize(
    ("hz", "presses_per_s", "share"),
    [(20.0, 2.0, 0.3), (50.0, 4.9, 0.5), (100.0, 4.0, 0.25), (100.0, 4.9, 0.25)],
)
def test_pads_that_a_hand_taps_stay_valid(
    hz: float, presses_per_s: float, share: float, pressures: bool, loss: float
):
    """Also where sweeps are lost, or computed more seldom while nothing touches the pad."""
    rig = Rig(1, 0.3, seed=5, hz=hz)
    use_own_curves(rig, 0.4)
    rng = np.random.default_rng(1)
    for sweep in range(round(10.0 * hz)):
        phase = sweep / hz * presses_per_s % 1.0 / share
        raw = rig.read(np.where(PRESSED, 40.0 * np.sin(np.pi * min(phase, 1.0)), 0.0))
        rig.t_ns += round(1e9 / hz)
        if rng.random() >= loss:
            frame = rig.pipeline.step(0, raw, np.ones(rig.n, bool), rig.t_ns, pressures)
            assert frame.valid.all()


def test_a_calibration_elsewhere_leaves_memory_and_doubts_of_other_pads():
    """Each calibration reads the fitted curves again from their file."""
    rig = own()
    hold(rig, 40.0, 50)
    jumping = np.arange(192) == 3
    for sweep in range(60):
        rig.step(np.where(PRESSED, 20.0, 0.0) + np.where(jumping, 20.0 * (sweep % 2), 0.0))
    relaxation_kpa = rig.pipeline.relaxation_kpa[4:12].copy()
    assert relaxation_kpa.min() > 1.0
    elsewhere = np.arange(192) >= 180
    again = use_own_curves(rig, 0.4, zeroed=elsewhere)
    assert rig.pipeline.relaxation_kpa[4:12].tolist() == relaxation_kpa.tolist()
    (frame,) = hold(rig, 20.0, 1)
    assert np.flatnonzero(~frame.valid).tolist() == [3]
    rig.pipeline.renew(rig.settings.processing, again, jumping)
    assert hold(rig, 20.0, 1)[-1].valid.all()
    use_own_curves(rig, 0.5)  # fitted again: another foam
    assert not rig.pipeline.relaxation_kpa.any()


def test_a_board_that_was_zeroed_leaves_a_broken_contact_in_doubt():
    rig = own()
    jumping = np.arange(192) == 3
    for sweep in range(60):
        rig.step(np.where(PRESSED, 20.0, 0.0) + np.where(jumping, 30.0 * (sweep % 2), 0.0))
    rig.pipeline.set_zero(np.arange(12, dtype=np.int32), rig.true_baseline[:12])
    (frame,) = hold(rig, 0.0, 1)
    assert np.flatnonzero(~frame.valid).tolist() == [3]


def test_another_time_of_smoothing_takes_effect_with_the_next_samples():
    """And nothing else changes: neither what the foam remembers nor what is smoothed so far."""
    rig = Rig(1, 1.0, seed=5, hz=50.0)
    calibration = use_own_curves(rig, 1.0)
    hold(rig, 40.0, 50)
    for smoothing_s, least, most in ((0.5, 0.0, 1.0), (0.0, 1.5, 5.0)):
        changed = msgspec.structs.replace(
            rig.settings.processing,
            pressure=msgspec.structs.replace(
                rig.settings.processing.pressure, smoothing_s=smoothing_s
            ),
        )
        memory_kpa = rig.pipeline.relaxation_kpa.copy()
        rig.pipeline.renew(changed, calibration, np.zeros(rig.n, bool))
        assert rig.pipeline.relaxation_kpa.tolist() == memory_kpa.tolist()
        pressures = [frame.pressure_kpa[:12] for frame in hold(rig, 20.0, 100)][50:]
        assert least < np.std(np.diff(pressures, axis=0)) < most


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


N, DT_S, SMOOTHING_S = 20, 0.02, 0.1
CURVE = PressureCurve(np.full(N, 2.88))
MEMORY = Memory((5.0, 20.0), (0.2, 0.1))
#: Pads without an own curve.
WITHOUT = [3, 5]


def curves(memory=MEMORY):
    verdict = np.full(N, CurveVerdict.GOOD, np.uint8)
    verdict[WITHOUT] = CurveVerdict.UNKNOWN
    noise = np.linspace(0.2, 1.0, N)
    nothing = np.zeros((N, 1)), np.full(N, 60.0)
    return Curves(*nothing, noise, np.zeros(N), verdict, 150.0, 0.0, memory)


class OnePad:
    """A pad with a filter and a memory of its own, as nothing but its readings decide.

    Without an own curve its noise is not known, and nothing is smoothed.

    Touched, or where much is, it is worked out in each sweep; otherwise from the mean of some.
    """

    def __init__(self, pad, memory):
        limit = limit_kpa(CURVE, curves().noise_units)[pad : pad + 1]
        limit = np.where(np.isin(pad, WITHOUT), 0.0, limit)
        self.filter = StepFilter(limit, SMOOTHING_S, np.float32)
        self.memory = make_memory(1, memory, np.float32)
        self.relaxation = np.zeros(1, np.float32)
        self.reported = 0.0

    def report(self):
        self.reported = max(float((self.filter.smooth - self.relaxation)[0]), 0.0)

    def remember(self):
        if self.memory is not None:
            self.relaxation = self.memory.step(self.filter.smooth, DT_S).copy()

    def follow(self, kpa):
        self.filter.step(np.array([kpa], np.float32), DT_S)
        self.remember()
        self.report()

    def fold(self, mean_kpa, elapsed_s):
        self.filter.step(np.array([mean_kpa], np.float32) + self.relaxation, elapsed_s)
        self.report()


@given(
    st.lists(
        st.tuples(
            st.sets(st.integers(0, N - 1), max_size=7),
            st.integers(1, 2 * ROWS),
            st.integers(0, 2**32 - 1),
        ),
        min_size=1,
        max_size=8,
    ),
    st.sampled_from([MEMORY, Memory()]),
)
def test_a_pads_pressure_is_that_of_its_own_filter_and_memory_whatever_others_feel(phases, memory):
    own = OwnCurves(CURVE, curves(memory), slice(0, N), np.arange(N, dtype=np.int32), SMOOTHING_S)
    pads = [OnePad(pad, memory) for pad in range(N)]
    relaxation = np.zeros(N, np.float32)
    rows, sweeps, felt = [], 0, set()
    for touched, count, seed in phases:
        rng = np.random.default_rng(seed)
        mask = np.isin(np.arange(N), list(touched))
        apart = touched if 4 * len(touched) <= N else set(range(N))
        felt |= touched
        for pad in pads:
            pad.report()
        level = rng.uniform(0.0, 60.0, N)
        for _ in range(count):
            kpa = (level + rng.normal(0.0, 2.0, N)).astype(np.float32)
            reported = own.step(kpa, DT_S, mask, relaxation)
            for pad in sorted(apart):
                pads[pad].follow(kpa[pad])
            wanted = [pad.reported for pad in pads]
            assert reported == pytest.approx(wanted, rel=1e-4, abs=1e-3)
            rows.append(kpa - relaxation)
            sweeps += 1
            if len(rows) == ROWS:
                own.fold(np.array(rows), np.sum(rows, axis=0), relaxation)
                for number, pad in enumerate(pads):
                    if number not in apart:
                        last = [rows[-1][number]] if number in felt else [r[number] for r in rows]
                        pad.fold(np.mean(last), ROWS * DT_S)
                    pad.report()
                rows, felt = [], set(touched)
            if sweeps % 25 == 0:
                own.end_window(25 * DT_S, relaxation)
                for number, pad in enumerate(pads):
                    if number not in apart:
                        pad.remember()
            told = np.concatenate([pad.relaxation for pad in pads])
            assert relaxation == pytest.approx(told, rel=1e-4, abs=1e-3)


def test_what_is_reset_begins_anew_and_the_others_go_on():
    own = OwnCurves(CURVE, curves(), slice(0, N), np.arange(N, dtype=np.int32), SMOOTHING_S)
    relaxation = np.zeros(N, np.float32)
    touched = np.arange(N) < 3
    kpa = np.zeros(N, np.float32)
    kpa[[7, 9]] = 3.0
    for press in (40.0, 40.0, 40.0, 20.0):
        kpa[touched] = press
        for _ in range(4):
            for _ in range(ROWS):
                before = own.step(kpa, DT_S, touched, relaxation)
                sums = ROWS * (kpa - relaxation)
            own.fold(np.tile(kpa - relaxation, (ROWS, 1)), sums, relaxation)
    assert relaxation[:3].min() > 1.0
    assert before[[7, 9]] == pytest.approx(3.0, abs=0.1)
    reset = np.isin(np.arange(N), [1, 2, 7])
    own.reset(reset)
    relaxation[reset] = 0.0
    kpa[2] = 0.0
    after = own.step(kpa, DT_S, touched, relaxation)
    assert after[[0, 9]] == pytest.approx(before[[0, 9]], abs=0.1)
    # Nothing is remembered of the harder press, nor smoothed with it: a press begins, or none.
    assert after[1] > before[0] + 1.0
    assert after[2] == after[7] == 0.0


def tracker(calibrated):
    return BaselineTracker(
        np.array(calibrated, float),
        np.ones(len(calibrated), np.bool_),
        np.zeros(len(calibrated), np.int32),
        np.zeros(len(calibrated), np.bool_),
        Drift(),
    )


def test_a_baseline_rises_slowly_untouched_and_not_at_all_touched():
    own = OwnCurves(CURVE, curves(), slice(0, N), np.arange(N, dtype=np.int32), SMOOTHING_S)
    before = np.linspace(0.0, 4.0, N)
    drift = tracker(before)
    drift.baseline[:] = before + 1.0
    drift.baseline[[7, 8]] = before[[7, 8]] - 1.0
    touched = np.isin(np.arange(N), [2, 3, 8])
    assert own.hold_rises(drift, before, touched, 4.0, None) is None
    rise = drift.baseline - before
    # Pads without an own curve rise as they did, and all may fall.
    assert rise[[3, 5]] == pytest.approx([1.0, 1.0])
    assert rise[[7, 8]] == pytest.approx([-1.0, -1.0])
    assert rise[2] == 0.0
    others = [0, 1, 4, 6, *range(9, N)]
    assert rise[others] == pytest.approx(4.0 * RISE_UNITS_PER_S)


def test_a_touch_is_drift_only_where_its_baseline_may_rise_as_far():
    own = OwnCurves(CURVE, curves(), slice(0, N), np.arange(N, dtype=np.int32), SMOOTHING_S)
    calibrated = np.full(N, 2.0)
    before = calibrated.copy()
    before[1] = 1.0
    drift = tracker(calibrated)
    drift.baseline[:] = before
    #: As far as it was calibrated; slowly; too far; without an own curve.
    drift.baseline[[1, 2, 4, 5]] = 1.9, 2.02, 2.5, 9.0
    drifted = np.array([1, 2, 4, 5])
    touched = np.isin(np.arange(N), drifted)
    found = own.hold_rises(drift, before, touched, 4.0, drifted)
    assert found.tolist() == [1, 2, 5]
    assert drift.baseline[[1, 2, 4, 5]] == pytest.approx([1.9, 2.02, 2.0 + 4.0 * 0.01, 9.0])
    drift.baseline[4] = 2.5
    assert own.hold_rises(drift, before, touched, 4.0, np.array([4])) is None


def test_where_most_of_the_part_is_released_a_touch_is_drift_at_once():
    own = OwnCurves(CURVE, curves(), slice(0, N), np.arange(N, dtype=np.int32), SMOOTHING_S)
    before = np.full(N, 2.0)
    drift = tracker(before)
    drift.is_released = True
    drift.baseline[[1, 2, 4]] += 2.0
    touched = np.isin(np.arange(N), [1, 2, 4, 6])
    found = own.hold_rises(drift, before, touched, 1.0, np.array([1, 2]))
    assert found.tolist() == [1, 2]
    assert drift.baseline[[1, 2]] == pytest.approx(4.0)
    # Its touch is no drift.
    assert drift.baseline[4] == 2.0


@pytest.mark.parametrize("common_units", [-0.01, 0.0, 0.005, 0.3])
def test_what_the_untouched_pads_show_is_followed_beside_what_was_hidden(common_units):
    own = OwnCurves(CURVE, curves(), slice(0, N), np.arange(N, dtype=np.int32), SMOOTHING_S)
    before = np.full(N, 2.0)
    drift = tracker(before)
    drift.shared_units = common_units
    drift.baseline[[1, 4]] += 2.0
    touched = np.isin(np.arange(N), [1, 4])
    assert own.hold_rises(drift, before, touched, 1.0, np.array([1])) is None
    shown = min(max(common_units, 0.0), RISE_UNITS_PER_S)
    assert drift.baseline[1] == pytest.approx(2.0 + RISE_UNITS_PER_S + shown)
    # A fall is followed in a touch.
    assert drift.baseline[4] == pytest.approx(2.0 + min(common_units, 0.0))


def drifting(rig: Rig, course_units: np.ndarray, press_units: float) -> list[PressureFrame]:
    """The frames of seconds in which the whole skin drifts so far, and some pads are pressed."""
    pressed = np.where(PRESSED, press_units, 0.0)
    return [rig.step(units + pressed) for units in course_units for _ in range(5)]


def held(course_units: np.ndarray) -> tuple[float, Rig]:
    """By how much (kPa) a held pressure changes while the skin drifts so; and the skin then."""
    rig = Rig(1, 0.4, seed=5, hz=5.0)
    use_own_curves(rig, 0.4)
    drifting(rig, np.zeros(5), 0.0)
    frames = drifting(rig, np.concatenate([np.zeros(20), course_units]), 30.0)
    first, last = (
        np.mean([frame.pressure_kpa[PRESSED] for frame in part])
        for part in (frames[50:100], frames[-50:])
    )
    return float(last - first), rig


@pytest.mark.parametrize(("units", "period_s"), [(0.0, 60.0), (0.3, 60.0), (1.0, 240.0)])
def test_what_drifts_to_and_fro_under_a_touch_leaves_no_pressure(units: float, period_s: float):
    change_kpa, rig = held(units * np.sin(2.0 * np.pi * np.arange(360) / period_s))
    assert change_kpa == pytest.approx(0.0, abs=2.5)
    after = drifting(rig, np.zeros(20), 0.0)
    assert not any(frame.touched.any() for frame in after[25:])


def test_what_the_skin_has_warmed_by_while_it_held_something_is_no_touch_after_the_release():
    """The pressure of what is held is too high by it, as a load that grows would read alike."""
    change_kpa, rig = held(np.linspace(0.0, 5.0, 600))
    assert change_kpa > 5.0
    after = drifting(rig, np.full(20, 5.0), 0.0)
    assert not any(frame.touched.any() for frame in after[25:])


def test_a_grip_that_is_eased_to_a_third_stays_one_after_the_skin_has_warmed():
    _, rig = held(np.linspace(0.0, 5.0, 600))
    after = drifting(rig, np.full(60, 5.0), 10.0)
    assert all(frame.touched[PRESSED].all() for frame in after)
