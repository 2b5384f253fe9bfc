"""A real daemon at full rate, while its broker and its buses fail: nothing else suffers.

The frames are the emulator's, played at their times by `tests.support.scheduled_bus`.
ACQUISITION_SECONDS sets how long things are broken.
"""

import asyncio
import json
import logging
import os
import random
import statistics
import time
from collections import Counter, defaultdict
from pathlib import Path

import pytest

from emulator.probes.scene import Scene
from skin_host.health import Record
from skin_host.processing.frame import PressureFrame
from tests.support.broker import Mosquitto, break_at_random
from tests.support.programs import require
from tests.support.scheduled_bus import ScheduledBus
from tests.support.steady import (
    MOST,
    PROBES,
    believed,
    daemon_of,
    four_parts,
    pressed,
    until,
    whole_skin,
)

SECONDS = float(os.environ.get("ACQUISITION_SECONDS", "12"))
FRAMES_A_SWEEP = 32


def codes(record: Record) -> set[str]:
    return {fault["code"] for fault in record["faults"]}


def heard(file: Path) -> dict[int, tuple[str, int]]:
    """What a subscriber was told: kind and contact of each event, by its number."""
    lines = file.read_bytes().split(b"\n")[:-1]
    return {one["count"]: (one["event"], one["id"]) for one in map(json.loads, lines)}


async def test_a_broken_broker_costs_no_sweep_and_no_untold_touch(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    config = whole_skin(tmp_path)
    told = tmp_path / "told"
    listen = [require("mosquitto_sub"), "-p", str(mosquitto.port), "-q", "1"]
    with told.open("wb") as file:
        listener = await asyncio.create_subprocess_exec(
            *listen, "-t", "skin/load/body/touch", stdout=file
        )
    try:
        async with daemon_of(config, pressed("body", 2112), mosquitto.port) as daemon:
            buses = dict(ScheduledBus.open_now)
            await until(lambda: len(heard(told)) > PROBES)
            breaking = asyncio.create_task(break_at_random(mosquitto, random.Random(1)))
            await asyncio.sleep(SECONDS)
            breaking.cancel()
            await asyncio.gather(breaking, return_exceptions=True)
            mosquitto.restart()
            # Whoever has lost events learns of it by the number of the next one.
            known = daemon.publisher.counters.touches_sent
            await until(lambda: max(heard(told)) > known + PROBES)
        counters = daemon.publisher.counters
        await asyncio.sleep(1.0)
    finally:
        listener.terminate()
        await listener.wait()
    events = heard(told)
    missed = max(events) - len(events)
    halves = Counter(contact for kind, contact in events.values() if kind != "move")
    sweeps = 0
    for name, port in daemon.link.ports.items():
        assembler = daemon.engine.assemblers[name].counters
        bus = buses[daemon.settings.buses[name].channel]
        assert port.counters.frames == bus.given == assembler.frames
        assert assembler.incomplete == assembler.halves == assembler.late == assembler.missed == 0
        assert 0 <= bus.given - FRAMES_A_SWEEP * assembler.sweeps < 5 * FRAMES_A_SWEEP
        sweeps += assembler.sweeps
    logging.info(
        "%g s, %d connections: %d sweeps, 0 lost; a frame waited %.0f ms at most; "
        "touches %s, missed and told %d, dropped %d; frames sent %d, skipped %d",
        SECONDS,
        counters.connections,
        sweeps,
        1e3 * max(bus.longest_wait_s for bus in buses.values()),
        dict(Counter(kind for kind, _ in events.values())),
        missed,
        counters.touches_dropped,
        counters.frames_sent,
        counters.frames_skipped,
    )
    assert counters.connections > 1
    # What the broker has taken has come, or its number is missing; the rest is counted.
    assert max(events) >= counters.touches_sent
    assert sum(count != 2 for count in halves.values()) <= missed + counters.touches_dropped


@pytest.mark.parametrize("how", ["cable", "adapter"])
async def test_one_bus_of_four_that_is_unplugged_leaves_the_others_alone(
    mosquitto: Mosquitto, tmp_path: Path, caplog: pytest.LogCaptureFixture, how: str
) -> None:
    config = four_parts(tmp_path)
    delays_ms: dict[str, list[float]] = defaultdict(list)
    async with daemon_of(config, Scene(spread=False, quiet=True), mosquitto.port) as daemon:
        put = daemon.publisher.put_frame
        valid: dict[str, list[float]] = defaultdict(list)

        def put_frame(frame: PressureFrame) -> None:
            delays_ms[frame.part].append((time.time_ns() - frame.t_ns) / 1e6)
            valid[frame.part].append(float(frame.valid.mean()))
            put(frame)

        await until(lambda: all(map(believed, daemon.records().values())))
        daemon.publisher.put_frame = put_frame
        await asyncio.sleep(SECONDS / 2)
        before = {part: sorted(delays) for part, delays in delays_ms.items()}
        known = {part: codes(record) for part, record in daemon.records().items()}
        delays_ms.clear()
        valid.clear()
        caplog.clear()
        caplog.set_level(logging.INFO)
        channel = daemon.settings.buses["can3"].channel
        if how == "cable":
            ScheduledBus.open_now[channel].unplugged = True
        else:
            ScheduledBus.removed.add(channel)
        await asyncio.sleep(SECONDS / 2)
        after = {part: sorted(delays) for part, delays in delays_ms.items()}
        lines = [record.getMessage() for record in caplog.records]
        records = daemon.records()
        unplugged = valid.pop("part3")[-1]
        ScheduledBus.removed.discard(channel)
        for bus in ScheduledBus.open_now.values():
            bus.unplugged = False
        await until(lambda: believed(daemon.records()["part3"]))
    others = ["part0", "part1", "part2"]
    for part in others:
        logging.info(
            "%s: %d frames before, %d after; delay before %.1f ms (99 %%: %.1f), "
            "after %.1f ms (%.1f)",
            part,
            len(before[part]),
            len(after[part]),
            statistics.median(before[part]),
            before[part][int(0.99 * len(before[part]))],
            statistics.median(after[part]),
            after[part][int(0.99 * len(after[part]))],
        )
        assert min(valid[part]) > MOST
        assert codes(records[part]) <= known[part] | {"taxel_noisy"}
    assert unplugged == 0.0
    assert records["part3"]["state"] == "silent"
    assert ("bus_silent" if how == "cable" else "bus_gone") in codes(records["part3"])
    assert len(lines) <= 1, lines
