"""What boards say of themselves is noted, and told with the health of their part."""

import asyncio
from collections.abc import Iterable
from typing import Any

import msgspec
import pytest

from skin_host.bus.answers import Discovered, DiscoveredBootloader, answer_frame
from skin_host.bus.board import configuration
from skin_host.bus.boards import Boards
from skin_host.bus.commands import (
    BoardType,
    Discover,
    Message,
    SetTriangleConfig,
    SetTxMode,
    TxMode,
    parse_command,
)
from skin_host.bus.wire import FrameBatch, MessageClass, identifier
from skin_host.clock import SteppedClock
from skin_host.config.settings import Board, Bus, Part, Patch, Settings, changed, load
from skin_host.health import HealthWatch, Record
from skin_host.layout import build_layout
from skin_host.processing.core import Engine
from tests.support.board import RESTING_FF, BoardOnBench
from tests.support.stack import ROOT
from tests.support.stepped import stepped

CONFIG = ROOT / "config" / "demo.toml"
S = 1_000_000_000
HAND = 14
TX_OVERFLOW = 5


class Nowhere:
    """Sends nothing: what boards say is fed by hand."""

    async def send(self, frames: Iterable[tuple[int, bytes]], gap_s: float = 0.0) -> None:
        raise AssertionError("nothing is to be sent")


class Heard:
    """The boards of the demo's bus, what they say, and what is told of it."""

    def __init__(self, **hand: Any) -> None:
        settings = load(CONFIG)
        table = msgspec.structs.replace(settings.boards["hand"], **hand)
        settings = changed(settings, {"boards.hand": table})
        layout = build_layout(settings, CONFIG.parent)
        self.engine = Engine(settings, layout, [0, 1])
        boards = [(i, layout.boards[i]) for i in self.engine.boards]
        self.boards = Boards("can0", Nowhere(), boards, layout.triangles, self.engine.ledger)
        self.health = HealthWatch(self.engine)
        self.now_ns = 1_700_000_000 * S
        self.look()

    def say(self, *frames: tuple[int, bytes]) -> None:
        output = self.engine.feed(
            "can0", FrameBatch.of([(i, data, self.now_ns) for i, data in frames])
        )
        self.boards.note_answers(output.answers)
        self.look()

    def answer(self, message: Message, address: int) -> None:
        self.say(answer_frame(message, address))

    def answer_again(self, message: Message, address: int) -> None:
        """It is asked twice, and answers the same."""
        for _ in range(2):
            self.boards.records[address].asked += 1
            self.answer(message, address)

    def look(self) -> None:
        self.now_ns += S // 10
        self.health.tick(self.now_ns, {}, {"can0": self.boards})

    def supervised(self, port: "Kept | Slow | Wired", clock: SteppedClock) -> None:
        """From now on boards are queried over a port of their own."""
        layout, ledger = self.engine.layout, self.engine.ledger
        boards = [(i, layout.boards[i]) for i in self.engine.boards]
        sent_by = self.engine.assemblers["can0"].unconfigured
        self.boards = Boards(
            "can0", port, boards, layout.triangles, ledger, clock=clock, unconfigured=sent_by
        )

    async def pass_time(self, clock: SteppedClock) -> None:
        """A tenth of a second passes, and boards are supervised."""
        await clock.sleep(0.1)
        self.look()
        self.engine.ledger.look(self.now_ns)
        self.boards.supervise()

    def send_sweep(self, lost: int = 0) -> None:
        """The hand sends its triangles, but for those that are lost, the last ones."""
        (hand,) = (one for one in self.engine.layout.boards if one.name == "hand")
        self.say(
            *(
                (identifier(MessageClass.SKIN_STREAM, HAND, triangle), header + bytes([230] * 7))
                for triangle in hand.triangles[: len(hand.triangles) - lost]
                for header in (b"\x40", b"\xc0")
            )
        )

    def record(self) -> Record:
        return self.health.record(0, self.now_ns, {}, {"can0": self.boards})

    def told(self) -> set[tuple[str, str]]:
        record = self.record()
        assert len(record["sentences"]) == len(record["faults"])
        return {(fault["code"], fault["where"]) for fault in record["faults"]}


@pytest.fixture
def heard() -> Heard:
    return Heard()


