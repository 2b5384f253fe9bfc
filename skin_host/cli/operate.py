"""Commands that work on the real skin: run, scan, command."""

import argparse
import contextlib
import gc
import json
import logging
import math
import os
import re
import signal
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, get_origin, get_type_hints

import msgspec

from skin_host.cli import stderr
from skin_host.cli.common import (
    Commands,
    add_broker,
    add_command,
    add_config,
    add_log_level,
    count,
    filled,
    load_skin,
    positive,
    print_json,
    run,
    set_up_logging,
    warn,
    warn_of_virtual,
    whole,
)
from skin_host.cli.options import add_rules
from skin_host.daemon import service
from skin_host.errors import (
    BrokerError,
    RequestError,
    SkinError,
    nearest,
    visible,
)
from skin_host.files import write_document

if TYPE_CHECKING:
    from skin_host.client import SkinClient
    from skin_host.config.settings import Settings
    from skin_host.daemon.daemon import Daemon
    from skin_host.layout import Layout

log = logging.getLogger(__name__)

#: Configuration of a running daemon, in systemd's folder for it: `skin check --running` compares
#: with it.
RUNNING = "configuration.json"
#: An answer to a command is waited for so long.
PATIENCE_S = 25.0
#: What nodes retain at the broker, their names among it, comes within this time.
NAMED_S = 2.0
#: Of more names only the first are listed.
MOST_NAMED = 20


def add_commands(commands: Commands) -> None:
    """Add the commands of this module to the parser."""
    run = add_command(
        commands,
        "run",
        "run the daemon: CAN in, pressure and touches over MQTT out",
        "skin run config/icub.toml --calibrate",
    )
    add_config(run)
    run.add_argument("--node", default="main", help="which parts are this daemon's")
    run.add_argument("--calibrate", action="store_true", help="take a calibration first")
    run.add_argument("--duration", type=positive, metavar="S", help="end after so many seconds")
    run.add_argument(
        "--workers",
        type=count,
        metavar="N",
        help="share the buses among so many processes, each a node: NODE-1, NODE-2, ...",
    )
    run.add_argument("--share", type=_share, help=argparse.SUPPRESS)
    run.add_argument("--parent", type=count, default=os.getppid(), help=argparse.SUPPRESS)
    add_log_level(run)
    run.set_defaults(run=_run)

    scan = add_command(
        commands,
        "scan",
        "ask who is on a CAN bus",
        "skin scan --interface socketcan --channel can0",
    )
    scan.add_argument("--interface", type=filled, default="socketcan", help="python-can interface")
    scan.add_argument("--channel", type=filled, default="can0", help="its channel")
    scan.add_argument(
        "--bitrate",
        type=whole(1000, 10_000_000),
        default=1_000_000,
        metavar="N",
        help="bit/s, for interfaces that set it themselves",
    )
    scan.add_argument(
        "--option",
        type=_option,
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="a further argument for can.Bus, as of buses.NAME.options in a configuration",
    )
    scan.add_argument("--json", action="store_true", help="one JSON document")
    scan.set_defaults(run=_scan)

    command = add_command(
        commands,
        "command",
        "have a running daemon do something",
        "skin command calibrate --part left_hand",
    )
    about = "; ".join(f"{name}: {text}" for name, text in COMMANDS.items())
    command.add_argument("name", choices=list(COMMANDS), metavar="NAME", help=about)
    add_broker(command)
    command.add_argument("--node", help="which daemon, if the robot has several")
    command.add_argument("--part", help="calibrate, disable, enable: this part")
    command.add_argument("--board", help="calibrate, configure: this board only")
    command.add_argument("--seconds", type=positive, help="calibrate, raw, record: how long")
    command.add_argument("--file", help="record: name of the file in the state directory")
    command.add_argument(
        "--set", action="append", default=[], metavar="KEY=NUMBER", help="thresholds: a change"
    )
    command.add_argument("--reset", action="store_true", help="thresholds: as configured")
    command.add_argument("--json", action="store_true", help="one JSON document")
    command.add_argument(
        "--strict",
        action="store_true",
        help="calibrate: exit status 1 if the skin was touched, or received too rarely",
    )
    add_rules(
        command,
        needs={
            "disable": ["--part"],
            "enable": ["--part"],
            "--part": ["calibrate", "disable", "enable"],
            "--board": ["calibrate", "configure"],
            "--seconds": ["calibrate", "raw", "record"],
            "--file": ["record"],
            "--set": ["thresholds"],
            "--reset": ["thresholds"],
            "--strict": ["calibrate"],
        },
        idle_with={"--board": ["--part"]},
    )
    command.set_defaults(run=_command)


