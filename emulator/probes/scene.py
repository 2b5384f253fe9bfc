"""What happens to the robot: probes that press, temperature, faults; from TOML or Python.

A probe is a flat object that is pressed on a part at a place, by a force, a pressure or to a
depth that follows keyframes in time. Places are mm in the part's own frame, or a triangle's
centre, or a taxel. `docs/scenes.md` explains every key.
"""

from bisect import bisect_right
from dataclasses import dataclass
from heapq import heapify, heapreplace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct, field
from numpy.typing import NDArray

from skin_host.config.settings import read_toml
from skin_host.errors import ConfigurationError
from skin_host.layout import TAXELS_PER_TRIANGLE, Layout

Seconds = Annotated[float, Meta(ge=0)]
Positive = Annotated[float, Meta(gt=0)]
#: Time (s) and value, straight lines between; no contact before the first and after the last.
Keyframes = list[tuple[Seconds, float]]

Floats = NDArray[np.float64]


class _Table(Struct, forbid_unknown_fields=True, kw_only=True):
    pass


class Place(_Table):
    """Where on a part: `taxel` or `triangle` of it (counted in its own order), and an offset.

    Without a taxel or triangle the offset is a point of the part's frame. Offsets are along x
    and y of the frame where the skin faces z, else along the skin.
    """

    triangle: Annotated[int, Meta(ge=0)] | None = None
    taxel: Annotated[int, Meta(ge=0)] | None = None
    x_mm: float = 0.0
    y_mm: float = 0.0
    #: On fingertips without skin: from the offset in this direction the place is reached.
    z_mm: float = 0.0
    towards: tuple[float, float, float] = (0.0, 0.0, 1.0)


class Probe(_Table):
    """A flat object that presses. Exactly one of force, pressure and depth drives it.

    `part` is a part of skin, or a fingertip on a force/torque board.

    `kind` "disc" is any object; "grounded" one that is earthed, such as a hand, which is what
    a skin without its conductive cover feels.
    """

    part: str
    at: Place = field(default_factory=Place)
    kind: Literal["disc", "grounded"] = "disc"
    diameter_mm: Positive = 6.0
    #: Width and height of a rectangle (mm) instead of a disc.
    size_mm: tuple[Positive, Positive] | None = None
    turn_deg: float = 0.0
    force_n: Keyframes | None = None
    pressure_kpa: Keyframes | None = None
    depth_mm: Keyframes | None = None
    #: Spring in series with a depth: load cell, arm, or the object itself.
    compliance_mm_per_n: Annotated[float, Meta(ge=0)] = 0.0
    #: The offset moves: time, x (mm), y (mm), added to the place.
    slide_mm: list[tuple[Seconds, float, float]] = []
    #: On fingertips with a force/torque board: an object hangs on the probe and is pulled along
    #: the surface by this force (N); what friction does not hold slides.
    tangential_n: Keyframes | None = None
    #: Direction of the pull, from the first of the two axes along the surface.
    tangential_deg: float = 0.0
    #: Coefficient of static friction between probe and fingertip.
    friction: Positive = 0.6
    start_s: Seconds = 0.0
    #: The keyframes start again after this time; 0 is never.
    repeat_s: Seconds = 0.0

    @property
    def area_mm2(self) -> float:
        """Area of the contact."""
        if self.size_mm is not None:
            return self.size_mm[0] * self.size_mm[1]
        return float(np.pi / 4 * self.diameter_mm**2)

    @property
    def drive(self) -> Keyframes:
        """The keyframes that drive it: force (N), or depth (mm) where there is no force."""
        if self.force_n is not None:
            return self.force_n
        if self.pressure_kpa is not None:
            per_kpa = self.area_mm2 * 1e-3
            return [(t_s, kpa * per_kpa) for t_s, kpa in self.pressure_kpa]
        return self.depth_mm or []

    @property
    def by_depth(self) -> bool:
        """Whether it is moved to a depth, not pushed by a force."""
        return self.depth_mm is not None


