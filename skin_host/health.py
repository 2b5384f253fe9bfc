"""One record of everything that can go wrong, part by part.

Counters come from where the losses happen; this module gathers them, sees what became of
them in the last second, and has `diagnosis` name what is wrong. What a part's record says is
published as `<part>/health` and shown by `skin status`. `docs/operations.md` explains its keys.
"""

from collections import deque
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Sweep
from skin_host.bus.boards import Boards
from skin_host.bus.commands import SKIN_BOARD_TYPES
from skin_host.bus.port import Port
from skin_host.bus.protocol import TRIANGLES, StatusError, out_of_range, status_error
from skin_host.diagnosis import Fault, diagnose
from skin_host.engine import Engine, Step
from skin_host.layout import Layout, PadKind
from skin_host.processing.calibration import Verdict
from skin_host.processing.intake import lifted

#: Rates are means over about this time.
RATE_S = 2.0
#: What is told of "the last second".
RECENT_NS = 1_000_000_000
#: A passing fault goes on being told for so long, and an event of a board for so long.
HOLD_NS = 3_000_000_000
LATELY_NS = 60_000_000_000
#: Bits of a frame of 8 bytes on the wire, stuff bits and pause included.
FRAME_BITS = 121
#: Intervals that are enough to judge a board's period.
PERIOD_SWEEPS = 16
FEWEST_INTERVALS = 8
#: Standard deviation over median deviation of a normal distribution.
SIGMA = 1.4826
#: A triangle is missing when it has not come in so many sweeps in a row.
ABSENT_SWEEPS = 3
#: A baseline that has moved by more than this share of its limit drifts.
DRIFTING_SHARE = 0.25
_TRIANGLES = np.arange(TRIANGLES)


@dataclass(slots=True)
class _PartWatch:
    last_ns: int = 0
    frames: int = 0
    rate_hz: float = 0.0
    rate_since_ns: int = 0
    rate_frames: int = 0
    valid: NDArray[np.bool_] | None = None
    beyond: NDArray[np.bool_] | None = None
    raw: NDArray[np.uint8] | None = None
    touched: bool = False


@dataclass(slots=True)
class _BoardWatch:
    sweep: Sweep | None = None
    sweeps: int = 0
    times_ns: deque[int] = field(default_factory=lambda: deque(maxlen=PERIOD_SWEEPS + 1))
    #: In how many sweeps in a row each triangle has been missing.
    absent: NDArray[np.int64] = field(default_factory=lambda: np.zeros(TRIANGLES, np.int64))
    #: The last error of each triangle that has not shown since that it lives.
    error: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(TRIANGLES, np.uint8))
    events: dict[str, int] = field(default_factory=dict)
    event_ns: dict[str, int] = field(default_factory=dict)


class _Recent:
    """What counters have gained in the last second."""

    def __init__(self) -> None:
        self._past: deque[tuple[int, dict[str, int]]] = deque()

    def note(self, now_ns: int, totals: dict[str, int]) -> dict[str, float]:
        past = self._past
        if past and now_ns < past[-1][0]:
            past.clear()  # the clock was set back
        past.append((now_ns, totals))
        while len(past) > 2 and now_ns - past[1][0] >= RECENT_NS:
            past.popleft()
        then_ns, before = past[0]
        gained: dict[str, float] = {key: totals[key] - before[key] for key in totals}
        gained["seconds"] = (now_ns - then_ns) * 1e-9
        return gained


