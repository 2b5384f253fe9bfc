"""Shell completion of the command line: commands, options, files, names.

argcomplete reads the parser itself, so nothing here repeats it. It is imported only when a
shell asks, or by the command `completion`.
"""

import argparse
import asyncio
import contextlib
import os
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from skin_host.bus.interfaces import can_interfaces
from skin_host.cli.common import Commands, add_command

if TYPE_CHECKING:
    from skin_host.config.settings import Settings

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
        "part": _parts,
        "board": _boards,
        "node": _nodes,
        "channel": _channels,
    }


def _attach(parser: argparse.ArgumentParser, completers: dict[str, Completer]) -> None:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _attach(command, completers)
        elif action.choices is None and action.dest in completers:
            action.completer = completers[action.dest]  # type: ignore[attr-defined]


def _parts(parsed_args: argparse.Namespace, **_: Any) -> set[str]:
    settings = _settings(parsed_args)
    return set(settings.parts) if settings is not None else _names_at(parsed_args, "parts")


def _boards(parsed_args: argparse.Namespace, **_: Any) -> set[str]:
    settings = _settings(parsed_args)
    return set(settings.boards) if settings is not None else _names_at(parsed_args, "boards")


def _nodes(parsed_args: argparse.Namespace, **_: Any) -> set[str]:
    settings = _settings(parsed_args)
    if settings is None:
        return _names_at(parsed_args, "nodes")
    return {part.node for part in settings.parts.values()}


def _channels(**_: Any) -> list[str]:
    """Return the CAN interfaces of this machine."""
    return can_interfaces()


def _settings(parsed_args: argparse.Namespace) -> "Settings | None":
    """Return the settings of the configuration that is already on the command line."""
    from skin_host.config.settings import load
    from skin_host.errors import ConfigurationError

    config = getattr(parsed_args, "config", None)
    if config is None:
        return None
    with contextlib.suppress(ConfigurationError):
        return load(config)
    return None


def _names_at(parsed_args: argparse.Namespace, what: str) -> set[str]:
    """Return names that the nodes of a robot publish at the broker given on the command line."""
    from skin_host.client import SkinClient
    from skin_host.errors import SkinError

    if not hasattr(parsed_args, "broker"):
        return set()

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

    with contextlib.suppress(SkinError):
        return asyncio.run(ask())
    return set()
