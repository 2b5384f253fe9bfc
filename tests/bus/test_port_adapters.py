"""Interfaces that are not SocketCAN: the same batches, by way of python-can's virtual bus."""

import contextlib
import itertools
import math
import os
import threading
import time
import tracemalloc

import can
import pytest

from skin_host.bus import adapters
from skin_host.bus.adapters import CAPACITY, AdapterPort, nanoseconds
from skin_host.bus.multicast import MulticastBus
from skin_host.bus.opening import open_bus, open_port
from skin_host.bus.port import LinkState, Port
from skin_host.bus.wire import FrameBatch
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus, Receive
from skin_host.errors import BusError
from tests.support.datagrams import FRAME
from tests.support.sweeps import frames, make, values
from tests.support.waiting import PATIENCE_S

_numbers = itertools.count()


@pytest.fixture
def virtual():
    channel = f"adapters-{next(_numbers)}"
    port = open_port("left", Bus(interface="virtual", channel=channel), Receive())
    with can.Bus(interface="virtual", channel=channel) as other:
        yield port, other
    port.close()


def message(identifier: int, data: bytes = b"", **options: object) -> can.Message:
    options.setdefault("is_extended_id", False)
    return can.Message(arbitration_id=identifier, data=data, **options)


def test_frames_come_as_they_were_sent(virtual):
    port, other = virtual
    before_ns = time.time_ns()
    for i in range(3):
        other.send(message(0x410 + i, bytes(range(i))))
    batch = port.read()
    assert batch.id.tolist() == [0x410, 0x411, 0x412]
    assert batch.dlc.tolist() == [0, 1, 2]
    assert batch.data[2, :2].tolist() == [0, 1]
    assert before_ns - 1000 <= batch.t_ns[0] <= time.time_ns() + 1000
    assert port.counters.frames == 3
    assert port.fileno() is None


def test_flags_are_those_of_socketcan(virtual):
    port, other = virtual
    other.send(message(0x123, is_extended_id=True))
    other.send(message(0x123, is_remote_frame=True))
    other.send(message(0x040, bytes(8), is_error_frame=True))
    assert port.read().id.tolist() == [0x80000123, 0x40000123, 0x20000040]
    assert port.counters.error_frames == 1
    assert port.state is LinkState.BUS_OFF


def test_error_frames_are_counted_by_whatever_name_the_library_has_them(virtual):
    """`can.Message` is extended by default, and not every adapter's library changes that."""
    port, other = virtual
    other.send(can.Message(arbitration_id=0x004, data=[0, 0x20], is_error_frame=True))
    assert port.read().id.tolist() == [0x20000004]
    assert port.counters.error_frames == 1
    assert port.state is LinkState.ERROR_PASSIVE


def test_an_identifier_of_more_than_29_bits_is_damaged(virtual):
    port, other = virtual
    other.send(message(0x20000040, bytes(8), is_extended_id=True, check=False))
    assert len(port.read()) == 0
    assert (port.counters.damaged, port.counters.error_frames) == (1, 0)


def test_fd_frames_are_left_out(virtual):
    port, other = virtual
    other.send(message(0x123, bytes(64), is_fd=True))
    other.send(message(0x124))
    assert port.read().id.tolist() == [0x124]


def test_skin_only_leaves_other_classes_out():
    channel = f"adapters-{next(_numbers)}"
    settings = Bus(interface="virtual", channel=channel, skin_only=True)
    port = open_port("left", settings, Receive())
    with can.Bus(interface="virtual", channel=channel) as other:
        for message_class in range(8):
            other.send(message(message_class << 8 | 0x12))
        other.send(message(0x412, is_extended_id=True))
    assert port.read().id.tolist() == [0x212, 0x312, 0x412, 0x612, 0x712]
    port.close()


def test_a_flood_is_taken_in_bounded_reads(virtual):
    port, other = virtual
    for _ in range(CAPACITY + 5):
        other.send(message(0x410))
    assert [len(port.read()) for _ in range(3)] == [CAPACITY, 5, 0]


async def test_own_frames_do_not_come_back(virtual):
    port, other = virtual
    await port.send([(0x20E, b"\x07\x00")], gap_s=0.0)
    assert other.recv(1.0).arbitration_id == 0x20E
    assert len(port.read()) == 0


