"""The broker as one connection. The only module that knows aiomqtt, and paho below it.

What is added to aiomqtt 2.5: sending at half the cost, an end that never waits for a broker
that does not answer, and a count of publications that the broker took but refused (MQTT 5
tells that in the acknowledgement, aiomqtt does not).
"""

import asyncio
import contextlib
import logging
import random
import re
import socket
import struct
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import aiomqtt
from aiomqtt.exceptions import MqttConnectError
from paho.mqtt.client import MQTT_CLEAN_START_FIRST_ONLY, MQTT_ERR_SUCCESS
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from skin_host.publish.address import Broker

#: A broker that does not answer for so long is taken for lost.
TIMEOUT_S = 3.0
GRACE_S = 0.2
#: Waiting times between attempts double from the first to the last.
FIRST_RETRY_S = 0.2
LAST_RETRY_S = 3.0
#: A connection that lasted so long was a good one: the next wait is short again.
GOOD_S = 10.0

MqttError = aiomqtt.MqttError
Message = aiomqtt.Message
Will = aiomqtt.Will
MessageProperties = Properties

# aiomqtt and paho warn once for each message; what matters is counted and said here.
_silent = logging.getLogger(f"{__name__}.library")
_silent.setLevel(logging.CRITICAL)


class Connection(aiomqtt.Client):
    """A client of the broker that can be cut off at any moment. Made by `connect`.

    Attributes:
        refused: publications that the broker acknowledged and refused (MQTT 5).
        refusal: the reason of the last one.
        discarded: messages that came faster than they were read, and are lost.
    """

    def __init__(
        self,
        broker: Broker,
        *,
        identifier: str | None,
        will: Will | None,
        max_incoming: int,
        session_s: int,
        resume: bool,
    ) -> None:
        properties = None
        if broker.v5:
            properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
            properties.SessionExpiryInterval = session_s
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
        self._sent: dict[int, asyncio.Future[None]] = {}
        self._cut = False
        self._thread = threading.get_ident()
        self._client.connect_timeout = TIMEOUT_S
        # Looked at in any case, or asyncio complains of an exception that nobody retrieved.
        self._disconnected.add_done_callback(
            lambda future: future.cancelled() or future.exception()
        )

    def send(
        self,
        topic: str,
        payload: bytes,
        *,
        qos: int = 0,
        retain: bool = False,
        properties: Properties | None = None,
    ) -> "asyncio.Future[None]":
        """Hand over a message without waiting: half the cost of `publish`.

        What is sent in one turn of the loop is written together. The future is done when
        the message is written (QoS 0) or acknowledged (QoS 1); it never fails, for when
        the connection is lost `messages` raises.

        Raises:
            MqttError: the connection is lost.
        """
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
        sock = self._client.socket()
        if sock is not None:
            self._write(self._client, sock)

    async def _wait_for(self, fut: Any, timeout: float | None) -> Any:  # noqa: ASYNC109  # aiomqtt names it
        """Wait as aiomqtt does, and never lose a cancellation.

        The `asyncio.wait_for` of Python 3.11 loses one that comes together with the result.
        The task then goes on, and whoever cancelled it waits for ever.
        """
        task = asyncio.current_task()
        before = task.cancelling() if task else 0
        result = await super()._wait_for(fut, timeout)
        if task and task.cancelling() > before:
            raise asyncio.CancelledError
        return result

    async def listen_to(self, topic: str) -> bool:
        """Subscribe with QoS 1; say whether the broker allows it."""
        codes: Any = await self.subscribe(topic, qos=1)
        return not any(
            code.is_failure if isinstance(code, ReasonCode) else code >= 128 for code in codes
        )

    def cut(self) -> None:
        """End at once, without a word to the broker: it will publish the last will."""
        self._cut = True
        raw = self._client.socket()
        if isinstance(raw, socket.socket):
            with contextlib.suppress(OSError):
                # What still waits in the kernel is old news: let it go with the connection.
                raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                raw.shutdown(socket.SHUT_RDWR)

    def _client_connect(self) -> None:
        # Runs in a thread that cannot be cancelled.
        super()._client_connect()
        if self._cut:
            self.cut()

    def _on_publish(
        self, client: Any, userdata: Any, mid: int, reason_code: ReasonCode, properties: Properties
    ) -> None:
        if reason_code.is_failure:
            self.refused += 1
            self.refusal = str(reason_code)
        done = self._sent.pop(mid, None)
        if done is not None and not done.done():
            done.set_result(None)
        super()._on_publish(client, userdata, mid, reason_code, properties)

    def _on_socket_register_write(self, client: Any, userdata: Any, sock: Any) -> None:
        if threading.get_ident() == self._thread:
            self._loop.call_soon(self._write, client, sock)
        else:  # while connecting
            self._loop.call_soon_threadsafe(self._write, client, sock)

    def _write(self, client: Any, sock: Any) -> None:
        """Write at once: mostly the socket takes it, and asking the kernel first costs as much."""
        try:
            client.loop_write()
        except Exception as error:
            if not self._disconnected.done():
                self._disconnected.set_exception(error)
            return
        if client.want_write() and sock.fileno() >= 0:
            self._loop.add_writer(sock.fileno(), self._write, client, sock)

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
    session_s: int = 0,
    resume: bool = False,
) -> AsyncIterator[Connection]:
    """Connect; say goodbye at the end, or cut the connection if an exception leaves.

    Args:
        broker: where.
        identifier: our name to the broker, which may have one client of each name.
        will: what the broker says for us if we vanish.
        max_incoming: messages that may wait to be read.
        session_s: how long after the end the broker keeps messages for us (MQTT 5).
        resume: go on with what was kept of the connection before.

    Raises:
        MqttError: no connection; `explain` tells why.
    """
    connection = Connection(
        broker,
        identifier=identifier,
        will=will,
        max_incoming=max_incoming,
        session_s=session_s,
        resume=resume,
    )
    try:
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

    def __init__(self) -> None:
        self._next_s = FIRST_RETRY_S

    def delay_s(self, lasted_s: float = 0.0) -> float:
        """Waiting time after a connection that lasted for `lasted_s`."""
        if lasted_s >= GOOD_S:
            self._next_s = FIRST_RETRY_S
        delay_s = self._next_s * random.uniform(0.5, 1.0)
        self._next_s = min(2 * self._next_s, LAST_RETRY_S)
        return delay_s


