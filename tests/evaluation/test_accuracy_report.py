"""The report's parts in small: what they contain, and that they say what is so."""

import json
import pickle

import numpy as np
import pytest

from skin_host.evaluation import (
    accuracy,
    bench_processing,
    force_trials,
    page,
    report,
    speed,
    touching,
)
from skin_host.evaluation.accuracy import DEFAULT, FITTED_FOAM, SCENARIOS, HistoryPlan
from skin_host.evaluation.goals import goal
from skin_host.evaluation.histories import HISTORIES, record
from skin_host.evaluation.machine import machine
from skin_host.evaluation.rig import Rig
from skin_host.processing.pipeline import Pipeline

pytestmark = pytest.mark.long

PLAN = HistoryPlan(0.01, 2.5)


@pytest.fixture(scope="module")
def small():
    """A whole report of one truth, short histories and next to no repeats."""
    rows = [row for scenario in SCENARIOS for row in accuracy.score("F", scenario, PLAN)]
    made = {
        "schema": report.SCHEMA,
        "date": "2026-01-02T03:04:05+00:00",
        "machine": machine(),
        "quick": True,
        "default": report.key_of(DEFAULT),
        "rows": rows,
        "noise_draws": accuracy.noise_draws("F", PLAN),
        "fits": accuracy.fit_rows("F"),
        "cycles": accuracy.cycles("F", 200, ("published", DEFAULT.model)),
        "speed": speed.models(0.0, (192, 1920)),
        "pipeline": speed.pipeline(0.0, (1, 10)),
        "own_curves": speed.own_curves(0.0),
        "unwatched": speed.cost_of_glancing(10.0),
        "false_touches": touching.false_touches(0.001, (2,), (None, 0.4, 1.0), boards=1),
        "detection": touching.detection_delays(boards=1),
        "drift": touching.drift_lags(0.1, "paper"),
        "holds": [
            touching.long_hold("F", "short", 600.0, 0.0, 2.5, alone) for alone in (False, True)
        ],
        "hard_cases": touching.negative(2.0),
        "localization": report.localization(20),
        "force": force_trials.force("triangle", 4, (4.0, 10.0)),
        "real_skin": {"absent": "nowhere", "real": [], "published": [], "grasps": None},
        "seconds": 1.0,
    }
    made["summary"] = report.summary(made)
    made["cycle_evidence"] = report.cycle_evidence(made)
    return made


def test_the_published_model_is_wrong_by_far_and_the_default_by_little(small):
    error = {
        row["model"]: abs(row["unclamped_error_kpa"])
        for row in report.select(small["cycles"], cycles=200)
    }
    assert error[DEFAULT.model] < 2.0
    assert error["published"] > 10.0 * error[DEFAULT.model]


def test_a_perfect_model_leaves_the_step_of_the_reading_and_what_pads_differ_by(small):
    perfect = report.select(small["rows"], model="perfect")
    for row in perfect:
        if "spread" in row["scenario"]:
            assert row["rms_kpa"] > 0.1
        elif row["noise_units"] == 0.0:
            assert row["rms_kpa"] < 1e-4
        else:
            assert 0.2 < row["rms_kpa"] < 1.3


def test_a_foam_that_nobody_fitted_costs_more_than_one_that_was(small):
    (line,) = [
        line for line in small["summary"] if line["model"] == DEFAULT.model and line["update_s"]
    ]
    assert line["scenarios"]["fitted"] < line["scenarios"]["not fitted, 40 % of loss"]
    assert line["scenarios"]["fitted"] < line["scenarios"]["spread of losses"]


def test_who_knows_the_future_errs_least_most_of_all_where_losses_are_unknown(small):
    for scenario in SCENARIOS:
        mean_square = {
            name: np.mean(
                [
                    row["rms_kpa"] ** 2
                    for row in report.select(
                        small["rows"], scenario=scenario.name, noise_units=0.0, **key
                    )
                    if row["history"] in accuracy.JUDGED_HISTORIES
                ]
            )
            for name, key in (
                ("default", report.key_of(DEFAULT)),
                ("hindsight", {"model": "hindsight"}),
            )
        }
        assert mean_square["hindsight"] <= mean_square["default"] + 1e-9
        if scenario.loss > 1.0:
            assert mean_square["hindsight"] < 0.25 * mean_square["default"]


