"""The client itself: receives for its streams, from all brokers of the robot."""

import asyncio
import contextlib
import logging
import secrets
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, Literal, Self, TypeVar
from weakref import WeakSet

from skin_host.client.absent import no_such_part, unpublished
from skin_host.client.heard import Described, Health
from skin_host.client.intake import Intake
from skin_host.client.links import (
    RETAINED_S,
    ROBOT_S,
    BrokerLink,
    only_robot,
    refusal,
    robots_at,
)
from skin_host.client.nodes import Node
from skin_host.client.presence import STALE_S, Contact
from skin_host.client.requests import (
    CommandError,
    Request,
    Requests,
    answer_within_s,
    refuse_wrong_name,
)
from skin_host.client.streams import ENDED, UNENTERED, Kind, Stream, refuse_other_loop
from skin_host.client.subscriptions import Subscriptions
from skin_host.errors import BrokerError, RequestError, SkinError, some_of, visible
from skin_host.fingertip.events import Over, Slip
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import (
    Connection,
    Message,
    MqttError,
    explain,
    message_properties,
)
from skin_host.mqtt.info import NodeInfo
from skin_host.mqtt.messages import Frame
from skin_host.mqtt.payload import JSON_TYPE
from skin_host.mqtt.topics import Topics, wrong_part
from skin_host.processing.events import Touch
from skin_host.tasks import cancel

#: Daemons find a broker that starts, or that comes back, within 3 s. This long after the last of
#: them has named its parts there are no others.
NAMED_S = 5.0
#: Health comes once a second, and may come late: nothing could be called stale sooner.
LEAST_STALE_S = 1.5
#: Timeouts are checked this often.
WATCH_S = 0.25

T = TypeVar("T")
_log = logging.getLogger(__name__)


