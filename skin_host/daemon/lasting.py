"""Which touches are kept in a file, so that a crash or a power failure does not forget them.

Each write of the file costs a disk of flash some of its life, and touches come and go all the time.
So a touch is kept only once it has lasted, and a board's touches until it has been untouched for a
while; those of a board that is touched all the time are reviewed now and then. A board that falls
silent in a touch may be zeroed in it: that is kept at once.
"""

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.masks import Mask

#: Touches are looked at this often; those that two looks in a row find are kept.
LOOK_S = 2.0
#: The touches of a board are kept until it has been untouched for so long.
UNTOUCHED_S = 10.0
#: What has not been touched since the review before is no longer kept, so often: a hand in use is
#: never untouched, and a crash would leave all in doubt that it has ever felt.
REVIEW_S = 30.0


class LastingTouches:
    """The touches of n taxels that are to be kept.

    Args:
        boards: int[n], the board of each taxel.
        kept: bool[n], taxels whose touches are in the file.

    Attributes:
        kept: the same, from then on.
    """

    def __init__(self, boards: NDArray[np.int64], kept: Mask) -> None:
        self.kept: Mask = kept.copy()
        self._boards = boards
        self._before: Mask = np.zeros_like(kept)
        self._looked_s = self._reviewed_s = -np.inf
        #: What was touched since the last review.
        self._lately: Mask = np.zeros_like(kept)
        #: When each board was last touched.
        self._touched_s = np.full(int(boards.max(initial=-1)) + 1, -np.inf)

    def is_due(self, now_s: float) -> bool:
        """Return whether the next look may change what is kept, even if no board is silent."""
        return now_s - self._looked_s >= LOOK_S

    def look(self, touched: Mask, silent: Mask, now_s: float) -> bool:
        """Look at what is touched; return whether what is to be kept has changed.

        Args:
            touched: bool[n], what something touches, or did when it was last known.
            silent: bool[n], taxels of silent boards.
            now_s: the time.
        """
        before = self.kept.tobytes()
        self.kept |= touched & silent
        if self.is_due(now_s):
            self._looked_s = now_s
            self.kept |= touched & self._before
            self._before = touched
            self._touched_s[self._boards[touched]] = now_s
            self.kept &= (now_s - self._touched_s < UNTOUCHED_S)[self._boards]
            self._lately |= touched
            if now_s - self._reviewed_s >= REVIEW_S:
                self._reviewed_s = now_s
                self.kept &= self._lately
                self._lately = touched.copy()
        return self.kept.tobytes() != before

    def calibrated(self, taxels: Mask) -> None:
        """The zeros of these taxels, bool[n], have been measured: none is touched by them."""
        self.kept &= ~taxels
        self._before = self._before & ~taxels