def test_time_stamps_that_count_from_power_on_are_replaced_by_the_time(virtual):
    port, _ = virtual
    sender = can.Bus(interface="virtual", channel=port.channel, preserve_timestamps=True)
    sender.send(message(0x410, timestamp=12.5))
    sender.send(message(0x410, timestamp=0.0))
    sender.shutdown()
    now_ns = time.time_ns()
    assert all(abs(int(t) - now_ns) < 10**9 for t in port.read().t_ns)


def test_a_time_stamp_that_is_no_number_is_replaced_by_the_time(virtual):
    port, _ = virtual
    sender = can.Bus(interface="virtual", channel=port.channel, preserve_timestamps=True)
    sender.send(message(0x410, timestamp=float("nan")))
    sender.shutdown()
    assert abs(int(port.read().t_ns[0]) - time.time_ns()) < 10**9


def test_a_bus_that_receives_is_not_off(virtual):
    port, other = virtual
    other.send(message(0x040, bytes(8), is_error_frame=True))
    port.read()
    assert port.state is LinkState.BUS_OFF
    other.send(message(0x410))
    port.read()
    assert port.state is LinkState.UP


def test_errors_on_the_wire_are_over_when_a_bus_receives_without_any():
    """Over multicast anybody can send an error frame; none may be believed for ever."""
    channel, clock = f"adapters-{next(_numbers)}", SteppedClock()
    settings = Bus(interface="virtual", channel=channel)
    port = open_port("left", settings, Receive(), clock=clock)
    with can.Bus(interface="virtual", channel=channel) as other:
        other.send(message(0x004, bytes([0, 0x20, 0, 0, 0, 0, 0, 0]), is_error_frame=True))
        port.read()
        for passed_s, state in ((9.0, LinkState.ERROR_PASSIVE), (2.0, LinkState.UP)):
            clock.advance(passed_s)
            assert port.state is LinkState.ERROR_PASSIVE
            other.send(message(0x410))
            port.read()
            assert port.state is state
    port.close()


def test_microseconds_survive_pythons_floats():
    for microseconds in range(0, 1_000_000, 997):
        text = f"1700000000.{microseconds:06d}"
        assert nanoseconds(float(text)) == 1700000000 * 10**9 + microseconds * 1000


class Unplugged(can.BusABC):
    """An adapter that is gone."""

    def __init__(self) -> None:
        super().__init__("unplugged")

    def _recv_internal(self, timeout):
        raise can.CanOperationError("read failed\nwith details")

    def send(self, msg, timeout=None):
        raise can.CanOperationError("write failed", 19)


def read_until(port: Port, state: LinkState) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while port.state is not state and time.monotonic() < deadline:
        port.read()
        time.sleep(0.01)
    assert port.state is state


def test_an_unplugged_adapter_is_opened_again(caplog):
    settings = Bus(interface="virtual", channel=f"adapters-{next(_numbers)}")
    port = AdapterPort("left", settings, Unplugged())
    assert len(port.read()) == 0
    assert port.state is LinkState.GONE
    assert "is gone (read failed), was up" in caplog.text
    read_until(port, LinkState.UP)
    with can.Bus(interface="virtual", channel=settings.channel) as other:
        other.send(message(0x410))
        assert len(port.read()) == 1
    assert port.counters.removals == port.counters.reopened == 1
    port.close()


class Pulled(can.BusABC):
    """An unplugged adapter as the libraries of Kvaser and of candleLight show it: reading finds no
    frame, as on a bus that is silent, and only sending fails.
    """

    def __init__(self, error: Exception) -> None:
        super().__init__("pulled")
        self.error = error

    def _recv_internal(self, timeout):
        return None, False

    def send(self, msg, timeout=None):
        raise self.error


def caused(cause: OSError) -> can.CanOperationError:
    error = can.CanOperationError("The message could not be sent")
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    "error",
    [
        can.CanOperationError("Hardware error detected", -15),  # canERR_HARDWARE
        can.CanOperationError("Handle is invalid", -10),  # canERR_INVHANDLE
        caused(OSError(19, "No such device")),
        OSError(5, "Input/Output Error"),
    ],
)
async def test_an_unplugged_adapter_that_only_sending_shows_is_opened_again(error):
    """It was silent until the daemon was started again."""
    settings = Bus(interface="virtual", channel=f"adapters-{next(_numbers)}")
    other = Bus(interface="kvaser", channel="0")
    port = AdapterPort("left", other, Pulled(error))
    assert len(port.read()) == 0
    with pytest.raises(BusError, match=r"cannot send"):
        await port.send([(0x20E, b"\x07\x00")])
    assert port.state is LinkState.GONE
    assert port.counters.removals == 1
    port._settings = settings  # it is plugged in again
    read_until(port, LinkState.UP)
    port.close()


