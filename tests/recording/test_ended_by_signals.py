"""Commands around recordings that are asked to end leave no half a file, and no lost one."""

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.candump import write_config, write_log
from tests.support.talking import live, talking
from tests.support.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]
GROUP = "239.74.163.49"
SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def begin(*arguments: str, hangups: str = "default") -> "subprocess.Popen[str]":
    """Start a command that takes the signals, also where this process ignores them."""
    program = ["env", "--default-signal=INT,TERM", f"--{hangups}-signal=HUP"]
    return subprocess.Popen(
        [*program, sys.executable, "-m", "skin_host", *arguments],
        cwd=ROOT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def wait_until(is_so: Callable[[], bool]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not is_so() and time.monotonic() < end_s:
        time.sleep(0.001)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Minutes of a board: a replay of it takes a second."""
    folder = tmp_path_factory.mktemp("long")
    write_config(folder / "skin.toml")
    return write_log(folder / "a.log", 6000, lambda _: ())


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_a_replay_that_is_ended_leaves_no_file(
    log: Path, tmp_path: Path, number: signal.Signals
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    config = log.parent / "skin.toml"
    command = ["replay", str(log), "--config", str(config), "--output", str(out / "a.jsonl")]
    with begin(*command) as running:
        wait_until(lambda: any(out.iterdir()))
        running.send_signal(number)
        said, err = running.communicate(timeout=PATIENCE_S)
    assert (running.returncode, said, err) == (128 + number, "", "")
    assert not any(out.iterdir())


def is_recorded(folder: Path) -> bool:
    """Whether frames have come to a recording that has no name yet."""
    return any(path.stat().st_size for path in folder.iterdir() if path.suffix != ".toml")


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_a_recording_that_is_ended_gets_its_name(tmp_path: Path, number: signal.Signals) -> None:
    """A terminal that is closed sends SIGHUP."""
    config = live(tmp_path, GROUP)
    path = tmp_path / "a.log"
    with talking(GROUP), begin("record", str(path), "--config", str(config)) as running:
        wait_until(lambda: is_recorded(tmp_path))
        running.send_signal(number)
        said, err = running.communicate(timeout=PATIENCE_S)
    assert running.returncode == 0, err
    assert said.startswith(f"{path}: ")
    assert path.read_text().endswith(" 4E4#40\n")
    assert {one.name for one in tmp_path.iterdir()} == {"skin.toml", "a.log"}


def test_a_recording_under_nohup_goes_on_when_its_terminal_is_closed(tmp_path: Path) -> None:
    config = live(tmp_path, GROUP)
    path = tmp_path / "a.log"
    command = ["record", str(path), "--config", str(config)]
    with talking(GROUP), begin(*command, hangups="ignore") as running:
        wait_until(lambda: is_recorded(tmp_path))
        running.send_signal(signal.SIGHUP)
        with pytest.raises(subprocess.TimeoutExpired):
            running.wait(0.5)
        running.send_signal(signal.SIGTERM)
        running.communicate(timeout=PATIENCE_S)
    assert running.returncode == 0
    assert path.exists()


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_a_search_for_a_robot_that_is_ended_ends_at_once(
    tmp_path: Path, number: signal.Signals
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as broker:  # never answers
        where = f"127.0.0.1:{broker.getsockname()[1]}"
        path = tmp_path / "a.mcap"
        with begin("record", str(path), "--broker", f"mqtt://{where}") as running:
            with broker.accept()[0]:
                running.send_signal(number)
                said, err = running.communicate(timeout=PATIENCE_S)
    wanted = f"{path}: ended before a robot was found at {where}; nothing is recorded"
    assert (running.returncode, said, err) == (1, "", f"skin record: {wanted}\n")
    assert not any(tmp_path.iterdir())
