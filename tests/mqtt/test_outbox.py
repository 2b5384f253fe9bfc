"""What waits to be published: the newest frame, every event or its count, the last state."""

import asyncio
import logging

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import json

from skin_host.clock import SteppedClock
from skin_host.mqtt.outbox import BACKLOG, REPEAT_S, REPEATED, Event, Outbox, State
from skin_host.mqtt.trials import HOLD_S
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from tests.support.said import touch_event


def frame(part: str, seq: int, t_ns: int = 0) -> PressureFrame:
    mask = np.zeros(1, np.bool_)
    return PressureFrame(
        part, seq, t_ns, np.zeros(1, np.uint8), np.zeros(1, np.float32), mask, ~mask, mask
    )


def touch(event: str, part: str = "palm", contact: int = 1, t_ns: int = 1) -> Touch:
    return touch_event(event, contact, 1, t_ns, part, [1], None, None, 1.0, 1.0, 1.0, 0.1)  # type: ignore[arg-type]


def connected(
    event_limit: int = 16, frame_hz: float = 0.0, clock: SteppedClock | None = None
) -> Outbox:
    outbox = Outbox(event_limit, frame_hz, clock or SteppedClock())
    outbox.counters.connected = True
    return outbox


def payloads(states: dict[str, State]) -> dict[str, bytes]:
    return {topic: state.payload for topic, state in states.items()}


def test_before_anything_was_put_nothing_is_counted() -> None:
    counters = Outbox(16).counters
    assert not any(getattr(counters, name) for name in counters.__slots__)


@given(st.lists(st.sampled_from(["a", "b", "c"])))
def test_every_frame_is_taken_or_counted(parts: list[str]) -> None:
    outbox = connected()
    newest = {}
    for seq, part in enumerate(parts):
        outbox.put_frame(frame(part, seq))
        newest[part] = seq
    taken = [outbox.take_frame() for _ in range(len(outbox.frames))]
    assert {one.part: one.seq for one in taken} == newest
    assert len(taken) + outbox.counters.frames_skipped == len(parts)


def test_a_part_that_comes_often_does_not_keep_the_others_waiting() -> None:
    outbox = connected()
    for seq, part in enumerate(["slow", "fast", "fast", "fast"]):
        outbox.put_frame(frame(part, seq))
    assert outbox.take_frame().part == "slow"


@settings(max_examples=20, deadline=None)
@given(
    rate_hz=st.sampled_from([1.0, 10.0, 25.0, 50.0]),
    jitter_ns=st.lists(st.integers(0, 1_500_000), min_size=500, max_size=500),
)
def test_frames_are_thinned_to_the_rate_despite_jitter(
    rate_hz: float, jitter_ns: list[int]
) -> None:
    outbox = connected(frame_hz=rate_hz)
    passed = 0
    for seq, jitter in enumerate(jitter_ns):  # ten seconds at 50 Hz
        outbox.put_frame(frame("palm", seq, seq * 20_000_000 + jitter))
        passed += len(outbox.frames)
        outbox.frames.clear()
    assert abs(passed - 10 * rate_hz) <= 1


def test_while_many_events_wait_a_contact_waits_with_its_newest_move_only() -> None:
    outbox = connected(event_limit=10_000)
    waiting_before = BACKLOG + 1
    for contact in range(waiting_before):
        outbox.put_touch("palm", touch("begin", contact=contact), None)
    for t_ns in range(1000):
        for contact in (1, 2):
            outbox.put_touch("palm", touch("move", contact=contact, t_ns=t_ns), None)
    for contact in (1, 2):
        outbox.put_touch("palm", touch("end", contact=contact), None)
    waiting = [json.decode(event.payload) for event in outbox.events]
    assert [(one["event"], one["id"], one["t_ns"]) for one in waiting[waiting_before:]] == [
        ("move", 1, 999),
        ("move", 2, 999),
        ("end", 1, 1),
        ("end", 2, 1),
    ]
    assert [one["count"] for one in waiting] == list(range(1, len(waiting) + 1))
    assert outbox.counters.moves_replaced == 2 * 999
    assert outbox.counters.touches_dropped == 0


def test_a_move_that_may_be_on_its_way_is_not_replaced() -> None:
    outbox = connected(event_limit=10_000)
    outbox.put_touch("palm", touch("move", contact=0), None)
    for contact in range(1, BACKLOG + 1):
        outbox.put_touch("palm", touch("begin", contact=contact), None)
    outbox.put_touch("palm", touch("move", contact=0, t_ns=2), None)
    first, last = outbox.events[0], outbox.events[-1]
    assert [json.decode(one.payload)["t_ns"] for one in (first, last)] == [1, 2]


