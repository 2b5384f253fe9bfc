"""What is known of the zeros of boards: which are sought, which are in doubt, and what may press.

A board that is set up, restarts, or loses a chip zeroes itself with whatever presses it then. None
of its taxels is valid until the new untouched readings have been found (`rezero`); those that were
touched just before stay in doubt until they are calibrated.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Sweep
from skin_host.bus.ledger import BoardLedger
from skin_host.bus.wire import TRIANGLES, StatusError
from skin_host.layout import Layout, PadKind
from skin_host.processing.calibration import Calibration, Verdict, fineness
from skin_host.processing.frame import PressureFrame
from skin_host.processing.glimpses import Glimpses
from skin_host.processing.intake import Intake, below_zero
from skin_host.processing.liveness import PADS
from skin_host.processing.masks import Mask, any_of
from skin_host.processing.pipeline import Pipeline
from skin_host.processing.pressed_zero import PressedZero
from skin_host.processing.returned_chips import ReturnedChips
from skin_host.processing.rezero import (
    END,
    STEADY_UNITS,
    Rezero,
    highest_rest,
    look_s,
    repeats_of,
)
from skin_host.processing.silent_zero import STILL_SHARE, SilentZero
from skin_host.processing.wrong_zeros import WrongZeros, others_rest


class BoardZeros:
    """The zeros of some boards.

    Args:
        layout: the skin.
        boards: indices of the boards.
        ledger: of these boards.
        intake: of their sweeps; it is given which taxels are not valid, which are touched, and
            which were pressed when their board was zeroed.
        on_rezero: called with the index of each board that has a new zero, and `believed`, see
            `rezero`.

    Attributes:
        found: how often new zeros have been found.
        changes: how often what is known of zeros has changed.
        rezeros: by board what is known of its zero since it was zeroed.
        held: taxels bool[n] of boards that have not been zeroed yet, see `hold`; None if there are
            none.
    """

    def __init__(
        self,
        layout: Layout,
        boards: list[int],
        ledger: BoardLedger,
        intake: Intake,
        on_rezero: Callable[[int, bool], None],
    ) -> None:
        self._layout, self._boards = layout, boards
        self._ledger, self._intake = ledger, intake
        self._on_rezero = on_rezero
        self._calibration: Calibration | None = None
        self._pipeline: Pipeline | None = None
        self.found = 0
        self.changes = 0
        self.rezeros: dict[int, Rezero] = {}
        self.held: Mask | None = None
        self._fineness = fineness(layout)
        #: Boards that were silent and may have been zeroed meanwhile.
        self._silent_zeros: dict[int, SilentZero] = {}
        self._returned = ReturnedChips(
            {board: np.any(self._of(board) >= 0, axis=1) for board in boards}
        )
        #: Boards that have neither sent nor been zeroed since they were held.
        self._awaited: set[int] = set()
        #: Boards of which taxels are not valid, or were not just now, as their zero is sought.
        self._glimpses = Glimpses()
        #: Triangles bool[16] of a board whose chips did not answer when they were last received,
        #: and whether any of these was missing from its last sweep.
        self._unanswered: dict[int, tuple[Mask, bool]] = {}
        self._wrong = WrongZeros()
        self._touched = np.zeros(layout.n_taxels, np.bool_)
        #: Whether each taxel was touched when it was last valid. A board that restarts in a touch
        #: is silent before it is zeroed: its touches have ended as lost, and may still be there.
        self._last_touched = np.zeros(layout.n_taxels, np.bool_)
        #: Taxels that were touched when an earlier start of the daemon ended, until their board is
        #: zeroed by this one.
        self._touched_before = np.zeros(layout.n_taxels, np.bool_)
        #: Boards of which taxels were pressed when they were zeroed.
        self._pressed: dict[int, PressedZero] = {}
        #: By part: which of its taxels were touched and valid in its last frame.
        self._noted: dict[int, tuple[Mask, Mask]] = {}
        #: Boards that were zeroed since they were held: until then what came before is under way.
        self._releasing: set[int] = set()

    def go_on(self, before: "BoardZeros") -> None:
        """Take over the state of a predecessor for the same boards."""
        self._ledger = before._ledger
        self.found, self.changes = before.found, before.changes
        self.rezeros, self.held = before.rezeros, before.held
        self._silent_zeros = before._silent_zeros
        self._returned.go_on(before._returned)
        self._awaited = before._awaited
        self._glimpses = before._glimpses
        self._unanswered = before._unanswered
        self._wrong.go_on(before._wrong)
        self._touched = before._touched
        self._last_touched = before._last_touched
        self._touched_before, self._pressed = before._touched_before, before._pressed
        self._releasing = before._releasing

    def adopt(self, calibration: Calibration, pipeline: Pipeline) -> None:
        """Judge by a calibration, and by the baselines of a pipeline, from now on."""
        self._calibration, self._pipeline = calibration, pipeline

    def calibrated(self, calibration: Calibration, boards: list[int]) -> None:
        """A calibration, adopted next, has measured the zeros of some boards, as far as they were
        received: those are known. Of the others nothing has shown what touches them, or what they
        have drifted by.
        """
        measured = self._layout.taxels_of(boards) & (calibration.verdict < Verdict.ABSENT)
        if calibration.unchanged is not None:
            measured &= ~calibration.unchanged
        for board in boards:
            taxels = self._of(board)
            mine = measured[taxels] & (taxels >= 0)
            if not any_of(mine):
                continue
            self.rezeros.pop(board, None)
            self._silent_zeros.pop(board, None)
            self._returned.note_measured(board, np.any(mine, axis=1))
            self._glimpses.forget(board)
            self._wrong.forget(board)
            self._forget_pressed(board, mine)
        self.release(boards)
        self._last_touched[measured] = self._touched[measured]
        self._touched_before[measured] = False

    def note(self, sweep: Sweep, row: int, silent_ns: int) -> None:
        """Take in a sweep of a board.

        Args:
            sweep: it; the ledger has noted it.
            row: of its board in the ledger.
            silent_ns: how long the board was silent before, if so long that it may have zeroed
                itself; otherwise 0.
        """
        ledger = self._ledger
        if silent_ns:
            self._note_return(sweep, silent_ns * 1e-9)
        elif self._awaited and sweep.board in self._awaited:
            self._awaited.discard(sweep.board)
            self._note_return(sweep, math.inf)
        if ledger.flagged[row] or self._unanswered:
            self._note_unanswered(sweep, row)
        if ledger.flagged[row] or self._returned.watches(sweep):
            self._note_unread(sweep, row)
        if row in ledger.twice:
            self._note_twice(sweep, row)
            return
        if ledger.flagged[row] or self._wrong.follows(sweep.board):
            self._note_below_zero(sweep, row)
        if self._wrong.may_be_at_end(sweep):
            self._note_at_end(sweep, row)
        if self._pressed:
            pressed_zero = self._pressed.get(sweep.board)
            if pressed_zero is not None:
                self._note_lifted(sweep, row, pressed_zero)
        rezero = self.rezeros.get(sweep.board)
        if rezero is not None and (not rezero.over or sweep.board in self._wrong.below):
            self._find_zero(sweep, row, rezero)
        if self._silent_zeros:
            silent_zero = self._silent_zeros.get(sweep.board)
            if silent_zero is not None:
                self._find_silent_zero(sweep, row, silent_zero)
        if sweep.board in self._returned.compared:
            self._compare_chips(sweep, row)
        rezero = self.rezeros.get(sweep.board)
        sought = rezero is not None and not rezero.over
        if sought or sweep.board in self._silent_zeros or sweep.board in self._glimpses:
            self._note_glimpse(sweep, row)

    def note_frame(self, index: int, frame: PressureFrame) -> None:
        """Pass the pressed pads to the liveness decision, but only when they change."""
        felt = frame.touched if frame.felt is None else frame.felt
        noted = self._noted.get(index)
        if noted is not None and noted[0] is felt and noted[1] is frame.valid:
            return
        self._noted[index] = felt, frame.valid
        part = self._layout.parts[index]
        touched = self._touched[part.start : part.stop]
        np.copyto(self._last_touched[part.start : part.stop], felt, where=frame.valid)
        if touched.tobytes() == felt.tobytes():
            return
        touched[:] = felt
        for board in part.boards:
            taxels = self._of(board)
            pads = self._touched[taxels] & (taxels >= 0)
            row = self._ledger.row[board]
            if any_of(pads):
                self._intake.touched[row] = pads
            else:
                self._intake.touched.pop(row, None)

    def hold(self, boards: list[int]) -> None:
        """Report no taxel of some boards as valid until they are zeroed and their zero is found.

        Their zero may be another than the calibration's: since that was taken, an earlier start of
        the daemon may have zeroed them, or they themselves. What seems to touch them is noted all
        the same, unless their first readings show that.
        """
        self._releasing.difference_update(boards)
        self._awaited.update(boards)
        held = self._layout.taxels_of(boards)
        self.held = held if self.held is None else self.held | held

    def release(self, boards: list[int]) -> None:
        """Report taxels of some boards as valid again: they are zeroed, or cannot be."""
        if self.held is not None:
            left: Mask = self.held & ~self._layout.taxels_of(boards)
            self.held = left if any_of(left) else None

    def without_held(self, frame: PressureFrame, index: int) -> PressureFrame:
        """Return a frame of a part (its index) in which the taxels that are held are not valid."""
        if self.held is None:
            return frame
        part = self._layout.parts[index]
        fit = ~self.held[part.start : part.stop]
        return replace(
            frame,
            pressure_kpa=frame.pressure_kpa * fit,
            touched=frame.touched & fit,
            valid=frame.valid & fit,
            beyond_range=frame.beyond_range & fit,
        )

    def expect_touched(self, taxels: Mask) -> None:
        """Something touched these taxels, bool[n], when an earlier start of the daemon ended.

        A board that still sends shows whether it does so now. If none comes before it is zeroed,
        their zero is in doubt from then on. Nothing has been fed yet.
        """
        self._touched_before |= taxels
        self._last_touched |= taxels

    def rezero(self, board: int, believed: bool = True) -> int:
        """Find the new untouched readings after a board was zeroed.

        For two seconds, longer for slow boards, none of its taxels is valid, and noisy ones are not
        for up to six. Taxels that were touched just before stay invalid until they are calibrated,
        and those whose noise reaches the end of the scale until they are zeroed again.

        Args:
            board: its index.
            believed: whether touches just before are real. Touches of a board that was not set up,
                by this start of the daemon or an earlier one, are not, but for those that an
                earlier start has left.

        Returns:
            How many taxels were touched.
        """
        taxels = self._of(board)
        self._returned.forget(board)
        silent_zero = self._silent_zeros.pop(board, None)
        if silent_zero is not None and silent_zero.at_start and silent_zero.was_zeroed:
            self._judge_again(board)
        self._awaited.discard(board)
        self._releasing.add(board)
        self._on_rezero(board, believed)
        before = self.rezeros.get(board)
        fitted = taxels >= 0
        touched = fitted & self._touched_before[taxels]
        if believed:
            touched &= self._undecided(board)
            touched |= fitted & self._last_touched[taxels]
        self._last_touched[taxels[fitted]] = touched[fitted]
        self._touched_before[taxels[fitted]] = False
        # A glimpse may be noise: a doubt, but nothing that must be shown to have lifted.
        self._note_pressed(board, touched)
        if believed:
            touched |= fitted & self._glimpsed(board)
        if self._calibration is None:
            return 0
        self._glimpses.forget(board)
        self._wrong.forget(board)
        if before is not None:
            touched |= before.unknown.reshape(TRIANGLES, PADS)
        own = self._layout.boards[board].settings
        no_load = np.full(taxels.size, float(own.no_load))
        wanted = None
        if self._pipeline is not None:
            seconds = look_s(self._calibration.spread, self._pipeline.enter)[taxels.ravel()]
            wanted = np.ceil(seconds * 1e3 / own.period_ms).astype(np.int64)
        period_s = own.period_ms * 1e-3
        self.rezeros[board] = Rezero(
            touched.ravel(), no_load, fitted.ravel(), wanted, period_s, believed
        )
        # None is valid from its first sweep on. One that sends none goes on by a calibration that
        # is taken meanwhile, but for what is in doubt.
        self._intake.veto[self._ledger.row[board]] = touched
        self.changes += 1
        return int(np.count_nonzero(touched))

    def doubt(self, taxels: Mask) -> None:
        """The zero of these taxels, bool[n], is not known from before: see `rezero`."""
        for board in self._boards:
            mine = self._of(board)
            doubted = taxels[mine] & (mine >= 0)
            if doubted.any():
                self.rezero(board)
                if board in self.rezeros:
                    self.rezeros[board].doubt(doubted.ravel())
                    self._intake.veto[self._ledger.row[board]] = self.in_doubt(board)

    def at_risk(self, touched: bool) -> Mask:
        """Return taxels bool[n] whose zero will not be known; with `touched`, also those which are
        touched: after another zero, theirs would not be.
        """
        found = self.touched() if touched else np.zeros_like(self._touched)
        for board in self._glimpses if touched else ():
            found[self._of(board)[self._glimpsed(board)]] = True
        for board, rezero in self.rezeros.items():
            found[self._of(board).ravel()[rezero.unknown]] = True
        return found

    def touched(self) -> Mask:
        """Return taxels bool[n] that something touches, or did when it was last known."""
        found: Mask = self._last_touched | self._touched_before
        return found

    @property
    def felt(self) -> Mask:
        """Return taxels bool[n] that something touches by the last frames of their parts."""
        return self._touched

    def pressed(self) -> Mask:
        """Return taxels bool[n] that something pressed when their zero was taken or observed, and
        whose release nothing has shown since.
        """
        found = np.zeros_like(self._touched)
        for board, pressed_zero in self._pressed.items():
            found[self._of(board).ravel()[pressed_zero.pressed]] = True
        for board, rezero in self.rezeros.items():
            found[self._of(board).ravel()[rezero.moved]] = True
        return found

    def may_be_touched(self) -> Mask:
        """Return taxels bool[n] that something may touch, because their zero is not known, or not
        yet while their board is in use again.
        """
        found = self.at_risk(touched=False)
        for board, rezero in self.rezeros.items():
            if rezero.late is not None:
                found[self._of(board).ravel()[rezero.late]] = True
        return found

    def cut_off(self) -> Mask:
        """Return taxels bool[n] whose noise reaches the end of the scale since they were zeroed."""
        found = np.zeros(self._layout.n_taxels, np.bool_)
        for board, rezero in self.rezeros.items():
            found[self._of(board).ravel()[rezero.cut_off]] = True
        return found

    def in_doubt(self, board: int) -> NDArray[np.bool_]:
        """Return taxels bool[16, 12] of a board whose zero is unknown."""
        found = np.zeros((TRIANGLES, PADS), np.bool_)
        if board in self.rezeros:
            found |= self.rezeros[board].unknown.reshape(TRIANGLES, PADS)
        if board in self._wrong.below:
            found |= self._wrong.below[board] > 0
        return found

    def unclear(self, board: int) -> Mask | None:
        """Return taxels bool[n] of which a calibration takes nothing that a board has sent until
        its last sweep; None if there are none.

        What two boards send at an address is the zero of neither. Until it is known whether a board
        zeroed itself while it was silent, taxels in doubt may rest elsewhere than before. Others do
        not, unless their readings show that it did.
        """
        if self._ledger.row[board] in self._ledger.twice:
            return self._layout.taxels_of([board])
        if board not in self._silent_zeros:
            return None
        taxels = self._of(board)
        found = np.zeros(self._layout.n_taxels, np.bool_)
        found[taxels[self.in_doubt(board) & (taxels >= 0)]] = True
        return found

    def compares(self, board: int) -> bool:
        """Return whether it was not known before a board's last sweep if it zeroed itself while it
        was silent.
        """
        return board in self._silent_zeros

    def paused(self, board: int) -> bool:
        """Return whether `compares` holds for a board that had not timed out."""
        silent_zero = self._silent_zeros.get(board)
        if silent_zero is None:
            return False
        limit_ns = int(self._ledger.silent_after_ns[self._ledger.row[board]])
        return silent_zero.silent_s * 1e9 <= limit_ns

    def doubts(self) -> dict[int, int]:
        """Return how many taxels of each board that was zeroed have an unknown zero, by index."""
        return {
            board: int(np.count_nonzero(self.in_doubt(board)))
            for board in sorted(self.rezeros.keys() | self._wrong.below.keys())
        }

    def _of(self, board: int) -> NDArray[np.int32]:
        return self._layout.boards[board].taxel_index

    def _undecided(self, board: int) -> Mask:
        """Return taxels bool[16, 12] of which a board has not sent enough since the start to decide
        whether something touches them.
        """
        taxels = self._of(board)
        if self._pipeline is None:
            return np.ones(taxels.shape, np.bool_)
        repeats = repeats_of(self._layout.boards[board].settings.period_ms * 1e-3)
        sent = self._ledger.sweeps[self._ledger.row[board]] / repeats
        undecided: Mask = self._pipeline.measurements[taxels] > sent
        return undecided

    def _note_pressed(self, board: int, touched: Mask) -> None:
        """A board is zeroed: what touches it, bool[16, 12], is in its zero, and so is what pressed
        it before and has not lifted.
        """
        pressed = touched.ravel().copy()
        before = self._pressed.get(board)
        if before is not None:
            pressed |= before.pressed
        self._pressed.pop(board, None)
        self._intake.zeroed_pressed.pop(self._ledger.row[board], None)
        if not any_of(pressed):
            return
        own = self._layout.boards[board].settings
        noise = np.ones(pressed.size)
        if self._calibration is not None:
            noise = self._calibration.noise[self._of(board).ravel()]
        repeats = repeats_of(own.period_ms * 1e-3)
        self._pressed[board] = PressedZero(pressed, float(own.no_load), noise, repeats)
        self._intake.zeroed_pressed[self._ledger.row[board]] = pressed.reshape(TRIANGLES, PADS)

    def _forget_pressed(self, board: int, pads: Mask) -> None:
        """The zeros of pads bool[16, 12] of a board are known, whatever pressed them before."""
        row = self._ledger.row[board]
        pressed_zero, explained = self._pressed.get(board), self._intake.zeroed_pressed.get(row)
        if pressed_zero is not None and pressed_zero.forget(pads.ravel()):
            del self._pressed[board]
        if explained is not None:
            self._intake.zeroed_pressed[row] = explained & ~pads

    def _note_lifted(self, sweep: Sweep, row: int, pressed_zero: PressedZero) -> None:
        """See what of that which pressed a board when it was zeroed has lifted."""
        ledger = self._ledger
        here = ledger.answered(row) & ~self._intake.reads_another(row, sweep.raw)
        if pressed_zero.step(sweep.raw.ravel(), np.repeat(here, PADS)):
            self._last_touched[self._of(sweep.board).ravel()[pressed_zero.lifted]] = False

    def _note_twice(self, sweep: Sweep, row: int) -> None:
        """Two boards send at an address: what both send is the zero of neither."""
        self._glimpses.forget(sweep.board)
        rezero = self.rezeros.get(sweep.board)
        if rezero is None:
            return
        # What differed was another board's, and no press.
        rezero.moved[:] = False
        if rezero.found_since(self._ledger.twice[row]):
            self.rezero(sweep.board)
        else:
            rezero.restart(sweep.t_ns)

    def _note_unanswered(self, sweep: Sweep, row: int) -> None:
        """Detect that a board zeroed itself, which it does after missing acknowledges (section
        4.5).

        The first status word without that error may be lost on its way: the zero may be another as
        soon as the triangle is missing, and is another when it comes without the error.
        """
        silent = self._ledger.error[row] & StatusError.NO_ACK != 0
        before, was_missing = self._unanswered.get(sweep.board, (silent, False))
        missing = before & ~silent & ~self._ledger.present[row]
        is_missing = any_of(missing)
        if any_of(silent) or is_missing:
            self._unanswered[sweep.board] = silent | missing, is_missing
        else:
            self._unanswered.pop(sweep.board, None)
        is_over = any_of(before & ~silent & self._ledger.present[row])
        rezero = self.rezeros.get(sweep.board)
        if is_over and was_missing and rezero is not None and rezero.seeks_all:
            rezero.restart(sweep.t_ns)
        elif is_over or (is_missing and not was_missing):
            self.rezero(sweep.board)

    def _note_return(self, sweep: Sweep, silent_s: float) -> None:
        """A board sends again: see whether it was zeroed meanwhile.

        Args:
            sweep: its first.
            silent_s: for how long it was not received; infinite at a start.
        """
        rezero = self.rezeros.get(sweep.board)
        if rezero is not None:
            rezero.restart(sweep.t_ns)
        # What was set up since it was received last has a new zero, and one that is still sought
        # is that of the board as it is now. At a start, one is sought of pads in doubt only.
        sought = rezero is not None and rezero.seeks_all and math.isfinite(silent_s)
        before = self._silent_zeros.get(sweep.board)
        if before is not None and before.decided:
            before = None
        if self._pipeline is None or self._calibration is None or sought:
            return
        self._silent_zeros[sweep.board] = self._comparison(sweep, silent_s, before)

    def _comparison(
        self,
        sweep: Sweep,
        silent_s: float,
        before: SilentZero | None = None,
        only: Mask | None = None,
    ) -> SilentZero:
        """Return what compares the sweeps of a board with its zeros; see `SilentZero`.

        Args:
            sweep: its first.
            silent_s: for how long it, or what of it is compared, was not received.
            before: the same after its last silence, if that has not decided.
            only: bool[192], the taxels that are compared, all by default.
        """
        assert self._pipeline is not None
        assert self._calibration is not None
        rezero = self.rezeros.get(sweep.board)
        taxels = self._of(sweep.board).ravel()
        touched = (taxels >= 0) & self._last_touched[taxels]
        if before is not None:
            touched |= before.touched
        known = (taxels >= 0) & self._calibration.usable[taxels] & ~touched
        known &= ~self.in_doubt(sweep.board).ravel()
        if rezero is not None:
            known &= ~rezero.cut_off
            if rezero.late is not None:
                known &= ~rezero.late
        if only is not None:
            known &= only
            touched &= only
        own = self._layout.boards[sweep.board].settings
        raw = self._intake.bytes_of(self._ledger.row[sweep.board])
        read_units = float(own.no_load) - raw.astype(np.float64)
        felt_units = self._pipeline.baseline[taxels] + self._pipeline.enter[taxels]
        return SilentZero(
            self._pipeline.baseline[taxels],
            self._calibration.noise[taxels],
            self._calibration.spread[taxels],
            known,
            float(own.no_load),
            own.period_ms * 1e-3,
            silent_s,
            touched,
            STILL_SHARE * np.maximum(read_units, felt_units),
            before,
            read_units,
            (taxels >= 0) & (self._layout.pad_kind[taxels] == PadKind.PRESSURE),
            self._fineness[taxels],
        )

    def _note_unread(self, sweep: Sweep, row: int) -> None:
        """See which chips are not read, and compare those that are again after a long time."""
        read = self._ledger.answered(row) & ~self._intake.reads_another(row, sweep.raw)
        read &= row not in self._ledger.twice
        back = self._returned.note(sweep.board, read, self._ledger.now_ns)
        rezero = self.rezeros.get(sweep.board)
        sought = sweep.board in self._silent_zeros or (rezero is not None and rezero.seeks_all)
        if back is None or sought or self._pipeline is None or self._calibration is None:
            return
        # What temperature pads read before is not known: their chip was not read, either.
        pads = self._layout.pad_kind[self._of(sweep.board).ravel()] == PadKind.PRESSURE
        pads &= np.repeat(back[0], PADS)
        comparison = self._comparison(sweep, back[1], only=pads)
        self._returned.compared[sweep.board] = back[0], comparison

    def _compare_chips(self, sweep: Sweep, row: int) -> None:
        """Keep chips that were not read for long from being valid until their drift is known."""
        here = np.repeat(self._ledger.answered(row), PADS)
        here &= ~self._ledger.far[row].ravel()
        unknown, drifted_units = self._returned.step(sweep, here, self._ledger.now_ns)
        if drifted_units is not None and self._pipeline is not None:
            taxels = self._of(sweep.board).ravel()
            self._pipeline.catch_up(taxels[taxels >= 0], drifted_units[taxels >= 0])
        self._renew_veto(sweep, row)
        if any_of(unknown):
            veto = self._intake.veto.get(row, np.zeros((TRIANGLES, PADS), np.bool_))
            self._intake.veto[row] = veto | unknown[:, None]

    def _judge_again(self, board: int) -> None:
        """A board was zeroed before a start, so that what seemed to touch it since was judged by
        another zero. It does so only if it reads more than it may untouched with either.
        """
        taxels, row = self._of(board), self._ledger.row[board]
        sweep = self._ledger.last[row]
        reads = self._glimpsed(board)
        if sweep is not None:
            reads |= self._ledger.far[row] & (sweep.raw != END)
        touched = (self._last_touched[taxels] & reads) | self._touched_before[taxels]
        self._last_touched[taxels[taxels >= 0]] = touched[taxels >= 0]

    def _find_silent_zero(self, sweep: Sweep, row: int, silent_zero: SilentZero) -> None:
        if silent_zero.decided:
            # Its last sweep is in a sample of its part by now.
            del self._silent_zeros[sweep.board]
            return
        ledger = self._ledger
        here = np.repeat(ledger.answered(row), PADS)
        zeroed = silent_zero.step(sweep.raw.ravel(), here & ~ledger.far[row].ravel(), sweep.t_ns)
        if zeroed:
            if silent_zero.at_start:
                self._judge_again(sweep.board)
            else:
                # It may have been taken for released since the board was taken for clear.
                taxels = self._of(sweep.board).ravel()
                self._last_touched[taxels[silent_zero.touched]] = True
            # What was read since is of the new zero.
            self._glimpses.forget(sweep.board)
            del self._silent_zeros[sweep.board]
            self.rezero(sweep.board)
            self._intake.veto[row] = np.ones((TRIANGLES, PADS), np.bool_)
            return
        if silent_zero.at_start:
            return
        if zeroed is None and not silent_zero.clear:
            self._intake.veto[row] = np.ones((TRIANGLES, PADS), np.bool_)
            return
        drifted_units = silent_zero.drifted_units() if silent_zero.decided else None
        if drifted_units is not None and self._pipeline is not None:
            taxels = self._of(sweep.board).ravel()
            self._pipeline.catch_up(taxels[taxels >= 0], drifted_units[taxels >= 0])
        self._renew_veto(sweep, row)

    def _renew_veto(self, sweep: Sweep, row: int) -> None:
        """Let all taxels of a board be valid but those whose zero is not known, or not yet."""
        rezero = self.rezeros.get(sweep.board)
        if rezero is None:
            self._intake.veto.pop(row, None)
        else:
            self._veto_unknown(sweep, row, rezero)

    def _note_glimpse(self, sweep: Sweep, row: int) -> None:
        """Keep what a board sends while its taxels are not valid, and until their touches are
        decided.
        """
        rezero = self.rezeros.get(sweep.board)
        blind = sweep.board in self._silent_zeros
        blind |= rezero is not None and rezero.unsettled(sweep.t_ns) is not None
        ledger, own = self._ledger, self._layout.boards[sweep.board].settings
        here = np.repeat(ledger.answered(row), PADS)
        units = np.where(ledger.far[row], -np.inf, float(own.no_load) - sweep.raw).ravel()
        period_s = own.period_ms * 1e-3
        self._glimpses.note(sweep.board, units, here, sweep.t_ns, period_s, blind=blind)

    def _glimpsed(self, board: int) -> Mask:
        """Return taxels bool[16, 12] of a board that something presses by its last readings, while
        no touch could be decided.
        """
        calibration, pipeline = self._calibration, self._pipeline
        if board not in self._glimpses or calibration is None or pipeline is None:
            return np.zeros((TRIANGLES, PADS), np.bool_)
        taxels = self._of(board).ravel()
        spread = np.maximum(calibration.spread, calibration.noise)[taxels]
        baseline = pipeline.baseline[taxels]
        repeats = repeats_of(self._layout.boards[board].settings.period_ms * 1e-3)
        highest, error = highest_rest(baseline, spread, repeats)
        rezero = self.rezeros.get(board)
        if rezero is not None and not rezero.believed:
            # What it was set up to send before had other rests.
            baseline = rezero.lowest()
            highest = baseline + STEADY_UNITS + error
        highest = np.maximum(highest, baseline + pipeline.enter[taxels])
        pressed = self._glimpses.pressed(board, highest)
        pressed &= (taxels >= 0) & calibration.usable[taxels]
        return pressed.reshape(TRIANGLES, PADS)

    def _note_below_zero(self, sweep: Sweep, row: int) -> None:
        """Doubt pads whose zero was taken while something pressed that has lifted now."""
        ledger, rezero = self._ledger, self.rezeros.get(sweep.board)
        if self._calibration is None:
            return
        far = self._intake.far_of(row)
        if not any_of(far) and not self._wrong.follows(sweep.board):
            return
        answered = ledger.answered(row)
        same = self._of_same_chip(sweep, row, far)[:, None]
        below = below_zero(sweep.raw, far) | (same & far & (sweep.raw == END))
        pressed, is_new = np.zeros_like(below), False
        if rezero is not None:
            pressed = rezero.unknown.reshape(TRIANGLES, PADS)
            is_new = not rezero.begun
        no_load = float(self._layout.boards[sweep.board].settings.no_load)
        received = answered, ledger.present[row]
        wrong = self._wrong.note_below(sweep, below, received, pressed, no_load, is_new=is_new)
        self._doubt_pads(sweep, wrong)
        explained = wrong & same
        if any_of(explained):
            before = self._intake.zeroed_pressed.get(row)
            self._intake.zeroed_pressed[row] = explained if before is None else before | explained

    def _of_same_chip(self, sweep: Sweep, row: int, far: Mask) -> Mask:
        """Return the triangles bool[16] of which pads read far below zero, as another chip's would,
        and the others have shown that they are not.

        Args:
            sweep: of a board.
            row: of that.
            far: bool[16, 12], its pads that are far out of range.
        """
        pipeline, calibration = self._pipeline, self._calibration
        assert pipeline is not None
        assert calibration is not None
        resting = self._intake.reads_another(row, sweep.raw)
        if any_of(resting):
            taxels = self._of(sweep.board)
            no_load = float(self._layout.boards[sweep.board].settings.no_load)
            known = (taxels >= 0) & calibration.usable[taxels] & ~self.in_doubt(sweep.board)
            resting &= others_rest(
                no_load - sweep.raw - pipeline.baseline[taxels],
                pipeline.enter[taxels],
                far,
                known,
                self._layout.pad_kind[taxels] == PadKind.PRESSURE,
            )
        return self._wrong.note_resting(sweep.board, resting, self._ledger.present[row])

    def _note_at_end(self, sweep: Sweep, row: int) -> None:
        """Doubt pads that rest at the end of the scale, or beyond it."""
        if self._calibration is None:
            return
        taxels = self._of(sweep.board)
        here = self._ledger.answered(row) & ~self._intake.reads_another(row, sweep.raw)
        pads = here[:, None] & ~self._ledger.far[row]
        pads &= (taxels >= 0) & self._calibration.usable[taxels]
        period_s = self._layout.boards[sweep.board].settings.period_ms * 1e-3
        touching = row in self._intake.touched
        self._doubt_pads(sweep, self._wrong.note_at_end(sweep, pads, period_s, touching=touching))

    def _doubt_pads(self, sweep: Sweep, pads: Mask) -> None:
        """The zero of some pads, bool[16, 12], of the board of a sweep is not known."""
        if not any_of(pads):
            return
        if sweep.board not in self.rezeros:
            no_load = float(self._layout.boards[sweep.board].settings.no_load)
            self.rezeros[sweep.board] = Rezero.of_long_ago(np.full(pads.size, no_load), sweep.t_ns)
        if self.rezeros[sweep.board].doubt(pads.ravel()):
            self.changes += 1

    def _find_zero(self, sweep: Sweep, row: int, rezero: Rezero) -> None:
        if self._pipeline is None or self._calibration is None:
            return
        if not rezero.begun:
            self._intake.veto[row] = np.ones((TRIANGLES, PADS), np.bool_)
        ledger = self._ledger
        here = np.repeat(ledger.answered(row), PADS)
        ledger.rezeros[row] += not rezero.begun
        far, touched = ledger.far[row].ravel(), row in self._intake.touched
        if rezero.step(sweep.raw.ravel(), here, far, sweep.t_ns, touched):
            taxels = self._of(sweep.board).ravel()
            baseline = np.where(taxels >= 0, self._pipeline.baseline[taxels], 0.0)
            calibration = self._calibration
            noise = calibration.noise[taxels]
            spread = np.maximum(calibration.spread[taxels], noise)
            spread[~calibration.usable[taxels]] = np.inf
            found, baseline = rezero.finish(baseline, noise, spread)
            self._pipeline.set_zero(taxels[found], baseline[found])
            self.found += any_of(found)
            self.changes += 1
        if rezero.settled(sweep.t_ns):
            if sweep.board in self._releasing:
                self._releasing.discard(sweep.board)
                self.release([sweep.board])
            self._veto_unknown(sweep, row, rezero)
            return
        # What jumps while a board is set up was not damaged on its way.
        self._intake.note_gap(row)

    def _veto_unknown(self, sweep: Sweep, row: int, rezero: Rezero) -> None:
        """Taxels whose zero is not known, or not yet, are not valid."""
        veto = self.in_doubt(sweep.board)
        veto |= rezero.cut_off.reshape(TRIANGLES, PADS)
        unsettled = rezero.unsettled(sweep.t_ns)
        if unsettled is not None:
            veto |= unsettled.reshape(TRIANGLES, PADS)
        if any_of(veto):
            self._intake.veto[row] = veto
        else:
            self._intake.veto.pop(row, None)
            rezero.over = unsettled is None
