"""Recordings hold the very bytes that were heard, and are read by others too."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from skin_host.bus.wire import FrameBatch
from skin_host.errors import LogError
from skin_host.mqtt.frames import encode_frame
from skin_host.mqtt.info import NodeInfo, encode_info
from skin_host.mqtt.messages import encode_event
from skin_host.processing.frame import PressureFrame
from skin_host.recording.mcap import Recorder, read_can, read_messages_of
from tests.support.said import touch_event

TOPIC = "skin/demo/palm"


def frame(seq: int, encoding: Any = "json", *, raw: bool = False) -> bytes:
    m = 12
    kpa = np.linspace(0, 20, m, dtype=np.float32)
    none = np.zeros(m, np.bool_)
    sent = PressureFrame(
        "palm", seq, 1000 * seq, np.arange(m, dtype=np.uint8), kpa, none, ~none, none
    )
    return encode_frame(sent, encoding, raw=raw)


def touch(event: Any, number: int) -> bytes:
    return encode_event(
        touch_event(event, 7, number, 500, "palm", [1, 2], None, None, 40.0, 3.0, 2.0, 0.1), number
    )


def everything() -> list[tuple[str, bytes]]:
    info = NodeInfo(robot="demo", node="main", version="1", configuration="x", parts={})
    return [
        ("skin/demo/nodes/main/status", b"online"),
        ("skin/demo/nodes/main/info", encode_info(info)),
        (f"{TOPIC}/frame", frame(1)),
        (f"{TOPIC}/frame", frame(2, raw=True)),
        (f"{TOPIC}/touch", touch("begin", 1)),
        (f"{TOPIC}/contact", b"ON"),
        (f"{TOPIC}/health", b'{"schema":"skin.health/1","state":"ok"}'),
    ]


def test_messages_come_back_byte_for_byte_in_their_order(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for at_ns, (topic, payload) in enumerate(everything()):
            recorder.say(topic, at_ns, payload)
    assert [(said.topic, said.payload) for said in read_messages_of(path)] == everything()
    assert [said.t_ns for said in read_messages_of(path)] == list(range(7))


def test_frames_in_cbor_become_the_json_that_says_the_same(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        recorder.say(f"{TOPIC}/frame", 1, frame(3, "cbor", raw=True))
    (said,) = read_messages_of(path)
    assert said.payload == frame(3, "json", raw=True)


def test_other_readers_find_schemas_times_and_json(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for topic, payload in everything():
            recorder.say(topic, 9_000, payload)
        recorder.can("can0", FrameBatch.of([(0x4E1, b"\x40\xf0", 5)]))
    with path.open("rb") as file:
        reader = make_reader(file)
        kinds = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert schema.encoding == "jsonschema"
            properties = msgspec.json.decode(schema.data)["properties"]
            data = msgspec.json.decode(message.data)
            assert channel.message_encoding == "json"
            assert set(data) <= set(properties)
            kinds[schema.name] = message
        assert set(kinds) == {
            "skin.frame/1",
            "skin.touch/1",
            "skin.health/1",
            "skin.info/1",
            "skin.contact",
            "skin.status",
            "skin.can/1",
        }
        assert kinds["skin.frame/1"].publish_time == 2000
        assert kinds["skin.touch/1"].publish_time == 500
        assert kinds["skin.frame/1"].log_time == 9000


def test_what_is_not_what_its_topic_promises_is_counted_and_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for topic, payload in (
            (f"{TOPIC}/frame", b"{}"),
            (f"{TOPIC}/touch", b"\xff"),
            (f"{TOPIC}/health", b"[1]"),
            (f"{TOPIC}/contact", b"\xff\xfe"),
            ("skin/demo/nodes/main/info", b"nothing"),
        ):
            recorder.say(topic, 1, payload)
        recorder.say("skin/demo/nodes/main/cmd/calibrate", 1, b"{}")
        assert recorder.unreadable == 5
    assert list(read_messages_of(path)) == []


frames = st.lists(
    st.tuples(
        st.one_of(st.integers(0, 0x7FF), st.integers(0x80000000, 0x9FFFFFFF)),
        st.binary(max_size=8),
        st.integers(0, 2**62),
    ),
    min_size=1,
    max_size=30,
)


@given(batches=st.lists(st.tuples(st.sampled_from(["can0", "can1"]), frames), max_size=5))
def test_can_frames_come_back_as_they_were(
    tmp_path_factory: pytest.TempPathFactory,
    batches: list[tuple[str, list[tuple[int, bytes, int]]]],
) -> None:
    path = tmp_path_factory.mktemp("can") / "a.mcap"
    with Recorder(path) as recorder:
        recorder.can("can9", FrameBatch.of([(1, b"", 0)]))
        for channel, rows in batches:
            recorder.can(channel, FrameBatch.of(rows))
    for channel in ("can0", "can1"):
        seen = [
            (int(batch.id[i]), batch.data[i, : batch.dlc[i]].tobytes(), int(batch.t_ns[i]))
            for name, batch in read_can(path)
            if name == channel
            for i in range(len(batch))
        ]
        ours = [rows for name, rows in batches if name == channel]
        assert seen == [row for rows in ours for row in rows]


def test_a_recording_that_is_being_made_has_not_its_name_yet(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    recorder = Recorder(path)
    recorder.say(f"{TOPIC}/contact", 1, b"ON")
    assert not path.exists()
    recorder.close()
    assert [said.payload for said in read_messages_of(path)] == [b"ON"]
    assert [file.name for file in tmp_path.iterdir()] == ["a.mcap"]


def test_a_recording_without_can_frames_says_so(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        recorder.say(f"{TOPIC}/contact", 1, b"ON")
    with pytest.raises(LogError, match="holds no CAN frames"):
        list(read_can(path))


@pytest.mark.parametrize("cut", [0, 4, 20, 200, -1])
def test_a_broken_recording_is_an_error_of_one_line(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for topic, payload in everything():
            recorder.say(topic, 1, payload)
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(LogError, match=r"a\.mcap: no whole MCAP file") as caught:
        list(read_messages_of(path))
    assert "\n" not in str(caught.value)


@given(data=st.binary(max_size=300))
def test_any_bytes_are_survived(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.mktemp("any") / "a.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + data)
    with pytest.raises(LogError):
        list(read_messages_of(path))


def test_a_missing_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot be read: No such file"):
        list(read_messages_of(tmp_path / "gone.mcap"))


def test_a_recording_that_failed_before_it_began_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(LogError), Recorder(tmp_path / "a.mcap"):
        raise LogError("no broker")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(LogError), Recorder(tmp_path / "a.mcap") as recorder:
        recorder.say(f"{TOPIC}/contact", 1, b"ON")
        raise LogError("the broker went away")
    assert [said.payload for said in read_messages_of(tmp_path / "a.mcap")] == [b"ON"]
