"""Results of a recording as lines: published messages, one JSON object per line with its type.

Most of a replay's output is numbers of frames. They are written for many frames at once: the text
of each number is taken from a table, filled up with zeros, which are removed afterwards.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, BinaryIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.fingertip.events import FingertipEvent
from skin_host.mqtt.messages import encode_event, health_keys
from skin_host.processing.core import Output
from skin_host.processing.events import KPA_DECIMALS
from skin_host.processing.frame import PressureFrame
from skin_host.processing.masks import any_of

#: So many frames are written at once. Of more, the work arrays would leave the processor's cache.
BLOCK_FRAMES = 32
_WORD = 4
_PER_KPA = 10**KPA_DECIMALS
#: Whole kPa with a table; a word holds three digits and the point.
_MOST_KPA = 1000
_NUL = b"\0"
_encoder = msgspec.json.Encoder()


def _table(texts: Iterable[str]) -> NDArray[np.uint32]:
    """Return texts of up to four characters as words."""
    padded = b"".join(text.encode().ljust(_WORD, _NUL) for text in texts)
    return np.frombuffer(padded, np.uint32)


_BYTES = _table(f"{number}," for number in range(256))
_WHOLE = _table(f"{number}." for number in range(_MOST_KPA))
_DECIMALS = _table(
    f"{f'{number:0{KPA_DECIMALS}}'.rstrip('0') or '0'}," for number in range(_PER_KPA)
)


def frame_lines(frames: Sequence[PressureFrame]) -> list[bytes]:
    """Write frames as lines: arrays of all taxels, kPa with three decimals.

    The key `beyond_range` is there only when a taxel is, as in what is published.
    """
    ends = np.cumsum([len(frame.raw) for frame in frames]).tolist()
    begins = [0, *ends[:-1]]
    raw = _BYTES.take(np.concatenate([frame.raw for frame in frames])).tobytes()
    kpa = _kpa(np.concatenate([frame.pressure_kpa for frame in frames]).astype(np.float64))
    if kpa is None:
        kpas = [_json_of(frame.pressure_kpa) for frame in frames]
    else:
        word = 2 * _WORD
        kpas = [
            _text(kpa[begin * word : end * word]) for begin, end in zip(begins, ends, strict=True)
        ]
    return [
        b'{"type":"frame","part":%b,"seq":%d,"t_ns":%d,"raw":[%b],"pressure_kpa":[%b],'
        b'"touched":%b,"valid":%b%b}\n'
        % (
            _name(frame.part),
            frame.seq,
            frame.t_ns,
            _text(raw[begin * _WORD : end * _WORD]),
            pressures,
            _flags(frame.touched.tobytes()),
            _flags(frame.valid.tobytes()),
            b',"beyond_range":' + _flags(frame.beyond_range.tobytes())
            if any_of(frame.beyond_range)
            else b"",
        )
        for frame, begin, end, pressures in zip(frames, begins, ends, kpas, strict=True)
    ]


def health_line(record: Any) -> bytes:
    """Write a health record as a line: the payload as published, and its type."""
    return _encoder.encode({"type": "health"} | health_keys(record)) + b"\n"


class EventLines:
    """Events as lines: the payload as published, and its type; numbered."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, type]] = Counter()

    def line(self, event: FingertipEvent) -> bytes:
        """A touch, slip, or excess as a line."""
        key = event.part, type(event)
        self._counts[key] += 1
        count = self._counts[key]
        kind = type(event).__name__.lower()
        # The message has keys of its own, so a comma follows the type.
        return b'{"type":"%b",%b\n' % (kind.encode(), encode_event(event, count)[1:])


class LineWriter:
    """Writes results as lines, in their order, a block of frames at a time.

    Args:
        output: what the lines are written to; all of them are there after `flush`.
    """

    def __init__(self, output: BinaryIO) -> None:
        self._output = output
        self._frames: list[PressureFrame] = []
        #: What follows each of these frames.
        self._following: list[list[bytes]] = []
        self._events = EventLines()

    def write(self, result: Output) -> None:
        """Write the frames and events of a result, now or later."""
        line = self._events.line
        for frame, events in ((step.frame, step.events) for step in result.steps):
            self._frames.append(frame)
            self._following.append(list(map(line, events)))
        if result.grasps:
            self.flush()
            self._output.writelines(map(line, result.grasps))
        elif len(self._frames) >= BLOCK_FRAMES:
            self.flush()

    def flush(self) -> None:
        """Write what is left."""
        if not self._frames:
            return
        lines: list[bytes] = []
        for line, following in zip(frame_lines(self._frames), self._following, strict=True):
            lines.append(line)
            lines += following
        self._frames.clear()
        self._following.clear()
        self._output.write(b"".join(lines))


def _kpa(kpa: NDArray[np.float64]) -> bytes | None:
    """Return pressures as texts of 8 bytes each; None if any is beyond the tables."""
    thousandths = np.rint(kpa * _PER_KPA)
    # A pressure that is no number is not within these limits, either.
    if not (thousandths.min(initial=0) >= 0 and thousandths.max(initial=0) < _MOST_KPA * _PER_KPA):
        return None
    number = thousandths.astype(np.uint32)
    whole = number // _PER_KPA
    texts = np.empty((len(kpa), 2), np.uint32)
    texts[:, 0] = _WHOLE.take(whole)
    texts[:, 1] = _DECIMALS.take(number - whole * _PER_KPA)
    return texts.tobytes()


def _text(padded: bytes) -> bytes:
    """Return texts one after the other, without the comma after the last."""
    return padded.translate(None, _NUL)[:-1]


def _json_of(kpa: NDArray[np.float32]) -> bytes:
    # Adding 0 turns a rounded -0.0 into 0.0.
    rounded = kpa.astype(np.float64).round(KPA_DECIMALS) + 0.0
    return _encoder.encode(rounded.tolist())[1:-1]


@lru_cache
def _name(part: str) -> bytes:
    return _encoder.encode(part)


@lru_cache(maxsize=64)
def _flags(bits: bytes) -> bytes:
    """A mask, given as its bytes, in JSON: that of most frames is that of the frame before."""
    return _encoder.encode(np.frombuffer(bits, np.bool_).tolist())
