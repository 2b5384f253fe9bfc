"""I2C bit by bit: what chips do at their pins, what firmware sees that bangs bits, and faults."""

import ctypes
import errno
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from smbus2 import i2c_msg

from emulator.boards.chip_access import BangedChips, I2cChips, StageMap
from emulator.chips.ad7147 import AD7147
from emulator.chips.i2c import EmulatedSMBus, build_lines
from emulator.chips.i2c_wire import FOR_EVER, BitMaster, I2cWire

ID = b"\x14\x71"


def marked(address: int) -> AD7147:
    """A chip with its address in the first word of Bank 2."""
    chip = AD7147()
    chip.write(bytes([0x00, 0x80, 0x00, address]))
    return chip


def wire_of(*lines: int) -> I2cWire:
    """Data lines with so many chips each."""
    return I2cWire([{0x2C + n: marked(0x2C + n) for n in range(chips)} for chips in lines])


def put(master: BitMaster, address: int, *data: int) -> list[int]:
    """START and bytes; what was acknowledged."""
    master.start()
    return [master.put(byte) for byte in (address, *data)]


def get(master: BitMaster, n: int, line: int = 0) -> bytes:
    return bytes(master.get(acknowledge=at < n - 1)[line] for at in range(n))


def read(master: BitMaster, address: int, register: int, n: int = 2, line: int = 0) -> bytes:
    put(master, address << 1, *register.to_bytes(2))
    put(master, address << 1 | 1)
    data = get(master, n, line)
    master.stop()
    return data


def read_bus(bus: EmulatedSMBus, address: int, register: int, n: int = 2) -> bytes:
    answer = i2c_msg.read(address, n)
    bus.i2c_rdwr(i2c_msg.write(address, register.to_bytes(2)), answer)
    return bytes(answer)


