"""Helpers shared by several commands."""

import argparse
import contextlib
import json
import logging
import math
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Coroutine, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from skin_host.cli import stderr
from skin_host.daemon import service
from skin_host.errors import visible
from skin_host.files import refuse_input as refuse_input  # noqa: PLC0414 (for other commands)

if TYPE_CHECKING:
    import asyncio

    from skin_host.config.settings import Settings
    from skin_host.layout import Layout

T = TypeVar("T")
log = logging.getLogger(__name__)
Commands = Any  # argparse's own type of sub-parser collections is private


class _Help(argparse.ArgumentDefaultsHelpFormatter):
    """Names the defaults of options that have one."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        has_one = action.default is not None and action.default is not False
        has_one = has_one and action.default != []
        return super()._get_help_string(action) if has_one else action.help


def add_command(commands: Commands, name: str, about: str, example: str) -> argparse.ArgumentParser:
    """Add a sub-command with its one-line description and an example at the end of its help."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=about,
        description=about[0].upper() + about[1:] + ".",
        epilog=f"Example: {example}",
        formatter_class=_Help,
    )
    parser.set_defaults(command=name)
    return parser


def add_config(parser: argparse.ArgumentParser) -> None:
    """The positional argument CONFIG."""
    parser.add_argument("config", metavar="CONFIG", type=Path, help="configuration file (TOML)")


def add_broker(parser: argparse.ArgumentParser) -> None:
    """Add the options to find the robot."""
    parser.add_argument("--broker", default="mqtt://localhost", metavar="URL", help="MQTT broker")
    parser.add_argument(
        "--robot", type=filled, help="whose skin, if the broker knows several robots"
    )


def positive_below(limit: float) -> Callable[[str], float]:
    """Return the type, for argparse, of a number above 0 and below a limit."""

    def of(text: str) -> float:
        value = _number(text)
        if not 0 < value < limit:
            bound = f"below {limit:g}" if value >= limit else "above 0"
            raise argparse.ArgumentTypeError(f"seen {text}, wanted a number {bound}")
        return value

    return of


#: Times, speeds, pressures.
positive = positive_below(1e9)


def finite(text: str) -> float:
    """A number, for argparse."""
    value = _number(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"seen {text}, wanted a number")
    return value


def filled(text: str) -> str:
    """A name that is not empty, for argparse."""
    if not text:
        raise argparse.ArgumentTypeError("seen '', wanted a name")
    return text


