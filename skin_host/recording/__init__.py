"""What was recorded: captured, played, processed, exported and drawn again."""

from pathlib import Path

#: Of recordings of messages, CAN frames, or both.
MCAP_SUFFIX = ".mcap"


def is_mcap(path: Path) -> bool:
    """Whether the name is that of an MCAP recording, in capitals too as of the other formats."""
    return path.suffix.lower() == MCAP_SUFFIX


def seconds(duration_ns: float) -> str:
    """Return a duration in seconds to be read: whole ones, of less than a second two digits."""
    duration_s = duration_ns / 1e9
    return f"{duration_s:.2g} s" if duration_s < 1.0 else f"{duration_s:.0f} s"
