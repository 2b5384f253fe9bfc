"""Whether a force/torque board repeats one sample, because its converter has stopped. Pure."""

from skin_host.bus.strain import Wrench

#: A board is frozen after a sample was repeated so many times in a row. Real and emulated boards
#: have noise of 0.5 words and more (rms): six channels at rest in the middle of their words repeat
#: one sample in ten then. At 0.25 words three in four do, and 0.75^200 is 10^-25.
REPEATS = 200
#: It works again after so many others in a row: fewer may be damaged frames.
OTHERS = 3


class Frozen:
    """Takes samples, and returns after each whether its board is frozen.

    All six channels must repeat, for a channel with a coarse full scale may well be constant. What
    is at the end of a board's range is constant too, but saturated.
    """

    def __init__(self) -> None:
        self.now = False
        self._values: list[float] = []
        self._repeats = 0
        self._others = 0

    def take(self, sample: Wrench) -> bool:
        """Take the next sample; return whether the board is frozen."""
        values = [*sample.force_n.tolist(), *sample.torque_nm.tolist()]
        if values == self._values and not sample.saturated:
            self._repeats += 1
            self._others = 0
            self.now = self._repeats >= REPEATS
            return self.now
        self._others += 1
        if not self.now or self._others >= OTHERS:
            self._values, self._repeats = values, 0
            self.now = False
        return self.now
