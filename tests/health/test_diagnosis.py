"""What a record says of buses and broker becomes a fault with a sentence that mends it."""

import copy
from typing import Any

import pytest

from skin_host.bus.pair import PAIR
from skin_host.health.diagnosis import FoundFault, diagnose, named
from tests.support.fault_bench import FaultBench


def found(bench: FaultBench, lately: tuple[str, ...] = (), **changes: Any) -> dict[str, FoundFault]:
    """Faults by code of a record of the healthy hand with `changes`; `gained` by its bus."""
    record: Any = copy.deepcopy(bench.records["left_hand"])
    bus = record["buses"][0]
    if "bus_state" in changes:
        bus["state"] = changes.pop("bus_state")
    bus["last_second"] |= changes.pop("gained", {})
    return {fault.code: fault for fault in diagnose(record | changes, lately)}


@pytest.mark.parametrize(
    ("state", "code", "remedy"),
    [
        ("bus_off", "bus_off", "check wiring"),
        ("error_passive", "bus_errors", "termination"),
        ("down", "bus_down", "ip link set"),
        ("gone", "bus_gone", "plug the adapter in"),
    ],
)
def test_a_bus_that_does_not_work_is_named_with_its_remedy(
    calibrated: FaultBench, state: str, code: str, remedy: str
) -> None:
    assert code not in found(calibrated)
    fault = found(calibrated, bus_state=state)[code]
    assert fault.where == "can0"
    assert remedy in fault.sentence


def test_a_bus_that_cannot_be_opened_is_named_with_what_the_system_answers(
    calibrated: FaultBench,
) -> None:
    record: Any = copy.deepcopy(calibrated.records["left_hand"])
    why = "slcan /dev/ttyACM0: cannot be opened: no serial; mend it with: pip install 'x'"
    record["buses"][0] |= {"state": "gone", "unopened": why}
    fault = next(one for one in diagnose(record) if one.code == "bus_gone")
    assert f"is gone: {why}" in fault.sentence


@pytest.mark.parametrize(
    ("interface", "channel", "words"),
    [
        ("socketcan", "can0", "check its plug"),
        ("socketcan", "vcan0", "the emulator"),
        ("virtual", "x", "other work on this computer"),
        (PAIR, "5", "other work on this computer"),
    ],
)
def test_a_bus_of_an_emulated_robot_has_no_plug_to_check(
    calibrated: FaultBench, interface: str, channel: str, words: str
) -> None:
    record: Any = copy.deepcopy(calibrated.records["left_hand"])
    record["buses"][0] |= {"interface": interface, "channel": channel, "silent": True}
    assert words in next(one for one in diagnose(record) if one.code == "bus_silent").sentence


@pytest.mark.parametrize(
    ("gained", "code", "words"),
    [
        ({"dropped": 7}, "bus_drops", "lost 7 frames"),
        ({"overflows": 2, "error_frames": 2}, "bus_drops", "its controller, or the driver of that"),
        ({"dropped": 7, "overflows": 2}, "bus_drops", "second, and its controller, or the driver"),
        ({"error_frames": 3}, "bus_errors", "3 error frames"),
        ({"error_frames": 5, "overflows": 2}, "bus_errors", "3 error frames"),
        ({"wrong": 2}, "bus_bit_errors", "2 with a wrong header"),
        ({"other_load": 0.9}, "bus_babbling", "90%"),
    ],
)
def test_what_a_bus_lost_in_the_last_second_is_counted(
    calibrated: FaultBench, gained: dict[str, float], code: str, words: str
) -> None:
    assert words in found(calibrated, gained=gained)[code].sentence


def test_a_controller_that_loses_frames_is_no_fault_of_the_wiring(calibrated: FaultBench) -> None:
    """It reports each loss in an error frame. Termination and load of the bus were accused."""
    gained = {"overflows": 2, "error_frames": 2, "halves": 9}
    assert "bus_errors" not in found(calibrated, gained=gained)


def test_frames_that_were_lost_here_are_no_fault_of_the_bus(calibrated: FaultBench) -> None:
    record: Any = copy.deepcopy(calibrated.records["left_hand"])
    record["buses"][0]["last_second"]["halves"] = 9
    assert "bus_loses_frames" in {fault.code for fault in diagnose(record)}
    record["buses"][0]["lost_here"] = True
    assert "bus_loses_frames" not in {fault.code for fault in diagnose(record)}


