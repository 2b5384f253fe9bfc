"""What goes wrong, by name: each begins, lasts a while and ends.

A trouble has the codes that health may report for it, and the one that it must report if it lasts.
"""

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from emulator import faults
from emulator.probes.scene import Fault
from skin_host.bus.board import configuration
from skin_host.bus.commands import (
    SetBoardConfig,
    SetTriangleConfig,
    SetTxMode,
    TxMode,
    command_frame,
)
from skin_host.bus.port import LinkState
from skin_host.config.settings import Settings
from skin_host.evaluation.simulate.cables import Mischief
from skin_host.evaluation.simulate.disk import FULL, READ_ONLY
from skin_host.evaluation.simulate.world import Triangle, World
from skin_host.fingertip.frozen import REPEATS
from skin_host.health.describe import enough_rest
from skin_host.health.diagnosis import JITTER_SHARE
from skin_host.layout import PadKind
from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.stuck import CALIBRATED_SAMPLES, ODDS, longest_run, rate_in_run

Mask = NDArray[np.bool_]

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
    "triangle_answers_again",
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
#: Verdicts of a calibration that was taken meanwhile.
_CALIBRATED = {"taxel_refused", "taxel_saturates", "taxel_drifting", "taxel_at_limit"}
_DAMAGED = {"bus_bit_errors", "bus_stranger", "bus_babbling"}
_DAMAGED |= {"fingertip_saturated", "fingertip_held", "fingertip_noisy", "fingertip_unreached"}
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
#: A force/torque board that is not received, or not asked yet for its full scales.
_TIPS = {"fingertip_absent", "fingertip_silent", "fingertip_not_configured"}
_BUS = _TIMING | _SET_UP | _CHIPS | _TIPS
_BUS |= {"bus_silent", "board_overflows", "fingertip_incomplete", "fingertip_loses_frames"}
_SWAPPED = _CHIPS | _SET_UP | {"part_temperature"}
#: Until a calibration at rest.
FOR_EVER_S = 1e6
#: Health sees few intervals at a time: one that is as far as this beyond its limit is named.
SURE_SCATTER = 1.25
#: A pad is surely noisier than it was calibrated from so much noise on (rms in units of 2.88 fF),
#: and so many times what it had then; no fault is larger than the last.
SURE_NOISE_UNITS, SURE_NOISE, MOST_NOISE_UNITS = 5.0, 8.0, 20.0
#: By when so many frames of boards are damaged, all but one bus in ten thousand shows it: of one
#: triangle, at rest (docs/found.md).
SURE_DAMAGED = 36
#: Of many more it is named within this.
DAMAGED_S = 8.0
#: A bus that loses this share of its frames surely shows it.
SURE_LOSS = 0.02
#: Evidence of a touch is gone after 2.6 s in the mean, of a pad with noise of six units.
RECOVERS_S = 5.0
#: A temperature pad that reads bytes of another chip moves the rests of its triangle. They go back
#: as its temperature does, which is smoothed over 10 s: one that had moved by 2.7 units took 11 s.
RESTS_AGAIN_S = 20.0
#: A broker ends the connection of a client from which nothing came for longer.
KEEP_ALIVE_S = 10.0
#: Pauses between the commands of another host: an MTB3 misses what comes while it zeroes itself.
OTHER_HOST_S = (0.005, 0.05, 0.2)
#: While it lasts, the chip that it names does not measure.
SILENCING = {"chip_gone"}
#: A pad may have moved less than most, so it may repeat itself so often before it is surely stuck.
LEAST_REPEATS = 400
#: Nothing but the chip that it names sends what is wrong.
ALONE = {"no_acknowledge"}
_BROKER = {"broker_away", "touches_dropped", "broker_refuses", "node_name_taken", "broker_rejects"}
_BROKER |= {"broker_withholds"}


def _nothing() -> None:
    """It is over already."""


def _always() -> bool:
    """It shows."""
    return True


