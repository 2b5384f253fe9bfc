"""Adapters that send damage, hang, or never answer: a state of their bus, and nothing more.

The libraries are python-can's own. The serial adapter (slcan) is the other end of a
pseudo-terminal; the server of buses (socketcand) is a thread with a real socket.
"""

import array
import asyncio
import contextlib
import fcntl
import os
import re
import signal
import socket
import subprocess
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from skin_host.bus import adapters, port
from skin_host.bus.adapters import Stamps
from skin_host.bus.opening import open_port
from skin_host.bus.port import LinkState, Port
from skin_host.config.settings import Bus, Receive
from skin_host.errors import BusError
from tests.support.broker import free_port
from tests.support.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]
GOOD = b"t4E0840F4F4F3F4F4F3F4\r"
LAST = b"t4E1840F4F4F3F4F4F3F5\r"


class Line:
    """What slcan needs of pyserial's port."""

    write_timeout = None

    def __init__(self, path: str) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_NOCTTY)

    def fileno(self) -> int:
        return self._fd

    @property
    def in_waiting(self) -> int:
        n = array.array("i", [0])
        fcntl.ioctl(self._fd, termios.FIONREAD, n)
        return n[0]

    def read(self, n: int) -> bytes:
        return os.read(self._fd, n) if self.in_waiting else b""

    def write(self, data: bytes) -> None:
        os.write(self._fd, data)

    def flush(self) -> None:
        pass

    def close(self) -> None:
        os.close(self._fd)


class Adapter:
    """The device at the other end."""

    def __init__(self) -> None:
        self.device, self.tty = os.openpty()
        tty.setraw(self.tty)
        self.path = os.ttyname(self.tty)

    def says(self, *lines: bytes) -> None:
        for line in lines:
            os.write(self.device, line)


@pytest.fixture
def adapter(monkeypatch: pytest.MonkeyPatch) -> Iterator[Adapter]:
    serial = SimpleNamespace(
        serial_for_url=lambda path, **_: Line(path),
        Timeout=lambda _: SimpleNamespace(expired=lambda: True),
    )
    monkeypatch.setattr("can.interfaces.slcan.serial", serial)
    made = Adapter()
    yield made
    for end in (made.device, made.tty):
        os.close(end)


@pytest.fixture
def slcan(adapter: Adapter) -> Iterator[Port]:
    settings = Bus(interface="slcan", channel=adapter.path, options={"sleep_after_open": 0.0})
    opened = open_port("left", settings, Receive())
    yield opened
    opened.close()


def read_until(bus: Port, condition: Callable[[list[tuple[int, bytes]]], bool]) -> None:
    frames: list[tuple[int, bytes]] = []
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition(frames):
        assert time.monotonic() < deadline_s, (frames, bus.state, bus.counters)
        batch = bus.read()
        frames += zip(batch.id.tolist(), map(bytes, batch.data), strict=True)
        time.sleep(0.005)


@pytest.mark.parametrize(
    "damage",
    [
        b"t4E08\r",
        b"t4E0840F4F4F3F4F4\r",
        b"t4E0840F4F4F3F4F4F3F\r",
        b"t4E0840F4F4F3F4F4F3Fx\r",
        b"tz",
        b"t\r",
        b"T4E0\r",
        b"t4E0",
        b"r4E09\r",
        b"b\r",
        b"D000000000\r",
        b"t4E09" + 9 * b"00" + b"\r",
        b"\a\a\a",
        b"\0\0\0\r",
    ],
)
def test_a_damaged_line_of_a_serial_adapter_is_no_frame_and_ends_nothing(
    adapter: Adapter, slcan: Port, damage: bytes
) -> None:
    """Cut lines are the commonest damage: what they lack is not taken from an earlier frame."""
    adapter.says(GOOD * 3)
    read_until(slcan, lambda frames: len(frames) == 3)
    adapter.says(damage, b"\r", LAST)
    seen: list[tuple[int, bytes]] = []

    def came(frames: list[tuple[int, bytes]]) -> bool:
        seen[:] = frames
        return bool(frames) and frames[-1][0] == 0x4E1

    read_until(slcan, came)
    assert [one for one in seen if one[0] == 0x4E0] == []
    assert slcan.state is LinkState.UP


