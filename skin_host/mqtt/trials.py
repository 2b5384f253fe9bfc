"""Finds what makes a broker end the connection, and withholds its topics. Pure.

A topic gets a strike when a publication to it, or a subscription, was all that waited for an answer
as the broker ended the connection. Strikes are of topics, not of payloads: a state that is sent
again may be a newer one each time.
"""

from collections.abc import Callable

from skin_host.clock import SYSTEM

#: A topic is found after this many strikes.
TRIES = 3
#: When this many events in a row of one topic were dropped, none is sent to it ...
REJECTIONS = 3
#: ... for this long. States, frames and subscriptions are withheld for as long when their topic is
#: found.
HOLD_S = 600.0
#: Each time from then on it is twice as long, up to this: each try costs a connection.
LONGEST_HOLD_S = 3600.0


class Trials:
    """Counts strikes, and keeps the withheld topics.

    Args:
        now_s: a clock that is never set.
    """

    def __init__(self, now_s: Callable[[], float] = SYSTEM.monotonic_s) -> None:
        self._now_s = now_s
        self._strikes: dict[str, int] = {}
        self._hold_s: dict[str, float] = {}
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

    def strike(self, topic: str) -> int:
        """The connection ended while only this waited for an answer.

        Returns:
            How often the topic has been found: 0 before `TRIES` strikes, and one more with each
            strike from then on, until something arrives.
        """
        strikes = self._strikes[topic] = self._strikes.get(topic, 0) + 1
        return max(0, strikes - TRIES + 1)

    def withhold(self, topic: str) -> None:
        """Send nothing to this topic for `HOLD_S`, or longer if nothing arrived after the last
        time.
        """
        hold_s = min(2 * self._hold_s.get(topic, HOLD_S / 2), LONGEST_HOLD_S)
        self._hold_s[topic] = hold_s
        self._until_s[topic] = self._now_s() + hold_s

    def arrived(self, topic: str) -> None:
        """Something of this topic was acknowledged."""
        self._strikes.pop(topic, None)
        self._hold_s.pop(topic, None)
        self._until_s.pop(topic, None)
