"""Take a calibration without a daemon, and find the one that is kept."""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from skin_host import service
from skin_host.engine import Engine
from skin_host.errors import CalibrationError, OtherSkinError, SkinError
from skin_host.layout import Layout
from skin_host.link import Link
from skin_host.processing import calibration as calibrations
from skin_host.processing.calibration import Calibration
from skin_host.settings import Settings, skin_hash

log = logging.getLogger(__name__)

#: When nothing has come for so long, a calibration ends with what it has.
GRACE_S = 5.0


async def take_calibration(
    settings: Settings,
    layout: Layout,
    parts: list[int],
    seconds: float,
    progress: Callable[[float], None],
) -> Calibration:
    """Bring up the boards of some parts and calibrate them.

    Raises:
        BusError: a bus cannot be opened.
        SkinError: no board sent a sweep.
    """
    engine = Engine(settings, layout, parts)
    link = Link(engine)
    tasks = [
        asyncio.create_task(link.read(lambda _: None)),
        asyncio.create_task(_supervise(link)),
    ]
    try:
        # A bus without any other node never takes the set-up; the time limit tells of it.
        async with asyncio.timeout(GRACE_S):
            await link.bring_up()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(GRACE_S):
                while not link.all_alive():  # noqa: ASYNC110 (the boards tell nobody)
                    await asyncio.sleep(0.05)
        return await collect(engine, seconds, progress)
    except TimeoutError:
        raise SkinError(
            "the boards could not be set up: nobody acknowledges on the bus; see with `skin scan` "
            "whether they are powered and answer"
        ) from None
    finally:
        await link.stop()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        link.close()


async def _supervise(link: Link) -> None:
    """Boards that are late, or missed their set-up, are set up again."""
    while True:
        await asyncio.sleep(0.5)
        link.supervise()


async def collect(
    engine: Engine, seconds: float, progress: Callable[[float], None] = lambda _: None
) -> Calibration:
    """Let an engine that is being fed collect a calibration.

    Raises:
        SkinError: no board sent a sweep.
    """
    engine.begin_calibration(seconds)
    grown_s = time.monotonic()
    share = 0.0
    while share < 1.0 and time.monotonic() - grown_s < GRACE_S:
        await asyncio.sleep(0.02)
        before, share = share, engine.calibration_progress()
        if share > before:
            grown_s = time.monotonic()
        progress(share)
    found = engine.end_calibration(datetime.now(UTC).isoformat(timespec="seconds"))
    if share == 0.0:
        raise SkinError(
            "no calibration: no board sent a sweep; see with `skin scan` whether the boards are "
            "powered and answer"
        )
    return found


def calibration_path(settings: Settings, node: str) -> Path:
    """Where a node keeps its calibration."""
    directory = service.state_directory(settings.service.state_directory)
    return directory / f"{settings.robot}-{node}.calibration.json"


def stored_calibration(settings: Settings, layout: Layout, node: str) -> Calibration | None:
    """The calibration that was kept, or None if there is none.

    A damaged file is told of and counts as none: a service goes on without it.

    Raises:
        OtherSkinError: it belongs to another configuration.
    """
    path = calibration_path(settings, node)
    if not path.exists():
        return None
    try:
        return calibrations.load(path, layout, skin_hash(settings))
    except OtherSkinError:
        raise
    except CalibrationError as error:
        log.warning("%s", error)
        return None
