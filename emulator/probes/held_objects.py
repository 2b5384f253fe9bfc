"""Contacts that stick and slip, and objects held by them.

An elastic tangential spring releases at the static limit and drags at the sliding one. Lengths
in mm, forces in N, time in s. The world advances in its own small steps and does not depend on the
controller of the fingers.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Friction:
    """A pair of surfaces: static and sliding coefficient, stiffness until it slips."""

    static: float = 0.6
    sliding: float = 0.5
    stiffness_n_mm: float = 2.0
    #: Viscous part of the rubber, N s/mm.
    damping: float = 0.01
    #: Slower than this a sliding contact sticks again: it sticks and slips.
    hold_mm_s: float = 15.0


class StickSlip:
    """Tangential springs of n contacts, each in one direction or two.

    Attributes:
        slipped_mm: float64[n], way that each contact has slid in all.
    """

    def __init__(self, n: int, friction: Friction, dimensions: int = 1) -> None:
        self._friction = friction
        self._stretch = np.zeros((n, dimensions))
        self._sliding = np.zeros(n, bool)
        self.slipped_mm = np.zeros(n)

    def step(self, speed_mm_s: ArrayLike, normal_n: ArrayLike, dt_s: float) -> Floats:
        """Force float64[n, d] that resists the speed [n, d] of one surface over the other."""
        speed = np.asarray(speed_mm_s, np.float64)
        normal = np.maximum(np.asarray(normal_n, np.float64), 0.0)
        law = self._friction
        self._stretch += speed * dt_s
        pull = law.stiffness_n_mm * np.linalg.norm(self._stretch, axis=1)
        self._sliding |= pull > law.static * normal
        limit = np.where(self._sliding, law.sliding, law.static) * normal
        excess = np.maximum(pull - limit, 0.0)
        share = np.divide(limit, pull, out=np.ones_like(pull), where=pull > limit)
        self._stretch *= share[:, None]
        self.slipped_mm += excess / law.stiffness_n_mm
        fast = np.linalg.norm(speed, axis=1) > law.hold_mm_s
        self._sliding &= (excess > 0.0) & fast
        stuck = ~self._sliding
        force: Floats = law.stiffness_n_mm * self._stretch + (law.damping * stuck)[:, None] * speed
        return force * np.atleast_1d(normal > 0.0)[:, None]


class HeldObjects:
    """n objects, each held by one contact against a tangential load.

    Args:
        n: objects side by side, alike but for their loads and grips.
        friction: of the contacts.
        mass_kg: of an object.
        dt_s: inner step.
    """

    def __init__(
        self, n: int, friction: Friction, *, mass_kg: float = 0.2, dt_s: float = 1 / 3000
    ) -> None:
        self._contact = StickSlip(n, friction)
        self._mass_kg = mass_kg
        self._dt_s = dt_s
        self._speed = np.zeros((n, 1))
        self._force = np.zeros((n, 1))
        #: Time that has passed since the last inner step, or is ahead of now.
        self._left_s = 0.0
        self.fallen_mm = np.zeros(n)

    @property
    def slipped_mm(self) -> Floats:
        """float64[n], how far each object has slid through the grip."""
        return self._contact.slipped_mm

    def advance(self, load_n: ArrayLike, normal_n: ArrayLike, dt_s: float) -> Floats:
        """Let time pass; the friction force on each object, float64[n], at the last inner step.

        However the time is divided, the inner steps are the same: who looks more often changes
        nothing.

        Args:
            load_n: [n], tangential pull.
            normal_n: [n], grip.
            dt_s: how long.
        """
        load = np.broadcast_to(np.asarray(load_n, np.float64), self.fallen_mm.shape)
        self._left_s += dt_s
        steps = max(0, round(self._left_s / self._dt_s))
        self._left_s -= steps * self._dt_s
        for _ in range(steps):
            self._force = self._contact.step(self._speed, normal_n, self._dt_s)
            # N over kg is m/s2; the speed is in mm/s.
            self._speed += 1e3 * (load[:, None] - self._force) / self._mass_kg * self._dt_s
            self.fallen_mm += self._speed[:, 0] * self._dt_s
        return self._force[:, 0]