@dataclass
class Trouble:
    """Something that goes wrong now.

    Attributes:
        name: its kind.
        about: the same with its target, for people.
        end: ends it.
        may: codes that health may report because of it, at `places`.
        must: codes of which health must report one, once it has lasted for `within_s`; what
            happens at once must be reported within that time.
        places: names of buses, boards and parts; None is everywhere.
        blind: triangles that do not measure meanwhile.
        spoils: bool[n], taxels whose values may be wrong meanwhile, without anybody being able to
            know, and for `recovers_s` afterwards: so long the noisiest pads stay touched by what
            is over.
        lingers: what it did lasts until it is put right.
        writes: it shows only when something is written.
        shows: whether it differs so far, for the daemon, from what is no trouble.
        lasts_s: shortest and longest; no time at all for what happens at once.
        twice: the board at whose address a second one sends; once health has reported that, no
            taxel of it is valid.
    """

    name: str
    about: str
    end: Callable[[], object]
    may: set[str] = field(default_factory=set)
    must: frozenset[str] = frozenset()
    within_s: float = 3.0
    places: frozenset[str] | None = None
    blind: frozenset[Triangle] = frozenset()
    spoils: Mask | None = None
    recovers_s: float = RECOVERS_S
    lingers: bool = False
    writes: bool = False
    shows: Callable[[], bool] = _always
    lasts_s: tuple[float, float] = (0.2, 15.0)
    twice: str = ""

    def accuses(self, code: str, where: str) -> bool:
        """Whether health may report this because of it."""
        if code not in self.may:
            return False
        return self.places is None or where.partition("/")[0] in self.places


#: Takes the world, what draws target and strength, and whether it is to be so strong that health
#: must name it (if it must at any strength).
Begin = Callable[[World, random.Random, bool], Trouble]


def _triangle(world: World, chance: random.Random) -> Triangle:
    board = chance.choice(world.layout.boards)
    return board.name, chance.choice(board.triangles)


def places_of(world: World, *, board: str = "", bus: str = "") -> frozenset[str]:
    """Return a board, or all of a bus, with what depends on it: names that health may blame."""
    layout = world.layout
    boards = [
        (number, one)
        for number, one in enumerate(layout.boards)
        if one.name == board or one.settings.bus == bus
    ]
    numbers = {number for number, _ in boards}
    parts = {part.name for part in layout.parts if numbers & set(part.boards)}
    buses = {one.settings.bus for _, one in boards}
    tips = {name for name, tip in world.settings.fingertips.items() if tip.bus == bus}
    return frozenset({one.name for _, one in boards} | parts | tips | buses | ({bus} - {""}))


def taxels_of(world: World, *, board: str = "", bus: str = "") -> Mask:
    """Return the taxels bool[n] of a board, or of all of a bus."""
    found = np.zeros(world.layout.n_taxels, np.bool_)
    for one in world.layout.boards:
        if one.name == board or one.settings.bus == bus:
            found[one.taxel_index[one.taxel_index >= 0]] = True
    return found


def _emulated(
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
) -> Begin:
    """A fault of the emulator's catalogue, with targets and value drawn.

    Args:
        name: of it.
        may, must, within_s, spoils, recovers_s, lingers, lasts_s: see `Trouble`.
        values: least and most of its value.
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
        value = None if values is None else round(chance.uniform(*values), 4)
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
            surely = _noise_that_shows(world, board, triangle, int(str(targets["taxel"])))
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
        if name == "board_reset" and _is_set_up_unseen(world, board):
            # It reports no uptime, and command 50 starts it: nothing shows what it lost.
            spoiled, lasting_s = taxels_of(world, board=board), FOR_EVER_S
        places = None
        if "board" in targets:
            places = places_of(world, board=board)
        elif "bus" in targets:
            places = places_of(world, bus=bus)
        about = " ".join([name, *(f"{key}={value}" for key, value in targets.items())])
        shows, bound_s = _always, within_s
        if name == "stuck_taxel":
            pad = int(str(targets["taxel"]))
            bound_s = max(within_s, _longest_chance_s(world, board, triangle, pad))
        elif name == "bit_errors" and value is not None:
            bound_s, shows = _until_damage_shows_s(world, bus, value), _rests(world, bus)
        elif name == "jittered_period":
            shows = _scatters(world, board)
        elif name == "temperature_step" and value is not None and value > 0.0:
            shows = _differs_from_a_load(world)
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
        )

    return begin


def _mixed(name: str, may: set[str], must: set[str]) -> Begin:
    """A fault of the emulator's catalogue that sends bytes of another chip, or register."""
    return _emulated(name, may, must, 1.0, spoils=True, recovers_s=RESTS_AGAIN_S)


