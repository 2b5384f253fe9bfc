"""One fingertip from samples of force and torque to contacts, slips and excess."""

import math
from itertools import groupby
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from skin_host.bus.strain import Wrench
from skin_host.config.fingertips import Fingertip
from skin_host.fingertip.events import FingertipEvent, Over, Slip
from skin_host.fingertip.tip import Tip
from skin_host.processing.calibration import Zero
from skin_host.processing.events import Touch
from tests.support.said import touch_event

MS = 1_000_000
RADIUS_MM = 13.0
NOISE = np.array([1e-3, 1e-3, 1e-3, 5e-5, 5e-5, 5e-5])
OFFSET = np.array([0.5, -0.2, 0.1, 0.004, -0.003, 0.002])


class Bench:
    """A tip that has been zeroed, and pushes on points of its sphere."""

    def __init__(self, **settings: Any) -> None:
        table: dict[str, Any] = {"shape": "sphere", "radius_mm": RADIUS_MM, "period_ms": 10}
        table |= settings
        self.tip = Tip("index", Fingertip(bus="can0", address=3, **table), 50.0, 50 * MS)
        self.period_ns = table["period_ms"] * MS
        self.tip.use(Zero(OFFSET, NOISE))
        self.rng = np.random.default_rng(1)
        self.t_ns = 0

    def sample(
        self, point_mm: Any, force_n: Any, more: Any = 0.0, *, saturated: bool = False
    ) -> list[FingertipEvent]:
        self.t_ns += self.period_ns
        torque_nm = 1e-3 * np.cross(point_mm, force_n)
        sent = np.concatenate([force_n, torque_nm]) + more + OFFSET
        sent = sent + NOISE * self.rng.normal(size=6)
        return self.tip.step(Wrench(self.t_ns, sent[:3], sent[3:], saturated))

    def hold(self, n: int, point_mm: Any, force_n: Any, **more: Any) -> list[FingertipEvent]:
        return [event for _ in range(n) for event in self.sample(point_mm, force_n, **more)]


def touches(events: list[FingertipEvent]) -> list[Touch]:
    return [event for event in events if isinstance(event, Touch)]


def slips(events: list[FingertipEvent]) -> list[Slip]:
    return [event for event in events if isinstance(event, Slip)]


DIRECTION = np.array([0.36, 0.48, 0.8])
POINT = RADIUS_MM * DIRECTION
NOWHERE = np.zeros(3)


def test_a_push_begins_moves_and_ends_with_its_place_normal_and_force() -> None:
    bench = Bench()
    events = bench.hold(20, NOWHERE, NOWHERE)
    assert events == []
    shear = np.array([0.8, 0.0, -0.36]) * 0.5  # along the surface
    events = bench.hold(150, POINT, -2.0 * DIRECTION + shear) + bench.hold(40, NOWHERE, NOWHERE)
    told = touches(events)
    assert [event.event for event in told] == ["begin", *["move"] * (len(told) - 2), "end"]
    assert {event.id for event in told} == {1}
    last = told[-2]
    assert last.centroid_m is not None and last.normal is not None and last.load is not None
    np.testing.assert_allclose(np.array(last.centroid_m) * 1e3, POINT, atol=0.15)
    np.testing.assert_allclose(last.normal, DIRECTION, atol=0.01)
    assert last.force_n == pytest.approx(2.0, abs=0.02)
    assert last.load.verdict == "contact"
    np.testing.assert_allclose(last.load.shear_n or [], shear, atol=0.02)
    assert last.peak_kpa is None
    assert not slips(events)


def test_the_standard_error_is_that_of_the_places() -> None:
    bench = Bench()
    off, said = [], []
    for _ in range(300):
        direction = bench.rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        begin, *_ = touches(bench.sample(RADIUS_MM * direction, -0.4 * direction))
        assert begin.centroid_m is not None and begin.sigma_m is not None
        off.append(np.linalg.norm(1e3 * np.array(begin.centroid_m) - RADIUS_MM * direction))
        said.append(1e3 * begin.sigma_m)
        bench.hold(3, NOWHERE, NOWHERE)
    assert 0.6 * np.mean(said) < math.sqrt(np.mean(np.square(off))) < 1.2 * np.mean(said)


