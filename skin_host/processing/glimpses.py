"""What boards sent while their taxels were not valid, so that what presses then is not missed.

No touch is decided of a taxel that is not valid. What presses one meanwhile must not become part of
its next zero unnoticed, so the last readings are kept until the touches after them are decided.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.masks import Mask
from skin_host.processing.rezero import repeats_of

#: So many conversions show that something presses a taxel which is not valid, ...
GLIMPSED = 3
#: ... or has become it less than this ago: a touch may not be decided yet.
DECIDED_NS = 500_000_000

Floats = NDArray[np.float64]


@dataclass(slots=True)
class _Glimpse:
    """The last readings of a board of which taxels are not valid, or were not just now.

    Attributes:
        units: float64[k, n], the last k that were received of each taxel, the newest first, away
            from its zero; -inf where it was far below zero, NaN where there are fewer.
        until_ns: then its touches are decided.
    """

    units: Floats
    until_ns: int = 0


class Glimpses:
    """The last readings of boards of which taxels are not valid, or were not just now."""

    def __init__(self) -> None:
        self._boards: dict[int, _Glimpse] = {}

    def __iter__(self) -> Iterator[int]:
        return iter(self._boards)

    def __len__(self) -> int:
        return len(self._boards)

    def note(
        self, board: int, units: Floats, here: Mask, t_ns: int, period_s: float, *, blind: bool
    ) -> None:
        """Take in a sweep of a board.

        Args:
            board: its index.
            units: float64[n], the readings, away from zero; -inf of what is far below it.
            here: bool[n], which were received.
            t_ns: when.
            period_s: how often it sends.
            blind: taxels of it are not valid now.
        """
        glimpse = self._boards.get(board)
        if glimpse is None:
            if not blind:
                return
            longest = math.ceil(GLIMPSED * repeats_of(period_s))
            glimpse = self._boards[board] = _Glimpse(np.full((longest, len(units)), np.nan))
        if blind:
            glimpse.until_ns = t_ns + DECIDED_NS
        elif not 0 <= glimpse.until_ns - t_ns <= DECIDED_NS:
            del self._boards[board]
            return
        glimpse.units[1:, here] = glimpse.units[:-1, here]
        glimpse.units[0, here] = units[here]

    def pressed(self, board: int, highest: Floats) -> Mask:
        """Return taxels bool[n] of a board whose last readings are above the highest float64[n]
        that they may read untouched, in units.
        """
        found = np.zeros(len(highest), np.bool_)
        glimpse = self._boards.get(board)
        if glimpse is not None:
            fit = np.count_nonzero(~np.isnan(glimpse.units), axis=0) >= GLIMPSED
            found[fit] = np.nanmedian(glimpse.units[:, fit], axis=0) > highest[fit]
        return found

    def forget(self, board: int) -> None:
        """Drop the readings of a board: they are of another zero."""
        self._boards.pop(board, None)
