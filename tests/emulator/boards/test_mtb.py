"""The boards' firmware, driven over emulated I2C by chips that convert. Sources are those of
icub-firmware: theSkin is embot_app_application_theSkin.cpp, PSK is
embot_prot_can_skin_periodic.cpp; MTB3 is in test_mtb3.py."""

from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from emulator.boards.arithmetic import transmit_16, transmit_32
from emulator.boards.mtb import make_board
from emulator.chips.converters import slot_of
from skin_host.bus import commands
from skin_host.bus.answers import (
    AdditionalInfo,
    Discovered,
    DiscoveredBootloader,
    FirmwareVersion,
    TimeOfLife,
)
from skin_host.bus.commands import (
    Discover,
    EnterBootloader,
    GetAdditionalInfo,
    GetFirmwareVersion,
    GetTimeOfLife,
    Ping,
    SetAdditionalInfo,
    SetBoardAddress,
    SetBoardConfig,
    SetCanAddress,
    SetTriangleConfig,
    SetTxMode,
    TactileSetup,
    TxMode,
)
from skin_host.bus.compensation import GAIN, GAIN_V2, thermal_gains
from skin_host.bus.wire import TRIANGLES
from skin_host.config.settings import Board
from skin_host.layout import BoardLayout
from tests.support.board import RESTING_FF, BoardOnBench

START = SetTxMode(TxMode.START)
STOP = SetTxMode(TxMode.STOP)


def started(model: str = "mtb4", *, skin_type: int = 2, triangles: int = 1) -> BoardOnBench:
    """A board that streams: type without compensation, shift 2, no-load 240, 50 ms."""
    bench = BoardOnBench(model)
    bench.say(SetBoardConfig(skin_type, 50, 240))
    bench.run(0.1)
    bench.say(SetTriangleConfig(0, triangles - 1))
    bench.run(0.3)
    bench.say(START)
    return bench


def word_at(bench: BoardOnBench, register: int) -> int:
    """What the first chip has in a register."""
    chip = bench.chips[0]
    chip.write(register.to_bytes(2, "big"))
    return int.from_bytes(chip.read(2), "big")


# ---------------------------------------------------------------------- data frames


def test_an_untouched_triangle_sends_no_load_in_two_frames() -> None:
    """PSK: 40 and seven values, C0 and five values and the status."""
    bench = started()
    assert bench.run(0.05) == [
        (0x410, bytes.fromhex("40F0F0F0F0F0F0F0")),
        (0x410, bytes.fromhex("C0F0F0F0F0F00000")),
    ]


def test_pressing_a_pad_lowers_its_byte_by_the_shifted_codes() -> None:
    """theSkin fill(): out = noLoad - ((raw - base) >> shift)."""
    bench = started()
    bench.chips[0].set_capacitance_ff(3, RESTING_FF + 0.36 * 101)
    bench.run(0.05)
    values, _ = bench.triangle(bench.run(0.05), 0)
    assert values == [240, 240, 240, 240 - (101 >> 2)] + [240] * 8


def test_lift_off_raises_the_byte_by_the_arithmetic_shift() -> None:
    """theSkin fill(): -5 >> 2 is -2, so a small negative change counts twice."""
    bench = started()
    bench.chips[0].set_capacitance_ff(0, RESTING_FF - 0.36 * 5)
    bench.run(0.05)
    assert bench.triangle(bench.run(0.05), 0)[0][0] == 242


def test_a_taxel_far_out_of_range_clips_and_gets_its_status_bit() -> None:
    """theSkin fill(): clips at the limits, marks at twice the limits; PSK packs the mask."""
    bench = started()
    low, high = 15 << 2, 240 << 2
    codes = [high - 1, high, 2 * high - 1, 2 * high, -low + 1, -low, -2 * low + 1, -2 * low]
    for pad, code in enumerate(codes):
        bench.chips[0].set_capacitance_ff(pad, RESTING_FF + 0.36 * code)
    bench.run(0.05)
    values, status = bench.triangle(bench.run(0.05), 0)
    assert values[:8] == [1, 0, 0, 0, 255, 255, 255, 255]
    assert status == (1 << 3 | 1 << 7) << 4


