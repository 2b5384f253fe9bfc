"""Whether a force/torque board measures, or repeats what it sent because its converter has stopped.
Pure.
"""

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.strain import Wrench

#: Force or torque is frozen after its three channels were repeated so many times in a row. Real and
#: emulated boards have noise of 0.5 words and more (rms): three channels at rest in the middle of
#: their words repeat themselves in one sample of three then. At 0.25 words they do in 87 of 100,
#: and 0.87^250 is 10^-15.
REPEATS = 250
#: What was sent is measured after so many changes in a row: fewer may be of damaged frames.
OTHERS = 3
#: A channel is judged by itself if it had so much noise at rest (words, rms, rounding included):
#: less may be that of a load between two words (0.5 then), which does not change in the middle of
#: one. So much noise repeats half of the samples there, and 0.5^250 is 10^-75.
LEAST_NOISE_WORDS = 0.6
_CHANNELS = [f"{half} along {axis}" for half in ("force", "torque") for axis in "xyz"]


class Frozen:
    """Takes samples, and knows whether they are measured or repeated.

    Nothing distinguishes the first samples of a board that measures from those of one that has
    stopped, so a board is trusted only once it has changed: force and torque by themselves, as one
    of them may be repeated alone. Noise is enough, no load is needed: most boards have shown it by
    their fourth sample, those with 0.5 words of noise by the tenth, and those with 0.25 words, at
    rest in the middle of all words, mostly by the fiftieth and nearly always by `REPEATS`. Less
    noise than that cannot be distinguished from none: such a board is trusted while its load
    changes, and is frozen at rest.

    A single channel whose amplifier has stopped leaves the others changing. It is found if it had
    noise when the zero was taken, see `judge`.

    What is at the end of a board's range is constant too, but saturated.
    """

    def __init__(self) -> None:
        self._halves = {"force": _Values(), "torque": _Values()}
        #: Channels that are judged by themselves, by their number.
        self._channels: dict[int, _Values] = {}

    def judge(self, noise_words: NDArray[np.float64]) -> None:
        """Judge channels by themselves from now on that had enough noise at rest.

        Args:
            noise_words: float64[6], rms, in words of the board; 0 where it is not known.
        """
        numbers = np.flatnonzero(noise_words >= LEAST_NOISE_WORDS).tolist()
        self._channels = {n: self._channels.get(n) or _Values(changes=True) for n in numbers}

    @property
    def trusted(self) -> bool:
        """Whether both have changed since the start or the last doubt, and no channel is
        repeated.
        """
        halves = self._halves["force"].changes and self._halves["torque"].changes
        return halves and all(channel.changes for channel in self._channels.values())

    @property
    def repeated(self) -> list[str]:
        """Which are frozen: "force", "torque", both, or channels of these such as "force along
        x".
        """
        found = [name for name, half in self._halves.items() if half.repeats >= REPEATS]
        for number, channel in self._channels.items():
            name = _CHANNELS[number]
            if channel.repeats >= REPEATS and name.partition(" ")[0] not in found:
                found.append(name)
        return found

    def take(self, sample: Wrench) -> None:
        """Take the next sample."""
        values = [*sample.force_n.tolist(), *sample.torque_nm.tolist()]
        self._halves["force"].take(values[:3], saturated=sample.saturated)
        self._halves["torque"].take(values[3:], saturated=sample.saturated)
        for number, channel in self._channels.items():
            channel.take(values[number : number + 1], saturated=sample.saturated)

    def doubt(self) -> None:
        """The next sample does not continue those before it: it must show again that it changes."""
        for half in self._halves.values():
            half.changes, half.others = False, 0


class _Values:
    """The force, or the torque, of one board, or one channel of them.

    Attributes:
        changes: whether it is known to be measured.
        repeats: how many samples in a row repeat `values`.
        others: how many in a row have not since.
    """

    def __init__(self, *, changes: bool = False) -> None:
        self.changes = changes
        self.repeats = 0
        self.others = 0
        self._values: list[float] | None = None

    def take(self, values: list[float], *, saturated: bool) -> None:
        if self._values is None:
            self._values = values
        elif values == self._values and not saturated:
            self.repeats += 1
            self.others = 0
            self.changes &= self.repeats < REPEATS
        else:
            self.others += 1
            self.changes |= self.others >= OTHERS
            if self.repeats < REPEATS or self.changes:
                self._values, self.repeats = values, 0
