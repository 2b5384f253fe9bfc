"""Fingertips on force/torque boards: the load of probes, as their boards measure it.

A probe of the scene presses along the inward normal at its place; where it is also pulled along
the surface, it carries an object that sticks and slips (`held_objects`). The board measures force
and torque about its own origin, along its own axes, with an offset.

The firmware of such a board (STRAIN2) is emulated as far as a host needs it: it takes the commands
of discovery, version, mode, period and full scales, none of its calibration and amplifiers, and
streams force and torque of the load that is laid on it. It makes its own bytes: host and board
share no encoder.
"""

import struct
from bisect import bisect_left
from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator.probes.held_objects import Friction, HeldObjects
from emulator.probes.scene import Keyframes, Probe, Scene, resolve, tangents
from skin_host.bus.commands import (
    SetTransmissionPeriod,
    SetTxMode,
    TxMode,
    command_frame,
)
from skin_host.bus.wire import (
    BROADCAST_ADDRESS,
    HOST_ADDRESS,
    FrameBatch,
    MessageClass,
    identifier,
)
from skin_host.config.fingertips import Fingertip
from skin_host.config.settings import Settings
from skin_host.errors import ConfigurationError
from skin_host.layout import Layout

Floats = NDArray[np.float64]
Frame = tuple[int, bytes]

NEVER_NS = 1 << 62
_NOTHING = np.zeros(6)
_NOTHING.flags.writeable = False
#: N and N m of the channels of a board that the configuration leaves open.
FULL_SCALE = (50.0, 50.0, 50.0, 1.0, 1.0, 1.0)
#: Directions in which a place of each shape is reached from its middle, and where places are.
TOWARDS = {
    "sphere": (0.0, 0.0, 1.0),
    "ellipsoid": (0.0, 0.0, 1.0),
    "plane": (0.0, 0.0, 1.0),
    "cylinder": (1.0, 0.0, 0.0),
}
_WANTED = {
    "sphere": "a place inside it",
    "ellipsoid": "a place inside it",
    "plane": "a place within its reach_mm",
    "cylinder": "a place inside it, within its half_length_mm, and a direction that is not along z",
}
#: Unloaded boards read up to this share of their full scale.
OFFSET_SHARE = 0.01
#: Mass of the object that the probe pulls.
OBJECT_KG = 0.2
SLIDING_SHARE = 0.85
#: Inner step of its motion; the contact's spring swings at some 16 Hz.
STEP_S = 1e-3
#: It is moved through no more than this of a time in which no board measured: then it rests, or is
#: lost.
MOST_UNSEEN_S = 1.0
NS_PER_MS = 1_000_000
#: Loads that boards measured are known for so long at least.
LATELY_NS = 1_000_000_000
_WORDS = struct.Struct("<3H")
_SET_MODE, _SET_PERIOD, _GET_FULL_SCALE, _GET_VERSION = 0x07, 0x08, 0x18, 0x1C
_STOP = 1
#: Lowest bit of the types of frames with force, and with torque.
FORCE, TORQUE = 0, 1
#: Command FF of class 7, "who is there?". The answer is FF, type of board STRAIN2, firmware; that
#: to 1C has the version of the protocol behind them.
_DISCOVER = 0xFF
_IDENTITY = bytes([12, 2, 0, 9])
_PROTOCOL = (2, 0)
#: Frames of each mode: pairs of types (force, torque), and whether they are calibrated.
_STREAMS: dict[int, list[tuple[int, int, bool]]] = {
    0: [(0xA, 0xB, True)],
    1: [],
    3: [(0x8, 0x9, False)],
    4: [(0xA, 0xB, True), (0x8, 0x9, False)],
}


