import tracemalloc
from itertools import chain
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.layout import builtin_kinds
from skin_host.processing.localization import (
    MOST_TABLE_BYTES,
    Method,
    covered_share,
    make_localizer,
    separate,
)
from skin_host.processing.localization_centroid import tangent_plane

METHODS = get_args(Method)
RADIUS_MM = 2.1
#: To lay down one table takes no more than this.
MOST_BYTES = 120_000_000


def patch_of_triangles():
    """A triangle and the three that share an edge with it, and those at its corners."""
    kind = builtin_kinds()["triangle"]
    pads, outline = np.array(kind.pads_mm), np.array(kind.outline_mm)
    triangles = [pads]
    for corner in range(3):
        for turn in range(1, 6):
            angle = np.deg2rad(60 * turn)
            rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            turned = (pads - outline[corner]) @ rotation.T + outline[corner]
            middles = [np.linalg.norm(turned.mean(0) - other.mean(0)) for other in triangles]
            if min(middles) > 3.0:
                triangles.append(turned)
    return np.concatenate(triangles)


PADS_MM = patch_of_triangles()
POSITION_M = np.column_stack([PADS_MM, np.zeros(len(PADS_MM))]) * 1e-3
NORMAL = np.tile([0.0, 0.0, 1.0], (len(PADS_MM), 1))
ALL = np.ones(len(PADS_MM), bool)
NEIGHBOURS = [
    np.flatnonzero((d > 0.0) & (d < 8.0)).tolist()
    for d in np.linalg.norm(PADS_MM[:, None] - PADS_MM[None], axis=2)
]


LOCALIZERS = {
    method: make_localizer(method, POSITION_M, NORMAL, np.full(len(PADS_MM), RADIUS_MM))
    for method in METHODS
}


class PressedFoam:
    """What pads under a pressed foam read. It sums over points of each pad, not lenses.

    The foam is strained under the probe and a little around it (its cover is a membrane);
    capacitance is local, x / (1 - x); pads differ in strength; bytes are rounded.
    """

    def __init__(self, rng, *, gain_sd=0.02, noise_units=0.4, membrane_mm=0.1):
        axis = np.linspace(-RADIUS_MM, RADIUS_MM, 29)
        grid = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
        self.points = grid[np.hypot(*grid.T) <= RADIUS_MM]
        self.rng, self.noise, self.membrane = rng, noise_units, membrane_mm
        self.gain = np.exp(gain_sd * rng.normal(size=len(PADS_MM)))

    def clean(self, probes):
        """Units of each pad. `probes` are (x, y, diameter, units of a covered pad)."""
        units = np.zeros(len(PADS_MM))
        for x, y, diameter, full in probes:
            strain = full / (35.0 + full)  # 100 fF at rest, 2.88 fF a unit
            near = np.flatnonzero(np.hypot(*(PADS_MM - [x, y]).T) < diameter / 2 + 4.0)
            at = PADS_MM[near][:, None, :] + self.points[None]
            beyond = np.hypot(at[..., 0] - x, at[..., 1] - y) - diameter / 2
            local = strain * np.exp(-np.maximum(beyond, 0.0) / self.membrane)
            units[near] += (35.0 * local / (1.0 - local)).mean(axis=1)
        return units * self.gain

    def bytes(self, probes):
        noise = self.noise * self.rng.normal(size=len(PADS_MM))
        return np.clip(np.round(self.clean(probes) + noise), 0, 255)


def in_the_triangle(rng):
    """A place among the pads of the middle triangle."""
    a, b = np.sort(rng.uniform(size=2))
    corners = np.array([[-10, -5.774], [10, -5.774], [0, 11.547]])
    return np.array([a, b - a, 1 - b]) @ corners


def errors_mm(method, diameter, count=250, *, full=57.0, probe_mm=None, seed=0):
    """Radial errors and said standard errors over random presses."""
    rng = np.random.default_rng(seed)
    size = diameter if probe_mm is None else probe_mm
    localizer = make_localizer(
        method, POSITION_M, NORMAL, np.full(len(PADS_MM), RADIUS_MM), probe_mm=size
    )
    foam = PressedFoam(rng)
    error, said = [], []
    while len(error) < count:
        place = in_the_triangle(rng)
        units = foam.bytes([(*place, diameter, full)])
        touched = np.flatnonzero(units > 2.6)
        if len(touched) == 0:
            continue
        found = localizer.locate(touched, units, ALL)
        error.append(np.linalg.norm(1e3 * found.position_m[:2] - place))
        said.append(1e3 * found.sigma_m)
    return np.array(error), np.array(said)


def measured(work):
    """What some work returns, and the most memory, bytes, that it took at a time."""
    tracemalloc.start()
    try:
        return work(), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(("diameter", "limit_mm"), [(10.0, 0.3), (6.0, 0.7)])
