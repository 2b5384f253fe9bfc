"""State that a node keeps over a restart, besides its calibration: changes by operators, and the
zeros of its taxels.

Each is a file of the state directory, written completely or not at all. A damaged one is set aside
and reported, so that the service can always start.
"""

import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, ClassVar, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta, Struct, field
from numpy.typing import NDArray

from skin_host.config.fields import Name
from skin_host.config.settings import Settings, TouchSettings, changed
from skin_host.daemon import service
from skin_host.errors import ConfigurationError
from skin_host.files import read_document, refuse_other_robot, set_aside, why_unreadable
from skin_host.layout import Layout, PartLayout

log = logging.getLogger(__name__)

#: No later time can be written: the end of the year 9999.
_LATEST_S = 253_402_300_799.0


class Thresholds(Struct, forbid_unknown_fields=True, omit_defaults=True):
    """Changes to the touch decision; None where the configuration's number applies."""

    margin_units: Annotated[float, Meta(ge=0, le=255)] | None = None
    minimum_threshold_units: Annotated[float, Meta(ge=0, le=255)] | None = None
    hysteresis_units: Annotated[float, Meta(ge=0, le=255)] | None = None
    votes_of_3: Literal[1, 2, 3] | None = None

    def over(self, touch: TouchSettings) -> TouchSettings:
        changes = msgspec.structs.asdict(self)
        known = {key: value for key, value in changes.items() if value is not None}
        return msgspec.structs.replace(touch, **known)

    def over_settings(self, settings: Settings) -> Settings:
        """Return a whole configuration with these changes."""
        touch = self.over(settings.processing.touch)
        return changed(settings, {"processing.touch": touch})


class NodeState(Struct, forbid_unknown_fields=True):
    """Changes by operators since the configuration was written."""

    WITHOUT: ClassVar = "starting without it"

    schema: str = "skin.state/1"
    robot: str = ""
    disabled: list[Name] = []
    thresholds: Thresholds = field(default_factory=Thresholds)


class Zeros(Struct, forbid_unknown_fields=True):
    """What has become of the zeros since the calibration, and of the pads.

    A start sets the boards up, and their set-up takes what touches them into the zero. So taxels
    that were touched when the daemon ended are not valid after it, until they are calibrated. What
    touches a board before its set-up is judged by the zero that it has by then, which is not the
    calibration's if the board was zeroed since.

    Attributes:
        calibration: id of the calibration in use; a later one has measured the zeros.
        before: id of the one that a start finds, while that in use is not in its file: it is being
            written, or could not be.
        unknown: numbers of taxels by part whose zero is not known, or will not be after the next
            start.
        touched: numbers of taxels by part that something touches, or touched when their board was
            received last or zeroed, and whose release nothing has shown since. A board that still
            sends with the zero that it had shows at a start whether it is touched. One that was
            reset meanwhile, as by a power failure, does not: then their zero is not known.
        stuck: numbers of taxels by part whose pads are stuck. They take as long to be found again
            as the first time.
        baselines: by part, activation of each untouched taxel in units, as found after the last
            set-up, or as it has drifted since. Empty: the calibration's.
        written: when that was so, ISO 8601 in UTC.
        robot: whose they are; empty, as in files of older versions: of whoever finds them.
        parts: names of the parts and fingertips that the node had; None in files of older versions.
    """

    WITHOUT: ClassVar = (
        "no taxel is valid until it is calibrated, because any may have been touched: "
        "skin command calibrate"
    )

    schema: str = "skin.zeros/1"
    calibration: str = ""
    before: str = ""
    unknown: dict[Name, list[int]] = {}
    touched: dict[Name, list[int]] = {}
    stuck: dict[Name, list[int]] = {}
    baselines: dict[Name, list[Annotated[float, Meta(ge=-255, le=255)]]] = {}
    written: Annotated[str, Meta(max_length=64)] = ""
    robot: str = ""
    parts: list[Name] | None = None

    def are_of(self, calibration: str) -> bool:
        """Return whether these zeros hold with the calibration of this id."""
        return bool(calibration) and calibration in (self.calibration, self.before)

    def are_older_than(self, time: str) -> bool:
        """Return whether a calibration that was taken at `time` has measured the zeros since.

        One that somebody has put back has not, nor one whose zero comes from a recording.
        """
        written_s, time_s = seconds_of(self.written), seconds_of(time)
        return written_s is not None and time_s is not None and written_s < time_s


def seconds_of(time: str) -> float | None:
    """Return an ISO 8601 time with its zone in s since 1970; None if it is none."""
    try:
        moment = datetime.fromisoformat(time)
        return moment.timestamp() if moment.tzinfo is not None else None
    except (ValueError, OverflowError):
        return None


