"""Which node has a part, and how that describes it: also when it moves, or is configured anew."""

import asyncio
import itertools
import threading
from typing import Any

import aiomqtt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skin_host.client import Contact, Described, RequestError, SkinCallbacks
from skin_host.client.nodes import Nodes
from skin_host.client.presence import Presence
from skin_host.config.settings import load
from skin_host.layout import build_layout
from skin_host.mqtt.info import NodeInfo, PartInfo, encode_info, node_info
from skin_host.mqtt.order import Stamp
from skin_host.mqtt.payload import MessageError
from tests.client.test_client import CONFIG, hearing, publishing, take
from tests.support.broker import Mosquitto
from tests.support.waiting import PATIENCE_S, until

INFO = node_info(build_layout(load(CONFIG), CONFIG.parent), "main", version="1", configuration="x")
HAND, FOREARM = INFO.parts["left_hand"], INFO.parts["left_forearm"]
ELSEWHERE = replace(HAND, position_m=[(0.5, y, z) for _, y, z in HAND.position_m])


def described_by(node: str, **parts: Any) -> NodeInfo:
    return replace(INFO, node=node, parts=parts)


#: Of a part that is wider than any robot's.
FAR = (900.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("part", "what"),
    [
        (replace(HAND, position_m=[FAR, *HAND.position_m[1:]]), r"900[.0-9]* m wide"),
        (
            replace(HAND, triangles=[replace(HAND.triangles[0], outline_m=[FAR, (0.0, 0.0, 0.0)])]),
            r"900[.0-9]* m wide",
        ),
        (replace(HAND, position_m=[(0.0, -1e300, 0.0)] * len(HAND.pads)), r"1e\+300 m from its"),
        (replace(HAND, radius_mm=[1e6] * len(HAND.pads)), "1000 m is the radius of a pad"),
    ],
)
def test_an_info_with_a_part_larger_than_any_robots_is_refused(part: PartInfo, what: str) -> None:
    """On a map of one scale nothing else would be seen."""
    nodes = Nodes(Presence(stale_s=3.0))
    nodes.take_info("main", 1, encode_info(INFO), None, 0.0)
    with pytest.raises(MessageError, match=f"^info: parts.left_hand: {what}"):
        nodes.take_info("other", 1, encode_info(described_by("other", left_hand=part)), None, 1.0)
    assert nodes.known["other"].info is None
    assert nodes.parts()["left_hand"] == Described("left_hand", "main", HAND)


def test_a_part_far_from_its_origin_is_taken() -> None:
    nodes = Nodes(Presence(stale_s=3.0))
    far = replace(
        HAND,
        position_m=[(x + 900, y, z) for x, y, z in HAND.position_m],
        triangles=[replace(triangle, outline_m=[FAR]) for triangle in HAND.triangles],
    )
    nodes.take_info("main", 1, encode_info(described_by("main", left_hand=far)), None, 0.0)
    assert nodes.parts()["left_hand"].info == far


async def test_one_among_the_messages_is_counted(mosquitto: Mosquitto) -> None:
    wide = replace(HAND, position_m=[FAR, *HAND.position_m[1:]])
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        publisher.put_info(INFO)
        await skin.ready()
        await until(lambda: "left_hand" in skin.parts())
        async with aiomqtt.Client(mosquitto.host, mosquitto.port) as somebody:
            payload = encode_info(described_by("other", wide=wide))
            await somebody.publish("skin/robot/nodes/other/info", payload, qos=1)
        await until(lambda: skin.unreadable == 1)
        assert set(skin.parts()) == {"left_hand", "left_forearm"}


@pytest.mark.parametrize("order", [*itertools.permutations(["main", "main-1", "main-2"])])
@pytest.mark.parametrize("dead", [False, None])
def test_a_part_is_that_of_the_node_that_is_online_in_whatever_order_infos_come(
    order: tuple[str, ...], dead: bool | None
) -> None:
    presence = Presence(stale_s=3.0)
    presence.take_node("main", True, 0.0)
    presence.take_node("main-1", dead, 0.0)
    presence.take_node("main-2", dead, 0.0)
    for number, node in enumerate(order):
        presence.take_info(node, ["left"], 0.0, Stamp(100 + number, 1))
    presence.take_state("left", "OFF", 0.0)
    presence.take_sign("left", 0.1)
    assert presence.holders == {"left": "main"}
    assert presence.contact("left", 0.2) == Contact("left", "OFF")


