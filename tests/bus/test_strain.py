import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.bus.commands import SetTxMode
from skin_host.bus.strain import (
    FullScale,
    GetFullScale,
    StrainMode,
    StrainType,
    WrenchAssembler,
    parse_full_scale,
    parse_strain,
    start_frames,
)
from skin_host.bus.wire import FrameBatch
from tests.support.strain import encode_strain, samples_of

MS = 1_000_000
SCALE = np.array([2000.0, 2000, 1000, 40, 40, 20])
values = st.tuples(*[st.integers(-0x8000, 0x7FFF)] * 3)


@given(board=st.integers(1, 14), kind=st.sampled_from(list(StrainType)), value=values)
def test_a_frame_comes_back_as_it_was(board, kind, value):
    can_id, payload = encode_strain(board, kind, value)
    frames = parse_strain(FrameBatch.of([(can_id, payload, 5)]))
    assert frames.value.tolist() == [list(value)]
    assert (frames.board[0], frames.type[0]) == (board, kind)
    assert not frames.saturated[0]


def test_the_bytes_are_those_of_the_wire():
    can_id, payload = encode_strain(13, StrainType.FORCE, (0, 1, -0x8000))
    assert can_id == 0x3DA
    assert payload.hex() == "008001800000"
    assert encode_strain(13, StrainType.TORQUE, (0, 0, 0), overflow=3)[1].hex() == "00800080008003"


@pytest.mark.parametrize("value", [(0, 0, 0x8000), (0, 0, -0x8001), (0, 0)])
def test_values_beyond_a_word_are_refused(value):
    with pytest.raises(ValueError, match="wanted three values"):
        encode_strain(1, StrainType.FORCE, value)


def test_commands_have_their_bytes():
    assert SetTxMode(StrainMode.STOP).encode().hex() == "0701"
    assert GetFullScale(3).encode().hex() == "1803"
    frames = start_frames(13, 10)
    assert {can_id for can_id, _ in frames} == {0x20D}
    assert [data.hex() for _, data in frames[-3:]] == ["1805", "080a", "0700"]


def test_a_full_scale_has_its_high_byte_first():
    assert parse_full_scale(0x2D0, bytes([0x18, 4, 0x07, 0xD0])) == (13, FullScale(4, 2000))


@pytest.mark.parametrize(
    ("can_id", "payload"),
    [
        (0x20D, bytes([0x18, 4])),  # the question, not the answer
        (0x2D0, bytes([0x18, 4, 7])),
        (0x2D0, bytes([0x18, 9, 7, 0])),
        (0x2D0, bytes([0x07, 0, 0, 0])),
        (0x200, bytes([0x18, 4, 7, 0])),
        (0x2D0, b""),
    ],
)
def test_other_answers_are_not_full_scales(can_id, payload):
    assert parse_full_scale(can_id, payload) is None


@given(
    frames=st.lists(
        st.tuples(
            st.one_of(st.integers(0x3D8, 0x3DB), st.integers(0x300, 0x3FF), st.integers(0, 0x7FF)),
            st.binary(max_size=8),
        ),
        max_size=30,
    )
)
def test_no_traffic_on_the_bus_can_break_the_assembler(frames):
    batch = FrameBatch.of([(can_id, data, i * MS) for i, (can_id, data) in enumerate(frames)])
    assembler = WrenchAssembler(13, 10, SCALE)
    for sample in samples_of(assembler, batch):
        assert np.isfinite(sample.force_n).all()
        assert (np.abs(sample.force_n) <= SCALE[:3]).all()
    strain = [data for can_id, data in frames if 0x3D8 <= can_id <= 0x3DB]
    assert assembler.counters.wrong_length == sum(len(data) not in (6, 7) for data in strain)


def stream(*entries):
    """Frames of board 13: (milliseconds, "f" or "t", first value, payload bytes more)."""
    rows = []
    for t_ms, kind, value, *more in entries:
        type_ = StrainType.FORCE if kind == "f" else StrainType.TORQUE
        can_id, payload = encode_strain(13, type_, (value, 0, 0))
        rows.append((can_id, payload + bytes(more), int(t_ms * MS)))
    return FrameBatch.of(rows)


