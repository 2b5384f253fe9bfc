"""Tables of what was published besides frames: one definition of their columns for every format.

`docs/recordings.md` lists the columns. A value that is not known is an empty cell, null in Parquet,
and in arrays NaN or an empty text.
"""

from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any, Literal, NamedTuple

import numpy as np

from skin_host.processing.events import Touch

#: `numbers` and `texts` are several ones an event.
Kind = Literal["integer", "number", "text", "vector", "numbers", "texts"]
_NOWHERE = (np.nan,) * 3


class Column(NamedTuple):
    """A column: `of` returns its value of an event; `axes` are the heads of a vector's cells."""

    name: str
    kind: Kind
    of: Callable[[Any], Any]
    unit: str | None = None
    axes: tuple[str, str, str] | None = None

    @property
    def heads(self) -> Sequence[str]:
        """Names of its cells in a row of text."""
        return self.axes or (self.name,)

    def cells(self, event: Any) -> Sequence[Any]:
        """Return the values of its cells in a row of text."""
        value = self.of(event)
        if self.kind == "vector":
            return (None,) * 3 if value is None else tuple(value)
        if self.kind in ("numbers", "texts"):
            return (" ".join(map(str, value or ())),)
        return (value,)

    def arrays(self, events: Sequence[Any]) -> dict[str, Any]:
        """Return its array of n events by name: [n], of a vector [n, 3].

        The numbers of all events follow one another in one array; `<name>_n` [n] is how many each
        has.
        """
        values = [self.of(event) for event in events]
        match self.kind:
            case "integer":
                return {self.name: np.array(values, np.int64)}
            case "number":
                return {self.name: np.array(values, np.float64)}  # None becomes NaN
            case "vector":
                known = [_NOWHERE if value is None else value for value in values]
                return {self.name: np.array(known, np.float64).reshape(-1, 3)}
            case "numbers":
                flat = [number for value in values for number in value]
                return {
                    self.name: np.array(flat, np.int64),
                    f"{self.name}_n": np.array(list(map(len, values)), np.int64),
                }
            case "texts":
                values = [" ".join(value or ()) for value in values]
        return {self.name: np.array([value or "" for value in values], np.str_)}


class Table(NamedTuple):
    """A table of a recording: `name` of its file, and of the rows in a `Series`.

    `singular` is that of its arrays.
    """

    name: str
    singular: str
    columns: tuple[Column, ...]


def _column(name: str, kind: Kind, unit: str | None = None) -> Column:
    axis, _, rest = name.rpartition("_") if unit else (name, "", "")
    axes = tuple(f"{axis}_{one}" + (f"_{rest}" if rest else "") for one in "xyz")
    return Column(name, kind, attrgetter(name), unit, axes if kind == "vector" else None)  # type: ignore[arg-type]


def _of_load(name: str, kind: Kind, unit: str | None = None) -> Column:
    def of(touch: Touch) -> Any:
        return None if touch.load is None else getattr(touch.load, name)

    return _column(f"load_{name}", kind, unit)._replace(of=of)


_HEAD = (
    _column("t_ns", "integer"),
    _column("part", "text"),
)
_EVENT = (
    *_HEAD,
    _column("event", "text"),
    _column("id", "integer"),
    _column("count", "integer"),
)

#: What a recording has besides frames, in the order in which it is written.
TABLES = (
    Table(
        "touches",
        "touch",
        (
            *_EVENT,
            _column("seq", "integer"),
            _column("reason", "text"),
            _column("centroid_m", "vector", "m")._replace(axes=("x_m", "y_m", "z_m")),
            _column("normal", "vector"),
            _column("area_mm2", "number", "mm2"),
            _column("peak_kpa", "number", "kPa"),
            _column("mean_kpa", "number", "kPa"),
            _column("force_n", "number", "N"),
            _column("sigma_m", "number", "m"),
            _column("partial", "integer")._replace(of=lambda touch: int(touch.partial)),
            _column("beyond", "integer")._replace(of=lambda touch: int(touch.beyond)),
            _column("taxels", "numbers"),
            _of_load("verdict", "text"),
            _of_load("force_n", "vector", "N"),
            _of_load("torque_nm", "vector", "N m"),
            _of_load("shear_n", "vector", "N"),
            _of_load("flags", "texts"),
        ),
    ),
    Table(
        "slips",
        "slip",
        (
            *_EVENT,
            _column("cause", "text"),
            _column("force_n", "number", "N"),
            _column("shear_n", "number", "N"),
            _column("shear_rate_n_s", "number", "N/s"),
        ),
    ),
    Table("overs", "over", (*_EVENT, _column("force_n", "number", "N"))),
    Table("contacts", "contact", (*_HEAD, _column("state", "text"))),
    Table("health", "health", (*_HEAD, _column("state", "text"), _column("text", "text"))),
)
