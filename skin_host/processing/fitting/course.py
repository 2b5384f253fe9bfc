"""Fits curves of the pads to a known pressure that is equal on all of them.

To any course of it `fit_course` fits each pad's own curve, and the foam's memory: the pressure on a
pad is P = f(x) - relaxation, f is the pad's own curve over its activation x, and the relaxation of
all pads follows f(x) by one shared set of plays. The plays are fitted to the pads' median, the
curves pad by pad.

To a few levels, such as a bag of compressed air on the skin gives (seed 002), `fit_gains` fits a
gain on the common curve; with several and large enough pressures also each pad's own bend, because
pads on denser foam differ little at low pressure and much at high pressure.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skin_host.errors import RequestError
from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.curves import (
    KNOTS_UNITS,
    Curve,
    Curves,
    CurveVerdict,
    Memory,
    TableCurve,
    rising,
)
from skin_host.processing.fitting.memory import (
    UNCERTAINTY_KPA,
    fit_memory,
    hinges,
    loading_kpa,
)
from skin_host.processing.relaxation import PlayRelaxation
from skin_host.processing.smoothing import LIMIT_DEVIATIONS, StepFilter

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Bytes = NDArray[np.uint8]

#: Means over this time are enough to find which pads follow the pressure.
BLOCK_S = 0.25
#: Noise is measured in pieces of this length without their linear trend; this share of them is
#: below the noise.
NOISE_BLOCK_S = 2.0
NOISE_QUANTILE = 0.9
#: Less than this is no response, and with less correlation a pad does not follow.
LEAST_UNITS = 3.0
#: Quantiles of a pad's activations that represent rest and press.
PRESSED_QUANTILES = (0.02, 0.98)
LEAST_CORRELATION = 0.8
#: Pads of one foam differ by less than this factor (as `GAIN_RANGE`): where the median pad that
#: follows moves this much more than the least, one that does not is dead.
WEAKEST = 5.0
#: If the pads' median correlates less than this with the table, the table does not belong to the
#: recording.
SAME_CORRELATION = 0.9
#: The table's clock may be ahead or behind by this much.
LONGEST_LAG_S = 60.0
LAG_STEP_S = 0.05
#: And run faster or slower by this share; others are tried. Recorded ones are off by 0.7 %, which
#: changes curves little: what it does to loading and unloading cancels.
MOST_RATE = 0.02
RATES = np.linspace(-0.1, 0.1, 21)
RATE_STEPS = np.linspace(-0.01, 0.01, 9)
RATE_LAGS_S = np.linspace(-2.0, 2.0, 17)
#: A share counts if it leaves at most so much of the mean square error of none, and that is above
#: this RMS: of a course that hardly turns, any of them fits well.
RATED_SHARE = 0.6
RATED_KPA = 3.0
#: A course must span this pressure; otherwise it is in another unit or nothing is pressed.
LEAST_KPA = 10.0
#: Possible time shift of the pressure against the pads while it moves.
DOUBT_S = 0.7
#: A pad jumps if it changes by this much, and this multiple of what noise leaves in the means of
#: blocks, within half a second beyond twice what the pressure explains. An hour has 14400 blocks.
JUMP_UNITS = 8.0
JUMP_DEVIATIONS = 5.5
#: A pad that spends more than this share of its time at 0 saturates; or at 255, where none is
#: pressed.
PRESSED_RAIL_SHARE = 0.005
RESTING_RAIL_SHARE = 0.05
#: A pad is noisy if its error is above this pressure, and above that of so many of its units: that
#: is where a touch ends, so it could not be parted from rest. How high the course goes is no
#: matter.
NOISY_UNITS = 1.5
NOISY_KPA = 4.0
#: Samples at this distance are independent enough to be fitted.
FIT_STEP_S = 0.1
#: Weight of a curve's bends, relative to its mean slope.
STIFFNESS = 1280.0
#: Above this quantile the activations are too few to fit a knot to them.
UPPERMOST = 0.995
#: Uncertainty of one reading: a unit of quantisation and the remaining relaxation.
READING_UNCERTAINTY_KPA = 1.0
#: A bend is used when its standard error is below this, and if it is plausible.
BEND_ERROR = 0.25
BEND_RANGE = (0.2, 3.0)
#: Below this highest level the parabola of equation (1) is a straight line.
BEND_FROM_KPA = 40.0
GAIN_RANGE = (0.2, 5.0)


@dataclass(frozen=True)
class Course:
    """Pads under a known pressure, at equal distances in time.

    Attributes:
        dt_s: distance of the samples.
        raw: uint8[t, n].
        zero: float64[n], the untouched reading.
        there: bool[n], pads that were received.
        pressure_kpa: float64[t].
        lag_s: by how much the table's clock was found to be ahead.
    """

    dt_s: float
    raw: Bytes
    zero: Floats
    there: Mask
    pressure_kpa: Floats
    lag_s: float = 0.0


def fit_course(course: Course, smoothing_s: float, memory: Memory | None = None) -> Curves:
    """Find the curve of each pad, the foam's memory, and a verdict on each pad.

    Args:
        course: a recording and its pressure.
        smoothing_s: of the filter that will be applied to the pads.
        memory: of the foam, where it is known already; None: it is fitted.

    Raises:
        RequestError: no pad follows the pressure.
    """
    n = course.raw.shape[1]
    units, saturates = activations(course)
    noise = _noise(units, course.dt_s)
    pressure = course.pressure_kpa
    verdict = _first_verdict(course, units, noise, saturates)
    good = np.flatnonzero(verdict == CurveVerdict.GOOD)
    if not len(good):
        raise RequestError("no pad follows the pressure without jumps; wanted all pads pressed")
    highest_kpa = float(np.max(pressure))
    smooth = _smoothed(units[:, good], noise[good], smoothing_s, course.dt_s)
    thin = slice(None, None, max(round(FIT_STEP_S / course.dt_s), 1))
    weight = _weight(pressure, course.dt_s)[thin]
    # What is smoothed lags behind by up to the filter's limit, as the foam does by its memory.
    median = np.median(units[:, good], axis=1)
    if memory is None:
        memory = fit_memory(median[thin], pressure[thin], weight)
    loading = loading_kpa(pressure, memory)[thin]
    kpa = np.zeros((n, len(KNOTS_UNITS)))
    beyond = np.full(n, np.inf)
    for column, pad in enumerate(good):
        x = smooth[thin, column]
        beyond[pad] = float(np.quantile(x, UPPERMOST))
        kpa[pad] = _fit_curve(x, loading, weight, beyond[pad])
    error = np.full(n, np.nan)
    found = Curves(rising(kpa), beyond, noise, error, verdict, highest_kpa, course.lag_s, memory)
    read = read_course(found, good, units[:, good], smoothing_s, course.dt_s)
    error[good] = np.sqrt(np.mean((read - pressure[:, np.newaxis]) ** 2, axis=0))
    unit_kpa = mean_slope(TableCurve(found.kpa, beyond))
    verdict[error > np.maximum(NOISY_UNITS * unit_kpa, NOISY_KPA)] = CurveVerdict.NOISY
    return replace(found, verdict=verdict)


def shown(course: Course) -> Mask:
    """Return the pads [n] of which a course shows a curve, or that they have none.

    Of the others nothing is known afterwards either: see `fit_course`.
    """
    units, saturates = activations(course)
    verdict = _first_verdict(course, units, _noise(units, course.dt_s), saturates)
    found: Mask = verdict != CurveVerdict.UNKNOWN
    return found


def _first_verdict(
    course: Course, units: Floats, noise: Floats, saturates: Mask
) -> NDArray[np.uint8]:
    """Return verdicts [n] before a curve is fitted.

    A pad that does not follow is dead only if the weakest would have followed, and otherwise noisy
    if its noise hides the least response.
    """
    follows = course.there & following(units, course.pressure_kpa, course.dt_s)
    moved = _span(units[:, follows], course.dt_s)
    strong = moved.size > 0 and float(np.median(moved)) >= WEAKEST * LEAST_UNITS
    verdict = np.full(len(follows), CurveVerdict.UNKNOWN, np.uint8)
    verdict[course.there & (noise > LEAST_UNITS)] = CurveVerdict.NOISY
    if strong:
        verdict[course.there] = CurveVerdict.DEAD
    verdict[follows] = CurveVerdict.GOOD
    jumps = _jumps(units, course.pressure_kpa, noise, course.dt_s)
    verdict[course.there & jumps] = CurveVerdict.JUMPS
    verdict[course.there & saturates] = CurveVerdict.SATURATES
    return verdict


def activations(course: Course) -> tuple[Floats, Mask]:
    """Return activations [t, n] in units, and which pads [n] are often at an end of the byte's
    range.

    Such a byte is not a reading; it is replaced by the last one before it.
    """
    pressed, resting = course.raw == 0, course.raw == 255
    at_rail = pressed | resting
    rows = np.where(at_rail, 0, np.arange(len(course.raw))[:, np.newaxis])
    held = np.take_along_axis(course.raw, np.maximum.accumulate(rows, axis=0), axis=0)
    saturates = (pressed.mean(axis=0) > PRESSED_RAIL_SHARE) | (
        resting.mean(axis=0) > RESTING_RAIL_SHARE
    )
    return course.zero - held, saturates


def read_course(
    curves: Curves, pads: NDArray[np.intp], units: Floats, smoothing_s: float, dt_s: float
) -> Floats:
    """Pressures [t, k] that some pads would have reported for activations [t, k]."""
    curve = TableCurve(curves.kpa[pads], curves.beyond_units[pads])
    smoother = StepFilter(limit_kpa(curve, curves.noise_units[pads]), smoothing_s)
    relaxation = make_memory(len(pads), curves.memory)
    result = np.empty(units.shape)
    for row, momentary in enumerate(curve.kpa(units)):
        smooth = smoother.step(momentary, dt_s)
        result[row] = smooth
        if relaxation is not None:
            result[row] -= relaxation.step(smooth, dt_s)
    return np.maximum(result, 0.0, out=result)


def limit_kpa(curve: Curve, noise_units: Floats) -> Floats:
    """Return the effect of noise [n] in the middle of the measured range, for `StepFilter`."""
    limit: Floats = LIMIT_DEVIATIONS * noise_units * mean_slope(curve)
    return limit


def mean_slope(curve: Curve) -> Floats:
    """Return the pressure of one unit [n], kPa, in the mean over the measured range."""
    end = np.where(np.isfinite(curve.beyond_units), curve.beyond_units, 1.0)
    end = np.maximum(end, 1.0)
    slope: Floats = curve.kpa(end) / end
    return slope


def make_memory(n: int, memory: Memory, dtype: type = np.float64) -> PlayRelaxation | None:
    """Return the relaxation of n pads of a foam; None if it has none."""
    if not memory.radius_kpa:
        return None
    return PlayRelaxation(n, radius_kpa=memory.radius_kpa, weight=memory.weight, dtype=dtype)


def find_lag(median_units: Floats, time_s: Floats, table: tuple[Floats, Floats]) -> float:
    """Return by how many seconds a table's clock is ahead of a recording's, from the whole of both.

    Args:
        median_units: activation [t] of the pads that move.
        time_s: float64[t], of the samples, on the table's clock as far as it is known.
        table: times in s and pressures in kPa.

    Raises:
        RequestError: the pads do not follow the pressure, whatever the lag, or the table's clock
            runs at another rate.
    """
    coarse = np.arange(time_s[0], time_s[-1], 1.0)
    units = np.interp(coarse, time_s, median_units)
    lags = np.arange(-LONGEST_LAG_S, LONGEST_LAG_S + 0.5)
    likeness = np.array([_correlation(units, np.interp(coarse + lag, *table)) for lag in lags])
    # A table that is at rest for long before and after correlates well even a second off.
    near = float(lags[int(np.argmax(likeness))])
    if likeness.max() < SAME_CORRELATION:
        raise RequestError(
            f"the pads do not follow these pressures: correlation {likeness.max():.2f} at the best "
            f"lag of {near:+.0f} s, wanted {SAME_CORRELATION} or more; is it the table of this "
            "recording?"
        )
    fine = np.arange(time_s[0], time_s[-1], FIT_STEP_S)
    misfit = _misfit(fine, np.interp(fine, time_s, median_units), table)
    tried = near + np.arange(-2.0, 2.0 + 0.5 * LAG_STEP_S, LAG_STEP_S)
    lag_s = float(min(tried, key=misfit))
    error = misfit(lag_s)
    if error > RATED_KPA**2:
        roughly = _misfit(coarse, units, table)
        some = itertools.product(lags, RATES)
        some_lag, some_rate = min(some, key=lambda clock: roughly(*clock))
        around = itertools.product(some_lag + RATE_LAGS_S, some_rate + RATE_STEPS)
        least, rate = min((misfit(*clock), float(clock[1])) for clock in around)
        if abs(rate) > MOST_RATE and least < RATED_SHARE * error:
            raise RequestError(
                f"the table's clock runs {abs(rate):.1%} {'fast' if rate > 0.0 else 'slow'}, and "
                "that of the recording does not; wanted the same: are its times counted in samples "
                "of another rate?"
            )
    return round(lag_s, 3)


def _misfit(time_s: Floats, units: Floats, table: tuple[Floats, Floats]) -> Callable[..., float]:
    """Return the mean square error (kPa^2) of the best rising curve with memory, as a function of
    the table's clock: by how many seconds it is ahead in the middle, and by which share faster.

    Args:
        time_s: float64[t].
        units: activation [t].
        table: times in s and pressures in kPa.
    """
    basis = np.hstack([hinges(units), _lagging(units)])
    # One pseudo-inverse for all clocks: only the right-hand side differs.
    project = np.linalg.pinv(basis)
    since_middle_s = time_s - time_s.mean()

    def error(lag_s: float, rate: float = 0.0) -> float:
        wanted = np.interp(time_s + rate * since_middle_s + lag_s, *table)
        return float(np.mean((basis @ (project @ wanted) - wanted) ** 2))

    return error


def median_of_moving(units: Floats, dt_s: float) -> Floats:
    """Activation [t] of the pads that move, each sample the median over them.

    Raises:
        RequestError: none does.
    """
    moving = moves(units, dt_s, (0.05, 0.95))
    if not moving.any():
        raise RequestError(
            "nothing is pressed in the recording: no pad's reading changes by "
            f"{LEAST_UNITS:g} units or more"
        )
    median: Floats = np.median(units[:, moving], axis=1)
    return median


def moves(units: Floats, dt_s: float, between: tuple[float, float]) -> Mask:
    """Return which pads [n] have activations [t, n] that differ between these two quantiles."""
    moving: Mask = _span(units, dt_s, between) > LEAST_UNITS
    return moving


def _span(units: Floats, dt_s: float, between: tuple[float, float] = PRESSED_QUANTILES) -> Floats:
    """Return how far these quantiles of activations [t, n] are apart [n]."""
    blocks = _block_means(units, max(round(BLOCK_S / dt_s), 1))
    low, high = np.quantile(blocks, between, axis=0)
    span: Floats = high - low
    return span


def _lagging(units: Floats) -> Floats:
    """Return the lag of plays of some radii [t, k]: hysteresis that could be mistaken for a time
    lag.
    """
    radii = np.array([0.03, 0.1]) * max(float(np.max(units)), 1.0)
    plays = np.zeros(2)
    result = np.empty((len(units), 2))
    for row, reading in enumerate(units):
        plays = np.minimum(np.maximum(plays, reading - radii), reading + radii)
        result[row] = reading - plays
    return result


def _noise(units: Floats, dt_s: float) -> Floats:
    length = max(round(NOISE_BLOCK_S / dt_s), 4)
    count = len(units) // length
    blocks = units[: count * length].reshape(count, length, -1)
    line = np.arange(length) - (length - 1) / 2
    slope = np.einsum("j,ijk->ik", line, blocks) / np.sum(line**2)
    # The variance about a straight line: that of the block minus what the line explains.
    variance = np.var(blocks, axis=1) - slope**2 * np.mean(line**2)
    noise: Floats = np.sqrt(np.maximum(np.quantile(variance, NOISE_QUANTILE, axis=0), 0.0))
    return noise


def following(units: Floats, pressure: Floats, dt_s: float) -> Mask:
    """Return which pads [n] have activations [t, n] that follow a pressure [t]."""
    length = max(round(BLOCK_S / dt_s), 1)
    blocks, mean = _block_means(units, length), _block_means(pressure[:, np.newaxis], length)
    centred, course = blocks - blocks.mean(axis=0), mean - mean.mean()
    power = np.sqrt(np.sum(centred**2, axis=0) * np.sum(course**2))
    correlation = np.sum(centred * course, axis=0) / np.where(power > 0.0, power, 1.0)
    follows: Mask = moves(units, dt_s, PRESSED_QUANTILES) & (correlation > LEAST_CORRELATION)
    return follows


def _jumps(units: Floats, pressure: Floats, noise: Floats, dt_s: float) -> Mask:
    length = max(round(BLOCK_S / dt_s), 1)
    blocks, mean = _block_means(units, length), _block_means(pressure[:, np.newaxis], length)[:, 0]
    change = np.abs(blocks[2:] - blocks[:-2])
    # The pressure may be shifted by up to a second.
    around = np.pad(mean, 4, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(around, 11)[: len(change)]
    moved = windows.max(axis=1) - windows.min(axis=1)
    per_kpa = (np.quantile(blocks, 0.98, axis=0) - np.quantile(blocks, 0.02, axis=0)) / np.ptp(mean)
    beyond = change - 2.0 * moved[:, np.newaxis] * per_kpa
    # Boards that send faster than their chips convert repeat their readings.
    conversions = min(length, max(length * dt_s / CONVERSION_S, 1.0))
    by_noise = noise * np.sqrt(2.0 / conversions)
    jumps: Mask = np.any(beyond > np.maximum(JUMP_UNITS, JUMP_DEVIATIONS * by_noise), axis=0)
    return jumps


def _smoothed(units: Floats, noise: Floats, smoothing_s: float, dt_s: float) -> Floats:
    smoother = StepFilter(LIMIT_DEVIATIONS * noise, smoothing_s)
    return np.array([smoother.step(row, dt_s).copy() for row in units])


def _weight(pressure: Floats, dt_s: float) -> Floats:
    """Return the weight [t] of each sample: less while the pressure moves."""
    length = max(round(0.5 / dt_s), 1)
    smooth = np.convolve(np.pad(pressure, length, mode="edge"), np.ones(length) / length, "same")
    rate = np.gradient(smooth)[length:-length] / dt_s
    weight: Floats = 1.0 / (UNCERTAINTY_KPA**2 + (DOUBT_S * rate) ** 2)
    return weight


def _fit_curve(units: Floats, kpa: Floats, weight: Floats, top: float) -> Floats:
    """Fit the curve [k] at `KNOTS_UNITS` to samples [t]: least squares, smooth, rising."""
    count = int(np.searchsorted(KNOTS_UNITS, max(top, 10.0))) + 1
    knots = KNOTS_UNITS[:count]
    inside = np.clip(units, 0.0, knots[-1])
    knot = np.searchsorted(knots[1:-1], inside, side="right")
    high = (inside - knots[knot]) / (knots[knot + 1] - knots[knot])
    # Below zero the first straight line continues.
    high = np.where(units < 0.0, units / knots[1], high)
    low = 1.0 - high
    normal = np.zeros((count, count))
    for row, column, product in (
        (knot, knot, low * low),
        (knot, knot + 1, low * high),
        (knot + 1, knot, low * high),
        (knot + 1, knot + 1, high * high),
    ):
        flat = row * count + column
        normal += np.bincount(flat, weight * product, count * count).reshape(count, count)
    right = np.bincount(knot, weight * low * kpa, count)
    right += np.bincount(knot + 1, weight * high * kpa, count)
    widths = np.diff(knots)
    slopes = np.diff(np.eye(count), axis=0) / widths[:, np.newaxis]
    bends = np.diff(slopes, axis=0) * np.sqrt(0.5 * (widths[1:] + widths[:-1]))[:, np.newaxis]
    mean_slope = max(float(np.sum(weight * units * kpa) / np.sum(weight * units**2)), 1e-3)
    normal += STIFFNESS / mean_slope**2 * bends.T @ bends
    # An untouched pad reads no pressure, so the first knot is fixed.
    found = np.zeros(len(KNOTS_UNITS))
    found[1:count] = np.linalg.solve(normal[1:, 1:], right[1:])
    found[:count] = rising(np.pad(found[:count], (0, len(KNOTS_UNITS) - count), mode="edge"))[
        :count
    ]
    last = max((found[count - 1] - found[count - 3]) / (knots[-1] - knots[-3]), 0.1 * mean_slope)
    found[count:] = found[count - 1] + last * (KNOTS_UNITS[count:] - knots[-1])
    return found


def _block_means(values: Floats, length: int) -> Floats:
    count = len(values) // length
    means: Floats = values[: count * length].reshape(count, length, -1).mean(axis=1)
    return means


def _correlation(one: Floats, other: Floats) -> float:
    one, other = one - one.mean(), other - other.mean()
    power = float(np.sqrt(np.sum(one**2) * np.sum(other**2)))
    return float(np.sum(one * other)) / power if power > 0.0 else 0.0


@dataclass(frozen=True)
class GainFit:
    """C = gain (bend a S^2 + b S) for each taxel [n], and how well it fits.

    Attributes:
        gain, bend: float64[n]; 1 where they could not be fitted.
        fitted: bool[n], whether the taxel has its own gain.
        bent: bool[n], whether it has its own bend.
        rms_before_kpa, rms_after_kpa: error over all levels and fitted taxels.
    """

    gain: Floats
    bend: Floats
    fitted: Mask
    bent: Mask
    rms_before_kpa: float
    rms_after_kpa: float


def fit_gains(levels_kpa: Floats, linear_kpa: Floats, square_kpa: Floats, usable: Mask) -> GainFit:
    """Fit gains and bends.

    Args:
        levels_kpa: known pressures [k].
        linear_kpa: the linear part of the common curve at each level and taxel [k, n], after
            correction for relaxation.
        square_kpa: its quadratic part, likewise.
        usable: taxels [n] that may be fitted.

    Raises:
        ValueError: no level, or levels that are not positive.
    """
    if len(levels_kpa) == 0 or np.any(levels_kpa <= 0.0):
        raise ValueError("levels must be positive pressures")
    level = levels_kpa[:, np.newaxis]
    common = linear_kpa + square_kpa
    power = np.sum(common**2, axis=0)
    gain = np.sum(common * level, axis=0) / np.where(power > 0.0, power, 1.0)
    fitted = usable & (gain > GAIN_RANGE[0]) & (gain < GAIN_RANGE[1])
    gain = np.where(fitted, gain, 1.0)
    bend = np.ones_like(gain)
    bent = np.zeros_like(fitted)
    if len(levels_kpa) >= 3 and levels_kpa.max() >= BEND_FROM_KPA:
        own_gain, own_bend, error = _two_parts(level, linear_kpa, square_kpa)
        sensible = (own_bend > BEND_RANGE[0]) & (own_bend < BEND_RANGE[1])
        bent = fitted & sensible & (error < BEND_ERROR) & (own_gain > GAIN_RANGE[0])
        gain = np.where(bent, own_gain, gain)
        bend = np.where(bent, own_bend, bend)
    after = gain * (linear_kpa + bend * square_kpa)
    return GainFit(
        gain,
        bend,
        fitted,
        bent,
        _rms((common - level)[:, fitted]),
        _rms((after - level)[:, fitted]),
    )


def _two_parts(level: Floats, linear: Floats, square: Floats) -> tuple[Floats, Floats, Floats]:
    """Least squares of level = gain linear + gain bend square; gain, bend, error of bend."""
    ll, ls, ss = (
        np.sum(x * y, axis=0) for x, y in ((linear, linear), (linear, square), (square, square))
    )
    lp, sp = np.sum(linear * level, axis=0), np.sum(square * level, axis=0)
    determinant = ll * ss - ls**2
    possible = determinant > 1e-9 * np.maximum(ll * ss, 1e-9)
    safe = np.where(possible, determinant, 1.0)
    gain = (ss * lp - ls * sp) / safe
    curvature = (ll * sp - ls * lp) / safe
    safe_gain = np.where(gain > 0.0, gain, 1.0)
    error = np.where(
        possible, READING_UNCERTAINTY_KPA * np.sqrt(np.maximum(ll / safe, 0.0)) / safe_gain, np.inf
    )
    return np.where(possible, gain, 0.0), curvature / safe_gain, error


def _rms(error: Floats) -> float:
    return float(np.sqrt(np.mean(error**2))) if error.size else float("nan")
