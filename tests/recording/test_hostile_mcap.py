"""MCAP files that other programs wrote, or somebody who means harm: bounded, and in a line."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from skin_host.bus.wire import FrameBatch
from skin_host.errors import LogError
from skin_host.recording.mcap import (
    MAX_TOPICS,
    Recorder,
    read_can,
    read_messages_of,
)

TOPIC = "skin/demo/palm/health"
SECOND = 10**9


def written(path: Path, fill: Callable[[Writer], None], **options: Any) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start()
        fill(writer)
        writer.finish()
    return path


def test_chunks_that_all_begin_at_once_do_not_fill_the_memory(tmp_path: Path) -> None:
    """In 256 kB: 2 GB that a reader which sorts by time takes at once."""

    def fill(writer: Writer) -> None:
        channel = writer.register_channel(TOPIC, "json", 0)
        for _ in range(64):
            writer.add_message(channel, 0, b"", 0)
            writer.add_message(channel, 1, b" " * 32_000_000, 1)

    path = written(tmp_path / "a.mcap", fill, chunk_size=1000, compression=CompressionType.ZSTD)
    assert path.stat().st_size < 1_000_000
    # The memory of a process that reads it.
    script = (
        "import sys\n"
        "from pathlib import Path\n"
        "from skin_host.recording.mcap import read_messages_of\n"
        "print(sum(len(one.payload) for one in read_messages_of(Path(sys.argv[1]))))\n"
        # What `getrusage` reports is that of the process that started this one, if it was more.
        "print(Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])\n"
    )
    command = [sys.executable, "-c", script, str(path)]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    size, most_kb = map(int, ran.stdout.split())
    assert size == 64 * 32_000_000
    assert most_kb < 600_000


def test_an_index_that_points_elsewhere_is_not_followed(tmp_path: Path) -> None:
    """Chunks that are none but for the index were not checked."""

    def fill(writer: Writer) -> None:
        channel = writer.register_channel(TOPIC, "json", 0)
        for n in range(10):
            writer.add_message(channel, n, b"{}", n)

    path = written(tmp_path / "a.mcap", fill, chunk_size=1)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    first, *others = (
        index.chunk_start_offset.to_bytes(8, "little") for index in summary.chunk_indexes
    )
    data = path.read_bytes()
    for other in others:
        before, _, after = data.rpartition(other)
        data = before + first + after
    path.write_bytes(data)
    assert [one.t_ns for one in read_messages_of(path)] == list(range(10))


def test_what_was_recorded_after_the_clock_was_set_back_comes_after_the_rest(
    tmp_path: Path,
) -> None:
    """By their times, two moments would be mixed into each other."""
    path = tmp_path / "a.mcap"
    times_ns = [3600 * SECOND + n for n in range(5)] + list(range(5))
    with Recorder(path) as recorder:
        for t_ns in times_ns:
            recorder.say(TOPIC, t_ns, b'{"schema":"skin.health/1"}')
            recorder.can("can0", FrameBatch.of([(0x4E0, b"", t_ns)]))
    assert [one.t_ns for one in read_messages_of(path)] == times_ns
    assert [int(batch.t_ns[0]) for _, batch in read_can(path)] == times_ns


def test_a_topic_of_another_encoding_is_passed_over(tmp_path: Path) -> None:
    def fill(writer: Writer) -> None:
        for encoding in ("cdr", "json", "protobuf"):
            channel = writer.register_channel(TOPIC, encoding, 0)
            writer.add_message(channel, 1, b"{}" if encoding == "json" else b"\x00\x01", 1)

    path = written(tmp_path / "a.mcap", fill)
    assert [one.payload for one in read_messages_of(path)] == [b"{}"]


@pytest.mark.parametrize("t_ns", [2**63, 2**64 - 1])
def test_a_time_that_no_clock_shows_is_refused(tmp_path: Path, t_ns: int) -> None:
    def fill(writer: Writer) -> None:
        channel = writer.register_channel(TOPIC, "json", 0)
        writer.add_message(channel, t_ns, b"{}", t_ns)

    with pytest.raises(LogError, match=r"a\.mcap: .*a time of (9.22|1.84)\d*e\+\d+ s"):
        list(read_messages_of(written(tmp_path / "a.mcap", fill)))


@pytest.mark.parametrize(
    ("frames", "what"),
    [
        ({"t_ns": [-1], "id": [1], "data": [""]}, "t_ns"),
        ({"t_ns": [2**63], "id": [1], "data": [""]}, "t_ns"),
        ({"t_ns": [1], "id": [-1], "data": [""]}, "id"),
        ({"t_ns": [1], "id": [2**32], "data": [""]}, "id"),
        ({"t_ns": [1], "id": [1], "data": ["00" * 9]}, "9 bytes"),
        ({"t_ns": [1], "id": [1], "data": ["0"]}, "hex"),
        ({"t_ns": [1], "id": [1], "data": [""], "dropped": -1}, "dropped"),
        ({"t_ns": [1], "id": [1], "data": [""], "dropped": 2**70}, "dropped|Integer"),
        ({"t_ns": [1, 2], "id": [1], "data": [""]}, "another number"),
    ],
)
def test_can_frames_that_cannot_be_are_refused(
    tmp_path: Path, frames: dict[str, Any], what: str
) -> None:
    def fill(writer: Writer) -> None:
        channel = writer.register_channel("can/can0", "json", 0)
        writer.add_message(channel, 1, msgspec.json.encode(frames), 1)

    with pytest.raises(LogError, match=rf"a\.mcap: can/can0: .*({what})") as caught:
        list(read_can(written(tmp_path / "a.mcap", fill)))
    assert len(str(caught.value)) < 500


def test_an_interrupted_recording_gives_what_it_holds_and_then_its_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    recorder = Recorder(path)
    for n in range(20_000):
        more = str(n).encode() * 30
        recorder.say(TOPIC, n, b'{"schema":"skin.health/1","more":"' + more + b'"}')
    whole = recorder._draft.path
    cut = tmp_path / "cut.mcap"
    recorder.close()
    cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert not whole.exists()
    found: list[int] = []
    with pytest.raises(LogError, match="no whole MCAP file"):
        found.extend(one.t_ns for one in read_messages_of(cut))
    assert found == list(range(len(found)))
    assert len(found) > 1000


def test_two_recordings_one_after_the_other_are_not_the_first_alone(tmp_path: Path) -> None:
    """As by `cat`: the second one was left out without a word."""
    for name in ("a", "b"):
        with Recorder(tmp_path / f"{name}.mcap") as recorder:
            recorder.say(TOPIC, SECOND, b'{"schema":"skin.health/1"}')
    joined = tmp_path / "joined.mcap"
    joined.write_bytes(b"".join((tmp_path / f"{name}.mcap").read_bytes() for name in "ab"))
    with pytest.raises(LogError, match=r"goes on after its end.*`mcap merge`"):
        list(read_messages_of(joined))


@pytest.mark.parametrize("length", [2**31, 2**40, 2**63, 2**64 - 1])
@pytest.mark.parametrize("opcode", [3, 5, 6, 9, 12, 0x80])
def test_a_record_that_states_to_be_huge_is_refused(
    tmp_path: Path, opcode: int, length: int
) -> None:
    path = tmp_path / "a.mcap"
    head = b"\x89MCAP0\r\n" + b"\x01" + (8).to_bytes(8, "little") + bytes(8)
    path.write_bytes(head + bytes([opcode]) + length.to_bytes(8, "little") + bytes(100))
    with pytest.raises(LogError, match="no whole MCAP file"):
        list(read_messages_of(path))


def test_more_topics_than_a_recording_can_have_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for n in range(MAX_TOPICS + 10):
            recorder.say(f"skin/demo/part{n}/contact", 1, b"ON")
        recorder.say("skin/demo/part0/contact", 2, b"OFF")
        assert recorder.unreadable == 10
    assert len(list(read_messages_of(path))) == MAX_TOPICS + 1
