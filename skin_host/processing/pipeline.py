"""State of the whole skin, and the per-sweep processing step: bytes to pressure and touch.

The work per sweep is small: a parabola per taxel, or its own table, converts its byte into
pressure. Everything slow - relaxation, drift, and with them the parabola and the byte from which
on a taxel may be touched - is updated once a window from the means of that time: drift once a
second, relaxation as often as the configuration wants it.
A sweep in which no byte comes near its limit, and no taxel has evidence of an earlier one, is
recognised as untouched by one comparison of bytes.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from skin_host.config.relaxation import RelaxationSettings
from skin_host.config.settings import Processing
from skin_host.layout import Layout, PadKind, PartLayout
from skin_host.processing.calibration import Calibration, fineness
from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.curves import Curve, Parabolas, Reader, TableCurve, Tables
from skin_host.processing.drift import BaselineTracker
from skin_host.processing.frame import PressureFrame
from skin_host.processing.masks import Mask, any_of
from skin_host.processing.own_curves import OwnCurves
from skin_host.processing.relaxation import OWN_MEANS, make_model, parameters_of
from skin_host.processing.relaxation import Relaxation as Model
from skin_host.processing.rules import Rules
from skin_host.processing.touch import Levels
from skin_host.processing.touch_decision import TouchDecision
from skin_host.processing.windows import Windows, WindowSums

#: A longer step is a gap or a jump of the clock. The foam's model is advanced by it, under the
#: readings after it; nothing else depends on its length.
LONGEST_STEP_S = 1.0
#: Baselines move this often.
WINDOW_S = 1.0
#: The curve of a taxel hardly bends below this.
STRAIGHT_UNITS = 2.0
#: Smaller relaxation does not affect the touch decision.
RELAXED_KPA = 0.01

Floats = NDArray[np.float32]
_T = TypeVar("_T", bound=np.generic)


class Pipeline:
    """The state of the skin between sweeps, as flat arrays over all taxels.

    Args:
        layout: the skin.
        settings: how to process it.
        calibration: of this layout.

    Attributes:
        baseline: float64[n], activation of the untouched taxels in units, drift included.
        relaxation_kpa: float32[n], pressure that the foam has lost by now.
        enter: float64[n], the threshold by which a press is known, in units, see `touch.felt_by`.
        measurements: int64[n], in which a touch is decided, see `touch.Levels`.
        unreached: bool[n], taxels that are not used because no reading of them is a touch.
        flat: bool[n], those of them whose curve of pressure does not rise with each unit.
    """

    def __init__(self, layout: Layout, settings: Processing, calibration: Calibration) -> None:
        self._layout = layout
        self.baseline = calibration.baseline.copy()
        self.relaxation_kpa = np.zeros(layout.n_taxels, np.float32)
        self._rules = rules = Rules.of(layout, settings, calibration)
        self.enter = rules.felt.enter
        self.measurements = rules.measurements()
        self.unreached, self.flat = rules.unreached, rules.unreached & ~rules.curve.sound
        self._parts = [_PartPipeline(self, layout, part, rules) for part in layout.parts]

    def renew(
        self,
        settings: Processing,
        calibration: Calibration,
        zeroed: Mask,
        layout: Layout | None = None,
    ) -> None:
        """Apply changed settings or a changed calibration; the state is kept.

        Only another relaxation model starts without a state, and one of another scale of pressure.

        Args:
            settings: how to process from now on.
            calibration: the one in use from now on.
            zeroed: bool[n], taxels that have been calibrated: they are untouched and relaxed.
            layout: the skin from now on, if its foam or its scale has changed.
        """
        self._layout = layout or self._layout
        np.copyto(self.baseline, calibration.baseline, where=zeroed)
        self._rules = rules = Rules.of(self._layout, settings, calibration)
        self.enter = rules.felt.enter
        self.measurements = rules.measurements()
        self.unreached, self.flat = rules.unreached, rules.unreached & ~rules.curve.sound
        for part in self._parts:
            part.renew(rules, zeroed)

    def step(
        self,
        part_index: int,
        raw: NDArray[np.uint8],
        present: Mask,
        t_ns: int,
        pressures: bool = True,
    ) -> PressureFrame:
        """Process one sweep of a part.

        Args:
            part_index: which part.
            raw: uint8[m], the bytes.
            present: bool[m], which of them were received.
            t_ns: time of the sweep.
            pressures: False if the pressures of this part are not subscribed: they are then only
                computed while something touches it.
        """
        return self._parts[part_index].step(raw, present, t_ns, pressures)

    def follow(
        self, part_index: int, raw: NDArray[np.uint8], present: Mask, t_ns: int
    ) -> PressureFrame:
        """Process one sweep of a part of which nothing is published: it takes no number.

        Args:
            part_index, raw, present, t_ns: see `step`.
        """
        part = self._parts[part_index]
        number = part.seq
        frame = part.step(raw, present, t_ns, pressures=False)
        part.seq = number
        return frame

    def clock_set(self, step_ns: int) -> None:
        """Take no time for passed that the clock of the sweeps was set forward by.

        Args:
            step_ns: by how much, negative if it was set back. Sweeps of the time before may follow.
        """
        for part in self._parts:
            part.clock_set(step_ns)

    def set_zero(self, taxels: NDArray[np.int32], baseline: NDArray[np.float64]) -> None:
        """Continue from new baselines, because a board was zeroed.

        Earlier samples of the taxels refer to the old zero, so they are forgotten: the taxels are
        relaxed, and untouched until their next sample.

        Args:
            taxels: int32[k], which ones.
            baseline: float64[k], their new baselines, in units.
        """
        self.baseline[taxels] = baseline
        anew = np.zeros(len(self.baseline), np.bool_)
        anew[taxels] = True
        for part in self._parts:
            part.begin_anew(anew)

    def catch_up(self, taxels: NDArray[np.int32], units: NDArray[np.float64]) -> None:
        """Continue from baselines that have drifted while their taxels were not received.

        Args:
            taxels: int32[k], which ones.
            units: float64[k], by how much.
        """
        drifted_units = np.zeros(len(self.baseline))
        drifted_units[taxels] = units
        for part in self._parts:
            part.catch_up(drifted_units)

    @property
    def levels(self) -> Levels:
        """Where the taxels [n] begin and end to be touched, in units."""
        return self._rules.levels

    def kpa(self, units: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return activations [n] as pressures, kPa."""
        return np.asarray(self._rules.curve.kpa(units), np.float64)

    def seq(self, part_index: int) -> int:
        """Return the number of the part's next frame."""
        return self._parts[part_index].seq

    def decides_kpa(self, part_index: int) -> float:
        """Return the pressure of which every usable taxel of a part detects nearly every press
        within a second, see `Levels.decides_surely`.
        """
        return self._parts[part_index].decides_kpa

    def frozen(self, part_index: int) -> Mask:
        """Return taxels [m] of a part that have been touched for so long that it is reported."""
        return self._parts[part_index].drift.frozen

    def returned(self, part_index: int) -> Mask:
        """Return taxels [m] of a part that are pressed again, or whose zero has come back: they
        are not valid.
        """
        return self._parts[part_index].drift.returned

    def at_limit(self, part_index: int) -> Mask:
        """Return taxels [m] of a part whose baseline has drifted to its limit."""
        return self._parts[part_index].drift.at_limit


