"""Recordings of real skin: read as they are, measured as defined, said to be absent."""

import json
import os
import pty
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.cli import main
from skin_host.errors import LogError, RequestError
from skin_host.evaluation import insole, page, real, tables
from skin_host.evaluation.insole import PADS, InsoleRecording
from skin_host.evaluation.real import PlayedCourse
from skin_host.processing.core import Engine

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
TOOL = ROOT.parent / "shared" / "tools" / "insole_log"
PERIOD_NS = 20_400_000


def recording(pressure_kpa: np.ndarray, kpa_per_unit: float = 8.0) -> InsoleRecording:
    """Pads that read a unit for every so many kPa, with noise, under a course of pressure."""
    rng = np.random.default_rng(1)
    t = len(pressure_kpa)
    rest = rng.uniform(180.0, 220.0, PADS)
    activation = pressure_kpa[:, np.newaxis] / kpa_per_unit
    counts = np.rint(rest - activation + rng.normal(0.0, 0.6, (t, PADS))).astype(np.uint8)
    t_ns = insole.START_NS + np.arange(t, dtype=np.int64) * PERIOD_NS
    return InsoleRecording("left_made_up", t_ns, counts, pressure_kpa)


def ramp(seconds: float = 30.0, high_kpa: float = 300.0) -> np.ndarray:
    """Ten seconds of rest, up to a pressure, and down again."""
    t_s = np.arange(0.0, seconds, PERIOD_NS * 1e-9)
    return np.interp(t_s, [0.0, 12.0, 20.0, 28.0], [5.0, 5.0, high_kpa, 5.0])


def course(
    made: InsoleRecording, pressure_kpa: np.ndarray, touched: np.ndarray | None = None
) -> PlayedCourse:
    t = len(made.t_ns)
    return PlayedCourse(
        made.t_ns,
        np.arange(t),
        np.broadcast_to(pressure_kpa[:, np.newaxis], (t, PADS)).astype(np.float32),
        np.zeros((t, PADS), np.bool_) if touched is None else touched,
        np.ones((t, PADS), np.bool_),
        np.zeros(0, np.int64),
    )


def write(folder: Path, made: InsoleRecording) -> Path:
    path = folder / f"{made.name}.npz"
    t_s = (made.t_ns - insole.START_NS) * 1e-9
    np.savez(path, t_s=t_s, counts=made.counts, pressure_kpa=made.pressure_kpa)
    return path


#: A load from 8 to 13 s, which goes at once, and half a minute after it.
UNLOADED = recording(
    np.where(np.abs(np.arange(0.0, 43.0, PERIOD_NS * 1e-9) - 10.5) < 2.5, 105, 5.0)
)
UNUSED = np.zeros(PADS, np.bool_)


def document_of(row: real.Row) -> real.Row:
    return {"real": [row], "published": [], "grasps": None, "emulated": [], "absent": None}


@pytest.fixture(scope="module")
def pressed() -> InsoleRecording:
    return recording(ramp())


@pytest.fixture(scope="module")
def replayed(pressed: InsoleRecording) -> PlayedCourse:
    settings, layout = insole.skin()
    calibration = real.calibrate(pressed, settings, layout)
    return real.play(pressed, settings, layout, calibration)


@pytest.mark.skipif(not TOOL.exists(), reason=f"{TOOL} is not here")
def test_the_skin_and_its_frames_are_those_of_the_tool_that_writes_logs(
    pressed: InsoleRecording, tmp_path: Path
) -> None:
    from importlib.machinery import SourceFileLoader
    from importlib.util import module_from_spec, spec_from_loader

    from skin_host.config.settings import load, skin_hash

    spec = spec_from_loader("insole_log", SourceFileLoader("insole_log", str(TOOL)))
    assert spec is not None
    tool = module_from_spec(spec)
    assert spec.loader is not None
    spec.loader.exec_module(tool)
    (tmp_path / "insole.toml").write_text(tool.configuration())
    settings, layout = insole.skin()
    assert skin_hash(load(tmp_path / "insole.toml")) == skin_hash(settings)
    assert tuple(tool.PADS) == insole.PRESSURE_PADS
    assert len(insole.pads(layout)) == PADS


