"""SocketCAN read in batches: one system call for all frames that wait, no allocation per frame.

python-can opens and configures the socket. Its descriptor is then read by recvmmsg(2) into
arrays that live as long as the port, with the kernel's own time stamps (SO_TIMESTAMPNS)
and its count of frames dropped for want of buffer (SO_RXQ_OVFL). See docs/receive.md.
"""

import ctypes
import errno
import fcntl
import logging
import os
import socket
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import numpy as np
from can.typechecking import CanFilter
from numpy.typing import NDArray

from skin_host.bus.interfaces import can_interfaces
from skin_host.bus.port import PLAUSIBLE_S, SKIN_CLASSES, LinkState, Port
from skin_host.bus.wire import NS_PER_S, FrameBatch, Records
from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Bus, Receive
from skin_host.errors import BusError

log = logging.getLogger(__name__)

#: One read takes at most this many frames, 0.13 s of a full bus: a daemon that is late gives its
#: other tasks their turn between two reads, and what was read is still in the processor's cache.
CAPACITY = 1024

# Numbers of Linux that Python 3.11's socket module does not name (asm-generic/socket.h,
# linux/if_arp.h, linux/sockios.h, linux/sock_diag.h).
_SO_RCVBUFFORCE = 33
_SO_RXQ_OVFL = 40
_SO_MEMINFO = 55
_MEMINFO_DROPS = 8
_ARPHRD_CAN = 280
_SIOCGIFFLAGS = 0x8913
_SIOCGIFHWADDR = 0x8927
_IFF_UP = 0x1
_IFF_RUNNING = 0x40

#: What the kernel writes for one frame: the ancillary data, which are a time stamp (struct
#: timespec) and, after the first loss, the drop counter; then struct can_frame (linux/can.h).
_CMSG_HEADER = socket.CMSG_LEN(0)
_LONG_SIZE = struct.calcsize("@l")
_LONG = "q" if _LONG_SIZE == 8 else "i"
_STAMP_SIZE = socket.CMSG_SPACE(struct.calcsize("@ll"))
_CONTROL_SIZE = _STAMP_SIZE + socket.CMSG_SPACE(4)
_FRAME_SIZE = 16
_RECORD_ARRAY = np.dtype(
    {
        "names": ["seconds", "nanoseconds", "dropped", "id", "dlc", "data"],
        "formats": [f"={_LONG}", f"={_LONG}", "=u4", "=u4", "u1", ("u1", 8)],
        "offsets": [
            _CMSG_HEADER,
            _CMSG_HEADER + struct.calcsize(_LONG),
            _STAMP_SIZE + _CMSG_HEADER,
            _CONTROL_SIZE,
            _CONTROL_SIZE + 4,
            _CONTROL_SIZE + 8,
        ],
        "itemsize": _CONTROL_SIZE + _FRAME_SIZE,
    }
)
_RECORD = struct.Struct(
    f"={_CMSG_HEADER}x2{_LONG}{_CONTROL_SIZE - _CMSG_HEADER - 2 * struct.calcsize(_LONG)}xIB3xB7s"
)
#: The byte of a record's identifier that holds the flags.
_FLAGS_AT = _CONTROL_SIZE + (3 if sys.byteorder == "little" else 0)


#: The kernel's, for `skin_only`.
_FILTERS: list[CanFilter] = [
    {"can_id": message_class << 8, "can_mask": 0x700, "extended": False}
    for message_class in SKIN_CLASSES
]

#: struct iovec and struct mmsghdr (recvmmsg(2)); pointers as plain numbers.
_VECTOR = np.dtype([("base", np.uintp), ("length", np.uintp)], align=True)
_MESSAGE = np.dtype(
    [
        ("name", np.uintp),
        ("name_length", np.uint32),
        ("vector", np.uintp),
        ("vectors", np.uintp),
        ("control", np.uintp),
        ("control_length", np.uintp),
        ("flags", np.intc),
    ],
    align=True,
)
_HEADER = np.dtype([("message", _MESSAGE), ("length", np.uintc)], align=True)

_recvmmsg = ctypes.CDLL(None, use_errno=True).recvmmsg
_recvmmsg.argtypes = [
    ctypes.c_int,
    ctypes.c_void_p,
    ctypes.c_uint,
    ctypes.c_int,
    ctypes.c_void_p,
]


