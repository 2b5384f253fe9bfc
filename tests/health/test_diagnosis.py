"""What a record says of buses and broker becomes a fault with a sentence that mends it."""

import copy
from typing import Any

import pytest

from skin_host.bus.pair import PAIR
from skin_host.health.diagnosis import FoundFault, diagnose
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
        ({"error_frames": 3}, "bus_errors", "3 error frames"),
        ({"wrong": 2}, "bus_bit_errors", "2 with a wrong header"),
        ({"other_load": 0.9}, "bus_babbling", "90%"),
    ],
)
def test_what_a_bus_lost_in_the_last_second_is_counted(
    calibrated: FaultBench, gained: dict[str, float], code: str, words: str
) -> None:
    assert words in found(calibrated, gained=gained)[code].sentence


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


def test_a_part_that_is_disabled_has_no_other_faults_of_its_own(calibrated: FaultBench) -> None:
    assert "part_disabled" in found(calibrated, state="disabled", calibration=None)
    assert "part_not_calibrated" not in found(calibrated, state="disabled", calibration=None)
    assert "part_not_calibrated" in found(calibrated, calibration=None)
