"""`skin calibrate`: on the untouched skin, summarised by triangle; from recordings, see `fits`."""

import argparse
from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skin_host.cli.calibration_file import path_to_write, write
from skin_host.cli.common import (
    Commands,
    Progress,
    add_command,
    add_config,
    add_log_level,
    load_skin,
    positive,
    print_json,
    refuse_input,
    set_up_logging,
    warn,
    warn_of_virtual,
)
from skin_host.cli.fits import add_fits, fit
from skin_host.cli.options import add_rules
from skin_host.errors import StateError, visible
from skin_host.files import check_output

if TYPE_CHECKING:
    from skin_host.processing.calibration.outcome import Outcome, TriangleVerdict

#: Whether a fingertip was zeroed, in words.
_TIPS = {
    "ok": "zero taken",
    "touched": "zero taken while it was touched",
    "unchanged": "too few samples of its board; it keeps its zero",
    "absent": "too few samples of its board; no zero",
}


def add_commands(commands: Commands) -> None:
    """Add the command of this module to the parser."""
    calibrate = add_command(
        commands,
        "calibrate",
        "calibrate the untouched skin and keep the result; while a daemon runs use `skin "
        "command calibrate`",
        "skin calibrate config/icub.toml --seconds 5",
    )
    add_config(calibrate)
    calibrate.add_argument("--node", default="main", help="which parts to calibrate")
    calibrate.add_argument(
        "--seconds",
        type=positive,
        default=5.0,
        help="how long to look; longer until each board that sends gave 60 readings of each pad",
    )
    calibrate.add_argument("--output", type=Path, metavar="FILE", help="keep it here instead")
    calibrate.add_argument("--json", action="store_true", help="one JSON document")
    calibrate.add_argument(
        "--strict",
        action="store_true",
        help="exit status 1 if the skin was touched meanwhile, or received too rarely",
    )
    add_fits(calibrate)
    add_rules(
        calibrate,
        needs={
            "--load": ["--pressure", "--relaxation"],
            "--levels": ["--pressure"],
            "--weight-kpa": ["--relaxation"],
            "--model": ["--relaxation"],
        },
        idle_with={
            "--weight-kpa": ["--load"],
            "--node": ["--relaxation"],
            "--strict": ["--relaxation", "--pressure"],
        },
    )
    add_log_level(calibrate)
    calibrate.set_defaults(run=_calibrate)


def _calibrate(arguments: argparse.Namespace) -> int:
    import asyncio

    from skin_host.client.serving import served_by_daemon
    from skin_host.daemon.alone import alone
    from skin_host.daemon.calibrate import take_calibration
    from skin_host.daemon.memory import known_of, remembered
    from skin_host.layout import parts_of
    from skin_host.processing.calibration import with_pressures_of, with_zeros
    from skin_host.processing.calibration.calibrator import going_on
    from skin_host.processing.calibration.file import find_calibration
    from skin_host.processing.calibration.outcome import outcome

    set_up_logging(arguments.verbose)
    logs = arguments.relaxation, arguments.pressure
    refuse_input(arguments.output, arguments.config, *logs, arguments.load)
    if arguments.output is not None:
        check_output(arguments.output)
    if arguments.relaxation is not None or arguments.pressure is not None:
        return fit(arguments)
    settings, layout = load_skin(arguments.config)
    warn_of_virtual(settings)
    parts = parts_of(layout, arguments.node)
    path = path_to_write(arguments, settings)
    served = asyncio.run(
        served_by_daemon(settings, arguments.config.parent, {layout.parts[i].name for i in parts})
    )
    if served is not None:
        raise StateError(
            f"a daemon publishes {served} at broker {settings.mqtt.host}:{settings.mqtt.port}: "
            "calibrating beside it "
            "would zero its boards; ask it with `skin command calibrate`, or stop it"
        )
    progress = Progress("calibrating, keep the skin untouched")
    with alone(settings, arguments.node):
        zeros = remembered(settings, layout, arguments.node, take_new=True).zeros
        try:
            found = asyncio.run(
                take_calibration(
                    *(settings, layout, parts, arguments.seconds, progress.update),
                    touched=zeros.touched,
                )
            )
        finally:
            progress.close()
        before = find_calibration(path, layout, found.configuration)
        if before is not None:
            found = going_on(found, known_of(before, zeros, layout))
            found = with_zeros(found, before.zeros | found.zeros)
            found = with_pressures_of(found, before)
        write(arguments, path, found, layout)
    tips = [name for name, tip in settings.fingertips.items() if tip.node == arguments.node]
    result = outcome(found, layout, parts, fingertips=tips, before=before)
    return show(result, {"file": str(path), **result}, f"kept in {path}", arguments)


def show(
    found: "Outcome", document: Mapping[str, Any], where: str, arguments: argparse.Namespace
) -> int:
    """Print what a calibration found, and warn of what is wrong with it.

    Args:
        found: what it found.
        document: the same and more, for `--json`.
        where: what became of it, for people.
        arguments: `json` and `strict`.

    Returns:
        The exit status.
    """
    from skin_host.daemon.calibrate import received_too_rarely, touched_meanwhile
    from skin_host.health.diagnosis import named_by_part

    if arguments.json:
        print_json(document)
    else:
        print(_table(found))
        print(f"calibration {visible(found['id'])} {where}")
    if found["unchanged"]:
        is_one = sum(map(len, found["unchanged"].values())) == 1
        go_on = "it goes on" if is_one else "they go on"
        warn(f"{named_by_part(found['unchanged'])}: received too rarely; {go_on} as before")
    rare = received_too_rarely(found)
    if rare:
        warn(
            f"{named_by_part(rare)}: received too rarely; not valid until calibrated; check with "
            "`skin scan` whether their boards are powered and answer"
        )
    if found["damaged"]:
        warn(f"{named_by_part(found['damaged'])}: calibrated without the bytes that were damaged")
    touched = touched_meanwhile(found, "repeat")
    if touched is not None:
        warn(touched)
    return 1 if arguments.strict and (touched or rare or found["unchanged"]) else 0


def _table(found: "Outcome") -> str:
    """Return lines for people: of the triangles, see `triangle_table`, and of each fingertip."""
    tips = [f"{visible(name)}: {_TIPS[verdict]}" for name, verdict in found["fingertips"].items()]
    return "\n".join([triangle_table(found["triangles"])] * bool(found["triangles"]) + tips)


def triangle_table(verdicts: list["TriangleVerdict"]) -> str:
    """Return a line for each triangle that is not ok, and one for those of a board that are."""
    from skin_host.config.check import columns
    from skin_host.config.settings import format_triangles

    def place(one: "TriangleVerdict") -> tuple[str, str]:
        return visible(one["part"]), visible(one["board"])

    rows: list[list[str | int]] = []
    for (part, board), triangles in groupby(verdicts, place):
        mine = list(triangles)
        well = [one["triangle"] for one in mine if not one["taxels"]]
        if well:
            rows.append([part, board, format_triangles(well), "ok"])
        rows += [[part, board, one["triangle"], _words(one)] for one in mine if one["taxels"]]
    return columns(["part", "board", "triangles", "verdict"], rows)


def _words(triangle: "TriangleVerdict") -> str:
    return "; ".join(
        visible(name).replace("_", " ")
        if len(taxels) == triangle["pressure_taxels"]
        else f"{len(taxels)} {visible(name).replace('_', ' ')}: {', '.join(map(str, taxels))}"
        for name, taxels in triangle["taxels"].items()
    )
