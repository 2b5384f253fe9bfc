"""Reads recordings as the same `FrameBatch` that a bus gives.

python-can's readers support the formats: candump (.log), Vector ASC and BLF, CSV, PEAK TRC,
MF4, and the text formats compressed (.gz).

Lines of candump (`candump -L`) of one form are decoded together, as arrays:
`(1700000000.000125) can0 4E4#40F4F4F3F4F4F3F4`, with six decimals, a standard identifier and whole
bytes. All other lines (extended identifiers, remote and error frames, CAN FD, damage) go through
python-can one by one, so that the result does not depend on how a line was read. It is imported
only for them and for the other formats: that takes longer than ten seconds of a board's frames.
"""

import codecs
import contextlib
import io
import logging
import math
import re
from bisect import bisect_left
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import FrameBatch, RecordBatch
from skin_host.errors import LogError, visible

if TYPE_CHECKING:
    import can

log = logging.getLogger(__name__)

#: One batch holds at most this many frames.
CAPACITY = 1024
WINDOW_NS = 4_000_000
#: Frames that are read one by one make a block of so many.
_BLOCK = 4096
#: Number of bytes that are read at a time.
BLOCK_BYTES = 1 << 19
#: No robot has more.
MOST_CHANNELS = 1000
#: Longer lines are damage.
_LONGEST_LINE = 1 << 16
#: So many characters of a damaged one are shown.
_SHOWN = 60
_WANTED = "plain text as of `candump -L`, such as (1700000000.000125) can0 4E4#40F4F4"
#: Lines of this length and more are decoded one by one.
_LONGEST_ALIKE = 100
#: For lines of one length, this many forms are decoded together; others one by one.
_MOST_FORMS = 8
#: python-can has times as floats, which are exact to the microsecond up to here. Later lines are
#: decoded one by one.
_EXACT_S = 1 << 32
_LINE = re.compile(
    rb"\((\d{1,10})\.(\d{6})\) ([!-~]+) ([0-9A-Fa-f]{3})#((?:[0-9A-Fa-f]{2}){0,8})\Z"
)
#: Python's numbers, with which python-can reads a line, may have signs and underscores, and what
#: stands in place of the brackets around the time is not looked at.
_ANY_LINE = re.compile(
    rb"\s*\([0-9.]+\)\s+[!-~]+\s+[0-9A-Fa-f]{1,8}"
    rb"#(?:R[0-9A-Fa-f]?|(?:#[0-9A-Fa-f])?(?:[0-9A-Fa-f]{2})*)(?:\s+[RTrt])?\s*\Z"
)
#: Candump writes error frames with a flag in the identifier, which python-can reads as that of an
#: extended data frame, or, of errors on the bus, without the identifier and the data.
_ERROR_LINE = re.compile(rb"(\s*\S+\s+\S+\s+)([23])(?=[0-9A-Fa-f]{7}#)")
_INVALID = 255
_HEX = np.full(256, _INVALID, np.uint8)
_HEX[list(b"0123456789")] = range(10)
_HEX[list(b"abcdef")] = _HEX[list(b"ABCDEF")] = range(10, 16)
#: The octet of two digits as they lie in memory; more than 255 where one is none.
_VALUE = np.where(_HEX == _INVALID, 1 << 8, _HEX.astype(np.uint16))
_PAIRS = np.arange(1 << 16, dtype=np.uint16).view(np.uint8).reshape(-1, 2)
_OCTET = _VALUE[_PAIRS[:, 0]] << 4 | _VALUE[_PAIRS[:, 1]]
_NEWLINE = ord("\n")
_BLANK_LINES = re.compile(rb"\n[\r\n]*\n")

#: A classic frame as (identifier with flags, data, t_ns); None for any other message.
Frame = tuple[int, bytes, int]
Convert = Callable[["can.Message"], tuple[str, Frame] | None]


class DamageError(Exception):
    """A line that is not a message, or a file that cannot be read further."""


class UnfinishedError(DamageError):
    """A last line that was not written whole, as by a power cut."""


_TOO_MANY = DamageError(f"more than {MOST_CHANNELS} channels")


