"""The boards of one bus: found, set up, started, watched, set up again, stopped.

A board that falls silent is asked who it is and how long it has been up: at once, then
ever more rarely. One that was reset is set up again; one that was not is told to start,
which leaves its zero alone; one that does not answer is asked again later. A board that
sends, but not what it was set up to send (triangles off, another period), has lost its
set-up and gets it again. Each is treated alone; the others go on undisturbed.

Their pitfalls decide the order (reference of the wire, sections 3 and 4):

- discovery comes first, because a streaming MTB3 falls silent after any class-7 frame;
- command 4D disables all triangles, so the 50s follow it;
- an MTB4 stops when it takes a 50, so the start comes last;
- an MTB4 takes its baseline before the first conversion with a new CDC offset, so the
  last 50 is sent once more after that conversion;
- an MTB3 reads its five mailboxes newest first and blocks for two periods while it
  calibrates, so its commands are spaced by more than that.
"""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Iterable
from typing import Protocol

from skin_host.bus.board import GAP_S, BoardRecord, configuration
from skin_host.bus.protocol import (
    BROADCAST_ADDRESS,
    FrameBatch,
    MessageClass,
)
from skin_host.bus.protocol.answers import (
    Discovered,
    DiscoveredBootloader,
    TimeOfLife,
    TxOverflow,
    parse_answer,
)
from skin_host.bus.protocol.commands import (
    SKIN_BOARD_TYPES,
    Discover,
    GetTimeOfLife,
    Message,
    SetTxMode,
    TxMode,
    command_frame,
)
from skin_host.errors import BusError
from skin_host.layout import BoardLayout, TriangleLayout

log = logging.getLogger(__name__)

#: Boards answer at once; a busy computer hears them later.
DISCOVERY_S = 0.5
#: Two conversions of twelve stages at decimation 256 (36.9 ms each), and some air.
NEW_OFFSET_S = 0.09
#: A board that does not answer within this time has not heard the question.
ANSWER_S = 1.0
#: One that never answers is set up every so many questions all the same: it may be mute only.
MUTE_QUESTIONS = 4
#: A silent board is seen to at once, then after so long, up to the last.
RETRY_S = (1.0, 2.0, 4.0, 8.0)
#: A board must send something wrong for so long before it is set up again, then the pause
#: doubles up to the last: what setting up does not mend should not be disturbed for ever.
WRONG_S = 1.0
WRONG_RETRY_S = (5.0, 10.0, 20.0, 60.0)
_ANSWERS = (MessageClass.ANALOG_COMMAND, MessageClass.MANAGEMENT)


class Sender(Protocol):
    """What is needed of a port: paced sending."""

    async def send(self, frames: Iterable[tuple[int, bytes]], gap_s: float = ...) -> None:
        """Send (identifier, data) frames, `gap_s` apart. Raises BusError."""


