"""Applies the detectors of `slip` to the load of one contact."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skin_host.config.fingertips import Fingertip
from skin_host.fingertip.events import Cause
from skin_host.fingertip.slip import RatioDrop, ShearRate, friction_used

Floats = NDArray[np.float64]

#: Noise alone crosses the threshold of the rate no more often than this.
FALSE_ALARMS_PER_HOUR = 0.1


@dataclass(frozen=True, slots=True)
class Seen:
    """Normal and tangential force (N), rate of the latter (N/s), and the sign of a slip, if any."""

    normal_n: float
    shear_n: float = 0.0
    rate_n_s: float = 0.0
    cause: Cause | None = None


class SlipWatch:
    """Watches one contact.

    Args:
        settings: of the fingertip.
        rate_hz: of the samples.
        noise_n: standard deviation of a component of the force.

    Attributes:
        threshold_n_s: of the rate; the noise may raise the configured one.
    """

    def __init__(self, settings: Fingertip, rate_hz: float, noise_n: float) -> None:
        self._friction = settings.friction
        self._least_n = settings.threshold_n
        self._derivative = ShearRate(1, rate_hz, components=3)
        self._fall = RatioDrop(1, force_sd_n=noise_n, minimum_n=2.0 * settings.threshold_n)
        by_noise = self._derivative.threshold(noise_n, FALSE_ALARMS_PER_HOUR, rate_hz)
        self.threshold_n_s = max(settings.slip_n_s, by_noise)

    def step(self, load: Floats, normal: Floats | None, *, settled: bool) -> Seen:
        """Take in a sample.

        Args:
            load: float64[6], not smoothed.
            normal: float64[3], of the surface at the contact, if it has a place.
            settled: the contact is not new; the force of a new contact may build up at any rate.
        """
        # Rate of the whole force, because its tangential axes turn with the place of the contact.
        change = self._derivative.derivative(load[None, :3])[0]
        if normal is None:
            return Seen(float(np.linalg.norm(load[:3])))
        normal_n = max(0.0, -float(load[:3] @ normal))
        shear = load[:3] + normal_n * normal
        shear_n = float(np.linalg.norm(shear))
        fell = self._fall.step(np.array([normal_n]), np.array([[shear_n, 0.0]]))[0]
        if not settled:
            return Seen(normal_n, shear_n)
        change = change - (change @ normal) * normal
        rate = float(np.linalg.norm(change))
        cause: Cause | None = None
        if rate > self.threshold_n_s:
            cause = "rate"
        elif self._friction is None:
            # Pressing harder lowers the ratio too, but then the shear force itself does not fall.
            if fell and float(change @ shear) < 0.0:
                cause = "fall"
        else:
            used = friction_used(
                np.array([normal_n]),
                np.array([[shear_n, 0.0]]),
                self._friction,
                minimum_n=self._least_n,
            )
            if used[0] >= 1.0:
                cause = "friction"
        return Seen(normal_n, shear_n, rate, cause)
