"""What is wrong in a configuration file is said with its place."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.cli import main
from skin_host.config.settings import (
    Settings,
    changed,
    format_triangles,
    load,
    parse_triangles,
    skin_hash,
)
from skin_host.errors import ConfigurationError
from skin_host.importing import configuration_text
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
LEFT = "wanted less than 1, or nothing is left of a press that lasts"
BETWEEN = "wanted numbers between -1e+09 and 1e+09"
OWN_KIND = """
[kinds.row]
about = "twelve in a row"
pads_mm = [[0, 0], [5, 0], [9, 0], [15, 0], [20, 0], [25, 0],
    [0, 5], [5, 5], [9, 5], [15, 5], [20, 5], [25, 5]]
pitch_mm = 5
radius_mm = 2
outline_mm = [[-3, -3], [28, -3], [28, 8], [-3, 8]]
"""
PATCH = "parts.left_hand.patches[1]"
TIP = 'fingertips.tip]\nbus = "can0"\naddress = 3\nshape = '
TIP_S = "fingertips.tip."
COVERED = f'{TIP}"plane"\narray = "left_hand"'
COPY = '[buses.copy]\ninterface = "virtual"\nchannel = "skin-demo"\n'
ALREADY = 'on bus "can0" is already that of board "hand"'
ONE_CHANNEL = "buses.can0.channel is that of buses.copy, skin-demo"
DEPENDENT = "follows from those before it, or is 0; wanted six independent rows"
#: Of a matrix whose fifth row is the third minus twice the fourth.
SINGULAR = np.eye(6) + 0.3 * np.arange(36).reshape(6, 6) ** 2 % 7
SINGULAR[4] = SINGULAR[2] - 2.0 * SINGULAR[3]
REACHED = "the force that is measured in every direction, by full_scale and matrix"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("address = 14", 'address = "14"', "boards.hand.address: seen '14', wanted `int`"),
        ("address = 14", "address = 15", "boards.hand.address: seen 15, wanted `int` <= 14"),
        ("skin_type", "skin_typ", "boards.hand: unknown key `skin_typ`; meant `skin_type`?"),
        (
            "skin_type = 1",
            "skin_type = 4",
            "boards.hand.skin_type: seen 4, wanted one of: 0, 1, 2, 3, 8",
        ),
        (
            "skin_type = 1",
            "skin_type = 7",
            "boards.hand.skin_type: seen 7, wanted one of: 0, 1, 2, 3, 8",
        ),
        (
            "skin_type = 1",
            "skin_type = 1\nno_load = 255",
            "boards.hand.no_load: seen 255, wanted `int` <= 254",
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
        ("x_mm = -25", "x_mm = nan", f"{PATCH}.places[0].x_mm: seen nan, wanted `float` >= {-1e6}"),
        (
            "x_mm = -25",
            "x_mm = 1e308",
            f"{PATCH}.places[0].x_mm: seen 1e+308, wanted `float` <= {1e6}",
        ),
        (
            "x_mm = -25",
            "turn_deg = nan",
            f"{PATCH}.places[0].turn_deg: seen nan, wanted a finite number",
        ),
        (
            "x_mm = -25",
            "turn_deg = 1e308",
            f"{PATCH}.places[0].turn_deg: seen 1e+308, wanted a number between -1e+09 and 1e+09",
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
            "processing.calibration.seconds: seen -1, wanted `float` >= 0.001",
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
            f"{TOP}\n[processing.relaxation]\nbeta = [0.1]\ntau_s = [1, 2]",
            "processing.relaxation: the lists of parameters differ in length",
        ),
        (
            TOP,
            f"{TOP}\n[processing.relaxation]\nbeta = [0.5, 0.5]\ntau_s = [1, 2]",
            f"processing.relaxation: `beta`: the shares sum to 1; {LEFT}",
        ),
        (
            TOP,
            f"{TOP}\n[processing.relaxation]\nupdate_s = 0.05",
            (
                "processing.relaxation: `update_s`: 0.05; wanted 0, or 0.2 to 5 s: means of fewer "
                "sweeps are mostly noise"
            ),
        ),
        (
            TOP,
            f"{TOP}\nmqtt.frame_hz = 1e-300",
            "mqtt.frame_hz: seen 1e-300, wanted 0 or at least 0.001",
        ),
        (
            '"8-11"',
            f'"{"9" * 5000}"',
            f'{PATCH}.triangles: "{"9" * 40} ...": a board has triangles 0 to 15',
        ),
        (
            "x_mm = -25",
            f"x_mm = {'9' * 5000}",
            f"not TOML: holds a number of thousands of digits; {BETWEEN}",
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
            f"{TOP}\n[{COVERED}\n[{COVERED.replace('.tip', '.other').replace('3', '4')}",
            'fingertips.other.array: "left_hand" already covers fingertips.tip',
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
            f'{TOP}\n[{TIP}"plane"\nmatrix = {[[0] * 6] * 6}',
            f"{TIP_S}matrix: row 1 {DEPENDENT}",
        ),
        (
            TOP,
            f'{TOP}\n[{TIP}"plane"\nmatrix = {[[1, 0, 0, 0, 0, 0]] * 6}',
            f"{TIP_S}matrix: row 2 {DEPENDENT}",
        ),
        (
            TOP,
            f'{TOP}\n[{TIP}"plane"\nmatrix = {SINGULAR.tolist()}',
            f"{TIP_S}matrix: row 5 {DEPENDENT}",
        ),
        (
            TOP,
            f'{TOP}\n[{TIP}"plane"\nmatrix = {np.diag([1, 1, 1, 1, 1, 0]).tolist()}',
            f"{TIP_S}matrix: row 6 {DEPENDENT}",
        ),
        (
            TOP,
            f'{TOP}\n[{TIP}"plane"\nthreshold_n = 150\nover_n = 200\nfull_scale = {[100] * 6}',
            f"{TIP_S}threshold_n: 150; wanted at most 99.9969, {REACHED}",
        ),
        (
            TOP,
            f'{TOP}\n[{TIP}"plane"\nfull_scale = {[1e-6] * 6}',
            f"{TIP_S}threshold_n: 0.2; wanted at most 9.99969e-07, {REACHED}",
        ),
        (
            TOP,
            f'{TOP}\n[{TIP}"plane"\nmatrix = {np.diag([1e-6] * 6).tolist()}',
            f"{TIP_S}threshold_n: 0.2; wanted at most 0.065533, {REACHED}",
        ),
        (
            TOP,
            f'{TOP}\n[{TIP.replace("3", "13")}"plane"',
            'fingertips.tip.address: 13 on bus "can0" is already that of board "forearm_outer"',
        ),
        # Otherwise two parts would show what one board feels.
        (
            '[boards.hand]\nbus = "can0"\naddress = 14',
            f'{COPY}[boards.hand]\nbus = "copy"\naddress = 13',
            f"boards.forearm_outer.address: 13 {ALREADY}: {ONE_CHANNEL}",
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
        # Without TLS the broker's files would have no effect, and nothing would be encrypted.
        (
            TOP,
            f'{TOP}\nmqtt.ca_file = "ca.pem"',
            "mqtt.ca_file: is given, but mqtt.tls is not true",
        ),
        (
            TOP,
            f'{TOP}\nmqtt.tls = true\nmqtt.key_file = "k.pem"',
            "mqtt.key_file: needs mqtt.certificate_file too",
        ),
        (TOP, f'{TOP}\nmqtt.password_file = "p"', "mqtt.password_file: needs mqtt.username too"),
        (
            TOP,
            f'{TOP}\nmqtt.protocol = "3.1.1"\nmqtt.brokers = ["a", "b"]',
            'mqtt.brokers: 2 brokers need mqtt.protocol = "5"',
        ),
        (
            TOP,
            f'{TOP}\nmqtt.port = 1884\nmqtt.brokers = ["a", "[::1]:1884", "a:1884"]',
            "mqtt.brokers[2]: a:1884 is named twice",
        ),
        (TOP, f'{TOP}\nmqtt.brokers = ["a:0"]', "mqtt.brokers[0]: a:0: wanted a port from 1"),
        (TOP, f'{TOP}\nmqtt.brokers = ["a:70000"]', "mqtt.brokers[0]: a:70000: Port out of range"),
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


def written(folder: Path, key: str, value: object) -> Path:
    """The demo's configuration and a kind, with one key of another value."""
    path = folder / "robot.toml"
    path.write_text(DEMO.read_text() + OWN_KIND)
    path.write_text(configuration_text(changed(load(path), {key: value})))
    return path


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("kinds.row.radius_mm", 1e-100),
        ("kinds.row.radius_mm", 1e-5),
        ("kinds.row.pitch_mm", 1e8),
        ("parts.left_hand.foam_mm", 1e-308),
        ("processing.calibration.seconds", 1e8),
        ("processing.pressure.pad_radius_mm", 1e-200),
        ("processing.pressure.foam_mm", 1e-160),
        ("processing.pressure.b_kpa_per_ff", 1e-300),
        ("processing.pressure.a_kpa_per_ff2", -1e8),
        ("processing.pressure.code_ff", 1e-300),
        ("processing.pressure.smoothing_s", 1e8),
        ("processing.relaxation.update_s", 1e8),
        ("processing.touch.hysteresis_units", 256),
        ("processing.touch.move_hz", 1e-9),
        ("processing.drift.rate_units_per_s", 1e8),
        ("processing.drift.gain_per_s", 1e8),
        ("receive.close_periods", 0.4),
        ("receive.silent_periods", 1e-9),
        ("receive.silent_periods", 1.0),
        ("buses.can0.bitrate", 0),
    ],
)
def test_a_number_that_would_make_the_skin_deaf_or_its_computation_overflow_is_refused(
    tmp_path: Path, key: str, value: float
) -> None:
    path = written(tmp_path, key, value)
    with pytest.raises(ConfigurationError, match=f"{key}: seen .*, wanted `(float|int)` [<>]= "):
        load(path)


