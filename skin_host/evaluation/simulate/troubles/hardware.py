"""Troubles of chips, boards and skin: the faults of the emulator, with targets and strengths."""

import math
import random

import numpy as np

from emulator import faults
from emulator.probes.scene import Fault
from skin_host.evaluation.simulate.troubles.codes import SWAPPED
from skin_host.evaluation.simulate.troubles.showing import (
    MOST_NOISE_UNITS,
    is_set_up_unseen,
    longest_chance_s,
    noise_that_shows,
    rests,
    scatters,
    temperature_shows,
    until_damage_shows_s,
    until_loss_shows_s,
)
from skin_host.evaluation.simulate.troubles.trouble import (
    FOR_EVER_S,
    RECOVERS_S,
    Begin,
    Mask,
    Trouble,
    always,
    nothing,
    places_of,
    taxels_of,
)
from skin_host.evaluation.simulate.world import Triangle, World
from skin_host.fingertip.frozen import REPEATS
from skin_host.layout import PadKind

#: They change which chip answers where: what ends one would undo another.
WIRING = {
    "chip_gone",
    "shorted_finger",
    "wrong_address",
    "swapped_lines",
    "shared_address",
    "no_acknowledge",
    "data_held_low",
    "clock_stretched",
    "bit_flipped",
    "slow_rise",
    "brown_out",
}
#: A temperature pad that reads bytes of another chip moves the rests of its triangle. They go back
#: as its temperature does, which is smoothed over 10 s: one that had moved by 2.7 units took 11 s.
RESTS_AGAIN_S = 20.0
#: While it lasts, the chip that it names does not measure.
SILENCING = {"chip_gone"}
#: Nothing but the chip that it names sends what is wrong.
ALONE = {"no_acknowledge"}


def _triangle(world: World, chance: random.Random) -> Triangle:
    board = chance.choice(world.layout.boards)
    return board.name, chance.choice(board.triangles)


