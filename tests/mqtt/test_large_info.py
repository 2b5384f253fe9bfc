"""A node's info that is larger than a broker's packets reaches subscribers in pieces."""

from pathlib import Path

import pytest

from skin_host.client import SkinClient
from skin_host.config.settings import load
from skin_host.errors import BrokerError
from skin_host.layout import build_layout
from skin_host.mqtt.info import NodeInfo, decode_info, encode_info, encode_pieces, node_info
from skin_host.mqtt.publisher import Publisher
from tests.mqtt.test_publisher import listening, settings
from tests.support.broker import Mosquitto
from tests.support.waiting import until

FOLDER = Path(__file__).parents[2] / "config"


def info_of(name: str) -> NodeInfo:
    layout = build_layout(load(FOLDER / name), FOLDER)
    return node_info(layout, "main", version="1", configuration="x")


def limited(mosquitto: Mosquitto, folder: Path, limit: int) -> Mosquitto:
    """A broker that takes packets of up to `limit` bytes."""
    folder.mkdir()
    return Mosquitto(mosquitto.program, folder, f"max_packet_size {limit}\n")


async def test_an_icub_is_known_through_a_broker_that_takes_256_kb(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    info = info_of("icub.toml")
    assert len(encode_info(info)) > 300_000
    narrow = limited(mosquitto, tmp_path / "narrow", 256_000)
    narrow.start()
    try:
        async with (
            Publisher(settings(narrow), "robot") as publisher,
            SkinClient(f"mqtt://{narrow.host}:{narrow.port}", robot="robot") as skin,
        ):
            publisher.put_info(info)
            assert (await skin.info(timeout_s=30.0))["main"].parts == info.parts
            assert not publisher.counters.withheld
    finally:
        narrow.kill()


async def test_contacts_go_right_behind_the_status_that_makes_them_valid(
    mosquitto: Mosquitto,
) -> None:
    """On a slow link a large info would keep contacts of before at the broker for seconds."""
    info = info_of("icub.toml")
    async with (
        listening(mosquitto) as seen,
        Publisher(settings(mosquitto, discovery_prefix="skin/home"), "robot") as publisher,
    ):
        publisher.put_info(info)
        for part in info.parts:
            publisher.put_health(part, {"state": "ok"})
            publisher.put_contact(part, "UNKNOWN")
        await until(lambda: seen.payloads("/info") and len(seen.payloads("/health")) > 1)
    topics = [message.topic.value.removeprefix("skin/robot/") for message in seen.messages]
    assert topics[: 1 + len(info.parts)] == [
        "nodes/main/status",
        *(f"{part}/contact" for part in info.parts),
    ]


async def test_pieces_that_are_needed_no_longer_are_cleared(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    info = info_of("demo.toml")
    narrow = limited(mosquitto, tmp_path / "narrow", one_part(info))
    narrow.start()
    try:
        async with listening(narrow) as seen, Publisher(settings(narrow), "robot") as publisher:
            publisher.put_info(info)
            await until(lambda: len(seen.payloads("/info")) == 2)
            first, second = (decode_info(payload) for payload in seen.payloads("/info"))
            assert [first.pieces, second.pieces] == [2, 2]
            assert first.parts | second.parts == info.parts
            assert seen.messages[-1].topic.value == "skin/robot/nodes/main/2/info"
            small = NodeInfo(
                robot="robot", node="main", version="1", configuration="y", parts=first.parts
            )
            publisher.put_info(small)
            await until(lambda: seen.payloads("main/info")[-1] == encode_info(small))
            await until(lambda: seen.payloads("2/info")[-1] == b"")
    finally:
        narrow.kill()


async def test_a_part_that_fits_into_no_packet_is_named_and_the_others_are_known(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    info = info_of("demo.toml")
    sizes = {name: len(encode_info(one)) for name, one in single_parts(info).items()}
    small, large = sorted(sizes, key=lambda name: sizes[name])
    narrow = limited(mosquitto, tmp_path / "narrow", sizes[small] + 1000)
    narrow.start()
    try:
        async with (
            Publisher(settings(narrow), "robot") as publisher,
            SkinClient(f"mqtt://{narrow.host}:{narrow.port}", robot="robot") as skin,
        ):
            publisher.put_info(info)
            assert list((await skin.info(timeout_s=30.0))["main"].parts) == [small]
            await until(lambda: publisher.counters.withheld == ["skin/robot/nodes/main/2/info"])
        assert large in info.parts
    finally:
        narrow.kill()


def one_part(info: NodeInfo) -> int:
    """So many bytes that each part fits into a packet alone, and two do not."""
    sizes = sorted(len(encode_info(one)) for one in single_parts(info).values())
    assert sizes[0] > 2000
    return sizes[-1] + 1000


def single_parts(info: NodeInfo) -> dict[str, NodeInfo]:
    return {
        name: NodeInfo(robot="r", node="main", version="1", configuration="x", parts={name: part})
        for name, part in info.parts.items()
    }


async def test_pieces_of_another_configuration_are_not_put_together(mosquitto: Mosquitto) -> None:
    info = info_of("demo.toml")
    pieces = encode_pieces(info, one_part(info))
    assert len(pieces) == 2
    async with listening(mosquitto) as seen, Publisher(settings(mosquitto), "robot") as publisher:
        publisher._outbox.put_state("skin/robot/nodes/main/info", pieces[0])
        other = pieces[1].replace(b'"configuration":"x"', b'"configuration":"y"')
        publisher._outbox.put_state("skin/robot/nodes/main/2/info", other)
        await until(lambda: len(seen.payloads("/info")) == 2)
        url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
        async with SkinClient(url, robot="robot") as skin:
            with pytest.raises(BrokerError, match="published its info"):
                await skin.info(timeout_s=0.3)
            publisher._outbox.put_state("skin/robot/nodes/main/2/info", pieces[1])
            assert (await skin.info())["main"].parts == info.parts