def test_what_no_single_push_can_give_has_no_place_and_says_why() -> None:
    bench = Bench()
    aside = bench.hold(5, [0, 0, RADIUS_MM], [2.0, 0, 0.0], more=np.array([0, 0, 0, 0, 0.05, 0]))
    assert aside and touches(aside)[0].load
    assert touches(aside)[0].load.verdict == "no_single_contact"  # type: ignore[union-attr]
    assert touches(aside)[0].centroid_m is None
    bench = Bench()
    twist = bench.hold(5, POINT, -2 * DIRECTION, more=0.01 * np.append([0, 0, 0], DIRECTION))
    assert touches(twist)[0].load.verdict == "several_contacts"  # type: ignore[union-attr]
    bench = Bench()
    clipped = bench.sample(POINT, -2 * DIRECTION, saturated=True)
    assert touches(clipped)[0].load.verdict == "saturated"  # type: ignore[union-attr]
    assert touches(clipped)[0].centroid_m is None


def test_without_a_zero_nothing_is_said() -> None:
    bench = Bench()
    bench.tip.use(None)
    assert bench.hold(20, POINT, -2 * DIRECTION) == []


def test_noise_raises_the_threshold_of_a_coarse_sensor() -> None:
    bench = Bench()
    bench.tip.use(Zero(OFFSET, 100 * NOISE))
    assert bench.tip.threshold_n == pytest.approx(0.6)
    assert bench.hold(20, POINT, -0.5 * DIRECTION) == []


def test_a_tip_feels_when_its_zero_is_known_and_samples_arrive() -> None:
    bench = Bench()
    assert not bench.tip.feels
    bench.sample(NOWHERE, NOWHERE)
    assert bench.tip.feels
    bench.tip.use(None)
    assert not bench.tip.feels


@pytest.mark.parametrize(
    ("threshold_n", "noises", "feels"),
    [
        (49.4, 1.0, True),
        (49.6, 1.0, False),
        (60.0, 1.0, False),
        (1.0, 5e3, True),
        (1.0, 1e4, False),
    ],
)
def test_a_tip_does_not_feel_if_no_load_within_its_range_is_a_touch(
    threshold_n: float, noises: float, feels: bool
) -> None:
    """The zero takes 0.5 N of the 50 N, and a threshold is six times the noise at least."""
    bench = Bench(threshold_n=threshold_n, over_n=100.0)
    bench.tip.set_range(np.array([50.0, 50.0, 50.0, 1.0, 1.0, 1.0]))
    bench.tip.use(Zero(OFFSET, noises * NOISE))
    bench.sample(NOWHERE, NOWHERE)
    assert bench.tip.reach_n == pytest.approx(49.5, abs=0.01)
    assert (bench.tip.feels, bench.tip.unreached) == (feels, not feels)
    bench.tip.use(None)
    assert bench.tip.threshold_n == threshold_n


def test_what_no_direction_of_the_matrix_measures_is_not_felt() -> None:
    rows = np.eye(6)
    rows[1] = rows[0]
    bench = Bench(matrix=rows.tolist())
    bench.tip.set_range(np.array([50.0, 50.0, 50.0, 1.0, 1.0, 1.0]))
    bench.sample(NOWHERE, NOWHERE)
    assert not bench.tip.feels
    assert bench.tip.reach_n == pytest.approx(0.0, abs=1e-9)