def test_a_chip_absent_since_calibration_sends_constant_no_load_and_not_connected() -> None:
    """theSkin: base 0xFFFF and raw 0xFFFF cancel; only S1 tells."""
    bench = started(triangles=2)
    bench.run(0.01)
    frames = bench.run(0.05)
    assert bench.chips.keys() == {0}
    assert bench.triangle(frames, 1) == ([240] * 12, 0x0002)


def test_a_chip_lost_later_reads_as_full_pressure_and_not_connected() -> None:
    """theSkin: raw 0xFFFF against a real baseline; reference vector of the wire."""
    bench = started()
    bench.lines[0].line.refuse(0x2C, 0)
    bench.run(0.01)
    assert bench.triangle(bench.run(0.05), 0) == ([0] * 12, 0xFFF2)


def test_five_readings_without_acknowledge_rebaseline_the_whole_board() -> None:
    """theSkin fill(): errorcounter, never reset by good readings, forces a calibration."""
    bench = started()
    bench.run(0.01)
    for pad in range(12):
        # So little that the converter sees 0, as it does from a chip without a bus.
        bench.chips[0].set_capacitance_ff(pad, -3000.0)
    statuses = [bench.triangle(bench.run(0.05), 0)[1] for _ in range(6)]
    assert statuses == [0xFFF1] * 5 + [0]
    assert bench.triangle(bench.run(0.05), 0) == ([240] * 12, 0)


