"""`skin import`: the files of the iCub's world become configurations that can be used."""

import re
from pathlib import Path
from typing import Any, get_args, get_type_hints

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.probes.scene import Scene
from emulator.robot import Robot
from skin_host.cli import main
from skin_host.config import check
from skin_host.config.explain import LARGEST
from skin_host.config.fields import FileName
from skin_host.config.settings import PlaceSettings, Settings, changed, load, parse_triangles
from skin_host.errors import ConfigurationError, RequestError
from skin_host.importing import Source, configuration_text, import_files
from skin_host.importing.report import Findings
from skin_host.layout import Layout, build_layout, builtin_kinds
from skin_host.layout.geometry import lay

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
SPEC = DATA / "icub_genova11_left_arm_skinSpec.xml"
GUI = DATA / "icub_left_forearm_V2_gui.ini"
POSITIONS = DATA / "icub_left_forearm_V2_positions.txt"
needs_samples = pytest.mark.skipif(not SPEC.exists(), reason=f"{DATA} is not here")


def built(path: Path) -> tuple[Settings, Layout]:
    settings = load(path)
    return settings, build_layout(settings, path.parent)


@needs_samples
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be"])
@pytest.mark.parametrize(
    ("source", "sample"), [("skinspec", SPEC), ("skingui", GUI), ("positions", POSITIONS)]
)
def test_a_file_with_a_byte_order_mark_is_the_same_file(
    tmp_path: Path, source: Source, sample: Path, encoding: str
) -> None:
    text = sample.read_text()
    copy = tmp_path / sample.name
    made = []
    for content in (text.encode(), ("\ufeff" * (encoding == "utf-16-be") + text).encode(encoding)):
        copy.write_bytes(content)
        settings, _, findings = run(source, copy)
        made.append((settings, findings))
    assert made[0] == made[1]


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    """A small arm: a hand board of one fingertip and a palm, a forearm of two boards."""
    path = tmp_path / "arm.toml"
    path.write_text(
        'robot = "test"\n[buses.arm]\n'
        + "".join(f'[boards.b{i}]\nbus = "arm"\naddress = {i}\n' for i in (14, 13, 12))
        + '[[parts.arm.patches]]\nboard = "b14"\ntriangles = "0,8-11"\nshift = 0\n'
        + '[[parts.arm.patches]]\nboard = "b13"\ntriangles = "0-2"\n'
        + '[[parts.arm.patches]]\nboard = "b12"\ntriangles = "0-1,5"\n'
    )
    return path


def run(
    source: Source, file: Path, config: Path | None = None, part: str | None = None
) -> tuple[Settings, Layout, str]:
    findings = Findings()
    output = file.parent / "out.toml"
    import_files(source, [file], output, findings, config=config, part=part)
    return *built(output), "\n".join(str(item) for item in findings.items)


@needs_samples
def test_the_samples_become_an_arm_with_placed_and_located_forearm(tmp_path: Path) -> None:
    arm, placed, located = (tmp_path / f"{name}.toml" for name in ("arm", "placed", "located"))
    findings = Findings()
    import_files("skinspec", [SPEC], arm, findings)
    import_files("skingui", [GUI], placed, findings, config=arm)
    import_files("positions", [POSITIONS], located, findings, config=placed)
    for path in (placed, located):
        settings, layout = built(path)
        assert {part.name: part.n_taxels for part in layout.parts} == {
            "left_arm": 600,
            "left_forearm": 288,
        }
        assert check.describe(settings, layout)["warnings"] == []
    settings, layout = built(placed)
    assert settings.parts["left_forearm"].patches[0].places[0] == PlaceSettings(
        x_mm=100, y_mm=-20, turn_deg=30, mirror=True
    )
    settings, layout = built(located)
    robot = Robot(settings, layout, Scene(quiet=True))
    robot.bring_up()
    robot.step(0.1)
    assert robot.true_pressure_kpa("left_forearm").shape == (288,)
    forearm = layout.part("left_forearm")
    # The file's first row, and triangle 10 of its first board, which was measured whole.
    assert layout.position_m[forearm.start] == pytest.approx([-0.0308, -0.0669, 0.0235])
    rows = np.array(
        [line.split() for line in POSITIONS.read_text().splitlines()[4:] if line.strip()], float
    )
    measured = [pad for pad in range(12) if pad not in (6, 10)]
    ours = layout.position_m[forearm.start + 120 :][:12]
    assert ours[measured] == pytest.approx(rows[120:132, :3][measured])
    assert "rms 0.2 mm from a flat triangle_10pad" in findings.table()


