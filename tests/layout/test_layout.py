"""Where taxels lie, who their neighbours are, and what a bad layout is told."""

import os
import re
import tracemalloc
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from skin_host.client.nodes import Nodes
from skin_host.client.presence import Presence
from skin_host.config.settings import KindSettings, PlaceSettings, Settings, changed
from skin_host.errors import ConfigurationError
from skin_host.layout import Layout, PadKind, build_layout, builtin_kinds
from skin_host.layout.geometry import NEIGHBOUR_PITCHES, fitted_outline, lay, shares_mm2, tile
from skin_host.mqtt.info import encode_info, node_info

HERE = Path()
angles_deg = st.floats(-360, 360)
lengths_mm = st.floats(-500, 500)
directions = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)).filter(
    lambda vector: np.linalg.norm(vector) > 0.1
)


def skin(*patches: dict[str, object], **more: object) -> Settings:
    """A robot of one part and one board."""
    return msgspec.convert(
        {
            "robot": "test",
            "buses": {"can0": {}},
            "boards": {"mtb": {"bus": "can0", "address": 1}},
            "parts": {"arm": {"patches": [{"board": "mtb", **patch} for patch in patches]}},
            **more,
        },
        Settings,
    )


def neighbours(layout: Layout, taxel: int) -> set[int]:
    start, stop = layout.neighbour_start[taxel : taxel + 2]
    return set(layout.neighbour[start:stop].tolist())


def test_a_triangle_without_a_place_lies_flat_and_faces_up() -> None:
    layout = build_layout(skin({"triangles": "3"}), HERE)
    kind = builtin_kinds()["triangle"]
    shift = layout.position_m[0, :2] * 1e3 - kind.pads_mm[0]
    assert layout.position_m[:, :2] * 1e3 - shift == pytest.approx(np.array(kind.pads_mm))
    assert (layout.normal == [0, 0, 1]).all()
    assert (layout.position_m[:, 2] == 0).all()


def test_taxels_follow_the_order_of_the_patches_and_of_their_triangles() -> None:
    layout = build_layout(skin({"triangles": "7,2"}, {"triangles": "0"}), HERE)
    assert [triangle.number for triangle in layout.triangles] == [7, 2, 0]
    board = layout.boards[0]
    assert board.taxel_index[7].tolist() == list(range(12))
    assert board.taxel_index[2].tolist() == list(range(12, 24))
    assert board.taxel_index[0].tolist() == list(range(24, 36))
    assert (board.taxel_index[1] == -1).all()
    assert board.enabled == 0b1000_0101
    assert layout.triangle_of.tolist() == [0] * 12 + [1] * 12 + [2] * 12


def test_the_unit_of_a_taxel_doubles_with_each_shift() -> None:
    layout = build_layout(
        skin({"triangles": "0", "shift": 0}, {"triangles": "1", "shift": 3}), HERE
    )
    assert layout.unit_ff[12] == pytest.approx(2.88)
    assert layout.unit_ff[12] == 8 * layout.unit_ff[0]


def test_thermal_pads_are_marked() -> None:
    layout = build_layout(skin({"triangles": "0-1", "kind": "triangle_10pad"}), HERE)
    assert np.flatnonzero(layout.pad_kind == PadKind.THERMAL).tolist() == [6, 10, 18, 22]


def test_a_palm_takes_four_triangles_and_has_thermal_pads_11_23_35_43() -> None:
    layout = build_layout(skin({"triangles": "8-11", "kind": "palml"}), HERE)
    assert np.flatnonzero(layout.pad_kind == PadKind.THERMAL).tolist() == [11, 23, 35, 43]