def whole(least: int, most: int) -> Callable[[str], int]:
    """Return the type, for argparse, of a whole number, with bounds that belong to it."""

    def of(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(
                f"seen {text}, wanted a whole number from {least} to {most}"
            )
        return value

    return of


#: What random numbers begin with.
seed_number = whole(0, 2**63 - 1)
#: How many of something there are; where fewer are possible, that is found out later.
count = whole(1, 1_000_000_000)
#: A port to listen on; 0 is any.
port_number = whole(0, 65535)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def add_log_level(parser: argparse.ArgumentParser) -> None:
    """Add `--verbose`, for long-running commands."""
    parser.add_argument("--verbose", "-v", action="store_true", help="log more")


def set_up_logging(verbose: bool, name: str | None = None) -> None:
    """Log to stderr, for people or for systemd's journal, and never wait until they read it.

    Args:
        verbose: log more.
        name: of this process, before each line, where several log to one stderr.
    """
    if (raw := stderr.current()) is not None:
        raw.write_in_thread()
    handler = logging.StreamHandler(sys.stderr)
    line = "%(message)s" if name is None else name.replace("%", "%%") + ": %(message)s"
    handler.setFormatter(
        service.JournalFormatter(line)
        if service.to_journal()
        else service.LogFormatter(f"%(levelname)-7s {line}")
    )
    logging.basicConfig(level=logging.DEBUG if verbose else logging.INFO, handlers=[handler])
    for noisy in ("mqtt", "asyncio"):
        logging.getLogger(noisy).setLevel(logging.WARNING)


def load_skin(config: Path) -> "tuple[Settings, Layout]":
    """The same as `layout.load_skin`, which imports numpy."""
    from skin_host import layout

    return layout.load_skin(config)


def warn_of_virtual(settings: "Settings", tell: Callable[[str], object] = log.warning) -> None:
    """A bus that ends with its process has nobody else on it, which looks like dead boards."""
    for name, bus in settings.buses.items():
        if bus.interface == "virtual":
            tell(
                f'bus {name}: interface "virtual" is of this process alone, and no other program '
                "is on it; use udp_multicast or vcan (docs/tutorial.md)"
            )


def print_json(document: object) -> None:
    print(visible_json(json.dumps(document, indent=2, ensure_ascii=False)))


def visible_json(text: str) -> str:
    """Return the same JSON with characters that steer a terminal as escapes, which JSON has, too.

    They are in its texts only, which anybody may have written.
    """
    return "".join(
        one if one.isprintable() or one == "\n" else json.dumps(one)[1:-1] for one in text
    )


def warn(text: str) -> None:
    """Print one line on stderr, in yellow on a terminal. Anybody may have written names in it."""
    line = f"warning: {visible(text, len(text))}"
    if sys.stderr.isatty() and not os.environ.get("NO_COLOR"):
        line = f"\033[33m{line}\033[0m"
    print(line, file=sys.stderr)


class Progress:
    """A progress line for long work, on a terminal only."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._shown = sys.stderr.isatty()
        #: Of the longest line so far, in characters.
        self._width = 0

    def update(self, share: float, note: str = "") -> None:
        """Show that `share` (0 to 1) is done. Anybody may have written names in `note`."""
        if self._shown:
            done = int(30 * min(1.0, max(0.0, share)))
            bar = "#" * done + "." * (30 - done)
            # A line that the terminal has to fold cannot be replaced.
            columns = max(1, shutil.get_terminal_size().columns - 1)
            line = visible(f"{self._what} [{bar}] {share:4.0%} {note}")[:columns]
            self._width = max(self._width, len(line))
            print(f"\r{line:<{self._width}}", end="", file=sys.stderr)

    def close(self) -> None:
        """Remove the line."""
        if self._shown:
            print("\r" + " " * self._width + "\r", end="", file=sys.stderr)


def leaving() -> tuple[signal.Signals, ...]:
    """Return the signals that ask to end, of which the terminal sends one when it is closed; not
    that if it is ignored, as under nohup.
    """
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return service.ENDING if ignored else (*service.ENDING, signal.SIGHUP)


@contextlib.contextmanager
def ended_in_good_order() -> Iterator[None]:
    """Let a request to end leave the block as Ctrl-C does, so that no half a file stays.

    Raises:
        SystemExit: in place of the end by a signal, with the status that a shell gives it.
    """

    def end(number: int, _: object) -> None:
        _ignore_more_hangups()
        raise SystemExit(128 + number)

    before = {}
    if threading.current_thread() is threading.main_thread():
        numbers = [number for number in leaving() if number != signal.SIGINT]
        before = {number: signal.signal(number, end) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _ignore_more_hangups() -> None:
    """A terminal that is closed sends SIGHUP, and its shell does, too: the second one must not end
    what the first one has begun to end in good order.
    """
    if signal.SIGHUP in leaving():
        signal.signal(signal.SIGHUP, signal.SIG_IGN)


def run(
    work: "Callable[[asyncio.Event], Coroutine[Any, Any, T]]",
    duration_s: float | None = None,
    ending: Sequence[signal.Signals] | None = None,
    *,
    patient: bool = False,
) -> T:
    """Work, and return the result.

    The event is set by the signals `ending`, by default those of `leaving`, and after `duration_s`.
    A second signal ends at once, but for SIGHUP, or never if this is `patient`.
    """

    import asyncio

    taken = leaving() if ending is None else ending

    async def working() -> T:
        stop, loop = asyncio.Event(), asyncio.get_running_loop()

        def end() -> None:
            stop.set()
            for number in taken:
                if patient:
                    signal.signal(number, signal.SIG_IGN)
                else:
                    loop.remove_signal_handler(number)
            if signal.SIGHUP in taken:
                _ignore_more_hangups()

        for number in taken:
            if patient:
                # A second one that comes as a handler of the loop is removed would end the process.
                signal.signal(number, lambda *_: loop.call_soon_threadsafe(end))
            else:
                loop.add_signal_handler(number, end)
        if duration_s is not None:
            loop.call_later(duration_s, stop.set)
        return await work(stop)

    return asyncio.run(working())
