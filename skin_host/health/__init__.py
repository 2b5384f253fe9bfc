"""Health of each part: counters, faults and their explanation in one record.

The modules that can lose data count their losses. `watch` notes how the counters grow and when
each board was last received, `describe` builds the record of a part from that, and `diagnosis`
finds the faults. The record is published as `<part>/health` and shown by `skin status`.
"""

import logging
from typing import TYPE_CHECKING, Any

import numpy as np

from skin_host.health.describe import LOST_SWEEPS, Describer
from skin_host.health.diagnosis import FoundFault, diagnose
from skin_host.health.record import Record
from skin_host.health.watch import Watch
from skin_host.processing.core import Engine, Output

if TYPE_CHECKING:
    from skin_host.bus.boards import Boards
    from skin_host.bus.port import Port

__all__ = ["FaultLog", "HealthWatch", "Record"]

log = logging.getLogger(__name__)
#: An intermittent fault stays in the record for this long after it was last seen.
HOLD_NS = 3_000_000_000
#: A longer pause between two calls of `tick` means that this computer stalled.
STALL_NS = 300_000_000
#: For this long after a stall, lateness and losses may be caused by this computer, so no board or
#: bus is blamed for them.
STALLED_NS = 4_000_000_000
#: Losses of the output are reported as faults for this long after they happened.
LATELY_NS = 60_000_000_000
#: Faults are logged together, at most once in this time.
LINE_S = 60.0
#: Ports log these faults themselves, at once.
LOGGED_BY_PORTS = {"bus_down", "bus_gone", "bus_off"}
#: A fault is logged only after it has lasted for this long ...
LASTING_S = 2.0
#: ... of which a time without a look counts for no more than this.
LONGEST_LOOK_S = 0.3
_ACCUSING = {"board_jitter", "board_period", "bus_loses_frames"}
_PASSING = {
    "board_jitter",
    "board_period",
    "bus_babbling",
    "bus_bit_errors",
    "bus_drops",
    "bus_errors",
    "bus_loses_frames",
    "part_temperature",
    "taxel_noisy",
}
#: What a bus gains in a second through faults.
_LOSSES = ("wrong", "halves", "dropped", "overflows", "error_frames")


