import numpy as np
import pytest

from emulator.boards.fingertips import StrainBoard
from skin_host.bus.answers import Discovered, FirmwareVersion, parse_answer
from skin_host.bus.commands import BoardType, Discover, GetFirmwareVersion, command_frame
from skin_host.bus.strain import (
    StrainType,
    WrenchAssembler,
    parse_full_scale,
    parse_strain,
    start_frames,
)
from tests.support.strain import samples_of

MS = 1_000_000
LOAD = np.array([10.0, -20.0, 300.0, 0.5, -1.0, 2.0])


def started(period_ms=10, **traits):
    """A board that the host has set up, and the full scales it told."""
    board = StrainBoard(13, lambda t_ns: LOAD, np.random.default_rng(1), **traits)
    answers = [
        answer
        for can_id, data in start_frames(13, period_ms)
        for answer in board.handle(can_id, data, 0)
    ]
    scales = {
        found.channel: found.value for _, found in (parse_full_scale(*answer) for answer in answers)
    }
    return board, np.array([scales[channel] for channel in range(6)], np.float64)


@pytest.mark.parametrize("torque_first", [False, True])
def test_the_host_reads_the_load_that_lies_on_the_board(torque_first):
    board, scale = started(torque_first=torque_first)
    assert scale.tolist() == [2000, 2000, 2000, 40, 40, 40]
    assembler = WrenchAssembler(13, 10, scale)
    samples = [
        sample for t in range(0, 1008, 7) for sample in samples_of(assembler, board.step(t * MS))
    ]
    assert len(samples) == 100
    assert assembler.counters.lone == 0
    force = np.mean([sample.force_n for sample in samples], axis=0)
    torque = np.mean([sample.torque_nm for sample in samples], axis=0)
    np.testing.assert_allclose(force, LOAD[:3], atol=0.1)
    np.testing.assert_allclose(torque, LOAD[3:], atol=0.002)


def test_a_board_is_silent_until_it_is_started_and_after_it_is_stopped():
    board = StrainBoard(3, lambda t_ns: LOAD, np.random.default_rng(1))
    assert len(board.step(50 * MS)) == 0
    board.handle(0x203, bytes([0x07, 0]), 50 * MS)
    assert len(board.step(100 * MS)) == 10
    board.handle(0x203, bytes([0x07, 1]), 100 * MS)
    assert len(board.step(200 * MS)) == 0


def test_a_mode_that_it_does_not_have_stops_a_board():
    """Message_SET_TXMODE::load of embot_prot_can_analog_polling.cpp."""
    board, _ = started()
    board.handle(0x20D, bytes([0x07, 2]), 0)
    assert len(board.step(50 * MS)) == 0


def test_commands_to_everyone_are_obeyed():
    """frameis4board of embot_prot_can.cpp, as with an MTB4."""
    board, _ = started()
    board.handle(0x20F, bytes([0x07, 1]), 0)
    assert len(board.step(50 * MS)) == 0


@pytest.mark.parametrize(("host", "compatible"), [((2, 0), 1), ((1, 0), 0), ((2, 1), 0)])
def test_a_board_answers_with_its_version(host: tuple[int, int], compatible: int) -> None:
    board = StrainBoard(3, lambda t_ns: LOAD, np.random.default_rng(1))
    for to in (3, 15):
        ((can_id, data),) = board.handle(*command_frame(GetFirmwareVersion(*host), to), 0)
        wanted = FirmwareVersion(BoardType.STRAIN2, 2, 0, 9, 2, 0, compatible)
        assert parse_answer(can_id, data) == (3, wanted)


def test_the_period_is_the_hosts():
    board, _ = started(period_ms=2)
    assert len(board.step(20 * MS)) == 20


def test_in_debug_mode_raw_data_come_too():
    board, _ = started()
    board.handle(0x20D, bytes([0x07, 4]), 0)
    frames = parse_strain(board.step(10 * MS))
    assert sorted(frames.type.tolist()) == [
        StrainType.RAW_FORCE,
        StrainType.RAW_TORQUE,
        StrainType.FORCE,
        StrainType.TORQUE,
    ]


def test_too_much_load_is_clipped_and_flagged():
    board = StrainBoard(3, lambda t_ns: [3000.0, 0, 0, 0, 0, -50.0], np.random.default_rng(1))
    board.handle(0x203, bytes([0x07, 0]), 0)
    batch = board.step(10 * MS)
    assert batch.dlc.tolist() == [7, 7]
    frames = parse_strain(batch)
    assert frames.saturated.all()
    assert frames.value[0, 0] == 0x7FFF
    assert frames.value[1, 2] == -0x8000


def test_a_full_scale_beyond_what_an_answer_holds_is_answered_as_the_largest() -> None:
    scale = (1e6, 70_000.0, 65_535.0, 40.0, 0.4, 1e-6)
    _, reported = started(full_scale=scale)
    assert reported.tolist() == [65_535, 65_535, 65_535, 40, 0, 0]


def test_a_board_says_who_it_is() -> None:
    board = StrainBoard(3, lambda t_ns: LOAD, np.random.default_rng(1))
    for asked in (command_frame(Discover(), 15), command_frame(Discover(), 3)):
        ((can_id, data),) = board.handle(*asked, 0)
        found = parse_answer(can_id, data)
        assert found is not None
        assert found[0] == 3
        assert isinstance(found[1], Discovered)
        assert found[1].board_type == BoardType.STRAIN2
    assert board.handle(*command_frame(Discover(), 4), 0) == []


@pytest.mark.parametrize(
    ("can_id", "data"),
    [
        (0x204, b"\x07\x00"),
        (0x203, b"\x07"),
        (0x203, b""),
        (0x203, b"\x08\x00"),
        (0x203, b"\x18\x06"),
        (0x203, b"\x1c\x02"),
        (0x20F, b"\x18\x06"),
    ],
)
def test_nonsense_and_other_boards_commands_change_nothing(can_id, data):
    board = StrainBoard(3, lambda t_ns: LOAD, np.random.default_rng(1))
    assert board.handle(can_id, data, 0) == []
    assert board.period_ms == 10
    assert board.next_ns is None