def _is_set_up_unseen(world: World, board: str) -> bool:
    """Return whether a board is an MTB3 that the daemon may be setting up now."""
    own = world.settings.boards[board]
    if world.life is None or own.model != "mtb3":
        return False
    link = world.life.daemon.link.boards
    return own.bus not in link or link[own.bus].records[own.address].busy is not None


def _taxel_of(world: World, board: str, triangle: int, pad: int) -> int:
    where = next(one for one in world.layout.boards if one.name == board)
    return int(where.taxel_index[triangle, pad])


def _noise_that_shows(world: World, board: str, triangle: int, pad: int) -> float:
    """Return from how much noise on (rms in units of 2.88 fF) a pad is noisier than it was
    calibrated: on real skin some are calibrated with six units.
    """
    calibration = None if world.life is None else world.life.daemon.engine.calibration
    if calibration is None:
        return SURE_NOISE_UNITS
    taxel = _taxel_of(world, board, triangle, pad)
    if not calibration.usable[taxel]:
        return math.inf
    return max(SURE_NOISE_UNITS, SURE_NOISE * float(calibration.noise[taxel]))


def _longest_chance_s(world: World, board: str, triangle: int, pad: int) -> float:
    """Return for how long a pad that works may send the same byte (s): very long, if its noise is
    small beside one unit and it rests in the middle of a byte.

    A calibration finds too much noise in such a pad at the edge of a byte, or too little in its
    middle.
    """
    taxel = _taxel_of(world, board, triangle, pad)
    own_units = float(world.robot.skin.noise_ff[taxel] / world.layout.unit_ff[taxel])
    noise_units = math.hypot(own_units, 12**-0.5)
    calibration = None if world.life is None else world.life.daemon.engine.calibration
    if calibration is not None:
        noise_units = min(noise_units, float(calibration.noise[taxel]))
    rate = rate_in_run(np.array([noise_units]))
    conversions = max(float(longest_run(rate, CALIBRATED_SAMPLES, ODDS)[0]), LEAST_REPEATS)
    period_ms = world.settings.boards[board].period_ms
    return conversions * max(period_ms * 1e-3, CONVERSION_S)


def _scatters(world: World, board: str) -> Callable[[], bool]:
    """Return a function: whether a board's sweeps have been irregular on their bus since now. Those
    that are ready while more urgent ones pass begin when these have passed.
    """
    settings = next(one.settings for one in world.layout.boards if one.name == board)
    sent, since_ns = world.cables[settings.bus].sent, world.clock.monotonic_ns()
    sure_ms = SURE_SCATTER * JITTER_SHARE * settings.period_ms
    return lambda: sent.scatter_ms(settings.address, since_ns) > sure_ms


def _differs_from_a_load(world: World) -> Callable[[], bool]:
    """Return a function: whether readings that rise everywhere can be no load. Temperature pads
    show that, and pads that are not touched. Where all are, an even load reads the same.
    """
    layout = world.layout
    thermal = layout.pad_kind == PadKind.THERMAL

    def differs() -> bool:
        if world.life is None:
            return True
        engine = world.life.daemon.engine
        if engine.calibration is None:
            return True
        usable = engine.calibration.usable & ~thermal
        rests = usable.copy()
        for index, row in engine.ledger.row.items():
            felt = engine.intake.touched.get(row)
            if felt is not None:
                rests[layout.boards[index].taxel_index[felt]] = False
        parts = (slice(part.start, part.stop) for part in layout.parts)
        return any(thermal[part].any() or enough_rest(rests[part], usable[part]) for part in parts)

    return differs


