"""`skin demo`: emulator, daemon, broker and live page, on a machine with nothing else."""

import asyncio
import contextlib
import json
import logging
import tempfile
from collections import Counter
from collections.abc import AsyncIterator
from importlib.metadata import files
from pathlib import Path

import can

from skin_host.cli.common import load_skin
from skin_host.cli.lines import event_line
from skin_host.client import SkinClient
from skin_host.daemon import Daemon
from skin_host.errors import ConfigurationError, SkinError
from skin_host.layout import Layout
from skin_host.publish.broker import LocalBroker, local_broker
from skin_host.settings import Bus, Settings
from skin_host.viewer.server import Viewer

log = logging.getLogger(__name__)

CALIBRATION_S = 3.0
PAGE_PORT = 8080
VCAN = "vcan0"
#: So long may the last events be on their way through the broker.
LAST_EVENTS_S = 5.0


async def run(duration_s: float | None, stop: asyncio.Event, page_port: int | None) -> int:
    """Run until `stop` or for `duration_s`; the last line on stdout is a JSON summary.

    Args:
        duration_s: None runs on.
        stop: set it to end.
        page_port: where the live page is served on this machine; 0 is any free port, None
            the usual one, or any if somebody has that.

    Raises:
        SkinError: a broker, a bus or the emulator cannot be started.
    """
    settings, layout = load_skin(configuration("demo.toml"))
    _choose_bus(settings.buses["can0"])
    if duration_s is not None:
        asyncio.get_running_loop().call_later(duration_s, stop.set)
    touches: Counter[str] = Counter()
    # The page and the listener find the broker too, which is no news.
    logging.getLogger("skin_host.client").setLevel(logging.WARNING)
    with tempfile.TemporaryDirectory(prefix="skin-demo-") as state:
        settings.service.state_directory = state
        settings.processing.calibration.seconds = CALIBRATION_S
        async with local_broker() as broker, _robot(settings, layout):
            settings.mqtt.host, settings.mqtt.port = broker.host, broker.port
            settings.mqtt.protocol = broker.protocol
            viewer = Viewer(broker.url, robot=settings.robot)
            async with served(viewer, page_port) as page:
                _explain(settings, broker, page)
                daemon = Daemon(settings, layout)
                listening = asyncio.create_task(_listen(broker.url, settings.robot, touches))
                await daemon.run(stop, calibrate=True)
                await _heard(touches, daemon.publisher.counters.touches_sent)
                listening.cancel()
                await asyncio.gather(listening, return_exceptions=True)
    sent = daemon.publisher.counters
    assemblers = [assembler.counters for assembler in daemon.engine.assemblers.values()]
    lost = sum(port.counters.dropped for port in daemon.link.ports.values())
    summary = {
        "sweeps": sum(counters.sweeps for counters in assemblers),
        "frames_published": sent.frames_sent,
        "frames_lost": lost + sum(counters.halves for counters in assemblers),
        "touches_begun": touches["begin"],
        "touches_ended": touches["end"],
        "bus": settings.buses["can0"].interface,
        "broker": broker.kind,
    }
    print(json.dumps(summary))
    return 0


@contextlib.asynccontextmanager
async def served(viewer: Viewer, port: int | None) -> AsyncIterator[str]:
    """Serve the page as `run` says; gives its URL.

    Raises:
        SkinError: the port cannot be had.
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
    """A file of the project's `config/`, in a checkout or where the package installed it.

    Raises:
        ConfigurationError: it is in neither place.
    """
    here = Path(__file__).parents[1] / "config" / name
    if here.exists():
        return here
    for file in files("skin-host") or ():
        if file.as_posix().endswith(f"share/skin-host/config/{name}"):
            return Path(str(file.locate())).resolve()
    raise ConfigurationError(f"{here}: not there; run the demo from a checkout of the project")


def _choose_bus(bus: Bus) -> None:
    """A virtual CAN interface of the kernel if there is one, else one within this process."""
    flags = Path("/sys/class/net", VCAN, "flags")
    if flags.exists() and int(flags.read_text(), 16) & 1:
        bus.interface, bus.channel = "socketcan", VCAN


def _explain(settings: Settings, broker: LocalBroker, page: str) -> None:
    bus = settings.buses["can0"]
    if bus.interface == "virtual":
        print(f"No interface {VCAN} here: emulator and daemon share python-can's virtual bus.")
    else:
        print(f"Emulator and daemon meet on {bus.channel}.")
    print(f"Broker: {broker.kind} on {broker.host}:{broker.port}. To listen along:")
    print(f"    .venv/bin/skin listen --broker '{broker.url}'")
    print(f"    mosquitto_sub -p {broker.port} -v -t 'skin/demo/+/touch'")
    print(f"The live page: {page}")
    print(f"Calibrating for {CALIBRATION_S:g} s, then touches as they come:", flush=True)


@contextlib.asynccontextmanager
async def _robot(settings: Settings, layout: Layout) -> AsyncIterator[None]:
    """The emulated robot on its bus, for as long as the block lasts."""
    from emulator.robot import Robot
    from emulator.scene import load

    robot = Robot(settings, layout, load(configuration("scenes/demo.toml")))
    bus = settings.buses["can0"]
    with can.Bus(interface=bus.interface, channel=bus.channel) as opened:
        living = asyncio.create_task(robot.run({"can0": opened}))
        try:
            yield
        finally:
            living.cancel()
            (result,) = await asyncio.gather(living, return_exceptions=True)
            if isinstance(result, Exception):
                raise SkinError(f"the emulator failed: {result}") from result


async def _heard(touches: "Counter[str]", sent: int) -> None:
    """Wait until the listener has all events, or they must be lost."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LAST_EVENTS_S):
            while touches.total() < sent:  # noqa: ASYNC110
                await asyncio.sleep(0.02)


async def _listen(url: str, robot: str, touches: "Counter[str]") -> None:
    """Be one more subscriber: count the touches and print those that begin and end."""
    async with SkinClient(url, robot=robot) as skin:
        async for touch in skin.touches():
            touches[touch.event] += 1
            if touch.event != "move":
                print(event_line(touch), flush=True)
