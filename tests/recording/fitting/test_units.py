"""Known pressures in another unit than kPa are refused, and what is kept stays as it is."""

import json
from pathlib import Path

import numpy as np
import pytest

from skin_host.config.settings import load
from skin_host.daemon.calibrate import calibration_path
from tests.support.limbs import (
    ARM,
    LEVELS,
    PADS,
    calibrate,
    pressed,
    ramp,
    staircase,
    with_levels,
    write_config,
    write_log,
)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot with gains, and recordings of a course of pressure and of levels."""
    bench = write_config(tmp_path_factory.mktemp("units"))
    write_log(bench.with_name("air.log"), ramp(bench)[0])
    log = write_log(bench.with_name("levels.log"), staircase(np.ones(2 * PADS)))
    assert with_levels(bench, log) == 0
    return bench


def scaled(bench: Path, factor: float) -> Path:
    """The table of the course of pressure, its numbers times a factor."""
    time_s, kpa = np.loadtxt(bench.with_name("air.csv"), delimiter=",").T
    table = bench.with_name("scaled.csv")
    np.savetxt(table, np.column_stack([time_s, factor * kpa]), delimiter=",")
    return table


def refused(bench: Path, status: int, error: str, unit: str) -> None:
    """Nothing is written, and one line names the unit."""
    assert status == 2
    assert error.count("\n") == 1
    assert f"are they in {unit}" in error
    kept = json.loads(calibration_path(load(bench), "main").read_text())
    assert kept["parts"]["arm"]["gain"] == pytest.approx([1.0] * PADS, rel=0.1)
    assert kept.get("curves") is None


@pytest.mark.parametrize(("factor", "unit"), [(10.0, "mbar"), (0.145, "N/cm2 or psi")])
def test_a_table_in_another_unit_is_refused(
    bench: Path, capsys: pytest.CaptureFixture[str], factor: float, unit: str
) -> None:
    table = scaled(bench, factor)
    capsys.readouterr()
    status = calibrate(bench, bench.with_name("air.log"), table)
    error = capsys.readouterr().err
    refused(bench, status, error, unit)
    assert str(table) in error


def test_pressures_of_the_stiffest_foam_are_kept_with_a_warning(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = bench.with_name("stiff.json")
    words = "--output", output, "--json"
    assert calibrate(bench, bench.with_name("air.log"), scaled(bench, 7.0), *words) == 0
    answer = capsys.readouterr()
    (line,) = answer.err.splitlines()
    assert line.startswith("warning: ")
    assert "are they in mbar" in line
    assert 4.0 < json.loads(answer.out)["ratio_to_curve"] < 6.5


@pytest.mark.parametrize(
    ("levels", "unit"),
    [
        ((200.0, 400.0, 800.0), "mbar"),
        ((0.2, 0.4, 0.8), "bar"),
        ((3.0, 6.0, 11.6), "N/cm2 or psi"),
        # No unit is so near, but no gain is so large.
        (tuple(6.0 * level for level in LEVELS), "mbar"),
    ],
)
def test_levels_in_another_unit_are_refused(
    bench: Path, capsys: pytest.CaptureFixture[str], levels: tuple[float, ...], unit: str
) -> None:
    capsys.readouterr()
    status = with_levels(bench, bench.with_name("levels.log"), "--json", levels=levels)
    answer = capsys.readouterr()
    assert answer.out == ""
    refused(bench, status, answer.err, unit)


def test_levels_that_fit_less_than_half_of_a_board_are_refused(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units = pressed(staircase(np.ones(2 * PADS)), ARM)
    units[:, 9:] = 0.0
    log = write_log(tmp_path / "few.log", units)
    assert with_levels(bench, log) == 2
    assert "9 of 24 pads of the pressed boards can be fitted" in capsys.readouterr().err


def test_a_file_of_a_newer_version_is_left_as_it_is(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = tmp_path / "kept.json"
    kept.write_text('{"schema": "skin.calibration/2", "new": 1}')
    before = kept.read_bytes()
    words = "--output", kept
    for status in (
        calibrate(bench, bench.with_name("air.log"), scaled(bench, 1.0), *words),
        with_levels(bench, bench.with_name("levels.log"), *words),
    ):
        assert status == 2
        assert kept.read_bytes() == before
    assert capsys.readouterr().err.count(f"mv {kept} {kept}.newer") == 2
