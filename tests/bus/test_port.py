"""Reading in batches: every frame with its time, every loss counted, no state that ends it."""

import errno
import logging
import socket
import struct
import time

import can
import numpy as np
import pytest
from can.interfaces.socketcan.socketcan import build_can_frame

from skin_host.bus import socketcan
from skin_host.bus.adapters import AdapterPort
from skin_host.bus.opening import open_port
from skin_host.bus.port import LinkState, Port
from skin_host.bus.socketcan import BatchReceiver, SocketCanPort
from skin_host.bus.wire import FrameBatch
from skin_host.clock import SYSTEM, Clock, SteppedClock
from skin_host.config.settings import Bus, Receive
from skin_host.errors import BusError, ConfigurationError
from skin_host.evaluation.stand_in import StandInBus, pair, register
from tests.support.waiting import PATIENCE_S

#: Of asm-generic/socket.h; Python does not name it.
SO_TIMESTAMPNS = 35
#: The computer's clock may be set meanwhile, by less than this.
SET_NS = 10_000_000
SMALL = Receive(buffer_bytes=65536)


def can_frame(identifier: int, data: bytes) -> bytes:
    return struct.pack("=IB3x8s", identifier, len(data), data)


def port_on(
    bus: can.BusABC, receive: Receive | None = None, clock: Clock = SYSTEM
) -> SocketCanPort:
    return SocketCanPort("left", Bus(), receive or Receive(), bus, lambda: bus, clock)


def read_all(port: Port, expected: int) -> tuple[int, int]:
    """Frames and losses of all reads until both make up what was sent."""
    frames = dropped = 0
    deadline = time.monotonic() + PATIENCE_S
    while frames + dropped < expected and time.monotonic() < deadline:
        batch = port.read()
        frames += len(batch)
        dropped += batch.dropped
    return frames, dropped


@pytest.fixture
def ends():
    ours, theirs = pair()
    yield ours, theirs
    ours.shutdown()
    theirs.shutdown()


@pytest.mark.parametrize("opening", [open_port, lambda *bus: socketcan.open_present(*bus[:2])])
def test_a_channel_with_a_zero_byte_is_no_interface(opening):
    with pytest.raises(BusError, match="no such network interface"):
        opening("left", Bus(channel="a\0"), SMALL)


def test_a_read_takes_everything_that_waits_in_order(ends):
    ours, theirs = ends
    port = port_on(ours)
    sent = [(0x410 + i, bytes(range(i, i + 8))) for i in range(16)]
    before_ns = time.time_ns()
    for identifier, data in sent:
        theirs.socket.send(can_frame(identifier, data))
    batch = port.read()
    assert batch.id.tolist() == [identifier for identifier, _ in sent]
    assert [row.tobytes() for row in batch.data] == [data for _, data in sent]
    assert set(batch.dlc.tolist()) == {8}
    assert before_ns - SET_NS <= batch.t_ns[0] <= batch.t_ns[-1] <= time.time_ns() + SET_NS
    assert np.all(np.diff(batch.t_ns) >= 0)
    assert len(port.read()) == 0
    assert port.counters.frames == 16


def test_walking_through_frames_gives_what_the_arrays_hold(ends):
    ours, theirs = ends
    port = port_on(ours)
    for i in range(5):
        theirs.socket.send(can_frame(0x410 + i, bytes(range(8))[: i + 1]))
    batch = port.read()
    walked = list(batch.frames())
    by_arrays = FrameBatch(batch.id, batch.dlc, batch.data, batch.t_ns).frames()
    assert walked == list(by_arrays)
    assert [(identifier, dlc) for _, _, identifier, dlc, _, _ in walked] == [
        (0x410 + i, i + 1) for i in range(5)
    ]


def test_more_than_the_capacity_comes_with_the_next_read(ends):
    ours, theirs = ends
    receiver = BatchReceiver(ours.socket, 65536, capacity=4)
    for i in range(10):
        theirs.socket.send(can_frame(i, b""))
    batches = [receiver.read().id.tolist() for _ in range(4)]
    assert batches == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9], []]


