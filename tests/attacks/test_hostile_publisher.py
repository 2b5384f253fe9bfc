"""Whoever may publish below a robot's topics makes no client grow without end, or fail."""

import asyncio
import json
from typing import Any

import aiomqtt
import pytest
from msgspec.structs import replace

from skin_host.cli import main
from skin_host.cli.lines import event_line, missed_line
from skin_host.cli.watch import status_table
from skin_host.client import Contact
from skin_host.client.nodes import MAX_NAMES
from skin_host.client.presence import MAX_TOUCHES, Presence
from skin_host.mqtt.info import encode_info
from skin_host.mqtt.messages import decode_health
from skin_host.mqtt.payload import MessageError
from skin_host.mqtt.publisher import Publisher
from skin_host.viewer.picture import MAX_CONTACTS, Picture
from tests.client.test_client import hearing, publishing, take, touch
from tests.client.test_presence import seen
from tests.mqtt.test_publisher import settings
from tests.support.broker import Mosquitto
from tests.support.waiting import until
from tests.viewer import test_picture as pages

INFO = pages.info({"palm": 3})
HEALTH = {"schema": "skin.health/1", "part": "palm", "state": "ok"}


@pytest.mark.parametrize(
    "record",
    [
        HEALTH | {"state": ["ok"]},
        HEALTH | {"state": 5},
        HEALTH | {"faults": 5},
        HEALTH | {"faults": [5]},
        HEALTH | {"faults": [{"code": 1, "where": "x"}]},
        HEALTH | {"sentences": "all is well"},
        HEALTH | {"sentences": [None]},
        HEALTH | {"rate_hz": "fast"},
        HEALTH | {"age_ms": "old"},
    ],
)
def test_a_health_record_of_other_types_is_not_passed_on(record: object) -> None:
    """A program that looks for a state among some would fail on a list."""
    with pytest.raises(MessageError, match="health: "):
        decode_health(json.dumps(record).encode())
    assert decode_health(json.dumps(HEALTH).encode())["state"] == "ok"


async def test_more_parts_and_nodes_than_a_robot_has_are_passed_over(mosquitto: Mosquitto) -> None:
    many = 2 * MAX_NAMES
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        touches, contacts = skin.touches(), skin.contacts()
        await skin.ready()
        publisher.put_touch(touch(1))
        await take(touches, 1)
        async with aiomqtt.Client(mosquitto.host, mosquitto.port) as stranger:
            for number in range(many):
                await stranger.publish(f"skin/robot/nodes/n{number}/status", b"online", qos=1)
                await stranger.publish(f"skin/robot/p{number}/contact", b"ON", qos=1)
        await until(lambda: skin.unreadable >= 2 * (many - MAX_NAMES))
        assert len(skin.nodes) == MAX_NAMES
        assert len(skin._presence.reported()) <= MAX_NAMES
        # Those that were known before go on.
        publisher.put_touch(touch(2))
        assert (await take(touches, 1))[0].count == 2
        contacts.close()


async def test_infos_in_endless_pieces_are_passed_over(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skin_host.client.nodes.MAX_INFO_BYTES", 100_000)
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        publisher.put_info(INFO)
        await until(lambda: "main" in skin.nodes and skin.nodes["main"].info is not None)
        piece = encode_info(replace(INFO, pieces=10_000))
        async with aiomqtt.Client(mosquitto.host, mosquitto.port) as stranger:
            for number in range(2, 200):
                await stranger.publish(f"skin/robot/nodes/n/{number}/info", piece, qos=1)
            await until(lambda: skin.unreadable > 0)
            assert sum(map(len, (one.pieces for one in skin.nodes.values()))) < 200
            # The robot's own, which is known, may change.
            publisher.put_info(replace(INFO, version="later"))
            await until(lambda: skin.nodes["main"].info.version == "later")
            before = len(skin.nodes["n"].pieces)
            for number in range(2, 200):
                await stranger.publish(f"skin/robot/nodes/n/{number}/info", b"", qos=1)
            await until(lambda: "n" not in skin.nodes)  # nothing is left of it
            for number in range(2, before):
                await stranger.publish(f"skin/robot/nodes/n/{number}/info", piece, qos=1)
            await until(lambda: "n" in skin.nodes and len(skin.nodes["n"].pieces) == before - 2)


def test_of_contacts_that_never_end_the_page_shows_the_newest() -> None:
    picture = Picture()
    picture.take_nodes("robot", {"main": (True, INFO)}, dict.fromkeys(INFO.parts, "main"))
    (name, part), *_ = picture.parts.items()
    numbers = range(MAX_CONTACTS + 10)
    picture.take_touches(replace(seen("begin", one), part=name, taxels=[0]) for one in numbers)
    assert [one.id for one in part.contacts] == list(numbers)[10:]


def test_touches_that_never_end_are_forgotten_from_the_oldest_on() -> None:
    presence = Presence(stale_s=3.0)
    for number in range(MAX_TOUCHES + 10):
        presence.take_touch(seen("begin", number), 1.0)
    known = [one.id for one in presence.touches("palm", 1.0)]
    assert known == list(range(10, MAX_TOUCHES + 10))


def test_touches_of_very_many_taxels_do_not_fill_the_memory() -> None:
    presence = Presence(stale_s=3.0)
    large = list(range(100_000))
    for number in range(100):
        presence.take_touch(replace(seen("begin", number), taxels=large), 1.0)
    assert [one.id for one in presence.touches("palm", 1.0)] == [98, 99]


def test_infos_that_name_other_parts_each_time_do_not_add_up() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_state("palm", "OFF", 1.0)
    presence.take_node("main", online=True, now_s=1.0)
    presence.take_info("main", ["palm"], 1.0)
    for number in range(100):
        presence.take_info("stranger", ["palm", f"part{number}"], 1.0)
    assert len(presence.holders) == 2
    presence.take_info("stranger", [], 1.0)
    presence.take_node("main", online=False, now_s=1.0)
    assert presence.changes(1.0) == [Contact("palm", "UNKNOWN", "offline")]


async def test_an_answer_does_not_steer_the_terminal_and_is_checked(
    mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whoever may publish answers may answer before the node does."""
    evil = "\x1b[2J\x9b2Jpalm\u202e"
    answers: dict[str, Any] = {
        "thresholds": {evil: evil},
        "status": {"palm": 5},
        "raw": {"seconds": [evil]},
    }

    async def handle(name: str, _: bytes) -> dict[str, Any]:
        return answers[name]

    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with Publisher(settings(mosquitto), "robot", handler=handle) as publisher:
        await until(lambda: publisher.counters.connected)
        for name, ends in (("thresholds", 0), ("raw", 0), ("status", 1)):
            for words in ([], ["--json"]):
                asked = ["command", name, "--broker", broker, "--robot", "robot", *words]
                assert await asyncio.to_thread(main, asked) == (0 if words else ends)
    said = capsys.readouterr()
    assert not {one for one in said.out + said.err if one != "\n" and not one.isprintable()}
    assert said.err == "skin command: health: Expected `object`, got `int`\n"


def test_what_is_received_does_not_steer_the_terminal() -> None:
    """Escapes move the cursor and hide what was printed; others turn the text around."""
    evil = "\x1b[2J\x9b2Jpalm\u202e"
    table = status_table({evil: HEALTH | {"state": evil, "sentences": [evil + "\nall is well"]}})
    line = event_line(replace(seen("begin"), part=evil))
    missed = missed_line(replace(seen("begin"), part=evil, missed=3), as_json=False)
    for text in (*table.split("\n"), line, missed):
        assert text.isprintable()
    assert len(table.split("\n")) == 3
