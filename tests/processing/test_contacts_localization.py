"""Where a contact is said to be, from an emulated press to the event."""

from dataclasses import replace
from typing import Any, get_args

import msgspec
import numpy as np
import pytest

from emulator.probes.foam import Drive, Foam, FoamLayer
from emulator.probes.pads import UNIT_FF, Disc, Pads
from emulator.probes.viscoelastic import FoamTruth
from skin_host.config.settings import Settings, load
from skin_host.errors import ConfigurationError
from skin_host.layout import Layout, build_layout
from skin_host.processing.contacts import ContactTracker
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from skin_host.processing.localization import Method
from skin_host.processing.pressure import PressureCurve

UNITS = 57.0
NOISE_UNITS = 0.4
TOUCHED_UNITS = 3.0
SIDE_MM = np.array([8.0, 0.0])
CONFIGURATION = """
robot = "r"
buses.can0 = {{}}
boards.b = {{ bus = "can0", address = 1 }}
[parts.palm]
{keys}
patches = [{{ board = "b", triangles = "0-15" }}]
"""


@pytest.fixture
def configured(tmp_path):
    def make(keys: str = "") -> tuple[Settings, Layout]:
        path = tmp_path / "robot.toml"
        path.write_text(CONFIGURATION.format(keys=keys))
        settings = load(path)
        return settings, build_layout(settings, tmp_path)

    return make


class PressedPalm:
    """Frames of the palm under the emulator's foam and pads, new foam for every press."""

    def __init__(self, layout: Layout) -> None:
        self.rng = np.random.default_rng(5)
        self.layout = layout
        self.centre_mm = 1e3 * layout.position_m[:, :2]
        self.foam_mm = layout.parts[0].foam_mm
        self.pads = Pads(self.centre_mm, layout.radius_mm, self.foam_mm)
        self.curve = PressureCurve(layout.unit_ff / layout.sensitivity)
        self.seq = 0

    def inside(self) -> np.ndarray:
        """A place in the middle of the palm, mm."""
        middle = self.centre_mm.mean(axis=0)
        return middle + self.rng.uniform(-6.0, 6.0, 2)

    def press(
        self,
        *probes: tuple[np.ndarray, float],
        diameter_mm: float = 10.0,
        lost: list[int] | None = None,
    ) -> PressureFrame:
        """One frame; `probes` are places (mm) and shares of the strength."""
        n = len(self.centre_mm)
        truth = FoamTruth("S", n, rng=self.rng)
        foam = FoamLayer(Foam.drawn(n, self.rng, self.foam_mm), truth)
        footprint = self.pads.footprint([Disc(*place, diameter_mm) for place, _ in probes])
        rise_ff = np.array([share * UNITS * UNIT_FF for _, share in probes])
        c0_ff = float(self.pads.c0_ff[0])
        depth = Drive.by_depth(self.foam_mm * rise_ff / (c0_ff + rise_ff))
        foam.step(footprint, depth, 0.02)
        felt = foam.step(footprint, depth, 0.5)
        exact = self.pads.rise_ff(felt, footprint) / UNIT_FF
        units = np.round(exact + NOISE_UNITS * self.rng.normal(size=n))
        valid = np.ones(n, bool)
        valid[lost or []] = False
        kpa = np.where(valid, np.maximum(self.curve.kpa(units), 0.0), 0.0).astype(np.float32)
        touched = valid & (units > TOUCHED_UNITS)
        self.seq += 1
        raw = np.clip(240 - units, 0, 255).astype(np.uint8)
        t_ns = 50_000_000 * self.seq
        return PressureFrame(
            "palm", self.seq, t_ns, raw, kpa, touched, valid, ~valid, elapsed_ns=t_ns
        )


def off_mm(event: Touch, place: np.ndarray) -> float:
    assert event.centroid_m is not None
    return float(np.linalg.norm(1e3 * np.array(event.centroid_m[:2]) - place))


