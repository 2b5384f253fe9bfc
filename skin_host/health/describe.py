"""Builds the health record of a part from what `watch` has noted."""

import math
from collections import deque
from statistics import fmean, median
from typing import TYPE_CHECKING, Any, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Assembler
from skin_host.bus.ledger import BoardLedger
from skin_host.bus.wire import TRIANGLES, StatusError, skin_id
from skin_host.health.diagnosis import FEW_HALVES, JITTER_SHARE
from skin_host.health.record import (
    BoardHealth,
    BusHealth,
    LastSecond,
    Record,
    Temperatures,
    TriangleHealth,
)
from skin_host.health.watch import Watch
from skin_host.layout import TAXELS_PER_TRIANGLE, PadKind
from skin_host.processing.calibration import USUAL_SHIFT, Calibration, Verdict, fineness
from skin_host.processing.core import Engine
from skin_host.processing.far_presses import FAR_PADS
from skin_host.processing.intake import lifted
from skin_host.processing.masks import Mask, any_of, count_of

if TYPE_CHECKING:
    from skin_host.bus.boards import Boards
    from skin_host.bus.port import Port

#: An event of a board stays in the record for this long.
LATELY_NS = 60_000_000_000
#: Length of a frame of 8 bytes on the wire in bits, with stuff bits and the pause after it.
FRAME_BITS = 121
#: A longer interval is one in which a sweep was lost.
LOST_PERIODS = 1.6
#: Sweeps with a shorter pause between them follow one another: how long they take is estimated.
PAUSE_MS = 1.0
#: The period of a board is judged from this many intervals between sweeps or more.
FEWEST_INTERVALS = 8
#: Ratio of standard deviation to median absolute deviation, for a normal distribution.
SIGMA = 1.4826
#: A shift of the whole part is measured on so many untouched taxels or more: by fewer their noise
#: would show one now and then (docs/found.md).
FEWEST_RESTING = 8
#: Taxels beside a press move with it, so all of a part with fewer must be untouched.
MANY_RESTING = 12
#: A part has shifted if this share of its untouched taxels has moved by half of that, or more.
TOGETHER_SHARE = 0.75
#: A shift counts for so long though the baselines have followed it.
FORMER_NS = 3_000_000_000
#: A triangle is missing when it was absent from this many sweeps in a row; where its bus loses
#: frames, from so many: of 10 % of the frames, three in a row are some triangle's every second.
ABSENT_SWEEPS = 3
LOST_SWEEPS = 12
#: That a triangle has not changed since its calibration is known after this.
CONSTANT_NS = 1_000_000_000
#: A baseline counts as drifting when it has moved by more than this share of its limit.
DRIFTING_SHARE = 0.25
#: Faults of triangles whose chips do not answer, or did not when their board was zeroed.
_UNANSWERED = {"not connected", "no ack", "silenced", "answers again"}
_COUNTS = (
    "wrong",
    "halves",
    "missed",
    "unknown",
    "spikes",
    "dropped",
    "overflows",
    "error_frames",
)


