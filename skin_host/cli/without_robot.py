"""Commands that need no robot: emulate, demo, bench, report, simulate."""

import argparse
import contextlib
import logging
import os
import stat
import sys
from collections.abc import Callable, Coroutine, Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skin_host.cli.common import (
    Commands,
    Progress,
    add_command,
    add_config,
    add_log_level,
    count,
    filled,
    load_skin,
    port_number,
    positive,
    positive_below,
    print_json,
    run,
    seed_number,
    set_up_logging,
    warn_of_virtual,
    whole,
)
from skin_host.cli.options import add_rules
from skin_host.daemon import service
from skin_host.errors import ConfigurationError, RequestError, visible
from skin_host.files import check_output

if TYPE_CHECKING:
    import can

    from emulator.probes.mujoco_model import MujocoModel
    from emulator.robot import Robot
    from skin_host.config.settings import Settings
    from skin_host.evaluation.simulate.run import RunResult
    from skin_host.layout import Layout

#: Runs on open python-can buses, by name, until cancelled.
Work = Callable[[dict[str, "can.BusABC"]], Coroutine[Any, Any, None]]

BENCHMARKS = {
    "receive": "reading a bus: python-can's ways and ours, on the same stream",
    "latency": "from the last CAN frame of a sweep to the touch in a subscriber's hands",
    "daemon": "CPU and latency of the whole daemon, 192 to 10 000 taxels",
    "scale": "a body of 100 000 taxels in as many processes as there are cores",
    "processing": "bytes to kPa, every model, against a copy of memory",
    "publish": "what messages cost the daemon and the broker",
    "fleet": "1000 robots over three brokers, one of them killed, one frozen",
    "emulator": "simulated seconds per second",
}
HOUR_S = 3600.0
#: Of stdin, in bytes.
LONGEST_COMMAND = 4096

log = logging.getLogger(__name__)


def add_commands(commands: Commands) -> None:
    """Add the commands of this module to the parser."""
    emulate = add_command(
        commands,
        "emulate",
        "emulate the robot on a CAN bus; faults are read from stdin, see docs/scenes.md",
        "skin emulate config/icub_hand.toml --channel vcan0",
    )
    add_config(emulate)
    _add_scene(emulate)
    emulate.add_argument(
        "--fidelity", choices=("signal", "chip"), default="signal", help="how deep the chips go"
    )
    emulate.add_argument("--seed", type=seed_number, help="replaces the scene's seed")
    emulate.add_argument(
        "--state",
        type=Path,
        metavar="FILE",
        help="continue from FILE if it exists, with its scene; save the robot to it at the end",
    )
    emulate.add_argument("--speed", type=positive, default=1.0, help="times real time")
    emulate.add_argument("--interface", type=filled, help="replaces that of every bus in CONFIG")
    emulate.add_argument("--channel", type=filled, help="replaces that of the only bus in CONFIG")
    emulate.add_argument("--board", metavar="NAME", help="the board of --i2c or --i2c-dev")
    emulate.add_argument(
        "--i2c",
        type=filled,
        metavar="DEVICES",
        help="run --board on real chips: its I2C lines, such as /dev/i2c-1,/dev/i2c-2",
    )
    emulate.add_argument(
        "--i2c-dev",
        type=whole(0, 255),
        metavar="N",
        help="show the I2C lines of --board as /dev/i2c-N, N+1, ... (CUSE, root)",
    )
    real = ["--i2c"]
    add_rules(
        emulate,
        needs={"--board": ["--i2c", "--i2c-dev"], "--i2c": ["--board"], "--i2c-dev": ["--board"]},
        idle_with={
            "--scene": real,
            "--mujoco": real,
            "--fidelity": real,
            "--seed": real,
            "--state": [*real, "--mujoco"],
            "--speed": real,
            "--i2c-dev": real,
        },
    )
    add_log_level(emulate)
    emulate.set_defaults(run=_emulate)

    demo = add_command(
        commands,
        "demo",
        "emulator, daemon, broker and live page together, on this machine alone",
        "skin demo --duration 15",
    )
    demo.add_argument(
        "config", metavar="CONFIG", nargs="?", type=Path, help="any robot; the demo's own without"
    )
    _add_scene(demo)
    demo.add_argument(
        "--page-port",
        type=port_number,
        metavar="PORT",
        help="of the live page, 0 is any; without it 8080, or any if that is taken",
    )
    add_log_level(demo)
    demo.set_defaults(run=_demo)
    _add_measurements(commands)


