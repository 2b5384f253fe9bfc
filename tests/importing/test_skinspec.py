"""Boards and triangles of skinSpec files, the messy ones of real robots above all."""

from pathlib import Path

import pytest

from skin_host.errors import ConfigurationError
from skin_host.importing.report import Findings
from skin_host.importing.skinspec import BoardSpec, Device, read_device

DATA = Path(__file__).parents[2].parent / "shared" / "data"

DEFAULTS = """\
<group name="defaultCfgBoard">
  <param name="period"> 50 </param>
  <param name="skinType"> 0 </param>
  <param name="noLoad"> 0xf0 </param>
  <param name="diagnostic"> false </param>
</group>
<group name="defaultCfgTriangle">
  <param name="enabled"> false </param>
  <param name="shift"> 2 </param>
  <param name="cdcOffset"> 0x2200 </param>
</group>
"""
HEAD = '<?xml version="1.0" encoding="UTF-8" ?>\n<params robot="iCubTest01" build="1">\n'


def sets(*rows: str, announced: int | None = None) -> str:
    lines = [f'<param name="triangleSetCfg{i}"> {row} </param>' for i, row in enumerate(rows, 1)]
    number = len(rows) if announced is None else announced
    return "\n".join(
        [
            '<group name="specialCfgTriangles">',
            f'<param name="numOfSets"> {number} </param>',
            *lines,
            "</group>\n",
        ]
    )


def read(folder: Path, text: str, name: str = "left_arm-eb1-skinSpec.xml") -> tuple[Device, str]:
    path = folder / name
    path.write_text(text)
    findings = Findings()
    device = read_device(path, findings)
    return device, "\n".join(str(item).replace(f"{path}", "FILE") for item in findings.items)


def triangles(boards: list[BoardSpec]) -> dict[int, list[int]]:
    return {board.address: sorted(board.triangles) for board in boards}


def test_a_real_arm_has_its_seven_boards_and_their_triangles() -> None:
    path = DATA / "icub_genova11_left_arm_skinSpec.xml"
    if not path.exists():
        pytest.skip(f"{path} is not here")
    findings = Findings()
    device = read_device(path, findings)
    assert (device.name, device.robot) == ("left_arm", "iCubGenova11")
    (boards,) = device.patches.values()
    assert triangles(boards) == {
        14: [0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 11],
        13: list(range(16)),
        12: [0, 1, 3, 6, 8, 9, 12, 13],
        11: [1, 2, 3, 4, 8, 9, 10, 11, 12, 13],
        10: [0, 1, 6, 8, 9, 10, 11, 12, 13, 14, 15],
        9: [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 13],
        8: [0, 8, 9, 10, 11, 13, 15],
    }
    assert boards[0].triangles[0] == (0, 0x2000)
    assert boards[0].triangles[8] == (2, 0x2200)
    assert all((b.period_ms, b.skin_type, b.no_load) == (50, 8, 240) for b in boards)
    assert f"{path}:13: diagnostic" in findings.table()
    assert "triangles without a set are on by default too" in findings.table()


def test_two_patches_are_two_buses_and_boards_keep_the_order_of_the_device(
    tmp_path: Path,
) -> None:
    spec = HEAD + DEFAULTS + sets("1 7 0 3 1 2 0x2200", "2 12 1 1 1 2 0x2200") + "</params>"
    (tmp_path / "left_leg-skinSpec.xml").write_text(spec)
    device, _ = read(
        tmp_path,
        '<device robot="r"><group name="patches">\n'
        '<param name="skinCanAddrsPatch1"> 7 </param>\n'
        '<param name="skinCanAddrsPatch2"> 13 12 </param></group>\n'
        '<xi:include xmlns:xi="x" href="left_leg-skinSpec.xml" /></device>',
        "left_leg-skin.xml",
    )
    assert {patch: triangles(boards) for patch, boards in device.patches.items()} == {
        1: {7: [0, 1, 2, 3]},
        2: {12: [1]},
    }


