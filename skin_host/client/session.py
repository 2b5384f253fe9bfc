"""The client itself: one connection that keeps what its streams ask for."""

import asyncio
import itertools
import logging
import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, Self, TypeVar
from weakref import WeakSet

from skin_host.client.heard import Contact, Health, read
from skin_host.client.robots import RETAINED_S, only_robot
from skin_host.client.streams import Stream
from skin_host.errors import BrokerError, RequestError, SkinError
from skin_host.publish.address import Broker
from skin_host.publish.commands import Result, decode_result, encode_request
from skin_host.publish.connection import (
    Connection,
    Message,
    MqttError,
    Retry,
    connect,
    explain,
    first_error,
    is_refusal,
    message_properties,
)
from skin_host.publish.frames import Frame
from skin_host.publish.grasping import Over, Slip
from skin_host.publish.info import NodeInfo, decode_info
from skin_host.publish.messages import Touch
from skin_host.publish.payload import JSON_TYPE
from skin_host.publish.topics import ONLINE, PartTopic, Topics

MAX_INCOMING = 10_000
#: The broker keeps touch events for us for so long while we are away (MQTT 5).
SESSION_S = 60

T = TypeVar("T")
_log = logging.getLogger(__name__)


class CommandError(SkinError):
    """A node refused a command, failed, or did not answer; the message says why."""


@dataclass
class Node:
    """A daemon of the robot. `online` is None until it has been heard of."""

    online: bool | None = None
    info: NodeInfo | None = None