class Air(_Table):
    """Air that presses all pads of a part alike, by exactly one of a file and keyframes."""

    part: str
    #: A recorded course, `time_s,pressure_kpa` or .npz, beside the scene's own file.
    file: str = ""
    pressure_kpa: Keyframes = []
    start_s: Seconds = 0.0


class Temperature(_Table):
    """Temperature of the skin: degrees C over time, straight lines between, held outside."""

    keyframes_c: list[tuple[Seconds, float]] = field(default_factory=lambda: [(0.0, 25.0)])


class Fault(_Table):
    """Something that goes wrong, see `emulator.faults` for the names.

    `board` names a board of the configuration, `bus` a bus; `triangle` is a board's own
    number 0..15, `taxel` one of its twelve.
    """

    name: str
    at_s: Seconds = 0.0
    until_s: Seconds | None = None
    board: str | None = None
    bus: str | None = None
    triangle: Annotated[int, Meta(ge=0, le=15)] | None = None
    taxel: Annotated[int, Meta(ge=0, le=11)] | None = None
    value: float | None = None


class Scene(_Table):
    """A whole scene. The same scene and seed give the same bytes."""

    about: str = ""
    seed: Annotated[int, Meta(ge=0)] = 1
    #: Draw every pad, chip and piece of foam as different as real ones are.
    spread: bool = True
    noise: bool = True
    #: Pads of the best skin (0.2 to 0.4 units of 2.88 fF) instead of what real robots have.
    quiet: bool = False
    #: Viscoelastic truth of the foam, see `emulator.probes.viscoelastic`.
    foam: Literal["S", "A", "L", "H", "infinergy"] = "S"
    #: Decay length of the surface around a contact; 0 is a plain Winkler layer.
    membrane_mm: Annotated[float, Meta(ge=0)] = 0.0
    temperature: Temperature = field(default_factory=Temperature)
    probe: list[Probe] = []
    air: list[Air] = []
    fault: list[Fault] = []


def load(path: Path) -> Scene:
    """Read and check a scene file.

    Raises:
        ConfigurationError: unreadable, not TOML, or wrong; the message names file and key.
    """
    scene = read_toml(path, Scene, {})
    for air in scene.air:
        if air.file:
            air.file = str(path.parent / air.file)
    try:
        check(scene)
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {error}") from None
    return scene


def check(scene: Scene) -> None:
    """Check properties that the types cannot express.

    Raises:
        ConfigurationError: names the key.
    """
    for number, probe in enumerate(scene.probe):
        where = f"probe[{number}]"
        drives = [name for name in ("force_n", "pressure_kpa", "depth_mm") if getattr(probe, name)]
        if len(drives) != 1:
            seen = " and ".join(drives) or "none"
            raise ConfigurationError(
                f"{where}: driven by {seen}; wanted one of force_n, pressure_kpa, depth_mm"
            )
        _check_times(f"{where}.{drives[0]}", [t_s for t_s, _ in getattr(probe, drives[0])])
        if min(value for _, value in getattr(probe, drives[0])) < 0:
            raise ConfigurationError(f"{where}.{drives[0]}: a probe cannot pull; wanted >= 0")
        if probe.tangential_n is not None:
            _check_times(f"{where}.tangential_n", [t_s for t_s, _ in probe.tangential_n])
        if probe.slide_mm:
            _check_times(f"{where}.slide_mm", [t_s for t_s, _, _ in probe.slide_mm])
        if probe.at.triangle is not None and probe.at.taxel is not None:
            raise ConfigurationError(f"{where}.at: has both `triangle` and `taxel`")
    for number, air in enumerate(scene.air):
        where = f"air[{number}]"
        if bool(air.file) == bool(air.pressure_kpa):
            raise ConfigurationError(f"{where}: wanted one of file and pressure_kpa")
        _check_times(f"{where}.pressure_kpa", [t_s for t_s, _ in air.pressure_kpa])
        if min((kpa for _, kpa in air.pressure_kpa), default=0.0) < 0:
            raise ConfigurationError(f"{where}.pressure_kpa: air cannot pull; wanted >= 0")
        if any(probe.part == air.part for probe in scene.probe):
            raise ConfigurationError(f'{where}.part: "{air.part}" has probes too; wanted one')
    if not scene.temperature.keyframes_c:
        raise ConfigurationError("temperature.keyframes_c: is empty")
    _check_times("temperature.keyframes_c", [t_s for t_s, _ in scene.temperature.keyframes_c])


