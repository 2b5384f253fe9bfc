"""Fingertips in the daemon: their boards are supervised, their events and health published."""

import asyncio
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from skin_host.bus.board import GAP_S
from skin_host.bus.boards import RETRY_S, Sender
from skin_host.bus.commands import SetTxMode, command_frame
from skin_host.bus.strain import StrainMode, scale_queries, start_frames
from skin_host.errors import BusError
from skin_host.fingertip.engine import FingertipEngine, TipState
from skin_host.fingertip.events import FingertipEvent
from skin_host.fingertip.health import FingertipHealth, FingertipRecord
from skin_host.mqtt.messages import ContactState
from skin_host.mqtt.publisher import Publisher

#: Health is published at once when something changes, otherwise this often.
HEALTH_NS = 1_000_000_000
log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Known:
    state: TipState
    started: bool = False
    samples: int = 0
    sampled_ns: int = 0
    retry_at_ns: int = 0
    retries: int = 0


class StrainBoards:
    """Sets up and supervises the force/torque boards of one bus.

    Commands go to `port`. `clock` gives ns and stands still while the bus is not read.
    """

    def __init__(
        self, bus: str, port: Sender, tips: list[TipState], clock: Callable[[], int]
    ) -> None:
        self._bus = bus
        self._port = port
        self._boards = [_Known(state) for state in tips]
        for state in tips:
            state.awaited = True
        self._clock = clock
        self._busy: asyncio.Task[None] | None = None

    async def bring_up(self) -> None:
        """Set up and start every board.

        Raises:
            BusError: the bus does not take frames.
        """
        try:
            for board in self._boards:
                await self._set_up(board)
        except BusError:
            for board in self._boards:
                board.state.awaited = False
            raise

    def supervise(self) -> None:
        """Supervise every board; set-ups run as separate tasks, so this does not wait for them."""
        now_ns = self._clock()
        for board in self._boards:
            # More than one board sends may be of one that sends too often, and irregularly.
            in_time = board.state.keeps_period is not False and not board.state.twice
            if board.state.samples != board.samples:
                board.samples, board.sampled_ns = board.state.samples, now_ns
                if in_time:
                    board.retries = 0
            # What comes but is no sample, as force without torque, is no more than silence.
            well = now_ns - board.sampled_ns <= board.state.tip.silent_ns and in_time
            due = board.started and now_ns >= board.retry_at_ns
            board.state.awaited &= not (due or board.state.frames)
            if due and self._busy is None and not (well and board.state.scale_before is None):
                self._busy = asyncio.create_task(self._mend(board, well=well))

    async def stop(self) -> None:
        """Command every board to stop sending.

        Raises:
            BusError: the bus does not take frames.
        """
        if self._busy is not None:
            self._busy.cancel()
        for board in self._boards:
            board.started = False
        stop = SetTxMode(StrainMode.STOP)
        await self._port.send(
            [command_frame(stop, board.state.settings.address) for board in self._boards]
        )

    async def _set_up(self, board: _Known) -> None:
        table = board.state.settings
        await self._port.send(start_frames(table.address, table.period_ms), GAP_S)
        pause_s = RETRY_S[min(board.retries, len(RETRY_S) - 1)]
        board.retries += 1
        board.started = True
        board.retry_at_ns = self._clock() + int(pause_s * 1e9)

    async def _mend(self, board: _Known, *, well: bool) -> None:
        """Set a board up again; one that works and reported other full scales is only queried for
        them again: another board may be there by now, and anybody on the bus can answer.
        """
        try:
            if well:
                board.retry_at_ns = self._clock() + int(RETRY_S[-1] * 1e9)
                await self._port.send(scale_queries(board.state.settings.address), GAP_S)
            else:
                log.debug("bus %s: the board of %s is set up again", self._bus, board.state.name)
                await self._set_up(board)
        except BusError as error:
            board.retry_at_ns = self._clock() + int(RETRY_S[-1] * 1e9)
            log.debug("%s", error)
        finally:
            self._busy = None


class FingertipPublisher:
    """Publishes the events and the health of an engine's fingertips.

    Args:
        engine: None if there are no fingertips; then nothing is done.
        publisher: of the daemon.
    """

    def __init__(self, engine: FingertipEngine | None, publisher: Publisher) -> None:
        self._engine = engine
        self._publisher = publisher
        self._health = None if engine is None else FingertipHealth(engine)
        self._published: dict[str, tuple[object, int]] = {}
        self._put_contacts()

    def deliver(self, events: Iterable[FingertipEvent], *, unread: bool = False) -> None:
        """Publish events and contacts; what is `unread` may be touched by now."""
        if self._engine is None:
            return
        for event in events:
            self._publisher.put_touch(event)
        self._put_contacts(unread=unread)

    def end(self, t_ns: int) -> None:
        """End all contacts, because the daemon stops."""
        if self._engine is not None:
            self.deliver(self._engine.end_all(t_ns))
            for name in self._engine.tips:
                self._publisher.put_contact(name, "UNKNOWN")

    def _put_contacts(self, *, unread: bool = False) -> None:
        for name, state in ({} if self._engine is None else self._engine.tips).items():
            free: ContactState = "OFF" if state.tip.feels and not unread else "UNKNOWN"
            self._publisher.put_contact(name, "ON" if state.tip.touched else free)

    def records(self, now_ns: int) -> dict[str, FingertipRecord]:
        return {} if self._health is None else self._health.records(now_ns)

    def publish_health(self, now_ns: int) -> dict[tuple[str, str], str]:
        """Publish health that changed or is due; return all present faults."""
        if self._health is None:
            return {}
        self._health.tick(now_ns)
        present: dict[tuple[str, str], str] = {}
        for name, record in self._health.records(now_ns).items():
            state = record["state"], [one["code"] for one in record["faults"]]
            published, published_ns = self._published.get(name, (None, 0))
            if published != state or abs(now_ns - published_ns) >= HEALTH_NS:
                self._published[name] = state, now_ns
                self._publisher.put_health(name, record)
            for fault, sentence in zip(record["faults"], record["sentences"], strict=True):
                present[fault["code"], fault["where"]] = sentence
        return present
