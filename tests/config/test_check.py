"""What `skin check` counts and warns of."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from skin_host.config import check
from skin_host.config.settings import Settings
from skin_host.layout import build_layout, builtin_kinds


def described(
    boards: dict[str, dict[str, object]],
    parts: dict[str, object],
    buses: dict[str, object] | None = None,
    folder: Path = Path(),
) -> check.Record:
    settings = msgspec.convert(
        {"robot": "test", "buses": buses or {"can0": {}}, "boards": boards, "parts": parts},
        Settings,
    )
    return check.describe(settings, build_layout(settings, folder))


def full_boards(n: int, **more: object) -> check.Record:
    """`n` boards of 16 triangles on one bus."""
    names = [f"mtb{i}" for i in range(1, n + 1)]
    return described(
        {
            name: {"bus": "can0", "address": i, "skin_type": 2, **more}
            for i, name in enumerate(names, 1)
        },
        {name: {"patches": [{"board": name, "triangles": "0-15"}]} for name in names},
    )


def test_seven_full_boards_at_50_ms_load_a_bus_by_half() -> None:
    """The wire's reference reckons 50 .. 60 %."""
    bus = full_boards(7)["buses"][0]
    assert bus["frames_per_s"] == 7 * 32 * 20
    assert bus["load"] == pytest.approx((0.497, 0.605), abs=1e-3)


def test_a_bus_loaded_beyond_80_percent_is_warned_of() -> None:
    assert full_boards(9)["warnings"] == []
    (warning,) = full_boards(10)["warnings"]
    assert warning.startswith("buses.can0: skin frames take 71 .. 86 % of the bus")


def test_a_slower_bus_is_loaded_more() -> None:
    fast = full_boards(1)["buses"][0]["load"]
    slow = described(
        {"mtb": {"bus": "can0", "address": 1, "skin_type": 2}},
        {"arm": {"patches": [{"board": "mtb", "triangles": "0-15"}]}},
        {"can0": {"bitrate": 500_000}},
    )["buses"][0]["load"]
    assert list(slow) == pytest.approx([2 * load for load in fast], abs=2e-3)


@pytest.mark.parametrize(
    ("bus", "warns"),
    [
        ({}, False),
        ({"bitrate": 500_000}, True),
        ({"interface": "slcan", "bitrate": 250_000}, True),
        ({"interface": "udp_multicast", "channel": "239.74.163.2", "bitrate": 500_000}, False),
    ],
)
def test_a_bit_rate_that_no_board_has_is_warned_of(bus: dict[str, object], warns: bool) -> None:
    """An adapter that sets it would disturb its bus, and receive nothing."""
    warnings = described(
        {"mtb": {"bus": "can0", "address": 1, "skin_type": 2}},
        {"arm": {"patches": [{"board": "mtb", "triangles": "0-3"}]}},
        {"can0": bus},
    )["warnings"]
    seen = [one for one in warnings if one.startswith("buses.can0.bitrate: ")]
    assert len(seen) == len(warnings) == int(warns)


def test_a_period_shorter_than_the_chips_conversion_is_warned_of() -> None:
    (warning,) = full_boards(1, period_ms=20)["warnings"]
    assert warning.startswith("boards.mtb1.period_ms: 20; the chips need 36.86 ms")


@pytest.mark.parametrize(("fast_ms", "slow_ms", "warns"), [(50, 99, False), (50, 100, True)])
@pytest.mark.parametrize("slow_first", [False, True])
def test_a_part_of_a_fast_board_and_a_slow_one_is_warned_of(
    fast_ms: int, slow_ms: int, warns: bool, slow_first: bool
) -> None:
    periods = (slow_ms, fast_ms) if slow_first else (fast_ms, slow_ms)
    names = {fast_ms: "quick", slow_ms: "slow"}
    boards: dict[str, dict[str, object]] = {
        names[period]: {"bus": "can0", "address": i, "skin_type": 2, "period_ms": period}
        for i, period in enumerate(periods, 1)
    }
    patches = [{"board": name, "triangles": "0-3"} for name in boards]
    warnings = described(boards, {"arm": {"patches": patches}})["warnings"]
    (*_, last) = ["", *(one for one in warnings if "period_ms" in one)]
    assert bool(last) is warns
    if warns:
        assert last.startswith("parts.arm: board quick sends every 50 ms and slow every 100 ms; ")
        assert last.endswith("wanted like period_ms, or two parts")


def test_a_thermometer_that_feels_pressure_is_warned_of() -> None:
    (warning,) = full_boards(1, skin_type=8)["warnings"]
    assert warning.startswith("boards.mtb1.skin_type: 8 takes pad 6 as a thermometer")
    assert "triangles 0-15 feels pressure" in warning


@pytest.mark.parametrize("skin_type", [3, 8])
def test_a_skin_type_that_an_mtb3_does_not_know_is_warned_of(skin_type: int) -> None:
    (warning,) = full_boards(1, model="mtb3", skin_type=skin_type)["warnings"]
    assert warning == (
        f"boards.mtb1.skin_type: {skin_type} is unknown to an MTB3, which then compensates no "
        "temperature; wanted 0, 1 or 2"
    )


