"""Slips and pressing too hard: payloads, and touches of fingertips without skin."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.fingertip.events import Over, Slip
from skin_host.mqtt import messages
from skin_host.mqtt.outbox import Outbox
from skin_host.mqtt.payload import MessageError
from skin_host.processing.events import Load
from tests.support.said import touch_event

SLIP = Slip(
    event="begin",
    id=4,
    t_ns=10,
    part="index",
    cause="rate",
    force_n=2.01,
    shear_n=1.14,
    shear_rate_n_s=7.5,
)
OVER = Over(event="end", id=4, t_ns=12, part="index", force_n=9.5)
LOAD = Load("contact", (0.1, 0.0, -2.0), (0.001, 0.0, 0.0), (0.1, 0.0, 0.0), ["touch"])


def test_what_was_said_is_what_is_heard() -> None:
    slip = messages.decode_slip(messages.encode_event(SLIP, 3))
    assert (slip.event, slip.id, slip.count, slip.part, slip.cause) == (
        "begin",
        4,
        3,
        "index",
        "rate",
    )
    assert (slip.force_n, slip.shear_n, slip.shear_rate_n_s) == (2.01, 1.14, 7.5)
    over = messages.decode_over(messages.encode_event(OVER, 1))
    assert (over.event, over.id, over.t_ns, over.force_n) == ("end", 4, 12, 9.5)


@given(st.binary(max_size=200))
def test_no_payload_of_a_stranger_raises_anything_else(payload: bytes) -> None:
    for decode in (messages.decode_slip, messages.decode_over):
        with pytest.raises(MessageError):
            decode(payload)


def test_a_touch_without_skin_has_neither_area_nor_pressure() -> None:
    event = touch_event(
        "begin",
        1,
        2,
        3,
        "index",
        [],
        [0.0, 0.0, 0.01],
        [0, 0, 1],
        None,
        None,
        None,
        2.0,
        1e-4,
        LOAD,
    )
    payload = messages.encode_event(event, 1)
    assert b'"area_mm2":null,"peak_kpa":null,"mean_kpa":null,"force_n":2.0' in payload
    touch = messages.decode_touch(payload)
    assert touch.load is not None
    assert touch.load.force_n == (0.1, 0.0, -2.0)
    assert touch.load.flags == ["touch"]


def test_each_kind_of_event_is_numbered_by_itself_and_counts_when_it_is_lost() -> None:
    outbox = Outbox(event_limit=2)
    for topic, event in (("a/slip", SLIP), ("a/over", OVER), ("a/slip", SLIP)):
        outbox.put_touch(topic, event, None)
    assert [b'"count":1' in event.payload for event in outbox.events] == [True, True]
    assert outbox.counters.touches_dropped == 1
