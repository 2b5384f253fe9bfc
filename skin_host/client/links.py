"""Connection of a client to one broker: kept up, and subscribed to the wanted topics.

A short connection finds out which robot is meant when none is named.
"""

import asyncio
import contextlib
import logging
from collections.abc import Iterable
from typing import Protocol

from skin_host.errors import BrokerError, RequestError, SkinError
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import (
    Connection,
    Message,
    MqttError,
    Retry,
    connect,
    explain,
    first_error,
    is_refusal,
)
from skin_host.mqtt.payload import MAX_PACKET_BYTES
from skin_host.mqtt.topics import ONLINE
from skin_host.tasks import leave_if_cancelled

MAX_INCOMING = 10_000
#: The broker keeps touch events for this long while we are disconnected (MQTT 5).
SESSION_S = 60
#: Of these it keeps nothing (QoS 0): they would take the room of events, and old states would look
#: new. The present ones come with each subscription.
NOT_KEPT = ("/frame", "/contact", "/health")

#: Retained messages come within this time of a subscription, or of the first of them.
RETAINED_S = 0.5
#: The first may take longer: a broker or a network can be slow, and no robot at all is rare.
FIRST_RETAINED_S = 3.0
#: So it is known by then which robots there are.
ROBOT_S = FIRST_RETAINED_S + RETAINED_S + 1.0
_log = logging.getLogger(__name__)


class Hearer(Protocol):
    """The user of a link, which receives its messages."""

    async def prepare(self, connection: Connection, broker: Broker) -> None:
        """Find out what must be known before the first subscription."""

    def wanted(self) -> Iterable[str]:
        """Return the topics to subscribe to, in that order."""

    def take(self, link: "BrokerLink", message: Message) -> None:
        """Take a message."""

    def unfollow(self, topic: str) -> None:
        """A topic is no longer subscribed."""

    def note(self, link: "BrokerLink") -> None:
        """The link was made, or lost, or could not be made."""


class BrokerLink:
    """A connection that is kept up.

    `number` is that of the broker among those of the client, `identifier` our name there.

    Attributes:
        connection: None before all wanted topics have been subscribed to once.
        connections: how often it was made.
        since_s: when it was made last, by the event loop's clock.
        last_error: why it was lost, or not made.
        failure: why it will not be made, as far as is known, before it was made once.
        reached: the broker has taken us, whatever came after.
        refused: wanted topics that the broker does not let us subscribe to; it is asked again with
            the next connection.
        again: to be set when the wanted topics change.
    """

    def __init__(self, number: int, broker: Broker, identifier: str, hearer: Hearer) -> None:
        self.number = number
        self.broker = broker
        self.connection: Connection | None = None
        self.connections = 0
        self.since_s = 0.0
        self.last_error = ""
        self.failure: SkinError | None = None
        self.reached = False
        self.refused: set[str] = set()
        self.again = asyncio.Event()
        self._identifier = identifier
        self._hearer = hearer
        self._subscribed: set[str] = set()
        self._kept: set[str] = set()  # subscriptions that the broker may still have

    @property
    def tried(self) -> bool:
        """Return whether the broker has been found, or found absent."""
        return bool(self.connections or self.last_error)

    def has(self, topics: set[str]) -> bool:
        """Return whether all of these are subscribed, or refused."""
        return self._subscribed >= topics

    async def run(self) -> None:
        """Keep the connection up until cancelled."""
        retry = Retry()
        loop = asyncio.get_running_loop()
        while True:
            since_s: float | None = None
            try:
                async with connect(
                    self.broker,
                    identifier=self._identifier,
                    max_incoming=MAX_INCOMING,
                    max_packet=MAX_PACKET_BYTES,
                    session_s=SESSION_S,
                    resume=self.connections > 0,
                ) as connection:
                    since_s = loop.time()
                    await self._talk(connection)
            except* Exception as group:
                self._note_loss(first_error(group))
            finally:
                self.connection = None
                self._kept |= self._subscribed
                self._subscribed, self.refused = set(), set()
                self._hearer.note(self)
            leave_if_cancelled()
            await asyncio.sleep(retry.delay_s(0.0 if since_s is None else loop.time() - since_s))

    def _note_loss(self, error: BaseException) -> None:
        why = explain(error)
        if self.connections and why != self.last_error:
            unknown = None if isinstance(error, MqttError) else error
            _log.warning("broker %s: %s; trying again", self.broker, why, exc_info=unknown)
        self.last_error = why
        if not self.connections:
            if isinstance(error, SkinError):
                self.failure = error
            elif is_refusal(error):
                self.failure = BrokerError(f"broker {self.broker}: refuses us: {why}")

    async def _talk(self, connection: Connection) -> None:
        self.reached = True
        self._hearer.note(self)
        await self._hearer.prepare(connection, self.broker)
        async with asyncio.TaskGroup() as group:
            group.create_task(self._keep_subscribed(connection))
            async for message in connection.messages:
                self._hearer.take(self, message)
                for other in connection.waiting():
                    self._hearer.take(self, other)

    async def _keep_subscribed(self, connection: Connection) -> None:
        while True:
            self.again.clear()
            wanted = list(self._hearer.wanted())
            want = set(wanted)
            for topic in wanted:
                if topic in self._subscribed:
                    continue
                qos = 0 if topic.endswith(NOT_KEPT) else 1
                if not await connection.listen_to(topic, qos, as_published=False):
                    self.refused.add(topic)
                    _log.info("broker %s: refuses us the topic %s", self.broker, topic)
            for topic in (self._subscribed | self._kept) - want:
                if topic not in self.refused:
                    await connection.unsubscribe(topic)
                self._hearer.unfollow(topic)
            self._subscribed, self._kept = want, set()
            self.refused &= want
            if self.connection is None:
                self.connection = connection
                self.connections += 1
                self.failure = None
                self.since_s = asyncio.get_running_loop().time()
                _log.info("broker %s: connected", self.broker)
            self._hearer.note(self)
            await self.again.wait()


