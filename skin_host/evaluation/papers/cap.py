"""A bottle's cap that two round fingertips close: the world of Ohka et al.'s second task.

The contacts stick and slip as in `emulator.probes.held_objects`. Lengths in mm, forces in N,
time in s.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from emulator.probes.held_objects import Friction, StickSlip

Floats = NDArray[np.float64]


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
