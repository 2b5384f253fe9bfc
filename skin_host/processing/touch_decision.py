"""Decides by some levels what touches the taxels of a part, less what presses have left in foam."""

from copy import deepcopy

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.curves import Curve
from skin_host.processing.masks import Mask, any_of
from skin_host.processing.residuals import Residuals
from skin_host.processing.touch import Levels, TouchDetector

Floats = NDArray[np.float32]


class TouchDecision:
    """Decides by some levels which of the m taxels of a part are touched.

    Args:
        levels: [m], see `touch.levels`; infinite where a taxel must never be touched.
        votes: least number of measurements for a touch.

    Attributes:
        detector: decides it from readings.
        residuals: what is reported of that.
    """

    def __init__(self, levels: Levels, votes: int) -> None:
        self.detector = TouchDetector(levels, votes)
        self.residuals = Residuals(len(levels.enter))

    def use(self, levels: Levels, votes: int) -> None:
        """Decide by other levels from now on; touched taxels stay touched."""
        self.detector.configure(levels, votes)

    def adopt(self, levels: Levels, curve: Curve, usable: Mask, fitted: bool) -> None:
        """Take over how activations [m] of the part are read.

        Args:
            levels: those in use.
            curve: gives their pressure.
            usable: bool[m], taxels that can be touched.
            fitted: whether the model of the foam was fitted to the pads.
        """
        self._curve = curve
        self._enter = np.where(usable, levels.enter, 0.0)
        self._enter_kpa = curve.kpa(self._enter)
        # The reading of a single measurement that counts in full.
        whole = np.where(usable, levels.whole, 0.0)
        firm = curve.kpa(whole + levels.fall)
        on = np.where(usable, curve.kpa(whole), np.inf)
        self.residuals.configure(on, firm, levels.votes, fitted)

    def copy(self) -> "TouchDecision":
        """Return another one that has decided the same so far."""
        return deepcopy(self)

    def renew(self, offset: Floats, relaxation_kpa: Floats, relaxed: Mask) -> None:
        """Set the readings [m] that are no activation: a press must exceed the relaxation of the
        foam.

        Args:
            offset: float32[m], what untouched taxels read.
            relaxation_kpa: float32[m], what the foam has lost.
            relaxed: bool[m], where that matters.
        """
        zero = offset
        if any_of(relaxed):
            zero = offset.copy()
            needed_kpa = self._enter_kpa[relaxed] + relaxation_kpa[relaxed]
            needed = self._curve.part(relaxed).units(needed_kpa)
            zero[relaxed] -= needed - self._enter[relaxed]
        self.detector.renew(zero)

    def report(self, touched: Mask, signal: Floats, relaxation_kpa: Floats, idle: bool) -> Mask:
        """Return which taxels [m] to report of those that the detector has found.

        Args:
            touched: bool[m], these.
            signal, relaxation_kpa: see `Residuals.step`.
            idle: whether the detector skipped this sweep.
        """
        repeated = None if idle else self.detector.repeated
        return self.residuals.step(touched, signal, repeated, self.detector.lost, relaxation_kpa)