def test_a_move_behind_repeated_events_keeps_what_its_number_stood_for() -> None:
    outbox = connected(event_limit=10_000)
    for contact in range(1, BACKLOG + 2):
        outbox.put_touch("palm", touch("begin", contact=contact), None)
    for _ in range(BACKLOG + 1):
        outbox.event_sent()
    outbox.put_touch("palm", touch("move", t_ns=2), None)  # may be in flight as the broker dies
    assert outbox.repeat_events() == BACKLOG + 1
    outbox.put_touch("palm", touch("move", t_ns=3), None)
    waiting = [json.decode(event.payload) for event in outbox.events]
    assert [one["t_ns"] for one in waiting[-2:]] == [2, 3]
    assert outbox.counters.moves_replaced == 0


@given(st.lists(st.tuples(st.sampled_from(["begin", "move", "end"]), st.sampled_from("ab"))))
def test_every_event_waits_or_is_counted_and_leaves_a_gap(events: list[tuple[str, str]]) -> None:
    outbox = connected()
    for event, part in events:
        outbox.put_touch(part, touch(event, part), None)
    waiting = [json.decode(event.payload) for event in outbox.events]
    assert len(waiting) <= 16
    assert len(waiting) + outbox.counters.touches_dropped == len(events)
    for part in "ab":
        put = sum(where == part for _, where in events)
        counts = [one["count"] for one in waiting if one["part"] == part]
        assert counts == sorted(set(counts))
        assert set(counts) <= set(range(1, put + 1))


def test_moves_leave_room_for_begins_and_ends() -> None:
    outbox = connected()
    for _ in range(20):
        outbox.put_touch("t", touch("move"), None)
    for _ in range(8):
        outbox.put_touch("t", touch("end"), None)
    kinds = [json.decode(event.payload)["event"] for event in outbox.events]
    assert kinds == ["move"] * 8 + ["end"] * 8


def test_a_state_that_changes_on_its_way_is_sent_again() -> None:
    outbox = connected()
    outbox.put_state("t", b"ON")
    states = outbox.take_states(6)
    outbox.put_state("t", b"OFF")
    outbox.states_sent(states)
    assert payloads(outbox.take_states(6)) == {"t": b"OFF"}
    outbox.states_sent({"t": outbox.retained["t"]})
    assert outbox.take_states(6) == {}
    outbox.repeat_states()
    assert payloads(outbox.take_states(6)) == {"t": b"OFF"}


def answer(text: bytes = b"{}") -> Event:
    return Event("reply", text, None, is_touch=False)


def numbers(outbox: Outbox) -> list[int]:
    return [json.decode(event.payload)["count"] for event in outbox.events]


def test_without_a_broker_frames_are_counted_and_not_kept() -> None:
    outbox = Outbox(16)
    outbox.put_frame(frame("palm", 1))
    assert (len(outbox.frames), outbox.counters.frames_skipped) == (0, 1)


def test_frames_that_could_not_be_sent_go_first_and_never_replace_newer_ones() -> None:
    outbox = connected()
    for part, seq in (("a", 1), ("b", 1)):
        outbox.put_frame(frame(part, seq))
    unsent = [outbox.take_frame(), outbox.take_frame()]
    outbox.put_frame(frame("c", 1))
    outbox.put_frame(frame("b", 2))
    outbox.put_back(unsent)
    assert [(one.part, one.seq) for one in outbox.frames.values()] == [("a", 1), ("b", 2), ("c", 1)]
    outbox.drop_frames()
    assert (len(outbox.frames), outbox.counters.frames_skipped) == (0, 3)


@pytest.mark.parametrize(
    ("times_ms", "passed"),
    [
        # A tenth of the interval early is on time, more is not.
        ([0, 90, 190], [1, 1, 1]),
        ([0, 89.999, 189.999], [1, 0, 1]),
        # Times keep to the grid as long as they are late by no more than an interval.
        ([0, 200, 280, 300], [1, 1, 1, 1]),
        # After a longer gap the grid begins again.
        ([0, 200.001, 280, 300], [1, 1, 0, 1]),
        ([0, 1000, 1050, 1091], [1, 1, 0, 1]),
        # A clock that was set back by more than two intervals begins another grid.
        ([1000, 900, 950], [1, 0, 0]),
        ([1000, 899.999, 950, 990], [1, 1, 0, 1]),
    ],
)
def test_frames_keep_to_a_grid_of_time(times_ms: list[float], passed: list[int]) -> None:
    outbox = connected(frame_hz=10.0)
    taken = []
    for seq, t_ms in enumerate(times_ms):
        outbox.put_frame(frame("palm", seq, round(t_ms * 1e6)))
        taken.append(len(outbox.frames))
        outbox.frames.clear()
    assert taken == passed


