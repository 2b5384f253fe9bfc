"""`skin demo`: emulator, daemon, broker and live page on one machine without other software."""

import asyncio
import contextlib
import json
import logging
import multiprocessing
import signal
import socket
import sys
import tempfile
from collections import Counter
from collections.abc import AsyncIterator
from importlib.metadata import files
from pathlib import Path
from typing import TYPE_CHECKING

import can
import numpy as np
from msgspec import structs

from skin_host import emulator_path
from skin_host.bus.pair import PAIR, PairBus, hand_over, pair
from skin_host.cli.lines import event_line
from skin_host.client import SkinClient
from skin_host.config.settings import Bus, Mqtt, Settings, changed
from skin_host.daemon.daemon import Daemon
from skin_host.errors import ConfigurationError, SkinError
from skin_host.layout import Layout, PadKind, build_layout, load_skin
from skin_host.mqtt.broker import LocalBroker, local_broker
from skin_host.processes import OF_TERMINALS, kept_from_children, start_tracker
from skin_host.tasks import cancel
from skin_host.viewer.server import Viewer

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    from emulator.probes.scene import Scene

# The emulator's process begins here, not at the command line.
emulator_path.provide()

log = logging.getLogger(__name__)

CALIBRATION_S = 3.0
PAGE_PORT = 8080
VCAN = "vcan0"
#: The last events may take this long to pass through the broker.
LAST_EVENTS_S = 5.0
#: Without a scene the parts are pressed one after the other, this often, starting after the
#: calibration.
PRESS_EVERY_S = 1.5
FIRST_PRESS_S = 6.0
PRESS_KPA = [(0.0, 0.0), (0.3, 45.0), (1.8, 40.0), (2.2, 0.0)]
FINGERTIP_N = [(0.0, 0.0), (0.3, 2.0), (1.8, 2.0), (2.2, 0.0)]


async def run(
    stop: asyncio.Event,
    page_port: int | None,
    config: Path | None = None,
    scene: Path | None = None,
    mujoco: Path | None = None,
) -> int:
    """Run until `stop`; the last line on stdout is a JSON summary.

    Args:
        stop: set it to end.
        page_port: where the live page is served on this machine; 0 is any free port, None
            the usual one, or any if that is taken.
        config: of the robot to show; the demo's own by default.
        scene: what happens to the skin; by default the demo's own, or on another robot a press
            on one part after the other.
        mujoco: a model whose contacts press the skin; without `scene` nothing else happens then.

    Raises:
        SkinError: a broker, a bus or the emulator cannot be started.
    """
    settings, layout, happening = prepared(config, scene)
    if mujoco is not None and scene is None:
        happening = structs.replace(happening, probe=[])
    touches: Counter[str] = Counter()
    # The page and the listener log that they found the broker, which is not of interest here.
    logging.getLogger("skin_host.client").setLevel(logging.WARNING)
    with tempfile.TemporaryDirectory(prefix="skin-demo-") as state:
        async with (
            local_broker() as broker,
            _robot(settings, layout, happening, mujoco, stop) as buses,
        ):
            settings = changed(
                settings,
                {
                    "buses": buses,
                    "service.state_directory": state,
                    "service.metrics_port": 0,
                    "processing.calibration.seconds": CALIBRATION_S,
                }
                | broker.settings,
            )
            viewer = Viewer(broker.url, robot=settings.robot)
            async with served(viewer, page_port) as page:
                _explain(settings, broker, page)
                daemon = Daemon(settings, layout)
                listening = asyncio.create_task(_listen(broker.url, settings.robot, touches))
                await daemon.run(stop, calibrate=True)
                await _heard(touches, daemon.publisher.counters.touches_sent)
                await cancel(listening)
    sent = daemon.publisher.counters
    assemblers = [assembler.counters for assembler in daemon.engine.assemblers.values()]
    lost = sum(port.counters.dropped for port in daemon.link.ports.values())
    summary = {
        "sweeps": sum(counters.sweeps for counters in assemblers),
        "frames_published": sent.frames_sent,
        "frames_lost": lost + sum(counters.halves for counters in assemblers),
        "touches_begun": touches["begin"],
        "touches_ended": touches["end"],
        "bus": next(iter(settings.buses.values())).interface,
        "broker": broker.kind,
    }
    print(json.dumps(summary))
    return 0