def test_the_models_are_run_by_the_pipeline_that_ships(monkeypatch):
    stepped = []
    original = Pipeline.step

    def step(self, *arguments, **named):
        stepped.append(self)
        return original(self, *arguments, **named)

    monkeypatch.setattr(Pipeline, "step", step)
    rows = accuracy.score("F", FITTED_FOAM, HistoryPlan(0.01, 1.0))
    assert len(set(map(id, stepped))) == len(accuracy.VARIANTS)
    models = {row["model"] for row in rows}
    assert models == {"perfect", "hindsight"} | {v.model for v in accuracy.VARIANTS}


def test_the_error_of_real_readings_is_judged_by_several_draws_of_the_noise(small):
    errors_kpa = accuracy.by_history(small["noise_draws"])
    assert {history for _, history in errors_kpa} == set(accuracy.JUDGED_HISTORIES)
    for values in errors_kpa.values():
        assert len(values) == len(set(values)) == accuracy.NOISE_DRAWS
    means_kpa = [np.sqrt(np.mean(np.square(values))) for values in errors_kpa.values()]
    assert report.worst_of_draws(small["noise_draws"]) == pytest.approx(max(means_kpa))


def test_rows_have_what_readers_count_on(small):
    for row in small["rows"]:
        assert {"model", "truth", "history", "noise_units", "rms_kpa", "worst_kpa"} <= set(row)
        assert row["worst_kpa"] >= row["rms_kpa"]
    assert {row["history"] for row in small["rows"]} == set(HISTORIES)
    for row in small["speed"]:
        assert {"model", "dtype", "taxels", "ns_per_taxel_step"} <= set(row)
        assert row["ns_per_taxel_step"] > 0.0


def test_the_error_of_a_cycle_is_told_with_what_the_truth_itself_still_moves(small):
    (row,) = small["cycle_evidence"]
    assert row["true_relaxation_kpa"][1] > row["true_relaxation_kpa"][0] > 5.0
    assert max(map(abs, row["error_kpa"])) < 0.1 * row["true_relaxation_kpa"][0]
    growth, last = report.growth_of_error(report.select(small["cycles"], model=DEFAULT.model))
    assert last == 200
    assert growth == pytest.approx(abs(row["error_kpa"][1]) - abs(row["error_kpa"][0]))


def test_headline_and_goals_rest_on_truths_that_no_model_is_kin_to(small):
    for truth in accuracy.HELD_OUT:
        assert {accuracy.FAMILY[v.model][truth] for v in accuracy.VARIANTS} == {"none"}
    assert {row["truth"] for row in small["rows"]} <= set(accuracy.HELD_OUT)


def test_jobs_are_sent_to_processes_with_all_that_they_need():
    for name, function, arguments in report.jobs_of(quick=True):
        assert pickle.loads(pickle.dumps((name, function, arguments)))[0] == name
    assert {name for name, *_ in report.jobs_of(quick=True)} == {
        name for name, *_ in report.jobs_of(quick=False)
    }


def test_what_is_on_the_pareto_front_is_beaten_by_nothing(small):
    front = [line for line in small["summary"] if line["pareto"]]
    assert front
    for line in front:
        assert not any(
            other["rms_kpa"] < line["rms_kpa"]
            and other["ns_per_taxel_step"] < line["ns_per_taxel_step"]
            for other in small["summary"]
        )


def test_page_tables_and_plots_are_written_beside_the_numbers(small, tmp_path):
    small = small | {"goals": [goal("a figure", 1.0, 2.0, 0.5)]}
    page.write(small, tmp_path)
    assert json.loads((tmp_path / "report.json").read_text())["schema"] == "skin.report/1"
    text = (tmp_path / "accuracy.md").read_text()
    html = (tmp_path / "report.html").read_text()
    assert "| a figure | 1 | 2 | 0.5 | reached |" in text
    for picture in (tmp_path / "accuracy").iterdir():
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert f"(accuracy/{picture.name})" in text
        assert f'src="accuracy/{picture.name}"' in html
    assert "a figure" in report.describe(small)


