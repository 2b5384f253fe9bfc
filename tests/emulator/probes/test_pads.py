import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.probes.foam import Drive, Foam, FoamLayer
from emulator.probes.pads import (
    Disc,
    Pads,
    Rectangle,
    draw_noise_ff,
    draw_resting_ff,
    lens_area_mm2,
)
from emulator.probes.viscoelastic import FoamTruth


def press_ff(shape, pressure_kpa, *, stiffening=1.0, grounded=False, force=None, **pads_args):
    """What a pad at the origin shows at once under a probe of given mean pressure."""
    pads = Pads([[0, 0]], **pads_args)
    foam = Foam.uniform(1)
    foam = Foam(foam.e0_kpa, foam.stiffening * stiffening, foam.thickness_mm)
    layer = FoamLayer(foam, FoamTruth("S", 1))
    footprint = pads.footprint([shape])
    force_n = pressure_kpa * shape.area_mm2 * 1e-3
    felt = layer.step(footprint, Drive.by_force(force_n), 0.0)
    return pads.rise_ff(felt, footprint, grounded)[0]


class TestThePapersFigures:
    @pytest.mark.parametrize(
        ("stiffening", "measured_ff"), [(0.85, 200.5), (1.0, 165.5), (1.18, 139.0)]
    )
    def test_figure_11_maxima_of_taxels_1_to_3(self, stiffening, measured_ff):
        seen = press_ff(Disc(0, 0, 3), 155.0, stiffening=stiffening)
        assert seen == pytest.approx(measured_ff, rel=0.01)

    @pytest.mark.parametrize(
        ("diameter_mm", "low", "high"),
        [(5, 0.97, 1.03), (4, 0.86, 0.95), (3, 0.45, 0.55), (2, 0.2, 0.25)],
    )
    def test_figure_13_smaller_probes_show_less_from_5_mm_down(self, diameter_mm, low, high):
        ratio = press_ff(Disc(0, 0, diameter_mm), 155.0) / press_ff(Disc(0, 0, 6), 155.0)
        assert low <= ratio <= high

    def test_figure_12_bell_without_crosstalk_but_with_overlap(self):
        def bell(x_mm):
            return press_ff(Disc(x_mm, 0, 3), 155.0) / press_ff(Disc(0, 0, 3), 155.0)

        assert bell(0.5) > 0.95
        assert bell(2.5) > 0.2
        pads = Pads([[0, 0]])
        assert len(pads.footprint([Disc(3.7, 0, 3)]).taxel) == 0

    def test_figures_14_and_15_taxels_agree_at_low_pressure_only(self):
        def spread(pressure_kpa, diameter_mm):
            soft = press_ff(Disc(0, 0, diameter_mm), pressure_kpa, stiffening=0.85)
            stiff = press_ff(Disc(0, 0, diameter_mm), pressure_kpa, stiffening=1.18)
            return soft, stiff

        soft, stiff = spread(155.0, 3)
        assert 1.35 <= soft / stiff <= 1.5
        for pressure_kpa in (5, 20, 40):
            soft, stiff = spread(pressure_kpa, 6)
            assert (soft - stiff) / 2.88 < 1.5

    def test_figure_16_5_kpa_are_two_units(self):
        assert press_ff(Disc(0, 0, 6), 5.0) / 2.88 == pytest.approx(2.0, abs=0.15)


class TestMembrane:
    @pytest.mark.parametrize("length_mm", [0.2, 0.35])
    def test_rounds_the_bell_and_reaches_a_little_further(self, length_mm):
        def bell(x_mm):
            here = press_ff(Disc(x_mm, 0, 3), 155.0, membrane_mm=length_mm)
            return here / press_ff(Disc(0, 0, 3), 155.0, membrane_mm=length_mm)

        assert bell(0.55) < 0.99
        assert 0.24 <= bell(2.5) <= 0.32
        assert 0 < bell(3.65) < 0.03

    def test_the_membrane_bears_part_of_the_force(self):
        assert 90 < press_ff(Disc(0, 0, 3), 155.0, membrane_mm=0.3) < 135


class TestCoverage:
    @given(st.floats(0, 10), st.floats(0.5, 4), st.floats(0.5, 4))
    def test_lens_is_bounded_and_symmetric(self, apart, a, b):
        lens = float(lens_area_mm2(np.array([apart]), a, b)[0])
        assert -1e-9 <= lens <= np.pi * min(a, b) ** 2 * (1 + 1e-9)
        assert lens == pytest.approx(float(lens_area_mm2(np.array([apart]), b, a)[0]), abs=1e-9)

    def test_lens_of_equal_circles_agrees_with_the_textbook(self):
        # Unit circles one radius apart: 2 pi / 3 - sqrt(3) / 2.
        area = lens_area_mm2(np.array([1.0]), 1.0, 1.0)
        assert area[0] == pytest.approx(2 * np.pi / 3 - np.sqrt(3) / 2)

    @given(st.floats(-4, 4), st.floats(-4, 4), st.floats(1, 6), st.floats(1, 6), st.floats(0, 180))
    def test_rectangle_agrees_with_counting_points(self, x, y, width, height, turn):
        shape = Rectangle(x, y, width, height, turn)
        area = shape.covered_mm2(np.array([[0.0, 0.0]]), np.array([2.1]))[0]
        side = np.linspace(-2.1, 2.1, 301)
        points = np.stack(np.meshgrid(side, side), -1)
        inside = (np.hypot(points[..., 0], points[..., 1]) <= 2.1) & (shape.outside_mm(points) == 0)
        assert area == pytest.approx(inside.sum() * (side[1] - side[0]) ** 2, abs=0.15)

    def test_a_large_rectangle_covers_pads_whole(self):
        pads = Pads([[0, 0], [5, 0], [40, 0]])
        footprint = pads.footprint([Rectangle(2, 0, 20, 20)])
        assert list(footprint.taxel) == [0, 1]
        assert footprint.covered == pytest.approx([1, 1], abs=1e-3)


class TestCover:
    def test_without_the_cover_only_grounded_objects_are_felt(self):
        assert press_ff(Disc(0, 0, 6), 50.0, cover=False) == 0
        hand = press_ff(Disc(0, 0, 6), 50.0, cover=False, grounded=True)
        assert hand > press_ff(Disc(0, 0, 6), 50.0)

    def test_with_the_cover_grounding_does_not_matter(self):
        hand = press_ff(Disc(0, 0, 6), 50.0, grounded=True)
        assert hand == press_ff(Disc(0, 0, 6), 50.0)


def test_capacitance_follows_pad_area_and_thickness():
    pads = Pads([[0, 0], [9, 0], [18, 0]], radius_mm=[2.1, 1.05, 2.1], thickness_mm=[2, 2, 3])
    np.testing.assert_allclose(pads.c0_ff, [100, 25, 200 / 3])


def test_pads_of_the_best_skin_are_all_quiet():
    noise_units = draw_noise_ff(5000, np.random.default_rng(3)) / 2.88
    assert noise_units.min() >= 0.2
    assert noise_units.max() <= 0.4


def test_resting_pads_lie_thousands_of_codes_apart():
    resting_ff = draw_resting_ff(1000, np.random.default_rng(3))
    assert np.ptp(resting_ff) / 0.36 > 3000
    # Within the range that the offset of 34 AFE steps brings on scale.
    codes = 32768 + (resting_ff - 34 * 320) / 0.36
    assert codes.min() > 10000
    assert codes.max() < 40000
