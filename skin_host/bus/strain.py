"""Force/torque boards (STRAIN, STRAIN2) on the robot's CAN: streams, commands, pairing.

Force and torque of one sample are two frames of class 3, ID 0x300 | board<<4 | type, each
with three little-endian words around 0x8000. They have no sequence number and are paired by
arrival, in the order in which the board sends them. Source: icub-main's CanBusFtSensor.cpp and
iCubCanProto_analogSensorMessages.h.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.commands import Analog, SetTransmissionPeriod, SetTxMode, command_frame, message
from skin_host.bus.ledger import BURST_NS, TWICE_NS, TWICE_SWEEPS
from skin_host.bus.wire import HOST_ADDRESS, FrameBatch, MessageClass, identifier

Floats = NDArray[np.float64]

ZERO_WORD = 0x8000
CHANNELS = 6
#: A board has timed out when nothing was received for this long, as the robots' own host has it,
#: and for so many of its periods: one lost sample is no silence.
LEAST_SILENT_NS = 100_000_000
SILENT_NS_PER_MS = 2_500_000
#: Time in which the two frames of a sample must arrive, per ms of period.
PAIR_NS_PER_MS = 750_000
#: A board sends its two frames one right after the other: the second is complete after 0.13 ms, or
#: after twice that behind a frame of another board. What follows within this, and within a sixth of
#: a period, after a pause of half a period is the second half of a sample.
NEXT_NS = 300_000
NEXT_SHARE = 1 / 6
PAUSE_SHARE = 1 / 2
#: No frame comes sooner after the one before, on any bus. What is read later at once may seem to.
FRAME_NS = 50_000
#: By so many samples more of the other order than of the known one, the other becomes the known.
ORDER_SAMPLES = 8


class StrainType(IntEnum):
    """Type of a stream: the low nibble of its identifier."""

    RAW_FORCE = 0x8
    RAW_TORQUE = 0x9
    FORCE = 0xA
    TORQUE = 0xB


# As plain numbers: NumPy asks the member of an enumeration in vain for methods of its own, which
# takes longer than the comparison.
_STREAM = int(MessageClass.ANALOG_STREAM)
_FIRST, LOADS, _LAST = map(int, (StrainType.RAW_FORCE, StrainType.FORCE, StrainType.TORQUE))


class StrainMode(IntEnum):
    """Argument of command 07 (`SetTxMode`) to a force/torque board."""

    CALIBRATED = 0
    STOP = 1
    UNCALIBRATED = 3
    BOTH = 4


@message(0x18, "<B")
class GetFullScale(Analog):
    """18: query the full scale of a channel: 0-2 force (N), 3-5 torque (N m)."""

    channel: int


@message(0x18, ">BH")
class FullScale(Analog):
    """Answer to 18. The only number in this protocol with its high byte first."""

    channel: int
    value: int


def silent_ns(period_ms: int) -> int:
    """Return after how long without a frame a board that sends every `period_ms` has timed out."""
    return max(LEAST_SILENT_NS, SILENT_NS_PER_MS * period_ms)


def scale_queries(board: int) -> list[tuple[int, bytes]]:
    """Return the frames that query all full scales of a board, twice: one answer may be damaged."""
    once = [command_frame(GetFullScale(channel), board) for channel in range(CHANNELS)]
    return once + once


def start_frames(board: int, period_ms: int) -> list[tuple[int, bytes]]:
    """Return the frames that set a board up: query its full scales, set the period, start it."""
    commands: list[Analog] = [SetTransmissionPeriod(period_ms), SetTxMode(StrainMode.CALIBRATED)]
    return scale_queries(board) + [command_frame(command, board) for command in commands]


def parse_full_scale(can_id: int, payload: bytes) -> tuple[int, FullScale] | None:
    """Return board and full scale of an answer to `GetFullScale`; None for any other frame."""
    board = can_id >> 4 & 0xF
    if can_id != identifier(MessageClass.ANALOG_COMMAND, board, HOST_ADDRESS) or board == 0:
        return None
    answer = FullScale.decode(payload)
    if answer is None or answer.channel >= CHANNELS:
        return None
    return board, answer


@dataclass(slots=True)
class StrainFrames:
    """The frames of a batch that force/torque boards sent.

    Attributes:
        row: intp[m], their rows in the batch.
        board, type: intp[m], see `StrainType`.
        value: int32[m, 3], words minus 0x8000.
        saturated: bool[m].
        wrong_length: intp[k], boards of the frames of such identifiers with neither 6 nor 7 bytes.
    """

    row: NDArray[np.intp]
    board: NDArray[np.intp]
    type: NDArray[np.intp]
    value: NDArray[np.int32]
    saturated: NDArray[np.bool_]
    wrong_length: NDArray[np.intp]


def parse_strain(batch: FrameBatch) -> StrainFrames:
    """Return the force/torque frames of a batch."""
    kind = batch.id & 0xF
    mine = (
        (batch.id >> 8 == _STREAM)
        & (batch.id >> 4 & 0xF != HOST_ADDRESS)
        & (kind >= _FIRST)
        & (kind <= _LAST)
    )
    fits = (batch.dlc == 6) | (batch.dlc == 7)
    row = np.flatnonzero(mine & fits)
    data = batch.data[row]
    words = data[:, 0:6:2].astype(np.int32) | data[:, 1:6:2].astype(np.int32) << 8
    return StrainFrames(
        row=row,
        board=(batch.id[row] >> 4 & 0xF).astype(np.intp),
        type=kind[row].astype(np.intp),
        value=words - ZERO_WORD,
        saturated=(batch.dlc[row] == 7) & (data[:, 6] != 0),
        wrong_length=(batch.id[mine & ~fits] >> 4 & 0xF).astype(np.intp),
    )


@dataclass(frozen=True, slots=True)
class Wrench:
    """Force and torque of one sample. `t_ns` is the arrival of its later frame."""

    t_ns: int
    force_n: Floats
    torque_nm: Floats
    saturated: bool


@dataclass(slots=True)
class StrainCounters:
    """Counters of one board's stream.

    Attributes:
        samples: pairs found.
        lone: frames whose other half did not arrive in time.
        late: of these, those whose other half came next, but later.
        saturated: samples with a saturated channel.
        doubled: frames that came twice in a row, alone or as both halves of a sample.
        wrong_length: frames that were neither force nor torque.
        excess: samples that were too many to be processed.
    """

    samples: int = 0
    lone: int = 0
    late: int = 0
    saturated: int = 0
    doubled: int = 0
    wrong_length: int = 0
    excess: int = 0


class _Half(NamedTuple):
    """A frame: its time, type and values (N or N m); `begins` if it came after a pause."""

    t_ns: int
    kind: int
    value: Floats
    saturated: bool
    begins: bool


class _TooMany:
    """Decides by the times of one type of frames whether more come than one board sends.

    What waited while a computer was busy comes in one burst, which does not count.

    Attributes:
        found: whether too many have come, for `TWICE_NS` or longer.
    """

    def __init__(self, period_ns: int) -> None:
        self.found = False
        self._period_ns = period_ns
        self._since_ns: int | None = None
        self._counted_ns = 0
        self._counted = 0

    def take(self, t_ns: int) -> None:
        """Take in the time of a frame."""
        since_ns = self._since_ns
        # After a pause, or a wrong time stamp, what was found holds until it is decided again.
        if since_ns is None or not 0 <= t_ns - since_ns < 2 * TWICE_NS:
            self._since_ns = self._counted_ns = t_ns
            self._counted = 0
        elif t_ns - since_ns < BURST_NS:
            self._counted_ns, self._counted = t_ns, 0
        else:
            self._counted += 1
            if t_ns - since_ns >= TWICE_NS:
                passed_ns = t_ns - self._counted_ns
                self.found = self._counted * self._period_ns > TWICE_SWEEPS * passed_ns
                self._since_ns = self._counted_ns = t_ns
                self._counted = 0


class WrenchAssembler:
    """Pairs the force and torque frames of one board, in its order, whichever that is.

    Either may come first, but always the same one: which one is learned from frames that come one
    right after the other. Before that only such frames are paired. Two frames belong together if
    they came in this order, with none between them, within three quarters of a period, and the
    second cannot be of the sample before. Other frames are counted and dropped, so that force is
    never joined with the torque of another sample, however late one of them is within its period
    and whichever are lost. Time stamps may be those of reading, equal for all that waited.

    Nothing distinguishes a board whose second half is always late by a whole period, to within
    `NEXT_NS`, from one that sends the other half first.

    Args:
        board: its address.
        period_ms: between samples.
        full_scale: float64[6], N and N m of a value of 0x8000.
        counters: to go on with; new ones by default.
    """

    def __init__(
        self,
        board: int,
        period_ms: int,
        full_scale: Floats,
        counters: StrainCounters | None = None,
    ) -> None:
        self.board = board
        self.full_scale = full_scale
        self.counters = StrainCounters() if counters is None else counters
        self._too_many = _TooMany(1_000_000 * period_ms)
        #: Of a value of 1, by type: float64[2, 3].
        self._unit = full_scale.reshape(2, -1) / ZERO_WORD
        period_ns = self._period_ns = 1_000_000 * period_ms
        self._pair_ns = period_ms * PAIR_NS_PER_MS
        self._next_ns = min(NEXT_NS, NEXT_SHARE * period_ns)
        self._pause_ns = PAUSE_SHARE * period_ns
        self._before: _Half | None = None
        #: The frame before waits for its other half.
        self._waits = False
        #: When the one before that came, if it had waited in vain: its other half may still come.
        self._owed_ns: int | None = None
        #: The type that comes first, None until that is known; and by how many samples more that is
        #: force than torque.
        self._first: int | None = None
        self._force_first = 0
        #: The last sample, and the last force.
        self._sample: tuple[_Half, _Half] | None = None
        self._force: _Half | None = None

    @property
    def twice(self) -> bool:
        """Whether more is sent than one board sends: a second one has its address, or two gateways
        pass its frames on.
        """
        return self._too_many.found

    def take(self, frames: StrainFrames, t_ns_of: NDArray[np.int64]) -> list[Wrench]:
        """Take a batch's frames, and its times [n]; return the samples that they complete."""
        self.counters.wrong_length += int(np.count_nonzero(frames.wrong_length == self.board))
        mine = np.flatnonzero((frames.board == self.board) & (frames.type >= LOADS))
        kinds = frames.type[mine]
        samples = []
        for t_ns, kind, value, saturated in zip(
            t_ns_of[frames.row[mine]].tolist(),
            kinds.tolist(),
            frames.value[mine] * self._unit[kinds - LOADS],
            frames.saturated[mine].tolist(),
            strict=True,
        ):
            begins = self._before is None or abs(t_ns - self._before.t_ns) >= self._pause_ns
            half = _Half(t_ns, kind, value, saturated, begins)
            if self._is_doubled(half):
                self.counters.doubled += 1
                continue
            if kind == LOADS:
                # What is passed on twice is not of two boards.
                if self._force is None or not self._repeats(self._force, half):
                    self._too_many.take(t_ns)
                self._force = half
            sample = self._pair(half)
            if sample is not None:
                samples.append(sample)
        return samples

    def _is_doubled(self, half: _Half) -> bool:
        """Whether it is the frame that came last, once more: a receiver that saw an error in the
        last bit of a frame gets it again, as do two gateways in parallel.

        The board itself sends the same type a period later.
        """
        before = self._before
        return before is not None and not half.begins and _equal(before, half)

    def _repeats(self, before: _Half, half: _Half) -> bool:
        """Whether a half is an earlier one once more, passed on twice with others between them."""
        return FRAME_NS <= half.t_ns - before.t_ns < self._pause_ns and _equal(before, half)

    def _pair(self, half: _Half) -> Wrench | None:
        before, self._before = self._before, half
        waited, self._waits = self._waits, False
        owed_ns, self._owed_ns = self._owed_ns, None
        if before is not None and before.kind != half.kind:
            passed_ns = abs(half.t_ns - before.t_ns)
            if before.begins and passed_ns <= self._next_ns:
                self._note_order(before.kind)
            owed = owed_ns is not None and abs(half.t_ns - owed_ns) < self._period_ns
            in_order = waited and before.kind == self._first
            if in_order and passed_ns <= self._pair_ns and not owed:
                return self._joined(before, half)
            self.counters.late += 2 * (in_order and passed_ns > self._pair_ns)
        elif before is not None and waited:
            self._owed_ns = before.t_ns
        self.counters.lone += waited
        self._waits = self._first in (None, half.kind)
        self.counters.lone += not self._waits
        return None

    def _note_order(self, first: int) -> None:
        """A sample came whose first half was of this type."""
        more = self._force_first + (1 if first == StrainType.FORCE else -1)
        self._force_first = max(-ORDER_SAMPLES, min(more, ORDER_SAMPLES))
        if self._first is None or abs(self._force_first) == ORDER_SAMPLES:
            self._first = first

    def _joined(self, first: _Half, second: _Half) -> Wrench | None:
        """Return the sample of two halves; None if it is the last one once more."""
        before, self._sample = self._sample, (first, second)
        if before is not None and all(map(self._repeats, before, self._sample)):
            self.counters.doubled += 2
            return None
        in_order = first.kind == StrainType.FORCE
        force, torque = (first, second) if in_order else (second, first)
        saturated = first.saturated or second.saturated
        self.counters.samples += 1
        self.counters.saturated += saturated
        return Wrench(second.t_ns, force.value, torque.value, saturated)


def _equal(one: _Half, other: _Half) -> bool:
    """Whether two halves are of the same type and have the same values."""
    return (one.kind, one.saturated) == (other.kind, other.saturated) and bool(
        (one.value == other.value).all()
    )
