"""The demo's scene, worked out without a clock: what is pressed is told, and nothing else."""

from pathlib import Path

from emulator.robot import Robot
from emulator.scene import load as load_scene
from skin_host.engine import Engine
from skin_host.layout import build_layout
from skin_host.settings import load

CONFIG = Path(__file__).parents[2] / "config"
CALIBRATION_S = 4.5
LASTS_S = 38.0
#: When something begins to press what nothing presses yet, by part.
PRESSES = {
    "left_forearm": [6, 8, 11, 14, 17, 28, 30, 33, 36],
    "left_hand": [7, 7, 8, 16, 16, 17, 25, 25, 26, 34, 34, 35],
}


def test_every_press_is_one_contact() -> None:
    settings = load(CONFIG / "demo.toml")
    layout = build_layout(settings, CONFIG)
    robot = Robot(settings, layout, load_scene(CONFIG / "scenes" / "demo.toml"))
    engine = Engine(settings, layout, list(range(len(layout.parts))))
    robot.bring_up()
    events = []
    calibrated = False
    engine.begin_calibration(CALIBRATION_S)
    while robot.t_ns < LASTS_S * 1e9:
        if not calibrated and engine.calibration_progress() >= 1.0:
            engine.use(engine.end_calibration("2026-01-01T00:00:00+00:00"))
            calibrated = True
        for step in engine.feed("can0", robot.step(0.02)["can0"]):
            events += step.events
    begun = {
        part: [
            event.t_ns * 1e-9 for event in events if event.part == part and event.event == "begin"
        ]
        for part in PRESSES
    }
    for part, at_s in PRESSES.items():
        late_s = [begin - wanted for begin, wanted in zip(begun[part], at_s, strict=True)]
        assert all(0.0 < late < 0.4 for late in late_s), (part, begun[part])
