"""Pressure curves of any shape, one per pad, from a recording under known pressure.

A curve is linear between knots over the activation. It belongs to pad and foam, so it stays valid
when zeros change. `skin calibrate --pressure LOG --load CSV` finds it, together with the faults of
each pad, its expected error, and the memory of the foam (see `PlayRelaxation`). In use, a `Reader`
converts the bytes of a part to momentary pressures: by a parabola or a table per taxel.
"""

import sys
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skin_host.config.settings import Pressure
from skin_host.layout import Layout
from skin_host.processing.masks import Mask
from skin_host.processing.pressure import PressureCurve

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Taxels = slice | Mask | NDArray[np.intp]

#: Dense where foam is soft; the straight end covers a byte's whole range.
KNOTS_UNITS: Floats = np.array([0.0, 0.75, 1.5, 3.0, 5.0, 7.5, *np.arange(10.0, 256.0, 3.0)])
#: All knots are multiples of this, so one look-up finds the piece that an activation is in.
GRID_UNITS = 0.25
#: Piece 0 is below zero.
_PIECE_AT: NDArray[np.intp] = np.searchsorted(
    KNOTS_UNITS, np.arange(-GRID_UNITS, KNOTS_UNITS[-1], GRID_UNITS), side="right"
)
#: The largest power of two that is not above their number.
HALF_KNOTS = 1 << (len(KNOTS_UNITS).bit_length() - 1)
#: Up to so many pressures are compared with all knots.
FEW_VALUES = 64
#: A curve rises by at least this much per unit, so that it has an inverse.
LEAST_SLOPE = 1e-3
#: Below zero a curve is as steep as up to this knot at least: noise may make its first piece flat,
#: and a reading below zero would then be one of many units.
STEEP_KNOT = 3

#: Fewer pads with curves of their own do not represent the foam of their part.
REPRESENTATIVES = 8

#: A table is computed again when its baseline has moved this far. Until then it is shifted by the
#: slope at rest, which is exact for small pressures only; so less is allowed where a pad is
#: touched.
STALE_UNITS = 1 / 4
STALE_TOUCHED_UNITS = 1 / 32
CODES = np.arange(256.0)[:, np.newaxis]


class CurveVerdict(IntEnum):
    """Result for a pad from a recording under known pressure. From NOISY on it is not used."""

    GOOD = 0
    #: The recording does not show its curve, because it was not in it or hardly moved: see
    #: `with_own`.
    UNKNOWN = 1
    #: Its expected error is too large.
    NOISY = 2
    #: It jumps to another level and back while the pressure does not.
    JUMPS = 3
    #: It reaches an end of the byte's range.
    SATURATES = 4
    #: It does not follow the pressure.
    DEAD = 5


@dataclass(frozen=True)
class Memory:
    """Rate-independent hysteresis of a foam: plays of these radii with these weights."""

    radius_kpa: tuple[float, ...] = ()
    weight: tuple[float, ...] = ()


@dataclass(frozen=True)
class Curves:
    """The pressure curves of n taxels, as measured.

    Attributes:
        kpa: float64[n, k], pressure at `KNOTS_UNITS`, rising from 0; while loading foam that
            rested. Rows of taxels whose verdict is not GOOD are undefined.
        beyond_units: float64[n], activation up to which the curve was measured.
        noise_units: float64[n], standard deviation of short-term noise, under pressure.
        error_kpa: float64[n], RMS error of the reported pressure in the recording; NaN if none.
        verdict: uint8[n], see `CurveVerdict`.
        highest_kpa: the highest pressure of the recording.
        lag_s: by how much the table's clock was ahead of the recording's.
        memory: of the foam, which all pads share.
    """

    kpa: Floats
    beyond_units: Floats
    noise_units: Floats
    error_kpa: Floats
    verdict: NDArray[np.uint8]
    highest_kpa: float
    lag_s: float
    memory: Memory = field(default_factory=Memory)

    @property
    def own(self) -> Mask:
        """Return which taxels [n] have an own curve."""
        own: Mask = self.verdict == CurveVerdict.GOOD
        return own

    @property
    def usable(self) -> Mask:
        """Which taxels [n] measure pressure, by their own curve or the common one."""
        usable: Mask = self.verdict <= CurveVerdict.UNKNOWN
        return usable

    def is_same(self, other: "Curves") -> bool:
        """Return whether these are the same curves of the same foam, as read again from a file."""
        its = other.arrays()
        return self.memory == other.memory and all(
            np.array_equal(mine, its[name], equal_nan=True) for name, mine in self.arrays().items()
        )

    def arrays(self) -> dict[str, NDArray[np.float64] | NDArray[np.uint8]]:
        """Return the arrays over taxels, by name."""
        names = ("kpa", "beyond_units", "noise_units", "error_kpa", "verdict")
        return {name: getattr(self, name) for name in names}


