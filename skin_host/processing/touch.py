"""The touch decision: evidence of each taxel, accumulated measurement by measurement.

The paper (section V-B) compares each sample with a threshold two units above the 95th percentile
of the untouched readings. On real skin noise reaches that all the time: its standard deviation is
0.7 to 1.5 units on most pads and 4 to 6 on one in twenty, while 40 kPa are 3.5 units. So the
threshold here is one for lasting changes: two units above the untouched mean. What a measurement
reads above it, minus what later ones read below it, is evidence (Page's cumulative sum), and a
taxel is touched when its evidence reaches its span. The span of each taxel is chosen so that its
noise alone gets there once in `ODDS` measurements. A quiet taxel needs two measurements for that,
a noisy one an average over as many as its noise requires, and a firm press always two.
"""

import math
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import TouchSettings
from skin_host.processing.conversions import CONVERSION_S, Conversions
from skin_host.processing.masks import Mask, any_of

Array = NDArray[np.floating]
Floats = NDArray[np.float64]
HALF_UNIT = 0.5
#: Noise alone causes a touch once in this many measurements of a taxel: 10^4 hours at 27 a second.
ODDS = 1e9
#: A random walk passes a level by this many standard deviations of its step, in the mean
#: (Siegmund, Sequential Analysis, 1985, chapter X).
OVERSHOOT_DEVIATIONS = 1.166
#: A noisy taxel is given the threshold at which it decides on the smallest press in this time.
DECIDE_S = 1.0
#: A press on which a taxel surely decides in time is so many standard deviations above one on which
#: it does so in the mean: 98 of 100 draws of noise are less.
SURE_DEVIATIONS = 2.0
#: A touch accumulates at most this many spans of evidence. Fewer make noisy taxels flicker, more
#: make them release late.
HOLD_SPANS = 1.5
#: A touched taxel that was not received for this long must show again that it is touched.
LOST_S = 0.5
#: A firm press ends after at most this many measurements.
RELEASE_MEASUREMENTS = 14
#: Rounded at the edge of a byte, noise is up to so many times what it is in its middle, at most so
#: many units (standard deviation).
EDGE_NOISE = 1.5
ROUNDED_UNITS = 0.5
#: No threshold and no span is less, whatever the settings: rounding is not evidence.
LEAST_UNITS = 0.1
#: A repeated fall by this many standard deviations of a measurement is not noise.
FALL_DEVIATIONS = 4.0


class Levels(NamedTuple):
    """Where n taxels begin and end to be touched, float64[n] in units above the baseline.

    Attributes:
        enter: a lasting reading above this becomes a touch.
        leave: a lasting reading below this ends it.
        whole: a single measurement above this counts in full.
        span: evidence that makes a touch.
        hold: the most evidence of a touch, which must be gone at its end.
        fall: readings that are this much lower, `votes` times in a row, are not noise.
        votes: int64[n], measurements that a press of twice the threshold takes.
        spread: standard deviation of a measurement.
    """

    enter: Floats
    leave: Floats
    whole: Floats
    span: Floats
    hold: Floats
    fall: Floats
    votes: NDArray[np.int64]
    spread: Floats

    @property
    def decides(self) -> Floats:
        """Return the activation [n] that becomes a touch within `DECIDE_S` in the mean, if each
        conversion is sent: what noise costs.
        """
        return self.enter + self.span * CONVERSION_S / DECIDE_S

    def decides_surely(self, interval_s: Floats | float, votes: int) -> Floats:
        """Return the activation [n] of which nearly every press becomes a touch within `DECIDE_S`,
        or in the least number of measurements, if those take longer.

        Args:
            interval_s: float64[n], time between measurements.
            votes: least number of measurements for a touch.
        """
        measurements = np.maximum(np.floor(DECIDE_S / np.asarray(interval_s) + 1e-6), votes)
        # No measurement counts for more than one vote: that much cannot be made up for.
        free = measurements - votes + 1
        noise = SURE_DEVIATIONS * self.spread / np.sqrt(free)
        return np.asarray(self.enter + self.span / measurements + noise, np.float64)

    def measurements(self, votes: int) -> NDArray[np.int64]:
        """Return the measurements [n] that a press of twice the threshold takes, and one more for
        their noise.

        Args:
            votes: least number of measurements for a touch.
        """
        return np.maximum(np.ceil(self.span / self.enter), votes).astype(np.int64) + 1


