"""A contact's event as it is published: numbered, rounded, and within the bounds of its schema."""

import math
from typing import Any

import msgspec
import pytest

from skin_host.processing.events import MAX_TAXELS, Touch, rounded
from tests.support.said import make_event

LONG = 1.23456789


def read(**changes: Any) -> Touch:
    """The event as a subscriber reads it, with changed keys."""
    sent = msgspec.to_builtins(make_event()) | changes
    return msgspec.json.decode(msgspec.json.encode(sent), type=Touch)


def test_a_published_event_is_numbered_and_rounded() -> None:
    assert make_event().count == make_event().missed == 0
    event = make_event(
        centroid_m=(LONG, -LONG, -1e-9),
        normal=(LONG, -1e-9, 0.0),
        area_mm2=LONG,
        peak_kpa=LONG,
        mean_kpa=LONG,
        force_n=LONG,
        sigma_m=LONG,
    ).published(17)
    assert event.count == 17
    assert event.centroid_m == (1.234568, -1.234568, 0.0)
    assert event.normal == (1.2346, 0.0, 0.0)
    assert (event.area_mm2, event.peak_kpa, event.mean_kpa) == (1.23, 1.235, 1.235)
    assert (event.force_n, event.sigma_m) == (1.2346, 1.234568)


@pytest.mark.parametrize("sigma_m", [0.0, 1e-300, 4e-7])
def test_no_place_is_published_as_certain(sigma_m: float) -> None:
    assert make_event(sigma_m=sigma_m).published(1).sigma_m == 1e-6


def test_only_a_partial_contact_is_marked() -> None:
    assert "partial" not in msgspec.to_builtins(make_event())
    partial = make_event(partial=True)
    assert msgspec.to_builtins(partial.published(1))["partial"] is True
    assert partial.ended(9, 9).partial and read(partial=True).partial
    assert not read().partial


def test_what_is_not_known_stays_unknown_when_it_is_published() -> None:
    unknown = dict.fromkeys(
        ("centroid_m", "normal", "area_mm2", "peak_kpa", "mean_kpa", "sigma_m"), None
    )
    event = make_event(**unknown).published(1)
    assert {key: getattr(event, key) for key in unknown} == unknown


def test_a_rounded_vector_has_no_negative_zero() -> None:
    assert [math.copysign(1.0, value) for value in rounded((-1e-9, -0.0, 0.0), 6)] == [1.0] * 3
    assert rounded((LONG, -LONG, 100.0), 2) == (1.23, -1.23, 100.0)


def test_an_end_is_where_the_contact_was_last_and_without_force() -> None:
    event = make_event(sigma_m=0.001)
    ended = event.ended(99, 12345, "lost")
    assert (ended.event, ended.seq, ended.t_ns, ended.reason) == ("end", 99, 12345, "lost")
    assert (ended.peak_kpa, ended.mean_kpa, ended.force_n) == (0.0, 0.0, 0.0)
    for kept in ("id", "part", "taxels", "centroid_m", "normal", "area_mm2", "sigma_m"):
        assert getattr(ended, kept) == getattr(event, kept)
    assert event.ended(9, 9).reason == "released"


def test_of_a_finger_without_skin_the_pressure_is_not_known_at_the_end_either() -> None:
    event = make_event(area_mm2=None, peak_kpa=None, mean_kpa=None).ended(9, 9)
    assert (event.peak_kpa, event.mean_kpa, event.force_n) == (None, None, 0.0)


@pytest.mark.parametrize(
    ("key", "most", "least"),
    [
        ("id", 2**63 - 1, 0),
        ("seq", 2**63 - 1, 0),
        ("count", 2**63 - 1, 0),
        ("t_ns", 2**63 - 1, 0),
        ("sigma_m", 1e9, 0.0),
    ],
)
def test_numbers_beyond_their_bounds_are_refused(key: str, most: float, least: float) -> None:
    for value in (most, least):
        assert getattr(read(**{key: value}), key) == value
    beyond = [least - 1] if key == "sigma_m" else [most + 1, least - 1]
    for value in beyond:
        with pytest.raises(msgspec.ValidationError, match=key):
            read(**{key: value})


def test_names_and_taxels_beyond_their_bounds_are_refused() -> None:
    assert read(part="p" * 64, taxels=[0, MAX_TAXELS]).taxels == [0, 100_000]
    for changes in ({"part": "p" * 65}, {"taxels": [MAX_TAXELS + 1]}, {"taxels": [-1]}):
        with pytest.raises(msgspec.ValidationError):
            read(**changes)
    assert len(read(taxels=[1] * MAX_TAXELS).taxels) == MAX_TAXELS
    with pytest.raises(msgspec.ValidationError):
        read(taxels=[1] * (MAX_TAXELS + 1))