def test_the_template_reaches_its_goal_and_beats_the_published_methods(diameter, limit_mm):
    found = {method: rms(errors_mm(method, diameter)[0]) for method in METHODS}
    best_published = min(found["centroid"], found["half_maximum"], found["peak"])
    assert found["template"] < limit_mm
    assert found["template"] < best_published


@pytest.mark.parametrize("diameter", [8.0, 10.0, 12.0])
def test_most_places_of_a_known_probe_are_exact_where_readings_are(diameter):
    """Between the candidate places its pattern is followed by its slopes."""
    radius = np.full(len(PADS_MM), RADIUS_MM)
    localizer = make_localizer("template", POSITION_M, NORMAL, radius, probe_mm=diameter)
    off_mm = []
    for place_mm in np.random.default_rng(2).uniform(-6.0, 6.0, (100, 2)):
        units = 80.0 * covered_share(place_mm[None], PADS_MM, radius, diameter)[0]
        found = localizer.locate(np.flatnonzero(units > 2.6), units, ALL)
        off_mm.append(np.linalg.norm(1e3 * found.position_m[:2] - place_mm))
    assert np.median(off_mm) < 0.01


def test_a_template_that_leaves_the_size_open_suits_probes_of_any_size():
    sizes = (6.0, 8.0, 10.0, 12.0)
    for diameter in sizes:
        open_size = rms(errors_mm("template", diameter, 120, probe_mm=sizes)[0])
        assert open_size < rms(errors_mm("centroid", diameter, 120)[0])


def test_a_template_of_the_wrong_size_is_worse_than_one_that_leaves_it_open():
    wrong = rms(errors_mm("template", 6.0, 120, probe_mm=10.0)[0])
    assert wrong > rms(errors_mm("template", 6.0, 120, probe_mm=(6.0, 8.0, 10.0, 12.0))[0])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("diameter", [3.0, 6.0, 10.0])
def test_the_said_uncertainty_is_of_the_size_of_the_error(method, diameter):
    error, said = errors_mm(method, diameter)
    assert 0.5 < rms(error) / rms(said) < 2.5


@pytest.mark.parametrize("diameter", [6.0, 8.0, 10.0])
def test_few_places_are_farther_off_than_four_standard_errors(diameter):
    """Of several sizes of probe that explain the readings, the best is only one."""
    error, said = errors_mm("template", diameter, 400, probe_mm=(6.0, 8.0, 10.0, 12.0))
    assert np.mean(error > 4.0 * said) < 0.05


def test_a_small_probe_inside_one_pad_is_said_to_be_anywhere_in_it():
    foam = PressedFoam(np.random.default_rng(1), gain_sd=0.0)
    pad = 3
    units = foam.bytes([(*(PADS_MM[pad] + [0.3, -0.2]), 3.0, 57.0)])
    localizer = make_localizer(
        "template", POSITION_M, NORMAL, np.full(len(PADS_MM), RADIUS_MM), probe_mm=3.0
    )
    found = localizer.locate(np.flatnonzero(units > 2.6), units, ALL)
    assert found.sigma_m > 1e-3
    assert np.linalg.norm(1e3 * found.position_m[:2] - PADS_MM[pad]) < 1.5


@pytest.mark.parametrize("method", METHODS)
def test_a_lost_taxel_is_not_taken_for_an_untouched_one(method):
    rng = np.random.default_rng(2)
    localizer = make_localizer(
        method, POSITION_M, NORMAL, np.full(len(PADS_MM), RADIUS_MM), probe_mm=10.0
    )
    foam = PressedFoam(rng, gain_sd=0.0)
    lost_as_zero, lost_as_lost = [], []
    for _ in range(100):
        place = in_the_triangle(rng)
        units = foam.bytes([(*place, 10.0, 57.0)])
        lost = int(rng.choice(np.argsort(units)[-3:]))
        units[lost] = 0.0
        usable = ALL.copy()
        usable[lost] = False
        touched = np.flatnonzero(units > 2.6)
        for mask, errors in ((ALL, lost_as_zero), (usable, lost_as_lost)):
            found = localizer.locate(touched, units, mask)
            errors.append(np.linalg.norm(1e3 * found.position_m[:2] - place))
    if method == "template":
        assert rms(lost_as_lost) < 0.5 * rms(lost_as_zero)
    assert rms(lost_as_lost) < 2.5


