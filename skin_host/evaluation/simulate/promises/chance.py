"""Touches by noise alone: as rare as promised, whatever the daemon decides by."""

import math

from skin_host.evaluation.simulate.promises.limits import (
    CAUSE_NS,
    MEASUREMENTS_A_FALSE_TOUCH,
    UNLIKELY,
)


def too_many(touches: int, measurements: int) -> bool:
    """Return whether noise touches so often with a probability below `UNLIKELY`.

    The number is taken for a Poisson variable with mean `measurements` /
    `MEASUREMENTS_A_FALSE_TOUCH`.
    """
    mean = max(measurements, 1) / MEASUREMENTS_A_FALSE_TOUCH
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
        #: When each of these was touched last.
        self._touched_ns: dict[int, int] = {}

    def lately(self, now_ns: int) -> list[int]:
        """Return the taxels that noise has touched, and that may be touched still."""
        return [taxel for taxel, t_ns in self._touched_ns.items() if now_ns - t_ns < CAUSE_NS]

    def explains(self, taxel: int, now_ns: int) -> bool:
        """Return whether noise may touch a taxel now; of one touch this can be asked repeatedly."""
        if taxel in self.lately(now_ns):
            return True
        if too_many(self.touches + 1, self.measurements):
            return False
        self.touches += 1
        self._touched_ns[taxel] = now_ns
        return True
