"""One run: storms of troubles and touches, each followed by a calm in which all must be well."""

import asyncio
import logging
import os
import random
import tempfile
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from emulator.probes.scene import Scene, Temperature
from skin_host.config.settings import Settings
from skin_host.evaluation.simulate.calm import Calm
from skin_host.evaluation.simulate.deeds import Deeds
from skin_host.evaluation.simulate.disk import PowerCut
from skin_host.evaluation.simulate.exercises import Exercises
from skin_host.evaluation.simulate.promises import Promises
from skin_host.evaluation.simulate.promises.limits import SAMPLE_S
from skin_host.evaluation.simulate.storm import Storm
from skin_host.evaluation.simulate.trace import Before
from skin_host.evaluation.simulate.troubles.catalogue import APART
from skin_host.evaluation.simulate.world import World
from skin_host.layout import Layout
from skin_host.processes import Processes

#: The temperature moves by at most so much in this time.
WANDER_S, MOST_WANDER_C = 600.0, 1.0
#: So many seeds wait for a process, or for the seed before them to be reported.
AHEAD = 1000


@dataclass
class RunResult:
    """What came of a run.

    Attributes:
        seed: of it.
        simulated_s, cpu_s: how long it lasted, simulated and in CPU time.
        events, digest: how many events there were, and the hash of them all: of those before
            `until_s` if the run was to end there.
        seconds: the same before its last whole seconds, to compare it with a repetition.
        broken: the promise that was broken, or None; `last` are the events before.
        kinds: of trouble that the robot can have.
        troubles: how many of each kind were injected.
        required, named: kinds that health had to name if they lasted, and those that it named.
        touches, deaths: events of touch, and ends of the daemon.
        by_chance, measurements: touches by noise alone, and measurements of valid taxels.
    """

    seed: int
    simulated_s: float = 0.0
    cpu_s: float = 0.0
    events: int = 0
    digest: str = ""
    seconds: list[Before] = field(default_factory=list)
    broken: str | None = None
    last: list[str] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    troubles: dict[str, int] = field(default_factory=dict)
    required: list[str] = field(default_factory=list)
    named: list[str] = field(default_factory=list)
    touches: int = 0
    deaths: int = 0
    by_chance: int = 0
    measurements: int = 0


def simulate(
    settings: Settings,
    layout: Layout,
    config: Path,
    seed: int,
    seconds: float,
    *,
    until_s: float | None = None,
) -> RunResult:
    """Let a robot and its daemon live for some time; the same arguments give the same events.

    Args:
        settings, layout, config: of the robot, and the file that they were read from.
        seed: of everything that happens.
        seconds: simulated time, rounded up to a whole storm and its calm.
        until_s: end the same run at this time; what happened before it is the same.
    """
    began_s = time.process_time()
    with tempfile.TemporaryDirectory(prefix="skin-simulate-") as state:
        before = os.environ.get("STATE_DIRECTORY")
        os.environ["STATE_DIRECTORY"] = state
        try:
            scene = _scene(seed, seconds)
            world = World(settings, layout, config, seed, scene)
            world.trace.unnamed = state.encode()
            if until_s is not None:
                world.trace.end_at(until_s)
            with world.clock.runner() as runner:
                run = _Run(world, Path(state), seed, seconds, until_s)
                runner.run(run.live())
        finally:
            if before is None:
                del os.environ["STATE_DIRECTORY"]
            else:
                os.environ["STATE_DIRECTORY"] = before
    result = run.result
    result.cpu_s = time.process_time() - began_s
    return result


def simulate_all(
    settings: Settings, layout: Layout, config: Path, seeds: Sequence[int], seconds: float
) -> Iterator[RunResult]:
    """Run `simulate` for several seeds, side by side on all cores; yield in the order of the seeds.

    The daemon logs nothing meanwhile.

    Raises:
        SkinError: somebody killed one of the processes that run them.
    """
    run = partial(_quietly, settings, layout, config, seconds)
    with Processes(len(seeds)) as processes:
        running: deque[Future[RunResult]] = deque()
        for seed in seeds:
            running.append(processes.submit(run, seed))
            if len(running) >= AHEAD:
                yield running.popleft().result()
        for future in running:
            yield future.result()


def _quietly(
    settings: Settings, layout: Layout, config: Path, seconds: float, seed: int
) -> RunResult:
    logging.disable(logging.CRITICAL)
    return simulate(settings, layout, config, seed, seconds)


