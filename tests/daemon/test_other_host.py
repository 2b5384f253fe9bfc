"""Another program sets up the boards of a daemon that runs."""

import contextlib
import logging
from collections.abc import AsyncIterator, Iterable
from pathlib import Path

import can
import pytest

from emulator.probes.scene import Place, Probe, Scene
from skin_host.bus.board import configuration
from skin_host.bus.commands import Message, SetTriangleConfig, SetTxMode, TxMode, command_frame
from skin_host.bus.wire import BROADCAST_ADDRESS
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus
from skin_host.mqtt.messages import ContactState
from skin_host.processing.events import Touch
from tests.daemon.test_link import Reader
from tests.support.live import CONFIG, Live, living
from tests.support.stepped import stepped

HELD = Probe(
    part="left_hand",
    at=Place(triangle=4),
    diameter_mm=10,
    pressure_kpa=[(0, 0), (0.1, 60), (1000, 60)],
    start_s=10.0,
)


class Other:
    """Another host on the bus of a daemon, and what the daemon publishes."""

    def __init__(self, live: Live, bus: can.BusABC, clock: SteppedClock) -> None:
        self.live, self._bus, self._clock = live, bus, clock
        self.contact: dict[str, ContactState] = {}
        self.ended: list[Touch] = []
        publisher = live.daemon.publisher
        put_touch = publisher.put_touch

        def note(event: Touch) -> None:
            if event.event == "end":
                self.ended.append(event)
            put_touch(event)

        publisher.put_contact = self.contact.__setitem__  # type: ignore[method-assign]
        publisher.put_touch = note  # type: ignore[method-assign, assignment]

    def commands(self, board: str) -> list[Message]:
        """Return the set-up of a board."""
        layout = self.live.daemon.layout
        index = next(i for i, one in enumerate(layout.boards) if one.name == board)
        mine = [triangle for triangle in layout.triangles if triangle.board == index]
        return configuration(layout.boards[index], mine)

    async def set_up(self, board: str, commands: Iterable[Message] | None = None) -> None:
        """Set a board up as a daemon does, and start it."""
        commands = self.commands(board) if commands is None else list(commands)
        layout = self.live.daemon.layout
        address = next(one.settings.address for one in layout.boards if one.name == board)
        for command in (*commands, SetTxMode(TxMode.START)):
            identifier, data = command_frame(command, address)
            self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
            await self._clock.sleep(0.1 if isinstance(command, SetTriangleConfig) else 0.01)


@contextlib.asynccontextmanager
async def beside(clock: SteppedClock, state: Path, *probes: Probe) -> AsyncIterator[Other]:
    """Boards that send so seldom that none is silent for being set up."""
    config = state / "seldom.toml"
    text = CONFIG.read_text()
    config.write_text(
        text.replace('bus = "can0"\naddress', 'bus = "can0"\nperiod_ms = 100\naddress')
    )
    bus = Bus(interface="virtual", channel=f"other-host-{state}")
    scene = Scene(quiet=True, probe=[*probes])
    async with living(bus, state, scene=scene, config=config, clock=clock) as live:
        with can.Bus(interface="virtual", channel=bus.channel) as other:
            await live.until_well(but=frozenset({"board_rezeroed"}))
            yield Other(live, other, clock)


@stepped
async def test_what_presses_a_board_that_another_host_sets_up_is_never_untouched(
    clock: SteppedClock, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with beside(clock, tmp_path, HELD) as other:
        await clock.sleep(10.0)
        assert other.contact["left_hand"] == "ON"
        states = set()
        with caplog.at_level(logging.WARNING):
            await other.set_up("hand")
            for _ in range(100):
                await clock.sleep(0.1)
                states.add(other.contact["left_hand"])
        assert "OFF" not in states
        assert other.contact == {"left_hand": "UNKNOWN", "left_forearm": "OFF"}
        assert {event.reason for event in other.ended} == {"lost"}
        assert "board_in_doubt" in {code for code, _ in other.live.faults()}
        told = [line for line in caplog.messages if "another program" in line]
        assert len(told) == 1
        assert "board hand" in told[0]


@stepped
async def test_a_board_that_another_host_sets_up_at_rest_feels_again(
    clock: SteppedClock, tmp_path: Path
) -> None:
    async with beside(clock, tmp_path) as other:
        await other.set_up("hand")
        await clock.sleep(8.0)
        assert other.contact == {"left_hand": "OFF", "left_forearm": "OFF"}
        assert other.ended == []
        # It is as it was set up to be: nothing is to be sent.
        (hand,) = other.live.daemon.records()["left_hand"]["boards"]
        assert (hand["configurations"], hand["rezeros"]) == (1, 1)


@stepped
async def test_a_board_that_another_host_sets_up_otherwise_is_set_up_again(
    clock: SteppedClock, tmp_path: Path
) -> None:
    """Its values would be read by a unit that is not theirs."""
    async with beside(clock, tmp_path) as other:
        finer = [
            SetTriangleConfig(one.first, one.last, 1, one.flags, one.cdc_offset)
            if isinstance(one, SetTriangleConfig)
            else one
            for one in other.commands("hand")
        ]
        await other.set_up("hand", finer)
        await clock.sleep(8.0)
        robot = other.live.robot
        assert set(robot.boards["hand"].shift.tolist()) == {2}
        assert other.contact == {"left_hand": "OFF", "left_forearm": "OFF"}


@pytest.fixture
def reader() -> Reader:
    return Reader()


def note_zeros(reader: Reader) -> list[int]:
    """Return the boards of which the engine learns that they are zeroed, as it does."""
    zeroed: list[int] = []

    def note(board: int, believed: bool = True) -> int:
        zeroed.append(board)
        return 0

    reader.engine.zeros.rezero = note  # type: ignore[method-assign]
    return zeroed


def test_the_echo_of_what_the_host_sent_is_no_other_host(reader: Reader) -> None:
    """By multicast a program receives what it sends."""
    zeroed = note_zeros(reader)
    frame = command_frame(SetTriangleConfig(0, 3), 1)
    reader.link.ports["can0"].on_sent(*frame)
    reader.link.ports["can0"].on_sent(*frame)
    for _ in range(2):
        reader.arrive([(*frame, reader.now_ns)])
        reader.wait(5)
    assert zeroed == []
    reader.arrive([(*frame, reader.now_ns)])
    reader.wait(5)
    assert zeroed == [0]
    reader.wait(30)
    everyone = command_frame(SetTriangleConfig(0, 3), BROADCAST_ADDRESS)
    reader.arrive([(*everyone, reader.now_ns), *reader.frames()])
    reader.wait(5)
    assert zeroed == [0, 0]


def test_a_board_gets_one_zero_from_commands_that_fill_the_bus(reader: Reader) -> None:
    """Anybody on the bus may send them."""
    zeroed = note_zeros(reader)
    frame = command_frame(SetTriangleConfig(0, 3), 1)
    for _ in range(5):
        reader.arrive([(*frame, reader.now_ns + 1000 * row) for row in range(400)])
        reader.wait(2)
    assert zeroed == [0]
    reader.wait(30)
    reader.arrive([(*frame, reader.now_ns)])
    reader.wait(2)
    assert zeroed == [0, 0]
