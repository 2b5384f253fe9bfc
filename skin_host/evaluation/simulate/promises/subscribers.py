"""What the broker keeps and subscribers get: it is what the daemon put, and no lie."""

import msgspec
import numpy as np

from skin_host.evaluation.simulate.promises.limits import (
    EVENTS,
    LONG_AGO_NS,
    NS,
    RETAINED_NS,
    UNKNOWN_NS,
    Mask,
)
from skin_host.evaluation.simulate.world import Life, World


class _Event(msgspec.Struct):
    event: str
    id: int
    count: int


class Subscribers:
    """Compares what left the daemon with what is at the broker.

    Attributes:
        counts: by topic the events that a subscriber got in this life, by their counts.
        wanted: by retained topic what the daemon put last, and when.
        contacts: what each topic of a contact is of.
        stalled_ns: when the computer last began to stall.
        kept: number of the last calibration that the daemon reported as kept, -1 before.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._parts = {part.name: part for part in world.layout.parts}
        self.counts: dict[str, dict[int, bytes]] = {}
        self.wanted: dict[str, tuple[bytes, int]] = {}
        self.contacts: dict[str, str] = {}
        self.stalled_ns = LONG_AGO_NS
        self.kept = -1
        #: Calibrations in the order in which they were taken.
        self._calibrations: list[tuple[str, str]] = []
        self._connected_ns: int | None = None
        self._connection = 0
        #: Since when no taxel of a part has been valid; and since when the broker has kept a wrong
        #: `OFF` of it.
        self._blank_since: dict[str, int] = {}
        self._wrong_since_ns: dict[str, int] = {}

    def begin(self, life: Life) -> None:
        """A life begins."""
        self.counts.clear()
        self.wanted.clear()
        topics = life.daemon.publisher.topics
        self.contacts = {
            topics.part("contact", name): name
            for name in (*self._parts, *self._world.settings.fingertips)
        }
        self._blank_since.clear()
        self._connected_ns = None

    def note_retained(self, topic: str, payload: bytes) -> None:
        """The daemon puts what the broker is to keep."""
        before = self.wanted.get(topic)
        if before is None or before[0] != payload:
            self.wanted[topic] = payload, self._now_ns()

    def note_blank(self, part: str, *, blank: bool) -> None:
        """A frame of a part has no valid taxel, or has one."""
        if blank:
            self._blank_since.setdefault(part, self._now_ns())
        else:
            self._blank_since.pop(part, None)

    # ------------------------------------------------------------------ events

    def hear(self, topic: str, payload: bytes) -> str | None:
        """What a subscriber that is always there gets; return what is wrong with it, or None."""
        if topic.endswith("/replies/operator"):
            self._note_answer(payload)
            return None
        if topic.rpartition("/")[2] not in EVENTS:
            return None
        event = msgspec.json.decode(payload, type=_Event)
        seen = self.counts.setdefault(topic, {})
        before = seen.get(event.count)
        if before is not None:
            return (
                None if before == payload else f"{topic}: two events have the count {event.count}"
            )
        last = max(seen, default=0)
        seen[event.count] = payload
        return (
            f"{topic}: count {event.count} comes first after {last}" if event.count < last else None
        )

    # ------------------------------------------------------------------ calibrations

    def _note_answer(self, payload: bytes) -> None:
        """What the daemon reports as kept is on the disk from then on."""
        answer = msgspec.json.decode(payload)
        result = answer.get("result") or {}
        if answer["ok"] and answer["command"] == "calibrate" and result["kept"]:
            self.note_calibration(result["id"], result["time"])
            self.kept = len(self._calibrations) - 1

    def note_calibration(self, name: str, time: str) -> None:
        """The daemon has this calibration."""
        # Calibrations of the same content, of boards that are not received, have the same id.
        if self._calibrations[-1:] != [(name, time)]:
            self._calibrations.append((name, time))

    def lost_calibration(self, life: Life) -> str | None:
        """A daemon has started; return that it found an earlier calibration than the kept one."""
        found = life.daemon.engine.calibration
        if self.kept < 0:
            return None
        kept = self._calibrations[self.kept][0]
        if found is None:
            return f"calibration {kept} was kept, and there is none at the next start"
        now = found.id, found.time
        if now in set(self._calibrations) - set(self._calibrations[self.kept :]):
            return f"calibration {kept} was kept, and the next start has {found.id}"
        if now not in self._calibrations:
            self.note_calibration(*now)
        return None

    # ------------------------------------------------------------------ what is retained

    def connected(self) -> bool:
        """Return whether the daemon has a connection over which the broker can be up to date."""
        life = self._world.life
        if life is None or life.dead or not life.daemon.publisher.counters.connected:
            self._connected_ns = None
            return False
        if self._world.broker.frozen:
            self._connected_ns = None
            return False
        connections = life.daemon.publisher.counters.connections
        if self._connected_ns is None or self._connection != connections:
            self._connection, self._connected_ns = connections, self._now_ns()
        return True

    def not_kept(self) -> str | None:
        """Return a topic of which the broker keeps something else than the daemon put."""
        assert self._connected_ns is not None
        now_ns = self._now_ns()
        for topic, (payload, put_ns) in self.wanted.items():
            # What was put just before a stall leaves after it.
            if now_ns - max(put_ns, self._connected_ns, self.stalled_ns) < RETAINED_NS:
                continue
            kept = self._world.broker.retained.get(topic)
            if kept != payload:
                return f"{topic}: the broker keeps {kept!r:.60}, put was {payload!r:.60}"
        return None

    def blank_off(self) -> str | None:
        """Return a part of which the broker keeps `OFF` while none of its taxels is valid."""
        assert self._connected_ns is not None
        for name, since_ns in self._blank_since.items():
            long = self._now_ns() - max(since_ns, self._connected_ns) > UNKNOWN_NS
            if long and self._keeps_off(name):
                return f"{name}: the broker keeps OFF, and no taxel is valid"
        return None

    def pressed_off(self, pressed: Mask) -> str | None:
        """Return a part of which the broker keeps `OFF` while some of these taxels are pressed.

        Args:
            pressed: of the whole skin bool[n], for one and a half seconds.
        """
        for name, part in self._parts.items():
            if not self._keeps_off(name) or not np.any(pressed[part.start : part.stop]):
                self._wrong_since_ns.pop(name, None)
            # A chip or a board that has just come back takes some sweeps to decide.
            elif self._now_ns() - self._wrong_since_ns.setdefault(name, self._now_ns()) > NS // 2:
                return f"{name}: the broker keeps OFF, and it has been pressed for 2 s"
        return None

    def _keeps_off(self, part: str) -> bool:
        life = self._world.life
        assert life is not None
        topic = life.daemon.publisher.topics.part("contact", part)
        return self._world.broker.retained.get(topic) == b"OFF"

    def _now_ns(self) -> int:
        return self._world.clock.monotonic_ns()
