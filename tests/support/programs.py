"""Programs from outside that tests run."""

import os
import shutil

import pytest

#: Debian keeps some in directories that only root has on its path.
_PATH = os.pathsep.join([os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"])


def find(name: str) -> str | None:
    """Return the path of the program, or None where it is not installed."""
    return shutil.which(name, path=_PATH)


def require(name: str) -> str:
    """Return the path of the program; without it the test fails, it does not skip."""
    path = find(name)
    if path is None:
        pytest.fail(f"{name} is not installed: run 'sudo tools/lane/packages'", pytrace=False)
    return path
