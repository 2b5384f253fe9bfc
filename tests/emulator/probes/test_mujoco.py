"""Contacts of a MuJoCo simulation press the foam: with their force, at their place."""

import os
from pathlib import Path

import msgspec
import numpy as np
import pytest

from emulator.probes.contacts import Contacts
from emulator.probes.mujoco_model import MujocoModel
from emulator.probes.scene import Place, Probe, Scene
from emulator.probes.skin import MOVING_NS, Skin
from emulator.robot import Robot
from skin_host.config.settings import Settings, load
from skin_host.errors import ConfigurationError, RequestError, SkinError
from skin_host.layout import Layout, build_layout
from skin_host.processing.core import Engine

mujoco = pytest.importorskip("mujoco")

CONFIG = Path(__file__).parents[3] / "config"


def flat_layout() -> Layout:
    """An arm whose forearm is not wound around it: a model's plane is its foam."""
    settings = load(CONFIG / "icub_2011_arm.toml")
    forearm = settings.parts["left_forearm"]
    patches = [msgspec.structs.replace(patch, places=[]) for patch in forearm.patches]
    flat = msgspec.structs.replace(forearm, patches=patches)
    parts = settings.parts | {"left_forearm": flat}
    return build_layout(msgspec.structs.replace(settings, parts=parts), CONFIG)


LAYOUT = flat_layout()
FOREARM = """
  <body name="forearm" pos="0.3 0.2 0.1" euler="20 -30 70">
    <geom type="box" size=".07 .05 .01" pos=".048 .036 -.01"/>
    <site name="left_forearm"/>
    {on_it}
  </body>"""
BALL = """
    <body name="ball{n}" pos="{x} {y} .0032">
      <joint name="push{n}" type="slide" axis="0 0 1"/>
      <joint name="slide{n}" type="slide" axis="1 0 0" damping="5"/>
      <geom size=".003" mass=".1" condim="1" priority="1"/>
    </body>"""


def load_skin(name: str) -> tuple[Settings, Layout]:
    settings = load(CONFIG / f"{name}.toml")
    return settings, build_layout(settings, CONFIG)


def written(folder: Path, bodies: str, rest: str = "", option: str = "") -> Path:
    path = folder / "model.xml"
    path.write_text(
        f'<mujoco><compiler angle="degree"/><option timestep="0.001" '
        f'gravity="0 0 0" integrator="implicitfast" {option}/>'
        f"<worldbody>{bodies}</worldbody>{rest}</mujoco>"
    )
    return path


def balls(folder: Path, places_mm: list[tuple[float, float]], option: str = "") -> Path:
    """Balls of 6 mm on a flat forearm, which lies across; each can be pushed and slid."""
    on_it = "".join(
        BALL.format(n=n, x=x_mm / 1e3, y=y_mm / 1e3) for n, (x_mm, y_mm) in enumerate(places_mm)
    )
    actuators = "".join(
        f'<motor name="push{n}" joint="push{n}"/>'
        f'<velocity name="slide{n}" joint="slide{n}" kv="20"/>'
        for n in range(len(places_mm))
    )
    return written(folder, FOREARM.format(on_it=on_it), f"<actuator>{actuators}</actuator>", option)


