"""A part that is configured without frames: touches alike, and next to nothing worked out."""

import asyncio

import msgspec
import numpy as np

from skin_host.bus.wire import FrameBatch, encode_sweep
from skin_host.config.settings import Settings
from skin_host.daemon.daemon import Daemon
from skin_host.layout import build_layout
from skin_host.processing.core import Engine

TRIANGLES = np.arange(4)
N = 12 * len(TRIANGLES)
HZ, SECONDS = 50, 20


def skin(tmp_path, *, frames):
    document = {
        "robot": "quiet",
        "buses": {"can0": {"interface": "virtual", "channel": "touch-only"}},
        "boards": {"palm": {"bus": "can0", "address": 3, "period_ms": 1000 // HZ, "skin_type": 2}},
        "parts": {
            "palm": {
                "frames": frames,
                "foam_mm": 2.0,
                "patches": [{"board": "palm", "triangles": "0-3", "shift": 3}],
            }
        },
    }
    settings = msgspec.convert(document, Settings)
    return settings, build_layout(settings, tmp_path)


def played(settings, layout, touch_only):
    """Every step of an engine that sees a press of two seconds after ten of calibration."""
    engine = Engine(settings, layout, [0])
    engine.touch_only = touch_only
    engine.begin_calibration(9.0)
    rng = np.random.default_rng(4)
    resting = rng.uniform(225.0, 240.0, N)
    steps = []
    for sweep in range(SECONDS * HZ):
        if sweep == 9 * HZ:
            engine.use(engine.end_calibration("1970-01-01T00:00:00Z"))
        pressed = (np.arange(N) < 5) & (15 * HZ <= sweep < 17 * HZ)
        level = resting - 20.0 * pressed + rng.normal(0.0, 0.3, N)
        values = np.rint(level).astype(np.uint8).reshape(-1, 12)
        ids, data = encode_sweep(3, TRIANGLES, values, np.zeros(len(TRIANGLES), np.uint16))
        t_ns = round(1e9 * (1.0 + sweep / HZ))
        frames = [
            (int(i), bytes(d), t_ns + k) for k, (i, d) in enumerate(zip(ids, data, strict=True))
        ]
        steps += engine.feed("can0", FrameBatch.of(frames)).steps
    return steps


def test_the_configuration_decides_what_is_worked_out(tmp_path):
    async def touch_only(frames):
        daemon = Daemon(*skin(tmp_path, frames=frames), folder=tmp_path)
        daemon.link.close()
        return daemon.engine.touch_only

    assert asyncio.run(touch_only(frames=False)) == {0}
    assert asyncio.run(touch_only(frames=True)) == set()


def test_touches_are_the_same_and_pressures_wait_for_them(tmp_path):
    settings, layout = skin(tmp_path, frames=False)
    watched = played(settings, layout, set())
    unwatched = played(settings, layout, {0})

    def events(steps):
        return [(e.event, e.t_ns, e.taxels) for s in steps for e in s.events if e.event != "move"]

    assert [event for event, *_ in events(watched)] == ["begin", "end"]
    assert events(unwatched) == events(watched)
    assert all(step.frame.computed for step in watched)
    at_rest = [step for step in unwatched if not step.frame.touched.any()]
    assert np.mean([step.frame.computed for step in at_rest]) < 0.2
    assert all(step.frame.computed for step in unwatched if step.frame.touched.any())
