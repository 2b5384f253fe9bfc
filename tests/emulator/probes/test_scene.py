from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.probes.scene import (
    Place,
    Probe,
    Scene,
    Script,
    check,
    check_values,
    load,
    tangents,
)
from skin_host.cli import main
from skin_host.errors import ConfigurationError

SCENES = Path(__file__).parents[3] / "config" / "scenes"


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.toml")), ids=lambda path: path.stem)
def test_the_scenes_that_come_with_the_project_are_right(path: Path) -> None:
    assert load(path).probe


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sed = 1", "unknown key `sed`; meant `seed`"),
        ("seed = 'x'", "seed: seen 'x', wanted `int`"),
        ("[[probe]]\npart = 'a'\ndiameter_mm = -1", r"probe\[0\].diameter_mm: seen -1, wanted"),
        ("[[probe]]\npart = 'a'", r"probe\[0\]: driven by none; wanted one of force_n"),
        (
            "[[probe]]\npart = 'a'\nforce_n = [[0, 1]]\ndepth_mm = [[0, 1]]",
            r"probe\[0\]: driven by force_n and depth_mm; wanted one of",
        ),
        (
            "[[probe]]\npart = 'a'\nforce_n = [[1, 1], [0, 1]]",
            r"probe\[0\].force_n: times run backwards",
        ),
        ("[[probe]]\npart = 'a'\nforce_n = [[0, -1]]", "a probe cannot pull"),
        (
            "[[probe]]\npart = 'a'\nforce_n = [[0, 1]]\nat = { taxel = 1, triangle = 2 }",
            r"probe\[0\].at: has both",
        ),
        ("membrane_mm = 300", "membrane_mm: seen 300, wanted"),
        ("[temperature]\nkeyframes_c = []", "temperature.keyframes_c: is empty"),
        ("[temperature]\nkeyframes_c = [[0, -300]]", r"keyframes_c\[0\]\[1\]: seen -300, wanted"),
        ("[temperature]\nkeyframes_c = [[0, 25], [1, 1e9]]", r"keyframes_c\[1\]\[1\]: seen 1"),
        (
            "[[probe]]\npart = 'a'\npressure_kpa = [[0, 60]]",
            r"probe\[0\].pressure_kpa: 1 keyframe, which is over at once; wanted at least two",
        ),
        (
            "[[probe]]\npart = 'a'\nforce_n = [[0, 1], [1, 1]]\ntangential_n = [[0, 1]]",
            r"probe\[0\].tangential_n: 1 keyframe, which",
        ),
        (
            "[[air]]\npart = 'a'\npressure_kpa = [[0, 60]]",
            r"air\[0\].pressure_kpa: 1 keyframe, which",
        ),
        *(
            (
                f"[[probe]]\npart = 'a'\nforce_n = [[0, 1]]\n{key} = {text}",
                rf"probe\[0\].{key}.*: seen",
            )
            for key, text in (
                ("diameter_mm", "1e-200"),
                ("diameter_mm", "1e8"),
                ("size_mm", "[1e-200, 3]"),
                ("friction", "1e-9"),
                ("friction", "1e8"),
                ("compliance_mm_per_n", "1e8"),
            )
        ),
        (
            "[[probe]]\npart = 'a'\nforce_n = [[0, nan]]",
            r"force_n\[0\]\[1\]: seen nan, wanted a finite",
        ),
        ("seed = ", "not TOML"),
    ],
)
def test_a_wrong_scene_is_refused_with_its_file_and_key(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=message) as error:
        load(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "[[probe]]\npart = 'left_hand'\nforce_n = [[0, 1], [1, 1]]\nat = { taxel = 999 }",
            "probe[0].at.taxel",
        ),
        ("[[air]]\npart = 'foot'\npressure_kpa = [[0, 1], [1, 1]]", "air[0].part"),
        ("[[fault]]\nname = 'wrong_address'\nboard = 'hand'\ntriangle = 3", "fault[0].value"),
    ],
)
def test_what_the_robot_does_not_have_is_refused_with_the_scenes_file(
    tmp_path: Path, text: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(text)
    demo = SCENES.parent / "demo.toml"
    assert main(["emulate", str(demo), "--scene", str(path), "--duration", "0.1"]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"skin emulate: {path}: {said}: ")


def test_a_missing_scene_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot be read: No such file"):
        load(tmp_path / "none.toml")


def force_n(script: Script, t_s: float) -> float:
    """Force of the only probe of a script, 0 while it does not touch."""
    return float(script.at(t_s).drive.sum())


def test_a_probe_presses_between_its_keyframes_and_not_outside() -> None:
    script = Script([Probe(part="a", force_n=[(0, 0), (1, 10), (3, 10), (4, 0)], start_s=2)])
    times_s = (0.0, 1.9, 2.5, 3.0, 4.9, 5.5, 6.0, 100.0)
    assert [force_n(script, t_s) for t_s in times_s] == pytest.approx([0, 0, 5, 10, 10, 5, 0, 0])


def test_a_pressure_is_a_force_on_the_probes_area() -> None:
    disc = Probe(part="a", diameter_mm=10, pressure_kpa=[(0, 100), (1, 100)])
    plate = Probe(part="a", size_mm=(10, 20), pressure_kpa=[(0, 100), (1, 100)])
    assert Script([disc, plate]).at(0.5).drive == pytest.approx([np.pi * 25 * 0.1, 20])


def test_a_repeated_probe_presses_again_for_ever() -> None:
    script = Script([Probe(part="a", force_n=[(0, 1), (1, 1)], start_s=2, repeat_s=5)])
    times_s = (2.5, 3.5, 7.5, 2 + 5000 * 5 + 0.5)
    assert [force_n(script, t_s) for t_s in times_s] == pytest.approx([1, 0, 1, 1])


def test_a_sliding_probe_moves_along_its_path() -> None:
    probe = Probe(part="a", force_n=[(0, 1), (2, 1)], slide_mm=[(0, 0, 0), (2, 10, -4)])
    script = Script([probe])
    script.at(0.3)
    assert script.at(1.0).offset_mm == pytest.approx(np.array([[5, -2]]))


@given(
    st.lists(
        st.tuples(
            st.lists(st.sampled_from([0.0, 1.0, 2.0]), min_size=1, max_size=5),
            st.integers(0, 3000).map(lambda start_ms: start_ms * 1e-3),
            st.sampled_from([0.0, 6.0]),
        ),
        min_size=1,
        max_size=4,
    ),
    st.floats(0, 20),
)
def test_nothing_changes_before_the_time_that_still_until_promises(
    probes: list[tuple[list[float], float, float]], t_s: float
) -> None:
    script = Script(
        [
            Probe(
                part="a",
                force_n=[(float(i), force) for i, force in enumerate(forces)],
                start_s=start_s,
                repeat_s=repeat_s,
            )
            for forces, start_s, repeat_s in probes
        ]
    )
    now = script.at(t_s)
    until_s = min(script.still_until_s(t_s), t_s + 30)
    for share in (0.25, 0.5, 0.999):
        later = script.at(t_s + share * (until_s - t_s))
        assert later.number.tolist() == now.number.tolist()
        assert later.drive == pytest.approx(now.drive)


@given(st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)))
def test_tangents_lie_along_the_skin(direction: tuple[float, float, float]) -> None:
    length = np.linalg.norm(direction)
    normal = np.array([0.0, 0.0, 1.0]) if length < 1e-3 else np.array(direction) / length
    along = tangents(normal)
    assert along @ along.T == pytest.approx(np.eye(2), abs=1e-9)
    assert along @ normal == pytest.approx(np.zeros(2), abs=1e-9)


