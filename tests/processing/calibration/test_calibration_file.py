"""A calibration outlives its program: what a file keeps, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from skin_host.errors import CalibrationError
from skin_host.processing import calibration
from skin_host.processing.calibration import Verdict
from skin_host.processing.calibration.calibrator import Calibrator, Known
from skin_host.processing.calibration.file import (
    find_calibration,
    load_calibration,
    save_calibration,
)
from skin_host.processing.curves import KNOTS_UNITS, Curves, CurveVerdict, Memory, rising
from tests.support.calibrated import LAYOUT, TIME, N, calibrated, noisy


def test_a_file_brings_back_what_was_saved(untouched, tmp_path):
    path = tmp_path / "new" / "calibration.json"
    save_calibration(path, untouched, LAYOUT)
    found = load_calibration(path, LAYOUT, "abc")
    assert (found.id, found.time) == (untouched.id, TIME)
    assert found.baseline == pytest.approx(untouched.baseline, abs=1e-6)
    assert np.array_equal(found.verdict, untouched.verdict)
    assert json.loads(path.read_text())["schema"] == "skin.calibration/1"


def test_other_numbers_have_another_id(untouched):
    other = calibration.with_gains(untouched, np.full(N, 1.1), untouched.bend)
    assert other.id != untouched.id
    assert calibration.with_gains(untouched, untouched.gain, untouched.bend).id == untouched.id


def test_zeros_of_fingertips_are_kept_with_it_and_renewed_with_the_whole_skin(untouched, tmp_path):
    zeros = {"index": calibration.Zero(np.arange(6.0), np.full(6, 1e-3))}
    taken = calibration.with_zeros(untouched, zeros)
    assert taken.id != untouched.id
    path = tmp_path / "calibration.json"
    save_calibration(path, taken, LAYOUT)
    found = load_calibration(path, LAYOUT, "abc")
    assert found.zeros["index"].offset.tolist() == list(range(6))
    assert found.zeros["index"].noise.tolist() == [1e-3] * 6
    assert found.zeros["index"].full_scale is None
    of_board = calibration.Zero(np.ones(6), np.ones(6), full_scale=np.arange(1.0, 7.0))
    save_calibration(path, calibration.with_zeros(untouched, {"index": of_board}), LAYOUT)
    of_board = load_calibration(path, LAYOUT, "abc").zeros["index"]
    assert of_board.full_scale is not None
    assert of_board.full_scale.tolist() == [1, 2, 3, 4, 5, 6]
    for wrong in ("[1, 2]", "[1, 2, 3, 4, 5, 0]", "[1, 2, 3, 4, 5, 1e99]"):
        whole = json.loads(path.read_text())
        whole["fingertips"]["index"]["full_scale"] = json.loads(wrong)
        (tmp_path / "wrong.json").write_text(json.dumps(whole))
        with pytest.raises(CalibrationError, match=r"fingertips\.index: wanted 6 full scales"):
            load_calibration(tmp_path / "wrong.json", LAYOUT, "abc")
    save_calibration(path, taken, LAYOUT)
    newer = calibration.with_zeros(
        untouched, {"index": calibration.Zero(np.ones(6), np.full(6, 1e-3))}
    )
    every = np.ones(N, bool)
    assert calibration.merge(found, newer, every).zeros["index"].offset[0] == 1.0
    assert calibration.merge(found, newer, ~every, zeros=False).zeros["index"].offset[0] == 0.0
    # A board that was silent meanwhile keeps the zero that it had.
    assert calibration.merge(found, untouched, every).zeros["index"].offset[0] == 0.0
    text = path.read_text()
    at = text.index('"fingertips"')
    path.write_text(text[:at] + text[at:].replace('"noise": [', '"noise": [1,', 1))
    with pytest.raises(CalibrationError, match=r"fingertips\.index: wanted twice 6 finite numbers"):
        load_calibration(path, LAYOUT, "abc")


def test_pads_that_are_not_used_may_have_any_noise(untouched, tmp_path):
    path = tmp_path / "calibration.json"
    spread, verdict = untouched.spread.copy(), untouched.verdict.copy()
    spread[3], verdict[3] = 4000.0, Verdict.TOO_NOISY
    save_calibration(path, replace(untouched, spread=spread, verdict=verdict), LAYOUT)
    assert load_calibration(path, LAYOUT, "abc").spread[3] == 4000.0


@pytest.mark.parametrize("sweeps", [45, 5])
def test_what_is_kept_of_noise_near_the_end_of_the_scale_can_be_read_again(tmp_path, sweeps):
    """The file was refused at the next start: its percentiles were beyond a byte."""
    rng = np.random.default_rng(4)
    path = tmp_path / "calibration.json"
    before = calibrated(noisy(rng, sd=4.0, level=60.0))
    before = replace(before, percentile=before.baseline + 24.0)
    known = Known(before, np.full(N, 238.0), np.ones(N, bool))
    calibrator = Calibrator(LAYOUT)
    for raw in noisy(rng, sweeps, sd=0.3, level=4.0):
        calibrator.add(0, raw.astype(np.uint8), np.ones(N, bool))
    found = calibrator.finish("abc", TIME, known)
    assert found.usable.any()
    save_calibration(path, found, LAYOUT)
    assert load_calibration(path, LAYOUT, "abc").percentile.max() <= 255.0


def test_gains_outlive_a_new_zero(untouched, tmp_path):
    path = tmp_path / "calibration.json"
    assert find_calibration(path, LAYOUT, "abc") is None
    fitted = calibration.with_gains(untouched, np.full(N, 1.2), np.full(N, 0.9))
    save_calibration(path, fitted, LAYOUT)
    renewed = calibrated(noisy(np.random.default_rng(77)))
    kept = calibration.with_pressures_of(renewed, load_calibration(path, LAYOUT, "abc"))
    assert kept.gain == pytest.approx(np.full(N, 1.2))
    assert kept.bend == pytest.approx(np.full(N, 0.9))
    assert kept.baseline == pytest.approx(renewed.baseline)


def test_a_file_without_bends_is_understood(untouched, tmp_path):
    path = tmp_path / "calibration.json"
    save_calibration(path, untouched, LAYOUT)
    document = json.loads(path.read_text())
    del document["parts"]["skin"]["bend"]
    path.write_text(json.dumps(document))
    assert load_calibration(path, LAYOUT, "abc").bend == pytest.approx(np.ones(N))


def test_a_file_without_spreads_is_understood(untouched, tmp_path):
    path = tmp_path / "calibration.json"
    save_calibration(path, untouched, LAYOUT)
    document = json.loads(path.read_text())
    del document["parts"]["skin"]["spread"]
    path.write_text(json.dumps(document))
    found = load_calibration(path, LAYOUT, "abc")
    assert found.spread == pytest.approx(untouched.noise, abs=1e-6)


def damaged(document, path):
    path.write_text(json.dumps(document))
    return path


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda d: d.update(schema="skin.relaxation/1"), "schema"),
        (lambda d: d.update(configuration="xyz"), "belongs to configuration xyz"),
        (lambda d: d["parts"].clear(), 'no part "skin"'),
        (lambda d: d["parts"]["skin"]["baseline"].pop(), "parts.skin.baseline: wanted 192"),
        (lambda d: d["parts"]["skin"]["baseline"].pop(), "from -255 to 255, seen 191;"),
        (lambda d: d["parts"]["skin"]["gain"].__setitem__(3, -1.0), "parts.skin.gain"),
        (lambda d: d["parts"]["skin"]["gain"].__setitem__(3, -1.0), "to 100, seen -1 of taxel 3;"),
        (lambda d: d["parts"]["skin"]["verdict"].__setitem__(3, "fine"), "parts.skin.verdict"),
        (lambda d: d["parts"]["skin"]["verdict"].__setitem__(3, "o\nk"), "of taxel 3, wanted ok,"),
        (lambda d: d.pop("time"), "not a calibration file"),
        # With these a pad would be valid and feel nothing, or anything.
        (lambda d: d["parts"]["skin"]["baseline"].__setitem__(3, 300.0), "from -255 to 255"),
        (lambda d: d["parts"]["skin"]["baseline"].__setitem__(3, -1e300), "from -255 to 255"),
        (lambda d: d["parts"]["skin"]["noise"].__setitem__(3, -1.0), "from 0 to 255"),
        (lambda d: d["parts"]["skin"]["spread"].__setitem__(3, 300.0), "taxel 3 has so much noise"),
        (lambda d: d["parts"]["skin"]["gain"].__setitem__(3, 1e12), "from 0.01 to 100"),
        (lambda d: d["parts"]["skin"]["bend"].__setitem__(3, 1e-300), "from 0.01 to 100"),
        (lambda d: d["parts"]["skin"].update(verdict=["ok"]), "verdict: wanted 192 words"),
        (lambda d: d.update(id="x\nERROR forged"), "not a calibration file"),
        (lambda d: d.update(time="x" * 100_000), "not a calibration file"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_in_one_line_with_the_remedy(
    untouched, tmp_path, damage, message
):
    path = tmp_path / "calibration.json"
    save_calibration(path, untouched, LAYOUT)
    document = json.loads(path.read_text())
    damage(document)
    damaged(document, path)
    with pytest.raises(CalibrationError) as caught:
        load_calibration(path, LAYOUT, "abc")
    text = str(caught.value)
    assert message in text
    assert str(path) in text
    assert "skin calibrate CONFIG" in text
    assert "\n" not in text


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"[1, 2]", b'{"schema": 3}'])
def test_what_is_no_calibration_is_refused(tmp_path, content):
    path = tmp_path / "calibration.json"
    path.write_bytes(content)
    with pytest.raises(CalibrationError, match="skin calibrate"):
        load_calibration(path, LAYOUT, "abc")


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(CalibrationError, match="cannot be read"):
        load_calibration(tmp_path / "none.json", LAYOUT, "abc")


def own_curves(good=slice(None), noise=0.8):
    kpa = np.tile(8.0 * KNOTS_UNITS, (N, 1)) + np.arange(N)[:, np.newaxis] * KNOTS_UNITS * 0.1
    verdict = np.full(N, CurveVerdict.JUMPS, np.uint8)
    verdict[good] = CurveVerdict.GOOD
    return Curves(
        rising(kpa),
        np.full(N, 42.0),
        np.full(N, noise),
        np.where(verdict == CurveVerdict.GOOD, 4.2, np.nan),
        verdict,
        340.0,
        -0.3,
        Memory((20.0,), (0.25,)),
    )


def test_curves_are_kept_with_it_and_outlive_new_zeros(untouched, tmp_path):
    fitted = calibration.with_curves(untouched, own_curves(slice(0, 7)))
    assert fitted.id != untouched.id
    assert np.array_equal(np.flatnonzero(fitted.usable), range(7))
    path = tmp_path / "calibration.json"
    save_calibration(path, fitted, LAYOUT)
    kept = load_calibration(path, LAYOUT, "abc")
    renewed = calibrated(noisy(np.random.default_rng(77)))
    every = np.ones(N, bool)
    for found in (kept, calibration.with_pressures_of(renewed, kept)):
        assert found.curves.kpa[:7] == pytest.approx(fitted.curves.kpa[:7], abs=1e-5)
        assert np.array_equal(found.curves.verdict, fitted.curves.verdict)
        assert found.curves.memory == fitted.curves.memory
        assert found.curves.lag_s == -0.3
    assert calibration.merge(fitted, untouched, every).curves is fitted.curves
    assert load_calibration(path, LAYOUT, "abc").id == fitted.id


def test_a_lively_pad_that_sends_one_byte_all_the_time_is_stuck():
    constant = calibrated(np.full((125, N), 240))
    found = calibration.with_curves(constant, own_curves(noise=1.0))
    assert (found.verdict == Verdict.STUCK).all()
    quiet = calibration.with_curves(constant, own_curves(noise=0.3))
    assert (quiet.verdict == Verdict.OK).all()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"jumps"', '"leaps"', "verdict"),
        ('"weight": [', '"weight": [1.0,', "radii"),
        ('"highest_kpa": 340.0', '"highest_kpa": -1.0', "curves"),
        ('"kpa": [\n', '"kpa": [[1.0],\n', "entries"),
        ('"noise_units": [\n', '"noise_units": [1e999,\n', "calibration"),
    ],
)
def test_damaged_curves_are_refused(untouched, tmp_path, old, new, message):
    path = tmp_path / "calibration.json"
    save_calibration(path, calibration.with_curves(untouched, own_curves(slice(0, 7))), LAYOUT)
    text = path.read_text()
    at = text.index('"curves"')
    assert old in text[at:]
    path.write_text(text[:at] + text[at:].replace(old, new, 1))
    with pytest.raises(CalibrationError, match=message):
        load_calibration(path, LAYOUT, "abc")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda c: c["parts"]["skin"]["kpa"].__setitem__(3, [0.0] * len(KNOTS_UNITS)), "taxel 3"),
        (
            lambda c: c["parts"]["skin"]["kpa"].__setitem__(
                5, np.linspace(0.0, 2.0, len(KNOTS_UNITS)).tolist()
            ),
            "taxel 5",
        ),
        (lambda c: c["parts"]["skin"]["beyond_units"].__setitem__(7, 1e-3), "taxel 7"),
        (lambda c: c.update(radius_kpa=[1.0, 5.0], weight=[0.9, 0.9]), "sum to 1.8"),
        (lambda c: c.update(radius_kpa=[1.0], weight=[1.0]), "sum to 1;"),
    ],
)
def test_curves_with_which_a_good_pad_would_feel_nothing_are_refused(
    untouched, tmp_path, damage, message
):
    path = tmp_path / "calibration.json"
    save_calibration(path, calibration.with_curves(untouched, own_curves()), LAYOUT)
    document = json.loads(path.read_text())
    damage(document["curves"])
    damaged(document, path)
    with pytest.raises(CalibrationError, match=message) as caught:
        load_calibration(path, LAYOUT, "abc")
    assert "skin calibrate CONFIG" in str(caught.value)
