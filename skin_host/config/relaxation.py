"""Table `[processing.relaxation]` of a configuration, and the file of a fitted foam.

Only this module has the names of the models. It does not need numpy, because `skin --help` lists
them.
"""

import math
from pathlib import Path
from typing import Annotated, Literal, get_args

import msgspec
from msgspec import Meta, Struct

from skin_host.config.fields import FileName, Seconds, Share
from skin_host.errors import ConfigurationError, visible
from skin_host.files import read_document

RELAXATION_SCHEMA = "skin.relaxation/1"

FittedModel = Literal["published", "asymmetric"]
Model = Literal["none", FittedModel]
#: The models that have parameters, and all models.
FITTED: tuple[FittedModel, ...] = get_args(FittedModel)
MODELS: tuple[Model, ...] = get_args(Model)
#: One number a mode.
Shares = Annotated[list[Share], Meta(min_length=1, max_length=64)]
Times = Annotated[list[Seconds], Meta(min_length=1, max_length=64)]

#: Means of a shorter time are too noisy for drift to be followed.
SHORTEST_UPDATE_S = 0.2


class RelaxationSettings(Struct, forbid_unknown_fields=True, kw_only=True, frozen=True):
    """Which viscoelastic model corrects the pressure, and its parameters.

    `set` names a replacement for the paper's lost Table I; explicit numbers take precedence.
    """

    model: Model = "asymmetric"
    set: Literal["mild", "mid", "strong"] = "mid"
    beta: Shares | None = None
    tau_s: Times | None = None
    beta_unload: Shares | None = None
    tau_unload_s: Times | None = None
    #: States are updated this often from means, every 0.2 to 5 s; 0 updates them at every sweep.
    update_s: Annotated[float, Meta(ge=0, le=5)] = 1.0
    #: A file written by `skin calibrate --relaxation`; it replaces the numbers above.
    file: FileName | None = None


class RelaxationFile(Struct, kw_only=True):
    """What `skin calibrate --relaxation` writes: one model's parameters for one foam."""

    schema: str
    model: FittedModel
    beta: Shares
    tau_s: Times
    beta_unload: Shares
    tau_unload_s: Times


def with_file(table: RelaxationSettings, configuration: Path) -> RelaxationSettings:
    """Replace the numbers of a table by those of the file that it names, and check what it has.

    The file's name is relative to the folder of `configuration`.

    Raises:
        ConfigurationError: the file is missing or not a relaxation file, or the numbers do not fit
            together, wherever they come from.
    """

    def wrong(what: str) -> ConfigurationError:
        return ConfigurationError(f"{configuration}: processing.relaxation{visible(what)}")

    if table.file is None:
        misfit = _misfit(table)
        if misfit is not None:
            raise wrong(f": {misfit}")
        return table
    file = configuration.parent / table.file

    def wrong_file(what: str) -> ConfigurationError:
        return wrong(
            f".file: {file}: {what}; make one with: skin calibrate CONFIG --relaxation LOG"
        )

    found = read_document(file, RelaxationFile, RELAXATION_SCHEMA, "relaxation", wrong_file)
    table = msgspec.structs.replace(
        table,
        model=found.model,
        beta=found.beta,
        tau_s=found.tau_s,
        beta_unload=found.beta_unload,
        tau_unload_s=found.tau_unload_s,
    )
    misfit = _misfit(table)
    if misfit is not None:
        raise wrong_file(misfit)
    return table


def _misfit(table: RelaxationSettings) -> str | None:
    """Return what does not fit together in a table; None if everything does."""
    if 0.0 < table.update_s < SHORTEST_UPDATE_S:
        return (
            f"`update_s`: {table.update_s:g}; wanted 0, or {SHORTEST_UPDATE_S:g} to 5 s: means of "
            "fewer sweeps are mostly noise"
        )
    if (table.beta is None) != (table.tau_s is None):
        return "`beta` and `tau_s` go together"
    given = (table.beta, table.tau_s, table.beta_unload, table.tau_unload_s)
    if len({len(values) for values in given if values is not None}) > 1:
        return "the lists of parameters differ in length"
    for name in ("beta", "beta_unload"):
        taken = math.fsum(getattr(table, name) or ())
        if taken >= 1.0:
            return (
                f"`{name}`: the shares sum to {taken:g}; wanted less than 1, or nothing is left of "
                "a press that lasts"
            )
    return None
