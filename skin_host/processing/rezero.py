"""A board has taken a new zero: where do its untouched taxels read now?

A board takes its zero when it is set up, and by itself when chips fail to answer
(reference of the wire, section 4.2 and 4.5): one snapshot of every pad, noise included.
What the host calibrated before is then off by some units, and whatever pressed at that
moment has become the zero. So the taxels are looked at for a while and the baselines
moved by what they read since. A taxel that was touched just before has no zero that
anybody could know; it is in doubt until it is calibrated again.
"""

import numpy as np
from numpy.typing import NDArray

#: The new zero is looked at for so long, and for so many sweeps, however slow the board; then the
#: pipeline needs so long to take it over.
LOOK_NS = 1_000_000_000
LOOK_SWEEPS = 20
SETTLE_NS = 1_100_000_000
#: Less samples than this say nothing.
FEWEST = 10
#: A zero that has moved by more than this was not taken of an untouched pad.
LARGEST_UNITS = 30.0
#: Noise of so many standard deviations must fit between the mean and the end of the scale.
SIGMAS_TO_END = 2.0

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Rezero:
    """Looks at the n taxels of a board after it took a new zero.

    Args:
        touched: bool[n], what was touched just before.
        no_load: float64[n], the byte of an untouched pad as the board was told.

    Attributes:
        doubted: bool[n], taxels whose zero is not known.
    """

    def __init__(self, touched: Mask, no_load: Floats) -> None:
        self._no_load = no_load
        self._sum = np.zeros(len(no_load))
        self._count = np.zeros(len(no_load), np.int64)
        self._sweeps = 0
        self._since_ns: int | None = None
        self._ended_ns: int | None = None
        self.doubted: Mask = touched.copy()

    def step(self, raw: NDArray[np.uint8], present: Mask, t_ns: int) -> bool:
        """Take one sweep: bytes [n], and which were received. True once: it has seen enough."""
        if self._since_ns is None:
            self._since_ns = t_ns
        if self._ended_ns is not None:
            return False
        if 0 <= t_ns - self._since_ns < LOOK_NS or self._sweeps < LOOK_SWEEPS:
            self._sum += np.where(present, self._no_load - raw, 0.0)
            self._count += present
            self._sweeps += 1
            return False
        self._ended_ns = t_ns
        return True

    @property
    def begun(self) -> bool:
        """Whether a sweep has come since."""
        return self._since_ns is not None

    def settled(self, t_ns: int) -> bool:
        """Whether the new baselines are in use."""
        return self._ended_ns is not None and abs(t_ns - self._ended_ns) >= SETTLE_NS

    def finish(self, baseline: Floats, noise: Floats) -> Floats:
        """Return the baselines [n] that hold from now on, in units.

        Args:
            baseline: float64[n], those of before.
            noise: float64[n], as calibrated.
        """
        mean = self._sum / np.maximum(self._count, 1)
        known = (self._count >= FEWEST) & ~self.doubted
        far = known & (np.abs(mean - baseline) > LARGEST_UNITS)
        # Noise that the end of the scale cuts off has no mean.
        highest = self._no_load - mean + SIGMAS_TO_END * noise
        far |= known & (highest > 255.0)
        self.doubted |= far
        return np.where(known & ~far, mean, baseline)
