"""What is published besides frames is in every export, by the same names."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skin_host.cli import main
from skin_host.errors import LogError, RequestError
from skin_host.fingertip.events import Over, Slip
from skin_host.layout import load_skin
from skin_host.mqtt.messages import encode_event
from skin_host.processing.events import Load, Touch
from skin_host.recording.export import Series, export, read_frames, read_messages
from skin_host.recording.export.columns import TABLES
from skin_host.recording.mcap import Recorder
from skin_host.recording.replay import calibrate_from_log
from tests.recording.test_fingertip_replay import CONFIG, recording
from tests.recording.test_odd_exports import START_NS, TIMES_NS, frame, frames

__all__ = ["recording"]

LOAD = Load("contact", (0.1, 0.2, -2.0), (0.01, 0.0, 0.0), (0.1, 0.2, 0.0), ["touch", "slip"])
BEGIN = Touch(
    event="begin",
    id=4,
    seq=7,
    t_ns=START_NS + 5,
    count=3,
    part="index",
    taxels=[],
    centroid_m=(0.001, 0.002, 0.003),
    normal=(0.0, 0.6, 0.8),
    area_mm2=None,
    peak_kpa=None,
    mean_kpa=None,
    force_n=2.0,
    load=LOAD,
)
LOST = Touch(
    event="end",
    id=9,
    seq=8,
    t_ns=START_NS + 6,
    count=12,
    part="palm",
    taxels=[3, 14],
    centroid_m=None,
    normal=None,
    area_mm2=40.0,
    peak_kpa=0.0,
    mean_kpa=0.0,
    force_n=0.0,
    reason="lost",
)
SLIP = Slip(
    event="begin",
    id=4,
    t_ns=START_NS + 7,
    count=1,
    part="index",
    cause="fall",
    force_n=2.0,
    shear_n=1.1,
    shear_rate_n_s=4.8,
)
OVER = Over(event="begin", id=4, t_ns=START_NS + 8, count=2, part="index", force_n=10.4)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A recording of a palm and a fingertip."""
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for topic, payload in frames("palm", TIMES_NS):
            recorder.say(topic, START_NS, payload)
        for kind, event in (("touch", BEGIN), ("touch", LOST), ("slip", SLIP), ("over", OVER)):
            recorder.say(f"skin/demo/{event.part}/{kind}", 1, encode_event(event, event.count))
        for n, state in enumerate((b"ON", b"ON", b"UNKNOWN", b"")):
            recorder.say("skin/demo/palm/contact", START_NS + n, state)
        assert not recorder.unreadable
    return path


@pytest.fixture
def series(path: Path) -> Series:
    return read_messages(path)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_all_that_is_published_of_an_event_has_a_column() -> None:
    columns = {table.singular: {one.name for one in table.columns} for table in TABLES}
    of_load = {f"load_{name}" for name in Load.__struct_fields__}
    # What was missed before an event is the receiver's.
    assert columns["touch"] == {*Touch.__struct_fields__, *of_load} - {"missed", "load"}
    assert columns["slip"] == {*Slip.__struct_fields__} - {"missed"}
    assert columns["over"] == {*Over.__struct_fields__} - {"missed"}


def test_tables_of_text(series: Series, tmp_path: Path) -> None:
    written = export(series, tmp_path / "tables")
    assert [one.name for one in written] == [
        *("palm.csv", "touches.csv", "slips.csv", "overs.csv", "contacts.csv", "health.csv"),
    ]
    tables = {one.stem: rows(one) for one in written}
    index, palm = tables["touches"]
    assert (index["x_m"], index["normal_y"], index["normal_z"]) == ("0.001", "0.6", "0.8")
    assert (index["seq"], index["count"], index["reason"], index["area_mm2"]) == ("7", "3", "", "")
    assert (index["load_verdict"], index["load_flags"]) == ("contact", "touch slip")
    assert [index[f"load_force_{axis}_n"] for axis in "xyz"] == ["0.1", "0.2", "-2.0"]
    assert (index["load_torque_x_nm"], index["load_shear_y_n"]) == ("0.01", "0.2")
    assert (palm["reason"], palm["taxels"], palm["x_m"]) == ("lost", "3 14", "")
    assert (palm["load_verdict"], palm["load_force_x_n"]) == ("", "")
    assert tables["slips"] == [
        {
            "t_ns": str(SLIP.t_ns),
            "part": "index",
            "event": "begin",
            "id": "4",
            "count": "1",
            "cause": "fall",
            "force_n": "2.0",
            "shear_n": "1.1",
            "shear_rate_n_s": "4.8",
        }
    ]
    assert tables["overs"][0]["force_n"] == "10.4"
    assert [(one["part"], one["state"]) for one in tables["contacts"]] == [
        ("palm", "ON"),
        ("palm", "UNKNOWN"),
    ]


def test_nothing_of_an_earlier_export_stays_beside_a_new_one(
    series: Series, tmp_path: Path
) -> None:
    export(series, tmp_path / "tables")
    export(Series(series.parts, [], {}), tmp_path / "tables")
    assert rows(tmp_path / "tables" / "slips.csv") == []


def test_a_part_of_another_recording_does_not_stay_beside_a_new_export(
    series: Series, tmp_path: Path
) -> None:
    (tmp_path / "load.csv").write_text("time_s,pressure_kpa\n")
    export(series, tmp_path)
    export(series, tmp_path)
    (palm,) = series.parts.values()
    other = replace(palm, name="forearm")
    before = (tmp_path / "touches.csv").read_bytes()
    with pytest.raises(RequestError, match=r"holds palm\.csv, a part that this recording does not"):
        export(Series({"forearm": other}, [], {}), tmp_path)
    assert (tmp_path / "touches.csv").read_bytes() == before
    assert not (tmp_path / "forearm.csv").exists()


