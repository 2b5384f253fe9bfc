"""Air presses all pads of a part alike, as scenes say or as it was recorded."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from emulator.probes.scene import Air, AirCourse, Probe, Scene, load, read_air
from emulator.robot import Robot
from skin_host.config.settings import load as load_settings
from skin_host.errors import ConfigurationError
from skin_host.evaluation import insole
from skin_host.layout import build_layout

CONFIG = Path(__file__).parents[3] / "config" / "demo.toml"
RECORDING = CONFIG.parents[1] / "../shared/data/insole/left_calibration.npz"


def robot(air: list[Air], **others: object) -> Robot:
    settings = load_settings(CONFIG)
    scene = Scene(noise=False, spread=False, air=air, **others)  # type: ignore[arg-type]
    return Robot(settings, build_layout(settings, CONFIG.parent), scene)


def rise_ff(of: Robot) -> np.ndarray:
    return np.asarray(of.skin.capacitance_ff - of.skin.resting_ff)


def test_all_pads_of_a_part_are_pressed_alike_and_the_others_are_not() -> None:
    blown = robot([Air(part="left_forearm", pressure_kpa=[(0, 0), (1, 100), (3, 100)])])
    blown.step(2.0)

    forearm = blown.layout.part("left_forearm")
    mine = np.zeros(blown.layout.n_taxels, bool)
    mine[forearm.start : forearm.stop] = blown.layout.pad_kind[forearm.start : forearm.stop] == 0
    assert np.ptp(rise_ff(blown)[mine]) == pytest.approx(0, abs=1e-9)
    assert rise_ff(blown)[mine].min() > 50
    assert np.all(rise_ff(blown)[~mine] == 0)
    assert np.all(blown.true_pressure_kpa("left_forearm") == 100)
    assert np.all(blown.true_pressure_kpa("left_hand") == 0)


def test_foam_creeps_under_air_and_comes_back_after_it() -> None:
    blown = robot([Air(part="left_hand", pressure_kpa=[(0, 80), (60, 80)], start_s=1)])
    heights = []
    for seconds in (1.5, 59.0, 1.0, 120.0):
        blown.step(seconds)
        heights.append(rise_ff(blown)[0])

    assert heights[1] > 1.02 * heights[0]
    assert 0 < heights[2] < 0.3 * heights[1]
    assert heights[3] < 0.3 * heights[2]


def test_the_callers_steps_do_not_change_what_happens() -> None:
    course = [Air(part="left_hand", pressure_kpa=[(0, 0), (1, 60), (2, 0)])]
    fine, coarse = robot(course), robot(course)
    for _ in range(130):
        fine.step(0.011)
    coarse.step(1.43)

    np.testing.assert_array_equal(rise_ff(fine), rise_ff(coarse))


def test_infinergy_is_stiffer_than_the_papers_foam() -> None:
    air = [Air(part="left_hand", pressure_kpa=[(0, 0), (1, 100), (2, 100)])]
    soft, stiff = robot(air), robot(air, foam="infinergy")
    for one in (soft, stiff):
        one.step(1.5)

    assert rise_ff(soft)[0] > 4 * rise_ff(stiff)[0]


def test_a_recorded_course_is_read_without_its_spikes(tmp_path: Path) -> None:
    path = tmp_path / "course.csv"
    path.write_text("time_s,pressure_kpa\n100,5\n100.1,5\n100.2,25\n100.3,6\n100.4,-1\n")

    wanted = [(0, 5), (0.1, 5), (0.2, 6), (0.3, 6), (0.4, 0)]
    np.testing.assert_allclose(read_air(path), wanted, atol=1e-9)


def test_a_scene_finds_its_course_beside_itself(tmp_path: Path) -> None:
    (tmp_path / "course.csv").write_text("time_s,pressure_kpa\n0,0\n1,50\n2,50\n")
    (tmp_path / "scene.toml").write_text('[[air]]\npart = "left_hand"\nfile = "course.csv"\n')
    settings = load_settings(CONFIG)
    blown = Robot(settings, build_layout(settings, CONFIG.parent), load(tmp_path / "scene.toml"))
    blown.step(1.5)

    assert np.all(blown.true_pressure_kpa("left_hand") == 50)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("seconds,bar\n0,0\n1,1\n", 'begins with "seconds,bar"'),
        ("time_s,pressure_kpa\n0,0\n", "1 samples; wanted 2 to 1000000"),
        ("time_s,pressure_kpa\n1,0\n0,1\n", "times run backwards"),
        ("time_s,pressure_kpa\n0,0\n1,nan\n", "pressure is no number"),
        ("time_s,pressure_kpa\n0,0\n1,1e9\n", "beyond 10000 kPa"),
        ("time_s,pressure_kpa\n0,0\n1,x\n", "wanted time_s,pressure_kpa"),
    ],
)
def test_a_wrong_course_is_refused_in_one_line(tmp_path: Path, text: str, wrong: str) -> None:
    path = tmp_path / "course.csv"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as refused:
        robot([Air(part="left_hand", file=str(path))])

    assert wrong in str(refused.value)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("scene", "wrong"),
    [
        (Scene(air=[Air(part="left_hand")]), "air[0]: wanted one of file and pressure_kpa"),
        (
            Scene(air=[Air(part="foot", pressure_kpa=[(0, 1), (1, 1)])]),
            'air[0].part: no part "foot"; there are: left_hand, left_forearm',
        ),
        (
            Scene(air=[Air(part="left_hand", pressure_kpa=[(at_s, 1), (9, 1)]) for at_s in (0, 5)]),
            'air[1].part: "left_hand" has air already; wanted one',
        ),
        (
            Scene(air=[Air(part="left_hand", pressure_kpa=[(0, 1e6)])]),
            "air[0].pressure_kpa: 1e+06; wanted up to 10000 kPa",
        ),
        (
            Scene(air=[Air(part="left_hand", file="/nowhere/course.csv")]),
            "air[0].file: /nowhere/course.csv: cannot be read: No such file or directory",
        ),
        (Scene(air=[Air(part="left_hand", pressure_kpa=[(0, -1)])]), "air cannot pull"),
        (
            Scene(
                air=[Air(part="left_hand", pressure_kpa=[(0, 1), (1, 1)])],
                probe=[Probe(part="left_hand", depth_mm=[(0, 1), (1, 1)])],
            ),
            'air[0].part: "left_hand" has probes too',
        ),
    ],
)
def test_a_wrong_table_is_refused(scene: Scene, wrong: str) -> None:
    settings = load_settings(CONFIG)
    with pytest.raises(ConfigurationError) as refused:
        Robot(settings, build_layout(settings, CONFIG.parent), scene)

    assert wrong in str(refused.value)


def test_a_course_is_nothing_before_and_after_itself() -> None:
    course = AirCourse.of([(0, 5), (1, 7)], start_s=2)

    assert [course.kpa_at(t_s) for t_s in (1.9, 2, 2.5, 3, 3.1)] == [0, 5, 6, 7, 0]


@pytest.mark.skipif(not RECORDING.exists(), reason="the recordings are not here")
def test_an_emulated_insole_sends_what_the_recorded_one_sent() -> None:
    rows = {row["figure"]: row for row in insole.compare(RECORDING, longest_s=25.0)}

    assert rows["course of the median pad: median difference"]["emulated"] < 1.0
    for share in (5, 50, 95):
        noise = rows[f"noise at rest, {share} % of the pads"]
        assert noise["emulated"] == pytest.approx(noise["recorded"], rel=0.2)


def packed(shape: str, data: bytes = b"", kind: str = "<f8", name: str = "t_s.npy") -> bytes:
    """An .npz whose head states a shape, whatever is behind it."""
    head = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    array = b"\x93NUMPY\1\0" + len(head).to_bytes(2, "little") + head + data
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, array)
        archive.writestr("pressure_kpa.npy", array)
    return file.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        packed("(1000000000000,)"),
        packed("(1000001,)", bytes(8_000_008)),
        packed("(-1,)"),
        packed("(3,)", b"abc", "|O"),
        packed("(3,)", bytes(48), "<c16"),
        packed("(3,)", bytes(8)),
        packed("(" * 5000),
        packed("(3,)", bytes(24), name="t.npy"),
        packed("(3,)", bytes(24)).replace(b"\x78", b"\x99").replace(b"\0\0\x08", b"\0\0\x63"),
        packed("(3,)", bytes(24))[:-40],
    ],
)
def test_a_damaged_or_endless_course_is_refused_in_a_line(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "air.npz"
    path.write_bytes(data)
    with pytest.raises(ConfigurationError) as refused:
        read_air(path)
    assert str(refused.value).isprintable()
    assert str(path) in str(refused.value)
