"""`skin ...`: one script. Each module of this room holds a few related commands.

Exit status: 0 done, 1 failed while running, 2 the request itself was wrong. An error is
one line on stderr; a user's mistake never shows a traceback. Heavy imports wait until a
command needs them.
"""

import argparse
import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from typing import NoReturn

from skin_host import __version__
from skin_host.cli import completion, emulation, files, measure, operate, recordings, watch
from skin_host.errors import SkinError


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """One line instead of the usage text."""
        print(f"{self.prog}: {message} (see `{self.prog} --help`)", file=sys.stderr)
        raise SystemExit(2)


def build_parser() -> argparse.ArgumentParser:
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
    for room in (operate, watch, files, recordings, emulation, measure, completion):
        room.add_commands(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    # numpy, imported later, would else start threads that spin: on a busy machine they make a
    # product of 100 000 taxels take seven times as long, and never help one of a few thousand.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    parser = build_parser()
    completion.complete_if_asked(parser)
    arguments = parser.parse_args(argv)
    name = f"skin {arguments.command}"
    try:
        status: int = arguments.run(arguments)
        sys.stdout.flush()
    except SkinError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return error.exit_status
    except BrokenPipeError:
        # The reader of our output left (`| head`). Keep Python from saying so at exit.
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"{name}: {where}{error.strerror or error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    return status
