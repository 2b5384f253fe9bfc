"""Units of the 8-bit reading to capacitance to pressure, and back (paper, equation 1)."""

from copy import copy

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: The paper's fit to taxel 2 with 5 and 6 mm probes.
A_KPA_PER_FF2 = -0.001132
B_KPA_PER_FF = 0.8141
#: Equation (1) turns back at its vertex. From this share of the vertex's pressure on, its tangent
#: is used, and the reading counts as beyond the calibrated range.
TANGENT_FROM = 0.9
#: Of a taxel that feels: one unit is so many kPa at rest. Real ones have 0.01 to 100.
SLOPES_KPA = (1e-6, 1e6)
#: Its square term is at most these shares of its linear one at one unit: a curve that turns back
#: before half a unit measures no pressure, and one that bends up more has no activation for what
#: the foam keeps of a press.
BENDS = (-1.0, 0.05)


def vertex(square: ArrayLike, linear: ArrayLike) -> Array:
    """Return where the parabolas square x^2 + linear x turn back; inf where they never do."""
    bend = np.asarray(square, dtype=np.float64)
    bent = bend < 0.0
    turn = -np.asarray(linear, dtype=np.float64) / np.where(bent, 2.0 * bend, 1.0)
    return np.where(bent, turn, np.inf)


def _is_sound(square: Array, linear: Array) -> NDArray[np.bool_]:
    (least, most), (down, up) = SLOPES_KPA, BENDS
    rises = (linear >= least) & (linear <= most)
    # Compared this way round, a number that is none is not sound.
    sound: NDArray[np.bool_] = rises & (square >= down * linear) & (square <= up * linear)
    return sound


class PressureCurve:
    """C = gain (a S^2 + b S) with S = unit_ff times the activation, for each of n taxels.

    Continued so that it never turns back: linear below zero activation, and by its tangent
    from 0.9 of the vertex's pressure (131.7 kPa, 246 fF at the paper's parameters). The
    continuation keeps the order of pressures but is not a calibration; it begins at `beyond_units`.

    Attributes:
        square, linear: coefficients [n] of the activation in units: C = square x^2 + linear x.
        beyond_units: activation [n] where the calibrated range ends; inf where a >= 0.
        tail_slope: kPa per unit [n] of the continuation.
        sound: bool[n], which curves are finite and rise with every unit. The others are flat, so
            nothing is known of what such a taxel feels.
    """

    def __init__(
        self,
        unit_ff: ArrayLike,
        gain: ArrayLike = 1.0,
        a: ArrayLike = A_KPA_PER_FF2,
        b: ArrayLike = B_KPA_PER_FF,
    ) -> None:
        unit, factor, curve, slope = np.broadcast_arrays(
            np.atleast_1d(np.asarray(unit_ff, dtype=np.float64)),
            *(np.asarray(value, dtype=np.float64) for value in (gain, a, b)),
        )
        if np.any(unit < 0.0) or np.any(factor <= 0.0) or np.any(slope <= 0.0):
            raise ValueError("unit_ff must not be negative; gain and b must be positive")
        with np.errstate(over="ignore", invalid="ignore"):
            square, linear = factor * curve * unit**2, factor * slope * unit
        self.sound: NDArray[np.bool_] = _is_sound(square, linear)
        self.square: Array = np.where(self.sound, square, 0.0)
        self.linear: Array = np.where(self.sound, linear, 0.0)
        bent = self.square < 0.0
        self.beyond_units: Array = np.full(unit.shape, np.inf)
        vertex_units = vertex(self.square, self.linear)[bent]
        self.beyond_units[bent] = (1.0 - np.sqrt(1.0 - TANGENT_FROM)) * vertex_units
        self.tail_slope: Array = self.linear.copy()
        self.tail_slope[bent] += 2.0 * self.square[bent] * self.beyond_units[bent]

    def part(self, taxels: slice | NDArray[np.bool_] | NDArray[np.intp]) -> "PressureCurve":
        chosen = copy(self)
        chosen.square = self.square[taxels]
        chosen.linear = self.linear[taxels]
        chosen.beyond_units = self.beyond_units[taxels]
        chosen.tail_slope = self.tail_slope[taxels]
        chosen.sound = self.sound[taxels]
        return chosen

    def kpa(self, units: ArrayLike) -> Array:
        """Return the pressure [..., n] in kPa of activations [..., n] in units."""
        x = np.asarray(units, dtype=np.float64)
        inside = np.minimum(np.maximum(x, 0.0), self.beyond_units)
        beyond = np.where(x > self.beyond_units, x - inside, 0.0)
        below = np.minimum(x, 0.0)
        result: Array = (
            (self.square * inside + self.linear) * inside
            + self.tail_slope * beyond
            + self.linear * below
        )
        return result

    def units(self, kpa: ArrayLike) -> Array:
        """Return the activation [..., n] in units for these pressures; inverse of kpa."""
        c = np.asarray(kpa, dtype=np.float64)
        safe_linear = np.where(self.linear > 0.0, self.linear, 1.0)
        finite_end = np.where(np.isfinite(self.beyond_units), self.beyond_units, 0.0)
        end_kpa = np.where(
            np.isfinite(self.beyond_units),
            (self.square * finite_end + self.linear) * finite_end,
            np.inf,
        )
        inside = np.clip(c, 0.0, end_kpa)
        # The form without cancellation, also right for square = 0.
        root = np.sqrt(np.maximum(self.linear**2 + 4.0 * self.square * inside, 0.0))
        rising = 2.0 * inside / np.where(self.linear > 0.0, self.linear + root, 1.0)
        beyond = np.where(c > end_kpa, c - inside, 0.0)
        tail = np.where(self.tail_slope > 0.0, self.tail_slope, 1.0)
        result: Array = rising + beyond / tail + np.minimum(c, 0.0) / safe_linear
        return result
