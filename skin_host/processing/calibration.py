"""The untouched reading of each taxel, its noise, and whether the taxel is usable.

The paper (section V-A) takes some seconds of untouched skin and keeps, per taxel, the mean and the
95th percentile. The readings are bytes, so a histogram of 256 counts keeps their whole
distribution, at a constant size for any length.

An activation is `no_load - raw`: it rises with pressure. All numbers here are in units of the
transmitted byte.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from statistics import median
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import TouchSettings
from skin_host.errors import CalibrationError, OtherSkinError
from skin_host.files import read_document, write_document
from skin_host.layout import Layout, PadKind
from skin_host.processing.conversions import Conversions
from skin_host.processing.curves import KNOTS_UNITS, Curves, CurveVerdict, Memory, rising
from skin_host.processing.masks import Mask
from skin_host.processing.touch import levels

SCHEMA = "skin.calibration/1"
#: A taxel is noisy if a decision within a second needs more than this multiple of the touch margin,
#: ...
NOISY_MARGINS = 1.5
#: ... and unusable if it needs more than this multiple: 16 units are half the scale of real skin.
USELESS_MARGINS = 8.0
#: Both are of units at this shift, which nearly all boards send. A pad that is sent in finer units
#: may need more of them: that is no more pressure.
USUAL_SHIFT = 2
#: With more than this share of its samples at the ends of the scale, a taxel is out of range.
SATURATED_SHARE = 0.05
#: A press is cut off if less than this share of the pressure curve's units fits between rest and 0.
#: The rest of a healthy pad is some noise beside its no-load value; at equation (1) the last
#: twentieth of the units are 3 % of the pressure.
CUT_OFF_SHARE = 0.95
#: With fewer samples than this, the rest position of a taxel is not known, ...
FEWEST_SAMPLES = 10
#: ... nor while its standard error may be a larger share of the threshold of touch: a noisy pad
#: needs 42 samples.
ERROR_SHARE = 1 / 4
#: With fewer measurements than this, nothing is known of a taxel's noise, ...
NOISE_SAMPLES = 40
#: ... and with fewer than this, it is at least what the calibration before has found.
KNOWN_SAMPLES = 60
#: A triangle of which less than this share of its part's samples were received dropped out.
RECEIVED_SHARE = 0.9
#: The course of a calibration is kept as means of this many samples, ...
BLOCK = 4
#: ... and at most this many means: when they are full, pairs are joined.
MOST_BLOCKS = 128
#: This many means are joined to measure how long noise lasts.
JOINED = 4
#: Three signs of a touch in the means: they differ by more than this and five standard errors, ...
STEADY_UNITS = 1.5
STEADY_ERRORS = 5.0
#: ... most of the variance is that of joined blocks (for white noise a sixteenth, for conversions
#: sent three times a sixth), and so many standard deviations more than such noise gives by chance,
#: ...
BETWEEN_SHARE = 0.5
SURE_DEVIATIONS = 6.0
#: ... and they rise and fall once, or together with another taxel of the triangle.
PRESS_SWITCHES = 2
SHARED_CORRELATION = 0.8
#: A taxel that rests this much nearer to pressure than its triangle and its part was pressed, if
#: its noise does not explain it.
PRESSED_UNITS = 8.0
#: Noise below this is rounding, from which the duration of noise cannot be measured.
ROUNDING_VARIANCE = 0.1
FEWEST_BLOCKS = 4
#: A histogram is smoothed with this share of its variance.
SMOOTHED_SHARE = 0.25
#: Noise jumps away from pressure if its skewness is beyond so many standard errors. A robot has
#: thousands of pads: with three, one in four hundred was taken for quieter than it is.
AWAY_ERRORS = 6.0
#: A normal variable is below its mean plus so many standard deviations in 95 of 100 cases.
SURE_QUANTILE = 1.645
#: Upper limit of the exponents, and number of bisections to find one.
LARGEST_EXPONENT = 40.0
BISECTIONS = 24
#: A pad with this much noise does not send the same byte for seconds.
LIVELY_UNITS = 0.6

#: A byte was damaged if it was off for one sweep by more than this many units, and this multiple of
#: the noise of the others: recorded skin at rest never is.
DAMAGED_UNITS = 7
DAMAGED_SIGMAS = 8.0
#: A pad that was so often more than twice, and this many times as often as the others of its
#: triangle in the mean, jumps itself.
OFTENER = 4.0
#: Of a pad with more such bytes none is kept apart: that is its noise.
MOST_OFF = 64

#: Channels of a force/torque board.
CHANNELS = 6

Floats = NDArray[np.float64]


class Verdict(IntEnum):
    """Result of the calibration of a taxel. The readings of STUCK and the following are not used.

    NOISY decides slowly, and on more pressure than others (`levels`). SATURATES rests so near 0
    that a press is cut off before its pressure curve ends. TOUCHED was touched for a part of the
    calibration, or for all of it. TOO_NOISY is not used: no realistic press would be detected.
    """

    OK = 0
    NOISY = 1
    SATURATES = 2
    TOUCHED = 3
    STUCK = 4
    OUT_OF_RANGE = 5
    TOO_NOISY = 6
    ABSENT = 7
    TOO_FEW = 8


@dataclass(frozen=True, slots=True)
class Zero:
    """Load that an unloaded force/torque board sends: mean and sd, float64[6], N and N m.

    `touched`: something touched the fingertip meanwhile, by the zero before.
    """

    offset: Floats
    noise: Floats
    touched: bool = False


@dataclass(frozen=True)
class Calibration:
    """The calibration of a whole skin: flat arrays in the order of its layout.

    Attributes:
        configuration: hash of the configuration it belongs to.
        id: identifies the numbers; equal numbers, equal id.
        time: when it was taken, ISO 8601 in UTC.
        baseline: float64[n], mean activation.
        percentile: float64[n], its 95th percentile (or the requested one).
        noise: float64[n], standard deviation of a measurement.
        spread: float64[n], the same derived from sums of measurements: larger where noise lasts for
            several measurements, and an upper limit after a short calibration.
        gain: float64[n], pressure of the taxel over that of the common curve.
        bend: float64[n], its quadratic part over that of the common curve, without the gain.
        verdict: uint8[n], see `Verdict`.
        zeros: of the fingertips on force/torque boards, by name.
        curves: of the pads and their foam, from a recording under known pressure, if there was one.
        unchanged: bool[n], taxels of which too little was received and that go on with what was
            known of them; None without a calibration before, and of a stored one.
        damaged: bool[n], taxels of which damaged bytes were left out; None of a stored one.
    """

    configuration: str
    id: str
    time: str
    baseline: Floats
    percentile: Floats
    noise: Floats
    spread: Floats
    gain: Floats
    bend: Floats
    verdict: NDArray[np.uint8]
    zeros: dict[str, Zero] = field(default_factory=dict)
    curves: Curves | None = None
    unchanged: Mask | None = None
    damaged: Mask | None = None

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """Which taxels [n] are usable; not to be written to."""
        usable: NDArray[np.bool_] = self.verdict < Verdict.STUCK
        if self.curves is not None:
            usable &= self.curves.usable
        usable.flags.writeable = False
        return usable


class Known(NamedTuple):
    """What is known of a skin while it is calibrated again.

    Attributes:
        calibration: the one in use.
        baseline: float64[n], the zeros in use, which have drifted or were found since, in units.
        zeroed: bool[n], taxels of which the zero in use is not in doubt.
    """

    calibration: Calibration
    baseline: Floats
    zeroed: Mask


class Calibrator:
    """Collects sweeps of untouched skin; `finish` turns them into a calibration.

    Args:
        layout: the skin.
        percentile: of the readings, kept beside their mean.
        touch: the touch decision by which noise is judged.
        range_units: float64[n], activation at which the pressure curve of each taxel ends; no limit
            by default.
    """

    def __init__(
        self,
        layout: Layout,
        percentile: float = 0.95,
        touch: TouchSettings | None = None,
        range_units: Floats | None = None,
    ) -> None:
        n = layout.n_taxels
        self._layout = layout
        self._percentile = percentile
        self._touch = touch or TouchSettings()
        self._range_units = np.full(n, np.inf) if range_units is None else range_units
        finer = [max(USUAL_SHIFT - triangle.shift, 0) for triangle in layout.triangles]
        self._fineness = np.exp2(np.array(finer))[layout.triangle_of]
        self._received = np.zeros(n, dtype=np.int64)
        self._counts = np.zeros((n, 256), dtype=np.int64)
        self._course = _Course(n)
        #: The last two bytes of each taxel, the newest first, and those that were off alone.
        self._last, self._earlier = np.zeros(n, np.int16), np.zeros(n, np.int16)
        self._off: list[_Off] = []
        self._was_off = np.zeros(n, np.bool_)
        self._times_off = np.zeros(n, np.int64)
        self._conversions = [Conversions(part.n_taxels) for part in layout.parts]
        self._at_ns: list[int | None] = [None] * len(layout.parts)

    def add(
        self,
        part_index: int,
        raw: NDArray[np.uint8],
        present: NDArray[np.bool_],
        t_ns: int | None = None,
    ) -> None:
        """Add one sweep of a part.

        Args:
            part_index: which part.
            raw: uint8[m], the bytes.
            present: bool[m], which of them were received.
            t_ns: time of the sweep; without it, every byte counts as a new measurement.
        """
        part = self._layout.parts[part_index]
        taxels = np.arange(part.start, part.stop)
        received = taxels[present]
        self._note_off(received, raw[present])
        self._received[received] += 1
        self._course.add(received, raw[present])
        new = present
        if t_ns is not None:
            before, self._at_ns[part_index] = self._at_ns[part_index], t_ns
            dt_s = 0.0 if before is None else max((t_ns - before) * 1e-9, 0.0)
            repeated = self._conversions[part_index].step(raw.copy(), dt_s)
            new = present if repeated is None else present & ~repeated
        self._counts[taxels[new], raw[new]] += 1

    def forget(self, taxels: NDArray[np.intp]) -> None:
        """Drop what was added of some taxels, whose board has another zero now."""
        self._received[taxels] = 0
        self._counts[taxels] = 0
        self._course.forget(taxels)
        self._times_off[taxels] = 0
        self._off = [one.of(~np.isin(one.taxel, taxels)) for one in self._off]

    def finish(self, configuration: str, time: str, known: Known | None = None) -> Calibration:
        """Return the calibration from the added sweeps.

        Args:
            configuration: hash of the configuration.
            time: when it was taken, ISO 8601 in UTC.
            known: of this skin from before. A taxel of which too little was received goes on with
                it, and noise is not lowered by few samples.
        """
        damaged = self._leave_out_damage()
        counts, received = self._counts, self._received
        samples = counts.sum(axis=1)
        some = np.maximum(samples, 1)
        mean_raw, variance = _mean_and_variance(counts)
        no_load = self._layout.no_load.astype(np.float64)
        baseline = no_load - mean_raw
        # Activation falls as raw rises: count from the top of the scale.
        cumulative = np.cumsum(counts[:, ::-1], axis=1)
        wanted = np.ceil(self._percentile * samples - 1e-9)
        from_top = np.argmax(cumulative >= wanted[:, np.newaxis], axis=1)
        percentile = no_load - (255.0 - from_top)
        noise = np.sqrt(variance)
        lasting = self._lasting(variance, received / some)

        course = self._course
        touched = self._touched(variance, received / some)
        steady_noise = course.error * np.sqrt(course.length * samples / np.maximum(received, 1))
        # The lowest activation is the best estimate of the untouched one.
        baseline = np.where(touched, no_load - course.highest, baseline)
        percentile = np.where(touched, baseline + 1.645 * steady_noise, percentile)
        noise = np.where(touched, steady_noise, noise)
        upward = np.where(touched, noise**2, _upward_variance(counts, variance, self._touch))
        spread = np.sqrt(upward * np.where(touched, 1.0, lasting))
        unknown = samples < NOISE_SAMPLES
        if known is not None:
            before = known.calibration
            unknown &= ~before.usable
            noisier = (samples < KNOWN_SAMPLES) & before.usable & (before.spread > spread)
            noise = np.where(noisier, np.fmax(noise, before.noise), noise)
            spread = np.where(noisier, before.spread, spread)
            above = np.fmax(percentile - baseline, before.percentile - before.baseline)
            percentile = np.where(noisier, baseline + above, percentile)

        rest = no_load - baseline
        margin = self._touch.margin_units * self._fineness
        touch = levels(percentile - baseline, spread, self._touch)
        cut_off = (rest < CUT_OFF_SHARE * self._range_units) & np.isfinite(self._range_units)
        ends = counts[:, 0] + counts[:, 255]
        verdict = np.full(len(samples), Verdict.OK, dtype=np.uint8)
        verdict[touch.decides > NOISY_MARGINS * margin] = Verdict.NOISY
        verdict[cut_off] = Verdict.SATURATES
        verdict[touched | self._pressed(baseline, counts)] = Verdict.TOUCHED
        verdict[touch.decides > USELESS_MARGINS * margin] = Verdict.TOO_NOISY
        verdict[ends > SATURATED_SHARE * samples] = Verdict.OUT_OF_RANGE
        verdict[(counts[:, 0] == samples) | (counts[:, 255] == samples)] = Verdict.STUCK
        # Bytes that come to an end of the scale and go differ by more than noise.
        jumps = (verdict == Verdict.OUT_OF_RANGE) & (steady_noise > 0.0)
        noise = np.where(jumps, np.minimum(noise, steady_noise), noise)
        few = (received < FEWEST_SAMPLES) | self._froze(variance)
        uncertain = spread > ERROR_SHARE * touch.enter * np.sqrt(some)
        few |= (unknown | uncertain) & (verdict < Verdict.STUCK)
        verdict[few] = Verdict.TOO_FEW
        verdict[received == 0] = Verdict.ABSENT
        # What a few bytes scatter by is not their noise: too little would call it damaged later.
        for array in (baseline, percentile, noise, spread):
            array[few] = 0.0
        found = Calibration(
            configuration,
            "",
            time,
            baseline=baseline,
            percentile=percentile,
            noise=noise,
            spread=spread,
            gain=np.ones(len(samples)),
            bend=np.ones(len(samples)),
            verdict=verdict,
            damaged=damaged,
        )
        return _identified(found if known is None else _going_on(found, known, few))

    def _note_off(self, taxels: NDArray[np.intp], raw: NDArray[np.uint8]) -> None:
        """Note which bytes the new ones [m] show to have been off alone: mostly the last ones."""
        new, last, earlier = raw.astype(np.int16), self._last[taxels], self._earlier[taxels]
        number = self._received[taxels]
        off = np.minimum(np.abs(last - earlier), np.abs(last - new))
        alone = (off > DAMAGED_UNITS) & (np.abs(new - earlier) <= DAMAGED_UNITS) & (number > 1)
        self._keep_off(alone, _Off(taxels, last, _middle(earlier, new), off, number - 1))
        off = np.abs(earlier - last)
        first = (off > DAMAGED_UNITS) & (np.abs(new - last) <= DAMAGED_UNITS) & (number == 2)
        self._keep_off(first, _Off(taxels, earlier, _middle(last, last), off, number - 2))
        self._was_off[taxels] = alone
        self._earlier[taxels] = last
        self._last[taxels] = new

    def _note_last_off(self) -> None:
        """Note which taxels' last byte was off, as far as the one before it shows that."""
        last, earlier, number = self._last, self._earlier, self._received
        off = np.abs(last - earlier)
        alone = (off > DAMAGED_UNITS) & ~self._was_off & (number > 2)
        self._keep_off(
            alone, _Off(np.arange(len(last)), last, _middle(earlier, earlier), off, number - 1)
        )

    def _keep_off(self, alone: Mask, found: "_Off") -> None:
        if not alone.any():
            return
        found = found.of(alone)
        self._times_off[found.taxel] += 1
        self._off.append(found.of(self._times_off[found.taxel] <= MOST_OFF))

    def _leave_out_damage(self) -> Mask:
        """Leave damaged bytes out of what was added, and return whose they were, bool[n]."""
        n = len(self._received)
        self._note_last_off()
        kept = [one for one in self._off if len(one.taxel)]
        self._off.clear()
        if not kept:
            return np.zeros(n, np.bool_)
        one = _Off.joined(kept)
        damaged = self._times_off[one.taxel] <= MOST_OFF
        some, row = np.unique(one.taxel, return_inverse=True)
        more = True
        while more:
            # The fewer are left out, the larger the noise of the others, until both agree.
            counts = self._counts[some]
            np.subtract.at(counts, (row[damaged], one.raw[damaged]), 1)
            far = one.off > DAMAGED_SIGMAS * np.sqrt(_mean_and_variance(counts)[1])[row]
            more = bool((damaged & ~far).any())
            damaged &= far
        times = np.bincount(one.taxel[damaged], minlength=n)
        triangle = self._layout.triangle_of
        mates = np.maximum(np.bincount(triangle)[triangle] - 1, 1)
        others = (np.bincount(triangle, times)[triangle] - times) / mates
        damaged &= (times <= 2.0 + OFTENER * others)[one.taxel]
        left = one.of(damaged)
        np.subtract.at(self._counts, (left.taxel, left.raw), 1)
        self._course.replace(left.taxel, left.number, left.between - left.raw)
        found = np.zeros(n, np.bool_)
        found[left.taxel] = True
        return found

    def _froze(self, variance: Floats) -> Mask:
        """Return the taxels [n] whose triangle was no longer received, and no pad of it had sent
        a second value by then.

        Its chip had stopped answering before: what was received is one reading again and again,
        until that was noticed. Triangles in coarse units may repeat theirs all the time.

        Args:
            variance: float64[n], of a measurement.
        """
        triangle = self._layout.triangle_of
        dropped = np.zeros(len(triangle), np.bool_)
        for part in self._layout.parts:
            mine = slice(part.start, part.stop)
            dropped[mine] = self._received[mine] < RECEIVED_SHARE * self._received[mine].max()
        lively = np.bincount(triangle, (variance > 0.0) | ~dropped)
        froze: Mask = lively[triangle] == 0.0
        return froze

    def _lasting(self, variance: Floats, repeats: Floats) -> Floats:
        """Return for how many measurements [n] noise lasts: 1 where each is independent of the
        last.

        The variance of block means is larger by this factor. How conversions fall into sweeps is
        the same for all taxels of a part, so their median counts; for a single taxel the difference
        must be beyond chance.

        Args:
            variance: float64[n], of a measurement.
            repeats: float64[n], samples a measurement.
        """
        course = self._course
        blocks = course.number // JOINED
        found = course.joined_variance * course.length * JOINED
        found /= np.maximum(repeats * variance, 1e-9)
        known = (variance > ROUNDING_VARIANCE) & (blocks >= FEWEST_BLOCKS)
        found = np.where(known, np.maximum(found, 1.0), 1.0)
        chance = 1.0 + 2.0 * np.sqrt(2.0 / np.maximum(blocks - 1, 1))
        lasting = np.maximum(found / chance, 1.0)
        for part in self._layout.parts:
            mine = slice(part.start, part.stop)
            if known[mine].any():
                common = median(found[mine][known[mine]].tolist())
                lasting[mine] = np.maximum(lasting[mine], common)
        return lasting

    def _touched(self, variance: Floats, repeats: Floats) -> Mask:
        """Return the taxels [n] that were touched for a part of the time.

        Not those that jump between levels: such noise has no course, or one that goes up and down
        more often than a press does and that no other pad shares.

        Args:
            variance: float64[n], of a measurement.
            repeats: float64[n], samples a measurement.
        """
        course = self._course
        moved = course.highest - course.lowest > STEADY_UNITS + STEADY_ERRORS * course.error
        # Few blocks of few measurements differ by chance.
        blocks = course.number // JOINED
        chance = 1.0 + SURE_DEVIATIONS * np.sqrt(2.0 / np.maximum(blocks - 1, 1))
        noise_share = repeats / (course.length * JOINED) * chance
        moved &= course.joined_variance > np.maximum(BETWEEN_SHARE, noise_share) * variance
        pressed = moved & (course.switches <= PRESS_SWITCHES)
        unclear = moved & ~pressed
        for taxel in np.flatnonzero(unclear):
            number = course.number[taxel]
            same = self._layout.triangle_of == self._layout.triangle_of[taxel]
            same &= moved & (course.number == number)
            same[taxel] = False
            own = course.means[taxel, :number]
            for other in np.flatnonzero(same):
                shared = np.corrcoef(own, course.means[other, :number])[0, 1]
                pressed[taxel] |= shared > SHARED_CORRELATION
        return pressed

    def _pressed(self, baseline: Floats, counts: NDArray[np.int64]) -> Mask:
        """Return the taxels [n] that were pressed all the time: they rest far from all other
        pads.

        A board's zero is one reading of each pad, noise included. A noisy pad may thus rest as far
        from the others as its own readings lie apart; only what is farther away was pressed.

        Args:
            baseline: float64[n], mean activations.
            counts: int64[n, 256], how often each byte was measured.
        """
        layout = self._layout
        seen = counts > 0
        known = seen.any(axis=1) & (layout.pad_kind == PadKind.PRESSURE)
        apart = 255 - np.argmax(seen[:, ::-1], axis=1) - np.argmax(seen, axis=1)
        limit = np.maximum(PRESSED_UNITS, apart)
        found = np.zeros(len(baseline), np.bool_)
        triangles = layout.triangle_of[known]
        order = np.argsort(triangles, kind="stable")
        ends = np.flatnonzero(np.diff(triangles[order])) + 1
        for mine in np.split(np.flatnonzero(known)[order], ends) if len(order) else ():
            found[mine] = baseline[mine] - median(baseline[mine].tolist()) > limit[mine]
        for part in layout.parts:
            span = slice(part.start, part.stop)
            if known[span].any():
                usual = median(baseline[span][known[span]].tolist())
                found[span] &= baseline[span] - usual > limit[span]
        return found


