"""The manipulation tasks of Son et al., section 4: what the right fingertip goes through.

A pin and a box are moved along a 2 cm square at 4 cm/s, and turned by 20 degrees each
way. Servo samples at 300 Hz; the array is read at every tenth.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skin_host.evaluation.papers.truth import Patch, box_patch, pin_patch

Floats = NDArray[np.float64]

RATE_HZ = 300.0
ARRAY_EVERY = 10
RADIUS_MM = 15.7
GRASP_N = 3.0
#: A contact is set up by hand: it lies within so much of where it should.
SET_UP_MM = 0.5

TASKS = (
    "pin translation centred",
    "pin translation off centre",
    "pin rotation centred",
    "pin rotation off centre",
    "box translation",
    "box rotation",
)


@dataclass(frozen=True, slots=True)
class Task:
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
    patch: Patch


def make_task(name: str, rng: np.random.Generator, seconds: float = 8.0) -> Task:
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
        return Task(name, place, normal, tangential, acceleration, patch)
    turn = np.deg2rad(20.0) * _triangle(t / 4.0)
    # The fingertip swings on an arm of half the object.
    swing = np.gradient(np.gradient(0.05 * turn, 1 / RATE_HZ), 1 / RATE_HZ)
    acceleration = np.stack([np.zeros(n), _smooth(swing, 0.01)], axis=1) + shake
    if name.startswith("pin"):
        place = np.full(n, set_up - 3.0 * name.endswith("off centre"))
        lean = turn - place / RADIUS_MM
        return Task(
            name,
            place,
            grasp * np.cos(lean),
            grasp * np.sin(lean) + lift,
            acceleration,
            pin_patch(),
        )
    # A face that turns rolls over the fingertip; there is no shear but the object's weight.
    return Task(
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
