"""What is said of touches, contact and health can be read back, and nonsense is refused."""

import contextlib
from collections.abc import Callable
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import json

from skin_host.mqtt import messages
from skin_host.mqtt.frames import decode_frame
from skin_host.mqtt.info import decode_info
from skin_host.mqtt.payload import MAX_BYTES, MessageError
from tests.support.said import make_event

DECODERS = (messages.decode_touch, messages.decode_contact, messages.decode_health)


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(payload: bytes) -> None:
    for decode in DECODERS:
        with contextlib.suppress(MessageError):
            decode(payload)


@pytest.mark.parametrize("decode", DECODERS)
def test_too_large_a_message_is_refused_in_few_words(
    decode: Callable[[bytes], object],
) -> None:
    with pytest.raises(MessageError) as refusal:
        decode(b" " * (MAX_BYTES + 1))
    assert len(str(refusal.value)) < 80


@pytest.mark.parametrize(
    ("what", "decode"),
    [
        ("touch", messages.decode_touch),
        ("slip", messages.decode_slip),
        ("over", messages.decode_over),
        ("health", messages.decode_health),
        ("frame", partial(decode_frame, "palm")),
        ("info", decode_info),
    ],
)
def test_a_message_of_a_later_version_is_refused_as_that(
    what: str, decode: Callable[[bytes], object]
) -> None:
    """Whoever reads that a value is invalid would look for a fault of the robot."""
    later = {"schema": f"skin.{what}/2", "seq": 1, "t_ns": 1, "unit": "kPa", "scale": 0.01}
    with pytest.raises(MessageError) as refusal:
        decode(json.encode(later | {"values": [], "valid": ""}))
    assert str(refusal.value).startswith(
        f'{what}: schema "skin.{what}/2"; this program reads skin.{what}/1: it needs the version of'
    )


def test_a_touch_has_the_keys_of_the_contract() -> None:
    payload = messages.encode_event(make_event(), 12)
    assert json.decode(payload) == {
        "schema": "skin.touch/1",
        "event": "begin",
        "id": 3,
        "seq": 8,
        "t_ns": 1000,
        "count": 12,
        "part": "palm",
        "taxels": [4, 5],
        "centroid_m": [0.012346, 0.0, 0.0],
        "normal": [0.0, 0.0, 1.0],
        "area_mm2": 25.13,
        "peak_kpa": 12.346,
        "mean_kpa": 8.0,
        "force_n": 0.1235,
        "sigma_m": 0.001235,
    }
    assert b"-0.0" not in payload


def test_a_touch_without_a_centroid_says_null() -> None:
    payload = messages.encode_event(make_event(centroid_m=None, normal=None), 1)
    assert b'"centroid_m":null,"normal":null' in payload
    assert messages.decode_touch(payload).centroid_m is None


def test_a_touch_reads_back() -> None:
    for event in (make_event(reason="lost"), make_event()):
        assert messages.decode_touch(messages.encode_event(event, 12)) == event.published(12)


def test_only_the_receiver_says_what_was_missed() -> None:
    payload = messages.encode_event(make_event(), 12).replace(b'"id"', b'"missed":5,"id"')
    assert messages.decode_touch(payload).missed == 0


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'"begin"', b'"start"'),
        (b'"id":3', b'"id":-3'),
        (b"[4,5]", b"[4,-5]"),
        (b"[0.0,0.0,1.0]", b"[0.0,1.0]"),
        (b"skin.touch/1", b"skin.touch/2"),
        (b"0.1235", b"null"),
    ],
)
def test_a_touch_that_breaks_the_contract_is_refused(old: bytes, new: bytes) -> None:
    payload = messages.encode_event(make_event(), 12)
    assert old in payload
    with pytest.raises(MessageError):
        messages.decode_touch(payload.replace(old, new))


def test_contact_is_on_or_off() -> None:
    for state in ("ON", "OFF", "UNKNOWN"):
        assert messages.decode_contact(messages.encode_contact(state)) == state


def test_health_carries_its_schema_first() -> None:
    payload = messages.encode_health({"rate_hz": 20.0})
    assert payload == b'{"schema":"skin.health/1","rate_hz":20.0}'
    assert messages.decode_health(payload)["rate_hz"] == 20.0