class _ReceivedBatch(FrameBatch):
    """The first `n` records as the kernel wrote them; each array is made when it is first read."""

    __slots__ = ("_n", "_octets", "_records")

    def __init__(
        self, n: int, records: NDArray[np.void], octets: NDArray[np.uint8], dropped: int
    ) -> None:
        self._n = n
        self._records = records
        self._octets = octets
        self.dropped = dropped

    def __len__(self) -> int:
        return self._n

    def __getattr__(self, name: str) -> NDArray[Any]:
        """Called once for each array, while its slot is empty."""
        records = self._records[: self._n]
        array: NDArray[Any]
        if name == "t_ns":
            array = records["seconds"].astype(np.int64) * NS_PER_S + records["nanoseconds"]
        elif name in {"id", "dlc", "data"}:
            array = records[name]
        else:
            raise AttributeError(name)
        setattr(self, name, array)
        return array

    @property
    def rising(self) -> bool:
        return True  # the kernel stamps them in this order

    def records(self) -> Records:
        return Records(self._octets[: self._n], _RECORD, _CONTROL_SIZE)


class BatchReceiver:
    """Reads datagrams of 16 bytes, each a `struct can_frame`, many at a time.

    Args:
        sock: a raw CAN socket (or a stand-in that carries the same datagrams) on which
            SO_TIMESTAMPNS is set.
        buffer_bytes: wanted size of the socket's receive buffer.
        capacity: most frames of one read.
    """

    def __init__(self, sock: socket.socket, buffer_bytes: int, capacity: int = CAPACITY) -> None:
        self.buffer_bytes = _grow_buffer(sock, buffer_bytes)
        self._socket = sock
        self._fileno = sock.fileno()
        self._capacity = capacity
        sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        self._dropped = 0
        self._is_stamped = True

        records = np.zeros(capacity, _RECORD_ARRAY)
        vectors = np.zeros(capacity, _VECTOR)
        vectors["base"] = _addresses(records) + np.uintp(_CONTROL_SIZE)
        vectors["length"] = _FRAME_SIZE
        headers = np.zeros(capacity, _HEADER)
        message = headers["message"]
        message["vector"] = _addresses(vectors)
        message["vectors"] = 1
        message["control"] = _addresses(records)
        message["control_length"] = _CONTROL_SIZE
        self._pointed_at = (vectors, headers)
        self._headers = headers.ctypes.data
        self._control_length = message["control_length"]
        self._records = records
        self._seconds = records["seconds"]
        self._octets = records.view(np.uint8).reshape(capacity, _RECORD_ARRAY.itemsize)
        self._flags = self._octets.reshape(-1).data[_FLAGS_AT :: _RECORD_ARRAY.itemsize]

    def read(self) -> FrameBatch:
        """Return the frames that wait, without blocking; the batch is valid until the next read.

        Raises:
            OSError: the socket's pending error, once: the link went down, or the device is gone.
        """
        n: int = _recvmmsg(self._fileno, self._headers, self._capacity, socket.MSG_DONTWAIT, None)
        if n <= 0:
            code = ctypes.get_errno()
            if code not in {errno.EAGAIN, errno.EINTR}:
                raise OSError(code, os.strerror(code))
            n = 0
        # The same for all of a read, but for the drop counter, which comes from the first loss on.
        controlled = int(self._control_length[n - 1]) if n else _STAMP_SIZE
        self._is_stamped = controlled >= _STAMP_SIZE
        dropped = self._newly_dropped(n) if n == 0 or controlled > _STAMP_SIZE else 0
        # The kernel wrote the lengths it used; reset them to the whole buffer for the next read.
        self._control_length[:n] = _CONTROL_SIZE
        return _ReceivedBatch(n, self._records, self._octets, dropped)

    def saw_flags(self, n: int) -> bool:
        """Return whether any of the `n` frames just read is not a standard data frame."""
        return self._flags[:n].tobytes() != bytes(n)

    def replace_stamps(self, n: int, now_ns: int) -> None:
        """Give those of the `n` frames just read the time `now_ns` that have no plausible one."""
        now_s, rest_ns = divmod(now_ns, NS_PER_S)
        seconds = self._seconds[:n]
        if not self._is_stamped:
            seconds[:] = 0
        elif seconds.tobytes() == now_s.to_bytes(_LONG_SIZE, sys.byteorder) * n:
            return  # mostly: one comparison of bytes in place of two passes of NumPy
        elif now_s - PLAUSIBLE_S <= seconds.min() and seconds.max() <= now_s + PLAUSIBLE_S:
            return
        wrong = (seconds < now_s - PLAUSIBLE_S) | (seconds > now_s + PLAUSIBLE_S)
        seconds[wrong] = now_s
        self._records["nanoseconds"][:n][wrong] = rest_ns

    def _newly_dropped(self, n: int) -> int:
        """Return newly dropped frames, by the counter that came with the last frame; the kernel
        sends it only with frames after a loss, so it is queried when no frames arrive.
        """
        if n == 0:
            size = 4 * (_MEMINFO_DROPS + 1)
            memory = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, size)
            counter: int = struct.unpack_from("=I", memory, size - 4)[0]
        else:
            counter = int(self._records["dropped"][n - 1])
        newly = (counter - self._dropped) & 0xFFFFFFFF
        self._dropped = counter
        return newly


