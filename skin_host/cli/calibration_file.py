"""The file that `skin calibrate` writes: where it lies, and whether it may be replaced."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from skin_host.config.settings import Settings
    from skin_host.layout import Layout
    from skin_host.processing.calibration import Calibration


def path_to_write(arguments: argparse.Namespace, settings: "Settings") -> Path:
    """Return where a calibration is to be kept.

    Raises:
        NewerFileError: a newer version has written what is there.
        OtherRobotError: it is another robot's.
        ConfigurationError: what was kept lies in the working directory.
        SkinError: nothing can be written there.
    """
    from skin_host.daemon.calibrate import calibration_path
    from skin_host.daemon.state import refuse_left_behind
    from skin_host.files import check_output, refuse_newer, refuse_other_robot
    from skin_host.processing.calibration.file import SCHEMA

    refuse_left_behind(settings, arguments.config.parent)
    path: Path = arguments.output or calibration_path(settings, arguments.node)
    refuse_newer(path, SCHEMA, "calibration")
    if arguments.output is None:
        refuse_other_robot(path, settings.robot, "calibration")
        check_output(path)
    return path


def write(
    arguments: argparse.Namespace, path: Path, found: "Calibration", layout: "Layout"
) -> None:
    """Write a calibration to `path`: the node's own file, or what the user named."""
    from skin_host.daemon.calibrate import keep_former
    from skin_host.files import whole_file
    from skin_host.processing.calibration.file import save_calibration

    if arguments.output is None:
        keep_former(path, layout, found.configuration)
        save_calibration(path, found, layout)
        return
    with whole_file(path) as growing:
        save_calibration(growing, found, layout)