@dataclass(slots=True)
class Block:
    """Frames of some lines, in order.

    Attributes:
        names: channels.
        channel: uint16[n], index into `names`.
        batch: the frames.
        messages: how many messages there were, those that are no classic frames included.
        damage: why there is nothing after these frames.
    """

    names: list[str]
    channel: NDArray[np.uint16]
    batch: RecordBatch
    messages: int
    damage: Exception | None = None


def read_blocks(file: BinaryIO, convert: Convert) -> Generator[Block, None, None]:
    """The blocks of an open log; after one with damage there is no other.

    Args:
        file: at its begin.
        convert: gives channel and frame of a message of python-can, or raises an exception.
    """
    read = getattr(file, "read1", file.read)
    names: dict[str, int] = {}
    rest = b""
    number = 1
    while True:
        try:
            text = read(BLOCK_BYTES)
        except Exception as error:  # each way of compression has errors of its own
            yield block_of([], names, 0, error)
            return
        lines = rest + text
        if number == 1:
            lines = lines.removeprefix(codecs.BOM_UTF8)
        whole = lines.rfind(b"\n") + 1
        if text and len(lines) - whole <= _LONGEST_LINE:
            lines, rest = lines[:whole], lines[whole:]
        else:
            rest = b""
        if lines:
            block = _parse(lines, names, convert, number, is_end=not text)
            yield block
            number += lines.count(b"\n")
            if block.damage is not None:
                return
        if not text:
            return


def block_of(
    frames: list[tuple[str, Frame]],
    names: dict[str, int],
    messages: int,
    damage: Exception | None,
) -> Block:
    """A block of frames that were read one by one, each with its channel.

    `names` are the channels so far with their numbers; those of the block are put there.
    """
    known = len(names)
    channel = np.array([_code_of(name, names) for name, _ in frames], np.uint16)
    many = _one_too_many(channel, names, known)
    if many is not None:
        messages -= len(frames) - many
        frames, channel, damage = frames[:many], channel[:many], _TOO_MANY
    batch = FrameBatch.of([frame for _, frame in frames])
    cut = RecordBatch(batch.id, batch.dlc, batch.data, batch.t_ns)
    return Block(list(names), channel, cut, messages, damage)


def _code_of(name: str, names: dict[str, int]) -> int:
    """The number of a channel, which is one of `names` afterwards."""
    return names.setdefault(name, len(names))


def _one_too_many(channel: NDArray[np.uint16], names: dict[str, int], known: int) -> int | None:
    """Where the first channel begins that is more than `MOST_CHANNELS`; of the names, the first
    `known` were there before.
    """
    if len(names) <= MOST_CHANNELS:
        return None
    codes, first = np.unique(channel, return_index=True)
    new = np.sort(first[codes >= known])
    left = MOST_CHANNELS - known
    return int(new[left]) if len(new) > left else None


class _Rows(NamedTuple):
    """Results of lines; `kind` is 0 for a line without a result yet, otherwise one of those
    below.
    """

    kind: NDArray[np.uint8]
    channel: NDArray[np.uint16]
    id: NDArray[np.uint32]
    dlc: NDArray[np.uint8]
    data: NDArray[np.uint8]
    t_ns: NDArray[np.int64]


_EMPTY, _FRAME, _NO_FRAME = 1, 2, 3


