"""Every frame and every event of a life is accounted for."""

from collections.abc import Mapping, Sequence
from typing import Any

from skin_host.evaluation.simulate.promises.limits import SLACK
from skin_host.evaluation.simulate.world import Life, World


class Accounts:
    """What one life of the daemon put, and what its counters must show of it."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._bus_of_board = [board.settings.bus for board in world.layout.boards]
        #: Frames in the sweeps of each bus.
        self._swept: dict[str, int] = {}
        self._put = 0

    def begin(self) -> None:
        """A life begins."""
        self._swept = dict.fromkeys(self._world.cables, 0)
        self._put = 0

    def note_sweeps(self, sweeps: Sequence[Any]) -> None:
        """These came out of the core together."""
        for sweep in sweeps:
            self._swept[self._bus_of_board[sweep.board]] += 2 * sweep.present.bit_count()

    def note_event(self) -> None:
        """A touch event was put."""
        self._put += 1

    def wrong(
        self, life: Life, counts: Mapping[str, Mapping[int, bytes]], clock_set_ns: int
    ) -> str | None:
        """Return what is not accounted for in a life, or None.

        Args:
            life: the daemon's, not killed.
            counts: by topic the events that a subscriber got in it, by their counts.
            clock_set_ns: when the time of day was last set.
        """
        daemon = life.daemon
        for name, port in daemon.link.ports.items():
            fate = self._world.cables[name].fate
            counters = port.counters
            if counters.frames != fate.read or counters.dropped != fate.dropped:
                return (
                    f"bus {name}: {fate.read} frames were read and {fate.dropped} dropped; counted "
                    f"are {counters.frames} and {counters.dropped}"
                )
            assembler = daemon.engine.assemblers[name]
            if assembler.counters.frames != counters.frames:
                return (
                    f"bus {name}: {assembler.counters.frames} of {counters.frames} frames were "
                    "taken"
                )
            hidden = fate.forgotten + (fate.dropped if clock_set_ns >= life.began_ns else 0)
            wrong = self._wrong_frames(name, assembler) or self._wrong_sweeps(
                life, name, assembler.counters, hidden
            )
            if wrong is not None:
                return wrong
        return self._wrong_events(life, counts)

    def _wrong_frames(self, bus: str, assembler: Any) -> str | None:
        """Each frame is in a sweep, waits to be, or is counted."""
        counters = assembler.counters
        states = assembler._states.values()
        waiting = sum(
            (state.awaited & ~state.missing).bit_count() for state in states if state.missing
        )
        # A lone frame of the last sweep waits for its other half.
        waiting += sum(state.lone.bit_count() for state in states)
        told = (
            counters.other
            + counters.force_torque
            + counters.wrong_header
            + counters.short
            + counters.unknown_board
            + counters.unknown_triangle
            + counters.late
            + counters.doubled
            + counters.halves
        )
        if counters.frames == told + self._swept[bus] + waiting:
            return None
        return (
            f"bus {bus}: {counters.frames} frames came; {self._swept[bus]} are in sweeps, "
            f"{waiting} wait, {told} are counted otherwise"
        )

    def _wrong_sweeps(self, life: Life, bus: str, counters: Any, hidden: int) -> str | None:
        """Each sweep came or is counted as missed, until the daemon was asked to end.

        Args:
            life, bus, counters: whose.
            hidden: frames of which nothing shows how many sweeps they were: those that waited when
                their adapter was unplugged, after which none may come; and those that were dropped
                in a life in which the clock was set back.
        """
        bursts = (life.sent_before_end or {}).get(bus, self._world.cables[bus].sent.bursts)
        layout = self._world.layout
        known = {board.settings.address for board in layout.boards}
        sent = sum(count - SLACK for address, count in bursts.items() if address in known)
        boards = [one for one in layout.boards if one.settings.bus == bus]
        came = counters.sweeps + counters.missed
        came += hidden // (2 * min((len(one.triangles) for one in boards), default=1))
        if sent <= came:
            return None
        return f"bus {bus}: {sent} sweeps were sent; {came} came or are counted as missed"

    def _wrong_events(self, life: Life, counts: Mapping[str, Mapping[int, bytes]]) -> str | None:
        known = life.daemon.publisher.counters
        waiting = sum(
            1
            for event in life.daemon.publisher._outbox.events
            if event.is_touch  # what waits at the end was counted as dropped
        )
        kept = known.touches_sent + known.touches_dropped + known.moves_replaced
        kept += 0 if life.task.done() else waiting
        if self._put != kept:
            return f"{self._put} touch events were put, {kept} are accounted for"
        gaps = sum(max(seen, default=0) - len(seen) for seen in counts.values())
        if gaps > known.touches_dropped + waiting:
            return f"{gaps} counts are missing, {known.touches_dropped} events were dropped"
        got = sum(len(seen) for seen in counts.values())
        if got < known.touches_sent:
            return f"{known.touches_sent} events were acknowledged, {got} arrived"
        return None
