"""What health reports is about now: each fault that can come also goes when its cause has gone.

Or it lasts until somebody does what its sentence, or docs/operations.md, asks for: `LASTING`.
"""

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from emulator.probes.scene import Place, Probe, Scene
from skin_host.bus.boards import Boards
from skin_host.bus.port import LinkState, PortCounters
from skin_host.bus.wire import FrameBatch
from skin_host.health import LATELY_NS, HealthWatch
from skin_host.processing.calibration import Verdict
from skin_host.processing.core import Engine
from tests.support.fault_bench import FaultBench
from tests.support.fault_matrix import bench_of

PAGE = (Path(__file__).parents[2] / "docs/operations.md").read_text()
HERE: dict[str, Any] = {"board": "forearm_outer", "triangle": 3}
CAN0 = {"bus": "can0"}
S = 1_000_000_000
#: What happens to the robot -> what is reported of it. By when it is over once it is mended, in
#: seconds: pads must prove themselves, and health holds what comes and goes for 3 s, after the 10 s
#: in which two pads damaged by a bus were seen.
ROBOT: list[tuple[str, dict[str, Any], str, float]] = [
    ("bus_off", CAN0, "bus_silent", 1.0),
    ("babbling_node", CAN0, "bus_babbling", 6.0),
    ("frame_loss", CAN0, "bus_loses_frames", 6.0),
    ("bit_errors", CAN0 | {"value": 0.01}, "bus_bit_errors", 15.0),
    ("board_silent", {"board": "forearm_outer"}, "board_silent", 1.0),
    ("late_period", {"board": "forearm_outer"}, "board_period", 6.0),
    ("jittered_period", {"board": "forearm_inner"}, "board_jitter", 6.0),
    ("chip_gone", HERE, "triangle_not_connected", 3.0),
    ("no_acknowledge", HERE, "triangle_no_ack", 3.0),
    ("chip_gone", HERE | {"value": 0x8000}, "triangle_out_of_range", 3.0),
    ("shorted_finger", HERE, "line_shorted", 3.0),
    ("swapped_lines", HERE, "lines_swapped", 3.0),
    ("stuck_taxel", HERE | {"taxel": 7}, "taxel_stuck", 6.0),
    ("stuck_taxel", HERE | {"taxel": 7, "value": 900.0}, "taxel_out_of_range", 6.0),
    ("noisy_taxel", HERE | {"taxel": 4}, "taxel_noisy", 15.0),
    ("temperature_step", {}, "part_temperature", 6.0),
]


@pytest.mark.parametrize(("name", "arguments", "code", "within_s"), ROBOT)
def test_a_fault_of_the_robot_is_over_when_it_is_mended(
    bench: FaultBench, name: str, arguments: dict[str, Any], code: str, within_s: float
) -> None:
    mend = bench.inject(name, **arguments)
    while code not in {told for told, _ in bench.first_told}:
        bench.run(0.2)
        assert bench.t_s < 40.0
    mend()
    bench.run(within_s)
    assert code not in {told for told, _ in bench.told}


@pytest.mark.parametrize("model", ["mtb3", "mtb4"])
def test_a_chip_that_has_lost_its_set_up_is_named_as_such_and_none_of_its_pads_stays_valid(
    model: str,
) -> None:
    """It converts one pad and reads as untouched on the others."""
    bench = bench_of(model, "signal", touched=False)
    bench.inject("brown_out", board="one", triangle=3)
    bench.run(12.0)
    assert not bench.valid["skin"][36:48].any()
    record = bench.records["skin"]
    assert ("triangle_frozen", "one/3") in bench.told
    assert "stuck" not in record["taxel_faults"]
    (sentence,) = (one for one in record["sentences"] if "triangle 3 of board one" in one)
    assert "switch the board off and on" in sentence