def _parse(
    text: bytes, names: dict[str, int], convert: Convert, number: int, *, is_end: bool
) -> Block:
    """Decode lines, of which the first has this number; at the end of a file the last one may be
    unfinished.
    """
    known = len(names)
    as_read = text
    if b"\n\n" in text or b"\n\r\n" in text:
        # A file of nothing else is a thousandth of its size when it is compressed.
        text = _BLANK_LINES.sub(b"\n", text)
    buffer = np.frombuffer(text, np.uint8)
    ends = np.flatnonzero(buffer == _NEWLINE)
    if not len(ends) or ends[-1] != len(buffer) - 1:
        ends = np.append(ends, len(buffer))
    starts = np.append(0, ends[:-1] + 1)
    lengths = ends - starts
    n = len(starts)
    rows = _Rows(
        np.zeros(n, np.uint8),
        np.zeros(n, np.uint16),
        np.zeros(n, np.uint32),
        np.zeros(n, np.uint8),
        np.zeros((n, 8), np.uint8),
        np.zeros(n, np.int64),
    )
    rows.kind[lengths == 0] = _EMPTY
    for length in np.flatnonzero(np.bincount(lengths)).tolist():
        if not 0 < length < _LONGEST_ALIKE:
            continue
        of_length = np.flatnonzero(lengths == length)
        if len(of_length) == n and n * (length + 1) == len(buffer):
            lines = buffer.reshape(n, -1)[:, :length]
        else:
            lines = buffer[starts[of_length, None] + np.arange(length)]
        _decode_alike(lines, of_length, rows, names)
    damage: Exception | None = None
    for row in np.flatnonzero(rows.kind == 0).tolist():
        try:
            _decode_one(text[starts[row] : ends[row]], row, rows, names, convert)
        except DamageError as error:
            is_unfinished = is_end and row == n - 1 and not text.endswith(b"\n")
            kind = UnfinishedError if is_unfinished else DamageError
            if as_read is not text:
                number += _filled(as_read)[_filled(text).index(row)] - row
            damage = kind(f"line {number + row}: {error}")
            rows.kind[row:] = _EMPTY
            break
    of_frames = np.flatnonzero(rows.kind == _FRAME)
    many = _one_too_many(rows.channel[of_frames], names, known)
    if many is not None:
        damage = _TOO_MANY
        rows.kind[of_frames[many] :] = _EMPTY
    messages = int(np.count_nonzero(rows.kind != _EMPTY))
    frames = rows.kind == _FRAME
    if not frames.all():
        rows = _Rows(*(column[frames] for column in rows))
    batch = RecordBatch(rows.id, rows.dlc, rows.data, rows.t_ns)
    return Block(list(names), rows.channel, batch, messages, damage)


def _filled(text: bytes) -> list[int]:
    """Which lines of a text are not blank, from 0."""
    return [i for i, line in enumerate(text.split(b"\n")) if line.strip(b"\r")]


def _decode_alike(
    lines: NDArray[np.uint8], at: NDArray[np.intp], rows: _Rows, names: dict[str, int]
) -> None:
    """Decode lines uint8[k, length], which belong to the rows `at`, form by form."""
    for _ in range(_MOST_FORMS):
        if not len(at):
            return
        first = lines[0].tobytes()
        found = _LINE.match(first)
        if found is None:
            lines, at = lines[1:], at[1:]
            continue
        name = found[3].decode()
        channel = _code_of(str(int(name)) if name.isdigit() else name, names)  # as in python-can
        seconds, decimals, _, identifier, data = (slice(*found.span(i)) for i in range(1, 6))
        digits = np.concatenate((lines[:, seconds], lines[:, decimals]), axis=1) - ord("0")
        nibbles = _HEX.take(lines[:, identifier])
        octets = _OCTET.take(np.ascontiguousarray(lines[:, data]).view(np.uint16))
        whole_s, micros = _numbers(digits, found.end(1) - found.start(1))
        fixed = np.ones(len(first), np.bool_)
        for varying in (seconds, decimals, identifier, data):
            fixed[varying] = False
        fits = (
            lines[:, fixed] == lines[0, fixed],
            digits < 10,
            nibbles != _INVALID,
            octets <= 255,
            whole_s[:, None] < _EXACT_S,
        )
        into: slice | NDArray[np.intp] = at if len(at) < len(rows.kind) else slice(None)
        left = at[:0]
        # Whole arrays are looked through in a twentieth of the time that their rows take.
        if not all(flags.all() for flags in fits):
            alike = np.logical_and.reduce([flags.all(axis=1) for flags in fits])
            whole_s, micros, nibbles = whole_s[alike], micros[alike], nibbles[alike]
            octets = octets[alike]
            into, left, lines = at[alike], at[~alike], lines[~alike]
        rows.kind[into] = _FRAME
        rows.channel[into] = channel
        high, middle, low = nibbles.T.astype(np.uint32)
        rows.id[into] = high << 8 | middle << 4 | low
        rows.dlc[into] = octets.shape[1]
        rows.data[into, : octets.shape[1]] = octets
        rows.t_ns[into] = (whole_s * 1_000_000 + micros) * 1000
        at = left


