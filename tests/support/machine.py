"""A Debian with systemd as its first process, booted by the lane, that takes commands."""

import contextlib
import json
import os
import select
import shlex
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
LANE = ROOT / "tools/lane"
BOOT_S = {"uml": 300.0, "qemu": 400.0}
#: A command's answer may come this much later than the end of its time.
GRACE_S = 30.0
#: An answer that nobody waited for is waited for this long before the next command.
LATE_S = 600.0


@dataclass(frozen=True)
class Done:
    """How a command in the machine ended, with both its outputs."""

    status: int
    output: str


class MachineEndedError(AssertionError):
    """The machine's process has ended."""


class Machine:
    """One booted machine; `close` ends it.

    Args:
        kind: "uml", at the speed of this computer, or "qemu", with other hardware and slowly.
        folder: for its console and what it writes to its disk.
        options: more of the machine's own options.
    """

    def __init__(self, kind: str, folder: Path, *options: str) -> None:
        subprocess.run([LANE / "debian"], check=True)
        self._kind = kind
        self._folder = folder
        self._options = options
        self._console = folder / "console"
        self._switch_on()

    def _switch_on(self) -> None:
        self._unread = b""
        self._unanswered = False
        self._process = subprocess.Popen(
            [LANE / "boot", self._kind, self._folder, *self._options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        try:
            self._answer(BOOT_S[self._kind])
        except AssertionError:
            self.close()
            raise

    def close(self) -> None:
        """Pull the plug."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.communicate()

    def run(self, command: str, timeout_s: float = 180.0) -> Done:
        """Run a line of bash as root; return how it ended."""
        self._send({"command": command, "timeout_s": timeout_s})
        return Done(**self._answer(timeout_s + GRACE_S))

    def do(self, command: str, timeout_s: float = 180.0) -> str:
        """The same, of a command that has to succeed; return what it wrote."""
        done = self.run(command, timeout_s)
        assert done.status == 0, f"$ {command}\n{done.output}\nended with {done.status}"
        return done.output.strip()

    def write(self, path: str, text: str, mode: str = "644") -> None:
        """Write a file, and the folders above it."""
        quoted = shlex.quote(path)
        self.do(f"install -D -m {mode} /dev/stdin {quoted} <<'END'\n{text}\nEND")

    def reboot(self) -> None:
        """Restart it; return when it takes commands again.

        User-mode Linux may end instead, on a busy computer: then it is switched on again, with
        the same disk.
        """
        self._send({"command": "systemctl reboot", "timeout_s": 60.0})
        try:
            while "booted" not in self._answer(BOOT_S[self._kind]):
                pass
        except MachineEndedError:
            self.close()
            self._switch_on()

    def until(self, true: Callable[[], bool], what: str, patience_s: float = 180.0) -> None:
        """Wait until something is so."""
        end_s = time.monotonic() + patience_s
        while not true():
            assert time.monotonic() < end_s, f"after {patience_s:g} s: {what}\n{self.failed()}"
            time.sleep(0.5)

    def failed(self) -> str:
        """The end of the journal, for whoever reads that a test has failed."""
        return self.run("journalctl --no-pager -o short-monotonic -n 60").output

    def _send(self, request: dict[str, Any]) -> None:
        if self._unanswered:
            # A test whose time was up left before its answer came, which is not that of this one.
            self._answer(LATE_S)
        assert self._process.stdin is not None
        self._unanswered = True
        self._process.stdin.write(json.dumps(request).encode() + b"\n")
        self._process.stdin.flush()

    def _answer(self, timeout_s: float) -> dict[str, Any]:
        assert self._process.stdout is not None
        end_s = time.monotonic() + timeout_s
        while b"\n" not in self._unread:
            left_s = end_s - time.monotonic()
            if left_s < 0 or not select.select([self._process.stdout], [], [], left_s)[0]:
                raise AssertionError(f"no answer in {timeout_s:g} s\n{self._last_words()}")
            some = os.read(self._process.stdout.fileno(), 65536)
            if not some:
                raise MachineEndedError(f"the machine has ended\n{self._last_words()}")
            self._unread += some
        line, _, self._unread = self._unread.partition(b"\n")
        answer: dict[str, Any] = json.loads(line)
        self._unanswered = False
        return answer

    def _last_words(self) -> str:
        try:
            return self._console.read_text(errors="replace")[-3000:]
        except OSError:
            return ""


def now(machine: Machine) -> str:
    """The time, as journalctl takes it. (Its `--after-cursor` leaves out the first match.)"""
    return machine.do("date +@%s.%6N")
