"""Recordings of other programs, of two robots, or with a clock that was set: exported and drawn."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skin_host.cli import main
from skin_host.config.settings import load
from skin_host.layout import build_layout
from skin_host.mqtt.frames import encode_frame
from skin_host.mqtt.info import encode_info, node_info
from skin_host.mqtt.messages import encode_event
from skin_host.processing.pipeline import PressureFrame
from skin_host.recording.export.columns import TABLES
from skin_host.recording.mcap import Recorder
from tests.support.said import touch_event

CONFIG = Path(__file__).parents[2] / "config" / "icub_hand.toml"
START_NS = 1_700_000_000 * 10**9
PERIOD_NS = 50_000_000


def frame(part: str, seq: int, t_ns: int, taxels: int = 12, kpa: float = 1.0) -> bytes:
    none = np.zeros(taxels, np.bool_)
    pressures = np.full(taxels, kpa, np.float32)
    raw = np.zeros(taxels, np.uint8)
    return encode_frame(PressureFrame(part, seq, t_ns, raw, pressures, none, ~none, none))


def touch(part: str) -> bytes:
    place, normal = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    event = touch_event("begin", 7, 1, START_NS, part, [1, 2], place, normal, 40.0, 3.0, 2.0, 0.1)
    return encode_event(event, 1)


def recording(folder: Path, messages: list[tuple[str, bytes]]) -> Path:
    path = folder / "a.mcap"
    with Recorder(path) as recorder:
        for n, (topic, payload) in enumerate(messages):
            recorder.say(topic, START_NS + n, payload)
        assert not recorder.unreadable
    return path


def frames(part: str, times_ns: list[int], robot: str = "demo") -> list[tuple[str, bytes]]:
    return [(f"skin/{robot}/{part}/frame", frame(part, n, t_ns)) for n, t_ns in enumerate(times_ns)]


TIMES_NS = [START_NS + n * PERIOD_NS for n in range(20)]


def test_two_robots_in_one_recording_are_not_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recording(tmp_path, frames("palm", TIMES_NS) + frames("palm", TIMES_NS, "icub"))
    for command in (["export", str(path), str(tmp_path / "a.npz")],):
        assert main(command) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{path}: holds messages of several robots: skin/demo, skin/icub" in line


@pytest.mark.parametrize(
    "times_ns",
    [[START_NS], [START_NS] * 20, [START_NS + n // 2 for n in range(20)], [0, 2**62]],
    ids=["one frame", "one time", "within microseconds", "a hundred years"],
)
@pytest.mark.parametrize("output", ["set", "a.npz", "a.parquet", "tables"])
def test_odd_times_are_exported(
    times_ns: list[int], output: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recording(tmp_path, frames("palm", times_ns))
    command = ["export", str(path), str(tmp_path / output)]
    status = main([*command, "--lerobot"] if output == "set" else command)
    stands = output == "set" and len(times_ns) == 20
    assert status == (2 if stands else 0)
    err = capsys.readouterr().err
    assert ("palm: its time stands still" in err) == stands
    assert len(err.splitlines()) == stands


def test_a_data_set_of_a_recording_whose_clock_was_set_back_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recording(tmp_path, frames("palm", [*TIMES_NS, *(t - 3600 * 10**9 for t in TIMES_NS)]))
    assert main(["export", str(path), str(tmp_path / "set"), "--lerobot"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "palm: its time goes back by 3601 s at frame 20" in line


def test_a_data_set_whose_fastest_part_has_a_rate(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    path = recording(tmp_path, frames("palm", TIMES_NS))
    assert main(["export", str(path), str(tmp_path / "set"), "--lerobot"]) == 0
    assert json.loads((tmp_path / "set" / "meta" / "info.json").read_text())["fps"] == 20


HOSTILE = ['a,"b', "$x^{$", "..", "=1+1", "touches", "touch", "x" * 64, "\u202egnp"]


@pytest.mark.parametrize("part", HOSTILE)
@pytest.mark.parametrize("output", ["a.npz", "a.parquet", "tables", "a.png", "a.svg"])
def test_hostile_names_of_parts_end_in_a_file_or_in_a_line(
    part: str, output: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    path = recording(folder, [*frames(part, TIMES_NS), (f"skin/demo/{part}/touch", touch(part))])
    where = tmp_path / "out"
    where.mkdir()
    command = ["plot", "pressure"] if output.endswith(("png", "svg")) else ["export"]
    status = main([*command, str(path), str(where / output)])
    err = capsys.readouterr().err
    assert status in (0, 2)
    assert len(err.splitlines()) == (status > 0)
    assert {one.name for one in tmp_path.iterdir()} == {"in", "out"}
    if status:
        return
    if output == "tables":
        tables = {one.name: one for one in (where / output).iterdir()}
        assert len(tables) == 1 + len(TABLES)
        with tables["touches.csv"].open(newline="") as file:
            head, row = csv.reader(file)
        assert row[head.index("part")] == part
    if output == "a.npz":
        with np.load(where / output) as arrays:
            assert arrays[f"{part}.t_ns"].tolist() == TIMES_NS
            assert arrays["touch.t_ns"].tolist() == [START_NS]


@pytest.mark.parametrize("command", [["export"], ["plot", "map"]])
def test_places_of_another_number_of_taxels_are_refused(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = load(CONFIG)
    layout = build_layout(settings, CONFIG.parent)
    info = encode_info(node_info(layout, "main", version="1", configuration="x"))
    path = recording(
        tmp_path, [("skin/demo/nodes/main/info", info), *frames("left_hand", TIMES_NS)]
    )
    outputs = ["b.mcap", "b.rrd"] if command == ["export"] else ["b.png"]
    for output in outputs:
        assert main([*command, str(path), str(tmp_path / output)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "left_hand" in line
        assert "positions" in line


def test_frames_without_taxels_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recording(
        tmp_path, [("skin/demo/palm/frame", frame("palm", n, t, 0)) for n, t in enumerate(TIMES_NS)]
    )
    for command in (["plot", "pressure"], ["plot", "map"], ["export"]):
        output: Any = tmp_path / ("b.npz" if command == ["export"] else "b.png")
        status = main([*command, str(path), str(output)])
        assert status in (0, 2)
        assert len(capsys.readouterr().err.splitlines()) == (status > 0)
