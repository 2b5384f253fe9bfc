from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.probes.foam import (
    MOST_STRAIN,
    POLE_STRAIN,
    Drive,
    Foam,
    FoamLayer,
    Footprint,
    deepest_mm,
)
from emulator.probes.pads import Disc, Pads
from emulator.probes.viscoelastic import TAU_S, FoamTruth


def layer_of(centres, kind="S", **foam):
    n = len(centres)
    return Pads(centres), FoamLayer(Foam.uniform(n, **foam), FoamTruth(kind, n))


def hold(layer, footprint, drive, seconds, dt_s=0.05):
    for _ in range(round(seconds / dt_s)):
        felt = layer.step(footprint, drive, dt_s)
    return felt


class TestElasticLaw:
    def test_agrees_with_the_papers_quadratic_below_130_kpa(self):
        foam = Foam.uniform(200)
        pressure = np.linspace(0, 130, 200)
        strain = foam.strain(pressure)
        rise_ff = 100 * strain / (1 - strain)
        quadratic = -0.001132 * rise_ff**2 + 0.8141 * rise_ff
        assert np.abs(quadratic - pressure).max() < 1.4

    @given(st.floats(0, 5000), st.floats(0.5, 2.0), st.floats(0.8, 1.2))
    def test_strain_and_pressure_are_inverse_to_each_other(self, pressure, k, e0):
        foam = Foam(np.array([91.7 * e0]), np.array([2.07 * k]), np.array([2.0]))
        strain = foam.strain(np.array([pressure]))
        assert 0 <= strain[0] < POLE_STRAIN
        assert foam.elastic_kpa(strain)[0] == pytest.approx(pressure, rel=1e-8, abs=1e-9)

    def test_the_foam_cannot_be_squeezed_flat(self):
        foam = Foam.uniform(1)
        assert foam.strain(np.array([1e6]))[0] < POLE_STRAIN

    def test_slope_is_the_derivative(self):
        foam = Foam.uniform(90)
        strain = np.linspace(0.01, 0.94, 90)
        _, slope = foam.elastic_kpa_and_slope(strain)
        above, below = foam.elastic_kpa(strain + 1e-6), foam.elastic_kpa(strain - 1e-6)
        np.testing.assert_allclose(slope, (above - below) / 2e-6, rtol=1e-4)


