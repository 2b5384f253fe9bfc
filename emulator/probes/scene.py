"""What happens to the robot: probes that press, temperature, faults; from TOML or Python.

A probe is a flat object that is pressed on a part at a place, by a force, a pressure or to a
depth that follows keyframes in time. Air presses all pads of a part equally, by keyframes or as it
was recorded. Places are mm in the part's own frame, or a triangle's
centre, or a taxel. `docs/scenes.md` explains every key.
"""

import io
import math
import zipfile
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heapify, heapreplace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct, field
from numpy.typing import NDArray

from skin_host.config.explain import explain, out_of_bounds
from skin_host.config.fields import Millimetres
from skin_host.config.settings import read_toml
from skin_host.errors import ConfigurationError, visible
from skin_host.files import read_whole
from skin_host.layout import TAXELS_PER_TRIANGLE, Layout

Seconds = Annotated[float, Meta(ge=0)]
#: More than the boards and the foam outlast.
Celsius = Annotated[float, Meta(ge=-100, le=200)]
#: Coefficients of static friction.
Friction = Annotated[float, Meta(ge=0.001, le=1000)]
#: Time (s) and value, straight lines between; no contact before the first and after the last.
Keyframes = list[tuple[Seconds, float]]

Floats = NDArray[np.float64]
#: Bounds of a recorded course of air.
MOST_BYTES = 64_000_000
MOST_SAMPLES = 1_000_000
HIGHEST_KPA = 10_000.0


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
    #: On fingertips without skin: from the offset in this direction the place is reached; by
    #: default along z, on a cylinder along x.
    z_mm: float = 0.0
    towards: tuple[float, float, float] | None = None


class Probe(_Table):
    """A flat object that presses. Exactly one of force, pressure and depth drives it.

    `part` is a part of skin, or a fingertip on a force/torque board.

    `kind` "disc" is any object; "grounded" one that is earthed, such as a hand, which is what
    a skin without its conductive cover feels.
    """

    part: str
    at: Place = field(default_factory=Place)
    kind: Literal["disc", "grounded"] = "disc"
    diameter_mm: Millimetres = 6.0
    #: Width and height of a rectangle (mm) instead of a disc.
    size_mm: tuple[Millimetres, Millimetres] | None = None
    turn_deg: float = 0.0
    force_n: Keyframes | None = None
    pressure_kpa: Keyframes | None = None
    depth_mm: Keyframes | None = None
    #: Spring in series with a depth: load cell, arm, or the object itself.
    compliance_mm_per_n: Annotated[float, Meta(ge=0, le=1000)] = 0.0
    #: The offset moves: time, x (mm), y (mm), added to the place.
    slide_mm: list[tuple[Seconds, float, float]] = []
    #: On fingertips with a force/torque board: an object hangs on the probe and is pulled along
    #: the surface by this force (N); what friction does not hold slides.
    tangential_n: Keyframes | None = None
    #: Direction of the pull, from the first of the two axes along the surface.
    tangential_deg: float = 0.0
    #: Coefficient of static friction between probe and fingertip.
    friction: Friction = 0.6
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

    keyframes_c: list[tuple[Seconds, Celsius]] = field(default_factory=lambda: [(0.0, 25.0)])


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
    #: Decay length of the surface around a contact, of real skin some 0.3 mm; 0 is a plain Winkler
    #: layer.
    membrane_mm: Annotated[float, Meta(ge=0, le=10)] = 0.0
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


def check_values(table: Scene | Probe) -> None:
    """Check what a program has made as what comes from a file is checked: types, bounds, numbers.

    Raises:
        ConfigurationError: names the key.
    """
    values = _as_read(msgspec.to_builtins(table, enc_hook=_plain))
    try:
        msgspec.convert(values, type(table))
    except msgspec.ValidationError as error:
        raise ConfigurationError(explain(values, error, type(table), {})) from None
    # A seed is no quantity, and values of faults have bounds of their own.
    others = {"seed": 0, "fault": [{**one, "value": None} for one in values.get("fault", [])]}
    for where, what in out_of_bounds({**values, **others}):
        raise ConfigurationError(f"{where}: {what}")


def _as_read(value: Any) -> Any:
    """Return values with lists for tuples, as a file has them."""
    if isinstance(value, dict):
        return {key: _as_read(inner) for key, inner in value.items()}
    return [_as_read(inner) for inner in value] if isinstance(value, list | tuple) else value


