"""Pressure curves of any shape, one per pad, from a recording under known pressure.

A curve is linear between knots over the activation. It belongs to pad and foam, so it stays valid
when zeros change. `skin calibrate --pressure LOG --load CSV` finds it, together with the faults of
each pad, its expected error, and the memory of the foam (see `PlayRelaxation`).
"""

from copy import copy
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skin_host.config.settings import Pressure
from skin_host.layout import Layout
from skin_host.processing.pressure import PressureCurve

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Taxels = slice | Mask

#: Dense where foam is soft; the straight end covers a byte's whole range.
KNOTS_UNITS: Floats = np.array([0.0, 0.75, 1.5, 3.0, 5.0, 7.5, *np.arange(10.0, 256.0, 3.0)])
#: A curve rises by at least this much per unit, so that it has an inverse.
LEAST_SLOPE = 1e-3


class CurveVerdict(IntEnum):
    """Result for a pad from a recording under known pressure. From NOISY on it is not used."""

    GOOD = 0
    #: The pad was not in the recording: it keeps the common curve.
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

    def arrays(self) -> dict[str, NDArray[np.float64] | NDArray[np.uint8]]:
        """Return the arrays over taxels, by name."""
        names = ("kpa", "beyond_units", "noise_units", "error_kpa", "verdict")
        return {name: getattr(self, name) for name in names}


class TableCurve:
    """Curves given at `KNOTS_UNITS`, straight between them and beyond the last.

    Has the same interface as `PressureCurve`.

    Attributes:
        table_kpa: float64[n, k], rising.
        linear: float64[n], kPa per unit at zero activation; it continues below zero.
        beyond_units: float64[n], activation up to which the curve was measured.
    """

    def __init__(self, table_kpa: Floats, beyond_units: Floats) -> None:
        self.table_kpa = table_kpa
        self.beyond_units = beyond_units
        steps = np.diff(KNOTS_UNITS)
        self.linear: Floats = (table_kpa[:, 1] - table_kpa[:, 0]) / steps[0]
        self._last_slope: Floats = (table_kpa[:, -1] - table_kpa[:, -2]) / steps[-1]

    @property
    def steepest(self) -> Floats:
        """Greatest slope [n], kPa per unit."""
        slopes: Floats = np.max(np.diff(self.table_kpa, axis=1) / np.diff(KNOTS_UNITS), axis=1)
        return slopes

    def part(self, taxels: Taxels) -> "TableCurve":
        """Return the curves of some of the taxels."""
        chosen = copy(self)
        chosen.table_kpa = self.table_kpa[taxels]
        chosen.beyond_units = self.beyond_units[taxels]
        chosen.linear = self.linear[taxels]
        chosen._last_slope = self._last_slope[taxels]
        return chosen

    def kpa(self, units: ArrayLike) -> Floats:
        """Return the pressure [..., n] in kPa of activations [..., n] in units."""
        x = np.asarray(units, dtype=np.float64)
        inside = np.clip(x, 0.0, KNOTS_UNITS[-1])
        knot = np.searchsorted(KNOTS_UNITS[1:-1], inside, side="right")
        taxel = np.arange(len(self.linear))
        low, high = self.table_kpa[taxel, knot], self.table_kpa[taxel, knot + 1]
        share = (inside - KNOTS_UNITS[knot]) / (KNOTS_UNITS[knot + 1] - KNOTS_UNITS[knot])
        result: Floats = (
            low
            + share * (high - low)
            + np.minimum(x, 0.0) * self.linear
            + np.maximum(x - KNOTS_UNITS[-1], 0.0) * self._last_slope
        )
        return result

    def units(self, kpa: ArrayLike) -> Floats:
        """Return the activation [..., n] in units for these pressures; inverse of kpa."""
        c = np.asarray(kpa, dtype=np.float64)
        first, last = self.table_kpa[:, 0], self.table_kpa[:, -1]
        inside = np.clip(c, first, last)
        knot = np.sum(self.table_kpa[:, 1:-1] <= inside[..., np.newaxis], axis=-1)
        taxel = np.arange(len(self.linear))
        low, high = self.table_kpa[taxel, knot], self.table_kpa[taxel, knot + 1]
        share = (inside - low) / (high - low)
        result: Floats = (
            KNOTS_UNITS[knot]
            + share * (KNOTS_UNITS[knot + 1] - KNOTS_UNITS[knot])
            + np.minimum(c - first, 0.0) / self.linear
            + np.maximum(c - last, 0.0) / self._last_slope
        )
        return result


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


def with_own(common: PressureCurve, curves: Curves) -> TableCurve:
    """Return own curves where taxels have one, the common one elsewhere."""
    own = curves.own
    table = np.where(own[:, np.newaxis], curves.kpa, common.kpa(KNOTS_UNITS[:, np.newaxis]).T)
    return TableCurve(rising(table), np.where(own, curves.beyond_units, common.beyond_units))