@pytest.mark.parametrize(
    "error",
    [
        can.CanOperationError("Transmit buffer overflow", -13),  # canERR_TXBUFOFL
        can.CanOperationError("The transmit queue is full"),
        caused(OSError(110, "Operation timed out")),
    ],
)
async def test_an_adapter_without_room_for_a_frame_is_there(error, monkeypatch):
    monkeypatch.setattr("skin_host.bus.port.SEND_DEADLINE_S", 0.02)
    port = AdapterPort("left", Bus(interface="kvaser", channel="0"), Pulled(error))
    with pytest.raises(BusError, match="termination"):
        await port.send([(0x20E, b"\x07\x00")])
    assert port.state is LinkState.UP
    assert port.counters.send_retries > 0
    port.close()


def of_library(interface: str, *messages: can.Message) -> tuple[AdapterPort, list[int]]:
    """A port of a library that has read these messages, and the identifiers that it returns."""
    waiting = list(messages)

    class Library(can.BusABC):
        def __init__(self) -> None:
            super().__init__("library")

        def _recv_internal(self, timeout):
            return (waiting.pop(0) if waiting else None), False

        def send(self, msg, timeout=None):
            pass

    port = AdapterPort("left", Bus(interface=interface, channel="0"), Library())
    return port, port.read().id.tolist()


class OfBytes(can.BusABC):
    """A serial adapter as python-can reads one: byte by byte, with a wait for each that has not
    come yet. A line is a frame by its identifier, or, if that is 0, an acknowledgement.
    """

    def __init__(self) -> None:
        super().__init__("line")
        self.line, self.adapter = os.pipe2(os.O_NONBLOCK)
        self._begun = b""

    def _recv_internal(self, timeout):
        if not self._begun.endswith(b"\n"):
            try:
                self._begun += os.read(self.line, 1)
            except BlockingIOError:
                raise AssertionError("it would wait for the next byte") from None
        if not self._begun.endswith(b"\n"):
            return None, False
        line, self._begun = self._begun.rstrip(), b""
        frame = can.Message(arbitration_id=int(line, 16), is_extended_id=False)
        return (None if line == b"0" else frame), False

    def fileno(self):
        return self.line

    def send(self, msg, timeout=None):
        pass


@pytest.mark.parametrize("interface", ["seeedstudio", "serial", "slcan"])
def test_what_a_serial_line_has_is_read_at_once_and_nothing_is_waited_for(interface):
    """Each read of two of them lasted until 1024 frames had come, 1.6 s for a board; behind an
    acknowledgement frames stayed where they were.
    """
    adapter = OfBytes()
    port = AdapterPort("left", Bus(interface=interface, channel="line"), adapter)
    assert len(port.read()) == 0
    os.write(adapter.adapter, b"4e0\n0\n4e1\n4e")
    assert port.read().id.tolist() == [0x4E0, 0x4E1]
    assert len(port.read()) == 0
    os.write(adapter.adapter, b"2\n")
    assert port.read().id.tolist() == [0x4E2]
    port.close()


def test_a_serial_line_that_was_hung_up_is_an_adapter_that_is_gone():
    """Seeed's library reads it as a bus that is silent."""
    adapter = OfBytes()
    port = AdapterPort("left", Bus(interface="seeedstudio", channel="line"), adapter)
    os.close(adapter.adapter)
    assert len(port.read()) == 0
    assert port.state is LinkState.GONE
    port.close()


def test_an_adapter_that_is_numbered_is_found_by_its_number(monkeypatch):
    """candleLight's library compared the text with the number of adapters, and failed over that."""
    opened = []
    monkeypatch.setattr("can.Bus", lambda **options: opened.append(options["channel"]))
    for interface, channel in (("gs_usb", "1"), ("gs_usb", "any"), ("kvaser", "1")):
        open_bus("left", Bus(interface=interface, channel=channel))
    assert opened == [1, "any", "1"]


