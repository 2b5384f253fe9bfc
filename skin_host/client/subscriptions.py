"""Which topics the streams of a client need. Pure."""

from collections.abc import Collection, Iterator
from typing import Any

from skin_host.client.streams import Kind, Stream
from skin_host.mqtt.topics import PartTopic, Topics


def needed(kind: Kind) -> tuple[PartTopic, ...]:
    """Return the topics of parts that a stream of a kind needs: a contact state is valid only while
    its part lives. Those of the nodes are always subscribed to.
    """
    if kind == "info":
        return ()
    return ("contact", "health", "touch") if kind == "contact" else (kind,)


class Subscriptions:
    """The topics of a robot that the streams of a client need, and those that it always needs.

    Args:
        topics: of the robot.
        replies: where the answers to requests come.
        streams: those that exist.
    """

    def __init__(self, topics: Topics, replies: str, streams: Collection[Stream[Any]]) -> None:
        self.topics = topics
        self.replies = replies
        self._streams = streams

    @property
    def nodes(self) -> tuple[str, ...]:
        """The topics of what the nodes are, and whether they are online."""
        topics = self.topics
        return topics.node("status", "+"), topics.info("+"), topics.info("+", "+")

    def of(self, kind: PartTopic, part: str | None) -> set[str]:
        """Return the topics by which a kind of message of a part, or of all, may come."""
        return {self.topics.part(kind, name) for name in ("+", part) if name is not None}

    def required(self, stream: Stream[Any]) -> set[str]:
        """Return the topics without which a stream receives nothing that is true."""
        kinds = {one for kind in stream.kinds for one in needed(kind)}
        if "contact" in stream.kinds:
            kinds.remove("touch")  # it is of use to `present` alone
        nodes = self.nodes if "info" in stream.kinds else ()
        return set(nodes).union(*(self.of(kind, stream.part) for kind in kinds))

    def kinds_of(self, part: str) -> set[PartTopic]:
        """Return the kinds of messages of a part that somebody reads."""
        here = [stream for stream in self._streams if stream.part in (None, part)]
        return {one for stream in here for kind in stream.kinds for one in needed(kind)}

    def wanted(self) -> Iterator[str]:
        """Yield the topics to subscribe to; none contains another, or messages would come twice.

        Nodes come first: what is retained of a part whose node has stopped is out of date. Contact
        states come before what shows that their part lives, or that would not be known of them.
        """
        yield from self.nodes
        yield self.replies
        asked = {
            (kind, stream.part)
            for stream in self._streams
            for asked_kind in stream.kinds
            for kind in needed(asked_kind)
        }
        for kind, part in sorted(asked, key=lambda one: one[0] != "contact"):
            if part is None or (kind, None) not in asked:
                yield self.topics.part(kind, "+" if part is None else part)
