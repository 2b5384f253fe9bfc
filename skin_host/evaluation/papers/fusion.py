"""One planar fingertip with an array and force/torque (Son et al.): each alone, and both as one.

The array locates a contact in the three ways of its section 2.2, and a fourth; samples without a
response give NaN. Force and torque locate it by one angle on a circle (section 3): the force is the
object's on the fingertip with reversed sign, so it points outward, from the centre to the contact.
Derivatives are the corrected ones: the paper's eq. 3.6 has a wrong sign in its second term, a wrong
denominator under dm and a missing square under dr.

Each makes up for the other (section 5). The array is blind to inertia but is
pulled aside by shear: the force sensor measures the shear. The force sensor is fast but is
hard to calibrate and answers every acceleration: the array shows its errors. Presses by
hand calibrate both corrections; a Kalman filter over place, speed and the force sensor's
remaining bias joins them in time.

All work on many samples at once. Places are in mm along the circumference, forces in N, torque in
N mm about the circle's centre.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skin_host.errors import CalibrationError
from skin_host.processing.localization_centroid import quadratic_peak

Floats = NDArray[np.float64]

#: Vibration (10 to 20 Hz, Son et al. section 4.3) makes so many servo samples err alike, so
#: each counts for one of them.
ALIKE_SAMPLES = 6.0
#: Errors of the array, from strips and gains, do not average out over samples.
ARRAY_SD_MM = 0.06
#: Width of the window of `smooth_peak`, in pitches. Wide enough that a sum over places a
#: pitch apart is as good as an integral, narrow enough to leave far elements out.
WINDOW_PITCHES = 1.25


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


def centroid(response: ArrayLike, around_mm: Floats, *, share: float = 0.0) -> Floats:
    """Centroid over all elements of at least `share` of the greatest (eq. 2.2).

    With share 0 it is the paper's simple centroid, with 0.5 its threshold centroid.
    """
    p = np.asarray(response, np.float64)
    if share > 0.0:
        p = np.where(p >= share * p.max(axis=(1, 2), keepdims=True), p, 0.0)
    # Negative readings stay: cutting them off would turn noise into load all over the array.
    columns = p.sum(axis=1)
    total = columns.sum(axis=1)
    total = np.where(total > 0.0, total, np.nan)
    place: Floats = columns @ around_mm / total
    return place


def peak(response: ArrayLike, around_mm: Floats) -> Floats:
    """Top of a parabola through the greatest element and its neighbours in its row.

    At an edge of the array the greatest element itself is the answer.
    """
    p = np.asarray(response, np.float64)
    n, _, columns = p.shape
    row, column = np.divmod(p.reshape(n, -1).argmax(axis=1), columns)
    inner = np.clip(column, 1, columns - 2)
    sample = np.arange(n)
    a, b, c = (p[sample, row, inner + side] for side in (-1, 0, 1))
    offset = quadratic_peak(a, b, c, float(around_mm[1] - around_mm[0]))
    place = around_mm[column] + np.where(inner == column, offset, 0.0)
    return np.where(p.max(axis=(1, 2)) > 0.0, place, np.nan)


def smooth_peak(response: ArrayLike, around_mm: Floats, *, steps: int = 8) -> Floats:
    """Top of the profile after smoothing with a Gaussian window (mean shift).

    Each step takes the centroid within a window about the last. It looks neither at one
    element's noise, as `peak` does, nor at far elements, as `centroid` does, and has no
    threshold for elements to jump across.
    """
    profile = np.maximum(np.asarray(response, np.float64), 0.0).sum(axis=1)
    place: Floats = around_mm[profile.argmax(axis=1)]
    width = WINDOW_PITCHES * float(around_mm[1] - around_mm[0])
    for _ in range(steps):
        off = around_mm - place[:, None]
        weight = profile * np.exp(-0.5 * (off / width) ** 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            # A bell under the window of its own width moves only half way: step twice.
            place = place + 2.0 * (weight * off).sum(axis=1) / weight.sum(axis=1)
    return place


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


@dataclass(frozen=True, slots=True)
class FusionCalibration:
    """Corrections of the two places, each linear in (1, shear ratio, place / radius).

    Attributes:
        array, force: float64[3], what to take off each place, mm.
        force_sd_mm: what is left of the force sensor's, against the array.
    """

    array: Floats
    force: Floats
    force_sd_mm: float


def shear_ratio(load: ArrayLike, place_mm: ArrayLike, radius_mm: float) -> Floats:
    """Tangential over normal force at a place, float64[n], within -1..1."""
    fx, fy, _ = np.moveaxis(np.asarray(load, np.float64), -1, 0)
    angle = np.asarray(place_mm, np.float64) / radius_mm
    normal = fx * np.cos(angle) + fy * np.sin(angle)
    tangential = -fx * np.sin(angle) + fy * np.cos(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio: Floats = np.clip(np.where(normal > 0.0, tangential / normal, 0.0), -1.0, 1.0)
    return ratio


def _traits(ratio: Floats, place_mm: ArrayLike, radius_mm: float) -> Floats:
    turn = np.asarray(place_mm, np.float64) / radius_mm
    return np.stack([np.ones_like(turn), ratio, turn], axis=-1)


def _fit(traits: Floats, error_mm: Floats) -> Floats:
    solution = np.linalg.lstsq(traits, error_mm, rcond=None)[0]
    return solution.astype(np.float64)


def calibrate_fusion(
    place_mm: ArrayLike, load: ArrayLike, response: ArrayLike, around_mm: Floats, radius_mm: float
) -> FusionCalibration:
    """Learn both corrections from presses at about known places.

    The array is corrected to the places meant; errors of the hand average out over the
    presses. The force sensor is corrected to the array, press by press: there the
    hand's errors are no matter, as both sensors felt the same press.

    Args:
        place_mm: [k], places meant.
        load: [k, 3], fx, fy, m as the calibrated force sensor measures them.
        response: [k, rows, columns], of the array.
        around_mm: places of the columns.
        radius_mm: of the fingertip.

    Raises:
        CalibrationError: fewer than 12 presses in which both sensors answer.
    """
    loads = np.asarray(load, np.float64)
    by_array = smooth_peak(response, around_mm)
    by_force = radius_mm * contact_angle(loads[:, 0], loads[:, 1], loads[:, 2], radius_mm)
    good = np.isfinite(by_array) & np.isfinite(by_force)
    if good.sum() < 12:
        raise CalibrationError(
            f"fingertip fusion: {int(good.sum())} presses felt by both sensors; wanted at least 12"
        )
    meant, loads = np.asarray(place_mm, np.float64)[good], loads[good]
    by_array, by_force = by_array[good], by_force[good]
    ratio = shear_ratio(loads, by_array, radius_mm)
    traits = _traits(ratio, by_array, radius_mm)
    array = _fit(traits, by_array - meant)
    corrected = by_array - traits @ array
    force_traits = _traits(ratio, by_force, radius_mm)
    force = _fit(force_traits, by_force - corrected)
    left = by_force - force_traits @ force - corrected
    spread = float(np.std(left))
    return FusionCalibration(array, force, spread)


class FingertipFusion:
    """One contact estimate from both sensors, sample by sample.

    Args:
        calibration: of the corrections.
        radius_mm: of the fingertip.
        force_sd_n, torque_sd_nmm: noise of the force sensor.
        mass_kg: between force sensor and contact; its inertia is unknown force.
        minimum_force_n: below it the force sensor is not asked (Son et al., section 4.4).
        speed_change_mm_s2: how fast a rolling contact changes its speed.
    """

    def __init__(
        self,
        calibration: FusionCalibration,
        radius_mm: float,
        *,
        force_sd_n: float,
        torque_sd_nmm: float,
        mass_kg: float = 0.0,
        minimum_force_n: float = 0.5,
        speed_change_mm_s2: float = 25.0,
    ) -> None:
        self._calibration = calibration
        self._radius_mm = radius_mm
        self._force_sd_n = force_sd_n
        self._torque_sd_nmm = torque_sd_nmm
        self._mass_kg = mass_kg
        self._minimum_force_n = minimum_force_n
        self._speed_change = speed_change_mm_s2
        self._state = np.zeros(3)
        self._covariance = np.zeros((3, 3))
        self._known = False

    def reset(self) -> None:
        """Forget the contact; the next reading of the array starts a new one."""
        self._known = False

    @property
    def sigma_mm(self) -> float:
        """Standard error of the place; infinite without a contact."""
        return float(np.sqrt(self._covariance[0, 0])) if self._known else float("inf")

    def step(
        self,
        dt_s: float,
        load: ArrayLike,
        array_place_mm: float | None = None,
        acceleration_m_s2: float = 0.0,
    ) -> float:
        """Place of the contact, mm; NaN before the array has shown one.

        Args:
            dt_s: since the last step.
            load: fx, fy (N), m (N mm) of the force sensor.
            array_place_mm: of `array.smooth_peak`, when there is a new reading.
            acceleration_m_s2: how large unknown accelerations of the fingertip may be.
        """
        loads = np.asarray(load, np.float64)
        if self._known:
            self._predict(dt_s)
        if array_place_mm is not None and np.isfinite(array_place_mm):
            ratio = shear_ratio(loads, array_place_mm, self._radius_mm)
            traits = _traits(ratio, array_place_mm, self._radius_mm)
            place = float(array_place_mm - traits @ self._calibration.array)
            if not self._known:
                self._begin(place)
            else:
                self._correct(place, np.array([1.0, 0.0, 0.0]), ARRAY_SD_MM)
        if self._known:
            self._use_force(loads, acceleration_m_s2)
            return float(self._state[0])
        return float("nan")

    def _begin(self, place_mm: float) -> None:
        self._state = np.array([place_mm, 0.0, 0.0])
        self._covariance = np.diag([ARRAY_SD_MM**2, 100.0, self._calibration.force_sd_mm**2])
        self._known = True

    def _predict(self, dt_s: float) -> None:
        step = np.array([[1.0, dt_s, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        self._state = step @ self._state
        self._covariance = step @ self._covariance @ step.T
        # A rolling contact turns round within about a tenth of a second.
        push = self._speed_change**2 * 0.1 * dt_s
        self._covariance[1, 1] += push
        self._covariance[2, 2] += 0.1**2 * dt_s

    def _use_force(self, loads: Floats, acceleration_m_s2: float) -> None:
        fx, fy, m = loads
        if np.hypot(fx, fy) < self._minimum_force_n:
            return
        place = float(self._radius_mm * contact_angle(fx, fy, m, self._radius_mm))
        if not np.isfinite(place):
            return
        unknown_n = np.hypot(self._force_sd_n, self._mass_kg * acceleration_m_s2)
        deviation = float(
            position_sd_mm(
                fx,
                fy,
                m,
                self._radius_mm,
                force_sd_n=unknown_n,
                torque_sd_nmm=self._torque_sd_nmm,
            )
        )
        ratio = shear_ratio(loads, place, self._radius_mm)
        traits = _traits(ratio, place, self._radius_mm)
        self._correct(
            place - float(traits @ self._calibration.force),
            np.array([1.0, 0.0, 1.0]),
            deviation * np.sqrt(ALIKE_SAMPLES),
        )

    def _correct(self, place_mm: float, sees: Floats, deviation_mm: float) -> None:
        surprise = place_mm - float(sees @ self._state)
        variance = float(sees @ self._covariance @ sees) + deviation_mm**2
        # Accelerations come in bursts: what lies beyond 3 deviations counts for less.
        excess = surprise**2 / (9.0 * variance)
        if excess > 1.0:
            variance += (excess - 1.0) * variance
        gain = self._covariance @ sees / variance
        self._state = self._state + gain * surprise
        self._covariance = self._covariance - np.outer(gain, sees @ self._covariance)
