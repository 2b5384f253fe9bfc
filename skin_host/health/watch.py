"""Notes when each part and bus last sent, and how the counters grow.

All times are on the clock of the frames' time stamps and mean "everything received up to then has
been read": while nothing is read (a stopped process, a suspended computer) nothing times out.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from skin_host.layout import TAXELS_PER_TRIANGLE
from skin_host.processing.core import Engine, Output, Step
from skin_host.processing.frame import PressureFrame
from skin_host.processing.masks import Mask, any_of, count_of

if TYPE_CHECKING:
    from skin_host.bus.boards import Boards
    from skin_host.bus.port import Port

#: Rates are means over about this time.
RATE_S = 2.0
#: Length of "the last second" in records.
RECENT_NS = 1_000_000_000
#: A pad that was off for one sweep counts for its bus for so long.
SPIKED_NS = 10_000_000_000
#: A bus without skin boards is silent after this long: force/torque boards send often.
ALONE_NS = 200_000_000
#: Foam that was pressed pushes for so long that a pad reads too much, as drift's `SETTLE_S`.
FOAM_NS = 5_000_000_000
#: What is watched of the counters of a port.
_OF_PORT = ("damaged", "dropped", "controller_overflows", "error_frames")


@dataclass(slots=True)
class PartWatch:
    """Counters of a part's samples, and arrays of the last sample.

    Attributes:
        late_samples: a triangle that was not received for fewer samples in a row is only late.
        lost: int64[k], for how many samples in a row each triangle was not received; None if all
            were.
        touched: bool[m], taxels that are touched, since `touched_ns` was renewed.
        touched_ns: when each taxel [m] was last touched before; None if none ever was.
        sample_ns: time stamp of the last sample.
        elapsed_ns: `PressureFrame.elapsed_ns` of it, as `touched_ns` and `rate_since_ns`.
        late: bool[m], taxels that are late and were valid before.
        doubted: bool[16 b, 12], pads that were in doubt after the last sample but one, and after
            the last one: its own doubts are between them.
    """

    late_samples: int
    last_ns: int = 0
    frames: int = 0
    rate_hz: float = 0.0
    rate_since_ns: int | None = None
    rate_frames: int = 0
    valid: NDArray[np.bool_] | None = None
    touched: NDArray[np.bool_] | None = None
    touched_ns: NDArray[np.int64] | None = None
    any_valid: bool = False
    any_touched: bool = False
    beyond: NDArray[np.bool_] | None = None
    raw: NDArray[np.uint8] | None = None
    lost: NDArray[np.int64] | None = None
    late: NDArray[np.bool_] | None = None
    doubted: tuple[Mask | None, Mask | None] = (None, None)
    sample_ns: int = 0
    elapsed_ns: int = 0

    def note(self, step: Step, doubted: Mask | None) -> None:
        """Take in a processed sample, with the pads that are in doubt now."""
        frame = step.frame
        self.doubted = self.doubted[1], doubted
        # The same masks as in the sample before are mostly the same objects.
        if frame.valid is not self.valid:
            self.any_valid = any_of(frame.valid)
        if self.any_valid:
            self.last_ns = frame.t_ns
            self.frames += 1
            self.rate_frames += 1
        self._note_lost(frame)
        self.valid = frame.valid
        if frame.touched is not self.touched:
            self._note_touched()
            self.touched = frame.touched
            self.any_touched = any_of(frame.touched)
        self.sample_ns, self.elapsed_ns = frame.t_ns, frame.elapsed_ns
        self.beyond = frame.beyond_range
        self.raw = frame.raw
        if self.rate_since_ns is None:
            self.rate_since_ns = frame.elapsed_ns
            self.rate_frames = 0
        elapsed_s = (frame.elapsed_ns - self.rate_since_ns) * 1e-9
        if elapsed_s >= RATE_S:
            self.rate_hz = self.rate_frames / elapsed_s
            self.rate_since_ns = frame.elapsed_ns
            self.rate_frames = 0

    def rests(self) -> Mask | None:
        """Return the valid taxels, bool[m], that nothing touches and no foam still pushes."""
        self._note_touched()
        if self.valid is None or self.touched_ns is None:
            return self.valid
        rests: Mask = self.valid & (self.elapsed_ns - self.touched_ns >= FOAM_NS)
        return rests

    def _note_touched(self) -> None:
        """Note until when the touched taxels of the last samples were touched."""
        if self.touched is None or not self.any_touched:
            return
        if self.touched_ns is None:
            self.touched_ns = np.full(len(self.touched), -FOAM_NS, np.int64)
        self.touched_ns[self.touched] = self.elapsed_ns

    def _note_lost(self, frame: PressureFrame) -> None:
        # Where nothing was received there is 0. A sample of nothing reports silence.
        if 0 not in frame.raw.tobytes() or not frame.raw.any() or self.valid is None:
            self.lost = self.late = None
            return
        lost = np.logical_not(frame.raw.reshape(-1, TAXELS_PER_TRIANGLE).any(axis=1))
        count = np.zeros(lost.shape, np.int64) if self.lost is None else self.lost
        self.lost = np.where(lost, count + 1, 0)
        late = np.repeat(lost & (self.lost < self.late_samples), TAXELS_PER_TRIANGLE)
        self.late = late & (self.valid if self.late is None else self.valid | self.late)


@dataclass(slots=True)
class BoardWatch:
    """Counters of rare events of a board, and when they last rose."""

    events: dict[str, int] = field(default_factory=dict)
    event_ns: dict[str, int] = field(default_factory=dict)

    def note(self, counts: dict[str, int], now_ns: int) -> None:
        """Note which counters have risen."""
        for name, count in counts.items():
            if count > self.events.get(name, 0):
                self.event_ns[name] = now_ns
            self.events[name] = count


class Window:
    """What counters gain in about the last `span_ns`."""

    def __init__(self, span_ns: int) -> None:
        self._span_ns = span_ns
        self._past: deque[tuple[int, dict[str, int]]] = deque()

    def note(self, now_ns: int, totals: dict[str, int]) -> dict[str, float]:
        """Take in all counters; return their gains, with the true length under "seconds"."""
        past = self._past
        if past and now_ns < past[-1][0]:
            past.clear()  # the clock was set back
        past.append((now_ns, totals))
        while len(past) > 2 and now_ns - past[1][0] >= self._span_ns:
            past.popleft()
        then_ns, before = past[0]
        gained: dict[str, float] = {key: totals[key] - before[key] for key in totals}
        return gained | {"seconds": (now_ns - then_ns) * 1e-9}


@dataclass(slots=True)
class BusWatch:
    """The last frame count of a bus, and what all its counters gained in the last second.

    Attributes:
        gained: in about the last second, see `Window`; empty before the first call of `note`.
        spiked_pads: how many of its pads were off for one sweep within `SPIKED_NS`.
        lost_ns: when this computer, or its controller, was last seen to have lost frames.
        received_ns: when a frame was last received, on the ledger's clock.
    """

    frames: int = -1
    received_ns: int = 0
    silent: bool = False
    spiked_pads: int = 0
    lost_ns: int | None = None
    gained: dict[str, float] = field(default_factory=dict)
    _window: Window = field(default_factory=lambda: Window(RECENT_NS))

    def note(
        self,
        now_ns: int,
        ledger_ns: int,
        totals: dict[str, int],
        *,
        silent_after_ns: int,
        awaited: bool = False,
    ) -> None:
        """Take in all counters, with the time of the time stamps and of the ledger.

        Without a frame for longer than `silent_after_ns` a bus is silent; not while none of its
        boards has had the time to send (`awaited`).
        """
        if totals["frames"] != self.frames:
            self.frames = totals["frames"]
            self.received_ns = ledger_ns
        self.silent = ledger_ns - self.received_ns > silent_after_ns and not awaited
        self.gained = self._window.note(now_ns, totals)
        if self.gained.get("dropped") or self.gained.get("overflows"):
            self.lost_ns = now_ns

    def lost_here(self, now_ns: int) -> bool:
        """Whether what is missing now, or until a moment ago, was lost in this computer."""
        return self.lost_ns is not None and abs(now_ns - self.lost_ns) < RECENT_NS


class Watch:
    """Watches an engine, its ports and its boards.

    Attributes:
        parts, boards: by index in the layout.
        buses: by name.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        periods = engine.settings.receive.silent_periods
        #: By then a board that sends nothing has timed out.
        late_samples = int(periods) + 1
        self.parts = {part: PartWatch(late_samples) for part in engine.parts}
        self.boards = {board: BoardWatch() for board in engine.boards}
        self.buses = {bus: BusWatch() for bus in engine.assemblers}
        self._noted: tuple[object, ...] = ()
        #: Spikes of each pad [16 b, 12], and when they were last seen to rise.
        self._spikes = engine.intake.liveness.spikes.copy()
        self._spiked_ns = np.full(self._spikes.shape, -SPIKED_NS)
        ledger_row = engine.ledger.row
        self._rows = {
            bus: np.array([ledger_row[i] for i in self._boards_of(bus)], np.intp)
            for bus in engine.assemblers
        }

    def use(self, engine: Engine) -> None:
        """Continue with another engine, after a reload."""
        self._engine = engine

    def note(self, output: Output) -> None:
        """Take in one output of the core."""
        for step in output.steps:
            self.parts[step.part].note(step, self._engine.intake.liveness.doubted)

    def tick(self, now_ns: int, ports: dict[str, "Port"], boards: dict[str, "Boards"]) -> None:
        """Read all counters; to be called several times a second."""
        ledger = self._engine.ledger
        spiked_pads = self._spiked_pads(now_ns)
        for bus, bus_watch in self.buses.items():
            rows = self._rows[bus]
            bus_watch.spiked_pads = int(spiked_pads[rows].sum())
            bus_watch.note(
                now_ns,
                ledger.now_ns,
                self._totals(bus, ports.get(bus)),
                silent_after_ns=max(ledger.silent_after_ns[rows].tolist(), default=ALONE_NS),
                awaited=bus in boards and boards[bus].awaits_all,
            )
        counts = self._counts()
        if counts == self._noted:
            return
        self._noted = counts
        for index, watch in self.boards.items():
            watch.note(self._events(index, watch, boards), now_ns)

    def _spiked_pads(self, now_ns: int) -> NDArray[np.intp]:
        """Return how many pads of each board [b] were off for one sweep lately. Damage strikes any
        pad; one that jumps again and again is not well itself, and counts once.
        """
        spikes = self._engine.intake.liveness.spikes
        if spikes.tobytes() != self._spikes.tobytes():
            self._spiked_ns[spikes > self._spikes] = now_ns
            self._spikes = spikes.copy()
        lately = np.abs(now_ns - self._spiked_ns) < SPIKED_NS
        return count_of(lately.reshape(len(self._engine.boards), -1))

    def _counts(self) -> tuple[object, ...]:
        """Return all that the boards are watched for: it rarely changes."""
        ledger = self._engine.ledger
        events = (
            ledger.rezeros,
            ledger.resets,
            ledger.lost_set_ups,
            ledger.tx_overflows,
            ledger.excess,
        )
        return tuple(counts.tobytes() for counts in events)

    def _totals(self, bus: str, port: "Port | None") -> dict[str, int]:
        assembler = self._engine.assemblers[bus]
        counters = assembler.counters
        of_port = {one: 0 if port is None else getattr(port.counters, one) for one in _OF_PORT}
        return {
            "frames": counters.frames,
            "sweeps": counters.sweeps,
            "other": counters.other,
            "elsewhere": assembler.elsewhere,
            "wrong": counters.wrong_header + counters.short + of_port["damaged"],
            "halves": counters.halves,
            "missed": counters.missed,
            "unknown": counters.unknown_board + counters.unknown_triangle,
            "unconfigured": counters.unknown_board,
            "spikes": self._spikes_of(bus),
            "dropped": of_port["dropped"],
            "overflows": of_port["controller_overflows"],
            "error_frames": of_port["error_frames"],
        }

    def _spikes_of(self, bus: str) -> int:
        of_boards = self._spikes.reshape(len(self._engine.boards), -1)
        return int(of_boards[self._rows[bus]].sum())

    def _events(self, index: int, watch: BoardWatch, boards: dict[str, "Boards"]) -> dict[str, int]:
        ledger = self._engine.ledger
        row = ledger.row[index]
        events = {"rezeros": int(ledger.rezeros[row]), "excess": int(ledger.excess[row])}
        settings = self._engine.layout.boards[index].settings
        manager = boards.get(settings.bus)
        if manager is not None:
            known = manager.records[settings.address]
            events |= {
                "resets": int(ledger.resets[row]),
                "lost_set_ups": int(ledger.lost_set_ups[row]),
                "tx_overflows": int(ledger.tx_overflows[row]),
            }
            if known.configurations <= 1 and not ledger.sweeps[row]:
                watch.events["rezeros"] = events["rezeros"]  # a first zero is no event
        return events

    def _boards_of(self, bus: str) -> list[int]:
        layout = self._engine.layout
        return [i for i in self._engine.boards if layout.boards[i].settings.bus == bus]
