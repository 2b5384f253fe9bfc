"""What a course of pressure cannot show is not kept: it is refused, or named."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from skin_host.config.settings import load
from skin_host.daemon.calibrate import calibration_path
from skin_host.errors import RequestError
from skin_host.processing.curves import CurveVerdict, Memory
from skin_host.processing.fitting.memory import loading_kpa
from skin_host.recording.load_table import LoadTable, read_table, without_spikes
from tests.support.limbs import (
    ARM,
    CURVE,
    HZ,
    PADS,
    calibrate,
    pressed,
    ramp,
    staircase,
    stored,
    with_levels,
    without,
    write_config,
    write_log,
)

Floats = NDArray[np.float64]


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    return write_config(tmp_path)


def table_of(bench: Path, kpa: Floats) -> Path:
    path = bench.with_name("course.csv")
    np.savetxt(path, np.column_stack([np.arange(len(kpa)) / HZ, kpa]), delimiter=",")
    return path


def test_a_recording_that_begins_pressed_is_refused_by_what_its_table_shows(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units, table = ramp(bench)
    kpa = np.loadtxt(table, delimiter=",")[:, 1]
    begun = round(28.0 * HZ)
    log = write_log(bench.with_name("air.log"), units[begun:])
    capsys.readouterr()
    assert calibrate(bench, log, table_of(bench, kpa[begun:])) == 2
    error = capsys.readouterr().err
    assert "the first 5 s of the recording, of which the zero is taken, are at 40 to 47" in error
    assert not calibration_path(load(bench), "main").exists()


def test_a_recording_that_is_pressed_while_its_zero_is_taken_is_refused(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units, table = ramp(bench)
    kpa = np.loadtxt(table, delimiter=",")[:, 1]
    begun = round(11.0 * HZ)
    log = write_log(bench.with_name("air.log"), units[begun:])
    assert calibrate(bench, log, table_of(bench, kpa[begun:])) == 2
    assert "are at 6 to 16 kPa; wanted untouched skin then" in capsys.readouterr().err


def test_a_chamber_that_rests_at_some_kpa_is_named_by_its_unit_and_not_as_a_press(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """6 kPa of rest are 60 mbar."""
    units, table = ramp(bench)
    kpa = np.loadtxt(table, delimiter=",")[:, 1]
    log = write_log(bench.with_name("air.log"), units)
    assert calibrate(bench, log, table_of(bench, 10.0 * (kpa + 6.0))) == 2
    assert "are they in mbar" in capsys.readouterr().err


def test_absolute_pressures_are_named(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    units, table = ramp(bench)
    kpa = np.loadtxt(table, delimiter=",")[:, 1]
    log = write_log(bench.with_name("air.log"), units)
    assert calibrate(bench, log, table_of(bench, kpa + 101.3)) == 2
    assert "no pressure is below 101 kPa: are they absolute" in capsys.readouterr().err


def test_a_chamber_that_rests_at_some_kpa_is_untouched(bench: Path) -> None:
    units, table = ramp(bench)
    kpa = np.loadtxt(table, delimiter=",")[:, 1]
    log = write_log(bench.with_name("air.log"), units)
    assert calibrate(bench, log, table_of(bench, kpa + 6.0)) == 0


def test_a_course_that_fits_less_than_half_of_the_pads_is_refused(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units, table = ramp(bench)
    wander = 9.0 * np.sin(np.arange(len(units)) / HZ / 2.0)
    wandering = np.arange(2 * PADS) % 3 > 0
    units += np.where(wandering & (units > 12.0), wander[:, np.newaxis], 0.0)
    log = write_log(bench.with_name("air.log"), units)
    assert calibrate(bench, log, table) == 2
    assert "16 of 48 pads of the pressed boards can be fitted" in capsys.readouterr().err
    assert not calibration_path(load(bench), "main").exists()


def test_the_hysteresis_of_a_foam_that_is_not_let_go_is_not_known(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units, table = ramp(bench)
    up = round(48.0 * HZ)
    log = write_log(bench.with_name("air.log"), units[:up])
    assert calibrate(bench, log, table) == 0
    answer = capsys.readouterr()
    assert "hysteresis of the foam: not known" in answer.out
    assert "expected error of the good while loading" in answer.out
    (line,) = answer.err.splitlines()
    assert "pressures that go down read too high" in line
    assert calibrate(bench, log, table, "--json") == 0
    assert json.loads(capsys.readouterr().out)["hysteresis_known"] is False


def test_hysteresis_is_known_as_far_as_the_pressure_goes_down(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    corners_s = [0.0, 8.0, 48.0, 53.0, 58.0, 80.0]
    kpa = np.interp(np.arange(0.0, 80.0, 1.0 / HZ), corners_s, [0.0, 0.0, 80.0, 80.0, 66.0, 66.0])
    reads_kpa = loading_kpa(kpa, Memory((6.0,), (0.5,)))
    units = CURVE.units(reads_kpa[:, np.newaxis] * np.ones(2 * PADS))
    log = write_log(bench.with_name("air.log"), units)
    assert calibrate(bench, log, table_of(bench, kpa)) == 0
    answer = capsys.readouterr()
    (radius,) = re.findall(r"hysteresis of the foam: 0\.\d+ within (\d+) kPa", answer.out)
    (line,) = answer.err.splitlines()
    assert f"the foam's hysteresis beyond {radius} kPa is not known" in line


def test_pads_that_a_weak_course_does_not_show_keep_their_curves(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units, table = ramp(bench)
    kpa = np.loadtxt(table, delimiter=",")[:, 1]
    assert calibrate(bench, write_log(bench.with_name("air.log"), units), table) == 0
    kept = calibration_path(load(bench), "main")
    before = stored(bench, kept)
    weak = 0.2 * units
    weak[:, :5] = 0.0
    log = write_log(bench.with_name("weak.log"), weak, seed=7)
    capsys.readouterr()
    assert calibrate(bench, log, table_of(bench, 0.25 * kpa)) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: taxels 0-4 of arm: moved too little in ")
    after = stored(bench, kept)
    assert before.curves is not None
    assert after.curves is not None
    assert np.array_equal(after.curves.kpa[:5], before.curves.kpa[:5])
    assert not np.array_equal(after.curves.kpa[5:], before.curves.kpa[5:])
    assert after.curves.memory == before.curves.memory
    assert (after.curves.verdict[ARM] == CurveVerdict.GOOD).all()


def test_spikes_of_a_table_are_left_out_and_its_steps_are_not() -> None:
    time_s = np.arange(0.0, 20.0, 0.02)
    kpa = np.where(time_s < 10.0, 5.0, 60.0)
    spiky = kpa.copy()
    spiky[[100, 101, 400, 700, 701]] += 20.0
    table = without_spikes(LoadTable(Path("air.csv"), time_s, spiky))
    assert table.kpa.tolist() == kpa.tolist()
    assert table.time_s.tolist() == time_s.tolist()


def test_two_lines_of_a_table_are_no_spikes() -> None:
    table = LoadTable(Path("air.csv"), np.array([0.0, 60.0]), np.array([0.0, 80.0]))
    assert without_spikes(table).kpa.tolist() == [0.0, 80.0]


@pytest.mark.parametrize("heading", ["time_s,pressure_kpa\r\n", "# chamber 2\r\n", ""])
def test_a_table_of_a_spreadsheet_is_read_from_its_first_line_on(
    tmp_path: Path, heading: str
) -> None:
    """Spreadsheets write a byte order mark and CRLF."""
    path = tmp_path / "air.csv"
    path.write_bytes(f"{heading}0.0,1.5\r\n0.1,2.5\r\n".encode("utf-8-sig"))
    table = read_table(path)
    assert table.time_s.tolist() == [0.0, 0.1]
    assert table.kpa.tolist() == [1.5, 2.5]


@pytest.mark.parametrize("heading", ['"time_s","pressure_kpa"\n', ""])
def test_a_table_whose_fields_stand_in_quotes_is_read(tmp_path: Path, heading: str) -> None:
    path = tmp_path / "course.csv"
    path.write_text(f'{heading}"0.0","1.5"\n"0.1", "2.5"\n')
    table = read_table(path)
    assert (table.time_s.tolist(), table.kpa.tolist()) == ([0.0, 0.1], [1.5, 2.5])


def test_a_table_without_numbers_is_refused_with_its_first_wrong_line(tmp_path: Path) -> None:
    path = tmp_path / "course.csv"
    path.write_text("time_s,pressure_kpa\ns,kPa\n0.0,1.5\n")
    with pytest.raises(RequestError, match=r'course.csv:2: "s,kPa"; wanted rising times'):
        read_table(path)


@pytest.mark.parametrize("addresses", ["3", "34"], ids=["one board", "all"])
def test_a_gap_while_a_board_is_pressed_is_named_and_not_its_table(
    bench: Path, capsys: pytest.CaptureFixture[str], addresses: str
) -> None:
    units, table = ramp(bench)
    log = without(write_log(bench.with_name("air.log"), units), 30.0, 40.0, addresses=addresses)
    assert calibrate(bench, log, table) == 2
    error = capsys.readouterr().err
    assert (
        "board a: nothing of it was received for 10.6 s, from 30.0 s of the recording on; "
        "wanted its readings throughout"
    ) in error
    assert not calibration_path(load(bench), "main").exists()


def test_a_board_that_ends_before_its_table_is_named(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units, table = ramp(bench)
    log = without(write_log(bench.with_name("air.log"), units), 60.0, 100.0, addresses="4")
    assert calibrate(bench, log, table) == 2
    assert "board b: nothing of it was received for 32" in capsys.readouterr().err


def test_a_recording_that_begins_in_the_middle_of_a_sweep_costs_no_pad_its_curve(
    bench: Path,
) -> None:
    units, table = ramp(bench)
    log = write_log(bench.with_name("air.log"), units)
    log.write_text("".join(log.read_text().splitlines(keepends=True)[1:]))
    assert calibrate(bench, log, table) == 0
    curves = stored(bench, calibration_path(load(bench), "main")).curves
    assert curves is not None
    assert (curves.verdict == CurveVerdict.GOOD).all()


def test_a_gap_of_a_board_that_nothing_presses_is_none_of_the_pressure(bench: Path) -> None:
    units, table = ramp(bench)
    log = write_log(bench.with_name("air.log"), pressed(units, ARM))
    assert calibrate(bench, without(log, 30.0, 40.0, addresses="4"), table) == 0


def test_a_gap_between_levels_is_named(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_log(bench.with_name("air.log"), staircase(np.ones(2 * PADS)))
    assert with_levels(bench, without(log, 22.0, 28.0, addresses="3")) == 2
    assert "board a: nothing of it was received for 6.6 s, from 22.0 s" in capsys.readouterr().err
