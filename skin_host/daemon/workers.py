"""`skin run --workers N`: one daemon for each share of a node, started by this process.

For systemd they are one service: it is ready when all are, its watchdog is notified when each
daemon has notified, and it ends with the first that ends. Each daemon gets a separate notify socket
here, instead of systemd's.

The node's buses are shared out among them, and what shares a bus stays together: parts with a board
on it, and fingertips. So does a fingertip with the part that covers it. Each share has parts; it is
a node of its own, named after the one that is shared: `main-1`, `main-2`, ... Together they make
one robot, because topics of parts do not show the node.
"""

import asyncio
import contextlib
import os
import signal
import socket
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from skin_host.config.settings import LAST_PORT, Settings, changed, parse_triangles
from skin_host.daemon import service
from skin_host.errors import RequestError
from skin_host.processes import kept_from_children

#: Daemons end touches, stop boards and disconnect within this time; systemd waits as long for all.
STOP_S = 4.5
_NOTIFICATION_BYTES = 4096


class Merged:
    """Merges the messages of several daemons to systemd. Pure.

    Args:
        names: of the daemons.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._unready = set(names)
        self._unfed = set(names)
        self._status = dict.fromkeys(names, "starting")
        self._is_stopping = False

    def take(self, name: str, message: str) -> list[str]:
        """Take a message of a daemon; return the messages to systemd."""
        said = dict(line.partition("=")[::2] for line in message.splitlines())
        told = []
        if "RELOADING" in said:
            if not self._unready:
                told.append(message)
            self._unready.add(name)
        if said.get("READY") == "1" and name in self._unready:
            self._unready.discard(name)
            if not self._unready:
                told.append("READY=1")
        if said.get("WATCHDOG") == "1":
            self._unfed.discard(name)
            if not self._unfed:
                self._unfed = set(self._names)
                told.append("WATCHDOG=1")
        if "STATUS" in said:
            self._status[name] = said["STATUS"]
            told.append("STATUS=" + "; ".join(f"{one}: {self._status[one]}" for one in self._names))
        if said.get("STOPPING") == "1" and not self._is_stopping:
            self._is_stopping = True
            told.append("STOPPING=1")
        return told


async def run(commands: dict[str, list[str]]) -> int:
    """Run daemons until a signal comes or one of them ends; return the worst exit status.

    Args:
        commands: arguments of `skin` by the name of the daemon.
    """
    loop = asyncio.get_running_loop()
    merged = Merged(list(commands))
    processes: dict[str, asyncio.subprocess.Process] = {}

    ending: int | None = None  # the signal that asked for it

    def forward(number: int) -> None:
        for process in processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(number)

    def end(number: int) -> None:
        nonlocal ending
        forward(number if ending is None else signal.SIGKILL)  # a second one ends at once
        ending = number

    for caught in service.ENDING:
        loop.add_signal_handler(caught, end, caught)
    loop.add_signal_handler(signal.SIGHUP, forward, signal.SIGHUP)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="skin-run-")))
        for number, (name, arguments) in enumerate(commands.items()):
            path = folder / str(number)
            _listen(stack, path, name, merged)
            service.hold_hangups()  # until that daemon can take one
            with kept_from_children(*service.ENDING):  # until that daemon takes them
                processes[name] = await asyncio.create_subprocess_exec(
                    # -P: this program, and not a folder of its name in the working directory.
                    *(sys.executable, "-P", "-m", "skin_host", *arguments),
                    env=_environment(path),
                    # Ctrl-C of a terminal reaches only this process, which passes it on once.
                    start_new_session=True,
                )
            if ending is not None:  # it came before this daemon was there
                with contextlib.suppress(ProcessLookupError):
                    processes[name].send_signal(ending)
                break
        service.take_hangups()
        waiting = [asyncio.ensure_future(process.wait()) for process in processes.values()]
        await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
        if ending is None:
            forward(signal.SIGTERM)
        _, left = await asyncio.wait(waiting, timeout=STOP_S)
        if left:
            forward(signal.SIGKILL)
        statuses = await asyncio.gather(*waiting)
    return max(status if status >= 0 else 1 for status in statuses)


def _listen(stack: contextlib.ExitStack, path: Path, name: str, merged: Merged) -> None:
    """Pass on a daemon's messages from the socket at `path`."""
    sock = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
    sock.setblocking(False)
    sock.bind(str(path))

    def pass_on() -> None:
        message = sock.recv(_NOTIFICATION_BYTES).decode(errors="replace")
        for told in merged.take(name, message):
            service.notify(told)

    loop = asyncio.get_running_loop()
    loop.add_reader(sock.fileno(), pass_on)
    stack.callback(loop.remove_reader, sock.fileno())


