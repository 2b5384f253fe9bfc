"""What pages are told: everything once, the newest of what changes, nothing that is over."""

import struct
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from skin_host.client import Contact, Frame, Health, NodeInfo, PartInfo, Touch
from skin_host.mqtt.info import FingertipInfo, TriangleInfo
from skin_host.processing.events import Load
from skin_host.viewer.picture import Cursor, Picture

NOW_S = 100.0


def info(parts: dict[str, int], node: str = "main") -> NodeInfo:
    """A node whose parts have so many taxels."""
    return NodeInfo(
        robot="test",
        node=node,
        version="1",
        configuration="x",
        parts={
            name: PartInfo(
                period_ms=50,
                pads=["pressure"] * n,
                position_m=[(0.0, 0.0, 0.0)] * n,
                normal=[(0.0, 0.0, 1.0)] * n,
                radius_mm=[2.0] * n,
                area_mm2=[20.0] * n,
                triangles=[TriangleInfo("mtb", 0, "triangle", 0, [(0.0, 0.0, 0.0)] * 3)],
            )
            for name, n in parts.items()
        },
    )


def frame(part: str, kpa: list[float], seq: int = 1, **more: Any) -> Frame:
    n = len(kpa)
    keys = {
        "valid": np.ones(n, np.bool_),
        "beyond_range": np.zeros(n, np.bool_),
    } | more
    return Frame(part, seq, 2_000_000_000, np.array(kpa), **keys)


def touch(event: Any, number: int, part: str = "palm", missed: int = 0) -> Touch:
    return Touch(
        event=event,
        id=number,
        seq=1,
        t_ns=1,
        part=part,
        taxels=[1, 2],
        centroid_m=(0.0, 0.0, 0.0),
        normal=None,
        area_mm2=40.0,
        peak_kpa=3.0,
        mean_kpa=2.0,
        force_n=0.1,
        missed=missed,
    )


def take_nodes(skin: Picture, nodes: dict[str, tuple[bool | None, NodeInfo]]) -> None:
    """Each part is of the last node that names it."""
    infos = {name: one for name, (_, one) in nodes.items()}
    holders = {part: name for name, one in infos.items() for part in [*one.parts, *one.fingertips]}
    skin.take_nodes("test", {**nodes}, holders)


def picture(parts: dict[str, int] | None = None) -> Picture:
    made = Picture()
    take_nodes(made, {"main": (True, info(parts or {"palm": 3}))})
    made.take_status({"connected": True})
    return made


def test_a_page_expects_frames_as_often_as_they_are_published() -> None:
    """Between two of them their part would look stale."""
    found = {}
    for frame_hz in (0.0, 100.0, 0.5):
        made = Picture()
        take_nodes(made, {"main": (True, replace(info({"palm": 3}), frame_hz=frame_hz))})
        layout = msgspec.json.decode(made.news(Cursor(), NOW_S)[0])
        part = layout["parts"][0]
        found[frame_hz] = part["period_ms"], part["thinned"]
    assert found == {0.0: (50, False), 100.0: (50, False), 0.5: (2000, True)}


def texts(news: list[bytes | str]) -> dict[str, Any]:
    return {
        message["type"]: message
        for message in (msgspec.json.decode(text) for text in news if isinstance(text, str))
    }


#: Fields of a touch that a page is not sent, and why.
LEFT_OUT = {
    "event": "the list holds what lasts now",
    "reason": "the same",
    "seq": "of what lasts, the age is that of the part",
    "t_ns": "the same",
    "count": "the list is whole",
    "missed": "the list is whole",
    "normal": "not drawn",
    "mean_kpa": "not shown: the highest is",
    "sigma_m": "not drawn",
}


def test_what_a_touch_has_is_shown_or_left_out_on_purpose() -> None:
    skin = picture()
    skin.take_contact(Contact("palm", "ON"))
    load = Load("saturated", (0.0, 0.0, -1.0), (0.0, 0.0, 0.0), None, [])
    skin.take_touches([replace(touch("begin", 3), partial=True, beyond=True, load=load)])
    message = texts(skin.news(Cursor(), NOW_S))["contacts"]
    (contact,) = message["contacts"]
    named = {"load": "verdict"}
    sent = {named.get(field, field) for field in Touch.__struct_fields__ if field not in LEFT_OUT}
    assert {*contact, "part"} == sent
    assert (contact["partial"], contact["beyond"], contact["verdict"]) == (True, True, "saturated")
    skin.take_touches([touch("begin", 3)])
    (contact,) = texts(skin.news(Cursor(), NOW_S))["contacts"]["contacts"]
    assert (contact["partial"], contact["beyond"], contact["verdict"]) == (False, False, None)


