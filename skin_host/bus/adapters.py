"""Port for every other interface of python-can (virtual, udp_multicast, slcan, pcan, kvaser ...).

Frames are read one by one, which costs some microseconds each, into the same arrays as SocketCAN's.
What an adapter's library may wait in for ever (opening, sending, closing) is done in a thread.
"""

import asyncio
import logging
import os
import select
import socket
from collections.abc import Mapping
from concurrent.futures import Future
from concurrent.futures import wait as wait_for
from importlib.util import find_spec

import can
import numpy as np

from skin_host.bus.port import (
    ERROR_FLAG,
    EXTENDED_FLAG,
    NO_ROOM,
    PLAUSIBLE_S,
    REMOTE_FLAG,
    SEND_DEADLINE_S,
    SKIN_CLASSES,
    LinkState,
    Port,
    one_line,
)
from skin_host.bus.stamps import Reads, Stamps
from skin_host.bus.wire import MAX_EXTENDED_ID, FrameBatch
from skin_host.clock import SYSTEM, Clock, Executor
from skin_host.config.settings import Bus
from skin_host.errors import BusError, ConfigurationError

#: One read takes at most this many frames, so that a flood cannot block the event loop.
CAPACITY = 1024
MULTICAST = "udp_multicast"
SOCKETCAND = "socketcand"
#: They take a frame at once, or never, and stamp it by this computer's clock.
AT_ONCE = ("virtual", MULTICAST)
#: Their error frames have the kernel's classes and details. Those of other libraries mean other
#: things by the same bits, such as the kind and the place of a bit error.
KERNELS_ERRORS = frozenset({"virtual", MULTICAST, SOCKETCAND, "gs_usb", "serial"})
#: What so many times in a row could not be read shows that the library does not get past it.
MOST_UNREADABLE = 8
#: A serial adapter's line is shorter than this; noise never ends one.
LONGEST_LINE = 4096
#: Their libraries stamp a frame when they are asked for it.
STAMPED_WHEN_READ = frozenset({"iscan", "neousys", "robotell", "seeedstudio", "slcan"})
#: Their libraries read a serial line byte by byte, and wait for each that has not come yet,
#: whatever time they are given.
OF_BYTES = frozenset({"seeedstudio", "serial", "slcan"})
#: Their libraries number adapters, and take no text for a number.
NUMBERED = frozenset({"gs_usb", "neousys"})
#: The time of day was set where it has moved so much more than the time since the computer's start.
CLOCK_SET_NS = 100_000_000
#: Opening may take so long: a serial adapter takes 2 s. Closing is waited for this long.
OPEN_S = 5.0
CLOSE_S = 1.0
#: A server of buses greets within this time.
GREETING_S = 2.0
#: If its computer answers nothing for so long, the connection has failed.
VANISHED_S = 5
#: Extras of python-can, by the interface that needs one.
_EXTRAS = {
    "canalystii": "canalystii",
    "cantact": "cantact",
    "gs_usb": "gs-usb",
    "neovi": "neovi",
    "robotell": "serial",
    "seeedstudio": "seeedstudio",
    "serial": "serial",
    "slcan": "serial",
}
#: Stands for a frame that the adapter's library could not read.
_UNREADABLE = can.Message()
#: Options of Linux sockets (in.h, in6.h) that Python does not name.
IP_MULTICAST_ALL = 49
IPV6_MULTICAST_ALL = 29

# Its errors are raised too, and reported in a line; of its own lines, some are tracebacks, and
# others come ten thousand times a second.
logging.getLogger("can").setLevel(logging.CRITICAL)


def nanoseconds(seconds: float) -> int:
    """Convert a time stamp of python-can to integer nanoseconds, to the microsecond.

    A float of today's seconds resolves 0.24 us, so that only whole microseconds are exact.
    """
    return round(seconds * 1e6) * 1000


def identifier(message: can.Message) -> int:
    """Return a message's identifier with SocketCAN's flags.

    An error frame has no format, whatever the adapter's library makes of that, and may have the
    flag in its number already.

    Raises:
        ValueError: it is no identifier.
    """
    number = message.arbitration_id
    if message.is_error_frame:
        return number & MAX_EXTENDED_ID | ERROR_FLAG
    if not 0 <= number <= MAX_EXTENDED_ID:
        raise ValueError(f"an identifier of {hex(number)[:40]}")
    return (
        number
        | bool(message.is_extended_id) * EXTENDED_FLAG
        | bool(message.is_remote_frame) * REMOTE_FLAG
    )


