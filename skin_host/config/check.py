"""Describes a configuration in numbers: `skin check`.

`--json` prints the records; `table` formats them for people. Permitted values that are probably
mistakes are listed as warnings, with their path in the file.
"""

import math
from collections.abc import Sequence
from ipaddress import ip_address
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.compensation import ERGO_HAND, THERMAL_TAXEL, thermal_gains
from skin_host.config.settings import (
    KindSettings,
    Settings,
    format_triangles,
    parse_triangles,
    skin_hash,
)
from skin_host.errors import nearest, visible
from skin_host.layout import (
    TAXELS_PER_TRIANGLE,
    BoardLayout,
    Layout,
    PadKind,
    PartLayout,
    TriangleLayout,
    builtin_kinds,
)
from skin_host.layout.geometry import Floats, by_unit, distances_mm, unlike_pitch

#: Bits of a standard frame of eight bytes with its interframe space: without stuff bits, and with
#: the most possible.
FRAME_BITS = (111, 135)
FRAMES_PER_TRIANGLE = 2
#: The same for the two frames of six bytes that make one sample of force and torque.
WRENCH_BITS = (2 * 95, 2 * 115)
#: The boards' firmware has no other bit rate.
BITRATE = 1_000_000
#: Interfaces that have none.
WITHOUT_BITRATE = ("virtual", "udp_multicast")
#: A bus with a higher load has no room for commands and retransmissions.
WARN_LOAD = 0.8
#: Twelve stages at decimation 256 take the chip this long (AD7147; MTB3's timer constants).
CONVERSION_MS = 36.86
#: Pads at this multiple of the least distance face the same way, even on a fingertip.
NEXT_PITCHES = 1.2
#: Boards of a part whose periods differ by this factor are better in two parts.
UNLIKE_PERIODS = 2
#: Foam outside this range usually means a wrong unit.
USUAL_FOAM_MM = (0.3, 30.0)
#: Settings that are shown as they are.
_OF_BOARDS = ("bus", "address", "model", "skin_type", "period_ms")
_OF_FINGERTIPS = ("node", "bus", "address", "period_ms", "shape", "array")

#: As `skin check --json` prints them.
Record = dict[str, Any]


def describe(settings: Settings, layout: Layout) -> Record:
    """Count what `settings` and their `layout` hold, and look for likely mistakes.

    `configuration` in the result is the hash that calibrations carry; `thermal` counts the taxels
    that measure temperature; `load` is the share of a bus that its boards take, least and most.
    """
    buses = [_bus(name, settings, layout) for name in settings.buses]
    parts = [_part(number, layout) for number in range(len(layout.parts))]
    return {
        "robot": settings.robot,
        "configuration": skin_hash(settings),
        "buses": buses,
        "boards": [_board(board, layout) for board in layout.boards],
        "parts": parts,
        "fingertips": [
            {"name": name} | {key: getattr(tip, key) for key in _OF_FINGERTIPS}
            for name, tip in settings.fingertips.items()
        ],
        "total": {
            "buses": len(buses),
            "boards": len(layout.boards),
            "parts": len(parts),
            "triangles": len(layout.triangles),
            "taxels": layout.n_taxels,
            "thermal": sum(part["thermal"] for part in parts),
            "area_cm2": round(sum(part["area_cm2"] for part in parts), 1),
        },
        "warnings": [
            *_bus_warnings(buses, settings),
            *_interface_warnings(buses),
            *_board_warnings(layout),
            *_position_warnings(settings, layout),
            *_part_warnings(layout),
        ],
    }


def _bus(name: str, settings: Settings, layout: Layout) -> Record:
    bus = settings.buses[name]
    boards = [board for board in layout.boards if board.settings.bus == name]
    frames_per_s = math.fsum(
        FRAMES_PER_TRIANGLE * len(board.triangles) * 1000 / board.settings.period_ms
        for board in boards
    )
    samples_per_s = math.fsum(
        1000 / tip.period_ms for tip in settings.fingertips.values() if tip.bus == name
    )
    least, most = (
        (bits * frames_per_s + wrench_bits * samples_per_s) / bus.bitrate
        for bits, wrench_bits in zip(FRAME_BITS, WRENCH_BITS, strict=True)
    )
    return {
        "name": name,
        "interface": bus.interface,
        "channel": bus.channel,
        "boards": len(boards),
        "triangles": sum(len(board.triangles) for board in boards),
        "frames_per_s": round(frames_per_s + 2 * samples_per_s, 1),
        "load": (round(least, 3), round(most, 3)),
    }


