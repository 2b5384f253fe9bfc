"""Passes on each message once and in order, though several brokers send it. Pure: takes times.

By the numbers of `publish.order`. Messages without them, from a publisher that speaks MQTT 3.1.1,
are passed on as they arrive.
"""

from dataclasses import dataclass, field

from skin_host.fingertip.events import Over, Slip
from skin_host.mqtt.messages import Frame
from skin_host.mqtt.order import Stamp
from skin_host.processing.events import Touch

Event = Touch | Slip | Over

#: At most this many events of a part wait for an earlier one.
MAX_HELD = 1000


@dataclass(slots=True)
class _Followed:
    run: int
    count: int
    #: By count: events that arrived early, and until when they wait for their turn.
    held: dict[int, tuple[Event, float]] = field(default_factory=dict)


class EventOrder:
    """Passes events on by run and count.

    Args:
        hold_s: how long an event waits for an earlier one, which may come from another broker.
    """

    def __init__(self, hold_s: float) -> None:
        self._hold_s = hold_s
        self._known: dict[tuple[type, str], _Followed] = {}
        self._frames: dict[str, tuple[int, int]] = {}

    def take_frame(self, frame: Frame, run: int | None) -> bool:
        """Return whether a frame is newer than all before; older frames are not waited for."""
        if run is None:
            return True
        number = run, frame.seq
        newer = number > self._frames.get(frame.part, (0, 0))
        if newer:
            self._frames[frame.part] = number
        return newer

    def take(self, event: Event, run: int | None, now_s: float) -> list[Event]:
        """Take a received event; return the events whose turn it is."""
        if run is None or not event.count:
            return [event]
        key = type(event), event.part
        known = self._known.get(key)
        if known is None:
            self._known[key] = _Followed(run, event.count)
            return [event]
        if run < known.run:
            return []
        left: list[Event] = []
        if run > known.run:
            left = [known.held[count][0] for count in sorted(known.held)]
            known = self._known[key] = _Followed(run, 0)
        if event.count <= known.count or event.count in known.held:
            return left
        known.held[event.count] = event, now_s + self._hold_s
        if len(known.held) > MAX_HELD:
            now_s += self._hold_s
        return left + _released(known, now_s)

    def expire(self, now_s: float) -> list[Event]:
        """Return events whose turn it is because earlier ones have not come in time."""
        return [event for known in self._known.values() for event in _released(known, now_s)]


def _released(known: _Followed, now_s: float) -> list[Event]:
    found = []
    for count in sorted(known.held):
        event, until_s = known.held[count]
        if count != known.count + 1 and now_s < until_s:
            break
        known.count = count
        del known.held[count]
        found.append(event)
    return found


class Newest:
    """Decides which of several retained messages is the newest, for each topic."""

    def __init__(self) -> None:
        self._stamps: dict[tuple[str, str], Stamp] = {}

    def take(self, kind: str, name: str, stamp: Stamp | None) -> bool | None:
        """Return whether a message is newer than all before; None if it is the newest one again.

        One without a stamp is newer only if there has been none with one.
        """
        key = kind, name
        known = self._stamps.get(key)
        if stamp is None:
            return known is None
        if known is not None and stamp <= known:
            return None if stamp == known else False
        self._stamps[key] = stamp
        return True

    def forget(self, kind: str, name: str | None = None) -> None:
        """Forget all topics of a kind, or one."""
        for key in [key for key in self._stamps if key[0] == kind and name in (None, key[1])]:
            del self._stamps[key]
