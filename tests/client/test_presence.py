"""What a client knows of contacts fails safe: whatever is not known now is UNKNOWN."""

import asyncio
import threading
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skin_host.client import Contact, SkinCallbacks, session
from skin_host.client.heard import is_online
from skin_host.client.order import Newest
from skin_host.client.presence import DISTANCE_S, MAX_TOUCHES, Lateness, Presence
from skin_host.client.session import LEAST_STALE_S, NAMED_S
from skin_host.config.settings import load
from skin_host.errors import RequestError
from skin_host.layout import build_layout
from skin_host.mqtt.info import node_info
from skin_host.mqtt.order import Stamp
from skin_host.mqtt.publisher import Publisher
from skin_host.mqtt.topics import OFFLINE, ONLINE
from skin_host.processing.events import Touch
from tests.client.test_client import frame, hearing, publishing, take, touch
from tests.support.broker import Mosquitto
from tests.support.waiting import PATIENCE_S, until

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"


def seen(event: Any, number: int = 1) -> Touch:
    return Touch(
        event=event,
        id=number,
        seq=1,
        t_ns=1,
        part="palm",
        taxels=[1],
        centroid_m=None,
        normal=None,
        area_mm2=1.0,
        peak_kpa=1.0,
        mean_kpa=1.0,
        force_n=1.0,
    )


def test_unknown_counts_as_touched() -> None:
    assert [Contact("a", state).touched for state in ("ON", "OFF", "UNKNOWN")] == [
        True,
        False,
        True,
    ]
    assert not Contact("a", "UNKNOWN", "stale").known


def test_a_part_of_which_nothing_comes_is_stale() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 0.0)
    assert presence.changes(0.0) == [Contact("palm", "OFF")]
    presence.take_sign("palm", 2.0)
    assert presence.changes(4.9) == []
    assert presence.changes(5.1) == [Contact("palm", "UNKNOWN", "stale")]
    presence.take_sign("palm", 6.0)
    assert presence.changes(6.0) == [Contact("palm", "OFF")]


def test_a_part_of_which_all_comes_late_is_stale() -> None:
    presence = Presence(stale_s=3.0)
    ahead_s = 1e6  # the node's clock is another
    presence.take_state("palm", "OFF", 0.0, sent_s=ahead_s)
    presence.take_sign("palm", 1.0, ahead_s + 0.9)
    assert presence.changes(1.0) == [Contact("palm", "OFF")]
    # The broker was held up, and delivers what it has, with the times of then.
    presence.take_sign("palm", 10.0, ahead_s + 1.9)
    assert presence.changes(10.0) == [Contact("palm", "UNKNOWN", "stale")]
    presence.take_state("palm", "ON", 10.1, sent_s=ahead_s + 2.9)
    assert presence.changes(10.1) == []
    # It has caught up.
    presence.take_sign("palm", 11.0, ahead_s + 10.5)
    assert presence.changes(11.0) == [Contact("palm", "ON")]


def test_a_part_whose_messages_come_about_too_late_does_not_flap() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 0.0, sent_s=0.0)
    shown = presence.changes(0.0)
    for second in range(10, 60):
        presence.take_sign("palm", float(second), second - (3.2 if second % 2 else 2.8))
        shown += presence.changes(float(second))
    assert shown == [Contact("palm", "OFF"), Contact("palm", "UNKNOWN", "stale")]
    presence.take_sign("palm", 60.0, 58.6)
    assert presence.changes(60.0) == [Contact("palm", "OFF")]


def test_a_part_is_known_while_all_comes_a_little_late() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 0.0, sent_s=0.0)
    for second in range(1, 60):
        presence.take_sign("palm", float(second), second - 2.0)
        assert presence.contact("palm", float(second)) == Contact("palm", "OFF")


def test_a_late_sign_of_life_takes_nothing_from_an_earlier_one() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 0.0, sent_s=0.0)
    presence.take_sign("palm", 9.0, 9.0)
    presence.take_sign("palm", 9.5, 5.0)  # from another broker, which is slow
    assert presence.contact("palm", 9.6) == Contact("palm", "OFF")


