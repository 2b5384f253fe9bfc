"""Joins sweeps of boards into samples of parts.

Several boards, each with its own clock, may belong to one part. A sample of the part is ready when
every living board has sent a sweep, or when one sends its second: no board waits for a dead one.
Values that were not received, or are not valid, are not present.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Sweep
from skin_host.bus.ledger import BoardLedger
from skin_host.layout import Layout
from skin_host.processing.masks import Mask

#: A silent part reports its silence at once and then once a second.
SILENCE_REPEAT_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class PartSample:
    """One part at one instant.

    Attributes:
        part: index into `Layout.parts`.
        raw: uint8[m], 0 where nothing was received.
        present: bool[m], the value was received and is valid.
        received: bool[m], the same without regard to a veto of the host: values that a new
            calibration may use.
        t_ns: time of the last CAN frame in it.
    """

    part: int
    raw: NDArray[np.uint8]
    present: Mask
    received: Mask
    t_ns: int


@dataclass(slots=True)
class _Feed:
    """Where one board's 192 values belong in one part."""

    row: int
    source: NDArray[np.intp]
    target: NDArray[np.intp]
    fresh: bool = False


@dataclass(slots=True)
class _PartState:
    """A part's sample in progress.

    Attributes:
        stamped_ns: time of the last sample that was returned.
        silence_ns: time of the first sample of silence after the last sweep.
        reported_ns: when silence was reported last, on the ledger's clock; -1 if it was not.
    """

    index: int
    feeds: dict[int, _Feed]
    period_ns: int
    silence_ns: int
    raw: NDArray[np.uint8]
    present: Mask
    received: Mask
    first_ns: int = 0
    last_ns: int = 0
    stamped_ns: int = 0
    reported_ns: int = -1
    pending: bool = False


class Intake:
    """Joins sweeps into samples of parts.

    Args:
        layout: the skin.
        parts: indices of the parts that this daemon reads.
        ledger: knows which boards have timed out.
        silent_periods: after this many of its periods without a sweep, a part is silent.
    """

    def __init__(
        self, layout: Layout, parts: list[int], ledger: BoardLedger, silent_periods: float
    ) -> None:
        self._ledger = ledger
        self._states: list[_PartState] = []
        self._of_board: dict[int, list[_PartState]] = {}
        for index in parts:
            part = layout.parts[index]
            feeds: dict[int, _Feed] = {}
            for board in part.boards:
                flat = layout.boards[board].taxel_index.ravel()
                source = np.flatnonzero((flat >= part.start) & (flat < part.stop))
                target = (flat[source] - part.start).astype(np.intp)
                feeds[board] = _Feed(ledger.row[board], source, target)
            period_ms = max(layout.boards[board].settings.period_ms for board in part.boards)
            state = _PartState(
                index,
                feeds,
                period_ms * 1_000_000,
                int(silent_periods * period_ms * 1_000_000),
                np.zeros(part.n_taxels, np.uint8),
                np.zeros(part.n_taxels, np.bool_),
                np.zeros(part.n_taxels, np.bool_),
            )
            self._states.append(state)
            for board in part.boards:
                self._of_board.setdefault(board, []).append(state)

    def take(self, sweep: Sweep, valid: Mask, received: Mask) -> list[PartSample]:
        """Take a sweep that the ledger has noted; return the samples that it completes.

        Args:
            sweep: of one board.
            valid, received: bool[192], see `PartSample`.
        """
        samples: list[PartSample] = []
        raw = sweep.raw.ravel()
        for state in self._of_board[sweep.board]:
            feed = state.feeds[sweep.board]
            if feed.fresh:
                self._emit(state, samples)
            if not state.pending:
                state.first_ns = sweep.t_ns
                state.last_ns = sweep.t_ns
                state.pending = True
            feed.fresh = True
            state.raw[feed.target] = raw[feed.source]
            state.present[feed.target] = valid[feed.source]
            state.received[feed.target] = received[feed.source]
            state.last_ns = max(state.last_ns, sweep.t_ns)
            is_silent = self._ledger.is_silent
            if all(other.fresh or is_silent(other.row) for other in state.feeds.values()):
                self._emit(state, samples)
        return samples

    def missing(self) -> list[list[int]]:
        """Of each part, the boards whose sweeps its next sample waits for."""
        return [
            [board for board, feed in state.feeds.items() if not feed.fresh]
            for state in self._states
        ]

    def expire(self, now_ns: int) -> list[PartSample]:
        """Return samples that have waited for a whole period, and report which parts are silent."""
        samples: list[PartSample] = []
        ledger = self._ledger
        for state in self._states:
            if state.pending:
                if abs(now_ns - state.first_ns) > state.period_ns:
                    self._emit(state, samples)
                continue
            if state.reported_ns >= 0 and ledger.now_ns - state.reported_ns < SILENCE_REPEAT_NS:
                continue
            if not all(ledger.is_silent(feed.row) for feed in state.feeds.values()):
                continue
            # The first sample of silence has the time at which the wait ended, because late frames
            # may still be newer.
            first = state.reported_ns < 0 and state.last_ns
            t_ns = min(now_ns, state.last_ns + state.silence_ns) if first else now_ns
            state.reported_ns = ledger.now_ns
            state.stamped_ns = t_ns
            none = np.zeros(len(state.raw), np.bool_)
            samples.append(PartSample(state.index, np.zeros_like(state.raw), none, none, t_ns))
        return samples

    def flush(self) -> list[PartSample]:
        """Return all samples in progress, at the end of a recording."""
        samples: list[PartSample] = []
        for state in self._states:
            if state.pending:
                self._emit(state, samples)
        return samples

    def _emit(self, state: _PartState, samples: list[PartSample]) -> None:
        for feed in state.feeds.values():
            if not feed.fresh:
                state.raw[feed.target] = 0
                state.present[feed.target] = False
                state.received[feed.target] = False
            feed.fresh = False
        if 0 <= state.stamped_ns - state.last_ns < 4 * state.period_ns:
            # A sweep that came after its sample was returned. Times of a part only rise, unless a
            # clock is set back.
            state.last_ns = state.stamped_ns + 1
        state.stamped_ns = state.last_ns
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
        state.reported_ns = -1
