"""Protocol of the MTB family: identifiers, data frames, status words. Pure, both directions.

Classic CAN 2.0A at 1 Mbit/s, eleven-bit identifiers of three fields:

    bits 10..8 class | bits 7..4 sender | bits 3..0 receiver, or type of a stream

A triangle's twelve values travel as two frames of one identifier 0x400|board<<4|triangle:

    A: 40 P0 P1 P2 P3 P4 P5 P6        B: C0 P7 P8 P9 P10 P11 S0 S1

The status word S0<<8|S1 is a mask of taxels far out of range (bits 15..4) and an error
nibble. The frames have no sequence number and no fixed order: pair them by header byte.
Sources: icub-firmware's embot_prot_can_skin_periodic.cpp and mtb3/main_V3.c. Commands
and their answers are in `commands`.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

HOST_ADDRESS = 0
BROADCAST_ADDRESS = 15
TAXELS = 12
TRIANGLES = 16
#: In a mask of triangles.
ALL_TRIANGLES = (1 << TRIANGLES) - 1
TRIANGLE_BITS = np.arange(TRIANGLES)
HEADER_A = 0x40
HEADER_B = 0xC0
VALUES_A = 7
MAX_STANDARD_ID = 0x7FF
MAX_EXTENDED_ID = 0x1FFF_FFFF
NS_PER_S = 1_000_000_000


class MessageClass(IntEnum):
    """Bits 10..8 of an identifier."""

    MOTOR_COMMAND = 0
    MOTOR_STREAM = 1
    ANALOG_COMMAND = 2
    ANALOG_STREAM = 3
    SKIN_STREAM = 4
    INERTIAL_STREAM = 5
    BATTERY_STREAM = 6
    MANAGEMENT = 7


class StatusError(IntFlag):
    """The error nibble of a status word."""

    NONE = 0
    #: A taxel reads 0 although its baseline is not: the chip did not acknowledge.
    NO_ACK = 1
    #: All twelve values read 0xFFFF: no chip on the line answers.
    NOT_CONNECTED = 2


#: A frame as it is laid out for walking through: its time, then `struct can_frame`.
_RECORD = struct.Struct("=qqIB3xB7s")
_HEAD = 16
_RECORD_ARRAY = np.dtype(
    {
        "names": ["seconds", "nanoseconds", "id", "dlc", "data"],
        "formats": ["=i8", "=i8", "=u4", "u1", ("u1", 8)],
        "offsets": [0, 8, _HEAD, _HEAD + 4, _HEAD + 8],
        "itemsize": _RECORD.size,
    }
)
#: Slices of time since 1970 have numbers of so many bits, if they last 0.1 ms or longer.
_SLICE_BITS = 44
#: Bytes of `struct can_frame` up to the first byte of data, the header.
HEAD_BYTES = 9
#: The status words of a sweep without any.
NO_STATUS = np.zeros(TRIANGLES, np.uint16)
NO_STATUS.flags.writeable = False


class Records(NamedTuple):
    """The frames of a batch as they lie in memory, one after the other.

    Attributes:
        octets: uint8[n, size], contiguous.
        form: unpacks one into (seconds, nanoseconds, id, DLC, first byte, the other seven).
        head: where in each its `struct can_frame` begins: `HEAD_BYTES`, then seven bytes of data.
    """

    octets: Bytes
    form: struct.Struct
    head: int


@dataclass(slots=True)
class FrameBatch:
    """CAN frames as arrays, in the order they were received.

    Attributes:
        id: uint32[n], as SocketCAN writes it: flags for extended (bit 31), remote
            (bit 30) and error frames (bit 29) included. Standard data frames are <= 0x7FF.
        dlc: uint8[n].
        data: uint8[n, 8]; bytes past the DLC are not defined.
        t_ns: int64[n], kernel time of reception, nanoseconds since 1970.
        dropped: frames that the kernel had to drop since the batch before.
    """

    id: NDArray[np.uint32]
    dlc: Bytes
    data: Bytes
    t_ns: NDArray[np.int64]
    dropped: int = 0

    def __len__(self) -> int:
        return len(self.id)

    @property
    def rising(self) -> bool:
        """Whether no frame is older than the one before."""
        return _rising(self.t_ns)

    def records(self) -> Records:
        """Return the frames laid out for walking through them."""
        octets = _octets_of(self.id, self.dlc, self.data, self.t_ns)
        return Records(octets, _RECORD, _HEAD)

    def frames(self) -> Iterator[tuple[int, int, int, int, int, bytes]]:
        """Yield each frame as (seconds, nanoseconds, id, DLC, first byte, the other seven).

        A read of a live bus returns some dozen frames. Looping over them costs less than even a few
        operations on arrays; see docs/receive.md.
        """
        octets, form, _ = self.records()
        return form.iter_unpack(octets.data)

    @classmethod
    def of(cls, frames: list[tuple[int, bytes, int]]) -> "FrameBatch":
        """A batch of (id, data, t_ns), the data at most 8 bytes long."""
        n = len(frames)
        batch = cls(
            np.zeros(n, np.uint32),
            np.zeros(n, np.uint8),
            np.zeros((n, 8), np.uint8),
            np.zeros(n, np.int64),
        )
        for row, (identifier, data, t_ns) in enumerate(frames):
            batch.id[row] = identifier
            batch.dlc[row] = len(data)
            batch.data[row, : len(data)] = np.frombuffer(data, np.uint8)
            batch.t_ns[row] = t_ns
        return batch


class RecordBatch(FrameBatch):
    """A batch that is cut into others: its frames are laid out for walking through once, and each
    array is made when it is first read.
    """

    __slots__ = ("_octets", "_rising")

    def __init__(
        self, identifier: NDArray[np.uint32], dlc: Bytes, data: Bytes, t_ns: NDArray[np.int64]
    ) -> None:
        super().__init__(identifier, dlc, data, t_ns)
        self._octets = _octets_of(identifier, dlc, data, t_ns)
        self._rising = _rising(t_ns)

    @classmethod
    def _laid_out(cls, octets: Bytes, rising: bool | None) -> "RecordBatch":
        batch = cls.__new__(cls)
        batch.dropped = 0
        batch._octets = octets
        batch._rising = _rising(batch.t_ns) if rising is None else rising
        return batch

    def __getattr__(self, name: str) -> NDArray[Any]:
        """Called once for each array, while its slot is empty."""
        if name not in {"id", "dlc", "data", "t_ns"}:
            raise AttributeError(name)
        records = self._octets.view(_RECORD_ARRAY).reshape(-1)
        array: NDArray[Any]
        if name == "t_ns":
            array = records["seconds"] * NS_PER_S + records["nanoseconds"]
        else:
            array = records[name]
        setattr(self, name, array)
        return array

    def __len__(self) -> int:
        return len(self._octets)

    def __getitem__(self, rows: "slice | NDArray[np.intp]") -> "RecordBatch":
        """Some of the frames, in their order."""
        return self._laid_out(self._octets[rows], self._rising or None)

    def joined(self, other: "RecordBatch") -> "RecordBatch":
        """These frames and then the other ones."""
        return self._laid_out(np.concatenate((self._octets, other._octets)), None)

    @property
    def rising(self) -> bool:
        return self._rising

    def records(self) -> Records:
        return Records(self._octets, _RECORD, _HEAD)


def in_slices(
    batches: list[tuple[str, FrameBatch]], slice_ns: int, *, alone: bool = False
) -> list[tuple[str, FrameBatch]]:
    """Cut what was read of several buses in one turn into slices of time, the frames of a slice bus
    by bus.

    After a pause of this computer each bus has several sweeps waiting. Taken bus by bus, the last
    sweep of one would join the first of another to one frame of a part, and the chips of all boards
    would be judged once for each bus and period, not once for each period.

    The order of a bus's frames is kept. Where its clock was set back by more than a slice, what
    follows is in slices of its own, after all those before.

    A batch of a single bus is cut if `alone` is set.
    """
    if (len(batches) < 2 and not alone) or all(
        abs(batch.t_ns[-1] - batch.t_ns[0]) < slice_ns for _, batch in batches if len(batch)
    ):
        return [(bus, batch) for bus, batch in batches if len(batch)]
    slices: list[tuple[int, str, FrameBatch]] = []
    for bus, batch in batches:
        number = np.clip(batch.t_ns // slice_ns, 0, (1 << _SLICE_BITS) - 1)
        number[1:] += np.cumsum(np.diff(batch.t_ns) < -slice_ns) << _SLICE_BITS
        number = np.maximum.accumulate(number)
        starts = np.flatnonzero(np.diff(number, prepend=-1)).tolist()
        rows = RecordBatch(batch.id, batch.dlc, batch.data, batch.t_ns)
        for begin, end in pairwise([*starts, len(batch)]):
            piece = rows[begin:end]
            piece.dropped = 0 if begin else batch.dropped
            slices.append((int(number[begin]), bus, piece))
    return [(bus, piece) for _, bus, piece in sorted(slices, key=lambda one: one[0])]


def merged(batch: FrameBatch, sent: FrameBatch) -> FrameBatch:
    """Return the frames of two batches of a bus, each of the second before the first frame of the
    first that is newer.
    """
    at = np.searchsorted(np.maximum.accumulate(batch.t_ns), sent.t_ns, "right")
    return FrameBatch(
        np.insert(batch.id, at, sent.id),
        np.insert(batch.dlc, at, sent.dlc),
        np.insert(batch.data, at, sent.data, axis=0),
        np.insert(batch.t_ns, at, sent.t_ns),
        batch.dropped,
    )


def triangles_in(mask: int) -> NDArray[np.bool_]:
    """Return bool[16], the triangles whose bits a mask has."""
    found: NDArray[np.bool_] = (mask >> TRIANGLE_BITS & 1).astype(np.bool_)
    return found


def _rising(t_ns: NDArray[np.int64]) -> bool:
    return bool((t_ns[1:] >= t_ns[:-1]).all())


def _octets_of(
    identifier: NDArray[np.uint32], dlc: Bytes, data: Bytes, t_ns: NDArray[np.int64]
) -> Bytes:
    n = len(identifier)
    records = np.zeros(n, _RECORD_ARRAY)
    records["seconds"], records["nanoseconds"] = np.divmod(t_ns, NS_PER_S)
    records["id"], records["dlc"], records["data"] = identifier, dlc, data
    return np.ndarray((n, _RECORD.size), np.uint8, records)


def skin_id(board: int, triangle: int) -> int:
    """Identifier of the two frames of a triangle, e.g. 0x4EF for board 14, triangle 15."""
    return MessageClass.SKIN_STREAM << 8 | board << 4 | triangle


def identifier(message_class: MessageClass, sender: int, low_nibble: int) -> int:
    """Return an eleven-bit identifier from its fields."""
    return message_class << 8 | sender << 4 | low_nibble


@dataclass(slots=True)
class SkinFrames:
    """The frames of a batch that carry skin values.

    Attributes:
        row: intp[m], their rows in the batch.
        board, triangle: intp[m].
        half: intp[m], 0 for an A frame (P0..P6), 1 for a B frame (P7..P11 and status).
        wrong_header: frames of a skin identifier whose first byte is neither 40 nor C0.
        short: skin frames with too few bytes for their values.
        other: frames outside the skin stream.
    """

    row: NDArray[np.intp]
    board: NDArray[np.intp]
    triangle: NDArray[np.intp]
    half: NDArray[np.intp]
    wrong_header: int
    short: int
    other: int


#: What an identifier's class may carry: bit 0 an A frame, bit 1 a B frame. Class 3 is the legacy
#: stream. A special firmware sends B frames with class 6.
_HALVES_OF_CLASS = np.array([0, 0, 0, 3, 3, 0, 2, 0], np.uint8)
_SMALLEST_DLC = np.array([8, 6], np.uint8)
#: Types of class 3 with which a MAIS sends the positions of a hand's joints, eight bytes of which
#: the first may have any value. Source: iCubCanProto_analogSensorMessages.h (HES0TO6, HES7TO14).
MAIS_TYPES = frozenset({0xC, 0xD})


def find_skin_frames(batch: FrameBatch) -> SkinFrames:
    """Return the frames of a batch that carry a triangle's values.

    Class 4, and the legacy class 3 in its two-frame form. Other streams of class 3 have fewer
    bytes (force/torque: DLC 6 or 7; temperature: DLC 5), but for `MAIS_TYPES`: a frame of these may
    be of joints, and a triangle shows by sending both A and B. A B frame of old firmware may lack
    its status bytes (DLC 6 or 7, class 4).
    """
    n = len(batch)
    message_class = (batch.id >> 8).astype(np.intp)
    standard = batch.id <= MAX_STANDARD_ID
    message_class[~standard] = 0
    halves = _HALVES_OF_CLASS[message_class]
    header = batch.data[:, 0]
    is_b = header == HEADER_B
    headed = is_b | (header == HEADER_A)
    of_stream = (halves != 0) & (batch.dlc > 0)
    legacy = message_class != MessageClass.SKIN_STREAM
    of_stream &= ~legacy | ((batch.dlc == 8) & headed & ((halves >> is_b) & 1).astype(bool))
    long_enough = batch.dlc >= _SMALLEST_DLC[is_b.astype(np.intp)]
    row = np.flatnonzero(of_stream & headed & long_enough)
    n_stream = int(np.count_nonzero(of_stream))
    n_headed = int(np.count_nonzero(of_stream & headed))
    ids = batch.id[row].astype(np.intp)
    return SkinFrames(
        row=row,
        board=(ids >> 4) & 0xF,
        triangle=ids & 0xF,
        half=is_b[row].astype(np.intp),
        wrong_header=n_stream - n_headed,
        short=n_headed - len(row),
        other=n - n_stream,
    )


def encode_sweep(
    board: int, triangles: NDArray[np.intp], values: Bytes, status: NDArray[np.uint16]
) -> tuple[NDArray[np.uint32], Bytes]:
    """Frames of one sweep, A then B for each triangle, as an MTB sends them.

    Args:
        board: sender, 1..14.
        triangles: [k] numbers 0..15.
        values: uint8[k, 12].
        status: uint16[k], S0 << 8 | S1.

    Returns:
        Identifiers uint32[2k] and data uint8[2k, 8], all of DLC 8.
    """
    ids = np.repeat((MessageClass.SKIN_STREAM << 8 | board << 4 | triangles).astype(np.uint32), 2)
    return ids, encode_values(values, status)


def encode_values(values: Bytes, status: NDArray[np.uint16]) -> Bytes:
    """Return the data uint8[2k, 8] alone of `encode_sweep`."""
    k = len(values)
    data = np.empty((k, 2 * 8), np.uint8)
    data[:, 0] = HEADER_A
    data[:, 1:8] = values[:, :VALUES_A]
    data[:, 8] = HEADER_B
    data[:, 9:14] = values[:, VALUES_A:]
    # The high byte first, whatever the machine's order.
    data[:, 14:] = status.astype(">u2").view(np.uint8).reshape(k, 2)
    return data.reshape(2 * k, 8)


def status_word(out_of_range: NDArray[np.bool_], error: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Status words uint16[k] from masks bool[k, 12] (taxel i is bit i) and error nibbles [k]."""
    mask = out_of_range.astype(np.uint16) @ (1 << np.arange(TAXELS, dtype=np.uint16))
    return (mask << 4 | (error & 0xF)).astype(np.uint16)


def out_of_range(status: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Return masks bool[..., 12] of the taxels that a status word marks as far out of range."""
    return (status[..., None] >> np.arange(4, 4 + TAXELS, dtype=np.uint16) & 1).astype(np.bool_)


def status_error(status: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Error nibbles of status words, see `StatusError`."""
    return (status & 0xF).astype(np.uint8)