def test_the_parts_are_thinned_apart() -> None:
    outbox = connected(frame_hz=10.0)
    for part in "ab":
        outbox.put_frame(frame(part, 1, 5))
    assert list(outbox.frames) == ["a", "b"]


@pytest.mark.parametrize(("ahead", "replaced"), [(BACKLOG - 1, 0), (BACKLOG, 1)])
def test_only_moves_behind_the_first_ones_are_replaced(ahead: int, replaced: int) -> None:
    outbox = connected(event_limit=10_000)
    for contact in range(1, ahead + 1):
        outbox.put_touch("palm", touch("begin", contact=contact), None)
    outbox.put_touch("palm", touch("move", contact=0, t_ns=1), None)
    outbox.put_touch("palm", touch("begin", contact=500), None)
    outbox.put_touch("palm", touch("move", contact=0, t_ns=2), None)
    assert outbox.counters.moves_replaced == replaced
    assert json.decode(outbox.events[ahead].payload)["t_ns"] == 1 + replaced
    assert numbers(outbox) == list(range(1, len(outbox.events) + 1))


def test_a_move_after_the_end_of_its_contact_replaces_nothing() -> None:
    outbox = connected(event_limit=10_000)
    for contact in range(BACKLOG + 1):
        outbox.put_touch("palm", touch("begin", contact=contact), None)
    for event in ("move", "end", "move"):
        outbox.put_touch("palm", touch(event, contact=3), None)
    assert outbox.counters.moves_replaced == 0


def test_a_full_queue_is_reported_once_until_it_was_empty(
    caplog: pytest.LogCaptureFixture,
) -> None:
    outbox = connected(event_limit=2)

    def overflow() -> None:
        for _ in range(4):
            outbox.put_touch("palm", touch("end"), None)

    with caplog.at_level(logging.WARNING):
        overflow()
        outbox.event_sent()
        overflow()
        assert len(caplog.messages) == 1
        for _ in range(2):
            outbox.event_sent()
        overflow()
    assert len(caplog.messages) == 2
    assert outbox.counters.touches_dropped == 2 + 3 + 2


async def test_an_event_to_a_withheld_topic_is_counted_and_a_state_waits_for_the_end() -> None:
    clock = SteppedClock()
    outbox = connected(clock=clock)
    for topic in ("touch", "state"):
        outbox.trials.withhold(topic)
    outbox.put_touch("touch", touch("begin"), None)
    assert outbox.held_until_s() is None
    outbox.put_state("state", b"0")
    outbox.put_state("state", b"1")
    assert not outbox.events
    assert outbox.take_states(6) == {}
    assert outbox.held_until_s() == clock.monotonic_s() + HOLD_S
    await outbox.drained()  # the end of the program does not wait for it
    assert (outbox.counters.touches_dropped, outbox.counters.rejected) == (1, 1)
    assert outbox.counted("touch") == 1
    assert outbox.counted("other") == 0
    clock.advance(3600.0)
    outbox.put_touch("touch", touch("end"), None)
    assert numbers(outbox) == [2]
    assert payloads(outbox.take_states(6)) == {"state": b"1"}
    outbox.states_sent(outbox.take_states(6))
    assert outbox.held_until_s() is None


def test_a_state_whose_payload_came_back_is_not_the_one_that_was_given_up() -> None:
    outbox = connected()
    off = b"OFF"
    outbox.put_state("t", off)
    outbox.give_up_state("t")
    outbox.put_state("t", b"ON")
    outbox.put_state("t", off)
    outbox.repeat_states()
    assert payloads(outbox.take_states(6)) == {"t": b"OFF"}


def test_a_state_that_is_put_again_while_it_is_on_its_way_is_sent_again() -> None:
    outbox = connected()
    outbox.put_state("t", b"ON")
    sent = outbox.take_states(6)
    outbox.put_state("t", sent["t"].payload)
    outbox.states_sent(sent)
    assert payloads(outbox.take_states(6)) == {"t": b"ON"}


def test_what_a_broker_acknowledged_lately_goes_before_what_waits_and_once() -> None:
    clock = SteppedClock()
    outbox = connected(event_limit=10, clock=clock)
    for _ in range(4):
        outbox.put_touch("palm", touch("end"), None)
    outbox.put_event(answer())
    for _ in range(2):
        outbox.event_sent()
        clock.advance(1.0)
    clock.advance(REPEAT_S - 2.0)
    # The first arrived exactly so long ago, so it counts; the answer is nothing to repeat.
    assert outbox.counters.touches_sent == 2
    puts: list[None] = []
    outbox.on_put = lambda: puts.append(None)
    assert outbox.repeat_events() == 2
    assert puts
    assert outbox.counters.touches_sent == 0
    assert [json.decode(event.payload).get("count") for event in outbox.events] == [
        1,
        2,
        3,
        4,
        None,
    ]
    assert outbox.repeat_events() == 0
    for _ in range(5):
        outbox.event_sent()
    assert outbox.counters.touches_sent == 4
    clock.advance(REPEAT_S + 0.001)
    assert outbox.repeat_events() == 0


