"""What a press leaves in the foam: a touch that feels no more than that is not reported."""

import math

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.masks import Mask, any_of
from skin_host.processing.touch import FALL_DEVIATIONS, Array

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
#: There it does not fall while that much is still felt, up to this share of the press, which falls
#: in the same time: foam that is pressed again and again recovers more slowly.
FELT_SHARE = 0.1
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
#: The mean of as many measurements as end a press differs by less than this share of that: by three
#: of its own standard deviations.
MEAN_NOISE_SHARE = 3.0 / (math.sqrt(2.0) * FALL_DEVIATIONS)
#: A rise of the mean by so many of its own standard deviations is not noise: they are those of a
#: measurement times the root of `MEAN_SHARE` / (2 - `MEAN_SHARE`).
RISE_DEVIATIONS = 5.0


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
        #: What the last firm press of each taxel left when it fell or ended, fading; and the least
        #: that has been felt since it fell, at most that.
        self._left = np.zeros(n, np.float32)
        self._still_felt = np.zeros(n, np.float32)
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
        if self._unfitted_share:
            self._keep_felt()
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

    def _keep_felt(self) -> None:
        """Let what a press left not fade while it is felt."""
        np.fmin(self._still_felt, self._felt, out=self._still_felt)
        np.copyto(self._still_felt, 0.0, where=~self._held)
        stays = np.fmin(self._still_felt, FELT_SHARE * self._hardest)
        np.fmax(self._left, stays, out=self._left, where=self._held & ~self._reported)

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
            most = LARGEST_SHARE * self._hardest[ended] + self._lacking[ended]
            self._left[ended] = np.clip(left, 0.0, np.fmax(most, self._left[ended]))
            self._still_felt[ended] = self._left[ended]
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
