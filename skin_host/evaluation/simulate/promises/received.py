"""What is reported as valid was received: lately, in one sweep, of a chip that answers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import TAXELS, TRIANGLES
from skin_host.evaluation.simulate.promises.limits import (
    FRESH_NS,
    FRESH_PERIODS,
    LONG_AGO_NS,
    NS,
    STALE_PERIODS,
    WAITED_NS,
    WRONG_NS,
    Mask,
)
from skin_host.evaluation.simulate.world import World
from skin_host.layout import Layout
from skin_host.processing.frame import PressureFrame


@dataclass(frozen=True, slots=True)
class _Run:
    """Triangles of a part that their board sends one after the other.

    Attributes:
        bus, period_ns: of the board.
        keys: address and number of each.
        start, stop: taxels of the part.
    """

    bus: str
    period_ns: int
    keys: tuple[int, ...]
    start: int
    stop: int


def _runs(layout: Layout, first: int, last: int) -> list[_Run]:
    """Return the triangles of the part that has these taxels."""
    runs: list[_Run] = []
    for one in layout.triangles:
        board = layout.boards[one.board]
        start = int(board.taxel_index[one.number].min())
        if not first <= start < last:
            continue
        own = board.settings
        key = own.address * TRIANGLES + one.number
        begin, stop = start - first, start - first + TAXELS
        before = runs[-1] if runs else None
        goes_on = (
            before is not None
            and before.bus == own.bus
            and before.stop == begin
            and before.keys[-1] < key < (own.address + 1) * TRIANGLES
            and before.keys[-1] // TRIANGLES == own.address
        )
        if before is not None and goes_on:
            keys = (*before.keys, key)
            runs[-1] = _Run(own.bus, before.period_ns, keys, before.start, stop)
        else:
            runs.append(_Run(own.bus, own.period_ms * 1_000_000, (key,), begin, stop))
    return runs


class Received:
    """Compares frames with what was sent on the buses, and when it was read.

    Attributes:
        clock_set_ns, stalled_ns: when the time of day was last set, and the last stall ended.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self.clock_set_ns = self.stalled_ns = LONG_AGO_NS
        layout = world.layout
        self._parts = {part.name: part for part in layout.parts}
        self._periods_ns = np.zeros(layout.n_taxels, np.int64)
        ids = np.zeros(layout.n_taxels, np.int64)
        buses = np.empty(layout.n_taxels, object)
        for board in layout.boards:
            own = board.settings
            for number in board.triangles:
                taxels = board.taxel_index[number]
                taxels = taxels[taxels >= 0]
                self._periods_ns[taxels] = own.period_ms * 1_000_000
                ids[taxels] = 0x400 | own.address << 4 | number
                buses[taxels] = own.bus
        #: Of the whole skin (None) and of each part: on which bus which of the taxels are sent, and
        #: by which identifiers.
        self._senders: dict[str | None, list[tuple[str, Mask, NDArray[np.int64]]]] = {
            name: [(bus, buses[mine] == bus, ids[mine][buses[mine] == bus]) for bus in world.cables]
            for name, mine in [
                (None, slice(None)),
                *((part.name, slice(part.start, part.stop)) for part in layout.parts),
            ]
        }
        #: Of each part, on which bus which identifiers are sent.
        self._ids = {
            part.name: [
                (bus, np.unique(of_bus))
                for bus, _, of_bus in self._senders[part.name]
                if of_bus.size
            ]
            for part in layout.parts
        }
        #: Of each part the triangles that a board sends one after the other.
        self._runs = {part.name: _runs(layout, part.start, part.stop) for part in layout.parts}
        #: The least period of the boards of each part.
        self._fastest_ns = {
            part.name: int(self._periods_ns[part.start : part.stop].min()) for part in layout.parts
        }

    def last_ns(self, part: str | None = None) -> NDArray[np.int64]:
        """Return when each taxel of a part, or of the whole skin, was last received (ns)."""
        senders = self._senders[part]
        found = np.full(len(senders[0][1]), LONG_AGO_NS, np.int64)
        for bus, mine, ids in senders:
            found[mine] = self._world.cables[bus].read_ns[ids]
        return found

    def stale(self, frame: PressureFrame) -> str | None:
        """Return that a taxel is valid whose board has been silent for long."""
        name = frame.part
        now_ns = self._world.clock.monotonic_ns()
        if now_ns - self.stalled_ns < NS:
            # What waited in a stall is read piece by piece, and is of its time.
            now_ns -= max(0, self._world.clock.now_ns() - frame.t_ns)
        cables = self._world.cables
        longest_ago_ns = min(int(cables[bus].read_ns[ids].min()) for bus, ids in self._ids[name])
        if now_ns - longest_ago_ns <= STALE_PERIODS * self._fastest_ns[name]:
            return None
        part = self._parts[name]
        age_ns = now_ns - self.last_ns(name)
        old = frame.valid & (age_ns > STALE_PERIODS * self._periods_ns[part.start : part.stop])
        if not old.any():
            return None
        taxel = int(np.flatnonzero(old)[0])
        return f"taxel {taxel} is valid, and its board last sent {age_ns[taxel] / NS:.2f} s ago"

    def untraced(self, frame: PressureFrame, valid: bytes) -> str | None:
        """Return that the bytes of a triangle with a valid taxel are of no fresh sweep.

        Args:
            frame: of a part.
            valid: its `valid`, a byte for each taxel.
        """
        world = self._world
        raw = frame.raw.tobytes()
        now_ns = world.clock.monotonic_ns()
        clock_was_set = now_ns - self.clock_set_ns < WAITED_NS
        taken_ns = frame.t_ns - (world.clock.now_ns() - now_ns)
        # What waited in stalls was damaged long before it is read.
        passed_ns = now_ns - WAITED_NS if clock_was_set else taken_ns
        for run in self._runs[frame.part]:
            if b"\1" not in valid[run.start : run.stop]:
                continue
            cable = world.cables[run.bus]
            wrong_ns = max(cable.damaged_ns, cable.blurred_ns)
            if cable.mischief.damaged or passed_ns - wrong_ns < WRONG_NS:
                continue
            longest_ns = FRESH_PERIODS * run.period_ns + FRESH_NS
            t_ns = cable.sent.find_together(run.keys, raw[run.start : run.stop])
            if t_ns is not None and (clock_was_set or taken_ns - t_ns <= longest_ns):
                continue
            for at, key in zip(range(run.start, run.stop, TAXELS), run.keys, strict=True):
                address, number = divmod(key, TRIANGLES)
                if b"\1" not in valid[at : at + TAXELS]:
                    continue
                found = "no sweep of it"
                for answered, t_ns in cable.sent.find(address, number, raw[at : at + TAXELS]):
                    age_ns = taken_ns - t_ns
                    if not answered:
                        found = "a chip that did not answer"
                    elif age_ns > longest_ns and not clock_was_set:
                        found = f"a sweep {age_ns / NS:.2f} s before it"
                    else:
                        break
                else:
                    return (
                        f"triangle {address}/{number} of frame {frame.seq} is valid, and its bytes "
                        f"are of {found}"
                    )
        return None
