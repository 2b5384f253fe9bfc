"""Troubles of the broker."""

import random

from skin_host.evaluation.simulate.troubles.codes import BROKER
from skin_host.evaluation.simulate.troubles.trouble import Trouble, nothing
from skin_host.evaluation.simulate.world import World

_AWAY = frozenset({"broker_away"})
_BROKER_PLACES = frozenset({"broker"})


def broker_absent(world: World, chance: random.Random, _: bool) -> Trouble:
    """It goes away, and may forget what is retained."""
    forget = chance.random() < 0.5
    world.broker.stop(forget=forget)

    def end() -> None:
        world.broker.absent = False

    about = f"broker_absent forgets={forget}"
    return Trouble("broker_absent", about, end, BROKER, _AWAY, 1.0, _BROKER_PLACES)


def broker_frozen(world: World, _chance: random.Random, _plain: bool) -> Trouble:
    """It answers nothing, and goes on later with all that came meanwhile."""
    world.broker.set_frozen(frozen=True)

    def end() -> None:
        world.broker.set_frozen(frozen=False)

    return Trouble("broker_frozen", "broker_frozen", end, BROKER, _AWAY, 6.0, _BROKER_PLACES)


def broker_refuses(world: World, _chance: random.Random, _plain: bool) -> Trouble:
    """It ends every connection, and takes none."""
    world.broker.refuses = True
    world.broker.disconnect_all(accusing=False)

    def end() -> None:
        world.broker.refuses = False

    return Trouble("broker_refuses", "broker_refuses", end, BROKER, _AWAY, 1.0, _BROKER_PLACES)


def broker_disconnects(world: World, chance: random.Random, _: bool) -> Trouble:
    """It ends every connection once, for no reason that it gives or as if over a publication."""
    accusing = chance.random() < 0.3
    world.broker.disconnect_all(accusing=accusing)
    about = f"broker_disconnects accusing={accusing}"
    return Trouble(
        "broker_disconnects",
        about,
        nothing,
        BROKER,
        places=_BROKER_PLACES,
        lasts_s=(0.0, 0.0),
    )


def broker_doubles(world: World, _chance: random.Random, _plain: bool) -> Trouble:
    """Subscribers get each message twice."""
    world.broker.doubles = True

    def end() -> None:
        world.broker.doubles = False

    return Trouble("broker_doubles", "broker_doubles", end)
