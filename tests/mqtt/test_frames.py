"""A frame that is published can be read back, and nonsense is refused."""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from skin_host.errors import SkinError
from skin_host.mqtt import frames
from skin_host.mqtt.payload import MAX_BYTES, MessageError
from tests.support.said import make_frame

masks = hnp.arrays(np.bool_, st.integers(0, 300))


def test_bit_i_of_a_mask_is_taxel_i() -> None:
    assert frames.encode_mask(np.array([True, False, False])) == "1"
    assert frames.encode_mask(np.array([True] * 11 + [False])) == "7ff"
    assert frames.encode_mask(np.array([False] * 8 + [True])) == "100"


@given(masks)
def test_a_mask_reads_back(mask: np.ndarray) -> None:
    text = frames.encode_mask(mask)
    assert len(text) == (len(mask) + 3) // 4
    assert (frames.decode_mask(text, len(mask)) == mask).all()


@pytest.mark.parametrize("text", ["", "1", "fff", "1000", "80", "0x", " 1", "+1", "1_"])
def test_a_mask_of_another_length_or_alphabet_is_refused(text: str) -> None:
    with pytest.raises(MessageError):
        frames.decode_mask(text, 7)


def test_a_frame_has_the_keys_of_the_contract_in_their_order() -> None:
    payload = frames.encode_frame(make_frame([0.0, 1.234, 0.005]))
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
    seen = frames.decode_frame("palm", frames.encode_frame(frame, encoding))  # type: ignore[arg-type]
    assert (seen.part, seen.seq, seen.t_ns, seen.missed) == ("palm", 7, frame.t_ns, 0)
    assert (seen.valid == frame.valid).all()
    assert (seen.beyond_range == frame.beyond_range).all()
    np.testing.assert_allclose(seen.pressure_kpa, pressure, atol=0.00501, rtol=1e-12)


@pytest.mark.parametrize("encoding", ["json", "cbor"])
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_sent_as_not_valid(encoding: str, number: float) -> None:
    frame = make_frame([1.0, number, 2.0])
    seen = frames.decode_frame("palm", frames.encode_frame(frame, encoding))  # type: ignore[arg-type]
    assert seen.valid.tolist() == [True, False, True]
    assert seen.pressure_kpa.tolist() == [1.0, 0.0, 2.0]


def test_a_cbor_frame_says_its_array_in_the_smallest_type_that_holds_it() -> None:
    import cbor2

    small = cbor2.loads(frames.encode_frame(make_frame([327.67]), "cbor"))
    large = cbor2.loads(frames.encode_frame(make_frame([327.68]), "cbor"))
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
    assert frames.decode_frame("palm", GOOD).pressure_kpa.tolist() == [0.01]
    with pytest.raises(MessageError):
        frames.decode_frame("palm", GOOD.replace(old, new))


def test_a_key_of_a_later_version_is_passed_over() -> None:
    later = GOOD.replace(b"}", b',"temperature_c":[31]}')
    assert frames.decode_frame("palm", later).seq == 1


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(payload: bytes) -> None:
    for damaged in (payload, b"\xa7" + payload):
        with contextlib.suppress(MessageError):
            frames.decode_frame("palm", damaged)


@given(st.data())
def test_a_damaged_cbor_frame_is_read_or_refused(data: st.DataObject) -> None:
    payload = bytearray(frames.encode_frame(make_frame([1.0, 2.0]), "cbor"))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    try:
        frame = frames.decode_frame("palm", bytes(payload))
    except MessageError:
        return
    assert len(frame.pressure_kpa) == len(frame.valid) == len(frame.beyond_range)


@pytest.mark.parametrize("first", [b" ", b"\xa7"])
def test_too_large_a_frame_is_refused_unread(first: bytes) -> None:
    with pytest.raises(MessageError, match=r"frame: \d+ bytes"):
        frames.decode_frame("palm", first * (MAX_BYTES + 1))


def test_without_cbor2_the_error_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "cbor2", None)
    with pytest.raises(SkinError, match=r"pip install 'skin-host\[cbor\]'"):
        frames.encode_frame(make_frame([1.0]), "cbor")


@pytest.mark.parametrize("encoding", ["json", "cbor"])
def test_raw_bytes_are_sent_when_asked_for(encoding: str) -> None:
    frame = make_frame([1.0, 2.0, 3.0], raw=np.array([0, 128, 255], np.uint8))
    plain = frames.decode_frame("palm", frames.encode_frame(frame, encoding))  # type: ignore[arg-type]
    assert plain.raw is None
    payload = frames.encode_frame(frame, encoding, raw=True)  # type: ignore[arg-type]
    seen = frames.decode_frame("palm", payload)
    assert seen.raw is not None
    assert seen.raw.tolist() == [0, 128, 255]


def test_raw_bytes_of_another_number_of_taxels_are_refused() -> None:
    payload = frames.encode_frame(make_frame([1.0, 2.0]), raw=True)
    wrong = payload.replace(b'"raw":"AAE="', b'"raw":"AAEC"')
    assert wrong != payload
    with pytest.raises(MessageError, match="3 raw bytes for 2 taxels"):
        frames.decode_frame("palm", wrong)
