"""How long a calibration looks: its time, and enough samples however slow the boards are."""

import numpy as np
import pytest

from skin_host.bus.wire import FrameBatch, encode_sweep
from skin_host.config.settings import load
from skin_host.layout import build_layout
from skin_host.processing.core import FEWEST_SAMPLES, Engine
from tests.support.stack import ROOT

CONFIG = ROOT / "config" / "demo.toml"


@pytest.mark.parametrize(("period_s", "sweeps"), [(0.05, 41), (1.0, FEWEST_SAMPLES)])
def test_two_seconds_are_enough_for_quick_boards_only(period_s: float, sweeps: int) -> None:
    settings = load(CONFIG)
    layout = build_layout(settings, CONFIG.parent)
    hand = layout.boards[0]
    engine = Engine(settings, layout, [layout.parts.index(layout.part("left_hand"))])
    engine.begin_calibration(2.0)
    triangles = np.array(hand.triangles)
    rng = np.random.default_rng(1)
    status = np.zeros(len(triangles), np.uint16)
    sent = 0
    while engine.calibration_progress() < 1.0:
        values = rng.integers(238, 242, (len(triangles), 12)).astype(np.uint8)
        ids, data = encode_sweep(hand.settings.address, triangles, values, status)
        t_ns = round(1e9 * (1.0 + sent * period_s))
        frames = [(int(i), bytes(d), t_ns) for i, d in zip(ids, data, strict=True)]
        engine.feed(hand.settings.bus, FrameBatch.of(frames))
        sent += 1
        assert sent < 100
    assert sent == sweeps
