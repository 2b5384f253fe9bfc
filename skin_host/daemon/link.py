"""The buses of one node: their ports, their boards, and the loop that reads them."""

import asyncio
import contextlib
import logging
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import AbstractContextManager
from functools import partial
from itertools import chain
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.boards import Boards
from skin_host.bus.commands import ZEROING, Message, cut_where_zeroed, parse_command
from skin_host.bus.opening import open_port
from skin_host.bus.port import Port
from skin_host.bus.wake import LONGEST_NS, WakeUp
from skin_host.bus.wire import NS_PER_S, FrameBatch, in_slices, merged
from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Bus, Receive
from skin_host.errors import BusError, SkinError
from skin_host.fingertip.service import StrainBoards
from skin_host.processing.contacts import LOST_NS
from skin_host.processing.core import EXPIRE_NS, Engine, Output

log = logging.getLogger(__name__)

#: Frames that several buses with a common part sent within this time may be taken bus by bus.
SLICE_NS = 10_000_000
#: A turn that comes later than planned by this was held up by other work on this computer.
HELD_UP_NS = 25_000_000
#: What brings the frames may have been held up by the same work. For this long after such a turn
#: no sweep is closed and no board becomes silent, so that what is on its way is not missed.
PATIENCE_NS = 100_000_000
#: It may go on as late as it was held up: it may be as long again until every board that was
#: received before is received again, up to this. Until then no board becomes silent; what has been
#: received does not wait for it.
LONGEST_PATIENCE_NS = 2_000_000_000
#: The end waits in steps of this until what came before it has been read.
CATCH_UP_S = 0.005
#: The time of day was set where it has moved by this much more or less than the time since the
#: computer was started, from turn to turn. Less is how a clock is corrected slowly.
CLOCK_SET_NS = 100_000_000
#: In so many turns all is read that waits when a board is zeroed, but where this computer is too
#: slow for what comes.
MOST_TURNS = 64
#: What some buses return of what was sent on them, as multicast does, comes within this time.
ECHO_S = 1.0
#: Commands of another program that follow each other as fast give a board one zero: a new one is
#: found over a longer time, and anybody on the bus may send as many as it carries.
ONE_ZERO_NS = 20_000_000
#: A bus that does not take the set-up of its boards is tried again after this.
RETRY_S = 2.0
STOP_S = 1.0


class OpenPort(Protocol):
    """How buses are opened."""

    def __call__(
        self, name: str, bus: Bus, receive: Receive, *, wait: bool = False, clock: Clock = SYSTEM
    ) -> Port:
        """See `bus.opening.open_port`."""


def _close(opened: "Future[Port]") -> None:
    """Close a port, if it could be opened."""
    if not opened.cancelled() and opened.exception() is None:
        opened.result().close()