def test_error_frames_of_a_bus_that_is_off_are_no_second_fault(calibrated: FaultBench) -> None:
    assert "bus_errors" not in found(calibrated, bus_state="bus_off", gained={"error_frames": 3})


OUTPUT = {"connected": True, "touches_dropped": 4}


@pytest.mark.parametrize(
    ("output", "lately", "code", "words"),
    [
        (OUTPUT | {"connected": False}, (), "broker_away", "not yet reached"),
        (OUTPUT | {"connected": False, "last_error": "refused"}, (), "broker_away", "refused"),
        (OUTPUT, ("touches_dropped",), "touches_dropped", "4 since the start"),
        (OUTPUT | {"withheld": ["a/frame", "b/frame"]}, (), "broker_rejects", "a/frame, b/frame"),
        (OUTPUT | {"unsubscribed": ["a/cmd/+"]}, (), "broker_withholds", "a/cmd/+"),
        (OUTPUT | {"name_taken": True}, (), "node_name_taken", "--node"),
    ],
)
def test_what_the_broker_does_not_take_is_reported(
    calibrated: FaultBench, output: dict[str, Any], lately: tuple[str, ...], code: str, words: str
) -> None:
    fault = found(calibrated, lately, output=output)[code]
    assert fault.where == "broker"
    assert words in fault.sentence


def test_a_broker_that_takes_everything_is_no_fault(calibrated: FaultBench) -> None:
    assert found(calibrated, output=OUTPUT).keys() == found(calibrated).keys()


def test_what_could_not_be_kept_is_named_with_the_reason(calibrated: FaultBench) -> None:
    fault = found(calibrated, unkept={"calibration": "disk full"})["state_not_kept"]
    assert fault.where == "calibration"
    assert "disk full" in fault.sentence
    assert "lost at a restart" in fault.sentence
    assert "calibrate" not in fault.sentence
    of_zeros = found(calibrated, unkept={"zeros": "disk full"})["state_not_kept"]
    assert of_zeros.sentence.endswith("look untouched; calibrate after the restart")


def test_a_part_that_is_disabled_has_no_other_faults_of_its_own(calibrated: FaultBench) -> None:
    assert "part_disabled" in found(calibrated, state="disabled", calibration=None)
    assert "part_not_calibrated" not in found(calibrated, state="disabled", calibration=None)
    assert "part_not_calibrated" in found(calibrated, calibration=None)


@pytest.mark.parametrize(
    ("gained", "code", "limit", "beyond"),
    [
        ("other_load", "bus_babbling", 0.4, 0.41),
        ("halves", "bus_loses_frames", 1, 2),
        ("wrong", "bus_bit_errors", 0, 1),
        ("dropped", "bus_drops", 0, 1),
    ],
)
def test_what_happens_on_a_bus_now_and_then_is_no_fault(
    calibrated: FaultBench, gained: str, code: str, limit: float, beyond: float
) -> None:
    assert code not in found(calibrated, gained={gained: limit})
    assert code in found(calibrated, gained={gained: beyond})


def test_one_pad_that_jumps_again_and_again_is_no_damage_of_its_bus(
    calibrated: FaultBench,
) -> None:
    record: Any = copy.deepcopy(calibrated.records["left_hand"])
    bus = record["buses"][0]
    bus["last_second"]["spikes"] = 3
    for pads, named_codes in ((1, set()), (2, {"bus_bit_errors"}), (9, {"bus_bit_errors"})):
        bus["spiked_pads"] = pads
        faults = {fault.code: fault for fault in diagnose(record)}
        assert faults.keys() & {"bus_bit_errors"} == named_codes
    assert "9 pads" in faults["bus_bit_errors"].sentence


@pytest.mark.parametrize(
    ("wanted_ms", "seen_ms", "jitter_ms", "codes"),
    [
        (40, 42.0, 2.4, set()),
        (40, 38.0, 0.0, set()),
        (40, 42.1, 0.0, {"board_period"}),
        (40, 37.9, 9.0, {"board_period"}),
        (40, 40.0, 2.5, {"board_jitter"}),
        (40, 80.0, None, set()),
        (40, None, 9.0, set()),
    ],
)
def test_a_board_may_be_off_by_a_twentieth_of_its_period_and_scatter_a_little_more(
    calibrated: FaultBench,
    wanted_ms: int,
    seen_ms: float | None,
    jitter_ms: float | None,
    codes: set[str],
) -> None:
    board = copy.deepcopy(calibrated.records["left_hand"]["boards"][0])
    board |= {"period_ms": wanted_ms, "period_seen_ms": seen_ms, "jitter_ms": jitter_ms}
    faults = found(calibrated, boards=[board])
    assert faults.keys() & {"board_period", "board_jitter"} == codes
    # Of one that has stopped, the last intervals mean nothing.
    assert "board_period" not in found(calibrated, boards=[board | {"alive": False}])


