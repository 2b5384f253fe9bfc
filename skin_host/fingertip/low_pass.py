"""The filter of a force/torque signal before contacts are located in it (Son et al.)."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


class Butterworth2:
    """A two-pole Butterworth low-pass over channels, one sample at a time.

    Bilinear transform with prewarped corner. The first sample sets the state at rest.
    """

    def __init__(self, cutoff_hz: float, rate_hz: float, channels: int = 1) -> None:
        if not 0.0 < cutoff_hz < 0.5 * rate_hz:
            raise ValueError(f"cutoff {cutoff_hz} Hz; wanted between 0 and half of {rate_hz} Hz")
        # Plain numbers: those of NumPy make each step slower.
        k = float(np.tan(np.pi * cutoff_hz / rate_hz))
        norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
        self._b = k * k * norm
        self._a1 = 2.0 * (k * k - 1.0) * norm
        self._a2 = (1.0 - math.sqrt(2.0) * k + k * k) * norm
        self._z1 = np.zeros(channels)
        self._z2 = np.zeros(channels)
        self._resting = True

    def step(self, value: ArrayLike) -> Floats:
        """Return filtered values float64[channels]. A NaN leaves the state unchanged."""
        x = np.asarray(value, np.float64)
        good = np.isfinite(x)
        whole = bool(good.all())
        if self._resting:
            if not whole:
                return np.array(np.broadcast_to(x, self._z1.shape))
            self._z1[:] = (1.0 - self._b) * x
            self._z2[:] = (self._b - self._a2) * x
            self._resting = False
        y: Floats = self._b * x + self._z1
        z1 = 2.0 * self._b * x - self._a1 * y + self._z2
        z2 = self._b * x - self._a2 * y
        self._z1 = z1 if whole else np.where(good, z1, self._z1)
        self._z2 = z2 if whole else np.where(good, z2, self._z2)
        return y
