"""Emulated buses as real `/dev/i2c-N`, through CUSE: a character device served by a process.

Any driver, tool or language that opens an I2C device file works on it: `i2cdetect`,
`i2ctransfer`, an unmodified `smbus2.SMBus(7)`, several programs at once. The kernel's module
`cuse` must be loaded, and opening `/dev/cuse` needs root.

A CUSE server cannot read its callers' memory. It names the areas that it needs, and the request
comes again with their bytes, which is why an I2C_RDWR takes up to four rounds. The kernel moves at
most 128 KiB in one round, so 42 messages of 8192 bytes, legal on real adapters, end in ENOMEM here.
Layouts are those of linux/fuse.h.

`I2cDevice` has the behaviour of the kernel's i2c-dev: it takes requests and returns answers,
without input or output. Its layouts are those of linux/i2c.h and linux/i2c-dev.h (64 bits).
"""

import errno
import os
import select
import struct
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path
from types import TracebackType

from smbus2 import i2c_msg

from emulator.chips.i2c import (
    I2C_M_RD,
    MAX_BLOCK_BYTES,
    MAX_MESSAGE_BYTES,
    MAX_MESSAGES,
    EmulatedSMBus,
)
from skin_host.errors import BusError

#: Address and length of a piece of a caller's memory.
Area = tuple[int, int]

_RDWR_DATA = struct.Struct("=QI4x")
_MESSAGE = struct.Struct("=HHH2xQ")
_SMBUS_DATA = struct.Struct("=BB2xIQ")
#: The largest member of the data union of I2C_SMBUS: a count, 32 bytes, and room for PEC.
_UNION_BYTES = 34


class Ioctl(IntEnum):
    """Commands of linux/i2c-dev.h."""

    RETRIES = 0x0701
    TIMEOUT = 0x0702
    SLAVE = 0x0703
    TENBIT = 0x0704
    FUNCS = 0x0705
    SLAVE_FORCE = 0x0706
    RDWR = 0x0707
    PEC = 0x0708
    SMBUS = 0x0720


class Smbus(IntEnum):
    """Transaction types of I2C_SMBUS."""

    QUICK = 0
    BYTE = 1
    BYTE_DATA = 2
    WORD_DATA = 3
    PROC_CALL = 4
    BLOCK_DATA = 5
    I2C_BLOCK_BROKEN = 6
    BLOCK_PROC_CALL = 7
    I2C_BLOCK_DATA = 8


class MoreMemory(Exception):  # noqa: N818
    """A request must come again with the memory that its `Caller` now names."""


class Caller:
    """The memory of a process that waits in an ioctl, as far as it was handed over.

    Args:
        given: the bytes of all `wanted` areas of the round before, one after another.
        room: bytes that the answer may fill.

    Attributes:
        wanted, reserved: the areas that this round asked for.
    """

    def __init__(self, given: bytes, room: int) -> None:
        self._given = given
        self._room = room
        self._used = 0
        self.wanted: list[Area] = []
        self.reserved: list[Area] = []

    def fetch(self, *areas: Area) -> list[bytes]:
        """The bytes of these areas.

        Raises:
            MoreMemory: they have not been handed over yet, or the answer has no room yet.
        """
        found = []
        for area in areas:
            if area[1]:
                self.wanted.append(area)
            found.append(self._given[self._used : self._used + area[1]])
            self._used += area[1]
        room = sum(length for _, length in self.reserved)
        if self._used > len(self._given) or room > self._room:
            raise MoreMemory
        return found

    def reserve(self, *areas: Area) -> None:
        """Areas that the answer will fill, in this order. The next `fetch` makes sure of them."""
        self.reserved += [area for area in areas if area[1]]


