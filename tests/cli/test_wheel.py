"""What `pip install` puts on a machine that has no checkout of the project."""

import json
import re
import shutil
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder

from tests.support.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site-packages with the wheel alone."""
    (wheel,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path_factory.mktemp("dist")))
    folder = tmp_path_factory.mktemp("site")
    zipfile.ZipFile(wheel).extractall(folder)
    return folder


def run(site: Path, program: str) -> str:
    """What a program prints that finds the wheel and what it depends on, but no checkout."""
    others = Path(pytest.__file__).parents[1]
    return subprocess.run(
        [
            sys.executable,
            "-I",
            "-S",
            "-c",
            f"import sys\nsys.path += {[str(site), str(others)]}\n{program}",
        ],
        check=True,
        capture_output=True,
        text=True,
        cwd=site,
        timeout=PATIENCE_S,
    ).stdout


def test_nothing_but_the_project_itself_stands_in_site_packages(site):
    names = {path.name.partition("-")[0] for path in site.iterdir()}
    assert names == {"skin_host"}


def test_the_command_line_finds_its_emulator_and_not_another_project_s(site):
    (site / "emulator").mkdir()
    (site / "emulator/__init__.py").write_text("raise ImportError('somebody else')")
    program = """
from skin_host.cli import main
try:
    main(["--version"])
except SystemExit:
    import emulator.robot
print(emulator.robot.__file__)
"""
    try:
        assert run(site, program).split()[-1] == str(site / "skin_host/_emulator/robot.py")
        with pytest.raises(subprocess.CalledProcessError):
            run(site, "import skin_host.client, emulator")
    finally:
        shutil.rmtree(site / "emulator")


def test_the_demo_runs_with_its_emulator_in_a_process_of_its_own(site):
    program = (
        "from skin_host.cli import main; main(['demo', '--duration', '1', '--page-port', '0'])"
    )
    summary = json.loads(run(site, program).splitlines()[-1])
    assert summary["bus"] == "socketpair"
    assert {"sweeps", "touches_begun"} <= set(summary)


def test_a_subscriber_imports_nothing_of_the_daemon(site):
    program = (
        "import skin_host.client; print(*(n for n in sys.modules if '.' not in n or 'skin_' in n))"
    )
    loaded = set(run(site, program).split())
    assert not loaded & {
        "can",
        "smbus2",
        "skin_host.layout",
        "skin_host.config.settings",
        "skin_host.processing.core",
    }


def test_the_metadata_say_what_it_is(site):
    (path,) = site.glob("*.dist-info/METADATA")
    said = Parser().parsestr(path.read_text())
    assert said["License-Expression"] == "Apache-2.0"
    assert said["Author"]
    needed = {
        re.split(r"[<>]", line)[0] for line in said.get_all("Requires-Dist") if "extra" not in line
    }
    # The first command, `skin demo`, needs no extra.
    assert {"amqtt", "websockets"} <= needed


def test_the_page_comes_with_its_libraries_and_their_licences(site):
    page = site / "skin_host/viewer/page"
    names = {path.name for path in (page / "vendor").iterdir()}
    assert {"uPlot.iife.min.js", "uPlot.LICENSE.txt"} <= names
    assert {"three.module.min.js", "three.core.min.js", "three.LICENSE.txt"} <= names
    assert not (page.parent / "npm").exists()