def test_pressing_too_hard_is_told_with_the_touch_it_belongs_to() -> None:
    bench = Bench(over_n=5.0)
    events = bench.hold(10, POINT, -2 * DIRECTION) + bench.hold(10, POINT, -8 * DIRECTION)
    events += bench.hold(10, POINT, -2 * DIRECTION)
    over = [event for event in events if isinstance(event, Over)]
    assert [(event.event, event.id) for event in over] == [("begin", 1), ("end", 1)]
    assert over[0].force_n == pytest.approx(8.0, abs=0.05)
    assert any("over" in event.load.flags for event in touches(events) if event.load)


@pytest.mark.parametrize(
    ("settings", "jump_n", "cause"),
    [
        ({"friction": 3.0}, 0.5, "rate"),
        ({"slip_n_s": 1e3}, 0.3, "fall"),
        ({"friction": 0.5}, 0.0, "friction"),
    ],
)
def test_a_slip_is_told_once_with_its_cause(
    settings: dict[str, Any], jump_n: float, cause: str
) -> None:
    """The pull rises to 0.55 of the grip, then falls as sliding friction is lower."""
    bench = Bench(**settings)
    along = np.array([0.8, -0.6, 0.0])
    events = []
    for pull_n in [*np.linspace(0.0, 1.1, 80), *[1.1 - jump_n] * 40]:
        events += bench.sample(POINT, -2 * DIRECTION + pull_n * along)
    found = slips(events)
    assert [(one.cause, one.id) for one in found if one.event == "begin"] == [(cause, 1)]
    if jump_n:
        assert found[0].t_ns == pytest.approx(820 * MS, abs=25 * MS)
        assert found[1].event == "end"


def test_no_slip_is_told_of_an_object_that_is_only_carried_about() -> None:
    bench = Bench()
    along = np.array([0.8, -0.6, 0.0])
    events = []
    for i in range(3000):
        sway = 0.1 * np.sin(2 * np.pi * 0.9 * i / 100)
        force = -4 * (1 + 0.5 * sway) * DIRECTION + 1.2 * (1 + sway) * along
        events += bench.sample(POINT, force)
    assert not slips(events)


def slipping(rate_n_s: float, lateness_ns: list[int | None]) -> list[Slip]:
    """Return the slips of a pull that swings between -2 and 2 N at a steady rate.

    Sample k is taken at 10 k ms; it arrives so much later (ns), or is lost (None).
    """
    bench = Bench()
    bench.hold(20, POINT, -5.0 * DIRECTION)
    along = np.array([0.8, -0.6, 0.0])
    begun_ns = bench.t_ns
    events = []
    for k, late_ns in enumerate(lateness_ns):
        if late_ns is None:
            continue
        pull_n = abs((0.01 * k * rate_n_s - 2.0) % 8.0 - 4.0) - 2.0
        bench.t_ns = begun_ns + k * 10 * MS + late_ns
        events += bench.sample(POINT, -5.0 * DIRECTION + pull_n * along)
    return slips(events)


LOSSES: dict[str, list[int | None]] = {
    "none": [0] * 200,
    "every second": [0, None] * 100,
    "two of three": [0, None, None] * 70,
    "a gap of 80 ms": [*[0] * 100, *[None] * 7, *[0] * 100],
    "one of twenty": [None if u < 0.05 else 0 for u in np.random.default_rng(1).random(200)],
    "one of five": [None if u < 0.2 else 0 for u in np.random.default_rng(2).random(200)],
}


@pytest.mark.parametrize("losses", LOSSES)
@pytest.mark.parametrize("rate_n_s", [2.0, 3.0, 5.0])
def test_a_pull_that_changes_slower_than_a_slip_is_none_whatever_is_lost(
    losses: str, rate_n_s: float
) -> None:
    assert slipping(rate_n_s, LOSSES[losses]) == []


@pytest.mark.parametrize("losses", LOSSES)
def test_a_pull_that_changes_faster_than_a_slip_is_one_whatever_is_lost(losses: str) -> None:
    found = slipping(8.0, LOSSES[losses])
    assert found[0].event == "begin" and found[0].cause == "rate"
    assert found[0].shear_rate_n_s == pytest.approx(7.0, abs=1.3)


