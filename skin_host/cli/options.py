"""Options that have an effect only beside others: a table for each command, and one refusal.

A word of a table is what a user types: `--load` is an option that was given, `--onto can` one with
this value, `map` a positional argument with this value, `CONFIG` one that was given; `no --config`
is an option that was not.
"""

import argparse
from collections.abc import Mapping, Sequence
from functools import partial

from skin_host.errors import RequestError

Table = Mapping[str, Sequence[str]]


def add_rules(
    parser: argparse.ArgumentParser, needs: Table | None = None, idle_with: Table | None = None
) -> None:
    """Declare which options of a command go together.

    Args:
        parser: of the command.
        needs: the words of which one has to hold where the key does.
        idle_with: the words beside each of which the key has no effect.
    """
    parser.set_defaults(needs=needs or {}, idle_with=idle_with or {})


def check(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Refuse an option that would have no effect.

    Raises:
        RequestError: there is one; the message names it and what it needs.
    """

    typed = partial(holds, parser, arguments)
    for word, others in getattr(arguments, "needs", {}).items():
        if typed(word) and not any(map(typed, others)):
            raise RequestError(f"{word} needs {_either(others)}")
    for word, others in getattr(arguments, "idle_with", {}).items():
        beside = next(filter(typed, others), None) if typed(word) else None
        if beside is not None:
            raise RequestError(f"{word} has no effect with {beside}")


def holds(parser: argparse.ArgumentParser, arguments: argparse.Namespace, word: str) -> bool:
    """Whether a word of a table is true of what was typed.

    Raises:
        KeyError: the command has no such argument.
    """
    name, _, value = word.partition(" ")
    if name == "no":
        return not holds(parser, arguments, value)
    for action in parser._actions:
        is_positional = not action.option_strings
        if name in action.option_strings or (is_positional and name == action.metavar):
            seen = getattr(arguments, action.dest)
            # As argparse does it: only what was read from the command line is another object.
            return bool(seen == value) if value else seen is not action.default
        if is_positional and name in (action.choices or ()):
            return bool(getattr(arguments, action.dest) == name)
    raise KeyError(word)


def _either(words: Sequence[str]) -> str:
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last
