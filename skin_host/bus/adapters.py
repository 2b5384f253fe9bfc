"""Any other interface of python-can (virtual, udp_multicast, slcan, pcan, kvaser ...).

Frames are taken one by one, which costs some microseconds each, and put into the same
arrays as SocketCAN's.
"""

import time
from concurrent.futures import Future, ThreadPoolExecutor

import can
import numpy as np

from skin_host.bus.port import (
    ERROR_FLAG,
    EXTENDED_FLAG,
    REMOTE_FLAG,
    SKIN_CLASSES,
    LinkState,
    Port,
)
from skin_host.bus.protocol import FrameBatch
from skin_host.errors import BusError
from skin_host.settings import Bus

#: One read takes at most so many frames, so that a flood cannot hold the loop.
CAPACITY = 1024
#: A time stamp farther from now than this is an uptime or a counter, not a time of day.
_PLAUSIBLE_S = 3600.0


def nanoseconds(seconds: float) -> int:
    """A time stamp of python-can as integer nanoseconds, to the microsecond.

    Today's seconds in a float resolve 0.24 us, so that only whole microseconds are exact.
    """
    return round(seconds * 1e6) * 1000


def identifier(message: can.Message) -> int:
    """A message's identifier with SocketCAN's flags."""
    return (
        message.arbitration_id
        | message.is_extended_id * EXTENDED_FLAG
        | message.is_remote_frame * REMOTE_FLAG
        | message.is_error_frame * ERROR_FLAG
    )


def one_line(error: Exception) -> str:
    """What a library's error says, in one line."""
    return (str(error).splitlines() or [type(error).__name__])[0]


class AdapterPort(Port):
    """A bus that python-can reads, frame by frame."""

    capacity = CAPACITY

    def __init__(self, name: str, settings: Bus, bus: can.BusABC) -> None:
        super().__init__(name, settings, bus)
        self._opener: ThreadPoolExecutor | None = None
        self._opening: Future[can.BusABC] | None = None
        self._id = np.zeros(CAPACITY, np.uint32)
        self._dlc = np.zeros(CAPACITY, np.uint8)
        self._data = np.zeros((CAPACITY, 8), np.uint8)
        self._t_ns = np.zeros(CAPACITY, np.int64)

    def read(self) -> FrameBatch:
        """See `Port.read`."""
        n = 0
        errors = False
        if self._bus is None:
            self._look_for_device()
        else:
            try:
                for _ in range(CAPACITY):
                    message = self._bus.recv(0)
                    if message is None:
                        break
                    if self._wanted(message):
                        self._put(n, message)
                        errors |= message.is_error_frame
                        n += 1
            except (can.CanError, OSError) as error:
                self._note_failure(error)
        self.counters.frames += n
        batch = FrameBatch(self._id[:n], self._dlc[:n], self._data[:n], self._t_ns[:n])
        if errors:
            self._note_errors(batch)
        if self.state is not self._told:
            self._tell()
        return batch

    def close(self) -> None:
        """See `Port.close`."""
        super().close()
        if self._opener is not None:
            self._opener.shutdown(wait=False, cancel_futures=True)
            self._opener = None

    def _wanted(self, message: can.Message) -> bool:
        # python-can's own filters are not used: with one set, `recv(0)` gives None for a frame
        # that does not pass, as if no other waited.
        if message.is_fd:
            return False
        return (
            not self._settings.skin_only
            or message.is_error_frame
            or (not message.is_extended_id and message.arbitration_id >> 8 in SKIN_CLASSES)
        )

    def _put(self, row: int, message: can.Message) -> None:
        self._id[row] = identifier(message)
        self._dlc[row] = message.dlc
        self._data[row, : len(message.data)] = message.data
        now_s = time.time()
        stamp_s = message.timestamp
        if abs(stamp_s - now_s) > _PLAUSIBLE_S:
            stamp_s = now_s
        self._t_ns[row] = nanoseconds(stamp_s)

    def _note_failure(self, error: Exception) -> None:
        try:
            super().close()
        except (can.CanError, OSError):
            self._bus = None
        self._enter(LinkState.GONE, one_line(error))
        self._time_to_check()

    def _look_for_device(self) -> None:
        """Try to open the interface again, in a thread: serial adapters take seconds."""
        if self._opening is None:
            if self._time_to_check():
                if self._opener is None:
                    self._opener = ThreadPoolExecutor(1, f"open-{self.name}")
                self._opening = self._opener.submit(open_bus, self.name, self._settings)
        elif self._opening.done():
            opening, self._opening = self._opening, None
            if opening.exception() is None:
                self._bus = opening.result()
                self.counters.reopened += 1
                self._enter(LinkState.UP)


def open_bus(name: str, settings: Bus) -> can.BusABC:
    """See `port.open_bus`."""
    options = {"bitrate": settings.bitrate} | settings.options
    where = f'bus "{name}": {settings.interface} {settings.channel}'
    if settings.interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise BusError(f"{where}: python-can has no such interface; it has {known}")
    try:
        return can.Bus(
            interface=settings.interface,
            channel=settings.channel,
            ignore_config=True,
            **options,  # type: ignore[arg-type]
        )
    except Exception as error:
        # Each adapter's library has errors of its own; to the user they are all one.
        raise BusError(f"{where}: cannot be opened: {one_line(error)}") from None