def _board(board: BoardLayout, layout: Layout) -> Record:
    return {
        "name": board.name,
        **{key: getattr(board.settings, key) for key in _OF_BOARDS},
        "triangles": format_triangles(list(board.triangles)),
        "taxels": TAXELS_PER_TRIANGLE * len(board.triangles),
        "parts": [layout.parts[part].name for part in board.parts],
    }


def _part(number: int, layout: Layout) -> Record:
    part = layout.parts[number]
    taxels = slice(part.start, part.stop)
    thermal = layout.pad_kind[taxels] == PadKind.THERMAL
    return {
        "name": part.name,
        "node": part.node,
        "boards": len(part.boards),
        "triangles": part.n_taxels // TAXELS_PER_TRIANGLE,
        "taxels": part.n_taxels,
        "thermal": int(thermal.sum()),
        "area_cm2": round(float(layout.area_mm2[taxels][~thermal].sum()) / 100, 1),
    }


def _bus_warnings(buses: list[Record], settings: Settings) -> list[str]:
    used = {tip.bus for tip in settings.fingertips.values()}
    # Two servers of buses may each have a can0.
    where = {
        name: (bus.interface, bus.channel, bus.options) for name, bus in settings.buses.items()
    }
    return (
        [
            f"buses.{bus['name']}: skin frames take {_load(bus['load'])} of the bus; "
            f"wanted at most {WARN_LOAD:.0%}: raise period_ms of its boards, or move boards to "
            "another bus"
            for bus in buses
            if bus["load"][1] > WARN_LOAD
        ]
        + [
            f"buses.{name}.bitrate: {bus.bitrate}; MTB boards send and receive at {BITRATE} bit/s "
            "alone"
            for name, bus in settings.buses.items()
            if bus.bitrate != BITRATE and bus.interface not in WITHOUT_BITRATE
        ]
        + [
            f"buses.{bus['name']}: no board is on this bus; it will be opened for nothing"
            for bus in buses
            if not bus["boards"] and bus["name"] not in used
        ]
        + [
            f"buses.{later['name']}.channel: {later['channel']} is that of buses.{bus['name']} "
            "too; each receives the frames of both"
            for bus, later in combinations(buses, 2)
            if where[bus["name"]] == where[later["name"]]
        ]
    )


def _interface_warnings(buses: list[Record]) -> list[str]:
    unusual = [bus for bus in buses if bus["interface"] not in ("socketcan", "virtual")]
    if not unusual:
        return []
    import can

    warnings = []
    for bus in unusual:
        seen = bus["interface"]
        if seen not in can.VALID_INTERFACES:
            near = nearest(seen, can.VALID_INTERFACES)
            known = ", ".join(sorted(can.VALID_INTERFACES))
            meant = f"meant {near}?" if near else f"it has {known}"
            where = f"buses.{bus['name']}.interface"
            warnings.append(f'{where}: python-can here has no interface "{seen}"; {meant}')
        channel = bus["channel"]
        if seen == "udp_multicast" and not _is_multicast(channel):
            warnings.append(
                f'buses.{bus["name"]}.channel: "{channel}" is no multicast address; wanted one '
                "such as 239.74.163.2"
            )
    return warnings


def _is_multicast(channel: str) -> bool:
    try:
        return ip_address(channel).is_multicast
    except ValueError:
        return False