@pytest.mark.parametrize("name", sorted(builtin_kinds()))
def test_pads_of_a_kind_lie_apart_and_within_its_outline(name: str) -> None:
    kind = builtin_kinds()[name]
    pads = np.array(kind.pads_mm)
    apart = np.linalg.norm(pads[:, None] - pads[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    assert apart.min() > 2 * kind.radius_mm * 0.8
    outline = np.array(kind.outline_mm)
    inside = np.zeros(len(pads), bool)
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        crosses = (a[1] > pads[:, 1]) != (b[1] > pads[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            at = (b[0] - a[0]) * (pads[:, 1] - a[1]) / (b[1] - a[1]) + a[0]
        inside ^= crosses & (pads[:, 0] < at)
    assert inside.all()


@given(x=lengths_mm, y=lengths_mm, z=lengths_mm, turn=angles_deg, normal=directions)
def test_placing_keeps_distances_and_lays_the_plane_along_the_normal(
    x: float, y: float, z: float, turn: float, normal: tuple[float, float, float]
) -> None:
    points = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 5.0]])
    placed, normals = lay(
        points, PlaceSettings(x_mm=x, y_mm=y, z_mm=z, turn_deg=turn, normal=normal)
    )
    assert placed[0] == pytest.approx([x, y, z])
    along, across = placed[1] - placed[0], placed[2] - placed[0]
    assert np.linalg.norm(along) == pytest.approx(10)
    assert np.linalg.norm(across) == pytest.approx(5)
    unit = normal / np.linalg.norm(normal)
    assert np.cross(along, across) / 50 == pytest.approx(unit, abs=1e-9)
    assert normals[0] == pytest.approx(unit, abs=1e-12)


def test_a_mirrored_unit_has_its_x_axis_turned_round() -> None:
    points = np.array([[3.0, 4.0]])
    placed, _ = lay(points, PlaceSettings(mirror=True))
    assert placed.tolist() == [[-3, 4, 0]]


def test_a_turn_is_counted_against_the_clock() -> None:
    placed, _ = lay(np.array([[1.0, 0.0]]), PlaceSettings(turn_deg=90))
    assert placed[0] == pytest.approx([0, 1, 0])


def test_tiled_triangles_share_edges_and_do_not_overlap() -> None:
    kind = builtin_kinds()["triangle"]
    corners = [
        {tuple(np.round(corner, 2)) for corner in lay(np.array(kind.outline_mm), place)[0]}
        for place in tile(kind, 16, 0.0)[0]
    ]
    centres = np.array([np.mean(list(triangle), axis=0) for triangle in corners])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2) + 99 * np.eye(16)
    assert apart.min() == pytest.approx(30 / np.sqrt(3), rel=1e-3)
    for i in (*range(7), *range(8, 15)):
        assert len(corners[i] & corners[i + 1]) == 2


def test_neighbours_reach_the_next_pads_of_a_triangle_and_no_further() -> None:
    layout = build_layout(skin({"triangles": "0", "places": [{}]}), HERE)
    assert neighbours(layout, 3) >= {0, 2, 4, 6, 7, 11}
    assert 9 not in neighbours(layout, 3)
    assert 3 not in neighbours(layout, 3)


@given(st.lists(st.tuples(lengths_mm, lengths_mm, lengths_mm, directions), min_size=1, max_size=6))
def test_neighbours_are_all_that_are_near_and_on_the_same_side(
    places: list[tuple[float, float, float, tuple[float, float, float]]],
) -> None:
    settled = [
        {"x_mm": x / 20, "y_mm": y / 20, "z_mm": z / 20, "normal": list(normal)}
        for x, y, z, normal in places
    ]
    layout = build_layout(skin({"triangles": f"0-{len(places) - 1}", "places": settled}), HERE)
    reach_m = NEIGHBOUR_PITCHES * builtin_kinds()["triangle"].pitch_mm * 1e-3
    for taxel, (position_m, normal) in enumerate(
        zip(layout.position_m, layout.normal, strict=True)
    ):
        apart_m = np.linalg.norm(layout.position_m - position_m, axis=1)
        same_side = layout.normal @ normal
        surely = (apart_m < reach_m - 1e-9) & (same_side > 1e-9)
        perhaps = (apart_m < reach_m + 1e-9) & (same_side > -1e-9)
        found = neighbours(layout, taxel)
        assert set(np.flatnonzero(surely).tolist()) - {taxel} <= found
        assert found <= set(np.flatnonzero(perhaps).tolist()) - {taxel}


def test_neighbours_reach_across_the_edge_of_two_triangles() -> None:
    layout = build_layout(skin({"triangles": "0-1"}), HERE)
    assert any(j >= 12 for i in range(12) for j in neighbours(layout, i))


def test_the_two_sides_of_a_limb_are_no_neighbours() -> None:
    places = [{}, {"z_mm": -2, "normal": [0, 0, -1]}]
    layout = build_layout(skin({"triangles": "0-1", "places": places}), HERE)
    assert all(j < 12 for i in range(12) for j in neighbours(layout, i))