def _add_measurements(commands: Commands) -> None:
    bench = add_command(commands, "bench", "measure what things cost here", "skin bench receive")
    about = "; ".join(f"{name}: {text}" for name, text in BENCHMARKS.items())
    bench.add_argument("name", choices=list(BENCHMARKS), metavar="NAME", help=about)
    bench.add_argument("--quick", action="store_true", help="shorter and less certain")
    bench.add_argument("--robots", type=count, metavar="N", help="of bench fleet; 1000 otherwise")
    bench.add_argument("--full", action="store_true", help="bench fleet: 7 messages/s a robot")
    bench.add_argument("--json", action="store_true", help="one JSON document")
    add_rules(bench, needs={"--robots": ["fleet"], "--full": ["fleet"]})
    bench.set_defaults(run=_bench)

    report = add_command(
        commands,
        "report",
        "build the table of speed against error, with plots",
        "skin report --quick --output report",
    )
    kind = report.add_mutually_exclusive_group()
    kind.add_argument("--contacts", action="store_true", help="localisation, fingertips, slip")
    kind.add_argument("--rig", action="store_true", help="the experiments of the paper")
    kind.add_argument("--real", action="store_true", help="only the recordings of real skin")
    report.add_argument(
        "--recordings",
        type=Path,
        metavar="DIR",
        help="folder of recordings of real skin, the insole of Belli et al. 2023 under known "
        "pressure, as .npz with t_s, counts and pressure_kpa; none comes with skin-host",
    )
    report.add_argument(
        "--quick",
        action="store_true",
        help="less certain: short histories, of foams to which no model was fitted, and few trials",
    )
    report.add_argument("--output", type=Path, metavar="DIR", help="folder for page and plots")
    report.add_argument("--json", action="store_true", help="one JSON document")
    add_rules(report, idle_with={"--recordings": ["--contacts", "--rig"]})
    report.set_defaults(run=_report)

    simulate = add_command(
        commands,
        "simulate",
        "let a robot and its daemon live through faults in stepped time, all from one seed",
        "skin simulate --seed 1 --hours 0.01",
    )
    simulate.add_argument(
        "config",
        metavar="CONFIG",
        type=Path,
        nargs="?",
        help="configuration file (TOML); the demo's if not given",
    )
    simulate.add_argument(
        "--seed", type=seed_number, default=1, help="decides everything that happens"
    )
    simulate.add_argument(
        "--seeds",
        type=whole(1, 1_000_000),
        default=1,
        metavar="N",
        help="so many, from --seed, on all cores",
    )
    simulate.add_argument(
        "--hours", type=positive_below(1e4), default=1.0, metavar="H", help="of each seed"
    )
    simulate.add_argument(
        "--until",
        type=positive,
        metavar="S",
        help="end the run at this simulated time, with the daemon's log on stderr",
    )
    simulate.add_argument("--json", action="store_true", help="one JSON document")
    add_rules(simulate, idle_with={"--until": ["--seeds"]})
    simulate.set_defaults(run=_simulate)


def _add_scene(parser: argparse.ArgumentParser) -> None:
    """Add what every emulated robot has: what happens to it, and for how long."""
    parser.add_argument("--scene", type=Path, help="what happens to the skin (TOML)")
    parser.add_argument(
        "--mujoco",
        type=Path,
        metavar="MODEL",
        help="a MuJoCo model whose contacts press the skin, see docs/mujoco.md",
    )
    parser.add_argument(
        "--duration", type=positive, metavar="S", help="end after this many seconds"
    )


def _emulate(arguments: argparse.Namespace) -> int:
    from skin_host.bus.opening import open_bus
    from skin_host.config.settings import changed

    set_up_logging(arguments.verbose)
    settings, layout = load_skin(arguments.config)
    if arguments.channel is not None and len(settings.buses) != 1:
        raise RequestError(
            f"--channel: {arguments.config} has the buses {', '.join(settings.buses)}; "
            "wanted one bus"
        )
    if arguments.board is not None and arguments.board not in settings.boards:
        known = ", ".join(settings.boards)
        raise RequestError(f'--board: no board "{arguments.board}"; there are: {known}')
    for name, bus in settings.buses.items():
        chosen = {
            "interface": arguments.interface or bus.interface,
            "channel": arguments.channel or bus.channel,
        }
        settings = changed(settings, {f"buses.{name}": changed(bus, chosen)})
    warn_of_virtual(settings)
    if arguments.state is not None:
        check_output(arguments.state)
    wanted = settings.buses
    if arguments.i2c:
        only = settings.boards[arguments.board].bus
        wanted = {only: settings.buses[only]}
    from skin_host.tasks import until

    with contextlib.ExitStack() as opened:
        work = (
            _on_real_chips(arguments, settings, opened)
            if arguments.i2c
            else _on_emulated_chips(arguments, settings, layout, opened)
        )
        buses = {}
        for name, bus in wanted.items():
            buses[name] = open_bus(name, bus)
            opened.callback(buses[name].shutdown)
        channels = ", ".join(bus.channel for bus in wanted.values())
        log.info("%s is emulated on %s", settings.robot, channels)
        run(lambda stop: until(stop, work(buses)), arguments.duration)
    return 0


