"""Recordings as other tools open them: read back by those tools' own loaders."""

import dataclasses
import json
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from skin_host.cli import main
from skin_host.errors import RequestError, SkinError, required
from skin_host.mqtt.info import FingertipInfo, PartInfo, TriangleInfo
from skin_host.mqtt.messages import ContactState
from skin_host.processing.events import Touch
from skin_host.recording.export import HealthLine, PartSeries, Series, export
from skin_host.recording.export.known import ContactLine, Gone
from skin_host.recording.export.scene import ARROW_M_PER_N, POINT, RecordedScene, SkinScene
from tests.recording.test_export_tables import BEGIN, LOAD, LOST, OVER, SLIP
from tests.support.rerun import chunks
from tests.support.waiting import PATIENCE_S

N, TAXELS = 5, 12
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 50_000_000


def part(name: str, *, start_ns: int = START_NS) -> PartSeries:
    kpa = np.arange(N * TAXELS, dtype=np.float32).reshape(N, TAXELS)
    kpa[2, 3] = np.nan
    t_ns = start_ns + PERIOD_NS * np.arange(N, dtype=np.int64)
    return PartSeries(name, np.arange(N), t_ns, kpa, kpa > 55, None)


def shape() -> PartInfo:
    return PartInfo(
        period_ms=50,
        pads=["pressure"] * 11 + ["thermal"],
        position_m=[(0.004 * i, 0.01, 0.002) for i in range(TAXELS)],
        normal=[(0.0, 0.0, 1.0)] * TAXELS,
        radius_mm=[2.0] * TAXELS,
        area_mm2=[25.0] * TAXELS,
        triangles=[TriangleInfo("b", 0, "triangle", 0, [(0.0, 0.0, 0.0)] * 3, 240)],
    )


def touch(event: str, frame: int, force_n: float) -> Touch:
    return Touch(
        event=event,  # type: ignore[arg-type]
        id=7,
        seq=frame,
        t_ns=START_NS + PERIOD_NS * frame,
        part="arm",
        taxels=[1, 2],
        centroid_m=(0.004, 0.01, 0.002),
        normal=(0.0, 0.0, 1.0),
        area_mm2=50.0,
        peak_kpa=40.0,
        mean_kpa=30.0,
        force_n=force_n,
    )


@pytest.fixture
def series() -> Series:
    touches = [touch("begin", 1, 1.5), touch("move", 2, 2.0), touch("end", 3, 0.0)]
    health = [HealthLine("arm", START_NS, "warning", "arm: warning; taxel 3: stuck")]
    later_ns = START_NS + PERIOD_NS
    parts = {"arm": part("arm"), "hand": part("hand", start_ns=later_ns)}
    return Series(parts, touches, {"arm": shape(), "hand": shape()}, health)


