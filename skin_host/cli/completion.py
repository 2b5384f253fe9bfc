"""Shell completion of the command line: commands, options, files, names.

argcomplete reads the parser itself, so nothing here repeats it. It is imported only when a
shell asks, or by the command `completion`.
"""

import argparse
import contextlib
import os
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from skin_host.bus.interfaces import can_interfaces
from skin_host.cli.common import Commands, add_command

Completer = Callable[..., Iterable[str]]

#: A shell should not wait longer than this for a broker.
PATIENCE_S = 1.0
RECORDINGS = ("mcap", "log", "blf", "asc", "trc", "csv")


def add_commands(commands: Commands) -> None:
    """Add the commands of this module to the parser."""
    completion = add_command(
        commands,
        "completion",
        "print the shell code that completes `skin`",
        'skin completion bash, in ~/.bashrc: eval "$(skin completion bash)"',
    )
    completion.add_argument(
        "shell", choices=("bash", "zsh", "fish"), metavar="SHELL", help="bash, zsh or fish"
    )
    completion.set_defaults(run=_completion)


def complete_if_asked(parser: argparse.ArgumentParser) -> None:
    """Answer a shell that asks for completions, and exit; otherwise do nothing."""
    if "_ARGCOMPLETE" not in os.environ:
        return
    import argcomplete

    _attach(parser, _completers())
    argcomplete.autocomplete(parser, always_complete_options=False)


def _completion(arguments: argparse.Namespace) -> int:
    from argcomplete.shell_integration import shellcode

    print(shellcode(["skin"], shell=arguments.shell))
    return 0


def _completers() -> dict[str, Completer]:
    """Completers by the name of the argument; the others complete their choices, or any file."""
    from argcomplete.completers import FilesCompleter

    toml, recording = FilesCompleter(("toml",)), FilesCompleter(RECORDINGS)
    return {
        "config": toml,
        "scene": toml,
        "log": recording,
        "relaxation": recording,
        "pressure": recording,
        "recording": FilesCompleter((*RECORDINGS, "json")),
        "calibration": FilesCompleter(("json",)),
        "part": partial(_names, "parts"),
        "board": partial(_names, "boards"),
        "node": partial(_names, "nodes"),
        "channel": lambda **_: can_interfaces(),
    }


def _attach(parser: argparse.ArgumentParser, completers: dict[str, Completer]) -> None:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _attach(command, completers)
        elif action.choices is None and action.dest in completers:
            action.completer = completers[action.dest]  # type: ignore[attr-defined]


def _names(what: str, parsed_args: argparse.Namespace, **_: Any) -> set[str]:
    """Return names from what is already on the command line: the configuration, or a broker."""
    from skin_host.errors import SkinError

    with contextlib.suppress(SkinError):
        if getattr(parsed_args, "config", None) is not None:
            return _names_in(parsed_args.config, what)
        if hasattr(parsed_args, "broker"):
            return _names_at(parsed_args, what)
    return set()


def _names_in(config: Path, what: str) -> set[str]:
    from skin_host.config.settings import load

    settings = load(config)
    if what == "nodes":
        return {part.node for part in settings.parts.values()}
    return set(settings.parts if what == "parts" else settings.boards)


def _names_at(parsed_args: argparse.Namespace, what: str) -> set[str]:
    """Return names that the nodes of a robot publish."""
    import asyncio

    from skin_host.client import SkinClient

    async def ask() -> set[str]:
        robot = getattr(parsed_args, "robot", None)
        async with SkinClient(parsed_args.broker, robot=robot, patience_s=PATIENCE_S) as skin:
            nodes = await skin.info(PATIENCE_S)
        if what == "nodes":
            return set(nodes)
        parts = {name: part for node in nodes.values() for name, part in node.parts.items()}
        if what == "parts":
            return set(parts)
        return {triangle.board for part in parts.values() for triangle in part.triangles}

    return asyncio.run(ask())
