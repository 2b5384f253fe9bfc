"""What systemd-networkd makes of CAN interfaces with the project's files."""

import re
from collections.abc import Iterator
from contextlib import closing
from functools import partial

import pytest

from tests.support.machine import ROOT, Machine

pytestmark = pytest.mark.timeout(900)

FOLDER = "/etc/systemd/network"
#: A serial adapter's other end: it takes every command of the kernel's slcan.
ADAPTER = """
import fcntl, os, pty, struct, tty
TIOCSETD, N_SLCAN = 0x5423, 17
ours, line = pty.openpty()
tty.setraw(line)
fcntl.ioctl(line, TIOCSETD, struct.pack("i", N_SLCAN))
while os.read(ours, 4096):
    os.write(ours, b"\\r")
"""


def install(machine: Machine, *drop_ins: str) -> None:
    """Give networkd the project's files, as `make install` and the documentation do."""
    machine.do(f"rm -rf {FOLDER}/80-skin-can.network.d")
    for name in ("80-skin-can.network", "80-skin-can.link"):
        machine.write(f"{FOLDER}/{name}", (ROOT / "systemd" / name).read_text())
    for name in drop_ins:
        path = f"80-skin-can.network.d/{name}"
        machine.write(f"{FOLDER}/{path}", (ROOT / "systemd" / path).read_text())


def link(machine: Machine, name: str) -> str:
    """What the kernel knows of an interface."""
    return machine.run(f"ip -details link show {name}").output


def set_up_again(machine: Machine, name: str) -> None:
    machine.do(f"networkctl reload; ip link set {name} down; networkctl reconfigure {name}")


def works(machine: Machine, name: str) -> bool:
    shown = link(machine, name)
    return "bitrate 1000000" in shown and re.search(r"[<,]UP[,>]", shown) is not None


@pytest.fixture
def slcan(machine: Machine) -> Iterator[str]:
    """A CAN interface on a serial line, as a cheap adapter is: no error reports, no restart."""
    machine.write("/root/adapter.py", ADAPTER)
    install(machine)
    machine.do("networkctl reload; udevadm control --reload")
    known = machine.do("ls /sys/class/net").split()
    machine.do("systemd-run --quiet --unit=adapter --collect python3 /root/adapter.py")

    def new() -> list[str]:
        return [name for name in machine.do("ls /sys/class/net").split() if name not in known]

    machine.until(lambda: bool(new()), "no interface")
    yield new()[0]
    machine.do("systemctl stop adapter; true")


def test_a_serial_adapter_gets_its_bit_rate_and_its_queue(machine: Machine, slcan: str) -> None:
    machine.until(lambda: works(machine, slcan), "it is not up at 1 Mbit/s")
    assert "qlen 128" in link(machine, slcan)


def test_a_setting_that_an_adapter_does_not_know_would_keep_it_down(
    machine: Machine, slcan: str
) -> None:
    """Why the drop-ins are not installed."""
    machine.until(lambda: works(machine, slcan), "it is not up at 1 Mbit/s")
    for name in ("restart.conf", "errors.conf"):
        install(machine, name)
        set_up_again(machine, slcan)
        machine.until(
            lambda: "(failed)" in machine.run(f"networkctl status {slcan}").output,
            f"{slcan} takes {name}",
        )
        assert not works(machine, slcan)


@pytest.fixture(scope="module")
def computer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """A PC with two CAN cards on one bus, emulated to the registers of their controllers."""
    options = ["-object", "can-bus,id=wire"]
    options += ["-device", "kvaser_pci,canbus=wire", "-device", "kvaser_pci,canbus=wire"]
    with closing(Machine("qemu", tmp_path_factory.mktemp("computer"), *options)) as made:
        yield made


@pytest.mark.parametrize("drop_ins", [[], ["restart.conf", "errors.conf"]], ids=["shipped", "all"])
def test_a_cards_controllers_come_up_and_pass_frames(
    computer: Machine, drop_ins: list[str]
) -> None:
    install(computer, *drop_ins)
    computer.do("udevadm control --reload; udevadm trigger --action=add /sys/class/net/can*")
    for name in ("can0", "can1"):
        assert "kvaser_pci" in computer.do(f"readlink /sys/class/net/{name}/device/driver")
        set_up_again(computer, name)
        computer.until(partial(works, computer, name), f"{name} is not up")
        shown = link(computer, name)
        assert "qlen 128" in shown
        assert ("restart-ms 100" in shown) == bool(drop_ins)
        assert ("BERR-REPORTING" in shown) == bool(drop_ins)
    computer.do("(candump -L -n 1 -T 60000 can1 >seen) & sleep 5; cansend can0 20E#0700; wait")
    assert computer.do("cat seen").endswith("can1 20E#0700")
