"""Which taxels of a board were pressed when it was zeroed, and what shows that this has lifted.

What presses a pad when its board is zeroed is in its zero: while it stays, the pad reads as if
untouched. When it lifts, the pad reads below its zero, which nothing can press it to. Nothing else
shows it: a pad that still reads at its zero may still be pressed.
"""

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.masks import Mask, any_of
from skin_host.processing.rezero import (
    BELOW_SWEEPS,
    END,
    LEAST_SPREAD,
    SNAPSHOT_SIGMAS,
    STEADY_UNITS,
    Floats,
)

#: What lifted is back when a pad reads no further below its zero than this share of what shows that
#: it lifted.
BACK_SHARE = 0.5


class PressedZero:
    """Observes the n taxels of a board of which some were pressed when it was zeroed.

    Args:
        pressed: bool[n], those.
        no_load: the byte of an untouched pad as the board was set up.
        noise: float64[n], as calibrated, in units.
        repeats: how often the board sends a conversion.

    Attributes:
        pressed: bool[n], those on which nothing shows now that it has lifted.
        lifted: bool[n], the others of them.
    """

    def __init__(self, pressed: Mask, no_load: float, noise: Floats, repeats: float) -> None:
        self.pressed: Mask = pressed.copy()
        self.lifted: Mask = np.zeros_like(pressed)
        self._no_load = no_load
        # The zero is one reading, noise included, and may have drifted.
        below = STEADY_UNITS + SNAPSHOT_SIGMAS * np.maximum(noise, LEAST_SPREAD)
        # What reads the end of the scale all the time has lifted, however noisy it is.
        self._below = np.minimum(below, max(END - no_load, 1.0) - 0.5)
        self._wanted = BELOW_SWEEPS * repeats
        #: In how many sweeps in a row each has read otherwise than is known of it.
        self._other = np.zeros(len(pressed), np.int64)

    def step(self, raw: NDArray[np.uint8], here: Mask) -> bool:
        """Take one sweep; return whether anything has lifted or is back.

        Args:
            raw: uint8[n], the bytes; 255 of a pad that is far below its zero.
            here: bool[n], which of them were received.
        """
        units = self._no_load - raw
        other = (self.pressed & (units < -self._below)) | (
            self.lifted & (units > -BACK_SHARE * self._below)
        )
        self._other = np.where(here, (self._other + 1) * other, self._other)
        turned = self._other >= self._wanted
        if not any_of(turned):
            return False
        self.pressed ^= turned
        self.lifted ^= turned
        self._other[turned] = 0
        return True

    def forget(self, pads: Mask) -> bool:
        """The zeros of some pads, bool[n], are known; return whether those of all are."""
        self.pressed &= ~pads
        self.lifted &= ~pads
        return not any_of(self.pressed | self.lifted)
