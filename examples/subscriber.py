"""A subscriber without skin-host, with paho-mqtt alone, to copy from: who is touched, how hard.

`python examples/subscriber.py [PORT [NAME]]`. The broker keeps events for NAME while it is away, so
each subscriber needs its own. In brackets: the numbers of the rules in docs/subscribers.md.
"""

import json
import queue
import sys
import time
from dataclasses import dataclass
from math import inf

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

#: Without its health, which comes once a second, nothing is known of a part.
STALE_S = 3.0
#: Two computers' clocks may run apart by this share: over days it looks like a delay that grows, so
#: the distance between them is let shrink by as much.
CLOCKS_APART = 200e-6
#: The broker keeps our subscriptions, and events for them, for this long while we are away.
AWAY_S = 300
#: Events with QoS 1, which the broker keeps for us. States with QoS 0: an old one is of no use.
TOPICS = [
    *[(f"skin/+/{topic}", 0) for topic in ("nodes/+/status", "+/contact", "+/health")],
    ("skin/+/+/touch", 1),
]
EVENTS = ("begin", "move", "end")
STATES = ("ON", "OFF", "UNKNOWN")
#: Reasons of a broker that would come again and again: unknown protocol, name of the client, user
#: or password, not authorized, another client has our NAME.
FINAL = {0x84, 0x85, 0x86, 0x87, 0x8E}
#: Of more parts than robots have, nothing is kept: anybody may publish names without end.
MOST_PARTS = 1000

#: From paho's thread: a message, or why there is no connection, or a line about a new one.
inbox: "queue.Queue[mqtt.MQTTMessage | ReasonCode | str]" = queue.Queue(10_000)


@dataclass
class Part:
    """What is known of one part."""

    state: str = "UNKNOWN"
    alive_s: float = -inf
    shown: str = ""
    #: Of the newest event: the start of the daemon that counted it, and its number since then.
    run: str | None = None
    count: int = 0
    #: Of the newest state: the connection of the daemon, and the least distance between our clock
    #: and the time since that began, by which later messages are compared.
    connection: str = ""
    least_s: float = inf

    def take_sign(self, now_s: float, stamp: str) -> None:
        """Take a sign of life, unless a broker that was held up delivers it late (3)."""
        connection, _, since_ns = stamp.partition(".")
        distance_s = now_s - int(since_ns or 0) * 1e-9 * (1.0 + CLOCKS_APART)
        if connection != self.connection:
            self.connection, self.least_s = connection, inf
        self.least_s = min(self.least_s, distance_s)
        if not stamp or distance_s - self.least_s < STALE_S:
            self.alive_s = now_s

    def forget(self) -> None:
        """What was received is out of date; what is true comes again."""
        self.state, self.alive_s = "UNKNOWN", -inf

    def lost(self, run: str, count: int) -> int | None:
        """Return how many events are missing before this one; None: it came before (4, 5)."""
        before = self.count
        if run != self.run:  # a daemon that starts counts from 1; we may have come later
            before = count - 1 if self.run is None else 0
        if count <= before:
            return None
        self.run, self.count = run, count
        return count - before - 1

    def show(self, name: str, now_s: float) -> None:
        """Print the state if it has changed. What is not received is not untouched (1, 3)."""
        state = self.state if now_s - self.alive_s < STALE_S else "UNKNOWN"
        if state != self.shown:
            self.shown = state
            print(name, state, flush=True)


class Parts(dict[str, Part]):
    """Parts by name, each from its first message on."""

    def __missing__(self, name: str) -> Part:
        if len(self) >= MOST_PARTS:
            raise ValueError("too many parts")
        return self.setdefault(name, Part())