def coverage(results: Iterable[RunResult]) -> dict[str, list[str]]:
    """Return what came of the catalogue over some runs, as kinds of trouble.

    Returns:
        injected, never_injected: all kinds that the robot can have.
        named, never_named: of the injected ones that health had to name. Those that do no harm, or
            were too weak, it need not.
    """
    results = list(results)
    possible = {kind for result in results for kind in result.kinds}
    injected = {kind for result in results for kind in result.troubles}
    required = {kind for result in results for kind in result.required}
    named = {kind for result in results for kind in result.named}
    return {
        "injected": sorted(injected),
        "never_injected": sorted(possible - injected),
        "named": sorted(named),
        "never_named": sorted(required - named),
    }


def _scene(seed: int, seconds: float) -> Scene:
    """Noise as recorded on real skin or of the best skin, and a temperature that wanders."""
    chance = random.Random(f"{seed} scene")
    quiet = chance.random() < 0.5
    # A longer run has the same beginning.
    degrees_c = [24.0]
    while (len(degrees_c) - 2) * WANDER_S < seconds:
        degrees_c.append(degrees_c[-1] + chance.uniform(-MOST_WANDER_C, MOST_WANDER_C))
    keyframes = [(WANDER_S * number, at_c) for number, at_c in enumerate(degrees_c)]
    return Scene(quiet=quiet, temperature=Temperature(keyframes_c=keyframes))


class _Run:
    def __init__(
        self, world: World, state: Path, seed: int, seconds: float, until_s: float | None
    ) -> None:
        self._world = world
        self._promises = Promises(world)
        self._deeds = Deeds(world, self._promises, state)
        self._seconds = seconds
        self._until_s = until_s
        self._chance = random.Random(f"{seed} run")
        self.result = RunResult(seed, kinds=sorted(self._deeds.kinds | APART))

    async def live(self) -> None:
        """Storm and calm, until the time is over or a promise is broken."""
        world = self._world
        asyncio.get_running_loop().set_exception_handler(self._unexpected)
        looking = asyncio.create_task(self._look(), name="look")
        living = asyncio.create_task(self._weather(), name="weather")
        stopped = asyncio.create_task(self._promises.stopped.wait(), name="stopped")
        await asyncio.wait(
            [living, stopped], timeout=self._until_s, return_when=asyncio.FIRST_COMPLETED
        )
        # What ends now ends in any order.
        self.result.events, self.result.digest = world.trace.count, world.trace.digest()
        self.result.seconds = list(world.trace.seconds)
        self.result.last = list(world.trace.last)
        ended = living.done()
        for task in (living, looking, stopped):
            task.cancel()
        outcome, *_ = await asyncio.gather(living, looking, stopped, return_exceptions=True)
        if ended and outcome is not None and self._promises.broken is None:
            raise outcome  # Whatever ended it early, this hour did not pass.
        if world.life is not None:
            world.life.kill()
        result = self.result
        result.simulated_s = world.clock.monotonic_s()
        result.broken = self._promises.broken
        result.troubles = dict(sorted(self._deeds.injected.items()))
        result.required = sorted(self._promises.accusations.required)
        result.named = sorted(self._promises.accusations.named)
        result.touches, result.deaths = self._promises.touches, self._deeds.deaths
        chance = self._promises.chance
        result.by_chance, result.measurements = chance.touches, chance.measurements

    def _unexpected(self, _: object, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if isinstance(error, PowerCut):
            return
        self._promises.break_(f"unexpected: {context['message']}: {error!r}")

    async def _look(self) -> None:
        while True:
            await self._world.clock.sleep(SAMPLE_S)
            self._promises.sample()
            self._promises.contacts()
            life = self._world.life
            if life is not None and not life.dead and life.task.done() and not life.stop.is_set():
                self._promises.break_(f"the daemon ended by itself: {life.task.exception()!r}")

    async def _weather(self) -> None:
        deeds = self._deeds
        storm, calm = Storm(deeds, self._chance), Calm(deeds)
        exercises = Exercises(deeds, self.result.seed, self._chance)
        deeds.start()
        await calm.until_well()
        while self._world.clock.monotonic_s() < self._seconds:
            await storm.rage()
            await calm.until_well()
            await exercises.drill()
            await exercises.rehearse()
            await exercises.endure()
        await self._end_in_a_press()

    async def _end_in_a_press(self) -> None:
        """The daemon is asked to end while something touches; every touch ends before it does."""
        spot = self._chance.choice(self._world.spots)
        pressing = asyncio.create_task(spot.press(3.0), name="last press")
        await self._world.clock.sleep(2.0)
        await self._deeds.stop()
        await pressing
