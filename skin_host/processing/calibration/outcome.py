"""What a calibration found, as a document: the answer of a daemon, and `skin calibrate --json`."""

from collections.abc import Collection
from typing import Annotated, Literal, TypedDict

from msgspec import Meta

from skin_host.layout import TAXELS_PER_TRIANGLE, Layout, PadKind
from skin_host.processing.calibration import (
    Calibration,
    Verdict,
    Zero,
    damaged,
    summary,
    unchanged,
)

#: An answer is not trusted.
Number = Annotated[int, Meta(ge=0, lt=2**31)]
#: By part: numbers of taxels within it.
Taxels = dict[str, list[Number]]
#: Whether a fingertip on a force/torque board was zeroed: yes; yes, while it was touched; no, it
#: keeps its zero; no, and it has none.
TipVerdict = Literal["ok", "touched", "unchanged", "absent"]


class TriangleVerdict(TypedDict):
    """One triangle of `pressure_taxels`: `verdict` is the worst; `taxels` are those not ok.

    The taxels have their numbers within the part, grouped by their own verdicts.
    """

    part: str
    board: str
    triangle: Number
    pressure_taxels: Number
    verdict: str
    taxels: Taxels


class Outcome(TypedDict):
    """What a calibration found.

    Attributes:
        id, time: of the calibration.
        verdicts: of the taxels of all parts, how many have each.
        triangles: those that were calibrated, in the order of the layout.
        touched: taxels that were touched meanwhile.
        unchanged: taxels that were received too rarely, and go on as before.
        damaged: taxels of which damaged bytes were left out.
        fingertips: those that were to be zeroed.
    """

    id: str
    time: str
    verdicts: dict[str, dict[str, Number]]
    triangles: list[TriangleVerdict]
    touched: Taxels
    unchanged: Taxels
    damaged: Taxels
    fingertips: dict[str, TipVerdict]


def outcome(
    calibration: Calibration,
    layout: Layout,
    parts: Collection[int],
    boards: Collection[int] | None = None,
    fingertips: Collection[str] = (),
    before: Calibration | None = None,
) -> Outcome:
    """Return what a calibration found.

    Args:
        calibration: the calibration.
        layout: of the skin.
        parts: indices of the parts of the node.
        boards: indices of those that were calibrated; None: all of these parts.
        fingertips: names of those that were to be zeroed.
        before: the calibration that the node had before.
    """
    triangles = triangle_verdicts(calibration, layout, parts, boards)
    kept = unchanged(calibration, layout)
    touched: Taxels = {}
    for one in triangles:
        part = one["part"]
        meanwhile = set(one["taxels"].get("touched", ())).difference(kept.get(part, ()))
        if meanwhile:
            touched.setdefault(part, []).extend(sorted(meanwhile))
    zeros = {} if before is None else before.zeros
    return {
        "id": calibration.id,
        "time": calibration.time,
        "verdicts": summary(calibration, layout),
        "triangles": triangles,
        "touched": touched,
        "unchanged": kept,
        "damaged": damaged(calibration, layout),
        "fingertips": {
            name: _tip_verdict(calibration.zeros.get(name), zeros.get(name)) for name in fingertips
        },
    }


def triangle_verdicts(
    calibration: Calibration,
    layout: Layout,
    parts: Collection[int],
    boards: Collection[int] | None = None,
) -> list[TriangleVerdict]:
    """Return the verdicts of the triangles of some parts, in the order of the layout."""
    found: list[TriangleVerdict] = []
    for triangle in layout.triangles:
        if triangle.part not in parts or not (boards is None or triangle.board in boards):
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


def _tip_verdict(zero: Zero | None, before: Zero | None) -> TipVerdict:
    if zero is None:
        return "absent"
    if zero is before:
        return "unchanged"
    return "touched" if zero.touched else "ok"
