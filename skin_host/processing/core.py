"""Turns CAN frames into pressure and touch events: runs the pure packages in order.

One engine serves both the daemon and the replay of recordings. It has no clock and no socket: it
takes frames and times, and returns frames of pressure and events.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Assembler, Sweep
from skin_host.bus.ledger import BoardLedger
from skin_host.bus.wire import TRIANGLES, FrameBatch, StatusError
from skin_host.config.settings import Settings, TouchSettings, skin_hash
from skin_host.fingertip.events import FingertipEvent
from skin_host.layout import Layout
from skin_host.processing.calibration import Calibration, Verdict, with_zeros
from skin_host.processing.calibration.calibrator import KNOWN_SAMPLES, Calibrator, Known
from skin_host.processing.contacts import ContactTracker
from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.events import Touch
from skin_host.processing.intake import Intake, PartSample, below_zero
from skin_host.processing.liveness import PADS
from skin_host.processing.masks import Mask, any_of
from skin_host.processing.pipeline import Pipeline, PressureFrame, unreached
from skin_host.processing.pressure import PressureCurve, vertex
from skin_host.processing.rezero import (
    BELOW_SWEEPS,
    JUMPS_NS,
    STEADY_UNITS,
    Rezero,
    highest_rest,
    look_s,
    repeats_of,
)
from skin_host.processing.silent_zero import SilentZero

if TYPE_CHECKING:
    from skin_host.fingertip.engine import FingertipEngine

#: A calibration takes at least `KNOWN_SAMPLES` of each board, even if that is slow, and the time of
#: so many conversions, even if less is asked for.
SHORTEST_S = KNOWN_SAMPLES * CONVERSION_S
#: A longer interval between two samples of a calibration does not count for its time: nothing was
#: received, or the clock was set.
LONGEST_INTERVAL_NS = 1_000_000_000
#: So many conversions show that something presses a taxel which is not valid, ...
GLIMPSED = 3
#: ... or has become it less than this ago: a touch may not be decided yet.
DECIDED_NS = 500_000_000


class Step(NamedTuple):
    """Result of one sample of a part.

    Attributes:
        part: index into `Layout.parts`.
        frame: its pressure.
        events: of its contacts.
    """

    part: int
    frame: PressureFrame
    events: list[Touch]


class Output(NamedTuple):
    """Complete result of one call.

    Attributes:
        sweeps: of boards, completed or closed.
        steps: samples of parts that were processed, each with the events of its contacts.
        samples: (number of the fingertip, time) of force/torque samples.
        grasps: events of fingertips on force/torque boards.
        answers: (identifier, payload) of frames in which boards answer.
    """

    sweeps: list[Sweep]
    steps: list[Step]
    samples: list[tuple[int, int]]
    grasps: list[FingertipEvent]
    answers: list[tuple[int, bytes]]

    @property
    def frames(self) -> list[PressureFrame]:
        """Pressure of parts, in the order of their samples."""
        return [step.frame for step in self.steps]

    @property
    def events(self) -> list[FingertipEvent]:
        """Touches of the skin in the order of its frames, then events of the fingertips."""
        return [event for step in self.steps for event in step.events] + self.grasps


@dataclass(slots=True)
class _CalibrationRun:
    calibrator: Calibrator
    duration_ns: int
    fewest: int
    #: Time of the newest sample; None before the first.
    last_ns: int | None = None
    #: The sum of the intervals between samples: a clock that is set adds nothing.
    passed_ns: int = 0
    #: By board and part, for those that have sent any.
    samples: dict[tuple[int, int], int] = field(default_factory=dict)


@dataclass(slots=True)
class _Glimpse:
    """The last readings of a board of which taxels are not valid, or were not just now.

    Attributes:
        units: float64[192] each: of its taxels, away from its zero; -inf where there is none.
        until_ns: then its touches are decided.
    """

    units: deque[NDArray[np.float64]]
    until_ns: int = 0


class Engine:
    """Assemblers, intake, pipeline and contact trackers of one daemon's share of a skin.

    Args:
        settings: the configuration.
        layout: its skin.
        parts: indices of the parts that this node reads.
        calibration: of this skin, or None: then there is no output until one is taken.
        after: the engine that this one replaces, see `settings.needs_restart`: its knowledge of
            boards, its zero, its learnt values and its contacts continue. It must not be fed again.

    Attributes:
        boards: indices of the boards of these parts.
        assemblers: of each bus, by its name.
        ledger: of these boards.
        intake: joins their sweeps into samples of parts; knows which of their taxels are valid.
        disabled: parts without output.
        touch_only: parts whose pressures are not subscribed while nothing touches them.
        fingertips: those of these parts' nodes, if there are any.
    """

    def __init__(
        self,
        settings: Settings,
        layout: Layout,
        parts: list[int],
        calibration: Calibration | None = None,
        after: "Engine | None" = None,
    ) -> None:
        self.settings = settings
        self.layout = layout
        self.parts = parts
        self.configuration = skin_hash(settings)
        self.calibration = calibration
        self.boards = sorted({board for part in parts for board in layout.parts[part].boards})
        self.fingertips = _fingertips(settings, layout, parts)
        buses = {layout.boards[i].settings.bus for i in self.boards}
        if self.fingertips is not None:
            buses |= self.fingertips.buses
        self.assemblers = (
            {}
            if after is not None
            else {
                bus: Assembler(
                    [
                        (i, layout.boards[i])
                        for i in self.boards
                        if layout.boards[i].settings.bus == bus
                    ],
                    settings.receive.close_periods,
                    frozenset() if self.fingertips is None else self.fingertips.identifiers(bus),
                )
                for bus in sorted(buses)
            }
        )
        #: Contacts of fingertips that a new zero ended; they are part of the next output.
        self._ended: list[FingertipEvent] = []
        self.disabled: set[int] = set()
        self.touch_only: set[int] = set()
        receive = settings.receive
        self.ledger = BoardLedger(
            [(i, layout.boards[i]) for i in self.boards], receive.silent_periods, receive.poll_ms
        )
        curve = settings.processing.pressure
        self.intake = Intake(
            layout,
            parts,
            self.boards,
            self.ledger,
            receive.silent_periods,
            float(vertex(curve.a_kpa_per_ff2, curve.b_kpa_per_ff)),
        )
        #: How often new zeros have been found, and how often what is known of zeros has changed.
        self.zeros_found = 0
        self.zero_changes = 0
        self._rezeros: dict[int, Rezero] = {}
        #: Boards that were silent and may have zeroed themselves meanwhile.
        self._silent_zeros: dict[int, SilentZero] = {}
        #: Boards of which taxels are not valid, or were not just now, as their zero is sought.
        self._glimpses: dict[int, _Glimpse] = {}
        self._unanswered: dict[int, Mask] = {}
        #: For how many sweeps pads int64[16, 12] of a board have read far below zero, where any do.
        self._below: dict[int, NDArray[np.int64]] = {}
        #: When a board's pad last came back from there by itself.
        self._jumped_ns: dict[int, int] = {}
        self._touched = np.zeros(layout.n_taxels, np.bool_)
        #: Whether each taxel was touched when it was last valid. A board that restarts in a touch
        #: is silent before it is zeroed: its touches have ended as lost, and may still be there.
        self._last_touched = np.zeros(layout.n_taxels, np.bool_)
        #: By part: which of its taxels were touched and valid in its last frame.
        self._noted: dict[int, tuple[Mask, Mask]] = {}
        #: Taxels of boards that have not been zeroed yet, see `hold`; None if there are none.
        self._held: Mask | None = None
        #: Boards that were zeroed since they were held: until then what came before is under way.
        self._releasing: set[int] = set()
        self._run: _CalibrationRun | None = None
        #: Between `collected` and `use`: the boards that were zeroed, and `believed` of each.
        self._zeroed_since: dict[int, bool] | None = None
        self._pipeline: Pipeline | None = None
        self._trackers: dict[int, ContactTracker] = {
            part: ContactTracker(
                layout, part, settings, None if after is None else after._trackers[part]
            )
            for part in parts
        }
        if after is not None:
            self._go_on(after)
        elif calibration is not None:
            self.use(calibration)

    def _go_on(self, after: "Engine") -> None:
        """Take over everything but settings and layout, which may differ only in values."""
        self.assemblers = after.assemblers
        self.ledger = after.ledger
        self.intake.go_on(after.intake)
        self.fingertips = after.fingertips
        if self.fingertips is not None:
            self.fingertips.renew(self.settings)
        self._ended = after._ended
        self.disabled = after.disabled
        self.zeros_found = after.zeros_found
        self.zero_changes = after.zero_changes
        self._rezeros = after._rezeros
        self._silent_zeros = after._silent_zeros
        self._glimpses = after._glimpses
        self._unanswered = after._unanswered
        self._below = after._below
        self._jumped_ns = after._jumped_ns
        self._touched = after._touched
        self._last_touched = after._last_touched
        self._held = after._held
        self._releasing = after._releasing
        self._run = after._run
        self._zeroed_since = after._zeroed_since
        self.calibration = after.calibration
        self._pipeline = after._pipeline
        if self.calibration is not None:
            self._renew_pipeline(np.zeros(self.layout.n_taxels, np.bool_))

    @property
    def pipeline(self) -> Pipeline | None:
        """The pipeline in use, if there is a calibration."""
        return self._pipeline

    @property
    def calibrating(self) -> bool:
        """Whether a calibration is being taken."""
        return self._run is not None

    def use(self, calibration: Calibration, boards: list[int] | None = None) -> None:
        """Use this calibration from now on; frame numbers continue.

        Args:
            calibration: the new one.
            boards: those whose zero it has measured; all by default.
        """
        self.calibration = calibration
        boards = self.boards if boards is None else boards
        noise = np.where(calibration.verdict < Verdict.ABSENT, calibration.noise, np.nan)
        self.intake.use(noise, np.isin(self.boards, boards))
        for board in boards:
            self._rezeros.pop(board, None)
            self._silent_zeros.pop(board, None)
            self._glimpses.pop(board, None)
        if self.fingertips is not None and boards == self.boards:
            self._ended += self.fingertips.use(calibration.zeros)
        self.release(boards)
        zeroed = self.taxels_of(boards)
        self._last_touched[zeroed] = self._touched[zeroed]
        self._renew_pipeline(zeroed)
        since, self._zeroed_since = self._zeroed_since or {}, None
        for board, believed in since.items():
            if board in boards:
                self.rezero(board, believed)

    def _renew_pipeline(self, zeroed: NDArray[np.bool_]) -> None:
        """Apply settings and calibration to the pipeline; taxels bool[n] were zeroed."""
        assert self.calibration is not None
        processing = self.settings.processing
        if self._pipeline is None:
            self._pipeline = Pipeline(self.layout, processing, self.calibration)
        else:
            self._pipeline.renew(processing, self.calibration, zeroed, self.layout)

    def taxels_of(self, boards: list[int]) -> NDArray[np.bool_]:
        """Return which taxels bool[n] of the skin some boards read."""
        found = np.zeros(self.layout.n_taxels, np.bool_)
        for board in boards:
            taxels = self._taxels_of(board)
            found[taxels[taxels >= 0]] = True
        return found

    def begin_calibration(self, seconds: float, fewest: int = KNOWN_SAMPLES) -> None:
        """Start to collect samples, see `end_calibration`.

        Args:
            seconds: how long, at least.
            fewest: samples of each board, and conversions, that are taken in any case.
        """
        processing = self.settings.processing
        curve = PressureCurve(
            self.layout.unit_ff / self.layout.sensitivity,
            a=processing.pressure.a_kpa_per_ff2,
            b=processing.pressure.b_kpa_per_ff,
        )
        calibrator = Calibrator(
            self.layout, processing.calibration.percentile, processing.touch, curve.beyond_units
        )
        duration_s = max(seconds, fewest * CONVERSION_S)
        self._run = _CalibrationRun(calibrator, int(duration_s * 1e9), fewest)
        if self.fingertips is not None:
            self.fingertips.begin_zero()

    def calibration_progress(self) -> float:
        """Share of the wanted time, and of the fewest samples, that has been collected, 0 to 1."""
        run = self._run
        if run is None or not run.samples:
            return 0.0
        time_share = run.passed_ns / run.duration_ns
        return min(1.0, time_share, min(run.samples.values()) / run.fewest)

    def end_calibration(self, time: str) -> Calibration:
        """Return a calibration from the collected samples and stop collecting.

        Args:
            time: now, ISO 8601 in UTC.
        """
        return self.collected(time)()

    def collected(self, time: str) -> Callable[[], Calibration]:
        """Stop collecting; return what computes the calibration, in a thread if wanted.

        A large skin takes a second. Boards that are zeroed between this call and `use` have
        another zero than this calibration, and `use` treats them so.

        Args:
            time: now, ISO 8601 in UTC.
        """
        assert self._run is not None
        run, self._run = self._run, None
        self._zeroed_since = {}
        zeros = None if self.fingertips is None else self.fingertips.end_zero()
        known = self._known()

        def compute() -> Calibration:
            found = run.calibrator.finish(self.configuration, time, known)
            return found if zeros is None else with_zeros(found, zeros)

        return compute

    def _known(self) -> Known | None:
        """Return what is known of the skin now, if there is a calibration."""
        if self.calibration is None or self._pipeline is None:
            return None
        zeroed = np.ones(self.layout.n_taxels, np.bool_)
        for board in self.boards:
            veto = self.intake.veto.get(self.ledger.row[board])
            if veto is not None:
                taxels = self._taxels_of(board)
                zeroed[taxels[veto & (taxels >= 0)]] = False
        if self._held is not None:
            zeroed &= ~self._held
        return Known(self.calibration, self._pipeline.baseline.copy(), zeroed)

    def feed(self, bus: str, batch: FrameBatch) -> Output:
        """Process a batch of frames of one bus."""
        samples: list[tuple[int, int]] = []
        grasps, self._ended = self._ended, []
        if self.fingertips is not None:
            felt = self.fingertips.feed(bus, batch, self.ledger.now_ns)
            samples = felt.samples
            grasps += felt.events
        sweeps, answers = self.assemblers[bus].feed(batch)
        taken = self._take(sweeps) if sweeps else []
        return Output(sweeps, self._process(taken) if taken else [], samples, grasps, answers)

    def feed_long(self, bus: str, batch: FrameBatch) -> Iterator[Output]:
        """Process a batch that spans many sweeps; yield a result for each, as if it came alone.

        For skins without fingertips, whose results would have to be put between them.
        """
        for sweep in self.assemblers[bus].feed(batch).sweeps:
            yield Output([sweep], self._process(self._take([sweep])), [], [], [])

    def judge(self) -> None:
        """Do deferred work, if there is any, so that the next sweep does not wait for it."""
        self.intake.judge_whole()

    def expire(self, now_ns: int) -> Output:
        """Return what has waited too long, on the clock of the frames' time stamps.

        Everything received up to `now_ns` has been fed.
        """
        self.ledger.look(now_ns)
        sweeps = [
            sweep for assembler in self.assemblers.values() for sweep in assembler.expire(now_ns)
        ]
        grasps, self._ended = self._ended, []
        if self.fingertips is not None:
            grasps += self.fingertips.expire(now_ns, self.ledger.now_ns)
        samples = self._take(sweeps)
        samples += self.intake.expire(now_ns)
        return Output(sweeps, self._process(samples) if samples else [], [], grasps, [])

    def clock_set(self, step_ns: int) -> None:
        """Take no time for passed that the clock of the time stamps was set forward by.

        Without this a gap in time stamps is time in which the computer may have slept.
        """
        if self._pipeline is not None:
            self._pipeline.clock_set(step_ns)

    def flush(self) -> Output:
        """Return everything that waits, at the end of a recording."""
        sweeps = [sweep for assembler in self.assemblers.values() for sweep in assembler.flush()]
        grasps, self._ended = self._ended, []
        steps = self._process(self._take(sweeps) + self.intake.flush())
        return Output(sweeps, steps, [], grasps, [])

    def hold(self, boards: list[int]) -> None:
        """Report no taxel of some boards as valid until they are zeroed and their zero is found.

        Their zero may be another than the calibration's: since that was taken, an earlier start of
        the daemon may have zeroed them. What seems to touch them is noted all the same.
        """
        self._releasing.difference_update(boards)
        held = self.taxels_of(boards)
        self._held = held if self._held is None else self._held | held

    def release(self, boards: list[int]) -> None:
        """Report taxels of some boards as valid again: they are zeroed, or cannot be."""
        if self._held is not None:
            left: Mask = self._held & ~self.taxels_of(boards)
            self._held = left if any_of(left) else None

    def rezero(self, board: int, believed: bool = True) -> int:
        """Find the new untouched readings after a board was zeroed.

        For two seconds, longer for slow boards, none of its taxels is valid, and noisy ones are not
        for up to six. Taxels that were touched just before stay invalid until they are calibrated,
        and those whose noise reaches the end of the scale until they are zeroed again.

        Args:
            board: its index.
            believed: whether touches just before are real. Touches of a board that was not set up,
                by this start of the daemon or an earlier one, are not.

        Returns:
            How many taxels were touched.
        """
        taxels = self._taxels_of(board)
        self._silent_zeros.pop(board, None)
        self._releasing.add(board)
        if self._zeroed_since is not None:
            self._zeroed_since[board] = believed
        if self._run is not None:
            # A calibration of two zeros would be that of none, and the rest of its time too short
            # for noisy pads.
            self._run.calibrator.forget(np.flatnonzero(self.taxels_of([board])))
            self._run.passed_ns = 0
            for sender in self._run.samples:
                if sender[0] == board:
                    self._run.samples[sender] = 0
        if self.calibration is None:
            return 0
        before = self._rezeros.get(board)
        fitted = taxels >= 0
        if believed:
            touched = fitted & (self._last_touched[taxels] | self._glimpsed(board))
        else:
            touched = np.zeros_like(fitted)
            self._last_touched[taxels[fitted]] = False
        self._glimpses.pop(board, None)
        if before is not None:
            touched |= before.unknown.reshape(TRIANGLES, PADS)
        own = self.layout.boards[board].settings
        no_load = np.full(taxels.size, float(own.no_load))
        wanted = None
        if self._pipeline is not None:
            seconds = look_s(self.calibration.spread, self._pipeline.enter)[taxels.ravel()]
            wanted = np.ceil(seconds * 1e3 / own.period_ms).astype(np.int64)
        period_s = own.period_ms * 1e-3
        self._rezeros[board] = Rezero(
            touched.ravel(), no_load, fitted.ravel(), wanted, period_s, believed
        )
        self.intake.veto[self.ledger.row[board]] = np.ones((TRIANGLES, PADS), np.bool_)
        self.zero_changes += 1
        return int(np.count_nonzero(touched))

    def doubt(self, taxels: Mask) -> None:
        """The zero of these taxels, bool[n], is not known from before: see `rezero`."""
        for board in self.boards:
            mine = self._taxels_of(board)
            doubted = taxels[mine] & (mine >= 0)
            if doubted.any():
                self.rezero(board)
                if board in self._rezeros:
                    self._rezeros[board].doubted |= doubted.ravel()

    def zero_at_risk(self, touched: bool) -> Mask:
        """Return taxels bool[n] whose zero will not be known; with `touched`, also those which are
        touched: after another zero, theirs would not be.
        """
        found = self._last_touched.copy() if touched else np.zeros_like(self._touched)
        for board in self._glimpses if touched else ():
            found[self._taxels_of(board)[self._glimpsed(board)]] = True
        for board, rezero in self._rezeros.items():
            found[self._taxels_of(board).ravel()[rezero.unknown]] = True
        return found

    def may_be_touched(self) -> Mask:
        """Return taxels bool[n] that something may touch, because their zero is not known, or not
        yet while their board is in use again.
        """
        found = self.zero_at_risk(touched=False)
        for board, rezero in self._rezeros.items():
            if rezero.late is not None:
                found[self._taxels_of(board).ravel()[rezero.late]] = True
        return found

    def cut_off(self) -> Mask:
        """Return taxels bool[n] whose noise reaches the end of the scale since they were zeroed."""
        found = np.zeros(self.layout.n_taxels, np.bool_)
        for board, rezero in self._rezeros.items():
            found[self._taxels_of(board).ravel()[rezero.cut_off]] = True
        return found

    def unreached(self, touch: TouchSettings) -> Mask:
        """Return the taxels bool[n] that no reading would touch any more by other thresholds."""
        if self.calibration is None or self._pipeline is None:
            return np.zeros(self.layout.n_taxels, np.bool_)
        processing = msgspec.structs.replace(self.settings.processing, touch=touch)
        found = unreached(self.layout, processing, self.calibration)
        return found & ~self._pipeline.unreached

    def in_doubt(self, board: int) -> NDArray[np.bool_]:
        """Return taxels bool[16, 12] of a board whose zero is unknown."""
        found = np.zeros((TRIANGLES, PADS), np.bool_)
        if board in self._rezeros:
            found |= self._rezeros[board].unknown.reshape(TRIANGLES, PADS)
        if board in self._below:
            found |= self._below[board] > 0
        return found

    def compares(self, board: int) -> bool:
        """Return whether it was not known before a board's last sweep if it zeroed itself while it
        was silent.
        """
        return board in self._silent_zeros

    def paused(self, board: int) -> bool:
        """Return whether `compares` holds for a board that had not timed out."""
        silent_zero = self._silent_zeros.get(board)
        if silent_zero is None:
            return False
        limit_ns = int(self.ledger.silent_after_ns[self.ledger.row[board]])
        return silent_zero.silent_s * 1e9 <= limit_ns

    def doubts(self) -> dict[int, int]:
        """Return how many taxels of each board that was zeroed have an unknown zero, by index."""
        return {
            board: int(np.count_nonzero(self.in_doubt(board)))
            for board in sorted(self._rezeros.keys() | self._below.keys())
        }

    def end_part(self, part: int, t_ns: int) -> list[Touch]:
        """End every contact of a part."""
        seq = self._pipeline.seq(part) if self._pipeline else 0
        events = self._trackers[part].end_all(seq, t_ns)
        if self.fingertips is not None:
            self.fingertips.note_skin(part, events, t_ns)
        return events

    def _taxels_of(self, board: int) -> NDArray[np.int32]:
        return self.layout.boards[board].taxel_index

    def _take(self, sweeps: list[Sweep]) -> list[PartSample]:
        samples: list[PartSample] = []
        for sweep in sweeps:
            silent_ns = self.ledger.silent_ns(sweep.board) if self.ledger.any_silent else 0
            if sweep.missed and not silent_ns:
                silent_ns = self.ledger.zeroing_ns(sweep)
            row = self.ledger.note(sweep)
            if silent_ns:
                self._note_return(sweep, silent_ns)
            if self.ledger.flagged[row] or self._unanswered:
                self._note_unanswered(sweep, row)
            if row in self.ledger.twice:
                self._note_twice(sweep, row)
                samples += self.intake.take(sweep, row)
                continue
            if self.ledger.flagged[row] or self._below:
                self._note_below_zero(sweep, row)
            if self._rezeros:
                rezero = self._rezeros.get(sweep.board)
                if rezero is not None:
                    self._find_zero(sweep, row, rezero)
            if self._silent_zeros:
                silent_zero = self._silent_zeros.get(sweep.board)
                if silent_zero is not None:
                    self._find_silent_zero(sweep, row, silent_zero)
            if self._rezeros or self._silent_zeros or self._glimpses:
                self._note_glimpse(sweep, row)
            samples += self.intake.take(sweep, row)
        return samples

    def _note_twice(self, sweep: Sweep, row: int) -> None:
        """Two boards send at an address: what both send is the zero of neither."""
        if self._run is not None:
            self._run.calibrator.forget(np.flatnonzero(self.taxels_of([sweep.board])))
        self._glimpses.pop(sweep.board, None)
        rezero = self._rezeros.get(sweep.board)
        if rezero is None:
            return
        # What differed was another board's, and no press.
        rezero.moved[:] = False
        if rezero.found_since(self.ledger.twice[row]):
            self.rezero(sweep.board)
        else:
            rezero.restart(sweep.t_ns)

    def _note_unanswered(self, sweep: Sweep, row: int) -> None:
        """Detect that a board zeroed itself, which it does after missing acknowledges (section
        4.5).
        """
        now = self.ledger.error[row] & StatusError.NO_ACK != 0
        before = self._unanswered.get(sweep.board)
        if before is not None:
            # Nobody knows of a triangle that was not received.
            now |= before & ~self.ledger.present[row]
        if any_of(now):
            self._unanswered[sweep.board] = now
        else:
            self._unanswered.pop(sweep.board, None)
        if before is not None and any_of(before & ~now):
            self.rezero(sweep.board)

    def _note_return(self, sweep: Sweep, silent_ns: int) -> None:
        """A board sends again: for half a second, see whether it zeroed itself meanwhile."""
        rezero = self._rezeros.get(sweep.board)
        if rezero is not None:
            rezero.restart(sweep.t_ns)
        # What was set up since it was received last has a new zero, and one that is still sought
        # is that of the board as it is now.
        sought = rezero is not None and rezero.seeks_all
        if self._pipeline is None or self.calibration is None or sought:
            return
        taxels = self._taxels_of(sweep.board).ravel()
        known = (taxels >= 0) & self.calibration.usable[taxels] & ~self._last_touched[taxels]
        known &= ~self.in_doubt(sweep.board).ravel()
        if rezero is not None:
            known &= ~rezero.cut_off
            if rezero.late is not None:
                known &= ~rezero.late
        own = self.layout.boards[sweep.board].settings
        self._silent_zeros[sweep.board] = SilentZero(
            self._pipeline.baseline[taxels],
            self.calibration.noise[taxels],
            self.calibration.spread[taxels],
            known,
            float(own.no_load),
            own.period_ms * 1e-3,
            silent_ns * 1e-9,
        )

    def _find_silent_zero(self, sweep: Sweep, row: int, silent_zero: SilentZero) -> None:
        if silent_zero.decided:
            # Its last sweep is in a sample of its part by now.
            del self._silent_zeros[sweep.board]
            return
        ledger = self.ledger
        here = np.repeat(ledger.present[row] & (ledger.error[row] == 0), PADS)
        zeroed = silent_zero.step(sweep.raw.ravel(), here & ~ledger.far[row].ravel(), sweep.t_ns)
        if zeroed is None:
            self.intake.veto[row] = np.ones((TRIANGLES, PADS), np.bool_)
            return
        if zeroed:
            # What was read since is of the new zero.
            self._glimpses.pop(sweep.board, None)
            self.rezero(sweep.board)
            return
        rezero = self._rezeros.get(sweep.board)
        if rezero is None:
            self.intake.veto.pop(row, None)
        else:
            self._veto_unknown(sweep, row, rezero)

    def _note_glimpse(self, sweep: Sweep, row: int) -> None:
        """Keep what a board sends while its taxels are not valid, and until their touches are
        decided: whatever presses them meanwhile must not become a zero unnoticed.
        """
        rezero = self._rezeros.get(sweep.board)
        blind = sweep.board in self._silent_zeros
        blind |= rezero is not None and rezero.unsettled(sweep.t_ns) is not None
        glimpse = self._glimpses.get(sweep.board)
        own = self.layout.boards[sweep.board].settings
        if glimpse is None:
            if not blind:
                return
            longest = math.ceil(GLIMPSED * repeats_of(own.period_ms * 1e-3))
            glimpse = self._glimpses[sweep.board] = _Glimpse(deque(maxlen=longest))
        if blind:
            glimpse.until_ns = sweep.t_ns + DECIDED_NS
        elif not 0 <= glimpse.until_ns - sweep.t_ns <= DECIDED_NS:
            del self._glimpses[sweep.board]
            return
        ledger = self.ledger
        here = (ledger.present[row] & (ledger.error[row] == 0))[:, None] & ~ledger.far[row]
        units = np.where(here, float(own.no_load) - sweep.raw, -np.inf)
        glimpse.units.append(units.ravel())

    def _glimpsed(self, board: int) -> Mask:
        """Return taxels bool[16, 12] of a board that something presses by its last readings, while
        no touch could be decided.
        """
        glimpse = self._glimpses.get(board)
        calibration, pipeline = self.calibration, self._pipeline
        pressed = np.zeros((TRIANGLES, PADS), np.bool_)
        if glimpse is None or calibration is None or pipeline is None:
            return pressed
        if len(glimpse.units) < GLIMPSED:
            return pressed
        taxels = self._taxels_of(board).ravel()
        spread = np.maximum(calibration.spread, calibration.noise)[taxels]
        baseline = pipeline.baseline[taxels]
        repeats = repeats_of(self.layout.boards[board].settings.period_ms * 1e-3)
        highest, error = highest_rest(baseline, spread, repeats)
        rezero = self._rezeros.get(board)
        if rezero is not None and not rezero.believed:
            # What it was set up to send before had other rests.
            baseline = rezero.lowest()
            highest = baseline + STEADY_UNITS + error
        highest = np.maximum(highest, baseline + pipeline.enter[taxels])
        fit = (taxels >= 0) & calibration.usable[taxels]
        pressed[:] = (fit & (np.median(glimpse.units, axis=0) > highest)).reshape(pressed.shape)
        return pressed

    def _note_below_zero(self, sweep: Sweep, row: int) -> None:
        """Detect pads whose zero was taken while something pressed that has lifted now."""
        answered = (self.ledger.error[row] == 0) & self.ledger.present[row]
        below = below_zero(sweep.raw, self.ledger.far[row] & answered[:, None])
        before = self._below.pop(sweep.board, None)
        no_load = float(self.layout.boards[sweep.board].settings.no_load)
        if before is not None:
            back = (before > 0) & (before < BELOW_SWEEPS) & answered[:, None]
            if sweep.board in self._rezeros:
                # What is known to have been pressed comes back when it is pressed again.
                back &= ~self._rezeros[sweep.board].unknown.reshape(TRIANGLES, PADS)
            if any_of(back & (sweep.raw < (no_load + 255) / 2)):
                # What was pressed and lifts stays below zero; what a bad wire brings does not.
                self._jumped_ns[sweep.board] = sweep.t_ns
        jumps = 0 <= sweep.t_ns - self._jumped_ns.get(sweep.board, -JUMPS_NS) < JUMPS_NS
        if self.calibration is None or jumps or not any_of(below):
            return
        lasted = below.astype(np.int64) if before is None else (before + 1) * below
        self._below[sweep.board] = lasted
        sure = lasted >= BELOW_SWEEPS
        if any_of(sure):
            if sweep.board not in self._rezeros:
                self._rezeros[sweep.board] = Rezero.over(np.full(sure.size, no_load), sweep.t_ns)
            doubted = self._rezeros[sweep.board].doubted
            if any_of(sure.ravel() & ~doubted):
                doubted |= sure.ravel()
                self.zero_changes += 1

    def _find_zero(self, sweep: Sweep, row: int, rezero: Rezero) -> None:
        if self._pipeline is None or self.calibration is None:
            return
        ledger = self.ledger
        here = np.repeat(ledger.present[row] & (ledger.error[row] == 0), PADS)
        ledger.rezeros[row] += not rezero.begun
        far, touched = ledger.far[row].ravel(), row in self.intake.touched
        if rezero.step(sweep.raw.ravel(), here, far, sweep.t_ns, touched):
            taxels = self._taxels_of(sweep.board).ravel()
            baseline = np.where(taxels >= 0, self._pipeline.baseline[taxels], 0.0)
            calibration = self.calibration
            noise = calibration.noise[taxels]
            spread = np.maximum(calibration.spread[taxels], noise)
            spread[~calibration.usable[taxels]] = np.inf
            found, baseline = rezero.finish(baseline, noise, spread)
            self._pipeline.set_zero(taxels[found], baseline[found])
            self.zeros_found += any_of(found)
            self.zero_changes += 1
        if rezero.settled(sweep.t_ns):
            if sweep.board in self._releasing:
                self._releasing.discard(sweep.board)
                self.release([sweep.board])
            self._veto_unknown(sweep, row, rezero)
            return
        # What jumps while a board is set up was not damaged on its way.
        self.intake.note_gap(row)

    def _veto_unknown(self, sweep: Sweep, row: int, rezero: Rezero) -> None:
        """Taxels whose zero is not known, or not yet, are not valid."""
        veto = self.in_doubt(sweep.board)
        veto |= rezero.cut_off.reshape(TRIANGLES, PADS)
        unsettled = rezero.unsettled(sweep.t_ns)
        if unsettled is not None:
            veto |= unsettled.reshape(TRIANGLES, PADS)
        self.intake.veto[row] = veto

    def _process(self, samples: list[PartSample]) -> list[Step]:
        steps = []
        for sample in samples:
            if self._run is not None:
                self._collect(self._run, sample)
            if self._pipeline is None:
                continue
            if sample.part in self.disabled:
                # What touches it is not published, but must not become a zero, and it drifts.
                frame = self._pipeline.follow(sample.part, sample.raw, sample.present, sample.t_ns)
                self._note_touched(sample.part, frame)
            else:
                frame = self._pipeline.step(
                    sample.part,
                    sample.raw,
                    sample.present,
                    sample.t_ns,
                    pressures=sample.part not in self.touch_only,
                )
                self._note_touched(sample.part, frame)
                if self._held is not None:
                    frame = self._without(frame, sample.part, self._held)
                events = self._trackers[sample.part].step(frame)
                if self.fingertips is not None:
                    self.fingertips.note_skin(sample.part, events, frame.t_ns)
                steps.append(Step(sample.part, frame, events))
        return steps

    def _without(self, frame: PressureFrame, index: int, held: Mask) -> PressureFrame:
        """Return a frame of a part in which taxels bool[n] of the skin are not valid."""
        part = self.layout.parts[index]
        fit = ~held[part.start : part.stop]
        return replace(
            frame,
            pressure_kpa=frame.pressure_kpa * fit,
            touched=frame.touched & fit,
            valid=frame.valid & fit,
            beyond_range=frame.beyond_range & fit,
        )

    def _note_touched(self, index: int, frame: PressureFrame) -> None:
        """Pass the touched pads to the liveness decision, but only when they change."""
        noted = self._noted.get(index)
        if noted is not None and noted[0] is frame.touched and noted[1] is frame.valid:
            return
        self._noted[index] = frame.touched, frame.valid
        part = self.layout.parts[index]
        touched = self._touched[part.start : part.stop]
        np.copyto(self._last_touched[part.start : part.stop], frame.touched, where=frame.valid)
        if touched.tobytes() == frame.touched.tobytes():
            return
        touched[:] = frame.touched
        for board in part.boards:
            taxels = self._taxels_of(board)
            pads = self._touched[taxels] & (taxels >= 0)
            row = self.ledger.row[board]
            if any_of(pads):
                self.intake.touched[row] = pads
            else:
                self.intake.touched.pop(row, None)

    def _collect(self, run: _CalibrationRun, sample: PartSample) -> None:
        if not any_of(sample.received):
            return
        interval_ns = 0 if run.last_ns is None else sample.t_ns - run.last_ns
        if 0 < interval_ns <= LONGEST_INTERVAL_NS:
            run.passed_ns += interval_ns
        # Samples of several parts come in any order, by much less.
        if run.last_ns is None or interval_ns > 0 or interval_ns < -LONGEST_INTERVAL_NS:
            run.last_ns = sample.t_ns
        senders = [(board, sample.part) for board in self._sent(sample)]
        samples = [run.samples.setdefault(sender, 0) for sender in senders]
        if run.passed_ns <= run.duration_ns or min(samples) < run.fewest:
            run.calibrator.add(sample.part, sample.raw, sample.received, sample.t_ns)
            for sender in senders:
                run.samples[sender] += 1

    def _sent(self, sample: PartSample) -> list[int]:
        """Return the boards of which a sample has any value."""
        part = self.layout.parts[sample.part]
        if len(part.boards) == 1:
            return list(part.boards)
        triangles = np.unique(self.layout.triangle_of[part.start : part.stop][sample.received])
        return sorted({self.layout.triangles[triangle].board for triangle in triangles.tolist()})


def _fingertips(settings: Settings, layout: Layout, parts: list[int]) -> "FingertipEngine | None":
    """Those of these parts' nodes; most skins have none, and do not need what they need."""
    if not settings.fingertips:
        return None
    from skin_host.fingertip.engine import FingertipEngine

    made = FingertipEngine(settings, layout, parts)
    return made if made.tips else None