def test_a_late_sign_shows_that_a_part_lived_when_it_was_sent() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 0.0, sent_s=0.0)
    presence.take_sign("palm", 2.0, 1.0)
    assert presence.contact("palm", 3.9) == Contact("palm", "OFF")
    assert presence.contact("palm", 4.1) == Contact("palm", "UNKNOWN", "stale")


def test_a_clock_that_was_set_back_looks_late_for_a_limited_time() -> None:
    lateness = Lateness()
    assert lateness.of(100.0, 0.0) == 0.0
    late_s = [lateness.of(at_s - 900.0, float(at_s)) for at_s in range(1, 400)]
    assert late_s[0] == 1000.0
    assert late_s[int(2 * DISTANCE_S) + 2 :] == [0.0] * (399 - int(2 * DISTANCE_S) - 2)


@pytest.mark.parametrize("step_s", [-600.0, -5.0, 5.0, 600.0])
def test_a_clock_that_was_set_shows_with_the_next_connection_and_makes_nothing_stale(
    step_s: float,
) -> None:
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 0.0, sent_s=1e6, connection=1)
    shown = presence.changes(0.0)
    for second in range(1, 10):
        presence.take_sign("palm", float(second), 1e6 + second, 1)
    for second in range(10, 300):
        presence.take_sign("palm", float(second), 1e6 + second + step_s, 2)
        shown += presence.changes(float(second))
    assert shown == [Contact("palm", "OFF")]
    # Within a connection stamps follow no clock that is set: what is late is late.
    presence.take_sign("palm", 306.0, 1e6 + 300 + step_s, 2)
    assert presence.contact("palm", 306.1) == Contact("palm", "UNKNOWN", "stale")


def test_a_next_connection_whose_messages_come_as_late_as_those_before_is_late() -> None:
    """The node has turned to a broker again that is held up all the time."""
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 0.0, sent_s=0.0, connection=1)
    for second in range(1, 100):
        connection = 1 if second < 50 else 2
        late_s = 6.0 if second > 10 else 0.0
        presence.take_sign("palm", float(second), second - late_s, connection)
    assert presence.contact("palm", 99.0) == Contact("palm", "UNKNOWN", "stale")
    presence.take_sign("palm", 100.0, 100.0, 2)  # it has caught up
    assert presence.contact("palm", 100.0) == Contact("palm", "OFF")


@given(
    st.lists(st.tuples(st.floats(0.0, 5.0), st.floats(0.0, 20.0)), min_size=1, max_size=50),
    st.floats(-1e9, 1e9),
)
def test_no_message_looks_later_than_it_is(
    steps: list[tuple[float, float]], ahead_s: float
) -> None:
    lateness = Lateness()
    sent_s = 0.0
    for step_s, late_s in steps:
        sent_s += step_s
        found_s = lateness.of(sent_s + ahead_s, sent_s + late_s)
        assert 0.0 <= found_s <= late_s + 1e-6


def test_a_node_that_stops_takes_its_parts_with_it() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_info("arm", ["palm"], 0.0)
    presence.take_node("arm", True, 0.0)
    presence.take_state("palm", "OFF", 0.0)
    presence.take_state("foot", "OFF", 0.0)
    presence.changes(0.0)
    presence.take_node("arm", False, 0.0)
    assert presence.changes(0.1) == [Contact("palm", "UNKNOWN", "offline")]


def test_a_last_will_says_nothing_of_a_node_that_may_be_at_another_broker() -> None:
    # The will of its old connection comes first; what it says over the new one comes 26 s late.
    newest, presence = Newest(), Presence(stale_s=3.0)
    presence.take_info("main", ["palm"], 0.0)

    def take(payload: bytes, stamp: Stamp, broker: int) -> None:
        newness = newest.take("status", "main", stamp)
        if newness is not False:
            said = is_online(payload, stamp, is_only_broker=False)
            presence.take_node("main", said, 26.0, broker, again=newness is None)

    take(ONLINE, Stamp(100, 0), 0)
    presence.take_state("palm", "OFF", 0.0)
    assert presence.online("main", 0.0)
    assert presence.changes(0.0) == [Contact("palm", "OFF")]
    take(OFFLINE, Stamp(100, 1), 0)
    assert presence.online("main", 26.0) is None
    assert presence.changes(0.1) == [Contact("palm", "UNKNOWN", "disconnected")]
    take(ONLINE, Stamp(200, 0), 1)
    presence.take_state("palm", "ON", 26.0, 1)
    assert presence.online("main", 26.0)
    assert presence.changes(26.0) == [Contact("palm", "ON")]
    take(OFFLINE, Stamp(100, 1), 2)  # the same will by a broker that was frozen
    assert presence.online("main", 26.1)
    take(OFFLINE, Stamp(200, 77), 1)  # its own word
    assert presence.online("main", 26.2) is False
    take(OFFLINE, Stamp(200, 1), 2)  # adds nothing to that
    assert presence.online("main", 26.3) is False