class Health:
    """Watches what passes through the daemon and describes it on request.

    Every time is on the clock of the frames' time stamps.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._layout: Layout = engine.layout
        self._parts = {part: _PartWatch() for part in engine.parts}
        self._boards = {board: _BoardWatch() for board in engine.boards}
        self._recent = {bus: _Recent() for bus in engine.assemblers}
        self._gained: dict[str, dict[str, float]] = {}
        self._bus_frames: dict[str, tuple[int, int]] = {}
        self._held: dict[int, dict[tuple[str, str], tuple[Fault, int]]] = {}

    # ------------------------------------------------------------------ what passes

    def note_sweeps(self, sweeps: list[Sweep]) -> None:
        """Sweeps that came."""
        for sweep in sweeps:
            watch = self._boards[sweep.board]
            watch.sweep = sweep
            watch.sweeps += 1
            watch.times_ns.append(sweep.t_ns)
            here = sweep.present >> _TRIANGLES & 1
            watch.absent = (watch.absent + 1) * (here == 0)
            if sweep.status.any() or watch.error.any():
                error = status_error(sweep.status)
                unproven = self._engine.liveness[sweep.board].unproven
                # While it has not shown that it lives, its last error is remembered.
                np.copyto(watch.error, error, where=(error != 0) | ~unproven)

    def note_step(self, step: Step) -> None:
        """A sample that was processed."""
        watch = self._parts[step.part]
        frame = step.frame
        if frame.valid.any():
            watch.last_ns = frame.t_ns
            watch.frames += 1
            watch.rate_frames += 1
        watch.valid = frame.valid
        watch.beyond = frame.beyond_range
        watch.raw = frame.raw
        watch.touched = bool(frame.touched.any())
        if not watch.rate_since_ns:
            watch.rate_since_ns = frame.t_ns
            watch.rate_frames = 0
        elapsed_s = (frame.t_ns - watch.rate_since_ns) * 1e-9
        if elapsed_s >= RATE_S or elapsed_s < 0.0:
            watch.rate_hz = watch.rate_frames / elapsed_s if elapsed_s > 0.0 else 0.0
            watch.rate_since_ns = frame.t_ns
            watch.rate_frames = 0

    def tick(self, now_ns: int, ports: dict[str, Port], boards: dict[str, Boards]) -> None:
        """Look at all counters; to be called some times a second."""
        for bus, recent in self._recent.items():
            counters = self._engine.assemblers[bus].counters
            port = ports.get(bus)
            totals = {
                "frames": counters.frames,
                "sweeps": counters.sweeps,
                "other": counters.other,
                "wrong": counters.wrong_header + counters.short,
                "halves": counters.halves,
                "missed": counters.missed,
                "unknown": counters.unknown_board + counters.unknown_triangle,
                "spikes": sum(
                    int(self._engine.liveness[i].spikes)
                    for i in self._engine.boards
                    if self._layout.boards[i].settings.bus == bus
                ),
                "dropped": 0 if port is None else port.counters.dropped,
                "error_frames": 0 if port is None else port.counters.error_frames,
            }
            self._gained[bus] = recent.note(now_ns, totals)
            frames, _ = self._bus_frames.get(bus, (-1, now_ns))
            if frames != counters.frames:
                self._bus_frames[bus] = (counters.frames, now_ns)
        for index, watch in self._boards.items():
            manager = boards.get(self._layout.boards[index].settings.bus)
            self._note_events(index, watch, manager, now_ns)

    def _note_events(
        self, index: int, watch: _BoardWatch, manager: Boards | None, now_ns: int
    ) -> None:
        events = {"rezeros": self._engine.rezeros[index]}
        if manager is not None:
            known = manager.records[self._layout.boards[index].settings.address]
            events |= {
                "resets": known.resets,
                "lost_set_ups": known.lost_set_ups,
                "tx_overflows": known.tx_overflows,
            }
            if known.configurations <= 1 and not watch.sweeps:
                watch.events["rezeros"] = events["rezeros"]  # everyone's first zero is no event
        for name, count in events.items():
            if count > watch.events.get(name, 0):
                watch.event_ns[name] = now_ns
            watch.events[name] = count

    # ------------------------------------------------------------------ what is told

    def part_record(
        self, part: int, now_ns: int | None, ports: dict[str, Port], boards: dict[str, Boards]
    ) -> dict[str, Any]:
        """What there is to say of a part; without `now_ns` (a replay) no ages."""
        watch = self._parts[part]
        layout = self._layout.parts[part]
        pressure = self._layout.pad_kind[layout.start : layout.stop] == PadKind.PRESSURE
        buses = sorted({self._layout.boards[i].settings.bus for i in layout.boards})
        pipeline = self._engine.pipeline
        calibration = self._engine.calibration
        record: dict[str, Any] = {
            "part": layout.name,
            "frames": watch.frames,
            "rate_hz": round(watch.rate_hz, 2),
            "taxels": int(np.count_nonzero(pressure)),
            "valid_taxels": 0 if watch.valid is None else int(np.count_nonzero(watch.valid)),
            "invalid": []
            if watch.valid is None
            else np.flatnonzero(pressure & ~watch.valid).tolist(),
            "beyond_range": [] if watch.beyond is None else np.flatnonzero(watch.beyond).tolist(),
            "triangles": self._triangles(part, now_ns),
            "taxel_verdicts": self._verdicts(part),
            "taxel_faults": self._taxel_faults(part, pressure),
            "boards": [self._board(i, now_ns, boards) for i in layout.boards],
            "buses": [self._bus(name, now_ns, ports, boards) for name in buses],
            "warmth": self._warmth(part, pressure),
            "baseline_frozen": []
            if pipeline is None
            else np.flatnonzero(pipeline.frozen(part)).tolist(),
            "baseline_at_limit": []
            if pipeline is None
            else np.flatnonzero(pipeline.at_limit(part)).tolist(),
            "calibration": None
            if calibration is None
            else {"id": calibration.id, "time": calibration.time},
        }
        if now_ns is not None:
            age_ms = (now_ns - watch.last_ns) / 1e6 if watch.last_ns else None
            record["age_ms"] = None if age_ms is None else round(age_ms, 1)
        record["state"] = self._state(part, record, watch)
        return record

    def rates(self) -> dict[str, float]:
        """Frames and sweeps a second over all buses and boards."""
        frames_hz = sum(one["frames"] / max(one["seconds"], 0.1) for one in self._gained.values())
        sweeps_hz = sum(one["sweeps"] / max(one["seconds"], 0.1) for one in self._gained.values())
        return {"frames_hz": frames_hz, "sweeps_hz": sweeps_hz}

    def diagnosed(self, part: int, record: dict[str, Any], now_ns: int) -> list[Fault]:
        """Add `faults` and `sentences` to a record; passing faults are held for a while."""
        held = self._held.setdefault(part, {})
        for fault in diagnose(record):
            held[fault.code, fault.where] = (fault, now_ns)
        for key, (_, seen_ns) in list(held.items()):
            passing = key[0] in _PASSING
            if abs(now_ns - seen_ns) > (HOLD_NS if passing else 0):
                del held[key]
        faults = [fault for fault, _ in held.values()]
        record["faults"] = [{"code": fault.code, "where": fault.where} for fault in faults]
        record["sentences"] = [fault.says for fault in faults]
        return faults

    def _state(self, part: int, record: dict[str, Any], watch: _PartWatch) -> str:
        if part in self._engine.disabled:
            return "disabled"
        if record["calibration"] is None:
            return "not calibrated"
        if not watch.frames:
            return "no data"
        if not record["valid_taxels"]:
            return "silent"
        return "ok" if not record["invalid"] else "degraded"

    def _alive(self, index: int, now_ns: int | None) -> bool:
        sweep = self._boards[index].sweep
        if sweep is None:
            return False
        if now_ns is None:
            return True
        limit = self._engine.settings.receive.silent_periods
        period_ms = self._layout.boards[index].settings.period_ms
        return now_ns - sweep.t_ns <= limit * period_ms * 1_000_000

    def _triangles(self, part: int, now_ns: int | None) -> list[dict[str, Any]]:
        """The triangles of a part that are not well, and why."""
        unwell = []
        for triangle in self._layout.triangles:
            if triangle.part != part:
                continue
            fault = self._triangle_fault(triangle.board, triangle.number, now_ns)
            if fault is not None:
                board = self._layout.boards[triangle.board]
                unwell.append({"board": board.name, "triangle": triangle.number, "fault": fault})
        return unwell

    def _triangle_fault(self, board: int, number: int, now_ns: int | None) -> str | None:
        watch = self._boards[board]
        sweep = watch.sweep
        if sweep is None or not self._alive(board, now_ns):
            return "missing"
        if not sweep.present >> number & 1:
            # A single frame that was lost is told with its bus.
            return "missing" if watch.absent[number] >= ABSENT_SWEEPS else None
        status = sweep.status[number : number + 1]
        error = int(status_error(status)[0])
        if error & StatusError.NOT_CONNECTED:
            return "not connected"
        if error & StatusError.NO_ACK:
            return "no ack"
        liveness = self._engine.liveness[board]
        if liveness.frozen[number]:
            return "silenced" if watch.error[number] else "frozen"
        if liveness.unproven[number]:
            return "silenced" if watch.error[number] else "constant"
        # Single pads are told with the taxels; here it is the whole triangle.
        many = np.count_nonzero(out_of_range(status)) > 6
        other = lifted(sweep.raw[number : number + 1], status)[0]
        return "out of range" if many or other else None

    def _taxel_faults(self, part: int, pressure: NDArray[np.bool_]) -> dict[str, list[int]]:
        layout = self._layout.parts[part]
        found: dict[str, NDArray[np.bool_]] = {}
        for kind in ("stuck", "noisy", "out_of_range"):
            found[kind] = np.zeros(layout.n_taxels, np.bool_)
        for index in layout.boards:
            taxels = self._layout.boards[index].taxel_index
            mine = (taxels >= layout.start) & (taxels < layout.stop)
            liveness = self._engine.liveness[index]
            sweep = self._boards[index].sweep
            masks = {"stuck": liveness.stuck, "noisy": liveness.noisy}
            if sweep is not None and sweep.status.any():
                answered = (status_error(sweep.status) == 0)[:, None]
                masks["out_of_range"] = out_of_range(sweep.status) & answered
            for kind, mask in masks.items():
                found[kind][taxels[mine & mask] - layout.start] = True
        pipeline, calibration = self._engine.pipeline, self._engine.calibration
        if pipeline is not None and calibration is not None:
            span = slice(layout.start, layout.stop)
            moved = np.abs(pipeline.baseline[span] - calibration.baseline[span])
            limit = self._engine.settings.processing.drift.limit_units
            found["drifting"] = (moved > DRIFTING_SHARE * limit) & calibration.usable[span]
        return {
            kind: np.flatnonzero(mask & pressure).tolist()
            for kind, mask in found.items()
            if (mask & pressure).any()
        }

    def _warmth(self, part: int, pressure: NDArray[np.bool_]) -> dict[str, float | None] | None:
        """How far thermal pads, and all taxels together, read from what was calibrated."""
        pipeline, calibration = self._engine.pipeline, self._engine.calibration
        watch = self._parts[part]
        if pipeline is None or calibration is None or watch.raw is None or watch.valid is None:
            return None
        layout = self._layout.parts[part]
        span = slice(layout.start, layout.stop)
        units = self._layout.no_load[span].astype(np.float64) - watch.raw
        heard = watch.raw > 0
        thermal = ~pressure & heard & calibration.usable[span]
        warmth: dict[str, float | None] = {"thermal_units": None, "common_units": 0.0}
        if thermal.any():
            shift = units[thermal] - calibration.baseline[span][thermal]
            warmth["thermal_units"] = round(float(np.median(shift)), 1)
        if watch.valid.any():
            shift = (units - pipeline.baseline[span])[watch.valid]
            warmth["common_units"] = round(float(np.median(shift)), 1)
        return warmth

    def _verdicts(self, part: int) -> dict[str, list[int]]:
        calibration = self._engine.calibration
        if calibration is None:
            return {}
        layout = self._layout.parts[part]
        mine = slice(layout.start, layout.stop)
        pressure = self._layout.pad_kind[mine] == PadKind.PRESSURE
        verdict = calibration.verdict[mine]
        return {
            kind.name.lower(): np.flatnonzero(pressure & (verdict == kind)).tolist()
            for kind in Verdict
            if kind != Verdict.OK and (pressure & (verdict == kind)).any()
        }

    def _board(self, index: int, now_ns: int | None, boards: dict[str, Boards]) -> dict[str, Any]:
        board = self._layout.boards[index]
        watch = self._boards[index]
        sweep = watch.sweep
        record: dict[str, Any] = {
            "name": board.name,
            "bus": board.settings.bus,
            "address": board.settings.address,
            "skin_type": board.settings.skin_type,
            "alive": self._alive(index, now_ns),
            "sweeps": watch.sweeps,
            "fitted": list(board.triangles),
            "triangles_present": 0 if sweep is None else _count(sweep.present, board.triangles),
            "triangles": len(board.triangles),
            "period_ms": board.settings.period_ms,
            "period_seen_ms": None,
            "jitter_ms": None,
            "rezeros": self._engine.rezeros[index],
            "in_doubt": int(np.count_nonzero(self._engine.in_doubt(index))),
        }
        if len(watch.times_ns) > FEWEST_INTERVALS:
            intervals_ms = np.diff(np.array(watch.times_ns, np.float64) - watch.times_ns[0]) / 1e6
            usual = intervals_ms[intervals_ms < 1.6 * board.settings.period_ms]
            if len(usual) < FEWEST_INTERVALS:
                usual = intervals_ms
            middle = float(np.median(usual))
            record["period_seen_ms"] = round(float(np.mean(usual)), 2)
            # From the median deviation: one late sweep of many is no jitter.
            record["jitter_ms"] = round(SIGMA * float(np.median(np.abs(usual - middle))), 2)
        manager = boards.get(board.settings.bus)
        if manager is not None:
            known = manager.records[board.settings.address]
            record |= {
                "board_type": known.board_type,
                "wrong_type": known.board_type is not None
                and known.board_type not in SKIN_BOARD_TYPES,
                "firmware": known.firmware,
                "in_bootloader": known.in_bootloader,
                "configurations": known.configurations,
                "silences": known.silences,
                "resets": known.resets,
                "lost_set_ups": known.lost_set_ups,
                "tx_overflows": known.tx_overflows,
            }
        if now_ns is not None:
            record["age_ms"] = None if sweep is None else round((now_ns - sweep.t_ns) / 1e6, 1)
            record["lately"] = {
                name: watch.events[name]
                for name, at_ns in watch.event_ns.items()
                if abs(now_ns - at_ns) < LATELY_NS
            }
        return record

    def _bus(
        self,
        name: str,
        now_ns: int | None,
        ports: dict[str, Port],
        boards: dict[str, Boards],
    ) -> dict[str, Any]:
        record: dict[str, Any] = {"name": name}
        record |= asdict(self._engine.assemblers[name].counters)
        bus = self._engine.settings.buses[name]
        record["channel"] = bus.channel
        port = ports.get(name)
        if port is not None:
            record["state"] = str(port.state)
            record["port"] = asdict(port.counters)
        manager = boards.get(name)
        if manager is not None:
            record["strangers"] = dict(manager.strangers)
            if manager.stranger_id is not None:
                record["stranger"] = f"0x{manager.stranger_id:x}"
        gained = self._gained.get(name)
        if gained is not None and now_ns is not None:
            seconds = max(gained["seconds"], 0.1)
            load = FRAME_BITS / (bus.bitrate * seconds)
            record["last_second"] = {
                "frames_hz": round(gained["frames"] / seconds),
                "load": round(gained["frames"] * load, 3),
                "other_load": round(gained["other"] * load, 3),
            } | {
                key: int(gained[key])
                for key in (
                    "wrong",
                    "halves",
                    "missed",
                    "unknown",
                    "spikes",
                    "dropped",
                    "error_frames",
                )
            }
            _, heard_ns = self._bus_frames.get(name, (0, now_ns))
            periods = self._engine.settings.receive.silent_periods
            periods_ms = [
                self._layout.boards[i].settings.period_ms
                for i in self._engine.boards
                if self._layout.boards[i].settings.bus == name
            ]
            record["silent"] = now_ns - heard_ns > periods * max(periods_ms) * 1_000_000
        return record


#: Faults that come and go by nature: told for a while after they were last seen.
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


def _count(present: int, triangles: tuple[int, ...]) -> int:
    return sum(present >> triangle & 1 for triangle in triangles if triangle < TRIANGLES)
