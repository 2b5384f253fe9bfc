"""A part is called untouched only where all of it can feel."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from emulator.probes.scene import Place, Probe, Scene
from skin_host.config.settings import load
from skin_host.evaluation.rig import Rig
from skin_host.layout import PadKind, build_layout
from skin_host.mqtt.contact import SURE_MEASUREMENTS, PartContact
from skin_host.processing.contacts import LOST_NS
from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.core import Output
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from tests.support.branch import branch
from tests.support.fault_bench import CONFIG, FaultBench
from tests.support.said import touch_event

LAYOUT = build_layout(load(CONFIG), CONFIG.parent)
PART = LAYOUT.parts.index(LAYOUT.part("left_forearm"))
N = LAYOUT.parts[PART].n_taxels
PADS = LAYOUT.pad_kind[LAYOUT.parts[PART].start : LAYOUT.parts[PART].stop] == PadKind.PRESSURE
MS = 1_000_000


def frame(
    elapsed_ns: int, touched: list[int] | None = None, blind: slice | None = None
) -> PressureFrame:
    valid = PADS.copy()
    if blind is not None:
        valid[blind] = False
    touches = np.zeros(N, np.bool_)
    touches[touched or []] = True
    none = np.zeros(N, np.bool_)
    kpa = np.zeros(N, np.float32)
    raw = np.zeros(N, np.uint8)
    return PressureFrame(
        "left_forearm", 1, 0, raw, kpa, touches, valid, none, elapsed_ns=elapsed_ns
    )


def begin(taxels: list[int]) -> Touch:
    return touch_event("begin", 1, 1, 1, "left_forearm", taxels, None, None, 1.0, 1.0, 1.0, 1.0)


def watched(t_ns: int = 0) -> PartContact:
    """A part that has been felt for long enough by then."""
    contact = PartContact(LAYOUT, PART)
    states = [
        contact.step(frame(t_ns - 50 * MS * left), []) for left in range(SURE_MEASUREMENTS)[::-1]
    ]
    assert states == ["UNKNOWN"] * (SURE_MEASUREMENTS - 1) + ["OFF"]
    return contact


def test_a_part_that_feels_is_on_or_off() -> None:
    contact = watched()
    assert contact.step(frame(1, [3]), [begin([3])]) == "ON"
    assert contact.step(frame(2), [begin([3]).ended(2, 2)]) == "OFF"


def test_a_part_that_was_not_read_for_a_while_must_be_felt_again_and_a_touch_of_it_lasts() -> None:
    contact = watched()
    assert contact.step(frame(1), []) == "OFF"
    assert contact.unread() == "UNKNOWN"
    states = [contact.step(frame(50 * MS * sweep), []) for sweep in range(1, 6)]
    assert (states[0], states[-1]) == ("UNKNOWN", "OFF")
    assert contact.step(frame(300 * MS, [3]), [begin([3])]) == "ON"
    assert contact.unread() == "ON"


def test_what_touched_a_part_before_it_was_disabled_does_not_touch_it_when_it_is_not_read() -> None:
    """Its contacts have ended; `icub_hand.toml`, seed 9257: enabled in a stall, it was ON."""
    contact = watched()
    touch = begin([3])
    assert contact.step(frame(1, [3]), [touch]) == "ON"
    assert contact.stop([touch.ended(2, 2)]) == "UNKNOWN"
    assert contact.unread() == "UNKNOWN"


@pytest.mark.parametrize("refused_first", [False, True])
def test_a_taxel_that_a_calibration_refuses_keeps_no_contact_unknown(refused_first: bool) -> None:
    """It will not be valid again, so nothing can confirm there that the contact is over."""
    contact = watched()
    assert contact.step(frame(1, [3]), [begin([3, 4])]) == "ON"
    decides = np.full(N, SURE_MEASUREMENTS)
    decides[3] = 0
    lost = [begin([3, 4]).ended(2, 2, "lost")]
    no_three = slice(3, 4)
    if refused_first:
        contact.use(decides)
    assert contact.step(frame(2, blind=no_three), lost) == "UNKNOWN"
    states = [contact.step(frame(50 * MS * sweep, blind=no_three), []) for sweep in range(1, 6)]
    if not refused_first:
        assert states[-1] == "UNKNOWN"
        contact.use(decides)
        states = [contact.step(frame(300 * MS, blind=no_three), [])]
    assert states[-1] == "OFF"


def test_a_triangle_that_comes_back_is_not_off_before_its_touch_can_be_decided() -> None:
    contact = watched()
    dead = slice(0, 12)
    assert contact.step(frame(2000 * MS, blind=dead), []) == "UNKNOWN"
    for sweep in range(SURE_MEASUREMENTS - 1):
        assert contact.step(frame((2050 + 50 * sweep) * MS), []) == "UNKNOWN"
    assert contact.step(frame(2200 * MS, [3]), [begin([3])]) == "ON"


@pytest.mark.parametrize("period_ms", [10, 20, 36, 50, 2000])
@pytest.mark.parametrize("decides", [3, 9, 27])
def test_repeats_of_a_measurement_decide_nothing(period_ms: int, decides: int) -> None:
    """Each taxel may take another number of them; that of the noisiest of a triangle counts."""
    contact = watched()
    needed = np.full(N, 3)
    needed[7] = decides
    contact.use(needed)
    assert contact.step(frame(2000 * MS, blind=slice(0, 12)), []) == "UNKNOWN"
    states: list[str] = []
    while "OFF" not in states:
        elapsed_ns = 2000 * MS + (len(states) + 1) * period_ms * MS
        states.append(contact.step(frame(elapsed_ns), []))
    taken_ms = decides * max(period_ms, 1e3 * CONVERSION_S)
    assert abs(len(states) * period_ms - taken_ms) <= period_ms
    assert set(states[:-1]) == {"UNKNOWN"}


def test_a_taxel_where_a_contact_was_lost_decides_for_itself() -> None:
    contact = watched()
    needed = np.full(N, 3)
    needed[3] = 9
    contact.use(needed)
    for taxel, frames in ((4, 3), (3, 9)):
        start_ms = 1000 * (10 + taxel)
        contact.step(frame(start_ms * MS, [taxel]), [begin([taxel])])
        lost = begin([taxel]).ended(2, 1, "lost")
        assert contact.step(frame((start_ms + 50) * MS, blind=slice(3, 5)), [lost]) == "UNKNOWN"
        states = [contact.step(frame((start_ms + 100 + 50 * n) * MS), []) for n in range(frames)]
        assert states == ["UNKNOWN"] * (frames - 1) + ["OFF"]


def test_what_is_waited_for_is_by_the_calibration_in_use() -> None:
    contact = PartContact(LAYOUT, PART)
    contact.step(frame(0), [])
    contact.use(np.full(N, 6))
    states = [contact.step(frame((50 + 50 * n) * MS), []) for n in range(6)]
    assert states == ["UNKNOWN"] * 5 + ["OFF"]
    contact.use(np.full(N, 9))
    assert contact.step(frame(400 * MS), []) == "OFF"


@pytest.mark.parametrize("period_ms", [10, 20, 50])
@pytest.mark.parametrize(("noise_units", "press_units"), [(0.6, 20.0), (2.0, 8.0), (4.5, 12.0)])
def test_a_triangle_that_comes_back_pressed_is_never_off(
    period_ms: int, noise_units: float, press_units: float
) -> None:
    """However noisy its pads are, and however often their board repeats what they convert."""
    rig = Rig(1, noise_units, hz=1000 / period_ms, calibrate_s=10.0)
    contact = PartContact(rig.layout, 0)
    contact.use(np.where(rig.calibration.usable, rig.pipeline.measurements, 0))
    pads = rig.layout.boards[0].taxel_index[0]
    start_ns = rig.t_ns
    converted = -1
    raw = np.zeros(rig.n, np.uint8)
    for number in range(round(14.0 / (period_ms * 1e-3))):
        passed_s = number * period_ms * 1e-3
        gone = 4.0 < passed_s < 6.0
        if int(passed_s / CONVERSION_S) != converted:
            converted = int(passed_s / CONVERSION_S)
            activation = np.zeros(rig.n)
            activation[pads] = press_units * (passed_s > 5.0)
            raw = rig.read(activation)
        present = np.ones(rig.n, np.bool_)
        present[pads] = not gone
        t_ns = start_ns + (number + 1) * period_ms * MS
        sent = np.where(present, raw, 0).astype(np.uint8)
        state = contact.step(rig.pipeline.step(0, sent, present, t_ns), [])
        if passed_s > 5.0:
            assert state != "OFF", passed_s - 6.0
    assert state == "ON"


def test_a_board_that_sends_once_in_two_seconds_is_felt() -> None:
    contact = PartContact(LAYOUT, PART)
    states = [contact.step(frame(2000 * MS * sweep), []) for sweep in range(SURE_MEASUREMENTS)]
    assert states[-1] == "OFF"


def test_where_an_earlier_daemon_felt_something_it_is_not_off_until_that_is_valid() -> None:
    contact = watched()
    taxels = np.zeros(N, np.bool_)
    taxels[3] = True
    contact.doubt(taxels)
    assert contact.step(frame(50 * MS, blind=slice(3, 4)), []) == "UNKNOWN"
    states = [
        contact.step(frame((100 + 50 * sweep) * MS), []) for sweep in range(SURE_MEASUREMENTS)
    ]
    assert states == ["UNKNOWN"] * (SURE_MEASUREMENTS - 1) + ["OFF"]


@pytest.mark.parametrize("calibrated", [False, True])
def test_a_temperature_pad_whose_zero_is_in_doubt_keeps_no_contact_unknown(
    calibrated: bool,
) -> None:
    """It is never valid, so nothing can confirm there that the contact is over."""
    contact = watched()
    if calibrated:
        contact.use(np.full(N, SURE_MEASUREMENTS))
    contact.doubt(~PADS)
    assert contact.step(frame(50 * MS), []) == "OFF"


def test_a_touched_taxel_of_a_larger_contact_is_not_off_until_it_is_valid_again() -> None:
    """The contact goes on without it, and its release tells nothing of that taxel."""
    contact = watched()
    only = slice(3, 4)
    assert contact.step(frame(50 * MS, [3, 8]), [begin([3, 8])]) == "ON"
    for sweep in range(20):
        assert contact.step(frame((100 + 50 * sweep) * MS, [8], blind=only), []) == "ON"
    released = [begin([8]).ended(2, 1200 * MS)]
    assert contact.step(frame(1200 * MS, blind=only), released) == "UNKNOWN"
    states = [
        contact.step(frame((1250 + 50 * sweep) * MS), []) for sweep in range(SURE_MEASUREMENTS)
    ]
    assert states == ["UNKNOWN"] * (SURE_MEASUREMENTS - 1) + ["OFF"]


def test_what_was_touched_when_a_part_was_disabled_is_not_off_until_it_is_valid_again() -> None:
    contact = watched()
    contact.step(frame(50 * MS, [3]), [begin([3])])
    assert contact.stop([begin([3]).ended(2, 60 * MS)]) == "UNKNOWN"
    for sweep in range(2 * SURE_MEASUREMENTS):
        state = contact.step(frame((900 + 50 * sweep) * MS, blind=slice(3, 4)), [])
        assert state == "UNKNOWN"


def test_without_a_valid_taxel_it_is_unknown_at_once() -> None:
    contact = watched()
    assert contact.step(frame(50 * MS, blind=slice(0, N)), []) == "UNKNOWN"
    assert contact.step(frame(100 * MS), []) == "OFF"


def test_a_triangle_that_was_never_felt_makes_it_unknown() -> None:
    contact = PartContact(LAYOUT, PART)
    assert contact.step(frame(0, blind=slice(0, 12)), []) == "UNKNOWN"
    # Whether the contact of what is touched was reported before or not.
    assert contact.step(frame(50 * MS, [30], blind=slice(0, 12)), []) == "ON"
    assert contact.step(frame(100 * MS, [30], blind=slice(0, 12)), [begin([30])]) == "ON"


@pytest.mark.parametrize("set_ns", [0, 3_600_000 * MS, -3_600_000 * MS])
@pytest.mark.parametrize("start_ns", [0, 777 * MS, 3_599_999 * MS])
def test_only_time_that_passed_makes_anything_unfelt(start_ns: int, set_ns: int) -> None:
    contact = watched(start_ns)
    states = [
        contact.step(replace(frame(start_ns + passed_ns, blind=slice(0, 12)), t_ns=set_ns), [])
        for passed_ns in range(50 * MS, LOST_NS + 50 * MS, 50 * MS)
    ]
    assert states == ["OFF"] * (len(states) - 1) + ["UNKNOWN"]


def test_frames_that_are_lost_for_a_moment_change_nothing() -> None:
    contact = watched()
    states = [
        contact.step(frame(t_ns, blind=slice(0, 12)), [])
        for t_ns in range(50 * MS, LOST_NS + 50 * MS, 50 * MS)
    ]
    assert states == ["OFF"] * (len(states) - 1) + ["UNKNOWN"]


def test_frames_that_are_lost_for_a_moment_change_nothing_however_long_all_was_felt() -> None:
    contact = watched()
    for t_ns in range(50 * MS, 3 * LOST_NS, 50 * MS):
        assert contact.step(frame(t_ns), []) == "OFF"
    assert contact.step(frame(3 * LOST_NS, blind=slice(0, 12)), []) == "OFF"


def test_a_contact_whose_frames_are_lost_stays_on_until_it_is_lost_itself() -> None:
    contact = watched()
    contact.step(frame(0, [3]), [begin([3])])
    assert contact.step(frame(50 * MS, blind=slice(0, 12)), []) == "ON"
    lost = begin([3]).ended(2, 600 * MS, "lost")
    assert contact.step(frame(600 * MS, blind=slice(0, 12)), [lost]) == "UNKNOWN"
    states = [
        contact.step(frame((650 + 50 * sweep) * MS), []) for sweep in range(SURE_MEASUREMENTS)
    ]
    assert states == ["UNKNOWN"] * (SURE_MEASUREMENTS - 1) + ["OFF"]


def test_where_a_contact_was_lost_the_same_taxels_must_come_back() -> None:
    contact = watched()
    contact.step(frame(0, [3]), [begin([3])])
    only = slice(3, 4)
    lost = begin([3]).ended(2, 1, "lost")
    assert contact.step(frame(600 * MS, blind=only), [lost]) == "UNKNOWN"
    assert contact.step(frame(9000 * MS, blind=only), []) == "UNKNOWN"
    states = [
        contact.step(frame((9050 + 50 * sweep) * MS), []) for sweep in range(SURE_MEASUREMENTS)
    ]
    assert states == ["UNKNOWN"] * (SURE_MEASUREMENTS - 1) + ["OFF"]


def test_a_part_that_was_stopped_must_be_felt_again() -> None:
    contact = watched()
    contact.step(frame(0, [3]), [begin([3])])
    assert contact.stop([begin([3]).ended(1, 1, "stopped")]) == "UNKNOWN"
    states = [contact.step(frame((50 + 50 * sweep) * MS), []) for sweep in range(SURE_MEASUREMENTS)]
    assert states == ["UNKNOWN"] * (SURE_MEASUREMENTS - 1) + ["OFF"]


HERE = {"board": "forearm_outer", "triangle": 3}


@pytest.fixture(scope="module")
def soon_pressed() -> FaultBench:
    """A calibrated robot that is pressed a moment later, and not let go."""
    press = Probe(
        part="left_forearm",
        at=Place(taxel=39),
        diameter_mm=3,
        pressure_kpa=[(0, 0), (0.1, 100), (100, 100)],
        start_s=11.0,
    )
    return FaultBench(3.0, Scene(probe=[press], quiet=True))


@pytest.mark.parametrize(
    ("fault", "arguments"),
    [
        ("board_silent", {"board": "forearm_outer"}),
        ("bus_off", {"bus": "can0"}),
        ("chip_gone", HERE),
        ("chip_gone", HERE | {"value": 0}),
        ("chip_gone", HERE | {"value": 0x8000}),
        ("shorted_finger", HERE),
        ("swapped_lines", HERE),
    ],
)
def test_no_board_or_triangle_that_dies_while_it_is_touched_looks_untouched(
    soon_pressed: FaultBench, fault: str, arguments: dict[str, Any]
) -> None:
    bench = branch(soon_pressed)
    contact = PartContact(bench.layout, PART)
    events: list[Touch] = []
    states: list[str] = []
    note = bench._note

    def watch(output: Output) -> None:
        note(output)
        for step in output.steps:
            if step.part == PART:
                events.extend(step.events)
                states.append(contact.step(step.frame, step.events))

    bench._note = watch  # type: ignore[method-assign]
    bench.run(3.0)
    assert [one.event for one in events if one.event != "move"] == ["begin"]
    assert states[-1] == "ON"
    states.clear()
    bench.inject(fault, **arguments)
    bench.run(4.0)
    (end,) = [one for one in events if one.event == "end"]
    assert end.reason == "lost"
    assert "OFF" not in states
    assert states[-1] == "UNKNOWN"


def test_any_pressure_pad_of_a_triangle_feels_for_it() -> None:
    """Also the very first taxel of the skin."""
    first = LAYOUT.parts[0]
    pads = LAYOUT.pad_kind[first.start : first.stop] == PadKind.PRESSURE
    same = LAYOUT.triangle_of[first.start : first.stop] == LAYOUT.triangle_of[first.start]
    none = np.zeros(first.n_taxels, np.bool_)
    raw, kpa = np.zeros(first.n_taxels, np.uint8), np.zeros(first.n_taxels, np.float32)
    for taxel in np.flatnonzero(same):
        valid = pads & ~same
        valid[taxel] = pads[taxel]
        contact = PartContact(LAYOUT, 0)
        states = [
            contact.step(
                PressureFrame(
                    first.name, n, 0, raw, kpa, none, valid, none, elapsed_ns=50 * MS * n
                ),
                [],
            )
            for n in range(SURE_MEASUREMENTS)
        ]
        assert states[-1] == ("OFF" if pads[taxel] else "UNKNOWN")
