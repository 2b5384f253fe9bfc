"""Something that goes wrong: what may be reported of it, where, and what must be."""

import random
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from skin_host.evaluation.simulate.world import Triangle, World

Mask = NDArray[np.bool_]
#: Until a calibration at rest.
FOR_EVER_S = 1e6
#: Evidence of a touch is gone after 2.6 s in the mean, of a pad with noise of six units.
RECOVERS_S = 5.0


def nothing() -> None:
    """It is over already."""


def always() -> bool:
    """It shows."""
    return True


@dataclass
class Trouble:
    """Something that goes wrong now.

    Attributes:
        name: its kind.
        about: the same with its target, for people.
        end: ends it.
        may: codes that health may report because of it, at `places`.
        must: codes of which health must report one, once it has lasted for `within_s`; what
            happens at once must be reported within that time.
        places: names of buses, boards and parts; None is everywhere.
        blind: triangles that do not measure meanwhile.
        spoils: bool[n], taxels whose values may be wrong meanwhile, without anybody being able to
            know, and for `recovers_s` afterwards: so long the noisiest pads stay touched by what
            is over.
        lingers: what it did lasts until it is put right.
        writes: it shows only when something is written.
        shows: whether it differs so far, for the daemon, from what is no trouble.
        lasts_s: shortest and longest; no time at all for what happens at once.
        twice: the board at whose address a second one sends; once health has reported that, no
            taxel of it is valid.
        lasting: codes of `may` of what lasts, though it is over, until the boards are zeroed again.
    """

    name: str
    about: str
    end: Callable[[], object]
    may: set[str] = field(default_factory=set)
    must: frozenset[str] = frozenset()
    within_s: float = 3.0
    places: frozenset[str] | None = None
    blind: frozenset[Triangle] = frozenset()
    spoils: Mask | None = None
    recovers_s: float = RECOVERS_S
    lingers: bool = False
    writes: bool = False
    shows: Callable[[], bool] = always
    lasts_s: tuple[float, float] = (0.2, 15.0)
    twice: str = ""
    lasting: frozenset[str] = frozenset()

    def accuses(self, code: str, where: str) -> bool:
        """Whether health may report this because of it."""
        if code not in self.may:
            return False
        return self.places is None or where.partition("/")[0] in self.places


#: Takes the world, what draws target and strength, and whether it is to be so strong that health
#: must name it (if it must at any strength).
Begin = Callable[[World, random.Random, bool], Trouble]


def places_of(world: World, *, board: str = "", bus: str = "") -> frozenset[str]:
    """Return a board, or all of a bus, with what depends on it: names that health may blame."""
    layout = world.layout
    boards = [
        (number, one)
        for number, one in enumerate(layout.boards)
        if one.name == board or one.settings.bus == bus
    ]
    numbers = {number for number, _ in boards}
    parts = {part.name for part in layout.parts if numbers & set(part.boards)}
    buses = {one.settings.bus for _, one in boards}
    tips = {name for name, tip in world.settings.fingertips.items() if tip.bus == bus}
    return frozenset({one.name for _, one in boards} | parts | tips | buses | ({bus} - {""}))


def taxels_of(world: World, *, board: str = "", bus: str = "") -> Mask:
    """Return the taxels bool[n] of a board, or of all of a bus."""
    found = np.zeros(world.layout.n_taxels, np.bool_)
    for one in world.layout.boards:
        if one.name == board or one.settings.bus == bus:
            found[one.taxel_index[one.taxel_index >= 0]] = True
    return found