def test_of_several_nodes_that_are_online_the_one_with_the_newest_info_has_a_part() -> None:
    presence = Presence(stale_s=3.0)
    for node, stamp in (("a", Stamp(2, 9)), ("b", Stamp(2, 10)), ("c", Stamp(1, 99))):
        presence.take_node(node, True, 0.0)
        presence.take_info(node, ["left"], 0.0, stamp)
    assert presence.holders == {"left": "b"}
    presence.take_info("d", ["left"], 0.0, Stamp(9, 9))  # of which no status is known
    assert presence.holders == {"left": "b"}
    # Without stamps, as with MQTT 3.1.1, the one that came last.
    for node in ("x", "y"):
        presence.take_node(node, True, 0.0)
        presence.take_info(node, ["right"], 0.0)
    assert presence.holders["right"] == "y"


def test_the_loss_of_a_broker_moves_no_part() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_node("main", True, 0.0)
    presence.take_node("main-1", False, 0.0)
    presence.take_info("main", ["left"], 0.0, Stamp(1, 1))
    presence.take_info("main-1", ["left"], 0.0, Stamp(2, 1))
    presence.take_loss()
    for node, stamp in (("main", Stamp(1, 1)), ("main-1", Stamp(2, 1))):
        presence.take_info(node, ["left"], 1.0, stamp)
        assert presence.holders == {"left": "main"}
    presence.take_node("main-1", False, 1.0)
    presence.take_node("main", True, 1.0)
    assert presence.holders == {"left": "main"}


def test_a_part_that_moves_is_unknown_until_something_comes_of_it() -> None:
    """What was received of it last is what its former node felt."""
    presence = Presence(stale_s=3.0)
    presence.take_node("a", True, 0.0)
    presence.take_info("a", ["left"], 0.0, Stamp(1, 1))
    presence.take_state("left", "OFF", 0.0)
    assert presence.changes(0.0) == [Contact("left", "OFF")]
    presence.take_node("b", True, 0.5)
    presence.take_info("b", ["left"], 0.5, Stamp(2, 1))
    assert presence.changes(0.5) == [Contact("left", "UNKNOWN", "stale")]
    presence.take_node("a", False, 0.6)
    presence.take_state("left", "OFF", 0.7)
    assert presence.changes(0.7) == [Contact("left", "OFF")]


def test_a_node_of_which_nothing_is_retained_has_no_parts() -> None:
    presence = Presence(stale_s=3.0)
    presence.take_node("main", True, 0.0)
    presence.take_info("main", ["left"], 0.0)
    presence.take_node("arm", False, 0.0)
    presence.take_info("arm", ["upper"], 0.0)
    assert presence.named() == {"left", "upper"}
    presence.forget_info("arm", 0.0)
    assert presence.named() is None  # nobody knows what it has
    presence.forget_node("arm", 0.0)
    assert presence.named() == {"left"}
    assert presence.holders == {"left": "main"}


NODES = st.sampled_from("abc")


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("status"), NODES, st.sampled_from([True, False, None])),
            st.tuples(st.just("info"), NODES, st.tuples(st.integers(0, 9), st.integers(0, 9))),
            st.tuples(st.just("deleted"), NODES, st.none()),
        )
    )
)
def test_a_part_that_an_online_node_names_is_that_of_one(steps: list[tuple[str, str, Any]]) -> None:
    presence = Presence(stale_s=3.0)
    online: dict[str, bool | None] = {}
    stamps: dict[str, Stamp] = {}
    for what, node, value in steps:
        match what:
            case "status":
                presence.take_node(node, value, 0.0)
                online[node] = value
            case "info":
                stamps[node] = Stamp(*value)
                presence.take_info(node, ["left"], 0.0, stamps[node])
            case "deleted":
                presence.forget_info(node, 0.0)
                stamps.pop(node, None)
        assert presence.holders.keys() == ({"left"} if stamps else set())
        for holder in presence.holders.values():
            rivals = [node for node in stamps if online.get(node)] or list(stamps)
            if any(online.get(node) for node in stamps):
                assert stamps[holder] == max(stamps[node] for node in rivals)
                assert online[holder]


async def left_behind(broker: Mosquitto, *infos: NodeInfo) -> None:
    """Leave at a broker what it keeps of nodes that have stopped."""
    async with aiomqtt.Client(broker.host, broker.port) as stranger:
        for info in infos:
            nodes = f"skin/robot/nodes/{info.node}"
            await stranger.publish(f"{nodes}/status", b"offline", qos=1, retain=True)
            await stranger.publish(f"{nodes}/info", encode_info(info), qos=1, retain=True)