def _numbers(digits: NDArray[np.uint8], n: int) -> NDArray[np.int64]:
    """The numbers int64[2, k] of the first n and of the other digits [k, m], up to 15 each."""
    place = np.zeros((digits.shape[1], 2))
    place[:n, 0] = 10.0 ** np.arange(n)[::-1]
    place[n:, 1] = 10.0 ** np.arange(len(place) - n)[::-1]
    # In float64, which is exact for so few digits, products of matrices are much faster.
    return (digits @ place).astype(np.int64).T


def _decode_one(
    line: bytes, row: int, rows: _Rows, names: dict[str, int], convert: Convert
) -> None:
    """Decode a line into its row.

    Raises:
        DamageError: it is none of candump, or is not to be believed.
    """
    import can

    from skin_host.bus.port import ERROR_FLAG, EXTENDED_FLAG, one_line

    rows.kind[row] = _EMPTY
    seen = line
    error = _ERROR_LINE.match(line)
    if error is not None:
        line = b"%b%d%b" % (error[1], int(error[2]) - 2, line[error.end() :])
    try:
        if line.strip() and _ANY_LINE.match(line) is None:
            raise ValueError
        messages = list(can.CanutilsLogReader(io.StringIO(line.decode())))
    except Exception:  # python-can has many kinds of errors for a damaged line
        shown = visible(seen.decode(errors="replace"), _SHOWN)
        raise DamageError(f'seen "{shown}", wanted {_WANTED}') from None
    for message in messages:
        rows.kind[row] = _NO_FRAME
        try:
            converted = convert(message)
        except ValueError as refused:
            raise DamageError(one_line(refused)) from None
        if converted is None:
            continue
        name, (identifier, data, t_ns) = converted
        if error is not None:
            identifier = identifier & ~EXTENDED_FLAG | ERROR_FLAG
        rows.channel[row] = _code_of(name, names)
        rows.kind[row] = _FRAME
        rows.id[row] = identifier
        rows.dlc[row] = len(data)
        rows.data[row, : len(data)] = np.frombuffer(data, np.uint8)
        rows.t_ns[row] = t_ns


def channel_names(path: Path) -> Iterator[str]:
    """Yield each channel of a recording when its first frame comes; "" is one without a name.

    Damage ends them: `read_channels` reports it.

    Raises:
        LogError: the recording is absent, or of unknown format.
    """
    seen: set[str] = set()
    with contextlib.closing(_blocks(path)) as blocks:
        for block in blocks:
            new = [block.names[code] for code in dict.fromkeys(block.channel.tolist())]
            yield from (name for name in new if name not in seen)
            seen.update(new)


