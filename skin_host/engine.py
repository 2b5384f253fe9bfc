"""From CAN frames to pressure and touch events: the pure rooms in their order.

One engine serves the daemon and the replay of recordings alike. It owns no clock and no
socket: frames and times go in, frames of pressure and events come out.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Assembler, Sweep
from skin_host.bus.protocol import TRIANGLES, FrameBatch, StatusError, status_error
from skin_host.bus.protocol.compensation import thermal_gains
from skin_host.fingertip.engine import FingertipEngine
from skin_host.layout import Layout
from skin_host.processing.calibration import Calibration, Calibrator, with_zeros
from skin_host.processing.contacts import ContactTracker, TouchEvent
from skin_host.processing.intake import Intake, PartSample
from skin_host.processing.liveness import PADS, Liveness
from skin_host.processing.pipeline import Pipeline, PressureFrame
from skin_host.processing.pressure import vertex
from skin_host.processing.repeats import Repeats
from skin_host.processing.rezero import Rezero
from skin_host.settings import Settings, skin_hash

#: A calibration takes at least so many samples of each part, however slow its boards: the 95th
#: percentile of less is the largest.
FEWEST_SAMPLES = 20


@dataclass(frozen=True, slots=True)
class Step:
    """What one sample of a part came to.

    Attributes:
        part: index into `Layout.parts`.
        frame: its pressure.
        events: what its contacts did.
    """

    part: int
    frame: PressureFrame
    events: list[TouchEvent]


@dataclass(slots=True)
class _CalibrationRun:
    calibrator: Calibrator
    duration_ns: int
    since_ns: int | None = None
    last_ns: int = 0
    #: By part, of those that have sent any.
    samples: dict[int, int] = field(default_factory=dict)


class Engine:
    """Assemblers, intake, pipeline and contact trackers of one daemon's share of a skin.

    Args:
        settings: the configuration.
        layout: its skin.
        parts: indices of the parts that this node reads.
        calibration: of this skin, or None: then nothing comes out until one is taken.

    Attributes:
        boards: indices of the boards that feed these parts.
        assemblers: of each bus, by its name.
        sweeps: those that the last call completed.
        liveness: who watches the bytes of each board, by its index.
        disabled: parts of which nothing is to come out.
        touch_only: parts whose pressures nobody wants while nothing touches them.
        rezeros: how often each board, by its index, has taken a new zero.
        fingertips: those of these parts' nodes, if there are any.
    """

    def __init__(
        self,
        settings: Settings,
        layout: Layout,
        parts: list[int],
        calibration: Calibration | None = None,
    ) -> None:
        self.settings = settings
        self.layout = layout
        self.parts = parts
        self.configuration = skin_hash(settings)
        self.calibration = calibration
        self.boards = sorted({board for part in parts for board in layout.parts[part].boards})
        made = FingertipEngine(settings, layout, parts) if settings.fingertips else None
        self.fingertips = made if made is not None and made.tips else None
        buses = {layout.boards[i].settings.bus for i in self.boards}
        if self.fingertips is not None:
            buses |= self.fingertips.buses
        self.assemblers = {
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
        self.sweeps: list[Sweep] = []
        self.disabled: set[int] = set()
        self.touch_only: set[int] = set()
        self.liveness = self._new_liveness(self.boards)
        curve = settings.processing.pressure
        self._intake = Intake(
            layout,
            parts,
            settings.receive.silent_periods,
            self.liveness,
            float(vertex(curve.a_kpa_per_ff2, curve.b_kpa_per_ff)),
        )
        self.rezeros = dict.fromkeys(self.boards, 0)
        self._rezeros: dict[int, Rezero] = {}
        self._unanswered: dict[int, int] = {}
        self._touched = np.zeros(layout.n_taxels, np.bool_)
        self._run: _CalibrationRun | None = None
        self._pipeline: Pipeline | None = None
        self._trackers = {part: ContactTracker(layout, part, settings) for part in parts}
        if calibration is not None:
            self.use(calibration)

    @property
    def pipeline(self) -> Pipeline | None:
        """The pipeline in use, if there is a calibration."""
        return self._pipeline

    @property
    def calibrating(self) -> bool:
        """Whether a calibration is being taken."""
        return self._run is not None

    def use(self, calibration: Calibration, boards: list[int] | None = None) -> None:
        """Work with this calibration from now on; counting of frames goes on.

        Args:
            calibration: the new one.
            boards: those whose zero it has taken; all if not given.
        """
        self.calibration = calibration
        boards = self.boards if boards is None else boards
        self.liveness.update(self._new_liveness(boards))
        for board in boards:
            self._rezeros.pop(board, None)
            self._intake.veto.pop(board, None)
        if self.fingertips is not None and boards == self.boards:
            self.fingertips.use(calibration.zeros)
        self._renew_pipeline(self.taxels_of(boards))

    def renew(self) -> None:
        """Take over settings that have changed; the calibration and its drift stay.

        Contacts must have been ended before.
        """
        if self.calibration is not None:
            self._renew_pipeline(np.zeros(self.layout.n_taxels, np.bool_))

    def _renew_pipeline(self, zeroed: NDArray[np.bool_]) -> None:
        """A new pipeline; taxels bool[n] that were not zeroed keep their drifted baselines."""
        assert self.calibration is not None
        before = self._pipeline
        self._pipeline = Pipeline(
            self.layout, self.settings.processing, self.calibration, after=before
        )
        if before is not None:
            np.copyto(self._pipeline.baseline, before.baseline, where=~zeroed)

    def taxels_of(self, boards: list[int]) -> NDArray[np.bool_]:
        """Which taxels bool[n] of the skin some boards read."""
        found = np.zeros(self.layout.n_taxels, np.bool_)
        for board in boards:
            taxels = self._taxels_of(board)
            found[taxels[taxels >= 0]] = True
        return found

    def begin_calibration(self, seconds: float) -> None:
        """Collect samples from the next one on; see `end_calibration`."""
        calibrator = Calibrator(self.layout, self.settings.processing.calibration.percentile)
        self._run = _CalibrationRun(calibrator, int(seconds * 1e9))
        if self.fingertips is not None:
            self.fingertips.begin_zero()

    def calibration_progress(self) -> float:
        """Share of the wanted time, and of the fewest samples, that has been collected, 0 to 1."""
        run = self._run
        if run is None or run.since_ns is None:
            return 0.0
        time_share = (run.last_ns - run.since_ns) / run.duration_ns
        return min(1.0, time_share, min(run.samples.values()) / FEWEST_SAMPLES)

    def end_calibration(self, time: str) -> Calibration:
        """Turn what was collected into a calibration and stop collecting.

        Args:
            time: now, ISO 8601 in UTC.
        """
        assert self._run is not None
        run, self._run = self._run, None
        found = run.calibrator.finish(self.configuration, time)
        return found if self.fingertips is None else with_zeros(found, self.fingertips.end_zero())

    def feed(self, bus: str, batch: FrameBatch) -> list[Step]:
        """Take a batch of frames of one bus. `sweeps` holds those it completed."""
        if self.fingertips is not None:
            self.fingertips.feed(bus, batch)
        self.sweeps = self.assemblers[bus].feed(batch)
        return self._process(self._take(self.sweeps)) if self.sweeps else []

    def judge(self) -> None:
        """Do, while there is time, what the next sweep would have to wait for else."""
        self._intake.judge()

    def expire(self, now_ns: int) -> list[Step]:
        """Hand on what has waited too long, on the clock of the frames' time stamps."""
        self.sweeps = [
            sweep for assembler in self.assemblers.values() for sweep in assembler.expire(now_ns)
        ]
        if self.fingertips is not None:
            self.fingertips.expire(now_ns)
        samples = self._take(self.sweeps) + self._intake.expire(now_ns)
        return self._process(samples) if samples else []

    def flush(self) -> list[Step]:
        """Hand on everything that waits, at the end of a recording."""
        self.sweeps = [
            sweep for assembler in self.assemblers.values() for sweep in assembler.flush()
        ]
        return self._process(self._take(self.sweeps) + self._intake.flush())

    def rezero(self, board: int, believed: bool = True) -> int:
        """A board has taken a new zero: find out where its taxels read now.

        For two seconds, longer for slow boards, none of them is valid. Taxels that were touched
        just before stay invalid until they are calibrated.

        Args:
            board: its index.
            believed: whether touches that were seen just before are to be believed. Those of a
                board that was not set up are none.

        Returns:
            How many taxels those are.
        """
        if self.calibration is None:
            return 0
        taxels = self._taxels_of(board)
        touched: NDArray[np.bool_] = self._touched[taxels] & (taxels >= 0) & believed
        before = self._rezeros.get(board)
        if before is not None:
            touched |= before.doubted.reshape(TRIANGLES, PADS)
        no_load = np.full(taxels.size, float(self.layout.boards[board].settings.no_load))
        self._rezeros[board] = Rezero(touched.ravel(), no_load)
        self._intake.veto[board] = np.ones((TRIANGLES, PADS), np.bool_)
        return int(np.count_nonzero(touched))

    def in_doubt(self, board: int) -> NDArray[np.bool_]:
        """Taxels bool[16, 12] of a board whose zero nobody knows."""
        rezero = self._rezeros.get(board)
        if rezero is None:
            return np.zeros((TRIANGLES, PADS), np.bool_)
        return rezero.doubted.reshape(TRIANGLES, PADS)

    def end_part(self, part: int, t_ns: int) -> list[TouchEvent]:
        """End every contact of a part."""
        seq = self._pipeline.seq(part) if self._pipeline else 0
        events = self._trackers[part].end_all(seq, t_ns)
        if self.fingertips is not None:
            self.fingertips.note_skin(part, events, t_ns)
        return events

    def _new_liveness(self, boards: list[int]) -> dict[int, Liveness]:
        """Watchers for some boards; of what is used of each, the calibrated noise."""
        made = {}
        for board in boards:
            noise = None
            if self.calibration is not None:
                taxels = self._taxels_of(board)
                noise = np.where(taxels >= 0, self.calibration.noise[taxels], 0.0)
            settings = self.layout.boards[board].settings
            gains = [thermal_gains(settings.skin_type, number)[0] for number in range(TRIANGLES)]
            shifts = dict.fromkeys(range(TRIANGLES), 0)
            shifts |= {
                triangle.number: triangle.shift
                for triangle in self.layout.triangles
                if triangle.board == board
            }
            repeats = Repeats(
                gains,
                list(shifts.values()),
                settings.no_load,
                truncates=settings.model == "mtb3",
            )
            made[board] = Liveness(TRIANGLES, noise, settings.period_ms * 1e-3, repeats)
        return made

    def _taxels_of(self, board: int) -> NDArray[np.int32]:
        return self.layout.boards[board].taxel_index

    def _take(self, sweeps: list[Sweep]) -> list[PartSample]:
        for sweep in sweeps:
            if sweep.status.any() or self._unanswered:
                self._note_unanswered(sweep)
            if self._rezeros:
                rezero = self._rezeros.get(sweep.board)
                if rezero is not None:
                    self._find_zero(sweep, rezero)
        return self._intake.feed(sweeps)

    def _note_unanswered(self, sweep: Sweep) -> None:
        """A board whose missing acknowledges end has taken a new zero by itself (section 4.5)."""
        errors = status_error(sweep.status) & StatusError.NO_ACK
        now = int((errors != 0) @ (1 << np.arange(TRIANGLES)))
        before = self._unanswered.get(sweep.board, 0)
        if now:
            self._unanswered[sweep.board] = now
        else:
            self._unanswered.pop(sweep.board, None)
        if before & ~now & sweep.present:
            self.rezero(sweep.board)

    def _find_zero(self, sweep: Sweep, rezero: Rezero) -> None:
        if self._pipeline is None or self.calibration is None:
            return
        answers = sweep.present >> np.arange(TRIANGLES) & (status_error(sweep.status) == 0)
        here = np.repeat(answers.astype(np.bool_), PADS)
        self.rezeros[sweep.board] += not rezero.begun
        if rezero.step(sweep.raw.ravel(), here, sweep.t_ns):
            taxels = self._taxels_of(sweep.board).ravel()
            fitted = taxels >= 0
            baseline = np.where(fitted, self._pipeline.baseline[taxels], 0.0)
            found = rezero.finish(baseline, self.calibration.noise[taxels])
            self._pipeline.take_zero(taxels[fitted], found[fitted])
        elif rezero.settled(sweep.t_ns):
            self._intake.veto[sweep.board] = self.in_doubt(sweep.board)

    def _process(self, samples: list[PartSample]) -> list[Step]:
        steps = []
        for sample in samples:
            if self._run is not None:
                self._collect(self._run, sample)
            if self._pipeline is not None and sample.part not in self.disabled:
                frame = self._pipeline.step(
                    sample.part,
                    sample.raw,
                    sample.present,
                    sample.t_ns,
                    pressures=sample.part not in self.touch_only,
                )
                events = self._trackers[sample.part].step(frame)
                if self.fingertips is not None:
                    self.fingertips.note_skin(sample.part, events, frame.t_ns)
                self._note_touched(sample.part, frame)
                steps.append(Step(sample.part, frame, events))
        return steps

    def _note_touched(self, index: int, frame: PressureFrame) -> None:
        """Liveness must know which pads are touched, but only when that changes."""
        part = self.layout.parts[index]
        touched = self._touched[part.start : part.stop]
        if np.array_equal(touched, frame.touched):
            return
        touched[:] = frame.touched
        for board in part.boards:
            taxels = self._taxels_of(board)
            pads = self._touched[taxels] & (taxels >= 0)
            if pads.any():
                self._intake.touched[board] = pads
            else:
                self._intake.touched.pop(board, None)

    @staticmethod
    def _collect(run: _CalibrationRun, sample: PartSample) -> None:
        if not sample.received.any():
            return
        if run.since_ns is None:
            run.since_ns = sample.t_ns
        samples = run.samples.setdefault(sample.part, 0)
        in_time = 0 <= sample.t_ns - run.since_ns <= run.duration_ns
        if in_time or samples < FEWEST_SAMPLES:
            run.calibrator.add(sample.part, sample.raw, sample.received)
            run.samples[sample.part] += 1
        run.last_ns = max(run.last_ns, sample.t_ns)