async def test_a_part_that_has_moved_is_known_and_described_by_the_node_that_has_it(
    mosquitto: Mosquitto,
) -> None:
    former = described_by("main-1", left_hand=ELSEWHERE), described_by("zz", left_hand=ELSEWHERE)
    await left_behind(mosquitto, *former)
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        contacts, infos = skin.contacts("left_hand"), skin.infos()
        await skin.ready()
        publisher.put_info(INFO)
        publisher.put_contact("left_hand", "OFF")
        await skin.info()
        await until(lambda: "left_forearm" in skin.parts())
        assert await take(contacts, 1) == [Contact("left_hand", "OFF")]
        assert skin.parts() == {
            "left_hand": Described("left_hand", "main", HAND),
            "left_forearm": Described("left_forearm", "main", FOREARM),
        }
        last: dict[str, Described] = {}
        while last != skin.parts():
            (one,) = await take(infos, 1)
            last[one.part] = one


async def test_what_a_former_node_published_of_a_part_is_no_measure(mosquitto: Mosquitto) -> None:
    """It had no frames of it; the one that has the part now does."""
    await left_behind(mosquitto, described_by("aa", left_hand=replace(HAND, frames=False)))
    await left_behind(mosquitto, described_by("zz", left_hand=HAND, left_forearm=FOREARM))
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        streams = [skin.frames(part) for part in ("left_hand", "left_forearm")]
        silent = replace(
            INFO, parts={"left_hand": HAND, "left_forearm": replace(FOREARM, frames=False)}
        )
        publisher.put_info(silent)
        await until(lambda: "left_forearm" in skin.parts() and len(skin.nodes) == 3)
        await until(lambda: skin.parts()["left_forearm"].node == "main")
        skin._check_parts(asyncio.get_running_loop().time())
        with pytest.raises(RequestError, match="publishes no frames"):
            await anext(streams[1])
        assert streams[0]._failure is None


async def test_a_description_comes_at_once_and_again_when_it_changes(mosquitto: Mosquitto) -> None:
    async with hearing(mosquitto) as skin:
        infos, forearm = skin.infos(), skin.infos("left_forearm")
        await skin.ready()
        async with publishing(mosquitto) as publisher:
            publisher.put_info(INFO)
            first = {one.part: one for one in await take(infos, 2)}
            assert first == skin.parts()
            assert (first["left_hand"].skin, first["left_hand"].fingertip) == (HAND, None)
            publisher.put_info(replace(INFO, version="2"))  # no part is another
            publisher.put_info(replace(INFO, parts={"left_hand": ELSEWHERE}))
            changes = await take(infos, 2)
            assert changes == [
                Described("left_forearm", "", None),
                Described("left_hand", "main", ELSEWHERE),
            ]
            assert await take(skin.infos(), 1) == changes[1:]
        assert await take(forearm, 2) == [first["left_forearm"], changes[0]]
        # That its node stops changes nothing of what the part is.
        assert skin.parts() == {"left_hand": changes[1]}


async def test_a_node_of_which_all_is_deleted_is_gone(mosquitto: Mosquitto) -> None:
    await left_behind(mosquitto, described_by("arm", upper=HAND))
    async with hearing(mosquitto) as skin:
        await until(lambda: "upper" in skin.parts())
        async with aiomqtt.Client(mosquitto.host, mosquitto.port) as somebody:
            for what in ("info", "status"):
                await somebody.publish(f"skin/robot/nodes/arm/{what}", b"", qos=1, retain=True)
        await until(lambda: not skin.nodes)
        assert skin.parts() == {}


async def test_of_more_parts_than_any_robot_has_no_description_is_passed_on(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skin_host.client.nodes.MAX_NAMES", 3)
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        infos = skin.infos()
        for start in (0, 10):
            parts = {f"part{number}": HAND for number in range(start, start + 9)}
            publisher.put_info(replace(INFO, parts=parts))
            await until(lambda: f"part{start}" in skin.parts())  # noqa: B023
        assert len(list(skin._nodes.described())) == 3
        assert [one.info is None for one in await take(infos, 9)] == 3 * [False] + 3 * [
            True
        ] + 3 * [False]


async def test_descriptions_reach_who_has_no_asyncio(mosquitto: Mosquitto) -> None:
    asked = threading.Event()
    seen: list[Any] = []

    def use() -> None:
        with SkinCallbacks(f"mqtt://{mosquitto.host}:{mosquitto.port}", robot="robot") as skin:

            def take_info(one: Described) -> None:
                seen.append((one.part, one.node, set(skin.parts())))
                asked.set()

            skin.on_info(take_info, part="left_hand")
            assert asked.wait(PATIENCE_S)
            assert set(skin.parts()) == set(INFO.parts)

    async with publishing(mosquitto) as publisher:
        publisher.put_info(INFO)
        await asyncio.to_thread(use)
    assert seen == [("left_hand", "main", set(INFO.parts))]
