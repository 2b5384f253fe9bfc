"""Turns CAN frames into pressure and touch events: runs the pure packages in order.

One engine serves both the daemon and the replay of recordings. It has no clock and no socket: it
takes frames and times, and returns frames of pressure and events.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Assembler, Sweep
from skin_host.bus.ledger import BoardLedger
from skin_host.bus.wire import FrameBatch
from skin_host.config.settings import Settings, TouchSettings, skin_hash
from skin_host.fingertip.events import FingertipEvent
from skin_host.layout import Layout
from skin_host.processing.board_zeros import BoardZeros
from skin_host.processing.calibration import Calibration, Verdict, with_zeros
from skin_host.processing.calibration.calibrator import KNOWN_SAMPLES, Calibrator, Known
from skin_host.processing.calibration.run import CalibrationRun
from skin_host.processing.contacts import ContactTracker, Decision
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from skin_host.processing.intake import Intake, PartSample
from skin_host.processing.masks import Mask
from skin_host.processing.pipeline import Pipeline
from skin_host.processing.pressure import PressureCurve, vertex
from skin_host.processing.rules import Rules
from skin_host.processing.touch import Levels

if TYPE_CHECKING:
    from skin_host.fingertip.engine import FingertipEngine

#: Waiting sweeps and samples are checked this often, see `Engine.expire`.
EXPIRE_NS = 20_000_000


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
        zeros: what is known of their zeros.
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
                    frozenset(
                        board.settings.address
                        for i, board in enumerate(layout.boards)
                        if board.settings.bus == bus and i not in self.boards
                    ),
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
        self.zeros = BoardZeros(layout, self.boards, self.ledger, self.intake, self._note_zeroed)
        #: The calibration that is being taken, or has been collected and is not in use yet.
        self._run: CalibrationRun | None = None
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
        self.zeros.go_on(after.zeros)
        self._run = after._run
        self.calibration = after.calibration
        self._pipeline = after._pipeline
        if self.calibration is not None:
            former = None if self._pipeline is None else self._pipeline.levels
            self._renew_pipeline(np.zeros(self.layout.n_taxels, np.bool_))
            if former is not None:
                self._note_former(former, after.settings.processing.touch.votes_of_3)

    def _note_former(self, former: Levels, votes: int) -> None:
        """Note how the touches were decided that there are now, if it is another way from now on.

        Args:
            former: the levels of all taxels before.
            votes: least number of measurements for a touch before.
        """
        assert self._pipeline is not None
        levels, votes_now = self._pipeline.levels, self.settings.processing.touch.votes_of_3
        if votes == votes_now and all(
            np.array_equal(now, before)
            for now, before in ((levels.leave, former.leave), (levels.hold, former.hold))
        ):
            return
        kpa = self._pipeline.kpa
        leave_kpa, enter_kpa = kpa(former.leave), kpa(levels.enter)
        hold_kpa = kpa(former.leave + former.hold) - leave_kpa
        span_kpa = kpa(levels.enter + levels.span) - enter_kpa
        for part in self.parts:
            mine = slice(self.layout.parts[part].start, self.layout.parts[part].stop)
            self._trackers[part].note_former(
                Decision(leave_kpa[mine], hold_kpa[mine], votes),
                Decision(enter_kpa[mine], span_kpa[mine], votes_now),
            )

    @property
    def pipeline(self) -> Pipeline | None:
        """The pipeline in use, if there is a calibration."""
        return self._pipeline

    @property
    def calibrating(self) -> bool:
        """Whether a calibration is being taken."""
        return self._run is not None and not self._run.is_over

    def use(self, calibration: Calibration, boards: list[int] | None = None) -> None:
        """Use this calibration from now on; frame numbers continue.

        Args:
            calibration: the new one.
            boards: those whose zero it has measured; all by default.
        """
        self.calibration = calibration
        boards = self.boards if boards is None else boards
        noise = np.where(calibration.verdict < Verdict.ABSENT, calibration.noise, np.nan)
        curves = calibration.curves
        pressed = None if curves is None else np.where(curves.own, curves.noise_units, np.nan)
        self.intake.use(noise, np.isin(self.boards, boards), pressed)
        if self.fingertips is not None and boards == self.boards:
            self._ended += self.fingertips.use(calibration.zeros)
        self.zeros.calibrated(calibration, boards)
        zeroed = self.layout.taxels_of(boards)
        self._renew_pipeline(zeroed)
        for part in self.parts:
            mine = slice(self.layout.parts[part].start, self.layout.parts[part].stop)
            self._trackers[part].note_zeroed(zeroed[mine])
        run = self._run
        if run is not None and run.is_over:
            self._run = None
            for board, believed in run.zeroed.items():
                if board in boards:
                    self.zeros.rezero(board, believed)

    def _renew_pipeline(self, zeroed: NDArray[np.bool_]) -> None:
        """Apply settings and calibration to the pipeline; taxels bool[n] were zeroed."""
        assert self.calibration is not None
        processing = self.settings.processing
        if self._pipeline is None:
            self._pipeline = Pipeline(self.layout, processing, self.calibration)
        else:
            self._pipeline.renew(processing, self.calibration, zeroed, self.layout)
        self.zeros.adopt(self.calibration, self._pipeline)

    def _note_zeroed(self, board: int, believed: bool) -> None:
        if self._run is not None:
            self._run.note_zeroed(board, believed)

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
        self._run = CalibrationRun(self.layout, calibrator, seconds, fewest)
        if self.fingertips is not None:
            self.fingertips.begin_zero()

    def calibration_progress(self) -> float:
        """Share of the wanted time, and of the fewest samples, that has been collected, 0 to 1."""
        run = self._run
        return 0.0 if run is None or run.is_over else run.progress

    @property
    def calibration_begun_again(self) -> int:
        """How often a board that a calibration has samples of was zeroed, of that with the most."""
        return 0 if self._run is None else max(self._run.begun_again.values(), default=0)

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
        pressed = self.zeros.pressed() | self.zeros.felt
        finish = self._run.end(self.configuration, time, self._known(), pressed)
        zeros = None if self.fingertips is None else self.fingertips.end_zero()

        def compute() -> Calibration:
            found = finish()
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
                taxels = self.layout.boards[board].taxel_index
                zeroed[taxels[veto & (taxels >= 0)]] = False
        if self.zeros.held is not None:
            zeroed &= ~self.zeros.held
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

    def take(self, sweep: Sweep) -> Output:
        """Process a sweep of a long batch that its bus's assembler was fed, as if it came alone.

        For skins without fingertips, whose results would have to be put between those of sweeps.
        """
        return Output([sweep], self._process(self._take([sweep])), [], [], [])

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
        for assembler in self.assemblers.values():
            assembler.clock_set(step_ns)
        if self._pipeline is not None:
            self._pipeline.clock_set(step_ns)

    def flush(self) -> Output:
        """Return everything that waits, at the end of a recording."""
        sweeps = [sweep for assembler in self.assemblers.values() for sweep in assembler.flush()]
        grasps, self._ended = self._ended, []
        steps = self._process(self._take(sweeps) + self.intake.flush())
        return Output(sweeps, steps, [], grasps, [])

    def unreached(self, touch: TouchSettings) -> Mask:
        """Return the taxels bool[n] that no reading would touch any more by other thresholds."""
        if self.calibration is None or self._pipeline is None:
            return np.zeros(self.layout.n_taxels, np.bool_)
        processing = msgspec.structs.replace(self.settings.processing, touch=touch)
        found = Rules.of(self.layout, processing, self.calibration).unreached
        return found & ~self._pipeline.unreached

    def usable(self) -> Mask | None:
        """Return the taxels bool[n] that can be valid, now or later; None without a calibration."""
        if self.calibration is None or self._pipeline is None:
            return None
        return self.calibration.usable & ~self.zeros.cut_off() & ~self._pipeline.unreached

    def measurements(self) -> NDArray[np.int64] | None:
        """Return in how many measurements each taxel int64[n] decides whether it is touched; 0: it
        cannot be valid, now or later. None without a calibration.
        """
        usable = self.usable()
        if usable is None or self._pipeline is None:
            return None
        return np.where(usable, self._pipeline.measurements, 0)

    def stuck(self) -> Mask:
        """Return the taxels bool[n] whose pads are stuck in a living triangle."""
        found = np.zeros(self.layout.n_taxels, np.bool_)
        taxels = self.intake.taxels
        found[taxels[self.intake.liveness.stuck & (taxels >= 0)]] = True
        return found

    def expect_stuck(self, taxels: Mask) -> None:
        """These taxels, bool[n], were stuck before a restart: they are not valid before their pads
        have shown that they live. Nothing has been fed yet.
        """
        of_pads = self.intake.taxels
        self.intake.liveness.expect_stuck(taxels[of_pads] & (of_pads >= 0))

    def end_part(self, part: int, t_ns: int) -> list[Touch]:
        """End every contact of a part."""
        seq = self._pipeline.seq(part) if self._pipeline else 0
        events = self._trackers[part].end_all(seq, t_ns)
        if self.fingertips is not None:
            self.fingertips.note_skin(part, events, t_ns)
        return events

    def _take(self, sweeps: list[Sweep]) -> list[PartSample]:
        samples: list[PartSample] = []
        for sweep in sweeps:
            silent_ns = self.ledger.silent_ns(sweep.board) if self.ledger.any_silent else 0
            if sweep.missed and not silent_ns:
                silent_ns = self.ledger.zeroing_ns(sweep)
            row = self.ledger.note(sweep)
            self.zeros.note(sweep, row, silent_ns)
            if self._run is not None:
                unclear = self.zeros.unclear(sweep.board)
                if unclear is not None:
                    self._run.forget(unclear)
            if not self.ledger.is_excess(row):
                samples += self.intake.take(sweep, row)
        return samples

    def _process(self, samples: list[PartSample]) -> list[Step]:
        steps = []
        for sample in samples:
            if self._run is not None:
                self._run.add(sample)
            if self._pipeline is None:
                continue
            if sample.part in self.disabled:
                # What touches it is not published, but must not become a zero, and it drifts.
                frame = self._pipeline.follow(sample.part, sample.raw, sample.present, sample.t_ns)
                self.zeros.note_frame(sample.part, frame)
            else:
                frame = self._pipeline.step(
                    sample.part,
                    sample.raw,
                    sample.present,
                    sample.t_ns,
                    pressures=sample.part not in self.touch_only,
                )
                self.zeros.note_frame(sample.part, frame)
                frame = self.zeros.without_held(frame, sample.part)
                events = self._trackers[sample.part].step(frame)
                if self.fingertips is not None:
                    self.fingertips.note_skin(sample.part, events, frame.t_ns)
                steps.append(Step(sample.part, frame, events))
        return steps


def _fingertips(settings: Settings, layout: Layout, parts: list[int]) -> "FingertipEngine | None":
    """Those of these parts' nodes; most skins have none, and do not need what they need."""
    if not settings.fingertips:
        return None
    from skin_host.fingertip.engine import FingertipEngine

    made = FingertipEngine(settings, layout, parts)
    return made if made.tips else None
