"""Going back: what a robot was at a moment, kept so that it can be that again at little cost.

Unlike a saved state (`emulator.state`) a mark is of one living robot, and holds references: what
its objects hold is put back in place, so that they are the same objects afterwards.
"""

from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

#: How the contents of things that change in place are kept, and put back.
_KEEP: dict[type, tuple[Callable[[Any], Any], Callable[[Any, Any], None]]] = {}


def _put_array(array: Any, content: Any) -> None:
    if content is not None:
        array[...] = content


def _put_sequence(sequence: Any, content: Any) -> None:
    sequence.clear()
    sequence.extend(content)


def _put_all(collection: Any, content: Any) -> None:
    collection.clear()
    collection.update(content)


def _put_chance(rng: Any, content: Any) -> None:
    rng.bit_generator.state = content


_KEEP[np.ndarray] = (lambda array: array.copy() if array.flags.writeable else None, _put_array)
_KEEP[list] = (list.copy, _put_sequence)
_KEEP[deque] = (deque.copy, _put_sequence)
_KEEP[dict] = (dict.copy, _put_all)
_KEEP[set] = (set.copy, _put_all)
_KEEP[np.random.Generator] = (lambda rng: rng.bit_generator.state, _put_chance)


def holders(root: object, *, without: Iterable[type]) -> list[object]:
    """Return the emulator's objects below one that can change, it included; but those of some
    classes.
    """
    left_out = tuple(without)
    found: dict[int, object] = {}
    waiting = [root]
    while waiting:
        thing = waiting.pop()
        if isinstance(thing, dict):
            waiting += thing.values()
        elif isinstance(thing, list | tuple | set | deque):
            waiting += thing
        elif (
            type(thing).__module__.startswith("emulator.")
            and hasattr(thing, "__dict__")
            and not isinstance(thing, (type, *left_out))
            and id(thing) not in found
        ):
            found[id(thing)] = thing
            waiting += vars(thing).values()
    return list(found.values())


class Mark:
    """What some objects hold now."""

    def __init__(self, things: Iterable[object]) -> None:
        self._kept = [
            (
                vars(thing),
                vars(thing).copy(),
                [
                    (value, keep[0](value), keep[1])
                    for value in vars(thing).values()
                    if (keep := _KEEP.get(type(value))) is not None
                ],
            )
            for thing in things
        ]

    def restore(self) -> None:
        """Let them hold it again; once."""
        for attributes, before, contents in self._kept:
            attributes.clear()
            attributes.update(before)
            for value, content, put in contents:
                put(value, content)
