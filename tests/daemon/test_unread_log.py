"""The reader of the daemon's log stops: a pager, or a journal that hangs."""

import asyncio
import contextlib
import fcntl
import os
import re
import signal
import socket
import sys
import urllib.request
from collections.abc import AsyncIterator
from pathlib import Path

from tests.daemon.test_workers import body
from tests.support.broker import free_port
from tests.support.waiting import PATIENCE_S

#: `skin` with little room for lines that wait for their reader.
SKIN = "from skin_host import cli; cli.stderr.LIMIT_BYTES = 500; raise SystemExit(cli.main())"
LOST = r"WARNING (\d+) lines of the log were lost"


class Service:
    """`skin run` as systemd sees it, with its log in a pipe of one page that is full of dots."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.metrics_port = free_port()
        self.reader, self.writer = os.pipe()
        fcntl.fcntl(self.writer, fcntl.F_SETPIPE_SZ, 4096)
        os.set_blocking(self.writer, False)
        self._dots = os.write(self.writer, b"." * 10_000)
        os.set_blocking(self.writer, True)
        self._systemd = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._systemd.bind(str(folder / "notify"))
        self._systemd.settimeout(PATIENCE_S)
        self._said = b""

    async def start(self, *options: str) -> None:
        config = body(self._folder / "body.toml", [("a", [0]), ("b", [1])], free_port())
        metrics = f"[service]\nmetrics_port = {self.metrics_port}"
        config.write_text(config.read_text().replace("[service]", metrics))
        self.process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", SKIN, "run", str(config), *options),
            env=os.environ
            | {"NOTIFY_SOCKET": str(self._folder / "notify"), "WATCHDOG_USEC": "400000"},
            stderr=self.writer,
        )
        os.close(self.writer)

    async def until(self, message: str, n: int = 1) -> None:
        """Wait until systemd got this message, again and again."""
        for _ in range(n):
            while await asyncio.to_thread(self._systemd.recv, 4096) != message.encode():
                pass

    async def reload(self, n: int) -> None:
        """Have it read its configuration again, which it logs."""
        for _ in range(n):
            self.process.send_signal(signal.SIGHUP)
            await self.until("READY=1")

    async def end(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return await asyncio.wait_for(self.process.wait(), PATIENCE_S)

    async def metrics(self) -> str:
        def get() -> str:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.metrics_port}/metrics") as page:
                text: str = page.read().decode()
                return text

        return await asyncio.to_thread(get)

    async def read(self, wanted: str = r"\Z.") -> list[str]:
        """Read the log until it has this expression, or to its end; return its lines so far."""
        while not re.search(wanted, self._text()):
            some = await asyncio.to_thread(os.read, self.reader, 65536)
            if not some:
                break
            self._said += some
        return self._text().splitlines()

    def _text(self) -> str:
        return self._said[self._dots :].decode()

    def close(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()
        os.close(self.reader)
        self._systemd.close()


@contextlib.asynccontextmanager
async def serving(folder: Path, *options: str) -> AsyncIterator[Service]:
    service = Service(folder)
    await service.start(*options)
    try:
        yield service
    finally:
        service.close()
        await service.process.wait()


async def test_a_daemon_whose_log_nobody_reads_works_and_ends(tmp_path: Path) -> None:
    async with serving(tmp_path) as service:
        await service.until("READY=1")
        await service.reload(3)
        await service.until("WATCHDOG=1", 3)
        assert await service.end() == 0


async def test_workers_whose_log_nobody_reads_work_and_end(tmp_path: Path) -> None:
    async with serving(tmp_path, "--workers", "2") as service:
        await service.until("READY=1")
        await service.reload(2)
        await service.until("WATCHDOG=1", 3)
        assert await service.end() == 0


async def test_lines_that_nobody_read_are_counted_where_they_are_missing(tmp_path: Path) -> None:
    async with serving(tmp_path) as service:
        await service.until("READY=1")
        await service.reload(12)
        found = re.search(r"^skin_log_lines_lost_total (\d+)", await service.metrics(), re.M)
        assert found is not None
        lost = int(found[1])
        assert lost > 0
        lines = await service.read(LOST)
        note = next(i for i, line in enumerate(lines) if re.match(LOST, line))
        await service.reload(1)
        assert await service.end() == 0
        lines = await service.read()
        assert int(re.match(LOST, lines[note])[1]) >= lost
        assert not [line for line in lines[note + 1 :] if re.match(LOST, line)]
        assert lines[0].startswith("WARNING bus can0: interface")
        assert any("body.toml read again" in line for line in lines[note + 1 :])