def test_foxglove_reads_points_contacts_transforms_and_log(series: Series, tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    output = tmp_path / "shown.mcap"
    assert export(series, output) == [output]
    seen: dict[str, list[Any]] = {}
    with output.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            seen.setdefault(channel.topic, []).append((schema.name, message.log_time, decoded))
    kinds = {topic: messages[0][0] for topic, messages in seen.items()}
    assert kinds == {
        "/tf": "foxglove.FrameTransforms",
        "/arm/points": "foxglove.PointCloud",
        "/hand/points": "foxglove.PointCloud",
        "/arm/contacts": "foxglove.SceneUpdate",
        "/health": "foxglove.Log",
    }
    (_, t_ns, cloud) = seen["/arm/points"][2]
    assert t_ns == START_NS + 2 * PERIOD_NS == cloud.timestamp.ToNanoseconds()
    assert cloud.frame_id == "arm"
    points = np.frombuffer(cloud.data, POINT)
    assert len(points) == 11  # the thermal pad is none
    assert cloud.point_stride == POINT.itemsize
    fields = {one.name: one.offset for one in cloud.fields}
    assert fields == {name: POINT.fields[name][1] for name in POINT.names}
    assert (points["valid"] == 0).nonzero()[0].tolist() == [3]
    assert points["kpa"][4] == 28.0
    last = np.frombuffer(seen["/arm/points"][4][2].data, POINT)
    assert last["beyond_range"].nonzero()[0].tolist() == [8, 9, 10]
    assert points["x"][4] == pytest.approx(0.016)
    begin, moved, ended = (decoded for _, _, decoded in seen["/arm/contacts"])
    (arrow,) = moved.entities[0].arrows
    assert arrow.shaft_length + arrow.head_length == pytest.approx(2.0 * ARROW_M_PER_N)
    # It points into the skin, and ends at the contact.
    assert arrow.pose.position.z == pytest.approx(0.002 + 2.0 * ARROW_M_PER_N)
    assert begin.entities[0].texts[0].text == "#7 1.50 N"
    assert not ended.entities[0].arrows
    (tf,) = (decoded for _, _, decoded in seen["/tf"])
    places = {one.child_frame_id: one.translation.x for one in tf.transforms}
    assert places["hand"] - places["arm"] > 0.044  # side by side
    assert seen["/health"][0][2].message.endswith("taxel 3: stuck")


def test_fingertips_have_arrows_and_what_no_arrow_shows_is_a_line(tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    index, palm = replace(BEGIN, t_ns=START_NS + 1), replace(LOST, part="arm", t_ns=START_NS + 2)
    free, skinned = (FingertipInfo(3, "sphere", [7.0], of, None, 0.3, 8.0) for of in (None, "arm"))
    series = Series(
        {"arm": part("arm")},
        [index, replace(BEGIN, part="thumb"), replace(BEGIN, part="not described"), palm],
        {"arm": shape()},
        slips=[SLIP, replace(SLIP, event="end")],
        overs=[OVER, replace(OVER, event="end")],
        fingertips={"index": free, "thumb": skinned},
    )
    scene = RecordedScene(series).scene
    assert scene.origins_m["thumb"] == scene.origins_m["arm"]
    assert scene.origins_m["index"][0] - scene.origins_m["arm"][0] > 0.044
    export(series, tmp_path / "shown.mcap")
    with (tmp_path / "shown.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        seen = [(topic.topic, found) for _, topic, _, found in reader.iter_decoded_messages()]
    lines = [found.message for topic, found in seen if topic == "/events"]
    assert lines == [
        "arm: contact 9 ended without a release (lost): it may still last",
        "index: contact 4 begins to slip (fall): 2.00 N, 1.10 N along the surface",
        "index: contact 4 slips no longer",
        "index: contact 4 presses too hard: 10.40 N",
        "index: contact 4 presses too hard no longer",
    ]
    (contact,) = (found for topic, found in seen if topic == "/index/contacts")
    # It has the whole force, that along the surface too.
    (words,) = contact.entities[0].texts
    assert words.text == f"#4 {np.linalg.norm(LOAD.force_n):.2f} N"
    assert "/thumb/contacts" in dict(seen)
    assert "/not described/contacts" not in dict(seen)
    export(series, tmp_path / "shown.rrd")
    from rerun.chunk import RrdReader

    assert "TextLog:text" in chunks(RrdReader(tmp_path / "shown.rrd"))["/events"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "#7 1.50 N"),
        ({"partial": True}, "#7 ≥ 1.50 N"),
        ({"beyond": True}, "#7 ≥ 1.50 N"),
        # The board of a fingertip measures what the pads on it do not feel to its end.
        ({"beyond": True, "load": LOAD}, f"#7 {np.linalg.norm(LOAD.force_n):.2f} N"),
        (
            {"load": replace(LOAD, verdict="saturated")},
            f"#7 ≥ {np.linalg.norm(LOAD.force_n):.2f} N",
        ),
    ],
)
def test_a_force_that_is_a_bound_is_no_measured_one(changes: dict[str, Any], words: str) -> None:
    scene = SkinScene({"arm": shape()})
    (arrow,) = scene.arrows("arm", 1, [replace(touch("begin", 1, 1.5), **changes)]).arrows
    assert arrow.label == words


def test_an_arrow_turns_to_where_a_force_points() -> None:
    from skin_host.recording.export.scene import turned_from_x

    for wanted in ([0, 0, -2.0], [0, 1.0, 0], [-1.0, 0, 0], [0.6, 0, 0.8]):
        x, y, z, w = turned_from_x(np.array(wanted))
        turned = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]
        np.testing.assert_allclose(turned, np.array(wanted) / np.linalg.norm(wanted), atol=1e-9)


