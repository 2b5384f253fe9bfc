"""The present step of long work, in one line of a terminal."""

import sys


def show_step(what: str) -> None:
    """Show what is worked on now, if standard error is a terminal; "" removes the line."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\033[K{what}")
        sys.stderr.flush()
