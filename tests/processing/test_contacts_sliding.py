"""Objects that land on emulated skin and slide: each is one contact for as long as it presses."""

from collections.abc import Callable
from typing import get_args

import msgspec
import numpy as np
import pytest

from emulator.probes.foam import Drive, Foam, FoamLayer
from emulator.probes.pads import UNIT_FF, Disc, Pads
from emulator.probes.viscoelastic import FoamTruth
from skin_host.evaluation.rig import Rig
from skin_host.processing.contacts import ContactTracker
from skin_host.processing.events import Touch
from skin_host.processing.localization import Method

HZ, FOAM_MM, KPA = 25.0, 2.0, 40.0
#: Where the middle of an object is (mm) at a share of the time.
Path = Callable[[float], tuple[float, float]]


def pressed(
    seconds: float,
    *objects: tuple[float, Path],
    lands_s: float = 0.0,
    method: Method = "centroid",
) -> list[Touch]:
    """Events of round objects of these diameters (mm) that press for so long.

    They land within `lands_s`, and are located by `method`.
    """
    rig = Rig(2, 0.4, hz=HZ)
    skin = msgspec.structs.replace(rig.settings.parts["skin"], localization=method)
    settings = msgspec.structs.replace(rig.settings, parts={"skin": skin})
    layout, rng = rig.layout, np.random.default_rng(1)
    pads = Pads(1e3 * layout.position_m[:, :2], layout.radius_mm, FOAM_MM)
    foam = FoamLayer(
        Foam.drawn(layout.n_taxels, rng, FOAM_MM), FoamTruth("S", layout.n_taxels, rng)
    )
    tracker = ContactTracker(layout, 0, settings)
    events: list[Touch] = []
    for share in np.linspace(0.0, 1.0, round(seconds * HZ)).tolist():
        kpa = KPA * min(1.0, share * seconds / lands_s) if lands_s else KPA
        discs = [Disc(*path(share), diameter_mm) for diameter_mm, path in objects]
        footprint = pads.footprint(discs)
        force_n = [1e-3 * kpa * disc.area_mm2 for disc in discs]
        felt = foam.step(footprint, Drive.by_force(force_n), rig.dt_s)
        rise_ff = pads.rise_ff(felt, footprint)
        events += tracker.step(rig.step(rise_ff / UNIT_FF))
    return events


@pytest.mark.parametrize("apart_mm", [17.0, 19.0, 20.0])
def test_a_finger_that_slides_past_a_hand_at_rest_keeps_its_name_and_the_hand_its_place(
    apart_mm: float,
) -> None:
    hand_mm = 67.0, 44.0
    past = hand_mm[1] + apart_mm
    events = pressed(
        2.0, (20.0, lambda _: hand_mm), (10.0, lambda share: (20.0 + 80.0 * share, past))
    )
    begun = [event for event in events if event.event != "move"]
    assert [event.event for event in begun] == ["begin", "begin"]
    hand = min(begun, key=lambda event: _away_mm(event, hand_mm)).id
    assert max(_away_mm(event, hand_mm) for event in events if event.id == hand) < 1.5


@pytest.mark.parametrize("height_mm", [23.0, 26.0, 38.0, 59.0])
def test_a_finger_that_slides_keeps_its_name(height_mm: float) -> None:
    """It covers one pad or two; those that it has left are released some sweeps late."""
    events = pressed(1.5, (9.0, lambda share: (10.0 + 90.0 * share, height_mm + 20.0 * share)))
    assert [event.event for event in events if event.event != "move"] == ["begin"]


@pytest.mark.parametrize("method", get_args(Method))
@pytest.mark.parametrize("place_mm", [(41.0, 52.0), (55.0, 40.0), (63.0, 58.0)])
def test_a_hand_that_lands_slowly_is_one_contact_from_the_first(
    method: Method, place_mm: tuple[float, float]
) -> None:
    events = pressed(2.0, (25.0, lambda _: place_mm), lands_s=1.0, method=method)
    assert [event.event for event in events if event.event != "move"] == ["begin"]


def _away_mm(event: Touch, place_mm: tuple[float, float]) -> float:
    assert event.centroid_m is not None
    return float(np.hypot(*(1e3 * np.array(event.centroid_m[:2]) - place_mm)))
