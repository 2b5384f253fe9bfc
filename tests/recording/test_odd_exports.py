"""Recordings of other programs, of two robots, or with a clock that was set: exported and drawn."""

import csv
import json
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from mcap.writer import Writer
from msgspec.structs import replace

from skin_host.cli import main
from skin_host.config.settings import load
from skin_host.layout import build_layout
from skin_host.mqtt.frames import encode_frame
from skin_host.mqtt.info import encode_info, node_info
from skin_host.mqtt.messages import encode_event, encode_health
from skin_host.mqtt.outbox import REPEATED
from skin_host.processing.frame import PressureFrame
from skin_host.recording.export import read_messages
from skin_host.recording.export.columns import TABLES
from skin_host.recording.mcap import Recorder
from tests.support.candump import write_config, write_log
from tests.support.rerun import chunks
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
    lasts = output == "set" and len(times_ns) == 2
    assert status == (2 if stands or lasts else 0)
    err = capsys.readouterr().err
    assert ("palm: its time stands still" in err) == stands
    assert ("palm: seen 1 steps a second for 4611686018 s; wanted at most" in err) == lasts
    assert len(err.splitlines()) == (stands or lasts)


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


#: Rows of each table.
ROWS = {"touches": 1, "contacts": 1, "health": 1}


@pytest.fixture
def without_frames(tmp_path: Path) -> Path:
    """A recording of a robot whose parts publish no frames."""
    settings = load(CONFIG)
    layout = build_layout(settings, CONFIG.parent)
    info = encode_info(node_info(layout, "main", version="1", configuration="x"))
    health = encode_health({"state": "ok", "sentences": []})
    said = {"touch": touch("left_hand"), "contact": b"ON", "health": health}
    messages = [(f"skin/demo/left_hand/{kind}", payload) for kind, payload in said.items()]
    return recording(tmp_path, [("skin/demo/nodes/main/info", info), *messages])