@pytest.mark.parametrize(
    ("thermal_units", "common_units", "coarsest_units", "words"),
    [
        (8.0, 1.5, 1.0, None),
        (-8.0, -1.5, 1.0, None),
        (8.1, 0.0, 1.0, "thermal pads read +8"),
        (-9.0, 9.0, 1.0, "thermal pads read -9"),
        (None, 1.5, 1.0, None),
        (None, 1.6, 1.0, "all read +1.6"),
        (None, -1.6, 1.0, "all read -1.6"),
        (0.0, 2.0, 1.0, "all read +2.0"),
        (None, -9.9, 1.0, "all read -9.9"),
        # What pressed all of it when it was zeroed has been lifted.
        (None, -14.9, 1.0, None),
        # Less than 1.5 units as they were sent is noise.
        (8.1, 3.0, 2.0, "thermal pads read +8"),
        (8.0, 3.0, 2.0, None),
        (None, -3.1, 2.0, "all read -3.1"),
        (-12.0, 0.0, 8.0, None),
        (-12.1, 0.0, 8.0, "thermal pads read -12"),
    ],
)
def test_a_temperature_that_has_changed_shows_in_the_thermal_pads_or_in_all(
    calibrated: FaultBench,
    thermal_units: float | None,
    common_units: float,
    coarsest_units: float,
    words: str | None,
) -> None:
    warmth = {
        "thermal_units": thermal_units,
        "common_units": common_units,
        "coarsest_units": coarsest_units,
    }
    fault = found(calibrated, warmth=warmth).get("part_temperature")
    assert (fault is None) == (words is None)
    assert fault is None or str(words) in fault.sentence
    assert "part_temperature" not in found(calibrated, warmth=None)


def of_lines(
    bench: FaultBench, faults: dict[int, str], fitted: range, skin_type: int = 0
) -> dict[str, set[str]]:
    """Places by code, where triangles of one board have faults."""
    record: Any = copy.deepcopy(bench.records["left_hand"])
    board = record["boards"][0] | {"fitted": list(fitted), "skin_type": skin_type}
    record["boards"] = [board]
    record["triangles"] = [
        {"board": board["name"], "triangle": triangle, "fault": fault}
        for triangle, fault in faults.items()
    ]
    places: dict[str, set[str]] = {}
    for fault in diagnose(record):
        places.setdefault(fault.code, set()).add(fault.where.removeprefix(board["name"] + "/"))
    return places


@pytest.mark.parametrize(
    ("skin_type", "lines"),
    [
        (0, [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11], [12, 13, 14, 15]]),
        (3, [[0, 10, 11, 12], [1, 13, 14, 15], [2, 5, 6, 7], [3, 8, 9]]),
    ],
)
def test_a_line_whose_chips_all_stopped_answering_is_shorted(
    calibrated: FaultBench, skin_type: int, lines: list[list[int]]
) -> None:
    """The chips of an ergoCub hand are wired in another order, one of them alone."""
    for number, line in enumerate(lines):
        dead = dict.fromkeys(line, "no ack") | {line[0]: "silenced"}
        places = of_lines(calibrated, dead, range(16), skin_type)
        assert places == {"line_shorted": {f"line{number}"}}
        one_lives = dict.fromkeys(line[1:], "no ack")
        places = of_lines(calibrated, one_lives, range(16), skin_type)
        assert places == {"triangle_no_ack": {str(triangle) for triangle in line[1:]}}
    # A line of one chip is a dead chip.
    alone = (range(4, 5), 0, 4) if skin_type == 0 else (range(16), 3, 4)
    assert of_lines(calibrated, {4: "no ack"}, *alone[:2]) == {"triangle_no_ack": {"4"}}


