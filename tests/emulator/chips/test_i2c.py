import ctypes
import errno

import pytest
from smbus2 import SMBus, i2c_msg

from emulator.chips.ad7147 import AD7147
from emulator.chips.i2c import EmulatedSMBus, build_lines, line_and_address
from emulator.chips.i2c_wire import FOR_EVER


def bus_of_four(**arguments):
    chips = {address: AD7147() for address in range(0x2C, 0x30)}
    for address, chip in chips.items():
        chip.write(bytes([0x00, 0x80, 0x00, address]))
    return EmulatedSMBus(chips, **arguments)


def read(bus, address, register, length=2):
    answer = i2c_msg.read(address, length)
    bus.i2c_rdwr(i2c_msg.write(address, [register >> 8, register & 0xFF]), answer)
    return bytes(answer)


class TestTransfers:
    def test_it_is_an_smbus_and_takes_its_messages(self):
        bus = bus_of_four()
        assert isinstance(bus, SMBus)
        with bus:
            assert read(bus, 0x2C, 0x017) == b"\x14\x71"

    def test_write_and_read_may_be_two_transactions(self):
        bus = bus_of_four()
        bus.i2c_rdwr(i2c_msg.write(0x2D, [0x00, 0x17]))
        answer = i2c_msg.read(0x2D, 2)
        bus.i2c_rdwr(answer)
        assert list(answer) == [0x14, 0x71]

    def test_one_transaction_may_address_several_chips(self):
        bus = bus_of_four()
        messages = []
        for address in range(0x2C, 0x30):
            messages += [i2c_msg.write(address, [0x00, 0x80]), i2c_msg.read(address, 2)]
        bus.i2c_rdwr(*messages)
        assert [list(answer)[1] for answer in messages[1::2]] == [0x2C, 0x2D, 0x2E, 0x2F]

    def test_smbus_commands_do_what_the_kernel_makes_of_them(self):
        bus = bus_of_four()
        bus.write_quick(0x2C)
        bus.write_i2c_block_data(0x2C, 0x00, [0x80, 0xAB, 0xCD, 0x12, 0x34])
        assert read(bus, 0x2C, 0x080, 4) == b"\xab\xcd\x12\x34"
        bus.write_byte_data(0x2C, 0x00, 0x17)
        assert bus.read_byte(0x2C) == 0x14
        bus.write_word_data(0x2C, 0x00, 0xEE81)
        assert read(bus, 0x2C, 0x081) == b"\x12\x34"

    def test_a_one_byte_command_cannot_address_a_register(self):
        # Half an address: the chip answers from where its pointer was.
        bus = bus_of_four()
        read(bus, 0x2C, 0x016)
        assert bus.read_i2c_block_data(0x2C, 0x02, 2) == [0x14, 0x71]

    def test_smbus_blocks_with_a_count_from_the_chip_are_not_supported(self):
        with pytest.raises(OSError) as raised:
            bus_of_four().read_block_data(0x2C, 0)
        assert raised.value.errno == errno.EOPNOTSUPP

    def test_software_reset_is_an_io_error_that_still_resets(self):
        bus = bus_of_four()
        with pytest.raises(OSError) as raised:
            bus.i2c_rdwr(i2c_msg.write(0x2C, [0x00, 0x00, 0x04, 0x00]))
        assert raised.value.errno == errno.EREMOTEIO
        assert read(bus, 0x2C, 0x002) == b"\x0f\xf0"


class TestKernelLimits:
    @pytest.mark.parametrize("count", [0, 43])
    def test_messages_are_limited_in_number(self, count):
        with pytest.raises(OSError) as raised:
            bus_of_four().i2c_rdwr(*[i2c_msg.read(0x2C, 1)] * count)
        assert raised.value.errno == errno.EINVAL

    def test_forty_two_messages_of_8192_bytes_pass(self):
        bus_of_four().i2c_rdwr(*[i2c_msg.read(0x2C, 8192)] * 42)

    def test_messages_are_limited_in_length(self):
        with pytest.raises(OSError) as raised:
            bus_of_four().i2c_rdwr(i2c_msg.read(0x2C, 8193))
        assert raised.value.errno == errno.EINVAL

    def test_unknown_flags_are_refused(self):
        message = i2c_msg.read(0x2C, 2)
        message.flags |= 0x0400
        with pytest.raises(OSError) as raised:
            bus_of_four().i2c_rdwr(message)
        assert raised.value.errno == errno.EOPNOTSUPP


