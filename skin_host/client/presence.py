"""Contact state of the parts, status of the nodes, and which node has a part, and whether they are
still known. Pure: takes times.

Fails safe: a part whose node is offline or silent, or whose broker is lost, is UNKNOWN, whatever
was received from it last. So is a part whose messages come much later than before: a broker that
was frozen, or has too much to do, delivers what was true then. By the same rule nothing is known of
a node of which no part is received in time.
"""

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import count
from typing import Literal, NamedTuple

from skin_host.mqtt.messages import ContactState, Frame
from skin_host.mqtt.order import Stamp
from skin_host.processing.events import Touch

#: Why a contact state is unknown: the node cannot feel all of the part; the node, or only this
#: part, has not been received for too long, or its state was deleted; the node has stopped; the
#: broker is lost, or the connection of the node, which may have another one by now.
Why = Literal["not_felt", "stale", "offline", "disconnected"]


class Contact(NamedTuple):
    """Whether anything touches a part; `why` is given only with UNKNOWN."""

    part: str
    state: ContactState
    why: Why | None = None

    @property
    def known(self) -> bool:
        return self.state != "UNKNOWN"

    @property
    def touched(self) -> bool:
        """Return whether the part may be touched: true also for UNKNOWN, so that it fails safe."""
        return self.state != "OFF"


#: A part of which nothing came for this long is UNKNOWN, unless somebody asks for another time.
STALE_S = 3.0
#: At most this many touches of a part are kept, of this many taxels together: of more, the oldest
#: are forgotten.
MAX_TOUCHES = 1000
MAX_TOUCHED = 200_000
#: Of nodes that name the same part: the one that is online has it, rather than one that may be.
_RANKS: dict[bool | None, int] = {False: 0, None: 1, True: 2}
_NO_STAMP = Stamp(-1, -1)
#: A distance between two clocks is the least one that was seen for this long, or twice as long.
DISTANCE_S = 120.0


def taxels_of(item: object) -> int:
    """Return how many taxels an item names: touches and frames may name very many, others none."""
    if isinstance(item, Frame):
        return len(item.valid)
    return len(item.taxels) if isinstance(item, Touch) else 0


def too_many(items: Collection[object], most: int) -> bool:
    """Return whether the oldest of some items of a part is to go: there are more than `most`, or
    several touches of more taxels together than any robot's.
    """
    return len(items) > most or (len(items) > 1 and sum(map(taxels_of, items)) > MAX_TOUCHED)


class Lateness:
    """How much later than before the messages of a sender come.

    Its clock and ours are not the same. What can be seen is that the distance between the two times
    grows: it is compared with the least of the last `DISTANCE_S` to twice that. So a clock that was
    set back looks late for this long, and no longer. The stamps of one connection follow a clock
    that is never set: such a step shows with the next one, see `_Part`.
    """

    def __init__(self) -> None:
        self._least_s = self._least_before_s = math.inf
        self._since_s = -math.inf

    def of(self, sent_s: float, now_s: float) -> float:
        """Return how late a message is, 0 or more; the sender's clock shows `sent_s`."""
        distance_s = now_s - sent_s
        if now_s - self._since_s > DISTANCE_S:
            self._least_before_s, self._least_s = self._least_s, distance_s
            self._since_s = now_s
        self._least_s = min(self._least_s, distance_s)
        return distance_s - min(self._least_s, self._least_before_s)