class StrainBoard:
    """One board.

    Args:
        address: 1..14.
        load: gives force (N) and torque (N m) float64[6] on the sensor at a time in ns.
        rng: draws the noise.
        full_scale: N and N m of each of the six channels; whole numbers are reported, of 16 bits.
        noise_share: standard deviation of a channel, as a share of its full scale. With none, the
            last bit of each word is 0 and 1 in turns: that of a converter is never still.
        torque_first: sends torque before force; the order is not promised.

    Attributes:
        latched: of `FORCE` and `TORQUE`, what it repeats instead of measuring it.
    """

    def __init__(
        self,
        address: int,
        load: Callable[[int], ArrayLike],
        rng: np.random.Generator,
        *,
        full_scale: tuple[float, ...] = (2000, 2000, 2000, 40, 40, 40),
        noise_share: float = 5e-5,
        torque_first: bool = False,
    ) -> None:
        self.address = address
        self.period_ms = 10
        self.next_ns: int | None = None
        self._load = load
        self._rng = rng
        self._full_scale = np.array(full_scale, np.float64)
        self._noise_share = noise_share
        self._torque_first = torque_first
        self._mode = _STOP
        self.latched: set[int] = set()
        #: By their types, the data of its last frames.
        self._sent: dict[int, bytes] = {}
        self._mixing = np.eye(6) + 0.1 * rng.normal(size=(6, 6))

    @property
    def off(self) -> Floats:
        """Standard deviation of the noise of each channel and one unit, float64[6] (N, N m)."""
        off: Floats = self._full_scale * (self._noise_share + 1 / 0x8000)
        return off

    def handle(self, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        """Take a frame from the bus, to this board or to all; give what it sends back."""
        if can_id & 0xF not in {self.address, BROADCAST_ADDRESS}:
            return []
        message_class = MessageClass(can_id >> 8 & 7)
        if can_id != identifier(message_class, HOST_ADDRESS, can_id & 0xF):
            return []
        answer = identifier(message_class, self.address, HOST_ADDRESS)
        if message_class == MessageClass.MANAGEMENT and data[:1] == bytes([_DISCOVER]):
            return [(answer, bytes([_DISCOVER]) + _IDENTITY)]
        if message_class != MessageClass.ANALOG_COMMAND or len(data) < 2:
            return []
        command, argument = data[0], data[1]
        if command == _SET_MODE:
            # A mode that it does not have stops it.
            self._mode = argument if argument in _STREAMS else _STOP
            self.next_ns = None if self._mode == _STOP else t_ns + self.period_ms * NS_PER_MS
        elif command == _SET_PERIOD and argument > 0:
            self.period_ms = argument
        elif command == _GET_FULL_SCALE and argument < 6:
            high, low = divmod(min(round(self._full_scale[argument]), 0xFFFF), 256)
            return [(answer, bytes([_GET_FULL_SCALE, argument, high, low]))]
        elif command == _GET_VERSION and len(data) > 2:
            major, minor = _PROTOCOL
            fits = argument == major and data[2] <= minor
            return [(answer, bytes([_GET_VERSION]) + _IDENTITY + bytes([major, minor, fits]))]
        return []

    def step(self, t_ns: int) -> FrameBatch:
        """Bring the board to `t_ns` and give the frames that it sends by then."""
        frames: list[tuple[int, bytes, int]] = []
        while self.next_ns is not None and self.next_ns <= t_ns:
            frames += self._sample(self.next_ns)
            self.next_ns += self.period_ms * NS_PER_MS
        return FrameBatch.of(frames)

    def _sample(self, t_ns: int) -> list[tuple[int, bytes, int]]:
        share = np.asarray(self._load(t_ns), np.float64) / self._full_scale
        share = share + self._noise(t_ns)
        frames = []
        for force_type, torque_type, calibrated in _STREAMS[self._mode]:
            values = share if calibrated else self._mixing @ share
            # Plain numbers: numpy takes several times as long for six.
            counts = (np.round(values * 0x8000) + 0x8000).tolist()
            pair = [(force_type, counts[:3]), (torque_type, counts[3:])]
            for delay, (kind, three) in enumerate(reversed(pair) if self._torque_first else pair):
                data = _WORDS.pack(*(min(max(int(count), 0), 0xFFFF) for count in three))
                flags = sum(1 << i for i, count in enumerate(three) if not 0 <= count <= 0xFFFF)
                if flags:
                    data += bytes([flags])
                if kind & 1 in self.latched:
                    data = self._sent.get(kind, data)
                self._sent[kind] = data
                frames.append(
                    (
                        identifier(MessageClass.ANALOG_STREAM, self.address, kind),
                        data,
                        t_ns + 130_000 * delay,  # a frame of 6 bytes lasts this long at 1 Mbit/s
                    )
                )
        return frames

    def _noise(self, t_ns: int) -> Floats:
        """Noise of a sample, as shares of the full scales."""
        if not self._noise_share:
            number = t_ns // (self.period_ms * NS_PER_MS)
            return np.full(6, number % 2 / 0x8000)
        return self._noise_share * self._rng.normal(size=6)


class Pressed(NamedTuple):
    """What one probe does to a fingertip: in the fingertip's frame, float64[3] each.

    Attributes:
        normal_n: force (N) into the surface.
        point_mm, normal: where it presses, and the outward normal there.
    """

    normal_n: float
    point_mm: Floats
    normal: Floats


class Loaded(NamedTuple):
    """The load of a fingertip when its board measured it.

    Attributes:
        t_ns: time of the sample.
        wrench: force (N) and torque (N m) on the fingertip about its origin, float64[6].
        presses: of the probes that press it.
    """

    t_ns: int
    wrench: Floats
    presses: list[Pressed]


class Fingertips:
    """The force/torque boards of a robot and what lies on them.

    Args:
        settings, layout: of the robot.
        scene: its probes on fingertips and on parts that cover one.
        skin_force_n: force (N) of each probe on the skin now, by its number in the scene.

    Attributes:
        boards: by name of the fingertip.
        hung: names of those whose boards neither receive nor send.
        lately: by name, the loads that its board measured in the last `LATELY_NS`, and some before.

    Raises:
        ConfigurationError: a probe cannot be on its fingertip; the message names the key.
    """

    def __init__(
        self,
        settings: Settings,
        layout: Layout,
        scene: Scene,
        skin_force_n: Callable[[], dict[int, float]],
    ) -> None:
        self.boards: dict[str, StrainBoard] = {}
        self.hung: set[str] = set()
        self.lately: dict[str, list[Loaded]] = {}
        self._tips = settings.fingertips
        self._skin_force_n = skin_force_n
        self._presses: dict[str, list[_Press]] = {}
        for number, (name, tip) in enumerate(settings.fingertips.items()):
            presses = self._presses[name] = []
            for i, probe in enumerate(scene.probe):
                if probe.part not in (name, tip.array):
                    continue
                force_n = None if probe.part == name else partial(self._force_on_skin, i)
                try:
                    presses.append(self._press(name, tip, probe, layout, force_n))
                except ConfigurationError as error:
                    raise ConfigurationError(f"probe[{i}].{error}") from None
            rng = np.random.default_rng([scene.seed, 6, number])
            scale = np.array(tip.full_scale or FULL_SCALE)
            lately: list[Loaded] = []
            self.lately[name] = lately
            self.boards[name] = StrainBoard(
                tip.address,
                _Load(tip, presses, OFFSET_SHARE * rng.uniform(-1, 1, 6) * scale, lately),
                rng,
                full_scale=tuple(scale),
                noise_share=5e-5 if scene.noise else 0.0,
            )

    @property
    def due_ns(self) -> int:
        """When the next board samples."""
        return min(
            (
                board.next_ns
                for name, board in self.boards.items()
                if board.next_ns is not None and name not in self.hung
            ),
            default=NEVER_NS,
        )

    def start(self, t_ns: int) -> None:
        """Let all boards send, at the periods of the configuration, for use without a host."""
        for name, board in self.boards.items():
            for message in (
                SetTransmissionPeriod(self._tips[name].period_ms),
                SetTxMode(TxMode.START),
            ):
                board.handle(*command_frame(message, board.address), t_ns)

    def revive(self, name: str, t_ns: int) -> None:
        """A board that was hung goes on: it samples from now on, and sends nothing of before."""
        self.hung.discard(name)
        board = self.boards[name]
        if board.next_ns is not None:
            board.next_ns = max(board.next_ns, t_ns)

    def slipped_mm(self, name: str) -> float:
        """How far what presses on a fingertip has slid over it since it was put there."""
        return max((press.slipped_mm for press in self._presses[name]), default=0.0)

    def force_n(self, name: str, t_ns: int) -> Floats:
        """Force (N) of all that presses on a fingertip at a time, float64[3]."""
        force: Floats = sum((press.wrench(t_ns)[:3] for press in self._presses[name]), np.zeros(3))
        return force

    def step(self, t_ns: int) -> list[tuple[str, FrameBatch]]:
        """Bring all boards to `t_ns`; the frames that they send, by bus."""
        return [
            (self._tips[name].bus, board.step(t_ns))
            for name, board in self.boards.items()
            if name not in self.hung
        ]

    def handle(self, bus: str, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        """A frame from the host; what the boards answer."""
        return [
            answer
            for name, board in self.boards.items()
            if self._tips[name].bus == bus and name not in self.hung
            for answer in board.handle(can_id, data, t_ns)
        ]

    def off(self, name: str) -> tuple[float, float]:
        """How far off a sample of the load of one is without its offset: force (N), torque (N m).

        One standard deviation of noise and one unit of the words, of the largest channels.
        """
        off = self.boards[name].off
        force_n, torque_nm = float(off[:3].max()), float(off[3:].max())
        arm_m = 1e-3 * float(np.linalg.norm(self._tips[name].sensor_mm))
        return force_n, torque_nm + arm_m * force_n

    def _force_on_skin(self, number: int) -> float:
        return self._skin_force_n().get(number, 0.0)

    def touch(
        self,
        probe: Probe,
        layout: Layout,
        force_n: Callable[[], float],
        pull_n: Callable[[], float | None],
    ) -> None:
        """Add a probe that a program moves, if it is on a fingertip.

        Args:
            probe: its keyframes are not used.
            layout: of the skin.
            force_n: returns with what force it presses now.
            pull_n: returns with what force an object that hangs on it is pulled along the surface
                now; None if there is none.

        Raises:
            ConfigurationError: it cannot be on its fingertip.
        """
        for name, tip in self._tips.items():
            if probe.part in (name, tip.array):
                press = self._press(name, tip, probe, layout, force_n, pull_n)
                self._presses[name].append(press)

    @staticmethod
    def _press(
        name: str,
        tip: Fingertip,
        probe: Probe,
        layout: Layout,
        force_n: Callable[[], float] | None,
        pull_n: Callable[[], float | None] | None = None,
    ) -> "_Press":
        if probe.part == name:
            if tip.array is not None:
                raise ConfigurationError(f'part: "{name}" is covered by "{tip.array}"; name that')
            if probe.by_depth:
                raise ConfigurationError("depth_mm: a fingertip without skin is driven by a force")
            point_mm, normal = place_on(tip, probe)
        else:
            point_m, normal = resolve(probe.at, probe.part, layout)
            point_mm = 1e3 * point_m
        _check_slide(tip, probe, point_mm, normal)
        return _Press(probe, point_mm, normal, force_n, pull_n)


class _Press:
    """One probe on a fingertip, and the object that its pull hangs on.

    Args:
        probe: of it.
        point_mm, normal: its place.
        force_n: returns with what force it presses now; by the probe's keyframes if None.
        pull_n: the same of the pull.
    """

    def __init__(
        self,
        probe: Probe,
        point_mm: Floats,
        normal: Floats,
        force_n: Callable[[], float] | None,
        pull_n: Callable[[], float | None] | None,
    ) -> None:
        self._probe = probe
        self._point_mm = point_mm
        self._normal = normal
        self._along = tangents(normal)
        self._force_n = force_n
        self._pull_n = pull_n
        turn = np.deg2rad(probe.tangential_deg)
        self._pull = np.cos(turn) * self._along[0] + np.sin(turn) * self._along[1]
        self._object: HeldObjects | None = None
        self._last_ns = 0
        #: What it does since the last `wrench`; None if it does not press.
        self.pressed: Pressed | None = None

    @property
    def slipped_mm(self) -> float:
        """How far its object has slid."""
        return 0.0 if self._object is None else float(self._object.slipped_mm[0])

    def wrench(self, t_ns: int) -> Floats:
        """Force (N) and torque (N m) on the fingertip about its origin, float64[6]."""
        probe = self._probe
        phase_s = 1e-9 * t_ns - probe.start_s
        if probe.repeat_s and phase_s >= 0.0:
            phase_s %= probe.repeat_s
        normal_n = _value(probe.drive, phase_s) if self._force_n is None else self._force_n()
        if normal_n == 0.0:
            self._object = self.pressed = None
            return _NOTHING
        force = -normal_n * self._normal
        pull_n: float | None = None
        if self._pull_n is not None:
            pull_n = self._pull_n()
        elif probe.tangential_n is not None:
            pull_n = _value(probe.tangential_n, phase_s)
        if pull_n is not None:
            force = force + self._held_n(normal_n, pull_n, t_ns) * self._pull
        offset = np.zeros(2)
        if probe.slide_mm:
            times, x_mm, y_mm = np.array(probe.slide_mm).T
            offset = np.array([np.interp(phase_s, times, x_mm), np.interp(phase_s, times, y_mm)])
        point_mm = self._point_mm + offset @ self._along
        self.pressed = Pressed(normal_n, point_mm, self._normal)
        x, y, z = (1e-3 * point_mm).tolist()
        fx, fy, fz = force.tolist()
        return np.array([fx, fy, fz, y * fz - z * fy, z * fx - x * fz, x * fy - y * fx])

    def _held_n(self, normal_n: float, pull_n: float, t_ns: int) -> float:
        """Tangential force (N) by which the object drags at the fingertip."""
        dt_s = min(1e-9 * (t_ns - self._last_ns), MOST_UNSEEN_S)
        self._last_ns = t_ns
        if normal_n <= 0.0:
            self._object = None
            return 0.0
        if self._object is None:
            static = self._probe.friction
            law = Friction(static=static, sliding=SLIDING_SHARE * static)
            self._object = HeldObjects(1, law, mass_kg=OBJECT_KG, dt_s=STEP_S)
            dt_s = 0.0
        return float(self._object.advance([pull_n], [normal_n], dt_s)[0])


class _Load:
    """What a board measures: force (N) and torque (N m) of its channels, with its offset."""

    def __init__(
        self,
        tip: Fingertip,
        presses: Sequence[_Press],
        offset: Floats,
        lately: list[Loaded],
    ) -> None:
        self._presses = presses
        self._offset = offset
        self._lately = lately
        x, y, z = (1e-3 * np.array(tip.sensor_mm)).tolist()
        about_sensor = np.eye(6)
        about_sensor[3:, :3] -= [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
        self._to_board = (
            about_sensor if tip.matrix is None else np.linalg.inv(tip.matrix) @ about_sensor
        )

    def __call__(self, t_ns: int) -> Floats:
        load = _NOTHING
        pressed: list[Pressed] = []
        for press in self._presses:
            wrench = press.wrench(t_ns)
            if press.pressed is not None:
                load = load + wrench
                pressed.append(press.pressed)
        lately = self._lately
        lately.append(Loaded(t_ns, load, pressed))
        if lately[0].t_ns < t_ns - 2 * LATELY_NS:
            del lately[: bisect_left(lately, t_ns - LATELY_NS, key=itemgetter(0))]
        if not pressed:
            return self._offset
        measured: Floats = self._to_board @ load + self._offset
        return measured


def place_on(tip: Fingertip, probe: Probe) -> tuple[Floats, Floats]:
    """Where a probe presses on a bare fingertip: point (mm) and outward normal, float64[3].

    The ray from the place's offset (x, y, z in the fingertip's frame) `towards`, by default as in
    `TOWARDS`, leaves the body there.

    Raises:
        ConfigurationError: it does not, or the place names what a fingertip does not have.
    """
    at = probe.at
    if at.taxel is not None or at.triangle is not None:
        raise ConfigurationError("at: a fingertip without skin has no taxels and no triangles")
    origin = np.array([at.x_mm, at.y_mm, at.z_mm])
    towards = np.array(at.towards or TOWARDS[tip.shape])
    size = float(np.linalg.norm(towards))
    if size == 0.0:
        raise ConfigurationError("at.towards: is no direction")
    point = _crossing(tip, origin, towards / size)
    if point is None:
        seen = [", ".join(f"{value:g}" for value in vector) for vector in (origin, towards)]
        raise ConfigurationError(
            f'at: the {tip.shape} "{probe.part}" is not reached from {seen[0]} mm in the direction '
            f"{seen[1]}; wanted {_WANTED[tip.shape]}"
        )
    if tip.shape == "plane":
        return point, np.array([0.0, 0.0, 1.0])
    gradient = _weight(tip) * point
    return point, gradient / np.linalg.norm(gradient)


def _weight(tip: Fingertip) -> Floats:
    """Of the squares of x, y, z (mm), whose weighted sum is 1 on the surface; of no plane."""
    if tip.semi_axes_mm is not None:
        return np.array(tip.semi_axes_mm) ** -2.0
    weight = np.full(3, float(tip.radius_mm or 1.0) ** -2.0)
    if tip.shape == "cylinder":
        weight[2] = 0.0
    return weight


def _crossing(tip: Fingertip, origin: Floats, ray: Floats) -> Floats | None:
    """Where a ray from a place leaves the body of a fingertip (mm); None if it does not.

    On a plane: below the place, whatever the ray.
    """
    if tip.shape == "plane":
        within = np.hypot(origin[0], origin[1]) <= (tip.reach_mm or np.inf)
        return np.array([origin[0], origin[1], 0.0]) if within else None
    weight = _weight(tip)
    a, b = float(weight @ ray**2), float(weight @ (origin * ray))
    c = float(weight @ origin**2) - 1.0
    if b * b - a * c < 0.0 or a <= 1e-12 * weight.max():
        return None
    point: Floats = origin + (-b + np.sqrt(b * b - a * c)) / a * ray
    return point if abs(point[2]) <= (tip.half_length_mm or np.inf) else None


def _check_slide(tip: Fingertip, probe: Probe, point_mm: Floats, normal: Floats) -> None:
    """Check that a probe stays on its fingertip: seen along its normal, bodies are convex.

    Raises:
        ConfigurationError: it does not.
    """
    along = tangents(normal)
    for _, x_mm, y_mm in probe.slide_mm:
        if _crossing(tip, point_mm + np.array([x_mm, y_mm]) @ along, normal) is None:
            raise ConfigurationError(
                f"slide_mm: {x_mm:g} mm, {y_mm:g} mm; the fingertip is not below that place; "
                "wanted a slide that stays on it"
            )


def _value(keyframes: Keyframes, t_s: float) -> float:
    """Straight lines between keyframes; 0 before the first and after the last."""
    times = [at_s for at_s, _ in keyframes]
    if not times or not times[0] <= t_s <= times[-1]:
        return 0.0
    return float(np.interp(t_s, times, [value for _, value in keyframes]))
