"""systemd's watchdog, and the memory of a process, as a test sees them."""

import os
import socket
import threading
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest


class Watchdog:
    """What systemd would see: when the daemon says that it works, in its own computing time."""

    def __init__(self, path: Path) -> None:
        self.pid: int | None = None
        self.fed_s: list[float] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        # `shutdown` ends the wait with an empty datagram.
        while said := self._socket.recv(4096):
            if b"WATCHDOG=1" in said:
                self.fed_s.append(computed_s(self.pid))

    def close(self) -> None:
        """Stop listening."""
        self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()

    def longest_gap_s(self, since_s: float) -> float:
        now_s = computed_s(self.pid)
        times_s = [since_s, *(at_s for at_s in self.fed_s if at_s >= since_s), now_s]
        return max(b - a for a, b in pairwise(times_s))


def computed_s(pid: int | None) -> float:
    """Processor time of a process so far, 0 before it is known."""
    if pid is None:
        return 0.0
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.fixture
def watchdog(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Watchdog]:
    path = tmp_path / "notify"
    made = Watchdog(path)
    monkeypatch.setenv("NOTIFY_SOCKET", str(path))
    monkeypatch.setenv("WATCHDOG_USEC", "400000")
    yield made
    made.close()


def memory_kb(pid: int) -> int:
    status = Path(f"/proc/{pid}/status").read_text()
    (line,) = [line for line in status.splitlines() if line.startswith("VmRSS")]
    return int(line.split()[1])
