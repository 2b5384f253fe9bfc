"""The buses of one node: their ports, their boards, and the loop that reads them."""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable

from skin_host.bus.boards import Boards
from skin_host.bus.port import Port, open_port
from skin_host.bus.protocol import FrameBatch
from skin_host.bus.wake import WakeUp
from skin_host.engine import Engine, Step
from skin_host.errors import BusError, SkinError
from skin_host.fingertip.boards import StrainBoards

log = logging.getLogger(__name__)

#: Sweeps and samples that wait are looked at this often.
EXPIRE_S = 0.02
#: A pause between two reads counts for no more than this: after a longer one there is no saying
#: yet who has been silent. Planned pauses are shorter.
LONGEST_PAUSE_NS = 100_000_000
#: A bus that does not take the set-up of its boards is tried again after this.
RETRY_S = 2.0
STOP_S = 1.0


class Link:
    """Connects an engine to the buses that it needs.

    Attributes:
        ports, boards: by name of the bus.
        force_torque: the boards of fingertips, by name of the bus.
        read_ns: everything that had come by then has been read, on the clock of the frames'
            time stamps. Ages are told from here, not from now: what waits unread is not silent.

    Raises:
        BusError: a bus cannot be opened; those already open are closed again.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.read_ns = time.time_ns()
        self._attended_ns = 0
        self._longest_ns = LONGEST_PAUSE_NS + int(engine.settings.receive.poll_ms * 1e6)
        self._read_at_ns = time.monotonic_ns()
        self.ports: dict[str, Port] = {}
        self.boards: dict[str, Boards] = {}
        self.force_torque: dict[str, StrainBoards] = {}
        fingertips = engine.fingertips
        settings, layout = engine.settings, engine.layout
        try:
            for bus in engine.assemblers:
                port = open_port(bus, settings.buses[bus], settings.receive)
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
                    settings.receive.silent_periods,
                    engine.rezero,
                    self.attended_ns,
                )
                if fingertips is not None and (tips := fingertips.on_bus(bus)):
                    self.force_torque[bus] = StrainBoards(bus, port, tips, self.attended_ns)
        except SkinError:
            self.close()
            raise

    async def read(
        self,
        deliver: Callable[[list[Step]], None],
        record: Callable[[str, FrameBatch], None] = lambda *_: None,
    ) -> None:
        """Read all buses for ever; hand what comes of it to `deliver`, often nothing.

        Args:
            deliver: called after each batch, and some times a second.
            record: called with each batch as it came.
        """
        engine = self._engine
        loop = asyncio.get_running_loop()
        periods_ns = {
            i: engine.layout.boards[i].settings.period_ms * 1_000_000 for i in engine.boards
        }
        fingertips = engine.fingertips
        if fingertips is not None:
            # Beside the indices of boards, which are not negative.
            for tip in fingertips.tips.values():
                periods_ns[~tip.number] = tip.settings.period_ms * 1_000_000
        wake_up = WakeUp(engine.settings.receive, periods_ns)
        expire_at_s = 0.0

        def work() -> None:
            nonlocal expire_at_s
            now_ns = time.time_ns()
            drained = True
            for bus, port in self.ports.items():
                batch = port.read()
                if not len(batch):
                    continue
                drained &= len(batch) < port.capacity
                record(bus, batch)
                boards = self.boards[bus]
                boards.feed(batch)
                if bus in self.force_torque:
                    self.force_torque[bus].claim(boards.strangers)
                steps = engine.feed(bus, batch)
                for sweep in engine.sweeps:
                    boards.note_sweep(sweep.board, sweep.present, sweep.t_ns)
                    wake_up.sweep_ended(sweep.board, sweep.t_ns)
                if fingertips is not None:
                    for number, t_ns in fingertips.sampled:
                        wake_up.sweep_ended(~number, t_ns)
                deliver(steps)
            # After what was delivered has been sent.
            loop.call_soon(engine.judge)
            if not drained:
                return
            self.read_ns = now_ns
            self._attend()
            now_s = time.monotonic()
            if now_s >= expire_at_s:
                expire_at_s = now_s + EXPIRE_S
                deliver(engine.expire(now_ns))

        await wake_up.run(work)

    def attended_ns(self) -> int:
        """Time that the reader has spent looking; it stands still while this process does."""
        return self._attended_ns

    def _attend(self) -> None:
        now_ns = time.monotonic_ns()
        self._attended_ns += min(now_ns - self._read_at_ns, self._longest_ns)
        self._read_at_ns = now_ns

    async def bring_up(self) -> None:
        """Set up and start the boards of every bus; a bus that cannot is tried again for ever."""
        await asyncio.gather(*(self._bring_up(boards) for boards in self._all_boards()))

    async def set_up(self, boards: list[int]) -> None:
        """Send boards, by index, their set-up again and start them.

        Raises:
            BusError: a bus does not take frames.
        """
        layout = self._engine.layout
        chosen = [layout.boards[board].settings for board in boards]
        await asyncio.gather(*(self.boards[one.bus].set_up(one.address) for one in chosen))

    def supervise(self) -> None:
        """Look after the boards: silent ones, and those that lost their set-up."""
        for boards in self._all_boards():
            boards.supervise()

    def all_alive(self) -> bool:
        """Whether every board has sent at least one sweep, or sample of a fingertip."""
        fingertips = self._engine.fingertips
        if fingertips is not None and not all(tip.frames for tip in fingertips.tips.values()):
            return False
        return all(
            record.last_sweep_ns
            for boards in self.boards.values()
            for record in boards.records.values()
        )

    async def stop(self) -> None:
        """Tell the boards to stop, as far as their buses still work."""
        for boards in self._all_boards():
            with contextlib.suppress(BusError, TimeoutError):
                await asyncio.wait_for(boards.stop(), STOP_S)

    def close(self) -> None:
        """Give the interfaces back."""
        for port in self.ports.values():
            port.close()

    def _all_boards(self) -> list[Boards | StrainBoards]:
        return [*self.boards.values(), *self.force_torque.values()]

    @staticmethod
    async def _bring_up(boards: Boards | StrainBoards) -> None:
        told = ""
        while True:
            try:
                await boards.bring_up()
                return
            except BusError as error:
                if str(error) != told:
                    log.warning("%s", error)
                    told = str(error)
                await asyncio.sleep(RETRY_S)
