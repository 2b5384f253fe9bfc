"""Troubles of buses, of what is sent over them, and of whoever else sends there."""

import math
import random
from dataclasses import replace

from skin_host.bus.board import configuration
from skin_host.bus.commands import (
    SetBoardConfig,
    SetTriangleConfig,
    SetTxMode,
    TxMode,
    command_frame,
)
from skin_host.bus.port import LinkState
from skin_host.evaluation.simulate.cables import Mischief
from skin_host.evaluation.simulate.troubles.codes import BUS, CHIPS, SET_UP, TIMING
from skin_host.evaluation.simulate.troubles.showing import (
    rests,
    until_damage_shows_s,
    until_loss_shows_s,
)
from skin_host.evaluation.simulate.troubles.trouble import (
    Begin,
    Trouble,
    always,
    nothing,
    places_of,
    taxels_of,
)
from skin_host.evaluation.simulate.world import World

#: A bus that loses this share of its frames shows it soon.
SURE_LOSS = 0.05
#: Pauses between the commands of another host: an MTB3 misses what comes while it zeroes itself.
OTHER_HOST_S = (0.005, 0.05, 0.2)


def frames(
    name: str,
    may: set[str],
    most: float,
    *,
    must: str | None = None,
    sure: float = 0.0,
    spoils: bool = False,
) -> Begin:
    """Something that happens to frames between the bus and the daemon."""

    def begin(world: World, chance: random.Random, plain: bool) -> Trouble:
        cable = world.cables[chance.choice(list(world.cables))]
        share = round(chance.uniform(0.1, 1.0) * most, 4)
        if plain and share < sure:
            share = round(chance.uniform(sure, most), 4)
        world.move()
        setattr(cable.mischief, name, share)

        def end() -> None:
            world.move()
            setattr(cable.mischief, name, getattr(Mischief(), name))

        bound_s, shows, surely = 8.0, always, sure
        if name == "lost":
            bound_s, surely = until_loss_shows_s(world, cable.name, share), 0.0
        elif name == "damaged":
            bound_s = until_damage_shows_s(world, cable.name, share)
            shows = rests(world, cable.name)
        is_sure = share >= surely and bound_s < math.inf
        return Trouble(
            f"frames_{name}",
            f"frames_{name} bus={cable.name} share={share}",
            end,
            may,
            frozenset({must}) if must is not None and is_sure else frozenset(),
            bound_s,
            places_of(world, bus=cable.name),
            spoils=taxels_of(world, bus=cable.name) if spoils else None,
            shows=shows,
        )

    return begin


def light_loss(world: World, chance: random.Random, _: bool) -> Trouble:
    """Every bus loses single frames, as those of real robots do all the time, for minutes."""
    world.move()
    shares = {name: round(chance.uniform(0.01, 0.05), 4) for name in world.cables}
    for name, share in shares.items():
        world.cables[name].mischief.lost = share

    def end() -> None:
        world.move()
        for cable in world.cables.values():
            cable.mischief.lost = 0.0

    return Trouble(
        "light_loss",
        " ".join(["light_loss", *(f"{name}={share}" for name, share in shares.items())]),
        end,
        # The temperature moves meanwhile.
        BUS | {"part_temperature"},
        frozenset({"bus_loses_frames"}),
        min(until_loss_shows_s(world, name, share) for name, share in shares.items()),
        lasts_s=(60.0, 150.0),
    )


def other_host(world: World, chance: random.Random, _: bool) -> Trouble:
    """Another program on the bus sets a board up: as the daemon does, or with another unit or
    period.
    """
    number = chance.randrange(len(world.layout.boards))
    board = world.layout.boards[number]
    mine = [triangle for triangle in world.layout.triangles if triangle.board == number]
    commands = [*configuration(board, mine), SetTxMode(TxMode.START)]
    otherwise = chance.choice(("", "shift", "period"))
    for at, command in enumerate(commands):
        if otherwise == "shift" and isinstance(command, SetTriangleConfig):
            commands[at] = replace(command, shift=command.shift - 1 if command.shift else 1)
        elif otherwise == "period" and isinstance(command, SetBoardConfig):
            commands[at] = replace(command, period_ms=2 * command.period_ms)
    pause_s = chance.choice(OTHER_HOST_S)
    cable = world.cables[board.settings.bus]
    for at, command in enumerate(commands):
        frame = command_frame(command, board.settings.address)
        world.clock.call_later(at * pause_s, cable.send_as_other_host, *frame)
    return Trouble(
        "other_host",
        f"other_host board={board.name} otherwise={otherwise or 'no'}",
        nothing,
        SET_UP | CHIPS | TIMING | {"bus_silent"},
        places=places_of(world, board=board.name),
        lasts_s=(0.0, 0.0),
    )


def address_twice(world: World, chance: random.Random, _: bool) -> Trouble:
    """A second board of the same address sends the same bus full of its own sweeps."""
    board = chance.choice(world.layout.boards)
    cable = world.cables[board.settings.bus]
    world.move()
    cable.mischief.twin = board.settings.address

    def end() -> None:
        world.move()
        cable.mischief.twin = None

    return Trouble(
        "address_twice",
        f"address_twice board={board.name}",
        end,
        # Each byte comes twice, which looks like one that stays for long.
        TIMING | SET_UP | {"board_twice", "taxel_unproven", "taxel_stuck"},
        frozenset({"board_twice"}),
        5.0,
        places_of(world, board=board.name),
        # One measurement comes in two sweeps, and so may noise: twice is enough for a touch.
        spoils=taxels_of(world, board=board.name),
        twice=board.name,
    )


def interface(name: str, state: LinkState, must: str) -> Begin:
    """Return what begins that a bus has another state; health must report `must`."""

    def begin(world: World, chance: random.Random, _: bool) -> Trouble:
        cable = world.cables[chance.choice(list(world.cables))]
        cable.set_state(state)
        about = f"{name} bus={cable.name}"
        may = BUS | {must}
        places = places_of(world, bus=cable.name)
        return Trouble(
            name,
            about,
            lambda: cable.set_state(LinkState.UP),
            may,
            frozenset({must}),
            3.0,
            places,
        )

    return begin