class TableCurve:
    """Curves given at `KNOTS_UNITS`, straight between them, beyond the last and below zero.

    Has the same interface as `PressureCurve`.

    Args:
        table_kpa: float64[n, k], rising from 0.
        beyond_units: float64[n], activation up to which the curve was measured.
        sound: bool[n], see the attribute; without it, all.

    Attributes:
        sound: bool[n], which curves are those of their taxels, see `PressureCurve`.
        linear: float64[n], kPa per unit below zero.
        straight_kpa: float64[n], pressure up to which the curve goes on like that.
        beyond_units: float64[n], activation up to which the curve was measured.
    """

    def __init__(self, table_kpa: Floats, beyond_units: Floats, sound: Mask | None = None) -> None:
        n, knots = table_kpa.shape
        self.sound: Mask = np.ones(n, np.bool_) if sound is None else sound
        self._row = np.arange(n)
        #: Where each piece ends, filled up for a search by halves.
        self._end_kpa = np.full((n, 2 * HALF_KNOTS), np.inf)
        self._end_kpa[:, : knots - 1] = table_kpa[:, :-1]
        self.beyond_units = beyond_units
        rising = np.diff(table_kpa, axis=1) / np.diff(KNOTS_UNITS)
        chord = table_kpa[:, STEEP_KNOT] / KNOTS_UNITS[STEEP_KNOT]
        self.linear: Floats = np.maximum(rising[:, 0], chord)
        self.straight_kpa: Floats = np.where(rising[:, 0] < self.linear, 0.0, table_kpa[:, 1])
        #: Each piece is level + slope x; the first and the last go on for ever.
        level = table_kpa[:, :-1] - rising * KNOTS_UNITS[:-1]
        #: There are as many as knots, because one is below zero. As one number of two parts, both
        #: are found by one look-up.
        piece = np.zeros((n, knots), np.complex128)
        piece.real = np.column_stack([self.linear, rising])
        piece.imag[:, 1:] = level
        self._piece = piece.reshape(-1)

    def part(self, taxels: Taxels) -> "TableCurve":
        """Return the curves of some of the taxels; they share the tables of all."""
        chosen = copy(self)
        chosen._row = self._row[taxels]
        chosen.beyond_units = self.beyond_units[taxels]
        chosen.linear = self.linear[taxels]
        chosen.straight_kpa = self.straight_kpa[taxels]
        chosen.sound = self.sound[taxels]
        return chosen

    def kpa(self, units: ArrayLike) -> Floats:
        """Return the pressure [..., n] in kPa of activations [..., n] in units."""
        x = np.asarray(units, dtype=np.float64)
        quarters = np.minimum(np.maximum(x / GRID_UNITS + 1.0, 0.0), len(_PIECE_AT) - 1.0)
        # Places in the whole table: two indices would cost several times as much.
        place = _PIECE_AT.take(quarters.astype(np.intp)) + self._row * len(KNOTS_UNITS)
        piece = self._piece.take(place)
        result: Floats = piece.real * x
        result += piece.imag
        return result

    def units(self, kpa: ArrayLike) -> Floats:
        """Return the activation [..., n] in units for these pressures; inverse of kpa."""
        c = np.asarray(kpa, dtype=np.float64)
        number = self._passed(c) if c.size > FEW_VALUES else self._passed_of_few(c)
        piece = self._piece.take(number + self._row * len(KNOTS_UNITS))
        result: Floats = (c - piece.imag) / piece.real
        return result

    def _passed(self, kpa: Floats) -> NDArray[np.intp]:
        """Return how many pieces [..., n] end below these pressures, by halves."""
        before = self._row * 2 * HALF_KNOTS - 1
        end = np.broadcast_to(before, np.broadcast(kpa, before).shape).copy()
        step = HALF_KNOTS
        while step:
            end += (self._end_kpa.take(end + step) <= kpa) * step
            step >>= 1
        return end - before

    def _passed_of_few(self, kpa: Floats) -> NDArray[np.intp]:
        """Return the same with fewer calls, each over all knots."""
        passed = self._end_kpa[self._row] <= kpa[..., np.newaxis]
        number: NDArray[np.intp] = np.count_nonzero(passed, axis=-1)
        return number


def rising(kpa: Floats) -> Floats:
    """Return curves [..., k] at `KNOTS_UNITS`, changed to rise strictly from 0."""
    least = LEAST_SLOPE * KNOTS_UNITS
    risen: Floats = np.maximum.accumulate(kpa - kpa[..., :1] - least, axis=-1) + least
    return risen


def common_curve(
    layout: Layout, settings: Pressure, gain: ArrayLike = 1.0, bend: ArrayLike = 1.0
) -> PressureCurve:
    """The parabola of each taxel of a skin, by equation (1)."""
    return PressureCurve(
        layout.unit_ff / layout.sensitivity,
        gain,
        settings.a_kpa_per_ff2 * np.asarray(bend),
        settings.b_kpa_per_ff,
    )


Curve = PressureCurve | TableCurve


