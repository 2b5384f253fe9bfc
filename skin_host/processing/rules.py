"""What each taxel is converted and judged by, derived from the settings and its calibration.

Both are given once; a sweep needs their consequences: curves, thresholds in units, and which taxels
can be used with them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import Processing
from skin_host.layout import Layout, PadKind
from skin_host.processing.calibration import Calibration
from skin_host.processing.curves import Curve, Curves, common_curve, with_own
from skin_host.processing.masks import Mask
from skin_host.processing.touch import Levels, felt_by, levels


class Rules(NamedTuple):
    """How some taxels [m] are processed.

    Attributes:
        settings: as configured.
        usable: bool[m], taxels whose pressure is known.
        unreached: bool[m], taxels that are not used because no reading of them is a touch.
        curve: of their pressures.
        curves: those that were fitted to each taxel; None if there are none.
        levels: what is called a touch.
        felt: by which a press is known; the same ones if none are lower.
    """

    settings: Processing
    usable: Mask
    unreached: Mask
    curve: Curve
    curves: Curves | None
    levels: Levels
    felt: Levels

    @classmethod
    def of(cls, layout: Layout, settings: Processing, calibration: Calibration) -> "Rules":
        """Derive those of the whole skin."""
        usable = calibration.usable & (layout.pad_kind == PadKind.PRESSURE)
        common = common_curve(layout, settings.pressure, calibration.gain, calibration.bend)
        curves = calibration.curves
        curve: Curve = common
        if curves is not None:
            parts = [slice(part.start, part.stop) for part in layout.parts]
            curve = with_own(common, curves, parts, ~calibration.gained)
        above = calibration.percentile - calibration.baseline
        spread = calibration.spread
        if curves is not None:
            # Some seconds at rest show less noise than a whole recording under pressure.
            spread = np.where(curves.own, np.fmax(spread, curves.noise_units), spread)
        known = np.isfinite(above) & np.isfinite(spread)
        above, spread = np.where(known, above, 0.0), np.where(known, spread, 0.0)
        found = felt = levels(above, spread, settings.touch)
        finest = felt_by(settings.touch)
        if finest != settings.touch:
            felt = levels(above, spread, finest)
        # A reading ends at 0: a larger threshold would leave a pressed taxel untouched. So would a
        # curve that does not rise, and a noise that is no number.
        reached = found.decides <= layout.no_load - calibration.baseline
        reached &= known & curve.sound
        unreached = usable & ~reached
        return cls(settings, usable & ~unreached, unreached, curve, curves, found, felt)

    def measurements(self) -> NDArray[np.int64]:
        """Return in how many measurements both are decided [n]."""
        votes = self.settings.touch.votes_of_3
        found = self.levels.measurements(votes)
        return (
            found if self.felt is self.levels else np.maximum(found, self.felt.measurements(votes))
        )

    def part(self, mine: slice) -> "Rules":
        """Return those of some of the taxels; unusable taxels are never touched."""
        usable = self.usable[mine]

        def of(found: Levels) -> Levels:
            return Levels(
                np.where(usable, found.enter[mine], np.inf),
                np.where(usable, found.leave[mine], np.inf),
                np.where(usable, found.whole[mine], np.inf),
                found.span[mine],
                found.hold[mine],
                found.fall[mine],
                found.votes[mine],
                found.spread[mine],
            )

        called = of(self.levels)
        return Rules(
            self.settings,
            usable,
            self.unreached[mine],
            self.curve.part(mine),
            self.curves,
            called,
            called if self.felt is self.levels else of(self.felt),
        )
