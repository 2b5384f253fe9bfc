"""The touch decision (paper, section V-B), with a vote and hysteresis."""

import math

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.masks import Mask
from skin_host.settings import Touch

Array = NDArray[np.floating]
Floats = NDArray[np.float64]
#: Samples that have a vote.
VOTERS = 3
HALF_UNIT = 0.5
#: Three samples in a row above the first, or two of three above the second, happen by chance once
#: in some 10^5 hours of a taxel at 20 Hz. Of the first alone two of three come every 20 hours.
NOISE_DEVIATIONS = 3.6
SURE_DEVIATIONS = 5.0
#: What a press leaves in the foam that no model takes off: a share of it, and the time in which
#: that falls to 1/e. On the emulated foam, after 30 to 200 kPa of 0.5 to 8 s, about 3 % at
#: first, 2 % after a second and 1 % after five.
IMPRINT_SHARE = 0.03
IMPRINT_S = 5.0


def threshold_units(
    percentile_units: Floats, baseline_units: Floats, noise_units: Floats, settings: Touch
) -> Floats:
    """Return the activation [n] above the baseline from which on a taxel counts as touched.

    The paper: at least the 95th percentile of the calibration plus a margin of two units.
    Readings are whole units, so half a unit less is the same rule; and it stays the same
    when the baseline has followed drift by a fraction of a unit.

    With more than about one unit of noise that margin is too small for a skin of thousands
    of taxels: a noisy taxel keeps so many standard deviations of its noise instead.
    """
    above = percentile_units - baseline_units + settings.margin_units - HALF_UNIT
    at_least = np.maximum(NOISE_DEVIATIONS * noise_units, settings.minimum_threshold_units)
    return np.maximum(above, at_least)


def sure_units(threshold: Floats, noise_units: Floats) -> Floats:
    """The activation [n] from which on two of three samples are enough: noise does not get there.

    Below it, at the threshold, a press must last for a third sample.
    """
    return np.maximum(threshold, SURE_DEVIATIONS * noise_units)


class TouchDetector:
    """Which of n taxels are touched: enough of the last three samples at the threshold.

    With two votes these must be sure, or else three at the threshold. A touched taxel needs only
    the lower release threshold to stay so. The signal and the thresholds may be in any unit, as
    long as it is the same.

    Args:
        on, off: [n], thresholds of touch and of release.
        votes: of the last three samples, how many are needed.
        sure: [n], from which on two votes are enough; `on` if not given.
    """

    def __init__(self, on: Array, off: Array, votes: int = 2, sure: Array | None = None) -> None:
        if np.any(off > on):
            raise ValueError("a release threshold lies above the threshold of touch")
        self._on = np.array(on)
        self._off = np.array(off)
        self._sure = self._on if sure is None else np.array(sure)
        self._threshold = self._on.copy()
        self._votes = votes
        n = self._on.shape[0]
        self.touched: Mask = np.zeros(n, dtype=np.bool_)
        #: Of this sample, the last and the one before: at the threshold; sure.
        self._over = [np.zeros(n, dtype=np.bool_) for _ in range(VOTERS)]
        self._certain = [np.zeros(n, dtype=np.bool_) for _ in range(VOTERS)]
        self._next: Mask = np.zeros(n, dtype=np.bool_)
        self._scratch: Mask = np.zeros(n, dtype=np.bool_)
        self._bits = self.touched.tobytes()
        self._alike = VOTERS
        self._none = True

    def step(self, signal: Array) -> Mask:
        """Take one sample [n]; return which taxels are touched [n].

        A sample that is not a number counts as below any threshold. The answer is the same
        array as before as long as nothing has changed, and is never written to again.
        """
        over = self._over[0]
        np.greater_equal(signal, self._threshold, out=over)
        bits = over.tobytes()
        if bits != self._bits:
            self._bits, self._alike, self._none = bits, 0, bits.find(1) < 0
        elif self._alike >= VOTERS:
            return self.touched
        self._alike += 1
        np.greater_equal(signal, self._sure, out=self._certain[0])
        self._vote()
        return self.touched

    @property
    def idle(self) -> bool:
        """Whether nothing is touched or has a vote, so that a sample below all thresholds
        changes nothing and need not be taken.
        """
        return self._none and self._alike >= VOTERS

    def reset(self, taxels: NDArray[np.intp] | Mask) -> None:
        """Forget that some taxels, by number or mask [n], were touched."""
        self.touched = self.touched.copy()
        for state in (self.touched, *self._over[1:], *self._certain[1:]):
            state[taxels] = False
        self._threshold[taxels] = self._on[taxels]
        self._alike = 0

    def _vote(self) -> None:
        touched, scratch = self._next, self._scratch
        over, last, before = self._over
        if self._votes == 1:
            np.copyto(touched, over)
        else:
            # Three in a row begin a touch, or two of three that are sure.
            np.logical_and(over, last, out=touched)
            np.logical_and(touched, before, out=touched)
            if self._votes == 2:
                _two_of_three(self._certain, scratch)
                np.logical_or(touched, scratch, out=touched)
                _two_of_three(self._over, scratch)
            else:
                # Letting go needs as many votes as touching.
                np.logical_or(last, before, out=scratch)
                np.logical_or(scratch, over, out=scratch)
            np.logical_and(scratch, self.touched, out=scratch)
            np.logical_or(touched, scratch, out=touched)
        for samples in (self._over, self._certain):
            samples.insert(0, samples.pop())
        np.not_equal(touched, self.touched, out=scratch)
        if np.count_nonzero(scratch):
            self.touched = touched.copy()
            np.copyto(self._threshold, np.where(touched, self._off, self._on))


def _two_of_three(samples: list[Mask], out: Mask) -> None:
    now, last, before = samples
    np.logical_or(last, before, out=out)
    np.logical_and(out, now, out=out)
    # The third pair; the array is free until the next sample is taken.
    np.logical_and(last, before, out=before)
    np.logical_or(out, before, out=out)


class Imprints:
    """Which of n touched taxels to tell of: not those that feel but what a press has left.

    A taxel that was let go of is told as touched again when it feels that much more than the
    threshold. The decision before stays as it is for whoever follows baselines: what is left
    may be drift, and then it lasts.
    """

    def __init__(self, on: Array) -> None:
        self._on = np.array(on)
        #: The hardest press of each taxel, fading.
        self._pressed = np.zeros_like(self._on)
        self._told: Mask = np.zeros(len(self._on), dtype=np.bool_)
        self._seen = self._told
        self._any = False
        self._undecided = False

    def step(self, touched: Mask, signal: Array) -> Mask:
        """Take one decision [n] and the signal [n] that it was made on.

        As with the decision, the answer is the same array as long as nothing has changed.
        """
        if self._undecided or touched is not self._seen:
            self._seen = touched
            told = touched & (self._told | (signal >= self._on + IMPRINT_SHARE * self._pressed))
            self._any = bool(np.count_nonzero(told))
            self._undecided = not np.array_equal(told, touched)
            if not np.array_equal(told, self._told):
                self._told = told
        if self._any:
            np.fmax(self._pressed, signal, out=self._pressed, where=self._told)
        return self._told

    def fade(self, dt_s: float) -> None:
        """Let what earlier presses left fade for so long."""
        self._pressed *= math.exp(-dt_s / IMPRINT_S)