class Describer:
    """Builds the health records of an engine's parts.

    All times are on the clock of the frames' time stamps. Without a time (a replay) the records
    have no ages.
    """

    def __init__(self, engine: Engine, watch: Watch) -> None:
        self._engine = engine
        self._layout = engine.layout
        self._watch = watch
        #: For each part the time of the last sample that was looked at, the shifts of its thermal
        #: and of its resting pads in it, and those that it and the one before agree on.
        self._shifts: dict[int, tuple[int, Temperatures, Temperatures]] = {}
        shifts = np.array([triangle.shift for triangle in self._layout.triangles])
        #: One unit of each taxel [n], in units of the usual shift.
        self._unit = np.exp2(shifts - USUAL_SHIFT)[self._layout.triangle_of]
        self._fineness = fineness(self._layout)
        #: For each part its baselines at the last looks, their times, and which zeros they are of.
        self._baselines: dict[int, deque[tuple[int, int, Calibration, NDArray[np.float64]]]] = {}
        #: Since when triangles, by board and number, have not changed after a calibration in which
        #: they did not either, or which has not seen them.
        self._unproven_ns: dict[tuple[int, int], int] = {}
        #: For each part: a calibration, and its verdicts that are not "ok".
        self._judged: dict[int, tuple[Calibration, int, dict[str, list[int]]]] = {}
        #: For each part: the triangles that belong to it, by board.
        self._fitted: dict[int, dict[int, list[int]]] = {part: {} for part in engine.parts}
        for triangle in self._layout.triangles:
            if triangle.part in self._fitted:
                of_board = self._fitted[triangle.part].setdefault(triangle.board, [])
                of_board.append(triangle.number)

    def part(
        self, part: int, now_ns: int | None, ports: dict[str, "Port"], boards: dict[str, "Boards"]
    ) -> Record:
        """Return the health record of a part."""
        watch = self._watch.parts[part]
        layout = self._layout.parts[part]
        pressure = self._layout.pad_kind[layout.start : layout.stop] == PadKind.PRESSURE
        buses = sorted({self._layout.boards[i].settings.bus for i in layout.boards})
        pipeline = self._engine.pipeline
        calibration = self._engine.calibration
        valid = self._valid(part)
        triangles, others = self._triangles(part, boards)
        record: Record = {
            "part": layout.name,
            "state": self._state(part, pressure, valid),
            "frames": watch.frames,
            "rate_hz": round(watch.rate_hz, 2),
            "taxels": int(np.count_nonzero(pressure)),
            "valid_taxels": 0 if valid is None else int(np.count_nonzero(valid)),
            "invalid": _listed(None if valid is None else pressure & ~valid),
            "beyond_range": _listed(watch.beyond),
            "triangles": triangles,
            "taxel_verdicts": self._verdicts(part, pressure),
            "decides_kpa": self._decides_kpa(part),
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
        if others:
            record["other_triangles"] = others
        if now_ns is not None:
            record["age_ms"] = _age_ms(now_ns, watch.last_ns or None)
        return record

    def _valid(self, part: int) -> Mask | None:
        """Return the valid taxels of a part, bool[m], so that every other one has a known reason.

        They are those of its last sample; those that were late for it, which is no fault until
        their board times out; and those in whose chip or pad there has been no doubt since.
        """
        watch, ledger = self._watch.parts[part], self._engine.ledger
        now = self._engine.intake.liveness.doubted
        cleared = [
            then if now is None else then & ~now
            for then in watch.doubted
            if then is not None and then is not now
        ]
        if watch.valid is None or (watch.late is None and not cleared):
            return watch.valid
        layout = self._layout.parts[part]
        valid = watch.valid.copy()
        usable = self._layout.pad_kind == PadKind.PRESSURE
        can_be = self._engine.usable()
        usable = usable if can_be is None else usable & can_be
        for index in layout.boards:
            taxels, row = self._layout.boards[index].taxel_index, ledger.row[index]
            fitted = (taxels >= layout.start) & (taxels < layout.stop)
            mine = taxels[fitted] - layout.start
            # A chip that does not answer is not late.
            if watch.late is not None and not ledger.flagged[row]:
                valid[mine] |= watch.late[mine]
            veto = self._engine.intake.veto.get(row)
            for pads in cleared:
                here = self._of_board(pads, row)
                here = here if veto is None else here & ~veto
                valid[mine] |= here[fitted] & usable[taxels[fitted]]
        return valid

    def _state(self, part: int, pressure: NDArray[np.bool_], valid: Mask | None) -> str:
        watch = self._watch.parts[part]
        if part in self._engine.disabled:
            return "disabled"
        if self._engine.calibration is None:
            return "not calibrated"
        if not watch.frames or valid is None:
            return "no data"
        if not valid.any():
            return "silent"
        return "ok" if valid[pressure].all() else "degraded"

    def _triangles(
        self, part: int, boards: dict[str, "Boards"]
    ) -> tuple[list[TriangleHealth], list[TriangleHealth]]:
        """Return the triangles with a fault of a part, and those of other parts on its boards."""
        unwell: list[TriangleHealth] = []
        others: list[TriangleHealth] = []
        for board, numbers in self._fitted[part].items():
            if self._all_well(board) or self._awaits(board, boards):
                continue
            name = self._layout.boards[board].name
            for number in self._layout.boards[board].triangles:
                fault = self._triangle_fault(board, number)
                if fault is not None:
                    found = unwell if number in numbers else others
                    found.append({"board": name, "triangle": number, "fault": fault})
        return unwell, others

    def _all_well(self, board: int) -> bool:
        """Whether no triangle of the board can have a fault: the common case, checked first."""
        ledger, liveness = self._engine.ledger, self._engine.intake.liveness
        row = ledger.row[board]
        return bool(
            ledger.sweeps[row]
            and ledger.complete(row)
            and not ledger.is_silent(row)
            and not ledger.flagged[row]
            and not self._of_board(liveness.unproven | liveness.halted, row).any()
        )

    def _awaits(self, board: int, boards: dict[str, "Boards"]) -> bool:
        """Whether a board has not had the time to send yet."""
        settings = self._layout.boards[board].settings
        return settings.bus in boards and boards[settings.bus].awaits(settings.address)

    @staticmethod
    def _of_board(of_triangles: Mask, row: int) -> Mask:
        """One board's share of an array over all triangles."""
        mine: Mask = of_triangles[TRIANGLES * row : TRIANGLES * (row + 1)]
        return mine

    def _triangle_fault(self, board: int, number: int) -> str | None:
        ledger = self._engine.ledger
        row = ledger.row[board]
        sweep = ledger.last[row]
        if sweep is None or ledger.is_silent(row):
            return "missing"
        if not ledger.present[row, number]:
            # One lost frame is a fault of the bus, not of the triangle.
            return "missing" if ledger.absent[row, number] >= self._absent_sweeps(board) else None
        error = int(ledger.error[row, number])
        if error & StatusError.NOT_CONNECTED:
            return "not connected"
        if error & StatusError.NO_ACK:
            return "no ack"
        liveness = self._engine.intake.liveness
        triangle = TRIANGLES * row + number
        if liveness.silenced[triangle] and any_of(ledger.far[row, number]):
            # A board sends the zero for a chip that does not answer.
            return "answers again"
        if liveness.frozen[triangle] or liveness.halted[triangle]:
            return "silenced" if liveness.silenced[triangle] else "frozen"
        if liveness.unproven[triangle] and liveness.silenced[triangle]:
            return "silenced"
        # If pads read far below zero, the readings are not taken and cannot show a change.
        if liveness.unproven[triangle] and self._engine.intake.takes(row, number):
            since_ns = self._unproven_ns.setdefault((board, number), ledger.now_ns)
            return "constant" if ledger.now_ns - since_ns >= CONSTANT_NS else None
        self._unproven_ns.pop((board, number), None)
        if row in ledger.twice:
            # What pressed one of the two boards as it was zeroed cannot be known.
            return None
        # Single pads are listed with the taxels; only a whole triangle counts here.
        far = self._far(board, sweep.raw)[number]
        many = np.count_nonzero(far) >= FAR_PADS
        other = lifted(sweep.raw[number], far)
        return "out of range" if many or other else None

    def _absent_sweeps(self, board: int) -> int:
        """Return from how many sweeps in a row a triangle of a board is absent that is missing."""
        gained = self._watch.buses[self._layout.boards[board].settings.bus].gained
        loses = gained.get("halves", 0) >= FEW_HALVES
        loses |= any(gained.get(lost, 0) for lost in ("dropped", "overflows"))
        return LOST_SWEEPS if loses else ABSENT_SWEEPS

    def _far(self, board: int, raw: NDArray[np.uint8]) -> Mask:
        """Return pads bool[16, 12] of a board's last sweep that are far out of range, but for those
        that are pressed, and those that what pressed as it took its zero explains, which is
        reported as `board_in_doubt`: they read far below zero pressure, not above.

        Args:
            board: of the layout.
            raw: uint8[16, 12], of that sweep.
        """
        row = self._engine.ledger.row[board]
        far: Mask = self._engine.ledger.far[row]
        found: Mask = far & ~(self._engine.zeros.in_doubt(board) & (raw == 255))
        if any_of(found):
            found &= ~self._engine.intake.far_presses.pressed(row)
        return found

    def _taxel_faults(self, part: int, pressure: NDArray[np.bool_]) -> dict[str, list[int]]:
        layout = self._layout.parts[part]
        found: dict[str, NDArray[np.bool_]] = {}
        ledger, liveness = self._engine.ledger, self._engine.intake.liveness
        for kind in ("stuck", "noisy", "out_of_range"):
            found[kind] = np.zeros(layout.n_taxels, np.bool_)
        for index in layout.boards:
            row = ledger.row[index]
            if liveness.doubted is None and not ledger.flagged[row]:
                continue
            taxels = self._layout.boards[index].taxel_index
            mine = (taxels >= layout.start) & (taxels < layout.stop)
            masks = {
                "stuck": self._of_board(liveness.stuck & ~liveness.halted[:, None], row),
                "noisy": self._of_board(liveness.noisy, row),
            }
            sweep = ledger.last[row]
            if sweep is not None and ledger.flagged[row] and row not in ledger.twice:
                answered = (ledger.error[row] == 0)[:, None]
                masks["out_of_range"] = self._far(index, sweep.raw) & answered
            for kind, mask in masks.items():
                found[kind][taxels[mine & mask] - layout.start] = True
        pipeline, calibration = self._engine.pipeline, self._engine.calibration
        if pipeline is not None and calibration is not None:
            span = slice(layout.start, layout.stop)
            moved = np.abs(pipeline.baseline[span] - calibration.baseline[span])
            limit = self._engine.settings.processing.drift.limit_units * self._fineness[span]
            found["returned"] = pipeline.returned(part)
            found["drifting"] = (moved > DRIFTING_SHARE * limit) & calibration.usable[span]
        # A temperature pad that fails spoils the correction of its triangle. Out of its range it is
        # only warm.
        for kind in found.keys() - {"stuck", "noisy"}:
            found[kind] &= pressure
        return {kind: np.flatnonzero(mask).tolist() for kind, mask in found.items() if any_of(mask)}

    def _warmth(self, part: int, pressure: NDArray[np.bool_]) -> Temperatures | None:
        pipeline, calibration = self._engine.pipeline, self._engine.calibration
        watch = self._watch.parts[part]
        if pipeline is None or calibration is None or watch.raw is None or watch.valid is None:
            return None
        known = self._shifts.get(part)
        if known is not None and known[0] == watch.sample_ns:
            return known[2]
        layout = self._layout.parts[part]
        span = slice(layout.start, layout.stop)
        units = self._layout.no_load[span].astype(np.float64) - watch.raw
        heard = watch.raw > 0
        unit = self._unit[span]
        # A triangle whose pressures are not valid has no valid temperature either.
        lives = watch.valid.reshape(-1, TAXELS_PER_TRIANGLE).any(axis=1)
        thermal = ~pressure & heard & calibration.usable[span]
        thermal &= np.repeat(lives, TAXELS_PER_TRIANGLE)
        none: Temperatures = {
            "thermal_units": None,
            "common_units": 0.0,
            "coarsest_units": max(float(unit.max()), 1.0),
        }
        found = none.copy()
        if thermal.any():
            shift = (units - calibration.baseline[span])[thermal] * unit[thermal]
            # At the end of its scale nobody can see how much colder a pad is: it counts twice.
            shift[watch.raw[thermal] == 255] *= 2.0
            found["thermal_units"] = round(_middle(shift), 1)
        rests = watch.rests()
        # Pads in doubt are not valid, and nobody knows that they are untouched.
        usable = pressure & calibration.usable[span]
        if rests is not None and enough_rest(rests, usable):
            shifts = [units - pipeline.baseline[span]]
            if (rests == watch.valid).all() and (former := self._former(part, span)) is not None:
                shifts.append(units - former)
            triangle_of = self._layout.triangle_of[span]
            common = max((common_shift(one * unit, rests, triangle_of) for one in shifts), key=abs)
            found["common_units"] = round(common, 1)
        # A temperature lasts. Noise that the pads of a triangle share, and what a chip sends that
        # has just stopped answering, pass from one sweep to the next; a board that is being set up
        # sends none.
        before = none if known is None else known[1]
        agreed = found.copy()
        agreed["thermal_units"] = _nearer_zero(before["thermal_units"], found["thermal_units"])
        agreed["common_units"] = min(before["common_units"], found["common_units"], key=abs)
        self._shifts[part] = watch.sample_ns, found, agreed
        return agreed

    def _former(self, part: int, span: slice) -> NDArray[np.float64] | None:
        """Return the baselines [m] that a part had some seconds ago, of the zeros that it has now.

        What all pads read too little is followed within a second: two looks would not agree on it.
        """
        pipeline, calibration = self._engine.pipeline, self._engine.calibration
        assert pipeline is not None
        assert calibration is not None
        now_ns, changes = self._watch.parts[part].sample_ns, self._engine.zeros.changes
        known = self._baselines.setdefault(part, deque())
        while known and not (
            0 <= now_ns - known[0][0] <= FORMER_NS
            and known[0][1] == changes
            and known[0][2] is calibration
        ):
            known.popleft()
        known.append((now_ns, changes, calibration, pipeline.baseline[span].copy()))
        return known[0][3]

    def _verdicts(self, part: int, pressure: NDArray[np.bool_]) -> dict[str, list[int]]:
        calibration, pipeline = self._engine.calibration, self._engine.pipeline
        if calibration is None or pipeline is None:
            return {}
        known, changes = self._judged.get(part), self._engine.zeros.changes
        if known is None or known[0] is not calibration or known[1] != changes:
            layout = self._layout.parts[part]
            mine = slice(layout.start, layout.stop)
            # A set-up may leave a pad as near to the end of the scale as a calibration may find it.
            cut_off = (self._engine.zeros.cut_off() & calibration.usable)[mine]
            verdict = np.where(cut_off, Verdict.OUT_OF_RANGE, calibration.verdict[mine])
            verdict = np.where(pressure, verdict, Verdict.OK)
            found = {
                kind.name.lower(): np.flatnonzero(verdict == kind).tolist()
                for kind in map(Verdict, sorted(set(verdict.tolist())))
                if kind != Verdict.OK
            }
            for name, taxels in (("unreached", pipeline.unreached), ("flat", pipeline.flat)):
                if taxels[mine].any():
                    found[name] = np.flatnonzero(taxels[mine]).tolist()
            self._judged[part] = known = calibration, changes, found
        return known[2]

    def _decides_kpa(self, part: int) -> float | None:
        """Return the pressure above which every usable taxel decides within a second."""
        pipeline = self._engine.pipeline
        return None if pipeline is None else round(pipeline.decides_kpa(part), 1)

    def _board(self, index: int, now_ns: int | None, boards: dict[str, "Boards"]) -> BoardHealth:
        board = self._layout.boards[index]
        watch = self._watch.boards[index]
        ledger = self._engine.ledger
        row = ledger.row[index]
        sweep = ledger.last[row]
        period_seen_ms, jitter_ms = _period(ledger.intervals_ns(row), board.settings.period_ms)
        record: BoardHealth = {
            "name": board.name,
            "bus": board.settings.bus,
            "address": board.settings.address,
            "skin_type": board.settings.effective_skin_type,
            "alive": sweep is not None and not ledger.is_silent(row) and not self._is_new(index),
            "sweeps": int(ledger.sweeps[row]),
            "fitted": list(board.triangles),
            "triangles_present": 0 if sweep is None else _count(sweep.present, board.triangles),
            "triangles": len(board.triangles),
            "period_ms": board.settings.period_ms,
            "period_seen_ms": period_seen_ms,
            "jitter_ms": jitter_ms,
            "rezeros": int(ledger.rezeros[row]),
            "excess": int(ledger.excess[row]),
            "in_doubt": self._in_doubt(index),
        }
        manager = boards.get(board.settings.bus)
        if manager is not None:
            known = manager.records[board.settings.address]
            record |= {
                "board_type": known.board_type,
                "wrong_type": known.is_wrong_type,
                "firmware": known.firmware,
                "in_bootloader": known.in_bootloader,
                "wrong_model": board.settings.model if known.is_wrong_model else "",
                "awaited": manager.awaits(board.settings.address)
                or self._engine.zeros.paused(index),
                "configurations": known.configurations,
                "silences": int(ledger.silences[row]),
                "resets": int(ledger.resets[row]),
                "lost_set_ups": int(ledger.lost_set_ups[row]),
                "tx_overflows": int(ledger.tx_overflows[row]),
            }
        if now_ns is not None:
            record["age_ms"] = _age_ms(now_ns, None if sweep is None else sweep.t_ns)
            record["lately"] = {
                name: watch.events[name]
                for name, at_ns in watch.event_ns.items()
                if abs(now_ns - at_ns) < LATELY_NS
            }
        record["held_up"] = (
            period_seen_ms is not None
            and jitter_ms is not None
            and jitter_ms > JITTER_SHARE * board.settings.period_ms
            and self._is_held_up(index, period_seen_ms)
        )
        record["twice"] = row in ledger.twice and not ledger.is_silent(row)
        return record

    def _in_doubt(self, index: int) -> int:
        """Return of how many taxels of a board the zero is unknown because they were touched; not
        of chips that do not answer, or did not when their board was zeroed: what it takes for their
        zero is none.
        """
        of_triangles = count_of(self._engine.zeros.in_doubt(index))
        return sum(
            int(of_triangles[number])
            for number in np.flatnonzero(of_triangles).tolist()
            if self._triangle_fault(index, number) not in _UNANSWERED
        )

    def _is_held_up(self, index: int, period_ms: float) -> bool:
        """Whether a board's intervals scatter because its sweeps wait for those of more urgent
        boards of its bus, as far as can be known.

        What is seen is when its sweeps end. Each was ready at some moment since the bus had its
        last pause. As long as three quarters of the intervals may have been regular, it is not
        accused.

        Args:
            index: of the board.
            period_ms: the mean of its intervals.
        """
        ledger, own = self._engine.ledger, self._layout.boards[index].settings
        sweeps: list[tuple[float, float]] = []
        known_ms, pause_ms = -np.inf, PAUSE_MS
        for other in self._engine.boards:
            one, row = self._layout.boards[other].settings, ledger.row[other]
            if one.bus != own.bus or one.address >= own.address:
                continue
            # One that is silent now has held up what was sent before.
            theirs_ms, unread_ms = _ends_ms(ledger, row), self._unread_ms(other)
            if theirs_ms:
                known_ms = max(known_ms, theirs_ms[0])
                pause_ms = max(pause_ms, PAUSE_MS + unread_ms)
                took_ms = self._sweep_ms(other) + unread_ms
                sweeps += [(end_ms, took_ms) for end_ms in theirs_ms]
        if not sweeps:
            return False
        sweeps.sort(reverse=True)
        ends_ms, took_ms = _ends_ms(ledger, ledger.row[index]), self._sweep_ms(index)
        latest_ms = [end_ms - took_ms for end_ms in ends_ms]
        earliest_ms = [
            -np.inf
            if end_ms <= known_ms
            else _busy_since_ms(end_ms - took_ms, end_ms, sweeps, pause_ms)
            for end_ms in ends_ms
        ]
        off_ms = sorted(
            max(earliest_ms[at] - latest_ms[at - 1] - period_ms, 0.0)
            + max(period_ms - latest_ms[at] + earliest_ms[at - 1], 0.0)
            for at in range(1, len(ends_ms))
            if ends_ms[at] - ends_ms[at - 1] < LOST_PERIODS * own.period_ms
        )
        return not off_ms or SIGMA * off_ms[3 * len(off_ms) // 4] <= JITTER_SHARE * own.period_ms

    def _sweep_ms(self, index: int) -> float:
        """Return how long the configured triangles of a board take its bus."""
        return self._triangle_ms(index) * len(self._layout.boards[index].triangles)

    def _unread_ms(self, index: int) -> float:
        """Return how long those take it that the board sends besides, before these or after."""
        sweep = self._engine.ledger.last[self._engine.ledger.row[index]]
        return 0.0 if sweep is None else self._triangle_ms(index) * sweep.unread.bit_count()

    def _triangle_ms(self, index: int) -> float:
        bus = self._layout.boards[index].settings.bus
        return 2 * FRAME_BITS / self._engine.settings.buses[bus].bitrate * 1e3

    def _is_new(self, index: int) -> bool:
        """Whether a board that had timed out sends again, but no sample has its values yet, or it
        is not known yet whether it zeroed itself meanwhile.
        """
        if self._engine.zeros.compares(index):
            return True
        sweep = self._engine.ledger.last[self._engine.ledger.row[index]]
        if sweep is None or self._engine.ledger.flagged[self._engine.ledger.row[index]]:
            return False
        for part, fitted in self._fitted.items():
            if part in self._engine.disabled:
                continue  # No samples of it are taken.
            watch = self._watch.parts[part]
            if index in fitted and watch.lost is not None and sweep.t_ns > watch.sample_ns:
                taxels = self._layout.boards[index].taxel_index[fitted[index], 0]
                first = taxels - self._layout.parts[part].start
                if (watch.lost[first // TAXELS_PER_TRIANGLE] >= watch.late_samples).all():
                    return True
        return False

    def _bus(
        self,
        name: str,
        now_ns: int | None,
        ports: dict[str, "Port"],
        boards: dict[str, "Boards"],
    ) -> BusHealth:
        bus = self._engine.settings.buses[name]
        counters = msgspec.to_builtins(self._engine.assemblers[name].counters)
        about = {"name": name, "interface": bus.interface, "channel": bus.channel}
        record = cast(BusHealth, about | counters)
        port = ports.get(name)
        if port is not None:
            record["state"] = str(port.state)
            if port.unopened:
                record["unopened"] = port.unopened
            record["port"] = msgspec.to_builtins(port.counters)
        manager = boards.get(name)
        if manager is not None:
            record["strangers"] = dict(manager.strangers)
            gained = self._watch.buses[name].gained
            if (stranger := _stranger(self._engine.assemblers[name], gained)) is not None:
                record["stranger"] = stranger
        watch = self._watch.buses[name]
        if watch.gained and now_ns is not None:
            record["last_second"] = _last_second(watch.gained, bus.bitrate)
            record["spiked_pads"] = watch.spiked_pads
            record["silent"] = watch.silent
            record["lost_here"] = watch.lost_here(now_ns)
        return record


def _stranger(assembler: Assembler, gained: dict[str, float]) -> str | None:
    """Return what the unconfigured node sends that sends most, as far as that is known."""
    if gained and gained["unconfigured"] > _others(gained):
        ((address, _),) = assembler.unconfigured.most_common(1)
        return f"0x{skin_id(address, 0):x}-0x{skin_id(address, TRIANGLES - 1):x}"
    return None if assembler.stranger_id is None else f"0x{assembler.stranger_id:x}"


def _others(gained: dict[str, float]) -> float:
    """Return how many frames a bus has gained of what no node of the robot is configured for, but
    for those of boards of skin.
    """
    return gained["other"] - gained["elsewhere"] - gained["error_frames"]


def enough_rest(rests: Mask, usable: Mask) -> bool:
    """Return whether a shift of a part can be known, bool[m] each: by the untouched taxels of those
    that are usable.

    If less than half are untouched, they may be those that are too noisy to feel an even load.
    """
    resting, all_pads = int(np.count_nonzero(rests)), int(np.count_nonzero(usable))
    return resting >= max(FEWEST_RESTING, min(MANY_RESTING, all_pads), all_pads / 2)


def common_shift(
    shift: NDArray[np.float64], rests: NDArray[np.bool_], triangle_of: NDArray[np.integer[Any]]
) -> float:
    """Return how far the untouched taxels of a part have moved together: 0 if they have not.

    Temperature moves nearly all pads, of all triangles. A press near them, or the end of one that a
    board took for its zero, moves the pads around it.

    Args:
        shift: [m], from the baselines, in units of one shift.
        rests: bool[m], untouched taxels; some are.
        triangle_of: int[m].
    """
    common = _middle(shift[rests])
    along = shift[rests] * math.copysign(1.0, common) >= abs(common) / 2
    if np.count_nonzero(along) < TOGETHER_SHARE * len(along):
        return 0.0
    # Most parts rest: then one of the first triangles has not moved like the others.
    own = (
        _middle(shift[rests & (triangle_of == one)])
        for one in sorted(set(triangle_of[rests].tolist()))
    )
    together = all(one * common > 0.0 and abs(one) >= abs(common) / 2 for one in own)
    return common if together else 0.0


def _middle(values: NDArray[np.float64]) -> float:
    """The median of some numbers, at a fifth of the cost of NumPy's."""
    half = len(values) // 2
    low = half - 1 + len(values) % 2
    values = np.partition(values, (low, half))
    return float(values[low] + values[half]) / 2.0


def _period(intervals_ns: NDArray[np.int64], wanted_ms: int) -> tuple[float | None, float | None]:
    """Mean period and its scatter in ms, None until there are enough sweeps."""
    if len(intervals_ns) < FEWEST_INTERVALS:
        return None, None
    # For so few numbers lists are faster than arrays.
    intervals_ms = [interval_ns / 1e6 for interval_ns in intervals_ns.tolist()]
    usual = [interval_ms for interval_ms in intervals_ms if interval_ms < LOST_PERIODS * wanted_ms]
    if 2 * len(usual) < len(intervals_ms):
        usual = intervals_ms
    elif len(usual) < FEWEST_INTERVALS:
        return None, None
    # From the median deviation, because one late sweep among many is not jitter.
    middle = median(usual)
    jitter_ms = SIGMA * median([abs(interval_ms - middle) for interval_ms in usual])
    return round(fmean(usual), 2), round(jitter_ms, 2)


def _ends_ms(ledger: BoardLedger, row: int) -> list[float]:
    """Return when a board's last sweeps ended, the oldest first."""
    last = ledger.last[row]
    if last is None:
        return []
    intervals_ns = ledger.intervals_ns(row)
    before_ns = last.t_ns - np.cumsum(intervals_ns[::-1])[::-1]
    return [t_ns / 1e6 for t_ns in [*before_ns.tolist(), last.t_ns]]


def _busy_since_ms(
    begin_ms: float, end_ms: float, sweeps: list[tuple[float, float]], pause_ms: float
) -> float:
    """Return since when a bus passed frames without a pause until a sweep began.

    Args:
        begin_ms, end_ms: of the sweep.
        sweeps: others, each with its end and how long it took the bus, the last first.
        pause_ms: after a shorter time the bus may have passed frames throughout.
    """
    for other_ms, took_ms in sweeps:
        if other_ms < begin_ms - pause_ms:
            break
        if other_ms <= end_ms:
            begin_ms = min(begin_ms, other_ms) - took_ms
    return begin_ms


def _last_second(gained: dict[str, float], bitrate: int) -> LastSecond:
    seconds = max(gained["seconds"], 0.1)
    load = FRAME_BITS / (bitrate * seconds)
    counts = {key: int(gained[key]) for key in _COUNTS}
    loads = {
        "frames_hz": round(gained["frames"] / seconds),
        # Reports of the controller are no frames of the bus.
        "load": round((gained["frames"] - gained["error_frames"]) * load, 3),
        "other_load": round((_others(gained) + gained["unconfigured"]) * load, 3),
    }
    return cast(LastSecond, loads | counts)


def _age_ms(now_ns: int, then_ns: int | None) -> float | None:
    """Return how old something is; what a clock dates after now has just been."""
    return None if then_ns is None else max(0.0, round((now_ns - then_ns) / 1e6, 1))


def _listed(mask: NDArray[np.bool_] | None) -> list[int]:
    return [] if mask is None else np.flatnonzero(mask).tolist()


def _count(present: int, triangles: tuple[int, ...]) -> int:
    return sum([present >> triangle & 1 for triangle in triangles if triangle < TRIANGLES])


def _nearer_zero(before: float | None, now: float | None) -> float | None:
    """Return the shift that two looks agree on; None if one of them had none."""
    return None if before is None or now is None else min(before, now, key=abs)
