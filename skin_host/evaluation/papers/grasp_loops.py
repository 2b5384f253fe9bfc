"""Three-axis optical fingertips, and closed loops of fingers and objects (Ohka et al.).

A camera along z sees the feet of each rubber element as bright spots. The grey-value sum gives the
normal force, by two straight lines; the displacement of the centroid gives the shear, in
proportion. Away from the vertex the picture is foreshortened and is put right first.

A held object under a rising load; a bottle's cap that two round fingertips close, whose contacts
stick and slip as in `emulator.probes.held_objects`; how soon a slip is found, and how often one is
reported for nothing. Lengths in mm, forces in N, time in s.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator.probes.held_objects import Friction, HeldObjects, StickSlip
from skin_host.errors import CalibrationError
from skin_host.evaluation.papers.truth import OpticalDome
from skin_host.fingertip.grasp import FingerFlags, Flags, GraspThresholds
from skin_host.fingertip.slip import RatioDrop, ShearRate, friction_used

Floats = NDArray[np.float64]

#: Force sensors are read at the servo rate of Son et al., cameras at a video rate.
FORCE_HZ = 300.0
CAMERA_HZ = 30.0
#: 0.4 units of the skin are this much force on one of its pads: 2.345 kPa times 13.9 mm2.
NOISE_N = 0.4 * 2.345e-3 * np.pi * 2.1**2
#: Thresholds under test: rate of the shear force, and safe share of known friction.
SHEAR_RATE_N_S = 6.0
SAFE_SHARE = 0.8
DETECTORS = ("shear rate", "ratio drop", "known friction")
#: Rings of the dome: elements, and angle from the vertex. The counts follow from Ohka et al.:
#: elements 0, 1, 5, 9, 17, 25, 33 lie on one great circle and 9 and 17 on one latitude.
#: The angles are not printed; these space the elements about evenly.
DOME_RINGS = ((1, 0.0), (8, 20.0), (16, 40.0), (16, 60.0))


@dataclass(frozen=True, slots=True)
class DomeLayout:
    """Elements on a hemisphere, seen by a camera along z (Ohka et al., Figs. 3 and 7).

    Attributes:
        azimuth_rad, latitude_rad: float64[n]; the vertex is at latitude pi / 2.
        position_mm: float64[n, 3], roots of the elements on the dome.
        normal, south, east: float64[n, 3], axes z_i, x_i, y_i of each element's own frame.
    """

    azimuth_rad: Floats
    latitude_rad: Floats
    position_mm: Floats
    normal: Floats
    south: Floats
    east: Floats


def dome(radius_mm: float = 20.0, rings: tuple[tuple[int, float], ...] = DOME_RINGS) -> DomeLayout:
    """The dome of 41 elements of Ohka et al., or another one."""
    azimuth = np.concatenate([2.0 * np.pi * np.arange(count) / count for count, _ in rings])
    from_vertex = np.deg2rad(np.concatenate([np.full(count, angle) for count, angle in rings]))
    ca, sa, cv, sv = np.cos(azimuth), np.sin(azimuth), np.cos(from_vertex), np.sin(from_vertex)
    normal = np.stack([sv * ca, sv * sa, cv], axis=1)
    return DomeLayout(
        azimuth_rad=azimuth,
        latitude_rad=0.5 * np.pi - from_vertex,
        position_mm=radius_mm * normal,
        normal=normal,
        south=np.stack([cv * ca, cv * sa, -sv], axis=1),
        east=np.stack([-sa, ca, np.zeros_like(ca)], axis=1),
    )


@dataclass(frozen=True, slots=True)
class Bilinear:
    """Force = lower * G up to the knot, and from there on with slope `upper` (Fig. 10).

    Attributes:
        knot: grey-value sum where the lines meet.
        lower, upper: N per unit of G; positive, so the curve rises throughout.
        correlation: of fitted and known forces.
    """

    knot: float
    lower: float
    upper: float
    correlation: float

    def force_n(self, grey: ArrayLike) -> Floats:
        """Normal force, N, of grey-value sums; no sum below zero is a force."""
        g = np.maximum(np.asarray(grey, np.float64), 0.0)
        force: Floats = self.lower * np.minimum(g, self.knot) + self.upper * np.maximum(
            g - self.knot, 0.0
        )
        return force


def fit_bilinear(grey: ArrayLike, force_n: ArrayLike) -> Bilinear:
    """Fit two lines through zero that meet at a free knot, by least squares.

    Between two neighbouring readings the error is smooth in the knot, so every such gap
    is searched by golden section around the best of the readings.

    Args:
        grey: [k], sums above the unloaded one.
        force_n: [k], the known normal forces.

    Raises:
        CalibrationError: fewer than 5 different readings, or a curve that falls.
    """
    g, f = np.asarray(grey, np.float64), np.asarray(force_n, np.float64)
    good = np.isfinite(g) & np.isfinite(f)
    g, f = g[good], f[good]
    candidates = np.unique(g[g > 0.0])
    if len(candidates) < 5:
        raise CalibrationError(
            f"three-axis element: {len(candidates)} different grey-value sums above zero; "
            "wanted at least 5 loads"
        )

    def solve(knot: float) -> tuple[float, float, float]:
        design = np.column_stack([np.minimum(g, knot), np.maximum(g - knot, 0.0)])
        slopes = np.linalg.lstsq(design, f, rcond=None)[0]
        return float(((f - design @ slopes) ** 2).sum()), float(slopes[0]), float(slopes[1])

    inner = candidates[1:-1]
    place = int(np.argmin([solve(float(knot))[0] for knot in inner])) + 1
    low, high = float(candidates[place - 1]), float(candidates[place + 1])
    golden = 0.5 * (np.sqrt(5.0) - 1.0)
    while high - low > 1e-9 * candidates[-1]:
        left, right = high - golden * (high - low), low + golden * (high - low)
        if solve(left)[0] <= solve(right)[0]:
            high = right
        else:
            low = left
    knot = 0.5 * (low + high)
    _, lower, upper = solve(knot)
    if lower <= 0.0 or upper <= 0.0:
        raise CalibrationError(
            f"three-axis element: slopes {lower:.3g} and {upper:.3g} N per unit; "
            "wanted a grey-value sum that rises with the load"
        )
    fitted = Bilinear(knot, lower, upper, 1.0)
    correlation = float(np.corrcoef(fitted.force_n(g), f)[0, 1])
    return Bilinear(knot, lower, upper, correlation)


def fit_shear(displacement: ArrayLike, force_n: ArrayLike) -> float:
    """Shear force per displacement of the centroid, N per its unit; one line through zero.

    One number does for all inclinations between 15 and 60 degrees (Fig. 12).

    Raises:
        CalibrationError: no displacement at all, or one against the force.
    """
    u, f = np.ravel(np.asarray(displacement, np.float64)), np.ravel(np.asarray(force_n))
    square = float(u @ u)
    stiffness = float(u @ f) / square if square > 0.0 else 0.0
    if stiffness <= 0.0:
        raise CalibrationError(
            "three-axis element: the centroid does not move along with the shear force"
        )
    return stiffness


def in_element_frame(
    layout: DomeLayout, grey: ArrayLike, centroid: ArrayLike
) -> tuple[Floats, Floats]:
    """What a camera looking at each element along its own normal would see (eqs. 4-6).

    With azimuth theta and latitude phi:  g_i = g / sin phi,
    u_south = (u_x cos theta + u_y sin theta) / sin phi,  u_east = -u_x sin theta + u_y cos theta.
    Eqs. 5-6 as printed use phi for both angles and have lost the minus sign.

    Args:
        layout: of the n elements.
        grey: [..., n], grey-value sums.
        centroid: [..., n, 2], displacements in the picture.

    Returns:
        Sums [..., n] and displacements [..., n, 2] towards south and east.
    """
    g, u = np.asarray(grey, np.float64), np.asarray(centroid, np.float64)
    sine = np.sin(layout.latitude_rad)
    cos, sin = np.cos(layout.azimuth_rad), np.sin(layout.azimuth_rad)
    south = (u[..., 0] * cos + u[..., 1] * sin) / sine
    east = -u[..., 0] * sin + u[..., 1] * cos
    return g / sine, np.stack([south, east], axis=-1)


class ThreeAxisSensor:
    """Calibrated elements on a dome.

    Args:
        layout: of the n elements.
        normal: calibration of each element; they differ even on one latitude.
        shear_n_per_unit: common, or one for each element.
    """

    def __init__(
        self, layout: DomeLayout, normal: list[Bilinear], shear_n_per_unit: ArrayLike
    ) -> None:
        n = len(layout.latitude_rad)
        if len(normal) != n:
            raise CalibrationError(f"three-axis sensor: {len(normal)} calibrations, {n} elements")
        self.layout = layout
        self._knot = np.array([curve.knot for curve in normal])
        self._lower = np.array([curve.lower for curve in normal])
        self._upper = np.array([curve.upper for curve in normal])
        self._shear = np.asarray(shear_n_per_unit, np.float64)

    def forces(self, grey: ArrayLike, centroid: ArrayLike) -> Floats:
        """Forces on the elements in their own frames, float64[..., n, 3], N.

        South, east and normal, the last not positive for a push (eqs. 1-3).

        Args:
            grey: [..., n], grey-value sums above the unloaded ones.
            centroid: [..., n, 2], displacements of the centroids in the picture.
        """
        g, u = in_element_frame(self.layout, grey, centroid)
        g = np.maximum(g, 0.0)
        normal = self._lower * np.minimum(g, self._knot) + self._upper * np.maximum(
            g - self._knot, 0.0
        )
        shear = u * self._shear[..., None]
        return np.concatenate([shear, -normal[..., None]], axis=-1)

    def total_force(self, forces_n: Floats) -> Floats:
        """Sum of the elements' forces in the fingertip's frame, float64[..., 3], N."""
        axes = np.stack([self.layout.south, self.layout.east, self.layout.normal], axis=1)
        total: Floats = np.einsum("...ni,nij->...j", forces_n, axes)
        return total


@dataclass
class Cap:
    """A bottle's cap about the origin: it turns lightly until it is closed, then hard.

    Torques in N mm.
    """

    radius_mm: float = 14.0
    closes_at_rad: float = 0.8
    light_nmm: float = 2.0
    stiffness_nmm_rad: float = 120.0
    damping_nmm_s: float = 4.0
    angle_rad: float = 0.0

    @property
    def resistance_nmm(self) -> float:
        """Torque that it takes to close the cap further."""
        return self.light_nmm + self.stiffness_nmm_rad * max(
            self.angle_rad - self.closes_at_rad, 0.0
        )

    def turn(self, torque_nmm: float, dt_s: float) -> float:
        """Turn under a torque for a short time; return the speed, rad/s. The thread holds."""
        excess = abs(torque_nmm) - (self.resistance_nmm if torque_nmm > 0 else self.light_nmm)
        if excess <= 0.0 or (torque_nmm < 0.0 and self.angle_rad > self.closes_at_rad):
            return 0.0
        speed = float(np.sign(torque_nmm)) * excess / self.damping_nmm_s
        self.angle_rad += speed * dt_s
        return speed


@dataclass
class CapWorld:
    """Two round fingertips in the plane of a cap between them.

    Attributes:
        cap: between the fingers.
        tip_mm: float64[2, 2], centres of the fingertips.
        normal_n: float64[2], force of each fingertip on the cap along the contact normal.
        shear_n: float64[2], tangential force of each fingertip on the cap, positive when it
            closes the cap.
        outward: float64[2, 2], unit vectors from the cap's axis to the fingertips.
    """

    cap: Cap = field(default_factory=Cap)
    friction: Friction = field(default_factory=Friction)
    tip_radius_mm: float = 20.0
    stiffness_n_mm: float = 2.0
    dt_s: float = 1 / 3000
    tip_mm: Floats = field(default_factory=lambda: np.array([[37.0, -5.0], [-37.0, 5.0]]))
    normal_n: Floats = field(default_factory=lambda: np.zeros(2))
    shear_n: Floats = field(default_factory=lambda: np.zeros(2))
    outward: Floats = field(default_factory=lambda: np.zeros((2, 2)))

    def __post_init__(self) -> None:
        self._contact = StickSlip(2, self.friction)
        self._spin = 0.0

    @property
    def slipped_mm(self) -> Floats:
        """float64[2], how far each fingertip has slid over the cap."""
        return self._contact.slipped_mm

    def advance(self, velocity_mm_s: Floats, dt_s: float) -> None:
        """Move the fingertips with velocities float64[2, 2] for a while."""
        for _ in range(max(1, round(dt_s / self.dt_s))):
            self.tip_mm = self.tip_mm + velocity_mm_s * self.dt_s
            distance = np.linalg.norm(self.tip_mm, axis=1)
            self.outward = self.tip_mm / distance[:, None]
            deep = self.cap.radius_mm + self.tip_radius_mm - distance
            self.normal_n = self.stiffness_n_mm * np.maximum(deep, 0.0)
            around = np.stack([-self.outward[:, 1], self.outward[:, 0]], axis=1)
            # The fingertip does not roll: its surface moves as its centre does.
            sliding = (velocity_mm_s * around).sum(axis=1) - self._spin * self.cap.radius_mm
            self.shear_n = self._contact.step(sliding[:, None], self.normal_n, self.dt_s)[:, 0]
            torque = float(self.shear_n.sum()) * self.cap.radius_mm
            self._spin = self.cap.turn(torque, self.dt_s)

    def element_forces(self, finger: int, normals: Floats, south: Floats, east: Floats) -> Floats:
        """Forces on the elements of a dome, float64[n, 3]: south, east and normal, N.

        The contact's load spreads over the elements around it. Fingertips are mounted with
        their vertex (z of the dome) towards the cap and the dome's x along the way that
        closes the cap.

        Args:
            finger: 0 or 1.
            normals, south, east: float64[n, 3], axes of the elements.
        """
        vertex = np.array([-1.0, 0.0]) if finger == 0 else np.array([1.0, 0.0])
        closing = np.array([0.0, 1.0]) if finger == 0 else np.array([0.0, -1.0])
        inward = -self.outward[finger]
        contact = np.array([inward @ closing, 0.0, inward @ vertex])
        around = np.stack([-self.outward[finger, 1], self.outward[finger, 0]])
        push = -self.normal_n[finger] * inward  # of the cap on the fingertip
        drag = -self.shear_n[finger] * around
        total = push + drag
        force = np.array([total @ closing, 0.0, total @ vertex])
        near = np.exp(-0.5 * (np.arccos(np.clip(normals @ contact, -1, 1)) / 0.2) ** 2)
        share = near / near.sum()
        return np.stack([share * (axes @ force) for axes in (south, east, normals)], axis=1)


def finger_velocity(
    flags: Flags,
    *,
    search_mm_s: Floats,
    move_mm_s: Floats,
    squeeze_mm_s: float,
    normal_n: Floats,
    inward: Floats,
) -> Floats:
    """Velocity of the fingertip, mm/s (Fig. 16).

    Args:
        flags: of this finger.
        search_mm_s: velocity v0 while it searches.
        move_mm_s: velocity vm while it manipulates.
        squeeze_mm_s: speed of re-compression at a slip.
        normal_n: float64[n], normal force on each element.
        inward: float64[n, d], unit vectors in which pressing harder moves the fingertip,
            the outward normals of the elements.
    """
    velocity = (search_mm_s if flags & Flags.SEARCH else move_mm_s).astype(np.float64)
    if flags & Flags.SLIP and not flags & Flags.OVER:
        velocity = velocity + squeeze_mm_s * inward[int(normal_n.argmax())]
    return velocity


@dataclass(frozen=True, slots=True)
class HoldResult:
    """How an object under a rising load was held, over servo samples [n]."""

    load_n: Floats
    grip_n: Floats
    slipped_mm: Floats
    slip: NDArray[np.bool_]  # flagged


def hold_object(
    rng: np.random.Generator,
    *,
    respond: bool = True,
    friction: float = 0.6,
    seconds: float = 6.0,
    load_rate_n_s: float = 0.5,
) -> HoldResult:
    """Hold an object while its weight rises, re-compressing at each slip (Ohka et al., 3.3).

    The controller knows neither load nor friction: it sees one contact's normal and shear
    force, with the noise of the skin.

    Args:
        rng: of the noise.
        respond: whether slips are answered; without, the object is dropped.
        friction: static coefficient of the contact; it slides at 0.85 of it.
        seconds: how long.
        load_rate_n_s: how fast the load rises.
    """
    objects = HeldObjects(1, Friction(static=friction, sliding=0.85 * friction))
    detector = ShearRate(1, FORCE_HZ)
    thresholds = GraspThresholds(touch_n=0.2, over_n=12.0, slip_n_s=6.0)
    finger = FingerFlags(thresholds)
    stiffness_n_mm, grip = 2.0, 2.0
    n = int(seconds * FORCE_HZ)
    load_n = load_rate_n_s * np.arange(n, dtype=np.float64) / FORCE_HZ
    grips, slips, flagged = np.zeros(n), np.zeros(n), np.zeros(n, np.bool_)
    for i in range(n):
        shear = objects.advance(load_n[i], grip, 1 / FORCE_HZ)
        seen = np.array([grip, shear[0], 0.0]) + NOISE_N * rng.normal(size=3)
        rate = detector.step(seen[None, 1:])
        finger.step(seen[:1], rate, int(i / FORCE_HZ * 1e9))
        squeeze = finger_velocity(
            finger.flags,
            search_mm_s=np.zeros(1),
            move_mm_s=np.zeros(1),
            squeeze_mm_s=20.0,
            normal_n=seen[:1],
            inward=np.ones((1, 1)),
        )
        if respond:
            grip += stiffness_n_mm * float(squeeze[0]) / FORCE_HZ
        grips[i], slips[i] = grip, objects.slipped_mm[0]
        flagged[i] = finger.flags & Flags.SLIP
    return HoldResult(load_n, grips, slips, flagged)


@dataclass(frozen=True, slots=True)
class CapResult:
    """How a cap was closed, over camera frames [n].

    Attributes:
        twist: int64[n], number of the touch-and-release motion, from 0.
        moving: bool[n], whether the fingers turn the cap.
        tip_mm: float64[n, 2, 2], centres of the fingertips.
        grip_n: float64[n], larger of the two normal forces.
        torque_nmm: float64[n], on the cap.
        shear_rate_n_s: float64[n], largest of all elements.
        angle_rad: float64[n], of the cap.
        element_n: float64[n], largest normal force on an element.
    """

    twist: NDArray[np.int64]
    moving: NDArray[np.bool_]
    tip_mm: Floats
    grip_n: Floats
    torque_nmm: Floats
    shear_rate_n_s: Floats
    angle_rad: Floats
    element_n: Floats


def close_cap(rng: np.random.Generator, *, twists: int = 4, adapt: bool = True) -> CapResult:
    """Close a bottle's cap by touch and release (Ohka et al., section 3.4).

    The trajectory given beforehand is a rectangle: towards the cap until both fingers
    touch, 10 mm straight along its tangent, back, and home. Slips bend it around the cap.

    Args:
        rng: of the sensors.
        twists: how many times.
        adapt: whether slips add re-compression.
    """
    world = CapWorld(cap=Cap(), friction=Friction(static=0.8, sliding=0.65))
    home = world.tip_mm.copy()
    layout = dome()
    cameras = [OpticalDome(layout.azimuth_rad, layout.latitude_rad, rng) for _ in range(2)]
    sensors = [_calibrated(camera) for camera in cameras]
    thresholds = GraspThresholds(
        touch_n=0.25, over_n=1.0, slip_n_s=1.5, slip_hold_s=0.04, lost_s=0.3
    )
    closing = np.array([[0.0, 1.0], [0.0, -1.0]])
    towards = np.array([[-1.0, 0.0], [1.0, 0.0]])
    dt_s = 1 / CAMERA_HZ
    rows: list[tuple[int, bool, Floats, float, float, float, float, float]] = []
    frame = 0
    for twist in range(twists):
        fingers = [FingerFlags(thresholds) for _ in range(2)]
        detectors = [ShearRate(41, CAMERA_HZ, window=3) for _ in range(2)]
        world.tip_mm = home.copy()
        moved_mm = np.zeros(2)
        velocity = 5.0 * towards
        for _ in range(int(8.0 * CAMERA_HZ)):
            world.advance(velocity, dt_s)
            rate = elements = 0.0
            touch = [bool(finger.flags & Flags.TOUCH) for finger in fingers]
            for i in range(2):
                truth = world.element_forces(i, layout.normal, layout.south, layout.east)
                force = sensors[i].forces(*cameras[i].read(truth))
                pressed, shear_rate = -force[:, 2], detectors[i].step(force[:, :2])
                fingers[i].step(
                    pressed,
                    shear_rate,
                    int(frame * dt_s * 1e9),
                    others_touch=touch[1 - i],
                    done=bool(moved_mm[i] >= 10.0),
                )
                flags = fingers[i].flags if adapt else fingers[i].flags & ~Flags.SLIP
                velocity[i] = finger_velocity(
                    flags,
                    search_mm_s=5.0 * towards[i],
                    move_mm_s=8.0 * closing[i],
                    squeeze_mm_s=4.0,
                    normal_n=pressed,
                    inward=_in_the_plane(layout.normal, towards[i], closing[i]),
                )
                if flags & Flags.MOVE:
                    moved_mm[i] += float(velocity[i] @ closing[i]) * dt_s
                rate = max(rate, float(shear_rate.max()))
                elements = max(elements, float(pressed.max()))
            moving = all(finger.flags & Flags.MOVE for finger in fingers)
            rows.append(
                (
                    twist,
                    moving,
                    world.tip_mm.copy(),
                    float(world.normal_n.max()),
                    float(world.shear_n.sum()) * world.cap.radius_mm,
                    rate,
                    world.cap.angle_rad,
                    elements,
                )
            )
            frame += 1
            if moved_mm.min() >= 10.0:
                break
        world.advance(-30.0 * towards, 0.2)
        world.advance(np.zeros((2, 2)), dt_s)
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return CapResult(*columns)


def _calibrated(camera: OpticalDome) -> ThreeAxisSensor:
    """Calibrate a dome by pressing every element in turn, straight and aslant."""
    layout = dome()
    push = np.linspace(0.0, 2.0, 41)
    straight = np.zeros((41, 41, 3))
    straight[..., 2] = -push[:, None]
    grey, _ = in_element_frame(layout, *camera.read(straight))
    aslant = np.zeros((21, 41, 3))
    aslant[..., 0] = np.linspace(-1.0, 1.0, 21)[:, None]
    aslant[..., 2] = -1.0
    _, moved = in_element_frame(layout, *camera.read(aslant))
    return ThreeAxisSensor(
        layout,
        [fit_bilinear(grey[:, i], push) for i in range(41)],
        fit_shear(moved[..., 0], aslant[..., 0]),
    )


def _in_the_plane(normals: Floats, vertex: Floats, closing: Floats) -> Floats:
    """Normals of the elements in the plane of the cap: z is towards it, x closes it."""
    flat: Floats = normals[:, 2:] * vertex + normals[:, :1] * closing
    return flat


@dataclass(frozen=True, slots=True)
class SlipTrials:
    """Slid way, and time since the object began to move, when each detector spoke.

    One row a detector of `DETECTORS`, one column a trial; infinite where it stayed silent,
    negative times where it spoke before.
    """

    slipped_mm: Floats
    delay_s: Floats


class _Detectors:
    """The three detectors over n contacts; `step` gives bool[3, n]."""

    def __init__(self, n: int, friction: float) -> None:
        self._rate = ShearRate(n, FORCE_HZ)
        self._drop = RatioDrop(n, force_sd_n=NOISE_N)
        self._friction = friction

    def step(self, normal_n: Floats, shear_n: Floats) -> NDArray[np.bool_]:
        return np.stack(
            [
                self._rate.step(shear_n) > SHEAR_RATE_N_S,
                self._drop.step(normal_n, shear_n),
                friction_used(normal_n, shear_n, self._friction) > SAFE_SHARE,
            ]
        )


def slip_trials(
    rng: np.random.Generator,
    n: int = 200,
    *,
    noise_n: float = NOISE_N,
    sliding_share: float = 0.85,
) -> SlipTrials:
    """Let n objects slip under a rising load, with various grips and rates.

    Static friction is 0.6, and all begin well within their limit.

    Args:
        rng: of grips, loads and noise.
        n: objects.
        noise_n: of each force reading.
        sliding_share: sliding over static friction. Near 1 a slip leaves hardly a trace in
            the forces.
    """
    law = Friction(static=0.6, sliding=0.6 * sliding_share)
    objects = HeldObjects(n, law)
    grip = rng.uniform(2.0, 8.0, n)
    rate = rng.uniform(0.3, 2.0, n)
    start = 0.5 * law.static * grip
    detectors = _Detectors(n, law.static)
    slipped = np.full((3, n), np.inf)
    spoke_s = np.full((3, n), np.inf)
    began_s = np.full(n, np.inf)
    # The load is laid on gently, then rises until every object is well under way.
    seconds = 2.5 + float(((0.62 * grip - start) / rate).max())
    for i in range(int(seconds * FORCE_HZ)):
        t = i / FORCE_HZ
        laid_on = 0.5 - 0.5 * np.cos(np.pi * min(t / 2.0, 1.0))
        load = start * laid_on + rate * max(t - 2.0, 0.0)
        shear = objects.advance(load, grip, 1 / FORCE_HZ)
        began_s[(objects.slipped_mm > 0.0) & np.isinf(began_s)] = t
        seen = np.zeros((n, 2))
        seen[:, 0] = shear
        seen += noise_n * rng.normal(size=(n, 2))
        cries = detectors.step(grip + noise_n * rng.normal(size=n), seen)
        new = cries & np.isinf(spoke_s)
        slipped[new] = np.broadcast_to(objects.slipped_mm, new.shape)[new]
        spoke_s[new] = t
    return SlipTrials(slipped, spoke_s - began_s)


def false_alarms_per_hour(
    rng: np.random.Generator, hours: float = 1.0, *, noise_n: float = NOISE_N, contacts: int = 200
) -> Floats:
    """False alarms per contact and hour of holding, float64[3], one a detector.

    Objects of various weights are carried about: grip and shear sway by 10 % within
    seconds, and nothing slips. A train of cries within 0.1 s is one alarm.
    """
    n = int(3600.0 * hours * FORCE_HZ / contacts)
    grip, share = rng.uniform(2.0, 8.0, contacts), rng.uniform(0.3, 0.6, contacts)
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, contacts))
    speed = 2.0 * np.pi * rng.uniform(0.2, 1.0, (3, contacts))
    detectors = _Detectors(contacts, 0.6)
    last = np.full((3, contacts), -np.inf)
    alarms = np.zeros(3)
    for i in range(n):
        t = i / FORCE_HZ
        sway = 0.1 * np.sin(speed * t + phase)
        normal = grip * (1.0 + sway[0])
        shear = (0.6 * share * grip)[:, None] * np.stack([1.0 + sway[1], 0.5 * sway[2]], axis=1)
        cries = detectors.step(
            normal + noise_n * rng.normal(size=contacts),
            shear + noise_n * rng.normal(size=shear.shape),
        )
        alarms += (cries & (t - last > 0.1)).sum(axis=1)
        last[cries] = t
    return alarms / (n * contacts / FORCE_HZ / 3600.0)