@pytest.mark.parametrize("noise", [b"\xff\r", b"x" * 3000])
def test_what_a_library_does_not_get_past_opens_the_adapter_again(
    adapter: Adapter, slcan: Port, noise: bytes
) -> None:
    """A byte that is no text stays in slcan's buffer; a line without an end fills it."""

    def again(_: list[tuple[int, bytes]]) -> bool:
        if not slcan.counters.removals:
            adapter.says(noise)
        return slcan.counters.reopened > 0

    def good(frames: list[tuple[int, bytes]]) -> bool:
        adapter.says(b"\r", LAST)
        return any(one[0] == 0x4E1 for one in frames)

    read_until(slcan, again)
    read_until(slcan, good)


async def test_an_adapter_that_takes_nothing_holds_nobody_up(
    adapter: Adapter, slcan: Port, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapters, "SEND_DEADLINE_S", 0.1)
    monkeypatch.setattr(port, "SEND_DEADLINE_S", 0.1)
    termios.tcflow(adapter.tty, termios.TCOOFF)
    turns = 0

    async def work() -> None:
        nonlocal turns
        while True:
            await asyncio.sleep(0.001)
            turns += 1

    working = asyncio.create_task(work())
    with pytest.raises(BusError, match="it has taken no frame for"):
        await slcan.send([(0x20E, b"\x07\x00")])
    working.cancel()
    assert turns
    assert slcan.state is LinkState.GONE
    termios.tcflow(adapter.tty, termios.TCOON)
    read_until(slcan, lambda _: slcan.state is LinkState.UP)


class Server:
    """A socketcand whose manners are given: what it answers to each of a client's messages."""

    def __init__(self, answers: Callable[[int], Iterable[bytes]]) -> None:
        self.answers = answers
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        self.connections = 0
        self.clients: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._socket.accept()
                self.connections += 1
                self.clients.append(client)
                serving = (client, self.answers(self.connections))
                threading.Thread(target=self._serve, args=serving, daemon=True).start()

    @staticmethod
    def _serve(client: socket.socket, answers: Iterable[bytes]) -> None:
        with contextlib.suppress(OSError), client:
            for answer in answers:
                client.sendall(answer)
                if not client.recv(1000):
                    return
            while client.recv(1000):
                pass

    def drop(self) -> None:
        """End all connections, as when it restarts."""
        for client in self.clients:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._socket.close()


def greets_always(connection: int) -> list[bytes]:
    return [b"< hi >", b"< ok >", b"< ok >"]


