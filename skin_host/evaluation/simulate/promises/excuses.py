"""Whose values may be wrong without anybody being able to know: these taxels are not judged."""

import numpy as np
from numpy.typing import NDArray

from skin_host.evaluation.simulate.promises.limits import (
    LONG_AGO_NS,
    NS,
    RELAXED_NS,
    RESTING_NS,
    TOUCHING_KPA,
    WAITED_NS,
    Mask,
)
from skin_host.evaluation.simulate.troubles.trouble import RECOVERS_S, Trouble
from skin_host.evaluation.simulate.world import Triangle, World


class Excuses:
    """Which taxels are not judged, and which triangles have no chip.

    Attributes:
        exempt: taxels bool[n] whose zero or calibration is wrong, until a calibration at rest.
        spoiling: troubles that last and make values wrong.
        known_twice: those of them of which health has reported that two boards send at one
            address.
        blind_since: since when each triangle has had no chip (ns).
        touched_ns: when each taxel was last pressed [n].
        zeroed_touched: taxels bool[n] that may have been pressed when their board was zeroed, until
            a calibration at rest.
        calibrated_touched_ns: when a calibration may last have seen each taxel pressed, or known
            that it was when its board was zeroed [n].
    """

    def __init__(self, world: World) -> None:
        self._world = world
        n = world.layout.n_taxels
        self.exempt = np.zeros(n, np.bool_)
        self.spoiling: list[Trouble] = []
        self.known_twice: list[Trouble] = []
        self.blind_since: dict[Triangle, int] = {}
        self.touched_ns = np.full(n, LONG_AGO_NS, np.int64)
        self.zeroed_touched = np.zeros(n, np.bool_)
        self.calibrated_touched_ns = np.full(n, LONG_AGO_NS, np.int64)
        self._spoiled_until_ns = np.full(n, LONG_AGO_NS, np.int64)

    def begin(self, trouble: Trouble) -> None:
        """A trouble begins."""
        for triangle in trouble.blind:
            self.blind_since.setdefault(triangle, self._now_ns())
        if trouble.spoils is not None:
            if trouble.lasts_s[1]:
                self.spoiling.append(trouble)
            else:
                self._recover(trouble)

    def end(self, trouble: Trouble) -> None:
        """A trouble ends."""
        for triangle in trouble.blind:
            self.blind_since.pop(triangle, None)
        if trouble.name == "babbling_node":
            self._note_freed(trouble)
        if trouble in self.spoiling:
            self._recover(trouble)
            self.spoiling.remove(trouble)
        if trouble in self.known_twice:
            self.known_twice.remove(trouble)

    def note_stall(self) -> None:
        """A stall is over: what was wrong as it passed is read now."""
        wrong, now_ns = self._spoiled_until_ns, self._now_ns()
        lately = wrong > now_ns - WAITED_NS
        wrong[lately] = np.maximum(wrong[lately], now_ns + int(RECOVERS_S * NS))

    def note_twice(self, trouble: Trouble) -> None:
        """Health has reported that two boards send at an address: none of it may be valid now."""
        if trouble not in self.known_twice:
            self.known_twice.append(trouble)
            self._recover(trouble)

    def spoiled(self) -> Mask:
        """Return the taxels bool[n] whose values may be wrong now.

        A pad of real skin that has been stuck since before its calibration cannot be distinguished
        from a quiet one.
        """
        spoiled: Mask = self._spoiled_until_ns > self._now_ns()
        spoiled |= ~np.isnan(self._world.robot.skin.held_ff)
        for trouble in self.spoiling:
            assert trouble.spoils is not None
            if trouble not in self.known_twice:
                spoiled |= trouble.spoils
        return spoiled

    def of_touches(self, taxels: NDArray[np.intp], lately_ns: int) -> Mask:
        """Return whether each of some taxels may be touched, bool[k]: something presses it or did
        so lately, or its value may be wrong.
        """
        caused: Mask = self._now_ns() - self.touched_ns[taxels] < lately_ns
        if not caused.all():
            caused |= self._world.robot.skin.true_pressure_kpa()[taxels] > TOUCHING_KPA
            caused |= (self.exempt | self.spoiled())[taxels]
        return caused

    def note_calibrating(self, true_kpa: NDArray[np.float64]) -> None:
        """A calibration goes on: touched taxels are calibrated anyway, with that verdict."""
        now_ns = self._now_ns()
        self.exempt |= (true_kpa > TOUCHING_KPA) | self.spoiled()
        self.calibrated_touched_ns[self._lately_touched() | self.zeroed_touched] = now_ns

    def note_zeroed(self, taxels: NDArray[np.int32]) -> None:
        """A board with these taxels was zeroed: what the daemon felt on them is in their zero."""
        self.zeroed_touched[taxels] |= (self._lately_touched() | self.spoiled())[taxels]

    def calibrated_at_rest(self) -> None:
        """A calibration of the whole untouched skin was taken."""
        long_ago = self.calibrated_touched_ns < self._now_ns() - RESTING_NS
        self.calibrated_touched_ns[long_ago] = LONG_AGO_NS
        self.exempt[:] = False
        self.zeroed_touched[:] = False
        self._spoiled_until_ns[:] = LONG_AGO_NS

    def _lately_touched(self) -> Mask:
        lately: Mask = self.exempt | (self._now_ns() - self.touched_ns < RELAXED_NS)
        return lately

    def _note_freed(self, trouble: Trouble) -> None:
        """A bus is free again: what waited for it in the boards passes now, and is of before."""
        assert trouble.places is not None
        for board, triangle in self.blind_since:
            if board in trouble.places:
                self.blind_since[board, triangle] = self._now_ns()

    def _recover(self, trouble: Trouble) -> None:
        assert trouble.spoils is not None
        until_ns = self._now_ns() + int(trouble.recovers_s * NS)
        wrong = self._spoiled_until_ns
        wrong[trouble.spoils] = np.maximum(wrong[trouble.spoils], until_ns)

    def _now_ns(self) -> int:
        return self._world.clock.monotonic_ns()
