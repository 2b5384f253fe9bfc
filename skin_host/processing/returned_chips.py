"""Which chips of a board were not read for so long that the zeros of their pads may have drifted.

A plug without contact, or a second board at the address, keeps pads from being valid for minutes
while the board goes on sending, in which the skin becomes warmer or colder. Where a part has other
pads, they show what it drifts by; a part of one chip has none. So the first readings of chips that
are read again are compared with their baselines before any of their pads is valid, as those of a
board that was silent for as long are (`silent_zero`).
"""

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Sweep
from skin_host.bus.wire import TRIANGLES
from skin_host.processing.masks import Mask, any_of
from skin_host.processing.silent_zero import DRIFT_S, SilentZero

_BITS = 1 << np.arange(TRIANGLES)
_READ_NS = -1
_DRIFT_NS = round(DRIFT_S * 1e9)


class ReturnedChips:
    """Notes since when triangles of boards have not been read, and compares those that are again.

    Args:
        fitted: by board the triangles bool[16] that there are.

    Attributes:
        compared: by board the triangles bool[16] that are compared, and what compares them.
    """

    def __init__(self, fitted: dict[int, Mask]) -> None:
        self._fitted = fitted
        self._all = {board: int(those @ _BITS) for board, those in fitted.items()}
        #: By board since when (ns) each of its triangles, int64[16], has not been read, where any
        #: is not; `_READ_NS` of the others.
        self._unread: dict[int, NDArray[np.int64]] = {}
        self.compared: dict[int, tuple[Mask, SilentZero]] = {}

    def go_on(self, before: "ReturnedChips") -> None:
        """Take over the state of a predecessor for the same boards."""
        self._unread, self.compared = before._unread, before.compared

    def watches(self, sweep: Sweep) -> bool:
        """Return whether `note` must see a sweep, by what was received: some chip is not read."""
        return bool(self._all[sweep.board] & ~sweep.present) or sweep.board in self._unread

    def note(self, board: int, read: Mask, now_ns: int) -> tuple[Mask, float] | None:
        """Take in which triangles of a board were read in a sweep.

        Args:
            board: its index.
            read: bool[16], those that were.
            now_ns: time of the sweep.

        Returns:
            Triangles bool[16] that are read again after so long that their zeros may have drifted,
            and for how long they were not (s); None if there are none.
        """
        since_ns = self._unread.pop(board, None)
        if since_ns is None:
            since_ns = np.full(TRIANGLES, _READ_NS, np.int64)
        back = read & (since_ns != _READ_NS) & (now_ns - since_ns > _DRIFT_NS)
        lost = self._fitted[board] & ~read
        if any_of(lost):
            lost_ns = np.where(since_ns == _READ_NS, now_ns, since_ns)
            self._unread[board] = np.where(lost, lost_ns, _READ_NS)
        if not any_of(back):
            return None
        return back, float((now_ns - since_ns[back]).max()) * 1e-9

    def step(self, sweep: Sweep, here: Mask) -> tuple[Mask, NDArray[np.float64] | None]:
        """Compare a sweep of a board of which some triangles are compared.

        Args:
            sweep: it.
            here: bool[192], its pads that were received and are readings.

        Returns:
            The triangles bool[16] that are not known yet, and what each pad [192] has drifted by in
            units, once that is known; None if it is not, or is nothing.
        """
        triangles, comparison = self.compared[sweep.board]
        comparison.step(sweep.raw.ravel(), here, sweep.t_ns)
        if not comparison.decided:
            return triangles, None
        del self.compared[sweep.board]
        drifted_units = comparison.drifted_units()
        if drifted_units is not None:
            drifted_units[~np.repeat(triangles, len(here) // TRIANGLES)] = 0.0
        return np.zeros_like(triangles), drifted_units

    def forget(self, board: int) -> None:
        """Compare no triangles of a board any more: its zero is sought, or was measured."""
        self.compared.pop(board, None)
