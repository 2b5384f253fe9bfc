"""Emulated chips as a real /dev/i2c-N, used by programs that know nothing of us."""

import errno
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from smbus2 import SMBus, i2c_msg

from emulator.chips.ad7147 import AD7147
from emulator.chips.cuse import CuseBus
from emulator.chips.i2c import EmulatedSMBus
from skin_host.errors import BusError
from tests.support import conformance, programs

NUMBER = 7
ADDRESSES = (0x2C, 0x2D, 0x2E)

# What a user's own program looks like.
_READER = """
import sys
from smbus2 import SMBus, i2c_msg
address, rounds = int(sys.argv[1]), int(sys.argv[2])
with SMBus(7) as bus:
    bus.i2c_rdwr(i2c_msg.write(address, [0x00, 0x80, address, 0x5A]))
    for _ in range(rounds):
        answer = i2c_msg.read(address, 2)
        bus.i2c_rdwr(i2c_msg.write(address, [0x00, 0x80]), answer)
        assert list(answer) == [address, 0x5A], list(answer)
"""


@pytest.fixture
def i2c() -> Iterator[EmulatedSMBus]:
    """Three chips at /dev/i2c-7, served by a thread of this process."""
    bus = EmulatedSMBus({address: AD7147() for address in ADDRESSES})
    wake, tell = os.pipe()
    with CuseBus(NUMBER, bus) as device:
        server = threading.Thread(target=device.serve, args=(wake,))
        server.start()
        yield bus
        os.close(tell)
        server.join()
    os.close(wake)


def _run(*command: str) -> "subprocess.CompletedProcess[str]":
    program, *arguments = command
    return subprocess.run(
        [programs.require(program), *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_i2ctransfer_reads_the_part_number(i2c: EmulatedSMBus) -> None:
    done = _run("i2ctransfer", "-y", "7", "w2@0x2c", "0x00", "0x17", "r2")
    assert (done.stdout, done.stderr) == ("0x14 0x71\n", "")


def test_i2cdetect_finds_the_chips_and_nothing_else(i2c: EmulatedSMBus) -> None:
    done = _run("i2cdetect", "-y", "7")
    assert done.returncode == 0, done.stderr
    found = re.findall(r"\b(2[0-9a-f]|[013-7][0-9a-f])\b(?!:)", done.stdout.split("\n", 1)[1])
    assert found == ["2c", "2d", "2e"]


def test_i2cdetect_lists_what_the_adapter_can_do(i2c: EmulatedSMBus) -> None:
    done = _run("i2cdetect", "-F", "7")
    able = dict(re.findall(r"^(.+?)\s{2,}(yes|no)$", done.stdout, flags=re.MULTILINE))
    assert able["I2C"] == "yes"
    assert able["SMBus Block Read"] == "no"


def test_smbus2_drives_it_unmodified(i2c: EmulatedSMBus) -> None:
    done = _run(sys.executable, "-c", _READER, str(0x2D), "20")
    assert done.returncode == 0, done.stderr
    assert i2c.transfers == 21


def test_i2cset_and_i2cget_work_through_smbus_commands(i2c: EmulatedSMBus) -> None:
    assert _run("i2cset", "-y", "7", "0x2c", "0x00", "0x80", "0x12", "0x34", "i").returncode == 0
    assert _run("i2cset", "-y", "7", "0x2c", "0x00", "0x80").returncode == 0
    assert _run("i2cget", "-y", "7", "0x2c").stdout == "0x12\n"


def test_several_programs_at_once_do_not_disturb_each_other(i2c: EmulatedSMBus) -> None:
    programs_at_once = [
        subprocess.Popen([sys.executable, "-c", _READER, str(address), "100"])
        for address in ADDRESSES
    ]
    assert [program.wait(120) for program in programs_at_once] == [0, 0, 0]
    assert i2c.transfers == 303


def test_an_absent_chip_answers_as_on_a_kernel_adapter(i2c: EmulatedSMBus) -> None:
    done = _run("i2ctransfer", "-y", "7", "w2@0x2f", "0x00", "0x17", "r2")
    assert done.returncode != 0
    assert "No such device or address" in done.stderr


def test_the_kernels_limits_hold(i2c: EmulatedSMBus) -> None:
    with SMBus(NUMBER) as bus:
        bus.i2c_rdwr(*[i2c_msg.read(0x2C, 1024)] * 42)
        bus.i2c_rdwr(i2c_msg.read(0x2C, 8192))
        for messages in ([i2c_msg.read(0x2C, 1)] * 43, [i2c_msg.read(0x2C, 8193)]):
            with pytest.raises(OSError) as raised:
                bus.i2c_rdwr(*messages)
            assert raised.value.errno == errno.EINVAL


def test_a_program_from_before_i2c_rdwr_reads_and_writes_the_file(i2c: EmulatedSMBus) -> None:
    with SMBus(NUMBER) as bus:
        bus.write_quick(0x2C)  # sets the slave address of this open file
        assert bus.fd is not None
        assert os.write(bus.fd, b"\x00\x17") == 2
        assert os.read(bus.fd, 2) == b"\x14\x71"


@pytest.mark.parametrize("path", conformance.SCRIPTS, ids=lambda path: path.stem)
def test_drivers_get_the_same_through_the_kernel(i2c: EmulatedSMBus, path: Path) -> None:
    script = conformance.load(path)
    chip = AD7147()
    i2c.line.chips = {0x2D: chip}
    with SMBus(NUMBER) as bus:
        done = conformance.run(script, bus, 0x2D, conformance.EmulatedBench(chip))
    assert done == len(script.steps)


def test_a_number_that_is_taken_is_refused(i2c: EmulatedSMBus) -> None:
    with pytest.raises(BusError, match="choose another number"):
        CuseBus(NUMBER, EmulatedSMBus({}))


def test_the_device_goes_with_its_bus() -> None:
    with CuseBus(NUMBER, EmulatedSMBus({})) as device:
        assert device.path.exists()
    assert not Path(f"/dev/i2c-{NUMBER}").exists()