def test_with_one_broker_the_last_will_is_believed() -> None:
    assert is_online(OFFLINE, Stamp(100, 1), is_only_broker=True) is False
    assert is_online(OFFLINE, None, is_only_broker=True) is False
    assert is_online(b"", None, is_only_broker=True) is None


def test_a_node_whose_parts_all_fall_silent_or_come_late_is_not_said_to_be_online() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_info("main", ["palm", "foot"], 0.0)
    presence.take_node("main", True, 0.0)
    presence.take_touch(seen("begin"), 0.0)
    assert presence.online("main", 60.0)  # who does not follow states cannot tell
    presence.take_state("palm", "OFF", 60.0, sent_s=60.0)
    presence.take_state("foot", "OFF", 60.0, sent_s=60.0)
    assert presence.online("main", 62.9)
    assert presence.online("main", 63.1) is None
    presence.take_sign("foot", 64.0, 64.0)  # one part is enough
    assert presence.online("main", 64.0)
    for second in range(70, 90):  # the broker is held up: what comes now was true 6 s ago
        presence.take_sign("foot", float(second), second - 6.0)
        presence.take_sign("palm", float(second), second - 6.0)
        assert presence.online("main", float(second)) is None
    presence.take_sign("palm", 90.0, 89.5)
    assert presence.online("main", 90.0)


def test_a_node_is_unknown_when_no_broker_is_left_that_named_its_status() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_node("main", True, 0.0, 0)
    presence.take_node("main", True, 0.0, 1, again=True)
    presence.take_loss(0)
    assert presence.online("main", 0.0)
    assert presence.brokers("main") == {1}
    presence.take_loss(1)
    assert presence.online("main", 0.0) is None
    presence.take_node("main", True, 0.0, 0, again=True)
    assert presence.online("main", 0.0)
    assert presence.online("arm", 0.0) is None


def test_after_a_lost_broker_the_state_before_is_history() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 0.0)
    presence.changes(0.0)
    presence.take_loss()
    assert presence.changes(1.0) == [Contact("palm", "UNKNOWN", "disconnected")]
    assert presence.changes(2.0) == []
    presence.take_state("palm", "ON", 2.1)
    assert presence.changes(2.1) == [Contact("palm", "ON")]


def test_contacts_are_present_from_begin_to_end() -> None:
    presence = Presence(stale_s=3.0)
    for event, number in (("begin", 1), ("begin", 2), ("move", 1), ("end", 2)):
        presence.take_touch(seen(event, number), 0.0)
    assert [(one.event, one.id) for one in presence.touches(None, 0.0)] == [("move", 1)]
    assert presence.touches("foot", 0.0) == []


def test_a_contact_whose_end_was_lost_goes_while_its_part_is_received() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_touch(seen("begin", 1), 0.0)
    assert presence.touches("palm", 10.0)  # nothing came at all: nothing is known of its end
    presence.take_sign("palm", 10.0)
    assert presence.touches("palm", 10.0) == []
    presence.take_touch(seen("begin", 2), 11.0)
    presence.take_state("palm", "OFF", 11.0)
    assert presence.touches("palm", 11.0) == []


def test_of_too_many_contacts_the_oldest_are_forgotten() -> None:
    presence = Presence(stale_s=3.0)
    for number in range(MAX_TOUCHES + 2):
        presence.take_touch(seen("begin", number), 0.0)
    assert [one.id for one in presence.touches("palm", 0.0)] == list(range(2, MAX_TOUCHES + 2))