def test_an_ergo_hand_of_two_shifts_is_warned_of() -> None:
    patches = [
        {"board": "hand", "triangles": "0-4", "kind": "fingertip", "shift": 0},
        {"board": "hand", "triangles": "5", "kind": "triangle_10pad", "shift": 2},
    ]
    boards = {"hand": {"bus": "can0", "address": 2, "skin_type": 3}}
    (warning,) = described(boards, {"hand": {"patches": patches}})["warnings"]
    assert warning.startswith("boards.hand: its triangles have the shifts 0, 2; the firmware of an")


def test_an_unused_bus_and_a_board_of_two_daemons_are_warned_of() -> None:
    description = described(
        {"mtb": {"bus": "can0", "address": 1, "skin_type": 2}},
        {
            "arm": {"patches": [{"board": "mtb", "triangles": "0"}]},
            "hand": {"node": "second", "patches": [{"board": "mtb", "triangles": "1"}]},
        },
        {"can0": {}, "can1": {"channel": "can1"}},
    )
    assert [warning.split(";")[0] for warning in description["warnings"]] == [
        "buses.can1: no board is on this bus",
        "boards.mtb: feeds parts of the nodes main, second",
    ]


def test_taxels_at_one_place_and_taxels_alone_are_warned_of(tmp_path: Path) -> None:
    rows = np.zeros((12, 6))
    rows[2:, 0] = 1e-2 * np.arange(1, 11)
    np.savetxt(tmp_path / "arm.txt", rows)
    description = described(
        {"mtb": {"bus": "can0", "address": 1, "skin_type": 2}},
        {"arm": {"patches": [{"board": "mtb", "triangles": "0", "positions": "arm.txt"}]}},
        folder=tmp_path,
    )
    assert [warning.split(";")[0] for warning in description["warnings"]] == [
        "parts.arm: 10 taxel(s) have no neighbour",
        "parts.arm: 2 taxel(s) lie nearer to another one than the radius of their pads",
    ]


def test_places_in_metres_are_warned_of() -> None:
    """0.03 m are 30 mm; as 0.03 mm the second triangle lies on the first."""
    patch = {"board": "mtb", "triangles": "0-1", "places": [{"x_mm": 0.0}, {"x_mm": 0.03}]}
    for kind, taxels in (("triangle", 24), ("triangle_10pad", 20)):
        (warning,) = described(
            {"mtb": {"bus": "can0", "address": 1, "skin_type": 2}},
            {"arm": {"patches": [patch | {"kind": kind}]}},
        )["warnings"]
        assert warning.startswith(f"parts.arm: {taxels} taxel(s) lie nearer to another one than ")
        assert warning.endswith(": wanted places in mm, files of positions in m")


def positions_warnings(
    tmp_path: Path, scale: float = 1.0, normals: np.ndarray | None = None, kind: str = "triangle"
) -> list[str]:
    """What is warned of two triangles whose file has these lengths and normals."""
    pads_mm = np.array(builtin_kinds()[kind].pads_mm)
    rows = np.zeros((24, 6))
    rows[:, :2] = scale * 1e-3 * np.concatenate([pads_mm, np.add(pads_mm, [40.0, 0.0])])
    rows[:, 3:] = [0.0, 0.0, 1.0] if normals is None else normals
    np.savetxt(tmp_path / "arm.txt", rows)
    patch = {"board": "mtb", "triangles": "0-1", "positions": "arm.txt", "kind": kind}
    boards: dict[str, dict[str, object]] = {"mtb": {"bus": "can0", "address": 1, "skin_type": 2}}
    warnings = described(boards, {"arm": {"patches": [patch]}}, folder=tmp_path)["warnings"]
    return [one for one in warnings if ".positions: " in one]


@pytest.mark.parametrize(
    ("scale", "meant"),
    [
        (100.0, "wanted metres: these look like cm"),
        (0.001, "wanted metres: these look like metres divided by 1000"),
        (20.0, "wanted metres"),
        (0.0, "wanted metres"),
    ],
)
def test_a_file_of_positions_that_are_not_in_metres_is_warned_of(
    tmp_path: Path, scale: float, meant: str
) -> None:
    (warning,) = positions_warnings(tmp_path, scale)
    assert warning.startswith("parts.arm.patches[0].positions: pads lie ")
    assert warning.endswith(f" mm apart, those of triangle 5 mm; {meant}")


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("kind", ["triangle", "triangle_10pad", "fingertip"])
def test_a_file_of_positions_in_metres_is_not_warned_of(
    tmp_path: Path, scale: float, kind: str
) -> None:
    assert positions_warnings(tmp_path, scale, kind=kind) == []


