"""Endurance: memory and descriptors stay flat, every event is there, counters are exact.

Short by default. The full length is an hour of real time and a month of accelerated time:

    SOAK_SECONDS=3600 SOAK_DAYS=30 pytest tests/soak
"""

import asyncio
import gc
import json
import logging
import os
from collections import Counter
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from emulator.probes.scene import load as load_scene
from skin_host.bus.wire import FrameBatch, encode_sweep
from skin_host.config.settings import Bus, load
from skin_host.health import HealthWatch
from skin_host.layout import build_layout
from skin_host.processing.core import Engine
from tests.support.broker import Mosquitto
from tests.support.live import living
from tests.support.programs import require

ROOT = Path(__file__).parents[2]
DAYS = float(os.environ.get("SOAK_DAYS", "0.03"))
SECONDS = float(os.environ.get("SOAK_SECONDS", "10"))
MOST_GROWTH_BYTES = 1024 * 1024
PERIOD_MS = 200
#: How often the hour is looked at, and what a robot may send while its daemon says goodbye.
LOOKS = 12
UNREAD_FRAMES = 2000
HOUR_NS = 3_600_000_000_000
#: A touch of two seconds begins this often.
TOUCH_EVERY = 300
TOUCH_SWEEPS = 10
ONE_BOARD = f"""
robot = "soak"
[buses.can0]
[boards.b]
bus = "can0"
address = 1
period_ms = {PERIOD_MS}
[[parts.p.patches]]
board = "b"
triangles = "0"
"""


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def tell_growth(when: str, sizes: list[int]) -> None:
    now, most = (size - sizes[0] for size in (sizes[-1], max(sizes)))
    logging.info("%s: memory %+d KiB, at most %+d KiB", when, now // 1024, most // 1024)


def test_an_accelerated_month(tmp_path: Path) -> None:
    config = tmp_path / "soak.toml"
    config.write_text(ONE_BOARD)
    settings = load(config)
    layout = build_layout(settings, tmp_path)
    engine = Engine(settings, layout, [0])
    health = HealthWatch(engine)
    rng = np.random.default_rng(1)
    noise = np.rint(0.8 * rng.standard_normal((997, 12))).astype(np.int16)
    triangle = np.zeros(1, np.intp)
    status = np.zeros(1, np.uint16)
    t_ns = 1_700_000_000_000_000_000
    count = int(DAYS * 86_400_000 / PERIOD_MS)
    events: Counter[str] = Counter()
    told: Counter[str] = Counter()
    planned = 0
    sizes: list[int] = []
    engine.begin_calibration(20.0)
    next_hour_ns = t_ns + HOUR_NS
    for number in range(count):
        t_ns += PERIOD_MS * 1_000_000
        values = 240 + noise[number % 997]
        phase = number % TOUCH_EVERY
        if number > TOUCH_EVERY // 2 and phase >= TOUCH_EVERY - TOUCH_SWEEPS:
            values[4] -= 60
            planned += phase == TOUCH_EVERY - TOUCH_SWEEPS
        ids, data = encode_sweep(1, triangle, values[None].astype(np.uint8), status)
        times = np.array([t_ns, t_ns + 120_000])
        batch = FrameBatch(ids, np.full(2, 8, np.uint8), data, times)
        for output in (engine.feed("can0", batch), engine.expire(t_ns + 150_000)):
            health.note(output)
            events.update(event.event for event in output.events)
        if number % 5 == 0:
            health.tick(t_ns, {}, {})
        if number % 25 == 0:
            told.update(fault["code"] for fault in health.record(0, t_ns, {}, {})["faults"])
        if engine.calibrating and engine.calibration_progress() >= 1.0:
            engine.use(engine.end_calibration("2026-01-01T00:00:00+00:00"))
        if t_ns >= next_hour_ns:
            next_hour_ns += HOUR_NS
            gc.collect()
            sizes.append(resident_bytes())
            if len(sizes) % 24 == 1:
                tell_growth(f"hour {len(sizes)}", sizes)
    for part in engine.parts:
        events.update(event.event for event in engine.end_part(part, t_ns))
    counters = engine.assemblers["can0"].counters
    assert (counters.frames, counters.sweeps) == (2 * count, count)
    assert counters.incomplete == counters.halves == counters.missed == counters.late == 0
    assert events["begin"] == events["end"] == planned
    assert set(told) == {"part_not_calibrated"}, told
    logging.info("%g days: %d sweeps, %d touches", DAYS, count, planned)
    if sizes:
        tell_growth("at the end", sizes)
        assert max(sizes) - sizes[0] < MOST_GROWTH_BYTES


async def test_an_hour_of_robot_daemon_and_broker(mosquitto: Mosquitto, tmp_path: Path) -> None:
    scene = replace(load_scene(ROOT / "config/scenes/demo.toml"), quiet=False)
    bus = Bus(interface="virtual", channel="soak")
    touches = tmp_path / "touches"
    listen = [require("mosquitto_sub"), "-p", str(mosquitto.port), "-q", "1"]
    with touches.open("wb") as file:
        listener = await asyncio.create_subprocess_exec(
            *listen, "-t", "skin/demo/+/touch", stdout=file
        )
    try:
        async with living(bus, tmp_path, port=mosquitto.port, scene=scene) as live:
            await asyncio.sleep(min(60.0, SECONDS / 2))
            opened = descriptors()
            sizes = [resident_bytes()]
            for number in range(1, LOOKS + 1):
                await asyncio.sleep(SECONDS / LOOKS)
                gc.collect()
                sizes.append(resident_bytes())
                tell_growth(f"{number / LOOKS * SECONDS:.0f} s", sizes)
            more = descriptors() - opened
            daemon = live.daemon
        port, assembler = daemon.link.ports["can0"], daemon.engine.assemblers["can0"]
        published = daemon.publisher.counters
        await asyncio.sleep(0.5)
    finally:
        listener.terminate()
        await listener.wait()
    # At least once: a repeated event has the number that it had.
    told = [json.loads(line) for line in touches.read_bytes().splitlines()]
    kinds = {(one["part"], one["count"]): one["event"] for one in told}
    events = Counter(kinds.values())
    logging.info("%g s: touches %s; %s", SECONDS, dict(events), assembler.counters)
    assert published.touches_dropped == 0
    assert len(kinds) >= published.touches_sent
    for part in {part for part, _ in kinds}:
        numbers = sorted(number for owner, number in kinds if owner == part)
        assert numbers == list(range(1, len(numbers) + 1))
    assert events["begin"] == events["end"] > 0
    # What the robot sent after the last look of the daemon lies unread.
    assert 0 <= live.frames_sent["can0"] - port.counters.frames <= UNREAD_FRAMES
    assert assembler.counters.frames == port.counters.frames
    assert more <= 0
    # Python's own arenas settle slowly.
    assert sizes[-1] - sizes[0] < 4 * MOST_GROWTH_BYTES
