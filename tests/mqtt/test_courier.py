"""What a courier sends over a connection, in which order, and what it gives up."""

import asyncio
import itertools
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import pytest
from msgspec import json

from skin_host.clock import SteppedClock
from skin_host.mqtt.address import Broker
from skin_host.mqtt.commands import RESULT_SCHEMA, Result
from skin_host.mqtt.connection import (
    GRACE_S,
    TIMEOUT_S,
    MessageProperties,
    MqttError,
    message_properties,
)
from skin_host.mqtt.courier import (
    FRAME_WINDOW,
    RETAINED_WINDOW,
    TOUCH_WINDOW,
    Courier,
    FrameForm,
    Suspect,
)
from skin_host.mqtt.outbox import Event, Outbox
from skin_host.mqtt.packets import publish_head
from skin_host.mqtt.topics import ONLINE, Topics
from skin_host.mqtt.trials import HOLD_S, REJECTIONS, TRIES
from tests.mqtt.test_publisher import frame, touch
from tests.support.stepped import stepped

TOPICS = Topics("skin", "robot")
STATUS = TOPICS.node("status", "main")
TOUCHES = TOPICS.part("touch", "palm")


@dataclass
class Sent:
    topic: str
    payload: bytes
    qos: int
    retain: bool
    done: "asyncio.Future[None]"

    @property
    def number(self) -> int:
        """Of a touch."""
        return int(json.decode(self.payload)["count"])


@dataclass
class Link:
    """A connection to a broker that acknowledges when a test asks for it.

    Attributes:
        takes: how many packets of frames the socket has room for.
        written: what was sent, event or frame, in order.
        writes: how many packets there were in each write.
    """

    packet_limit: int | None = None
    takes: int = 10_000
    is_prompt: bool = False
    ended_by_broker: bool = False
    is_lost: bool = False
    sent: list[Sent] = field(default_factory=list)
    frames: list[bytes] = field(default_factory=list)
    written: list[str] = field(default_factory=list)
    writes: list[int] = field(default_factory=list)
    when_clear: Any = None

    def fits(self, topic: str, payload: bytes, properties: Any) -> bool:
        size = len(payload) + (0 if properties is None else len(properties.pack()))
        return self.packet_limit is None or size <= self.packet_limit

    def send(
        self, topic: str, payload: bytes, *, qos: int = 0, retain: bool = False, **_: object
    ) -> "asyncio.Future[None]":
        if self.is_lost:
            raise MqttError("lost")
        done = asyncio.get_running_loop().create_future()
        if self.is_prompt:
            done.set_result(None)
        self.sent.append(Sent(topic, payload, qos, retain, done))
        self.written.append("event")
        return done

    def flush(self) -> None:
        pass

    def is_clear(self) -> bool:
        return self.takes > 0

    def write_now(self, packets: list[bytes]) -> int:
        taken = min(self.takes, len(packets))
        self.frames += packets[:taken]
        self.written += ["frame"] * taken
        self.writes.append(taken)
        self.takes -= taken
        return taken

    def waiting(self, *topics: str) -> list[Sent]:
        """What is not acknowledged yet, of all topics or of some."""
        unanswered = [one for one in self.sent if not one.done.done()]
        return [one for one in unanswered if not topics or one.topic in topics]

    def shown(self) -> list[tuple[str, int]]:
        """The part and the number of each frame that was written."""
        found = []
        for packet in self.frames:
            start = packet.index(b"{")
            part = packet[:start].split(b"/")[-2].decode()
            found.append((part, json.decode(packet[start:])["seq"]))
        return found

    def acknowledge(self, sent: Iterable[Sent]) -> None:
        for one in sent:
            one.done.set_result(None)


