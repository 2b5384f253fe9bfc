"""Port for every other interface of python-can (virtual, udp_multicast, slcan, pcan, kvaser ...).

Frames are read one by one, which costs some microseconds each, into the same arrays as SocketCAN's.
"""

import os
import socket
from concurrent.futures import Future
from importlib.util import find_spec

import can
import numpy as np

from skin_host.bus.port import (
    ERROR_FLAG,
    EXTENDED_FLAG,
    PLAUSIBLE_S,
    REMOTE_FLAG,
    SKIN_CLASSES,
    LinkState,
    Port,
)
from skin_host.bus.wire import FrameBatch
from skin_host.clock import SYSTEM, Clock, Executor
from skin_host.config.settings import Bus
from skin_host.errors import BusError, ConfigurationError

#: One read takes at most this many frames, so that a flood cannot block the event loop.
CAPACITY = 1024
#: A controller that still has many errors reports one within this time.
CALM_S = 10.0
MULTICAST = "udp_multicast"
#: Stands for a frame that the adapter's library could not read.
_UNREADABLE = can.Message()
#: Options of Linux sockets (in.h, in6.h) that Python does not name.
IP_MULTICAST_ALL = 49
IPV6_MULTICAST_ALL = 29


def nanoseconds(seconds: float) -> int:
    """Convert a time stamp of python-can to integer nanoseconds, to the microsecond.

    A float of today's seconds resolves 0.24 us, so that only whole microseconds are exact.
    """
    return round(seconds * 1e6) * 1000


def identifier(message: can.Message) -> int:
    """Return a message's identifier with SocketCAN's flags."""
    return (
        message.arbitration_id
        | bool(message.is_extended_id) * EXTENDED_FLAG
        | bool(message.is_remote_frame) * REMOTE_FLAG
        | bool(message.is_error_frame) * ERROR_FLAG
    )


def one_line(error: Exception) -> str:
    """Return the message of a library's error on one line."""
    return (str(error).splitlines() or [type(error).__name__])[0]


class AdapterPort(Port):
    """A bus that python-can reads, frame by frame."""

    capacity = CAPACITY
    stamps_late = True

    def __init__(
        self, name: str, settings: Bus, bus: can.BusABC | None, clock: Clock = SYSTEM
    ) -> None:
        super().__init__(name, settings, bus, clock)
        self._opener: Executor | None = None
        self._opening: Future[can.BusABC] | None = None
        self._calm_at_s = 0.0
        self._id = np.zeros(CAPACITY, np.uint32)
        self._dlc = np.zeros(CAPACITY, np.uint8)
        self._data = np.zeros((CAPACITY, 8), np.uint8)
        self._t_ns = np.zeros(CAPACITY, np.int64)

    def read(self) -> FrameBatch:
        n = 0
        errors = False
        if self._bus is None:
            self._look_for_device()
        else:
            try:
                for _ in range(CAPACITY):
                    message = self._receive(self._bus)
                    if message is None:
                        break
                    if self._put(n, message):
                        errors |= bool(message.is_error_frame)
                        n += 1
            except (can.CanError, OSError) as error:
                self._note_failure(error)
        self.counters.frames += n
        batch = FrameBatch(self._id[:n], self._dlc[:n], self._data[:n], self._t_ns[:n])
        if errors:
            self._note_errors(batch)
            self._calm_at_s = self._clock.monotonic_s() + CALM_S
        elif n and self._is_over():
            self._enter(LinkState.UP)
        if self.state is not self._logged_state:
            self._log_state()
        return batch

    def _is_over(self) -> bool:
        """Whether a bus that receives has left the state that error frames reported.

        Not every adapter reports the end, and over multicast anybody can send an error frame.
        """
        if self.state is LinkState.ERROR_PASSIVE:
            return self._clock.monotonic_s() > self._calm_at_s
        return self.state is LinkState.BUS_OFF

    def close(self) -> None:
        super().close()
        if self._opener is not None:
            self._opener.close()
            self._opener = None

    def _receive(self, bus: can.BusABC) -> can.Message | None:
        """Return the next frame, `_UNREADABLE` in place of a damaged one, or None."""
        try:
            return bus.recv(0)
        except can.CanOperationError as error:
            # Everybody in the network may send datagrams. Their content shows nothing about the
            # socket, whose own failures are caused by an OSError.
            if self._settings.interface != MULTICAST or isinstance(error.__cause__, OSError):
                raise
            return _UNREADABLE

    def _wanted(self, message: can.Message) -> bool:
        # python-can's own filters are not used: with a filter, `recv(0)` returns None for a frame
        # that does not pass, even if others wait.
        if message.is_fd:
            return False
        return (
            not self._settings.skin_only
            or message.is_error_frame
            or (not message.is_extended_id and message.arbitration_id >> 8 in SKIN_CLASSES)
        )

    def _put(self, row: int, message: can.Message) -> bool:
        """Write a frame into a row of the batch; return whether it is wanted and readable."""
        try:
            if message is _UNREADABLE or not self._wanted(message):
                self.counters.damaged += message is _UNREADABLE
                return False
            self._id[row] = identifier(message)
            self._dlc[row] = message.dlc
            self._data[row, : len(message.data)] = message.data
        except (TypeError, ValueError, OverflowError):  # numbers of other types, out of range
            self.counters.damaged += 1
            return False
        now_s = self._clock.now_ns() * 1e-9
        stamp_s = message.timestamp
        if not abs(stamp_s - now_s) <= PLAUSIBLE_S:
            stamp_s = now_s
        self._t_ns[row] = nanoseconds(stamp_s)
        return True

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
                    self._opener = self._clock.executor(f"open-{self.name}")
                self._opening = self._opener.submit(open_bus, self.name, self._settings)
        elif self._opening.done():
            opening, self._opening = self._opening, None
            if opening.exception() is None:
                self._bus = opening.result()
                self.counters.reopened += 1
                self._enter(LinkState.UP)


def open_bus(name: str, settings: Bus) -> can.BusABC:
    options = {"bitrate": settings.bitrate} | settings.options
    where = f'bus "{name}": {settings.interface} {settings.channel}'
    if settings.interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise ConfigurationError(f"{where}: python-can has no such interface; it has {known}")
    try:
        bus = can.Bus(
            interface=settings.interface,
            channel=settings.channel,
            ignore_config=True,
            **options,  # type: ignore[arg-type]
        )
    except Exception as error:
        # Each adapter's library has its own errors; the user gets one kind.
        why = one_line(error)
        if settings.interface == MULTICAST and find_spec("msgpack") is None:
            why = "the package msgpack is not installed; mend it with: "
            why += "pip install 'skin-host[multicast]'"
        raise BusError(f"{where}: cannot be opened: {why}") from None
    if settings.interface == MULTICAST:
        _leave_other_groups(bus, settings.channel)
    return bus


def _leave_other_groups(bus: can.BusABC, group: str) -> None:
    """Receive what is sent to this bus's own group alone.

    By default Linux delivers each group that any program of the machine has joined to every
    socket of the port, so that one bus would carry the frames of all others.
    """
    family = socket.AF_INET6 if ":" in group else socket.AF_INET
    level = socket.IPPROTO_IPV6 if family == socket.AF_INET6 else socket.IPPROTO_IP
    option = IPV6_MULTICAST_ALL if family == socket.AF_INET6 else IP_MULTICAST_ALL
    # A copy of the descriptor: the socket itself belongs to python-can.
    with socket.socket(family, socket.SOCK_DGRAM, fileno=os.dup(bus.fileno())) as copy:
        copy.setsockopt(level, option, 0)