def _until_damage_shows_s(world: World, bus: str, share: float) -> float:
    """Return by when it must be known that a bus damages a share of its frames (s)."""
    frames_hz = sum(
        2 * len(board.triangles) * 1000 / board.settings.period_ms
        for board in world.layout.boards
        if board.settings.bus == bus
    )
    return max(DAMAGED_S, SURE_DAMAGED / (share * frames_hz)) if frames_hz else math.inf


def _rests(world: World, bus: str) -> Callable[[], bool]:
    """Return a function: whether nothing touches a bus. What jumps in a touch may be real skin."""
    return lambda: (
        world.life is None
        or not any(
            world.layout.boards[index].settings.bus == bus
            for index, row in world.life.daemon.engine.ledger.row.items()
            if row in world.life.daemon.engine.intake.touched
        )
    )


def _frames(
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

        bound_s, shows = 8.0, _always
        if name == "damaged":
            bound_s = _until_damage_shows_s(world, cable.name, share)
            shows = _rests(world, cable.name)
        is_sure = share >= sure and bound_s < math.inf
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


def _light_loss(world: World, chance: random.Random, _: bool) -> Trouble:
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
        _BUS | {"part_temperature"},
        frozenset({"bus_loses_frames"} if max(shares.values()) >= SURE_LOSS else ()),
        8.0,
        lasts_s=(60.0, 150.0),
    )


def _other_host(world: World, chance: random.Random, _: bool) -> Trouble:
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
        _nothing,
        _SET_UP | _CHIPS | _TIMING | {"bus_silent"},
        places=places_of(world, board=board.name),
        lasts_s=(0.0, 0.0),
    )


def _address_twice(world: World, chance: random.Random, _: bool) -> Trouble:
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
        _TIMING | _SET_UP | {"board_twice", "taxel_unproven", "taxel_stuck"},
        frozenset({"board_twice"}),
        5.0,
        places_of(world, board=board.name),
        # One measurement comes in two sweeps, and so may noise: twice is enough for a touch.
        spoils=taxels_of(world, board=board.name),
        twice=board.name,
    )


def _interface(name: str, state: LinkState, must: str) -> Begin:
    def begin(world: World, chance: random.Random, _: bool) -> Trouble:
        cable = world.cables[chance.choice(list(world.cables))]
        cable.set_state(state)
        about = f"{name} bus={cable.name}"
        may = _BUS | {must}
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


#: What a buffer or the queue of events has no room for meanwhile is lost, and counted. What waits
#: in them accuses nobody.
_STALLED = {"host_stalls", "bus_drops", "touches_dropped"}
#: How long stalls last, times `_STALL_SHARES`; no stall lasts for longer, nor does what passes wait
#: to be read.
_STALLS_S, _LONG_STALLS_S = (0.05, 0.2, 0.5, 1.5, 4.0), (1.5, 4.0)
_STALL_SHARES = (0.8, 1.2)
LONGEST_STALL_S = math.ceil(max(_STALLS_S) * max(_STALL_SHARES))


def _stall(world: World, chance: random.Random, plain: bool) -> Trouble:
    seconds = chance.choice(_LONG_STALLS_S if plain else _STALLS_S)
    seconds *= chance.uniform(*_STALL_SHARES)
    world.clock.advance(seconds)
    must = frozenset({"host_stalls"} if seconds > 0.7 else ())
    about = f"stall {seconds:.2f} s"
    return Trouble("stall", about, _nothing, _STALLED, must, 1.0, lasts_s=(0.0, 0.0))