async def within(timeout_s: float, done: "asyncio.Future[None]") -> None:
    """Wait until a message is sent.

    If this process was stopped meanwhile, the answer may lie unread: it has a moment more.

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
        """Pack properties, if there are any."""
        return None if properties is None else cls(properties)

    def pack(self) -> bytes:
        """The bytes of the properties."""
        packed: bytes = object.__getattribute__(self, "_packed")
        return packed


def message_properties(broker: Broker, kind: str, *, text: bool = True) -> Properties | None:
    """Properties that say what a payload is; None for MQTT 3.1.1, which has none."""
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
    """Whether the broker answered and does not want us: waiting may not mend that."""
    return isinstance(error, MqttConnectError)


def explain(error: BaseException) -> str:
    """Say in a few words why there is no connection, and what may mend it."""
    error = error.__cause__ or error
    code = getattr(error, "rc", None)
    text = str(code) if isinstance(code, ReasonCode) else str(error)
    # "[code:7] ..." and "[Errno 111] ..." help nobody.
    text = re.sub(r"^\[[^]]*\] ", "", text).strip() or type(error).__name__
    for seen, hint in _HINTS.items():
        if seen.lower() in text.lower():
            return f"{text} ({hint})"
    return text


_HINTS = {
    "Unspecified error": "the broker closed the connection",
    "Connection refused": "no broker listens there",
    "Operation timed out": "the broker does not answer",
    "Not authorized": "check mqtt.username and its password",
    "Not authorised": "check mqtt.username and its password",
    "Bad user name or password": "check mqtt.username and its password",
    "Session taken over": "does a second daemon run as the same node?",
    "Unsupported protocol version": 'for an old broker set mqtt.protocol = "3.1.1"',
    "CERTIFICATE_VERIFY_FAILED": "check mqtt.ca_file, mqtt.host and the broker's certificate",
}
