import json

import numpy as np
import pytest

from skin_host.errors import CalibrationError
from skin_host.evaluation.rig import flat_skin
from skin_host.processing import calibration
from skin_host.processing.calibration import Calibrator, Verdict

_, LAYOUT = flat_skin(1)
N = LAYOUT.n_taxels
PRESENT = np.ones(N, bool)
TIME = "2026-01-02T03:04:05+00:00"


def calibrated(sweeps, present=None, percentile=0.95):
    calibrator = Calibrator(LAYOUT, percentile)
    for number, raw in enumerate(sweeps):
        here = PRESENT if present is None else present[number]
        calibrator.add(0, np.asarray(raw, np.uint8), here)
    return calibrator.finish("abc", TIME)


def noisy(rng, sweeps=125, sd=0.4, level=240.3):
    return np.rint(level + rng.normal(0.0, sd, (sweeps, N)))


@pytest.fixture
def untouched():
    return calibrated(noisy(np.random.default_rng(0)))


def test_baseline_is_the_mean_and_noise_the_deviation():
    sweeps = noisy(np.random.default_rng(1))
    found = calibrated(sweeps)
    assert found.baseline == pytest.approx(LAYOUT.no_load - sweeps.mean(axis=0))
    assert found.noise == pytest.approx(sweeps.std(axis=0))


def test_the_percentile_is_the_inverted_distribution_of_activations():
    sweeps = noisy(np.random.default_rng(2), sweeps=73, sd=2.0)
    expected = np.quantile(LAYOUT.no_load - sweeps, 0.95, axis=0, method="inverted_cdf")
    assert calibrated(sweeps).percentile == pytest.approx(expected)
    assert calibrated(sweeps, percentile=1.0).percentile == pytest.approx(
        (LAYOUT.no_load - sweeps).max(axis=0)
    )


def test_an_untouched_skin_is_ok(untouched):
    assert np.all(untouched.verdict == Verdict.OK)
    assert untouched.usable.all()


def test_a_quiet_taxel_that_repeats_one_code_is_ok():
    assert np.all(calibrated(np.full((125, N), 240)).verdict == Verdict.OK)


def test_a_noisy_taxel_is_named_and_used():
    sweeps = noisy(np.random.default_rng(3))
    sweeps[:, 5] += np.rint(np.random.default_rng(4).normal(0.0, 3.0, 125))
    found = calibrated(sweeps)
    assert found.verdict[5] == Verdict.NOISY
    assert found.usable[5]


@pytest.mark.parametrize("sd", [3.0, 5.0, 8.0])
def test_noise_of_any_size_is_no_touch(sd):
    sweeps = np.rint(200.0 + np.random.default_rng(11).normal(0.0, sd, (100, N)))
    found = calibrated(sweeps)
    assert np.mean(found.verdict == Verdict.NOISY) > 0.99
    assert np.median(found.noise) == pytest.approx(sd, rel=0.05)


@pytest.mark.parametrize(("first", "last"), [(0, 60), (60, 125), (40, 80)])
def test_a_touch_during_calibration_is_named_and_left_out_of_the_baseline(first, last):
    sweeps = noisy(np.random.default_rng(5))
    untouched = 240.0 - sweeps[:, 7].mean()
    sweeps[first:last, 7] -= 30
    found = calibrated(sweeps)
    assert found.verdict[7] == Verdict.TOUCHED
    assert np.count_nonzero(found.verdict) == 1
    assert found.baseline[7] == pytest.approx(untouched, abs=0.6)
    assert found.percentile[7] < untouched + 3.0


@pytest.mark.parametrize("code", [0, 255])
def test_a_taxel_at_an_end_of_the_scale_is_stuck(code):
    sweeps = noisy(np.random.default_rng(6))
    sweeps[:, 9] = code
    found = calibrated(sweeps)
    assert found.verdict[9] == Verdict.STUCK
    assert not found.usable[9]


def test_a_taxel_that_is_often_at_an_end_of_the_scale_is_out_of_range():
    sweeps = noisy(np.random.default_rng(7))
    sweeps[::5, 9] = 255
    assert calibrated(sweeps).verdict[9] == Verdict.OUT_OF_RANGE