def test_a_board_in_its_bootloader_is_told_until_its_application_answers(heard: Heard) -> None:
    heard.answer_again(DiscoveredBootloader(BoardType.MTB4, 4, 0), HAND)
    assert ("board_in_bootloader", "hand") in heard.told()
    heard.answer(Discovered(BoardType.MTB4, 1, 25, 0), HAND)
    assert not {code for code, _ in heard.told()} & {"board_in_bootloader", "board_wrong_type"}


def test_a_board_of_another_kind_at_the_address_is_told(heard: Heard) -> None:
    heard.answer_again(Discovered(BoardType.STRAIN2, 2, 0, 0), HAND)
    assert ("board_wrong_type", "hand") in heard.told()


def test_one_damaged_answer_makes_no_board_another(heard: Heard) -> None:
    heard.answer(Discovered(BoardType.MTB4, 1, 25, 0), HAND)
    heard.boards.records[HAND].asked += 1
    for _ in range(2):  # The frame comes twice.
        heard.answer(Discovered(21, 1, 25, 0), HAND)
    heard.boards.records[HAND].asked += 1
    heard.answer(DiscoveredBootloader(BoardType.MTB4, 1, 25), HAND)
    assert not {code for code, _ in heard.told()} & {"board_in_bootloader", "board_wrong_type"}


@pytest.mark.parametrize("damaged", [True, False])
@stepped
async def test_a_board_that_seems_to_be_another_is_asked_again_at_the_start(
    clock: SteppedClock, damaged: bool
) -> None:
    heard, port = Heard(), Kept(clock)
    heard.supervised(port, clock)
    beginning = asyncio.create_task(heard.boards.bring_up())
    await clock.sleep(0.001)
    heard.answer(Discovered(21, 1, 25, 0), HAND)
    assert len(port.sent) == 1
    await clock.sleep(0.02)
    assert len(port.sent) == 2
    heard.answer(Discovered(BoardType.MTB4 if damaged else 21, 1, 25, 0), HAND)
    assert (("board_wrong_type", "hand") in heard.told()) != damaged
    await beginning


def test_a_board_that_nobody_configured_is_told(heard: Heard) -> None:
    heard.answer(Discovered(BoardType.MTB4, 1, 25, 0), 7)
    assert ("bus_stranger", "can0/7") in heard.told()


@pytest.mark.parametrize("answers", [True, False])
@stepped
async def test_a_board_that_nobody_configured_is_told_for_as_long_as_it_answers(
    clock: SteppedClock, answers: bool
) -> None:
    """Its answer may be forged, or it may be unplugged; both stay in no record until a restart."""
    heard, port = Heard(), Kept(clock)
    heard.supervised(port, clock)
    heard.answer(Discovered(BoardType.MTB4, 1, 25, 0), 7)
    for _ in range(300):
        asked = len(port.sent)
        await heard.pass_time(clock)
        if answers and len(port.sent) > asked:
            heard.answer(Discovered(BoardType.MTB4, 1, 25, 0), 7)
    assert (("bus_stranger", "can0/7") in heard.told()) == answers
    assert 2 <= len(port.sent) <= 4
    await heard.boards.stop()


@stepped
async def test_a_board_that_nobody_configured_and_that_sends_is_not_queried(
    clock: SteppedClock,
) -> None:
    """An MTB3 would stop, which another host may have started."""
    heard, port = Heard(), Kept(clock)
    heard.supervised(port, clock)
    heard.answer(Discovered(BoardType.SKIN, 3, 0, 0), 7)
    for _ in range(300):
        heard.say((identifier(MessageClass.SKIN_STREAM, 7, 0), b"\x40" + bytes(7)))
        await heard.pass_time(clock)
    assert ("bus_stranger", "can0/7") in heard.told()
    assert not port.sent
    for _ in range(300):
        await heard.pass_time(clock)
    assert ("bus_stranger", "can0/7") not in heard.told()
    await heard.boards.stop()


