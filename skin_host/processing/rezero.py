"""Finds the untouched readings of a board's taxels after the board was zeroed.

A board is zeroed when it is set up, and by itself when chips fail to answer (reference of the
wire, section 4.2 and 4.5): it stores one snapshot of every pad, noise included. The host's
calibration is then off by some units, and whatever pressed at that moment has become the zero. So
the host observes the taxels for a while and moves the baselines by their new readings. The zero of
a taxel that was touched just before is unknown; it is in doubt until it is calibrated again.

A press that nobody felt begin (the daemon was not running) becomes the zero too. It shows when it
lifts: the pad then reads far below zero, which nothing can press it to.

A press that begins, ends or changes while the new zero is observed is in the mean of what is read.
It shows in its course: before some moment and after it the readings differ by more than noise
explains. Such a pad is observed again until it rests, and no higher than it did before or after
that moment. So is one that rests higher than the noise of one reading explains, because it was
pressed between the zero and the first sweep. Until then its zero is in doubt.

The threshold of touch is that of a zero which is known. So a noisy taxel is observed until what its
noise leaves in the mean is a small part of its threshold. While another taxel of its board is
touched, what it reads does not count. A board's zero, one reading, may leave a noisy pad so near to
the end of the scale that its noise is cut off: it is refused, as a calibration would refuse it. A
pad that was pressed then and lifts is at that end too, but farther off than its noise reaches: its
zero is in doubt.
"""

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.calibration.calibrator import SATURATED_SHARE
from skin_host.processing.conversions import CONVERSION_S

#: The new zero is observed for this long, and for this many sweeps if the board is slow; then the
#: pipeline needs the third time to use it.
LOOK_NS = 1_000_000_000
LOOK_SWEEPS = 20
SETTLE_NS = 1_100_000_000
#: Fewer samples than this are not used.
FEWEST = 10
#: A zero is known when its standard error is this share of the threshold of touch. One second of a
#: pad with much noise leaves a third, which drift takes away as slowly as it is a false touch.
ERROR_SHARE = 1 / 7
#: A pad that reads far below zero in so many sweeps in a row was pressed when it was zeroed.
BELOW_SWEEPS = 5
#: One that comes back sooner jumps: for so long, none of its board is taken for a lifted press.
JUMPS_NS = 2_000_000_000
#: Readings before and after a moment have another mean if they differ by more than drift does, ...
STEADY_UNITS = 0.5
#: ... and so many standard errors, of a spread that rounding alone may have.
STEADY_ERRORS = 5.0
LEAST_SPREAD = 0.5
#: With fewer conversions before or after, where an untouched pad rests is not taken from them.
FEWEST_RESTING = 3
#: Noise explains that a board's zero, one reading, is off by so many of its standard deviations.
SNAPSHOT_SIGMAS = 3.0
#: The byte at the end of the scale, of a pad far below zero.
END = 255

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def look_s(spread: Floats, enter: Floats) -> Floats:
    """Return how long [n] a zero is to be observed, in seconds, by `ERROR_SHARE`: at most 4.8.

    Args:
        spread: float64[n], standard deviation of a measurement derived from sums of measurements.
        enter: float64[n], the threshold of touch, see `touch.levels`, which grows with the spread.
    """
    found: Floats = np.square(spread / (ERROR_SHARE * enter)) * CONVERSION_S
    return found


def repeats_of(period_s: float) -> float:
    """Return how often a board that sends at this interval sends a conversion."""
    return max(1.0, CONVERSION_S / period_s)


def highest_rest(baseline: Floats, spread: Floats, repeats: float = 1.0) -> tuple[Floats, Floats]:
    """Return up to where untouched taxels [n] may read, whether or not their board was zeroed, and
    what noise may add to one reading, in units.

    Args:
        baseline: float64[n], where they rested before.
        spread: float64[n], see `Rezero.finish`.
        repeats: how often the board sends a conversion.
    """
    # That of a mean of k readings is this by sqrt(k).
    error = STEADY_ERRORS * np.sqrt(repeats) * np.maximum(spread, LEAST_SPREAD)
    # The board's zero is one reading. Without one, pads rest where they did.
    return np.maximum(baseline, 0.0) + STEADY_UNITS + error, error


