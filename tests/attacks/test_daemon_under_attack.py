"""A running daemon, a real broker, and somebody on the network who means harm.

After each attack: the same process, its watchdog fed all the time, memory as before, frames and
answers as before, and few lines in the log, none of them a traceback or of somebody's making.
"""

import json
import socket
import sys
import time
from collections.abc import Callable
from typing import Any

import paho.mqtt.client as mqtt
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from tests.support.broker import Mosquitto
from tests.support.stack import Stack, wait_for
from tests.support.subscriber import Subscriber
from tests.support.waiting import PATIENCE_S
from tests.support.watchdog import Watchdog, computed_s, memory_kb

NODE = "skin/demo/nodes/main"
GROWTH_KB = 20_000
#: Of the daemon's own computing: a busy machine only makes it wait.
GAP_S = 0.4
LOG_BYTES = 20_000


class Attacker:
    """A client that may do whatever the broker allows."""

    def __init__(self, broker: Mosquitto) -> None:
        self.place = broker.host, broker.port
        self.idle: list[socket.socket] = []
        self.client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        self.client.connect(broker.host, broker.port)
        self.client.loop_start()

    def ask(self, name: str, payload: bytes = b"{}", n: int = 1, **keys: Any) -> None:
        for _ in range(n):
            sent = self.client.publish(f"{NODE}/cmd/{name}", payload, qos=1, **keys)
            if not _ % 100:
                sent.wait_for_publish(30)


def properties(**keys: Any) -> Properties:
    made = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    for key, value in keys.items():
        setattr(made, key, value)
    return made


def bomb(attacker: Attacker) -> None:
    pairs = [("", "")] * 3000
    for _ in range(20):
        attacker.ask("status", properties=properties(UserProperty=pairs))


def huge(attacker: Attacker) -> None:
    attacker.ask("status", b" " * 5_000_000, n=5)
    attacker.ask("status", b" " * 70_000, n=20)


def replies(attacker: Attacker) -> None:
    for topic in ("/" * 250, "a" * 60_000, f"{NODE}/replies/" + "x/" * 150, "skin/demo/x/contact"):
        attacker.ask("status", properties=properties(ResponseTopic=topic))


def flood(attacker: Attacker) -> None:
    attacker.ask("status", n=3000)


def nested(attacker: Attacker) -> None:
    for payload in (b"[" * 60_000, b'{"a":' * 10_000, b'{"id":1e999999}', b'{"id":"\\ud800"}'):
        attacker.ask("calibrate", payload)
    attacker.ask("thresholds", b'{"set":{"margin_units":1e400}}')


def forged(attacker: Attacker) -> None:
    evil = {"id": "x\nERROR forged line", "x\nERROR forged line\u2028": 1}
    for name in ("disable", "calibrate", "record", "nothing"):
        attacker.ask(name, json.dumps(evil, ensure_ascii=False).encode(), n=5)
    attacker.ask("record", json.dumps({"file": "../../\nERROR forged line"}).encode(), n=5)


def poisoned(attacker: Attacker) -> None:
    for name in ("calibrate", "disable", "record"):
        attacker.ask(name, b'{"part":"left_hand"}', retain=True)
        attacker.ask(name, b"", retain=True)
    for topic in (f"{NODE}/status", f"{NODE}/info", "skin/demo/left_hand/health"):
        attacker.client.publish(topic, b"\xff" * 1000, qos=1, retain=True)


def deaf(attacker: Attacker) -> None:
    """Subscribers of everything that read nothing, and whose windows stay shut."""
    for number in range(30):
        reader = socket.socket()
        reader.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        reader.connect(attacker.place)
        attacker.idle.append(reader)
        name = b"deaf%02d" % number
        reader.sendall(b"\x10" + bytes([13 + len(name)]) + b"\0\4MQTT\5\2\0\0\0\0")
        reader.sendall(bytes([len(name)]) + name + b"\x82\7\0\1\0\0\1#\1")
    time.sleep(2.0)


def odd_numbers_and_texts(attacker: Attacker) -> None:
    odd = [
        b"NaN",
        b"\xef\xbb\xbf{}",
        b'{"seconds":NaN}',
        b'{"seconds":-Infinity}',
        b'{"seconds":1e308}',
        b'{"seconds":' + b"9" * 5000 + b"}",
        b'{"seconds":-1}',
        b'{"seconds":1,"seconds":"x"}',
        b'{"part":"\\u0000"}',
        b'{"part":"\xed\xa0\x80"}',
        b'{"part":"left_hand\\u202e"}',
        b'{"file":"a\\u0000b.log","seconds":1}',
        b'{"file":"' + b"a" * 400 + b'.log","seconds":1}',
        b'{"file":"CON.log","seconds":1e-300}',
        b'{"set":{"margin_units":-1e308,"hysteresis":1e308}}',
        b"null",
        b"[]",
        b'"' + b"\\u0041" * 10_000 + b'"',
    ]
    for payload in odd:
        for name in ("calibrate", "record", "raw", "thresholds", "enable", "configure", "status"):
            attacker.ask(name, payload)
    attacker.ask("thresholds", b'{"reset":true}')


