"""Distinguishes pads that are pressed beyond their range from pads that are shorted or torn.

A board marks a pad that is twice as far out as its scale reaches. A short circuit does that, and so
does a hard press where the scale is fine. Both send byte 0 then. But a press grows through the
scale, or presses the pads around, too:

- A pad that was touched, and by more than half of its scale, is pressed further.
- Another one that was received until now is pressed if it was touched before, or was at more than
  half of its scale though that was not decided yet, or if pads around it are touched within half a
  second. One damaged frame does not show that.
- What goes far where nothing presses is not pressed, nor is a pad of which nothing is known from
  before, nor one of a chip whose pads nearly all go far at once without having been pressed.

It is pressed for as long as it is far and pads around it are touched. If none of these is, as under
a narrow object, or all are far themselves, a pad that was pressed by more than half counts for
`ALONE_NS` more. What broke in a press stays far when the pads around it are released: if those were
pressed firmly, and for a pad that was pressed less, only `RELEASED_NS` are left.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Sweep
from skin_host.bus.wire import TAXELS, TRIANGLES, out_of_range, status_error, triangles_in
from skin_host.layout import Layout
from skin_host.processing.masks import Mask, any_of, count_of

#: For so long a far pad counts as pressed though nothing around it is touched, see above.
ALONE_NS = 600_000_000_000
RELEASED_NS = 10_000_000_000
#: Sweeps of a board that are kept; of older ones than this (or as many periods) nothing is known.
KEPT_SWEEPS = 4
KEPT_NS = 500_000_000
#: A pad that was not pressed far is believed when it has been far for so long.
LASTS_NS = 100_000_000
#: Within so long, or so many of its sweeps, the touches around it are decided.
DECIDED_NS = 500_000_000
DECIDED_SWEEPS = 4
#: A pad at less than this share of its untouched byte is pressed by more than half of its scale; at
#: less than the other it is pressed firmly.
HALF = 0.5
FIRM = 0.75
#: So many pads of a chip that are far are no accident: if they go far at once, none of them pressed
#: by half before, it is dead.
FAR_PADS = 7


class _Past(NamedTuple):
    """A sweep, the pads bool[16, 12] that were touched before it, and when it came."""

    sweep: Sweep
    touched: Mask | None
    now_ns: int


def _no_pads() -> Mask:
    return np.zeros((TRIANGLES, TAXELS), np.bool_)


def _no_times() -> NDArray[np.int64]:
    return np.zeros((TRIANGLES, TAXELS), np.int64)


@dataclass(slots=True)
class _Far:
    """What is known of a board's far pads, [16, 12] each.

    Attributes:
        far: that were far when they were last received.
        pressed: those of them that are pressed.
        open: those of them that may prove to be pressed yet.
        grown: that were touched and pressed by more than half before.
        touched: that were either before.
        firm: beside which others were pressed firmly.
        beside: pads that were touched while others were far.
        since_ns, sweeps: since when they are far, and in how many sweeps.
        supported_ns: when they were last known to be pressed.
        came_ns: int64[16], when each triangle was last received.
    """

    came_ns: NDArray[np.int64]
    far: Mask = field(default_factory=_no_pads)
    pressed: Mask = field(default_factory=_no_pads)
    open: Mask = field(default_factory=_no_pads)
    grown: Mask = field(default_factory=_no_pads)
    touched: Mask = field(default_factory=_no_pads)
    firm: Mask = field(default_factory=_no_pads)
    beside: Mask = field(default_factory=_no_pads)
    since_ns: NDArray[np.int64] = field(default_factory=_no_times)
    sweeps: NDArray[np.int64] = field(default_factory=_no_times)
    supported_ns: NDArray[np.int64] = field(default_factory=_no_times)

    def forget(self, pads: Mask) -> None:
        """Some pads are not far, or nothing is known of them."""
        kept = ~pads
        for mask in (self.pressed, self.open, self.grown, self.touched, self.firm):
            np.logical_and(mask, kept, out=mask)


class FarPresses:
    """Finds which far pads of some boards are pressed.

    Args:
        layout: the skin.
        boards: indices of the boards, in the order of their rows.
    """

    def __init__(self, layout: Layout, boards: list[int]) -> None:
        self._layout, self._boards = layout, boards
        settings = [layout.boards[board].settings for board in boards]
        self._no_load = [float(one.no_load) for one in settings]
        self._kept_ns = [max(KEPT_NS, KEPT_SWEEPS * one.period_ms * 1_000_000) for one in settings]
        self._past: list[deque[_Past]] = [deque(maxlen=KEPT_SWEEPS) for _ in boards]
        self._known: dict[int, _Far] = {}
        #: By row: which pads [192, 192] of a board are beside each other, once that is needed.
        self._near: dict[int, Mask] = {}

    def note(self, row: int, sweep: Sweep, touched: Mask | None, now_ns: int) -> None:
        """Keep a sweep of a board (its row), after it was judged."""
        self._past[row].append(_Past(sweep, touched, now_ns))

    def forget(self, row: int) -> None:
        """Nothing that a board has sent is known to be of its present zero."""
        self._past[row].clear()
        self._known.pop(row, None)

    def watches(self, row: int) -> bool:
        """Return whether any pad of a board is far, or was when it was last received."""
        return row in self._known

    def pressed(self, row: int) -> Mask:
        """Return the far pads bool[16, 12] of a board that were pressed in its last sweep."""
        known = self._known.get(row)
        return _no_pads() if known is None else known.pressed

    def step(
        self,
        row: int,
        sweep: Sweep,
        far: Mask,
        trusted: Mask,
        vetoed: Mask | None,
        touched: Mask | None,
        now_ns: int,
    ) -> Mask:
        """Take a sweep of a board with far pads, or after one with some.

        Args:
            row: of the board.
            sweep: of it.
            far: bool[16, 12], which its status words mark.
            trusted: bool[16, 12], pads in which there is no doubt.
            vetoed: bool[16, 12], pads whose zero is not known; None if there are none.
            touched: bool[16, 12], pads that are touched; None if none is.
            now_ns: on the ledger's clock.

        Returns:
            bool[16, 12], the far pads that are pressed; a copy.
        """
        known = self._known.get(row)
        if known is None:
            if not any_of(far):
                return _no_pads()
            known = self._known[row] = _Far(np.full(TRIANGLES, now_ns))
        came = triangles_in(sweep.present)
        erring = came & (status_error(sweep.status) != 0)
        answered = came & ~erring
        stale = came & (now_ns - known.came_ns > self._kept_ns[row])
        known.came_ns[came] = now_ns
        here = answered[:, None]
        unknown = erring[:, None] | stale[:, None] | (far & (sweep.raw == 255))
        known.forget(unknown | (here & ~far))
        if vetoed is not None:
            known.forget(vetoed)
            trusted = trusted & ~vetoed
        touched = _no_pads() if touched is None else touched
        at_end = far & here & (sweep.raw == 0)
        new = at_end & trusted & ~known.far & ~stale[:, None]
        if any_of(new):
            self._begin(row, known, new, touched, now_ns)
        known.far = np.where(came[:, None], far, known.far)
        known.sweeps += at_end
        self._go_on(row, known, sweep, at_end & trusted, touched & here & ~far, now_ns)
        if not any_of(known.far):
            del self._known[row]
        pressed: Mask = known.pressed & at_end
        return pressed

    def _begin(self, row: int, known: _Far, new: Mask, touched: Mask, now_ns: int) -> None:
        """Decide what some pads are that were not far before.

        Args:
            row: of the board.
            known: of it.
            new: bool[16, 12], these pads.
            touched: bool[16, 12], pads that are touched.
            now_ns: on the ledger's clock.
        """
        seen, before, felt = self._before(row, now_ns)
        felt |= touched
        by_half = before <= HALF * self._no_load[row]
        grown = new & seen & felt & by_half
        sudden = count_of(new & ~grown) >= FAR_PADS
        known.open |= new & seen
        known.grown |= grown
        known.touched |= new & seen & (felt | by_half)
        known.pressed |= grown
        known.forget(np.repeat(sudden[:, None], TAXELS, axis=1))
        for times in (known.since_ns, known.supported_ns):
            times[new] = now_ns
        known.sweeps[new] = 0

    def _before(self, row: int, now_ns: int) -> tuple[Mask, NDArray[np.uint8], Mask]:
        """Return which pads were received and not far when their triangles last came, their bytes
        then, and which were touched lately, [16, 12] each.
        """
        seen, touched = _no_pads(), _no_pads()
        raw = np.zeros(seen.shape, np.uint8)
        left = np.ones(TRIANGLES, np.bool_)
        for past in reversed(self._past[row]):
            if now_ns - past.now_ns > self._kept_ns[row]:
                break
            if past.touched is not None:
                touched |= past.touched
            came = left & triangles_in(past.sweep.present)
            left &= ~came
            status = past.sweep.status
            raw[came] = past.sweep.raw[came]
            fit = (status_error(status) == 0)[:, None] & ~out_of_range(status)
            seen[came] = fit[came]
        return seen, raw, touched

    def _go_on(
        self,
        row: int,
        known: _Far,
        sweep: Sweep,
        at_end: Mask,
        touched: Mask,
        now_ns: int,
    ) -> None:
        """Decide which pads are pressed, by those beside them that are touched.

        Args:
            row: of the board.
            known: of it.
            sweep: its last.
            at_end: bool[16, 12], far pads at the end of the scale.
            touched: bool[16, 12], touched pads that were received and are not far.
            now_ns: on the ledger's clock.
        """
        if not any_of(known.open | known.pressed):
            return
        way = at_end & (known.open | known.pressed)
        held = self._reached(row, touched, way)
        if any_of(held & ~known.firm):
            firmly = touched & (sweep.raw <= FIRM * self._no_load[row])
            known.firm |= self._reached(row, firmly, way)
        known.beside |= touched
        over = known.firm & ~held
        if any_of(over):
            # Pads that were touched beside it, and are not any more, though they are in range.
            over &= self._reached(row, known.beside & ~touched & ~known.far, way)
        less = way & ~known.grown & ~over & ~held
        if any_of(less):
            # It goes on beside one that was pressed by more than half, for as long as that does.
            lasting = known.pressed & known.grown & ~over
            lasting &= now_ns - known.supported_ns <= ALONE_NS
            held |= less & self._reached(row, lasting, way)
        known.supported_ns[held] = now_ns
        for_ns = now_ns - known.since_ns
        proven = held | known.touched
        known.pressed |= way & proven & (for_ns >= LASTS_NS)
        known.open &= (for_ns <= DECIDED_NS) | (known.sweeps <= DECIDED_SWEEPS)
        limit_ns = np.where(known.grown & ~over, ALONE_NS, RELEASED_NS)
        known.forget(known.pressed & (now_ns - known.supported_ns > limit_ns))

    def _reached(self, row: int, pads: Mask, way: Mask) -> Mask:
        """Return which pads of `way` are beside some pads, or beside others of it that are, and
        those pads themselves that are of it; bool[16, 12] each.
        """
        found: Mask = (pads & way).ravel()
        if not any_of(pads) or not any_of(way):
            return found.reshape(pads.shape)
        near, free = self._beside(row), way.ravel()
        reached = pads.ravel()
        while any_of(reached):
            reached = near[reached].any(axis=0) & free & ~found
            found |= reached
        return found.reshape(pads.shape)

    def _beside(self, row: int) -> Mask:
        near = self._near.get(row)
        if near is None:
            layout = self._layout
            taxels = layout.boards[self._boards[row]].taxel_index.ravel()
            place = np.full(layout.n_taxels + 1, -1)
            place[taxels] = np.arange(taxels.size)
            place[-1] = -1
            near = np.zeros((taxels.size, taxels.size), np.bool_)
            for pad in np.flatnonzero(taxels >= 0).tolist():
                begin, end = layout.neighbour_start[taxels[pad] : taxels[pad] + 2].tolist()
                others = place[layout.neighbour[begin:end]]
                near[pad, others[others >= 0]] = True
            self._near[row] = near
        return near