def test_two_parts_at_one_place_are_no_neighbours() -> None:
    patch = {"board": "mtb", "places": [{}]}
    settings = skin({"triangles": "5"})
    parts = {
        name: {"patches": [{**patch, "triangles": number}]}
        for name, number in (("arm", "0"), ("hand", "1"))
    }
    both = msgspec.convert({**msgspec.to_builtins(settings), "parts": parts}, Settings)
    layout = build_layout(both, HERE)
    assert all(j < 12 for i in range(12) for j in neighbours(layout, i))


def write_rows(path: Path, rows: np.ndarray) -> None:
    np.savetxt(path, rows)


def test_positions_from_a_file_are_taken_as_they_stand(tmp_path: Path) -> None:
    rows = np.column_stack([np.arange(36).reshape(12, 3) * 1e-3, np.tile([0, 3, 4], (12, 1))])
    write_rows(tmp_path / "arm.txt", rows)
    layout = build_layout(skin({"triangles": "0", "positions": "arm.txt"}), tmp_path)
    assert layout.position_m == pytest.approx(rows[:, :3])
    assert layout.normal == pytest.approx(np.tile([0, 0.6, 0.8], (12, 1)))


@example(turn=0.0, normal=(5e-324, 5e-324, -1.0), mirror=False)
@given(turn=angles_deg, normal=directions, mirror=st.booleans())
def test_the_outline_is_fitted_to_positions_from_a_file(
    turn: float, normal: tuple[float, float, float], mirror: bool
) -> None:
    kind = builtin_kinds()["triangle_10pad"]
    place = PlaceSettings(x_mm=40, y_mm=-20, z_mm=7, turn_deg=turn, normal=normal, mirror=mirror)
    position_mm, normals = lay(np.array(kind.pads_mm), place)
    outline_mm, _ = lay(np.array(kind.outline_mm), place)
    fitted_m = fitted_outline(kind, position_mm * 1e-3, normals)
    assert fitted_m * 1e3 == pytest.approx(outline_mm, abs=1e-6)


def test_an_outline_can_be_drawn_where_all_taxels_lie_at_one_place() -> None:
    kind = builtin_kinds()["triangle"]
    outline = fitted_outline(kind, np.zeros((12, 3)), np.tile([0.0, 0, 1], (12, 1)))
    assert np.isfinite(outline).all()
    assert np.linalg.norm(outline[0] - outline[1]) == pytest.approx(0.03)


@pytest.mark.timeout(60)
def test_a_pipe_that_nobody_writes_positions_to_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "arm.txt")
    with pytest.raises(ConfigurationError, match="a pipe that nobody writes to"):
        build_layout(skin({"triangles": "0", "positions": "arm.txt"}), tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "cannot be read"),
        ("", "0 rows of"),
        ("1 2 3 4 5 6\n" * 11, "11 rows of 6 numbers; wanted 12 rows x y z nx ny nz"),
        ("1 2 3\n" * 12, "12 rows of 3 numbers"),
        ("1 2 3 4 5 6\n" * 11 + "1 2 x 4 5 6\n", "could not convert string 'x'"),
        (
            "name arm\n[calibration]\n",
            "wanted 12 rows x y z nx ny nz alone: `skin import",
        ),
        ("1 2 3 4 5 6\n" * 11 + "1 2 nan 4 5 6\n", "a number that is not finite"),
    ],
)
def test_a_bad_positions_file_is_named(tmp_path: Path, text: str | None, said: str) -> None:
    if text is not None:
        (tmp_path / "arm.txt").write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        build_layout(skin({"triangles": "0", "positions": "arm.txt"}), tmp_path)
    assert str(caught.value).startswith("parts.arm.patches[0].positions: ")
    assert "arm.txt" in str(caught.value)
    assert said in str(caught.value)


KIND = {
    "about": "a test",
    "pads_mm": [[5.0 * i, 0.0] for i in range(12)],
    "pitch_mm": 5,
    "radius_mm": 2,
    "outline_mm": [[0, 0], [60, 0], [0, 5]],
}


def outline_mm2(kind: KindSettings) -> float:
    x, y = np.array(kind.outline_mm).T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


