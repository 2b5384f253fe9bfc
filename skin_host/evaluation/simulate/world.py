"""The whole system in one event loop: robot, buses, daemon, broker, disk, and who touches it.

Everything is drawn from one seed and lives by one stepped clock. The daemon is the real one.
"""

import asyncio
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emulator.boards.mtb4 import POWER_CONTROL
from emulator.probes.scene import Fault, Place, Probe, Scene
from emulator.robot import NS, LiveProbe, Robot
from skin_host.bus.port import Port
from skin_host.clock import SYSTEM, Clock, SteppedClock
from skin_host.config.settings import Bus, Receive, Settings
from skin_host.daemon.calibrate import stored_calibration
from skin_host.daemon.daemon import Daemon
from skin_host.evaluation.simulate.broker import Living, MemoryBroker
from skin_host.evaluation.simulate.cables import Cable, SimulatedPort
from skin_host.evaluation.simulate.disk import PowerCut, SimulatedDisk
from skin_host.evaluation.simulate.trace import Trace
from skin_host.files import on_disk
from skin_host.layout import Layout

#: A board's name and the number of a triangle on it.
Triangle = tuple[str, int]

#: Places that are pressed.
SPOTS = 6
#: A daemon that has not ended so long after it was asked to hangs.
LONGEST_END_S = 8.0
#: How a fingertip's object is pulled: so hard in the end, as a share of what presses it; for so
#: long until it is, and then.
PULL_SHARE, PULL_S, SLIDE_S = 0.8, 1.0, 0.7


class Life(Living):
    """One start of the daemon, until it ends or is killed."""

    def __init__(self, world: "World") -> None:
        super().__init__()
        self.world = world
        self.ports: list[SimulatedPort] = []
        self.began_ns = world.clock.monotonic_ns()
        #: By bus, how many sweeps each address had sent when the daemon was asked to end: it need
        #: not read what comes later, whatever it has to finish.
        self.sent_before_end: dict[str, dict[int, int]] | None = None
        self.disk = SimulatedDisk(
            world.chance, world.clock.monotonic_ns, world.trace, world.power_cut
        )
        self.disk.refuses = world.disk_refuses
        self.stop = asyncio.Event()
        self.daemon: Daemon
        self.task: asyncio.Task[None]

    def start(self, watch: Callable[["Life"], None]) -> None:
        """Make the daemon as `skin run` does, and let it run.

        Raises:
            SkinError: it does not start.
        """
        world = self.world
        calibration = stored_calibration(world.settings, world.layout, "main")
        self.daemon = Daemon(
            world.settings,
            world.layout,
            calibration=calibration,
            folder=world.config.parent,
            configuration=world.config,
            clock=world.clock,
            open_port=self._open_port,
            connect=world.broker.connector(self),
        )
        watch(self)
        with on_disk(self.disk):
            self.task = asyncio.create_task(self.daemon.run(self.stop), name="daemon")
        # One that was killed fails where it would write; nobody asks why.
        self.task.add_done_callback(lambda task: task.cancelled() or task.exception())

    def _open_port(
        self, name: str, bus: Bus, receive: Receive, *, wait: bool = False, clock: Clock = SYSTEM
    ) -> Port:
        port = SimulatedPort(self.world.cables[name], bus, clock)
        self.ports.append(port)
        return port

    def kill(self) -> None:
        """It does nothing from now on that anybody could notice."""
        if self.dead:
            return
        self.dead = True
        self.disk.die()
        for port in self.ports:
            port.dead = True
            port.close()
        for line in self.lines:
            line.vanish()
        self.task.cancel()


