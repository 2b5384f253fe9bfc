"""Takes a robot's messages for streams: each event once and in order, and the newest states."""

import asyncio
import logging
from collections.abc import Callable, Container, Iterable
from typing import Any

from skin_host.client.heard import Described, Health, is_online, read
from skin_host.client.nodes import MAX_NAMES, Nodes
from skin_host.client.order import EventOrder, Newest
from skin_host.client.presence import Contact, Presence
from skin_host.client.requests import Requests
from skin_host.client.streams import Kind, Stream
from skin_host.errors import SkinError, visible
from skin_host.fingertip.events import Over, Slip
from skin_host.mqtt.commands import decode_result
from skin_host.mqtt.connection import Message
from skin_host.mqtt.messages import Frame
from skin_host.mqtt.order import parts_of, run_of, stamp_of
from skin_host.mqtt.payload import MessageError
from skin_host.mqtt.topics import NAME, WRONG_NAME, PartTopic, Subject
from skin_host.processing.events import Touch

#: An event waits this long for an earlier one, which may come from another broker: as long as a
#: robot sends events again there (`mqtt.outbox.REPEAT_S`). Only after an earlier one is missing.
HOLD_S = 10.0
#: No more reasons why messages are unreadable are logged.
MOST_REASONS = 20

_log = logging.getLogger(__name__)