async def send_until(bus: Port, condition: Callable[[], bool]) -> None:
    """Read, and send as to boards that are silent, until a condition holds."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, (bus.state, bus.unopened, bus.counters)
        bus.read()
        with contextlib.suppress(BusError):
            await bus.send([(0x20E, b"\x07\x00")])
        await asyncio.sleep(0.02)


@pytest.fixture
def served() -> Iterator[tuple[Server, Callable[[], Port]]]:
    """A server that can be changed, and what opens its bus."""
    server = Server(greets_always)
    options: dict[str, str | int] = {"host": "127.0.0.1", "port": server.port}
    settings = Bus(interface="socketcand", channel="can0", options=options)
    opened: list[Port] = []

    def open_it() -> Port:
        opened.append(open_port("left", settings, Receive()))
        return opened[-1]

    yield server, open_it
    server.close()
    server.drop()
    for one in opened:
        one.close()


async def received_until(bus: Port, number: int) -> list[int]:
    """Return the identifiers of at least so many frames."""
    found: list[int] = []
    end_s = time.monotonic() + PATIENCE_S
    while len(found) < number:
        assert time.monotonic() < end_s, found
        await asyncio.sleep(0.01)
        found += bus.read().id.tolist()
    return found


async def test_a_server_of_buses_that_restarts_is_connected_to_again(
    served: tuple[Server, Callable[[], Port]],
) -> None:
    """Its library reads the end of a connection as no frame: only sending shows it."""
    server, open_it = served
    bus = open_it()
    assert bus.state is LinkState.UP
    server.drop()
    await send_until(bus, lambda: bus.counters.reopened == 1)
    assert bus.state is LinkState.UP
    assert bus.counters.removals == 1


async def test_frames_behind_a_damaged_line_of_a_server_of_buses_are_received_once(
    served: tuple[Server, Callable[[], Port]],
) -> None:
    """python-can's client kept that line, and began with those before it again at each later one:
    a board that had died seemed to go on, and nothing of the others was received.
    """
    server, open_it = served
    bus = open_it()

    def frame(can_id: int) -> bytes:
        return b"< frame %x %.6f 4000000000000000 >" % (can_id, time.time())

    server.clients[-1].sendall(frame(0x410) + b"< frame zzz 1.0 00 >" + frame(0x411))
    received = await received_until(bus, 2)
    for can_id in range(0x420, 0x424):
        server.clients[-1].sendall(frame(can_id))
        received += await received_until(bus, 1)
    assert received == [0x410, 0x411, 0x420, 0x421, 0x422, 0x423]
    assert bus.counters.damaged == 1
    assert bus.state is LinkState.UP


def test_the_connection_to_a_server_of_buses_fails_if_its_computer_vanishes(
    served: tuple[Server, Callable[[], Port]],
) -> None:
    """Where no packet comes back, not even a refusal, reading would wait for ever."""
    _, open_it = served
    connection = vars(open_it()._bus)["_SocketCanDaemonBus__socket"]
    tcp = socket.IPPROTO_TCP
    assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
    # What was sent fails after 5 s, and where nothing is sent, probes that begin after 1 s.
    assert connection.getsockopt(tcp, socket.TCP_USER_TIMEOUT) == 5000
    assert connection.getsockopt(tcp, socket.TCP_KEEPIDLE) == 1
    assert connection.getsockopt(tcp, socket.TCP_KEEPINTVL) == 1


async def test_a_server_that_does_not_answer_any_more_is_named(
    served: tuple[Server, Callable[[], Port]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapters, "OPEN_S", 0.2)
    server, open_it = served
    bus = open_it()
    works_again = threading.Event()

    def answers(connection: int) -> Iterator[bytes]:
        yield b"< hi >"
        works_again.wait(PATIENCE_S)
        yield b"< ok >"
        yield b"< ok >"

    server.answers = answers
    server.drop()
    await send_until(bus, lambda: bool(bus.unopened))
    assert bus.state is LinkState.GONE
    assert bus.unopened == "socketcand can0: has not answered for 0.2 s: check its plug and power"
    works_again.set()
    await send_until(bus, lambda: bus.state is LinkState.UP)
    assert not bus.unopened


def configuration(folder: Path, tcp_port: int) -> Path:
    text = (ROOT / "config" / "demo.toml").read_text()
    text = re.sub(r'interface = ".*"', 'interface = "socketcand"', text)
    options = f'options = {{ host = "127.0.0.1", port = {tcp_port} }}'
    text = re.sub(r'channel = ".*"', f'channel = "can0"\n{options}', text)
    text += f"\n[mqtt]\nport = {free_port()}\n[service]\nstate_directory = '{folder}/state'\n"
    path = folder / "robot.toml"
    path.write_text(text)
    return path


def greeting_only(connection: int) -> list[bytes]:
    return [b"< hi >"] if connection < 3 else []


def damage(connection: int) -> list[bytes]:
    return [b"< hi >", b"< ok >", b"< ok >", b"< frame zzz 1.0 00 >\xff" * 20]


@pytest.mark.parametrize("answers", [None, lambda _: [], greeting_only, damage])
def test_a_server_of_buses_that_misbehaves_fills_no_log_and_the_daemon_ends_when_told(
    tmp_path: Path, answers: Callable[[int], list[bytes]] | None
) -> None:
    server = None if answers is None else Server(answers)
    path = configuration(tmp_path, free_port() if server is None else server.port)
    with (tmp_path / "log").open("w") as log:
        program = [sys.executable, "-m", "skin_host", "run", str(path)]
        daemon = subprocess.Popen(program, cwd=ROOT, stdout=log, stderr=log)
    try:
        deadline_s = time.monotonic() + PATIENCE_S
        while "broker" not in (tmp_path / "log").read_text():
            assert daemon.poll() is None, (tmp_path / "log").read_text()
            assert time.monotonic() < deadline_s, (tmp_path / "log").read_text()
            time.sleep(0.1)
        time.sleep(1.0)
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(PATIENCE_S) == 0
    finally:
        daemon.kill()
        if server is not None:
            server.close()
    said = (tmp_path / "log").read_text()
    assert "Traceback" not in said
    assert len(said) < 5_000
    assert "socketcand can0" in said or "can0 is gone" in said or "did not answer" in said


def test_a_server_whose_port_is_given_as_text_is_connected_to() -> None:
    """Its client tried for 10 s without a pause, and the daemon named no reason."""
    server = Server(lambda _: [b"< hi >", b"< ok >", b"< ok >"])
    options: dict[str, object] = {"host": "127.0.0.1", "port": str(server.port)}
    bus = open_port("left", Bus(interface="socketcand", channel="can0", options=options), Receive())
    assert bus.state is LinkState.UP
    bus.close()
    server.close()


@pytest.mark.parametrize("ahead_s", [-300.0, -0.5, -0.02, 0.0, 0.02, 300.0, 1e9])
def test_another_computers_clock_does_not_move_the_frames(ahead_s: float) -> None:
    """Sweeps seemed cut, and boards to have sent minutes ago or in the future."""
    handshake = [b"< hi >", b"< ok >", b"< ok >"]
    server = Server(lambda _: handshake)
    options: dict[str, object] = {"host": "127.0.0.1", "port": server.port}
    settings = Bus(interface="socketcand", channel="can0", options=options)
    bus = open_port("left", settings, Receive())
    for _ in range(20):
        sent_ns = time.time_ns()
        server.clients[-1].sendall(
            f"< frame 4E0 {sent_ns * 1e-9 + ahead_s:.6f} 40F4F4F3F4F4F3F4 >".encode()
        )
        n = 0
        while not n:
            batch = bus.read()
            n = len(batch)
        assert sent_ns - 2_000_000 <= batch.t_ns[0] <= time.time_ns() + 1000
    bus.close()
    server.close()


def test_stamps_follow_a_clock_that_runs_slowly_and_keep_what_waited() -> None:
    stamps, slow = Stamps(), 1 - 1e-3
    now_s = 1_700_000_000.0
    began_s = now_s
    for _ in range(2000):
        now_s += 0.05
        sent_s = began_s + (now_s - began_s) * slow
        assert now_s - 0.005 < stamps.here(sent_s, now_s) <= now_s
    # This computer was stopped for 10 s; what waited comes in a burst.
    paused_s = now_s
    now_s += 10.0
    for number in range(200):
        sent_s = paused_s + 0.05 * number
        stamp_s = stamps.here(began_s + (sent_s - began_s) * slow, now_s)
        assert abs(stamp_s - sent_s) < 0.02


def test_what_waits_while_the_computer_is_too_busy_for_seconds_keeps_its_stamps() -> None:
    """Then no frame is read at once for longer than a clock is judged by."""
    stamps = Stamps()
    sent_s = now_s = 1_700_000_000.0
    for number in range(400):
        sent_s += 0.05
        # It needs longer for a frame than the next takes to come, and then catches up.
        now_s = max(sent_s, now_s + (0.09 if 40 <= number < 240 else 0.01))
        assert stamps.here(sent_s - 300.0, now_s) == pytest.approx(sent_s, abs=1e-5)
        if now_s == sent_s:
            stamps.note_empty(now_s)


@pytest.mark.parametrize("wrong_s", [3000.0, 40.0, 0.3])
def test_one_stamp_that_is_ahead_does_not_move_those_after_it(wrong_s: float) -> None:
    """Frames of the next four seconds seemed to be as old as it was ahead."""
    stamps = Stamps()
    now_s = 1_700_000_000.0
    for number in range(400):
        now_s += 0.05
        ahead_s = wrong_s if number == 100 else 0.0
        assert now_s - 0.005 < stamps.here(now_s - 0.001 + ahead_s, now_s) <= now_s


@pytest.mark.parametrize("ahead_s", [3000.0, -3000.0, 0.3])
def test_stamps_of_a_clock_that_is_ahead_are_brought_to_this_one(ahead_s: float) -> None:
    stamps = Stamps()
    now_s = 1_700_000_000.0
    late = []
    for _ in range(400):
        now_s += 0.05
        late.append(now_s - stamps.here(now_s - 0.001 + ahead_s, now_s))
    assert all(abs(late_s) < 0.005 for late_s in late)


def ages_by_stamps(
    of: Callable[[float], float], seconds: float = 60.0, jump_s: float = 0.0
) -> list[float | None]:
    """How old frames are by a clock that shows `of(time)`, of which each is read after 0 to 20 ms,
    in the last quarter of some time; in its middle this computer's clock is set. None: nobody
    knows.
    """
    stamps, now_s, set_s = Stamps(), 1_700_000_000.0, 0.0
    late = []
    for number in range(int(seconds * 20)):
        sent_s = 0.05 * number
        if number == int(seconds * 10):
            set_s = jump_s
        read_s = now_s + set_s + sent_s + 0.001 * (number * 8 % 21)
        stamps.note_empty(read_s)
        came_s = stamps.here(of(sent_s), read_s)
        late.append(None if came_s is None else read_s - came_s)
    return late[-len(late) // 4 :]


@pytest.mark.parametrize(
    "of",
    [
        lambda sent_s: sent_s,
        lambda sent_s: sent_s + 86_400.0,
        lambda sent_s: (sent_s + 4270.0) % (2**32 * 1e-6),  # microseconds in 32 bits
        lambda sent_s: round(sent_s, 3),
        lambda sent_s: (1.0 + 1e-4) * sent_s,
    ],
)
def test_stamps_that_count_from_any_moment_are_brought_to_this_computers_clock(
    of: Callable[[float], float],
) -> None:
    """Those of PEAK, candleLight and others count from the adapter's start. Frames had the time of
    their reading: a computer that was busy cut sweeps, and the bus and the boards were accused."""
    late = [one for one in ages_by_stamps(of) if one is not None]
    assert len(late) == len(ages_by_stamps(of))
    assert min(late) >= 0.0
    assert max(late) == pytest.approx(0.02, abs=0.006)
    assert min(late) < 0.004


@pytest.mark.parametrize("jump_s", [-1e6, -5000.0, 5000.0, 1e9])
def test_a_computer_whose_clock_is_set_by_hours_goes_on_with_the_adapters_stamps(
    jump_s: float,
) -> None:
    """As one without a battery for its clock does once it reaches the network."""
    late = ages_by_stamps(lambda sent_s: 1_700_000_000.0 + sent_s, jump_s=jump_s)
    assert max(one for one in late if one is not None) == pytest.approx(0.02, abs=0.003)


@pytest.mark.parametrize(
    "of",
    [
        lambda _: 0.0,
        lambda _: float("nan"),
        lambda _: float("inf"),
        lambda sent_s: 1e3 * sent_s,  # of another unit
        lambda sent_s: -sent_s,
        lambda sent_s: 7919.0 * (sent_s * 1e4 % 101),
    ],
)
def test_stamps_that_are_none_never_count(of: Callable[[float], float]) -> None:
    assert set(ages_by_stamps(of)) == {None}
