"""One record of everything that can go wrong, part by part.

Counters come from where the losses happen; `watch` notes what they gained and who was heard
when, `describe` makes the record of a part from that, and `diagnosis` names what is wrong.
The record is published as `<part>/health` and shown by `skin status`.
"""

from typing import Any

from skin_host.bus.assembler import Sweep
from skin_host.bus.boards import Boards
from skin_host.bus.port import Port
from skin_host.engine import Engine, Step
from skin_host.health.describe import Describer
from skin_host.health.diagnosis import Fault, diagnose
from skin_host.health.record import Record
from skin_host.health.watch import Watch

__all__ = ["Health", "Record"]

#: Faults that come and go by nature: told for so long after they were last seen.
HOLD_NS = 3_000_000_000
_PASSING = {
    "board_jitter",
    "board_overflows",
    "board_period",
    "bus_babbling",
    "bus_bit_errors",
    "bus_drops",
    "bus_errors",
    "bus_loses_frames",
    "part_temperature",
    "taxel_noisy",
}


class Health:
    """Watches what passes through the daemon and describes it on request.

    Every time is on the clock of the frames' time stamps, and should be the one by which
    everything that came had been read: what waits unread is not silent.
    """

    def __init__(self, engine: Engine) -> None:
        self._watch = Watch(engine)
        self._describer = Describer(engine, self._watch)
        self._held: dict[int, dict[tuple[str, str], tuple[Fault, int]]] = {}

    def note_sweeps(self, sweeps: list[Sweep]) -> None:
        """Sweeps that came."""
        self._watch.note_sweeps(sweeps)

    def note_step(self, step: Step) -> None:
        """A sample that was processed."""
        self._watch.note_step(step)

    def tick(self, now_ns: int, ports: dict[str, Port], boards: dict[str, Boards]) -> None:
        """Look at all counters; to be called some times a second."""
        self._watch.tick(now_ns, ports, boards)

    def record(
        self,
        part: int,
        now_ns: int,
        ports: dict[str, Port],
        boards: dict[str, Boards],
        output: dict[str, Any] | None = None,
    ) -> Record:
        """What there is to say of a part, its faults by name and in sentences.

        Args:
            part: index in the layout.
            now_ns: the time.
            ports, boards: by name of the bus.
            output: the counters of the publisher, if there is one.
        """
        record = self._describer.part(part, now_ns, ports, boards)
        if output is not None:
            record["output"] = output
        faults = self._hold(part, diagnose(record), now_ns)
        record["faults"] = [{"code": fault.code, "where": fault.where} for fault in faults]
        record["sentences"] = [fault.says for fault in faults]
        return record

    def replayed(self, part: int) -> Record:
        """What there is to say of a part at the end of a replay: no ages, and no judgement."""
        return self._describer.part(part, None, {}, {})

    def rates(self) -> dict[str, float]:
        """Frames and sweeps a second over all buses and boards."""
        gained = [bus.gained for bus in self._watch.buses.values() if bus.gained]
        return {
            f"{what}_hz": sum(one[what] / max(one["seconds"], 0.1) for one in gained)
            for what in ("frames", "sweeps")
        }

    def _hold(self, part: int, faults: list[Fault], now_ns: int) -> list[Fault]:
        """Those there are, and passing ones for a while longer."""
        held = self._held.setdefault(part, {})
        for fault in faults:
            held[fault.code, fault.where] = (fault, now_ns)
        for key, (fault, seen_ns) in list(held.items()):
            if abs(now_ns - seen_ns) > (HOLD_NS if fault.code in _PASSING else 0):
                del held[key]
        return [fault for fault, _ in held.values()]