@needs_samples
@pytest.mark.parametrize(("source", "file"), [("skingui", GUI), ("positions", POSITIONS)])
def test_each_sample_makes_a_configuration_by_itself(
    tmp_path: Path, source: str, file: Path
) -> None:
    findings = Findings()
    output = tmp_path / "alone.toml"
    import_files(source, [file], output, findings)  # type: ignore[arg-type]
    assert built(output)[1].n_taxels == 288
    assert "default set-up" in findings.table()


SETS = """\
<params><group name="patches">
<param name="skinCanAddrsPatch1"> 1 2 </param><param name="skinCanAddrsPatch2"> 13 </param></group>
<group name="defaultCfgTriangle"><param name="enabled"> true </param></group></params>
"""


def spec(folder: Path, text: str = SETS, name: str = "left_leg-skinSpec.xml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def based(folder: Path, bus: str, channel: str, board: str) -> Path:
    """Write a configuration of one bus with one board on it."""
    path = folder / "base.toml"
    path.write_text(
        f'robot = "base"\n[buses.{bus}]\nchannel = "{channel}"\n[boards.{board}]\n'
        f'bus = "{bus}"\naddress = 7\n[[parts.chest.patches]]\nboard = "{board}"\n'
        'triangles = "0-3"\n'
    )
    return path


@pytest.mark.parametrize("channel", ["can0", "can1", "can2", "can5"])
@pytest.mark.parametrize("bus", ["left_leg_1", "left_leg_2", "other"])
def test_a_new_bus_leaves_those_of_the_base_as_they_are(
    tmp_path: Path, bus: str, channel: str
) -> None:
    base = based(tmp_path, bus, channel, "b1")
    settings, _, said = run("skinspec", spec(tmp_path), base)
    assert settings.buses[bus] == load(base).buses[bus]
    assert settings.boards["b1"] == load(base).boards["b1"]
    channels = [one.channel for one in settings.buses.values()]
    assert len(set(channels)) == 3
    # As in the file: boards 1 and 2 on one new bus, board 13 on another.
    of_bus: dict[str, list[int]] = {}
    for board in settings.boards.values():
        of_bus.setdefault(board.bus, []).append(board.address)
    assert sorted(of_bus.values()) == [[1, 2], [7], [13]]
    for name in set(settings.buses) - {bus}:
        assert f'the bus "{name}" on channel {settings.buses[name].channel}' in said
    assert ("exists" in said) == (bus != "other")


def test_a_board_whose_name_exists_is_refused(tmp_path: Path) -> None:
    base = based(tmp_path, "other", "can0", "left_leg_1_2")
    with pytest.raises(ConfigurationError, match='a board of this name exists: "left_leg_1_2"'):
        run("skinspec", spec(tmp_path), base)
    assert not (tmp_path / "out.toml").exists()


def test_a_second_file_of_a_part_is_refused(tmp_path: Path) -> None:
    files = []
    for name in ("one.ini", "two.ini"):
        (tmp_path / name).write_text(HAND)
        files.append(tmp_path / name)
    with pytest.raises(ConfigurationError, match=r'two\.ini: a part of this name exists: "hand"'):
        import_files("skingui", files, tmp_path / "out.toml", Findings())


@pytest.mark.parametrize("opposite", ["0 0 0", "0 0 -1"])
def test_places_without_a_normal_in_common_get_one_and_a_remark(
    tmp_path: Path, opposite: str
) -> None:
    table = tmp_path / "left_arm.txt"
    first = "0 0 0" if opposite == "0 0 0" else "0 0 1"
    pads = np.array(builtin_kinds()["triangle"].pads_mm) * 1e-3
    rows = [f"{x} {y} 0.05 {(first, opposite)[i % 2]}" for i, (x, y) in enumerate(pads)]
    table.write_text("\n".join(rows) + "\n")
    _, layout, said = run("positions", table)
    assert layout.normal == pytest.approx(np.tile([0.0, 0.0, 1.0], (12, 1)))
    why = "no normals" if opposite == "0 0 0" else "its normals cancel each other"
    assert f"{why}; taken: +z" in said


def test_places_of_a_limb_on_two_buses_are_in_the_order_of_its_vector(tmp_path: Path) -> None:
    """The boards of patch 2 come before those of patch 1."""
    base, _, _ = run("skinspec", spec(tmp_path))
    assert [base.buses[f"left_leg_{patch}"].channel for patch in (1, 2)] == ["can0", "can1"]
    table = tmp_path / "left_leg.txt"
    pads = np.array(builtin_kinds()["triangle_10pad"].pads_mm) * 1e-3
    row_of = {13: 0, 1: 1, 2: 2}
    rows = [
        f"{x + 0.03 * triangle} {y} {-0.1 * number} 0 0 1"
        for number in (1, 2, 3)
        for triangle in range(16)
        for x, y in pads
    ]
    table.write_text("\n".join(rows) + "\n")
    _, layout, said = run("positions", table, tmp_path / "out.toml")
    for board in layout.boards:
        first = board.taxel_index[0, 0]
        wanted_m = -0.1 * (1 + row_of[board.settings.address])
        assert layout.position_m[first, 2] == pytest.approx(wanted_m)
    assert "boards are on several buses; taken in this order: left_leg_2_13, left_leg_1_1" in said


HAND = """\
robotPart hand
cardid 14
width 640
[SENSORS]
# type id x y th gain mirror layout
palmL 8 -25.0 0 0 4.0 0 0
fingertip2L 0 -32 35 30 4.0 1 0
"""


def test_placed_triangles_move_to_the_part_that_the_display_names(
    tmp_path: Path, arm: Path
) -> None:
    file = tmp_path / "hand.ini"
    file.write_text(HAND)
    settings, _, said = run("skingui", file, arm)
    tip, palm = settings.parts["hand"].patches
    assert (tip.board, tip.triangles, tip.kind, tip.shift) == ("b14", "0", "fingertip2l", 0)
    assert tip.places == [PlaceSettings(x_mm=-32, y_mm=35, turn_deg=30, mirror=True)]
    assert (palm.triangles, palm.kind) == ("8-11", "palml")
    assert [patch.board for patch in settings.parts["arm"].patches] == ["b13", "b12"]
    assert f"{file}:3: width: of the display's window" in said


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("wobble 3 0 0 0 1 0 0", '"wobble" is not a known kind of unit; not read'),
        ("triangle 3 0 0", 'seen "triangle 3 0 0", wanted a type and 4 to 7 numbers; not read'),
        ("triangle 200 0 0 0 1", "id 200; wanted 0 to 127; not read"),
        ("triangle 0 5 5 0 1", "id 0 is placed in line 7; not read"),
        ("triangle 7 nan 0 0 1", "wanted a type and 4 to 7 numbers; not read"),
        ("triangle 3 0 0 0 1", 'triangle 3 of board "b14" is not on'),
    ],
)
def test_a_strange_line_of_a_display_is_named(
    tmp_path: Path, arm: Path, line: str, said: str
) -> None:
    file = tmp_path / "hand.ini"
    file.write_text(HAND + line + "\n")
    settings, _, remarks = run("skingui", file, arm)
    assert f"{file}:8: " in remarks
    assert said in remarks
    assert len(settings.parts["hand"].patches) == 2