class Rezero:
    """Observes the n taxels of a board after the board was zeroed.

    A taxel of which too few bytes came, because it is noisy or frames were lost, is observed for
    longer: its old zero is wrong, and its new one is not known.

    Args:
        touched: bool[n], taxels that were touched just before.
        no_load: float64[n], the byte of an untouched pad as the board was set up.
        fitted: bool[n], taxels that there are.
        wanted: int[n], how many bytes of each are wanted; `FEWEST` by default.
        period_s: how often the board sends: it may repeat conversions.
        believed: whether the board had been set up before, as it is now.

    Attributes:
        believed: the same.
        doubted: bool[n], taxels whose zero is not known.
        cut_off: bool[n], taxels whose noise reaches the end of the scale: they are refused.
        moved: bool[n], taxels that something may have pressed while they were observed: they are
            observed again.
        over: whether all zeros have been found, are in use and in no doubt: no sweep changes that.
    """

    def __init__(
        self,
        touched: Mask,
        no_load: Floats,
        fitted: Mask,
        wanted: NDArray[np.int64] | None = None,
        period_s: float = CONVERSION_S,
        believed: bool = True,
    ) -> None:
        self.believed = believed
        self.over = False
        self._no_load = no_load
        self._repeats = repeats_of(period_s)
        none = np.zeros(len(no_load), np.int64)
        self._wanted = np.maximum(FEWEST, none if wanted is None else wanted)
        self._forget()
        self._sweeps = 0
        self._since_ns: int | None = None
        self._t_ns = 0
        #: Taxels whose new zero is not found yet, whether there are any, when each was found, and
        #: when the first and the last were.
        self._sought: Mask = fitted.copy()
        self._seeks = bool(fitted.any())
        self._found_ns = np.zeros(len(no_load), np.int64)
        self._first_ns: int | None = None
        self._last_ns = 0
        self.doubted: Mask = touched.copy()
        self.cut_off: Mask = np.zeros(len(no_load), np.bool_)
        self.moved: Mask = np.zeros(len(no_load), np.bool_)
        #: Where untouched pads rest at most, in units.
        self._highest = np.full(len(no_load), np.inf)

    def _forget(self) -> None:
        """Observe from the first byte on."""
        n = len(self._no_load)
        #: The bytes of each, in the order in which they came.
        self._raw: NDArray[np.uint8] = np.zeros((LOOK_SWEEPS, n), np.uint8)
        self._count: NDArray[np.int64] = np.zeros(n, np.int64)
        self._n_far = np.zeros(n, np.int64)
        self._n_end = np.zeros(n, np.int64)

    def doubt(self, pads: Mask) -> bool:
        """The zeros of some pads, bool[n], are not known; return whether any of them was."""
        if not np.any(pads & ~self.doubted):
            return False
        self.doubted |= pads
        self.over = False
        return True

    @classmethod
    def of_long_ago(cls, no_load: Floats, t_ns: int) -> "Rezero":
        """Return one whose zero has long been in use, at a time: only doubts can still arise."""
        none = np.zeros(len(no_load), np.bool_)
        rezero = cls(none, no_load, none)
        rezero._since_ns = rezero._first_ns = rezero._last_ns = t_ns - SETTLE_NS
        return rezero

    def step(
        self, raw: NDArray[np.uint8], present: Mask, far: Mask, t_ns: int, touched: bool = False
    ) -> bool:
        """Take one sweep; return whether `finish` has new zeros.

        Args:
            raw: uint8[n], the bytes.
            present: bool[n], which of them were received.
            far: bool[n], pads that their board marks as far out of range. Such a byte is no
                reading: boards send it while a data line is shorted, and for some sweeps after.
            t_ns: time of the sweep.
            touched: whether any taxel whose zero is known is touched: then what noisy ones read
                does not count, for it may press them too. Those that moved show that themselves.
        """
        if self._since_ns is None:
            self._since_ns = t_ns
        if not self._seeks:
            return False
        self._t_ns = t_ns
        looks = 0 <= t_ns - self._since_ns < LOOK_NS or self._sweeps < LOOK_SWEEPS
        observed = present & self._sought
        if not looks:
            observed &= ~self._enough
            if touched:
                observed &= (self._count < FEWEST) | self.moved
        read = observed & ~far
        pads = np.flatnonzero(read)
        rows = self._count[pads]
        if rows.max(initial=0) >= len(self._raw):
            self._raw = np.concatenate([self._raw, np.zeros_like(self._raw)])
        self._raw[rows, pads] = raw[pads]
        self._count += read
        self._n_far += observed & far
        self._n_end += observed & (raw == END)
        self._sweeps += 1
        return not looks and bool((self._sought & self._enough).any())

    @property
    def _enough(self) -> Mask:
        """Return which taxels [n] have been observed often enough, at their rest or far off."""
        enough: Mask = (self._count >= self._wanted) | (self._n_far >= self._wanted)
        return enough

    @property
    def unknown(self) -> Mask:
        """Return the taxels bool[n] whose zero is not known, or not before they rest."""
        return self.doubted | self.moved

    @property
    def late(self) -> Mask | None:
        """Return the taxels bool[n] that are sought while the others have been found."""
        return self._sought if self._seeks and self._first_ns is not None else None

    @property
    def begun(self) -> bool:
        """Return whether a sweep has been received since."""
        return self._since_ns is not None

    @property
    def seeks_all(self) -> bool:
        """Return whether no new zero has been found yet."""
        return self._first_ns is None

    def found_since(self, t_ns: int) -> bool:
        """Return whether any new zero has been found since a time."""
        return bool((self._found_ns >= t_ns).any())

    def lowest(self) -> Floats:
        """Return the lowest that each taxel [n] has rested at, in units: infinite if it was not
        observed for `FEWEST_RESTING` readings.
        """
        units = self._no_load - self._raw[: int(self._count.max())]
        lowest = np.full(len(self._no_load), np.inf)
        for last in range(FEWEST_RESTING, len(units) + 1):
            rest = np.median(units[last - FEWEST_RESTING : last], axis=0)
            np.minimum(lowest, rest, out=lowest, where=self._count >= last)
        return lowest

    def restart(self, t_ns: int) -> None:
        """The board was not received for a while, up to a time: what it sent before may have been
        of another zero.
        """
        if self._since_ns is None or not self._seeks:
            return
        self._forget()
        self._highest[~self.moved] = np.inf
        if self.seeks_all:
            self._since_ns = t_ns
            self._sweeps = 0

    def settled(self, t_ns: int) -> bool:
        """Return whether new baselines are in use, but for those of `unsettled`."""
        return self._first_ns is not None and abs(t_ns - self._first_ns) >= SETTLE_NS

    def unsettled(self, t_ns: int) -> Mask | None:
        """Return the taxels bool[n] whose new baseline is not in use; None if there are none."""
        if not self._seeks and abs(t_ns - self._last_ns) >= SETTLE_NS:
            return None
        unsettled: Mask = self._sought | (np.abs(t_ns - self._found_ns) < SETTLE_NS)
        return unsettled

    def finish(
        self, baseline: Floats, noise: Floats, spread: Floats | None = None
    ) -> tuple[Mask, Floats]:
        """Return the taxels bool[n] whose zero has been found now, or is known better than before
        while they are observed for longer, and the new baselines [n], in units.

        Should the daemon end meanwhile, the next one judges by what it finds kept: what noise left
        in the mean so far is less than what it left in the board's zero, one reading.

        Args:
            baseline: float64[n], the previous ones.
            noise: float64[n], as calibrated.
            spread: float64[n], as for `look_s`; infinite for taxels that are not used. The noise by
                default.
        """
        found = self._sought & self._enough
        if self._first_ns is None:
            self._first_ns = self._t_ns
        longest = int(self._count.max())
        units = self._no_load - self._raw[:longest]
        units[np.arange(longest)[:, None] >= self._count] = 0.0
        count = np.maximum(self._count, 1)
        mean = units.sum(axis=0) / count
        # What was far out of range mostly may have another zero when it is back.
        self.doubted |= found & (self._count < self._wanted)
        known = found & ~self.doubted
        # Noise that is cut off at the end of the scale gives a wrong mean.
        cut = self._n_end > SATURATED_SHARE * (self._count + self._n_far)
        ends = known & cut
        # By their squares: readings of a press, before it lifted far below zero, balance in a mean.
        mean_square = np.square(units).sum(axis=0) / count
        below = ends & (mean_square > (SNAPSHOT_SIGMAS**2 + 1.0) * np.square(noise))
        self.doubted |= below
        self.cut_off |= ends & ~below
        known &= ~ends
        late = self._sought & ~found & (self._count >= FEWEST) & ~self.unknown & ~cut
        known |= late
        moved = self._moves(known, units, baseline, noise if spread is None else spread)
        self.moved = (self.moved & ~found) | moved
        self._wanted[moved] = np.maximum(self._wanted, self._count)[moved]
        for array in (self._count, self._n_far, self._n_end):
            array[moved] = 0
        found &= ~moved
        self._sought &= ~found
        self._seeks = bool(self._sought.any())
        self._found_ns[found] = self._last_ns = self._t_ns
        better = found | (late & ~moved)
        return better, np.where(known & better, mean, baseline)

    def _moves(self, known: Mask, units: Floats, baseline: Floats, spread: Floats) -> Mask:
        """Return which of some taxels bool[n] did not rest, or higher than they do untouched.

        Args:
            known: bool[n], those.
            units: float64[k, n], the readings, 0 where there are fewer.
            baseline: float64[n], the previous ones.
            spread: float64[n], see `finish`.
        """
        most, error = highest_rest(baseline, spread, self._repeats)
        if self.believed:
            self._highest = np.minimum(self._highest, most)
        before = np.arange(1, len(units))[:, None]
        after = self._count - before
        sums = np.cumsum(units, axis=0)
        means_after = (sums[-1:] - sums[:-1]) / np.maximum(after, 1)
        apart = np.abs(means_after - sums[:-1] / before)
        apart -= error * np.sqrt(1.0 / before + 1.0 / np.maximum(after, 1))
        apart[after <= 0] = -np.inf
        moves: Mask = known & (apart.max(axis=0, initial=-np.inf) > STEADY_UNITS)
        for pad in np.flatnonzero(moves):
            split = int(apart[:, pad].argmax()) + 1
            for side in (units[:split, pad], units[split : self._count[pad], pad]):
                if len(side) >= FEWEST_RESTING * self._repeats:
                    # A damaged byte is no rest.
                    rest = float(np.median(side)) + error[pad] / np.sqrt(len(side))
                    self._highest[pad] = min(self._highest[pad], rest + STEADY_UNITS)
        mean = units.sum(axis=0) / np.maximum(self._count, 1)
        moves |= known & (mean > self._highest)
        return moves