def test_frames_that_a_library_returns_to_their_sender_are_not_received():
    """That of candleLight returns each: they were recorded twice, and counted as others'."""
    own = message(0x20E, b"\x07\x00", is_rx=False)
    port, received = of_library("gs_usb", own, message(0x410, bytes(8)))
    assert received == [0x410]
    assert port.counters.frames == 1


@pytest.mark.parametrize(
    ("interface", "passive", "overflows"), [("pcan", False, 0), ("gs_usb", True, 1)]
)
def test_an_error_frame_has_the_meaning_that_its_library_gives_it(interface, passive, overflows):
    """PEAK's have the kind of a bit error, and its place in the frame: here 4, of the stuffing, at
    place 17."""
    error = can.Message(arbitration_id=4, data=[0, 0x11, 0, 0], is_error_frame=True)
    port, received = of_library(interface, error)
    assert len(received) == 1
    assert port.counters.error_frames == 1
    assert (port.state is LinkState.ERROR_PASSIVE) is passive
    assert port.counters.controller_overflows == overflows


class Sending(can.BusABC):
    """A library of an adapter whose frames come at their time; it stamps them when they are read,
    or, with an offset (s), by a clock of its own.
    """

    def __init__(
        self,
        clock: SteppedClock,
        sent: list[tuple[int, bytes, int]],
        own_s: float | None = None,
    ) -> None:
        super().__init__("sending")
        self._clock = clock
        self._began_ns = clock.now_ns()
        self._own_s = own_s
        self._sent = sorted(sent, key=lambda frame: frame[2])

    def _recv_internal(self, timeout):
        came_ns = self._began_ns + self._clock.since_boot_ns()
        if not self._sent or self._sent[0][2] > came_ns:
            return None, False
        identifier, data, t_ns = self._sent.pop(0)
        stamp_s = self._clock.now_ns() * 1e-9
        if self._own_s is not None:
            stamp_s = t_ns * 1e-9 + self._own_s
        return message(identifier, data, timestamp=stamp_s), False

    def send(self, msg, timeout=None):
        pass


@pytest.mark.parametrize("own_s", [0.0, -1_699_999_000.0])
@pytest.mark.parametrize("step_s", [0.3, 2.0, 1800.0, 5000.0, -0.3, -2.0, -1800.0, -5000.0])
def test_an_adapters_stamps_follow_this_computers_clock_when_it_is_set(own_s, step_s):
    """Sweeps seemed to be as old as that for up to four seconds, and were cut."""
    clock = SteppedClock()
    began_ns = clock.now_ns()
    sent = [(0x4E0, bytes(8), began_ns + number * 50_000_000) for number in range(200)]
    port = AdapterPort(
        "left", Bus(interface="pcan", channel="0"), Sending(clock, sent, own_s), clock
    )
    set_ns, n = 0, 0
    for turn in range(400):
        if turn == 200:
            clock.set(step_s)
            set_ns = round(step_s * 1e9)
        for t_ns in port.read().t_ns.tolist():
            came_ns = sent[n][2] + set_ns
            n += 1
            assert -1_000_000 <= t_ns - came_ns <= 26_000_000
            # Set back, it needs some frames that are read at once.
            if n > 45 and abs(step_s) < 3600 and not 100 <= n <= 140:
                assert abs(t_ns - came_ns) < 3_000_000
        clock.advance(0.0253)
    assert n == 200
    port.close()


def test_frames_of_a_read_are_in_order_also_as_the_adapters_clock_becomes_known():
    """A sweep was cut then: its first frames seemed to be newer than the others."""
    clock = SteppedClock()
    began_ns = clock.now_ns()
    sweeps = [began_ns + number * 50_000_000 for number in range(100)]
    sent = [(0x4E0 + i, bytes(8), t_ns + i * 111_000) for t_ns in sweeps for i in range(8)]
    library = Sending(clock, sent, own_s=-1_699_999_000.0)
    port = AdapterPort("left", Bus(interface="pcan", channel="0"), library, clock)
    found: list[int] = []
    for _ in range(200):
        clock.advance(0.0253)
        found += port.read().t_ns.tolist()
    assert len(found) == 800
    assert found == sorted(found)
    assert found[-1] == pytest.approx(sent[-1][2], abs=3_000_000)
    port.close()