@pytest.mark.parametrize(
    ("file", "key", "named"),
    [
        ("left arm (2)", "", "left_arm_2"),
        ("left_arm.v2", "", "left_arm_v2"),
        ("hand", 'robotPart "left_arm"', "left_arm"),
        ("hand", "robotPart LEFT;arm", "left_arm"),
        ("hand", "robotPart ]]", "skin"),
        ("\u624b", "", "skin"),
        ("a" * 200, "", "a" * 60),
    ],
)
def test_a_part_is_named_with_the_characters_that_names_have(
    tmp_path: Path, file: str, key: str, named: str
) -> None:
    """What was written was no TOML, or a table within another one, which did not name the part."""
    display = tmp_path / f"{file}.ini"
    display.write_text(f"{key}\n[SENSORS]\ntriangle 0 0 0 0 1\n")
    settings, _, _ = run("skingui", display)
    assert list(settings.parts) == [named]
    positions = tmp_path / f"{file}.txt"
    write_rows(positions, forearm_rows())
    settings, _, _ = run("positions", positions, part=key.removeprefix("robotPart ") or None)
    assert list(settings.parts) == [named]


def test_an_address_of_a_display_that_is_no_number_of_a_board_is_not_taken(tmp_path: Path) -> None:
    """Five thousand digits ended in a traceback."""
    file = tmp_path / "hand.ini"
    file.write_text(
        f"cardid 3 {'9' * 5000} x 0x4\n[SENSORS]\ntriangle 4 0 0 0 1\ntriangle 20 0 0 0 1\n"
    )
    written = import_files("skingui", [file], tmp_path / "robot.toml", Findings())
    assert written == [tmp_path / "robot.toml"]
    made = load(tmp_path / "robot.toml")
    assert [board.address for board in made.boards.values()] == [3, 4]