def test_a_goal_is_reached_or_missed_by_its_figure():
    assert goal("x", 1.0, 1.0, 0.5)["reached"]
    assert not goal("x", 1.01, 1.0, 0.5)["reached"]
    assert goal("x", 0.5, 1.0, 0.5)["aim_reached"]
    assert goal("x", 0.9, 0.8, 0.9, at_least=True)["aim_reached"]
    assert not goal("x", 0.7, 0.8, 0.9, at_least=True)["reached"]
    assert not goal("x", None, 1.0, 1.0)["reached"]


def test_a_hold_is_reported_as_long_as_it_lasts_and_leaves_no_false_contact(small):
    for row in small["holds"]:
        assert row["touched_share_in_hold"] == 1.0
        # A sample of one pad in a hundred, not a touch that stays.
        assert row["ghost_s_per_taxel"] < 0.1
        assert row["rest_rms_kpa"] < 1.5


def test_the_higher_the_press_the_sooner_it_is_told(small):
    assert small["detection"][-1]["told_within_2_s"] == 1.0
    first, last = small["detection"][0], small["detection"][-1]
    assert first["told_within_2_s"] < 1.0 or first["median_sweeps"] > last["median_sweeps"]
    assert last["median_sweeps"] == 2.0


def test_the_bench_compares_with_a_copy_in_the_same_run(small):
    document = bench_processing.with_ratios(small["speed"], small["pipeline"])
    document["frames_to_events"] = bench_processing.frames_to_events(0.2)
    copies = report.select(document["models"], model="memory_copy")
    assert all(row["ratio_to_copy"] == 1.0 for row in copies)
    assert "times a copy" in bench_processing.describe(document)


@pytest.mark.parametrize("kind", ["A", "S", "L", "H", "F", "M"])
def test_a_truth_holds_relaxes_and_is_free_of_pressure_at_rest(kind):
    played = record(kind, [(50.0, 60.0), (0.0, 60.0)], 10.0)
    pressed = ~played.resting
    assert played.pressure_kpa[pressed][5] > played.pressure_kpa[pressed][-5] + 2.0
    assert played.pressure_kpa[played.resting][5:].max() < 0.01
    assert played.momentary_kpa[played.resting].min() > 0.0


def test_the_rig_knows_its_own_baseline():
    rig = Rig(1, 0.3, seed=3)
    for _ in range(500):
        rig.step(0.0)
    assert np.abs(rig.pipeline.baseline - rig.true_baseline).max() < 0.3


def test_the_rig_has_the_noise_of_real_skin_if_asked():
    rig = Rig(2, None, seed=3, hz=50.0)
    reads = []
    for _ in range(500):
        rig.t_ns += 20_000_000
        reads.append(rig.read(0.0).astype(float))
    spread = np.std(reads, axis=0)
    assert 0.7 < np.median(spread) < 1.4
    assert np.mean(spread > 3.0) > 0.01
    assert np.mean(np.diff(reads, axis=0) == 0.0) > 0.5


@pytest.mark.parametrize(
    ("case", "asked"),
    [
        (touching.renewal, 20.0),
        (touching.silence, 5.0),
        (touching.fast_drift, 0.2),
        (touching.absorbed_load, 1.0),
    ],
)
def test_a_hard_case_comes_to_figures_with_their_goals(case, asked):
    for row in case(asked):
        assert row["measured"] >= 0.0
        assert row["must"] >= row["aim"]


def test_every_goal_is_set_against_what_was_measured(small, monkeypatch):
    monkeypatch.setattr(accuracy, "HELD_OUT", ("F",))
    monkeypatch.setattr(report, "NOISE_HZ", (25.0,))
    lines = report.goals(small)
    assert all(isinstance(line["measured"], float | int) for line in lines)
    figures = [line["figure"] for line in lines]
    assert len(set(figures)) == len(figures)
    assert sum("no model's family" in figure for figure in figures) == len(SCENARIOS)
    assert any("measured on real skin" in figure for figure in figures)
