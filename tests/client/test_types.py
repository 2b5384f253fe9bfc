"""A typo in a subscriber's program fails mypy."""

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
from skin_host.client import Contact, Health, SkinCallbacks, Touch
def on_health(health: Health) -> None:
    print(health.{health}, health.record["{key}"])
def on_touch(touch: Touch) -> None:
    print(touch.force_n)
skin = SkinCallbacks("mqtt://localhost", {argument}=3.0)
skin.on_health(on_health)
skin.on_touch({callback})
"""
RIGHT = {"health": "state", "key": "rate_hz", "argument": "stale_s", "callback": "on_touch"}


TYPOS: dict[str, dict[str, str]] = {
    "none": {},
    "attribute": {"health": "staet"},
    "key": {"key": "rate_herz"},
    "argument": {"argument": "stael_s"},
    "callback": {"callback": "on_health"},
}


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What mypy finds in a program for each typo; once for all, as its start takes longest."""
    folder = tmp_path_factory.mktemp("programs")
    for name, typo in TYPOS.items():
        (folder / f"{name}_typo.py").write_text(PROGRAM.format(**(RIGHT | typo)))
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", *map(str, folder.iterdir())],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert f"checked {len(TYPOS)} source files" in done.stdout, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("name", TYPOS)
def test_a_typo_fails_the_type_checker(found: str, name: str) -> None:
    assert (f"{name}_typo.py" in found) == (name != "none"), found