PRESS = [(0.0, 1.0), (1.0, 1.0)]


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("diameter_mm", 0.0, "diameter_mm: seen 0.0, wanted"),
        ("diameter_mm", float("nan"), "diameter_mm: seen nan, wanted"),
        ("size_mm", (0.0, 5.0), r"size_mm\[0\]: seen 0.0, wanted"),
        ("turn_deg", float("inf"), "turn_deg: seen inf, wanted a finite number"),
        ("repeat_s", -1.0, "repeat_s: seen -1.0, wanted"),
        ("at", Place(taxel=-1), "at.taxel: seen -1, wanted"),
        ("at", Place(x_mm=float("nan")), "at.x_mm: seen nan, wanted a finite number"),
        ("force_n", [(0.0, 1.0), (1.0, float("nan"))], r"force_n\[1\]\[1\]: seen nan, wanted"),
        ("force_n", [(0.0, 1e308), (1.0, 0.0)], r"force_n\[0\]\[1\]: seen 1e\+308, wanted"),
    ],
)
def test_a_value_made_in_python_is_checked_like_one_of_a_file(
    key: str, value: object, message: str
) -> None:
    """They pressed nothing, or another part's taxel, or let the robot hang, without a word."""
    probe = msgspec.structs.replace(Probe(part="left_hand", force_n=PRESS), **{key: value})
    with pytest.raises(ConfigurationError, match=rf"^probe\[0\].{message}"):
        check(Scene(probe=[probe]))
    with pytest.raises(ConfigurationError, match=f"^{message}"):
        check_values(probe)


def test_numbers_of_numpy_and_any_seed_are_values_of_a_scene() -> None:
    times_s, force_n = np.linspace(0.0, 1.0, 5), np.arange(5)
    keyframes = list(zip(times_s, force_n, strict=True))
    probe = Probe(part="a", at=Place(taxel=np.int64(3)), force_n=keyframes)  # type: ignore[arg-type]
    check(Scene(seed=1 << 70, probe=[probe]))


def test_a_scene_made_in_python_is_checked_like_a_file() -> None:
    with pytest.raises(ConfigurationError, match="wanted one of"):
        check(Scene(probe=[Probe(part="a", at=Place(taxel=1))]))
