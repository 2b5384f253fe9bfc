"""Three slip detectors over contacts or elements, one sample at a time.

`friction_used` needs to know the friction; `RatioDrop` and `ShearRate` do not. Forces in
N; normal forces are not negative. All arrays have one entry a contact. `SlipWatch` applies them to
the load of one contact.

Samples may be lost. `SampleAges` finds from the times of the others how many periods lie between
them, so that what changed slowly over a gap is not taken for what changed at once.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skin_host.config.fingertips import Fingertip
from skin_host.fingertip.events import Cause

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
#: How many periods ago the samples of a window were taken, the oldest first, the newest 0; None if
#: each came a period after the one before.
Ages = tuple[int, ...] | None


#: Noise alone crosses the threshold of the rate no more often than this.
FALSE_ALARMS_PER_HOUR = 0.1


def size(vector: Floats) -> float:
    """Return the length of a vector float64[3]; `numpy.linalg.norm` takes ten times as long."""
    return math.sqrt(vector @ vector)


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


class SampleAges:
    """How many periods ago the last samples were taken, some between which may be lost.

    A board samples in time with its period, but its frames arrive when the bus and the computer let
    them. So ages are whole numbers of periods, and no two are the same: samples that were held up
    and arrive together were still taken one after the other. By the arrivals themselves they would
    change at any rate.

    Args:
        window: samples in the window.
        period_ns: of the board.
    """

    def __init__(self, window: int, period_ns: int) -> None:
        self._t_ns: deque[int] = deque(maxlen=window)
        self._window = window
        self._period_ns = period_ns

    def step(self, t_ns: int) -> Ages:
        """Take in the time of a sample, not before that of the last; return the ages of the window.

        Until the window is full, samples are assumed before the first, a period apart.
        """
        if not self._t_ns:
            self._t_ns.extend(t_ns - i * self._period_ns for i in range(self._window, 0, -1))
        self._t_ns.append(t_ns)
        oldest = self._periods(t_ns - self._t_ns[0])
        if oldest < self._window:
            return None
        ages: list[int] = []
        # Each has a place of its own between the one that is newer and the oldest.
        for newer, before_ns in enumerate(reversed(self._t_ns)):
            least = ages[-1] + 1 if ages else 0
            most = oldest - (self._window - 1 - newer)
            ages.append(min(max(least, self._periods(t_ns - before_ns)), most))
        return tuple(reversed(ages))

    def _periods(self, duration_ns: int) -> int:
        return (duration_ns + self._period_ns // 2) // self._period_ns


class RatioDrop:
    """Detects an abrupt fall of the ratio Ft / Fn: static friction became sliding friction.

    For unknown friction (Bicchi and Dario, Fig. 6, second strategy). The ratio's mean over a short
    window is compared with that of the window before; the fall must exceed the effect of noise. If
    sliding friction is no lower than static friction, the ratio does not fall and this detector
    finds nothing. Where samples are lost, the windows are further apart, and the least fall is
    larger in proportion: what falls too slowly for a slip does not become one.

    Args:
        contacts: n.
        force_sd_n: noise of one force reading; the fall must exceed 6 times its effect.
        minimum_n: contacts with less normal force are ignored.
    """

    #: Samples in each of the two windows, and least fall of the ratio between them.
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

    def step(self, normal_n: ArrayLike, shear_n: ArrayLike, ages: Ages = None) -> Mask:
        """Return which contacts slip, bool[n].

        Args:
            normal_n: [n].
            shear_n: [n, 2], tangential forces.
            ages: of the last samples, those of the two windows at least.
        """
        normal = np.asarray(normal_n, np.float64)
        shear = np.asarray(shear_n, np.float64)
        tangential = np.hypot(shear[:, 0], shear[:, 1])
        heavy = normal >= self._minimum_n
        safe = np.where(heavy, normal, 1.0)
        self._past[:-1] = self._past[1:]
        self._past[-1] = np.where(heavy, tangential / safe, np.nan)
        # A sum takes a third of the time of a mean.
        before = np.add.reduce(self._past[: self.WINDOW]) / self.WINDOW
        after = np.add.reduce(self._past[self.WINDOW :]) / self.WINDOW
        slips: Mask = before - after > self.LEAST_DROP * self._stretch(ages)
        if np.count_nonzero(slips):  # the noise is of interest for these alone
            noise = self._force_sd_n / safe * np.sqrt((1.0 + after**2) * 2.0 / self.WINDOW)
            slips &= before - after > 6.0 * noise
        return slips

    def _stretch(self, ages: Ages) -> float:
        """Return how many times further apart the two windows are than without losses."""
        if ages is None:
            return 1.0
        before, after = ages[-2 * self.WINDOW : -self.WINDOW], ages[-self.WINDOW :]
        return (sum(before) - sum(after)) / self.WINDOW**2


class ShearRate:
    """The time derivative of the shear force, by a line through the last samples (Ohka et al.).

    The line is the low-pass that the derivative needs: a plain difference has noise
    sd sqrt(2) / dt; through w samples it is sd sqrt(12 / (w (w^2 - 1))) / dt.

    Where samples are lost, the line is fitted at the ages of the others. Its slope is a weighted
    mean of the slopes between all pairs of samples, so whatever is lost, a force that never changes
    faster than a threshold does not cross it; and a longer window has less noise. So a window is
    not emptied at a gap: what comes after it is judged at once.

    There are n contacts, w samples in the window, and d components; 2 in the tangent plane.
    """

    def __init__(
        self, contacts: int, rate_hz: float, *, window: int = 6, components: int = 2
    ) -> None:
        self._past = np.full((window, contacts, components), np.nan)
        self._rate_hz = rate_hz
        self._weight = self._weight_of(np.arange(window))

    def step(self, shear_n: ArrayLike, ages: Ages = None) -> Floats:
        """|dFs/dt|, float64[n], N/s, of forces [n, d]; 0 until the window is full.

        A reading that is not a number repeats the one before. `ages` are those of the window.
        """
        rate: Floats = np.linalg.norm(self.derivative(shear_n, ages), axis=-1)
        return rate

    def derivative(self, shear_n: ArrayLike, ages: Ages = None) -> Floats:
        """dFs/dt itself, float64[n, d], N/s, as `step`."""
        shear = np.asarray(shear_n, np.float64)
        self._past[:-1] = self._past[1:]
        is_number = np.isfinite(shear)
        self._past[-1] = shear if is_number.all() else np.where(is_number, shear, self._past[-2])
        weight = self._weight if ages is None else self._weight_of(-np.array(ages))
        rate: Floats = (weight @ self._past.reshape(len(weight), -1)).reshape(self._past.shape[1:])
        is_number = np.isfinite(rate)
        if is_number.all():
            return rate
        return np.where(is_number.all(axis=-1, keepdims=True), rate, 0.0)

    def _weight_of(self, periods: NDArray[np.int_]) -> Floats:
        """Return what each sample adds to the slope, 1/s, from when it was taken, int[w]."""
        offset = periods - periods.mean()
        weight: Floats = offset / (offset @ offset) * self._rate_hz
        return weight

    def threshold(self, force_sd_n: float, false_alarms_per_hour: float, rate_hz: float) -> float:
        """Return the least threshold, N/s, that noise alone crosses at most this often.

        The two components are Gaussian, so the magnitude of their vector crosses t with
        probability exp(-t^2 / 2 s^2) per sample. No window has more noise than one without losses.
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

    #: Samples that the detectors look back, this one included.
    WINDOW = 6

    def __init__(self, settings: Fingertip, noise_n: float) -> None:
        rate_hz = 1000.0 / settings.period_ms
        self._friction = settings.friction
        self._least_n = settings.threshold_n
        self._ages = SampleAges(self.WINDOW, 1_000_000 * settings.period_ms)
        self._derivative = ShearRate(1, rate_hz, window=self.WINDOW, components=3)
        self._fall = RatioDrop(1, force_sd_n=noise_n, minimum_n=2.0 * settings.threshold_n)
        by_noise = self._derivative.threshold(noise_n, FALSE_ALARMS_PER_HOUR, rate_hz)
        self.threshold_n_s = max(settings.slip_n_s, by_noise)

    def step(self, load: Floats, normal: Floats | None, t_ns: int, *, settled: bool) -> Seen:
        """Take in a sample.

        Args:
            load: float64[6], not smoothed.
            normal: float64[3], of the surface at the contact, if it has a place.
            t_ns: when it came, not before the last one.
            settled: the contact is not new; the force of a new contact may build up at any rate.
        """
        # Rate of the whole force, because its tangential axes turn with the place of the contact.
        ages = self._ages.step(t_ns)
        force = load[:3]
        change = self._derivative.derivative(force[None], ages)[0]
        if normal is None:
            # No ratio is known, and a later one is not compared with those before.
            if self._friction is None:
                self._fall.step(np.zeros(1), np.zeros((1, 2)))
            return Seen(size(force))
        normal_n = max(0.0, -float(force @ normal))
        shear = force + normal_n * normal
        shear_n = size(shear)
        fell = False
        if self._friction is None:
            fell = self._fall.step(np.array([normal_n]), np.array([[shear_n, 0.0]]), ages)[0]
        if not settled:
            return Seen(normal_n, shear_n)
        change = change - (change @ normal) * normal
        rate = size(change)
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
