"""What the sensors of published fingertips read, given what presses on them.

`OpticalDome` is that of Ohka et al. (41 elements on a dome); `StripArray` and `PlanarGauges`
are those of Son et al. (an 8 x 8 array and three gauges on one fingertip). Each has traits
that the estimators do not know: curves with rounded knees, cross-talk, strips that carry
loads sideways, a calibration rig that is a little off. Lengths in mm, forces in N.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

#: Gauge signals to fx, fy, m of Son et al. (section 3.2), read as N and N mm per volt.
PRINTED_MATRIX: Floats = np.array([[-126.0, -51, 127], [378, -6, -72], [396, -128, 22]])


class OpticalDome:
    """Rubber feelers on a lit dome, seen by a camera along z.

    The grey-value sum rises with two slopes and a rounded knee (Figs. 9 and 10), depends a
    little on the inclination of the force (3.7 %, Fig. 11), and the brightness on the
    latitude and from element to element. The centroid moves in proportion to the shear,
    whatever the inclination (Fig. 12). Shear near the edge of the dome is foreshortened.

    Args:
        azimuth_rad, latitude_rad: float64[n].
        rng: draws the spread of the elements and the noise.
        noise_grey: standard deviation of a grey-value sum.
        noise_pixels: standard deviation of a centroid.
    """

    def __init__(
        self,
        azimuth_rad: Floats,
        latitude_rad: Floats,
        rng: np.random.Generator,
        *,
        noise_grey: float = 10.0,
        noise_pixels: float = 0.005,
    ) -> None:
        n = len(azimuth_rad)
        self._sine = np.sin(latitude_rad)
        self._cos, self._sin = np.cos(azimuth_rad), np.sin(azimuth_rad)
        self._rng = rng
        self._noise_grey = noise_grey
        self._noise_pixels = noise_pixels
        #: Grey value per N below and above the knee, and the knee, N.
        self.lower = 4000.0 * (1.3 - 0.3 * self._sine) * np.exp(0.1 * rng.normal(size=n))
        self.upper = self.lower * rng.uniform(0.45, 0.8, n)
        self.knee_n = rng.uniform(0.5, 0.9, n)
        self.pixels_per_n = 2.0

    def read(self, force_n: ArrayLike) -> tuple[Floats, Floats]:
        """Grey-value sums [..., n] and centroids [..., n, 2] in the picture.

        Args:
            force_n: [..., n, 3], south, east and normal; a push is negative.
        """
        force = np.asarray(force_n, np.float64)
        push = np.maximum(-force[..., 2], 0.0)
        shear = force[..., :2]
        width = 0.03
        beyond = width * np.logaddexp(0.0, (push - self.knee_n) / width)
        grey = self.lower * push + (self.upper - self.lower) * beyond
        lean2 = (shear**2).sum(axis=-1) / np.maximum(push, 0.05) ** 2
        grey = grey * (1.0 - 0.037 * np.minimum(3.0 * lean2, 1.0)) * self._sine
        grey = np.round(grey + self._noise_grey * self._rng.normal(size=grey.shape))
        moved = self.pixels_per_n * shear * (push > 0.0)[..., None]
        south = moved[..., 0] * self._sine
        picture = np.stack(
            [
                south * self._cos - moved[..., 1] * self._sin,
                south * self._sin + moved[..., 1] * self._cos,
            ],
            axis=-1,
        )
        return np.maximum(grey, 0.0), picture + self._noise_pixels * self._rng.normal(
            size=picture.shape
        )


@dataclass(frozen=True, slots=True)
class LoadPatch:
    """How a contact's load lies on the skin: points [k, 2] mm about its middle, shares [k]."""

    points_mm: Floats
    share: Floats


def pin_patch(radius_mm: float = 1.66) -> LoadPatch:
    """A round Hertz contact: a 1.6 mm tip on rubber of 0.7 MPa under 3 N."""
    axis = np.linspace(-1.0, 1.0, 9)
    points = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    share = np.sqrt(np.maximum(1.0 - (points**2).sum(axis=1), 0.0))
    kept = share > 0.0
    return LoadPatch(radius_mm * points[kept], share[kept] / share.sum())


