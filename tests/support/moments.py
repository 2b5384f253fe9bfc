"""Programs that do something at a moment of their start that is the same each time: as they import
a module.
"""

import os
from pathlib import Path

#: Python imports this module first, in each interpreter that the program starts, too.
_BEGIN = """
import os, signal, sys, time

class Moment:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            {act}

if any({argument!r} in word for word in sys.orig_argv):
    sys.meta_path.insert(0, Moment())
"""


def at_import(folder: Path, module: str, argument: str, act: str) -> dict[str, str]:
    """Return the environment of a program in which something happens as it imports a module.

    Args:
        folder: for files of this function.
        module: at its import.
        argument: in interpreters with this in their command line.
        act: what happens, a line of Python.
    """
    (folder / "sitecustomize.py").write_text(
        _BEGIN.format(module=module, argument=argument, act=act)
    )
    return os.environ | {"PYTHONPATH": str(folder)}
