"""The daemon's recording of frames: each frame that came in its time is in the file, or counted."""

import logging
import os
import resource
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.bus.logs import read_channels
from skin_host.bus.port import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from skin_host.bus.wire import FrameBatch
from skin_host.clock import SteppedClock
from skin_host.errors import RequestError, StateError
from skin_host.recording import capture
from skin_host.recording.capture import RESERVE_BYTES, FrameRecorder, candump_lines
from tests.support.waiting import until

Row = tuple[int, bytes, int]


def batch(n: int = 100, first: int = 0) -> FrameBatch:
    return FrameBatch.of([(0x4E0, bytes(8), 1_700_000_000 * 10**9 + first + i) for i in range(n)])


def rows_of(path: Path) -> list[Row]:
    return [
        (int(one.id[i]), one.data[i, : one.dlc[i]].tobytes(), int(one.t_ns[i]))
        for _, one in read_channels(path)
        for i in range(len(one))
    ]


@pytest.fixture
def full_disk() -> Iterator[None]:
    """A disk that takes 10 kB of a file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


async def test_what_a_full_disk_did_not_take_is_lost(tmp_path: Path, full_disk: None) -> None:
    recorder = FrameRecorder(tmp_path / "x.log", 60.0, 10**9)
    for _ in range(20):
        recorder.put("can0", batch())
    await until(lambda: recorder.ended is not None)
    assert recorder.ended == "cannot write: File too large"
    for _ in range(30):
        recorder.put("can0", batch())
    recorder.finish()
    await recorder.finished()
    written = len(rows_of(tmp_path / "x.log"))
    assert 0 < written < 5000
    assert (recorder.frames, recorder.lost) == (written, 5000 - written)


async def test_a_recording_leaves_room_for_what_the_daemon_keeps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk full of frames would not take what is touched, and a restart would not know it."""
    disk = os.statvfs(tmp_path)
    sizes = [disk.f_bavail * disk.f_frsize]

    def seen(_: Path | int) -> os.statvfs_result:
        values = list(disk)
        values[1], values[4] = 1, max(sizes[0], 0)
        return os.statvfs_result(values)

    monkeypatch.setattr(capture.os, "statvfs", seen)
    recorder = FrameRecorder(tmp_path / "x.log", 60.0, 10**9)
    for _ in range(10):
        recorder.put("can0", batch())
    await until(lambda: recorder.frames == 1000)
    sizes[0] = RESERVE_BYTES + 1000  # less than what comes next
    recorder.put("can0", batch())
    await until(lambda: recorder.ended is not None)
    assert "less than 16 MiB of its disk are left" in (recorder.ended or "")
    recorder.finish()
    await recorder.finished()
    assert (recorder.frames, recorder.lost) == (1000, 100)
    assert len(rows_of(tmp_path / "x.log")) == 1000
    sizes[0] = RESERVE_BYTES + 1000  # it would hold nothing
    with pytest.raises(StateError, match="move recordings away"):
        FrameRecorder(tmp_path / "y.log", 60.0, 10**9)
    assert not (tmp_path / "y.log").exists()


async def test_what_does_not_fit_in_its_size_is_lost(tmp_path: Path) -> None:
    recorder = FrameRecorder(tmp_path / "x.log", 60.0, 10_000)
    for _ in range(50):
        recorder.put("can0", batch())
    recorder.finish()
    await recorder.finished()
    written = len(rows_of(tmp_path / "x.log"))
    assert (recorder.frames, recorder.lost) == (written, 5000 - written)


class SlowDisk:
    """Writes when it is let to."""

    def __init__(self, recorder: FrameRecorder, monkeypatch: pytest.MonkeyPatch) -> None:
        self.asked, self.open = threading.Event(), threading.Event()
        self._append = recorder._append
        monkeypatch.setattr(recorder, "_append", self)

    def __call__(self, lines: bytes) -> None:
        self.asked.set()
        assert self.open.wait(60.0)
        self._append(lines)


