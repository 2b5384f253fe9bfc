"""Every event of a run: hashed, and the last ones kept to be shown."""

from collections import deque
from hashlib import blake2b
from typing import NamedTuple

NS = 1_000_000_000
#: So many events are shown when a promise is broken.
KEPT = 40
#: So many are hashed at once: the hash is of all bytes, however they come.
_AT_ONCE = 256
#: So many of the last whole seconds are kept: a run is repeated up to a second before its end.
_SECONDS = 3


class Before(NamedTuple):
    """What happened before some time of a run.

    Attributes:
        at_s: the time.
        events, digest: how many events came before it, and their hash.
    """

    at_s: int
    events: int
    digest: str


class Trace:
    """Takes the events of a run in order.

    Attributes:
        count: events so far.
        seconds: what happened before the last whole seconds.
        last: the last ones that are worth showing, as lines.
        unnamed: a name that is another in every run, as that of the state's folder; it may stand in
            messages and is not hashed.
    """

    unnamed = b""

    def __init__(self) -> None:
        self._until_ns = 1 << 62
        self._next_ns = NS
        self.seconds: deque[Before] = deque(maxlen=_SECONDS)
        self._hash = blake2b(digest_size=16)
        self._events: list[bytes] = []
        self.count = 0
        self.last: deque[str] = deque(maxlen=KEPT)

    def end_at(self, until_s: float) -> None:
        """What happens at this time and later does not count."""
        self._until_ns = round(until_s * NS)
        self._next_ns = min(self._next_ns, self._until_ns)

    def data(self, t_ns: int, kind: str, *values: bytes) -> None:
        """An event that is only hashed: frames on a bus, publications."""
        if t_ns >= self._next_ns:
            if t_ns >= self._until_ns:
                return
            self._end_second(t_ns)
        self.count += 1
        self._events += (b"%d %b" % (t_ns, kind.encode()), *values)
        if len(self._events) >= _AT_ONCE:
            self._take()

    def note(self, t_ns: int, text: str) -> None:
        """An event that is hashed and shown."""
        self.data(t_ns, text)
        self.last.append(f"{t_ns / 1e9:11.6f}  {text}")

    def digest(self) -> str:
        """Of all events so far, 32 hexadecimal digits."""
        self._take()
        return self._hash.hexdigest()

    def _end_second(self, t_ns: int) -> None:
        second = t_ns // NS
        self.seconds.append(Before(second, self.count, self.digest()))
        self._next_ns = min((second + 1) * NS, self._until_ns)

    def _take(self) -> None:
        events = b"".join(self._events)
        self._events.clear()
        self._hash.update(events.replace(self.unnamed, b"") if self.unnamed else events)