def first_events(tracker: ContactTracker, frame: PressureFrame) -> list[Touch]:
    """What is told of a frame when no contact was there before it."""
    events = tracker.step(frame)
    tracker.end_all(frame.seq, frame.t_ns)
    return events


def test_a_template_is_nearer_to_a_10_mm_press_than_the_centroid(configured):
    plain, layout = configured()
    template, _ = configured('localization = "template"')
    palm = PressedPalm(layout)
    trackers = [ContactTracker(layout, 0, settings) for settings in (plain, template)]
    found = []
    for _ in range(60):
        place = palm.inside()
        frame = palm.press((place, 1.0))
        events = [tracker.step(frame)[-1] for tracker in trackers]
        for tracker in trackers:
            tracker.end_all(frame.seq, frame.t_ns)
        found.append([off_mm(event, place) for event in events])
    centroid_mm, template_mm = np.sqrt((np.array(found) ** 2).mean(axis=0))
    assert template_mm < 0.3
    assert template_mm < 0.5 * centroid_mm


@pytest.mark.parametrize("method", get_args(Method))
def test_the_error_told_is_of_the_size_of_the_error_made(configured, method):
    settings, layout = configured(f'localization = "{method}"')
    tracker = ContactTracker(layout, 0, settings)
    palm = PressedPalm(layout)
    made, told = [], []
    for _ in range(60):
        place = palm.inside()
        event = first_events(tracker, palm.press((place, 1.0)))[0]
        assert event.sigma_m is not None
        made.append(off_mm(event, place))
        told.append(1e3 * event.sigma_m)
    ratio = np.sqrt(np.mean(np.square(made)) / np.mean(np.square(told)))
    assert 0.4 < ratio < 2.5


@pytest.mark.parametrize("method", get_args(Method))
@pytest.mark.parametrize("diameter_mm", [6.0, 20.0])
def test_beside_a_triangle_that_is_not_valid_the_error_told_is_that_of_what_is_not_felt(
    configured, method, diameter_mm
):
    settings, layout = configured(f'localization = "{method}"')
    tracker = ContactTracker(layout, 0, settings)
    palm = PressedPalm(layout)
    lost = list(range(60, 72))
    middle = palm.centre_mm[lost].mean(axis=0)
    made, told = [], []
    for _ in range(60):
        place = middle + palm.rng.uniform(-14.0, 14.0, 2)
        events = first_events(tracker, palm.press((place, 1.0), diameter_mm=diameter_mm, lost=lost))
        if len(events) == 1 and events[0].partial:
            assert events[0].sigma_m is not None
            made.append(off_mm(events[0], place))
            told.append(1e3 * events[0].sigma_m)
    assert len(made) > 20
    assert np.sqrt(np.mean(np.square(made))) < np.sqrt(np.mean(np.square(told)))


def test_one_size_of_probe_may_be_named(configured):
    settings, layout = configured('localization = "template"\nprobe_mm = [10]')
    tracker = ContactTracker(layout, 0, settings)
    palm = PressedPalm(layout)
    place = palm.inside()
    (event,) = first_events(tracker, palm.press((place, 1.0)))
    assert off_mm(event, place) < 0.5


def test_of_a_contact_wider_than_any_probe_the_template_says_no_more_than_the_centroid(configured):
    settings, layout = configured('localization = "template"')
    tracker = ContactTracker(layout, 0, settings)
    palm = PressedPalm(layout)
    for _ in range(20):
        place = palm.inside()
        (event,) = first_events(tracker, palm.press((place, 1.0), diameter_mm=24.0))
        assert off_mm(event, place) < 1.5
        assert event.sigma_m is not None
        assert event.sigma_m > 0.2e-3


def test_a_contact_somewhat_wider_than_any_probe_is_told_with_less_certainty(configured):
    settings, layout = configured('localization = "template"')
    tracker = ContactTracker(layout, 0, settings)
    palm = PressedPalm(layout)
    made, told = [], []
    for _ in range(15):
        place = palm.inside()
        (event,) = first_events(tracker, palm.press((place, 1.0), diameter_mm=14.0))
        made.append(off_mm(event, place))
        told.append(1e3 * (event.sigma_m or 0.0))
    assert np.sqrt(np.mean(np.square(made))) < 2.0 * np.sqrt(np.mean(np.square(told)))