@dataclass(slots=True)
class _Part:
    #: None: not yet received over this connection, or deleted.
    received: ContactState | None = None
    #: When it lived last; -inf: all that came over this connection, or since its node is online
    #: again, was stored.
    alive_s: float = -math.inf
    #: Since when it is waited for what was not stored.
    waiting_s: float = -math.inf
    lateness: Lateness = field(default_factory=Lateness)
    #: Of the node, over which the last message came whose time is known.
    connection: int | None = None
    #: How late the last message was whose time is known.
    late_s: float = 0.0
    #: Brokers from which the state, or its deletion, came; without any it is out of date.
    over: set[int] = field(default_factory=set)
    reported: Contact | None = None
    #: Of the node's start from which the touches are, as far as they show it.
    run: int | None = None
    touches: dict[int, tuple[Touch, float]] = field(default_factory=dict)

    def hear(
        self,
        now_s: float,
        stale_s: float,
        sent_s: float | None = None,
        connection: int | None = None,
        *,
        behind_state: bool = True,
    ) -> None:
        """Take a sign of life: it shows that the part lived when it was sent.

        What comes before the newest state, or was kept for us, makes no OFF true that is not known
        to be.

        A stale part comes back with a message that is half as late as one that makes it stale, so
        that it does not flap where messages come about as late as that.

        The node's clock may have been set before its next connection: the distance to ours is
        another then. Not if what came before was late: a broker that is held up sends the messages
        of the next connection after those of the last one, and as late.
        """
        is_alive = now_s - self.alive_s <= stale_s
        is_old = self.received == "OFF" or (self.received is None and self.reported is not None)
        if is_old and not (behind_state or is_alive):
            return
        if sent_s is not None:
            if connection != self.connection and self.late_s <= stale_s / 2:
                self.lateness = Lateness()
            self.connection = connection
            self.late_s = self.lateness.of(sent_s, now_s)
        if is_alive or self.late_s <= stale_s / 2:
            if self.alive_s == -math.inf and self.received == "OFF":
                self.touches.clear()
            self.alive_s = max(self.alive_s, now_s - self.late_s)

    def wait(self, now_s: float) -> None:
        """Take nothing for true before something of it comes that was not stored."""
        self.alive_s, self.waiting_s = -math.inf, now_s


@dataclass(slots=True)
class _Node:
    #: Whether it is online by its newest status; None: that does not show it.
    status: bool | None
    #: Brokers from which that came.
    over: set[int]
    #: Of which it publishes, by its status, as far as that has room for them.
    parts: frozenset[str]

    @property
    def online(self) -> bool | None:
        """Whether it is online; None: that is not known any more."""
        return self.status if self.over else None


class _Info(NamedTuple):
    """The parts that a node's info names, and which of two infos is newer."""

    parts: list[str]
    #: None: it has none, and the one that was received later counts as newer.
    stamp: Stamp | None
    number: int


