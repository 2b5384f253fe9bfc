"""From when on a trouble surely shows: what is no trouble for the daemon may do the same."""

import math
from collections.abc import Callable

import numpy as np

from skin_host.bus.compensation import thermal_gains
from skin_host.evaluation.simulate.world import World
from skin_host.health.describe import enough_rest
from skin_host.health.diagnosis import FEW_HALVES, JITTER_SHARE
from skin_host.layout import PadKind
from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.stuck import CALIBRATED_SAMPLES, ODDS, longest_run, rate_in_run

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
#: Lost frames are named within this, or once no second with enough of them has only these odds.
LOST_S, ALL_HID = 5.0, 1e-4
#: A pad may have moved less than most, so it may repeat itself so often before it is surely stuck.
LEAST_REPEATS = 400


def is_set_up_unseen(world: World, board: str) -> bool:
    """Return whether a board is an MTB3 that the daemon may be setting up now."""
    own = world.settings.boards[board]
    if world.life is None or own.model != "mtb3":
        return False
    link = world.life.daemon.link.boards
    return own.bus not in link or link[own.bus].records[own.address].busy is not None


def _taxel_of(world: World, board: str, triangle: int, pad: int) -> int:
    where = next(one for one in world.layout.boards if one.name == board)
    return int(where.taxel_index[triangle, pad])


def noise_that_shows(world: World, board: str, triangle: int, pad: int) -> float:
    """Return from how much noise on (rms in units of 2.88 fF) a pad is noisier than it was
    calibrated: on real skin some are calibrated with six units, and some are stuck from the first.
    """
    taxel = _taxel_of(world, board, triangle, pad)
    if not math.isnan(world.robot.skin.held_ff[taxel]):
        return math.inf
    calibration = None if world.life is None else world.life.daemon.engine.calibration
    if calibration is None:
        return SURE_NOISE_UNITS
    if not calibration.usable[taxel]:
        return math.inf
    return max(SURE_NOISE_UNITS, SURE_NOISE * float(calibration.noise[taxel]))


def longest_chance_s(world: World, board: str, triangle: int, pad: int) -> float:
    """Return for how long a pad that works may send the same byte (s): very long, if its noise is
    small beside one unit and it rests in the middle of a byte.

    A calibration finds too much noise in such a pad at the edge of a byte, or too little in its
    middle. Where boards compensate temperature, whole bytes may be of one word of the chip.
    """
    taxel = _taxel_of(world, board, triangle, pad)
    own_units = float(world.robot.skin.noise_ff[taxel] / world.layout.unit_ff[taxel])
    noise_units = math.hypot(own_units, 12**-0.5)
    calibration = None if world.life is None else world.life.daemon.engine.calibration
    if calibration is not None:
        noise_units = min(noise_units, float(calibration.noise[taxel]))
    settings = world.settings.boards[board]
    gains, _ = thermal_gains(settings.effective_skin_type, triangle)
    rate = rate_in_run(np.array([noise_units]), 1.0 + math.ceil(gains[pad] / 128))
    conversions = max(float(longest_run(rate, CALIBRATED_SAMPLES, ODDS)[0]), LEAST_REPEATS)
    period_ms = settings.period_ms
    return conversions * max(period_ms * 1e-3, CONVERSION_S)


def scatters(world: World, board: str) -> Callable[[], bool]:
    """Return a function: whether a board's sweeps have been irregular on their bus since now. Those
    that are ready while more urgent ones pass begin when these have passed.
    """
    settings = next(one.settings for one in world.layout.boards if one.name == board)
    sent, since_ns = world.cables[settings.bus].sent, world.clock.monotonic_ns()
    sure_ms = SURE_SCATTER * JITTER_SHARE * settings.period_ms
    return lambda: sent.scatter_ms(settings.address, since_ns) > sure_ms


def temperature_shows(world: World) -> Callable[[], bool]:
    """Return a function: whether readings that move everywhere can be no load. Temperature pads
    show that, and pads that are not touched. Where most are, an even load reads the same, and where
    the zero of most is not known, neither is how far they moved.
    """
    layout = world.layout
    thermal = layout.pad_kind == PadKind.THERMAL

    def shows() -> bool:
        if world.life is None:
            return True
        engine = world.life.daemon.engine
        if engine.calibration is None:
            return True
        usable = engine.calibration.usable & ~thermal
        rests = usable.copy()
        for index, row in engine.ledger.row.items():
            taxels = layout.boards[index].taxel_index
            other = (taxels >= 0) & engine.zeros.in_doubt(index)
            felt = engine.intake.touched.get(row)
            rests[taxels[other if felt is None else other | felt]] = False
        parts = (slice(part.start, part.stop) for part in layout.parts)
        return any(thermal[part].any() or enough_rest(rests[part], usable[part]) for part in parts)

    return shows


def _frames_hz(world: World, bus: str) -> float:
    return sum(
        2 * len(board.triangles) * 1000 / board.settings.period_ms
        for board in world.layout.boards
        if board.settings.bus == bus
    )


def until_damage_shows_s(world: World, bus: str, share: float) -> float:
    """Return by when it must be known that a bus damages a share of its frames (s)."""
    frames_hz = _frames_hz(world, bus)
    return max(DAMAGED_S, SURE_DAMAGED / (share * frames_hz)) if frames_hz else math.inf


def until_loss_shows_s(world: World, bus: str, share: float) -> float:
    """Return by when it must be known that a bus loses a share of its frames (s).

    It shows by triangles of which one frame comes, a few within a second.
    """
    halves_hz = _frames_hz(world, bus) * share * (1.0 - share)
    if not halves_hz:
        return math.inf
    odds = sum(halves_hz**n / math.factorial(n) for n in range(FEW_HALVES)) * math.exp(-halves_hz)
    return max(LOST_S, 1.0 + math.log(ALL_HID) / math.log(odds)) if odds else LOST_S


def rests(world: World, bus: str) -> Callable[[], bool]:
    """Return a function: whether nothing touches a bus. What jumps in a touch may be real skin."""
    return lambda: (
        world.life is None
        or not any(
            world.layout.boards[index].settings.bus == bus
            for index, row in world.life.daemon.engine.ledger.row.items()
            if row in world.life.daemon.engine.intake.touched
        )
    )