def test_the_set_up_of_single_boards_replaces_the_default(tmp_path: Path) -> None:
    special = (
        '<group name="specialCfgBoards"><param name="numOfSets"> 1 </param>\n'
        '<param name="boardSetCfg1"> 1 14 14 100 1 0xc8 </param></group>'
    )
    body = sets("1 14 0 4 1 0 0x2000", "1 13 0 0 1 2 0x2200")
    device, said = read(tmp_path, HEAD + DEFAULTS + special + body + "</params>")
    hand, arm = device.patches[1]
    assert (hand.period_ms, hand.skin_type, hand.no_load) == (100, 1, 200)
    assert (arm.period_ms, arm.skin_type, arm.no_load) == (50, 0, 240)
    assert said == "FILE:7: diagnostic: status words are always read here"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            '<param name="enabled"> false',
            '<param name="enabled"> fasle',
            'FILE:10: enabled: seen "fasle"; taken as false, as the robot\'s own host reads it',
        ),
        (
            '<param name="period"> 50',
            '<param name="period"> about 50',
            'FILE:4: period: seen "about 50"; taken: 50',
        ),
        (
            '<param name="skinType"> 0',
            '<param name="skinType"> 9',
            'FILE:5: skinType: seen "9"; taken: 0',
        ),
        (
            '<param name="period"> 50 </param>',
            "",
            "FILE: defaultCfgBoard: no period; taken: 50",
        ),
        (
            "</params>",
            "",
            "FILE:19: not valid XML from here: no element found; the rest is not read",
        ),
    ],
)
def test_a_strange_value_is_named_with_its_line(
    tmp_path: Path, old: str, new: str, said: str
) -> None:
    text = HEAD + DEFAULTS + sets("1 13 0 3 1 2 0x2200", "1 13 8 8 1 2 0x2200") + "</params>"
    assert old in text
    device, remarks = read(tmp_path, text.replace(old, new))
    assert said in remarks.splitlines()
    assert triangles(device.patches[1]) == {13: [0, 1, 2, 3, 8]}


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("1 13 0 3 1 2", 'seen "1 13 0 3 1 2", wanted 7 numbers; not read'),
        ("1 13 0 x 1 2 0x2200", 'seen "1 13 0 x 1 2 0x2200", wanted 7 numbers; not read'),
        ("1 13 0 16 1 2 0x2200", "last triangle 16; not read"),
        ("1 13 4 3 1 2 0x2200", "last triangle 3; not read"),
        ("1 15 0 3 1 2 0x2200", "board 15; not read"),
        ("1 13 0 3 1 9 0x2200", "shift 9; not read"),
        ("1 13 0 3 1 2 0x12200", "cdcOffset 74240; not read"),
        ("1 13 0 99999999999999999999 1 2 0", "wanted 7 numbers; not read"),
    ],
)
def test_a_set_that_cannot_be_meant_is_named_and_left_out(
    tmp_path: Path, row: str, said: str
) -> None:
    text = HEAD + DEFAULTS + sets("1 13 5 5 1 2 0x2200", row) + "</params>"
    device, remarks = read(tmp_path, text)
    assert f"FILE:17: triangleSetCfg2: {said}" in remarks or said in remarks
    assert triangles(device.patches[1]) == {13: [5]}


def test_a_set_that_is_off_takes_triangles_away(tmp_path: Path) -> None:
    text = HEAD + DEFAULTS + sets("1 13 0 7 1 2 0x2200", "1 13 2 4 0 2 0x2200") + "</params>"
    device, _ = read(tmp_path, text)
    assert triangles(device.patches[1]) == {13: [0, 1, 5, 6, 7]}