class TestPins:
    def test_an_address_is_acknowledged_in_the_ninth_clock_only(self) -> None:
        wire = wire_of(1)
        wire.set_sda(0)
        wire.set_scl(False)
        seen = []
        for bit in (0, 1, 0, 1, 1, 0, 0, 0, 1):
            wire.set_sda(bit)
            wire.set_scl(True)
            seen.append(wire.sda)
            wire.set_scl(False)
        assert seen == [0, 1, 0, 1, 1, 0, 0, 0, 0]
        wire.set_sda(1)
        assert wire.sda == 1

    def test_each_byte_of_a_write_is_acknowledged_and_an_absent_chip_says_nothing(self) -> None:
        master = BitMaster(wire_of(1))
        assert put(master, 0x2C << 1, 0x00, 0x81, 0xAB, 0xCD) == [1] * 5
        master.stop()
        assert read(master, 0x2C, 0x081) == b"\xab\xcd"
        assert put(master, 0x2D << 1, 0x00) == [0, 0]

    def test_the_last_byte_of_a_software_reset_is_not_acknowledged(self) -> None:
        assert put(BitMaster(wire_of(1)), 0x2C << 1, 0, 0, 4, 0) == [1, 1, 1, 1, 0]

    def test_lines_share_a_clock_and_are_read_together(self) -> None:
        wire = wire_of(4, 2, 1)
        master = BitMaster(wire, 0b111)
        assert put(master, 0x2D << 1, 0x00, 0x80) == [0b011] * 3
        put(master, 0x2D << 1 | 1)
        assert [master.get(acknowledge=True) for _ in range(2)][1] == [0x2D, 0x2D, 0xFF]

    def test_lines_that_are_not_driven_notice_nothing(self) -> None:
        wire = wire_of(1, 1)
        put(BitMaster(wire, 0b01), 0x2C << 1, 0x00, 0x80, 0xAA, 0xAA)
        BitMaster(wire, 0b01).stop()
        assert read(BitMaster(wire, 0b10), 0x2C, 0x080, line=1) == b"\x00\x2c"

    def test_the_pointer_survives_a_stop_and_moves_by_whole_words(self) -> None:
        master = BitMaster(wire_of(1))
        put(master, 0x2C << 1, 0x00, 0x17)
        master.stop()
        for wanted in (b"\x14", b"\x14\x71\x00", b"\x00"):
            put(master, 0x2C << 1 | 1)
            assert get(master, len(wanted)) == wanted
            master.stop()

    @pytest.mark.parametrize("seed", range(5))
    def test_bits_and_messages_do_the_same_to_a_chip(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        chips = [AD7147(np.random.default_rng(seed)) for _ in range(2)]
        for chip in chips:
            chip.set_capacitances_ff(np.full(12, 9000.0))
        messages, bits = EmulatedSMBus({0x2C: chips[0]}), EmulatedSMBus({0x2C: chips[1]})
        # A fault that never strikes makes a bus go bit by bit.
        bits.line.rise_slowly(1 << 60)
        for _ in range(30):
            register = int(rng.choice([0x000, 0x008, 0x00B, 0x080, 0x0E0, 0x28E]))
            data = rng.integers(0, 256, rng.integers(0, 12)).tolist()
            outcomes = []
            for bus in (messages, bits):
                answer = i2c_msg.read(0x2C, len(data) + 1)
                try:
                    bus.i2c_rdwr(i2c_msg.write(0x2C, [*register.to_bytes(2), *data]))
                    bus.i2c_rdwr(answer)
                    outcomes.append(bytes(answer))
                except OSError as error:
                    outcomes.append(str(error).encode())
            assert outcomes[0] == outcomes[1]
            for chip in chips:
                chip.advance(0.01)
        assert read_bus(messages, 0x2C, 0, 2 * 0x290) == read_bus(bits, 0x2C, 0, 2 * 0x290)


class TestFirmware:
    def test_banged_chips_are_set_up_and_read_as_by_messages(self) -> None:
        words = []
        for kind in (I2cChips, lambda lines: BangedChips(lines[0].wire)):
            chips = [AD7147() if n != 5 else None for n in range(20)]
            driver = kind(build_lines(chips))
            driver.configure(range(20), StageMap.SINGLE, 0x2200, 0x00B0)
            for number, chip in enumerate(chips):
                if chip is not None:
                    chip.set_capacitances_ff(9000.0 + 7 * number + np.arange(12))
                    chip.advance(0.1)
            words.append(driver.read())
        np.testing.assert_array_equal(words[0], words[1])
        assert (words[1][5] == 0xFFFF).all()

    def test_firmware_in_c_is_linked_against_the_pins(self, tmp_path: Path) -> None:
        compiler = shutil.which("cc")
        if compiler is None:
            pytest.skip("no C compiler")
        source, library = Path(__file__).with_name("bit_bang.c"), tmp_path / "bit_bang.so"
        options = ["-std=c99", "-Wall", "-Werror", "-shared", "-fPIC"]
        subprocess.run([compiler, *options, "-o", library, source], check=True)
        wire = wire_of(4, 4, 4, 4, 1)

        class Pins(ctypes.Structure):
            _fields_ = (
                ("set_scl", ctypes.CFUNCTYPE(None, ctypes.c_int)),
                ("set_sda", ctypes.CFUNCTYPE(None, ctypes.c_uint32)),
                ("sda", ctypes.CFUNCTYPE(ctypes.c_uint32)),
                ("delay_ns", ctypes.CFUNCTYPE(None, ctypes.c_uint32)),
            )

        kinds = [kind for _, kind in Pins._fields_]
        calls = (wire.set_scl, wire.set_sda, lambda: wire.sda, wire.wait)
        pins = Pins(*(kind(call) for kind, call in zip(kinds, calls, strict=True)))
        words = ((ctypes.c_uint16 * 3) * 5)()
        ctypes.CDLL(str(library)).read_words(ctypes.byref(pins), 0x2C, 0x017, 5, 3, words)
        assert [list(line) for line in words] == [[0x1471, 0, 0]] * 5
        ctypes.CDLL(str(library)).read_words(ctypes.byref(pins), 0x2D, 0x080, 5, 1, words)
        assert list(words[0])[:1] == [0x2D]


class TestFaults:
    def test_no_acknowledge_of_the_address_is_a_chip_that_is_not_there(self) -> None:
        bus = EmulatedSMBus({0x2C: AD7147(), 0x2D: AD7147()})
        bus.line.refuse(0x2C, 0)
        with pytest.raises(OSError) as raised:
            read_bus(bus, 0x2C, 0x017)
        assert raised.value.errno == errno.ENXIO
        assert read_bus(bus, 0x2D, 0x017) == ID

    def test_no_acknowledge_of_a_byte_loses_the_rest_of_the_message(self) -> None:
        bus = EmulatedSMBus({0x2C: marked(0x2C)})
        bus.line.refuse(0x2C, 5)
        with pytest.raises(OSError) as raised:
            bus.i2c_rdwr(i2c_msg.write(0x2C, [0x00, 0x80, 0xAB, 0xCD, 0xEF, 0x01]))
        assert raised.value.errno == errno.EREMOTEIO
        bus.line.refuse(0x2C, None)
        assert read_bus(bus, 0x2C, 0x080, 4) == b"\xab\xcd\x00\x00"

    def test_firmware_that_looks_at_no_acknowledge_reads_other_registers(self) -> None:
        wire = wire_of(1)
        master = BitMaster(wire)
        read(master, 0x2C, 0x016)
        wire.lines[0].refuse(0x2C, 1)
        assert read(master, 0x2C, 0x080) == ID

    def test_a_data_line_that_is_held_is_free_again_after_nine_clocks(self) -> None:
        bus = EmulatedSMBus({0x2C: AD7147()})
        bus.line.hold()
        with pytest.raises(OSError) as raised:
            read_bus(bus, 0x2C, 0x017)
        assert raised.value.errno == errno.ETIMEDOUT
        assert read_bus(bus, 0x2C, 0x017) == ID
        assert not bus.line.faulty

    def test_firmware_frees_it_by_its_own_clocks_and_loses_one_message(self) -> None:
        wire = wire_of(1)
        master = BitMaster(wire)
        read(master, 0x2C, 0x080)
        wire.lines[0].hold()
        assert read(master, 0x2C, 0x017) != ID
        assert read(master, 0x2C, 0x017) == ID

    def test_a_line_held_for_ever_reads_zero_until_it_is_mended(self) -> None:
        wire = wire_of(1)
        wire.lines[0].hold(FOR_EVER)
        assert read(BitMaster(wire), 0x2C, 0x017) == b"\0\0"
        wire.lines[0].hold(0)
        assert read(BitMaster(wire), 0x2C, 0x017) == ID

    def test_a_master_waits_for_a_clock_that_is_stretched(self) -> None:
        bus = EmulatedSMBus({0x2C: AD7147(), 0x2D: AD7147()})
        bus.line.stretch(0x2C, 50_000)
        assert read_bus(bus, 0x2C, 0x017) == ID
        stretched_ns = bus.busy_ns
        bus.line.stretch(0x2C, None)
        assert read_bus(bus, 0x2C, 0x017) == ID
        # Six bytes; the time of a clock that was low anyway is not added.
        assert stretched_ns - (bus.busy_ns - stretched_ns) == pytest.approx(6 * 50_000, rel=0.1)

    def test_a_master_gives_up_a_clock_that_is_held_for_long(self) -> None:
        bus = EmulatedSMBus({0x2C: AD7147()})
        bus.line.stretch(0x2C, 10**9)
        with pytest.raises(OSError) as raised:
            read_bus(bus, 0x2C, 0x017)
        assert raised.value.errno == errno.ETIMEDOUT

    def test_firmware_that_does_not_look_at_the_clock_loses_bits_on_all_lines(self) -> None:
        wire = wire_of(1, 1)
        wire.lines[0].stretch(0x2C, 20_000)
        assert wire.faulty == 0b11
        master = BitMaster(wire, 0b11)
        assert read(master, 0x2C, 0x017, line=1) != ID
        assert read(BitMaster(wire, 0b10), 0x2C, 0x017, line=1) == ID

    def test_a_share_of_the_bits_is_read_wrong_until_it_is_mended(self) -> None:
        wire = wire_of(1)
        master = BitMaster(wire)
        wire.lines[0].flip(0.1)
        idle = np.array([master.get(acknowledge=False)[0] for _ in range(200)], np.uint8)
        assert 1 - np.unpackbits(idle).mean() == pytest.approx(0.1, abs=0.03)
        wire.lines[0].flip(0)
        assert read(master, 0x2C, 0x017) == ID

    def test_every_third_bit_that_rises_is_lost(self) -> None:
        wire = wire_of(1)
        master = BitMaster(wire)
        put(master, 0x2C << 1, 0x00, 0x80, 0x55, 0x55)
        put(master, 0x2C << 1, 0x00, 0x80)
        put(master, 0x2C << 1 | 1)
        wire.lines[0].rise_slowly(3)
        assert get(master, 2) == bytes([0b01010001, 0b01000101])

    def test_a_zero_of_either_chip_wins_where_two_answer(self) -> None:
        bus = EmulatedSMBus({0x2C: marked(0b1100)})
        second = marked(0b1010)
        bus.line.share(0x2C, second)
        assert read_bus(bus, 0x2C, 0x080) == b"\x00\x08"
        bus.i2c_rdwr(i2c_msg.write(0x2C, [0x00, 0x81, 0xAB, 0xCD]))
        bus.line.share(0x2C, None)
        assert read_bus(bus, 0x2C, 0x081) == b"\xab\xcd"
        assert second.write(b"\x00\x81") == 2
        assert second.read(2) == b"\xab\xcd"

    def test_a_brown_out_leaves_registers_at_reset_and_anything_in_ram(self) -> None:
        chip = marked(0x2C)
        chip.write(b"\x00\x00\x00\xb0")
        chip.set_capacitances_ff(np.full(12, 9000.0))
        chip.advance(0.1)
        chip.brown_out(np.arange(0x210, dtype=np.uint16))
        bus = EmulatedSMBus({0x2C: chip})
        assert read_bus(bus, 0x2C, 0x000, 10) == b"\0\0\0\0\x0f\xf0\x01\x64\xff\xff"
        assert read_bus(bus, 0x2C, 0x00B, 24) == bytes(24)
        assert read_bus(bus, 0x2C, 0x081) == b"\x00\x01"


def _bit_by_bit(out: int, lines: int, half_ns: int) -> None:
    """In place of `I2cWire.clock_byte`: each byte goes clock by clock."""


class TestWholeBytes:
    """Bytes that are clocked at once are those that are clocked bit by bit."""

    def everything(self, seed: int, *, at_once: bool) -> list[object]:
        """What comes of random faults and messages on three lines, with all states on the way."""
        rng = np.random.default_rng(seed)
        wire = wire_of(4, 2, 0)
        if not at_once:
            wire.clock_byte = _bit_by_bit  # type: ignore[method-assign]
        seen: list[object] = []
        for _ in range(12):
            line = wire.lines[rng.integers(3)]
            address = 0x2C + int(rng.integers(4))
            match rng.integers(9):
                case 0:
                    line.refuse(address, int(rng.integers(4)))
                case 1:
                    line.refuse(address, None)
                case 2:
                    line.share(address, marked(0x55) if rng.random() < 0.5 else None)
                case 3:
                    line.hold(int(rng.choice([0, 3, 20, FOR_EVER])))
                case 4:
                    line.flip(float(rng.choice([0.0, 0.002, 0.05])))
                case 5:
                    line.rise_slowly(int(rng.choice([0, 1, 3, 7])))
                case 6:
                    line.slip(int(rng.integers(3)))
                case 7:
                    line.stretch(address, None if rng.random() < 0.6 else 3000)
            master = BitMaster(wire, int(rng.integers(1, 8)))
            chip = 0x2C + int(rng.integers(4))
            data = rng.integers(0, 256, 2 * rng.integers(3)).tolist()
            seen.append(put(master, chip << 1, 0x00, 0x80, *data))
            if rng.random() < 0.7:
                seen.append(put(master, chip << 1 | 1))
                n = int(rng.integers(1, 8))
                seen += [master.get(acknowledge=at < n - 1) for at in range(n)]
            if rng.random() < 0.9:
                master.stop()
            seen += [wire.t_ns, wire.sda]
            for one in wire.lines:
                seen.append((one.level, one.seen, one.asleep, one.faulty))
        return seen

    @pytest.mark.parametrize("seed", range(60))
    def test_they_give_the_same_whatever_goes_wrong(self, seed: int) -> None:
        assert self.everything(seed, at_once=True) == self.everything(seed, at_once=False)
