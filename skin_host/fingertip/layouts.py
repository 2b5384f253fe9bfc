"""Where the elements of two published fingertips lie. Lengths in mm.

A fingertip's frame has its origin in the centre of the curvature, and z outward through
the vertex.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Rings of the dome: elements, and angle from the vertex. The counts follow from Ohka et al.:
#: elements 0, 1, 5, 9, 17, 25, 33 lie on one great circle and 9 and 17 on one latitude.
#: The angles are not printed; these space the elements about evenly.
DOME_RINGS = ((1, 0.0), (8, 20.0), (16, 40.0), (16, 60.0))


@dataclass(frozen=True, slots=True)
class DomeLayout:
    """Elements on a hemisphere, seen by a camera along z (Ohka et al., Figs. 3 and 7).

    Attributes:
        azimuth_rad, latitude_rad: float64[n]; the vertex is at latitude pi / 2.
        position_mm: float64[n, 3], roots of the elements on the dome.
        normal, south, east: float64[n, 3], axes z_i, x_i, y_i of each element's own frame.
    """

    azimuth_rad: Floats
    latitude_rad: Floats
    position_mm: Floats
    normal: Floats
    south: Floats
    east: Floats


def dome(radius_mm: float = 20.0, rings: tuple[tuple[int, float], ...] = DOME_RINGS) -> DomeLayout:
    """The dome of 41 elements of Ohka et al., or another one."""
    azimuth = np.concatenate([2.0 * np.pi * np.arange(count) / count for count, _ in rings])
    from_vertex = np.deg2rad(np.concatenate([np.full(count, angle) for count, angle in rings]))
    ca, sa, cv, sv = np.cos(azimuth), np.sin(azimuth), np.cos(from_vertex), np.sin(from_vertex)
    normal = np.stack([sv * ca, sv * sa, cv], axis=1)
    return DomeLayout(
        azimuth_rad=azimuth,
        latitude_rad=0.5 * np.pi - from_vertex,
        position_mm=radius_mm * normal,
        normal=normal,
        south=np.stack([cv * ca, cv * sa, -sv], axis=1),
        east=np.stack([-sa, ca, np.zeros_like(ca)], axis=1),
    )


@dataclass(frozen=True, slots=True)
class ArrayLayout:
    """Crossed strips wrapped around a cylinder (Son et al., Fig. 1).

    Attributes:
        around_mm: float64[columns], places along the circumference, from the middle.
        along_mm: float64[rows], places along the cylinder's axis, from the middle.
        radius_mm: of the outer surface.
        depth_mm: of the elements below it.
    """

    around_mm: Floats
    along_mm: Floats
    radius_mm: float
    depth_mm: float


def strip_array(
    *,
    strips: int = 8,
    pitch_mm: float = 2.0,
    radius_mm: float = 15.7,
    depth_mm: float = 2.4,
) -> ArrayLayout:
    """The 8 x 8 array of Son et al.: 2 mm pitch under 2.4 mm of rubber, radius 15.7 mm."""
    place: Floats = pitch_mm * (np.arange(strips, dtype=np.float64) - 0.5 * (strips - 1))
    return ArrayLayout(place, place.copy(), radius_mm, depth_mm)
