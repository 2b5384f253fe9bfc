"""Probes that slide: what is found for all at once is what each pad's own geometry says."""

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from emulator.probes.coverage import WORST_SHARE, Coverage, LensCurves
from emulator.probes.foam import Footprint
from emulator.probes.pads import Disc, Pads, Rectangle, lens_area_mm2
from emulator.probes.scene import Place, Probe
from skin_host.evaluation.rig import flat_skin

_, LAYOUT = flat_skin(1)
THICKNESS_MM = np.full(LAYOUT.n_taxels, 2.0)
MM = st.floats(-40, 40)


@st.composite
def probes(draw: st.DrawFn) -> tuple[Probe, Disc | Rectangle]:
    """A probe and its outline where it starts."""
    taxel = draw(st.integers(0, LAYOUT.n_taxels - 1))
    x_mm, y_mm = LAYOUT.position_m[taxel, :2] * 1e3
    if draw(st.booleans()):
        diameter_mm = draw(st.floats(1, 30))
        probe = Probe(part="skin", at=Place(taxel=taxel), diameter_mm=diameter_mm)
        return probe, Disc(x_mm, y_mm, diameter_mm)
    size_mm = draw(st.floats(1, 50)), draw(st.floats(1, 50))
    turn_deg = draw(st.floats(0, 180))
    probe = Probe(part="skin", at=Place(taxel=taxel), size_mm=size_mm, turn_deg=turn_deg)
    return probe, Rectangle(x_mm, y_mm, *size_mm, turn_deg)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(probes(), min_size=1, max_size=5),
    st.lists(st.tuples(MM, MM), min_size=1, max_size=6),
)
def test_sliding_probes_cover_what_their_outlines_cover(
    drawn: list[tuple[Probe, Disc | Rectangle]], path_mm: list[tuple[float, float]]
) -> None:
    coverage = Coverage(LAYOUT, THICKNESS_MM, 0.0)
    for probe, _ in drawn:
        coverage.add(probe)
    pads = Pads(LAYOUT.position_m[:, :2] * 1e3, LAYOUT.radius_mm, THICKNESS_MM)
    numbers = np.arange(len(drawn))
    for x_mm, y_mm in path_mm:
        offset_mm = np.tile([x_mm, y_mm], (len(drawn), 1))
        found = coverage.footprint(numbers, offset_mm)
        for number, (_, shape) in enumerate(drawn):
            own = found.contact == number
            covered = np.zeros(len(pads))
            covered[found.taxel[own]] = found.covered[own]
            moved = (
                Disc(shape.x_mm + x_mm, shape.y_mm + y_mm, shape.diameter_mm)
                if isinstance(shape, Disc)
                else Rectangle(
                    shape.x_mm + x_mm,
                    shape.y_mm + y_mm,
                    shape.width_mm,
                    shape.height_mm,
                    shape.turn_deg,
                )
            )
            wanted = moved.covered_mm2(pads.centre_mm, pads.radius_mm) / pads.area_mm2
            np.testing.assert_allclose(covered, wanted, atol=2e-6)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(probes(), min_size=1, max_size=5),
    st.tuples(MM, MM),
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    st.integers(1, 40),
)
def test_a_path_covers_at_each_step_what_its_places_cover(
    drawn: list[tuple[Probe, Disc | Rectangle]],
    start_mm: tuple[float, float],
    step_mm: tuple[float, float],
    steps: int,
) -> None:
    at_once, one_by_one = (Coverage(LAYOUT, THICKNESS_MM, 0.0) for _ in range(2))
    for probe, _ in drawn:
        at_once.add(probe)
        one_by_one.add(probe)
    numbers = np.arange(len(drawn))
    begin_mm = np.tile(start_mm, (len(drawn), 1))
    # The first of several probes stays where it is.
    own_step_mm = np.linspace(0.0, 1.0, len(drawn) + 1)[-len(drawn) :, None] * step_mm
    own_step_mm[0] *= len(drawn) == 1
    found = at_once.footprints(numbers, begin_mm, own_step_mm, steps)
    assert len(found) == steps
    for number, footprint in enumerate(found):
        alone = one_by_one.footprint(numbers, begin_mm + number * own_step_mm)
        covered = dense(footprint, len(drawn))
        np.testing.assert_allclose(covered, dense(alone, len(drawn)), atol=2 * WORST_SHARE)
        bears = covered * LAYOUT.radius_mm**2
        borne = bears.sum(axis=1)[footprint.contact]
        weight = bears[footprint.contact, footprint.taxel] / borne
        np.testing.assert_allclose(footprint.weight, weight, rtol=1e-9)


def dense(footprint: Footprint, contacts: int) -> NDArray[np.float64]:
    """How much of each pad each contact covers, [contacts, pads]."""
    covered = np.zeros((contacts, LAYOUT.n_taxels))
    covered[footprint.contact, footprint.taxel] = footprint.covered
    return covered


@given(
    st.lists(st.tuples(st.floats(0.5, 5), st.floats(0.2, 40)), min_size=1, max_size=4),
    st.floats(0, 1),
)
@example([(2.1, 2.1)], 1e-3)
@example([(2.1, 2.1005)], 1e-3)
def test_a_curve_meets_the_exact_share_at_every_distance(
    radii_mm: list[tuple[float, float]], from_share: float
) -> None:
    pad_mm, disc_mm = np.array(radii_mm).T
    curves = LensCurves()
    one_by_one = np.arange(len(radii_mm))
    course = curves.courses(disc_mm, pad_mm)[:, one_by_one, one_by_one]
    steps = 300
    # Straight away from the middle, until the disc has left the pad.
    begin_mm = from_share * (pad_mm + disc_mm)
    step_mm = (pad_mm + disc_mm - begin_mm) / steps
    course[:3] = begin_mm**2, 2 * begin_mm * step_mm, step_mm**2
    course[:3] *= course[4] ** 2
    distance_mm = begin_mm + np.arange(steps)[:, None] * step_mm
    exact = lens_area_mm2(distance_mm, pad_mm, disc_mm) / (np.pi * pad_mm**2)
    np.testing.assert_allclose(curves.shares(course, 0, steps), exact, atol=WORST_SHARE)
