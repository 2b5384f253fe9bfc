"""The live page keeps up with a large skin: 2112 taxels at 50 Hz, in a real browser.

It runs without a graphics card, and other work may share the processors: of several spells
one must do, and what an update costs is the page's own processor time.
"""

import asyncio
import logging
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np

from skin_host.config.settings import Mqtt, load
from skin_host.layout import Layout, build_layout
from skin_host.mqtt.info import node_info
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from tests.support.broker import Mosquitto
from tests.support.devtools import Page
from tests.support.said import touch_event
from tests.support.steady import whole_skin
from tests.support.viewing import LIVE, viewing

RATE_HZ = 50.0
UPDATES_HZ = 20.0
#: The page is watched until a spell is as it should be, at most so often.
SPELLS = 8
SPELL_S = 2.0
CONTACTS = 6
#: What came, what had come when the page had drawn, and when the screen could show it.
WATCH = """
    globalThis.came = [];
    globalThis.drawn = [];
    globalThis.screens = [];
    globalThis.long = [];
    globalThis.WebSocket = class extends WebSocket {
        constructor(url) {
            super(url);
            this.addEventListener("message", ({ data }) => {
                if (data instanceof ArrayBuffer) came.push(new DataView(data).getUint32(12, true));
            });
        }
    };
    new MutationObserver(() => drawn.push([performance.now(), came.at(-1) ?? 0]))
        .observe(document, { subtree: true, attributeFilter: ["data-draws"] });
    new PerformanceObserver((list) => list.getEntries().forEach((one) => long.push(one.duration)))
        .observe({ type: "longtask" });
    requestAnimationFrame(function next(now) { screens.push(now); requestAnimationFrame(next); });
"""


class Robot:
    """A daemon's mouth: every taxel changes with every frame, and contacts wander."""

    def __init__(self, layout: Layout, publisher: Publisher) -> None:
        (self.part,) = layout.parts
        self.publisher = publisher
        self.seq = 0

    async def speak(self) -> None:
        """Publish at the rate of the boards until cancelled."""
        rng = np.random.default_rng(1)
        n = self.part.n_taxels
        due_s = time.monotonic()
        while True:
            self.seq += 1
            t_ns = time.time_ns()
            middle = (7 * self.seq + np.arange(CONTACTS) * n // CONTACTS) % (n - 6)
            away = np.min(np.abs(np.arange(n) - middle[:, None] - 3), axis=0)
            kpa = (30 * np.exp(-((away / 3) ** 2)) + 3 * rng.random(n)).astype(np.float32)
            valid = np.arange(n) < n - 12
            raw = np.zeros(n, np.uint8)
            self.publisher.put_frame(
                PressureFrame(self.part.name, self.seq, t_ns, raw, kpa, kpa > 10, valid, kpa > 32)
            )
            if self.seq % 10 == 1:
                for contact, first in enumerate(middle.tolist()):
                    self.publisher.put_touch(self.touch(contact, first, t_ns))
            due_s += 1 / RATE_HZ
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))

    def touch(self, contact: int, first: int, t_ns: int) -> Touch:
        return touch_event(
            "begin" if self.seq == 1 else "move",
            *(contact, self.seq, t_ns, self.part.name, list(range(first, first + 6))),
            *([0.01 * contact, 0.0, 0.0], [0.0, 0.0, 1.0], 30.0, 33.0, 20.0, 1.5),
        )


@asynccontextmanager
async def speaking(broker: Mosquitto, folder: Path) -> AsyncIterator[tuple[Robot, Publisher]]:
    config = whole_skin(folder)
    layout = build_layout(load(config), folder)
    settings = Mqtt(host=broker.host, port=broker.port)
    async with Publisher(settings, "load", "main") as publisher:
        publisher.put_info(node_info(layout, "main", version="1", configuration="x"))
        robot = Robot(layout, publisher)
        talking = asyncio.create_task(robot.speak())
        yield robot, publisher
        talking.cancel()
        await asyncio.gather(talking, return_exceptions=True)


async def spell(page: Page, robot: Robot) -> dict[str, float]:
    """What the page does for some seconds. Times in ms, the main thread's are of its processor."""

    async def worked_s() -> tuple[float, float]:
        metrics = (await page.call("Performance.getMetrics"))["metrics"]
        known = {metric["name"]: metric["value"] for metric in metrics}
        return known["TaskDuration"], known["ScriptDuration"]

    await page.run("came.length = drawn.length = screens.length = long.length = 0")
    task_s, script_s = await worked_s()
    first, began_s = robot.seq, time.monotonic()
    await asyncio.sleep(SPELL_S)
    task_s, script_s = (np.array(await worked_s()) - (task_s, script_s)).tolist()
    seen: dict[str, Any] = await page.run("({ came, drawn, screens, long })")
    lasted_s = time.monotonic() - began_s
    at_ms, seqs = np.array(seen["drawn"]).T
    updates = np.flatnonzero(np.diff(seqs, prepend=0.0))
    gaps_ms = np.diff(at_ms[updates])
    return {
        "published_hz": (robot.seq - first) / lasted_s,
        "came_hz": len(seen["came"]) / lasted_s,
        "drawn_hz": len(updates) / lasted_s,
        "gap_median": float(np.median(gaps_ms)),
        "gap_99": float(np.quantile(gaps_ms, 0.99)),
        "gap_most": float(gaps_ms.max()),
        "screen_gap_99": float(np.quantile(np.diff(seen["screens"]), 0.99)),
        "long_tasks": len(seen["long"]),
        "script": 1e3 * script_s / len(updates),
        "main_thread": 1e3 * task_s / len(updates),
    }


async def test_twenty_updates_a_second_of_two_thousand_taxels_are_drawn(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    async with speaking(mosquitto, tmp_path) as (robot, publisher):
        async with viewing(mosquitto, "load", tmp_path / "profile", watch=WATCH) as page:
            await page.call("Performance.enable", timeDomain="threadTicks")
            await page.until(f"{LIVE} && drawn.length > 50")
            for _ in range(SPELLS):
                seen = await spell(page, robot)
                logging.info("%s", ", ".join(f"{name} {at:.1f}" for name, at in seen.items()))
                if keeps_up(seen):
                    break
            rows = await page.run('document.querySelectorAll("#contacts tbody tr").length')
            rates = await page.run('document.querySelector("#health .rates").textContent')
            # Nothing queues on the way: what is drawn is what is said now.
            await page.until(f"drawn.at(-1)[1] >= {robot.seq}")
    assert keeps_up(seen), seen
    # Its one thread has time left for whoever uses the page.
    assert seen["main_thread"] * UPDATES_HZ < 800.0
    assert rows == CONTACTS
    # What the page passes over is not lost: no more is than the robot itself left out.
    assert int(rates.split(", ")[1].split()[0]) <= publisher.counters.frames_skipped


def keeps_up(seen: dict[str, float]) -> bool:
    """Whether the robot spoke fast enough, and what reached the page was drawn, update by update.

    The screen may pass over what came between two of its pictures.
    """
    return (
        seen["published_hz"] > 2 * UPDATES_HZ
        and seen["drawn_hz"] >= UPDATES_HZ
        and seen["drawn_hz"] > 0.9 * seen["came_hz"]
    )
