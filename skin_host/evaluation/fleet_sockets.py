"""Both ends of a fleet at a fraction of the cost: the same packets over plain sockets.

A `PlainEar` receives what a `client.links.BrokerLink` does. A `PlainRobot` is put what a
`mqtt.publisher.Publisher` is put, and does the same with it where it matters for a fleet: events
wait in a queue, go out in order, are acknowledged (QoS 1), and are sent again after a loss; the
next broker gets what was acknowledged shortly before, and all states again; messages have the
numbers by which clients distinguish old from new. It has no frames, commands, access rules, packet
limits or bounds of its queue. paho and aiomqtt have no part in either.
Source: MQTT 5.0, sections 3.1 to 3.4 and 3.8.
"""

import asyncio
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

from skin_host.config.settings import Mqtt
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import FIRST_RETRY_S, GOOD_S, TIMEOUT_S, Retry, message_properties
from skin_host.mqtt.courier import RETAINED_WINDOW, TOUCH_WINDOW
from skin_host.mqtt.messages import ContactState, encode_contact, encode_event, encode_health
from skin_host.mqtt.order import RUN, STAMP, Numbers, Stamp, put_run
from skin_host.mqtt.outbox import REPEAT_S, REPEATED
from skin_host.mqtt.packets import pack_number, pack_text, unpack_number
from skin_host.mqtt.payload import JSON_TYPE
from skin_host.mqtt.topics import OFFLINE, ONLINE, Topics
from skin_host.processing.events import Touch

_CONNACK, _PUBLISH, _PUBACK, _SUBACK = 0x20, 0x30, 0x40, 0x90
_EVENT, _STATE = b"\x32", b"\x33"  # PUBLISH with QoS 1; the second is retained
#: Of CONNECT: clean start; a will that is retained and has QoS 1; a name and a password.
_CLEAN, _WILL, _NAMED = 0x02, 0x2C, 0xC0
#: None: the broker does not ask who is silent.
KEEPALIVE_S = 0
_REFUSED = 0x80