def prepared(config: Path | None, scene: Path | None) -> "tuple[Settings, Layout, Scene]":
    """Return the robot of a configuration on buses of this process, as one node; and its scene."""
    from emulator.probes import scene as scenes

    settings, _ = load_skin(config or configuration("demo.toml"))
    buses = {
        name: Bus(interface="virtual", channel=f"skin-demo-{name}", bitrate=bus.bitrate)
        for name, bus in settings.buses.items()
    }
    if config is None and _is_up(VCAN):
        buses = {name: Bus(interface="socketcan", channel=VCAN) for name in buses}
    mqtt = Mqtt(encoding=settings.mqtt.encoding, frame_hz=settings.mqtt.frame_hz)
    settings = changed(
        settings,
        {"buses": buses, "mqtt": mqtt}
        | {f"parts.{name}.node": "main" for name in settings.parts}
        | {f"fingertips.{name}.node": "main" for name in settings.fingertips},
    )
    folder = Path() if config is None else config.parent
    layout = build_layout(settings, folder)
    if scene is not None:
        return settings, layout, scenes.load(scene)
    if config is None:
        return settings, layout, scenes.load(configuration("scenes/demo.toml"))
    return settings, layout, presses(settings, layout)


def presses(settings: Settings, layout: Layout) -> "Scene":
    """A scene for any robot: a press in the middle of each part, one part after the other.

    Its pads are healthy: health would name many of those of recorded real skin.
    """
    from emulator.probes.scene import Place, Probe, Scene

    # A fingertip under an array of taxels is pressed through the array.
    bare = [name for name, tip in settings.fingertips.items() if tip.array is None]
    names = [part.name for part in layout.parts] + bare
    every_s = max(8.0, PRESS_EVERY_S * len(names))
    probes = []
    for number, name in enumerate(names):
        start_s = FIRST_PRESS_S + PRESS_EVERY_S * number
        if name in settings.fingertips:
            probes.append(Probe(part=name, force_n=FINGERTIP_N, start_s=start_s, repeat_s=every_s))
            continue
        part = layout.parts[number]
        mine = slice(part.start, part.stop)
        feels = np.flatnonzero(layout.pad_kind[mine] == PadKind.PRESSURE)
        if not len(feels):
            continue
        places_m = layout.position_m[mine][feels]
        middle = int(feels[np.argmin(np.linalg.norm(places_m - places_m.mean(axis=0), axis=1))])
        probes.append(
            Probe(
                part=name,
                at=Place(taxel=middle),
                kind="disc" if settings.parts[name].covered else "grounded",
                diameter_mm=12.0,
                pressure_kpa=PRESS_KPA,
                start_s=start_s,
                repeat_s=every_s,
            )
        )
    about = "One part after the other is pressed."
    return Scene(about=about, seed=8, quiet=True, probe=probes)


@contextlib.asynccontextmanager
async def served(viewer: Viewer, port: int | None) -> AsyncIterator[str]:
    """Serve the page on the port that `run` describes; yields its URL.

    Raises:
        SkinError: the port is not available.
    """
    async with contextlib.AsyncExitStack() as stack:
        try:
            wanted = viewer.serving(port=PAGE_PORT if port is None else port)
            url = await stack.enter_async_context(wanted)
        except SkinError:
            if port is not None:
                raise
            url = await stack.enter_async_context(viewer.serving(port=0))
        yield url


def configuration(name: str) -> Path:
    """Return the path of a file of the project's `config/`, in a checkout or an installed package.

    Raises:
        ConfigurationError: it is in neither place.
    """
    here = Path(__file__).parents[1] / "config" / name
    if here.exists():
        return here
    for file in files("skin-host") or ():
        if file.as_posix().endswith(f"share/skin-host/config/{name}"):
            return Path(str(file.locate())).resolve()
    raise ConfigurationError(f"{here}: not found; name a configuration: skin demo CONFIG")


def _is_up(interface: str) -> bool:
    """Whether the kernel has a CAN interface of this name that is up."""
    flags = Path("/sys/class/net", interface, "flags")
    return flags.exists() and bool(int(flags.read_text(), 16) & 1)


