"""What a packet may cost is known before it is decoded."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties, VariableByteIntegers

from skin_host.mqtt.packets import MAX_PROPERTIES, pack_number, unfit, unpack_number

PUBLISH_1 = 0x32
LIMIT = 80_000


def publish(properties: bytes, topic: bytes = b"a/b", payload: bytes = b"{}") -> bytes:
    size = VariableByteIntegers.encode(len(properties))  # type: ignore[no-untyped-call]
    return len(topic).to_bytes(2, "big") + topic + b"\x12\x34" + size + properties + payload


def why(packet: bytes, command: int = PUBLISH_1) -> str | None:
    found = unfit(command, packet, len(packet), LIMIT, v5=True)
    return None if found is None else found.why


@settings(max_examples=50)
@given(
    st.lists(st.tuples(st.text(max_size=5), st.text(max_size=5)), max_size=MAX_PROPERTIES - 5),
    st.binary(max_size=100),
)
def test_what_an_honest_client_sends_is_decoded(pairs: list[tuple[str, str]], data: bytes) -> None:
    properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    properties.ContentType = "application/json"
    properties.PayloadFormatIndicator = 1
    properties.MessageExpiryInterval = 10
    properties.ResponseTopic = "a/b"
    properties.CorrelationData = data
    for pair in pairs:
        properties.UserProperty = pair
    packed: bytes = properties.pack()  # type: ignore[no-untyped-call]
    size, length = VariableByteIntegers.decode(packed)  # type: ignore[no-untyped-call]
    assert size + length == len(packed)
    assert why(publish(packed[length:])) is None


@pytest.mark.parametrize(
    ("properties", "said"),
    [
        (b"\x26\0\0\0\0" * 100, "more than 32 properties"),
        (b"\x26\0\0\0\0" * 16_000, "80000 bytes of properties"),
        (b"\x09\x20\x00" + bytes(0x2000), "bytes of properties"),
        (b"\x0b\x01" * 100, "more than 32 properties"),
        (b"\x01\x01" * 100, "more than 32 properties"),
    ],
)
def test_a_message_with_too_many_properties_is_acknowledged_and_not_decoded(
    properties: bytes, said: str
) -> None:
    found = unfit(PUBLISH_1, packet := publish(properties), len(packet), 1_000_000, v5=True)
    assert found is not None
    assert said in found.why
    assert found.mid == 0x1234


@pytest.mark.parametrize("topic", [b"", b"\xff\xfe", b"a/+", b"a/#", b"a\0b"])
def test_a_message_whose_topic_is_none_is_not_decoded(topic: bytes) -> None:
    assert why(publish(b"", topic)) == "a message with an invalid topic"


def test_only_messages_may_be_long() -> None:
    assert why(bytes(10_000), command=0x90) is not None
    assert why(bytes(100), command=0x90) is None


@given(st.integers(0, 255), st.binary(max_size=300))
def test_no_packet_makes_the_check_itself_fail(command: int, packet: bytes) -> None:
    unfit(command, packet, len(packet), LIMIT, v5=True)


@given(st.integers(0, 268_435_455), st.binary(max_size=3))
def test_numbers_are_written_and_read_as_paho_does(number: int, rest: bytes) -> None:
    packed = pack_number(number)
    assert packed == VariableByteIntegers.encode(number)  # type: ignore[no-untyped-call]
    assert unpack_number(packed + rest, 0) == (number, len(packed))
