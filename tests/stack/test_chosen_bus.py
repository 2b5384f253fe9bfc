"""The bus that `--bus` has chosen carries frames, and is nobody else's."""

from collections.abc import Callable

import can

from skin_host.config.settings import Bus

_WAIT_S = 20.0


def _open(bus: Bus) -> can.BusABC:
    return can.Bus(interface=bus.interface, channel=bus.channel)


def _frame(identifier: int) -> can.Message:
    return can.Message(arbitration_id=identifier, data=b"\x40\xf0", is_extended_id=False)


def test_a_frame_reaches_everybody_else_on_the_bus(can_bus_settings: Bus) -> None:
    with (
        _open(can_bus_settings) as sender,
        _open(can_bus_settings) as first,
        _open(can_bus_settings) as second,
    ):
        sender.send(_frame(0x4E1))
        for receiver in (first, second):
            frame = receiver.recv(timeout=_WAIT_S)
            assert frame is not None
            assert (frame.arbitration_id, bytes(frame.data)) == (0x4E1, b"\x40\xf0")
        assert sender.recv(timeout=0) is None


def test_two_buses_do_not_hear_each_other(new_can_bus: Callable[[], Bus]) -> None:
    here, there = new_can_bus(), new_can_bus()
    with _open(here) as sender, _open(here) as near, _open(there) as far:
        sender.send(_frame(1))
        assert near.recv(timeout=_WAIT_S) is not None
        assert far.recv(timeout=0) is None
