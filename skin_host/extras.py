"""Imports optional packages, which are extras of the installation."""

import importlib
from typing import Any

from skin_host.errors import SkinError


def required(module: str, what: str, extra: str) -> Any:
    """Import a module of an extra.

    Args:
        module: to import.
        what: needs it, in the plural: "MCAP recordings".
        extra: of the project that brings it.

    Raises:
        SkinError: it is not installed; the message gives the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise SkinError(
            f"{what} need the package {package}, which is not installed; "
            f"mend it with: pip install 'skin-host[{extra}]'"
        ) from None
