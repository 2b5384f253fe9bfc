"""The live servers of Foxglove and Rerun, seen by a client of each."""

import asyncio
import json
import os
import signal
import socket
import sys
import warnings
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from skin_host.config.settings import Mqtt, load
from skin_host.layout import build_layout
from skin_host.mqtt.info import FingertipInfo, PartInfo, node_info
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.frame import PressureFrame
from skin_host.recording.export import live
from skin_host.recording.export.scene import Arrows, EventLine, Points
from skin_host.recording.export.series import HealthLine
from tests.support.broker import Mosquitto, free_port
from tests.support.rerun import chunks
from tests.support.said import touch_event
from tests.support.waiting import until

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"
PATIENCE_S = 60.0
TOUCH = touch_event(
    "begin", 7, 3, 10**18 + 5, "left_hand", [0, 1], [0.1, 0, 0], [0, 0, 1.0], 40.0, 31, 20.0, 2.0
)


@asynccontextmanager
async def shown(broker: Mosquitto, serving: live.Serving) -> AsyncIterator[str]:
    """A viewer of a robot that sends a frame and a touch again and again; its URL."""
    layout = build_layout(load(CONFIG), CONFIG.parent)
    n = layout.part("left_hand").n_taxels
    valid, none = np.arange(n) != 5, np.zeros(n, np.bool_)
    kpa = np.where(valid, np.float32(12.5), np.float32(0.0))
    url: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    stop = asyncio.Event()

    async def publish(publisher: Publisher) -> None:
        seq = 0
        while True:
            seq += 1
            t_ns, raw = 10**18 + seq * 50_000_000, np.zeros(n, np.uint8)
            frame = PressureFrame("left_hand", seq, t_ns, raw, kpa, none, valid, none)
            publisher.put_frame(frame)
            publisher.put_touch(TOUCH)
            await asyncio.sleep(0.1)

    async with Publisher(Mqtt(host=broker.host, port=broker.port), "demo", "main") as publisher:
        publisher.put_info(node_info(layout, "main", version="1", configuration="x"))
        where = f"mqtt://{broker.host}:{broker.port}"
        tasks = [
            asyncio.create_task(publish(publisher)),
            asyncio.create_task(live.run(where, "demo", stop, serving, url.set_result)),
        ]
        async with asyncio.timeout(PATIENCE_S):
            await asyncio.wait([url, tasks[1]], return_when=asyncio.FIRST_COMPLETED)
            if tasks[1].done():
                await tasks[1]
            yield await url
            stop.set()
            await tasks[1]
        tasks[0].cancel()
        with suppress(asyncio.CancelledError):
            await tasks[0]


async def test_foxglove_s_client_receives_points_contacts_and_transforms(
    mosquitto: Mosquitto,
) -> None:
    pytest.importorskip("foxglove")
    from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    kinds: dict[str, Any] = {
        "/tf": FrameTransforms,
        "/left_hand/points": PointCloud,
        "/left_hand/contacts": SceneUpdate,
    }
    seen: dict[str, Any] = {}
    async with shown(mosquitto, live.foxglove("127.0.0.1", 0)) as url:
        protocols = [Subprotocol("foxglove.sdk.v1")]
        async with connect(url.split()[0], subprotocols=protocols, max_size=None) as socket:
            topics: dict[int, str] = {}
            while set(seen) != set(kinds):
                said = await socket.recv()
                if isinstance(said, str):
                    for channel in json.loads(said).get("channels", []):
                        assert channel["encoding"] == "protobuf"
                        topics[channel["id"]] = channel["topic"]
                        subscribed = {"id": channel["id"], "channelId": channel["id"]}
                        await socket.send(
                            json.dumps({"op": "subscribe", "subscriptions": [subscribed]})
                        )
                elif said[0] == 1:
                    topic = topics[int.from_bytes(said[1:5], "little")]
                    if topic in kinds:
                        seen[topic] = kinds[topic].FromString(said[13:])
    cloud = seen["/left_hand/points"]
    assert [field.name for field in cloud.fields][:5] == ["x", "y", "z", "kpa", "valid"]
    assert len(cloud.data) % cloud.point_stride == 0
    (entity,) = seen["/left_hand/contacts"].entities
    assert len(entity.arrows) == 1
    names = {one.child_frame_id for one in seen["/tf"].transforms}
    assert names == {"left_hand", "left_forearm"}