def _board_warnings(layout: Layout) -> list[str]:
    warnings = []
    triangles: list[list[TriangleLayout]] = [[] for _ in layout.boards]
    for triangle in layout.triangles:
        triangles[triangle.board].append(triangle)
    for board, mine in zip(layout.boards, triangles, strict=True):
        where = f"boards.{board.name}"
        if board.settings.period_ms < CONVERSION_MS:
            warnings.append(
                f"{where}.period_ms: {board.settings.period_ms}; the chips need "
                f"{CONVERSION_MS} ms for twelve pads, shorter periods repeat old values"
            )
        nodes = {layout.parts[part].node for part in board.parts}
        if len(nodes) > 1:
            warnings.append(
                f"{where}: feeds parts of the nodes {', '.join(sorted(nodes))}; one daemon "
                "should set a board up: give these parts one node"
            )
        skin_type = board.settings.effective_skin_type
        if skin_type != board.settings.skin_type:
            warnings.append(
                f"{where}.skin_type: {board.settings.skin_type} is unknown to an MTB3, which then "
                "compensates no temperature; wanted 0, 1 or 2"
            )
        shifts = [str(shift) for shift in sorted({triangle.shift for triangle in mine})]
        if skin_type == ERGO_HAND and len(shifts) > 1:
            warnings.append(
                f"{where}: its triangles have the shifts {', '.join(shifts)}; the firmware of an "
                "ergoCub hand mixes them up when it is set up again: wanted one"
            )
        wrong = []
        for triangle in mine:
            gains, thermometer = thermal_gains(skin_type, triangle.number)
            if any(gains) and layout.pad_kind[triangle.first + thermometer] != PadKind.THERMAL:
                wrong.append(triangle.number)
        if wrong:
            warnings.append(
                f"{where}.skin_type: {skin_type} takes pad {THERMAL_TAXEL} as a "
                f"thermometer, but that of triangles {format_triangles(wrong)} feels pressure; "
                "wanted 1 or 2"
            )
    return warnings


def _part_warnings(layout: Layout) -> list[str]:
    warnings = []
    n_neighbours = np.diff(layout.neighbour_start)
    for part in layout.parts:
        low, high = USUAL_FOAM_MM
        if not low <= part.foam_mm <= high:
            warnings.append(
                f"parts.{part.name}.foam_mm: {part.foam_mm:g}; foam is {low:g} to {high:g} mm "
                "thick as a rule, and pressures are scaled by it: is it in mm?"
            )
        periods_ms = {
            layout.boards[board].name: layout.boards[board].settings.period_ms
            for board in part.boards
        }
        fast, slow = (choose(periods_ms, key=periods_ms.__getitem__) for choose in (min, max))
        if periods_ms[slow] >= UNLIKE_PERIODS * periods_ms[fast]:
            warnings.append(
                f"parts.{part.name}: board {fast} sends every {periods_ms[fast]} ms and {slow} "
                f"every {periods_ms[slow]} ms; a part is sampled as seldom as its slowest board "
                "sends, and feels no shorter taps: wanted like period_ms, or two parts"
            )
        taxels = slice(part.start, part.stop)
        pressure = layout.pad_kind[taxels] == PadKind.PRESSURE
        alone = int((n_neighbours[taxels][pressure] == 0).sum())
        if alone:
            warnings.append(
                f"parts.{part.name}: {alone} taxel(s) have no neighbour; look at their places"
            )
        overlapping = int(_overlap(layout, part).sum())
        if overlapping:
            warnings.append(
                f"parts.{part.name}: {overlapping} taxel(s) lie nearer to another one than the "
                "radius of their pads; contacts there cannot be distinguished: wanted places in "
                "mm, files of positions in m"
            )
    return warnings


def _overlap(layout: Layout, part: PartLayout) -> NDArray[np.bool_]:
    """Which taxels of a part measure pressure and lie on another one that does."""
    first, last = layout.neighbour_start[[part.start, part.stop]]
    n_neighbours = np.diff(layout.neighbour_start[part.start : part.stop + 1])
    one = np.repeat(np.arange(part.start, part.stop), n_neighbours)
    other = layout.neighbour[first:last]
    apart_mm = 1e3 * np.linalg.norm(layout.position_m[one] - layout.position_m[other], axis=1)
    press = layout.pad_kind == PadKind.PRESSURE
    near = press[one] & press[other] & (apart_mm < layout.radius_mm[one])
    found = np.zeros(part.n_taxels, np.bool_)
    found[one[near] - part.start] = True
    return found