@pytest.mark.parametrize("period_ms", [10, 100, 150, 255])
def test_samples_of_a_slow_board_continue_those_before_them(period_ms: int) -> None:
    """A rate is that of a line through several samples."""
    bench = Bench(period_ms=period_ms, filter_hz=1.0, slip_n_s=0.2)
    bench.hold(20, POINT, -5.0 * DIRECTION)
    along = np.array([0.8, -0.6, 0.0])
    events = []
    for pull_n in np.linspace(0.0, 1.0, round(2000 / period_ms)):
        events += bench.sample(POINT, -5.0 * DIRECTION + pull_n * along)
    found = slips(events)
    assert [(one.event, one.cause) for one in found] == [("begin", "rate")]


def test_samples_that_are_held_up_and_arrive_together_are_no_slip() -> None:
    """A computer that stalls for 90 ms stamps what it then reads with nearly one time."""
    held_up = [(90 - 10 * k) * MS for k in range(10)]
    assert slipping(5.0, [*[0] * 40, *held_up] * 4) == []
    late_ns = np.random.default_rng(3).integers(0, 4 * MS, 400)
    assert slipping(5.0, late_ns.tolist()) == []


@pytest.mark.parametrize("step_ms", [-3_600_000, -90, -30, -5, 30, 90, 3_600_000])
def test_a_clock_that_is_set_makes_no_slip(step_ms: int) -> None:
    for losses in ([0] * 100, [0, None] * 50):
        stepped = [None if late is None else step_ms * MS for late in losses]
        assert slipping(5.0 if None not in losses else 3.0, losses + stepped) == []


def test_a_ratio_that_falls_slowly_is_no_slip_when_samples_are_lost() -> None:
    for lost in ([], range(100, 107), range(1, 400, 2)):
        bench = Bench(slip_n_s=1e3)
        events = bench.hold(20, POINT, -2.0 * DIRECTION + np.array([0.8, -0.6, 0.0]))
        for k in range(400):
            if k in lost:
                bench.t_ns += 10 * MS
                continue
            pull_n = 1.0 - 2.5 * abs((0.01 * k + 0.4) % 0.8 - 0.4)
            events += bench.sample(POINT, -2.0 * DIRECTION + pull_n * np.array([0.8, -0.6, 0.0]))
        assert slips(events) == []


def test_a_ratio_that_is_not_known_for_a_while_is_not_compared_with_that_before() -> None:
    """Where the contact has no place there is no ratio; it may fall slowly meanwhile."""
    bench = Bench(slip_n_s=1e3)
    along = np.array([0.8, -0.6, 0.0])
    events = bench.hold(40, POINT, -2.0 * DIRECTION + 1.0 * along)
    for pull_n in np.linspace(1.0, 0.4, 60):
        events += bench.sample(POINT, -2.0 * DIRECTION + pull_n * along, saturated=True)
    for pull_n in np.linspace(0.4, 0.3, 40):
        events += bench.sample(POINT, -2.0 * DIRECTION + pull_n * along)
    assert slips(events) == []


@pytest.mark.parametrize("lost", [set(), {80}, {81}, set(range(1, 120, 2))])
def test_a_ratio_that_falls_at_once_is_a_slip_although_samples_are_lost(lost: set[int]) -> None:
    bench = Bench(slip_n_s=1e3)
    events = []
    for k, pull_n in enumerate([*np.linspace(0.0, 1.1, 80), *[0.8] * 40]):
        if k in lost:
            bench.t_ns += 10 * MS
        else:
            events += bench.sample(POINT, -2 * DIRECTION + pull_n * np.array([0.8, -0.6, 0.0]))
    assert [one.cause for one in slips(events) if one.event == "begin"] == ["fall"]