def test_a_display_that_names_its_boards_wrongly_is_read_by_the_triangles_that_are_on(
    tmp_path: Path, arm: Path
) -> None:
    file = tmp_path / "forearm.ini"
    file.write_text(
        "robotPart forearm\ncardid 12 13\n[SENSORS]\n"
        "triangle 1 0 0 0 1\ntriangle 2 30 0 0 1\ntriangle 21 60 0 0 1\n"
    )
    settings, _, said = run("skingui", file, arm)
    assert [(patch.board, patch.triangles) for patch in settings.parts["forearm"].patches] == [
        ("b13", "1-2"),
        ("b12", "5"),
    ]
    assert "cardid [12, 13] are not the boards whose triangles are on" in said
    assert 'triangles 0 of board "b13" are on but not placed' in said


def rows_of(place: PlaceSettings, kind: str = "triangle_10pad") -> np.ndarray:
    position_mm, normal = lay(np.array(builtin_kinds()[kind].pads_mm), place)
    return np.column_stack([position_mm * 1e-3, normal])


def forearm_rows() -> np.ndarray:
    """192 rows a board: three and three triangles with places."""
    rows = np.zeros((384, 6))
    for i, slot in enumerate((0, 1, 2, 16, 17, 21)):
        rows[12 * slot : 12 * slot + 12] = rows_of(
            PlaceSettings(x_mm=30 * i, y_mm=5, z_mm=40, normal=(0, 1, 1), turn_deg=20 * i)
        )
    return rows


def write_rows(path: Path, rows: np.ndarray, head: str = "") -> None:
    body = "\n".join(" ".join(f"{value:.7f}" for value in row) for row in rows)
    path.write_text(head + body + "\n")


@pytest.fixture
def forearm(tmp_path: Path, arm: Path) -> Path:
    text = arm.read_text().replace(
        '[[parts.arm.patches]]\nboard = "b13"', '[[parts.forearm.patches]]\nboard = "b13"'
    )
    text = text.replace(
        '[[parts.arm.patches]]\nboard = "b12"', '[[parts.forearm.patches]]\nboard = "b12"'
    )
    path = tmp_path / "forearm.toml"
    path.write_text(text.replace('"0-2"\n', '"0-2"\nkind = "triangle_10pad"\n'))
    return path


