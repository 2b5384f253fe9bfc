from typing import Any

import numpy as np
import pytest
from hypothesis import assume, currently_in_test_context, given, settings
from hypothesis import strategies as st

from skin_host.config.relaxation import FITTED, MODELS, RelaxationSettings
from skin_host.processing.relaxation import (
    STAND_INS,
    AsymmetricRelaxation,
    NoRelaxation,
    ParameterSet,
    PlayRelaxation,
    PublishedRelaxation,
    make_model,
    parameters_of,
    stand_in,
)
from skin_host.processing.relaxation.base import TumblingMean

MID = STAND_INS["mid"]
LOADING = {"beta": MID.beta, "tau_s": MID.tau_s, "tau_unload_s": MID.tau_unload_s}
PUBLISHED = {
    "beta_load": MID.beta,
    "tau_load_s": MID.tau_s,
    "beta_unload": MID.beta_unload,
    "tau_unload_s": MID.tau_unload_s,
}
pressures = st.lists(st.floats(0.0, 250.0), min_size=1, max_size=40)
steps = st.lists(st.tuples(st.floats(0.0, 200.0), st.floats(1e-4, 5.0)), min_size=1, max_size=60)


def direct_sum(samples, every=1, mean_s=1.0, threshold_kpa=1.5):
    """Equation (5) word for word: keep every step, sum every term. Samples hold over dt."""
    events, answers = [], []
    now = elapsed = integral = staircase = 0.0
    for number, (pressure, dt) in enumerate(samples):
        left = dt
        while elapsed + left >= mean_s - 1e-9:
            room = mean_s - elapsed
            integral += pressure * room
            now += room
            left = max(left - room, 0.0)
            mean = integral / mean_s
            # On the threshold rounding decides, in another way here than there.
            if currently_in_test_context():
                assume(abs(abs(mean - staircase) - threshold_kpa) > 1e-9)
            if abs(mean - staircase) > threshold_kpa:
                events.append((now, mean - staircase))
                staircase = mean
            elapsed = integral = 0.0
        integral += pressure * left
        elapsed += left
        now += left
        if number % every:
            continue
        total = 0.0
        for instant, step in events:
            betas, taus = (MID.beta, MID.tau_s) if step > 0 else (MID.beta_unload, MID.tau_unload_s)
            total += sum(
                step * beta * (1.0 - np.exp(-(now - instant) / tau))
                for beta, tau in zip(betas, taus, strict=True)
            )
        answers.append(total)
    return np.array(answers)


@given(steps)
@settings(deadline=None)
def test_published_is_the_direct_sum_of_equation_5(samples):
    model = PublishedRelaxation(1, **PUBLISHED)
    answers = [model.step(np.array([pressure]), dt)[0] for pressure, dt in samples]
    assert answers == pytest.approx(direct_sum(samples), abs=1e-9)


def test_published_is_the_direct_sum_over_long_noisy_loading():
    rng = np.random.default_rng(5)
    levels = np.repeat(rng.uniform(0.0, 120.0, 60), 20 * 25)
    samples = [(level, 0.04) for level in levels + rng.normal(0.0, 0.8, levels.size)]
    model = PublishedRelaxation(1, **PUBLISHED)
    answers = np.array([model.step(np.array([c]), dt)[0] for c, dt in samples])
    assert answers[::500] == pytest.approx(direct_sum(samples, every=500), abs=1e-9)


def test_a_step_of_just_the_threshold_makes_no_event():
    model = PublishedRelaxation(2, **PUBLISHED)
    for _ in range(400):
        answer = model.step(np.array([1.5, 1.5000001]), 0.25)
    assert answer[0] == 0.0
    assert answer[1] > 0.15


def test_the_published_step_takes_effect_at_the_end_of_its_second():
    model = PublishedRelaxation(1, **PUBLISHED)
    fifty = np.array([50.0])
    assert model.step(fifty, 0.999)[0] == 0.0
    assert model.step(fifty, 0.001)[0] == 0.0
    expected = sum(50.0 * b * -np.expm1(-0.5 / t) for b, t in zip(MID.beta, MID.tau_s, strict=True))
    assert model.step(fifty, 0.5)[0] == pytest.approx(expected, abs=1e-12)