@asynccontextmanager
async def following(broker: Mosquitto) -> AsyncIterator[list[Any]]:
    """What a viewer of the robot is given to show."""
    items: list[Any] = []
    stop = asyncio.Event()
    ready = asyncio.Event()

    @asynccontextmanager
    async def serving() -> AsyncIterator[tuple[str, live.Show]]:
        yield "a viewer", lambda _: items.append

    where = f"mqtt://{broker.host}:{broker.port}"
    running = asyncio.create_task(live.run(where, "demo", stop, serving(), lambda _: ready.set()))
    async with asyncio.timeout(PATIENCE_S):
        await ready.wait()
        try:
            yield items
        finally:
            stop.set()
            await running


async def test_a_part_of_a_robot_that_is_gone_does_not_look_as_it_was(
    mosquitto: Mosquitto,
) -> None:
    layout = build_layout(load(CONFIG), CONFIG.parent)
    n = layout.part("left_hand").n_taxels
    all_valid, none = np.ones(n, np.bool_), np.zeros(n, np.bool_)
    raw, kpa = np.zeros(n, np.uint8), np.zeros(n, np.float32)
    frame = PressureFrame("left_hand", 1, 10**18, raw, kpa, none, all_valid, none)

    def last(kind: type) -> Any:
        return next((item for item in reversed(items) if isinstance(item, kind)), None)

    settings = Mqtt(host=mosquitto.host, port=mosquitto.port)
    async with AsyncExitStack() as stack:
        robot = await stack.enter_async_context(Publisher(settings, "demo", "main"))
        robot.put_info(node_info(layout, "main", version="1", configuration="x"))
        async with following(mosquitto) as items:
            while last(Points) is None or last(Arrows) is None or not last(Arrows).arrows:
                robot.put_contact("left_hand", "ON")
                robot.put_frame(replace(frame, t_ns=frame.t_ns + len(items)))
                robot.put_touch(TOUCH)
                await asyncio.sleep(0.05)
            assert last(Points).points["valid"].all()
            # The end of the contact is lost on the way.
            robot.put_contact("left_hand", "OFF")
            await until(lambda: not last(Arrows).arrows)
            before_ns = last(Points).t_ns
            robot.put_touch(TOUCH.ended(4, 10**18 + 6, "lost"))
            await until(lambda: last(EventLine))
            assert last(EventLine).text.endswith("it may still last")
            await stack.aclose()
            await until(lambda: not last(Points).points["valid"].any())
            assert last(Points).t_ns > before_ns


async def test_what_touched_a_robot_that_is_gone_is_not_known_any_more(
    mosquitto: Mosquitto,
) -> None:
    """Fingertips are no other: they have no taxels that would show it."""
    layout = build_layout(load(CONFIG), CONFIG.parent)
    info = node_info(layout, "main", version="1", configuration="x")
    tip = FingertipInfo(3, "sphere", [7.0], None, None, 0.3, 8.0)
    touched = {"left_hand", "tip"}

    def shown() -> dict[str, tuple[bool, bool]]:
        arrows = {item.part: item for item in items if isinstance(item, Arrows)}
        return {part: (bool(item.arrows), item.is_known) for part, item in arrows.items()}

    settings = Mqtt(host=mosquitto.host, port=mosquitto.port)
    async with AsyncExitStack() as stack:
        robot = await stack.enter_async_context(Publisher(settings, "demo", "main"))
        robot.put_info(msgspec.structs.replace(info, fingertips={"tip": tip}))
        async with following(mosquitto) as items:
            while shown() != dict.fromkeys(touched, (True, True)):
                for part in touched:
                    robot.put_contact(part, "ON")
                    robot.put_touch(msgspec.structs.replace(TOUCH, part=part))
                await asyncio.sleep(0.05)
            await stack.aclose()
            await until(lambda: shown() == dict.fromkeys(touched, (False, False)))