def test_positions_are_taken_as_they_stand(tmp_path: Path, forearm: Path) -> None:
    rows = forearm_rows()
    file = tmp_path / "forearm_V2.txt"
    write_rows(file, rows)
    _, layout, said = run("positions", file, forearm)
    part = layout.part("forearm")
    assert layout.position_m[part.start : part.start + 36] == pytest.approx(rows[:36, :3], abs=1e-5)
    assert said == ""


def test_taxels_that_copy_their_representative_are_fitted_to_the_measured_ones(
    tmp_path: Path, forearm: Path
) -> None:
    rows = forearm_rows()
    true = rows[:12, :3].copy()
    rows[[4, 5, 7, 8]] = rows[3]
    rows[[6, 10]] = 0
    by = np.repeat(np.arange(384) // 12 * 12 + 3, 1)
    by[[6, 10]] = -2
    file = tmp_path / "forearm.txt"
    entries = "  ".join(map(str, by))
    write_rows(file, rows, f"name f\nspatial_sampling taxel\ntaxel2Repr ( {entries} )\n")
    _, layout, said = run("positions", file, forearm)
    assert layout.position_m[layout.part("forearm").start :][:12] == pytest.approx(true, abs=1e-4)
    assert (
        f'{file}:4: triangle 0 of board "b13": 4 taxels without a place, fitted to the other 6; '
        "rms 0.0 mm from a flat triangle_10pad"
    ) in said


@pytest.mark.parametrize("by", [-1, 15], ids=["no taxel", "one of another triangle"])
def test_a_triangle_of_which_no_place_was_measured_keeps_them(
    tmp_path: Path, forearm: Path, by: int
) -> None:
    rows = forearm_rows()
    represented = np.arange(384) // 12 * 12 + 3
    represented[:12] = by
    if by >= 0:
        rows[:12, :3] = rows[by, :3]
    file = tmp_path / "forearm.txt"
    write_rows(file, rows, f"name f\ntaxel2Repr ( {'  '.join(map(str, represented))} )\n")
    _, layout, said = run("positions", file, forearm)
    assert (
        f'{file}:3: triangle 0 of board "b13": by taxel2Repr none of its places is its own'
    ) in said
    part = layout.part("forearm")
    assert layout.position_m[part.start] == pytest.approx(rows[0, :3], abs=0.02)
    assert np.isfinite(layout.position_m).all()


def test_taxels_that_share_one_place_beside_one_without_a_place_are_fitted_to_it(
    tmp_path: Path, forearm: Path
) -> None:
    rows = forearm_rows()
    rows[:12] = rows[3]
    rows[6] = 0
    file = tmp_path / "forearm.txt"
    write_rows(file, rows)
    _, layout, said = run("positions", file, forearm)
    assert "9 taxels without a place, fitted to the other 1, too few" in said
    part = layout.part("forearm")
    assert layout.position_m[part.start] == pytest.approx(rows[0, :3], abs=1e-5)


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        ("1 2 3 4 5", 'seen "1 2 3 4 5", wanted x y z nx ny nz; taken as no place'),
        ("1 2 3 4 5 x", "wanted x y z nx ny nz; taken as no place"),
        ("nan 2 3 4 5 6", "wanted x y z nx ny nz; taken as no place"),
    ],
)
def test_a_strange_row_is_named(tmp_path: Path, forearm: Path, edit: str, said: str) -> None:
    file = tmp_path / "forearm.txt"
    write_rows(file, forearm_rows())
    lines = file.read_text().splitlines()
    lines[1] = edit
    file.write_text("\n".join(lines))
    _, _, remarks = run("positions", file, forearm)
    assert f"{file}:2: " in remarks
    assert said in remarks


