"""The emulator's side of a python-can bus, and a single board that lives on one.

A board on real chips and a real bus makes an MTB of a single-board computer.
"""

import errno
import logging
from collections.abc import Iterator, Sequence
from contextlib import ExitStack

import can
import numpy as np
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.virtual import VirtualBus
from numpy.typing import NDArray
from smbus2 import SMBus

from emulator.boards.chip_access import CHIPS_PER_LINE, SLOTS
from emulator.boards.mtb import I2cChips, make_board
from emulator.clock import EmulatedTime, RealClock
from skin_host.bus.pair import PairBus
from skin_host.bus.port import one_line
from skin_host.bus.wire import FrameBatch, MessageClass
from skin_host.errors import RequestError

log = logging.getLogger(__name__)

LONGEST_DATA = 8
#: Codes of the system for an interface that is no more, and for the end of a connection to a server
#: of buses.
_ENDED = {
    errno.ENODEV,
    errno.ENXIO,
    errno.EPIPE,
    errno.ECONNABORTED,
    errno.ECONNRESET,
    errno.ENOTCONN,
    errno.ETIMEDOUT,
}
#: Boards act on commands only, which come from address 0: class and sender of an identifier.
_COMMANDS = {
    message_class << 4 for message_class in (MessageClass.ANALOG_COMMAND, MessageClass.MANAGEMENT)
}
#: The same for the kernel, so that it wakes the process only for these.
_FILTERS: list[can.typechecking.CanFilter] = [
    {"can_id": command << 4, "can_mask": 0x7F0, "extended": False} for command in _COMMANDS
]
#: How often the bus is looked at for commands.
POLL_NS = 2_000_000
#: Frames that are read at once: boards live on while others send without end.
MOST_READS = 10_000
#: Frames kept for a controller that does not take them now.
WAITING_FRAMES = 2000
#: Data lines of a board.
MOST_LINES = SLOTS // CHIPS_PER_LINE


class BoardLink:
    """Sends the frames of boards, and returns the commands of a host.

    Attributes:
        shows_pauses: the host is shown up to when the boards have lived; on other buses it cannot
            distinguish a pause of this process from silence.
        sent, lost: frames that the bus took, and that it did not (too slow, down, bus-off).
    """

    def __init__(self, name: str, bus: can.BusABC) -> None:
        self._name = name
        self._bus = bus
        if isinstance(bus, SocketcanBus):
            # python-can's own filters are not used: with one set, `recv(0)` gives None for a frame
            # that does not pass, as if no other waited.
            bus.set_filters(_FILTERS)
        if isinstance(bus, VirtualBus):
            # A frame is stamped when its board sent it, as by a kernel, not when this process got
            # the processor to pass it on.
            bus.preserve_timestamps = True
        self.shows_pauses = isinstance(bus, PairBus)
        self._waiting: list[can.Message] = []
        self._failing = False
        self.sent = 0
        self.lost = 0

    def received(self) -> Iterator[tuple[int, bytes]]:
        """Commands that have come since the last call: identifier and data."""
        for _ in range(MOST_READS):
            try:
                message = self._bus.recv(timeout=0)
            except Exception as error:
                if _is_damage(error):
                    continue
                self._complain(error)
                return
            if message is None:
                return
            # By multicast anybody may send numbers of other types.
            is_frame = isinstance(message.arbitration_id, int) and (
                len(message.data) == message.dlc <= LONGEST_DATA
            )
            is_other = message.is_remote_frame or message.is_error_frame or message.is_fd
            if not is_frame or is_other or message.is_extended_id:
                continue
            if message.arbitration_id >> 4 in _COMMANDS:
                yield message.arbitration_id, bytes(message.data)

    def send(
        self, batch: FrameBatch, host_ns: NDArray[np.int64], until_ns: int | None = None
    ) -> None:
        """Send frames in their order; frames that the controller does not take wait, or are lost.

        Args:
            batch: the frames.
            host_ns: when they are sent, int64[n], in the host's time of day.
            until_ns: up to when all frames have now been sent, by the same clock.
        """
        if isinstance(self._bus, PairBus):
            lost = self._bus.send_batch(batch, host_ns, until_ns)
            self.lost += lost
            self.sent += len(batch) - lost
            return
        messages = self._waiting + [
            can.Message(
                timestamp=t_ns * 1e-9,
                arbitration_id=can_id,
                data=data[:dlc].tobytes(),
                dlc=dlc,
                is_extended_id=False,
            )
            for can_id, dlc, data, t_ns in zip(
                batch.id.tolist(),
                batch.dlc.tolist(),
                batch.data,
                host_ns.tolist(),
                strict=True,
            )
        ]
        self._waiting = []
        for number, message in enumerate(messages):
            try:
                self._bus.send(message)
            except (can.CanError, OSError) as error:
                self._complain(error)
                rest = messages[number:]
                self._waiting = rest[:WAITING_FRAMES]
                self.lost += len(rest) - len(self._waiting)
                return
            self.sent += 1
        self._failing = False

    def _complain(self, error: Exception) -> None:
        if not self._failing:
            # What caused it is one sentence; what a library makes of that may be a traceback.
            cause = error.__cause__ or error
            ends = "frames wait or are lost until it works"
            if {getattr(error, "error_code", None), getattr(cause, "errno", None)} & _ENDED:
                ends = "start the emulator again when it is back"
            log.warning("bus %s: %s; %s", self._name, one_line(cause), ends)
        self._failing = True