@pytest.mark.parametrize(
    ("rows", "on"),
    [
        (["1 5 4 15 0 2 0x2200"], {5: [0, 1, 2, 3], 6: list(range(16))}),
        (["1 5 4 15 0 2 0x2200", "1 5 1 1 1 3 0x2000"], {5: [0, 1, 2, 3], 6: list(range(16))}),
        (["1 5 1 1 1 3 0x2000", "1 5 4 15 0 2 0x2200"], {5: [0, 1, 2, 3], 6: list(range(16))}),
        (["1 5 0 15 0 2 0x2200"], {6: list(range(16))}),
        (["1 5 0 15 0 2 0x2200", "1 5 2 2 1 2 0x2200"], {5: [2], 6: list(range(16))}),
    ],
)
def test_a_set_that_is_off_takes_triangles_from_those_that_are_on_by_default(
    tmp_path: Path, rows: list[str], on: dict[int, list[int]]
) -> None:
    patches = '<group name="patches"><param name="skinCanAddrsPatch1"> 5 6 </param></group>'
    defaults = DEFAULTS.replace("> false <", "> true <", 2)
    device, said = read(tmp_path, HEAD + patches + defaults + sets(*rows) + "</params>")
    assert triangles(device.patches[1]) == on
    assert "boards 6 have no set of triangles" in said
    assert "without a set are on by default" not in said
    assert "earlier set" not in said


def test_triangles_that_are_on_by_default_have_the_default_set_up(tmp_path: Path) -> None:
    defaults = DEFAULTS.replace("> false <", "> true <", 2)
    rows = ["1 5 2 15 0 2 0x2200", "1 5 1 1 1 3 0x2000"]
    device, _ = read(tmp_path, HEAD + defaults + sets(*rows) + "</params>")
    assert device.patches[1][0].triangles == {0: (2, 0x2200), 1: (3, 0x2000)}


def test_a_set_that_is_not_read_turns_nothing_on(tmp_path: Path) -> None:
    defaults = DEFAULTS.replace("> false <", "> true <", 2)
    rows = ["1 5 0 3 1 2 0x2200", "1 5 8 20 0 2 0x2200"]
    device, _ = read(tmp_path, HEAD + defaults + sets(*rows) + "</params>")
    assert triangles(device.patches[1]) == {5: [0, 1, 2, 3]}


def test_a_name_that_is_there_twice_is_named_and_both_sets_are_taken(tmp_path: Path) -> None:
    body = sets("1 13 0 0 1 2 0x2200", "1 13 1 1 1 2 0x2200").replace("Cfg2", "Cfg1")
    device, said = read(tmp_path, HEAD + DEFAULTS + body + "</params>")
    assert "FILE:17: triangleSetCfg1 exists already, line 16; both are taken" in said
    assert triangles(device.patches[1]) == {13: [0, 1]}


def test_more_sets_than_the_robots_own_hosts_read_are_all_taken(tmp_path: Path) -> None:
    rows = [f"1 {8 + i // 16} {i % 16} {i % 16} 1 2 0x2200" for i in range(33)]
    device, said = read(tmp_path, HEAD + DEFAULTS + sets(*rows) + "</params>")
    assert "FILE:15: numOfSets 33: the robot's own hosts read 20 at most; all are taken" in said
    assert triangles(device.patches[1]) == {8: list(range(16)), 9: list(range(16)), 10: [0]}


def test_a_number_of_sets_that_does_not_fit_is_named(tmp_path: Path) -> None:
    rows = ["1 13 0 0 1 2 0x2200", "1 13 1 1 1 2 0x2200"]
    _, said = read(tmp_path, HEAD + DEFAULTS + sets(*rows, announced=4) + "</params>")
    assert "FILE:15: numOfSets 4, but there are 2" in said
    device, said = read(tmp_path, HEAD + DEFAULTS + sets(*rows, announced=1) + "</params>")
    assert "FILE:17: triangleSetCfg2: beyond numOfSets 1; taken" in said
    assert triangles(device.patches[1]) == {13: [0, 1]}


def test_comments_within_comments_end_at_the_first_end(tmp_path: Path) -> None:
    text = (
        HEAD
        + DEFAULTS
        + "<!-- off <!-- really -->\n"
        + sets("1 13 0 0 1 2 0x2200")
        + "<!-- the end\n -->\n</params>"
    )
    device, said = read(tmp_path, text)
    assert (
        "FILE:14: a comment within the comment of line 14; both end at the first -->, line 14"
    ) in said
    assert triangles(device.patches[1]) == {13: [0]}


