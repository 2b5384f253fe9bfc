"""A whole stack: emulated robot, `skin` commands and a real broker, as processes."""

import contextlib
import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from skin_host.config.settings import Bus
from tests.support.broker import Mosquitto
from tests.support.subscriber import Subscriber

ROOT = Path(__file__).parents[2]
#: The lane's emulated processor is slow; here this is never waited for.
WAIT_S = 200.0


class Stack:
    """Starts and stops the processes of one test, and knows their files."""

    def __init__(
        self,
        directory: Path,
        bus: Bus,
        bus_kind: str,
        broker: Mosquitto,
        configuration: str,
    ) -> None:
        self.directory = directory
        self.bus = bus
        self.kind = bus_kind
        self.broker = broker
        self.state = directory / "state"
        self.config = directory / "robot.toml"
        text = (ROOT / f"config/{configuration}.toml").read_text()
        text = re.sub(r'interface = ".*"', f'interface = "{bus.interface}"', text)
        text = re.sub(r'channel = ".*"', f'channel = "{bus.channel}"', text)
        if bus_kind == "vcan":
            # The lane's processor is emulated; a slower skin leaves it time.
            text = text.replace('bus = "can0"\naddress', 'bus = "can0"\nperiod_ms = 200\naddress')
            # So rarely sampled, a slip shows by the share of a known friction alone.
            text = text.replace("period_ms = 10 ", "period_ms = 25 ")
            text = text.replace("period_ms = 3 ", "friction = 0.5\nperiod_ms = 25 ")
        text += f"\n[mqtt]\nhost = '127.0.0.1'\nport = {broker.port}\n"
        text += f"\n[service]\nstate_directory = '{self.state}'\n"
        self.config.write_text(text)
        self._processes: list[subprocess.Popen[str]] = []
        self._said: list[Path] = []
        #: How long a calibration took, with its programs' start, where that is slow.
        self._calibrated_s = 0.0

    def start(self, *command: str, scene: Path | None = None) -> "subprocess.Popen[str]":
        """Start `skin COMMAND...` with a robot on its bus."""
        robot = [str(self.config), str(self._scene(scene))]
        if self.kind == "virtual":
            program = [sys.executable, "-m", "tests.support.one_process", *robot, "--"]
        else:
            emulate = [sys.executable, "-m", "skin_host", "emulate", robot[0], "--scene", robot[1]]
            self._await_robot(self._spawn(emulate))
            program = [sys.executable, "-m", "skin_host"]
        return self._spawn([*program, *command])

    def _scene(self, scene: Path | None) -> Path:
        """The same scene with quiet pads: the robot that was calibrated is the one that runs.

        Nothing is touched until a slow daemon has set the boards up, which it does sooner than a
        calibration takes.
        """
        text = scene.read_text() if scene else ""
        text = re.sub(
            r"(?m)^start_s = (\S+)",
            lambda found: f"start_s = {float(found[1]) + self._calibrated_s}",
            text,
        )
        # Offsets of boards are drawn: another seed would be another robot.
        text = re.sub(r"(?m)^(seed|quiet) = .*\n", "", text)
        path = self.directory / (scene.name if scene else "untouched.toml")
        path.write_text(f"quiet = true\n{text}")
        return path

    def _spawn(self, command: list[str]) -> "subprocess.Popen[str]":
        said = self.directory / f"{len(self._said)}.log"
        with said.open("w") as log:
            process = subprocess.Popen(
                command, cwd=ROOT, stdout=subprocess.PIPE, stderr=log, text=True
            )
        self._processes.append(process)
        self._said.append(said)
        return process

    def _await_robot(self, process: "subprocess.Popen[str]") -> None:
        """A robot is switched on before its host; the other order has a test of its own."""
        said = self._said[-1]
        deadline = time.monotonic() + WAIT_S
        while "is emulated on" not in said.read_text():
            assert process.poll() is None, said.read_text()
            assert time.monotonic() < deadline, said.read_text()
            time.sleep(0.1)

    def calibrate(self, *extra: str) -> Any:
        """Calibrate an untouched robot; return what the command says as JSON."""
        seconds = "1" if self.kind == "virtual" else "8"
        began_s = time.monotonic()
        process = self.start("calibrate", str(self.config), "--seconds", seconds, "--json", *extra)
        out, _ = process.communicate(timeout=WAIT_S)
        assert process.returncode == 0, self._said[-1].read_text()
        if self.kind == "vcan":
            self._calibrated_s = time.monotonic() - began_s
        self.stop()
        return json.loads(out)

    def stop(self) -> list[int]:
        """Send SIGTERM to everything that still runs; return all exit statuses."""
        for process in self._processes:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        statuses = []
        for process in self._processes:
            try:
                process.communicate(timeout=WAIT_S)
            except ValueError:
                process.wait(timeout=WAIT_S)
            statuses.append(process.returncode)
        self._processes.clear()
        return statuses

    def kill(self) -> None:
        """End everything at once, as a loss of power would; show what it had said."""
        for process in self._processes:
            process.kill()
            with contextlib.suppress(ValueError):  # its pipes are closed already
                process.communicate()
        for said in self._said:
            sys.stdout.write(said.read_text())
        self._processes.clear()


@pytest.fixture
def configuration() -> str:
    """Of `config/`, without its ending; its robot has the same name. Tests may choose another."""
    return "demo"


@pytest.fixture
def stack(
    tmp_path: Path, can_bus_settings: Bus, bus_kind: str, mosquitto: Mosquitto, configuration: str
) -> Iterator[Stack]:
    made = Stack(tmp_path, can_bus_settings, bus_kind, mosquitto, configuration)
    yield made
    made.kill()


@pytest.fixture
def subscriber(mosquitto: Mosquitto, configuration: str) -> Iterator[Subscriber]:
    listening = Subscriber(mosquitto.host, mosquitto.port, f"skin/{configuration}/#")
    yield listening
    listening.close()


def wait_for(
    condition: Callable[[], Any], what: str, seen: Callable[[], object] = lambda: "nothing"
) -> Any:
    """Wait until `condition` gives something true, and return that; else say what was seen."""
    deadline = time.monotonic() + WAIT_S
    while time.monotonic() < deadline:
        found = condition()
        if found:
            return found
        time.sleep(0.2)
    raise AssertionError(f"waited {WAIT_S:g} s for {what}; seen: {seen()}")
