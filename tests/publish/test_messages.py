"""What is published can be read back, and nonsense is refused."""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from msgspec import json

from skin_host.errors import SkinError
from skin_host.processing.contacts import TouchEvent
from skin_host.processing.pipeline import PressureFrame
from skin_host.publish import messages
from skin_host.publish.messages import MessageError

masks = hnp.arrays(np.bool_, st.integers(0, 300))


def make_frame(pressure_kpa: list[float], **changes: object) -> PressureFrame:
    m = len(pressure_kpa)
    keys: dict[str, object] = {
        "part": "palm",
        "seq": 7,
        "t_ns": 1_763_700_000_123_456_789,
        "raw": np.arange(m, dtype=np.uint8),
        "pressure_kpa": np.array(pressure_kpa, np.float32),
        "touched": np.zeros(m, np.bool_),
        "valid": np.ones(m, np.bool_),
        "beyond_range": np.zeros(m, np.bool_),
    }
    return PressureFrame(**(keys | changes))  # type: ignore[arg-type]


def make_event(**changes: object) -> TouchEvent:
    keys: dict[str, object] = {
        "event": "begin",
        "id": 3,
        "seq": 8,
        "t_ns": 1000,
        "part": "palm",
        "taxels": [4, 5],
        "centroid_m": [0.01234567, -0.0000001, 0.0],
        "normal": [0.0, 0.0, 1.0],
        "area_mm2": 25.128,
        "peak_kpa": 12.34567,
        "mean_kpa": 8.0,
        "force_n": 0.123456,
        "sigma_m": 0.00123456,
    }
    return TouchEvent(**(keys | changes))  # type: ignore[arg-type]


def test_bit_i_of_a_mask_is_taxel_i() -> None:
    assert messages.encode_mask(np.array([True, False, False])) == "1"
    assert messages.encode_mask(np.array([True] * 11 + [False])) == "7ff"
    assert messages.encode_mask(np.array([False] * 8 + [True])) == "100"


@given(masks)
def test_a_mask_reads_back(mask: np.ndarray) -> None:
    text = messages.encode_mask(mask)
    assert len(text) == (len(mask) + 3) // 4
    assert (messages.decode_mask(text, len(mask)) == mask).all()


@pytest.mark.parametrize("text", ["", "1", "fff", "1000", "80", "0x", " 1", "+1", "1_"])
def test_a_mask_of_another_length_or_alphabet_is_refused(text: str) -> None:
    with pytest.raises(MessageError):
        messages.decode_mask(text, 7)


def test_a_frame_has_the_keys_of_the_contract_in_their_order() -> None:
    payload = messages.encode_frame(make_frame([0.0, 1.234, 0.005]))
    assert payload == (
        b'{"schema":"skin.frame/1","seq":7,"t_ns":1763700000123456789,"unit":"kPa",'
        b'"scale":0.01,"values":[0,123,0],"valid":"7"}'
    )


@pytest.mark.parametrize("encoding", ["json", "cbor"])
@given(
    pressure=hnp.arrays(np.float32, st.integers(0, 60), elements=st.floats(-1e4, 2e5, width=32)),
    seed=st.integers(0, 1000),
)
def test_a_frame_reads_back_to_half_a_unit(encoding: str, pressure: np.ndarray, seed: int) -> None:
    random = np.random.default_rng(seed)
    frame = make_frame(
        pressure.tolist(),
        valid=random.random(len(pressure)) < 0.8,
        beyond_range=random.random(len(pressure)) < 0.1,
    )
    seen = messages.decode_frame("palm", messages.encode_frame(frame, encoding))  # type: ignore[arg-type]
    assert (seen.part, seen.seq, seen.t_ns, seen.missed) == ("palm", 7, frame.t_ns, 0)
    assert (seen.valid == frame.valid).all()
    assert (seen.beyond_range == frame.beyond_range).all()
    np.testing.assert_allclose(seen.pressure_kpa, pressure, atol=0.00501, rtol=1e-12)


@pytest.mark.parametrize("encoding", ["json", "cbor"])
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_sent_as_not_valid(encoding: str, number: float) -> None:
    frame = make_frame([1.0, number, 2.0])
    seen = messages.decode_frame("palm", messages.encode_frame(frame, encoding))  # type: ignore[arg-type]
    assert seen.valid.tolist() == [True, False, True]
    assert seen.pressure_kpa.tolist() == [1.0, 0.0, 2.0]


def test_a_cbor_frame_says_its_array_in_the_smallest_type_that_holds_it() -> None:
    import cbor2

    small = cbor2.loads(messages.encode_frame(make_frame([327.67]), "cbor"))
    large = cbor2.loads(messages.encode_frame(make_frame([327.68]), "cbor"))
    assert (small["values"].tag, small["values"].value) == (77, b"\xff\x7f")
    assert (large["values"].tag, large["values"].value) == (78, b"\x00\x80\x00\x00")
    assert list(small) == ["schema", "seq", "t_ns", "unit", "scale", "values", "valid"]