def test_a_contact_that_moves_is_present_until_it_has_not_moved_for_too_long() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_touch(seen("begin"), 0.0)
    presence.take_touch(seen("move"), 2.0)
    presence.take_sign("palm", 5.0)
    assert presence.touches("palm", 5.0)
    presence.take_sign("palm", 5.1)
    assert presence.touches("palm", 5.0)  # what is not yet past does not count
    assert presence.touches("palm", 5.1) == []
    assert presence.touches("palm", 5.0) == []


def test_touches_alone_tell_no_contact_state() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_sign("palm", 0.0)
    presence.take_touch(seen("begin"), 0.0)
    assert presence.contact("palm", 0.0) is None
    assert presence.contact("foot", 0.0) is None
    assert presence.changes(0.0) == []
    assert presence.reported() == []


def test_a_part_that_is_not_felt_is_unknown_though_its_node_lives() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "UNKNOWN", 0.0)
    assert presence.contact("palm", 3.0) == Contact("palm", "UNKNOWN", "not_felt")
    # Who has not heard of it for too long cannot tell even that.
    assert presence.contact("palm", 3.1) == Contact("palm", "UNKNOWN", "stale")


def test_a_part_that_is_not_followed_any_more_is_forgotten() -> None:
    presence = Presence(stale_s=3.0)
    for part in ("palm", "foot"):
        presence.take_state(part, "OFF", 0.0)
    assert presence.changes(0.0) == presence.reported()
    presence.forget_state("palm")
    assert presence.contact("palm", 1.0) is None
    assert [one.part for one in presence.reported()] == ["foot"]


def test_a_state_that_is_deleted_is_unknown_and_so_is_each_loss_after_it() -> None:
    """Whoever clears retained messages must not make a motor move for ever."""
    presence = Presence(stale_s=3.0)
    presence.take_info("arm", ["palm"], 0.0)
    presence.take_node("arm", True, 0.0)
    presence.take_state("foot", None, 0.0)
    presence.take_state("palm", "OFF", 0.0)
    assert presence.changes(0.0) == [Contact("palm", "OFF")]
    presence.take_state("palm", None, 1.0)
    assert presence.changes(1.0) == [Contact("palm", "UNKNOWN", "stale")]
    presence.take_sign("palm", 2.0)
    assert presence.changes(2.0) == []
    presence.take_node("arm", False, 3.0)
    assert presence.changes(3.0) == [Contact("palm", "UNKNOWN", "offline")]
    presence.take_loss()
    assert presence.changes(4.0) == [Contact("palm", "UNKNOWN", "disconnected")]
    presence.take_node("arm", True, 5.0)
    presence.take_state("palm", "ON", 5.0)
    assert presence.changes(5.0) == [Contact("palm", "ON")]


def test_of_a_part_that_is_followed_by_one_topic_less_the_rest_stays() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_touch(seen("begin", 7), 0.0)
    presence.take_state("palm", "ON", 0.1)
    assert presence.changes(0.1) == [Contact("palm", "ON")]
    presence.forget_state("palm")
    assert presence.reported() == []
    assert [one.id for one in presence.touches("palm", 0.2)] == [7]
    presence.take_state("palm", "ON", 0.3)
    presence.forget_touches("palm")
    assert presence.touches("palm", 0.3) == []
    assert presence.contact("palm", 0.3) == Contact("palm", "ON")
    presence.forget_state("palm")
    presence.forget_touches("foot")
    presence.forget_state("foot")
    assert presence._parts == {}


def test_a_touch_that_comes_before_its_state_stays_though_its_part_was_untouched() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 0.0)
    presence.take_touch(seen("begin", 7), 0.1)
    presence.take_sign("palm", 0.2)
    assert [one.id for one in presence.touches("palm", 0.2)] == [7]


@pytest.mark.parametrize("what", ["touch", "frame"])
def test_a_touch_that_comes_first_after_a_silence_is_not_taken_for_the_untouched_state_before_it(
    what: str,
) -> None:
    """A node sends touches and frames before the states that change with them."""
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 0.0)
    assert presence.changes(0.0) == [Contact("palm", "OFF")]
    assert presence.changes(4.0) == [Contact("palm", "UNKNOWN", "stale")]
    if what == "touch":
        presence.take_touch(seen("begin"), 4.1)
    else:
        presence.take_data("palm", 4.1)
    assert presence.changes(4.1) == []
    presence.take_state("palm", "ON", 4.2)
    assert presence.changes(4.2) == [Contact("palm", "ON")]