class Boards:
    """Bring-up and supervision of the boards of one bus.

    Args:
        bus: its name, for messages.
        port: where commands are sent.
        boards: (index in `Layout.boards`, board) of this bus.
        triangles: all triangles of the skin.
        silent_periods: a started board is silent after so many periods without a sweep.
        zeroed: called just before a board takes a new zero, with its index and whether what it
            sent until now was what it had been set up to send.
        clock: time in ns that only passes while the bus is being read: while nobody looks, no
            board is silent.
    """

    def __init__(
        self,
        bus: str,
        port: Sender,
        boards: list[tuple[int, BoardLayout]],
        triangles: tuple[TriangleLayout, ...],
        silent_periods: float,
        zeroed: Callable[[int, bool], object] = lambda *_: None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.bus = bus
        self._clock = clock
        self._zeroed = zeroed
        self._port = port
        self._silent_periods = silent_periods
        self.records = {board.settings.address: BoardRecord(i, board) for i, board in boards}
        self._of_index = {record.index: record for record in self.records.values()}
        self.strangers: dict[int, int] = {}
        #: The identifier that strangers' frames have most.
        self.stranger_id: int | None = None
        for record in self.records.values():
            mine = [triangle for triangle in triangles if triangle.board == record.index]
            record.commands = configuration(record.layout, mine)

    async def bring_up(self) -> None:
        """Discover, set up and start every board of the bus.

        Raises:
            BusError: the bus does not take frames.
        """
        await self._port.send([command_frame(Discover(), BROADCAST_ADDRESS)])
        end_s = time.monotonic() + DISCOVERY_S
        while any(record.board_type is None for record in self.records.values()):
            if time.monotonic() > end_s:
                break
            await asyncio.sleep(GAP_S)
        for address, record in self.records.items():
            if record.board_type is None:
                log.warning(
                    "bus %s: board %s (address %d) did not answer discovery; is it powered?",
                    self.bus,
                    record.layout.name,
                    address,
                )
        for address, kind in self.strangers.items():
            log.warning(
                "bus %s: a board of type %d at address %d is not in the configuration",
                self.bus,
                kind,
                address,
            )
        heard = []
        for record in self.records.values():
            if record.board_type is not None or record.last_sweep_ns:
                heard.append(record)
            else:
                # Asked again later: one that is just starting would take the end of its set-up.
                record.started = True
                record.configured_ns = self._clock()
        await asyncio.gather(*(self._set_up(record) for record in heard))

    async def set_up(self, address: int) -> None:
        """Send a board its set-up and start it.

        Raises:
            BusError: the bus does not take frames.
        """
        record = self.records[address]
        while record.busy is not None:
            await asyncio.wait([record.busy])
        # Busy, so that nobody sees to its silence meanwhile.
        await self._occupy(record, self._set_up(record))

    async def _set_up(self, record: BoardRecord) -> None:
        address = record.layout.settings.address
        gap_s = record.gap_s
        frames = [command_frame(command, address) for command in record.commands]
        self._zeroed(record.index, record.configurations > 0 and not record.missing)
        await self._port.send(frames, gap_s)
        await asyncio.sleep(max(gap_s, NEW_OFFSET_S))
        await self._port.send([frames[-1]])
        await asyncio.sleep(max(gap_s, NEW_OFFSET_S))
        await self._port.send([command_frame(SetTxMode(TxMode.START), address)])
        record.configurations += 1
        record.configured_ns = self._clock()
        record.configured_at_ns = time.monotonic_ns()
        record.sweep_times_ns.clear()
        record.presents.clear()
        record.wrong = ""
        record.started = True

    def supervise(self) -> None:
        """Look after every board; what is to be done takes place beside everything else.

        No discovery of all here: it would silence the MTB3s that are well.
        """
        now_ns = self._clock()
        for record in self.records.values():
            if not record.started or record.busy is not None:
                continue
            period_ns = record.layout.settings.period_ms * 1_000_000
            since_ns = max(record.last_sweep_ns, record.configured_ns)
            silent = now_ns - since_ns > self._silent_periods * period_ns
            if silent:
                self._note_silence(record, now_ns)
            elif record.last_sweep_ns >= record.configured_ns:
                self._note_sending(record, now_ns)

    def _note_silence(self, record: BoardRecord, now_ns: int) -> None:
        if record.alive:
            log.debug("bus %s: board %s is silent", self.bus, record.layout.name)
            record.alive = False
            record.silences += 1
            record.retries = 0
            record.retry_at_ns = now_ns
        if record.retry_at_ns <= now_ns:
            wait_s = RETRY_S[min(record.retries, len(RETRY_S) - 1)]
            record.retry_at_ns = now_ns + int(wait_s * 1e9)
            record.retries += 1
            self._begin(record, self._revive(record))

    def _note_sending(self, record: BoardRecord, now_ns: int) -> None:
        if not record.alive:
            record.alive = True
            log.debug("bus %s: board %s is sending", self.bus, record.layout.name)
        self._judge(record, now_ns)
        if not record.wrong or now_ns - record.wrong_since_ns < WRONG_S * 1e9:
            if not record.wrong and now_ns - record.wrong_retry_ns > WRONG_RETRY_S[-1] * 1e9:
                record.wrong_tries = 0
            return
        if now_ns < record.wrong_retry_ns:
            return
        wait_s = WRONG_RETRY_S[min(record.wrong_tries, len(WRONG_RETRY_S) - 1)]
        record.wrong_retry_ns = now_ns + int(wait_s * 1e9)
        record.wrong_tries += 1
        record.lost_set_ups += record.configurations > 0
        if record.wrong_tries == 1:
            log.warning(
                "bus %s: board %s %s: it is set up",
                self.bus,
                record.layout.name,
                record.wrong,
            )
        self._begin(record, self._set_up(record))

    @staticmethod
    def _judge(record: BoardRecord, now_ns: int) -> None:
        wrong = ""
        seen_ns = record.wrong_period_ns
        if not record.configurations:
            wrong = "sends without having been set up"
        elif record.missing:
            wrong = "does not send all of its triangles"
        elif seen_ns is not None:
            wrong = f"sends every {seen_ns / 1e6:.0f} ms, not {record.layout.settings.period_ms} ms"
        if wrong and not record.wrong:
            record.wrong_since_ns = now_ns
        record.wrong = wrong

    def _begin(self, record: BoardRecord, work: Coroutine[None, None, None]) -> None:
        async def do() -> None:
            try:
                await work
            except BusError as error:
                log.debug("bus %s: %s", self.bus, error)

        self._occupy(record, do())

    @staticmethod
    def _occupy(record: BoardRecord, work: Coroutine[None, None, None]) -> "asyncio.Task[None]":
        """Begin what nothing else is done to the board beside."""

        def end(_: "asyncio.Task[None]") -> None:
            record.busy = None

        record.busy = asyncio.create_task(work, name=f"board {record.layout.name}")
        record.busy.add_done_callback(end)
        return record.busy

    async def _revive(self, record: BoardRecord) -> None:
        """Ask a silent board who it is and how long it has been up; do what that calls for."""
        address = record.layout.settings.address
        asked_ns = time.monotonic_ns()
        # An MTB3 does not tell its age; one that answers and does not send was reset.
        tells_age = not record.is_mtb3
        questions: list[Message] = [Discover()]
        if tells_age:
            questions.append(GetTimeOfLife())
        sent_before = record.last_sweep_ns > record.configured_ns
        record.answered_ns, record.life_s = 0, None
        await self._port.send([command_frame(question, address) for question in questions])
        last_sweep_ns = record.last_sweep_ns
        while time.monotonic_ns() - asked_ns < ANSWER_S * 1e9:
            if record.answered_ns and (record.life_s is not None or not tells_age):
                break
            if tells_age and record.last_sweep_ns > last_sweep_ns and sent_before:
                return  # it only paused
            await asyncio.sleep(GAP_S)
        mute = record.board_type is None and record.retries % MUTE_QUESTIONS == 0
        if record.in_bootloader or not (record.answered_ns or mute):
            return
        reset = record.answered_ns != 0 and not tells_age
        if record.life_s is not None:
            reset = asked_ns - int(record.life_s * 1e9) > record.configured_at_ns
        record.resets += reset and record.configurations > 0
        if sent_before and record.life_s is not None and not reset and record.retries == 1:
            await self._port.send([command_frame(SetTxMode(TxMode.START), address)])
        else:
            await self._set_up(record)

    async def stop(self) -> None:
        """Tell every board to stop sending.

        Raises:
            BusError: the bus does not take frames.
        """
        busy = [record.busy for record in self.records.values() if record.busy is not None]
        for task in busy:
            task.cancel()
        await asyncio.gather(*busy, return_exceptions=True)
        for address, record in self.records.items():
            record.started = False
            await self._port.send([command_frame(SetTxMode(TxMode.STOP), address)])

    def note_sweep(self, board: int, present: int, t_ns: int) -> None:
        """A sweep of this board (index in `Layout.boards`) came, with these triangles.

        Whether a board is silent goes by our own clock: `t_ns` may jump.
        """
        record = self._of_index[board]
        record.last_sweep_ns = self._clock()
        record.sweep_times_ns.append(t_ns)
        record.presents.append(present)

    def feed(self, batch: FrameBatch) -> None:
        """Take answers out of a batch."""
        # Nearly all frames are skin; looking at each costs less than arrays of the few others.
        strange: list[int] = []
        for _, _, identifier, dlc, first, rest in batch.frames():
            message_class = identifier >> 8
            if message_class in _ANSWERS:
                parsed = parse_answer(identifier, (bytes([first]) + rest)[:dlc])
                if parsed is not None:
                    self._note_answer(*parsed)
            elif message_class < MessageClass.ANALOG_COMMAND:
                strange.append(identifier)
        if 2 * len(strange) > len(batch):
            ((self.stranger_id, _),) = Counter(strange).most_common(1)

    def _note_answer(self, address: int, answer: Message | TxOverflow) -> None:
        record = self.records.get(address)
        if record is None:
            if isinstance(answer, Discovered):
                self.strangers[address] = answer.board_type
            return
        if isinstance(answer, Discovered | DiscoveredBootloader | TimeOfLife):
            record.answered_ns = time.monotonic_ns()
        if isinstance(answer, Discovered):
            record.board_type = answer.board_type
            record.firmware = (
                answer.firmware_major,
                answer.firmware_minor,
                answer.firmware_build,
            )
            record.in_bootloader = False
            if answer.board_type not in SKIN_BOARD_TYPES:
                log.warning(
                    "bus %s: board %s is of type %d, which is no skin board",
                    self.bus,
                    record.layout.name,
                    answer.board_type,
                )
        elif isinstance(answer, DiscoveredBootloader):
            record.board_type = answer.board_type
            record.in_bootloader = True
            log.warning("bus %s: board %s is in its bootloader", self.bus, record.layout.name)
        elif isinstance(answer, TimeOfLife):
            record.life_s = answer.seconds
        elif isinstance(answer, TxOverflow):
            record.tx_overflows += 1
