import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.config.settings import Settings
from skin_host.evaluation.rig import Rig, flat_skin
from skin_host.layout import PadKind, build_layout
from skin_host.processing.contacts import ALIVE_NS, LOST_NS, ContactTracker
from skin_host.processing.contacts.tracker import MERGED_NS, PARTED_NS
from skin_host.processing.frame import PressureFrame
from skin_host.processing.localization_centroid import GEOMETRY_PITCHES, nearest_distance

SETTINGS, LAYOUT = flat_skin(1)
N = LAYOUT.n_taxels
SWEEP_NS = 20_000_000
#: Triangles far apart from each other on the strip.
HERE, THERE = set(range(12)), set(range(120, 132))


class Skin:
    """Frames of chosen taxels at one pressure, and what the tracker makes of them."""

    def __init__(self, layout=LAYOUT):
        self.tracker = ContactTracker(layout, 0, SETTINGS)
        self.seq = 0
        #: By how much the clock was set.
        self.set_ns = 0

    def show(self, *taxels, kpa=20.0, lost=(), felt=(), unlike=None):
        """`felt` taxels feel something but have too few votes yet; `unlike` ones differ in kPa."""
        touched = np.zeros(N, bool)
        touched[list(set().union(*taxels))] = True
        valid = np.ones(N, bool)
        valid[list(lost)] = False
        touched &= valid
        pressure = np.where(touched, kpa, 0.0).astype(np.float32)
        pressure[list(felt)] = 4.0
        for taxel, its_kpa in (unlike or {}).items():
            pressure[taxel] = its_kpa
        frame = PressureFrame(
            "skin",
            self.seq,
            self.seq * SWEEP_NS + self.set_ns,
            np.zeros(N, np.uint8),
            pressure,
            touched,
            valid,
            np.zeros(N, bool),
            elapsed_ns=self.seq * SWEEP_NS,
        )
        self.seq += 1
        return self.tracker.step(frame)


def kinds(events):
    return [(event.event, event.id) for event in events]


def test_a_contact_begins_and_ends_once():
    skin = Skin()
    assert kinds(skin.show(HERE)) == [("begin", 1)]
    assert kinds(skin.show(HERE)) == []
    assert kinds(skin.show()) == [("end", 1)]
    assert kinds(skin.show()) == []


def test_an_event_tells_place_area_pressure_and_force():
    (event,) = Skin().show(HERE, kpa=50.0)
    taxels = sorted(HERE)
    area = LAYOUT.area_mm2[taxels].sum()
    assert event.taxels == taxels
    centroid_m = LAYOUT.area_mm2[taxels] @ LAYOUT.position_m[taxels] / area
    assert event.centroid_m == pytest.approx(centroid_m.tolist())
    assert event.normal == pytest.approx([0.0, 0.0, 1.0])
    assert event.area_mm2 == pytest.approx(area)
    assert (event.peak_kpa, event.mean_kpa) == (50.0, pytest.approx(50.0))
    assert event.force_n == pytest.approx(50e3 * area * 1e-6)


def test_two_places_are_two_contacts_with_names_of_their_own():
    skin = Skin()
    assert kinds(skin.show(HERE, THERE)) == [("begin", 1), ("begin", 2)]
    assert kinds(skin.show(THERE)) == [("end", 1)]
    assert kinds(skin.show(HERE, THERE)) == [("begin", 3)]


def test_a_contact_that_grows_and_slides_keeps_its_name():
    skin = Skin()
    skin.show({0})
    reached = {0}
    for _ in range(30):
        start, end = LAYOUT.neighbour_start[max(reached)], LAYOUT.neighbour_start[max(reached) + 1]
        reached = set(LAYOUT.neighbour[start:end].tolist())
        assert {event.id for event in skin.show(reached)} <= {1}


