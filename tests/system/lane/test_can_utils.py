"""Frames pass between python-can and the kernel's own tools."""

import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager

import can

from tests.support import programs
from tests.support.vcan import Vcan

_WAIT_S = 60.0


@contextmanager
def _candump(*arguments: str) -> Iterator["subprocess.Popen[str]"]:
    """Run candump, and go on once its socket receives."""
    before = _receivers()
    with subprocess.Popen(
        [programs.require("candump"), *arguments], stdout=subprocess.PIPE, text=True
    ) as dump:
        deadline = time.monotonic() + _WAIT_S
        while _receivers() <= before and time.monotonic() < deadline:
            time.sleep(0.01)
        yield dump
        dump.kill()


def _receivers() -> int:
    """Count the subscriptions that the kernel lists."""
    with open("/proc/net/can/rcvlist_all") as lists:
        return len(re.findall(r"^\s+v?can\d+\s", lists.read(), flags=re.MULTILINE))


def _bus(vcan: Vcan) -> can.BusABC:
    return can.Bus(interface="socketcan", channel=vcan.name)


def test_candump_prints_a_frame_that_python_can_sent(vcan: Vcan) -> None:
    with _candump("-L", "-n", "1", "-T", "60000", vcan.name) as dump, _bus(vcan) as bus:
        bus.send(can.Message(arbitration_id=0x71E, data=range(8), is_extended_id=False))
        printed, _ = dump.communicate(timeout=_WAIT_S)
    assert printed.split()[1:] == [vcan.name, "71E#0001020304050607"]


def test_python_can_receives_what_cansend_sent(vcan: Vcan) -> None:
    with _bus(vcan) as bus:
        subprocess.run([programs.require("cansend"), vcan.name, "4E1#40F0"], check=True)
        frame = bus.recv(timeout=_WAIT_S)
    assert frame is not None
    assert (frame.arbitration_id, bytes(frame.data)) == (0x4E1, b"\x40\xf0")
    assert not frame.is_extended_id


def test_the_kernel_stamps_each_frame(vcan: Vcan) -> None:
    with _bus(vcan) as bus, _bus(vcan) as other:
        before = time.time()
        other.send(can.Message(arbitration_id=0x7FF, is_extended_id=False))
        after = time.time()
        frame = bus.recv(timeout=_WAIT_S)
    assert frame is not None
    assert before <= frame.timestamp <= after


def test_two_interfaces_do_not_hear_each_other(vcan: Vcan) -> None:
    other = Vcan()
    try:
        with _bus(vcan) as here, _bus(other) as there, _bus(vcan) as sender:
            sender.send(can.Message(arbitration_id=1, is_extended_id=False))
            assert here.recv(timeout=_WAIT_S) is not None
            assert there.recv(timeout=0) is None
    finally:
        other.close()
