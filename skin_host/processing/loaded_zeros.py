"""Zeros that had a load in them when they were taken.

When the load lifts, its taxels read below their zeros, to which nothing can press them:

- Single taxels may bulge beside a touch for a while. Where they stay low, their baselines follow;
  `drift` decides that.
- Where most of a part reads so, or a quarter of one that nothing touches, even for the moment
  between two steps, nothing but a load has lifted: the baselines follow at once.

What then returns to where its baseline was is that load again, or was pulled down and is free. No
reading shows which, until it falls again: then it was a load.
"""

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.masks import Mask

Array = NDArray[np.float64]

#: Normal drift never goes this far below the baseline: the skin bulges, or was loaded before.
FALLEN_UNITS = -2.5
#: So many taxels may bulge beside each that is touched.
BULGED = 10
#: By so many deviations of single readings noise takes the lowest of some means below the level,
#: even where it jumps between two levels.
LOWEST_DEVIATIONS = 1.5
#: Two lifts that are no further apart show that a load lifts: one may be a fault.
STEPS_S = 5.0
#: For this long a taxel may return after a fall, ...
MEMORY_S = 3600.0
#: ... and it has when it reads within this of what its baseline was.
NEAR_UNITS = 1.0
#: What has returned has fallen again when it reads less than this share of what it fell by.
LIFTED_SHARE = 0.5


class LoadedZeros:
    """Which of the n taxels of a part had a load in their zero.

    Attributes:
        returned: bool[n], taxels that read what their baseline was before it fell: they are pressed
            again, or it has returned. The array changes only by being replaced.
    """

    def __init__(self, n: int) -> None:
        self.returned: Mask = np.zeros(n, np.bool_)
        #: For how long it yet counts that each taxel read below its zero as much of the part did.
        self._below_s: Array = np.zeros(n)
        #: The baselines before they fell, and for how long their taxels may yet return.
        self._former: Array = np.zeros(n)
        self._former_s: Array = np.zeros(n)

    @property
    def may_return(self) -> bool:
        """Whether any taxel may return, or has."""
        return bool(np.count_nonzero(self._former_s > 0.0))

    def lifted(
        self, low: Array, noise: Array | float, touched: Mask, received: Mask, dt_s: float
    ) -> Mask | None:
        """Return from which taxels [n] a load has lifted that pressed much of the part when its
        zeros were taken, or None: in two windows so much of it has read below its zeros.

        Args:
            low: lowest reading [n] of each in a window, relaxation included: no model of the foam
                makes it so low.
            noise: of single readings [n].
            touched: taxels [n] that were touched in it.
            received: usable taxels [n] that were received often enough in it.
            dt_s: its length.
        """
        below = (low < FALLEN_UNITS) & received
        surely = below & (low + LOWEST_DEVIATIONS * noise < FALLEN_UNITS)
        n, fallen = int(np.count_nonzero(received)), int(np.count_nonzero(surely))
        pressed = int(np.count_nonzero(touched & ~below))
        most = fallen > max(n // 2, BULGED * pressed)
        # Beside what touches another part no more than the edge of this one may bulge.
        if not most and (pressed or fallen <= max(n // 4, BULGED)):
            self._below_s -= dt_s
            return None
        # Others of a part may be low by noise; of one of which most has fallen they have, too.
        lifted = (below if most else surely) & (self._below_s > 0.0)
        self._below_s = np.where(below, STEPS_S, self._below_s - dt_s)
        return lifted if np.count_nonzero(lifted) else None

    def expect_back(self, fallen: Mask, baseline: Array) -> None:
        """Store the baselines [n] of some taxels before they follow a fall."""
        new = fallen & (self._former_s <= 0.0)
        if np.count_nonzero(new):
            self._former[new] = baseline[new]
            self._former_s[new] = MEMORY_S

    def note_drift(self, change: Array | float) -> None:
        """All readings have changed by this: those from before would be others now."""
        self._former += change

    def note_returns(
        self, level: Array, baseline: Array, still: Mask, missing: Mask, dt_s: float
    ) -> None:
        """Note which taxels read again as they did before a fall, until they fall again.

        Args:
            level: reading [n], relaxation included, on the scale of the baselines [n].
            still: taxels [n] that read the same in the window before.
            missing: those that were received too rarely.
            dt_s: time since the last call.
        """
        self._former_s -= np.where(self.returned, 0.0, dt_s)
        fall = self._former - baseline
        near = np.abs(level - self._former) < NEAR_UNITS
        new = still & (self._former_s > 0.0) & (fall > -FALLEN_UNITS) & near & ~self.returned
        lifted = self.returned & ~missing & (level - baseline < LIFTED_SHARE * fall)
        self._former_s[lifted] = 0.0
        if np.count_nonzero(new) or np.count_nonzero(lifted):
            self.returned = (self.returned | new) & ~lifted

    def forget(self, taxels: Mask) -> None:
        """Some taxels, bool[n], have a new zero."""
        self._below_s[taxels] = 0.0
        self._former_s[taxels] = 0.0
        self.returned = self.returned & ~taxels
