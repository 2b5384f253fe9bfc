"""Commands that work on files: check, replay, import."""

import argparse
import gc
import sys
from pathlib import Path

from skin_host.cli.common import (
    Commands,
    Progress,
    add_command,
    add_config,
    load_skin,
    print_json,
    refuse_input,
    warn,
)
from skin_host.cli.options import add_rules
from skin_host.cli.recordings import PROCESSED, add_calibration, add_onto, play
from skin_host.errors import RequestError, SkinError, visible
from skin_host.files import check_output


def add_commands(commands: Commands) -> None:
    """Add the commands of this module to the parser."""
    check = add_command(
        commands,
        "check",
        "check a configuration and show what it describes",
        "skin check config/icub.toml",
    )
    add_config(check)
    check.add_argument("--json", action="store_true", help="one JSON document")
    check.add_argument(
        "--running",
        type=Path,
        metavar="FILE",
        help="check only whether the daemon that wrote FILE could take it without a restart",
    )
    add_rules(check, idle_with={"--json": ["--running"]})
    check.set_defaults(run=_check)

    replay = add_command(
        commands,
        "replay",
        "process a recording of CAN frames with the whole pipeline",
        "skin replay grasp.log --config config/icub_hand.toml --output grasp.jsonl",
    )
    replay.add_argument(
        "logs",
        metavar="LOG",
        nargs="+",
        type=Path,
        help="candump, ASC, BLF, MCAP, ... recording; several are processed side by side",
    )
    replay.add_argument(
        "--config",
        type=Path,
        help="configuration file (TOML); needed, but to play the messages of an .mcap to a broker",
    )
    replay.add_argument(
        "--output", default="-", help="file of JSON lines, - is stdout; of several LOGs, a folder"
    )
    replay.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="process on the Dask cluster with this scheduler, such as tcp://host:8786; "
        "its workers must see the files under the same paths",
    )
    add_calibration(replay)
    add_onto(replay)
    add_rules(
        replay,
        needs={
            "--onto can": ["--config"],
            "--speed": ["--onto"],
            "--broker": ["--onto broker"],
            "--robot": ["--onto broker"],
            **PROCESSED,
        },
        idle_with={
            "--output": ["--onto"],
            "--scheduler": ["--onto"],
            **{option: ["--onto can"] for option in PROCESSED},
        },
    )
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
    add_rules(importing, needs={"--part": ["positions"]})
    importing.set_defaults(run=_import)


def _check(arguments: argparse.Namespace) -> int:
    from skin_host.config import check
    from skin_host.config.settings import load_running, needs_restart

    settings, layout = load_skin(arguments.config)
    if arguments.running is not None:
        what = needs_restart(load_running(arguments.running), settings)
        if what is not None:
            raise RequestError(f"{arguments.config}: {what} changed; that needs a restart")
        return 0
    description = check.describe(settings, layout)
    if arguments.json:
        print_json(description)
    else:
        print(check.table(description))
    return 0


def _replay(arguments: argparse.Namespace) -> int:
    if arguments.onto is not None:
        if len(arguments.logs) > 1:
            raise RequestError("--onto plays one LOG at a time")
        (arguments.log,) = arguments.logs
        return play(arguments)
    if arguments.config is None:
        raise RequestError("the following arguments are required: --config")
    if len(arguments.logs) > 1 or arguments.scheduler is not None:
        return _replay_all(arguments)
    # The collector looks through what is imported again and again, and finds nothing.
    gc.set_threshold(100_000)
    from skin_host.recording.replay import Task, process

    (log,) = arguments.logs
    progress = Progress("replay")

    def told(number: int) -> None:
        progress.update(0.0, f"{number} frames")

    output = None if arguments.output == "-" else Path(arguments.output)
    refuse_input(output, log, arguments.config, arguments.calibration)
    if output is not None:
        check_output(output)
    calibrated = arguments.calibration, arguments.calibrate_seconds
    task = Task(log, arguments.config, output, *calibrated)
    try:
        process(task, told, lambda doubt: warn(f"{log}: {doubt}"))
    finally:
        progress.close()
    return 0


def _replay_all(arguments: argparse.Namespace) -> int:
    """Process several recordings, each into its own file in the folder OUTPUT."""
    from skin_host.recording.replay import Task, process_all

    if arguments.output == "-":
        raise RequestError("several LOGs go into a folder: wanted --output FOLDER")
    folder = Path(arguments.output)
    # Absolute paths, because workers of a cluster have other working directories.
    tasks = [
        Task(
            log.absolute(),
            arguments.config.absolute(),
            (folder / f"{log.stem}.jsonl").absolute(),
            arguments.calibration and arguments.calibration.absolute(),
            arguments.calibrate_seconds,
        )
        for log in arguments.logs
    ]
    outputs = [task.output for task in tasks]
    for output in outputs:
        refuse_input(output, *arguments.logs, arguments.config, arguments.calibration)
    twice = next((one for one in outputs if outputs.count(one) > 1), None)
    if twice is not None:
        raise RequestError(f"{twice}: two LOGs of that name; process them one folder at a time")
    load_skin(arguments.config)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"--output {folder}: {error.strerror}") from None
    progress = Progress("replay")
    worst = 0
    for number, (task, result) in enumerate(process_all(tasks, arguments.scheduler), 1):
        if isinstance(result, SkinError):
            progress.close()
            print(f"skin replay: {visible(str(result))}", file=sys.stderr)
            worst = max(worst, result.exit_status)
        elif result:
            progress.close()
            for doubt in result:
                warn(f"{task.log}: {doubt}")
        progress.update(number / len(tasks), task.log.name)
    progress.close()
    return worst


def _import(arguments: argparse.Namespace) -> int:
    from skin_host.importing import import_files
    from skin_host.importing.report import Findings

    # The configuration to add to may be the one to write.
    refuse_input(arguments.output, *arguments.files)
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
    except SkinError as error:
        # What was filled in is of no interest where nothing is written.
        wrong = [one for one in findings.items if one.grade == "odd"]
        raise type(error)("; ".join(map(str, [*wrong[:1], error]))) from None
    if findings.items:
        print(findings.table(), file=sys.stderr)
    for path in written:
        print(path)
    return 0