def written_after(time_s: float, others_s: float) -> str:
    """Return a time as `Zeros.written`, or one later than that of others; both in s since 1970, and
    0 for none.

    Who has taken over from others is the last one by that, whatever clocks showed meanwhile.
    """
    least_s = others_s + 1.0 if others_s else 0.0
    moment = datetime.fromtimestamp(min(max(time_s, least_s), _LATEST_S), UTC)
    return moment.isoformat(timespec="seconds")


def taxels_of(layout: Layout, numbers: Mapping[str, list[int]]) -> NDArray[np.bool_]:
    """Return as bool[n] the taxels that are named by part, as far as this skin has them."""
    found = np.zeros(layout.n_taxels, np.bool_)
    for part in layout.parts:
        for taxel in numbers.get(part.name, ()):
            if 0 <= taxel < part.n_taxels:
                found[part.start + taxel] = True
    return found


def baselines_of(
    layout: Layout, baselines: Mapping[str, list[float]]
) -> Iterator[tuple[PartLayout, NDArray[np.float64]]]:
    """Yield the parts of which baselines [m] were kept, as far as they are of this skin."""
    for part in layout.parts:
        kept = baselines.get(part.name, ())
        if len(kept) == part.n_taxels:
            yield part, np.array(kept)


def kept_or(
    otherwise: NDArray[np.float64], layout: Layout, baselines: Mapping[str, list[float]]
) -> NDArray[np.float64]:
    """Return the baselines [n] that were kept, and of parts without any those `otherwise`."""
    found = otherwise.copy()
    for part, kept in baselines_of(layout, baselines):
        found[part.start : part.stop] = kept
    return found


Kept = TypeVar("Kept", NodeState, Zeros)


def kept_path(settings: Settings, node: str, what: str) -> Path:
    """Return where a node keeps its `calibration`, `state` or `zeros`."""
    directory = service.state_directory(settings.service.state_directory)
    return directory / f"{settings.robot}-{node}.{what}.json"


def refuse_left_behind(settings: Settings, folder: Path) -> None:
    """Refuse to start without what was kept, where that lies in the working directory.

    Relative names of the state directory start in the configuration's folder; they started in the
    working directory in older versions. Without its memory a daemon would take what touches the
    skin for its zero.

    Args:
        settings: of the robot.
        folder: the configuration's.

    Raises:
        ConfigurationError: the state directory has nothing of the robot, and the folder of its name
            in the working directory has.
    """
    if settings.service.state_directory is None:
        return
    place = service.state_directory(settings.service.state_directory)
    try:
        former = Path(os.path.realpath(os.path.relpath(place, os.path.realpath(folder))))
    except OSError:  # the working directory is gone
        return
    if _keeps(former, settings.robot) and not _keeps(place, settings.robot):
        raise ConfigurationError(
            f'service.state_directory: {place} has nothing of robot "{settings.robot}", and '
            f"{former} has: relative names start in the configuration's folder, and not in the "
            f"working directory any more; move it: mv {former} {place}"
        )


def _keeps(folder: Path, robot: str) -> bool:
    with suppress(OSError):
        return any(one.match(f"{robot}-*.*.json") for one in folder.iterdir())
    return False


def can_be_read(path: Path, without: str) -> bool:
    """Return whether there is a file that can be read; log if there is one that cannot.

    Args:
        path: of the file.
        without: what the node does without it.
    """
    why = why_unreadable(path)
    if why is not None:
        log.error("%s: cannot be read: %s; %s", path, why, without)
        return False
    return os.access(path, os.F_OK)


def is_there(path: Path) -> bool:
    """Return whether there is a file, or may be one that cannot be looked at."""
    return os.path.lexists(path) or why_unreadable(path) is not None


def load_kept(path: Path, kind: type[Kept], robot: str = "") -> Kept:
    """Read what a node keeps.

    A missing or unreadable file gives an unchanged one; so does a damaged one, which is set aside.

    Args:
        path: of the file.
        kind: what it holds.
        robot: whose file it is to be; that of any if empty.

    Raises:
        NewerFileError: a newer version has written it.
        BusyFileError: another program is writing it.
        OtherRobotError: it is another robot's.
    """
    unchanged = kind()
    if not can_be_read(path, kind.WITHOUT):
        return unchanged
    what = unchanged.schema.removeprefix("skin.").partition("/")[0]
    if robot:
        refuse_other_robot(path, robot, what)
    try:
        return read_document(path, kind, unchanged.schema, what, ValueError)
    except ValueError as error:
        log.error("%s: damaged (%s); %s", path, error, kind.WITHOUT)
        set_aside(path)
        return unchanged
