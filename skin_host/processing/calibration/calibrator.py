"""Takes a calibration: the untouched reading of each taxel, its noise, and whether it is usable.

The paper (section V-A) takes some seconds of untouched skin and keeps, per taxel, the mean and the
95th percentile. The readings are bytes, so a histogram of 256 counts keeps their whole
distribution, at a constant size for any length.

An activation is `no_load - raw`: it rises with pressure. All numbers here are in units of the
transmitted byte.
"""

from dataclasses import replace
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import TouchSettings
from skin_host.layout import Layout, PadKind
from skin_host.processing.calibration import (
    SCALE_UNITS,
    Calibration,
    Floats,
    Verdict,
    fineness,
    identified,
)
from skin_host.processing.calibration.block_means import JOINED, BlockMeans
from skin_host.processing.calibration.warming import leave_out
from skin_host.processing.conversions import Conversions
from skin_host.processing.masks import Mask
from skin_host.processing.touch import levels

#: A taxel is noisy if a decision within a second needs more than this multiple of the touch margin,
#: ...
NOISY_MARGINS = 1.5
#: ... and unusable if it needs more than this multiple: 16 units are half the scale of real skin.
#: Both are of usual units. A pad that is sent in finer ones may need more of them: that is no more
#: pressure.
USELESS_MARGINS = 8.0
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
#: A longer interval between two samples of a calibration does not count for its time: nothing was
#: received, or the clock was set.
LONGEST_INTERVAL_NS = 1_000_000_000
#: A part was pressed as a whole if the mean of its pads moves by more than this, the least
#: threshold of a touch, five standard errors, and the fastest drift, and this share of them moves
#: like it.
COMMON_UNITS = 1.0
DRIFT_UNITS_PER_S = 0.1
COMMON_SHARE = 0.5
#: A pad moves like the others if its correlation with their sum is beyond so many standard errors.
ALIKE_ERRORS = 2.0
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
        self._fineness = fineness(layout)
        self._received = np.zeros(n, dtype=np.int64)
        self._counts = np.zeros((n, 256), dtype=np.int64)
        self._course = BlockMeans(n)
        #: The last two bytes of each taxel, the newest first, and those that were off alone.
        self._last, self._earlier = np.zeros(n, np.int16), np.zeros(n, np.int16)
        self._off: list[_Off] = []
        self._was_off = np.zeros(n, np.bool_)
        self._times_off = np.zeros(n, np.int64)
        self._conversions = [Conversions(part.n_taxels) for part in layout.parts]
        self._at_ns: list[int | None] = [None] * len(layout.parts)
        #: How long each part was added.
        self._passed_s = [0.0] * len(layout.parts)

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
            # A gap, or a clock that is set, is no time in which pads were seen to move slowly.
            self._passed_s[part_index] += min(dt_s, LONGEST_INTERVAL_NS * 1e-9)
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
        for index, part in enumerate(self._layout.parts):
            if not self._received[part.start : part.stop].any():
                self._passed_s[index] = 0.0

    def finish(
        self,
        configuration: str,
        time: str,
        known: Known | None = None,
        pressed: Mask | None = None,
    ) -> Calibration:
        """Return the calibration from the added sweeps.

        Args:
            configuration: hash of the configuration.
            time: when it was taken, ISO 8601 in UTC.
            known: of this skin from before. A taxel of which too little was received goes on with
                it, and noise is not lowered by few samples.
            pressed: bool[n], taxels that are touched by what is known from before, or were pressed
                when their board was zeroed, and whose release nothing has shown since: their
                readings alone cannot show that they are touched.
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
        as_measured = variance
        warmed, drift_variance = self._leave_out_warming()
        baseline = baseline - warmed
        variance = np.maximum(variance - drift_variance, 0.0)
        noise = np.sqrt(variance)
        warms = drift_variance > 0.0
        percentile = np.where(warms, baseline + 1.645 * noise, percentile)
        lasting = self._lasting(variance, received / some)

        course = self._course
        repeats = received / some
        steady = error = course.error
        before = None if known is None else known.calibration
        if before is not None:
            # Neighbouring blocks do not show noise that wanders for seconds, or seldom jumps.
            expected = before.noise * np.sqrt(repeats / course.length)
            error = np.where(before.usable, np.fmax(error, expected), error)
        shown = self._touched(variance, repeats, error)
        touched = shown | self._pressed_together(shown)
        steady_noise = steady * np.sqrt(course.length * samples / np.maximum(received, 1))
        # The lowest activation is the untouched one. The lowest mean alone would be too low by what
        # noise took it down: the fewer measurements a mean has, the more.
        baseline = np.where(touched, no_load - course.rest(error), baseline)
        percentile = np.where(touched, baseline + 1.645 * steady_noise, percentile)
        noise = np.where(touched, steady_noise, noise)
        upward = _upward_variance(counts, as_measured, self._touch)
        surely = _underestimated(some)
        of_drift = drift_variance * np.maximum(surely, 1.0 + SMOOTHED_SHARE)
        noisier = np.maximum(upward - of_drift, variance * surely)
        upward = np.where(touched, noise**2, np.where(warms, noisier, upward))
        spread = np.sqrt(upward * np.where(touched, 1.0, lasting))
        unknown = samples < NOISE_SAMPLES
        if before is not None:
            unknown &= ~before.usable
            # Presses that come and go leave more in it than a quiet pad has: it would seem stuck.
            noise = np.where(touched & before.usable, np.fmin(noise, before.noise), noise)
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
        out = ends > SATURATED_SHARE * samples
        far = self._pressed(baseline, counts, ~out)
        if known is not None:
            # What was untouched and reads no more now is so still, wherever the others rest.
            rested = known.zeroed & (known.calibration.verdict < Verdict.TOUCHED)
            far &= ~(rested & (baseline - known.baseline < margin))
        verdict[touched | far] = Verdict.TOUCHED
        if pressed is not None:
            verdict[pressed] = Verdict.TOUCHED
        verdict[touch.decides > USELESS_MARGINS * margin] = Verdict.TOO_NOISY
        verdict[out] = Verdict.OUT_OF_RANGE
        verdict[(counts[:, 0] == samples) | (counts[:, 255] == samples)] = Verdict.STUCK
        # Bytes that come to an end of the scale and go differ by more than noise.
        jumps = (verdict == Verdict.OUT_OF_RANGE) & (steady_noise > 0.0)
        noise = np.where(jumps, np.minimum(noise, steady_noise), noise)
        few = (received < FEWEST_SAMPLES) | self._froze(variance)
        uncertain = spread > ERROR_SHARE * touch.enter * np.sqrt(some)
        few |= (unknown | uncertain) & (verdict < Verdict.STUCK)
        # Neither is a share of few samples known.
        few |= unknown & (verdict == Verdict.OUT_OF_RANGE)
        verdict[few] = Verdict.TOO_FEW
        verdict[received == 0] = Verdict.ABSENT
        percentile = np.minimum(percentile, SCALE_UNITS)
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
        return identified(found) if known is None else going_on(found, known)

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

    def _leave_out_warming(self) -> tuple[Floats, Floats]:
        """Leave what the pads of a part drift by together out of their courses; return by how much
        the bytes at the end are above their mean, and the variance of the drift, [n] each.
        """
        layout, received = self._layout, self._received
        end, variance = np.zeros(len(received)), np.zeros(len(received))
        pressure = layout.pad_kind == PadKind.PRESSURE
        for part, passed_s in zip(layout.parts, self._passed_s, strict=True):
            mine = slice(part.start, part.stop)
            steadily = received[mine] >= max(RECEIVED_SHARE * received[mine].max(), 1.0)
            pads = np.flatnonzero(steadily & pressure[mine]) + part.start
            if not len(pads):
                continue
            fastest = DRIFT_UNITS_PER_S * float(np.median(self._fineness[pads]))
            found = leave_out(self._course, pads, passed_s, fastest)
            if found is not None:
                end[pads], variance[pads] = found
        return end, variance

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

    def _touched(self, variance: Floats, repeats: Floats, error: Floats) -> Mask:
        """Return the taxels [n] that were touched for a part of the time.

        Not those that jump between levels: such noise has no course, or one that goes up and down
        more often than a press does and that no other pad shares.

        Args:
            variance: float64[n], of a measurement.
            repeats: float64[n], samples a measurement.
            error: float64[n], standard error of a block's mean.
        """
        course = self._course
        moved = course.highest - course.lowest > STEADY_UNITS + STEADY_ERRORS * error
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

    def _pressed_together(self, shown: Mask) -> Mask:
        """Return the taxels [n] of parts that were pressed as a whole for a part of the time.

        The noise of each may hide a slow press, as of air in a chamber, that together they show.

        Args:
            shown: bool[n], taxels that show it by themselves. How they move is no evidence about
                the others, which may be beside what pressed these.
        """
        course, layout = self._course, self._layout
        found = np.zeros(len(self._received), np.bool_)
        pressure = np.flatnonzero(layout.pad_kind == PadKind.PRESSURE)
        for part, passed_s in zip(layout.parts, self._passed_s, strict=True):
            pads = pressure[(pressure >= part.start) & (pressure < part.stop)]
            pads = pads[~shown[pads]]
            number = int(course.number[pads].max(initial=0)) // JOINED * JOINED
            pads = pads[course.number[pads] >= number]
            if number < FEWEST_BLOCKS * JOINED:
                continue
            each = course.means[pads, :number]
            each = each - each.mean(axis=1, keepdims=True)
            lively = each.any(axis=1)
            pads, each = pads[lively], each[lively]
            if not len(pads):
                continue
            shared = each.mean(axis=0)
            # Second differences, because a steady rise is no noise.
            step = float(np.median(np.abs(np.diff(shared, 2)))) / (0.6745 * np.sqrt(6.0))
            error = step / np.sqrt(JOINED)
            limit = max(COMMON_UNITS, STEADY_ERRORS * error, DRIFT_UNITS_PER_S * passed_s)
            if np.ptp(shared.reshape(-1, JOINED).mean(axis=1)) <= limit:
                continue
            # Each weighs the same, and none is compared with itself.
            each /= np.linalg.norm(each, axis=1, keepdims=True)
            others = each.sum(axis=0) - each
            likeness = np.sum(each * others, axis=1)
            alike = likeness > ALIKE_ERRORS / np.sqrt(number) * np.linalg.norm(others, axis=1)
            found[pads] = alike & (alike.mean() >= COMMON_SHARE)
        return found

    def _pressed(self, baseline: Floats, counts: NDArray[np.int64], within: Mask) -> Mask:
        """Return the taxels [n] that were pressed all the time: they rest far from all other
        pads that are within the scale.

        A board's zero is one reading of each pad, noise included. A noisy pad may thus rest as far
        from the others as its own readings lie apart; only what is farther away was pressed.

        Args:
            baseline: float64[n], mean activations.
            counts: int64[n, 256], how often each byte was measured.
            within: bool[n], which do not rest at an end of the scale.
        """
        layout = self._layout
        seen = counts > 0
        known = seen.any(axis=1) & within & (layout.pad_kind == PadKind.PRESSURE)
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


def going_on(found: Calibration, known: Known) -> Calibration:
    """Return a calibration in which taxels of which too little was received have what is known of
    them, if their zero is not in doubt and they were usable.
    """
    before = known.calibration
    unchanged = (found.verdict >= Verdict.ABSENT) & known.zeroed & before.usable
    baseline = np.clip(known.baseline, -SCALE_UNITS, SCALE_UNITS)
    percentile = np.minimum(baseline + (before.percentile - before.baseline), SCALE_UNITS)
    return identified(
        replace(
            found,
            baseline=np.where(unchanged, baseline, found.baseline),
            percentile=np.where(unchanged, percentile, found.percentile),
            noise=np.where(unchanged, before.noise, found.noise),
            spread=np.where(unchanged, before.spread, found.spread),
            verdict=np.where(unchanged, before.verdict, found.verdict),
            unchanged=unchanged,
        )
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