#: Commands to a running daemon.
COMMANDS = {
    "calibrate": "calibrate all, a part or a board",
    "configure": "send the boards their set-up again",
    "disable": "publish nothing of a part",
    "enable": "publish a part again",
    "raw": "publish raw bytes with the frames for --seconds, without it no longer",
    "record": "record the CAN frames",
    "reload": "read the configuration file again",
    "status": "health of every part",
    "stop_recording": "end the recording",
    "thresholds": "show or change the touch thresholds",
}


def _share(text: str) -> tuple[int, int]:
    """Which share of how many, for argparse."""
    number, _, n = text.partition("/")
    if not re.fullmatch("[1-9][0-9]{0,8}/[1-9][0-9]{0,8}", text) or int(number) > int(n):
        raise argparse.ArgumentTypeError(f"seen {text}, wanted NUMBER/OF such as 1/2")
    return int(number), int(n)


def _option(text: str) -> tuple[str, str | int | float | bool]:
    """An option of a bus, for argparse: its value is read as in a configuration, but text has no
    quotes.
    """
    key, equals, value = text.partition("=")
    if not (key and equals):
        raise argparse.ArgumentTypeError(f"seen {text}, wanted KEY=VALUE such as host=10.0.0.5")
    if value in ("true", "false"):
        return key, value == "true"
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            number = kind(value)
            return key, number if math.isfinite(number) else value
    return key, value


def reload_on_hangup(daemon: "Daemon") -> None:
    """Read the configuration again on SIGHUP; a wrong one is reported and changes nothing."""
    import asyncio

    reloading: set[asyncio.Task[None]] = set()

    async def reload() -> None:
        service.notify(service.reloading(daemon.clock))
        try:
            await daemon.reload()
        except SkinError as error:
            log.error("not reloaded: %s", error)
        finally:
            service.notify("READY=1")

    def begin() -> None:
        task = asyncio.get_running_loop().create_task(reload())
        reloading.add(task)
        task.add_done_callback(reloading.discard)

    asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, begin)
    service.take_hangups()


def _run(arguments: argparse.Namespace) -> int:
    service.hold_hangups()
    with service.ended_at_once():
        return _run_node(arguments)


def _run_node(arguments: argparse.Namespace) -> int:
    import asyncio

    from skin_host.config.settings import Settings
    from skin_host.daemon.alone import alone
    from skin_host.daemon.daemon import Daemon
    from skin_host.daemon.memory import remembered
    from skin_host.daemon.state import refuse_left_behind
    from skin_host.daemon.workers import share_name, share_of
    from skin_host.layout import build_layout, parts_of
    from skin_host.processes import end_with_parent

    node, is_share = arguments.node, arguments.share is not None
    if is_share:
        node = share_name(node, arguments.share[0])
    # The lines of all shares come to one log.
    set_up_logging(arguments.verbose, node if is_share else None)
    settings, layout = load_skin(arguments.config)
    refuse_left_behind(settings, arguments.config.parent)
    if arguments.workers is not None:
        return _run_workers(arguments, settings, layout)

    def ours(settings: Settings) -> Settings:
        """A configuration as this process has it: of one share, or as it is."""
        if not is_share:
            return settings
        return share_of(settings, arguments.node, *arguments.share)

    if is_share:
        end_with_parent(arguments.parent)
        settings = ours(settings)
        layout = build_layout(settings, arguments.config.parent)
    parts_of(layout, node)

    async def work(stop: asyncio.Event) -> None:
        daemon = Daemon(
            settings,
            layout,
            node,
            folder=arguments.config.parent,
            configuration=arguments.config,
            share=ours,
            log_lines_lost=stderr.lines_lost,
            memory=memory,
        )
        reload_on_hangup(daemon)
        if not is_share:
            _show_running(settings)
        # The collector would look through all that is loaded by now for 30 ms, again and again.
        gc.freeze()
        await daemon.run(stop, calibrate=arguments.calibrate)

    with alone(settings, node):
        # Of a new calibration, gains come from the file later.
        memory = remembered(settings, layout, node, arguments.node, take_new=arguments.calibrate)
        warn_of_virtual(settings)
        # SIGHUP reloads. A service sends a request to end to each share, and their parent, too.
        run(work, arguments.duration, service.ENDING, patient=is_share)
    return 0