def test_events_that_the_broker_kept_for_us_make_no_stored_state_true() -> None:
    """The robot may have lost its power since."""
    presence = Presence(stale_s=3.0)
    presence.take_info("arm", ["palm"], 0.0)
    presence.take_node("arm", True, 0.0)
    presence.take_state("palm", "OFF", 0.0)
    presence.changes(0.0)
    presence.take_loss()
    assert presence.changes(1.0) == [Contact("palm", "UNKNOWN", "disconnected")]
    presence.take_node("arm", True, 2.0)
    for event in ("begin", "end"):
        presence.take_touch(seen(event), 2.0)
    presence.take_state("palm", "OFF", 2.1, stored=True)
    assert presence.changes(2.1) == []
    presence.take_sign("palm", 2.9)
    assert presence.changes(2.9) == [Contact("palm", "OFF")]


def test_a_state_that_its_only_broker_does_not_let_us_receive_any_more_is_not_known() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 0.0, 0)
    presence.take_state("foot", "OFF", 0.0, 0)
    presence.take_state("foot", "OFF", 0.0, 1, again=True)
    assert len(presence.changes(0.0)) == 2
    for part in ("palm", "foot", "of which nothing is known"):
        presence.take_refusal(part, 0)
    assert presence.changes(0.1) == [Contact("palm", "UNKNOWN", "stale")]


def test_no_contact_is_present_on_a_part_that_is_not_received() -> None:
    def known(now_s: float) -> list[int]:
        return [one.id for one in presence.touches(None, now_s)]

    for follows_states in (True, False):
        presence = Presence(stale_s=3.0)
        presence.take_info("arm", ["palm"], 0.0)
        presence.take_node("arm", True, 0.0)
        presence.take_touch(seen("begin", 7), 0.0)
        if follows_states:
            presence.take_state("palm", "ON", 0.0)
        assert known(0.1) == [7]
        presence.take_node("arm", None, 0.2)  # it may have another connection
        assert known(0.2) == []
        presence.take_node("arm", True, 0.3)
        assert known(0.4) == []  # it may have been started again
        presence.take_touch(seen("move", 7), 0.5)
        if follows_states:
            assert known(3.4) == [7]
            assert known(3.6) == []  # silent
            presence.take_touch(seen("move", 7), 4.0)
        presence.take_loss()
        assert known(4.0) == []
        presence.take_node("arm", False, 4.1)
        presence.take_touch(seen("move", 7), 4.1)
        assert known(4.1) == []


def test_no_contact_is_present_of_a_part_whose_broker_is_lost_and_whose_node_is_not_known() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_touch(seen("begin", 7), 0.0)
    presence.take_loss()
    assert presence.touches(None, 0.1) == []
    presence.take_touch(seen("move", 7), 0.2)
    assert [one.id for one in presence.touches(None, 0.2)] == [7]


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("state"), st.sampled_from(["ON", "OFF", "UNKNOWN", None]), st.booleans()),
        st.tuples(st.just("node"), st.sampled_from([True, False, None]), st.none()),
        st.tuples(st.sampled_from(["sign", "touch", "loss"]), st.none(), st.none()),
        st.tuples(st.just("pass"), st.sampled_from([0.5, 1.0, 3.5]), st.none()),
    ),
    max_size=30,
)


