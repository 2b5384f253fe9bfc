"""The command `skin`. Each module of this package holds a few related commands.

Exit status: 0 done, 1 failed while running, 2 the request itself was wrong. An error is one line on
stderr; a user's mistake never shows a traceback. Heavy imports wait until a command needs them.
"""

import argparse
import atexit
import contextlib
import gc
import io
import logging
import os
import re
import select
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from skin_host import __version__, emulator_path
from skin_host.cli import (
    calibrate,
    completion,
    files,
    operate,
    options,
    recordings,
    stderr,
    watch,
    without_robot,
)
from skin_host.cli.common import ended_in_good_order, filled
from skin_host.daemon import service
from skin_host.errors import SkinError, nearest, visible

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer, SupportsWrite

#: Of more choices only the probable one is named.
MANY = 8


class _Parser(argparse.ArgumentParser):
    def __init__(self, *words: Any, **options: Any) -> None:
        super().__init__(*words, **options)
        self.register("type", Path, lambda text: Path(filled(text)))  # Path("") is this folder

    def error(self, message: str) -> NoReturn:
        """Print one line instead of the usage text; for a mistyped word it suggests the probable
        one.
        """
        choice = re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message)
        unknown = re.match(r"unrecognized arguments: (--[\w-]+)", message)
        typed, known = "", list[str]()
        if choice is not None:
            typed, known = choice[1], re.findall(r"[\w-]+", choice[2])
        elif unknown is not None:
            typed = unknown[1]
            known = [option for action in self._actions for option in action.option_strings]
        near = nearest(typed, known)
        if near and choice is not None and len(known) > MANY:
            message = message.replace(choice[0], f"no '{typed}'")
        message += f"; meant {near}?" if near else ""
        print(f"{self.prog}: {visible(message)} (see `{self.prog} --help`)", file=sys.stderr)
        raise SystemExit(2)

    def _print_message(self, message: str, file: "SupportsWrite[str] | None" = None) -> None:
        """Let it be known that help cannot be written, which argparse ignores."""
        print(message or "", end="", file=file or sys.stderr)

    def read(self, words: Sequence[str]) -> argparse.Namespace:
        """Parse a command line; what a command does not know is that command's mistake."""
        if words[:1] == ["help"]:
            words = [*words[1:], "--help"]
        arguments, unknown = self.parse_known_args(words)
        if unknown:
            command = self.command(arguments.command)
            command.error(f"unrecognized arguments: {' '.join(unknown)}")
        return arguments

    def command(self, name: str) -> "_Parser":
        """Return the parser of one command."""
        (commands,) = (
            action for action in self._actions if isinstance(action, argparse._SubParsersAction)
        )
        parser: _Parser = commands.choices[name]
        return parser


def _complain(line: str) -> None:
    line = "\n".join(map(visible, line.splitlines()))
    line = service.with_priority(line, logging.ERROR) if service.to_journal() else line
    print(line, file=sys.stderr)


class _StandardOutput(io.FileIO):
    """The raw stream below `sys.stdout`, whose errors name it."""

    def write(self, data: "ReadableBuffer") -> int | None:  # type: ignore[override]
        try:
            return super().write(data)
        except OSError as error:
            error.filename = error.filename or "standard output"
            raise


def _make_printable() -> None:
    """What is printed where nobody can read it goes nowhere, and never ends a command.

    A stream that was closed (`>&-`) gets its number again, before a file or socket takes it. A
    character that the locale's encoding has not is spelt with others: see `stderr.SPELT`.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115
        elif mode == "w" and isinstance(stream, io.TextIOWrapper):
            with contextlib.suppress(OSError):  # a stream that changed under our feet
                stream.reconfigure(errors=stderr.SPELT)
    stderr.replace()
    _name_output()


def _name_output() -> None:
    """Make `sys.stdout` a stream over `_StandardOutput`, unless it is another program's."""
    own = sys.__stdout__
    if own is None or sys.stdout is not own or not isinstance(own, io.TextIOWrapper):
        return
    own.flush()
    raw = _StandardOutput(own.fileno(), "w", closefd=False)
    sys.stdout = io.TextIOWrapper(
        raw if own.write_through else io.BufferedWriter(raw),
        encoding=own.encoding,
        errors=own.errors,
        line_buffering=own.line_buffering,
        write_through=own.write_through,
    )


def _reader_left() -> bool:
    """Whether standard output is a pipe that nobody reads any more."""
    poll = select.poll()
    try:
        poll.register(sys.stdout.fileno(), 0)
    except (OSError, ValueError):  # it is no file
        return False
    return bool(poll.poll(0))


def _lose_output() -> None:
    """Keep Python from reporting at exit that standard output cannot be written."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def build_parser() -> _Parser:
    """The parser of the whole command line."""
    parser = _Parser(
        prog="skin",
        description="Tactile skin on CAN: calibrated pressure and touch events over MQTT.",
        epilog="Begin with: skin demo",
    )
    parser.add_argument("--version", action="version", version=f"skin-host {__version__}")
    commands = parser.add_subparsers(
        title="commands", metavar="COMMAND", required=True, parser_class=_Parser
    )
    for room in (operate, calibrate, watch, files, recordings, without_robot, completion):
        room.add_commands(commands)
    return parser


def _delivered(config: Path | None) -> str:
    """Return where the project's own configuration of a name is, if there is none at `config`."""
    with contextlib.suppress(SkinError, OSError):
        if config is not None and not config.exists():
            from skin_host.demo import configuration

            return f"; the delivered {config.name} is {configuration(config.name)}"
    return ""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    # numpy, imported later, would otherwise start threads that spin: on a busy machine they make a
    # product of 100 000 taxels take seven times as long, and never help one of a few thousand.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Python's last search for unreachable objects goes through all that was imported, for 20 ms.
    atexit.register(gc.freeze)
    _make_printable()
    emulator_path.provide()
    parser = build_parser()
    completion.complete_if_asked(parser)
    name, config = "skin", None
    try:
        try:
            arguments = parser.read(sys.argv[1:] if argv is None else list(argv))
        finally:
            sys.stdout.flush()  # help
        name = f"skin {arguments.command}"
        config = getattr(arguments, "config", None)
        options.check(parser.command(arguments.command), arguments)
        with ended_in_good_order():
            status: int = arguments.run(arguments)
        sys.stdout.flush()
    except SkinError as error:
        _complain(f"{name}: {error}{_delivered(config)}")
        return error.exit_status
    except OSError as error:
        read_enough = isinstance(error, BrokenPipeError) and _reader_left()  # such as `| head`
        _lose_output()
        if read_enough:
            return 0
        where = f"{error.filename}: " if error.filename else ""
        _complain(f"{name}: {where}{error.strerror or error}")
        return 1
    return status