def levels(above: Floats, spread: Floats, settings: TouchSettings) -> Levels:
    """Return the levels of n taxels.

    Args:
        above: float64[n], 95th percentile of the untouched readings above their mean, in units.
        spread: float64[n], standard deviation of a measurement derived from sums of measurements:
            more than that of single ones where noise lasts.
        settings: margin and hysteresis.

    The margin covers lasting changes that are not noise: drift, rounding, the effect of a press
    next to the taxel. Readings are whole units, so half a unit less is the same rule; and it stays
    the same when the baseline has followed drift by a fraction of a unit. The percentile counts at
    most as that of a byte: the span covers larger noise.
    """
    margin = settings.margin_units - HALF_UNIT + np.minimum(above, HALF_UNIT)
    margin = np.maximum(margin, max(settings.minimum_threshold_units, LEAST_UNITS))
    band = np.minimum(settings.hysteresis_units, margin)
    # With n measurements a press of `enter` + span / n is detected; the least of that:
    best = spread * math.sqrt(math.log(ODDS) / 2 * CONVERSION_S / DECIDE_S)
    enter = np.maximum(margin - band / 2, best)
    # A pad that rested in the middle of a byte may rest at its edge after the next zero.
    noise = np.maximum(spread, np.minimum(EDGE_NOISE * spread, ROUNDED_UNITS))
    span = np.maximum(_span(enter, noise), np.maximum(band, LEAST_UNITS))
    # A reading near its threshold must not flicker, and the sum of noise goes far.
    leave = enter - enter / 2 * (1.0 - band / span)
    hold = np.maximum(span, np.minimum(2 * (span - band), HOLD_SPANS * span))
    votes = np.clip(np.ceil(span / enter), 2, RELEASE_MEASUREMENTS)
    fall = FALL_DEVIATIONS * spread * np.sqrt(2 / votes)
    whole = enter + band / 2
    return Levels(enter, leave, whole, span, hold, fall, votes.astype(np.int64), spread)


def _span(enter: Floats, spread: Floats) -> Floats:
    """Evidence [n] that noise of so many units reaches once in `ODDS` measurements.

    The mean time to a false alarm of a cumulative sum is exp(2 k b) / (2 k^2) steps, with the
    drift k of its steps and the bound b, overshoot included, in standard deviations (Siegmund).
    """
    deviation = np.maximum(spread, 1e-6)
    drift = enter / deviation
    bound = np.log(ODDS * np.maximum(2 * drift**2, 1.0)) / (2 * drift)
    return deviation * (bound - OVERSHOOT_DEVIATIONS)


def felt_by(settings: TouchSettings) -> TouchSettings:
    """Return the settings by which a press is known, whatever is to be called a touch.

    Larger thresholds are asked for where only firm presses matter. A lighter one presses all the
    same: baselines must not follow it, and a zero that is taken under it is none.
    """
    usual = TouchSettings()
    return msgspec.structs.replace(
        settings,
        margin_units=min(settings.margin_units, usual.margin_units),
        minimum_threshold_units=min(
            settings.minimum_threshold_units, usual.minimum_threshold_units
        ),
    )


