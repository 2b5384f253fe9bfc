"""Whatever ways messages come, each is passed on once and in order, the newest state wins."""

import random

import pytest
from msgspec.structs import replace

from skin_host.client.order import MAX_HELD, MAX_TOPICS, EventOrder, Newest
from skin_host.mqtt.order import Numbers, Stamp
from skin_host.mqtt.payload import MessageError
from skin_host.processing.events import Touch
from tests.client.test_presence import seen


def event(count: int) -> Touch:
    return replace(seen("move"), count=count)


def counts(events: list[Touch]) -> list[int]:
    return [one.count for one in events]


@pytest.mark.parametrize("seed", range(20))
def test_of_several_ways_each_with_its_own_delay_comes_one_order(seed: int) -> None:
    chance = random.Random(seed)
    order = EventOrder(hold_s=1.0)
    order.take(event(1), 7, 0.0)
    # Each way brings all events in order, some twice, some late, within the holding time.
    ways = [[*range(2, 40)] for _ in range(3)]
    for way in ways:
        at = chance.randrange(20)
        way[at:at] = way[max(0, at - 5) : at]
    passed: list[int] = []
    while any(ways):
        way = chance.choice([way for way in ways if way])
        passed += counts(order.take(event(way.pop(0)), 7, 0.5))
    assert passed == list(range(2, 40))


def test_a_gap_is_waited_for_and_then_passed_over() -> None:
    order = EventOrder(hold_s=1.0)
    assert counts(order.take(event(1), 7, 0.0)) == [1]
    assert counts(order.take(event(3), 7, 0.1)) == []
    assert counts(order.expire(1.0)) == []
    assert counts(order.take(event(5), 7, 1.0)) == []
    assert counts(order.expire(1.2)) == [3]
    assert counts(order.take(event(4), 7, 1.3)) == [4, 5]
    assert counts(order.take(event(2), 7, 1.4)) == []


def test_a_single_way_waits_for_nothing() -> None:
    order = EventOrder(hold_s=0.0)
    assert counts(order.take(event(1), 7, 0.0)) == [1]
    assert counts(order.take(event(9), 7, 0.0)) == [9]


def test_a_node_that_starts_anew_begins_at_1_and_its_last_run_is_over() -> None:
    order = EventOrder(hold_s=1.0)
    assert counts(order.take(event(50), 7, 0.0)) == [50]
    assert counts(order.take(event(52), 7, 0.0)) == []
    assert counts(order.take(event(1), 8, 0.1)) == [52, 1]
    assert counts(order.take(event(51), 7, 0.2)) == []


def test_what_waits_is_bounded() -> None:
    order = EventOrder(hold_s=1e9)
    order.take(event(1), 7, 0.0)
    passed = [one for n in range(3, 3 + MAX_HELD + 1) for one in order.take(event(n), 7, 0.0)]
    assert counts(passed) == [*range(3, 3 + MAX_HELD + 1)]


def test_large_touches_that_wait_do_not_fill_the_memory() -> None:
    order = EventOrder(hold_s=1e9)
    order.take(event(1), 7, 0.0)
    large = list(range(100_000))
    passed = [
        one for n in range(3, 9) for one in order.take(replace(event(n), taxels=large), 7, 0.0)
    ]
    # Those that wait have together as many taxels as are kept of a part.
    assert counts(passed) == [3, 4, 5, 6, 7, 8]
    assert counts(order.take(event(10), 7, 0.0)) == []


def test_the_newest_state_wins_over_what_comes_late() -> None:
    newest = Newest()
    assert newest.take("contact", "palm", Stamp(5, 3))
    assert newest.take("contact", "palm", Stamp(5, 3)) is None
    assert newest.take("contact", "palm", Stamp(4, 9)) is False
    assert newest.take("contact", "palm", None) is False
    assert newest.take("contact", "arm", None)
    newest.forget("contact")
    assert newest.take("contact", "palm", Stamp(4, 9))


def test_topics_without_end_are_passed_over_and_the_known_ones_go_on() -> None:
    """Whoever may publish could number the pieces of a node's info for ever."""
    newest = Newest()
    for piece in range(MAX_TOPICS):
        assert newest.take("info", f"main/{piece}", Stamp(5, 3))
    for piece in range(MAX_TOPICS, MAX_TOPICS + 10):
        with pytest.raises(MessageError, match=f"more than {MAX_TOPICS} topics of this kind"):
            newest.take("info", f"main/{piece}", Stamp(5, 3))
    assert newest.take("info", "main/1", Stamp(5, 4))
    assert newest.take("contact", "palm", Stamp(5, 4))
    newest.forget("info", "main/7")
    assert newest.take("info", f"main/{MAX_TOPICS}", Stamp(5, 3))


def test_numbers_rise_while_the_clock_is_set_back() -> None:
    times = iter([100, 50, 51, 200])
    numbers = Numbers(lambda: next(times), lambda: 0)
    given = [numbers.run]
    for _ in range(3):
        numbers.connect()
        given.append(numbers.connection)
        assert numbers.online < numbers.last_will < numbers.state() < numbers.state()
    assert given == [100, 101, 102, 200]


def test_the_number_of_a_state_tells_when_it_was_published() -> None:
    passed_ns = 7
    numbers = Numbers(lambda: 10**18, lambda: passed_ns)
    numbers.connect()
    passed_ns += 5 * 10**9
    first = numbers.state()
    passed_ns += 10**9
    later = numbers.state()
    assert later > first
    assert first.sent_s == pytest.approx(numbers.connection * 1e-9 + 5.0)
    assert later.sent_s - first.sent_s == pytest.approx(1.0)
    assert numbers.state() > later


def test_a_run_overtakes_one_that_had_a_clock_ahead() -> None:
    numbers = Numbers(lambda: 5, lambda: 0)
    assert not numbers.overtake(Stamp(5, 1))
    assert numbers.overtake(Stamp(1000, 1))
    assert numbers.run > 1000
    numbers.connect()
    assert numbers.online > Stamp(1000, 10**6)
