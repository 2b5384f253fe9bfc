"""Pads whose own readings show that their zero is wrong: they read what nothing presses them to.

A zero that was taken under a press is that of the pressed pad. When the press lifts, the pad reads
far below zero, which its board marks, or rests at the end of the scale, or beyond it. There nobody
knows where it rests, so that a press is felt late and measured too low.
"""

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Sweep
from skin_host.bus.wire import TRIANGLES
from skin_host.processing.drift import SETTLE_S
from skin_host.processing.liveness import PADS
from skin_host.processing.masks import Mask, any_of
from skin_host.processing.rezero import BELOW_SWEEPS, END, JUMPS_NS

#: One reading inside the scale counts as so many at its end: a pad whose noise reaches inside in a
#: tenth of its readings rests within 1.3 standard deviations of the end.
INSIDE_WEIGHT = 9
#: The byte at the end of the scale, to be found among those of a sweep.
_END_BYTE = bytes((END,))
_NO_SWEEPS = np.zeros((TRIANGLES, PADS), np.int64)

Sweeps = NDArray[np.int64]


class WrongZeros:
    """Counts for how long pads bool[16, 12] of boards have read what shows a wrong zero.

    Attributes:
        below: by board, in how many sweeps in a row that came its pads int64[16, 12] have read far
            below zero, where any do. They are in doubt from the first on.
    """

    def __init__(self) -> None:
        self.below: dict[int, Sweeps] = {}
        #: By board, of how many sweeps more each pad has sent the end of the scale than readings
        #: inside, these by `INSIDE_WEIGHT`, where any have.
        self._at_end: dict[int, Sweeps] = {}
        #: When a board's pad last came back from far below zero by itself.
        self._jumped_ns: dict[int, int] = {}

    def go_on(self, before: "WrongZeros") -> None:
        """Take over the state of a predecessor for the same boards."""
        self.below, self._at_end = before.below, before._at_end
        self._jumped_ns = before._jumped_ns

    def forget(self, board: int) -> None:
        """A board has a new zero: what rested at the end of its scale may do so no more."""
        self._at_end.pop(board, None)

    def may_be_at_end(self, sweep: Sweep) -> bool:
        """Return whether `note_at_end` has anything to do with a sweep."""
        return sweep.board in self._at_end or _END_BYTE in sweep.raw.tobytes()

    def note_below(
        self,
        sweep: Sweep,
        below: Mask,
        received: tuple[Mask, Mask],
        pressed: Mask,
        no_load: float,
        *,
        is_new: bool,
    ) -> Mask:
        """Return pads bool[16, 12] whose zero was taken while something pressed that has lifted.

        Args:
            sweep: of a board.
            below: bool[16, 12], those that read far below zero in it.
            received: triangles bool[16] that answered, and those that were received at all.
            pressed: bool[16, 12], those that are known to have been pressed: they come back when
                they are pressed again.
            no_load: the byte of an untouched pad as the board was set up.
            is_new: its zero has just been taken; what another zero brings back did not jump.
        """
        answered, present = received
        before = None if is_new else self.below.get(sweep.board)
        self.below.pop(sweep.board, None)
        if before is not None:
            back = (before > 0) & (before < BELOW_SWEEPS) & answered[:, None] & ~pressed
            if any_of(back & (sweep.raw < (no_load + 255) / 2)):
                # What was pressed and lifts stays below zero; what a bad wire brings does not.
                self._jumped_ns[sweep.board] = sweep.t_ns
        if 0 <= sweep.t_ns - self._jumped_ns.get(sweep.board, -JUMPS_NS) < JUMPS_NS:
            return np.zeros_like(below)
        lasted = below.astype(np.int64)
        if before is not None:
            lasted += before * (below | ~present[:, None])
        if any_of(lasted > 0):
            self.below[sweep.board] = lasted
        wrong: Mask = lasted >= BELOW_SWEEPS
        return wrong

    def note_at_end(self, sweep: Sweep, pads: Mask, period_s: float, *, touching: bool) -> Mask:
        """Return pads bool[16, 12] that rest at the end of the scale, or beyond it.

        Their zero was taken under a press that has lifted, but not by so much that their board
        marks them as far out of range, or has drifted that far.

        Args:
            sweep: of a board.
            pads: bool[16, 12], those that were received and are not marked.
            period_s: how often it sends.
            touching: something touches the board. Beside a touch skin bulges, and may read so for
                as long as the touch lasts.
        """
        at_end = pads & (sweep.raw == END)
        lasted = self._at_end.pop(sweep.board, _NO_SWEEPS) - INSIDE_WEIGHT * (pads & ~at_end)
        if not touching:
            lasted += at_end
        np.maximum(lasted, 0, out=lasted)
        if any_of(lasted > 0):
            self._at_end[sweep.board] = lasted
        wrong: Mask = lasted * period_s >= SETTLE_S
        return wrong