def test_places_of_triangles_that_are_off_and_triangles_without_places_are_named(
    tmp_path: Path, forearm: Path
) -> None:
    rows = forearm_rows()
    rows[12 * 3 : 12 * 4] = rows_of(PlaceSettings(x_mm=300))
    rows[12 * 17 : 12 * 18] = 0
    file = tmp_path / "forearm.txt"
    write_rows(file, rows)
    settings, _, said = run("positions", file, forearm)
    assert f'{file}:37: places for triangle 3 of board "b13", which is not on; not used' in said
    assert 'no places for triangles 1 of board "b12"' in said
    last = [patch for patch in settings.parts["forearm"].patches if patch.board == "b12"]
    assert [(patch.triangles, bool(patch.positions)) for patch in last] == [
        ("1", False),
        ("0,5", True),
    ]


def test_rows_of_more_boards_than_a_bus_has_are_counted(tmp_path: Path) -> None:
    file = tmp_path / "arm.txt"
    write_rows(file, np.tile(forearm_rows()[:192], (20, 1)))
    with pytest.raises(ConfigurationError, match="rows of 20 boards, 20 with places; wanted 1 to"):
        run("positions", file)


def test_a_positions_file_of_no_known_part_asks_for_one(tmp_path: Path, forearm: Path) -> None:
    file = tmp_path / "torso.txt"
    write_rows(file, forearm_rows())
    with pytest.raises(ConfigurationError, match=r"--part, there are: arm, forearm"):
        run("positions", file, forearm)
    _, layout, _ = run("positions", file, forearm, part="forearm")
    assert layout.position_m[layout.part("forearm").start, 2] != 0


MANAGER = """\
inputPorts ( /icub/skin/a \\
             /icub/skin/b )
robot icubTest01
period 50
addThreshold 7
compensationGain 0.2
contactCompensationGain 0.05
zeroUpRawData true
wobble 3
[SKIN_EVENTS]
taxelPositionFiles ( positions/gone.txt
    here.txt )
"""


def test_the_managers_thresholds_and_gains_are_taken(tmp_path: Path, arm: Path) -> None:
    (tmp_path / "here.txt").write_text("")
    file = tmp_path / "skinMan.ini"
    file.write_text(MANAGER)
    settings, _, said = run("skinmanager", file, arm)
    assert settings.robot == "icubtest01"
    assert settings.processing.touch.margin_units == 7
    assert settings.processing.drift.rule == "proportional"
    assert settings.processing.drift.gain_per_s == pytest.approx(0.08)
    for remark in (
        "1: inputPorts: of its ports",
        "8: zeroUpRawData true: here values always fall with pressure",
        '9: "wobble 3" is not understood; not read',
        "11: positions/gone.txt: not found",
        "11: here.txt: `skin import positions",
        "12: the line before lacks its backslash",
    ):
        assert f"{file}:{remark}" in said


def test_the_manager_alone_is_no_skin(tmp_path: Path) -> None:
    file = tmp_path / "skinMan.ini"
    file.write_text(MANAGER)
    with pytest.raises(ConfigurationError, match="import skinspec first"):
        run("skinmanager", file)


def test_nothing_is_written_when_something_is_wrong(tmp_path: Path, arm: Path) -> None:
    file = tmp_path / "hand.ini"
    file.write_text("robotPart hand\ncardid 14\n[SENSORS]\nfingertip 0 1e9 0 0 1\n")
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(ConfigurationError, match="do not give a valid configuration"):
        run("skingui", file, arm)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_positions_file_is_not_replaced_by_what_is_made_of_it(
    tmp_path: Path, forearm: Path
) -> None:
    file = tmp_path / "forearm.txt"
    write_rows(file, forearm_rows())
    run("positions", file, forearm)
    made = min((tmp_path / "out-positions").iterdir())
    file.rename(made)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    output = tmp_path / "out.toml"
    with pytest.raises(RequestError, match=re.escape(f"{made}: is read by this command")):
        import_files("positions", [made], output, Findings(), config=forearm, part="forearm")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_positions_files_are_found_from_another_folder(tmp_path: Path, forearm: Path) -> None:
    file = tmp_path / "forearm.txt"
    write_rows(file, forearm_rows())
    run("positions", file, forearm)
    manager = tmp_path / "skinMan.ini"
    manager.write_text("addThreshold 3\n")
    elsewhere = tmp_path / "deep" / "er" / "robot.toml"
    import_files("skinmanager", [manager], elsewhere, Findings(), config=tmp_path / "out.toml")
    assert built(elsewhere)[1].position_m == pytest.approx(
        built(tmp_path / "out.toml")[1].position_m
    )