def read_at(
    times_ms: list[float], sent: list[tuple[int, bytes, float]]
) -> tuple[list[FrameBatch], list[list[float]]]:
    """What reads at some times return, and the times that they give the frames; all in ms."""
    clock = SteppedClock()
    began_ns = clock.now_ns()
    on_bus = [(number, data, began_ns + round(t_ms * 1e6)) for number, data, t_ms in sent]
    port = AdapterPort("left", Bus(interface="slcan", channel="0"), Sending(clock, on_bus), clock)
    batches, found = [], []
    for t_ms in times_ms:
        clock.advance(t_ms * 1e-3 - (clock.now_ns() - began_ns) * 1e-9)
        batch = port.read()
        batches.append(
            FrameBatch(
                *(one.copy() for one in (batch.id, batch.dlc, batch.data)), batch.t_ns.copy()
            )
        )
        found.append([round((t_ns - began_ns) * 1e-6, 3) for t_ns in batch.t_ns.tolist()])
    port.close()
    return batches, found


def sweep_of(board: int, t_ms: float, triangles: int = 4) -> list[tuple[int, bytes, float]]:
    """The frames of a sweep that begins at a time, in ms; each takes 0.125."""
    raw = values(triangles, board)
    return [
        (number, data, t_ns * 1e-6) for number, data, t_ns in frames(raw, round(t_ms * 1e6), board)
    ]


def test_a_sweep_that_a_read_finds_half_sent_is_not_cut_by_the_next():
    """Reads are up to 26 ms apart. Such a sweep lasted for more than half of its period, so it was
    taken for two, again and again: single frames seemed lost, and a board seemed to send twice as
    often. A board that goes first may come between.
    """
    late, first = sweep_of(2, 9.6), sweep_of(1, 10.1)
    late[4:] = [(*one[:2], one[2] + 1.0) for one in late[4:]]
    batches, times = read_at([1.0, 10.05, 36.0, 60.0], late + first)
    assert [len(one) for one in times] == [0, 4, 12, 0]
    assert times[1] == [10.05] * 4
    assert times[2] == pytest.approx([10.05 + 0.111 * n for n in range(1, 13)])
    assembler = make("0-3", boards=2)
    sweeps = [sweep for batch in batches for sweep in assembler.feed(batch).sweeps]
    assert sorted(sweep.board for sweep in sweeps) == [0, 1]
    assert {sweep.present for sweep in sweeps} == {0b1111}
    assert assembler.counters.incomplete == assembler.counters.halves == 0


def test_frames_behind_those_of_a_sweep_that_was_half_sent_come_when_they_are_read():
    others = [(0x123, b"\x40", 20.0), (0x124, b"\x40", 20.0), *sweep_of(1, 34.0)]
    _, times = read_at([1.0, 10.05, 36.0], sweep_of(2, 9.6) + others)
    assert times[2] == [pytest.approx(10.05 + 0.111 * n) for n in range(1, 5)] + [36.0] * 10


@pytest.mark.parametrize("apart_ms", [15.0, 25.0, 50.0])
def test_a_sweep_is_not_dated_by_the_one_before(apart_ms):
    """It has the same frames: nothing shows that it followed at once."""
    sent = [*sweep_of(1, 8.0), *sweep_of(1, 8.0 + apart_ms), *sweep_of(1, 8.0 + 2 * apart_ms)]
    reads = [1.0, *(10.0 + number * apart_ms for number in range(3))]
    _, times = read_at(reads, sent)
    assert times == [[], *([t_ms] * 8 for t_ms in reads[1:])]


@pytest.mark.parametrize("pause_ms", [31.0, 300.0])
def test_what_waited_while_this_computer_was_busy_did_not_follow_at_once(pause_ms):
    _, times = read_at([1.0, 10.05, 10.05 + pause_ms], sweep_of(1, 9.6))
    assert times[2] == [10.05 + pause_ms] * 4


@pytest.mark.parametrize(
    ("interface", "stamp_s", "late"),
    [
        ("kvaser", 0.0, False),
        ("pcan", 0.0, False),
        ("pcan", -1e6, True),
        ("slcan", 0.0, True),
        ("virtual", 0.0, True),
    ],
)
def test_a_busy_computer_moves_no_stamps_of_an_adapters_own_clock(interface, stamp_s, late):
    """Whatever is amiss on its bus was put down to a pause of 50 ms of this computer."""
    stamped = message(0x410, bytes(8), timestamp=time.time() + stamp_s)
    port, received = of_library(interface, stamped)
    assert received == [0x410]
    assert port.stamps_late is late
    assert len(port.read()) == 0
    assert port.stamps_late is late


