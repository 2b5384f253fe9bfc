"""The demo's scene, worked out without a clock: what is pressed is told, and nothing else."""

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from emulator.probes.scene import Scene
from emulator.probes.scene import load as load_scene
from emulator.robot import Robot
from skin_host import demo
from skin_host.config.settings import changed, load
from skin_host.layout import build_layout
from skin_host.processing.core import Engine
from tests.support.fault_bench import FaultBench

CONFIG = Path(__file__).parents[2] / "config"
CALIBRATION_S = 4.5
LASTS_S = 38.0
#: When something begins to press what nothing presses yet, by part.
PRESSES = {
    "left_forearm": [6, 8, 11, 14, 17, 28, 30, 33, 36],
    "left_hand": [7, 7, 8, 16, 16, 17, 25, 25, 26, 34, 34, 35],
}


def begun_in(scene: Scene) -> dict[str, list[float]]:
    """When contacts begin, s, by part."""
    settings = load(CONFIG / "demo.toml")
    layout = build_layout(settings, CONFIG)
    robot = Robot(settings, layout, scene)
    engine = Engine(settings, layout, list(range(len(layout.parts))))
    robot.bring_up()
    begun: dict[str, list[float]] = {part: [] for part in PRESSES}
    calibrated = False
    engine.begin_calibration(CALIBRATION_S)
    while robot.t_ns < LASTS_S * 1e9:
        if not calibrated and engine.calibration_progress() >= 1.0:
            engine.use(engine.end_calibration("2026-01-01T00:00:00+00:00"))
            calibrated = True
        for step in engine.feed("can0", robot.step(0.02)["can0"]).steps:
            for event in step.events:
                if event.event == "begin":
                    begun[event.part].append(event.t_ns * 1e-9)
    return begun


def test_every_press_is_one_contact() -> None:
    begun = begun_in(load_scene(CONFIG / "scenes" / "demo.toml"))
    for part, at_s in PRESSES.items():
        late_s = [begin - wanted for begin, wanted in zip(begun[part], at_s, strict=True)]
        assert all(0.0 < late < 0.4 for late in late_s), (part, begun[part])


def test_the_scene_of_the_tutorial_leaves_time_to_calibrate_by_hand() -> None:
    """A daemon that waits for its boards has calibrated them 20 s after they began to send."""
    presses = load_scene(CONFIG / "scenes" / "tutorial.toml").probe
    courses = [probe.force_n or probe.pressure_kpa for probe in presses]
    spans = sorted(
        (probe.start_s, probe.start_s + course[-1][0])
        for probe, course in zip(presses, courses, strict=True)
    )
    assert spans[0][0] >= 30.0
    (repeat_s,) = {probe.repeat_s for probe in presses}
    assert spans[0][0] + repeat_s - max(end_s for _, end_s in spans) >= 20.0
    assert {probe.part for probe in presses} == set(PRESSES)


def test_no_press_is_missed_or_late_on_pads_as_noisy_as_real_ones() -> None:
    begun = begun_in(replace(load_scene(CONFIG / "scenes" / "demo.toml"), quiet=False))
    for part, at_s in PRESSES.items():
        for wanted in at_s:
            assert any(0.0 < begin - wanted < 0.4 for begin in begun[part]), (part, wanted)
        assert min(begun[part]) > min(at_s)


@pytest.mark.long
@pytest.mark.parametrize("config", ["demo.toml", "icub.toml", "fingertips.toml", "nao.toml"])
def test_a_robot_of_the_demo_is_healthy_before_and_while_it_is_pressed(config: str) -> None:
    settings, layout, _ = demo.prepared(CONFIG / config, None)
    bench = FaultBench(3.0, demo.presses(settings, layout), config=CONFIG / config)
    for _ in range(8):
        bench.run(1.0)
        wrong = {part: record["sentences"] for part, record in bench.records.items()}
        assert wrong == {part: [] for part in wrong}


@pytest.mark.parametrize("seed", [1, 8])
def test_pads_that_are_refused_are_as_bad_in_the_emulator(seed: int) -> None:
    """Their own noise drives them against the end of the scale; pads with less are kept."""
    scene = replace(load_scene(CONFIG / "scenes" / "demo.toml"), quiet=False, seed=seed)
    bench = FaultBench(scene=scene, settle_s=0.0)
    calibration = bench.engine.calibration
    noise = bench.robot.skin.noise
    assert calibration is not None
    assert noise is not None
    rms_units = noise.rms_units.ravel()
    refused = ~calibration.usable
    assert refused.any()
    highest_raw = bench.layout.boards[0].settings.no_load - calibration.baseline + 2 * rms_units
    assert (highest_raw[refused] > 255).all()
    assert (rms_units[refused] > 2).all()
    named = {where for record in bench.records.values() for where in record["taxel_verdicts"]}
    assert named <= {"noisy", "out_of_range"}


@pytest.mark.parametrize(
    "shape",
    [
        {"shape": "sphere", "radius_mm": 8.0},
        {"shape": "ellipsoid", "semi_axes_mm": (8.0, 8.0, 12.0)},
        {"shape": "plane", "reach_mm": 10.0},
        {"shape": "cylinder", "radius_mm": 8.0},
        {"shape": "cylinder", "radius_mm": 8.0, "half_length_mm": 10.0},
    ],
)
def test_a_bare_fingertip_of_any_shape_is_pressed(shape: dict[str, Any]) -> None:
    settings = load(CONFIG / "fingertips.toml")
    index = replace(settings.fingertips["index"], radius_mm=None)
    settings = changed(settings, {"fingertips.index": replace(index, **shape)})
    layout = build_layout(settings, CONFIG)
    scene = demo.presses(settings, layout)
    robot = Robot(settings, layout, scene)
    robot.bring_up()
    [probe] = [one for one in scene.probe if one.part == "index"]
    while robot.t_ns < (probe.start_s + 1.0) * 1e9:
        robot.step(0.1)
    [press] = robot.fingertips.lately["index"][-1].presses
    assert press.normal_n == pytest.approx(2.0)
