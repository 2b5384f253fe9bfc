"""Array and force/torque of one planar fingertip as one contact estimate.

Each makes up for the other (Son et al., section 5). The array is blind to inertia but is
pulled aside by shear: the force sensor measures the shear. The force sensor is fast but is
hard to calibrate and answers every acceleration: the array shows its errors. Presses by
hand calibrate both corrections; a Kalman filter over place, speed and the force sensor's
remaining bias joins them in time.

Places are in mm along the circumference, forces in N in the sign of `planar`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skin_host.errors import CalibrationError
from skin_host.evaluation.papers.array import smooth_peak
from skin_host.evaluation.papers.planar import contact_angle, position_sd_mm

Floats = NDArray[np.float64]

#: Vibration (10 to 20 Hz, Son et al. section 4.3) makes so many servo samples err alike, so
#: each counts for one of them.
ALIKE_SAMPLES = 6.0
#: Errors of the array, from strips and gains, do not average out over samples.
ARRAY_SD_MM = 0.06


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