@pytest.mark.parametrize("method", METHODS)
def test_a_contact_without_signal_has_no_place(method):
    localizer = make_localizer(method, POSITION_M, NORMAL, np.full(len(PADS_MM), RADIUS_MM))
    nothing = np.zeros(len(PADS_MM))
    assert localizer.locate(np.array([3, 4]), nothing, ALL) is None
    assert localizer.locate(np.array([3]), nothing + 5.0, ~ALL) is None
    assert localizer.locate(np.array([], int), nothing + 5.0, ALL) is None
    assert localizer.locate(np.array([3]), nothing - 5.0, ALL) is None


@pytest.mark.parametrize("method", METHODS)
def test_a_part_of_one_taxel_is_located_at_it(method):
    localizer = make_localizer(
        method, POSITION_M[:1], NORMAL[:1], np.array([RADIUS_MM]), probe_mm=6.0
    )
    found = localizer.locate(np.array([0]), np.array([20.0]), np.ones(1, bool))
    assert np.linalg.norm(found.position_m - POSITION_M[0]) < 1e-3
    assert np.isfinite(found.sigma_m)


def test_a_skin_of_large_pads_is_located_as_well_in_proportion_to_them():
    scale = 20.0
    radius = np.full(len(PADS_MM), scale * RADIUS_MM)
    foam = PressedFoam(np.random.default_rng(4))
    large = make_localizer("template", scale * POSITION_M, NORMAL, radius, probe_mm=10.0 * scale)
    off = []
    for _ in range(60):
        place = in_the_triangle(foam.rng)
        units = foam.bytes([(*place, 10.0, 57.0)])
        found, bytes_used = measured(lambda u=units: large.locate(np.flatnonzero(u > 2.6), u, ALL))
        assert bytes_used < MOST_BYTES
        off.append(np.linalg.norm(1e3 * found.position_m[:2] / scale - place))
    assert rms(off) < 0.3


def test_pads_that_lie_close_take_no_more_memory():
    rng = np.random.default_rng(6)
    n = 1500
    pads_mm = rng.uniform(-10.0, 10.0, (n, 2))
    localizer = make_localizer(
        "template",
        1e-3 * np.column_stack([pads_mm, np.zeros(n)]),
        np.tile([0.0, 0.0, 1.0], (n, 1)),
        np.full(n, RADIUS_MM),
        probe_mm=10.0,
    )
    units = 57.0 * covered_share(np.zeros((1, 2)), pads_mm, np.full(n, RADIUS_MM), 10.0)[0]
    touched = np.flatnonzero(units > 2.6)
    found, bytes_used = measured(lambda: localizer.locate(touched, units, np.ones(n, bool)))
    assert bytes_used < MOST_BYTES
    assert np.linalg.norm(found.position_m) < 3e-3


def test_tables_of_many_pads_take_no_more_memory_than_is_stated():
    n = 1500
    radius = np.full(n, RADIUS_MM)
    localizer = make_localizer(
        "template", np.zeros((n, 3)), np.tile([0.0, 0.0, 1.0], (n, 1)), radius, probe_mm=10.0
    )

    def one_pad_after_the_other():
        for pad in range(14):
            units = np.where(np.arange(n) == pad, 57.0, 20.0)
            localizer.locate(np.arange(n), units, np.ones(n, bool))

    _, bytes_used = measured(one_pad_after_the_other)
    assert bytes_used < MOST_BYTES + MOST_TABLE_BYTES


@pytest.mark.parametrize("method", METHODS)
def test_the_whole_patch_may_lie_anywhere_and_any_way_up(method):
    axis = np.array([1.0, 2.0, -0.5]) / np.linalg.norm([1.0, 2.0, -0.5])
    cross = np.cross(np.eye(3), axis)
    rotation = np.eye(3) + np.sin(2.0) * cross + (1 - np.cos(2.0)) * cross @ cross
    shift = np.array([0.3, -0.1, 0.7])
    radius = np.full(len(PADS_MM), RADIUS_MM)
    flat = make_localizer(method, POSITION_M, NORMAL, radius, probe_mm=10.0)
    turned = make_localizer(
        method, POSITION_M @ rotation.T + shift, NORMAL @ rotation.T, radius, probe_mm=10.0
    )
    rng = np.random.default_rng(3)
    foam = PressedFoam(rng)
    for _ in range(20):
        units = foam.bytes([(*in_the_triangle(rng), 10.0, 57.0)])
        touched = np.flatnonzero(units > 2.6)
        here, there = (where.locate(touched, units, ALL) for where in (flat, turned))
        np.testing.assert_allclose(
            there.position_m, rotation @ here.position_m + shift, atol=0.1e-3
        )


def test_a_curved_patch_is_unrolled_with_its_distances():
    angle = np.linspace(-1.2, 1.2, 9)
    normal = np.column_stack([np.sin(angle), np.zeros(9), np.cos(angle)])
    index, flat, basis = tangent_plane(0.02 * normal, normal, 4, 0.1)
    assert index.tolist() == list(range(9))
    chord = 0.02 * 2 * np.sin(np.abs(angle) / 2)
    np.testing.assert_allclose(np.linalg.norm(flat, axis=1), chord, atol=1e-12)
    np.testing.assert_allclose(basis @ normal[4], 0.0, atol=1e-12)


