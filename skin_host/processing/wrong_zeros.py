"""Pads whose own readings show that their zero is wrong: they read what nothing presses them to.

A zero that was taken under a press is that of the pressed pad. When the press lifts, the pad reads
far below zero, which its board marks, or rests at the end of the scale, or beyond it. There nobody
knows where it rests, so that a press is felt late and measured too low.

Several pads of a chip that read far below zero may be those of another chip, see `intake.lifted`.
Where the others of their triangle rest where they did, and none reads more, they are not: the
baselines of two chips differ by far more than noise.
"""

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Sweep
from skin_host.bus.wire import TRIANGLES
from skin_host.processing.drift import SETTLE_S
from skin_host.processing.liveness import PADS
from skin_host.processing.masks import Mask, any_of, count_of
from skin_host.processing.rezero import BELOW_SWEEPS, END, JUMPS_NS

#: One reading inside the scale counts as so many at its end: a pad whose noise reaches inside in a
#: tenth of its readings rests within 1.3 standard deviations of the end.
INSIDE_WEIGHT = 9
#: So many pads of a triangle that rest where they did are those of the same chip.
RESTING_PADS = 2
#: The byte at the end of the scale, to be found among those of a sweep.
_END_BYTE = bytes((END,))
_NO_SWEEPS = np.zeros((TRIANGLES, PADS), np.int64)
_NO_TRIANGLES = np.zeros(TRIANGLES, np.int64)

Sweeps = NDArray[np.int64]


class WrongZeros:
    """Counts for how long pads bool[16, 12] of boards have read what shows a wrong zero.

    Attributes:
        below: by board, in how many sweeps in a row that came its pads int64[16, 12] have read far
            below zero, where any do. They are in doubt from the first on.
    """

    def __init__(self) -> None:
        self.below: dict[int, Sweeps] = {}
        #: By board in how many sweeps in a row the others of each triangle, int64[16], have rested.
        self._others_rest: dict[int, Sweeps] = {}
        #: By board, of how many sweeps more each pad has sent the end of the scale than readings
        #: inside, these by `INSIDE_WEIGHT`, where any have.
        self._at_end: dict[int, Sweeps] = {}
        #: When a board's pad last came back from far below zero by itself.
        self._jumped_ns: dict[int, int] = {}

    def go_on(self, before: "WrongZeros") -> None:
        """Take over the state of a predecessor for the same boards."""
        self.below, self._at_end = before.below, before._at_end
        self._others_rest = before._others_rest
        self._jumped_ns = before._jumped_ns

    def forget(self, board: int) -> None:
        """A board has a new zero: what rested at the end of its scale may do so no more."""
        self._at_end.pop(board, None)

    def follows(self, board: int) -> bool:
        """Return whether `note_below` and `note_resting` have anything to do with a board's sweep
        without far pads.
        """
        return board in self.below or board in self._others_rest

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

    def note_resting(self, board: int, resting: Mask, present: Mask) -> Mask:
        """Return the triangles bool[16] of a board that are of the same chip as before, though pads
        of them read far below zero.

        Args:
            board: its index.
            resting: bool[16], those whose other pads rest in a sweep, see `others_rest`.
            present: bool[16], those that were received in it.
        """
        before = self._others_rest.pop(board, None)
        if before is None and not any_of(resting):
            return resting
        before = _NO_TRIANGLES if before is None else before
        lasted = np.where(present, (before + 1) * resting, before)
        if any_of(lasted > 0):
            self._others_rest[board] = lasted
        same: Mask = lasted >= BELOW_SWEEPS
        return same

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


def others_rest(
    above_units: NDArray[np.float64],
    enter_units: NDArray[np.float64],
    far: Mask,
    known: Mask,
    pressure: Mask,
) -> Mask:
    """Return the triangles bool[16] of which other pads than those that read far below zero show
    that it is not another chip that reads so.

    Args:
        above_units: float64[16, 12], what each pad reads above its baseline.
        enter_units: float64[16, 12], from where on that is a touch.
        far: bool[16, 12], pads that their status words mark as far out of range.
        known: bool[16, 12], those whose baseline is known.
        pressure: bool[16, 12], those that measure pressure.
    """
    resting = known & ~far & (np.abs(above_units) < enter_units)
    # What lifts brings no pad above where it rests. One that warms up may be.
    raised = known & pressure & (above_units >= enter_units)
    raised |= far & (above_units >= 0.0)
    found: Mask = (count_of(resting) >= RESTING_PADS) & (count_of(raised) == 0)
    return found