def _upward_variance(counts: NDArray[np.int64], variance: Floats, touch: TouchSettings) -> Floats:
    """Return the variance [n] of the normal noise that gives as much evidence of a touch as this.

    Noise with occasional jumps towards pressure gives more evidence than its variance suggests, and
    noise with jumps the other way gives less. The exponent x of the decay of evidence solves
    E exp(x (reading - mean - margin)) = 1 (Cramer and Lundberg); for a normal variable it is
    2 margin / variance. The histogram is smoothed, because a short one has no tails.

    Args:
        counts: int64[n, 256], how often each byte was measured.
        variance: float64[n], of the bytes.
        touch: the touch decision.
    """
    samples = np.maximum(counts.sum(axis=1), 1)
    # A short calibration may underestimate it.
    surely = variance * _underestimated(samples)
    codes = np.flatnonzero(counts.any(axis=0))
    share = counts[:, codes] / samples[:, None]
    reading = (share @ codes)[:, None] - codes
    margin = max(touch.margin_units - touch.hysteresis_units / 2, 1.0)
    low, high = np.zeros(len(counts)), np.full(len(counts), LARGEST_EXPONENT)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        growth = np.exp(np.minimum(middle[:, None] * (reading - margin), 99.0))
        moment = np.sum(share * growth, axis=1)
        moment *= np.exp(np.minimum(middle**2 * SMOOTHED_SHARE * variance / 2, 99.0))
        thins = moment < 1.0
        low, high = np.where(thins, middle, low), np.where(thins, high, middle)
    found = 2 * margin / np.maximum(low, margin / 1e4)
    third = np.sum(share * reading**3, axis=1)
    skewness = third / np.maximum(variance, ROUNDING_VARIANCE) ** 1.5
    # The skewness of normal noise is estimated within sqrt(6 / samples).
    away = skewness < -AWAY_ERRORS * np.sqrt(6.0 / samples)
    upward: Floats = np.where(away, np.minimum(found, surely), np.maximum(found, surely))
    return upward


