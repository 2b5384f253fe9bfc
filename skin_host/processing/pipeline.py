"""The state of the whole skin, and one step of it: bytes to pressure and touch.

What is done at every sweep is little: a parabola per taxel turns its byte into pressure.
All that is slow - relaxation, drift, with them the parabola, and the byte from which on a
taxel may be touched - is brought up to date once a window (1 s by default) from the means
of that time. A sweep in which no byte comes near its limit is known to be untouched by one
comparison of bytes.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from skin_host.layout import Layout, PadKind, PartLayout
from skin_host.processing.calibration import Calibration
from skin_host.processing.drift import BaselineTracker
from skin_host.processing.masks import Mask, any_of
from skin_host.processing.pressure import PressureCurve
from skin_host.processing.relaxation import OWN_MEANS, make_model, parameters_of
from skin_host.processing.touch import Imprints, TouchDetector, sure_units, threshold_units
from skin_host.settings import Processing

#: A longer step is a gap or a jump of the clock: the pressure in it is not known.
LONGEST_STEP_S = 1.0
#: Baselines move this often where the relaxation model looks at every sample.
WINDOW_S = 1.0
#: Of an untouched part whose pressures nobody wants, one sweep in so much time is worked out.
GLANCE_S = 0.2
#: Samples are laid aside and summed so many at a time: fewer passes over the taxels.
ROWS = 8

Floats = NDArray[np.float32]
_T = TypeVar("_T", bound=np.generic)


@dataclass(slots=True)
class PressureFrame:
    """One part at one instant. Arrays have one entry a taxel [m], in the layout's order.

    Attributes:
        part: its name.
        seq: counts the part's frames from 0.
        t_ns: time of the sweep's last CAN frame.
        raw: uint8, bytes as received.
        pressure_kpa: float32, 0 where not valid.
        touched: whether something touches the taxel.
        valid: received now, and fit to be believed.
        beyond_range: the pressure is above the calibrated range: its order is right, its
            size a guess.
        computed: False if pressures were not asked for and nothing touches: they are 0.
    """

    part: str
    seq: int
    t_ns: int
    raw: NDArray[np.uint8]
    pressure_kpa: Floats
    touched: Mask
    valid: Mask
    beyond_range: Mask
    computed: bool = True


class Pipeline:
    """Everything that is remembered of the skin between sweeps, as flat arrays over it.

    Args:
        layout: the skin.
        settings: how to process it.
        calibration: of this layout.
        after: the pipeline that this one replaces; its frames go on being counted.

    Attributes:
        baseline: float64[n], activation of the untouched taxels in units, drift included.
        relaxation_kpa: float32[n], pressure that the foam has lost by now.
    """

    def __init__(
        self,
        layout: Layout,
        settings: Processing,
        calibration: Calibration,
        after: "Pipeline | None" = None,
    ) -> None:
        self.baseline = calibration.baseline.copy()
        self.relaxation_kpa = np.zeros(layout.n_taxels, np.float32)
        curve = PressureCurve(
            layout.unit_ff / layout.sensitivity,
            calibration.gain,
            settings.pressure.a_kpa_per_ff2 * calibration.bend,
            settings.pressure.b_kpa_per_ff,
        )
        on_units = threshold_units(
            calibration.percentile, calibration.baseline, calibration.noise, settings.touch
        )
        believed = calibration.usable & (layout.pad_kind == PadKind.PRESSURE)
        sure_at_units = sure_units(on_units, calibration.noise)
        self._parts = [
            _PartPipeline(self, layout, part, settings, believed, curve, on_units, sure_at_units)
            for part in layout.parts
        ]
        if after is not None:
            for part, before in zip(self._parts, after._parts, strict=True):
                part.seq = before.seq

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
            pressures: False if nobody wants the pressures of this part: they are then only
                worked out while something touches it.
        """
        return self._parts[part_index].step(raw, present, t_ns, pressures)

    def take_zero(self, taxels: NDArray[np.int32], baseline: NDArray[np.float64]) -> None:
        """Go on from new baselines: a board has taken its zero anew.

        What was received of the taxels before is told against the old zero, so it is forgotten:
        they are untouched until their next sample.

        Args:
            taxels: int32[k], which ones.
            baseline: float64[k], theirs from now on, in units.
        """
        self.baseline[taxels] = baseline
        anew = np.zeros(len(self.baseline), np.bool_)
        anew[taxels] = True
        for part in self._parts:
            part.begin_anew(anew)

    def seq(self, part_index: int) -> int:
        """Number of the part's next frame."""
        return self._parts[part_index].seq

    def frozen(self, part_index: int) -> Mask:
        """Taxels [m] of a part that have been touched for so long that it is told."""
        return self._parts[part_index].drift.frozen

    def at_limit(self, part_index: int) -> Mask:
        """Taxels [m] of a part whose baseline has drifted as far as it may."""
        return self._parts[part_index].drift.at_limit


