"""A node runs once on a computer."""

import errno
import os
import select
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from skin_host.cli import main
from skin_host.config.settings import Settings, changed, load
from skin_host.daemon.alone import alone
from skin_host.errors import StateError
from tests.support.live import CONFIG

HOLD = """
import sys, time
from pathlib import Path
from skin_host.config.settings import load
from skin_host.daemon.alone import alone
with alone(load(Path(sys.argv[1])), "main"):
    print("alone", flush=True)
    time.sleep(1000)
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "robot.toml"
    path.write_text(f'{CONFIG.read_text()}\n[service]\nstate_directory = "{tmp_path / "state"}"\n')
    return path


@pytest.fixture
def settings(config: Path) -> Settings:
    return load(config)


def test_a_second_one_is_refused_until_the_first_has_ended(settings: Settings) -> None:
    with alone(settings, "main"):
        for _ in range(2):
            with pytest.raises(StateError, match="another daemon would zero its boards"):
                with alone(settings, "main"):
                    pass
        # Others have other boards.
        with alone(settings, "arm"), alone(changed(settings, {"robot": "other"}), "main"):
            pass
    with alone(settings, "main"):
        pass


def test_a_pipe_in_place_of_the_lock_holds_up_no_daemon(config: Path, settings: Settings) -> None:
    """Nobody writes to it: who opened it to read would wait for ever."""
    with alone(settings, "main"):
        pass
    (lock,) = (config.parent / "state").glob("*.lock")
    lock.unlink()
    os.mkfifo(lock)
    command = [sys.executable, "-c", HOLD, str(config)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        ready, _, _ = select.select([process.stdout], [], [], 20.0)
        process.kill()
    assert ready


def test_another_user_is_refused_too(settings: Settings, tmp_path: Path) -> None:
    """Who cannot open the lock does not notice it; systemd's service has a umask of 0077."""
    before = os.umask(0o077)
    try:
        with alone(settings, "main"):
            (lock,) = (tmp_path / "state").glob("*.lock")
            assert stat.S_IMODE(lock.stat().st_mode) == 0o644
    finally:
        os.umask(before)


@pytest.mark.parametrize("why", [errno.EPERM, errno.EROFS])
def test_a_second_one_is_refused_where_the_lock_cannot_be_changed(
    settings: Settings, monkeypatch: pytest.MonkeyPatch, why: int
) -> None:
    """It is another user's, or its disk has become read-only since the first one began."""

    def refuse(*_: object) -> None:
        raise OSError(why, os.strerror(why))

    with alone(settings, "main"):
        monkeypatch.setattr(os, "fchmod", refuse)
        with (
            pytest.raises(StateError, match="another daemon would zero its boards"),
            alone(settings, "main"),
        ):
            pass


def test_a_process_that_is_killed_leaves_the_node_to_others(config: Path) -> None:
    arguments = [sys.executable, "-c", HOLD, str(config)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"alone\n"
        with pytest.raises(StateError):
            with alone(load(config), "main"):
                pass
        process.send_signal(signal.SIGKILL)
    with alone(load(config), "main"):
        pass


@pytest.mark.parametrize("what", ["file", "link", "folder"])
def test_where_nothing_can_be_kept_a_daemon_runs_all_the_same(
    settings: Settings, tmp_path: Path, what: str
) -> None:
    place = tmp_path / "state"
    if what == "file":
        place.write_text("")
    else:
        place.mkdir()
        lock = place / "demo-main.lock"
        if what == "link":
            lock.symlink_to(tmp_path / "elsewhere")
        else:
            lock.mkdir()
    with alone(settings, "main"):
        pass
    assert not os.path.lexists(tmp_path / "elsewhere")


@pytest.mark.parametrize(
    "command",
    [["run", "--duration", "3"], ["run", "--duration", "3", "--workers", "2"], ["calibrate"]],
)
def test_a_command_that_would_zero_the_boards_of_a_daemon_is_refused(
    config: Path, capsys: pytest.CaptureFixture[str], command: list[str]
) -> None:
    name, *options = command
    with alone(load(config), "main"):
        assert main([name, str(config), *options]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1 or name == "calibrate"
    assert "is running, and another daemon would zero its boards" in err