def _show_running(settings: "Settings") -> None:
    """Write the configuration for `skin check --running`. The skin does not depend on it."""
    runtime = service.runtime_directory()
    if runtime is None:
        return
    try:
        write_document(runtime / RUNNING, settings)
    except OSError as error:
        log.warning("%s: cannot be written: %s", runtime / RUNNING, error.strerror)


def _run_workers(arguments: argparse.Namespace, settings: "Settings", layout: "Layout") -> int:
    import asyncio

    from skin_host.daemon import workers
    from skin_host.daemon.alone import alone
    from skin_host.daemon.memory import hand_over
    from skin_host.daemon.workers import share_name, share_of, share_out

    node, n = arguments.node, arguments.workers
    shares = share_out(settings, node, n)
    if not shares:
        raise RequestError(f'{arguments.config}: no part belongs to node "{node}"')
    if len(shares) < n:
        log.info("workers: %d; the buses cannot be shared among more", len(shares))
    numbers = {share_name(node, number): number for number in range(1, len(shares) + 1)}
    of_shares = {name: share_of(settings, node, one, len(shares)) for name, one in numbers.items()}
    options = ["--calibrate"] * arguments.calibrate + ["--verbose"] * arguments.verbose
    if arguments.duration is not None:
        options += ["--duration", str(arguments.duration)]
    commands = {
        name: [
            *("run", str(arguments.config), "--node", node),
            *("--share", f"{number}/{len(shares)}", "--parent", str(os.getpid()), *options),
        ]
        for name, number in numbers.items()
    }
    with alone(settings, node):
        hand_over(settings, layout, node, of_shares)
        _show_running(settings)
        return asyncio.run(workers.run(commands))


def _scan(arguments: argparse.Namespace) -> int:
    import asyncio

    from skin_host.bus.scan import scan, scan_table
    from skin_host.config.explain import explain
    from skin_host.config.settings import Bus

    document = {
        "interface": arguments.interface,
        "channel": arguments.channel,
        "bitrate": arguments.bitrate,
        "options": dict(arguments.option),
    }
    try:
        bus = msgspec.convert(document, Bus)
    except msgspec.ValidationError as error:
        raise RequestError(visible(explain(document, error, Bus, {}))) from None
    found = asyncio.run(scan(bus))
    if arguments.json:
        print_json({"boards": [asdict(one) for one in found]})
    if not found:
        raise SkinError(scan_table(found, arguments.channel))
    if not arguments.json:
        print(scan_table(found, arguments.channel))
    return 0


def _command(arguments: argparse.Namespace) -> int:
    import asyncio

    from skin_host.cli import watch
    from skin_host.client import SkinClient
    from skin_host.mqtt.commands import LEFT_OUT
    from skin_host.mqtt.messages import check_health

    request: dict[str, Any] = {
        key: getattr(arguments, key)
        for key in ("part", "board", "seconds", "file")
        if getattr(arguments, key) is not None
    }
    changes = dict(_pair(text) for text in arguments.set)
    if changes:
        _check_thresholds(changes)
        request["set"] = changes
    if arguments.reset:
        request["reset"] = True

    async def work() -> dict[str, Any]:
        patience = watch.PATIENCE_S
        async with SkinClient(arguments.broker, robot=arguments.robot, patience_s=patience) as skin:
            await _check_names(skin, arguments)
            return await skin.command(
                arguments.name, node=arguments.node, timeout_s=patience_s(arguments), **request
            )

    answer = asyncio.run(work())
    left_out = answer.get(LEFT_OUT)
    if not isinstance(left_out, list):  # a part may have this name
        left_out = []
    shown = {key: value for key, value in answer.items() if not (left_out and key == LEFT_OUT)}
    status = 0
    if arguments.name == "calibrate":
        status = _show_calibration(shown, answer, left_out, arguments)
    elif arguments.json:
        print_json(answer)
    elif arguments.name == "status":
        for record in shown.values():
            check_health(record)
        print(watch.status_table(shown))
    else:
        print("\n".join(_lines(shown)))
    if left_out:
        names = ", ".join(map(str, left_out))
        warn(f"done, but the answer came without {names}: more than the broker takes in one packet")
    if answer.get("kept") is False:
        warn(
            "done, but it could not be written and is lost when the daemon restarts; `skin status` "
            "gives the reason"
        )
        return 1
    return status


def _check_thresholds(changes: dict[str, float]) -> None:
    """Refuse changes that no daemon takes.

    Raises:
        RequestError: there is no such threshold, or not of this value.
    """
    from skin_host.config.explain import explain
    from skin_host.daemon.state import Thresholds

    try:
        msgspec.convert(changes, Thresholds)
    except msgspec.ValidationError as error:
        raise RequestError(f"--set: {explain(changes, error, Thresholds, {})}") from None


