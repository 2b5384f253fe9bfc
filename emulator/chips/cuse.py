"""Emulated buses as real `/dev/i2c-N`, through CUSE: a character device served by a process.

Any driver, tool or language that opens an I2C device file works on it: `i2cdetect`,
`i2ctransfer`, an unmodified `smbus2.SMBus(7)`, several programs at once. The kernel's module
`cuse` must be loaded, and opening `/dev/cuse` needs root.

A CUSE server cannot read its callers' memory. It names the areas that it needs, and the request
comes again with their bytes, which is why an I2C_RDWR takes up to four rounds. The kernel moves at
most 128 KiB in one round, so 42 messages of 8192 bytes, legal on real adapters, end in ENOMEM here.
Layouts are those of linux/fuse.h.
"""

import errno
import os
import select
import struct
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path
from types import TracebackType

from emulator.chips.i2c import MAX_MESSAGE_BYTES, EmulatedSMBus
from emulator.chips.i2c_dev import Area, Caller, I2cDevice, MoreMemory
from skin_host.errors import BusError

_IN_HEADER = struct.Struct("=IIQ24x")
_OUT_HEADER = struct.Struct("=IiQ")
_INIT_IN = struct.Struct("=II8x")
_INIT_OUT = struct.Struct("=8I40x")
_HANDLE = struct.Struct("=Q")
_OPEN_OUT = struct.Struct("=QI4x")
#: Both read and write: handle, offset, size, three more words.
_READ_WRITE_IN = struct.Struct("=Q8xI20x")
_WRITE_OUT = struct.Struct("=I4x")
_IOCTL_IN = struct.Struct("=QIIQII")
_IOCTL_OUT = struct.Struct("=iIII")
_AREA = struct.Struct("=QQ")

_UNRESTRICTED_IOCTL = 1
_IOCTL_RETRY = 4
_IOCTL_32BIT = 8
#: The newest revision of the protocol with the layouts above.
_NEWEST_MINOR = 31
_LARGEST_REQUEST = 1 << 18
_CUSE = Path("/dev/cuse")
_START_S = 10.0


class _Opcode(IntEnum):
    OPEN = 14
    READ = 15
    WRITE = 16
    RELEASE = 18
    INTERRUPT = 36
    IOCTL = 39
    INIT = 4096


def answer(device: I2cDevice, request: bytes, name: str) -> bytes | None:
    """Answer one request of the kernel; None where it expects no answer.

    Args:
        device: what stands behind the device file.
        request: one message as read from /dev/cuse.
        name: of the device file, without /dev/.
    """
    _, opcode, unique = _IN_HEADER.unpack_from(request)
    if opcode == _Opcode.INTERRUPT:
        return None  # every request is answered at once, so there is nothing to interrupt
    error, payload = 0, b""
    try:
        payload = _perform(device, opcode, request[_IN_HEADER.size :], name)
    except OSError as refused:
        error = -(refused.errno or errno.EIO)
    return _OUT_HEADER.pack(_OUT_HEADER.size + len(payload), error, unique) + payload


def _perform(device: I2cDevice, opcode: int, body: bytes, name: str) -> bytes:
    match opcode:
        case _Opcode.INIT:
            major, minor = _INIT_IN.unpack_from(body)
            limits = (MAX_MESSAGE_BYTES, MAX_MESSAGE_BYTES)
            # Device numbers 0, 0: the kernel chooses.
            numbers = (min(minor, _NEWEST_MINOR), 0, _UNRESTRICTED_IOCTL, *limits, 0, 0)
            return _INIT_OUT.pack(major, *numbers) + f"DEVNAME={name}".encode() + b"\0"
        case _Opcode.OPEN:
            return _OPEN_OUT.pack(device.open(), 0)
        case _Opcode.RELEASE:
            device.release(*_HANDLE.unpack_from(body))
            return b""
        case _Opcode.READ:
            return device.read(*_READ_WRITE_IN.unpack_from(body))
        case _Opcode.WRITE:
            handle, size = _READ_WRITE_IN.unpack_from(body)
            data = body[_READ_WRITE_IN.size :][:size]
            return _WRITE_OUT.pack(device.write(handle, data))
        case _Opcode.IOCTL:
            return _ioctl(device, body)
    raise OSError(errno.ENOSYS, "not here")


def _ioctl(device: I2cDevice, body: bytes) -> bytes:
    handle, flags, command, argument, _, room = _IOCTL_IN.unpack_from(body)
    if flags & _IOCTL_32BIT:
        raise OSError(errno.ENOTTY, "a 32-bit program has other layouts")
    caller = Caller(body[_IOCTL_IN.size :], room)
    try:
        result, data = device.ioctl(handle, command, argument, caller)
    except MoreMemory:
        areas: list[Area] = caller.wanted + caller.reserved
        counts = len(caller.wanted), len(caller.reserved)
        head = _IOCTL_OUT.pack(0, _IOCTL_RETRY, *counts)
        return head + b"".join(_AREA.pack(*area) for area in areas)
    return _IOCTL_OUT.pack(result, 0, 0, 0) + data


class CuseBus:
    """A bus as `/dev/i2c-<number>`, for as long as the object is open.

    Someone has to call `handle` whenever `fileno` is readable: an event loop's reader, or
    `serve`.

    Args:
        number: N of /dev/i2c-N.
        bus: the emulated bus.
        before_transfer: called before the bus is used, to bring the chips' time up to date.

    Raises:
        BusError: no CUSE in the kernel, no right to it, or the number is taken.
    """

    def __init__(
        self,
        number: int,
        bus: EmulatedSMBus,
        before_transfer: Callable[[], None] = lambda: None,
    ) -> None:
        self.path = Path(f"/dev/i2c-{number}")
        self._device = I2cDevice(bus, before_transfer)
        if self.path.exists():
            raise BusError(f"{self.path}: there already; choose another number")
        try:
            self._fd = os.open(_CUSE, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except FileNotFoundError:
            raise BusError(f"{_CUSE}: not there; load it as root: modprobe cuse") from None
        except OSError as error:
            raise BusError(f"{_CUSE}: {error.strerror}; only root may make devices") from None
        try:
            # The kernel's first request asks for the name; its device exists with our answer.
            asked = select.select([self._fd], [], [], _START_S)[0] and self.handle()
            if not asked or not self.path.exists():
                raise BusError(f"{_CUSE}: the kernel did not make {self.path}")
        except BaseException:
            os.close(self._fd)
            raise

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return self._fd

    def handle(self) -> bool:
        """Answer one request, if there is one; False once the kernel has dropped the device."""
        try:
            request = os.read(self._fd, _LARGEST_REQUEST)
            reply = answer(self._device, request, self.path.name)
            if reply is not None:
                os.write(self._fd, reply)
        except (BlockingIOError, InterruptedError, FileNotFoundError):
            return True  # taken back by its caller before it was read or answered
        except OSError as error:
            if error.errno == errno.ENODEV:
                return False
            raise
        return True

    def serve(self, wake: int | None = None) -> None:
        """Answer requests until the descriptor `wake` is readable, or the device is dropped."""
        watched = [self._fd] if wake is None else [self._fd, wake]
        while True:
            readable, _, _ = select.select(watched, [], [])
            if wake in readable or not self.handle():
                return

    def close(self) -> None:
        """Take the device away; programs that hold it open get errors."""
        os.close(self._fd)

    def __enter__(self) -> "CuseBus":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