class AdapterPort(Port):
    """A bus that python-can reads, frame by frame.

    Args:
        name, settings, clock: see `Port`.
        bus: None if it is not open.
        worker: the thread for what may block, if there is one already.
        opening: what it is opening, if the bus is awaited.
    """

    capacity = CAPACITY
    stamps_late = True

    def __init__(
        self,
        name: str,
        settings: Bus,
        bus: can.BusABC | None,
        clock: Clock = SYSTEM,
        worker: Executor | None = None,
        opening: Future[can.BusABC] | None = None,
    ) -> None:
        super().__init__(name, settings, bus, clock)
        self._worker = worker
        self._opening = opening
        self._opening_since_s = self._clock.monotonic_s()
        self._unreadable = 0
        self._stamps = Stamps()
        self._reads = Reads()
        self._unstamped = 0
        self._started_at_ns = self._now_started_at_ns()
        self._id = np.zeros(CAPACITY, np.uint32)
        self._dlc = np.zeros(CAPACITY, np.uint8)
        self._data = np.zeros((CAPACITY, 8), np.uint8)
        self._t_ns = np.zeros(CAPACITY, np.int64)

    def read(self) -> FrameBatch:
        n = 0
        errors = False
        self._unstamped = 0
        emptied_ns: int | None = None
        before_ns, self._started_at_ns = self._started_at_ns, self._now_started_at_ns()
        if self._started_at_ns - before_ns >= CLOCK_SET_NS:
            self._stamps.clock_set((self._started_at_ns - before_ns) * 1e-9)
        if self._bus is None:
            self._look_for_device()
        else:
            try:
                line = self._line_of_bytes()
                for _ in range(CAPACITY):
                    waits = None if line is None else _waits(line)
                    message = None if waits is False else self._receive(self._bus)
                    if message is None and waits:
                        continue  # an acknowledgement, noise, or the begin of a frame
                    if message is None:
                        emptied_ns = self._clock.now_ns()
                        break
                    if self._put(n, message):
                        errors |= bool(message.is_error_frame)
                        n += 1
                unread = getattr(self._bus, "_buffer", None)
                if isinstance(unread, bytearray) and len(unread) > LONGEST_LINE:
                    raise BusError("what it sends is no line of an adapter")
            except (can.CanError, OSError, BusError) as error:
                self._note_failure(error)
        self.counters.frames += n
        batch = FrameBatch(self._id[:n], self._dlc[:n], self._data[:n], self._t_ns[:n])
        if n:
            self.stamps_late = self._settings.interface in AT_ONCE or self._unstamped > 0
        if n == self._unstamped:
            self._reads.date(batch.id, batch.data[:, 0], batch.t_ns)
        if emptied_ns is not None:
            self._stamps.note_empty(emptied_ns * 1e-9)
            self._reads.note_empty(emptied_ns)
        if errors:
            self._note_errors(batch)
        elif n:
            self._note_calm()
        if self.state is not self._logged_state:
            self._log_state()
        return batch

    def _now_started_at_ns(self) -> int:
        """Return the time of day at which this computer was started, by the present clock."""
        return self._clock.now_ns() - self._clock.since_boot_ns()

    def _note_calm(self) -> None:
        # Not every adapter reports the end of this, and over multicast anybody can send an error.
        if self.state is LinkState.BUS_OFF:
            self._enter(LinkState.UP)
        super()._note_calm()

    def close(self) -> None:
        if (closing := self._shut_down()) is not None:
            wait_for([closing], CLOSE_S)
        if self._worker is not None:
            self._worker.close()
            self._worker = None

    async def _hand_over(self, bus: can.BusABC, message: can.Message) -> None:
        if self._settings.interface in AT_ONCE:
            bus.send(message)
            return
        sending = self._in_order().submit(bus.send, message)
        try:
            async with self._clock.timeout(SEND_DEADLINE_S):
                await asyncio.wrap_future(sending)
        except TimeoutError:
            if sending.done() and not sending.cancelled():
                raise  # the library's own
            why = f"it has taken no frame for {SEND_DEADLINE_S:g} s"
            if self._bus is bus:
                self._note_failure(BusError(why))
                self._worker = None  # it may wait for ever
            raise BusError(why) from None
        except (can.CanError, OSError) as error:
            # A library may read the end of a connection, or an adapter that was unplugged, as no
            # frame: only sending shows it.
            if self._bus is bus and _is_failure(error):
                self._note_failure(error)
            raise

    def _in_order(self) -> Executor:
        """Return the thread for what may block."""
        if self._worker is None:
            self._worker = self._clock.executor(f"adapter-{self.name}")
        return self._worker

    def _shut_down(self) -> "Future[None] | None":
        """Begin to close the bus, after what is being sent."""
        bus, self._bus = self._bus, None
        return None if bus is None else self._in_order().submit(bus.shutdown)

    def _receive(self, bus: can.BusABC) -> can.Message | None:
        """Return the next frame, `_UNREADABLE` in place of a damaged one, or None.

        Raises:
            can.CanError, OSError: the adapter is gone, or its library does not get past something.
        """
        try:
            message = bus.recv(0)
        except OSError:
            raise
        except Exception as error:
            # A library fails over damaged bytes in its own ways: with the error of a number, of a
            # text, or with one of python-can that these caused. Without a cause, or with that of
            # the system, it is the adapter that fails. Everybody in the network may send datagrams,
            # whose content shows nothing about the socket.
            cause = error.__cause__
            is_can = isinstance(error, can.CanError)
            if self._settings.interface == MULTICAST:
                if is_can and isinstance(cause, OSError):
                    raise
                return _UNREADABLE
            self._unreadable += 1
            if is_can and (cause is None or isinstance(cause, OSError)):
                raise
            if self._unreadable >= MOST_UNREADABLE:
                raise can.CanError(one_line(error)) from cause
            return _UNREADABLE
        if message is not None:
            self._unreadable = 0
        return message

    def _line_of_bytes(self) -> "select.poll | None":
        """Return what shows whether a byte of a serial line waits; None of other adapters, and
        where that is not known.
        """
        descriptor = self.fileno() if self._settings.interface in OF_BYTES else None
        if descriptor is None or descriptor < 0:
            return None
        line = select.poll()
        line.register(descriptor, select.POLLIN)
        return line

    def _wanted(self, message: can.Message) -> bool:
        # python-can's own filters are not used: with a filter, `recv(0)` returns None for a frame
        # that does not pass, even if others wait.
        # Some libraries return what was sent, too.
        if message.is_fd or not message.is_rx:
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
            if len(message.data) != message.dlc and not message.is_remote_frame:
                raise ValueError("a frame that was cut")
            self._id[row] = identifier(message)
            if message.is_error_frame and self._settings.interface not in KERNELS_ERRORS:
                self._id[row] = ERROR_FLAG
            self._dlc[row] = message.dlc
            # Nothing of an earlier frame remains behind this one's bytes.
            self._data[row] = bytearray(message.data).ljust(8, b"\0")
        except (TypeError, ValueError, OverflowError):  # cut; numbers of other types, out of range
            self.counters.damaged += 1
            return False
        now_ns = self._clock.now_ns()
        time_s = self._time_of(message, now_ns * 1e-9)
        self._unstamped += time_s is None
        self._t_ns[row] = now_ns if time_s is None else nanoseconds(time_s)
        return True

    def _time_of(self, message: can.Message, now_s: float) -> float | None:
        """Return when a frame came; None if no more is known than that it is read now."""
        if self._settings.interface in STAMPED_WHEN_READ:
            return None
        if self._settings.interface not in AT_ONCE:
            return self._stamps.here(message.timestamp, now_s)
        is_time = abs(message.timestamp - now_s) <= PLAUSIBLE_S
        return message.timestamp if is_time else now_s

    def _note_failure(self, error: Exception) -> None:
        self._shut_down()
        self._unreadable = 0
        # What caused it is one sentence; what a library makes of that may be a traceback.
        self._enter(LinkState.GONE, one_line(error.__cause__ or error))
        self._time_to_check()

    def _look_for_device(self) -> None:
        """Try to open the interface again, in a thread: serial adapters take seconds."""
        if self._opening is None:
            if self._time_to_check():
                self._opening = self._in_order().submit(open_bus, self.name, self._settings)
                self._opening_since_s = self._clock.monotonic_s()
        elif self._opening.done():
            opening, self._opening = self._opening, None
            error = opening.exception()
            if error is not None:
                self.note_unopened(error)
                return
            self._bus = opening.result()
            self._stamps = Stamps()  # its clock may have begun again
            self.counters.reopened += 1
            self._enter(LinkState.UP)
        elif not self.unopened and self._clock.monotonic_s() - self._opening_since_s >= OPEN_S:
            self.note_unopened(no_answer(self.name, self._settings))


