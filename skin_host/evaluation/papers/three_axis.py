"""Three-axis optical elements (Ohka et al.): grey-value sum and centroid to three forces.

A camera along z sees the feet of each rubber element as bright spots. The grey-value sum
gives the normal force, by two straight lines; the displacement of the centroid gives the
shear, in proportion. Away from the vertex the picture is foreshortened and is put right
first.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skin_host.errors import CalibrationError

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
class Bilinear:
    """Force = lower * G up to the knot, and from there on with slope `upper` (Fig. 10).

    Attributes:
        knot: grey-value sum where the lines meet.
        lower, upper: N per unit of G; positive, so the curve rises throughout.
        correlation: of fitted and known forces.
    """

    knot: float
    lower: float
    upper: float
    correlation: float

    def force_n(self, grey: ArrayLike) -> Floats:
        """Normal force, N, of grey-value sums; no sum below zero is a force."""
        g = np.maximum(np.asarray(grey, np.float64), 0.0)
        force: Floats = self.lower * np.minimum(g, self.knot) + self.upper * np.maximum(
            g - self.knot, 0.0
        )
        return force


def fit_bilinear(grey: ArrayLike, force_n: ArrayLike) -> Bilinear:
    """Fit two lines through zero that meet at a free knot, by least squares.

    Between two neighbouring readings the error is smooth in the knot, so every such gap
    is searched by golden section around the best of the readings.

    Args:
        grey: [k], sums above the unloaded one.
        force_n: [k], the known normal forces.

    Raises:
        CalibrationError: fewer than 5 different readings, or a curve that falls.
    """
    g, f = np.asarray(grey, np.float64), np.asarray(force_n, np.float64)
    good = np.isfinite(g) & np.isfinite(f)
    g, f = g[good], f[good]
    candidates = np.unique(g[g > 0.0])
    if len(candidates) < 5:
        raise CalibrationError(
            f"three-axis element: {len(candidates)} different grey-value sums above zero; "
            "wanted at least 5 loads"
        )

    def solve(knot: float) -> tuple[float, float, float]:
        design = np.column_stack([np.minimum(g, knot), np.maximum(g - knot, 0.0)])
        slopes = np.linalg.lstsq(design, f, rcond=None)[0]
        return float(((f - design @ slopes) ** 2).sum()), float(slopes[0]), float(slopes[1])

    inner = candidates[1:-1]
    place = int(np.argmin([solve(float(knot))[0] for knot in inner])) + 1
    low, high = float(candidates[place - 1]), float(candidates[place + 1])
    golden = 0.5 * (np.sqrt(5.0) - 1.0)
    while high - low > 1e-9 * candidates[-1]:
        left, right = high - golden * (high - low), low + golden * (high - low)
        if solve(left)[0] <= solve(right)[0]:
            high = right
        else:
            low = left
    knot = 0.5 * (low + high)
    _, lower, upper = solve(knot)
    if lower <= 0.0 or upper <= 0.0:
        raise CalibrationError(
            f"three-axis element: slopes {lower:.3g} and {upper:.3g} N per unit; "
            "wanted a grey-value sum that rises with the load"
        )
    fitted = Bilinear(knot, lower, upper, 1.0)
    correlation = float(np.corrcoef(fitted.force_n(g), f)[0, 1])
    return Bilinear(knot, lower, upper, correlation)


def fit_shear(displacement: ArrayLike, force_n: ArrayLike) -> float:
    """Shear force per displacement of the centroid, N per its unit; one line through zero.

    One number does for all inclinations between 15 and 60 degrees (Fig. 12).

    Raises:
        CalibrationError: no displacement at all, or one against the force.
    """
    u, f = np.ravel(np.asarray(displacement, np.float64)), np.ravel(np.asarray(force_n))
    square = float(u @ u)
    stiffness = float(u @ f) / square if square > 0.0 else 0.0
    if stiffness <= 0.0:
        raise CalibrationError(
            "three-axis element: the centroid does not move along with the shear force"
        )
    return stiffness


def in_element_frame(
    layout: DomeLayout, grey: ArrayLike, centroid: ArrayLike
) -> tuple[Floats, Floats]:
    """What a camera looking at each element along its own normal would see (eqs. 4-6).

    With azimuth theta and latitude phi:  g_i = g / sin phi,
    u_south = (u_x cos theta + u_y sin theta) / sin phi,  u_east = -u_x sin theta + u_y cos theta.
    Eqs. 5-6 as printed use phi for both angles and have lost the minus sign.

    Args:
        layout: of the n elements.
        grey: [..., n], grey-value sums.
        centroid: [..., n, 2], displacements in the picture.

    Returns:
        Sums [..., n] and displacements [..., n, 2] towards south and east.
    """
    g, u = np.asarray(grey, np.float64), np.asarray(centroid, np.float64)
    sine = np.sin(layout.latitude_rad)
    cos, sin = np.cos(layout.azimuth_rad), np.sin(layout.azimuth_rad)
    south = (u[..., 0] * cos + u[..., 1] * sin) / sine
    east = -u[..., 0] * sin + u[..., 1] * cos
    return g / sine, np.stack([south, east], axis=-1)


class ThreeAxisSensor:
    """Calibrated elements on a dome.

    Args:
        layout: of the n elements.
        normal: calibration of each element; they differ even on one latitude.
        shear_n_per_unit: common, or one for each element.
    """

    def __init__(
        self, layout: DomeLayout, normal: list[Bilinear], shear_n_per_unit: ArrayLike
    ) -> None:
        n = len(layout.latitude_rad)
        if len(normal) != n:
            raise CalibrationError(f"three-axis sensor: {len(normal)} calibrations, {n} elements")
        self.layout = layout
        self._knot = np.array([curve.knot for curve in normal])
        self._lower = np.array([curve.lower for curve in normal])
        self._upper = np.array([curve.upper for curve in normal])
        self._shear = np.asarray(shear_n_per_unit, np.float64)

    def forces(self, grey: ArrayLike, centroid: ArrayLike) -> Floats:
        """Forces on the elements in their own frames, float64[..., n, 3], N.

        South, east and normal, the last not positive for a push (eqs. 1-3).

        Args:
            grey: [..., n], grey-value sums above the unloaded ones.
            centroid: [..., n, 2], displacements of the centroids in the picture.
        """
        g, u = in_element_frame(self.layout, grey, centroid)
        g = np.maximum(g, 0.0)
        normal = self._lower * np.minimum(g, self._knot) + self._upper * np.maximum(
            g - self._knot, 0.0
        )
        shear = u * self._shear[..., None]
        return np.concatenate([shear, -normal[..., None]], axis=-1)

    def total_force(self, forces_n: Floats) -> Floats:
        """Sum of the elements' forces in the fingertip's frame, float64[..., 3], N."""
        axes = np.stack([self.layout.south, self.layout.east, self.layout.normal], axis=1)
        total: Floats = np.einsum("...ni,nij->...j", forces_n, axes)
        return total