def test_no_more_than_so_many_events_are_repeated() -> None:
    outbox = connected(event_limit=10_000)
    for _ in range(REPEATED + 5):
        outbox.put_touch("palm", touch("end"), None)
        outbox.event_sent()
    assert outbox.repeat_events() == REPEATED == 1000
    assert numbers(outbox)[0] == 6


def test_what_is_given_up_is_counted_by_its_kind() -> None:
    outbox = connected()
    outbox.put_event(answer(b"first"))
    outbox.put_touch("palm", touch("begin"), None)
    outbox.put_touch("palm", touch("end"), None)
    assert outbox.touches_waiting() == 2
    outbox.give_up_event()
    assert (outbox.counters.rejected, outbox.counters.touches_dropped) == (1, 0)
    outbox.give_up_event(1)
    assert (outbox.counters.rejected, outbox.counters.touches_dropped) == (2, 1)
    assert numbers(outbox) == [1]
    assert not outbox.emptied.is_set()
    outbox.give_up_event()
    assert outbox.emptied.is_set()


def test_answers_are_dropped_and_touches_are_not() -> None:
    outbox = connected()
    outbox.put_event(answer())
    outbox.put_touch("palm", touch("begin"), None)
    outbox.put_event(answer())
    outbox.drop_answers()
    assert numbers(outbox) == [1]
    assert outbox.counters.answers_dropped == 2


def test_states_are_taken_in_their_order_and_stay_until_they_have_arrived() -> None:
    outbox = connected()
    for topic in "abc":
        outbox.put_state(topic, topic.encode())
    assert outbox.retained_put.is_set()
    first = outbox.take_states(2)
    assert payloads(first) == {"a": b"a", "b": b"b"}
    assert outbox.take_states(2) == first
    outbox.states_sent(first)
    assert outbox.counters.retained_sent == 2
    assert not outbox.emptied.is_set()
    outbox.states_sent(outbox.take_states(2))
    assert outbox.emptied.is_set()


def test_states_that_change_whenever_they_are_sent_do_not_keep_the_others_waiting() -> None:
    outbox = connected()
    for topic in ("restless", "restless too", "quiet"):
        outbox.put_state(topic, b"0")
    first = outbox.take_states(2)
    for topic in first:
        outbox.put_state(topic, b"1")
    outbox.states_sent(first)
    assert list(outbox.take_states(3)) == ["quiet", "restless", "restless too"]


def test_a_state_that_the_broker_does_not_take_is_not_repeated_until_it_changes() -> None:
    outbox = connected()
    outbox.put_state("t", b"too long")
    outbox.put_state("u", b"fits")
    outbox.give_up_state("t")
    assert outbox.counters.rejected == 1
    assert not outbox.emptied.is_set()
    outbox.states_sent(outbox.take_states(6))
    outbox.repeat_states()
    assert payloads(outbox.take_states(6)) == {"u": b"fits"}
    outbox.give_up_state("u")
    assert outbox.emptied.is_set()
    outbox.put_state("t", b"short")
    assert payloads(outbox.take_states(6)) == {"t": b"short"}
    outbox.repeat_states()
    assert payloads(outbox.take_states(6)) == {"t": b"short"}


async def test_all_has_arrived_when_neither_an_event_nor_a_state_waits() -> None:
    outbox = connected()
    await outbox.drained()
    outbox.put_touch("palm", touch("end"), None)
    outbox.put_state("t", b"1")
    waiting = asyncio.create_task(outbox.drained())
    done = []
    for step in (outbox.event_sent, lambda: outbox.states_sent(outbox.take_states(1))):
        for _ in range(3):
            await asyncio.sleep(0)
        done.append(waiting.done())
        step()
    await waiting
    assert done == [False, False]


def test_who_sends_is_woken_by_a_frame_and_by_states_that_are_repeated() -> None:
    outbox, woken = connected(frame_hz=10.0), []
    outbox.on_put = lambda: woken.append(len(outbox.frames))
    outbox.put_frame(frame("palm", 0))
    assert woken == [1]
    # One that is not due wakes nobody.
    outbox.put_frame(frame("palm", 1, 1))
    assert woken == [1]
    outbox.put_state("palm/contact", b"ON")
    outbox.retained_put.clear()
    outbox.repeat_states()
    assert outbox.retained_put.is_set()
    assert list(outbox.pending) == ["palm/contact"]