def test_published_runs_away_under_cycling_and_the_default_does_not():
    published = PublishedRelaxation(1, **PUBLISHED)
    asymmetric = AsymmetricRelaxation(1, **LOADING)
    for _ in range(100):
        for pressure in (50.0, 0.0):
            for _ in range(5):
                runaway = published.step(np.array([pressure]), 1.0)[0]
                bounded = asymmetric.step(np.array([pressure]), 1.0)[0]
    assert runaway > 100.0
    assert bounded < sum(MID.beta) * 50.0


@given(pressures, st.sampled_from(["float32", "float64"]))
def test_asymmetric_stays_between_zero_and_its_share_of_the_largest_pressure(c, dtype):
    model = make_model("asymmetric", 1, MID, dtype=dtype)
    for pressure in c:
        answer = model.step(np.array([pressure], dtype), 7.3)[0]
        assert -1e-6 <= answer <= sum(MID.beta) * max(c) * (1 + 1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_zero_pressure_relaxes_nothing(name):
    model = make_model(name, 3, stand_in(name, "mid"))
    for _ in range(50):
        assert not model.step(np.zeros(3), 0.3).any()


@given(pressures, st.lists(st.floats(0.0, 50.0), min_size=40, max_size=40))
def test_asymmetric_is_monotone_in_pressure(c, more):
    model = AsymmetricRelaxation(2, **LOADING)
    for pressure, extra in zip(c, more, strict=False):
        lower, higher = model.step(np.array([pressure, pressure + extra]), 3.1)
        assert higher >= lower - 1e-12


@given(steps, st.integers(2, 5))
@settings(deadline=None)
def test_split_steps_equal_one_step(samples, pieces):
    whole = make_model("asymmetric", 1, MID)
    split = make_model("asymmetric", 1, MID)
    for pressure, dt in samples:
        one = whole.step(np.array([pressure]), dt)[0]
        for _ in range(pieces):
            many = split.step(np.array([pressure]), dt / pieces)[0]
        assert many == pytest.approx(one, abs=1e-6)


def test_a_hold_follows_the_exponential_of_equation_3():
    model = AsymmetricRelaxation(1, beta=[0.3], tau_s=[100.0], tau_unload_s=[300.0])
    for _ in range(250):
        held = model.step(np.array([40.0]), 0.4)[0]
    assert held == pytest.approx(40.0 * 0.3 * -np.expm1(-1.0), abs=1e-9)
    released = model.step(np.zeros(1), 300.0)[0]
    assert released == pytest.approx(held * np.exp(-1.0), abs=1e-9)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_no_number_counts_as_the_last_one(name, held, wrong):
    spoilt, clean = (make_model(name, 2, stand_in(name, "mid"), held=held) for _ in "ab")
    for number in range(100):
        clean.step(np.array([30.0, 10.0]), 0.1)
        spoilt.step(np.array([wrong if number == 57 else 30.0, 10.0]), 0.1)
    expected = clean.step(np.array([30.0, 10.0]), 0.1)
    assert spoilt.step(np.array([30.0, 10.0]), 0.1) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("dt", [-3600.0, -1e-9, np.nan, np.inf])
def test_time_that_cannot_have_passed_changes_nothing(name, dt):
    model = make_model(name, 1, stand_in(name, "mid"))
    for _ in range(20):
        before = model.step(np.array([30.0]), 0.3)
    assert model.step(np.array([30.0]), dt) == pytest.approx(before, abs=1e-12)


@pytest.mark.parametrize("name", MODELS)
def test_parameters_per_taxel_give_what_shared_ones_give(name):
    n = 3
    shared = stand_in(name, "mid")
    per_taxel = type(shared)(
        *(
            np.repeat(np.array(getattr(shared, field), float)[:, np.newaxis], n, axis=1)
            for field in ("beta", "tau_s", "beta_unload", "tau_unload_s")
        )
    )
    one, many = make_model(name, n, shared), make_model(name, n, per_taxel)
    rng = np.random.default_rng(0)
    for pressure in rng.uniform(0.0, 100.0, (50, n)):
        assert many.step(pressure, 0.7) == pytest.approx(one.step(pressure, 0.7), abs=1e-12)


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("name", FITTED)
def test_reset_forgets_the_chosen_taxels_alone(name, held):
    model, other, new = (make_model(name, 2, stand_in(name, "mid"), held=held) for _ in "abc")
    for _ in range(30):
        model.step(np.array([50.0, 50.0]), 1.0)
        other.step(np.array([50.0, 50.0]), 1.0)
    # Amid a mean.
    for _ in range(12):
        model.step(np.array([50.0, 50.0]), 0.05)
        other.step(np.array([50.0, 50.0]), 0.05)
        new.step(np.zeros(2), 0.05)
    model.reset(np.array([True, False]))
    for pressure_kpa in (np.nan, 0.0, 0.0, 0.0, 30.0, 30.0, 0.0, 0.0):
        gone, kept = model.step(np.full(2, pressure_kpa), 1.0)
        assert gone == pytest.approx(new.step(np.full(2, pressure_kpa), 1.0)[0], abs=1e-12)
        assert kept == pytest.approx(other.step(np.full(2, pressure_kpa), 1.0)[1], abs=1e-12)
    model.step(np.array([50.0, 50.0]), 0.3)
    model.reset()
    new = make_model(name, 2, stand_in(name, "mid"), held=held)
    for dt_s in (0.5, 0.45, 0.1, 0.1):
        pressures_kpa = np.array([50.0, 80.0])
        assert model.step(pressures_kpa, dt_s).tolist() == new.step(pressures_kpa, dt_s).tolist()


@pytest.mark.parametrize("name", MODELS)
def test_each_answer_is_an_array_of_its_own(name):
    model = make_model(name, 1, stand_in(name, "mid"))
    first = model.step(np.array([50.0]), 10.0)
    kept = first.copy()
    model.step(np.array([90.0]), 10.0)
    assert first == kept


def test_no_relaxation_corrects_nothing():
    assert not NoRelaxation(2).step(np.array([50.0, 250.0]), 1000.0).any()


@pytest.mark.parametrize(
    ("beta", "tau_s", "message"),
    [
        ([0.1, 0.2], [1.0], "modes differ"),
        ([0.1], [0.0], "must be positive"),
        ([-0.1], [1.0], "not negative"),
        ([np.nan], [1.0], "finite"),
        (np.ones((1, 5)), [1.0], "shape"),
    ],
)
def test_impossible_parameters_are_refused(beta, tau_s, message):
    with pytest.raises(ValueError, match=message):
        AsymmetricRelaxation(3, beta=beta, tau_s=tau_s, tau_unload_s=tau_s)


def test_states_never_become_denormal():
    model = AsymmetricRelaxation(1, beta=[0.3], tau_s=[0.5], tau_unload_s=[0.5], dtype="float32")
    model.step(np.array([50.0], np.float32), 1.0)
    seen = [float(model.step(np.zeros(1, np.float32), 0.3)[0]) for _ in range(400)]
    assert all(value == 0.0 or value > 1e-37 for value in seen)
    assert seen[-1] == 0.0


@pytest.mark.parametrize("name", FITTED)
@pytest.mark.parametrize(("stand", "lost_kpa"), [("mild", 15.0), ("mid", 25.0), ("strong", 40.0)])
def test_a_stand_in_set_loses_its_share_of_a_pressure_that_is_held_for_ever(
    name: str, stand: str, lost_kpa: float
) -> None:
    model = make_model(name, 1, stand_in(name, stand))
    for _ in range(200):
        relaxed = model.step(np.array([100.0]), 1000.0)
    assert relaxed == pytest.approx([lost_kpa], rel=1e-6)


def test_modes_of_the_asymmetric_stand_in_share_alike_and_recover_half_as_fast() -> None:
    found = stand_in("asymmetric", "mid")
    assert found.beta == found.beta_unload == pytest.approx([0.25 / 6] * 6)
    ratios = np.diff(np.log(found.tau_s))
    assert ratios == pytest.approx([ratios.mean()] * 5, rel=0.01)
    assert np.array(found.tau_unload_s) == pytest.approx(2.0 * np.array(found.tau_s))


def test_numbers_of_a_configuration_take_precedence_and_serve_unloading_too() -> None:
    assert parameters_of(RelaxationSettings(model="published", set="mild")) == STAND_INS["mild"]
    assert parameters_of(RelaxationSettings(set="strong")) == stand_in("asymmetric", "strong")
    own = RelaxationSettings(beta=[0.1, 0.2], tau_s=[3.0, 30.0])
    assert parameters_of(own) == ParameterSet([0.1, 0.2], [3.0, 30.0], [0.1, 0.2], [3.0, 30.0])
    both = RelaxationSettings(
        beta=[0.1], tau_s=[3.0], beta_unload=[0.2], tau_unload_s=[6.0], set="strong"
    )
    assert parameters_of(both) == ParameterSet([0.1], [3.0], [0.2], [6.0])


@pytest.mark.parametrize(("name", "of_a_mode"), [("asymmetric", 1), ("published", 2)])
def test_the_size_of_a_state_grows_with_its_modes(name: str, of_a_mode: int) -> None:
    """The published model has modes of its own for unloading."""

    def size(modes: int, dtype: str) -> int:
        few = ParameterSet([0.1] * modes, [3.0] * modes, [0.1] * modes, [6.0] * modes)
        return make_model(name, 7, few, dtype=dtype).bytes_per_taxel

    for dtype, item in (("float64", 8), ("float32", 4)):
        assert size(5, dtype) - size(2, dtype) == 3 * of_a_mode * item
        # Besides the modes: the last pressure, and what averages need.
        numbers = size(2, dtype) // item - 2 * of_a_mode
        assert numbers == (1 if name == "asymmetric" else 2 + 2 + TumblingMean.ROWS + 3)
    assert size(3, "float64") == 2 * size(3, "float32")


def test_stand_ins_keep_the_time_constants_that_published_figures_were_made_with() -> None:
    """They replace a lost table: loading in seconds, minutes and an hour, recovery slower."""
    times = {name: (chosen.tau_s, chosen.tau_unload_s) for name, chosen in STAND_INS.items()}
    assert times == {
        "mild": ((4, 90, 1500), (8, 180, 3000)),
        "mid": ((6, 120, 1800), (12, 240, 3600)),
        "strong": ((8, 150, 2400), (20, 400, 4800)),
    }


@given(steps, st.sampled_from([0.4, 2.5]))
@settings(max_examples=40, deadline=None)
def test_a_mean_of_another_length_is_the_direct_sum_of_such_means(samples, mean_s):
    model = PublishedRelaxation(1, mean_s=mean_s, **PUBLISHED)
    answers = [model.step(np.array([pressure]), 3.0 * dt)[0] for pressure, dt in samples]
    expected = direct_sum([(pressure, 3.0 * dt) for pressure, dt in samples], mean_s=mean_s)
    np.testing.assert_allclose(answers, expected, atol=1e-6)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("name", MODELS)
def test_an_answer_may_be_written_where_it_is_wanted(name, held, dtype):
    own, given_one = (make_model(name, 2, stand_in(name, "mid"), held=held) for _ in "ab")
    for pressure_kpa in (50.0, 80.0, 0.0):
        where = np.full(2, 7.0, dtype)
        assert given_one.step(np.full(2, pressure_kpa), 1.0, where) is where
        assert where == pytest.approx(own.step(np.full(2, pressure_kpa), 1.0), rel=1e-6)


RADII_KPA, PLAY_WEIGHTS = [5.0, 20.0, 60.0], [0.1, 0.05, 0.2]


def play(n: int = 3) -> PlayRelaxation:
    return PlayRelaxation(n, radius_kpa=RADII_KPA, weight=PLAY_WEIGHTS)


@given(st.lists(st.floats(-20.0, 250.0) | st.just(np.nan), min_size=1, max_size=40))
def test_plays_follow_their_definition(readings):
    """Equation by equation, one play and one reading at a time."""
    model = play(1)
    plays, last = [0.0] * 3, 0.0
    for reading in readings:
        c = last = max(reading, 0.0) if np.isfinite(reading) else last
        plays = [min(max(p, c - r), c + r) for p, r in zip(plays, RADII_KPA, strict=True)]
        relaxed = sum(
            w * (p - max(c - r, 0.0))
            for p, r, w in zip(plays, RADII_KPA, PLAY_WEIGHTS, strict=True)
        )
        assert model.step(np.array([reading]), 0.05) == pytest.approx([relaxed], abs=1e-9)


@pytest.mark.parametrize("per_taxel", [False, True])
def test_plays_of_some_taxels_continue_by_themselves_and_are_taken_back(per_taxel: bool) -> None:
    radii = np.outer(RADII_KPA, [1.0, 1.5, 2.0]) if per_taxel else RADII_KPA
    whole, split = (
        PlayRelaxation(3, radius_kpa=radii, weight=PLAY_WEIGHTS) for _ in ("whole", "split")
    )
    for model in (whole, split):
        model.step(np.array([100.0, 150.0, 200.0]), 0.05)
    some = np.array([0, 2])
    part = split.part(some)
    for kpa in (np.nan, 180.0, np.nan, 90.0):
        expected = whole.step(np.array([kpa, 150.0, kpa]), 0.05)
        assert part.step(np.full(2, kpa), 0.05).tolist() == expected[some].tolist()
    split.take_back(some, part)
    # A reading that is missing counts as the last one of the part.
    missing = np.full(3, np.nan)
    assert split.step(missing, 0.05).tolist() == whole.step(missing, 0.05).tolist()


def test_plays_of_chosen_taxels_are_forgotten() -> None:
    model, other, new = play(2), play(2), play(2)
    for one in (model, other):
        one.step(np.array([120.0, 120.0]), 0.05)
    model.reset(np.array([True, False]))
    for kpa in (np.nan, 30.0, 5.0):
        gone, kept = model.step(np.full(2, kpa), 0.05)
        assert gone == new.step(np.full(2, kpa), 0.05)[0]
        assert kept == other.step(np.full(2, kpa), 0.05)[1]


@pytest.mark.parametrize(("dtype", "item"), [(np.float64, 8), (np.float32, 4)])
def test_the_size_of_the_state_of_plays_is_one_number_each_and_the_last_reading(
    dtype: type[np.floating[Any]], item: int
) -> None:
    model = PlayRelaxation(7, radius_kpa=RADII_KPA, weight=PLAY_WEIGHTS, dtype=dtype)
    assert model.bytes_per_taxel == (3 + 1) * item


def test_radii_and_weights_of_plays_go_together() -> None:
    with pytest.raises(ValueError, match="3 radii and 2 weights"):
        PlayRelaxation(1, radius_kpa=RADII_KPA, weight=[0.1, 0.2])


def test_a_mean_that_was_reset_has_nothing_of_the_samples_before() -> None:
    completed: list[float] = []
    means = TumblingMean(1, 1.0, np.float64)
    for number, kpa in enumerate((99.0, 10.0, np.nan)):
        means.feed(np.array([kpa]), 0.5, lambda mean, windows: completed.extend(mean))
        if number == 0:
            means.reset(None)
    assert completed == [10.0]


@pytest.mark.parametrize("step_s", [3.0, 3.0 - 1e-12])
def test_a_step_of_whole_windows_completes_each_of_them_but_for_what_is_rounded(
    step_s: float,
) -> None:
    completed: list[tuple[list[float], int]] = []
    means = TumblingMean(1, 1.0, np.float64)
    means.feed(
        np.array([7.0]), step_s, lambda mean, windows: completed.append((mean.tolist(), windows))
    )
    assert completed == [([7.0], 1), ([7.0], 2)]


def test_what_is_missing_from_a_mean_counts_as_the_mean_so_far() -> None:
    found: list[float] = []
    mean = TumblingMean(1, 1.0, np.float64)
    for kpa, dt_s in [(10.0, 0.2), (np.nan, 0.3), (40.0, 0.2), *[(np.nan, 0.03)] * 10]:
        mean.feed(np.array([kpa]), dt_s, lambda value, _: found.append(float(value[0])))
    so_far = (10.0 * 0.5 + 40.0 * 0.2) / 0.7
    assert found == pytest.approx([so_far])
    # Nothing of a window: the mean of the one before.
    mean.feed(np.array([np.nan]), 1.0, lambda value, _: found.append(float(value[0])))
    assert found == pytest.approx([so_far] * 2)
