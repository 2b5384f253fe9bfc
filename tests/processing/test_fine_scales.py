"""Presses of pads in the finest units, on foam whose model was not fitted."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.probes.scene import Place, Probe, Scene
from emulator.robot import Robot
from skin_host.config.settings import load
from skin_host.layout import build_layout
from skin_host.processing.calibration.calibrator import Calibrator
from skin_host.processing.core import Engine
from skin_host.processing.events import Touch
from skin_host.processing.pipeline import Pipeline
from tests.support.calibrated import TIME

STEP_S = 0.1
FINGERTIPS = """
robot = "fine"
[buses.can0]
interface = "virtual"
channel = "fine"
[boards.hand]
bus = "can0"
address = 14
[parts.hand]
foam_mm = 3.0
[[parts.hand.patches]]
board = "hand"
triangles = "0-4"
kind = "fingertip2l"
shift = 0
"""


@pytest.mark.parametrize("falls_in_s", [0.2, 3.0])
def test_a_press_of_fingertips_ends_soon_after_its_release(
    tmp_path: Path, falls_in_s: float
) -> None:
    """Their noise is as large as their threshold, and the foam keeps as much for a minute."""
    config = tmp_path / "fine.toml"
    config.write_text(FINGERTIPS)
    settings = load(config)
    layout = build_layout(settings, tmp_path)
    course = [(0, 0), (0.2, 60), (10.2, 60), (10.2 + falls_in_s, 0)]
    presses = [
        Probe(
            part="hand",
            at=Place(triangle=finger),
            diameter_mm=10,
            pressure_kpa=course,
            start_s=8.0,
        )
        for finger in range(5)
    ]
    robot = Robot(settings, layout, Scene(seed=1, quiet=True, probe=presses))
    robot.bring_up()
    engine = Engine(settings, layout, [0])
    engine.begin_calibration(5.0)
    calibrating, touched, ends_s = True, False, []
    while robot.t_ns < 40e9:
        for bus, batch in robot.step(STEP_S).items():
            output = engine.feed(bus, batch)
            ends_s += [
                event.t_ns * 1e-9
                for event in output.events
                if isinstance(event, Touch) and event.event == "end"
            ]
            for one in output.steps:
                touched = bool(one.frame.touched.any())
        if calibrating and engine.calibration_progress() >= 1.0:
            engine.use(engine.end_calibration(TIME))
            calibrating = False
    released_s = 18.2 + falls_in_s
    assert not touched
    assert len(ends_s) == 5
    assert max(ends_s) - released_s < 6.0


@pytest.mark.parametrize("period_s", [0.05, 0.2])
@pytest.mark.parametrize("rate", [0.17, -0.17])
def test_fingertips_that_become_warm_are_not_touched(
    tmp_path: Path, rate: float, period_s: float
) -> None:
    """By 5 degrees a minute, with noise that is four times that of the usual units."""
    config = tmp_path / "fine.toml"
    config.write_text(FINGERTIPS)
    settings = load(config)
    layout = build_layout(settings, tmp_path)
    n = layout.n_taxels
    rng = np.random.default_rng(9)
    rates = rate * rng.uniform(0.8, 1.2, n)
    present = np.ones(n, np.bool_)

    def sweep(warm_s: float) -> NDArray[np.uint8]:
        return np.rint(220.0 - rates * warm_s + rng.normal(0.0, 1.6, n)).astype(np.uint8)

    calibrator = Calibrator(layout)
    for number in range(100):
        calibrator.add(0, sweep(0.0), present, round(number * period_s * 1e9))
    pipeline = Pipeline(layout, settings.processing, calibrator.finish("abc", TIME))
    touched = 0
    for number in range(round(90.0 / period_s)):
        t_ns = round((100 + number) * period_s * 1e9)
        touched += int(pipeline.step(0, sweep(number * period_s), present, t_ns).touched.sum())
    assert touched == 0