def crooked_replies(attacker: Attacker) -> None:
    topics = (
        f"{NODE}/status",
        f"{NODE}/info",
        f"{NODE}/cmd/calibrate",
        f"{NODE}/cmd/status/result",
        "$SYS/broker/version",
        "$share/x/skin/#",
        "skin/demo/left_hand/contact",
        f"{NODE}/replies/../../x",
        f"{NODE}/replies/\u2028",
    )
    for topic in topics:
        keys = properties(ResponseTopic=topic, CorrelationData=b"\xff" * 60_000)
        attacker.ask("status", properties=keys)
    for _ in range(50):
        attacker.ask("status", properties=properties(CorrelationData=b"\0" * 60_000))


def forged_states(attacker: Attacker) -> None:
    """States of the node itself, newer than its own, from live clients and from last wills."""
    stamps = ["9" * 19, "9" * 5000, "-1", "\u0661.\u0662", "1e9.0", ".", "9" * 19 + "." + "9" * 19]
    topics = (f"{NODE}/status", f"{NODE}/info", "skin/demo/left_hand/contact")
    for stamp in (*stamps, "8000000000000000000.1", "9" * 18 + "8.1"):
        for topic in topics:
            for retain in (True, False):
                keys = properties(UserProperty=[("stamp", stamp), ("run", stamp)])
                attacker.client.publish(topic, b"offline", 1, retain, keys).wait_for_publish(30)
    for number in range(30):
        will = Properties(PacketTypes.WILLMESSAGE)  # type: ignore[no-untyped-call]
        will.UserProperty = ("stamp", f"{8 * 10**18 + number}.1")
        dying = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        dying.will_set(f"{NODE}/status", b"offline", 1, True, will)
        dying.connect(*attacker.place)
        dying.loop(1.0)
        raw = dying.socket()
        assert isinstance(raw, socket.socket)
        raw.shutdown(socket.SHUT_RDWR)


def half_said(attacker: Attacker) -> None:
    """Messages with QoS 2 that are never released, and clients that stop in the middle."""
    topic = f"{NODE}/cmd/status".encode()
    head = len(topic).to_bytes(2, "big") + topic
    for number in range(50):
        one = socket.create_connection(attacker.place)
        attacker.idle.append(one)
        name = b"half%02d" % number
        one.sendall(b"\x10" + bytes([13 + len(name)]) + b"\0\4MQTT\5\2\0\0\0\0")
        one.sendall(bytes([len(name)]) + name)
        for mid in range(1, 100):
            body = head + mid.to_bytes(2, "big") + b"\0{}"
            one.sendall(b"\x34" + bytes([len(body)]) + body)
        one.sendall(b"\x30\xff\xff\xff\x7f" + head)


def crowd(attacker: Attacker) -> None:
    """Retained messages under the robot's own prefix, more than anybody wants."""
    for number in range(20_000):
        sent = attacker.client.publish(f"skin/demo/x{number}/health", b"{}", 1, retain=True)
        if not number % 500:
            sent.wait_for_publish(30)
    sent.wait_for_publish(30)


ATTACKS: list[Callable[[Attacker], None]] = [
    bomb,
    huge,
    replies,
    flood,
    nested,
    forged,
    poisoned,
    deaf,
    odd_numbers_and_texts,
    crooked_replies,
    forged_states,
    half_said,
    crowd,
]


def test_whoever_is_on_the_network_stops_nothing(
    stack: Stack, mosquitto: Mosquitto, subscriber: Subscriber, watchdog: Watchdog
) -> None:
    stack.calibrate()
    daemon = stack.start("run", str(stack.config))
    watchdog.pid = daemon.pid
    log = stack._said[-1]
    wait_for(lambda: len(subscriber.payloads("left_hand/frame")) > 20, "frames")
    attacker = Attacker(mosquitto)

    def answers() -> int:
        return len(subscriber.payloads("cmd/status/result"))

    def is_well() -> None:
        """A request is answered, and frames come."""
        frames, said = len(subscriber.payloads("left_hand/frame")), answers()
        deadline_s = time.monotonic() + PATIENCE_S
        while answers() == said and time.monotonic() < deadline_s:
            attacker.ask("status")
            time.sleep(0.5)
        assert answers() > said, log.read_text()[-3000:]
        wait_for(lambda: len(subscriber.payloads("left_hand/frame")) > frames, "more frames")

    is_well()
    for attack in ATTACKS:
        before_kb, log_bytes, since_s = (
            memory_kb(daemon.pid),
            log.stat().st_size,
            computed_s(daemon.pid),
        )
        attack(attacker)
        is_well()
        what = attack.__name__
        assert daemon.poll() is None, what
        assert watchdog.longest_gap_s(since_s) < GAP_S, what
        assert memory_kb(daemon.pid) - before_kb < GROWTH_KB, what
        assert log.stat().st_size - log_bytes < LOG_BYTES, what
        sys.stdout.write(
            f"{what}: longest gap {watchdog.longest_gap_s(since_s):.2f} s, "
            f"{memory_kb(daemon.pid) - before_kb} kB more, {log.stat().st_size - log_bytes} "
            "bytes of log\n"
        )
    said = log.read_text()
    assert "Traceback" not in said
    assert not [line for line in said.splitlines() if line.startswith("ERROR forged")]
    # Each forged status is contradicted once.
    assert subscriber.payloads("main/status").count(b"online") < 100
    assert subscriber.payloads("main/status")[-1] == b"online"
    assert b"OFF" not in subscriber.payloads("x/contact")
    for reader in attacker.idle:
        reader.close()
    attacker.client.disconnect()
    attacker.client.loop_stop()
    assert set(stack.stop()) <= {0}
