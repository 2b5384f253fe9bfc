"""How much pressure the foam has lost: viscoelastic models behind one interface."""

from skin_host.processing.relaxation.base import Relaxation
from skin_host.processing.relaxation.models import (
    AsymmetricRelaxation,
    NoRelaxation,
    PlayRelaxation,
    PublishedRelaxation,
)
from skin_host.processing.relaxation.sets import (
    OWN_MEANS,
    STAND_INS,
    ParameterSet,
    make_model,
    parameters_of,
    stand_in,
)

__all__ = [
    "OWN_MEANS",
    "STAND_INS",
    "AsymmetricRelaxation",
    "NoRelaxation",
    "ParameterSet",
    "PlayRelaxation",
    "PublishedRelaxation",
    "Relaxation",
    "make_model",
    "parameters_of",
    "stand_in",
]