def test_two_presses_on_one_patch_are_told_apart_unless_the_plain_mean_is_asked_for(configured):
    plain, layout = configured()
    template, _ = configured('localization = "template"')
    palm = PressedPalm(layout)
    middle = palm.centre_mm.mean(axis=0)
    places = [middle - SIDE_MM, middle + SIDE_MM]
    frame = palm.press((places[0], 1.0), (places[1], 0.8))
    assert len(first_events(ContactTracker(layout, 0, plain), frame)) == 1
    first, second = first_events(ContactTracker(layout, 0, template), frame)
    assert not set(first.taxels) & set(second.taxels)
    assert off_mm(first, places[0]) < 1.0
    assert off_mm(second, places[1]) < 1.0


def begins_and_ends(configured, is_even):
    """Two presses of one patch, which seem to be one even press in some of the frames."""
    settings, layout = configured('localization = "template"')
    palm = PressedPalm(layout)
    tracker = ContactTracker(layout, 0, settings)
    middle = palm.centre_mm.mean(axis=0)
    two = palm.press((middle - SIDE_MM, 1.0), (middle + SIDE_MM, 0.8))
    even = replace(two, pressure_kpa=np.where(two.touched, 20.0, 0.0).astype(np.float32))
    events = []
    for number, seems_one in enumerate(is_even):
        shown = even if seems_one else two
        events += tracker.step(replace(shown, elapsed_ns=50_000_000 * number))
    return [event.event for event in events if event.event != "move"]


def test_a_contact_that_becomes_two_on_the_same_taxels_parts(configured):
    assert begins_and_ends(configured, [True] * 3 + [False] * 5) == ["begin", "begin"]


def test_two_presses_whose_pass_is_high_now_and_then_stay_two(configured):
    is_even = [number % 25 == 24 for number in range(100)]
    assert begins_and_ends(configured, is_even) == ["begin", "begin"]


def test_a_contact_that_parts_keeps_its_name_on_the_stronger_side(configured):
    settings, layout = configured('localization = "template"')
    palm = PressedPalm(layout)
    tracker = ContactTracker(layout, 0, settings)
    middle = palm.centre_mm.mean(axis=0)
    left, right = middle - SIDE_MM, middle + SIDE_MM
    (begun,) = tracker.step(palm.press((left, 0.7)))
    moved, other = tracker.step(palm.press((left, 1.0), (right, 0.8)))
    assert (moved.event, moved.id) == ("move", begun.id)
    assert other.event == "begin"
    assert other.id != begun.id
    assert off_mm(moved, left) < 1.0


def test_a_lost_taxel_is_not_believed_to_be_untouched(configured):
    settings, layout = configured('localization = "template"')
    tracker = ContactTracker(layout, 0, settings)
    palm = PressedPalm(layout)
    found = []
    for _ in range(20):
        place = palm.inside()
        away = np.linalg.norm(palm.centre_mm - place, axis=1)
        frame = palm.press((place, 1.0), lost=[int(np.argsort(away)[1])])
        found.append(off_mm(first_events(tracker, frame)[0], place))
    assert np.sqrt(np.mean(np.square(found))) < 0.6