def test_rerun_reads_what_was_exported(series: Series, tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    output = tmp_path / "grasp.rrd"
    assert export(series, output) == [output]
    seen = chunks(RrdReader(output))
    assert {"time", "Points3D:positions", "Points3D:colors"} <= seen["/robot/arm/taxels"]
    assert {"Arrows3D:vectors", "Arrows3D:labels"} <= seen["/robot/arm/contacts"]
    assert "Transform3D:translation" in seen["/robot/hand"]
    assert {"Scalars:scalars"} <= seen["/force_n/arm"] & seen["/kpa/hand"]
    assert "TextLog:text" in seen["/health"]


#: Ends the export of the recording in argv[1] to the file in argv[2], when it is nearly done.
ENDED = """
import pickle, sys
from pathlib import Path
from skin_host.recording.export import export, scene

show, left = scene.RerunStream.show, 9

def until_ended(self, item):
    global left
    left -= 1
    if not left:
        raise KeyboardInterrupt
    show(self, item)

scene.RerunStream.show = until_ended
export(pickle.loads(Path(sys.argv[1]).read_bytes()), Path(sys.argv[2]))
"""


def test_an_export_for_rerun_that_is_ended_ends(series: Series, tmp_path: Path) -> None:
    """Rerun waits for a thread that waits for Python when what it has encoded is not read."""
    pickled, output = tmp_path / "series", tmp_path / "a.rrd"
    pickled.write_bytes(pickle.dumps(series))
    done = subprocess.run(
        [sys.executable, "-c", ENDED, pickled, output],
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    assert done.stderr.endswith("KeyboardInterrupt\n")
    assert not output.exists()


def course(reader: Any, entity: str) -> list[float]:
    """The numbers of an entity over time."""
    found = []
    for chunk in reader.stream():
        if chunk.entity_path == entity:
            found += chunk.to_record_batch()["Scalars:scalars"].to_pylist()
    return [value for (value,) in found]


def test_no_force_and_no_pressure_is_0_where_it_is_not_known(
    series: Series, tmp_path: Path
) -> None:
    """In a plot over time a part that died would look untouched."""
    from rerun.chunk import RrdReader

    begin, _, end = series.touches
    after_ns = START_NS + N * PERIOD_NS
    touches = [
        *(begin, replace(end, reason="released")),
        *(replace(begin, t_ns=after_ns), replace(end, t_ns=after_ns + 1, reason="lost")),
        replace(begin, t_ns=after_ns + 2),
    ]
    gone = [Gone("arm", after_ns + 3)]
    export(dataclasses.replace(series, touches=touches, gone=gone), tmp_path / "a.rrd")
    reader = RrdReader(tmp_path / "a.rrd")
    forces_n = course(reader, "/force_n/arm")
    np.testing.assert_array_equal(forces_n, [1.5, 0.0, 1.5, np.nan, 1.5, np.nan])
    assert np.isnan(course(reader, "/kpa/arm")).tolist() == [False] * N + [True]


def test_after_a_lost_contact_the_force_is_not_known_until_the_part_is_untouched(
    series: Series, tmp_path: Path
) -> None:
    """The next one's release does not end the first, which may still press."""
    from rerun.chunk import RrdReader

    begin, _, end = series.touches
    touches = [begin, replace(end, t_ns=begin.t_ns + 1, reason="lost")]
    touches.append(replace(begin, id=8, t_ns=begin.t_ns + 3))
    touches.append(replace(end, id=8, t_ns=begin.t_ns + 4, reason="released"))
    touches.append(replace(begin, id=9, t_ns=begin.t_ns + 8))
    states: list[tuple[int, ContactState]] = [(-2, "OFF"), (0, "ON"), (1, "UNKNOWN")]
    states += [(3, "ON"), (6, "OFF"), (9, "OFF"), (10, "ON")]
    contacts = [ContactLine("arm", begin.t_ns + after_ns, state) for after_ns, state in states]
    contacts.append(ContactLine("hand", begin.t_ns + 2, "OFF"))
    shown = dataclasses.replace(series, touches=touches, contacts=contacts)
    export(shown, tmp_path / "a.rrd")
    reader = RrdReader(tmp_path / "a.rrd")
    forces_n = [0.0, 1.5, np.nan, np.nan, np.nan, 0.0, 1.5]
    np.testing.assert_array_equal(course(reader, "/force_n/arm"), forces_n)


def test_rerun_reads_the_file_for_foxglove_too(series: Series, tmp_path: Path) -> None:
    from rerun.chunk import McapReader

    export(series, tmp_path / "shown.mcap")
    seen = chunks(McapReader(tmp_path / "shown.mcap"))
    assert {"Points3D:positions", "CoordinateFrame:frame"} <= seen["/arm/points"]
    assert "Transform3D:child_frame" in seen["/tf"]
    assert "TextLog:text" in seen["/health"]


def test_pandas_and_polars_read_parquet_with_units_and_layout(
    series: Series, tmp_path: Path
) -> None:
    import pandas as pd
    import polars as pl
    from pyarrow import parquet

    frames, touches, *_ = export(series, tmp_path / "grasp.parquet")
    table = pd.read_parquet(frames, filters=[("part", "==", "arm")])
    kpa = np.stack(table["pressure_kpa"])
    np.testing.assert_array_equal(kpa, series.parts["arm"].pressure_kpa)
    assert table["t"].iloc[0] == pd.Timestamp(START_NS, tz="UTC")
    forces = pl.read_parquet(touches).filter(pl.col("event") == "move")["force_n"]
    assert forces.to_list() == [2.0]
    schema = parquet.read_schema(frames)
    assert schema.field("pressure_kpa").metadata[b"unit"] == b"kPa"
    layout = json.loads(schema.metadata[b"skin"])
    assert layout["parts"]["arm"]["position_m"][1] == [0.004, 0.01, 0.002]


def test_a_data_set_for_learning_has_an_array_a_step(series: Series, tmp_path: Path) -> None:
    from pyarrow import parquet

    export(series, tmp_path / "set", lerobot=True)
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    path = info["data_path"].format(episode_chunk=0, episode_index=0)
    table = parquet.read_table(tmp_path / "set" / path)
    assert info["fps"] == 20
    # From the first frame of the arm to the last one of the hand, which began a step later.
    assert info["total_frames"] == table.num_rows == N + 1
    assert set(info["features"]) == set(table.column_names)
    arm = np.array(table["observation.skin.arm"].to_pylist())
    valid = np.array(table["observation.skin.arm.valid"].to_pylist())
    assert arm.shape == (N + 1, TAXELS)
    assert arm[2, 3] == 0
    assert not valid[2, 3]
    # Until it begins nothing of the hand is valid.
    hand_valid = np.array(table["observation.skin.hand.valid"].to_pylist())
    assert not hand_valid[0].any()
    assert hand_valid[1].all()
    beyond = np.array(table["observation.skin.arm.beyond_range"].to_pylist())
    np.testing.assert_array_equal(beyond[:N], series.parts["arm"].beyond_range)
    np.testing.assert_allclose(table["timestamp"].to_pylist(), 0.05 * np.arange(N + 1), atol=1e-6)


def test_what_is_missing_is_said(series: Series, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="has no positions of the taxels of arm, hand"):
        RecordedScene(Series(series.parts, [], {}))
    with pytest.raises(SkinError, match=r"need the package nowhere.*pip install 'skin-host\[x\]'"):
        required("nowhere", "things", "x")
    with pytest.raises(RequestError, match=r"ends in one of .npz, .parquet, .mcap, .rrd"):
        export(series, tmp_path / "x.xls")


def test_a_recording_is_not_written_over_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = tmp_path / "grasp.mcap"
    recording.write_bytes(b"")
    assert main(["export", str(recording), str(recording)]) == 2
    assert "is read by this command" in capsys.readouterr().err


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", ["a.rrd", "a.mcap", "a.npz", "a.parquet", "tables", "set"])
def test_an_export_to_a_full_disk_ends_in_a_line_and_leaves_what_was_there(
    series: Series, tmp_path: Path, name: str
) -> None:
    """Rerun's own writer neither reported it nor ended."""
    output = tmp_path / "out" / name
    old = output if output.suffix else output / "touches.csv"
    old.parent.mkdir(parents=True)
    old.write_text("old")
    ended = exported_to_a_full_disk(series, output, 100)
    assert ended.endswith("cannot be written: File too large\n")
    assert old.read_text() == "old"
    assert list(tmp_path.rglob(".*")) == []


def exported_to_a_full_disk(series: Series, output: Path, most_bytes: int) -> str:
    """Export where no file can have more bytes; return what was wrong."""
    script = (
        "import resource, sys, pickle\n"
        "from pathlib import Path\n"
        "from skin_host.errors import SkinError\n"
        "from skin_host.recording.export import export\n"
        "series = pickle.loads(Path(sys.argv[1]).read_bytes())\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]), resource.RLIM_INFINITY))\n"
        "try:\n"
        "    export(series, Path(sys.argv[2]), lerobot=sys.argv[2].endswith('set'))\n"
        "except SkinError as error:\n"
        "    print(error)\n"
    )
    pickled = output.parent.parent / "pickled"
    pickled.write_bytes(pickle.dumps(series))
    command = [sys.executable, "-c", script, str(pickled), str(output), str(most_bytes)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize(("name", "most_bytes"), [("a.parquet", 40_000), ("tables", 10_000)])
def test_files_that_belong_together_appear_all_or_none(
    series: Series, tmp_path: Path, name: str, most_bytes: int
) -> None:
    """The touches do not fit on the disk; the frames, which come before them, do."""
    touches = [touch("move", n, float(n % 997)) for n in range(5000)]
    whole = Series(series.parts, touches, series.shapes)
    output = tmp_path / "out" / name
    assert "touches" in exported_to_a_full_disk(whole, output, most_bytes)
    assert [path for path in (tmp_path / "out").rglob("*") if path.is_file()] == []
    few = Series(series.parts, touches[:5], series.shapes)
    assert exported_to_a_full_disk(few, output, most_bytes) == ""