def _is_damage(error: Exception) -> bool:
    """Whether a library failed over what came, in one of its ways, and not over its bus."""
    if isinstance(error, can.CanError):
        cause = error.__cause__
        return cause is not None and not isinstance(cause, OSError)
    return not isinstance(error, OSError)


def open_lines(devices: str, opened: ExitStack) -> list[SMBus]:
    """Open the data lines of a board of real chips.

    Args:
        devices: of I2C, such as "/dev/i2c-1,/dev/i2c-2".
        opened: closes them.

    Raises:
        RequestError: none is named, or more than a board has.
        OSError: one cannot be opened; the error names it.
    """
    paths = [path.strip() for path in devices.split(",")]
    if not all(paths) or len(paths) > MOST_LINES:
        raise RequestError(
            f'--i2c: seen "{devices}", wanted 1 to {MOST_LINES} devices such as '
            "/dev/i2c-1,/dev/i2c-2"
        )
    lines = []
    for path in paths:
        try:
            lines.append(opened.enter_context(SMBus(path)))
        except OSError as error:
            error.filename = path
            raise
    return lines


async def run_board(
    model: str,
    address: int,
    lines: Sequence[SMBus],
    bus: can.BusABC,
    clock: EmulatedTime | None = None,
) -> None:
    """Be a board made of a single-board computer, until cancelled: the firmware on real chips.

    Args:
        model: "mtb3", "mtb4" or "mtb4c".
        address: CAN address, 1..14.
        lines: its I2C buses, one for each data line of a board: triangle t is the chip at
            0x2C + t % 4 of line t // 4. A computer with one bus has triangles 0 to 3.
        bus: an open python-can bus.
        clock: time to live in; the machine's own, if not given. Chips that are real live in
            real time.

    Raises:
        ValueError: there is no such model.
    """
    clock = clock or RealClock()
    board = make_board(model, address, I2cChips(lines))
    link = BoardLink(f"of board {address}", bus)
    while True:
        now_ns = clock.now_ns()
        for can_id, data in link.received():
            answers = board.handle(can_id, data, now_ns)
            batch = FrameBatch.of([(answer, payload, now_ns) for answer, payload in answers])
            link.send(batch, clock.host_ns(batch.t_ns))
        batch = board.step(now_ns)
        link.send(batch, clock.host_ns(batch.t_ns))
        due_ns = now_ns + POLL_NS if board.due_ns is None else min(board.due_ns, now_ns + POLL_NS)
        await clock.sleep_until_ns(due_ns)
