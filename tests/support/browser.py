"""A real browser without a window."""

import subprocess
from pathlib import Path

from tests.support import programs

_LIMIT_S = 120.0
#: A browser that minds its own business.
QUIET = [
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


def page_text(url: str, profile: Path, *, wait_ms: int = 5000) -> str:
    """Open the page, let its scripts run, and return its document as HTML.

    `wait_ms` is the browser's own time: it passes as fast as the page's timers allow.
    """
    return _chromium(profile, f"--virtual-time-budget={wait_ms}", "--dump-dom", url)


def screenshot(url: str, profile: Path, picture: Path, *, wait_ms: int = 5000) -> None:
    """Open the page, let its scripts run, and write what it looks like as PNG."""
    _chromium(
        profile,
        f"--virtual-time-budget={wait_ms}",
        "--window-size=1280,800",
        f"--screenshot={picture}",
        url,
    )


def _chromium(profile: Path, *arguments: str) -> str:
    done = subprocess.run(
        [
            programs.require("chromium"),
            "--headless",
            "--no-sandbox",  # root has no sandbox of its own
            "--disable-gpu",
            "--disable-dev-shm-usage",
            *QUIET,
            "--hide-scrollbars",
            f"--user-data-dir={profile}",
            *arguments,
        ],
        check=True,
        capture_output=True,
        text=True,
        timeout=_LIMIT_S,
    )
    return done.stdout