class Lying:
    """The skin of an arm under a model, without its boards, over time."""

    def __init__(self, path: Path, scene: Scene | None = None) -> None:
        self.model = MujocoModel(path, LAYOUT)
        self.skin = Skin(LAYOUT, scene or Scene(), (), self.model)
        self._t_ns = 0

    def go_on(self, seconds: float) -> int:
        """Let time pass; how many taxels may have changed in the last step."""
        changed = 0
        for _ in range(round(seconds * 1e9) // MOVING_NS):
            self._t_ns += MOVING_NS
            changed = len(self.skin.step(self._t_ns))
        return changed

    def kpa(self, part: str) -> np.ndarray:
        """True pressure on the part."""
        found = LAYOUT.part(part)
        return self.skin.true_pressure_kpa()[found.start : found.stop]


def simulated(model: MujocoModel) -> tuple[float, np.ndarray]:
    """Sum (N) and centre (m, in the forearm's frame) of all contacts, by MuJoCo's own function."""
    total_n, moment = 0.0, np.zeros(3)
    for number in range(model.data.ncon):
        force = np.zeros(6)
        mujoco.mj_contactForce(model.model, model.data, number, force)
        total_n += force[0]
        moment += force[0] * model.data.contact[number].pos
    site = model.data.site("left_forearm")
    return total_n, (moment / total_n - site.xpos) @ site.xmat.reshape(3, 3)


def felt(skin: Skin) -> tuple[float, np.ndarray]:
    """Sum (N) and centre (m) of what the foam bears."""
    force_n, places_mm = skin.source_force_n(), skin.contacts.place_mm
    return force_n.sum(), force_n @ places_mm / force_n.sum() / 1e3


def assert_conserved(lying: Lying) -> None:
    wanted_n, wanted_m = simulated(lying.model)
    seen_n, seen_m = felt(lying.skin)
    assert seen_n == pytest.approx(wanted_n, rel=0.01)
    assert np.linalg.norm((seen_m - wanted_m)[:2]) < 0.5e-3


@pytest.mark.parametrize("option", ['cone="pyramidal"', 'cone="elliptic"'])
def test_the_foam_bears_a_ball_with_its_force_at_its_place(tmp_path: Path, option: str) -> None:
    rng = np.random.default_rng(4)
    for x_mm, y_mm in rng.uniform([5, 10], [90, 60], (4, 2)).tolist():
        lying = Lying(balls(tmp_path, [(x_mm, y_mm)], option))
        lying.model.set_control("push0", -1.5)
        lying.go_on(0.3)
        assert felt(lying.skin)[0] == pytest.approx(1.5, rel=0.02)
        assert_conserved(lying)
        (place_mm,) = lying.skin.contacts.place_mm
        assert np.hypot(*(place_mm[:2] - [x_mm, y_mm])) < 0.5


def test_the_pads_bear_their_share_around_the_ball_s_place(tmp_path: Path) -> None:
    """Over many places the pads' own pressures are centred on the ball, and add up to their
    share of its area.
    """
    part = LAYOUT.part("left_forearm")
    mine = slice(part.start, part.stop)
    pad_mm2 = np.pi * np.asarray(LAYOUT.radius_mm)[mine] ** 2
    lying = Lying(balls(tmp_path, [(20.0, 36.0)]), Scene(spread=False, noise=False))
    lying.model.set_control("push0", -1.0)
    lying.go_on(0.1)
    lying.model.set_control("slide0", 0.1)
    off_mm, shares = [], []
    for _ in range(100):
        lying.go_on(0.005)
        borne_n = lying.kpa("left_forearm") * pad_mm2 * 1e-3
        shares.append(borne_n.sum())
        if borne_n.sum() > 0:
            centre_mm = borne_n @ LAYOUT.position_m[mine, :2] * 1e3 / borne_n.sum()
            off_mm.append(centre_mm - lying.skin.contacts.place_mm[0, :2])
    # What is under the ball but under no pad is foam too; pads are two fifths of this skin.
    assert 0.25 < np.mean(shares) < 0.6
    assert max(shares) <= 1.01
    assert abs(np.mean(off_mm, axis=0)[0]) < 0.4
    assert np.median(np.linalg.norm(off_mm, axis=1)) < 1.6


def test_several_balls_press_each_with_its_own_force(tmp_path: Path) -> None:
    places_mm = [(10.0, 20.0), (40.0, 30.0), (44.0, 38.0), (80.0, 55.0)]
    lying = Lying(balls(tmp_path, places_mm))
    for n in range(4):
        lying.model.set_control(f"push{n}", -0.5 * (n + 1))
    lying.go_on(0.3)
    contacts = lying.skin.contacts
    order = np.argsort(contacts.force_n)
    np.testing.assert_allclose(lying.skin.source_force_n()[order], [0.5, 1, 1.5, 2], rtol=0.02)
    np.testing.assert_allclose(contacts.place_mm[order, :2], places_mm, atol=0.5)
    assert_conserved(lying)


def test_a_sliding_ball_is_where_it_is_all_the_way(tmp_path: Path) -> None:
    lying = Lying(balls(tmp_path, [(15.0, 35.0)]))
    lying.model.set_control("push0", -1.0)
    lying.go_on(0.2)
    lying.model.set_control("slide0", 0.2)
    for _ in range(60):
        lying.go_on(0.005)
        assert_conserved(lying)
    assert lying.skin.contacts.place_mm[0, 0] > 50


def test_an_object_of_the_scene_presses_beside_the_simulation_s(tmp_path: Path) -> None:
    probe = Probe(part="left_hand", at=Place(taxel=20), force_n=[(0, 2.0), (9, 2.0)])
    lying = Lying(balls(tmp_path, [(40.0, 40.0)]), Scene(probe=[probe]))
    lying.model.set_control("push0", -1.0)
    lying.go_on(0.3)
    assert lying.skin.contact_force_n() == {0: pytest.approx(2.0, rel=0.01)}
    assert lying.skin.source_force_n() == pytest.approx([1.0], rel=0.01)
    assert lying.kpa("left_hand").max() > 20
    lying.model.set_control("push0", 1.0)
    lying.go_on(0.3)
    assert not len(lying.skin.contacts)
    assert lying.kpa("left_forearm").max() == 0


def test_probes_that_come_while_others_slide_are_found() -> None:
    def sliding(taxel: int, start_s: float) -> Probe:
        return Probe(
            part="left_forearm",
            at=Place(taxel=taxel),
            force_n=[(0, 1.0), (2, 1.0)],
            slide_mm=[(0, 0, 0), (2, 20, 0)],
            start_s=start_s,
        )

    skin = Skin(LAYOUT, Scene(probe=[sliding(20, 0.0), sliding(60, 0.1)]))
    for t_ns in range(MOVING_NS, 300_000_000, MOVING_NS):
        skin.step(t_ns)
    assert set(skin.contact_force_n()) == {0, 1}


def test_what_meets_the_body_beside_its_skin_presses_no_taxel(tmp_path: Path) -> None:
    lying = Lying(balls(tmp_path, [(115.0, 80.0)]))
    lying.model.set_control("push0", -1.0)
    lying.go_on(0.2)
    assert not len(lying.skin.contacts)
    assert lying.skin.contacts_beside.force_n == pytest.approx([1.0], rel=0.02)
    assert lying.kpa("left_forearm").max() == 0


def test_a_contact_of_two_parts_presses_both(tmp_path: Path) -> None:
    hand = """
      <body name="hand" pos=".04 .04 .0102" euler="180 0 0">
        <joint name="push0" type="slide" axis="0 0 -1"/>
        <geom type="sphere" size=".01" pos="0 0 -.01" mass=".1"/><site name="left_hand"/>
      </body>"""
    path = written(
        tmp_path,
        FOREARM.format(on_it=hand),
        '<actuator><motor name="push0" joint="push0"/></actuator>',
    )
    model = MujocoModel(path, LAYOUT)
    model.set_control("push0", -2.0)
    found = [model.at(t_ns) for t_ns in range(0, 500_000_000, 5_000_000)][-1]
    names = sorted(LAYOUT.parts[part].name for part in found.part)
    assert names == ["left_forearm", "left_hand"]
    assert found.force_n == pytest.approx([2.0, 2.0], rel=0.02)
    # Each sees the other come from outside.
    np.testing.assert_allclose(found.normal, [[0, 0, 1], [0, 0, 1]], atol=1e-3)


def test_a_sphere_presses_a_disc_as_large_as_the_foam_gives_way(tmp_path: Path) -> None:
    radii_mm = []
    lying = Lying(balls(tmp_path, [(40.0, 40.0)]))
    for push_n in (-0.02, -0.2, -5.0):
        lying.model.set_control("push0", push_n)
        lying.go_on(0.3)
        radii_mm.append(lying.skin.contacts.radius_mm[0])
    assert radii_mm[0] < radii_mm[1] < radii_mm[2]
    assert radii_mm[2] == pytest.approx(3.0)


def test_where_nothing_touches_no_foam_is_computed(tmp_path: Path) -> None:
    assert Lying(balls(tmp_path, [(40.0, 40.0)])).go_on(0.1) == 0


def gripping(seed: int = 1) -> tuple[Robot, MujocoModel]:
    """The gripper as it closes."""
    settings, layout = load_skin("gripper")
    model = MujocoModel(CONFIG / "scenes" / "gripper.xml", layout)
    for finger in ("left", "right"):
        model.set_control(finger, 0.01)
    return Robot(settings, layout, Scene(seed=seed), source=model), model


def test_the_same_model_and_seed_send_the_same_bytes_however_they_are_stepped() -> None:
    sent = []
    for step_s in (0.05, 4.5):
        robot, _ = gripping(seed=3)
        robot.bring_up()
        batches = [robot.step(step_s)["can0"] for _ in range(round(4.5 / step_s))]
        assert len(robot.skin.contacts)
        sent.append(np.concatenate([batch.data for batch in batches]))
    np.testing.assert_array_equal(*sent)


def test_keyframes_drive_the_actuators_and_begin_again(tmp_path: Path) -> None:
    body = '<body><joint name="j" type="slide"/><geom size=".1" mass="1"/></body>'
    rest = """
      <actuator><motor name="m" joint="j"/></actuator>
      <keyframe><key time="0" ctrl="0"/><key time="1" ctrl="2"/><key time="2" ctrl="2"/></keyframe>
      <custom><numeric name="repeat_s" data="4"/></custom>"""
    path = written(tmp_path, body + FOREARM.format(on_it=""), rest)
    model = MujocoModel(path, LAYOUT)
    seen = []
    for t_s in (0.5, 1.0, 1.5, 3.0, 4.25):
        model.at(round(t_s * 1e9))
        seen.append(model.data.ctrl[0])
    assert seen == pytest.approx([1.0, 2.0, 2.0, 2.0, 0.5])
    model.set_control("m", -7.0)
    model.at(5_000_000_000)
    assert model.data.ctrl[0] == -7.0


def touches_of(
    robot: Robot, engine: Engine, seconds: float
) -> list[tuple[float, str, str, list[float] | None]]:
    told = []
    until_ns = robot.t_ns + seconds * 1e9
    while robot.t_ns < until_ns:
        for step in engine.feed("can0", robot.step(0.02)["can0"]).steps:
            told += [(one.t_ns * 1e-9, one.part, one.event, one.centroid_m) for one in step.events]
    return told


def calibrated(robot: Robot, seconds: float) -> Engine:
    robot.bring_up()
    engine = Engine(robot.settings, robot.layout, list(range(len(robot.layout.parts))))
    engine.begin_calibration(seconds)
    while engine.calibration_progress() < 1.0:
        engine.feed("can0", robot.step(0.02)["can0"])
    engine.use(engine.end_calibration("2026-01-01T00:00:00+00:00"))
    return engine


def test_the_arm_bumps_into_the_post_and_the_host_tells_where() -> None:
    settings, layout = load_skin("demo")
    model = MujocoModel(CONFIG / "scenes" / "arm.xml", layout)
    robot = Robot(settings, layout, Scene(quiet=True), source=model)
    engine = calibrated(robot, 2.0)
    robot.step(5.9 - robot.t_ns * 1e-9)
    told = touches_of(robot, engine, 1.6)
    begun = [one for one in told if one[2] == "begin"]
    assert {part for _, part, _, _ in begun} == {"left_forearm"}
    contacts = robot.skin.contacts
    assert len(contacts) == 1
    for place_mm in contacts.place_mm:
        ways_mm = [
            np.linalg.norm(np.array(where) * 1e3 - place_mm)
            for _, _, _, where in told
            if where is not None
        ]
        assert min(ways_mm) < 5.0


def test_a_gripper_that_stops_on_touch_does_not_crush_the_ball() -> None:
    robot, model = gripping()
    # They reach the ball after three seconds.
    engine = calibrated(robot, 1.0)
    closing = {"left_finger", "right_finger"}
    for _ in range(250):
        for _, part, event, _ in touches_of(robot, engine, 0.02):
            if event == "begin":
                model.set_control(part.removesuffix("_finger"), 0.0)
                closing.discard(part)
    assert not closing
    held_n = robot.skin.source_force_n()
    assert len(held_n) == 2
    # Fingers that nobody stops press with some 20 N.
    assert 0.05 < held_n.max() < 5.0


@pytest.mark.parametrize(
    ("bodies", "rest", "option", "complaint"),
    [
        ("<geom/>", "", "", "MuJoCo cannot read it"),
        (FOREARM.replace("left_forearm", "arm").format(on_it=""), "", "", "its sites are arm"),
        ("<geom size='.1'/><body><site name='left_hand'/></body>", "", "", "has no geometry"),
        (
            FOREARM.format(on_it=""),
            "<keyframe><key time='1'/><key time='0'/></keyframe>",
            "",
            "run backwards",
        ),
    ],
)
def test_a_model_without_this_skin_is_refused(
    tmp_path: Path, bodies: str, rest: str, option: str, complaint: str
) -> None:
    with pytest.raises(ConfigurationError, match=complaint) as caught:
        MujocoModel(written(tmp_path, bodies, rest, option), LAYOUT)
    assert str(caught.value).startswith(str(tmp_path / "model.xml"))
    assert "\n" not in str(caught.value)


def test_steps_longer_than_the_mechanics_s_are_refused(tmp_path: Path) -> None:
    path = balls(tmp_path, [(40, 40)])
    path.write_text(path.read_text().replace('timestep="0.001"', 'timestep="0.01"'))
    with pytest.raises(ConfigurationError, match=r"timestep 0.01 s; wanted at most 0.005 s"):
        MujocoModel(path, LAYOUT)


def test_an_actuator_that_there_is_not_is_named(tmp_path: Path) -> None:
    model = MujocoModel(balls(tmp_path, [(40, 40)]), LAYOUT)
    with pytest.raises(RequestError, match="no such actuator; there are: push0, slide0"):
        model.set_control("grip", 1.0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e300])
