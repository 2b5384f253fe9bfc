"""A whole robot as bytes, and back: what is saved goes on as if it had never been interrupted.

Settings and layout are not part of it, but a digest of them is: a state is restored with the
configuration that it was saved with. A state is checked as it is read: it may hold nothing but
the emulator's own objects, numbers, arrays and generators, and names no other code.
"""

import hashlib
import io
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from skin_host.errors import RequestError
from skin_host.files import read_whole

MAGIC = b"skin-emulator-state/12\n"
DIGEST_BYTES = 32
#: Decimal places of positions (m) and of what else the digest has of a layout.
PLACES = 9
#: More than a robot of 100 000 taxels needs.
MOST_BYTES = 2_000_000_000

#: Classes and functions of others that a state may name.
_OTHERS = {
    ("builtins", "set"),
    ("builtins", "slice"),
    ("builtins", "complex"),
    ("functools", "partial"),
    ("pathlib", "PosixPath"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy.random._pickle", "__generator_ctor"),
    ("numpy.random._pickle", "__bit_generator_ctor"),
    ("numpy.random._pcg64", "PCG64"),
    ("numpy.random.bit_generator", "SeedSequence"),
    ("numpy.random.bit_generator", "__pyx_unpickle_SeedSequence"),
    ("msgspec._utils", "rebuild"),
    ("smbus2.smbus2", "I2cFunc"),
}
#: Functions of the emulator that a state may name: arithmetic of boards, and how faults end.
_FUNCTIONS = {
    ("emulator.faults", name)
    for name in (
        "_babble",
        "_hold",
        "_latch",
        "_move",
        "_newest",
        "_put",
        "_rewired",
        "_set_noise",
        "_set_wire",
        "_silence",
        "_silence_fingertip",
        "_swap",
        "_unplug",
        "_warm",
    )
}
_FUNCTIONS |= {("emulator.boards.arithmetic", f"transmit_{bits}") for bits in (16, 32)}
#: Modules whose classes a state may hold, and those that open devices or buses.
_PARTS = (
    "emulator.",
    "skin_host.bus.answers",
    "skin_host.bus.commands",
    "skin_host.bus.compensation",
    "skin_host.bus.strain",
    "skin_host.bus.wire",
    "skin_host.fingertip.",
    "skin_host.layout",
    "skin_host.config.",
)
_DOORS = (
    "emulator.chips.cuse",
    "emulator.link",
)
#: Methods that a robot keeps for later. A state can call what it names, so it may name no other:
#: `Robot.write`, for example, replaces a file.
_METHODS = {
    ("emulator.boards.fingertips", "Fingertips", "_force_on_skin"),
    ("emulator.chips.converters", "Converters", "answer_second"),
    ("emulator.chips.converters", "Converters", "force"),
    ("emulator.chips.i2c_wire", "DataLine", "flip"),
    ("emulator.chips.i2c_wire", "DataLine", "hold"),
    ("emulator.chips.i2c_wire", "DataLine", "refuse"),
    ("emulator.chips.i2c_wire", "DataLine", "rise_slowly"),
    ("emulator.chips.i2c_wire", "DataLine", "stretch"),
    ("emulator.probes.coverage", "Coverage", "_inside"),
    ("emulator.robot", "LiveProbe", "pressing_n"),
    ("emulator.robot", "LiveProbe", "pulling_n"),
    ("emulator.robot", "Robot", "_happen"),
    ("emulator.robot", "Robot", "_skin_force_n"),
}


class StateError(RequestError):
    """A saved state cannot be used."""


def save(robot: object, configuration: Sequence[Any]) -> bytes:
    """A robot as bytes; `configuration` (settings, layout) is only referred to."""
    parts = {id(part): number for number, part in enumerate(configuration)}

    class Pickler(pickle.Pickler):
        def persistent_id(self, thing: object) -> int | None:
            return parts.get(id(thing))

    file = io.BytesIO()
    Pickler(file, protocol=5).dump(robot)
    return MAGIC + _digest(configuration) + file.getvalue()


def restore(data: bytes, configuration: Sequence[Any]) -> object:
    """What was saved.

    Raises:
        StateError: not a saved state, or one of another configuration or version.
    """
    if not data.startswith(MAGIC):
        raise StateError("not a state of this version of the emulator; save it again")
    start = len(MAGIC) + DIGEST_BYTES
    if data[len(MAGIC) : start] != _digest(configuration):
        raise StateError("the state is of another configuration; wanted the one it was saved with")

    class Unpickler(pickle.Unpickler):
        def persistent_load(self, number: Any) -> object:
            return configuration[number]

        def find_class(self, module: str, name: str) -> object:
            return _allowed(module, name, super().find_class)

    try:
        return Unpickler(io.BytesIO(data[start:])).load()
    except StateError:
        raise
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise StateError(f"the state is damaged: {reason}; save it again") from None


def read(path: Path) -> bytes:
    """The bytes of a saved state.

    Raises:
        StateError: the file cannot be read, or is too large.
    """
    try:
        return read_whole(path, MOST_BYTES)
    except OSError as error:
        raise StateError(f"cannot be read: {error.strerror}") from None


def _digest(configuration: Sequence[Any]) -> bytes:
    settings, layout = configuration
    found = hashlib.sha256(msgspec.json.encode(settings))
    # Files that settings name may have changed, and so may the kinds of pads. Rounded: another
    # computer's sine may differ in its last bit.
    for array in (layout.position_m, layout.normal, layout.unit_ff, layout.sensitivity):
        found.update((np.round(array, PLACES) + 0.0).tobytes())  # no -0.0
    return found.digest()


def _allowed(module: str, name: str, find: Any) -> object:
    """A class or function that a state may name.

    Raises:
        StateError: it is none of them.
    """
    if (module, name) == ("builtins", "getattr"):
        return _method
    if (module, name) in _OTHERS | _FUNCTIONS:
        return find(module, name)
    if module.startswith(_PARTS) and not module.startswith(_DOORS) and "." not in name:
        found = find(module, name)
        if isinstance(found, type) and found.__module__ == module:
            return found
    raise StateError(f"the state names {module}.{name}, which is no part of a robot")


def _method(thing: object, name: str) -> object:
    """One of `_METHODS`.

    Raises:
        StateError: it is none of them.
    """
    kind = type(thing)
    if (kind.__module__, kind.__qualname__, name) not in _METHODS:
        raise StateError(f"the state names {kind.__name__}.{name}, which no robot keeps")
    return getattr(thing, name)
