"""A robot and a daemon in one process over a bus of choice: faults as they are lived."""

import asyncio
import contextlib
from collections import Counter
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path

import can

from emulator.clock import RealClock
from emulator.probes.scene import Fault, Place, Probe, Scene
from emulator.robot import LiveProbe, Robot
from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Bus, changed, load
from skin_host.daemon.daemon import Daemon
from skin_host.layout import build_layout
from tests.support.waiting import PATIENCE_S

#: How often health is looked at: a look makes that of all parts.
HEALTH_S = 0.1
CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"
#: 60 kPa below a finger.
FINGER_N = 4.7


class Live:
    """What `living` gives: the robot, its daemon, and ways to wait."""

    def __init__(self, robot: Robot, daemon: Daemon, frames_sent: Counter[str]) -> None:
        self.robot = robot
        self.daemon = daemon
        #: Frames that the robot has put on each bus.
        self.frames_sent = frames_sent

    def finger(self) -> LiveProbe:
        """A finger over the thumb; what presses at a time of its own may press a calibration."""
        return self.robot.touch(Probe(part="left_hand", at=Place(triangle=4), diameter_mm=10))

    def faults(self) -> set[tuple[str, str]]:
        """What is told now, by code and place."""
        return {
            (fault["code"], fault["where"])
            for record in self.daemon.records().values()
            for fault in record["faults"]
        }

    async def until(self, *codes: str) -> set[tuple[str, str]]:
        """Wait until all these codes are told."""
        await self.wait(lambda: set(codes) <= {code for code, _ in self.faults()}, HEALTH_S)
        return self.faults()

    async def until_well(self, *, but: frozenset[str] = frozenset()) -> None:
        """Wait until all taxels are valid and nothing is told but codes of `but`.

        A calibration of a second or two leaves the odd taxel that decides late.
        """
        await self.wait(lambda: self._well(but), HEALTH_S)

    async def wait(self, condition: Callable[[], bool], every_s: float = 0.02) -> None:
        """Wait until a condition holds; else say which faults there are."""
        clock = self.daemon.clock
        end_s = clock.monotonic_s() + PATIENCE_S
        while not condition():
            assert clock.monotonic_s() < end_s, f"after {PATIENCE_S:g} s: {self.faults()}"
            await clock.sleep(every_s)

    def _well(self, but: frozenset[str]) -> bool:
        records = self.daemon.records().values()
        return all(record["state"] in ("ok", "warning") for record in records) and {
            code for code, _ in self.faults()
        } <= but | {"broker_away", "taxel_decides_late"}


@contextlib.asynccontextmanager
async def living(
    bus: Bus,
    state: Path,
    *,
    port: int = 1,
    scene: Scene | None = None,
    config: Path = CONFIG,
    calibrate_s: float = 1.5,
    robot_late_s: float = 0.0,
    hung: Sequence[str] = (),
    clock: Clock = SYSTEM,
) -> AsyncIterator[Live]:
    """Run both until the block is left; there is no broker unless `port` names one.

    The robot may get its power later than the daemon; what was sent until then is lost on it. Its
    boards `hung` are silent from the start.
    """
    settings = changed(
        load(config),
        {
            "buses.can0": bus,
            "service.state_directory": str(state),
            "mqtt.port": port,
            "processing.calibration.seconds": calibrate_s,
        },
    )
    layout = build_layout(settings, config.parent)
    robot = Robot(settings, layout, scene or Scene(quiet=True))
    for board in hung:
        robot.inject(Fault(name="board_silent", board=board))
    can_bus = can.Bus(interface=bus.interface, channel=bus.channel)
    frames_sent = _counting(can_bus, "can0")
    daemon = Daemon(settings, layout, configuration=config, clock=clock)
    stop = asyncio.Event()

    async def live_on() -> None:
        await asyncio.sleep(robot_late_s)
        while robot_late_s and can_bus.recv(0) is not None:
            pass
        await robot.run({"can0": can_bus}, RealClock(clock=clock))

    body = asyncio.create_task(live_on())
    host = asyncio.create_task(daemon.run(stop))
    try:
        live = Live(robot, daemon, frames_sent)
        async with asyncio.timeout(PATIENCE_S):
            while daemon.engine.calibration is None or daemon._calibration_lock.locked():  # noqa: ASYNC110
                await asyncio.sleep(0.02)
        yield live
    finally:
        stop.set()
        await asyncio.gather(host, return_exceptions=False)
        body.cancel()
        await asyncio.gather(body, return_exceptions=True)
        can_bus.shutdown()


def _counting(bus: can.BusABC, name: str) -> Counter[str]:
    """Count what is sent on a bus."""
    counts: Counter[str] = Counter()
    send = bus.send

    def counted(message: can.Message, timeout: float | None = None) -> None:
        send(message, timeout)
        counts[name] += 1

    bus.send = counted  # type: ignore[method-assign, assignment]
    return counts