class PlainRobot(asyncio.Protocol):
    """One robot with one part.

    Attributes:
        connected: a broker has accepted the connection.
        connections: how often that was so.
        address: of that broker.
        count: how many events were put.
        events: those that were not acknowledged, in order.
    """

    def __init__(self, settings: Mqtt, robot: str) -> None:
        self._brokers = Broker.all_from_settings(settings, Path(), f"{robot}/main")
        self._topics = Topics(settings.base, robot)
        self._identifier = f"{settings.base}/{robot}/main"
        self._status = self._topics.node("status", "main")
        self._numbers = Numbers(time.time_ns, time.monotonic_ns)
        properties: Any = message_properties(self._brokers[0], JSON_TYPE)
        put_run(properties, self._numbers.run)
        self._event_properties: bytes = properties.pack()
        self._touch_topic = b""
        self.connected = False
        self.connections = 0
        self.address = ""
        self.count = 0
        self.events: deque[bytes] = deque()
        self._passed_on: deque[tuple[float, bytes]] = deque(maxlen=REPEATED)
        #: Number and time of those of the first events that are on their way.
        self._events_out: deque[tuple[int, float]] = deque()
        self._acknowledged: set[int] = set()
        self._retained: dict[str, bytes] = {self._status: ONLINE}
        self._pending: dict[str, None] = {}
        #: By number: topic, payload and time of the states that are on their way.
        self._states_out: dict[int, tuple[str, bytes, float]] = {}
        self._mid = 0
        self._transport: asyncio.Transport | None = None
        self._received = b""
        self._accepted: asyncio.Future[None]
        self._lost: asyncio.Future[None]

    @property
    def waiting(self) -> int:
        """How many events are not acknowledged."""
        return len(self.events)

    def put_touch(self, event: Touch) -> None:
        """Send an event."""
        self._touch_topic = self._touch_topic or pack_text(self._topics.part("touch", event.part))
        self.count += 1
        self.events.append(encode_event(event, self.count))
        self._send()

    def put_contact(self, part: str, state: ContactState) -> None:
        """Send the state of a contact, if it has changed."""
        topic, payload = self._topics.part("contact", part), encode_contact(state)
        if self._retained.get(topic) != payload:
            self._put_state(topic, payload)

    def put_health(self, part: str, record: Any) -> None:
        """Send a record of health."""
        self._put_state(self._topics.part("health", part), _encoded(record))

    async def __aenter__(self) -> Self:
        self.task = asyncio.create_task(self._run())
        return self

    async def _run(self) -> None:
        """Be connected to one broker after the other."""
        retry = Retry()
        turn, untried, last = 0, len(self._brokers), -1
        while True:
            number = turn % len(self._brokers)
            try:
                up_s = await self._stay(self._brokers[number], repeat=last not in (-1, number))
            finally:
                self._abort()
            if up_s > 0.0:
                last = number
            turn += 1
            untried = (len(self._brokers) if up_s >= GOOD_S else untried) - 1
            wait_s = FIRST_RETRY_S
            if untried <= 0:
                untried, wait_s = len(self._brokers), retry.delay_s(up_s)
            await asyncio.sleep(wait_s)

    async def _stay(self, broker: Broker, *, repeat: bool) -> float:
        """Be connected to a broker for as long as it lasts; return how long, 0 if never."""
        loop = asyncio.get_running_loop()
        self._accepted, self._lost = loop.create_future(), loop.create_future()
        self._received = b""
        self._numbers.connect()
        try:
            async with asyncio.timeout(TIMEOUT_S):
                transport, _ = await loop.create_connection(lambda: self, broker.host, broker.port)
                will = self._status, OFFLINE, self._numbers.last_will
                transport.write(_connect(broker, self._identifier, will))
                await self._accepted
        except (OSError, TimeoutError):
            return 0.0
        since_s = time.monotonic()
        self.connections += 1
        self.address = f"{broker.host}:{broker.port}"
        self._events_out.clear()
        self._acknowledged.clear()
        self._states_out.clear()
        self._pending = dict.fromkeys(self._retained)
        if repeat:
            recent = [one for at_s, one in self._passed_on if since_s - at_s <= REPEAT_S]
            self._passed_on.clear()
            self.events.extendleft(reversed(recent))
        self.connected = True
        self._send()
        while not self._lost.done():
            await asyncio.wait([self._lost], timeout=TIMEOUT_S / 4)
            if self._is_late(time.monotonic()):
                self._abort()
        self.connected = False
        return time.monotonic() - since_s

    def _is_late(self, now_s: float) -> bool:
        """Whether something has not been acknowledged in time: the broker is lost."""
        sent_s = [at_s for _, at_s in self._events_out]
        sent_s += [at_s for _, _, at_s in self._states_out.values()]
        return bool(sent_s) and now_s - min(sent_s) > TIMEOUT_S

    def _abort(self) -> None:
        if self._transport is not None:
            self._transport.abort()
        self.connected = False

    def _put_state(self, topic: str, payload: bytes) -> None:
        self._retained[topic] = payload
        self._pending[topic] = None
        self._send()

    def _send(self) -> None:
        """Send what waits, as far as the windows allow, in one write."""
        if not self.connected or self._transport is None:
            return
        now_s = time.monotonic()
        packets = []
        while len(self._events_out) < min(len(self.events), TOUCH_WINDOW):
            payload = self.events[len(self._events_out)]
            mid = self._next_mid()
            self._events_out.append((mid, now_s))
            packets.append(
                _publish(_EVENT, self._touch_topic, mid, self._event_properties, payload)
            )
        on_the_way = {topic for topic, _, _ in self._states_out.values()}
        for topic in [one for one in self._pending if one not in on_the_way]:
            if len(self._states_out) == RETAINED_WINDOW:
                break
            mid, payload = self._next_mid(), self._retained[topic]
            self._states_out[mid] = topic, payload, now_s
            stamp = self._numbers.online if topic == self._status else self._numbers.state()
            packets.append(_publish(_STATE, pack_text(topic), mid, _stamped(stamp), payload))
        if packets:
            self._transport.write(b"".join(packets))

    def _next_mid(self) -> int:
        self._mid = self._mid % 0xFFFF + 1
        return self._mid

    def _take_acknowledgement(self, mid: int) -> None:
        state = self._states_out.pop(mid, None)
        if state is not None:
            topic, payload, _ = state
            if self._retained[topic] is payload:
                self._pending.pop(topic, None)
        else:
            self._acknowledged.add(mid)
        now_s = time.monotonic()
        while self._events_out and self._events_out[0][0] in self._acknowledged:
            self._acknowledged.remove(self._events_out.popleft()[0])
            self._passed_on.append((now_s, self.events.popleft()))

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Called by the loop."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def connection_lost(self, exc: Exception | None) -> None:
        """Called by the loop."""
        self.connected = False
        self._transport = None
        if not self._accepted.done():
            self._accepted.set_exception(exc or ConnectionResetError())
        if not self._lost.done():
            self._lost.set_result(None)

    def data_received(self, data: bytes) -> None:
        """Called by the loop with acknowledgements, and pieces of them."""
        packets, self._received = _split(self._received + data)
        for kind, body in packets:
            if kind == _PUBACK:
                self._take_acknowledgement(int.from_bytes(body[:2], "big"))
            elif kind == _CONNACK and not self._accepted.done():
                if body[1] < _REFUSED:
                    self._accepted.set_result(None)
                else:
                    self._accepted.set_exception(ConnectionRefusedError())
        self._send()


class Heard(NamedTuple):
    """A received message."""

    topic: str
    payload: bytes
    retained: bool
    run: int | None
    stamp: Stamp | None


