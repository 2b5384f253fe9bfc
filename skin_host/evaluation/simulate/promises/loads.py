"""What events of fingertips on force/torque boards report of their load, and of its place."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.evaluation.simulate.promises.limits import (
    FELT_N,
    LOADED_BACK_NS,
    MOST_TILT,
    NS,
    OVERSHOOT,
    PUBLISHED,
    SIGMAS,
    SLANTED,
    STEADY_SHARE,
)
from skin_host.evaluation.simulate.world import World
from skin_host.fingertip.events import Over, Slip
from skin_host.processing.events import Touch

Floats = NDArray[np.float64]


class Range(NamedTuple):
    """The least and the most of something lately, as numbers or arrays."""

    least: Floats
    most: Floats

    @classmethod
    def of(cls, values: Floats, off: float) -> "Range":
        """Of values [k, ...] as they pass a filter, each off by no more than `off`."""
        least, most = values.min(axis=0), values.max(axis=0)
        more = OVERSHOOT * (most - least) + off
        return cls(least - more, most + more)

    def lacks(self, value: object) -> bool:
        """Whether a value, or one of several, is not within it."""
        found = np.asarray(value, np.float64)
        return not bool(((self.least <= found) & (found <= self.most)).all())


class LoadCheck:
    """Compares loads that fingertips report with those that their boards measured.

    What a board measured is the emulator's: the load of what presses, with the noise that it draws
    and the units of its words. Of the daemon it is known that it smooths.

    Args:
        world: to watch.
    """

    def __init__(self, world: World) -> None:
        self._world = world

    def wrong(self, event: Touch | Slip | Over) -> str | None:
        """Return what is wrong with the begin or the move of something, or None."""
        clock, tips = self._world.clock, self._world.robot.fingertips
        if abs(clock.now_ns() - event.t_ns) > NS // 2:
            return None  # it waited to be read, or the time of day was set
        after_ns = clock.monotonic_ns() - LOADED_BACK_NS
        lately = [one for one in tips.lately[event.part] if one.t_ns > after_ns]
        if not lately:
            return None
        off_n, off_nm = (SIGMAS * off + PUBLISHED for off in tips.off(event.part))
        wrench = np.array([one.wrench for one in lately])
        normals = [press.normal for one in lately for press in one.presses]
        if not normals:
            normals = [np.array([0.0, 0.0, 1.0])]
        one_way = bool((np.array(normals) @ normals[0] > 1.0 - 1e-9).all())
        whole_n = np.linalg.norm(wrench[:, :3], axis=1)
        normal_n = -wrench[:, :3] @ normals[0]
        shear_n = np.linalg.norm(wrench[:, :3] + normal_n[:, None] * normals[0], axis=1)
        # The normal that is found may be tilted: then a share of either force counts as the other.
        into, along = Range.of(normal_n, off_n), Range.of(shear_n, off_n)
        tilted_n = np.sin(MOST_TILT) * along.most
        force_n = Range(
            np.cos(MOST_TILT) * into.least - tilted_n, np.maximum(into.most, whole_n.max() + off_n)
        )
        if not one_way:
            force_n = Range(np.array(-np.inf), force_n.most)
        found: list[tuple[str, object, Range, str]] = [
            ("presses with", event.force_n, force_n, "N")
        ]
        if isinstance(event, Slip) and one_way:
            tilted_n = np.sin(MOST_TILT) * into.most
            sheared_n = Range(along.least - tilted_n, along.most + tilted_n)
            found.append(("is pulled with", event.shear_n, sheared_n, "N"))
        if isinstance(event, Touch):
            if event.load is None:
                return f"{event.part}: touch {event.id} has no load"
            if event.load.verdict == "saturated":
                return None
            found += [
                ("has a force of", event.load.force_n, Range.of(wrench[:, :3], off_n), "N"),
                ("has a torque of", event.load.torque_nm, Range.of(wrench[:, 3:], off_nm), "N m"),
            ]
        for what, value, bounds, unit in found:
            if bounds.lacks(value):
                return (
                    f"{event.part}: {_kind(event)} {event.id} {what} {_text(value)} {unit}, and "
                    f"what presses it gives {_text(bounds.least)} to {_text(bounds.most)} {unit}"
                )
        if not isinstance(event, Touch):
            return None
        steady = normal_n.min() >= max(FELT_N, (1.0 - STEADY_SHARE) * normal_n.max())
        points_m = 1e-3 * np.array([press.point_mm for one in lately for press in one.presses])
        if one_way and steady:
            arm_m = np.linalg.norm(points_m, axis=1).max()
            off_m = SLANTED * (off_nm + arm_m * off_n) / normal_n.min()
            return _wrong_shear(event) or _wrong_place(event, points_m, normals[0], off_m)
        return _wrong_shear(event)


def _wrong_shear(event: Touch) -> str | None:
    """Return a force along the surface that is not what the normal force leaves of the force."""
    assert event.load is not None
    if event.normal is None or event.load.shear_n is None:
        return None
    rest_n = np.array(event.load.force_n) + event.force_n * np.array(event.normal)
    off_n = float(np.linalg.norm(rest_n - event.load.shear_n))
    if off_n <= PUBLISHED or event.force_n == 0.0:
        return None
    return f"{event.part}: touch {event.id} has a shear that is {off_n:.3g} N off its force"


def _wrong_place(event: Touch, points_m: Floats, normal: Floats, off_m: float) -> str | None:
    """Return a place or a normal that is none of those where something presses.

    Where skin is joined, its own events are judged.
    """
    if event.centroid_m is None or event.normal is None or event.taxels:
        return None
    centroid_m = np.array(event.centroid_m)
    among_m = np.clip(centroid_m, points_m.min(axis=0), points_m.max(axis=0))
    apart_m = float(np.linalg.norm(centroid_m - among_m))
    if apart_m > off_m + 1e-3 * PUBLISHED:
        return (
            f"{event.part}: touch {event.id} is at {event.centroid_m} m, {apart_m * 1e3:.1f} mm "
            f"from what presses it, which is seen to {off_m * 1e3:.1f} mm"
        )
    unit = abs(np.linalg.norm(event.normal) - 1.0) < PUBLISHED
    if unit and np.dot(event.normal, normal) >= np.cos(MOST_TILT):
        return None
    return f"{event.part}: touch {event.id} has the normal {event.normal}, and nothing presses so"


def _kind(event: Touch | Slip | Over) -> str:
    return type(event).__name__.lower()


def _text(value: object) -> str:
    return " ".join(f"{one:.3g}" for one in np.atleast_1d(np.asarray(value)).tolist())
