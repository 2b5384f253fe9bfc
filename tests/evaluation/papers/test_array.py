import numpy as np
import pytest

from skin_host.evaluation.papers.fusion import centroid, peak, smooth_peak, strip_array
from skin_host.evaluation.papers.truth import LoadPatch, StripArray, box_patch

LAYOUT = strip_array()
AROUND = LAYOUT.around_mm
POINT = LoadPatch(np.zeros((1, 2)), np.ones(1))
METHODS = {
    "centroid": lambda r: centroid(r, AROUND),
    "half": lambda r: centroid(r, AROUND, share=0.5),
    "peak": lambda r: peak(r, AROUND),
    "smooth": lambda r: smooth_peak(r, AROUND),
}


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def errors(lean_deg, patch=POINT, count=300, reach_mm=4.0, seed=1, **traits):
    rng = np.random.default_rng(seed)
    array = StripArray(AROUND, LAYOUT.along_mm, rng, **traits)
    place = rng.uniform(-reach_mm, reach_mm, count)
    lean = np.deg2rad(lean_deg)
    response = array.read(place, 3 * np.cos(lean), 3 * np.sin(lean), patch)
    return {name: method(response) - place for name, method in METHODS.items()}


def test_the_array_has_64_elements_2_mm_apart():
    assert len(LAYOUT.around_mm) * len(LAYOUT.along_mm) == 64
    np.testing.assert_allclose(np.diff(LAYOUT.around_mm), 2.0)
    assert LAYOUT.around_mm.sum() == pytest.approx(0.0)


def test_a_profile_symmetric_about_a_place_is_found_there_by_all():
    offset = (AROUND - 1.0)[None, None, :]
    response = np.exp(-0.5 * (offset / 2.0) ** 2) * np.ones((1, 8, 1))
    for name, method in METHODS.items():
        # The profile is cut off at the array's right edge: the simple centroid feels it.
        assert method(response)[0] == pytest.approx(1.0, abs=0.12 if name == "centroid" else 0.01)


def test_every_method_is_within_a_millimetre_under_a_normal_push():
    for found in errors(0.0).values():
        assert rms(found) < 0.3


def test_shear_pulls_the_simple_centroid_most():
    found = {name: abs(np.mean(error)) for name, error in errors(30.0).items()}
    assert found["centroid"] > 3.0 * max(found["half"], found["peak"])
    assert max(found["half"], found["peak"], found["smooth"]) < 0.6


def test_a_flat_contact_in_noise_suits_centroids_better_than_the_peak():
    flat = errors(0.0, patch=box_patch(), noise=0.012)
    found = {name: rms(error) for name, error in flat.items()}
    assert found["half"] < 0.9 * found["peak"]
    assert found["smooth"] < 0.5 * found["peak"]


def test_the_smooth_peak_is_the_sharpest_under_a_normal_push():
    found = {name: rms(error) for name, error in errors(0.0).items()}
    assert found["smooth"] < 0.4 * min(found["centroid"], found["half"], found["peak"])


def test_an_untouched_array_shows_no_place():
    for method in METHODS.values():
        assert np.isnan(method(np.zeros((2, 8, 8)))).all()


def test_a_peak_in_the_last_strip_stays_in_the_array():
    response = np.zeros((1, 8, 8))
    response[0, 3, 7] = 1.0
    response[0, 3, 6] = 0.6
    for method in METHODS.values():
        assert AROUND[6] <= method(response)[0] <= AROUND[7] + 1e-9
