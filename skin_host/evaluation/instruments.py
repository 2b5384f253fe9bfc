"""Which room of a running program takes the CPU, and what wakes its event loop how often.

A timer on the process's own CPU time interrupts it some hundred times a second; each time the
innermost function of this project, or of its MQTT libraries, names the room. It costs nothing
between two samples, unlike a profiler that is called at each function.
"""

import asyncio
import selectors
import signal
from collections import Counter
from types import FrameType
from typing import Any

#: Rooms by the beginning of a module's name; the first that fits counts.
ROOMS = {
    "skin_host.bus.assembler": "assembler",
    "skin_host.bus": "bus",
    "skin_host.daemon.link": "bus",
    "skin_host.clock": "bus",
    "skin_host.processing.intake": "intake",
    "skin_host.processing.validity": "liveness",
    "skin_host.processing.liveness": "liveness",
    "skin_host.processing.stuck": "liveness",
    "skin_host.processing.contacts": "contacts",
    "skin_host.processing.localization": "contacts",
    "skin_host.processing.core": "daemon",
    "skin_host.processing": "pipeline",
    "skin_host.mqtt.frames": "encoding",
    "skin_host.mqtt": "mqtt",
    "aiomqtt": "mqtt",
    "paho": "mqtt",
    "skin_host.health": "health",
    "skin_host.evaluation": "",
    "skin_host": "daemon",
}
#: The event loop itself, and everything that runs outside of these rooms.
LOOP = "loop"
#: Causes by the beginning of the module whose function is called; the first that fits counts.
_CAUSES = {
    "skin_host.bus": "plan",
    "skin_host.clock": "plan",
    "skin_host.mqtt": "mqtt",
    "aiomqtt": "mqtt",
    "asyncio": "thread",
}
#: A timer of the loop itself.
TIMER = "timer"
_INTERVAL_S = 0.002


class RoomClock:
    """Counts samples by room, in the main thread of this process.

    Attributes:
        samples: how many fell into each room since `begin`.
    """

    def __init__(self) -> None:
        self.samples: Counter[str] = Counter()
        self._rooms: dict[str, str] = {}

    def begin(self) -> None:
        """Count from now on."""
        self.samples.clear()
        signal.signal(signal.SIGPROF, self._sample)
        signal.setitimer(signal.ITIMER_PROF, _INTERVAL_S, _INTERVAL_S)

    def end(self) -> dict[str, float]:
        """Stop counting; return the share of each room."""
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        total = self.samples.total()
        return {room: count / total for room, count in self.samples.most_common()}

    def _sample(self, _number: int, frame: FrameType | None) -> None:
        while frame is not None:
            module = frame.f_globals.get("__name__", "")
            room = self._rooms.get(module)
            if room is None:
                room = self._rooms[module] = _room_of(module)
            if room:
                self.samples[room] += 1
                return
            frame = frame.f_back
        self.samples[LOOP] += 1


def _room_of(module: str) -> str:
    for start, room in ROOMS.items():
        if module.startswith(start):
            return room
    return ""


class Wakeups(selectors.DefaultSelector):
    """A selector that counts how often its loop slept, by what ended the sleep.

    Attributes:
        counts: sleeps by cause. Turns of the loop between which it did not sleep are not counted.
    """

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        found = super().select(timeout)
        if timeout != 0:
            self.counts[_cause(found[0][0].data) if found else TIMER] += 1
        return found

    def runner(self) -> asyncio.Runner:
        """Runs coroutines in a loop with this selector."""
        return asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(self))


def _cause(handles: Any) -> str:
    callback = next(handle for handle in handles if handle is not None)._callback
    module = getattr(callback, "__module__", None) or type(callback).__module__
    return next((cause for start, cause in _CAUSES.items() if module.startswith(start)), module)
