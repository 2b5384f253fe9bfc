"""Force and torque from strain gauges: calibration matrix, condition number, error bounds.

The gauges answer linearly, V = V0 + C P (Bicchi and Dario, eqs. 10-11). The fit is of V on
the known loads P, because the noise sits in V; the inverse fit of P on V (Son et al., eq.
3.7) would pull the loads towards zero. Load components are in the order of the caller's own
columns, usually fx fy fz (N) and mx my mz (N mm).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skin_host.errors import CalibrationError

Floats = NDArray[np.float64]


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
