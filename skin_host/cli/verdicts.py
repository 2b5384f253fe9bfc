"""Summarises a calibration by triangle, for `skin calibrate`."""

from itertools import groupby
from typing import TypedDict

from skin_host.config.check import columns, format_triangles
from skin_host.health.diagnosis import named
from skin_host.layout import TAXELS_PER_TRIANGLE, Layout, PadKind
from skin_host.processing.calibration import Calibration, Verdict


class TriangleVerdict(TypedDict):
    """One triangle of `pressure_taxels`: `verdict` is the worst; `taxels` are those not ok.

    The taxels have their numbers within the part, grouped by their own verdicts.
    """

    part: str
    board: str
    triangle: int
    pressure_taxels: int
    verdict: str
    taxels: dict[str, list[int]]


def triangle_verdicts(
    calibration: Calibration, layout: Layout, parts: list[int]
) -> list[TriangleVerdict]:
    """The verdicts of the triangles of some parts, in the order of the layout."""
    found: list[TriangleVerdict] = []
    for triangle in layout.triangles:
        if triangle.part not in parts:
            continue
        part = layout.parts[triangle.part]
        by_verdict: dict[Verdict, list[int]] = {}
        for taxel in range(triangle.first, triangle.first + TAXELS_PER_TRIANGLE):
            if layout.pad_kind[taxel] == PadKind.PRESSURE:
                verdict = Verdict(calibration.verdict[taxel])
                by_verdict.setdefault(verdict, []).append(taxel - part.start)
        found.append(
            {
                "part": part.name,
                "board": layout.boards[triangle.board].name,
                "triangle": triangle.number,
                "pressure_taxels": sum(map(len, by_verdict.values())),
                "verdict": max(by_verdict, default=Verdict.OK).name.lower(),
                "taxels": {
                    verdict.name.lower(): taxels
                    for verdict, taxels in sorted(by_verdict.items())
                    if verdict is not Verdict.OK
                },
            }
        )
    return found


def table(verdicts: list[TriangleVerdict]) -> str:
    """Return a line for each triangle that is not ok, and one for those of a board that are."""
    rows: list[list[str | int]] = []
    for (part, board), triangles in groupby(verdicts, lambda one: (one["part"], one["board"])):
        mine = list(triangles)
        well = [one["triangle"] for one in mine if not one["taxels"]]
        if well:
            rows.append([part, board, format_triangles(well), "ok"])
        rows += [[part, board, one["triangle"], _words(one)] for one in mine if one["taxels"]]
    return columns(["part", "board", "triangles", "verdict"], rows)


def touched(verdicts: list[TriangleVerdict]) -> str:
    """Return which taxels were touched, by part: "taxels 3-5, 9 of left_hand"; empty if none
    was.
    """
    by_part: dict[str, list[int]] = {}
    for one in verdicts:
        by_part.setdefault(one["part"], []).extend(one["taxels"].get("touched", []))
    return "; ".join(f"{named(taxels)} of {part}" for part, taxels in by_part.items() if taxels)


def _words(triangle: TriangleVerdict) -> str:
    return "; ".join(
        name.replace("_", " ")
        if len(taxels) == triangle["pressure_taxels"]
        else f"{len(taxels)} {name.replace('_', ' ')}: {', '.join(map(str, taxels))}"
        for name, taxels in triangle["taxels"].items()
    )