@pytest.mark.parametrize("order", ["ft", "tf"])
def test_force_and_torque_are_paired_in_either_order_and_scaled(order):
    assembler = WrenchAssembler(13, 10, SCALE)
    value = {"f": 0x4000, "t": -0x2000}
    samples = samples_of(
        assembler,
        stream(*[(10 * i + 0.1 * k, o, value[o]) for i in range(3) for k, o in enumerate(order)]),
    )
    assert len(samples) == 3
    assert samples[0].force_n[0] == 1000.0
    assert samples[0].torque_nm[0] == -10.0
    assert samples[2].t_ns == 20_100_000
    assert assembler.counters.lone == 0


@given(
    order=st.permutations("ft"),
    copies=st.lists(st.integers(1, 3), min_size=40, max_size=40),
    late_ms=st.floats(0.0, 0.9),
    values=st.lists(st.integers(-2, 2), min_size=20, max_size=20),
)
def test_frames_that_come_twice_in_a_row_are_taken_once(order, copies, late_ms, values):
    """A fingertip whose frames all came twice was blind: no force was followed by its torque."""
    sent = [(10 * i + k, kind, values[i]) for i in range(20) for k, kind in enumerate(order)]
    # The order is learnt from frames that follow each other at once.
    start = [(10 * i - 30 + 0.1 * k, kind, i) for i in range(3) for k, kind in enumerate(order)]
    came = [
        (t_ms + late_ms * copy / 3, kind, value)
        for (t_ms, kind, value), n in zip(sent, copies, strict=True)
        for copy in range(n)
    ]
    assembler = WrenchAssembler(13, 10, SCALE)
    samples = samples_of(assembler, stream(*start, *came))
    assert assembler.counters.lone == 0
    assert assembler.counters.doubled == len(came) - len(sent)
    found = [s.force_n[0] * 0x8000 / SCALE[0] for s in samples[3:]]
    assert np.round(found).tolist() == values


@pytest.mark.parametrize("order", ["ft", "tf"])
@given(
    apart_ms=st.floats(0.15, 4.8),
    lost=st.sets(st.integers(3, 39)),
    values=st.lists(st.integers(-2, 2), min_size=40, max_size=40),
)
def test_samples_that_two_gateways_pass_on_are_taken_once(order, apart_ms, lost, values):
    """Whichever of them passes some samples on alone; two of the board may be equal."""
    came = [
        (10 * i + 0.1 * k + apart_ms * copy, kind, values[i])
        for i in range(40)
        for copy in range(1 if i in lost or i < 3 else 2)
        for k, kind in enumerate(order)
    ]
    came.sort(key=lambda frame: frame[0])
    assembler = WrenchAssembler(13, 10, SCALE)
    samples = samples_of(assembler, stream(*came))
    found = [s.force_n[0] * 0x8000 / SCALE[0] for s in samples]
    assert np.round(found).tolist() == values
    assert assembler.counters.doubled == len(came) - 2 * 40
    assert assembler.counters.lone == 0


@pytest.mark.parametrize("apart_ms", [0.05, 0.15, 0.7, 1.4])
def test_samples_that_come_twice_are_not_of_two_boards(apart_ms):
    came = [
        (3 * i + 0.13 * k + apart_ms * copy, kind, i % 1000)
        for i in range(2000)
        for copy in range(2)
        for k, kind in enumerate("ft")
    ]
    came.sort(key=lambda frame: frame[0])
    assembler = WrenchAssembler(13, 3, SCALE)
    samples_of(assembler, stream(*came))
    assert not assembler.twice


@pytest.mark.parametrize("wrong_ms", [3.6e6, -3.6e6, 5e3])
def test_one_wrong_time_stamp_does_not_end_two_boards(wrong_ms):
    came = [
        (3600_000 + 3 * i + 0.13 * k + 1.1 * copy, kind, 2 * i + copy)
        for i in range(4000)
        for copy in range(2)
        for k, kind in enumerate("ft")
    ]
    came[8000] = (came[8000][0] + wrong_ms, *came[8000][1:])
    assembler = WrenchAssembler(13, 3, SCALE)
    twice = []
    for frame in came:
        samples_of(assembler, stream((frame[0], frame[1], frame[2] % 1000)))
        twice.append(assembler.twice)
    assert all(twice[5000:])