def _plain(value: object) -> object:
    """Return what numpy has made as Python's own numbers."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise ConfigurationError(f"seen {value!r}, wanted a value as of a file")


def check(scene: Scene) -> None:
    """Check the values of a scene, and properties that its types cannot express.

    Raises:
        ConfigurationError: names the key.
    """
    check_values(scene)
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
        _check_lasts(f"{where}.{drives[0]}", getattr(probe, drives[0]))
        _check_lasts(f"{where}.tangential_n", probe.tangential_n)
    for number, air in enumerate(scene.air):
        where = f"air[{number}]"
        if bool(air.file) == bool(air.pressure_kpa):
            raise ConfigurationError(f"{where}: wanted one of file and pressure_kpa")
        _check_times(f"{where}.pressure_kpa", [t_s for t_s, _ in air.pressure_kpa])
        if min((kpa for _, kpa in air.pressure_kpa), default=0.0) < 0:
            raise ConfigurationError(f"{where}.pressure_kpa: air cannot pull; wanted >= 0")
        if (most_kpa := max((kpa for _, kpa in air.pressure_kpa), default=0.0)) > HIGHEST_KPA:
            what = f"{most_kpa:g}; wanted up to {HIGHEST_KPA:g} kPa"
            raise ConfigurationError(f"{where}.pressure_kpa: {what}")
        if any(air.part == before.part for before in scene.air[:number]):
            raise ConfigurationError(f'{where}.part: "{air.part}" has air already; wanted one')
        if any(probe.part == air.part for probe in scene.probe):
            raise ConfigurationError(f'{where}.part: "{air.part}" has probes too; wanted one')
        _check_lasts(f"{where}.pressure_kpa", air.pressure_kpa)
    if not scene.temperature.keyframes_c:
        raise ConfigurationError("temperature.keyframes_c: is empty")
    _check_times("temperature.keyframes_c", [t_s for t_s, _ in scene.temperature.keyframes_c])


def _check_lasts(where: str, keyframes: Keyframes | None) -> None:
    """Check that keyframes do something: one alone is over when it begins."""
    if keyframes and len(keyframes) < 2:
        raise ConfigurationError(f"{where}: 1 keyframe, which is over at once; wanted at least two")


def _check_times(where: str, times_s: list[float]) -> None:
    if any(after < before for before, after in pairwise(times_s)):
        raise ConfigurationError(f"{where}: times run backwards")


@dataclass(frozen=True, slots=True)
class Slide:
    """How the c probes in contact slide: each straight on, until the next keyframe of any.

    Attributes:
        begin_s: float64[c], when the line of each probe began.
        begin_mm: float64[2, c], how far it had slid from its place then.
        mm_per_s: float64[2, c].
        moves: whether any of them slides.
    """

    begin_s: Floats
    begin_mm: Floats
    mm_per_s: Floats
    moves: bool

    def offset_mm(self, t_s: float) -> Floats:
        """How far each probe has slid from its place at `t_s`, [c, 2]."""
        offset_mm: Floats = (self.begin_mm + self.mm_per_s * (t_s - self.begin_s)).T
        return offset_mm


@dataclass(slots=True)
class Moment:
    """What presses at one time: arrays over the c probes in contact.

    Attributes:
        t_s: the time.
        number: intp[c], the probes.
        drive: float64[c], force (N) or depth (mm).
        slide: how they slide; the same object from keyframe to keyframe.
    """

    t_s: float
    number: NDArray[np.intp]
    drive: Floats
    slide: Slide

    @property
    def offset_mm(self) -> Floats:
        """How far each has slid from its place, [c, 2]."""
        return self.slide.offset_mm(self.t_s)


class Script:
    """The scene's probes over time. Time only goes forward; work is done where keyframes are."""

    def __init__(self, probes: list[Probe]) -> None:
        self._courses = [_Course.of(probe) for probe in probes]
        n = len(probes)
        #: The straight line that each probe follows now, as in `_Course`.
        self._lines = np.zeros((n, _LINE))
        self._touches = np.zeros(n, bool)
        self._gather()
        #: When the lines end, the next one first.
        self._ends = [(course.start_s, number) for number, course in enumerate(self._courses)]
        heapify(self._ends)

    def add_live(self) -> int:
        """One more probe, which `set_live` moves; its number."""
        self._lines = np.append(self._lines, np.zeros((1, _LINE)), axis=0)
        self._touches = np.append(self._touches, False)
        return len(self._touches) - 1

    def set_live(self, number: int, drive: float, x_mm: float, y_mm: float) -> None:
        """Let a live probe press like this from now on; a drive of 0 lifts it."""
        self._lines[number, 1:4] = drive, x_mm, y_mm
        self._touches[number] = drive > 0
        self._gather()

    def at(self, t_s: float) -> Moment:
        """What presses at `t_s`, which is not before that of the last call."""
        if self._ends and self._ends[0][0] <= t_s:
            while self._ends[0][0] <= t_s:
                number = self._ends[0][1]
                course = self._courses[number]
                self._lines[number], self._touches[number], end_s = course.at(t_s)
                heapreplace(self._ends, (end_s, number))
            self._gather()
        drive = self._drive + self._drive_rate * (t_s - self._slide.begin_s)
        return Moment(t_s, self._number, np.maximum(drive, 0.0), self._slide)

    def still_until_s(self, t_s: float) -> float:
        """After `at(t_s)`: when something may change next; `t_s` itself if it does now."""
        return t_s if self._moves else self.next_keyframe_s

    @property
    def next_keyframe_s(self) -> float:
        """After `at`: when the line of any probe ends next."""
        return self._ends[0][0] if self._ends else np.inf

    def _gather(self) -> None:
        """Collect the lines of the probes that touch."""
        self._number = np.flatnonzero(self._touches)
        lines = self._lines[self._number].T.copy()
        self._drive, self._drive_rate = lines[1], lines[4]
        self._slide = Slide(lines[0], lines[2:4], lines[5:7], bool(lines[5:7].any()))
        self._moves = self._slide.moves or bool(self._drive_rate.any())


