"""Commands that subscribe: listen, status, view."""

import argparse
import contextlib
import shutil
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from skin_host.cli.common import (
    Commands,
    add_broker,
    add_command,
    add_log_level,
    count,
    filled,
    port_number,
    print_json,
    run,
    set_up_logging,
    visible_json,
    warn,
)
from skin_host.cli.options import add_rules
from skin_host.errors import visible

if TYPE_CHECKING:
    from skin_host.client import SkinClient

#: `skin status` looks for the broker for this long; a reachable one answers at once.
PATIENCE_S = 1.5
#: Health comes once a second. A part of which none comes for this long is not received; a computer
#: that has much to do may send it late.
LIVE_S = 5.0
#: Until then it is not known whether a robot lives of which the broker has stored something.
SETTLED_S = 2.5
PAGE_PORT = 8080
_INDENT = " " * 4


def add_commands(commands: Commands) -> None:
    """Add the commands of this module to the parser."""
    listen = add_command(
        commands,
        "listen",
        "print touches and slips as they come",
        "skin listen --part left_hand --broker mqtt://robot.local",
    )
    add_broker(listen)
    listen.add_argument("--part", type=filled, help="only this part")
    listen.add_argument("--moves", action="store_true", help="also while a touch goes on")
    listen.add_argument("--json", action="store_true", help="one JSON document a line")
    listen.add_argument("--count", type=count, metavar="N", help="end after N lines")
    listen.set_defaults(run=_listen)

    status = add_command(
        commands,
        "status",
        "show how every part is; exit status 1 unless each is ok or has a warning",
        "skin status --json",
    )
    add_broker(status)
    status.add_argument("--json", action="store_true", help="one JSON document")
    status.set_defaults(run=_status)

    view = add_command(
        commands,
        "view",
        "serve the live page, or Foxglove, or show it in Rerun",
        "skin view --port 8080",
    )
    add_broker(view)
    viewers = view.add_mutually_exclusive_group()
    viewers.add_argument(
        "--foxglove", action="store_true", help="serve Foxglove instead (extra `foxglove`)"
    )
    viewers.add_argument(
        "--rerun", action="store_true", help="serve Rerun's viewer instead (extra `rerun`)"
    )
    # An empty one, as of a variable of the shell that is not set, would be every address.
    view.add_argument("--host", type=filled, default="127.0.0.1", help="address to listen on")
    view.add_argument(
        "--port", type=port_number, help="port to listen on (8080; Foxglove 8765, Rerun 9090)"
    )
    view.add_argument(
        "--name",
        type=filled,
        action="append",
        default=[],
        help="the page: another name of this machine, such as that of a proxy",
    )
    view.add_argument("--read-only", action="store_true", help="pages calibrate and record nothing")
    view.add_argument(
        "--recordings",
        type=Path,
        default=Path("recordings"),
        metavar="FOLDER",
        help="for what is recorded from the page",
    )
    others = ["--foxglove", "--rerun"]
    add_rules(view, idle_with={"--name": others, "--read-only": others, "--recordings": others})
    add_log_level(view)
    view.set_defaults(run=_view)


def _listen(arguments: argparse.Namespace) -> int:
    import asyncio

    from skin_host.cli.lines import event_line, missed_line
    from skin_host.client import SkinClient
    from skin_host.tasks import cancel

    async def work() -> None:
        printed = 0
        async with contextlib.AsyncExitStack() as stack:
            skin = SkinClient(arguments.broker, robot=arguments.robot)
            # Events come only while something touches; health comes always.
            followed = skin.contacts()
            watching = asyncio.create_task(_report_absence(skin))
            stack.push_async_callback(cancel, watching)
            await stack.enter_async_context(skin)
            async for event in skin.events(arguments.part):
                if event.missed:
                    print(missed_line(event, as_json=arguments.json), flush=True)
                if event.event == "move" and not arguments.moves:
                    continue
                if arguments.json:
                    # Its schema too, and what is published only where it is not None or 0.
                    whole = msgspec.to_builtins(event) | msgspec.structs.asdict(event)
                    print(visible_json(msgspec.json.encode(whole).decode()), flush=True)
                else:
                    print(event_line(event), flush=True)
                printed += 1
                if printed == arguments.count:
                    break
            del followed

    asyncio.run(work())
    return 0


async def _report_absence(skin: "SkinClient") -> None:
    """Print on stderr, whenever it changes, why no events can come."""
    import asyncio

    said = ""
    await asyncio.sleep(SETTLED_S)
    while True:
        why = _absence(skin)
        if why != said:
            said = why
            if not why:
                print("events can come now", file=sys.stderr)
            elif skin.connected and not skin.nodes:
                warn(f"{await skin.absence('is online')}; waiting")
            else:
                warn(f"{why}; waiting")
        await asyncio.sleep(1.0)


