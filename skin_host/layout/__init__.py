"""The skin as arrays: parts, boards, triangles, taxels, and their positions.

A part's taxels lie side by side in the flat arrays, in the order of its patches and
their triangles, twelve a triangle. All other packages index by this order.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from enum import IntEnum
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import (
    TRIANGLES_PER_BOARD,
    Board,
    KindSettings,
    Part,
    Patch,
    Pressure,
    Settings,
    load,
    parse_triangles,
)
from skin_host.config.sizes import DECIMALS_M, too_large
from skin_host.errors import ConfigurationError
from skin_host.layout.geometry import (
    NEIGHBOUR_PITCHES,
    Floats,
    fitted_outline,
    lay,
    read_positions,
    shares_mm2,
    tile,
    unlike_pitch,
)
from skin_host.processing.pressure import BENDS, SLOPES_KPA, PressureCurve

TAXELS_PER_TRIANGLE = 12
#: A pad that stands for less skin than this counts for no force.
SMALLEST_SHARE_MM2 = 0.001
#: A probe of more pitches covers so many pads wholly that the strongest reading does not show which
#: is nearest: the template is then farther off than the centroid (on pads of 5 mm: 0.05 mm with a
#: probe of 10 mm, 0.7 mm with 15 mm, 2.7 mm with 20 mm; the centroid is 0.1 to 0.2 mm off).
WIDEST_PITCHES = 3.0
#: No taxel has so many neighbours: those of the delivered configurations have up to 11. In a part
#: of any size, so many pairs may be beyond that.
MOST_NEIGHBOURS = 100
MOST_PAIRS = 1_000_000
#: So many pairs are looked at together, which bounds the memory.
PAIRS_AT_ONCE = 500_000


class PadKind(IntEnum):
    """Quantity that a pad measures."""

    PRESSURE = 0
    THERMAL = 1


class TriangleLayout(NamedTuple):
    """One triangle: `number` on its board (index into `Layout.boards`), first flat taxel."""

    part: int
    board: int
    number: int
    kind: str
    first: int
    shift: int
    cdc_offset: int
    outline_m: Floats


class BoardLayout(NamedTuple):
    """One board. `taxel_index` int32[16, 12] is the flat index of each value, -1 where unused."""

    name: str
    settings: Board
    triangles: tuple[int, ...]
    enabled: int
    taxel_index: NDArray[np.int32]
    parts: tuple[int, ...]


class PartLayout(NamedTuple):
    """One part: flat taxels `start:stop`, and its boards."""

    name: str
    node: str
    start: int
    stop: int
    boards: tuple[int, ...]
    covered: bool
    foam_mm: float

    @property
    def n_taxels(self) -> int:
        """How many taxels the part has, thermal pads included."""
        return self.stop - self.start


@dataclass(frozen=True, slots=True)
class Layout:
    """The whole skin. Arrays have one row a taxel; positions in m in the part's frame.

    Attributes:
        position_m, normal: float64[n, 3].
        area_mm2: float64[n], the skin that a pad stands for, see `geometry.shares_mm2`: force is
            the sum of pressure times this. 0 for thermal pads.
        radius_mm: float64[n], of the pad itself.
        pitch_mm: float64[n], distance of the pads of its kind, as `kinds.toml` has it.
        pad_kind: uint8[n], see `PadKind`.
        unit_ff: float64[n], capacitance of one unit of the transmitted byte.
        sensitivity: float64[n], capacitance of the pad over that of the pad that equation (1)
            was measured on, both unloaded: it grows with the area, falls with the foam.
        no_load: uint8[n], the byte sent when untouched.
        triangle_of: int32[n], index into `triangles`.
        neighbour_start, neighbour: int32[n + 1], int32[m]; the neighbours of taxel i are
            neighbour[neighbour_start[i]:neighbour_start[i + 1]], all in the same part.
    """

    robot: str
    parts: tuple[PartLayout, ...]
    boards: tuple[BoardLayout, ...]
    triangles: tuple[TriangleLayout, ...]
    position_m: Floats
    normal: Floats
    area_mm2: Floats
    radius_mm: Floats
    pitch_mm: Floats
    pad_kind: NDArray[np.uint8]
    unit_ff: Floats
    sensitivity: Floats
    no_load: NDArray[np.uint8]
    triangle_of: NDArray[np.int32]
    neighbour_start: NDArray[np.int32]
    neighbour: NDArray[np.int32]

    @property
    def n_taxels(self) -> int:
        """How many taxels the skin has, thermal pads included."""
        return len(self.triangle_of)

    def taxels_of(self, boards: Iterable[int]) -> NDArray[np.bool_]:
        """Which taxels bool[n] some boards read, given by their indices."""
        found = np.zeros(self.n_taxels, np.bool_)
        for board in boards:
            taxels = self.boards[board].taxel_index
            found[taxels[taxels >= 0]] = True
        return found

    def part(self, name: str) -> PartLayout:
        """The part called `name`.

        Raises:
            KeyError: there is none.
        """
        for part in self.parts:
            if part.name == name:
                return part
        raise KeyError(name)


@cache
def builtin_kinds() -> dict[str, KindSettings]:
    """The kinds of sensor unit that come with the project (`kinds.toml`)."""
    text = Path(__file__).with_name("kinds.toml").read_bytes()
    return msgspec.toml.decode(text, type=dict[str, KindSettings])


def load_skin(config: Path) -> tuple[Settings, Layout]:
    """Return settings and layout of a configuration file.

    Raises:
        ConfigurationError: see `settings.load` and `build_layout`.
    """
    settings = load(config)
    try:
        return settings, build_layout(settings, config.parent)
    except ConfigurationError as error:
        raise ConfigurationError(f"{config}: {error}") from None


def build_layout(settings: Settings, folder: Path) -> Layout:
    """Lay out the skin that `settings` describe.

    Relative file names in them start in `folder`, the configuration's own.

    Raises:
        ConfigurationError: an unknown kind, wrong numbers of places, a bad positions file,
            taxels that would feel nothing or lie on one another by the thousand, a part larger
            than any robot's, or probes too large for the pads.
    """
    kinds = builtin_kinds() | settings.kinds
    board_names = list(settings.boards)
    board_index = {
        name: np.full((TRIANGLES_PER_BOARD, TAXELS_PER_TRIANGLE), -1, np.int32)
        for name in board_names
    }
    board_parts: dict[str, list[int]] = {name: [] for name in board_names}
    triangles: list[TriangleLayout] = []
    parts: list[PartLayout] = []
    columns: list[_Columns] = []
    taxel = 0
    for part_number, (part_name, part) in enumerate(settings.parts.items()):
        start = taxel
        shelf_mm = 0.0
        first_column = len(columns)
        used: list[int] = []
        for patch_number, patch in enumerate(part.patches):
            where = f"parts.{part_name}.patches[{patch_number}]"
            kind = kinds.get(patch.kind)
            if kind is None:
                known = ", ".join(kinds)
                raise ConfigurationError(
                    f'{where}.kind: no kind "{patch.kind}"; there are: {known}'
                )
            numbers = parse_triangles(patch.triangles)
            column, shelf_mm = _patch_columns(where, patch, kind, len(numbers), shelf_mm, folder)
            board = settings.boards[patch.board]
            column.no_load[:] = board.no_load
            reference = settings.processing.pressure
            column.sensitivity[:] = (kind.radius_mm / reference.pad_radius_mm) ** 2 * (
                reference.foam_mm / part.foam_mm
            )
            column.unit_ff[:] = settings.processing.pressure.code_ff * 2**patch.shift
            _check_curve(where, column, reference)
            columns.append(column)
            board_number = board_names.index(patch.board)
            if board_number not in used:
                used.append(board_number)
                board_parts[patch.board].append(part_number)
            for i, number in enumerate(numbers):
                first = taxel + TAXELS_PER_TRIANGLE * i
                board_index[patch.board][number] = np.arange(first, first + TAXELS_PER_TRIANGLE)
                triangles.append(
                    TriangleLayout(
                        part_number,
                        board_number,
                        number,
                        patch.kind,
                        first,
                        patch.shift,
                        patch.cdc_offset,
                        column.outlines_m[i],
                    )
                )
            taxel += TAXELS_PER_TRIANGLE * len(numbers)
        _check_size(part_name, part, kinds, columns[first_column:])
        _check_probes(part_name, part, columns[first_column:])
        if all((column.pad_kind != PadKind.PRESSURE).all() for column in columns[first_column:]):
            raise ConfigurationError(
                f"parts.{part_name}: all of its pads are thermal; wanted one at least that "
                "measures pressure"
            )
        parts.append(
            PartLayout(part_name, part.node, start, taxel, tuple(used), part.covered, part.foam_mm)
        )
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(column, name) for column in columns]) for name in _ARRAYS
    }
    neighbour_start, neighbour = _neighbours(
        arrays["position_m"], arrays["normal"], arrays["pitch_mm"], parts
    )
    return Layout(
        robot=settings.robot,
        parts=tuple(parts),
        boards=tuple(
            _board_layout(name, settings.boards[name], board_index[name], board_parts[name])
            for name in board_names
        ),
        triangles=tuple(triangles),
        **arrays,
        triangle_of=np.repeat(np.arange(len(triangles), dtype=np.int32), TAXELS_PER_TRIANGLE),
        neighbour_start=neighbour_start,
        neighbour=neighbour,
    )


@dataclass(slots=True)
class _Columns:
    """The taxels of one patch."""

    position_m: Floats
    normal: Floats
    pad_kind: NDArray[np.uint8]
    area_mm2: Floats
    radius_mm: Floats
    pitch_mm: Floats
    unit_ff: Floats
    sensitivity: Floats
    no_load: NDArray[np.uint8]
    outlines_m: list[Floats]


_ARRAYS = [one.name for one in fields(_Columns) if one.name != "outlines_m"]


def _check_size(
    name: str, part: Part, kinds: dict[str, KindSettings], columns: list[_Columns]
) -> None:
    """Refuse a part that is larger than any robot's, with what makes it so large."""
    places_m = np.concatenate(
        [np.concatenate([one.position_m, *one.outlines_m]) for one in columns]
    )
    # As clients receive it.
    least_m, most_m = (
        end_m.round(DECIMALS_M).tolist() for end_m in (places_m.min(axis=0), places_m.max(axis=0))
    )
    large = too_large(least_m, most_m, max(float(one.radius_mm.max()) for one in columns))
    if not large:
        return
    for number, (patch, column) in enumerate(zip(part.patches, columns, strict=True)):
        if patch.positions is not None:
            why = unlike_pitch(patch.kind, kinds[patch.kind], column.position_m)
            if why:
                raise ConfigurationError(f"parts.{name}.patches[{number}].positions: {why}")
    tiled = sum(patch.positions is None and not patch.places for patch in part.patches)
    how = "places in mm, files of positions in m"
    if tiled > 1:
        how = f"{tiled} of its patches are tiled above each other; place them, or divide the part"
    raise ConfigurationError(f"parts.{name}: {large}: {how}")


