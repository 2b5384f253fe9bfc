"""What pages are told: everything once, the newest of what changes, nothing that is over."""

import struct
from typing import Any

import msgspec
import numpy as np

from skin_host.client import Contact, Frame, Health, NodeInfo, PartInfo, Touch
from skin_host.mqtt.info import FingertipInfo, TriangleInfo
from skin_host.viewer.picture import Cursor, Picture


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


def picture(parts: dict[str, int] | None = None) -> Picture:
    made = Picture()
    made.take_nodes("test", {"main": (True, info(parts or {"palm": 3}))})
    made.take_status({"connected": True})
    return made


def texts(news: list[bytes | str]) -> dict[str, Any]:
    return {
        message["type"]: message
        for message in (msgspec.json.decode(text) for text in news if isinstance(text, str))
    }


def contact_ids(news: list[bytes | str]) -> list[int]:
    return [contact["id"] for contact in texts(news)["contacts"]["contacts"]]


def test_a_new_page_is_told_everything_once() -> None:
    skin = picture()
    skin.take_frame(frame("palm", [1, 2, 3]))
    skin.take_health(Health("palm", {"state": "ok"}))
    cursor = Cursor()
    news = skin.news(cursor)
    assert texts(news).keys() == {"layout", "status", "contacts", "health"}
    assert sum(isinstance(message, bytes) for message in news) == 1
    assert skin.news(cursor) == []


def test_a_frame_is_bytes_in_the_documented_order() -> None:
    skin = picture({"arm": 2, "palm": 3})
    cursor = Cursor()
    skin.news(cursor)
    skin.take_frame(
        frame(
            "palm",
            [1.5, 0, 99],
            seq=7,
            valid=np.array([True, False, True]),
            beyond_range=np.array([False, False, True]),
            missed=4,
        )
    )
    (message,) = skin.news(cursor)
    assert isinstance(message, bytes)
    kind, flags, part, n, version, seq, t_s, received, missed = struct.unpack(
        "<BBHIIIdII", message[:32]
    )
    assert (kind, flags, part, n, version, seq, t_s) == (1, 0, 1, 3, skin.version, 7, 2.0)
    assert (received, missed) == (1, 4)
    assert np.frombuffer(message[32:44], "<f4").tolist() == [1.5, 0, 99]
    assert list(message[44:]) == [1, 0, 3]


def test_raw_values_follow_when_they_came() -> None:
    skin = picture()
    cursor = Cursor()
    skin.news(cursor)
    skin.take_frame(frame("palm", [0, 0, 0], raw=np.array([240, 200, 0], np.uint8)))
    (message,) = skin.news(cursor)
    assert isinstance(message, bytes)
    assert message[1] == 1
    assert list(message[-3:]) == [240, 200, 0]


def test_a_slow_page_is_told_the_newest_frame_alone() -> None:
    skin = picture()
    cursor = Cursor()
    skin.news(cursor)
    for seq in range(5):
        skin.take_frame(frame("palm", [seq, 0, 0], seq=seq))
    (message,) = skin.news(cursor)
    assert isinstance(message, bytes)
    assert np.frombuffer(message[32:36], "<f4")[0] == 4


def test_a_frame_of_another_length_or_part_is_not_drawn() -> None:
    skin = picture()
    cursor = Cursor()
    skin.news(cursor)
    skin.take_frame(frame("palm", [1, 2]))
    skin.take_frame(frame("sole", [1, 2, 3]))
    assert skin.news(cursor) == []


def test_contacts_live_from_begin_to_end() -> None:
    skin = picture()
    cursor = Cursor()
    skin.take_touch(touch("begin", 1))
    skin.take_touch(touch("begin", 2))
    skin.take_touch(touch("move", 1))
    assert contact_ids(skin.news(cursor)) == [1, 2]
    skin.take_touch(touch("end", 1))
    assert contact_ids(skin.news(cursor)) == [2]