def _environment(notify_socket: Path) -> dict[str, str]:
    """Of a daemon; systemd's watchdog time holds for it, whatever its process identifier."""
    return {
        **{key: value for key, value in os.environ.items() if key != "WATCHDOG_PID"},
        "NOTIFY_SOCKET": str(notify_socket),
    }


def share_out(settings: Settings, node: str, n: int) -> list[frozenset[str]]:
    """The buses of each share, as even as may be by triangles; no share is without parts.

    Args:
        settings: of the robot.
        node: that is shared.
        n: shares wanted; there are fewer where too many parts share buses.
    """
    bus_of = {name: board.bus for name, board in settings.boards.items()}
    weights: dict[frozenset[str], int] = {}
    for part in settings.parts.values():
        if part.node == node:
            buses = frozenset(bus_of[patch.board] for patch in part.patches)
            triangles = sum(len(parse_triangles(patch.triangles)) for patch in part.patches)
            _join(weights, buses, triangles)
    of_parts = frozenset().union(*weights)
    for tip in settings.fingertips.values():
        if tip.node == node:
            covering = settings.parts[tip.array].patches if tip.array is not None else ()
            _join(weights, frozenset([tip.bus, *(bus_of[patch.board] for patch in covering)]), 1)
    n = min(n, sum(bool(buses & of_parts) for buses in weights))
    if not n:
        return []
    shares: list[tuple[int, frozenset[str]]] = [(0, frozenset())] * n
    # The largest first, each to the smallest share; fingertips alone when each share has parts.
    for buses in sorted(weights, key=lambda one: (not one & of_parts, -weights[one], sorted(one))):
        smallest = min(range(len(shares)), key=lambda number: shares[number][0])
        weight, others = shares[smallest]
        shares[smallest] = weight + weights[buses], others | buses
    return [buses for _, buses in shares]


def share_of(settings: Settings, node: str, number: int, n: int) -> Settings:
    """Settings in which one share of a node is the node `share_name(node, number)`.

    Args:
        settings: of the robot.
        node: that is shared.
        number: of the share, from 1.
        n: shares wanted, see `share_out`.

    Raises:
        RequestError: there are fewer, or not so many ports for their metrics.
    """
    shares = share_out(settings, node, n)
    if number > len(shares):
        raise RequestError(
            f'node "{node}": seen share {number} of {n}, wanted one of the {len(shares)} that its '
            "parts can be shared out to; start it again"
        )
    buses = shares[number - 1]
    values: dict[str, object] = {}
    for name, part in settings.parts.items():
        if part.node == node and settings.boards[part.patches[0].board].bus in buses:
            values[f"parts.{name}.node"] = share_name(node, number)
    for name, tip in settings.fingertips.items():
        if tip.node == node and tip.bus in buses:
            values[f"fingertips.{name}.node"] = share_name(node, number)
    port = settings.service.metrics_port
    if port:
        if port + len(shares) - 1 > LAST_PORT:
            raise RequestError(
                f"service.metrics_port: seen {port}, wanted at most {LAST_PORT + 1 - len(shares)}: "
                f"{len(shares)} workers serve this port and those after it"
            )
        values["service.metrics_port"] = port + number - 1
    return changed(settings, values)


def share_name(node: str, number: int) -> str:
    return f"{node}-{number}"


def _join(weights: dict[frozenset[str], int], buses: frozenset[str], triangles: int) -> None:
    """Add what lies on some buses to what lies on any of them."""
    for others in [others for others in weights if others & buses]:
        triangles += weights.pop(others)
        buses |= others
    weights[buses] = triangles