@pytest.mark.parametrize("name", builtin_kinds())
def test_the_pads_of_a_unit_stand_for_all_of_its_outline(name: str) -> None:
    """Pressure between the pads counts, and none counts twice."""
    kind = builtin_kinds()[name]
    triangles = len(kind.pads_mm) // 12
    layout = build_layout(skin({"triangles": f"0-{triangles - 1}", "kind": name}), HERE)
    assert layout.area_mm2.sum() == pytest.approx(outline_mm2(kind))
    thermal = layout.pad_kind == PadKind.THERMAL
    assert (layout.area_mm2[thermal] == 0.0).all()
    assert (layout.area_mm2[~thermal] > 5.0).all()


def test_an_equal_pad_of_the_triangle_of_twelve_stands_for_a_twelfth_of_it() -> None:
    layout = build_layout(skin({"triangles": "0"}), HERE)
    assert layout.area_mm2 == pytest.approx(np.full(12, np.sqrt(3) / 4 * 30**2 / 12), rel=1e-3)


def test_the_skin_of_a_pad_is_that_of_its_kind_wherever_its_places_are_read_from(
    tmp_path: Path,
) -> None:
    write_rows(tmp_path / "arm.txt", np.random.default_rng(5).uniform(0.1, 0.2, (12, 6)))
    laid, read = (
        build_layout(skin({"triangles": "0", "kind": "triangle_10pad", **more}), tmp_path)
        for more in ({}, {"positions": "arm.txt"})
    )
    assert np.array_equal(laid.area_mm2, read.area_mm2)


@given(
    st.lists(st.tuples(st.integers(-40, 40), st.integers(-30, 30)), min_size=12, max_size=12),
    st.sets(st.integers(0, 11), max_size=11),
    st.booleans(),
)
def test_a_pad_stands_for_the_skin_that_is_nearest_to_it(
    places: list[tuple[int, int]], thermal: set[int], clockwise: bool
) -> None:
    """Also where the outline has a notch; pads at one place have equal shares."""
    outline = [(-50, -40), (50, -40), (50, 40), (0, 5), (-50, 40)]
    kind = msgspec.convert(
        KIND
        | {
            "pads_mm": places,
            "thermal": sorted(thermal),
            "outline_mm": outline[::-1] if clockwise else outline,
        },
        KindSettings,
    )
    found = shares_mm2(kind)
    step = 1.0
    x, y = np.meshgrid(np.arange(-49.5, 50, step), np.arange(-39.5, 40, step))
    within = y < 5 + 35 / 50 * np.abs(x)
    points = np.column_stack([x[within], y[within]])
    pressing = np.array([number for number in range(12) if number not in thermal])
    apart = np.linalg.norm(points[:, None] - np.array(places)[pressing], axis=2)
    nearest = apart <= apart.min(axis=1, keepdims=True) + 1e-9
    share = nearest / nearest.sum(axis=1, keepdims=True)
    wanted = np.zeros(12)
    wanted[pressing] = share.sum(axis=0) * step**2
    # The grid's squares are cut where the cells' borders run, some 200 mm of them.
    assert found == pytest.approx(wanted, abs=60.0)
    assert found.sum() == pytest.approx(outline_mm2(kind))


def test_a_kind_of_the_users_own_is_laid_out() -> None:
    layout = build_layout(
        skin({"triangles": "0", "kind": "row", "places": [{}]}, kinds={"row": KIND}), HERE
    )
    assert layout.position_m[:, 0] == pytest.approx(np.arange(12) * 5e-3)
    assert neighbours(layout, 5) == {4, 6}


WANTED_OUTLINE = "wanted 0.001 at least: corners around all pads, one after the other"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"pads_mm": [[0, 0]] * 11}, "kinds.row.pads_mm: 11 pads; wanted a multiple of 12"),
        ({"pads_mm": []}, "kinds.row.pads_mm: 0 pads; wanted a multiple of 12"),
        ({"outline_mm": [[0, 0], [1, 1]]}, "kinds.row.outline_mm: 2 corners; wanted 3 or more"),
        ({"thermal": [12]}, "kinds.row.thermal: [12]; pads are 0 to 11"),
        (
            {"outline_mm": [[0, -3], [40, -3], [40, 3], [0, 3]]},
            f"kinds.row.outline_mm: 0 mm2 of it are nearest to pad 9; {WANTED_OUTLINE}",
        ),
        (
            {"outline_mm": [[0, 0], [60, 0], [30, 0]]},
            f"kinds.row.outline_mm: 0 mm2 of it are nearest to pad 0; {WANTED_OUTLINE}",
        ),
    ],
)
def test_a_bad_kind_is_named(change: dict[str, object], said: str) -> None:
    settings = skin({"triangles": "0", "kind": "row"}, kinds={"row": KIND | change})
    with pytest.raises(ConfigurationError) as caught:
        build_layout(settings, HERE)
    assert str(caught.value) == said