GOOD = (
    b'{"schema":"skin.frame/1","seq":1,"t_ns":2,"unit":"kPa","scale":0.01,"values":[1],"valid":"1"}'
)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"frame/1", b"frame/2"),
        (b'"seq":1', b'"seq":-1'),
        (b'"seq":1', b'"seq":"1"'),
        (b"kPa", b"psi"),
        (b"0.01", b"0"),
        (b"0.01", b"1e400"),
        (b"[1]", b"[1.5]"),
        (b"[1]", b"[99999999999]"),
        (b"[1]", b"[1,2,3,4,5]"),
        (b'"valid":"1"', b'"valid":"3"'),
        (b'"valid":"1"', b'"valid":"1","beyond_range":"ff"'),
        (b"[1]", b"[" * 3000),
        (b"{", b""),
        (b"}", b"\xff"),
    ],
)
def test_a_frame_that_breaks_the_contract_is_refused(old: bytes, new: bytes) -> None:
    assert messages.decode_frame("palm", GOOD).pressure_kpa.tolist() == [0.01]
    with pytest.raises(MessageError):
        messages.decode_frame("palm", GOOD.replace(old, new))


def test_a_key_of_a_later_version_is_passed_over() -> None:
    later = GOOD.replace(b"}", b',"temperature_c":[31]}')
    assert messages.decode_frame("palm", later).seq == 1


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(payload: bytes) -> None:
    for decode in (
        lambda data: messages.decode_frame("palm", data),
        lambda data: messages.decode_frame("palm", b"\xa7" + data),
        messages.decode_touch,
        messages.decode_contact,
        messages.decode_health,
    ):
        with contextlib.suppress(MessageError):
            decode(payload)


@given(st.data())
def test_a_damaged_cbor_frame_is_read_or_refused(data: st.DataObject) -> None:
    payload = bytearray(messages.encode_frame(make_frame([1.0, 2.0]), "cbor"))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    try:
        frame = messages.decode_frame("palm", bytes(payload))
    except MessageError:
        return
    assert len(frame.pressure_kpa) == len(frame.valid) == len(frame.beyond_range)


def test_too_large_a_message_is_refused_unread() -> None:
    with pytest.raises(MessageError, match="bytes"):
        messages.decode_frame("palm", b" " * (messages.MAX_BYTES + 1))


def test_a_touch_has_the_keys_of_the_contract() -> None:
    payload = messages.encode_touch(make_event(), 12)
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
    payload = messages.encode_touch(make_event(centroid_m=None, normal=None), 1)
    assert b'"centroid_m":null,"normal":null' in payload
    assert messages.decode_touch(payload).centroid_m is None


def test_a_touch_reads_back() -> None:
    sent = messages.touch_message(make_event(), 12)
    seen = messages.decode_touch(messages.encode_touch(make_event(), 12))
    assert all(getattr(seen, key) == getattr(sent, key) for key in sent.__struct_fields__)


def test_only_the_receiver_says_what_was_missed() -> None:
    payload = messages.encode_touch(make_event(), 12).replace(b'"id"', b'"missed":5,"id"')
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
    payload = messages.encode_touch(make_event(), 12)
    assert old in payload
    with pytest.raises(MessageError):
        messages.decode_touch(payload.replace(old, new))


def test_contact_is_on_or_off() -> None:
    assert messages.encode_contact(True) == b"ON"
    assert messages.decode_contact(messages.encode_contact(False)) is False


def test_health_carries_its_schema_first() -> None:
    payload = messages.encode_health({"rate_hz": 20.0})
    assert payload == b'{"schema":"skin.health/1","rate_hz":20.0}'
    assert messages.decode_health(payload)["rate_hz"] == 20.0


def test_a_line_of_a_replay_holds_every_taxel() -> None:
    frame = make_frame([0.12345, -0.0001], valid=np.array([True, False]))
    assert messages.frame_line(frame) == (
        b'{"type":"frame","part":"palm","seq":7,"t_ns":1763700000123456789,"raw":[0,1],'
        b'"pressure_kpa":[0.123,0.0],"touched":[false,false],"valid":[true,false]}\n'
    )


def test_a_touch_line_is_the_payload_and_its_type() -> None:
    line = json.decode(messages.touch_line(make_event(), 12))
    assert line == {"type": "touch"} | json.decode(messages.encode_touch(make_event(), 12))


def test_without_cbor2_the_error_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "cbor2", None)
    with pytest.raises(SkinError, match=r"pip install 'skin-host\[cbor\]'"):
        messages.encode_frame(make_frame([1.0]), "cbor")


@pytest.mark.parametrize("encoding", ["json", "cbor"])
def test_raw_bytes_are_sent_when_asked_for(encoding: str) -> None:
    frame = make_frame([1.0, 2.0, 3.0], raw=np.array([0, 128, 255], np.uint8))
    plain = messages.decode_frame("palm", messages.encode_frame(frame, encoding))  # type: ignore[arg-type]
    assert plain.raw is None
    payload = messages.encode_frame(frame, encoding, raw=True)  # type: ignore[arg-type]
    seen = messages.decode_frame("palm", payload)
    assert seen.raw is not None
    assert seen.raw.tolist() == [0, 128, 255]


def test_raw_bytes_of_another_number_of_taxels_are_refused() -> None:
    payload = messages.encode_frame(make_frame([1.0, 2.0]), raw=True)
    wrong = payload.replace(b'"raw":"AAE="', b'"raw":"AAEC"')
    assert wrong != payload
    with pytest.raises(MessageError, match="3 raw bytes for 2 taxels"):
        messages.decode_frame("palm", wrong)
