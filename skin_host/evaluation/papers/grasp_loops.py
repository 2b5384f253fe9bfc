"""Closed loops of fingers and emulated objects: a held object, and a bottle's cap."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.probes.held_objects import Friction, HeldObjects
from skin_host.evaluation.papers.cap import Cap, CapWorld
from skin_host.evaluation.papers.three_axis import (
    ThreeAxisSensor,
    dome,
    fit_bilinear,
    fit_shear,
    in_element_frame,
)
from skin_host.evaluation.papers.truth import OpticalDome
from skin_host.fingertip.grasp import FingerFlags, Flags, GraspEvent, Thresholds, finger_velocity
from skin_host.fingertip.slip import ShearRate

Floats = NDArray[np.float64]

#: Force sensors are read at the servo rate of Son et al., cameras at a video rate.
FORCE_HZ = 300.0
CAMERA_HZ = 30.0
#: 0.4 units of the skin are this much force on one of its pads: 2.345 kPa times 13.9 mm2.
NOISE_N = 0.4 * 2.345e-3 * np.pi * 2.1**2


@dataclass(frozen=True, slots=True)
class HoldResult:
    """How an object under a rising load was held, over servo samples [n]."""

    load_n: Floats
    grip_n: Floats
    slipped_mm: Floats
    events: list[GraspEvent]


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
    thresholds = Thresholds(touch_n=0.2, over_n=12.0, slip_n_s=6.0)
    finger = FingerFlags(thresholds)
    stiffness_n_mm, grip = 2.0, 2.0
    n = int(seconds * FORCE_HZ)
    load_n = load_rate_n_s * np.arange(n, dtype=np.float64) / FORCE_HZ
    grips, slips, events = np.zeros(n), np.zeros(n), []
    for i in range(n):
        shear = objects.advance(load_n[i], grip, 1 / FORCE_HZ)
        seen = np.array([grip, shear[0], 0.0]) + NOISE_N * rng.normal(size=3)
        rate = detector.step(seen[None, 1:])
        events += finger.step(seen[:1], rate, int(i / FORCE_HZ * 1e9))
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
    return HoldResult(load_n, grips, slips, events)


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
    thresholds = Thresholds(touch_n=0.25, over_n=1.0, slip_n_s=1.5, slip_hold_s=0.04, lost_s=0.3)
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
