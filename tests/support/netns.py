"""Two computers, each its own network namespace, and the cable between them. Needs root."""

import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.support.programs import require

ROOT = Path(__file__).parents[2]
HERE, THERE = "skin-a", "skin-b"
HERE_ADDRESS, THERE_ADDRESS = "10.77.0.1", "10.77.0.2"


def ip(*arguments: str) -> None:
    subprocess.run([require("ip"), *arguments], check=True, capture_output=True)


@contextmanager
def two_computers() -> Iterator[None]:
    """Namespaces skin-a (10.77.0.1) and skin-b (10.77.0.2), joined by a veth pair."""
    with ExitStack() as stack:
        for name in (HERE, THERE):
            try:
                ip("netns", "add", name)
            except subprocess.CalledProcessError as error:
                pytest.skip(f"no network namespaces here: {error.stderr.decode().strip()}")
            stack.callback(ip, "netns", "del", name)
            ip("-n", name, "link", "set", "lo", "up")
        ip(
            "link",
            "add",
            "skin-va",
            "netns",
            HERE,
            "type",
            "veth",
            "peer",
            "name",
            "skin-vb",
            "netns",
            THERE,
        )
        ip("-n", HERE, "addr", "add", f"{HERE_ADDRESS}/24", "dev", "skin-va")
        ip("-n", THERE, "addr", "add", f"{THERE_ADDRESS}/24", "dev", "skin-vb")
        ip("-n", HERE, "link", "set", "skin-va", "up")
        cable(up=True)
        yield


def cable(*, up: bool) -> None:
    """Plug or unplug at the far end: the near one only loses its carrier."""
    ip("-n", THERE, "link", "set", "skin-vb", "up" if up else "down")


class Process:
    """A program in a namespace, its output in a file."""

    def __init__(self, stack: ExitStack, namespace: str, output: Path, *command: str) -> None:
        self.output = output
        with output.open("wb") as file:
            process = subprocess.Popen(
                [require("ip"), "netns", "exec", namespace, *command],
                stdout=file,
                stderr=subprocess.STDOUT,
                cwd=ROOT,
            )
        stack.callback(process.wait)
        stack.callback(process.terminate)

    def lines(self) -> list[str]:
        return self.output.read_text(errors="replace").splitlines()

    def wait_for(self, text: str, limit_s: float, since: int = 0) -> float:
        began_s = time.monotonic()
        while time.monotonic() - began_s < limit_s:
            if any(text in line for line in self.lines()[since:]):
                return time.monotonic() - began_s
            time.sleep(0.05)
        raise AssertionError(f"no {text!r} within {limit_s} s: {self.lines()[-5:]}")
