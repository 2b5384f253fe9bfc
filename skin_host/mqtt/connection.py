"""The broker as one connection. The only module that knows aiomqtt, and paho below it.

What is added to aiomqtt 2.5: sending at half the cost, frames at the cost of their bytes, an end
that never waits for a broker that does not answer, and a count of publications that the broker
took but refused (MQTT 5 reports that in the acknowledgement, aiomqtt does not).

Frames (QoS 0) do not pass through paho: `Connection.write_now` writes packets that are encoded
already, see `packets.publish_packet`, to paho's socket. Nothing is expected in answer to such a
packet, so nothing of it has to be kept: no number, no future, no lock, no callback, which together
cost paho and aiomqtt several times what the bytes do. Only the writing has to be shared, and
paho's queue of packets does that: while it holds anything, no frame is written past it, and the
rest of a frame that the socket took in part becomes its first packet. Alternatives were: paho's
internals as far as `_send_publish`, which still make a numbered, logged and announced message of
each frame; the encoder of the package `mqtt5`, which writes any packet of MQTT 5 and needs 3.1.1
beside it, where one packet is needed whose head never changes; a major version of aiomqtt that has
no paho below it, which is not released. Whatever is acknowledged (events, states) keeps paho's
bookkeeping: its number, its place among those in flight, its entry until it is acknowledged. But
its packet is encoded here, and its entry is one object for all of them, because paho never sends
it again over another connection. A broker's limits: no packet is longer than it takes (`fits`), no
topic alias is used, and packets with QoS 0 do not count for its receive maximum.
"""

import asyncio
import contextlib
import logging
import re
import socket
import ssl
import struct
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from typing import Any, cast

import aiomqtt
from aiomqtt.exceptions import MqttConnectError
from paho.mqtt.client import (
    MQTT_CLEAN_START_FIRST_ONLY,
    MQTT_ERR_PROTOCOL,
    MQTT_ERR_SUCCESS,
)
from paho.mqtt.enums import MessageState, MQTTErrorCode
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from skin_host.clock import SYSTEM, Clock
from skin_host.mqtt.address import Broker
from skin_host.mqtt.packets import KEPT_BYTES, numbered_packet, pack_number, unfit

#: A broker that does not answer for this long is lost.
TIMEOUT_S = 3.0
GRACE_S = 0.2
#: At most this many publications are unacknowledged, or fewer if the broker allows no more.
MAX_IN_FLIGHT = 20
#: Waiting times between attempts double from the first to the last.
FIRST_RETRY_S = 0.2
LAST_RETRY_S = 3.0
#: A connection that lasted this long was good: the next wait is short again.
GOOD_S = 10.0
#: Reasons of a broker that ends a connection which do not concern a publication (MQTT 5.0,
#: 3.14.2.1): busy, shutting down, keep alive timeout, session taken over, use another server,
#: server moved.
_INNOCENT = {0x89, 0x8B, 0x8D, 0x8E, 0x9C, 0x9D}
_TAKEN_OVER = 0x8E
#: Of a packet with a description besides topic and payload, at most: header, properties.
_ENVELOPE_BYTES = 128
#: What paho gives for a connection that was closed without a reason.
_CLOSED = 0x80
#: So many packets are read in one turn of the loop: the next turn comes late in a program that
#: computes between the two.
MOST_READ = 1000
#: Usual acknowledgements, by their bytes after the number of the message: arrived, with and without
#: a code, and arrived without anybody who listens. Decoding them costs paho as much as publishing.
_USUAL_ACKS = {
    code: ReasonCode(PacketTypes.PUBACK, identifier=code[0] if code else 0)
    for code in (b"", b"\x00", b"\x10")
}
_PUBACK = 0x40
_NO_PROPERTIES = Properties(PacketTypes.PUBACK)  # type: ignore[no-untyped-call]

#: The properties of a message without any.
_NONE = b"\0"


class _OnItsWay:
    """A message with QoS 1 that waits for its acknowledgement, as far as paho looks at it."""

    qos = 1
    state = MessageState.MQTT_MS_WAIT_FOR_PUBACK

    @property
    def info(self) -> "_OnItsWay":
        return self

    def _set_as_published(self) -> None:
        """Nobody waits for this one."""


