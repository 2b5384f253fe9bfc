"""Finds the untouched readings of a board's taxels after the board was zeroed.

A board is zeroed when it is set up, and by itself when chips fail to answer (reference of the
wire, section 4.2 and 4.5): it stores one snapshot of every pad, noise included. The host's
calibration is then off by some units, and whatever pressed at that moment has become the zero. So
the host observes the taxels for a while and moves the baselines by their new readings. The zero of
a taxel that was touched just before is unknown; it is in doubt until it is calibrated again.

A press that nobody felt begin (the daemon was not running) becomes the zero too. It shows when it
lifts: the pad then reads far below zero, which nothing can press it to.
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

    A taxel of which too few bytes came, because frames were lost, is observed for longer: its old
    zero is wrong, and its new one is not known.

    Args:
        touched: bool[n], taxels that were touched just before.
        no_load: float64[n], the byte of an untouched pad as the board was set up.
        fitted: bool[n], taxels that there are.

    Attributes:
        doubted: bool[n], taxels whose zero is not known.
    """

    def __init__(self, touched: Mask, no_load: Floats, fitted: Mask) -> None:
        self._no_load = no_load
        self._sum = np.zeros(len(no_load))
        self._count = np.zeros(len(no_load), np.int64)
        self._n_far = np.zeros(len(no_load), np.int64)
        self._sweeps = 0
        self._since_ns: int | None = None
        self._t_ns = 0
        #: Taxels whose new zero is not found yet, whether there are any, when each was found, and
        #: when the first and the last were.
        self._sought: Mask = fitted.copy()
        self._seeks = bool(fitted.any())
        self._found_ns = np.zeros(len(no_load), np.int64)
        self._first_ns: int | None = None
        self._last_ns = 0
        self.doubted: Mask = touched.copy()

    @classmethod
    def over(cls, no_load: Floats, t_ns: int) -> "Rezero":
        """Return one whose zero has long been in use, at a time: only doubts can still arise."""
        none = np.zeros(len(no_load), np.bool_)
        rezero = cls(none, no_load, none)
        rezero._since_ns = rezero._first_ns = rezero._last_ns = t_ns - SETTLE_NS
        return rezero

    def step(self, raw: NDArray[np.uint8], present: Mask, far: Mask, t_ns: int) -> bool:
        """Take one sweep; return whether `finish` has new zeros.

        Args:
            raw: uint8[n], the bytes.
            present: bool[n], which of them were received.
            far: bool[n], pads that their board marks as far out of range. Such a byte is no
                reading: boards send it while a data line is shorted, and for some sweeps after.
            t_ns: time of the sweep.
        """
        if self._since_ns is None:
            self._since_ns = t_ns
        if not self._seeks:
            return False
        self._t_ns = t_ns
        looks = 0 <= t_ns - self._since_ns < LOOK_NS or self._sweeps < LOOK_SWEEPS
        observed = present & self._sought
        if not looks:
            observed &= ~self._enough
        read = observed & ~far
        self._sum += np.where(read, self._no_load - raw, 0.0)
        self._count += read
        self._n_far += observed & far
        self._sweeps += 1
        return not looks and bool((self._sought & self._enough).any())

    @property
    def _enough(self) -> Mask:
        """Return which taxels [n] have been observed often enough, at their rest or far off."""
        enough: Mask = (self._count >= FEWEST) | (self._n_far >= FEWEST)
        return enough

    @property
    def begun(self) -> bool:
        """Return whether a sweep has been received since."""
        return self._since_ns is not None

    def settled(self, t_ns: int) -> bool:
        """Return whether new baselines are in use, but for those of `unsettled`."""
        return self._first_ns is not None and abs(t_ns - self._first_ns) >= SETTLE_NS

    def unsettled(self, t_ns: int) -> Mask | None:
        """Return the taxels bool[n] whose new baseline is not in use; None if there are none."""
        if not self._seeks and abs(t_ns - self._last_ns) >= SETTLE_NS:
            return None
        unsettled: Mask = self._sought | (np.abs(t_ns - self._found_ns) < SETTLE_NS)
        return unsettled

    def finish(self, baseline: Floats, noise: Floats) -> tuple[Mask, Floats]:
        """Return the taxels bool[n] that have been observed enough now, and the new baselines [n],
        in units.

        Args:
            baseline: float64[n], the previous ones.
            noise: float64[n], as calibrated.
        """
        found = self._sought & self._enough
        self._sought &= ~found
        self._seeks = bool(self._sought.any())
        self._found_ns[found] = self._last_ns = self._t_ns
        if self._first_ns is None:
            self._first_ns = self._t_ns
        mean = self._sum / np.maximum(self._count, 1)
        enough = self._count >= FEWEST
        # What was far out of range all the time may have another zero when it is back.
        self.doubted |= found & ~enough
        known = found & ~self.doubted
        far = known & (np.abs(mean - baseline) > LARGEST_UNITS)
        # Noise that is cut off at the end of the scale gives a wrong mean.
        highest = self._no_load - mean + SIGMAS_TO_END * noise
        far |= known & (highest > 255.0)
        self.doubted |= far
        return found, np.where(known & ~far, mean, baseline)