class I2cDevice:
    """One device file `/dev/i2c-N`, opened any number of times.

    Args:
        bus: the bus behind it.
        before_transfer: called before the bus is used, to bring the chips' time up to date.

    Raises:
        OSError: from all requests, with the number that the caller gets to see.
    """

    def __init__(
        self, bus: EmulatedSMBus, before_transfer: Callable[[], None] = lambda: None
    ) -> None:
        self._bus = bus
        self._before_transfer = before_transfer
        self._address: dict[int, int] = {}
        self._opened = 0

    def open(self) -> int:
        """Open the file once more; answers a handle. Each has its own slave address."""
        self._opened += 1
        self._address[self._opened] = 0
        return self._opened

    def release(self, handle: int) -> None:
        self._address.pop(handle, None)

    def read(self, handle: int, length: int) -> bytes:
        """One read message from the slave address."""
        message = i2c_msg.read(self._address[handle], min(length, MAX_MESSAGE_BYTES))
        self._before_transfer()
        self._bus.i2c_rdwr(message)
        return bytes(message)

    def write(self, handle: int, data: bytes) -> int:
        """One write message to the slave address; answers how many bytes were taken."""
        data = data[:MAX_MESSAGE_BYTES]
        self._before_transfer()
        self._bus.i2c_rdwr(i2c_msg.write(self._address[handle], data))
        return len(data)

    def ioctl(self, handle: int, command: int, argument: int, caller: Caller) -> tuple[int, bytes]:
        """One ioctl. Answers its result, and what fills the areas reserved in `caller`."""
        match command:
            case Ioctl.RDWR:
                return self._rdwr(argument, caller)
            case Ioctl.SMBUS:
                return 0, self._smbus(self._address[handle], argument, caller)
            case Ioctl.FUNCS:
                caller.reserve((argument, 8))
                caller.fetch()
                return 0, struct.pack("=Q", self._bus.funcs)
            case Ioctl.SLAVE | Ioctl.SLAVE_FORCE:
                if argument > 0x7F:
                    raise OSError(errno.EINVAL, "not a 7-bit address")
                self._address[handle] = argument
            case Ioctl.TENBIT | Ioctl.PEC:
                if argument:
                    raise OSError(errno.EINVAL, "no 10-bit addresses, no PEC")
            case Ioctl.RETRIES | Ioctl.TIMEOUT:
                pass
            case _:
                raise OSError(errno.ENOTTY, "no such ioctl")
        return 0, b""

    def _rdwr(self, argument: int, caller: Caller) -> tuple[int, bytes]:
        table, count = _RDWR_DATA.unpack(*caller.fetch((argument, _RDWR_DATA.size)))
        if not table or not 0 < count <= MAX_MESSAGES:
            raise OSError(errno.EINVAL, "wanted 1 to 42 messages")
        rows = list(_MESSAGE.iter_unpack(*caller.fetch((table, count * _MESSAGE.size))))
        if any(length > MAX_MESSAGE_BYTES for _, _, length, _ in rows):
            raise OSError(errno.EINVAL, "a message of more than 8192 bytes")
        reads = [(at, length) for _, flags, length, at in rows if flags & I2C_M_RD]
        writes = [(at, length) for _, flags, length, at in rows if not flags & I2C_M_RD]
        caller.reserve(*reads)
        data = iter(caller.fetch(*writes))
        messages = []
        for address, flags, length, _ in rows:
            if flags & I2C_M_RD:
                message = i2c_msg.read(address, length)
            else:
                message = i2c_msg.write(address, next(data))
            message.flags = flags
            messages.append(message)
        self._before_transfer()
        self._bus.i2c_rdwr(*messages)
        return count, b"".join(bytes(one) for one in messages if one.flags & I2C_M_RD)

    def _smbus(self, address: int, argument: int, caller: Caller) -> bytes:
        (header,) = caller.fetch((argument, _SMBUS_DATA.size))
        is_read, command, kind, union = _SMBUS_DATA.unpack(header)
        match kind:
            case Smbus.QUICK:
                length = 0
            case Smbus.BYTE:
                length = 1 if is_read else 0
            case Smbus.BYTE_DATA:
                length = 1
            case Smbus.WORD_DATA | Smbus.PROC_CALL:
                length = 2
            case _:
                length = _UNION_BYTES
        # Block reads bring their length along.
        block = kind in (Smbus.I2C_BLOCK_DATA, Smbus.I2C_BLOCK_BROKEN)
        both_ways = kind == Smbus.PROC_CALL or (is_read and block)
        answered = length if both_ways or is_read else 0
        caller.reserve((union, answered))
        (data,) = caller.fetch((union, length if both_ways or not is_read else 0))
        self._before_transfer()
        return self._command(address, bool(is_read), command, kind, data).ljust(answered, b"\0")

    def _command(self, address: int, is_read: bool, command: int, kind: int, data: bytes) -> bytes:
        """One SMBus transaction; takes and answers the bytes of the data union."""
        bus = self._bus
        if len(data) == _UNION_BYTES and not 0 < data[0] <= MAX_BLOCK_BYTES:
            raise OSError(errno.EINVAL, "a block has 1 to 32 bytes")
        match kind, is_read:
            case Smbus.QUICK, True:
                bus.i2c_rdwr(i2c_msg.read(address, 0))
            case Smbus.QUICK, False:
                bus.write_quick(address)
            case Smbus.BYTE, True:
                return bytes([bus.read_byte(address)])
            case Smbus.BYTE, False:
                bus.write_byte(address, command)
            case Smbus.BYTE_DATA, True:
                return bytes([bus.read_byte_data(address, command)])
            case Smbus.BYTE_DATA, False:
                bus.write_byte_data(address, command, data[0])
            case Smbus.WORD_DATA, True:
                return struct.pack("=H", bus.read_word_data(address, command))
            case Smbus.WORD_DATA, False:
                bus.write_word_data(address, command, *struct.unpack("=H", data))
            case Smbus.PROC_CALL, _:
                (value,) = struct.unpack("=H", data)
                return struct.pack("=H", bus.process_call(address, command, value))
            case Smbus.BLOCK_DATA, False:
                bus.write_block_data(address, command, data[1 : 1 + data[0]])
            case Smbus.I2C_BLOCK_DATA | Smbus.I2C_BLOCK_BROKEN, True:
                # The broken one, of old programs, always asked for 32 bytes.
                length = data[0] if kind == Smbus.I2C_BLOCK_DATA else MAX_BLOCK_BYTES
                return bytes([length, *bus.read_i2c_block_data(address, command, length)])
            case Smbus.I2C_BLOCK_DATA | Smbus.I2C_BLOCK_BROKEN, False:
                bus.write_i2c_block_data(address, command, data[1 : 1 + data[0]])
            case _:
                raise OSError(errno.EOPNOTSUPP, "not on this adapter")
        return b""


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
