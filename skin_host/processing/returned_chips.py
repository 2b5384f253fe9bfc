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
_KNOWN_NS = -1
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
        #: By board since when (ns) it is not known what each of its triangles, int64[16], drifts
        #: by, where it is not of any; `_KNOWN_NS` of the others.
        self._since_ns: dict[int, NDArray[np.int64]] = {}
        self.compared: dict[int, tuple[Mask, SilentZero]] = {}

    def go_on(self, before: "ReturnedChips") -> None:
        """Take over the state of a predecessor for the same boards."""
        self._since_ns, self.compared = before._since_ns, before.compared

    def watches(self, sweep: Sweep) -> bool:
        """Return whether `note` must see a sweep, by what was received: some chip is not read, or
        was not.
        """
        return bool(self._all[sweep.board] & ~sweep.present) or sweep.board in self._since_ns

    def note(self, board: int, read: Mask, now_ns: int) -> tuple[Mask, float] | None:
        """Take in which triangles of a board were read in a sweep.

        Args:
            board: its index.
            read: bool[16], those that were.
            now_ns: time of the sweep.

        Returns:
            Triangles bool[16] that are to be compared from now on, as they are read again after so
            long that their zeros may have drifted, and for how long they were not (s); None if
            there are none, or they are being compared.
        """
        since_ns = self._since_ns.pop(board, None)
        lost = self._fitted[board] & ~read
        if since_ns is None:
            if not any_of(lost):
                return None
            since_ns = np.full(TRIANGLES, _KNOWN_NS, np.int64)
        since_ns[lost & (since_ns == _KNOWN_NS)] = now_ns
        since_ns[read & (now_ns - since_ns <= _DRIFT_NS)] = _KNOWN_NS
        unknown = since_ns != _KNOWN_NS
        if not any_of(unknown):
            return None
        self._since_ns[board] = since_ns
        back = read & unknown
        # A plug that gets contact flickers: what is compared already begins again with the others.
        others = back & ~self.compared[board][0] if board in self.compared else back
        if not any_of(others):
            return None
        return back, float((now_ns - since_ns[back]).max()) * 1e-9

    def step(
        self, sweep: Sweep, here: Mask, now_ns: int
    ) -> tuple[Mask, NDArray[np.float64] | None]:
        """Compare a sweep of a board of which some triangles are compared.

        Args:
            sweep: it.
            here: bool[192], its pads that were received and are readings.
            now_ns: time of the sweep.

        Returns:
            The triangles bool[16] that are not known yet, and what each pad [192] has drifted by in
            units, once that is known; None if it is not, or is nothing.
        """
        triangles, comparison = self.compared[sweep.board]
        comparison.step(sweep.raw.ravel(), here, sweep.t_ns)
        if not comparison.decided:
            return triangles, None
        del self.compared[sweep.board]
        known = triangles & np.any(comparison.received.reshape(TRIANGLES, -1), axis=1)
        since_ns = self._since_ns.get(sweep.board)
        if since_ns is not None:
            read = np.any(here.reshape(TRIANGLES, -1), axis=1)
            since_ns[known] = np.where(read[known], _KNOWN_NS, now_ns)
        drifted_units = comparison.drifted_units()
        if drifted_units is not None:
            drifted_units[~np.repeat(known, len(here) // TRIANGLES)] = 0.0
        return triangles & ~known, drifted_units

    def note_measured(self, board: int, triangles: Mask) -> None:
        """The zeros of some triangles, bool[16], of a board have been measured. The others have
        drifted since they were read last.
        """
        self.compared.pop(board, None)
        since_ns = self._since_ns.get(board)
        if since_ns is not None:
            since_ns[triangles] = _KNOWN_NS

    def forget(self, board: int) -> None:
        """Compare no triangles of a board any more: its zero is sought."""
        self.compared.pop(board, None)
        self._since_ns.pop(board, None)