def _check_times(where: str, times_s: list[float]) -> None:
    if any(after < before for before, after in pairwise(times_s)):
        raise ConfigurationError(f"{where}: times run backwards")


@dataclass(slots=True)
class Moment:
    """What presses at one time: arrays over the c probes in contact.

    Attributes:
        number: intp[c], the probes.
        drive: float64[c], force (N) or depth (mm).
        offset_mm: float64[c, 2], how far each has slid from its place.
    """

    number: NDArray[np.intp]
    drive: Floats
    offset_mm: Floats


class Script:
    """The scene's probes over time. Time only goes forward; work is done where keyframes are."""

    def __init__(self, probes: list[Probe]) -> None:
        self._probes = probes
        self._drives = [probe.drive for probe in probes]
        self._drive_times_s = [[t_s for t_s, _ in drive] for drive in self._drives]
        self._slide_times_s = [[t_s for t_s, _, _ in probe.slide_mm] for probe in probes]
        n = len(probes)
        #: Of each probe's present stretch: begin (s), then drive, x and y there and per second.
        self._begin_s = np.zeros(n)
        self._from = np.zeros((n, 3))
        self._rate = np.zeros((n, 3))
        self._touches = np.zeros(n, bool)
        self._number = np.zeros(0, np.intp)
        self._moves = False
        #: When the stretches end, the next one first.
        self._ends = [(probe.start_s, number) for number, probe in enumerate(probes)]
        heapify(self._ends)

    def add_live(self) -> int:
        """One more probe, which `set_live` moves; its number."""
        self._begin_s = np.append(self._begin_s, 0.0)
        self._from = np.append(self._from, np.zeros((1, 3)), axis=0)
        self._rate = np.append(self._rate, np.zeros((1, 3)), axis=0)
        self._touches = np.append(self._touches, False)
        return len(self._touches) - 1

    def set_live(self, number: int, drive: float, x_mm: float, y_mm: float) -> None:
        """Let a live probe press like this from now on; a drive of 0 lifts it."""
        self._from[number] = drive, x_mm, y_mm
        self._touches[number] = drive > 0
        self._number = np.flatnonzero(self._touches)

    def at(self, t_s: float) -> Moment:
        """What presses at `t_s`, which is not before that of the last call."""
        if self._ends and self._ends[0][0] <= t_s:
            while self._ends[0][0] <= t_s:
                probe = self._ends[0][1]
                heapreplace(self._ends, (self._enter(probe, t_s), probe))
            self._number = np.flatnonzero(self._touches)
            self._moves = bool(self._rate[self._number].any())
        number = self._number
        since_s = t_s - self._begin_s[number]
        values = self._from[number] + self._rate[number] * since_s[:, None]
        return Moment(number, np.maximum(values[:, 0], 0.0), values[:, 1:])

    def path_mm(self, number: NDArray[np.intp], times_s: Floats) -> Floats:
        """Where some probes [c] are, [k, c, 2], at k times after `at`, if no keyframe comes."""
        since_s = times_s[:, None] - self._begin_s[number]
        path_mm: Floats = self._from[number, 1:] + self._rate[number, 1:] * since_s[:, :, None]
        return path_mm

    def still_until_s(self, t_s: float) -> float:
        """After `at(t_s)`: when something may change next; `t_s` itself if it does now."""
        if self._moves:
            return t_s
        return self._ends[0][0] if self._ends else np.inf

    def _enter(self, number: int, t_s: float) -> float:
        """Set up the stretch between keyframes in which `t_s` lies; answers when it ends."""
        probe = self._probes[number]
        phase_s = t_s - probe.start_s
        if probe.repeat_s:
            phase_s %= probe.repeat_s
        # A nanosecond ahead, so that rounding never enters a stretch that is over.
        ahead_s = phase_s + 1e-9
        low, share, rate_hz, end_s = _stretch(self._drive_times_s[number], ahead_s)
        drive = self._drives[number]
        high = min(low + 1, len(drive) - 1)
        self._begin_s[number] = t_s
        change = drive[high][1] - drive[low][1]
        self._from[number, 0] = drive[low][1] + share * change
        self._rate[number, 0] = rate_hz * change
        inside = 0 <= low < len(drive) - 1
        self._touches[number] = inside and max(drive[low][1], drive[high][1]) > 0
        if probe.slide_mm:
            low, share, rate_hz, slide_end_s = _stretch(self._slide_times_s[number], ahead_s)
            first = np.array(probe.slide_mm[max(low, 0)][1:])
            change_mm = np.array(probe.slide_mm[min(low + 1, len(probe.slide_mm) - 1)][1:]) - first
            self._from[number, 1:] = first + share * change_mm
            self._rate[number, 1:] = rate_hz * change_mm
            end_s = min(end_s, slide_end_s)
        if probe.repeat_s:
            end_s = min(end_s, probe.repeat_s)
        return t_s + (end_s - phase_s)


