"""The MTB3 and its pitfalls. Sources: mtb3/main_V3.c (main) and mtb3/can_interface.c (CI3)
of icub-firmware."""

import pytest

from skin_host.bus.answers import (
    Discovered,
    DiscoveredBootloader,
    FirmwareVersion,
    PingAnswer,
    ResetAnswer,
)
from skin_host.bus.commands import (
    Discover,
    EnterBootloader,
    GetFirmwareVersion,
    Ping,
    SetBoardAddress,
    SetBoardConfig,
    SetTriangleConfig,
    SetTxMode,
    TactileSetup,
    TactileSetup2,
    TxMode,
    command_frame,
)
from tests.support.board import RESTING_FF, BoardOnBench

START = SetTxMode(TxMode.START)
BOOT_S = 0.15


def booted() -> BoardOnBench:
    bench = BoardOnBench("mtb3")
    assert bench.run(BOOT_S) == []
    return bench


def started(triangles: int = 1) -> BoardOnBench:
    bench = booted()
    bench.say(SetBoardConfig(2, 50, 240))
    bench.say(SetTriangleConfig(0, triangles - 1))
    bench.run(0.21)  # into the pause between two bursts
    return bench


def test_it_is_silent_after_power_up_though_all_triangles_are_enabled() -> None:
    """main: the timer's interrupt is disabled before the loop begins."""
    bench = booted()
    assert bench.board.triangles.all()
    assert bench.run(1.0) == []


def test_command_50_makes_it_send_by_itself_two_periods_later() -> None:
    """main, CALIB: `if (!transmission_was_enabled)` turns the stream on: tested inverted."""
    bench = booted()
    bench.say(SetBoardConfig(2, 50, 240))
    bench.say(SetTriangleConfig(0, 0))
    # A tick of the timer, then two periods of calibration.
    assert bench.run(0.15) == []
    assert len(bench.run(0.15)) == 6


def test_the_newest_frame_goes_first() -> None:
    """CI3: the transmit buffer is a stack of 20."""
    bench = started(triangles=3)
    bench.run(0.05)
    frames = bench.run(0.05)
    assert [(can_id, data[0]) for can_id, data in frames] == [
        (0x412, 0xC0),
        (0x412, 0x40),
        (0x411, 0xC0),
        (0x411, 0x40),
        (0x410, 0xC0),
        (0x410, 0x40),
    ]


def test_a_new_cdc_offset_takes_effect_before_the_baseline_is_taken() -> None:
    """main, CALIB: chips are written, one period passes, then they are read."""
    bench = started()
    bench.say(SetTriangleConfig(0, 0, cdc_offset=0x2000))
    bench.run(0.25)
    assert bench.triangle(bench.run(0.06), 0) == ([240] * 12, 0)


def test_it_falls_silent_after_any_frame_of_class_7() -> None:
    """CI3 CAN1_handleRx(): DisableIntT1 before the command is looked at."""
    for can_id, data in ((0x70F, b"\xff"), (0x701, b"\x04"), (0x70F, b"\x77")):
        bench = started()
        assert len(bench.run(0.2)) == 8
        bench.board.handle(can_id, data, bench.t_ns)
        assert bench.run(0.5) == []
        bench.say(START)
        assert len(bench.run(0.2)) >= 6


@pytest.mark.parametrize(
    "command", [SetTriangleConfig(0, 0), SetBoardConfig(2, 50, 240), TactileSetup(), START]
)
def test_what_brings_it_back_after_class_7(command: SetTxMode) -> None:
    """CI3: 50, 4D (while sending), 4C and 07 00 enable the timer again."""
    bench = started()
    bench.say(Discover())
    bench.say(command)
    assert bench.board.next_ns is not None


def test_it_does_not_hear_the_broadcast_of_class_2() -> None:
    """CI3 SetBoardCanFilter(): 0x2xN, 0x7xN and 0x7xF with the mask 0x70F."""
    bench = started()
    bench.board.handle(0x20F, b"\x07\x01", bench.t_ns)
    assert len(bench.run(0.2)) == 8
    assert bench.board.handle(0x70F, b"\xff", bench.t_ns) != []


def test_it_answers_whoever_asks() -> None:
    """CI3: IdTx takes the sender of the question as receiver."""
    bench = booted()
    ((can_id, _),) = bench.board.handle(0x731, b"\x04", bench.t_ns)
    assert can_id == 0x713


