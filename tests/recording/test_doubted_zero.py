"""A recording whose begin gives no good zero: what `skin calibrate` reports of such skin is
reported of the recording.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skin_host.cli import main
from skin_host.layout import load_skin
from skin_host.processing.calibration import Verdict, with_curves
from skin_host.processing.calibration.file import save_calibration
from skin_host.processing.curves import KNOTS_UNITS, Curves, CurveVerdict
from skin_host.recording.export import read_frames
from skin_host.recording.replay import calibrate_from_log, doubts
from tests.support.candump import write_config, write_log

#: One taxel of a triangle and two of another.
PADS = [5, 14, 15]
WORDS = "taxels 5, 14-15 of arm"


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return write_config(tmp_path / "skin.toml")


def briefly(period: int) -> Sequence[int]:
    return PADS if 30 < period < 60 else ()


def always(period: int) -> Sequence[int]:
    return PADS


def untouched(period: int) -> Sequence[int]:
    return ()


def health_of(output: Path) -> dict[str, Any]:
    lines = map(json.loads, output.read_text().splitlines())
    (found,) = [line for line in lines if line["type"] == "health"]
    return found


@pytest.mark.parametrize("pressed", [briefly, always])
def test_pads_that_were_touched_are_named_and_in_the_health_of_the_replay(
    pressed: Any, config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write_log(tmp_path / "a.log", 140, pressed)
    output = tmp_path / "a.jsonl"
    assert main(["replay", str(log), "--config", str(config), "--output", str(output)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"warning: {log}: {WORDS} were touched")
    health = health_of(output)
    assert health["state"] == "warning"
    assert health["faults"] == [{"code": "taxel_pressed", "where": "arm"}]
    assert WORDS in health["sentences"][0]


def test_pads_without_enough_readings_are_named_and_not_valid(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write_log(tmp_path / "a.log", 25, untouched)
    output = tmp_path / "a.jsonl"
    assert main(["replay", str(log), "--config", str(config), "--output", str(output)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"warning: {log}: taxels 0-191 of arm have no zero (too few)")
    assert [one["code"] for one in health_of(output)["faults"]] == ["taxel_refused"]
    frames = [json.loads(line) for line in output.read_text().splitlines()][:-1]
    assert frames
    assert not any(any(frame["valid"]) for frame in frames)


def test_what_is_stated_of_one_pad_is_stated_of_one(config: Path, tmp_path: Path) -> None:
    settings, layout = load_skin(config)
    log = write_log(tmp_path / "a.log", 140, lambda period: PADS[:1] if 30 < period < 60 else ())
    touched = calibrate_from_log(log, settings, layout, 5.0)
    (line,) = doubts(touched, settings, layout)
    assert line.startswith(
        "taxel 5 of arm was touched while its zero was taken, and reads too little; wanted"
    )
    for verdicts, line in (
        (
            {5: Verdict.STUCK, 7: Verdict.TOO_FEW},
            "taxels 5, 7 of arm have no zero (stuck, too few) and are not valid",
        ),
        ({5: Verdict.STUCK}, "taxel 5 of arm has no zero (stuck) and is not valid"),
    ):
        verdict = np.zeros_like(touched.verdict)
        for taxel, found in verdicts.items():
            verdict[taxel] = found
        assert doubts(replace(touched, verdict=verdict), settings, layout) == [line]


def test_untouched_skin_gives_no_warning(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write_log(tmp_path / "a.log", 140, untouched)
    output = tmp_path / "a.jsonl"
    assert main(["replay", str(log), "--config", str(config), "--output", str(output)]) == 0
    assert capsys.readouterr().err == ""
    health = health_of(output)
    assert (health["state"], health["faults"]) == ("ok", [])


def test_a_stored_calibration_that_was_touched_is_reported_the_same_way(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where the recording itself begins untouched."""
    settings, layout = load_skin(config)
    touched = write_log(tmp_path / "a.log", 140, briefly)
    known = tmp_path / "known.json"
    save_calibration(known, calibrate_from_log(touched, settings, layout, 5.0), layout)
    log = write_log(tmp_path / "b.log", 140, untouched)
    command = ["replay", str(log), "--config", str(config), "--output", str(tmp_path / "b.jsonl")]
    assert main([*command, "--calibration", str(known)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{WORDS} were touched" in line


def test_of_many_recordings_each_one_is_named(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = [
        write_log(tmp_path / "a.log", 140, briefly),
        write_log(tmp_path / "b.log", 140, untouched),
        write_log(tmp_path / "c.log", 140, always),
    ]
    command = ["replay", *map(str, logs), "--config", str(config)]
    assert main([*command, "--output", str(tmp_path / "out")]) == 0
    lines = sorted(capsys.readouterr().err.splitlines())
    assert len(lines) == 2
    assert all(
        line.startswith(f"warning: {log}: {WORDS} were touched")
        for line, log in zip(lines, logs[::2], strict=True)
    )


@pytest.mark.parametrize("command", [["export"], ["plot", "pressure"]])
def test_exports_and_pictures_name_them_too(
    command: list[str], config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write_log(tmp_path / "a.log", 140, always)
    output = tmp_path / ("a.npz" if command == ["export"] else "a.png")
    assert main([*command, str(log), str(output), "--config", str(config)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"warning: {log}: {WORDS} were touched")


def test_a_fit_to_a_recording_that_begins_under_a_press_names_the_pads(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write_log(tmp_path / "a.log", 140, always)
    main(["calibrate", str(config), "--pressure", str(log), "--levels", "20"])
    assert capsys.readouterr().err.startswith(f"warning: {log}: {WORDS} were touched")


def test_an_export_of_frames_holds_the_health_at_its_end(config: Path, tmp_path: Path) -> None:
    settings, layout = load_skin(config)
    log = write_log(tmp_path / "a.log", 140, always)
    found = calibrate_from_log(log, settings, layout, 5.0)
    (line,) = read_frames(log, settings, layout, found).health
    assert (line.part, line.state) == ("arm", "warning")
    assert line.text.startswith(f"arm: warning; {WORDS}: touched when calibrated")
    assert line.t_ns == 1_700_000_000 * 10**9 + 139 * 50_000_000 + 31 * 125_000


def zeroed_elsewhere(config: Path, folder: Path, units: float) -> Path:
    """A calibration file whose zero is so many units further from pressure than the recordings."""
    settings, layout = load_skin(config)
    log = write_log(folder / "before.log", 140, untouched)
    found = calibrate_from_log(log, settings, layout, 5.0)
    moved = replace(found, baseline=found.baseline - units, percentile=found.percentile - units)
    save_calibration(folder / "known.json", moved, layout)
    return folder / "known.json"


def warnings_of(
    config: Path, folder: Path, log: Path, options: Sequence[str], capsys: Any
) -> list[str]:
    command = ["replay", str(log), "--config", str(config), "--output", str(folder / "b.jsonl")]
    assert main([*command, *options]) == 0
    lines: list[str] = capsys.readouterr().err.splitlines()
    return lines


@pytest.mark.parametrize("units", [5.0, -5.0])
def test_a_recording_whose_pads_rest_elsewhere_than_by_the_zero_of_the_file_is_named(
    units: float, config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As of another day, after which the boards were zeroed: half of the skin was touched."""
    known = zeroed_elsewhere(config, tmp_path, units)
    log = write_log(tmp_path / "b.log", 140, untouched)
    (line,) = warnings_of(config, tmp_path, log, ["--calibration", str(known)], capsys)
    assert line.startswith(f"warning: {log}: by the zero of {known}, 192 of 192 taxels of arm")
    assert line.endswith("--calibrate-seconds 5 takes the recording's own")
    own = ["--calibration", str(known), "--calibrate-seconds", "5"]
    assert warnings_of(config, tmp_path, log, own, capsys) == []


def test_a_recording_with_the_zero_of_the_file_that_begins_with_a_grip_gives_no_warning(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = zeroed_elsewhere(config, tmp_path, 0.0)
    log = write_log(tmp_path / "b.log", 140, lambda period: range(40))
    assert warnings_of(config, tmp_path, log, ["--calibration", str(known)], capsys) == []
    short = write_log(tmp_path / "c.log", 3, untouched)
    assert warnings_of(config, tmp_path, short, ["--calibration", str(known)], capsys) == []


def test_a_zero_of_a_recording_that_begins_pressed_as_a_whole_is_named_by_that_of_the_file(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its readings alone do not show it: all pads are as steady as untouched ones."""
    known = zeroed_elsewhere(config, tmp_path, 0.0)
    log = write_log(tmp_path / "b.log", 140, lambda period: range(192))
    options = ["--calibration", str(known), "--calibrate-seconds", "5"]
    (line,) = warnings_of(config, tmp_path, log, options, capsys)
    assert line.startswith(f"warning: {log}: its first seconds, of which the zero is taken, are 60")


@pytest.mark.parametrize(("known", "named"), [(40, True), (120, False)])
def test_curves_of_a_skin_in_which_other_pads_work_are_named(
    known: int, named: bool, config: Path, tmp_path: Path
) -> None:
    settings, layout = load_skin(config)
    log = write_log(tmp_path / "a.log", 140, untouched)
    n = layout.n_taxels
    verdict = np.full(n, CurveVerdict.UNKNOWN, np.uint8)
    verdict[:known] = CurveVerdict.GOOD
    kpa = np.tile(8.0 * KNOTS_UNITS, (n, 1))
    curves = Curves(kpa, np.full(n, 40.0), np.zeros(n), np.zeros(n), verdict, 300.0, 0.0)
    found = with_curves(calibrate_from_log(log, settings, layout, 5.0), curves)
    lines = doubts(found, settings, layout)
    begins = "152 of 192 usable taxels of arm have no curve of their own"
    assert [line.startswith(begins) for line in lines] == [True] * named
    with_gain = replace(found, gain=np.full(n, 5.0))
    assert doubts(with_gain, settings, layout) == []
