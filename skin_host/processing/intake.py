"""Joins sweeps of boards into samples of parts, and decides which of their taxels are valid.

Several boards, each with its own clock, may belong to one part. A sample of the part is ready when
every living board has sent a sweep, or when one sends its second: no board waits for a dead one.
Values that were not received, or are not valid, are not present.

A value is valid when its triangle was received, its chip answers (status words), it is not far out
of range, or is so because it is pressed (`far_presses`), its chip lives (`liveness`), the zero of
its board is known, and no second board sends at its address.

Deciding whether a chip lives takes more computing time than everything else of a sample, and does
not depend on one sweep. So a sweep affects that decision only from the next sweep on. It is made
for all boards at once: when every board that sends has sent, or before one sends again.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Sweep
from skin_host.bus.compensation import thermal_gains
from skin_host.bus.ledger import BoardLedger
from skin_host.bus.wire import TAXELS, TRIANGLES
from skin_host.layout import Layout
from skin_host.processing.far_presses import FAR_PADS, FarPresses
from skin_host.processing.liveness import PADS, Liveness
from skin_host.processing.masks import Mask, any_of, count_of
from skin_host.processing.stuck import Encoding, Repeats

#: Sweeps that are further apart, in periods, are of no one sample, however they were read.
APART_PERIODS = 2
#: A silent part reports its silence at once and then once a second.
SILENCE_REPEAT_NS = 1_000_000_000
#: This many pads far below zero pressure are not an accident.
LIFTED_PADS = 2
#: One such pad is enough while `FAR_PADS` pads are far out of range. That many far pads are enough
#: alone where "far" is more than this multiple of the capacitance at which the pressure curve ends.
FAR_SHARE = 1.5
#: A triangle that reads like another chip's twice within this time, or within this many periods,
#: stays so until it has not for as long: which of its sweeps show it is up to noise.
AGAIN_NS = 1_000_000_000
AGAIN_PERIODS = 10
LONG_AGO_NS = -1 << 60


class PartSample(NamedTuple):
    """One part at one instant.

    Attributes:
        part: index into `Layout.parts`.
        raw: uint8[m], 0 where nothing was received.
        present: bool[m], the value was received and is valid.
        received: bool[m], the same without regard to a veto of the host, and to noise, which a
            calibration measures, and without what is far out of range: values that a new
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
        faster: boards that send more often than its slowest: of several sweeps the newest counts.
        source: intp[m], where its values are among those of all boards.
        stamped_ns: time of the last sample that was returned.
        silence_ns: time of the first sample of silence after the last sweep.
        reported_ns: when silence was reported last, on the ledger's clock; -1 if it was not.
        present, received: of its last sample, None once those of a board have changed.
    """

    index: int
    rows: dict[int, int]
    waits: dict[int, int]
    faster: frozenset[int]
    source: NDArray[np.intp]
    period_ns: int
    silence_ns: int
    first_ns: int = 0
    last_ns: int = 0
    stamped_ns: int = 0
    reported_ns: int = -1
    pending: bool = False
    present: Mask | None = None
    received: Mask | None = None


class Intake:
    """Takes the sweeps of a node's boards.

    Args:
        layout: the skin.
        parts: indices of the parts that this daemon reads.
        boards: indices of their boards, in the order of the ledger.
        ledger: of these boards.
        silent_periods: after this many of its periods without a sweep, a part is silent.
        full_ff: capacitance at which the curve of pressure ends, of a pad of sensitivity 1.

    Attributes:
        liveness: of all triangles, those of one board after those of another.
        taxels: int32[16 b, 12], the taxel of each pad, in the order of `liveness`; -1 where there
            is none.
        veto: bool[16, 12] by row of the board: taxels that are invalid for a reason that the
            bytes do not show.
        touched: bool[16, 12] by row of the board: pads that are touched, where any is.
        zeroed_pressed: bool[16, 12] by row of the board: pads that were pressed when it was zeroed.
            Once that lifts they read far below zero, and show no other chip.
        far_presses: which of the pads that are far out of range are pressed.
    """

    def __init__(
        self,
        layout: Layout,
        parts: list[int],
        boards: list[int],
        ledger: BoardLedger,
        silent_periods: float,
        full_ff: float = np.inf,
    ) -> None:
        self._layout = layout
        self._boards = boards
        self._ledger = ledger
        self._unpressable = np.array([unpressable(layout, board, full_ff) for board in boards])
        self.veto: dict[int, Mask] = {}
        self.touched: dict[int, Mask] = {}
        self.zeroed_pressed: dict[int, Mask] = {}
        self.far_presses = FarPresses(layout, boards)
        n = len(boards)
        # The last sweep of each board, by its row.
        shape = (n, TRIANGLES * TAXELS)
        self._raw = np.zeros(shape, np.uint8)
        self._bytes = self._raw.reshape(-1)
        self._present = np.zeros(shape, np.bool_)
        self._received = np.zeros(shape, np.bool_)
        #: The masks that were copied there.
        self._masks: list[tuple[Mask, Mask] | None] = [None] * n
        #: By row: of a sweep without status words, the triangles that were received and, as bytes,
        #: what is in doubt, and the masks made of that.
        self._usual: list[tuple[int, bytes | None, tuple[Mask, Mask]] | None] = [None] * n
        #: By row: the masks of the last sweep with status words; and of which masks, and with which
        #: veto, others were made.
        self._last: list[tuple[Mask, Mask] | None] = [None] * n
        self._vetoed: dict[int, tuple[tuple[Mask, Mask], bytes, tuple[Mask, Mask]]] = {}
        #: When each triangle read like another chip's last, and until when its readings are not
        #: taken for that, on the ledger's clock; by row the last of these.
        self._another_ns = np.full((n, TRIANGLES), LONG_AGO_NS, np.int64)
        self._untaken_ns = self._another_ns.copy()
        self._until_ns = [0] * n
        self._again_ns = [
            max(AGAIN_NS, AGAIN_PERIODS * 1_000_000 * layout.boards[board].settings.period_ms)
            for board in boards
        ]
        # What is not judged yet.
        self._waiting = np.zeros(n, np.bool_)
        self._n_waiting = 0
        #: Triangles of each board's last sweep.
        self._here = np.zeros((n, TRIANGLES), np.bool_)
        self._none = np.zeros(n * TRIANGLES, np.bool_)
        nothing = np.zeros(TRIANGLES * TAXELS, np.bool_)
        nothing.flags.writeable = False
        #: Of a sweep whose readings are not taken.
        self._nothing = nothing, nothing
        self._erring: dict[int, NDArray[np.uint8]] = {}
        self._felt: dict[int, Mask] = {}
        #: What it was at the last judgement with any, and the same over all boards.
        self._felt_before: tuple[dict[int, Mask], Mask] = {}, np.zeros((0, PADS), np.bool_)
        of_boards = [layout.boards[board].taxel_index for board in boards]
        self.taxels = np.array(of_boards, np.int32).reshape(-1, PADS)
        self._encodings = _encodings(layout, boards)
        self.liveness = self._new_liveness(None)
        self._states = [self._new_state(part, silent_periods) for part in parts]
        self._waits = [state.waits for state in self._states]
        self._of_board: dict[int, list[_PartState]] = {board: [] for board in boards}
        for state in self._states:
            for board in state.rows:
                self._of_board[board].append(state)

    def use(
        self,
        noise: NDArray[np.float64] | None,
        boards: Mask,
        pressed_units: NDArray[np.float64] | None = None,
    ) -> None:
        """Use a calibrated noise.

        Args:
            noise: float64[n] over the skin in units, NaN where it is not known, or None without a
                calibration.
            boards: bool[b], the calibrated ones; the others continue unchanged.
            pressed_units: float64[n], noise as measured under pressure, NaN where it is not known.
        """
        self.judge()
        before, self.liveness = self.liveness, self._new_liveness(noise, pressed_units)
        self.liveness.keep(before, ~boards)
        for row in np.flatnonzero(boards).tolist():
            self.veto.pop(row, None)
            self.far_presses.forget(row)
            self._untaken_ns[row] = self._another_ns[row] = LONG_AGO_NS
            self._until_ns[row] = 0

    def go_on(self, before: "Intake") -> None:
        """Take over the state of a predecessor for the same boards."""
        before.judge()
        self._ledger = before._ledger
        self.liveness = before.liveness
        self.veto = before.veto
        self.touched = before.touched
        self.zeroed_pressed = before.zeroed_pressed
        self.far_presses = before.far_presses
        self._raw, self._bytes = before._raw, before._bytes
        self._present, self._received = before._present, before._received
        self._masks, self._usual, self._here = before._masks, before._usual, before._here
        self._another_ns, self._untaken_ns = before._another_ns, before._untaken_ns
        self._until_ns = before._until_ns
        self._states, self._of_board = before._states, before._of_board
        self._waits = before._waits

    def take(self, sweep: Sweep, row: int) -> list[PartSample]:
        """Take a sweep that the ledger has just noted; return the samples that it completes.

        Args:
            sweep: of one board.
            row: of the board.
        """
        if self._waiting[row]:
            self.judge()
        masks = self._valid(row, sweep)
        board, t_ns = sweep.board, sweep.t_ns
        states = self._of_board[board]
        # Samples that the board's second sweep completes, before it replaces the first.
        completed: dict[int, PartSample] = {}
        for state in states:
            if (board not in state.waits and board not in state.faster) or (
                state.pending and abs(t_ns - state.first_ns) > APART_PERIODS * state.period_ns
            ):
                completed[state.index] = self._sample(state)
        self._raw[row] = sweep.raw.reshape(-1)
        if masks is not self._masks[row]:
            self._masks[row] = masks
            self._present[row], self._received[row] = masks
            for state in states:
                state.present = None
        samples: list[PartSample] = []
        for state in states:
            if completed and state.index in completed:
                samples.append(completed[state.index])
            if not state.pending:
                state.first_ns = t_ns
                state.last_ns = t_ns
                state.pending = True
            elif t_ns > state.last_ns:
                state.last_ns = t_ns
            state.waits.pop(board, None)
            if not state.waits or (
                self._ledger.any_silent and all(map(self._ledger.is_silent, state.waits.values()))
            ):
                samples.append(self._sample(state))
        return samples

    def note_gap(self, row: int, missed: int = 0) -> None:
        """A board's next sweep does not follow the one before it: see `Liveness.note_gap`."""
        if self._waiting[row]:
            # The one before may itself not be judged yet.
            self.judge()
        self.liveness.note_gap(row, missed)

    def takes(self, row: int, number: int) -> bool:
        """Return whether the readings of a triangle in the last sweep of a board (its row) are
        taken: it was received without an error, and in its range.
        """
        return bool(self._here[row, number])

    def bytes_of(self, row: int) -> NDArray[np.uint8]:
        """Return the bytes uint8[192] of the last sweep of a board (its row) that was taken."""
        found: NDArray[np.uint8] = self._raw[row]
        return found

    def missing(self) -> list[dict[int, int]]:
        """Of each part, the boards whose sweeps its next sample waits for."""
        return self._waits

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
        self.liveness.catch_up()
        return [self._sample(state) for state in self._states if state.pending]

    def _valid(self, row: int, sweep: Sweep) -> tuple[Mask, Mask]:
        """Return which taxels of a noted sweep are valid, and which a calibration may use.

        Args:
            row: of the board.
            sweep: of the board.
        """
        ledger = self._ledger
        if sweep.missed:
            self.note_gap(row, sweep.missed)
        if row in ledger.twice:
            # Which of the two boards it is of, nobody knows: it shows neither that a chip lives nor
            # what is a zero.
            self._here[row] = False
            self._usual[row] = None
            self.far_presses.forget(row)
            masks = self._nothing
        elif ledger.flagged[row] or ledger.now_ns < self._until_ns[row]:
            pressed = self._pressed_far(row, sweep)
            here = self._flagged(row, sweep.raw, pressed)
            # A copy: it may be judged after the ledger has noted the next sweep.
            self._erring[row] = ledger.error[row].copy()
            masks = self._without_doubt(row, here[:, None] & ~ledger.far[row])
            if any_of(pressed):
                pressed &= here[:, None]
                masks = masks[0] | self._without_doubt(row, pressed)[0], masks[1]
                masks[0].flags.writeable = False
            before = self._last[row]
            # The same arrays as before are known to be the same further on.
            if before is not None and all(map(np.array_equal, before, masks)):
                masks = before
            else:
                self._last[row] = masks
            self._here[row] = here
            self._usual[row] = None
        else:
            if self.far_presses.watches(row):
                self._pressed_far(row, sweep)
            # Most sweeps have nothing but the triangles of the one before.
            key = self._doubts_of(row)
            usual = self._usual[row]
            if usual is None or usual[0] != sweep.present or usual[1] != key:
                here = ledger.present[row]
                every = np.broadcast_to(here[:, None], (TRIANGLES, PADS))
                self._here[row] = here
                usual = sweep.present, key, self._without_doubt(row, every)
                self._usual[row] = usual
            masks = usual[2]
        self._waiting[row] = True
        self._n_waiting += 1
        touched = self.touched.get(row)
        if touched is not None:
            self._felt[row] = touched
        if row not in ledger.twice:
            self.far_presses.note(row, sweep, touched, ledger.now_ns)
        veto = self.veto.get(row)
        if veto is None:
            return masks
        key = veto.tobytes()
        known = self._vetoed.get(row)
        if known is None or known[0] is not masks or known[1] != key:
            self._vetoed[row] = known = masks, key, (masks[0] & ~veto.ravel(), masks[1])
        return known[2]

    def _doubts_of(self, row: int) -> bytes | None:
        """Return what is in doubt of a board's pads, as bytes; None if nothing is."""
        if self.liveness.doubted is None or self.liveness.lifeless is None:
            return None
        mine = slice(TRIANGLES * row, TRIANGLES * (row + 1))
        return self.liveness.doubted[mine].tobytes() + self.liveness.lifeless[mine].tobytes()

    def _without_doubt(self, row: int, pads: Mask) -> tuple[Mask, Mask]:
        """Return those of a board's pads (bool[16, 12]) that no doubt is in, and those that at most
        noise is in, bool[192]: one mask twice where they are the same.
        """
        doubted, lifeless = self.liveness.doubted, self.liveness.lifeless
        if doubted is None or lifeless is None:
            present = pads.ravel().copy()
            present.flags.writeable = False
            return present, present
        mine = slice(TRIANGLES * row, TRIANGLES * (row + 1))
        present = (pads & ~doubted[mine]).ravel()
        received = (pads & ~lifeless[mine]).ravel()
        present.flags.writeable = received.flags.writeable = False
        return (present, present) if np.array_equal(present, received) else (present, received)

    def _pressed_far(self, row: int, sweep: Sweep) -> Mask:
        """Return pads bool[16, 12] of a sweep that are pressed far out of their range."""
        ledger, doubted = self._ledger, self.liveness.doubted
        far = self.far_of(row)
        if not self.far_presses.watches(row) and not any_of(far):
            return far
        trusted = np.repeat(~self.reads_another(row, sweep.raw)[:, None], PADS, axis=1)
        if doubted is not None:
            trusted &= ~doubted[TRIANGLES * row : TRIANGLES * (row + 1)]
        return self.far_presses.step(
            row,
            sweep,
            far,
            trusted,
            self.veto.get(row),
            self.touched.get(row),
            ledger.now_ns,
        )

    def reads_another(self, row: int, raw: NDArray[np.uint8]) -> Mask:
        """Return the triangles bool[16] of a board that read like another chip, see `lifted`.

        Args:
            row: of the board; the ledger has noted its sweep.
            raw: uint8[16, 12], the bytes of that.
        """
        far = self._unexplained(row)
        return lifted(raw, far) if any_of(far) else np.zeros(TRIANGLES, np.bool_)

    def far_of(self, row: int) -> Mask:
        """Return pads bool[16, 12] of a board that are far out of range, of chips that answer: the
        others are so for as long as they do not.
        """
        ledger = self._ledger
        far: Mask = ledger.far[row] & ledger.answered(row)[:, None]
        return far

    def _unexplained(self, row: int) -> Mask:
        """Return pads bool[16, 12] of a board that are far out of range, and were not pressed when
        it was zeroed.
        """
        far = self.far_of(row)
        pressed = self.zeroed_pressed.get(row)
        return far if pressed is None else far & ~pressed

    def _flagged(self, row: int, raw: NDArray[np.uint8], pressed: Mask) -> Mask:
        """Return triangles bool[16] of a sweep with status words that were received, answer, and
        are in their range but for the pads bool[16, 12] that are pressed beyond it.
        """
        ledger = self._ledger
        another = self.reads_another(row, raw)
        if any_of(self._unpressable[row]):
            far = self._unexplained(row)
            another |= self._unpressable[row] & (count_of(far & ~pressed) >= FAR_PADS)
        here = ledger.answered(row)
        another &= here
        now_ns, untaken_ns = ledger.now_ns, self._untaken_ns[row]
        if any_of(another):
            last_ns, again_ns = self._another_ns[row], self._again_ns[row]
            untaken_ns[another & (now_ns - last_ns <= again_ns)] = now_ns + again_ns
            last_ns[another] = now_ns
            self._until_ns[row] = int(untaken_ns.max())
        here &= ~another & (now_ns >= untaken_ns)
        return here

    @property
    def is_whole(self) -> bool:
        """Whether every board that has not timed out has sent since the last judgement."""
        return self._n_waiting == len(self._waiting) or bool(
            self._n_waiting
            and self._ledger.any_silent
            and (self._waiting | self._ledger.silent).all()
        )

    def judge_whole(self) -> None:
        """Judge which chips live if every board that has not timed out has sent since."""
        if self.is_whole:
            self.judge()

    def judge(self) -> None:
        """Judge which chips live by the sweeps since the last judgement."""
        if not self._n_waiting:
            return
        waiting = self._waiting
        felt = self._felt_by_all() if self._felt else None
        every = self._n_waiting == len(waiting)
        here = self._here if every else self._here & waiting[:, None]
        erring = self._none
        if self._erring:
            erring = np.zeros(erring.shape, np.bool_)
            for row, errors in self._erring.items():
                erring[TRIANGLES * row : TRIANGLES * (row + 1)] = errors
        self.liveness.step(
            self._raw.reshape(-1, PADS),
            here.ravel(),
            erring,
            felt,
            None if every else waiting.copy(),
        )
        self._felt.clear()
        self._erring.clear()
        waiting[:] = False
        self._n_waiting = 0

    def _felt_by_all(self) -> Mask:
        """Return the touched pads of the sweeps that are judged, mostly those of the last time."""
        felt, (before, found) = self._felt, self._felt_before
        if len(felt) != len(before) or any(before.get(row) is not felt[row] for row in felt):
            found = np.zeros((TRIANGLES * len(self._waiting), PADS), np.bool_)
            for row, pads in felt.items():
                found[TRIANGLES * row : TRIANGLES * (row + 1)] = pads
            self._felt_before = felt.copy(), found
        return found

    def _new_liveness(
        self,
        noise: NDArray[np.float64] | None,
        pressed_units: NDArray[np.float64] | None = None,
    ) -> Liveness:
        boards = [self._layout.boards[board] for board in self._boards]

        def of_pads(of_taxels: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
            if of_taxels is None:
                return None
            return np.where(self.taxels >= 0, of_taxels[self.taxels], 0.0)

        return Liveness(
            len(self._encodings),
            of_pads(noise),
            np.array([board.settings.period_ms * 1e-3 for board in boards]),
            Repeats(self._encodings),
            len(boards),
            np.array(
                [number in board.triangles for board in boards for number in range(TRIANGLES)]
            ),
            of_pads(pressed_units),
        )

    def _new_state(self, index: int, silent_periods: float) -> _PartState:
        layout = self._layout
        part = layout.parts[index]
        source = np.zeros(part.n_taxels, np.intp)
        rows = {board: self._ledger.row[board] for board in part.boards}
        for board, row in rows.items():
            flat = layout.boards[board].taxel_index.ravel()
            mine = np.flatnonzero((flat >= part.start) & (flat < part.stop))
            source[flat[mine] - part.start] = row * flat.size + mine
        period_ms = {board: layout.boards[board].settings.period_ms for board in rows}
        slowest_ms = max(period_ms.values())
        faster = frozenset(board for board in rows if period_ms[board] < slowest_ms)
        period_ns = 1_000_000 * slowest_ms
        silence_ns = int(silent_periods * period_ns)
        return _PartState(index, rows, rows.copy(), faster, source, period_ns, silence_ns)

    def _sample(self, state: _PartState) -> PartSample:
        """Return a part's sample in progress, and begin the next."""
        source = state.source
        raw = self._bytes[source]
        present, received = state.present, state.received
        if present is None or received is None:
            present = self._present.reshape(-1)[source]
            received = self._received.reshape(-1)[source]
            state.present, state.received = present, received
        if state.waits:
            lost = np.isin(source // self._raw.shape[1], list(state.waits.values()))
            present, received = present.copy(), received.copy()
            raw[lost] = 0
            present[lost] = received[lost] = False
        if 0 <= state.stamped_ns - state.last_ns < 4 * state.period_ns:
            # A sweep that came after its sample was returned. Times of a part only rise, unless a
            # clock is set back.
            state.last_ns = state.stamped_ns + 1
        state.stamped_ns = state.last_ns
        state.waits.update(state.rows)
        state.pending = False
        state.reported_ns = -1
        return PartSample(state.index, raw, present, received, state.last_ns)


def _encodings(layout: Layout, boards: list[int]) -> list[Encoding]:
    """How each triangle of some boards makes bytes of capacitances, 16 of each board."""
    shifts = {(triangle.board, triangle.number): triangle.shift for triangle in layout.triangles}
    return [
        Encoding(
            thermal_gains(settings.effective_skin_type, number)[0],
            shifts.get((board, number), 0),
            settings.no_load,
            settings.model == "mtb3",
        )
        for board in boards
        for settings in (layout.boards[board].settings,)
        for number in range(TRIANGLES)
    ]


def unpressable(layout: Layout, board: int, full_ff: float) -> Mask:
    """Return triangles bool[16] of a board that pressing cannot bring far out of their range.

    A pad is far out at twice the capacitance of all its units (reference of the wire, 4.3).
    """
    taxels = layout.boards[board].taxel_index[:, 0]
    far_ff = 2.0 * layout.no_load[taxels] * layout.unit_ff[taxels]
    found: Mask = far_ff > FAR_SHARE * full_ff * layout.sensitivity[taxels]
    return found


def below_zero(raw: NDArray[np.uint8], far: Mask) -> Mask:
    """Return pads bool[k, 12] that read far below zero pressure, and are not of another chip.

    A pad does that after a release if its board was zeroed while it was pressed.

    Args:
        raw: uint8[k, 12].
        far: bool[k, 12], pads that their status words mark as far out of range.
    """
    found: Mask = far & (raw == 255)
    if any_of(found):
        found &= (count_of(far) < FAR_PADS)[:, None]
    return found


def lifted(raw: NDArray[np.uint8], far: Mask) -> Mask:
    """Return triangles bool[k] whose pads read far below zero pressure: those of another chip.

    Pressing cannot do it. Plugs of data lines that were swapped, or a chip at another one's
    address, put the pads of one triangle on the baselines of another.

    Args:
        raw: uint8[k, 12].
        far: bool[k, 12], pads that their status words mark as far out of range.
    """
    below = count_of(far & (raw == 255))
    torn = (below > 0) & (count_of(far) >= FAR_PADS)
    found: Mask = (below >= LIFTED_PADS) | torn
    return found