def test_an_overflow_is_counted_to_the_frame(ends):
    ours, theirs = ends
    port = port_on(ours, SMALL)
    for _ in range(3000):
        theirs.socket.send(can_frame(0x410, bytes(8)))
    frames, dropped = read_all(port, 3000)
    assert dropped > 0
    assert frames + dropped == 3000
    # The kernel also reports the loss with the frames after it; it is not counted twice.
    theirs.socket.send(can_frame(0x410, bytes(8)))
    assert len(port.read()) == 1
    assert (port.counters.frames, port.counters.dropped) == (frames + 1, dropped)


def test_a_buffer_smaller_than_wanted_is_said_once(ends, caplog):
    ours, _ = ends
    with caplog.at_level(logging.WARNING):
        port = port_on(ours, Receive(buffer_bytes=2**31 - 1))
    assert port.counters.buffer_bytes < 2**31 - 1
    (record,) = caplog.records
    assert "sysctl -w net.core.rmem_max=2147483647" in record.getMessage()


def test_a_loose_plug_repeats_nothing_of_the_buffer(caplog):
    """Each time the device was back, there was a line of it."""
    buses = [pair() for _ in range(5)]
    port = port_on(buses[0][0], Receive(buffer_bytes=2**31 - 1))
    for ours, _ in buses[1:]:
        port._use(ours)
    assert len([one for one in caplog.messages if "rmem_max" in one]) == 1
    for ends in buses:
        for end in ends:
            end.shutdown()


def test_error_frames_are_counted_and_move_the_state(ends):
    ours, theirs = ends
    port = port_on(ours)

    def state_after(error: int, detail: int) -> LinkState:
        theirs.socket.send(can_frame(0x20000000 | error, bytes([0, detail, 0, 0, 0, 0, 0, 0])))
        port.read()
        return port.state

    assert state_after(0x004, 0x20) is LinkState.ERROR_PASSIVE
    assert state_after(0x004, 0x40) is LinkState.UP
    assert state_after(0x040, 0) is LinkState.BUS_OFF
    assert state_after(0x100, 0) is LinkState.UP
    assert state_after(0x004, 0x01) is LinkState.UP
    assert state_after(0x080, 0) is LinkState.UP
    counters = port.counters
    assert (counters.error_frames, counters.bus_offs, counters.controller_overflows) == (6, 1, 1)