def _position_warnings(settings: Settings, layout: Layout) -> list[str]:
    """Look at files of positions: are they in m, and do normals point out of the skin?"""
    kinds = builtin_kinds() | settings.kinds
    warnings = []
    taxel = 0
    for name, part in settings.parts.items():
        for number, patch in enumerate(part.patches):
            start = taxel
            taxel += TAXELS_PER_TRIANGLE * len(parse_triangles(patch.triangles))
            if patch.positions is None:
                continue
            where = f"parts.{name}.patches[{number}].positions"
            taxels, kind = slice(start, taxel), kinds[patch.kind]
            why = unlike_pitch(patch.kind, kind, layout.position_m[taxels])
            if why:
                warnings.append(f"{where}: {why}")
            facing = _n_facing_away(kind, layout.position_m[taxels], layout.normal[taxels])
            if facing:
                warnings.append(
                    f"{where}: {facing} pad(s) face the other way than a pad next to them, and "
                    "make no contact with it; wanted normals that point out of the skin"
                )
    return warnings


def _n_facing_away(kind: KindSettings, position_m: Floats, normal: Floats) -> int:
    """Count the pads of units that have one next to them whose normal is opposed."""
    apart_mm, normals = distances_mm(kind, position_m), by_unit(kind, normal)
    near = apart_mm <= NEXT_PITCHES * apart_mm.min(axis=2, keepdims=True, initial=np.inf)
    return int((near & (normals @ normals.swapaxes(1, 2) < 0.0)).any(axis=2).sum())


#: Tables for people: what their rows are, and the keys of a record that are shown.
_TABLES = {
    "bus": "name interface channel boards triangles frames_per_s load",
    "board": "name bus address model skin_type period_ms triangles taxels parts",
    "part": "name node boards triangles taxels thermal area_cm2",
    "fingertip": "name node bus address period_ms shape array",
}
#: Heads that are not the key itself.
_HEADS = {
    "frames_per_s": "frames/s",
    "skin_type": "type",
    "period_ms": "period",
    "area_cm2": "area",
}


def table(description: Record) -> str:
    """The description as text for a terminal, without a newline at its end."""
    total = {"name": "total", "node": "", **description["total"]}
    records: dict[str, list[Record]] = {
        "bus": description["buses"],
        "board": description["boards"],
        "part": [*description["parts"], total],
        "fingertip": description["fingertips"],
    }
    sections = [f"robot {description['robot']}, configuration {description['configuration']}"]
    for kind, shown in _TABLES.items():
        if not records[kind]:
            continue
        keys, first = shown.split(), records[kind][0]
        heads = [kind if key == "name" else _HEADS.get(key, key) for key in keys]
        aligned = [
            f">{head}" if isinstance(first[key], int | float | tuple) else head
            for key, head in zip(keys, heads, strict=True)
        ]
        sections.append(
            columns(aligned, [[_cell(k, one[k]) for k in keys] for one in records[kind]])
        )
    if description["warnings"]:
        sections.append("\n".join(f"warning: {text}" for text in description["warnings"]))
    return "\n\n".join(sections)


def _cell(key: str, value: Any) -> str:
    match key:
        case "frames_per_s":
            return f"{value:.0f}"
        case "area_cm2":
            return f"{value:.0f} cm²"
        case "load":
            return _load(value)
        case "period_ms":
            return f"{value} ms"
        case "parts":
            return ", ".join(value)
        case _:
            return "-" if value is None else visible(str(value))


def _load(load: tuple[float, float]) -> str:
    least, most = load
    return f"{100 * least:.0f} .. {100 * most:.0f} %"


def columns(heads: list[str], rows: Sequence[Sequence[str | int]]) -> str:
    """Format columns as wide as their longest entry; a head that starts with > is right-aligned."""
    cells = [[head.removeprefix(">") for head in heads], *([str(x) for x in row] for row in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(heads))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if head.startswith(">") else cell.ljust(width)
            for cell, width, head in zip(row, widths, heads, strict=True)
        ).rstrip()
        for row in cells
    )