_ON_ITS_WAY = _OnItsWay()

MqttError = aiomqtt.MqttError
Message = aiomqtt.Message
Will = aiomqtt.Will
MessageProperties = Properties

# aiomqtt and paho warn once for each message; the important cases are counted and logged here.
_silent = logging.getLogger(f"{__name__}.library")
_silent.setLevel(logging.CRITICAL)
_log = logging.getLogger(__name__)


class UnansweredError(aiomqtt.MqttCodeError):
    """The broker closed the connection before it answered who we are: it may be shutting down, or
    take no packet as large as that.
    """


class Connection(aiomqtt.Client):
    """A client of the broker that can be cut off at any moment. Made by `connect`.

    Attributes:
        refused: publications that the broker acknowledged and refused (MQTT 5).
        refusal: the reason of the last one.
        discarded: messages that came faster than they were read or were not safe to decode,
            and are lost.
        packet_limit: the longest packet that the broker takes, in bytes, if it has a limit.
        taken_over: another client of the same name has replaced this one.
        ended_by_broker: the broker ended the connection, and may have done so because of what
            was published last; `without_reason` if it gave none.
        when_clear: called when the socket takes frames again after `write_now` left some.
    """

    def __init__(
        self,
        broker: Broker,
        *,
        identifier: str | None,
        will: Will | None,
        max_incoming: int,
        max_packet: int,
        session_s: int,
        resume: bool,
    ) -> None:
        properties = None
        if broker.v5:
            properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
            properties.SessionExpiryInterval = session_s
            properties.MaximumPacketSize = max_packet
        super().__init__(
            broker.host,
            broker.port,
            username=broker.username,
            password=broker.password,
            identifier=identifier,
            protocol=aiomqtt.ProtocolVersion.V5 if broker.v5 else aiomqtt.ProtocolVersion.V311,
            clean_session=None if broker.v5 else True,
            clean_start=not resume if broker.v5 else MQTT_CLEAN_START_FIRST_ONLY,
            properties=properties,
            will=will,
            tls_context=broker.tls,
            timeout=TIMEOUT_S,
            keepalive=broker.keepalive_s,
            max_queued_incoming_messages=max_incoming,
            socket_options=[(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)],
            logger=_silent,
        )
        self.pending_calls_threshold = 1_000_000
        self.refused = 0
        self.refusal = ""
        self.discarded = 0
        self.ended_by_broker = self.without_reason = False
        self.taken_over = False
        self.packet_limit: int | None = None
        self._takes_wildcards = True
        self._v5 = broker.v5
        self._max_packet = max_packet
        #: paho's client, with its private members.
        self._paho = cast(Any, self._client)
        # paho's own: packets that they read are checked before they are decoded.
        self._read_packet, self._handle_packet = self._paho._packet_read, self._paho._packet_handle
        self._paho._packet_read, self._paho._packet_handle = self._bounded_read, self._checked
        self._sent: dict[int, asyncio.Future[None]] = {}
        #: By number: requests whose senders wait for the acknowledgement.
        self._requests: dict[int, asyncio.Future[str]] = {}
        #: Packets for which `flush` follows.
        self._held: list[bytes] = []
        self.when_clear: Callable[[], None] = lambda: None
        self._is_refusing = False
        self._cut = False
        # From then on the socket is the event loop's; until then it is the opening thread's.
        self._is_open = False
        self._client.connect_timeout = TIMEOUT_S
        # Retrieved in any case, or asyncio logs an exception that was never retrieved.
        for future in (self._connected, self._disconnected):
            future.add_done_callback(lambda future: future.cancelled() or future.exception())

    def send(
        self,
        topic: str,
        payload: bytes,
        *,
        qos: int = 0,
        retain: bool = False,
        properties: Properties | None = None,
        hold: bool = False,
    ) -> "asyncio.Future[None]":
        """Hand over a message without waiting: a fraction of the cost of `publish`.

        What is sent in one turn of the loop is written together. The future is done when
        the message is written (QoS 0) or acknowledged (QoS 1); it never fails, for when
        the connection is lost `messages` raises.

        Args:
            topic, payload, qos, retain, properties: of the message.
            hold: `flush` follows in this turn of the loop.

        Raises:
            MqttError: the connection is lost.
        """
        paho = self._paho
        in_flight = paho._inflight_messages
        # What is above the window, and all after it, waits in paho.
        if (
            qos == 1
            and paho._sock is not None
            and len(paho._out_messages) <= in_flight < paho._max_inflight_messages
            and (number := paho._mid_generate()) not in paho._out_messages
        ):
            packed: bytes | None = None
            if self._v5:
                packed = _NONE if properties is None else properties.pack()  # type: ignore[no-untyped-call]
            packet = numbered_packet(topic, number, packed, payload, retain=retain)
            paho._out_messages[number] = _ON_ITS_WAY
            paho._inflight_messages = in_flight + 1
            done = self._sent[number] = self._loop.create_future()
            if hold:
                self._held.append(packet)
            else:
                self._put_behind(packet)
            return done
        self.flush()
        info = self._client.publish(topic, payload, qos, retain, properties)
        if info.rc != MQTT_ERR_SUCCESS:
            raise aiomqtt.MqttCodeError(info.rc, "not sent")
        done = self._loop.create_future()
        if info.is_published():
            done.set_result(None)
        else:
            self._sent[info.mid] = done
        return done

    def flush(self) -> None:
        """Write what was sent in this turn of the loop now, not at its end."""
        held, self._held = self._held, []
        sock = self._paho._sock
        if sock is None:
            return
        if held:
            data = held[0] if len(held) == 1 else b"".join(held)
            if self._paho._out_packet:
                self._put_behind(data)
            else:
                written = self._push(sock, data)
                if 0 <= written < len(data):
                    self._is_refusing = True
                    self._put_behind(data[written:])
        if self._paho._out_packet:
            self._write(self._client, sock)

    def is_clear(self) -> bool:
        """Whether the socket took all that was written; if not, `when_clear` will be called.

        What was sent in this turn of the loop is written first.
        """
        paho = self._paho
        if paho._out_packet or self._held:
            self.flush()
        clear = not paho._out_packet and paho._sock is not None
        self._is_refusing |= not clear
        return clear

    def write_now(self, packets: list[bytes]) -> int:
        """Write whole packets without acknowledgement, behind all that was sent before.

        Returns:
            How many the socket took, from the first on. The others are left to the caller; a
            packet that it took in part is completed before anything else is written.
        """
        sock: Any = self._paho._sock
        if (self._paho._out_packet or self._held or sock is None) and not self.is_clear():
            return 0
        data = packets[0] if len(packets) == 1 else b"".join(packets)
        written = self._push(sock, data)
        if written == len(data):
            return len(packets)
        if written < 0:
            return 0
        self._is_refusing = True
        taken = end = 0
        while end < written:
            end += len(packets[taken])
            taken += 1
        if end > written:
            self._put_behind(data[written:end])
        else:
            self._loop.add_writer(sock.fileno(), self._write, self._client, sock)
        return taken

    def _push(self, sock: Any, data: bytes) -> int:
        """Write past paho's queue, which is empty; return how much was taken, -1 after an error."""
        try:
            return int(sock.send(data))
        except (ssl.SSLWantWriteError, ssl.SSLWantReadError):
            # Some of it may be on its way, encrypted: TLS needs the same bytes again.
            self._put_behind(data)
            return len(data)
        except BlockingIOError:
            return 0
        except OSError:
            # The reader of the socket gets the same error and ends the connection.
            return -1

    def _put_behind(self, packets: bytes) -> None:
        """Let paho write these after all that it has to write, when the socket takes it."""
        # The number 0 is not a type of packet: paho only writes it.
        self._paho._packet_queue(0, packets, 0, 0)

    async def _wait_for(self, fut: Any, timeout: float | None) -> Any:  # noqa: ASYNC109  # aiomqtt names it
        """Wait as aiomqtt does, and never lose a cancellation.

        The `asyncio.wait_for` of Python 3.11 loses one that comes together with the result, or
        with the error. The task then continues, and the canceller waits for ever.
        """
        task = asyncio.current_task()
        before = task.cancelling() if task else 0
        try:
            return await super()._wait_for(fut, timeout)
        finally:
            if task and task.cancelling() > before:
                raise asyncio.CancelledError

    async def listen_to(self, topic: str, qos: int = 1, *, as_published: bool = True) -> bool:
        """Subscribe; return whether the broker allows it. One that takes no wildcards is not asked
        for any, because it would end the connection.

        Args:
            topic: what to subscribe to.
            qos: the greatest with which messages come.
            as_published: with MQTT 5 messages show whether they were published as retained, also
                those that come while we listen; else only what the broker had stored shows it.

        Raises:
            MqttError: the connection is lost, or there is no answer for `TIMEOUT_S`.
        """
        if not self._takes_wildcards and any(one in topic for one in "+#"):
            return False
        if self._v5:
            options = SubscribeOptions(qos=qos, retainAsPublished=as_published)
            codes: Any = await self.subscribe(topic, options=options)
        else:
            codes = await self.subscribe(topic, qos=qos)
        return not any(
            code.is_failure if isinstance(code, ReasonCode) else code >= 128 for code in codes
        )

    async def request(self, topic: str, payload: bytes, properties: Properties | None) -> str:
        """Publish with QoS 1 and wait for the acknowledgement.

        Returns:
            Why the broker refuses it, which MQTT 5 alone shows; "" if it does not.

        Raises:
            MqttError: the connection is lost, or there is no answer for `TIMEOUT_S`.
        """
        self.flush()
        sent = self._client.publish(topic, payload, 1, False, properties)
        if sent.rc != MQTT_ERR_SUCCESS:
            raise aiomqtt.MqttCodeError(sent.rc, "not sent")
        answer: asyncio.Future[str] = self._loop.create_future()
        self._requests[sent.mid] = answer
        try:
            ends: list[asyncio.Future[Any]] = [answer, self._disconnected]
            await asyncio.wait(ends, timeout=TIMEOUT_S, return_when=asyncio.FIRST_COMPLETED)
            if answer.done():
                return answer.result()
            if self._disconnected.done():
                await self.lost()
            raise MqttError("Operation timed out")
        finally:
            del self._requests[sent.mid]

    def waiting(self) -> Iterator[Message]:
        """Yield the messages that have come and were not read: `messages` takes turns of the loop
        for each.
        """
        while not self._queue.empty():
            yield self._queue.get_nowait()

    async def lost(self) -> None:
        """Wait until the connection is lost.

        Raises:
            MqttError: it is lost.
        """
        await asyncio.wait([self._disconnected])
        raise self._disconnected.exception() or MqttError("the connection has ended")

    def cut(self) -> None:
        """End at once, without a message to the broker, which will publish the last will."""
        self._cut = True
        raw = self._client.socket()
        if not self._is_open:
            self._close_unopened()
        elif isinstance(raw, socket.socket):
            with contextlib.suppress(OSError):
                # Data that still waits in the kernel is out of date: drop it with the connection.
                raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                raw.shutdown(socket.SHUT_RDWR)

    async def open(self, clock: Clock) -> None:
        """Resolve the name and make the connection. The end of the program waits for neither.

        Raises:
            MqttError: there is no connection; `explain` gives the reason.
        """
        try:
            await clock.in_thread(self._open)
        except (OSError, UnicodeError) as error:  # the latter of names that no host can have
            raise MqttError(str(error)) from None
        self._is_open = True
        sock: Any = self._client.socket()
        if sock is not None:
            super()._on_socket_open(self._client, None, sock)
            self._loop.call_soon(self._write, self._client, sock)

    def _open(self) -> None:
        # Runs in a thread that cannot be cancelled. It leaves the loop alone, which may have ended
        # meanwhile: a reader or a task of a loop that ends would stay behind, with the socket.
        super()._client_connect()
        if self._cut:
            self._close_unopened()

    def _close_unopened(self) -> None:
        """Close the socket of a connection that was given up while it was made."""
        sock = self._client.socket()
        if sock is not None:
            sock.close()

    def _on_socket_open(self, client: Any, userdata: Any, sock: Any) -> None:
        """Do nothing: `open` registers the socket with the loop, in the loop's thread."""

    def _on_socket_close(self, client: Any, userdata: Any, sock: Any) -> None:
        if self._is_open:
            super()._on_socket_close(client, userdata, sock)

    def _on_socket_unregister_write(self, client: Any, userdata: Any, sock: Any) -> None:
        if self._is_open:
            super()._on_socket_unregister_write(client, userdata, sock)

    def _client_connect(self) -> None:
        """Do nothing, where aiomqtt would connect in a thread that the program's end waits for."""

    def _on_publish(
        self, client: Any, userdata: Any, mid: int, reason_code: ReasonCode, properties: Properties
    ) -> None:
        if reason_code.is_failure:
            self.refused += 1
            self.refusal = str(reason_code)
        answer = self._requests.get(mid)
        if answer is not None and not answer.done():
            answer.set_result(str(reason_code) if reason_code.is_failure else "")
        done = self._sent.pop(mid, None)
        if done is not None and not done.done():
            done.set_result(None)
        super()._on_publish(client, userdata, mid, reason_code, properties)

    def _on_socket_register_write(self, client: Any, userdata: Any, sock: Any) -> None:
        if self._is_open:
            self._loop.call_soon(self._write, client, sock)

    def _write(self, client: Any, sock: Any) -> None:
        """Write at once: mostly the socket takes it, and asking the kernel first costs as much."""
        try:
            client.loop_write()
        except Exception as error:
            if not self._disconnected.done():
                self._disconnected.set_exception(error)
            return
        if client.want_write():
            if sock.fileno() >= 0:
                self._loop.add_writer(sock.fileno(), self._write, client, sock)
        elif self._is_refusing:
            self._is_refusing = False
            if sock.fileno() >= 0:
                self._loop.remove_writer(sock.fileno())
            self._loop.call_soon(self.when_clear)

    def fits(self, topic: str, payload: bytes, properties: Properties | None) -> bool:
        """Return whether the broker takes a message with this as a packet with QoS 1, as far as it
        states a limit (MQTT 5).
        """
        if self.packet_limit is None:
            return True
        packed: bytes = _NONE if properties is None else properties.pack()  # type: ignore[no-untyped-call]
        # The topic has its length before it, and a number behind it.
        left = 2 + len(topic.encode()) + 2 + len(packed) + len(payload)
        return 1 + len(pack_number(left)) + left <= self.packet_limit

    def room(self, topic: str) -> int | None:
        """How many bytes of a description fit into a message to a topic, if there is a limit."""
        if self.packet_limit is None:
            return None
        return self.packet_limit - len(topic.encode()) - _ENVELOPE_BYTES

    def _on_connect(
        self,
        client: Any,
        userdata: Any,
        flags: Any,
        reason_code: ReasonCode,
        properties: Properties | None = None,
    ) -> None:
        self.packet_limit = getattr(properties, "MaximumPacketSize", None)
        self._takes_wildcards = bool(getattr(properties, "WildcardSubscriptionAvailable", True))
        # paho knows no receive maximum of the broker's; what is above it waits in paho.
        self._paho._max_inflight_messages = min(
            MAX_IN_FLIGHT, getattr(properties, "ReceiveMaximum", MAX_IN_FLIGHT)
        )
        super()._on_connect(client, userdata, flags, reason_code, properties)

    def _on_disconnect(
        self,
        client: Any,
        userdata: Any,
        flags: Any,
        reason_code: ReasonCode,
        properties: Properties | None = None,
    ) -> None:
        self.taken_over = reason_code.value == _TAKEN_OVER
        accused = flags.is_disconnect_packet_from_server and reason_code.value not in _INNOCENT
        closed = reason_code.value == _CLOSED
        self.ended_by_broker = not self._cut and (accused or closed)
        self.without_reason = not self._cut and closed
        for answer in self._pending_subscribes.values():  # aiomqtt would wait until its timeout
            if not answer.done():
                answer.set_exception(aiomqtt.MqttCodeError(reason_code, "closed"))
        if self._connected.cancelled():
            return  # the attempt was given up; aiomqtt would raise
        if not self._connected.done():  # aiomqtt would wait for the answer until its timeout
            self._connected.set_exception(UnansweredError(reason_code, "closed"))
        super()._on_disconnect(client, userdata, flags, reason_code, properties)

    def _bounded_read(self) -> MQTTErrorCode:
        """Read as paho does, but all packets that have come and have room, and only the checked
        part of a large one.
        """
        code: MQTTErrorCode = MQTT_ERR_SUCCESS
        room = self._queue.maxsize - self._queue.qsize()
        for _ in range(min(MOST_READ, max(1, room))):
            code = self._read_packet()
            arriving = self._paho._in_packet
            if arriving["remaining_length"] > max(self._max_packet, KEPT_BYTES):
                del arriving["packet"][KEPT_BYTES:]
            if code != MQTT_ERR_SUCCESS or self._paho._sock is None:
                break
        return code

    def _checked(self) -> MQTTErrorCode:
        """Handle a packet that was read, unless decoding it would take too long."""
        arrived = self._paho._in_packet
        command, packet = arrived["command"], arrived["packet"]
        if command == _PUBACK and (len(packet) == 2 or (len(packet) == 3 and self._v5)):
            reason = _USUAL_ACKS.get(bytes(packet[2:]))
            if reason is not None:
                return self._acknowledged(int.from_bytes(packet[:2], "big"), reason)
        found = unfit(
            command,
            packet,
            arrived["remaining_length"],
            self._max_packet,
            self._v5,
        )
        if found is None:
            code: MQTTErrorCode = self._handle_packet()
            return code
        if not self.discarded:
            _log.warning("%s was not read; such are counted", found.why)
        self.discarded += 1
        if not found.is_publish:
            return MQTT_ERR_PROTOCOL
        acknowledged: MQTTErrorCode = MQTT_ERR_SUCCESS
        if found.mid:
            acknowledged = self._paho._send_puback(found.mid)
        return acknowledged

    def _acknowledged(self, mid: int, reason: ReasonCode) -> MQTTErrorCode:
        """Do what paho does for an acknowledgement, decoded already."""
        paho = self._paho
        code: MQTTErrorCode = MQTT_ERR_SUCCESS
        waiting = paho._out_messages
        if waiting.get(mid) is _ON_ITS_WAY:
            del waiting[mid]
            paho._inflight_messages -= 1
            done = self._sent.pop(mid)
            if not done.done():
                done.set_result(None)
            if len(waiting) > paho._inflight_messages:
                code = paho._update_inflight()
            return code
        with paho._out_message_mutex:
            if mid in paho._out_messages:
                code = paho._do_on_publish(mid, reason, _NO_PROPERTIES)
        return code

    def _on_message(self, client: Any, userdata: Any, message: Any) -> None:
        self.discarded += self._queue.full()
        super()._on_message(client, userdata, message)