class _PartPipeline:
    """One part's share of the flat arrays, and scratch to work in without new memory."""

    def __init__(
        self,
        skin: Pipeline,
        layout: Layout,
        part: PartLayout,
        settings: Processing,
        believed: Mask,
        curve: PressureCurve,
        on_units: NDArray[np.float64],
        sure_at_units: NDArray[np.float64],
    ) -> None:
        self._mine = mine = slice(part.start, part.stop)
        m = part.n_taxels
        self._name = part.name
        self.seq = 0
        self._t_ns: int | None = None
        self._believed = believed = believed[mine]
        self._curve = curve = curve.part(mine)
        self._no_load = layout.no_load[mine].astype(np.float64)
        self._thermal = layout.pad_kind[mine] == PadKind.THERMAL
        self._has_thermal = bool(self._thermal.any())

        # A model that may be stepped once a window is: the pipeline takes means anyway. Steps
        # of a second are large enough for float32.
        chosen = settings.relaxation
        own_means = chosen.model in OWN_MEANS
        windowed = chosen.update_s > 0.0 and not own_means
        self._every_sample = not windowed
        self._relaxation = make_model(
            chosen.model,
            m,
            parameters_of(chosen),
            update_s=chosen.update_s if own_means else 0.0,
            dtype=np.float32 if windowed else np.float64,
        )
        self._window_s = chosen.update_s if windowed else WINDOW_S
        self._relaxation_kpa = skin.relaxation_kpa[mine]
        self.drift = BaselineTracker(
            skin.baseline[mine], believed, layout.triangle_of[mine], self._thermal, settings.drift
        )

        # A taxel that is not believed has a flat curve: it needs no masks later on.
        self._square = np.where(believed, curve.square, 0.0).astype(np.float32)
        self._linear = np.where(believed, curve.linear, 0.0).astype(np.float32)
        self._beyond_units = np.where(believed, curve.beyond_units, np.inf).astype(np.float32)
        self._units_per_kpa = np.where(believed, 1.0 / np.maximum(curve.linear, 1e-9), 0.0)
        on_units = on_units[mine]
        off_units = np.maximum(on_units - settings.touch.hysteresis_units, 0.0)
        near_units = np.minimum(on_units, curve.beyond_units)
        self._near_units = np.where(believed, near_units, np.inf).astype(np.float32)
        on_kpa = np.where(believed, curve.kpa(on_units), np.inf).astype(np.float32)
        self._imprints = Imprints(on_kpa)
        self._detector = TouchDetector(
            on_kpa,
            np.where(believed, curve.kpa(off_units), np.inf).astype(np.float32),
            settings.touch.votes_of_3,
            np.where(believed, curve.kpa(sure_at_units[mine]), np.inf).astype(np.float32),
        )

        self._zeros = _constant(np.zeros(m, np.float32))
        self._offset = np.empty(m, np.float32)
        self._slope = np.empty(m, np.float32)
        self._level = np.empty(m, np.float32)
        self._near_raw = np.empty(m, np.uint8)
        self._beyond_raw = np.empty(m, np.uint8)
        self._renew_limits()
        self._last_raw = self._untouched_raw()
        self._bytes = np.empty(m, np.float32)
        self._near = np.empty(m, np.bool_)
        self._nowhere = _constant(np.zeros(m, np.bool_))
        self._always_valid = _constant(believed.copy())

        self._rows = np.zeros((ROWS, m), np.float32)
        self._row = list(self._rows)
        self._laid = 0
        self._part_kpa = np.empty(m, np.float32)
        self._sum_kpa = np.zeros(m, np.float32)
        self._samples = 0
        self._skipped = 0
        self._elapsed_s = 0.0
        self._was_touched = np.zeros(m, np.bool_)
        self._noted = self._nowhere
        self._was_missing = np.zeros(m, np.bool_)
        self._since_glance_s = 0.0

    def step(
        self, raw: NDArray[np.uint8], present: Mask, t_ns: int, pressures: bool
    ) -> PressureFrame:
        dt_s = self._dt_s(t_ns)
        raw = raw.copy()
        valid = self._receive(raw, present)
        quiet = not self._every_sample and self._is_quiet()
        if quiet and not pressures and not self._due(dt_s):
            self._elapsed_s += dt_s
            self._skipped += 1
            return self._frame(t_ns, raw, valid, self._zeros, self._nowhere, self._nowhere, False)
        self._since_glance_s = 0.0
        beyond = self._nowhere if quiet else self._beyond()
        corrected = self._corrected_kpa(beyond, dt_s)
        touched = self._nowhere if quiet else self._detector.step(corrected)
        self._gather(touched, dt_s)
        if not quiet:
            touched = self._imprints.step(touched, corrected)
        pressure = np.fmax(corrected, self._zeros)
        if valid is not self._always_valid:
            missing = ~valid
            pressure[missing] = 0.0
            touched = touched & valid
            beyond = beyond & valid
        return self._frame(t_ns, raw, valid, pressure, touched, beyond, True)

    def begin_anew(self, taxels: Mask) -> None:
        """Forget the last samples of some taxels, bool[n] over the skin: baselines are new."""
        anew = taxels[self._mine]
        if not any_of(anew):
            return
        self._renew_limits()
        self._last_raw = np.where(anew, self._untouched_raw(), self._last_raw)
        self._detector.reset(anew)

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
        return PressureFrame(self._name, seq, t_ns, raw, pressure, touched, valid, beyond, computed)

    def _dt_s(self, t_ns: int) -> float:
        last, self._t_ns = self._t_ns, t_ns
        if last is None:
            return 0.0
        return min(max((t_ns - last) * 1e-9, 0.0), LONGEST_STEP_S)

    def _due(self, dt_s: float) -> bool:
        """Whether a quiet sweep is worked out all the same: for the means, and at their end."""
        self._since_glance_s += dt_s
        return self._since_glance_s >= GLANCE_S or self._elapsed_s + dt_s >= self._window_s

    def _receive(self, raw: NDArray[np.uint8], present: Mask) -> Mask:
        """Take in the bytes; return which are valid."""
        if b"\0" not in present.tobytes():
            self._last_raw = raw
            return self._always_valid
        valid: Mask = present & self._believed
        # What was not received is taken to be as it was: the foam does not forget.
        self._last_raw = np.where(valid, raw, self._last_raw)
        if np.array_equal(valid, self._always_valid):
            return self._always_valid
        np.logical_or(self._was_missing, ~valid, out=self._was_missing)
        return valid

    def _untouched_raw(self) -> NDArray[np.uint8]:
        return np.rint(np.clip(self._offset, 0.0, 255.0)).astype(np.uint8)

    def _is_quiet(self) -> bool:
        """Whether no taxel can be touched, nor was in the samples that still have a vote."""
        if not self._detector.idle:
            return False
        np.less_equal(self._last_raw, self._near_raw, out=self._near)
        return not any_of(self._near)

    def _beyond(self) -> Mask:
        """Which taxels read more than their calibrated range."""
        np.less(self._last_raw, self._beyond_raw, out=self._near)
        return self._near.copy() if any_of(self._near) else self._nowhere

    def _corrected_kpa(self, beyond: Mask, dt_s: float) -> Floats:
        """Equation (1) with the relaxation taken off, laid aside for the means.

        With the byte r that is (square r + slope) r + level. Below zero activation the square
        adds nothing that matters to any use of it.
        """
        row = self._row[self._laid]
        self._bytes[...] = self._last_raw
        np.multiply(self._bytes, self._square, out=row)
        np.add(row, self._slope, out=row)
        np.multiply(row, self._bytes, out=row)
        np.add(row, self._level, out=row)
        if beyond is not self._nowhere:
            units = self._offset[beyond] - self._last_raw[beyond]
            row[beyond] = self._curve.part(beyond).kpa(units)
            if not self._every_sample:
                row[beyond] -= self._relaxation_kpa[beyond]
        if self._every_sample:
            self._relaxation.step(row, dt_s, self._relaxation_kpa)
            np.subtract(row, self._relaxation_kpa, out=row)
        return row

    def _gather(self, touched: Mask, dt_s: float) -> None:
        """Count the sample for the window's means; at its end bring up to date what is slow."""
        self._laid += 1
        if self._laid == ROWS:
            self._fold()
        self._samples += 1
        self._elapsed_s += dt_s
        if touched is not self._noted:
            np.logical_or(self._was_touched, touched, out=self._was_touched)
            self._noted = touched
        if self._elapsed_s < self._window_s:
            return
        self._fold()
        units: NDArray[np.float64] = self._sum_kpa / self._samples * self._units_per_kpa
        if self._has_thermal:
            np.subtract(self._offset, self._last_raw, out=units, where=self._thermal)
        if not self._every_sample:
            # Within the window the relaxation was constant, and what was skipped was untouched.
            momentary = self._part_kpa
            np.multiply(self._sum_kpa, 1.0 / (self._samples + self._skipped), out=momentary)
            np.add(momentary, self._relaxation_kpa, out=momentary)
            self._relaxation.step(momentary, self._elapsed_s, self._relaxation_kpa)
        ghosts = self.drift.step(units, self._was_touched, self._was_missing, self._elapsed_s)
        if ghosts is not None:
            self._detector.reset(ghosts)
        self._imprints.fade(self._elapsed_s)
        self._renew_limits()
        self._sum_kpa.fill(0.0)
        self._samples = 0
        self._skipped = 0
        self._elapsed_s = 0.0
        self._was_touched.fill(False)
        self._noted = self._nowhere
        self._was_missing.fill(False)

    def _fold(self) -> None:
        np.add.reduce(self._rows[: self._laid], axis=0, out=self._part_kpa)
        np.add(self._sum_kpa, self._part_kpa, out=self._sum_kpa)
        self._laid = 0

    def _renew_limits(self) -> None:
        """The parabola of each taxel, and the bytes from which on it may be touched or beyond."""
        offset, slope, level = self._offset, self._slope, self._level
        np.subtract(self._no_load, self.drift.baseline, out=offset, casting="same_kind")
        np.multiply(self._square, offset, out=slope)
        np.add(slope, self._linear, out=level)
        np.multiply(level, offset, out=level)
        np.add(slope, slope, out=slope)
        np.add(slope, self._linear, out=slope)
        np.negative(slope, out=slope)
        if not self._every_sample:
            np.subtract(level, self._relaxation_kpa, out=level)
        # The curve bends down, so this many units are at least needed to make up for the
        # relaxation; the decision itself is made on the pressure.
        needed = np.fmax(self._relaxation_kpa, self._zeros)
        np.multiply(needed, self._units_per_kpa, out=needed, casting="same_kind")
        np.add(needed, self._near_units, out=needed)
        _as_bytes(offset - needed + 1e-3, self._near_raw)
        _as_bytes(np.ceil(offset - self._beyond_units), self._beyond_raw)


def _as_bytes(levels: Floats, out: NDArray[np.uint8]) -> None:
    """Round down to 0 .. 255, in place."""
    np.copyto(out, np.clip(levels, 0.0, 255.0), casting="unsafe")


def _constant(array: NDArray[_T]) -> NDArray[_T]:
    array.flags.writeable = False
    return array