def _suspended(world: World, chance: random.Random, _: bool) -> Trouble:
    """The computer sleeps: its adapters receive nothing, monotonic time stops, brokers go on."""
    seconds = round(chance.uniform(2.0, 20.0), 1)
    world.suspend(seconds)
    if seconds > KEEP_ALIVE_S:
        world.broker.disconnect_all(accusing=False)
    about = f"suspended {seconds:g} s"
    must = frozenset({"host_stalls"})
    may = _STALLED | _BROKER
    return Trouble("suspended", about, _nothing, may, must, 1.0, lasts_s=(0.0, 0.0))


def _set_clock(world: World, chance: random.Random, plain: bool) -> Trouble:
    jump_s = chance.choice((-3600.0, -2.0, -0.3, -0.02, 0.02, 0.3, 2.0, 3600.0))
    if plain:
        jump_s = 2.0
    world.move()
    world.clock.set(jump_s)
    may = {"host_stalls"}
    # Time set by more than a minute is recognised as that and blamed on nothing.
    must = frozenset({"host_stalls"} if 1.0 < jump_s < 60.0 else ())
    about = f"clock set by {jump_s:+g} s"
    return Trouble("clock_set", about, _nothing, may, must, 1.0, lasts_s=(0.0, 0.0))


_AWAY = frozenset({"broker_away"})
_BROKER_PLACES = frozenset({"broker"})


def _broker_absent(world: World, chance: random.Random, _: bool) -> Trouble:
    forget = chance.random() < 0.5
    world.broker.stop(forget=forget)

    def end() -> None:
        world.broker.absent = False

    about = f"broker_absent forgets={forget}"
    return Trouble("broker_absent", about, end, _BROKER, _AWAY, 1.0, _BROKER_PLACES)


def _broker_frozen(world: World, _chance: random.Random, _plain: bool) -> Trouble:
    world.broker.set_frozen(frozen=True)

    def end() -> None:
        world.broker.set_frozen(frozen=False)

    return Trouble("broker_frozen", "broker_frozen", end, _BROKER, _AWAY, 6.0, _BROKER_PLACES)


def _broker_refuses(world: World, _chance: random.Random, _plain: bool) -> Trouble:
    world.broker.refuses = True
    world.broker.disconnect_all(accusing=False)

    def end() -> None:
        world.broker.refuses = False

    return Trouble("broker_refuses", "broker_refuses", end, _BROKER, _AWAY, 1.0, _BROKER_PLACES)


def _broker_disconnects(world: World, chance: random.Random, _: bool) -> Trouble:
    accusing = chance.random() < 0.3
    world.broker.disconnect_all(accusing=accusing)
    about = f"broker_disconnects accusing={accusing}"
    return Trouble(
        "broker_disconnects",
        about,
        _nothing,
        _BROKER,
        places=_BROKER_PLACES,
        lasts_s=(0.0, 0.0),
    )


def _broker_doubles(world: World, _chance: random.Random, _plain: bool) -> Trouble:
    world.broker.doubles = True

    def end() -> None:
        world.broker.doubles = False

    return Trouble("broker_doubles", "broker_doubles", end)


def _disk(name: str, code: int) -> Begin:
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


def _board_latched(world: World, chance: random.Random, _: bool) -> Trouble:
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


def _disk_slow(world: World, chance: random.Random, _: bool) -> Trouble:
    """Each file takes long; everything else goes on meanwhile. A connection to the broker begins
    with the files of its passwords and certificates, and events wait for it.
    """
    world.clock.threads_take_s = round(chance.uniform(0.1, 3.0), 2)

    def end() -> None:
        world.clock.threads_take_s = 0.0

    about = f"disk_slow {world.clock.threads_take_s:g} s"
    return Trouble("disk_slow", about, end, {"broker_away", "touches_dropped"})


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
        _nothing,
        _SWAPPED | {"bus_bit_errors"},
        places=places_of(world, board=name),
        spoils=spoiled,
        recovers_s=FOR_EVER_S,
    )


def act(name: str) -> Trouble:
    """An act of an operator or systemd, and what health may report for it."""
    return Trouble(name, name, _nothing, ACTS[name], lasts_s=(0.0, 0.0))