@asynccontextmanager
async def connect(
    broker: Broker,
    *,
    identifier: str | None = None,
    will: Will | None = None,
    max_incoming: int = 64,
    max_packet: int = 80_000,
    session_s: int = 0,
    resume: bool = False,
    clock: Clock = SYSTEM,
) -> AsyncIterator[Connection]:
    """Connect; disconnect at the end, or cut the connection if an exception leaves.

    Args:
        broker: where.
        identifier: our name at the broker, which may have one client of each name.
        will: what the broker publishes for us if we vanish.
        max_incoming: messages that may wait to be read.
        max_packet: the longest packet that is taken, in bytes.
        session_s: how long after the end the broker keeps messages for us (MQTT 5).
        resume: continue with the session of the connection before.
        clock: for time and waiting.

    Raises:
        MqttError: no connection; `explain` gives the reason.
    """
    connection = Connection(
        broker,
        identifier=identifier,
        will=will,
        max_incoming=max_incoming,
        max_packet=max_packet,
        session_s=session_s,
        resume=resume,
    )
    try:
        await connection.open(clock)
        await connection.__aenter__()
        yield connection
        await connection.__aexit__(None, None, None)
    except BaseException:
        connection.cut()
        raise


class Retry:
    """How long to wait before the next attempt: doubling, with jitter.

    The jitter keeps a thousand robots from coming back to a broker in the same instant.
    """

    def __init__(self, clock: Clock = SYSTEM) -> None:
        self._clock = clock
        self._next_s = FIRST_RETRY_S

    def delay_s(self, lasted_s: float = 0.0) -> float:
        """Waiting time after a connection that lasted for `lasted_s`."""
        if lasted_s >= GOOD_S:
            self._next_s = FIRST_RETRY_S
        delay_s = self._next_s * self._clock.uniform(0.5, 1.0)
        self._next_s = min(2 * self._next_s, LAST_RETRY_S)
        return delay_s


