"""Commands around recordings that are asked to end leave no half a file, and no lost one."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from skin_host.recording.mcap import read_messages_of
from tests.support.candump import write_config, write_log
from tests.support.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]
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


def virtual(folder: Path) -> Path:
    """Write a configuration of a bus on which nothing comes."""
    path = write_config(folder / "skin.toml")
    path.write_text(
        path.read_text().replace('channel = "can0"', 'channel = "v"\ninterface = "virtual"')
    )
    return path


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
        end_s = time.monotonic() + PATIENCE_S
        while not any(out.iterdir()) and time.monotonic() < end_s:
            time.sleep(0.001)
        running.send_signal(number)
        said, err = running.communicate(timeout=PATIENCE_S)
    assert (running.returncode, said, err) == (128 + number, "", "")
    assert not any(out.iterdir())


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_a_recording_that_is_ended_gets_its_name(tmp_path: Path, number: signal.Signals) -> None:
    """A terminal that is closed sends SIGHUP."""
    config = virtual(tmp_path)
    path = tmp_path / "a.mcap"
    with begin("record", str(path), "--config", str(config)) as running:
        assert running.stderr is not None
        assert "end with Ctrl-C" in running.stderr.readline()
        running.send_signal(number)
        said, _ = running.communicate(timeout=PATIENCE_S)
    assert running.returncode == 1  # nothing comes on that bus
    assert said.startswith(f"{path}: ")
    assert list(read_messages_of(path)) == []
    assert {one.name for one in tmp_path.iterdir()} == {"skin.toml", "a.mcap"}


def test_a_recording_under_nohup_goes_on_when_its_terminal_is_closed(tmp_path: Path) -> None:
    config = virtual(tmp_path)
    path = tmp_path / "a.mcap"
    command = ["record", str(path), "--config", str(config)]
    with begin(*command, hangups="ignore") as running:
        assert running.stderr is not None
        assert "end with Ctrl-C" in running.stderr.readline()
        running.send_signal(signal.SIGHUP)
        with pytest.raises(subprocess.TimeoutExpired):
            running.wait(0.5)
        running.send_signal(signal.SIGTERM)
        running.communicate(timeout=PATIENCE_S)
    assert running.returncode == 1  # nothing comes on that bus
    assert path.exists()