def read_channels(
    path: Path, window_ns: int = WINDOW_NS, only: str | None = None
) -> Iterator[tuple[str, FrameBatch]]:
    """Yield channel and frames of a recording at full speed, in batches as from a live bus.

    Times are exact to the microsecond. They count from the epoch where the format has a
    date, otherwise from the start of the recording. Frames of one window are returned channel
    by channel; the name of a channel is "" where the recording has none.

    Args:
        path: file; its suffix gives the format.
        window_ns: a batch spans at most this time.
        only: return the frames of this channel alone, in the recording's order.

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
            if only is not None and block.names != [only]:
                code = block.names.index(only) if only in block.names else len(block.names)
                of_only = np.flatnonzero(channel == code)
                batch, channel = batch[of_only], channel[of_only]
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
                break
    if rest is not None and len(rest):
        yield from _by_channel(rest, rest_channel, names)
    if n and isinstance(damage, UnfinishedError):
        shown = visible(str(path))
        log.warning("%s: ends in the middle of a line; read as far as it is whole", shown)
        damage = None
    if damage is not None:
        from skin_host.bus.port import one_line

        where = f"damaged after frame {n}" if n else "cannot be read in the format of its name"
        raise LogError(f"{path}: {where}: {one_line(damage)}") from None
    if not n:
        raise LogError(f"{path}: it contains no CAN frame; wanted a recording, e.g. of candump")


def _windows(
    batch: RecordBatch, channel: NDArray[np.uint16], window_ns: int
) -> Iterator[tuple[int, int]]:
    """Where windows begin and end: at the first frame that is too late or too early for one, or too
    many.
    """
    times = batch.t_ns.data  # unlike a list, it makes numbers only of those looked at
    n = len(times)
    rising = bool((np.diff(batch.t_ns) >= 0).all())
    begin = 0
    while begin < n:
        if rising:
            end = bisect_left(times, times[begin] + window_ns, begin + 1)
        else:
            end = _end_of_span(times, begin, window_ns)
        if end - begin > CAPACITY:
            for code in np.flatnonzero(np.bincount(channel[begin:end]) > CAPACITY):
                of_channel = np.flatnonzero(channel[begin:end] == code)
                if len(of_channel) > CAPACITY:
                    end = begin + int(of_channel[CAPACITY])
        yield begin, end
        begin = end


def _end_of_span(times: Sequence[int], begin: int, window_ns: int) -> int:
    """The first row after `begin` with which the times, in any order, span the window.

    Also a time that goes back ends a window: after a clock was set back, or one damaged time ahead,
    a later one comes only when all channels' frames of that while are in the window.
    """
    low_ns = high_ns = times[begin]
    for row in range(begin + 1, len(times)):
        low_ns, high_ns = min(low_ns, times[row]), max(high_ns, times[row])
        if high_ns - low_ns >= window_ns:
            return row
    return len(times)


def _by_channel(
    batch: RecordBatch, channel: NDArray[np.uint16], names: list[str]
) -> Iterator[tuple[str, FrameBatch]]:
    """The frames of one window channel by channel, in the order in which channels came."""
    codes = {0: None} if len(names) == 1 else dict.fromkeys(channel.tolist())
    if len(codes) == 1:
        yield names[next(iter(codes))], batch
        return
    for code in codes:
        yield names[code], batch[np.flatnonzero(channel == code)]


def _frame(message: "can.Message") -> tuple[str, Frame] | None:
    """Channel and frame of a message; None for one of CAN FD.

    Raises:
        ValueError: it is not to be believed.
    """
    from skin_host.bus.adapters import identifier, nanoseconds

    if message.is_fd:
        return None
    channel = "" if message.channel is None else str(message.channel)
    data = bytes(message.data)
    if len(data) > 8:
        raise ValueError(f"a frame of {len(data)} bytes; wanted at most 8")
    if len(data) < min(message.dlc, 8) and not message.is_remote_frame:
        raise ValueError(f"{len(data)} bytes of a frame of {message.dlc}")
    t_ns = nanoseconds(message.timestamp) if math.isfinite(message.timestamp) else -1
    if not 0 <= t_ns < 2**63:
        raise ValueError(f"a time of {message.timestamp:g} s")
    return channel, (identifier(message), data, t_ns)


def _blocks(path: Path) -> Generator[Block, None, None]:
    """The frames of a recording in order; what is damaged ends them."""
    check_format(path)
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes[-1:] == [".log"]:
        with path.open("rb") as file:
            yield from read_blocks(file, _frame)
    elif suffixes[-2:] == [".log", ".gz"]:
        import gzip

        with gzip.open(path) as zipped:
            yield from read_blocks(cast(BinaryIO, zipped), _frame)
    else:
        yield from _messages(path)


class _Lines(io.TextIOWrapper):
    """A text whose lines have a limited length.

    Attributes:
        is_whole: the last line that was read has an end.
    """

    is_whole = True

    def __next__(self) -> str:  # type: ignore[override]
        line = self.readline()
        if not line:
            raise StopIteration
        return line

    def readline(self, size: int | None = -1, /) -> str:  # type: ignore[override]
        line = super().readline(_LONGEST_LINE)
        if len(line) == _LONGEST_LINE:
            raise ValueError(f"a line of more than {_LONGEST_LINE} characters")
        self.is_whole = not line or line.endswith("\n")
        return line


class _TrcLines(_Lines):
    """Those of one recording: its times count from the begin that its head states, and python-can
    would count those of another that follows it from there, too.
    """

    _has_begun = False

    def __next__(self) -> str:  # type: ignore[override]
        line = super().__next__()
        if not line.startswith(";"):
            self._has_begun = self._has_begun or not line.isspace()
        elif self._has_begun and line.startswith(";$"):
            raise ValueError(
                "it goes on after its end, as two recordings one after the other; wanted one"
            )
        return line


def _reader(path: Path) -> "tuple[can.io.generic.MessageReader, _Lines | None]":
    """python-can's reader, which would read a line of any length and a container of any size, and
    the text that it reads, if it is one.
    """
    import gzip

    import can

    from skin_host.bus.asc import DatedAscReader
    from skin_host.bus.blf import BoundedBlfReader
    from skin_host.bus.sqlite import BoundedSqliteReader
    from skin_host.bus.trc import StrictTrcReader

    zipped = path.suffix.lower() == ".gz"
    kind = can.io.player.MESSAGE_READERS[_format([one.lower() for one in path.suffixes])]
    if kind is can.BLFReader:
        return BoundedBlfReader(path), None
    if kind is can.SqliteReader:
        return BoundedSqliteReader(path), None
    if not issubclass(kind, can.io.generic.TextIOMessageReader):
        return can.LogReader(path), None
    file = gzip.open(path) if zipped else path.open("rb")  # noqa: SIM115  # the reader closes it
    kind_of_lines = _TrcLines if kind is can.TRCReader else _Lines
    lines = kind_of_lines(cast(BinaryIO, file), encoding="utf-8-sig", errors="strict")
    ours = {can.ASCReader: DatedAscReader, can.TRCReader: StrictTrcReader}
    return ours.get(kind, kind)(lines), lines


def _format(suffixes: list[str]) -> str:
    """The suffix that names the format of a recording, zipped or not; empty if there is none."""
    named = suffixes[:-1] if suffixes[-1:] == [".gz"] else suffixes
    return named[-1] if named else ""


def _messages(path: Path) -> Iterator[Block]:
    """The same by python-can's readers."""

    names: dict[str, int] = {}
    frames: list[tuple[str, Frame]] = []
    n = 0
    damage: Exception | None = None
    lines: _Lines | None = None
    try:
        reader, lines = _reader(path)
        with reader:
            for message in reader:
                frame = _frame(message)
                n += 1
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
        is_whole = lines is None or lines.is_whole
        damage = error if is_whole else UnfinishedError(str(error))
    yield block_of(frames, names, n, damage)