class Sender:
    """A courier with its outbox, in stepped time.

    Attributes:
        acknowledged: the connections over which all states had been acknowledged.
    """

    def __init__(self, clock: SteppedClock) -> None:
        self.clock = clock
        self.outbox = Outbox(1000, clock=clock)
        self.outbox.counters.connected = True
        self.outbox.put_state(STATUS, ONLINE)
        self.acknowledged: list[Any] = []
        #: Of the states that are sent.
        self.properties: MessageProperties | None = None
        self.courier = Courier(
            self.outbox,
            TOPICS,
            STATUS,
            FrameForm("json", None),
            lambda topic, payload: self.properties,
            self.acknowledged.append,
            clock,
        )

    def put_touches(self, numbers: Iterable[int], part: str = "palm") -> None:
        for number in numbers:
            self.outbox.put_touch(TOPICS.part("touch", part), touch(number, part=part), None)

    def put_contacts(self, payload: bytes) -> list[str]:
        """Contact states of two parts; return their topics."""
        topics = [TOPICS.part("contact", part) for part in ("palm", "arm")]
        for topic in topics:
            self.outbox.put_state(topic, payload)
        return topics

    @asynccontextmanager
    async def over(self, link: Link) -> AsyncIterator["asyncio.Task[None]"]:
        """For as long as a connection lasts."""
        carrying = asyncio.create_task(self.courier.carry(link))  # type: ignore[arg-type]
        await self.turn()
        yield carrying
        carrying.cancel()
        with suppress(asyncio.CancelledError, MqttError, ExceptionGroup):
            await carrying

    async def turn(self, seconds: float = 0.001) -> None:
        await self.clock.sleep(seconds)

    async def rejected(self, link: Link | None = None) -> str | None:
        """Let the broker end a connection over what is put meanwhile; return the topic if it is
        found.
        """
        link = link or Link()
        async with self.over(link):
            link.acknowledge(link.waiting(STATUS))
            await self.turn()
        link.ended_by_broker = True
        return self.found(link)

    def found(self, link: Link) -> str | None:
        """The topic over which the broker has ended a connection, if it is found."""
        suspect = self.courier.note_end(link)  # type: ignore[arg-type]
        return suspect.topic if suspect and suspect.found else None


def is_loss(error: BaseException | None) -> bool:
    """Whether all that went wrong is that the broker is taken for lost."""
    if isinstance(error, ExceptionGroup):
        return all(map(is_loss, error.exceptions))
    return isinstance(error, MqttError)


