"""Why contacts end when touches are decided in another way, or zeros are taken in a touch."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.frame import PressureFrame
from skin_host.processing.masks import Mask, any_of

Floats = NDArray[np.float64]


class Decision(NamedTuple):
    """How touches begin or end: by the sum of what is above a level, see `touch.TouchDetector`.

    Attributes:
        level_kpa: float64[m], what lasts above this is a touch, below it none.
        evidence_kpa: float64[m], the sum that makes a touch, or that one has at most.
        votes: least number of measurements in which it is reached, or lost.
    """

    level_kpa: Floats
    evidence_kpa: Floats
    votes: int

    def added(self, evidence_kpa: Floats, pressure_kpa: NDArray[np.float32]) -> Floats:
        """Return the evidence [m] after another measurement [m]."""
        vote_kpa = self.evidence_kpa / self.votes
        gain = np.clip(pressure_kpa - self.level_kpa, -vote_kpa, vote_kpa)
        return np.clip(evidence_kpa + gain, 0.0, self.evidence_kpa)


class Former:
    """Whether contacts would still be touches by the decision by which they were found.

    Another decision, or a new zero, ends touches that last. The former decision is continued on
    the pressures of the taxels that were touched then, until the present one finds them, too.

    Args:
        m: taxels of the part.

    Attributes:
        names: of the contacts that it was for and that have not ended.
    """

    def __init__(self, m: int) -> None:
        self.names: set[int] = set()
        nothing = np.zeros(m)
        self._former = self._now = Decision(nothing, nothing, 1)
        #: What keeps each taxel touched by the former decision, and what the present one has found.
        self._kept_kpa, self._found_kpa = nothing, nothing
        self._zeroed: Mask = np.zeros(m, np.bool_)

    def _note(self, contacts: dict[int, list[int]]) -> Mask:
        """Note the contacts, and return their taxels [m]; forget those of earlier ones."""
        self.names = set(contacts)
        touched = np.zeros(len(self._zeroed), np.bool_)
        for taxels in contacts.values():
            touched[taxels] = True
        self._zeroed &= touched
        self._kept_kpa = np.where(touched, self._kept_kpa, 0.0)
        return touched

    def begin(self, contacts: dict[int, list[int]], former: Decision, now: Decision) -> None:
        """Continue a decision that is in use no longer, see `ContactTracker.note_former`.

        Args:
            contacts: the taxels of each by its name.
            former, now: the two decisions.
        """
        touched = self._note(contacts)
        # Of several that followed each other, that which keeps a touch for longest.
        level_kpa = np.where(
            self._kept_kpa > 0.0,
            np.fmin(self._former.level_kpa, former.level_kpa),
            former.level_kpa,
        )
        self._former, self._now = former._replace(level_kpa=level_kpa), now
        self._kept_kpa = np.where(touched, former.evidence_kpa, 0.0)
        self._found_kpa = np.zeros(len(touched))

    def zero(self, contacts: dict[int, list[int]], taxels: Mask) -> None:
        """Some taxels [m] have a new zero: nothing shows any more what they felt."""
        self._zeroed |= self._note(contacts) & taxels

    def step(self, frame: PressureFrame, received: Mask) -> None:
        """Take in a frame, and which of its taxels [m] were received."""
        kept = self._former.added(self._kept_kpa, frame.pressure_kpa)
        found = self._now.added(self._found_kpa, frame.pressure_kpa)
        self._found_kpa = np.where(received, found, self._found_kpa)
        over = (kept <= 0.0) | (found >= self._now.evidence_kpa)
        self._kept_kpa = np.where(received, np.where(over, 0.0, kept), self._kept_kpa)
        # A touch of now was found since the zero.
        self._zeroed &= ~frame.touched

    def keeps(self, taxels: NDArray[np.intp]) -> bool:
        """Return whether any of some taxels would still be touched."""
        return any_of((self._kept_kpa[taxels] > 0.0) | self._zeroed[taxels])