class Intake:
    """What has been received of a robot.

    Args:
        streams: that are open; they receive what is taken.
        requests: that wait for answers.
        stale_s: after which a part is not known any more.
        brokers: over how many the robot's messages come.

    Attributes:
        presence: whether parts are touched.
        nodes: the robot's daemons.
        parts: names of parts that were received.
        unreadable: messages that could not be read.
        info_error: why the last info could not be read.
    """

    def __init__(
        self, streams: Iterable[Stream[Any]], requests: Requests, stale_s: float, brokers: int
    ) -> None:
        self.presence = Presence(stale_s)
        self.nodes = Nodes(self.presence)
        self.parts: set[str] = set()
        self.unreadable = 0
        self.info_error = ""
        self._streams = streams
        self._requests = requests
        self._brokers = brokers
        self._latest: dict[str, Health] = {}
        self._nodes_received: set[str] = set()
        self._order = EventOrder(HOLD_S if brokers > 1 else 0.0)
        self._newest = Newest()
        self._unreadable_for: set[str] = set()

    def take(
        self,
        subject: Subject,
        message: Message,
        link: int,
        kinds_of: Callable[[str], Container[str]],
    ) -> bool:
        """Take a message of a topic, which came over a link.

        Args:
            subject: what the topic is about.
            message: of it.
            link: the number of the link to a broker.
            kinds_of: what is read of a part, by its name.

        Returns:
            Whether somebody reads it.
        """
        payload = message.payload if isinstance(message.payload, bytes) else b""
        kind, name, piece = subject
        try:
            if kind != "answer":
                self._admit(kind in ("status", "info"), name)
            if kind == "status":
                self._take_status(name, payload, link, message)
            elif kind == "info":
                if self._newness(kind, f"{name}/{piece}", message) is not False:
                    stamp = stamp_of(message.properties)
                    self.nodes.take_info(name, piece, payload, stamp, _now_s())
                    self._report_nodes()
            elif kind == "answer":
                self._requests.take(decode_result(payload))
            elif kind not in kinds_of(name):
                return False
            else:
                self._take_part(kind, name, payload, link, message)
        except SkinError as error:
            self._note_unreadable(message.topic.value, error)
            if kind == "info":
                self.info_error = visible(f"{message.topic.value}: {error}")
            if not isinstance(error, MessageError):  # it is we who cannot read it
                for stream in self._streams:
                    if stream.takes(kind, name):
                        stream.refuse(kind, error)
        return True

    def begin(self, stream: Stream[Any]) -> None:
        """Pass what is known already on to a stream that was opened."""
        known: dict[str, Iterable[Health | Contact | Described]] = {
            "health": self._latest.values(),
            "contact": self.presence.reported(),
            "info": self.nodes.described(),
        }
        for kind, items in known.items():
            for item in items:
                if stream.takes(kind, item.part):
                    stream.put(item)

    def forget(self, kind: str, kinds_of: Callable[[str], Container[str]]) -> None:
        """Forget states of parts, or touches, that are not followed any more.

        Args:
            kind: of their topic.
            kinds_of: what is followed of a part, by its name.
        """
        if kind not in ("contact", "health", "touch"):
            return
        for part in self.parts:
            if kind in kinds_of(part):
                continue
            if kind == "touch":
                self.presence.forget_touches(part)
                continue
            if kind == "health":
                self._latest.pop(part, None)
            else:
                self.presence.forget_state(part)
            self._newest.forget(kind, part)

    def look(self) -> None:
        """Report what the time that has passed makes of states."""
        self._report_contacts()
        self.nodes.watch(_now_s())

    def expire(self) -> None:
        """Pass on events that have waited for earlier ones long enough, and look."""
        for event in self._order.expire(_now_s()):
            self._pass_on(event, self._order.run_of(event))
        self.look()

    def _note_unreadable(self, topic: str, error: SkinError) -> None:
        """Count a message that cannot be read; log each reason once, and no more than some."""
        self.unreadable += 1
        why = visible(str(error))
        if why not in self._unreadable_for and len(self._unreadable_for) < MOST_REASONS:
            self._unreadable_for.add(why)
            _log.warning("%s: %s; such messages are passed over", visible(topic), why)

    def _admit(self, is_node: bool, name: str) -> None:
        """Remember a name, so that what is known of names stays bounded: anybody may publish.

        Raises:
            MessageError: no configuration has such a name, or there are too many.
        """
        names = self._nodes_received if is_node else self.parts
        if name not in names:
            if not NAME.fullmatch(name):
                raise MessageError(WRONG_NAME)
            if len(names) >= MAX_NAMES:
                what = "nodes" if is_node else "parts"
                raise MessageError(f"more than {MAX_NAMES} {what} of one robot")
            names.add(name)

    def _newness(self, kind: str, name: str, message: Message) -> bool | None:
        """Return whether a retained message is newer than the known one; None: the same again."""
        if self._brokers == 1:
            return True
        if not message.payload:
            self._newest.forget(kind, name)
            return True
        # Nodes and their infos are not published again and again.
        is_live = kind in ("contact", "health") and not message.retain
        live_s = _now_s() if is_live else None
        return self._newest.take(kind, name, stamp_of(message.properties), live_s)

    def _take_status(self, name: str, payload: bytes, link: int, message: Message) -> None:
        newness = self._newness("status", name, message)
        if newness is False:
            return
        online = is_online(payload, stamp_of(message.properties), is_only_broker=self._brokers == 1)
        self.nodes.take_status(
            name,
            online,
            _now_s(),
            link,
            again=newness is None,
            parts=parts_of(message.properties),
            deleted=not payload,
        )
        self.nodes.watch(_now_s())
        self._report_nodes()

    def _report_nodes(self) -> None:
        """Pass on what a status or an info has changed."""
        for described in self.nodes.changes():
            self._put("info", described)
        self._report_contacts()

    def _take_part(
        self, kind: PartTopic, part: str, payload: bytes, link: int, message: Message
    ) -> None:
        item = read(kind, part, payload, stored=message.retain)
        now_s = _now_s()
        if isinstance(item, Touch | Slip | Over):
            run = run_of(message.properties)
            before = self._order.run_of(item)
            for event in self._order.take(item, run, now_s):
                # What had to wait for its turn may be of the run before.
                self._pass_on(event, run if event.t_ns == item.t_ns else before)
        elif isinstance(item, Frame):
            run = run_of(message.properties)
            if self._order.take_frame(item, run, now_s):
                self.presence.take_data(part, now_s)
                self._put(kind, item, run)
        elif kind == "contact":
            assert item is None or isinstance(item, Contact)
            newness = self._newness(kind, part, message)
            if newness is not False:
                self.presence.take_state(
                    part,
                    None if item is None else item.state,
                    now_s,
                    link,
                    again=newness is None,
                    stored=message.retain,
                    sent_s=_sent_s(message),
                    connection=self._connection_of(message),
                )
        elif self._newness(kind, part, message):
            if item is None:
                self._latest.pop(part, None)
            else:
                assert isinstance(item, Health)
                if not item.stored:
                    sent_s, connection = _sent_s(message), self._connection_of(message)
                    self.presence.take_sign(part, now_s, sent_s, connection)
                self._latest[part] = item._replace(stored=True)
                self._put(kind, item)
        self._report_contacts()

    def _connection_of(self, message: Message) -> int | None:
        """Return the connection of the node over which a message was sent; None: not known, or it
        shows nothing.

        Over several brokers the messages of a connection do not come after those of the last one: a
        broker that is held up may be the next one that the node turned to.
        """
        stamp = stamp_of(message.properties)
        return None if stamp is None or self._brokers > 1 else stamp.connection

    def _pass_on(self, event: Touch | Slip | Over, run: int | None) -> None:
        kind: PartTopic = "touch"
        if isinstance(event, Touch):
            self.presence.take_touch(event, _now_s(), run)
        else:
            kind = "slip" if isinstance(event, Slip) else "over"
            self.presence.take_data(event.part, _now_s())
        self._put(kind, event, run)

    def _put(
        self,
        kind: Kind,
        item: Touch | Slip | Over | Frame | Health | Contact | Described,
        run: int | None = None,
    ) -> None:
        for stream in self._streams:
            if stream.takes(kind, item.part):
                stream.put(item, run)

    def _report_contacts(self) -> None:
        for contact in self.presence.changes(_now_s()):
            self._put("contact", contact)


def _sent_s(message: Message) -> float | None:
    """When a state was published, by the node's clock; None: it was stored, or does not show."""
    stamp = None if message.retain else stamp_of(message.properties)
    return None if stamp is None else stamp.sent_s


def _now_s() -> float:
    return asyncio.get_running_loop().time()