def _underestimated(samples: NDArray[np.int64]) -> Floats:
    """Return how many times larger [n] a variance is at most, in 95 of 100 cases, than the mean
    square of so many normal samples: three times for ten samples, 1.3 times for a hundred.

    By the chi-squared distribution (Wilson and Hilferty, 1931); a standard error does not show how
    skewed that is for few samples.
    """
    freedom = np.maximum(samples - 1, 1)
    part = 2.0 / (9.0 * freedom)
    root = np.maximum(1.0 - part - SURE_QUANTILE * np.sqrt(part), 0.1)
    found: Floats = samples / freedom / root**3
    return found


def _going_on(found: Calibration, known: Known, few: Mask) -> Calibration:
    """Return a calibration in which the taxels `few` [n] have what is known of them, if it is."""
    before = known.calibration
    unchanged = few & known.zeroed & before.usable
    above = before.percentile - before.baseline
    return replace(
        found,
        baseline=np.where(unchanged, known.baseline, found.baseline),
        percentile=np.where(unchanged, known.baseline + above, found.percentile),
        noise=np.where(unchanged, before.noise, found.noise),
        spread=np.where(unchanged, before.spread, found.spread),
        verdict=np.where(unchanged, before.verdict, found.verdict),
        unchanged=unchanged,
    )


