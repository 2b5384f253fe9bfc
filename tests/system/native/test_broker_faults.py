"""Under load a broker is killed, frozen and restarted at random; nothing is lost untold."""

import asyncio
import random
from collections.abc import Callable

import numpy as np
import pytest

from skin_host.client import SkinClient, Stream, Touch
from skin_host.config.settings import Mqtt
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.frame import PressureFrame
from tests.support.broker import Mosquitto, break_at_random
from tests.support.said import touch_event

PARTS = [f"part_{i}" for i in range(10)]
TAXELS = 200  # of each of ten parts
RATE_HZ = 50
SECONDS = 20
PATIENCE_S = 60.0


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.02)


class Load:
    """What a daemon would put: frames of 2000 taxels at 50 Hz, and the touches of every part."""

    def __init__(self, publisher: Publisher) -> None:
        self.publisher = publisher
        self.sweeps = 0
        self.touches = 0
        random = np.random.default_rng(1)
        self._kpa = random.uniform(0, 50, TAXELS).astype(np.float32)
        self._mask = np.zeros(TAXELS, np.bool_)

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        start_s = loop.time()
        while self.sweeps < SECONDS * RATE_HZ:
            await asyncio.sleep(max(0.0, start_s + self.sweeps / RATE_HZ - loop.time()))
            for part in PARTS:
                self._put(part)
            self.sweeps += 1

    def _put(self, part: str) -> None:
        raw = np.zeros(TAXELS, np.uint8)
        t_ns = 1 + self.sweeps * 20_000_000
        frame = PressureFrame(
            part, self.sweeps, t_ns, raw, self._kpa, self._mask, ~self._mask, self._mask
        )
        self.publisher.put_frame(frame)
        step = self.sweeps % 10
        if step in (0, 3, 6, 9):
            kind = "begin" if step == 0 else "end" if step == 9 else "move"
            contact = self.sweeps // 10
            self.publisher.put_touch(
                touch_event(kind, contact, self.sweeps, t_ns, part, [1], None, None, 1, 1, 1, 0.1)
            )
            self.touches += 1


async def count(stream: Stream[Touch], seen: dict[str, int], told: dict[str, int]) -> None:
    async for touch in stream:
        seen[touch.part] += 1
        told[touch.part] += touch.missed


@pytest.mark.parametrize("seed", [1, 2])
async def test_every_touch_arrives_or_its_loss_is_told(mosquitto: Mosquitto, seed: int) -> None:
    keys = Mqtt(host=mosquitto.host, port=mosquitto.port)
    seen, told = dict.fromkeys(PARTS, 0), dict.fromkeys(PARTS, 0)
    url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with SkinClient(url, robot="robot") as skin:
        touches = skin.touches()
        await skin.ready()
        counting = asyncio.create_task(count(touches, seen, told))
        async with Publisher(keys, "robot") as publisher:
            load = Load(publisher)
            # The first and the last of each part are heard, so that all between is counted.
            for part in PARTS:
                load._put(part)
            await until(lambda: min(seen.values()) == 1)
            load.sweeps += 1
            breaking = asyncio.create_task(break_at_random(mosquitto, random.Random(seed)))
            await load.run()
            breaking.cancel()
            await asyncio.gather(breaking, return_exceptions=True)
            mosquitto.restart()
            await until(lambda: publisher.counters.touches_waiting == 0)
            await until(lambda: skin.connected)
            await skin.ready()
            for part in PARTS:
                publisher.put_touch(
                    touch_event("end", 999_999, 0, 10**18, part, [], None, None, 1, 1, 1, 0.1)
                )
            # A move that a newer one replaced while many waited is neither sent nor a loss.
            sent = load.touches + len(PARTS) - publisher.counters.moves_replaced
            await until(lambda: sum(seen.values()) + sum(told.values()) == sent)
            await until(lambda: publisher.counters.touches_waiting == 0)
            counters = publisher.counters
        counting.cancel()
    assert load.sweeps == SECONDS * RATE_HZ
    assert counters.touches_dropped == 0
    assert counters.touches_sent == sent
    # Every frame was sent or is counted as skipped; one may have been lost with each link.
    frames = load.sweeps * len(PARTS)
    in_flight = frames - counters.frames_sent - counters.frames_skipped
    assert 0 <= in_flight <= counters.connections