class TouchDetector:
    """Decides which of the n taxels of a part are touched.

    Each new measurement adds its excess above `enter` to the evidence of its taxel, or subtracts
    what it is below. No measurement counts for more than one vote: a touch begins and ends with at
    least that many.

    Args:
        found: levels [n] of the taxels; infinite where a taxel must never be touched.
        votes: least number of measurements for a touch.

    Attributes:
        touched: bool[n]; see `step`.
        any: whether any is.
        repeated: bool[n], which taxels only repeated a measurement in the last step; None if none.
        lost: bool[n], taxels whose touch was lost, and that have neither been touched again nor
            been released since; None if none.
    """

    def __init__(self, found: Levels, votes: int = 2) -> None:
        n = len(found.enter)
        self._none = np.zeros(n, np.float32)
        self._zero = np.zeros(n, np.float32)
        self._conversions = Conversions(n)
        self._evidence = np.zeros(n, np.float32)
        self._no_evidence = self._evidence.tobytes()
        self._gain = np.empty(n, np.float32)
        self._over: Mask = np.empty(n, np.bool_)
        self._limit = np.empty(n, np.float32)
        self._near = np.zeros(n, np.uint8)
        #: For how long touched taxels were not received, and whether any was not.
        self._unheard_s = np.zeros(n, np.float32)
        self._is_unheard = False
        self.touched: Mask = np.zeros(n, np.bool_)
        self._bits = self.touched.tobytes()
        self._reads: Mask = np.empty(n, np.bool_)
        self.repeated: Mask | None = None
        self.lost: Mask | None = None
        self.any = False
        self._clear = True
        self._skipped = True
        self.configure(found, votes)

    def configure(self, found: Levels, votes: int) -> None:
        """Use other levels from now on; touched taxels stay touched."""
        self._enter = found.enter.astype(np.float32)
        self._leave = found.leave.astype(np.float32)
        self._span = found.span.astype(np.float32)
        # A little more than its share, because rounding would otherwise require one vote more.
        self._vote = self._span * np.float32((1 + 1e-5) / votes)
        self._hold = found.hold.astype(np.float32)
        self._veto = -self._hold * np.float32((1 + 1e-5) / votes)
        # What was gathered against other levels is no evidence against these.
        np.copyto(self._evidence, np.where(self.touched, self._hold, self._none))
        self._set_limits()

    def renew(self, zero: Array) -> None:
        """Set the readings [n] that are no activation, the foam's relaxation included."""
        np.copyto(self._zero, zero, casting="same_kind")
        self._set_limits()

    def is_idle(self, raw: NDArray[np.uint8]) -> bool:
        """Return whether a sweep of bytes [n] changes nothing and can be skipped.

        That is so when nothing is touched, no taxel has evidence and none reads any.
        """
        if self.any:
            return False
        np.less(raw, self._near, out=self._reads)
        if any_of(self._reads):
            return False
        if not self._clear:
            # Comparing bytes costs a fifth of counting.
            self._clear = self._evidence.tobytes() == self._no_evidence
            if not self._clear:
                return False
        self._skipped = True
        return True

    def step(self, raw: NDArray[np.uint8], dt_s: float, unheard: Mask | None = None) -> Mask:
        """Take one sweep; return which taxels are touched [n].

        The result is the same array as before as long as nothing has changed, and is never
        written to again.

        Args:
            raw: uint8[n]; must not be written to afterwards.
            dt_s: time since the sweep before.
            unheard: bool[n], taxels that were not received: their evidence does not change until
                they are lost. That of untouched ones is forgotten then: what is received now and
                then only may be received because of what it reads, and is no lasting change.
        """
        if self._skipped:
            self._skipped = False
            self._conversions.forget()
        self.repeated = repeated = self._conversions.step(raw, dt_s)
        gain, evidence = self._gain, self._evidence
        np.subtract(self._limit, raw, out=gain)
        np.minimum(gain, self._vote, out=gain)
        np.maximum(gain, self._veto, out=gain)
        if repeated is not None:
            np.putmask(gain, repeated, 0.0)  # in a third of the time of a copy with a mask
        if unheard is not None:
            gain[unheard] = 0.0
            self._unheard_s += np.float32(dt_s)
            self._unheard_s[~unheard] = 0.0
            self._is_unheard = True
            lost = self._unheard_s > LOST_S
            if any_of(lost):
                self.lose(self.touched & lost)
                forgotten = lost & ~self.touched
                if self.lost is not None:
                    forgotten &= ~self.lost
                evidence[forgotten] = 0.0
        elif self._is_unheard:
            self._unheard_s.fill(0.0)
            self._is_unheard = False
        np.add(evidence, gain, out=evidence)
        np.maximum(evidence, self._none, out=evidence)
        np.minimum(evidence, self._hold, out=evidence)
        np.greater_equal(evidence, self._bar, out=self._over)
        bits = self._over.tobytes()
        if bits != self._bits:
            self._bits = bits
            self.any = 1 in bits
            self.touched = self._over.copy()
            self._set_limits()
        if self.lost is not None:
            self._keep_lost((evidence > 0.0) & ~self.touched)
        self._clear = False
        return self.touched

    def lose(self, taxels: Mask) -> None:
        """Some touched taxels, bool[n], were not received for long, and may have been released.

        One vote of the next measurements makes them touched again: what still presses is felt at
        once, and what has lifted meanwhile is no touch.
        """
        if any_of(taxels):
            evidence = np.where(taxels, self._span - self._vote, self._evidence)
            lost = taxels if self.lost is None else taxels | self.lost
            self.reset(taxels)
            self.lost = lost
            np.copyto(self._evidence, evidence)

    def _keep_lost(self, which: Mask) -> None:
        """Keep only these of the lost taxels."""
        assert self.lost is not None
        lost = self.lost & which
        if not any_of(lost):
            self.lost = None
        elif lost.tobytes() != self.lost.tobytes():
            self.lost = lost

    def reset(self, taxels: NDArray[np.intp] | Mask) -> None:
        """Forget that some taxels, by number or mask [n], were touched."""
        self.touched = self.touched.copy()
        self.touched[taxels] = False
        self._evidence[taxels] = 0.0
        self._bits = self.touched.tobytes()
        self.any = 1 in self._bits
        if self.lost is not None:
            others = np.ones(len(self.touched), np.bool_)
            others[taxels] = False
            self._keep_lost(others)
        self._set_limits()

    def _set_limits(self) -> None:
        """Set the reading of each taxel below which its evidence grows, for touched and untouched
        ones.
        """
        touched = self.touched
        np.subtract(self._zero, np.where(touched, self._leave, self._enter), out=self._limit)
        # A touched taxel stays touched as long as there is any evidence.
        self._bar = np.where(touched, self._hold * np.float32(1e-4), self._span)
        np.copyto(self._near, np.clip(np.ceil(self._limit - 1e-3), 0.0, 255.0), casting="unsafe")
