"""Taxels whose curve and memory are known from a recording under known pressure."""

import math

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.curves import Curve, Curves
from skin_host.processing.drift import SETTLE_S, BaselineTracker
from skin_host.processing.erratic import Erratic, range_kpa, step_kpa
from skin_host.processing.fitting.course import limit_kpa, make_memory
from skin_host.processing.masks import Mask
from skin_host.processing.relaxation import PlayRelaxation
from skin_host.processing.smoothing import StepFilter

#: Baselines of pads with own curves rise no faster above their calibrated zero (10 degrees in 10
#: minutes are 0.008), and those of touched ones do not rise before their release.
RISE_UNITS_PER_S = 0.01
#: A taxel that rests at this value or above sends 255 by noise alone.
RESTING_NEAR_RAIL = 247.0
#: A taxel whose reading was at less than this share of its untouched byte, and is 0 now, is pressed
#: beyond its scale. On four recordings of real skin 188 of 193 contacts that broke did so above it.
PRESSED_SHARE = 0.5

Floats = NDArray[np.float32]


class OwnCurves:
    """Extra state of taxels with own curves: smoothing, memory, and detection of jumps.

    Cost follows touch: touched taxels, or all where more than a quarter is touched, are smoothed
    and remembered in each sweep, the others from the means of `windows.ROWS` sweeps: their
    reported pressures change as seldom.

    Args:
        curve: of the m taxels of a part.
        curves: of all taxels.
        mine: those of the part.
        chip: int[m], which chip each of them is read by.
        smoothing_s: of the filter of noise.

    Attributes:
        erratic: which of them jump.
    """

    def __init__(
        self,
        curve: Curve,
        curves: Curves,
        mine: slice,
        chip: NDArray[np.int32],
        smoothing_s: float,
    ) -> None:
        own, noise = curves.own[mine], curves.noise_units[mine]
        m = len(own)
        self._own = own
        limit = np.where(own, limit_kpa(curve, noise), 0.0)
        self._smoother = StepFilter(limit, smoothing_s, np.float32)
        self._memory = make_memory(m, curves.memory, np.float32)
        step = np.where(own, step_kpa(curve, noise), np.inf)
        self.erratic = Erratic(step, range_kpa(curve), chip)
        self._zeros = np.zeros(m, np.float32)
        self._reported = self._zeros
        self._touched: Mask | None = None
        #: Taxels with a filter and a memory of their own: the touched ones, or all.
        self._felt_memory: PlayRelaxation | None = None
        self._set_apart(np.zeros(0, np.intp), 0)
        #: Which were touched since the last fold.
        self._felt: Mask = np.zeros(m, np.bool_)
        self._touching = False
        #: By how much the skin has drifted since each taxel was touched, as others show. A fall is
        #: followed, and goes back; a rise above what the zero was is not, while the touch lasts.
        self._shown_units: NDArray[np.float64] = np.zeros(m)
        #: Which were valid in the last sweep, but for the bytes that `without_rails` leaves out.
        self._present: Mask = np.ones(m, np.bool_)
        #: Of the samples since the last fold, the time since the one before each.
        self._steps_s: list[float] = []

    def use(self, smoothing_s: float) -> None:
        """Smooth over this time from now on."""
        for smoother in (self._smoother, self._felt_smoother):
            smoother.use(smoothing_s)

    def step(self, momentary: Floats, dt_s: float, touched: Mask, relaxation_kpa: Floats) -> Floats:
        """Return the pressures [m] to report; update the relaxation [m] of touched taxels.

        The result is not written to again.

        Args:
            momentary: [m], in kPa.
            dt_s: time since the last call.
            touched: bool[m].
            relaxation_kpa: [m].
        """
        self._steps_s.append(dt_s)
        if touched is not self._touched:
            self._touched = touched
            self._felt |= touched
            self._take_back()
            felt = np.flatnonzero(touched)
            if 4 * len(felt) <= len(touched):
                self._set_apart(felt, len(felt))
            else:
                # Where much is touched, the rest is likely to feel something, too.
                self._set_apart(slice(None), len(touched))
            self._report(relaxation_kpa)
        which = self._which
        if not self._apart:
            return self._reported
        self._touching = True
        mine = momentary if isinstance(which, slice) else momentary.take(which)
        smooth = self._felt_smoother.step(mine, dt_s)
        if self._felt_memory is not None:
            self._felt_memory.step(smooth, dt_s, self._relaxed)
            relaxation_kpa[which] = self._relaxed
        pressure = smooth - self._relaxed
        np.maximum(pressure, self._zeros[: self._apart], out=pressure)
        if isinstance(which, slice):
            return pressure
        reported = self._reported.copy()
        reported[which] = pressure
        return reported

    def _set_apart(self, which: NDArray[np.intp] | slice, count: int) -> None:
        """Step so many taxels apart from the others, in steps that cost as much as they are."""
        self._which, self._apart = which, count
        self._relaxed = np.zeros(count, np.float32)
        self._felt_smoother = self._smoother.part(which)
        if self._memory is not None:
            self._felt_memory = self._memory.part(which)

    def _take_back(self) -> None:
        """Bring the state of all taxels up to date."""
        if self._apart:
            self._smoother.take_back(self._which, self._felt_smoother)
            if self._memory is not None and self._felt_memory is not None:
                self._memory.take_back(self._which, self._felt_memory)

    def fold(self, rows: Floats, sums: Floats, relaxation_kpa: Floats) -> None:
        """Take the corrected pressures [k, m] of the last sweeps, and their sums [m]."""
        folded_s = sum(self._steps_s)
        if self._touching or self.erratic.suspects:
            self.erratic.look(rows, self._steps_s)
        else:
            self.erratic.wait(folded_s)
        self._steps_s.clear()
        momentary = sums / np.float32(len(rows))
        if self._touching:
            # A mean over a press and its release is neither.
            np.copyto(momentary, rows[-1], where=self._felt)
        momentary += relaxation_kpa
        self._smoother.step(momentary, folded_s)
        if self._touching:
            self._smoother.take_back(self._which, self._felt_smoother)
            self._touching = self._apart > 0
            if self._touched is not None:
                np.copyto(self._felt, self._touched)
        self._report(relaxation_kpa)

    def end_window(self, elapsed_s: float, relaxation_kpa: Floats) -> None:
        """Update the relaxation [m] of all taxels, in place, and forget jumps of long ago."""
        if self._memory is not None:
            # Plays do not move under a reading that they had: those apart stay as they are.
            self._take_back()
            self._memory.step(self._smoother.smooth, elapsed_s, relaxation_kpa)
        self.erratic.note_valid(self._present)
        self.erratic.pass_time(elapsed_s)

    def _report(self, relaxation_kpa: Floats) -> None:
        self._reported = np.fmax(self._smoother.smooth - relaxation_kpa, self._zeros)

    def hold_rises(
        self,
        drift: BaselineTracker,
        before: NDArray[np.float64],
        touched: Mask,
        elapsed_s: float,
        drifted: NDArray[np.intp] | None,
    ) -> NDArray[np.intp] | None:
        """Limit baselines to a slow rise, in place.

        A load that grows slowly, or has nearly gone, reads like drift; on a skin with known curves
        it is more probable than drift. Where most of the part is released, it has gone: what a
        pad reads then, within what foam and drift can leave, is taken for these at once. So is, in
        any case, what the others have shown meanwhile.

        Args:
            drift: with the baselines [m] that it would have, by its last step. It learns what is
                owed to the touched ones.
            before: float64[m], the baselines of the window before.
            touched: bool[m], taxels whose baselines may not rise, but those of `drifted`.
            elapsed_s: how long the window was.
            drifted: touched taxels whose touch would be drift.

        Returns:
            Those of `drifted` that are: the others stay touched while their baselines rise.
        """
        slow = RISE_UNITS_PER_S * drift.fineness * elapsed_s
        shared = np.minimum(drift.shared_units, slow)
        shown = self._shown_units + shared
        if drift.may_be_loaded:
            np.minimum(shown, np.maximum(self._shown_units, 0.0), out=shown)
        fall = np.minimum(shown, 0.0) - np.minimum(self._shown_units, 0.0)
        held = touched & self._own
        if drifted is not None:
            held[drifted] = False
        drift.baseline += np.where(held, fall - shared, 0.0)
        highest = before + np.where(touched, fall, slow)
        self._shown_units = np.where(touched, shown, shown * math.exp(-elapsed_s / SETTLE_S))
        owed = np.maximum(self._shown_units, 0.0) * self._own
        if drifted is not None:
            # What the untouched ones show is none of what was hidden.
            allowed = drift.baseline if drift.is_released else before + slow + owed
            highest[drifted] = np.maximum(allowed, drift.calibrated)[drifted]
            reached = drift.baseline[drifted] <= highest[drifted]
            drifted = drifted[reached | ~self._own[drifted]]
        np.minimum(drift.baseline, highest, out=drift.baseline, where=self._own)
        # What has been given is no longer owed.
        self._shown_units -= np.clip(drift.baseline - before - slow, 0.0, owed)
        drift.owed_units = np.maximum(self._shown_units, 0.0) * self._own
        return drifted if drifted is not None and len(drifted) else None

    def reset(self, taxels: Mask) -> None:
        """Forget the readings of taxels [m], but not that they jumped: see `Erratic.reset`."""
        self._take_back()
        self._smoother.reset(taxels)
        self._reported = np.where(taxels, self._zeros, self._reported)
        self._shown_units[taxels] = 0.0
        if self._memory is not None:
            self._memory.reset(taxels)
        self._set_apart(self._which, self._apart)

    def without_rails(
        self,
        raw: NDArray[np.uint8],
        present: Mask,
        offset: Floats,
        before: NDArray[np.uint8],
        touched: Mask,
    ) -> Mask:
        """Leave out bytes at the ends of the range that are not readings.

        A broken contact sends 0, from any level. Only what was pressed by more than half of its
        scale before is pressed beyond it. 255 is no reading far from rest.

        Args:
            raw: uint8[m], the bytes.
            present: bool[m], which were received.
            offset: [m], bytes of the untouched taxels.
            before: uint8[m], the last readings.
            touched: bool[m], taxels that were touched by these, or may have been.
        """
        self._present = present
        data = raw.tobytes()
        if 0 not in data and 255 not in data:
            return present
        broken = (raw == 0) & ~(touched & (before <= PRESSED_SHARE * offset))
        rail = broken | ((raw == 255) & (offset < RESTING_NEAR_RAIL))
        left: Mask = present & ~(rail & self._own)
        return left
