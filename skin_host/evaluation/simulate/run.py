"""One run: storms of troubles and touches, each followed by a calm in which all must be well."""

import asyncio
import contextlib
import logging
import os
import random
import tempfile
import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from emulator.probes.scene import Fault, Scene, Temperature
from skin_host.config.settings import Settings
from skin_host.errors import ConfigurationError
from skin_host.evaluation.simulate.accusations import BACK_NS, NOISE, QUIET_NS, STARTED_NS
from skin_host.evaluation.simulate.disk import PowerCut
from skin_host.evaluation.simulate.promises import Promises
from skin_host.evaluation.simulate.promises.limits import SAMPLE_S
from skin_host.evaluation.simulate.trace import Before
from skin_host.evaluation.simulate.troubles import (
    ACTS,
    APART,
    WIRING,
    Trouble,
    act,
    kinds_of,
)
from skin_host.evaluation.simulate.world import Life, Spot, World
from skin_host.layout import Layout
from skin_host.mqtt.commands import MAX_RUNNING
from skin_host.processes import Processes

#: How long a storm lasts, how long the calm after it may take to be well, and after what time an
#: operator calibrates again.
STORM_S = 40.0
CALM_S = 60.0
AGAIN_S = 8.0
#: Mean times between troubles, presses, requests and ends of the daemon in a storm.
TROUBLE_S = 3.0
PRESS_S = 2.5
REQUEST_S = 6.0
DEATH_S = 25.0
#: A trouble lasts no longer alone.
LONGEST_DRILL_S = 60.0
#: Presses: short ones, and long ones in which an operator does something that a press spoils.
SHORT_S, LONG_S = (0.2, 5.0), (7.0, 11.0)
LONG_SHARE = 0.3
#: Share of the presses of a fingertip in which an object is held that slips.
SLIP_SHARE = 0.4
#: One round in so many ends with light loss for minutes. Meanwhile the temperature moves by up to
#: ten degrees in ten minutes, as of a robot that was switched on, up and down in turn.
ENDURING_ROUNDS, LEAST_C_PER_S, MOST_C_PER_S = 5, 0.1 / 60, 1.0 / 60
#: The temperature moves by at most so much in this time.
WANDER_S, MOST_WANDER_C = 600.0, 1.0
#: Presses of rehearsals.
FIRM_KPA = (40.0, 80.0)
#: So many seeds wait for a process, or for the seed before them to be reported.
AHEAD = 1000
#: Troubles at one time.
MOST_TROUBLES = 3
#: Faults that a calm may keep: they report what happened within the last minute, or real pads.
LATE_FAULTS = {
    "board_lost_set_up",
    "board_reset",
    "board_rezeroed",
    "board_overflows",
    "touches_dropped",
    "broker_refuses",
    "taxel_decides_late",
    "taxel_held",
    "part_temperature",
    "taxel_drifting",
}


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
        self.world = world
        self._kinds = kinds_of(world.settings)
        self.result = RunResult(seed, kinds=sorted(self._kinds | APART))
        self._state = state
        self._seconds = seconds
        self._until_s = until_s
        self._chance = random.Random(f"{seed} run")
        self._troubles: list[Trouble] = []
        self._injected: Counter[str] = Counter()
        self._requests = 0
        self._drills = 0
        self._rounds = 0
        #: Draws how light loss is, and where it is pressed meanwhile.
        self._enduring = random.Random(f"{seed} light loss")
        #: Draws what is rehearsed: storms stay as they are when rehearsals change.
        self._staging = random.Random(f"{seed} rehearsals")
        self._rehearsals = 0

    async def live(self) -> None:
        """Storm and calm, until the time is over or a promise is broken."""
        world = self.world
        self._promises = Promises(world)
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
        result.troubles = dict(sorted(self._injected.items()))
        result.required = sorted(self._promises.accusations.required)
        result.named = sorted(self._promises.accusations.named)
        result.touches = self._promises.touches
        chance = self._promises.chance
        result.by_chance, result.measurements = chance.touches, chance.measurements

    def _unexpected(self, _: object, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if isinstance(error, PowerCut):
            return
        self._promises.break_(f"unexpected: {context['message']}: {error!r}")

    async def _look(self) -> None:
        while True:
            await self.world.clock.sleep(SAMPLE_S)
            self._promises.sample()
            self._promises.contacts()
            life = self.world.life
            if life is not None and not life.dead and life.task.done() and not life.stop.is_set():
                self._promises.break_(f"the daemon ended by itself: {life.task.exception()!r}")

    async def _weather(self) -> None:
        world = self.world
        self._start()
        await self._calm()
        while world.clock.monotonic_s() < self._seconds:
            await self._storm()
            await self._calm()
            await self._drill()
            await self._rehearse()
            await self._endure()
        await self._end_in_a_press()

    # ------------------------------------------------------------------ the daemon's lives

    def _start(self) -> None:
        for path in sorted(self._state.rglob("*")):
            if ".damaged-" in path.name:
                self._promises.break_(f"a file was damaged: {path.name}")
        world = self.world
        world.note("the daemon starts")
        self._promises.begin(act("start"))
        world.life = Life(world)
        world.life.start(self._promises.watch)
        self._promises.started(world.life)

    async def _stop(self) -> None:
        life = self.world.life
        if life is None:
            return
        self.world.note("the daemon is asked to end")
        whole = True
        try:
            whole = await self.world.end()
        except TimeoutError:
            self._promises.break_("the daemon did not end")
        except Exception as error:
            self._promises.break_(f"the daemon ended with {error!r}")
        if whole:
            self._promises.over(life)
        else:
            # It was killed meanwhile, or its power failed.
            self._promises.forget(life.daemon)
            life.kill()

    def _kill(self, *, power: bool) -> None:
        world = self.world
        life = world.life
        if life is None:
            return
        world.note("the power fails" if power else "the daemon is killed")
        self._promises.forget(life.daemon)
        if power:
            life.disk.cut()
        life.kill()
        world.life = None

    # ------------------------------------------------------------------ storm

    async def _storm(self) -> None:
        world = self.world
        world.note("storm")
        end_s = world.clock.monotonic_s() + STORM_S
        works = [
            (self._trouble, TROUBLE_S),
            (self._press, PRESS_S),
            (self._request, REQUEST_S),
            (self._die, DEATH_S),
        ]
        if world.tips:
            works.append((self._press_tip, PRESS_S))
        async with asyncio.TaskGroup() as group:
            for work, mean_s in works:
                group.create_task(self._now_and_then(work, mean_s, end_s, group))

    async def _now_and_then(
        self, work: Any, mean_s: float, end_s: float, group: asyncio.TaskGroup
    ) -> None:
        clock = self.world.clock
        while True:
            wait_s = self._chance.expovariate(1 / mean_s)
            left_s = end_s - clock.monotonic_s() - wait_s
            if left_s <= 0:
                return
            await clock.sleep(wait_s)
            group.create_task(work(left_s))

    async def _trouble(self, left_s: float) -> None:
        chance = self._chance
        if len(self._troubles) >= MOST_TROUBLES:
            return
        name = chance.choice(list(self._kinds))
        if any(trouble.name == name for trouble in self._troubles):
            return
        if name in WIRING and any(trouble.name in WIRING for trouble in self._troubles):
            return
        trouble = self._inject(name, chance)
        if trouble is None or not trouble.lasts_s[1]:
            return
        await self._last(trouble, min(left_s, chance.uniform(*trouble.lasts_s)))

    def _inject(self, name: str, chance: random.Random, *, plain: bool = False) -> Trouble | None:
        """Begin a trouble; None if another one has unplugged the chip that was drawn."""
        world = self.world
        try:
            trouble = (self._kinds | APART)[name](world, chance, plain)
        except ConfigurationError:
            return None
        world.note(f"trouble: {trouble.about}")
        self._injected[name] += 1
        self._promises.begin(trouble)
        return trouble

    async def _last(self, trouble: Trouble, seconds: float) -> None:
        """Let a trouble last, then end it."""
        world = self.world
        self._troubles.append(trouble)
        try:
            await world.clock.sleep(seconds)
        finally:
            trouble.end()
            self._troubles.remove(trouble)
            world.note(f"ended: {trouble.about}")
            self._promises.end(trouble)

    async def _press(self, left_s: float) -> None:
        spots = [spot for spot in self.world.spots if not spot.pressed]
        if spots:
            spot = self._chance.choice(spots)
            long = self._chance.random() < LONG_SHARE
            seconds = self._chance.uniform(*(LONG_S if long else SHORT_S))
            if long:
                self.world.clock.call_later(self._chance.uniform(1.0, 2.0), self._meddle, spot)
            # A tap of one sweep cannot be distinguished from a byte that was off for one sweep.
            await spot.press(max(SHORT_S[0], min(left_s, seconds)))

    async def _press_tip(self, left_s: float) -> None:
        """As `_press`, a fingertip without skin; or let slip what it holds."""
        tip = self._chance.choice(self.world.tips)
        if tip.pressed:
            return
        if self._chance.random() < SLIP_SHARE:
            await tip.slip()
            return
        seconds = self._chance.uniform(*(LONG_S if self._chance.random() < LONG_SHARE else SHORT_S))
        await tip.press(max(SHORT_S[0], min(left_s, seconds)))

    def _meddle(self, spot: Spot) -> None:
        """An operator does something to what is pressed."""
        layout = self.world.layout
        part = next(part for part in layout.parts if part.name == spot.part)
        board = layout.triangles[int(layout.triangle_of[part.start + spot.taxel])].board
        name, payload = self._chance.choice(
            [
                ("configure", f'{{"board": "{layout.boards[board].name}"}}'),
                ("configure", "{}"),
                ("disable", f'{{"part": "{spot.part}"}}'),
                ("reload", "{}"),
                ("calibrate", "{}"),
            ]
        )
        self._ask(name, payload)

    async def _request(self, _: float) -> None:
        """An operator does something, at a moment that may be a bad one."""
        parts = [part.name for part in self.world.layout.parts]
        boards = [board.name for board in self.world.layout.boards]
        part, board = self._chance.choice(parts), self._chance.choice(boards)
        margin = round(self._chance.uniform(1.0, 4.0), 1)
        name, payload = self._chance.choice(
            [
                ("calibrate", "{}"),
                ("calibrate", f'{{"seconds": 1, "board": "{board}"}}'),
                ("configure", f'{{"board": "{board}"}}'),
                ("disable", f'{{"part": "{part}"}}'),
                ("enable", f'{{"part": "{part}"}}'),
                ("thresholds", f'{{"set": {{"margin_units": {margin}}}}}'),
                ("thresholds", '{"reset": true}'),
                ("raw", '{"seconds": 5}'),
                ("reload", "{}"),
                ("status", ""),
                ("nonsense", "{}"),
                ("calibrate", "no request"),
            ]
        )
        self._ask(name, payload)

    def _ask(self, name: str, payload: str) -> int:
        world = self.world
        self._requests += 1
        if name in ACTS:
            self._promises.begin(act(name))
        if name == "thresholds":
            self._promises.note_thresholds(payload)
        topics = world.life.daemon.publisher.topics if world.life is not None else None
        if topics is None:
            return self._requests
        world.note(f"request {self._requests}: {name} {payload}")
        reply_to = topics.reply("main", "operator")
        world.broker.request(
            topics.command("main", name), payload.encode(), reply_to, b"%d" % self._requests
        )
        return self._requests

    async def _die(self, left_s: float) -> None:
        world, chance = self.world, self._chance
        life = world.life
        if life is None:
            return
        self.result.deaths += 1
        kind = chance.choice(("killed", "power", "writing", "asked"))
        if kind == "asked":
            await self._stop()
        elif kind == "writing":
            life.disk.steps_left = chance.randrange(8)
            self._ask("calibrate", '{"seconds": 0.5}')
            self._ask("thresholds", '{"set": {"margin_units": 3}}')
            world.power_failed.clear()
            await asyncio.wait(
                [asyncio.create_task(world.power_failed.wait())], timeout=min(6.0, left_s)
            )
            self._kill(power=True)
        else:
            self._kill(power=kind == "power")
        await world.clock.sleep(min(left_s, chance.uniform(0.1, 5.0)))
        if world.life is None:  # Else another end, begun meanwhile, has started it.
            self._start()

    # ------------------------------------------------------------------ drill

    async def _drill(self) -> None:
        """One trouble alone, until health names it. All kinds take their turns, also over seeds."""
        world = self.world
        if world.life is None:
            return
        names = list(self._kinds)
        kind = names[(self.result.seed + self._drills) % len(names)]
        self._drills += 1
        quiet_s = max(QUIET_NS, STARTED_NS) / 1e9
        await world.clock.sleep(quiet_s)
        trouble = self._inject(kind, self._chance, plain=True)
        if trouble is None:
            return
        if trouble.writes:
            self._ask("thresholds", '{"reset": true}')
        if trouble.lasts_s[1]:
            await self._last(trouble, min(trouble.within_s, LONGEST_DRILL_S) + 0.5)
        else:
            await world.clock.sleep(trouble.within_s + 0.5)

    # ------------------------------------------------------------------ rehearsal

    async def _rehearse(self) -> None:
        """A situation that storms seldom make. All take their turns, also over seeds."""
        if self.world.life is None:
            return
        situations = (
            self._reset_in_a_press,
            self._set_up_in_a_press,
            self._lose_broker_in_presses,
            self._fail_after_writing,
            self._obey_another_host_in_a_press,
            self._lose_all_power_in_a_press,
        )
        situation = situations[(self.result.seed + self._rehearsals) % len(situations)]
        self._rehearsals += 1
        await situation()
        if self.world.life is not None:
            self._promises.account(self.world.life)

    async def _press_all(self, seconds: float) -> None:
        """Press every place firmly for a while."""
        async with asyncio.TaskGroup() as group:
            for spot in [*self.world.spots, *self.world.tips]:
                group.create_task(spot.press(seconds, self._staging.uniform(*FIRM_KPA)))

    @contextlib.asynccontextmanager
    async def _in_a_press(
        self, seconds: float, least_s: float, most_s: float
    ) -> AsyncIterator[None]:
        """Press every place firmly for a while; begin when it has lasted a drawn time, and end with
        it.
        """
        pressing = asyncio.create_task(self._press_all(seconds), name="press all")
        await self.world.clock.sleep(self._staging.uniform(least_s, most_s))
        yield
        await pressing

    async def _reset_in_a_press(self) -> None:
        """A board restarts while it is pressed; the daemon brings it back by itself."""
        async with self._in_a_press(8.0, 1.0, 2.0):
            self._inject("board_reset", self._staging)
        await self.world.clock.sleep(BACK_NS / 1e9)

    async def _set_up_in_a_press(self) -> None:
        """An operator sets boards up while they are pressed."""
        async with self._in_a_press(8.0, 1.0, 2.0):
            board = self._staging.choice(self.world.layout.boards).name
            self._ask("configure", self._staging.choice(("{}", f'{{"board": "{board}"}}')))

    async def _lose_broker_in_presses(self) -> None:
        """The broker fails while the skin is pressed again and again, and then is well again."""
        kinds = ("broker_absent", "broker_frozen", "broker_refuses", "broker_disconnects")
        async with self._in_a_press(1.0, 0.5, 1.0):
            trouble = self._inject(self._staging.choice(kinds), self._staging)
            assert trouble is not None
            lasting = asyncio.create_task(self._last(trouble, 8.0 if trouble.lasts_s[1] else 0.0))
        for _ in range(4):
            await self.world.clock.sleep(0.5)
            await self._press_all(1.0)
        await lasting
        await self.world.clock.sleep(5.0)

    async def _fail_after_writing(self) -> None:
        """The power fails as soon as the daemon has reported that a calibration is kept."""
        clock = self.world.clock
        kept = self._promises.subscribers.kept
        self._ask("calibrate", '{"seconds": 0.5}')
        end_s = clock.monotonic_s() + 5.0
        while self._promises.subscribers.kept == kept and clock.monotonic_s() < end_s:
            await clock.sleep(0.1)
        self.result.deaths += 1
        self._kill(power=True)
        await clock.sleep(self._staging.uniform(0.1, 2.0))
        self._start()
        await clock.sleep(5.0)

    async def _obey_another_host_in_a_press(self) -> None:
        """Another program on the bus sets a board up while it is pressed."""
        async with self._in_a_press(8.0, 1.0, 2.0):
            self._inject("other_host", self._staging)
        await self.world.clock.sleep(BACK_NS / 1e9)

    async def _lose_all_power_in_a_press(self) -> None:
        """The power of robot and computer fails together, as when a battery is changed. What was
        pressed before and still is does not read as untouched afterwards.
        """
        clock = self.world.clock
        async with self._in_a_press(16.0, 5.0, 7.0):
            held = self._parts_with_contact(b"ON")
            self.result.deaths += 1
            self._kill(power=True)
            for board in self.world.layout.boards:
                self._promises.begin(act("power"))
                self.world.robot.inject(Fault(name="board_reset", board=board.name))
            await clock.sleep(self._staging.uniform(0.1, 2.0))
            self._start()
            while any(spot.pressed for spot in self.world.spots):
                for part in held & self._parts_with_contact(b"OFF"):
                    self._promises.break_(f"{part}: OFF after a power failure, and still pressed")
                await clock.sleep(0.1)
        await clock.sleep(BACK_NS / 1e9)

    def _parts_with_contact(self, state: bytes) -> set[str]:
        """Return the parts with skin of which the broker keeps this contact."""
        life = self.world.life
        if life is None:
            return set()
        topics, retained = life.daemon.publisher.topics, self.world.broker.retained
        parts = (part.name for part in self.world.layout.parts)
        return {name for name in parts if retained.get(topics.part("contact", name)) == state}

    # ------------------------------------------------------------------ light loss

    async def _endure(self) -> None:
        """Single frames are lost for minutes, as real robots lose them all the time, while the skin
        warms up or cools down and is pressed now and then.
        """
        self._rounds += 1
        if self.world.life is None or (self.result.seed + self._rounds) % ENDURING_ROUNDS:
            return
        world, chance = self.world, self._enduring
        trouble = self._inject("light_loss", chance)
        assert trouble is not None
        c_per_s = chance.uniform(LEAST_C_PER_S, MOST_C_PER_S) * (-1) ** self._rounds
        seconds = chance.uniform(*trouble.lasts_s)
        async with asyncio.TaskGroup() as group:
            lasting = group.create_task(self._last(trouble, seconds))
            left_s = seconds
            while not lasting.done():
                world.warm(c_per_s)
                spot = chance.choice(world.spots)
                if not spot.pressed and chance.random() < 1.0 / PRESS_S:
                    pressed_s = min(chance.uniform(*SHORT_S), max(left_s, SHORT_S[0]))
                    group.create_task(spot.press(pressed_s, chance.uniform(20.0, 80.0)))
                await world.clock.sleep(1.0)
                left_s -= 1.0
        if world.life is not None:
            self._promises.account(world.life)

    async def _end_in_a_press(self) -> None:
        """The daemon is asked to end while something touches; every touch ends before it does."""
        spot = self._chance.choice(self.world.spots)
        pressing = asyncio.create_task(spot.press(3.0), name="last press")
        await self.world.clock.sleep(2.0)
        await self._stop()
        await pressing

    # ------------------------------------------------------------------ calm

    async def _calm(self) -> None:
        """Nothing happens any more. The operator does what a careful one does; then all is well."""
        world = self.world
        world.note("calm")
        began_s = world.clock.monotonic_s()
        await world.clock.sleep(8.0)
        repaired_s: float | None = None
        while not self._is_well():
            now_s = world.clock.monotonic_s()
            if now_s - began_s > CALM_S:
                self._promises.break_(
                    f"not well after {CALM_S:g} s of calm: {self._state_of_all()}"
                )
                return
            due = repaired_s is None or now_s - repaired_s > AGAIN_S
            if due and self._is_reachable():
                await self._repair(first=repaired_s is None)
                repaired_s = world.clock.monotonic_s()
            await world.clock.sleep(0.5)
        world.note("well")
        if world.life is not None:
            self._promises.account(world.life)
            self._promises.grown()

    async def _repair(self, *, first: bool) -> None:
        """The operator does what the sentences of health ask for."""
        world = self.world
        if first:
            world.note("the operator sets everything up")
            await self._enable([part.name for part in world.layout.parts])
            self._ask("thresholds", '{"reset": true}')
            for board in sorted(world.unpowered):
                self._promises.begin(act("power"))
                world.robot.inject(Fault(name="board_reset", board=board))
            world.unpowered.clear()
            self._ask("configure", "{}")
            await world.clock.sleep(6.0)
        elif world.life is not None:
            # While others ran, or the connection was lost, a request was refused or lost.
            disabled = sorted(world.life.daemon.engine.disabled)
            await self._enable([world.layout.parts[number].name for number in disabled])
        # Foam that was pressed for long relaxes for a while: then one calibration is not enough.
        world.note("the operator calibrates")
        self._ask("calibrate", "{}")
        await world.clock.sleep(7.0)
        self._promises.calibrated_at_rest()

    async def _enable(self, parts: list[str]) -> None:
        for number, part in enumerate(parts, 1):
            self._ask("enable", f'{{"part": "{part}"}}')
            if number % MAX_RUNNING == 0:  # it would refuse the next one
                await self.world.clock.sleep(0.5)

    def _is_reachable(self) -> bool:
        life = self.world.life
        return life is not None and life.daemon.publisher.counters.connected

    def _is_well(self) -> bool:
        return not self._state_of_all()

    def _state_of_all(self) -> list[str]:
        """What is not as it should be after quiet, as the broker keeps it."""
        world = self.world
        life = world.life
        if life is None:
            return ["no daemon"]
        topics, retained = life.daemon.publisher.topics, world.broker.retained
        found = []
        if retained.get(topics.node("status", "main")) != b"online":
            found.append("status is not online")
        for name in [*(part.name for part in world.layout.parts), *world.settings.fingertips]:
            state = retained.get(topics.part("contact", name))
            if state != b"OFF":
                found.append(f"{name}: contact {state!r}")
            stuck = self._promises.accusations.stuck.get(name, frozenset())
            for fault, where in self._faults(retained.get(topics.part("health", name)), stuck):
                if fault not in LATE_FAULTS and not (world.real_noise and fault in NOISE):
                    found.append(f"{name}: {fault} {where}")
        return found

    def _faults(self, payload: bytes | None, stuck: frozenset[int]) -> list[tuple[str, str]]:
        """Return what health reports of a part, but for pads that have been stuck from the first.

        A calibration by damaged bytes finds noise where there is none: then they are named.
        """
        if payload is None:
            return [("no health", "")]
        record = msgspec.json.decode(payload)
        found = [(fault["code"], fault["where"]) for fault in record["faults"]]
        refused = self.world.real_noise and any(code in NOISE for code, _ in found)
        if stuck and stuck.issuperset(record["taxel_faults"].get("stuck", ())):
            found = [(code, where) for code, where in found if code != "taxel_stuck"]
            refused |= record["state"] == "degraded" and stuck.issuperset(record["invalid"])
        if record["state"] not in ("ok", "warning") and not refused:
            taxels = f"{record['valid_taxels']} of {record['taxels']}" if "taxels" in record else ""
            found.append((record["state"], taxels))
        return found
