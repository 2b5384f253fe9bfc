"""Prepares a force/torque signal for the location of contacts (Son et al.).

The mass between sensor and contact responds to accelerations: its inertial force is removed where
the acceleration is known, and otherwise the time is marked as uncertain. A two-pole Butterworth
filter reduces the noise; contacts lighter than a threshold are not localised.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FingertipMass:
    """The part of the finger beyond the force sensor: its mass, and the position of its centre."""

    mass_kg: float
    centre_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def remove_inertia(
        self, force_n: ArrayLike, torque_nmm: ArrayLike, acceleration_m_s2: ArrayLike
    ) -> tuple[Floats, Floats]:
        """The contact's share of measured force and torque, all [n, 3].

        The sensor carries f = f_contact - mass (a - g). `acceleration_m_s2` is a - g, what
        an accelerometer in the fingertip reads; rotation of the fingertip is neglected.
        """
        inertial = -self.mass_kg * np.asarray(acceleration_m_s2, np.float64)
        force: Floats = np.asarray(force_n, np.float64) - inertial
        torque: Floats = np.asarray(torque_nmm, np.float64) - np.cross(self.centre_mm, inertial)
        return force, torque


class Butterworth2:
    """A two-pole Butterworth low-pass over channels, one sample at a time.

    Bilinear transform with prewarped corner. The first sample sets the state at rest.
    """

    def __init__(self, cutoff_hz: float, rate_hz: float, channels: int = 1) -> None:
        if not 0.0 < cutoff_hz < 0.5 * rate_hz:
            raise ValueError(f"cutoff {cutoff_hz} Hz; wanted between 0 and half of {rate_hz} Hz")
        k = np.tan(np.pi * cutoff_hz / rate_hz)
        norm = 1.0 / (1.0 + np.sqrt(2.0) * k + k * k)
        self._b = k * k * norm
        self._a1 = 2.0 * (k * k - 1.0) * norm
        self._a2 = (1.0 - np.sqrt(2.0) * k + k * k) * norm
        self._z1 = np.zeros(channels)
        self._z2 = np.zeros(channels)
        self._resting = True

    def step(self, value: ArrayLike) -> Floats:
        """Return filtered values float64[channels]. A NaN leaves the state unchanged."""
        x = np.broadcast_to(np.asarray(value, np.float64), self._z1.shape)
        if self._resting:
            if not np.isfinite(x).all():
                return np.array(x)
            self._z1 = (1.0 - self._b) * x
            self._z2 = (self._b - self._a2) * x
            self._resting = False
        y: Floats = self._b * x + self._z1
        z1 = 2.0 * self._b * x - self._a1 * y + self._z2
        z2 = self._b * x - self._a2 * y
        good = np.isfinite(x)
        self._z1 = np.where(good, z1, self._z1)
        self._z2 = np.where(good, z2, self._z2)
        return y

    def reset(self) -> None:
        """Forget the past; the next sample sets the state."""
        self._resting = True


def steady(
    force_n: ArrayLike, dt_s: float, *, minimum_force_n: float, rate_limit_n_s: float
) -> NDArray[np.bool_]:
    """bool[n]: samples fit for localisation without knowing the acceleration.

    The force must be above the threshold and change slowly: first contact, impacts and
    the corners of a trajectory show as fast changes (Son et al., section 4.4).

    Args:
        force_n: [n, 2 or 3], low-passed.
        dt_s: between samples.
        minimum_force_n: least force.
        rate_limit_n_s: greatest rate of change.
    """
    force = np.asarray(force_n, np.float64)
    rate = np.zeros(len(force))
    rate[1:] = np.linalg.norm(np.diff(force, axis=0), axis=1) / dt_s
    heavy = np.linalg.norm(force, axis=1) >= minimum_force_n
    fit: NDArray[np.bool_] = heavy & (rate <= rate_limit_n_s)
    return fit
