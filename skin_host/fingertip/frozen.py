"""Whether a force/torque board measures, or repeats what it sent because its converter has stopped.
Pure.
"""

from skin_host.bus.strain import Wrench

#: Force or torque is frozen after its three channels were repeated so many times in a row. Real and
#: emulated boards have noise of 0.5 words and more (rms): three channels at rest in the middle of
#: their words repeat themselves in one sample of three then. At 0.25 words they do in 87 of 100,
#: and 0.87^250 is 10^-15.
REPEATS = 250
#: What was sent is measured after so many changes in a row: fewer may be of damaged frames.
OTHERS = 3


class Frozen:
    """Takes samples, and knows whether they are measured or repeated.

    Nothing distinguishes the first samples of a board that measures from those of one that has
    stopped, so a board is trusted only once it has changed: force and torque by themselves, as one
    of them may be repeated alone. Noise is enough, no load is needed: most boards have shown it by
    their fourth sample, those with 0.5 words of noise by the tenth, and those with 0.25 words, at
    rest in the middle of all words, mostly by the fiftieth and nearly always by `REPEATS`. Less
    noise than that cannot be distinguished from none: such a board is trusted while its load
    changes, and is frozen at rest.

    What is at the end of a board's range is constant too, but saturated.
    """

    def __init__(self) -> None:
        self._halves = {"force": _Half(), "torque": _Half()}

    @property
    def trusted(self) -> bool:
        """Whether both have changed since the start or the last doubt, and are not repeated."""
        return self._halves["force"].changes and self._halves["torque"].changes

    @property
    def repeated(self) -> list[str]:
        """Which are frozen: "force", "torque", both or none."""
        return [name for name, half in self._halves.items() if half.repeats >= REPEATS]

    def take(self, sample: Wrench) -> None:
        """Take the next sample."""
        for half, values in zip(
            self._halves.values(), (sample.force_n, sample.torque_nm), strict=True
        ):
            half.take(values.tolist(), saturated=sample.saturated)

    def doubt(self) -> None:
        """The next sample does not continue those before it: it must show again that it changes."""
        for half in self._halves.values():
            half.changes, half.others = False, 0


class _Half:
    """The force, or the torque, of one board.

    Attributes:
        changes: whether it is known to be measured.
        repeats: how many samples in a row repeat `values`.
        others: how many in a row have not since.
    """

    def __init__(self) -> None:
        self.changes = False
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