def test_a_chip_that_answers_again_is_not_told_to_be_silent_but_to_need_a_set_up(
    bench: FaultBench,
) -> None:
    """What its board took for its zero meanwhile was none, so its pads read far out of range."""
    mend = bench.inject("shorted_finger", **HERE)
    bench.run(3.0)
    assert ("line_shorted", "forearm_outer/line0") in bench.told
    assert "taxel_unproven" not in {code for code, _ in bench.first_told}
    mend()
    bench.run(1.0)
    assert "line_shorted" not in {code for code, _ in bench.told}
    assert ("triangle_answers_again", "forearm_outer/3") in bench.told
    (says, *_) = (one for one in bench.records["left_forearm"]["sentences"] if "again," in one)
    assert "skin command configure --board forearm_outer" in says
    assert not bench.valid["left_forearm"][36:48].any()


#: What is counted within a minute, or held up to an hour, is over then: see `LATELY_NS`.
_OUTPUT: dict[str, Any] = {
    "connected": True,
    "touches_dropped": 0,
    "refused": 0,
    "last_error": "",
    "withheld": [],
    "unsubscribed": [],
    "name_taken": False,
}
#: What the publisher counts -> what is reported, and what it counts when that is over. Publications
#: are withheld for `trials.HOLD_S`, a name counts as taken for a minute.
OUTPUT: list[tuple[dict[str, Any], str, dict[str, Any]]] = [
    ({"connected": False}, "broker_away", {}),
    ({"refused": 1}, "broker_refuses", {"refused": 1}),
    ({"withheld": ["a/frame"]}, "broker_rejects", {}),
    ({"unsubscribed": ["a/cmd/+"]}, "broker_withholds", {}),
    ({"touches_dropped": 1}, "touches_dropped", {"touches_dropped": 1}),
    ({"name_taken": True}, "node_name_taken", {}),
]
#: As the ports report: state of the link, gains -> what is reported.
PORTS: list[tuple[LinkState, dict[str, int], str]] = [
    (LinkState.BUS_OFF, {}, "bus_off"),
    (LinkState.ERROR_PASSIVE, {}, "bus_errors"),
    (LinkState.UP, {"error_frames": 3}, "bus_errors"),
    (LinkState.DOWN, {}, "bus_down"),
    (LinkState.GONE, {}, "bus_gone"),
    (LinkState.UP, {"dropped": 3}, "bus_drops"),
    (LinkState.UP, {"controller_overflows": 1, "error_frames": 1}, "bus_drops"),
]
#: Counters of the ledger -> what is reported, for a minute.
EVENTS = {
    "resets": "board_reset",
    "lost_set_ups": "board_lost_set_up",
    "rezeros": "board_rezeroed",
    "tx_overflows": "board_overflows",
}
#: What lasts -> the command that ends it.
LASTING = {
    "board_in_doubt": "calibrate",
    "part_disabled": "enable",
    "part_not_calibrated": "calibrate",
    "state_not_kept": "repeat the command",
    "taxel_at_limit": "calibrate",
    "taxel_decides_late": "calibrate",
    "taxel_drifting": "calibrate",
    "taxel_pressed": "calibrate",
    "taxel_refused": "calibrate",
    "taxel_saturates": "configure, calibrate",
    "taxel_unproven": "calibrate",
    "taxel_unreached": "thresholds",
    "triangle_answers_again": "configure",
    "triangle_constant": "calibrate",
    "fingertip_noisy": "calibrate",
    "fingertip_not_calibrated": "calibrate",
}
#: Codes that other tests begin and end.
ELSEWHERE = {
    "board_absent": "tests/daemon/test_daemon_boards.py",
    "board_in_bootloader": "tests/bus/test_boards.py",
    "board_twice": "tests/health/test_honest.py",
    "board_wrong_model": "tests/bus/test_boards.py",
    "board_wrong_type": "tests/bus/test_boards.py",
    "bus_stranger": "tests/bus/test_boards.py",
    "host_stalls": "tests/health/test_honest.py",
    "taxel_returned": "tests/health/test_taxels.py",
    "fingertip_absent": "tests/fingertip/test_boards.py",
    "fingertip_frozen": "tests/fingertip/test_boards.py",
    "fingertip_held": "tests/fingertip/test_boards.py",
    "fingertip_incomplete": "tests/fingertip/test_boards.py",
    "fingertip_loses_frames": "tests/fingertip/test_boards.py",
    "fingertip_not_configured": "tests/fingertip/test_boards.py",
    "fingertip_period": "tests/fingertip/test_boards.py",
    "fingertip_pressed": "tests/fingertip/test_boards.py",
    "fingertip_saturated": "tests/fingertip/test_boards.py",
    "fingertip_scale": "tests/fingertip/test_boards.py",
    "fingertip_silent": "tests/fingertip/test_boards.py",
    "fingertip_twice": "tests/fingertip/test_boards.py",
    "fingertip_unreached": "tests/fingertip/test_boards.py",
}
#: Codes of tests below.
BELOW = {"taxel_held", "triangle_frozen", "triangle_missing", "triangle_silenced"}


