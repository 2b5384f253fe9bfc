"""Reads the skin manager's ini files: thresholds and gains of the iCub software."""

import re
from pathlib import Path

import msgspec

from skin_host.config.settings import Settings
from skin_host.errors import ConfigurationError
from skin_host.importing.report import Findings, read_source

LARGEST_FILE = 1_000_000
#: Keys without a counterpart here, and why.
DROPPED = {
    "name": "of its ports",
    "inputPorts": "of its ports",
    "outputPorts": "of its ports",
    "minBaseline": "drift has a separate limit, processing.drift.limit_units",
    "contactCompensationGain": "baselines of touched taxels follow the common drift of the others",
    "smoothFilter": "touch is decided by votes, pressure is not smoothed",
    "smoothFactor": "touch is decided by votes, pressure is not smoothed",
    "binarization": "pressure is always published; ON and OFF are the topic contact",
    "maxNeighborDist": "neighbours follow from the pitch of the kinds of unit",
    "skinParts": "numbers of the parts in its events",
}
#: The skin manager's compensator takes steps of 0.02 times the gain, whatever its period is.
STEP = 0.02


def import_manager(files: list[Path], base: Settings | None, findings: Findings) -> Settings:
    """Add the settings that have a counterpart to `base`.

    Raises:
        ConfigurationError: there is no `base`, or a file cannot be read.
    """
    if base is None:
        raise ConfigurationError(
            f"{files[0]}: contains no boards; import skinspec first and add this with --config"
        )
    touch, drift = base.processing.touch, base.processing.drift
    for file in files:
        entries = _entries(file, findings)
        periods = [_number(words) for _, key, words in entries if key == "period"]
        period_ms = next((period for period in periods if period), 20.0)
        for number, key, words in entries:
            value = _number(words)
            if key == "addThreshold" and value is not None and value >= 0:
                touch = msgspec.structs.replace(touch, margin_units=value)
            elif key == "compensationGain" and value is not None and value > 0:
                gain_per_s = round(value * STEP * 1000 / period_ms, 6)
                drift = msgspec.structs.replace(drift, rule="proportional", gain_per_s=gain_per_s)
                findings.odd(
                    (file, number),
                    f"compensationGain: taken as {gain_per_s} of the distance in a second; there "
                    "it is divided by each taxel's own threshold besides",
                )
            elif key == "robot" and words:
                robot = re.sub(r"[^a-z0-9_-]", "-", words[0].lower())[:64]
                base = msgspec.structs.replace(base, robot=robot)
            elif key == "zeroUpRawData":
                if words != ["false"]:
                    findings.odd(
                        (file, number), "zeroUpRawData true: here values always fall with pressure"
                    )
            elif key == "taxelPositionFiles":
                _check_files(file, number, words, findings)
            elif key == "period":
                findings.dropped((file, number), "period: sweeps are processed as they arrive")
            elif key in DROPPED:
                findings.dropped((file, number), f"{key}: {DROPPED[key]}")
            else:
                seen = " ".join([key, *words])[:60]
                findings.odd((file, number), f'"{seen}" is not understood; not read')
    processing = msgspec.structs.replace(base.processing, touch=touch, drift=drift)
    return msgspec.structs.replace(base, processing=processing)


def _entries(file: Path, findings: Findings) -> list[tuple[int, str, list[str]]]:
    """Return the keys of a file with their line and words; lists may span several lines.

    A list is meant to be continued by a backslash at the end of a line; where one is missing, the
    robot's own reader ends the list. Here it ends with its parenthesis.
    """
    text = read_source(file, LARGEST_FILE)
    entries: list[tuple[int, str, list[str]]] = []
    depth = 0
    continued = True
    for number, line in enumerate(text.splitlines(), 1):
        bare = re.split(r"[%#]", line)[0].strip()
        if not bare or (depth == 0 and bare.startswith("[")):
            continue
        goes_on = bare.endswith("\\")
        words = bare.rstrip("\\").replace("(", " ( ").replace(")", " ) ").split()
        if depth == 0 and words:
            entries.append((number, words[0], []))
            words = words[1:]
        elif not continued:
            findings.odd(
                (file, number),
                "the line before lacks its backslash; taken as one list, the robot's own reader "
                "ends it there",
            )
        for word in words:
            if word == "(":
                depth += 1
            elif word == ")":
                depth -= 1
            else:
                entries[-1][2].append(word)
        depth = max(depth, 0)
        continued = goes_on
    return entries


def _number(words: list[str]) -> float | None:
    try:
        return float(words[0])
    except (IndexError, ValueError):
        return None


def _check_files(file: Path, number: int, words: list[str], findings: Findings) -> None:
    """Report how to import the positions files that are named, and which of them do not exist."""
    for word in words:
        path = file.parent / word
        if path.exists():
            findings.dropped((file, number), f"{word}: `skin import positions {path}` brings it")
        else:
            findings.odd((file, number), f"{word}: not found")
