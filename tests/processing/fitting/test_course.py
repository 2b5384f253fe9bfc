"""Curves, memory and verdicts from any course of known pressure."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.errors import RequestError
from skin_host.evaluation.rig import Rig
from skin_host.processing.curves import (
    FEW_VALUES,
    KNOTS_UNITS,
    Curves,
    CurveVerdict,
    Memory,
    TableCurve,
    Tables,
    rising,
)
from skin_host.processing.fitting.course import (
    Course,
    find_lag,
    fit_course,
    median_of_moving,
    read_course,
    shown,
)
from skin_host.processing.pressure import PressureCurve
from skin_host.processing.relaxation import PlayRelaxation
from skin_host.processing.smoothing import StepFilter

DT_S = 0.05
ZERO = 237.0
MEMORY = Memory((20.0,), (0.3,))


def staircase(top_kpa=300.0, steps=12, hold_s=5.0):
    """Untouched, up, down and untouched again, as a valve gives it [t]."""
    levels = np.concatenate([[0.0], np.linspace(0.0, top_kpa, steps + 1)[1:]])
    levels = np.concatenate([levels, levels[-2::-1]])
    course = np.repeat(levels, round(hold_s / DT_S))
    width = round(2.0 / DT_S)
    return np.convolve(np.pad(course, width, mode="edge"), np.ones(width) / width, "same")[
        width:-width
    ]


def softening(units):
    """A curve that bends the other way than equation (1)."""
    return 16.0 * units * np.exp(-units / 8.0) + 8.0 * units * (1.0 - np.exp(-units / 8.0))


def under(reading_kpa, n=6, noise=0.8, seed=0):
    """A foam with hysteresis: the pressure [t] of a loading curve's kPa, and pads' readings."""
    memory = PlayRelaxation(1, radius_kpa=MEMORY.radius_kpa, weight=MEMORY.weight)
    relaxation = [memory.step(np.array([kpa]), DT_S)[0] for kpa in reading_kpa]
    fine = np.linspace(0.0, 80.0, 4001)
    units = np.interp(reading_kpa, softening(fine), fine)
    gains = np.linspace(0.8, 1.2, n)
    noisy = np.random.default_rng(seed).normal(0.0, noise, (len(units), n))
    return np.maximum(reading_kpa - relaxation, 0.0), units[:, np.newaxis] * gains + noisy


def as_course(units, pressure):
    raw = np.clip(np.rint(ZERO - units), 0, 255).astype(np.uint8)
    n = units.shape[1]
    return Course(DT_S, raw, np.full(n, ZERO), np.ones(n, np.bool_), pressure)


@pytest.fixture(scope="module")
def pressed():
    pressure, units = under(staircase())
    return units, pressure


def test_curves_of_another_shape_than_the_papers_and_hysteresis_carry_over(pressed):
    units, pressure = pressed
    curves = fit_course(as_course(units, pressure), 0.5)
    assert (curves.verdict == CurveVerdict.GOOD).all()
    assert curves.error_kpa.max() < 6.5
    # Another course, not fitted: quick cycles that turn back half way.
    t = np.arange(0.0, 60.0, DT_S)
    cycles = 20.0 + 120.0 * (1.0 - np.cos(2 * np.pi * t / 12.0)) * (0.6 + 0.4 * np.sin(t / 9.0))
    known, other = under(cycles, seed=1)
    read = read_course(curves, np.arange(6), np.rint(other), 0.5, DT_S)
    rms = np.sqrt(np.mean((read - known[:, np.newaxis]) ** 2, axis=0))
    assert np.median(rms) < 10.0


@pytest.mark.parametrize("dt_s", [0.0204, 0.05, 0.061, 0.102, 0.2])
def test_noise_is_no_jump_and_a_jump_is_one_however_seldom_boards_send(dt_s):
    """At 0.1 s and more, every third of the noisy pads of a real insole was refused for it."""
    t = np.arange(0.0, 600.0, dt_s)
    pressure = np.interp(t, [0.0, 10.0, 300.0, 590.0], [0.0, 0.0, 300.0, 0.0])
    rng = np.random.default_rng(3)
    noise = np.repeat([0.8, 2.2, 3.5], 8)
    converted = (t / 0.0369).astype(np.intp)
    scattered = (noise * rng.normal(0.0, 1.0, (converted[-1] + 1, 24)))[converted]
    units = pressure[:, np.newaxis] / 8.0 + scattered
    units[(t > 200.0) & (t < 230.0), ::8] += 45.0
    course = replace(as_course(units, pressure), dt_s=dt_s)
    verdict = fit_course(course, 0.5, Memory()).verdict
    assert (verdict[::8] == CurveVerdict.JUMPS).all()
    assert np.count_nonzero(verdict == CurveVerdict.JUMPS) == 3


def swept(period_s, top_kpa=100.0):
    """At rest, then up and down at a constant rate [t]."""
    t = np.arange(0.0, 8.0 * period_s + 60.0, DT_S)
    return np.where(t < 8.0, 0.0, top_kpa * (1.0 - np.abs((t - 8.0) / period_s % 2.0 - 1.0)))


@pytest.mark.parametrize("smoothing_s", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("period_s", [2.0, 15.0, 60.0])
@pytest.mark.parametrize("noise", [0.0, 0.4, 1.5])
def test_pads_without_memory_get_none_however_fast_they_are_swept_and_smoothed(
    period_s, smoothing_s, noise
):
    pressure = swept(period_s)
    rng = np.random.default_rng(7)
    units = np.outer(0.8 * pressure, np.linspace(0.8, 1.2, 6))
    units += rng.normal(0.0, noise, units.shape)
    assert fit_course(as_course(units, pressure), smoothing_s).memory == Memory()


def half_width_kpa(memory):
    """How far a foam that is being let go reads above its mean course."""
    return sum(r * w for r, w in zip(memory.radius_kpa, memory.weight, strict=True))


@pytest.mark.parametrize("period_s", [30.0, 60.0])
def test_pads_with_memory_keep_it_however_they_are_smoothed(period_s):
    pressure, units = under(swept(period_s, 300.0))
    found = [fit_course(as_course(units, pressure), smoothing_s) for smoothing_s in (0.0, 0.5, 2.0)]
    assert found[0].memory == found[1].memory == found[2].memory
    assert half_width_kpa(found[0].memory) == pytest.approx(half_width_kpa(MEMORY), rel=0.2)


def test_each_pad_gets_its_verdict(pressed):
    units, pressure = pressed
    units = units.copy()
    rng = np.random.default_rng(2)
    units[:, 1] = 0.0
    units[1500:2500, 2] += 25.0
    units[:, 3] += 15.0 * rng.choice([-1.0, 1.0], len(units))
    units[:, 4] *= 8.0
    verdict = fit_course(as_course(units, pressure), 0.5).verdict
    expected = ("GOOD", "DEAD", "JUMPS", "NOISY", "SATURATES", "GOOD")
    assert [CurveVerdict(number).name for number in verdict] == list(expected)


@pytest.mark.parametrize("top_kpa", [60.0, 120.0, 300.0])
def test_a_verdict_does_not_depend_on_how_high_the_course_goes(top_kpa):
    pressure, units = under(staircase(top_kpa), noise=1.5)
    rng = np.random.default_rng(2)
    units[:, 3] += 15.0 * rng.choice([-1.0, 1.0], len(units))
    verdict = fit_course(as_course(units, pressure), 0.5).verdict
    expected = [CurveVerdict.GOOD] * 6
    expected[3] = CurveVerdict.NOISY
    assert verdict.tolist() == expected


@pytest.mark.parametrize(
    ("top_kpa", "verdict"), [(50.0, CurveVerdict.UNKNOWN), (300.0, CurveVerdict.DEAD)]
)
def test_a_pad_is_dead_only_where_the_weakest_would_have_moved(top_kpa, verdict):
    pressure, units = under(staircase(top_kpa))
    units[:, 1] = 0.0
    course = as_course(units, pressure)
    curves = fit_course(course, 0.5)
    good = CurveVerdict.GOOD
    assert curves.verdict.tolist() == [good, verdict, good, good, good, good]
    assert shown(course).tolist() == [True, verdict == CurveVerdict.DEAD, *[True] * 4]


def test_taxels_that_were_not_received_keep_the_common_curve(pressed):
    units, pressure = pressed
    course = as_course(units, pressure)
    course.there[2:] = False
    curves = fit_course(course, 0.5)
    assert list(np.flatnonzero(curves.own)) == [0, 1]
    assert curves.usable.all()


def test_the_clock_of_the_table_is_found_to_a_fraction_of_a_second(pressed):
    units, pressure = pressed
    time_s = np.arange(len(pressure)) * DT_S
    median = median_of_moving(np.rint(units), DT_S)
    for lag_s in (-7.3, 0.0, 12.6):
        assert find_lag(median, time_s, (time_s + lag_s, pressure)) == pytest.approx(lag_s, abs=0.3)


def test_a_table_of_something_else_and_an_unpressed_recording_are_refused(pressed):
    units, pressure = pressed
    time_s = np.arange(len(pressure)) * DT_S
    other = 100.0 + 50.0 * np.sin(time_s / 2.0)
    with pytest.raises(RequestError, match="do not follow"):
        find_lag(median_of_moving(units, DT_S), time_s, (time_s, other))
    with pytest.raises(RequestError, match="nothing is pressed"):
        median_of_moving(np.zeros_like(units), DT_S)


@given(
    slopes=st.lists(st.floats(0.0, 50.0), min_size=len(KNOTS_UNITS), max_size=len(KNOTS_UNITS)),
    units=st.floats(-100.0, 300.0),
)
def test_a_curve_rises_and_has_an_inverse(slopes, units):
    table = rising(np.cumsum(slopes)[np.newaxis])
    curve = TableCurve(table, np.array([40.0]))
    kpa = curve.kpa(units)
    assert curve.kpa(units + 1.0) > kpa
    assert curve.kpa(curve.units(kpa)) == pytest.approx(kpa, rel=1e-6, abs=1e-6)
    many = curve.units(np.full((2 * FEW_VALUES, 1), kpa))
    assert np.all(many == curve.units(kpa))


@given(
    st.lists(
        st.floats(-500.0, 500.0) | st.sampled_from([np.nan, np.inf, -np.inf]),
        min_size=1,
        max_size=80,
    )
)
def test_plays_are_bounded_finite_and_fade_only_by_readings(values):
    model = PlayRelaxation(1, radius_kpa=(5.0, 20.0, 60.0), weight=(0.3, 0.2, 0.1))
    bound = 2.0 * (5.0 * 0.3 + 20.0 * 0.2 + 60.0 * 0.1)
    for reading in values:
        relaxation = model.step(np.array([reading]), 0.02)[0]
        assert 0.0 <= relaxation <= bound + 1e-9
        assert model.step(np.array([reading]), 3600.0)[0] == relaxation


@given(st.lists(st.floats(0.0, 400.0), max_size=30), st.floats(0.0, 400.0), st.floats(0.01, 50.0))
def test_a_higher_reading_is_a_higher_pressure(history, reading, more):
    pressures = []
    for last in (reading, reading + more):
        model = PlayRelaxation(1, radius_kpa=(5.0, 20.0), weight=(0.5, 0.3))
        for value in [*history, last]:
            relaxation = model.step(np.array([value]), 0.02)[0]
        pressures.append(last - relaxation)
    assert pressures[1] > pressures[0]


def test_the_first_loading_relaxes_nothing_and_a_million_cycles_drift_nowhere():
    model = PlayRelaxation(1, radius_kpa=(20.0,), weight=(0.3,), dtype=np.float32)
    assert all(model.step(np.array([c]), 0.02)[0] == 0.0 for c in np.linspace(0.0, 300.0, 500))
    once = [model.step(np.array([c]), 0.02)[0] for c in (50.0, 200.0)]
    for _ in range(5000):
        later = [model.step(np.array([c]), 0.02)[0] for c in (50.0, 200.0)]
    assert later == once


@given(
    st.lists(st.floats(-300.0, 300.0), min_size=1, max_size=50),
    st.floats(0.0, 2.0),
    st.floats(0.0, 1.0),
)
def test_the_filter_is_never_farther_off_than_noise_may_be(values, time_s, dt_s):
    smoother = StepFilter(np.array([10.0]), time_s)
    for value in values:
        smooth = smoother.step(np.array([value]), dt_s)[0]
        assert abs(smooth - value) <= 10.0 + 1e-9


def test_noise_is_smoothed_and_a_step_passes_but_for_the_noise():
    rng = np.random.default_rng(5)
    smoother = StepFilter(np.array([16.0]), 0.5)
    read = [smoother.step(np.array([v]), 0.02)[0] for v in 100.0 + 8.0 * rng.normal(size=500)]
    assert np.std(read[200:]) < 3.0
    assert smoother.step(np.array([200.0]), 0.02)[0] > 175.0


def test_taxels_that_are_stepped_apart_and_taken_back_are_as_if_they_had_not_been():
    rng = np.random.default_rng(3)
    n = 40
    radius, weight = (5.0, 20.0, 60.0), (0.3, 0.2, 0.1)
    models = [PlayRelaxation(n, radius_kpa=radius, weight=weight) for _ in range(2)]
    filters = [StepFilter(np.full(n, 4.0), 0.5) for _ in range(2)]
    kpa = np.zeros(n)
    for some in (np.array([2, 3, 5, 7, 30]), np.array([], np.intp), np.array([3, 39])):
        others = np.delete(np.arange(n), some)
        apart = [(filters[1].part(them), models[1].part(them)) for them in (some, others)]
        for _ in range(200):
            kpa = kpa + rng.normal(0.0, 6.0, n)
            wanted = models[0].step(filters[0].step(kpa, 0.02), 0.02)
            for them, (smoother, memory) in zip((some, others), apart, strict=True):
                relaxation = memory.step(smoother.step(kpa[them], 0.02), 0.02)
                assert relaxation == pytest.approx(wanted[them])
        for them, (smoother, memory) in zip((some, others), apart, strict=True):
            filters[1].take_back(them, smoother)
            models[1].take_back(them, memory)
        assert filters[1].smooth == pytest.approx(filters[0].smooth)


EQUATION_1_KPA = PressureCurve(2.88).kpa(KNOTS_UNITS[:, np.newaxis])[:, 0]


def use_own_curves(rig, noise_units, verdict=CurveVerdict.GOOD, kpa=EQUATION_1_KPA, zeroed=None):
    """Give all pads equation (1) or another own curve, and a foam with plays; return these."""
    n = rig.n
    curves = Curves(
        kpa=np.tile(kpa, (n, 1)),
        beyond_units=np.full(n, 60.0),
        noise_units=np.full(n, noise_units),
        error_kpa=np.full(n, 1.0),
        verdict=np.full(n, verdict, np.uint8),
        highest_kpa=150.0,
        lag_s=0.0,
        memory=Memory((5.0, 20.0), (0.2, 0.1)),
    )
    calibration = replace(rig.calibration, curves=curves)
    zeroed = np.zeros(n, np.bool_) if zeroed is None else zeroed
    rig.pipeline.renew(rig.settings.processing, calibration, zeroed)
    return calibration


def test_pads_that_were_noisy_under_pressure_do_not_flicker_though_they_rest_calmly():
    begins = []
    here = np.arange(192) < 48
    for noise_units in (0.4, 2.0):
        rig = Rig(1, 0.4, seed=6, hz=25.0)
        use_own_curves(rig, noise_units)
        rng = np.random.default_rng(7)
        touched = np.array(
            [
                rig.step(np.where(here, rng.normal(3.0, 1.5, rig.n), 0.0)).touched[here]
                for _ in range(1000)
            ]
        )
        assert touched[-500:].mean() > 0.8
        begins.append(np.count_nonzero(touched[1:] & ~touched[:-1]) / 48)
    assert begins[0] > 2.0
    assert begins[1] < 1.1


@pytest.mark.parametrize("pressed", [6, 192])
def test_pressures_by_own_curves_follow_a_press_at_once_and_end_with_it(pressed):
    rig = Rig(1, 0.4, seed=5, hz=50.0)
    n = rig.n
    use_own_curves(rig, 0.4)
    here = np.arange(n) < pressed
    true_kpa = float(PressureCurve(2.88).kpa(np.array([20.0]))[0])
    for _ in range(20):
        rig.step(0.0)
    for _ in range(3):
        during = [rig.step(np.where(here, 20.0, 0.0)) for _ in range(50)]
        after = [rig.step(0.0) for _ in range(50)]
        # Two measurements decide; a filter's limit is what may be missing then.
        assert all(frame.touched[here].all() for frame in during[4:])
        assert np.abs(during[10].pressure_kpa[here] - true_kpa).max() < 6.0
        for frame in (during[-1], during[10]):
            assert frame.pressure_kpa[~here].max(initial=0.0) < 4.0
        for frame in after[5:]:
            assert not frame.touched.any()
            assert frame.pressure_kpa.max() < 4.0


def test_a_noisy_pad_whose_curve_begins_flat_reads_no_pressure_after_its_release():
    rig = Rig(1, 2.0, seed=5, hz=50.0)
    # A fit may find no rise in the first piece of a pad that is noisy at rest.
    use_own_curves(rig, 2.0, kpa=rising(np.maximum(9.0 * (KNOTS_UNITS - 0.75), 0.0)))
    for units in [*np.linspace(0.0, 38.0, 1500), *np.linspace(38.0, 0.0, 1500), *np.zeros(500)]:
        rig.step(units)
    after = [rig.step(0.0) for _ in range(100)]
    assert max(frame.pressure_kpa.max() for frame in after) < 20.0
    assert not after[-1].touched.any()


def test_tables_follow_a_zero_that_moves():
    rng = np.random.default_rng(3)
    n = 50
    table = rising(np.cumsum(rng.uniform(0.0, 20.0, (n, len(KNOTS_UNITS))), axis=1))
    curve = TableCurve(table, np.full(n, 40.0))
    touched = np.arange(n) < 25
    # In units: the zero of a table may be late by so much, where its curve is not that at rest.
    late = np.where(touched, 1 / 32, 1 / 4)
    tables = Tables(curve, np.ones(n, np.bool_))
    zero = rng.uniform(200.0, 250.0, n).astype(np.float32)
    read = np.empty(n, np.float32)
    for _ in range(40):
        zero += rng.uniform(-0.1, 0.1, n).astype(np.float32)
        tables.renew(zero, touched)
        for activation, off in ((-3.0, 0.0), (0.0, late), (30.0, late)):
            raw = np.rint(zero - activation)
            tables.kpa(raw.astype(np.uint8), read)
            low, high = curve.kpa(zero - raw - off), curve.kpa(zero - raw + off)
            near = off * curve.linear + 1e-3
            assert np.all((read > low - near) & (read < high + near))


def test_pads_of_a_foam_with_memory_but_without_own_curves_read_equation_1_and_beyond_its_range():
    rig = Rig(1, 0.0, seed=5, hz=50.0)
    use_own_curves(rig, 0.0, CurveVerdict.UNKNOWN)
    for units in (20.0, 60.0, 100.0):
        frames = [rig.step(units) for _ in range(30)]
        expected_kpa = float(PressureCurve(2.88).kpa(np.array([units]))[0])
        assert np.median(frames[-1].pressure_kpa) == pytest.approx(expected_kpa, rel=0.05)
    assert frames[-1].beyond_range.all()


def test_where_much_is_touched_the_untouched_pads_are_followed_in_each_sweep_too():
    rig = Rig(1, 0.0, seed=5, hz=50.0)
    use_own_curves(rig, 0.4)
    pressed, one = np.arange(192) < 96, np.arange(192) == 150
    for _ in range(50):
        rig.step(np.where(pressed, 20.0, 0.0))
    for _ in range(3):
        rig.step(np.where(pressed, 20.0, 0.0))
        # One measurement does not make a touch.
        frame = rig.step(np.where(pressed, 20.0, np.where(one, 10.0, 0.0)))
        assert not frame.touched[one]
        assert frame.pressure_kpa[one] > 10.0
        for _ in range(20):
            rig.step(np.where(pressed, 20.0, 0.0))
