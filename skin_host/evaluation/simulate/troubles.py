"""What goes wrong, by name: each begins, lasts a while and ends.

A trouble has the codes that health may report for it, and the one that it must report if it lasts.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass, field

from emulator import faults
from emulator.probes.scene import Fault
from skin_host.bus.port import LinkState
from skin_host.evaluation.simulate.cables import Mischief
from skin_host.evaluation.simulate.disk import FULL, READ_ONLY
from skin_host.evaluation.simulate.world import World

Triangle = tuple[str, int]

_TAXELS = {
    "taxel_out_of_range",
    "taxel_noisy",
    "taxel_stuck",
    "taxel_drifting",
    "taxel_at_limit",
    "taxel_held",
    "taxel_refused",
    "taxel_pressed",
    "taxel_saturates",
    "taxel_unproven",
}
_TRIANGLES = {
    "triangle_not_connected",
    "triangle_no_ack",
    "triangle_silenced",
    "triangle_frozen",
    "triangle_constant",
    "triangle_missing",
    "triangle_out_of_range",
    "line_shorted",
    "lines_swapped",
}
#: A board that is set up again, and what it may have done to need that.
_SET_UP = {
    "board_absent",
    "board_in_doubt",
    "board_lost_set_up",
    "board_reset",
    "board_rezeroed",
    "board_silent",
}
_TIMING = {"board_jitter", "board_period", "bus_loses_frames"}
_CHIPS = _TAXELS | _TRIANGLES
#: They change which chip answers where: what ends one would undo another.
WIRING = {"chip_gone", "shorted_finger", "wrong_address", "swapped_lines"}
_BUS = _TIMING | _SET_UP | _CHIPS | {"bus_silent", "board_overflows"}
_SWAPPED = _CHIPS | _SET_UP | {"part_temperature"}
_BROKER = {"broker_away", "touches_dropped", "broker_refuses", "node_name_taken", "broker_rejects"}


@dataclass
class Trouble:
    """Something that goes wrong now.

    Attributes:
        name: its kind.
        about: the same with its target, for people.
        end: ends it.
        may: codes that health may report because of it.
        must: a code that health must report, once it has lasted for `within_s`.
        blind: triangles that do not measure meanwhile.
        spoils: values may be wrong meanwhile, without anybody being able to know.
        lingers: what it did lasts until it is put right.
        lasts_s: shortest and longest; no time at all for what happens at once.
    """

    name: str
    about: str
    end: Callable[[], object]
    may: set[str] = field(default_factory=set)
    must: str | None = None
    within_s: float = 3.0
    blind: frozenset[Triangle] = frozenset()
    spoils: bool = False
    lingers: bool = False
    lasts_s: tuple[float, float] = (0.2, 15.0)


Begin = Callable[[World, random.Random], Trouble]


def _nothing() -> None:
    """It is over already."""


def _triangle(world: World, chance: random.Random) -> Triangle:
    board = chance.choice(world.layout.boards)
    return board.name, chance.choice(board.triangles)


def _emulated(
    name: str,
    may: set[str],
    must: str | None,
    within_s: float = 3.0,
    *,
    spoils: bool = False,
    values: tuple[float, float] | None = None,
    lasts_s: tuple[float, float] = (0.2, 15.0),
) -> Begin:
    """A fault of the emulator's catalogue, with targets and value drawn."""

    def begin(world: World, chance: random.Random) -> Trouble:
        kind = faults.KINDS[name]
        targets: dict[str, object] = {}
        blind: frozenset[Triangle] = frozenset()
        board, triangle = _triangle(world, chance)
        if "board" in kind.needs:
            targets["board"] = board
        if "triangle" in kind.needs:
            targets["triangle"] = triangle
            blind = frozenset({(board, triangle)})
        if "taxel" in kind.needs:
            targets["taxel"] = chance.randrange(12)
            blind = frozenset()
        if "bus" in kind.needs:
            targets["bus"] = chance.choice(list(world.robot.wires))
        if values is not None:
            targets["value"] = round(chance.uniform(*values), 4)
        if name == "wrong_address":
            targets["value"] = float((triangle % 4 + chance.randrange(1, 4)) % 4)
        if name == "swapped_lines":
            targets["value"] = float((triangle // 4 + chance.randrange(1, 4)) % 4)
        if name in ("shorted_finger", "swapped_lines", "wrong_address"):
            blind = frozenset()
        world.move()
        mend = world.robot.inject(Fault(name=name, **targets))  # type: ignore[arg-type]

        def end() -> None:
            world.move()
            mend()

        about = " ".join([name, *(f"{key}={value}" for key, value in targets.items())])
        return Trouble(name, about, end, may, must, within_s, blind, spoils, lasts_s=lasts_s)

    return begin


def _frames(
    name: str, may: set[str], most: float, *, must: str | None = None, spoils: bool = False
) -> Begin:
    """Something that happens to frames between the bus and the daemon."""

    def begin(world: World, chance: random.Random) -> Trouble:
        cable = world.cables[chance.choice(list(world.cables))]
        share = round(chance.uniform(0.1, 1.0) * most, 4)
        world.move()
        setattr(cable.mischief, name, share)

        def end() -> None:
            world.move()
            setattr(cable.mischief, name, getattr(Mischief(), name))

        said = must if share > 0.02 else None
        about = f"frames_{name} bus={cable.name} share={share}"
        return Trouble(f"frames_{name}", about, end, may, said, 4.0, spoils=spoils)

    return begin


def _interface(name: str, state: LinkState, must: str) -> Begin:
    def begin(world: World, chance: random.Random) -> Trouble:
        cable = world.cables[chance.choice(list(world.cables))]
        cable.set_state(state)
        about = f"{name} bus={cable.name}"
        may = _BUS | {must, "bus_gone", "bus_down", "bus_off", "bus_errors", "host_stalls"}
        return Trouble(name, about, lambda: cable.set_state(LinkState.UP), may, must)

    return begin


def _stall(world: World, chance: random.Random) -> Trouble:
    seconds = chance.choice((0.05, 0.2, 0.5, 1.5, 4.0)) * chance.uniform(0.8, 1.2)
    world.clock.advance(seconds)
    may = _BUS | _BROKER | {"host_stalls", "bus_drops"}
    return Trouble("stall", f"stall {seconds:.2f} s", _nothing, may, lasts_s=(0.0, 0.0))


def _set_clock(world: World, chance: random.Random) -> Trouble:
    jump_s = chance.choice((-3600.0, -2.0, -0.3, -0.02, 0.02, 0.3, 2.0, 3600.0))
    world.move()
    world.clock.set(jump_s)
    may = _BUS | {"host_stalls"}
    return Trouble("clock_set", f"clock set by {jump_s:+g} s", _nothing, may, lasts_s=(0.0, 0.0))


def _broker_absent(world: World, chance: random.Random) -> Trouble:
    forget = chance.random() < 0.5
    world.broker.stop(forget=forget)

    def end() -> None:
        world.broker.absent = False

    about = f"broker_absent forgets={forget}"
    return Trouble("broker_absent", about, end, _BROKER, "broker_away", 1.0)


def _broker_frozen(world: World, _: random.Random) -> Trouble:
    world.broker.set_frozen(frozen=True)

    def end() -> None:
        world.broker.set_frozen(frozen=False)

    return Trouble("broker_frozen", "broker_frozen", end, _BROKER, "broker_away", 6.0)


def _broker_refuses(world: World, _: random.Random) -> Trouble:
    world.broker.refuses = True
    world.broker.disconnect_all(accusing=False)

    def end() -> None:
        world.broker.refuses = False

    return Trouble("broker_refuses", "broker_refuses", end, _BROKER, "broker_away", 1.0)


def _broker_disconnects(world: World, chance: random.Random) -> Trouble:
    accusing = chance.random() < 0.3
    world.broker.disconnect_all(accusing=accusing)
    about = f"broker_disconnects accusing={accusing}"
    return Trouble("broker_disconnects", about, _nothing, _BROKER, lasts_s=(0.0, 0.0))


def _broker_doubles(world: World, _: random.Random) -> Trouble:
    world.broker.doubles = True

    def end() -> None:
        world.broker.doubles = False

    return Trouble("broker_doubles", "broker_doubles", end)


def _disk(name: str, code: int) -> Begin:
    def begin(world: World, _: random.Random) -> Trouble:
        world.disk_refuses = code

        def end() -> None:
            world.disk_refuses = None

        return Trouble(name, name, end, {"state_not_kept"}, lingers=True)

    return begin


def act(name: str) -> Trouble:
    """An act of an operator or systemd, and what health may report for it."""
    return Trouble(name, name, _nothing, ACTS[name], lasts_s=(0.0, 0.0))


#: What health may report after these acts, which are not faults.
ACTS: dict[str, set[str]] = {
    "start": _SET_UP | _TAXELS | {"broker_away", "bus_silent", "triangle_out_of_range"},
    "calibrate": {"taxel_pressed", "taxel_refused", "taxel_saturates", "state_not_kept"},
    "configure": _SET_UP | _TAXELS | {"bus_silent", "triangle_out_of_range"},
    "disable": {"part_disabled"},
    "enable": set(),
    "thresholds": set(),
    "reload": _SET_UP | _TAXELS | {"bus_silent", "triangle_out_of_range"},
}

KINDS: dict[str, Begin] = {
    "chip_gone": _emulated("chip_gone", _CHIPS | _SET_UP, "triangle_not_connected", 2.0),
    "stuck_taxel": _emulated("stuck_taxel", _CHIPS, None),
    "noisy_taxel": _emulated("noisy_taxel", _CHIPS, None, spoils=True),
    "shorted_finger": _emulated("shorted_finger", _CHIPS | _SET_UP, None),
    "wrong_address": _emulated("wrong_address", _SWAPPED, None, spoils=True),
    "swapped_lines": _emulated("swapped_lines", _SWAPPED, None, spoils=True),
    "board_reset": _emulated(
        "board_reset", _SET_UP | _CHIPS | _TIMING | {"bus_silent"}, None, lasts_s=(0.0, 0.0)
    ),
    "board_silent": _emulated(
        "board_silent", _SET_UP | _CHIPS | _TIMING | {"bus_silent"}, "board_silent", 2.0
    ),
    "late_period": _emulated(
        "late_period", _TIMING | _SET_UP | _CHIPS, "board_period", 4.0, values=(3.0, 40.0)
    ),
    "jittered_period": _emulated(
        "jittered_period", _TIMING | _SET_UP | _CHIPS, None, values=(2.0, 8.0)
    ),
    "frame_loss": _emulated("frame_loss", _BUS, "bus_loses_frames", 5.0, values=(0.01, 0.3)),
    "bit_errors": _emulated(
        "bit_errors",
        _BUS | {"bus_bit_errors", "bus_stranger", "bus_babbling"},
        None,
        values=(0.0005, 0.05),
        spoils=True,
    ),
    "bus_off": _emulated("bus_off", _BUS, "bus_silent", 2.0),
    "babbling_node": _emulated(
        "babbling_node",
        _BUS | {"bus_babbling", "bus_drops"},
        "bus_babbling",
        2.0,
        lasts_s=(0.5, 3.0),  # thousands of frames a second cost what minutes of others do
    ),
    "temperature_step": _emulated(
        "temperature_step",
        {"part_temperature", "bus_bit_errors"} | _TAXELS,
        None,
        values=(-4.0, 4.0),
        spoils=True,
    ),
    "frames_lost": _frames("lost", _BUS, 0.5, must="bus_loses_frames"),
    "frames_late": _frames("late", _BUS, 0.2),
    "frames_doubled": _frames("doubled", _BUS, 0.2),
    "frames_swapped": _frames("swapped", _BUS, 0.5),
    "frames_damaged": _frames(
        "damaged", _BUS | {"bus_bit_errors", "bus_stranger", "bus_babbling"}, 0.05, spoils=True
    ),
    "adapter_gone": _interface("adapter_gone", LinkState.GONE, "bus_gone"),
    "link_down": _interface("link_down", LinkState.DOWN, "bus_down"),
    "stall": _stall,
    "clock_set": _set_clock,
    "broker_absent": _broker_absent,
    "broker_frozen": _broker_frozen,
    "broker_refuses": _broker_refuses,
    "broker_disconnects": _broker_disconnects,
    "broker_doubles": _broker_doubles,
    "disk_full": _disk("disk_full", FULL),
    "disk_read_only": _disk("disk_read_only", READ_ONLY),
}