def test_no_code_is_left_out() -> None:
    table = PAGE.partition("### What each fault means")[2].split("\n\n")[1]
    rows = (line.split("|")[1] for line in table.splitlines() if line.startswith("| `"))
    codes = {code for row in rows for code in re.findall("`([a-z]+_[a-z_]+)`", row)}
    tested = {code for *_, code, _ in ROBOT} | {code for _, _, code in PORTS}
    tested |= {code for _, code, _ in OUTPUT} | set(EVENTS.values())
    tested |= set(LASTING) | set(ELSEWHERE) | BELOW
    assert codes == tested


def codes(health: HealthWatch, now_ns: int, **given: Any) -> set[str]:
    """What is reported at a time; given: ports, boards, output, unkept."""
    ports, boards = given.pop("ports", {}), given.pop("boards", {})
    health.tick(now_ns, ports, boards)
    record = health.record(0, now_ns, ports, boards, **given)
    return {fault["code"] for fault in record.get("faults", [])}


@pytest.mark.parametrize(("counted", "code", "over"), OUTPUT)
def test_a_fault_of_the_output_is_over_when_it_was_long_ago(
    calibrated: FaultBench, counted: dict[str, Any], code: str, over: dict[str, Any]
) -> None:
    health, now_ns = HealthWatch(calibrated.engine), calibrated.now_ns
    assert code not in codes(health, now_ns, output=_OUTPUT)
    assert code in codes(health, now_ns, output=_OUTPUT | counted)
    assert code not in codes(health, now_ns + LATELY_NS + 1, output=_OUTPUT | over)


class Seen:
    """What health reads of a port."""

    stamps_late = False
    unopened = ""

    def __init__(self) -> None:
        self.state = LinkState.UP
        self.counters = PortCounters()


