"""From a press and a slip on an emulated fingertip to messages in a subscriber's hands."""

from typing import Any

import numpy as np
import pytest

from tests.support.stack import ROOT, Stack, wait_for
from tests.support.subscriber import Subscriber

SCENE = ROOT / "config" / "scenes" / "fingertips.toml"
PLACE_MM = 13.0 * np.array([0.3, 0.4, 0.87]) / np.linalg.norm([0.3, 0.4, 0.87])


@pytest.fixture
def configuration() -> str:
    return "fingertips"


def whole(events: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """Events by contact, of those that have ended."""
    by_contact: dict[int, list[dict[str, Any]]] = {}
    for event in events:
        by_contact.setdefault(event["id"], []).append(event)
    return [found for found in by_contact.values() if found[-1]["event"] == "end"]


def test_a_press_and_a_slip_on_a_fingertip_reach_a_subscriber(
    stack: Stack, subscriber: Subscriber
) -> None:
    assert stack.calibrate()["fingertips"] == {"index": "ok", "thumb": "ok"}
    daemon = stack.start("run", str(stack.config), scene=SCENE)

    # The scene repeats itself: a slow daemon may come into the middle of a press, not of the next.
    def slipped() -> list[tuple[list[dict[str, Any]], list[dict[str, Any]]]]:
        """Touches in which something was held and slipped, with their slips."""
        slips = whole(subscriber.documents("index/slip"))
        return [
            (touch, slip)
            for touch in whole(subscriber.documents("index/touch"))
            for slip in slips
            if touch[0]["id"] == slip[0]["id"] and any(map(is_held, touch))
        ]

    def is_held(event: dict[str, Any]) -> bool:
        return event["load"]["verdict"] == "contact" and event["force_n"] > 1.5

    def pressed() -> list[list[dict[str, Any]]]:
        """Touches that force and skin felt together."""
        return [one for one in whole(subscriber.documents("thumb/touch")) if any(map(is_felt, one))]

    def is_felt(event: dict[str, Any]) -> bool:
        return bool(event["taxels"]) and event["force_n"] > 2.0

    def seen() -> object:
        """The last events and health of each, for whoever reads that they were not enough."""
        kinds = ("index/touch", "index/slip", "thumb/touch", "thumb_skin/touch", "index/health")
        return {
            kind: (len(subscriber.payloads(kind)), subscriber.documents(kind)[-2:])
            for kind in kinds
        }

    touch, slip = wait_for(slipped, "a slip that ended, and its touch", seen)[0]
    thumb = wait_for(pressed, "a touch of the thumb that its skin felt too", seen)[0]
    assert daemon.poll() is None
    assert set(stack.stop()) <= {0}
    subscriber.catch_up()

    assert [touch[0]["event"], touch[-1]["event"]] == ["begin", "end"]
    held = [one for one in touch if is_held(one)]
    off_mm = 1e3 * np.array([one["centroid_m"] for one in held]) - PLACE_MM
    assert np.median(np.linalg.norm(off_mm, axis=1)) < 0.5
    assert np.median([one["force_n"] for one in held]) == pytest.approx(2.0, abs=0.1)
    assert {one["area_mm2"] for one in touch} == {None}
    assert slip[0]["event"] == "begin"
    assert 0.3 < slip[0]["shear_n"] / slip[0]["force_n"] < 0.8
    assert touch[0]["t_ns"] < slip[0]["t_ns"] < touch[-1]["t_ns"]

    both = [one for one in thumb if is_felt(one)]
    off_mm = 1e3 * np.array([one["centroid_m"] for one in both]) - [3.0, -2.0, 0.0]
    assert np.median(np.linalg.norm(off_mm, axis=1)) < 0.6
    assert {one["part"] for one in subscriber.documents("thumb_skin/touch")} == {"thumb_skin"}

    for part in ("index", "thumb"):
        contacts = subscriber.payloads(f"{part}/contact")
        assert contacts[0] == contacts[-1] == b"UNKNOWN"
        assert {*contacts} == {b"UNKNOWN", b"OFF", b"ON"}
        assert "ok" in {record["state"] for record in subscriber.documents(f"{part}/health")}
    # They answer discovery too, and are no strangers.
    faults = [one["code"] for record in subscriber.documents("/health") for one in record["faults"]]
    assert "bus_stranger" not in faults
    info = subscriber.documents("main/info")[-1]
    assert info["fingertips"]["index"]["shape"] == "sphere"
