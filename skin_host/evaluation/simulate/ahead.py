"""The emulated robot, some time ahead of whoever looks at it.

Sweep after sweep a robot costs a third of what it does between turns of a daemon, whose code is
another. So while nothing acts on it, it lives a while ahead, and what its boards send waits. If
something does act on it, it goes back to the present: then it is as if it had never been ahead.
"""

from bisect import bisect_right
from collections import deque

import numpy as np
from numpy.typing import NDArray

from emulator.boards.board import join
from emulator.rewind import Mark
from emulator.robot import NS, Robot
from emulator.wire import NOTHING
from skin_host.bus.wire import FrameBatch

#: How far ahead it lives: what acts on it comes seldom alone, so that is little at first, from some
#: time after it on, and doubles each time.
REST_NS = 40_000_000
LEAST_NS, MOST_NS = 100_000_000, 400_000_000


class Ahead:
    """Lets a robot live ahead.

    Args:
        robot: the robot; nobody else calls its `step`.

    Attributes:
        t_ns: the present.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.t_ns = robot.t_ns
        self._acted_ns = self.t_ns
        self._ahead_ns = LEAST_NS
        self._mark: Mark | None = None
        #: By bus, what was sent in the future.
        self._frames: dict[str, deque[FrameBatch]] = {name: deque() for name in robot.wires}
        #: True pressures of now and later, and their times.
        self._felt: list[tuple[int, NDArray[np.float64]]] = []
        robot.before_input = self._go_back

    def move_to(self, t_ns: int) -> dict[str, FrameBatch]:
        """Let time pass; return, by bus, the frames that passed meanwhile."""
        robot = self._robot
        self.t_ns = t_ns
        if self._mark is not None and t_ns <= robot.t_ns:
            return {name: self._passed(name) for name in self._frames}
        frames = {}
        if self._mark is not None:
            frames = {name: self._passed(name) for name in self._frames}
            self._forget()
        later = robot.step((t_ns - robot.t_ns) / NS)
        if frames:
            later = {name: join([frames[name], batch]) for name, batch in later.items()}
        if t_ns - self._acted_ns >= REST_NS and robot.is_steady:
            self._live_ahead()
        return later

    def true_pressure_kpa(self) -> NDArray[np.float64]:
        """True pressure on each taxel now, float64[n]: mean over the pad (kPa)."""
        if self._mark is None:
            return self._robot.skin.true_pressure_kpa()
        return self._felt[bisect_right(self._felt, self.t_ns, key=lambda one: one[0]) - 1][1]

    def _live_ahead(self) -> None:
        robot = self._robot
        self._mark = robot.mark()
        self._felt = robot.felt = [(self.t_ns, robot.skin.true_pressure_kpa())]
        end_ns = self.t_ns + self._ahead_ns
        self._ahead_ns = min(2 * self._ahead_ns, MOST_NS)
        while robot.t_ns < end_ns:
            sweep = robot.sweep(end_ns)
            if sweep is not None:
                self._frames[sweep[0]].append(sweep[1])
                continue
            sent = robot.step((min(end_ns, robot.next_ns) - robot.t_ns) / NS)
            for name, batch in sent.items():
                if len(batch):
                    self._frames[name].append(batch)
        robot.felt = None

    def _go_back(self) -> None:
        """Something is about to act on the robot."""
        self._acted_ns = self.t_ns
        self._ahead_ns = LEAST_NS
        mark = self._mark
        if mark is None:
            return
        self._forget()
        self._robot.go_back(mark)
        # What is sent until now has passed already.
        self._robot.step((self.t_ns - self._robot.t_ns) / NS)

    def _forget(self) -> None:
        self._mark = None
        for frames in self._frames.values():
            frames.clear()

    def _passed(self, name: str) -> FrameBatch:
        """The frames of a bus that have passed by now."""
        waiting, passed = self._frames[name], []
        while waiting and waiting[0].t_ns[-1] <= self.t_ns:
            passed.append(waiting.popleft())
        if waiting and waiting[0].t_ns[0] <= self.t_ns:
            part = waiting.popleft()
            n = int(part.t_ns.searchsorted(self.t_ns, side="right"))
            passed.append(_rows(part, slice(n)))
            waiting.appendleft(_rows(part, slice(n, None)))
        return join(passed) if passed else NOTHING


def _rows(batch: FrameBatch, rows: slice) -> FrameBatch:
    return FrameBatch(batch.id[rows], batch.dlc[rows], batch.data[rows], batch.t_ns[rows])
