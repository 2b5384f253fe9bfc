"""A stream says what it did not hear."""

import asyncio
from itertools import groupby
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skin_host.client.heard import Contact, Described, Health
from skin_host.client.streams import HELD, HELD_TAXELS, LATE_S, Stream
from skin_host.clock import SteppedClock
from skin_host.fingertip.events import Over
from skin_host.mqtt.messages import Frame
from skin_host.processing.events import Touch


def touch(count: int, t_ns: int | None = None, part: str = "palm") -> Touch:
    return Touch(
        event="move",
        id=1,
        seq=count,
        t_ns=count if t_ns is None else t_ns,
        count=count,
        part=part,
        taxels=[1],
        centroid_m=None,
        normal=None,
        area_mm2=1.0,
        peak_kpa=1.0,
        mean_kpa=1.0,
        force_n=0.1,
    )


def frame(seq: int, t_ns: int | None = None, part: str = "palm", taxels: int = 1) -> Frame:
    mask = np.zeros(taxels, np.bool_)
    return Frame(part, seq, seq if t_ns is None else t_ns, np.zeros(taxels), mask, mask)


async def heard(stream: Stream[Touch]) -> list[tuple[int, int]]:
    stream.close()
    return [(touch.count, touch.missed) async for touch in stream]


async def test_a_gap_is_told_by_the_next_event() -> None:
    stream: Stream[Touch] = Stream(None, "touch")
    for count in (5, 6, 9, 10):
        stream.put(touch(count))
    assert await heard(stream) == [(5, 0), (6, 0), (9, 2), (10, 0)]


async def test_parts_are_counted_apart() -> None:
    stream: Stream[Touch] = Stream(None, "touch")
    for item in (touch(5), touch(90, part="arm"), touch(6), touch(92, part="arm")):
        stream.put(item)
    assert await heard(stream) == [(5, 0), (90, 0), (6, 0), (92, 1)]


async def test_an_event_that_comes_twice_is_heard_once() -> None:
    stream: Stream[Touch] = Stream(None, "touch")
    for count in (1, 2, 3, 1, 2, 3, 4):
        stream.put(touch(count))
    assert await heard(stream) == [(1, 0), (2, 0), (3, 0), (4, 0)]


async def test_a_node_that_starts_anew_counts_anew() -> None:
    stream: Stream[Touch] = Stream(None, "touch")
    for item in (touch(40), touch(1, t_ns=1000), touch(2, t_ns=1001)):
        stream.put(item)
    assert await heard(stream) == [(40, 0), (1, 0), (2, 0)]


async def test_a_node_that_starts_anew_with_an_earlier_clock_is_heard() -> None:
    stream: Stream[Touch] = Stream(None, "touch")
    for item in (touch(4000), touch(1, t_ns=1), touch(2, t_ns=2)):
        stream.put(item)
    assert await heard(stream) == [(4000, 0), (1, 0), (2, 0)]


async def test_a_node_that_starts_anew_early_with_an_earlier_clock_is_heard() -> None:
    """Its events are others than those of the same numbers before."""
    stream: Stream[Touch] = Stream(None, "touch")
    before = [touch(count, t_ns=1000 + count) for count in (1, 2, 3)]
    after = [touch(count, t_ns=10 + count) for count in (1, 2, 3, 4, 6)]
    for item in before + after[:2] + after:
        stream.put(item)
    assert await heard(stream) == [(1, 0), (2, 0), (3, 0), (1, 0), (2, 0), (3, 0), (4, 0), (6, 1)]


async def test_what_a_slow_reader_loses_is_told() -> None:
    stream: Stream[Touch] = Stream(None, "touch")
    held = HELD["touch"]
    stream.put(touch(1))
    assert (await anext(stream)).missed == 0
    for count in range(2, held + 12):
        stream.put(touch(count))
    first = await anext(stream)
    assert (first.count, first.missed) == (12, 10)


@pytest.mark.parametrize("kind", ["touch", "frame"])
async def test_what_is_lost_before_the_first_read_is_told(kind: Any) -> None:
    """Nothing is lost without being counted, whenever the reader begins to read."""
    stream: Stream[Any] = Stream(None, kind)
    make: Any = touch if kind == "touch" else frame
    n = HELD[kind] + 744
    for number in range(1, n + 1):
        stream.put(make(number), 7)
    stream.close()
    items = [item async for item in stream]
    assert len(items) == HELD[kind]
    assert items[0].missed == 744
    assert sum(item.missed for item in items) + len(items) == n


async def test_each_part_is_told_what_was_lost_of_it() -> None:
    stream: Stream[Touch] = Stream(None, "touch")
    stream._most = 3
    for item in (touch(1), touch(4), touch(1, part="arm"), touch(5), touch(2, part="arm")):
        stream.put(item)
    stream.close()
    seen = [(one.part, one.count, one.missed) async for one in stream]
    assert seen == [("arm", 1, 0), ("palm", 5, 4), ("arm", 2, 0)]