def test_tables_without_frames_have_everything_else(without_frames: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    outputs = [tmp_path / "out" / name for name in ("a.npz", "a.parquet", "tables")]
    for output in outputs:
        assert main(["export", str(without_frames), str(output)]) == 0
    npz, frames, tables = outputs
    with np.load(npz) as arrays:
        assert arrays["touch.part"].tolist() == ["left_hand"]
        assert arrays["contact.state"].tolist() == ["ON"]
    assert parquet.read_table(frames).num_rows == 0
    for table in TABLES:
        number = ROWS.get(table.name, 0)
        assert parquet.read_table(frames.with_suffix(f".{table.name}.parquet")).num_rows == number
        assert len((tables / f"{table.name}.csv").read_text().splitlines()) == 1 + number


def test_a_scene_without_frames_has_the_contacts(without_frames: Path, tmp_path: Path) -> None:
    pytest.importorskip("mcap_protobuf")
    pytest.importorskip("rerun")
    from mcap.reader import make_reader
    from rerun.chunk import RrdReader

    for name in ("b.mcap", "b.rrd"):
        assert main(["export", str(without_frames), str(tmp_path / name)]) == 0
    with (tmp_path / "b.mcap").open("rb") as file:
        times_ns = {
            channel.topic: message.log_time
            for _, channel, message in make_reader(file).iter_messages()
        }
    assert times_ns["/left_hand/contacts"] == times_ns["/tf"] == START_NS
    assert "/robot/left_hand/contacts" in chunks(RrdReader(tmp_path / "b.rrd"))


@pytest.mark.parametrize(
    "command", [["plot", "pressure", "b.png"], ["plot", "map", "b.png"], ["export", "set"]]
)
def test_what_needs_frames_names_what_there_is_instead(
    command: list[str], without_frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    *words, output = command
    more = ["--lerobot"] if words == ["export"] else ["--part", "left_hand"]
    assert main([*words, str(without_frames), str(tmp_path / output), *more]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "holds touches (1), contacts (1), health (1); wanted frames of pressure" in line
    assert not (tmp_path / output).exists()


def test_a_recording_of_nothing_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recording(tmp_path, [("skin/demo/nodes/main/status", b"online")])
    assert main(["export", str(path), str(tmp_path / "b.npz")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "holds no frames of pressure, events, contact states or health" in line


def test_an_event_that_came_twice_is_exported_once(tmp_path: Path) -> None:
    moved = touch("palm").replace(b'"begin"', b'"move"')
    again = moved.replace(b'"count":1', b'"count":2').replace(b'"t_ns":17', b'"t_ns":18')
    restarted = moved.replace(b'"t_ns":17', b'"t_ns":16')
    uncounted = moved.replace(b'"count":1,', b"")
    assert len({moved, again, restarted, uncounted}) == 4
    payloads = [moved, again, moved, again, restarted, uncounted, uncounted]
    path = recording(tmp_path, [("skin/demo/palm/touch", payload) for payload in payloads])
    seen = [(event.count, event.t_ns // 10**17) for event in read_messages(path).touches]
    assert seen == [(1, 17), (2, 18), (1, 16), (0, 17), (0, 17)]


def test_all_that_a_node_sends_again_over_its_next_connection_is_exported_once(
    tmp_path: Path,
) -> None:
    """To the next of several brokers, what it has sent in the last 10 s."""
    place, normal = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    payloads = []
    for count in range(1, REPEATED + 1):
        t_ns = START_NS + count * PERIOD_NS
        event = touch_event("move", 7, count, t_ns, "palm", [1], place, normal, 40.0, 3.0, 2.0, 0.1)
        payloads.append(encode_event(event, count))
    path = recording(tmp_path, [("skin/demo/palm/touch", payload) for payload in 2 * payloads])
    touches = read_messages(path).touches
    assert [event.count for event in touches] == list(range(1, REPEATED + 1))


@pytest.mark.parametrize("kind", ["frame", "touch"])
@pytest.mark.parametrize("t_ns", [-5, 2**63])
@pytest.mark.parametrize("output", ["b.mcap", "b.rrd", "b.npz", "b.parquet", "tables"])
def test_a_time_that_is_none_is_refused(
    kind: str, t_ns: int, output: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    payload = frame("palm", 1, START_NS) if kind == "frame" else touch("palm")
    changed = payload.replace(f'"t_ns":{START_NS}'.encode(), f'"t_ns":{t_ns}'.encode())
    assert changed != payload
    path = tmp_path / "a.mcap"
    # What another program has recorded: ours leaves such a message out.
    with path.open("wb") as file:
        writer: Any = Writer(file)
        writer.start()
        channel = writer.register_channel(f"skin/demo/palm/{kind}", "json", 0)
        writer.add_message(channel, START_NS, changed, START_NS)
        writer.finish()
    assert main(["export", str(path), str(tmp_path / output)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{path}: skin/demo/palm/{kind}: " in line
    assert "t_ns" in line
    assert not (tmp_path / output).exists()


@pytest.mark.parametrize("output", ["b.mcap", "b.rrd", "b.png"])
def test_a_part_without_taxels_or_outlines_stops_no_picture_of_the_others(
    output: str, tmp_path: Path
) -> None:
    settings = load(CONFIG)
    info = node_info(build_layout(settings, CONFIG.parent), "main", version="1", configuration="x")
    hand = info.parts["left_hand"]
    hand.triangles[0].outline_m.clear()
    lists = ("pads", "position_m", "normal", "radius_mm", "area_mm2", "triangles")
    info.parts["nothing"] = replace(hand, **{key: [] for key in lists})
    said = [
        ("skin/demo/nodes/main/info", encode_info(info)),
        ("skin/demo/left_hand/frame", frame("left_hand", 1, START_NS, len(hand.pads))),
        ("skin/demo/left_hand/touch", touch("left_hand")),
    ]
    path = recording(tmp_path, said)
    command = ["plot", "map"] if output == "b.png" else ["export"]
    assert main([*command, str(path), str(tmp_path / output)]) == 0


def test_a_table_does_not_replace_the_recording_that_it_is_made_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A recording of CAN frames may be a CSV file, too, and have the name of a part."""
    config = write_config(tmp_path / "skin.toml")
    (part,) = load(config).parts
    log = tmp_path / "tables" / f"{part}.csv"
    log.parent.mkdir()
    source = write_log(tmp_path / "a.log", 120, lambda _: [])
    with can.LogReader(source) as reader, can.CSVWriter(log) as writer:
        for message in reader:
            writer.on_message_received(message)
    before = log.read_bytes()
    assert main(["export", str(log), str(log.parent), "--config", str(config)]) == 2
    assert f"{log}: is read by this command" in capsys.readouterr().err
    assert log.read_bytes() == before
    assert list(log.parent.iterdir()) == [log]
