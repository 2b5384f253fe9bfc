"""Decides which taxels of a sweep are valid.

A value is valid when its triangle was received, its chip answers (status words), it is not at a
rail that pressing cannot reach, its chip lives (`liveness`), and the zero of its board is known.

Deciding whether a chip lives takes more computing time than everything else of a sample, and does
not depend on one sweep. So a sweep affects that decision only from the next sweep on. It is made
for all boards at once: when every board that sends has sent, or before one sends again.
"""

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.compensation import thermal_gains
from skin_host.bus.ledger import BoardLedger
from skin_host.bus.wire import TRIANGLES
from skin_host.layout import Layout
from skin_host.processing.liveness import PADS, Liveness
from skin_host.processing.masks import Mask
from skin_host.processing.stuck import Encoding, Repeats

#: This many pads far below zero pressure are not an accident.
LIFTED_PADS = 2
#: One such pad is enough while this many pads are far out of range. This many far pads are enough
#: alone where "far" is more than this multiple of the capacitance at which the pressure curve ends.
FAR_PADS = 7
FAR_SHARE = 1.5


class Validity:
    """Decides for the boards of a node.

    Args:
        layout: the skin.
        boards: indices of the boards, in the order of the ledger.
        ledger: of these boards.
        full_ff: capacitance at which the curve of pressure ends, of a pad of sensitivity 1.

    Attributes:
        liveness: of all triangles, those of one board after those of another.
        veto: bool[16, 12] by row of the board: taxels that are invalid for a reason that the
            bytes do not show.
        touched: bool[16, 12] by row of the board: pads that are touched, where any is.
    """

    def __init__(
        self, layout: Layout, boards: list[int], ledger: BoardLedger, full_ff: float = np.inf
    ) -> None:
        self._layout = layout
        self._boards = boards
        self._ledger = ledger
        self._unpressable = np.array([unpressable(layout, board, full_ff) for board in boards])
        self.veto: dict[int, Mask] = {}
        self.touched: dict[int, Mask] = {}
        n = len(boards)
        self._waiting = np.zeros(n, np.bool_)
        self._n_waiting = 0
        #: By row: which triangles were received, as bytes, and bool[16, 12] made of that.
        self._usual: list[tuple[bytes, Mask]] = [(b"", np.zeros((TRIANGLES, PADS), np.bool_))] * n
        self._raw = np.zeros((n, TRIANGLES, PADS), np.uint8)
        self._here = np.zeros((n, TRIANGLES), np.bool_)
        self._erring = np.zeros((n, TRIANGLES), np.bool_)
        self._felt: dict[int, Mask] = {}
        self.liveness = self._new_liveness(None)

    def use(self, noise: NDArray[np.float64] | None, boards: Mask) -> None:
        """Use a calibrated noise.

        Args:
            noise: float64[n] over the skin in units, or None without a calibration.
            boards: bool[b], the calibrated ones; the others continue unchanged.
        """
        self.judge()
        before, self.liveness = self.liveness, self._new_liveness(noise)
        self.liveness.keep(before, ~boards)
        for row in np.flatnonzero(boards).tolist():
            self.veto.pop(row, None)

    def go_on(self, before: "Validity") -> None:
        """Take over the state of a predecessor for the same boards."""
        before.judge()
        self._ledger = before._ledger
        self.liveness = before.liveness
        self.veto = before.veto
        self.touched = before.touched

    def take(self, row: int, raw: NDArray[np.uint8]) -> tuple[Mask, Mask]:
        """Take a board's sweep that the ledger has just noted.

        Args:
            row: of the board.
            raw: uint8[16, 12].

        Returns:
            valid: bool[192].
            received: bool[192], the same without regard to `veto`: values that a new calibration
                may use.
        """
        if self._waiting[row]:
            self.judge()
        ledger = self._ledger
        last = ledger.last[row]
        if last is not None and last.missed:
            self.liveness.note_gap(row)
        doubted = self.liveness.doubted
        flagged = ledger.flagged[row]
        if flagged or doubted is not None:
            here = self.here(row, raw)
            received = np.repeat(here[:, None], PADS, axis=1)
            if flagged:
                received &= ~ledger.far[row]
                self._erring[row] = ledger.error[row]
            if doubted is not None:
                received &= ~doubted[TRIANGLES * row : TRIANGLES * (row + 1)]
        else:
            # Most sweeps have nothing but the triangles of the one before.
            here = ledger.present[row]
            key, received = self._usual[row]
            if key != (present := here.tobytes()):
                received = np.repeat(here[:, None], PADS, axis=1)
                received.flags.writeable = False
                self._usual[row] = present, received
        self._waiting[row] = True
        self._n_waiting += 1
        self._raw[row] = raw
        self._here[row] = here
        if row in self.touched:
            self._felt[row] = self.touched[row]
        veto = self.veto.get(row)
        valid = received if veto is None else received & ~veto
        return valid.ravel(), received.ravel()

    def here(self, row: int, raw: NDArray[np.uint8]) -> Mask:
        """Return triangles bool[16] that were received, answer, and are in their range, by the
        ledger.
        """
        ledger = self._ledger
        here: Mask = ledger.present[row]
        if ledger.flagged[row]:
            far = ledger.far[row]
            here = here & (ledger.error[row] == 0) & ~lifted(raw, far)
            many = np.count_nonzero(far, axis=1) >= FAR_PADS
            here &= ~(self._unpressable[row] & many)
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
        felt: Mask | None = None
        if self._felt:
            felt = np.zeros((TRIANGLES * len(waiting), PADS), np.bool_)
            for row, pads in self._felt.items():
                felt[TRIANGLES * row : TRIANGLES * (row + 1)] = pads
        self.liveness.step(
            self._raw.reshape(-1, PADS),
            self._here.ravel(),
            self._erring.ravel(),
            felt,
            None if self._n_waiting == len(waiting) else waiting.copy(),
        )
        self._felt.clear()
        self._here[:] = False
        self._erring[:] = False
        waiting[:] = False
        self._n_waiting = 0

    def _new_liveness(self, noise: NDArray[np.float64] | None) -> Liveness:
        encodings = []
        of_pads = None if noise is None else np.zeros((len(self._boards), TRIANGLES, PADS))
        for row, board in enumerate(self._boards):
            layout = self._layout.boards[board]
            if noise is not None and of_pads is not None:
                taxels = layout.taxel_index
                of_pads[row] = np.where(taxels >= 0, noise[taxels], 0.0)
            settings = layout.settings
            shifts = dict.fromkeys(range(TRIANGLES), 0)
            mine = (triangle for triangle in self._layout.triangles if triangle.board == board)
            shifts |= {triangle.number: triangle.shift for triangle in mine}
            encodings += [
                Encoding(
                    thermal_gains(settings.skin_type, number)[0],
                    shifts[number],
                    settings.no_load,
                    settings.model == "mtb3",
                )
                for number in range(TRIANGLES)
            ]
        periods_s = [self._layout.boards[board].settings.period_ms * 1e-3 for board in self._boards]
        return Liveness(
            len(encodings),
            None if of_pads is None else of_pads.reshape(-1, PADS),
            np.array(periods_s),
            Repeats(encodings),
            len(self._boards),
        )


def unpressable(layout: Layout, board: int, full_ff: float) -> Mask:
    """Return triangles bool[16] of a board that pressing cannot bring far out of their range.

    A pad is far out at twice the capacitance of all its units (reference of the wire, 4.3).
    """
    taxels = layout.boards[board].taxel_index[:, 0]
    far_ff = 2.0 * layout.no_load[taxels] * layout.unit_ff[taxels]
    found: Mask = far_ff > FAR_SHARE * full_ff * layout.sensitivity[taxels]
    return found


def lifted(raw: NDArray[np.uint8], far: Mask) -> Mask:
    """Return triangles bool[k] whose pads read far below zero pressure: those of another chip.

    Pressing cannot do it. Plugs of data lines that were swapped, or a chip at another one's
    address, put the pads of one triangle on the baselines of another.

    Args:
        raw: uint8[k, 12].
        far: bool[k, 12], pads that their status words mark as far out of range.
    """
    below = np.count_nonzero(far & (raw == 255), axis=-1)
    torn = (below > 0) & (np.count_nonzero(far, axis=-1) >= FAR_PADS)
    found: Mask = (below >= LIFTED_PADS) | torn
    return found