@given(STEPS)
def test_once_a_state_was_reported_no_loss_is_kept_quiet(steps: list[tuple[str, Any, Any]]) -> None:
    """Whatever was received, deleted and lost before: the last report is never out of date."""
    presence, now_s = Presence(stale_s=3.0), 0.0
    presence.take_info("arm", ["palm"], 0.0)
    presence.take_node("arm", True, now_s)
    last: Contact | None = None
    live_s = -10.0  # when something came that was not stored, over this connection and node
    state: str | None = None
    online: bool | None = True
    for what, value, stored in [*steps, ("loss", None, None)]:
        match what:
            case "state":
                presence.take_state("palm", value, now_s, stored=stored)
                state = value
                live_s = live_s if stored or value is None else now_s
            case "node":
                presence.take_node("arm", value, now_s)
                live_s = -10.0 if value and not online else live_s
                online = value
            case "sign":
                presence.take_sign("palm", now_s)
                live_s = now_s
            case "touch":
                presence.take_touch(seen("begin"), now_s)
                is_old = state == "OFF" or (state is None and last is not None)
                live_s = live_s if is_old and now_s - live_s > 3.0 else now_s
            case "loss":
                presence.take_loss()
                state, live_s, online = None, -10.0, None
            case "pass":
                now_s += value
        for contact in presence.changes(now_s):
            assert contact != last
            last = contact
        is_known = state in ("ON", "OFF") and online is True and now_s - live_s <= 3.0
        if is_known and last is not None:
            assert last == Contact("palm", state)  # type: ignore[arg-type]
        elif last is not None:
            assert last.state == "UNKNOWN"
            assert presence.reported() == [last]


def test_what_the_broker_kept_is_not_known_until_something_comes() -> None:
    """After a power cut the broker has what was true before, and no node that could correct it."""
    presence = Presence(stale_s=3.0)
    presence.take_info("arm", ["palm", "foot"], 0.0)
    presence.take_node("arm", True, 0.0)
    for part in ("palm", "foot"):
        presence.take_state(part, "OFF", 0.0, stored=True)
    assert presence.changes(0.0) == []
    assert presence.online("arm", 0.0) is None
    presence.take_sign("palm", 0.9)
    assert presence.changes(0.9) == [Contact("palm", "OFF")]
    assert presence.online("arm", 0.9)
    assert presence.changes(3.1) == [Contact("foot", "UNKNOWN", "stale")]


def test_a_node_that_is_online_again_publishes_its_states_again() -> None:
    """Between its status and those, what it published before it was restarted is not known."""
    presence = Presence(stale_s=3.0)
    presence.take_info("arm", ["palm"], 0.0)
    presence.take_node("arm", True, 0.0)
    presence.take_state("palm", "OFF", 0.0)
    assert presence.changes(0.0) == [Contact("palm", "OFF")]
    presence.take_node("arm", False, 1.0)
    assert presence.changes(1.0) == [Contact("palm", "UNKNOWN", "offline")]
    presence.take_node("arm", True, 2.0)
    assert presence.changes(2.0) == []
    presence.take_state("palm", "ON", 2.1)
    assert presence.changes(2.1) == [Contact("palm", "ON")]


def test_after_a_lost_broker_what_it_kept_is_not_known_either() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 0.0)
    assert presence.changes(0.0) == [Contact("palm", "OFF")]
    presence.take_loss()
    presence.take_state("palm", "OFF", 1.0, stored=True)
    assert presence.changes(1.0) == [Contact("palm", "UNKNOWN", "stale")]
    presence.take_sign("palm", 1.5)
    assert presence.changes(1.5) == [Contact("palm", "OFF")]
    presence.take_loss()
    assert presence.changes(2.0) == [Contact("palm", "UNKNOWN", "disconnected")]
    presence.take_state("palm", "OFF", 2.5, stored=True)
    assert presence.changes(2.5) == []
    assert presence.changes(6.0) == [Contact("palm", "UNKNOWN", "stale")]


def test_touches_of_the_run_before_have_ended_with_it() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_touch(seen("begin", 3), 0.0, run=1)
    presence.take_touch(seen("begin", 1), 0.5, run=2)
    presence.take_touch(seen("begin", 2), 0.5)  # of which run is not known
    assert [one.id for one in presence.touches("palm", 0.5)] == [1, 2]


def test_a_state_is_known_while_a_broker_is_left_that_told_it() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 0.0, 0)
    presence.take_state("palm", "OFF", 0.0, 1, again=True)
    presence.take_loss(0)
    assert presence.contact("palm", 0.0) == Contact("palm", "OFF")
    # A newer one of broker 0 alone makes that of broker 1 out of date.
    presence.take_state("palm", "ON", 1.0, 0)
    presence.take_loss(1)
    assert presence.contact("palm", 1.0) == Contact("palm", "ON")
    presence.take_loss(0)
    presence.take_state("foot", "OFF", 1.0, 0)
    assert presence.contact("foot", 1.0) == Contact("foot", "OFF")
    assert presence.changes(1.0) == [Contact("foot", "OFF")]


