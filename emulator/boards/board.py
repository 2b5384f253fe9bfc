"""Common parts of all MTB boards: state, bursts of data frames, identification.

A board is a pure core. `handle` takes a frame from the bus and returns the answers; `advance`
brings it to a time and returns whether its sampling tick has come; `step` does the whole tick.
Robots of many boards take the burst of all boards that are due at once from one `Burst`.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from emulator.boards.arithmetic import TAXELS, Bytes, Ints, Words
from emulator.boards.chip_access import SLOTS, Chips
from skin_host.bus.answers import (
    AdditionalInfo,
    Discovered,
    DiscoveredBootloader,
    FirmwareVersion,
)
from skin_host.bus.commands import BoardType, Discover, Message, Ping
from skin_host.bus.compensation import thermal_gains
from skin_host.bus.wire import TRIANGLES, FrameBatch, MessageClass, encode_values

NS_PER_MS = 1_000_000
INFO_PARTS = 8
#: How long a board stays in its bootloader after a reset (s) before it starts by itself [?].
BOOTLOADER_S = 1.0

Frame = tuple[int, bytes]


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity that a firmware reports."""

    board_type: BoardType
    firmware: tuple[int, int, int]
    protocol: tuple[int, int]


class Mtb(ABC):
    """A board: address, configuration, baseline, and when its next burst is due.

    Attributes:
        address: on the bus, 1..14; survives `reset`, as it is stored.
        next_ns: time of the next sampling tick, or None while there is none.
        version: changes with everything that a `Burst` has gathered.
        triangles: bool[16], which triangles are enabled.
        base: int32[20, 12], raw words of the last calibration, by slot.
    """

    identity: ClassVar[Identity]
    #: Entries of the transmit stack where it is one: newest frame first.
    stack_size: ClassVar[int | None] = None

    def __init__(self, address: int, chips: Chips) -> None:
        self.address = address
        self.chips = chips
        self.info = [b"    "] * INFO_PARTS
        self.version = 0
        self.start_ns = 0
        self._burst: Burst | None = None
        self._burst_version = 0
        self.reset(0)

    @staticmethod
    @abstractmethod
    def arithmetic(
        raw: Words, base: Ints, shift: Ints, no_load: Ints, gain: Ints, thermal: NDArray[np.intp]
    ) -> tuple[Bytes, Words]:
        """Values and status words of k triangles, see `emulator.boards.arithmetic`."""

    @abstractmethod
    def reset(self, t_ns: int) -> None:
        """Restart the application: everything except address and info is forgotten."""

    @abstractmethod
    def handle(self, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        """Take a frame that was on the bus at `t_ns`; return the board's answers."""

    @abstractmethod
    def advance(self, t_ns: int) -> bool:
        """Bring the board to `t_ns`; whether a sampling tick that sends data has come."""

    @property
    @abstractmethod
    def due_ns(self) -> int | None:
        """Return when `advance` must be called next, unless a frame comes before; None is never."""

    @abstractmethod
    def count_no_ack(self, triangles: int) -> None:
        """Count so many triangles of a burst that had taxels without acknowledge."""

    def answers(self) -> list[Frame]:
        """Answers to frames that were queued when they came, and are ready now."""
        return []

    def step(self, t_ns: int) -> FrameBatch:
        """Bring the board to `t_ns` and give the data frames that it sends by then."""
        sent = [self.sample(t_ns)] if self.advance(t_ns) else []
        answers = FrameBatch.of([(can_id, data, t_ns) for can_id, data in self.answers()])
        return join([answers, *sent])

    def sample(self, t_ns: int) -> FrameBatch:
        """Read the chips and make the frames of a sampling tick."""
        if self._burst is None or self._burst_version != self.version:
            self._burst, self._burst_version = Burst([self]), self.version
        return self._burst.frames(self.chips.read()[self._burst.slot], t_ns)

    def slot(self, triangle: int) -> int:
        """The slot of the chip whose values go out as `triangle`."""
        return triangle

    def shift_of(self, triangle: int) -> int:
        """The shift that the arithmetic uses for `triangle`."""
        return int(self.shift[triangle])

    def thermal(self, triangle: int) -> tuple[tuple[int, ...], int]:
        """Temperature gains x128 of a triangle, and the taxel that measures the temperature.

        Source: `computedrift` of embot_app_application_theSkin.cpp.
        """
        return thermal_gains(self.skin_type, triangle)

    @property
    def message_class(self) -> MessageClass:
        """Class of the data frames."""
        return MessageClass.SKIN_STREAM

    @property
    def sends_raw(self) -> bool:
        """Whether the low bytes of the raw words are sent as they are (test mode)."""
        return False

    @property
    def alone(self) -> bool:
        """Whether the board now sends something that a `Burst` of several cannot make."""
        return False

    def _defaults(self, period_ms: float, no_load: int) -> None:
        self.skin_type = 0
        self.no_load = no_load
        self.period_ns = round(period_ms * NS_PER_MS)
        self.triangles = np.ones(TRIANGLES, bool)
        self.shift = np.full(SLOTS, 2, np.int32)
        self.cdc_offset = np.full(SLOTS, 0x2200, np.int32)
        self.base = np.zeros((SLOTS, TAXELS), np.int32)
        self.no_acks = 0
        self.next_ns: int | None = None
        self.version += 1

    def _set_triangles(self, first: int, last: int, *, enabled: bool) -> None:
        self.triangles[first : last + 1] = enabled
        self.version += 1

    def _take_baseline(self) -> None:
        """Store one snapshot of all chips as the zero of every taxel; nothing is averaged."""
        self.base[:] = self.chips.read()
        self.version += 1

    def _discovered(self) -> Message:
        return Discovered(self.identity.board_type, *self.identity.firmware)

    def _obey_in_bootloader(self, command: Message, t_ns: int) -> list[Message]:
        """What the bootloader does instead of the application: it answers FF, and 04 ends it."""
        match command:
            case Discover():
                identity = self.identity
                return [DiscoveredBootloader(identity.board_type, *identity.firmware[:2])]
            case Ping():
                self.reset(t_ns)
        return []

    def _firmware_version(self, *, compatible: bool) -> Message:
        identity = self.identity
        return FirmwareVersion(
            identity.board_type, *identity.firmware, *identity.protocol, int(compatible)
        )

    def _additional_info(self) -> list[Message]:
        return [AdditionalInfo(index, text) for index, text in enumerate(self.info)]


def join(batches: Sequence[FrameBatch]) -> FrameBatch:
    """Batches one after the other as one."""
    batches = [batch for batch in batches if len(batch)] or batches[:1]
    if len(batches) == 1:
        return batches[0]
    return FrameBatch(
        np.concatenate([batch.id for batch in batches]),
        np.concatenate([batch.dlc for batch in batches]),
        np.concatenate([batch.data for batch in batches]),
        np.concatenate([batch.t_ns for batch in batches]),
    )


class Burst:
    """The frames of some boards with the same arithmetic at a tick, gathered once until they
    change.

    Attributes:
        boards: the boards, in the order of their frames.
        board: intp[k], index into `boards` of each enabled triangle.
        slot: intp[k], its chip.
        triangle: intp[k], its number on the bus.
    """

    def __init__(self, boards: Sequence[Mtb]) -> None:
        self.boards = boards
        self._arithmetic = type(boards[0]).arithmetic
        rows = [
            (number, board, int(triangle))
            for number, board in enumerate(boards)
            for triangle in np.flatnonzero(board.triangles)
        ]
        self.board = np.array([number for number, _, _ in rows], np.intp)
        self.triangle = np.array([triangle for _, _, triangle in rows], np.intp)
        self.slot = np.array([board.slot(triangle) for _, board, triangle in rows], np.intp)
        models = [board.thermal(triangle) for _, board, triangle in rows]
        self._base = np.array(
            [board.base[board.slot(triangle)] for _, board, triangle in rows], np.int32
        ).reshape(-1, TAXELS)
        self._shift = np.array([board.shift_of(triangle) for _, board, triangle in rows], np.int32)
        self._no_load = np.array([board.no_load for _, board, _ in rows], np.int32)
        self._gain = np.array([gain for gain, _ in models], np.int32).reshape(-1, TAXELS)
        self._thermal = np.array([taxel for _, taxel in models], np.intp)
        addresses = np.array([board.address for _, board, _ in rows], np.intp)
        test_mode = np.array([board.sends_raw for _, board, _ in rows], bool)
        self._test_mode = test_mode if test_mode.any() else None
        classes = np.array([board.message_class for _, board, _ in rows], np.uint32)
        header = classes << 8 | addresses.astype(np.uint32) << 4
        self._order = self._sending_order()
        ids = np.repeat((header | self.triangle).astype(np.uint32), 2)
        self._ids = ids if self._order is None else ids[self._order]
        self._dlc = np.full(len(ids), 8, np.uint8)
        #: What the arithmetic takes for several sweeps, by how many.
        self._of_sweeps: dict[int, tuple[Ints, Ints, Ints, Ints, NDArray[np.intp]]] = {}

    def _sending_order(self) -> NDArray[np.intp] | None:
        parts = []
        start = 0
        for number, board in enumerate(self.boards):
            n = 2 * int(np.count_nonzero(self.board == number))
            parts.append(start + board_order(board, n))
            start += n
        order = np.concatenate(parts) if parts else np.empty(0, np.intp)
        return None if (np.diff(order) == 1).all() else order

    def frames(self, raw: Words, t_ns: int) -> FrameBatch:
        """The frames that carry `raw`, uint16[k, 12], and the no-acknowledges counted."""
        values, status = self._arithmetic(
            raw, self._base, self._shift, self._no_load, self._gain, self._thermal
        )
        if self._test_mode is not None:
            values[self._test_mode] = raw[self._test_mode] & 0xFF
            status[self._test_mode] = 0
        if status.any() and (status & 1).any():
            silent = np.bincount(self.board[(status & 1).astype(bool)], minlength=len(self.boards))
            for board, count in zip(self.boards, silent, strict=True):
                board.count_no_ack(int(count))
        data = encode_values(values, status)
        if self._order is not None:
            data = data[self._order]
        return self.batch(data, t_ns)

    def batch(self, data: Bytes, t_ns: int) -> FrameBatch:
        """The frames with some contents, uint8[2 k, 8] in the order in which they are sent."""
        return FrameBatch(self._ids, self._dlc, data, np.full(len(data), t_ns, np.int64))

    def contents(self, raw: Words) -> Bytes | None:
        """The contents of the frames of m sweeps, uint8[m, 2 k, 8]; None in the test mode, and if
        a triangle does not acknowledge: its board counts that.

        Args:
            raw: uint16[m, k, 12].
        """
        if self._test_mode is not None:
            return None
        m = len(raw)
        if m not in self._of_sweeps:
            self._of_sweeps[m] = (
                np.tile(self._base, (m, 1)),
                np.tile(self._shift, m),
                np.tile(self._no_load, m),
                np.tile(self._gain, (m, 1)),
                np.tile(self._thermal, m),
            )
        values, status = self._arithmetic(raw.reshape(-1, TAXELS), *self._of_sweeps[m])
        if (status & 1).any():
            return None
        data = encode_values(values, status).reshape(m, -1, 8)
        return data if self._order is None else data[:, self._order]


def board_order(board: Mtb, n: int) -> NDArray[np.intp]:
    """In which order the board's CAN driver sends the `n` frames of a burst."""
    size = board.stack_size
    if size is None:
        return np.arange(n, dtype=np.intp)
    frame = np.arange(n, dtype=np.intp)
    return np.concatenate([frame[at : at + size][::-1] for at in range(0, n, size)] or [frame])
