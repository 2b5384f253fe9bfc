"""Fits the pressure curve of each taxel to known uniform pressures on all of them.

A bag of compressed air on the skin (seed 002) presses every taxel equally. Each taxel then gets a
gain on the common curve; with several and large enough pressures also its own bend, because pads
on denser foam differ little at low pressure and much at high pressure.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Uncertainty of one reading: a unit of quantisation and the remaining relaxation.
UNCERTAINTY_KPA = 1.0
#: A bend is used when its standard error is below this, and if it is plausible.
BEND_ERROR = 0.25
BEND_RANGE = (0.2, 3.0)
#: Below this highest level the parabola of equation (1) is a straight line.
BEND_FROM_KPA = 40.0
GAIN_RANGE = (0.2, 5.0)


@dataclass(frozen=True)
class GainFit:
    """C = gain (bend a S^2 + b S) for each taxel [n], and how well it fits.

    Attributes:
        gain, bend: float64[n]; 1 where they could not be fitted.
        fitted: bool[n], whether the taxel has its own gain.
        bent: bool[n], whether it has its own bend.
        rms_before_kpa, rms_after_kpa: error over all levels and fitted taxels.
    """

    gain: Floats
    bend: Floats
    fitted: Mask
    bent: Mask
    rms_before_kpa: float
    rms_after_kpa: float


def fit_gains(levels_kpa: Floats, linear_kpa: Floats, square_kpa: Floats, usable: Mask) -> GainFit:
    """Fit gains and bends.

    Args:
        levels_kpa: known pressures [k].
        linear_kpa: the linear part of the common curve at each level and taxel [k, n], after
            correction for relaxation.
        square_kpa: its quadratic part, likewise.
        usable: taxels [n] that may be fitted.

    Raises:
        ValueError: no level, or levels that are not positive.
    """
    if len(levels_kpa) == 0 or np.any(levels_kpa <= 0.0):
        raise ValueError("levels must be positive pressures")
    level = levels_kpa[:, np.newaxis]
    common = linear_kpa + square_kpa
    power = np.sum(common**2, axis=0)
    gain = np.sum(common * level, axis=0) / np.where(power > 0.0, power, 1.0)
    fitted = usable & (gain > GAIN_RANGE[0]) & (gain < GAIN_RANGE[1])
    gain = np.where(fitted, gain, 1.0)
    bend = np.ones_like(gain)
    bent = np.zeros_like(fitted)
    if len(levels_kpa) >= 3 and levels_kpa.max() >= BEND_FROM_KPA:
        own_gain, own_bend, error = _two_parts(level, linear_kpa, square_kpa)
        sensible = (own_bend > BEND_RANGE[0]) & (own_bend < BEND_RANGE[1])
        bent = fitted & sensible & (error < BEND_ERROR) & (own_gain > GAIN_RANGE[0])
        gain = np.where(bent, own_gain, gain)
        bend = np.where(bent, own_bend, bend)
    after = gain * (linear_kpa + bend * square_kpa)
    return GainFit(
        gain,
        bend,
        fitted,
        bent,
        _rms((common - level)[:, fitted]),
        _rms((after - level)[:, fitted]),
    )


def _two_parts(level: Floats, linear: Floats, square: Floats) -> tuple[Floats, Floats, Floats]:
    """Least squares of level = gain linear + gain bend square; gain, bend, error of bend."""
    ll, ls, ss = (
        np.sum(x * y, axis=0) for x, y in ((linear, linear), (linear, square), (square, square))
    )
    lp, sp = np.sum(linear * level, axis=0), np.sum(square * level, axis=0)
    determinant = ll * ss - ls**2
    possible = determinant > 1e-9 * np.maximum(ll * ss, 1e-9)
    safe = np.where(possible, determinant, 1.0)
    gain = (ss * lp - ls * sp) / safe
    curvature = (ll * sp - ls * lp) / safe
    safe_gain = np.where(gain > 0.0, gain, 1.0)
    error = np.where(
        possible, UNCERTAINTY_KPA * np.sqrt(np.maximum(ll / safe, 0.0)) / safe_gain, np.inf
    )
    return np.where(possible, gain, 0.0), curvature / safe_gain, error


def _rms(error: Floats) -> float:
    return float(np.sqrt(np.mean(error**2))) if error.size else float("nan")
