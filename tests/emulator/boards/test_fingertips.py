"""Fingertips of an emulated robot: what the host reads is what lies on them."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from emulator.boards.fingertips import TOWARDS, place_on
from emulator.faults import parse
from emulator.probes.held_objects import HeldObjects
from emulator.probes.scene import Fault, Place, Probe, Scene
from emulator.robot import Robot
from skin_host.bus.strain import start_frames
from skin_host.bus.wire import FrameBatch
from skin_host.config.fingertips import Fingertip
from skin_host.config.settings import changed, load
from skin_host.errors import ConfigurationError
from skin_host.fingertip.events import Slip
from skin_host.fingertip.health import FingertipHealth
from skin_host.layout import build_layout
from skin_host.processing.core import Engine
from skin_host.processing.events import Touch

CONFIG = Path(__file__).parents[3] / "config"
PATH = CONFIG / "fingertips.toml"


class World:
    """The robot of the shipped configuration and an engine that has been calibrated."""

    def __init__(self, *probes: dict[str, Any], noise: bool = True) -> None:
        # So fast that less than two seconds, before anything presses, are enough to calibrate.
        settings = load(PATH)
        hand = msgspec.structs.replace(settings.boards["hand"], period_ms=20)
        self.settings = changed(settings, {"boards.hand": hand})
        layout = build_layout(self.settings, CONFIG)
        scene = Scene(
            probe=[msgspec.convert(probe, Probe) for probe in probes],
            spread=False,
            quiet=True,
            noise=noise,
        )
        self.robot = Robot(self.settings, layout, scene)
        self.robot.bring_up()
        for tip in self.settings.fingertips.values():
            for can_id, data in start_frames(tip.address, tip.period_ms):
                self.robot.receive("can0", can_id, data)
        self.engine = Engine(self.settings, layout, [0])
        self.engine.begin_calibration(1.6)
        self.events: list[Any] = []
        self.run(1.8)
        self.engine.use(self.engine.end_calibration("2026-01-01T00:00:00+00:00"))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.02)):
            self.events += self.engine.feed("can0", self.step()).grasps
            self.events += self.engine.expire(self.robot.t_ns).grasps

    def step(self) -> FrameBatch:
        return self.robot.step(0.02)["can0"]

    def touches(self, part: str) -> list[Touch]:
        return [one for one in self.events if isinstance(one, Touch) and one.part == part]

    def slips(self) -> list[Slip]:
        return [one for one in self.events if isinstance(one, Slip)]


def test_the_host_finds_the_press_on_a_bare_fingertip_where_it_is() -> None:
    direction = np.array([0.3, 0.4, 0.87])
    direction /= np.linalg.norm(direction)
    world = World(
        {
            "part": "index",
            "at": {"towards": direction.tolist()},
            "force_n": [[2, 0], [2.3, 2], [4, 2], [4.3, 0]],
        }
    )
    world.run(4.0)
    told = world.touches("index")
    assert [told[0].event, told[-1].event] == ["begin", "end"]
    held = [one for one in told if 2_600_000_000 < one.t_ns < 4_000_000_000]
    place_mm = 1e3 * np.array([one.centroid_m for one in held])
    assert np.abs(place_mm - 13.0 * direction).max() < 0.4
    assert np.mean([one.force_n for one in held]) == pytest.approx(2.0, abs=0.02)
    assert not world.slips()


def test_an_object_that_is_pulled_too_hard_slips_and_the_host_tells_before_a_millimetre() -> None:
    world = World(
        {
            "part": "index",
            "force_n": [[2, 0], [2.3, 2], [5, 2]],
            "tangential_n": [[2, 0], [3, 0], [4.5, 1.3], [4.6, 0], [5, 0]],
        }
    )
    while not world.slips() and world.robot.t_ns < 5_000_000_000:
        world.run(0.02)
    assert 0.0 < world.robot.fingertips.slipped_mm("index") < 0.5
    assert world.slips()[0].event == "begin"
    assert world.slips()[0].t_ns == pytest.approx(4_390_000_000, abs=20_000_000)


def test_skin_and_board_of_the_thumb_make_one_estimate_in_one_frame() -> None:
    world = World(
        {
            "part": "thumb_skin",
            "at": {"x_mm": 3, "y_mm": -2},
            "diameter_mm": 8,
            "force_n": [[2, 0], [2.3, 3], [4, 3], [4.3, 0]],
        }
    )
    world.run(4.0)
    held = [one for one in world.touches("thumb") if 2_800_000_000 < one.t_ns < 4_000_000_000]
    assert held
    for one in held:
        assert one.load is not None and one.load.verdict == "contact"
        assert one.taxels
        assert one.centroid_m is not None
        np.testing.assert_allclose(1e3 * np.array(one.centroid_m), [3, -2, 0], atol=0.4)
    assert held[-1].force_n == pytest.approx(3.0, rel=0.03)


def test_a_contact_of_the_skin_that_was_ended_is_not_joined_any_more() -> None:
    world = World(
        {"part": "thumb_skin", "diameter_mm": 8, "force_n": [[2, 0], [2.3, 3], [60, 3]]},
    )
    world.run(1.5)
    assert world.touches("thumb")[-1].taxels
    world.engine.disabled.add(0)
    world.engine.end_part(0, world.robot.t_ns)
    world.run(0.06)
    world.engine.disabled.clear()
    world.run(1.2)  # the skin begins a new contact, the only one
    last = world.touches("thumb")[-1]
    assert last.load is not None and last.load.verdict == "contact"


def test_without_a_host_the_boards_stream_too() -> None:
    settings = load(PATH)
    robot = Robot(settings, build_layout(settings, CONFIG))
    robot.bring_up()
    batch = robot.step(0.3)["can0"]
    assert np.count_nonzero(batch.id == 0x31A) == pytest.approx(100, abs=2)
    assert np.count_nonzero(batch.id == 0x32B) == pytest.approx(30, abs=2)


def test_frames_of_configured_boards_are_no_strangers() -> None:
    world = World()
    counters = world.engine.assemblers["can0"].counters
    assert counters.force_torque == pytest.approx(2 * (180 + 600), abs=12)
    # Answers: four to the bring-up at the most, and six full scales of each board.
    assert counters.other < 30
    assert counters.short == counters.unknown_board == 0


def test_a_silent_board_is_known_and_its_touch_ends() -> None:
    world = World({"part": "index", "force_n": [[2.0, 0], [2.1, 2], [60, 2]]})
    world.run(1.0)
    assert world.engine.fingertips is not None
    state = world.engine.fingertips.tips["index"]
    assert state.tip.touched
    mend = world.robot.inject(parse("board_silent board=index"))
    world.run(1.0)
    assert (state.alive, state.silenced, state.tip.touched) == (False, 1, False)
    mend()
    world.run(0.2)
    assert state.alive and state.tip.touched


def test_boards_without_noise_are_not_taken_for_frozen() -> None:
    world = World({"part": "index", "force_n": [[4.5, 0], [4.6, 2], [6.0, 2]]}, noise=False)
    assert world.engine.fingertips is not None
    world.run(2.0)
    for state in world.engine.fingertips.tips.values():
        assert state.frozen.trusted and state.tip.zeroed
        assert state.tip.feels and not state.tip.touched
    world.run(1.0)
    (begin,) = [one for one in world.touches("index") if one.event == "begin"]
    assert world.touches("index")[-1].force_n == pytest.approx(2.0, rel=0.1)
    assert begin.t_ns == pytest.approx(4_513_000_000, abs=6_000_000)


def test_a_board_that_was_silent_sends_nothing_of_that_time_when_it_is_back() -> None:
    world = World()
    mends = [world.robot.inject(parse("board_silent board=index")) for _ in range(2)]
    world.robot.step(3.0)
    mends[0]()
    assert 0x31A not in world.robot.step(0.3)["can0"].id
    mends[1]()
    batch = world.robot.step(0.3)["can0"]
    assert np.count_nonzero(batch.id == 0x31A) == pytest.approx(100, abs=2)
    assert batch.t_ns[0] > world.robot.t_ns - 300_000_000


def test_the_object_of_a_board_that_was_silent_for_long_is_not_moved_through_all_that_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    moved_s: list[float] = []
    advance = HeldObjects.advance

    def note(one: HeldObjects, load_n: Any, normal_n: Any, dt_s: float) -> Any:
        moved_s.append(dt_s)
        return advance(one, load_n, normal_n, dt_s)

    monkeypatch.setattr(HeldObjects, "advance", note)
    held = {"part": "index", "force_n": [[0, 2], [90, 2]], "tangential_n": [[0, 0.5], [90, 0.5]]}
    world = World(held)
    mend = world.robot.inject(parse("board_silent board=index"))
    world.robot.step(30.0)
    mend()
    world.robot.step(0.1)
    assert max(moved_s) == 1.0
    assert sorted(moved_s)[-2] == pytest.approx(0.003)


@pytest.mark.parametrize(
    ("value", "latched"),
    [(None, [0x31A, 0x31B]), (0, [0x31A, 0x31B]), (1, [0x31A]), (2, [0x31B])],
)
def test_a_latched_board_repeats_its_last_frames_whatever_presses(
    value: float | None, latched: list[int]
) -> None:
    world = World({"part": "index", "force_n": [[2.0, 0], [2.1, 2], [60, 2]]})

    def sent(can_id: int, seconds: float = 0.5) -> set[bytes]:
        batch = world.robot.step(seconds)["can0"]
        return {batch.data[row].tobytes() for row in np.flatnonzero(batch.id == can_id)}

    mend = world.robot.inject(Fault(name="board_latched", board="index", value=value))
    for can_id in (0x31A, 0x31B, 0x32A, 0x32B):
        assert (len(sent(can_id)) == 1) == (can_id in latched), hex(can_id)
    branch = Robot.restore(world.robot.save(), world.settings, world.robot.layout)
    assert (branch.step(0.1)["can0"].data == world.robot.step(0.1)["can0"].data).all()
    mend()
    assert all(len(sent(can_id)) > 10 for can_id in (0x31A, 0x31B))


def test_health_names_a_latched_board_and_its_touch_ends() -> None:
    world = World({"part": "index", "force_n": [[2.2, 0], [2.3, 2], [60, 2]]})
    world.run(1.0)
    mend = world.robot.inject(parse("board_latched board=index"))
    world.run(1.0)
    assert world.engine.fingertips is not None
    health = FingertipHealth(world.engine.fingertips)
    records = health.records(world.robot.t_ns)
    assert [one["code"] for one in records["index"]["faults"]] == ["fingertip_frozen"]
    assert records["thumb"]["faults"] == []
    assert world.touches("index")[-1].reason == "lost"
    mend()
    world.run(0.2)
    assert health.records(world.robot.t_ns)["index"]["faults"] == []
    assert world.touches("index")[-1].event != "end"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("board_latched board=hand", 'board: no fingertip "hand"; there are: index, thumb'),
        ("board_latched", "board: missing"),
        ("board_latched board=index value=3", "value: 3; wanted a whole number, 0 to 2"),
        ("board_latched board=index value=0.5", "value: 0.5; wanted a whole number, 0 to 2"),
        ("board_silent board=foot", 'board: no board "foot"; there are: hand, index, thumb'),
        ("board_reset board=index", 'board: no board "index"; there are: hand'),
    ],
)
def test_a_fault_names_a_board_that_can_have_it(line: str, said: str) -> None:
    settings = load(PATH)
    robot = Robot(settings, build_layout(settings, CONFIG))
    with pytest.raises(ConfigurationError) as caught:
        robot.inject(parse(line))
    assert str(caught.value).startswith(said)


@pytest.mark.parametrize(
    ("probe", "said"),
    [
        ({"part": "index", "depth_mm": [[0, 1], [1, 1]]}, "probe[0].depth_mm"),
        ({"part": "thumb", "force_n": [[0, 1], [1, 1]]}, 'probe[0].part: "thumb" is covered'),
        ({"part": "index", "force_n": [[0, 1], [1, 1]], "at": {"taxel": 1}}, "probe[0].at"),
        (
            {"part": "index", "force_n": [[0, 1], [1, 1]], "at": {"towards": [0, 0, 0]}},
            "probe[0].at.towards",
        ),
        (
            {"part": "index", "force_n": [[0, 1], [1, 1]], "at": {"x_mm": 20}},
            'probe[0].at: the sphere "index" is not reached from 20, 0, 0 mm in the direction 0, ',
        ),
        ({"part": "ring", "force_n": [[0, 1], [1, 1]]}, "probe[0].part"),
        (
            {"part": "index", "force_n": [[0, 1], [1, 1]], "slide_mm": [[0, 0, 0], [1, 500, 0]]},
            "probe[0].slide_mm: 500 mm, 0 mm; the fingertip is not below that place",
        ),
        (
            {"part": "index", "force_n": [[0, 1], [1, 1]], "slide_mm": [[0, -9, -10], [1, 0, 0]]},
            "probe[0].slide_mm: -9 mm, -10 mm; the fingertip is not below that place",
        ),
        (
            {
                "part": "thumb_skin",
                "force_n": [[0, 1], [1, 1]],
                "slide_mm": [[0, 0, 0], [1, 0, 17]],
            },
            "probe[0].slide_mm: 0 mm, 17 mm; the fingertip is not below that place",
        ),
    ],
)
def test_a_probe_that_cannot_be_on_its_fingertip_is_refused(
    probe: dict[str, Any], said: str
) -> None:
    settings = load(PATH)
    scene = Scene(probe=[msgspec.convert(probe, Probe)])
    with pytest.raises(ConfigurationError) as caught:
        Robot(settings, build_layout(settings, CONFIG), scene)
    assert str(caught.value).startswith(said)


@pytest.mark.parametrize(
    ("shape", "at", "reached"),
    [
        ({"shape": "plane", "reach_mm": 16}, {"x_mm": 9, "y_mm": 13}, True),
        ({"shape": "plane", "reach_mm": 16}, {"x_mm": 10, "y_mm": 13}, False),
        ({"shape": "plane"}, {"x_mm": 1000}, True),
        ({"shape": "cylinder", "radius_mm": 8, "half_length_mm": 10}, {"z_mm": 9}, True),
        ({"shape": "cylinder", "radius_mm": 8, "half_length_mm": 10}, {"z_mm": 11}, False),
        ({"shape": "cylinder", "radius_mm": 8}, {"z_mm": 11}, True),
        ({"shape": "ellipsoid", "semi_axes_mm": (5, 6, 7)}, {"z_mm": 6.9}, True),
        ({"shape": "ellipsoid", "semi_axes_mm": (5, 6, 7)}, {"z_mm": 7.1}, False),
    ],
)
def test_a_place_beyond_the_end_of_a_fingertip_is_refused(
    shape: dict[str, Any], at: dict[str, float], reached: bool
) -> None:
    tip = msgspec.convert({"address": 1, "bus": "can0", "sensor_mm": [0, 0, 0], **shape}, Fingertip)
    place = Place(towards=(1.0, 0.0, 0.0), **at)
    probe = Probe(part="index", force_n=[(0, 1)], at=place)
    if reached:
        place_on(tip, probe)
        return
    with pytest.raises(ConfigurationError, match=r'at: the .* "index" is not reached from'):
        place_on(tip, probe)


SHAPES: dict[str, dict[str, Any]] = {
    "sphere": {"shape": "sphere", "radius_mm": 8},
    "ellipsoid": {"shape": "ellipsoid", "semi_axes_mm": (8, 8, 12)},
    "plane": {"shape": "plane"},
    "small plane": {"shape": "plane", "reach_mm": 10},
    "cylinder": {"shape": "cylinder", "radius_mm": 8},
    "short cylinder": {"shape": "cylinder", "radius_mm": 8, "half_length_mm": 10},
}


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_a_probe_without_a_place_presses_a_fingertip_of_any_shape(shape: dict[str, Any]) -> None:
    """As those of `skin demo` and `skin simulate` do."""
    tip = msgspec.convert({"address": 1, "bus": "can0", "sensor_mm": [0, 0, 0], **shape}, Fingertip)
    point_mm, normal = place_on(tip, Probe(part="index", force_n=[(0, 1)]))
    assert normal.tolist() == list(TOWARDS[tip.shape])
    assert point_mm == pytest.approx(normal * point_mm.max())


def test_a_probe_can_slide_to_the_edge_of_its_fingertip() -> None:
    slide = [(0.0, 0.0, 0.0), (1.0, 12.9, 0.0), (2.0, -9.0, 9.0)]
    world = World({"part": "index", "force_n": [[0, 2], [9, 2]], "slide_mm": slide})
    world.run(2.5)
    assert world.robot.fingertips.lately["index"][-1].presses


def test_the_loads_that_a_board_measured_lately_are_known_and_older_ones_forgotten() -> None:
    world = World({"part": "index", "force_n": [[2, 0], [2.1, 2], [9, 2]]})
    for _ in range(4):
        world.run(1.0)
        lately = world.robot.fingertips.lately["index"]
        now_ns = world.robot.t_ns
        assert lately[-1].t_ns > now_ns - 5_000_000
        assert now_ns - 2_010_000_000 < lately[0].t_ns <= now_ns - 1_000_000_000
    [press] = lately[-1].presses
    assert press.normal_n == pytest.approx(2.0)
    assert press.normal.tolist() == [0.0, 0.0, 1.0]
    assert press.point_mm.tolist() == pytest.approx([0.0, 0.0, 13.0])
    assert lately[-1].wrench.tolist() == pytest.approx([0.0, 0.0, -2.0, 0.0, 0.0, 0.0])
    # The thumb, which nothing presses, is known to be free.
    assert not world.robot.fingertips.lately["thumb"][-1].presses


def test_samples_are_off_by_the_noise_and_the_unit_that_a_board_states() -> None:
    world = World()
    force_n, torque_nm = world.robot.fingertips.off("index")
    assert force_n == pytest.approx(50.0 * (5e-5 + 2.0**-15))
    assert torque_nm == pytest.approx(1.0 * (5e-5 + 2.0**-15) + 0.025 * force_n)
    still = World(noise=False).robot.fingertips.off("index")
    assert still[0] == pytest.approx(50.0 * 2.0**-15)
