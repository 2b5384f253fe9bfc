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


@pytest.mark.parametrize(
    "typo",
    [
        {},
        {"health": "staet"},
        {"key": "rate_herz"},
        {"argument": "stael_s"},
        {"callback": "on_health"},
    ],
)
def test_a_typo_fails_the_type_checker(tmp_path: Path, typo: dict[str, str]) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM.format(**(RIGHT | typo)))
    root = Path(__file__).parents[2]
    found = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", str(program)],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (found.returncode != 0) == bool(typo), found.stdout
