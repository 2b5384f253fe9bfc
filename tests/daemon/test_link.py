"""Between the buses and the core: every sweep counts, however it was closed."""

import contextlib
import socket
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from skin_host.bus import wire
from skin_host.bus.assembler import AssemblerCounters
from skin_host.bus.port import SEND_DEADLINE_S, LinkState
from skin_host.bus.wire import FrameBatch
from skin_host.clock import SteppedClock
from skin_host.config.settings import Board, Bus, Part, Patch, Settings
from skin_host.daemon.link import Link
from skin_host.errors import BusError
from skin_host.layout import build_layout
from skin_host.processing.core import Engine, Output
from tests.support.ports import StillPort
from tests.support.stepped import stepped
from tests.support.waiting import PATIENCE_S

MS = 1_000_000
PERIOD = 50 * MS
T0 = 1_700_000_000_000_000_000
TRIANGLES = 4
#: Identifier, payload, time.
Frame = tuple[int, bytes, int]
ALL = np.arange(2 * TRIANGLES)


class Reader:
    """A link with one board on its bus, in time that the test steps."""

    def __init__(self) -> None:
        settings = Settings(
            robot="r",
            buses={"can0": Bus()},
            boards={"b": Board(bus="can0", address=1)},
            parts={"p": Part(patches=[Patch(board="b", triangles=f"0-{TRIANGLES - 1}")])},
        )
        self.engine = Engine(settings, build_layout(settings, Path()), [0])
        self.link = Link(self.engine, open_port=StillPort)
        self.rng = np.random.default_rng(1)
        self.outputs: list[Output] = []
        self.now_ns = T0
        self.turn()
        # Between the end of a sweep's time and the next sweep, the link looks at every second.
        self.now_ns += 12 * MS

    def turn(self) -> None:
        self.link.turn(self.now_ns, self.outputs.append)

    def frames(self) -> list[Frame]:
        """Of a sweep that the board begins to send now."""
        values = self.rng.integers(200, 250, (TRIANGLES, 12), np.uint8)
        ids, data = wire.encode_sweep(
            1, np.arange(TRIANGLES), values, np.zeros(TRIANGLES, np.uint16)
        )
        times = self.now_ns + 100_000 * np.arange(2 * TRIANGLES)
        return [(int(ids[i]), data[i].tobytes(), int(times[i])) for i in range(2 * TRIANGLES)]

    def arrive(self, frames: list[Frame]) -> None:
        port = self.link.ports["can0"]
        assert isinstance(port, StillPort)
        port.waiting.append(FrameBatch.of(frames))

    def wait(self, ms: int) -> None:
        """Time passes in which the link takes its turns."""
        for _ in range(ms):
            self.turn()
            self.now_ns += MS

    def period(self, keep: np.ndarray) -> None:
        """The board sends the frames with these numbers; then a period passes."""
        frames = self.frames()
        self.arrive([frames[i] for i in keep])
        self.wait(50)

    @property
    def counters(self) -> AssemblerCounters:
        return self.engine.assemblers["can0"].counters


@pytest.fixture
def reader() -> Reader:
    return Reader()


def test_sweeps_that_time_closes_reach_the_supervision_of_their_board(reader: Reader) -> None:
    for _ in range(200):
        lost = reader.rng.random(2 * TRIANGLES) < 0.05
        reader.period(np.flatnonzero(~lost))
    sweeps = [sweep for output in reader.outputs for sweep in output.sweeps]
    assert len(sweeps) == 200
    assert reader.engine.ledger.sweeps.tolist() == [200]


@pytest.mark.parametrize("pause_ms", [75, 150, 300])
def test_half_a_sweep_is_not_lost_when_the_computer_paused(reader: Reader, pause_ms: int) -> None:
    reader.period(ALL)
    frames = reader.frames()
    reader.arrive(frames[:3])
    reader.now_ns += pause_ms * MS
    reader.wait(10)
    # What brings the frames was held up as well, and went on a little later.
    reader.arrive(frames[3:])
    reader.wait(50)
    reader.period(ALL)
    assert reader.counters.sweeps == 3
    assert (reader.counters.halves, reader.counters.incomplete, reader.counters.late) == (0, 0, 0)


def test_half_a_sweep_is_closed_in_time_on_a_computer_that_pauses_again_and_again(
    reader: Reader,
) -> None:
    reader.period(ALL)
    reader.arrive(reader.frames()[:3])
    began_ns = reader.now_ns
    while reader.counters.incomplete == 0:
        reader.turn()
        reader.now_ns += 80 * MS
    assert reader.now_ns - began_ns <= 400 * MS


@pytest.mark.parametrize(
    ("pause_ms", "more_ms"), [(150, 190), (600, 190), (600, 600), (9000, 1500)]
)
def test_no_board_is_silent_because_what_brings_its_frames_was_held_up_too(
    reader: Reader, pause_ms: int, more_ms: int
) -> None:
    for _ in range(3):
        reader.period(ALL)
    reader.now_ns += pause_ms * MS
    reader.wait(more_ms)
    assert not reader.engine.ledger.any_silent
    reader.period(ALL)
    assert not reader.engine.ledger.any_silent


