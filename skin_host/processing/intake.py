"""Sweeps of boards to samples of parts.

A part may be fed by several boards, each with its own clock. A sample of the part is
ready when every board that is alive has given a sweep, or when one gives its second: no
board waits for a dead one. What did not come, or came with an error, is not present.

Whether a chip still lives takes longer to tell than all the rest of a sample takes, and is
no matter of one sweep. So what a sweep says of that holds from the next one on, and is
worked out by `judge` when there is time.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Sweep
from skin_host.bus.protocol import TRIANGLES, out_of_range, status_error
from skin_host.layout import Layout
from skin_host.processing.liveness import PADS, Liveness
from skin_host.processing.masks import Mask

#: A silent part says so at once and then once a second.
SILENCE_REPEAT_NS = 1_000_000_000
#: So many pads far below zero pressure are no accident.
LIFTED_PADS = 2
#: Nor is one, while so many are far out of range. Nor are so many, where that is more than so
#: many times the capacitance at which the pressure curve ends.
FAR_PADS = 7
FAR_SHARE = 1.5
_NONE_ERRS = np.zeros(TRIANGLES, np.bool_)
_BITS = np.arange(TRIANGLES)

#: Of a sweep: its bytes, the triangles that came without an error, those with one, and the pads
#: that were touched just before.
_Seen = tuple[NDArray[np.uint8], Mask, Mask, Mask | None]


@dataclass(frozen=True, slots=True)
class PartSample:
    """One part at one instant.

    Attributes:
        part: index into `Layout.parts`.
        raw: uint8[m], 0 where nothing came.
        present: bool[m], the value came, and nothing speaks against it.
        received: bool[m], the same where a veto of the host does not count: what a new
            calibration may be taken from.
        t_ns: time of the last CAN frame in it.
    """

    part: int
    raw: NDArray[np.uint8]
    present: Mask
    received: Mask
    t_ns: int


@dataclass(slots=True)
class _Feed:
    """How one board's 192 values go into one part."""

    board: int
    source: NDArray[np.intp]
    target: NDArray[np.intp]
    alive_until_ns: int = 0
    fresh: bool = False


@dataclass(slots=True)
class _PartState:
    index: int
    n: int
    feeds: dict[int, _Feed]
    period_ns: int
    raw: NDArray[np.uint8]
    present: Mask
    received: Mask
    first_ns: int = 0
    last_ns: int = 0
    said_ns: int = 0
    pending: bool = False
    silent_at_ns: int = field(default=1 << 62)


