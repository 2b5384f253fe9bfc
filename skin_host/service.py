"""systemd: readiness, watchdog, status line, state directory, credentials."""

import os
import socket
import time
from pathlib import Path


def notify(message: str) -> None:
    """Tell systemd something (sd_notify's protocol); without systemd, do nothing."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock:
        try:
            sock.sendto(message.encode(), socket.MSG_DONTWAIT, address)
        except OSError:
            # systemd is busy, restarts or is gone: nothing that the skin should wait for.
            return


def notify_reloading() -> None:
    """Tell systemd that a reload has begun; READY=1 ends it."""
    notify(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")


def watchdog_interval_s() -> float | None:
    """How often systemd wants to be fed, half its limit; None where it does not."""
    usec = os.environ.get("WATCHDOG_USEC", "")
    pid = os.environ.get("WATCHDOG_PID", "")
    if not usec.isdigit() or (pid and pid != str(os.getpid())):
        return None
    return int(usec) / 2e6


def state_directory(configured: str | None) -> Path:
    """Where calibrations live: as configured, systemd's, or XDG's."""
    if configured is not None:
        return Path(configured).expanduser()
    given = os.environ.get("STATE_DIRECTORY")
    if given:
        return Path(given.split(":")[0])
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "skin-host"
