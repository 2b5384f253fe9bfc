"""Recordings as arrays, tables and pictures."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skin_host.config.settings import load
from skin_host.errors import RequestError
from skin_host.layout import build_layout
from skin_host.mqtt.frames import encode_frame
from skin_host.processing.calibration import with_curves
from skin_host.processing.curves import KNOTS_UNITS, Curves, Memory, rising
from skin_host.processing.frame import PressureFrame
from skin_host.recording import plots
from skin_host.recording.export import Series, export, read_frames, read_messages
from skin_host.recording.mcap import Recorder
from skin_host.recording.replay import calibrate_from_log

ROOT = Path(__file__).parents[2]
CONFIG = ROOT / "config" / "icub_hand.toml"
GRASP = ROOT.parent / "shared" / "data" / "icub_grasp.log"
pytestmark = pytest.mark.skipif(not GRASP.exists(), reason=f"{GRASP} is not here")


@pytest.fixture(scope="module")
def hand() -> Any:
    settings = load(CONFIG)
    return settings, build_layout(settings, CONFIG.parent)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("grasp") / "grasp.log"
    path.write_text("".join(GRASP.read_text().splitlines(keepends=True)[:2600]))
    return path


@pytest.fixture(scope="module")
def series(hand: Any, log: Path) -> Series:
    return read_frames(log, *hand, calibrate_from_log(log, *hand, 5.0))


def test_every_sweep_of_a_recording_is_there(series: Series, hand: Any) -> None:
    part = series.parts["left_hand"]
    assert part.pressure_kpa.shape == (260, 108)
    assert part.raw is not None
    assert part.raw.shape == (260, 108)
    # The palm is not in this recording.
    assert np.isnan(part.pressure_kpa[:, 60:]).all()
    assert np.isfinite(part.pressure_kpa[100:, :60]).any()
    assert np.diff(part.t_s) == pytest.approx(0.05, abs=0.002)
    assert {touch.event for touch in series.touches} >= {"begin", "move"}


def test_an_npz_file_holds_what_its_documentation_says(series: Series, tmp_path: Path) -> None:
    assert export(series, tmp_path / "grasp.npz") == [tmp_path / "grasp.npz"]
    with np.load(tmp_path / "grasp.npz") as arrays:
        kpa = arrays["left_hand.pressure_kpa"]
        np.testing.assert_array_equal(kpa, series.parts["left_hand"].pressure_kpa)
        assert arrays["left_hand.t_ns"].dtype == np.int64
        assert arrays["left_hand.raw"].dtype == np.uint8
        assert arrays["left_hand.position_m"].shape == (108, 3)
        assert len(arrays["touch.event"]) == len(series.touches)
        assert arrays["touch.centroid_m"].shape == (len(series.touches), 3)


def test_tables_have_a_row_a_frame_and_empty_cells_where_nothing_is_known(
    series: Series, tmp_path: Path
) -> None:
    written = export(series, tmp_path / "tables")
    assert [path.name for path in written] == [
        *("left_hand.csv", "touches.csv", "slips.csv", "overs.csv", "contacts.csv", "health.csv"),
    ]
    with written[0].open() as file:
        rows = list(csv.reader(file))
    assert rows[0][:3] == ["seq", "t_ns", "taxel_0_kpa"]
    assert len(rows) == 261
    assert rows[1][2 + 60 : -2] == [""] * 48
    part = series.parts["left_hand"]
    assert part.raw is not None
    assert rows[0][-2:] == ["beyond_range", "raw"]
    assert bytes.fromhex(rows[200][-1]) == part.raw[199].tobytes()
    assert float(rows[200][2]) == pytest.approx(part.pressure_kpa[199, 0], abs=0.005)
    with written[1].open() as file:
        touches = list(csv.DictReader(file))
    assert len(touches) == len(series.touches)
    assert touches[0]["event"] == "begin"
    assert float(touches[0]["force_n"]) > 0


def test_a_recording_of_messages_gives_the_same_arrays(
    series: Series, hand: Any, tmp_path: Path
) -> None:
    part = series.parts["left_hand"]
    path = tmp_path / "said.mcap"
    with Recorder(path) as recorder:
        for row in range(len(part.seq)):
            kpa = part.pressure_kpa[row]
            assert part.raw is not None
            frame = PressureFrame(
                "left_hand",
                int(part.seq[row]),
                int(part.t_ns[row]),
                part.raw[row],
                np.nan_to_num(kpa, nan=0.0),
                np.zeros(108, np.bool_),
                np.isfinite(kpa),
                part.beyond_range[row],
            )
            payload = encode_frame(frame, raw=True)
            recorder.say("skin/icub/left_hand/frame", row, payload)
    seen = read_messages(path).parts["left_hand"]
    np.testing.assert_array_equal(seen.t_ns, part.t_ns)
    np.testing.assert_array_equal(seen.raw, part.raw)
    np.testing.assert_allclose(seen.pressure_kpa, part.pressure_kpa, atol=0.0051)


def test_another_form_is_refused(series: Series, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"ends in one of \.npz, .* or a folder"):
        export(series, tmp_path / "a.xlsx")


def size(path: Path) -> tuple[int, int]:
    """Width and height of a PNG."""
    head = path.read_bytes()[:24]
    assert head.startswith(b"\x89PNG")
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")


def test_pictures_are_drawn(series: Series, hand: Any, log: Path, tmp_path: Path) -> None:
    settings, layout = hand
    plots.plot_pressure(series, tmp_path / "pressure.png", "left_hand")
    plots.plot_pressure(series, tmp_path / "two.svg", "left_hand", [3, 40])
    plots.plot_map(series, tmp_path / "map.png", "left_hand")
    plots.plot_map(series, tmp_path / "then.png", "left_hand", at_s=0.0)
    found = calibrate_from_log(log, settings, layout, 5.0)
    plots.plot_calibration(found, layout, tmp_path / "calibration.png")
    n = layout.n_taxels
    curves = Curves(
        rising(np.tile(8.0 * KNOTS_UNITS, (n, 1))),
        np.full(n, 40.0),
        np.full(n, 0.8),
        np.full(n, 4.0),
        np.zeros(n, np.uint8),
        340.0,
        0.0,
        Memory((20.0,), (0.3,)),
    )
    own = with_curves(found, curves)
    plots.plot_calibration(own, layout, tmp_path / "curves.png")
    for name in ("pressure", "map", "then", "calibration", "curves"):
        width, height = size(tmp_path / f"{name}.png")
        assert width > 600
        assert height > 200
    assert "<svg" in (tmp_path / "two.svg").read_text()


def test_what_is_not_there_is_not_drawn(series: Series, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match='no part "foot"; there are: left_hand'):
        plots.plot_map(series, tmp_path / "a.png", "foot")
    with pytest.raises(RequestError, match="no frame at 1000 s; its last is at"):
        plots.plot_map(series, tmp_path / "a.png", "left_hand", at_s=1000.0)
    with pytest.raises(RequestError, match=r"no frame at -3 s; .*, its first at 0.00 s"):
        plots.plot_map(series, tmp_path / "a.png", "left_hand", at_s=-3.0)
    with pytest.raises(RequestError, match="taxels 0 to 107; seen 108"):
        plots.plot_pressure(series, tmp_path / "a.png", "left_hand", [108])
    with pytest.raises(RequestError, match=r"ends in one of \.png"):
        plots.plot_map(series, tmp_path / "a.bmp", "left_hand")
