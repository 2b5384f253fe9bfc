"""Every fault of the emulator's catalogue is told by its right name, all but one in a second.

`python -m tests.support.fault_times` measures how soon, in many places each.
"""

from typing import Any

import numpy as np
import pytest

from emulator.faults import KINDS
from skin_host.health.diagnosis import diagnose
from tests.support.fault_bench import FaultBench
from tests.support.fault_matrix import bench_of

HERE = {"board": "forearm_outer", "triangle": 3}
#: What happens -> what must be told, and which taxels of the forearm must not be believed.
FAULTS: list[tuple[str, dict[str, Any], str, range]] = [
    ("chip_gone", HERE, "triangle_not_connected", range(36, 48)),
    ("chip_gone", HERE | {"value": 0}, "triangle_no_ack", range(36, 48)),
    ("chip_gone", HERE | {"value": 0x8000}, "triangle_out_of_range", range(36, 48)),
    ("stuck_taxel", HERE | {"taxel": 7}, "taxel_stuck", range(43, 44)),
    ("noisy_taxel", HERE | {"taxel": 4}, "taxel_noisy", range(40, 41)),
    ("shorted_finger", HERE, "line_shorted", range(48)),
    ("wrong_address", HERE | {"value": 0}, "triangle_not_connected", range(36, 48)),
    ("swapped_lines", HERE, "lines_swapped", range(96)),
    ("shared_address", HERE | {"value": 0}, "triangle_not_connected", range(36, 48)),
    ("no_acknowledge", HERE, "triangle_no_ack", range(36, 48)),
    ("data_held_low", HERE, "triangle_no_ack", range(48)),
    ("clock_stretched", HERE, "triangle_out_of_range", range(36, 48)),
    ("bit_flipped", HERE, "taxel_out_of_range", range(0)),
    ("slow_rise", HERE, "taxel_out_of_range", range(0)),
    ("brown_out", HERE, "triangle_no_ack", range(36, 48)),
    ("board_reset", {"board": "forearm_outer"}, "board_silent", range(192)),
    ("board_silent", {"board": "forearm_outer"}, "board_silent", range(192)),
    ("late_period", {"board": "forearm_outer"}, "board_period", range(0)),
    ("jittered_period", {"board": "forearm_inner"}, "board_jitter", range(0)),
    ("frame_loss", {"bus": "can0"}, "bus_loses_frames", range(0)),
    ("bit_errors", {"bus": "can0", "value": 0.01}, "bus_bit_errors", range(0)),
    ("bus_off", {"bus": "can0"}, "bus_silent", range(288)),
    ("babbling_node", {"bus": "can0"}, "bus_babbling", range(0)),
    ("temperature_step", {}, "part_temperature", range(0)),
]


def test_the_list_has_every_fault_of_the_catalogue() -> None:
    of_fingertips = {name for name, kind in KINDS.items() if kind.on == "fingertip"}
    assert {name for name, *_ in FAULTS} | {"chip_back"} == KINDS.keys() - of_fingertips


def test_a_healthy_robot_is_accused_of_nothing(bench: FaultBench) -> None:
    bench.run(20.0)
    assert bench.first_told == {}
    assert bench.records["left_forearm"]["state"] == "ok"
    assert bench.records["left_forearm"]["sentences"] == []


@pytest.mark.parametrize(("name", "arguments", "code", "doubted"), FAULTS)
def test_a_fault_is_named_in_time(
    bench: FaultBench, name: str, arguments: dict[str, Any], code: str, doubted: range
) -> None:
    bench.inject(name, **arguments)
    # Chance lets single pads repeat themselves, or read little noise, for longer than that: see
    # `processing.stuck` and the table of times in docs/operations.md.
    bench.run({"stuck_taxel": 8.0, "noisy_taxel": 2.0}.get(name, 1.0))
    told = {told for told, _ in bench.first_told}
    assert code in told
    assert not bench.valid["left_forearm"][list(doubted)].any()
    assert not bench.touched["left_forearm"][list(doubted)].any()


def test_readings_that_come_and_go_are_of_a_bad_wire_and_not_of_a_press_that_lifts() -> None:
    bench = bench_of("mtb4", "chip", touched=False)
    bench.inject("slow_rise", board="one", triangle=3)
    bench.run(0.4)
    assert "taxel_out_of_range" in {told for told, _ in bench.first_told}


