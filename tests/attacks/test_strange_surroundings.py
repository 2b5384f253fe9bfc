"""A command that was started in a strange way does its work, or says in a line why not."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support.waiting import PATIENCE_S

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


def test_an_emulated_robot_does_not_wait_for_the_rest_of_a_line(tmp_path: Path) -> None:
    """Whoever writes faults to it may write half a line, two at once, bytes that are no text, or
    one without an end: it goes on.
    """
    with (tmp_path / "said").open("w") as said:
        robot = subprocess.Popen(
            [SKIN, "emulate", CONFIG], stdin=subprocess.PIPE, stdout=said, stderr=said
        )
    assert robot.stdin is not None

    def wait_for(text: str) -> str:
        deadline_s = time.monotonic() + PATIENCE_S
        while text not in (found := (tmp_path / "said").read_text()):
            assert robot.poll() is None, found
            assert time.monotonic() < deadline_s, found
            time.sleep(0.05)
        return found

    try:
        wait_for("is emulated on")
        os.write(robot.stdin.fileno(), b"nope\nneither\nboard_silent boa")
        wait_for('"nope"')
        wait_for('"neither"')
        os.write(robot.stdin.fileno(), b"rd=\xff\x1b[2J\n")
        wait_for("\\x1b[2J")
        os.write(robot.stdin.fileno(), b"x" * 20_000)
        wait_for("a line of more than 4096 bytes")
        robot.terminate()
        assert robot.wait(PATIENCE_S) in (0, -15)
    finally:
        robot.kill()
        robot.communicate()
    found = (tmp_path / "said").read_text()
    assert "Traceback" not in found
    assert "\x1b" not in found
    assert len(found) < 5000