def test_the_command_byte_is_not_masked() -> None:
    """CI3: data[0] is taken as it is."""
    bench = started()
    bench.board.handle(0x201, b"\x87\x01", bench.t_ns)
    assert len(bench.run(0.2)) == 8


def test_a_short_command_acts_on_stale_bytes_of_the_mailbox() -> None:
    """CI3 CAN1_interruptRx(): datalen = 8 whatever the DLC was."""
    bench = started()
    bench.say(SetTriangleConfig(3, 5, shift=6, flags=1, cdc_offset=0x2100))
    bench.run(0.3)
    bench.board.handle(0x201, b"\x50\x01", bench.t_ns)
    assert bench.board.shift[:7].tolist() == [2, 6, 6, 6, 6, 6, 2]
    assert bench.board.cdc_offset[1] == 0x2100


def test_a_period_of_210_ms_wraps_to_a_third_of_a_millisecond() -> None:
    """CI3: (period * 625) >> 1 ticks of 3.2 us, kept in 16 bits."""
    bench = booted()
    bench.say(SetBoardConfig(2, 209, 240))
    assert bench.board.period_ns == 208_998_400
    bench.say(SetBoardConfig(2, 210, 240))
    assert bench.board.period_ns == 284_800


def test_commands_sent_during_a_calibration_run_in_reverse() -> None:
    """CI3: a receive stack read newest first; main: the loop blocks while it calibrates."""
    bench = booted()
    bench.say(SetTriangleConfig(0, 15))
    bench.run(0.06)
    bench.say(SetBoardConfig(2, 50, 240))
    bench.say(SetTriangleConfig(0, 3))
    bench.run(0.5)
    assert not bench.board.triangles.any()


def test_commands_sent_while_it_reads_and_sends_a_burst_run_in_reverse() -> None:
    """CI3 CAN1_handleRx(): called once in a turn of the loop, after the burst."""
    bench = started()
    while not bench.run(0.001):
        pass
    bench.say(SetBoardConfig(2, 50, 200))
    assert bench.say(GetFirmwareVersion(1, 0)) == []
    bench.say(SetTriangleConfig(0, 3))
    assert bench.board.no_load == 240
    # 3.4 ms for the chips and 0.1 ms for each of two frames.
    (answer, _), *_ = bench.run(0.004)
    assert answer == 0x210
    assert bench.board.no_load == 200
    assert not bench.board.triangles.any()


def test_only_four_commands_wait_and_the_last_one_is_replaced() -> None:
    """CI3 CAN1_interruptRx(): the index stops at 4 and the newest overwrites."""
    bench = booted()
    bench.say(SetTriangleConfig(0, 0))
    bench.run(0.06)
    for shift in range(6):
        bench.say(SetTriangleConfig(shift, shift, shift=7))
    bench.run(0.5)
    assert (bench.board.shift[:6] == 7).tolist() == [True, True, True, False, False, True]


def test_version_is_compatible_only_if_equal() -> None:
    """CI3 GET_FW_VERSION: exact equality of major and minor; 2.17.0, protocol 1.0."""
    bench = booted()
    for wanted, compatible in (((1, 0), 1), ((1, 1), 0), ((2, 0), 0)):
        assert bench.say(GetFirmwareVersion(*wanted)) == [
            FirmwareVersion(5, 2, 17, 0, 1, 0, compatible)
        ]
    assert bench.say(Discover()) == [Discovered(5, 2, 17, 0)]
    assert bench.say(Ping()) == [PingAnswer(1)]


def test_reset_is_acknowledged_and_executed_only_if_addressed() -> None:
    """CI3 ICUBCANPROTO_BL_BOARD."""
    bench = started()
    bench.board.handle(0x70F, b"\x00", bench.t_ns)
    bench.say(START)
    assert len(bench.run(0.21)) >= 6
    assert bench.say(EnterBootloader()) == [ResetAnswer(1)]
    bench.run(2.0)
    assert bench.board.no_load == 245


