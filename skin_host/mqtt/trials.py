"""Finds publications that make a broker end the connection, and withholds their topics. Pure.

A publication gets a strike when it was the only one in flight as the broker ended the connection.
"""

from collections.abc import Callable

from skin_host.clock import SYSTEM

#: A publication is dropped after this many strikes.
TRIES = 3
#: When this many in a row to one topic were dropped, nothing is sent to it ...
REJECTIONS = 3
#: ... for this long.
HOLD_S = 600.0


class Trials:
    """Counts strikes, and keeps the withheld topics.

    Args:
        now_s: a clock that is never set.
    """

    def __init__(self, now_s: Callable[[], float] = SYSTEM.monotonic_s) -> None:
        self._now_s = now_s
        self._strikes: dict[tuple[str, bytes], int] = {}
        self._rejections: dict[str, int] = {}
        self._until_s: dict[str, float] = {}

    @property
    def withheld(self) -> list[str]:
        """Return the topics to which nothing is sent now."""
        return [topic for topic in self._until_s if self.withholds(topic)]

    def withholds(self, topic: str) -> bool:
        """Whether nothing is sent to this topic now."""
        until_s = self.until_s(topic)
        return until_s is not None and self._now_s() < until_s

    def until_s(self, topic: str) -> float | None:
        """Until when this topic is or was withheld, if something has not arrived since."""
        return self._until_s.get(topic)

    def strike(self, topic: str, payload: bytes) -> bool:
        """The connection ended while only this was in flight; return whether to drop it.

        Once one of a topic was dropped, the next ones have a single try, until one arrives.
        """
        key = topic, payload
        strikes = self._strikes.pop(key, 0) + 1
        if strikes < TRIES and topic not in self._rejections:
            self._strikes[key] = strikes
            return False
        self.reject(topic)
        return True

    def reject(self, topic: str) -> None:
        """A publication to this topic was dropped."""
        self._rejections[topic] = self._rejections.get(topic, 0) + 1
        if self._rejections[topic] >= REJECTIONS:
            self.withhold(topic)

    def withhold(self, topic: str) -> None:
        """Send nothing to this topic for `HOLD_S`."""
        self._until_s[topic] = self._now_s() + HOLD_S

    def arrived(self, topic: str) -> None:
        """A publication to this topic was acknowledged."""
        if self._strikes or self._rejections:
            self._rejections.pop(topic, None)
            self._until_s.pop(topic, None)
            self._strikes = {key: n for key, n in self._strikes.items() if key[0] != topic}
