"""Sums of the pressures of a part over the windows in which its slow state moves.

Samples are stored, and summed some at a time, for fewer passes over the taxels. Most sweeps of an
untouched part whose pressures are not subscribed are skipped: the next sample stands for them.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.masks import Mask

#: Samples are stored and summed this many at a time.
ROWS = 8
#: An untouched part that is not subscribed is sampled once in this time.
IDLE_UPDATE_S = 0.2

Floats = NDArray[np.float32]


class WindowSums:
    """Sums over the samples of a time, of m taxels.

    Attributes:
        sum_kpa: float32[m], of the pressures without the relaxation.
        lowest_kpa: float32[m], lowest mean of `ROWS` samples, infinite if there are not so many.
        samples: how many they are.
        skipped: sweeps that no sample stands for.
        elapsed_s: how long they all took.
    """

    def __init__(self, m: int) -> None:
        self.sum_kpa = np.zeros(m, np.float32)
        self.lowest_kpa = np.empty(m, np.float32)
        self.clear()

    def clear(self) -> None:
        """Begin the next."""
        self.sum_kpa.fill(0.0)
        self.lowest_kpa.fill(np.inf)
        self.samples = 0
        self.skipped = 0
        self.elapsed_s = 0.0

    def add(self, piece: "WindowSums") -> None:
        """Add what followed."""
        np.add(self.sum_kpa, piece.sum_kpa, out=self.sum_kpa)
        np.fmin(self.lowest_kpa, piece.lowest_kpa, out=self.lowest_kpa)
        self.samples += piece.samples
        self.skipped += piece.skipped
        self.elapsed_s += piece.elapsed_s

    def forget(self, taxels: Mask) -> None:
        """Take taxels, bool[m], for untouched in it."""
        self.sum_kpa[taxels] = 0.0
        self.lowest_kpa[taxels] = np.inf


class Windows:
    """The samples of m taxels, and the windows of their baselines and of their relaxation.

    What is in neither window yet is a piece, which ends with the window that ends first.

    Args:
        m: how many taxels.
        drift_s: how long a window of the baselines is.
        on_fold: takes the samples float32[k, m] that are summed now, and their sums float32[m].

    Attributes:
        drifting: the window of the baselines.
        relaxing: that of the relaxation.
        unseen_s: how long the sweeps took that were skipped since the last sample.
    """

    def __init__(self, m: int, drift_s: float, on_fold: Callable[[Floats, Floats], None]) -> None:
        self._drift_s, self._on_fold = drift_s, on_fold
        self.drifting, self.relaxing = WindowSums(m), WindowSums(m)
        self._piece = WindowSums(m)
        self._rows = np.zeros((ROWS, m), np.float32)
        self._row = list(self._rows)
        self._laid = 0
        self._sum_kpa = np.empty(m, np.float32)
        #: Skipped sweeps since the last sample, how long they took, and the sums of their bytes.
        self._unseen = 0
        self.unseen_s = 0.0
        self._unseen_raw = np.zeros(m, np.int32)
        self._since_sample_s = 0.0
        self.relax_in(drift_s)

    def relax_in(self, relax_s: float) -> None:
        """The window of the relaxation is so long from now on."""
        self._relax_s = relax_s
        #: How long the present piece is at least.
        self._piece_s = min(self._drift_s, relax_s)

    @property
    def row(self) -> Floats:
        """Return where the next sample float32[m] is to be stored: pressures without relaxation."""
        return self._row[self._laid]

    def due(self, dt_s: float) -> bool:
        """Return whether a sweep that could be skipped is sampled anyway, for the sums, and at the
        end of a piece.
        """
        self._since_sample_s += dt_s
        sampled = self._since_sample_s >= IDLE_UPDATE_S
        return sampled or self._piece.elapsed_s + dt_s >= self._piece_s

    def skip(self, raw: NDArray[np.uint8], dt_s: float) -> None:
        """Note a sweep uint8[m] without a sample: the next one stands for it."""
        self._piece.elapsed_s += dt_s
        self.unseen_s += dt_s
        self._unseen += 1
        np.add(self._unseen_raw, raw, out=self._unseen_raw)

    def add(
        self,
        raw: NDArray[np.uint8],
        dt_s: float,
        kpa_per_unit: NDArray[np.float64] | None,
    ) -> bool:
        """Take the sample that is stored in `row`; return whether the piece is over.

        From a quiet sample the sweeps that were skipped before it differ by bytes near zero, where
        the curve is straight. What was skipped before a touch was none, and counts as relaxed.

        Args:
            raw: uint8[m], the bytes of the sample.
            dt_s: how long it took.
            kpa_per_unit: float64[m], slope of the curves near zero; None of a sample in which
                anything is felt.
        """
        piece = self._piece
        self._since_sample_s = 0.0
        if self._unseen:
            if kpa_per_unit is not None:
                beyond_units = np.multiply(raw, self._unseen, dtype=np.int32)
                beyond_units -= self._unseen_raw
                piece.sum_kpa += self.row * np.float32(self._unseen)
                piece.sum_kpa += beyond_units * kpa_per_unit
                piece.samples += self._unseen
            else:
                piece.skipped += self._unseen
            self._forget_unseen()
        self._laid += 1
        if self._laid == ROWS:
            self.fold()
        piece.samples += 1
        piece.elapsed_s += dt_s
        return piece.elapsed_s >= self._piece_s

    def fold(self) -> None:
        """Sum the samples that are stored."""
        rows = self._rows[: self._laid]
        np.add.reduce(rows, axis=0, out=self._sum_kpa)
        if self._laid:
            self._on_fold(rows, self._sum_kpa)
        piece = self._piece
        np.add(piece.sum_kpa, self._sum_kpa, out=piece.sum_kpa)
        if self._laid == ROWS:
            np.multiply(self._sum_kpa, np.float32(1.0 / ROWS), out=self._sum_kpa)
            np.fmin(piece.lowest_kpa, self._sum_kpa, out=piece.lowest_kpa)
        self._laid = 0

    def end_piece(self, early: bool) -> tuple[bool, bool]:
        """Add the piece to both windows; return whether that of the baselines and that of the
        relaxation is over, which with `early` is any that has samples.
        """
        self.fold()
        piece, drifting, relaxing = self._piece, self.drifting, self.relaxing
        piece.skipped += self._unseen
        self._forget_unseen()
        drifting.add(piece)
        relaxing.add(piece)
        piece.clear()
        drifted = drifting.samples and (early or drifting.elapsed_s >= self._drift_s)
        relaxed = relaxing.samples and (early or relaxing.elapsed_s >= self._relax_s)
        return bool(drifted), bool(relaxed)

    def begin_piece(self) -> None:
        """Begin the next one. The windows that are over have been cleared."""
        left_s = self._relax_s - self.relaxing.elapsed_s
        self._piece_s = min(self._drift_s - self.drifting.elapsed_s, left_s)

    def forget(self, taxels: Mask) -> None:
        """Take taxels, bool[m], for untouched in all samples so far."""
        self._rows[:, taxels] = 0.0
        for window in (self._piece, self.drifting, self.relaxing):
            window.forget(taxels)

    def begin_anew(self, taxels: Mask, raw: NDArray[np.uint8]) -> None:
        """Take what was skipped of taxels, bool[m], for the bytes uint8[m]."""
        unseen_raw = np.multiply(raw, self._unseen, dtype=np.int32)
        np.copyto(self._unseen_raw, unseen_raw, where=taxels)

    def _forget_unseen(self) -> None:
        self._unseen, self.unseen_s = 0, 0.0
        self._unseen_raw.fill(0)