def contact_ids(news: list[bytes | str]) -> list[int]:
    return [contact["id"] for contact in texts(news)["contacts"]["contacts"]]


def test_a_new_page_is_told_everything_once() -> None:
    skin = picture()
    skin.take_frame(frame("palm", [1, 2, 3]), NOW_S)
    skin.take_health(Health("palm", {"state": "ok"}), NOW_S)
    cursor = Cursor()
    news = skin.news(cursor, NOW_S)
    assert texts(news).keys() == {"layout", "status", "contacts", "health"}
    assert sum(isinstance(message, bytes) for message in news) == 1
    assert skin.news(cursor, NOW_S) == []


def test_a_frame_is_bytes_in_the_documented_order() -> None:
    skin = picture({"arm": 2, "palm": 3})
    cursor = Cursor()
    skin.news(cursor, NOW_S)
    skin.take_frame(
        frame(
            "palm",
            [1.5, 0, 99],
            seq=7,
            valid=np.array([True, False, True]),
            beyond_range=np.array([False, False, True]),
            missed=4,
        ),
        NOW_S,
    )
    (message,) = skin.news(cursor, NOW_S + 1.5)
    assert isinstance(message, bytes)
    kind, flags, part, n, version, seq, t_s, received, missed, age_s = struct.unpack(
        "<BBHIIIdIIf", message[:36]
    )
    assert (kind, flags, part, n, version, seq, t_s) == (1, 0, 1, 3, skin.version, 7, 2.0)
    assert (received, missed, age_s) == (1, 4, 1.5)
    assert np.frombuffer(message[36:48], "<f4").tolist() == [1.5, 0, 99]
    assert list(message[48:]) == [1, 0, 3]


def test_raw_values_follow_when_they_came() -> None:
    skin = picture()
    cursor = Cursor()
    skin.news(cursor, NOW_S)
    skin.take_frame(frame("palm", [0, 0, 0], raw=np.array([240, 200, 0], np.uint8)), NOW_S)
    (message,) = skin.news(cursor, NOW_S)
    assert isinstance(message, bytes)
    assert message[1] == 1
    assert list(message[-3:]) == [240, 200, 0]


def test_a_slow_page_is_told_the_newest_frame_alone() -> None:
    skin = picture()
    cursor = Cursor()
    skin.news(cursor, NOW_S)
    for seq in range(5):
        skin.take_frame(frame("palm", [seq, 0, 0], seq=seq), NOW_S)
    (message,) = skin.news(cursor, NOW_S)
    assert isinstance(message, bytes)
    assert np.frombuffer(message[36:40], "<f4")[0] == 4


def test_a_frame_of_another_length_or_part_is_not_drawn() -> None:
    skin = picture()
    cursor = Cursor()
    skin.news(cursor, NOW_S)
    skin.take_frame(frame("palm", [1, 2]), NOW_S)
    skin.take_frame(frame("sole", [1, 2, 3]), NOW_S)
    assert skin.news(cursor, NOW_S) == []


def test_contacts_are_those_that_the_client_knows() -> None:
    skin = picture()
    cursor = Cursor()
    first, second = touch("begin", 1), touch("begin", 2)
    skin.take_touches([first, second])
    assert contact_ids(skin.news(cursor, NOW_S)) == [1, 2]
    skin.take_touches([first, second])
    assert skin.news(cursor, NOW_S) == []
    skin.take_touches([second])
    assert contact_ids(skin.news(cursor, NOW_S)) == [2]


def test_pages_get_the_contact_state_of_each_part_and_why_it_is_not_known() -> None:
    skin = picture()
    cursor = Cursor()
    before = texts(skin.news(cursor, NOW_S))["contacts"]
    assert (before["state"], before["why"]) == (None, None)
    for contact in (
        Contact("palm", "OFF"),
        Contact("palm", "UNKNOWN", "not_felt"),
        Contact("palm", "ON"),
        Contact("palm", "UNKNOWN", "offline"),
    ):
        skin.take_contact(contact)
        sent = texts(skin.news(cursor, NOW_S))["contacts"]
        assert (sent["state"], sent["why"]) == (contact.state, contact.why)


