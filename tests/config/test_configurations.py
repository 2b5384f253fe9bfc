"""The configurations that come with the project hold what their sources say."""

from pathlib import Path

import numpy as np
import pytest

from skin_host.config import check
from skin_host.config.settings import load
from skin_host.layout import build_layout

CONFIG = Path(__file__).parents[2] / "config"


def described(name: str) -> check.Record:
    settings = load(CONFIG / f"{name}.toml")
    return check.describe(settings, build_layout(settings, CONFIG))


def taxels(description: check.Record) -> dict[str, int]:
    return {part["name"]: part["taxels"] for part in description["parts"]}


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*.toml")), ids=lambda path: path.stem)
def test_every_configuration_is_sound_and_gives_no_warning(path: Path) -> None:
    description = described(path.stem)
    assert description["total"]["taxels"] == 12 * description["total"]["triangles"]
    assert description["warnings"] == []


def test_the_arm_of_the_paper_has_384_points_of_which_108_on_the_hand() -> None:
    description = described("icub_2011_arm")
    assert taxels(description) == {"left_hand": 108, "left_forearm": 276}
    assert description["parts"][1]["triangles"] == 23


def test_kaspar_has_ten_boards_and_68_triangles_with_816_points() -> None:
    total = described("kaspar")["total"]
    assert (total["boards"], total["triangles"], total["taxels"]) == (10, 68, 816)


def test_nao_has_216_points_on_each_lower_arm_and_108_on_each_upper_arm() -> None:
    assert taxels(described("nao")) == {
        "left_lower_arm": 216,
        "left_upper_arm": 108,
        "right_lower_arm": 216,
        "right_upper_arm": 108,
    }


def test_the_whole_icub_has_its_boards_at_the_robots_addresses() -> None:
    boards: dict[str, list[int]] = {}
    for board in described("icub")["boards"]:
        boards.setdefault(board["bus"], []).append(board["address"])
    assert boards == {
        "left_arm": [14, 13, 12, 11, 10, 9, 8],
        "right_arm": [14, 13, 12, 11, 10, 9, 8],
        "torso": [7, 8, 9, 10],
        "left_leg_lower": [13, 12, 8, 9, 10, 11],
        "left_leg_upper": [1, 2, 3, 4, 5, 6, 7],
        "right_leg_lower": [13, 12, 8, 9, 10, 11],
        "right_leg_upper": [1, 2, 3, 4, 5, 6, 7],
    }


def test_the_whole_icub_has_the_triangles_of_its_parts() -> None:
    triangles = {part["name"]: part["triangles"] for part in described("icub")["parts"]}
    arm = {"hand": 9, "forearm": 16 + 8, "upper_arm": 10 + 11 + 11 + 7}
    leg = {"foot": 13 + 12, "lower_leg": 10 + 8 + 10 + 10, "upper_leg": 68}
    assert triangles == {
        **{f"{side}_{part}": n for side in ("left", "right") for part, n in (arm | leg).items()},
        "torso": 7 + 11 + 16 + 10,
    }


def test_the_left_arm_enables_what_the_robots_own_description_enables() -> None:
    """Triangles 5 and 6 of the hand board are enabled there, but carry nothing."""
    path = CONFIG.parent.parent / "shared" / "data" / "icub_genova11_left_arm_skinSpec.xml"
    if not path.exists():
        pytest.skip(f"{path} is not here")
    sets = [
        [int(word, 0) for word in line.split(">")[1].split("<")[0].split()]
        for line in path.read_text().splitlines()
        if "triangleSetCfg" in line
    ]
    named: dict[int, set[int]] = {}
    for _patch, board, first, last, enabled, _shift, _offset in sets:
        if enabled:
            named.setdefault(board, set()).update(range(first, last + 1))
    named[14] -= {5, 6}
    settings = load(CONFIG / "icub.toml")
    layout = build_layout(settings, CONFIG)
    ours = {
        board.settings.address: set(board.triangles)
        for board in layout.boards
        if board.settings.bus == "left_arm"
    }
    assert ours == named


@pytest.mark.parametrize("name", ["demo", "icub", "icub_2011_arm", "icub_hand"])
def test_what_one_finger_touches_is_no_contact_of_the_next(name: str) -> None:
    settings = load(CONFIG / f"{name}.toml")
    layout = build_layout(settings, CONFIG)
    for part in layout.parts:
        if not part.name.endswith("hand"):
            continue
        unit = np.minimum((np.arange(part.n_taxels)) // 12, 5)  # five tips, then the palm
        for taxel in range(part.n_taxels):
            start, stop = layout.neighbour_start[part.start + taxel : part.start + taxel + 2]
            near = layout.neighbour[start:stop] - part.start
            assert (unit[near] == unit[taxel]).all()


def test_the_whole_icub_lies_in_space_but_for_its_hands() -> None:
    layout = build_layout(load(CONFIG / "icub.toml"), CONFIG)
    for part in layout.parts:
        mine = slice(part.start, part.stop)
        position_mm, normal = 1e3 * layout.position_m[mine], layout.normal[mine]
        triangle = layout.triangle_of[mine]
        apart_mm = np.linalg.norm(position_mm[:, np.newaxis] - position_mm, axis=2)
        # Triangles do not overlap.
        assert apart_mm[triangle[:, np.newaxis] != triangle].min() > 5.0, part.name
        if part.name.endswith(("hand", "foot")):
            assert np.ptp(position_mm[:, 2]) < 1e-6
            continue
        assert np.ptp(position_mm, axis=0).min() > 20.0
        outward_mm = ((position_mm - np.median(position_mm, axis=0)) * normal).sum(axis=1)
        assert outward_mm.min() > 0.0, part.name