def test_a_board_that_falls_silent_ends_its_touch_and_slip() -> None:
    bench = Bench(friction=0.2)
    bench.hold(20, POINT, -2 * DIRECTION + np.array([0.8, -0.6, 0.0]))
    assert bench.tip.touched
    assert bench.tip.expire(bench.t_ns + 400 * MS, 400 * MS) == []
    ended = bench.tip.expire(bench.t_ns + 600 * MS, 600 * MS)
    assert [(type(event), event.event) for event in ended] == [
        (Slip, "end"),
        (Touch, "end"),
    ]
    assert not bench.tip.touched


def test_a_board_that_falls_silent_after_a_release_ends_the_slip_before_it() -> None:
    """A slip is held for a moment, longer than its touch."""
    bench = Bench(friction=0.2)
    bench.hold(20, POINT, -2 * DIRECTION + np.array([0.8, -0.6, 0.0]))
    events = bench.hold(1, NOWHERE, NOWHERE)
    assert [(type(event), event.event) for event in events] == [(Touch, "end")]
    ended = bench.tip.expire(bench.t_ns + 600 * MS, 600 * MS)
    assert [(type(event), event.event) for event in ended] == [(Slip, "end")]
    assert bench.tip.expire(bench.t_ns + 700 * MS, 700 * MS) == []


def test_matrix_and_place_of_the_sensor_lead_to_the_fingertips_frame() -> None:
    turn = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    matrix = np.kron(np.eye(2), np.array(turn))
    sensor_mm = np.array([1.0, -2.0, -20.0])
    bench = Bench(matrix=matrix.tolist(), sensor_mm=tuple(sensor_mm))
    force = -2 * DIRECTION
    torque_nm = 1e-3 * np.cross(POINT - sensor_mm, force)
    sent = np.linalg.inv(matrix) @ np.concatenate([force, torque_nm]) + OFFSET
    begin, *_ = touches(bench.tip.step(Wrench(10 * MS, sent[:3], sent[3:], saturated=False)))
    np.testing.assert_allclose(1e3 * np.array(begin.centroid_m), POINT, atol=1e-6)


def skin_contact(number: int, centroid_mm: Any, sigma_mm: float) -> Touch:
    centroid_m = (1e-3 * np.array(centroid_mm)).tolist()
    more = (40.0, 9.0, 7.0, 0.3, 1e-3 * sigma_mm)
    return touch_event("begin", number, 1, 0, "skin", [4], centroid_m, [0.0, 0.0, 1.0], *more)


