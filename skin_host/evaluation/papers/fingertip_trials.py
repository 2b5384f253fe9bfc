"""Fingertips under test: the tasks of Son et al. by all methods, and contact sensing by force.

In the tasks of its section 4 a pin and a box are moved along a 2 cm square at 4 cm/s, and turned by
20 degrees each way. Servo samples at 300 Hz; the array is read at every tenth.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skin_host.evaluation.papers.force_torque import calibrate
from skin_host.evaluation.papers.fusion import (
    FingertipFusion,
    calibrate_fusion,
    centroid,
    contact_angle,
    peak,
    smooth_peak,
    strip_array,
)
from skin_host.evaluation.papers.truth import (
    LoadPatch,
    PlanarGauges,
    StripArray,
    box_patch,
    pin_patch,
    planar_load,
)
from skin_host.fingertip.intrinsic import locate, point_covariance, sphere
from skin_host.fingertip.wrench import Butterworth2

Floats = NDArray[np.float64]

RATE_HZ = 300.0
ARRAY_EVERY = 10
RADIUS_MM = 15.7
GRASP_N = 3.0
#: A contact is set up by hand: it lies within so much of where it should.
SET_UP_MM = 0.5

NOISE_V = 1.0e-4
MASS_KG = 0.035
#: Methods of the paper; "force, 10 Hz" is its two-pole low-pass on the force sensor's places.
SINGLE_METHODS = ("centroid", "half maximum", "peak", "force")
METHODS = (*SINGLE_METHODS, "force, 10 Hz", "smooth peak", "fused")
TASKS = (
    "pin translation centred",
    "pin translation off centre",
    "pin rotation centred",
    "pin rotation off centre",
    "box translation",
    "box rotation",
)


@dataclass(frozen=True, slots=True)
class ManipulationTask:
    """One task over time. Rows are servo samples.

    Attributes:
        name: one of `TASKS`.
        place_mm: float64[n], true contact along the circumference.
        normal_n, tangential_n: float64[n], the contact's force in Son's sign.
        acceleration_m_s2: float64[n, 2], of the fingertip.
        patch: of the contact.
    """

    name: str
    place_mm: Floats
    normal_n: Floats
    tangential_n: Floats
    acceleration_m_s2: Floats
    patch: LoadPatch


def make_task(name: str, rng: np.random.Generator, seconds: float = 8.0) -> ManipulationTask:
    """Make one of `TASKS`.

    Raises:
        KeyError: no such task.
    """
    if name not in TASKS:
        raise KeyError(name)
    n = int(seconds * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    set_up = rng.uniform(-SET_UP_MM, SET_UP_MM)
    shake = 0.3 * _unrest(rng, n, 2, 0.01)
    grasp = GRASP_N + 0.15 * _unrest(rng, n, 1, 0.1)[:, 0]
    lift = 0.05 * _unrest(rng, n, 1, 0.1)[:, 0]
    if "translation" in name:
        velocity = _square_path(t)
        acceleration = _smooth(np.gradient(velocity, 1 / RATE_HZ, axis=0), 0.02) + shake
        mass_kg = 0.0042 if name.startswith("pin") else 0.077
        # Half of the object's inertia on each of the two fingers.
        normal = grasp + 0.5 * mass_kg * acceleration[:, 0]
        tangential = lift + 0.5 * mass_kg * acceleration[:, 1]
        place = np.full(n, set_up)
        if name == "pin translation off centre":
            place -= 3.0
            tangential = tangential + 0.19 * normal
        if name == "box translation":
            # Fingers roll on the box while they go up and down (a trapezoid in time).
            place = 1.5 * np.cumsum(velocity[:, 1]) / RATE_HZ / 0.01 - 1.5 + set_up
        patch = pin_patch() if name.startswith("pin") else box_patch(skew=0.2)
        return ManipulationTask(name, place, normal, tangential, acceleration, patch)
    turn = np.deg2rad(20.0) * _triangle(t / 4.0)
    # The fingertip swings on an arm of half the object.
    swing = np.gradient(np.gradient(0.05 * turn, 1 / RATE_HZ), 1 / RATE_HZ)
    acceleration = np.stack([np.zeros(n), _smooth(swing, 0.01)], axis=1) + shake
    if name.startswith("pin"):
        place = np.full(n, set_up - 3.0 * name.endswith("off centre"))
        lean = turn - place / RADIUS_MM
        return ManipulationTask(
            name,
            place,
            grasp * np.cos(lean),
            grasp * np.sin(lean) + lift,
            acceleration,
            pin_patch(),
        )
    # A face that turns rolls over the fingertip; there is no shear but the object's weight.
    return ManipulationTask(
        name, RADIUS_MM * 0.9 * turn + set_up, grasp, lift, acceleration, box_patch(skew=0.2)
    )


def _square_path(t: Floats) -> Floats:
    """Velocity along a square of 2 cm at 4 cm/s, m/s, float64[n, 2]."""
    side = np.floor(t / 0.5).astype(int) % 4
    directions = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]])
    velocity: Floats = 0.04 * directions[side]
    return velocity


def _triangle(phase: Floats) -> Floats:
    """A triangular wave of height 1 and period 1 that starts at 0."""
    wave: Floats = 4.0 * np.abs((phase + 0.75) % 1.0 - 0.5) - 1.0
    return wave


def _smooth(values: Floats, seconds: float) -> Floats:
    """Gaussian mean over about `seconds`, down the columns of [n] or [n, k]."""
    half = int(np.ceil(3.0 * seconds * RATE_HZ))
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / (seconds * RATE_HZ)) ** 2)
    kernel /= kernel.sum()
    columns = np.pad(values.reshape(len(values), -1), ((half, half), (0, 0)), mode="edge")
    smooth = [np.convolve(column, kernel, mode="valid") for column in columns.T]
    return np.stack(smooth, axis=1).reshape(values.shape)


def _unrest(rng: np.random.Generator, n: int, channels: int, seconds: float) -> Floats:
    """Noise of standard deviation 1 that changes within about `seconds`, [n, channels]."""
    noise = _smooth(rng.normal(size=(n, channels)), seconds)
    unrest: Floats = noise / noise.std(axis=0)
    return unrest


class TrialFingertip:
    """One emulated fingertip of Son et al., calibrated by presses with a pointed indenter.

    Args:
        seed: of the fingertip's traits and noise.
        presses: of the calibration.
        place_sd_mm: how well each press hits its place.
    """

    def __init__(self, seed: int, presses: int = 200, place_sd_mm: float = 0.2) -> None:
        rng = np.random.default_rng(seed)
        layout = strip_array()
        self.around_mm = layout.around_mm
        self.array = StripArray(layout.around_mm, layout.along_mm, rng)
        self.gauges = PlanarGauges(rng, mass_kg=MASS_KG, noise_v=NOISE_V)
        meant, signals, true = self.gauges.calibration_presses(
            presses, RADIUS_MM, place_sd_mm=place_sd_mm
        )
        self.force = calibrate(signals, meant)
        response = self.array.read(true[:, 0], true[:, 1], -true[:, 2], pin_patch())
        place = RADIUS_MM * contact_angle(meant[:, 0], meant[:, 1], meant[:, 2], RADIUS_MM)
        self.calibration = calibrate_fusion(
            place[1:], self.force.loads(signals)[1:], response[1:], self.around_mm, RADIUS_MM
        )
        noise = NOISE_V * np.linalg.norm(self.force.matrix, axis=1)
        self.fusion = FingertipFusion(
            self.calibration,
            RADIUS_MM,
            force_sd_n=float(noise[:2].max()),
            torque_sd_nmm=float(noise[2]),
            mass_kg=MASS_KG,
        )

    def places(self, task: ManipulationTask) -> dict[str, Floats]:
        """Where each method puts the contact, mm, at the 300 Hz of the servo.

        The array's methods hold their last place between two readings.
        """
        load = planar_load(task.place_mm, task.normal_n, task.tangential_n, RADIUS_MM)
        loads = self.force.loads(self.gauges.read(load, task.acceleration_m_s2))
        seen = slice(None, None, ARRAY_EVERY)
        response = self.array.read(
            task.place_mm[seen], task.normal_n[seen], -task.tangential_n[seen], task.patch
        )
        by_array = smooth_peak(response, self.around_mm)
        by_force = RADIUS_MM * contact_angle(loads[:, 0], loads[:, 1], loads[:, 2], RADIUS_MM)
        low_pass = Butterworth2(10.0, RATE_HZ)
        self.fusion.reset()
        fused = [
            self.fusion.step(
                1 / RATE_HZ, load, by_array[i // ARRAY_EVERY] if i % ARRAY_EVERY == 0 else None, 1.0
            )
            for i, load in enumerate(loads)
        ]

        def held(places: Floats) -> Floats:
            return np.repeat(places, ARRAY_EVERY)[: len(loads)]

        return {
            "centroid": held(centroid(response, self.around_mm)),
            "half maximum": held(centroid(response, self.around_mm, share=0.5)),
            "peak": held(peak(response, self.around_mm)),
            "force": by_force,
            "force, 10 Hz": np.array([low_pass.step(place)[0] for place in by_force]),
            "smooth peak": held(by_array),
            "fused": np.array(fused),
        }


def task_errors(
    fingertips: int, seconds: float, presses: int = 200, place_sd_mm: float = 0.2
) -> dict[str, dict[str, Floats]]:
    """Errors in mm of every method in every task, over several fingertips and set-ups.

    The first half second, in which filters settle, is left out. The fingertips are others
    than those on which the constants of the fusion were chosen.
    """
    found: dict[str, dict[str, list[Floats]]] = {
        name: {method: [] for method in METHODS} for name in TASKS
    }
    settled = int(0.5 * RATE_HZ)
    for seed in range(50, 50 + fingertips):
        fingertip = TrialFingertip(seed, presses, place_sd_mm)
        for name in TASKS:
            task = make_task(name, np.random.default_rng(1000 + seed), seconds)
            for method, places in fingertip.places(task).items():
                found[name][method].append((places - task.place_mm)[settled:])
    return {
        name: {method: np.concatenate(parts) for method, parts in methods.items()}
        for name, methods in found.items()
    }


def rms(values: Floats) -> float:
    """Root of the mean square, numbers only."""
    return float(np.sqrt(np.nanmean(np.square(values))))


def intrinsic_errors(
    force_n: float, rng: np.random.Generator, samples: int, *, radius_mm: float = 13.0
) -> tuple[float, float, float]:
    """Contacts on the sphere of Bicchi and Dario with noise that gives 0.2 mm at 1 N.

    Returns:
        rms error and its first-order prediction, mm, and the share of samples in which no
        single contact was found.
    """
    normal = rng.normal(size=(samples, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    side = np.cross(normal, rng.normal(size=(samples, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    lean = rng.uniform(0.0, 0.3, (samples, 1))
    force = force_n * (lean * side - normal) / np.sqrt(1.0 + lean**2)
    point = radius_mm * normal
    torque = np.cross(point, force)
    # Two tangential directions, each moved by force and torque noise alike.
    unit = 0.2 / radius_mm / 2.0
    sd = np.array([unit, unit, unit, radius_mm * unit, radius_mm * unit, radius_mm * unit])
    noisy = np.hstack([force, torque]) + sd * rng.normal(size=(samples, 6))
    found = locate(
        noisy[:, :3],
        noisy[:, 3:],
        sphere(radius_mm),
        minimum_force_n=0.05,
        pitch_limit_mm=np.inf,
    )
    error = np.linalg.norm(found.point_mm - point, axis=1)
    exact = locate(force, torque, sphere(radius_mm), minimum_force_n=0.05)
    covariance = point_covariance(force, torque, exact, np.diag(sd**2))
    predicted = np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean())
    return rms(error), float(predicted), float(np.isnan(error).mean())