def _on_real_chips(
    arguments: argparse.Namespace, settings: "Settings", opened: contextlib.ExitStack
) -> Work:
    from emulator import link

    board = settings.boards[arguments.board]
    lines = link.open_lines(arguments.i2c, opened)
    return lambda buses: link.run_board(board.model, board.address, lines, buses[board.bus])


def _on_emulated_chips(
    arguments: argparse.Namespace,
    settings: "Settings",
    layout: "Layout",
    opened: contextlib.ExitStack,
) -> Work:
    from emulator.chips.cuse import CuseBus
    from emulator.clock import RealClock
    from emulator.probes.mujoco_model import MujocoModel
    from emulator.probes.scene import load as load_scene
    from emulator.robot import Robot

    scene = None if arguments.scene is None else load_scene(arguments.scene)
    model = None if arguments.mujoco is None else MujocoModel(arguments.mujoco, layout)
    fidelity: str | dict[str, str] = arguments.fidelity
    if arguments.i2c_dev is not None:
        fidelity = dict.fromkeys(settings.boards, arguments.fidelity) | {arguments.board: "chip"}
    if arguments.state is not None and arguments.state.exists():
        robot = Robot.read(arguments.state, settings, layout)
        log.info(
            "%s: continues with the scene, seed and fidelity with which it began", arguments.state
        )
    else:
        try:
            robot = Robot(
                settings, layout, scene, fidelity=fidelity, seed=arguments.seed, source=model
            )
        except ConfigurationError as error:  # of what the scene names
            raise ConfigurationError(f"{arguments.scene}: {error}") from None
    if arguments.state is not None:
        opened.callback(robot.write, arguments.state)
    devices: list[CuseBus] = []
    if arguments.i2c_dev is not None:
        number = list(settings.boards).index(arguments.board)
        for i, line in enumerate(robot.converters.lines[number]):
            devices.append(opened.enter_context(CuseBus(arguments.i2c_dev + i, line)))

    async def work(buses: "dict[str, can.BusABC]") -> None:
        import asyncio

        loop = asyncio.get_running_loop()
        for device in devices:
            loop.add_reader(device.fileno(), device.handle)
        follow_commands(robot, model)
        await robot.run(buses, RealClock(arguments.speed))

    return work


def follow_commands(robot: "Robot", model: "MujocoModel | None" = None) -> None:
    """Take commands from stdin as they come; those of a file at once, as it cannot be waited for.

    Args:
        robot, model: see `take_commands`.
    """
    import asyncio

    begun = bytearray()
    is_file = False
    # It may be closed, or another device that cannot be waited for, such as /dev/null.
    with contextlib.suppress(OSError, ValueError, AttributeError):
        descriptor = sys.stdin.fileno()
        is_file = stat.S_ISREG(os.fstat(descriptor).st_mode)
        if not is_file:
            loop = asyncio.get_running_loop()
            loop.add_reader(descriptor, take_commands, robot, begun, model)
    while is_file and take_commands(robot, begun, model):
        pass


def take_commands(
    robot: "Robot",
    begun: bytearray,
    model: "MujocoModel | None" = None,
) -> bool:
    """Read what waits on stdin, never for the rest of a line: each line is a fault such as
    `chip_gone board=hand triangle=3`, or `mend` and it.

    With a MuJoCo model also `ctrl ACTUATOR VALUE`, which sets what drives an actuator.

    Args:
        robot: is given the faults.
        begun: a line whose end has not come.
        model: of the scene.

    Returns:
        Whether there may be more.
    """
    try:
        data = os.read(sys.stdin.fileno(), LONGEST_COMMAND)
    except BlockingIOError:  # another reader of it was faster
        return True
    except OSError:  # such as that of a terminal, for an orphan in the background
        data = b""
    if not data:
        import asyncio

        asyncio.get_running_loop().remove_reader(sys.stdin.fileno())
    begun += data or b"\n"
    *lines, rest = begun.split(b"\n")
    if len(rest) > LONGEST_COMMAND:  # it may never end
        lines, rest = [*lines, rest], bytearray()
    begun[:] = rest
    for line in lines:
        try:
            if len(line) > LONGEST_COMMAND:
                raise RequestError(f"a line of more than {LONGEST_COMMAND} bytes")
            _take_command(robot, line.decode(errors="replace"), model)
        except RequestError as error:
            print(f"skin emulate: {visible(str(error))}", file=sys.stderr, flush=True)
    return bool(data)


