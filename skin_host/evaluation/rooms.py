"""Which room of a running program takes the CPU.

A timer on the process's own CPU time interrupts it some hundred times a second; each time the
innermost function of this project, or of its MQTT libraries, names the room. It costs nothing
between two samples, unlike a profiler that is called at each function.
"""

import signal
from collections import Counter
from types import FrameType

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
    "skin_host.processing.repeats": "liveness",
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
