"""Three slip detectors over contacts or elements, one sample at a time.

`friction_used` needs to know the friction; `RatioDrop` and `ShearRate` do not. Forces in
N; normal forces are not negative. All arrays have one entry a contact. `SlipWatch` applies them to
the load of one contact.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skin_host.config.fingertips import Fingertip
from skin_host.fingertip.events import Cause

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


#: Noise alone crosses the threshold of the rate no more often than this.
FALSE_ALARMS_PER_HOUR = 0.1


def friction_used(
    normal_n: ArrayLike, shear_n: ArrayLike, friction: float, *, minimum_n: float = 0.1
) -> Floats:
    """Return the share of the friction limit that is used, float64[n]; slip is expected at 1.

    Ft / (mu Fn) (Bicchi and Dario, Fig. 6, first strategy). 0 for contacts lighter than
    `minimum_n`.

    Args:
        normal_n: [n].
        shear_n: [n, 2], tangential forces.
        friction: mu, a safe estimate of the static coefficient.
        minimum_n: least normal force.
    """
    normal = np.asarray(normal_n, np.float64)
    tangential = np.linalg.norm(np.asarray(shear_n, np.float64), axis=-1)
    heavy = normal >= minimum_n
    used: Floats = np.where(heavy, tangential / (friction * np.where(heavy, normal, 1.0)), 0.0)
    return used


class RatioDrop:
    """Detects an abrupt fall of the ratio Ft / Fn: static friction became sliding friction.

    For unknown friction (Bicchi and Dario, Fig. 6, second strategy). The ratio's mean over a short
    window is compared with that of the window before; the fall must exceed the effect of noise. If
    sliding friction is no lower than static friction, the ratio does not fall and this detector
    finds nothing.

    Args:
        contacts: n.
        force_sd_n: noise of one force reading; the fall must exceed 6 times its effect.
        minimum_n: contacts with less normal force are ignored.
    """

    #: Samples in each of the two windows, and least fall of the ratio.
    WINDOW = 2
    LEAST_DROP = 0.04

    def __init__(
        self,
        contacts: int,
        *,
        force_sd_n: float = 0.013,
        minimum_n: float = 0.2,
    ) -> None:
        self._past = np.full((2 * self.WINDOW, contacts), np.nan)
        self._force_sd_n = force_sd_n
        self._minimum_n = minimum_n

    def step(self, normal_n: ArrayLike, shear_n: ArrayLike) -> Mask:
        """Return which contacts slip, bool[n], from normal [n] and tangential forces [n, 2]."""
        normal = np.asarray(normal_n, np.float64)
        tangential = np.linalg.norm(np.asarray(shear_n, np.float64), axis=-1)
        heavy = normal >= self._minimum_n
        safe = np.where(heavy, normal, 1.0)
        self._past[:-1] = self._past[1:]
        self._past[-1] = np.where(heavy, tangential / safe, np.nan)
        before = self._past[: self.WINDOW].mean(axis=0)
        after = self._past[self.WINDOW :].mean(axis=0)
        noise = self._force_sd_n / safe * np.sqrt((1.0 + after**2) * 2.0 / self.WINDOW)
        slips: Mask = before - after > np.maximum(self.LEAST_DROP, 6.0 * noise)
        return slips


class ShearRate:
    """The time derivative of the shear force, by a line through the last samples (Ohka et al.).

    The line is the low-pass that the derivative needs: a plain difference has noise
    sd sqrt(2) / dt; through w samples it is sd sqrt(12 / (w (w^2 - 1))) / dt.

    There are n contacts, w samples in the window, and d components; 2 in the tangent plane.
    """

    def __init__(
        self, contacts: int, rate_hz: float, *, window: int = 6, components: int = 2
    ) -> None:
        self._past = np.full((window, contacts, components), np.nan)
        offset = np.arange(window) - 0.5 * (window - 1)
        self._weight = offset / (offset @ offset) * rate_hz

    def step(self, shear_n: ArrayLike) -> Floats:
        """|dFs/dt|, float64[n], N/s, of forces [n, d]; 0 until the window is full.

        A reading that is not a number repeats the one before.
        """
        rate: Floats = np.linalg.norm(self.derivative(shear_n), axis=-1)
        return rate

    def derivative(self, shear_n: ArrayLike) -> Floats:
        """dFs/dt itself, float64[n, d], N/s, as `step`."""
        shear = np.asarray(shear_n, np.float64)
        self._past[:-1] = self._past[1:]
        self._past[-1] = np.where(np.isfinite(shear), shear, self._past[-2])
        rate = np.tensordot(self._weight, self._past, axes=1)
        known: Floats = np.where(np.isfinite(rate).all(axis=-1, keepdims=True), rate, 0.0)
        return known

    def threshold(self, force_sd_n: float, false_alarms_per_hour: float, rate_hz: float) -> float:
        """Return the least threshold, N/s, that noise alone crosses at most this often.

        The two components are Gaussian, so the magnitude of their vector crosses t with
        probability exp(-t^2 / 2 s^2) per sample.
        """
        deviation = force_sd_n * float(np.linalg.norm(self._weight))
        per_sample = false_alarms_per_hour / (3600.0 * rate_hz)
        return deviation * math.sqrt(-2.0 * math.log(min(per_sample, 1.0)))


@dataclass(frozen=True, slots=True)
class Seen:
    """Normal and tangential force (N), rate of the latter (N/s), and the sign of a slip, if any."""

    normal_n: float
    shear_n: float = 0.0
    rate_n_s: float = 0.0
    cause: Cause | None = None


class SlipWatch:
    """Watches one contact.

    Forces have the standard deviation `noise_n` in each component.

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
