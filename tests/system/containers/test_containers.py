"""The image and the compose file, run by podman: `tools/lane/image` builds the one.

An emulated robot outside the containers sends by UDP multicast, so the daemon in its container
reads what the host's network brings. What containers do with CAN interfaces is not tested.
"""

import asyncio
import json
import re
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import connect
from websockets.typing import Origin

from tests.support.pages import ROOT
from tests.support.programs import require
from tests.support.subscriber import Subscriber
from tests.support.waiting import until

pytestmark = pytest.mark.timeout(600)

SKIN = Path(sys.executable).parent / "skin"
COMPOSE = Path(sys.executable).parent / "podman-compose"
SERVICES = ("broker", "daemon", "page")
PARTS = {"left_forearm", "left_hand"}


def podman(*arguments: str, check: bool = True) -> "subprocess.CompletedProcess[str]":
    done = subprocess.run(
        [require("podman"), *arguments],
        check=False,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert done.returncode == 0 or not check, done.stdout
    return done


def wait(condition: Callable[[], object]) -> None:
    asyncio.run(until(condition))


def exit_status(container: str) -> int:
    return int(podman("inspect", "--format", "{{.State.ExitCode}}", container).stdout)


class Computer:
    """A robot's computer: its boards on the network, and what the compose file starts."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / "containers/compose.yaml"
        self._file.parent.mkdir()
        self._file.write_text((ROOT / "containers/compose.yaml").read_text())
        text = (ROOT / "config/demo.toml").read_text()
        text = re.sub(r'interface = ".*"', 'interface = "udp_multicast"', text)
        text = re.sub(r'channel = ".*"', 'channel = "239.74.163.16"', text)
        # A busy computer has time for a slower skin.
        text = text.replace('bus = "can0"\naddress', 'bus = "can0"\nperiod_ms = 200\naddress')
        (self._file.parent / "robot.toml").write_text(text)
        self._robot = subprocess.Popen(
            [
                SKIN,
                "emulate",
                self._file.parent / "robot.toml",
                "--scene",
                ROOT / "config/scenes/demo.toml",
            ]
        )

    def compose(self, *arguments: str) -> str:
        """Let podman-compose do it."""
        done = subprocess.run(
            [COMPOSE, "--file", self._file, *arguments],
            check=False,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        assert done.returncode == 0, done.stdout
        return done.stdout

    def up(self) -> Subscriber:
        """Start everything; return somebody on the host who listens, once the daemon is online."""
        self.compose("up", "--no-build", "--detach")
        wait(lambda: "running" in self.log("broker"))
        listener = Subscriber("127.0.0.1", 1883, "skin/demo/#")
        wait(lambda: listener.payloads("main/status")[-1:] == [b"online"])
        return listener

    def log(self, service: str) -> str:
        """What the service has written since it was made."""
        return podman("logs", self.container(service)).stdout

    def container(self, service: str) -> str:
        return f"containers_{service}_1"

    def close(self) -> None:
        """Take everything away, the robot too."""
        self.compose("down", "--volumes")
        self._robot.terminate()
        self._robot.wait()


@pytest.fixture(scope="module")
def computer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Computer]:
    made = Computer(tmp_path_factory.mktemp("computer"))
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def listener(computer: Computer) -> Iterator[Subscriber]:
    """Everything is up, and a program on the host listens."""
    made = computer.up()
    try:
        yield made
    finally:
        made.close()


def calibration(listener: Subscriber) -> Any:
    """The number of the calibration that the node says it has, or None."""
    infos = listener.documents("main/info")
    return infos[-1].get("calibration") if infos else None


def test_the_image_alone_runs_the_demo_as_nobody_and_ends_when_it_is_asked() -> None:
    podman("run", "--detach", "--replace", "--name=demo", "--network=host", "skin-host")
    try:
        wait(lambda: "begin #1" in podman("logs", "demo").stdout)
        assert podman("exec", "demo", "id", "--user").stdout.strip() == "990"
        podman("stop", "--time=10", "demo")
        assert exit_status("demo") == 0
        summary = json.loads(podman("logs", "demo").stdout.strip().splitlines()[-1])
        assert summary["touches_begun"] > 0
    finally:
        podman("rm", "--force", "--volumes", "demo")


def test_a_program_on_the_host_hears_touches(computer: Computer, listener: Subscriber) -> None:
    wait(lambda: {t["event"] for t in listener.documents("/touch")} >= {"begin", "end"})
    assert {t["part"] for t in listener.documents("/touch")} <= PARTS
    for service in ("daemon", "page"):
        running = podman("top", computer.container(service), "user", "capeff").stdout.splitlines()
        assert [line.split() for line in running[1:]] == [["skin", "none"]]


def test_the_daemon_is_healthy_as_long_as_its_skin_is(
    computer: Computer, listener: Subscriber
) -> None:
    daemon = computer.container("daemon")
    wait(lambda: {d["part"] for d in listener.documents("/health")} == PARTS)
    command = json.loads(
        podman("inspect", "--format", "{{json .Config.Healthcheck.Test}}", daemon).stdout
    )
    assert command.pop(0) == "CMD"
    told = podman("exec", daemon, *command, "--json", check=False)
    # On a busy computer boards send irregularly, and then the skin is not well.
    states = set(re.findall(r'"state": ?"(\w+)"', told.stdout))
    assert all(part in told.stdout for part in PARTS)
    assert (told.returncode == 0) == (states <= {"ok", "warning"}), told.stdout
    computer.compose("stop", "broker")
    assert podman("healthcheck", "run", daemon, check=False).returncode == 1


def test_the_page_shows_itself_and_keeps_what_it_records(
    computer: Computer, listener: Subscriber
) -> None:
    with urllib.request.urlopen("http://127.0.0.1:8080/") as answer:
        page = answer.read().decode()
    assert "<html" in page

    async def record() -> None:
        async with connect(
            "ws://127.0.0.1:8080/live", origin=Origin("http://127.0.0.1:8080"), max_size=None
        ) as socket:

            async def received(**wanted: object) -> dict[str, Any]:
                async for data in socket:
                    message = json.loads(data) if isinstance(data, str) else {}
                    if wanted.items() <= message.items():
                        return dict(message)
                raise AssertionError("the page's server closed the connection")

            # It was started with the broker, and finds it some seconds later.
            await received(type="status", connected=True)
            for wish in ("record", "stop"):
                await socket.send(json.dumps({"do": wish}))
                answer = await received(type="answer")
                assert answer["ok"], answer

    asyncio.run(record())
    kept = podman("exec", computer.container("daemon"), "ls", "recordings").stdout
    assert kept.strip().endswith(".mcap")


def test_what_is_stopped_ends_by_itself_and_what_is_made_again_has_its_calibration(
    computer: Computer, listener: Subscriber
) -> None:
    wait(lambda: calibration(listener))
    known = calibration(listener)
    computer.compose("stop", "daemon")
    wait(lambda: listener.payloads("main/status")[-1] == b"offline")
    computer.compose("stop")  # kills what has not ended after 10 s, which is no status of 0
    assert {name: exit_status(computer.container(name)) for name in SERVICES} == dict.fromkeys(
        SERVICES, 0
    )
    computer.compose("down")
    again = computer.up()
    wait(lambda: calibration(again))
    assert calibration(again) == known
    assert "calibrating for" not in computer.log("daemon")
    again.close()