async def test_what_came_in_its_time_is_written_and_what_came_later_is_none_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SteppedClock()
    recorder = FrameRecorder(tmp_path / "x.log", 10.0, 10**9, clock)
    disk = SlowDisk(recorder, monkeypatch)
    for number in range(3):
        recorder.put("can0", batch(first=1000 * number))
    await until(disk.asked.is_set)
    clock.advance(11.0)
    recorder.put("can0", batch())
    disk.open.set()
    await until(lambda: recorder.ended is not None)
    assert recorder.ended == "the time is over"
    assert len(rows_of(tmp_path / "x.log")) == recorder.frames == 300
    assert recorder.lost == 0


async def test_what_a_slow_disk_did_not_take_in_time_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capture, "WAITING_BATCHES", 2)
    recorder = FrameRecorder(tmp_path / "x.log", 10.0, 10**9)
    disk = SlowDisk(recorder, monkeypatch)
    recorder.put("can0", batch())
    await until(disk.asked.is_set)
    for _ in range(5):
        recorder.put("can0", batch())
    recorder.finish()
    disk.open.set()
    await recorder.finished(60.0)
    assert (recorder.frames, recorder.lost) == (300, 300)


async def test_a_disk_that_is_given_up_leaves_what_waited_as_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = FrameRecorder(tmp_path / "x.log", 10.0, 10**9)
    disk = SlowDisk(recorder, monkeypatch)
    recorder.put("can0", batch())
    recorder.put("can0", batch())
    await until(disk.asked.is_set)
    recorder.finish()
    await recorder.finished(0.0)
    assert (recorder.frames, recorder.lost) == (0, 200)
    disk.open.set()


async def test_its_end_states_how_much_was_lost(
    tmp_path: Path, full_disk: None, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    recorder = FrameRecorder(tmp_path / "x.log", 60.0, 10**9)
    recorder.put("can0", batch(1000))
    await until(lambda: recorder.ended is not None)
    recorder.finish()
    await recorder.finished()
    # A recorder of another test may end late.
    (line,) = [line for line in caplog.messages if f"{tmp_path}/x.log ended" in line]
    assert line.endswith("x.log ended: cannot write: File too large; 0 frames, 1000 lost")


async def test_a_file_that_took_its_name_meanwhile_is_not_cut(
    tmp_path: Path, full_disk: None
) -> None:
    path = tmp_path / "x.log"
    recorder = FrameRecorder(path, 60.0, 10**9)
    recorder.put("can0", batch())
    await until(lambda: recorder.frames == 100)
    path.unlink()
    path.write_bytes(bytes(9_000))
    for _ in range(10):
        recorder.put("can0", batch())
    await until(lambda: recorder.ended is not None)
    assert path.read_bytes() == bytes(9_000)


STAMPS = st.integers(0, 2**32 * 10**6).map(lambda us: us * 1000)
DATA = st.tuples(
    st.one_of(
        st.integers(0, 0x7FF), st.integers(0, 0x1FFFFFFF).map(lambda number: number | EXTENDED_FLAG)
    ),
    st.binary(max_size=8),
    STAMPS,
)
REMOTE = st.tuples(st.integers(0, 0x7FF).map(lambda n: n | REMOTE_FLAG), st.just(b""), STAMPS)
ERRORS = st.tuples(
    st.integers(0, 0x1FFFFFFF).map(lambda number: number | ERROR_FLAG),
    st.binary(min_size=8, max_size=8),
    STAMPS,
)


@given(st.lists(st.one_of(DATA, REMOTE, ERRORS), min_size=1, max_size=20))
def test_every_kind_of_frame_is_read_as_it_was_received(
    tmp_path_factory: pytest.TempPathFactory, rows: list[Row]
) -> None:
    path = tmp_path_factory.mktemp("kinds") / "x.log"
    path.write_bytes(candump_lines("can0", FrameBatch.of(rows)))
    assert rows_of(path) == rows


def test_a_name_of_another_format_is_refused(tmp_path: Path) -> None:
    """Its lines could not be read in the format of that name."""
    with pytest.raises(RequestError, match=r'x\.blf: wanted a name that ends in "\.log"'):
        FrameRecorder(tmp_path / "x.blf", 1.0, 1000)
    assert list(tmp_path.iterdir()) == []