def test_every_recorded_byte_passes_through_the_engine(
    pressed: InsoleRecording, replayed: PlayedCourse
) -> None:
    assert sorted(set(replayed.sweep.tolist())) == list(range(len(pressed.counts)))
    settings, layout = insole.skin()
    engine = real.Engine(settings, layout, [0], real.calibrate(pressed, settings, layout))
    first = {0: 0, 1: 16}
    sweeps: dict[int, list[np.ndarray]] = {board: [] for board in first}
    for batch in pressed.batches():
        for sweep in engine.feed(insole.BUS, batch).sweeps:
            sweeps[sweep.board].append(sweep.raw)
    recorded = pressed.counts.reshape(-1, 28, 10)
    for board, triangles in zip(first, insole.TRIANGLES_OF.values(), strict=True):
        raw = np.array(sweeps[board])[:, :triangles][:, :, insole.PRESSURE_PADS]
        wanted = recorded[:, first[board] : first[board] + triangles]
        np.testing.assert_array_equal(raw, wanted)


def test_quiet_pads_are_detected_and_touch_nothing_before(
    pressed: InsoleRecording, replayed: PlayedCourse
) -> None:
    live = real.live_pads(pressed)
    assert live.all()
    row = real.touches(pressed, replayed, live, live)
    assert row["touches_begun_10s"] == row["false_begins_per_s"] == 0
    assert row["detected_60kpa"] == row["detected_40kpa"] == 1.0
    assert 1.0 <= row["begins_per_pad"] < 1.5


def test_a_spike_of_the_pressures_own_record_is_no_press(pressed: InsoleRecording) -> None:
    pressure = pressed.pressure_kpa.copy()
    pressure[100::200] += 70.0
    spiky = InsoleRecording(pressed.name, pressed.t_ns, pressed.counts, pressure)
    late = pressed.t_ns - pressed.t_ns[0] > 15e9
    touched = np.broadcast_to(late[:, np.newaxis], (len(late), PADS)).copy()
    everyone = np.ones(PADS, np.bool_)
    # 60 kPa over rest are passed at 13.6 s, 100 kPa at 14.7 s.
    for level, found in ((60.0, 0.0), (100.0, 1.0)):
        given = course(spiky, pressure, touched)
        assert real.detected(spiky, given, everyone, level) == found


def test_dead_and_still_pads_are_not_live() -> None:
    made = recording(ramp())
    made.counts[:, 0] = 240
    made.counts[5, 1] = 3
    assert np.flatnonzero(~real.live_pads(made)).tolist() == [0, 1]


def test_right_pressures_have_no_error_and_late_ones_the_lag_that_was_put_in() -> None:
    made = recording(ramp())
    everyone = np.ones(PADS, np.bool_)
    row = real.pressure_errors(made, course(made, made.pressure_kpa), everyone, None)
    assert row["median_rmse_kpa"] < 1e-4
    assert row["lag_s"] == 0.0
    late = np.concatenate([np.full(25, 5.0), made.pressure_kpa[:-25]])
    row = real.pressure_errors(made, course(made, late), everyone, None)
    assert row["median_rmse_kpa"] == pytest.approx(
        float(np.sqrt(np.mean((late - made.pressure_kpa) ** 2))), rel=1e-4
    )
    assert row["lag_s"] == pytest.approx(25 * PERIOD_NS * 1e-9)
    assert row["lagged_median_rmse_kpa"] < 1e-4


@pytest.mark.parametrize("rate", [-0.015, 0.007])
def test_the_rate_of_the_pressures_clock_is_found_beside_its_lag(rate: float) -> None:
    made = recording(ramp())
    everyone = np.ones(PADS, np.bool_)
    middle = (len(made.t_ns) - 1) / 2
    at = middle + (1.0 + rate) * (np.arange(len(made.t_ns)) - middle) - 25
    reported = np.interp(at, np.arange(len(made.t_ns)), made.pressure_kpa)
    row = real.pressure_errors(made, course(made, reported), everyone, None)
    assert row["rate"] == pytest.approx(rate, abs=1.5e-3)
    assert row["lagged_skin_rms_kpa"] > 3.0 * row["rated_skin_rms_kpa"]


def test_a_pad_is_judged_by_the_frames_in_which_it_is_valid() -> None:
    made = recording(ramp())
    given = course(made, made.pressure_kpa)
    given.pressure_kpa[:100, 7] = 0.0
    given.valid[:100, 7] = False
    row = real.pressure_errors(made, given, np.arange(PADS) == 7, None)
    assert row["median_rmse_kpa"] < 1e-4
    assert row["valid_share"] == pytest.approx(1.0 - 100 / len(made.t_ns))