def box_patch(half_width_mm: float = 2.4, length_mm: float = 16.0, skew: float = 0.0) -> LoadPatch:
    """A line contact along the cylinder, heavier at its ends (edge effect, section 4.4).

    `skew` in -1..1 loads one end more than the other.
    """
    around = half_width_mm * np.linspace(-0.9, 0.9, 7)
    along = length_mm * np.linspace(-0.5, 0.5, 17)
    points = np.stack(np.meshgrid(around, along), -1).reshape(-1, 2)
    edge = 1.0 + 0.8 * (np.abs(points[:, 1]) > 0.45 * length_mm)
    tilt = 1.0 + 2.0 * skew * points[:, 1] / length_mm
    share = np.sqrt(1.0 - (points[:, 0] / half_width_mm) ** 2) * edge * tilt
    return LoadPatch(points, share / share.sum())


class StripArray:
    """Crossed copper strips under rubber on a cylinder: vertical strain in a half-space.

    Boussinesq's and Cerruti's solutions at the depth of the elements, added over the
    contact patch. As the paper measured (its Fig. 2), the strips take away most of the
    local effect of shear, and carry a little of normal load and shear far along.

    Args:
        around_mm, along_mm: float64[columns], float64[rows], places of the strips.
        rng: draws gains and noise.
        depth_mm: of the elements.
        poisson: of the rubber with its air gaps.
        shear_local: share of Cerruti's strain that is left.
        shear_far: height of the long tail of shear, relative to the response's peak.
        noise: standard deviation of an element, relative to the peak at 3 N.
        gain_sd: what the pressure calibration leaves.
    """

    def __init__(
        self,
        around_mm: Floats,
        along_mm: Floats,
        rng: np.random.Generator,
        *,
        depth_mm: float = 2.4,
        poisson: float = 0.12,
        shear_local: float = 0.35,
        shear_far: float = 0.25,
        noise: float = 0.006,
        gain_sd: float = 0.02,
    ) -> None:
        self._around, self._along = around_mm, along_mm
        self._rng = rng
        self._depth_mm = depth_mm
        self._poisson = poisson
        self._shear_local = shear_local
        self._shear_far = shear_far
        self._gain = np.exp(gain_sd * rng.normal(size=(len(along_mm), len(around_mm))))
        peak = float(self._response(np.zeros(1), np.zeros(1), 1.0, 0.0)[0])
        self._scale = 1.0 / (3.0 * peak)
        self._noise = noise

    def read(
        self, place_mm: ArrayLike, normal_n: ArrayLike, shear_n: ArrayLike, patch: LoadPatch
    ) -> Floats:
        """Responses float64[n, rows, columns]; 1 is the peak over a point load of 3 N.

        Args:
            place_mm: [n], middle of the contact along the circumference.
            normal_n: [n], pressing force.
            shear_n: [n], tangential force on the skin along the circumference.
            patch: of the contact.
        """
        place, normal, shear = np.broadcast_arrays(
            *(np.atleast_1d(np.asarray(v, np.float64)) for v in (place_mm, normal_n, shear_n))
        )
        total = np.zeros((len(place), len(self._along), len(self._around)))
        for (px, py), share in zip(patch.points_mm, patch.share, strict=True):
            x = self._around[None, None, :] - (place + px)[:, None, None]
            y = np.broadcast_to((self._along - py)[None, :, None], x.shape[:1] + total.shape[1:])
            total += share * self._response(
                np.broadcast_to(x, y.shape), y, normal[:, None, None], shear[:, None, None]
            )
        total *= self._scale * self._gain
        return total + self._noise * self._rng.normal(size=total.shape)

    def _response(
        self, x: Floats, y: Floats, normal: float | Floats, shear: float | Floats
    ) -> Floats:
        """Vertical strain at (x, y) from a point load, up to (1 + nu) / (2 pi E)."""
        z = self._depth_mm
        r2 = x**2 + y**2 + z**2
        shape = 3.0 * z**3 / r2**2.5 - 2.0 * self._poisson * z / r2**1.5
        peak = (3.0 - 2.0 * self._poisson) / z**2
        # Along the strips, one strip wide.
        tail = np.exp(-np.abs(x) / 10.0 - (y / 2.0) ** 2)
        far = peak * tail * (0.01 * normal + self._shear_far * shear * np.tanh(x / 6.0))
        local: Floats = shape * (normal + self._shear_local * shear * x / z)
        return local + far


