"""Named sets of parameters, and a model made from the settings.

The paper's Table I (its twelve parameters) is not in any public copy of it. The sets
here are replacements: they agree with its text about the foam, and they span the known range of
porous silicones. For the numbers of a real skin, fit them to a
recording: `skin calibrate --relaxation LOG`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike

from skin_host.config.relaxation import MODELS
from skin_host.config.relaxation import RelaxationSettings as Settings
from skin_host.processing.relaxation.base import Parameters, Relaxation
from skin_host.processing.relaxation.models import (
    AsymmetricRelaxation,
    NoRelaxation,
    PublishedRelaxation,
)

#: Evenly spaced modes, from a second to the longest that an hour's record can distinguish from a
#: constant.
LOG_TAU_S = (1.0, 4.8, 23.0, 110.0, 520.0, 2500.0)
#: Models that take means of their own, and so must see every sample.
OWN_MEANS = ("published",)


@dataclass(frozen=True)
class ParameterSet:
    """Shares and time constants of the modes, for pressing and for letting go."""

    beta: Parameters
    tau_s: Parameters
    beta_unload: Parameters
    tau_unload_s: Parameters


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


def stand_in(model: str, name: str) -> ParameterSet:
    """Return the stand-in set `name` (mild, mid, strong) as `model` wants it."""
    chosen = STAND_INS[name]
    if model != "asymmetric":
        return chosen
    return log_spaced(float(np.sum(np.asarray(chosen.beta))))


def make_model(
    model: str,
    n: int,
    parameters: ParameterSet,
    *,
    held: bool = False,
    dtype: DTypeLike = np.float64,
) -> Relaxation:
    """Make a relaxation model by name for n taxels.

    Args:
        model: one of MODELS.
        n: number of taxels.
        parameters: of the model; those of unloading serve the models that have them.
        held: whether the published model's answer stays the same between the ends of its
            averages.
        dtype: of states and answers.

    Raises:
        ValueError: no such model, or parameters that do not fit together.
    """
    match model:
        case "none":
            return NoRelaxation(n, dtype=dtype)
        case "published":
            return PublishedRelaxation(
                n,
                beta_load=parameters.beta,
                tau_load_s=parameters.tau_s,
                beta_unload=parameters.beta_unload,
                tau_unload_s=parameters.tau_unload_s,
                held=held,
                dtype=dtype,
            )
        case "asymmetric":
            return AsymmetricRelaxation(
                n,
                beta=parameters.beta,
                tau_s=parameters.tau_s,
                tau_unload_s=parameters.tau_unload_s,
                dtype=dtype,
            )
        case _:
            raise ValueError(f'no relaxation model "{model}"; there are: {", ".join(MODELS)}')


def parameters_of(settings: Settings) -> ParameterSet:
    """Return the parameters that a configuration asks for (table `processing.relaxation`)."""
    if settings.beta is None or settings.tau_s is None:
        return stand_in(settings.model, settings.set)
    return ParameterSet(
        settings.beta,
        settings.tau_s,
        settings.beta if settings.beta_unload is None else settings.beta_unload,
        settings.tau_s if settings.tau_unload_s is None else settings.tau_unload_s,
    )