def check_format(path: Path) -> None:
    """Check that there is a file of a known format.

    Raises:
        LogError: there is none.
    """
    seen = _format([suffix.lower() for suffix in path.suffixes])
    if seen != ".log":
        import can.io.player

        known = sorted(can.io.player.MESSAGE_READERS)
        if seen not in known:
            names = ", ".join(sorted({*known, ".mcap"}))
            raise LogError(f"{path}: unknown format of file name; known are {names}")
    open_recording(path).close()


def candump_name(channel: str) -> str:
    """Return what candump's logs call a channel: a word; they are read with numbers as such."""
    word = "_".join(channel.split()) or "_"
    return str(int(word)) if word.isdecimal() else word


def name_in(path: Path, channel: str) -> str:
    """Return what a recording of the format of `path` calls a channel; most formats know only
    numbers.
    """
    match _format([suffix.lower() for suffix in path.suffixes]):
        case ".log":
            return candump_name(channel)
        case ".csv":
            return ""
        case ".asc" | ".blf" | ".trc" as numbers:
            from can.util import channel2int

            return str((channel2int(channel) or 0) + (numbers == ".trc"))
    return channel


def open_recording(path: Path) -> BinaryIO:
    """Open a file to read; a pipe, which would be waited for, is refused.

    Raises:
        LogError: it cannot be read.
    """
    try:
        if path.is_fifo():
            raise LogError(f"{path}: not a file; wanted a recording")
        return path.open("rb")
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from None