def test_equal_samples_that_waited_and_were_stamped_at_once_are_not_doubled():
    assembler = WrenchAssembler(13, 10, SCALE)
    learn = [(10 * i + 0.1 * k, kind, i) for i in range(3) for k, kind in enumerate("ft")]
    waited = [(90 + 0.01 * i, kind, 7) for i in range(6) for kind in "ft"]
    assert len(samples_of(assembler, stream(*learn, *waited))) == 9
    assert assembler.counters.doubled == 0


def test_a_lost_half_never_joins_two_samples():
    assembler = WrenchAssembler(13, 10, SCALE)
    samples = samples_of(
        assembler,
        stream(
            (0, "f", 1), (0.1, "t", 1), (10, "f", 2), (20.1, "t", 3), (30, "f", 4), (30.1, "t", 4)
        ),
    )
    assert [s.force_n[0] / s.torque_nm[0] for s in samples] == [2000 / 40, 2000 / 40]
    assert assembler.counters.samples == 2
    assert (assembler.counters.lone, assembler.counters.late) == (2, 2)


@pytest.mark.parametrize("lost", ["f", "t"])
def test_halves_whose_other_half_was_lost_are_not_late(lost):
    assembler = WrenchAssembler(13, 10, SCALE)
    frames = [(10 * i + 0.1 * k, kind, i) for i in range(9) for k, kind in enumerate("ft")]
    del frames[8 + "ft".index(lost)]
    assert len(samples_of(assembler, stream(*frames))) == 8
    assert (assembler.counters.lone, assembler.counters.late) == (1, 0)


LATE_MS = st.floats(0.1, 9.6)


@pytest.mark.parametrize("order", ["ft", "tf"])
@given(
    samples=st.lists(st.tuples(LATE_MS, st.booleans(), st.booleans()), min_size=1, max_size=40),
    gathered=st.booleans(),
)
def test_force_is_never_joined_with_the_torque_of_another_sample(order, samples, gathered):
    """However late a half is within its period, and whichever frames are lost."""
    frames = []
    for number, (late_ms, loses_first, loses_second) in enumerate(samples):
        halves = [(10 * number, order[0]), (10 * number + late_ms, order[1])]
        frames += [
            (t_ms, kind, number)
            for (t_ms, kind), lost in zip(halves, (loses_first, loses_second), strict=True)
            if not lost
        ]
    assembler = WrenchAssembler(13, 10, SCALE)
    batches = [stream(*frames)] if gathered else [stream(frame) for frame in frames]
    found = [sample for batch in batches for sample in samples_of(assembler, batch)]
    for sample in found:
        assert sample.force_n[0] / SCALE[0] == sample.torque_nm[0] / SCALE[3]
    assert assembler.counters.samples == len(found)
    waits = len(frames) - 2 * len(found) - assembler.counters.lone
    assert waits in (0, 1)


@pytest.mark.parametrize("order", ["ft", "tf"])
def test_a_late_half_ends_its_sample_and_begins_no_other(order):
    assembler = WrenchAssembler(13, 10, SCALE)
    late = range(20, 60)
    frames = [
        (10 * i + k * (8.0 if i in late else 0.1), kind, i)
        for i in range(80)
        for k, kind in enumerate(order)
    ]
    samples = samples_of(assembler, stream(*frames))
    numbers = [round(sample.force_n[0] / SCALE[0] * 0x8000) for sample in samples]
    assert numbers == [i for i in range(80) if i not in late]
    assert assembler.counters.lone == assembler.counters.late == 2 * len(late)


@pytest.mark.parametrize("order", ["ft", "tf"])
def test_a_half_may_be_late_by_half_a_period_once_the_order_is_known(order):
    assembler = WrenchAssembler(13, 10, SCALE)
    frames = [
        (10 * i + k * (5.0 if i else 0.1), o, i) for i in range(9) for k, o in enumerate(order)
    ]
    assert len(samples_of(assembler, stream(*frames))) == 9
    assert assembler.counters.lone == 0


