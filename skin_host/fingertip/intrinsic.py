"""Intrinsic contact sensing: the point of contact from force and torque alone.

A single push through one point has a line of action, and the line enters the fingertip's
surface at the contact (Bicchi and Dario; Son et al.). Forces in N, torques in N mm about
the origin of the frame in which the surface is given, lengths in mm. Rows are samples.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_NEXT, _AFTER = [1, 2, 0], [2, 0, 1]

#: A push has at least this share of its force into the surface: no friction carries a thousand
#: times as much along it, and the less it has, the less its line determines where it enters.
LEAST_SLOPE = 1e-3


class ContactVerdict(IntEnum):
    """Result of locating one sample of force and torque."""

    CONTACT = 0
    TOO_LIGHT = 1  # force below the threshold (Son et al., section 4.4)
    NO_SINGLE_CONTACT = 2  # no single push on this surface gives this load
    SEVERAL_CONTACTS = 3  # a twist about the force that one point cannot carry


class Quadric(NamedTuple):
    """Sphere, cylinder or ellipsoid: sum of ((x - centre) / semi_axis)^2 = 1.

    Attributes:
        semi_axes_mm: three lengths; infinite along the axis of a cylinder.
        centre_mm: of the body.
        half_length_mm: a cylinder's surface ends at this distance from the centre, along its axis.
    """

    semi_axes_mm: tuple[float, float, float]
    centre_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    half_length_mm: float = np.inf

    def enter(self, origin_mm: Floats, direction: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Return where lines of unit `direction` [n, 3] enter the surface: distance, whether."""
        weight = self._weight
        start = origin_mm - self.centre_mm
        a = (weight * direction**2).sum(axis=1)
        b = (weight * start * direction).sum(axis=1)
        c = (weight * start**2).sum(axis=1) - 1.0
        discriminant = b**2 - a * c
        # A line along a cylinder never enters through its side: a = 0.
        found = (discriminant >= 0.0) & (a > 1e-12 * weight.max())
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (-b - np.sqrt(np.where(found, discriminant, 0.0))) / a
        distance = np.where(found, distance, np.nan)
        if np.isfinite(self.half_length_mm):
            along = (start + distance[:, None] * direction)[:, weight == 0.0]
            found &= (np.abs(along) <= self.half_length_mm).all(axis=1)
        return distance, found

    def normal(self, point_mm: Floats) -> Floats:
        """Outward unit normals [n, 3] at points [n, 3] of the surface."""
        gradient = self._weight * (point_mm - self.centre_mm)
        normal: Floats = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
        return normal

    @property
    def _weight(self) -> Floats:
        return 1.0 / np.array(self.semi_axes_mm) ** 2


def sphere(radius_mm: float) -> Quadric:
    """A sphere about the origin."""
    return Quadric((radius_mm, radius_mm, radius_mm))


def cylinder(radius_mm: float, half_length_mm: float = np.inf) -> Quadric:
    """A cylinder about the z axis."""
    return Quadric((radius_mm, radius_mm, np.inf), half_length_mm=half_length_mm)


def ellipsoid(a_mm: float, b_mm: float, c_mm: float) -> Quadric:
    """An ellipsoid about the origin with its axes along x, y, z."""
    return Quadric((a_mm, b_mm, c_mm))


