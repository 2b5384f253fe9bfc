"""A command that was started in a strange way does its work, or says in a line why not."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"
SKIN = Path(sys.executable).parent / "skin"


def said_by(shell: str, **environment: str) -> "subprocess.CompletedProcess[bytes]":
    """Let a shell run `skin check` as `CHECK`."""
    line = shell.replace("CHECK", f"{SKIN} check {CONFIG}")
    return subprocess.run(
        ["sh", "-c", line], check=False, env=os.environ | environment, capture_output=True
    )


@pytest.mark.parametrize(
    "shell",
    [
        "CHECK >&-",
        "CHECK <&- >&- 2>&-",
        "CHECK | head -n 1",
        "CHECK > here; CHECK >> here",
        "ulimit -n 32; CHECK",
        "mkdir gone_$$; cd gone_$$; rmdir ../gone_$$; CHECK",
    ],
)
def test_a_command_does_its_work(shell: str, tmp_path: Path) -> None:
    done = said_by(f"cd {tmp_path}; {shell}")
    assert done.returncode == 0
    assert done.stderr == b""


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp437"])
def test_a_terminal_that_lacks_a_character_gets_another(encoding: str) -> None:
    done = said_by("CHECK", LC_ALL="POSIX", PYTHONIOENCODING=encoding)
    assert done.returncode == 0
    assert done.stderr == b""
    assert b"left_hand" in done.stdout


def test_a_strange_time_zone_and_locale_are_survived() -> None:
    done = said_by("CHECK", TZ=":/etc/passwd", LANG="xx_YY.bogus", LC_ALL="tr_TR.UTF-8")
    assert done.returncode == 0
    assert done.stderr == b""