@pytest.mark.parametrize("code", ["board_in_bootloader", "board_wrong_type"])
@pytest.mark.parametrize("sends", [True, False])
@stepped
async def test_what_a_board_answered_is_told_until_it_sends_or_answers_no_more(
    clock: SteppedClock, code: str, sends: bool
) -> None:
    """The answer may be forged; or the board has been updated, replaced or unplugged since."""
    heard, port = Heard(), Kept(clock)
    heard.supervised(port, clock)
    record = heard.boards.records[HAND]
    heard.answer(Discovered(BoardType.MTB4, 1, 25, 0), HAND)
    record.started, record.configurations = True, 1
    if code == "board_in_bootloader":
        heard.answer_again(DiscoveredBootloader(BoardType.MTB4, 4, 0), HAND)
    else:
        heard.answer_again(Discovered(BoardType.STRAIN2, 2, 0, 0), HAND)
    assert (code, "hand") in heard.told()
    for step in range(250):
        if sends and step % 2:
            heard.send_sweep()
        await heard.pass_time(clock)
    told = {told for told, _ in heard.told()}
    assert code not in told
    assert ("bus_silent" in told) != sends
    await heard.boards.stop()


def test_a_board_that_must_answer_while_it_sends_is_not_told_to_overflow(heard: Heard) -> None:
    heard.say((identifier(MessageClass.MANAGEMENT, HAND, TX_OVERFLOW), b""))
    assert "board_overflows" not in {code for code, _ in heard.told()}


def test_a_board_that_could_not_send_is_told(heard: Heard) -> None:
    heard.boards.records[HAND].started = True
    heard.say((identifier(MessageClass.MANAGEMENT, HAND, TX_OVERFLOW), b""))
    assert ("board_overflows", "hand") in heard.told()
    assert heard.engine.ledger.tx_overflows.sum() == 1


def test_a_board_tells_its_firmware(heard: Heard) -> None:
    heard.answer(Discovered(BoardType.MTB4, 1, 25, 3), HAND)
    (hand,) = heard.record()["boards"]
    assert hand.get("firmware") == (1, 25, 3)
    assert hand.get("board_type") == BoardType.MTB4


class Kept:
    """Keeps what is sent, with the time."""

    def __init__(self, clock: SteppedClock) -> None:
        self._clock = clock
        self.sent: list[tuple[float, int]] = []

    async def send(self, frames: Iterable[tuple[int, bytes]], gap_s: float = 0.0) -> None:
        self.sent += [(self._clock.monotonic_s(), can_id >> 8) for can_id, _ in frames]


@stepped
async def test_no_board_is_set_up_while_the_bus_is_being_discovered(clock: SteppedClock) -> None:
    """Discovery stops an MTB3 that has just been started, which then looks like one that reset."""
    heard, port = Heard(), Kept(clock)
    listed = [(i, heard.engine.layout.boards[i]) for i in heard.engine.boards]
    layout, ledger = heard.engine.layout, heard.engine.ledger
    boards = Boards("can0", port, listed, layout.triangles, ledger, clock=clock)
    beginning = asyncio.create_task(boards.bring_up(listen=True))
    await clock.sleep(0.02)
    assert not port.sent
    await boards.set_up(HAND)
    assert beginning.done()
    discovered_s = min(s for s, kind in port.sent if kind == MessageClass.MANAGEMENT)
    assert min(s for s, kind in port.sent if kind != MessageClass.MANAGEMENT) > discovered_s + 0.4


class Taken:
    """A bus that takes the commands of one sender after another's, as a port does."""

    def __init__(self, clock: SteppedClock) -> None:
        self._clock = clock
        self._lock = asyncio.Lock()
        self.taken: list[tuple[int, Message | None]] = []

    async def send(self, frames: Iterable[tuple[int, bytes]], gap_s: float = 0.0) -> None:
        async with self._lock:
            for frame in frames:
                command = parse_command(*frame)
                assert command is not None
                self.taken.append(command)
                await self._clock.sleep(gap_s)