async def within(timeout_s: float, done: "asyncio.Future[None]") -> None:
    """Wait until a message is sent.

    If this process was stopped meanwhile, the answer may still be unread, so it gets some more
    time.

    Raises:
        MqttError: it takes too long; the broker is taken for lost.
    """
    for patience_s in (timeout_s, GRACE_S):
        finished, _ = await asyncio.wait([done], timeout=patience_s)
        if finished:
            return
    raise MqttError("Operation timed out")


class PackedProperties(Properties):
    """Properties that never change, packed once: packing costs paho as much as sending."""

    def __init__(self, properties: Properties) -> None:
        super().__init__(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
        object.__setattr__(self, "_packed", properties.pack())  # type: ignore[no-untyped-call]

    @classmethod
    def of(cls, properties: Properties | None) -> "PackedProperties | None":
        return None if properties is None else cls(properties)

    def pack(self) -> bytes:
        packed: bytes = object.__getattribute__(self, "_packed")
        return packed


def message_properties(broker: Broker, kind: str, *, text: bool = True) -> Properties | None:
    """Return properties that describe a payload; None for MQTT 3.1.1, which has none."""
    if not broker.v5:
        return None
    properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    properties.ContentType = kind
    properties.PayloadFormatIndicator = int(text)
    return properties


def first_error(error: BaseException) -> BaseException:
    """Of a group of exceptions the first; they are mostly the same one."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error


def is_refusal(error: BaseException) -> bool:
    """Return whether the broker answered and refuses us: waiting may not help."""
    return isinstance(error, MqttConnectError)


def explain(error: BaseException) -> str:
    """Explain in a few words why there is no connection, and what may help."""
    error = error.__cause__ or error
    code = getattr(error, "rc", None)
    text = str(code) if isinstance(code, ReasonCode) else str(error)
    # The prefixes "[code:7] ..." and "[Errno 111] ..." are of no use to the reader.
    text = re.sub(r"^\[[^]]*\] ", "", text).strip() or type(error).__name__
    for seen, hint in _HINTS.items():
        if seen.lower() in text.lower():
            return f"{text} ({hint})"
    return text


_HINTS = {
    "Unspecified error": "the broker closed the connection",
    "The client is not currently connected": "the broker closed the connection",
    "Connection refused": "no broker listens there",
    "Operation timed out": "the broker does not answer",
    "Not authorized": "check mqtt.username and its password, or those of the URL",
    "Not authorised": "check mqtt.username and its password, or those of the URL",
    "Bad user name or password": "check mqtt.username and its password, or those of the URL",
    "Protocol error": "what answers there is no MQTT broker; check host and port",
    "wrong version number": "no TLS is spoken there; check the port, or leave TLS off",
    "Session taken over": "does a second daemon run as the same node?",
    "QoS not supported": "this node needs a broker that takes QoS 1",
    "Retain not supported": "this node needs a broker that retains messages",
    "Unsupported protocol version": 'for an old broker set mqtt.protocol = "3.1.1"',
    "CERTIFICATE_VERIFY_FAILED": "check mqtt.ca_file, mqtt.host and the broker's certificate",
}
