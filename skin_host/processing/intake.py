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
from skin_host.bus.wire import TAXELS, TRIANGLES
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
class _PartState:
    """A part's sample in progress.

    Attributes:
        rows: of its boards, by their index.
        waits: boards (index: row) whose sweep it waits for.
        source: intp[m], where its values are among those of all boards.
        stamped_ns: time of the last sample that was returned.
        silence_ns: time of the first sample of silence after the last sweep.
        reported_ns: when silence was reported last, on the ledger's clock; -1 if it was not.
    """

    index: int
    rows: dict[int, int]
    waits: dict[int, int]
    source: NDArray[np.intp]
    period_ns: int
    silence_ns: int
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
        # The last sweep of each board, by its row in the ledger.
        shape = (len(ledger.row), TRIANGLES * TAXELS)
        self._raw = np.zeros(shape, np.uint8)
        self._present = np.zeros(shape, np.bool_)
        self._received = np.zeros(shape, np.bool_)
        for index in parts:
            part = layout.parts[index]
            source = np.zeros(part.n_taxels, np.intp)
            rows = {board: ledger.row[board] for board in part.boards}
            for board, row in rows.items():
                flat = layout.boards[board].taxel_index.ravel()
                mine = np.flatnonzero((flat >= part.start) & (flat < part.stop))
                source[flat[mine] - part.start] = row * flat.size + mine
            period_ms = max(layout.boards[board].settings.period_ms for board in part.boards)
            state = _PartState(
                index,
                rows,
                rows.copy(),
                source,
                period_ms * 1_000_000,
                int(silent_periods * period_ms * 1_000_000),
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
        board, t_ns = sweep.board, sweep.t_ns
        states = self._of_board[board]
        row = self._ledger.row[board]
        # Samples that the board's second sweep completes, before it replaces the first.
        completed = [self._sample(state) if board not in state.waits else None for state in states]
        self._raw[row] = sweep.raw.ravel()
        self._present[row] = valid
        self._received[row] = received
        samples: list[PartSample] = []
        for state, sample in zip(states, completed, strict=True):
            if sample is not None:
                samples.append(sample)
            if not state.pending:
                state.first_ns = t_ns
                state.last_ns = t_ns
                state.pending = True
            del state.waits[board]
            state.last_ns = max(state.last_ns, t_ns)
            if not state.waits or (
                self._ledger.any_silent and all(map(self._ledger.is_silent, state.waits.values()))
            ):
                samples.append(self._sample(state))
        return samples

    def missing(self) -> list[dict[int, int]]:
        """Of each part, the boards whose sweeps its next sample waits for."""
        return [state.waits for state in self._states]

    def expire(self, now_ns: int) -> list[PartSample]:
        """Return samples that have waited for a whole period, and report which parts are silent."""
        samples: list[PartSample] = []
        ledger = self._ledger
        for state in self._states:
            if state.pending:
                if abs(now_ns - state.first_ns) > state.period_ns:
                    samples.append(self._sample(state))
                continue
            if state.reported_ns >= 0 and ledger.now_ns - state.reported_ns < SILENCE_REPEAT_NS:
                continue
            if not (ledger.any_silent and all(map(ledger.is_silent, state.rows.values()))):
                continue
            # The first sample of silence has the time at which the wait ended, because late frames
            # may still be newer.
            first = state.reported_ns < 0 and state.last_ns
            t_ns = min(now_ns, state.last_ns + state.silence_ns) if first else now_ns
            state.reported_ns = ledger.now_ns
            state.stamped_ns = t_ns
            none = np.zeros(len(state.source), np.bool_)
            nothing = np.zeros(len(state.source), np.uint8)
            samples.append(PartSample(state.index, nothing, none, none, t_ns))
        return samples

    def flush(self) -> list[PartSample]:
        """Return all samples in progress, at the end of a recording."""
        return [self._sample(state) for state in self._states if state.pending]

    def _sample(self, state: _PartState) -> PartSample:
        """Return a part's sample in progress, and begin the next."""
        source = state.source
        raw = self._raw.ravel()[source]
        present = self._present.ravel()[source]
        received = self._received.ravel()[source]
        if state.waits:
            lost = np.isin(source // self._raw.shape[1], list(state.waits.values()))
            raw[lost] = 0
            present[lost] = received[lost] = False
        if 0 <= state.stamped_ns - state.last_ns < 4 * state.period_ns:
            # A sweep that came after its sample was returned. Times of a part only rise, unless a
            # clock is set back.
            state.last_ns = state.stamped_ns + 1
        state.stamped_ns = state.last_ns
        state.waits = state.rows.copy()
        state.pending = False
        state.reported_ns = -1
        return PartSample(state.index, raw, present, received, state.last_ns)
