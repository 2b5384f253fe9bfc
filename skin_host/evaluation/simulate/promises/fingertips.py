"""A fingertip on a force/torque board whose zero is of no load is touched while it is loaded."""

import numpy as np

from skin_host.evaluation.simulate.accusations import Accusations
from skin_host.evaluation.simulate.promises.limits import (
    CAUSE_NS,
    FELT_N,
    LOADED_N,
    LONG_AGO_NS,
    NS,
    PAUSE_NS,
)
from skin_host.evaluation.simulate.world import Life, World


class Fingertips:
    """Compares what fingertips report with their loads.

    Args:
        world: to watch.
        accusations: knows which zeros may be of a load, and which frames are damaged.
    """

    def __init__(self, world: World, accusations: Accusations) -> None:
        self._world, self._accusations = world, accusations
        #: When each was last loaded, and was not loaded firmly.
        self._loaded_ns = dict.fromkeys(world.settings.fingertips, LONG_AGO_NS)
        self._eased_ns = dict.fromkeys(world.settings.fingertips, LONG_AGO_NS)

    def note_loads(self, life: Life | None) -> None:
        """Note which are loaded, and which zeros may be of a load."""
        now_ns = self._world.clock.monotonic_ns()
        tips = self._world.robot.fingertips
        calibrating = life is not None and life.daemon.engine.calibrating
        for name in self._loaded_ns:
            force_n = float(np.linalg.norm(tips.force_n(name, now_ns)))
            if force_n > LOADED_N:
                self._loaded_ns[name] = now_ns
            if force_n < FELT_N:
                self._eased_ns[name] = now_ns
            if calibrating and now_ns - self._loaded_ns[name] < NS:
                self._accusations.loaded.add(name)

    def wrong(self, life: Life) -> str | None:
        """Return one that is touched without a load, or is not touched with one, or None."""
        clock = self._world.clock
        now_ns = clock.monotonic_ns()
        engine = life.daemon.engine.fingertips
        for name, state in ({} if engine is None else engine.tips).items():
            if name in self._accusations.loaded or self._accusations.may_damage(name):
                continue
            # What it sent lately waits to be read after a stall.
            if not state.tip.feels or abs(clock.now_ns() - state.last_ns) > NS // 2:
                continue
            if state.tip.touched and now_ns - self._loaded_ns[name] > CAUSE_NS:
                return f"{name}: still touched, and nothing presses"
            threshold_n = state.tip.threshold_n
            if not state.tip.touched and now_ns - self._eased_ns[name] > PAUSE_NS:
                return f"{name}: not touched while it is pressed, from {threshold_n:.2f} N on"
        return None