def test_skin_and_force_together_are_better_than_either() -> None:
    """At light forces torque says little, and skin of coarse pads as much; their errors differ."""
    by_force, by_skin, joined, said = [], [], [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        truth = np.append(rng.uniform(-6, 6, 2), 0.0)
        error = rng.normal(0, 0.3, 2)
        for errors, with_skin in ((by_force, False), (joined, True)):
            bench = Bench(shape="plane", radius_mm=None, reach_mm=20.0)
            bench.tip.use(Zero(OFFSET, np.array([2, 2, 2, 0.08, 0.08, 0.08]) * 1e-3))
            noise = np.array([2, 2, 2, 0.08, 0.08, 0.08]) * 1e-3
            noise = noise * np.random.default_rng(seed + 1000).normal(size=6)
            if with_skin:
                seen = truth + np.append(error, 0.0)
                bench.tip.note_skin([skin_contact(1, seen, 0.3 * math.sqrt(2))], 10 * MS)
            force = np.array([0.0, 0.0, -0.3])
            sent = np.concatenate([force, 1e-3 * np.cross(truth, force)]) + OFFSET + noise
            begin, *_ = touches(bench.tip.step(Wrench(10 * MS, sent[:3], sent[3:], False)))
            assert begin.centroid_m is not None and begin.sigma_m is not None
            errors.append(np.linalg.norm(1e3 * np.array(begin.centroid_m) - truth))
            if with_skin:
                assert begin.taxels == [4] and begin.peak_kpa == 9.0
                said.append(1e3 * begin.sigma_m)
        by_skin.append(np.linalg.norm(error))
    rms = [math.sqrt(np.mean(np.square(errors))) for errors in (by_force, by_skin, joined)]
    assert rms[2] < 0.85 * min(rms[:2])
    assert 0.8 < rms[2] / np.mean(said) < 1.25


@pytest.mark.parametrize("force_n", [1.0, 3.7, 11.3, 20.0])
def test_a_push_that_grazes_the_fingertip_where_its_skin_is_touched_has_no_place(
    force_n: float,
) -> None:
    bench = Bench(radius_mm=8.0)
    bench.tip.use(Zero(np.zeros(6), NOISE))
    bench.tip.note_skin([skin_contact(1, [0.0, 8.0, 0.0], 0.5)], 10 * MS)
    force, torque_nm = np.array([force_n, 0.0, 0.0]), np.array([0.0, 0.0, -8e-3 * force_n])
    (begin,) = touches(bench.tip.step(Wrench(10 * MS, force, torque_nm, False)))
    assert begin.load is not None and begin.load.verdict == "no_single_contact"
    assert begin.centroid_m is None and begin.sigma_m is None
    assert begin.force_n == pytest.approx(force_n)


def test_a_contact_of_skin_beside_pads_that_are_not_valid_is_partial_on_the_fingertip_too() -> None:
    bench = Bench(shape="plane", radius_mm=None)
    felt = skin_contact(1, [0, 0, 0], 0.5)
    partial = []
    for marked in (False, True, False):
        bench.tip.note_skin([replace(felt, partial=marked)], bench.t_ns)
        told = touches(bench.hold(10, [0, 0, 0], [0, 0, -1.0]))
        partial += [event.partial for event in told]
    assert [one for one, _ in groupby(partial)] == [False, True, False]


def test_a_load_beyond_the_range_of_the_board_is_only_a_bound() -> None:
    bench = Bench()
    told = [
        event
        for saturated in (False, True, False)
        for event in touches(bench.hold(10, POINT, -2 * DIRECTION, saturated=saturated))
    ]
    told += touches(bench.hold(5, NOWHERE, NOWHERE))
    assert [one for one, _ in groupby(event.beyond for event in told)] == [False, True, False]
    assert {event.load.verdict for event in told if event.beyond and event.load} == {"saturated"}
    assert (told[-1].event, told[-1].beyond) == ("end", False)


def test_a_pad_beyond_its_range_marks_the_contact_of_the_fingertip_below_too() -> None:
    bench = Bench(shape="plane", radius_mm=None)
    felt = skin_contact(1, [0, 0, 0], 0.5)
    told = []
    for marked in (False, True, False):
        bench.tip.note_skin([replace(felt, beyond=marked)], bench.t_ns)
        told += touches(bench.hold(10, [0, 0, 0], [0, 0, -1.0]))
    assert [one for one, _ in groupby(event.beyond for event in told)] == [False, True, False]
    # Its force is measured all the same.
    assert {event.load.verdict for event in told if event.load} == {"contact"}


def test_skin_that_feels_two_contacts_tells_force_and_torque_that_they_are_several() -> None:
    bench = Bench(shape="plane", radius_mm=None)
    two = [skin_contact(1, [5, 0, 0], 0.5), skin_contact(2, [-5, 0, 0], 0.5)]
    bench.tip.note_skin(two, 10 * MS)
    begin, *_ = touches(bench.sample([0, 0, 0], [0, 0, -1.0]))
    assert begin.load is not None and begin.load.verdict == "several_contacts"
    assert begin.centroid_m is None
    # Skin that has fallen silent is not asked.
    told = touches(bench.hold(40, [0, 0, 0], [0, 0, -1.0]))
    assert told[-1].load is not None and told[-1].load.verdict == "contact"
