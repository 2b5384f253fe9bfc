"""Force and torque from strain gauges: calibration matrix, condition number, error bounds.

The gauges answer linearly, V = V0 + C P (Bicchi and Dario, eqs. 10-11). The fit is of V on
the known loads P, because the noise sits in V; the inverse fit of P on V (Son et al., eq.
3.7) would pull the loads towards zero. Load components are in the order of the caller's own
columns, usually fx fy fz (N) and mx my mz (N mm).

Where gauges are placed: two published fingertips as parametric models, and a search.
`cylinder_response` is the thin-walled cylinder with six gauges of Bicchi and Dario, eqs. 16-17.
`PlanarStructure` is the pair of beams of the multi-axial study, Tables 1-3. Both give response
matrices for `condition_number`. `intrinsic_errors` locates contacts by force and torque alone.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skin_host.errors import CalibrationError
from skin_host.fingertip.intrinsic import locate, point_covariance, sphere

Floats = NDArray[np.float64]

#: Published factors of Bicchi and Dario, eq. 9, at friction coefficients 0.1, 0.3, 0.5.
PUBLISHED_FRICTION_FACTOR = {0.1: 1.08, 0.3: 1.62, 0.5: 2.30}


@dataclass(frozen=True)
class ForceTorqueCalibration:
    """What a calibration found.

    Attributes:
        response: float64[g, m], signal of each gauge per unit of each load component.
        offset: float64[g], signal at no load.
        noise: float64[g], standard deviation of what the fit leaves of each gauge.
        response_sd: float64[g, m], standard error of `response`.
    """

    response: Floats
    offset: Floats
    noise: Floats
    response_sd: Floats

    @cached_property
    def matrix(self) -> Floats:
        """float64[m, g], load = matrix @ (signal - offset), weighted by the gauges' noise."""
        weight = 1.0 / np.maximum(self.noise, 1e-12 * max(self.noise.max(), 1e-300))
        inverse: Floats = np.linalg.pinv(self.response * weight[:, None]) * weight
        return inverse

    def loads(self, signals: ArrayLike) -> Floats:
        """Loads float64[..., m] of signals [..., g]."""
        loads: Floats = (np.asarray(signals, np.float64) - self.offset) @ self.matrix.T
        return loads

    def load_covariance(self) -> Floats:
        """float64[m, m], covariance of one reading's loads from the gauges' noise."""
        scaled = self.matrix * self.noise
        covariance: Floats = scaled @ scaled.T
        return covariance

    def relative_response_error(self, nominal_load: ArrayLike) -> float:
        """|dC| / |C| for `relative_error_bound`, with load columns scaled by `nominal_load`.

        The Frobenius norm of the standard errors over the spectral norm of C: an upper
        value, as the spectral norm of an error never exceeds its Frobenius norm.
        """
        scale = np.asarray(nominal_load, np.float64)
        return float(
            np.linalg.norm(self.response_sd * scale) / np.linalg.norm(self.response * scale, 2)
        )


def calibrate(signals: ArrayLike, loads: ArrayLike) -> ForceTorqueCalibration:
    """Fit response and offset of every gauge by least squares.

    Args:
        signals: [k, g], one row per known load.
        loads: [k, m], the loads. They must span all m components and the zero.

    Raises:
        CalibrationError: numbers missing, or loads that do not separate the components.
    """
    v = np.asarray(signals, np.float64)
    p = np.asarray(loads, np.float64)
    if v.ndim != 2 or p.ndim != 2 or len(v) != len(p):
        raise CalibrationError(
            f"force/torque calibration: signals {v.shape} and loads {p.shape}; "
            "wanted two tables with one row per known load"
        )
    n, m = p.shape
    if not (np.isfinite(v).all() and np.isfinite(p).all()):
        raise CalibrationError("force/torque calibration: a signal or load is not a number")
    # Columns are scaled to 1 so that N beside N mm do not decide the rank.
    scale = np.abs(p).max(axis=0, initial=0.0)
    scale[scale == 0.0] = 1.0
    design = np.column_stack([p / scale, np.ones(n)])
    rank = int(np.linalg.matrix_rank(design))
    if rank < m + 1:
        raise CalibrationError(
            f"force/torque calibration: {n} loads span {rank} of {m + 1} unknowns per gauge; "
            f"wanted loads along all {m} components, and one without load"
        )
    if v.shape[1] < m:
        raise CalibrationError(
            f"force/torque calibration: {v.shape[1]} gauges for {m} load components"
        )
    solution, *_ = np.linalg.lstsq(design, v, rcond=None)
    rest = v - design @ solution
    noise = np.sqrt((rest**2).sum(axis=0) / max(n - m - 1, 1))
    spread = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    return ForceTorqueCalibration(
        response=(solution[:m] / scale[:, None]).T.copy(),
        offset=solution[m].copy(),
        noise=noise,
        response_sd=noise[:, None] * (spread[:m] / scale),
    )


def condition_number(matrix: ArrayLike, load_scale: ArrayLike | None = None) -> float:
    """The 2-norm condition number of a response matrix [g, m] (Bicchi and Dario, eq. 14).

    It depends on the units of the loads: a force in N beside a moment in N mm. With
    `load_scale` [m], the nominal loads, columns are multiplied by them first, as Bicchi and
    Dario do; without it the number belongs to the units of `matrix` as it stands.
    """
    c = np.asarray(matrix, np.float64)
    if load_scale is not None:
        c = c * np.asarray(load_scale, np.float64)
    return float(np.linalg.cond(c))


def relative_error_bound(condition: float, signal_error: float, response_error: float) -> float:
    """Upper bound of |dP| / |P| from |dV| / |V| and |dC| / |C| (Bicchi and Dario, eq. 14).

    The paper's law is of first order, (eV + eC) Nc. The division makes it hold for
    errors of any size; it is infinite where the errors may make C singular.
    """
    loss = 1.0 - condition * response_error
    if loss <= 0.0:
        return float("inf")
    return condition * (signal_error + response_error) / loss


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
    rms = float(np.sqrt(np.nanmean(np.square(error))))
    return rms, float(predicted), float(np.isnan(error).mean())


def sphere_error_bound(radius_mm: float, relative_error: float, friction: float = 0.0) -> float:
    """Upper bound of the contact's error on a sphere, mm (Bicchi and Dario, eqs. 3-9).

    2 R Ef f(q): the interval bound of first order of the closed form, for a push with
    tangential force over normal force = tan q = `friction` and all of it in one plane.
    The printed factors 1.08, 1.62, 2.30 at 0.1, 0.3, 0.5 are up to 8 % above this
    derivation (1.07, 1.52, 2.13); the scan of the paper does not show the reason.
    """
    sin2 = friction**2 / (1.0 + friction**2)
    cos2 = 1.0 - sin2
    along = 4.0 * sin2 + cos2
    across = 3.0 * np.sqrt(sin2 * cos2) + 2.0 * sin2 * friction
    return float(2.0 * radius_mm * relative_error * np.hypot(along, across))