def test_what_was_never_received_is_absent():
    present = np.ones((125, N), bool)
    present[:, 24:36] = False
    found = calibrated(noisy(np.random.default_rng(8)), present)
    assert np.all(found.verdict[24:36] == Verdict.ABSENT)
    assert np.count_nonzero(found.verdict) == 12
    assert calibration.summary(found, LAYOUT) == {"skin": {"ok": N - 12, "absent": 12}}


@pytest.mark.parametrize("samples", [1, 9])
def test_what_was_hardly_ever_received_is_not_judged_by_that(samples):
    found = calibrated(np.full((samples, N), 240))
    assert np.all(found.verdict == Verdict.TOO_FEW)
    assert not found.usable.any()


def test_lost_sweeps_do_not_shift_the_baseline():
    sweeps = noisy(np.random.default_rng(9))
    present = np.random.default_rng(10).uniform(size=(125, N)) > 0.3
    raw = np.where(present, sweeps, 0)
    expected = np.array([240.0 - sweeps[present[:, i], i].mean() for i in range(N)])
    assert calibrated(raw, present).baseline == pytest.approx(expected)


def test_a_file_brings_back_what_was_saved(untouched, tmp_path):
    path = tmp_path / "new" / "calibration.json"
    calibration.save(path, untouched, LAYOUT)
    found = calibration.load(path, LAYOUT, "abc")
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
    calibration.save(path, taken, LAYOUT)
    found = calibration.load(path, LAYOUT, "abc")
    assert found.zeros["index"].offset.tolist() == list(range(6))
    assert found.zeros["index"].noise.tolist() == [1e-3] * 6
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
        calibration.load(path, LAYOUT, "abc")


def test_gains_outlive_a_new_zero(untouched, tmp_path):
    path = tmp_path / "calibration.json"
    assert calibration.with_gains_of(untouched, path, LAYOUT) is untouched
    fitted = calibration.with_gains(untouched, np.full(N, 1.2), np.full(N, 0.9))
    calibration.save(path, fitted, LAYOUT)
    renewed = calibrated(noisy(np.random.default_rng(77)))
    kept = calibration.with_gains_of(renewed, path, LAYOUT)
    assert kept.gain == pytest.approx(np.full(N, 1.2))
    assert kept.bend == pytest.approx(np.full(N, 0.9))
    assert kept.baseline == pytest.approx(renewed.baseline)


def test_a_file_without_bends_is_understood(untouched, tmp_path):
    path = tmp_path / "calibration.json"
    calibration.save(path, untouched, LAYOUT)
    document = json.loads(path.read_text())
    del document["parts"]["skin"]["bend"]
    path.write_text(json.dumps(document))
    assert calibration.load(path, LAYOUT, "abc").bend == pytest.approx(np.ones(N))


def damaged(document, path):
    path.write_text(json.dumps(document))
    return path


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda d: d.update(schema="skin.calibration/9"), "schema"),
        (lambda d: d.update(configuration="xyz"), "belongs to configuration xyz"),
        (lambda d: d["parts"].clear(), 'no part "skin"'),
        (lambda d: d["parts"]["skin"]["baseline"].pop(), "parts.skin.baseline: wanted 192"),
        (lambda d: d["parts"]["skin"]["gain"].__setitem__(3, -1.0), "parts.skin.gain"),
        (lambda d: d["parts"]["skin"]["verdict"].__setitem__(3, "fine"), "parts.skin.verdict"),
        (lambda d: d.pop("time"), "not a calibration file"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_in_one_line_with_the_remedy(
    untouched, tmp_path, damage, message
):
    path = tmp_path / "calibration.json"
    calibration.save(path, untouched, LAYOUT)
    document = json.loads(path.read_text())
    damage(document)
    damaged(document, path)
    with pytest.raises(CalibrationError) as caught:
        calibration.load(path, LAYOUT, "abc")
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
        calibration.load(path, LAYOUT, "abc")


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(CalibrationError, match="cannot be read"):
        calibration.load(tmp_path / "none.json", LAYOUT, "abc")
