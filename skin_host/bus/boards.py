"""Discovers, sets up, starts, supervises and stops the boards of one bus.

A board that times out is queried for its type and its uptime: at once, then at growing intervals.
If it was reset, it is set up again; if it was not, it is commanded to start, which does not change
its zero; if it does not answer, it is queried again later. A board that sends, but not what it was
set up to send (triangles off, another period), has lost its set-up and gets it again. Each board is
treated separately; the others continue undisturbed.

Properties of the firmware decide the order (reference of the wire, sections 3 and 4):

- discovery comes first, because a streaming MTB3 stops sending after any class-7 frame;
- command 4D disables all triangles, so the 50s follow it;
- an MTB4 stops when it receives a 50, so the start comes last, with a query for its uptime: one
  that was reset meanwhile has lost what came before;
- an MTB4 takes its baseline before the first conversion with a new CDC offset, so the
  last 50 is sent once more after that conversion;
- an MTB3 reads its five mailboxes newest first and blocks for two periods while it
  calibrates, so its commands are spaced by more than that.
"""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping, Set
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

from skin_host.bus.answers import (
    Discovered,
    DiscoveredBootloader,
    TimeOfLife,
    TxOverflow,
    parse_answer,
)
from skin_host.bus.board import GAP_S, BoardRecord, configuration
from skin_host.bus.commands import (
    Discover,
    GetTimeOfLife,
    Message,
    SetTxMode,
    TxMode,
    command_frame,
)
from skin_host.bus.ledger import BoardLedger
from skin_host.bus.wire import BROADCAST_ADDRESS
from skin_host.clock import SYSTEM, Clock
from skin_host.errors import BusError
from skin_host.layout import BoardLayout, TriangleLayout
from skin_host.tasks import cancel

log = logging.getLogger(__name__)

#: Boards answer at once; a busy computer may read the answers later.
DISCOVERY_S = 0.5
#: Two conversions of twelve stages at decimation 256 (36.9 ms each), and some margin.
NEW_OFFSET_S = 0.09
#: A board that does not answer within this time has not received the query.
ANSWER_S = 1.0
#: A board that never answers is set up anyway after every so many queries: it may be unable to
#: answer only.
MUTE_QUESTIONS = 4
#: Pauses before a timed-out board is tried again; the last one repeats.
RETRY_S = (1.0, 2.0, 4.0, 8.0)
#: Boards that stream already are listened to for so many periods, for fewer if none does.
LISTEN_PERIODS = 12
LISTEN_AT_LEAST_PERIODS = 3
#: A board must send something wrong for the first of these times before it is set up again; then
#: the pause doubles up to the last, because repeating a set-up that does not help only disturbs the
#: board.
WRONG_S = 1.0
WRONG_RETRY_S = (5.0, 10.0, 20.0, 60.0)
#: What a board reports of itself is logged no oftener than this.
WARN_S = 60.0
#: An answer counts until so many queries after it were not answered.
UNANSWERED = 2
#: A board that sends for so long after it answered that it is in its bootloader, or reads no skin,
#: did not send that answer, or is another one by now.
CLAIM_S = 5.0


class Sender(Protocol):
    """The part of a port that is needed here: paced sending."""

    async def send(self, frames: Iterable[tuple[int, bytes]], gap_s: float = ...) -> None:
        """Send (identifier, data) frames, `gap_s` apart. Raises BusError."""


@dataclass(slots=True)
class _Unconfigured:
    """A board that answered and is not configured: it is present while it answers or sends."""

    ask_at_ns: int
    frames: int
    unanswered: int = 0


