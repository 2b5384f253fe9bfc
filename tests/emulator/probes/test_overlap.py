"""Probes whose outlines overlap: each point of a pad is pressed by the deepest of them alone."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from emulator.probes.contacts import ContactPads, Contacts, joined
from emulator.probes.coverage import Coverage
from emulator.probes.foam import Drive, Foam, FoamLayer
from emulator.probes.pads import Disc, Pads, Rectangle, Shape
from emulator.probes.scene import Place, Probe, Scene
from emulator.probes.skin import Skin
from emulator.probes.viscoelastic import FoamTruth
from skin_host.evaluation.rig import flat_skin
from tests.emulator.test_robot import load

_, LAYOUT = flat_skin(1)
#: What the points of a pad resolve, as a share of it.
RESOLVED = 0.01


def pressed(shapes: list[Shape], force_n: list[float], membrane_mm: float = 0.0, steps: int = 1):
    """One pad under some probes: the rise of its capacitance (fF), and the layer above it."""
    pads = Pads([[0, 0]], membrane_mm=membrane_mm)
    layer = FoamLayer(Foam.uniform(1), FoamTruth("S", 1))
    footprint = pads.footprint(shapes)
    for _ in range(steps):
        felt = layer.step(footprint, Drive.by_force(force_n), 0.01)
    return pads.rise_ff(felt, footprint)[0], layer


def skin_under(*probes: Probe, membrane_mm: float = 0.0, name: str = "demo") -> Skin:
    """The skin of a robot half a second after some probes were put on it."""
    scene = Scene(spread=False, noise=False, membrane_mm=membrane_mm, probe=list(probes))
    skin = Skin(load(name)[1], scene)
    for step in range(100):
        skin.step(5_000_000 * (step + 1))
    return skin


def probe(taxel: int = 27, x_mm: float = 0.0, force_n: float = 1.0, **shape) -> Probe:
    return Probe(
        part="left_forearm",
        at=Place(taxel=taxel, x_mm=x_mm),
        force_n=[(0.0, force_n), (1e6, force_n)],
        **({"diameter_mm": 4.0} | shape),
    )


@pytest.mark.parametrize("shape", [{"diameter_mm": 3.0}, {"size_mm": (3.0, 2.0), "turn_deg": 20.0}])
@pytest.mark.parametrize("membrane_mm", [0.0, 0.3])
@pytest.mark.parametrize("x_mm", [0.0, 1.7])
def test_identical_probes_at_one_place_read_like_one(shape, membrane_mm, x_mm) -> None:
    one = probe(x_mm=x_mm, **shape)
    alone, twice, thrice = (
        skin_under(*[one] * count, membrane_mm=membrane_mm) for count in (1, 2, 3)
    )
    assert (alone.true_pressure_kpa() > 0).any()
    for skin in (twice, thrice):
        np.testing.assert_allclose(skin.true_pressure_kpa(), alone.true_pressure_kpa())
        np.testing.assert_allclose(skin.capacitance_ff, alone.capacitance_ff)


def test_probes_that_each_cover_half_a_pad_and_no_point_twice_add() -> None:
    left, right = Rectangle(-5, 0, 10, 20), Rectangle(5, 0, 10, 20)
    rise_ff, layer = pressed([left, right], [4.0, 4.0])
    half_ff, half = pressed([left], [4.0])
    assert rise_ff == pytest.approx(2 * half_ff)
    assert layer.mean_kpa() == pytest.approx(2 * half.mean_kpa())


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(1, 8), st.floats(0.05, 3)),
        min_size=1,
        max_size=5,
    ),
    st.sampled_from([0.0, 0.3]),
)
def test_a_pad_is_never_covered_by_more_than_all_of_it_nor_pressed_harder_than_its_foam(
    discs: list[tuple[float, float, float, float]], membrane_mm: float
) -> None:
    shapes = [Disc(x_mm, y_mm, diameter_mm) for x_mm, y_mm, diameter_mm, _ in discs]
    pads = Pads([[0, 0]], membrane_mm=membrane_mm)
    layer = FoamLayer(Foam.uniform(1), FoamTruth("S", 1))
    footprint = pads.footprint(shapes)
    felt = layer.step(footprint, Drive.by_force([force_n for *_, force_n in discs]), 0.01)
    # What is drawn down beside a probe alone may count a little more: it is found by points.
    slack = RESOLVED if membrane_mm else 1e-9
    assert np.bincount(felt.taxel, felt.covered, 1) <= 1.0 + slack
    assert layer.mean_kpa()[0] <= (1.0 + slack) * layer.pressure_kpa[0]


@settings(deadline=None)
@given(st.floats(0, 4), st.floats(0.1, 3), st.floats(0.1, 3))
def test_where_two_probes_overlap_the_deeper_one_presses(
    apart_mm: float, force_n: float, other_n: float
) -> None:
    # Which of two is deeper is known where their depths are farther apart than they are solved for.
    assume(force_n == other_n or abs(force_n - other_n) > 1e-6)
    # The pad is wide under both: its area that either covers is that of their union.
    deep, shallow = (0, 1) if force_n >= other_n else (1, 0)
    discs = [Disc(0, 0, 2.4), Disc(apart_mm / 2, 0, 2.4)]
    pads = Pads([[0, 0]], 6.0)
    layer = FoamLayer(Foam.uniform(1), FoamTruth("S", 1))
    footprint = pads.footprint(discs)
    felt = layer.step(footprint, Drive.by_force([force_n, other_n]), 0.01)
    whole = discs[0].area_mm2 / pads.area_mm2[0]
    common = discs[0].covered_mm2(np.array([[apart_mm / 2, 0.0]]), np.array([1.2]))[0]
    assert felt.covered[deep] == pytest.approx(whole)
    assert felt.covered[shallow] == pytest.approx(whole - common / pads.area_mm2[0], abs=RESOLVED)


def test_a_light_probe_beside_a_heavy_one_on_a_pad_counts_with_its_own_pressure() -> None:
    left, right = Rectangle(-5, 0, 10, 20), Rectangle(5, 0, 10, 20)
    _, layer = pressed([left, right], [8.0, 2.0], steps=100)
    assert layer.force_n == pytest.approx([8.0, 2.0], rel=0.01)
    assert layer.mean_kpa()[0] == pytest.approx((40.0 + 10.0) / 2, rel=0.01)
    assert layer.pressure_kpa[0] == pytest.approx(40.0, rel=0.01)


def test_what_overlapping_probes_leave_in_the_foam_counts_once() -> None:
    def left_ff(count: int) -> float:
        pads = Pads([[0, 0]])
        layer = FoamLayer(Foam.uniform(1), FoamTruth("S", 1))
        footprint = pads.footprint([Disc(1, 0, 3)] * count)
        for _ in range(100):
            layer.step(footprint, Drive.by_force([1.0] * count), 0.05)
        nobody = pads.footprint([])
        felt = layer.step(nobody, Drive.by_force([]), 0.05)
        return float(pads.rise_ff(felt, nobody)[0])

    assert left_ff(1) > 0
    assert left_ff(2) == pytest.approx(left_ff(1))


def test_a_probe_that_slides_over_another_uncovers_what_it_leaves() -> None:
    """Two discs on a pad: apart, then one on the other, then apart again."""
    slides = [(0.0, -2.0, 0.0), (1.0, 2.0, 0.0)]
    skin = Skin(
        load()[1],
        Scene(
            spread=False,
            noise=False,
            probe=[
                probe(diameter_mm=1.0, force_n=0.05),
                probe(diameter_mm=1.0, force_n=0.05, slide_mm=slides),
            ],
        ),
    )
    covered = []
    mine = skin._layout.part("left_forearm").start + 27
    for step in range(200):
        skin.step(5_000_000 * (step + 1))
        covered.append(skin.true_pressure_kpa()[mine] / skin._foam.pressure_kpa[mine])
    whole = 0.25 / skin._layout.radius_mm[mine] ** 2
    assert covered[99] == pytest.approx(whole, abs=RESOLVED)
    assert covered[60] == pytest.approx(2 * whole, abs=RESOLVED)
    assert covered[139] == pytest.approx(2 * whole, abs=RESOLVED)


def test_contacts_of_a_program_and_probes_overlap_alike() -> None:
    """A disc of a scene, and the same disc as a source gives it."""
    taxel = 20
    coverage = Coverage(LAYOUT, np.full(LAYOUT.n_taxels, 2.0), 0.0)
    coverage.add(Probe(part="skin", at=Place(taxel=taxel), diameter_mm=5.0))
    given_now = Contacts(
        np.zeros(1, np.intp),
        1e3 * LAYOUT.position_m[[taxel]],
        LAYOUT.normal[[taxel]],
        np.array([1.0]),
        np.array([2.5]),
    )
    _, contacts = ContactPads(LAYOUT).place(given_now)
    both = joined(coverage.footprint(np.array([0]), np.zeros((1, 2))), contacts)
    layer = FoamLayer(Foam.uniform(LAYOUT.n_taxels), FoamTruth("S", LAYOUT.n_taxels))
    felt = layer.step(both, Drive.by_force([1.0, 1.0]), 0.01)
    once = np.bincount(contacts.taxel, contacts.covered, LAYOUT.n_taxels)
    np.testing.assert_allclose(
        np.bincount(felt.taxel, felt.covered, LAYOUT.n_taxels), once, atol=1e-6
    )


def test_probes_that_face_a_pad_from_two_sides_overlap_on_it() -> None:
    """On a curved part each probe has axes of its own."""
    layout = load()[1]
    part = layout.part("left_forearm")
    near = part.start + 27
    apart_m = np.linalg.norm(layout.position_m - layout.position_m[near], axis=1)
    turned = (layout.normal @ layout.normal[near] < 0.999) & (apart_m < 0.02)
    other = int(np.flatnonzero(turned[part.start : part.stop])[0])
    wide = [probe(taxel, diameter_mm=60.0, force_n=20.0) for taxel in (27, other)]
    one, two, both = skin_under(wide[0]), skin_under(wide[1]), skin_under(*wide)
    alone = np.minimum(one._foam.mean_kpa(), two._foam.mean_kpa()) > 0
    assert alone.any()
    hardest = np.maximum(one._foam.pressure_kpa, two._foam.pressure_kpa)
    assert (both.true_pressure_kpa()[alone] <= 1.001 * hardest[alone]).all()
