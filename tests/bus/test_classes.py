"""Which frames are of skin, and in which classes a board sends them."""

from dataclasses import asdict

import numpy as np
import pytest

from skin_host.bus import wire
from skin_host.bus.wire import FrameBatch
from tests.support.sweeps import (
    MS,
    PERIOD,
    feed,
    feed_in_parts,
    frames,
    has_nothing_else,
    make,
    values,
)


def identifier(message_class: wire.MessageClass, address: int, triangle: int = 0) -> int:
    return message_class << 8 | address << 4 | triangle


STREAM, LEGACY = wire.MessageClass.SKIN_STREAM, wire.MessageClass.ANALOG_STREAM
BATTERY = wire.MessageClass.BATTERY_STREAM


@pytest.mark.parametrize(
    ("can_id", "length", "header", "counted"),
    [
        (identifier(STREAM, 1), 7, wire.HEADER_A, "short"),
        (identifier(STREAM, 1), 5, wire.HEADER_B, "short"),
        (identifier(STREAM, 1), 8, 0x80, "wrong_header"),
        (identifier(STREAM, 1, 4), 8, wire.HEADER_A, "unknown_triangle"),
        (identifier(STREAM, 2, 3), 6, wire.HEADER_B, "unknown_board"),
        (identifier(LEGACY, 1, 9), 8, wire.HEADER_A, "unknown_triangle"),
        (identifier(LEGACY, 9), 8, wire.HEADER_B, "unknown_board"),
        (identifier(BATTERY, 9), 8, wire.HEADER_B, "unknown_board"),
        (identifier(LEGACY, 1, 12), 8, wire.HEADER_A, "unknown_triangle"),
        # Other sensors share these classes.
        (identifier(LEGACY, 9, 12), 8, wire.HEADER_A, "other"),
        (identifier(LEGACY, 9, 13), 8, wire.HEADER_B, "other"),
        (identifier(LEGACY, 1), 7, wire.HEADER_A, "other"),
        (identifier(LEGACY, 1), 6, wire.HEADER_B, "other"),
        (identifier(LEGACY, 1), 8, 0x80, "other"),
        (identifier(BATTERY, 1), 8, wire.HEADER_A, "other"),
        (identifier(STREAM, 1), 0, 0, "other"),
        (0x800 | identifier(STREAM, 1), 8, wire.HEADER_A, "other"),
        (0x3A5, 8, wire.HEADER_A, "force_torque"),
        (0x7FF, 8, wire.HEADER_A, "other"),
    ],
)
def test_a_frame_that_is_of_no_sweep_is_counted_by_its_reason_and_once(
    can_id: int, length: int, header: int, counted: str
) -> None:
    assembler = make(force_torque=frozenset({0x3A5}))
    data = bytes([header, *range(1, 8)])[:length]
    assert assembler.feed(FrameBatch.of([(can_id, data, PERIOD)])).sweeps == []
    assert assembler.flush() == []
    counters = asdict(assembler.counters)
    assert {name: n for name, n in counters.items() if n} == {"frames": 1, counted: 1}


def test_strangers_are_counted():
    assembler = make("0,2")
    feed(assembler, frames(values(1), PERIOD, board=9) + frames(values(4), PERIOD))
    assert assembler.counters.unknown_board == 2
    assert assembler.counters.unknown_triangle == 4


def test_a_sweep_has_the_triangles_that_were_sent_since_the_one_before_and_are_not_configured():
    assembler = make("0,2")
    first, second, third = (
        feed(assembler, frames(values(n), number * PERIOD)) + assembler.flush()
        for number, n in enumerate((4, 4, 3), 1)
    )
    assert [sweep.unread for sweep in first + second + third] == [0b0010, 0b1010, 0b1010]


def test_boards_that_another_node_reads_are_no_strangers():
    assembler = make("0-1", boards=2, mine=1)
    sent = frames(values(2), PERIOD) + frames(values(2), PERIOD, board=2)
    sweeps = feed(assembler, sent + frames(values(1), PERIOD, board=9))
    assert [sweep.board for sweep in sweeps] == [0]
    feed(assembler, [(0x123, bytes(8), PERIOD)])
    assert (assembler.counters.other, assembler.elsewhere) == (5, 4)
    assert assembler.counters.unknown_board == 2
    assert assembler.unconfigured == {9: 2}


@pytest.mark.parametrize("garbage", [0xFFFFFFFF, 0x7FF, 0x4F0, 0x400])
def test_any_identifier_is_survived(garbage):
    assembler = make()
    assert feed(assembler, [(garbage, b"\x40" + bytes(7), PERIOD)]) == []
    counters = assembler.counters
    assert counters.other + counters.unknown_board == 1


def in_classes(
    sent: list[tuple[int, bytes, int]], *classes: wire.MessageClass
) -> list[tuple[int, bytes, int]]:
    """The frames of a sweep, A and B in turn, as a board sends them in these two classes."""
    return [
        (classes[place % 2] << 8 | can_id & 0xFF, *rest)
        for place, (can_id, *rest) in enumerate(sent)
    ]


