"""What was recorded: captured, played, processed, exported and drawn again."""

from pathlib import Path

#: Of recordings of messages, CAN frames, or both.
MCAP_SUFFIX = ".mcap"


def is_mcap(path: Path) -> bool:
    """Whether the name is that of an MCAP recording, in capitals too as of the other formats."""
    return path.suffix.lower() == MCAP_SUFFIX
