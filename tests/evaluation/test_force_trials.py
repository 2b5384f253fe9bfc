"""Force of contacts against the load of the emulator's probes."""

from functools import cache

import numpy as np
import pytest

from skin_host.evaluation.force_trials import KINDS, force
from skin_host.evaluation.report import select

#: Enough for a median to be known within a few percent.
PRESSES = 100
PROBES_MM = (4.0, 10.0, 15.0, 30.0)


@cache
def rows_of(kind):
    return force(kind, PRESSES, PROBES_MM)


@pytest.fixture(params=KINDS)
def rows(request):
    return rows_of(request.param)


def test_the_force_of_probes_wider_than_the_pitch_is_unbiased_anywhere_on_a_triangle(rows):
    wide = [row for row in select(rows, where="triangle") if row["probe_mm"] >= 10.0]
    assert len(wide) == 3
    for row in wide:
        assert 0.9 < row["median_ratio"] < 1.1
        assert row["unseen_share"] == 0.0


@pytest.mark.parametrize("where", ["seam", "inside the edge"])
def test_neither_a_seam_nor_the_edge_of_the_skin_changes_the_force_of_wide_probes(rows, where):
    wide = [row for row in select(rows, where=where) if row["probe_mm"] >= 15.0]
    assert len(wide) == 2
    for row in wide:
        assert 0.9 < row["median_ratio"] < 1.1
        assert row["p5_ratio"] > 0.85
        assert row["p95_ratio"] < 1.2


def test_what_narrow_probes_lose_between_the_pads_they_gain_on_them(rows):
    for row in select(rows, where="triangle"):
        assert 0.85 < row["mean_ratio"] < 1.15
    spread = [row["p95_ratio"] - row["p5_ratio"] for row in select(rows, where="triangle")]
    assert spread[0] > 1.0 > 0.25 > spread[-1]


def test_what_presses_beside_the_skin_is_not_felt(rows):
    """Half of the probe has no pads under it."""
    for row in select(rows, where="half over the edge"):
        assert row["mean_ratio"] < 0.7
        if row["probe_mm"] >= 15.0:
            assert 0.4 < row["p5_ratio"] < row["p95_ratio"] < 0.6


def test_a_wide_probe_over_a_seam_is_located_as_well_as_on_a_triangle(rows):
    for probe_mm in (15.0, 30.0):
        for where in ("triangle", "seam"):
            (row,) = select(rows, where=where, probe_mm=probe_mm)
            assert row["centroid_rms_mm"] < 1.2


def test_the_truth_is_the_load_on_the_probe(rows):
    for row in rows:
        assert row["true_n"] == pytest.approx(40e-3 * np.pi / 4 * row["probe_mm"] ** 2, rel=0.02)


def test_presses_that_come_to_no_contact_count_as_no_force():
    (row,) = force("triangle", 4, probes_mm=(0.5,), places=("half over the edge",))
    assert (row["unseen_share"], row["median_ratio"], row["centroid_rms_mm"]) == (1.0, 0.0, None)
