"""A real mosquitto that a test can start, freeze, kill and bring back."""

import asyncio
import contextlib
import random
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

_START_S = 30.0
#: Ports that no client of anybody's is given, so that one stays free while its broker is away.
_PORTS = range(10_000, 32_768)
#: What the broker writes down: the usual, and who subscribes to what.
_LOGGED = ("error", "warning", "notice", "information", "subscribe")


def free_port() -> int:
    """Return a TCP port of 127.0.0.1 that nobody listens on."""
    while True:
        port = random.choice(_PORTS)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


class Mosquitto:
    """One broker on its own port of 127.0.0.1, open to everybody, remembering nothing; it runs in a
    block of `with`, or between `start` and `kill`.

    The port stays the same over `restart`, so that clients can find it again.
    """

    host = "127.0.0.1"

    def __init__(self, program: str, directory: Path, settings: str = "") -> None:
        """Prepare a broker; `settings` are further lines of mosquitto.conf."""
        self.port = free_port()
        self.program = program
        self._log = directory / "mosquitto.log"
        self._configuration = directory / "mosquitto.conf"
        self._configuration.write_text(
            f"listener {self.port} {self.host}\n"
            f"allow_anonymous true\npersistence false\nlog_dest stderr\n"
            + "".join(f"log_type {kind}\n" for kind in _LOGGED)
            + settings
        )
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def log(self) -> str:
        """What the broker has written so far."""
        return self._log.read_text(errors="replace")

    def subscriptions(self, topic: str) -> int:
        """How many times somebody has subscribed to exactly this topic so far."""
        return self.log.count(f" {topic}\n") if self._log.exists() else 0

    def start(self) -> None:
        """Start the broker and wait until it accepts connections."""
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [self.program, "-c", self._configuration], stdout=log, stderr=log
            )
        deadline = time.monotonic() + _START_S
        while self._process.poll() is None and time.monotonic() < deadline:
            with contextlib.suppress(OSError):
                socket.create_connection((self.host, self.port), timeout=1.0).close()
                return
            time.sleep(0.005)
        self.kill()
        raise RuntimeError(f"mosquitto did not start:\n{self.log}")

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def stop(self) -> None:
        """End the broker as its service would: clients are told."""
        self._end(signal.SIGTERM)

    def kill(self) -> None:
        """End the broker at once, as a loss of power would. Nothing happens if it has ended."""
        self._end(signal.SIGKILL)

    def freeze(self) -> None:
        """Stop the broker in its tracks; its connections stay open and silent."""
        self._running.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Let a frozen broker go on."""
        self._running.send_signal(signal.SIGCONT)

    def restart(self) -> None:
        """Kill the broker if it runs, and start it on the same port."""
        self.kill()
        self.start()

    @property
    def _running(self) -> "subprocess.Popen[bytes]":
        if self._process is None:
            raise RuntimeError("the broker does not run")
        return self._process

    def _end(self, how: signal.Signals) -> None:
        if self._process is not None:
            self._process.send_signal(how)
            self._process.wait(timeout=_START_S)
            self._process = None


async def break_at_random(broker: Mosquitto, chance: random.Random) -> None:
    """Kill, stop, restart and freeze the broker until cancelled; it runs in the end."""
    while True:
        await asyncio.sleep(chance.uniform(0.2, 2.0))
        match chance.choice(["restart", "kill", "freeze", "stop"]):
            case "restart":
                await _whole(broker.restart)
            case "kill" | "stop" as how:
                try:
                    await _whole(broker.kill if how == "kill" else broker.stop)
                    await asyncio.sleep(chance.uniform(0.1, 2.0))
                finally:
                    broker.start()
            case "freeze":
                broker.freeze()
                try:
                    await asyncio.sleep(chance.uniform(0.1, 5.0))
                finally:
                    broker.resume()


async def _whole(step: Callable[[], None]) -> None:
    """Run a step in a thread; it has ended when this has, also where this is cancelled."""
    step_done = asyncio.ensure_future(asyncio.to_thread(step))
    try:
        await asyncio.shield(step_done)
    finally:
        await asyncio.wait([step_done])
