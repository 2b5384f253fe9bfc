"""Passes on each message once and in order, though several brokers send it. Pure: takes times.

By the numbers of `mqtt.order`. Messages without them, from a publisher that speaks MQTT 3.1.1,
are passed on as they arrive.
"""

from dataclasses import dataclass, field

from msgspec.structs import replace

from skin_host.client.presence import too_many
from skin_host.fingertip.events import Over, Slip
from skin_host.mqtt.messages import Frame
from skin_host.mqtt.order import Stamp
from skin_host.mqtt.payload import MessageError
from skin_host.processing.events import Touch

Event = Touch | Slip | Over

#: At most this many events of a part wait for an earlier one.
MAX_HELD = 1000
#: Of earlier runs of a part, or what looked like one, so many are known.
MAX_CHAINS = 8
#: Of each kind of retained topics. With 256 parts in 256 nodes there are at most 512 infos: each
#: piece after the first of a node has a part.
MAX_TOPICS = 1000
#: Greater numbers are given up if only smaller ones came for this long: what comes late from an
#: earlier run or over another broker comes sooner.
VANISHED_S = 30.0


@dataclass(slots=True)
class _Chain:
    """Events of one run whose counts followed one another: what was passed on, or over."""

    run: int
    first: int
    last: int

    def holds(self, run: int, count: int) -> bool:
        return run == self.run and self.first <= count <= self.last + MAX_HELD


@dataclass(slots=True)
class _Followed:
    chain: _Chain
    #: Followed before.
    others: list[_Chain] = field(default_factory=list)
    #: Since when only older events came.
    older_s: float | None = None
    #: By count: events that arrived early, and until when they wait for their turn.
    held: dict[int, tuple[Event, float]] = field(default_factory=dict)

    def follow(self, chain: _Chain) -> list[Event]:
        """Follow another run; return what waited for its turn."""
        left = [self.held[count][0] for count in sorted(self.held)]
        self.held.clear()
        self.others = [one for one in [*self.others, self.chain] if one is not chain][-MAX_CHAINS:]
        self.chain = chain
        return left


class EventOrder:
    """Passes events on by run and count.

    Anybody may send an event or a frame with a great number, and a node may have had a clock that
    was ahead. So the greatest number is followed, but not for ever: see `VANISHED_S`.

    Args:
        hold_s: how long an event waits for an earlier one, which may come from another broker.
    """

    def __init__(self, hold_s: float) -> None:
        self._hold_s = hold_s
        self._known: dict[tuple[type, str], _Followed] = {}
        #: By part: the greatest run and number, and since when only smaller ones came.
        self._frames: dict[str, tuple[tuple[int, int], float | None]] = {}

    def run_of(self, event: Event) -> int | None:
        """Return the run that is followed of an event's part and kind; None: there is none yet."""
        known = self._known.get((type(event), event.part))
        return None if known is None else known.chain.run

    def take_frame(self, frame: Frame, run: int | None, now_s: float) -> bool:
        """Return whether a frame is newer than all before; older frames are not waited for."""
        if run is None:
            return True
        number = run, frame.seq
        greatest, older_s = self._frames.get(frame.part, ((0, 0), None))
        newer = number > greatest or _have_vanished(older_s, now_s)
        if newer:
            self._frames[frame.part] = number, None
        elif older_s is None and number < greatest:
            self._frames[frame.part] = greatest, now_s
        return newer

    def take(self, event: Event, run: int | None, now_s: float) -> list[Event]:
        """Take a received event; return the events whose turn it is."""
        if run is None or not event.count:
            return [event]
        key, count = (type(event), event.part), event.count
        known = self._known.get(key)
        if known is None:
            self._known[key] = _Followed(_Chain(run, count, count))
            return [event]
        left: list[Event] = []
        if run > known.chain.run:
            left = known.follow(_Chain(run, 1, 0))
        elif (run, count) <= (known.chain.run, known.chain.last):
            chains = [known.chain, *reversed(known.others)]
            chain = next((one for one in chains if one.holds(run, count)), None)
            if chain is not None and count <= chain.last:
                return []
            if not _have_vanished(known.older_s, now_s):
                known.older_s = now_s if known.older_s is None else known.older_s
                return []
            if chain is not None and count > chain.last + 1:
                # What came meanwhile was passed over, for the sake of greater numbers.
                event = replace(event, missed=count - chain.last - 1)
            left = known.follow(_Chain(run, count, count - 1) if chain is None else chain)
        elif count in known.held:
            return []
        known.older_s = None
        known.held[count] = event, now_s + self._hold_s
        if too_many([waiting for waiting, _ in known.held.values()], MAX_HELD):
            now_s += self._hold_s
        return left + _released(known, now_s)

    def expire(self, now_s: float) -> list[Event]:
        """Return events whose turn it is because earlier ones have not come in time."""
        return [event for known in self._known.values() for event in _released(known, now_s)]


def _have_vanished(older_s: float | None, now_s: float) -> bool:
    return older_s is not None and now_s - older_s > VANISHED_S


def _released(known: _Followed, now_s: float) -> list[Event]:
    found = []
    for count in sorted(known.held):
        event, until_s = known.held[count]
        if count != known.chain.last + 1 and now_s < until_s:
            break
        del known.held[count]
        if known.chain.holds(known.chain.run, count):
            known.chain.last = count
        else:  # no run loses so many at once
            known.others = [*known.others, known.chain][-MAX_CHAINS:]
            known.chain = _Chain(known.chain.run, count, count)
        found.append(event)
    return found


class Newest:
    """Decides which of several retained messages is the newest, for each topic.

    A stamp that only smaller ones follow is given up as a run is, see `EventOrder`. A state may not
    change for long: each message of its part shows that greater stamps live, health once a second.
    """

    def __init__(self) -> None:
        #: By kind and name.
        self._stamps: dict[str, dict[str, Stamp]] = {}
        #: By name and kind: since when only older messages came of a topic, as long as none with a
        #: greater stamp came of its part.
        self._older_s: dict[str, dict[str, float]] = {}

    def take(
        self, kind: str, name: str, stamp: Stamp | None, live_s: float | None = None
    ) -> bool | None:
        """Return whether a message is newer than all before; None if it is the newest one again.

        One without a stamp is newer only if there has been none with one.

        Args:
            kind: of topic.
            name: of the part or node.
            stamp: of the message.
            live_s: when it came, if it was sent then. None: it was stored, or stays as it is until
                a greater one comes, however long that lasts.

        Raises:
            MessageError: there are too many topics of this kind.
        """
        stamps = self._stamps.setdefault(kind, {})
        known = stamps.get(name)
        if stamp is None:
            return known is None
        older_s = self._older_s.get(name, {})
        for other in list(older_s):
            if stamp >= self._stamps[other][name]:
                del older_s[other]
        if known is None and len(stamps) >= MAX_TOPICS:
            raise MessageError(f"more than {MAX_TOPICS} topics of this kind of one robot")
        if known is not None and stamp <= known:
            if stamp == known:
                return None
            if live_s is None:
                return False
            older_s = self._older_s.setdefault(name, {})
            if not _have_vanished(older_s.setdefault(kind, live_s), live_s):
                return False
            del older_s[kind]
        stamps[name] = stamp
        return True

    def forget(self, kind: str, name: str | None = None) -> None:
        """Forget all topics of a kind, or one."""
        stamps = self._stamps.get(kind, {})
        for one in list(stamps) if name is None else [name]:
            stamps.pop(one, None)
            self._older_s.get(one, {}).pop(kind, None)