@pytest.mark.parametrize(
    ("patch", "said"),
    [
        ({"kind": "plam"}, '.kind: no kind "plam"; there are: triangle'),
        ({"kind": "palml"}, '.triangles: 1 triangles; "palml" takes them by 4'),
        ({"places": [{}, {}]}, ".places: 2 places for 1 units"),
        ({"places": [{"normal": [0, 0, 0]}]}, ".places[0]: normal: [0.0, 0.0, 0.0]"),
        ({"kind": "row"}, ": one unit of its taxels' byte is 9.53e+06 fF of a pad"),
    ],
)
def test_a_patch_that_cannot_be_laid_out_is_named(patch: dict[str, object], said: str) -> None:
    tiny = KIND | {"radius_mm": 0.001}
    with pytest.raises(ConfigurationError) as caught:
        build_layout(skin({"triangles": "0", **patch}, kinds={"row": tiny}), HERE)
    assert str(caught.value).startswith(f"parts.arm.patches[0]{said}")


@pytest.mark.parametrize(
    ("pressure", "wanted"),
    [
        ({"a_kpa_per_ff2": -9.0}, "1.23e-06 to 0.0905 fF"),
        ({"a_kpa_per_ff2": 1.0}, "1.23e-06 to 0.0407 fF"),
        ({"a_kpa_per_ff2": 0.0, "code_ff": 1e6}, "1.23e-06 to 1.23e+06 fF"),
    ],
)
def test_a_curve_that_does_not_rise_with_each_unit_is_refused(
    pressure: dict[str, float], wanted: str
) -> None:
    settings = skin({"triangles": "0"}, processing={"pressure": pressure})
    with pytest.raises(ConfigurationError, match=re.escape(f"wanted {wanted}, where equation")):
        build_layout(settings, HERE)


def test_a_curve_that_bends_more_than_it_rises_is_refused() -> None:
    settings = skin({"triangles": "0"}, processing={"pressure": {"b_kpa_per_ff": 1e-6}})
    with pytest.raises(ConfigurationError, match=r"^processing\.pressure: a_kpa_per_ff2 -0\.0011"):
        build_layout(settings, HERE)


@pytest.mark.parametrize("shift", range(9))
@pytest.mark.parametrize("kind", ["triangle", "fingertip", "fingertip_mid"])
@pytest.mark.parametrize("foam_mm", [0.5, 3.0, 5.0])
def test_each_shift_of_a_board_is_permitted_on_usual_foam(
    kind: str, shift: int, foam_mm: float
) -> None:
    settings = skin({"triangles": "0", "kind": kind, "shift": shift})
    layout = build_layout(changed(settings, {"parts.arm.foam_mm": foam_mm}), HERE)
    assert layout.n_taxels == 12


@pytest.mark.parametrize("length", [1e-320, 1e-200, 1.0, 1e9])
def test_only_the_direction_of_a_normal_counts(tmp_path: Path, length: float) -> None:
    place = {"normal": [0.0, length, 0.0]}
    layout = build_layout(skin({"triangles": "0", "places": [place]}), HERE)
    assert layout.normal == pytest.approx(np.tile([0.0, 1.0, 0.0], (12, 1)))
    rows = np.tile([0.0, 0.0, 0.0, min(length, 1e6), 0.0, 0.0], (12, 1))
    write_rows(tmp_path / "arm.txt", rows)
    layout = build_layout(skin({"triangles": "0", "positions": "arm.txt"}), tmp_path)
    assert layout.normal == pytest.approx(np.tile([1.0, 0.0, 0.0], (12, 1)))


def test_a_part_without_a_pressure_pad_is_refused_and_a_triangle_without_one_is_not() -> None:
    """It would have no contact state, and nothing would be felt there."""
    thermal = {"thermal": KIND | {"thermal": list(range(12))}}
    patch: dict[str, object] = {"triangles": "1", "kind": "thermal"}
    with pytest.raises(ConfigurationError) as caught:
        build_layout(skin(patch, kinds=thermal), HERE)
    assert str(caught.value) == (
        "parts.arm: all of its pads are thermal; wanted one at least that measures pressure"
    )
    layout = build_layout(skin({"triangles": "0"}, patch, kinds=thermal), HERE)
    assert np.count_nonzero(layout.pad_kind == PadKind.THERMAL) == 12


