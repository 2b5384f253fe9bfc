"""A daemon at full rate on buses that cost nothing: see `scheduled_bus`."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path

from emulator.probes.scene import Place, Probe, Scene
from skin_host.config.settings import Bus, changed, load
from skin_host.daemon.daemon import Daemon
from skin_host.health import Record
from skin_host.layout import build_layout
from tests.support import scheduled_bus

PATIENCE_S = 120.0
#: The skin is left alone for so long, then pressed here and there, again and again.
UNTOUCHED_S = 6.0
LOOP_S = 4.0
PRESS_S = 0.6
PROBES = 6
#: The emulator draws a few pads that are too noisy to be believed.
MOST = 0.9


def whole_skin(folder: Path) -> Path:
    """2112 taxels in one part: eleven boards on three buses, at 50 Hz."""
    lines = ['robot = "load"']
    for board in range(11):
        bus, address = divmod(board, 4)
        if address == 0:
            lines += [f"[buses.can{bus}]", f'channel = "can{bus}"']
        lines += [f"[boards.b{board}]", f'bus = "can{bus}"', f"address = {address + 1}"]
        lines += ["period_ms = 20", "[[parts.body.patches]]", f'board = "b{board}"']
        lines += ['triangles = "0-15"']
    return written(folder, lines)


def four_parts(folder: Path) -> Path:
    """Four parts of 192 taxels, each of one board on a bus of its own, at 20 Hz."""
    lines = ['robot = "load"']
    for number in range(4):
        lines += [f"[buses.can{number}]", f'channel = "can{number}"']
        lines += [f"[boards.b{number}]", f'bus = "can{number}"']
        lines += ["address = 1", "period_ms = 50"]
        lines += [f"[[parts.part{number}.patches]]", f'board = "b{number}"', 'triangles = "0-15"']
    return written(folder, lines)


def written(folder: Path, lines: list[str]) -> Path:
    path = folder / "load.toml"
    path.write_text("\n".join(lines))
    return path


def pressed(part: str, taxels: int) -> Scene:
    """Each probe presses once in two seconds, none over the seam of the loop."""
    probes = [
        Probe(
            part=part,
            at=Place(taxel=number * taxels // PROBES + 3),
            pressure_kpa=[(0.0, 0.0), (0.1, 60.0), (PRESS_S - 0.1, 60.0), (PRESS_S, 0.0)],
            start_s=UNTOUCHED_S + 0.1 + (1.8 - PRESS_S) * number / PROBES,
            repeat_s=2.0,
        )
        for number in range(PROBES)
    ]
    return Scene(spread=False, quiet=True, probe=probes)


@contextlib.asynccontextmanager
async def daemon_of(
    config: Path, scene: Scene, port: int = 1, state: Path | None = None
) -> AsyncIterator[Daemon]:
    """A calibrated daemon on scheduled buses."""
    scheduled_bus.register()
    settings = load(config)
    layout = build_layout(settings, config.parent)
    files = scheduled_bus.record(
        settings, layout, scene, UNTOUCHED_S + LOOP_S, LOOP_S, config.parent
    )
    for bus, file in files.items():
        scheduled = Bus(interface=scheduled_bus.INTERFACE, channel=str(file))
        settings = changed(settings, {f"buses.{bus}": scheduled})
    settings = changed(
        settings,
        {
            "mqtt.port": port,
            "service.state_directory": str(state or config.parent),
            "processing.calibration.seconds": 3.0,
            "processing.touch.move_hz": 5.0,
            # At this rate, chance touches one of so many noisy taxels all the time.
            "processing.touch.margin_units": 8.0,
        },
    )
    daemon = Daemon(settings, layout)
    stop = asyncio.Event()
    running = asyncio.create_task(daemon.run(stop))
    try:
        await until(lambda: daemon.engine.calibration or running.done())
        yield daemon
    finally:
        stop.set()
        await running


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.02)


def believed(record: Record) -> bool:
    return record["valid_taxels"] > MOST * record["taxels"]