def test_two_lines_that_read_wrong_at_once_are_swapped_and_one_or_three_are_not(
    calibrated: FaultBench,
) -> None:
    def wrong(*lines: int, fault: str = "out of range") -> dict[str, set[str]]:
        faults = {4 * line + place: fault for line in lines for place in range(4)}
        return of_lines(calibrated, faults, range(16))

    assert wrong(0, 2) == {"lines_swapped": {"line0+2"}}
    assert wrong(1, 3) == {"lines_swapped": {"line1+3"}}
    assert wrong(0).keys() == wrong(0, 1, 2).keys() == {"triangle_out_of_range"}
    # A short is no second swap.
    faults = dict.fromkeys(range(4), "no ack") | dict.fromkeys(range(4, 12), "out of range")
    assert of_lines(calibrated, faults, range(16)) == {
        "line_shorted": {"line0"},
        "lines_swapped": {"line1+2"},
    }


def test_a_chip_at_the_address_of_another_is_suspected_where_both_read_wrong(
    calibrated: FaultBench,
) -> None:
    def sentence(faults: dict[int, str]) -> str:
        record: Any = copy.deepcopy(calibrated.records["left_hand"])
        name = record["boards"][0]["name"]
        record["triangles"] = [
            {"board": name, "triangle": triangle, "fault": fault}
            for triangle, fault in faults.items()
        ]
        return next(
            one.sentence for one in diagnose(record) if one.code == "triangle_not_connected"
        )

    assert "does it have this address" in sentence({1: "not connected", 2: "out of range"})
    assert "does it have this address" not in sentence({1: "not connected", 5: "out of range"})


@pytest.mark.parametrize(
    ("explained", "named_alone"),
    [
        ({}, "taxels 5-8"),
        ({"taxel_faults": {"noisy": [5, 6]}}, "taxels 7-8"),
        ({"taxel_faults": {"returned": [5, 6, 7, 8]}}, None),
        ({"taxel_verdicts": {"too_noisy": [8]}}, "taxels 5-7"),
        ({"taxel_verdicts": {"noisy": [8]}}, "taxels 5-8"),
        ({"taxel_verdicts": {"unreached": [5], "absent": [6, 7, 8]}}, None),
    ],
)
def test_pads_that_are_not_valid_for_no_reason_of_their_own_are_named_beside_those_with_one(
    calibrated: FaultBench, explained: dict[str, Any], named_alone: str | None
) -> None:
    changes = {"state": "degraded", "invalid": [5, 6, 7, 8], "decides_kpa": 2.0} | explained
    fault = found(calibrated, **changes).get("taxel_unproven")
    assert (None if fault is None else fault.sentence.partition(" of ")[0]) == named_alone
    board = calibrated.records["left_hand"]["boards"][0]["name"]
    changes["triangles"] = [{"board": board, "triangle": 0, "fault": "no ack"}]
    assert "taxel_unproven" not in found(calibrated, **changes)


def test_taxels_are_named_in_runs_and_no_more_than_eight_of_them() -> None:
    assert named([3]) == "taxel 3"
    assert named([9, 4, 5, 1, 6, 7]) == "taxels 1, 4-7, 9"
    eight = list(range(0, 16, 2))
    assert named(eight) == "taxels 0, 2, 4, 6, 8, 10, 12, 14"
    assert named([*eight, 16, 17]) == "taxels 0, 2, 4, 6, 8, 10, 12, 14, ... (10 in all)"


@pytest.mark.parametrize(
    ("sweeps", "code", "check"),
    [(0, "board_absent", "check power and address"), (9, "board_silent", "check its power")],
)
def test_a_board_that_a_full_bus_starves_is_not_blamed_alone(
    calibrated: FaultBench, sweeps: int, code: str, check: str
) -> None:
    record: Any = copy.deepcopy(calibrated.records["left_hand"])
    record["boards"][0] |= {"alive": False, "sweeps": sweeps, "awaited": False}
    sentences = {}
    for load in (0.94, 1.028):
        recent = {"load": load, "halves": 110}
        faults = found(calibrated, boards=record["boards"], gained=recent)
        sentences[load] = faults[code].sentence, faults["bus_loses_frames"].sentence
    board, bus = sentences[0.94]
    assert "full" not in board
    assert bus.endswith("110 in the last second; the bus is overloaded or badly terminated")
    board, bus = sentences[1.028]
    assert "; its bus is full (load 103%), and lower addresses go first: have less" in board
    assert board.endswith(check)
    assert bus.endswith("110 in the last second; the bus is overloaded: its load is 103%")