@pytest.mark.parametrize("forged_s", [0, -1, 2**63 // 10**9, 1, 4_000_000_000])
def test_a_stamp_that_is_far_from_now_is_replaced_by_the_time(ends, monkeypatch, forged_s):
    """A program on this computer may ask the kernel for any stamp of what it sends (SO_TXTIME)."""
    ours, theirs = ends
    port = port_on(ours)
    for number in range(3):
        theirs.socket.send(can_frame(number, b""))
    receive = socketcan._recvmmsg

    def forging(*arguments):
        n = receive(*arguments)
        port._receiver._records["seconds"][1] = forged_s
        return n

    monkeypatch.setattr(socketcan, "_recvmmsg", forging)
    before_ns = time.time_ns()
    batch = port.read()
    assert batch.id.tolist() == [0, 1, 2]
    assert np.abs(batch.t_ns - before_ns).max() < 10**10
    assert batch.t_ns[1] >= before_ns - SET_NS


def test_frames_without_stamps_have_the_time_at_which_they_are_read(ends):
    ours, theirs = ends
    port = port_on(ours)
    theirs.socket.send(can_frame(1, b""))
    port.read()
    ours.socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 0)
    for number in range(2):
        theirs.socket.send(can_frame(number, b""))
    before_ns = time.time_ns()
    assert (port.read().t_ns >= before_ns - SET_NS).all()


def test_a_bus_without_errors_for_ten_seconds_is_up_whatever_its_driver_reports(ends):
    """That of the MCP2515 reports no return from error passive."""
    ours, theirs = ends
    clock = SteppedClock()
    port = port_on(ours, clock=clock)

    def state_after(seconds: float, sent: bytes) -> LinkState:
        clock.advance(seconds)
        theirs.socket.send(sent)
        port.read()
        return port.state

    passive, data = can_frame(0x20000004, bytes([0, 0x20, *bytes(6)])), can_frame(0x410, bytes(8))
    for _ in range(3):
        assert state_after(1.0, passive) is LinkState.ERROR_PASSIVE
    assert state_after(9.0, passive) is LinkState.ERROR_PASSIVE
    assert state_after(9.0, data) is LinkState.ERROR_PASSIVE
    clock.advance(60.0)
    port.read()
    assert port.state is LinkState.ERROR_PASSIVE
    assert state_after(0.0, data) is LinkState.UP


def test_a_frame_with_the_error_bit_is_an_error_whatever_else_it_is(ends):
    """The kernel's own filters (net/can/af_can.c) ask for this bit first, and no identifier has
    it."""
    ours, theirs = ends
    port = port_on(ours)
    theirs.socket.send(can_frame(0x80000000 | 0x1FFFFFFF, bytes(8)))
    theirs.socket.send(can_frame(0x40000000 | 0x123, b""))
    assert len(port.read()) == 2
    assert port.counters.error_frames == 0
    theirs.socket.send(can_frame(0x80000000 | 0x20000040, bytes(8)))
    assert len(port.read()) == 1
    assert port.counters.error_frames == 1
    assert port.state is LinkState.BUS_OFF


def test_one_line_is_logged_for_a_change_not_for_a_frame(ends, caplog):
    ours, theirs = ends
    port = port_on(ours)
    with caplog.at_level(logging.INFO):
        for _ in range(50):
            theirs.socket.send(can_frame(0x20000040, bytes(8)))
            port.read()
    assert [record.getMessage() for record in caplog.records] == [
        'bus "left": can0 is bus_off, was up'
    ]


def test_a_loose_plug_is_logged_ever_more_rarely(ends, caplog):
    ours, _ = ends
    clock = SteppedClock()
    port = port_on(ours, clock=clock)
    with caplog.at_level(logging.INFO):
        for number in range(7200):
            clock.advance(0.5)
            port._enter(LinkState.DOWN if number % 3 else LinkState.UP)
            port._log_state()
        assert 60 < len(caplog.records) < 70
        # A calm link is told of at once again.
        clock.advance(121.0)
        port._log_state()
        lines = len(caplog.records)
        clock.advance(121.0)
        for _ in range(2):
            clock.advance(2.5)
            port._enter(LinkState.DOWN if port.state is LinkState.UP else LinkState.UP)
            port._log_state()
    assert len(caplog.records) == lines + 2


def test_a_socket_that_fails_is_replaced():
    # A refused datagram is a one-shot error of the socket, as a removed device is.
    ours, theirs = pair()
    address = theirs.port
    opened: list[StandInBus] = []

    def reopen() -> can.BusABC:
        if len(opened) < 2:
            opened.append(ours)
            raise BusError("not there yet")
        return StandInBus(f"0-{address}")

    port = SocketCanPort("left", Bus(), Receive(), ours, reopen)
    theirs.shutdown()
    ours.socket.send(bytes(16))
    assert len(port.read()) == 0
    assert port.state is LinkState.GONE
    assert port.fileno() is None
    with StandInBus(f"{address}-0") as back:
        deadline = time.monotonic() + PATIENCE_S
        while port.state is LinkState.GONE and time.monotonic() < deadline:
            port.read()
            time.sleep(0.01)
        assert port.counters.reopened == 1
        back.connect(port._bus.port)
        back.socket.send(can_frame(0x410, bytes(8)))
        assert read_all(port, 1) == (1, 0)
    assert port.state is LinkState.UP
    assert port.counters.removals == 1
    port.close()


async def test_sent_frames_arrive_in_order_as_python_can_builds_them(ends):
    ours, theirs = ends
    port = port_on(ours)
    frames = [(0x20E, b"\x07\x00"), (0x7F0, b"\xff"), (0x201, bytes(8))]
    await port.send(frames, gap_s=0.0)
    for identifier, data in frames:
        message = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
        assert theirs.socket.recv(64) == build_can_frame(message)
    assert port.counters.sent == 3
    assert len(port.read()) == 0


async def test_nothing_is_sent_while_the_interface_is_down(ends):
    ours, _ = ends
    port = port_on(ours)
    port.state = LinkState.DOWN
    with pytest.raises(BusError, match="cannot send, down"):
        await port.send([(0x20E, b"")])


class FullQueue(can.BusABC):
    """An interface whose transmit queue is full for the first frames tried."""

    def __init__(self, full_for: int) -> None:
        super().__init__("full")
        self.left = full_for
        self.sent: list[int] = []

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.left -= 1
        if self.left >= 0:
            raise can.CanOperationError("No buffer space available", 105)
        self.sent.append(msg.arbitration_id)

    def _recv_internal(self, timeout):
        return None, False


async def test_a_full_transmit_queue_is_waited_for():
    with FullQueue(3) as bus:
        port = AdapterPort("left", Bus(interface="x"), bus)
        await port.send([(0x20E, b"")], gap_s=0.0)
        assert bus.sent == [0x20E]
        assert port.counters.send_retries == 3


async def test_a_transmit_queue_that_stays_full_is_an_error(monkeypatch):
    monkeypatch.setattr("skin_host.bus.port.SEND_DEADLINE_S", 0.02)
    with FullQueue(1 << 30) as bus:
        port = AdapterPort("left", Bus(interface="x"), bus)
        with pytest.raises(BusError, match=r"termination$"):
            await port.send([(0x20E, b"")])


async def test_of_a_network_interface_the_command_that_shows_more_is_named(monkeypatch):
    monkeypatch.setattr("skin_host.bus.port.SEND_DEADLINE_S", 0.02)
    ours, theirs = pair()
    monkeypatch.setattr(ours, "send", FullQueue(1 << 30).send)
    with pytest.raises(BusError, match=r"termination \(`ip -details .* link show can0`\)$"):
        await port_on(ours).send([(0x20E, b"")])
    ours.shutdown()
    theirs.shutdown()


def test_python_cans_socketcan_under_another_name_is_read_in_batches():
    register()
    port = open_port("left", Bus(interface="stand-in", channel="0-0"), SMALL)
    assert isinstance(port, SocketCanPort)
    port.close()


@pytest.mark.parametrize(
    ("bus", "says"),
    [
        (Bus(channel="nowhere7"), "no such network interface .*ip link add dev nowhere7 type vcan"),
        (Bus(channel="lo"), "not a CAN interface"),
        (
            Bus(interface="udp_multicast", channel="10.0.0.1"),
            "udp_multicast 10.0.0.1: cannot be opened",
        ),
    ],
)
def test_what_cannot_be_opened_is_one_line_with_its_name(bus, says, monkeypatch):
    def refuse():
        raise OSError(errno.EAFNOSUPPORT, "no netlink in the service's sandbox")

    monkeypatch.setattr(socket, "if_nameindex", refuse)
    with pytest.raises(BusError, match=f'bus "left": .*{says}') as caught:
        open_port("left", bus, Receive())
    assert "\n" not in str(caught.value)


async def test_an_interface_that_is_absent_at_the_start_is_one_that_is_gone(caplog):
    port = open_port("left", Bus(channel="nowhere7"), Receive(), wait=True)
    assert port.state is LinkState.GONE
    assert len(port.read()) == 0
    assert port.fileno() is None
    with pytest.raises(BusError, match="cannot send, gone"):
        await port.send([(0x20E, b"")])
    (line,) = caplog.messages
    assert "no such network interface" in line
    assert line.endswith("waiting for it")
    port.close()


def test_an_adapter_that_is_absent_at_the_start_is_used_once_it_is_there():
    register()
    taken, theirs = StandInBus(), StandInBus()
    theirs.connect(taken.port)
    port = open_port("left", Bus(interface="stand-in", channel=f"{taken.port}-0"), SMALL, wait=True)
    assert len(port.read()) == 0
    assert port.state is LinkState.GONE
    taken.shutdown()
    deadline = time.monotonic() + PATIENCE_S
    while port.state is not LinkState.UP and time.monotonic() < deadline:
        port.read()
    theirs.socket.send(can_frame(0x410, b"\x40"))
    assert read_all(port, 1) == (1, 0)
    assert (port.counters.removals, port.counters.reopened) == (0, 1)
    port.close()
    theirs.shutdown()


@pytest.mark.parametrize("wait", [True, False])
def test_a_kind_of_interface_that_python_can_does_not_know_is_never_waited_for(wait):
    with pytest.raises(ConfigurationError, match=r"python-can has no such interface; .*socketcan"):
        open_port("left", Bus(interface="psychic"), Receive(), wait=wait)