def test_buses_by_multicast_do_not_hear_each_other():
    pytest.importorskip("msgpack")
    here, there = (Bus(interface="udp_multicast", channel=f"239.74.163.{n}") for n in (201, 202))
    with open_bus("a", here) as sender, open_bus("b", here) as near, open_bus("c", there) as far:
        try:
            sender.send(message(0x410, b"\x01"))
        except can.CanError:
            pytest.skip("this machine has no network for multicast")
        received = near.recv(5)
        assert received is not None
        assert received.arbitration_id == 0x410
        assert far.recv(0) is None


@pytest.mark.parametrize(
    "changes",
    [
        {"data": 200_000_000},
        {"data": 2**63},
        {"data": -1},
        {"data": "12345678"},
        {"data": [1] * 8},
        {"data": bytes(65), "dlc": 65},
        {"dlc": 2**40},
        {"dlc": -1},
        {"dlc": 4.0},
        {"arbitration_id": 2**63},
        {"arbitration_id": "x"},
        {"is_extended_id": [0] * 100},
        {"timestamp": "now"},
        {"timestamp": [0.0] * 100},
        {"channel": None, "data": None},
    ],
)
def test_a_datagram_that_is_no_frame_costs_its_own_size_alone(changes: dict[str, object]) -> None:
    """A number as data makes as many bytes in python-can: one datagram filled the memory."""
    msgpack = pytest.importorskip("msgpack")
    group = Bus(interface="udp_multicast", channel="239.74.163.204")
    port = open_port("left", group, Receive())
    near = open_bus("b", group)
    with can.Bus(interface="udp_multicast", channel=group.channel) as other:
        try:
            other._multicast.send(msgpack.packb(FRAME | changes))
            other.send(message(0x411, b"\x01"))
        except can.CanError:
            pytest.skip("this machine has no network for multicast")
        tracemalloc.start()
        with contextlib.suppress(can.CanError):
            near.recv(PATIENCE_S)
        assert near.recv(PATIENCE_S).arbitration_id == 0x411
        assert port.read().id.tolist() == [0x411]
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < 5_000_000
    assert port.counters.damaged == 1
    near.shutdown()
    port.close()


@pytest.mark.parametrize(
    ("sent", "times_s"),
    [
        ([-0.4, -0.39987, -0.2], [-0.4, -0.39987, -0.2]),  # of an emulator that was held up
        ([0.0, -2.0, 3600.0, -1e9, math.nan, math.inf, -math.inf, None], [0.0] * 8),  # other clocks
        ([-2.0, -0.5, 0.0], [0.0] * 3),  # of those, some seem to be of just now
        ([-0.3, -0.4, -0.1], [-0.3, -0.3, -0.1]),  # of two senders
    ],
)
def test_a_frame_over_multicast_has_its_senders_time_if_that_was_just_now(
    sent: list[float | None], times_s: list[float]
) -> None:
    msgpack = pytest.importorskip("msgpack")
    now_s = 1_700_000_000.0
    with open_bus("a", Bus(interface="udp_multicast", channel="239.74.163.205")) as bus:
        assert isinstance(bus, MulticastBus)
        datagrams = [
            msgpack.packb(FRAME | {"timestamp": None if one is None else now_s + one})
            for one in sent
        ]
        bus._multicast.recv = lambda _: (datagrams.pop(0), ("", 0), now_s)
        found = [bus._recv_internal(0)[0] for _ in sent]
    assert [one.timestamp - now_s for one in found if one is not None] == pytest.approx(
        times_s, abs=1e-6
    )


def test_a_clock_that_is_set_back_is_followed_over_multicast() -> None:
    msgpack = pytest.importorskip("msgpack")
    with open_bus("a", Bus(interface="udp_multicast", channel="239.74.163.206")) as bus:
        assert isinstance(bus, MulticastBus)
        arrivals_s = [1000.0, 1001.0, 500.0, 501.0]
        received = iter(
            (msgpack.packb(FRAME | {"timestamp": at_s - 0.25}), ("", 0), at_s)
            for at_s in arrivals_s
        )
        bus._multicast.recv = lambda _: next(received)
        found = [bus._recv_internal(0)[0] for _ in arrivals_s]
    assert [one.timestamp for one in found if one is not None] == [999.75, 1000.75, 500.0, 500.75]


