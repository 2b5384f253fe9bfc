"""Buses of emulated chips behind smbus2's interface, with the faults of real wires.

A driver written for `smbus2.SMBus` runs on an `EmulatedSMBus` unchanged: it takes smbus2's own
`i2c_msg` objects, keeps the kernel's limits and raises the kernel's errors. A bus moves no
clock: transfers happen at one instant, and the time they would have taken is added up in
`busy_ns` for whoever schedules the bus's master. Over a faulty line (`emulator.chips.i2c_wire`)
messages go bit by bit, as an adapter sends them that checks the clock and acknowledges.
"""

import ctypes
import errno
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress

from smbus2 import I2cFunc, SMBus, i2c_msg

from emulator.chips.i2c_wire import BitMaster, Chip, I2cWire

FIRST_ADDRESS = 0x2C
CHIPS_PER_LINE = 4

I2C_M_RD = 0x0001
#: Limits of the kernel's I2C_RDWR.
MAX_MESSAGES = 42
MAX_MESSAGE_BYTES = 8192
MAX_BLOCK_BYTES = 32
#: Plain I2C, and what SMBus commands can be made of it; no PEC, no block reads.
FUNCTIONALITY = 0x0EFF0001
#: How long the adapter waits for a clock that a chip holds: the default of the kernel's i2c-gpio.
PATIENCE_NS = 100_000_000


def line_and_address(position: int) -> tuple[int, int]:
    """Where the chip of a triangle sits: (line, 7-bit address); position 16..19 is line 4.

    Boards drive one clock and four data lines (newer ones five); triangle t is at address
    0x2C + t % 4 of line t // 4.
    """
    line, offset = divmod(position, CHIPS_PER_LINE)
    return line, FIRST_ADDRESS + offset