@pytest.mark.parametrize("value_ff", [None, 40.0])
def test_a_chip_whose_results_all_stand_still_is_frozen_within_a_second(
    bench: FaultBench, value_ff: float | None
) -> None:
    for taxel in range(12):
        bench.inject("stuck_taxel", **HERE, taxel=taxel, value=value_ff)
    bench.run(1.0)
    assert ("triangle_frozen", "forearm_outer/3") in bench.told
    assert not bench.valid["left_forearm"][36:48].any()
    assert not bench.touched["left_forearm"][36:48].any()


def test_a_chip_that_comes_back_is_believed_again(bench: FaultBench) -> None:
    bench.inject("chip_gone", **HERE)
    bench.run(1.0)
    bench.inject("chip_back", **HERE)
    bench.run(1.0)
    assert bench.told == {}
    pressure = [taxel for taxel in range(36, 48) if taxel not in (42, 46)]
    assert bench.valid["left_forearm"][pressure].all()


def test_a_chip_that_died_and_was_zeroed_away_is_never_believed_again(bench: FaultBench) -> None:
    """The board sends its constant without an error, as if the triangle were untouched."""
    bench.inject("chip_gone", **HERE, value=0)
    bench.run(10.0)
    assert bench.status("forearm_outer")[3] == 0
    assert not bench.valid["left_forearm"][36:48].any()
    assert ("triangle_silenced", "forearm_outer/3") in bench.told
    others = np.delete(bench.valid["left_forearm"][:192], range(36, 48))
    assert np.count_nonzero(others) >= 145


def test_a_chip_that_was_dead_before_the_calibration_is_not_calibrated_as_untouched(
    bench: FaultBench,
) -> None:
    bench.inject("chip_gone", **HERE, value=0)
    bench.run(5.0)
    bench.calibrate(5.0)
    bench.run(2.0)
    assert not bench.valid["left_forearm"][36:48].any()
    told = {code for code, _ in bench.told}
    assert told & {"triangle_silenced", "triangle_constant", "triangle_frozen"}


def test_a_taxel_that_the_calibration_refused_is_told(bench: FaultBench) -> None:
    record = bench.records["left_hand"]
    refused = record | {"taxel_verdicts": {"out_of_range": [5, 6], "noisy": [7]}, "invalid": [5, 7]}
    faults = {fault.code: fault for fault in diagnose(refused)}
    assert faults["taxel_refused"].where == "left_hand"
    assert "taxel 5 of left_hand" in faults["taxel_refused"].sentence


def test_who_reads_that_a_pad_is_stuck_is_not_asked_to_calibrate_it(bench: FaultBench) -> None:
    """A calibration leaves it out, so what the last one found of it would stand for ever."""
    record = bench.records["left_hand"] | {"taxel_verdicts": {"touched": [5, 6]}}
    stuck = record | {"taxel_faults": {"stuck": [5]}, "invalid": [5]}
    faults = {fault.code: fault for fault in diagnose(stuck)}
    assert faults["taxel_stuck"].sentence.startswith("taxel 5 of left_hand")
    assert faults["taxel_pressed"].sentence.startswith("taxel 6 of left_hand")
    stuck = record | {"taxel_faults": {"stuck": [5, 6]}, "invalid": [5, 6]}
    assert "taxel_pressed" not in {fault.code for fault in diagnose(stuck)}


def test_the_new_zero_of_a_board_is_found_by_itself(bench: FaultBench) -> None:
    """The zero is one noisy snapshot; without finding it anew some taxels would be touched."""
    bench.inject("chip_gone", **HERE, value=0)
    bench.run(6.0)
    assert ("board_rezeroed", "forearm_outer") in bench.told
    touched = np.zeros(288)
    for _ in range(40):
        bench.run(0.05)
        touched += bench.touched["left_forearm"]
    assert touched.max() <= 4


def test_one_reset_board_leaves_the_others_alone(bench: FaultBench) -> None:
    bench.inject("board_reset", board="hand")
    bench.run(2.0)
    assert bench.valid["left_forearm"].sum() == 240
    assert not bench.valid["left_hand"].any()
    assert {where for _, where in bench.told} == {"hand"}