def test_half_a_sweep_is_not_kept_until_the_silence_after_a_long_pause_has_lasted_long(
    reader: Reader,
) -> None:
    """Otherwise it is of its time no more when it is reported."""
    for _ in range(3):
        reader.period(ALL)
    reader.now_ns += 9000 * MS
    began_ns = reader.now_ns
    reader.arrive(reader.frames()[:6])
    while reader.counters.incomplete == 0:
        reader.wait(1)
    assert 100 * MS <= reader.now_ns - began_ns <= 150 * MS


def test_a_board_that_sent_after_a_stall_and_died_is_silent_in_time(reader: Reader) -> None:
    for _ in range(3):
        reader.period(ALL)
    reader.now_ns += 9000 * MS
    reader.period(ALL)
    reader.wait(300)
    assert reader.engine.ledger.any_silent


def test_a_board_that_died_in_a_stall_is_silent_soon_after_it(reader: Reader) -> None:
    for _ in range(3):
        reader.period(ALL)
    reader.now_ns += 9000 * MS
    reader.wait(2300)
    assert reader.engine.ledger.any_silent


def test_a_silent_board_is_found_on_a_computer_that_pauses_again_and_again(reader: Reader) -> None:
    reader.period(ALL)
    began_ns = reader.now_ns
    while not reader.engine.ledger.any_silent:
        reader.turn()
        reader.now_ns += 80 * MS
    assert reader.now_ns - began_ns <= 1000 * MS


@pytest.mark.parametrize("set_back_ms", [0, 3_600_000])
def test_what_waited_on_several_buses_is_taken_by_its_time_and_not_by_its_bus(
    set_back_ms: int,
) -> None:
    """Otherwise a frame of a part would join sweeps of different times, and so would a recording of
    them. The clock may be set back meanwhile.
    """
    boards = {"b": Board(bus="can0", address=1), "c": Board(bus="can1", address=1)}
    settings = Settings(
        robot="r",
        buses={"can0": Bus(), "can1": Bus()},
        boards=boards,
        parts={"p": Part(patches=[Patch(board=name, triangles="0-3") for name in boards])},
    )
    link = Link(Engine(settings, build_layout(settings, Path()), [0]), open_port=StillPort)
    values = np.full((TRIANGLES, 12), 240, np.uint8)
    ids, data = wire.encode_sweep(1, np.arange(TRIANGLES), values, np.zeros(TRIANGLES, np.uint16))
    for number, port in enumerate(link.ports.values()):
        assert isinstance(port, StillPort)
        starts = [T0 + number * MS + period * PERIOD for period in range(8)]
        starts[4:] = [start_ns - set_back_ms * MS for start_ns in starts[4:]]
        frames = [
            (int(ids[i]), data[i].tobytes(), start_ns + 100_000 * i)
            for start_ns in starts
            for i in ALL
        ]
        port.waiting.append(FrameBatch.of(frames))
    outputs: list[Output] = []
    recorded: list[str] = []
    link.turn(
        T0 + 8 * PERIOD - set_back_ms * MS,
        outputs.append,
        lambda bus, batch: recorded.extend([bus] * len(batch)),
    )
    boards_of_sweeps = [sweep.board for output in outputs for sweep in output.sweeps]
    assert boards_of_sweeps == [0, 1] * 8
    assert recorded == (["can0"] * len(ALL) + ["can1"] * len(ALL)) * 8


def test_on_a_bus_that_never_ends_a_board_that_dies_has_timed_out(reader: Reader) -> None:
    reader.period(ALL)
    reader.period(ALL)
    assert not reader.engine.ledger.is_silent(0)
    # Somebody floods the bus: each read is full, and what comes after it waits.
    port = reader.link.ports["can0"]
    port.capacity = 4
    for _ in range(1000):
        reader.arrive([(0x100, b"", reader.now_ns + i) for i in range(4)])
        reader.wait(1)
    assert reader.engine.ledger.is_silent(0)