def test_two_probes_apart_are_two_contacts_and_one_probe_is_one():
    rng = np.random.default_rng(4)
    foam = PressedFoam(rng)
    split_two = split_one = count = 0
    for _ in range(200):
        place, direction = in_the_triangle(rng), rng.uniform(0, 2 * np.pi)
        other = place + 16.0 * np.array([np.cos(direction), np.sin(direction)])
        units = foam.bytes([(*place, 8.0, 57.0), (*other, 8.0, 40.0)])
        alone = foam.bytes([(*place, 10.0, 57.0)])
        for reading, wanted in ((units, 2), (alone, 1)):
            for group in connected(np.flatnonzero(reading > 2.6)):
                parts = separate(group, reading, NEIGHBOURS)
                assert sorted(chain.from_iterable(parts)) == sorted(group)
                if wanted == 1:
                    split_one += len(parts) > 1
        total = sum(
            len(separate(group, units, NEIGHBOURS))
            for group in connected(np.flatnonzero(units > 2.6))
        )
        split_two += total == 2
        count += 1
    assert split_one / count < 0.05
    assert split_two / count > 0.9


def connected(touched):
    left, groups = set(touched.tolist()), []
    while left:
        group = [left.pop()]
        for taxel in group:
            for other in NEIGHBOURS[taxel]:
                if other in left:
                    left.remove(other)
                    group.append(other)
        groups.append(sorted(group))
    return groups


def test_a_pass_below_the_saddle_splits_and_one_above_does_not():
    line = [[1], [0, 2], [1, 3], [2, 4], [3]]
    deep = np.array([10.0, 8.0, 3.0, 6.0, 7.0])
    assert separate([0, 1, 2, 3, 4], deep, line) == [[0, 1, 2], [3, 4]]
    shallow = np.array([10.0, 8.0, 5.0, 6.0, 7.0])
    assert separate([0, 1, 2, 3, 4], shallow, line) == [[0, 1, 2, 3, 4]]
    assert separate([2], deep, line) == [[2]]


@given(st.lists(st.floats(0.0, 100.0), min_size=8, max_size=8))
def test_separation_loses_no_taxel_and_keeps_the_strongest_first(heights):
    ring = [[(i - 1) % 8, (i + 1) % 8] for i in range(8)]
    units = np.array(heights)
    groups = separate(list(range(8)), units, ring)
    assert sorted(chain.from_iterable(groups)) == list(range(8))
    tops = [units[group].max() for group in groups]
    assert tops == sorted(tops, reverse=True)


def test_covered_shares_agree_with_counted_points():
    rng = np.random.default_rng(5)
    axis = np.linspace(-1, 1, 401)
    grid = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    grid = grid[np.hypot(*grid.T) <= 1.0]
    for _ in range(20):
        place, radius = rng.uniform(-5, 5, 2), rng.uniform(1.0, 3.0)
        probe = rng.uniform(1.0, 12.0)
        share = covered_share(place[None], np.zeros((1, 2)), np.array([radius]), probe)
        counted = (np.hypot(*(radius * grid - place).T) <= probe / 2).mean()
        assert share[0, 0] == pytest.approx(counted, abs=0.004)


@pytest.mark.parametrize("method", METHODS)
@given(seed=st.integers(0, 10_000))
def test_no_contact_is_located_with_certainty_whatever_its_pads_read(method, seed):
    """Of one candidate place that fits far better than all others, the template knows the cell."""
    rng = np.random.default_rng(seed)
    centre = rng.integers(len(PADS_MM))
    touched = np.unique([centre, *rng.permutation(NEIGHBOURS[centre])[: rng.integers(0, 5)]])
    units = np.zeros(len(PADS_MM))
    units[touched] = rng.uniform(2.0, 240.0, len(touched))
    usable = rng.random(len(PADS_MM)) > rng.uniform(0.0, 0.5)
    usable[centre] = True
    found = LOCALIZERS[method].locate(touched, units, usable)
    assert found.sigma_m > 1e-6


@pytest.mark.parametrize("method", METHODS)
def test_pads_at_one_place_are_located_as_pads_of_their_pitch_are(method):
    n = 12
    localizer = make_localizer(
        method, np.zeros((n, 3)), NORMAL[:n], np.full(n, RADIUS_MM), pitch_m=np.full(n, 5e-3)
    )
    found = localizer.locate(np.arange(3), np.full(n, 50.0), np.ones(n, bool))
    assert found.sigma_m > 1e-4
