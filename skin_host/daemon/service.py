"""systemd: readiness, watchdog, status line, directories, priorities in its journal."""

import contextlib
import logging
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from skin_host.errors import ConfigurationError, visible_lines

if TYPE_CHECKING:
    from skin_host.clock import Clock

#: Python's levels, highest first, and the priorities of syslog(3).
_PRIORITIES = (
    (logging.CRITICAL, 2),
    (logging.ERROR, 3),
    (logging.WARNING, 4),
    (logging.INFO, 6),
    (logging.NOTSET, 7),
)


#: Signals that ask a daemon to end.
ENDING = (signal.SIGTERM, signal.SIGINT)
#: In the environment: descriptor of the socket that takes the messages to systemd, and never waits,
#: in place of the name of one (`NOTIFY_SOCKET`).
NOTIFIED = "SKIN_NOTIFIED"


def notify(message: str) -> None:
    """Send a message to systemd (sd_notify's protocol); without systemd, do nothing."""
    address, descriptor = os.environ.get("NOTIFY_SOCKET", ""), os.environ.get(NOTIFIED, "")
    if not (address or descriptor):
        return
    try:
        if descriptor:
            os.write(int(descriptor), message.encode())
            return
        import socket

        if address.startswith("@"):
            address = "\0" + address[1:]
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock:
            sock.sendto(message.encode(), socket.MSG_DONTWAIT, address)
    except OSError:
        # systemd is busy, restarts or is gone, or no more files may be open: the skin must not
        # wait for it.
        return


def hold_hangups() -> None:
    """Let a SIGHUP, which asks for a reload, wait; otherwise it ends what cannot take it yet.

    Programs that are started meanwhile let it wait, too.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})


def take_hangups() -> None:
    """Take the SIGHUP that waits, and those that come."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGHUP})


@contextlib.contextmanager
def ended_at_once() -> Iterator[None]:
    """A request to end, in the block, ends this process with status 0, until the daemon takes such
    requests: nothing has begun yet that is to be ended in good order.

    By default the status would be that of a failure; and a container would not end at all, because
    its first process gets only the signals that it takes.
    """
    before = {number: signal.signal(number, lambda *_: os._exit(0)) for number in ENDING}
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
    try:
        yield
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) is not signal.SIG_IGN:  # by who needs to be asked once only
                signal.signal(number, handler)


def reloading(clock: "Clock") -> str:
    """Return the message to systemd that a reload has begun; READY=1 ends it."""
    return f"RELOADING=1\nMONOTONIC_USEC={clock.monotonic_ns() // 1000}"


def to_journal() -> bool:
    """Whether stderr is a stream of systemd's journal."""
    try:
        stderr = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{stderr.st_dev}:{stderr.st_ino}"


def with_priority(text: str, level: int) -> str:
    """Add to each line the priority in the form that the journal reads (sd-daemon(3))."""
    priority = next(number for least, number in _PRIORITIES if level >= least)
    return "\n".join(f"<{priority}>{line}" for line in text.split("\n"))


class LogFormatter(logging.Formatter):
    """Lines whose control characters are visible: names and errors that anybody may have written
    are logged.
    """

    def format(self, record: logging.LogRecord) -> str:
        return visible_lines(super().format(record))


class JournalFormatter(LogFormatter):
    """Lines with priorities; the journal adds time and name."""

    def format(self, record: logging.LogRecord) -> str:
        return with_priority(super().format(record), record.levelno)


def watchdog_interval_s() -> float | None:
    """Return how often to notify systemd's watchdog, half its limit; None without a watchdog."""
    usec = os.environ.get("WATCHDOG_USEC", "")
    pid = os.environ.get("WATCHDOG_PID", "")
    if not usec.isdecimal() or (pid and pid != str(os.getpid())):
        return None
    return int(usec) / 2e6


def state_directory(configured: str | None) -> Path:
    """Return the folder of calibrations: as configured, systemd's, or XDG's.

    Raises:
        ConfigurationError: it is in the home folder of somebody who has none.
    """
    if configured is not None:
        if "\0" in configured:
            raise ConfigurationError("service.state_directory: seen a zero byte, wanted a path")
        return _at_home(Path(configured), "wanted a folder that there is")
    given = os.environ.get("STATE_DIRECTORY")
    if given:
        return Path(given.split(":")[0])
    base = os.environ.get("XDG_STATE_HOME")
    if base:
        return Path(base) / "skin-host"
    return _at_home(Path("~/.local/state/skin-host"), "name a folder there, or set HOME")


def _at_home(path: Path, wanted: str) -> Path:
    try:
        return path.expanduser()
    except RuntimeError:
        raise ConfigurationError(
            f"service.state_directory: {path}: nobody's home folder; {wanted}"
        ) from None


def runtime_directory() -> Path | None:
    """Return systemd's folder for files of a running service; None if there is none."""
    given = os.environ.get("RUNTIME_DIRECTORY")
    return Path(given.split(":")[0]) if given else None