@pytest.mark.parametrize(
    ("classes", "first"),
    [((STREAM, STREAM), 0), ((LEGACY, LEGACY), 0), ((STREAM, BATTERY), 1)],
)
@pytest.mark.parametrize("triangles", [1, 3])
@pytest.mark.parametrize("at_once", [1, 100])
def test_a_board_may_send_in_other_classes(
    classes: tuple[wire.MessageClass, ...], first: int, triangles: int, at_once: int
) -> None:
    """That of the special firmware, which other sensors use too, is known by its first sweep."""
    raws = [values(triangles, number) for number in range(5)]
    sent = [
        frame
        for number, raw in enumerate(raws)
        for frame in in_classes(frames(raw, number * PERIOD), *classes)
    ]
    assembler = make(f"0-{triangles - 1}")
    sweeps = feed_in_parts(assembler, sent, at_once)
    assert [sweep.raw[:triangles].tolist() for sweep in sweeps] == [
        raw.tolist() for raw in raws[first:]
    ]
    assert assembler.counters.other == assembler.counters.halves == first * triangles


@pytest.mark.parametrize("at_once", [1, 7, 1000])
@pytest.mark.parametrize("triangles", [1, 4])
@pytest.mark.parametrize(
    ("classes", "foreign"),
    [
        ((STREAM, STREAM), (LEGACY, BATTERY)),
        ((LEGACY, LEGACY), (BATTERY,)),
        ((STREAM, BATTERY), (LEGACY,)),
    ],
)
def test_frames_in_a_class_in_which_their_board_does_not_send_are_no_halves(
    classes: tuple[wire.MessageClass, ...],
    foreign: tuple[wire.MessageClass, ...],
    triangles: int,
    at_once: int,
) -> None:
    """Before, within and after sweeps; a board that loses frames, in and out of the known order."""
    rng = np.random.default_rng(5)
    other = [
        (identifier(of, 1, triangle), header)
        for of in foreign
        for triangle in range(triangles)
        for header in ([wire.HEADER_B] if of == BATTERY else [wire.HEADER_A, wire.HEADER_B])
    ]
    sent: list[tuple[int, bytes, int]] = []
    refused = 0
    raws = {}
    for number in range(60):
        raw = raws[number] = values(triangles, number)
        swept = in_classes(frames(raw, number * PERIOD), *classes)
        if number % 5 == 4:
            del swept[rng.integers(len(swept))]
        if number > 1:
            for can_id, header in rng.permutation(other)[:3].tolist():
                place = int(rng.integers(len(swept) + 1))
                t_ns = number * PERIOD - MS if place == 0 else swept[place - 1][2]
                swept.insert(place, (can_id, bytes([header, *rng.bytes(7)]), t_ns))
                refused += 1
        sent += swept
    assembler = make(f"0-{triangles - 1}")
    sweeps = feed_in_parts(assembler, sent, at_once)
    sweeps += assembler.flush()
    for sweep in sweeps:
        has_nothing_else(sweep, raws[sweep.t_ns // PERIOD])
    first = triangles if BATTERY in classes else 0
    lost = 12
    assert sum(sweep.present.bit_count() for sweep in sweeps) == 60 * triangles - lost - first
    assert assembler.counters.other == refused + first
    assert assembler.counters.halves == lost + first


def test_a_board_that_begins_to_send_in_other_classes_joins_nothing_of_both() -> None:
    """The class of the stream is believed at once; those that other sensors use, too, once the
    board, or all its B frames, are missing from it.
    """
    assembler = make("0-1")
    number = 0

    def send(periods: int, *classes: wire.MessageClass) -> list[int]:
        """Send so many sweeps; return which of them came, whole and true."""
        nonlocal number
        came = []
        for sweep in range(periods):
            number += 1
            raw = values(2, number)
            # Cut amid a triangle, as a set-up would.
            sent = in_classes(frames(raw, number * PERIOD), *classes)[: 3 if sweep == 0 else 4]
            for one in feed(assembler, sent):
                np.testing.assert_array_equal(one.raw[0], values(2, one.t_ns // PERIOD)[0])
                if one.present == 0b11:
                    np.testing.assert_array_equal(one.raw[:2], raw)
                    came.append(sweep)
        return came

    assert send(4, LEGACY, LEGACY) == [1, 2, 3]
    assert send(4, STREAM, STREAM) == [1, 2, 3]
    assert send(9, STREAM, BATTERY) == [3, 4, 5, 6, 7, 8]
    assert send(4, STREAM, STREAM) == [1, 2, 3]
    assert send(9, LEGACY, LEGACY) == []
    assert send(4, LEGACY, LEGACY) == [1, 2, 3]
    assert send(5, STREAM, BATTERY) == [3, 4]