def test_in_its_bootloader_it_answers_discovery_and_obeys_nothing_until_that_is_ended() -> None:
    """TSD management: discovery in the bootloader has DLC 4; 04 ends it."""
    bench = started()
    bench.say(EnterBootloader())
    assert bench.say(Discover()) == [DiscoveredBootloader(5, 2, 17)]
    assert bench.board.handle(0x70F, b"\xff", bench.t_ns) == [(0x710, b"\xff\x05\x02\x11")]
    bench.say(START)
    assert bench.run(0.2) == []
    assert bench.say(Ping()) == []
    bench.run(BOOT_S)
    assert bench.say(Discover()) == [Discovered(5, 2, 17, 0)]


def test_not_connected_replaces_no_acknowledge() -> None:
    """main FillCanMessages8bit(): `error = error_notconnected` overwrites."""
    bench = started(triangles=2)
    bench.lines[0].line.refuse(0x2C, 0)
    bench.run(0.05)
    frames = bench.run(0.06)
    # The baseline is below 0x8000, so the 16-bit difference wraps and clips at the wrong end.
    assert bench.triangle(frames, 0) == ([255] * 12, 0xFFF2)
    assert bench.triangle(frames, 1) == ([240] * 12, 0x0002)


def test_five_bad_readings_make_it_silent_for_a_calibration() -> None:
    """main FillCanMessages8bit(): ERROR_COUNTER == 5 sets CALIB."""
    bench = started()
    for pad in range(12):
        # So little that the converter sees 0, as it does from a chip without a bus.
        bench.chips[0].set_capacitance_ff(pad, -3000.0)
    frames = bench.run(0.7)
    statuses = [data[7] & 0xF for _, data in frames if data[0] == 0xC0]
    assert statuses.count(1) == 5
    assert statuses[-1] == 0
    assert len(statuses) < 0.7 / 0.05 - 2


def test_data_frames_are_of_class_3_until_a_new_command_comes() -> None:
    """CI3: `new_configuration` is set by 4D, 50 and 07 00."""
    bench = booted()
    bench.say(TactileSetup(mode=0x01, decimation=1, cdc_offset=0x2200))
    frames = bench.run(0.3)
    assert {can_id >> 4 for can_id, _ in frames} == {0x31}
    assert bench.triangle(frames, 0) == ([245] * 12, 0)
    bench.say(START)
    assert {can_id >> 4 for can_id, _ in bench.run(0.2)} == {0x41}


def test_the_timer_word_of_4c_sets_the_period() -> None:
    """CI3: data[3] = 3 takes data[6..7], ticks of 3.2 us (0x3500 is 43.4 ms)."""
    bench = booted()
    bench.say(TactileSetup(mode=0x01, decimation=1, timer_flag=3, timer=0x3500))
    assert bench.board.period_ns == 0x3500 * 3200


@pytest.mark.parametrize(("mode", "n_values"), [(0x21, 1), (0x11, 3)])
def test_the_reduced_formats_send_one_short_frame_a_triangle(mode: int, n_values: int) -> None:
    """main FillCanMessages8bit_all and _three: class 3, around 244; all 16 triangles."""
    bench = booted()
    bench.say(TactileSetup(mode=mode, decimation=1, cdc_offset=0x3F00))
    frames = bench.run(0.4)[-16:]
    assert {can_id for can_id, _ in frames} == set(range(0x310, 0x320))
    own = next(data for can_id, data in frames if can_id == 0x310)
    assert own == bytes([0x40] + [244] * n_values)


def test_4e_sets_shifts_no_load_type_and_triangles_and_starts() -> None:
    """CI3 TACT_SETUP2."""
    bench = booted()
    bench.say(TactileSetup2(shift=3, no_load=200, flags=8, enabled=0x0005))
    frames = bench.run(0.3)
    assert {can_id & 0xF for can_id, _ in frames} == {0, 2}
    assert bench.triangle(frames, 0) == ([200] * 12, 0)
    bench.chips[0].set_capacitance_ff(0, RESTING_FF + 0.36 * 80)
    bench.run(0.06)
    assert bench.triangle(bench.run(0.06), 0)[0][0] == 200 - (80 >> 3)


def test_a_new_address_is_used_at_once() -> None:
    """CI3 SET_BOARD_ADX: stored, filters set anew."""
    bench = started()
    bench.say(SetBoardAddress(7))
    assert {can_id for can_id, _ in bench.run(0.2)} == {0x470}
    assert bench.board.handle(0x201, command_frame(START, 1)[1], bench.t_ns) == []
