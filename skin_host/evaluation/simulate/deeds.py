"""What is done to a robot and its daemon in a run, each deed noted for the promises."""

import random
from collections import Counter
from pathlib import Path

from skin_host.errors import ConfigurationError
from skin_host.evaluation.simulate.promises import Promises
from skin_host.evaluation.simulate.troubles.acts import ACTS, act
from skin_host.evaluation.simulate.troubles.catalogue import APART, kinds_of
from skin_host.evaluation.simulate.troubles.trouble import Trouble
from skin_host.evaluation.simulate.world import Life, World


class Deeds:
    """Starts and ends the daemon, begins and ends troubles, and asks what operators ask.

    Args:
        world: in which they are done.
        promises: that know of them.
        state: folder of what the daemon keeps.

    Attributes:
        kinds: of trouble that the robot can have, and how each begins.
        troubles: that last.
        injected: how many of each kind were.
        deaths: of the daemon, before its time.
    """

    def __init__(self, world: World, promises: Promises, state: Path) -> None:
        self.world = world
        self.promises = promises
        self.kinds = kinds_of(world.settings)
        self.troubles: list[Trouble] = []
        self.injected: Counter[str] = Counter()
        self.deaths = 0
        self._state = state
        self._requests = 0

    # ------------------------------------------------------------------ the daemon's lives

    def start(self) -> None:
        for path in sorted(self._state.rglob("*")):
            if ".damaged-" in path.name:
                self.promises.break_(f"a file was damaged: {path.name}")
        world = self.world
        world.note("the daemon starts")
        self.promises.begin(act("start"))
        world.life = Life(world)
        world.life.start(self.promises.watch)
        self.promises.started(world.life)

    async def stop(self) -> None:
        life = self.world.life
        if life is None:
            return
        self.world.note("the daemon is asked to end")
        whole = True
        try:
            whole = await self.world.end()
        except TimeoutError:
            self.promises.break_("the daemon did not end")
        except Exception as error:
            self.promises.break_(f"the daemon ended with {error!r}")
        if whole:
            self.promises.over(life)
        else:
            # It was killed meanwhile, or its power failed.
            self.promises.forget(life.daemon)
            life.kill()

    def kill(self, *, power: bool) -> None:
        world = self.world
        life = world.life
        if life is None:
            return
        world.note("the power fails" if power else "the daemon is killed")
        self.promises.forget(life.daemon)
        if power:
            life.disk.cut()
        life.kill()
        world.life = None

    # ------------------------------------------------------------------ troubles and requests

    def inject(self, name: str, chance: random.Random, *, plain: bool = False) -> Trouble | None:
        """Begin a trouble; None if another one has unplugged the chip that was drawn."""
        world = self.world
        try:
            trouble = (self.kinds | APART)[name](world, chance, plain)
        except ConfigurationError:
            return None
        world.note(f"trouble: {trouble.about}")
        self.injected[name] += 1
        self.promises.begin(trouble)
        return trouble

    async def last(self, trouble: Trouble, seconds: float) -> None:
        """Let a trouble last, then end it."""
        world = self.world
        self.troubles.append(trouble)
        try:
            await world.clock.sleep(seconds)
        finally:
            trouble.end()
            self.troubles.remove(trouble)
            world.note(f"ended: {trouble.about}")
            self.promises.end(trouble)

    def ask(self, name: str, payload: str) -> int:
        world = self.world
        self._requests += 1
        if name in ACTS:
            self.promises.begin(act(name))
        if name == "thresholds":
            self.promises.note_thresholds(payload)
        topics = world.life.daemon.publisher.topics if world.life is not None else None
        if topics is None:
            return self._requests
        world.note(f"request {self._requests}: {name} {payload}")
        reply_to = topics.reply("main", "operator")
        world.broker.request(
            topics.command("main", name), payload.encode(), reply_to, b"%d" % self._requests
        )
        return self._requests