def test_a_status_of_one_broker_replaces_that_of_another() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_node("main", True, 0.0, 0)
    presence.take_node("main", True, 0.0, 1)
    assert presence.brokers("main") == {1}
    assert presence.brokers("arm") == set()
    presence.take_loss(0)
    assert presence.online("main", 0.0)


async def announced(publisher: Publisher) -> None:
    """The node is the demo's, whose parts have a contact and send their health."""
    layout = build_layout(load(CONFIG), CONFIG.parent)
    publisher.put_info(node_info(layout, "main", version="1", configuration="x"))
    publisher.put_contact("left_hand", "OFF")
    publisher.put_health("left_hand", {})
    await until(lambda: publisher.counters.retained_sent >= 4)


async def test_a_node_that_falls_silent_is_stale_and_one_that_ends_is_offline(
    mosquitto: Mosquitto,
) -> None:
    async with hearing(mosquitto, stale_s=LEAST_STALE_S) as skin:
        contacts = skin.contacts("left_hand")
        await skin.ready()
        async with publishing(mosquitto) as publisher:
            await announced(publisher)
            assert await take(contacts, 1) == [Contact("left_hand", "OFF")]
            # It is online and says nothing more.
            assert await take(contacts, 1) == [Contact("left_hand", "UNKNOWN", "stale")]
            publisher.put_health("left_hand", {"rate_hz": 1.0})
            assert await take(contacts, 1) == [Contact("left_hand", "OFF")]
        assert await take(contacts, 1) == [Contact("left_hand", "UNKNOWN", "offline")]


async def test_what_the_broker_kept_of_a_node_that_is_offline_is_never_off(
    mosquitto: Mosquitto,
) -> None:
    async with publishing(mosquitto) as publisher:
        await announced(publisher)
    for _ in range(5):
        async with hearing(mosquitto) as skin:
            (first,) = await take(skin.contacts("left_hand"), 1)
            assert first == Contact("left_hand", "UNKNOWN", "offline")


@pytest.mark.parametrize("how", ["kill", "freeze"])
async def test_a_lost_broker_makes_everything_unknown(mosquitto: Mosquitto, how: str) -> None:
    async with (
        publishing(mosquitto) as publisher,
        hearing(mosquitto, stale_s=LEAST_STALE_S) as skin,
    ):
        contacts = skin.contacts()
        await skin.ready()
        await announced(publisher)
        assert await take(contacts, 1) == [Contact("left_hand", "OFF")]
        mosquitto.kill() if how == "kill" else mosquitto.freeze()
        (lost,) = await take(contacts, 1)
        assert lost == Contact("left_hand", "UNKNOWN", "disconnected" if how == "kill" else "stale")
        if how == "freeze":
            mosquitto.resume()


async def test_present_contacts_are_listed(mosquitto: Mosquitto) -> None:
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        contacts = skin.contacts()
        await skin.ready()
        publisher.put_touch(touch(1, event="begin"))
        await until(lambda: [one.part for one in skin.present()] == ["palm"])
        publisher.put_touch(touch(2, event="end"))
        await until(lambda: not skin.present("palm"))
        del contacts


async def test_callbacks_for_what_is_unknown(mosquitto: Mosquitto) -> None:
    unknown: list[Contact] = []

    def use() -> SkinCallbacks:
        url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
        skin = SkinCallbacks(url, robot="robot", stale_s=10 * PATIENCE_S)
        skin.__enter__()
        skin.on_unknown(unknown.append)
        skin.ready()
        return skin

    async with publishing(mosquitto) as publisher:
        await announced(publisher)
        skin = await asyncio.to_thread(use)
        publisher.put_contact("left_hand", "ON")
        publisher.put_contact("left_forearm", "UNKNOWN")
        await until(lambda: unknown == [Contact("left_forearm", "UNKNOWN", "not_felt")])
        assert await asyncio.to_thread(skin.present) == []
        await asyncio.to_thread(skin.__exit__)


