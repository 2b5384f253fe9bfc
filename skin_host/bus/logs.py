"""Reads recordings as the same `FrameBatch` that a bus gives.

python-can's readers support the formats: candump (.log), Vector ASC and BLF, CSV, PEAK TRC,
MF4, and the text formats compressed (.gz).
"""

import contextlib
import gzip
from bisect import bisect_left
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import BinaryIO, cast

import can
import can.io.player
import numpy as np
from numpy.typing import NDArray

from skin_host.bus.adapters import identifier, nanoseconds, one_line
from skin_host.bus.candump import Block, Frame, block_of, read_blocks
from skin_host.bus.wire import FrameBatch, RecordBatch
from skin_host.errors import LogError

#: One batch holds at most this many frames.
CAPACITY = 1024
WINDOW_NS = 4_000_000
#: Frames that are read one by one make a block of so many.
_BLOCK = 4096


def read_channels(path: Path, window_ns: int = WINDOW_NS) -> Iterator[tuple[str, FrameBatch]]:
    """Yield channel and frames of a recording at full speed, in batches as from a live bus.

    Times are exact to the microsecond. They count from the epoch where the format has a
    date, otherwise from the start of the recording. Frames of one window are returned channel
    by channel; the name of a channel is "" where the recording has none.

    Args:
        path: file; its suffix gives the format.
        window_ns: a batch spans at most this time.

    Raises:
        LogError: absent, of unknown format, empty, or damaged; everything before the damage has
            then been returned.
    """
    n = 0
    rest: RecordBatch | None = None
    rest_channel = np.zeros(0, np.uint16)
    damage: Exception | None = None
    with contextlib.closing(_blocks(path)) as blocks:
        for block in blocks:
            n += block.messages
            batch, channel = block.batch, block.channel
            if rest is not None and len(rest):
                batch, channel = rest.joined(batch), np.concatenate((rest_channel, channel))
            begin = 0
            for begin, end in _windows(batch, channel, window_ns):
                if end == len(batch):
                    break
                yield from _by_channel(batch[begin:end], channel[begin:end], block.names)
            else:
                begin = len(batch)
            rest, rest_channel, names = batch[begin:], channel[begin:], block.names
            damage = block.damage
    if damage is not None:
        where = f"damaged after frame {n}" if n else "cannot be read in the format of its name"
        raise LogError(f"{path}: {where}: {one_line(damage)}") from None
    if not n:
        raise LogError(f"{path}: it contains no CAN frame; wanted a recording, e.g. of candump")
    if rest is not None and len(rest):
        yield from _by_channel(rest, rest_channel, names)


def _windows(
    batch: RecordBatch, channel: NDArray[np.uint16], window_ns: int
) -> Iterator[tuple[int, int]]:
    """Where windows begin and end: at the first frame that is too late for one, or too many."""
    times = batch.t_ns.tolist()
    n = len(times)
    rising = bool((np.diff(batch.t_ns) >= 0).all())
    begin = 0
    while begin < n:
        end_ns = times[begin] + window_ns
        if rising:
            end = bisect_left(times, end_ns, begin + 1)
        else:
            end = next((row for row in range(begin + 1, n) if times[row] >= end_ns), n)
        if end - begin > CAPACITY:
            for code in set(channel[begin:end].tolist()):
                of_channel = np.flatnonzero(channel[begin:end] == code)
                if len(of_channel) > CAPACITY:
                    end = begin + int(of_channel[CAPACITY])
        yield begin, end
        begin = end


def _by_channel(
    batch: RecordBatch, channel: NDArray[np.uint16], names: list[str]
) -> Iterator[tuple[str, FrameBatch]]:
    """The frames of one window channel by channel, in the order in which channels came."""
    codes = dict.fromkeys(channel.tolist())
    if len(codes) == 1:
        yield names[next(iter(codes))], batch
        return
    for code in codes:
        yield names[code], batch[np.flatnonzero(channel == code)]


def _frame(message: can.Message) -> tuple[str, Frame] | None:
    """Channel and frame of a message; None for one of CAN FD.

    Raises:
        ValueError: it is not to be believed.
    """
    if message.is_fd:
        return None
    channel = "" if message.channel is None else str(message.channel)
    data = bytes(message.data)
    t_ns = nanoseconds(message.timestamp)
    if len(data) > 8:
        raise ValueError(f"a frame of {len(data)} bytes; wanted at most 8")
    if not 0 <= t_ns < 2**63:
        raise ValueError(f"a time of {message.timestamp:g} s")
    return channel, (identifier(message), data, t_ns)


def _blocks(path: Path) -> Generator[Block, None, None]:
    """The frames of a recording in order; what is damaged ends them."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    _check(path, suffixes)
    if suffixes[-1:] == [".log"]:
        with path.open("rb") as file:
            yield from read_blocks(file, _frame)
    elif suffixes[-2:] == [".log", ".gz"]:
        with gzip.open(path) as zipped:
            yield from read_blocks(cast(BinaryIO, zipped), _frame)
    else:
        yield from _messages(path)


def _messages(path: Path) -> Iterator[Block]:
    """The same by python-can's readers."""
    names: list[str] = []
    frames: list[tuple[str, Frame]] = []
    n = 0
    damage: Exception | None = None
    try:
        with can.LogReader(path) as reader:
            for message in reader:
                n += 1
                frame = _frame(message)
                if frame is not None:
                    frames.append(frame)
                if len(frames) == _BLOCK:
                    yield block_of(frames, names, n, None)
                    frames, n = [], 0
            # python-can does not report that a BLF file was cut off.
            said, there = getattr(reader, "file_size", 0), path.stat().st_size
            if there < said:
                raise ValueError(f"cut off, {there} of {said} bytes are left")
    except Exception as error:
        # Each reader has its own errors for a file that is not what its name indicates.
        damage = error
    yield block_of(frames, names, n, damage)


def _check(path: Path, suffixes: list[str]) -> None:
    """Whether there is a file of a known format.

    Raises:
        LogError: there is none.
    """
    known = sorted(can.io.player.MESSAGE_READERS)
    if not any(suffix in known for suffix in suffixes[-2:]):
        raise LogError(f"{path}: unknown format of file name; known are {', '.join(known)}")
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from None
