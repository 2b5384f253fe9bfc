"""A bus without a wire: what is put into it is read, what is sent on it is kept."""

from collections.abc import Iterable

from skin_host.bus.port import Port
from skin_host.bus.wire import FrameBatch
from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Bus, Receive


class StillPort(Port):
    """Gives each batch that was put in at the next read."""

    capacity = 4096

    def __init__(
        self, name: str, bus: Bus, receive: Receive, *, wait: bool = False, clock: Clock = SYSTEM
    ) -> None:
        super().__init__(name, bus, None, clock)
        self.waiting: list[FrameBatch] = []
        self.sent: list[tuple[int, bytes]] = []

    def read(self) -> FrameBatch:
        batch = self.waiting.pop(0) if self.waiting else FrameBatch.of([])
        self.counters.frames += len(batch)
        return batch

    async def send(self, frames: Iterable[tuple[int, bytes]], gap_s: float = 0.0) -> None:
        self.sent += frames