#: Keys of a configuration whose value is the name of a file.
FILES = {"positions", "file", "password_file", "ca_file", "certificate_file", "key_file"}
FOAM = {"beta": [0.125], "tau_s": [3.5], "beta_unload": [0.25], "tau_unload_s": [4.5]}


@pytest.fixture
def secured(tmp_path: Path, arm: Path) -> Path:
    """The arm with a fitted foam, and a broker that wants a password and certificates."""
    foam = {"schema": "skin.relaxation/1", "model": "published", **FOAM}
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "foam.json").write_bytes(msgspec.json.encode(foam))
    (tmp_path / "files" / "password").write_text("secret")
    arm.write_text(
        arm.read_text()
        + '[processing.relaxation]\nfile = "files/foam.json"\nupdate_s = 2.0\n'
        + '[mqtt]\nusername = "skin"\npassword_file = "files/password"\ntls = true\n'
        + 'ca_file = "/etc/ssl/ca.pem"\ncertificate_file = "files/c.pem"\nkey_file = "k.pem"\n'
    )
    return arm


def test_all_files_that_a_configuration_names_are_found_from_another_folder(
    tmp_path: Path, secured: Path
) -> None:
    manager = tmp_path / "skinMan.ini"
    manager.write_text("addThreshold 3\n")
    for output in (tmp_path / "near.toml", tmp_path / "deep" / "er" / "robot.toml"):
        import_files("skinmanager", [manager], output, Findings(), config=secured)
        old, new = load(secured), load(output)
        for key in FILES - {"positions", "file"}:
            there = output.parent / getattr(new.mqtt, key)
            assert there.resolve() == tmp_path / getattr(old.mqtt, key)
        assert new.mqtt.ca_file == "/etc/ssl/ca.pem"
        relaxation = msgspec.structs.replace(new.processing.relaxation, file="files/foam.json")
        assert relaxation == old.processing.relaxation
        assert relaxation.beta == FOAM["beta"]
        # The file has the numbers; a copy of them would stay when it changes.
        assert "beta" not in output.read_text()
    assert load(tmp_path / "near.toml").mqtt.password_file == "files/password"


def test_a_folder_behind_a_link_still_finds_the_files(tmp_path: Path, secured: Path) -> None:
    manager = tmp_path / "skinMan.ini"
    manager.write_text("addThreshold 3\n")
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "a" / "b")
    output = tmp_path / "link" / "robot.toml"
    import_files("skinmanager", [manager], output, Findings(), config=secured)
    there = output.parent / (load(output).mqtt.password_file or "")
    assert there.read_text() == "secret"