def test_a_contact_whose_end_was_missed_does_not_stay() -> None:
    for lose in (
        lambda skin: skin.take_touch(touch("begin", 9, missed=2)),
        lambda skin: skin.take_contact(Contact("palm", "OFF")),
        lambda skin: skin.forget_contacts(),
        lambda skin: skin.take_nodes("test", {"main": (False, info({"palm": 3}))}),
    ):
        skin = picture()
        cursor = Cursor()
        skin.take_touch(touch("begin", 1))
        assert contact_ids(skin.news(cursor)) == [1]
        lose(skin)
        assert 1 not in contact_ids(skin.news(cursor))


def test_a_changed_layout_is_told_with_all_that_is_known() -> None:
    skin = picture()
    cursor = Cursor()
    skin.take_frame(frame("palm", [1, 2, 3]))
    skin.news(cursor)
    both = {"main": (True, info({"palm": 3})), "legs": (True, info({"foot": 2}, "legs"))}
    skin.take_nodes("test", both)
    news = skin.news(cursor)
    layout = texts(news)["layout"]
    assert [(part["name"], part["node"]) for part in layout["parts"]] == [
        ("palm", "main"),
        ("foot", "legs"),
    ]
    assert sum(isinstance(message, bytes) for message in news) == 1
    skin.take_nodes("test", both)
    assert skin.news(cursor) == []


def test_health_is_told_in_sentences() -> None:
    skin = picture()
    record = {"state": "not calibrated", "sentences": ["bus can0 is down"], "valid_taxels": 3}
    skin.take_health(Health("palm", record))
    health = texts(skin.news(Cursor()))["health"]
    assert health["sentences"] == [
        "Not calibrated: leave the skin untouched and calibrate.",
        "bus can0 is down",
    ]
    assert health["valid_taxels"] == 3


def test_a_health_record_of_any_form_is_survived() -> None:
    skin = picture()
    for record in ({}, {"state": 3, "sentences": "x"}, {"state": ["a"], "triangles": None}):
        skin.take_health(Health("palm", record))
        health = texts(skin.news(Cursor()))["health"]
        assert health["part"] == "palm"
        assert isinstance(health["triangles"], list)


def test_nodes_that_go_offline_are_told() -> None:
    skin = picture()
    cursor = Cursor()
    assert texts(skin.news(cursor))["status"]["nodes"] == {"main": True}
    skin.take_nodes("test", {"main": (False, info({"palm": 3}))})
    skin.take_status({"connected": True})
    assert texts(skin.news(cursor))["status"]["nodes"] == {"main": False}


def test_a_fingertip_without_skin_is_told_with_its_contacts_and_health() -> None:
    tip = FingertipInfo(3, "sphere", [7.0], None, None, 0.1, 10.0)
    other = msgspec.structs.replace(info({"back": 2}, "two"), fingertips={"tip": tip})
    skin = picture()
    skin.take_nodes("test", {"two": (True, other), "main": (True, info({"palm": 3}))})
    skin.take_touch(msgspec.structs.replace(touch("begin", 4, "tip"), taxels=[], peak_kpa=None))
    skin.take_health(Health("tip", {"state": "saturated", "rate_hz": 333.0}))
    skin.take_frame(frame("palm", [1, 2, 3]))
    news = skin.news(Cursor())
    parts = texts(news)["layout"]["parts"]
    assert [part["name"] for part in parts] == ["back", "palm", "tip"]
    assert (parts[2]["fingertip"], parts[2]["pads"]) == (True, [])
    (told,) = [
        message
        for message in map(msgspec.json.decode, (text for text in news if isinstance(text, str)))
        if message["type"] == "contacts" and message["part"] == "tip"
    ]
    assert [(contact["id"], contact["peak_kpa"]) for contact in told["contacts"]] == [(4, None)]
    assert texts(news)["health"] == {
        "type": "health",
        "part": "tip",
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