@stepped
async def test_a_touch_goes_before_the_frames_of_its_turn_which_go_in_one_write(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link(is_prompt=True)
    async with sender.over(link):
        link.written.clear()
        for part in ("palm", "arm"):
            sender.outbox.put_frame(frame(1, part=part))
        sender.put_touches([1])
        await sender.turn()
    assert link.written == ["event", "frame", "frame"]
    assert link.writes == [2]
    assert sender.outbox.counters.frames_sent == 2


@stepped
async def test_of_many_frames_some_are_written_at_a_time_so_that_other_tasks_run(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link(is_prompt=True)
    n = 2 * FRAME_WINDOW + 1
    async with sender.over(link):
        for number in range(n):
            sender.outbox.put_frame(frame(1, part=f"part{number}"))
        turns = 0
        while len(link.frames) < n:
            await asyncio.sleep(0)
            turns += 1
    assert link.writes == [FRAME_WINDOW, FRAME_WINDOW, 1]
    assert turns >= 3


@stepped
async def test_frames_that_a_full_socket_leaves_wait_for_it_and_the_newest_goes(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link(is_prompt=True, takes=1)
    async with sender.over(link):
        for part in ("palm", "arm", "leg"):
            sender.outbox.put_frame(frame(1, part=part))
        await sender.turn()
        assert sender.outbox.counters.frames_sent == 1
        sender.outbox.put_frame(frame(2, part="leg"))
        await sender.turn()
        assert link.writes == [1]  # nothing is encoded for a socket that is full
        link.takes = 10
        link.when_clear()
        await sender.turn()
    assert link.shown() == [("palm", 1), ("arm", 1), ("leg", 2)]
    assert sender.outbox.counters.frames_sent == 3
    assert sender.outbox.counters.frames_skipped == 1


@stepped
async def test_what_is_put_in_a_block_is_written_at_its_end_without_another_turn(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link(is_prompt=True)
    async with sender.over(link):
        link.written.clear()
        with sender.courier:
            sender.outbox.put_frame(frame(1))
            sender.put_touches([1])
            assert link.written == []
        assert link.written == ["event", "frame"]


@stepped
async def test_what_is_put_before_a_connection_or_after_it_waits(clock: SteppedClock) -> None:
    sender, link = Sender(clock), Link(is_prompt=True)
    sender.put_touches([1])
    with sender.courier:
        sender.put_touches([2])
    async with sender.over(link):
        assert [one.number for one in link.sent if one.topic == TOUCHES] == [1, 2]
    sender.put_touches([3])
    await sender.turn()
    assert len(sender.outbox.events) == 1
    assert len([one for one in link.sent if one.topic == TOUCHES]) == 2


@stepped
async def test_frames_have_a_new_head_when_their_properties_change(clock: SteppedClock) -> None:
    sender, link = Sender(clock), Link(is_prompt=True)
    async with sender.over(link):
        sender.outbox.put_frame(frame(1))
        await sender.turn()
        sender.courier.use(FrameForm("cbor", None))
        sender.outbox.put_frame(frame(2))
        await sender.turn()
    head = publish_head(TOPICS.part("frame", "palm"), None)
    first, second = (packet[packet.index(head) + len(head) :] for packet in link.frames)
    assert first.startswith(b"{")
    assert not second.startswith(b"{")


@stepped
async def test_so_many_touches_are_on_their_way_and_the_next_follow_in_order(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link()
    async with sender.over(link):
        sender.put_touches(range(1, 2 * TOUCH_WINDOW + 1))
        await sender.turn()
        first = link.waiting(TOUCHES)
        assert [one.number for one in first] == list(range(1, TOUCH_WINDOW + 1))
        # An acknowledgement out of order makes no room: the queue is left from its front.
        link.acknowledge([first[1]])
        await sender.turn()
        assert len(link.waiting(TOUCHES)) == TOUCH_WINDOW - 1
        assert sender.outbox.counters.touches_sent == 0
        link.acknowledge([first[0]])
        await sender.turn()
        assert sender.outbox.counters.touches_sent == 2
        numbers = [one.number for one in link.sent if one.topic == TOUCHES]
        assert numbers == list(range(1, TOUCH_WINDOW + 3))


@stepped
async def test_a_touch_that_is_not_acknowledged_in_time_ends_the_connection_and_is_sent_again(
    clock: SteppedClock,
) -> None:
    sender, link, other = Sender(clock), Link(), Link()
    async with sender.over(link) as carrying:
        link.acknowledge(link.waiting(STATUS))
        sender.put_touches([1])
        await sender.turn(1.0)
        sender.put_touches([2])
        await sender.turn()
        link.acknowledge([link.waiting(TOUCHES)[0]])
        await sender.turn(TIMEOUT_S - 0.5)
        assert not carrying.done()  # the first was acknowledged, the second has time
        await sender.turn(0.5 + 2 * GRACE_S)
        assert carrying.done()
        assert is_loss(carrying.exception())
    sender.courier.note_end(link)  # type: ignore[arg-type]
    async with sender.over(other):
        assert [one.number for one in other.waiting(TOUCHES)] == [2]


@stepped
async def test_touches_that_are_acknowledged_keep_a_connection_for_ever(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link()
    async with sender.over(link) as carrying:
        link.acknowledge(link.waiting(STATUS))
        for number in range(100):
            sender.put_touches([number])
            await sender.turn(0.9 * TIMEOUT_S)
            link.acknowledge(link.waiting(TOUCHES))
            await sender.turn()
        assert not carrying.done()
    assert sender.outbox.counters.touches_sent == 100


@stepped
async def test_a_connection_that_is_lost_while_touches_are_put_loses_none(
    clock: SteppedClock,
) -> None:
    sender, link, other = Sender(clock), Link(), Link()
    async with sender.over(link):
        link.is_lost = True
        with sender.courier:
            sender.put_touches([1])
            sender.outbox.put_frame(frame(1))
        assert link.frames == []
    sender.courier.note_end(link)  # type: ignore[arg-type]
    async with sender.over(other):
        assert [one.number for one in other.waiting(TOUCHES)] == [1]


@stepped
async def test_states_go_some_at_a_time_and_are_counted_when_all_of_these_have_arrived(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link()
    for number in range(RETAINED_WINDOW):
        sender.outbox.put_state(f"state{number}", b"1")
    async with sender.over(link):
        assert len(link.sent) == RETAINED_WINDOW
        link.acknowledge(link.waiting()[1:])
        await sender.turn()
        assert sender.outbox.counters.retained_sent == 0
        assert sender.acknowledged == []
        link.acknowledge(link.waiting())
        await sender.turn()
        assert sender.outbox.counters.retained_sent == RETAINED_WINDOW
        assert sender.acknowledged == [link]
        assert [one.topic for one in link.waiting()] == [f"state{RETAINED_WINDOW - 1}"]


@stepped
async def test_states_are_retained_and_touches_not_and_both_ask_for_an_acknowledgement(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link(is_prompt=True)
    async with sender.over(link):
        sender.put_touches([1])
        await sender.turn()
    forms = {(one.topic, one.qos, one.retain) for one in link.sent}
    assert forms == {(STATUS, 1, True), (TOUCHES, 1, False)}


@stepped
async def test_a_state_that_is_not_acknowledged_in_time_ends_the_connection(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link()
    async with sender.over(link) as carrying:
        await sender.turn(TIMEOUT_S - 0.1)
        assert not carrying.done()
        await sender.turn(0.1 + 2 * GRACE_S)
        assert is_loss(carrying.exception())


@stepped
async def test_one_touch_that_the_broker_never_takes_is_dropped_after_some_tries(
    clock: SteppedClock,
) -> None:
    sender = Sender(clock)
    sender.put_touches([1])
    assert [await sender.rejected() for _ in range(TRIES)] == [*[None] * (TRIES - 1), TOUCHES]
    assert not sender.outbox.events
    assert (sender.outbox.counters.rejected, sender.outbox.counters.touches_dropped) == (1, 1)
    # The next ones are not suspected.
    sender.put_touches([2, 3])
    link = Link()
    async with sender.over(link):
        assert [one.number for one in link.waiting(TOUCHES)] == [2, 3]


@stepped
async def test_touches_that_were_on_their_way_together_have_no_strike_for_it(
    clock: SteppedClock,
) -> None:
    sender = Sender(clock)
    sender.put_touches([1, 2])
    assert [await sender.rejected() for _ in range(1 + TRIES)] == [*[None] * TRIES, TOUCHES]
    assert len(sender.outbox.events) == 1


@stepped
async def test_of_several_touches_on_their_way_the_rejected_one_is_found_one_at_a_time(
    clock: SteppedClock,
) -> None:
    sender = Sender(clock)
    sender.put_touches([1, 2, 3])
    assert await sender.rejected() is None
    found = None
    for _ in range(TRIES):
        link = Link()
        async with sender.over(link):
            link.acknowledge(link.waiting(STATUS))  # the broker works
            await sender.turn()
            while [one.number for one in link.waiting(TOUCHES)] == [1]:
                link.acknowledge(link.waiting(TOUCHES))
                await sender.turn()
            assert [one.number for one in link.waiting(TOUCHES)] == [2]
        link.ended_by_broker = True
        found = sender.found(link)
    assert found == TOUCHES
    link = Link()
    async with sender.over(link):
        link.acknowledge(link.waiting(STATUS))
        await sender.turn()
        assert [one.number for one in link.waiting(TOUCHES)] == [3]
        # Only the suspected ones go alone.
        sender.put_touches([4])
        await sender.turn()
        assert [one.number for one in link.waiting(TOUCHES)] == [3]
        link.acknowledge(link.waiting(TOUCHES))
        await sender.turn()
        sender.put_touches([5])
        await sender.turn()
        assert [one.number for one in link.waiting(TOUCHES)] == [4, 5]
    assert sender.outbox.counters.touches_sent == 2


@stepped
async def test_contacts_go_before_suspected_touches_which_take_a_round_trip_each(
    clock: SteppedClock,
) -> None:
    """The status makes valid what the broker retained of contacts."""
    sender = Sender(clock)
    sender.put_contacts(b"OFF")
    sender.put_touches([1, 2])
    async with sender.over(Link(is_prompt=True)):  # the broker has stored them
        pass
    sender.put_touches([3, 4])
    assert await sender.rejected() is None
    contacts = sender.put_contacts(b"ON")
    sender.outbox.repeat_states([STATUS, *contacts])
    link = Link()
    async with sender.over(link):
        link.acknowledge(link.waiting(STATUS))
        await sender.turn()
        assert [(one.topic, one.payload) for one in link.waiting()] == [
            (topic, b"ON") for topic in contacts
        ]
        link.acknowledge(link.waiting())
        await sender.turn()
        assert [one.number for one in link.waiting()] == [3]


@stepped
async def test_suspected_contacts_go_one_at_a_time_before_suspected_touches(
    clock: SteppedClock,
) -> None:
    sender = Sender(clock)
    sender.outbox.put_state("state", b"")
    contacts = sender.put_contacts(b"ON")
    sender.put_touches([1, 2])
    assert await sender.rejected() is None
    went, link = [], Link()
    async with sender.over(link):
        while waiting := link.waiting():
            went.append([one.topic for one in waiting])
            link.acknowledge(waiting)
            await sender.turn()
    assert went == [[STATUS], *[[topic] for topic in contacts], [TOUCHES], [TOUCHES], ["state"]]


@stepped
async def test_a_connection_that_never_worked_or_that_we_lost_accuses_no_message(
    clock: SteppedClock,
) -> None:
    sender = Sender(clock)
    sender.put_touches([1])
    for number in range(2 * TRIES):
        link = Link(ended_by_broker=number % 2 > 0)
        async with sender.over(link):
            if not link.ended_by_broker:
                link.acknowledge(link.waiting(STATUS))
                await sender.turn()
        assert sender.found(link) is None
    assert len(sender.outbox.events) == 1
    assert sender.outbox.counters.rejected == 0


@stepped
async def test_a_state_that_the_broker_never_takes_is_found_though_it_changes_at_every_try(
    clock: SteppedClock,
) -> None:
    """It is tried again as it is then, once, when its topic is no longer withheld."""
    sender, numbers = Sender(clock), itertools.count()

    async def rejected() -> str | None:
        sender.outbox.put_state("state", b"%d" % next(numbers))
        return await sender.rejected()

    # Over the first connection the status was on its way with it.
    assert [await rejected() for _ in range(1 + TRIES)] == [*[None] * TRIES, "state"]
    assert sender.outbox.counters.rejected == 1
    assert sender.outbox.trials.withheld == ["state"]
    link = Link(is_prompt=True)
    sender.outbox.repeat_states()
    async with sender.over(link):
        sender.outbox.put_state("state", b"withheld")
        await sender.turn(HOLD_S - 1.0)
        assert [one.topic for one in link.sent] == [STATUS]
        sender.outbox.put_state("state", b"newest")
        link.is_prompt = False
        await sender.turn(2.0)
        assert [one.payload for one in link.waiting()] == [b"newest"]
    link.ended_by_broker = True
    assert sender.found(link) == "state"
    assert sender.outbox.trials.withheld == ["state"]


@stepped
async def test_a_state_that_arrives_after_all_was_never_suspected(clock: SteppedClock) -> None:
    sender = Sender(clock)
    sender.outbox.put_state("state", b"1")
    for _ in range(TRIES):
        assert await sender.rejected() is None
    async with sender.over(Link(is_prompt=True)):
        pass
    sender.outbox.put_state("state", b"2")
    assert [await sender.rejected() for _ in range(1 + TRIES)] == [*[None] * TRIES, "state"]


@stepped
async def test_a_status_that_never_arrives_is_found_and_never_withheld(
    clock: SteppedClock,
) -> None:
    """Of what was on its way with it nothing is accused."""
    sender = Sender(clock)
    sender.outbox.put_state("state", b"1")
    suspects = []
    for _ in range(2 + TRIES):
        link = Link(ended_by_broker=True)
        async with sender.over(link):
            assert link.waiting(STATUS)
        suspects.append(sender.courier.note_end(link))  # type: ignore[arg-type]
    assert suspects == [None, *(Suspect(STATUS, found) for found in (0, 0, 1, 2))]
    assert sender.outbox.trials.withheld == []
    assert sender.outbox.counters.rejected == 0
    link = Link(is_prompt=True)
    async with sender.over(link):
        assert [one.topic for one in link.sent] == [STATUS, "state"]


@stepped
async def test_the_status_is_never_dropped(clock: SteppedClock) -> None:
    sender = Sender(clock)
    for _ in range(3 * TRIES):
        sender.outbox.repeat_states()
        link = Link()
        async with sender.over(link):
            link.acknowledge(link.waiting(STATUS))
            await sender.turn()
            sender.outbox.put_state(STATUS, ONLINE)
            await sender.turn()
            assert len(link.waiting(STATUS)) == 1
        link.ended_by_broker = True
        assert sender.found(link) is None
    assert sender.outbox.counters.rejected == 0


@stepped
async def test_suspected_states_go_one_at_a_time_after_the_status(clock: SteppedClock) -> None:
    sender = Sender(clock)
    for topic in "ab":
        sender.outbox.put_state(topic, b"1")
    await sender.rejected(Link())
    sender.outbox.repeat_states()
    link = Link()
    order = []
    async with sender.over(link):
        while waiting := link.waiting():
            assert len(waiting) == 1
            order.append(waiting[0].topic)
            link.acknowledge(waiting)
            await sender.turn()
    assert order == [STATUS, "a", "b"]
    assert not sender.outbox.pending


@stepped
async def test_an_answer_is_lost_with_the_connection_and_no_touch_is_accused_for_it(
    clock: SteppedClock,
) -> None:
    sender = Sender(clock)
    for _ in range(2 * TRIES):
        sender.outbox.put_event(Event("reply", b"{}", None, is_touch=False))
        link = Link(ended_by_broker=True)
        async with sender.over(link):
            link.acknowledge(link.waiting(STATUS))
            await sender.turn()
        assert sender.courier.note_end(link) == Suspect("reply", 0)  # type: ignore[arg-type]
    assert sender.outbox.counters.answers_dropped == 2 * TRIES
    assert sender.outbox.counters.rejected == 0


@stepped
async def test_an_acknowledgement_that_is_read_after_the_end_counts_for_no_other_event(
    clock: SteppedClock,
) -> None:
    """The answer before the touch is gone from the queue by then."""
    sender, link, other = Sender(clock), Link(), Link()
    async with sender.over(link):
        sender.outbox.put_event(Event("reply", b"{}", None, is_touch=False))
        sender.put_touches([1])
        await sender.turn()
    sender.courier.note_end(link)  # type: ignore[arg-type]
    link.acknowledge(link.waiting("reply"))
    await sender.turn()
    async with sender.over(other):
        assert [one.number for one in other.waiting(TOUCHES)] == [1]


@stepped
async def test_touches_on_their_way_with_an_answer_are_suspected_without_it(
    clock: SteppedClock,
) -> None:
    sender = Sender(clock)
    sender.outbox.put_event(Event("reply", b"{}", None, is_touch=False))
    sender.put_touches([1, 2, 3])
    assert await sender.rejected() is None
    sender.put_touches([4, 5])
    link = Link()
    waiting = []
    async with sender.over(link):
        while now := link.waiting():
            waiting.append([one.number for one in now if one.topic == TOUCHES])
            link.acknowledge(now)
            await sender.turn()
    assert waiting == [[], [1], [2], [3], [4, 5]]


async def answered(clock: SteppedClock, **keys: Any) -> list[dict[str, Any]]:
    """Answers to a command that reach a subscriber of a broker of small packets."""
    sender, link = Sender(clock), Link(packet_limit=1000, is_prompt=True)
    answer = json.encode(Result(RESULT_SCHEMA, "scan", id="a", **keys))
    sender.outbox.put_event(Event("reply", answer, None, is_touch=False))
    async with sender.over(link):
        found = [json.decode(one.payload) for one in link.sent if one.topic == "reply"]
    counters = sender.outbox.counters
    assert counters.rejected == counters.answers_dropped == (not found)
    return found


@stepped
async def test_an_answer_larger_than_the_broker_takes_is_shortened_and_says_so(
    clock: SteppedClock,
) -> None:
    """What was asked for is done: a refusal would let the asker do it again."""
    result = {"id": "b", "text": "x" * 2000, "kept": True, "list": [1] * 600, "few": [1, 2]}
    assert await answered(clock, ok=True, result=result) == [
        {
            "schema": RESULT_SCHEMA,
            "command": "scan",
            "id": "a",
            "ok": True,
            "result": {"id": "b", "kept": True, "few": [1, 2], "left_out": ["text", "list"]},
        }
    ]


@stepped
async def test_the_reason_of_a_refusal_is_shortened_too(clock: SteppedClock) -> None:
    (answer,) = await answered(clock, ok=False, error="x" * 2000, cause="request")
    assert (answer["ok"], answer["cause"]) == (False, "request")
    assert answer["error"] == "the reason is longer than the broker takes"


@stepped
async def test_an_answer_that_cannot_be_short_enough_is_dropped(clock: SteppedClock) -> None:
    result = {f"{number:03}": number for number in range(500)}
    assert await answered(clock, ok=True, result=result) == []


@stepped
async def test_frames_are_suspected_when_nothing_else_was_on_its_way(clock: SteppedClock) -> None:
    """One frame of each part asks for an acknowledgement; the part that gets none is withheld."""
    sender = Sender(clock)
    topic = TOPICS.part("frame", "arm")
    found = []
    for number in range(TRIES + 1):
        link = Link()
        async with sender.over(link):
            link.acknowledge(link.waiting(STATUS))
            await sender.turn()
            for part in ("palm", "arm"):
                sender.outbox.put_frame(frame(number, part=part))
            await sender.turn()
            if number:
                assert link.frames == []
            link.acknowledge(link.waiting(TOPICS.part("frame", "palm")))
            await sender.turn()
            assert [one.topic for one in link.waiting()] == ([topic] if number else [])
        link.ended_by_broker = True
        found.append(sender.found(link))
    assert found == [*[None] * TRIES, topic]
    assert sender.outbox.counters.rejected == 1
    assert sender.outbox.trials.withheld == [topic]
    link = Link(is_prompt=True)
    async with sender.over(link):
        for part in ("palm", "arm"):
            sender.outbox.put_frame(frame(9, part=part))
        await sender.turn()
    assert link.shown() == [("palm", 9)]


@stepped
async def test_a_suspected_frame_that_arrives_clears_its_part(clock: SteppedClock) -> None:
    sender = Sender(clock)
    for number in range(3 * TRIES):
        link = Link()
        async with sender.over(link):
            link.acknowledge(link.waiting(STATUS))
            await sender.turn()
            sender.outbox.put_frame(frame(number))
            await sender.turn()
            if number % 3 == 2:  # seldom enough, so that it is never accused often enough
                link.acknowledge(link.waiting())
                await sender.turn()
        link.ended_by_broker = True
        assert sender.found(link) is None
    assert sender.outbox.counters.rejected == 0


@stepped
async def test_frames_of_an_earlier_connection_are_not_suspected(clock: SteppedClock) -> None:
    sender = Sender(clock)
    for by_broker in (False, True):
        link = Link(is_prompt=True, ended_by_broker=by_broker)
        async with sender.over(link):
            if not by_broker:
                sender.outbox.put_frame(frame(1))
                await sender.turn()
        sender.courier.note_end(link)  # type: ignore[arg-type]
    link = Link(is_prompt=True)
    async with sender.over(link):
        sender.outbox.put_frame(frame(2))
        await sender.turn()
    assert link.shown() == [("palm", 2)]


@stepped
async def test_parts_that_send_no_frame_are_waited_for_a_second(clock: SteppedClock) -> None:
    sender, link = Sender(clock), Link(is_prompt=True)
    async with sender.over(link):
        sender.outbox.put_frame(frame(1))
        await sender.turn()
    link.ended_by_broker = True
    sender.courier.note_end(link)  # type: ignore[arg-type]
    link = Link(is_prompt=True)
    async with sender.over(link):
        sender.put_touches([1])
        await sender.turn(0.9)
        assert not [one for one in link.sent if one.topic == TOUCHES]
        await sender.turn(0.2)
        assert [one for one in link.sent if one.topic == TOUCHES]
        sender.outbox.put_frame(frame(2))
        await sender.turn()
    assert link.shown() == [("palm", 2)]


@stepped
async def test_frames_left_by_a_lost_connection_are_counted_as_skipped(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link(is_prompt=True, takes=0)
    async with sender.over(link):
        sender.outbox.put_frame(frame(1))
        await sender.turn()
    sender.courier.note_end(link)  # type: ignore[arg-type]
    assert not sender.outbox.frames
    assert sender.outbox.counters.frames_skipped == 1


LARGE = b"x" * 100


@stepped
async def test_a_state_larger_than_the_broker_takes_is_named_for_as_long_as_it_is(
    clock: SteppedClock, caplog: pytest.LogCaptureFixture
) -> None:
    sender, link = Sender(clock), Link(packet_limit=50, is_prompt=True)
    sender.outbox.put_state("state", LARGE)
    async with sender.over(link):
        assert "state" in sender.courier.too_large
        sender.outbox.put_state("state", LARGE)
        await sender.turn()
        assert [one.topic for one in link.sent] == [STATUS]
        assert sum("not published: state: 100 bytes" in one for one in caplog.messages) == 1
        assert "up to 50" in caplog.text
        sender.outbox.put_state("state", b"1")
        await sender.turn()
        assert not sender.courier.too_large
        assert [one.topic for one in link.sent] == [STATUS, "state"]


@stepped
async def test_a_broker_without_a_limit_takes_what_another_did_not(clock: SteppedClock) -> None:
    sender = Sender(clock)
    sender.outbox.put_state("state", LARGE)
    for limit, named in ((50, ["state"]), (None, [])):
        async with sender.over(Link(packet_limit=limit, is_prompt=True)):
            sender.outbox.put_state("state", LARGE)
            await sender.turn()
        assert list(sender.courier.too_large) == named


@stepped
async def test_a_touch_larger_than_the_broker_takes_is_dropped_and_the_next_goes(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link(packet_limit=1000)
    large = touch(2)
    large.taxels.extend(range(2000))
    async with sender.over(link):
        sender.put_touches([1])
        sender.outbox.put_touch(TOUCHES, large, None)
        sender.put_touches([3])
        await sender.turn()
        assert [one.number for one in link.waiting(TOUCHES)] == [1, 3]
        link.acknowledge(link.waiting(TOUCHES))
        await sender.turn()
    assert sender.outbox.counters.touches_sent == 2
    assert sender.outbox.counters.touches_dropped == 1


@stepped
async def test_suspected_messages_that_are_larger_than_the_next_broker_takes_are_dropped(
    clock: SteppedClock,
) -> None:
    sender = Sender(clock)
    large = touch(1)
    large.taxels.extend(range(2000))
    sender.outbox.put_touch(TOUCHES, large, None)
    sender.put_touches([2])
    sender.outbox.put_state("large", b"x" * 2000)
    sender.outbox.put_state("small", b"x")
    await sender.rejected()
    link = Link(packet_limit=1000)
    sent = []
    async with sender.over(link):
        sender.put_touches([3])
        while waiting := link.waiting():
            sent.append([one.topic for one in waiting])
            link.acknowledge(waiting)
            await sender.turn()
    assert sent == [[STATUS], [TOUCHES], ["small"], [TOUCHES]]
    assert [one.number for one in link.sent if one.topic == TOUCHES] == [2, 3]
    assert sender.outbox.counters.rejected == 2
    assert not sender.outbox.events
    assert not sender.outbox.pending


@stepped
async def test_touches_repeated_for_another_broker_are_suspected_with_those_behind_them(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link(is_prompt=True)
    sender.put_touches([1, 2])
    async with sender.over(link):
        pass
    sender.put_touches([3, 4])
    await sender.rejected()
    sender.courier.repeat_events()
    link = Link()
    async with sender.over(link):
        link.acknowledge(link.waiting(STATUS))
        await sender.turn()
        for number in (1, 2, 3, 4):
            assert [one.number for one in link.waiting(TOUCHES)] == [number]
            link.acknowledge(link.waiting(TOUCHES))
            await sender.turn()


@stepped
async def test_boards_bytes_go_with_frames_for_so_long(clock: SteppedClock) -> None:
    sender, link = Sender(clock), Link(is_prompt=True)
    async with sender.over(link):
        for seconds in (0.0, 9.0, 2.0):
            if seconds == 9.0:
                sender.courier.show_raw(10.0)
            await sender.turn(seconds)
            sender.outbox.put_frame(frame(1))
            await sender.turn()
        sender.courier.show_raw(10.0)
        sender.courier.show_raw(0.0)
        sender.outbox.put_frame(frame(1))
        await sender.turn()
    assert [b'"raw"' in packet for packet in link.frames] == [False, True, False, False]


@stepped
async def test_a_topic_is_withheld_for_some_time_after_rejections_in_a_row(
    clock: SteppedClock,
) -> None:
    sender = Sender(clock)
    for number in range(REJECTIONS):
        sender.put_touches([number])
        while sender.outbox.events:
            await sender.rejected()
    sender.put_touches([9])
    assert not sender.outbox.events
    clock.advance(HOLD_S)
    sender.put_touches([10])
    assert len(sender.outbox.events) == 1


@stepped
async def test_the_newest_of_the_states_put_while_their_topic_is_withheld_goes_when_that_ends(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link(is_prompt=True)
    async with sender.over(link) as carrying:
        sender.outbox.trials.withhold("contact")
        await sender.turn(1.0)
        sender.outbox.trials.withhold("later")
        for topic in ("later", "contact"):
            for payload in (b"ON", b"OFF", b"ON"):
                sender.outbox.put_state(topic, payload)
        await sender.turn(HOLD_S - 1.5)
        assert [one.topic for one in link.sent] == [STATUS]
        await sender.turn(1.0)
        assert [(one.topic, one.payload) for one in link.sent[1:]] == [("contact", b"ON")]
        await sender.turn(1.0)
        assert [(one.topic, one.payload) for one in link.sent[2:]] == [("later", b"ON")]
        await sender.turn(2 * HOLD_S)
        assert len(link.sent) == 3
        assert not carrying.done()


@stepped
async def test_a_status_that_is_put_again_while_it_is_on_its_way_with_others_is_sent_again(
    clock: SteppedClock,
) -> None:
    sender, link = Sender(clock), Link()
    sender.outbox.put_state("state", b"1")
    async with sender.over(link):
        link.acknowledge(link.waiting(STATUS))
        sender.outbox.put_state(STATUS, ONLINE)
        link.acknowledge(link.waiting())
        await sender.turn()
        assert [one.topic for one in link.waiting()] == [STATUS]


def answer(size: int) -> Event:
    reply = Result(RESULT_SCHEMA, "status", ok=True, id="1", result={"text": "x" * size})
    return Event("reply", json.encode(reply), None, is_touch=False)


@pytest.mark.parametrize("size", [0, 2000])
@stepped
async def test_an_answer_is_dropped_if_not_even_its_refusal_fits_and_what_follows_goes(
    clock: SteppedClock, size: int
) -> None:
    sender, link = Sender(clock), Link(packet_limit=50, is_prompt=True)
    async with sender.over(link):
        sender.outbox.put_event(answer(size))
        sender.outbox.put_event(Event("other", b"{}", None, is_touch=False))
        await sender.turn()
    assert [one.topic for one in link.sent if one.topic != STATUS] == ["other"]
    assert sender.outbox.counters.answers_dropped == 1
    assert not sender.outbox.events
    assert not sender.courier.too_large  # a reply's topic is used once


@stepped
async def test_what_fits_is_judged_with_the_properties(
    clock: SteppedClock, caplog: pytest.LogCaptureFixture
) -> None:
    sender, link = Sender(clock), Link(packet_limit=1000, is_prompt=True)
    sender.properties = message_properties(Broker("localhost", 1), "x" * 1000)
    async with sender.over(link):
        sender.outbox.put_state("state", b"1")
        sender.outbox.put_event(answer(0)._replace(properties=sender.properties))
        await sender.turn()
    assert link.sent == []
    assert sender.outbox.counters.answers_dropped == 1
    assert "not published: state: 1008 bytes; the broker takes packets of up to" in caplog.text


@stepped
async def test_a_status_larger_than_the_broker_takes_does_not_keep_suspected_messages_waiting(
    clock: SteppedClock,
) -> None:
    sender = Sender(clock)
    sender.put_touches([1, 2])
    await sender.rejected()
    sender.properties = message_properties(Broker("localhost", 1), "x" * 1000)
    sender.outbox.repeat_states()
    link = Link(packet_limit=1000, is_prompt=True)
    async with sender.over(link):
        pass
    assert [one.topic for one in link.sent] == [TOUCHES, TOUCHES]
    assert list(sender.courier.too_large) == [STATUS]
