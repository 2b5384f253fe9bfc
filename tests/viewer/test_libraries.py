"""The page's libraries come from npm when the package is built, and are not needed to build it."""

import json
import shutil
import sys
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder

from tests.support.viewing import LIBRARIES, VENDOR

ROOT = Path(__file__).parents[2]
#: What a source tree needs for a wheel, without the libraries.
SOURCES = ["pyproject.toml", "hatch_build.py", "README.md", "LICENSE", "config"]


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A fresh clone, as far as the page is concerned."""
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copyfile
        copy(ROOT / name, tmp_path / name)
    ignored = shutil.ignore_patterns("vendor", "__pycache__")
    for name in ("skin_host/viewer", "emulator"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=ignored)
    (tmp_path / "skin_host/__init__.py").touch()
    return tmp_path


def with_npm(tree: Path, monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    """Put a program called npm, and nothing else, on the path."""
    folder = tree / "programs"
    folder.mkdir(exist_ok=True)
    npm = folder / "npm"
    npm.write_text(f"#!{sys.executable}\n{program}")
    npm.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))


def built(tree: Path) -> Path:
    (wheel,) = WheelBuilder(str(tree)).build(directory=str(tree / "dist"))
    return Path(wheel)


def test_the_libraries_are_beside_the_page():
    assert (VENDOR / "lock.sha256").exists(), LIBRARIES
    for name in ("uPlot", "three"):
        assert "MIT" in (VENDOR / f"{name}.LICENSE.txt").read_text()


def test_the_lock_file_names_versions_and_hashes_and_no_host():
    text = (ROOT / "skin_host/viewer/npm/package-lock.json").read_text()
    assert "://" not in text
    packages = json.loads(text)["packages"]
    assert {name for name in packages if name} == {"node_modules/three", "node_modules/uplot"}
    for name, package in packages.items():
        assert not name or package["integrity"].startswith("sha512-")


def test_without_the_registry_there_is_a_package_all_the_same(
    tree: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    with_npm(tree, monkeypatch, "import sys; sys.exit('npm error network')")
    assert built(tree).exists()
    said = capsys.readouterr()
    assert "the live page will lack its libraries" in said.out + said.err
    assert "npm error network" in said.out + said.err
    assert not (tree / VENDOR.relative_to(ROOT)).exists()


def test_what_is_there_is_not_fetched_again_until_the_lock_file_changes(
    tree: Path, monkeypatch: pytest.MonkeyPatch
):
    program = """
import pathlib, sys
assert sys.argv[1] == "ci" and "--ignore-scripts" in sys.argv
with open(pathlib.Path(__file__).with_name("calls"), "a") as calls:
    print("x", file=calls)
for name in ("three/build", "uplot/dist"):
    pathlib.Path("node_modules", name).mkdir(parents=True)
for name in ("uplot/dist/uPlot.iife.min.js", "uplot/dist/uPlot.min.css", "uplot/LICENSE",
        "three/build/three.module.min.js", "three/build/three.core.min.js", "three/LICENSE"):
    pathlib.Path("node_modules", name).write_text(name)
"""
    with_npm(tree, monkeypatch, program)
    calls = tree / "programs/calls"
    built(tree)
    built(tree)
    assert calls.read_text() == "x\n"
    assert (tree / VENDOR.relative_to(ROOT) / "uPlot.LICENSE.txt").read_text() == "uplot/LICENSE"
    lock = tree / "skin_host/viewer/npm/package-lock.json"
    lock.write_text(lock.read_text() + "\n")
    built(tree)
    assert calls.read_text() == "x\nx\n"