def test_what_follows_a_silence_is_judged_as_skin_replay_judges_it(
    pressed: InsoleRecording,
) -> None:
    """After a silence a board may have another zero: it is not valid before it is compared."""
    kept = np.delete(np.arange(len(pressed.t_ns)), np.s_[600:700])
    with_gap = InsoleRecording(
        pressed.name, pressed.t_ns[kept], pressed.counts[kept], pressed.pressure_kpa[kept]
    )
    settings, layout = insole.skin()
    calibration = real.calibrate(with_gap, settings, layout)
    played = real.play(with_gap, settings, layout, calibration)
    last, first, later = np.searchsorted(played.t_ns, with_gap.t_ns[[598, 600, 700]])
    assert played.valid[last].all()
    assert not played.valid[first + 1].any()
    assert played.valid[later].all()


@given(
    late_s=st.floats(0.0, 8.0),
    stay=st.sets(st.integers(0, PADS - 1), max_size=20),
    excess_kpa=st.floats(-4.0, 4.0),
)
def test_pads_count_as_touched_afterwards_that_still_are_ten_seconds_after_the_load(
    late_s: float, stay: set[int], excess_kpa: float
) -> None:
    """What remains of the load within the skin's resolution is none."""
    made = UNLOADED
    pressure = made.pressure_kpa + np.where(made.t_ns - made.t_ns[0] > 13e9, excess_kpa, 0.0)
    made = replace(made, pressure_kpa=pressure)
    after_s = (made.t_ns - made.t_ns[0]) * 1e-9 - 13.0
    touched = np.broadcast_to((after_s < late_s)[:, np.newaxis], (len(after_s), PADS)).copy()
    touched[:, list(stay)] = True
    usable = np.arange(PADS) >= 5
    found = real.touched_afterwards(made, course(made, pressure, touched), usable)
    assert found == len([pad for pad in stay if pad >= 5])


def test_a_recording_that_ends_before_shows_nothing_of_what_is_touched_afterwards() -> None:
    made = UNLOADED
    everyone = np.ones(PADS, np.bool_)
    ends = np.searchsorted(made.t_ns, made.t_ns[0] + 22_000_000_000)
    short = InsoleRecording(
        made.name, made.t_ns[:ends], made.counts[:ends], made.pressure_kpa[:ends]
    )
    assert real.touched_afterwards(short, course(short, short.pressure_kpa), everyone) is None
    never = replace(made, pressure_kpa=np.full_like(made.pressure_kpa, 5.0))
    assert real.touched_afterwards(never, course(never, never.pressure_kpa), everyone) is None


def test_the_worst_pad_and_readings_that_are_far_off_are_named_however_few_they_are() -> None:
    made = UNLOADED
    given = course(made, made.pressure_kpa)
    t, wrong = len(made.t_ns), slice(100, 200)
    given.pressure_kpa[wrong, 7] += 80.0
    given.pressure_kpa[wrong, 8] += 59.0
    given.pressure_kpa[wrong, 9] += 500.0
    given.valid[wrong, 9] = False
    row = real.pressure_errors(made, given, np.ones(PADS, np.bool_), None)
    assert row["worst_rmse_kpa"] == pytest.approx(80.0 * np.sqrt(100 / t), rel=1e-4)
    assert row["far_share"] == pytest.approx(100 / (t * PADS - 100))
    assert row["p95_rmse_kpa"] < 1e-4
    row["calibrated_far_share"] = None
    names, (shown,) = tables.real({"real": [real.touches(made, given, UNUSED, UNUSED) | row]})
    assert len(names) == len(shown)
    assert shown[names.index("worst pad kPa")] == f"{row['worst_rmse_kpa']:.1f}"
    assert shown[names.index("off by 60 kPa")] == f"{row['far_share']:.2%}"


