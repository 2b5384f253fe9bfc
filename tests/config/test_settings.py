"""What is wrong in a configuration file is said with its place."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.cli import main
from skin_host.config.settings import format_triangles, load, parse_triangles, skin_hash
from skin_host.errors import ConfigurationError
from skin_host.layout import build_layout

DEMO = Path(__file__).parents[2] / "config" / "demo.toml"


def edited(folder: Path, old: str, new: str) -> Path:
    """The demo's configuration with one place changed."""
    text = DEMO.read_text()
    assert old in text
    path = folder / "robot.toml"
    path.write_text(text.replace(old, new, 1))
    return path


TOP = 'robot = "demo"'
PATCH = "parts.left_hand.patches[1]"
TIP = 'fingertips.tip]\nbus = "can0"\naddress = 3\nshape = '


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("address = 14", 'address = "14"', "boards.hand.address: seen '14', wanted `int`"),
        ("address = 14", "address = 15", "boards.hand.address: seen 15, wanted `int` <= 14"),
        ("skin_type", "skin_typ", "boards.hand: unknown key `skin_typ`; meant `skin_type`?"),
        (
            "skin_type = 1",
            "skin_type = 4",
            "boards.hand.skin_type: seen 4, wanted one of: 0, 1, 2, 3, 7, 8",
        ),
        ('"8-11"', '"8-16"', f'{PATCH}.triangles: "8-16": a board has triangles 0 to 15'),
        (
            '"8-11"',
            '"4-7"',
            f'{PATCH}.triangles: triangle 4 of board "hand" is already in {PATCH[:-3]}[0]',
        ),
        ("x_mm = -25", "x_m = 1", f"{PATCH}.places[0]: unknown key `x_m`; meant `x_mm`?"),
        (
            "x_mm = -25",
            "normal = [0, 1]",
            f"{PATCH}.places[0].normal: seen 2, wanted `array` of length 3",
        ),
        ("x_mm = -25", "x_mm = nan", f"{PATCH}.places[0].x_mm: seen nan, wanted a finite number"),
        (
            "x_mm = -25",
            "x_mm = 1e308",
            f"{PATCH}.places[0].x_mm: seen 1e+308, wanted a number between -1e+09 and 1e+09",
        ),
        (
            'bus = "can0"',
            'bus = "can9"',
            'boards.hand.bus: no bus "can9"; there are: can0',
        ),
        (
            "address = 13",
            "address = 14",
            'boards.forearm_outer.address: 14 on bus "can0" is already that of board "hand"',
        ),
        (
            "[boards.hand]",
            '[boards."Left Hand"]',
            'boards: the name "Left Hand"; wanted at most 64 of the characters a-z, 0-9, - and _',
        ),
        (TOP, "", "missing key `robot`"),
        (TOP, f"{TOP}\nprocesing = 1", "unknown key `procesing`; meant `processing`?"),
        (
            TOP,
            f"{TOP}\n[processing.touch]\nmargin = 3",
            "processing.touch: unknown key `margin`; meant `margin_units`?",
        ),
        (
            TOP,
            f'{TOP}\n[processing.drift]\nrule = "fast"',
            "processing.drift.rule: seen 'fast', wanted one of: none, paper, proportional",
        ),
        (
            TOP,
            f"{TOP}\n[processing.calibration]\nseconds = -1",
            "processing.calibration.seconds: seen -1, wanted `float` > 0.0",
        ),
        (
            TOP,
            f"{TOP}\n[boards.spare]\nbus = 'can0'\naddress = 3",
            "boards.spare: no part uses this board; remove it or add a patch",
        ),
        (
            TOP,
            f"{TOP}\n[processing.relaxation]\nbeta = [0.1]",
            "processing.relaxation: `beta` and `tau_s` go together",
        ),
        (
            TOP,
            f'{TOP}\n[{TIP}"cube"',
            "fingertips.tip.shape: seen 'cube', wanted one of: sphere, cylinder, ellipsoid, plane",
        ),
        (
            TOP,
            f'{TOP}\n[{TIP}"sphere"',
            "fingertips.tip.radius_mm: missing key; a sphere needs it",
        ),
        (
            TOP,
            f'{TOP}\n[{TIP}"plane"\nradius_mm = 3',
            "fingertips.tip.radius_mm: a plane does not have it",
        ),
        (
            TOP,
            f'{TOP}\n[{TIP}"plane"\nmatrix = [[1, 0, 0, 0, 0, 0]]',
            "fingertips.tip.matrix: seen 1, wanted `array` of length 6",
        ),
        (
            TOP,
            f'{TOP}\n[{TIP}"plane"\narray = "palm"',
            'fingertips.tip.array: no part "palm"; there are: left_hand, left_forearm',
        ),
        (
            TOP,
            f'{TOP}\n[{TIP}"plane"\nfilter_hz = 100',
            "fingertips.tip.filter_hz: 100; wanted below 100, half of the samples' rate",
        ),
        (
            TOP,
            f'{TOP}\n[{TIP.replace("3", "13")}"plane"',
            'fingertips.tip.address: 13 on bus "can0" is already that of board "forearm_outer"',
        ),
        (
            TOP,
            f'{TOP}\n[{TIP.replace(".tip", ".left_hand")}"plane"',
            "fingertips.left_hand: the name is taken by another's topics; choose another",
        ),
    ],
)
def test_a_mistake_is_named_with_its_place(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = edited(tmp_path, old, new)
    with pytest.raises(ConfigurationError) as caught:
        load(path)
    assert str(caught.value) == f"{path}: {said}"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        # A line end after a name would be a part of topics and of file names.
        (TOP, 'robot = "demo\\n"', "robot: seen 'demo\\n', wanted `str`"),
        ("left_hand", '"left_hand\\n"', 'parts: the name "left_hand\\n"; wanted at most 64'),
        (TOP, f'{TOP}\nmqtt.base = "a\\nb"', 'mqtt.base: "a\\nb" cannot start a topic'),
        (TOP, f'{TOP}\nmqtt.base = "#"', 'mqtt.base: "#" cannot start a topic'),
        (TOP, f'{TOP}\nmqtt.brokers = ["a\\n"]', "mqtt.brokers"),
        # A board that is gone would not be missed for as long.
        (TOP, f"{TOP}\nreceive.silent_periods = 1e8", "receive.silent_periods: seen 100000000.0"),
    ],
)
def test_what_would_only_fail_later_is_refused_by_the_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, said: str
) -> None:
    assert main(["check", str(edited(tmp_path, old, new))]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_what_a_channel_is_called_does_not_steer_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = edited(tmp_path, 'channel = "skin-demo"', 'channel = "\\u001b[2J"')
    assert main(["check", str(path)]) == 0
    assert "\x1b" not in capsys.readouterr().out


def test_what_is_not_toml_is_named_with_its_line(tmp_path: Path) -> None:
    path = edited(tmp_path, "[boards.hand]", "[boards.hand")
    with pytest.raises(ConfigurationError, match=r"not TOML: .*line 10"):
        load(path)


def test_bytes_that_are_not_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_bytes(b"\xff\xfe\x00robot")
    with pytest.raises(ConfigurationError, match="not TOML"):
        load(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"robot\.toml: cannot be read: No such file"):
        load(tmp_path / "robot.toml")


@given(st.sets(st.integers(0, 15), min_size=1))
def test_triangles_survive_writing_and_reading(numbers: set[int]) -> None:
    assert parse_triangles(format_triangles(sorted(numbers))) == sorted(numbers)


@pytest.mark.parametrize("text", ["", "a", "1-", "-1", "3-1", "0,0", "0-99999999999", "²", "1.5"])
def test_what_is_no_list_of_triangles_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=f'"{text}"'):
        parse_triangles(text)


def test_a_calibration_fits_when_only_the_processing_or_the_channel_changed(
    tmp_path: Path,
) -> None:
    same = edited(tmp_path, TOP, f"{TOP}\n[processing.touch]\nmargin_units = 3")
    assert skin_hash(load(same)) == skin_hash(load(DEMO))
    same = edited(tmp_path, '"skin-demo"', '"vcan0"')
    assert skin_hash(load(same)) == skin_hash(load(DEMO))


def test_a_calibration_does_not_fit_other_boards(tmp_path: Path) -> None:
    other = edited(tmp_path, "address = 13", "address = 11")
    assert skin_hash(load(other)) != skin_hash(load(DEMO))
    with_tip = edited(tmp_path, TOP, f'{TOP}\n[{TIP}"plane"')
    assert skin_hash(load(with_tip)) != skin_hash(load(DEMO))


def test_the_demo_builds() -> None:
    assert build_layout(load(DEMO), DEMO.parent).n_taxels == 396
