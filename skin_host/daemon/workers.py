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
import logging
import os
import signal
import socket
import sys
from collections.abc import Sequence

from skin_host.clock import SYSTEM
from skin_host.config.settings import LAST_PORT, Settings, changed, parse_triangles
from skin_host.daemon import service
from skin_host.errors import RequestError
from skin_host.processes import kept_from_children

log = logging.getLogger(__name__)

#: Daemons end touches, stop boards and disconnect within this time; systemd waits as long for all.
STOP_S = 4.5
_NOTIFICATION_BYTES = 4096


class Merged:
    """Merges the messages of several daemons to systemd. Pure.

    Args:
        names: of the daemons.

    Attributes:
        unfed: daemons that have not notified the watchdog since it was notified.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._unready = set(names)
        self.unfed = set(names)
        self._status = dict.fromkeys(names, "starting")
        self._is_stopping = False

    def reload(self, message: str, names: Sequence[str]) -> list[str]:
        """Some daemons reload, or are asked to: wait for all of them, although one may be ready
        before another has begun. Return the messages to systemd: this one, unless it waits already.
        """
        messages = [] if self._unready else [message]
        self._unready.update(names)
        return messages

    def take(self, name: str, message: str) -> list[str]:
        """Take a message of a daemon; return the messages to systemd."""
        said = dict(line.partition("=")[::2] for line in message.splitlines())
        told = []
        if "RELOADING" in said:
            told += self.reload(message, [name])
        if said.get("READY") == "1" and name in self._unready:
            self._unready.discard(name)
            if not self._unready:
                told.append("READY=1")
        if said.get("WATCHDOG") == "1":
            self.unfed.discard(name)
            if not self.unfed:
                self.unfed = set(self._names)
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
    asked = asyncio.Event()

    def forward(number: int) -> None:
        for process in processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(number)

    def reload() -> None:
        for message in merged.reload(service.reloading(SYSTEM), list(processes)):
            service.notify(message)
        forward(signal.SIGHUP)

    def abort() -> None:
        """systemd's watchdog was not notified: the log shows where the daemon hangs that is why."""
        for name in merged.unfed & processes.keys():
            with contextlib.suppress(ProcessLookupError):
                processes[name].send_signal(signal.SIGABRT)

    def end(number: int) -> None:
        nonlocal ending
        forward(number if ending is None else signal.SIGKILL)  # a second one ends at once
        ending = number
        asked.set()

    for caught in service.ENDING:
        loop.add_signal_handler(caught, end, caught)
    loop.add_signal_handler(signal.SIGHUP, reload)
    loop.add_signal_handler(signal.SIGABRT, abort)
    with contextlib.ExitStack() as stack:
        for name, arguments in commands.items():
            service.hold_hangups()  # until that daemon can take one
            # Until that daemon takes them.
            with _listen(stack, name, merged) as notified, kept_from_children(*service.ENDING):
                processes[name] = await asyncio.create_subprocess_exec(
                    # -P: this program, and not a folder of its name in the working directory.
                    *(sys.executable, "-P", "-m", "skin_host", *arguments),
                    env=_environment(notified),
                    pass_fds=[notified.fileno()],
                    # Ctrl-C of a terminal reaches only this process, which passes it on once.
                    start_new_session=True,
                )
            if ending is not None:  # it came before this daemon was there
                with contextlib.suppress(ProcessLookupError):
                    processes[name].send_signal(ending)
                break
        service.take_hangups()
        waiting = [asyncio.ensure_future(process.wait()) for process in processes.values()]
        asking = asyncio.create_task(asked.wait())
        await asyncio.wait([*waiting, asking], return_when=asyncio.FIRST_COMPLETED)
        asking.cancel()
        # The first of them has as long as the others have after it.
        await asyncio.wait(waiting, timeout=STOP_S, return_when=asyncio.FIRST_COMPLETED)
        if ending is None:
            for name, process in processes.items():
                number = -(process.returncode or 0)
                if number > 0:
                    hint = " (`journalctl -k` shows whether memory was short)"
                    log.error(
                        "%s: ended by signal %d (%s); all workers end with it%s",
                        *(name, number, signal.strsignal(number)),
                        hint if number == signal.SIGKILL else "",
                    )
            forward(signal.SIGTERM)
        _, left = await asyncio.wait(waiting, timeout=STOP_S)
        if left:
            hung = [name for name, process in processes.items() if process.returncode is None]
            log.error("%s: not ended within %g s; killed", ", ".join(hung), STOP_S)
            forward(signal.SIGKILL)
        statuses = await asyncio.gather(*waiting)
    return max(status if status >= 0 else 1 for status in statuses)


def _listen(stack: contextlib.ExitStack, name: str, merged: Merged) -> socket.socket:
    """Pass on a daemon's messages; return the socket that it is to send them to.

    This has no name: one in a folder of temporary files may be too long, and on others everybody
    could write.
    """
    sock, notified = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    stack.enter_context(sock)
    for one in (sock, notified):
        one.setblocking(False)

    def pass_on() -> None:
        message = sock.recv(_NOTIFICATION_BYTES).decode(errors="replace")
        for told in merged.take(name, message):
            service.notify(told)

    loop = asyncio.get_running_loop()
    loop.add_reader(sock.fileno(), pass_on)
    stack.callback(loop.remove_reader, sock.fileno())
    return notified


def _environment(notified: socket.socket) -> dict[str, str]:
    """Of a daemon; systemd's watchdog time holds for it, whatever its process identifier."""
    not_its = {"NOTIFY_SOCKET", "WATCHDOG_PID"}
    return {
        **{key: value for key, value in os.environ.items() if key not in not_its},
        service.NOTIFIED: str(notified.fileno()),
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
