"""Presses of pads in the finest units, on foam whose model was not fitted."""

from pathlib import Path

import pytest

from emulator.probes.scene import Place, Probe, Scene
from emulator.robot import Robot
from skin_host.config.settings import load
from skin_host.layout import build_layout
from skin_host.processing.core import Engine
from skin_host.processing.events import Touch
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
