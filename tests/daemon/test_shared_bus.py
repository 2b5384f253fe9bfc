"""Two nodes of one robot have boards on the same bus."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

import can

from emulator.clock import RealClock
from emulator.probes.scene import Scene
from emulator.robot import Robot
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus, changed, load
from skin_host.daemon.daemon import Daemon
from skin_host.layout import build_layout
from tests.support.live import CONFIG
from tests.support.stepped import stepped


@contextlib.asynccontextmanager
async def nodes(clock: SteppedClock, state: Path, *names: str) -> AsyncIterator[list[Daemon]]:
    """Let the hand be the node `hand`'s and the forearm `main`'s; these nodes run."""
    bus = Bus(interface="virtual", channel=f"shared-bus-{state}")
    settings = changed(
        load(CONFIG),
        {
            "buses.can0": bus,
            "service.state_directory": str(state),
            "mqtt.port": 1,
            "processing.calibration.seconds": 1.5,
            "parts.left_hand.node": "hand",
        },
    )
    layout = build_layout(settings, CONFIG.parent)
    stop = asyncio.Event()
    with can.Bus(interface=bus.interface, channel=bus.channel) as wire:
        robot = Robot(settings, layout, Scene(quiet=True))
        body = asyncio.create_task(robot.run({"can0": wire}, RealClock(clock=clock)))
        daemons = [Daemon(settings, layout, name, clock=clock) for name in names]
        hosts = [asyncio.create_task(daemon.run(stop)) for daemon in daemons]
        try:
            yield daemons
        finally:
            stop.set()
            await asyncio.gather(*hosts)
            body.cancel()
            await asyncio.gather(body, return_exceptions=True)


@stepped
async def test_a_board_of_another_node_is_no_stranger(clock: SteppedClock, tmp_path: Path) -> None:
    async with nodes(clock, tmp_path, "main", "hand") as daemons:
        await clock.sleep(20.0)
        for daemon in daemons:
            assert not daemon.link.boards["can0"].strangers
            counters = daemon.engine.assemblers["can0"].counters
            assert counters.unknown_board == counters.unknown_triangle == 0
            for record in daemon.records().values():
                assert record["state"] in ("ok", "warning")
                codes = {fault["code"] for fault in record["faults"]}
                assert codes <= {"broker_away", "taxel_decides_late"}