class HealthWatch:
    """Watches what passes through the daemon and describes it on request.

    All times are on the clock of the frames' time stamps. The time passed in should be the time up
    to which all received frames have been read: a board whose frames wait unread has not timed out.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._watch = Watch(engine)
        self._describer = Describer(engine, self._watch)
        self._held: dict[int, dict[tuple[str, str], tuple[FoundFault, int]]] = {}
        self._ticked_ns = 0
        self._stall_ns = 0
        self._stalled_ns = -STALLED_NS
        self._output: dict[str, int] = {}
        self._output_ns: dict[str, int] = {}

    def use(self, engine: Engine) -> None:
        """Continue with another engine, after a reload."""
        self._engine = engine
        self._watch.use(engine)
        self._describer = Describer(engine, self._watch)

    def note(self, output: Output) -> None:
        """Take in one output of the core."""
        self._watch.note(output)

    def tick(
        self,
        now_ns: int,
        ports: dict[str, "Port"],
        boards: dict[str, "Boards"],
        held_up_ns: int = 0,
    ) -> None:
        """Read all counters; to be called ten times a second.

        Args:
            now_ns: the time.
            ports, boards: by name of the bus.
            held_up_ns: for how long at most the buses were not read since the last call, where
                that is longer than planned.
        """
        pause_ns = now_ns - self._ticked_ns
        if not (self._ticked_ns and STALL_NS < pause_ns < LATELY_NS):
            # Shorter pauses only matter where they change time stamps.
            pause_ns = held_up_ns if any(port.stamps_late for port in ports.values()) else 0
        if pause_ns:
            lately = abs(now_ns - self._stalled_ns) <= STALLED_NS
            self._stall_ns = max(pause_ns, self._stall_ns * lately)
            self._stalled_ns = now_ns
        self._ticked_ns = now_ns
        self._watch.tick(now_ns, ports, boards)

    def pulse(self, ports: dict[str, "Port"], boards: dict[str, "Boards"]) -> tuple[object, ...]:
        """Return a value that differs from the last one when a fault may have begun or ended.

        It is taken ten times a second; only when it differs, and once a second, are the records
        made, which cost a hundred times as much. Measures that change slowly (temperature, periods,
        baselines) are left to the records of each second.
        """
        engine, watch = self._engine, self._watch
        return (
            abs(self._ticked_ns - self._stalled_ns) > STALLED_NS,
            engine.calibration,
            tuple(engine.disabled),
            *_pulse_of_boards(engine),
            *(
                None if part.valid is None else part.valid.tobytes()
                for part in watch.parts.values()
            ),
            *(
                (bus.silent, bus.spiked_pads, *map(bus.gained.get, _LOSSES))
                for bus in watch.buses.values()
            ),
            *(port.state for port in ports.values()),
            *(dict(manager.strangers) for manager in boards.values()),
            *(
                (known.board_type, known.in_bootloader, manager.awaits(address))
                for manager in boards.values()
                for address, known in manager.records.items()
            ),
        )

    def record(
        self,
        part: int,
        now_ns: int,
        ports: dict[str, "Port"],
        boards: dict[str, "Boards"],
        output: dict[str, Any] | None = None,
        unkept: dict[str, str] | None = None,
    ) -> Record:
        """Return the health record of a part, with its faults as codes and as sentences.

        `unkept` is what the daemon could not write to its state directory, and why.
        """
        record = self._describer.part(part, now_ns, ports, boards)
        if output is not None:
            record["output"] = output
        if unkept:
            record["unkept"] = dict(unkept)
        if output is not None:
            self._note_output(output, now_ns)
        found = diagnose(record, [name for name, at_ns in self._output_ns.items() if at_ns])
        return _with_faults(
            record, self._hold(part, self._without_own_stalls(found, now_ns), now_ns)
        )

    def replayed(self, part: int) -> Record:
        """Return the record of a part at the end of a replay: without ages, and with the faults
        that need none.
        """
        record = self._describer.part(part, None, {}, {})
        return _with_faults(record, diagnose(record))

    def rates(self) -> dict[str, float]:
        """Return frames and sweeps per second, summed over all buses and boards."""
        gained = [bus.gained for bus in self._watch.buses.values() if bus.gained]
        return {
            f"{what}_hz": sum(one[what] / max(one["seconds"], 0.1) for one in gained)
            for what in ("frames", "sweeps")
        }

    def _note_output(self, output: dict[str, Any], now_ns: int) -> None:
        """Note which losses have grown within the last minute."""
        for name in ("touches_dropped", "refused"):
            if output[name] > self._output.get(name, 0):
                self._output_ns[name] = now_ns
            self._output[name] = output[name]
        self._output_ns = {
            name: at_ns
            for name, at_ns in self._output_ns.items()
            if abs(now_ns - at_ns) < LATELY_NS
        }

    def _without_own_stalls(self, faults: list[FoundFault], now_ns: int) -> list[FoundFault]:
        """Drop the faults that a stall of this computer can cause, and add the stall itself.

        A short one is only added where it is the reason that a fault is not reported.
        """
        if abs(now_ns - self._stalled_ns) > STALLED_NS:
            return faults
        kept = [fault for fault in faults if fault.code not in _ACCUSING]
        dropped = len(kept) < len(faults)
        for held in self._held.values():
            for key in [key for key in held if key[0] in _ACCUSING]:
                del held[key]
                dropped = True
        if not dropped and self._stall_ns <= STALL_NS:
            return kept
        sentence = (
            f"this computer did not look at the buses for {self._stall_ns / 1e6:.0f} ms: other "
            "work held it up, or its clock was set; for some seconds neither periods "
            "nor losses are judged"
        )
        return [FoundFault("host_stalls", "host", sentence), *kept]

    def _hold(self, part: int, faults: list[FoundFault], now_ns: int) -> list[FoundFault]:
        """Add intermittent faults that were seen within the last `HOLD_NS`."""
        held = self._held.setdefault(part, {})
        for fault in faults:
            held[fault.code, fault.where] = (fault, now_ns)
        for key, (fault, seen_ns) in list(held.items()):
            if abs(now_ns - seen_ns) > (HOLD_NS if fault.code in _PASSING else 0):
                del held[key]
        return [fault for fault, _ in held.values()]


def _with_faults(record: Record, faults: list[FoundFault]) -> Record:
    """Put faults into a record, as codes and as sentences; return it."""
    if record["state"] == "ok" and faults:
        record["state"] = "warning"
    record["faults"] = [{"code": fault.code, "where": fault.where} for fault in faults]
    record["sentences"] = [fault.sentence for fault in faults]
    return record


def _pulse_of_boards(engine: Engine) -> tuple[object, ...]:
    ledger, liveness = engine.ledger, engine.intake.liveness
    events = (ledger.resets, ledger.lost_set_ups, ledger.tx_overflows, ledger.rezeros)
    found: tuple[object, ...] = (
        ledger.any_silent and ledger.silent.tobytes(),
        (ledger.sweeps > 0).tobytes(),
        ledger.all_complete or np.minimum(ledger.absent, LOST_SWEEPS).tobytes(),
        (engine.zeros.doubts(), engine.zeros.changes),
        *(counts.tobytes() for counts in events),
    )
    if any(ledger.flagged):
        found += ledger.error.tobytes(), ledger.far.tobytes()
    if liveness.doubted is not None:
        found += liveness.doubted.tobytes(), liveness.frozen.tobytes()
    return found


class FaultLog:
    """Logs faults that last, and the end of faults that were logged: at most one line a minute."""

    def __init__(self) -> None:
        self._since_s: dict[tuple[str, str], float] = {}
        self._looked_s = 0.0
        self._noted_s: float | None = None
        self._logged: set[tuple[str, str]] = set()
        self._line_s = -LINE_S

    def note(self, present: dict[tuple[str, str], str], now_s: float) -> None:
        """Take in all present faults: their sentences by code and place."""
        present = {
            key: sentence for key, sentence in present.items() if key[0] not in LOGGED_BY_PORTS
        }
        passed_s = 0.0 if self._noted_s is None else now_s - self._noted_s
        self._noted_s = now_s
        self._looked_s += min(passed_s, LONGEST_LOOK_S)
        self._since_s = {key: self._since_s.get(key, self._looked_s) for key in present}
        if now_s - self._line_s < LINE_S:
            return
        new = [
            key
            for key, since_s in self._since_s.items()
            if key not in self._logged and self._looked_s - since_s >= LASTING_S
        ]
        over = [key for key in self._logged if key not in present]
        if not new and not over:
            return
        self._line_s = now_s
        self._logged = (self._logged - set(over)) | set(new)
        words = []
        if new:
            words.append(present[new[0]])
            if len(new) > 1:
                faults = "one more fault" if len(new) == 2 else f"{len(new) - 1} more faults"
                words[-1] += f" (and {faults}; see `skin status`)"
        if over:
            names = ", ".join(f"{code} {where}" for code, where in sorted(over)[:3])
            words.append(f"over: {names}" + (f" and {len(over) - 3} more" * (len(over) > 3)))
        log.log(logging.WARNING if new else logging.INFO, "%s", "; ".join(words))
