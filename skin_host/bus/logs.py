"""Recordings as the same `FrameBatch` that a bus gives.

python-can's readers know the formats: candump (.log), Vector ASC and BLF, CSV, PEAK TRC,
MF4, and the text ones compressed (.gz).
"""

from collections.abc import Iterator
from pathlib import Path

import can
import can.io.player

from skin_host.bus.adapters import identifier, nanoseconds, one_line
from skin_host.bus.protocol import FrameBatch
from skin_host.errors import LogError

#: One batch holds at most so many frames.
CAPACITY = 1024
WINDOW_NS = 4_000_000


def read_channels(path: Path, window_ns: int = WINDOW_NS) -> Iterator[tuple[str, FrameBatch]]:
    """Channel and frames of a recording at full speed, in batches as a live bus would give.

    Times are exact to the microsecond. They count from the epoch where the format has a
    date, else from the start of the recording. Frames of one window are handed on channel
    by channel; the name of a channel is "" where the recording has none.

    Args:
        path: file; its suffix tells the format.
        window_ns: a batch spans at most so long.

    Raises:
        LogError: absent, of no known format, empty, or damaged; what came before the
            damage has then been handed on.
    """
    windows: dict[str, list[tuple[int, bytes, int]]] = {}
    end_ns = 0
    for channel, frame in _frames(path):
        if windows and (frame[2] >= end_ns or len(windows.get(channel, ())) == CAPACITY):
            yield from ((name, FrameBatch.of(frames)) for name, frames in windows.items())
            windows = {}
        if not windows:
            end_ns = frame[2] + window_ns
        windows.setdefault(channel, []).append(frame)
    yield from ((name, FrameBatch.of(frames)) for name, frames in windows.items())


def _frames(path: Path) -> Iterator[tuple[str, tuple[int, bytes, int]]]:
    """(channel, (identifier with flags, data, t_ns)) of each classic frame."""
    n = 0
    try:
        with _reader(path) as reader:
            for message in reader:
                n += 1
                if not message.is_fd:
                    channel = "" if message.channel is None else str(message.channel)
                    data = bytes(message.data)
                    yield channel, (identifier(message), data, nanoseconds(message.timestamp))
            # python-can takes a BLF that was cut off for one that ended.
            said, there = getattr(reader, "file_size", 0), path.stat().st_size
            if there < said:
                raise ValueError(f"cut off, {there} of {said} bytes are there")
    except LogError:
        raise
    except Exception as error:
        # Each reader has errors of its own for a file that is not what its name says.
        where = f"damaged after frame {n}" if n else "cannot be read as what its name says"
        raise LogError(f"{path}: {where}: {one_line(error)}") from None
    if not n:
        raise LogError(f"{path}: there is no CAN frame in it; wanted a recording, e.g. of candump")


def _reader(path: Path) -> can.io.generic.MessageReader:
    suffixes = [suffix.lower() for suffix in path.suffixes]
    known = sorted(can.io.player.MESSAGE_READERS)
    if not any(suffix in known for suffix in suffixes[-2:]):
        raise LogError(f"{path}: format not known by its name; known are {', '.join(known)}")
    try:
        with path.open("rb"):
            pass
        return can.LogReader(path)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from None