def _explain(settings: Settings, broker: LocalBroker, page: str) -> None:
    bus = next(iter(settings.buses.values()))
    if bus.interface == PAIR:
        print("Emulator and daemon are joined by sockets: no CAN interface is needed.")
    else:
        print(f"Emulator and daemon meet on {bus.channel}.")
    print(f"Broker: {broker.kind} on {broker.host}:{broker.port}. To listen to it:")
    print(f"    {Path(sys.executable).parent / 'skin'} listen --broker '{broker.url}'")
    print(
        f"    mosquitto_sub -p {broker.port} -v -t '{settings.mqtt.base}/{settings.robot}/+/touch'"
    )
    print(f"The live page: {page}")
    print(f"Calibrating for {CALIBRATION_S:g} s, then touches as they come:", flush=True)


@contextlib.asynccontextmanager
async def _robot(
    settings: Settings,
    layout: Layout,
    scene: "Scene",
    mujoco: Path | None,
    stop: asyncio.Event,
) -> AsyncIterator[dict[str, Bus]]:
    """Run the emulated robot in a process of its own, for as long as the block lasts.

    A daemon that is busy must not hold up its robot. Yields the daemon's buses; `stop` is set if
    the robot ends by itself.
    """
    buses, ends = dict(settings.buses), {}
    for name, bus in settings.buses.items():
        if bus.interface == "virtual":
            ours, ends[name] = pair()
            buses[name] = Bus(interface=PAIR, channel=hand_over(ours), bitrate=bus.bitrate)
    spawn = multiprocessing.get_context("spawn")
    ready, told = spawn.Pipe(duplex=False)
    process = spawn.Process(
        target=_live, args=(settings, layout, scene, mujoco, ends, told), daemon=True
    )
    start_tracker()
    with kept_from_children(*OF_TERMINALS, signal.SIGTERM):
        process.start()
    told.close()
    for end in ends.values():
        end.close()
    loop = asyncio.get_running_loop()
    try:
        try:
            fault = await asyncio.to_thread(ready.recv)
        except EOFError:
            fault = SkinError("the emulator failed as it started; its error stands above")
        if fault is not None:
            raise fault
        loop.add_reader(process.sentinel, stop.set)
        yield buses
    finally:
        loop.remove_reader(process.sentinel)
        failed = process.exitcode
        process.kill()
        await asyncio.to_thread(process.join)
        ready.close()
    if failed:
        raise SkinError("the emulator failed; its error stands above")


def _live(
    settings: Settings,
    layout: Layout,
    scene: "Scene",
    mujoco: Path | None,
    ends: dict[str, socket.socket],
    told: "Connection",
) -> None:
    """Be the robot, in its own process, until the parent ends."""
    from emulator.probes.mujoco_model import MujocoModel
    from emulator.robot import Robot
    from skin_host.bus.opening import open_bus

    try:
        model = None if mujoco is None else MujocoModel(mujoco, layout)
        robot = Robot(settings, layout, scene, source=model)
        buses: dict[str, can.BusABC] = {name: PairBus(end) for name, end in ends.items()}
        for name, bus in settings.buses.items():
            if name not in buses:
                buses[name] = open_bus(name, bus)
    except SkinError as error:
        told.send(error)
        return
    with contextlib.suppress(BrokenPipeError):  # the parent is gone, which ends this below
        told.send(None)

    async def live() -> None:
        living = asyncio.create_task(robot.run(buses))
        parent = multiprocessing.parent_process()
        assert parent is not None
        asyncio.get_running_loop().add_reader(parent.sentinel, living.cancel)
        with contextlib.suppress(asyncio.CancelledError):
            await living

    try:
        asyncio.run(live())
    except SkinError as error:
        print(f"skin demo: {error}", file=sys.stderr)
        sys.exit(1)
    finally:
        for opened in buses.values():
            opened.shutdown()


async def _heard(touches: "Counter[str]", sent: int) -> None:
    """Wait until the listener has received all events, or they must be lost."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LAST_EVENTS_S):
            while touches.total() < sent:  # noqa: ASYNC110
                await asyncio.sleep(0.02)


async def _listen(url: str, robot: str, touches: "Counter[str]") -> None:
    """Subscribe as another client: count the touches and print those that begin and end."""
    async with SkinClient(url, robot=robot) as skin:
        async for touch in skin.touches():
            touches[touch.event] += 1
            if touch.event != "move":
                print(event_line(touch), flush=True)