#: A board that is zeroed: its pads are not valid until its new zero is known.
_ZEROED = {"board_rezeroed", "board_in_doubt", "taxel_unproven"}
#: What health may report after these acts, which are not faults.
ACTS: dict[str, set[str]] = {
    # What the broker and the boards do not know yet; a board that just stopped must be queried.
    "start": _ZEROED
    | _TIPS
    | {"broker_away", "bus_silent", "board_absent", "board_silent", "board_lost_set_up"}
    | {"triangle_missing", "bus_loses_frames"},
    "calibrate": _CALIBRATED | {"taxel_pressed"},
    "configure": _ZEROED
    | _TIPS
    | {"bus_silent", "board_silent", "triangle_missing", "bus_loses_frames"},
    "disable": {"part_disabled"},
    "power": _SET_UP | _CHIPS | _TIMING | {"bus_silent"},
    "enable": set(),
    "thresholds": set(),
    "reload": set(),
}

_LINE = {"line_shorted", "triangle_no_ack", "triangle_not_connected"}
#: A chip that does not answer may show in one sweep only, which may pass between two looks of
#: health: then its board zeroes itself, and what follows does not show it.
_UNANSWERED = _LINE | {"triangle_silenced"}
_WRONG_BITS = _LINE | {"board_rezeroed", "bus_bit_errors", "taxel_out_of_range"}
_SILENCED = {"triangle_silenced", "triangle_answers_again"}
_WRONG_BITS |= {"triangle_out_of_range", *_SILENCED}
_ELSEWHERE = {"triangle_not_connected", "triangle_out_of_range", "taxel_out_of_range"}

