"""Commands that work on files: check, replay, import."""

import argparse
import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from skin_host.cli.common import (
    Commands,
    Progress,
    add_command,
    add_config,
    load_skin,
    print_json,
)
from skin_host.cli.recordings import add_onto, play, positive
from skin_host.errors import RequestError


def add_commands(commands: Commands) -> None:
    """Add this room's commands to the parser."""
    check = add_command(
        commands,
        "check",
        "check a configuration and show what it describes",
        "skin check config/icub.toml",
    )
    add_config(check)
    check.add_argument("--json", action="store_true", help="one JSON document")
    check.set_defaults(run=_check)

    replay = add_command(
        commands,
        "replay",
        "put a recording of CAN frames through the whole pipeline",
        "skin replay grasp.log --config config/icub_hand.toml --output grasp.jsonl",
    )
    replay.add_argument(
        "log", metavar="LOG", type=Path, help="candump, ASC, BLF, MCAP, ... recording"
    )
    replay.add_argument("--config", type=Path, help="configuration file (TOML)")
    replay.add_argument("--output", default="-", help="file of JSON lines, - is stdout")
    replay.add_argument("--calibration", type=Path, help="use this calibration file")
    replay.add_argument(
        "--calibrate-seconds",
        type=positive,
        default=5.0,
        help="else calibrate on the first seconds of the recording",
    )
    add_onto(replay)
    replay.set_defaults(run=_replay)

    importing = add_command(
        commands,
        "import",
        "turn files of an iCub into a configuration",
        "skin import skinspec left_arm-skinSpec.xml --output robot.toml",
    )
    importing.add_argument(
        "kind",
        metavar="KIND",
        choices=("skinspec", "skingui", "positions", "skinmanager"),
        help="skinspec, skingui, positions or skinmanager",
    )
    importing.add_argument("files", metavar="FILE", nargs="+", type=Path, help="files to read")
    importing.add_argument("--output", required=True, type=Path, help="configuration to write")
    importing.add_argument("--config", type=Path, help="configuration to add to")
    importing.add_argument("--part", help="the part that a positions file describes")
    importing.set_defaults(run=_import)


def _check(arguments: argparse.Namespace) -> int:
    from skin_host import check

    settings, layout = load_skin(arguments.config)
    description = check.describe(settings, layout)
    if arguments.json:
        print_json(description)
    else:
        print(check.table(description))
    return 0


def _replay(arguments: argparse.Namespace) -> int:
    from skin_host.engine import Engine
    from skin_host.fingertip.health import FingertipHealth
    from skin_host.health import Health
    from skin_host.processing import calibration
    from skin_host.publish.lines import EventLines, frame_line, health_line
    from skin_host.replay import calibrate_from_log, replay
    from skin_host.settings import skin_hash

    if arguments.onto is not None:
        return play(arguments)
    if arguments.config is None:
        raise RequestError("the following arguments are required: --config")
    settings, layout = load_skin(arguments.config)
    if arguments.calibration is not None:
        found = calibration.load(arguments.calibration, layout, skin_hash(settings))
    else:
        found = calibrate_from_log(arguments.log, settings, layout, arguments.calibrate_seconds)
    engine = Engine(settings, layout, list(range(len(layout.parts))), found)
    health = Health(engine)
    tips = engine.fingertips
    lines = EventLines()
    progress = Progress("replay")
    with _output(arguments.output) as output:
        for number, step in enumerate(replay(arguments.log, engine)):
            health.note_sweeps(engine.sweeps)
            health.note_step(step)
            output.write(frame_line(step.frame))
            told = step.events if tips is None else [*step.events, *tips.take()]
            output.writelines(map(lines.line, told))
            if number % 200 == 0:
                progress.update(0.0, f"{number} frames")
        for part in engine.parts:
            output.write(health_line(health.replayed(part)))
        if tips is not None:
            output.writelines(map(lines.line, tips.take()))
            for record in FingertipHealth(tips).records(None).values():
                output.write(health_line(record))
    progress.close()
    return 0


def _import(arguments: argparse.Namespace) -> int:
    from skin_host.importing.report import Findings
    from skin_host.importing.run import import_files

    findings = Findings()
    try:
        written = import_files(
            arguments.kind,
            arguments.files,
            arguments.output,
            findings,
            config=arguments.config,
            part=arguments.part,
        )
    finally:
        if findings.items:
            print(findings.table(), file=sys.stderr)
    for path in written:
        print(path)
    return 0


@contextlib.contextmanager
def _output(name: str) -> Iterator[BinaryIO]:
    """Standard output, or a file that appears whole or not at all."""
    if name == "-":
        yield sys.stdout.buffer
        return
    path = Path(name)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as file:
            yield file
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