class _Off(NamedTuple):
    """Bytes that were off for one sweep, arrays [m].

    Attributes:
        taxel: whose.
        raw: the byte.
        between: mean of the one before and the one after.
        off: how far it was from the nearer of them.
        number: which byte of the taxel.
    """

    taxel: NDArray[np.intp]
    raw: NDArray[np.int16]
    between: Floats
    off: NDArray[np.int16]
    number: NDArray[np.int64]

    def of(self, mask: Mask) -> "_Off":
        """Return some of them, bool[m]."""
        return _Off._make(array[mask] for array in self)

    @classmethod
    def joined(cls, those: list["_Off"]) -> "_Off":
        return cls(*map(np.concatenate, zip(*those, strict=True)))


def _mean_and_variance(counts: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return those of bytes, [m] each, of which int64[m, 256] is how often each came."""
    number = np.maximum(counts.sum(axis=1), 1)
    codes = np.arange(256.0)
    mean: Floats = counts @ codes / number
    return mean, np.maximum(counts @ codes**2 / number - mean**2, 0.0)


def _middle(one: NDArray[np.int16], other: NDArray[np.int16]) -> Floats:
    found: Floats = (one.astype(np.float64) + other) / 2.0
    return found


class _Course:
    """The course of n taxels over a calibration of any length, as means of blocks of samples."""

    def __init__(self, n: int) -> None:
        self._sum = np.zeros(n)
        self._count = np.zeros(n, np.int64)
        #: Samples per block, so far.
        self.length = np.full(n, BLOCK)
        #: How many blocks are full, and their means; entries beyond are undefined.
        self.number = np.zeros(n, np.int64)
        self.means = np.zeros((n, MOST_BLOCKS))

    def add(self, taxels: NDArray[np.intp], raw: NDArray[np.uint8]) -> None:
        """Add one byte for each of some taxels."""
        self._sum[taxels] += raw
        self._count[taxels] += 1
        full = taxels[self._count[taxels] == self.length[taxels]]
        if not len(full):
            return
        self.means[full, self.number[full]] = self._sum[full] / self.length[full]
        self.number[full] += 1
        self._sum[full] = 0.0
        self._count[full] = 0
        joined = full[self.number[full] == MOST_BLOCKS]
        if len(joined):
            pairs = self.means[joined].reshape(len(joined), -1, 2).mean(axis=2)
            self.means[joined, : MOST_BLOCKS // 2] = pairs
            self.number[joined] = MOST_BLOCKS // 2
            self.length[joined] *= 2

    def forget(self, taxels: NDArray[np.intp]) -> None:
        """Begin again with some taxels."""
        self._sum[taxels] = 0.0
        self._count[taxels] = 0
        self.length[taxels] = BLOCK
        self.number[taxels] = 0

    def replace(
        self, taxels: NDArray[np.intp], numbers: NDArray[np.int64], changes: Floats
    ) -> None:
        """Change bytes that were added, each of a taxel by its number since the begin."""
        block = numbers // self.length[taxels]
        full = block < self.number[taxels]
        taxels, block = taxels[full], block[full]
        np.add.at(self.means, (taxels, block), changes[full] / self.length[taxels])

    @property
    def _begun(self) -> Floats:
        """The means [n, b] up to the last that any taxel has; b is a multiple of `JOINED`."""
        most = max(int(self.number.max(initial=0)), 1)
        return self.means[:, : -(-most // JOINED) * JOINED]

    @property
    def _full(self) -> Mask:
        """Which of these [n, b] are full."""
        full: Mask = np.arange(self._begun.shape[1]) < self.number[:, None]
        return full

    @property
    def highest(self) -> Floats:
        """Largest mean [n]; 0 where there is none."""
        found: Floats = self._begun.max(axis=1, where=self._full, initial=0.0)
        return found

    @property
    def lowest(self) -> Floats:
        """Smallest mean [n]; 0 where there is none."""
        found: Floats = self._begun.min(axis=1, where=self._full, initial=255.0)
        return np.where(self.number > 0, found, 0.0)

    @property
    def joined_variance(self) -> Floats:
        """Return the variance [n] of joined blocks; 0 where there are fewer than two."""
        means = self._begun.reshape(len(self.means), -1, JOINED).mean(axis=2)
        number = self.number // JOINED
        full = np.arange(means.shape[1]) < number[:, None]
        mean = means.sum(axis=1, where=full) / np.maximum(number, 1)
        squares = np.square(means - mean[:, None]).sum(axis=1, where=full)
        found: Floats = squares / np.maximum(number - 1, 1)
        return found

    @property
    def error(self) -> Floats:
        """Return the standard error of a mean [n], from the median step between neighbours: a press
        makes few large steps.
        """
        steps = np.abs(np.diff(self._begun, axis=1))
        steps[~self._full[:, 1:]] = np.inf
        steps.sort(axis=1)
        count = np.maximum(self.number - 1, 0)
        median = steps[np.arange(len(steps)), count // 2]
        return np.where(count > 0, median / (0.6745 * np.sqrt(2.0)), 0.0)

    @property
    def switches(self) -> NDArray[np.int64]:
        """Return how often the means [n] change between the lowest and the highest third of their
        range.
        """
        low, high = self.lowest, self.highest
        third = (high - low) / 3.0
        state = np.zeros(len(low), np.int64)
        found = np.zeros(len(low), np.int64)
        for mean, full in zip(self._begun.T, self._full.T, strict=True):
            now = np.where(mean > high - third, 1, np.where(mean < low + third, -1, state))
            found += full & (state != 0) & (now != state)
            state = np.where(full, now, state)
        return found


def with_gains(calibration: Calibration, gain: Floats, bend: Floats) -> Calibration:
    """Return the calibration with gains and bends [n] fitted to known pressures."""
    return _identified(replace(calibration, gain=gain, bend=bend))


def with_curves(calibration: Calibration, curves: Curves | None) -> Calibration:
    """Return the calibration with these curves, or without any.

    A pad that was noisy under pressure and now always sends the same byte is stuck.
    """
    verdict = calibration.verdict
    if curves is not None:
        frozen = curves.own & (curves.noise_units > LIVELY_UNITS) & (calibration.noise == 0.0)
        stuck = np.uint8(Verdict.STUCK)
        verdict = np.where(frozen & (verdict < stuck), stuck, verdict).astype(np.uint8)
    return _identified(replace(calibration, curves=curves, verdict=verdict))


def with_zeros(calibration: Calibration, zeros: dict[str, Zero]) -> Calibration:
    """Return the calibration with the zeros of force/torque boards, by name of the fingertip."""
    return _identified(replace(calibration, zeros=zeros))


def with_gains_of(calibration: Calibration, path: Path, layout: Layout) -> Calibration:
    """Return the calibration with gains and curves of the one in `path`, if one fits.

    Zero and noise are measured at every start; gains and curves belong to pad and foam, and remain
    valid.

    Raises:
        NewerFileError, BusyFileError: see `find`.
    """
    before = find(path, layout, calibration.configuration)
    return calibration if before is None else with_pressures_of(calibration, before)


def with_pressures_of(calibration: Calibration, before: Calibration) -> Calibration:
    """Return the calibration with gains and curves of another one of this skin."""
    return with_curves(with_gains(calibration, before.gain, before.bend), before.curves)


def merge(
    old: Calibration, new: Calibration, renewed: NDArray[np.bool_], *, zeros: bool = True
) -> Calibration:
    """Return `old` with the taxels `renewed` [n] taken from `new`; their gains and curves stay.

    With `zeros`, zeros of fingertips are taken from `new`, as far as it has them.
    """
    merged = _identified(
        replace(
            new,
            baseline=np.where(renewed, new.baseline, old.baseline),
            percentile=np.where(renewed, new.percentile, old.percentile),
            noise=np.where(renewed, new.noise, old.noise),
            spread=np.where(renewed, new.spread, old.spread),
            gain=old.gain,
            bend=old.bend,
            verdict=np.where(renewed, new.verdict, old.verdict),
            unchanged=None if new.unchanged is None else new.unchanged & renewed,
            damaged=None if new.damaged is None else new.damaged & renewed,
            zeros=old.zeros | new.zeros if zeros else old.zeros,
        )
    )
    return merged if old.curves is None else with_curves(merged, old.curves)


def _identified(calibration: Calibration) -> Calibration:
    digest = hashlib.sha256(calibration.configuration.encode())
    for array in (
        calibration.baseline,
        calibration.percentile,
        calibration.noise,
        calibration.spread,
        calibration.gain,
        calibration.bend,
        calibration.verdict,
    ):
        digest.update(np.ascontiguousarray(array).tobytes())
    for name, zero in sorted(calibration.zeros.items()):
        digest.update(name.encode() + zero.offset.tobytes() + zero.noise.tobytes())
        digest.update(b"touched" * zero.touched)
    if (curves := calibration.curves) is not None:
        for array in curves.arrays().values():
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(np.array([curves.memory.radius_kpa, curves.memory.weight]).tobytes())
    return replace(calibration, id=digest.hexdigest()[:12])


def summary(calibration: Calibration, layout: Layout) -> dict[str, dict[str, int]]:
    """Return how many pressure taxels of each part got each verdict (those above 0)."""
    pressure = layout.pad_kind == PadKind.PRESSURE
    result: dict[str, dict[str, int]] = {}
    for part in layout.parts:
        mine = slice(part.start, part.stop)
        verdicts = calibration.verdict[mine][pressure[mine]]
        counted = {verdict.name.lower(): int((verdicts == verdict).sum()) for verdict in Verdict}
        result[part.name] = {name: count for name, count in counted.items() if count}
    return result


def unchanged(calibration: Calibration, layout: Layout) -> dict[str, list[int]]:
    """Return by part the numbers of the pressure taxels that go on as before: see `Calibration`."""
    return _by_part(calibration.unchanged, layout)


def damaged(calibration: Calibration, layout: Layout) -> dict[str, list[int]]:
    """Return by part the numbers of the pressure taxels of which bytes were left out."""
    return _by_part(calibration.damaged, layout)


def _by_part(taxels: Mask | None, layout: Layout) -> dict[str, list[int]]:
    if taxels is None:
        return {}
    these = taxels & (layout.pad_kind == PadKind.PRESSURE)
    found = {p.name: np.flatnonzero(these[p.start : p.stop]).tolist() for p in layout.parts}
    return {name: numbers for name, numbers in found.items() if numbers}


#: Of a byte.
SCALE_UNITS = 255.0
#: Of the numbers of a file. Beyond them a pad would feel nothing, or anything, and be valid.
_BOUNDS = {
    "baseline": (-SCALE_UNITS, SCALE_UNITS),
    "percentile": (-SCALE_UNITS, SCALE_UNITS),
    "noise": (0.0, SCALE_UNITS),
    # Of pads that are not used it may be any, where jumps last.
    "spread": (0.0, 1e6),
    "gain": (0.01, 100.0),
    "bend": (0.01, 100.0),
}
#: Loads (N, N m), pressures (kPa) and numbers derived from them.
MOST = 1e6
_Label = Annotated[str, msgspec.Meta(max_length=64, pattern=r"^[ -~]*(?!\n)$")]


class _PartFile(msgspec.Struct, forbid_unknown_fields=True):
    baseline: list[float]
    percentile: list[float]
    noise: list[float]
    gain: list[float]
    verdict: list[str]
    #: Files of older versions do not have it.
    bend: list[float] | None = None
    spread: list[float] | None = None


class _ZeroFile(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    offset: list[float]
    noise: list[float]
    touched: bool = False


class _PartCurves(msgspec.Struct, forbid_unknown_fields=True):
    """Curves of the taxels of one part; null where a taxel has no own curve."""

    kpa: list[list[float] | None]
    beyond_units: list[float | None]
    noise_units: list[float]
    error_kpa: list[float | None]
    verdict: list[str]


class _CurvesFile(msgspec.Struct, forbid_unknown_fields=True):
    #: Activations at which the curves are given.
    units: list[float]
    highest_kpa: float
    lag_s: float
    radius_kpa: list[float]
    weight: list[float]
    parts: dict[str, _PartCurves]


class _File(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    schema: str
    id: _Label
    time: _Label
    robot: str
    configuration: str
    parts: dict[str, _PartFile]
    fingertips: dict[str, _ZeroFile] = {}
    curves: _CurvesFile | None = None


def save(path: Path, calibration: Calibration, layout: Layout) -> None:
    """Write a calibration file, completely or not at all (JSON, schema skin.calibration/1).

    Raises:
        OSError: it cannot be written.
    """
    parts = {}
    for part in layout.parts:
        mine = slice(part.start, part.stop)
        parts[part.name] = _PartFile(
            baseline=_rounded(calibration.baseline[mine]),
            percentile=_rounded(calibration.percentile[mine]),
            noise=_rounded(calibration.noise[mine]),
            gain=_rounded(calibration.gain[mine]),
            bend=_rounded(calibration.bend[mine]),
            spread=_rounded(calibration.spread[mine]),
            verdict=[Verdict(number).name.lower() for number in calibration.verdict[mine]],
        )
    zeros = {
        # Not rounded, so that it serves for coarse and fine boards.
        name: _ZeroFile(zero.offset.tolist(), zero.noise.tolist(), zero.touched)
        for name, zero in calibration.zeros.items()
    }
    content = _File(
        SCHEMA,
        calibration.id,
        calibration.time,
        layout.robot,
        calibration.configuration,
        parts,
        zeros,
        None if calibration.curves is None else _curves_file(calibration.curves, layout),
    )
    write_document(path, content)


def _curves_file(curves: Curves, layout: Layout) -> _CurvesFile:
    parts = {}
    for part in layout.parts:
        mine = range(part.start, part.stop)
        own = curves.own
        parts[part.name] = _PartCurves(
            kpa=[_rounded(curves.kpa[taxel]) if own[taxel] else None for taxel in mine],
            beyond_units=[_finite(curves.beyond_units[taxel]) for taxel in mine],
            noise_units=_rounded(curves.noise_units[part.start : part.stop]),
            error_kpa=[_finite(curves.error_kpa[taxel]) for taxel in mine],
            verdict=[CurveVerdict(curves.verdict[taxel]).name.lower() for taxel in mine],
        )
    return _CurvesFile(
        KNOTS_UNITS.tolist(),
        curves.highest_kpa,
        curves.lag_s,
        list(curves.memory.radius_kpa),
        list(curves.memory.weight),
        parts,
    )


def _finite(value: float) -> float | None:
    return round(float(value), 6) if np.isfinite(value) else None


def _rounded(values: Floats) -> list[float]:
    rounded: list[float] = np.round(values, 6).tolist()
    return rounded


def load(path: Path, layout: Layout, configuration: str) -> Calibration:
    """Read a calibration file of this skin.

    Raises:
        CalibrationError: unreadable, damaged, of another schema, configuration or robot; one
            line that ends with the command that helps.
        NewerFileError: a newer version has written it.
        BusyFileError: another program is writing it.
    """

    def refused(what: str) -> CalibrationError:
        return CalibrationError(f"{path}: {what}; take a new one with: skin calibrate CONFIG")

    content = read_document(path, _File, SCHEMA, "calibration", refused)
    if (content.configuration, content.robot) != (configuration, layout.robot):
        raise OtherSkinError(
            f"{path}: belongs to configuration {content.configuration} "
            f'of robot "{content.robot}", this is {configuration} of robot "{layout.robot}"; '
            "take a new one with: skin calibrate CONFIG"
        )
    n = layout.n_taxels
    names = ("baseline", "percentile", "noise", "spread", "gain", "bend")
    arrays = {name: np.zeros(n) for name in names}
    verdict = np.full(n, Verdict.ABSENT, dtype=np.uint8)
    for part in layout.parts:
        stored = content.parts.get(part.name)
        if stored is None:
            raise refused(f'no part "{part.name}"')
        mine = slice(part.start, part.stop)
        for name, array in arrays.items():
            given = getattr(stored, name)
            if given is None:
                given = stored.noise if name == "spread" else np.ones(part.n_taxels)
            values, (least, most) = np.array(given), _BOUNDS[name]
            wrong = values.shape != (part.n_taxels,)
            if wrong or not np.all((values >= least) & (values <= most)):
                raise refused(
                    f"parts.{part.name}.{name}: wanted {part.n_taxels} finite numbers "
                    f"from {least:g} to {most:g}"
                )
            array[mine] = values
        if len(stored.verdict) != part.n_taxels:
            raise refused(f"parts.{part.name}.verdict: wanted {part.n_taxels} words")
        try:
            verdict[mine] = [Verdict[name.upper()] for name in stored.verdict]
        except KeyError as error:
            raise refused(f"parts.{part.name}.verdict: {error}") from None
        above = arrays["percentile"][mine] - arrays["baseline"][mine]
        decides = levels(above, arrays["spread"][mine], TouchSettings()).decides
        deaf = np.flatnonzero((decides > SCALE_UNITS) & (verdict[mine] < Verdict.STUCK))
        if len(deaf):
            raise refused(
                f"parts.{part.name}: taxel {deaf[0]} has so much noise that it would feel nothing, "
                "and is called usable"
            )
    zeros = {}
    for name, zero in content.fingertips.items():
        offset, noise = np.array(zero.offset), np.array(zero.noise)
        fits = offset.shape == noise.shape == (CHANNELS,)
        if not fits or not (np.abs([offset, noise]) <= MOST).all() or (noise < 0.0).any():
            raise refused(
                f"fingertips.{name}: wanted twice {CHANNELS} finite numbers up to {MOST:g}, "
                "and no noise below 0"
            )
        zeros[name] = Zero(offset, noise, zero.touched)
    curves = None
    if content.curves is not None:
        curves = _curves_of(content.curves, layout, refused)
    return Calibration(
        content.configuration,
        content.id,
        content.time,
        verdict=verdict,
        zeros=zeros,
        curves=curves,
        unchanged=None,
        damaged=None,
        **arrays,
    )


def find(path: Path, layout: Layout, configuration: str) -> Calibration | None:
    """Return the calibration of this skin that a file holds; None if it holds none.

    Raises:
        NewerFileError: a newer version has written it; it is not to be replaced.
        BusyFileError: another program is writing it.
    """
    try:
        return load(path, layout, configuration)
    except CalibrationError:
        return None


def _curves_of(
    content: _CurvesFile, layout: Layout, refused: Callable[[str], CalibrationError]
) -> Curves:
    """Return the curves of a file; errors are raised through `refused`."""
    memory = np.array([*content.radius_kpa, *content.weight])
    lengths_agree = len(content.radius_kpa) == len(content.weight)
    if not lengths_agree or not np.all((memory > 0.0) & (memory <= MOST)):
        raise refused("curves: wanted as many radii as weights, all positive")
    if content.units != KNOTS_UNITS.tolist() or not 0.0 < content.highest_kpa <= MOST:
        raise refused("curves.units: not the activations that this version knows")
    n = layout.n_taxels
    kpa = np.zeros((n, len(KNOTS_UNITS)))
    beyond, noise = np.full(n, np.inf), np.zeros(n)
    error = np.full(n, np.nan)
    verdict = np.full(n, CurveVerdict.UNKNOWN, np.uint8)
    for part in layout.parts:
        stored = content.parts.get(part.name)
        where = f"curves.parts.{part.name}"
        if stored is None:
            raise refused(f'curves: no part "{part.name}"')
        if any(len(values) != part.n_taxels for values in msgspec.structs.astuple(stored)):
            raise refused(f"{where}: wanted {part.n_taxels} entries of each kind")
        mine = slice(part.start, part.stop)
        try:
            verdict[mine] = [CurveVerdict[name.upper()] for name in stored.verdict]
        except KeyError as unknown:
            raise refused(f"{where}.verdict: {unknown}") from None
        for taxel, curve in enumerate(stored.kpa, part.start):
            if curve is not None:
                if len(curve) != len(KNOTS_UNITS) or not np.all(np.abs(curve) <= MOST):
                    raise refused(f"{where}.kpa: wanted {len(KNOTS_UNITS)} finite numbers a curve")
                kpa[taxel] = curve
            elif verdict[taxel] == CurveVerdict.GOOD:
                raise refused(f"{where}.kpa: a good taxel without a curve")
        beyond[mine] = [np.inf if units is None else units for units in stored.beyond_units]
        error[mine] = [np.nan if kpa is None else kpa for kpa in stored.error_kpa]
        noise[mine] = stored.noise_units
    wild = not np.all((noise >= 0.0) & (noise <= SCALE_UNITS))
    if wild or np.any(np.diff(kpa) < 0.0) or not np.all(beyond > 0.0):
        raise refused("curves: a curve falls, or a noise is negative")
    return Curves(
        rising(kpa),
        beyond,
        noise,
        error,
        verdict,
        content.highest_kpa,
        content.lag_s,
        Memory(tuple(content.radius_kpa), tuple(content.weight)),
    )
