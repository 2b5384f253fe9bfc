"""How much pressure the foam has lost: viscoelastic models behind one interface."""

from skin_host.processing.relaxation.asymmetric import AsymmetricRelaxation
from skin_host.processing.relaxation.base import Relaxation
from skin_host.processing.relaxation.prony import NoRelaxation, PronyRelaxation
from skin_host.processing.relaxation.published import PublishedRelaxation
from skin_host.processing.relaxation.sets import (
    OWN_MEANS,
    STAND_INS,
    ParameterSet,
    make_model,
    make_relaxation,
    parameters_of,
    stand_in,
)
from skin_host.processing.relaxation.windowed import WindowedRelaxation

__all__ = [
    "OWN_MEANS",
    "STAND_INS",
    "AsymmetricRelaxation",
    "NoRelaxation",
    "ParameterSet",
    "PronyRelaxation",
    "PublishedRelaxation",
    "Relaxation",
    "WindowedRelaxation",
    "make_model",
    "make_relaxation",
    "parameters_of",
    "stand_in",
]