class Presence:
    """Follows contact states, touches, signs of life, and nodes.

    Args:
        stale_s: a part not received for this long is UNKNOWN. Its health is sent once a second.
    """

    def __init__(self, stale_s: float) -> None:
        self._stale_s = stale_s
        self._parts: dict[str, _Part] = {}
        #: By node.
        self._infos: dict[str, _Info] = {}
        #: By part, see `holders`.
        self._node_of: dict[str, str] = {}
        self._numbers = count()
        self._nodes: dict[str, _Node] = {}

    def take_state(
        self,
        part: str,
        state: ContactState | None,
        now_s: float,
        broker: int = 0,
        *,
        again: bool = False,
        stored: bool = False,
        sent_s: float | None = None,
        connection: int | None = None,
    ) -> None:
        """Take the newest contact state; None: it was deleted.

        Args:
            part: whose.
            state: what was received.
            now_s: the time.
            broker: from which it came.
            again: it came from another broker before.
            stored: the broker had it; it does not show that the part lives.
            sent_s: when it was sent, by the node's clock. None: not known, or it was stored.
            connection: of the node, over which it was sent.
        """
        known = self._parts.setdefault(part, _Part())
        known.received = state
        known.over = known.over | {broker} if again else {broker}
        if not stored and state is not None:
            known.hear(now_s, self._stale_s, sent_s, connection)
            if state == "OFF":
                known.touches.clear()
        elif known.alive_s == -math.inf:
            known.waiting_s = now_s

    def take_sign(
        self, part: str, now_s: float, sent_s: float | None = None, connection: int | None = None
    ) -> None:
        """Take a health record of a part that was not a stored one: it follows the newest state."""
        if part in self._parts:
            self._parts[part].hear(now_s, self._stale_s, sent_s, connection)

    def take_data(self, part: str, now_s: float) -> None:
        """Take a frame or an event of a part: it may come before the state that changes with it."""
        if part in self._parts:
            self._parts[part].hear(now_s, self._stale_s, behind_state=False)

    def take_touch(self, touch: Touch, now_s: float, run: int | None = None) -> None:
        """Take a touch, of a run of the node if that is known; those of the runs before have ended
        with them.
        """
        part = self._parts.setdefault(touch.part, _Part())
        part.hear(now_s, self._stale_s, behind_state=False)
        if run is not None and run != part.run:
            part.touches.clear()
            part.run = run
        if touch.event == "end":
            part.touches.pop(touch.id, None)
        else:
            part.touches[touch.id] = touch, now_s
            while too_many([one for one, _ in part.touches.values()], MAX_TOUCHES):
                del part.touches[next(iter(part.touches))]

    def take_node(
        self,
        node: str,
        online: bool | None,
        now_s: float,
        broker: int = 0,
        *,
        again: bool = False,
        parts: Iterable[str] = (),
    ) -> None:
        """Take the newest status of a node; None: its connection ended, or the status was deleted.

        One that is online again may have been restarted: its parts are not as they were before.

        Args:
            node: whose.
            online: whether it is, see `is_online`.
            now_s: the time.
            broker: from which it came.
            again: it came from another broker before.
            parts: of which it publishes, as far as the status names them.
        """
        before = self._nodes.get(node)
        over = before.over if again and before is not None else set()
        self._nodes[node] = _Node(online, over | {broker}, frozenset(parts))
        if before is None or before.status != online:
            self._find_holders(now_s)
        if online and before is not None and not before.online:
            for name, part in self._parts.items():
                if self._node_of.get(name) == node:
                    part.wait(now_s)

    def take_info(
        self, node: str, parts: Iterable[str], now_s: float, stamp: Stamp | None = None
    ) -> None:
        """Take the newest info of a node: which parts it names, and its stamp, if it has one."""
        # Only what the last info of each node names: whoever may publish could go on for ever.
        self._infos[node] = _Info(list(parts), stamp, next(self._numbers))
        self._find_holders(now_s)

    def forget_info(self, node: str, now_s: float) -> None:
        """Note that the info of a node was deleted."""
        if self._infos.pop(node, None) is not None:
            self._find_holders(now_s)

    def forget_node(self, node: str, now_s: float) -> None:
        """Note that all that is retained of a node was deleted: there is no such node."""
        self._nodes.pop(node, None)
        self.forget_info(node, now_s)

    @property
    def holders(self) -> Mapping[str, str]:
        """By part: the node that has it now.

        A part may have moved from one node to another, and what is retained of the former one names
        it still. So it is that of the node that is online, then of one that may be, and of several
        of these the one whose info is the newest.
        """
        return self._node_of

    def _find_holders(self, now_s: float) -> None:
        def rank(node: str) -> tuple[int, Stamp, int]:
            known, info = self._nodes.get(node), self._infos[node]
            # Until it has another one its status is that before the loss of a broker.
            status = None if known is None else known.status
            return _RANKS[status], info.stamp or _NO_STAMP, info.number

        before = self._node_of
        self._node_of = {
            part: node for node in sorted(self._infos, key=rank) for part in self._infos[node].parts
        }
        for name, part in self._parts.items():
            former = before.get(name)
            if former is not None and self._node_of.get(name) not in (None, former):
                part.wait(now_s)  # what is known of it is of the former node

    def take_refusal(self, part: str, broker: int = 0) -> None:
        """Note that a broker does not let us receive the state of a part any more."""
        known = self._parts.get(part)
        if known is not None and known.over == {broker}:
            known.received = None

    def take_loss(self, broker: int = 0) -> None:
        """Note the loss of a broker. Its retained messages come again with the next connection."""
        for part in self._parts.values():
            part.over.discard(broker)
            if not part.over:
                part.received, part.alive_s = None, -math.inf
        for node in self._nodes.values():
            node.over.discard(broker)

    def forget_state(self, part: str) -> None:
        """Forget the contact state of a part, which is not followed any more."""
        known = self._parts.get(part)
        if known is not None:
            known.received = known.reported = None
            known.over.clear()
            self._forget_unfollowed(part)

    def forget_touches(self, part: str) -> None:
        """Forget the touches of a part, which are not followed any more."""
        known = self._parts.get(part)
        if known is not None:
            known.touches.clear()
            self._forget_unfollowed(part)

    def _forget_unfollowed(self, part: str) -> None:
        known = self._parts[part]
        if not (known.touches or known.over or known.reported):
            del self._parts[part]

    def online(self, node: str, now_s: float) -> bool | None:
        """Return whether a node is online; None: not known.

        Not while all of its parts that are followed are silent, or are received too late.
        """
        known = self._nodes.get(node)
        if known is None or not known.online:
            return None if known is None else known.online
        parts = [
            part
            for name, part in self._parts.items()
            if part.over and self._node_of.get(name) == node
        ]
        stale = all(now_s - part.alive_s > self._stale_s for part in parts)
        return None if parts and stale else True

    @property
    def parts(self) -> Collection[str]:
        """The parts of which a contact state or a touch was received."""
        return self._parts.keys()

    def named(self) -> set[str] | None:
        """Return the parts that the robot's nodes name; None: that is not complete.

        A node that has stopped may start again, so its parts count. While no node is online, nobody
        knows with which configuration the robot will start.
        """
        nodes = self._nodes.values()
        complete = self._nodes.keys() <= self._infos.keys()
        if not complete or not any(node.online for node in nodes):
            return None
        named = [info.parts for info in self._infos.values()]
        return set().union(*named, *(node.parts for node in nodes))

    def brokers(self, node: str) -> set[int]:
        """Return the brokers from which the newest status of a node came."""
        return self._nodes[node].over if node in self._nodes else set()

    def contact(self, part: str, now_s: float) -> Contact | None:
        """Return the present state of a part; None if nothing was received of it, or only what was
        stored, a moment ago.
        """
        known = self._parts.get(part)
        if known is None or (known.received is None and known.reported is None):
            return None
        node = self._nodes.get(self._node_of.get(part, ""))
        why: Why | None = None
        if not known.over or (node is not None and node.online is None):
            why = "disconnected"
        elif node is not None and not node.online:
            why = "offline"
        elif known.received is None or now_s - known.alive_s > self._stale_s:
            before = known.reported
            waits = known.alive_s == -math.inf and now_s - known.waiting_s <= self._stale_s
            if waits and known.received is not None and (before is None or not before.known):
                return before
            why = "stale"
        elif known.received == "UNKNOWN":
            why = "not_felt"
        received = "UNKNOWN" if why is not None else known.received
        return Contact(part, received or "UNKNOWN", why)

    def touches(self, part: str | None, now_s: float) -> list[Touch]:
        """What touches a part, or all, as far as it is known.

        Nothing is known of a part that is not received: its node is offline, or it may be, or the
        part is silent or received too late. A touch whose end was lost goes when it has not moved
        for `stale_s` while its part was received: a touch that lasts moves once a second.
        """
        found = []
        for name, known in self._parts.items():
            if not self.is_received(name, now_s):
                continue
            for number, (touch, at_s) in list(known.touches.items()):
                if min(known.alive_s, now_s) - at_s > self._stale_s:
                    del known.touches[number]
                elif part in (None, name):
                    found.append(touch)
        return found

    def is_received(self, part: str, now_s: float) -> bool:
        """Return whether what is known of a part is from now, as far as that shows."""
        state = self.contact(part, now_s)
        if state is not None:
            return state.why in (None, "not_felt")
        node = self._nodes.get(self._node_of.get(part, ""))
        return (node is None or node.online is True) and self._parts[part].alive_s > -math.inf

    def reported(self) -> list[Contact]:
        """The contact states as they were reported last."""
        return [one.reported for one in self._parts.values() if one.reported is not None]

    def changes(self, now_s: float) -> list[Contact]:
        """Contact states that have changed since they were asked for last."""
        changed = []
        for name, known in self._parts.items():
            now = self.contact(name, now_s)
            if now is not None and now != known.reported:
                known.reported = now
                changed.append(now)
        return changed
