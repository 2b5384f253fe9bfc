"""Copies of living things with numpy arrays: what was a view of another array stays one.

`copy.deepcopy` makes an array of its own of each view: a copied engine would write its rows into
one place and read their sums from another.
"""

import io
import pickle
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import Settings
from skin_host.layout import Layout

T = TypeVar("T")
#: Never changed, and so not copied.
SHARED = (Layout, Settings)


def branch(origin: T) -> T:
    """Return a copy that lives on independently."""
    data = io.BytesIO()
    writer = _Writer(data, protocol=5)
    writer.dump(origin)
    data.seek(0)
    made: T = _Reader(data, writer.shared).load()
    return made


class _Writer(pickle.Pickler):
    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.shared: list[Any] = []

    def persistent_id(self, obj: Any) -> int | None:
        if not isinstance(obj, SHARED):
            return None
        self.shared.append(obj)
        return len(self.shared) - 1

    def reducer_override(self, obj: Any) -> Any:
        if type(obj) is not np.ndarray or type(obj.base) is not np.ndarray:
            return NotImplemented
        assert obj.base.flags.forc
        offset = _address(obj) - _address(obj.base)
        return _view, (obj.base, obj.shape, obj.dtype, offset, obj.strides)


class _Reader(pickle.Unpickler):
    def __init__(self, data: io.BytesIO, shared: list[Any]) -> None:
        super().__init__(data)
        self._shared = shared

    def persistent_load(self, pid: int) -> Any:
        return self._shared[pid]


def _address(array: NDArray[Any]) -> int:
    address: int = array.__array_interface__["data"][0]
    return address


def _view(base: NDArray[Any], shape: Any, dtype: Any, offset: int, strides: Any) -> NDArray[Any]:
    return np.ndarray(shape, dtype, base, offset, strides)