def build_lines(
    chips: Sequence[Chip | None] | I2cWire, clock_hz: float = 400e3
) -> list["EmulatedSMBus"]:
    """The data lines of one board, four of them or five if there are more than 16 chips.

    Args:
        chips: the chip of each position of `line_and_address`, None where there is none; or the
            wire that has them.
        clock_hz: clock of all lines.
    """
    if isinstance(chips, I2cWire):
        wire = chips
    else:
        n_lines = max(4, -(-len(chips) // CHIPS_PER_LINE))
        on_line: list[dict[int, Chip]] = [{} for _ in range(n_lines)]
        for position, chip in enumerate(chips):
            if chip is not None:
                line, address = line_and_address(position)
                on_line[line][address] = chip
        wire = I2cWire(on_line)
    return [EmulatedSMBus(wire, line, clock_hz=clock_hz) for line in range(len(wire.lines))]


class EmulatedSMBus(SMBus):
    """An `smbus2.SMBus` with emulated adapter and chips.

    Args:
        chips: chip by 7-bit address; the mapping is kept, so chips can come and go. Or the wire
            of a board, of which this bus is a data line.
        line: which one.
        clock_hz: bus clock, for `busy_ns`.

    Attributes:
        line: the data line, which has the chips and the faults.
        wire: it and the clock, for masters that bang bits.
        busy_ns: time that all transfers so far would have taken.
        transfers, failures: how many there were, and how many of them failed.

    Raises:
        OSError: from transfers, as a kernel adapter would. ENXIO: nobody acknowledges the
            address. EREMOTEIO: a data byte is not acknowledged. ETIMEDOUT: the data line or the
            clock is held low; the adapter then gives nine clocks and a STOP, as the kernel's
            recovery does. EINVAL: more than 42 messages, none, or one of more than 8192 bytes.
            EOPNOTSUPP: a message flag or SMBus command that the adapter does not have. Which
            error an adapter chooses for a missing acknowledge varies [M].
    """

    def __init__(
        self,
        chips: Mapping[int, Chip] | I2cWire,
        line: int = 0,
        *,
        clock_hz: float = 400e3,
    ) -> None:
        super().__init__(None)
        self.funcs = I2cFunc(FUNCTIONALITY)
        self.wire = chips if isinstance(chips, I2cWire) else I2cWire([chips])
        self.line = self.wire.lines[line]
        self.busy_ns = 0
        self.transfers = 0
        self.failures = 0
        self._bit_ns = 1e9 / clock_hz
        self._master = BitMaster(
            self.wire, 1 << line, patience_ns=PATIENCE_NS, half_ns=round(self._bit_ns / 2)
        )
        self._number = line

    def open(self, bus: object) -> None:
        """Nothing to open: the bus is in this process."""

    def close(self) -> None:
        """Nothing to close."""

    # ------------------------------------------------------------------ transfers

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        """One transaction: repeated START between the messages, one STOP at the end."""
        if not 0 < len(i2c_msgs) <= MAX_MESSAGES:
            raise _os_error(errno.EINVAL)
        for message in i2c_msgs:
            if message.len > MAX_MESSAGE_BYTES:
                raise _os_error(errno.EINVAL)
            if message.flags & ~I2C_M_RD:
                raise _os_error(errno.EOPNOTSUPP)
        self.transfers += 1
        try:
            if self.line.faulty:
                self._bang(i2c_msgs)
            else:
                self._pass(i2c_msgs)
        except OSError:
            self.failures += 1
            raise

    def _pass(self, messages: Sequence[i2c_msg]) -> None:
        """A transaction over a line without faults."""
        bits = 1  # STOP
        try:
            for message in messages:
                # START, address byte with its acknowledge, then the data.
                bits += 10 + 9 * message.len
                self._transfer(message)
        finally:
            self.busy_ns += round(bits * self._bit_ns)

    def _transfer(self, message: i2c_msg) -> None:
        length = message.len
        chip = self.line.chips.get(message.addr)
        if chip is None:
            raise _os_error(errno.ENXIO)
        if message.flags & I2C_M_RD:
            ctypes.memmove(message.buf, chip.read(length), length)
        elif chip.write(ctypes.string_at(message.buf, length)) < length:
            raise _os_error(errno.EREMOTEIO)

    def _bang(self, messages: Sequence[i2c_msg]) -> None:
        """A transaction bit by bit."""
        start_ns = self.wire.t_ns
        try:
            for message in messages:
                self._bang_one(message)
            self._master.stop()
        except OSError as error:
            if error.errno == errno.ETIMEDOUT:
                with suppress(OSError):
                    self._master.recover()
            else:
                self._master.stop()
            raise
        finally:
            self.busy_ns += self.wire.t_ns - start_ns

    def _bang_one(self, message: i2c_msg) -> None:
        master, length, reads = self._master, message.len, message.flags & I2C_M_RD
        master.start()
        if not master.put(message.addr << 1 | reads):
            raise _os_error(errno.ENXIO)
        if reads:
            # The chip sends its first byte whether it is wanted or not.
            taken = [
                master.get(acknowledge=at < length - 1)[self._number]
                for at in range(max(length, 1))
            ]
            ctypes.memmove(message.buf, bytes(taken[:length]), length)
        elif not all(master.put(byte) for byte in ctypes.string_at(message.buf, length)):
            raise _os_error(errno.EREMOTEIO)

    # ------------------------------------------------------------------ SMBus commands
    #
    # What the kernel's i2c_smbus_xfer_emulated does on an adapter that only knows messages.

    def _write(self, address: int, data: Sequence[int]) -> None:
        self.i2c_rdwr(i2c_msg.write(address, data))

    def _write_read(self, address: int, data: Sequence[int], length: int) -> list[int]:
        answer = i2c_msg.read(address, length)
        self.i2c_rdwr(i2c_msg.write(address, data), answer)
        return list(bytes(answer))

    def write_quick(self, i2c_addr: int, force: bool | None = None) -> None:
        """Address the chip and stop."""
        self._write(i2c_addr, [])

    def read_byte(self, i2c_addr: int, force: bool | None = None) -> int:
        """Read one byte, without a command."""
        answer = i2c_msg.read(i2c_addr, 1)
        self.i2c_rdwr(answer)
        return bytes(answer)[0]

    def write_byte(self, i2c_addr: int, value: int, force: bool | None = None) -> None:
        """Write one byte."""
        self._write(i2c_addr, [value])

    def read_byte_data(self, i2c_addr: int, register: int, force: bool | None = None) -> int:
        """Write a command byte, read one byte."""
        return self._write_read(i2c_addr, [register], 1)[0]

    def write_byte_data(
        self, i2c_addr: int, register: int, value: int, force: bool | None = None
    ) -> None:
        """Write a command byte and one byte."""
        self._write(i2c_addr, [register, value])

    def read_word_data(self, i2c_addr: int, register: int, force: bool | None = None) -> int:
        """Write a command byte, read a little-endian word."""
        low, high = self._write_read(i2c_addr, [register], 2)
        return low | high << 8

    def write_word_data(
        self, i2c_addr: int, register: int, value: int, force: bool | None = None
    ) -> None:
        """Write a command byte and a little-endian word."""
        self._write(i2c_addr, [register, value & 0xFF, value >> 8 & 0xFF])

    def process_call(
        self, i2c_addr: int, register: int, value: int, force: bool | None = None
    ) -> int:
        """Write a command byte and a word, read a word."""
        low, high = self._write_read(i2c_addr, [register, value & 0xFF, value >> 8 & 0xFF], 2)
        return low | high << 8

    def read_i2c_block_data(
        self, i2c_addr: int, register: int, length: int, force: bool | None = None
    ) -> list[int]:
        """Write a command byte, read up to 32 bytes."""
        _check_block(length)
        return self._write_read(i2c_addr, [register], length)

    def write_i2c_block_data(
        self, i2c_addr: int, register: int, data: Sequence[int], force: bool | None = None
    ) -> None:
        """Write a command byte and up to 32 bytes."""
        _check_block(len(data))
        self._write(i2c_addr, [register, *data])

    def write_block_data(
        self, i2c_addr: int, register: int, data: Sequence[int], force: bool | None = None
    ) -> None:
        """Write a command byte, a count and up to 32 bytes."""
        _check_block(len(data))
        self._write(i2c_addr, [register, len(data), *data])

    def read_block_data(self, i2c_addr: int, register: int, force: bool | None = None) -> list[int]:
        """Not supported: an adapter without I2C_M_RECV_LEN cannot take the length from the chip."""
        raise _os_error(errno.EOPNOTSUPP)

    def block_process_call(
        self, i2c_addr: int, register: int, data: Sequence[int], force: bool | None = None
    ) -> list[int]:
        """Not supported, as `read_block_data`."""
        raise _os_error(errno.EOPNOTSUPP)


def _check_block(length: int) -> None:
    if length > MAX_BLOCK_BYTES:
        raise ValueError(f"an SMBus block has at most {MAX_BLOCK_BYTES} bytes, not {length}")


def _os_error(number: int) -> OSError:
    return OSError(number, os.strerror(number))
