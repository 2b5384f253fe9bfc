"""The course of each taxel over a calibration, at a constant size for any length."""

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.calibration import Floats
from skin_host.processing.masks import Mask

#: The course of a calibration is kept as means of this many samples, ...
BLOCK = 4
#: ... and at most this many means: when they are full, pairs are joined.
MOST_BLOCKS = 128
#: This many means are joined to measure how long noise lasts.
JOINED = 4
#: Means within so many standard errors of the largest are of the same reading. The largest of them
#: is 1 to 2.5 above it by chance, and hardly one is further below it than that.
SAME_ERRORS = 4.0


class BlockMeans:
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

    def rest(self, error: Floats) -> Floats:
        """Return the mean [n] of the means that differ from the largest by no more than noise; 0
        where there is none.

        Args:
            error: float64[n], standard error of a mean.
        """
        same = self._full & (self._begun >= (self.highest - SAME_ERRORS * error)[:, None])
        total = self._begun.sum(axis=1, where=same)
        found: Floats = total / np.maximum(np.count_nonzero(same, axis=1), 1)
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