def test_pads_that_are_valid_seldom_and_wrong_then_are_not_hidden(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are not usable, so the errors of usable pads say nothing of them."""
    path = write(tmp_path, replace(recording(ramp()), name="left_calibration"))
    play = real.play

    def seldom(*given: object) -> PlayedCourse:
        played = play(*given)  # type: ignore[arg-type]
        played.valid[:] = True
        played.valid[: int(0.9 * len(played.valid)), 7] = False
        played.pressure_kpa[:, 7] += 500.0
        return played

    monkeypatch.setattr(real, "play", seldom)
    row = real.measure(path, real.fit_pressures(path))
    assert row["far_share"] < 1e-3
    sweeps = len(ramp())
    wrong = round(0.1 * sweeps) / ((PADS - 1 + 0.1) * sweeps)
    assert row["calibrated_far_share"] - row["far_share"] == pytest.approx(wrong, rel=0.1)
    names, (shown,) = tables.real({"real": [row]})
    assert len(names) == len(shown)
    place = names.index("off by 60 kPa, all calibrated")
    assert shown[place] == f"{row['calibrated_far_share']:.2%}"
    assert "`all calibrated`" in " ".join(page.real_skin(document_of(row)).text)


def test_the_share_that_is_far_off_is_of_valid_readings_that_have_a_true_pressure() -> None:
    made = UNLOADED
    made = replace(made, pressure_kpa=made.pressure_kpa[:-100])
    t, sweeps = len(made.t_ns), len(made.pressure_kpa)
    given = course(made, np.append(made.pressure_kpa, np.full(100, 900.0)))
    given.pressure_kpa[:10, 3] += 61.0
    given.pressure_kpa[:10, 4] -= 61.0
    given.pressure_kpa[:10, 5] += 59.0
    given.valid[:5, 3] = False
    assert t == sweeps + 100
    four = np.isin(np.arange(PADS), [3, 4, 5, 6])
    assert real.far_share(made, given, four) == pytest.approx(15 / (4 * sweeps - 5))
    given.valid[:] = False
    assert real.far_share(made, given, four) is None


def test_one_json_document_has_a_row_for_each_recording(
    pressed: InsoleRecording,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(real, "RECORDINGS", tmp_path / "nowhere")
    write(tmp_path, pressed)
    options = ["--real", "--recordings", str(tmp_path), "--json", "--output", str(tmp_path / "o")]
    assert main(["report", *options]) == 0
    (row,) = json.loads(capsys.readouterr().out)["real"]
    assert row["recording"] == "left_made_up"
    assert row["pads_live"] == row["pads_usable"] == PADS
    assert row["touches_begun_10s"] == 0
    assert row["median_rmse_kpa"] is None
    assert row["calibrated_far_share"] is None
    assert row["why_no_pressure"] == "left_calibration.npz is missing"
    assert "left_made_up" in (tmp_path / "o" / "real.md").read_text()
    assert "left_made_up" in (tmp_path / "o" / "real.html").read_text()


def test_a_terminal_shows_what_is_done(pressed: InsoleRecording, tmp_path: Path) -> None:
    write(tmp_path, pressed)
    program = [sys.executable, "-m", "skin_host", "report", "--real", "--recordings", tmp_path]
    terminal, end = pty.openpty()
    ran = subprocess.run(program, check=True, stdout=subprocess.PIPE, stderr=end)
    os.close(end)
    assert b"left_made_up" in ran.stdout
    shown = os.read(terminal, 4096).decode().split("\r\x1b[K")
    assert [step for step in shown if step.startswith("real skin: 1 of ")]
    assert shown[-1] == ""  # removed
    os.close(terminal)


def test_a_recording_is_measured_with_the_curves_that_its_foams_calibration_gave(
    tmp_path: Path,
) -> None:
    path = write(tmp_path, replace(recording(ramp()), name="left_calibration"))
    row = real.measure(path, real.fit_pressures(path))
    assert row["pads_usable"] > 0.9 * PADS
    assert row["why_no_pressure"] is None
    assert row["median_rmse_kpa"] < 12.0
    assert row["valid_share"] > 0.9


def test_recordings_that_are_not_there_are_said_to_be_absent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(real, "RECORDINGS", tmp_path / "nowhere")
    for options in ([], ["--json"]):
        assert main(["report", "--real", *options]) == 2
        told = capsys.readouterr()
        assert told.out == ""
        (line,) = told.err.splitlines()
        assert "no recordings of real skin here; --recordings names a folder" in line
    # The whole report has more to say, and names them as absent.
    document = real.run(quick=False, output=None, may_be_absent=True)
    assert document["real"] == []
    assert "absent" in page.real_skin(document).text[0]
    assert main(["report", "--real", "--recordings", str(tmp_path)]) == 2
    assert "no recording in it" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arrays",
    [
        {"counts": np.zeros((5, 280))},
        {"counts": np.zeros((5, 279), np.uint8)},
        {"counts": np.zeros((4, 280), np.uint8)},
        {"t_s": np.array([0.0, 1.0, 1.0, 2.0, 8.0])},
        {"t_s": np.array([0.0, 1.0, np.nan, 2.0, 8.0])},
        {"t_s": np.arange(5.0)},
        {"t_s": np.arange(5.0) * 1e-9},
        {"t_s": np.array([0.0, 1e-9, 1.0, 2.0, 8.0])},
        {"t_s": np.array(["0", "1", "2", "3", "8"])},
        {"t_s": np.arange(5.0) * (2.0 + 0.0j)},
        {"t_s": np.zeros(1), "counts": np.zeros((1, 280), np.uint8)},
        {"pressure_kpa": np.array([])},
        {"pressure_kpa": np.array([1.0, np.inf])},
        {"pressure_kpa": np.array(["a"], dtype=object)},
    ],
)
def test_what_is_no_recording_is_refused_in_one_line(
    arrays: dict[str, np.ndarray], tmp_path: Path
) -> None:
    whole = {
        "t_s": 2.0 * np.arange(5.0),
        "counts": np.zeros((5, 280), np.uint8),
        "pressure_kpa": np.zeros(5),
    }
    np.savez(tmp_path / "good.npz", **whole)
    assert len(insole.read(tmp_path / "good.npz").t_ns) == 5
    np.savez(tmp_path / "bad.npz", **(whole | arrays))
    with pytest.raises(LogError, match=r"bad\.npz: ") as error:
        insole.read(tmp_path / "bad.npz")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("samples", [800, 1400])
def test_a_gap_of_days_is_refused_before_the_memory_for_its_sweeps_is_needed(
    tmp_path: Path, samples: int
) -> None:
    """Also where the pressure ends before it."""
    made = recording(ramp())
    t_s = (made.t_ns - made.t_ns[0]) * 1e-9
    np.savez(
        tmp_path / "left_calibration.npz",
        t_s=np.where(np.arange(len(t_s)) < 1000, t_s, t_s + 9e5),
        counts=made.counts,
        pressure_kpa=made.pressure_kpa[:samples],
    )
    with pytest.raises(RequestError, match=r"a gap of 900000\.0 s after|covers 16 s of the"):
        real.fit_pressures(tmp_path / "left_calibration.npz")


def test_pads_that_are_valid_only_after_the_pressures_record_have_no_errors() -> None:
    made = recording(ramp())
    short = replace(made, pressure_kpa=made.pressure_kpa[:100])
    played = course(made, made.pressure_kpa)
    played.valid[:200] = False
    row = real.pressure_errors(short, played, np.ones(PADS, np.bool_), None)
    assert row["median_rmse_kpa"] is row["zero_kpa"] is None


@pytest.mark.parametrize("content", [b"not an archive", b"", None], ids=["text", "none", "npy"])
def test_bytes_that_are_no_archive_are_refused(content: bytes | None, tmp_path: Path) -> None:
    """A single array was a traceback, and other bytes came with the advice to run them."""
    path = tmp_path / "bad.npz"
    if content is None:
        np.save(tmp_path / "one.npy", np.zeros(3))
        (tmp_path / "one.npy").rename(path)
    else:
        path.write_bytes(content)
    with pytest.raises(LogError, match="no archive of arrays; wanted arrays"):
        insole.read(path)


#: Errors of pressure that are larger than wanted; docs/accuracy.md shows what stands in the way.
MISSED = {
    "left_steps: RMSE, median pad, kPa",
    "left_validation_1: RMS of the mean over pads, kPa",
}


@pytest.mark.skipif(not real.RECORDINGS.exists(), reason=f"no recordings in {real.RECORDINGS}")
def test_on_recorded_skin_everything_else_is_as_good_as_wanted() -> None:
    """Presses are detected, nothing else is, and no press ends and begins again."""
    goals = real.goals(real.run(quick=False, output=None))
    assert len(goals) > 20
    assert {goal["figure"] for goal in goals if not goal["reached"]} <= MISSED


@pytest.mark.skipif(not real.RECORDINGS.exists(), reason=f"no recordings in {real.RECORDINGS}")
def test_what_real_pads_do_under_pressure_is_no_damage_of_their_bus() -> None:
    """Two minutes in which pads of noisy triangles jumped for one sweep 33 times."""
    found = insole.read(real.RECORDINGS / "left_validation_1.npz")
    made = replace(found, t_ns=found.t_ns[:6200], counts=found.counts[:6200])
    settings, layout = insole.skin()
    engine = Engine(settings, layout, [0], real.calibrate(made, settings, layout))
    for batch in made.batches():
        engine.feed(insole.BUS, batch)
    engine.intake.judge()
    assert engine.intake.liveness.spikes.sum() == 0
