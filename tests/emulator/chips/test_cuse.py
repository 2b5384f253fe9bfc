"""The device file's side of CUSE, with the kernel's side played by a few lines here."""

import errno
import struct

import pytest

from emulator.chips.ad7147 import AD7147
from emulator.chips.cuse import CuseBus, I2cDevice, answer
from emulator.chips.i2c import EmulatedSMBus
from skin_host.errors import BusError

I2C_SLAVE, I2C_FUNCS, I2C_RDWR, I2C_SMBUS = 0x0703, 0x0705, 0x0707, 0x0720
OPEN, READ, WRITE, RELEASE, INTERRUPT, IOCTL, INIT = 14, 15, 16, 18, 36, 39, 4096
RETRY = 4


class Kernel:
    """A kernel with one program: `memory` is the program's."""

    def __init__(self, *addresses, **arguments):
        self.bus = EmulatedSMBus({address: AD7147() for address in addresses})
        self.device = I2cDevice(self.bus, **arguments)
        self.memory = bytearray(1 << 20)
        self.rounds = 0
        self._unique = 0

    def send(self, opcode, body):
        self._unique += 1
        header = struct.pack("=IIQQIIII", 40 + len(body), opcode, self._unique, 1, 0, 0, 0, 0)
        reply = answer(self.device, header + body, "i2c-7")
        length, error, unique = struct.unpack_from("=IiQ", reply)
        assert (length, unique) == (len(reply), self._unique)
        if error:
            raise OSError(-error, "from the device")
        return reply[16:]

    def open(self):
        return struct.unpack_from("=Q", self.send(OPEN, bytes(8)))[0]

    def ioctl(self, handle, command, argument, flags=0):
        wanted, room = [], []
        for self.rounds in range(1, 9):
            given = b"".join(self.memory[at : at + length] for at, length in wanted)
            size = sum(length for _, length in room)
            body = struct.pack("=QIIQII", handle, flags, command, argument, len(given), size)
            reply = self.send(IOCTL, body + given)
            result, out_flags, n_in, n_out = struct.unpack_from("=iIII", reply)
            if not out_flags & RETRY:
                data = reply[16:]
                assert len(data) == size
                for at, length in room:
                    self.memory[at : at + length], data = data[:length], data[length:]
                return result
            areas = list(struct.iter_unpack("=QQ", reply[16:]))
            assert len(areas) == n_in + n_out
            wanted, room = areas[:n_in], areas[n_in:]
        raise AssertionError("the device never has enough")

    def rdwr(self, handle, *messages):
        """Messages are (address, bytes to write or number of bytes to read)."""
        at, rows = 0x1000, []
        for address, content in messages:
            is_read = isinstance(content, int)
            length = content if is_read else len(content)
            if not is_read:
                self.memory[at : at + length] = content
            rows.append((address, int(is_read), length, at))
            at += length
        table = 0x100
        packed = b"".join(struct.pack("=HHH2xQ", *row) for row in rows)
        self.memory[table : table + len(packed)] = packed
        self.memory[0:16] = struct.pack("=QI4x", table, len(rows))
        result = self.ioctl(handle, I2C_RDWR, 0)
        return result, [bytes(self.memory[a : a + n]) for _, is_read, n, a in rows if is_read]

    def smbus(self, handle, is_read, command, size, data=b""):
        self.memory[0x200 : 0x200 + len(data)] = data
        self.memory[0:16] = struct.pack("=BB2xIQ", is_read, command, size, 0x200)
        self.ioctl(handle, I2C_SMBUS, 0)
        return bytes(self.memory[0x200 : 0x200 + 34])


def test_the_first_answer_names_the_device_and_asks_for_unrestricted_ioctls():
    reply = Kernel().send(INIT, struct.pack("=IIII", 7, 38, 0, 1))
    assert struct.unpack_from("=IIII", reply) == (7, 31, 0, 1)
    assert reply[72:] == b"DEVNAME=i2c-7\0"


def test_a_combined_read_takes_four_rounds_and_gives_the_part_number():
    kernel = Kernel(0x2C)
    result, read = kernel.rdwr(kernel.open(), (0x2C, b"\x00\x17"), (0x2C, 2))
    assert (result, read) == (2, [b"\x14\x71"])
    assert kernel.rounds <= 4
    assert kernel.bus.transfers == 1


def test_all_of_a_bank_comes_in_one_message():
    kernel = Kernel(0x2C, 0x2D)
    file = kernel.open()
    words = bytes(range(192))
    kernel.rdwr(file, (0x2D, b"\x00\x80" + words))
    _, read = kernel.rdwr(file, (0x2D, b"\x00\x80"), (0x2D, 192), (0x2C, b"\x00\x80"), (0x2C, 4))
    assert read == [words, bytes(4)]


def test_a_message_without_bytes_is_a_question_whether_somebody_is_there():
    kernel = Kernel(0x2C)
    file = kernel.open()
    assert kernel.rdwr(file, (0x2C, b""))[0] == 1
    with pytest.raises(OSError) as raised:
        kernel.rdwr(file, (0x2D, b""))
    assert raised.value.errno == errno.ENXIO


@pytest.mark.parametrize("messages", [[], [(0x2C, 1)] * 43, [(0x2C, 8193)]])
def test_the_kernels_limits_are_kept(messages):
    kernel = Kernel(0x2C)
    with pytest.raises(OSError) as raised:
        kernel.rdwr(kernel.open(), *messages)
    assert raised.value.errno == errno.EINVAL
    assert kernel.bus.transfers == 0


