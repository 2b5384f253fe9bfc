"""A broker in memory, at the seam of `publish.connection`.

It takes and sends messages after a latency, keeps retained ones, publishes the last will of a
client that vanishes, and can be absent, frozen, unwilling, forgetful or repeat itself. What it
acknowledged and what its subscribers got is passed on to whoever watches.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, cast

from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from skin_host.clock import Clock
from skin_host.evaluation.simulate.trace import Trace
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import TIMEOUT_S, Connection, Message, MqttError, Will
from skin_host.mqtt.packets import unpack_number

#: One way.
LATENCY_S = 0.001
#: A connection takes no more than so many packets that the broker does not read.
WAITING_PACKETS = 64


class MemoryBroker:
    """The broker.

    Args:
        clock: time.
        trace: takes every publication.

    Attributes:
        absent: nobody listens at its address.
        frozen: it answers nobody.
        refuses: it refuses clients.
        doubles: subscribers get each message twice.
        retained, properties: retained messages, by topic.
        listeners: called with topic and payload of each message to subscribers.
    """

    def __init__(self, clock: Clock, trace: Trace) -> None:
        self.clock = clock
        self.trace = trace
        self.absent = False
        self.frozen = False
        self.refuses = False
        self.doubles = False
        self.retained: dict[str, bytes] = {}
        self.properties: dict[str, Any] = {}
        self.listeners: list[Callable[[str, bytes], None]] = []
        self._lines: dict[str, Line] = {}
        self._held: list[Callable[[], None]] = []

    def connector(self, life: "Living") -> Callable[..., Any]:
        """What a daemon connects by; when it has died, so have its connections."""

        @asynccontextmanager
        async def connect(
            address: Broker,
            *,
            identifier: str,
            will: Will,
            max_incoming: int = 64,
            clock: Clock,
            **_options: object,
        ) -> AsyncIterator[Connection]:
            await clock.sleep(2 * LATENCY_S)
            if life.dead or self.absent:
                raise MqttError("Connection refused")
            if self.frozen:
                await clock.sleep(TIMEOUT_S)
                raise MqttError("Operation timed out")
            if self.refuses:
                raise MqttError("Not authorized")
            line = Line(self, identifier, will, max_incoming, v5=address.v5)
            life.lines.append(line)
            self._admit(line)
            try:
                yield cast(Connection, line)
                line.leave()
            except BaseException:
                line.cut()
                raise

        return connect

    def set_frozen(self, *, frozen: bool) -> None:
        """Stop, or go on with all that has come meanwhile."""
        self.frozen = frozen
        if not frozen:
            held, self._held = self._held, []
            for work in held:
                work()

    def do(self, work: Callable[[], None]) -> None:
        """Do something now, or when it is not frozen any more."""
        if self.frozen:
            self._held.append(work)
        else:
            work()

    def stop(self, *, forget: bool) -> None:
        """It goes away, and with it every connection; what is retained may be forgotten."""
        self.absent = True
        self._held.clear()
        self.frozen = False
        for line in list(self._lines.values()):
            line.end("the broker is gone", accusing=False)
        self._lines.clear()
        if forget:
            self.retained.clear()

    def disconnect_all(self, *, accusing: bool) -> None:
        """End every connection; with `accusing`, without a reason, as if over a publication."""
        for line in list(self._lines.values()):
            self.lose(line)
            line.end("closed", accusing=accusing)

    def _admit(self, line: "Line") -> None:
        before = self._lines.get(line.identifier)
        if before is not None:
            self.lose(before)
            before.end("session taken over", accusing=False)
        self._lines[line.identifier] = line
        self.trace.note(self.clock.monotonic_ns(), f"broker: {line.identifier} connects")

    def lose(self, line: "Line") -> None:
        """A client vanished without a word."""
        if self._lines.get(line.identifier) is line:
            del self._lines[line.identifier]
            self.trace.note(self.clock.monotonic_ns(), f"broker: {line.identifier} is lost")
            payload = line.will.payload
            assert isinstance(payload, str | bytes)
            words = payload.encode() if isinstance(payload, str) else payload
            will = line.will
            self.accept(will.topic, words, retain=will.retain, properties=will.properties)

    def leave(self, line: "Line") -> None:
        """A client has disconnected."""
        if self._lines.get(line.identifier) is line:
            del self._lines[line.identifier]
            self.trace.note(self.clock.monotonic_ns(), f"broker: {line.identifier} leaves")

    def accept(
        self, topic: str, payload: bytes, *, retain: bool = False, properties: Any = None
    ) -> None:
        """Take a publication: keep it, if it is to be retained, and give it to subscribers."""
        self.trace.data(self.clock.monotonic_ns(), topic, payload)
        if retain:
            self.retained[topic], self.properties[topic] = payload, properties
        for _ in range(2 if self.doubles else 1):
            for listener in self.listeners:
                listener(topic, payload)
        for line in list(self._lines.values()):
            if line.wants(topic):
                line.give(topic, payload, retain=retain, properties=properties)

    def request(self, topic: str, payload: bytes, reply_to: str, correlation: bytes) -> None:
        """Publish a command, as an operator does."""
        properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
        properties.ResponseTopic = reply_to
        properties.CorrelationData = correlation
        self.do(lambda: self.accept(topic, payload, properties=properties))


class Living:
    """Something that can die with its connections.

    Attributes:
        dead: it does nothing any more.
        lines: its connections.
    """

    def __init__(self) -> None:
        self.dead = False
        self.lines: list[Line] = []


class Line:
    """One connection, with what the publisher uses of `publish.connection.Connection`."""

    packet_limit: int | None = None
    refusal = ""

    def __init__(
        self, broker: MemoryBroker, identifier: str, will: Will, max_incoming: int, *, v5: bool
    ) -> None:
        self.when_clear: Callable[[], object] = lambda: None
        self._is_refusing = False
        self._v5 = v5
        self.identifier = identifier
        self.will = will
        self.refused = 0
        self.discarded = 0
        self.taken_over = False
        self.ended_by_broker = self.without_reason = False
        self._broker = broker
        self._topics: list[str] = []
        self._loop = asyncio.get_running_loop()
        self._ended: asyncio.Future[None] = self._loop.create_future()
        self._ended.add_done_callback(lambda future: future.cancelled() or future.exception())
        self._incoming: asyncio.Queue[Message | None] = asyncio.Queue(max_incoming)
        self._out: list[tuple[str, bytes, int, bool, Any, asyncio.Future[None]]] = []
        self._due = False
        self._mid = 0

    # ------------------------------------------------------------------ the publisher's side

    def send(
        self,
        topic: str,
        payload: bytes,
        *,
        qos: int = 0,
        retain: bool = False,
        properties: Any = None,
        hold: bool = False,  # nothing waits for the end of the turn
    ) -> "asyncio.Future[None]":
        if self._ended.done():
            raise MqttError("not sent: the connection is lost")
        done = self._loop.create_future()
        if qos == 0:
            done.set_result(None)
        self._out.append((topic, payload, qos, retain, properties, done))
        if not self._due:
            self._due = True
            self._loop.call_later(LATENCY_S, self._arrive)
        return done

    async def publish(self, topic: str, payload: bytes | str, qos: int = 0, **options: Any) -> None:
        """Send and wait for the acknowledgement."""
        words = payload.encode() if isinstance(payload, str) else payload
        done = self.send(topic, words, qos=qos, **options)
        await asyncio.wait([done, self._ended], timeout=TIMEOUT_S, return_when="FIRST_COMPLETED")
        if not done.done():
            raise MqttError("Operation timed out")

    def is_clear(self) -> bool:
        """See `Connection.is_clear`: the kernel keeps so much for a broker that reads nothing."""
        if self._ended.done():
            return False
        clear = len(self._out) < WAITING_PACKETS
        self._is_refusing |= not clear
        return clear

    def write_now(self, packets: list[bytes]) -> int:
        if not self.is_clear():
            return 0
        for packet in packets:
            self.send(*_published(packet, v5=self._v5))
        return len(packets)

    def flush(self) -> None:
        """Nothing waits for the end of the turn."""

    def fits(self, topic: str, payload: bytes, properties: Any) -> bool:
        """Every size does."""
        return True

    def room(self, topic: str) -> int | None:
        """There is no limit."""
        return None

    async def listen_to(self, topic: str) -> bool:
        await asyncio.wait([self._ended], timeout=2 * LATENCY_S)
        while self._broker.frozen and not self._ended.done():
            await asyncio.wait([self._ended], timeout=0.1)
        if self._ended.done():
            raise MqttError("not subscribed: the connection is lost")
        self._topics.append(topic)
        for known, payload in list(self._broker.retained.items()):
            if _matches(topic, known):
                properties = self._broker.properties[known]
                self._put(known, payload, retain=True, properties=properties)
        return True

    @property
    async def messages(self) -> AsyncIterator[Message]:
        """See aiomqtt."""
        while True:
            message = await self._incoming.get()
            if message is None:
                raise MqttError("Disconnected during message iteration")
            yield message

    async def lost(self) -> None:
        await asyncio.wait([self._ended])
        raise self._ended.exception() or MqttError("the connection has ended")

    def cut(self) -> None:
        if not self._ended.done():
            self._end("cut")
            self._broker.do(lambda: self._broker.lose(self))

    def leave(self) -> None:
        """Disconnect."""
        if not self._ended.done():
            self._end("goodbye")
            self._broker.do(lambda: self._broker.leave(self))

    # ------------------------------------------------------------------ the broker's side

    def wants(self, topic: str) -> bool:
        """Whether it has subscribed to a topic."""
        return any(_matches(wanted, topic) for wanted in self._topics)

    def give(self, topic: str, payload: bytes, *, retain: bool, properties: Any) -> None:
        """Send a message to the client."""
        self._loop.call_later(
            LATENCY_S, lambda: self._put(topic, payload, retain=retain, properties=properties)
        )

    def end(self, why: str, *, accusing: bool) -> None:
        """The broker ends the connection."""
        self.ended_by_broker = self.without_reason = accusing
        if not self._ended.done():
            self._end(why)

    def vanish(self) -> None:
        """The client's process died: its socket is closed by its kernel."""
        self.cut()

    def _end(self, why: str) -> None:
        self._ended.set_exception(MqttError(why))
        if self._incoming.full():
            self._incoming.get_nowait()
        self._incoming.put_nowait(None)

    def _put(self, topic: str, payload: bytes, *, retain: bool, properties: Any) -> None:
        if self._ended.done():
            return
        if self._incoming.full():
            self.discarded += 1
            return
        self._mid += 1
        came = _as_received(properties)
        self._incoming.put_nowait(Message(topic, payload, 1, retain, self._mid, came))

    def _arrive(self) -> None:
        """What was sent has come over the network, unless the connection ended before."""

        def take() -> None:
            self._due = False
            out, self._out = self._out, []
            if self._ended.done():
                return
            if self._is_refusing:
                self._is_refusing = False
                self._loop.call_soon(self.when_clear)
            acknowledged = []
            for topic, payload, qos, retain, properties, done in out:
                self._broker.accept(topic, payload, retain=retain, properties=properties)
                if qos:
                    acknowledged.append(done)
            if acknowledged:
                self._loop.call_later(LATENCY_S, self._acknowledge, acknowledged)

        self._broker.do(take)

    def _acknowledge(self, acknowledged: "list[asyncio.Future[None]]") -> None:
        if self._ended.done():
            return
        for done in acknowledged:
            if not done.done():
                done.set_result(None)


def _published(packet: bytes, *, v5: bool) -> tuple[str, bytes]:
    """Topic and payload of a PUBLISH packet with QoS 0."""
    _, at = unpack_number(packet, 1)
    name = at + 2
    at = name + int.from_bytes(packet[at:name], "big")
    topic = packet[name:at].decode()
    if v5:
        length, at = unpack_number(packet, at)
        at += length
    return topic, packet[at:]


def _as_received(properties: Any) -> Properties | None:
    """Properties after their way over the network."""
    if properties is None:
        return None
    came = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    came.unpack(properties.pack())  # type: ignore[no-untyped-call]
    return came


def _matches(wanted: str, topic: str) -> bool:
    """Whether a topic is one of those that were subscribed to; `+` stands for a last level."""
    if wanted.endswith("/+"):
        return topic.rpartition("/")[0] == wanted[:-2]
    return wanted == topic