class TestFaults:
    def test_an_absent_chip_does_not_acknowledge(self):
        bus = EmulatedSMBus({0x2C: AD7147()})
        with pytest.raises(OSError) as raised:
            read(bus, 0x2E, 0x017)
        assert raised.value.errno == errno.ENXIO
        assert (bus.transfers, bus.failures) == (1, 1)

    def test_a_chip_can_go_and_come_back_with_its_registers(self):
        bus = bus_of_four()
        bus.line.refuse(0x2D, 0)
        with pytest.raises(OSError):
            read(bus, 0x2D, 0x080)
        assert read(bus, 0x2C, 0x080) == b"\x00\x2c"
        bus.line.refuse(0x2D, None)
        assert read(bus, 0x2D, 0x080) == b"\x00\x2d"

    def test_messages_before_the_missing_acknowledge_had_their_effect(self):
        bus = bus_of_four()
        with pytest.raises(OSError):
            bus.i2c_rdwr(i2c_msg.write(0x2C, [0x00, 0x80, 0x11, 0x22]), i2c_msg.write(0x50, [1]))
        assert read(bus, 0x2C, 0x080) == b"\x11\x22"

    def test_a_stuck_bus_times_out_for_everybody(self):
        bus = bus_of_four()
        bus.line.hold(FOR_EVER)
        for address in (0x2C, 0x2F):
            with pytest.raises(OSError) as raised:
                read(bus, address, 0x017)
            assert raised.value.errno == errno.ETIMEDOUT
        bus.line.hold(0)
        assert read(bus, 0x2C, 0x017) == b"\x14\x71"

    def test_a_glitch_shifts_one_read_by_a_bit(self):
        bus = bus_of_four()
        bus.line.slip()
        assert read(bus, 0x2C, 0x017) == b"\x8a\x38"
        assert read(bus, 0x2C, 0x017) == b"\x14\x71"


class TestTime:
    def test_a_result_read_takes_two_thirds_of_a_millisecond_at_400_khz(self):
        bus = bus_of_four(clock_hz=400e3)
        read(bus, 0x2C, 0x00B, 24)
        # START, address, 2 bytes; repeated START, address, 24 bytes; STOP.
        assert bus.busy_ns == (10 + 18 + 10 + 216 + 1) * 2500

    def test_half_the_clock_takes_twice_the_time(self):
        slow, fast = bus_of_four(clock_hz=100e3), bus_of_four(clock_hz=200e3)
        read(slow, 0x2C, 0x00B, 24)
        read(fast, 0x2C, 0x00B, 24)
        assert slow.busy_ns == 2 * fast.busy_ns


class TestLines:
    @pytest.mark.parametrize(
        ("position", "place"), [(0, (0, 0x2C)), (5, (1, 0x2D)), (15, (3, 0x2F)), (16, (4, 0x2C))]
    )
    def test_triangles_sit_four_to_a_line(self, position, place):
        assert line_and_address(position) == place

    def test_sixteen_chips_make_four_lines_and_twenty_five(self):
        assert len(build_lines([AD7147() for _ in range(16)])) == 4
        assert len(build_lines([AD7147() for _ in range(20)])) == 5

    def test_gaps_answer_nothing(self):
        lines = build_lines([AD7147(), None, AD7147()])
        assert read(lines[0], 0x2E, 0x017) == b"\x14\x71"
        with pytest.raises(OSError):
            read(lines[0], 0x2D, 0x017)
        with pytest.raises(OSError):
            read(lines[3], 0x2C, 0x017)


def test_answers_arrive_in_the_callers_own_buffer():
    message = i2c_msg.read(0x2C, 2)
    where = ctypes.addressof(message.buf.contents)
    bus = bus_of_four()
    bus.i2c_rdwr(i2c_msg.write(0x2C, [0x00, 0x17]), message)
    assert ctypes.string_at(where, 2) == b"\x14\x71"