class _PartPipeline:
    """One part's share of the flat arrays, and work arrays that are reused."""

    def __init__(self, skin: Pipeline, layout: Layout, part: PartLayout, rules: Rules) -> None:
        self._mine = mine = slice(part.start, part.stop)
        m = part.n_taxels
        self._name = part.name
        self.seq = 0
        self._t_ns: int | None = None
        self._elapsed_ns = 0
        #: For how long nothing of the part has been received.
        self._unseen_s = 0.0
        #: By how much the clock was set forward and no sweep has shown it yet.
        self._set_ns = 0
        self._no_load = layout.no_load[mine].astype(np.float64)
        self._thermal = layout.pad_kind[mine] == PadKind.THERMAL
        self._has_thermal = bool(self._thermal.any())
        self._relaxation_kpa = skin.relaxation_kpa[mine]
        self._zeros = _constant(np.zeros(m, np.float32))
        self._nowhere = _constant(np.zeros(m, np.bool_))
        self._offset = np.empty(m, np.float32)
        self._beyond_raw = np.empty(m, np.uint8)
        self._most_beyond_raw = 0
        self._shifted = np.empty(m, np.uint8)
        self._near = np.empty(m, np.bool_)
        self._was_touched = np.zeros(m, np.bool_)

        # The samples of a part are as seldom as its slowest board's sweeps.
        periods_ms = [layout.boards[board].settings.period_ms for board in part.boards]
        self._interval_s = max(max(periods_ms) * 1e-3, CONVERSION_S)
        self._triangle_of = layout.triangle_of[mine]
        self._windows = Windows(m, WINDOW_S, self._fold)
        #: For passing use.
        self._scratch_kpa = np.empty(m, np.float32)
        rules = rules.part(mine)
        self._set_model(rules)
        self.drift = BaselineTracker(
            skin.baseline[mine],
            rules.usable,
            self._triangle_of,
            self._thermal,
            rules.settings.drift,
            fineness(layout)[mine],
        )
        #: What presses, and what of that is called a touch; mostly they are one.
        self._felt = self._called = TouchDecision(rules.felt, rules.settings.touch.votes_of_3)
        self._decide_by(rules)
        self._adopt(rules)
        self._last_raw = self._untouched_raw()

        self._noted = self._nowhere
        #: How many sweeps of the window lacked each taxel.
        self._lacking = np.zeros(m, np.int32)

    def renew(self, rules: Rules, zeroed: Mask) -> None:
        before = self._rules
        rules = rules.part(self._mine)
        zeroed = zeroed[self._mine]
        other_model = rules.settings.relaxation != before.settings.relaxation
        if rules.curves is None or before.curves is None:
            other_foam = rules.curves is not before.curves
        else:
            other_foam = not rules.curves.is_same(before.curves)
        # What the foam has lost is known in kPa, which a byte stands for no longer.
        other_scale = not np.array_equal(rules.curve.linear, before.curve.linear)
        if other_foam or other_scale or (other_model and rules.curves is None):
            self._windows.fold()
            self._set_model(rules)
        elif self._own is not None:
            self._own.use(rules.settings.pressure.smoothing_s)
        self._decide_by(rules)
        self.drift.renew(rules.usable, zeroed, rules.settings.drift)
        if any_of(zeroed):
            if self._own is not None:
                self._own.erratic.reset(zeroed)
            self._forget(zeroed)
        self._adopt(rules)
        self._begin_anew(zeroed)

    def _decide_by(self, rules: Rules) -> None:
        """Use the levels of these rules from now on."""
        votes = rules.settings.touch.votes_of_3
        if rules.felt is rules.levels:
            self._called = self._felt
        elif self._called is self._felt:
            self._called = self._felt.copy()
        is_one = self._called is self._felt
        self._decisions = [self._felt] if is_one else [self._felt, self._called]
        for decision, found in zip(self._decisions, (rules.felt, rules.levels), strict=False):
            decision.use(found, votes)
        self._nothing = [self._nowhere] * len(self._decisions)

    def _adopt(self, rules: Rules) -> None:
        """Compute what each sweep needs from the rules."""
        self._rules = rules
        self._curve = curve = rules.curve
        self._usable = usable = rules.usable
        self._reader: Reader
        if isinstance(curve, TableCurve):
            self._reader = Tables(curve, usable)
        else:
            self._reader = Parabolas(curve, usable)
        self._beyond_units = np.where(usable, curve.beyond_units, np.inf).astype(np.float32)
        self._units_per_kpa = np.where(usable, 1.0 / np.maximum(curve.linear, 1e-9), 0.0)
        self._kpa_per_unit = np.where(usable, curve.linear, 0.0)
        for decision, found in zip(self._decisions, (rules.felt, rules.levels), strict=False):
            decision.adopt(found, curve, usable, rules.curves is not None)
        decides = rules.levels.decides_surely(self._interval_s, rules.settings.touch.votes_of_3)
        decides = curve.kpa(np.where(usable, decides, 0.0))
        self.decides_kpa = float(decides.max(initial=0.0))
        self._always_valid = _constant(usable.copy())
        self._always_bytes = self._always_valid.tobytes()
        #: Which taxels were received last, as bytes, and which of them are valid.
        self._received = b""
        self._valid = self._always_valid
        self._far_taxels: tuple[bytes, NDArray[np.intp], Curve] | None = None
        self._renew_limits()

    def _set_model(self, rules: Rules) -> None:
        """Start a new relaxation model; a foam model that was fitted with curves replaces the
        configured one.
        """
        self._relaxation_kpa.fill(0.0)
        self._relaxation: Model | None = None
        self._own: OwnCurves | None = None
        self._every_sample = False
        self._windows.relax_in(WINDOW_S)
        if rules.curves is not None:
            smoothing_s = rules.settings.pressure.smoothing_s
            self._own = OwnCurves(
                rules.curve, rules.curves, self._mine, self._triangle_of, smoothing_s
            )
            return
        # A model that permits it is stepped once a window, because the pipeline takes means anyway.
        # Steps of a second are large enough for float32.
        chosen: RelaxationSettings = rules.settings.relaxation
        own_means = chosen.model in OWN_MEANS
        windowed = chosen.update_s > 0.0 and not own_means
        self._every_sample = not windowed
        self._relaxation = make_model(
            chosen.model,
            len(self._relaxation_kpa),
            parameters_of(chosen),
            held=own_means and chosen.update_s > 0.0,
            dtype=np.float32 if windowed else np.float64,
        )
        if windowed:
            self._windows.relax_in(chosen.update_s)

    def step(
        self, raw: NDArray[np.uint8], present: Mask, t_ns: int, pressures: bool
    ) -> PressureFrame:
        dt_s = self._dt_s(t_ns)
        raw = raw.copy()
        own = self._own
        if own is not None:
            felt, lost = self._felt.detector.touched, self._felt.detector.lost
            felt = felt if lost is None else felt | lost
            present = own.without_rails(raw, present, self._offset, self._last_raw, felt)
        valid = self._receive(raw, present)
        # Nobody knows what presses a part of which nothing is received: its foam waits.
        foam_s, self._unseen_s = self._unseen_s + dt_s, 0.0
        if valid is not self._always_valid and not any_of(present):
            foam_s, self._unseen_s = 0.0, foam_s
        if foam_s > LONGEST_STEP_S:
            self._bridge(foam_s - LONGEST_STEP_S)
            foam_s = LONGEST_STEP_S
        dt_s = min(dt_s, LONGEST_STEP_S)
        if own is not None and own.erratic.any:
            valid = valid & ~own.erratic.pads
        if any_of(self.drift.returned):
            valid = valid & ~self.drift.returned
        idle = self._felt.detector.is_idle(self._last_raw)
        if self._called is not self._felt:
            idle = self._called.detector.is_idle(self._last_raw) and idle
        decided = self._nothing if idle else self._decide(valid, dt_s)
        pressed, touched = decided[0], decided[-1]
        quiet = pressed is touched is self._nowhere and not self._every_sample
        quiet = quiet and not (self._felt.residuals.any or self._called.residuals.any)
        windows = self._windows
        if quiet and not pressures and not windows.due(foam_s):
            windows.skip(self._last_raw, foam_s)
            return self._frame(t_ns, raw, valid, self._zeros, self._nowhere, self._nowhere, False)
        cut_off = 255 in self._last_raw.tobytes()
        beyond = self._beyond(cut_off) if cut_off or not (idle and quiet) else self._nowhere
        corrected, pressure = self._pressures(beyond, pressed, windows.unseen_s + foam_s)
        over = windows.add(self._last_raw, foam_s, self._kpa_per_unit if quiet else None)
        if pressed is not self._noted:
            np.logical_or(self._was_touched, pressed, out=self._was_touched)
            self._noted = pressed
        if over:
            self._end_piece()
        if not quiet:
            relaxation_kpa = self._relaxation_kpa
            found = []
            for one, its in zip(self._decisions, decided, strict=True):
                if beyond is not self._nowhere:
                    one.residuals.press_beyond(beyond & its, self._last_raw == 0, foam_s)
                found.append(one.report(its, corrected, relaxation_kpa, idle))
            pressed, touched = found[0], found[-1]
        if valid is not self._always_valid:
            pressure = np.where(valid, pressure, self._zeros)
            is_one = pressed is touched
            touched = touched if touched is self._nowhere else touched & valid
            pressed = touched if is_one else pressed & valid
            beyond = beyond if beyond is self._nowhere else beyond & valid
        frame = self._frame(t_ns, raw, valid, pressure, touched, beyond, True)
        if pressed is not touched:
            frame.felt = pressed
        return frame

    def clock_set(self, step_ns: int) -> None:
        """See `Pipeline.clock_set`."""
        if self._t_ns is not None:
            self._set_ns = max(self._set_ns + step_ns, 0)

    def begin_anew(self, taxels: Mask) -> None:
        """Forget the last samples of some taxels, bool[n] over the skin: baselines are new."""
        anew = taxels[self._mine]
        if any_of(anew):
            self.drift.forget(anew)
            self._forget(anew)
            self._renew_limits()
            self._begin_anew(anew)

    def catch_up(self, units: NDArray[np.float64]) -> None:
        """See `Pipeline.catch_up`; the drift float64[n] of all taxels of the skin."""
        units = units[self._mine]
        drifted = units != 0.0
        if any_of(drifted):
            self.drift.catch_up(units)
            # What these sent before is no reading above the new baselines.
            self._windows.forget(drifted)
            self._renew_limits()
            self._begin_anew(drifted)

    def _forget(self, taxels: Mask) -> None:
        """Take taxels [m] for relaxed: what the foam keeps of a press is in their new zero."""
        for model in (self._relaxation, self._own):
            if model is not None:
                model.reset(taxels)
        self._relaxation_kpa[taxels] = 0.0
        for decision in self._decisions:
            decision.residuals.reset(taxels)
        self._windows.forget(taxels)
        self._was_touched[taxels] = False
        self._noted = self._nowhere

    def _begin_anew(self, taxels: Mask) -> None:
        self._last_raw = np.where(taxels, self._untouched_raw(), self._last_raw)
        self._windows.begin_anew(taxels, self._last_raw)
        for decision in self._decisions:
            decision.detector.reset(taxels)

    def _frame(
        self,
        t_ns: int,
        raw: NDArray[np.uint8],
        valid: Mask,
        pressure: Floats,
        touched: Mask,
        beyond: Mask,
        computed: bool,
    ) -> PressureFrame:
        seq, self.seq = self.seq, self.seq + 1
        return PressureFrame(
            self._name,
            seq,
            t_ns,
            raw,
            pressure,
            touched,
            valid,
            beyond,
            computed,
            self._elapsed_ns,
        )

    def _dt_s(self, t_ns: int) -> float:
        """Return the time since the sample before."""
        last, self._t_ns = self._t_ns, t_ns
        if last is None:
            return 0.0
        passed_ns = t_ns - last
        if 0 < self._set_ns <= passed_ns:
            passed_ns -= self._set_ns
            self._set_ns = 0
        passed_ns = max(passed_ns, 0)
        self._elapsed_ns += passed_ns
        return passed_ns * 1e-9

    def _bridge(self, gap_s: float) -> None:
        """Advance the foam's model through a gap, under the readings after it."""
        self.drift.pass_gap(gap_s)
        for decision in self._decisions:
            decision.residuals.fade(gap_s)
            decision.detector.lose(decision.detector.touched)
        if self._relaxation is None:
            return
        self._end_piece(early=True)
        momentary = self._scratch_kpa
        self._reader.kpa(self._last_raw, momentary)
        beyond = self._beyond(cut_off=True)
        if beyond is not self._nowhere:
            taxels, curve = self._beyond_curve(beyond)
            momentary[taxels] = self._beyond_kpa(taxels, curve)
        if not self._every_sample:
            np.add(momentary, self._relaxation_kpa, out=momentary)
        np.fmax(momentary, self._zeros, out=momentary)
        self._relaxation.step(momentary, gap_s, self._relaxation_kpa)
        self._renew_limits()

    def _receive(self, raw: NDArray[np.uint8], present: Mask) -> Mask:
        """Take in the bytes; return which are valid."""
        received = present.tobytes()
        if 0 not in received:
            self._last_raw = raw
            return self._always_valid
        if received != self._received:
            self._received = received
            self._valid = present & self._usable
            if self._valid.tobytes() == self._always_bytes:
                self._valid = self._always_valid
        valid = self._valid
        # Values that were not received are taken as unchanged: the foam does not forget.
        taken = valid | (present & self._thermal) if self._has_thermal else valid
        self._last_raw = np.where(taken, raw, self._last_raw)
        if valid is not self._always_valid or self._has_thermal:
            self._lacking += ~taken
        return valid

    def _untouched_raw(self) -> NDArray[np.uint8]:
        return np.rint(np.clip(self._offset, 0.0, 255.0)).astype(np.uint8)

    def _decide(self, valid: Mask, dt_s: float) -> list[Mask]:
        """Return which taxels each decision finds touched, `_nowhere` if none."""
        unheard = None if valid is self._always_valid else ~valid
        found = []
        for decision in self._decisions:
            touched = decision.detector.step(self._last_raw, dt_s, unheard)
            found.append(touched if decision.detector.any else self._nowhere)
        return found

    def _beyond(self, cut_off: bool) -> Mask:
        """Return which taxels read more than their calibrated range, or an end of the scale.

        Args:
            cut_off: whether any reads 255.
        """
        raw = self._last_raw
        # NumPy finds where the lowest byte is in a quarter of the time in which it finds the byte.
        if not cut_off and raw[raw.argmin()] >= self._most_beyond_raw:
            return self._nowhere
        # After this 255 is 0, which is below every limit.
        np.add(raw, np.uint8(1), out=self._shifted)
        np.less_equal(self._shifted, self._beyond_raw, out=self._near)
        np.logical_and(self._near, self._usable, out=self._near)
        return self._near.copy() if any_of(self._near) else self._nowhere

    def _pressures(self, beyond: Mask, touched: Mask, dt_s: float) -> tuple[Floats, Floats]:
        """Return the momentary pressure minus the relaxation, and what is reported of it.

        The first is stored for the means.
        """
        row = self._windows.row
        self._reader.kpa(self._last_raw, row)
        if self._own is not None:
            if beyond is not self._nowhere and not isinstance(self._curve, TableCurve):
                taxels, curve = self._beyond_curve(beyond)
                row[taxels] = curve.kpa(self._activations(taxels))
            reported = self._own.step(row, dt_s, touched, self._relaxation_kpa)
            np.subtract(row, self._relaxation_kpa, out=row)
            return row, reported
        if beyond is not self._nowhere:
            taxels, curve = self._beyond_curve(beyond)
            row[taxels] = self._beyond_kpa(taxels, curve)
        if self._every_sample and self._relaxation is not None:
            # Foam is not pulled: a taxel with too low a reading has nothing to relax from.
            pressed = np.fmax(row, self._zeros, out=self._scratch_kpa)
            self._relaxation.step(pressed, dt_s, self._relaxation_kpa)
            np.subtract(row, self._relaxation_kpa, out=row)
        return row, np.fmax(row, self._zeros)

    def _beyond_curve(self, beyond: Mask) -> tuple[NDArray[np.intp], Curve]:
        """Return some taxels [m] by number, and their curve; mostly those of the last sweep."""
        key = beyond.tobytes()
        known = self._far_taxels
        if known is None or known[0] != key:
            taxels = np.flatnonzero(beyond)
            self._far_taxels = known = key, taxels, self._curve.part(taxels)
        return known[1:]

    def _beyond_kpa(self, taxels: NDArray[np.intp], curve: Curve) -> NDArray[np.float64]:
        """Return the common curve of some taxels beyond their calibrated range."""
        kpa = curve.kpa(self._activations(taxels))
        return kpa if self._every_sample else kpa - self._relaxation_kpa[taxels]

    def _activations(self, taxels: NDArray[np.intp]) -> Floats:
        """Return the activations of some taxels, in units."""
        activations: Floats = self._offset[taxels] - self._last_raw[taxels]
        return activations

    def _end_piece(self, early: bool = False) -> None:
        """Update the slow state from the means of the windows that have ended, or end `early`."""
        windows = self._windows
        drifted, relaxed = windows.end_piece(early)
        if drifted:
            self._follow_drift(windows.drifting)
            windows.drifting.clear()
        if relaxed:
            relaxing = windows.relaxing
            if self._relaxation is not None and not self._every_sample:
                # Within the window it was constant, and skipped sweeps were relaxed.
                momentary = self._scratch_kpa
                scale = 1.0 / (relaxing.samples + relaxing.skipped)
                np.multiply(relaxing.sum_kpa, scale, out=momentary)
                np.add(momentary, self._relaxation_kpa, out=momentary)
                np.fmax(momentary, self._zeros, out=momentary)
                self._relaxation.step(momentary, relaxing.elapsed_s, self._relaxation_kpa)
            relaxing.clear()
        self._renew_limits()
        if not windows.drifting.samples:
            self._was_touched.fill(False)
            self._noted = self._nowhere
        windows.begin_piece()

    def _follow_drift(self, window: WindowSums) -> None:
        """Move the baselines by the means of a window."""
        elapsed_s = window.elapsed_s
        mean_kpa = np.divide(window.sum_kpa, window.samples, dtype=np.float64)
        if self._own is not None:
            self._own.end_window(elapsed_s, self._relaxation_kpa)
        units = self._units(mean_kpa)
        relaxed_units = np.multiply(self._relaxation_kpa, self._units_per_kpa, dtype=np.float64)
        pressed = self._was_touched & self._usable
        if any_of(pressed):
            momentary_kpa = mean_kpa[pressed] + self._relaxation_kpa[pressed]
            momentary_units = self._curve.part(pressed).units(momentary_kpa)
            relaxed_units[pressed] = momentary_units - units[pressed]
        if self._has_thermal:
            np.subtract(self._offset, self._last_raw, out=units, where=self._thermal)
        before = self.drift.baseline.copy()
        # A frame is lost now and then; a mean of more repeated readings than others shows nothing.
        sweeps = window.samples + window.skipped
        touched, missing = self._was_touched, 2 * self._lacking > sweeps
        conversions = self._conversions(window)
        lowest = self._units(np.fmin(window.lowest_kpa, mean_kpa))
        spread = self._rules.levels.spread
        ghosts = self.drift.step(
            units, touched, missing, elapsed_s, relaxed_units, conversions, (lowest, spread)
        )
        if self._own is not None:
            ghosts = self._own.hold_rises(self.drift, before, touched, elapsed_s, ghosts)
        if ghosts is not None:
            for decision in self._decisions:
                decision.detector.reset(ghosts)
        for decision in self._decisions:
            decision.residuals.fade(elapsed_s)
        self._lacking.fill(0)

    def _conversions(self, window: WindowSums) -> NDArray[np.float64]:
        """Return how many independent measurements are in the mean of each taxel [m].

        A reading that was not received is the last one again. Where the share p is lost by chance,
        the mean is as noisy as that of the share (1 - p) / (1 + p) of the sweeps.
        """
        sweeps = window.samples + window.skipped
        new = min(window.samples, window.elapsed_s / CONVERSION_S)
        share = np.maximum(sweeps - self._lacking, 0) / (sweeps + self._lacking)
        conversions: NDArray[np.float64] = new * share
        return conversions

    def _units(self, kpa: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return mean activations [m] in units; the bend of the curve matters only far from
        zero.
        """
        units = kpa * self._units_per_kpa
        if isinstance(self._curve, TableCurve):
            far = kpa > self._curve.straight_kpa
            if any_of(far):
                units[far] = self._curve.part(far).units(kpa[far])
            return units
        far = np.abs(units) > STRAIGHT_UNITS
        if any_of(far):
            curve, c = self._curve.part(far), kpa[far]
            # Below zero the bytes are converted by the parabola, too.
            below = np.minimum(c, 0.0)
            # A parabola that bends up has no activation for pressures below its vertex.
            root = np.sqrt(np.maximum(curve.linear**2 + 4.0 * curve.square * below, 0.0))
            units[far] = np.where(c < 0.0, 2.0 * below / (curve.linear + root), curve.units(c))
        return units

    def _fold(self, rows: Floats, sums_kpa: Floats) -> None:
        if self._own is not None:
            self._own.fold(rows, sums_kpa, self._relaxation_kpa)

    def _renew_limits(self) -> None:
        """Compute the curve at each byte, and the bytes from which on it may be touched or beyond
        range.
        """
        offset = self._offset
        np.subtract(self._no_load, self.drift.baseline, out=offset, casting="same_kind")
        self._reader.renew(offset, self._was_touched)
        if self._relaxation is not None and not self._every_sample:
            self._reader.lower(self._relaxation_kpa)
        relaxed = self._relaxation_kpa > RELAXED_KPA
        for decision in self._decisions:
            decision.renew(offset, self._relaxation_kpa, relaxed)
        # At 0 the reading is cut off in any case.
        _as_bytes(np.fmax(np.ceil(offset - self._beyond_units), 1.0), self._beyond_raw)
        self._most_beyond_raw = int(self._beyond_raw.max(initial=0))


def _as_bytes(levels: Floats, out: NDArray[np.uint8]) -> None:
    """Round down to 0 .. 255, in place."""
    np.copyto(out, np.clip(levels, 0.0, 255.0), casting="unsafe")


def _constant(array: NDArray[_T]) -> NDArray[_T]:
    array.flags.writeable = False
    return array
