"""Reading what Rerun reads."""

from typing import Any


def chunks(reader: Any) -> dict[str, set[str]]:
    """The columns of each entity that a reader of Rerun finds."""
    found: dict[str, set[str]] = {}
    for chunk in reader.stream():
        names = chunk.to_record_batch().schema.names
        found.setdefault(chunk.entity_path, set()).update(names)
    return found
