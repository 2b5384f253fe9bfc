"""Table `[processing.relaxation]` of a configuration, and the file of a fitted foam.

Only this module has the names of the models. It does not need numpy, because `skin --help` lists
them.
"""

from pathlib import Path
from typing import Literal, get_args

import msgspec
from msgspec import Struct

from skin_host.config.fields import NotNegative, Positive
from skin_host.errors import ConfigurationError
from skin_host.files import read_document

RELAXATION_SCHEMA = "skin.relaxation/1"

FittedModel = Literal["published", "asymmetric"]
Model = Literal["none", FittedModel]
#: The models that have parameters, and all models.
FITTED: tuple[FittedModel, ...] = get_args(FittedModel)
MODELS: tuple[Model, ...] = get_args(Model)


class RelaxationSettings(Struct, forbid_unknown_fields=True, kw_only=True, frozen=True):
    """Which viscoelastic model corrects the pressure, and its parameters.

    `set` names a replacement for the paper's lost Table I; explicit numbers take precedence.
    """

    model: Model = "asymmetric"
    set: Literal["mild", "mid", "strong"] = "mid"
    beta: list[NotNegative] | None = None
    tau_s: list[Positive] | None = None
    beta_unload: list[NotNegative] | None = None
    tau_unload_s: list[Positive] | None = None
    #: States are updated this often; 0 means at every sweep.
    update_s: NotNegative = 1.0
    #: A file written by `skin calibrate --relaxation`; it replaces the numbers above.
    file: str | None = None


class RelaxationFile(Struct, kw_only=True):
    """What `skin calibrate --relaxation` writes: one model's parameters for one foam."""

    schema: str
    model: FittedModel
    beta: list[NotNegative]
    tau_s: list[Positive]
    beta_unload: list[NotNegative]
    tau_unload_s: list[Positive]


def wrong_parameters(table: RelaxationSettings) -> str | None:
    """Return what does not fit together in a table; None if everything does."""
    if (table.beta is None) != (table.tau_s is None):
        return "`beta` and `tau_s` go together"
    given = (table.beta, table.tau_s, table.beta_unload, table.tau_unload_s)
    lengths = {len(values) for values in given if values is not None}
    if len(lengths) > 1 or 0 in lengths:
        return "the lists of parameters differ in length"
    return None


def with_file(table: RelaxationSettings, configuration: Path) -> RelaxationSettings:
    """Replace the numbers of a table by those of the file that it names.

    The file's name is relative to the folder of `configuration`.

    Raises:
        ConfigurationError: the file is missing or not a relaxation file.
    """
    if table.file is None:
        return table
    file = configuration.parent / table.file

    def wrong(what: str) -> ConfigurationError:
        return ConfigurationError(
            f"{configuration}: processing.relaxation.file: {file}: {what}; "
            "make one with: skin calibrate CONFIG --relaxation LOG"
        )

    found = read_document(file, RelaxationFile, RELAXATION_SCHEMA, "relaxation", wrong)
    return msgspec.structs.replace(
        table,
        model=found.model,
        beta=found.beta,
        tau_s=found.tau_s,
        beta_unload=found.beta_unload,
        tau_unload_s=found.tau_unload_s,
    )