async def _check_names(skin: "SkinClient", arguments: argparse.Namespace) -> None:
    """Refuse names that the robot's nodes do not have, as far as they have described themselves.

    Raises:
        BrokerError: no node is known.
        RequestError: there is no such node, part or board; the message names those that there are.
    """
    import asyncio

    node, where = arguments.node, f'robot "{skin.robot}"'
    if node is not None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(NAMED_S):
                while node not in skin.nodes:  # noqa: ASYNC110
                    await asyncio.sleep(0.02)
        if not skin.nodes:
            raise BrokerError(
                f"broker {skin.where}: no node of {where} is known; is `skin run` running?"
            )
        _check_name("node", node, skin.nodes, where)
        where = f'node "{node}"'
    if arguments.part is None and arguments.board is None:
        return
    with contextlib.suppress(BrokerError):  # then the node itself refuses them
        nodes = await skin.info(NAMED_S)
        parts = {
            name: part
            for key, info in nodes.items()
            if node in (None, key)
            for name, part in info.parts.items()
        }
        boards = {triangle.board for part in parts.values() for triangle in part.triangles}
        if parts:
            _check_name("part", arguments.part, parts, where)
            _check_name("board", arguments.board, boards, where)


def _check_name(kind: str, name: str | None, known: Iterable[str], where: str) -> None:
    names = sorted(known)
    if name is None or name in names:
        return
    near = nearest(name, names)
    there = ", ".join(visible(one, 64) for one in names[:MOST_NAMED]) or "none"
    more = ", ..." if len(names) > MOST_NAMED else ""
    meant = f"; meant {visible(near, 64)}?" if near else ""
    raise RequestError(f'no {kind} "{name}" of {where}; there are: {there}{more}{meant}')


def patience_s(arguments: argparse.Namespace) -> float:
    """Return how long to wait for the answer of a node that stays online."""
    if arguments.name != "calibrate":
        return PATIENCE_S
    # What was collected of a board that is zeroed meanwhile is collected again, a few times; and
    # how long the node calibrates by itself is in its configuration.
    return 2 * PATIENCE_S + 4 * (arguments.seconds or 60.0)


def _show_calibration(
    known: dict[str, Any],
    document: dict[str, Any],
    left_out: list[Any],
    arguments: argparse.Namespace,
) -> int:
    """Print what a calibration found, as `skin calibrate` does; return the exit status.

    Args:
        known: what came of the answer.
        document: the whole answer, for `--json`.
        left_out: the keys that did not come.
        arguments: `json` and `strict`.
    """
    from skin_host.cli.calibrate import show
    from skin_host.processing.calibration.outcome import Outcome

    absent = {
        key: (get_origin(kind) or kind)()
        for key, kind in get_type_hints(Outcome).items()
        if key in left_out
    }
    try:
        found = msgspec.convert(absent | known, Outcome)
    except msgspec.ValidationError as error:
        raise SkinError(
            f"calibrated, but the answer is not understood: {error}; is the daemon of another "
            "version?"
        ) from None
    unsure = arguments.strict and not absent.keys().isdisjoint({"touched", "fingertips"})
    return max(show(found, document, "is in use", arguments), int(unsure))


def _lines(answer: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of an answer for people. Anybody may have written it."""
    for key, value in answer.items():
        if isinstance(value, dict) and value:
            yield f"{visible(key)}:"
            yield from (f"  {visible(name)}: {_words(one)}" for name, one in value.items())
        else:
            yield f"{visible(key)}: {_words(value)}"


def _words(value: object) -> str:
    """Return one value of an answer in words."""
    if value in ([], {}):
        return "none"
    match value:
        case True | False:
            return "yes" if value else "no"
        case None:
            return "unknown"
        case float():
            return str(value).removesuffix(".0")
        case str() | int():
            text = str(value)
        case list() if all(type(one) in (str, int) for one in value):
            text = ", ".join(map(str, value))
        case _:
            text = json.dumps(value, ensure_ascii=False)
    return visible(text, len(text))


def _pair(text: str) -> tuple[str, float]:
    key, equals, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not equals or not math.isfinite(number):  # JSON has only finite ones
        raise RequestError(f"--set {text}: wanted KEY=NUMBER such as margin_units=3")
    return key, int(number) if key == "votes_of_3" and number.is_integer() else number
