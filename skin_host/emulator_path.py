"""Make the package `emulator` importable where this project is installed from a wheel.

In a checkout `emulator/` lies beside `skin_host/` and needs no help. A wheel holds it inside
`skin_host`, because a top-level `emulator` in a shared site-packages would overwrite another
project's. Its modules import each other as `emulator.*`, so it keeps that name at run time.
"""

import sys
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path

_FOLDER = Path(__file__).parent / "_emulator"


class _Finder:
    """Finds the name `emulator` only; its submodules are found through its path."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if name != "emulator":
            return None
        return spec_from_file_location(
            name, _FOLDER / "__init__.py", submodule_search_locations=[str(_FOLDER)]
        )


def provide() -> None:
    """Make `import emulator` find the installed emulator, before any other package of that name.

    Programs that import only the client do not call this, so that `emulator` stays free in them.
    """
    if _FOLDER.is_dir() and _Finder not in sys.meta_path:
        sys.meta_path.insert(0, _Finder)
