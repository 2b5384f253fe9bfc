"""The wire of the data frames, against vectors of the firmware's documentation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from skin_host.bus import wire
from skin_host.bus.wire import FrameBatch, StatusError


def payloads(text: str) -> list[bytes]:
    return [bytes.fromhex(line) for line in text.split("/")]


def word(mask: int, error: StatusError) -> int:
    bits = np.array([[mask >> i & 1 for i in range(12)]], bool)
    return int(wire.status_word(bits, np.array([error], np.uint8))[0])


# Board 1, triangle 0, noLoad 0xF0: (values, taxels out of range, error, frame A / frame B).
GOLDEN = [
    ([0xF0] * 12, 0, StatusError.NONE, "40F0F0F0F0F0F0F0/C0F0F0F0F0F00000"),
    ([0xF0] * 9 + [0, 0xF0, 0xF0], 0x200, StatusError.NONE, "40F0F0F0F0F0F0F0/C0F0F000F0F02000"),
    ([0xF0] * 2 + [255] + [0xF0] * 9, 4, StatusError.NONE, "40F0F0FFF0F0F0F0/C0F0F0F0F0F00040"),
    ([0xF0] * 12, 0, StatusError.NOT_CONNECTED, "40F0F0F0F0F0F0F0/C0F0F0F0F0F00002"),
    ([0] * 12, 0xFFF, StatusError.NOT_CONNECTED, "4000000000000000/C00000000000FFF2"),
    ([255] * 12, 0xFFF, StatusError.NO_ACK, "40FFFFFFFFFFFFFF/C0FFFFFFFFFFFFF1"),
]


@pytest.mark.parametrize(("values", "mask", "error", "frames"), GOLDEN)
def test_a_sweep_is_sent_as_the_firmware_sends_it(values, mask, error, frames):
    ids, data = wire.encode_sweep(
        1,
        np.array([0]),
        np.array([values], np.uint8),
        np.array([word(mask, error)], np.uint16),
    )
    assert ids.tolist() == [0x410, 0x410]
    assert [bytes(row) for row in data] == payloads(frames)


@pytest.mark.parametrize(("_values", "mask", "error", "frames"), GOLDEN)
def test_status_bits_name_the_taxel_and_the_fault(_values, mask, error, frames):
    b = payloads(frames)[1]
    status = np.array([b[6] << 8 | b[7]], np.uint16)
    assert np.flatnonzero(wire.out_of_range(status)[0]).tolist() == [
        i for i in range(12) if mask >> i & 1
    ]
    assert wire.status_error(status)[0] == error


def test_identifiers_are_those_of_real_boards():
    assert wire.skin_id(1, 0) == 0x410
    assert wire.skin_id(14, 15) == 0x4EF


def found(*frames: tuple[int, str]) -> wire.SkinFrames:
    return wire.find_skin_frames(
        FrameBatch.of([(can_id, bytes.fromhex(data), 0) for can_id, data in frames])
    )


def test_halves_are_told_by_the_header_byte_not_by_order():
    frames = found((0x4E3, "C0F0F0F0F0F00000"), (0x4E3, "40F0F0F0F0F0F0F0"))
    assert frames.half.tolist() == [1, 0]
    assert frames.board.tolist() == [14, 14]
    assert frames.triangle.tolist() == [3, 3]


@pytest.mark.parametrize(
    ("frame", "counter"),
    [
        ((0x410, "41F0F0F0F0F0F0F0"), "wrong_header"),
        ((0x410, "40F0F0F0F0F0"), "short"),
        ((0x410, "C0F0F0"), "short"),
        ((0x410, "40"), "short"),
        ((0x410, ""), "other"),
        ((0x210, "1C0B0119000200"), "other"),
        ((0x31A, "008000800080"), "other"),
        ((0x80000410, "40F0F0F0F0F0F0F0"), "other"),
        ((0x40000410, "40F0F0F0F0F0F0F0"), "other"),
        ((0x20000004, "0000000000000000"), "other"),
        ((0x510, "40F0F0F0F0F0F0F0"), "other"),
    ],
)
def test_what_is_not_skin_is_counted_and_nothing_else(frame, counter):
    frames = found(frame)
    assert len(frames.row) == 0
    counts = {name: getattr(frames, name) for name in ("wrong_header", "short", "other")}
    assert counts == {name: int(name == counter) for name in counts}


def test_old_firmware_without_status_bytes_is_understood():
    assert found((0x410, "C0F0F0F0F0F0")).half.tolist() == [1]


def test_the_legacy_stream_of_class_3_is_understood():
    frames = found((0x3E0, "40F0F0F0F0F0F0F0"), (0x3E0, "C0F0F0F0F0F00000"))
    assert frames.half.tolist() == [0, 1]


def test_the_firmware_that_sends_its_second_frame_with_class_6_is_understood():
    frames = found((0x6E0, "C0F0F0F0F0F00000"), (0x6E0, "40F0F0F0F0F0F0F0"))
    assert frames.half.tolist() == [1]
    assert frames.other == 1


@given(
    board=st.integers(1, 14),
    values=npst.arrays(np.uint8, (16, 12)),
    status=npst.arrays(np.uint16, 16),
)
def test_what_is_encoded_is_decoded(board, values, status):
    ids, data = wire.encode_sweep(board, np.arange(16), values, status)
    batch = FrameBatch(ids, np.full(32, 8, np.uint8), data, np.zeros(32, np.int64))
    frames = wire.find_skin_frames(batch)
    assert (frames.board == board).all()
    again = np.zeros((16, 2, 7), np.uint8)
    again[frames.triangle, frames.half] = data[frames.row, 1:]
    flat = again.reshape(16, 14)
    np.testing.assert_array_equal(flat[:, :12], values)
    np.testing.assert_array_equal(flat[:, 12].astype(int) << 8 | flat[:, 13], status)
    back = wire.status_word(wire.out_of_range(status), wire.status_error(status))
    np.testing.assert_array_equal(back, status)


@given(
    ids=npst.arrays(np.uint32, 20),
    dlc=npst.arrays(np.uint8, 20, elements=st.integers(0, 8)),
    data=npst.arrays(np.uint8, (20, 8)),
)
def test_every_frame_of_garbage_is_counted_once(ids, dlc, data):
    frames = wire.find_skin_frames(FrameBatch(ids, dlc, data, np.zeros(20, np.int64)))
    assert len(frames.row) + frames.wrong_header + frames.short + frames.other == 20


@given(
    received=st.lists(st.integers(0, 50)),
    sent=st.lists(st.integers(0, 50), min_size=1).map(sorted),
)
def test_what_was_sent_comes_between_what_was_received_by_time(
    received: list[int], sent: list[int]
) -> None:
    both = wire.merged(
        FrameBatch.of([(1, bytes(8), t_ns) for t_ns in received]),
        FrameBatch.of([(2, bytes(8), t_ns) for t_ns in sent]),
    )
    assert both.t_ns[both.id == 1].tolist() == received
    assert both.t_ns[both.id == 2].tolist() == sent
    if received == sorted(received):
        assert both.rising
