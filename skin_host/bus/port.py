"""One CAN bus as a source of `FrameBatch`, with paced sending.

There are two implementations: SocketCAN, read in batches (`socketcan`), and every other interface
that python-can supports (`adapters`). Reading from an open port never raises: an interface that
goes down, disappears or is bus-off is a state, which is counted and logged in one line per change,
and the port waits for it to return.
"""

import asyncio
import errno
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum

import can
import numpy as np

from skin_host.bus.wire import FrameBatch, MessageClass
from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Bus
from skin_host.errors import BusError

log = logging.getLogger(__name__)

#: A port that is not up checks its interface this often.
CHECK_S = 0.25
#: After bus-off the kernel may need this long to report that the carrier is gone.
_CARRIER_S = 1.5
#: A controller that still has many errors reports one within this time.
CALM_S = 10.0
#: A frame that the interface does not take within this time is dropped.
SEND_DEADLINE_S = 1.0
_SEND_RETRY_S = 0.002
#: With these codes a frame was not sent because there is no room for it yet. An error without a
#: code shows no more than that; the last one is of Kvaser's library (canERR_TXBUFOFL).
NO_ROOM = frozenset({None, errno.ENOBUFS, errno.EAGAIN, errno.ETIMEDOUT, -13})
#: An unstable link writes at most one log line in the first of these times, which doubles up to the
#: last.
_QUIET_S = 1.0
_LONGEST_QUIET_S = 60.0

#: A time stamp farther from now than this is none: an uptime or a counter of an adapter, or what
#: whoever sent the frame on this computer asked the kernel for (SO_TXTIME).
PLAUSIBLE_S = 3600

EXTENDED_FLAG = 0x80000000
REMOTE_FLAG = 0x40000000
ERROR_FLAG = 0x20000000
#: Classes of the frames that skin boards and force/torque sensors send.
SKIN_CLASSES = (
    MessageClass.ANALOG_COMMAND,
    MessageClass.ANALOG_STREAM,
    MessageClass.SKIN_STREAM,
    MessageClass.BATTERY_STREAM,
    MessageClass.MANAGEMENT,
)
#: Classes and details of error frames (linux/can/error.h).
_ERROR_CONTROLLER = 0x004
_ERROR_BUS_OFF = 0x040
_ERROR_RESTARTED = 0x100
_CONTROLLER_RX_OVERFLOW = 0x01
_CONTROLLER_PASSIVE = 0x30
_CONTROLLER_ACTIVE = 0x40


def one_line(error: BaseException) -> str:
    """Return the message of a library's error on one line."""
    return (str(error).splitlines() or [type(error).__name__])[0]


class LinkState(StrEnum):
    """State of the interface, as far as it is known."""

    UP = "up"
    #: There are many errors on the wire, but frames still pass.
    ERROR_PASSIVE = "error_passive"
    #: The controller left the bus after too many errors.
    BUS_OFF = "bus_off"
    DOWN = "down"
    #: The device was removed, or its driver failed; the port looks for it under the same name.
    GONE = "gone"


@dataclass(slots=True)
class PortCounters:
    """Counters of a port since it was opened.

    Attributes:
        frames: frames read, error frames included.
        dropped: frames lost because the socket's buffer was full (counted by the kernel).
        damaged: frames that could not be read, and are left out.
        controller_overflows: how often the controller lost frames; it does not report how many.
        buffer_bytes: size of the socket's buffer that was granted, 0 without a socket.
    """

    frames: int = 0
    dropped: int = 0
    damaged: int = 0
    controller_overflows: int = 0
    error_frames: int = 0
    bus_offs: int = 0
    link_downs: int = 0
    removals: int = 0
    reopened: int = 0
    sent: int = 0
    send_retries: int = 0
    buffer_bytes: int = 0