class SkinClient:
    """One robot's skin, heard over MQTT.

    Args:
        broker: `mqtt://[user[:password]@]host[:port][/base][?protocol=3.1.1]`, `mqtts://...`, or
            a `Broker`.
        robot: its name; without one the only robot that the broker knows, or that is online.
        base: of the topics; "skin" unless the URL or this says otherwise.
        protocol: of MQTT, for a broker given by URL.
        patience_s: how long entering waits for a broker that is not there.

    Attributes:
        nodes: the robot's daemons by name, as far as they have been heard of.
        connections: how often the broker was found; more than 1 says that it was lost.
        last_error: why it was lost, or not found.
        unreadable: messages that did not hold what their topic promises.

    Raises (on entering):
        BrokerError: no broker, or one that refuses us.
        RequestError: the URL is wrong, or it is not clear which robot is meant.
    """

    def __init__(
        self,
        broker: str | Broker = "mqtt://localhost",
        *,
        robot: str | None = None,
        base: str | None = None,
        protocol: Literal["5", "3.1.1"] = "5",
        patience_s: float = 10.0,
    ) -> None:
        if isinstance(broker, str):
            broker, path = Broker.from_url(broker, protocol)
            base = base or path
        self._broker = broker
        self._base = base or "skin"
        self._topics = None if robot is None else Topics(self._base, robot)
        self._robot = robot
        self._patience_s = patience_s
        self._identifier = f"skin-client-{secrets.token_hex(4)}"
        self._numbers = itertools.count(1)
        self._asked: dict[str, asyncio.Future[Result]] = {}
        self._streams: WeakSet[Stream[Any]] = WeakSet()
        self._latest: dict[tuple[PartTopic, str], Contact | Health] = {}
        self._connection: Connection | None = None
        self._news = asyncio.Event()
        self._since_s = 0.0
        self._streams_changed = asyncio.Event()
        self._subscribed: set[str] = set()
        self._kept: set[str] = set()  # subscriptions of which the broker may know still
        self._failure: SkinError | None = None
        self._task: asyncio.Task[None] | None = None
        self.nodes: dict[str, Node] = {}
        self.connections = 0
        self.last_error = ""
        self.unreadable = 0

    @property
    def robot(self) -> str:
        """Whose skin it is."""
        return self._robot or ""

    @property
    def connected(self) -> bool:
        """Whether the broker is there now."""
        return self._connection is not None

    def touches(self, part: str | None = None) -> Stream[Touch]:
        """Touch events of a part, or of all."""
        return self._stream(part, "touch")

    def slips(self, part: str | None = None) -> Stream[Slip]:
        """Slips of a fingertip, or of all: they begin and end."""
        return self._stream(part, "slip")

    def overs(self, part: str | None = None) -> Stream[Over]:
        """When a fingertip, or any, begins or ends to press too hard."""
        return self._stream(part, "over")

    def events(self, part: str | None = None) -> Stream[Touch | Slip | Over]:
        """Touches, slips and excesses of a part, or of all, in the order in which they come."""
        return self._stream(part, "touch", "slip", "over")

    def frames(self, part: str | None = None) -> Stream[Frame]:
        """Frames of a part, or of all: pressure in kPa as numpy arrays."""
        return self._stream(part, "frame")

    def contacts(self, part: str | None = None) -> Stream[Contact]:
        """Whether parts are touched: as it is now, and each change."""
        return self._stream(part, "contact")

    def health(self, part: str | None = None) -> Stream[Health]:
        """How parts are: as it is now, and each change."""
        return self._stream(part, "health")

    async def ready(self) -> None:
        """Wait until all that was asked for so far has reached the broker."""
        await self._until(
            lambda: self._topics and self._subscribed >= set(self._wanted(self._topics))
        )

    async def info(self, timeout_s: float = 5.0) -> dict[str, NodeInfo]:
        """What the robot's nodes are: their parts, taxels, places. Waits for the first.

        Raises:
            BrokerError: none has said so within `timeout_s`.
        """

        def known() -> dict[str, NodeInfo]:
            return {name: node.info for name, node in self.nodes.items() if node.info is not None}

        try:
            async with asyncio.timeout(timeout_s):
                return await self._until(known)
        except TimeoutError:
            raise BrokerError(
                f'broker {self._broker}: no node of robot "{self.robot}" has said what it is; '
                "is `skin run` running?"
            ) from None

    async def command(
        self, name: str, *, node: str | None = None, timeout_s: float = 10.0, **arguments: Any
    ) -> dict[str, Any]:
        """Ask a node to do something and return its result.

        Args:
            name: of the command.
            node: whom to ask; without it the robot's only node.
            timeout_s: how long to wait for the answer.
            arguments: of the command.

        Raises:
            CommandError: the node refused, failed, or did not answer in time.
            RequestError: it is not clear which node is meant.
        """
        number = f"{self._identifier}-{next(self._numbers)}"
        answer = self._asked[number] = asyncio.get_running_loop().create_future()
        try:
            async with asyncio.timeout(timeout_s):
                node = node or await self._only_node()
                await self._ask(node, name, {"id": number} | arguments)
                result = await answer
        except TimeoutError:
            raise CommandError(
                f'no answer to "{name}" from node "{node or "?"}" of robot "{self.robot}" within '
                f"{timeout_s:g} s; is `skin run` running there?"
            ) from None
        except MqttError as error:
            raise CommandError(f"broker {self._broker}: {explain(error)}") from None
        finally:
            del self._asked[number]
        if not result.ok:
            raise CommandError(result.error or "refused without a reason")
        return result.result or {}

    async def __aenter__(self) -> Self:
        self._task = asyncio.create_task(self._run(), name="skin client")
        try:
            async with asyncio.timeout(self._patience_s):
                await self._until(lambda: self._connection or self._failure)
        except TimeoutError:
            why = self.last_error or "it does not answer"
            if self._broker.v5 and "does not answer" in why:
                why += "; if it speaks MQTT 3.1.1 alone, end its URL with ?protocol=3.1.1"
            self._failure = BrokerError(f"broker {self._broker}: cannot connect: {why}")
        except BaseException:
            await self._stop()
            raise
        if self._failure is not None:
            await self._stop()
            raise self._failure
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stop()

    async def _stop(self) -> None:
        assert self._task is not None
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        for stream in list(self._streams):
            stream.close()

    async def _until(self, condition: Callable[[], T]) -> T:
        """Wait until `condition` holds, and return what it said."""
        while not (found := condition()):
            self._news.clear()
            await self._news.wait()
        return found

    def _stream(self, part: str | None, *kinds: PartTopic) -> Stream[Any]:
        stream: Stream[Any] = Stream(part, *kinds)
        self._streams.add(stream)
        for (known_kind, known_part), state in self._latest.items():
            if known_kind in kinds and part in (None, known_part):
                stream.put(state)
        self._streams_changed.set()
        return stream

    async def _only_node(self) -> str:
        await self._until(lambda: self._connection)
        # By then all that is retained has come: there are no more nodes than these.
        age_s = asyncio.get_running_loop().time() - self._since_s
        await asyncio.sleep(max(0.0, RETAINED_S - age_s))
        online = sorted(name for name, node in self.nodes.items() if node.online)
        if len(online) == 1:
            return online[0]
        names = ", ".join(online) or "none"
        raise RequestError(
            f'robot "{self.robot}": wanted one node that is online, there are: {names}; '
            "name the node"
        )

    async def _ask(self, node: str, name: str, arguments: dict[str, Any]) -> None:
        connection = await self._until(lambda: self._connection)
        assert connection is not None and self._topics is not None
        properties = message_properties(self._broker, JSON_TYPE)
        if properties is not None:
            properties.ResponseTopic = self._topics.reply(node, self._identifier)
        await connection.publish(
            self._topics.command(node, name), encode_request(arguments), 1, properties=properties
        )

    async def _run(self) -> None:
        retry = Retry()
        loop = asyncio.get_running_loop()
        while self._failure is None:
            since_s: float | None = None
            try:
                async with connect(
                    self._broker,
                    identifier=self._identifier,
                    max_incoming=MAX_INCOMING,
                    session_s=SESSION_S,
                    resume=self.connections > 0,
                ) as connection:
                    since_s = loop.time()
                    await self._talk(connection)
            except* Exception as group:
                self._note_loss(first_error(group))
            finally:
                self._connection = None
                self._kept |= self._subscribed
                self._subscribed = set()
            await asyncio.sleep(retry.delay_s(0.0 if since_s is None else loop.time() - since_s))

    def _note_loss(self, error: BaseException) -> None:
        why = explain(error)
        if self.connections and why != self.last_error:
            unknown = None if isinstance(error, MqttError) else error
            _log.warning("broker %s: %s; trying again", self._broker, why, exc_info=unknown)
        self.last_error = why
        if not self.connections:
            if isinstance(error, SkinError):
                self._failure = error
            elif is_refusal(error):
                self._failure = BrokerError(f"broker {self._broker}: refuses us: {why}")
            self._news.set()

    async def _talk(self, connection: Connection) -> None:
        if self._topics is None:
            self._robot = await only_robot(connection, self._broker, self._base)
            self._topics = Topics(self._base, self._robot)
        async with asyncio.TaskGroup() as group:
            group.create_task(self._keep_subscribed(connection, self._topics))
            async for message in connection.messages:
                self._take(message, self._topics)

    async def _keep_subscribed(self, connection: Connection, topics: Topics) -> None:
        while True:
            self._streams_changed.clear()
            want = set(self._wanted(topics))
            for topic in want - self._subscribed:
                await connection.subscribe(topic, qos=0 if topic.endswith("/frame") else 1)
            for topic in (self._subscribed | self._kept) - want:
                await connection.unsubscribe(topic)
                # What is no longer followed is no longer known.
                kinds = {place.kind} if (place := topics.parse(topic)) else set()
                self._latest = {k: v for k, v in self._latest.items() if k[0] not in kinds}
            self._subscribed, self._kept = want, set()
            self._news.set()
            if self._connection is None:
                self._connection = connection
                self.connections += 1
                self._since_s = asyncio.get_running_loop().time()
                _log.info("broker %s: connected", self._broker)
            await self._streams_changed.wait()

    def _wanted(self, topics: Topics) -> Iterator[str]:
        """Topics to subscribe to; none lies within another, or messages would come twice."""
        yield topics.node("status", "+")
        yield topics.node("info", "+")
        if self._broker.v5:
            yield topics.reply("+", self._identifier)
        else:
            yield topics.result("+", "+")
        asked = {(kind, stream.part) for stream in self._streams for kind in stream.kinds}
        for kind, part in asked:
            if part is None or (kind, None) not in asked:
                yield topics.part(kind, part or "+")

    def _take(self, message: Message, topics: Topics) -> None:
        place = topics.parse(message.topic.value)
        payload = message.payload if isinstance(message.payload, bytes) else b""
        if place is None:
            return
        kind, name = place
        try:
            if kind == "status" or kind == "info":  # noqa: PLR1714
                self._take_node(kind, name, payload)
            elif kind == "answer":
                self._take_answer(decode_result(payload))
            else:
                self._take_part(kind, name, payload)
        except SkinError as error:
            self.unreadable += 1
            if self.unreadable == 1:
                _log.warning("%s: %s; such messages are passed over", message.topic, error)

    def _take_node(self, kind: str, name: str, payload: bytes) -> None:
        node = self.nodes.setdefault(name, Node())
        if kind == "status":
            node.online = payload == ONLINE if payload else None
        else:
            node.info = decode_info(payload) if payload else None
        self._news.set()

    def _take_answer(self, result: Result) -> None:
        answer = self._asked.get(str(result.id))
        if answer is not None and not answer.done():
            answer.set_result(result)

    def _take_part(self, kind: PartTopic, part: str, payload: bytes) -> None:
        streams = [
            stream
            for stream in self._streams
            if kind in stream.kinds and stream.part in (None, part)
        ]
        if not streams:
            self._streams_changed.set()  # nobody reads it any more
            return
        item = read(kind, part, payload)
        if item is None:
            self._latest.pop((kind, part), None)
            return
        if isinstance(item, Contact | Health):
            self._latest[kind, part] = item
        for stream in streams:
            stream.put(item)