def test_each_number_of_a_configuration_has_a_range() -> None:
    """But for directions, angles and matrices, which may be any finite number."""
    without = {
        key.rpartition(".")[2]
        for key, hint in numbers(Settings)
        if not re.search(r"\b(ge|gt|le|lt)=", hint)
    }
    assert without == {"turn_deg", "normal", "matrix", "options", "thermal"}


def numbers(table: type[msgspec.Struct], where: str = "") -> Iterator[tuple[str, str]]:
    """Each key of a configuration that holds numbers, and how its type is written."""
    for name, hint in get_type_hints(table, include_extras=True).items():
        inner = [one for one in flat(hint) if isinstance(one, type)]
        for struct in inner:
            if issubclass(struct, msgspec.Struct):
                yield from numbers(struct, f"{where}{name}.")
        if {int, float} & set(inner):
            yield f"{where}{name}", str(hint)


def flat(hint: Any) -> Iterator[Any]:
    """What a type consists of."""
    yield hint
    for one in get_args(hint):
        yield from flat(one)


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("buses.can0.channel", "a\0"),
        ("buses.can0.interface", "\x1b[2J"),
        ("buses.can0.options", "a\0"),
        ("kinds.row.about", "a\u202eb"),
        ("processing.relaxation.file", "r\0.json"),
        ("mqtt.username", "a\rb"),
        ("mqtt.ca_file", "a\nb"),
        ("service.state_directory", "a\x9bb"),
    ],
)
def test_text_that_cannot_be_printed_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str, text: str
) -> None:
    path = written(tmp_path, key, {"app": text} if key.endswith("options") else text)
    assert main(["check", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.isprintable()
    assert f" {key}: seen " in line or f" {key}[...]: seen " in line
    assert "of characters that can be printed" in line


@pytest.mark.parametrize(
    "host", ["localhost:1884", "10.0.0.5:1884", "mqtt://localhost", "", "a\x1b[31m", "a\n"]
)
def test_a_broker_that_is_no_host_alone_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], host: str
) -> None:
    assert main(["check", str(written(tmp_path, "mqtt.host", host))]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "mqtt.host: seen " in line
    assert "of a host alone; its port is the key `port`" in line


@pytest.mark.parametrize("host", ["localhost", "10.0.0.5", "fe80::1%eth0", "::1", "bücher.local"])
def test_a_host_may_be_a_name_or_an_address(tmp_path: Path, host: str) -> None:
    assert load(written(tmp_path, "mqtt.host", host)).mqtt.host == host


@pytest.mark.parametrize(
    "text",
    [
        f"robot.{'a.' * 3000}a = 1",
        f"{TOP}\n[buses.can0]\noptions.{'a.' * 3000}a = 1",
        f"{TOP}\n[{'x.' * 3000}y]\nz = 1",
        f"{TOP}\nx = {'[' * 500}{']' * 500}",
        f"{TOP}\nx = {'[' * 50}{']' * 50}",
    ],
)
def test_a_document_that_is_nested_too_deep_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(text)
    assert main(["check", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "nested too deep" in line
    assert len(line) < 300


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"beta": [0.1]}, "the lists of parameters differ in length"),
        ({"beta": [0.6, 0.6]}, "`beta`: the shares sum to 1.2; wanted less than 1"),
        ({"beta_unload": [0.6, 0.6]}, "`beta_unload`: the shares sum to 1.2"),
        ({"beta": [], "tau_s": []}, "`array` of length >= 1"),
        ({"beta": [1e300, 0.1]}, "`float` <= 1.0"),
        ({"tau_s": [1e-300, 1.0]}, "`float` >= 0.001"),
        ({"tau_unload_s": [1.0, 1e308]}, "`float` <= 1000000000.0"),
    ],
)
def test_the_numbers_of_a_file_of_a_foam_are_checked_as_those_of_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict[str, object], said: str
) -> None:
    foam: dict[str, object] = {"schema": "skin.relaxation/1", "model": "asymmetric"}
    foam |= {"beta": [0.1, 0.2], "tau_s": [1, 9], "beta_unload": [0.1, 0.2], "tau_unload_s": [1, 9]}
    file = tmp_path / "foam.json"
    file.write_bytes(msgspec.json.encode(foam))
    path = edited(tmp_path, TOP, f'{TOP}\n[processing.relaxation]\nfile = "foam.json"')
    assert load(path).processing.relaxation.beta == [0.1, 0.2]
    file.write_bytes(msgspec.json.encode(foam | change))
    assert main(["check", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"processing.relaxation.file: {file}: " in line
    assert said in line
    assert line.endswith("make one with: skin calibrate CONFIG --relaxation LOG")


def test_what_is_not_toml_is_named_with_its_line(tmp_path: Path) -> None:
    path = edited(tmp_path, "[boards.hand]", "[boards.hand")
    with pytest.raises(ConfigurationError, match=r"not TOML: .*line 10"):
        load(path)


def test_bytes_that_are_not_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_bytes(b"\xff\xfe\x00robot")
    with pytest.raises(ConfigurationError, match=r"not TOML: .*; save it as UTF-8"):
        load(path)


def test_a_mark_of_the_coding_is_no_mistake(tmp_path: Path) -> None:
    """Editors of other systems begin a text in UTF-8 with it."""
    path = edited(tmp_path, "", "")
    plain = load(path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert load(path) == plain


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


def test_a_calibration_fits_however_the_same_triangles_are_written(tmp_path: Path) -> None:
    for text in ("0,1,2-4", "0, 1, 2, 3, 4", "00-04"):
        same = edited(tmp_path, 'triangles = "0-4"', f'triangles = "{text}"')
        assert skin_hash(load(same)) == skin_hash(load(DEMO))
    # Places and the numbers of taxels follow the order.
    other = edited(tmp_path, 'triangles = "0-4"', 'triangles = "1-4,0"')
    assert skin_hash(load(other)) != skin_hash(load(DEMO))


def test_a_calibration_does_not_fit_other_boards(tmp_path: Path) -> None:
    other = edited(tmp_path, "address = 13", "address = 11")
    assert skin_hash(load(other)) != skin_hash(load(DEMO))
    with_tip = edited(tmp_path, TOP, f'{TOP}\n[{TIP}"plane"')
    assert skin_hash(load(with_tip)) != skin_hash(load(DEMO))


def test_the_demo_builds() -> None:
    assert build_layout(load(DEMO), DEMO.parent).n_taxels == 396


@pytest.mark.parametrize(
    ("place", "wanted"),
    [
        ("state", "robots/state"),
        ("../state", "state"),
        ("", "robots"),
        ("/var/lib/x", "/var/lib/x"),
        ("~/x", "~/x"),
    ],
)
def test_a_state_directory_is_the_same_from_every_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, wanted: str
) -> None:
    folder = tmp_path / "robots"
    folder.mkdir()
    path = written(folder, "service.state_directory", place)
    expected = wanted if wanted.startswith("~") else str(tmp_path / wanted)
    assert load(path).service.state_directory == expected
    monkeypatch.chdir(tmp_path)
    assert load(path.relative_to(tmp_path)).service.state_directory == expected
    monkeypatch.chdir(folder)
    assert load(Path(path.name)).service.state_directory == expected