class Port(ABC):
    """An open CAN bus.

    Attributes:
        name: of the bus in the configuration.
        channel: of the interface, e.g. "can0".
        state: of the link, as far as it is known.
        unopened: why it could not be opened when that was last tried; empty where it is open, or
            its device is absent.
        counters: of everything since opening.
        capacity: most frames of one read.
        stamps_late: time stamps may be those of reading or of another process, so a busy computer
            moves them; the kernel's are not.
        on_sent: called with the identifier and the data of each frame that was sent: a bus does not
            return them to the port that sent them.
        see_also: a command that shows more of the interface, for messages.
    """

    capacity: int
    stamps_late = False
    see_also = ""

    def __init__(
        self, name: str, settings: Bus, bus: can.BusABC | None, clock: Clock = SYSTEM
    ) -> None:
        self.name = name
        self._clock = clock
        self.channel = settings.channel
        self.state = LinkState.GONE if bus is None else LinkState.UP
        self.unopened = ""
        self.counters = PortCounters()
        self.on_sent: Callable[[int, bytes], None] = lambda *_: None
        self._settings = settings
        self._bus: can.BusABC | None = bus
        self._send_lock = asyncio.Lock()
        self._reason = ""
        self._logged_state = self.state
        self._told_at_s = -2 * _LONGEST_QUIET_S
        self._quiet_s = _QUIET_S
        self._check_at_s = 0.0
        self._calm_at_s = 0.0

    @abstractmethod
    def read(self) -> FrameBatch:
        """Return the frames that wait, at most the port's capacity. Never blocks or raises.

        The arrays are reused: they are valid until the next read.
        """

    def read_until_ns(self, now_ns: int) -> int:
        """Return up to when everything sent has been read, by a `read` at `now_ns` that left
        nothing.
        """
        return now_ns

    def fileno(self) -> int | None:
        """Return a descriptor that is readable when frames wait, or None; it changes on
        reopening.
        """
        try:
            return self._bus.fileno() if self._bus is not None else None
        except NotImplementedError:
            return None

    async def send(self, frames: Iterable[tuple[int, bytes]], gap_s: float = 0.002) -> None:
        """Send standard data frames, with a pause after each because the boards' mailboxes are
        small.

        Waits while the transmit queue is full.

        Raises:
            BusError: the interface is down or gone, or its queue stayed full.
        """
        async with self._send_lock:
            for identifier, data in frames:
                message = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
                deadline_s = self._clock.monotonic_s() + SEND_DEADLINE_S
                while not await self._try_send(message):
                    if self._clock.monotonic_s() > deadline_s:
                        raise BusError(
                            f'bus "{self.name}": {self.channel}: the transmit queue stayed full '
                            f"for {SEND_DEADLINE_S:g} s; no other node acknowledges: check power, "
                            f"wiring and termination{self.see_also.format(channel=self.channel)}"
                        )
                    self.counters.send_retries += 1
                    await self._clock.sleep(_SEND_RETRY_S)
                self.counters.sent += 1
                self.on_sent(identifier, data)
                await self._clock.sleep(gap_s)

    def close(self) -> None:
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None

    async def _try_send(self, message: can.Message) -> bool:
        where = f'bus "{self.name}": {self.channel}: cannot send'
        if self._bus is None or self.state is LinkState.DOWN:
            raise BusError(f"{where}, {self.state}")
        try:
            await self._hand_over(self._bus, message)
        except Exception as error:
            if isinstance(error, can.CanOperationError) and error.error_code in NO_ROOM:
                return False
            raise BusError(f"{where}: {one_line(error)}") from None
        return True

    async def _hand_over(self, bus: can.BusABC, message: can.Message) -> None:
        """Give the bus a frame to send. Raises what its library raises."""
        bus.send(message)

    def _enter(self, state: LinkState, reason: str = "") -> None:
        """Note and count a change of state."""
        if state is self.state:
            return
        self.state = state
        self.unopened = ""
        self._reason = f" ({reason})" if reason else ""
        match state:
            case LinkState.BUS_OFF:
                self.counters.bus_offs += 1
                # The flags of the interface follow the controller with a delay.
                self._check_at_s = self._clock.monotonic_s() + _CARRIER_S
            case LinkState.DOWN:
                self.counters.link_downs += 1
            case LinkState.GONE:
                self.counters.removals += 1

    def note_unopened(self, error: BaseException) -> None:
        """Note why the bus could not be opened: waiting alone may not help."""
        self.unopened = one_line(error).removeprefix(f'bus "{self.name}": ')

    def _log_state(self) -> None:
        """Log the state if it differs from the last logged one."""
        now_s = self._clock.monotonic_s()
        since_s = now_s - self._told_at_s
        if self.state is self._logged_state or since_s < self._quiet_s:
            return
        calm = since_s >= 2 * _LONGEST_QUIET_S
        self._quiet_s = _QUIET_S if calm else min(2 * self._quiet_s, _LONGEST_QUIET_S)
        log.log(
            logging.INFO if self.state is LinkState.UP else logging.WARNING,
            'bus "%s": %s is %s%s, was %s',
            self.name,
            self.channel,
            self.state,
            self._reason,
            self._logged_state,
        )
        self._logged_state = self.state
        self._told_at_s = now_s

    def _time_to_check(self) -> bool:
        now_s = self._clock.monotonic_s()
        if now_s < self._check_at_s:
            return False
        self._check_at_s = now_s + CHECK_S
        return True

    def _note_errors(self, batch: FrameBatch) -> None:
        """Count a batch's error frames and derive the link's state from them."""
        before = self.counters.error_frames
        for row in np.flatnonzero(batch.id & np.uint32(ERROR_FLAG)).tolist():
            self.counters.error_frames += 1
            error, detail = int(batch.id[row]), int(batch.data[row, 1])
            if error & _ERROR_CONTROLLER:
                self.counters.controller_overflows += detail & _CONTROLLER_RX_OVERFLOW
                if detail & _CONTROLLER_PASSIVE:
                    self._enter(LinkState.ERROR_PASSIVE)
                elif detail & _CONTROLLER_ACTIVE:
                    self._enter(LinkState.UP)
            if error & _ERROR_BUS_OFF:
                self._enter(LinkState.BUS_OFF)
            if error & _ERROR_RESTARTED:
                self._enter(LinkState.UP)
        if self.counters.error_frames != before:
            self._calm_at_s = self._clock.monotonic_s() + CALM_S

    def _note_calm(self) -> None:
        """Note that frames came, and no error: not every driver reports the end of many errors."""
        if self.state is LinkState.ERROR_PASSIVE and self._clock.monotonic_s() > self._calm_at_s:
            self._enter(LinkState.UP)
