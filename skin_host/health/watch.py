"""What passes through the daemon, noted: who was heard when, and what counters gained.

Every time is on the clock of the frames' time stamps, and tells what had been read by then:
while nobody looks (a stopped process, a suspended computer) nobody grows silent.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.assembler import Sweep
from skin_host.bus.boards import Boards
from skin_host.bus.port import Port
from skin_host.bus.protocol import TRIANGLES, status_error
from skin_host.engine import Engine, Step

#: Rates are means over about this time.
RATE_S = 2.0
#: What is told of "the last second".
RECENT_NS = 1_000_000_000
#: After a longer pause between two looks, or a step of the clock, silence is measured anew.
LONGEST_PAUSE_NS = 1_000_000_000
#: Taken for the period of a bus without boards of skin: its force/torque boards are faster.
ALONE_NS = 50_000_000
#: Intervals that are enough to judge a board's period.
PERIOD_SWEEPS = 16
_TRIANGLES = np.arange(TRIANGLES)


@dataclass(slots=True)
class PartWatch:
    """What became of a part's samples; the arrays are those of the last one."""

    last_ns: int = 0
    frames: int = 0
    rate_hz: float = 0.0
    rate_since_ns: int = 0
    rate_frames: int = 0
    valid: NDArray[np.bool_] | None = None
    beyond: NDArray[np.bool_] | None = None
    raw: NDArray[np.uint8] | None = None

    def note(self, step: Step) -> None:
        """A sample that was processed."""
        frame = step.frame
        if frame.valid.any():
            self.last_ns = frame.t_ns
            self.frames += 1
            self.rate_frames += 1
        self.valid = frame.valid
        self.beyond = frame.beyond_range
        self.raw = frame.raw
        if not self.rate_since_ns:
            self.rate_since_ns = frame.t_ns
            self.rate_frames = 0
        elapsed_s = (frame.t_ns - self.rate_since_ns) * 1e-9
        if elapsed_s >= RATE_S or elapsed_s < 0.0:
            self.rate_hz = self.rate_frames / elapsed_s if elapsed_s > 0.0 else 0.0
            self.rate_since_ns = frame.t_ns
            self.rate_frames = 0


@dataclass(slots=True)
class BoardWatch:
    """What came of a board.

    Attributes:
        sweep: the last one.
        heard_ns: when it came, or when silence began to be measured anew.
        silent: nothing has come since for too long.
        absent: int64[16], in how many sweeps in a row each triangle has been missing.
        error: uint8[16], the last error of each triangle that has not shown since that it lives.
        events, event_ns: counters of rare events, and when they last rose.
    """

    silent_after_ns: int
    sweep: Sweep | None = None
    sweeps: int = 0
    heard_ns: int = 0
    silent: bool = False
    times_ns: deque[int] = field(default_factory=lambda: deque(maxlen=PERIOD_SWEEPS + 1))
    absent: NDArray[np.int64] = field(default_factory=lambda: np.zeros(TRIANGLES, np.int64))
    error: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(TRIANGLES, np.uint8))
    events: dict[str, int] = field(default_factory=dict)
    event_ns: dict[str, int] = field(default_factory=dict)

    @property
    def alive(self) -> bool:
        """It sends."""
        return self.sweep is not None and not self.silent

    def note(self, sweep: Sweep, unproven: NDArray[np.bool_]) -> None:
        """A sweep that came; bool[16] says which triangles have yet to show that they live."""
        self.sweep = sweep
        self.sweeps += 1
        self.heard_ns = sweep.t_ns
        self.silent = False
        if self.times_ns and not 0 < sweep.t_ns - self.times_ns[-1] < LONGEST_PAUSE_NS:
            self.times_ns.clear()  # a pause, or the clock was set: no period
        self.times_ns.append(sweep.t_ns)
        here = sweep.present >> _TRIANGLES & 1
        self.absent = (self.absent + 1) * (here == 0)
        if sweep.status.any() or self.error.any():
            error = status_error(sweep.status)
            np.copyto(self.error, error, where=(error != 0) | ~unproven)

    def note_events(self, counts: dict[str, int], now_ns: int) -> None:
        """See which counters have risen."""
        for name, count in counts.items():
            if count > self.events.get(name, 0):
                self.event_ns[name] = now_ns
            self.events[name] = count


