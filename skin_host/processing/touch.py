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
#: Residual that a press leaves in the foam and that no model removes: its share of the press, and
#: the time in which it falls to 1/e. On the emulated foam, after 30 to 200 kPa of 0.5 to 8 s, about
#: 3 % at first, 2 % after a second and 1 % after five.
RESIDUAL_SHARE = 0.03
RESIDUAL_S = 5.0
#: Below this nothing is left of a press; denormal numbers would cost many times the time.
NEGLIGIBLE_KPA = 1e-20
#: Where the model of the foam is not fitted, more remains, for longer: what is felt when a firm
#: press falls, up to this share of it, and the time in which that falls to 1/e. On the emulated
#: foam, 10 s of 70 kPa leave up to 5 % for 15 s. The threshold of coarse units is larger; in fine
#: ones, a reading that is no more than this share and noise shows no press.
LARGEST_SHARE = 0.06
LEFT_S = 30.0
#: Beyond the calibrated range a pressure is an estimate, and so is the relaxation derived from it:
#: it may lack this share of itself, and more where the byte was cut off, because no byte shows how
#: hard the press was. On the emulated foam that ends the touch of 220 kPa held for ten minutes, and
#: of 250 kPa, a tenth beyond the end of the scale, held for one. More may remain of a harder or a
#: longer press; it is a touch then, because a contact that was eased reads the same.
BEYOND_SHARE = 0.25
CUT_OFF_SHARE = 0.5
#: Foam recovers half as fast as it relaxes. What is left of a press that was beyond the calibrated
#: range for a time falls to 1/e in this multiple of it more, and in at most so many seconds.
RECOVERS_IN = 2.0
LONGEST_LEFT_S = 1200.0
#: A residual of less than this share of the threshold causes no touch.
LEAST_RESIDUAL = 0.05
#: Weight of a new sample in the mean that is compared with the residual.
MEAN_SHARE = 0.25
#: A repeated fall by this many standard deviations of a measurement is not noise.
FALL_DEVIATIONS = 4.0
#: The mean of as many measurements as end a press differs by less than this share of that: by three
#: of its own standard deviations.
MEAN_NOISE_SHARE = 3.0 / (math.sqrt(2.0) * FALL_DEVIATIONS)
#: Nor is a rise of the mean by so many of its own, which are those of a measurement times the root
#: of `MEAN_SHARE` / (2 - `MEAN_SHARE`).
RISE_DEVIATIONS = 5.0


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