def test_every_enabled_triangle_is_sent_in_order_whether_it_answers_or_not() -> None:
    """theSkin tick(): TRG 0 to 15, A then B."""
    bench = started(triangles=16)
    frames = bench.run(0.05)
    assert [can_id for can_id, _ in frames] == [0x410 + i // 2 for i in range(32)]
    assert [data[0] for _, data in frames] == [0x40, 0xC0] * 16


def test_test_mode_sends_the_low_byte_of_the_raw_words() -> None:
    """theSkin fill(): skin type 7, status always 0."""
    bench = started(skin_type=7)
    raw = bench.board.chips.read()[0]
    values, status = bench.triangle(bench.run(0.05), 0)
    assert values == (raw & 0xFF).tolist()
    assert status == 0


@pytest.mark.parametrize(("skin_type", "gains"), [(0, GAIN), (8, GAIN_V2)])
def test_the_thermal_pad_takes_temperature_out_of_the_others(
    skin_type: int, gains: tuple[int, ...]
) -> None:
    """theSkin computedrift(): pad 6, ((dT >> 2) * gain) >> 5."""
    bench = started(skin_type=skin_type)
    bench.chips[0].set_capacitance_ff(6, RESTING_FF + 0.36 * 400)
    bench.run(0.05)
    values, _ = bench.triangle(bench.run(0.05), 0)
    drift = [(100 * gain) >> 5 for gain in gains]
    expected = [min(255, 240 - (-one >> 2)) for one in drift]
    expected[6] = 240 - (400 >> 2)
    assert values == expected


@pytest.mark.parametrize("model", ["mtb3", "mtb4", "mtb4c"])
@pytest.mark.parametrize("skin_type", [0, 1, 2, 3, 8])
def test_the_host_knows_what_each_firmware_makes_of_a_skin_type(
    model: Literal["mtb3", "mtb4", "mtb4c"], skin_type: Literal[0, 1, 2, 3, 8]
) -> None:
    """main: an MTB3 has gains for type 0 alone, and no map of an ergoCub hand."""
    bench = BoardOnBench(model)
    bench.run(0.15)
    bench.say(SetBoardConfig(skin_type, 50, 240))
    settings = Board(bus="can0", address=1, model=model, skin_type=skin_type)
    layout = BoardLayout("mtb", settings, (), 0, np.zeros((TRIANGLES, 12), np.int32), ())
    for triangle in range(TRIANGLES):
        gains, _ = thermal_gains(settings.effective_skin_type, triangle)
        assert bench.board.thermal(triangle)[0] == gains
        assert bench.board.slot(triangle) == slot_of(layout, triangle)


def test_palms_have_no_temperature_gains() -> None:
    """theSkin GAIN_PALM: all zero, so pad 11 changes nothing else."""
    bench = started(skin_type=1)
    bench.chips[0].set_capacitance_ff(11, RESTING_FF + 0.36 * 400)
    bench.run(0.05)
    assert bench.triangle(bench.run(0.05), 0)[0][:11] == [240] * 11


# ---------------------------------------------------------------------- arithmetic


def _one(
    raw: list[int], base: list[int], shift: int = 2, no_load: int = 240
) -> tuple[np.ndarray, ...]:
    twelve = np.array([raw + [0] * (12 - len(raw))], np.uint16)
    zero = np.array([base + [0] * (12 - len(base))], np.int32)
    return (
        twelve,
        zero,
        np.array([shift], np.int32),
        np.array([no_load], np.int32),
        np.zeros((1, 12), np.int32),
        np.array([6]),
    )


def test_a_jump_beyond_16_bits_clips_at_the_wrong_end_on_the_mtb3_only() -> None:
    """mtb3/main_V3.c: `value` is a 16-bit int; the MTB4 computes in 32 bits."""
    arguments = _one([60000], [20000])
    assert transmit_32(*arguments)[0][0, 0] == 0
    assert transmit_16(*arguments)[0][0, 0] == 255


def test_falling_temperature_rounds_differently_on_the_two() -> None:
    """theSkin negates before the last shift, mtb3/main_V3.c after it."""
    raw, base, shift, no_load, gain, pad = _one([1000] * 12, [1000] * 12, shift=0, no_load=128)
    raw[0, 6] = 1000 - 4
    gain[:] = 70
    assert transmit_32(raw, base, shift, no_load, gain, pad)[0][0, 0] == 128 - 3
    assert transmit_16(raw, base, shift, no_load, gain, pad)[0][0, 0] == 128 - 2


@given(
    arrays.arrays(np.uint16, (3, 12), elements=st.integers(12000, 28000)),
    arrays.arrays(np.int32, (3, 12), elements=st.integers(12000, 28000)),
    st.integers(0, 5),
    st.integers(1, 254),
)
def test_both_arithmetics_agree_where_nothing_wraps(
    raw: np.ndarray, base: np.ndarray, shift: int, no_load: int
) -> None:
    arguments = (
        raw,
        base,
        np.full(3, shift, np.int32),
        np.full(3, no_load, np.int32),
        np.zeros((3, 12), np.int32),
        np.full(3, 6),
    )
    for mine, other in zip(transmit_32(*arguments), transmit_16(*arguments), strict=True):
        assert (mine == other).all()


@given(
    arrays.arrays(np.uint16, (2, 12)),
    arrays.arrays(np.int32, (2, 12), elements=st.integers(0, 65535)),
    st.integers(0, 8),
    st.integers(0, 255),
    st.sampled_from([GAIN, GAIN_V2]),
)
def test_the_32_bit_arithmetic_is_that_of_the_source_taxel_by_taxel(
    raw: np.ndarray, base: np.ndarray, shift: int, no_load: int, gains: tuple[int, ...]
) -> None:
    values, status = transmit_32(
        raw,
        base,
        np.full(2, shift, np.int32),
        np.full(2, no_load, np.int32),
        np.tile(np.array(gains, np.int32), (2, 1)),
        np.full(2, 6),
    )
    for k in range(2):
        mask = 0
        dt = int(raw[k, 6]) - int(base[k, 6])
        for i in range(12):
            size = (abs(dt) >> 2) * gains[i]
            value = int(raw[k, i]) - int(base[k, i]) - ((size if dt > 0 else -size) >> 5)
            up, bottom = (255 - no_load) << shift, no_load << shift
            out = 255 if value <= -up else 0 if value >= bottom else no_load - (value >> shift)
            assert values[k, i] == out or (up == bottom == 0)
            mask |= (value <= -2 * up or value >= 2 * bottom) << i
        assert int(status[k]) >> 4 == mask


# ---------------------------------------------------------------------- commands


def test_the_board_is_silent_until_it_is_started() -> None:
    """theSkin: `ticking` is false until SET_TXMODE."""
    bench = BoardOnBench("mtb4")
    assert bench.run(1.0) == []
    bench.say(SetBoardConfig(2, 50, 240))
    assert bench.run(1.0) == []


def test_command_07_starts_with_0_and_stops_with_1() -> None:
    """theSkin set(SET_TXMODE)."""
    bench = started()
    assert len(bench.run(0.5)) == 20
    bench.say(STOP)
    assert bench.run(0.5) == []


def test_command_50_stops_the_stream() -> None:
    """theSkin configtriangles(): stop() where the board ticks; the host must start it again."""
    bench = started()
    bench.say(SetTriangleConfig(0, 0))
    assert bench.run(0.5) == []
    bench.say(START)
    assert len(bench.run(0.1)) == 4


def test_command_4d_disables_all_triangles() -> None:
    """theSkin set(SKIN_SET_BRD_CFG): activemask = 0; a running timer goes on."""
    bench = started()
    bench.say(SetBoardConfig(2, 50, 240))
    assert bench.run(0.5) == []
    assert bench.board.next_ns is not None


def test_command_4d_changes_the_period_of_a_running_board() -> None:
    """theSkin: stop and start with the new period."""
    bench = started()
    bench.say(SetBoardConfig(2, 200, 240))
    assert bench.board.period_ns == 200_000_000
    assert bench.board.next_ns == bench.t_ns + 200_000_000


def test_an_mtb4_takes_210_ms_without_wrapping() -> None:
    """theSkin: the period is in microseconds, 32 bits."""
    bench = BoardOnBench("mtb4")
    bench.say(SetBoardConfig(2, 210, 240))
    assert bench.board.period_ns == 210_000_000


@pytest.mark.parametrize("ends", [(3, 2), (0, 16), (200, 255)])
def test_command_50_with_a_wrong_range_is_ignored(ends: tuple[int, int]) -> None:
    """theSkin configtriangles(): start <= end < 16, else nothing happens, not even the stop."""
    bench = started()
    bench.say(SetTriangleConfig(*ends, flags=0))
    assert len(bench.run(0.5)) == 20


def test_shift_and_offset_are_taken_when_disabling_too() -> None:
    """theSkin configtriangles(): processed even if enabled is false."""
    bench = started()
    bench.say(SetTriangleConfig(0, 3, shift=5, flags=0, cdc_offset=0x2000))
    assert bench.board.shift[:5].tolist() == [5, 5, 5, 5, 2]
    assert bench.board.cdc_offset[:5].tolist() == [0x2000] * 4 + [0x2200]
    assert not bench.board.triangles[:4].any()


def test_after_a_new_cdc_offset_untouched_values_are_wrong_until_the_command_is_repeated() -> None:
    """icub-firmware threads 671, 678: the baseline is read before a new conversion."""
    bench = started()
    again = SetTriangleConfig(0, 0, cdc_offset=0x2000)
    for expected in (0, 240):
        bench.say(again)
        bench.run(0.1)
        bench.say(START)
        bench.run(0.05)
        assert bench.triangle(bench.run(0.05), 0)[0] == [expected] * 12
        bench.say(STOP)


def test_command_4c_starts_with_defaults_whatever_it_says() -> None:
    """PPO SKIN_OBSOLETE_TACT_SETUP: 40 ms, 0x2200; theSkin: defaults, calibrate, start."""
    bench = BoardOnBench("mtb4")
    bench.run(0.1)
    bench.say(TactileSetup(mode=0x21, decimation=3, timer_flag=3, cdc_offset=0x1000, timer=99))
    bench.run(0.1)
    bench.say(TactileSetup())
    frames = bench.run(0.4)
    assert len(frames) == 10 * 32
    assert bench.triangle(frames, 0) == ([245] * 12, 0)


def test_command_4c_gives_chips_its_cdc_offset_and_triangles_keep_their_shift() -> None:
    """theSkin set(SKIN_OBSOLETE_TACT_SETUP): each offset that differs is written."""
    bench = started()
    bench.say(SetTriangleConfig(0, 0, shift=4, cdc_offset=0x2000))
    bench.run(0.1)
    assert word_at(bench, 0x082) == 0x2000
    bench.say(TactileSetup())
    assert word_at(bench, 0x082) == 0x2200
    bench.run(0.1)
    # Its baseline is of before, as after command 50, until that is sent again.
    bench.say(TactileSetup())
    bench.chips[0].set_capacitance_ff(3, RESTING_FF + 0.36 * 160)
    bench.run(0.1)
    assert bench.triangle(bench.run(0.04), 0)[0][3] == 245 - (160 >> 4)


def test_a_board_hears_its_address_and_the_broadcast_from_anyone() -> None:
    """embot_prot_can.cpp frameis4board(): destination nibble only."""
    bench = started()
    for can_id in (0x202, 0x20E, 0x401, 0x501):
        assert bench.board.handle(can_id, b"\x07\x01", bench.t_ns) == []
        assert len(bench.run(0.1)) == 4
    bench.board.handle(0x23F, b"\x07\x01", bench.t_ns)
    assert bench.run(0.1) == []


def test_the_command_byte_is_masked_in_class_2() -> None:
    """embot_prot_can.cpp frame2cmd(): data[0] & 0x7F."""
    bench = started()
    bench.board.handle(0x201, b"\x87\x01", bench.t_ns)
    assert bench.run(0.1) == []


def test_versions_and_compatibility() -> None:
    """PPO GET_FW_VERSION: same major and own minor at least the wanted one."""
    for model, board_type, version in (("mtb4", 11, (1, 25, 0)), ("mtb4c", 20, (2, 4, 0))):
        bench = BoardOnBench(model)
        assert bench.say(Discover()) == [Discovered(board_type, *version)]
        for wanted, compatible in (((2, 0), 1), ((2, 1), 0), ((1, 0), 0)):
            assert bench.say(GetFirmwareVersion(*wanted)) == [
                FirmwareVersion(board_type, *version, 2, 0, compatible)
            ]


def test_a_discovery_is_answered_on_the_broadcast_with_the_boards_own_address() -> None:
    bench = BoardOnBench("mtb4", address=14)
    assert bench.board.handle(0x70F, b"\xff", 0) == [(0x7E0, bytes.fromhex("FF0B011900"))]


def test_an_mtb4_does_not_know_the_ping_of_the_mtb3() -> None:
    """theCANparserBasic: 04 is a command of the bootloader."""
    assert BoardOnBench("mtb4").say(Ping()) == []


@pytest.mark.parametrize("command", [SetBoardAddress(9), SetCanAddress(9)])
def test_a_new_address_is_used_at_once(command: commands.Message) -> None:
    """theCANparserBasic setcanaddress()."""
    bench = started()
    assert bench.say(command) == []
    assert {can_id for can_id, _ in bench.run(0.1)} == {0x490}


@pytest.mark.parametrize("address", [0, 15, 16, 200])
def test_an_impossible_address_is_refused(address: int) -> None:
    """theCANparserBasic setcanaddress(): never 0 nor 15."""
    bench = BoardOnBench("mtb4")
    bench.say(SetBoardAddress(address))
    assert bench.board.address == 1


def test_a_random_address_keeps_off_the_forbidden_ones() -> None:
    """theCANparserBasic setcanaddress(): FF, and the mask of addresses not wanted."""
    bench = BoardOnBench("mtb4")
    bench.say(SetCanAddress(0xFF, forbidden=0xFFFF & ~(1 << 6)))
    assert bench.board.address == 6
    bench.say(SetCanAddress(0xFF, forbidden=0xFFFF))
    assert bench.board.address == 6


def test_the_address_survives_a_reset_and_the_configuration_does_not() -> None:
    """The skin configuration is volatile; only the address is stored."""
    bench = started()
    bench.say(SetBoardAddress(9))
    bench.say(EnterBootloader())
    bench.run(2.0)
    assert bench.board.address == 9
    assert bench.board.next_ns is None
    assert bench.board.no_load == 245


def test_after_command_00_the_bootloader_answers_and_nothing_streams() -> None:
    """TSD management: discovery in the bootloader has DLC 4."""
    bench = started()
    bench.say(EnterBootloader())
    assert bench.run(0.2) == []
    assert bench.say(Discover()) == [DiscoveredBootloader(11, 1, 25)]
    bench.say(START)
    assert bench.run(0.2) == []
    bench.say(Ping())
    assert bench.say(Discover()) == [Discovered(11, 1, 25, 0)]


def test_additional_info_is_kept() -> None:
    bench = BoardOnBench("mtb4")
    text = b"left forearm, outer side".ljust(32)
    parts = [text[at : at + 4] for at in range(0, 32, 4)]
    for index, part in enumerate(parts):
        bench.say(SetAdditionalInfo(index, part))
    assert bench.say(GetAdditionalInfo()) == [
        AdditionalInfo(index, part) for index, part in enumerate(parts)
    ]


def test_time_of_life_counts_microseconds() -> None:
    bench = BoardOnBench("mtb4")
    bench.run(1.5)
    (answer,) = bench.say(GetTimeOfLife())
    assert isinstance(answer, TimeOfLife)
    assert answer.seconds == pytest.approx(1.5)


def test_an_ergo_hand_takes_its_chips_from_the_mapped_places() -> None:
    """theSkin altTrianglesOrder: TRG 4 is the first chip of the fifth line."""
    bench = BoardOnBench("mtb4", slots=(0, 4, 16), skin_type=3)
    bench.say(SetBoardConfig(3, 50, 240))
    bench.run(0.1)
    bench.say(SetTriangleConfig(0, 4))
    bench.run(0.1)
    bench.say(START)
    bench.run(0.06)
    bench.chips[16].set_capacitance_ff(0, RESTING_FF + 0.36 * 200)
    bench.chips[4].set_capacitance_ff(0, RESTING_FF + 0.36 * 100)
    bench.run(0.05)
    frames = bench.run(0.05)
    assert [bench.triangle(frames, number)[0][0] for number in (0, 1, 4)] == [240, 215, 190]


def test_an_ergo_hand_stores_the_shift_at_the_mapped_place_and_uses_the_plain_one() -> None:
    """theSkin: config[trianglesOrder[i]] is written, config[trg] limits the value."""
    bench = BoardOnBench("mtb4", slots=(0, 4), skin_type=3)
    bench.say(SetBoardConfig(3, 50, 240))
    bench.run(0.1)
    bench.say(SetTriangleConfig(0, 1))
    bench.run(0.1)
    bench.say(START)
    bench.run(0.1)
    bench.say(SetTriangleConfig(1, 1, shift=4))
    assert bench.board.shift[[1, 4]].tolist() == [2, 4]
    assert bench.board.shift_of(1) == 2


def test_garbage_changes_nothing() -> None:
    bench = started()
    rng = np.random.default_rng(0)
    for _ in range(500):
        can_id = int(rng.integers(0x800))
        data = rng.integers(0, 256, int(rng.integers(9))).astype(np.uint8).tobytes()
        if can_id & 0xF not in {1, 15}:
            assert bench.board.handle(can_id, data, bench.t_ns) == []
    for data in (b"", b"\x99", b"\x50"):
        bench.board.handle(0x201, data, bench.t_ns)
        bench.board.handle(0x701, data[:0], bench.t_ns)


def test_an_unknown_model_is_refused() -> None:
    with pytest.raises(ValueError, match="there are: mtb3, mtb4, mtb4c"):
        make_board("mtb5", 1, BoardOnBench("mtb4").board.chips)
