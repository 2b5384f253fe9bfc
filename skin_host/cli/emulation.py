"""Commands for emulated hardware: emulate, demo."""

import argparse
import asyncio
import contextlib
import logging
import sys
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skin_host.cli.common import (
    Commands,
    add_command,
    add_config,
    add_log_level,
    load_skin,
    positive,
    set_up_logging,
    stop_on_signals,
)
from skin_host.errors import RequestError

if TYPE_CHECKING:
    import can

    from emulator.probes.mujoco_model import MujocoModel
    from emulator.robot import Robot
    from skin_host.config.settings import Settings
    from skin_host.layout import Layout

log = logging.getLogger(__name__)

#: Runs on open python-can buses, by name, until cancelled.
Work = Callable[[dict[str, "can.BusABC"]], Coroutine[Any, Any, None]]


def add_commands(commands: Commands) -> None:
    """Add the commands of this module to the parser."""
    emulate = add_command(
        commands,
        "emulate",
        "emulate the robot on a CAN bus; faults are read from stdin, see docs/scenes.md",
        "skin emulate config/icub_hand.toml --channel vcan0",
    )
    add_config(emulate)
    emulate.add_argument("--scene", type=Path, help="what happens to the skin (TOML)")
    add_mujoco(emulate)
    emulate.add_argument(
        "--fidelity", choices=("signal", "chip"), default="signal", help="how deep the chips go"
    )
    emulate.add_argument("--seed", type=int, help="replaces the scene's seed")
    emulate.add_argument(
        "--state",
        type=Path,
        metavar="FILE",
        help="continue from FILE if it exists, with its scene; save the robot to it at the end",
    )
    emulate.add_argument("--speed", type=positive, default=1.0, help="times real time")
    emulate.add_argument("--interface", help="replaces that of every bus in CONFIG")
    emulate.add_argument("--channel", help="replaces that of the only bus in CONFIG")
    emulate.add_argument(
        "--duration", type=positive, metavar="S", help="end after this many seconds"
    )
    emulate.add_argument("--board", metavar="NAME", help="only this board; see the next two")
    emulate.add_argument(
        "--i2c",
        metavar="DEVICES",
        help="run --board on real chips: its I2C lines, such as /dev/i2c-1,/dev/i2c-2",
    )
    emulate.add_argument(
        "--i2c-dev",
        type=int,
        metavar="N",
        help="show the I2C lines of --board as /dev/i2c-N, N+1, ... (CUSE, root)",
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
    demo.add_argument("--scene", type=Path, help="what happens to the skin (TOML)")
    demo.add_argument("--duration", type=positive, metavar="S", help="end after this many seconds")
    add_mujoco(demo)
    demo.add_argument(
        "--page-port",
        type=int,
        metavar="PORT",
        help="of the live page, 0 is any; without it 8080, or any if that is taken",
    )
    add_log_level(demo)
    demo.set_defaults(run=_demo)


def add_mujoco(parser: argparse.ArgumentParser) -> None:
    """Add the option for a simulation of bodies."""
    parser.add_argument(
        "--mujoco",
        type=Path,
        metavar="MODEL",
        help="a MuJoCo model whose contacts press the skin, see docs/mujoco.md",
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
    if (arguments.i2c or arguments.i2c_dev is not None) and arguments.board is None:
        raise RequestError("--i2c and --i2c-dev need --board NAME")
    if arguments.mujoco is not None and (arguments.i2c or arguments.state is not None):
        option = "--i2c" if arguments.i2c else "--state"
        raise RequestError(f"--mujoco and {option}: wanted one of them")
    for name, bus in settings.buses.items():
        chosen = {
            "interface": arguments.interface or bus.interface,
            "channel": arguments.channel or bus.channel,
        }
        settings = changed(settings, {f"buses.{name}": changed(bus, chosen)})
    wanted = settings.buses
    if arguments.i2c:
        only = settings.boards[arguments.board].bus
        wanted = {only: settings.buses[only]}
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
        asyncio.run(_until_stopped(lambda: work(buses), arguments.duration))
    return 0


def _on_real_chips(
    arguments: argparse.Namespace, settings: "Settings", opened: contextlib.ExitStack
) -> Work:
    from smbus2 import SMBus

    from emulator import link

    board = settings.boards[arguments.board]
    lines = [opened.enter_context(SMBus(path.strip())) for path in arguments.i2c.split(",")]
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
    else:
        robot = Robot(settings, layout, scene, fidelity=fidelity, seed=arguments.seed, source=model)
    if arguments.state is not None:
        opened.callback(robot.write, arguments.state)
    devices: list[CuseBus] = []
    if arguments.i2c_dev is not None:
        number = list(settings.boards).index(arguments.board)
        for i, line in enumerate(robot.converters.lines[number]):
            devices.append(opened.enter_context(CuseBus(arguments.i2c_dev + i, line)))

    async def work(buses: "dict[str, can.BusABC]") -> None:
        loop = asyncio.get_running_loop()
        for device in devices:
            loop.add_reader(device.fileno(), device.handle)
        # A file or /dev/null cannot be waited for; then there are no commands.
        with contextlib.suppress(PermissionError, ValueError, AttributeError):
            loop.add_reader(sys.stdin.fileno(), take_command, robot, {}, model)
        await robot.run(buses, RealClock(arguments.speed))

    return work


def take_command(
    robot: "Robot", mends: dict[str, Callable[[], None]], model: "MujocoModel | None" = None
) -> None:
    """Read a line of stdin: a fault such as `chip_gone board=hand triangle=3`, or `mend` and it.

    With a MuJoCo model also `ctrl ACTUATOR VALUE`, which sets what drives an actuator.

    Args:
        robot: to which it happens.
        mends: functions that end the given faults, by their lines.
        model: of the bodies.
    """
    from emulator import faults

    line = sys.stdin.readline()
    if not line:
        asyncio.get_running_loop().remove_reader(sys.stdin.fileno())
        return
    text = " ".join(line.split())
    verb, _, rest = text.partition(" ")
    try:
        if verb == "mend":
            if rest not in mends:
                raise RequestError(f'"{rest}": no such fault is on; there are: {", ".join(mends)}')
            mends.pop(rest)()
        elif verb == "ctrl":
            _set_control(model, rest)
        elif text:
            mends[text] = robot.inject(faults.parse(text))
    except RequestError as error:
        print(f"skin emulate: {error}", file=sys.stderr, flush=True)


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


async def _until_stopped(
    work: Callable[[], Coroutine[Any, Any, None]], duration_s: float | None
) -> None:
    stop = asyncio.Event()
    stop_on_signals(stop)
    if duration_s is not None:
        asyncio.get_running_loop().call_later(duration_s, stop.set)
    running = asyncio.create_task(work())
    stopping = asyncio.create_task(stop.wait())
    await asyncio.wait([running, stopping], return_when=asyncio.FIRST_COMPLETED)
    for task in (running, stopping):
        task.cancel()
    result, _ = await asyncio.gather(running, stopping, return_exceptions=True)
    if isinstance(result, Exception):
        raise result


def _demo(arguments: argparse.Namespace) -> int:
    from skin_host import demo

    set_up_logging(arguments.verbose)

    async def work() -> int:
        stop = asyncio.Event()
        stop_on_signals(stop)
        return await demo.run(
            arguments.duration,
            stop,
            arguments.page_port,
            arguments.config,
            arguments.scene,
            arguments.mujoco,
        )

    return asyncio.run(work())