def body(boards: int, places: list[dict[str, float]]) -> Settings:
    """A robot of one part, each of its boards with a triangle at each of these places, or 16 of
    them side by side.
    """
    names = [f"b{number}" for number in range(boards)]
    patch = {"triangles": f"0-{len(places or range(16)) - 1}", "places": places}
    return msgspec.convert(
        {
            "robot": "test",
            "buses": {f"can{bus}": {} for bus in range(-(-boards // 14))},
            "boards": {
                name: {"bus": f"can{number // 14}", "address": number % 14 + 1}
                for number, name in enumerate(names)
            },
            "parts": {"arm": {"patches": [{"board": name, **patch} for name in names]}},
        },
        Settings,
    )


def test_thousands_of_taxels_at_one_place_are_refused_before_they_fill_the_memory() -> None:
    """As from a file of positions in another unit: their pairs grow with the square."""
    tracemalloc.start()
    try:
        with pytest.raises(
            ConfigurationError, match=r"parts\.arm: more than .* of its 10752 taxels .* in mm"
        ):
            build_layout(body(56, [{}] * 16), HERE)
        assert tracemalloc.get_traced_memory()[1] < 200e6
    finally:
        tracemalloc.stop()


def in_mm(tmp_path: Path) -> Settings:
    """A part whose file of positions is in mm."""
    rows = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (12, 1))
    rows[:, :2] = builtin_kinds()["triangle"].pads_mm
    np.savetxt(tmp_path / "arm.txt", rows)
    return skin({"triangles": "0", "positions": "arm.txt"})


def test_a_file_of_positions_in_mm_is_refused_as_such(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as refused:
        build_layout(in_mm(tmp_path), tmp_path)
    assert str(refused.value) == (
        "parts.arm.patches[0].positions: pads lie 5e+03 mm apart, those of triangle 5 mm; wanted "
        "metres: these look like mm"
    )


@pytest.mark.parametrize(
    ("settings", "seen", "cause"),
    [
        (body(1, [{}, {"x_mm": 12e3}]), "12.03 m wide", "places in mm, files of positions in m"),
        (body(1, [{"y_mm": -1e6}]), "1000.0087 m from its origin", "places in mm, files of posi"),
        (body(200, []), "10.392 m wide", "200 of its patches are tiled above each other; place th"),
    ],
    ids=["wide", "far", "tiled"],
)
def test_a_part_that_no_robot_has_is_refused(settings: Settings, seen: str, cause: str) -> None:
    """Clients refuse its description, too: beside it other parts would be too small to be seen."""
    with pytest.raises(ConfigurationError) as refused:
        build_layout(settings, HERE)
    said, _, wanted = str(refused.value).partition("; wanted at most ")
    assert said == f"parts.arm: {seen}"
    assert wanted.partition(" m: ")[2].startswith(cause)


@given(st.floats(9_969.999, 9_970.001), st.floats(-0.001, 0.001))
def test_what_is_published_of_a_part_that_may_be_is_taken(apart_mm: float, x_mm: float) -> None:
    """At the limit, and rounded as it is published."""
    settings = body(1, [{"x_mm": x_mm}, {"x_mm": x_mm + apart_mm}])
    try:
        layout = build_layout(settings, HERE)
    except ConfigurationError:
        return
    info = node_info(layout, "main", version="1", configuration="x")
    Nodes(Presence(stale_s=3.0)).take_info("main", 1, encode_info(info), None, 0.0)


def test_a_few_taxels_at_one_place_are_neighbours() -> None:
    layout = build_layout(body(1, [{}] * 4), HERE)
    assert {0, 12, 24, 36} - {0} <= neighbours(layout, 0)


def test_neighbours_do_not_depend_on_how_many_pairs_are_looked_at_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = skin({"triangles": "0-15"})
    whole = build_layout(settings, HERE)
    for at_once in (1, 7, 100):
        monkeypatch.setattr("skin_host.layout.PAIRS_AT_ONCE", at_once)
        some = build_layout(settings, HERE)
        assert (some.neighbour_start == whole.neighbour_start).all()
        assert (some.neighbour == whole.neighbour).all()