@dataclass(slots=True)
class BusWatch:
    """What came of a bus: the last count of frames, and what all counters gained lately.

    Attributes:
        gained: in about the last second, with its true length under "seconds"; empty before
            the first look.
    """

    silent_after_ns: int
    frames: int = -1
    heard_ns: int = 0
    silent: bool = False
    gained: dict[str, float] = field(default_factory=dict)
    _past: deque[tuple[int, dict[str, int]]] = field(default_factory=deque)

    def note(self, now_ns: int, totals: dict[str, int]) -> None:
        """Take in all counters."""
        if totals["frames"] != self.frames:
            self.frames = totals["frames"]
            self.heard_ns = now_ns
            self.silent = False
        past = self._past
        if past and now_ns < past[-1][0]:
            past.clear()  # the clock was set back
        past.append((now_ns, totals))
        while len(past) > 2 and now_ns - past[1][0] >= RECENT_NS:
            past.popleft()
        then_ns, before = past[0]
        self.gained = {key: totals[key] - before[key] for key in totals}
        self.gained["seconds"] = (now_ns - then_ns) * 1e-9


class Watch:
    """Watches an engine, its ports and its boards.

    Attributes:
        parts, boards: by index in the layout.
        buses: by name.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._looked_ns = 0
        periods = engine.settings.receive.silent_periods
        period_ns = {
            board: engine.layout.boards[board].settings.period_ms * 1_000_000
            for board in engine.boards
        }
        self.parts = {part: PartWatch() for part in engine.parts}
        self.boards = {
            board: BoardWatch(int(periods * period_ns[board])) for board in engine.boards
        }
        self.buses = {
            bus: BusWatch(
                int(periods * max((period_ns[i] for i in self._boards_of(bus)), default=ALONE_NS))
            )
            for bus in engine.assemblers
        }

    def note_sweeps(self, sweeps: list[Sweep]) -> None:
        """Sweeps that came."""
        for sweep in sweeps:
            unproven = self._engine.liveness[sweep.board].unproven
            self.boards[sweep.board].note(sweep, unproven)

    def note_step(self, step: Step) -> None:
        """A sample that was processed."""
        self.parts[step.part].note(step)

    def tick(self, now_ns: int, ports: dict[str, Port], boards: dict[str, Boards]) -> None:
        """Look at all counters; to be called some times a second."""
        for bus, bus_watch in self.buses.items():
            bus_watch.note(now_ns, self._totals(bus, ports.get(bus)))
        for index, watch in self.boards.items():
            watch.note_events(self._events(index, watch, boards), now_ns)
        watches: list[BusWatch | BoardWatch] = [*self.buses.values(), *self.boards.values()]
        if not 0 <= now_ns - self._looked_ns <= LONGEST_PAUSE_NS:
            for one in watches:
                one.heard_ns = now_ns
        self._looked_ns = now_ns
        for one in watches:
            one.silent |= now_ns - one.heard_ns > one.silent_after_ns

    def _totals(self, bus: str, port: Port | None) -> dict[str, int]:
        counters = self._engine.assemblers[bus].counters
        return {
            "frames": counters.frames,
            "sweeps": counters.sweeps,
            "other": counters.other,
            "wrong": counters.wrong_header + counters.short,
            "halves": counters.halves,
            "missed": counters.missed,
            "unknown": counters.unknown_board + counters.unknown_triangle,
            "spikes": sum(int(self._engine.liveness[i].spikes) for i in self._boards_of(bus)),
            "dropped": 0 if port is None else port.counters.dropped,
            "error_frames": 0 if port is None else port.counters.error_frames,
        }

    def _events(self, index: int, watch: BoardWatch, boards: dict[str, Boards]) -> dict[str, int]:
        events = {"rezeros": self._engine.rezeros[index]}
        settings = self._engine.layout.boards[index].settings
        manager = boards.get(settings.bus)
        if manager is not None:
            known = manager.records[settings.address]
            events |= {
                "resets": known.resets,
                "lost_set_ups": known.lost_set_ups,
                "tx_overflows": known.tx_overflows,
            }
            if known.configurations <= 1 and not watch.sweeps:
                watch.events["rezeros"] = events["rezeros"]  # everyone's first zero is no event
        return events

    def _boards_of(self, bus: str) -> list[int]:
        layout = self._engine.layout
        return [i for i in self._engine.boards if layout.boards[i].settings.bus == bus]