def emulated(
    name: str,
    may: set[str],
    must: set[str],
    within_s: float = 3.0,
    *,
    spoils: bool = False,
    recovers_s: float = RECOVERS_S,
    values: tuple[float, float] | None = None,
    sure: float = 0.0,
    lingers: bool = False,
    lasts_s: tuple[float, float] = (0.2, 15.0),
    lasting: frozenset[str] = frozenset(),
) -> Begin:
    """A fault of the emulator's catalogue, with targets and value drawn.

    Args:
        name: of it.
        may, must, within_s, spoils, recovers_s, lingers, lasts_s, lasting: see `Trouble`.
        values: least and most of its value, of which what is out of the catalogue's bounds is put
            on them.
        sure: from this value on, it must be reported.
    """

    def begin(world: World, chance: random.Random, plain: bool) -> Trouble:
        kind = faults.KINDS[name]
        targets: dict[str, object] = {}
        blind: frozenset[Triangle] = frozenset()
        board, triangle = _triangle(world, chance)
        bus = chance.choice(list(world.robot.wires))
        if "board" in kind.needs:
            targets["board"] = board
        if "triangle" in kind.needs:
            targets["triangle"] = triangle
            if name in SILENCING:
                blind = frozenset({(board, triangle)})
        if "taxel" in kind.needs:
            targets["taxel"] = chance.randrange(12)
        if "bus" in kind.needs:
            targets["bus"] = bus
        value = None
        if values is not None and kind.bounds is not None:
            value = round(min(max(chance.uniform(*values), kind.bounds[0]), kind.bounds[1]), 4)
        if plain and value is not None and values is not None and abs(value) < sure:
            value = round(chance.uniform(sure, values[1]), 4)
        if name == "data_held_low" and plain:
            # Nine clocks, the catalogue's, may meet bits that are low anyway.
            value = 0.0
        if name in ("wrong_address", "shared_address"):
            value = float((triangle % 4 + chance.randrange(1, 4)) % 4)
        if name == "swapped_lines":
            value = float((triangle // 4 + chance.randrange(1, 4)) % 4)
        surely = sure
        if name == "noisy_taxel":
            surely = noise_that_shows(world, board, triangle, int(str(targets["taxel"])))
            value = round(min(surely, MOST_NOISE_UNITS), 4) if plain else None
        if value is not None:
            targets["value"] = value
        world.move()
        mend = world.robot.inject(Fault(name=name, **targets))  # type: ignore[arg-type]

        def end() -> None:
            world.move()
            mend()

        spoiled: Mask | None = None
        if spoils and "board" in targets:
            spoiled = taxels_of(world, board=board)
            if "taxel" in targets or name in ALONE:
                number = next(one for one in world.layout.boards if one.name == board)
                taxels = number.taxel_index[triangle]
                if "taxel" in targets:
                    taxel = taxels[[int(str(targets["taxel"]))]]
                    # A board takes what its temperature pad reads off all pads of the triangle.
                    warms = world.layout.pad_kind[taxel] == PadKind.THERMAL
                    if not (name == "noisy_taxel" and warms.any() and (taxel >= 0).all()):
                        taxels = taxel
                spoiled = np.zeros_like(spoiled)
                spoiled[taxels[taxels >= 0]] = True
        elif spoils:
            spoiled = (
                taxels_of(world, bus=bus)
                if "bus" in targets
                else np.ones(world.layout.n_taxels, np.bool_)
            )
        if name == "brown_out":
            world.unpowered.add(board)
        lasting_s = recovers_s
        if name == "board_reset" and is_set_up_unseen(world, board):
            # It reports no uptime, and command 50 starts it: nothing shows what it lost.
            spoiled, lasting_s = taxels_of(world, board=board), FOR_EVER_S
        places = None
        if "board" in targets:
            places = places_of(world, board=board)
        elif "bus" in targets:
            places = places_of(world, bus=bus)
        about = " ".join([name, *(f"{key}={value}" for key, value in targets.items())])
        shows, bound_s = always, within_s
        if name == "stuck_taxel":
            pad = int(str(targets["taxel"]))
            bound_s = max(within_s, longest_chance_s(world, board, triangle, pad))
        elif name == "frame_loss" and value is not None:
            bound_s, surely = until_loss_shows_s(world, bus, value), 0.0
        elif name == "bit_errors" and value is not None:
            bound_s, shows = until_damage_shows_s(world, bus, value), rests(world, bus)
        elif name == "jittered_period":
            shows = scatters(world, board)
        elif name == "temperature_step":
            shows = temperature_shows(world)
        strength = kind.value if value is None else value
        is_sure = (strength is None or abs(strength) >= surely) and bound_s < math.inf
        return Trouble(
            name,
            about,
            end,
            may,
            frozenset(must) if is_sure else frozenset(),
            bound_s,
            places,
            blind,
            spoiled,
            lasting_s,
            lingers,
            shows=shows,
            lasts_s=lasts_s,
            lasting=lasting,
        )

    return begin


def mixed(name: str, may: set[str], must: set[str]) -> Begin:
    """A fault of the emulator's catalogue that sends bytes of another chip, or register."""
    return emulated(name, may, must, 1.0, spoils=True, recovers_s=RESTS_AGAIN_S)


def board_latched(world: World, chance: random.Random, _: bool) -> Trouble:
    """The board of a fingertip repeats its last sample, or only the force or torque of it."""
    name = chance.choice(list(world.settings.fingertips))
    fault = Fault(name="board_latched", board=name, value=float(chance.randrange(3)))
    world.move()
    mend = world.robot.inject(fault)

    def end() -> None:
        world.move()
        mend()

    return Trouble(
        "board_latched",
        f"board_latched board={name} value={fault.value:g}",
        end,
        # A zero of samples of which some were repeated is noisy, or of a load.
        {"fingertip_frozen", "fingertip_noisy", "fingertip_held", "fingertip_pressed"},
        frozenset({"fingertip_frozen"}),
        1e-3 * REPEATS * world.settings.fingertips[name].period_ms + 1.0,
        frozenset({name}),
    )


def damaged_set_up(world: World, place: Triangle) -> Trouble:
    """A chip does not measure what it should, because its set-up was damaged on its way.

    Bytes do not show which pads it measures, and its board writes its set-up after power-up only.
    """
    name, number = place
    spoiled = np.zeros(world.layout.n_taxels, np.bool_)
    spoiled[world.taxels(place)] = True
    return Trouble(
        "damaged_set_up",
        f"damaged_set_up board={name} triangle={number}",
        nothing,
        SWAPPED | {"bus_bit_errors"},
        places=places_of(world, board=name),
        spoils=spoiled,
        recovers_s=FOR_EVER_S,
    )
