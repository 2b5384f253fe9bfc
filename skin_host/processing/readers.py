"""Converts the bytes of a part to momentary pressures: by a parabola or a table per taxel."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.curves import TableCurve
from skin_host.processing.masks import Mask
from skin_host.processing.pressure import PressureCurve

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

#: A table is computed again when its taxel's baseline has moved this far: a quarter of a kPa.
STALE_UNITS = 1 / 32
CODES = np.arange(256.0)[:, np.newaxis]


class Reader(Protocol):
    """Converts the bytes of m taxels into kPa."""

    def renew(self, offset: Floats) -> None:
        """Set the bytes [m] of the untouched taxels, with fractions."""
        ...

    def lower(self, relaxation_kpa: Floats) -> None:
        """Subtract a relaxation [m] from all pressures until the next `renew`."""
        ...

    def kpa(self, raw: Bytes, out: Floats) -> None:
        """Write the momentary pressures [m] for bytes [m]."""
        ...


class Parabolas:
    """Equation (1): with the byte r that is (square r + slope) r + level.

    Below zero activation the square is negligible. Beyond the calibrated range it is wrong; see
    `PressureCurve`.
    """

    def __init__(self, curve: PressureCurve, believed: Mask) -> None:
        # An unusable taxel has a flat curve, so that no masks are needed later.
        self._square = np.where(believed, curve.square, 0.0).astype(np.float32)
        self._linear = np.where(believed, curve.linear, 0.0).astype(np.float32)
        self._slope = np.empty_like(self._square)
        self._level = np.empty_like(self._square)
        self._bytes = np.empty_like(self._square)

    def renew(self, offset: Floats) -> None:
        slope, level = self._slope, self._level
        np.multiply(self._square, offset, out=slope)
        np.add(slope, self._linear, out=level)
        np.multiply(level, offset, out=level)
        np.add(slope, slope, out=slope)
        np.add(slope, self._linear, out=slope)
        np.negative(slope, out=slope)

    def lower(self, relaxation_kpa: Floats) -> None:
        np.subtract(self._level, relaxation_kpa, out=self._level)

    def kpa(self, raw: Bytes, out: Floats) -> None:
        self._bytes[...] = raw
        np.multiply(self._bytes, self._square, out=out)
        np.add(out, self._slope, out=out)
        np.multiply(out, self._bytes, out=out)
        np.add(out, self._level, out=out)


class Tables:
    """A table of 256 pressures per taxel, shifted when its baseline moves."""

    def __init__(self, curve: TableCurve, believed: Mask) -> None:
        m = len(believed)
        self._curve = curve
        self._believed = believed
        self._offset = np.full(m, np.inf, np.float32)
        self._table = np.zeros((m, 256), np.float32)
        self._flat = self._table.reshape(-1)
        self._row = np.arange(0, 256 * m, 256)
        self._index = np.empty(m, np.intp)
        self._lowered: Floats | None = None

    def renew(self, offset: Floats) -> None:
        self._lowered = None
        stale = (np.abs(offset - self._offset) > STALE_UNITS) & self._believed
        if stale.any():
            self._offset[stale] = offset[stale]
            kpa = self._curve.part(stale).kpa(self._offset[stale] - CODES)
            self._table[stale] = kpa.T

    def lower(self, relaxation_kpa: Floats) -> None:
        self._lowered = relaxation_kpa.copy()

    def kpa(self, raw: Bytes, out: Floats) -> None:
        np.add(self._row, raw, out=self._index)
        self._flat.take(self._index, out=out, mode="clip")
        if self._lowered is not None:
            np.subtract(out, self._lowered, out=out)