class PlanarGauges:
    """Three gauges under a planar fingertip, with its mass (Son et al., sections 3.2 and 4.1).

    Forces follow the paper's sign: outward, from the fingertip's centre to the contact.

    Args:
        rng: draws the noise.
        mass_kg: between the gauges and the contact.
        noise_v: of a gauge.
        offset_n: constant out-of-plane load, as it shows in fx, fy, m.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        *,
        mass_kg: float = 0.035,
        noise_v: float = 1.0e-4,
        offset_n: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self._rng = rng
        self._mass_kg = mass_kg
        self._noise_v = noise_v
        self._offset = np.array(offset_n)
        self._to_signals = np.linalg.inv(PRINTED_MATRIX)

    def read(self, load: ArrayLike, acceleration_m_s2: ArrayLike = 0.0) -> Floats:
        """Gauge signals float64[n, 3], V.

        Args:
            load: [n, 3], fx, fy (N) and m (N mm) of the contact, about the centre.
            acceleration_m_s2: [n, 2], of the fingertip; its mass centre is the centre.
        """
        total = np.asarray(load, np.float64) + self._offset
        inertial = np.zeros_like(total)
        inertial[..., :2] = self._mass_kg * np.asarray(acceleration_m_s2)
        signals: Floats = (total + inertial) @ self._to_signals.T
        return signals + self._noise_v * self._rng.normal(size=signals.shape)

    def calibration_presses(
        self,
        count: int,
        radius_mm: float,
        *,
        place_sd_mm: float = 0.2,
        angle_sd_rad: float = 0.02,
    ) -> tuple[Floats, Floats, Floats]:
        """Presses by hand with a pointed indenter: what was meant, and what was read.

        The rubber gives way, so place and direction are not quite those meant. These errors
        are what limits the calibration (section 3.2).

        Returns:
            Loads meant [count, 3], the first of them none; gauge signals [count, 3]; and
            true places and forces [count, 3] as place mm, normal N, tangential N.
        """
        rng = self._rng
        place = rng.uniform(-6.0, 6.0, count)
        lean = rng.uniform(-0.4, 0.4, count)
        size = rng.uniform(1.0, 4.0, count)
        size[0] = 0.0
        true_lean = lean + angle_sd_rad * rng.normal(size=count)
        true_place = place + place_sd_mm * rng.normal(size=count)
        meant = planar_load(place, size * np.cos(lean), size * np.sin(lean), radius_mm)
        normal, tangential = size * np.cos(true_lean), size * np.sin(true_lean)
        signals = self.read(planar_load(true_place, normal, tangential, radius_mm))
        return meant, signals, np.column_stack([true_place, normal, tangential])


def planar_load(
    place_mm: ArrayLike, normal_n: ArrayLike, tangential_n: ArrayLike, radius_mm: float
) -> Floats:
    """fx, fy (N), m (N mm) float64[n, 3] of a contact on a circle, in Son's sign.

    Place along the circumference from the x axis; normal outward, tangential towards
    greater places.
    """
    angle = np.asarray(place_mm, np.float64) / radius_mm
    normal, tangential = np.asarray(normal_n), np.asarray(tangential_n)
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack(
        [normal * cos - tangential * sin, normal * sin + tangential * cos, radius_mm * tangential],
        axis=-1,
    )
