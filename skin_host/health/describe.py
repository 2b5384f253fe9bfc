"""From what was watched to what is told: the health record of a part."""

from itertools import pairwise
from statistics import fmean, median
from typing import cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.bus.boards import Boards
from skin_host.bus.port import Port
from skin_host.bus.protocol import TRIANGLES, StatusError, out_of_range, status_error
from skin_host.bus.protocol.commands import SKIN_BOARD_TYPES
from skin_host.engine import Engine
from skin_host.health.record import (
    BoardHealth,
    BusHealth,
    LastSecond,
    Record,
    TriangleHealth,
    Warmth,
)
from skin_host.health.watch import BoardWatch, Watch
from skin_host.layout import PadKind
from skin_host.processing.calibration import Verdict
from skin_host.processing.intake import FAR_PADS, lifted

#: An event of a board is told for so long.
LATELY_NS = 60_000_000_000
#: Bits of a frame of 8 bytes on the wire, stuff bits and pause included.
FRAME_BITS = 121
#: Intervals between sweeps that are enough to judge a board's period.
FEWEST_INTERVALS = 8
#: Standard deviation over median deviation of a normal distribution.
SIGMA = 1.4826
#: A triangle is missing when it has not come in so many sweeps in a row.
ABSENT_SWEEPS = 3
#: A baseline that has moved by more than this share of its limit drifts.
DRIFTING_SHARE = 0.25


class Describer:
    """Describes the parts of an engine, with the ports and boards that there are.

    Every time is on the clock of the frames' time stamps; without a time (a replay) no ages.
    """

    def __init__(self, engine: Engine, watch: Watch) -> None:
        self._engine = engine
        self._layout = engine.layout
        self._watch = watch
        #: Of each part, the triangles that each board gives it.
        self._fitted: dict[int, dict[int, list[int]]] = {part: {} for part in engine.parts}
        for triangle in self._layout.triangles:
            if triangle.part in self._fitted:
                of_board = self._fitted[triangle.part].setdefault(triangle.board, [])
                of_board.append(triangle.number)

    def part(
        self, part: int, now_ns: int | None, ports: dict[str, Port], boards: dict[str, Boards]
    ) -> Record:
        """What there is to say of a part."""
        watch = self._watch.parts[part]
        layout = self._layout.parts[part]
        pressure = self._layout.pad_kind[layout.start : layout.stop] == PadKind.PRESSURE
        buses = sorted({self._layout.boards[i].settings.bus for i in layout.boards})
        pipeline = self._engine.pipeline
        calibration = self._engine.calibration
        record: Record = {
            "part": layout.name,
            "state": self._state(part, pressure),
            "frames": watch.frames,
            "rate_hz": round(watch.rate_hz, 2),
            "taxels": int(np.count_nonzero(pressure)),
            "valid_taxels": 0 if watch.valid is None else int(np.count_nonzero(watch.valid)),
            "invalid": _listed(None if watch.valid is None else pressure & ~watch.valid),
            "beyond_range": _listed(watch.beyond),
            "triangles": self._triangles(part),
            "taxel_verdicts": self._verdicts(part, pressure),
            "taxel_faults": self._taxel_faults(part, pressure),
            "boards": [self._board(i, now_ns, boards) for i in layout.boards],
            "buses": [self._bus(name, now_ns, ports, boards) for name in buses],
            "warmth": self._warmth(part, pressure),
            "baseline_frozen": _listed(None if pipeline is None else pipeline.frozen(part)),
            "baseline_at_limit": _listed(None if pipeline is None else pipeline.at_limit(part)),
            "calibration": None
            if calibration is None
            else {"id": calibration.id, "time": calibration.time},
        }
        if now_ns is not None:
            record["age_ms"] = _age_ms(now_ns, watch.last_ns or None)
        return record

    def _state(self, part: int, pressure: NDArray[np.bool_]) -> str:
        watch = self._watch.parts[part]
        if part in self._engine.disabled:
            return "disabled"
        if self._engine.calibration is None:
            return "not calibrated"
        if not watch.frames or watch.valid is None:
            return "no data"
        if not watch.valid.any():
            return "silent"
        return "ok" if watch.valid[pressure].all() else "degraded"

    def _triangles(self, part: int) -> list[TriangleHealth]:
        """The triangles of a part that are not well, and why."""
        unwell: list[TriangleHealth] = []
        for board, numbers in self._fitted[part].items():
            if self._all_well(board):
                continue
            name = self._layout.boards[board].name
            for number in numbers:
                fault = self._triangle_fault(board, number)
                if fault is not None:
                    unwell.append({"board": name, "triangle": number, "fault": fault})
        return unwell

    def _all_well(self, board: int) -> bool:
        """As nearly always: everything has come, nothing is reported, everything lives."""
        watch = self._watch.boards[board]
        sweep = watch.sweep
        return (
            sweep is not None
            and not watch.silent
            and not self._layout.boards[board].enabled & ~sweep.present
            and not sweep.status.any()
            and not self._engine.liveness[board].unproven.any()
        )

    def _triangle_fault(self, board: int, number: int) -> str | None:
        watch = self._watch.boards[board]
        sweep = watch.sweep
        if sweep is None or watch.silent:
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
        far = out_of_range(status)
        many = np.count_nonzero(far) >= FAR_PADS
        other = lifted(sweep.raw[number : number + 1], far)[0]
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
            sweep = self._watch.boards[index].sweep
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

    def _warmth(self, part: int, pressure: NDArray[np.bool_]) -> Warmth | None:
        pipeline, calibration = self._engine.pipeline, self._engine.calibration
        watch = self._watch.parts[part]
        if pipeline is None or calibration is None or watch.raw is None or watch.valid is None:
            return None
        layout = self._layout.parts[part]
        span = slice(layout.start, layout.stop)
        units = self._layout.no_load[span].astype(np.float64) - watch.raw
        heard = watch.raw > 0
        thermal = ~pressure & heard & calibration.usable[span]
        warmth: Warmth = {"thermal_units": None, "common_units": 0.0}
        if thermal.any():
            shift = units[thermal] - calibration.baseline[span][thermal]
            warmth["thermal_units"] = round(float(np.median(shift)), 1)
        if watch.valid.any():
            shift = (units - pipeline.baseline[span])[watch.valid]
            warmth["common_units"] = round(float(np.median(shift)), 1)
        return warmth

    def _verdicts(self, part: int, pressure: NDArray[np.bool_]) -> dict[str, list[int]]:
        calibration = self._engine.calibration
        if calibration is None:
            return {}
        layout = self._layout.parts[part]
        mine = slice(layout.start, layout.stop)
        verdict = calibration.verdict[mine]
        return {
            kind.name.lower(): np.flatnonzero(pressure & (verdict == kind)).tolist()
            for kind in Verdict
            if kind != Verdict.OK and (pressure & (verdict == kind)).any()
        }

    def _board(self, index: int, now_ns: int | None, boards: dict[str, Boards]) -> BoardHealth:
        board = self._layout.boards[index]
        watch = self._watch.boards[index]
        sweep = watch.sweep
        period_seen_ms, jitter_ms = _period(watch, board.settings.period_ms)
        record: BoardHealth = {
            "name": board.name,
            "bus": board.settings.bus,
            "address": board.settings.address,
            "skin_type": board.settings.skin_type,
            "alive": watch.alive,
            "sweeps": watch.sweeps,
            "fitted": list(board.triangles),
            "triangles_present": 0 if sweep is None else _count(sweep.present, board.triangles),
            "triangles": len(board.triangles),
            "period_ms": board.settings.period_ms,
            "period_seen_ms": period_seen_ms,
            "jitter_ms": jitter_ms,
            "rezeros": self._engine.rezeros[index],
            "in_doubt": int(np.count_nonzero(self._engine.in_doubt(index))),
        }
        manager = boards.get(board.settings.bus)
        if manager is not None:
            known = manager.records[board.settings.address]
            kind = known.board_type
            record |= {
                "board_type": kind,
                "wrong_type": kind is not None and kind not in SKIN_BOARD_TYPES,
                "firmware": known.firmware,
                "in_bootloader": known.in_bootloader,
                "configurations": known.configurations,
                "silences": known.silences,
                "resets": known.resets,
                "lost_set_ups": known.lost_set_ups,
                "tx_overflows": known.tx_overflows,
            }
        if now_ns is not None:
            record["age_ms"] = _age_ms(now_ns, None if sweep is None else sweep.t_ns)
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
    ) -> BusHealth:
        bus = self._engine.settings.buses[name]
        counters = msgspec.to_builtins(self._engine.assemblers[name].counters)
        record = cast(BusHealth, {"name": name, "channel": bus.channel} | counters)
        port = ports.get(name)
        if port is not None:
            record["state"] = str(port.state)
            record["port"] = msgspec.to_builtins(port.counters)
        manager = boards.get(name)
        if manager is not None:
            record["strangers"] = dict(manager.strangers)
            if manager.stranger_id is not None:
                record["stranger"] = f"0x{manager.stranger_id:x}"
        watch = self._watch.buses[name]
        if watch.gained and now_ns is not None:
            record["last_second"] = _last_second(watch.gained, bus.bitrate)
            record["silent"] = watch.silent
        return record