class Residuals:
    """Selects which of n touched taxels to report: not those that feel only a residual.

    A taxel that was released is reported as touched again when its reading exceeds the threshold by
    the residual: that of any press, or what was felt when this one fell. A firm press ends when it
    has fallen to its residual: by evidence alone that takes long, because the residual is nearly
    enough to keep a touch. The baselines still follow the decision before: what is left may be
    drift, and then it lasts. While that decision holds on to a residual it is no new evidence, nor
    is it when it has lost it and finds it again: a taxel is touched again when its mean rises
    further than noise carries it. Beyond the calibrated range the model of the foam may lack some
    of the relaxation, so a harder press ends at a higher residual, which remains for longer; and
    where none was fitted, more is left of any.

    A firm press has fallen when as many measurements in a row as a decision takes were below the
    bar. Where no model was fitted, what is left comes close to it, and noise carries some across:
    then those below must outnumber those above by as many, also of one that comes down slowly; as
    many more are needed after one that has stayed above the bar.

    Attributes:
        any: whether any is reported.
    """

    def __init__(self, n: int) -> None:
        self._on = np.zeros(n, np.float32)
        self._firmer = np.zeros(n, np.float32)
        self._votes = np.zeros(n, np.int64)
        #: The hardest press of each taxel, fading as its residual, and as what is left at most.
        self._pressed = np.zeros(n, np.float32)
        self._hardest = np.zeros(n, np.float32)
        #: What the last firm press of each taxel left when it fell or ended, fading.
        self._left = np.zeros(n, np.float32)
        self._felt = np.zeros(n, np.float32)
        #: The time in which that falls to 1/e, and by which share of itself the relaxation may be
        #: too small, both because of presses beyond the calibrated range; and that in kPa.
        self._left_s = np.full(n, LEFT_S, np.float32)
        self._lacking_share = np.zeros(n, np.float32)
        self._lacking = np.zeros(n, np.float32)
        #: Up to which share of it is left because no model was fitted; and what noise adds to the
        #: mean of as many measurements as end a press.
        self._unfitted_share = np.float32(0.0)
        self._mean_noise = np.zeros(n, np.float32)
        #: Which reported taxels were pressed firmly not long ago; how many more measurements were
        #: below the bar than above it; and number and sum of all since the first was below.
        self._firm = np.zeros(n, np.bool_)
        self._fallen = np.zeros(n, np.int64)
        self._fallen_number = np.zeros(n, np.int64)
        self._fallen_sum = np.zeros(n, np.float32)
        #: What noise adds to a measurement at most, and to the mean; and which taxels have fallen
        #: to their residual and are still touched by the decision before.
        self._outlier = np.zeros(n, np.float32)
        self._rise = np.zeros(n, np.float32)
        self._held = np.zeros(n, np.bool_)
        #: Whether any of `_fallen` is not 0.
        self._any_fallen = False
        self._reported: Mask = np.zeros(n, dtype=np.bool_)
        self._seen = self._reported
        self._lost: Mask | None = None
        self._which: NDArray[np.intp] | slice = np.zeros(0, np.intp)
        self.any = False
        self._undecided = False

    def configure(
        self, on: Array, firm: Array, votes: NDArray[np.int64], fitted: bool = True
    ) -> None:
        """Use other rules from now on.

        Args:
            on: float[n], activations that count in full, in kPa.
            firm: float[n], activations that noise does not take below `on`.
            votes: int[n], measurements that end a firm press.
            fitted: whether the model of the foam was fitted to the pads.
        """
        np.copyto(self._on, on, casting="same_kind")
        with np.errstate(invalid="ignore"):  # both are infinite where nothing is touched
            fall = firm - on
        np.copyto(self._firmer, np.fmax(fall, on), casting="same_kind")
        np.copyto(self._mean_noise, np.fmin(fall * MEAN_NOISE_SHARE, on), casting="same_kind")
        self._votes = votes
        self._unfitted_share = np.float32(0.0 if fitted else LARGEST_SHARE)
        np.copyto(self._outlier, self._firmer * np.sqrt(votes / 2), casting="same_kind")
        own = RISE_DEVIATIONS * math.sqrt(MEAN_SHARE / (2.0 - MEAN_SHARE))
        np.multiply(self._outlier, own / FALL_DEVIATIONS, out=self._rise)

    def step(
        self,
        touched: Mask,
        signal: Array,
        repeated: Mask | None = None,
        lost: Mask | None = None,
        relaxation: Array | None = None,
    ) -> Mask:
        """Take one decision [n] and the signal [n] that it was based on, in kPa.

        As with the decision, the result is the same array as long as nothing has changed.

        Args:
            touched: bool[n].
            signal: float[n].
            repeated: bool[n], which of them only repeat a measurement.
            lost: see `TouchDetector`.
            relaxation: float[n], what was subtracted for the signal, in kPa; by default nothing.
        """
        if relaxation is not None:
            np.multiply(self._lacking_share, relaxation, out=self._lacking, casting="same_kind")
            np.fmax(self._lacking, 0.0, out=self._lacking)
        if self._undecided or touched is not self._seen or lost is not self._lost:
            self._lost = lost
            self._begin_and_end(touched, signal, lost)
        if self.any:
            self._end_fallen(signal, repeated)
        return self._reported

    def press_beyond(self, taxels: Mask, cut_off: Mask, dt_s: float) -> None:
        """Some taxels, bool[n], are pressed beyond their calibrated range.

        Args:
            taxels: which ones.
            cut_off: bool[n], taxels at the end of the scale.
            dt_s: for how long.
        """
        share = np.where(cut_off, np.float32(CUT_OFF_SHARE), np.float32(BEYOND_SHARE))
        np.fmax(self._lacking_share, share, out=self._lacking_share, where=taxels)
        np.add(self._left_s, np.float32(RECOVERS_IN * dt_s), out=self._left_s, where=taxels)
        np.minimum(self._left_s, np.float32(LONGEST_LEFT_S), out=self._left_s)

    def _begin_and_end(self, touched: Mask, signal: Array, lost: Mask | None) -> None:
        known = touched & self._seen
        self._seen = touched
        self._note_left(np.flatnonzero(self._reported & ~touched))
        left = np.fmax(RESIDUAL_SHARE * self._pressed, self._left)
        unfitted = self._unfitted_share * self._hardest
        floor = self._mean_noise + unfitted
        bar = np.fmax(self._on + left, floor)
        negligible = LEAST_RESIDUAL * self._on
        # A sample is noisy: a taxel's signal is its fading mean since it was touched. The first one
        # is high if noise on top of what is left made it a touch.
        chance = (unfitted >= negligible) & (signal < bar + self._outlier)
        first = np.where(chance, np.fmin(signal, self._on), signal)
        felt = np.where(known, self._felt + MEAN_SHARE * (signal - self._felt), first)
        np.copyto(self._felt, felt, where=~self._reported, casting="same_kind")
        self._held &= touched if lost is None else touched | lost
        enough = (left < negligible) & (floor <= self._on) & ~self._held
        enough |= self._felt >= bar + np.where(self._held, self._rise, 0.0)
        self._report(touched & (self._reported | enough))
        self._undecided = not np.array_equal(self._reported, touched)

    def _note_left(self, ended: NDArray[np.intp]) -> None:
        """Note what is left of touches that the decision has ended, if they had fallen to that
        before. It ends them when noise has made some readings low, so more is left than they show.
        """
        if len(ended):
            felt, on = self._felt[ended], self._on[ended]
            most = LARGEST_SHARE * self._hardest[ended] + self._lacking[ended]
            fallen = felt < on + most
            left = np.clip(felt + self._rise[ended], self._left[ended], most)
            self._left[ended] = np.where(fallen, left, self._left[ended])
            # Only noise has kept a firm press that has fallen so far; if it was lost, it may be
            # found again.
            self._held[ended] = fallen & (self._hardest[ended] >= on + most + self._firmer[ended])

    def _end_fallen(self, signal: Array, repeated: Mask | None) -> None:
        """End touches that have fallen from a firm press to its residual."""
        which = self._which
        # Of all taxels, or some; views of the state are not written to.
        now, felt = signal[which], self._felt[which]
        pressed = np.fmax(self._pressed[which], now)
        self._pressed[which] = pressed
        self._hardest[which] = hardest = np.fmax(self._hardest[which], now)
        # What earlier presses have left is left after this one, too.
        left = np.fmax(RESIDUAL_SHARE * pressed + self._lacking[which], self._left[which])
        bar = np.fmax(
            self._on[which] + left, self._mean_noise[which] + self._unfitted_share * hardest
        )
        needed = bar + self._firmer[which]
        firmly = felt >= needed
        before, votes = self._fallen[which], self._votes[which]
        # What a fitted model leaves goes before a press that is eased slowly has come down to it.
        recent = hardest >= needed if self._unfitted_share else before > 0
        firm = firmly | (self._firm[which] & recent)
        self._firm[which] = firm
        again = None if repeated is None else repeated[which]
        mean = felt + MEAN_SHARE * (now - felt)
        self._felt[which] = mean if again is None else np.where(again, felt, mean)
        far = now >= bar + self._outlier[which]
        if not self._any_fallen and not any_of(firm & ~far):
            return
        # A fitted model leaves so little that what is above the bar is pressed.
        missed = np.where(far, np.minimum(before, 1), before) - 1 if self._unfitted_share else 0
        counts = np.where(now < bar, before + 1, missed)
        counts = np.where(firm, np.maximum(counts, np.where(firmly, 0, -votes)), 0)
        begins = before <= 0
        numbers = np.where(begins, 1, self._fallen_number[which] + 1)
        sums = np.where(begins, now, self._fallen_sum[which] + now)
        if again is not None:
            counts = np.where(again, before, counts)
            numbers = np.where(again, self._fallen_number[which], numbers)
            sums = np.where(again, self._fallen_sum[which], sums)
        self._fallen[which] = counts
        self._fallen_number[which] = numbers
        self._fallen_sum[which] = sums
        self._any_fallen = any_of(counts != 0)
        ended = np.flatnonzero(counts >= votes)
        if len(ended):
            if not isinstance(which, slice):
                ended = which[ended]
            # The last of them may be low by noise.
            left = self._fallen_sum[ended] / self._fallen_number[ended]
            self._felt[ended] = left
            self._held[ended] = True
            most = LARGEST_SHARE * self._pressed[ended] + self._lacking[ended]
            self._left[ended] = np.clip(left, 0.0, np.fmax(most, self._left[ended]))
            reported = self._reported.copy()
            reported[ended] = False
            self._report(reported)
            self._undecided = True

    def _report(self, reported: Mask) -> None:
        if not np.array_equal(reported, self._reported):
            began = reported & ~self._reported
            self._firm[began] = False
            self._fallen[began] = 0
            self._reported = reported
            found = np.flatnonzero(reported)
            self._which = found if len(found) < len(reported) else slice(None)
            self.any = bool(len(found))

    def fade(self, dt_s: float) -> None:
        """Let the residuals of earlier presses fade for this time."""
        kept = np.exp(np.float32(-dt_s) / self._left_s)
        self._left_s -= LEFT_S
        for residual, share in (
            (self._pressed, math.exp(-dt_s / RESIDUAL_S)),
            (self._hardest, kept),
            (self._left, kept),
            (self._lacking_share, kept),
            (self._left_s, kept),
        ):
            np.multiply(residual, share, out=residual)
            residual[np.abs(residual) < NEGLIGIBLE_KPA] = 0.0
        self._left_s += LEFT_S

    def reset(self, taxels: Mask) -> None:
        """Forget the presses on some taxels [n]."""
        self._pressed[taxels] = 0.0
        self._hardest[taxels] = 0.0
        self._left[taxels] = 0.0
        self._left_s[taxels] = LEFT_S
        self._lacking_share[taxels] = 0.0
        self._held[taxels] = False
        self._report(self._reported & ~taxels)
        self._undecided = True