def test_a_state_and_a_health_record_wait_for_the_description_of_their_part() -> None:
    """Those of a node that has stopped are sent once."""
    skin = Picture()
    skin.take_contact(Contact("palm", "UNKNOWN", "offline"))
    skin.take_health(Health("palm", {"state": "ok", "valid_taxels": 3}), NOW_S)
    take_nodes(skin, {"main": (False, info({"palm": 3}))})
    sent = texts(skin.news(Cursor(), NOW_S + 30.0))
    assert (sent["contacts"]["state"], sent["contacts"]["why"]) == ("UNKNOWN", "offline")
    assert (sent["health"]["valid_taxels"], sent["health"]["age_s"]) == (3, 30.0)


@pytest.mark.parametrize("why", ["stale", "offline", "disconnected"])
def test_contacts_of_what_is_not_received_any_more_are_not_shown(why: Any) -> None:
    skin = picture()
    cursor = Cursor()
    skin.take_contact(Contact("palm", "ON"))
    skin.take_touches([touch("begin", 1)])
    assert contact_ids(skin.news(cursor, NOW_S)) == [1]
    skin.take_contact(Contact("palm", "UNKNOWN", why))
    assert contact_ids(skin.news(cursor, NOW_S)) == []


def test_after_the_client_has_ended_nothing_is_known() -> None:
    skin = picture()
    cursor = Cursor()
    skin.take_contact(Contact("palm", "ON"))
    skin.take_touches([touch("begin", 1)])
    skin.lose()
    sent = texts(skin.news(cursor, NOW_S))["contacts"]
    assert (sent["state"], sent["why"], sent["contacts"]) == ("UNKNOWN", "disconnected", [])


def test_a_page_that_opens_later_gets_what_is_old_with_its_age() -> None:
    skin = picture()
    skin.take_frame(frame("palm", [1, 2, 3]), NOW_S)
    skin.take_health(Health("palm", {"state": "ok"}), NOW_S + 1.0)
    for cursor, age_s in ((Cursor(), 0.0), (Cursor(), 30.0)):
        news = skin.news(cursor, NOW_S + 1.0 + age_s)
        (bytes_,) = [message for message in news if isinstance(message, bytes)]
        assert struct.unpack_from("<f", bytes_, 32) == (1.0 + age_s,)
        assert texts(news)["health"]["age_s"] == age_s


def test_how_old_stored_health_is_is_not_known_before_other_health_comes() -> None:
    skin = picture()
    stored = Health("palm", {"state": "ok"}, stored=True)
    skin.take_health(stored, NOW_S)
    assert texts(skin.news(Cursor(), NOW_S + 1.0))["health"]["age_s"] is None
    skin.take_health(Health("palm", {"state": "ok"}), NOW_S + 2.0)
    assert texts(skin.news(Cursor(), NOW_S + 3.0))["health"]["age_s"] == 1.0
    # The connection was lost: it is no older than what came before.
    skin.take_health(stored, NOW_S + 4.0)
    assert texts(skin.news(Cursor(), NOW_S + 5.0))["health"]["age_s"] == 3.0


def test_a_changed_layout_is_told_with_all_that_is_known() -> None:
    skin = picture()
    cursor = Cursor()
    skin.take_frame(frame("palm", [1, 2, 3]), NOW_S)
    skin.news(cursor, NOW_S)
    both = {"main": (True, info({"palm": 3})), "legs": (True, info({"foot": 2}, "legs"))}
    take_nodes(skin, both)
    news = skin.news(cursor, NOW_S)
    layout = texts(news)["layout"]
    assert [(part["name"], part["node"]) for part in layout["parts"]] == [
        ("palm", "main"),
        ("foot", "legs"),
    ]
    assert sum(isinstance(message, bytes) for message in news) == 1
    take_nodes(skin, both)
    assert skin.news(cursor, NOW_S) == []