class Link:
    """Connects an engine to the buses that it needs.

    Args:
        engine: processes the frames.
        wait: wait for a bus that cannot be opened, as for one that was unplugged.
        open_port: opens a bus, see `bus.opening.open_port`.
        clock: for waiting.

    Attributes:
        ports, boards: by name of the bus.
        force_torque: the boards of fingertips, by name of the bus.
        read_ns: everything received up to then has been read, on the clock of the frames' time
            stamps. Ages count from here, not from now: a board whose frames wait unread has not
            timed out.
        is_behind: what is read now is of before: nothing was read for so long that nobody knows
            what is felt, and not all has been read since, as far as that takes no longer than
            `LONGEST_PATIENCE_NS`.

    Raises:
        ConfigurationError: python-can has no such kind of interface.
        BusError: a bus cannot be opened, and `wait` is not set. Those already open are closed
            again.
    """

    def __init__(
        self,
        engine: Engine,
        *,
        wait: bool = False,
        open_port: OpenPort = open_port,
        clock: Clock = SYSTEM,
    ) -> None:
        self._clock = clock
        self._engine = engine
        self.read_ns = clock.now_ns()
        self.ports: dict[str, Port] = {}
        self.boards: dict[str, Boards] = {}
        self.force_torque: dict[str, StrainBoards] = {}
        #: Boards of which it is not known yet whether they can be set up; and those that could not
        #: be so far, and are tried again.
        self._untried: set[Boards | StrainBoards] = set()
        self._failing: set[Boards | StrainBoards] = set()
        #: Set whenever one of these changes.
        self._tried = asyncio.Event()
        fingertips = engine.fingertips
        settings, layout = engine.settings, engine.layout
        periods_ns = {i: layout.boards[i].settings.period_ms * 1_000_000 for i in engine.boards}
        if fingertips is not None:
            # Negative keys never collide with board indices.
            for tip in fingertips.tips.values():
                periods_ns[~tip.number] = tip.settings.period_ms * 1_000_000
        bus_of = {i: layout.boards[i].settings.bus for i in engine.boards}
        of_parts = [{bus_of[i] for i in layout.parts[part].boards} for part in engine.parts]
        # Buses that share no part keep their time to a period: so each slice has a sweep of every
        # board, and there are few slices, which matters most when this computer is late already.
        shared = any(len(buses) > 1 for buses in of_parts)
        self._slice_ns = SLICE_NS if shared else min(periods_ns.values(), default=SLICE_NS)
        alone = [(key,) for key in periods_ns if key < 0]
        fastest_ns = [
            min(periods_ns[one] for one in layout.parts[part].boards) for part in engine.parts
        ]
        fastest_ns += [periods_ns[key] for (key,) in alone]
        self._wake_up = WakeUp(
            settings.receive,
            periods_ns,
            clock,
            (lambda: chain(self._missing(), alone)) if alone else self._missing,
            sum(1e9 / period_ns for period_ns in fastest_ns),
        )
        self._expired_ns = 0
        self._started_at_ns = self._now_started_at_ns()
        self._held_up_ns = max(LONGEST_NS, int(settings.receive.poll_ms * 1e6)) + HELD_UP_NS
        self._held_up_at_ns: int | None = None
        self._patience_ns = PATIENCE_NS
        #: How many sweeps of each board had been received when a turn was last held up.
        self._sweeps_then = engine.ledger.sweeps.copy()
        self._longest_pause_ns = 0
        self.is_behind = False
        self._overdue_ns = max(LOST_NS, self._held_up_ns)
        #: Identifier, data and time of each frame that was sent since the last turn, by bus.
        self._sent: dict[str, list[tuple[int, bytes, int]]] = {}
        #: Bus, receiver and command of what was sent, and when, s: some buses return it.
        self._echoes: list[tuple[tuple[str, int, Message], float]] = []
        #: When another program last gave each board a zero.
        self._zeroed_ns: dict[int, int] = {}
        #: Reads the buses and passes the results on, once `read` does that.
        self._work: Callable[[], None] = lambda: None
        # Beside each other: what does not answer is waited for, and holds no other bus up.
        openers = {bus: clock.executor(f"open {bus}") for bus in engine.assemblers}
        open_one = partial(open_port, wait=wait, clock=clock)
        opening = {
            bus: opener.submit(open_one, bus, settings.buses[bus], settings.receive)
            for bus, opener in openers.items()
        }
        try:
            for bus in engine.assemblers:
                port = opening[bus].result()
                port.on_sent = partial(self._note_sent, bus)
                self.ports[bus] = port
                mine = [
                    (i, layout.boards[i])
                    for i in engine.boards
                    if layout.boards[i].settings.bus == bus
                ]
                self.boards[bus] = Boards(
                    bus,
                    port,
                    mine,
                    layout.triangles,
                    engine.ledger,
                    self._zeroed,
                    clock,
                    engine.assemblers[bus].unconfigured,
                    {
                        *(tip.address for tip in settings.fingertips.values() if tip.bus == bus),
                        *(one.settings.address for one in layout.boards if one.settings.bus == bus),
                    },
                )
                if fingertips is not None and (tips := fingertips.on_bus(bus)):
                    self.force_torque[bus] = StrainBoards(
                        bus, port, tips, lambda: engine.ledger.now_ns
                    )
        except SkinError:
            for opened in opening.values():
                opened.add_done_callback(_close)
            raise
        finally:
            for opener in openers.values():
                opener.close()
        self._untried.update(self._all_boards())
        # What opening takes is no stall of this computer.
        self._turned_ns = clock.now_ns()
        self._turned_at_boot_ns = self._behind_at_boot_ns = clock.since_boot_ns()

    def use(self, engine: Engine) -> None:
        """Continue with another engine, which has the ledger of the one before."""
        self._engine = engine

    def _missing(self) -> list[dict[int, int]]:
        return self._engine.intake.missing()

    def _zeroed(self, board: int, believed: bool) -> None:
        # What waits unread, as after a stall, is of the zero before, and may show what touches it.
        now_ns = self._clock.now_ns()
        for _ in range(MOST_TURNS):
            self._work()
            if self.read_ns >= now_ns:
                break
        self._engine.zeros.rezero(board, believed)

    async def read(
        self,
        deliver: Callable[[Output], None],
        record: Callable[[str, FrameBatch], None] = lambda *_: None,
        together: AbstractContextManager[None] = contextlib.nullcontext(),  # noqa: B008  # no state
    ) -> None:
        """Read all buses for ever; pass the results to `deliver`.

        Args:
            deliver: called after each batch, and several times a second.
            record: called with what was received, and sent, in the order of time.
            together: block in which each turn delivers; at its end the results leave.
        """

        def work() -> None:
            with together:
                self.turn(self._clock.now_ns(), deliver, record)
            self._engine.judge()

        self._work = work
        try:
            await self._wake_up.run(work)
        finally:
            # Boards may still be set up, but nothing takes results any more.
            self._work = lambda: None

    def turn(
        self,
        now_ns: int,
        deliver: Callable[[Output], None],
        record: Callable[[str, FrameBatch], None] = lambda *_: None,
    ) -> None:
        """Read every bus once.

        Args:
            now_ns: the time, on the clock of the frames' time stamps.
            deliver, record: see `read`.
        """
        boot_ns = self._clock.since_boot_ns()
        if self.is_overdue():
            self.is_behind, self._behind_at_boot_ns = True, boot_ns
            deliver(Output([], [], [], [], []))  # known at once, also where nothing waits
        self._turned_at_boot_ns = boot_ns
        pause_ns, self._turned_ns = now_ns - self._turned_ns, now_ns
        if pause_ns > self._held_up_ns:
            self._note_held_up(now_ns, pause_ns)
        read_ns, is_behind = now_ns, False
        batches: list[tuple[str, FrameBatch]] = []
        for bus, port in self.ports.items():
            batch = port.read()
            read_ns = min(read_ns, port.read_until_ns(now_ns))
            n = len(batch)
            if not n:
                continue
            if n >= port.capacity:
                is_behind = True
                read_ns = min(read_ns, int(batch.t_ns[-1]))
            batches.append((bus, batch))
        self._note_clock()
        slices = in_slices(batches, self._slice_ns)
        recorded = in_slices(self._with_sent(batches), self._slice_ns) if self._sent else slices
        for bus, batch in recorded:
            record(bus, batch)
        for bus, batch in slices:
            for piece in cut_where_zeroed(batch, partial(self._note_other_host, bus)):
                output = self._engine.feed(bus, piece)
                if output.answers:
                    self._note_answers(bus, output.answers)
                self._note(output)
                deliver(output)
        self.read_ns = read_ns
        # What brings the frames may have been held up, too.
        self.is_behind &= (
            is_behind or self._held_up_at_ns is not None
        ) and boot_ns - self._behind_at_boot_ns < LONGEST_PATIENCE_NS
        # What is behind is complete up to its last frame, whatever held this computer up.
        if self._held_up_at_ns is not None and not is_behind and self._is_patient(now_ns):
            self._engine.ledger.pass_over(read_ns)
            if 0 <= now_ns - self._held_up_at_ns < PATIENCE_NS:
                return
        else:
            self._engine.ledger.look(read_ns)
        if not 0 <= read_ns - self._expired_ns < EXPIRE_NS:
            self._expired_ns = read_ns
            output = self._engine.expire(read_ns)
            self._note(output)
            deliver(output)

    def _note_sent(self, bus: str, identifier: int, data: bytes) -> None:
        self._sent.setdefault(bus, []).append((identifier, data, self._clock.now_ns()))
        parsed = parse_command(identifier, data)
        if parsed is not None and isinstance(parsed[1], ZEROING):
            now_s = self._clock.monotonic_s()
            self._echoes = [one for one in self._echoes if now_s - one[1] < ECHO_S]
            self._echoes.append(((bus, *parsed), now_s))

    def _note_other_host(self, bus: str, address: int, command: Message, t_ns: int) -> None:
        """A command was received that gives a board, or all, another zero."""
        now_s = self._clock.monotonic_s()
        for echo in self._echoes:
            if echo[0] == (bus, address, command) and now_s - echo[1] < ECHO_S:
                self._echoes.remove(echo)
                return
        for board, believed in self.boards[bus].note_other_host(address, command):
            since_ns = t_ns - self._zeroed_ns.get(board, -ONE_ZERO_NS)
            if not 0 <= since_ns < ONE_ZERO_NS:
                self._zeroed_ns[board] = t_ns
                self._engine.zeros.rezero(board, believed)

    def _with_sent(self, batches: list[tuple[str, FrameBatch]]) -> list[tuple[str, FrameBatch]]:
        """Return the batches of a turn together with what was sent since the turn before."""
        sent = {bus: FrameBatch.of(frames) for bus, frames in self._sent.items()}
        self._sent.clear()
        both = [
            (bus, merged(batch, sent.pop(bus)) if bus in sent else batch) for bus, batch in batches
        ]
        return [*both, *sent.items()]

    async def catch_up(self) -> None:
        """Wait until `read` has read what came before now, and then a sweep of every board, or for
        as long as it may take: what a buffer had no room for shows in the boards' next sweeps.
        """
        asked_ns = self._clock.now_ns()
        end_s = self._clock.monotonic_s() + LONGEST_PATIENCE_NS / NS_PER_S
        while self.read_ns < asked_ns or self._held_up_at_ns is not None:
            if self._clock.monotonic_s() >= end_s:
                if self.read_ns < asked_ns:
                    log.warning("ends with frames unread: they come faster than they are processed")
                return
            await self._clock.sleep(CATCH_UP_S)
        before = self._engine.ledger.sweeps.copy()
        while not self._are_back(before) and self._clock.monotonic_s() < end_s:
            await self._clock.sleep(CATCH_UP_S)

    def _are_back(self, before: NDArray[np.int64]) -> bool:
        """Whether each board was received since its `before` sweeps, never before, or is silent."""
        ledger = self._engine.ledger
        return bool(((ledger.sweeps > before) | (before == 0) | ledger.silent).all())

    def _now_started_at_ns(self) -> int:
        """Return the time of day at which this computer was started, by the present clock."""
        return self._clock.now_ns() - self._clock.since_boot_ns()

    def _note_clock(self) -> None:
        """Report to the engine that the time of day was set before the last frames were stamped."""
        before_ns, self._started_at_ns = self._started_at_ns, self._now_started_at_ns()
        step_ns = self._started_at_ns - before_ns
        if abs(step_ns) >= CLOCK_SET_NS:
            self._engine.clock_set(step_ns)

    def _note_held_up(self, now_ns: int, pause_ns: int) -> None:
        """This turn was held up; what waits has not been read yet."""
        self._longest_pause_ns = max(self._longest_pause_ns, pause_ns)
        if self._held_up_at_ns is None:
            self._held_up_at_ns = now_ns
            self._patience_ns = min(max(pause_ns, PATIENCE_NS), LONGEST_PATIENCE_NS)
            self._sweeps_then[:] = self._engine.ledger.sweeps

    def _is_patient(self, now_ns: int) -> bool:
        """Whether this turn, or one shortly before it, was held up.

        Between two such times what has waited too long is closed once, so that a computer that is
        held up all the time closes it too.
        """
        if self._held_up_at_ns is None:
            return False
        waited_ns = now_ns - self._held_up_at_ns
        if 0 <= waited_ns < PATIENCE_NS:
            return True
        if 0 <= waited_ns < self._patience_ns and not self._are_back(self._sweeps_then):
            return True
        self._held_up_at_ns = None
        return False

    def is_overdue(self) -> bool:
        """Return whether nothing was read for so long that nobody knows what is felt: this computer
        was held up, stopped or asleep.
        """
        return self._clock.since_boot_ns() - self._turned_at_boot_ns >= self._overdue_ns

    def longest_pause_ns(self) -> int:
        """Return by how long a turn was held up at most since this was last called; 0: by less
        than matters.
        """
        longest_ns, self._longest_pause_ns = self._longest_pause_ns, 0
        return longest_ns

    def _note(self, output: Output) -> None:
        """Note that the next sweep of a board is one period later."""
        for sweep in output.sweeps:
            self._wake_up.sweep_ended(sweep.board, sweep.t_ns)
        for number, t_ns in output.samples:
            self._wake_up.sweep_ended(~number, t_ns)

    def _note_answers(self, bus: str, answers: list[tuple[int, bytes]]) -> None:
        self.boards[bus].note_answers(answers)

    async def bring_up(self) -> None:
        """Set up and start the boards of every bus; a bus where that fails is tried again for
        ever.
        """
        await asyncio.gather(*(self._bring_up(boards) for boards in self._all_boards()))

    async def until_set_up(self) -> None:
        """Wait until all boards are set up that a calibration of all has to wait for: not those of
        buses that are away, while there are others; but fingertips get no zero later.
        """
        while not self._is_set_up():
            self._tried.clear()
            await self._tried.wait()

    def _is_set_up(self) -> bool:
        if self._untried or not self._failing.isdisjoint(self.force_torque.values()):
            return False
        with_boards = {boards for boards in self.boards.values() if boards.records}
        return not with_boards or not with_boards <= self._failing

    def set_ups(self, board: int) -> int:
        """Return how often a board, by its index, has been set up; 0 if no values of its pads come
        since.
        """
        known, ledger = self._engine.layout.boards[board].settings, self._engine.ledger
        record, row = self.boards[known.bus].records[known.address], ledger.row[board]
        answering = ledger.answered(row)
        if ledger.is_silent(row) or not (ledger.since_set_up(row) and answering.any()):
            return 0
        return record.configurations

    async def set_up(self, boards: list[int]) -> None:
        """Send boards, by index, their set-up again and start them.

        Raises:
            BusError: a bus does not take frames.
        """
        layout = self._engine.layout
        chosen = [layout.boards[board].settings for board in boards]
        await asyncio.gather(*(self.boards[one.bus].set_up(one.address) for one in chosen))

    def supervise(self) -> None:
        """Supervise the boards: those that timed out, and those that lost their set-up."""
        for boards in self._all_boards():
            boards.supervise()

    def all_alive(self) -> bool:
        """Whether every board has sent at least one sweep, or sample of a fingertip."""
        fingertips = self._engine.fingertips
        if fingertips is not None and not all(tip.frames for tip in fingertips.tips.values()):
            return False
        return bool(self._engine.ledger.sweeps.all())

    async def stop(self) -> None:
        """Command the boards to stop, as far as their buses still work."""
        await asyncio.gather(*(self._stop(boards) for boards in self._all_boards()))

    async def _stop(self, boards: Boards | StrainBoards) -> None:
        with contextlib.suppress(BusError, TimeoutError):
            async with self._clock.timeout(STOP_S):
                await boards.stop()

    def close(self) -> None:
        for port in self.ports.values():
            port.close()

    def _all_boards(self) -> list[Boards | StrainBoards]:
        return [*self.boards.values(), *self.force_torque.values()]

    async def _bring_up(self, boards: Boards | StrainBoards) -> None:
        told = ""
        sweeps: dict[int, int] = {}
        while True:
            try:
                if isinstance(boards, Boards):
                    # Touches cannot be detected without a calibration.
                    await boards.bring_up(listen=self._engine.calibration is not None)
                else:
                    await boards.bring_up()
                self._failing.discard(boards)
                self._untried.discard(boards)
                self._tried.set()
                return
            except BusError as error:
                self._failing.add(boards)
                self._untried.discard(boards)
                self._tried.set()
                if str(error) != told:
                    log.warning("%s", error)
                    told = str(error)
                if isinstance(boards, Boards):
                    # Boards that go on sending keep the zero that they have. Those of a bus that
                    # was away may have another when it is back; then they are set up.
                    before, sweeps = sweeps, self._sweeps_of(boards)
                    sending = [one for one, n in sweeps.items() if n > before.get(one, n)]
                    self._engine.zeros.release(sending)
                await self._clock.sleep(RETRY_S)

    def _sweeps_of(self, boards: Boards) -> dict[int, int]:
        """Return how many sweeps of each board, by index, have been received."""
        received = self._engine.ledger.sweeps
        return {one.index: int(received[one.row]) for one in boards.records.values()}
