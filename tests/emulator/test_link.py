"""The emulator's side of a bus that python-can reads frame by frame."""

import errno
import select
import socket
import threading
from collections import deque

import can
import numpy as np
import pytest

from emulator.link import MOST_READS, BoardLink
from skin_host.bus.served import ServedBus
from skin_host.bus.wire import FrameBatch


def message(identifier: int, data: bytes = b"", **kind: bool) -> can.Message:
    kind.setdefault("is_extended_id", False)
    return can.Message(arbitration_id=identifier, data=data, **kind)


def test_a_command_behind_any_number_of_other_frames_is_received_at_once() -> None:
    """As on udp_multicast, which gives a sender its own stream back."""
    with (
        can.Bus(interface="virtual", channel="emulators-link") as boards,
        can.Bus(interface="virtual", channel="emulators-link") as others,
    ):
        link = BoardLink("can0", boards)
        for _ in range(1000):
            others.send(message(0x4E0, bytes(8)))
        for other in (
            message(0x21E, b"\x01"),
            message(0x20E, b"\x01", is_extended_id=True),
            message(0x20E, is_remote_frame=True),
            message(0x20E, bytes(64), is_fd=True),
        ):
            others.send(other)
        others.send(message(0x20E, b"\x07\x00"))
        others.send(message(0x70E, b"\xff"))
        assert list(link.received()) == [(0x20E, b"\x07\x00"), (0x70E, b"\xff")]


class Adapter(can.BusABC):
    """Gives what it is given to give, and fails as it is told to."""

    def __init__(self, *gives: can.Message | Exception) -> None:
        super().__init__(channel=None)
        self.gives = deque(gives)
        self.send_fails: Exception | None = None
        self.took: list[int] = []

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self.gives:
            return None, False
        given = self.gives.popleft()
        if isinstance(given, Exception):
            raise given
        return given, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.send_fails is not None:
            raise self.send_fails
        self.took.append(msg.arbitration_id)


def unpacked(cause: Exception) -> can.CanOperationError:
    """As python-can fails over what anybody may send by multicast."""
    error = can.CanOperationError("could not unpack received message")
    error.__cause__ = cause
    return error


COMMAND = message(0x20E, b"\x07\x00")


@pytest.mark.parametrize(
    "damage",
    [
        unpacked(ValueError("not msgpack")),
        unpacked(TypeError("unexpected keyword argument")),
        ValueError("invalid literal for int() with base 16"),
        IndexError("bytearray index out of range"),
        message(0x20E, bytes(20)),
        can.Message(arbitration_id=0x20E, data=b"\x07\x00", dlc=8, is_extended_id=False),
        can.Message(arbitration_id=0x20E, data=b"\x07", dlc="x", is_extended_id=False),  # type: ignore[arg-type]
        can.Message(arbitration_id=526.0, data=b"\x07", is_extended_id=False),  # type: ignore[arg-type]
        message(0x20E, b"\x07\x00", is_error_frame=True),
    ],
    ids=lambda value: type(value).__name__,
)
def test_damaged_frames_neither_end_the_emulator_nor_hide_the_commands_behind_them(
    damage: can.Message | Exception, caplog: pytest.LogCaptureFixture
) -> None:
    with Adapter(damage, damage, COMMAND) as bus:
        assert list(BoardLink("can0", bus).received()) == [(0x20E, b"\x07\x00")]
    assert not caplog.records


def test_a_line_that_is_damaged_hides_no_command_of_a_server_of_buses_and_repeats_none() -> None:
    """python-can keeps what it failed over, with what came before it, and reads that again."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        accepted: list[socket.socket] = []

        def greet() -> None:
            accepted.append(server.accept()[0])
            accepted[0].sendall(b"< hi >")
            for _ in ("open", "rawmode"):
                accepted[0].recv(100)
                accepted[0].sendall(b"< ok >")

        greeting = threading.Thread(target=greet)
        greeting.start()
        host, port = server.getsockname()
        with ServedBus("can0", host, port) as bus:
            greeting.join()
            link = BoardLink("can0", bus)
            start, stop = b"< frame 20E 1.0 0700 >", b"< frame 20E 1.0 0701 >"
            for damage in (b"< frame zzz 1.0 00 >", b"< frame 20E >", b"< frame 20E 1.0 0 >"):
                received: list[list[tuple[int, bytes]]] = []
                for sent in (stop + damage + start, start, start):
                    accepted[0].sendall(sent)
                    select.select([vars(bus)["_SocketCanDaemonBus__socket"]], [], [])
                    received.append(list(link.received()))
                assert received == [
                    [(0x20E, b"\x07\x01"), (0x20E, b"\x07\x00")],
                    [(0x20E, b"\x07\x00")],
                    [(0x20E, b"\x07\x00")],
                ]
        accepted[0].close()


@pytest.mark.parametrize(
    "failure",
    [
        can.CanOperationError("failed", errno.ENETDOWN),
        can.CanTimeoutError("not sent"),
        OSError(errno.ENETUNREACH, "Network is unreachable"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_bus_that_fails_is_logged_once_and_works_again(
    failure: Exception, caplog: pytest.LogCaptureFixture
) -> None:
    frames = FrameBatch.of([(0x4E0, bytes(8), 5), (0x4E1, bytes(8), 5)])
    with Adapter(failure, COMMAND) as bus:
        link = BoardLink("can0", bus)
        assert list(link.received()) == []
        bus.send_fails = failure
        link.send(frames, np.array([5, 5]))
        assert len(caplog.records) == 1
        assert "frames wait or are lost until it works" in caplog.records[0].getMessage()
        bus.send_fails = None
        assert list(link.received()) == [(0x20E, b"\x07\x00")]
        link.send(FrameBatch.of([(0x4E2, bytes(8), 6)]), np.array([6]))
        assert bus.took == [0x4E0, 0x4E1, 0x4E2]
    assert (link.sent, link.lost) == (3, 0)


def caused(error: can.CanError, cause: Exception) -> can.CanError:
    """As a library raises it, with a traceback in its text."""
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("failure", "reason"),
    [
        (can.CanOperationError("No such device", errno.ENODEV), "No such device"),
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), "Broken pipe"),
        (
            caused(
                can.CanError("failed  Traceback (most recent call last):\n"),
                ConnectionResetError(errno.ECONNRESET, "Connection reset by peer"),
            ),
            "Connection reset by peer",
        ),
        (
            caused(can.CanError("timed out\n"), TimeoutError(errno.ETIMEDOUT, "timed out")),
            "timed out",
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_bus_that_never_works_again_is_named_in_a_line(
    failure: Exception, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    """An interface that was removed, or a server of buses that has ended."""
    with Adapter(failure) as bus:
        assert list(BoardLink("can0", bus).received()) == []
    (line,) = [record.getMessage() for record in caplog.records]
    assert reason in line
    assert line.endswith("start the emulator again when it is back")
    assert "\n" not in line


def test_a_bus_on_which_commands_never_end_lets_the_boards_live() -> None:
    with Adapter(*[COMMAND] * (MOST_READS + 5)) as bus:
        link = BoardLink("can0", bus)
        assert [len(list(link.received())) for _ in range(3)] == [MOST_READS, 5, 0]