def test_a_part_is_drawn_once_by_the_description_of_the_node_that_has_it() -> None:
    """Of one that has moved between nodes, or between a part of skin and a fingertip, the former
    node's description stays at the broker.
    """
    tip = FingertipInfo(3, "sphere", [7.0], None, None, 0.1, 10.0)
    former = msgspec.structs.replace(info({"palm": 2, "tip": 4}, "former"), fingertips={})
    now = msgspec.structs.replace(info({"palm": 3}, "now"), fingertips={"tip": tip})
    nodes: dict[str, tuple[bool | None, NodeInfo | None]] = {
        "now": (True, now),
        "former": (False, former),
    }
    for _ in range(2):  # in whichever order they came
        skin = Picture()
        cursor = Cursor()
        skin.take_nodes("test", nodes, {"palm": "now", "tip": "now"})
        parts = texts(skin.news(cursor, NOW_S))["layout"]["parts"]
        assert [(part["name"], part["node"], len(part["pads"])) for part in parts] == [
            ("palm", "now", 3),
            ("tip", "now", 0),
        ]
        skin.take_nodes("test", nodes, {"palm": "former", "tip": "now"})
        parts = texts(skin.news(cursor, NOW_S))["layout"]["parts"]
        assert [(part["name"], part["node"], len(part["pads"])) for part in parts] == [
            ("palm", "former", 2),
            ("tip", "now", 0),
        ]
        nodes = dict(reversed(nodes.items()))


def test_health_is_told_in_sentences() -> None:
    skin = picture()
    record = {"state": "not calibrated", "sentences": ["bus can0 is down"], "valid_taxels": 3}
    skin.take_health(Health("palm", record), NOW_S)
    health = texts(skin.news(Cursor(), NOW_S))["health"]
    assert health["sentences"] == [
        "Not calibrated: leave the skin untouched and calibrate.",
        "bus can0 is down",
    ]
    assert health["valid_taxels"] == 3


def test_a_health_record_of_any_form_is_survived() -> None:
    skin = picture()
    for record in ({}, {"state": 3, "sentences": "x"}, {"state": ["a"], "triangles": None}):
        skin.take_health(Health("palm", record), NOW_S)
        health = texts(skin.news(Cursor(), NOW_S))["health"]
        assert health["part"] == "palm"
        assert isinstance(health["triangles"], list)


def test_nodes_that_go_offline_are_told() -> None:
    skin = picture()
    cursor = Cursor()
    assert texts(skin.news(cursor, NOW_S))["status"]["nodes"] == {"main": True}
    take_nodes(skin, {"main": (False, info({"palm": 3}))})
    skin.take_status({"connected": True})
    assert texts(skin.news(cursor, NOW_S))["status"]["nodes"] == {"main": False}


def test_a_fingertip_without_skin_is_told_with_its_contacts_and_health() -> None:
    tip = FingertipInfo(3, "sphere", [7.0], None, None, 0.1, 10.0)
    other = msgspec.structs.replace(info({"back": 2}, "two"), fingertips={"tip": tip})
    skin = picture()
    take_nodes(skin, {"two": (True, other), "main": (True, info({"palm": 3}))})
    skin.take_touches([msgspec.structs.replace(touch("begin", 4, "tip"), taxels=[], peak_kpa=None)])
    skin.take_contact(Contact("tip", "ON"))
    skin.take_health(Health("tip", {"state": "saturated", "rate_hz": 333.0}), NOW_S)
    skin.take_frame(frame("palm", [1, 2, 3]), NOW_S)
    news = skin.news(Cursor(), NOW_S)
    parts = texts(news)["layout"]["parts"]
    assert [part["name"] for part in parts] == ["back", "palm", "tip"]
    assert (parts[2]["fingertip"], parts[2]["pads"]) == (True, [])
    (told,) = [
        message
        for message in map(msgspec.json.decode, (text for text in news if isinstance(text, str)))
        if message["type"] == "contacts" and message["part"] == "tip"
    ]
    assert [(contact["id"], contact["peak_kpa"]) for contact in told["contacts"]] == [(4, None)]
    assert told["state"] == "ON"
    assert texts(news)["health"] == {
        "type": "health",
        "part": "tip",
        "age_s": 0.0,
        "state": "saturated",
        "sentences": [],
        "rate_hz": 333.0,
        "taxels": None,
        "valid_taxels": None,
        "triangles": [],
    }
    # Frames name their part by its place in the layout.
    (bytes_,) = [message for message in news if isinstance(message, bytes)]
    assert struct.unpack_from("<H", bytes_, 2) == (1,)