class Plane(NamedTuple):
    """A flat face: outward unit normal, a point on it, and how far the face reaches."""

    outward: tuple[float, float, float] = (0.0, 0.0, 1.0)
    point_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reach_mm: float = np.inf

    def enter(self, origin_mm: Floats, direction: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Return where lines of unit `direction` [n, 3] enter the face: distance, and whether."""
        outward = np.array(self.outward)
        slope = direction @ outward
        found = slope < -1e-12  # a push has a component into the face
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = ((self.point_mm - origin_mm) @ outward) / slope
        distance = np.where(found, distance, np.nan)
        off = origin_mm + distance[:, None] * direction - self.point_mm
        found &= np.linalg.norm(off, axis=1) <= self.reach_mm
        return distance, found

    def normal(self, point_mm: Floats) -> Floats:
        """Outward unit normals [n, 3]."""
        return np.broadcast_to(np.array(self.outward), point_mm.shape).copy()


Surface = Quadric | Plane


class IntrinsicContact(NamedTuple):
    """Contacts located from force and torque, one row per sample; NaN where there is none.

    Attributes:
        verdict: uint8[n], see `ContactVerdict`.
        point_mm, normal: float64[n, 3], contact point, and outward normal of the surface.
        normal_n: float64[n], force into the surface, N, not negative.
        tangential_n: float64[n, 3], the rest of the force, in the tangent plane.
        pitch_mm: float64[n], torque about the force over the force; 0 for one hard point.
    """

    verdict: NDArray[np.uint8]
    point_mm: Floats
    normal: Floats
    normal_n: Floats
    tangential_n: Floats
    pitch_mm: Floats


def locate(
    force_n: ArrayLike,
    torque_nmm: ArrayLike,
    surface: Surface,
    *,
    minimum_force_n: float = 0.1,
    pitch_limit_mm: float = 1.0,
) -> IntrinsicContact:
    """Return contact point, normal and force components (Bicchi and Dario, eqs. 1-2).

    Args:
        force_n: [n, 3], force that the touched object exerts on the fingertip.
        torque_nmm: [n, 3], its torque about the origin.
        surface: of the fingertip.
        minimum_force_n: below it the result is `TOO_LIGHT`; 0.1 N is the least force that
            Bicchi and Dario detect.
        pitch_limit_mm: a soft pad under friction can carry some twist about the force;
            beyond this much there must be several contacts. (Two pushes through the centre of
            a sphere have no twist: force and torque cannot distinguish them from one push.)
    """
    force = np.atleast_2d(np.asarray(force_n, np.float64))
    torque = np.atleast_2d(np.asarray(torque_nmm, np.float64))
    size = np.linalg.norm(force, axis=1)
    heavy = size >= max(minimum_force_n, 1e-300)  # False for NaN
    safe = np.where(heavy, size, np.nan)[:, None]
    direction = force / safe
    arm = _cross(direction, torque / safe)
    pitch = (direction * torque / safe).sum(axis=1)
    distance, found = surface.enter(arm, direction)
    point = arm + distance[:, None] * direction
    normal = surface.normal(point)
    found &= (direction * normal).sum(axis=1) <= -LEAST_SLOPE
    verdict = np.full(len(force), ContactVerdict.CONTACT, np.uint8)
    verdict[np.abs(pitch) > pitch_limit_mm] = ContactVerdict.SEVERAL_CONTACTS
    verdict[~found] = ContactVerdict.NO_SINGLE_CONTACT
    verdict[~heavy] = ContactVerdict.TOO_LIGHT
    point[verdict != ContactVerdict.CONTACT] = np.nan
    normal[verdict != ContactVerdict.CONTACT] = np.nan
    into = -(force * normal).sum(axis=1)
    return IntrinsicContact(
        verdict, point, normal, into, force + into[:, None] * normal, np.where(heavy, pitch, np.nan)
    )


def sensitivity(force_n: ArrayLike, torque_nmm: ArrayLike, contact: IntrinsicContact) -> Floats:
    """Return the first-order change of the contact point with the load, float64[n, 3, 6].

    The point is r0 + lambda f with r0 = f x m / |f|^2, and moves along the surface:
    n . dc = 0 fixes d lambda. Columns: fx fy fz (mm/N), mx my mz (1/N).
    """
    f = np.atleast_2d(np.asarray(force_n, np.float64))
    m = np.atleast_2d(np.asarray(torque_nmm, np.float64))
    squared = (f**2).sum(axis=1)[:, None]
    arm = _cross(f, m) / squared
    reach = ((contact.point_mm - arm) * f).sum(axis=1)[:, None] / squared
    change = np.empty((len(f), 3, 6))
    # d(f x m) = df x m + f x dm, and the distance along f changes with |f|.
    change[:, :, :3] = -cross_matrices(m) - 2.0 * arm[:, :, None] * f[:, None, :]
    change[:, :, 3:] = cross_matrices(f)
    change /= squared[:, :, None]
    change[:, :, :3] += reach[:, :, None] * np.eye(3)
    lift = np.einsum("ni,nij->nj", contact.normal, change)
    slope = (contact.normal * f).sum(axis=1)
    tangent: Floats = change - f[:, :, None] * (lift / slope[:, None])[:, None, :]
    return tangent


def point_covariance(
    force_n: ArrayLike,
    torque_nmm: ArrayLike,
    contact: IntrinsicContact,
    load_covariance: ArrayLike,
    *,
    surface_sd_mm: float = 0.0,
) -> Floats:
    """Covariance of the contact point, float64[n, 3, 3], mm^2, to first order.

    Args:
        force_n: [n, 3].
        torque_nmm: [n, 3].
        contact: what `locate` made of them.
        load_covariance: [6, 6] or [n, 6, 6], of force (N) and torque (N mm).
        surface_sd_mm: how far the true surface may lie off the model along its normal.
    """
    jacobian = sensitivity(force_n, torque_nmm, contact)
    covariance: Floats = jacobian @ np.asarray(load_covariance) @ jacobian.swapaxes(1, 2)
    f = np.atleast_2d(np.asarray(force_n, np.float64))
    along = f / (contact.normal * f).sum(axis=1)[:, None]
    covariance += surface_sd_mm**2 * along[:, :, None] * along[:, None, :]
    return covariance


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross product of rows [n, 3]; numpy's own takes five times as long for a single row."""
    product: Floats = a[:, _NEXT] * b[:, _AFTER] - a[:, _AFTER] * b[:, _NEXT]
    return product


def cross_matrices(a: Floats) -> Floats:
    """Matrices float64[n, 3, 3] whose product with b is a x b, of rows a, float64[n, 3]."""
    matrix = np.zeros((len(a), 3, 3))
    matrix[:, _AFTER, _NEXT] = a
    matrix[:, _NEXT, _AFTER] = -a
    return matrix
