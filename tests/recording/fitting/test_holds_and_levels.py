"""From a recording of CAN frames to parameters, and from those to better pressures."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from emulator.probes.foam import Foam
from emulator.probes.viscoelastic import FoamTruth
from skin_host.bus.wire import encode_sweep
from skin_host.cli import main
from skin_host.config.settings import load, skin_hash
from skin_host.errors import ConfigurationError, RequestError
from skin_host.evaluation.histories import record
from skin_host.layout import build_layout
from skin_host.processing.calibration.file import load_calibration
from skin_host.processing.pressure import PressureCurve
from skin_host.recording.fitting.levels import plateaus
from tests.support.limbs import without

HZ = 5.0
TRIANGLES = np.array([0, 1])
N = 12 * len(TRIANGLES)
CURVE = PressureCurve(2.88)
CONFIG = """
robot = "bench"
[buses.can0]
[boards.palm]
bus = "can0"
address = 3
period_ms = 200
[parts.palm]
foam_mm = 2.0
patches = [{ board = "palm", triangles = "0-1", shift = 3 }]
"""


@pytest.fixture
def bench(tmp_path):
    config = tmp_path / "bench.toml"
    config.write_text(CONFIG)
    return config


def write_log(path, units):
    """A candump log of activations [t, n], with noise, a second of which lies between codes."""
    rng = np.random.default_rng(3)
    resting = rng.uniform(235.0, 241.0, N)
    status = np.zeros(len(TRIANGLES), np.uint16)
    with path.open("w") as file:
        for sweep, activation in enumerate(units):
            level = resting - activation + rng.normal(0.0, 0.4, N)
            values = np.clip(np.rint(level), 0, 255).astype(np.uint8).reshape(-1, 12)
            ids, data = encode_sweep(3, TRIANGLES, values, status)
            for number, (can_id, payload) in enumerate(zip(ids, data, strict=True)):
                time_s = 1.7e9 + sweep / HZ + 1e-4 * number
                file.write(f"({time_s:.6f}) can0 {can_id:03X}#{payload.tobytes().hex().upper()}\n")


@pytest.fixture(scope="module")
def hold(tmp_path_factory):
    """A hold of four minutes on half a triangle, four minutes of rest, and the load cell."""
    folder = tmp_path_factory.mktemp("hold")
    played = record("A", [(0.0, 10.0), (60.0, 240.0), (0.0, 240.0)], HZ)
    units = np.zeros((len(played.momentary_kpa), N))
    units[:, :6] = CURVE.units(played.momentary_kpa[:, np.newaxis])
    log = folder / "hold.log"
    write_log(log, units)
    load_cell = folder / "load.csv"
    time_s = np.arange(len(played.pressure_kpa)) / HZ
    np.savetxt(load_cell, np.column_stack([time_s, played.pressure_kpa]), delimiter=",")
    return log, load_cell


def run(capsys, *arguments):
    status = main([str(argument) for argument in arguments])
    return status, capsys.readouterr()


def test_a_hold_and_release_becomes_a_file_that_the_configuration_takes(bench, hold, capsys):
    log, load_cell = hold
    status, said = run(
        capsys, "calibrate", bench, "--relaxation", log, "--load", load_cell, "--json"
    )
    assert status == 0
    told = json.loads(said.out)
    assert told["hold_s"] == pytest.approx(240.0, abs=2.0)
    assert told["level_kpa"] == pytest.approx(57.0, abs=4.0)
    # Six taxels at 1.7 kPa a unit.
    assert told["unit_rms_kpa"] == pytest.approx(1.7 / np.sqrt(12 * 6), abs=0.03)
    by_model = {found["model"]: found for found in told["fits"]}
    assert by_model["asymmetric"]["rms_hold_kpa"] < 1.0
    assert by_model["asymmetric"]["rms_rest_kpa"] < 1.0
    assert any("one level" in remark for remark in told["remarks"])

    bench.write_text(CONFIG + '[processing.relaxation]\nfile = "bench.relaxation.json"\n')
    relaxation = load(bench).processing.relaxation
    assert relaxation.model == "asymmetric"
    assert 0.1 < sum(relaxation.beta) < 0.4


def test_a_file_of_an_unknown_model_says_how_to_make_one(bench):
    fitted = {"schema": "skin.relaxation/1", "model": "prony"}
    fitted |= {name: [0.1] for name in ("beta", "tau_s", "beta_unload", "tau_unload_s")}
    bench.with_name("old.json").write_text(json.dumps(fitted))
    bench.write_text(CONFIG + '[processing.relaxation]\nfile = "old.json"\n')
    with pytest.raises(ConfigurationError, match=r"'prony'.*make one with: skin calibrate"):
        load(bench)


def test_people_are_told_what_the_record_cannot_tell(bench, hold, capsys):
    log, _ = hold
    status, said = run(capsys, "calibrate", bench, "--relaxation", log, "--weight-kpa", 50)
    assert status == 0
    assert "> asymmetric" in said.out
    assert "readings in whole units leave up to 0.2" in said.out
    assert "not known from this record" in said.out
    assert "bench.relaxation.json" in said.out


def test_without_a_load_the_unloading_still_tells(bench, hold, capsys):
    log, _ = hold
    status, said = run(
        capsys, "calibrate", bench, "--relaxation", log, "--model", "asymmetric", "--json"
    )
    assert status == 0
    told = json.loads(said.out)
    (found,) = [one for one in told["fits"] if one["model"] == "asymmetric"]
    assert found["rms_hold_kpa"] is None
    assert found["rms_rest_kpa"] < 1.0
    assert any("unknown" in remark for remark in told["remarks"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--relaxation", "nothing.log"], "nothing.log"),
        (["--relaxation", "{log}", "--load", "none.csv"], "none.csv"),
        (["--relaxation", "{log}", "--load", "{log}"], "hold.log"),
        (["--pressure", "{log}"], "--levels"),
        (["--pressure", "{log}", "--levels", "10", "20", "30"], "plateaus"),
    ],
)
def test_wrong_requests_are_one_line_and_write_nothing(bench, hold, capsys, arguments, message):
    log, _ = hold
    before = set(bench.parent.iterdir())
    status, said = run(capsys, "calibrate", bench, *(text.format(log=log) for text in arguments))
    assert status == 2
    assert message in said.err
    assert said.err.strip().count("\n") == 0
    assert set(bench.parent.iterdir()) == before


def test_a_recording_without_a_hold_is_refused(bench, tmp_path, capsys):
    log = tmp_path / "quiet.log"
    write_log(log, np.zeros((300, N)))
    status, said = run(capsys, "calibrate", bench, "--relaxation", log)
    assert status == 2
    assert "no taxel was held" in said.err


def test_a_relaxation_file_that_cannot_be_used_is_refused(bench, capsys):
    bench.write_text(CONFIG + '[processing.relaxation]\nfile = "none.json"\n')
    status, said = run(capsys, "check", bench)
    assert status == 2
    assert "processing.relaxation.file" in said.err
    assert "skin calibrate CONFIG --relaxation LOG" in said.err


def test_levels_of_air_pressure_become_gains_that_halve_the_error(bench, tmp_path, capsys):
    levels = [10.0, 25.0, 50.0, 80.0, 110.0]
    foam = Foam.drawn(N, np.random.default_rng(8))
    rows = [np.zeros((100, N))]
    for level in levels:
        strain = foam.strain(np.full(N, level))
        rows += [np.tile(100.0 * strain / (1.0 - strain) / 2.88, (40, 1)), np.zeros((40, N))]
    log = tmp_path / "air.log"
    write_log(log, np.concatenate(rows))
    output = tmp_path / "palm.json"
    output.symlink_to("kept.json")
    status, said = run(
        capsys,
        *("calibrate", bench, "--pressure", log, "--output", output, "--json", "--levels"),
        *levels,
    )
    assert status == 0
    assert output.is_symlink()
    told = json.loads(said.out)
    assert told["fitted"] == N
    assert told["rms_after_kpa"] < 0.5 * told["rms_before_kpa"]
    settings = load(bench)
    layout = build_layout(settings, bench.parent)
    found = load_calibration(output, layout, skin_hash(settings))
    assert found.gain.std() > 0.01


def test_the_imprint_of_a_high_level_is_no_level_and_creep_parts_none(bench, tmp_path, capsys):
    levels = [10.0, 40.0, 80.0, 100.0, 20.0]
    truth = FoamTruth("S", 1)
    momentary = [0.0] * 100
    for level in levels:
        for pressure, seconds in ((level, 12.0), (0.0, 20.0)):
            momentary += [
                float(truth.step_pressure([pressure], 1.0 / HZ)[0])
                for _ in range(int(seconds * HZ))
            ]
    log = tmp_path / "air.log"
    write_log(log, np.tile(CURVE.units(np.array(momentary)[:, np.newaxis]), (1, N)))
    output = tmp_path / "palm.json"
    arguments = ("calibrate", bench, "--pressure", log, "--output", output, "--json", "--levels")
    status, said = run(capsys, *arguments, *levels)
    assert (status, said.err) == (0, "")
    assert json.loads(said.out)["rms_after_kpa"] < 2.0
    status, said = run(capsys, *arguments, *levels[:-1])
    assert status == 2
    assert "plateaus of pressure in the recording: 5" in said.err
    assert "levels given: 4" in said.err


def test_plateaus_are_found_with_what_settles_left_out():
    kpa = np.concatenate(
        [np.zeros(50), np.full(60, 20.0), np.zeros(40), np.linspace(0, 90, 100), np.full(80, 90.0)]
    )
    first, second = plateaus(kpa, 0.05)
    assert 50 < first.start < first.stop <= 110
    assert 250 - 10 < second.start < second.stop <= 330
    assert plateaus(np.zeros(100), 0.05) == []


def test_a_moment_of_noise_parts_no_plateau_and_a_step_does():
    kpa = np.concatenate([np.zeros(40), np.full(100, 50.0), np.full(100, 70.0), np.zeros(40)])
    kpa[90] = 58.0
    first, second = plateaus(kpa, 0.1)
    assert first.stop - first.start > 60
    assert kpa[second].mean() == pytest.approx(70.0)


def test_a_hold_that_is_never_let_go_is_refused(bench, tmp_path, capsys):
    units = np.zeros((400, N))
    units[100:, :4] = 20.0
    log = tmp_path / "held.log"
    write_log(log, units)
    status, said = run(capsys, "calibrate", bench, "--relaxation", log)
    assert status == RequestError.exit_status
    assert "release" in said.err


def test_a_recording_of_several_presses_is_no_hold(bench, tmp_path, capsys):
    units = np.zeros((600, N))
    for start in (60, 200, 340):
        units[start : start + 80, :4] = 20.0
    log = tmp_path / "presses.log"
    write_log(log, units)
    status, said = run(capsys, "calibrate", bench, "--relaxation", log)
    assert status == 2
    assert said.err.count("\n") == 1
    assert "pressed 3 times; wanted one hold" in said.err
    assert not bench.with_suffix(".relaxation.json").exists()


@pytest.mark.parametrize("load", [False, True], ids=["alone", "load cell"])
@pytest.mark.parametrize(("begin_s", "end_s"), [(9.0, 14.0), (248.0, 253.0)])
def test_a_press_or_release_in_a_gap_is_refused(
    bench, hold, tmp_path, capsys, begin_s, end_s, load
):
    """Its time is not known: the foam would seem to lose a fifth less."""
    log, load_cell = hold
    cut = without(log, begin_s, end_s, output=tmp_path / "cut.log")
    more = ["--load", load_cell] if load else []
    status, said = run(capsys, "calibrate", bench, "--relaxation", cut, *more)
    assert status == 2
    assert f"palm: nothing of it was received for 5.6 s, from {begin_s:.1f} s" in said.err
    assert not bench.with_suffix(".relaxation.json").exists()


def test_a_gap_while_nothing_moves_is_left_out_of_the_fit(bench, hold, tmp_path, capsys):
    log, _ = hold
    found = []
    cut = without(log, 300.0, 400.0, output=tmp_path / "cut.log")
    for number, recording in enumerate([log, cut]):
        output = tmp_path / f"{number}.json"
        status, _ = run(capsys, "calibrate", bench, "--relaxation", recording, "--output", output)
        assert status == 0
        found.append(sum(json.loads(output.read_text())["beta"]))
    assert found[1] == pytest.approx(found[0], abs=0.015)


def test_what_is_no_load_cell_is_refused_with_what_is_wanted(bench, hold, capsys):
    log, _ = hold
    for wrong in (bench, bench.with_name("nowhere.csv")):
        status, said = run(capsys, "calibrate", bench, "--relaxation", log, "--load", wrong)
        assert status == 2
        assert str(wrong) in said.err
        assert "wanted rising times in s and pressures in kPa" in said.err


def of_another_time(time_s, kpa):
    return time_s + 1.5e9, kpa


def with_a_gap(time_s, kpa):
    kept = (time_s < 40.0) | (time_s > 55.0)
    return time_s[kept], kpa[kept]


def in_bar(time_s, kpa):
    return time_s, kpa / 100.0


def same_clock(time_s, kpa):
    return time_s + 1.7e9, kpa


def same_clock_and_earlier(time_s, kpa):
    earlier = np.arange(-5.0, 0.0, 0.2)
    time_s, kpa = np.concatenate([earlier, time_s]), np.concatenate([0.0 * earlier, kpa])
    return time_s + 1.7e9, kpa


@pytest.mark.parametrize("change", [same_clock, same_clock_and_earlier])
def test_a_load_cell_is_used_whichever_clock_its_table_has_and_however_early_it_begins(
    bench, hold, tmp_path, capsys, change
):
    log, own = hold
    table = tmp_path / "cell.csv"
    np.savetxt(table, np.column_stack(change(*np.loadtxt(own, delimiter=",").T)), "%.3f", ",")
    fits = []
    for load_cell in (own, table):
        status, said = run(
            capsys, "calibrate", bench, "--relaxation", log, "--load", load_cell, "--json"
        )
        assert status == 0
        fits.append(json.loads(said.out)["fits"])
    assert [one["rms_hold_kpa"] for one in fits[1]] == pytest.approx(
        [one["rms_hold_kpa"] for one in fits[0]], abs=0.05
    )


@pytest.mark.parametrize("ahead_s", [2.0, -5.0, 20.0])
def test_the_lag_of_the_tables_clock_is_found_from_press_and_release(
    bench, hold, tmp_path, capsys, ahead_s
):
    log, own = hold
    time_s, kpa = np.loadtxt(own, delimiter=",").T
    table = tmp_path / "cell.csv"
    np.savetxt(table, np.column_stack([time_s + 1.7e9 + ahead_s, kpa]), "%.3f", ",")
    found = []
    for load_cell in (own, table):
        arguments = ("--relaxation", log, "--load", load_cell, "--json")
        status, said = run(capsys, "calibrate", bench, *arguments)
        assert status == 0
        found.append(json.loads(said.out))
    exact, late = found
    assert late["lag_s"] - exact["lag_s"] == pytest.approx(ahead_s, abs=0.02)
    assert abs(exact["lag_s"]) < 1.0 / HZ
    for one, other in zip(exact["fits"], late["fits"], strict=True):
        assert other["rms_hold_kpa"] == pytest.approx(one["rms_hold_kpa"], abs=0.05)


def test_people_read_the_lag_of_the_tables_clock(bench, hold, capsys):
    log, own = hold
    status, said = run(capsys, "calibrate", bench, "--relaxation", log, "--load", own)
    assert status == 0
    assert "the table's clock is +0." in said.out or "the table's clock is -0." in said.out


@pytest.mark.parametrize(
    ("kpa", "message"),
    [(6.0, "are they in N/cm2"), (24.0, "wanted less than 60%"), (85.0, "kPa RMS; wanted less")],
)
def test_a_weight_that_did_not_lie_on_the_skin_is_refused(bench, hold, capsys, kpa, message):
    log, _ = hold
    status, said = run(capsys, "calibrate", bench, "--relaxation", log, "--weight-kpa", kpa)
    assert (status, said.out) == (2, "")
    assert message in said.err
    assert said.err.count("\n") == 1
    assert not bench.with_suffix(".relaxation.json").exists()


def test_a_relaxation_file_of_a_newer_version_is_left_as_it_is(bench, hold, capsys):
    log, _ = hold
    kept = bench.with_suffix(".relaxation.json")
    kept.write_text('{"schema": "skin.relaxation/2", "x": 1}')
    status, said = run(capsys, "calibrate", bench, "--relaxation", log, "--weight-kpa", 50)
    assert status == 2
    assert f"mv {kept} {kept}.newer" in said.err
    assert kept.read_text() == '{"schema": "skin.relaxation/2", "x": 1}'


def in_pascal(time_s, kpa):
    return time_s, 1000.0 * kpa


def in_tens_of_pascal(time_s, kpa):
    return time_s, 100.0 * kpa


def in_millibar(time_s, kpa):
    return time_s, 10.0 * kpa


def in_newton_per_cm2(time_s, kpa):
    # Not quite: a tenth of it would span too little for any pressure.
    return time_s, 0.2 * kpa


def of_a_stronger_hold(time_s, kpa):
    return time_s, 1.4 * kpa


def of_a_weaker_hold(time_s, kpa):
    return time_s, 0.45 * kpa


def fading_away(time_s, kpa):
    return time_s, kpa * np.exp(-np.maximum(time_s - 12.0, 0.0) / 50.0)


def after_the_hold(time_s, kpa):
    return time_s[1300:], kpa[1300:] + np.linspace(0.0, 12.0, len(kpa) - 1300)


def of_half_the_hold(time_s, kpa):
    return time_s[:600], kpa[:600]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (in_pascal, "are they in Pa?"),
        (in_bar, "are they in bar"),
        (in_tens_of_pascal, "times those of the configured curve"),
        (in_millibar, "are they in mbar"),
        (in_newton_per_cm2, "are they in N/cm2"),
        (of_a_stronger_hold, "kPa RMS; wanted less than 5."),
        (of_a_weaker_hold, "of a hold's pressure away; wanted less than 60%"),
        (fading_away, "of a hold's pressure away; wanted less than 60%"),
        (of_another_time, "pressure of the same time"),
        (after_the_hold, "pressure of the same time"),
        (of_half_the_hold, "of the hold's"),
        (with_a_gap, "a gap of 15"),
    ],
)
def test_a_load_that_is_not_that_of_the_hold_is_one_line_and_nothing_is_kept(
    bench, hold, tmp_path, capsys, change, message
):
    log, own = hold
    table = tmp_path / "cell.csv"
    np.savetxt(table, np.column_stack(change(*np.loadtxt(own, delimiter=",").T)), "%.3f", ",")
    status, said = run(capsys, "calibrate", bench, "--relaxation", log, "--load", table)
    assert (status, said.out) == (2, "")
    assert message in said.err
    assert said.err.count("\n") == 1
    assert not bench.with_suffix(".relaxation.json").exists()


def test_a_sample_taken_while_the_probe_moved_does_not_count(bench, tmp_path, capsys):
    played = record("A", [(0.0, 10.0), (60.0, 240.0), (0.0, 240.0)], HZ)
    units = np.zeros((len(played.momentary_kpa), N))
    units[:, :6] = CURVE.units(played.momentary_kpa[:, np.newaxis])
    units[np.argmax(played.pressure_kpa > 30.0)] *= 0.7
    write_log(tmp_path / "hold.log", units)
    time_s = np.arange(len(played.pressure_kpa)) / HZ
    cell = tmp_path / "load.csv"
    np.savetxt(cell, np.column_stack([time_s, played.pressure_kpa]), delimiter=",")
    arguments = (
        "calibrate",
        bench,
        "--relaxation",
        tmp_path / "hold.log",
        "--load",
        cell,
        "--json",
    )
    status, said = run(capsys, *arguments)
    assert status == 0
    assert max(found["rms_hold_kpa"] for found in json.loads(said.out)["fits"]) < 0.7


@pytest.fixture(scope="module")
def staircase(tmp_path_factory):
    """A skin of another shape of curve under a staircase of air pressure, and its table."""
    folder = tmp_path_factory.mktemp("staircase")
    levels = np.concatenate([[0.0], np.linspace(0.0, 240.0, 9), np.linspace(210.0, 0.0, 8)])
    kpa = np.repeat(levels, round(8 * HZ))
    kpa = np.convolve(np.pad(kpa, 5, mode="edge"), np.ones(10) / 10, "same")[5:-5]
    units = kpa / 8.0 + 1.5 * (1.0 - np.exp(-kpa / 30.0))
    log, table = folder / "air.log", folder / "air.csv"
    write_log(log, np.outer(units, np.linspace(0.8, 1.2, N)))
    time_s = np.arange(len(kpa)) / HZ + 1.2
    np.savetxt(table, np.column_stack([time_s, kpa]), delimiter=",", header="time_s,pressure_kpa")
    return log, table


@pytest.fixture
def chamber(staircase, tmp_path):
    """The recording of the staircase, and a copy of its table to change."""
    log, table = staircase
    return log, Path(shutil.copy(table, tmp_path))


def test_any_course_of_pressure_becomes_curves_that_a_replay_uses(bench, chamber, tmp_path, capsys):
    log, table = chamber
    output = tmp_path / "palm.json"
    status, said = run(
        capsys,
        *("calibrate", bench, "--pressure", log, "--load", table, "--output", output, "--json"),
    )
    assert (status, said.err) == (0, "")
    told = json.loads(said.out)
    assert told["counts"]["good"] == N
    assert told["lag_s"] == pytest.approx(1.2, abs=0.3)
    assert told["median_error_kpa"] < 5.0
    assert len(told["parts"]["palm"]["verdict"]) == N

    status, said = run(
        capsys,
        *("replay", log, "--config", bench, "--calibration", output, "--calibrate-seconds", 5),
    )
    assert status == 0
    lines = [json.loads(line) for line in said.out.splitlines()]
    frames = [line for line in lines if line["type"] == "frame"]
    highest = max(np.mean(frame["pressure_kpa"]) for frame in frames)
    assert highest == pytest.approx(240.0, abs=12.0)
    assert np.mean(frames[10]["pressure_kpa"]) < 10.0


def test_people_read_what_a_course_of_pressure_showed(bench, chamber, tmp_path, capsys):
    log, table = chamber
    status, said = run(
        capsys,
        *("calibrate", bench, "--pressure", log, "--load", table),
        *("--output", tmp_path / "palm.json"),
    )
    assert status == 0
    assert "24 good" in said.out
    assert "expected error" in said.out


def falling(time_s, kpa):
    return time_s[::-1], kpa


def too_short(time_s, kpa):
    return time_s[:300], kpa[:300]


def fast(time_s, kpa):
    return 1.05 * time_s, kpa


def slow(time_s, kpa):
    return 0.97 * time_s, kpa


def of_something_else(time_s, kpa):
    return time_s, 50.0 + 40.0 * np.sin(time_s * 3.0)


def not_finite(time_s, kpa):
    return time_s, np.where(time_s > 30.0, np.nan, kpa)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (of_another_time, "pressure of the same time"),
        (with_a_gap, "a gap of 15"),
        (falling, "follows"),
        (in_bar, "bar"),
        (too_short, "recording's"),
        (fast, "the table's clock runs 5.0% fast"),
        (slow, "the table's clock runs 3.0% slow"),
        (of_something_else, "do not follow"),
        (not_finite, "not finite"),
    ],
)
def test_a_wrong_table_is_one_line_and_nothing_is_kept(bench, chamber, capsys, change, message):
    log, table = chamber
    time_s, kpa = change(*np.loadtxt(table, delimiter=",").T)
    np.savetxt(table, np.column_stack([time_s, kpa]), delimiter=",")
    output = bench.with_name("palm.json")
    status, said = run(
        capsys, "calibrate", bench, "--pressure", log, "--load", table, "--output", output
    )
    assert status == 2
    assert message in said.err
    assert str(table) in said.err
    assert said.err.strip().count("\n") == 0
    assert not output.exists()


@pytest.mark.parametrize("content", [b"", b"time_s,pressure_kpa\n", b"1,2,3\n", b"\xff\xfe\x00"])
def test_what_is_no_table_of_pressure_is_refused(bench, chamber, capsys, content):
    log, table = chamber
    table.write_bytes(content)
    status, said = run(capsys, "calibrate", bench, "--pressure", log, "--load", table)
    assert status == 2
    assert f"{table}" in said.err
    assert "wanted rising times" in said.err


def test_a_recording_in_which_nothing_is_pressed_is_refused(bench, chamber, tmp_path, capsys):
    _, table = chamber
    log = tmp_path / "quiet.log"
    write_log(log, np.zeros((len(np.loadtxt(table, delimiter=",")), N)))
    output = tmp_path / "palm.json"
    status, said = run(
        capsys, "calibrate", bench, "--pressure", log, "--load", table, "--output", output
    )
    assert status == 2
    assert "nothing is pressed" in said.err
    assert not output.exists()


def test_levels_and_a_table_exclude_each_other(bench, chamber, capsys):
    log, table = chamber
    for more in ((), ("--load", table, "--levels", 10)):
        status, said = run(capsys, "calibrate", bench, "--pressure", log, *more)
        assert status == 2
        assert "one of the two" in said.err
