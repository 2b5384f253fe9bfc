"""Goals: a measured figure, and whether it is good enough."""

from typing import Any


def goal(
    figure: str, measured: float | None, must: float, aim: float, *, at_least: bool = False
) -> dict[str, Any]:
    """Return a row of the goals; `measured` is None if it could not be measured."""

    def enough(wanted: float) -> bool:
        if measured is None:
            return False
        return measured >= wanted - 1e-9 if at_least else measured <= wanted + 1e-9

    return {
        "figure": figure,
        "measured": measured,
        "must": must,
        "aim": aim,
        "at_least": at_least,
        "reached": enough(must),
        "aim_reached": enough(aim),
    }
