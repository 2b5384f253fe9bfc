"""A folder that may not be entered, a home that there is not, a storm of signals, no more files."""

import asyncio
import errno
import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from skin_host.cli import main, operate
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus, changed, load
from skin_host.daemon import service
from skin_host.daemon.calibrate import calibration_path, stored_calibration
from skin_host.daemon.state import Zeros, load_kept
from skin_host.daemon.workers import share_of
from skin_host.errors import RequestError, SkinError
from skin_host.layout import build_layout
from tests.support.broker import free_port
from tests.support.live import CONFIG, living
from tests.support.stepped import stepped
from tests.support.waiting import PATIENCE_S

ROBOT = CONFIG.read_text() + f"\n[mqtt]\nport = {free_port()}\n"


def forbid(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody may enter a folder: what root, as whom tests may run, is never refused."""
    stat, access, opened = os.stat, os.access, os.open

    def refuse(path: Any) -> None:
        if not isinstance(path, int) and folder in Path(path).parents:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    def of(wanted: Any) -> Any:
        def do(path: Any, *arguments: Any, **keys: Any) -> Any:
            refuse(path)
            return wanted(path, *arguments, **keys)

        return do

    def may(path: Any, *arguments: Any, **keys: Any) -> bool:
        return folder not in Path(path).parents and access(path, *arguments, **keys)

    monkeypatch.setattr(os, "stat", of(stat))
    monkeypatch.setattr(os, "lstat", of(os.lstat))
    monkeypatch.setattr(os, "open", of(opened))
    monkeypatch.setattr(os, "access", may)


@stepped
async def test_a_state_directory_that_may_not_be_entered_any_more_ends_nothing(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with living(can_bus_settings, tmp_path / "state", clock=clock) as live:
        await clock.sleep(2.0)
        with monkeypatch.context() as context:
            forbid(tmp_path / "state", context)
            await clock.sleep(12.0)
            await live.until("state_not_kept")
        await clock.sleep(12.0)
        assert "state_not_kept" not in {code for code, _ in live.faults()}


def test_a_state_directory_that_may_not_be_entered_is_reported_and_the_start_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    settings = changed(load(CONFIG), {"service.state_directory": str(tmp_path / "state")})
    layout = build_layout(settings, CONFIG.parent)
    forbid(tmp_path / "state", monkeypatch)
    assert stored_calibration(settings, layout, "main") is None
    assert load_kept(tmp_path / "state" / "demo-main.zeros.json", Zeros) == Zeros()
    first, second = (record.getMessage() for record in caplog.records)
    path = calibration_path(settings, "main")
    assert first == f"{path}: cannot be read: Permission denied; a new one is taken"
    assert "no taxel is valid until it is calibrated" in second


@pytest.mark.parametrize("folder", ["~no-such-user/x", "a\\u0000b"])
def test_a_state_directory_that_is_no_path_is_refused_in_a_line(
    folder: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(f'{ROBOT}[service]\nstate_directory = "{folder}"\n')
    for words in (["run", "--duration", "1"], ["calibrate"]):
        assert main([*words, str(path)]) == 2
        (said,) = capsys.readouterr().err.splitlines()
        assert "service.state_directory: " in said
        assert "wanted " in said


def test_without_a_home_a_line_states_what_is_to_be_set(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody(_: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "expanduser", nobody)
    with pytest.raises(RequestError, match="name a folder there, or set HOME"):
        service.state_directory(None)


def test_systemd_is_not_told_when_no_more_files_may_be_open_and_nothing_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> socket.socket:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setattr(socket, "socket", full)
    service.notify("WATCHDOG=1")


def test_a_folder_of_systemd_that_takes_nothing_does_not_keep_the_skin_from_starting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "file"))
    operate._show_running(load(CONFIG))
    assert "configuration.json: cannot be written: " in caplog.text
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    operate._show_running(load(CONFIG))
    assert json.loads((tmp_path / operate.RUNNING).read_bytes())["robot"] == "demo"


@stepped
async def test_reloads_that_come_together_read_the_file_twice_and_zero_no_board(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hundred set-ups were half a minute without touch."""
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        daemon = live.daemon
        known = daemon._configured
        read: list[Path] = []

        def load_again(path: Path) -> Any:
            read.append(path)
            return known

        monkeypatch.setattr("skin_host.daemon.daemon.load", load_again)
        before = daemon.link.boards["can0"].records[14].configurations
        await asyncio.gather(*(daemon.reload() for _ in range(100)))
        # One that was being carried out, and one that reads what changed since it read.
        assert len(read) == 2
        assert daemon.link.boards["can0"].records[14].configurations == before
        monkeypatch.setattr("skin_host.daemon.daemon.load", lambda _: 1 / 0)
        daemon._configuration = None
        refused = await asyncio.gather(*(daemon.reload() for _ in range(9)), return_exceptions=True)
        assert {type(one) for one in refused} == {RequestError}
        await live.until_well()


def test_a_share_that_a_changed_configuration_has_not_is_refused() -> None:
    with pytest.raises(SkinError, match="seen share 2 of 2, wanted one of the 1"):
        share_of(load(CONFIG), "main", 2, 2)


@pytest.mark.parametrize("options", [[], ["--workers", "1"]])
def test_a_storm_of_hangups_at_the_start_ends_nothing(options: list[str], tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(f'{ROBOT}[service]\nstate_directory = "{tmp_path}"\n')
    log = tmp_path / "log"
    with log.open("wb") as written:
        daemon = subprocess.Popen(
            [sys.executable, "-c", START, "run", str(path), *options], stderr=written
        )
    try:
        # From the first line of `skin run` on; what starts Python itself is not ours.
        while not (tmp_path / "begun").exists():
            assert daemon.poll() is None
        for _ in range(400):
            daemon.send_signal(signal.SIGHUP)
            with pytest.raises(subprocess.TimeoutExpired):
                daemon.wait(0.01)
        daemon.terminate()
        assert daemon.wait(PATIENCE_S) == 0
    finally:
        daemon.kill()
    assert b"Traceback" not in log.read_bytes()


#: Shows when the command begins.
START = """
import sys
from pathlib import Path
from skin_host.cli import main, operate
service = operate.service
hold = service.hold_hangups

def begin():
    hold()
    (Path(sys.argv[2]).parent / "begun").touch()

service.hold_hangups = begin
sys.exit(main())
"""