class World:
    """See the module.

    Args:
        settings, layout: of the robot.
        config: the file that they were read from.
        seed: of everything.
        scene: the robot's skin and temperature.
    """

    def __init__(
        self, settings: Settings, layout: Layout, config: Path, seed: int, scene: Scene
    ) -> None:
        self.settings = settings
        self.layout = layout
        self.config = config
        self.chance = random.Random(f"{seed} world")
        self.clock = SteppedClock(seed=seed)
        self.trace = Trace()
        self.robot = Robot(settings, layout, scene, seed=seed)
        self.broker = MemoryBroker(self.clock, self.trace)
        self.cables = {
            name: Cable(
                name,
                self.clock,
                self.move,
                self.robot.receive,
                lambda wire=wire: wire.passes,  # type: ignore[misc]
                lambda wire=wire: wire.loss_share > 0.0,  # type: ignore[misc]
                np.random.default_rng([seed, 20, number]),
                self.trace,
                frozenset(
                    board.address
                    for board in settings.boards.values()
                    if board.bus == name and board.model == "mtb3"
                ),
            )
            for number, (name, wire) in enumerate(self.robot.wires.items())
        }
        self.life: Life | None = None
        self.real_noise = not scene.quiet
        #: Boards of which a chip lost its set-up: they need their power switched off and on.
        self.unpowered: set[str] = set()
        self.spots = [Spot(self, self.chance) for _ in range(SPOTS)]
        self.tips = [
            PressedTip(self, self.chance, name)
            for name, tip in settings.fingertips.items()
            if tip.array is None
        ]
        #: Looks at the skin just before it is pressed otherwise: presses and pauses may be shorter
        #: than the time between samples.
        self.before_press: Callable[[], object] = lambda: None
        self.power_failed = asyncio.Event()
        self._disk_refuses: int | None = None

    def move(self) -> None:
        """Bring the robot to the present; what its boards sent waits on the buses."""
        passed_ns = self.clock.since_boot_ns() - self.robot.t_ns
        if passed_ns <= 0:
            return
        slept_ns = self.clock.since_boot_ns() - self.clock.monotonic_ns()
        for name, batch in self.robot.step(passed_ns / NS).items():
            if slept_ns and len(batch):
                batch.t_ns = batch.t_ns - slept_ns
            self.cables[name].arrive(batch)

    def suspend(self, seconds: float) -> None:
        """The computer sleeps and wakes up: its monotonic time has not moved, all else has."""
        self.move()
        for name, batch in self.robot.step(seconds).items():
            self.cables[name].sleep_through(batch)
        self.clock.suspend(seconds)

    def warm(self, by_c: float) -> None:
        """The skin is so much warmer from now on (degrees C)."""
        self.move()
        self.robot.inject(Fault(name="temperature_step", value=by_c))

    def taxels(self, place: Triangle) -> NDArray[np.intp]:
        """Return the taxels [m] of a triangle."""
        name, number = place
        board = next(one for one in self.layout.boards if one.name == name)
        row = board.taxel_index[number]
        found: NDArray[np.intp] = row[row >= 0].astype(np.intp)
        return found

    def damaged_set_ups(self) -> set[Triangle]:
        """Return the triangles, each by its board, whose chip does not measure each pad alone,
        as its board sets it up.
        """
        found = set()
        signal = self.robot.converters.signal
        for chip in signal.bit_by_bit():
            triangle = self.layout.triangles[chip]
            name = self.layout.boards[triangle.board].name
            board = self.robot.boards[name]
            offset = int(board.cdc_offset[board.slot(triangle.number)])
            if not signal.is_set_up(chip, offset, POWER_CONTROL):
                found.add((name, triangle.number))
        return found

    @property
    def disk_refuses(self) -> int | None:
        """The error that writing to the disk gives, or None."""
        return self._disk_refuses

    @disk_refuses.setter
    def disk_refuses(self, code: int | None) -> None:
        self._disk_refuses = code
        if self.life is not None:
            self.life.disk.refuses = code

    def power_cut(self) -> None:
        """The computer lost its power in the middle of writing."""
        self.power_failed.set()

    async def end(self) -> bool:
        """Let the daemon end as it is asked to; return whether it did: it may be killed meanwhile.

        Raises:
            TimeoutError: it does not end.
            Exception: it failed.
        """
        life = self.life
        if life is None:
            return False
        self.move()
        life.sent_before_end = {
            name: dict(cable.sent.bursts) for name, cable in self.cables.items()
        }
        life.stop.set()
        async with self.clock.timeout(LONGEST_END_S):
            await asyncio.wait([life.task])
        self.life = None
        try:
            life.task.result()
        except (asyncio.CancelledError, PowerCut):
            return False
        return True

    def note(self, text: str) -> None:
        """Something happens that is worth showing."""
        self.trace.note(self.clock.monotonic_ns(), text)