def test_where_two_contacts_merge_for_good_the_larger_one_goes_on():
    skin = Skin()
    small, large = {0}, {4, 5, 6}
    whole = set(range(12))
    assert kinds(skin.show(small, large)) == [("begin", 1), ("begin", 2)]
    moved = skin.show(whole)
    assert {event.event for event in moved} == {"move"}
    for _ in range(MERGED_NS // SWEEP_NS - 1):
        assert {event.event for event in skin.show(whole)} <= {"move"}
    ended, moved = skin.show(whole)
    assert kinds([ended, moved]) == [("end", 1), ("move", 2)]
    assert set(moved.taxels) == whole


@pytest.mark.parametrize("firm", [0, 1])
def test_where_contacts_meet_a_new_taxel_belongs_to_what_presses_hardest_beside_it(firm):
    """A finger slides along a hand that rests: what it reaches is not the hand's."""
    skin = Skin()
    one, between, other = _chain()
    larger = {other} | set(_near(other)) - set(_near(between)) - {between}
    assert kinds(skin.show({one}, larger)) == [("begin", 1), ("begin", 2)]
    firmly = dict.fromkeys([{one}, larger][firm], 60.0) | {between: 50.0}
    found = {frozenset(one.taxels) for one in skin.show({one, between}, larger, unlike=firmly)}
    assert frozenset([{one, between}, larger | {between}][firm]) in found


@pytest.mark.parametrize(("taxels_away", "continues"), [(1, True), (2, True), (3, False)])
def test_a_contact_that_slides_over_a_taxel_keeps_its_name(taxels_away, continues):
    """What it leaves is released some sweeps late, in the sweep in which it is felt again."""
    skin = Skin()
    assert kinds(skin.show({0})) == [("begin", 1)]
    reached = [{0}]
    for _ in range(taxels_away):
        reached.append(set().union(*map(_near, reached[-1])) - set().union(*reached))
    slid = {min(reached[-1])}
    assert kinds(skin.show(slid)) == ([("move", 1)] if continues else [("end", 1), ("begin", 2)])


@pytest.mark.parametrize("sweeps", [1, 5, 12, 25, 40])
def test_a_taxel_that_flickers_between_two_contacts_makes_no_other(sweeps):
    skin = Skin()
    # The first two have a common neighbour but are none of each other.
    one, between, other = _chain()
    assert kinds(skin.show({one}, {other})) == [("begin", 1), ("begin", 2)]
    for number in range(1000):
        flicker = {between} if number // sweeps % 2 else set()
        assert {event.event for event in skin.show({one}, {other}, flicker)} <= {"move"}


def _near(taxel):
    start, end = LAYOUT.neighbour_start[taxel : taxel + 2]
    return LAYOUT.neighbour[start:end].tolist()


def _chain():
    """Three taxels of which the second is the neighbour of both others, which are not."""
    near = [set(_near(taxel)) for taxel in range(N)]
    for between in range(N):
        for one in near[between]:
            for other in near[between] - near[one] - {one}:
                return one, between, other
    raise AssertionError("no three taxels in a row")


def test_a_hand_that_lands_taxel_by_taxel_is_one_contact_from_the_first():
    skin = Skin()
    whole = set(range(12))
    (event,) = skin.show({0}, {4, 5}, felt=whole - {0, 4, 5})
    assert (event.event, set(event.taxels)) == ("begin", {0, 4, 5})
    (event,) = skin.show({0}, {4, 5}, {8}, felt=whole - {0, 4, 5, 8})
    assert (event.event, event.id, set(event.taxels)) == ("move", 1, {0, 4, 5, 8})
    assert kinds(skin.show(whole)) == [("move", 1)]


def test_two_contacts_with_something_felt_between_them_stay_two():
    skin = Skin()
    one, other = {0}, {4, 5}
    assert kinds(skin.show(one, other)) == [("begin", 1), ("begin", 2)]
    assert kinds(skin.show(one, other, felt=set(range(12)) - one - other)) == []


def test_a_contact_that_lets_go_taxel_by_taxel_is_one_to_its_end():
    skin = Skin()
    skin.show(set(range(12)))
    for left in ({0, 4, 5, 6}, {0, 5}, {0}):
        assert [(one.event, one.id, set(one.taxels)) for one in skin.show(left)] == [
            ("move", 1, left)
        ]
    assert kinds(skin.show()) == [("end", 1)]


def test_pieces_that_come_together_again_are_one_contact_for_as_long_as_they_do():
    skin = Skin()
    whole, pieces = set(range(12)), {0, 4, 5, 6}
    skin.show(whole)
    for _ in range(20):
        assert kinds(skin.show(pieces)) == [("move", 1)]
        assert kinds(skin.show(whole)) == [("move", 1)]


def test_where_a_contact_parts_the_larger_piece_keeps_the_name():
    skin = Skin()
    small, large = {0}, {4, 5, 6}
    skin.show(set(range(12)))
    for _ in range(PARTED_NS // SWEEP_NS + 1):
        assert kinds(skin.show(small, large)) in ([], [("move", 1)])
    events = skin.show(small, large)
    assert sorted((event.event, event.id, len(event.taxels)) for event in events) == [
        ("begin", 2, 1),
        ("move", 1, 3),
    ]


def test_a_piece_that_hardly_feels_anything_is_no_contact_of_its_own():
    skin = Skin()
    skin.show(set(range(12)))
    for _ in range(20):
        assert kinds(skin.show({0}, {4, 5, 6}, kpa=1.0)) in ([], [("move", 1)])


def test_a_piece_that_noise_lifts_for_a_moment_is_no_contact_of_its_own():
    """A noisy taxel that releases late: its mean is far below what a piece must feel."""
    skin = Skin()
    skin.show(set(range(12)), kpa=50.0)
    for kpa in (12.0, 0.0, 5.0, 12.0, 3.0, 0.0) * 5:
        assert kinds(skin.show({0}, {4, 5, 6}, kpa=50.0, unlike={0: kpa})) in ([], [("move", 1)])


def test_a_change_of_pressure_moves_and_noise_does_not():
    skin = Skin()
    skin.show(HERE, kpa=20.0)
    assert skin.show(HERE, kpa=20.5) == []
    assert kinds(skin.show(HERE, kpa=30.0)) == [("move", 1)]


def test_a_force_that_grows_beside_a_pad_at_the_end_of_its_scale_is_reported():
    """The peak stays, and so does the centroid."""
    skin = Skin()
    middle_m = LAYOUT.area_mm2 @ LAYOUT.position_m / LAYOUT.area_mm2.sum()
    middle = int(np.linalg.norm(LAYOUT.position_m - middle_m, axis=1).argmin())
    reported_n = 0.0
    for kpa in range(10, 60):
        events = skin.show(set(range(N)), kpa=float(kpa), unlike={middle: 257.0})
        reported_n = events[-1].force_n if events else reported_n
        other = LAYOUT.area_mm2.sum() - LAYOUT.area_mm2[middle]
        force_n = 1e-3 * (kpa * other + 257.0 * LAYOUT.area_mm2[middle])
        assert reported_n == pytest.approx(force_n, rel=0.25)


def test_moves_come_no_faster_than_wanted():
    skin = Skin()
    skin.tracker = ContactTracker(
        LAYOUT, 0, flat_skin(1, processing={"touch": {"move_hz": 10.0}})[0]
    )
    said = sum(len(skin.show(HERE, kpa=20.0 + 5.0 * number)) for number in range(50))
    assert said == pytest.approx(50 * SWEEP_NS * 1e-9 * 10.0, abs=2)


def test_a_lost_frame_is_not_the_end_of_a_touch():
    skin = Skin()
    skin.show(HERE)
    for _ in range(5):
        assert skin.show(HERE, lost=HERE) == []
    assert skin.show(HERE) == []


def test_a_touch_of_which_nothing_is_heard_for_long_ends():
    skin = Skin()
    skin.show(HERE)
    sweeps = LOST_NS // SWEEP_NS + 2
    events = [event for _ in range(sweeps) for event in skin.show(HERE, lost=HERE)]
    assert kinds(events) == [("end", 1)]


@pytest.mark.parametrize("comes_back", [False, True])
def test_a_contact_of_which_a_part_was_not_received_to_its_end_is_lost(comes_back: bool) -> None:
    """What was not received may still be touched, however long it has not been."""
    skin = Skin()
    away = set(list(HERE)[:3])
    skin.show(HERE)
    for _ in range(3 * (LOST_NS // SWEEP_NS)):
        skin.show(HERE, lost=away)
    skin.show(HERE - away, lost=set() if comes_back else away)
    (end,) = skin.show(lost=set() if comes_back else away)
    assert end.reason == ("released" if comes_back else "lost")


#: Two triangles next to each other, a taxel of the second harder pressed than all others.
WIDE, SECOND, UNEVEN = set(range(24)), set(range(12, 24)), {13: 60.0}


def measured(event):
    """What an event reports of its contact, without what names and dates it."""
    return msgspec.structs.replace(event, event="move", seq=0, t_ns=0)


@given(st.lists(st.sets(st.integers(0, 23), max_size=23), max_size=80))
def test_lost_frames_change_nothing_of_a_steady_contact(losses):
    skin = Skin()
    (begun,) = skin.show(WIDE, unlike=UNEVEN)
    missing = dict.fromkeys(WIDE, 0)
    for lost in losses:
        missing = {taxel: missing[taxel] + 1 if taxel in lost else 0 for taxel in WIDE}
        away = {taxel for taxel in lost if missing[taxel] < LOST_NS // SWEEP_NS}
        pressed = {taxel: UNEVEN[taxel] for taxel in UNEVEN if taxel not in away}
        for moved in skin.show(WIDE, lost=away, unlike=pressed):
            assert moved.event == "move"
            assert measured(moved) == measured(begun)


def test_a_contact_is_measured_by_what_was_received_and_what_was_last_received_of_the_rest():
    skin = Skin()
    skin.show(WIDE, kpa=20.0)
    skin.show(WIDE, kpa=20.0, lost=SECOND)
    (moved,) = skin.show(WIDE, kpa=40.0, lost=SECOND)
    area_mm2 = LAYOUT.area_mm2[:24].sum()
    assert moved.taxels == sorted(WIDE)
    assert moved.area_mm2 == pytest.approx(area_mm2)
    assert moved.mean_kpa == pytest.approx(30.0)
    assert moved.force_n == pytest.approx(30.0 * area_mm2 * 1e-3)


def test_the_most_pressed_taxel_is_the_peak_of_its_contact_while_it_is_not_received():
    skin = Skin()
    skin.show(WIDE, unlike=UNEVEN)
    (moved,) = skin.show(WIDE, kpa=40.0, lost=SECOND)
    assert moved.peak_kpa == 60.0


def test_taxels_that_are_not_received_for_long_leave_their_contact_one_by_one():
    skin = Skin()
    skin.show(WIDE)
    sweeps = LOST_NS // SWEEP_NS
    left = {}
    for number in range(2 * sweeps):
        lost = SECOND if number >= 5 else set(range(12, 18))
        for event in skin.show(WIDE, lost=lost):
            assert event.event == "move"
            assert event.mean_kpa == pytest.approx(20.0)
            left[number] = len(event.taxels)
    assert left == {sweeps - 1: 18, sweeps + 4: 12}


def test_a_taxel_that_is_received_again_untouched_has_left_its_contact():
    skin = Skin()
    skin.show(WIDE)
    assert skin.show(WIDE, lost=SECOND) == []
    (moved,) = skin.show(WIDE - SECOND)
    assert set(moved.taxels) == WIDE - SECOND
    (end,) = skin.show()
    assert end.reason == "released"


def test_a_contact_released_after_all_its_lost_taxels_came_back_is_released_with_any_loss():
    skin = Skin()
    skin.show(WIDE)
    for _ in range(LOST_NS // SWEEP_NS + 2):
        skin.show(WIDE, lost=SECOND)
    skin.show(WIDE - SECOND)
    (end,) = skin.show(lost=SECOND)
    assert end.reason == "released"


def test_a_piece_that_is_not_received_begins_no_contact_until_it_is():
    skin = Skin()
    small, large = {0}, {4, 5, 6}
    skin.show(set(range(12)))
    skin.show(small, large)
    for _ in range(2 * (PARTED_NS // SWEEP_NS)):
        assert skin.show(small, large, lost=small) == []
    events = skin.show(small, large)
    assert {(event.event, *event.taxels) for event in events} == {("begin", 0), ("move", 4, 5, 6)}


def test_the_tracker_that_replaces_another_knows_what_its_contacts_felt():
    skin = Skin()
    (begun,) = skin.show(WIDE, unlike=UNEVEN)
    skin.tracker = ContactTracker(LAYOUT, 0, SETTINGS, skin.tracker)
    for _ in range(LOST_NS // SWEEP_NS - 1):
        assert skin.show(WIDE, lost=SECOND) == []
        skin.tracker = ContactTracker(LAYOUT, 0, SETTINGS, skin.tracker)
    for number in range(ALIVE_NS // SWEEP_NS):
        for moved in skin.show(WIDE, lost=SECOND if number % 2 else (), unlike=UNEVEN):
            assert measured(moved) == measured(begun)


def test_what_was_felt_before_all_contacts_were_ended_is_forgotten():
    skin = Skin()
    skin.show(WIDE, kpa=60.0)
    skin.tracker.end_all(0, 0)
    (begun,) = skin.show({0}, lost=SECOND)
    assert (begun.taxels, begun.peak_kpa, begun.partial) == ([0], 20.0, True)
    (moved,) = skin.show({0})
    assert (moved.taxels, moved.peak_kpa, moved.partial) == ([0], 20.0, False)
    assert skin.show({0}) == []


def test_a_contact_that_merges_while_taxels_are_not_received_is_not_lost():
    """They are in the contact that continues."""
    skin = Skin()
    skin.show({0}, {4, 5, 6})
    for _ in range(MERGED_NS // SWEEP_NS):
        skin.show(set(range(12)))
    ended, moved = skin.show(set(range(12)), lost={0})
    assert (ended.event, ended.reason) == ("end", "released")
    assert moved.taxels == list(range(12))


def test_a_contact_whose_piece_became_another_while_it_was_not_received_is_not_lost():
    skin = Skin()
    small, large = {0, 1}, {4, 5, 6}
    skin.show(set(range(12)))
    for _ in range(PARTED_NS // SWEEP_NS + 2):
        skin.show(small, large, lost={1})
    (end,) = skin.show(small, lost={1})
    assert (end.id, end.reason) == (1, "released")


def test_a_wide_press_is_one_contact_though_a_third_of_all_can_frames_is_lost():
    """Each of the ten triangles misses half of the sweeps, since it takes two frames."""
    rig = Rig(1, 0.4, hz=50)
    tracker = ContactTracker(rig.layout, 0, rig.settings)
    rng = np.random.default_rng(5)
    pressed = np.where(np.arange(rig.n) < 120, 20.0, 0.0)
    forces_n, ends = [], []
    begun = 0
    for sweep in range(60 * 50):
        rig.t_ns += SWEEP_NS
        loss = 0.3 if sweep >= 150 else 0.0
        present = np.repeat((rng.random((16, 2)) >= loss).all(axis=1), 12)
        raw = np.where(present, rig.read(pressed if sweep >= 100 else 0.0), 0).astype(np.uint8)
        for event in tracker.step(rig.pipeline.step(0, raw, present, rig.t_ns)):
            begun += event.event == "begin"
            if event.event == "end":
                ends.append(event.reason)
            elif sweep >= 150:
                forces_n.append(event.force_n)
    assert (begun, ends) == (1, [])
    assert len(forces_n) >= 57
    assert np.abs(np.diff(forces_n)).max() < 0.03 * min(forces_n)


def test_where_nothing_is_left_to_feel_the_place_stays():
    skin = Skin()
    (begin,) = skin.show(HERE)
    events = skin.show(HERE, kpa=0.3)
    assert all(event.centroid_m == begin.centroid_m for event in events)


def test_a_light_touch_of_pads_in_fine_units_is_where_it_has_slid_to():
    fine = replace(LAYOUT, unit_ff=LAYOUT.unit_ff / 4)
    skin = Skin(fine)
    (begin,) = skin.show({0}, kpa=1.2)
    (moved,) = skin.show({1}, kpa=1.2)
    assert begin.centroid_m == pytest.approx(LAYOUT.position_m[0].tolist())
    assert moved.centroid_m == pytest.approx(LAYOUT.position_m[1].tolist())


def test_where_hardly_anything_is_left_to_feel_the_normal_stays():
    tilted = LAYOUT.normal.copy()
    tilted[0], tilted[1] = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    skin = Skin(replace(LAYOUT, normal=tilted))
    (begin,) = skin.show({0, 1})
    (moved,) = skin.show({0, 1}, kpa=0.3, unlike={0: 1.5})
    assert moved.normal == begin.normal == pytest.approx([0.5**0.5, 0.5**0.5, 0.0], abs=1e-3)


def test_stopping_ends_every_contact():
    skin = Skin()
    skin.show(HERE, THERE)
    assert kinds(skin.tracker.end_all(7, 7)) == [("end", 1), ("end", 2)]
    assert skin.tracker.end_all(8, 8) == []


def test_many_contacts_keep_their_names_whatever_the_others_do():
    skin = Skin()
    apart = [{taxel} for taxel in range(0, N, 12)]
    begun = skin.show(*apart)
    assert [event.id for event in begun] == list(range(1, len(apart) + 1))
    for number, taxel in enumerate(apart):
        others = [other for other in apart if other != taxel]
        assert kinds(skin.show(*others)) == [("end", number + 1)]
        assert kinds(skin.show(*apart)) == [("begin", len(apart) + number + 1)]
    names = {event.taxels[0]: event.id for event in skin.show(*apart, kpa=60.0)}
    assert sorted(names.values()) == list(range(len(apart) + 1, 2 * len(apart) + 1))


@given(st.lists(st.sets(st.integers(0, 47), max_size=20), max_size=30))
def test_every_touched_taxel_is_in_one_contact_and_every_begin_has_its_end(frames):
    skin = Skin()
    alive = {}
    for touched in frames:
        for event in skin.show(touched):
            if event.event == "begin":
                assert event.id not in alive
            else:
                assert event.id in alive
            if event.event == "end":
                del alive[event.id]
            else:
                alive[event.id] = event
        said = [taxel for event in alive.values() for taxel in event.taxels]
        assert sorted(said) == sorted(touched)
    ended = {event.id for event in skin.tracker.end_all(0, 0)}
    assert ended == set(alive)


@pytest.mark.parametrize("set_s", [0, 3600, -3600])
def test_a_contact_that_lasts_is_reported_each_second_though_the_clock_was_set(set_s):
    skin = Skin()
    skin.show(HERE)
    skin.set_ns = set_s * 1_000_000_000
    said = [kinds(skin.show(HERE)) for _ in range(ALIVE_NS // SWEEP_NS)]
    assert said == [[]] * (len(said) - 1) + [[("move", 1)]]


SHOWN = st.tuples(
    st.sets(st.integers(0, 23), max_size=12),
    st.sets(st.integers(0, 23), max_size=2),
    st.sampled_from([1.0, 5.0, 20.0, 100.0]),
    st.sampled_from([0, 0, 0, 100_000_000, -100_000_000, 3_600_000_000_000, -3_600_000_000_000]),
)


@given(st.lists(SHOWN, max_size=40))
def test_a_clock_that_is_set_changes_nothing_of_an_event_but_its_time(frames):
    followed, steady = Skin(), Skin()
    for touched, lost, kpa, step_ns in frames:
        followed.set_ns += step_ns
        found = followed.show(touched, lost=lost, kpa=kpa)
        expected = steady.show(touched, lost=lost, kpa=kpa)
        assert expected == [
            msgspec.structs.replace(event, t_ns=event.t_ns - followed.set_ns) for event in found
        ]


def test_a_press_of_the_whole_skin_keeps_the_name_of_the_larger_contact_that_it_covers():
    skin = Skin()
    larger = HERE | set(range(12, 24))
    assert kinds(skin.show(larger, THERE)) == [("begin", 1), ("begin", 2)]
    for _ in range(MERGED_NS // SWEEP_NS + 2):
        events = skin.show(set(range(N)))
        assert {event.id for event in events if event.event != "end"} <= {1, 2}
        for event in events:
            assert event.taxels == sorted(event.taxels)
    assert kinds(skin.show()) == [("end", 1)]


@pytest.mark.parametrize("first", [0, 77, N - 1])
def test_a_press_of_the_whole_skin_continues_the_contact_of_one_taxel(first):
    skin = Skin()
    assert kinds(skin.show({first})) == [("begin", 1)]
    assert kinds(skin.show(set(range(N)))) == [("move", 1)]


def test_a_press_of_the_whole_skin_is_one_contact_to_its_end():
    skin = Skin()
    (begun,) = skin.show(set(range(N)))
    assert begun.taxels == list(range(N))
    assert skin.show(set(range(N))) == []
    assert kinds(skin.show()) == [("end", 1)]


@pytest.mark.parametrize(("seconds", "contacts"), [(4.0, 1), (9.0, 2)])
def test_a_fifth_of_what_a_contact_felt_lately_is_what_makes_its_piece_another(seconds, contacts):
    """Ten seconds after a press of 100 kPa, 37 of them count."""
    skin = Skin()
    skin.show(set(range(12)), kpa=100.0)
    for _ in range(round(seconds * 1e9) // SWEEP_NS):
        skin.show(set(range(12)), kpa=10.0)
    begun = {1}
    for _ in range(PARTED_NS // SWEEP_NS + 2):
        begun |= {event.id for event in skin.show({0}, {4, 5, 6}, kpa=10.0)}
    assert len(begun) == contacts


def test_the_uncertainty_of_a_place_falls_with_the_root_of_its_taxels():
    (few,), (many,) = Skin().show({0, 1, 2}), Skin().show(set(range(12)))
    assert few.sigma_m == pytest.approx(2 * many.sigma_m)
    assert 0.1e-3 < many.sigma_m < few.sigma_m < 2e-3


def test_the_uncertainty_of_a_place_grows_with_the_distance_of_taxels_wherever_the_part_is():
    wide = replace(LAYOUT, position_m=2.0 * LAYOUT.position_m + 1.0)
    (event,), (usual,) = Skin(wide).show(HERE), Skin().show(HERE)
    assert event.sigma_m == pytest.approx(2.0 * usual.sigma_m)


def test_the_place_of_a_pad_without_neighbours_is_as_certain_as_that_of_a_pad_of_its_kind():
    alone = replace(LAYOUT, neighbour_start=np.zeros_like(LAYOUT.neighbour_start))
    (event,), (usual,) = Skin(alone).show({0}), Skin().show({0})
    assert event.sigma_m == pytest.approx(usual.sigma_m, rel=1e-3)


def test_pads_that_lie_on_each_other_are_not_certain_of_their_place():
    """Duplicates in a file of positions, or one in millimetres read as micrometres."""
    twice = LAYOUT.position_m.copy()
    twice[1::2] = twice[::2]
    (usual,) = Skin().show(HERE)
    for position_m in (twice, 1e-3 * LAYOUT.position_m, np.zeros_like(twice)):
        (event,) = Skin(replace(LAYOUT, position_m=position_m)).show(HERE)
        assert event.sigma_m >= 0.99 * usual.sigma_m


def test_pads_that_feel_temperature_make_no_place_more_certain():
    skin = {
        "robot": "ten",
        "buses": {"can0": {}},
        "boards": {"b": {"bus": "can0", "address": 1}},
        "parts": {
            "skin": {"patches": [{"board": "b", "triangles": "0-15", "kind": "triangle_10pad"}]}
        },
    }
    layout = build_layout(msgspec.convert(skin, Settings), Path())
    (event,) = Skin(layout).show({0})
    pads_m = layout.position_m[layout.pad_kind == PadKind.PRESSURE]
    pitch_m = np.median(nearest_distance(pads_m))
    assert pitch_m > 1.2 * np.median(nearest_distance(layout.position_m))
    assert event.sigma_m == pytest.approx(GEOMETRY_PITCHES * pitch_m, rel=1e-3)


def test_a_contact_beside_pads_that_are_not_valid_is_partial_and_less_certain_of_its_place():
    beside = _beside(HERE)
    (whole,), (far,) = Skin().show(HERE), Skin().show(HERE, lost=THERE)
    assert (whole.partial, far.partial) == (False, False)
    assert (whole.centroid_m, whole.sigma_m) == (far.centroid_m, far.sigma_m)
    (event,) = Skin().show(HERE, lost=beside)
    assert event.partial
    assert (event.centroid_m, event.force_n) == (whole.centroid_m, whole.force_n)
    # Where the contact would be if the same pressure were on those pads, too.
    (more,) = Skin().show(HERE | beside)
    away_m = math.dist(more.centroid_m, event.centroid_m)
    assert away_m > 1e-3
    assert event.sigma_m >= 0.99 * math.hypot(whole.sigma_m, away_m)


def test_pads_that_feel_temperature_and_never_pressure_make_no_contact_partial():
    kind = LAYOUT.pad_kind.copy()
    kind[[6, 10]] = PadKind.THERMAL
    (event,) = Skin(replace(LAYOUT, pad_kind=kind)).show(HERE - {6, 10}, lost={6, 10})
    assert not event.partial


def test_a_contact_that_loses_a_part_of_itself_is_partial_until_that_is_valid_again():
    skin = Skin()
    skin.show(HERE)
    lost = {taxel for taxel in HERE if LAYOUT.position_m[taxel, 0] > LAYOUT.position_m[5, 0]}
    assert 0 < len(lost) < len(HERE)
    partial = []
    for _ in range(2 * LOST_NS // SWEEP_NS):
        partial += [event.partial for event in skin.show(HERE, lost=lost)]
    assert set(partial) == {True}
    moved = skin.show(HERE)[-1]
    assert (moved.taxels, moved.partial) == (sorted(HERE), False)


def test_the_first_and_the_last_pad_beside_a_contact_that_is_not_valid_are_reported():
    """Nothing of the contact itself has changed then."""
    skin = Skin()
    reported = []
    for number in range(150):
        lost = _beside(HERE) if 40 <= number < 100 else ()
        reported += [(number, event.partial) for event in skin.show(HERE, lost=lost)]
    gone = 40 + LOST_NS // SWEEP_NS
    first, back = reported.index((gone - 1, True)), reported.index((100, False))
    assert {partial for _, partial in reported[first:back]} == {True}
    assert {partial for _, partial in reported[:first] + reported[back:]} == {False}


def _beside(taxels):
    """The neighbours of some taxels that are none of them."""
    start = LAYOUT.neighbour_start
    near = [LAYOUT.neighbour[start[taxel] : start[taxel + 1]].tolist() for taxel in taxels]
    return set().union(*near) - set(taxels)


@pytest.mark.parametrize(("kpa", "moves"), [(19.5, False), (17.0, True)])
def test_a_place_that_moves_by_a_fifth_of_a_millimetre_is_reported(kpa, moves):
    skin = Skin()
    skin.show({0, 1})
    events = skin.show({0, 1}, unlike={1: kpa})
    assert bool(events) is moves


def test_a_touch_that_is_lost_for_less_than_half_a_second_goes_on_whenever_that_is():
    skin = Skin()
    for number in range(200):
        lost = HERE if number % 25 else ()
        assert {event.event for event in skin.show(HERE, lost=lost)} <= {"begin", "move"}
    assert skin.tracker.end_all(0, 0)[0].id == 1


def test_what_feels_no_pressure_yet_is_a_contact_without_a_place():
    skin = Skin()
    (begun,) = skin.show({0}, kpa=0.0)
    assert (begun.event, begun.centroid_m, begun.normal) == ("begin", None, None)
    assert skin.show({0}, kpa=0.5) == []
    (moved,) = skin.show({0}, kpa=2.0)
    assert moved.centroid_m == pytest.approx(LAYOUT.position_m[0].tolist())
    assert moved.normal == pytest.approx([0.0, 0.0, 1.0])


def test_the_normal_of_a_contact_is_the_mean_of_its_taxels_of_length_one():
    alike = replace(LAYOUT, area_mm2=np.full(N, 20.0))
    tilted = LAYOUT.normal.copy()
    tilted[0], tilted[1] = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    (event,) = Skin(replace(alike, normal=tilted)).show({0, 1})
    assert event.normal == pytest.approx([0.5**0.5, 0.5**0.5, 0.0])
    tilted[1] = (-1.0, 0.0, 0.0)
    (event,) = Skin(replace(alike, normal=tilted)).show({0, 1})
    assert event.normal is None


def test_taxels_of_a_second_part_are_neighbours_as_those_of_the_first():
    skin = msgspec.convert(
        {
            "robot": "two",
            "buses": {"can0": {}},
            "boards": {"b0": {"bus": "can0", "address": 1}, "b1": {"bus": "can0", "address": 2}},
            "parts": {
                name: {"patches": [{"board": board, "triangles": "0-15"}]}
                for name, board in (("first", "b0"), ("second", "b1"))
            },
        },
        Settings,
    )
    layout = build_layout(skin, Path())
    tracker = ContactTracker(layout, 1, skin)
    touched = np.zeros(N, bool)
    touched[sorted(HERE | THERE)] = True
    frame = PressureFrame(
        "second",
        0,
        0,
        np.zeros(N, np.uint8),
        np.where(touched, 20.0, 0.0).astype(np.float32),
        touched,
        np.ones(N, bool),
        np.zeros(N, bool),
    )
    assert [set(event.taxels) for event in tracker.step(frame)] == [HERE, THERE]
