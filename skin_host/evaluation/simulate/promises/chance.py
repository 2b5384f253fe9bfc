"""Touches by noise alone: a pad is touched once in `touch.ODDS` measurements, and no more often."""

import math

from skin_host.evaluation.simulate.promises.limits import CAUSE_NS, UNLIKELY
from skin_host.processing.touch import ODDS


def too_many(touches: int, measurements: int) -> bool:
    """Return whether noise touches so often with a probability below `UNLIKELY`.

    The number is taken for a Poisson variable with mean `measurements` / `ODDS`.
    """
    mean = max(measurements, 1) / ODDS
    fewer = sum(
        math.exp(number * math.log(mean) - mean - math.lgamma(number + 1))
        for number in range(touches)
    )
    return touches > 0 and 1.0 - fewer < UNLIKELY


class Chance:
    """Counts the measurements of a run, and the touches of single pads that nothing explains.

    Attributes:
        measurements: of valid taxels.
        touches: how many of them made a touch.
    """

    def __init__(self) -> None:
        self.measurements = 0
        self.touches = 0
        self._last: tuple[int, int] | None = None

    def explains(self, taxel: int, now_ns: int) -> bool:
        """Return whether noise may touch a pad now; of one touch this can be asked repeatedly."""
        if self._last is not None:
            last, at_ns = self._last
            if taxel == last and now_ns - at_ns < CAUSE_NS:
                return True
        if too_many(self.touches + 1, self.measurements):
            return False
        self.touches += 1
        self._last = taxel, now_ns
        return True
