"""What the boards put on a bus lately, so that what the daemon has can be traced back to it.

The two frames of a triangle's sweep leave its board one after the other, so the two that are close
together in time belong to one sweep. Every byte of a triangle that is reported as valid must come
from one such pair, of a chip that answered.
"""

from collections import deque
from collections.abc import Iterable

from skin_host.bus.wire import HEADER_A, HEADER_B, FrameBatch, MessageClass

#: Frames of one sweep are no further apart; sweeps of a board are.
PAIR_NS = 12_000_000
#: A longer pause separates two sweeps of a board.
BURST_NS = 16_000_000
#: The part of a status word that names an error.
ERROR = 0xF
#: Sweeps of a triangle that are kept.
KEPT = 128
_STREAMS = {int(MessageClass.SKIN_STREAM), int(MessageClass.ANALOG_STREAM)}


class Sent:
    """The last sweeps of every triangle of a bus, as they passed over it.

    Attributes:
        bursts: by address, how many sweeps began.
    """

    def __init__(self) -> None:
        self._half: dict[int, tuple[int, bytes, int]] = {}
        #: By address and triangle: (12 bytes, status, time in ns).
        self._whole: dict[int, deque[tuple[bytes, int, int]]] = {}
        self.bursts: dict[int, int] = {}
        self._last_ns: dict[int, int] = {}

    def note(self, batch: FrameBatch) -> None:
        """Take frames in the order in which they passed, stamped with the robot's time."""
        for seconds, nanoseconds, identifier, dlc, header, payload in batch.frames():
            if identifier >> 8 not in _STREAMS or dlc != 8:
                continue
            key = identifier & 0xFF
            t_ns = seconds * 1_000_000_000 + nanoseconds
            address = key >> 4
            if t_ns - self._last_ns.get(address, -BURST_NS) >= BURST_NS:
                self.bursts[address] = self.bursts.get(address, 0) + 1
            self._last_ns[address] = t_ns
            half = self._half.get(key)
            if half is None or half[0] == header or t_ns - half[2] > PAIR_NS:
                self._half[key] = header, payload, t_ns
                continue
            del self._half[key]
            if header == HEADER_B and half[0] == HEADER_A:
                first, second = half[1], payload
            elif header == HEADER_A and half[0] == HEADER_B:
                first, second = payload, half[1]
            else:
                continue
            whole = self._whole.get(key)
            if whole is None:
                whole = self._whole[key] = deque(maxlen=KEPT)
            whole.append((first + second[:5], second[5] << 8 | second[6], t_ns))

    def find(self, address: int, triangle: int, raw: bytes) -> Iterable[tuple[bool, int]]:
        """Yield, newest first, whether the chip answered and when, of sweeps with these bytes."""
        for sent, status, t_ns in reversed(self._whole.get(address << 4 | triangle, ())):
            if sent == raw:
                yield not status & ERROR, t_ns

    def forget(self) -> None:
        """Count from here."""
        self.bursts = {}