@pytest.mark.parametrize("method", get_args(Method))
def test_lost_frames_change_nothing_of_the_place_of_a_steady_contact(configured, method):
    settings, layout = configured(f'localization = "{method}"')
    palm = PressedPalm(layout)
    frame = palm.press((palm.inside(), 1.0))
    tracker = ContactTracker(layout, 0, settings)
    (begun,) = tracker.step(frame)
    for number in range(1, 60):
        valid = np.ones(layout.n_taxels, np.bool_)
        # Each triangle in turn, then half of the palm.
        first = 12 * (number % 16)
        valid[first : first + (12 if number < 32 else 96)] = False
        lossy = replace(
            frame,
            pressure_kpa=np.where(valid, frame.pressure_kpa, np.float32(0.0)),
            touched=frame.touched & valid,
            valid=valid,
            elapsed_ns=frame.elapsed_ns + 20_000_000 * number,
        )
        for moved in tracker.step(lossy):
            assert moved.event == "move"
            assert (moved.centroid_m, moved.sigma_m) == (begun.centroid_m, begun.sigma_m)
            assert (moved.force_n, moved.taxels) == (begun.force_n, begun.taxels)
    assert [event.id for event in tracker.end_all(0, 0)] == [begun.id]


def test_a_taxel_lost_before_a_press_is_not_believed_to_be_untouched(configured):
    settings, layout = configured('localization = "template"')
    palm = PressedPalm(layout)
    place = palm.inside()
    away = np.linalg.norm(palm.centre_mm - place, axis=1)
    lossy = palm.press((place, 1.0), lost=[int(np.argsort(away)[1])])
    used = ContactTracker(layout, 0, settings)
    pressed, rest = palm.press((place, 1.0)), palm.press((place, 0.0))
    for number, frame in enumerate([pressed, rest, rest]):
        used.step(replace(frame, elapsed_ns=lossy.elapsed_ns + 20_000_000 * number))
    (begun,) = used.step(replace(lossy, elapsed_ns=lossy.elapsed_ns + 60_000_000))
    (expected,) = first_events(ContactTracker(layout, 0, settings), lossy)
    assert (begun.taxels, begun.centroid_m) == (expected.taxels, expected.centroid_m)


def test_an_end_tells_where_the_contact_was_and_how_surely(configured):
    settings, layout = configured('localization = "template"')
    palm = PressedPalm(layout)
    tracker = ContactTracker(layout, 0, settings)
    frame = palm.press((palm.inside(), 1.0))
    (begun,) = tracker.step(frame)
    (end,) = tracker.end_all(frame.seq, frame.t_ns)
    assert (end.centroid_m, end.sigma_m) == (begun.centroid_m, begun.sigma_m)


@pytest.mark.parametrize(
    "keys",
    ['localization = "best"', "probe_mm = []", "probe_mm = [0]", f"probe_mm = {[6.0] * 17}"],
)
def test_a_wrong_choice_is_refused(configured, keys: Any):
    with pytest.raises(ConfigurationError, match=r"parts\.palm"):
        configured(keys)


def test_a_probe_that_covers_many_pads_wholly_is_refused(configured):
    with pytest.raises(ConfigurationError) as refused:
        configured('localization = "template"\nprobe_mm = [10, 400]')
    assert str(refused.value) == (
        "parts.palm.probe_mm: 400 mm; wanted at most 15 mm, 3 pitches of its pads: many pads read "
        'alike under a larger object, which localization = "centroid" locates better'
    )
    configured('localization = "template"\nprobe_mm = [15]')
    configured("probe_mm = [400]")


def test_the_plain_mean_is_the_default(configured):
    part = configured()[0].parts["palm"]
    assert part.localization == "centroid"
    assert msgspec.to_builtins(part)["probe_mm"] == [6.0, 8.0, 10.0, 12.0]


def test_contacts_are_located_by_activations_of_the_parts_median_pad(configured) -> None:
    settings, layout = configured('localization = "peak"')
    tracker = ContactTracker(layout, 0, settings)
    n = layout.n_taxels
    touched = np.arange(n) == 3
    pressure = np.where(touched, 20.0, 0.0).astype(np.float32)
    tracker.step(
        PressureFrame(
            "palm",
            0,
            0,
            np.zeros(n, np.uint8),
            pressure,
            touched,
            np.ones(n, bool),
            np.zeros(n, bool),
        )
    )
    curve = PressureCurve(float(np.median(layout.unit_ff / layout.sensitivity)))
    assert tracker._places is not None
    assert tracker._places._units[3] == pytest.approx(curve.units(np.full(1, 20.0))[0])