def take(message: mqtt.MQTTMessage, parts: Parts) -> None:
    """Take a message.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: it is not one of a robot's skin.
    """
    if not message.topic.isprintable():  # anybody may publish, and a terminal obeys what it shows
        raise ValueError("topic")
    name, _, kind = message.topic.removeprefix("skin/").rpartition("/")
    sent = dict(getattr(message.properties, "UserProperty", ()))
    if kind == "status":
        if message.payload != b"online":  # contact and health are out of date (2)
            for part in sent.get("parts", "").split(","):
                if known := parts.get(f"{name.split('/')[0]}/{part}"):
                    known.forget()
        return
    if kind == "touch":
        touch = json.loads(message.payload)
        event, number, force_n = touch["event"], int(touch["id"]), float(touch["force_n"])
        # Another schema may have another meaning; keys that we do not know are ignored (7).
        if touch["schema"] != "skin.touch/1" or event not in EVENTS:
            raise ValueError("event")
        part, run = parts[name], sent.get("run", "")
        if part.run not in (None, run):
            print(name, "the daemon was started again", flush=True)
        lost = part.lost(run, int(touch["count"]))
        if lost:  # what lasts comes again within a second, as a move
            print(name, lost, "events were lost", flush=True)
        if lost is not None:
            # Only a contact that was released is over (1).
            is_open = event == "end" and touch["reason"] != "released"
            doubt = ", may still last" if is_open else ""
            print(name, event, number, f"{force_n:.2f} N{doubt}", flush=True)
        return
    if kind == "contact":
        state = message.payload.decode() or "UNKNOWN"  # without payload: it was deleted
        if state not in STATES:
            raise ValueError("state")
        parts[name].state = state
    # A retained message may be from any time, and anybody may delete one.
    if message.payload and not message.retain:
        parts[name].take_sign(message.timestamp, sent.get("stamp", ""))


def watch() -> None:
    """Print what is received until the broker does not want us."""
    parts = Parts()
    while True:
        try:
            seen = inbox.get(timeout=STALE_S / 10)
        except queue.Empty:
            seen = None
        if isinstance(seen, mqtt.MQTTMessage):
            try:
                take(seen, parts)
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                print("unreadable:", ascii(seen.topic), repr(error), file=sys.stderr)
        elif isinstance(seen, str):
            print(seen, flush=True)
        elif seen is not None:
            if seen.value in FINAL:
                sys.exit(f"the broker refuses us: {seen}")
            print("no connection to the broker:", seen, flush=True)
            for part in parts.values():
                part.forget()
        for name, part in parts.items():
            part.show(name, time.monotonic())


def on_connect(
    client: mqtt.Client, _data: object, flags: mqtt.ConnectFlags, reason: ReasonCode, _: object
) -> None:
    """Subscribe again after every connection (6)."""
    if reason.is_failure:
        inbox.put(reason)
        return
    client.subscribe(TOPICS)
    kept = "and has kept" if flags.session_present else "without"
    inbox.put(f"the broker is there, {kept} what came meanwhile")


def main(port: str = "1883", name: str = "subscriber-example") -> None:
    """Connect to the broker of this computer, and watch."""
    if not (port.isdecimal() and 0 < int(port) < 65536):
        sys.exit(f"{port}: wanted the port of a broker, a number from 1 to 65535")
    client = mqtt.Client(CallbackAPIVersion.VERSION2, client_id=name, protocol=mqtt.MQTTv5)
    client.on_connect = on_connect
    client.on_disconnect = lambda _client, _data, _flags, reason, _properties: inbox.put(reason)
    client.on_message = lambda _client, _data, message: inbox.put(message)
    # MQTT 5 ends a session with its connection unless it is given a time.
    session = Properties(PacketTypes.CONNECT)
    session.SessionExpiryInterval = AWAY_S
    try:
        try:
            client.connect("localhost", int(port), clean_start=False, properties=session)
        except OSError as error:
            sys.exit(f"localhost:{port}: {error}; is a broker running there?")
        client.loop_start()
        watch()
    except KeyboardInterrupt:
        pass
    finally:
        client.disconnect()


if __name__ == "__main__":
    main(*sys.argv[1:])