async def test_the_force_on_a_part_is_not_known_from_a_lost_contact_until_nothing_touches_it(
    mosquitto: Mosquitto,
) -> None:
    """However other contacts of the part begin, last and are released meanwhile."""
    layout = build_layout(load(CONFIG), CONFIG.parent)
    other = msgspec.structs.replace(TOUCH, id=TOUCH.id + 1)

    def shown() -> tuple[int, bool] | None:
        arrows = [item for item in items if isinstance(item, Arrows)]
        return (len(arrows[-1].arrows), arrows[-1].is_known) if arrows else None

    settings = Mqtt(host=mosquitto.host, port=mosquitto.port)
    async with AsyncExitStack() as stack:
        robot = await stack.enter_async_context(Publisher(settings, "demo", "main"))
        robot.put_info(node_info(layout, "main", version="1", configuration="x"))
        items = await stack.enter_async_context(following(mosquitto))
        while shown() != (2, True):
            robot.put_contact("left_hand", "ON")
            robot.put_touch(TOUCH)
            robot.put_touch(other)
            await asyncio.sleep(0.05)
        robot.put_touch(TOUCH.ended(4, 10**18 + 6, "lost"))
        await until(lambda: shown() == (1, False))
        robot.put_touch(other.ended(5, 10**18 + 7, "released"))
        await until(lambda: shown() == (0, False))
        robot.put_contact("left_hand", "OFF")
        await until(lambda: shown() == (0, True))


async def test_what_has_no_time_follows_the_rest_by_the_clock_of_the_robot(
    mosquitto: Mosquitto,
) -> None:
    """By another clock a state would be behind, or hide, the contacts that follow it."""
    layout = build_layout(load(CONFIG), CONFIG.parent)
    settings = Mqtt(host=mosquitto.host, port=mosquitto.port)

    def arrows() -> list[Arrows]:
        return [item for item in items if isinstance(item, Arrows)]

    async with Publisher(settings, "demo", "main") as robot:
        robot.put_info(node_info(layout, "main", version="1", configuration="x"))
        async with following(mosquitto) as items:
            while not arrows():
                robot.put_touch(TOUCH)
                await asyncio.sleep(0.05)
            robot.put_contact("left_hand", "OFF")
            await until(lambda: not arrows()[-1].arrows)
            last_ns = TOUCH.t_ns + 10**12
            robot.put_touch(msgspec.structs.replace(TOUCH, t_ns=last_ns))
            await until(lambda: arrows()[-1].arrows)
            times_ns = [item.t_ns for item in arrows()]
            assert times_ns == sorted(times_ns)
            assert times_ns[-1] == last_ns


async def test_health_that_the_broker_had_stored_is_not_shown_as_that_of_now(
    mosquitto: Mosquitto,
) -> None:
    layout = build_layout(load(CONFIG), CONFIG.parent)
    settings = Mqtt(host=mosquitto.host, port=mosquitto.port)
    async with Publisher(settings, "demo", "main") as robot:
        robot.put_info(node_info(layout, "main", version="1", configuration="x"))
        robot.put_health("left_hand", {"state": "silent"})
        async with following(mosquitto) as items:
            while not any(isinstance(item, EventLine) for item in items):
                robot.put_touch(TOUCH.ended(4, 10**18 + 6, "lost"))
                await asyncio.sleep(0.05)
            robot.put_health("left_hand", {"state": "ok"})
            await until(lambda: any(isinstance(item, HealthLine) for item in items))
            assert [item.state for item in items if isinstance(item, HealthLine)] == ["ok"]


async def test_it_ends_when_it_is_asked_to_while_the_broker_does_not_answer() -> None:
    stop, unused = asyncio.Event(), cast(Any, None)
    with socket.create_server(("127.0.0.1", 0)) as server:
        stop.set()  # as Ctrl-C does
        where = f"mqtt://127.0.0.1:{server.getsockname()[1]}"
        await live.run(where, "demo", stop, unused, unused)


async def test_a_forged_last_time_of_all_ends_no_view(mosquitto: Mosquitto) -> None:
    layout = build_layout(load(CONFIG), CONFIG.parent)
    n = layout.part("left_hand").n_taxels
    none, kpa = np.zeros(n, np.bool_), np.zeros(n, np.float32)
    frame = PressureFrame("left_hand", 1, 2**63 - 1, np.zeros(n, np.uint8), kpa, none, ~none, none)
    settings = Mqtt(host=mosquitto.host, port=mosquitto.port)
    async with Publisher(settings, "demo", "main") as robot:
        robot.put_info(node_info(layout, "main", version="1", configuration="x"))
        async with following(mosquitto) as items:
            while not any(isinstance(item, Points) for item in items):
                robot.put_frame(frame)
                await asyncio.sleep(0.05)
            robot.put_contact("left_hand", "OFF")
            await until(lambda: any(isinstance(item, Arrows) for item in items))
            assert {item.t_ns for item in items if isinstance(item, Points | Arrows)} == {2**63 - 1}


