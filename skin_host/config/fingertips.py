"""Table `[fingertips.NAME]` of a configuration: a fingertip on a force/torque board."""

from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from skin_host.config.fields import Hertz, Millimetres, Name, Newtons, PlaceMm
from skin_host.fingertip.intrinsic import Plane, Quadric, Surface, cylinder, ellipsoid, sphere
from skin_host.fingertip.reach import reach_n

Vector = tuple[PlaceMm, PlaceMm, PlaceMm]
Six = tuple[float, float, float, float, float, float]

#: Dimensions that a shape needs, and optional ones.
_NEEDS = {"sphere": ["radius_mm"], "cylinder": ["radius_mm"], "ellipsoid": ["semi_axes_mm"]}
_MAY = {"cylinder": ["half_length_mm"], "plane": ["reach_mm"]}
#: The largest full scales that a board can answer.
_ANSWERED = np.full(6, float(0xFFFF))
#: A row of a matrix of which less than this share is its own depends on the others, but for
#: rounding.
_ROUNDING = 1e-9
_DIMENSIONS = ("radius_mm", "semi_axes_mm", "half_length_mm", "reach_mm")


class Fingertip(Struct, forbid_unknown_fields=True, kw_only=True, frozen=True):
    """A fingertip on a force/torque board (STRAIN, STRAIN2): contact from force and torque.

    Its frame has its origin in the middle of a sphere, a cylinder (about z) or an ellipsoid
    (axes along x, y, z), or on a plane that faces z. Its topics have its name.
    """

    bus: Name
    address: Annotated[int, Meta(ge=1, le=14)]
    shape: Literal["sphere", "cylinder", "ellipsoid", "plane"]
    #: Of a sphere or cylinder.
    radius_mm: Millimetres | None = None
    #: Of an ellipsoid.
    semi_axes_mm: tuple[Millimetres, Millimetres, Millimetres] | None = None
    #: Distance from the middle to the ends of a cylinder; without it, the cylinder is infinite.
    half_length_mm: Millimetres | None = None
    #: Distance from the middle to the edge of a plane; without it, the plane is infinite.
    reach_mm: Millimetres | None = None
    #: A part whose skin covers the fingertip, in the same frame: both contribute to one estimate.
    array: Name | None = None
    node: Name = "main"
    #: A sample is sent this often; at 10 ms slips are reported after a millimetre.
    period_ms: Annotated[int, Meta(ge=1, le=255)] = 5
    #: N and N m that the largest value of each channel stands for; without it, the board is
    #: queried.
    full_scale: tuple[Newtons, Newtons, Newtons, Newtons, Newtons, Newtons] | None = None
    #: Calibration matrix from the values of the board (N, N m) to the force and torque that the
    #: touching object exerts, along the axes of the fingertip's frame; its rows are independent.
    #: Without it, the board's own axes are used.
    matrix: tuple[Six, Six, Six, Six, Six, Six] | None = None
    #: Position of the force/torque sensor's origin in the fingertip's frame.
    sensor_mm: Vector = (0.0, 0.0, 0.0)
    #: Coefficient of static friction, better too low than too high; without it, an abrupt fall of
    #: tangential over normal force is detected instead.
    friction: Annotated[float, Meta(ge=0.001, le=1000)] | None = None
    #: A contact begins at this force, and ends at 0.7 of it (F1).
    threshold_n: Newtons = 0.2
    #: Above this normal force the fingertip presses too hard (F2).
    over_n: Newtons = 10.0
    #: A faster change of the tangential force is a slip.
    slip_n_s: Annotated[float, Meta(ge=0.001, le=1e9)] = 6.0
    #: Contacts are located on force and torque below this frequency.
    filter_hz: Hertz = 10.0

    def wrong_values(self) -> Iterator[tuple[str, str]]:
        """Values that are wrong beyond their types: the key, and the reason."""
        if self.filter_hz >= 500.0 / self.period_ms:
            limit = 500.0 / self.period_ms
            what = f"{self.filter_hz:g}; wanted below {limit:g}, half of the samples' rate"
            yield "filter_hz", what
        if self.over_n <= self.threshold_n:
            yield "over_n", f"{self.over_n:g}; wanted more than threshold_n"
        yield from self._dependent()
        yield from self._unreached()
        needs = _NEEDS.get(self.shape, [])
        for key in _DIMENSIONS:
            given = getattr(self, key) is not None
            if key in needs and not given:
                yield f"{key}", f"missing key; a {self.shape} needs it"
            if given and key not in [*needs, *_MAY.get(self.shape, [])]:
                yield f"{key}", f"a {self.shape} does not have it"

    def _dependent(self) -> Iterator[tuple[str, str]]:
        """Why the matrix gives no force or torque in some direction."""
        rows = self.to_wrench
        sizes = np.linalg.norm(rows, axis=1, keepdims=True)
        shares = rows / np.where(sizes > 0.0, sizes, 1.0)
        own = np.abs(np.diag(np.linalg.qr(shares.T, mode="r")))
        for row in np.flatnonzero(own < _ROUNDING)[:1].tolist():
            what = (
                f"row {row + 1} follows from those before it, or is 0; wanted six independent rows"
            )
            yield "matrix", what

    def _unreached(self) -> Iterator[tuple[str, str]]:
        """Why no load would be a touch, whatever the board answers and its zero is."""
        limit_n = reach_n(self.to_wrench[:3], np.array(self.full_scale or _ANSWERED))
        if not self.threshold_n <= limit_n:
            what = (
                f"{self.threshold_n:g}; wanted at most {limit_n:g}, the force that is measured in "
                "every direction, by full_scale and matrix"
            )
            yield "threshold_n", what

    @property
    def to_wrench(self) -> NDArray[np.float64]:
        """float64[6, 6], from the values of the board to force (N) and torque (N m)."""
        return np.eye(6) if self.matrix is None else np.array(self.matrix)

    @property
    def surface(self) -> Surface:
        """The surface, in its frame."""
        inf = float("inf")
        if self.shape == "plane":
            return Plane(reach_mm=self.reach_mm or inf)
        if self.semi_axes_mm is not None:
            return ellipsoid(*self.semi_axes_mm)
        assert self.radius_mm is not None
        body: Quadric = sphere(self.radius_mm)
        if self.shape == "cylinder":
            body = cylinder(self.radius_mm, self.half_length_mm or inf)
        return body