def test_a_bus_whose_package_is_not_installed_leaves_the_others_live(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    there = can.Bus

    def bus(*args: Any, interface: str, **options: Any) -> can.BusABC:
        if interface == "slcan":
            raise can.CanInterfaceNotImplementedError("the serial module is not installed")
        return there(*args, interface=interface, **options)

    monkeypatch.setattr("can.Bus", bus)
    settings = Settings(
        robot="r",
        buses={
            "left": Bus(interface="slcan", channel="/dev/ttyACM0"),
            "right": Bus(interface="virtual", channel="one-package-is-missing"),
        },
        boards={"l": Board(bus="left", address=1), "r": Board(bus="right", address=1)},
        parts={
            side: Part(patches=[Patch(board=side[0], triangles="0")]) for side in ("left", "right")
        },
    )
    engine = Engine(settings, build_layout(settings, Path()), [0, 1])
    link = Link(engine, wait=True, clock=SteppedClock())
    with there(interface="virtual", channel="one-package-is-missing") as board:
        board.send(can.Message(arbitration_id=0x410, data=bytes(8), is_extended_id=False))
        link.turn(T0, lambda _: None)
    assert link.ports["right"].counters.frames == 1
    assert "pip install 'python-can[serial]'" in link.ports["left"].unopened
    link.close()


def test_buses_are_opened_beside_each_other(caplog: pytest.LogCaptureFixture) -> None:
    """Four adapters that hung would hold a start up for 20 s, in which no other bus is read and no
    signal is taken. Here a server of buses greets each client once both are there.
    """
    server = socket.create_server(("127.0.0.1", 0))
    clients: list[socket.socket] = []
    both = threading.Barrier(2)

    def answer(client: socket.socket, is_first: bool) -> None:
        with contextlib.suppress(OSError, threading.BrokenBarrierError):
            if is_first:
                both.wait()
            for words in (b"< hi >", b"< ok >", b"< ok >"):
                client.sendall(words)
                client.recv(1000)

    def accept() -> None:
        with contextlib.suppress(OSError):
            while True:
                clients.append(server.accept()[0])
                arguments = (clients[-1], len(clients) <= 2)
                threading.Thread(target=answer, args=arguments, daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    options = {"host": "127.0.0.1", "port": server.getsockname()[1]}
    names = ("left", "right")
    settings = Settings(
        robot="r",
        buses={name: Bus(interface="socketcand", channel=name, options=options) for name in names},
        boards={name: Board(bus=name, address=1) for name in names},
        parts={name: Part(patches=[Patch(board=name, triangles="0")]) for name in names},
    )
    link = Link(Engine(settings, build_layout(settings, Path()), [0, 1]), wait=True)
    try:
        assert [*link.ports] == [*names]
        assert {port.state for port in link.ports.values()} == {LinkState.UP}, caplog.text
    finally:
        both.abort()
        link.close()
        server.close()
        for client in clients:
            client.close()


def test_a_bus_that_cannot_be_opened_leaves_no_other_one_open() -> None:
    settings = Settings(
        robot="r",
        buses={"left": Bus(), "right": Bus()},
        boards={name: Board(bus=name, address=1) for name in ("left", "right")},
        parts={
            name: Part(patches=[Patch(board=name, triangles="0")]) for name in ("left", "right")
        },
    )
    opening, failed, closed = threading.Event(), threading.Event(), threading.Event()

    class Opened(StillPort):
        def close(self) -> None:
            closed.set()

    def open_one(name: str, *arguments: Any, **options: Any) -> StillPort:
        if name == "left":
            assert opening.wait(PATIENCE_S)
            raise BusError("absent")
        opening.set()
        assert failed.wait(PATIENCE_S)
        return Opened(name, *arguments, **options)

    with pytest.raises(BusError, match="absent"):
        Link(Engine(settings, build_layout(settings, Path()), [0, 1]), open_port=open_one)
    failed.set()
    assert closed.wait(PATIENCE_S)


@stepped
async def test_buses_that_take_nothing_are_stopped_beside_each_other(clock: SteppedClock) -> None:
    """An iCub has seven, and systemd kills a service that takes more than 5 s to end."""
    names = [f"can{number}" for number in range(7)]
    settings = Settings(
        robot="r",
        buses={name: Bus() for name in names},
        boards={name: Board(bus=name, address=1) for name in names},
        parts={name: Part(patches=[Patch(board=name, triangles="0")]) for name in names},
    )

    class Unacknowledged(StillPort):
        async def send(self, frames: Iterable[tuple[int, bytes]], gap_s: float = 0.0) -> None:
            await clock.sleep(SEND_DEADLINE_S)
            raise BusError("the transmit queue stayed full")

    engine = Engine(settings, build_layout(settings, Path()), [*range(len(names))])
    link = Link(engine, open_port=Unacknowledged, clock=clock)
    since_s = clock.monotonic_s()
    await link.stop()
    assert clock.monotonic_s() - since_s < 1.5
    link.close()


def test_the_time_that_opening_takes_is_no_stall_of_this_computer() -> None:
    """An adapter that does not answer is waited for; health accused other work of the pause."""
    settings = Settings(
        robot="r",
        buses={"can0": Bus()},
        boards={"b": Board(bus="can0", address=1)},
        parts={"p": Part(patches=[Patch(board="b", triangles="0")])},
    )
    clock = SteppedClock()

    def open_slowly(*arguments: Any, **options: Any) -> StillPort:
        clock.advance(5.0)
        return StillPort(*arguments, **options)

    engine = Engine(settings, build_layout(settings, Path()), [0])
    link = Link(engine, open_port=open_slowly, clock=clock)
    link.turn(clock.now_ns(), lambda _: None)
    assert link.longest_pause_ns() == 0
    clock.advance(5.0)
    link.turn(clock.now_ns(), lambda _: None)
    assert link.longest_pause_ns() == 5_000_000_000