def _take_command(robot: "Robot", line: str, model: "MujocoModel | None") -> None:
    from emulator import faults

    text = " ".join(line.split())
    verb, _, rest = text.partition(" ")
    if verb == "mend":
        if not (rest and robot.mend(faults.parse(rest))):
            known = ", ".join(map(faults.line_of, robot.faults_on)) or "none"
            why = f'"{rest}" is not on, is over or cannot be undone' if rest else "wanted a fault"
            raise RequestError(f"mend: {why}; those that can be mended: {known}")
    elif verb == "ctrl":
        _set_control(model, rest)
    elif text:
        fault = faults.parse(text)
        robot.mend(fault)  # the same again begins again
        robot.inject(fault)


def _set_control(model: "MujocoModel | None", text: str) -> None:
    if model is None:
        raise RequestError("ctrl: there is no model; wanted skin emulate CONFIG --mujoco MODEL")
    name, _, number = text.partition(" ")
    try:
        value = float(number)
    except ValueError:
        raise RequestError(
            f'ctrl {text}: "{number}" is no number; wanted ctrl NAME VALUE'
        ) from None
    model.set_control(name, value)


def _demo(arguments: argparse.Namespace) -> int:
    from skin_host import demo

    set_up_logging(arguments.verbose)
    shown = arguments.page_port, arguments.config, arguments.scene, arguments.mujoco
    return run(lambda stop: demo.run(stop, *shown), arguments.duration)


def _bench(arguments: argparse.Namespace) -> int:
    module = import_module(f"skin_host.evaluation.bench_{arguments.name}")
    more: dict[str, int] = {}
    if arguments.robots is not None:
        more["robots"] = arguments.robots
    if arguments.full:
        more["full"] = True
    document = module.run(quick=arguments.quick, **more)
    if arguments.json:
        print_json(document)
    else:
        print(module.describe(document))
    return 0


def _report(arguments: argparse.Namespace) -> int:
    from skin_host.evaluation.steps import show_step
    from skin_host.recording.plots import find_matplotlib

    kinds = {"papers.contacts_report": arguments.contacts, "rig_report": arguments.rig}
    kinds |= {"real": arguments.real, "report": True}
    name = next(name for name, chosen in kinds.items() if chosen)
    module = import_module(f"skin_host.evaluation.{name}")
    output = arguments.output
    if output is None and not arguments.json and not arguments.real:
        output = Path("report")
    if output is not None:  # before the work, which takes minutes
        find_matplotlib()
        check_output(output, folder=True)
    on_recordings = {"recordings": arguments.recordings} if name in ("real", "report") else {}
    try:
        document = module.run(quick=arguments.quick, output=output, **on_recordings)
    finally:
        show_step("")
    if arguments.json:
        print_json(document)
        return 0
    print(module.describe(document))
    if output is not None:
        print(f"written to {output}")
    return 0


def _simulate(arguments: argparse.Namespace) -> int:
    from skin_host.demo import configuration
    from skin_host.evaluation.simulate import outcome
    from skin_host.evaluation.simulate.run import simulate, simulate_all

    config: Path = arguments.config or configuration("demo.toml")
    settings, layout = load_skin(config)
    if arguments.until is not None:
        handler = logging.StreamHandler()
        handler.setFormatter(service.LogFormatter("%(levelname)-7s %(name)s: %(message)s"))
        logging.basicConfig(level=logging.DEBUG, handlers=[handler])
    progress = Progress("simulating")
    results: list[RunResult] = []
    asked = settings, layout, config
    seconds = arguments.hours * HOUR_S
    running: Iterable[RunResult]
    try:
        progress.update(0.0)
        if arguments.until is not None:
            running = [simulate(*asked, arguments.seed, seconds, until_s=arguments.until)]
        else:
            seeds = range(arguments.seed, arguments.seed + arguments.seeds)
            running = simulate_all(*asked, seeds, seconds)
        for result in running:
            results.append(result)
            if not arguments.json:
                progress.close()
                print(outcome.line(result), flush=True)
                if result.broken:
                    print(outcome.story(result, config, arguments.hours), flush=True)
            progress.update(len(results) / arguments.seeds, f"seed {result.seed}")
    finally:
        progress.close()
    if arguments.json:
        print_json(outcome.document(results))
    elif arguments.seeds > 1:
        print(outcome.summary(results))
    failed = any(result.broken for result in results) or outcome.touched_too_often(results)
    return 1 if failed else 0