def test_fd_frames_over_multicast_hold_up_no_others():
    """With this option python-can's `recv(0)` returns None for them, even if others wait."""
    pytest.importorskip("msgpack")
    group = Bus(interface="udp_multicast", channel="239.74.163.203", options={"fd": False})
    near = open_bus("b", group)
    port = open_port("left", group, Receive())
    with can.Bus(interface="udp_multicast", channel=group.channel) as other:
        try:
            for _ in range(5):
                other.send(message(0x123, bytes(64), is_fd=True))
            other.send(message(0x410))
        except can.CanError:
            pytest.skip("this machine has no network for multicast")
        arrived = iter(lambda: near.recv(PATIENCE_S), None)
        assert any(one.arbitration_id == 0x410 for one in arrived)
        assert port.read().id.tolist() == [0x410]
    near.shutdown()
    port.close()


@pytest.mark.parametrize(
    ("interface", "extra"), [("slcan", "serial"), ("serial", "serial"), ("gs_usb", "gs-usb")]
)
def test_an_adapter_whose_package_is_not_installed_names_it(monkeypatch, interface, extra):
    def absent(*_, **__):
        raise can.CanInterfaceNotImplementedError("the module is not installed")

    monkeypatch.setattr("can.Bus", absent)
    bus = Bus(interface=interface, channel="/dev/none")
    with pytest.raises(BusError, match=rf"pip install 'python-can\[{extra}\]'"):
        open_bus("left", bus)


def test_a_daemon_waits_for_a_package_as_for_an_adapter_and_names_it_until_it_is_there(
    monkeypatch, caplog
):
    """It ended, so that the other buses of the robot were not read either."""
    there = can.Bus

    def absent(*_, **__):
        raise can.CanInterfaceNotImplementedError("the module is not installed")

    monkeypatch.setattr("can.Bus", absent)
    clock = SteppedClock()
    bus = Bus(interface="virtual", channel=f"adapters-{next(_numbers)}")
    monkeypatch.setitem(adapters._EXTRAS, "virtual", "serial")
    port = open_port("left", bus, Receive(), wait=True, clock=clock)
    assert "pip install 'python-can[serial]'; waiting for it" in caplog.text
    for _ in range(20):
        assert len(port.read()) == 0
        assert port.state is LinkState.GONE
        assert port.unopened.startswith(f"virtual {bus.channel}: cannot be opened: the module is")
        assert port.unopened.endswith("pip install 'python-can[serial]'")
        clock.advance(0.1)
    monkeypatch.setattr("can.Bus", there)
    for _ in range(20):
        port.read()
        clock.advance(0.1)
    assert port.state is LinkState.UP
    assert port.unopened == ""
    port.close()


def test_an_adapter_that_lacks_its_options_names_where_they_are_given():
    wanted = r"'host' and 'port'; .* from \[buses\.left\.options\]"
    with pytest.raises(BusError, match=wanted):
        open_bus("left", Bus(interface="socketcand", channel="can0"))


def test_a_group_that_is_no_multicast_address_is_named_as_the_reason() -> None:
    wanted = "Invalid argument; wanted a multicast address, and a route to it"
    with pytest.raises(BusError, match=wanted):
        open_bus("left", Bus(interface="udp_multicast", channel="127.0.0.1"))


def test_an_adapter_without_its_makers_library_is_named_as_such(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Kvaser's then lacks the functions that python-can calls."""

    def absent(*_: object, **__: object) -> None:
        raise NameError("name 'canGetNumberOfChannels' is not defined")

    monkeypatch.setattr("can.Bus", absent)
    with pytest.raises(BusError, match="the library of its maker is not installed"):
        open_bus("left", Bus(interface="kvaser", channel="0"))


def test_an_adapter_that_does_not_answer_is_named_to_the_emulator_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It waited for ever, without a word, as for a server of buses that greets and does no more."""
    ended = threading.Event()
    monkeypatch.setattr(adapters, "OPEN_S", 0.2)
    monkeypatch.setattr("can.Bus", lambda **_: ended.wait(PATIENCE_S))
    with pytest.raises(BusError, match=r"kvaser 0: has not answered for 0\.2 s: check its plug"):
        open_bus("left", Bus(interface="kvaser", channel="0"))
    ended.set()