def refusal(broker: Broker, topic: str) -> BrokerError:
    """Return that a broker does not let us subscribe to a topic."""
    return BrokerError(
        f'broker {broker}: refuses us the topic "{topic}"; its access rules decide who may read it'
    )


async def only_robot(connection: Connection, broker: Broker, base: str) -> str:
    """Find the only robot below the base, by the status of its nodes.

    Of several the only one that is online: the broker remembers who has left.

    Raises:
        BrokerError: there is none, or it does not let us know which there are.
        RequestError: there is more than one.
    """
    statuses = await _statuses(connection, broker, base, FIRST_RETAINED_S)
    robots = {topic: topic.removeprefix(f"{base}/").partition("/")[0] for topic in statuses}
    known = set(robots.values())
    meant = {robots[topic] for topic, status in statuses.items() if status == ONLINE} or known
    if not meant:
        raise BrokerError(
            f'broker {broker}: no robot has published below "{base}"; is `skin run` running?'
        )
    if len(meant) > 1:
        names = ", ".join(sorted(meant)[:20])
        raise RequestError(
            f'broker {broker}: wanted one robot below "{base}", there are: {names}; name the robot'
        )
    return meant.pop()


async def robots_at(broker: Broker, base: str, identifier: str) -> list[str]:
    """Return the names of the robots that a broker knows, as far as it answers at once."""
    try:
        async with connect(
            broker, identifier=identifier, max_incoming=MAX_INCOMING, max_packet=MAX_PACKET_BYTES
        ) as connection:
            topics = await _statuses(connection, broker, base, RETAINED_S)
    except (MqttError, SkinError):
        return []
    return sorted({topic.removeprefix(f"{base}/").partition("/")[0] for topic in topics})


async def _statuses(
    connection: Connection, broker: Broker, base: str, first_s: float
) -> dict[str, object]:
    """Return the statuses of all nodes below the base by topic: of two of a node the later one.

    Args:
        connection: to the broker.
        broker: which one.
        base: of the topics.
        first_s: how long to wait for the first one.

    Raises:
        BrokerError: the broker does not let us know them.
    """
    statuses: dict[str, object] = {}
    everybody = f"{base}/+/nodes/+/status"
    if not await connection.listen_to(everybody, as_published=False):
        raise refusal(broker, everybody)
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(first_s) as waiting:
            async for message in connection.messages:
                if not statuses:
                    waiting.reschedule(asyncio.get_running_loop().time() + RETAINED_S)
                statuses[message.topic.value] = message.payload
    await connection.unsubscribe(everybody)
    return statuses
