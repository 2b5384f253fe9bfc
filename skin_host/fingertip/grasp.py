"""Flags of a grasping hand (Ohka et al., 3.3).

SEARCH: fingers approach until something touches. MOVE: the hand manipulates. TOUCH: the normal
force of an element is above F1, or it slips. SLIP: |dFs/dt| of an element is above dr. OVER: the
normal force of an element is above F2 (the text has F1 in one place, a misprint). A slip adds a
re-compression along the inward normal of the element with the largest normal force, unless OVER.
"""

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Flags(IntFlag):
    """State of one finger."""

    SEARCH = 1
    MOVE = 2
    TOUCH = 4
    SLIP = 8
    OVER = 16


_NONE = Flags(0)
# As plain numbers: an operation on members of an enumeration takes as long as ten on these.
_MOVE, _TOUCH, _SLIP, _OVER = map(int, (Flags.MOVE, Flags.TOUCH, Flags.SLIP, Flags.OVER))


@dataclass(frozen=True, slots=True)
class GraspThresholds:
    """F1, F2 and dr of Ohka et al., and the times that the paper does not give."""

    touch_n: float = 0.2
    over_n: float = 2.0
    slip_n_s: float = 5.0
    #: SLIP stays set this long after the last crossing, so that a stick-slip series is one slip.
    slip_hold_s: float = 0.03
    #: MOVE ends this long after the last touch.
    lost_s: float = 0.2


def analyse(
    normal_n: Floats, shear_rate_n_s: Floats, thresholds: GraspThresholds, *, slips: bool = False
) -> Flags:
    """Return TOUCH, SLIP and OVER of one finger from its elements [n] (Fig. 15).

    `slips`: another sign than the rate of the shear force shows that it slips.
    """
    largest = float(normal_n.max(initial=0.0))
    flags = 0
    if slips or shear_rate_n_s.max(initial=0.0) > thresholds.slip_n_s:
        flags |= _SLIP
    if largest > thresholds.touch_n or flags & _SLIP:
        flags |= _TOUCH
    if largest > thresholds.over_n:
        flags |= _OVER
    return Flags(flags)


def next_mode(mode: Flags, *, touch: bool, lost: bool, done: bool) -> Flags:
    """Return SEARCH or MOVE, from the mode before; the truth table:

    | mode   | touch | lost | done | next   |
    |--------|-------|------|------|--------|
    | SEARCH | no    | -    | -    | SEARCH |
    | SEARCH | yes   | -    | -    | MOVE   |
    | MOVE   | -     | -    | yes  | SEARCH |
    | MOVE   | -     | yes  | no   | SEARCH |
    | MOVE   | -     | no   | no   | MOVE   |

    Args:
        mode: `Flags.SEARCH` or `Flags.MOVE`.
        touch: every finger of the hand touches.
        lost: none has touched for `GraspThresholds.lost_s`.
        done: the requested motion is finished.
    """
    if mode == Flags.MOVE:
        return Flags.SEARCH if done or lost else Flags.MOVE
    return Flags.MOVE if touch else Flags.SEARCH


class FingerFlags:
    """The flags of one finger over time."""

    def __init__(self, thresholds: GraspThresholds) -> None:
        self.flags = Flags.SEARCH
        self._thresholds = thresholds
        self._slipped_ns: int | None = None
        self._touched_ns: int | None = None

    def step(
        self,
        normal_n: Floats,
        shear_rate_n_s: Floats,
        t_ns: int,
        *,
        slips: bool = False,
        others_touch: bool = True,
        done: bool = False,
    ) -> Flags:
        """Update the flags; return those that changed.

        Args:
            normal_n: float64[n], normal force on each element.
            shear_rate_n_s: float64[n], see `slip.ShearRate`.
            t_ns: time of the sample.
            slips: another sign than the rate of the shear force shows that it slips.
            others_touch: the other fingers of the hand touch.
            done: the requested motion is finished.
        """
        seen = int(analyse(normal_n, shear_rate_n_s, self._thresholds, slips=slips))
        if seen & _SLIP:
            self._slipped_ns = t_ns
        elif _within(self._slipped_ns, t_ns, self._thresholds.slip_hold_s):
            seen |= _SLIP | _TOUCH
        touch = bool(seen & _TOUCH)
        if touch:
            self._touched_ns = t_ns
        lost = not _within(self._touched_ns, t_ns, self._thresholds.lost_s)
        before = int(self.flags)
        mode = next_mode(
            Flags.MOVE if before & _MOVE else Flags.SEARCH,
            touch=touch and others_touch,
            lost=lost,
            done=done,
        )
        now = seen | int(mode)
        if now == before:
            return _NONE
        self.flags = Flags(now)
        return Flags(before ^ now)


def _within(since_ns: int | None, t_ns: int, seconds: float) -> bool:
    return since_ns is not None and 0 <= t_ns - since_ns <= seconds * 1e9