@pytest.mark.parametrize(("state", "gains", "code"), PORTS)
def test_a_fault_of_a_port_is_over_when_it_works(
    calibrated: FaultBench, state: LinkState, gains: dict[str, int], code: str
) -> None:
    health, port = HealthWatch(calibrated.engine), Seen()
    ports: Any = {"can0": port}
    now_ns = calibrated.now_ns
    assert code not in codes(health, now_ns, ports=ports)
    port.state = state
    for name, gain in gains.items():
        setattr(port.counters, name, gain)
    assert code in codes(health, now_ns + S // 10, ports=ports)
    port.state = LinkState.UP
    seen = [codes(health, now_ns + n * S // 10, ports=ports) for n in range(2, 60)]
    assert code not in seen[-1]


def second_of(
    frame: tuple[int, bytes], n: int, parts: list[int] | None = None, **counted: int
) -> tuple[set[str], Any]:
    """What is reported, and the record, after a second in which a bus brought so many frames; of a
    node that reads some parts only.
    """
    bench, port = FaultBench(3.0), Seen()
    if parts is not None:
        bench.engine = Engine(bench.engine.settings, bench.layout, parts)
        bench.health = HealthWatch(bench.engine)
    layout, ledger = bench.layout, bench.engine.ledger
    ports: Any = {"can0": port}
    assembler = bench.engine.assemblers["can0"]
    boards: Any = {
        "can0": Boards(
            "can0",
            Silent(),
            [(i, layout.boards[i]) for i in bench.engine.boards],
            layout.triangles,
            ledger,
            unconfigured=assembler.unconfigured,
        )
    }
    codes(bench.health, bench.now_ns, ports=ports, boards=boards)
    for number in range(n // 100):
        t_ns = bench.now_ns + number * S * 100 // n
        bench.engine.feed("can0", FrameBatch.of([(*frame, t_ns)] * 100))
    for name, gain in counted.items():
        setattr(port.counters, name, gain)
    now_ns = bench.now_ns + S
    bench.health.tick(now_ns, ports, boards)
    record = bench.health.record(0, now_ns, ports, boards)
    return {fault["code"] for fault in record["faults"]}, record


def test_reports_of_the_controller_take_nothing_of_its_bus() -> None:
    """A controller may report some thousand errors a second, of which no other node sends one."""
    error = (0x20000008, bytes(8))
    reported, record = second_of(error, 5000, error_frames=5000)
    assert "bus_errors" in reported
    assert "bus_babbling" not in reported
    assert record["buses"][0]["last_second"]["load"] == 0.0


def test_boards_of_another_node_do_not_fill_their_bus() -> None:
    """A node with one board beside six of another node sent its operator to look for them."""
    # Part 0 is the hand at address 14; this is triangle 3 of the forearm, at 13.
    reported, record = second_of((0x4D3, b"\x40" + bytes(7)), 5000, parts=[0])
    assert "bus_babbling" not in reported
    recent = record["buses"][0]["last_second"]
    assert (recent["load"], recent["other_load"]) == (0.605, 0.0)


def test_a_board_that_is_not_configured_and_fills_its_bus_is_named() -> None:
    """Only frames that are not of skin were frames of others: the boards behind it were blamed."""
    reported, record = second_of((0x413, b"\x40" + bytes(7)), 5000)
    assert "bus_babbling" in reported
    (sentence,) = (one for one in record["sentences"] if "other devices" in one)
    assert "60% of it, mostly with identifier 0x410-0x41f" in sentence
    # Of a few frames of it among many of others, the others are named.
    reported, record = second_of((0x123, bytes(8)), 5000)
    (sentence,) = (one for one in record["sentences"] if "other devices" in one)
    assert "mostly with identifier 0x123" in sentence


@pytest.mark.parametrize(("counter", "code"), EVENTS.items())
def test_what_happened_to_a_board_is_told_for_a_minute(counter: str, code: str) -> None:
    bench = FaultBench(3.0)
    layout, ledger = bench.layout, bench.engine.ledger
    boards: Any = {
        "can0": Boards("can0", Silent(), list(enumerate(layout.boards)), layout.triangles, ledger)
    }
    assert code not in codes(bench.health, bench.now_ns, boards=boards)
    getattr(ledger, counter)[0] += 1
    now_ns = bench.now_ns + S // 10
    assert code in codes(bench.health, now_ns, boards=boards)
    assert code in codes(bench.health, now_ns + LATELY_NS - S, boards=boards)
    assert code not in codes(bench.health, now_ns + LATELY_NS + S // 10, boards=boards)


class Silent:
    """A bus on which nothing is sent."""

    async def send(self, frames: Iterable[tuple[int, bytes]], gap_s: float = 0.0) -> None:
        raise AssertionError("nothing is to be sent")


def test_verdicts_of_a_calibration_last_until_a_better_one(bench: FaultBench) -> None:
    known = bench.engine.calibration
    assert known is not None
    verdict = known.verdict.copy()
    verdict[[1, 2, 3, 4]] = Verdict.NOISY, Verdict.SATURATES, Verdict.TOUCHED, Verdict.OUT_OF_RANGE
    bench.engine.use(replace(known, verdict=verdict))
    bench.run(1.0)
    lasting = {"taxel_decides_late", "taxel_saturates", "taxel_pressed", "taxel_refused"}
    assert lasting <= {code for code, _ in bench.told}
    bench.calibrate(5.0)
    bench.run(3.0)
    assert not lasting & {code for code, _ in bench.told}


def test_a_part_without_a_calibration_or_disabled_is_told_until_it_is_not(
    bench: FaultBench,
) -> None:
    bench.engine.disabled.add(0)
    assert "part_disabled" in codes(bench.health, bench.now_ns)
    bench.engine.disabled.clear()
    bench.run(0.5)
    assert bench.told == {}
    known, bench.engine.calibration = bench.engine.calibration, None
    assert known is not None
    assert "part_not_calibrated" in codes(bench.health, bench.now_ns)
    bench.engine.use(known)
    bench.run(1.0)
    assert "part_not_calibrated" not in {code for code, _ in bench.told}


def test_what_could_not_be_kept_is_told_until_it_could(bench: FaultBench) -> None:
    unkept = {"calibration": "disk full"}
    assert "state_not_kept" in codes(bench.health, bench.now_ns, unkept=unkept)
    assert codes(bench.health, bench.now_ns + S // 10, unkept={}) == set()


def test_a_touch_that_hid_a_zero_is_over_when_it_is(tmp_path: Path) -> None:
    press = Probe(
        part="left_forearm",
        at=Place(taxel=27),
        diameter_mm=3,
        pressure_kpa=[(0, 0), (0.2, 100), (6.0, 100), (6.2, 0)],
        start_s=10.0,
    )
    bench = FaultBench(3.0, Scene(quiet=True, spread=False, probe=[press]), settle_s=4.0)
    bench.reload({"processing.drift.frozen_report_s": 3.0})
    bench.run(15.0 - bench.t_s)
    assert ("taxel_held", "left_forearm") in bench.told
    bench.run(10.0)
    assert ("taxel_held", "left_forearm") not in bench.told


def test_drift_that_can_follow_no_farther_is_told_until_calibrated(bench: FaultBench) -> None:
    bench.reload({"processing.drift.limit_units": 2.0})
    bench.inject("temperature_step", value=2.0)
    bench.run(6.0)
    bench.inject("temperature_step", value=3.0)
    while "taxel_at_limit" not in {code for code, _ in bench.told}:
        bench.run(1.0)
        assert bench.t_s < 120.0
    bench.calibrate(5.0)
    bench.run(0.5)
    assert "taxel_at_limit" not in {code for code, _ in bench.told}


@pytest.mark.parametrize("code", ["triangle_frozen", "triangle_silenced"])
def test_a_triangle_whose_bytes_stood_still_is_told_until_they_change(
    bench: FaultBench, code: str
) -> None:
    if code == "triangle_frozen":
        mends = [bench.inject("stuck_taxel", **HERE, taxel=taxel) for taxel in range(12)]
    else:
        mends = [bench.inject("chip_gone", **HERE, value=0)]
    while (code, "forearm_outer/3") not in bench.told:
        bench.run(0.5)
        assert bench.t_s < 60.0
    for mend in mends:
        mend()
    bench.run(6.0)
    assert (code, "forearm_outer/3") not in bench.told


def test_a_triangle_that_is_sent_again_is_not_missing(bench: FaultBench) -> None:
    step = bench.robot.step

    def without(seconds: float) -> dict[str, FrameBatch]:
        (batch,) = step(seconds).values()
        address = next(one for one in bench.layout.boards if one.name == "hand").settings.address
        kept = batch.id & 0xFF != address << 4 | 3
        return {
            "can0": FrameBatch(
                batch.id[kept], batch.dlc[kept], batch.data[kept], batch.t_ns[kept].copy()
            )
        }

    bench.robot.step = without  # type: ignore[method-assign]
    bench.run(2.0)
    assert ("triangle_missing", "hand/3") in bench.told
    bench.robot.step = step  # type: ignore[method-assign]
    bench.run(2.0)
    assert bench.told == {}