class SkinClient:
    """One robot's skin, received over MQTT.

    Args:
        broker: `mqtt://[user[:password]@]host[:port][/base][?protocol=3.1.1]`, `mqtts://...`, or
            a `Broker`. Or several, nodes of a cluster or not: messages are received from whichever
            the robot publishes to, each event once and in order. They need MQTT 5, and `robot`.
        robot: its name; by default the only robot that the broker knows, or that is online.
        base: of the topics; "skin" unless the URL or this states otherwise.
        protocol: of MQTT, for a broker given by URL.
        patience_s: how long entering waits for a broker that cannot be reached.
        stale_s: a part that was not received for this long, or only so late, is UNKNOWN to
            `contacts`; `LEAST_STALE_S` or more.

    Attributes:
        connections: how often a broker was found; more than the number of brokers means that one
            was lost.
        last_error: why one was lost, or not found.
        unreadable: messages whose payload did not fit their topic, or needs a package that is not
            installed.

    Raises (on making it):
        RequestError: the URL is wrong, a time is negative or no number, `stale_s` is too short, or
            several brokers are named without the robot.

    Raises (on entering):
        BrokerError: no broker, or one that refuses us.
        RequestError: it is not clear which robot is meant, or the client was entered before.

    Raises (in use):
        RequestError: no part can have such a name, the event loop is not the one in which the
            client was entered, or it was not entered, or has ended. Streams may be opened before it
            is entered.

    Raises (on reading a stream, once):
        RequestError: the robot has no part of this name, and had none since the stream was opened.
            All nodes have named their parts for `NAMED_S`, and one of them is online; those of a
            node that is offline are known from what the broker keeps. A part of a node that starts
            later still is received by who reads on. Or nothing of this kind comes of the part: of a
            fingertip on a force/torque board no frames, nor of a part whose configuration has
            `frames = false`; of a part of skin no slips and no excesses.
        SkinError: the frames of the part are in CBOR, and cbor2 is not installed.
    """

    def __init__(
        self,
        broker: str | Broker | Sequence[str | Broker] = "mqtt://localhost",
        *,
        robot: str | None = None,
        base: str | None = None,
        protocol: Literal["5", "3.1.1"] = "5",
        patience_s: float = 10.0,
        stale_s: float = STALE_S,
    ) -> None:
        brokers: list[Broker] = []
        for one in [broker] if isinstance(broker, str | Broker) else broker:
            if isinstance(one, str):
                found, path = Broker.from_url(one, protocol)
                base = base or path
            else:
                found = one
            brokers.append(found)
        _check_several(brokers, robot)
        _check_times(patience_s=patience_s, stale_s=stale_s)
        if stale_s < LEAST_STALE_S:
            raise RequestError(
                f"stale_s: seen {stale_s}, wanted {LEAST_STALE_S} s or more: health comes once a "
                "second, and a part is not known in between otherwise"
            )
        self._base = base or "skin"
        self._robot = robot
        self._patience_s = patience_s
        self._identifier = f"skin-client-{secrets.token_hex(4)}"
        self._requests = Requests(self._identifier)
        self._streams: WeakSet[Stream[Any]] = WeakSet()
        self._intake = Intake(self._streams, self._requests, stale_s, len(brokers))
        self._presence, self._nodes = self._intake.presence, self._intake.nodes
        self._news = asyncio.Event()
        #: In which the client was entered.
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stopping = False
        self._tasks: list[asyncio.Task[None]] = []
        # Nodes of a cluster share clients' names, so each link has its own.
        self._links = [
            BrokerLink(i, one, self._identifier + f"-{i}" * (len(brokers) > 1), self)
            for i, one in enumerate(brokers)
        ]
        #: None until the robot's name is known.
        self._subscriptions = None if robot is None else self._subscriptions_of(robot)
        self.last_error = ""

    def _subscriptions_of(self, robot: str) -> Subscriptions:
        topics = Topics(self._base, robot)
        if self._links[0].broker.v5:
            replies = topics.reply("+", self._identifier)
        else:
            replies = topics.result("+", "+")
        return Subscriptions(topics, replies, self._streams)

    @property
    def robot(self) -> str:
        return self._robot or ""

    @property
    def nodes(self) -> dict[str, Node]:
        """The robot's daemons by name, as far as they have been received."""
        return self._nodes.known

    @property
    def connected(self) -> bool:
        """Return whether the broker, or one of them, is connected now."""
        return any(link.connection for link in self._links)

    @property
    def connections(self) -> int:
        """How often a broker was found."""
        return sum(link.connections for link in self._links)

    @property
    def unreadable(self) -> int:
        """How many messages could not be read."""
        return self._intake.unreadable

    @property
    def info_error(self) -> str:
        """Why no node of the robot is described, if what one published could not be read."""
        is_described = any(node.info for node in self.nodes.values())
        return "" if is_described else self._intake.info_error

    def touches(self, part: str | None = None) -> Stream[Touch]:
        """Touch events of a part, or of all."""
        return self._stream(part, "touch")

    def slips(self, part: str | None = None) -> Stream[Slip]:
        """Slips of a fingertip, or of all: they begin and end."""
        return self._stream(part, "slip")

    def overs(self, part: str | None = None) -> Stream[Over]:
        """Excesses: when a fingertip, or any, begins or ends to press too hard."""
        return self._stream(part, "over")

    def events(self, part: str | None = None) -> Stream[Touch | Slip | Over]:
        """Touches, slips and excesses of a part, or of all, in the order in which they arrive."""
        return self._stream(part, "touch", "slip", "over")

    def frames(self, part: str | None = None) -> Stream[Frame]:
        """Frames of a part, or of all: pressure in kPa as numpy arrays.

        A reader that is more than `LATE_S` late continues with the newest frame of each part; the
        others are counted by its `missed`.
        """
        return self._stream(part, "frame")

    def contacts(self, part: str | None = None) -> Stream[Contact]:
        """Contact states of parts: the present one, and each change.

        The present one comes as soon as anything of the part does that the broker had not stored,
        which takes up to a second, or as UNKNOWN after `stale_s`.

        A slow reader gets no OFF that is not true any more.

        UNKNOWN is an item of its own: when the node cannot feel all of the part, when the part was
        not received for `stale_s` or its state was deleted, when its node stops or the broker is
        lost.
        """
        return self._stream(part, "contact")

    def present(self, part: str | None = None) -> list[Touch]:
        """Return the last event of each contact that lasts now, as far as known: none of a part
        whose state is not known because nothing is received of it.

        They are followed while a stream of `contacts`, `touches` or `events` exists.

        Raises:
            RequestError: the robot has no such part.
            BrokerError: a broker does not let us subscribe to its touches.
        """
        self._check_entered()
        self._check_use(part)
        missing = self._missing(part, _now_s())
        if missing is not None:
            raise RequestError(missing)
        self._refuse_unread(lambda subscriptions: subscriptions.of("touch", part))
        return self._presence.touches(part, _now_s())

    def health(self, part: str | None = None) -> Stream[Health]:
        """Health of parts: the last one, see `Health.stored`, and each change."""
        return self._stream(part, "health")

    def infos(self, part: str | None = None) -> Stream[Described]:
        """Descriptions of a part, or of all: the present one, and each change of it, as after a
        `reload`, or when the part moves to another node, or no node names it any more.
        """
        return self._stream(part, "info")

    def parts(self) -> dict[str, Described]:
        """Return the parts and fingertips by name, each with its description and the node that has
        it now, see `Described`.

        As far as they have been received: after `info()` those of all nodes that are online.
        """
        return self._nodes.parts()

    async def ready(self) -> None:
        """Wait until all subscriptions so far have reached the broker.

        Raises:
            BrokerError: a broker does not let us subscribe to a topic that a stream needs, or to
                those of the nodes.
        """

        def is_ready() -> bool:
            want = set(self.wanted())
            made = [link for link in self._links if link.connection]
            return bool(made) and all(link.has(want) for link in made)

        await self._until(is_ready)
        self._refuse_unread(lambda one: set(one.nodes).union(*map(one.required, self._streams)))

    async def info(self, timeout_s: float = 5.0) -> dict[str, NodeInfo]:
        """Return the descriptions of the robot's nodes: parts, taxels, places.

        Waits for those of all nodes that are online, and returns what there is after `timeout_s`.

        Raises:
            BrokerError: none was received within `timeout_s`.
            RequestError: `timeout_s` is no time.
        """
        _check_times(timeout_s=timeout_s)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._until(lambda: self._nodes.are_described)
        known = {name: node.info for name, node in self.nodes.items() if node.info is not None}
        if not known:
            self._refuse_unread(lambda subscriptions: set(subscriptions.nodes))
            why = self.info_error or await self.absence("published its info")
            raise BrokerError(f"broker {self.where}: {why}")
        return known

    async def command(
        self,
        name: str,
        *,
        node: str | None = None,
        timeout_s: float | None = None,
        **arguments: Any,
    ) -> dict[str, Any]:
        """Send a command to a node and return its result.

        Args:
            name: of the command.
            node: which one; by default the robot's only node.
            timeout_s: how long to wait for the answer. None: `ANSWER_S`, and of a command that has
                `seconds` that many more.
            arguments: of the command. The request's `id` is the client's, whatever is given.

        Raises:
            CommandError: the node is offline, takes no commands, refused, failed, or did not
                answer in time.
            WrongCommandError: the node found the request wrong. It is a `CommandError` and a
                `RequestError`.
            RequestError: it is not clear which node is meant, or a name or a number cannot be sent.
            BrokerError: no node is online, or the broker does not let us receive answers.
        """
        if node is not None:
            refuse_wrong_name(node)
        if timeout_s is None:
            timeout_s = answer_within_s(arguments)
        _check_times(timeout_s=timeout_s)
        with self._requests.request(name, arguments) as request:
            try:
                async with asyncio.timeout(timeout_s):
                    known = await self._nodes_of_command(node)
                    node = node or await self._only(known)
                    self._refuse_deaf(node)
                    self._refuse_unread(lambda subscriptions: {subscriptions.replies})
                    await self._ask(node, name, request.payload)
                    await self._until(partial(self._is_answered, request, node))
            except TimeoutError:
                if not self.connected:
                    raise CommandError(f"broker {self.where}: {self.last_error}") from None
                running = "is `skin run` running there?"
                raise CommandError(
                    f'no answer to "{name}" from node "{node or "?"}" of robot "{self.robot}" '
                    f"within {timeout_s:g} s; it may still be carried out; "
                    f"{running if self.nodes else await self.absence('is known')}"
                ) from None
            except MqttError as error:
                raise CommandError(f"broker {self.where}: {explain(error)}") from None
        return request.result()

    def _is_answered(self, request: Request, node: str) -> bool:
        if request.answer is None:
            self._refuse_deaf(node)
        return request.answer is not None

    def _refuse_deaf(self, node: str) -> None:
        """Refuse to wait for the answer of a node that receives no request."""
        known = self.nodes.get(node, Node())
        why = None
        if known.online is False:
            why = "is offline; is `skin run` running there?"
        elif known.info is not None and not known.info.commands:
            why = "takes no commands: its configuration has `[mqtt] commands = false`"
        if why is not None:
            raise CommandError(f'node "{node}" of robot "{self.robot}" {why}')

    async def __aenter__(self) -> Self:
        if self._loop is not None:
            raise RequestError("this client was entered before: make another one")
        self._loop = asyncio.get_running_loop()
        for stream in self._streams:
            stream.loop, stream.is_early = self._loop, False
        self._tasks = [
            asyncio.create_task(link.run(), name=f"skin client {link.broker}")
            for link in self._links
        ]
        self._tasks.append(asyncio.create_task(self._watch(), name="skin client's watch"))
        failure: SkinError | None = None
        try:
            async with asyncio.timeout(self._patience_s) as waiting:
                await self._until(lambda: self._is_settled or self._is_asking)
                if self._is_asking:  # the broker was reached in time; its answer takes longer
                    waiting.reschedule(_now_s() + max(self._patience_s, ROBOT_S))
                await self._until(lambda: self._is_settled)
        except TimeoutError:
            if not self.connected:
                failure = self._absence()
        except BaseException:
            await self._stop()
            raise
        if not self.connected:
            failure = failure or self._links[0].failure
        if failure is not None:
            await self._stop()
            raise failure
        return self

    @property
    def _is_settled(self) -> bool:
        """Return whether it is known which brokers can be reached, and at least one can."""
        if all(link.failure for link in self._links):
            return True
        return self.connected and all(link.tried for link in self._links)

    @property
    def _is_asking(self) -> bool:
        """Return whether the broker is being asked which robot it knows."""
        return self._subscriptions is None and any(link.reached for link in self._links)

    def _absence(self) -> BrokerError:
        link = next((link for link in self._links if not link.failure), self._links[0])
        why = link.last_error or "it does not answer"
        if link.broker.v5 and "does not answer" in why:
            why += "; if it speaks MQTT 3.1.1 alone, end its URL with ?protocol=3.1.1"
        if "closed the connection" in why and not link.broker.tls:
            why += "; if it speaks TLS alone, begin its URL with mqtts://"
        if "no broker listens" in why:
            why += f"; start one, such as `mosquitto -p {link.broker.port}`, or name another"
        return BrokerError(f"broker {self.where}: cannot connect: {why}")

    @property
    def where(self) -> str:
        """The address of the broker, or of all."""
        return ", ".join(str(link.broker) for link in self._links)

    async def __aexit__(self, *_: object) -> None:
        refuse_other_loop(self._loop)
        await self._stop()

    async def absence(self, what: str) -> str:
        """Return as a sentence that no node of the robot does something, such as "is online", and
        which other robots the broker knows: the name may be misspelt.
        """
        start = f'no node of robot "{self.robot}" {what}; '
        link = self._links[0]
        others: list[str] = []
        if link.connection and not self.nodes:
            others = await robots_at(link.broker, self._base, f"{self._identifier}-robots")
        names = some_of([visible(name, 64) for name in others])
        return start + (f"there are the robots: {names}" if names else "is `skin run` running?")

    async def _stop(self) -> None:
        self._stopping = True
        await cancel(*self._tasks)
        self._nodes.watch(_now_s())
        self._news.set()
        for stream in list(self._streams):
            stream.close()

    async def _until(self, condition: Callable[[], T | None]) -> T:
        """Wait until `condition` holds, and return its result.

        Raises:
            RequestError: the client was not entered, or in another event loop, or has ended.
        """
        self._check_entered()
        while not (found := condition()):
            self._check_running()
            self._news.clear()
            await self._news.wait()
        return found

    def _check_entered(self) -> None:
        if self._loop is None:
            raise RequestError(UNENTERED)
        self._check_running()

    def _check_running(self) -> None:
        refuse_other_loop(self._loop)
        if self._stopping:
            raise RequestError(ENDED)

    def _check_use(self, part: str | None) -> None:
        self._check_running()
        # A subscription that cannot be made would end the connection, again and again.
        wrong = None if part is None else wrong_part(part)
        if wrong is not None:
            raise RequestError(wrong)

    def _stream(self, part: str | None, *kinds: Kind) -> Stream[Any]:
        self._check_use(part)
        stream: Stream[Any] = Stream(part, *kinds)
        stream.loop, stream.is_early = self._loop, self._loop is None
        self._streams.add(stream)
        self._intake.begin(stream)
        self._ask_again()
        return stream

    def _ask_again(self) -> None:
        for link in self._links:
            link.again.set()

    def _missing(self, part: str | None, now_s: float) -> str | None:
        """Return that the robot has no such part; None: it has, or may have.

        A node that publishes it may have been started a moment later than the others, or be known
        to a broker that is away.
        """
        if part is None or not all(link.connection for link in self._links):
            return None
        names = self._presence.named()
        since_s = max(self._nodes.named_s, *(link.since_s for link in self._links))
        if names is None or part in names or now_s - since_s < NAMED_S:
            return None
        return no_such_part(self.robot, part, names)

    def _check_parts(self, now_s: float) -> None:
        """Fail the streams of parts that the robot does not have, and never had, and those of what
        its parts do not publish.
        """
        names = self._presence.named() or ()
        for stream in self._streams:
            stream.is_judged |= stream.part in names
            missing = None if stream.is_judged else self._missing(stream.part, now_s)
            why = missing or unpublished(self.robot, stream.part, stream.kinds, self.parts())
            if why is not None:
                stream.fail(why)

    async def _nodes_of_command(self, wanted: str | None) -> list[str]:
        """Return the robot's nodes once those that the broker keeps are known, or, if it is known
        before, once the wanted one is.

        Raises:
            RequestError: none of them is the wanted one.
        """
        await self._until(lambda: self.connected)
        if wanted not in self.nodes:
            # By then all retained messages have been received: there are no more nodes than these.
            age_s = _now_s() - max(link.since_s for link in self._links)
            await asyncio.sleep(max(0.0, RETAINED_S - age_s))
        known = sorted(self.nodes)
        # A broker may keep nothing, or let us read nothing of it, and hand on commands.
        if wanted is not None and known and wanted not in known:
            raise RequestError(
                f'robot "{self.robot}": it has no node "{wanted}"; wanted one of: '
                f"{', '.join(known)}"
            )
        return known

    async def _only(self, known: list[str]) -> str:
        """Return the node of these that is online.

        Raises:
            BrokerError: there is none.
            RequestError: there are several.
        """
        known = [name for name in known if self.nodes[name].online is not False]
        online = [name for name in known if self.nodes[name].online] or known
        if len(online) == 1:
            return online[0]
        if not online:
            raise BrokerError(f"broker {self.where}: {await self.absence('is online')}")
        raise RequestError(
            f'robot "{self.robot}": wanted one node that is online, there are: '
            f"{', '.join(online)}; name the node"
        )

    async def _ask(self, node: str, name: str, request: bytes) -> None:
        connection = await self._until(lambda: self._way_to(node))
        assert connection is not None and self._subscriptions is not None
        topics = self._subscriptions.topics
        properties = message_properties(self._links[0].broker, JSON_TYPE)
        if properties is not None:
            properties.ResponseTopic = topics.reply(node, self._identifier)
        why = await connection.request(topics.command(node, name), request, properties)
        if why:
            raise CommandError(
                f"broker {self.where}: does not let us command ({why}); log in as one who may"
            )

    def _refuse_unread(self, needs: Callable[[Subscriptions], set[str]]) -> None:
        """Refuse what needs a topic that a broker does not let us subscribe to.

        Raises:
            BrokerError: there is one among these.
        """
        if self._subscriptions is None:
            return
        for link in self._links:
            for topic in sorted(link.refused & needs(self._subscriptions)):
                raise refusal(link.broker, topic)

    def _note_refusals(self, link: BrokerLink) -> None:
        """Let streams raise that a broker refuses what they need."""
        if self._subscriptions is None or not link.refused:
            return
        for stream in self._streams:
            for topic in self._subscriptions.required(stream) & link.refused:
                stream.refuse(topic, refusal(link.broker, topic))
        for part in self._intake.parts:
            if link.refused & self._subscriptions.of("contact", part):
                self._presence.take_refusal(part, link.number)

    def _way_to(self, node: str) -> Connection | None:
        """Return the connection to a broker where a node is; a request must not reach it twice."""
        over = self._presence.brokers(node)
        for link in self._links:
            if link.connection and (link.number in over or len(self._links) == 1):
                return link.connection
        return None

    async def prepare(self, connection: Connection, broker: Broker) -> None:
        if self._subscriptions is None:
            self._robot = await only_robot(connection, broker, self._base)
            self._subscriptions = self._subscriptions_of(self._robot)

    def note(self, link: BrokerLink) -> None:
        if link.last_error:
            self.last_error = link.last_error
        if link.connection is None:
            self._presence.take_loss(link.number)
        self._note_refusals(link)
        if not self._stopping:
            self._intake.look()
        self._news.set()

    def unfollow(self, topic: str) -> None:
        assert self._subscriptions is not None
        place = self._subscriptions.topics.parse(topic)
        if place is not None:
            self._intake.forget(place.kind, self._subscriptions.kinds_of)

    def wanted(self) -> Iterable[str]:
        return () if self._subscriptions is None else self._subscriptions.wanted()

    def take(self, link: BrokerLink, message: Message) -> None:
        assert self._subscriptions is not None
        place = self._subscriptions.topics.parse(message.topic.value)
        if place is None:
            return
        if not self._intake.take(place, message, link.number, self._subscriptions.kinds_of):
            self._ask_again()
        if place.kind in ("status", "info", "answer"):
            self._news.set()

    async def _watch(self) -> None:
        """Detect timeouts."""
        while True:
            await asyncio.sleep(WATCH_S)
            self._intake.expire()
            self._check_parts(_now_s())


def _check_several(brokers: list[Broker], robot: str | None) -> None:
    if not brokers:
        raise RequestError("no broker is named")
    if len(brokers) == 1:
        return
    if robot is None:
        raise RequestError("with several brokers name the robot")
    if not all(one.v5 for one in brokers):
        raise RequestError(
            "several brokers need MQTT 5, which distinguishes new messages from old ones"
        )


def _check_times(**times_s: float) -> None:
    """Refuse what no time can be compared with: without a number nothing would ever be late."""
    for name, time_s in times_s.items():
        if not time_s >= 0:
            raise RequestError(f"{name}: seen {time_s}, wanted seconds from 0 on")


def _now_s() -> float:
    return asyncio.get_running_loop().time()
