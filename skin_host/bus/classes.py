"""Which frames of a bus are of skin: in which message classes its boards send their A and B frames.

Most boards send both in the class of the stream. Older firmware sends both in the legacy class, one
special firmware its B frames in another. Other sensors use these two classes as well, so that a
frame there is of skin only if its board may send in that class.
"""

from collections import Counter
from dataclasses import dataclass

from skin_host.bus.wire import (
    HEADER_A,
    HEADER_B,
    MAIS_TYPES,
    MAX_STANDARD_ID,
    TRIANGLES,
    MessageClass,
)

#: In which classes a board sends its A and its B frames, by the class that shows it: the stream,
#: the legacy stream, and a special firmware, whose A frames are as those of the stream.
_CLASSES: dict[int, tuple[MessageClass, MessageClass]] = {
    MessageClass.SKIN_STREAM: (MessageClass.SKIN_STREAM, MessageClass.SKIN_STREAM),
    MessageClass.ANALOG_STREAM: (MessageClass.ANALOG_STREAM, MessageClass.ANALOG_STREAM),
    MessageClass.BATTERY_STREAM: (MessageClass.SKIN_STREAM, MessageClass.BATTERY_STREAM),
}
#: By the header of a frame, its half.
_HALVES = {HEADER_A: 0, HEADER_B: 1}
_SMALLEST_DLC_B = 6
#: A board that has sent nothing for so many periods may send in the legacy class from then on. It
#: pauses for fewer while it zeroes itself.
_LEFT_PERIODS = 10
#: A board may be of the special firmware once so many sweeps in succession had A frames alone; of
#: the first ones, one is enough.
_WITHOUT_B_SWEEPS = 3


@dataclass(slots=True)
class FrameCounters:
    """Counts the frames of a bus, and those that are not of a configured triangle."""

    frames: int = 0
    #: Frames outside the skin stream, as answers, other sensors and unconfigured nodes, also those
    #: at a board's address in a class in which it does not send, and skin frames of boards that
    #: others read.
    other: int = 0
    #: Of the configured force/torque boards.
    force_torque: int = 0
    wrong_header: int = 0
    short: int = 0
    #: Skin frames of a board that is not configured on this bus.
    unknown_board: int = 0
    #: Skin frames of a triangle that is not configured.
    unknown_triangle: int = 0


@dataclass(slots=True)
class BoardClasses:
    """In which classes a board sends.

    Attributes:
        address: of the board.
        triangles: mask of those that are configured.
        period_ns: of its sweeps.
        halves: classes of its A and of its B frames.
        without_b: sweeps in succession that had A frames alone.
    """

    address: int
    triangles: int
    period_ns: int
    halves: tuple[MessageClass, MessageClass] = _CLASSES[MessageClass.SKIN_STREAM]
    without_b: int = _WITHOUT_B_SWEEPS - 1

    def slots(self) -> list[tuple[int, int, int]]:
        """Return (identifier << 8 | header, triangle, half) of each frame of a sweep."""
        return [
            ((self.halves[half] << 8 | self.address << 4 | triangle) << 8 | header, triangle, half)
            for triangle in range(TRIANGLES)
            if self.triangles >> triangle & 1
            for header, half in _HALVES.items()
        ]

    def note_sweep(self, *, has_b: bool) -> None:
        """Note whether B frames came of a sweep."""
        self.without_b = 0 if has_b else self.without_b + 1

    def may_be_of(self, identifier: int, half: int, quiet_ns: int, *, has_b: bool) -> bool:
        """Return whether a frame of this class, which other sensors use too, may be of the board.

        Nothing else sends in the class of the stream. So a board that does so is of the special
        firmware only if all its B frames are missing there, and of the legacy stream only if
        nothing comes there.

        Args:
            identifier: of the frame.
            half: of its form.
            quiet_ns: for how long the board has sent nothing.
            has_b: whether a B frame of its sweep in progress came.
        """
        message_class = identifier >> 8
        if message_class in (self.halves[half], MessageClass.SKIN_STREAM):
            return True
        if message_class == MessageClass.ANALOG_STREAM:
            return quiet_ns > _LEFT_PERIODS * self.period_ns
        return (
            self.halves[0] == MessageClass.SKIN_STREAM
            and self.without_b >= _WITHOUT_B_SWEEPS
            and not has_b
        )

    def change_to(self, message_class: int) -> None:
        """The board sends as a frame in this class shows."""
        self.halves = _CLASSES[message_class]


class FrameForms:
    """Finds and counts what has the form of a configured board's frame.

    Args:
        counters: of the bus.
        boards: addresses of the configured boards that are read here.
        others: addresses of those that another node reads.
        force_torque: identifiers of the data of the configured force/torque boards.

    Attributes:
        unconfigured: frames of the skin stream by address of a board that is not configured.
        elsewhere: how many of the other frames are of boards that another node reads.
    """

    def __init__(
        self,
        counters: FrameCounters,
        boards: frozenset[int],
        others: frozenset[int],
        force_torque: frozenset[int],
    ) -> None:
        self.unconfigured: Counter[int] = Counter()
        self.elsewhere = 0
        self._counters = counters
        self._boards = boards
        self._others = others
        self._force_torque = force_torque

    def half_of(self, identifier: int, dlc: int, header: int) -> int | None:
        """Return the half of which a frame has the form, 0 for A and 1 for B; None if it has none,
        or that of a board that is not read here, and is counted.
        """
        counters = self._counters
        message_class = identifier >> 8
        is_skin = message_class == MessageClass.SKIN_STREAM
        half = _HALVES.get(header)
        if identifier in self._force_torque:
            counters.force_torque += 1
        elif dlc == 0 or identifier > MAX_STANDARD_ID:
            counters.other += 1
        elif is_skin and half is None:
            counters.wrong_header += 1
        elif is_skin and dlc < (_SMALLEST_DLC_B if half else 8):
            counters.short += 1
        elif (
            half is None
            or message_class not in _CLASSES
            or message_class != _CLASSES[message_class][half]
            # Other sensors use the legacy class too, most with fewer bytes.
            or (dlc < 8 and not is_skin)
        ):
            counters.other += 1
        elif (address := identifier >> 4 & 0xF) in self._boards:
            return half
        elif address in self._others:
            counters.other += 1
            self.elsewhere += 1
        elif message_class == MessageClass.ANALOG_STREAM and identifier & 0xF in MAIS_TYPES:
            # A frame of joints may have the form of one of skin.
            counters.other += 1
        else:
            counters.unknown_board += 1
            self.unconfigured[address] += 1
        return None
