"""The report's parts in small: what they contain, and that they say what is so."""

import json
import pickle

import numpy as np
import pytest

from skin_host.evaluation import accuracy, bench_processing, page, report, speed, tables, touching
from skin_host.evaluation.accuracy import Plan
from skin_host.evaluation.histories import HISTORIES, record
from skin_host.evaluation.rig import Rig

PLAN = Plan(0.03, 5.0, 1)


@pytest.fixture(scope="module")
def small():
    """A whole report of one truth, short histories and next to no repeats."""
    rows, fits = accuracy.score("S", PLAN)
    made = {
        "schema": report.SCHEMA,
        "date": "2026-01-02T03:04:05+00:00",
        "machine": report.machine(),
        "quick": True,
        "default": report._key(report.DEFAULT),
        "rows": rows,
        "fits": fits,
        "cycles": accuracy.cycles("S", 200, report.QUICKLY_CYCLED),
        "speed": speed.models(0.0, (192, 1920)),
        "pipeline": speed.pipeline(0.0, (1, 10)),
        "unwatched": speed.cost_of_glancing(10.0),
        "false_touches": touching.false_touches(0.001, (2,), boards=1),
        "detection": touching.detection_delays(boards=1),
        "drift": touching.drift_lags(0.1, "paper"),
        "holds": [
            touching.long_hold("S", "short", 600.0, 0.0, 5.0, alone) for alone in (False, True)
        ],
        "localization": report._localization(20),
        "seconds": 1.0,
    }
    made["summary"] = report.summary(made)
    made["cycle_evidence"] = report.cycle_evidence(made)
    return made


def test_the_published_model_is_wrong_by_far_and_the_default_by_little(small):
    rms = {
        row["model"]: row["rms_kpa"]
        for row in report.select(small["rows"], history="cycling", noise_units=0.0, update_s=1.0)
    }
    assert rms["asymmetric_clock"] < 0.5
    assert rms["published"] > 5.0 * rms["asymmetric_clock"]


def test_a_perfect_model_leaves_nothing_but_the_step_of_the_reading(small):
    perfect = report.select(small["rows"], model="perfect")
    assert all(row["rms_kpa"] < 1e-9 for row in perfect if row["noise_units"] == 0.0)
    assert all(0.2 < row["rms_kpa"] < 1.3 for row in perfect if row["noise_units"] > 0.0)


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
    assert row["change_by_float32_and_1_hz_kpa"] < 0.01
    growth, last = report.growth_of_error(report.select(small["cycles"], **small["default"]))
    assert last == 200
    assert growth == pytest.approx(abs(row["error_kpa"][1]) - abs(row["error_kpa"][0]))


def test_each_row_tells_what_its_model_shares_with_its_truth(small):
    shared = {row["model"]: row["in_common"] for row in small["rows"]}
    assert shared["asymmetric_clock"] == "cause"
    assert shared["asymmetric"] == shared["prony"] == "none"
    assert accuracy.FAMILY["prony"]["L"] == "law"
    assert "left out" in tables.verdict_of_strangers(small)
    as_if = small | {"rows": [row | {"truth": "H"} for row in small["rows"]]}
    assert tables.verdict_of_strangers(as_if).startswith("On H the default leaves 0.")
    # No model is what any other truth is made of.
    assert all(of["H"] != "law" != of["A"] for of in accuracy.FAMILY.values())


def test_jobs_are_sent_to_processes_with_all_that_they_need():
    for name, function, arguments in report._jobs(quick=True):
        assert pickle.loads(pickle.dumps((name, function, arguments)))[0] == name
    assert {name for name, *_ in report._jobs(quick=True)} == {
        name for name, *_ in report._jobs(quick=False)
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
    small = small | {"goals": [report._goal("a figure", 1.0, 2.0, 0.5)]}
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
    assert report._goal("x", 1.0, 1.0, 0.5)["reached"]
    assert not report._goal("x", 1.01, 1.0, 0.5)["reached"]
    assert report._goal("x", 0.5, 1.0, 0.5)["aim_reached"]


def test_a_hold_is_told_as_long_as_it_lasts_and_leaves_no_ghost(small):
    for row in small["holds"]:
        assert row["touched_share_in_hold"] == 1.0
        assert row["ghost_s_per_taxel"] == 0.0
        assert row["rest_rms_kpa"] < 1.5


def test_the_higher_the_press_the_sooner_it_is_told(small):
    told = [row["told_within_2_s"] for row in small["detection"]]
    assert told[0] < 1.0
    assert told[-1] == 1.0
    assert small["detection"][-1]["median_sweeps"] == 2.0


def test_the_bench_compares_with_a_copy_in_the_same_run(small):
    document = bench_processing.with_ratios(small["speed"], small["pipeline"])
    copies = report.select(document["models"], model="memory_copy")
    assert all(row["ratio_to_copy"] == 1.0 for row in copies)
    assert "times a copy" in bench_processing.describe(document)


@pytest.mark.parametrize("kind", ["A", "S", "L", "H"])
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