def test_a_control_that_no_simulation_takes_is_refused(tmp_path: Path, value: float) -> None:
    """MuJoCo would go on without any; not a number would let the keyframes have it again."""
    model = MujocoModel(balls(tmp_path, [(40, 40)]), LAYOUT)
    with pytest.raises(RequestError, match=r"push0: seen .*, wanted a number from -1e\+10"):
        model.set_control("push0", value)


def test_a_simulation_that_bursts_ends_with_a_sentence_and_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    lying = Lying(balls(tmp_path, [(40, 40)]))
    lying.model.set_control("push0", 9e9)
    with pytest.raises(SkinError, match=r"became unstable at .* smaller option timestep"):
        lying.go_on(1.0)
    assert not list(here.iterdir())
    assert "The simulation is unstable" in caplog.text


def test_a_model_that_is_too_large_or_no_file_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    large = tmp_path / "large.xml"
    with large.open("wb") as file:
        file.truncate(3 * 2**30)  # a sparse file
    os.mkfifo(tmp_path / "pipe.xml")
    with pytest.raises(ConfigurationError, match=r"File size over 2GB is not supported"):
        MujocoModel(large, LAYOUT)
    for path in (here, tmp_path / "pipe.xml", tmp_path / "absent.xml"):
        with pytest.raises(ConfigurationError, match=r"is no file; wanted a model"):
            MujocoModel(path, LAYOUT)
    assert not list(here.iterdir())
    assert capfd.readouterr() == ("", "")


def test_a_robot_under_a_model_is_not_saved() -> None:
    robot, _ = gripping()
    with pytest.raises(RequestError, match="cannot be saved"):
        robot.save()


def test_contacts_that_hardly_move_are_still() -> None:
    one = Contacts(np.array([1]), np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.ones(1), np.ones(1))
    harder = Contacts(one.part, one.place_mm + 0.001, one.normal, 2 * one.force_n, one.radius_mm)
    away = Contacts(one.part, one.place_mm + 0.1, one.normal, one.force_n, one.radius_mm)
    assert harder.is_still(one)
    assert not away.is_still(one)
    assert not Contacts.none().is_still(one)
