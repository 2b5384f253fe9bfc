"""A fingertip on a force/torque board whose zero is of no load is touched while it is loaded, slips
while its load slides, and reports this load.
"""

import numpy as np

from skin_host.evaluation.simulate.accusations import Accusations
from skin_host.evaluation.simulate.promises.limits import (
    CAUSE_NS,
    FELT_N,
    LOADED_N,
    LONG_AGO_NS,
    NS,
    PAUSE_NS,
    PULLED_NS,
    SLID_MM,
    SLID_NS,
)
from skin_host.evaluation.simulate.promises.loads import LoadCheck
from skin_host.evaluation.simulate.world import Life, World
from skin_host.fingertip.events import FingertipEvent, Slip
from skin_host.processing.events import Touch


class FingertipCheck:
    """Compares what fingertips report with their loads.

    Args:
        world: to watch.
        accusations: knows which zeros may be of a load, and which frames are damaged.
    """

    def __init__(self, world: World, accusations: Accusations) -> None:
        self._world, self._accusations = world, accusations
        self._load = LoadCheck(world)
        #: When each was last loaded, and was not loaded firmly.
        self._loaded_ns = dict.fromkeys(world.settings.fingertips, LONG_AGO_NS)
        self._eased_ns = dict.fromkeys(world.settings.fingertips, LONG_AGO_NS)
        #: When the load of each had last not slid; and those that have slipped under the present
        #: load, or whose board may not have been received then: a steady slide does not show.
        self._held_ns = dict.fromkeys(world.settings.fingertips, LONG_AGO_NS)
        self._slipped: set[str] = set()

    def note_pause(self) -> None:
        """One is about to be loaded, and may have been free only between two samples."""
        for name in self._eased_ns:
            self._load_n(name)

    def _load_n(self, name: str) -> float:
        """Return the present load of one, and note if there is none."""
        now_ns = self._world.clock.monotonic_ns()
        force_n = float(np.linalg.norm(self._world.robot.fingertips.force_n(name, now_ns)))
        if force_n < FELT_N:
            self._eased_ns[name] = now_ns
        return force_n

    def note_loads(self, life: Life | None) -> None:
        """Note which are loaded, and which zeros may be of a load."""
        now_ns = self._world.clock.monotonic_ns()
        tips = self._world.robot.fingertips
        calibrating = life is not None and life.daemon.engine.calibrating
        for name in self._loaded_ns:
            if self._load_n(name) > LOADED_N:
                self._loaded_ns[name] = now_ns
            else:
                self._slipped.discard(name)
            if tips.slipped_mm(name) < SLID_MM:
                self._held_ns[name] = now_ns
            # What is repeated may be of a load that has gone.
            repeats = self._accusations.may_repeat(name)
            if calibrating and (repeats or now_ns - self._loaded_ns[name] < NS):
                self._accusations.loaded.add(name)

    def reports(self, event: FingertipEvent) -> str | None:
        """Take an event; return what is wrong with it, or None."""
        name = event.part
        if name not in self._held_ns or event.event == "end":
            return None
        slips = isinstance(event, Slip)
        begins = isinstance(event, Touch) and event.event == "begin"
        if slips or (begins and self._world.robot.fingertips.slipped_mm(name) > 0.0):
            self._slipped.add(name)
        if self._unknown(name):
            return None
        if slips and self._world.clock.monotonic_ns() - self._pulled_ns(name) > PULLED_NS:
            return f"{name}: slips, and nothing pulls"
        is_old = self._accusations.may_repeat(name) or self._accusations.may_wait(name)
        return None if is_old else self._load.wrong(event)

    def _pulled_ns(self, name: str) -> int:
        """When what is held on one was last pulled."""
        of_tip = (tip.pulled_ns for tip in self._world.tips if tip.name == name)
        return max(of_tip, default=LONG_AGO_NS)

    def _unknown(self, name: str) -> bool:
        return name in self._accusations.loaded or self._accusations.may_damage(name)

    def wrong(self, life: Life) -> str | None:
        """Return one that is touched without a load, or is not touched with one, or whose load
        slides without a slip; or None.
        """
        clock = self._world.clock
        now_ns = clock.monotonic_ns()
        engine = life.daemon.engine.fingertips
        for name, state in ({} if engine is None else engine.tips).items():
            if self._accusations.may_lose(name):
                self._slipped.add(name)
            if self._unknown(name):
                continue
            # What it sent lately waits to be read after a stall.
            if not state.tip.feels or abs(clock.now_ns() - state.last_ns) > NS // 2:
                continue
            slides = now_ns - self._held_ns[name] > SLID_NS
            if slides and state.tip.touched and name not in self._slipped:
                return f"{name}: does not slip, and what presses it slides"
            if state.tip.touched and now_ns - self._loaded_ns[name] > CAUSE_NS:
                return f"{name}: still touched, and nothing presses"
            threshold_n = state.tip.threshold_n
            if not state.tip.touched and now_ns - self._eased_ns[name] > PAUSE_NS:
                return f"{name}: not touched while it is pressed, from {threshold_n:.2f} N on"
        return None