def test_what_goes_into_a_pipe_names_files_from_any_folder(
    tmp_path: Path, secured: Path, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    manager = tmp_path / "skinMan.ini"
    manager.write_text("addThreshold 3\n")
    import_files("skinmanager", [manager], Path("/dev/stdout"), Findings(), config=secured)
    elsewhere = tmp_path / "deep" / "robot.toml"
    elsewhere.parent.mkdir()
    elsewhere.write_bytes(capfdbinary.readouterr().out)
    assert load(elsewhere).mqtt.password_file == str(tmp_path / "files" / "password")


def test_a_file_that_is_missing_is_named_where_it_is_wanted(tmp_path: Path, secured: Path) -> None:
    manager = tmp_path / "skinMan.ini"
    manager.write_text("addThreshold 3\n")
    output = tmp_path / "deep" / "robot.toml"
    (tmp_path / "files" / "foam.json").unlink()
    missing = re.escape(f"{tmp_path}/files/foam.json: cannot be read")
    with pytest.raises(ConfigurationError, match=missing):
        import_files("skinmanager", [manager], output, Findings(), config=secured)
    assert not output.parent.exists()


def test_each_key_that_names_a_file_is_one_that_an_import_moves() -> None:
    named: set[str] = set()
    moved: set[str] = set()
    for table in _tables(Settings):
        for key, kind in get_type_hints(table, include_extras=True).items():
            moved |= {key} if kind == FileName | None else set()
            named |= {key} if key.endswith(("file", "positions")) else set()
    assert named == moved == FILES


def _tables(kind: Any) -> set[type[msgspec.Struct]]:
    """All tables that a type holds, itself included."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        inner = get_type_hints(kind, include_extras=True).values()
        return {kind}.union(*map(_tables, inner))
    return set().union(*map(_tables, get_args(kind)))


@pytest.mark.parametrize("path", sorted((ROOT / "config").glob("*.toml")), ids=lambda p: p.stem)
def test_settings_survive_writing(tmp_path: Path, path: Path) -> None:
    settings = load(path)
    (tmp_path / path.name).write_text(configuration_text(settings, "a comment\n\nof lines"))
    assert msgspec.to_builtins(load(tmp_path / path.name)) == msgspec.to_builtins(settings)


#: Categories of characters that free text of a configuration does not have.
UNPRINTABLE = ("Cc", "Cf", "Cs", "Zl", "Zp")


@given(
    channel=st.text(
        st.characters(codec="utf-8", exclude_categories=UNPRINTABLE), min_size=1, max_size=20
    ),
    turn=st.floats(-LARGEST, LARGEST),
    option=st.one_of(
        st.booleans(),
        st.integers(-(2**62), 2**62),
        st.text(st.characters(exclude_categories=UNPRINTABLE), max_size=9),
    ),
)
def test_any_values_survive_writing(
    tmp_path_factory: pytest.TempPathFactory, channel: str, turn: float, option: object
) -> None:
    settings = changed(
        load(ROOT / "config" / "demo.toml"),
        {
            "buses.can0.channel": channel,
            "buses.can0.options": {"odd key": option},
            "processing.relaxation.beta": [0.1, 0.2],
            "processing.relaxation.tau_s": [1.0, 2e7],
        },
    )
    places = settings.parts["left_hand"].patches[0].places
    places[0] = changed(places[0], {"turn_deg": turn})
    path = tmp_path_factory.mktemp("any") / "robot.toml"
    path.write_text(configuration_text(settings), encoding="utf-8", newline="")
    assert msgspec.to_builtins(load(path)) == msgspec.to_builtins(settings)


def test_what_is_written_is_what_was_meant_to_be_read() -> None:
    settings = load(ROOT / "config" / "nao.toml")
    text = configuration_text(settings)
    assert "period_ms" not in text  # the default
    assert parse_triangles(settings.parts["left_upper_arm"].patches[0].triangles) == list(range(9))


@needs_samples
def test_the_shipped_icub_has_its_forearm_where_its_positions_file_has_it(tmp_path: Path) -> None:
    shipped = ROOT / "config" / "icub.toml"
    output = tmp_path / "icub.toml"
    arguments = ["--part", "left_forearm", "--config", str(shipped), "--output", str(output)]
    assert main(["import", "positions", str(POSITIONS), *arguments]) == 0
    ours, theirs = (build_layout(load(path), path.parent) for path in (shipped, output))
    part = ours.part("left_forearm")
    mine = np.arange(part.start, part.stop)[ours.pad_kind[part.start : part.stop] == 0]
    apart_m = np.linalg.norm(ours.position_m[mine] - theirs.position_m[mine], axis=1)
    assert np.median(apart_m) < 1e-3
    assert apart_m.max() < 3e-3
    # Both look outwards.
    assert np.sum(ours.normal[mine] * theirs.normal[mine], axis=1).min() > 0