@pytest.mark.parametrize("lost", ["f", "t"])
def test_frames_that_were_stamped_when_read_are_paired_in_the_order_of_the_board(lost):
    """An adapter may stamp all that waited with one time: a lost frame is lost alone."""
    assembler = WrenchAssembler(13, 10, SCALE)
    numbers = []
    #: A torque that comes after two forces may be of either.
    missing = {"f": [4], "t": [4, 5]}[lost]
    for read in range(5):
        frames = [
            (100 * read, kind, 10 * read + i)
            for i in range(10)
            for kind in "ft"
            if (i, kind) != (4, lost)
        ]
        for sample in samples_of(assembler, stream(*frames)):
            assert sample.force_n[0] / SCALE[0] == sample.torque_nm[0] / SCALE[3]
            numbers.append(round(sample.force_n[0] / SCALE[0] * 0x8000))
    assert numbers == [i for i in range(50) if i % 10 not in missing]
    assert assembler.counters.lone == 5 * (2 * len(missing) - 1)


@pytest.mark.parametrize("order", ["ft", "tf"])
def test_a_half_that_may_be_of_either_of_two_samples_is_of_none(order):
    """A board that is set up again begins another period: here after 6.5 of 10 ms."""
    assembler = WrenchAssembler(13, 10, SCALE)
    first, second = order
    whole = [(10 * i + 0.1 * k, kind, i) for i in range(3) for k, kind in enumerate(order)]
    late = [(30, first, 3), (36.5, first, 4), (38.4, second, 3), (46.5, first, 5)]
    late += [(46.6, second, 5)]
    samples = samples_of(assembler, stream(*whole, *late))
    numbers = [round(sample.force_n[0] / SCALE[0] * 0x8000) for sample in samples]
    assert numbers == [0, 1, 2, 5]
    assert assembler.counters.lone == 3


def test_frames_that_changed_places_are_lost_and_those_after_them_are_not():
    assembler = WrenchAssembler(13, 10, SCALE)
    frames = [
        (10 * i + 0.1 * k, kind, i)
        for i in range(20)
        for k, kind in enumerate("tf" if i == 10 else "ft")
    ]
    samples = samples_of(assembler, stream(*frames))
    numbers = [round(sample.force_n[0] / SCALE[0] * 0x8000) for sample in samples]
    assert numbers == [i for i in range(20) if i != 10]
    assert assembler.counters.lone == 2


def test_the_order_of_another_board_at_the_address_is_learned():
    assembler = WrenchAssembler(13, 10, SCALE)
    frames = [
        (10 * i + 0.1 * k, kind, i)
        for i in range(100)
        for k, kind in enumerate("ft" if i < 50 else "tf")
    ]
    samples = samples_of(assembler, stream(*frames))
    numbers = [round(sample.force_n[0] / SCALE[0] * 0x8000) for sample in samples]
    assert numbers[:50] == list(range(50))
    assert numbers[50:] == list(range(100 - len(numbers[50:]), 100))
    assert 30 < len(numbers[50:]) < 50


def test_pairs_may_be_split_over_batches_and_other_boards_are_not_mixed_in():
    assembler = WrenchAssembler(13, 10, SCALE)
    assert samples_of(assembler, stream((0, "f", 1))) == []
    other_id, payload = encode_strain(12, StrainType.TORQUE, (5, 5, 5))
    assert samples_of(assembler, FrameBatch.of([(other_id, payload, 50_000)])) == []
    assert len(samples_of(assembler, stream((0.1, "t", 1)))) == 1


def test_saturation_is_told():
    assembler = WrenchAssembler(13, 10, SCALE)
    samples = samples_of(
        assembler, stream((0, "f", 0x7FFF, 1), (0.1, "t", 0), (10, "f", 1, 0), (10.1, "t", 0))
    )
    assert [sample.saturated for sample in samples] == [True, False]
    assert assembler.counters.saturated == 1
