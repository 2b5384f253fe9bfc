"""What waits to be published: the newest frame, every event or its count, the last state."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import json

from skin_host.mqtt.outbox import BACKLOG, Outbox
from skin_host.processing.events import TouchEvent
from skin_host.processing.pipeline import PressureFrame


def frame(part: str, seq: int, t_ns: int = 0) -> PressureFrame:
    mask = np.zeros(1, np.bool_)
    return PressureFrame(
        part, seq, t_ns, np.zeros(1, np.uint8), np.zeros(1, np.float32), mask, ~mask, mask
    )


def touch(event: str, part: str = "palm", contact: int = 1, t_ns: int = 1) -> TouchEvent:
    return TouchEvent(event, contact, 1, t_ns, part, [1], None, None, 1.0, 1.0, 1.0, 0.1)  # type: ignore[arg-type]


def connected(event_limit: int = 16, frame_hz: float = 0.0) -> Outbox:
    outbox = Outbox(event_limit, frame_hz)
    outbox.counters.connected = True
    return outbox


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
    assert outbox.take_states(6) == {"t": b"OFF"}
    outbox.states_sent({"t": outbox.retained["t"]})
    assert outbox.take_states(6) == {}
    outbox.repeat_states()
    assert outbox.take_states(6) == {"t": b"OFF"}