def _absence(skin: "SkinClient") -> str:
    if not skin.connected:
        return f"no broker at {skin.where}: {skin.last_error}" if skin.last_error else ""
    if all(node.online is False for node in skin.nodes.values()):
        return f'no node of robot "{skin.robot}" is online: is `skin run` running?'
    if not any(node.online for node in skin.nodes.values()):
        return f'nothing comes from robot "{skin.robot}": is `skin run` running?'
    return ""


async def health_of_all(broker: str, robot: str | None) -> dict[str, dict[str, Any]]:
    """Return the health record of every part that the robot's nodes list.

    A record that the broker has stored does not describe the present state: the robot may have been
    switched off since. Nor does that of a part whose node has gone, or lists it no longer.
    """
    import asyncio

    from skin_host.client import SkinClient

    async with SkinClient(broker, robot=robot, patience_s=PATIENCE_S) as skin:
        await skin.info()
        parts = {part: described.node for part, described in skin.parts().items()}
        live: dict[str, dict[str, Any]] = {}
        stored: dict[str, dict[str, Any]] = {}

        def is_gone(part: str) -> bool:
            return skin.nodes[parts[part]].online is False

        def is_decided(part: str) -> bool:
            return part in live or (is_gone(part) and part in stored)

        stream = skin.health()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LIVE_S):
                while not all(map(is_decided, parts)):
                    health = await anext(stream)
                    if health.part in parts:
                        (stored if health.stored else live)[health.part] = dict(health.record)
        records: dict[str, dict[str, Any]] = {}
        for part, node in parts.items():
            last = stored.get(part, {}) | live.get(part, {})
            if is_gone(part):
                why = f"node {node} is offline: is `skin run` running there?"
                records[part] = _absent(part, "offline", why, last)
            elif part not in live:
                why = f"nothing came of it for {LIVE_S:g} s: is `skin run` running at node {node}?"
                records[part] = _absent(part, "not received", why, last)
            else:
                records[part] = live[part]
        return records


def _absent(part: str, state: str, why: str, last: dict[str, Any]) -> dict[str, Any]:
    """Return the record of a part that is not received; `last` is its last record."""
    return {
        **{key: last[key] for key in ("kind", "taxels") if key in last},
        "part": part,
        "state": state,
        "valid_taxels": 0,
        "sentences": [why],
    }


def status_table(records: dict[str, dict[str, Any]]) -> str:
    """Health records by part as text; on a terminal its sentences are folded between words."""
    columns = shutil.get_terminal_size().columns if sys.stdout.isatty() else 0
    lines = [f"{'part':<16} {'state':<14} {'Hz':>6} {'valid':>11} {'age':>9}"]
    for part, record in sorted(records.items()):
        valid = f"{record.get('valid_taxels', 0)}/{record.get('taxels', 0)}"
        if record.get("kind") == "fingertip":
            valid = "-"
        age_ms = record.get("age_ms")
        age = "-" if age_ms is None else f"{age_ms:.0f} ms"
        rate = record.get("rate_hz", 0.0)
        state = visible(record.get("state", "?"))
        lines.append(f"{visible(part):<16} {state:<14} {rate:>6.1f} {valid:>11} {age:>9}")
        for sentence in record.get("sentences", ()):
            lines += _folded(visible(sentence), columns)
    return "\n".join(lines)


def _folded(sentence: str, columns: int) -> list[str]:
    """Return an indented sentence as lines of so many columns; 0: as one line."""
    if not columns:
        return [_INDENT + sentence]
    return textwrap.wrap(
        sentence,
        columns,
        initial_indent=_INDENT,
        subsequent_indent=_INDENT,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _status(arguments: argparse.Namespace) -> int:
    import asyncio

    records = asyncio.run(health_of_all(arguments.broker, arguments.robot))
    if arguments.json:
        print_json(records)
    else:
        print(status_table(records))
    well = all(record.get("state") in ("ok", "warning") for record in records.values())
    return 0 if records and well else 1


def _view(arguments: argparse.Namespace) -> int:
    if arguments.foxglove or arguments.rerun:
        return _view_elsewhere(arguments)
    from skin_host.mqtt.address import Broker
    from skin_host.viewer.server import Viewer

    Broker.from_url(arguments.broker)  # a wrong URL stays wrong, however long it is tried
    port = PAGE_PORT if arguments.port is None else arguments.port
    set_up_logging(arguments.verbose)

    viewer = Viewer(
        arguments.broker,
        robot=arguments.robot,
        commands=not arguments.read_only,
        recordings=arguments.recordings,
        names=arguments.name,
    )

    def show(url: str) -> None:
        print(f"the page: {url}", flush=True)

    run(lambda stop: viewer.run(stop, arguments.host, port, show))
    return 0


def _view_elsewhere(arguments: argparse.Namespace) -> int:
    from skin_host.recording.export import live

    set_up_logging(arguments.verbose)
    serving = (live.foxglove if arguments.foxglove else live.rerun)(arguments.host, arguments.port)

    def show(url: str) -> None:
        print(f"open {url}", flush=True)

    run(lambda stop: live.run(arguments.broker, arguments.robot, stop, serving, show))
    return 0