#: Numbers of a line: when it began (s); drive, x and y (mm) there; their rates (1/s).
_LINE = 7


@dataclass(frozen=True, slots=True)
class _Course:
    """What a probe does, in straight lines: one before its first keyframe, one after the last.

    Attributes:
        start_s: when its keyframes begin to count.
        repeat_s: after which time they start again; 0 is never.
        ends_s: when each line is over, counted from the keyframes' zero.
        lines: float64[m, 7].
        touches: whether the probe presses on each of them.
    """

    start_s: float
    repeat_s: float
    ends_s: list[float]
    lines: Floats
    touches: list[bool]

    @classmethod
    def of(cls, probe: Probe) -> "_Course":
        """The course of a probe of a scene."""
        drive, slide = probe.drive, probe.slide_mm or [(0.0, 0.0, 0.0)]
        drive_s, slide_s = ([keyframe[0] for keyframe in keyframes] for keyframes in (drive, slide))
        begins_s = sorted({*drive_s, *slide_s})
        lines: list[tuple[float, ...]] = []
        touches: list[bool] = []
        for begin_s in (0.0, *begins_s):
            # The first line is that before all keyframes.
            before = not lines
            after = 0 if before else bisect_right(drive_s, begin_s)
            pressed, press_rate = _line(drive, after, begin_s)
            slid, slide_rate = _line(
                slide, 0 if before else bisect_right(slide_s, begin_s), begin_s
            )
            lines.append((begin_s, *pressed, *slid, *press_rate, *slide_rate))
            is_between = 0 < after < len(drive)
            touches.append(is_between and max(drive[after - 1][1], drive[after][1]) > 0)
        ends_s = [*begins_s, np.inf]
        return cls(probe.start_s, probe.repeat_s, ends_s, np.array(lines), touches)

    def at(self, t_s: float) -> tuple[Floats, bool, float]:
        """The line on which `t_s` lies, whether the probe presses, and when the line ends."""
        # A nanosecond ahead, so that rounding never finds a line that is over.
        since_s = t_s - self.start_s + 1e-9
        cycle_s = since_s // self.repeat_s * self.repeat_s if self.repeat_s else 0.0
        zero_s = self.start_s + cycle_s
        number = bisect_right(self.ends_s, since_s - cycle_s)
        end_s = self.ends_s[number]
        line = self.lines[number].copy()
        line[0] += zero_s
        return line, self.touches[number], zero_s + min(end_s, self.repeat_s or end_s)


def _line(
    keyframes: Sequence[tuple[float, ...]], after: int, t_s: float
) -> tuple[list[float], list[float]]:
    """Values at `t_s`, and their rates of change, where keyframe `after` is the next."""
    low_s, *low = keyframes[max(after - 1, 0)]
    high_s, *high = keyframes[min(after, len(keyframes) - 1)]
    if not 0 < after < len(keyframes):
        return low, [0.0] * len(low)
    rates = [(end - begin) / (high_s - low_s) for begin, end in zip(low, high, strict=True)]
    values = [begin + rate * (t_s - low_s) for begin, rate in zip(low, rates, strict=True)]
    return values, rates


