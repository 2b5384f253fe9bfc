"""Which load the samples of a force/torque board agree on. Pure."""

from collections import deque

import numpy as np

from skin_host.bus.strain import Floats, Wrench

#: So many samples are compared: with one damaged among them, the median is of the two others.
AROUND = 3


class Agreement:
    """Takes samples, and returns for each but the first and the last what two of it and its
    neighbours agree on: the median of each channel.

    A sample has no checksum beyond that of its frames, which a gateway or adapter makes again, and
    one wrong bit may be half the full scale. A load lasts for two samples at least. What rises or
    falls steadily stays as it is, and all that is felt comes one period later.
    """

    def __init__(self) -> None:
        self._samples: deque[Wrench] = deque(maxlen=AROUND)

    def take(self, sample: Wrench) -> Wrench | None:
        """Take the next sample; return the one before it, as its neighbours confirm it."""
        self._samples.append(sample)
        if len(self._samples) < AROUND:
            return None
        before, middle, after = self._samples
        saturated = before.saturated + middle.saturated + after.saturated > AROUND // 2
        return Wrench(
            middle.t_ns,
            _median(before.force_n, middle.force_n, after.force_n),
            _median(before.torque_nm, middle.torque_nm, after.torque_nm),
            saturated,
        )

    def forget(self) -> None:
        """The next sample does not continue those before it."""
        self._samples.clear()


def _median(a: Floats, b: Floats, c: Floats) -> Floats:
    """Return the median of three, element by element; numpy's own takes ten times as long."""
    median: Floats = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
    return median
