"""Joins the contact from force and torque with the contact of the skin, if there is skin.

Both give a place and its error; the estimate weights each by its precision, along the surface. On
planar fingertips with a manual calibration `fusion` does more.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skin_host.fingertip.intrinsic import IntrinsicContact, Surface, point_covariance
from skin_host.processing.events import TouchEvent

Floats = NDArray[np.float64]

#: Relative error of a calibrated sensor (the multi-axial study: +-1 %).
RELATIVE_ERROR = 0.01
#: Distance of a real fingertip's surface from its geometrical form.
SURFACE_SD_MM = 0.05


@dataclass(frozen=True, slots=True)
class Place:
    """Where a contact is: point and outward normal, float64[3], mm; radial standard error, mm."""

    point_mm: Floats
    normal: Floats
    sigma_mm: float


def locate_with_skin(
    load: Floats,
    contact: IntrinsicContact,
    surface: Surface,
    noise: Floats,
    felt: TouchEvent | None,
) -> Place:
    """Return the place of the contact of one sample.

    Args:
        load: float64[6], force (N) and torque (N mm) on the fingertip.
        contact: result of `intrinsic.locate` for it.
        surface: of the fingertip.
        noise: float64[6, 6], covariance of the load.
        felt: the present contact of the skin, in the same frame, if there is one.
    """
    force, torque = load[:3], load[3:]
    sizes = np.repeat([np.linalg.norm(force), np.linalg.norm(torque)], 3)
    covariance = point_covariance(
        force,
        torque,
        contact,
        noise + np.diag((RELATIVE_ERROR * sizes) ** 2),
        surface_sd_mm=SURFACE_SD_MM,
    )[0]
    point, normal = contact.point_mm[0], contact.normal[0]
    if felt is not None and felt.centroid_m is not None and felt.sigma_m:
        along = np.eye(3) - np.outer(normal, normal)
        covariance = along @ covariance @ along
        # A radial standard error covers two directions.
        of_skin = along * (1e3 * felt.sigma_m) ** 2 / 2.0
        gain = covariance @ np.linalg.pinv(covariance + of_skin, hermitian=True)
        joined = point + gain @ along @ (1e3 * np.array(felt.centroid_m) - point)
        # Move the point back to the surface, which bends away below the tangent plane.
        distance, found = surface.enter((joined + normal)[None], -normal[None])
        if found[0]:
            point = joined + (1.0 - distance[0]) * normal
            normal = surface.normal(point[None])[0]
            covariance = covariance - gain @ covariance
    return Place(point, normal, math.sqrt(max(float(np.trace(covariance)), 0.0)))
