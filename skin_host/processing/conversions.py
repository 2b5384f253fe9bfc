"""Finds which bytes are new measurements.

A chip needs 36.9 ms for its twelve stages (AD7147, decimation 256: 3.07 ms each), and a board that
sends more often repeats the last values. A repetition is not a second measurement. Which sweep has
a new one depends on the chip, and within a sweep on the pad: some boards read a whole sequence at
once, others read each value when it is ready.
"""

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.masks import Mask

#: Of a chip's twelve stages at decimation 256.
CONVERSION_S = 0.0369
#: A byte that has not changed for less than this is the same measurement; sweeps may be a little
#: early or late.
YOUNG_S = np.float32(0.95 * CONVERSION_S)
LONG_AGO_S = np.float32(1e9)


class Conversions:
    """Finds which of n pads only repeat their last measurement in a sweep.

    A byte is new when it has changed, or when the last new one is one conversion old.
    """

    def __init__(self, n: int) -> None:
        self._last: NDArray[np.uint8] = np.zeros(n, np.uint8)
        self._age_s = np.full(n, LONG_AGO_S)
        self._repeated: Mask = np.empty(n, np.bool_)
        self._young: Mask = np.empty(n, np.bool_)
        #: Whether every byte of the last sweep was new.
        self._all_new = False

    def step(self, raw: NDArray[np.uint8], dt_s: float) -> Mask | None:
        """Take the bytes [n] of a sweep that comes dt_s after the last.

        Returns:
            bool[n], which repeat a measurement, or None if none can; the array is reused.
        """
        if np.float32(dt_s) >= YOUNG_S:
            self._all_new = True
            self._last = raw
            return None
        repeated, age_s = self._repeated, self._age_s
        if self._all_new:
            self._all_new = False
            age_s.fill(0.0)
        np.add(age_s, np.float32(dt_s), out=age_s)
        np.equal(raw, self._last, out=repeated)
        np.less(age_s, YOUNG_S, out=self._young)
        np.logical_and(repeated, self._young, out=repeated)
        np.multiply(age_s, repeated, out=age_s)
        self._last = raw
        return repeated

    def forget(self) -> None:
        """Sweeps were left out: the next one is new."""
        self._all_new = False
        self._age_s.fill(LONG_AGO_S)