@stepped
async def test_a_zero_is_announced_when_the_bus_is_free_for_it(clock: SteppedClock) -> None:
    """Earlier, the board still sends with the old zero, for seconds where a bus has ten boards."""
    heard, port = Heard(), Taken(clock)
    listed = [(i, heard.engine.layout.boards[i]) for i in heard.engine.boards]
    layout, ledger = heard.engine.layout, heard.engine.ledger

    def announce(index: int, _: bool) -> None:
        port.taken.append((layout.boards[index].settings.address, None))

    boards = Boards("can0", port, listed, layout.triangles, ledger, zeroed=announce, clock=clock)
    addresses = list(boards.records)
    await asyncio.gather(*(boards.set_up(address) for address in addresses))
    announced, zeroed = 0, []
    for address, command in port.taken:
        if command is None:
            announced = address
        elif address != announced:
            announced = 0
        if isinstance(command, SetTriangleConfig):
            assert announced == address
            zeroed.append(address)
    assert set(zeroed) == set(addresses)


@stepped
async def test_what_touches_a_board_is_believed_though_a_triangle_is_missing(
    clock: SteppedClock,
) -> None:
    """Frames are lost, too: what was touched then was forgotten, and became the new zero."""
    heard, believed = Heard(), list[bool]()
    listed = [(i, heard.engine.layout.boards[i]) for i in heard.engine.boards]
    layout, ledger = heard.engine.layout, heard.engine.ledger

    def announce(_: int, felt: bool) -> None:
        believed.append(felt)

    boards = Boards(
        "can0", Taken(clock), listed, layout.triangles, ledger, zeroed=announce, clock=clock
    )
    await boards.set_up(HAND)
    for _ in range(10):
        heard.send_sweep(lost=1)
    assert ledger.missing(boards.records[HAND].row)
    believed.clear()
    await boards.set_up(HAND)
    assert believed == [True, True]


def test_forged_answers_fill_no_log(heard: Heard, caplog: pytest.LogCaptureFixture) -> None:
    for number in range(100):
        kind = BoardType.STRAIN2 if number % 2 else BoardType.MTB4
        heard.answer_again(Discovered(kind, 1, 25, 0), HAND)
        heard.answer_again(DiscoveredBootloader(BoardType.MTB4, 4, 0), HAND)
    assert len(caplog.records) == 1


class Slow:
    """A bus that is full: queries wait on it for two seconds, and the board answers at once.

    Args:
        heard: takes the answers.
        clock: of the test.
    """

    def __init__(self, heard: Heard, clock: SteppedClock) -> None:
        self._heard, self._clock = heard, clock
        self.set_up = 0

    async def send(self, frames: Iterable[tuple[int, bytes]], gap_s: float = 0.0) -> None:
        for frame in frames:
            command = parse_command(*frame)
            assert command is not None
            address, message = command
            self.set_up += address == HAND and isinstance(message, SetTriangleConfig)
            if isinstance(message, Discover) and address == HAND:
                await self._clock.sleep(2.0)
                asyncio.get_running_loop().call_soon(self._answer)

    def _answer(self) -> None:
        self._heard.answer(Discovered(BoardType.SKIN, 2, 17, 0), HAND)


@stepped
async def test_a_board_has_its_time_to_answer_from_when_the_query_is_sent(
    heard: Heard, clock: SteppedClock
) -> None:
    port = Slow(heard, clock)
    heard.supervised(port, clock)
    await heard.boards.bring_up()
    for _ in range(200):
        await heard.pass_time(clock)
    assert port.set_up
    await heard.boards.stop()


class Wired:
    """The hand as an MTB3, on a bus with the host; its answers may get lost.

    Args:
        heard: takes what it sends.
        clock: of the test.
        mute: its answers do not arrive, its values do.
    """

    def __init__(self, heard: Heard, clock: SteppedClock, *, mute: bool) -> None:
        self.heard, self._clock, self._mute = heard, clock, mute
        (hand,) = (one for one in heard.engine.layout.boards if one.name == "hand")
        self._bench = BoardOnBench("mtb3", HAND, slots=hand.triangles)
        heard.supervised(self, clock)

    async def send(self, frames: Iterable[tuple[int, bytes]], gap_s: float = 0.002) -> None:
        for can_id, data in frames:
            self._take(self._bench.board.handle(can_id, data, self._bench.t_ns))
            await self._clock.sleep(gap_s)

    async def run(self, seconds: float) -> int:
        """Let time pass; return how many frames of values came in the last second."""
        came: list[int] = []
        for step in range(round(seconds / 0.02)):
            await self._clock.sleep(0.02)
            self.heard.now_ns += S // 50
            came.append(self._take(self._bench.run(0.02)))
            self.heard.engine.ledger.look(self.heard.now_ns)
            self.heard.boards.supervise()
            if step % 5 == 0:
                self.heard.health.tick(self.heard.now_ns, {}, {"can0": self.heard.boards})
        return sum(came[-50:])

    def _take(self, frames: list[tuple[int, bytes]]) -> int:
        values = [one for one in frames if one[0] >> 8 == MessageClass.SKIN_STREAM]
        arrived = [(*one, self.heard.now_ns) for one in (values if self._mute else frames)]
        output = self.heard.engine.feed("can0", FrameBatch.of(arrived))
        self.heard.boards.note_answers(output.answers)
        return len(values)


