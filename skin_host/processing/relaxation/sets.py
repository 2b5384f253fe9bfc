"""Named sets of parameters, and a model made from the settings.

The paper's Table I (its twelve parameters) is not in any public copy of it. The sets
here are stand-ins: they agree with what its text says about the foam, and they span what
porous silicones are known to do. Whoever needs the numbers of a real skin fits them to a
recording: `skin calibrate --relaxation LOG`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from skin_host.processing.relaxation.asymmetric import AsymmetricRelaxation
from skin_host.processing.relaxation.base import Parameters, Relaxation
from skin_host.processing.relaxation.prony import NoRelaxation, PronyRelaxation
from skin_host.processing.relaxation.published import PublishedRelaxation
from skin_host.processing.relaxation.windowed import WindowedRelaxation
from skin_host.relaxation_settings import MODELS
from skin_host.relaxation_settings import Relaxation as Settings

BLEED_S = 20.0
#: Evenly spaced modes, from a second to what an hour's record can tell from a constant.
LOG_TAU_S = (1.0, 4.8, 23.0, 110.0, 520.0, 2500.0)
#: Models that take means of their own, and so must see every sample.
OWN_MEANS = ("published", "published_bleed")
#: The pressure at which the stand-ins' time constants hold when there is a clock.
TYPICAL_KPA = 60.0


@dataclass(frozen=True)
class ParameterSet:
    """Shares and time constants of the modes, for pressing and for letting go.

    With a clock (see AsymmetricRelaxation) the time constants are those at zero pressure.
    """

    beta: Parameters
    tau_s: Parameters
    beta_unload: Parameters
    tau_unload_s: Parameters
    clock_kpa: float | NDArray[np.float64] = np.inf


STAND_INS = {
    "mild": ParameterSet((0.04, 0.05, 0.06), (4, 90, 1500), (0.035, 0.05, 0.06), (8, 180, 3000)),
    "mid": ParameterSet((0.07, 0.08, 0.10), (6, 120, 1800), (0.06, 0.08, 0.09), (12, 240, 3600)),
    "strong": ParameterSet((0.10, 0.12, 0.18), (8, 150, 2400), (0.08, 0.11, 0.16), (20, 400, 4800)),
}


def log_spaced(total_beta: float, unload_ratio: float = 2.0) -> ParameterSet:
    """Return modes spaced evenly in the logarithm of time, sharing `total_beta` alike."""
    beta = tuple(total_beta / len(LOG_TAU_S) for _ in LOG_TAU_S)
    slow = tuple(unload_ratio * tau for tau in LOG_TAU_S)
    return ParameterSet(beta, LOG_TAU_S, beta, slow)


def shared_cause(
    beta: Parameters, tau_s: Parameters, unload_ratio: ArrayLike, level_kpa: float
) -> ParameterSet:
    """Return parameters that lay slow unloading half to direction and half to the clock.

    Args:
        beta: share of each mode.
        tau_s: time constants of loading at `level_kpa`, [modes] or [modes, k].
        unload_ratio: how much slower unloading to zero is, above 1; one or [k].
        level_kpa: the level of the hold at which that was seen.
    """
    logarithm = np.log(np.maximum(np.asarray(unload_ratio, dtype=np.float64), 1.0 + 1e-9))
    tau = np.asarray(tau_s, dtype=np.float64)
    at_zero = tau * np.exp(0.5 * logarithm)
    unloading = tau * np.exp(logarithm)
    return ParameterSet(beta, at_zero, beta, unloading, level_kpa / (0.5 * logarithm))


def stand_in(model: str, name: str) -> ParameterSet:
    """Return the stand-in set `name` (mild, mid, strong) as `model` wants it."""
    chosen = STAND_INS[name]
    if model not in ("asymmetric_log", "asymmetric_clock"):
        return chosen
    spaced = log_spaced(float(np.sum(np.asarray(chosen.beta))))
    if model == "asymmetric_log":
        return spaced
    return shared_cause(spaced.beta, spaced.tau_s, 2.0, TYPICAL_KPA)


def make_model(
    model: str,
    n: int,
    parameters: ParameterSet,
    *,
    update_s: float = 0.0,
    dtype: DTypeLike = np.float64,
) -> Relaxation:
    """Make a relaxation model by name for n taxels.

    Args:
        model: one of MODELS.
        n: number of taxels.
        parameters: of the model; those of unloading serve the models that have them.
        update_s: 0 brings the states up to date at every step, else once in so many seconds
            (the published model: at the end of its averages).
        dtype: of states and answers.

    Raises:
        ValueError: no such model, or parameters that do not fit together.
    """
    made: Relaxation
    match model:
        case "none":
            return NoRelaxation(n, dtype=dtype)
        case "published" | "published_bleed":
            return PublishedRelaxation(
                n,
                beta_load=parameters.beta,
                tau_load_s=parameters.tau_s,
                beta_unload=parameters.beta_unload,
                tau_unload_s=parameters.tau_unload_s,
                bleed_s=BLEED_S if model == "published_bleed" else None,
                held=update_s > 0.0,
                dtype=dtype,
            )
        case "prony":
            made = PronyRelaxation(n, beta=parameters.beta, tau_s=parameters.tau_s, dtype=dtype)
        case "asymmetric" | "asymmetric_log" | "asymmetric_clock":
            made = AsymmetricRelaxation(
                n,
                beta=parameters.beta,
                tau_s=parameters.tau_s,
                tau_unload_s=parameters.tau_unload_s,
                clock_kpa=parameters.clock_kpa,
                dtype=dtype,
            )
        case _:
            raise ValueError(f'no relaxation model "{model}"; there are: {", ".join(MODELS)}')
    return WindowedRelaxation(made, update_s, dtype) if update_s > 0.0 else made


def parameters_of(settings: Settings) -> ParameterSet:
    """Return the parameters that a configuration asks for (table `processing.relaxation`)."""
    if settings.beta is None or settings.tau_s is None:
        return stand_in(settings.model, settings.set)
    return ParameterSet(
        settings.beta,
        settings.tau_s,
        settings.beta if settings.beta_unload is None else settings.beta_unload,
        settings.tau_s if settings.tau_unload_s is None else settings.tau_unload_s,
        np.inf if settings.clock_kpa is None else settings.clock_kpa,
    )


def make_relaxation(settings: Settings, n: int, *, dtype: DTypeLike = np.float64) -> Relaxation:
    """Make the model that a configuration asks for (table `processing.relaxation`)."""
    return make_model(
        settings.model, n, parameters_of(settings), update_s=settings.update_s, dtype=dtype
    )