class Target:
    """A place that is pressed now and then.

    Args:
        world: that it is in.
        chance: draws how it is pressed.
        probe: what presses it.
        about: the place, for people.
    """

    def __init__(self, world: World, chance: random.Random, probe: Probe, about: str) -> None:
        self._world = world
        self._chance = chance
        self._probe: LiveProbe = world.robot.touch(probe)
        self._area_mm2 = np.pi / 4 * probe.diameter_mm**2
        self._about = about
        self.pressed = False

    async def press(self, seconds: float, kpa: float | None = None) -> None:
        """Press for a while with some pressure, a drawn one if not given; then lift."""
        world = self._world
        if kpa is None:
            kpa = self._chance.uniform(20.0, 80.0)
        world.note(f"press {self._about} {kpa:.0f} kPa for {seconds:.1f} s")
        self.pressed = True
        try:
            for share in (0.25, 0.5, 0.75, 1.0):
                world.move()
                world.before_press()
                self._probe.press(share * kpa * self._area_mm2 * 1e-3)
                await world.clock.sleep(0.03)
            await world.clock.sleep(seconds)
        finally:
            world.move()
            world.before_press()
            self._probe.lift()
            world.note(f"lift {self._about}")
            self.pressed = False


class Spot(Target):
    """One on the skin."""

    def __init__(self, world: World, chance: random.Random) -> None:
        part = chance.choice(world.layout.parts)
        self.part = part.name
        self.taxel = chance.randrange(part.n_taxels)
        probe = Probe(
            # Skin without its cover feels only what is earthed.
            kind="disc" if part.covered else "grounded",
            part=part.name,
            at=Place(taxel=self.taxel),
            diameter_mm=chance.choice((4.0, 8.0, 12.0)),
            force_n=[(0.0, 0.0)],
        )
        super().__init__(world, chance, probe, f"{self.part}/{self.taxel}")


class PressedTip(Target):
    """A fingertip without skin, which only its force/torque board feels."""

    def __init__(self, world: World, chance: random.Random, name: str) -> None:
        probe = Probe(part=name, diameter_mm=8.0, force_n=[(0.0, 0.0)])
        super().__init__(world, chance, probe, name)
        self.name = name
        #: When it was last pulled along its surface.
        self.pulled_ns = -(1 << 62)

    async def slip(self) -> None:
        """Press an object to it that is pulled along the surface until it slides; then lift it."""
        world = self._world
        kpa = self._chance.uniform(30.0, 80.0)
        async with asyncio.TaskGroup() as group:
            group.create_task(self.press(0.5 + PULL_S + SLIDE_S, kpa))
            await world.clock.sleep(0.5)
            world.note(f"pull {self._about}")
            steps = round(PULL_S / 0.01)
            for step in range(1, steps + 1):
                world.move()
                if not self.pressed:
                    break  # A stall has outlasted the press.
                self._probe.pull(step / steps * PULL_SHARE * kpa * self._area_mm2 * 1e-3)
                self.pulled_ns = world.clock.monotonic_ns()
                await world.clock.sleep(0.01)
            await world.clock.sleep(SLIDE_S)
            self.pulled_ns = world.clock.monotonic_ns()
