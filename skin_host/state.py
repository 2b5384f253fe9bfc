"""What a node keeps over a restart, beside its calibration: what operators have changed.

A file of the state directory, written whole or not at all. A damaged one is set aside and
told of; it never keeps the service from starting.
"""

import logging
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct, field

from skin_host.fields import Name
from skin_host.files import write_atomic
from skin_host.settings import Touch

log = logging.getLogger(__name__)

SCHEMA = "skin.state/1"
MAX_BYTES = 1_000_000


class Thresholds(Struct, forbid_unknown_fields=True, omit_defaults=True):
    """Changes to the touch decision; None where the configuration's number stands."""

    margin_units: Annotated[float, Meta(ge=0, le=255)] | None = None
    minimum_threshold_units: Annotated[float, Meta(ge=0, le=255)] | None = None
    hysteresis_units: Annotated[float, Meta(ge=0, le=255)] | None = None
    votes_of_3: Literal[1, 2, 3] | None = None

    def over(self, touch: Touch) -> Touch:
        """The settings with these changes."""
        changes = msgspec.structs.asdict(self)
        known = {key: value for key, value in changes.items() if value is not None}
        return msgspec.structs.replace(touch, **known)


class State(Struct, forbid_unknown_fields=True):
    """What operators have changed since the configuration was written."""

    schema: str = SCHEMA
    disabled: list[Name] = []
    thresholds: Thresholds = field(default_factory=Thresholds)


def load_state(path: Path) -> State:
    """Read the state of a node; a missing or damaged file gives an unchanged one."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return State()
    except OSError as error:
        log.error("%s: cannot be read: %s; starting without it", path, error.strerror)
        return State()
    try:
        if len(data) > MAX_BYTES:
            raise ValueError(f"{len(data)} bytes")
        state = msgspec.json.decode(data, type=State)
        if state.schema != SCHEMA:
            raise ValueError(f'schema "{state.schema}"')
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        log.error("%s: damaged (%s); starting without it", path, error)
        return State()
    return state


def save_state(path: Path, state: State) -> None:
    """Keep the state of a node.

    Raises:
        OSError: it cannot be written; the old one is unchanged.
    """
    write_atomic(path, msgspec.json.format(msgspec.json.encode(state), indent=1) + b"\n")
