"""Takes a calibration without a daemon, and finds the stored one."""

import asyncio
import contextlib
import logging
from collections.abc import Callable
from pathlib import Path

from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Settings, skin_hash
from skin_host.daemon.link import Link
from skin_host.daemon.state import can_be_read, kept_path
from skin_host.errors import CalibrationError, OtherSkinError, SkinError
from skin_host.files import set_aside
from skin_host.health.diagnosis import named_by_part
from skin_host.layout import Layout
from skin_host.processing.calibration import Calibration
from skin_host.processing.calibration.file import load_calibration
from skin_host.processing.calibration.outcome import Outcome
from skin_host.processing.core import Engine
from skin_host.tasks import cancel

log = logging.getLogger(__name__)

#: If nothing was received for this long, a calibration ends with what it has.
GRACE_S = 5.0
#: A calibration in which a board is zeroed takes longer, so many times.
MOST_FALLS = 3


async def take_calibration(
    settings: Settings,
    layout: Layout,
    parts: list[int],
    seconds: float,
    progress: Callable[[float], None],
    clock: Clock = SYSTEM,
) -> Calibration:
    """Bring up the boards of some parts and calibrate them.

    Raises:
        BusError: a bus cannot be opened.
        SkinError: no board sent a sweep.
    """
    engine = Engine(settings, layout, parts)
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
        SkinError: no board sent a sweep.
    """
    engine().begin_calibration(seconds)
    grown_s = clock.monotonic_s()
    share, falls = 0.0, 0
    while share < 1.0 and clock.monotonic_s() - grown_s < GRACE_S:
        await clock.sleep(0.02)
        before, share = share, engine().calibration_progress()
        falls += share < before
        # A board that zeroes itself again and again takes it back every time.
        if share > before and falls <= MOST_FALLS:
            grown_s = clock.monotonic_s()
        progress(share)
    compute = engine().collected(clock.today().isoformat(timespec="seconds"))
    if share == 0.0 and not falls:
        raise SkinError(
            "no calibration: no board sent a sweep; check with `skin scan` whether the boards are "
            "powered and answer"
        )
    # Of a large skin this takes a second, in which the boards' frames must be read.
    return await clock.in_thread(compute)


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


def calibration_path(settings: Settings, node: str) -> Path:
    """Where a node keeps its calibration."""
    return kept_path(settings, node, "calibration")


def stored_calibration(settings: Settings, layout: Layout, node: str) -> Calibration | None:
    """Return the stored calibration, or None if there is none.

    An unreadable one counts as none, so that a service can continue without it. So does a damaged
    one, which is set aside.

    Raises:
        OtherSkinError: it belongs to another configuration or robot.
        NewerFileError: a newer version has written it.
        BusyFileError: another program is writing it.
    """
    path = calibration_path(settings, node)
    if not can_be_read(path, "a new one is taken"):
        return None
    try:
        return load_calibration(path, layout, skin_hash(settings))
    except OtherSkinError:
        raise
    except CalibrationError as error:
        log.warning("%s", error)
        set_aside(path)
        return None
