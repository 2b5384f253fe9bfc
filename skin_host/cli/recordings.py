"""Commands around recordings: record, export, plot, dbc, urdf; and replay onto CAN or a broker."""

import argparse
import contextlib
import logging
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skin_host.cli.common import (
    Commands,
    add_command,
    add_config,
    filled,
    finite,
    load_skin,
    positive,
    print_json,
    refuse_input,
    run,
    warn,
    warn_of_virtual,
)
from skin_host.cli.options import add_rules
from skin_host.errors import RequestError, SkinError
from skin_host.files import check_output

if TYPE_CHECKING:
    import asyncio

    from skin_host.config.settings import Settings
    from skin_host.layout import Layout
    from skin_host.processing.calibration import Calibration
    from skin_host.recording.export import Series

LOCAL = "mqtt://localhost"
#: Messages are as they were published; only CAN frames are processed, and calibrated before.
PROCESSED = {"--calibration": ["--config"], "--calibrate-seconds": ["--config"]}


def add_commands(commands: Commands) -> None:
    """Add this room's commands to the parser."""
    record = add_command(
        commands,
        "record",
        "record a robot's messages (MCAP), the frames of its buses, or both",
        "skin record grasp.mcap --seconds 60",
    )
    record.add_argument(
        "file", metavar="FILE", type=Path, help="new file: .mcap, or for CAN alone .log, .blf, .asc"
    )
    record.add_argument("--broker", metavar="URL", help=f"record its messages ({LOCAL})")
    record.add_argument("--robot", type=filled, help="whose, if the broker knows several")
    record.add_argument("--config", type=Path, help="record the CAN frames of its buses")
    record.add_argument("--seconds", type=positive, metavar="S", help="end after so long")
    record.add_argument("--json", action="store_true", help="one JSON document at the end")
    add_rules(record, needs={"--robot": ["--broker", "no --config"]})
    record.set_defaults(run=_record)

    export = add_command(
        commands,
        "export",
        "write a recording for other tools: .npz, .parquet, Foxglove (.mcap), Rerun (.rrd), CSV",
        "skin export grasp.mcap grasp.npz",
    )
    _add_recording(export)
    export.add_argument(
        "output",
        metavar="OUTPUT",
        type=Path,
        help="file .npz, .parquet, .mcap or .rrd; or a folder",
    )
    export.add_argument("--lerobot", action="store_true", help="the folder is a LeRobot data set")
    add_rules(export, needs=PROCESSED)
    export.set_defaults(run=_export)

    plot = add_command(
        commands,
        "plot",
        "draw pressure over time, the skin at an instant, or a calibration",
        "skin plot pressure grasp.mcap grasp.png",
    )
    plot.add_argument("what", choices=("pressure", "map", "calibration"), help="what to draw")
    _add_recording(plot, "recording, or calibration")
    plot.add_argument("output", metavar="OUTPUT", type=Path, help="file .png, .svg or .pdf")
    plot.add_argument("--part", help="which part, if there are several")
    plot.add_argument(
        "--taxels",
        type=_numbers,
        metavar="N,N",
        help="pressure: these taxels of the part; without it those of the highest peaks",
    )
    plot.add_argument(
        "--at",
        type=finite,
        metavar="S",
        help="map: so long after the part's first frame; without it when the sum of the pressures "
        "of its taxels was highest",
    )
    add_rules(
        plot,
        needs={"--taxels": ["pressure"], "--at": ["map"], **PROCESSED},
        idle_with={option: ["calibration"] for option in ["--part", *PROCESSED]},
    )
    plot.set_defaults(run=_plot)

    dbc = add_command(
        commands,
        "dbc",
        "write the boards' CAN frames as a DBC file for other tools",
        "skin dbc config/demo.toml --output skin.dbc",
    )
    dbc.add_argument(
        "config", metavar="CONFIG", nargs="?", type=Path, help="only its boards; all that can be"
    )
    dbc.add_argument("--bus", help="which bus of CONFIG")
    dbc.add_argument("--output", type=Path, help="file to write; else standard output")
    add_rules(dbc, needs={"--bus": ["CONFIG"]})
    dbc.set_defaults(run=_dbc)

    urdf = add_command(
        commands,
        "urdf",
        "write the taxels' places as tags for a robot's description (URDF)",
        "skin urdf config/icub.toml --output skin.urdf",
    )
    add_config(urdf)
    urdf.add_argument("--output", type=Path, help="file to write; else standard output")
    urdf.set_defaults(run=_urdf)