class Boards:
    """Bring-up and supervision of the boards of one bus.

    Args:
        bus: its name, for messages.
        port: where commands are sent.
        boards: (index in `Layout.boards`, board) of this bus.
        triangles: all triangles of the skin.
        ledger: of the node's boards.
        zeroed: called just before a board is zeroed, with its index and whether the values that it
            sent until then were those that it had been set up to send.
        clock: for waiting.
        unconfigured: frames by address of boards that are not configured, see `Assembler`.
        configured: addresses of all boards that the configuration has on this bus, also those of
            fingertips and of other nodes.
    """

    def __init__(
        self,
        bus: str,
        port: Sender,
        boards: list[tuple[int, BoardLayout]],
        triangles: tuple[TriangleLayout, ...],
        ledger: BoardLedger,
        zeroed: Callable[[int, bool], object] = lambda *_: None,
        clock: Clock = SYSTEM,
        unconfigured: Mapping[int, int] = MappingProxyType({}),
        configured: Set[int] = frozenset(),
    ) -> None:
        self.bus = bus
        self._zeroed = zeroed
        self._clock = clock
        self._port = port
        self._ledger = ledger
        self.records = {
            board.settings.address: BoardRecord(i, ledger.row[i], board) for i, board in boards
        }
        #: The types of the boards that are not configured, by address.
        self.strangers: dict[int, int] = {}
        self._sent_by = unconfigured
        self._configured = configured
        self._unconfigured: dict[int, _Unconfigured] = {}
        self._asking: asyncio.Task[None] | None = None
        self._failed = False
        for record in self.records.values():
            mine = [triangle for triangle in triangles if triangle.board == record.index]
            record.commands = configuration(record.layout, mine)

    async def bring_up(self, *, listen: bool = False) -> None:
        """Discover, set up and start every board of the bus.

        Args:
            listen: to what boards send already, first.

        Raises:
            BusError: the bus does not take frames.
        """
        records = list(self.records.values())
        await self._until_free(records)
        try:
            # Occupied: discovery stops an MTB3, so nobody sets up a board in the middle of it.
            await self._occupy(records, self._bring_up(listen))
        except BusError:
            self._failed = True
            raise

    async def _bring_up(self, listen: bool) -> None:
        if listen and self.records:  # a bus may have fingertips only
            await self._listen()
        for record in self.records.values():
            record.asked += 1
        await self._port.send([command_frame(Discover(), BROADCAST_ADDRESS)])
        end_s = self._clock.monotonic_s() + DISCOVERY_S
        while any(record.board_type is None for record in self.records.values()):
            if self._clock.monotonic_s() > end_s:
                break
            await self._clock.sleep(GAP_S)
            for record in self.records.values():
                await self._ask_again(record)
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
            if record.board_type is not None or self._ledger.sweeps[record.row]:
                heard.append(record)
            else:
                # Query it again later: a board that is just starting would receive only the end of
                # its set-up.
                record.started = True
                record.configured_ns = self._ledger.now_ns
        await asyncio.gather(*(self._set_up(record) for record in heard))

    async def _listen(self) -> None:
        """Wait until it is known what touches boards that stream already."""
        period_s = 1e-3 * max(one.layout.settings.period_ms for one in self.records.values())
        began_s = self._clock.monotonic_s()
        while (waited_s := self._clock.monotonic_s() - began_s) < LISTEN_PERIODS * period_s:
            heard = [bool(self._ledger.sweeps[record.row]) for record in self.records.values()]
            if waited_s >= LISTEN_AT_LEAST_PERIODS * period_s and not any(heard):
                return
            await self._clock.sleep(0.5 * period_s)

    async def set_up(self, address: int) -> None:
        """Send a board its set-up and start it.

        Raises:
            BusError: the bus does not take frames.
        """
        record = self.records[address]
        await self._until_free([record])
        # Occupied, so that `supervise` does not act on its silence at the same time.
        await self._occupy([record], self._set_up(record))

    async def _set_up(self, record: BoardRecord) -> None:
        address = record.layout.settings.address
        gap_s = record.gap_s
        frames = [command_frame(command, address) for command in record.commands]
        began_ns = self._clock.monotonic_ns()
        believed = self._believes(record)
        record.set_up_otherwise = False

        def announced(
            zeroing: list[tuple[int, bytes]], believed: bool
        ) -> Iterator[tuple[int, bytes]]:
            # Drawn when this board's turn on the bus comes. Set-ups of others take seconds; until
            # then the board sends with the zero that it has.
            self._zeroed(record.index, believed)
            yield from zeroing

        await self._port.send(announced(frames, believed), gap_s)
        await self._clock.sleep(max(gap_s, NEW_OFFSET_S))
        await self._port.send(announced(frames[-1:], believed=True))
        await self._clock.sleep(max(gap_s, NEW_OFFSET_S))
        record.configured_from_ns = began_ns
        # It answers before its first sweep. Nothing else shows that it was reset before its last
        # commands came: it would send by its own settings. An MTB3 does not report its uptime, and
        # would stop sending.
        questions: list[Message] = [] if record.may_be_mtb3 else [GetTimeOfLife()]
        await self._port.send(self._asked(record, [SetTxMode(TxMode.START), *questions]))
        record.configurations += 1
        record.configured_ns = self._ledger.now_ns
        record.configured_at_ns = self._clock.monotonic_ns()
        self._ledger.set_up(record.row)
        record.wrong = ""
        record.started = True

    def _asked(self, record: BoardRecord, questions: list[Message]) -> Iterator[tuple[int, bytes]]:
        """Yield questions to a board, of which one may be for its uptime, when the bus is free."""
        record.booted_at_ns, record.queried_at_ns = None, self._clock.monotonic_ns()
        for question in questions:
            yield command_frame(question, record.layout.settings.address)

    def note_other_host(self, address: int, command: Message) -> Iterator[tuple[int, bool]]:
        """Note that another program on the bus sets up a board, or every one; yield the boards that
        it gives another zero, as `zeroed` is called with them.
        """
        for record in self.records.values():
            if address not in (record.layout.settings.address, BROADCAST_ADDRESS):
                continue
            yield record.index, self._believes(record)
            record.set_up_otherwise |= command not in record.commands
            self._warn(
                record,
                "is set up by another program on this bus, which gives it another zero: stop that "
                "program, as one host must set up a board",
            )

    def _believes(self, record: BoardRecord) -> bool:
        """Return whether touches of a board are believed: by settings of its own, untouched pads
        may read as if they were pressed.
        """
        in_use = record.configurations > 0 or self._is_in_use(record)
        return in_use and not record.sends_by_itself

    def _is_in_use(self, record: BoardRecord) -> bool:
        """Whether a board sends as one that an earlier start of the daemon has set up."""
        return self._ledger.keeps_period(record.row) is True

    def awaits(self, address: int) -> bool:
        """Whether a board has sent nothing yet because it has not had its time for that: it is
        being discovered or set up.
        """
        record = self.records[address]
        has_sent = bool(self._ledger.sweeps[record.row])
        return not (has_sent or record.retries or self._failed)

    @property
    def awaits_all(self) -> bool:
        """Whether the bus has boards, and none has had its time to send yet."""
        return bool(self.records) and all(map(self.awaits, self.records))

    def supervise(self) -> None:
        """Supervise every board; actions run as separate tasks, so this does not wait for them.

        It never sends a discovery to all boards, because that would stop the MTB3s that work.
        """
        now_ns = self._ledger.now_ns
        for record in self.records.values():
            if not record.started or record.busy is not None:
                continue
            if (
                self._ledger.is_easy(record.row)
                and record.alive
                and record.configurations
                and not (record.wrong or record.wrong_tries or record.claims)
                and not (record.sends_by_itself or record.set_up_otherwise)
            ):
                continue  # the usual case
            if self._ledger.overdue(record.row, record.configured_ns):
                self._note_silence(record, now_ns)
            elif self._ledger.since_set_up(record.row):
                self._note_sending(record, now_ns)
        self._ask_unconfigured(now_ns)

    def _ask_unconfigured(self, now_ns: int) -> None:
        """Query the boards that are not configured again, to forget those that are gone.

        One that sends is not queried: that would stop an MTB3.
        """
        asked = []
        for address in self.strangers:
            known = self._unconfigured[address]
            if now_ns < known.ask_at_ns:
                continue
            known.ask_at_ns = now_ns + int(RETRY_S[-1] * 1e9)
            frames, known.frames = known.frames, self._sent_by.get(address, 0)
            if known.frames != frames:
                known.unanswered = 0
            else:
                asked.append(address)
        for address in asked:
            if self._unconfigured[address].unanswered >= UNANSWERED:
                del self.strangers[address]
        asked = [address for address in asked if address in self.strangers]
        if asked and (self._asking is None or self._asking.done()):
            self._asking = asyncio.create_task(self._ask(asked), name=f"query {self.bus}")

    async def _ask(self, addresses: list[int]) -> None:
        with contextlib.suppress(BusError):  # they are queried again
            await self._port.send([command_frame(Discover(), address) for address in addresses])
            for address in addresses:
                self._unconfigured[address].unanswered += 1

    def _note_silence(self, record: BoardRecord, now_ns: int) -> None:
        if record.alive:
            log.debug("bus %s: board %s is silent", self.bus, record.layout.name)
            record.alive = False
            self._ledger.silences[record.row] += 1
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
        if record.claims and now_ns - record.claimed_ns > CLAIM_S * 1e9:
            record.disclaim()
        self._judge(record, now_ns)
        # Its zero must not be observed; what else is wrong may be by frames that are lost.
        wait_s = 0.0 if record.sends_by_itself else WRONG_S
        if not record.wrong or now_ns - record.wrong_since_ns < wait_s * 1e9:
            if not record.wrong and now_ns - record.wrong_retry_ns > WRONG_RETRY_S[-1] * 1e9:
                record.wrong_tries = 0
            return
        if now_ns < record.wrong_retry_ns:
            return
        wait_s = WRONG_RETRY_S[min(record.wrong_tries, len(WRONG_RETRY_S) - 1)]
        record.wrong_retry_ns = now_ns + int(wait_s * 1e9)
        record.wrong_tries += 1
        self._ledger.lost_set_ups[record.row] += record.configurations > 0
        if record.wrong_tries == 1:
            log.warning(
                "bus %s: board %s %s: setting it up",
                self.bus,
                record.layout.name,
                record.wrong,
            )
        self._begin(record, self._set_up(record))

    def _judge(self, record: BoardRecord, now_ns: int) -> None:
        wrong = ""
        if not record.configurations:
            wrong = "sends without having been set up"
        elif record.sends_by_itself:
            wrong = "was reset while it was set up"
        elif self._ledger.missing(record.row):
            wrong = "does not send all of its triangles"
        elif self._ledger.keeps_period(record.row) is False:
            seen_ms = (self._ledger.regular_period_ns(record.row) or 0.0) / 1e6
            wrong = f"sends every {seen_ms:.0f} ms, not {record.layout.settings.period_ms} ms"
        elif record.set_up_otherwise:
            wrong = "was set up otherwise by another program"
        if wrong and not record.wrong:
            record.wrong_since_ns = now_ns
        record.wrong = wrong

    def _begin(self, record: BoardRecord, work: Coroutine[None, None, None]) -> None:
        async def do() -> None:
            try:
                await work
            except BusError as error:
                log.debug("bus %s: %s", self.bus, error)

        self._occupy([record], do())

    @staticmethod
    async def _until_free(records: list[BoardRecord]) -> None:
        while busy := [record.busy for record in records if record.busy is not None]:
            await asyncio.wait(busy)

    @staticmethod
    def _occupy(
        records: list[BoardRecord], work: Coroutine[None, None, None]
    ) -> "asyncio.Task[None]":
        """Run an action on boards; until it ends, no other action is started on them."""

        def end(_: "asyncio.Task[None]") -> None:
            for record in records:
                record.busy = None

        names = ", ".join(record.layout.name for record in records)
        task = asyncio.create_task(work, name=f"boards {names}")
        for record in records:
            record.busy = task
        task.add_done_callback(end)
        return task

    async def _ask_again(self, record: BoardRecord) -> None:
        """Query a board whose last answer is not believed yet."""
        doubted = record.claim is not None and record.claim[1] == record.asked
        if doubted and not record.claims:
            record.asked += 1
            address = record.layout.settings.address
            await self._port.send([command_frame(Discover(), address)])

    async def _revive(self, record: BoardRecord) -> None:
        """Query a timed-out board for its type and uptime, and take the action that they call
        for.
        """
        address = record.layout.settings.address
        # An MTB3 does not report its uptime; one that answers and does not send was reset, or has
        # been stopped by a query before.
        tells_age = not record.is_mtb3
        questions: list[Message] = [Discover()]
        if tells_age:
            questions.append(GetTimeOfLife())
        sent_before = self._ledger.since_set_up(record.row) > 0
        record.answered_ns = 0
        record.asked += 1
        await self._port.send(self._asked(record, questions))
        asked_ns = self._clock.monotonic_ns()
        sweeps = self._ledger.sweeps[record.row]
        while self._clock.monotonic_ns() - asked_ns < ANSWER_S * 1e9:
            if record.answered_ns and (record.booted_at_ns is not None or not tells_age):
                break
            if tells_age and self._ledger.sweeps[record.row] > sweeps and sent_before:
                return  # it only paused
            await self._clock.sleep(GAP_S)
            await self._ask_again(record)
        record.unanswered = 0 if record.answered_ns else record.unanswered + 1
        if record.unanswered >= UNANSWERED:
            record.disclaim()
        mute = record.board_type is None and record.retries % MUTE_QUESTIONS == 0
        if record.in_bootloader or not (record.answered_ns or mute):
            return
        stopped = self._is_stopped(record)
        reset = record.answered_ns != 0 and not tells_age and not stopped
        if record.booted_at_ns is not None:
            reset = record.was_reset
        self._ledger.resets[record.row] += reset and record.configurations > 0
        if sent_before and record.booted_at_ns is not None and not reset and record.retries == 1:
            await self._port.send([command_frame(SetTxMode(TxMode.START), address)])
        else:
            await self._set_up(record)

    def _is_stopped(self, record: BoardRecord) -> bool:
        """Whether no more than the sweep that was on its way came since a query stopped a board."""
        stopped = record.stopped_sweeps
        return stopped is not None and self._ledger.sweeps[record.row] - stopped <= 1

    async def stop(self) -> None:
        """Command every board to stop sending.

        Raises:
            BusError: the bus does not take frames.
        """
        busy = [self._asking, *(record.busy for record in self.records.values())]
        await cancel(*(task for task in busy if task is not None))
        for address, record in self.records.items():
            record.started = False
            await self._port.send([command_frame(SetTxMode(TxMode.STOP), address)])

    def note_answers(self, answers: Iterable[tuple[int, bytes]]) -> None:
        """Take in frames (identifier, payload) of the classes in which boards answer."""
        for identifier, payload in answers:
            parsed = parse_answer(identifier, payload)
            if parsed is not None:
                self._note_answer(*parsed)

    def _note_answer(self, address: int, answer: Message | TxOverflow) -> None:
        record = self.records.get(address)
        if record is None:
            if isinstance(answer, Discovered) and address not in self._configured:
                self.strangers[address] = answer.board_type
                ask_at_ns = self._ledger.now_ns + int(RETRY_S[-1] * 1e9)
                frames = self._sent_by.get(address, 0)
                self._unconfigured[address] = _Unconfigured(ask_at_ns, frames)
            return
        if isinstance(answer, Discovered | DiscoveredBootloader) and not record.believes(answer):
            return
        if isinstance(answer, Discovered | DiscoveredBootloader | TimeOfLife):
            record.answered_ns = self._clock.monotonic_ns()
        if isinstance(answer, Discovered):
            record.board_type = answer.board_type
            record.firmware = (
                answer.firmware_major,
                answer.firmware_minor,
                answer.firmware_build,
            )
            record.in_bootloader = False
            if record.is_mtb3:
                self._ledger.expect_pauses(record.row)
                if record.busy is None and not self._is_stopped(record):
                    record.stopped_sweeps = int(self._ledger.sweeps[record.row])
                    record.retry_at_ns = 0
            if record.is_wrong_type:
                record.claimed_ns = self._ledger.now_ns
                self._warn(record, f"is of type {answer.board_type}, which is no skin board")
            elif record.is_wrong_model:
                model = record.layout.settings.model
                self._warn(record, f"is of type {answer.board_type}, and configured as {model}")
        elif isinstance(answer, DiscoveredBootloader):
            record.board_type = answer.board_type
            record.in_bootloader = True
            record.claimed_ns = self._ledger.now_ns
            self._warn(record, "is in its bootloader")
        elif isinstance(answer, TimeOfLife):
            record.booted_at_ns = record.queried_at_ns - int(answer.seconds * 1e9)
        elif isinstance(answer, TxOverflow):
            # A board that must answer in the middle of a sweep drops the rest of it: no fault.
            is_queried = not record.started or record.busy is not None
            self._ledger.tx_overflows[record.row] += not is_queried

    def _warn(self, record: BoardRecord, what: str) -> None:
        """Log what a board reports of itself, rarely: anybody on the bus can send its answers."""
        now_ns = self._clock.monotonic_ns()
        if record.warned_at_ns is None or now_ns - record.warned_at_ns > WARN_S * 1e9:
            record.warned_at_ns = now_ns
            log.warning("bus %s: board %s %s", self.bus, record.layout.name, what)
