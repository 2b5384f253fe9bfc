"""Probes that slide: what is found for all at once is what each pad's own geometry says."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.probes.coverage import Coverage
from emulator.probes.pads import Disc, Pads, Rectangle
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
    share = np.linspace(0.5, 1.0, len(drawn))[:, None]
    path_mm = start_mm + np.arange(steps)[:, None, None] * share * step_mm
    found = at_once.footprints(numbers, path_mm)
    assert 1 <= len(found) <= steps
    for footprint, offset_mm in zip(found, path_mm, strict=False):
        alone = one_by_one.footprint(numbers, offset_mm)
        assert footprint.taxel.tolist() == alone.taxel.tolist()
        assert footprint.contact.tolist() == alone.contact.tolist()
        np.testing.assert_allclose(footprint.covered, alone.covered, rtol=1e-9)
        np.testing.assert_allclose(footprint.weight, alone.weight, rtol=1e-9)
        sums = np.bincount(footprint.contact, footprint.weight, len(drawn))
        under = np.bincount(footprint.contact, minlength=len(drawn)) > 0
        np.testing.assert_allclose(sums[under], 1.0)
