"""The plain subscriber follows the rules of docs/subscribers.md, at a real broker."""

import asyncio
import runpy
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import aiomqtt
import pytest
from msgspec import json
from msgspec.structs import replace
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from skin_host.mqtt.messages import encode_event
from skin_host.processing.events import Touch
from tests.examples.test_examples import BEGIN, EXAMPLES, ROOT, node
from tests.support.broker import Mosquitto, free_port
from tests.support.waiting import PATIENCE_S, until

HAND = "skin/demo/left_hand"
NAME = "demo/left_hand"


class Program:
    """The example as it runs."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process

    async def line(self) -> str:
        """Return the next line that it prints."""
        assert self.process.stdout is not None
        async with asyncio.timeout(PATIENCE_S):
            return (await self.process.stdout.readline()).decode().strip()

    async def lines_to(self, last: str) -> list[str]:
        """Return the next lines, to this one."""
        found = [await self.line()]
        while found[-1] != last:
            assert found[-1], found
            found.append(await self.line())
        return found

    async def lines_to_marker(self, robot: "Robot") -> list[str]:
        """Return what it prints of all that was published so far."""
        robot.markers += 1
        await robot.touch(robot.markers, part="marker")
        *lines, _ = await self.lines_to("demo/marker begin 7 2.00 N")
        return [line for line in lines if line != "demo/marker UNKNOWN"]


@asynccontextmanager
async def running(broker: Mosquitto, name: str = "a") -> AsyncIterator[Program]:
    """Run the example until it has subscribed, and end it as Ctrl-C does."""
    before = broker.subscriptions("skin/+/+/touch")
    # What runs in the background ignores this signal, and so would all that it starts.
    command = ["env", "--default-signal=INT", sys.executable, EXAMPLES / "subscriber.py"]
    process = await asyncio.create_subprocess_exec(
        *command, str(broker.port), name, cwd=ROOT, stdout=-1, stderr=-1
    )
    program = Program(process)
    try:
        await until(lambda: broker.subscriptions("skin/+/+/touch") > before)
        yield program
    finally:
        if process.returncode is None:
            process.send_signal(signal.SIGINT)
        async with asyncio.timeout(PATIENCE_S):
            await process.communicate()


class Robot:
    """A daemon whose messages have whatever numbers a test gives them."""

    def __init__(self, client: aiomqtt.Client) -> None:
        self._client = client
        self.markers = 0

    async def put(self, topic: str, payload: bytes, *, retain: bool = False, **keys: str) -> None:
        """Publish with user properties."""
        properties = Properties(PacketTypes.PUBLISH)
        properties.UserProperty = list(keys.items())
        await self._client.publish(topic, payload, 1, retain, properties)

    async def touch(
        self, count: int, run: str = "7", event: Touch = BEGIN, part: str = "left_hand"
    ) -> None:
        payload = json.encode(replace(event, count=count, part=part))
        await self.put(f"skin/demo/{part}/touch", payload, run=run)

    async def health(self, stamp: str) -> None:
        await self.put(f"{HAND}/health", b"{}", retain=True, stamp=stamp)


@asynccontextmanager
async def robot(broker: Mosquitto) -> AsyncIterator[Robot]:
    async with aiomqtt.Client(
        broker.host, broker.port, protocol=aiomqtt.ProtocolVersion.V5
    ) as client:
        yield Robot(client)


async def test_it_prints_touches_of_a_daemon(mosquitto: Mosquitto) -> None:
    async with node(mosquitto) as publisher, running(mosquitto) as program:
        publisher.put_touch(BEGIN)
        publisher.put_touch(BEGIN.ended(4, 10**18 + 6, "lost"))
        assert (await program.lines_to(f"{NAME} end 7 0.00 N, may still last"))[-3:] == [
            f"{NAME} begin 7 2.00 N",
            f"{NAME} UNKNOWN",
            f"{NAME} end 7 0.00 N, may still last",
        ]


async def test_it_tells_a_loss_from_a_daemon_that_was_started_again(mosquitto: Mosquitto) -> None:
    async with robot(mosquitto) as demo, running(mosquitto) as program:
        assert await program.line() == "the broker is there, without what came meanwhile"
        for count, run in ((4, "7"), (5, "7"), (8, "7"), (8, "7"), (1, "8"), (3, "8"), (2, "9")):
            await demo.touch(count, run)
        begins = f"{NAME} begin 7 2.00 N"
        restart = f"{NAME} the daemon was started again"
        assert await program.lines_to_marker(demo) == [
            # Events that came before it are none of its losses.
            *(begins, f"{NAME} UNKNOWN", begins),
            *(f"{NAME} 2 events were lost", begins),
            *(restart, begins, f"{NAME} 1 events were lost", begins),
            *(restart, f"{NAME} 1 events were lost", begins),
        ]


async def test_the_broker_keeps_events_while_it_is_away(mosquitto: Mosquitto) -> None:
    async with robot(mosquitto) as demo:
        async with running(mosquitto) as program:
            await demo.touch(1)
            await program.lines_to(f"{NAME} begin 7 2.00 N")
        await demo.touch(2)
        async with running(mosquitto) as program:
            assert await program.line() == "the broker is there, and has kept what came meanwhile"
            assert await program.line() == f"{NAME} begin 7 2.00 N"


async def test_a_retained_state_is_not_known_before_its_part_is_received(
    mosquitto: Mosquitto,
) -> None:
    async with robot(mosquitto) as demo:
        await demo.put(f"{HAND}/contact", b"OFF", retain=True, stamp="5.1")
        await demo.health("5.2")
        async with running(mosquitto) as program:
            await program.line()
            assert await program.line() == f"{NAME} UNKNOWN"
            assert await program.lines_to_marker(demo) == []
            await demo.health("5.3")
            assert await program.lines_to_marker(demo) == [f"{NAME} OFF"]
            # Then nothing more is published.
            assert (await program.lines_to(f"{NAME} UNKNOWN"))[-1] == f"{NAME} UNKNOWN"


async def test_what_a_broker_delivers_late_is_not_known(mosquitto: Mosquitto) -> None:
    second_ns = 10**9
    async with robot(mosquitto) as demo, running(mosquitto) as program:
        await demo.put(f"{HAND}/contact", b"OFF", stamp=f"5.{100 * second_ns}")
        await program.lines_to(f"{NAME} OFF")
        await program.lines_to(f"{NAME} UNKNOWN")
        for late_s in (50, 20, 10):
            await demo.health(f"5.{(100 - late_s) * second_ns}")
        assert await program.lines_to_marker(demo) == []
        # By another connection of the daemon its clock may have been set.
        await demo.health(f"6.{second_ns}")
        assert await program.lines_to_marker(demo) == [f"{NAME} OFF"]


@pytest.mark.parametrize("ppm", [-100, 0, 100])
def test_two_clocks_that_run_apart_make_nothing_late(ppm: int) -> None:
    """Nor hide that a broker is held up, after days of one connection."""
    part = runpy.run_path(str(EXAMPLES / "subscriber.py"))["Part"]()
    for hour in range(100):
        now_s = 3600.0 * hour
        since_ns = round(now_s * (1e9 + 1e3 * ppm))
        part.take_sign(now_s, f"5.{since_ns}")
        assert part.alive_s == now_s
    part.take_sign(now_s + 10.0, f"5.{since_ns + 1}")
    assert part.alive_s == now_s


async def test_states_of_a_node_that_is_offline_are_out_of_date(mosquitto: Mosquitto) -> None:
    async with robot(mosquitto) as demo, running(mosquitto) as program:
        await demo.put(f"{HAND}/contact", b"OFF", stamp="5.1")
        await program.lines_to(f"{NAME} OFF")
        await demo.put("skin/demo/nodes/main/status", b"offline", parts="left_hand,palm")
        assert f"{NAME} UNKNOWN" in await program.lines_to_marker(demo)


async def test_nothing_is_known_without_the_broker(mosquitto: Mosquitto) -> None:
    async with running(mosquitto) as program:
        async with robot(mosquitto) as demo:
            await demo.put(f"{HAND}/contact", b"OFF", stamp="5.1")
            await program.lines_to(f"{NAME} OFF")
        mosquitto.kill()
        assert (await program.line()).startswith("no connection to the broker: ")
        assert await program.line() == f"{NAME} UNKNOWN"
        mosquitto.restart()
        await program.lines_to("the broker is there, without what came meanwhile")


async def test_what_is_no_message_of_a_skin_is_passed_over(mosquitto: Mosquitto) -> None:
    async with robot(mosquitto) as demo, running(mosquitto) as program:
        await program.line()
        for topic, payload in {
            f"{HAND}/touch": b"not json",
            f"{HAND}/contact": b"\x1b[2J",
            "skin/demo/\u202egnp/contact": b"ON",
            "skin/demo/head/touch": encode_event(replace(BEGIN, event="\x1b[2J"), 1),
            "skin/demo/arm/touch": b"[]",
            "skin/demo/leg/touch": json.encode({"schema": "skin.touch/2"}),
        }.items():
            await demo.put(topic, payload, stamp="5.x")
        await demo.touch(1)
        lines = await program.lines_to(f"{NAME} begin 7 2.00 N")
        assert all(line.isprintable() for line in lines)


async def test_names_without_end_are_not_kept(mosquitto: Mosquitto) -> None:
    async with robot(mosquitto) as demo, running(mosquitto) as program:
        await demo.touch(1)
        assert f"{NAME} begin 7 2.00 N" in await program.lines_to_marker(demo)
        for number in range(1100):
            await demo.put(f"skin/demo/part{number}/contact", b"OFF", stamp="5.1")
        lines = await program.lines_to_marker(demo)
        assert len({line for line in lines if line.endswith(" OFF")}) == 1000 - 2
        # Of those that it knows nothing is passed over.
        names = "part1099,part1098,left_hand"
        await demo.put(f"{HAND}/contact", b"OFF", stamp="5.2")
        await demo.put("skin/demo/nodes/main/status", b"offline", parts=names)
        lines = await program.lines_to_marker(demo)
        assert [line for line in lines if NAME in line] == [f"{NAME} OFF", f"{NAME} UNKNOWN"]


async def test_a_broker_that_refuses_it_ends_it_with_one_line(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    with Mosquitto(mosquitto.program, tmp_path, "allow_anonymous false\n") as broker:
        process = await asyncio.create_subprocess_exec(
            sys.executable, EXAMPLES / "subscriber.py", str(broker.port), stderr=-1
        )
        async with asyncio.timeout(PATIENCE_S):
            _, errors = await process.communicate()
    assert process.returncode == 1
    assert errors == b"the broker refuses us: Not authorized\n"


async def test_it_ends_quietly_with_ctrl_c(mosquitto: Mosquitto) -> None:
    async with running(mosquitto) as program:
        program.process.send_signal(signal.SIGINT)
        async with asyncio.timeout(PATIENCE_S):
            _, errors = await program.process.communicate()
    assert (program.process.returncode, errors) == (0, b"")


@pytest.mark.parametrize("port", ["many", "70000", ""])
async def test_a_broker_that_cannot_be_is_named_in_one_line(port: str) -> None:
    port = port or str(free_port())
    process = await asyncio.create_subprocess_exec(
        sys.executable, EXAMPLES / "subscriber.py", port, stderr=-1
    )
    _, errors = await process.communicate()
    assert process.returncode == 1
    assert errors.count(b"\n") == 1
    assert port.encode() in errors