def test_arrays(series: Series, tmp_path: Path) -> None:
    export(series, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        assert arrays["touch.reason"].tolist() == ["", "lost"]
        assert arrays["touch.count"].tolist() == [3, 12]
        assert arrays["touch.seq"].tolist() == [7, 8]
        np.testing.assert_array_equal(arrays["touch.normal"], [(0, 0.6, 0.8), [np.nan] * 3])
        np.testing.assert_array_equal(arrays["touch.area_mm2"], [np.nan, 40.0])
        np.testing.assert_array_equal(
            arrays["touch.load_force_n"], [(0.1, 0.2, -2.0), [np.nan] * 3]
        )
        assert arrays["touch.load_flags"].tolist() == ["touch slip", ""]
        taxels = np.split(arrays["touch.taxels"], arrays["touch.taxels_n"].cumsum()[:-1])
        assert [one.tolist() for one in taxels] == [[], [3, 14]]
        assert arrays["slip.cause"].tolist() == ["fall"]
        assert arrays["over.force_n"].tolist() == [10.4]
        assert arrays["contact.state"].tolist() == ["ON", "UNKNOWN"]
        assert arrays["health.state"].tolist() == []


def test_parquet(series: Series, tmp_path: Path) -> None:
    from pyarrow import parquet

    written = export(series, tmp_path / "a.parquet")
    assert [one.name for one in written] == [
        *("a.parquet", "a.touches.parquet", "a.slips.parquet", "a.overs.parquet"),
        *("a.contacts.parquet", "a.health.parquet"),
    ]
    touches = parquet.read_table(tmp_path / "a.touches.parquet")
    index, palm = touches.to_pylist()
    assert (index["count"], index["seq"], index["normal"]) == (3, 7, [0.0, 0.6, 0.8])
    assert index["load_torque_nm"] == [0.01, 0.0, 0.0]
    assert index["load_flags"] == ["touch", "slip"]
    assert (palm["reason"], palm["taxels"], palm["load_verdict"]) == ("lost", [3, 14], None)
    assert touches.schema.field("load_force_n").metadata == {b"unit": b"N"}
    (slip,) = parquet.read_table(tmp_path / "a.slips.parquet").to_pylist()
    assert (slip["cause"], slip["shear_rate_n_s"], slip["t"].value) == ("fall", 4.8, SLIP.t_ns)


def test_a_table_of_frames_names_what_is_beyond_range_and_has_the_boards_bytes(
    series: Series, tmp_path: Path
) -> None:
    part = series.parts["palm"]
    part.beyond_range[1, [2, 11]] = True
    table, *_ = export(series, tmp_path / "tables")
    plain, beyond, *_ = rows(table)
    assert (plain["beyond_range"], beyond["beyond_range"]) == ("", "2 11")
    assert plain["raw"] == ""


def test_events_of_a_second_robot_are_not_mixed_with_those_of_the_first(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        recorder.say("skin/demo/palm/frame", 1, frame("palm", 1, START_NS))
        recorder.say("skin/other/index/touch", 2, encode_event(BEGIN, 1))
    with pytest.raises(LogError, match="holds messages of several robots: skin/demo, skin/other"):
        read_messages(path)


def test_what_is_no_contact_state_is_not_recorded(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.say("skin/demo/palm/contact", 1, b"maybe")
        assert recorder.unreadable == 1


def test_fingertips_in_a_recording_of_can_frames_are_exported(
    recording: Path, tmp_path: Path
) -> None:
    output = tmp_path / "tables"
    command = ["export", str(recording), str(output), "--config", str(CONFIG / "fingertips.toml")]
    assert main([*command, "--calibrate-seconds", "5"]) == 0
    touches = [one for one in rows(output / "touches.csv") if one["part"] == "index"]
    assert [one["count"] for one in touches] == [str(n + 1) for n in range(len(touches))]
    assert touches[0]["load_verdict"] == "contact"
    assert touches[-1]["reason"] == "released"
    slip, *_ = rows(output / "slips.csv")
    assert (slip["part"], slip["event"], slip["count"]) == ("index", "begin", "1")
    contacts = [one["state"] for one in rows(output / "contacts.csv")]
    assert {"OFF", "ON"} <= set(contacts)
    assert {one["part"] for one in rows(output / "health.csv")} == {"thumb_skin", "index", "thumb"}


def test_can_frames_of_fingertips_alone_are_exported(recording: Path, tmp_path: Path) -> None:
    settings, layout = load_skin(CONFIG / "fingertips.toml")
    zero = calibrate_from_log(recording, settings, layout, 5.0)
    log = tmp_path / "tips.log"
    lines = recording.read_text().splitlines(keepends=True)
    # So short that the board of the skin is not missed yet.
    tips = [line for line in lines if int(line.split()[2][:3], 16) >> 8 != 4][:100]
    log.write_text("".join(tips))
    series = read_frames(log, settings, layout, zero)
    assert series.parts == {}
    assert [one.part for one in series.health] == ["index", "thumb"]
    assert {one.t_ns // 10**9 for one in series.health} == {int(tips[-1][1:].partition(".")[0])}
    export(series, tmp_path / "tables")
    assert len(rows(tmp_path / "tables" / "health.csv")) == 2
    log.write_text(tips[-1].split()[0] + " can0 7FF#00\n")
    with pytest.raises(LogError, match="no sweep of this skin, and no sample of its fingertips"):
        read_frames(log, settings, layout, zero)