def _is_failure(error: Exception) -> bool:
    """Whether an error of sending is that of the adapter, or of its connection: it does not only
    lack room, as on a bus where no node acknowledges.
    """
    code = error.errno if isinstance(error, OSError) else getattr(error, "error_code", None)
    if code is None and isinstance(error.__cause__, OSError):
        code = error.__cause__.errno
    return isinstance(error, ConnectionError) or code not in NO_ROOM


def _waits(line: "select.poll") -> bool:
    """Return whether a byte of a line waits to be read.

    Raises:
        BusError: the adapter is gone. Not each library shows that.
    """
    events = sum(event for _, event in line.poll(0))
    if events & (select.POLLHUP | select.POLLERR):
        raise BusError("it was unplugged")
    return events != 0


def no_answer(name: str, settings: Bus) -> BusError:
    """Return the error of an interface whose library has been opening it for too long."""
    where = f'bus "{name}": {settings.interface} {settings.channel}'
    return BusError(f"{where}: has not answered for {OPEN_S:g} s: check its plug and power")


def open_bus(name: str, settings: Bus) -> can.BusABC:
    options = {"bitrate": settings.bitrate} | settings.options
    channel, numbered = settings.channel, settings.interface in NUMBERED
    where = f'bus "{name}": {settings.interface} {settings.channel}'
    if settings.interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise ConfigurationError(f"{where}: python-can has no such interface; it has {known}")
    try:
        if settings.interface == MULTICAST:
            # Without, `recv(0)` returns None for a frame of CAN FD, even if others wait.
            options["fd"] = True
        if settings.interface == SOCKETCAND and {"host", "port"} <= options.keys():
            # As text, its client would try to connect for 10 s, at full load, and then again.
            options["port"] = int(str(options["port"]))
            _await_greeting(options)
        if settings.interface == MULTICAST:
            from skin_host.bus.multicast import MulticastBus

            bus: can.BusABC = MulticastBus(settings.channel, **options)  # type: ignore[arg-type]
            _leave_other_groups(bus, settings.channel)
        elif settings.interface == SOCKETCAND:
            from skin_host.bus.served import ServedBus

            bus = ServedBus(settings.channel, **options)  # type: ignore[no-untyped-call]
            _fail_if_it_vanishes(bus)
        else:
            bus = can.Bus(
                interface=settings.interface,
                channel=int(channel) if numbered and channel.isdecimal() else channel,
                ignore_config=True,
                **options,  # type: ignore[arg-type]
            )
    except Exception as error:
        # Each adapter's library has its own errors; the user gets one kind.
        why = one_line(error)
        absent = ""
        if settings.interface == MULTICAST and find_spec("msgpack") is None:
            why, absent = "the package msgpack is not installed", "skin-host[multicast]"
        elif isinstance(error, can.CanInterfaceNotImplementedError | ImportError):
            extra = _EXTRAS.get(settings.interface)
            absent = f"python-can[{extra}]" if extra else ""
        elif isinstance(error, TypeError):  # of its arguments, which are these
            why += f"; python-can's {settings.interface} takes them from [buses.{name}.options]"
        elif isinstance(error, NameError):  # python-can then lacks its functions
            why = "the library of its maker is not installed"
        elif settings.interface == MULTICAST and isinstance(error.__cause__, OSError):
            why += f": {error.__cause__.strerror}; wanted a multicast address, and a route to it"
        if absent:
            why += f"; mend it with: pip install '{absent}'"
        raise BusError(f"{where}: cannot be opened: {why}") from None
    return bus


def _await_greeting(options: Mapping[str, object]) -> None:
    """See whether a server of buses answers.

    python-can's client tries to connect for 10 s without a pause, and waits for answers for ever.

    Raises:
        OSError: it does not.
    """
    host, port = str(options["host"]), int(str(options["port"]))
    with socket.create_connection((host, port), GREETING_S) as server:
        if not server.recv(16).startswith(b"< hi"):
            raise OSError("what listens there is no socketcand")


def _fail_if_it_vanishes(bus: can.BusABC) -> None:
    """Let the connection to a server of buses fail if its computer is cut off or loses its power.

    Otherwise nothing fails: TCP waits for an answer to what was sent for a quarter of an hour, and
    for the next frame for ever.
    """
    # python-can gives no other access to it. Where a version has none, the connection stays as it
    # is.
    connection = getattr(bus, "_SocketCanDaemonBus__socket", None)
    if isinstance(connection, socket.socket):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 1)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
        # In milliseconds; it holds for what was sent and for probes, however many these are.
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, VANISHED_S * 1000)


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
