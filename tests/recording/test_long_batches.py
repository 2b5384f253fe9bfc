"""Recordings whose recorder was held up: long batches hold what many short ones would."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from emulator.probes.scene import Probe, Scene
from emulator.probes.scene import load as load_scene
from emulator.robot import Robot
from skin_host.bus.strain import start_frames
from skin_host.bus.wire import FrameBatch
from skin_host.layout import load_skin
from skin_host.processing.core import Engine
from skin_host.recording.mcap import Recorder
from skin_host.recording.replay import calibrate_from_log, read_buses, replay

ROOT = Path(__file__).parents[2]
FINGERTIPS = ROOT / "config" / "fingertips.toml"
SMALL = ROOT / "tests" / "evaluation" / "simulate" / "small.toml"
T0_NS = 1_763_700_000 * 10**9
SECONDS = 12.0
PRESS = Probe(
    part="cuff", diameter_mm=12, pressure_kpa=[(0, 0), (0.1, 60), (2, 60), (2.1, 0)], start_s=6.0
)


def frames_of(config: Path, scene: Scene) -> dict[str, list[tuple[int, bytes, int]]]:
    """Return what each channel sends."""
    settings, layout = load_skin(config)
    robot = Robot(settings, layout, scene)
    robot.bring_up()
    for tip in settings.fingertips.values():
        for can_id, data in start_frames(tip.address, tip.period_ms):
            robot.receive(tip.bus, can_id, data)
    found: dict[str, list[tuple[int, bytes, int]]] = {}
    while robot.t_ns < SECONDS * 1e9:
        for bus, batch in robot.step(0.05).items():
            frames = found.setdefault(settings.buses[bus].channel, [])
            frames += [
                (
                    int(batch.id[row]),
                    batch.data[row, : batch.dlc[row]].tobytes(),
                    T0_NS + int(batch.t_ns[row]),
                )
                for row in range(len(batch))
            ]
    return found


def in_batches(
    frames: dict[str, list[tuple[int, bytes, int]]], length_ns: int
) -> Iterator[tuple[str, FrameBatch]]:
    """Yield them in batches of some length, channel by channel, as a recorder reads them."""
    for begin_ns in range(T0_NS, T0_NS + int(SECONDS * 1e9), length_ns):
        for channel, of_channel in frames.items():
            batch = [one for one in of_channel if begin_ns <= one[2] < begin_ns + length_ns]
            if batch:
                yield channel, FrameBatch.of(batch)


@pytest.mark.parametrize(
    ("config", "scene"),
    [
        (FINGERTIPS, lambda: load_scene(ROOT / "config" / "scenes" / "fingertips.toml")),
        (SMALL, lambda: Scene(quiet=True, probe=[PRESS])),
    ],
    ids=["fingertips", "two buses"],
)
def test_the_length_of_recorded_batches_changes_nothing(
    config: Path, scene: Callable[[], Scene], tmp_path: Path
) -> None:
    frames = frames_of(config, scene())
    settings, layout = load_skin(config)
    results = []
    for length_ms in (4, 100, 250, 1000):
        path = tmp_path / f"{length_ms}.mcap"
        with Recorder(path) as recorder:
            for channel, batch in in_batches(frames, length_ms * 1_000_000):
                recorder.can(channel, batch)
        spans_ns = [batch.t_ns[-1] - batch.t_ns[0] for _, batch in read_buses(path, settings)]
        assert max(spans_ns) <= 4_000_000
        found = calibrate_from_log(path, settings, layout, 5.0)
        engine = Engine(settings, layout, list(range(len(layout.parts))), found)
        outputs = list(replay(path, engine))
        results.append(
            (
                [
                    (step.part, step.frame.t_ns, step.frame.valid.all(), step.frame.raw.tobytes())
                    for output in outputs
                    for step in output.steps
                ],
                [
                    (event.part, event.event, event.t_ns)
                    for output in outputs
                    for event in output.events
                ],
            )
        )
    assert results[0][1]
    assert all(result == results[0] for result in results[1:])