def listening() -> set[str]:
    """Addresses on which programs of this machine listen, as the kernel writes them."""
    lines = Path("/proc/net/tcp").read_text().splitlines()[1:]
    return {line.split()[1] for line in lines if line.split()[3] == "0A"}


async def test_rerun_s_viewer_is_served_on_loopback_alone_and_ends_with_us(
    mosquitto: Mosquitto,
) -> None:
    pytest.importorskip("rerun")
    async with shown(mosquitto, live.rerun("127.0.0.1", 0)) as url:
        page, _, feed = url.partition("?url=")
        host, _, port = page.removeprefix("http://").rstrip("/").partition(":")
        assert feed.startswith("rerun+http://127.0.0.1:")
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(b"GET / HTTP/1.0\r\nHost: localhost\r\n\r\n")
        assert b"200" in await reader.readline()
        writer.close()
        ports = (int(port), int(feed.split(":")[2].partition("/")[0]))
        ours = {f"0100007F:{wanted:04X}" for wanted in ports}
        assert ours <= listening()
        assert not {f"00000000:{wanted:04X}" for wanted in ports} & listening()
    await until(lambda: not ours & listening())


async def test_rerun_s_own_client_receives_points_contacts_and_transforms(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    received = tmp_path / "received.rrd"
    async with shown(mosquitto, live.rerun("127.0.0.1", 0)) as url:
        client = await asyncio.create_subprocess_exec(
            *(Path(sys.executable).with_name("rerun"), url.partition("?url=")[2]),
            *("--save", received, "--bind", "127.0.0.1", "--port", str(free_port())),
            env=os.environ | {"RERUN_ANALYTICS": "0"},
            stderr=asyncio.subprocess.DEVNULL,
            start_new_session=True,
        )
        # Some tens of frames and touches: the first ones come with it.
        await until(lambda: received.exists() and received.stat().st_size > 200_000)
        # A computer that runs this in the background may have SIGINT ignored.
        os.killpg(client.pid, signal.SIGTERM)
        await client.wait()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a file that was ended by a signal has no index
        seen = chunks(RrdReader(received))
    assert {"time", "Points3D:positions", "Points3D:colors"} <= seen["/robot/left_hand/taxels"]
    assert {"Arrows3D:vectors", "Arrows3D:labels"} <= seen["/robot/left_hand/contacts"]
    assert "Transform3D:translation" in seen["/robot/left_forearm"]
    assert "Scalars:scalars" in seen["/kpa/left_hand"]


async def test_taxels_are_shown_where_they_are_after_a_reload(mosquitto: Mosquitto) -> None:
    layout = build_layout(load(CONFIG), CONFIG.parent)
    info = node_info(layout, "main", version="1", configuration="x")
    hand = info.parts["left_hand"]
    moved = msgspec.structs.replace(
        hand, position_m=[(x, y + 0.25, z) for x, y, z in hand.position_m]
    )
    n = layout.part("left_hand").n_taxels
    none, kpa = np.zeros(n, np.bool_), np.zeros(n, np.float32)
    frame = PressureFrame("left_hand", 1, 10**18, np.zeros(n, np.uint8), kpa, none, ~none, none)

    def last(kind: type) -> Any:
        return next((item for item in reversed(items) if isinstance(item, kind)), None)

    def ys_m() -> list[float]:
        return [] if last(Points) is None else last(Points).points["y"].tolist()

    def wanted(shape: PartInfo) -> list[float]:
        places = zip(shape.position_m, shape.pads, strict=True)
        return np.array([y for (_, y, _), pad in places if pad == "pressure"], np.float32).tolist()

    settings = Mqtt(host=mosquitto.host, port=mosquitto.port)
    async with Publisher(settings, "demo", "main") as robot:
        robot.put_info(info)
        async with following(mosquitto) as items:
            for shape in (hand, moved):
                robot.put_info(msgspec.structs.replace(info, parts={"left_hand": shape}))
                while ys_m() != wanted(shape):
                    frame = replace(frame, seq=frame.seq + 1, t_ns=frame.t_ns + 1)
                    robot.put_frame(frame)
                    robot.put_touch(TOUCH)
                    await asyncio.sleep(0.05)
            await until(lambda: last(Arrows) is not None and last(Arrows).arrows)
            # Of a part that the robot has no longer nothing is left.
            robot.put_info(msgspec.structs.replace(info, parts={"left_forearm": hand}))
            await until(lambda: not last(Points).points["valid"].any() and not last(Arrows).arrows)