class TestFoamLayer:
    def test_a_force_driven_probe_gets_its_force(self):
        pads, layer = layer_of([[0, 0], [5, 0], [0, 5]])
        footprint = pads.footprint([Disc(1, 1, 8)])
        hold(layer, footprint, Drive.by_force(2.0), 1.0)
        assert layer.force_n == pytest.approx([2.0], rel=0.01)

    def test_a_held_probe_loses_force_and_sinks_in_as_the_load_cell_gives(self):
        pads, layer = layer_of([[0, 0]])
        footprint = pads.footprint([Disc(0, 0, 6)])
        drive = Drive.by_depth(1.0, compliance_mm_per_n=0.06)
        hold(layer, footprint, drive, 0.1)
        force, depth = layer.force_n[0], layer.depth_mm[0]
        hold(layer, footprint, drive, 60.0)
        assert layer.force_n[0] < 0.95 * force
        assert layer.depth_mm[0] > depth
        assert layer.depth_mm[0] + 0.06 * layer.force_n[0] == pytest.approx(1.0, abs=2e-3)

    def test_a_stiff_robot_reaches_the_commanded_depth(self):
        pads, layer = layer_of([[0, 0]])
        layer.step(pads.footprint([Disc(0, 0, 6)]), Drive.by_depth(0.8), 0.01)
        assert layer.depth_mm == pytest.approx([0.8])

    @given(
        st.lists(
            st.tuples(st.booleans(), st.floats(0, 1e308), st.sampled_from([0.0, 1e-6, 0.01, 1000])),
            min_size=3,
            max_size=3,
        ),
        st.floats(0.1, 20.0),
        st.sampled_from(["S", "A", "L", "H", "F", "M"]),
        st.booleans(),
    )
    def test_whatever_drives_a_probe_the_foam_bears_no_more_than_it_can(
        self, drives, thickness_mm, kind, is_infinergy
    ):
        pads = Pads([[0, 0], [5, 0], [0, 5]])
        foam = Foam.drawn(3, np.random.default_rng(1), thickness_mm)
        foam = foam.infinergy() if is_infinergy else foam
        layer = FoamLayer(foam, FoamTruth(kind, 3))
        # Two on pads, of which they share one, and one that lies between the pads.
        footprint = pads.footprint([Disc(0, 0, 4), Disc(4, 0, 6), Disc(50, 0, 0.1)])
        is_depth, value, compliance = (np.array(column) for column in zip(*drives, strict=True))
        most_kpa = foam.elastic_kpa(np.full(3, MOST_STRAIN)).max()
        for dt_s in (0.0, 0.005, 0.005, 0.005, 0.5, 0.5):
            felt = layer.step(footprint, Drive(value, is_depth, compliance), dt_s)
            assert (felt.strain <= MOST_STRAIN).all()
            assert (layer.pressure_kpa <= most_kpa).all()
            assert (layer.force_n <= most_kpa * footprint.area_mm2 * footprint.edge * 1e-3).all()
        nobody = Footprint.empty()
        felt = hold(layer, nobody, Drive.by_force([]), 10.0)
        assert (layer.pressure_kpa == 0).all()
        assert (felt.strain < MOST_STRAIN).all()

    @given(st.floats(0, 20), st.floats(0.5, 6), st.sampled_from([0.0, 0.001, 0.06, 10]))
    def test_a_probe_goes_no_deeper_than_the_deepest_foam_can(
        self, depth_mm, thickness_mm, compliance
    ):
        pads, layer = layer_of([[0, 0]], thickness_mm=thickness_mm)
        footprint = pads.footprint([Disc(0, 0, 3)])
        most_mm = deepest_mm(thickness_mm, footprint.area_mm2[0], compliance)
        layer.step(footprint, Drive.by_depth(min(depth_mm, most_mm), compliance), 0.0)
        reached_mm = layer.depth_mm[0] + compliance * layer.force_n[0]
        assert reached_mm == pytest.approx(min(depth_mm, most_mm), abs=1e-3, rel=1e-3)
        layer.step(footprint, Drive.by_depth(most_mm + 1, compliance), 0.0)
        assert layer.depth_mm[0] + compliance * layer.force_n[0] < most_mm + 0.01

    def test_a_rigid_probe_presses_harder_on_stiffer_foam(self):
        pads = Pads([[-2.5, 0], [2.5, 0]])
        foam = Foam(np.array([91.7, 91.7]), np.array([1.7, 2.5]), np.array([2.0, 2.0]))
        layer = FoamLayer(foam, FoamTruth("L", 2))
        felt = layer.step(pads.footprint([Disc(0, 0, 12)]), Drive.by_depth(1.2), 0.01)
        assert felt.strain[0] == felt.strain[1]
        assert layer.pressure_kpa[1] > 1.1 * layer.pressure_kpa[0]

    def test_release_leaves_an_imprint_without_pressure_that_fades(self):
        pads, layer = layer_of([[0, 0], [5, 0]])
        footprint = pads.footprint([Disc(0, 0, 6)])
        hold(layer, footprint, Drive.by_force(2.0), 60.0)
        nobody = Footprint.empty()
        felt = layer.step(nobody, Drive.by_force([]), 0.05)
        first = felt.strain[felt.taxel == 0][0]
        assert layer.pressure_kpa[0] == 0
        assert first > 0.05
        felt = hold(layer, nobody, Drive.by_force([]), 60.0)
        assert 0 < felt.strain[felt.taxel == 0][0] < 0.8 * first

    def test_an_imprint_ends_and_then_costs_nothing(self):
        pads, layer = layer_of([[0, 0]])
        hold(layer, pads.footprint([Disc(0, 0, 6)]), Drive.by_force(0.2), 0.5)
        nobody = Footprint.empty()
        layer.step(nobody, Drive.by_force([]), 0.05)
        felt = layer.step(nobody, Drive.by_force([]), 40 * TAU_S[-1])
        assert len(felt.taxel) == 0

    def test_a_probe_in_its_own_imprint_feels_nothing(self):
        pads, layer = layer_of([[0, 0]])
        footprint = pads.footprint([Disc(0, 0, 6)])
        hold(layer, footprint, Drive.by_depth(1.2), 120.0)
        felt = layer.step(footprint, Drive.by_depth(0.1), 0.05)
        assert layer.force_n[0] == 0
        assert felt.strain[0] * 2.0 > 0.1

    def test_two_contacts_on_one_pad_add_their_areas(self):
        pads, layer = layer_of([[0, 0]])
        footprint = pads.footprint([Disc(-1.2, 0, 2), Disc(1.2, 0, 2)])
        felt = layer.step(footprint, Drive.by_force([0.2, 0.2]), 0.01)
        one = layer_of([[0, 0]])
        alone = one[0].footprint([Disc(-1.2, 0, 2)])
        felt_alone = one[1].step(alone, Drive.by_force(0.2), 0.01)
        both = pads.rise_ff(felt, footprint)[0]
        assert both == pytest.approx(2 * one[0].rise_ff(felt_alone, alone)[0], rel=1e-6)

    def test_a_probe_between_the_pads_meets_foam_but_no_pad_feels_it(self):
        pads, layer = layer_of([[0, 0]])
        footprint = pads.footprint([Disc(50, 0, 3), Disc(0, 0, 3)])
        felt = layer.step(footprint, Drive.by_force([1.0, 0.5]), 0.0)
        assert list(felt.taxel) == [0]
        assert layer.force_n == pytest.approx([1.0, 0.5])
        layer.step(footprint, Drive.by_depth([0.7, 0.7]), 0.0)
        assert layer.depth_mm == pytest.approx([0.7, 0.7])
        assert layer.force_n[0] == pytest.approx(layer.force_n[1])

    @pytest.mark.parametrize("force_n", [1e-9, 1e-4, 0.0437, 3.1])
    def test_where_there_is_no_pad_at_all_the_foam_bears_the_whole_force(self, force_n):
        pads, layer = layer_of([[0, 0]])
        layer.step(pads.footprint([Disc(50, 0, 20)]), Drive.by_force(force_n), 0.0)
        assert layer.force_n == pytest.approx([force_n], rel=1e-6)

    def test_a_load_cell_gives_alike_on_a_pad_and_between_the_pads(self):
        pads, layer = layer_of([[0, 0]])
        footprint = pads.footprint([Disc(50, 0, 6), Disc(0, 0, 6)])
        layer.step(footprint, Drive.by_depth([1.6, 1.6], compliance_mm_per_n=0.1), 0.0)
        assert layer.force_n[0] == pytest.approx(layer.force_n[1])
        assert layer.depth_mm + 0.1 * layer.force_n == pytest.approx([1.6, 1.6])

    def test_foam_left_behind_comes_back_alike_under_a_still_and_a_sliding_probe(self):
        def left_behind(places_mm):
            pads, layer = layer_of([[0, 0], [20, 0]])
            first = pads.footprint([Disc(0, 0, 5)])
            hold(layer, first, Drive.by_force(2.0), 20.0)
            still = pads.footprint([Disc(20, 0, 5)])
            for x_mm in places_mm:
                footprint = still
                if x_mm:
                    slid = pads.footprint([Disc(20 + x_mm, 0, 5)])
                    footprint = replace(
                        slid, taxel=still.taxel, contact=still.contact, area_mm2=still.area_mm2
                    )
                felt = layer.step(footprint, Drive.by_force(1.0), 0.005)
            return felt.strain[felt.taxel == 0]

        steps = 1000
        sliding = left_behind(np.linspace(0, 1, steps))
        assert sliding == pytest.approx(left_behind(np.zeros(steps)), rel=1e-12)
        assert sliding[0] > 0.03

    def test_untouched_taxels_stay_out_of_the_work(self):
        grid = np.stack(np.meshgrid(np.arange(30) * 5.0, np.arange(30) * 5.0), -1).reshape(-1, 2)
        pads, layer = layer_of(grid)
        felt = layer.step(pads.footprint([Disc(50, 50, 4)]), Drive.by_force(1.0), 0.05)
        assert list(felt.taxel) == [10 * 30 + 10]
        assert np.count_nonzero(layer.truth.elastic_kpa) == 1

    def test_the_same_history_gives_the_same_bytes(self):
        def run():
            rng = np.random.default_rng(7)
            pads = Pads([[0, 0], [5, 0]])
            layer = FoamLayer(Foam.drawn(2, rng), FoamTruth("S", 2, rng))
            footprint = pads.footprint([Disc(2, 0, 5)])
            return hold(layer, footprint, Drive.by_force(1.0), 2.0).strain.tobytes()

        assert run() == run()