@pytest.mark.parametrize(
    ("before", "after", "missed"),
    [(30, 10, 9), (5, 200, 199), (5, 6, 5), (5, 1, 0), (5, 5, 4)],
)
@pytest.mark.parametrize("step_ns", [10**9, -(10**9)])
async def test_what_is_lost_at_the_start_of_a_run_is_told(
    before: int, after: int, missed: int, step_ns: int
) -> None:
    """Each run counts from 1, whatever the clock of its node shows."""
    stream: Stream[Touch] = Stream(None, "touch")
    stream.put(touch(before, 10**10), 7)
    stream.put(touch(after, 10**10 + step_ns), 8)
    stream.put(touch(after + 2, 10**10 + step_ns + 1), 8)
    assert await heard(stream) == [(before, 0), (after, missed), (after + 2, 1)]


async def test_without_the_number_of_its_run_a_smaller_number_shows_a_restart() -> None:
    stream: Stream[Touch] = Stream(None, "touch")
    for count in (30, 10):
        stream.put(touch(count, t_ns=1000 - count))
    assert await heard(stream) == [(30, 0), (10, 9)]


async def test_frames_of_a_run_are_counted_from_0() -> None:
    stream: Stream[Frame] = Stream(None, "frame")
    stream.put(frame(70), 7)
    stream.put(frame(3, 99), 8)
    stream.close()
    assert [item.missed async for item in stream] == [0, 3]


@given(
    st.lists(st.tuples(st.booleans(), st.integers(0, 5), st.booleans()), min_size=1, max_size=60)
)
def test_what_is_read_and_missed_is_all_that_was_sent(
    steps: list[tuple[bool, int, bool]],
) -> None:
    """From the first event that came on, over restarts, whenever it is read."""
    stream: Stream[Touch] = Stream(None, "touch")
    stream._most = 4
    run, count, t_ns, sent, read = 1, 0, 0, 0, 0
    for restarts, lost, reads in steps:
        if restarts:
            run, count = run + 1, 0
        count, t_ns = count + lost + 1, t_ns + 1
        stream.put(touch(count, t_ns), run)
        sent += 1 + (lost if sent else 0)
        if reads:
            while stream._items:
                read += 1 + stream._take_out().missed
            assert read == sent
    while stream._items:
        read += 1 + stream._take_out().missed
    assert read == sent


async def test_sweeps_between_two_frames_are_told() -> None:
    stream: Stream[Frame] = Stream(None, "frame")
    for seq in (7, 8, 7, 8, 12):  # each of two brokers sends them
        stream.put(frame(seq))
    stream.close()
    assert [(item.seq, item.missed) async for item in stream] == [(7, 0), (8, 0), (12, 3)]


async def test_two_streams_of_one_event_do_not_disturb_each_other() -> None:
    early: Stream[Touch] = Stream(None, "touch")
    late: Stream[Touch] = Stream(None, "touch")
    early.put(touch(1))
    shared = touch(5)
    early.put(shared)
    late.put(shared)
    assert await heard(early) == [(1, 0), (5, 3)]
    assert await heard(late) == [(5, 0)]


async def test_events_that_are_not_counted_are_all_heard() -> None:
    stream: Stream[Touch] = Stream(None, "touch")
    uncounted = replace(touch(1), count=0)
    stream.put(uncounted)
    stream.put(uncounted)
    assert await heard(stream) == [(0, 0), (0, 0)]


async def test_a_slow_reader_gets_the_newest_state_of_each_part() -> None:
    """However often that of another part changes meanwhile."""
    stream: Stream[Health] = Stream(None, "health")
    n = 2 * HELD["health"]
    last = {}
    for part, number in [("palm", 0), ("palm", 1), *(("foot", n) for n in range(n))]:
        last[part] = Health(part, {"rate_hz": float(number)})
        stream.put(last[part])
    assert len(stream._items) == HELD["health"]
    stream.close()
    items = [item async for item in stream]
    assert {item.part: item for item in items} == last
    assert [item.part for item in items].index("palm") == 0  # in the order in which they came


STATES = [
    *(Contact(part, state) for part in ("palm", "foot") for state in ("OFF", "ON")),
    *(Contact("palm", "UNKNOWN", why) for why in ("stale", "not_felt")),
]


@given(st.lists(st.one_of(st.none(), st.sampled_from(STATES)), max_size=40))
def test_a_slow_reader_never_takes_a_part_for_untouched_that_is_not_any_more(
    steps: list[Contact | None],
) -> None:
    """It reads now and then (None), and learns of all that was touched, or not known."""
    stream: Stream[Contact] = Stream(None, "contact")
    now: dict[str, Contact] = {}
    read: list[Contact] = []

    async def read_one() -> None:
        seen = await anext(stream)
        assert seen.touched or seen == now[seen.part]
        read.append(seen)

    async def read_slowly() -> None:
        for state in steps:
            if state is not None:
                now[state.part] = state
                stream.put(state)
            elif stream._items:
                await read_one()
        while stream._items:
            await read_one()

    def touched(part: str, states: list[Contact]) -> list[Contact]:
        mine = [one for one in states if one.part == part and one.touched]
        return [one for one, _ in groupby(mine)]

    asyncio.run(read_slowly())
    assert {one.part: one for one in read} == now
    for part in now:
        assert touched(part, read) == touched(part, [one for one in steps if one])


