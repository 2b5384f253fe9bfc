"""Turns devices of skinSpec files into buses, boards and parts of a configuration."""

from itertools import groupby
from pathlib import Path

import msgspec

from skin_host.config.check import format_triangles
from skin_host.config.settings import Board, Bus, Part, Patch, Settings
from skin_host.errors import ConfigurationError
from skin_host.importing.report import Findings
from skin_host.importing.skinspec import BoardSpec, Device, read_device

#: Boards of these types correct their values with a temperature pad: their triangles have ten pads.
TEN_PAD_TYPES = (0, 3, 8)


def import_boards(files: list[Path], base: Settings | None, findings: Findings) -> Settings:
    """Read skinSpec (or device) files; each gives a part, and a bus for each of its patches.

    Args:
        files: the XML files.
        base: a configuration to add to, or None.
        findings: receives the remarks.

    Raises:
        ConfigurationError: a file cannot be read or describes no board.
    """
    base = base or Settings(robot="", buses={}, boards={}, parts={})
    buses, boards, parts = dict(base.buses), dict(base.boards), dict(base.parts)
    robot = base.robot
    for file in files:
        device = read_device(file, findings)
        robot = robot or _robot(device)
        if not device.patches:
            raise ConfigurationError(
                f"{file}: no triangle of any board is on in it; import the device file that "
                "includes it, which names the CAN addresses, or add sets of triangles"
            )
        if device.name in parts:
            raise ConfigurationError(f'{file}: a part of this name exists: "{device.name}"')
        patches = []
        for number, specs in device.patches.items():
            bus = device.name if len(device.patches) == 1 else f"{device.name}_{number}"
            buses[bus] = Bus(channel=f"can{len(buses)}")
            findings.assumed(
                file, 0, f'patch {number} is the bus "{bus}" on channel {buses[bus].channel}'
            )
            for spec in specs:
                name = f"{bus}_{spec.address}"
                boards[name] = Board(
                    bus=bus,
                    address=spec.address,
                    period_ms=spec.period_ms,
                    skin_type=spec.skin_type,  # type: ignore[arg-type]  # read as one of them
                    no_load=spec.no_load,
                )
                patches += _patches(name, spec)
        parts[device.name] = Part(patches=patches)
        kinds = sorted({patch.kind for patch in patches})
        findings.assumed(
            file,
            0,
            f"triangles are of the kind {' and '.join(kinds)}, by the type of their boards, and "
            "lie side by side; `skin import skingui` brings kinds and places",
        )
    findings.assumed(files[0], 0, "boards are of the model mtb4")
    return msgspec.structs.replace(
        base, robot=robot or "robot", buses=buses, boards=boards, parts=parts
    )


def _robot(device: Device) -> str:
    text = "".join(c if c.isascii() and c.isalnum() else "-" for c in device.robot.lower())
    return text.strip("-")[:64]


def _patches(board: str, spec: BoardSpec) -> list[Patch]:
    """Return patches of consecutive triangles that have the same set-up."""
    kind = "triangle_10pad" if spec.skin_type in TEN_PAD_TYPES else "triangle"
    ordered = sorted(spec.triangles.items())
    patches = []
    for (shift, offset), group in groupby(ordered, key=lambda item: item[1]):
        numbers = [number for number, _ in group]
        patches.append(
            Patch(
                board=board,
                triangles=format_triangles(numbers),
                kind=kind,
                shift=shift,
                cdc_offset=offset,
            )
        )
    return patches