class AirCourse:
    """Pressure of air over time: straight lines between samples, nothing before and after them.

    Args:
        times_s: float64[m], not falling.
        pressure_kpa: float64[m].
    """

    def __init__(self, times_s: Floats, pressure_kpa: Floats) -> None:
        self._times_s = times_s
        self._kpa = pressure_kpa

    @classmethod
    def of(cls, keyframes: Sequence[tuple[float, float]], start_s: float) -> "AirCourse":
        """Return the course of a scene's keyframes (s, kPa), which count from `start_s`."""
        times_s, kpa = np.array(keyframes, np.float64).reshape(-1, 2).T
        return cls(times_s + start_s, kpa)

    @property
    def start_s(self) -> float:
        """When it begins."""
        return float(self._times_s[0])

    @property
    def end_s(self) -> float:
        """When it is over."""
        return float(self._times_s[-1])

    def kpa_at(self, t_s: float) -> float:
        """Pressure at a time."""
        return float(np.interp(t_s, self._times_s, self._kpa, left=0.0, right=0.0))


def read_air(path: Path) -> list[tuple[float, float]]:
    """Read a recorded course: time from 0 (s) and pressure (kPa).

    A CSV file has the head `time_s,pressure_kpa`; an .npz file the arrays `t_s` and
    `pressure_kpa`, paired by index. Times count from the first. A sample that differs from both
    its neighbours is a spike of the sensor: each is replaced by the median of the three.

    Raises:
        ConfigurationError: unreadable, or not such a course.
    """
    try:
        data = io.BytesIO(read_whole(path, MOST_BYTES))
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        times_s, kpa = _npz(data) if path.suffix == ".npz" else _csv(data)
    except Exception as error:  # of zip, of each way of compression, of arrays
        reason = visible(str(error).partition("\n")[0] or type(error).__name__, 200)
        raise ConfigurationError(
            f"{path}: {reason}; wanted time_s,pressure_kpa or an .npz of t_s and pressure_kpa"
        ) from None
    if not 1 < len(times_s) <= MOST_SAMPLES:
        raise ConfigurationError(f"{path}: {len(times_s)} samples; wanted 2 to {MOST_SAMPLES}")
    if not np.isfinite(times_s).all() or (np.diff(times_s) < 0).any():
        raise ConfigurationError(f"{path}: times run backwards or are no numbers")
    if not np.isfinite(kpa).all() or np.abs(kpa).max() > HIGHEST_KPA:
        raise ConfigurationError(f"{path}: pressure is no number, or beyond {HIGHEST_KPA:g} kPa")
    before, after = np.append(kpa[:1], kpa[:-1]), np.append(kpa[1:], kpa[-1:])
    kpa = np.maximum(np.median([before, kpa, after], axis=0), 0.0)
    return list(zip((times_s - times_s[0]).tolist(), kpa.tolist(), strict=True))


def _npz(data: io.BytesIO) -> tuple[Floats, Floats]:
    with zipfile.ZipFile(data) as file:
        times_s, kpa = (_array(file, f"{name}.npy") for name in ("t_s", "pressure_kpa"))
    if times_s.ndim != 1 or kpa.ndim != 1:
        raise ValueError("t_s or pressure_kpa is no row of numbers")
    n = min(len(times_s), len(kpa))
    return times_s[:n], kpa[:n]


def _array(file: zipfile.ZipFile, name: str) -> Floats:
    """Read an array, unless it is larger than any course: a few bytes may become gigabytes."""
    with file.open(name) as member:
        version = np.lib.format.read_magic(member)
        read_head = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        shape, _, kind = read_head(member)
    if math.prod(shape) > MOST_SAMPLES:
        raise ValueError(f"{name}: {shape} numbers, wanted up to {MOST_SAMPLES}")
    if kind.kind not in "iuf":
        raise ValueError(f"{name}: {kind}, wanted numbers")
    with file.open(name) as member:
        return np.asarray(np.lib.format.read_array(member, allow_pickle=False), np.float64)


def _csv(data: io.BytesIO) -> tuple[Floats, Floats]:
    with io.TextIOWrapper(data, encoding="utf-8") as file:
        head = file.readline(200).strip()
        if head != "time_s,pressure_kpa":
            raise ValueError(f'begins with "{head[:40]}"')
        table = np.loadtxt(file, delimiter=",", ndmin=2, max_rows=MOST_SAMPLES + 1)
    if table.shape[1:] != (2,):
        raise ValueError(f"{table.shape[-1]} columns")
    return table[:, 0], table[:, 1]


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

    Of normals [3, k] they are [2, 3, k].

    The basis of Duff et al., "Building an Orthonormal Basis, Revisited" (2017), which stays
    exact in every direction.
    """
    x, y, z = normal
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    return np.array(
        [[1 + sign * x * x * a, sign * x * y * a, -sign * x], [x * y * a, sign + y * y * a, -y]]
    )