def _check_probes(name: str, part: Part, columns: list[_Columns]) -> None:
    if part.localization != "template":
        return
    most_mm = WIDEST_PITCHES * max(float(column.pitch_mm.max()) for column in columns)
    largest_mm = max(part.probe_mm)
    if largest_mm > most_mm:
        raise ConfigurationError(
            f"parts.{name}.probe_mm: {largest_mm:g} mm; wanted at most {most_mm:g} mm, "
            f"{WIDEST_PITCHES:g} pitches of its pads: many pads read alike under a larger object, "
            'which localization = "centroid" locates better'
        )


def _board_layout(
    name: str, board: Board, taxel_index: NDArray[np.int32], parts: list[int]
) -> BoardLayout:
    used = tuple(int(number) for number in np.flatnonzero(taxel_index[:, 0] >= 0))
    return BoardLayout(
        name, board, used, sum(1 << number for number in used), taxel_index, tuple(parts)
    )


def _patch_columns(
    where: str, patch: Patch, kind: KindSettings, n_triangles: int, shelf_mm: float, folder: Path
) -> tuple[_Columns, float]:
    """Taxels of one patch, and the height at which the next patch without places may start."""
    _check_kind(patch.kind, kind)
    per_unit = len(kind.pads_mm) // TAXELS_PER_TRIANGLE
    n_units, rest = divmod(n_triangles, per_unit)
    if rest:
        raise ConfigurationError(
            f'{where}.triangles: {n_triangles} triangles; "{patch.kind}" takes them by {per_unit}'
        )
    if patch.places and len(patch.places) != n_units:
        raise ConfigurationError(
            f"{where}.places: {len(patch.places)} places for {n_units} units of "
            f'"{patch.kind}" ({per_unit} triangle(s) each)'
        )
    share_mm2 = shares_mm2(kind)
    _check_shares(patch.kind, kind, share_mm2)
    pads, outline = np.array(kind.pads_mm), np.array(kind.outline_mm)
    n = TAXELS_PER_TRIANGLE * n_triangles
    if patch.positions is not None:
        position_m, normal = read_positions(where, folder / patch.positions, n)
        by_unit = zip(np.split(position_m, n_units), np.split(normal, n_units), strict=True)
        outlines = [fitted_outline(kind, *unit) for unit in by_unit]
    else:
        places = patch.places
        if not places:
            places, shelf_mm = tile(kind, n_units, shelf_mm)
        laid = []
        outlines = []
        for number, place in enumerate(places):
            try:
                laid.append(lay(pads, place))
                outlines.append(lay(outline, place)[0] * 1e-3)
            except ConfigurationError as error:
                raise ConfigurationError(f"{where}.places[{number}]: {error}") from None
        position_m = np.concatenate([position for position, _ in laid]) * 1e-3
        normal = np.concatenate([normal for _, normal in laid])
    pad_kind = np.full(len(pads), PadKind.PRESSURE, np.uint8)
    pad_kind[kind.thermal] = PadKind.THERMAL
    columns = _Columns(
        position_m=position_m,
        normal=normal,
        pad_kind=np.tile(pad_kind, n_units),
        area_mm2=np.tile(share_mm2, n_units),
        radius_mm=np.full(n, kind.radius_mm),
        pitch_mm=np.full(n, kind.pitch_mm),
        unit_ff=np.empty(n),
        sensitivity=np.empty(n),
        no_load=np.empty(n, np.uint8),
        outlines_m=[outlines[i // per_unit] for i in range(n_triangles)],
    )
    return columns, shelf_mm


def _check_kind(name: str, kind: KindSettings) -> None:
    """Check properties of a user's own kind that types cannot express."""
    n = len(kind.pads_mm)
    if n == 0 or n % TAXELS_PER_TRIANGLE:
        raise ConfigurationError(f"kinds.{name}.pads_mm: {n} pads; wanted a multiple of 12")
    if len(kind.outline_mm) < 3:
        raise ConfigurationError(
            f"kinds.{name}.outline_mm: {len(kind.outline_mm)} corners; wanted 3 or more"
        )
    if any(not 0 <= pad < n for pad in kind.thermal):
        raise ConfigurationError(f"kinds.{name}.thermal: {kind.thermal}; pads are 0 to {n - 1}")


def _check_shares(name: str, kind: KindSettings, share_mm2: Floats) -> None:
    """Refuse a kind with pads whose pressure would count for no force."""
    for pad, share in enumerate(share_mm2):
        if share < SMALLEST_SHARE_MM2 and pad not in kind.thermal:
            raise ConfigurationError(
                f"kinds.{name}.outline_mm: {share:.3g} mm2 of it are nearest to pad {pad}; wanted "
                f"{SMALLEST_SHARE_MM2:g} at least: corners around all pads, one after the other"
            )


def _check_curve(where: str, taxels: _Columns, pressure: Pressure) -> None:
    """Refuse taxels that would feel nothing, because one unit of their byte is too little or too
    much.
    """
    seen_ff = float(taxels.unit_ff[0] / taxels.sensitivity[0])
    a, b = pressure.a_kpa_per_ff2, pressure.b_kpa_per_ff
    if not PressureCurve(seen_ff, 1.0, a, b).sound.all():
        least, most = (slope / b for slope in SLOPES_KPA)
        if a:
            most = min(most, BENDS[int(a > 0.0)] * b / a)
        if most < least:
            raise ConfigurationError(
                f"processing.pressure: a_kpa_per_ff2 {a:g} bends equation (1) more than it rises "
                f"by b_kpa_per_ff {b:g}"
            )
        raise ConfigurationError(
            f"{where}: one unit of its taxels' byte is {seen_ff:.3g} fF of a pad of "
            f"processing.pressure, by its code_ff and the patch's shift, radius_mm and foam_mm; "
            f"wanted {least:.3g} to {most:.3g} fF, where equation (1) rises"
        )


def _neighbours(
    position_m: Floats, normal: Floats, pitch_mm: Floats, parts: list[PartLayout]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Which taxels of a part are near each other and on the same side of it.

    Raises:
        ConfigurationError: far more are near each other than can be, see `MOST_NEIGHBOURS`.
    """
    pairs: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    for part in parts:
        taxels = slice(part.start, part.stop)
        most = max(MOST_PAIRS, MOST_NEIGHBOURS * part.n_taxels)
        n = 0
        for first, second in _pairs_along_an_axis(
            position_m[taxels], NEIGHBOUR_PITCHES * pitch_mm[taxels].max() * 1e-3
        ):
            first, second = first + part.start, second + part.start  # noqa: PLW2901
            apart = position_m[first] - position_m[second]
            reach_mm = NEIGHBOUR_PITCHES * np.maximum(pitch_mm[first], pitch_mm[second])
            near = np.sqrt(np.einsum("ij,ij->i", apart, apart)) * 1e3 <= reach_mm
            near &= np.einsum("ij,ij->i", normal[first], normal[second]) > 0
            pairs.append((first[near], second[near]))
            n += len(pairs[-1][0])
            if n > most:
                raise ConfigurationError(
                    f"parts.{part.name}: more than {most} pairs of its {part.n_taxels} taxels are "
                    "nearer to each other than the pitch of their kind allows; wanted each unit at "
                    "a place of its own, places in mm and files of positions in m"
                )
    first, second = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    taxel, neighbour = np.concatenate([first, second]), np.concatenate([second, first])
    start = np.concatenate([[0], np.cumsum(np.bincount(taxel, minlength=len(position_m)))])
    return start.astype(np.int32), neighbour[np.lexsort((neighbour, taxel))].astype(np.int32)


def _pairs_along_an_axis(
    position_m: Floats, reach_m: float
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Each pair of points once whose places on the axis of the greatest spread are in reach, some
    at a time.

    A large part has few such pairs beside the square of its taxels.
    """
    along_m = position_m[:, np.ptp(position_m, axis=0).argmax()]
    order = np.argsort(along_m, kind="stable")
    along_m = along_m[order]
    number = np.arange(len(order))
    # A little more than the reach: the exact distance decides.
    after = np.searchsorted(along_m, along_m + reach_m * (1 + 1e-9), side="right") - number - 1
    before = np.append(0, np.cumsum(after))
    begin = 0
    while begin < len(order):
        # One point at least, and more while they have few pairs together.
        end = int(np.searchsorted(before, before[begin] + PAIRS_AT_ONCE, side="right")) - 1
        end = max(end, begin + 1)
        some = slice(begin, end)
        first = np.repeat(number[some], after[some])
        in_pair = np.arange(len(first)) - np.repeat(before[some] - before[begin], after[some])
        yield order[first], order[first + 1 + in_pair]
        begin = end


def parts_of(layout: Layout, node: str) -> list[int]:
    """Indices of the parts that belong to a node.

    Raises:
        ConfigurationError: none does.
    """
    parts = [i for i, part in enumerate(layout.parts) if part.node == node]
    if not parts:
        known = ", ".join(sorted({part.node for part in layout.parts}))
        raise ConfigurationError(f'no part belongs to node "{node}"; there are: {known}')
    return parts
