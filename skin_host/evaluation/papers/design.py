"""Placement of strain gauges: two published fingertips as parametric models, and a search.

`cylinder_response` is the thin-walled cylinder with six gauges of Bicchi and Dario, eqs.
16-17. `PlanarStructure` is the pair of beams of the multi-axial study, Tables 1-3. Both give
response matrices for `force_torque.condition_number`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skin_host.evaluation.papers.force_torque import condition_number

Floats = NDArray[np.float64]

#: Azimuths and signs of the six gauges of Bicchi and Dario, Fig. 3. The table in the scan is
#: damaged; this is the one arrangement for which the decoupling matrix M of its eq. 19
#: gives the almost diagonal matrix of eq. 20.
CYLINDER_AZIMUTH_DEG = (0.0, 90.0, 180.0, 270.0, 0.0, 90.0)
CYLINDER_TURN_SIGN = (1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
CYLINDER_ROW = (0.0, 0.0, 0.0, 0.0, 1.0, 1.0)

#: The sums and differences of eq. 19 that almost decouple the six signals.
CYLINDER_DECOUPLING: Floats = np.array(
    [
        [1, 1, 1, 1, 0, 0],
        [-1, 0, 0, 0, 1, 0],
        [0, -1, 0, 0, 0, 1],
        [1, -1, 1, -1, 0, 0],
        [0, 1, 0, -1, 0, 0],
        [1, 0, -1, 0, 0, 0],
    ],
    np.float64,
)


def cylinder_response(
    turn_rad: ArrayLike,
    azimuth_rad: ArrayLike,
    height_mm: ArrayLike,
    radius_mm: float,
    *,
    poisson: float = 0.33,
) -> Floats:
    """Strain of gauges on a thin-walled cantilever cylinder per unit load, float64[g, 6].

    Columns: f1 along the axis, away from the clamp, f2, f3 (N); torsion m1, bending m2,
    m3 (N mm), about the centre of the first row; azimuth turns from axis 2 to axis 3.
    Bicchi and Dario, eqs. 16-17, with the signs of a right-handed frame. Their eq. 16 has
    sine and cosine of the bending columns interchanged against their own eq. 20, and
    bending and shear of f3 with one sign. Strains are in units of Wn = 1 / (2 pi E R s),
    so wall and modulus drop out.

    Args:
        turn_rad: [g], angle of each gauge to the cylinder's axis.
        azimuth_rad: [g], where around the cylinder.
        height_mm: [g], distance from the first row towards the clamped end.
        radius_mm: of the cylinder.
        poisson: of its material.
    """
    turn, azimuth, height = (
        np.asarray(values, np.float64) for values in (turn_rad, azimuth_rad, height_mm)
    )
    along = np.cos(turn) ** 2 - poisson * np.sin(turn) ** 2
    across = np.sin(2.0 * turn)
    bending = 2.0 / radius_mm
    shear = 2.0 * (1.0 + poisson)
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    return np.column_stack(
        [
            along,
            -height * along * cos * bending - across * sin * shear,
            -height * along * sin * bending + across * cos * shear,
            across * (1.0 + poisson) / radius_mm,
            along * sin * bending,
            -along * cos * bending,
        ]
    )


def six_gauge_cylinder(
    turn_deg: float, height_mm: float, radius_mm: float, *, poisson: float = 0.33
) -> Floats:
    """The arrangement of Bicchi and Dario, Fig. 3: turn Q, distance d of the rows, radius R."""
    return cylinder_response(
        np.deg2rad(turn_deg) * np.array(CYLINDER_TURN_SIGN),
        np.deg2rad(CYLINDER_AZIMUTH_DEG),
        height_mm * np.array(CYLINDER_ROW),
        radius_mm,
        poisson=poisson,
    )


@dataclass(frozen=True, slots=True)
class PlanarStructure:
    """A clamped beam with a second one standing on its middle, and the fingertip on top.

    The multi-axial study, Figs. 1-4. Lengths in any one unit; stresses are per unit force
    and width.

    Attributes:
        half_length: a, half of the horizontal beam.
        height: d, of the vertical beam; its upper end is the fingertip's centre.
        radius: r, of the fingertip.
        thickness_h: h1, of the horizontal beam.
        thickness_v: h2, of the vertical beam.
    """

    half_length: float = 1.0
    height: float = 1.0
    radius: float = 1.0
    thickness_h: float = 1.0
    thickness_v: float = float(np.sqrt(8.0 / 3.0))

    def stresses(self, *, axial: bool = False) -> dict[str, Floats]:
        """Surface stress at the six candidate places, float64[3] each.

        Components multiply P sin(phi), P sin(theta - phi) and P cos(phi): vertical force,
        moment about the fingertip's centre over r, horizontal force. L and R are at the
        clamps, K and S beside the joint, T and U at top and bottom of the vertical beam.
        Beam theory: a central load W bends a clamped beam of length 2 a by W a / 4 at
        clamps and middle, a central moment M by M / 4 at the clamps and M / 2 beside it.
        The published condition numbers follow from bending alone; `axial` adds the
        tension of the beams.
        """
        h1, h2 = self.thickness_h, self.thickness_v
        load = 1.5 * self.half_length / h1**2
        moment = np.array([0.0, self.radius, self.height]) / h1**2
        clamp, joint = 1.5 * moment, 3.0 * moment
        pull = np.array([0.0, 0.0, 0.5 / h1]) if axial else np.zeros(3)
        stand = np.array([-1.0 / h2, 0.0, 0.0]) if axial else np.zeros(3)
        down = np.array([load, 0.0, 0.0])
        top = np.array([0.0, 6.0 * self.radius / h2**2, 0.0])
        bottom = np.array([0.0, 6.0 * self.radius / h2**2, 6.0 * self.height / h2**2])
        return {
            "L": down + clamp + pull,
            "R": down - clamp - pull,
            "K": -down - joint - pull,
            "S": -down + joint + pull,
            "T": top + stand,
            "U": bottom + stand,
        }

    def placements(self, *, axial: bool = False) -> list[tuple[float, str]]:
        """Condition number and name of every choice of three places, best first.

        Columns are scaled as in `stresses`: the moment is divided by r.
        """
        stresses = self.stresses(axial=axial)
        found = [
            (condition_number(np.array([stresses[place] for place in three])), "".join(three))
            for three in combinations("LRKSTU", 3)
        ]
        return sorted(found)


def pattern_search(
    cost: Callable[[Floats], float],
    start: ArrayLike,
    step: ArrayLike,
    *,
    finest: float = 1e-4,
) -> tuple[Floats, float]:
    """Tumble down into the nearest hollow of `cost` (Bicchi and Dario, Fig. 4).

    Steps along one parameter after the other; where none helps the steps are halved,
    until they are `finest` of what they were.

    Returns:
        The parameters of the hollow and its cost.
    """
    best = np.array(start, np.float64)
    steps = np.array(step, np.float64)
    lowest = cost(best)
    shrink = 1.0
    while shrink > finest:
        improved = False
        for i in range(len(best)):
            for sign in (1.0, -1.0):
                trial = best.copy()
                trial[i] += sign * shrink * steps[i]
                value = cost(trial)
                if value < lowest:
                    best, lowest, improved = trial, value, True
                    break
        if not improved:
            shrink *= 0.5
    return best, lowest