class PlainEar(asyncio.Protocol):
    """A subscriber at one broker.

    Args:
        broker: where.
        identifier: our name there.
        topics: what is subscribed.
        take: called with each message.
        note: called when the connection comes or goes.

    Attributes:
        connected: the broker has taken the subscription.
    """

    def __init__(
        self,
        broker: Broker,
        identifier: str,
        topics: Sequence[str],
        take: Callable[[Heard], None],
        note: Callable[[], None],
    ) -> None:
        self._broker = broker
        self._identifier = identifier
        self._topics = topics
        self._take = take
        self._note = note
        self.connected = False
        self._transport: asyncio.Transport | None = None
        self._received = b""
        self._lost: asyncio.Future[None]

    async def run(self) -> None:
        """Be connected until cancelled."""
        loop = asyncio.get_running_loop()
        retry = Retry()
        while True:
            self._lost, self._received = loop.create_future(), b""
            try:
                async with asyncio.timeout(TIMEOUT_S):
                    transport, _ = await loop.create_connection(
                        lambda: self, self._broker.host, self._broker.port
                    )
                body = b"\0\1\0" + b"".join(pack_text(topic) + b"\1" for topic in self._topics)
                subscribe = b"\x82" + pack_number(len(body)) + body
                transport.write(_connect(self._broker, self._identifier) + subscribe)
                await self._lost
            except (OSError, TimeoutError):
                pass
            finally:
                if self._transport is not None:
                    self._transport.abort()
            await asyncio.sleep(retry.delay_s())

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Called by the loop."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def connection_lost(self, exc: Exception | None) -> None:
        """Called by the loop."""
        self.connected = False
        self._note()
        if not self._lost.done():
            self._lost.set_result(None)

    def data_received(self, data: bytes) -> None:
        """Called by the loop with packets, and pieces of packets."""
        packets, self._received = _split(self._received + data)
        acknowledgements = []
        for first, body in packets:
            if first & 0xF0 == _PUBLISH:
                mid = self._take_message(first, body)
                if mid:
                    acknowledgements.append(b"\x40\2" + mid)
            elif first == _SUBACK:
                self.connected = True
                self._note()
        if acknowledgements and self._transport is not None:
            self._transport.write(b"".join(acknowledgements))

    def _take_message(self, first: int, body: bytes) -> bytes:
        """Pass a message on; return its number, which is empty with QoS 0."""
        at = 2 + int.from_bytes(body[:2], "big")
        topic = body[2:at].decode()
        numbered = 2 if first & 0x06 else 0
        mid = body[at : at + numbered]
        at += numbered
        size = body[at]  # a robot's properties have less than 128 bytes
        properties, payload = body[at + 1 : at + 1 + size], body[at + 1 + size :]
        run, stamp = _user_value(properties, RUN), _user_value(properties, STAMP)
        connection, _, number = stamp.partition(b".")
        newness = Stamp(int(connection), int(number)) if stamp else None
        self._take(Heard(topic, payload, bool(first & 1), int(run) if run else None, newness))
        return mid


def _split(data: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    """Return first byte and body of each whole packet in `data`, and what is left of it."""
    packets = []
    at = 0
    while at + 1 < len(data):
        size, begin = unpack_number(data, at + 1)
        end = begin + size
        if data[begin - 1] > 0x7F or end > len(data):
            break
        packets.append((data[at], data[begin:end]))
        at = end
    return packets, data[at:]


def _user_value(properties: bytes, name: str) -> bytes:
    """The value of a user property of our own messages, empty if there is none."""
    key = b"\x26" + pack_text(name)
    at = properties.find(key)
    if at < 0:
        return b""
    at += len(key)
    return properties[at + 2 : at + 2 + int.from_bytes(properties[at : at + 2], "big")]


def _connect(
    broker: Broker, identifier: str, will: tuple[str, bytes, Stamp] | None = None
) -> bytes:
    """Return the packet CONNECT.

    Args:
        broker: whose name and password are used.
        identifier: our name there.
        will: topic, payload and stamp of the last will.
    """
    names = [broker.username, broker.password or ""] if broker.username else []
    last = b""
    if will is not None:
        topic, payload, stamp = will
        last = _stamped(stamp) + pack_text(topic) + pack_text(payload.decode())
    flags = _CLEAN | bool(last) * _WILL | bool(names) * _NAMED
    body = b"".join(
        (
            pack_text("MQTT"),
            bytes((5, flags)),
            KEEPALIVE_S.to_bytes(2, "big"),
            b"\0",
            pack_text(identifier),
            last,
            *map(pack_text, names),
        )
    )
    return b"\x10" + pack_number(len(body)) + body


_health: dict[int, bytes] = {}


def _encoded(record: Any) -> bytes:
    """The payload of a record; all robots have the same one."""
    payload = _health.get(id(record))
    if payload is None:
        payload = _health[id(record)] = encode_health(record)
    return payload


def _publish(kind: bytes, topic: bytes, mid: int, properties: bytes, payload: bytes) -> bytes:
    size = pack_number(len(topic) + 2 + len(properties) + len(payload))
    return b"".join((kind, size, topic, mid.to_bytes(2, "big"), properties, payload))


def _user_property(stamp: Stamp) -> bytes:
    return b"\x26" + pack_text(STAMP) + pack_text(f"{stamp.connection}.{stamp.message}")


def _stamped(stamp: Stamp) -> bytes:
    """The properties of a state."""
    found = _user_property(stamp)
    return pack_number(len(found)) + found
