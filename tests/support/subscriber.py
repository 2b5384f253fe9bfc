"""A plain paho subscriber: a program that knows nothing of ours."""

import json
import threading
import time
import uuid
from typing import Any

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion

from tests.support.waiting import PATIENCE_S


class Subscriber:
    """Collects everything below a topic, in the order of arrival."""

    def __init__(self, host: str, port: int, topic: str) -> None:
        self._lock = threading.Lock()
        self._messages: list[tuple[str, bytes]] = []
        self._read: dict[str, tuple[int, list[Any]]] = {}
        self._subscribed = threading.Event()
        self._caught_up = threading.Event()
        self._marker = f"caught-up/{uuid.uuid4().hex}"
        self._client = mqtt.Client(CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        self._client.on_message = self._take
        self._client.on_connect = lambda client, *_: client.subscribe(
            [(topic, 1), (self._marker, 1)]
        )
        self._client.on_subscribe = lambda *_: self._subscribed.set()
        self._client.connect(host, port)
        self._client.loop_start()
        assert self._subscribed.wait(PATIENCE_S)

    def _take(self, _client: Any, _data: Any, message: mqtt.MQTTMessage) -> None:
        if message.topic == self._marker:
            self._caught_up.set()
            return
        with self._lock:
            self._messages.append((message.topic, bytes(message.payload)))

    def catch_up(self) -> None:
        """Wait until everything has arrived that the broker has taken so far.

        A program that has ended was answered by the broker, which says nothing about us.
        """
        self._caught_up.clear()
        self._client.publish(self._marker, b"", qos=1)
        assert self._caught_up.wait(PATIENCE_S), "the broker did not send our own message back"

    def payloads(self, ending: str) -> list[bytes]:
        """Payloads so far of the topics that end so."""
        with self._lock:
            return [payload for topic, payload in self._messages if topic.endswith(ending)]

    def documents(self, ending: str) -> list[Any]:
        """The same as JSON. What was read before is not read again: who waits asks often."""
        seen, found = self._read.get(ending, (0, []))
        with self._lock:
            new = self._messages[seen:]
        found += [json.loads(payload) for topic, payload in new if topic.endswith(ending)]
        self._read[ending] = (seen + len(new), found)
        return list(found)

    def wait_for(self, n: int) -> dict[str, bytes]:
        """Wait until so many topics have been heard of; return the last payload of each."""
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            with self._lock:
                heard = dict(self._messages)
            if len(heard) >= n:
                return heard
            assert time.monotonic() < deadline_s, f"waited for {n} topics, heard {sorted(heard)}"
            time.sleep(0.02)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()