def test_forty_two_messages_pass():
    kernel = Kernel(0x2C)
    assert kernel.rdwr(kernel.open(), *[(0x2C, 16)] * 42)[0] == 42


def test_functionality_is_messages_and_what_can_be_made_of_them():
    kernel = Kernel()
    kernel.ioctl(kernel.open(), I2C_FUNCS, 0x300)
    assert struct.unpack_from("=Q", kernel.memory, 0x300) == (0x0EFF0001,)


def test_each_open_file_has_its_own_slave_address():
    kernel = Kernel(0x2C, 0x2F)
    first, second = kernel.open(), kernel.open()
    kernel.ioctl(first, I2C_SLAVE, 0x2C)
    kernel.ioctl(second, I2C_SLAVE, 0x2F)
    for file in (first, second):
        message = b"\x00\x80" + bytes([0xA0 + file, 0])
        kernel.send(WRITE, struct.pack("=QQI20x", file, 0, len(message)) + message)
    for file in (first, second):
        address = b"\x00\x80"
        reply = kernel.send(WRITE, struct.pack("=QQI20x", file, 0, 2) + address)
        assert struct.unpack_from("=I", reply) == (2,)
        data = kernel.send(READ, struct.pack("=QQI20x", file, 0, 2))
        assert data == bytes([0xA0 + file, 0])
    kernel.send(RELEASE, struct.pack("=QIIQ", first, 0, 0, 0))


def test_addresses_have_seven_bits():
    kernel = Kernel(0x2C)
    with pytest.raises(OSError) as raised:
        kernel.ioctl(kernel.open(), I2C_SLAVE, 0x80)
    assert raised.value.errno == errno.EINVAL


class TestSmbus:
    @pytest.fixture
    def kernel(self):
        return Kernel(0x2C)

    @pytest.fixture
    def file(self, kernel):
        file = kernel.open()
        kernel.ioctl(file, I2C_SLAVE, 0x2C)
        return file

    @pytest.mark.parametrize("is_read", [0, 1])
    def test_quick(self, kernel, file, is_read):
        kernel.smbus(file, is_read, 0, 0)
        kernel.ioctl(file, I2C_SLAVE, 0x30)
        with pytest.raises(OSError) as raised:
            kernel.smbus(file, is_read, 0, 0)
        assert raised.value.errno == errno.ENXIO

    def test_bytes_and_words(self, kernel, file):
        kernel.smbus(file, 0, 0x00, 2, b"\x17")  # byte data: register address 0x0017
        assert kernel.smbus(file, 1, 0, 1)[0] == 0x14
        assert kernel.smbus(file, 1, 0x55, 2)[0] == 0x14
        assert kernel.smbus(file, 1, 0x55, 3)[:2] == b"\x14\x71"
        kernel.smbus(file, 0, 0x00, 3, b"\x02\x00")
        assert kernel.smbus(file, 1, 0, 1)[0] == 0x0F
        assert kernel.smbus(file, 1, 0x00, 4, b"\x17\xff")[:2] == b"\x14\x71"
        kernel.smbus(file, 0, 0x00, 1)

    def test_blocks(self, kernel, file):
        block = bytes([5, 0x80, 0x12, 0x34, 0x56, 0x78])
        kernel.smbus(file, 0, 0x00, 8, block)
        kernel.smbus(file, 0, 0x00, 2, b"\x80")
        assert kernel.smbus(file, 1, 0x55, 8, b"\x04")[:5] == b"\x04\x12\x34\x56\x78"
        kernel.smbus(file, 0, 0x00, 5, b"\x02\x80\x99")
        with pytest.raises(OSError) as raised:
            kernel.smbus(file, 0, 0x00, 8, b"\x21" + bytes(33))
        assert raised.value.errno == errno.EINVAL

    @pytest.mark.parametrize(("is_read", "size"), [(1, 5), (0, 7), (0, 99)])
    def test_what_the_adapter_does_not_have(self, kernel, file, is_read, size):
        with pytest.raises(OSError) as raised:
            kernel.smbus(file, is_read, 0, size, b"\x01")
        assert raised.value.errno == errno.EOPNOTSUPP


def test_time_is_brought_up_to_date_once_for_each_transfer():
    calls = []
    kernel = Kernel(0x2C, before_transfer=lambda: calls.append(1))
    kernel.rdwr(kernel.open(), (0x2C, b"\x00\x17"), (0x2C, 2))
    assert calls == [1]


@pytest.mark.parametrize(
    ("command", "flags", "number"), [(0x1234, 0, errno.ENOTTY), (I2C_FUNCS, 8, errno.ENOTTY)]
)
def test_unknown_ioctls_and_32_bit_programs_are_refused(command, flags, number):
    kernel = Kernel()
    with pytest.raises(OSError) as raised:
        kernel.ioctl(kernel.open(), command, 0, flags)
    assert raised.value.errno == number


def test_unknown_requests_are_refused_and_interrupts_need_no_answer():
    kernel = Kernel()
    with pytest.raises(OSError) as raised:
        kernel.send(40, bytes(24))
    assert raised.value.errno == errno.ENOSYS
    header = struct.pack("=IIQQIIII", 48, INTERRUPT, 9, 1, 0, 0, 0, 0)
    assert answer(kernel.device, header + bytes(8), "i2c-7") is None


def test_without_cuse_it_says_what_to_do(monkeypatch, tmp_path):
    monkeypatch.setattr("emulator.chips.cuse._CUSE", tmp_path / "cuse")
    with pytest.raises(BusError, match="modprobe cuse"):
        CuseBus(97, EmulatedSMBus({}))
