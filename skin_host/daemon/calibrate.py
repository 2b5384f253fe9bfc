"""Takes a calibration without a daemon, and finds the stored one."""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import TRIANGLES, StatusError
from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Settings, format_triangles, skin_hash
from skin_host.daemon.link import Link
from skin_host.daemon.state import can_be_read, kept_path, taxels_of
from skin_host.errors import CalibrationError, OtherSkinError, SkinError
from skin_host.files import (
    give_second_name,
    refuse_other_robot,
    set_aside,
    why_unreadable,
)
from skin_host.health.diagnosis import named_by_part
from skin_host.layout import Layout
from skin_host.processing.calibration import Calibration, Verdict, by_part, summary
from skin_host.processing.calibration.file import load_calibration
from skin_host.processing.calibration.outcome import Outcome
from skin_host.processing.core import Engine
from skin_host.tasks import cancel

log = logging.getLogger(__name__)

#: If nothing was received for this long, a calibration ends with what it has.
GRACE_S = 5.0
#: A calibration in which a board is zeroed takes longer, so many times.
MOST_ZEROED = 3
#: Where no sample is usable, so many boards are named.
NAMED_BOARDS = 4


async def take_calibration(
    settings: Settings,
    layout: Layout,
    parts: list[int],
    seconds: float,
    progress: Callable[[float], None],
    clock: Clock = SYSTEM,
    touched: Mapping[str, list[int]] = MappingProxyType({}),
) -> Calibration:
    """Bring up the boards of some parts and calibrate them.

    Args:
        settings, layout: of the robot.
        parts: indices of those parts.
        seconds: how long to look at least.
        progress: is called with the share that has been collected.
        clock: for waiting.
        touched: numbers of taxels by part that were touched when a daemon ended: the set-up may
            hide that.

    Raises:
        BusError: a bus cannot be opened.
        SkinError: no board sent a sweep, or no pad is usable by what was received.
    """
    engine = Engine(settings, layout, parts)
    engine.zeros.expect_touched(taxels_of(layout, touched))
    link = Link(engine, clock=clock)
    tasks = [
        asyncio.create_task(link.read(lambda _: None)),
        asyncio.create_task(_supervise(link, clock)),
    ]
    try:
        # A bus without any other node never takes the set-up; the time limit reports that.
        async with clock.timeout(GRACE_S):
            await link.bring_up()
        with contextlib.suppress(TimeoutError):
            async with clock.timeout(GRACE_S):
                while not link.all_alive():
                    await clock.sleep(0.05)
        return await collect(lambda: engine, seconds, progress, clock)
    except TimeoutError:
        raise SkinError(
            "the boards could not be set up: no node acknowledges; check with `skin scan` "
            "whether they are powered and answer"
        ) from None
    finally:
        await link.stop()
        await cancel(*tasks)
        link.close()


async def _supervise(link: Link, clock: Clock) -> None:
    """Set up boards again that are late, or missed their set-up."""
    while True:
        await clock.sleep(0.5)
        link.supervise()


async def collect(
    engine: Callable[[], Engine],
    seconds: float,
    progress: Callable[[float], None] = lambda _: None,
    clock: Clock = SYSTEM,
) -> Calibration:
    """Let a running engine collect a calibration.

    Args:
        engine: returns the engine in use, which may be replaced meanwhile.
        seconds: how long at least; less than noise is known from is not enough.
        progress: is called with the share that has been collected.
        clock: for waiting.

    Raises:
        SkinError: no board sent a sweep, or no pad is usable by what was received.
    """
    engine().begin_calibration(seconds)
    ledger = engine().ledger
    before_sweeps = ledger.sweeps.copy()
    grown_s = clock.monotonic_s()
    share, zeroed = 0.0, 0
    while share < 1.0 and clock.monotonic_s() - grown_s < GRACE_S:
        await clock.sleep(0.02)
        before, share = share, engine().calibration_progress()
        zeroed = engine().calibration_begun_again
        # A board that zeroes itself again and again takes it back every time.
        if share > before and zeroed <= MOST_ZEROED:
            grown_s = clock.monotonic_s()
        progress(share)
    compute = engine().collected(clock.today().isoformat(timespec="seconds"))
    if share == 0.0 and not zeroed:
        now = engine().ledger
        came = now.sweeps > (before_sweeps if now is ledger else 0)
        raise SkinError(f"no calibration: {_why_none(engine(), came)}")
    # Of a large skin this takes a second, in which the boards' frames must be read.
    found = await clock.in_thread(compute)
    if not by_part(found.usable, engine().layout):
        raise SkinError(f"no calibration: {_why_unusable(found, engine(), zeroed)}")
    return found


