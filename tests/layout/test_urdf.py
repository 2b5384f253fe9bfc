"""The skin as tags of a robot's description."""

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from skin_host.cli import main
from skin_host.config.settings import load
from skin_host.layout import PadKind, build_layout
from skin_host.layout.urdf import urdf_text

CONFIG = Path(__file__).parents[2] / "config"


def turned(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """The z axis after URDF's rotation: about the fixed axes x, y and z in this order."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array([cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr])


@pytest.mark.parametrize("name", ["demo", "icub", "icub_2011_arm", "nao"])
def test_every_taxel_of_pressure_has_its_place_and_normal(name: str) -> None:
    layout = build_layout(load(CONFIG / f"{name}.toml"), CONFIG)
    robot = ET.fromstring(urdf_text(layout))
    assert robot.get("name") == layout.robot
    links = {link.get("name") for link in robot.iter("link")}
    for sensor, part in zip(robot.iter("sensor"), layout.parts, strict=True):
        parent = sensor.find("parent")
        assert parent is not None
        assert parent.get("link") == part.name
        assert part.name in links
        taxels = list(sensor.iter("taxel"))
        numbers = [int(taxel.get("idx", "")) + part.start for taxel in taxels]
        mine = np.arange(part.start, part.stop)
        assert numbers == mine[layout.pad_kind[mine] == PadKind.PRESSURE].tolist()
        for number, taxel in zip(numbers, taxels, strict=True):
            xyz, rpy = (np.array(taxel.get(key, "").split(), float) for key in ("xyz", "rpy"))
            np.testing.assert_allclose(xyz, layout.position_m[number], atol=1e-6)
            np.testing.assert_allclose(turned(*rpy), layout.normal[number], atol=1e-5)


def test_the_command_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "skin.urdf"
    assert main(["urdf", str(CONFIG / "nao.toml"), "--output", str(output)]) == 0
    assert capsys.readouterr().out == f"{output}\n"
    assert ET.parse(output).getroot().tag == "robot"
