"""Troubles of the computer: it stalls, sleeps, has its clock set; its disk is full or slow."""

import math
import random

from skin_host.evaluation.simulate.troubles.codes import BROKER
from skin_host.evaluation.simulate.troubles.trouble import Begin, Trouble, nothing
from skin_host.evaluation.simulate.world import World

#: A broker ends the connection of a client from which nothing came for longer.
KEEP_ALIVE_S = 10.0
#: What a buffer or the queue of events has no room for meanwhile is lost, and counted. What waits
#: in them accuses nobody.
_STALLED = {"host_stalls", "bus_drops", "touches_dropped"}
#: How long stalls last, times `_STALL_SHARES`; no stall lasts for longer, nor does what passes wait
#: to be read.
_STALLS_S, _LONG_STALLS_S = (0.05, 0.2, 0.5, 1.5, 4.0), (1.5, 4.0)
_STALL_SHARES = (0.8, 1.2)
LONGEST_STALL_S = math.ceil(max(_STALLS_S) * max(_STALL_SHARES))


def stall(world: World, chance: random.Random, plain: bool) -> Trouble:
    """The daemon gets no processor for a while; buses and broker go on."""
    seconds = chance.choice(_LONG_STALLS_S if plain else _STALLS_S)
    seconds *= chance.uniform(*_STALL_SHARES)
    world.clock.advance(seconds)
    must = frozenset({"host_stalls"} if seconds > 0.7 else ())
    about = f"stall {seconds:.2f} s"
    return Trouble("stall", about, nothing, _STALLED, must, 1.0, lasts_s=(0.0, 0.0))


def suspended(world: World, chance: random.Random, _: bool) -> Trouble:
    """The computer sleeps: its adapters receive nothing, monotonic time stops, brokers go on."""
    seconds = round(chance.uniform(2.0, 20.0), 1)
    world.suspend(seconds)
    if seconds > KEEP_ALIVE_S:
        world.broker.disconnect_all(accusing=False)
    about = f"suspended {seconds:g} s"
    must = frozenset({"host_stalls"})
    may = _STALLED | BROKER
    return Trouble("suspended", about, nothing, may, must, 1.0, lasts_s=(0.0, 0.0))


def set_clock(world: World, chance: random.Random, plain: bool) -> Trouble:
    """The clock is set; monotonic time goes on."""
    jump_s = chance.choice((-3600.0, -2.0, -0.3, -0.02, 0.02, 0.3, 2.0, 3600.0))
    if plain:
        jump_s = 2.0
    world.move()
    world.clock.set(jump_s)
    may = {"host_stalls"}
    # Time set by more than a minute is recognised as that and blamed on nothing.
    must = frozenset({"host_stalls"} if 1.0 < jump_s < 60.0 else ())
    about = f"clock set by {jump_s:+g} s"
    return Trouble("clock_set", about, nothing, may, must, 1.0, lasts_s=(0.0, 0.0))


def disk(name: str, code: int) -> Begin:
    """Return what begins that nothing can be written; `code` is the `errno`."""

    def begin(world: World, _chance: random.Random, _plain: bool) -> Trouble:
        world.disk_refuses = code

        def end() -> None:
            world.disk_refuses = None

        must = frozenset({"state_not_kept"})
        places = frozenset({"state", "calibration", "zeros"})
        return Trouble(
            name, name, end, set(must), must, 4.0, places=places, lingers=True, writes=True
        )

    return begin


def disk_slow(world: World, chance: random.Random, _: bool) -> Trouble:
    """Each file takes long; everything else goes on meanwhile. A connection to the broker begins
    with the files of its passwords and certificates, and events wait for it.
    """
    world.clock.threads_take_s = round(chance.uniform(0.1, 3.0), 2)

    def end() -> None:
        world.clock.threads_take_s = 0.0

    about = f"disk_slow {world.clock.threads_take_s:g} s"
    return Trouble("disk_slow", about, end, {"broker_away", "touches_dropped"})