def _why_unusable(found: Calibration, engine: Engine, zeroed: int) -> str:
    """Return in words why no pad is usable by a calibration.

    Args:
        found: the calibration.
        engine: that has collected it.
        zeroed: how often a board was zeroed meanwhile.
    """
    verdicts = summary(found, engine.layout)
    names = [engine.layout.parts[part].name for part in engine.parts]
    counted = {
        name: [f"{number} {word.replace('_', ' ')}" for word, number in verdicts[name].items()]
        for name in names
    }
    listed = "; ".join(f"{name}: {', '.join(counts)}" for name, counts in counted.items() if counts)
    why = f"no pad is usable by what was received: {listed}"
    if zeroed:
        why += (
            f"; a board was zeroed {zeroed} times meanwhile, as by a restart: check with "
            "`skin scan` whether it keeps its power"
        )
    return why


def _why_none(engine: Engine, came: NDArray[np.bool_]) -> str:
    """Return in words why there is no usable sample.

    Args:
        engine: that has none.
        came: bool[b], the boards of its ledger that have sent sweeps.
    """
    if not came.any():
        return (
            "no board sent a sweep; check with `skin scan` whether the boards are powered and "
            "answer"
        )
    found = [_of_board(engine, board, came) for board in engine.boards]
    more = len(found) - NAMED_BOARDS
    listed = "; ".join(found[:NAMED_BOARDS]) + (f"; and {more} more boards" if more > 0 else "")
    return f"no taxel gave a usable sample: {listed}; `skin status` has all that is wrong"


def _of_board(engine: Engine, board: int, came: NDArray[np.bool_]) -> str:
    """Return in words what a board sends from which no sample is usable."""
    ledger, known = engine.ledger, engine.layout.boards[board]
    row = ledger.row[board]
    by_fault: dict[str, list[int]] = {}
    for number in range(TRIANGLES if came[row] else 0):
        if known.enabled >> number & 1:
            error = int(ledger.error[row, number])
            fault = "with no usable value"
            if not ledger.present[row, number]:
                fault = "not received"
            elif error & StatusError.NOT_CONNECTED:
                fault = "not connected"
            elif error & StatusError.NO_ACK:
                fault = "without an answer on I2C"
            by_fault.setdefault(fault, []).append(number)
    faults = [f"triangles {format_triangles(those)} {fault}" for fault, those in by_fault.items()]
    return f"board {known.name}: {', '.join(faults) or 'no sweep'}"


def touched_meanwhile(found: Outcome, repeat: str) -> str | None:
    """Return in words what touched the skin during a calibration, and how to mend it, `repeat`;
    None: nothing touched it.
    """
    tips = [name for name, verdict in found["fingertips"].items() if verdict == "touched"]
    touched = "; ".join([named_by_part(found["touched"])] * bool(found["touched"]) + tips)
    if not touched:
        return None
    return (
        f"the skin was touched while it was calibrated: {touched}; take away what touches it and "
        f"{repeat}: these read too little until then"
    )


def received_too_rarely(found: Outcome) -> dict[str, list[int]]:
    """Return by part the numbers of the taxels that have no zero, as too little came of them."""
    rare: dict[str, list[int]] = {}
    for triangle in found["triangles"]:
        for verdict in (Verdict.TOO_FEW, Verdict.ABSENT):
            numbers = triangle["taxels"].get(verdict.name.lower(), [])
            if numbers:
                rare.setdefault(triangle["part"], []).extend(numbers)
    return rare


def calibration_path(settings: Settings, node: str) -> Path:
    """Where a node keeps its calibration."""
    return kept_path(settings, node, "calibration")


def stored_calibration(settings: Settings, layout: Layout, node: str) -> Calibration | None:
    """Return the stored calibration, or None if there is none.

    An unreadable one counts as none, so that a service can continue without it. So does a damaged
    one, which is set aside.

    Raises:
        OtherSkinError: it belongs to another configuration.
        OtherRobotError: it is another robot's.
        NewerFileError: a newer version has written it.
        BusyFileError: another program is writing it.
    """
    path = calibration_path(settings, node)
    if not can_be_read(path, "a new one is taken"):
        return None
    refuse_other_robot(path, layout.robot, "calibration")
    try:
        return load_calibration(path, layout, skin_hash(settings))
    except OtherSkinError:
        raise
    except CalibrationError as error:
        log.warning("%s", error)
        set_aside(path)
        return None


def keep_former(path: Path, layout: Layout, configuration: str) -> None:
    """Give a calibration of another configuration, or one that this user may not read, a second
    name, before a new one takes its own: gains and curves that were fitted are in no other file.

    Raises:
        OSError: the folder is read-only, the disk is full, ...
        BusyFileError: another program is writing it.
    """
    try:
        load_calibration(path, layout, configuration)
    except OtherSkinError:
        what = "of another configuration"
        mend = "fit them again with skin calibrate CONFIG --pressure LOG"
    except SkinError:
        why = why_unreadable(path)
        if why is None:
            return
        what, mend = f"cannot be read: {why}", "let this user read that file, and put it back"
    else:
        return
    former = give_second_name(path, "former")
    if former is not None:
        log.warning(
            "%s: %s; kept as %s. Gains and curves that were fitted to its pads are not used any "
            "more: %s",
            path,
            what,
            former.name,
            mend,
        )
