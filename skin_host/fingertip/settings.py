"""Table `[fingertips.NAME]` of a configuration: a fingertip on a force/torque board."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

from msgspec import Meta, Struct

from skin_host.fields import Name, Positive
from skin_host.fingertip.intrinsic import Plane, Quadric, Surface, cylinder, ellipsoid, sphere

if TYPE_CHECKING:
    from skin_host.settings import Settings

Vector = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]

#: Dimensions that a shape needs, and those that it may have.
_NEEDS = {"sphere": ["radius_mm"], "cylinder": ["radius_mm"], "ellipsoid": ["semi_axes_mm"]}
_MAY = {"cylinder": ["half_length_mm"], "plane": ["reach_mm"]}
_DIMENSIONS = ("radius_mm", "semi_axes_mm", "half_length_mm", "reach_mm")


class Fingertip(Struct, forbid_unknown_fields=True, kw_only=True):
    """A fingertip on a force/torque board (STRAIN, STRAIN2): contact from force and torque.

    Its frame has its origin in the middle of a sphere, a cylinder (about z) or an ellipsoid
    (axes along x, y, z), or on a plane that faces z. Its name is that of its topics.
    """

    bus: Name
    address: Annotated[int, Meta(ge=1, le=14)]
    shape: Literal["sphere", "cylinder", "ellipsoid", "plane"]
    #: Of a sphere or cylinder.
    radius_mm: Positive | None = None
    #: Of an ellipsoid.
    semi_axes_mm: tuple[Positive, Positive, Positive] | None = None
    #: A cylinder ends so far from its middle; without it, it has no end.
    half_length_mm: Positive | None = None
    #: A plane ends so far from its middle; without it, it has no end.
    reach_mm: Positive | None = None
    #: A part whose skin covers the fingertip, in the same frame: both make one estimate.
    array: Name | None = None
    node: Name = "main"
    #: A sample is sent this often; at 10 ms slips are told after a millimetre.
    period_ms: Annotated[int, Meta(ge=1, le=255)] = 5
    #: N and N m that the largest value of each channel stands for; the board is asked without.
    full_scale: tuple[Positive, Positive, Positive, Positive, Positive, Positive] | None = None
    #: Calibration matrix: what the board sends (N, N m) to the force and torque of whatever
    #: touches, along the axes of the fingertip's frame. The board's own axes without.
    matrix: tuple[Six, Six, Six, Six, Six, Six] | None = None
    #: Where the force/torque sensor's origin lies in the fingertip's frame.
    sensor_mm: Vector = (0.0, 0.0, 0.0)
    #: Coefficient of static friction, rather too low; without it an abrupt fall of
    #: tangential over normal force is looked for.
    friction: Positive | None = None
    #: A contact begins at this force, and ends at 0.7 of it (F1).
    threshold_n: Positive = 0.2
    #: Above this normal force the fingertip presses too hard (F2).
    over_n: Positive = 10.0
    #: Faster changes of the tangential force are slips.
    slip_n_s: Positive = 6.0
    #: Contacts are located on force and torque below this frequency.
    filter_hz: Positive = 10.0

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


def wrong_references(settings: "Settings") -> Iterator[tuple[str, str]]:
    """What is wrong with fingertips beyond types: where in the file, and what."""
    addresses = {
        (board.bus, board.address): f'board "{name}"' for name, board in settings.boards.items()
    }
    nodes = {part.node for part in settings.parts.values()}
    for name, tip in settings.fingertips.items():
        where = f"fingertips.{name}"
        if name in settings.parts or name == "nodes":
            yield where, "the name is taken by another's topics; choose another"
        if tip.bus not in settings.buses:
            yield f"{where}.bus", f'no bus "{tip.bus}"; there are: {", ".join(settings.buses)}'
        twin = addresses.setdefault((tip.bus, tip.address), where)
        if twin != where:
            yield f"{where}.address", f'{tip.address} on bus "{tip.bus}" is already that of {twin}'
        if tip.array is not None and tip.array not in settings.parts:
            yield f"{where}.array", f'no part "{tip.array}"; there are: {", ".join(settings.parts)}'
        elif tip.array is not None and settings.parts[tip.array].node != tip.node:
            yield f"{where}.node", f'"{tip.node}", but its array belongs to another node'
        if tip.node not in nodes:
            yield f"{where}.node", f'no part belongs to node "{tip.node}"'
        if tip.filter_hz >= 500.0 / tip.period_ms:
            limit = 500.0 / tip.period_ms
            what = f"{tip.filter_hz:g}; wanted below {limit:g}, half of the samples' rate"
            yield f"{where}.filter_hz", what
        if tip.over_n <= tip.threshold_n:
            yield f"{where}.over_n", f"{tip.over_n:g}; wanted more than threshold_n"
        needs = _NEEDS.get(tip.shape, [])
        for key in _DIMENSIONS:
            given = getattr(tip, key) is not None
            if key in needs and not given:
                yield f"{where}.{key}", f"missing key; a {tip.shape} needs it"
            if given and key not in [*needs, *_MAY.get(tip.shape, [])]:
                yield f"{where}.{key}", f"a {tip.shape} has none"