def test_sets_that_are_commented_out_are_named(tmp_path: Path) -> None:
    text = (
        HEAD
        + DEFAULTS.replace("> false <", "> true <")
        + '<!-- <param name="triangleSetCfg1"> 1 9 0 3 1 2 0 </param> -->\n'
        + '<group name="patches"><param name="skinCanAddrsPatch1"> 9 </param></group></params>'
    )
    device, said = read(tmp_path, text)
    assert "FILE:14: a comment with sets of triangles in it; they are not read" in said
    assert "boards 9 have no set of triangles, and all are on by default; all 16 are taken" in said
    assert triangles(device.patches[1]) == {9: list(range(16))}


@pytest.mark.timeout(20)
@pytest.mark.parametrize(
    "filling",
    ["<!---->", "<!----\n>-->", "\n", "<a/>\n", '<param name="x">' + "\n" * 99 + "</param>"],
)
def test_the_time_of_reading_grows_no_faster_than_the_file(tmp_path: Path, filling: str) -> None:
    """Comments of 1.4 MB took 50 s, because each one counted the lines before it."""
    body = filling * (3_500_000 // len(filling))
    _, said = read(tmp_path, f"{HEAD}{DEFAULTS}{body}<!-- no end")
    line = (HEAD + DEFAULTS + body).count("\n") + 1
    assert f"FILE:{line}: a comment without an end; it takes the rest" in said


def test_a_comments_line_counts_the_lines_of_the_comments_before(tmp_path: Path) -> None:
    text = "<params>\n<!-- one\n\n --> <!-- \n<!-- two\n -->\n<!-- triangleSetCfg -->\n<!-- "
    _, said = read(tmp_path, text)
    assert (
        "FILE:5: a comment within the comment of line 4; both end at the first -->, line 6" in said
    )
    assert "FILE:7: a comment with sets of triangles" in said
    assert "FILE:8: a comment without an end" in said


def test_the_oldest_form_names_only_addresses(tmp_path: Path) -> None:
    device, said = read(
        tmp_path,
        '<device><param name="canDeviceNum"> 9 </param>\n'
        '<param name="skinCanIds"> 7 8 x 8 </param></device>',
    )
    assert triangles(device.patches[9]) == {7: list(range(16)), 8: list(range(16))}
    assert 'FILE:2: skinCanIds: "x" is no address 1..14' in said
    assert "FILE:2: skinCanIds: 8 is there twice" in said
    assert "boards 7, 8: all 16 triangles are on" in said


def test_an_included_file_that_is_missing_is_named(tmp_path: Path) -> None:
    device, said = read(
        tmp_path,
        '<device>\n<xi:include xmlns:xi="x" href="./gone-skinSpec.xml" />\n'
        '<xi:include xmlns:xi="x" href="../general.xml" /></device>',
    )
    assert device.patches == {}
    assert 'FILE:2: includes "./gone-skinSpec.xml", which was not found' in said
    assert 'FILE:3: includes "../general.xml"; only skinSpec files are read' in said


@pytest.mark.parametrize("text", ["", "not xml", "<a", "<!-- no end", "<params></device>", "\x00"])
def test_what_is_no_such_file_describes_no_board(tmp_path: Path, text: str) -> None:
    device, said = read(tmp_path, text)
    assert device.patches == {}
    assert said


def test_a_file_that_expands_itself_is_no_trap(tmp_path: Path) -> None:
    entities = "".join(f'<!ENTITY l{i + 1} "{f"&l{i};" * 10}">' for i in range(12))
    text = f'<!DOCTYPE a [<!ENTITY l0 "ha">{entities}]><params>&l12;</params>'
    with pytest.raises(ConfigurationError, match="declares entities"):
        read(tmp_path, text)


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot be read"):
        read_device(tmp_path / "gone.xml", Findings())