def _addresses(array: NDArray[np.void]) -> NDArray[np.uintp]:
    """The address of each element of a contiguous array."""
    first = np.arange(len(array), dtype=np.uintp) * np.uintp(array.itemsize)
    return first + np.uintp(array.ctypes.data)


def _grow_buffer(sock: socket.socket, wanted: int) -> int:
    """Enlarge the receive buffer; beyond net.core.rmem_max this needs CAP_NET_ADMIN."""
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, wanted)
    except PermissionError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted)
    # The kernel doubles the number for its own book-keeping.
    return sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


class SocketCanPort(Port):
    """A SocketCAN interface.

    Args:
        bus: opened; None where the device is absent.
        reopen: returns a new bus when the device is present; raises BusError until then.
    """

    capacity = CAPACITY
    see_also = " (`ip -details -statistics link show {channel}`)"

    def __init__(
        self,
        name: str,
        settings: Bus,
        receive: Receive,
        bus: can.BusABC | None,
        reopen: Callable[[], can.BusABC],
        clock: Clock = SYSTEM,
    ) -> None:
        super().__init__(name, settings, bus, clock)
        self._buffer_bytes = receive.buffer_bytes
        self._reopen = reopen
        self._nothing = FrameBatch.of([])
        if bus is not None:
            self._use(bus)

    def _use(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._socket: socket.socket = bus.socket  # type: ignore[attr-defined]
        self._receiver = BatchReceiver(self._socket, self._buffer_bytes)
        before, granted = self.counters.buffer_bytes, self._receiver.buffer_bytes
        self.counters.buffer_bytes = granted
        # A loose plug opens it again and again.
        if granted < self._buffer_bytes and granted != before:
            log.warning(
                'bus "%s": %s: receive buffer of %d bytes granted, %d wanted; '
                "`sudo sysctl -w net.core.rmem_max=%d` allows it",
                self.name,
                self.channel,
                granted,
                self._buffer_bytes,
                self._buffer_bytes,
            )

    def read(self) -> FrameBatch:
        if self.state is LinkState.GONE:
            self._look_for_device()
            return self._nothing
        try:
            batch = self._receiver.read()
        except OSError as error:
            self._note_failure(error)
            return self._nothing
        n = len(batch)
        self.counters.frames += n
        self.counters.dropped += batch.dropped
        if n:
            self._receiver.replace_stamps(n, self._clock.now_ns())
            if self.state is LinkState.DOWN:
                self._enter(LinkState.UP)
            if self._receiver.saw_flags(n):
                self._note_errors(batch)
            if self.state is LinkState.ERROR_PASSIVE:
                self._note_calm()
        if self.state is not LinkState.UP and self._time_to_check():
            self._check_link()
        if self.state is not self._logged_state:
            self._log_state()
        return batch

    def _note_failure(self, error: OSError) -> None:
        if error.errno == errno.ENETDOWN:
            self._enter(LinkState.DOWN)
        else:
            # After ENODEV (the device was removed) this socket never receives again. For any other
            # error a new socket may help.
            self.close()
            self._enter(LinkState.GONE, os.strerror(error.errno or 0))
        self._time_to_check()
        self._log_state()

    def _check_link(self) -> None:
        """Query the state of the link, because a raw socket gets no notice when it comes up
        again.
        """
        try:
            flags = _ask_interface(self._socket, self.channel, _SIOCGIFFLAGS)
        except OSError:
            return  # being removed: the socket's own error follows
        if not flags & _IFF_UP:
            self._enter(LinkState.DOWN)
        elif flags & _IFF_RUNNING and self.state is not LinkState.ERROR_PASSIVE:
            # A controller that is bus-off has no carrier.
            self._enter(LinkState.UP)

    def _look_for_device(self) -> None:
        if self._time_to_check():
            try:
                self._use(self._reopen())
            except (BusError, OSError) as error:
                # The next check tries again.
                if _interface_exists(self.channel):
                    self.note_unopened(error)
                return
            self.unopened = ""
            self.counters.reopened += 1
            # Whether it is up is known from its flags, or from the first frame.
            self.state = LinkState.DOWN
            self._check_link()
        self._log_state()


def _interface_exists(channel: str) -> bool:
    try:
        socket.if_nametoindex(channel)
    except (OSError, ValueError):  # a name with a zero byte is no string of the system
        return False
    return True


def _ask_interface(sock: socket.socket, channel: str, request: int) -> int:
    """Query 16 bits about a network interface (netdevice(7)); any socket serves for this."""
    answer = fcntl.ioctl(sock.fileno(), request, struct.pack("16s24x", channel.encode()))
    value: int = struct.unpack_from("H", answer, 16)[0]
    return value


def _check_interface(name: str, settings: Bus) -> None:
    """Check an interface before it is opened; the error names the problem and its remedy."""
    channel = settings.channel
    where = f'bus "{name}": {channel}'
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        if not _interface_exists(channel):
            raise BusError(
                f"{where}: no such network interface (CAN interfaces here: "
                f"{', '.join(can_interfaces()) or 'none'}); plug the adapter in, or for a trial "
                f"`sudo ip link add dev {channel} type vcan && sudo ip link set {channel} up`"
            )
        if _ask_interface(sock, channel, _SIOCGIFHWADDR) != _ARPHRD_CAN:
            raise BusError(
                f"{where}: not a CAN interface; `ip -brief link show type can` lists those"
            )
        if not _ask_interface(sock, channel, _SIOCGIFFLAGS) & _IFF_UP:
            # A controller on hardware has a bit rate; vcan and slcan have none.
            hardware = Path("/sys/class/net", channel, "device").exists()
            how = f" type can bitrate {settings.bitrate}" if hardware else ""
            raise BusError(f"{where}: the interface is down; `sudo ip link set {channel} up{how}`")


def open_checked(name: str, settings: Bus) -> can.BusABC:
    """Open an interface that is present, is CAN and is up; see `opening.open_bus`."""
    _check_interface(name, settings)
    return open_present(name, settings)


def open_present(name: str, settings: Bus) -> can.BusABC:
    """Open an interface that is present, up or down.

    Raises:
        BusError: it is absent, or cannot be opened.
    """
    if not _interface_exists(settings.channel):
        # Checked first, because python-can logs an error itself.
        raise BusError(f'bus "{name}": {settings.channel}: no such network interface')
    try:
        return can.Bus(
            interface="socketcan",
            channel=settings.channel,
            ignore_config=True,
            can_filters=_FILTERS if settings.skin_only else None,
            # No board sends frames of CAN FD; they are longer, and would be read as others, cut.
            **(settings.options | {"fd": False}),  # type: ignore[arg-type]
        )
    except OSError as error:
        where = f'bus "{name}": {settings.channel}'
        if error.errno == errno.EAFNOSUPPORT:
            raise BusError(
                f"{where}: this kernel or service has no SocketCAN; `sudo modprobe can-raw`, "
                "or allow AF_CAN (RestrictAddressFamilies=) in the unit"
            ) from None
        if error.errno in {errno.EPERM, errno.EACCES}:
            raise BusError(f"{where}: no permission to open a CAN socket") from None
        raise BusError(f"{where}: cannot be opened: {error.strerror or error}") from None
    except (can.CanError, TypeError, ValueError) as error:
        raise BusError(f'bus "{name}": {settings.channel}: cannot be opened: {error}') from None
