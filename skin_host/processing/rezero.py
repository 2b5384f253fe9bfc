"""Finds the untouched readings of a board's taxels after the board was zeroed.

A board is zeroed when it is set up, and by itself when chips fail to answer (reference of the
wire, section 4.2 and 4.5): it stores one snapshot of every pad, noise included. The host's
calibration is then off by some units, and whatever pressed at that moment has become the zero. So
the host observes the taxels for a while and moves the baselines by their new readings. The zero of
a taxel that was touched just before is unknown; it is in doubt until it is calibrated again.

A press that nobody felt begin (the daemon was not running, the part was disabled) becomes the zero
too. It shows when it lifts: the pad then reads far below zero, which nothing can press it to.
"""

import numpy as np
from numpy.typing import NDArray

#: The new zero is observed for this long, and for this many sweeps if the board is slow; then the
#: pipeline needs the third time to use it.
LOOK_NS = 1_000_000_000
LOOK_SWEEPS = 20
SETTLE_NS = 1_100_000_000
#: Fewer samples than this are not used.
FEWEST = 10
#: A pad that reads far below zero in so many sweeps in a row was pressed when it was zeroed.
BELOW_SWEEPS = 5
#: One that comes back sooner jumps: for so long, none of its board is taken for a lifted press.
JUMPS_NS = 2_000_000_000
#: A zero that has moved by more than this was not that of an untouched pad.
LARGEST_UNITS = 30.0
#: Noise of this many standard deviations must fit between the mean and the end of the scale.
SIGMAS_TO_END = 2.0

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Rezero:
    """Observes the n taxels of a board after the board was zeroed.

    Args:
        touched: bool[n], taxels that were touched just before.
        no_load: float64[n], the byte of an untouched pad as the board was set up.

    Attributes:
        doubted: bool[n], taxels whose zero is not known.
    """

    def __init__(self, touched: Mask, no_load: Floats) -> None:
        self._no_load = no_load
        self._sum = np.zeros(len(no_load))
        self._count = np.zeros(len(no_load), np.int64)
        self._n_far = np.zeros(len(no_load), np.int64)
        self._sweeps = 0
        self._since_ns: int | None = None
        self._ended_ns: int | None = None
        self.doubted: Mask = touched.copy()

    @classmethod
    def over(cls, no_load: Floats, t_ns: int) -> "Rezero":
        """Return one whose zero has long been in use, at a time: only doubts can still arise."""
        rezero = cls(np.zeros(len(no_load), np.bool_), no_load)
        rezero._since_ns = rezero._ended_ns = t_ns - SETTLE_NS
        return rezero

    def step(self, raw: NDArray[np.uint8], present: Mask, far: Mask, t_ns: int) -> bool:
        """Take one sweep; return True once, when it has enough.

        Args:
            raw: uint8[n], the bytes.
            present: bool[n], which of them were received.
            far: bool[n], pads that their board marks as far out of range. Such a byte is no
                reading: boards send it while a data line is shorted, and for some sweeps after.
            t_ns: time of the sweep.
        """
        if self._since_ns is None:
            self._since_ns = t_ns
        if self._ended_ns is not None:
            return False
        if 0 <= t_ns - self._since_ns < LOOK_NS or self._sweeps < LOOK_SWEEPS:
            read = present & ~far
            self._sum += np.where(read, self._no_load - raw, 0.0)
            self._count += read
            self._n_far += present & far
            self._sweeps += 1
            return False
        self._ended_ns = t_ns
        return True

    @property
    def begun(self) -> bool:
        """Return whether a sweep has been received since."""
        return self._since_ns is not None

    def settled(self, t_ns: int) -> bool:
        """Return whether the new baselines are in use."""
        return self._ended_ns is not None and abs(t_ns - self._ended_ns) >= SETTLE_NS

    def finish(self, baseline: Floats, noise: Floats) -> Floats:
        """Return the new baselines [n], in units.

        Args:
            baseline: float64[n], the previous ones.
            noise: float64[n], as calibrated.
        """
        mean = self._sum / np.maximum(self._count, 1)
        enough = self._count >= FEWEST
        # What was far out of range all the time may have another zero when it is back.
        self.doubted |= ~enough & (self._n_far >= FEWEST)
        known = enough & ~self.doubted
        far = known & (np.abs(mean - baseline) > LARGEST_UNITS)
        # Noise that is cut off at the end of the scale gives a wrong mean.
        highest = self._no_load - mean + SIGMAS_TO_END * noise
        far |= known & (highest > 255.0)
        self.doubted |= far
        return np.where(known & ~far, mean, baseline)