def with_own(
    common: PressureCurve, curves: Curves, parts: Sequence[slice], ungained: Mask
) -> Curve:
    """Return own curves where taxels have one; elsewhere that of the median pad of the part, as far
    as its pads represent it, or the common one.

    Pads of one foam differ by some tens of percent, other foam from the common curve by a factor of
    five: a pad of which nothing is known is one like the others.

    Args:
        common: the curve of each taxel [n] without a recording under pressure.
        curves: of these taxels.
        parts: which taxels have the same foam.
        ungained: bool[n], of which no gain is known, either.
    """
    own = curves.own
    if not own.any():
        return common
    finite: Mask = np.asarray(np.isfinite(curves.kpa).all(axis=1))
    table = common.kpa(KNOTS_UNITS[:, np.newaxis]).T
    table = np.where((own & finite)[:, np.newaxis], curves.kpa, table)
    beyond_units = np.where(own, curves.beyond_units, common.beyond_units)
    measured = own & finite & common.sound
    unknown = ungained & common.sound & (curves.verdict == CurveVerdict.UNKNOWN)
    for part in parts:
        known, alike = (np.flatnonzero(mask[part]) + part.start for mask in (measured, unknown))
        if len(known) >= REPRESENTATIVES and len(alike):
            of_known = TableCurve(rising(curves.kpa[known]), curves.beyond_units[known])
            table[alike], beyond_units[alike] = _typical(common, known, of_known, alike)
    return TableCurve(rising(table), beyond_units, np.where(own, finite, common.sound))


def _typical(
    common: PressureCurve, known: NDArray[np.intp], of_known: TableCurve, alike: NDArray[np.intp]
) -> tuple[Floats, Floats]:
    """Return the curves [k, knots] of taxels that read like the median of some known ones, and the
    activations [k] up to which half of these were measured.

    What is alike is capacitance: taxels that are sent in other units, or have thinner foam, have
    the same pressure where the common curve has.
    """
    theirs = common.part(known)
    reach_kpa = float(np.median(theirs.kpa(of_known.beyond_units)))
    # Few kinds of pads make a skin.
    kinds = np.column_stack([common.square[alike], common.linear[alike]])
    table, beyond = np.empty((len(alike), len(KNOTS_UNITS))), np.empty(len(alike))
    for kind in np.unique(kinds, axis=0):
        mine = np.flatnonzero((kinds == kind).all(axis=1))
        one = common.part(alike[mine[:1]])
        units = theirs.units(one.kpa(KNOTS_UNITS[:, np.newaxis]))
        table[mine] = np.median(of_known.kpa(units), axis=1)
        beyond[mine] = one.units(reach_kpa)
    return table, beyond


class Reader(Protocol):
    """Converts the bytes of m taxels into kPa."""

    def renew(self, offset: Floats32, touched: Mask) -> None:
        """Set the bytes [m] of the untouched taxels, with fractions, and which are touched [m]."""
        ...

    def lower(self, relaxation_kpa: Floats32) -> None:
        """Subtract a relaxation [m] from all pressures until the next `renew`."""
        ...

    def kpa(self, raw: Bytes, out: Floats32) -> None:
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

    def renew(self, offset: Floats32, touched: Mask) -> None:
        slope, level = self._slope, self._level
        np.multiply(self._square, offset, out=slope)
        np.add(slope, self._linear, out=level)
        np.multiply(level, offset, out=level)
        np.add(slope, slope, out=slope)
        np.add(slope, self._linear, out=slope)
        np.negative(slope, out=slope)

    def lower(self, relaxation_kpa: Floats32) -> None:
        np.subtract(self._level, relaxation_kpa, out=self._level)

    def kpa(self, raw: Bytes, out: Floats32) -> None:
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
        #: The zero of each table, and what to add for the present one.
        self._offset = np.full(m, -np.inf, np.float32)
        self._shift = np.zeros(m, np.float32)
        self._table = np.zeros((m, 256), np.float32)
        self._flat = self._table.reshape(-1)
        #: Where each taxel's row begins, plus its byte: rows are as long as a byte has values, so
        #: the lowest byte of this sum is the taxel's.
        self._index = np.arange(0, 256 * m, 256, dtype=np.intp)
        lowest = 0 if sys.byteorder == "little" else self._index.itemsize - 1
        self._lowest = self._index.view(np.uint8)[lowest :: self._index.itemsize]

    def renew(self, offset: Floats32, touched: Mask) -> None:
        moved = np.subtract(offset, self._offset)
        limit = np.where(touched, STALE_TOUCHED_UNITS, STALE_UNITS)
        stale = np.flatnonzero((np.abs(moved) > limit) & self._believed)
        if len(stale):
            self._offset[stale] = offset[stale]
            self._table[stale] = self._curve.part(stale).kpa(offset[stale] - CODES).T
            moved[stale] = 0.0
        np.multiply(moved, self._curve.linear, out=self._shift, where=self._believed)

    def lower(self, relaxation_kpa: Floats32) -> None:
        np.subtract(self._shift, relaxation_kpa, out=self._shift)

    def kpa(self, raw: Bytes, out: Floats32) -> None:
        self._lowest[...] = raw
        self._flat.take(self._index, out=out, mode="clip")
        np.add(out, self._shift, out=out)