KINDS: dict[str, Begin] = {
    "chip_gone": _emulated("chip_gone", _CHIPS | _SET_UP, {"triangle_not_connected"}, 1.0),
    # It may stay as it was pressed, until repeats are no chance any more.
    "stuck_taxel": _emulated(
        "stuck_taxel", {"taxel_stuck", "taxel_unproven"}, {"taxel_stuck"}, 20, spoils=True
    ),
    "noisy_taxel": _emulated(
        "noisy_taxel",
        {"taxel_noisy", "taxel_unproven", "bus_bit_errors", *_CALIBRATED},
        {"taxel_noisy"},
        4.0,
        spoils=True,
    ),
    "shorted_finger": _emulated("shorted_finger", _CHIPS | _SET_UP, _UNANSWERED, 1.0),
    # Where two chips drive one data line, their bytes mix, differently in each sweep.
    "wrong_address": _mixed("wrong_address", _SWAPPED | {"bus_bit_errors"}, _ELSEWHERE),
    "swapped_lines": _mixed("swapped_lines", _SWAPPED, _ELSEWHERE | _LINE | {"lines_swapped"}),
    "shared_address": _mixed("shared_address", _SWAPPED | {"bus_bit_errors"}, _ELSEWHERE),
    "no_acknowledge": _mixed("no_acknowledge", _SWAPPED, _UNANSWERED),
    "data_held_low": _emulated(
        "data_held_low",
        _CHIPS | _SET_UP,
        # In the middle of a reading it turns one pad's bytes into ones and changes nothing besides.
        _LINE | _SILENCED | {"board_in_doubt"},
        1.0,
        spoils=True,
    ),
    "clock_stretched": _emulated("clock_stretched", _SWAPPED, _ELSEWHERE | _LINE, 1.0, spoils=True),
    # What a wrong bit does to a reading, or to the board that takes it for a missing chip.
    "bit_flipped": _emulated(
        "bit_flipped", _SWAPPED | {"bus_bit_errors"}, _WRONG_BITS, 4.0, spoils=True
    ),
    "slow_rise": _emulated(
        "slow_rise", _SWAPPED | {"bus_bit_errors"}, _WRONG_BITS, 4.0, spoils=True
    ),
    "brown_out": _emulated(
        "brown_out",
        _SWAPPED,
        _ELSEWHERE | _LINE,
        1.0,
        spoils=True,
        recovers_s=FOR_EVER_S,
        lingers=True,
        lasts_s=(0.0, 0.0),
    ),
    "board_reset": _emulated(
        "board_reset",
        _SET_UP | _CHIPS | _TIMING | {"bus_silent"},
        {"board_silent", "board_reset", "bus_silent"},
        2.0,
        lasts_s=(0.0, 0.0),
    ),
    "board_silent": _emulated(
        "board_silent",
        _SET_UP | _CHIPS | _TIMING | {"bus_silent"},
        {"board_silent", "bus_silent"},
        2.0,
    ),
    "late_period": _emulated(
        "late_period",
        _TIMING | _SET_UP | _CHIPS | {"bus_silent"},  # it is set up again, and silent meanwhile
        {"board_period"},
        4.0,
        values=(3.0, 40.0),
    ),
    "jittered_period": _emulated(
        "jittered_period",
        _TIMING | _SET_UP | _CHIPS,
        {"board_jitter", "board_period"},
        4.0,
        values=(2.0, 8.0),
        sure=6.0,
    ),
    "frame_loss": _emulated("frame_loss", _BUS, {"bus_loses_frames"}, 5.0, values=(0.01, 0.3)),
    "bit_errors": _emulated(
        "bit_errors",
        _BUS | _DAMAGED,
        {"bus_bit_errors"},
        values=(0.0005, 0.05),
        sure=0.02,
        spoils=True,
    ),
    "bus_off": _emulated("bus_off", _BUS, {"bus_silent"}, 2.0),
    "babbling_node": _emulated(
        "babbling_node",
        _BUS | {"bus_babbling", "bus_drops"},
        {"bus_babbling"},
        2.0,
        lasts_s=(0.5, 3.0),  # thousands of frames a second cost what minutes of others do
    ),
    "temperature_step": _emulated(
        "temperature_step",
        {"part_temperature", "bus_bit_errors"} | _TAXELS,
        {"part_temperature"},
        3.0,
        values=(-4.0, 4.0),
        # Where bytes are coarse the next lower one of a temperature pad must still show it.
        sure=3.8,
        spoils=True,
        recovers_s=60.0,
    ),
    "frames_lost": _frames("lost", _BUS, 0.5, must="bus_loses_frames", sure=SURE_LOSS),
    "frames_late": _frames("late", _BUS, 0.2),
    "frames_doubled": _frames("doubled", _BUS, 0.2),
    "frames_swapped": _frames("swapped", _BUS, 0.5),
    "frames_damaged": _frames(
        "damaged", _BUS | _DAMAGED, 0.05, must="bus_bit_errors", sure=0.02, spoils=True
    ),
    "address_twice": _address_twice,
    "adapter_gone": _interface("adapter_gone", LinkState.GONE, "bus_gone"),
    "link_down": _interface("link_down", LinkState.DOWN, "bus_down"),
    "stall": _stall,
    "suspended": _suspended,
    "clock_set": _set_clock,
    "broker_absent": _broker_absent,
    "broker_frozen": _broker_frozen,
    "broker_refuses": _broker_refuses,
    "broker_disconnects": _broker_disconnects,
    "broker_doubles": _broker_doubles,
    "disk_full": _disk("disk_full", FULL),
    "disk_read_only": _disk("disk_read_only", READ_ONLY),
    "disk_slow": _disk_slow,
}
#: Storms and drills draw none of these: what lasts for longer than a storm has a time of its own,
#: and another host comes in a rehearsal.
APART: dict[str, Begin] = {"light_loss": _light_loss, "other_host": _other_host}
#: Those of robots with fingertips alone: what other robots draw does not depend on them.
OF_FINGERTIPS: dict[str, Begin] = {"board_latched": _board_latched}


def kinds_of(settings: Settings) -> dict[str, Begin]:
    """Return the kinds of trouble that a robot can have."""
    return KINDS | OF_FINGERTIPS if settings.fingertips else KINDS