class Intake:
    """Joins sweeps into samples of parts.

    Args:
        layout: the skin.
        parts: indices of the parts that this daemon reads.
        silent_periods: a board is taken for dead after so many periods without a sweep.
        liveness: who watches each board's bytes, by index of the board; may be replaced.
        full_ff: capacitance at which the curve of pressure ends, of a pad of sensitivity 1.

    Attributes:
        veto: bool[16, 12] by index of the board: taxels that are not to be believed for a
            reason that the bytes do not show.
        touched: bool[16, 12] by index of the board: pads that are touched, where any is.
    """

    def __init__(
        self,
        layout: Layout,
        parts: list[int],
        silent_periods: float,
        liveness: dict[int, Liveness],
        full_ff: float = np.inf,
    ) -> None:
        self.liveness = liveness
        self.veto: dict[int, Mask] = {}
        self.touched: dict[int, Mask] = {}
        self._silent_periods = silent_periods
        self._unjudged: dict[int, _Seen] = {}
        self._unpressable = {
            board: _unpressable(layout, board, full_ff)
            for part in parts
            for board in layout.parts[part].boards
        }
        self._states: list[_PartState] = []
        self._of_board: dict[int, list[_PartState]] = {}
        for index in parts:
            part = layout.parts[index]
            feeds: dict[int, _Feed] = {}
            for board in part.boards:
                flat = layout.boards[board].taxel_index.ravel()
                source = np.flatnonzero((flat >= part.start) & (flat < part.stop))
                feeds[board] = _Feed(board, source, (flat[source] - part.start).astype(np.intp))
            period_ms = max(layout.boards[board].settings.period_ms for board in part.boards)
            state = _PartState(
                index,
                part.n_taxels,
                feeds,
                period_ms * 1_000_000,
                np.zeros(part.n_taxels, np.uint8),
                np.zeros(part.n_taxels, np.bool_),
                np.zeros(part.n_taxels, np.bool_),
            )
            self._states.append(state)
            for board in part.boards:
                self._of_board.setdefault(board, []).append(state)

    def feed(self, sweeps: list[Sweep]) -> list[PartSample]:
        """Take sweeps in order of time, hand on the samples that they complete."""
        samples: list[PartSample] = []
        for sweep in sweeps:
            states = self._of_board.get(sweep.board)
            if states is None:
                continue
            self._judge(sweep.board)
            trusted = self._trusted(sweep)
            veto = self.veto.get(sweep.board)
            received = trusted.ravel()
            trusted = received if veto is None else (trusted & ~veto).ravel()
            raw = sweep.raw.ravel()
            for state in states:
                feed = state.feeds[sweep.board]
                if feed.fresh:
                    self._emit(state, samples)
                if not state.pending:
                    state.first_ns = sweep.t_ns
                    state.last_ns = sweep.t_ns
                    state.pending = True
                feed.fresh = True
                feed.alive_until_ns = sweep.t_ns + int(self._silent_periods * state.period_ns)
                state.raw[feed.target] = raw[feed.source]
                state.present[feed.target] = trusted[feed.source]
                state.received[feed.target] = received[feed.source]
                state.last_ns = max(state.last_ns, sweep.t_ns)
                if all(
                    other.fresh or other.alive_until_ns < sweep.t_ns
                    for other in state.feeds.values()
                ):
                    self._emit(state, samples)
        return samples

    def judge(self) -> None:
        """Bring the liveness of all boards up to their last sweeps; `feed` does it else."""
        for board in list(self._unjudged):
            self._judge(board)

    def _judge(self, board: int) -> None:
        seen = self._unjudged.pop(board, None)
        if seen is not None:
            self.liveness[board].step(*seen)

    def expire(self, now_ns: int) -> list[PartSample]:
        """Hand on what has waited for a whole period, and say which parts are silent."""
        samples: list[PartSample] = []
        for state in self._states:
            if state.pending and now_ns - state.first_ns > state.period_ns:
                self._emit(state, samples)
            if state.silent_at_ns == 1 << 62:
                state.silent_at_ns = now_ns + int(self._silent_periods * state.period_ns)
            elif now_ns > state.silent_at_ns and not state.pending:
                nothing = np.zeros(state.n, np.uint8)
                none = nothing.astype(np.bool_)
                # Stamped with the end of the wait: what comes late may still be newer.
                state.said_ns = state.silent_at_ns
                samples.append(PartSample(state.index, nothing, none, none, state.said_ns))
                state.silent_at_ns = now_ns + SILENCE_REPEAT_NS
        return samples

    def flush(self) -> list[PartSample]:
        """Hand on everything that waits, at the end of a recording."""
        samples: list[PartSample] = []
        for state in self._states:
            if state.pending:
                self._emit(state, samples)
        return samples

    def _trusted(self, sweep: Sweep) -> Mask:
        """bool[16, 12]: the triangle came, its chip answers and lives, the value is in range."""
        here = (sweep.present >> _BITS & 1).astype(np.bool_)
        erring = _NONE_ERRS
        trusted: Mask
        if sweep.status.any():
            erring = status_error(sweep.status) != 0
            here &= ~erring
            far = out_of_range(sweep.status)
            here &= ~lifted(sweep.raw, far)
            unpressable = self._unpressable[sweep.board]
            here &= ~(unpressable & (np.count_nonzero(far, axis=1) >= FAR_PADS))
            trusted = ~far & here[:, None]
        else:
            trusted = np.repeat(here[:, None], PADS, axis=1)
        doubted = self.liveness[sweep.board].doubted
        if doubted is not None:
            trusted &= ~doubted
        self._unjudged[sweep.board] = (sweep.raw, here, erring, self.touched.get(sweep.board))
        return trusted

    def _emit(self, state: _PartState, samples: list[PartSample]) -> None:
        for feed in state.feeds.values():
            if not feed.fresh:
                state.raw[feed.target] = 0
                state.present[feed.target] = False
                state.received[feed.target] = False
            feed.fresh = False
        if 0 <= state.said_ns - state.last_ns < 4 * state.period_ns:
            # A sweep that came after the sample it belongs to. Times of a part only rise, but
            # for a clock that is set back.
            state.last_ns = state.said_ns + 1
        state.said_ns = state.last_ns
        samples.append(
            PartSample(
                state.index,
                state.raw.copy(),
                state.present.copy(),
                state.received.copy(),
                state.last_ns,
            )
        )
        state.pending = False
        state.silent_at_ns = state.last_ns + int(self._silent_periods * state.period_ns)


def _unpressable(layout: Layout, board: int, full_ff: float) -> Mask:
    """Triangles bool[16] of a board that nothing can press far out of their range.

    A pad is far out at twice the capacitance of all its units (reference of the wire, 4.3).
    """
    taxels = layout.boards[board].taxel_index[:, 0]
    far_ff = 2.0 * layout.no_load[taxels] * layout.unit_ff[taxels]
    found: Mask = far_ff > FAR_SHARE * full_ff * layout.sensitivity[taxels]
    return found


def lifted(raw: NDArray[np.uint8], far: Mask) -> Mask:
    """Triangles bool[k] whose pads read far below zero pressure: that is not their chip.

    Pressing cannot do it. Plugs of data lines that were swapped, or a chip at another one's
    address, put the pads of one triangle on the baselines of another.

    Args:
        raw: uint8[k, 12].
        far: bool[k, 12], pads that their status words call far out of range.
    """
    below = np.count_nonzero(far & (raw == 255), axis=-1)
    torn = (below > 0) & (np.count_nonzero(far, axis=-1) >= FAR_PADS)
    found: Mask = (below >= LIFTED_PADS) | torn
    return found
