"""The lane runs a command, says how it ended, and fails when it cannot."""

import os
import subprocess
from pathlib import Path

import pytest

from tests.support import programs

_RUN = Path(__file__).parents[3] / "tools/lane/run"


def _lane(*command: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [_RUN, *command],
        env=dict(os.environ, **environment),
        check=False,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
    )


def test_the_status_the_output_and_the_environment_are_the_commands_own() -> None:
    done = _lane("sh", "-c", 'echo "$GREETING it\'s $PWD"; exit 7', GREETING="hello")
    assert done.returncode == 7, done.stderr
    assert done.stdout == f"hello it's {Path.cwd()}\n"


def test_a_command_that_succeeds_has_vcan_and_cuse() -> None:
    done = _lane(
        "sh", "-c", "ip link add vlane type vcan && ip link del vlane && test -c /dev/cuse"
    )
    assert done.returncode == 0, done.stderr


def test_where_the_kernel_has_both_no_machine_is_started() -> None:
    done = _lane(str(_RUN), "sh", "-c", "exit 5", LANE_TIMEOUT="60")
    assert done.returncode == 5
    assert "lane: on this host's kernel" in done.stdout + done.stderr


def test_a_command_that_does_not_end_is_a_failure_of_the_lane() -> None:
    done = _lane("sleep", "1000", LANE_TIMEOUT="3")
    assert done.returncode == 125
    assert "LANE_TIMEOUT" in done.stderr


def test_a_command_in_the_machine_changes_no_file_of_the_host(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.write_text("host")
    done = _lane("sh", "-c", f"echo guest >{kept}; cat {kept}", LANE="vm")
    assert (done.returncode, done.stdout) == (0, "guest\n"), done.stderr
    assert kept.read_text() == "host"


def test_a_lane_that_cannot_start_is_a_failure(tmp_path: Path) -> None:
    for name in ("bash", "env", "dirname", "uname"):
        (tmp_path / name).symlink_to(programs.require(name))
    done = _lane("true", LANE="vm", PATH=str(tmp_path))
    assert done.returncode == 125
    assert "tools/lane/packages" in done.stderr


@pytest.mark.parametrize("name", ["candump", "cansend", "i2ctransfer", "chromium", "mosquitto_sub"])
def test_the_packages_have_brought_the_program(name: str) -> None:
    assert Path(programs.require(name)).exists()
