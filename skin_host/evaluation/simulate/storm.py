"""Storms: troubles, presses, requests of operators and ends of the daemon, all at random times."""

import asyncio
import random
from typing import Any

from skin_host.evaluation.simulate.deeds import Deeds
from skin_host.evaluation.simulate.troubles.hardware import WIRING
from skin_host.evaluation.simulate.world import Spot

#: How long a storm lasts.
STORM_S = 40.0
#: Mean times between troubles, presses, requests and ends of the daemon in a storm.
TROUBLE_S = 3.0
PRESS_S = 2.5
REQUEST_S = 6.0
DEATH_S = 25.0
#: Presses: short ones, and long ones in which an operator does something that a press spoils.
SHORT_S, LONG_S = (0.2, 5.0), (7.0, 11.0)
LONG_SHARE = 0.3
#: Share of the presses of a fingertip in which an object is held that slips.
SLIP_SHARE = 0.4
#: Troubles at one time.
MOST_TROUBLES = 3


class Storm:
    """Makes storms.

    Args:
        deeds: that they consist of.
        chance: draws everything.
    """

    def __init__(self, deeds: Deeds, chance: random.Random) -> None:
        self._deeds = deeds
        self._world = deeds.world
        self._chance = chance

    async def rage(self) -> None:
        """Let one storm rage, and whatever it has begun end."""
        world = self._world
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
        clock = self._world.clock
        while True:
            wait_s = self._chance.expovariate(1 / mean_s)
            left_s = end_s - clock.monotonic_s() - wait_s
            if left_s <= 0:
                return
            await clock.sleep(wait_s)
            group.create_task(work(left_s))

    async def _trouble(self, left_s: float) -> None:
        chance = self._chance
        if len(self._deeds.troubles) >= MOST_TROUBLES:
            return
        name = chance.choice(list(self._deeds.kinds))
        if any(trouble.name == name for trouble in self._deeds.troubles):
            return
        if name in WIRING and any(trouble.name in WIRING for trouble in self._deeds.troubles):
            return
        trouble = self._deeds.inject(name, chance)
        if trouble is None or not trouble.lasts_s[1]:
            return
        await self._deeds.last(trouble, min(left_s, chance.uniform(*trouble.lasts_s)))

    async def _press(self, left_s: float) -> None:
        spots = [spot for spot in self._world.spots if not spot.pressed]
        if spots:
            spot = self._chance.choice(spots)
            long = self._chance.random() < LONG_SHARE
            seconds = self._chance.uniform(*(LONG_S if long else SHORT_S))
            if long:
                self._world.clock.call_later(self._chance.uniform(1.0, 2.0), self._meddle, spot)
            # A tap of one sweep cannot be distinguished from a byte that was off for one sweep.
            await spot.press(max(SHORT_S[0], min(left_s, seconds)))

    async def _press_tip(self, left_s: float) -> None:
        """As `_press`, a fingertip without skin; or let slip what it holds."""
        tip = self._chance.choice(self._world.tips)
        if tip.pressed:
            return
        if self._chance.random() < SLIP_SHARE:
            await tip.slip()
            return
        seconds = self._chance.uniform(*(LONG_S if self._chance.random() < LONG_SHARE else SHORT_S))
        await tip.press(max(SHORT_S[0], min(left_s, seconds)))

    def _meddle(self, spot: Spot) -> None:
        """An operator does something to what is pressed."""
        layout = self._world.layout
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
        self._deeds.ask(name, payload)

    async def _request(self, _: float) -> None:
        """An operator does something, at a moment that may be a bad one."""
        parts = [part.name for part in self._world.layout.parts]
        boards = [board.name for board in self._world.layout.boards]
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
        self._deeds.ask(name, payload)

    async def _die(self, left_s: float) -> None:
        world, chance = self._world, self._chance
        life = world.life
        if life is None:
            return
        self._deeds.deaths += 1
        kind = chance.choice(("killed", "power", "writing", "asked"))
        if kind == "asked":
            await self._deeds.stop()
        elif kind == "writing":
            life.disk.steps_left = chance.randrange(8)
            self._deeds.ask("calibrate", '{"seconds": 0.5}')
            self._deeds.ask("thresholds", '{"set": {"margin_units": 3}}')
            world.power_failed.clear()
            await asyncio.wait(
                [asyncio.create_task(world.power_failed.wait())], timeout=min(6.0, left_s)
            )
            self._deeds.kill(power=True)
        else:
            self._deeds.kill(power=kind == "power")
        await world.clock.sleep(min(left_s, chance.uniform(0.1, 5.0)))
        if world.life is None:  # Else another end, begun meanwhile, has started it.
            self._deeds.start()