def _period(watch: BoardWatch, wanted_ms: int) -> tuple[float | None, float | None]:
    """Mean period and its scatter in ms, None until there are enough sweeps."""
    if len(watch.times_ns) <= FEWEST_INTERVALS:
        return None, None
    # Of so few numbers lists are done sooner than arrays.
    intervals_ms = [(late - early) / 1e6 for early, late in pairwise(watch.times_ns)]
    usual = [interval_ms for interval_ms in intervals_ms if interval_ms < 1.6 * wanted_ms]
    if len(usual) < FEWEST_INTERVALS:
        usual = intervals_ms
    # From the median deviation: one late sweep of many is no jitter.
    middle = median(usual)
    jitter_ms = SIGMA * median([abs(interval_ms - middle) for interval_ms in usual])
    return round(fmean(usual), 2), round(jitter_ms, 2)


def _last_second(gained: dict[str, float], bitrate: int) -> LastSecond:
    seconds = max(gained["seconds"], 0.1)
    load = FRAME_BITS / (bitrate * seconds)
    return {
        "frames_hz": round(gained["frames"] / seconds),
        "load": round(gained["frames"] * load, 3),
        "other_load": round(gained["other"] * load, 3),
        "wrong": int(gained["wrong"]),
        "halves": int(gained["halves"]),
        "missed": int(gained["missed"]),
        "unknown": int(gained["unknown"]),
        "spikes": int(gained["spikes"]),
        "dropped": int(gained["dropped"]),
        "error_frames": int(gained["error_frames"]),
    }


def _age_ms(now_ns: int, then_ns: int | None) -> float | None:
    return None if then_ns is None else round((now_ns - then_ns) / 1e6, 1)


def _listed(mask: NDArray[np.bool_] | None) -> list[int]:
    return [] if mask is None else np.flatnonzero(mask).tolist()


def _count(present: int, triangles: tuple[int, ...]) -> int:
    return sum(present >> triangle & 1 for triangle in triangles if triangle < TRIANGLES)