@stepped
@pytest.mark.parametrize("period_ms", [20, 50, 60, 209])
async def test_a_mute_board_is_started_whatever_it_is(clock: SteppedClock, period_ms: int) -> None:
    """An MTB3 that is taken for another board stopped when it was asked for its uptime."""
    heard = Heard(period_ms=period_ms, model="mtb4")
    wired = Wired(heard, clock, mute=True)
    beginning = asyncio.create_task(heard.boards.bring_up())
    frames = await wired.run(20.0)
    await beginning
    assert frames == pytest.approx(2 * 9 * 1000 / period_ms, rel=0.05, abs=18)
    await heard.boards.stop()


@stepped
@pytest.mark.parametrize("model", ["mtb3", "mtb4"])
async def test_a_board_of_another_model_than_configured_is_named_and_sends(
    clock: SteppedClock, model: str
) -> None:
    heard = Heard(model=model)
    wired = Wired(heard, clock, mute=False)
    beginning = asyncio.create_task(heard.boards.bring_up())
    assert await wired.run(10.0) == pytest.approx(360, abs=18)
    await beginning
    found = [one for one in heard.record()["sentences"] if "boards.hand.model" in one]
    assert bool(found) == (model == "mtb4")
    assert (("board_wrong_model", "hand") in heard.told()) == (model == "mtb4")
    await heard.boards.stop()


def test_one_damaged_answer_makes_no_board_one_of_another_model(heard: Heard) -> None:
    heard.answer(Discovered(BoardType.SKIN, 2, 17, 0), HAND)
    heard.boards.records[HAND].asked += 1
    heard.answer(Discovered(BoardType.MTB4, 1, 25, 0), HAND)
    assert ("board_wrong_model", "hand") not in heard.told()
    heard.answer_again(Discovered(BoardType.SKIN, 2, 17, 0), HAND)
    assert ("board_wrong_model", "hand") in heard.told()
    heard.answer(Discovered(BoardType.MTB4, 1, 25, 0), HAND)
    assert ("board_wrong_model", "hand") not in heard.told()


def test_an_ergo_hand_that_runs_gets_another_shift_for_all_of_its_triangles() -> None:
    """Its firmware keeps what a triangle is set up with beside another one. Three fingers were
    still shifted as before, so that pressures were wrong by a factor, until the robot was off.
    """
    bench = BoardOnBench("mtb4", slots=(0, 4, 8, 12, 16), skin_type=3)
    chips = list(bench.chips.values())
    for shift in (1, 2, 0):
        settings = Settings(
            robot="r",
            buses={"can0": Bus()},
            boards={"hand": Board(bus="can0", address=1, skin_type=3)},
            parts={
                "hand": Part(
                    patches=[Patch(board="hand", triangles="0-4", kind="fingertip", shift=shift)]
                )
            },
        )
        layout = build_layout(settings, CONFIG.parent)
        commands = configuration(layout.boards[0], list(layout.triangles))
        for command in [*commands, commands[-1], SetTxMode(TxMode.START)]:
            bench.say(command)
            bench.run(0.09)
        for chip in chips:
            chip.set_capacitance_ff(0, RESTING_FF + 0.36 * 100)
        bench.run(0.05)
        frames = bench.run(0.05)
        seen = [bench.triangle(frames, number)[0][0] for number in range(5)]
        assert seen == [240 - (100 >> shift)] * 5
        for chip in chips:
            chip.set_capacitance_ff(0, RESTING_FF)
        bench.run(0.05)
