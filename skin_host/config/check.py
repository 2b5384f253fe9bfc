"""Describes a configuration in numbers: `skin check`.

`--json` prints the records; `table` formats them for people. Permitted values that are probably
mistakes are listed as warnings, with their path in the file.
"""

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.compensation import THERMAL_TAXEL, thermal_gains
from skin_host.config.settings import Settings, format_triangles, parse_triangles, skin_hash
from skin_host.errors import nearest, visible
from skin_host.layout import (
    TAXELS_PER_TRIANGLE,
    BoardLayout,
    Layout,
    PadKind,
    TriangleLayout,
    builtin_kinds,
)

#: Bits of a standard frame of eight bytes with its interframe space: without stuff bits, and with
#: the most possible.
FRAME_BITS = (111, 135)
FRAMES_PER_TRIANGLE = 2
#: The same for the two frames of six bytes that make one sample of force and torque.
WRENCH_BITS = (2 * 95, 2 * 115)
#: A bus with a higher load has no room for commands and retransmissions.
WARN_LOAD = 0.8
#: Twelve stages at decimation 256 take the chip this long (AD7147; MTB3's timer constants).
CONVERSION_MS = 36.86
#: Pads of a unit whose distance is more times the pitch of their kind, or less than this share of
#: it, are in another unit of length.
UNLIKE_PITCHES = 3.0
#: What positions seem to be, by the factor that they are too large.
_LENGTHS = {1000.0: "mm", 100.0: "cm", 0.001: "metres divided by 1000"}
#: Pads at this multiple of the least distance face the same way, even on a fingertip.
NEXT_PITCHES = 1.2
#: Taxels of a part that are closer than this are at the same place.
SAME_PLACE_M = 1e-4
#: Boards of a part whose periods differ by this factor are better in two parts.
UNLIKE_PERIODS = 2
#: Foam outside this range usually means a wrong unit.
USUAL_FOAM_MM = (0.3, 30.0)
#: Settings that are shown as they are.
_OF_BOARDS = ("bus", "address", "model", "skin_type", "period_ms")
_OF_FINGERTIPS = ("node", "bus", "address", "period_ms", "shape", "array")


Floats = NDArray[np.float64]
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
            *_bus_warnings(buses, {tip.bus for tip in settings.fingertips.values()}),
            *_interface_warnings(buses),
            *_board_warnings(layout),
            *_part_warnings(layout),
            *_position_warnings(settings, layout),
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


def _bus_warnings(buses: list[Record], used: set[str]) -> list[str]:
    return (
        [
            f"buses.{bus['name']}: skin frames take {_load(bus['load'])} of the bus; "
            f"wanted at most {WARN_LOAD:.0%}: raise period_ms of its boards, or move boards to "
            "another bus"
            for bus in buses
            if bus["load"][1] > WARN_LOAD
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
            if (bus["interface"], bus["channel"]) == (later["interface"], later["channel"])
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
    return warnings


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
        cells = np.round(layout.position_m[taxels][pressure] / SAME_PLACE_M).astype(np.int64)
        shared = len(cells) - len(set(map(tuple, cells.tolist())))
        if shared:
            warnings.append(
                f"parts.{part.name}: {shared} taxel(s) lie where another one lies; "
                "contacts there cannot be distinguished"
            )
    return warnings


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
            n_pads = len(kinds[patch.kind].pads_mm)
            units = [_unit(layout, first, n_pads) for first in range(start, taxel, n_pads)]
            units = [(apart, normal) for apart, normal in units if len(apart) > 1]
            if not units:
                continue
            apart_mm = float(np.median(np.concatenate([apart.min(axis=1) for apart, _ in units])))
            pitch_mm = kinds[patch.kind].pitch_mm
            if not 1.0 / UNLIKE_PITCHES <= apart_mm / pitch_mm <= UNLIKE_PITCHES:
                warnings.append(
                    f"{where}: pads lie {apart_mm:.3g} mm apart, those of {patch.kind} "
                    f"{pitch_mm:g} mm; wanted metres{_looks_like(apart_mm / pitch_mm)}"
                )
            facing = sum(map(_n_facing_away, units))
            if facing:
                warnings.append(
                    f"{where}: {facing} pad(s) face the other way than a pad next to them, and "
                    "make no contact with it; wanted normals that point out of the skin"
                )
    return warnings


def _unit(layout: Layout, first: int, n_pads: int) -> tuple[Floats, Floats]:
    """Return of the k pressure pads of a unit the distances, mm [k, k], and normals [k, 3].

    A pad is infinitely far from itself.
    """
    pads = first + np.flatnonzero(layout.pad_kind[first : first + n_pads] == PadKind.PRESSURE)
    position_mm = 1e3 * layout.position_m[pads]
    apart_mm = np.linalg.norm(position_mm[:, None] - position_mm[None], axis=2)
    np.fill_diagonal(apart_mm, np.inf)
    return apart_mm, layout.normal[pads]


def _n_facing_away(unit: tuple[Floats, Floats]) -> int:
    """Count the pads of a unit that have one next to them whose normal is opposed."""
    apart_mm, normal = unit
    near = apart_mm <= NEXT_PITCHES * apart_mm.min(axis=1, keepdims=True)
    return int((near & (normal @ normal.T < 0.0)).any(axis=1).sum())


def _looks_like(ratio: float) -> str:
    """Return what positions seem to be in whose pads are so many times too far apart."""
    for factor, name in _LENGTHS.items():
        if 0.5 < ratio / factor < 2.0:
            return f": these look like {name}"
    return ""


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