def add_onto(parser: argparse.ArgumentParser) -> None:
    """Add the options of `skin replay` that play a recording elsewhere."""
    parser.add_argument(
        "--onto", choices=("can", "broker"), help="play it on CONFIG's buses, or to a broker"
    )
    parser.add_argument(
        "--speed", type=positive, default=1.0, help="for --onto: 2 is twice as fast"
    )
    parser.add_argument("--broker", default=LOCAL, metavar="URL", help="for --onto broker")
    parser.add_argument(
        "--robot",
        type=filled,
        help="for --onto broker: play it under this name, not the recorded or configured",
    )


def play(arguments: argparse.Namespace) -> int:
    """Play a recording onto CAN, or to a broker: messages as they are, CAN frames processed.

    Raises:
        RequestError: the options do not go together.
    """
    import asyncio

    from skin_host.recording import is_mcap

    if arguments.onto == "can":
        return asyncio.run(_play_on_buses(arguments))
    if arguments.config is None and not is_mcap(arguments.log):
        raise _needs_config(arguments.log)
    if arguments.config is not None:
        return asyncio.run(_play_processed(arguments))
    return asyncio.run(_play_said(arguments))


def add_calibration(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose how a recording of CAN frames is calibrated."""
    parser.add_argument(
        "--calibration", type=Path, metavar="FILE", help="use this calibration file"
    )
    parser.add_argument(
        "--calibrate-seconds",
        type=positive,
        metavar="S",
        help="take the zero from the recording's first seconds, 5 without a calibration file; "
        "with both, curves and gains come from the file",
    )


def _add_recording(parser: argparse.ArgumentParser, about: str = "recording") -> None:
    parser.add_argument("recording", metavar="FILE", type=Path, help=about)
    parser.add_argument("--config", type=Path, help="process the CAN frames of FILE with it")
    add_calibration(parser)


def _calibration(
    arguments: argparse.Namespace, log: Path, settings: "Settings", layout: "Layout"
) -> "Calibration":
    """Return the calibration with which a recording is processed; print what is in doubt of it."""
    from skin_host.recording.replay import calibration_for, doubts

    warn_of = partial(_warn_of, log)
    found = calibration_for(
        log, settings, layout, arguments.calibration, arguments.calibrate_seconds, warn_of
    )
    for doubt in doubts(found, settings, layout):
        warn_of(doubt)
    return found


def _warn_of(log: Path, doubt: str) -> None:
    warn(f"{log}: {doubt}")


def _needs_config(recording: Path) -> RequestError:
    """Return the error of a recording of CAN frames without --config.

    Raises:
        LogError: there is no such recording.
    """
    from skin_host.bus.logs import check_format

    check_format(recording)
    return RequestError(f"{recording}: CAN frames need --config to be processed")


def _numbers(text: str) -> list[int]:
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: wanted numbers such as 3,14") from None


def _record(arguments: argparse.Namespace) -> int:
    from skin_host.recording import is_mcap
    from skin_host.recording.capture import CanLog, can_suffix
    from skin_host.recording.mcap import Recorder

    file: Path = arguments.file
    if file.exists():
        raise RequestError(f"{file}: is there already; remove it or choose another name")
    settings = None if arguments.config is None else load_skin(arguments.config)[0]
    if is_mcap(file):
        with Recorder(file) as recorder:
            told = run(partial(_capture, arguments, settings, recorder, None))
            if not recorder.messages:
                _require_frames(arguments, 0)
        told |= {"messages": recorder.messages, "unreadable": recorder.unreadable}
    else:
        can_suffix(file)
        if settings is None or arguments.broker is not None:
            raise RequestError(f"{file}: holds CAN frames alone and needs --config; or use .mcap")
        with CanLog(file, [bus.channel for bus in settings.buses.values()]) as log:
            told = run(partial(_capture, arguments, settings, None, log))
            _require_frames(arguments, log.frames)
        told |= {"frames": log.frames}
        told |= {"frames_left_out": log.left_out} if log.left_out else {}
        told |= {"times_moved": log.moved} if log.moved else {}
    if arguments.json:
        print_json({"file": str(file)} | told)
    else:
        print(f"{file}: " + ", ".join(f"{key} {_plain(value)}" for key, value in told.items()))
    if "messages" in told:
        _require_frames(arguments, told["messages"].get("can", 0))
    return 0


def _require_frames(arguments: argparse.Namespace, frames: int) -> None:
    """Refuse a recording of buses without frames; raised before its end, it leaves no file.

    Raises:
        SkinError: there are none.
    """
    if arguments.config is not None and not frames:
        raise SkinError(
            f"{arguments.file}: no CAN frame came on the buses of {arguments.config}; is the bus "
            "up? (An interface `virtual` reaches only its own program.)"
        )


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return "(" + ", ".join(f"{n} {kind}" for kind, n in value.items()) + ")" if value else "0"
    return str(value)


async def _capture(
    arguments: argparse.Namespace,
    settings: "Settings | None",
    recorder: Any,
    log: Any,
    stop: "asyncio.Event",
) -> dict[str, Any]:
    """Record until `stop` is set, or the time is over; report what was lost.

    The time begins when the robot is known and the buses are open.

    Raises:
        SkinError: it was ended before that.
    """
    import asyncio

    from skin_host.mqtt.address import Broker
    from skin_host.recording.capture import capture_broker, capture_buses
    from skin_host.tasks import until

    told: dict[str, Any] = {}
    sources = []

    async def from_broker(broker: Broker, base: str, robot: str) -> None:
        told["gaps"] = await capture_broker(recorder, broker, base, robot, stop)
        told["messages_lost"] = recorder.discarded

    async def from_buses(settings: "Settings") -> None:
        sink = log.put if log is not None else recorder.can
        told["frames_lost"] = await capture_buses(settings, sink, stop)

    async def begin_the_time() -> None:
        if arguments.seconds is not None:
            asyncio.get_running_loop().call_later(arguments.seconds, stop.set)

    if recorder is not None and (arguments.broker is not None or settings is None):
        url = arguments.broker or LOCAL
        broker, base = Broker.from_url(url)
        robot = await until(stop, _robot(url, arguments.robot))
        if robot is None:
            raise SkinError(
                f"{arguments.file}: ended before a robot was found at {broker}; nothing is recorded"
            )
        sources.append(from_broker(broker, base or "skin", robot))
    if settings is not None:
        sources.append(from_buses(settings))
    if arguments.seconds is None:
        print("recording; end with Ctrl-C", file=sys.stderr)
    async with contextlib.AsyncExitStack() as stack:
        stack.callback(stop.set)  # one that fails ends the other
        # Buses are opened in the first step of theirs, which may take seconds; the time follows.
        await asyncio.gather(*sources, begin_the_time())
    return told


async def _robot(url: str, robot: str | None) -> str:
    """Return the name of the robot at a broker."""
    from skin_host.client import SkinClient

    async with SkinClient(url, robot=robot) as skin:
        return skin.robot


def _series(arguments: argparse.Namespace) -> "Series":
    from skin_host.recording import is_mcap
    from skin_host.recording.export import read_frames, read_messages

    if arguments.config is None:
        if not is_mcap(arguments.recording):
            raise _needs_config(arguments.recording)
        return read_messages(arguments.recording)
    settings, layout = load_skin(arguments.config)
    found = _calibration(arguments, arguments.recording, settings, layout)
    warn_of = partial(_warn_of, arguments.recording)
    return read_frames(arguments.recording, settings, layout, found, warn_of)


def _export(arguments: argparse.Namespace) -> int:
    from skin_host.recording.export import check_format, export

    refuse_input(arguments.output, arguments.recording, arguments.config, arguments.calibration)
    # Before the work, which takes minutes for a long recording.
    check_format(arguments.output, lerobot=arguments.lerobot)
    check_output(arguments.output, folder=not arguments.output.suffix)
    written = export(
        _series(arguments), arguments.output, arguments.recording, lerobot=arguments.lerobot
    )
    for path in written:
        print(path)
    return 0


def _plot(arguments: argparse.Namespace) -> int:
    from skin_host.config.settings import skin_hash
    from skin_host.processing.calibration.file import load_calibration
    from skin_host.recording import plots

    refuse_input(arguments.output, arguments.recording, arguments.config, arguments.calibration)
    plots.check_format(arguments.output)
    check_output(arguments.output)
    if arguments.what == "calibration":
        if arguments.config is None:
            raise RequestError("a calibration is drawn with --config, whose skin it is of")
        settings, layout = load_skin(arguments.config)
        found = load_calibration(arguments.recording, layout, skin_hash(settings))
        plots.plot_calibration(found, layout, arguments.output)
    else:
        series = _series(arguments)
        series.require_frames(f"{arguments.output}: a picture")
        part = arguments.part or next(iter(series.parts))
        if arguments.part is None and len(series.parts) > 1:
            raise RequestError(f"choose one with --part; there are: {', '.join(series.parts)}")
        if arguments.what == "pressure":
            plots.plot_pressure(series, arguments.output, part, arguments.taxels)
        else:
            plots.plot_map(series, arguments.output, part, arguments.at)
    print(arguments.output)
    return 0


def _dbc(arguments: argparse.Namespace) -> int:
    from skin_host.bus.dbc import dbc_text

    refuse_input(arguments.output, arguments.config)
    if arguments.config is None:
        text = dbc_text(bus=arguments.bus)
    else:
        settings, layout = load_skin(arguments.config)
        text = dbc_text(layout, arguments.bus, settings.fingertips)
    return _write(text, arguments.output)


def _urdf(arguments: argparse.Namespace) -> int:
    from skin_host.layout.urdf import urdf_text

    refuse_input(arguments.output, arguments.config)
    _, layout = load_skin(arguments.config)
    return _write(urdf_text(layout), arguments.output)


def _write(text: str, output: Path | None) -> int:
    from skin_host.files import write_atomic, writing

    if output is None:
        print(text, end="")
        return 0
    with writing(output):
        is_file = write_atomic(output, text.encode())
    if is_file:
        print(output)
    return 0


async def _play_on_buses(arguments: argparse.Namespace) -> int:
    from skin_host.bus.opening import open_bus
    from skin_host.recording.playback import play_on_buses

    settings, _ = load_skin(arguments.config)
    warn_of_virtual(settings, warn)
    with contextlib.ExitStack() as stack:
        buses = {
            name: stack.enter_context(open_bus(name, bus)) for name, bus in settings.buses.items()
        }
        n = await play_on_buses(arguments.log, settings, buses, arguments.speed)
    print(f"{n} frames played")
    return 0


async def _play_processed(arguments: argparse.Namespace) -> int:
    from skin_host.config.settings import changed
    from skin_host.layout import build_layout
    from skin_host.mqtt.address import Broker
    from skin_host.processing.core import Engine
    from skin_host.recording.playback import play_processed, played_as, refuse_live
    from skin_host.recording.replay import mistimed_boards

    settings, layout = load_skin(arguments.config)
    broker, base = Broker.from_url(arguments.broker, settings.mqtt.protocol)
    if base:
        settings = changed(settings, {"mqtt.base": base})
    if arguments.robot is not None and arguments.robot != settings.robot:
        settings = played_as(settings, arguments.robot)
        layout = build_layout(settings, arguments.config.parent)
    await refuse_live(broker, settings.mqtt.base, settings.robot)
    found = _calibration(arguments, arguments.log, settings, layout)
    engine = Engine(settings, layout, list(range(len(layout.parts))), found)
    # What goes wrong at the broker is stated in one line at the end.
    logging.getLogger("skin_host.mqtt").addHandler(logging.NullHandler())
    played = await play_processed(arguments.log, engine, settings, broker, arguments.speed)
    print(
        f"{played.frames} frames played; delivered: {played.frames_sent} frames, "
        f"{played.events_sent} touch events"
    )
    if mistimed := mistimed_boards(engine):
        _warn_of(arguments.log, mistimed)
    return 0


async def _play_said(arguments: argparse.Namespace) -> int:
    from skin_host.mqtt.address import Broker
    from skin_host.recording.playback import play_messages

    broker, _ = Broker.from_url(arguments.broker)
    n = await play_messages(arguments.log, broker, arguments.speed, arguments.robot)
    print(f"{n} messages played")
    return 0
