"""Every event of a run: hashed, and the last ones kept to be shown."""

from collections import deque
from hashlib import blake2b

#: So many events are shown when a promise is broken.
KEPT = 40
#: So many are hashed at once: the hash is of all bytes, however they come.
_AT_ONCE = 256


class Trace:
    """Takes the events of a run in order.

    Attributes:
        count: events so far.
        last: the last ones that are worth showing, as lines.
        unnamed: a name that is another in every run, as that of the state's folder; it may stand in
            messages and is not hashed.
    """

    unnamed = b""

    def __init__(self) -> None:
        self._hash = blake2b(digest_size=16)
        self._events: list[bytes] = []
        self.count = 0
        self.last: deque[str] = deque(maxlen=KEPT)

    def data(self, t_ns: int, kind: str, *values: bytes) -> None:
        """An event that is only hashed: frames on a bus, publications."""
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

    def _take(self) -> None:
        events = b"".join(self._events)
        self._events.clear()
        self._hash.update(events.replace(self.unnamed, b"") if self.unnamed else events)