def test_pads_that_face_the_other_way_than_their_neighbours_are_warned_of(tmp_path: Path) -> None:
    normals = np.tile([0.0, 0.0, 1.0], (24, 1))
    normals[::2, 2] = -1.0
    (warning,) = positions_warnings(tmp_path, normals=normals)
    assert warning == (
        "parts.arm.patches[0].positions: 24 pad(s) face the other way than a pad next to them, and "
        "make no contact with it; wanted normals that point out of the skin"
    )
    # A unit may lie on the other side of a part, and be bent.
    normals[:] = [0.0, 0.0, 1.0]
    normals[12:] = [0.0, 0.0, -1.0]
    assert positions_warnings(tmp_path, normals=normals) == []
    normals[:, 0] = np.linspace(-2.0, 2.0, 24)
    assert positions_warnings(tmp_path, normals=normals) == []


def test_the_table_holds_totals_and_warnings() -> None:
    text = check.table(full_boards(10))
    total = next(line for line in text.splitlines() if line.startswith("total"))
    assert total.split()[:5] == ["total", "10", "160", "1920", "0"]
    assert "warning: buses.can0" in text
    assert all(line == line.rstrip() for line in text.splitlines())


def test_a_fingertip_is_listed_and_its_samples_load_the_bus() -> None:
    settings = msgspec.convert(
        {
            "robot": "test",
            "buses": {"can0": {}, "can1": {"channel": "can1"}},
            "boards": {"hand": {"bus": "can0", "address": 1, "skin_type": 2}},
            "parts": {"palm": {"patches": [{"board": "hand", "triangles": "0-3"}]}},
            "fingertips": {
                "index": {"bus": "can1", "address": 3, "shape": "sphere", "radius_mm": 9}
            },
        },
        Settings,
    )
    description = check.describe(settings, build_layout(settings, Path()))
    assert description["buses"][1]["frames_per_s"] == 400
    assert description["buses"][1]["load"] == pytest.approx((0.038, 0.046))
    assert description["warnings"] == []
    assert "index      main  can1        3    5 ms  sphere  -" in check.table(description)


def test_two_buses_on_one_channel_are_a_warning():
    buses = {"a": {"channel": "can0"}, "b": {"channel": "can0"}}
    boards = {
        name: {"bus": name, "address": 1 + number, "skin_type": 2}
        for number, name in enumerate(buses)
    }
    parts = {name: {"patches": [{"board": name, "triangles": "0"}]} for name in buses}
    (warning,) = described(boards, parts, buses)["warnings"]
    assert warning.startswith("buses.b.channel: can0 is that of buses.a too")


def test_buses_of_one_name_on_two_servers_are_none() -> None:
    buses: dict[str, object] = {
        name: {"interface": "socketcand", "options": {"host": host, "port": 29536}}
        for name, host in (("a", "10.0.0.1"), ("b", "10.0.0.2"))
    }
    boards: dict[str, dict[str, object]] = {
        name: {"bus": name, "address": 1, "skin_type": 2} for name in buses
    }
    parts = {name: {"patches": [{"board": name, "triangles": "0"}]} for name in buses}
    assert described(boards, dict(parts), buses)["warnings"] == []
    buses["b"] = buses["a"]
    (warning,) = described(boards, dict(parts), buses)["warnings"]
    assert warning.startswith("buses.b.channel: can0 is that of buses.a too")


@pytest.mark.parametrize(("seen", "meant"), [("socketcn", "meant socketcan?"), ("x", "it has ")])
def test_an_interface_that_nothing_here_knows_is_a_warning(seen, meant):
    boards = {"mtb": {"bus": "can0", "address": 1, "skin_type": 2}}
    parts = {"arm": {"patches": [{"board": "mtb", "triangles": "0-1"}]}}
    (warning,) = described(boards, parts, {"can0": {"interface": seen}})["warnings"]
    assert warning.startswith(
        f'buses.can0.interface: python-can here has no interface "{seen}"; {meant}'
    )


@pytest.mark.parametrize(
    ("channel", "wrong"),
    [
        ("239.74.163.2", False),
        ("ff15::7079:7468", False),
        ("10.0.0.1", True),
        ("239.74.163", True),
        ("can0", True),
    ],
)
def test_a_channel_that_is_no_multicast_group_is_a_warning(channel: str, wrong: bool) -> None:
    boards: dict[str, dict[str, object]] = {"mtb": {"bus": "can0", "address": 1, "skin_type": 2}}
    parts = {"arm": {"patches": [{"board": "mtb", "triangles": "0-1"}]}}
    bus = {"interface": "udp_multicast", "channel": channel}
    assert described(boards, parts, {"can0": bus})["warnings"] == wrong * [
        f'buses.can0.channel: "{channel}" is no multicast address; wanted one such as 239.74.163.2'
    ]


def test_foam_in_metres_is_a_warning():
    boards = {"mtb": {"bus": "can0", "address": 1, "skin_type": 2}}
    parts = {"arm": {"foam_mm": 0.002, "patches": [{"board": "mtb", "triangles": "0-1"}]}}
    (warning,) = described(boards, parts)["warnings"]
    assert warning.startswith("parts.arm.foam_mm: 0.002")
