"""Situations that storms seldom make: drills, rehearsals, and light loss for minutes."""

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator

from emulator.probes.scene import Fault
from skin_host.evaluation.simulate.accusations import BACK_NS, QUIET_NS, STARTED_NS
from skin_host.evaluation.simulate.deeds import Deeds
from skin_host.evaluation.simulate.storm import PRESS_S, SHORT_S
from skin_host.evaluation.simulate.troubles.acts import act

#: A trouble lasts no longer alone.
LONGEST_DRILL_S = 60.0
#: Presses of rehearsals.
FIRM_KPA = (40.0, 80.0)
#: One round in so many ends with light loss for minutes. Meanwhile the temperature moves by up to
#: ten degrees in ten minutes, as of a robot that was switched on, up and down in turn.
ENDURING_ROUNDS, LEAST_C_PER_S, MOST_C_PER_S = 5, 0.1 / 60, 1.0 / 60


class Exercises:
    """Brings situations about, each in its turn.

    Args:
        deeds: that they consist of.
        seed: of the run; it decides with which they begin.
        chance: draws where and what a drill is.
    """

    def __init__(self, deeds: Deeds, seed: int, chance: random.Random) -> None:
        self._deeds = deeds
        self._world = deeds.world
        self._seed = seed
        self._chance = chance
        self._drills = 0
        self._rounds = 0
        self._rehearsals = 0
        #: Draws how light loss is, and where it is pressed meanwhile.
        self._enduring = random.Random(f"{seed} light loss")
        #: Draws what is rehearsed: storms stay as they are when rehearsals change.
        self._staging = random.Random(f"{seed} rehearsals")

    # ------------------------------------------------------------------ drill

    async def drill(self) -> None:
        """One trouble alone, until health names it. All kinds take their turns, also over seeds."""
        world = self._world
        if world.life is None:
            return
        names = list(self._deeds.kinds)
        kind = names[(self._seed + self._drills) % len(names)]
        self._drills += 1
        quiet_s = max(QUIET_NS, STARTED_NS) / 1e9
        await world.clock.sleep(quiet_s)
        trouble = self._deeds.inject(kind, self._chance, plain=True)
        if trouble is None:
            return
        if trouble.writes:
            self._deeds.ask("thresholds", '{"reset": true}')
        if trouble.lasts_s[1]:
            await self._deeds.last(trouble, min(trouble.within_s, LONGEST_DRILL_S) + 0.5)
        else:
            await world.clock.sleep(trouble.within_s + 0.5)

    # ------------------------------------------------------------------ rehearsal

    async def rehearse(self) -> None:
        """A situation that storms seldom make. All take their turns, also over seeds."""
        if self._world.life is None:
            return
        situations = (
            self._reset_in_a_press,
            self._set_up_in_a_press,
            self._lose_broker_in_presses,
            self._fail_after_writing,
            self._obey_another_host_in_a_press,
            self._lose_all_power_in_a_press,
        )
        situation = situations[(self._seed + self._rehearsals) % len(situations)]
        self._rehearsals += 1
        await situation()
        if self._world.life is not None:
            self._deeds.promises.account(self._world.life)

    async def _press_all(self, seconds: float) -> None:
        """Press every place firmly for a while."""
        async with asyncio.TaskGroup() as group:
            for spot in [*self._world.spots, *self._world.tips]:
                group.create_task(spot.press(seconds, self._staging.uniform(*FIRM_KPA)))

    @contextlib.asynccontextmanager
    async def _in_a_press(
        self, seconds: float, least_s: float, most_s: float
    ) -> AsyncIterator[None]:
        """Press every place firmly for a while; begin when it has lasted a drawn time, and end with
        it.
        """
        pressing = asyncio.create_task(self._press_all(seconds), name="press all")
        await self._world.clock.sleep(self._staging.uniform(least_s, most_s))
        yield
        await pressing

    async def _reset_in_a_press(self) -> None:
        """A board restarts while it is pressed; the daemon brings it back by itself."""
        async with self._in_a_press(8.0, 1.0, 2.0):
            self._deeds.inject("board_reset", self._staging)
        await self._world.clock.sleep(BACK_NS / 1e9)

    async def _set_up_in_a_press(self) -> None:
        """An operator sets boards up while they are pressed."""
        async with self._in_a_press(8.0, 1.0, 2.0):
            board = self._staging.choice(self._world.layout.boards).name
            self._deeds.ask("configure", self._staging.choice(("{}", f'{{"board": "{board}"}}')))

    async def _lose_broker_in_presses(self) -> None:
        """The broker fails while the skin is pressed again and again, and then is well again."""
        kinds = ("broker_absent", "broker_frozen", "broker_refuses", "broker_disconnects")
        async with self._in_a_press(1.0, 0.5, 1.0):
            trouble = self._deeds.inject(self._staging.choice(kinds), self._staging)
            assert trouble is not None
            lasting = asyncio.create_task(
                self._deeds.last(trouble, 8.0 if trouble.lasts_s[1] else 0.0)
            )
        for _ in range(4):
            await self._world.clock.sleep(0.5)
            await self._press_all(1.0)
        await lasting
        await self._world.clock.sleep(5.0)

    async def _fail_after_writing(self) -> None:
        """The power fails as soon as the daemon has reported that a calibration is kept."""
        clock = self._world.clock
        kept = self._deeds.promises.subscribers.kept
        self._deeds.ask("calibrate", '{"seconds": 0.5}')
        end_s = clock.monotonic_s() + 5.0
        while self._deeds.promises.subscribers.kept == kept and clock.monotonic_s() < end_s:
            await clock.sleep(0.1)
        self._deeds.deaths += 1
        self._deeds.kill(power=True)
        await clock.sleep(self._staging.uniform(0.1, 2.0))
        self._deeds.start()
        await clock.sleep(5.0)

    async def _obey_another_host_in_a_press(self) -> None:
        """Another program on the bus sets a board up while it is pressed."""
        async with self._in_a_press(8.0, 1.0, 2.0):
            self._deeds.inject("other_host", self._staging)
        await self._world.clock.sleep(BACK_NS / 1e9)

    async def _lose_all_power_in_a_press(self) -> None:
        """The power of robot and computer fails together, as when a battery is changed. What was
        pressed before and still is does not read as untouched afterwards.
        """
        clock = self._world.clock
        async with self._in_a_press(16.0, 5.0, 7.0):
            held = self._parts_with_contact(b"ON")
            self._deeds.deaths += 1
            self._deeds.kill(power=True)
            for board in self._world.layout.boards:
                self._deeds.promises.begin(act("power"))
                self._world.robot.inject(Fault(name="board_reset", board=board.name))
            await clock.sleep(self._staging.uniform(0.1, 2.0))
            self._deeds.start()
            while any(spot.pressed for spot in self._world.spots):
                for part in held & self._parts_with_contact(b"OFF"):
                    self._deeds.promises.break_(
                        f"{part}: OFF after a power failure, and still pressed"
                    )
                await clock.sleep(0.1)
        await clock.sleep(BACK_NS / 1e9)

    def _parts_with_contact(self, state: bytes) -> set[str]:
        """Return the parts with skin of which the broker keeps this contact."""
        life = self._world.life
        if life is None:
            return set()
        topics, retained = life.daemon.publisher.topics, self._world.broker.retained
        parts = (part.name for part in self._world.layout.parts)
        return {name for name in parts if retained.get(topics.part("contact", name)) == state}

    # ------------------------------------------------------------------ light loss

    async def endure(self) -> None:
        """Single frames are lost for minutes, as real robots lose them all the time, while the skin
        warms up or cools down and is pressed now and then.
        """
        self._rounds += 1
        if self._world.life is None or (self._seed + self._rounds) % ENDURING_ROUNDS:
            return
        world, chance = self._world, self._enduring
        trouble = self._deeds.inject("light_loss", chance)
        assert trouble is not None
        c_per_s = chance.uniform(LEAST_C_PER_S, MOST_C_PER_S) * (-1) ** self._rounds
        seconds = chance.uniform(*trouble.lasts_s)
        async with asyncio.TaskGroup() as group:
            lasting = group.create_task(self._deeds.last(trouble, seconds))
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
            self._deeds.promises.account(world.life)
