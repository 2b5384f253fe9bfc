"""Intrinsic contact sensing in a plane (Son et al., section 3): one angle on a circle.

Forces in N, torque in N mm about the circle's centre, radius in mm. The force is the
object's on the fingertip taken with reversed sign, as in Son et al.: it points outward,
from the centre to the contact. Derivatives are the corrected ones: the paper's eq. 3.6
has a wrong sign in its second term, a wrong denominator under dm and a missing square
under dr.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def contact_angle(fx: ArrayLike, fy: ArrayLike, m: ArrayLike, radius_mm: float) -> Floats:
    """Angle of the contact, rad (eq. 3.5). NaN where |m| >= f r: no single contact.

    m = fy x - fx y = f r sin(psi - theta), psi the direction of the force.
    """
    fx, fy, m = (np.asarray(values, np.float64) for values in (fx, fy, m))
    with np.errstate(divide="ignore", invalid="ignore"):
        lever = m / (np.hypot(fx, fy) * radius_mm)
        lever = np.where(np.abs(lever) < 1.0, lever, np.nan)
    angle: Floats = np.arctan2(fy, fx) - np.arcsin(lever)
    return angle


@dataclass(frozen=True, slots=True)
class AngleDerivatives:
    """Derivatives of the contact angle: 1/N, 1/N, 1/(N mm), 1/mm."""

    fx: Floats
    fy: Floats
    m: Floats
    r: Floats


def angle_derivatives(
    fx: ArrayLike, fy: ArrayLike, m: ArrayLike, radius_mm: float
) -> AngleDerivatives:
    """Derivatives of `contact_angle` with respect to what goes into it."""
    fx, fy, m = (np.asarray(values, np.float64) for values in (fx, fy, m))
    f2 = fx**2 + fy**2
    f = np.sqrt(f2)
    g = np.sqrt(1.0 - (m / (f * radius_mm)) ** 2)
    pull = m / (radius_mm * f2 * f * g)
    return AngleDerivatives(
        fx=-fy / f2 + fx * pull,
        fy=fx / f2 + fy * pull,
        m=-1.0 / (f * radius_mm * g),
        r=m / (f * radius_mm**2 * g),
    )


def position_sd_mm(
    fx: ArrayLike,
    fy: ArrayLike,
    m: ArrayLike,
    radius_mm: float,
    *,
    force_sd_n: ArrayLike,
    torque_sd_nmm: ArrayLike,
    radius_sd_mm: float = 0.0,
) -> Floats:
    """Standard deviation of the contact along the circumference, mm (eq. 3.6 corrected).

    Errors of fx, fy, m and r are taken as independent; fx and fy have the same one.
    """
    d = angle_derivatives(fx, fy, m, radius_mm)
    force_sd, torque_sd = np.asarray(force_sd_n), np.asarray(torque_sd_nmm)
    variance = (
        (d.fx**2 + d.fy**2) * force_sd**2 + (d.m * torque_sd) ** 2 + (d.r * radius_sd_mm) ** 2
    )
    deviation: Floats = radius_mm * np.sqrt(variance)
    return deviation