def test_the_parts_are_known_when_all_nodes_have_named_theirs_and_one_is_online() -> None:
    presence = Presence(stale_s=3.0)
    assert presence.named() is None
    presence.take_node("main", online=True, now_s=0.0)
    assert presence.named() is None
    presence.take_info("main", ["palm"], 0.0)
    assert presence.named() == {"palm"}
    presence.take_node("arm", online=True, now_s=0.0, parts={"upper"})
    assert presence.named() is None  # its info may name more
    presence.take_info("arm", ["lower"], 0.0)
    assert presence.named() == {"palm", "upper", "lower"}
    # A node that has stopped may start again.
    presence.take_node("arm", online=False, now_s=0.0, parts={"upper"})
    assert presence.named() == {"palm", "upper", "lower"}
    # Without a node that is online nobody knows with what the robot will start.
    presence.take_node("main", online=False, now_s=0.0)
    assert presence.named() is None
    presence.take_node("main", online=True, now_s=0.0)
    presence.take_loss()
    assert presence.named() is None


async def test_a_part_that_no_node_has_is_an_error_that_names_those_there_are(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "NAMED_S", 1000.0)
    layout = build_layout(load(CONFIG), CONFIG.parent)
    info = node_info(layout, "main", version="1", configuration="x")
    async with hearing(mosquitto) as skin, publishing(mosquitto) as publisher:
        streams = [skin.touches("palm"), skin.frames("left_hnd"), skin.contacts("left_hand")]
        await skin.ready()
        publisher.put_touch(touch(1))
        assert (await take(streams[0], 1))[0].count == 1
        publisher.put_info(info)
        await until(lambda: skin.nodes["main"].info)
        now_s = asyncio.get_running_loop().time()
        skin._check_parts(now_s + 800.0)  # a further node may just have been started
        assert not any(stream._failure for stream in streams)
        assert skin.present("left_hnd") == []
        skin._check_parts(now_s + 1200.0)
        missing = 'robot "robot" has no part "left_hnd"; there are: left_forearm, left_hand'
        with pytest.raises(RequestError, match=missing):
            await anext(streams[1])
        # What was received exists, whatever nodes name; what they once named does not fail later.
        publisher.put_info(replace(info, parts={}))
        await until(lambda: not skin._presence.named())
        skin._check_parts(now_s + 1e6)
        assert not any(stream._failure for stream in streams)
        # It is raised once: who goes on reading gets what a node that starts much later has.
        publisher.put_frame(frame(1, "left_hnd"))
        assert (await take(streams[1], 1))[0].seq == 1


async def test_a_wrong_part_reaches_who_has_no_asyncio(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(session, "NAMED_S", 0.0)
    layout = build_layout(load(CONFIG), CONFIG.parent)
    info = node_info(layout, "main", version="1", configuration="x")
    reported = threading.Event()

    def use() -> None:
        with SkinCallbacks(f"mqtt://{mosquitto.host}:{mosquitto.port}", robot="robot") as skin:
            skin.on_touch(print, part="left_hnd")
            skin.on_touch(late.append, part="late")
            assert reported.wait(PATIENCE_S)
            with pytest.raises(RequestError, match="has no part"):
                skin.present("left_hnd")

    late: list[Touch] = []
    async with publishing(mosquitto) as publisher:
        publisher.put_info(info)
        user = asyncio.create_task(asyncio.to_thread(use))
        for part in ("left_hnd", "late"):
            await until(lambda part=part: f'has no part "{part}"' in caplog.text)  # type: ignore[misc]
        publisher.put_touch(touch(1, "late"))
        await until(lambda: late)
        reported.set()
        with pytest.raises(RequestError, match='robot "robot" has no part "left_hnd"'):
            await user


async def test_what_anybody_names_steers_no_terminal_and_is_cut(mosquitto: Mosquitto) -> None:
    presence_names = {"\x1b[2J": None} | {f"part{n:04}": None for n in range(1000)}
    async with hearing(mosquitto) as skin:
        await skin.ready()
        skin._presence.take_node("main", online=True, now_s=0.0)
        skin._presence.take_info("main", presence_names, 0.0)
        stream = skin.touches("absent")
        skin._check_parts(asyncio.get_running_loop().time() + NAMED_S + 1.0)
        with pytest.raises(RequestError) as raised:
            await anext(stream)
    assert str(raised.value).isprintable()
    assert len(str(raised.value)) < 500
    assert "(1001 in all)" in str(raised.value)
