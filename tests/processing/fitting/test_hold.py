from dataclasses import astuple, replace
from functools import cache
from itertools import chain

import numpy as np
import pytest

from skin_host.config.relaxation import FITTED
from skin_host.evaluation.accuracy import fitted_hold
from skin_host.evaluation.histories import grasps, record
from skin_host.processing.fitting.hold import HoldRecord, fit, merge
from skin_host.processing.relaxation import STAND_INS, ParameterSet, log_spaced, make_model

SHARED_RATIO = ParameterSet(
    (0.09, 0.12, 0.15), (7.0, 130.0, 1500.0), (0.09, 0.12, 0.15), (14.0, 260.0, 3000.0)
)


@cache
def hold_on(kind):
    return fitted_hold(kind)


def hold_of(model, parameters, noise=0.0):
    """A hold of one hour and a rest of 75 min as the model itself would have them."""
    dt_s = 1.0
    momentary = np.concatenate([np.full(3600, 60.0), np.full(4500, 3.0)])
    momentary += np.random.default_rng(0).normal(0.0, noise, len(momentary))
    truth = make_model(model, 1, parameters)
    relaxation = np.array([truth.step(np.array([c]), dt_s)[0] for c in momentary])
    return merge(dt_s, momentary, momentary - relaxation, 0, 3600)


@pytest.mark.parametrize(
    ("model", "true"), [("asymmetric", log_spaced(0.3)), ("published", SHARED_RATIO)]
)
def test_the_parameters_that_made_a_record_are_found_again(model, true):
    found = fit(model, hold_of(model, true)).parameters
    assert found.beta == pytest.approx(true.beta, rel=0.05)
    assert found.tau_s == pytest.approx(true.tau_s, rel=0.05)


def test_the_unloading_branch_of_the_published_model_is_found_again():
    true = SHARED_RATIO
    found = fit("published", hold_of("published", true)).parameters
    assert found.beta_unload == pytest.approx(true.beta_unload, rel=0.1)
    assert found.tau_unload_s == pytest.approx(true.tau_unload_s, rel=0.1)


def test_noise_hardly_moves_the_fit():
    true = log_spaced(0.25)
    found = fit("asymmetric", hold_of("asymmetric", true, noise=1.0)).parameters
    assert sum(found.beta) == pytest.approx(sum(true.beta), rel=0.05)
    assert found.tau_unload_s == pytest.approx(true.tau_unload_s, rel=0.2)


@pytest.mark.parametrize("kind", ["A", "S"])
def test_what_was_fitted_to_a_hold_corrects_grasps(kind):
    played = record(kind, grasps(0.1), sample_hz=10.0)
    fitted = fit("asymmetric", hold_on(kind)).parameters
    rms = {}
    for name, parameters in (("none", STAND_INS["mid"]), ("asymmetric", fitted)):
        model = make_model(name, 1, parameters)
        corrected = [c - model.step(np.array([c]), played.dt_s)[0] for c in played.momentary_kpa]
        error = np.maximum(corrected, 0.0) - played.pressure_kpa
        rms[name] = np.sqrt(np.mean(error**2))
    assert rms["asymmetric"] < 0.6
    assert rms["asymmetric"] < 0.15 * rms["none"]


@pytest.mark.parametrize("model", FITTED)
def test_a_fit_tells_its_error_and_what_one_level_cannot_show(model):
    found = fit(model, hold_on("S"))
    assert 0.0 < found.rms_hold_kpa < 1.0
    assert 0.0 < found.rms_rest_kpa < 1.0
    assert any("one level" in remark for remark in found.remarks)


def test_without_the_load_in_the_hold_the_fit_says_what_it_rests_on():
    known = hold_on("A")
    pressure = known.pressure_kpa.copy()
    pressure[: known.released] = np.nan
    blind = HoldRecord(known.dt_s, known.momentary_kpa, pressure, known.released)
    found = fit("asymmetric", blind)
    assert np.isnan(found.rms_hold_kpa)
    assert found.rms_rest_kpa < 0.5
    assert any("unknown" in remark for remark in found.remarks)
    assert sum(found.parameters.beta) == pytest.approx(
        sum(fit("asymmetric", known).parameters.beta), rel=0.3
    )


def test_a_short_record_says_that_long_times_are_not_known():
    short = merge(0.1, np.r_[np.full(600, 50.0), np.full(600, 3.0)], np.zeros(1200), 0, 600)
    found = fit("asymmetric", short)
    assert any("constant" in remark for remark in found.remarks)
    assert "beta_6" in found.uncertain


@pytest.mark.parametrize("model", FITTED)
@pytest.mark.parametrize("times", [1000.0, 1e7])
def test_a_pressure_that_no_parameters_explain_gives_finite_numbers(model, times):
    known = hold_on("A")
    record = replace(known, pressure_kpa=times * known.pressure_kpa)
    found = fit(model, record)
    assert found.rms_hold_kpa > record.level_kpa
    numbers = [found.rms_rest_kpa, *found.uncertain.values(), *chain(*astuple(found.parameters))]
    assert np.all(np.isfinite(numbers))


def test_merging_keeps_time_and_means():
    rng = np.random.default_rng(1)
    momentary = rng.uniform(0.0, 60.0, 5000)
    merged = merge(0.04, momentary, np.zeros(5000), 100, 3000)
    assert merged.hold_s == pytest.approx(2900 * 0.04)
    assert merged.rest_s == pytest.approx(2000 * 0.04)
    assert merged.dt_s @ merged.momentary_kpa == pytest.approx(0.04 * momentary[100:].sum())
    assert len(merged.dt_s) < 400


@pytest.mark.parametrize("model", ["none", "nonsense"])
def test_what_has_no_parameters_is_not_fitted(model):
    with pytest.raises(ValueError, match="no parameters"):
        fit(model, hold_on("L"))