@given(st.lists(st.sampled_from("abcdef"), max_size=60))
def test_the_newest_state_of_each_part_is_held_while_there_is_room(parts: list[str]) -> None:
    async def put() -> None:
        stream: Stream[Health] = Stream(None, "health")
        stream._most = 6
        last = {}
        for number, part in enumerate(parts):
            last[part] = Health(part, {"rate_hz": float(number)})
            stream.put(last[part])
            assert len(stream._items) <= 6
        assert {item.part: item for item in stream._items} == last

    asyncio.run(put())


async def test_descriptions_of_ever_other_parts_do_not_add_up() -> None:
    stream: Stream[Described] = Stream(None, "info")
    for number in range(2 * HELD["info"]):
        stream.put(Described(f"part{number}", "", None))
    assert len(stream._items) == HELD["info"]
    assert (await anext(stream)).part == f"part{HELD['info']}"


async def test_states_pass_as_they_are() -> None:
    stream: Stream[Contact] = Stream("palm", "contact")
    stream.put(Contact("palm", "ON"))
    stream.close()
    assert [contact async for contact in stream] == [Contact("palm", "ON")]


async def test_kinds_of_events_have_numbers_of_their_own_and_stay_in_order() -> None:
    stream: Stream[Touch | Over] = Stream("palm", "touch", "over")
    over = Over(event="begin", id=1, t_ns=1, count=1, part="palm", force_n=10.0)
    for item in (touch(7), over, touch(8), replace(over, t_ns=2, count=4), touch(8)):
        stream.put(item)
    stream.close()
    seen = [(type(event).__name__, event.count, event.missed) async for event in stream]
    assert seen == [("Touch", 7, 0), ("Over", 1, 0), ("Touch", 8, 0), ("Over", 4, 2)]


def test_a_slow_reader_of_frames_never_gets_old_ones() -> None:
    """At 20 frames a second, of which it reads five."""
    clock = SteppedClock()

    async def read() -> None:
        stream: Stream[Frame] = Stream(None, "frame")
        seen = 0
        for seq in range(1, 401):
            stream.put(frame(seq), 7)
            await clock.sleep(0.05)
            if seq % 4 == 0:
                read = await anext(stream)
                assert (seq - read.seq) * 0.05 <= LATE_S
                seen += 1 + read.missed
                assert seen == read.seq  # what was left out is counted

    with clock.runner() as runner:
        runner.run(read())


def test_who_returns_to_frames_reads_the_newest_of_each_part_that_is_received() -> None:
    clock = SteppedClock()

    async def read() -> list[tuple[str, int, int]]:
        stream: Stream[Frame] = Stream(None, "frame")
        for seq in range(1, 11):
            stream.put(frame(seq), 7)
            stream.put(frame(seq, part="foot"), 7)
        stream.put(frame(1, part="gone"), 7)
        await clock.sleep(60.0)
        for seq in range(11, 14):
            stream.put(frame(seq), 7)
            stream.put(frame(seq, part="foot"), 7)
        stream.close()
        return [(one.part, one.seq, one.missed) async for one in stream]

    with clock.runner() as runner:
        assert runner.run(read()) == [("palm", 13, 12), ("foot", 13, 12)]


def test_who_is_late_reads_the_newest_health_of_each_part_however_old_it_is() -> None:
    clock = SteppedClock()

    async def read() -> list[Health]:
        stream: Stream[Health] = Stream(None, "health")
        for number in range(10):
            for part in ("palm", "foot"):
                stream.put(Health(part, {"rate_hz": float(number)}))
            await clock.sleep(1.0)
        await clock.sleep(60.0)
        first = await anext(stream)
        stream.put(Health("palm", {"state": "ok"}))
        stream.close()
        return [first, *[one async for one in stream]]

    with clock.runner() as runner:
        assert runner.run(read()) == [
            Health("palm", {"rate_hz": 9.0}),
            Health("foot", {"rate_hz": 9.0}),
            Health("palm", {"state": "ok"}),
        ]


async def test_frames_of_very_many_taxels_are_held_only_so_far_and_counted() -> None:
    stream: Stream[Frame] = Stream(None, "frame")
    for seq in range(1, 101):
        stream.put(frame(seq, taxels=100_000), 7)
    assert sum(len(item.valid) for item in stream._items) == HELD_TAXELS
    assert (await anext(stream)).missed == 100 - HELD_TAXELS // 100_000


async def test_touches_of_very_many_taxels_are_held_only_so_far_and_counted() -> None:
    """Whoever may publish could fill the memory of a slow reader."""
    stream: Stream[Touch] = Stream(None, "touch")
    large = list(range(100_000))
    for count in range(1, 201):
        stream.put(replace(touch(count), taxels=large))
    assert sum(len(item.taxels) for item in stream._items) == HELD_TAXELS
    told = await heard(stream)
    assert len(told) == HELD_TAXELS // len(large)
    assert told[-1] == (200, 0)
    assert stream._taxels == 0