def _stretch(times_s: list[float], t_s: float) -> tuple[int, float, float, float]:
    """Between which keyframes `t_s` lies.

    Returns:
        Index of the one before (-1: none yet), share of the way to the next, shares per
        second, and when it ends.
    """
    low = bisect_right(times_s, t_s) - 1
    if low < 0:
        return low, 0.0, 0.0, times_s[0]
    if low == len(times_s) - 1:
        return low, 0.0, 0.0, np.inf
    length_s = times_s[low + 1] - times_s[low]
    return low, (t_s - times_s[low]) / length_s, 1 / length_s, times_s[low + 1]


def resolve(place: Place, part: str, layout: Layout) -> tuple[Floats, Floats]:
    """A place as a point [3] (m) of the part's frame and the outward normal [3] there.

    Raises:
        ConfigurationError: no such part, triangle or taxel; the message names the key.
    """
    try:
        found = layout.part(part)
    except KeyError:
        known = ", ".join(one.name for one in layout.parts)
        raise ConfigurationError(f'part: no part "{part}"; there are: {known}') from None
    offset_m = np.array([place.x_mm, place.y_mm, 0.0]) * 1e-3
    normal = np.array([0.0, 0.0, 1.0])
    origin_m = np.zeros(3)
    if place.taxel is not None:
        if place.taxel >= found.n_taxels:
            raise ConfigurationError(
                f'at.taxel: {place.taxel}; part "{part}" has taxels 0 to {found.n_taxels - 1}'
            )
        origin_m = layout.position_m[found.start + place.taxel]
        normal = layout.normal[found.start + place.taxel]
    elif place.triangle is not None:
        first = found.start + TAXELS_PER_TRIANGLE * place.triangle
        if first >= found.stop:
            last = found.n_taxels // TAXELS_PER_TRIANGLE - 1
            raise ConfigurationError(
                f'at.triangle: {place.triangle}; part "{part}" has triangles 0 to {last}'
            )
        taxels = slice(first, first + TAXELS_PER_TRIANGLE)
        origin_m = layout.position_m[taxels].mean(axis=0)
        normal = layout.normal[taxels].mean(axis=0)
        normal /= np.linalg.norm(normal)
    along = tangents(normal)
    return origin_m + offset_m[:2] @ along, normal


def tangents(normal: Floats) -> Floats:
    """Two unit vectors [2, 3] along the skin; x and y of the frame where the skin faces z.

    The basis of Duff et al., "Building an Orthonormal Basis, Revisited" (2017), which stays
    exact in every direction.
    """
    x, y, z = normal
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    return np.array(
        [[1 + sign * x * x * a, sign * x * y * a, -sign * x], [x * y * a, sign + y * y * a, -y]]
    )
